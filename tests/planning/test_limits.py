"""Margins against closed forms of the minimum-jerk move, roots of polynomials and dense samples."""

from math import inf, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.planning import Margin, Margins, margins
from ctrlplan.planning.bounds import limit_words
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints

MOVE = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
OBSTACLE = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
HOIST = cp.PolySpline(nominal_waypoints(5))


def speed(jet):
    return {"speed": np.hypot(jet[1, 0], jet[1, 1])}


def rows(found):
    return {row.bound.name: row for row in found}


def test_minimum_jerk_move_in_closed_form():
    found = rows(margins(MOVE, {"y": 2.0, "y_d1": 2.0, "y_d2": 5.0, "y_d3": 80.0}))
    assert found["y"].fraction == pytest.approx(0.5, abs=1e-14)
    assert found["y"].value == pytest.approx(1.0, abs=1e-14)
    assert found["y_d1"].value == pytest.approx(15 / 8, rel=1e-14)
    assert found["y_d1"].time == pytest.approx(0.5, abs=1e-7)
    assert found["y_d1"].fraction == pytest.approx(1 / 16, rel=1e-12)
    assert abs(found["y_d2"].value) == pytest.approx(10 / sqrt(3), rel=1e-13)
    assert found["y_d2"].fraction == pytest.approx(1 - 2 / sqrt(3), rel=1e-12)
    assert abs(found["y_d2"].time - 0.5) == pytest.approx(1 / sqrt(12), abs=1e-7)


def test_jerk_is_sixty_where_it_starts_and_ends_continuous():
    septic = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(1, 1, 0, 0, 0)])
    # y''' of 35 t^4 - 84 t^5 + 70 t^6 - 20 t^7 is 840 t - 5040 t^2 + 8400 t^3 - 4200 t^4: -105/2 half-way.
    (row,) = margins(septic, {"y_d3": (-50.0, 60.0)})
    assert row.value == pytest.approx(-52.5, rel=1e-12)
    assert row.time == pytest.approx(0.5, abs=1e-7)
    assert row.fraction == pytest.approx(-2.5 / 55, rel=1e-10)


def test_smallest_margin_comes_first():
    found = margins(OBSTACLE, {"velocity": 3.0, "acceleration": 2.0})
    assert [row.fraction for row in found] == sorted(row.fraction for row in found)
    assert found.active is found.rows[0]
    assert len(found) == 4
    assert set(rows(found)) == {"x_d1", "z_d1", "x_d2", "z_d2"}
    assert isinstance(found, Margins)
    assert isinstance(found.active, Margin)


@pytest.mark.parametrize(("word", "nu"), [("position", 0), ("velocity", 1), ("acceleration", 2), ("jerk", 3)])
def test_words_limit_every_axis(word, nu):
    plan = cp.TrigSpline(nominal_waypoints(4), alpha=1.0)
    found = rows(margins(plan, {word: 50.0}))
    names = ["x", "z"] if nu == 0 else [f"x_d{nu}", f"z_d{nu}"]
    assert set(found) == set(names)
    dense = np.abs(plan.jet(np.linspace(0, 15, 100_001), nu)[nu]).max(axis=1)
    for axis, name in enumerate(names):
        assert abs(found[name].value) == pytest.approx(dense[axis], rel=1e-8)
        assert found[name].fraction == pytest.approx(1 - dense[axis] / 50.0, abs=1e-8)


def test_the_fourth_word():
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(2, 1, 0, 0, 0)])
    assert margins(plan, {"jerk": 7.0}).active.bound.name == "y_d3"
    smooth = cp.PolySpline([Waypoint.from_jets(0, y=[0] * 5), Waypoint.from_jets(2, y=[1, 0, 0, 0, 0])])
    dense = np.abs(smooth(np.linspace(0, 2, 100_001), 4)).max()
    assert abs(margins(smooth, {"snap": 1e3}).active.value) == pytest.approx(dense, rel=1e-8)


