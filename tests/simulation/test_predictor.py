"""Predictions against runs by another solver, and against the admissible set where the loop is linear."""

import importlib.util
import math

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.symbolic import extra


def rates(x, r):
    """Pendulum under a PD law with gravity fed forward at the reference, and the law's torque."""
    u = 12.0 * (r - x[0]) - 5.0 * x[1] + 9.81 * np.sin(r)
    return np.array([x[1], -9.81 * np.sin(x[0]) + u]), u


def pendulum():
    return ct.nlsys(
        lambda t, x, u, p: rates(x, u[0])[0],
        lambda t, x, u, p: np.array([x[0], rates(x, u[0])[1]]),
        inputs="r",
        outputs=["angle", "torque"],
        states=["angle", "rate"],
        name="pendulum",
    )


def highest_torque(x, r):
    run = solve_ivp(lambda t, x: rates(x, r)[0], (0.0, 4.0), x, "DOP853", rtol=1e-9, atol=1e-10, dense_output=True)
    times = 4.0 * np.linspace(0.0, 1.0, 801) ** 2
    return max(rates(x, r)[1] for x in run.sol(times).T)


def by_bisection(x, high):
    """Largest step from 0 whose torque stays below a limit, by runs made here."""
    low, maximum = 0.0, 3.0
    while maximum - low > 1e-4:
        middle = 0.5 * (low + maximum)
        low, maximum = (middle, maximum) if highest_torque(x, middle) < high else (low, middle)
    return low


@pytest.mark.slow
@pytest.mark.parametrize("x", [[0.0, 0.0], [0.2, 0.3], [-0.1, -0.5]])
def test_the_largest_step_of_a_pendulum(x):
    """The limit is 10 of -10 to 10, kept by a margin of 0.02."""
    predictor = cp.Predictor(pendulum(), {"torque": (-10.0, 10.0)}, 8.0, resolution=2.0**-11)
    kappa = predictor.fraction(x, [0.0], [1.0])
    assert 0.0 < kappa < 1.0
    assert abs(kappa - by_bisection(x, 9.8)) < 2e-3
    assert predictor.contains(x, [kappa])
    assert predictor.fraction(x, [0.0], [0.9 * kappa]) == 1.0
    assert highest_torque(x, kappa) < 10.0


@pytest.mark.slow
def test_the_fraction_is_within_the_resolution_and_below_it_within_a_factor_of_two():
    coarse = cp.Predictor(pendulum(), {"torque": (-10.0, 10.0)}, 8.0)
    exact = by_bisection([0.0, 0.0], 9.8)
    kappa = coarse.fraction([0.0, 0.0], [0.0], [1.0])
    assert exact - 1.0 / 64.0 - 2e-3 < kappa < exact + 2e-3
    kappa = coarse.fraction([0.0, 0.0], [0.0], [-300.0])  # the limits are symmetric
    assert 0.49 * exact < 300.0 * kappa < exact + 1e-2


@pytest.mark.slow
def test_a_linear_loop_is_as_the_admissible_set_says():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    limits = {"u": (-1.0, 1.0), "y": (-0.5, 0.5)}
    predictor = cp.Predictor(loop, limits, 25.0, margin=1e-3, resolution=1e-4)
    known = cp.AdmissibleSet(loop, limits, 0.05, margin=2e-3)
    rng = np.random.default_rng(0)
    for _ in range(12):
        x, v, r = 0.15 * rng.standard_normal(2), 0.1 * rng.standard_normal(1), rng.standard_normal(1)
        one, two = predictor.fraction(x, v, r), known.fraction(x, v, r)
        if known.contains(x, v):
            assert abs(one - two) < 0.02
        elif math.isnan(two):
            assert not predictor.contains(x, 1.1 * v) or not known.contains(x, v)
    assert predictor.references == known.references
    assert predictor.states == known.states


def test_the_steady_state_keeps_twice_the_margin():
    lag = ct.nlsys(lambda t, x, u, p: -x + u, None, inputs="r", outputs="y", states="x", name="lag")
    predictor = cp.Predictor(lag, {"y": (-1.0, math.inf)}, 20.0, margin=0.05)
    assert predictor.contains([-0.94], [5.0])
    assert not predictor.contains([-0.96], [5.0])
    assert predictor.contains([0.0], [-0.89])
    assert not predictor.contains([0.0], [-0.91])


def test_what_does_not_come_to_rest_is_not_admissible():
    swing = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - np.sin(x[0])]), None, inputs="r", outputs=["y", "w"], states=2
    )
    predictor = cp.Predictor(swing, {"y": (-1.0, 1.0)}, 40.0)
    assert predictor.contains([0.0, 0.0], [0.0])
    assert predictor.contains([0.005, 0.0], [0.0])  # a swing of 0.01 is less than the margin
    assert not predictor.contains([0.5, 0.0], [0.0])


