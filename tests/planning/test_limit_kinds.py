"""Limits of rates, root mean squares, regions, intervals and tables, against closed forms and dense samples."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan import Limits, Region, Waypoint, fastest, margins

MOVE = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
"""10 t^3 - 15 t^4 + 6 t^5."""
PLANE = cp.PolySpline([Waypoint(1.0, [0, 2], 0, 0), Waypoint(1.6, [1, 3], None), Waypoint(3.0, [2, -1], 0, 0)])
CRANE_MOVE = cp.PolySpline(
    [
        Waypoint.from_jets(0, x=[0.0] * 5, z=[10.0, 0, 0, 0, 0]),
        Waypoint.from_jets(12, x=[8.0, 0, 0, 0, 0], z=[7.0, 0, 0, 0, 0]),
    ]
)


def squared(jet):
    """A quantity of first order."""
    return {"power": jet[1, 0] ** 2, "speed": np.hypot(jet[1, 0], 0.1)}


def only(found):
    (row,) = found
    return row


# Values


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda: Limits(math.nan, 1.0), "Limits must be a number, got nan"),
        (lambda: Limits(2.0, 1.0), "Limits must increase, got 2 and 1"),
        (lambda: Limits(1.0, 1.0), "Limits must increase, got 1 and 1"),
        (lambda: Limits(), "Limits must contain a finite one"),
        (lambda: Limits(rate=-1.0), "rate must be finite and above 0"),
        (lambda: Limits(rate=(1.0, 2.0)), "rate must include 0, the value at rest"),
        (lambda: Limits(rate=(2.0, 1.0)), "rate must increase"),
        (lambda: Limits(rms=0.0), "rms must be finite and above 0"),
        (lambda: Limits(rms=math.nan), "rms must be finite"),
        (lambda: Limits(1.0, 2.0, period=1.0), "period must be that of an rms limit"),
        (lambda: Limits(rms=1.0, period=-1.0), "period must be finite and above 0"),
        (lambda: Limits(rms=1.0, during=(0.0, 1.0)), "during must be given with low, high or rate"),
        (lambda: Limits(1.0, 2.0, during=(1.0, 1.0)), "during must increase"),
        (lambda: Limits(1.0, 2.0, during=(0.0, math.inf)), "during must be two finite times"),
        (lambda: Limits(1.0, 2.0, during=3.0), "during must be two numbers"),
        (lambda: Limits(high=[1.0, 2.0]), "high must be one number unless times are given by along="),
        (lambda: Limits(np.array([-1.0]), 1.0), "low must be one number unless times are given by along="),
        (lambda: Limits(high=[1.0, 2.0], along=[0.0]), "along must be two or more finite times"),
        (lambda: Limits(high=[1.0, 2.0], along=[1.0, 0.0]), "along must be two or more finite times that increase"),
        (lambda: Limits(high=[1.0, 2.0, 3.0], along=[0.0, 1.0]), "high must be a finite number, or 2 of them"),
        (lambda: Limits(high=[1.0, math.nan], along=[0.0, 1.0]), "high must be a finite number, or 2 of them"),
        (lambda: Limits([0.0, 3.0], [1.0, 2.0], along=[0.0, 1.0]), r"got 2 and 3 at along\[1\] = 1 s"),
        (lambda: Limits([0.0, 2.0], [1.0, 2.0], along=[0.0, 1.0]), r"high must be above low at all times"),
        (lambda: Limits(rms=1.0, along=[0.0, 1.0]), "along must be given with low or high"),
        (lambda: Limits(high=np.sin, along=[0.0, 1.0]), "along must be given with values at its times"),
        (lambda: Region(("a", "b"), [(0, 0), (1, 0)]), r"shape \(n, 2\) with n of at least 3"),
        (lambda: Region(("a", "b"), [(0, 0), (1, 0), (1, math.nan)]), "vertices must be finite"),
        (lambda: Region(("a", "b"), [(0, 0), (1, 1), (2, 2)]), "vertices must enclose an area"),
        (lambda: Region(("a", "b"), [(0, 0), (1, 0), (2, 0)]), "vertices must enclose an area"),
        (lambda: Region(("a", "b"), [(0, 0), (2, 0), (0.5, 0.5), (0, 2)]), r"turned inwards at vertices\[2\]"),
        (lambda: Region(("a", "b"), [(0, 0), (1, 1), (1, 0), (0, 1)]), "vertices must"),
        (lambda: Region(("a", "b"), [(0, 0), (0, 0), (1, 0), (0, 1)]), "vertices must be different"),
        (lambda: Region(("a", "b"), [(1, 0), (-0.8, 0.6), (0.3, -1), (0.3, 1), (-0.8, -0.6)]), "once, in order"),
        (lambda: Region(("a", "a"), [(0, 0), (1, 0), (0, 1)]), "signals must be different"),
    ],
)  # fmt: skip
def test_limits_that_are_none(made, message):
    with pytest.raises(ValueError, match=message):
        made()


@pytest.mark.parametrize("signals", ["ab", ("a",), ("a", "b", "c"), (1, 2), None])
def test_a_region_is_of_two_names(signals):
    with pytest.raises(TypeError, match="signals must be two names"):
        Region(signals, [(0, 0), (1, 0), (0, 1)])


def test_limits_are_immutable_and_equal_by_value():
    given = Limits(np.array([0.0, 1.0]), 3.0, along=np.array([0.0, 1.0]), rate=(None, 2.0))
    assert given == Limits([0, 1], [3, 3], along=(0, 1), rate=(None, 2))
    assert hash(given) == hash(Limits([0, 1], [3, 3], along=(0, 1), rate=(None, 2)))
    assert repr(Limits(-1, 2, rms=3, period=4)) == "Limits(low=-1.0, high=2.0, rms=3.0, period=4.0)"
    corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    region = Region(["a", "b"], corners)
    corners[0][0] = 9.0
    assert region.vertices == ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    with pytest.raises(AttributeError):
        given.low = 0.0


# Rate


def test_the_rate_of_a_derivative_is_the_next_one():
    row = only(margins(MOVE, {"y_d1": Limits(rate=(-7.0, 6.0))}))
    assert row.bound.name == "rate of y_d1"
    assert row.value == pytest.approx(10 / math.sqrt(3), rel=1e-12)
    assert row.fraction == pytest.approx((6 - 10 / math.sqrt(3)) / 6.5, rel=1e-10)
    assert margins(MOVE, {"velocity": Limits(2.0 * -1, 2.0, rate=7.0)}).rows[0].bound.name == "y_d1"


def test_the_rate_of_a_quantity_is_that_of_its_closed_form():
    """d/dt v^2 = 2 v a of the quintic, and of hypot(v, 0.1)."""
    t = np.linspace(0, 1, 200_001)
    v, a = MOVE(t, 1), MOVE(t, 2)
    found = {row.bound.name: row for row in margins(MOVE, {n: Limits(rate=9.0) for n in ("power", "speed")}, squared)}
    assert abs(found["rate of power"].value) == pytest.approx(np.abs(2 * v * a).max(), rel=1e-8)
    assert abs(found["rate of speed"].value) == pytest.approx(np.abs(v * a / np.hypot(v, 0.1)).max(), rel=1e-8)


@pytest.mark.slow
def test_the_rate_of_the_force_of_a_crane():
    crane = cp.plants.Crane()
    row = only(margins(CRANE_MOVE, {"F": Limits(rate=1e4)}, crane))
    t = np.linspace(0, 12, 20_001)
    h = 1e-4
    ahead, behind = (crane.quantities(CRANE_MOVE.segment_jet(0, t + s, 4))["F"] for s in (h, -h))
    assert abs(row.value) == pytest.approx(np.abs((ahead - behind) / (2 * h)).max(), rel=1e-6)
    assert fastest(CRANE_MOVE, {"F": Limits(rate=500.0)}, crane).active.bound.name == "rate of F"


def test_a_rate_of_what_jumps_is_an_error():
    bent = cp.PiecewiseSpline([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, 0)])
    profile = cp.Trapezoid(1.0, velocity=1.0, acceleration=2.0)
    with pytest.raises(ValueError, match="limits of rate of y_d1 require a plan that is continuous up to derivative 1"):
        margins(bent, {"y_d1": Limits(rate=1.0)})
    with pytest.raises(ValueError, match="limits of rate of power require"):
        margins(bent, {"power": Limits(rate=1.0)}, squared)
    assert margins(profile, {"y_d1": Limits(rate=3.0)}).satisfied


# Root mean square


def test_the_root_mean_square_of_the_quintic_in_closed_form():
    """The integral of (60 t - 180 t^2 + 120 t^3)^2 is 120/7, that of (30 t^2 - 60 t^3 + 30 t^4)^2 is 10/7."""
    rows = {
        row.bound.name: row for row in margins(MOVE, {"y_d1": Limits(rms=2.0), "y_d2": Limits(rms=5.0, period=3.0)})
    }
    assert rows["RMS of y_d1"].value == pytest.approx(math.sqrt(10 / 7), rel=1e-13)
    assert rows["RMS of y_d2"].value == pytest.approx(math.sqrt(120 / 7 / 3), rel=1e-13)
    assert rows["RMS of y_d2"].fraction == pytest.approx(1 - math.sqrt(40 / 7) / 5, rel=1e-12)
    assert str(rows["RMS of y_d2"]).startswith("RMS of y_d2 at most 5 over 3 s: 2.39046, 52.2 % left")


def test_the_fastest_move_of_an_rms_acceleration_in_closed_form():
    """sqrt(120/7)/T^2 over the move; sqrt(120/7/T^3/P) over a period P."""
    found = fastest(MOVE, {"y_d2": Limits(rms=2.0)})
    assert found.duration == pytest.approx((120 / 7) ** 0.25 / math.sqrt(2.0), rel=1e-9)
    assert found.active.bound.name == "RMS of y_d2"
    period = fastest(MOVE, {"y_d2": Limits(rms=2.0, period=5.0)})
    assert period.duration == pytest.approx((120 / 7 / 5 / 4) ** (1 / 3), rel=1e-9)
    assert period.feasible[-1][1] == pytest.approx(5.0, rel=1e-6)


def test_the_dwell_of_a_quantity_counts():
    """A quantity of 2 at the end of the move, 0 at its start: the mean of (2 y)^2 over 1 s, then 4 for 2 s."""
    t = np.linspace(0, 1, 20_001)
    square = 4 * np.mean(0.5 * (MOVE(t[1:]) ** 2 + MOVE(t[:-1]) ** 2))
    row = only(margins(MOVE, {"weight": Limits(rms=3.0, period=3.0)}, lambda jet: {"weight": 2 * jet[0, 0]}))
    assert row.value == pytest.approx(math.sqrt((square + 8.0) / 3.0), rel=1e-8)


def test_a_period_below_the_duration_is_an_error():
    with pytest.raises(ValueError, match="period of RMS of y_d1 must be at least the duration of the plan, 1 s, got"):
        margins(MOVE, {"y_d1": Limits(rms=1.0, period=0.5)})


def test_a_mean_square_of_noise_is_an_error():
    rng = np.random.default_rng(0)
    with pytest.raises(RuntimeError, match="a mean square must be resolved"):
        margins(MOVE, {"n": Limits(rms=1.0)}, lambda jet: {"n": rng.normal(size=jet.shape[2])})


# Regions


def inside(point, corners):
    """Smallest distance to an edge along its normal, as a fraction of half the extent of the polygon there."""
    corners = np.array(corners, dtype=float)
    found = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        normal = np.array([(end - start)[1], -(end - start)[0]])
        along = corners @ normal
        if along.mean() > start @ normal:
            normal, along = -normal, -along
        found.append((start @ normal - point.T @ normal) / (0.5 * np.ptp(along)))
    return np.min(found, axis=0)


CORNERS = [(1.2, 4.0), (-0.4, 5.0), (-1.5, -3.0), (0.2, -6.5), (1.9, -2.0)]


@pytest.mark.parametrize("corners", [CORNERS, CORNERS[::-1], CORNERS[2:] + CORNERS[:2]])
def test_a_region_against_dense_samples(corners):
    t = np.linspace(0, 1, 100_001)
    dense = inside(np.stack([MOVE(t, 1), MOVE(t, 2)]), corners)
    found = margins(MOVE, {"motor": Region(("y_d1", "y_d2"), corners)})
    assert len(found) == 5
    assert found.active.fraction == pytest.approx(dense.min(), abs=1e-8)
    assert found.active.time == pytest.approx(t[dense.argmin()], abs=1e-4)
    assert found.active.bound.name.startswith("motor: ")


def test_edges_parallel_to_the_axes_are_limits_of_one_signal():
    box = Region(("y_d1", "y_d2"), [(-1, -7), (2, -7), (2, 6), (-1, 6)])
    found = {row.bound.name: row for row in margins(MOVE, {"motor": box})}
    assert set(found) == {"motor: y_d1", "motor: -y_d1", "motor: y_d2", "motor: -y_d2"}
    assert found["motor: y_d1"].fraction == pytest.approx((2 - 15 / 8) / 1.5, rel=1e-10)
    assert found["motor: -y_d2"].fraction == pytest.approx((7 - 10 / math.sqrt(3)) / 6.5, rel=1e-10)


def test_the_fastest_move_in_a_region_touches_its_edge():
    region = Region(("y_d1", "y_d2"), [(0, 3), (1, 0), (0, -3), (-1, 0)])
    found = fastest(MOVE, {"motor": region})
    t = np.linspace(0, found.duration, 100_001)
    dense = inside(np.stack([found.plan(t, 1), found.plan(t, 2)]), region.vertices).min()
    assert -1e-12 <= dense <= 1e-7
    shorter = found.plan.retime(0.999 * found.duration)
    t = np.linspace(0, shorter.duration, 100_001)
    assert inside(np.stack([shorter(t, 1), shorter(t, 2)]), region.vertices).min() < -1e-4


def test_the_names_of_a_region_are_checked():
    with pytest.raises(ValueError, match="got 'torque'"):
        margins(MOVE, {"motor": Region(("y_d1", "torque"), CORNERS)})


# Intervals of time


def test_limits_in_an_interval_of_time():
    """The speed 30 t^2 (1 - t)^2 in (0.6, 0.8) is largest at 0.6: 1.728."""
    row = only(margins(MOVE, {"y_d1": Limits(high=1.8, during=(0.6, 0.8))}))
    assert (row.value, row.time) == (pytest.approx(1.728, rel=1e-13), pytest.approx(0.6, abs=1e-12))
    assert row.bound.range == "at most 1.8 between 0.6 and 0.8 s"
    low = only(margins(MOVE, {"y_d1": Limits(1.0, 2.5, during=(0.3, 0.6))}))
    assert low.value == pytest.approx(30 * 0.09 * 0.49, rel=1e-13)


def test_an_interval_is_stretched_with_the_plan():
    limits = {"y_d1": Limits(high=1.0, during=(0.6, 0.8))}
    found = fastest(MOVE, limits)
    assert found.duration == pytest.approx(1.728, rel=1e-9)
    assert found.active.time == pytest.approx(0.6 * 1.728, rel=1e-9)


def test_a_speed_within_a_window_has_durations_on_both_sides():
    """A part is picked from a conveyor: between 0.4 and 0.6 of the move the speed must be 0.5 to 0.7."""
    found = fastest(MOVE, {"y_d1": Limits(0.5, 0.7, during=(0.4, 0.6))})
    assert len(found.feasible) == 1
    assert found.feasible[0] == pytest.approx((1.875 / 0.7, 1.728 / 0.5), rel=1e-9)


def test_an_interval_of_a_quantity():
    row = only(margins(MOVE, {"power": Limits(high=4.0, during=(0.0, 0.3))}, squared))
    assert row.value == pytest.approx((30 * 0.09 * 0.49) ** 2, rel=1e-9)


@pytest.mark.parametrize("during", [(2.0, 3.0), (-1.0, 0.0), (1.0, 2.0)])
def test_an_interval_outside_of_the_plan_is_an_error(during):
    with pytest.raises(ValueError, match="during of y_d1 must overlap the plan, from 0 to 1 s"):
        margins(MOVE, {"y_d1": Limits(high=1.0, during=during)})


@pytest.mark.parametrize("along", [(2.0, 3.0), (-1.0, 0.0), (1.0, 2.0)])
def test_limits_at_times_outside_of_the_plan_are_an_error(along):
    limits = {"y_d1": Limits(high=[1.0, 1.0], along=along), "y_d2": 5.0}
    with pytest.raises(ValueError, match="along of y_d1 must overlap the plan, from 0 to 1 s, got"):
        margins(MOVE, limits)
    for hold in ("shape", "waypoints", "path"):
        with pytest.raises(ValueError, match="along of y_d1 must overlap the plan, from 0 to 1 s, got"):
            fastest(MOVE, limits, hold=hold)


def test_several_limits_of_one_signal():
    limits = {"y_d1": [Limits(high=1.9), Limits(high=1.0, during=(0.0, 0.2)), Limits(rms=1.3)]}
    found = margins(MOVE, limits)
    assert len(found) == 3
    assert found.to_pandas().shape == (3, 5)
    assert found.active.fraction == pytest.approx((1.9 - 1.875) / 1.9, rel=1e-10)


# Limits over time


@examples(40)
@given(
    st.lists(st.floats(0.5, 3.0), min_size=4, max_size=4),
    st.lists(st.floats(-3.0, -0.5), min_size=4, max_size=4),
    st.floats(0.3, 3.0),
)
def test_a_table_against_dense_samples(high, low, stretch):
    times = [1.1, 1.6, 2.2, 3.0]
    plan = PLANE.retime(2.0 * stretch)
    own = np.union1d(np.linspace(1.1, 3.0, 40_001), times)  # the kinks of the table too
    speed = plan(plan.start + (own - 1.0) * stretch, 1)[0]
    top, bottom = np.interp(own, times, high), np.interp(own, times, low)
    scale = 0.5 * (np.array(high) - np.array(low)).max()
    dense = np.minimum(top - speed, speed - bottom).min() / scale
    given_plan = PLANE
    limited = cp.planning.limits.Limited(given_plan, {"y1_d1": Limits(low, high, along=times)})
    row = only(limited.margins(plan))
    assert row.fraction <= dense + 1e-9
    assert row.fraction == pytest.approx(dense, abs=1e-5 * (1.0 + np.abs(plan.peak(2)).max() / scale))


def test_functions_of_time():
    row = only(margins(MOVE, {"y_d1": Limits(high=lambda t: 2.0 - t)}))
    t = np.linspace(0, 1, 1_000_001)
    gap = 2.0 - t - MOVE(t, 1)
    assert row.fraction * row.bound.scale == pytest.approx(gap.min(), abs=1e-9)
    assert row.time == pytest.approx(t[gap.argmin()], abs=1e-4)
    assert row.value == pytest.approx(MOVE(row.time, 1), rel=1e-9)
    assert row.bound.high == pytest.approx(2.0 - row.time, rel=1e-12)


def test_a_table_is_stretched_with_the_plan():
    """The peak of the ratio of speed and limit is that of the durations."""
    found = fastest(MOVE, {"y_d1": Limits(high=[1.0, 2.0, 1.0], along=[0.0, 0.5, 1.0])})
    t = np.linspace(0, 1, 400_001)
    longest = (MOVE(t, 1) / np.interp(t, [0, 0.5, 1], [1, 2, 1])).max()
    assert found.duration == pytest.approx(longest, rel=1e-8)


@pytest.mark.parametrize("bad", [lambda t: np.array([1.0, 2.0]), lambda t: np.full(t.shape, np.nan)])
def test_functions_that_return_something_else(bad):
    with pytest.raises(ValueError, match=r"high must map times \(ntime,\) to numbers"):
        margins(MOVE, {"y_d1": Limits(high=bad)})


def test_functions_that_cross():
    with pytest.raises(ValueError, match="high must be above low at all times"):
        margins(MOVE, {"y_d1": Limits(low=-1.0, high=lambda t: 0.5 - 2 * t)})


# Where they make no sense


@pytest.mark.parametrize(
    "limit", [Limits(rms=1.0), Limits(high=1.0, during=(0.2, 0.4)), Limits(high=[1.0, 2.0], along=[0.0, 1.0])]
)
def test_a_time_law_requires_limits_that_are_local_in_time(limit):
    if limit.rms:  # limits over time apply at positions
        with pytest.raises(ValueError, match='limits with hold="path" must be local in time'):
            fastest(MOVE, {"y_d1": limit}, hold="path")
    with pytest.raises(ValueError, match="limits of a plan on a cycle must be local in time"):
        MOVE.on_cycle(0.01, {"y_d1": limit})


def test_waypoints_held_with_each_kind():
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(0.5, 0.3), Waypoint(1, 1, 0, 0)])
    limits = {
        "y_d1": Limits(high=1.5, rms=1.1),
        "y_d2": Limits(-4.0, 4.0, during=(0.0, 0.5)),
        "motor": Region(("y_d1", "y_d2"), [(0, 9), (2, 0), (0, -9), (-2, 0)]),
    }
    shape, held = (fastest(plan, limits, hold=hold) for hold in ("shape", "waypoints"))
    assert held.duration == pytest.approx(shape.duration, rel=1e-8)
    assert held.active.bound.name == shape.active.bound.name
