"""The exact method compared with closed forms in 250 digits: plans of every kind, and various loops."""

from functools import cache
from itertools import pairwise

import control as ct
import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import solve_ivp
from simulation_oracle import both, gap, lag_loop, response, spline, step

import ctrlplan as cp

ALPHAS = [0.0, 1e-9, 1e-4, 1.0, 5.0]
SMALL = 1e-11
"""Error bound, relative to the largest value of each signal."""


def random_axes(rng, counts, pace):
    """Jets with `counts[axis][i]` entries at waypoint i, each of the size that belongs to a move in `pace` seconds."""
    return [[(rng.normal(size=k) / pace ** np.arange(k)).tolist() for k in axis] for axis in counts]


def random_system(rng, nstates, ninputs, stable=True):
    a = rng.normal(size=(nstates, nstates)) * 10.0 ** rng.uniform(-0.5, 1)
    if stable:
        a -= (np.linalg.eigvals(a).real.max() + rng.uniform(0.1, 1)) * np.eye(nstates)
    return a, rng.normal(size=(nstates, ninputs)), rng.normal(size=(2, nstates)), rng.normal(size=(2, ninputs))


def odd_times(rng, first, last, marks, count=25):
    """Sample times of no regular spacing, some of them at breakpoints, one a rounding after another."""
    t = np.concatenate([[first, last], rng.uniform(first, last, count), np.asarray(marks)[1:]])
    return np.unique(np.append(t, np.nextafter(t[2], np.inf)))


def check(matrices, plan, signals, times, initial=None, tolerance=SMALL):
    found = cp.simulate(ct.ss(*matrices), times, plan, 0.0 if initial is None else initial, method="exact")
    outputs, states = response(*matrices, signals, times, initial)
    assert gap(found.states, states) <= tolerance
    assert gap(found.outputs, outputs) <= tolerance


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("alpha", ALPHAS)
def test_random_plans_on_random_systems(alpha, seed):
    rng = np.random.default_rng([seed, int(1e4 * alpha)])
    naxes, nstates, npoints = rng.integers(1, 4), rng.integers(1, 6), rng.integers(2, 5)
    pace = 10.0 ** rng.uniform(-1, 1)
    times = rng.normal() + pace * np.cumsum(rng.uniform(0.3, 1.0, npoints))
    plan, signals = both(times, random_axes(rng, rng.integers(1, 4, (naxes, npoints)), pace), alpha)
    # Every other run begins in the middle of the plan; the rest wait for it.
    first = times[0] + (-0.7 * pace if seed % 2 else 0.4 * (times[-1] - times[0]))
    sampled = odd_times(rng, first, times[-1] + pace, times[times > first] if not seed % 2 else times)
    system = random_system(rng, nstates, naxes)
    check(system, plan, signals, sampled, rng.normal(size=nstates))


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 1e-2, 1.0, 4.0])
@pytest.mark.parametrize(("npoints", "nentries"), [(4, 3), (6, 2), (8, 3), (12, 2)])
def test_many_constraints(npoints, nentries, alpha):
    # One analytic segment with as many turns as waypoints: a Taylor series about one point cancels at the others.
    rng = np.random.default_rng(npoints)
    times = np.linspace(0.0, 16.0, npoints) + np.append(0.0, rng.uniform(-0.3, 0.3, npoints - 1))
    axes = [[[x, *rng.uniform(-0.2, 0.2, nentries - 1)] for x in rng.uniform(0, 5, npoints)]]
    plan, signals = both(times, axes, alpha)
    check(lag_loop(5.0), plan, signals, np.linspace(0.0, 20.0, 83))


@pytest.mark.slow
def test_the_obstacle_plan_of_simulation_3():
    x = [[0.0, 0.0, 0.0], [5.0, 1.0, 0.1], [15.0, 2.0, 0.1], [20.0, 0.0, 0.0]]
    z = [[10.0, 0.0, 0.0], [5.0, -1.0, -0.15], [5.0, 1.0, 1.0], [11.0, 0.0, 0.0]]
    rng = np.random.default_rng(4)
    for alpha in (0.0, 1.0, 4.0):
        plan, signals = both([0.0, 6.0, 11.0, 16.0], [x, z], alpha)
        check(random_system(rng, 4, 2), plan, signals, np.linspace(0.0, 30.0, 91))


