"""Profiles from and to motion: ruckig in scaled units, symmetries, a linear program, closed forms, what is rejected."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import bmat, diags, eye
from strict import WARNINGS

import ctrlplan as cp
from ctrlplan.trajectories import MotionProfile, SCurve, Trapezoid, moving, trajectory_from_dict

ruckig = pytest.importorskip("ruckig")


class Case:
    """One axis: two states, and limits."""

    def __init__(self, start, end, velocity, acceleration, jerk):
        self.start, self.end, self.jerk = np.array(start), np.array(end), jerk
        self.velocity, self.acceleration = tuple(velocity), tuple(acceleration)

    def arguments(self):
        return {
            "final": self.end[0],
            "initial": self.start[0],
            "velocity": self.velocity,
            "acceleration": self.acceleration,
            "jerk": self.jerk,
            "start_velocity": self.start[1],
            "start_acceleration": self.start[2],
            "end_velocity": self.end[1],
            "end_acceleration": self.end[2],
        }

    def profile(self):
        return SCurve(**self.arguments())

    def mirrored(self):
        swapped = ([-high, -low] for low, high in (self.velocity, self.acceleration))
        return Case(-self.start, -self.end, *swapped, self.jerk)

    def reversed(self):
        """The same motion backwards in time: velocities change sign, accelerations do not."""
        signs = np.array([1.0, -1.0, 1.0])
        low, high = self.velocity
        return Case(signs * self.end, signs * self.start, (-high, -low), self.acceleration, self.jerk)

    def scaled(self, length, time):
        units = length / time ** np.arange(4)
        limits = (np.array(self.velocity) * units[1], np.array(self.acceleration) * units[2], self.jerk * units[3])
        return Case(self.start * units[:3], self.end * units[:3], *limits)


def cases(count, seed):
    """Limits log-uniform from 0.1 to 10, minima up to a factor sqrt(10) different from maxima, distances normal
    times 0.01 to 100, states uniform where no excess is unavoidable; one in three without accelerations at the ends,
    one in five to rest, one in seven from rest.
    """
    rng = np.random.default_rng(seed)
    for k in range(count):
        v, a, jerk = 10.0 ** rng.uniform(-1, 1, 3)
        (vl, vh), (al, ah) = velocity, acceleration = [(-s * 10.0 ** rng.uniform(-0.5, 0.5), s) for s in (v, a)]
        first = rng.normal()
        distance = rng.normal() * 10.0 ** rng.uniform(-2, 2)
        while True:
            v0, v1 = rng.uniform(vl, vh, 2)
            a0, a1 = rng.uniform(al, ah, 2) * (k % 3 > 0)
            if k % 5 == 0:
                v1 = a1 = 0.0
            if k % 7 == 0:
                v0 = a0 = 0.0
            if vl <= v0 + a0 * abs(a0) / (2 * jerk) <= vh and vl <= v1 - a1 * abs(a1) / (2 * jerk) <= vh:
                break
        yield Case((first, v0, a0), (first + distance, v1, a1), velocity, acceleration, jerk)


def by_ruckig(case):
    """Duration by the library, in units in which velocity and jerk limits are 1."""
    tau = math.sqrt(case.velocity[1] / case.jerk)
    one = case.scaled(1.0 / (case.velocity[1] * tau), 1.0 / tau)
    given, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
    given.current_position, given.target_position = [0.0], [one.end[0] - one.start[0]]
    given.current_velocity, given.current_acceleration = [one.start[1]], [one.start[2]]
    given.target_velocity, given.target_acceleration = [one.end[1]], [one.end[2]]
    (given.min_velocity,), (given.max_velocity,) = ([x] for x in ([v] for v in one.velocity))
    (given.min_acceleration,), (given.max_acceleration,) = ([x] for x in ([a] for a in one.acceleration))
    given.max_jerk = [one.jerk]
    ruckig.Ruckig(1).calculate(given, found)
    return found.duration * tau


def exact_extrema(plan, axis=0):
    """Minimum and maximum of derivatives 1 to 3 of a piecewise cubic: at breakpoints and where the next one is 0."""
    right, left = plan.jet(plan.breakpoints[:-1], 3)[:, axis], plan.jet(plan.breakpoints[1:], 3, left=True)[:, axis]
    rows = [[*right[k], *left[k]] for k in (1, 2, 3)]
    for (_, v, a, j), last in zip(right.T, np.diff(plan.breakpoints), strict=True):
        if j and 0.0 < -a / j < last:
            rows[0].append(v - a * a / (2 * j))
    return [(min(row), max(row)) for row in rows]


def check(case, symmetries=True):
    plan = case.profile()
    size = abs(case.end[0] - case.start[0]) + max(case.velocity) * plan.duration
    scales = np.array(
        [size, max(-case.velocity[0], case.velocity[1]), max(-case.acceleration[0], case.acceleration[1])]
    )
    for state, time in ((case.start, plan.start), (case.end, plan.end)):
        assert (np.abs(plan.jet(time, 2)[:, 0] - state) <= 1e-12 * scales).all()
    inner = plan.breakpoints[1:-1]
    assert (np.abs(plan.jet(inner, 2) - plan.jet(inner, 2, left=True))[:, 0] <= 1e-12 * scales[:, None]).all()
    for (low, high), (minimum, maximum) in zip(
        (case.velocity, case.acceleration, (-case.jerk, case.jerk)), exact_extrema(plan), strict=True
    ):
        slack = 1e-9 * (high - low)
        assert low - slack <= minimum
        assert maximum <= high + slack
    assert plan.duration == pytest.approx(by_ruckig(case), rel=1e-8)
    if symmetries:
        rng = np.random.default_rng(int(1e6 * abs(case.start[1])))
        assert case.mirrored().profile().duration == pytest.approx(plan.duration, rel=1e-10)
        assert case.reversed().profile().duration == pytest.approx(plan.duration, rel=1e-9)
        length, time = 10.0 ** rng.uniform(-9, 9), 10.0 ** rng.uniform(-3, 3)
        scaled = case.scaled(length, time).profile()
        assert scaled.duration == pytest.approx(plan.duration * time, rel=1e-9)


@pytest.mark.slow
def test_random_cases():
    for case in cases(100, 1):
        check(case)


@pytest.mark.slow
def test_many_random_cases():
    for k, case in enumerate(cases(600, 2)):
        check(case, symmetries=k % 20 == 0)


@pytest.mark.parametrize("length", [1e-9, 1e9])
@pytest.mark.parametrize("time", [1e-3, 1e3])
def test_units(length, time):
    for case in cases(10, 3):
        plan, scaled = case.profile(), case.scaled(length, time).profile()
        assert scaled.duration == pytest.approx(plan.duration * time, rel=1e-9)
        t = np.linspace(0.0, plan.duration, 50)
        assert np.abs(scaled(time * t) / length - plan(t)).max() <= 1e-8 * np.abs(plan(t)).max()


# A linear program


def is_feasible(case, duration, steps=500):
    """Whether jerks that are constant in each of many steps lead from one state to the other; limits at the steps."""
    tau = duration
    one = case.scaled(1.0 / (case.velocity[1] * tau), 1.0 / tau)
    h, n = 1.0 / steps, steps
    # States p, v, a at the n + 1 ends and jerks: s[k+1] = A s[k] + B j[k].
    up, here = eye(n, n + 1, 1), eye(n, n + 1)
    equations = bmat(
        [
            [up - here, -h * here, -0.5 * h * h * here, -(h**3) / 6.0 * eye(n)],
            [None, up - here, -h * here, -0.5 * h * h * eye(n)],
            [None, None, up - here, -h * eye(n)],
        ]
    ).tocsr()
    low, high = (
        np.repeat([side, *rest, jerk], [n + 1, n + 1, n + 1, n])
        for side, rest, jerk in (
            (-1e3, (one.velocity[0], one.acceleration[0]), -one.jerk),
            (1e3, (one.velocity[1], one.acceleration[1]), one.jerk),
        )
    )
    position = np.array([0.0, *one.start[1:]]), np.array([one.end[0] - one.start[0], *one.end[1:]])
    for state, at in zip(position, (0, n), strict=True):
        for k, value in enumerate(state):
            low[k * (n + 1) + at] = high[k * (n + 1) + at] = value
    scale = diags(1.0 / np.repeat([h, h, h], n))
    found = linprog(
        np.zeros(low.size),
        A_eq=scale @ equations,
        b_eq=np.zeros(3 * n),
        bounds=np.stack([low, high], axis=1),
        method="highs",
    )
    return found.status == 0


def check_by_linear_program(count, seed):
    """Its grid error: a duration 1 % longer, 5 of 500 steps, is feasible; one 1 % shorter is not."""
    for case in cases(count, seed):
        duration = case.profile().duration
        assert is_feasible(case, 1.01 * duration) or is_feasible(case, 1.03 * duration)
        assert not is_feasible(case, 0.99 * duration)


@pytest.mark.slow
def test_no_jerk_in_steps_is_faster():
    check_by_linear_program(3, 4)


@pytest.mark.slow
def test_no_jerk_in_steps_is_faster_for_many():
    check_by_linear_program(8, 5)


# Closed forms


def test_s_curves_in_closed_form():
    limits = {"velocity": 1.0, "acceleration": 0.5, "jerk": 0.5}
    # From the limit of the velocity: cruise, then v/a + a/j = 3 s over 1.5.
    assert SCurve(4.0, **limits, start_velocity=1.0).duration == pytest.approx(2.5 + 3.0, rel=1e-12)
    assert SCurve(4.0, **limits, end_velocity=1.0).duration == pytest.approx(3.0 + 2.5, rel=1e-12)
    assert SCurve(4.0, **limits, start_velocity=1.0, end_velocity=1.0).duration == pytest.approx(4.0, rel=1e-12)
    # Into the wrong direction first: the stop, and the way back.
    away = SCurve(0.0, **limits, start_velocity=1.0)
    assert away.duration == pytest.approx(3.0 + SCurve(0.0, 1.5, **limits).duration, rel=0.2)
    assert away.extrema().maximum[0] == pytest.approx(1.5, rel=0.05)
    assert away.final == 0.0


def test_trapezoids_in_closed_form():
    plan = Trapezoid(3.5, velocity=2.0, acceleration=(-4.0, 1.0), start_velocity=1.0)
    np.testing.assert_allclose(np.diff(plan.breakpoints), [1.0, 0.75, 0.5], rtol=1e-12)
    np.testing.assert_allclose([j.size for j in plan.jumps(2) if j.order == 2], [1.0, -1.0, -4.0, 4.0], rtol=1e-12)
    back = Trapezoid(0.0, 0.0, velocity=(-1.0, 5.0), acceleration=2.0, start_velocity=2.0)
    # The stop of 1 s over 1, and back with at most 1: 0.5 + 0.5 s of ramps and 0.5 of cruise.
    assert back.duration == pytest.approx(1.0 + 1.0 / 1.0 + 1.0 / 2.0, rel=1e-12)
    assert back.extrema(1).minimum[0] == pytest.approx(-1.0, rel=1e-12)


def trapezoid_cases(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        v, a = 10.0 ** rng.uniform(-1, 1, 2)
        velocity, acceleration = [(-s * 10.0 ** rng.uniform(-0.5, 0.5), s) for s in (v, a)]
        v0, v1 = rng.uniform(*velocity, 2)
        yield rng.normal() * 10.0 ** rng.uniform(-2, 2), v0, v1, velocity, acceleration


def bang_bang(distance, v0, v1, velocity, acceleration):
    """Minimum duration with limited velocity and acceleration, by cases: a peak between two ramps, or a cruise."""
    best = math.inf
    for (first, second), limit in (((acceleration[1], acceleration[0]), velocity[1]), (acceleration, velocity[0])):
        # Peak w: (w^2 - v0^2)/(2 first) + (v1^2 - w^2)/(2 second) = distance.
        square = (distance + v0**2 / (2 * first) - v1**2 / (2 * second)) / (1 / (2 * first) - 1 / (2 * second))
        if square < 0.0:
            continue
        for peak in (math.sqrt(square), -math.sqrt(square)):
            cruise = 0.0
            w = peak
            if (w - limit) * first > 0.0:
                w = limit
                cruise = (distance - (w**2 - v0**2) / (2 * first) - (v1**2 - w**2) / (2 * second)) / w
            times = [(w - v0) / first, cruise, (v1 - w) / second]
            if min(times) >= -1e-12:
                best = min(best, sum(times))
    return best


@pytest.mark.slow
def test_trapezoids_by_cases():
    for distance, v0, v1, velocity, acceleration in trapezoid_cases(200, 6):
        plan = Trapezoid(distance, velocity=velocity, acceleration=acceleration, start_velocity=v0, end_velocity=v1)
        assert plan.duration == pytest.approx(bang_bang(distance, v0, v1, velocity, acceleration), rel=1e-9)
        np.testing.assert_allclose(
            plan.jet([plan.start, plan.end], 1)[1, 0], [v0, v1], rtol=0, atol=1e-12 * velocity[1]
        )
        (low, high), (minimum, maximum), _ = exact_extrema(plan)
        assert velocity[0] * (1 + 1e-9) <= low
        assert high <= velocity[1] * (1 + 1e-9)
        assert acceleration[0] * (1 + 1e-9) <= minimum
        assert maximum <= acceleration[1] * (1 + 1e-9)


def test_from_rest_to_rest_with_pairs():
    """Stronger brakes: v^2/(2 a) + v^2/(2 b) + cruise."""
    plan = Trapezoid(10.0, velocity=2.0, acceleration=(-4.0, 1.0))
    assert plan.duration == pytest.approx(2.0 + 0.5 + (10.0 - 2.0 - 0.5) / 2.0, rel=1e-12)
    slow = Trapezoid(-10.0, velocity=(-1.0, 2.0), acceleration=1.0)
    assert slow.duration == pytest.approx(Trapezoid(10.0, velocity=1.0, acceleration=1.0).duration, rel=1e-12)
    same = SCurve(10.0, velocity=(-2.0, 2.0), acceleration=(-1.0, 1.0), jerk=1.0)
    assert same.to_dict() == SCurve(10.0, velocity=2.0, acceleration=1.0, jerk=1.0).to_dict()


# Several axes

LIMITS = {"velocity": [1.0, 2.0], "acceleration": [1.0, 3.0], "jerk": [4.0, 9.0]}


def test_axes_end_together_or_alone():
    states = {"start_velocity": [0.5, -1.0], "start_acceleration": [0.2, 0.0]}
    together = SCurve([3.0, 1.0], **LIMITS, **states, synchronize="time")
    alone = SCurve([3.0, 1.0], **LIMITS, **states, synchronize=None)
    one = [
        SCurve(d, velocity=v, acceleration=a, jerk=j, start_velocity=v0, start_acceleration=a0).duration
        for d, v, a, j, v0, a0 in zip(
            [3.0, 1.0], *(LIMITS[k] for k in ("velocity", "acceleration", "jerk")), [0.5, -1.0], [0.2, 0.0], strict=True
        )
    ]
    assert alone.duration == pytest.approx(max(one), rel=1e-10)
    assert together.duration >= max(one) * (1 - 1e-10)
    early = min(one)
    assert np.abs(alone.jet(early + 1e-6, 2)[1:, int(np.argmin(one))]).max() <= 1e-9
    for plan in (together, alone):
        np.testing.assert_array_equal(plan.final, [3.0, 1.0])
        np.testing.assert_array_equal(
            plan.jet(plan.start, 2)[:, :, None][..., 0], [[0.0, 0.0], [0.5, -1.0], [0.2, 0.0]]
        )
        assert not plan.jet(plan.end, 2)[1:].any()
        for axis in range(2):
            for (low, high), limit in zip(exact_extrema(plan, axis), LIMITS.values(), strict=True):
                assert max(-low, high) <= limit[axis] * (1 + 1e-9)


@pytest.mark.slow
def test_random_axes_together():
    rng = np.random.default_rng(7)
    for k in range(60):
        naxes = int(rng.integers(2, 5))
        v, a, j = 10.0 ** rng.uniform(-0.5, 0.5, (3, naxes))
        final, v0 = rng.normal(size=naxes), v * rng.uniform(-0.9, 0.9, naxes)
        v1 = v * rng.uniform(-0.9, 0.9, naxes) * (k % 2)
        plan = SCurve(
            final, velocity=v, acceleration=a, jerk=j, start_velocity=v0, end_velocity=v1, synchronize="time", time=3.0
        )
        np.testing.assert_allclose(plan.jet(plan.end, 2)[:, :], [final, v1, 0 * v1], rtol=0, atol=1e-12)
        for axis in range(naxes):
            for (low, high), limit in zip(exact_extrema(plan, axis), (v, a, j), strict=True):
                assert max(-low, high) <= limit[axis] * (1 + 1e-9)


def test_rest_to_rest_together_and_alone():
    for kind, limits in ((SCurve, LIMITS), (Trapezoid, {k: LIMITS[k] for k in ("velocity", "acceleration")})):
        own = [kind(d, **{k: v[axis] for k, v in limits.items()}) for axis, d in enumerate((3.0, -1.0))]
        longest = max(plan.duration for plan in own)
        together, alone = (kind([3.0, -1.0], **limits, synchronize=s) for s in ("time", None))
        assert together.duration == pytest.approx(longest, rel=1e-12)
        assert alone.duration == pytest.approx(longest, rel=1e-12)
        assert kind([3.0, -1.0], **limits).duration >= longest * (1 - 1e-12)
        t = np.linspace(0.0, longest, 77)
        for axis, plan in enumerate(own):
            assert np.abs(alone(t)[axis] - plan(t)).max() <= 1e-12
            assert np.abs(together(t)[axis] - plan.retime(longest)(t)).max() <= 1e-12


def test_a_straight_line_with_ends_in_motion():
    line = np.array([2.0, -1.0, 0.0])
    plan = SCurve(
        3.0 * line,
        -1.0 * line,
        velocity=[(-9.0, 3.0), (-1.0, 9.0), (-1.0, 1.0)],
        acceleration=[4.0, 1.0, 1.0],
        jerk=9.0,
        start_velocity=0.5 * line,
        end_velocity=0.3 * line,
        end_acceleration=-0.1 * line,
    )
    points = plan(np.linspace(plan.start, plan.end, 201))
    assert np.abs(points - points[0] / 2.0 * line[:, None]).max() <= 1e-12
    # As one axis: velocity at most 1 (second axis), acceleration 1, jerk 4.5.
    one = SCurve(
        3.0,
        -1.0,
        velocity=(-4.5, 1.0),
        acceleration=1.0,
        jerk=4.5,
        start_velocity=0.5,
        end_velocity=0.3,
        end_acceleration=-0.1,
    )
    assert plan.duration == pytest.approx(one.duration, rel=1e-10)
    np.testing.assert_allclose(plan.jet(plan.end, 2), [3.0 * line, 0.3 * line, -0.1 * line], rtol=0, atol=1e-12)


# As any plan


def test_a_moving_profile_is_a_plan(tmp_path):
    for plan in (
        SCurve(3.0, 1.0, velocity=(-1.0, 2.0), acceleration=1.5, jerk=9.0, start_velocity=0.7, time=2.0, labels="x"),
        Trapezoid([3.0, 1.0], velocity=2.0, acceleration=1.5, start_velocity=[0.7, -0.3], synchronize="time"),
    ):
        data = json.loads(json.dumps(plan.to_dict()))
        again = trajectory_from_dict(data)
        t = np.linspace(plan.start - 0.5, plan.end + 0.5, 301)
        np.testing.assert_array_equal(again.jet(t, 3), plan.jet(t, 3))
        assert again.to_dict() == plan.to_dict()
        assert type(again) is type(plan)
        for name in ("velocity", "acceleration", "start_velocity", "end_velocity"):
            np.testing.assert_array_equal(getattr(again, name), getattr(plan, name))
        slow = plan.retime(2.0 * plan.duration)
        inner = np.setdiff1d(t, plan.breakpoints)
        scaled = slow.jet(plan.start + 2.0 * (inner - plan.start), 3) * 2.0 ** np.arange(4)[:, None, None]
        assert np.abs(scaled - plan.jet(inner, 3)).max() <= 1e-11
        np.testing.assert_allclose(slow.start_velocity, plan.start_velocity / 2.0, rtol=1e-15)
        np.testing.assert_allclose(slow.acceleration, plan.acceleration / 4.0, rtol=1e-15)
        assert np.abs(plan.shift(1e6).jet(inner + 1e6, 2) - plan.jet(inner, 2)).max() <= 1e-8
        for ending in (".csv", ".c", ".ppoly.json"):
            assert plan.export(tmp_path / f"plan{ending}")
        stopped = plan.stop(plan.start + 0.5 * plan.duration, {"acceleration": 3.0, "jerk": 20.0})
        assert stopped.end < plan.end + 2.0
        assert "SCurve" in repr(plan) or "Trapezoid" in repr(plan)


def test_it_continues_a_plan_that_ends_in_motion():
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 10, 0, 0)])
    slow = move.to_velocity(2.0, 1.0, {"acceleration": 5.0, "jerk": 20.0}, hold=0.5)
    on = SCurve(20.0, slow.final, velocity=3.0, acceleration=2.0, jerk=10.0, start_velocity=1.0)
    both = slow.then(on)
    assert both.final == 20.0
    assert [jump for jump in both.jumps(2) if both.start < jump.time < both.end] == []


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_series_at_a_symbol():
    casadi = pytest.importorskip("casadi")
    plan = SCurve([3.0, 1.0], velocity=2.0, acceleration=1.5, jerk=9.0, start_velocity=[0.7, -0.3], synchronize="time")
    t = casadi.SX.sym("t")
    function = casadi.Function("f", [t], [casadi.vertcat(*(value for row in plan.series(t, 4) for value in row))])
    for moment in np.linspace(-0.5, plan.end + 0.5, 41).tolist():
        wanted = plan.jet(moment, 4) / np.array([1, 1, 2, 6, 24])[:, None]
        assert np.abs(np.array(function(moment)).reshape(2, 5).T - wanted).max() <= 1e-13


def test_distant_origins():
    near = SCurve(3.0, velocity=2.0, acceleration=1.5, jerk=9.0, start_velocity=0.7)
    far = SCurve(1e6 + 3.0, 1e6, velocity=2.0, acceleration=1.5, jerk=9.0, start_velocity=0.7)
    late = SCurve(3.0, velocity=2.0, acceleration=1.5, jerk=9.0, start_velocity=0.7, time=1e6)
    assert far.duration == pytest.approx(near.duration, rel=1e-9)
    assert late.duration == pytest.approx(near.duration, rel=1e-9)
    assert not late.jet(late.end, 2)[1:].any()
    inner = late.breakpoints[1:-1]
    assert np.abs(late.jet(inner, 2) - late.jet(inner, 2, left=True)).max() <= 1e-9


def test_motion_profiles():
    """Naive sums; and ends that do not fit."""
    plan = MotionProfile([0.0, 1.0, 3.0], [[2.0, -1.0]], [[1.0], [0.5], [0.0]])
    assert plan(1.0) == pytest.approx(1.0 + 0.5 + 2.0 / 6.0, rel=1e-15)
    assert plan(3.0) == pytest.approx(plan(1.0) + 2.0 * 1.5 + 4.0 * 2.0 / 2.0 - 8.0 / 6.0, rel=1e-14)
    for wrong, message in (
        ({"values": [[1.0]]}, r"values must have shape \(naxes, nsegments\), \(1, 2\), got shape \(1, 1\)"),
        ({"breakpoints": [0.0, 3.0, 1.0]}, "breakpoints must be two or more and increase strictly"),
        ({"breakpoints": [1.0]}, "breakpoints must be two or more"),
        ({"start_state": [1.0]}, "start_state must be an array of 2 dimensions, got shape"),
        ({"values": [[1.0, math.nan]]}, "values must be finite"),
        ({"end_state": [[9.0], [0.0], [0.0]]}, "values must lead from start_state to end_state, got y off by"),
        ({"end_state": [[9.0], [0.0]]}, "end_state must have the shape of start_state"),
    ):
        given = {"breakpoints": [0.0, 1.0, 3.0], "values": [[2.0, -1.0]], "start_state": [[1.0], [0.5], [0.0]]} | wrong
        with pytest.raises(ValueError, match=message):
            MotionProfile(**given)


# What is rejected


def wrong(**changed):
    return SCurve(**({"final": 3.0, "velocity": 1.0, "acceleration": 1.0, "jerk": 2.0} | changed))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"start_velocity": 1.5},
            "start_velocity must allow a motion from -1 to 1, .* got 1.5 of y.*excess of 0.5; raise",
        ),
        # v + a|a|/(2 j) = 0.9 + 0.25; before the end 0.9 + 0.25 with a negative acceleration.
        (
            {"start_velocity": 0.9, "start_acceleration": 1.0},
            "start_velocity must .*, got 1.15 of y after the start with the maximum jerk: .* excess of 0.15",
        ),
        (
            {"end_velocity": 0.9, "end_acceleration": -1.0},
            "end_velocity must .*, got 1.15 of y before the end with the maximum jerk: an unavoidable excess of 0.15;",
        ),
        ({"end_velocity": -1.25}, "end_velocity must .* got -1.25 of y.*: an unavoidable excess of 0.25;"),
        (
            {"start_acceleration": 3.0},
            "start_acceleration must allow a motion from -1 to 1, .* got 3 of y.* excess of 2",
        ),
        ({"start_velocity": math.nan}, "start_velocity must be a finite number"),
        ({"start_velocity": [0.1, 0.2]}, "start_velocity must be a finite number or 1 of them"),
        ({"velocity": (0.0, 1.0)}, "velocity must be pairs of a finite minimum below 0 and a finite maximum above 0"),
        ({"velocity": (1.0, -1.0)}, "velocity must be pairs of a finite minimum below 0"),
        ({"acceleration": (-1.0, math.inf)}, "acceleration must be pairs of a finite minimum"),
        ({"jerk": (-1.0, 2.0)}, r"jerk must be a scalar or of shape \(1,\), got shape \(2,\)"),
        ({"velocity": (-1.0, 1.0, 2.0)}, "velocity must be a scalar or of shape"),
        ({"synchronize": "path"}, 'synchronize must be "phase", "time" or None, got \'path\''),
        ({"final": 0.0}, "final must differ from initial by a finite length"),
    ],
)
def test_what_is_rejected(changed, message):
    with pytest.raises(ValueError, match=message):
        wrong(**changed)


def test_off_the_straight_line():
    for states, name in (
        ({"start_velocity": [0.5, 0.5]}, "start_velocity"),
        ({"end_velocity": [0.5, 0.6]}, "end_velocity"),
        ({"start_acceleration": [0.0, 0.1]}, "start_acceleration"),
    ):
        message = rf'synchronize must be "time" or None for a motion off the straight line .* with {name} = '
        with pytest.raises(ValueError, match=message):
            SCurve([3.0, 1.0], velocity=1.0, acceleration=1.0, jerk=2.0, **states)


def test_an_axis_that_ends_early_must_end_at_rest():
    limits = {"velocity": 1.0, "acceleration": 1.0, "jerk": 2.0}
    with pytest.raises(ValueError, match='synchronize must be "time", got None with an end in motion of y2 after'):
        SCurve([9.0, 1.0], **limits, end_velocity=[0.0, 0.5], synchronize=None)
    assert SCurve([9.0, 1.0], **limits, end_velocity=[0.5, 0.0], synchronize=None).final[1] == 1.0
    # An axis that is in its final state already, in motion, and returns to it together with the other.
    states = {"start_velocity": [0.0, 0.5], "end_velocity": [0.0, 0.5]}
    with pytest.raises(ValueError, match="got None with an end in motion of y2 after 0 s"):
        SCurve([9.0, 0.0], **limits, **states, synchronize=None)
    both = SCurve([9.0, 0.0], **limits, **states, synchronize="time")
    assert both.duration >= SCurve(9.0, **limits).duration * (1 - 1e-12)
    np.testing.assert_allclose(both.jet(both.end, 1)[:, 1], [0.0, 0.5], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_without_the_extra():
    """Rest to rest with symmetric limits, stops and saved profiles work; what requires it says what to install."""
    saved = json.dumps(SCurve(3.0, velocity=1.0, acceleration=1.0, jerk=2.0, start_velocity=0.5).to_dict())
    code = f"""