@pytest.mark.parametrize(
    ("limit", "fraction", "value"),
    [
        (4.0, 1 - 15 / 32, 15 / 8),
        ((-1.0, 3.0), 0.5, 0.0),
        ((-1.0, 2.0), (2 - 15 / 8) / 1.5, 15 / 8),
        ((None, 1.5), -0.25, 15 / 8),
        ((-0.5, None), 1.0, 0.0),
        ((-2.0, inf), 1.0, 0.0),
        ((0.0, None), 0.0, 0.0),
        (np.array([-1.0, 2.0]), (2 - 15 / 8) / 1.5, 15 / 8),
        ([-1, 2], (2 - 15 / 8) / 1.5, 15 / 8),
    ],
)
def test_sides_and_their_scale(limit, fraction, value):
    (row,) = margins(MOVE, {"y_d1": limit})
    assert row.fraction == pytest.approx(fraction, rel=1e-11, abs=1e-11)
    assert row.value == pytest.approx(value, abs=1e-13)


SLOW_FAST = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(1, [1, -2], 0, 0)])
"""Peak speeds 15/8 and 15/4, the second one downwards; both axes lie in one range only one way."""


def fractions(plan, limits):
    return {row.bound.name: (row.bound.low, row.bound.high, row.fraction) for row in margins(plan, limits)}


@pytest.mark.parametrize("kind", [list, np.array, lambda values: np.array(values, dtype=np.float32)])
def test_a_list_of_as_many_numbers_as_axes_is_by_axis(kind):
    found = fractions(SLOW_FAST, {"velocity": kind([2.0, 5.0])})
    assert found["y1_d1"] == (-2.0, 2.0, pytest.approx(1 / 16, rel=1e-11))
    assert found["y2_d1"] == (-5.0, 5.0, pytest.approx(1 / 4, rel=1e-11))


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_pairs_by_axis(kind):
    found = fractions(SLOW_FAST, {"velocity": kind([(-1.0, 3.0), (-4.0, 2.0)])})
    assert found["y1_d1"] == (-1.0, 3.0, pytest.approx(0.5, rel=1e-11))
    assert found["y2_d1"] == (-4.0, 2.0, pytest.approx(0.25 / 3.0, rel=1e-11))
    open_ended = fractions(SLOW_FAST, {"velocity": [[None, 3.0], [-5.0, None]]})
    assert (open_ended["y1_d1"][:2], open_ended["y2_d1"][:2]) == ((-inf, 3.0), (-5.0, inf))


def test_a_tuple_of_two_numbers_is_a_pair_for_every_axis():
    found = fractions(SLOW_FAST, {"velocity": (-5.0, 4.0), "acceleration": (None, 30.0)})
    assert found["y1_d1"][:2] == found["y2_d1"][:2] == (-5.0, 4.0)
    assert found["y1_d2"][:2] == (-inf, 30.0)
    assert found["y2_d1"][2] == pytest.approx((5 - 15 / 4) / 4.5, rel=1e-11)


def test_limits_by_axis_are_those_of_each_axis():
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(2, [1, -2, 3], 0, 0)])
    given = {"velocity": [1.0, 3.0, 4.0], "acceleration": np.array([[-9.0, 8.0], [-7.0, 6.0], [-9.5, 5.0]])}
    named = {"y1_d1": 1.0, "y2_d1": 3.0, "y3_d1": 4.0, "y1_d2": (-9.0, 8.0), "y2_d2": (-7.0, 6.0), "y3_d2": (-9.5, 5.0)}
    assert fractions(plan, given) == fractions(plan, named)


def test_on_one_axis_a_list_of_two_is_a_pair():
    assert fractions(MOVE, {"velocity": [-1.0, 3.0]}) == fractions(MOVE, {"velocity": (-1.0, 3.0)})
    assert fractions(MOVE, {"velocity": [3.0]}) == fractions(MOVE, {"velocity": 3.0})


@pytest.mark.parametrize(
    "limit",
    [[1.0, 2.0, 3.0], (1.0, 2.0, 3.0), [1.0], [[-1.0, 1.0]], np.ones((2, 3)), [[-1, 1], 2.0], [[-1, 1, 2], [1, 2]], []],
)
def test_limits_by_axis_of_another_number_of_axes(limit):
    with pytest.raises(ValueError, match="limits of velocity must be a number, a pair, or 2 numbers or pairs by axis"):
        margins(SLOW_FAST, {"velocity": limit})


