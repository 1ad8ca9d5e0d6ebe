"""Time scaling on line: its severity near limits and errors, and loops whose actuator saturates."""

import math
from functools import cache

import control as ct
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp
from time_scaling_cases import INF, METHODS, ONE, RISE, rest

import ctrlplan as cp

# Severity


def severity_of(block, u, t=0.0, slowest=0.1):
    """From the beginning of the first lag at the zero state, where the commanded rate is 1 - severity (1 - slowest)."""
    w = 1.0
    return block.dynamics(t, np.zeros(block.nstates), u)[1] / w / (1 - slowest)


NEARNESS = [
    # limits, margin, then input and severity by hand
    ((-1, 1), 0.1, [(0, 0), (0.8, 0), (0.9, 0.5), (1, 1), (7, 1), (-0.8, 0), (-0.95, 0.75), (-1, 1), (-9, 1)]),
    ((-3, 1), 0.25, [(0, 0), (0.25, 0.25), (0.5, 0.5), (-2, 0), (-2.5, 0.5), (-3, 1), (-1, 0)]),
    ((2, 6), 0.5, [(4, 0), (5, 0.5), (3, 0.5), (2, 1), (6, 1), (0, 1)]),
    ((-INF, 4), 0.25, [(-1e300, 0), (0, 0), (3, 0), (3.5, 0.5), (4, 1), (5, 1)]),
    ((-4, INF), 0.25, [(1e300, 0), (0, 0), (-3, 0), (-3.5, 0.5), (-4, 1), (-5, 1)]),
    ((-INF, -4), 0.25, [(-6, 0), (-5, 0), (-4.5, 0.5), (-4, 1), (0, 1)]),
    ((2, INF), 0.5, [(4, 0), (3, 0), (2.5, 0.5), (2, 1)]),
]


@pytest.mark.parametrize(("limits", "margin", "table"), NEARNESS)
def test_severity_near_limits(limits, margin, table):
    """From 0 at the margin inside to 1 at a limit, linear between, 1 beyond; a margin of the finite limit alone."""
    block = cp.create_time_scaling_iosystem(ONE, limits={"u": limits}, margin=margin, bandwidth=1.0)
    for u, wanted in table:
        assert abs(severity_of(block, [u]) - wanted) <= 1e-14, u


@pytest.mark.parametrize("t", [-1.0, 0.3, 0.5, 2.0])
def test_severity_of_errors(t):
    """0 up to the soft distance, 1 from the hard one on, about where the reference is: by the plan at sigma."""
    block = cp.create_time_scaling_iosystem(ONE, errors={"x": (0.1, 0.5)}, suffix="_ref", bandwidth=1.0)
    tau = min(max(t, 0.0), 1.0)
    for error, wanted in [(0, 0), (0.1, 0), (0.2, 0.25), (-0.3, 0.5), (0.5, 1), (-0.5, 1), (9, 1), (-9, 1)]:
        assert abs(severity_of(block, [RISE(tau) + error], t) - wanted) <= 1e-12
    # Behind by 0.2 s the reference is where the plan was then.
    state = np.array([0.2, 0.0, 0.0])
    was = RISE(min(max(t - 0.2, 0.0), 1.0))
    wanted = 0.1 + (1 - 0.5) * (min(1.1, 1 + 0.2 / 8) - 0.1)
    assert abs(block.dynamics(t, state, [was + 0.3])[1] - (1 - wanted)) <= 1e-12


def test_an_error_may_begin_to_count_at_once():
    block = cp.create_time_scaling_iosystem(ONE, errors={"x": (0.0, 2.0)}, suffix="_ref", bandwidth=1.0)
    for error, wanted in [(0, 0), (0.5, 0.25), (-1, 0.5), (2, 1)]:
        assert abs(severity_of(block, [error]) - wanted) <= 1e-14


def test_the_largest_severity_counts():
    """Two actuators and two axes: the severity is the maximum, not the sum. Inputs in the order named."""
    plan = cp.stack([ONE, rest((0, 3.0), (1, 5.0), labels=["z"])])
    block = cp.create_time_scaling_iosystem(
        plan,
        limits={"F": (-10, 10), "C": (-2, 0)},
        errors={"z": (1.0, 2.0), "x": (0.5, 1.0)},
        suffix="_ref",
        bandwidth=1.0,
    )
    assert block.input_labels == ["F", "C", "z", "x"]
    calm = np.array([0.0, -1.0, 3.0, 0.0])
    assert severity_of(block, calm) == 0.0
    for place, value, wanted in [(0, 9.0, 0.5), (1, -0.05, 0.75), (2, 1.75, 0.25), (3, -0.8, 0.6)]:
        u = calm.copy()
        u[place] = value
        assert abs(severity_of(block, u) - wanted) <= 1e-12
    worst = calm + np.array([9.0, 0.95, -1.25, -0.8])
    assert abs(severity_of(block, worst) - 0.75) <= 1e-12


