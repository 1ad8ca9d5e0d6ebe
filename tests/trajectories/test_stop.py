"""Stops and changes of velocity: ruckig, naive integration, closed forms, every kind of plan, and what is rejected."""

import itertools
import json
import math
import warnings

import numpy as np
import pytest
from natural import NaturalCubic

import ctrlplan as cp
from ctrlplan.trajectories import (
    Clipped,
    Joined,
    PiecewiseSpline,
    PolySpline,
    Retimed,
    SCurve,
    Shaper,
    Step,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
    trajectory_from_dict,
)
from ctrlplan.trajectories.velocity_change import fastest_velocity_change, slower_velocity_change

LIMITS = {"acceleration": 4.0, "jerk": 25.0}
POINTS = [
    Waypoint.from_jets(1.0, x=[0.0, 0.0, 0.0], z=[1.0, 0.0, 0.0]),
    Waypoint.from_jets(2.5, x=[2.0], z=[-1.0, 0.5, 0.0]),
    Waypoint.from_jets(4.0, x=[1.0, 0.0, 0.0], z=[3.0, 0.0, 0.0]),
]
BACK = [
    Waypoint.from_jets(0.0, x=[1.0, 0.0, 0.0], z=[3.0, 0.0, 0.0]),
    Waypoint.from_jets(2.0, x=[-1.0, 0.0, 0.0], z=[2.0, 0.0, 0.0]),
]
MOVE = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(4, 10, 0, 0)], labels="x")
SLOW = PolySpline([Waypoint(0.0, 1.0, 0.0), Waypoint(5.0, 4.0, 0.0)])
KINDS = {
    "polynomial": PolySpline(POINTS),
    "trigonometric": TrigSpline(POINTS, alpha=2.0),
    "piecewise": PiecewiseSpline(POINTS),
    "s-curve": SCurve([3.0, 1.0], velocity=1.5, acceleration=2.0, jerk=9.0, time=1.0),
    "trapezoid": Trapezoid([3.0, 1.0], velocity=1.5, acceleration=2.0, time=1.0),
    "sum": PolySpline(POINTS) + 0.3 * TrigSpline(POINTS, alpha=1.0).shift(0.2),
    "stacked": stack([PolySpline(POINTS).select("x"), SLOW], labels=["a", "b"]),
    "joined": PolySpline(POINTS).then(TrigSpline(BACK, alpha=1.0)),
    "retimed": Retimed(SLOW, Trapezoid(5.0, velocity=1.5, acceleration=1.0)),
    "shaped": Shaper.zvd(0.7, 0.05)(PolySpline(POINTS)),
    "cyclic": TrigSpline.cyclic(POINTS, 4.0, warn=False),
    "user-written": NaturalCubic(POINTS, labels=["x", "z"]),
    "stopped": MOVE.stop(1.5, {"acceleration": 3.0, "jerk": 10.0}),
}
every = pytest.mark.parametrize("plan", KINDS.values(), ids=KINDS)


def quiet(call, *args, **options):
    """The result of a call that may warn of an excess."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the limits of the stop are exceeded")
        return call(*args, **options)


def integrated(state, durations, jerks):
    """State after phases of constant jerk, one at a time, and the extreme accelerations."""
    p, v, a = state
    seen = [a]
    for d, j in zip(durations, jerks, strict=True):
        p, v, a = p + v * d + a * d * d / 2 + j * d**3 / 6, v + a * d + j * d * d / 2, a + j * d
        seen.append(a)
    return (p, v, a), (min(seen), max(seen))


# The closed form


def cases(count, seed):
    """Random velocity changes: speeds, limits and jerks over two decades, half of the starts up to 1.5 times beyond."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        v, v1 = rng.normal(size=2) * 10.0 ** rng.uniform(-1, 1)
        low, high, jerk = 10.0 ** rng.uniform(-1, 1, 3)
        a = rng.uniform(-1.5, 1.5) * rng.choice([low, high]) * (k % 11 > 0)
        yield v, a, (0.0 if k % 7 == 0 else v if k % 13 == 0 else v1), (-low, high), jerk


