"""Governed loops: limits at all times, unchanged admissible commands, held references without valid inputs."""

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.systems import Admission

TIGHT = {"rtol": 1e-10, "atol": 1e-12}


def lag_loop(**options):
    """k/(s^2 + s) in unity feedback with |u| <= 1, governed every 0.05 s."""
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    governor = cp.create_governor_iosystem(loop, 0.05, {"u": (-1.0, 1.0)}, **options)
    return ct.interconnect([governor, cp.expose_states(loop)], inputs=["r_cmd"], outputs=["y", "u", "r"])


def random_governed(rng):
    """A stable loop of 2 to 4 states with feedthrough, its limits, and the governed whole."""
    n = int(rng.integers(2, 5))
    a = rng.standard_normal((n, n))
    a -= (np.linalg.eigvals(a).real.max() + rng.uniform(0.3, 1.0)) * np.eye(n)
    m = int(rng.integers(1, 3))
    names = {"inputs": [f"r{i}" for i in range(m)], "outputs": ["y", "u"], "name": "plant"}
    loop = ct.ss(a, rng.standard_normal((n, m)), rng.standard_normal((2, n)), rng.standard_normal((2, m)), **names)
    limits = {"y": (-rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0)), "u": (-1.0, rng.uniform(0.5, 2.0))}
    found = cp.AdmissibleSet(loop, limits, rng.uniform(0.02, 0.3))
    governor = cp.create_governor_iosystem(found)
    requested = [f"r{i}_cmd" for i in range(m)]
    whole = ct.interconnect([governor, cp.expose_states(loop)], inputs=requested, outputs=["y", "u", *names["inputs"]])
    return loop, limits, found, whole


def jumps(rng, end, size, count=5):
    """A reference that jumps at random times to random values, and one that is smooth."""
    times = np.sort(rng.uniform(0.0, end, count))
    steps = [
        cp.Step(float(value), time=float(t)) for t, value in zip(times, size * rng.standard_normal(count), strict=True)
    ]
    points = [cp.Waypoint(float(t), float(size * rng.standard_normal())) for t in np.linspace(0.0, end, 5)]
    return sum(steps[1:], steps[0]) + cp.PolySpline(points)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_limits_hold_at_all_times(seed):
    rng = np.random.default_rng(seed)
    loop, limits, found, whole = random_governed(rng)
    m, n = loop.ninputs, loop.nstates
    while not found.contains(x := rng.standard_normal(n) * rng.uniform(0.0, 2.0), np.zeros(m)):
        pass
    inputs = {f"r{i}_cmd": jumps(rng, 8.0, 3.0) for i in range(m)}
    start = np.concatenate([np.zeros(m + 3), x])
    response = cp.simulate(whole, np.linspace(0.0, 10.0, 8001), inputs, start, **TIGHT)
    for y, (low, high) in zip(response.outputs[:2], limits.values(), strict=True):
        assert y.max() <= high + 1e-9 * (high - low)
        assert y.min() >= low - 1e-9 * (high - low)
    fraction = response.states[response.state_labels.index("governor_fraction")]
    assert fraction.min() < 1.0  # else nothing was limited
    assert response.events == []