def test_a_peak_between_the_times_that_are_looked_at():
    """Twenty-five looks at an overshoot of 1 + exp(-pi/3 ...): the parabola finds it within a hundredth."""
    zeta, w = 0.3, 2.0
    loop = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], w * w * (u[0] - x[0]) - 2 * zeta * w * x[1]]),
        lambda t, x, u, p: x[0],
        inputs="r",
        outputs="y",
        states=2,
        name="loop",
    )
    largest = 1.0 / (1.0 + math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)))
    predictor = cp.Predictor(loop, {"y": (-1.0, 1.0)}, 10.0, count=30, margin=0.02, resolution=1e-4)
    assert abs(predictor.fraction([0.0, 0.0], [0.0], [1.0]) - 0.98 * largest) < 0.01


@pytest.mark.parametrize("law", ["explodes", "ends"])
def test_a_prediction_that_fails_is_not_admissible(law):
    grow = {"explodes": lambda x: x * x, "ends": lambda x: 1.0 - np.sqrt(0.5 - x)}[law]
    loop = ct.nlsys(
        lambda t, x, u, p: np.array([grow(x[0]) * np.exp(u[0]) - x[0]]),
        None,
        inputs="r",
        outputs="y",
        states=["x"],
        name="loop",
    )
    predictor = cp.Predictor(loop, {"y": (-math.inf, 1e9)}, 15.0)
    assert not predictor.contains([0.4], [3.0])
    assert math.isnan(predictor.fraction([0.4], [3.0], [4.0]))


@pytest.mark.slow
def test_without_casadi_python_says_the_same(monkeypatch):
    predictor = cp.Predictor(pendulum(), {"torque": (-10.0, 10.0)}, 8.0)
    compiled = predictor.fraction([0.0, 0.0], [0.0], [1.0])
    monkeypatch.setattr(extra, "find_spec", lambda name: None)
    assert importlib.util.find_spec("casadi") is not None
    assert predictor.fraction([0.0, 0.0], [0.0], [1.0]) == compiled


def test_a_block_that_cannot_be_traced_is_run_by_python():
    def stiffened(t, x, u, p):
        return np.array([-float(x[0]) + (u[0] if x[0] < 0.5 else 0.5 * u[0] + 0.25)])

    loop = ct.nlsys(stiffened, None, inputs="r", outputs="y", states=["x"], name="loop")
    predictor = cp.Predictor(loop, {"y": (-1.0, 1.0)}, 15.0, margin=0.01)
    assert predictor.contains([0.0], [1.4])  # rests at 0.95
    assert not predictor.contains([0.0], [1.6])  # would at 1.05


def test_parameters_and_other_inputs():
    loop = ct.nlsys(
        lambda t, x, u, p: p["k"] * u[0] + u[1] - x,
        None,
        inputs=["r", "d"],
        outputs="y",
        states=["x"],
        params={"k": 1.0},
        name="loop",
    )
    predictor = cp.Predictor(loop, {"y": (-1.0, 1.0)}, 15.0, references=["r"], params={"k": 4.0}, resolution=1e-4)
    assert abs(predictor.fraction([0.0], [0.0], [1.0]) - 0.96 / 4.0) < 1e-3
    assert repr(predictor) == "<Predictor of loop over 15 s>"


def test_a_sampled_law_is_predicted_with_its_samples():
    """x' = u, u = 3 (r - x) every 0.5 s: errors shrink by 1 - 1.5 a sample, so a step overshoots by half."""
    law = ct.ss([], [], [], [[3.0, -3.0]], 0.5, inputs=["r", "y"], outputs="u", name="law")
    plant = ct.ss([[0.0]], [[1.0]], [[1.0]], 0, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([cp.sample_hold(law, 0.5), plant], inputs="r", outputs="y", name="loop")
    predictor = cp.Predictor(loop, {"y": (-1.5, 1.5)}, 12.0, resolution=1e-4, count=400)
    assert abs(predictor.fraction([0.0, 0.0], [0.0], [1.0]) - 0.98) < 0.02


GOOD = {"limits": {"torque": (-1.0, 1.0)}, "horizon": 5.0}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"limits": {"force": (-1, 1)}}, "limits must be among the outputs angle, torque, got 'force'"),
        ({"limits": {}}, "limits must name at least one output"),
        ({"limits": {"torque": (2, 1)}}, "limits of torque must increase, got 2 and 1"),
        ({"limits": {"torque": (-math.inf, math.inf)}}, "must contain a finite one"),
        ({"limits": {"torque": -3.0}}, "limits of torque must be finite and above 0, got -3.0"),
        ({"horizon": 0.0}, "horizon must be finite and above 0, got 0.0"),
        ({"references": ["q"]}, "references must be among the inputs r, got 'q'"),
        ({"references": []}, "references must name at least one input"),
        ({"references": ["r", "r"]}, "references must not name an input twice"),
        ({"margin": 0.5}, r"margin must lie in \(0, 0.5\), got 0.5"),
        ({"resolution": 0.0}, r"resolution must lie in \(0, 1\), got 0.0"),
        ({"count": 5}, "count must be a whole number from 20 to 100000, got 5"),
        ({"count": 20.5}, "count must be a whole number"),
    ],
)
def test_what_is_rejected(given, message):
    with pytest.raises(ValueError, match=message):
        cp.Predictor(pendulum(), **{**GOOD, **given})


