"""Fixed path: another time law under limits, against the trapezoid in closed form."""

from functools import cache
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.planning import fastest
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints
from ctrlplan.trajectories import Retimed

COUNT = 100_001
HOIST = cp.PolySpline(nominal_waypoints(5))
PLANS = {
    "obstacle": cp.TrigSpline(obstacle_waypoints(), alpha=4.0),
    "segments": cp.PiecewiseSpline(obstacle_waypoints()),
    "nominal": cp.TrigSpline(nominal_waypoints(), alpha=2.0),
    "there and back": cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]).then(
        cp.PolySpline([Waypoint(1, 1, 0, 0), Waypoint(3, -1, 0, 0)])
    ),
}
LIMITS = {"velocity": 2.0, "acceleration": 0.8}


@cache
def found_on_path(name):
    """Fastest plan on one of the paths, for several tests."""
    return fastest(PLANS[name], LIMITS, hold="path")


def move(kind, distance=1.0, shift=0.0):
    """Straight move over a distance, from rest to rest."""
    entries = {"cubic": 2, "quintic": 3, "trigonometric": 3, "septic": 4}[kind]
    still = [0.0] * (entries - 1)
    points = [Waypoint.from_jets(shift, y=[0.0, *still]), Waypoint.from_jets(shift + 1, y=[distance, *still])]
    return cp.TrigSpline(points, alpha=2.0 if kind == "trigonometric" else 0.0)


def trapezoid(distance, velocity, acceleration):
    """Minimum time from rest to rest under limits of velocity and acceleration."""
    if distance * acceleration <= velocity**2:
        return 2 * sqrt(distance / acceleration)
    return distance / velocity + velocity / acceleration


def sampled(plan, order, count=COUNT):
    return plan.jet(np.linspace(plan.start, plan.end, count), order)


def law_of(plan):
    assert isinstance(plan, Retimed)
    return plan.law


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANS)
def test_limits_are_satisfied_and_the_duration_does_not_exceed_that_of_fixed_shape(name):
    plan = PLANS[name]
    shape, path = fastest(plan, LIMITS), found_on_path(name)
    assert path.duration <= shape.duration
    assert path.duration < 0.95 * shape.duration  # these plans are far below their limits most of the time
    assert path.hold == "path"
    assert path.plan.start == plan.start
    jet = np.abs(sampled(path.plan, 2))
    assert jet[1].max() <= 2.0 * (1 + 1e-11)
    assert jet[2].max() <= 0.8 * (1 + 1e-11)
    assert path.active.fraction == pytest.approx(0.0, abs=1e-9)
    shorter = np.abs(sampled(path.plan.retime(path.duration * (1 - 1e-4)), 2))
    assert max(shorter[1].max() / 2.0, shorter[2].max() / 0.8) > 1.0
    assert path.plan.labels == plan.labels


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANS)
def test_the_path_is_the_same(name):
    plan = PLANS[name]
    found = found_on_path(name).plan
    law = law_of(found)
    passed = law(np.linspace(found.start, found.end, 2001))
    assert (np.diff(passed) > 0).all()
    assert [passed[0], passed[-1]] == pytest.approx([found.plan.start, found.plan.end], rel=1e-12, abs=1e-12)
    # The time law is relative to the duration of the given plan.
    parts = np.clip((passed - passed[0]) / (passed[-1] - passed[0]), 0.0, 1.0)
    expected = plan(plan.start + parts * plan.duration)
    points = found(np.linspace(found.start, found.end, 2001))
    np.testing.assert_allclose(points, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["obstacle", "there and back"])
def test_the_time_law_is_increasing(name):
    law = law_of(found_on_path(name).plan)
    rate = law(np.linspace(law.start, law.end, COUNT), 1)
    assert rate.min() > 0.0


def check_four_continuous_derivatives(law):
    inner = law.breakpoints[1:-1]
    right, left = law.jet(inner, 4)[:, 0], law.jet(inner, 4, left=True)[:, 0]
    size = np.abs(sampled(law, 4, 2001)[:, 0]).max(axis=1)
    assert (np.abs(right - left).max(axis=1) <= 1e-9 * size).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cubic", "quintic"])