def check_velocity_changes(count, seed):
    ruckig = pytest.importorskip("ruckig")
    for v, a, v1, (low, high), jerk in cases(count, seed):
        given = ruckig.InputParameter(1)
        given.control_interface = ruckig.ControlInterface.Velocity
        given.current_velocity, given.current_acceleration, given.target_velocity = [v], [a], [v1]
        given.min_acceleration, given.max_acceleration, given.max_jerk = [low], [high], [jerk]
        peer = ruckig.Trajectory(1)
        ruckig.Ruckig(1).calculate(given, peer)
        found = fastest_velocity_change(v1 - v, a, (low, high), jerk)
        assert found.duration == pytest.approx(peer.duration, rel=1e-12, abs=1e-12)
        size = max(abs(v), abs(v1), a * a / jerk)
        changes = [found]
        for factor in (1.0, 1.0 + 1e-9, 1.3, 20.0):
            changes.append(slower_velocity_change(v1 - v, a, jerk, factor * found.duration))
            assert changes[-1].duration == pytest.approx(factor * found.duration, rel=1e-13, abs=1e-13)
        for change in changes:
            (_, reached, rest), seen = integrated((0.0, v, a), change.durations, change.jerks)
            assert abs(reached - v1) <= 1e-12 * size * max(1.0, change.duration / found.duration if a else 1.0)
            assert abs(rest) <= 1e-12 * max(-low, high, abs(a))
            assert min(low, a) * (1 + 1e-9) <= seen[0]
            assert seen[1] <= max(high, a) * (1 + 1e-9)
            assert all(abs(j) in (0.0, jerk) for j in change.jerks)


def test_durations_are_those_of_ruckig():
    check_velocity_changes(300, 1)


@pytest.mark.slow
def test_durations_of_many_cases_are_those_of_ruckig():
    check_velocity_changes(10_000, 2)


@pytest.mark.parametrize(
    ("state", "limits", "duration"),
    [
        ((1.0, 0.0), {"acceleration": 1.0, "jerk": 1.0}, 2.0),  # v/A + A/J
        ((1.0, 0.0), {"acceleration": 9.0, "jerk": 1.0}, 2.0),  # 2 sqrt(v/J)
        ((4.0, 0.0), {"acceleration": 1.0, "jerk": 1.0}, 5.0),
        ((0.5, -1.0), {"acceleration": 1.0, "jerk": 1.0}, 1.0),  # only the acceleration has to end
        ((4.0, 0.0), {"acceleration": (-1.0, 9.0), "jerk": 1.0}, 5.0),  # of a pair the side that brakes
        ((-4.0, 0.0), {"acceleration": (-9.0, 1.0), "jerk": 1.0}, 5.0),
        # From v, a = -2 beyond A = 1, J = 1: 1 s to -1 in which v falls by 1.5, then v/A + A/(2J).
        ((4.0, -2.0), {"acceleration": 1.0, "jerk": 1.0}, 1.0 + 2.5 + 0.5),
    ],
)
def test_durations_in_closed_form(state, limits, duration):
    plan = PolySpline([Waypoint(0.0, 1.0, *state), Waypoint(20.0, 2.0, 0.0, 0.0)], warn=False)
    stopped = quiet(plan.stop, 0.0, limits)
    assert stopped.duration == pytest.approx(duration, rel=1e-14)


# Every kind of plan


@every
@pytest.mark.parametrize("synchronize", ["time", None])
@pytest.mark.parametrize("share", [0.0, 0.21, 0.83, 1.0])
def test_the_plan_is_followed_then_stops(plan, synchronize, share):
    time = plan.start + share * plan.duration
    stopped = quiet(plan.stop, time, LIMITS, synchronize=synchronize)
    before = np.linspace(plan.start - 1.0, time, 37)[:-1]
    np.testing.assert_array_equal(stopped.jet(before, 4), plan.jet(before, 4))
    if stopped is plan:
        assert share == 1.0
        return
    np.testing.assert_allclose(stopped.jet(time, 4, left=True), plan.jet(time, 4, left=True), rtol=1e-14, atol=1e-14)
    # At the end at rest, exactly; nothing jumps from the beginning of the stop on.
    assert not stopped.jet([stopped.end], 2)[1:].any() or stopped.end == time
    jumps = [j for j in stopped.jumps(2) if j.time >= time and (j.time > plan.start or j.order)]
    assert jumps == [] or plan.end == time or isinstance(plan, Trapezoid | NaturalCubic)


@every
@pytest.mark.parametrize("synchronize", ["time", None])
def test_limits_hold_from_a_state_within_them(plan, synchronize):
    time = plan.start + 0.43 * plan.duration
    state = plan.jet(time, 2, left=True)
    limits = {"acceleration": (1.01 * np.abs(state[2]) + 0.5).tolist(), "jerk": 30.0}
    stopped = plan.stop(time, limits, synchronize=synchronize)
    t = np.linspace(time, stopped.end, 2_001)[1:]
    assert (np.abs(stopped.jet(t, 3)[2]).max(axis=1) <= np.array(limits["acceleration"]) * (1 + 1e-9)).all()
    assert np.abs(stopped.jet(t, 3)[3]).max() <= 30.0 * (1 + 1e-9)
    margins = cp.margins(Clipped(stopped, time, stopped.end), limits)
    assert margins.active.fraction >= -1e-9
    # The position is the integral of the velocity.
    for segment in range(stopped.breakpoints.size - 1):
        a, b = stopped.breakpoints[segment : segment + 2]
        nodes, weights = np.polynomial.legendre.leggauss(20)
        grown = 0.5 * (b - a) * stopped.jet(0.5 * (a + b) + 0.5 * (b - a) * nodes, 1)[1] @ weights
        change = np.diff(stopped.jet([a, b], 0, left=False)[0], axis=1)[:, 0]
        assert np.abs(change - grown).max() <= 1e-12 * (1.0 + np.abs(stopped.jet(a, 0)).max())