@pytest.mark.parametrize("name", ["velocity", "y2_d1", "acceleration"])
@pytest.mark.parametrize("limit", [(1.0, 2.0), (-2.0, -1.0), (0.5, None), (None, -0.5)])
def test_a_derivative_must_be_allowed_to_be_0(name, limit):
    """Which tells a pair from magnitudes by axis that were given as a tuple."""
    with pytest.raises(
        ValueError, match=r"must include 0.*a tuple \(minimum, maximum\).*a list of one number per axis"
    ):
        margins(SLOW_FAST, {name: limit})


@pytest.mark.parametrize("limit", [[-1.0, 2.0], [0.0, 2.0], np.array([1.0, np.nan])])
def test_magnitudes_by_axis_are_above_0(limit):
    with pytest.raises(
        ValueError, match=r"limits of velocity must be finite and above 0, got .*a tuple \(minimum, maxi"
    ):
        margins(SLOW_FAST, {"velocity": limit})


@pytest.mark.parametrize("limit", [[True, 2.0], [None, 2.0], np.array([1, 2], dtype="timedelta64[s]")])
def test_magnitudes_by_axis_are_numbers(limit):
    with pytest.raises(TypeError, match=r"limits of velocity must be (a number|plain numbers)"):
        margins(SLOW_FAST, {"velocity": limit})


def test_a_position_may_have_to_stay_away_from_0():
    plan = cp.PolySpline([Waypoint(0, [3, 4], 0, 0), Waypoint(1, [5, 6], 0, 0)])
    assert fractions(plan, {"position": (2.0, 7.0)})["y1"][:2] == (2.0, 7.0)
    assert fractions(plan, {"position": [[2.0, 6.0], [3.0, 8.0]]})["y2"][:2] == (3.0, 8.0)


def test_hold_says_whether_all_do():
    assert margins(MOVE, {"y_d1": 1.876, "y_d2": 5.78}).satisfied
    assert not margins(MOVE, {"y_d1": 1.876, "y_d2": 5.77}).satisfied
    assert margins(MOVE, {"y_d1": 1.876, "y_d2": 5.77}).active.bound.name == "y_d2"


def test_both_limits_of_a_jump_count():
    # Quintic segments: the jerk may jump at the inner waypoint, and comes to its peak there from the left.
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0.5, 0), Waypoint(4, 0, 0, 0)]
    plan = cp.PiecewiseSpline(points)
    peaks = []
    for a, b in ((0, 1), (1, 4)):
        segment = cp.PolySpline([p for p in points if p.time in (a, b)])
        peaks.append(np.abs(segment(np.linspace(a, b, 10_001), 3)).max())
    with pytest.raises(ValueError, match="limits of y_d4 require a plan that is continuous up to derivative 3"):
        margins(plan, {"y_d4": 1e3})
    assert abs(margins(plan, {"y_d3": 1e3}).active.value) == pytest.approx(max(peaks), rel=1e-12)


# Quantities


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
def test_a_quantity_with_a_narrow_peak(width):
    """A resonance of the place y = 0.37: its height is 5 however fast it is passed."""
    plan = cp.TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(3, 1, 0, 0)], alpha=2.0)
    (row,) = margins(plan, {"load": 4.0}, lambda jet: {"load": 5.0 / (1.0 + ((jet[0, 0] - 0.37) / width) ** 2)})
    assert row.value == pytest.approx(5.0, rel=1e-9)
    assert plan(row.time) == pytest.approx(0.37, abs=1e-3 * width)
    assert row.fraction == pytest.approx(-0.25, rel=1e-8)


def test_a_quantity_that_is_0_but_for_rounding():
    """It is resolved to the size of its limit, not to its own."""
    (row,) = margins(MOVE, {"drift": 1.0}, lambda jet: {"drift": (jet[0, 0] + 1e3) - 1e3 - jet[0, 0]})
    assert row.fraction == pytest.approx(1.0, abs=1e-12)


def test_a_noisy_quantity_has_no_margin():
    noise = np.random.default_rng(0)
    with pytest.raises(RuntimeError, match="function must be resolved"):
        margins(MOVE, {"load": 2.0}, lambda jet: {"load": jet[0, 0] + 1e-4 * noise.normal(size=jet.shape[2])})


def test_a_quantity_is_limited_over_the_whole_interval():
    t = np.linspace(0, 16, 200_001)
    fast = np.linalg.norm(OBSTACLE(t, 1), axis=0)
    (row,) = margins(OBSTACLE, {"speed": 3.0}, speed)
    assert row.value == pytest.approx(fast.max(), rel=1e-9)
    assert row.time == pytest.approx(t[fast.argmax()], abs=1e-3)
    assert row.fraction == pytest.approx(1 - fast.max() / 3.0, abs=1e-8)
    assert row.bound.order == 1
    assert row.bound.axis is None