MOVE = ([0.4, 1.1, 2.7], [[[0.0, 0.0, 0.0], [1.0, -0.3], [0.5, 0.0, 0.0]]])
REST = ([0.4, 1.7], [[[0.5, 0.0, 0.0], [2.0, 0.0, 0.0]]])
SPEED = ([-0.2, 0.9, 2.0], [[[0.0], [0.3, 2.0, -1.0], [-1.0, 4.0, 3.0]]])
BACK = ([-1.0, -0.3], [[[2.0, 0.3], [0.5, -1.0]]])
FULL = ([0.3, 1.0, 1.6, 2.9], [[[0.0, 1.0], [1.0, -1.0], [0.2, 0.5], [2.0, 1.0]]])


@cache
def kinds(alpha):
    move, (m,) = both(*MOVE, alpha)
    rest, (r,) = both(*REST, alpha)
    speed, (s,) = both(*SPEED, alpha)
    segments, (p,) = both(*FULL, alpha, each_segment=True)
    back, (b,) = both(*BACK, alpha)
    late = r.shift(3.25)
    return {
        "late": (rest.shift(3.25), [late]),
        "ends at speed": (speed, [s]),
        "piecewise": (segments, [p]),
        "retimed": (cp.trajectory_from_dict(rest.to_dict()).retime(2.6), both([0.4, 3.0], REST[1], alpha)[1]),
        "sum": (move + rest, [m + r]),
        "sum with a step": (speed + cp.Step(-0.5, 0.25, time=1.3), [s + step(-0.5, 0.25, 1.3)]),
        "difference of a multiple": (move - 0.75 * speed, [m + (-0.75) * s]),
        "join": (move.then(rest).then(back), [m.then(r).then(b)]),
        "joined segments": (segments.then(back.shift(7.0)), [p.then(b)]),
        "sum of joins": (move.then(rest) + segments.then(back), [m.then(r) + p.then(b)]),
        "stack": (cp.stack([move, segments, speed], labels=["a", "b", "c"]), [m, p, s]),
        "stack with a step": (cp.stack([rest, cp.Step(1.0, time=0.77)], ["a", "b"]), [r, step(1.0, 0.0, 0.77)]),
    }  # fmt: skip


@pytest.mark.parametrize("alpha", ALPHAS[::2])
@pytest.mark.parametrize("kind", sorted(kinds(1.0)))
def test_plans_of_every_kind(kind, alpha):
    rng = np.random.default_rng(11)
    plan, signals = kinds(alpha)[kind]
    system = random_system(rng, 3, len(signals))
    check(system, plan, signals, odd_times(rng, -1.0, 7.0, plan.breakpoints), [0.5, -1.0, 2.0])


@pytest.mark.parametrize("alpha", [0.0, 1e-9, 1.0])
@pytest.mark.parametrize("gain", [1e-3, 0.1, 0.25, 0.26, 1.0, 5.0, 1e3, 1e4, 1e6])
def test_the_integrator_lag_loop_at_every_gain(gain, alpha):
    rng = np.random.default_rng(3)
    plan, signals = both(*MOVE, alpha)
    loop = cp.plants.integrator_lag_loop(gain, outputs=("y", "u", "e"))
    times = odd_times(rng, 0.0, 9.0, plan.breakpoints)
    found = cp.simulate(loop, times, plan, [0.3, -0.2], method="exact")
    outputs, states = response(*lag_loop(gain), signals, times, [0.3, -0.2])
    assert gap(found.states, states) <= SMALL
    assert gap(found.outputs, outputs) <= SMALL


def test_the_double_pole_in_closed_form():
    # At k = 1/4 both poles are -1/2: y = 1 - (1 + t/2) exp(-t/2).
    t = np.linspace(0.0, 40.0, 401)
    found = cp.simulate(cp.plants.integrator_lag_loop(0.25), t, cp.Step(1.0), method="exact")
    assert np.abs(found.outputs - (1 - (1 + t / 2) * np.exp(-t / 2))).max() <= 1e-12