@pytest.mark.parametrize(("distance", "velocity", "acceleration"), [(1.0, 10.0, 1.0), (10.0, 1.0, 1.0)])
def test_straight_moves_come_near_the_trapezoid(kind, distance, velocity, acceleration):
    found = fastest(move(kind, distance), {"y_d1": velocity, "y_d2": acceleration}, hold="path")
    best = trapezoid(distance, velocity, acceleration)
    assert best * (1 - 1e-9) <= found.duration <= 1.004 * best
    jet = np.abs(sampled(found.plan, 2)[:, 0])
    assert jet[1].max() <= velocity * (1 + 1e-11)
    assert jet[2].max() <= acceleration * (1 + 1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cubic", "quintic", "trigonometric"])
@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.3, 1.0, 2.0, 5.0, 20.0, 50.0, 100.0])
def test_every_trapezoid(kind, ratio):
    # v^2/(a d) alone decides on the form of the trapezoid.
    found = fastest(move(kind, ratio), {"y_d1": 1.0, "y_d2": 1.0}, hold="path")
    best = trapezoid(ratio, 1.0, 1.0)
    assert best * (1 - 1e-9) <= found.duration <= 1.004 * best


@pytest.mark.slow
def test_a_velocity_limit_alone():
    found = fastest(move("quintic"), {"y_d1": 2.0}, hold="path")
    assert 0.5 <= found.duration <= 1.004 * 0.5


def test_a_line_at_constant_speed_stays_one():
    line = cp.PolySpline([Waypoint(0, [0, 0]), Waypoint(1, [3, 4])])
    found = fastest(line, {"speed": 2.0}, lambda jet: {"speed": np.hypot(jet[1, 0], jet[1, 1])}, hold="path")
    assert found.duration == pytest.approx(2.5, rel=1e-9)
    np.testing.assert_allclose(np.hypot(*found.plan([0.1, 1.3, 2.4], 1)), 2.0, rtol=1e-6)


@pytest.mark.slow
def test_unequal_sides_turn_the_trapezoid():
    # Braking is twice as hard as speeding up: d/v + v/2 (1/a + 1/b).
    distance, velocity, up, down = 10.0, 1.0, 0.5, 1.0
    found = fastest(move("quintic", distance), {"y_d1": velocity, "y_d2": (-down, up)}, hold="path")
    best = distance / velocity + 0.5 * velocity * (1 / up + 1 / down)
    assert best <= found.duration <= 1.004 * best
    acceleration = sampled(found.plan, 2)[2, 0]
    assert -down * (1 + 1e-11) <= acceleration.min() < -0.9 * down
    assert 0.9 * up < acceleration.max() <= up * (1 + 1e-11)


@pytest.mark.slow
def test_jerk_limits_need_longer():
    plan = move("septic")
    limits = {"y_d1": 1.0, "y_d2": 2.0, "y_d3": 10.0}
    path, shape = fastest(plan, limits, hold="path"), fastest(plan, limits)
    # The double-S profile: with all three limits reached, T = d/v + v/a + a/j.
    best = 1.0 + 0.5 + 0.2
    assert best <= path.duration < shape.duration
    jet = np.abs(sampled(path.plan, 3)[:, 0]).max(axis=1)
    assert (jet[1:] <= np.array([1.0, 2.0, 10.0]) * (1 + 1e-11)).all()


def crane_force(plan):
    """F along a plan of the load, with D of (15b) differentiated numerically on samples of its closed form."""
    t = np.linspace(plan.start, plan.end, 20_001)
    x, z = plan.jet(t, 2).transpose(1, 0, 2)
    hoist = 9.81 - z[2]
    trolley = x[0] - (0.25 * np.hypot(x[2], hoist) - z[0] * x[2]) / hoist
    step = t[1] - t[0]
    rate = (trolley[:-4] - 8 * trolley[1:-3] + 8 * trolley[3:-1] - trolley[4:]) / (12 * step)
    second = (-trolley[:-4] + 16 * trolley[1:-3] - 30 * trolley[2:-2] + 16 * trolley[3:-1] - trolley[4:]) / (
        12 * step**2
    )
    return 5000.0 * second + 20.0 * rate + 500.0 * x[2, 2:-2]