def test_quantities_of_a_plant():
    limits = {"theta": 0.1, "T": (0, 6e3), "R": (9, 12), "x_d1": 3.0}
    by_plant, by_function = margins(HOIST, limits, CRANE), margins(HOIST, limits, CRANE.quantities)
    assert str(by_plant) == str(by_function)
    x, z = HOIST.jet(np.linspace(0, 15, 100_001), 2).transpose(1, 0, 2)
    hoist = CRANE.gravity - z[2]
    tension, theta = 500 * np.hypot(x[2], hoist), np.arctan2(-x[2], hoist)
    rope = (z[0] * np.hypot(x[2], hoist) - 0.25 * x[2]) / hoist
    found = rows(by_plant)
    assert abs(found["theta"].value) == pytest.approx(np.abs(theta).max(), rel=1e-8)
    assert found["T"].value == pytest.approx(tension.max(), rel=1e-10)
    assert found["R"].value in (pytest.approx(rope.min(), rel=1e-10), pytest.approx(rope.max(), rel=1e-10))
    assert found["R"].fraction == pytest.approx(min(rope.min() - 9, 12 - rope.max()) / 1.5, abs=1e-8)
    assert {name: row.bound.order for name, row in found.items()} == {"theta": 2, "T": 2, "R": 2, "x_d1": 1}


def test_order_of_quantities_is_the_lowest_that_they_need():
    found = rows(margins(HOIST, {"D_d1": 10.0, "F": 1e5, "T_d2": 1e5}, CRANE))
    assert {name: row.bound.order for name, row in found.items()} == {"D_d1": 3, "F": 4, "T_d2": 4}


def test_a_quantity_with_a_kink():
    plan = cp.PolySpline([Waypoint(t, t**3 - t) for t in (-1.5, -0.6, 0.7, 2.0)])
    (row,) = margins(plan, {"size": 5.9}, lambda jet: {"size": np.abs(jet[0, 0] - 0.1)})
    assert row.value == pytest.approx(5.9, rel=1e-12)
    assert row.time == 2.0
    assert row.fraction == pytest.approx(0.0, abs=1e-11)


def test_a_constant_quantity():
    (row,) = margins(MOVE, {"load": (0, 4)}, lambda jet: {"load": np.full(jet.shape[2:], 3.0)})
    assert (row.value, row.fraction) == (3.0, 0.5)


def test_a_plan_that_the_plant_cannot_follow():
    with pytest.raises(ValueError, match="g - z'' must be above 0"):
        margins(HOIST.retime(0.5), {"T": (0, 1e6)}, CRANE)


# Words and tables


def test_margins_in_words():
    found = margins(MOVE, {"y_d1": 2.0, "y_d2": (-5.0, 8.0)})
    first, second = map(str, found)
    assert second == "y_d1 within ±2: 1.875 at 0.5 s, 6.25 % left"
    assert first.startswith("y_d2 from -5 to 8: -5.7735 at 0.788675 s")
    assert first.endswith("% beyond")
    assert repr(found) == f"<Margins of 2 limits: {first}>"
    assert [" ".join(line.split()) for line in str(found).splitlines()[-3:]] == [
        "signal limits value time [s] margin",
        f"y_d2 from -5 to 8 -5.7735 0.788675 -{100 * (5.773502691896258 - 5.0) / 6.5:.3g} %",
        "y_d1 within ±2 1.875 0.5 6.25 %",
    ]


@pytest.mark.parametrize(
    ("limit", "words"), [((None, 2.0), "at most 2"), ((-3.0, None), "at least -3"), ((0.0, None), "at least 0")]
)
def test_lone_sides_in_words(limit, words):
    (row,) = margins(MOVE, {"y_d1": limit})
    assert str(row).startswith(f"y_d1 {words}: ")
    assert limit_words(limit) == words