@pytest.mark.parametrize("gain", [1e-3, 0.1, 0.24999, 0.25001, 0.3, 1.0, 5.0, 20.0, 100.0, 1000.0])
def test_the_step_response_in_closed_form(gain):
    """Equation (1) corrected: y = 1 - (w_n/w_p) exp(-xi w_n t) sin(w_p t + arccos xi)."""
    t = np.concatenate([np.linspace(0.0, 15.0, 1501), [15.1, 20.0, 33.3]])
    with mp.workdps(50):
        natural, damping = mp.sqrt(mp.mpf(gain)), 1 / (2 * mp.sqrt(mp.mpf(gain)))
        proper = natural * mp.sqrt(1 - damping**2)  # imaginary below 1/4: the same formula holds

        def y(t):
            return 1 - natural / proper * mp.exp(-damping * natural * t) * mp.sin(proper * t + mp.acos(damping))

        exact = np.array([float(mp.re(y(mp.mpf(x)))) for x in t])
    found = cp.simulate(cp.plants.integrator_lag_loop(gain), t, cp.Step(1.0), method="exact")
    assert np.abs(found.outputs - exact).max() <= 1e-12


@pytest.mark.parametrize("jump", [0.0, 0.123, 2.0])
def test_a_step_later_and_from_another_level(jump):
    # At rest at -1/2 until the jump; from then on the step response, of height 2.
    t = np.union1d(np.linspace(0.0, 9.0, 100), jump)
    plan = cp.Step(1.5, initial=-0.5, time=jump)
    found = cp.simulate(cp.plants.integrator_lag_loop(5.0, ["y", "u"]), t, plan, [0.0, -0.5], method="exact")
    w = np.sqrt(4.75)
    s = np.maximum(t - jump, 0.0)
    y = -0.5 + 2 * (1 - np.exp(-s / 2) * (np.cos(w * s) + np.sin(w * s) / (2 * w)))
    assert np.abs(found.outputs[0] - y).max() <= 1e-12
    assert np.abs(found.outputs[1] - 5 * (np.where(t >= jump, 1.5, -0.5) - y)).max() <= 1e-11


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("gain", [-0.5, -2.0, -40.0])
def test_unstable_loops(gain, alpha):
    plan, signals = both(*MOVE, alpha)
    check(lag_loop(gain), plan, signals, odd_times(np.random.default_rng(9), 0.0, 20.0, plan.breakpoints))


def test_an_unstable_loop_that_leaves_the_range_of_numbers():
    t = np.linspace(0.0, 20.0, 41)
    found = cp.simulate(ct.ss(100.0, 1.0, 1.0, 0.0), t, cp.Step(1.0), method="exact").outputs
    inside = t <= 7.0
    assert np.abs(found[inside][1:] / (np.expm1(100 * t[inside][1:]) / 100) - 1).max() <= 1e-11
    assert np.all(found[t >= 7.5] == np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e3, 1e4, 1e6])
@pytest.mark.parametrize("duration", [1.0, 10.0, 100.0])
def test_a_slow_mode_next_to_a_fast_one(stiffness, duration):
    """A fast actuator before a slow plant: the fast mode must not reduce the accuracy of the slow one."""
    rng = np.random.default_rng(8)
    for slow in (1.0, 0.3, 0.03, 1e-3):
        matrices = [[-stiffness, 0.0], [slow, -slow]], [[stiffness], [0.0]], [[0.0, 1.0]], [[0.0]]
        times = odd_times(rng, 0.0, duration, [0.0])
        check(matrices, cp.Step(1.0), [step(1.0)], times)
        move = ([0.1 * duration, 0.3 * duration], REST[1])
        plan, signals = both(*move, 1.0)
        check(matrices, plan, signals, times)


def test_an_undamped_oscillator_driven_at_its_own_frequency():
    # r = (1 - cos w t)/2 over whole turns is the trigonometric spline of these jets: x'' + w^2 x = r resonates.
    turns, w = 0.75, 2.0
    duration = turns * 2 * np.pi / w
    points = [
        cp.Waypoint(x, (1 - np.cos(w * x)) / 2, w * np.sin(w * x) / 2 if given else None)
        for x, given in ((0.0, True), (duration / 3, False), (duration, True))
    ]
    plan = cp.TrigSpline(points, alpha=w * duration, warn=False)
    t = np.linspace(0.0, duration, 37)
    assert np.abs(plan(t) - (1 - np.cos(w * t)) / 2).max() <= 1e-13
    found = cp.simulate(ct.ss([[0, 1], [-(w**2), 0]], [[0], [1]], [[1, 0]], 0), t, plan, method="exact")
    exact = (1 - np.cos(w * t)) / (2 * w**2) - t * np.sin(w * t) / (4 * w)
    assert np.abs(found.outputs - exact).max() <= 1e-12