@pytest.mark.slow
def test_limits_hold_whatever_a_bounded_disturbance_does():
    """One that switches at random between extremes, and one at the natural frequency of the loop."""
    loop = ct.ss(
        [[0, 1], [-4, -0.8]], [[0, 0.5], [4, 1]], [[1, 0]], 0, inputs=["r", "w"], outputs="y", states=2, name="loop"
    )
    governor = cp.create_governor_iosystem(loop, 0.1, {"y": (-1.0, 1.0)}, disturbances={"w": 0.15})
    whole = ct.interconnect([governor, cp.expose_states(loop)], inputs=["r_cmd", "w"], outputs=["y", "r"])
    rng, times = np.random.default_rng(0), np.linspace(0.0, 20.0, 8001)
    for instants in (np.sort(rng.uniform(0.0, 20.0, 30)), np.arange(0.0, 20.0, math.pi / math.sqrt(4.0 - 0.16))):
        w = cp.Step(0.15)
        for k, t in enumerate(instants[1:]):
            w = w + cp.Step(0.3 if k % 2 else -0.3, time=float(t))
        found = cp.simulate(whole, times, {"r_cmd": jumps(rng, 15.0, 2.0), "w": w}, **TIGHT)
        assert np.abs(found.outputs[0]).max() <= 1.0 + 1e-9
        assert found.events == []
        assert found.states[1].min() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_every_sample_takes_the_largest_fraction(seed):
    """The law, written out in the test, on states propagated from sample to sample by a matrix exponential."""
    rng = np.random.default_rng(50 + seed)
    loop, _, found, whole = random_governed(rng)
    m, n, dt = loop.ninputs, loop.nstates, found.dt
    r = rng.standard_normal((40, m))
    times = dt * np.arange(40)
    change = expm(np.block([[loop.A, loop.B], [np.zeros((m, n + m))]]) * dt)
    x, v, expected = np.zeros(n), np.zeros(m), []
    for requested in r:
        low, high = 0.0, 1.0
        if found.contains(x, requested):
            low = 1.0
        while high - low > 1e-13:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if found.contains(x, v + middle * (requested - v)) else (low, middle)
        v = v + low * (requested - v)
        expected.append(v)
        x = (change @ np.concatenate([x, v]))[:n]
    fine = np.repeat(times, 2)[1:]
    fine[1::2] -= 1e-9 * dt  # samples are linear in between: a staircase by steep ramps
    held = np.repeat(r, 2, axis=0)[:-1].T
    found_r = cp.simulate(whole, np.unique(fine), held, **TIGHT).outputs[2:]
    assert np.abs(found_r[:, ::2] - np.array(expected).T).max() <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    "plan",
    [
        cp.Step(0.19),
        cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(7.0, 0.6, 0, 0)], alpha=4.0),
        cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(7.0, -0.6, 0, 0)]),
    ],
)
def test_what_is_admissible_passes_unchanged(plan):
    times = 0.05 * np.arange(161)
    found = cp.simulate(lag_loop(), times, {"r_cmd": plan})
    assert np.array_equal(found.states[1], np.ones(161))
    # Two evaluations of a plan differ by the rounding of its six terms, each at most 15 times the move.
    assert np.abs(found.outputs[2] - plan(times)).max() <= 6 * 15 * 0.6 * 0.5 * np.spacing(1.0)
    assert found.events == []


@pytest.mark.slow
def test_what_is_not_admissible_waits_and_arrives():
    plan = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1.0, 1.0, 0, 0)], alpha=4.0)
    found = cp.simulate(lag_loop(), np.linspace(0.0, 12.0, 2401), {"r_cmd": plan}, **TIGHT)
    y, u, r = found.outputs
    assert 0.99 < np.abs(u).max() <= 1.0 + 1e-9
    assert np.abs(cp.simulate(cp.plants.integrator_lag_loop(5.0, outputs=("u",)), found.time, plan).outputs).max() > 1.5
    assert r[-1] == 1.0
    assert abs(y[-1] - 1.0) < 5e-3


@pytest.mark.slow
def test_compiled_and_python_agree():
    times = np.linspace(0.0, 2.0, 101)
    whole = lag_loop()
    runs = [cp.simulate(whole, times, cp.Step(0.7), method=method, **TIGHT) for method in ("compiled", "python")]
    assert [run.method for run in runs] == ["compiled", "python"]
    assert np.abs(runs[0].outputs - runs[1].outputs).max() <= 1e-6


def test_the_reference_before_the_first_sample():
    times = np.linspace(0.0, 1.0, 101)
    start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1])  # the plant at rest at y = 0.1
    found = cp.simulate(lag_loop(initial=0.1, offset=0.32), times, 0.15, start)
    assert np.array_equal(found.outputs[2], np.where(times < 0.32 - 1e-9, 0.1, 0.15))
    assert np.array_equal(found.states[1], np.where(times < 0.32 - 1e-9, 0.0, 1.0))