@every
@pytest.mark.parametrize("synchronize", ["time", None, "path"])
def test_a_stopped_plan_is_a_plan(plan, synchronize, tmp_path):
    """Saved, moved, retimed, selected and exported as any other."""
    if synchronize == "path" and plan not in (KINDS["piecewise"], KINDS["trigonometric"], KINDS["joined"]):
        return
    time = plan.start + 0.63 * plan.duration
    stopped = quiet(plan.stop, time, LIMITS, synchronize=synchronize)
    t = np.concatenate([np.linspace(stopped.start - 0.1, stopped.end + 0.1, 301), stopped.breakpoints])
    again = trajectory_from_dict(json.loads(json.dumps(stopped.to_dict())))
    assert again.to_dict() == stopped.to_dict()
    np.testing.assert_array_equal(again.jet(t, 4), stopped.jet(t, 4))
    inner = np.setdiff1d(t, stopped.breakpoints)
    size = np.abs(stopped.jet(t, 3)).max(axis=2, keepdims=True)
    assert (np.abs(stopped.shift(3.0).jet(inner + 3.0, 3) - stopped.jet(inner, 3)) <= 1e-11 * size).all()
    if plan is not KINDS["shaped"]:
        half = stopped.retime(2.0 * stopped.duration)
        moved = half.jet(stopped.start + 2.0 * (inner - stopped.start), 3) * 2.0 ** np.arange(4)[:, None, None]
        assert (np.abs(moved - stopped.jet(inner, 3)) <= 1e-10 * size).all()
    assert (
        np.abs(stopped.select(stopped.labels[0]).jet(t, 3)[:, 0] - stopped.jet(t, 3)[:, 0]) <= 1e-14 * size[:, 0]
    ).all()
    for ending in (".csv", ".ppoly.json") + ((".c",) if plan is KINDS["piecewise"] else ()):
        assert stopped.export(tmp_path / f"plan{ending}")
    assert stopped.labels == plan.labels
    assert type(stopped).__name__ in repr(stopped)


# Axes together, alone, and on the path


def test_axes_together_and_alone():
    plan = KINDS["piecewise"]
    limits = {"acceleration": [5.0, 8.0], "jerk": [40.0, 90.0]}
    together = quiet(plan.stop, 3.0, limits)
    alone = quiet(plan.stop, 3.0, limits, synchronize=None)
    state = plan.jet(3.0, 2)
    own = [
        fastest_velocity_change(-v, a, (-hi, hi), j).duration
        for v, a, hi, j in zip(state[1], state[2], (5.0, 8.0), (40.0, 90.0), strict=True)
    ]
    assert own[0] != pytest.approx(own[1], rel=0.05)
    assert together.end == alone.end == pytest.approx(3.0 + max(own), rel=1e-14)
    slow, fast = int(np.argmax(own)), int(np.argmin(own))
    early = 3.0 + own[fast]
    assert np.abs(alone.jet(early + 1e-6, 2)[1:, fast]).max() <= 1e-15
    assert abs(alone(early - 1e-3, 1)[fast]) > 0
    assert abs(together(early, 1)[fast]) > 1e-2
    t = np.linspace(3.0, 3.2, 9)
    np.testing.assert_allclose(together(t)[slow], alone(t)[slow], rtol=1e-14)
    # Together an axis does not accelerate more than alone.
    assert together.peak(2)[fast] <= alone.peak(2)[fast]


def on_path(stopped, plan, time):
    """Largest distance of points of a stop from the path of the plan."""
    path = plan(np.linspace(time, plan.end, 20_001))
    points = stopped(np.linspace(time, stopped.end, 60))
    return max(np.hypot(*(path - point[:, None])).min() for point in points.T)


@pytest.mark.parametrize("name", ["polynomial", "trigonometric", "piecewise", "sum", "joined", "stacked", "s-curve"])
@pytest.mark.parametrize("share", [0.1, 0.35, 0.9])
def test_a_stop_on_the_path(name, share):
    plan = KINDS[name]
    time = plan.start + share * plan.duration
    limits = {"acceleration": (3.0 * plan.peak(2)).tolist(), "jerk": (3.0 * plan.peak(3)).tolist()}
    stopped = plan.stop(time, limits, synchronize="path")
    assert time < stopped.end <= plan.end
    assert on_path(stopped, plan, time) <= 5e-4
    t = np.linspace(time, stopped.end, 5_001)[1:]
    jet = stopped.jet(t, 3)
    for nu, entry in ((2, "acceleration"), (3, "jerk")):
        assert (np.abs(jet[nu]).max(axis=1) <= np.array(limits[entry]) * (1 + 1e-9)).all()
    assert np.abs(stopped.jet(stopped.end, 1)[1]).max() <= 1e-12 * plan.peak(1).max()
    np.testing.assert_allclose(stopped.jet(time, 2), plan.jet(time, 2), rtol=1e-12, atol=1e-12)