def test_a_chain_of_integrators_gives_back_the_plan():
    # x''' = r''' from the plan's own start: no state is anything but the plan's jet.
    plan, _ = both([0.0, 1.0, 2.5], [[[0.0, 1.0, 2.0], [3.0, -1.0], [1.0, 0.5, 0.0]]], 2.0)
    source = cp.create_source_iosystem(plan, derivatives=3)
    chain = ct.ss(
        np.eye(3, k=1), [[0], [0], [1]], np.eye(3), np.zeros((3, 1)), inputs="axis0_d3", outputs=["p", "v", "a"]
    )
    loop = ct.interconnect([source, chain], inputs=0, outputs=["p", "v", "a"], warn_duplicate=False, ignore_outputs=[
        "axis0", "axis0_d1", "axis0_d2"
    ])  # fmt: skip
    t = np.linspace(0.0, 2.5, 61)
    found = cp.simulate(loop, t, initial_state=plan.jet(0.0, 2)[:, 0], method="exact")
    assert gap(found.states, plan.jet(t, 2)[:, 0]) <= 1e-12


@pytest.mark.parametrize("alpha", ALPHAS[::2])
def test_next_to_a_tight_numerical_integration(alpha):
    """An independent solution: DOP853 at 1e-13, restarted at each breakpoint."""
    move, _ = both(*MOVE, alpha)
    plan = cp.stack([move.shift(0.8), cp.Step(1.0, time=2.0) + move], labels=["a", "b"])
    a = np.array([[0.0, 1.0, 0.0], [-4.0, -0.6, 1.0], [0.3, 0.0, -2.0]])
    b = np.array([[0.0, 0.5], [1.0, 0.0], [0.0, 2.0]])
    t = np.unique(np.concatenate([[0.0], np.random.default_rng(2).uniform(0, 8, 50), [8.0]]))
    found = cp.simulate(ct.ss(a, b, np.eye(3), 0 * b), t, plan, [1.0, 0.0, -1.0], method="exact").outputs
    state, rows = np.array([1.0, 0.0, -1.0]), []
    edges = [0.0, *[x for x in plan.breakpoints if 0.0 < x < 8.0], 8.0]
    for left, right in pairwise(edges):
        inside = t[(t >= left) & (t < right)]

        def rate(x, y, left=left, right=right):
            return a @ y + b @ plan.jet(x, 0, left=x == right)[0]

        run = solve_ivp(
            rate, (left, right), state, "DOP853", t_eval=np.append(inside, right), rtol=3e-14, atol=1e-15, max_step=0.1
        )
        rows.append(run.y[:, : inside.size])
        state = run.y[:, -1]
    rows.append(state[:, None])
    assert gap(found, np.hstack(rows)) <= SMALL


# Properties of all plans and systems