@pytest.mark.parametrize("value", [math.nan, INF, -INF])
def test_an_input_that_is_no_number(value):
    """An infinite signal is at its limit; nan is ignored, and the others count."""
    block = cp.create_time_scaling_iosystem(ONE, limits={"a": (-1, 1), "b": (-1, 1)}, bandwidth=1.0)
    wanted = 0.0 if math.isnan(value) else 1.0
    assert severity_of(block, [value, 0.0]) == wanted
    assert severity_of(block, [0.0, value]) == wanted
    if math.isnan(value):
        assert abs(severity_of(block, [value, 0.9]) - 0.5) <= 1e-14
        assert abs(severity_of(block, [0.9, value]) - 0.5) <= 1e-14


@pytest.mark.parametrize("cause", [{"errors": {"x": (0.1, 0.5)}}, {"limits": {"x": (-2, 2)}}], ids=["errors", "limits"])
@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_sensor_that_outputs_nan_for_a_while_does_not_end_the_run(method, cause):
    """The measurement is nan from 1 s to 2 s: the rate is 1, and the run reaches its end."""
    plan = rest((0, 0), (4, 1), labels=["x"])
    scaling = cp.create_time_scaling_iosystem(plan, 1, suffix="_ref", bandwidth=5.0, **cause)
    sensor = ct.nlsys(
        None,
        lambda t, x, u, params: np.array([np.where((t >= 1.0) * (t < 2.0), np.nan, u[0])]),
        inputs=["x_ref"],
        outputs=["x"],
        name="sensor",
    )
    cp.declare(sensor, breakpoints=np.array([1.0, 2.0]))
    loop = ct.interconnect([scaling, sensor], inputs=0, outputs=["x_ref", "x_ref_d1", "x"])
    t = np.linspace(0, 6, 61)
    found = cp.simulate(loop, t, method=method)
    assert found.time[-1] == 6.0
    assert np.isnan(np.asarray(found.outputs)[2, 15])
    wanted = plan.jet(t, 1)[:, 0]
    assert np.abs(np.asarray(found.outputs)[:2] - wanted).max() <= 1e-9


# In a loop whose actuator saturates


PLAN = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(3.0, 4.0, 0, 0)], labels=["x"])
"""4 m in 2.5 s from rest to rest: at 3 m/s at the most."""
DAMPING, MAXIMUM = 4.0, 9.0
"""At 3 m/s the damping force is 12 N."""
GAINS = (64.0, 32.0, 16.0, 0.02)
LOOP_TIMES = np.linspace(0.0, 12.0, 241)


def saturating(source, gains=GAINS, maximum=MAXIMUM, damping=DAMPING):
    """Unit mass under a PID whose force is limited; x_ref to x."""
    pid = cp.create_pid_iosystem(*gains, limits=(-maximum, maximum), inputs=("x_ref", "x"), outputs="F", name="pid")
    mass = ct.ss([[0, 1], [0, -damping]], [[0], [1]], [[1, 0]], 0, inputs=["F"], outputs=["x"], name="mass")
    return ct.interconnect([source, pid, mass], inputs=0, outputs=["x", "x_ref", "F"])


CLOCKS = {
    "errors": {"errors": {"x": (0.02, 0.2)}, "bandwidth": 8.0},
    "limits": {"limits": {"F": (-MAXIMUM, MAXIMUM)}, "margin": 0.2, "bandwidth": 8.0},
    "both": {"errors": {"x": (0.02, 0.2)}, "limits": {"F": (-MAXIMUM, MAXIMUM)}, "bandwidth": 8.0},
}


