"""Limits by position of quantities on a fixed path: dense samples, closed forms, and laws under limits of axes."""

import numpy as np
import pytest
from scipy.integrate import quad

import ctrlplan as cp
from ctrlplan import Limits, Waypoint, fastest
from ctrlplan.planning.limits import Limited
from ctrlplan.studies.crane import CRANE

REST = [0.0] * 4
LIFT = cp.PolySpline(
    [Waypoint.from_jets(0, x=[0, *REST], z=[9, *REST]), Waypoint.from_jets(12, x=[14, *REST], z=[7.5, *REST])]
)
CURVE = cp.PolySpline(
    [Waypoint(0, [0, 0], 0, 0), Waypoint(1.3, [1.1, 0.4]), Waypoint(2.9, [2, -0.8], 0, 0)], labels=["x", "z"]
)
ALONG = [0.0, 1.4, 2.9]


def motion(jet):
    return {
        "speed": np.hypot(jet[1, 0], jet[1, 1]),
        "effort": 0.6 * jet[2, 0] - 0.3 * jet[2, 1] + 0.2 * jet[1, 0],
        "along x": jet[2, 0],
    }


def at_samples(found, given, system):
    """Quantities at 200001 times, and the times of the given plan at the same positions."""
    plan = found.plan
    t = np.linspace(plan.start, plan.end, 200_001)
    if isinstance(plan, cp.Retimed):
        s = given.start + (plan.law(t) - plan.plan.start) * given.duration / plan.plan.duration
    else:  # no other law is needed
        s = given.start + (t - plan.start) * given.duration / plan.duration
    np.testing.assert_allclose(plan(t[::500]), given(np.clip(s[::500], given.start, given.end)), atol=1e-9)
    return system(plan.jet(t, 6)), s


def check(found, given, system, name, low, high):
    """The limits are satisfied at all samples, attained at one, and the margin is that of the samples."""
    values, s = at_samples(found, given, system)
    size = np.max(high(s) - low(s)) / 2
    room = np.minimum(high(s) - values[name], values[name] - low(s)) / size
    assert room.min() >= -1e-8
    assert found.margins.satisfied
    row = next(row for row in found.margins if row.bound.name == name)
    assert row.fraction == pytest.approx(room.min(), abs=2e-5)
    assert room.min() < 1e-3


def between(times, values):
    return lambda s: np.interp(s, times, values)


@pytest.mark.parametrize(
    ("name", "times", "values"),
    [
        ("theta", [0.0, 12.0], [0.08, 0.015]),
        ("theta", [0.0, 5.0, 8.0, 12.0], [0.03, 0.09, 0.02, 0.05]),
        ("F", [0.0, 12.0], [900.0, 2500.0]),
    ],
)
def test_a_crane_under_limits_by_position(name, times, values):
    high = between(times, values)
    found = fastest(LIFT, {name: Limits([-v for v in values], values, along=times)}, CRANE, hold="path")
    check(found, LIFT, CRANE.quantities, name, lambda s: -high(s), high)
    loosest, strictest = (fastest(LIFT, {name: v}, CRANE, hold="path") for v in (max(values), min(values)))
    assert loosest.duration < found.duration < strictest.duration
    assert (
        found.duration
        < fastest(
            LIFT, {name: found.bound_of(name)} if hasattr(found, "bound_of") else {name: min(values)}, CRANE
        ).duration
    )


@pytest.mark.slow
def test_functions_of_the_time_of_the_given_plan():
    def high(t):
        return 1500 - 400 * np.sin(t / 3)

    found = fastest(LIFT, {"F": Limits(high=high, low=lambda t: -1.2 * high(t))}, CRANE, hold="path")
    check(found, LIFT, CRANE.quantities, "F", lambda s: -1.2 * high(s), high)