def test_limits_in_words_whatever_their_form():
    assert limit_words(3) == "within ±3"
    assert limit_words(np.array(3.0)) == "within ±3"
    assert limit_words((-1.0, 2.5)) == "from -1 to 2.5"
    assert limit_words(cp.Limits(low=-1.0)) == "at least -1"
    assert limit_words([1.0, 2.0]) == limit_words([1.0, 2.0], "jerk") == "within ±1; within ±2"
    assert limit_words([None, 2.0], "y_d2") == "at most 2"
    assert limit_words(np.array([-1.0, 2.0]), "F") == "from -1 to 2"
    assert limit_words(np.array([[-1.0, 2.0], [-3.0, 3.0]])) == "from -1 to 2; within ±3"


def test_margins_as_tables():
    found = margins(MOVE, {"y_d1": 2.0, "y_d2": (None, 8.0)})
    frame = found.to_pandas()
    assert list(frame.columns) == ["low", "high", "value", "time", "margin"]
    assert frame.loc["y_d1", "margin"] == pytest.approx(1 / 16)
    assert frame.loc["y_d2", "low"] == -inf
    html = found._repr_html_()
    assert html.count("<tr>") == 3
    assert "y_d1" in html


# What is rejected


@pytest.mark.parametrize("limit", [0.0, -1.0, inf, np.nan, -0.0])
def test_limits_must_be_positive(limit):
    with pytest.raises(ValueError, match="limits of y_d1 must be finite and above 0, got "):
        margins(MOVE, {"y_d1": limit})


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ((1.0, -1.0), "limits of y_d1 must increase, got 1 and -1"),
        ((1.0, 1.0), "limits of y_d1 must increase, got 1 and 1"),
        ((np.nan, 1.0), "limits of y_d1 must be a number, got nan"),
        ((-1.0, 0.0, 1.0), "limits of y_d1 must be a number or a pair"),
        ((1.0,), "limits of y_d1 must be a number or a pair"),
        ([], "limits of y_d1 must be a number or a pair"),
        ((None, None), "limits of y_d1 must contain a finite one"),
        ((-inf, inf), "limits of y_d1 must contain a finite one"),
    ],
)
def test_pairs_must_increase(limit, message):
    with pytest.raises(ValueError, match=message):
        margins(MOVE, {"y_d1": limit})


@pytest.mark.parametrize("limit", ["fast", None, {"low": 1}, ("a", "b"), "3", True])
def test_limits_of_the_wrong_kind(limit):
    with pytest.raises(TypeError, match="limits of y_d1 must be a number"):
        margins(MOVE, {"y_d1": limit})


@pytest.mark.parametrize("limit", [np.float64(2.0), 2, np.array(2.0), np.int64(2)])
def test_numbers_of_every_kind(limit):
    assert margins(MOVE, {"y_d1": limit}).active.fraction == pytest.approx(1 / 16, rel=1e-12)


@pytest.mark.parametrize("limits", [[("y_d1", 2.0)], "y_d1", None, 3.0])
def test_limits_are_a_mapping(limits):
    with pytest.raises(TypeError, match="limits must be a mapping of names to limits, got"):
        margins(MOVE, limits)


def test_no_limits():
    with pytest.raises(ValueError, match="limits must name at least one signal, got none"):
        margins(MOVE, {})


@pytest.mark.parametrize("name", ["x_d1", "speed", "y_d", "y_d9", "y_d01", "", 1])
def test_unknown_names(name):
    with pytest.raises(ValueError, match=r"limits must name derivatives of an axis \(y_d1, .*no system was given"):
        margins(MOVE, {name: 1.0})


def test_unknown_names_in_addition_to_quantities():
    with pytest.raises(ValueError, match=r"or quantities \(D, R, theta, T, F, C, ...\), got 'Q'"):
        margins(HOIST, {"Q": 1.0}, CRANE)


@pytest.mark.parametrize("quantities", [3, "crane", {"F": 1.0}])
def test_quantities_of_the_wrong_kind(quantities):
    with pytest.raises(TypeError, match=r"system must be a flat system, .*or a function of a jet, got"):
        margins(MOVE, {"F": 1.0}, quantities)


def test_quantities_must_return_a_mapping():
    with pytest.raises(TypeError, match="quantities must return a mapping of names to signals, got float"):
        margins(MOVE, {"F": 1.0}, lambda jet: 1.0)


def test_a_step_has_no_derivatives_to_limit():
    with pytest.raises(ValueError, match="must have a duration, got a step"):
        margins(cp.Step(1.0), {"y_d1": 1.0})