def by_hand(name, t):
    """The same loop from its equations: time scaling, PID with back calculation, mass."""
    chosen = CLOCKS[name]
    w, horizon = chosen["bandwidth"], 4.0 / chosen["bandwidth"]
    rise = Polynomial([0, 0, 0, 10, -15, 6])
    kp, ki, kd, tf = GAINS
    back = math.sqrt(ki / kd)

    def signals(moment, y):
        lag, _, integral, filtered, x, _ = y
        ref = 4.0 * rise(min(max((moment - lag - 0.5) / 2.5, 0.0), 1.0))
        requested = kp * (ref - x) + integral + kd * (ref - x - filtered) / tf
        return ref, requested, min(max(requested, -MAXIMUM), MAXIMUM)

    def rate(moment, y):
        lag, slow, _, filtered, x, v = y
        ref, requested, force = signals(moment, y)
        severity = 0.0
        if "errors" in chosen:
            severity = max(severity, (abs(x - ref) - 0.02) / 0.18)
        if "limits" in chosen:
            severity = max(severity, 1 - (MAXIMUM - abs(force)) / (chosen.get("margin", 0.1) * 2 * MAXIMUM))
        rho = 0.1 + (1 - min(severity, 1.0)) * (min(1.1, 1 + lag / horizon) - 0.1)
        return [
            slow,
            w * (1 - rho - slow),
            ki * (ref - x) + back * (force - requested),
            (ref - x - filtered) / tf,
            v,
            force - DAMPING * v,
        ]

    run = solve_ivp(rate, (t[0], t[-1]), np.zeros(6), method="LSODA", t_eval=t, rtol=1e-10, atol=1e-11, max_step=0.02)
    assert run.success
    seen = np.array([signals(*pair) for pair in zip(t, run.y.T, strict=True)])
    return run.y[0], run.y[4], seen[:, 0], seen[:, 2]


@pytest.fixture(scope="module")
def saturated():
    """Response of the loop with a time scaling by a method; "plain" stands for none."""

    @cache
    def run(name, method="auto"):
        if name == "plain":
            return cp.simulate(saturating(cp.create_source_iosystem(PLAN, suffix="_ref")), LOOP_TIMES)
        scaling = cp.create_time_scaling_iosystem(PLAN, 0, suffix="_ref", **CLOCKS[name])
        return cp.simulate(saturating(scaling), LOOP_TIMES, method=method, rtol=1e-9, atol=1e-11)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", CLOCKS)
def test_a_saturating_loop_against_its_equations_by_hand(saturated, name, method):
    found = saturated(name, method)
    lag, x, ref, _ = by_hand(name, LOOP_TIMES)
    assert found.method == method
    outputs = np.asarray(found.outputs)
    assert np.abs(outputs[0] - x).max() <= 1e-6
    assert np.abs(outputs[1] - ref).max() <= 1e-6
    assert np.abs(np.asarray(found.states)[0] - lag).max() <= 1e-6
    assert lag.max() > 0.1


@pytest.mark.parametrize("name", CLOCKS)
def test_a_slowed_time_scaling_spares_a_saturating_loop_most_of_its_tracking_error(saturated, name):
    plain, found = (np.asarray(saturated(*key).outputs) for key in (("plain",), (name, "compiled")))
    assert np.abs(plain[2]).max() == pytest.approx(MAXIMUM, abs=1e-9)  # the plan requires too much force
    assert np.abs(plain[1] - plain[0]).max() > 0.5
    assert np.abs(found[1] - found[0]).max() < 0.2 * np.abs(plain[1] - plain[0]).max()
    assert abs(found[0, -1] - 4.0) <= 1e-3


def test_a_free_mass_that_saturates_in_braking_is_spared_error_and_overshoot():
    """Acceleration of 10/sqrt 3 times 4/2.5^2 = 3.7 m/s^2 at 2.5 N; slowed down by errors, default bandwidth."""
    free = {"gains": (16.0, 8.0, 8.0, 0.02), "maximum": 2.5, "damping": 0.0}
    scaling = cp.create_time_scaling_iosystem(PLAN, 0, errors={"x": (0.02, 0.2)}, suffix="_ref")
    sources = (cp.create_source_iosystem(PLAN, suffix="_ref"), scaling)
    plain, found = (np.asarray(cp.simulate(saturating(s, **free), LOOP_TIMES).outputs) for s in sources)
    assert np.abs(found[1] - found[0]).max() < 0.8 * np.abs(plain[1] - plain[0]).max()
    assert found[0].max() - 4.0 < 0.8 * (plain[0].max() - 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*(pytest.param(k, marks=pytest.mark.slow) for k in ("errors", "limits")), "both"])
def test_python_and_compiled_agree(saturated, name):
    first, second = (np.asarray(saturated(name, method).outputs) for method in METHODS)
    assert np.abs(first - second).max() <= 1e-6 * np.abs(first).max()