import sys
sys.modules["ruckig"] = None
import json
import ctrlplan as cp
limits = dict(velocity=1.0, acceleration=1.0, jerk=2.0)
move = cp.SCurve([3.0, 1.0], **limits)
for synchronize in ("time", None):
    cp.SCurve([3.0, 1.0], **limits, synchronize=synchronize)
move.stop(1.0, {{"acceleration": 2.0, "jerk": 9.0}})
move.to_velocity(1.0, 0.1, {{"acceleration": 2.0, "jerk": 9.0}})
plan = cp.trajectory_from_dict(json.loads({saved!r}))
assert plan.retime(2.0 * plan.duration).final == 3.0
for wrong in (dict(start_velocity=0.5), dict(velocity=(-1.0, 2.0))):
    try:
        cp.SCurve(3.0, **(limits | wrong))
    except ImportError as error:
        assert str(error).endswith('require ruckig; install it with pip install "ctrlplan[otg]"'), error
    else:
        raise AssertionError(wrong)
"""
    done = subprocess.run([sys.executable, *WARNINGS, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def doubled(solved):
    """The solution of a problem with twice the velocity and acceleration."""

    def found(problem, scale):
        ranges = moving.Ranges(*(np.array([[2.0], [2.0], [1.0]]) * side for side in problem.ranges))
        return solved(replace(problem, ranges=ranges), scale)

    return found


@pytest.mark.parametrize("valid", range(3))
def test_a_profile_beyond_its_limits_is_not_taken(monkeypatch, valid):
    """Although it is shorter: of several time scales only that with a valid profile counts."""
    wanted, solved, calls = wrong(start_velocity=0.5), moving._solved, []

    def mixed(problem, scale):
        calls.append(scale)
        return (solved if len(calls) == valid + 1 else doubled(solved))(problem, scale)

    monkeypatch.setattr(moving, "_solved", mixed)
    assert wrong(start_velocity=0.5).duration == pytest.approx(wanted.duration, rel=1e-12)
    assert len(calls) == 3


def test_without_a_valid_profile_it_is_an_error(monkeypatch):
    monkeypatch.setattr(moving, "_solved", doubled(moving._solved))
    with pytest.raises(
        RuntimeError, match=r"ruckig must find a profile within the limits, got none: .* of y beyond -1 to"
    ):
        wrong(start_velocity=0.5)


def test_long_cruises_between_short_ramps():
    """Ramps of 1e-3 s around a cruise of 1e5 s: rounding of times is compensated; where it is too large, an error."""
    limits = {"velocity": (-0.015, 0.028), "acceleration": (-0.02, 0.016), "jerk": 33.7}
    plan = SCurve(4895.0, **limits, start_velocity=0.0094, end_velocity=-0.0031)
    assert plan.duration == pytest.approx(4895.0 / 0.028, rel=1e-4)
    for (low, high), found in zip((limits["velocity"], limits["acceleration"]), exact_extrema(plan), strict=False):
        assert low * (1 + 2e-9) <= found[0]
        assert found[1] <= high * (1 + 2e-9)
    with pytest.raises(RuntimeError, match="ruckig must find a profile within the limits, got none: "):
        Trapezoid(1e12, velocity=1e-3, acceleration=1e3, start_velocity=0.5e-3, end_velocity=-0.3e-3)


class Failing:
    """A solver that finds nothing."""

    def __init__(self, *_):
        pass

    def calculate(self, *_):
        raise ruckig.RuckigError("error in step 1\nof many lines")


class Undecided(Failing):
    def calculate(self, *_):
        return ruckig.Result.Error


def test_what_the_library_cannot_solve_is_an_error(monkeypatch):
    for kind, message in ((Failing, "got none: .*error in step 1$"), (Undecided, "got none: .*Error")):
        monkeypatch.setattr(ruckig, "Ruckig", kind)
        with pytest.raises(RuntimeError, match=message):
            wrong(start_velocity=0.5)
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(ImportError, match=r'require ruckig; install it with pip install "ctrlplan\[otg\]"'):
        wrong(start_velocity=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("time", [1e6, 1.7e9, -3e9])
def test_late_times(time):
    """Such as seconds since 1970: limits and ends hold, and the duration is longer by no more than the rounding."""
    for k, case in enumerate(cases(40, 8)):
        plan = SCurve(**case.arguments(), time=time)
        near = case.profile()
        tick = np.spacing(abs(time)) / np.diff(near.breakpoints).min()
        if tick > 1e-5:
            continue
        assert plan.duration == pytest.approx(near.duration, rel=1e-9 + 100.0 * tick), k
        for (low, high), found in zip((case.velocity, case.acceleration), exact_extrema(plan), strict=False):
            assert low - 1e-9 * (high - low) <= found[0]
            assert found[1] <= high + 1e-9 * (high - low)
        assert plan.peak(3)[0] <= case.jerk * (1 + 2e-9)
        np.testing.assert_array_equal(plan.jet(plan.end, 2)[:, 0], case.end)


def test_times_that_do_not_resolve_a_profile():
    limits = {"velocity": 1.3, "acceleration": 0.7, "jerk": 2.1, "start_velocity": 0.33, "end_velocity": 0.1}
    with pytest.raises(
        RuntimeError, match=r"the profile must satisfy its limits, got .* origin nearer to 0 than 1e\+12"
    ):
        wrong(**limits, time=1e12)
    with pytest.raises(ValueError, match=r"by a motion that times near 1e[+]18 s resolve, got none"):
        wrong(start_velocity=0.5, time=1e18)
    with pytest.raises(ValueError, match="the end must differ from the start"):
        wrong(final=1.0, initial=1.0, start_velocity=0.5, end_velocity=0.5)