@pytest.mark.slow
def test_a_sensor_that_fails_and_comes_back():
    """The measured state is nan from 0.5 to 1 s: the reference is held and events are recorded."""
    governor = cp.create_governor_iosystem(
        cp.AdmissibleSet(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="r", outputs="y", states="x"), {"y": (-9, 9)}, 0.1)
    )

    def broken(t, x, u, params):
        return np.array([u[0] if not 0.45 < t < 0.95 else np.nan])

    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="r", outputs="y", name="plant")
    sensor = ct.nlsys(None, broken, inputs="y", outputs="x_state", name="sensor")
    whole = ct.interconnect([governor, plant, sensor], inputs="r_cmd", outputs=["y", "r"])
    times = 0.05 * np.arange(41)
    ramp = cp.PolySpline([cp.Waypoint(0.0, 0.0), cp.Waypoint(2.0, 2.0)])
    found = cp.simulate(whole, times, ramp, method="python")
    sampled = 0.1 * np.floor(times / 0.1 + 1e-6)
    expected = np.where((times > 0.49) & (times < 0.99), 0.4, sampled)
    assert np.abs(found.outputs[1] - expected).max() <= 1e-12
    seen = [(event.name, event.kind, round(event.time, 6)) for event in found.events]
    assert seen == [
        ("governor: nan at the input, reference held", "above", 0.5),
        ("governor: nan at the input, reference held", "inside", 1.0),
    ]


@pytest.mark.slow
def test_a_state_from_which_nothing_is_admissible():
    """The reference is 0 throughout, so that what would come is what comes: u beyond its limits, or not."""
    start = [0.0, 0.0, 0.0, 0.0, -0.4, 0.5]  # u = -2.5 there
    found = cp.simulate(lag_loop(), np.linspace(0.0, 6.0, 1201), 0.0, start)
    assert [(e.name, e.kind) for e in found.events] == [
        ("governor: no admissible reference, previous one held", "above"),
        ("governor: no admissible reference, previous one held", "inside"),
    ]
    assert found.events[0].time == 0.0
    rejected = found.states[2, ::10] == 1.0
    to_come = np.maximum.accumulate(np.abs(found.outputs[1])[::-1])[::-1][::10]
    assert to_come[rejected].min() > 1.0
    assert to_come[~rejected].max() <= 1.01  # outside by no more than the margin


def test_two_references_move_on_a_line():
    loop = ct.ss(-np.eye(2), np.eye(2), [[1.0, 1.0]], 0, inputs=["a", "b"], outputs="y", states=["p", "q"], name="loop")
    governor = cp.create_governor_iosystem(loop, 0.1, {"y": (-1.0, 1.0)})
    assert governor.input_labels == ["a_cmd", "b_cmd", "p_state", "q_state"]
    assert governor.output_labels == ["a", "b"]
    whole = ct.interconnect([governor, cp.expose_states(loop)], inputs=["a_cmd", "b_cmd"], outputs=["y", "a", "b"])
    y, a, b = cp.simulate(whole, np.linspace(0.0, 10.0, 101), {"a_cmd": 2.0, "b_cmd": 1.0}).outputs
    assert np.abs(a - 2.0 * b).max() <= 1e-12
    assert 0.98 < y[-1] <= 0.99 + 1e-9


class Slowly:
    """A user's admission: a tenth of the way at every state."""

    references = ("r",)
    states = ("x[0]",)

    def fraction(self, x, v, r):
        return 0.1


def test_an_admission_of_the_user():
    assert isinstance(Slowly(), Admission)
    governor = cp.create_governor_iosystem(Slowly(), 0.5, name="slow")
    plant = cp.expose_states(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="r", outputs="y", name="plant"))
    whole = ct.interconnect([governor, plant], inputs="r_cmd", outputs=["y", "r"])
    times = 0.5 * np.arange(21)
    found = cp.simulate(whole, times, 1.0)
    assert np.abs(found.outputs[1] - (1.0 - 0.9 ** np.arange(1, 22))).max() <= 1e-12
    assert found.state_labels[:2] == ["slow_r_offset", "slow_fraction"]


