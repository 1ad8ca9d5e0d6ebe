"""Durations, times and values near the ends of floating point: right, or an error that says what is lost."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ctrlplan as cp
from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    Retimed,
    SCurve,
    Shaper,
    Step,
    Transition,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
)

pytestmark = pytest.mark.every_combination

REST = [Waypoint(0, 0, 0, 0), Waypoint(10, 1, 0, 0)]
MOVING = [Waypoint(0, 0, 0, 0), Waypoint(4, 1, 0.5, 0.25), Waypoint(10, 1, 0, 0)]
QUINTIC = PolySpline(REST)
SMALLEST = pytest.param(
    5e-324, marks=pytest.mark.skipif(np.__version__ < "2", reason="numpy 1.26 warns of overflow in places it pads")
)
PLANS = {
    "TrigSpline": TrigSpline(REST, alpha=1.0),
    "PolySpline": PolySpline(MOVING),
    "PiecewiseSpline": PiecewiseSpline(MOVING, alpha=1.0),
    "free": PiecewiseSpline([REST[0], Waypoint(4, 1), REST[1]]),
    "cyclic": TrigSpline.cyclic(MOVING[:2], 10.0),
    "SCurve": SCurve(1.0, velocity=1, acceleration=1, jerk=1),
    "Trapezoid": Trapezoid(1.0, velocity=1, acceleration=1),
    "Sum": QUINTIC + PolySpline(MOVING),
    "Scaled": 2.0 * QUINTIC,
    "Stacked": stack([QUINTIC, PolySpline(MOVING)], ["a", "b"]),
    "Joined": QUINTIC.then(QUINTIC * 0.5 + Step(1.0, 1.0)),
    "Shaped": Shaper.zv(1.0)(QUINTIC),
    "Retimed": Retimed(PolySpline(MOVING), PolySpline([Waypoint(0, 0), Waypoint(3, 10)])),
}


def attempt(make):
    """What a call returns, or None and its message."""
    try:
        return make(), ""
    except ValueError as error:
        return None, str(error)


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("exponent", [-300, -160, -150, -100, -20, 20, 100, 150, 160, 300])
def test_any_duration_is_right_or_rejected(name, exponent):
    """The path at the same part of the duration, and its first derivative, by the chain rule."""
    plan, duration = PLANS[name], 10.0**exponent
    moved, said = attempt(lambda: plan.retime(duration))
    if moved is None:
        assert "floating point" in said or (name == "Shaped" and "a shaped plan must keep its duration" in said)
        return
    part = np.array([0.1, 0.3, 0.55, 0.8])
    size = np.abs(plan(np.linspace(plan.start, plan.end, 101))).max()
    before, after = plan.start + part * plan.duration, moved.start + part * moved.duration
    assert np.abs(moved(after) - plan(before)).max() <= 1e-9 * size
    rate = plan.duration / duration
    if 1e-290 < rate < 1e290:
        slopes = moved(after, 1) / rate
        assert np.abs(slopes - plan(before, 1)).max() <= 1e-8 * np.abs(plan(before, 1)).max()


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("dt", [1e300, -1e300, 1e17, 3e15, 1e13, 1e11, 1e9 / 3])
@pytest.mark.filterwarnings("ignore:intervals of the plan must be representable")
def test_any_shift_is_right_or_rejected(name, dt):
    """Up to the resolution of times there, as long as that is below 1e-3 of an interval."""
    plan = PLANS[name]
    moved, said = attempt(lambda: plan.shift(dt))
    if moved is None:
        assert "increase strictly" in said or "intervals" in said or "acceleration phase" in said
        return
    resolution = np.spacing(abs(dt) + plan.duration)
    part = np.linspace(0.05, 0.95, 7)
    before, after = plan.start + part * plan.duration, moved.start + part * moved.duration
    speed = np.max(plan.peak(1))
    assert np.abs(moved(after) - plan(before)).max() <= 1e-2 * np.max(plan.peak(0)) + 4 * resolution * speed


def test_the_rounding_of_late_times_is_stated():
    plan = PiecewiseSpline([Waypoint(0, 0, 0), Waypoint(0.003, 1, 3), Waypoint(1, 0, 0)])
    at = 1.7e9  # seconds since 1970: 0.003 s is 12,582.9 units in the last place
    error = abs(Fraction(at + 0.003) - Fraction(at) - Fraction(0.003)) / Fraction(0.003)
    with pytest.warns(UserWarning, match="must be representable, got an error of") as caught:
        moved = plan.shift(at)
    said = float(str(caught[0].message).split("error of ")[1].split(" ")[0])
    assert caught[0].filename == __file__
    assert said == pytest.approx(float(error), rel=0.1)
    with pytest.raises(ValueError, match=r"intervals of the plan must be representable, got an error of 0\.0?\d+ of"):
        plan.shift(1e4 * at)
    with pytest.raises(ValueError, match="intervals of the plan must be representable"):
        moved.then(PolySpline([Waypoint(0, 0, 0), Waypoint(1e-6, 1, 0), Waypoint(1e-5, 2)], warn=False))
    late = PolySpline([Waypoint(1e9, 0, 0), Waypoint(1e9 + 1, 1, 0)])
    with pytest.raises(ValueError, match="intervals of the plan must be representable"):
        late.retime(1e-6)


@pytest.mark.parametrize("duration", [1e155, 1e160, 1e300, 1e-155, 1e-160, 1e-300, SMALLEST])
@pytest.mark.parametrize("spline", [PolySpline, PiecewiseSpline, lambda points: TrigSpline(points, alpha=1.0)])
def test_durations_whose_powers_overflow(spline, duration):
    with pytest.raises(ValueError, match="floating point, got"):
        spline([Waypoint(0, 0, 0, 0), Waypoint(duration, 1, 0, 0)])
    line = spline([Waypoint(0, 0), Waypoint(duration, 1)])
    assert float(line(duration)) == pytest.approx(1.0, rel=1e-15)


def test_free_entries_over_such_durations():
    """A filled-in velocity that overflowed to nan would count as free."""
    with pytest.raises(ValueError, match="floating point"):
        PiecewiseSpline([Waypoint(0, 0, 0, 0), Waypoint(5e159, 1), Waypoint(1e160, 0, 0, 0)])


def test_entries_that_would_vanish_or_overflow_are_no_free_ones():
    point = Waypoint(1, 0.0, 0.0, 1.0)
    for rate in (1e200, 1e-200):
        with pytest.raises(ValueError, match=r"derivatives must stay within floating point, got 1 times .* power 2"):
            point.scaled(1.0, rate)
    still = Waypoint(1, 3.0, 0.0, 0.0).scaled(1.0, 1e200)
    np.testing.assert_array_equal(still.jet, [[3.0], [0.0], [0.0]])


@pytest.mark.parametrize("spline", [PolySpline, PiecewiseSpline])
@pytest.mark.parametrize(("duration", "order"), [(1e-3, 97), (1e-3, 100), (1e-9, 50), (1e-50, 9), (1e9, 100)])
@pytest.mark.parametrize("share", [0.5, [0.5], np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, 500)], ids=np.size)
def test_derivatives_above_the_degree_are_0(spline, duration, order, share):
    plan = spline([Waypoint(0, [0, 1], 0, 0), Waypoint(duration, [1, 5], 0, 0)])
    jet = plan.jet(np.multiply(share, duration), order)
    np.testing.assert_array_equal(jet[6:], 0.0)
    assert np.isfinite(jet).all()
    assert jet[5] * duration**5 == pytest.approx(np.multiply.outer([720.0, 2880.0], np.ones_like(share)), rel=1e-12)


def test_derivatives_beyond_floating_point():
    plan = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1e-70, 1, 0, 0)])
    assert float(plan(5e-71, 1)) == pytest.approx(1.875e70, rel=1e-14)
    for call in (lambda: plan.jet(0.0, 5), lambda: plan(0.0, 5), lambda: plan.series(0.0, 5)):
        with pytest.raises(ValueError, match="derivative 5 must stay within floating point, got a duration of 1e-70 s"):
            call()
    slow = PolySpline([Waypoint(0, 0), Waypoint(1e150, 1)])
    np.testing.assert_array_equal(slow(5e149, 3), 0.0)


@pytest.mark.parametrize("value", [1e308, 1.7e308])
def test_positions_too_far_apart(value):
    for spline in (PolySpline, PiecewiseSpline):
        with pytest.raises(ValueError, match="floating point"):
            spline([Waypoint(0, -value), Waypoint(1, value)])
    with pytest.raises(ValueError, match="positions must stay within floating point"):
        value * QUINTIC + value * QUINTIC
    with pytest.raises(ValueError, match="positions must stay within floating point"):
        1e300 * (1e300 * QUINTIC)
    with pytest.raises(ValueError, match="factor must be within floating point"):
        QUINTIC * 10**400


def test_horizons_whose_powers_overflow():
    for horizon in (1e-100, 1e100):
        with pytest.raises(ValueError, match="powers of the horizon must stay within floating point"):
            Transition(2, horizon)
    assert Transition(0, 1e-100).horizon == 1e-100


def test_limits_whose_powers_overflow():
    for duration in (1e-300, 1e300):
        for plan in (PLANS["SCurve"], PLANS["Trapezoid"]):
            with pytest.raises(ValueError, match="floating point"):
                plan.retime(duration)


@given(st.floats(-320, 320), st.floats(-320, 320), st.floats(-320, 320))
def test_no_scale_gives_nan(duration, position, velocity):
    """Whatever the exponents: a plan of finite values that meets its ends, or a ValueError."""
    length, far, speed = (float(f"1e{x:.0f}") for x in (duration, position, velocity))
    try:
        first, last = Waypoint(0.0, 0.0, speed), Waypoint(length, far, 0.0)
        plan = cp.PolySpline([first, last], warn=False)
        jets = plan.jet(np.array([0.0, 0.25, 0.5, 1.0]) * length, 1)
    except (ValueError, RuntimeWarning):  # numpy's own, of an overflow
        return
    assert np.isfinite(jets).all()
    size = max(far, speed * length)
    assert abs(jets[0, 0, 0]) <= 1e-12 * size + 1e-300
    assert math.isclose(jets[0, 0, -1], far, rel_tol=1e-12, abs_tol=1e-12 * size)


@pytest.mark.parametrize("name", ["TrigSpline", "PolySpline", "PiecewiseSpline", "free", "cyclic", "Sum"])
@pytest.mark.parametrize("factor", [1.0, 1e100])
@pytest.mark.parametrize("exponent", [-160, -60, 60, 160])
def test_derivatives_at_fractions_of_segments_fail_where_those_at_times_do(name, exponent, factor):
    plan, _ = attempt(lambda: factor * PLANS[name].retime(10.0**exponent))
    if plan is None:  # the plan itself is no number
        return
    fractions = np.array([0.25, 0.5, 0.9])
    times = plan.breakpoints[:-1, None] + np.diff(plan.breakpoints)[:, None] * fractions
    for nu in (1, 2):
        found, message = attempt(lambda nu=nu: plan.at_fractions(fractions, nu))
        wanted, said = attempt(lambda nu=nu: plan.jet(times, nu)[nu])
        assert message == said
        if wanted is not None:
            assert (np.abs(found - wanted) <= 1e-11 * np.abs(wanted).max()).all()