def test_intervals_of_the_given_plan():
    limits = {"theta": [Limits(-0.08, 0.08), Limits(-0.02, 0.03, during=(4.0, 7.5))]}
    found = fastest(LIFT, limits, CRANE, hold="path")
    values, s = at_samples(found, LIFT, CRANE.quantities)
    inside = (s > 4.0) & (s < 7.5)
    assert np.abs(values["theta"]).max() <= 0.08 * (1 + 1e-8)
    assert values["theta"][inside].min() >= -0.02 * (1 + 1e-8)
    assert values["theta"][inside].max() <= 0.03 * (1 + 1e-8)
    assert np.abs(values["theta"][~inside]).max() > 0.078
    slow, fast = (fastest(LIFT, {"theta": limit}, CRANE, hold="path").duration for limit in ((-0.02, 0.03), 0.08))
    assert fast < found.duration < slow


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1800.0, 400.0])
def test_limits_that_do_not_change_are_constant_ones(limit):
    expected = fastest(LIFT, {"F": limit}, CRANE, hold="path").duration
    for same in (
        Limits([-limit, -limit], [limit, limit], along=[0.0, 12.0]),
        Limits(-limit, limit, during=(-1.0, 13.0)),
        Limits(high=lambda t: limit + 0 * t, low=lambda t: -limit + 0 * t),
    ):
        assert fastest(LIFT, {"F": same}, CRANE, hold="path").duration == pytest.approx(expected, rel=1e-9)


def test_a_limit_of_the_speed_alone_is_attained_everywhere():
    high = between(ALONG, [1.0, 0.25, 0.8])
    found = fastest(CURVE, {"speed": Limits(high=[1.0, 0.25, 0.8], along=ALONG)}, motion, hold="path")
    check(found, CURVE, motion, "speed", lambda s: -high(s), high)
    shortest = quad(lambda s: np.hypot(*CURVE(s, 1)) / high(s), 0, 2.9, points=[1.3, 1.4], epsrel=1e-10)[0]
    assert shortest <= found.duration <= 1.02 * shortest


@pytest.mark.parametrize("values", [[1.0, 0.2, 0.7], [0.3, 1.5, 0.4]])
def test_a_quantity_that_is_a_derivative_has_the_law_of_the_derivative(values):
    limit = Limits([-v for v in values], values, along=ALONG)
    others = {"velocity": 0.9, "z_d2": 1.5}
    found = fastest(CURVE, others | {"along x": limit}, motion, hold="path")
    expected = fastest(CURVE, others | {"x_d2": limit}, hold="path")
    high = between(ALONG, values)
    check(found, CURVE, motion, "along x", lambda s: -high(s), high)
    assert found.duration == pytest.approx(expected.duration, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 300.0, -40.0])
@pytest.mark.parametrize("pace", [1.0, 1e-4, 1e5])
def test_starts_and_durations_of_the_given_plan_do_not_matter(start, pace):
    given = CURVE.retime(2.9 * pace).shift(start)
    times, high = start + pace * np.array(ALONG), between(ALONG, [1.0, 0.3, 0.7])
    limits = {"effort": Limits([-1.0, -0.3, -0.7], [1.0, 0.3, 0.7], along=times)}
    found = fastest(given, limits, motion, hold="path")
    assert found.plan.start == pytest.approx(start, abs=1e-9)
    values, s = at_samples(found, given, motion)
    u = (s - start) / pace
    assert (np.abs(values["effort"]) - high(u)).max() <= 1e-7
    first = fastest(CURVE, {"effort": Limits([-1.0, -0.3, -0.7], [1.0, 0.3, 0.7], along=ALONG)}, motion, hold="path")
    assert found.duration == pytest.approx(first.duration, rel=2e-3)


@pytest.mark.slow
def test_a_plan_with_a_time_law_has_its_own_times():
    given = fastest(CURVE, {"effort": 0.5}, motion, hold="path").plan
    times, high = [0.0, given.duration], between([0.0, given.duration], [0.2, 0.9])
    found = fastest(given, {"effort": Limits([-0.2, -0.9], [0.2, 0.9], along=times)}, motion, hold="path")
    check(found, given, motion, "effort", lambda s: -high(s), high)