@pytest.mark.slow
def test_a_nonlinear_loop_behind_a_predictor():
    """Pendulum under a PID: torque and angle within their limits, and the goal is reached."""
    pendulum = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1] + u[0]]),
        lambda t, x, u, p: x[:1],
        inputs="u",
        outputs="y",
        states=["angle", "rate"],
        name="pendulum",
    )
    cp.declare(pendulum, feedthrough=False)
    law = cp.create_pid_iosystem(20.0, 15.0, 8.0, 0.05, limits=(-30.0, 30.0))
    loop = ct.interconnect([law, pendulum], inputs="r", outputs=["y", "u"], name="loop")
    limits = {"y": (-1.2, 1.05), "u": (-12.0, 12.0)}
    governor = cp.create_governor_iosystem(cp.Predictor(loop, limits, 12.0), 0.2)
    whole = ct.interconnect([governor, cp.expose_states(loop)], inputs="r_cmd", outputs=["y", "u", "r"])
    found = cp.simulate(whole, np.linspace(0.0, 10.0, 5001), cp.Step(1.0))
    assert found.events == []
    for value, (low, high) in zip(found.outputs, limits.values(), strict=False):
        assert low <= value.min()
        assert value.max() <= high
    assert found.outputs[2, -1] == 1.0
    alone = cp.simulate(loop, np.linspace(0.0, 10.0, 5001), cp.Step(1.0))
    assert alone.outputs[1].max() > 12.0


# Blocks and errors


def test_only_simulate_runs_it():
    with pytest.raises(RuntimeError, match=r"block governor, which is sampled, must be run by ctrlplan.simulate"):
        ct.input_output_response(lag_loop(), [0.0, 1.0], [0.0, 0.0])


def test_samples_are_cheap_and_the_same_again():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("u",))
    governor = cp.create_governor_iosystem(loop, 0.05, {"u": (-1.0, 1.0)})
    x, u = np.zeros(4), np.array([1.0, 0.0, 0.0])
    first = governor.sample(0.0, x, u, {})
    first[:] = 7.0
    again = governor.sample(0.0, x, u, {})
    assert 0.199 < again[0] <= 0.2
    assert governor.sample(0.0, x, np.array([0.1, 0.0, 0.0]), {}).tolist() == [0.1, 1.0, 0.0, 0.0]
    assert governor.sample(0.0, x, np.array([math.inf, 0.0, 0.0]), {}).tolist() == [0.0, 0.0, 0.0, 1.0]


LIMITS = {"u": (-1.0, 1.0)}


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"dt": None}, ValueError, "dt and limits must be given with a loop"),
        ({"limits": None}, ValueError, "dt and limits must be given with a loop"),
        ({"dt": -1.0}, ValueError, "dt must be finite and above 0, got -1.0"),
        ({"initial": math.nan}, ValueError, "initial must be a finite number or 1 of them, got nan"),
        ({"initial": [0.0, 1.0]}, ValueError, "initial must be a finite number or 1 of them"),
        ({"offset": -0.1}, ValueError, "offset must be finite and at least 0, got -0.1"),
        ({"margin": 2.0}, ValueError, r"margin must lie in \(0, 1\)"),
        ({"loop": 3.0}, TypeError, "loop must be a linear control system or have references, .* got float"),
        (
            {"loop": Slowly()},
            TypeError,
            "limits must be given with a linear loop only, got a Slowly, which has its own",
        ),
        ({"loop": Slowly(), "limits": None, "margin": 1}, TypeError, "margin must be given with a linear loop only"),
        ({"loop": Slowly(), "limits": None, "dt": None}, ValueError, "dt must be given, the period in s"),
    ],
)
def test_what_is_rejected(given, error, message):
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("u",))
    with pytest.raises(error, match=message):
        cp.create_governor_iosystem(**{"loop": loop, "dt": 0.05, "limits": LIMITS, **given})


def test_the_period_of_a_set_is_that_of_the_governor():
    found = cp.AdmissibleSet(cp.plants.integrator_lag_loop(5.0, outputs=("u",)), LIMITS, 0.05)
    assert cp.create_governor_iosystem(found).period == 0.05
    with pytest.raises(ValueError, match=r"dt must be the period of the admissible set, 0.05 s, got 0.1 s"):
        cp.create_governor_iosystem(found, 0.1)
