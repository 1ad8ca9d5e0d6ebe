"""Discrete systems: the response by python-control to the samples of the plan."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

DT = 0.1
T = DT * np.arange(41)
PLAN = cp.TrigSpline([cp.Waypoint(0.45, 0, 0, 0), cp.Waypoint(2.3, 1, 0, 0)], alpha=1.0, labels=["r"])
TWO = cp.stack([PLAN, cp.Step(-1.0, time=1.0)], labels=["a", "b"])


def recursion(rate, out, samples, initial):
    x, states, outputs = np.asarray(initial, dtype=float), [], []
    for u in samples.T:
        states.append(x)
        outputs.append(out(x, u))
        x = rate(x, u)
    return np.array(outputs).T, np.array(states).T


@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_linear_recursion(method):
    a, b = np.array([[0.9, 0.2], [-0.3, 0.7]]), np.array([[0.1, 0.0], [0.4, 1.0]])
    c, d = np.array([[1.0, 0.0], [1.0, -1.0]]), np.array([[0.0, 0.5], [0.0, 0.0]])
    found = cp.simulate(ct.ss(a, b, c, d, DT), T, TWO, [1.0, -0.5], method=method)
    outputs, states = recursion(lambda x, u: a @ x + b @ u, lambda x, u: c @ x + d @ u, TWO(T), [1.0, -0.5])
    assert np.abs(found.outputs - outputs).max() <= 1e-13
    assert np.abs(found.states - states).max() <= 1e-13
    assert np.array_equal(found.inputs, TWO(T))
    assert found.method == "python"


def test_a_logistic_recursion_with_params():
    logistic = ct.nlsys(
        lambda t, x, u, p: p["r"] * x * (1 - x) + 0.01 * u,
        None,
        inputs=1,
        outputs=1,
        states=1,
        params={"r": 2.0},
        dt=DT,
    )
    for r in (2.0, 2.9):
        found = cp.simulate(logistic, T, PLAN, 0.3, params={"r": r} if r != 2.0 else None)
        states = recursion(lambda x, u, r=r: r * x * (1 - x) + 0.01 * u, lambda x, u: x, PLAN(T)[None], [0.3])[1]
        assert np.abs(found.states - states).max() <= 1e-12


def test_a_plan_inside_a_discrete_loop():
    held = ct.ss(0.5, 1.0, 1.0, 0.0, DT, inputs="r", outputs="y", name="held")
    loop = ct.interconnect([cp.create_source_iosystem(PLAN), held], inputs=0, outputs=["y"], name="driven")
    found = cp.simulate(loop, T, initial_state=0.25)
    states = recursion(lambda x, u: 0.5 * x + u, lambda x, u: x, PLAN(T)[None], [0.25])[1]
    assert np.abs(found.states - states).max() <= 1e-14
    assert np.abs(found.outputs - states).max() <= 1e-14


def test_samples_numbers_and_names():
    system = ct.ss(0.5, [[1.0, 2.0]], 1.0, 0.0, DT, inputs=["r", "d"], outputs="y")
    samples = np.sin(T)
    found = cp.simulate(system, T, {"d": 0.1, "r": samples})
    states = recursion(lambda x, u: 0.5 * x + u[0] + 2 * u[1], lambda x, u: x, np.array([samples, 0.1 + 0 * T]), [0.0])[
        1
    ]
    assert np.abs(found.states - states).max() <= 1e-14


def test_equal_to_the_peer():
    system = ct.ss(0.5, 1.0, 1.0, 0.0, DT)
    assert np.array_equal(cp.simulate(system, T, PLAN).outputs, ct.input_output_response(system, T, PLAN(T)).outputs)


def test_a_static_discrete_block():
    found = cp.simulate(ct.ss([], [], [], [[2.0]], DT), T, PLAN)
    assert np.abs(found.outputs - 2 * PLAN(T)).max() <= 1e-15


def test_the_exact_method_is_for_continuous_systems():
    with pytest.raises(ValueError, match=r'method "exact".*discrete \(dt = 0.1\)'):
        cp.simulate(ct.ss(0.5, 1.0, 1.0, 0.0, DT, name="held"), T, PLAN, method="exact")


# Unspecified sampling time, and sample times


def halving(dt, **names):
    return ct.ss(0.5, 1.0, 1.0, 0.0, dt, **names)


@pytest.mark.parametrize("spacing", [2.0, 1.0, 0.1, 1e-6, 1e9])
@pytest.mark.parametrize("first", [0.0, -3.0, 1e6])
def test_an_unspecified_sampling_time_is_one_step_a_sample(spacing, first):
    t = first + spacing * np.arange(9)
    for inputs in (1.0, np.sin(np.arange(9.0)), cp.Step(1.0, time=t[3])):
        samples = inputs(t) if isinstance(inputs, cp.Step) else inputs + np.zeros(9)
        states = recursion(lambda x, u: 0.5 * x + u, lambda x, u: x, samples[None], [0.25])[1]
        found = cp.simulate(halving(True), t, inputs, 0.25)
        assert np.abs(found.outputs - states[0]).max() <= 1e-15 * 4
        assert np.array_equal(found.time, t)
        assert np.array_equal(found.inputs, samples)
        if isinstance(inputs, np.ndarray) and not first:  # elsewhere the peer rounds its samples
            assert np.abs(found.outputs - ct.forced_response(halving(True), t, inputs, 0.25).outputs).max() <= 1e-14


def test_nonlinear_static_and_joined_systems_without_a_sampling_time():
    t = 5.0 * np.arange(6)
    bent = ct.nlsys(lambda t, x, u, p: 0.5 * np.sin(x) + u, None, inputs="u", outputs="y", states=1, dt=True, name="b")
    states = recursion(lambda x, u: 0.5 * np.sin(x) + u, lambda x, u: x, np.ones((1, 6)), [0.0])[1]
    assert np.abs(cp.simulate(bent, t, 1.0).outputs - states[0]).max() <= 1e-15
    square = ct.nlsys(None, lambda t, x, u, p: u**2, inputs="y", outputs="z", dt=True, name="square")
    assert (cp.simulate(square, t, 3.0).outputs == 9.0).all()
    joined = ct.interconnect([bent, square], inputs="u", outputs="z")
    assert joined.dt is True
    assert np.abs(cp.simulate(joined, t, 1.0).outputs - states[0] ** 2).max() <= 1e-14
    # A sampling time of 1 s is one: two steps in 2 s.
    assert cp.simulate(halving(1.0), [0.0, 2.0, 4.0], 1.0).outputs.tolist() == [0.0, 1.5, 1.875]


def test_uneven_times_without_a_sampling_time():
    for t in ([0.0, 1.0, 3.0], [0.0, 1.0, 2.001], 1e3 + np.arange(9.0) ** 1.01):
        with pytest.raises(ValueError, match=r"timepts must be evenly spaced .*\(dt = True\), got spacings from"):
            cp.simulate(halving(True), t, 1.0)


def test_no_timebase():
    t = np.linspace(0.0, 2.0, 5)
    # Without states continuous and discrete systems do not differ.
    assert (cp.simulate(ct.ss([], [], [], 2.0, None), t, 1.0).outputs == 2.0).all()
    bent = ct.nlsys(None, lambda t, x, u, p: u**2, inputs=1, outputs=1, dt=None)
    assert (cp.simulate(bent, t, 3.0).outputs == 9.0).all()
    with pytest.warns(
        UserWarning, match=r"lag has states and no timebase \(dt = None\): it is simulated as continuous-time"
    ):
        found = cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0, None, name="lag"), t, 1.0)
    assert np.abs(found.outputs + np.expm1(-t)).max() <= 1e-15
    # Joined with others it has theirs.
    for dt in (0.5, True):
        gain = ct.ss([], [], [], 1.0, dt, inputs="r", outputs="u", name="gain")
        lag = halving(None, inputs="u", outputs="y", name="lag")
        loop = ct.interconnect([gain, lag], inputs="r", outputs="y")
        assert cp.simulate(loop, t, 1.0).outputs.tolist() == [0.0, 1.0, 1.5, 1.75, 1.875]


@pytest.mark.parametrize("dt", [0.1, 1 / 3, 1e-3, 0.7e-3, 1 / 44100])
@pytest.mark.parametrize(("first", "count"), [(0.0, 1000), (-7.0, 1000), (1e5, 10_000)])
def test_every_instant_of_a_long_clock_is_a_step(dt, first, count):
    counter = ct.ss(1.0, 1.0, 1.0, 0.0, dt)
    for t in (first + dt * np.arange(count), np.linspace(first, first + dt * (count - 1), count)):
        assert np.array_equal(cp.simulate(counter, t, 1.0).outputs, np.arange(count))
        assert np.array_equal(cp.simulate(counter, t[::7], 1.0).outputs, np.arange(count)[::7])


def test_single_precision_times_are_instants():
    t = np.arange(0.0, 10.0, 0.1, dtype=np.float32)
    assert np.array_equal(cp.simulate(ct.ss(1.0, 1.0, 1.0, 0.0, 0.1), t, 1.0).outputs, np.arange(100))


@pytest.mark.parametrize(
    ("dt", "times", "match"),
    [
        (0.1, [0.0, 0.1, 0.25], "whole periods of 0.1 s apart in a discrete system, got 0.25 s, 0.5 periods off"),
        (0.1, 0.1001 * np.arange(11), "whole periods of 0.1 s apart"),
        (0.1, 0.02 * np.arange(6), "whole periods of 0.1 s apart"),
        (0.1, [0.0, 1e-9, 0.1], "at least a period of 0.1 s apart"),
        (1e-3, 1e13 + np.arange(4.0), "resolve sample times 0.001 s apart, got times up to 1e"),
        (1e-3, [0.0, 1e9], "span at most 1e.08 periods of a discrete system, got 1e.12"),
    ],
)
def test_times_that_are_no_instants(dt, times, match):
    with pytest.raises(ValueError, match=f"timepts must .*{match}"):
        cp.simulate(halving(dt), times, 1.0)


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.7, 1e-3])
def test_a_step_at_an_instant_is_seen_there(dt):
    """k dt in doubles is often not the k-th instant that a user writes."""
    per_second = {0.01: (100, 1), 0.1: (10, 1), 0.7: (10, 7), 1e-3: (1000, 1)}[dt]
    t = dt * np.arange(1001)
    sums = ct.ss(1.0, 1.0, 1.0, 0.0, dt)
    instants = [(k, k * per_second[1] / per_second[0]) for k in range(1, 1000)]
    apart = [(k, instant) for k, instant in instants if instant != t[k]]
    for k, instant in [*apart[:6], *apart[-6:], instants[0], instants[-1]]:
        found = cp.simulate(sums, t, cp.Step(1.0, time=instant))
        assert np.array_equal(found.outputs, np.maximum(0.0, np.arange(1001) - k))
        assert np.array_equal(found.inputs, np.where(np.arange(1001) >= k, 1.0, 0.0))