@st.composite
def runs(draw):
    """Random system, plan of as many axes, odd sample times and an initial state."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    naxes, npoints = draw(st.integers(1, 3)), draw(st.integers(2, 3))
    times = np.cumsum(rng.uniform(0.3, 1.0, npoints))
    axes = random_axes(rng, rng.integers(1, 4, (naxes, npoints)), 0.5)
    points = [
        cp.Waypoint.from_jets(t, **{f"x{i}": axis[k] for i, axis in enumerate(axes)}) for k, t in enumerate(times)
    ]
    alpha = draw(st.one_of(st.sampled_from(ALPHAS), st.floats(1e-3, 5.5)))
    nstates = draw(st.integers(1, 5))
    sampled = np.unique(np.concatenate([[0.0, 4.0], rng.uniform(0, 4, 25)]))
    return (
        ct.ss(*random_system(rng, nstates, naxes)),
        cp.TrigSpline(points, alpha=alpha, warn=False),
        sampled,
        rng.normal(size=nstates),
    )


def close(found, other):
    scale = max(np.abs(other.outputs).max(), np.abs(other.states).max())
    assert np.abs(found.outputs - other.outputs).max() <= SMALL * scale
    assert np.abs(found.states - other.states).max() <= SMALL * scale


@examples(40)
@given(runs(), st.floats(-3, 3))
def test_responses_superpose(run, factor):
    system, plan, t, initial = run
    other = cp.Step(np.arange(1.0, plan.naxes + 1), time=1.234)
    apart = [cp.simulate(system, t, plan, initial), cp.simulate(system, t, other)]
    whole = cp.simulate(system, t, plan + factor * other, initial)
    scale = max(np.abs(r.outputs).max() for r in (*apart, whole))
    assert np.abs(whole.outputs - apart[0].outputs - factor * apart[1].outputs).max() <= SMALL * scale * (
        1 + abs(factor)
    )


@examples(40)
@given(runs(), st.data())
def test_a_run_can_be_taken_up_at_any_sample(run, data):
    system, plan, t, initial = run
    whole = cp.simulate(system, t, plan, initial)
    k = data.draw(st.integers(1, t.size - 2))
    rest = cp.simulate(system, t[k:], plan, whole.states[:, k])
    scale = np.abs(whole.states).max()
    assert np.abs(rest.states - whole.states[:, k:]).max() <= SMALL * scale
    assert np.abs(rest.states[:, 0] - whole.states[:, k]).max() == 0.0


@examples(40)
@given(runs(), st.integers(0, 3))
def test_a_sample_does_not_depend_on_the_others(run, seed):
    system, plan, t, initial = run
    more = np.unique(np.concatenate([t, np.random.default_rng(seed).uniform(0, 4, 500)]))
    dense = cp.simulate(system, more, plan, initial)
    where = np.searchsorted(more, t)
    sparse = cp.simulate(system, t, plan, initial)
    scale = np.abs(dense.states).max()
    assert np.abs(sparse.states - dense.states[:, where]).max() <= SMALL * scale


@examples(40)
@given(runs(), st.integers(-512, 512))
def test_the_clock_may_start_anywhere(run, eighths):
    # Times that stay exact under the shift, so that only the simulation's own rounding is left.
    system, plan, t, initial = run
    t = np.unique(np.round(t * 1024) / 1024)
    points = [cp.Waypoint(np.round(w.time * 1024) / 1024, *w.jet) for w in plan.waypoints]
    plan = cp.TrigSpline(points, alpha=plan.alpha, warn=False)
    dt = eighths / 8
    close(cp.simulate(system, t + dt, plan.shift(dt), initial), cp.simulate(system, t, plan, initial))


def test_two_samples_are_enough():
    plan, signals = both(*REST, 1.0)
    check(lag_loop(5.0), plan, signals, [0.9, 1.3], [0.5, 0.7])


def test_twenty_thousand_samples_at_once():
    plan, signals = both(*REST, 1.0)
    t = np.linspace(0.0, 20.0, 20_001)
    found = cp.simulate(cp.plants.integrator_lag_loop(5.0, ["y", "u", "e"]), t, plan, [0.0, 0.5], method="exact")
    some = np.concatenate([np.arange(0, 20_000, 397), [20_000]])
    outputs, states = response(*lag_loop(5.0), signals, t[some], [0.0, 0.5])
    assert gap(found.outputs[:, some], outputs) <= SMALL
    assert gap(found.states[:, some], states) <= SMALL


def test_an_hour_of_rest_costs_no_digit():
    # The initial state is propagated over one segment of 3600 s, and over another one after the end.
    plan, signals = both([3600.3, 3601.6], REST[1], 1.0)
    matrices = [[0.0, 1.0], [-9.0, -1e-4]], [[0.0], [9.0]], [[1.0, 0.0]], [[0.0]]
    t = np.concatenate([[0.0, 1800.0, 3600.0], np.linspace(3600.2, 3603.0, 15), [5000.0, 7200.0]])
    check(matrices, plan, signals, t, [1.0, 0.0])


def test_spline_oracle_meets_its_own_constraints():
    """The oracle itself: jets at the waypoints, and a constant before and after."""
    for alpha in (0.0, 1e-9, 1.0, 5.0):
        signal = spline(MOVE[0], MOVE[1][0], alpha)
        for nu in range(3):
            want = [jet[nu] for jet in MOVE[1][0] if len(jet) > nu]
            at = [t for t, jet in zip(MOVE[0], MOVE[1][0], strict=True) if len(jet) > nu]
            assert np.abs(signal(at) - want).max() <= 1e-15
            signal = signal.derivative()
    assert signal([0.0, 3.0]).tolist() == [0.0, 0.0]