@pytest.mark.parametrize("plan", [None, 3.0, lambda t: t])
def test_no_plan(plan):
    with pytest.raises(TypeError, match=r"plan must be a Trajectory .*, got"):
        margins(plan, {"y_d1": 1.0})


@pytest.mark.parametrize(
    ("entries", "name", "below", "jumping"), [(2, "y_d3", 2, "y_d2"), (3, "y_d4", 3, "y_d3"), (3, "y_d5", 4, "y_d3")]
)
def test_jumps_would_make_a_signal_infinite(entries, name, below, jumping):
    still = [0.0] * (entries - 1)
    plan = cp.PolySpline([Waypoint.from_jets(0, y=[0.0, *still]), Waypoint.from_jets(2, y=[1.0, *still])])
    message = (
        rf"limits of {name} require a plan that is continuous up to derivative {below} .*got {jumping} that jumps by"
    )
    with pytest.raises(ValueError, match=message):
        margins(plan, {name: 1e6})
    order = int(name[-1]) - 1
    if order == entries:  # what jumps itself is finite
        assert margins(plan, {f"y_d{order}": 1e6}).satisfied


def test_a_force_requires_a_smooth_plan():
    with pytest.raises(ValueError, match="limits of F require a plan that is continuous up to derivative 3"):
        margins(cp.PolySpline(nominal_waypoints(3)), {"F": 1e6}, CRANE)


def test_only_the_limited_axis_must_be_smooth():
    points = [Waypoint.from_jets(0, x=[0, 0], z=[0] * 4), Waypoint.from_jets(2, x=[1, 0], z=[1, 0, 0, 0])]
    plan = cp.PolySpline(points)
    assert margins(plan, {"z_d3": 1e3}).satisfied
    with pytest.raises(ValueError, match="limits of x_d3 require a plan that is continuous"):
        margins(plan, {"x_d3": 1e3})
    with pytest.raises(ValueError, match="limits of pull require a plan that is continuous"):
        margins(plan, {"pull": 1e3}, lambda jet: {"pull": jet[3].sum(axis=0)})


def test_a_plan_that_starts_and_ends_in_motion_continues_one():
    line = cp.PolySpline([Waypoint(0, 0), Waypoint(2, 4)])
    assert margins(line, {"y_d2": 1.0}).active.fraction == 1.0


sizes = st.floats(1e-3, 1e3)


@examples(12)
@given(size=sizes, duration=sizes, limits=st.tuples(*[sizes] * 3))
def test_margins_scale_with_size_and_time(size, duration, limits):
    plan = (size * MOVE).retime(duration)
    found = rows(margins(plan, {f"y_d{k}": limit for k, limit in enumerate(limits[:2], 1)}))
    peaks = [size * 15 / 8 / duration, size * 10 / sqrt(3) / duration**2]
    for k, peak in enumerate(peaks, 1):
        assert found[f"y_d{k}"].fraction == pytest.approx(1 - peak / limits[k - 1], rel=1e-11, abs=1e-11)


@examples(6)
@given(shift=st.floats(-1e4, 1e4), factor=sizes)
def test_margins_shift_with_time_and_limits_with_the_signal(shift, factor):
    limits = {"x_d1": 3.0, "z_d2": (-1.0, 2.0)}
    ours = rows(margins(OBSTACLE, limits))
    theirs = rows(margins((factor * OBSTACLE).shift(shift), {"x_d1": 3.0 * factor, "z_d2": (-factor, 2.0 * factor)}))
    for name, row in ours.items():
        assert theirs[name].fraction == pytest.approx(row.fraction, abs=1e-9)
        assert theirs[name].time - shift == pytest.approx(row.time, abs=1e-5)


# One value for the limits of a signal


@pytest.mark.parametrize(
    ("short", "value"),
    [
        (2.0, cp.Limits(-2.0, 2.0)),
        ((-1.0, 3.0), cp.Limits(-1.0, 3.0)),
        ((None, 3.0), cp.Limits(high=3.0)),
        ((-1, None), cp.Limits(low=-1)),
        (np.array([-1.0, inf]), cp.Limits(low=-1.0)),
        ((-inf, 3.0), cp.Limits(high=3.0)),
    ],
)
@pytest.mark.parametrize("name", ["y_d1", "velocity", "speed"])
def test_short_forms_are_limits(short, value, name):
    system = (lambda jet: {"speed": jet[1, 0]},) if name == "speed" else ()
    assert margins(MOVE, {name: value}, *system).rows == margins(MOVE, {name: short}, *system).rows
    if not (name == "velocity" and isinstance(short, np.ndarray)):
        assert cp.Limits.of(short, name) == value
    assert cp.Limits.of(value, name) is value