def test_a_straight_line_is_stopped_as_fast_as_one_axis():
    """At constant velocity the path is the axis: the closed form is the best of the three-phase laws."""
    plan = PolySpline([Waypoint(0.0, [0.0, 0.0]), Waypoint(10.0, [30.0, -10.0])])
    for jerk, fraction in ((3.0, 0.0), (9.0, 0.5)):
        limits = {"acceleration": [3.0, 1.0], "jerk": [jerk, jerk]}
        # Of the time law: rate 1 to 0, with acceleration and jerk over speed.
        exact = fastest_velocity_change(-1.0, 0.0, (-1.0, 1.0), jerk / 3.0).duration
        assert exact == pytest.approx(2.0 * math.sqrt(3.0 / jerk) if not fraction else 1.0 + 3.0 / jerk, rel=1e-14)
        stopped = plan.stop(2.0, limits, synchronize="path")
        assert exact * (1 - 1e-9) <= stopped.end - 2.0 <= 1.01 * exact


def random_plans(count, seed):
    """Piecewise splines through four random points of two axes, with limits 1.2 to 4 times their peaks."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        times = np.cumsum(rng.uniform(0.6, 2.0, 4))
        points = [Waypoint(t, rng.normal(size=2)) for t in times.tolist()]
        points[0], points[-1] = (Waypoint(p.time, p.position, 0, 0) for p in (points[0], points[-1]))
        plan = PiecewiseSpline(points, warn=False)
        factor = rng.uniform(1.2, 4.0)
        limits = {"acceleration": (factor * plan.peak(2)).tolist(), "jerk": (factor * plan.peak(3)).tolist()}
        yield plan, float(rng.uniform(plan.start + 0.1, plan.end - 0.1)), limits


def shortest_by_search(plan, time, limits, below):
    """Shortest law of three phases without delay, from a grid of durations and fractions, below a given one."""
    for duration in np.arange(0.02, below - time, 0.01 * (below - time)):
        for fraction in np.linspace(0.0, 0.9, 10):
            ramp = 0.5 * duration * (1.0 - fraction)
            knots = np.array([0.0, ramp, duration - ramp, duration])
            jerk = 4.0 / (duration**2 * (1.0 - fraction**2))
            s = np.linspace(0.0, duration, 200)
            steps = np.array([-jerk, 0.0, jerk])
            law = [
                sum(
                    j * (np.clip(s - a, 0, None) ** n - np.clip(s - b, 0, None) ** n) / math.factorial(n)
                    for j, a, b in zip(steps, knots[:-1], knots[1:], strict=True)
                )
                for n in (3, 2, 1)
            ]
            third = steps[np.clip(np.searchsorted(knots, s, side="right") - 1, 0, 2)]
            rate, moved = 1.0 + law[1], time + s + law[0]
            if moved[-1] > plan.end:
                continue
            q = plan.jet(moved, 3)
            second = q[2] * rate**2 + q[1] * law[2]
            jerks = q[3] * rate**3 + 3.0 * q[2] * rate * law[2] + q[1] * third
            if (np.abs(second).max(axis=1) <= limits["acceleration"]).all() and (
                np.abs(jerks).max(axis=1) <= limits["jerk"]
            ).all():
                return duration
    return math.inf


def check_paths(count, seed):
    shares = []
    for plan, time, limits in random_plans(count, seed):
        stopped = plan.stop(time, limits, synchronize="path")
        margins = cp.margins(Clipped(stopped, time, stopped.end), limits)
        assert margins.active.fraction >= -1e-9
        assert stopped.end <= plan.end
        duration = stopped.end - time
        assert shortest_by_search(plan, time, limits, stopped.end) >= 0.98 * duration
        shares.append(duration / (plan.end - time))
    return shares


@pytest.mark.slow
def test_no_law_of_the_same_kind_is_shorter():
    check_paths(1, 5)


@pytest.mark.slow
def test_no_law_of_the_same_kind_is_shorter_for_many_plans():
    assert np.median(check_paths(6, 6)) < 0.7


@pytest.mark.slow
def test_the_path_ends_first():
    """Shortly before the end the plan itself is the stop; with slower limits what follows the end is rest."""
    time = MOVE.end - 0.05
    limits = {"acceleration": MOVE.peak(2).tolist(), "jerk": MOVE.peak(3).tolist()}
    stopped = MOVE.stop(time, limits, synchronize="path")
    assert stopped.end == MOVE.end
    assert stopped.final == MOVE.final
    slow = quiet(MOVE.stop, 3.0, {"acceleration": 4.0, "jerk": 3.0}, synchronize="path")
    assert slow.final <= MOVE.final
    assert slow.jet(slow.end, 1)[1] == pytest.approx(0.0, abs=1e-9)


def test_a_delay_ends_a_phase_of_maximum_jerk_first():
    """In the phase in which the acceleration falls the jerk is at its limit: no law of lower rate may begin there."""
    plan = SCurve(40.0, velocity=4.0, acceleration=2.0, jerk=2.0)
    limits = {"acceleration": 2.0, "jerk": 2.0}
    stopped = plan.stop(2.5, limits, synchronize="path")
    assert stopped.peak(3)[0] <= 2.0 * (1 + 1e-9)
    # The phase ends at 3 s; from 4 m/s the minimum is v/A + A/J = 3 s.
    assert 6.0 * (1 - 1e-9) <= stopped.end <= 6.1


# States beyond the limits


def test_an_excess_is_brought_back_and_reported():
    plan = PolySpline([Waypoint(0.0, 0.0, 4.0, -2.0), Waypoint(20.0, 2.0, 0.0, 0.0)], labels="x", warn=False)
    limits = {"acceleration": 1.0, "jerk": 1.0, "velocity": 3.0}
    with pytest.warns(UserWarning, match="the limits of the stop are exceeded") as caught:
        stopped = plan.stop(0.0, limits)
    said = sorted(str(w.message) for w in caught)
    assert len(said) == 2
    assert "x_d1 must be within ±3, got 4 at 0 s, 1 beyond; from the state at 0 s this is unavoidable" in said[0]
    assert "x_d2 must be within ±1, got -2 at 0 s, 1 beyond" in said[1]
    assert all(w.filename == __file__ for w in caught)
    t = np.linspace(0.0, 1.0, 11)[:-1]
    np.testing.assert_allclose(stopped(t, 2), -2.0 + t, atol=1e-14)  # with the maximum jerk


def test_the_unavoidable_peak_of_the_velocity():
    """v + a|a|/(2 J) = 2 + 9/8 with a = 3, J = 4."""
    plan = PolySpline([Waypoint(0.0, 0.0, 2.0, 3.0), Waypoint(5.0, 2.0, 0.0, 0.0)], labels="x", warn=False)
    with pytest.warns(UserWarning, match=r"x_d1 must be within ±3, got 3.125 at 0.75 s, 0.125 beyond"):
        plan.stop(0.0, {"acceleration": 5.0, "jerk": 4.0, "velocity": 3.0})
    plan.stop(0.0, {"acceleration": 5.0, "jerk": 4.0, "velocity": 3.2})


def test_a_position_limit_is_reported():
    with pytest.warns(UserWarning, match=r"x must be at most 7, got 7.7832 at 3.1875 s, 0.783 beyond"):
        MOVE.stop(2.0, {"acceleration": 5.0, "jerk": 20.0, "x": cp.Limits(high=7.0)})


@pytest.mark.slow
def test_a_stop_on_the_path_from_beyond_a_limit_warns():
    time = float(MOVE.extrema(2).time_min[0])
    with pytest.warns(UserWarning, match="x_d2 must be within ±2"):
        stopped = MOVE.stop(time, {"acceleration": 2.0, "jerk": 25.0}, synchronize="path")
    assert stopped.peak(2)[0] <= MOVE.peak(2)[0] * (1 + 1e-9)
    assert stopped.end <= MOVE.end


# Special times


def test_at_a_breakpoint_the_state_is_that_before_a_jump():
    plan = Trapezoid(3.0, velocity=1.0, acceleration=0.5)  # the acceleration jumps at 2 s from 0.5 to 0
    stopped = plan.stop(2.0, {"acceleration": 1.0, "jerk": 2.0})
    assert stopped.jet(2.0, 2)[2, 0] == pytest.approx(0.5, rel=1e-14)
    step = MOVE.then(Step(11.0, 10.0)).then(PolySpline([Waypoint(0, 11.0, 0.0), Waypoint(1.0, 12.0, 0.0)], labels="x"))
    still = step.stop(4.0, LIMITS)
    assert still.final == 10.0
    assert still.end == 4.0


def test_a_plan_at_rest_remains_so():
    dwell = MOVE.then(PolySpline([Waypoint(0, 10.0), Waypoint(1, 10.0)], labels="x")).then(MOVE + Step(10.0, 10.0))
    for time in (4.0, 4.5, 5.0):
        stopped = dwell.stop(time, LIMITS)
        assert (stopped.end, stopped.final) == (time, 10.0)
    for synchronize in ("time", None, "path"):
        assert MOVE.stop(4.0, LIMITS, synchronize=synchronize) is MOVE
        still = MOVE.stop(0.0, LIMITS, synchronize=synchronize)
        assert (still.start, still.end, still(1.0)) == (0.0, 0.0, 0.0)
    # The end of a trapezoid is rest: its acceleration ends there.
    plan = Trapezoid(3.0, velocity=1.0, acceleration=0.5)
    assert plan.stop(plan.end, LIMITS) is plan


def test_ends_in_motion():
    plan = PolySpline([Waypoint(1.0, 0.0, 3.0), Waypoint(2.0, 3.0, 3.0)])
    first, last = plan.stop(1.0, LIMITS), plan.stop(2.0, LIMITS)
    assert first.start == 1.0
    assert first.duration == last.end - 2.0 == pytest.approx(3.0 / 4.0 + 4.0 / 25.0, rel=1e-14)
    assert last(1.5) == plan(1.5)


def test_late_times_have_exact_ends():
    for time in (0.0, 1e3, 1e6):
        stopped = quiet(KINDS["piecewise"].shift(time).stop, time + 2.2, LIMITS)
        assert not stopped.jet(stopped.end, 2)[1:].any()
        tail = stopped.breakpoints[stopped.breakpoints >= time + 2.2][:-1]
        jump = np.abs(stopped.jet(tail, 2)[:, :, 1:] - stopped.jet(tail, 2, left=True)[:, :, 1:]).max()
        assert jump <= 1e-13


# To a velocity


def test_to_a_velocity_and_on():
    slow = MOVE.to_velocity(2.0, 1.0, {"acceleration": 5.0, "jerk": 20.0}, hold=0.5)
    change = fastest_velocity_change(1.0 - MOVE(2.0, 1), 0.0, (-5.0, 5.0), 20.0)
    assert slow.end == pytest.approx(2.0 + change.duration + 0.5, rel=1e-14)
    np.testing.assert_array_equal(slow.jet(slow.end, 2)[1:, 0], [1.0, 0.0])
    t = np.linspace(slow.end - 0.5, slow.end, 7)[1:]
    np.testing.assert_allclose(slow(t), slow.final - (slow.end - t), rtol=1e-14)
    rest = PolySpline([Waypoint(0, slow.final, 1.0, 0.0), Waypoint(2.0, 10.0, 0.0, 0.0)], labels="x")
    both = slow.then(rest)
    assert both.final == 10.0
    assert [j for j in both.jumps(2) if both.start < j.time < both.end] == []
    # And it can be stopped again, in the held part and after it.
    for time in (slow.end - 0.2, slow.end, slow.end + 1.0):
        assert quiet(both.stop, time, LIMITS).jet(4.9 + time, 1)[1] == 0.0


def test_to_velocities_of_several_axes():
    plan = KINDS["piecewise"]
    for synchronize in ("time", None):
        moving = quiet(plan.to_velocity, 2.0, [0.5, -0.25], LIMITS, hold=0.2, synchronize=synchronize)
        np.testing.assert_array_equal(moving.jet(moving.end, 2)[1:], [[0.5, -0.25], [0.0, 0.0]])
    again = trajectory_from_dict(json.loads(json.dumps(moving.to_dict())))
    assert again.to_dict() == moving.to_dict()
    same = quiet(plan.to_velocity, 2.0, 0.5, LIMITS)
    np.testing.assert_array_equal(same.jet(same.end, 1)[1], [0.5, 0.5])


def test_a_velocity_that_is_reached_already():
    line = PolySpline([Waypoint(0.0, 0.0), Waypoint(2.0, 4.0)])
    moving = line.to_velocity(1.0, 2.0, LIMITS)
    assert (moving.end, moving.final) == (1.0, 2.0)
    assert line.to_velocity(1.0, 2.0, LIMITS, hold=3.0).final == pytest.approx(8.0, rel=1e-15)


def test_rest_is_a_velocity():
    np.testing.assert_array_equal(
        MOVE.to_velocity(2.0, 0.0, LIMITS).jet([2.1, 2.5], 3), MOVE.stop(2.0, LIMITS).jet([2.1, 2.5], 3)
    )


def test_phases_that_times_do_not_resolve_are_reported():
    with pytest.warns(UserWarning, match="x_d2 .* floating-point times do not resolve its phases; use a time origin"):
        MOVE.shift(1e6).stop(1e6 + 2.0, {"acceleration": 1e6, "jerk": 1e12})


# Forms of limits


@pytest.mark.parametrize(
    "limits",
    [
        {"acceleration": [4.0, 4.0], "jerk": [25.0, 25.0]},
        {"acceleration": (-4.0, 4.0), "jerk": 25},
        {"acceleration": [(-4.0, 4.0), (-4.0, 4.0)], "jerk": np.array([25.0, 25.0])},
        {"acceleration": cp.Limits(-4.0, 4.0), "jerk": cp.Limits(-25.0, 25.0)},
        {"x_d2": 4.0, "z_d2": (-4.0, 4.0), "x_d3": 25.0, "z_d3": 25.0},
        {"acceleration": 4.0, "jerk": 25.0, "velocity": 99.0, "x": (-99.0, 99.0)},
        {"acceleration": cp.Limits(-4.0, 4.0, rate=25.0)},
        {"x_d2": 4.0, "acceleration": 9.0, "z_d2": 4.0, "jerk": 25.0, "x_d3": 99.0},  # all apply
    ],
)
def test_forms_of_limits(limits):
    plan = KINDS["piecewise"]
    np.testing.assert_array_equal(
        quiet(plan.stop, 2.0, limits).jet([2.1, 2.2], 3), quiet(plan.stop, 2.0, LIMITS).jet([2.1, 2.2], 3)
    )


def test_an_acceleration_without_limit_on_one_side():
    plan = PolySpline([Waypoint(0.0, 0.0, 4.0), Waypoint(2.0, 8.0, 4.0)])
    free = plan.stop(1.0, {"acceleration": cp.Limits(high=1.0), "jerk": 1.0})
    assert free.end - 1.0 == pytest.approx(4.0, rel=1e-14)  # 2 sqrt(v/J)


# What is rejected


@pytest.mark.parametrize(
    ("time", "limits", "options", "message"),
    [
        (-0.5, LIMITS, {}, r"time must lie within the plan, from 0 s to 4 s, got -0.5 s, before its start"),
        (
            4.1,
            LIMITS,
            {},
            r"time must lie within the plan, from 0 s to 4 s, got 4.1 s, after its end, where it is at rest",
        ),
        (math.nan, LIMITS, {}, "time must be finite, got nan"),
        (2.0, {"acceleration": 1.0}, {}, "limits must contain acceleration and jerk, got no jerk of x; add 'jerk'"),
        (2.0, {"jerk": 1.0}, {}, "got no acceleration of x; add 'acceleration' for all axes, or 'x_d2'"),
        (2.0, {}, {}, "limits must contain acceleration and jerk, got no acceleration of x"),
        (2.0, {"acceleration": 1.0, "jerk": (-1.0, 2.0)}, {}, "limits of x_d3 must be one number"),
        (
            2.0,
            {"acceleration": (0.0, 2.0), "jerk": 2.0},
            {},
            "limits of x_d2 must be below and above 0, got from 0 to 2",
        ),
        (2.0, {"acceleration": (1.0, 2.0), "jerk": 2.0}, {}, "limits of acceleration must include 0"),
        (2.0, {"acceleration": -1.0, "jerk": 2.0}, {}, "limits of acceleration must be"),
        (2.0, {"acceleration": math.nan, "jerk": 2.0}, {}, "limits of acceleration must be"),
        (2.0, {"acceleration": [1.0, 2.0, 3.0], "jerk": 2.0}, {}, "limits of acceleration must be"),
        (
            2.0,
            {**LIMITS, "snap": 3.0},
            {},
            "limits must be those of position, velocity, acceleration and jerk, got x_d4",
        ),
        (2.0, {**LIMITS, "x_d1": cp.Limits(rms=3.0)}, {}, "limits of a stop must be constant ones .*, got RMS of x_d1"),
        (
            2.0,
            {"acceleration": cp.Limits(-1.0, 1.0, during=(0.0, 1.0)), "jerk": 2.0},
            {},
            "limits of a stop must be constant ones .*, got x_d2 within ±1 between 0 and 1 s",
        ),
        (
            2.0,
            {**LIMITS, "both": cp.Region(("x_d1", "x_d2"), [(9, 0), (0, 9), (-9, 0), (0, -9)])},
            {},
            "limits of a stop must be constant ones .*, got both: ",
        ),
        (2.0, {**LIMITS, "force": 3.0}, {}, "limits must name derivatives of an axis .*, got 'force'"),
        (2.0, LIMITS, {"synchronize": "phase"}, 'synchronize must be "time", "path" or None, got \'phase\''),
    ],
)
def test_what_is_rejected(time, limits, options, message):
    with pytest.raises(ValueError, match=message):
        MOVE.stop(time, limits, **options)


def test_kinds_that_are_rejected():
    with pytest.raises(ValueError, match="plan must have a duration to be stopped, got a step at 1 s"):
        Step(2.0, time=1.0).stop(1.0, LIMITS)
    with pytest.raises(TypeError, match="limits must be a mapping"):
        MOVE.stop(2.0, 4.0)
    with pytest.raises(TypeError, match="time must be a number, got '2'"):
        MOVE.stop("2", LIMITS)
    with pytest.raises(ValueError, match=r'"time" or None for a shaped plan, got "path"'):
        KINDS["shaped"].stop(2.0, LIMITS, synchronize="path")
    moving = PolySpline([Waypoint(0.0, 0.0, 3.0), Waypoint(1.0, 3.0, 3.0)])
    for time in (0.9, 1.0):
        with pytest.raises(ValueError, match=r'got "path": the plan ends in motion at 1 s, before it can be stopped'):
            moving.stop(time, LIMITS, synchronize="path")


@pytest.mark.parametrize(
    ("velocity", "limits", "options", "message"),
    [
        ([1.0, 2.0], LIMITS, {}, "velocity must be a finite number or 1 of them"),
        (math.inf, LIMITS, {}, "velocity must be a finite number"),
        (1.0, LIMITS, {"hold": -1.0}, "hold must be finite and at least 0, got -1.0"),
        (1.0, LIMITS, {"synchronize": "path"}, 'synchronize must be "time" or None for a change to a velocity'),
        (
            2.0,
            {**LIMITS, "velocity": 1.5},
            {},
            "velocity must satisfy the limits, got 2 of x, where x_d1 must be within",
        ),
    ],
)
def test_velocities_that_are_rejected(velocity, limits, options, message):
    with pytest.raises(ValueError, match=message):
        MOVE.to_velocity(2.0, velocity, limits, **options)


# On a drive's cycle, and in a loop


def test_a_stopped_plan_on_a_cycle_remains_continuous():
    """Its parts are retimed together: apart, the velocity would jump where the stop begins."""
    for plan in (MOVE.stop(1.9, LIMITS), MOVE.to_velocity(1.9, 1.0, LIMITS, hold=0.3)):
        cycled = plan.on_cycle(0.004)
        assert cycled.end / 0.004 == pytest.approx(round(cycled.end / 0.004), abs=1e-9)
        assert plan.end <= cycled.end < plan.end + 0.004
        assert [j for j in cycled.jumps(2) if cycled.start < j.time < cycled.end] == []
        assert cycled.peak(1) <= plan.peak(1)
    there = MOVE.then(SCurve(3.0, 10.0, velocity=1.5, acceleration=2.0, jerk=9.0, labels="x"))
    assert [type(part).__name__ for part in there.on_cycle(0.3).parts] == ["PolySpline", "SCurve"]  # each on its own


@pytest.mark.parametrize("synchronize", ["time", "path"])
def test_a_stopped_plan_in_a_loop(synchronize):
    """Simulated exactly as by Python, integrated from breakpoint to breakpoint."""
    control = pytest.importorskip("control")
    stopped = MOVE.stop(2.0, LIMITS, synchronize=synchronize)
    lag = control.ss([[-3.0]], [[3.0]], [[1.0]], 0, inputs="x", outputs="y", name="lag")
    loop = control.interconnect([cp.create_source_iosystem(stopped), lag], inputs=[], outputs=["y"])
    t = np.linspace(0.0, 6.0, 601)
    exact, python = (cp.simulate(loop, t, method=method, rtol=1e-10) for method in ("exact", "python"))
    assert np.abs(exact.outputs - python.outputs).max() <= 1e-7
    assert np.asarray(exact.outputs).ravel()[-1] == pytest.approx(stopped.final[0], rel=1e-3)


# The parts of a stopped plan


def test_a_clipped_plan():
    for plan in KINDS.values():
        for first, last in itertools.pairwise(np.linspace(plan.start, plan.end, 4).tolist()):
            part = Clipped(plan, first, last)
            t = np.linspace(first, last, 60)[1:-1]
            np.testing.assert_array_equal(part.jet(t, 3), plan.jet(t, 3))
            np.testing.assert_allclose(part.jet(t - 1e-12, 0), plan.jet(t - 1e-12, 0), rtol=1e-14)
            np.testing.assert_array_equal(part.final, plan.jet(last, 0, left=True)[0])
            assert part.start == first
            assert part.end == last
    for wrong in ((0.0, 5.0), (-1.0, 2.0), (2.0, 2.0), (3.0, 2.0)):
        with pytest.raises(ValueError, match="start and end must increase and lie within the plan, from 0 s to 4 s"):
            Clipped(MOVE, *wrong)
    with pytest.raises(TypeError, match="plan must be a Trajectory"):
        Clipped(3.0, 0.0, 1.0)


def test_what_stopped_plans_consist_of():
    stopped = MOVE.stop(2.0, LIMITS)
    assert isinstance(stopped, Joined)
    assert [type(part).__name__ for part in stopped.parts] == ["Clipped", "MotionProfile"]
    assert [w.time for w in stopped.waypoints] == [0.0]