@pytest.mark.slow
@pytest.mark.parametrize("force", [30e3, pytest.param(2e3, marks=pytest.mark.slow)])
def test_crane_forces_are_within_limits_with_the_new_time_law(force):
    limits = {"F": force, "C": (-3e3, 1e3), "theta": 0.5}
    shape, path = fastest(HOIST, limits, CRANE), fastest(HOIST, limits, CRANE, hold="path")
    assert path.duration < 0.95 * shape.duration
    check_four_continuous_derivatives(law_of(path.plan))
    found = crane_force(path.plan)
    # Finite differences of a force have rounding errors.
    assert np.abs(found).max() == pytest.approx(force, rel=1e-3)
    assert path.active.bound.name == "F"
    assert path.active.fraction == pytest.approx(0.0, abs=1e-9)
    for name, values in CRANE.quantities(sampled(path.plan, 4)).items():
        if name in limits:
            low, high = (-limits[name], limits[name]) if name != "C" else limits[name]
            assert low * (1 + 1e-11) <= values.min()
            assert values.max() <= high * (1 + 1e-11)
    assert np.abs(CRANE.quantities(sampled(path.plan.retime(path.duration * (1 - 1e-4)), 4))["F"]).max() > force
    ends = path.plan.jet([path.plan.start, path.plan.end], 4)
    np.testing.assert_allclose(ends[0].T, [[0, 10], [20, 11]], atol=1e-12)
    np.testing.assert_allclose(ends[1:], 0.0, atol=1e-9)


@pytest.mark.slow
def test_sway_is_limited_on_the_path():
    path = fastest(PLANS["obstacle"], {"theta": 0.08, "velocity": 3.0}, CRANE, hold="path")
    x, z = sampled(path.plan, 2).transpose(1, 0, 2)
    assert np.abs(np.arctan2(-x[2], 9.81 - z[2])).max() <= 0.08 * (1 + 1e-11)
    assert max(np.abs(x[1]).max(), np.abs(z[1]).max()) <= 3.0 * (1 + 1e-11)
    assert path.duration < fastest(PLANS["obstacle"], {"theta": 0.08, "velocity": 3.0}, CRANE).duration


@pytest.mark.slow
def test_position_limits_stay_what_they_are():
    plan = PLANS["nominal"]
    found = fastest(plan, {"x": (0, 20), "z": (10, 11), "x_d1": 2.0, "x_d2": 0.5}, hold="path")
    assert trapezoid(20.0, 2.0, 0.5) <= found.duration <= 1.004 * trapezoid(20.0, 2.0, 0.5)
    # The path is held, and its positions with it: limits that it touches leave the time law as it is.
    assert found.duration == pytest.approx(fastest(plan, {"x_d1": 2.0, "x_d2": 0.5}, hold="path").duration, rel=1e-9)
    with pytest.raises(ValueError, match="limits must be satisfied at rest"):
        fastest(plan, {"x": (0, 19), "x_d1": 2.0}, hold="path")


@pytest.mark.slow
def test_the_plan_is_saved_with_its_time_law(tmp_path):
    found = found_on_path("nominal").plan
    found.save(tmp_path / "plan.json")
    again = cp.load_trajectory(tmp_path / "plan.json")
    t = np.linspace(found.start, found.end, 101)
    np.testing.assert_array_equal(again(t), found(t))


@pytest.mark.slow
@examples(5)
@given(size=st.floats(1e-3, 1e3), duration=st.floats(1e-3, 1e3), start=st.sampled_from([0.0, -50.0, 100.0]))
def test_the_fastest_plan_is_invariant_under_units_and_time_shifts(size, duration, start):
    plan = (size * move("quintic")).retime(duration).shift(start)
    limits = {"y_d1": size * 1.0, "y_d2": size * 1.0}
    found = fastest(plan, limits, hold="path")
    assert trapezoid(1.0, 1.0, 1.0) <= found.duration <= 1.004 * trapezoid(1.0, 1.0, 1.0)
    assert found.plan.start == start