def test_systems_that_a_state_does_not_predict():
    limits = {"y": (-1.0, 1.0)}
    plan = cp.create_source_iosystem(cp.Step(1.0, labels=["d"]))
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="u", outputs="y", name="lag")
    both = ct.interconnect([plan, ct.summing_junction(["r", "d"], "u"), lag], inputs="r", outputs="y", name="both")
    with pytest.raises(ValueError, match="must not depend on time, got the plan or breakpoints of the block plan"):
        cp.Predictor(both, limits, 5.0)
    late = ct.interconnect(
        [cp.create_delay_iosystem(0.5, inputs="r", outputs="u"), lag], inputs="r", outputs="y", name="late"
    )
    with pytest.raises(ValueError, match="must have a finite number of states, got the delay of the block delay"):
        cp.Predictor(late, limits, 5.0)
    with pytest.raises(ValueError, match=r"must be continuous, got .* dt = 0.1"):
        cp.Predictor(ct.ss([[0.5]], [[1]], [[1]], 0, 0.1, inputs="r", outputs="y"), limits, 5.0)
    gain = ct.nlsys(None, lambda t, x, u, p: -np.sin(u), inputs="y", outputs="u", name="gain")
    with pytest.raises(ValueError, match="must have an input to govern"):
        cp.Predictor(ct.interconnect([gain, lag], inputs=0, outputs="y", name="alone"), limits, 5.0)
    with pytest.raises(TypeError, match="system must be a control system, got float"):
        cp.Predictor(1.0, limits, 5.0)


@pytest.mark.parametrize(
    ("x", "v", "message"),
    [
        ([0.0], [0.0], "x must have 2 finite entries"),
        ([0.0, math.nan], [0.0], "x must"),
        ([0, 0], [0, 1], "v must have 1"),
    ],
)
def test_states_and_references_that_do_not_fit(x, v, message):
    predictor = cp.Predictor(pendulum(), **GOOD)
    with pytest.raises(ValueError, match=message):
        predictor.contains(x, v)


def test_it_is_immutable():
    with pytest.raises(AttributeError, match="immutable"):
        cp.Predictor(pendulum(), **GOOD).horizon = 3.0


@pytest.mark.slow
def test_a_crane_whose_law_feeds_the_load_back():
    """The load is sent 4 m away by a jump: sway and force within their limits at all times."""
    from ctrlplan.systems.plants import create_load_feedback_iosystem

    crane = cp.plants.Crane()
    lags = np.kron(np.eye(2), [[0, 1, 0], [0, 0, 1], [-1.0, -3.0, -3.0]])
    jet = [f"{axis}_ref{order}" for axis in "xz" for order in ("", "_d1", "_d2")]
    command = ct.ss(
        lags, np.kron(np.eye(2), [[0], [0], [1.0]]), np.eye(6), 0, inputs=["x_set", "z_set"], outputs=jet, name="filter"
    )
    blocks = [command, create_load_feedback_iosystem(crane, 0.5), crane.trolley_pid(5.0), crane.hoist_pid(5.0)]
    plant = crane.iosystem()
    loop = ct.interconnect(
        [*blocks, plant], inputs=["x_set", "z_set"], outputs=[*plant.output_labels, "F", "C"], name="crane_loop"
    )
    rest = np.zeros(loop.nstates)
    rest[3] = 10.0
    rest[-6:] = crane.equilibrium(0.0, 10.0)[0]
    limits = {"theta": (-0.06, 0.06), "F": (-6000.0, 6000.0)}
    governor = cp.create_governor_iosystem(cp.Predictor(loop, limits, 40.0), 1.0, initial=[0.0, 10.0])
    outputs = [*plant.output_labels, "F", "C", "x_set", "z_set"]
    requested = ["x_set_cmd", "z_set_cmd"]
    whole = ct.interconnect([governor, cp.expose_states(loop)], inputs=requested, outputs=outputs)
    start = np.concatenate([np.zeros(5), rest])
    found = cp.simulate(whole, np.linspace(0.0, 60.0, 12001), {"x_set_cmd": 4.0, "z_set_cmd": 10.0}, start)
    y = dict(zip(outputs, found.outputs, strict=True))
    assert found.events == []
    assert np.abs(y["theta"]).max() <= 0.06
    assert np.abs(y["F"]).max() <= 6000.0
    assert np.abs(y["F"]).max() > 4000.0
    assert abs(y["x"][-1] - 4.0) < 0.05