@pytest.mark.parametrize("ends", ["free", "given"])
def test_ends_in_motion(ends):
    given = cp.PolySpline(
        [Waypoint(1, [0, 0], [0.4, 0.2], 0), Waypoint(3, [1, 0.8]), Waypoint(5, [2, 0], [0.3, -0.2], 0)],
        labels=["x", "z"],
    )
    high = between([1.0, 2.5, 5.0], [1.0, 0.55, 0.9])
    limits = {"speed": Limits(high=[1.0, 0.55, 0.9], along=[1.0, 2.5, 5.0]), "effort": 0.8}
    found = fastest(given, limits, motion, hold="path", ends=ends)
    values, s = at_samples(found, given, motion)
    assert (values["speed"] - high(s)).max() <= 1e-8
    assert np.abs(values["effort"]).max() <= 0.8 * (1 + 1e-8)
    assert found.margins.satisfied
    if ends == "given":
        np.testing.assert_allclose(found.plan.jet(1.0, 1)[1], [0.4, 0.2], atol=1e-9)
        np.testing.assert_allclose(found.plan.jet(found.plan.end, 1, left=True)[1], [0.3, -0.2], atol=1e-9)


def test_durations_that_are_given():
    limits = {"effort": Limits([-1.0, -0.3, -0.7], [1.0, 0.3, 0.7], along=ALONG)}
    shortest = fastest(CURVE, limits, motion, hold="path").duration
    found = fastest(CURVE, limits, motion, hold="path", durations=(1.5 * shortest, 4 * shortest))
    assert found.duration == pytest.approx(1.5 * shortest)
    values, s = at_samples(found, CURVE, motion)
    assert (np.abs(values["effort"]) - between(ALONG, [1.0, 0.3, 0.7])(s)).max() < 0
    with pytest.raises(ValueError, match="limits must be satisfied for some duration"):
        fastest(CURVE, limits, motion, hold="path", durations=(0.2 * shortest, 0.5 * shortest))


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 6])
def test_higher_derivatives_of_an_axis(order):
    move = cp.PolySpline([Waypoint.from_jets(0, y=[0.0] * 7), Waypoint.from_jets(3, y=[2.0] + [0.0] * 6)])
    high = between([0.0, 3.0], [30.0, 4.0])
    found = fastest(move, {f"y_d{order}": Limits([-30.0, -4.0], [30.0, 4.0], along=[0.0, 3.0])}, hold="path")
    values, s = at_samples(found, move, lambda jet: jet[order, 0])
    assert found.margins.satisfied
    assert (np.abs(values) - high(s)).max() <= 1e-7
    assert (np.abs(values) - high(s)).max() > -0.05
    loosest, strictest = (fastest(move, {f"y_d{order}": v}, hold="path").duration for v in (30.0, 4.0))
    assert loosest < found.duration < strictest


def test_margins_at_positions_are_those_of_samples():
    law = cp.PolySpline([Waypoint(0, 0, 0.3), Waypoint(2, 1.0), Waypoint(5, 2.9, 1.1)])
    plan = cp.Retimed(CURVE, law)
    t = np.linspace(0, 5, 400_001)
    s, effort = law(t), motion(plan.jet(t, 2))["effort"]
    for limit, low, high in [
        (Limits([-1.0, -0.3, -0.7], [1.0, 0.3, 0.7], along=ALONG), between(ALONG, [-1.0, -0.3, -0.7]), None),
        (Limits(-0.4, 0.5, during=(0.7, 2.0)), lambda s: -0.4 + 0 * s, lambda s: 0.5 + 0 * s),
    ]:
        upper = high or (lambda s, low=low: -low(s))
        inside = (s >= 0.7) & (s <= 2.0) if limit.during else np.full(s.shape, True)
        limited = Limited(CURVE, {"effort": limit}, motion).at_positions()
        row = limited.margins(plan).active
        beyond = np.maximum(effort - upper(s), low(s) - effort)[inside]
        assert row.fraction * row.bound.scale == pytest.approx(-beyond.max(), abs=1e-8)
        assert row.time == pytest.approx(t[inside][beyond.argmax()], abs=1e-3)


def test_what_a_position_does_not_limit_is_rejected():
    with pytest.raises(ValueError, match="must be local in time, got those of RMS of effort"):
        fastest(CURVE, {"effort": Limits(rms=1.0)}, motion, hold="path")
    with pytest.raises(ValueError, match="at rest"):
        fastest(CURVE, {"speed": Limits(low=[0.1, -1.0], high=[1.0, 1.0], along=[0.0, 2.9])}, motion, hold="path")