def test_limits_of_each_axis_may_be_values():
    plan = cp.stack([MOVE, 2.0 * MOVE], labels=["x", "z"])
    found = rows(margins(plan, {"velocity": [cp.Limits(high=4.0), cp.Limits(-5.0, 5.0)]}))
    assert found["x_d1"].bound.range == "at most 4"
    assert found["x_d1"].fraction == pytest.approx(1.0 - 15 / 8 / 4.0, rel=1e-12)
    assert found["z_d1"].fraction == pytest.approx(1.0 - 15 / 4 / 5.0, rel=1e-12)
    same = rows(margins(plan, {"velocity": cp.Limits(-5.0, 5.0)}))
    assert {row.bound.high for row in same.values()} == {5.0}


@pytest.mark.parametrize(
    ("sides", "error", "message"),
    [
        ((), ValueError, "Limits must contain a finite one, got -inf and inf"),
        ((1.0, 1.0), ValueError, "Limits must increase, got 1 and 1"),
        ((np.nan, 1.0), ValueError, "Limits must be a number, got nan"),
        (("1", 2.0), TypeError, "Limits must be a number, got '1'"),
        ((0.0, True), TypeError, "Limits must be a number, got True"),
    ],
)
def test_wrong_values(sides, error, message):
    with pytest.raises(error, match=message):
        cp.Limits(*sides)


def test_a_function_that_returns_nan_is_named_with_the_position():
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    said = r"u must be determined by the plan, got nan .*at the position \(1\): .*, or the function returns nan"
    with pytest.raises(ValueError, match=said):
        cp.fastest(plan, {"u": 1.0}, lambda jet: {"u": np.where(jet[0, 0] > 0.5, np.nan, jet[1, 0])}, hold="path")


@pytest.mark.parametrize(
    "turning",
    [
        lambda jet: {"effort": jet[2, 0] if jet[2, 0] > 0 else -jet[2, 0]},
        lambda jet: {"effort": max(jet[2, 0], -0.5 * jet[2, 0])},
        lambda jet: {"effort": float(jet[2, 0])},
    ],
)
@pytest.mark.parametrize("hold", ["shape", "waypoints", "path"])
def test_quantities_of_one_time_only_are_rejected_with_the_way_on(turning, hold):
    with pytest.raises(
        ValueError, match=r"quantities must accept jets .*got (Value|Type)Error: .*; .*np\.where"
    ) as info:
        cp.fastest(MOVE, {"effort": 1.0}, turning, hold=hold)
    assert isinstance(info.value.__cause__, ValueError | TypeError)
    cp.fastest(MOVE, {"effort": 1.0}, lambda jet: {"effort": np.where(jet[2, 0] > 0, jet[2, 0], -jet[2, 0])})


def test_quantities_keep_the_reason_of_a_rejected_jet():
    with pytest.raises(ValueError, match="quantities must accept jets") as info:
        margins(MOVE, {"effort": 1.0}, lambda jet: {"effort": jet[20, 0]})
    assert isinstance(info.value.__cause__, IndexError)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("end", [0, 1])
def test_a_velocity_of_rounding_at_an_end_is_rest(end, size):
    """The acceleration jumps there, so that the jerk is infinite; a plan that moves there continues a motion."""

    def plan(velocity):
        jets = [[0.0, 0.0, 0.0, 0.0], [size, 0.0, 0.0, 0.0]]
        jets[end][1:3] = velocity, size
        return cp.PolySpline([cp.Waypoint(k, *jet) for k, jet in enumerate(jets)])

    for velocity in (0.0, 1e-17 * size, -1e-17 * size):
        with pytest.raises(ValueError, match=rf"got y_d2 that jumps by .* at {end} s"):
            cp.margins(plan(velocity), {"jerk": 1e9 * size})
    assert cp.margins(plan(1e-3 * size), {"jerk": 1e9 * size}).satisfied
