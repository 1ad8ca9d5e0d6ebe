"""Bad input: what must hold, what was given, where."""

import numpy as np
import pytest
from trajectory_oracle import waypoints

from ctrlplan.trajectories import (
    Joined,
    PiecewiseSpline,
    PolySpline,
    Scaled,
    Stacked,
    Step,
    Sum,
    TrigSpline,
    Waypoint,
    stack,
)

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

nan, inf = np.nan, np.inf
POINTS = waypoints([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
MOVE = PolySpline(POINTS)


def trig(points, **options):
    return TrigSpline(points, alpha=1.0, **options)


def cyclic(points, **options):
    return TrigSpline.cyclic(points, 10.0, **options)


SPLINES = [PolySpline, PiecewiseSpline, trig]
every_spline = pytest.mark.parametrize("spline", SPLINES, ids=["polynomial", "piecewise", "trigonometric"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((nan, 0.0), "time must be finite, got nan"),
        ((inf, 0.0), "time must be finite, got inf"),
        ((-inf, 0.0), "time must be finite, got -inf"),
        ((1.0, inf), "position must be finite or nan .*, got inf at time 1"),
        ((1.0, [0.0, 1.0], [0.0, -inf]), "velocity must be finite or nan .*, got -inf at time 1"),
        ((1.0, 0.0, 0.0, inf), "acceleration must be finite or nan .*, got inf"),
        ((1.0, 0.0, 0.0, 0.0, inf), "jerk must be finite or nan"),
        ((1.0, 0.0, 0.0, 0.0, 0.0, [inf]), "snap must be finite or nan"),
        ((1.0, nan, inf), "velocity must be finite or nan"),
        (
            (1.0, [1.0, 2.0], [1.0, 2.0, 3.0]),
            r"position must have shape \(3,\) as the other entries, or be 0, got shape \(2,\)",
        ),
        ((1.0, [1.0, 2.0], 1.0), r"velocity must have shape \(2,\) .* or be 0, got scalar 1"),
        ((1.0, [1.0, 2.0], 0.0, -3.0), r"acceleration must have shape \(2,\) .*, got scalar -3"),
        ((1.0, [[1.0, 2.0]]), r"position must have shape \(2,\) .*, got shape \(1, 2\)"),
        ((1.0, []), "position must have at least one axis, got none"),
        ((1.0, "high"), "position must be numbers, got 'high'"),
        ((1.0, 0.0, [1.0, "fast"]), "velocity must be numbers"),
        ((1.0, [1.0, [2.0]]), "position must be numbers"),
        ((1.0, 1j), "position must be numbers"),
    ],
)
def test_waypoint_values(arguments, message):
    with pytest.raises(ValueError, match=message):
        Waypoint(*arguments)


@pytest.mark.parametrize("time", ["soon", None, [1.0], 1j])
def test_waypoint_time_of_another_kind(time):
    with pytest.raises(TypeError, match="time must be a number, got"):
        Waypoint(time, 0.0)


@pytest.mark.parametrize(
    ("jets", "message"),
    [
        ({}, "from_jets requires at least one axis, .* got none"),
        ({"x": 1.0}, "jet of axis x must be a sequence of numbers, got 1.0"),
        ({"x": [0.0], "z": [[1.0]]}, "jet of axis z must be a sequence of numbers"),
        ({"x": ["a"]}, "jet of axis x must be numbers"),
        ({"x": [0.0], "z": [0.0, inf]}, "velocity must be finite or nan .*, got inf"),
        ({"x": [0.0] * 6 + [inf]}, "derivative 6 must be finite or nan .*, got inf"),
    ],
)
def test_waypoint_from_jets(jets, message):
    with pytest.raises(ValueError, match=message):
        Waypoint.from_jets(0.0, **jets)


@every_spline
def test_too_few_waypoints(spline):
    with pytest.raises(ValueError, match="a plan must have at least two waypoints, got 0"):
        spline([])
    with pytest.raises(ValueError, match="a plan must have at least two waypoints, got 1"):
        spline(POINTS[:1])
    with pytest.raises(ValueError, match="a plan must have at least one waypoint, got 0"):
        cyclic([])


@pytest.mark.parametrize("spline", [*SPLINES, cyclic])
def test_times_that_do_not_increase(spline):
    unsorted = [Waypoint(t, t) for t in (0.0, 2.0, 1.0)]
    with pytest.raises(ValueError, match=r"times must increase strictly, got waypoints\[2\].time = 1.0 after .* = 2.0"):
        spline(unsorted)
    with pytest.raises(
        ValueError, match=r"increase strictly, got waypoints\[1\].time = 6.0 after waypoints\[0\].time = 6.0"
    ):
        spline([Waypoint(6.0, 0.0), Waypoint(6.0, 1.0), Waypoint(7.0, 1.0)])


@pytest.mark.parametrize("spline", [*SPLINES, cyclic])
def test_jets_of_unequal_axes(spline):
    with pytest.raises(ValueError, match=r"same axes, got waypoints\[1\] with 1 axes after waypoints\[0\] with 2 axes"):
        spline([Waypoint(0, [0, 0]), Waypoint(1, 1)])
    with pytest.raises(ValueError, match=r"same axes, got waypoints\[1\] with axes x, y after .* with axes x, z"):
        spline([Waypoint.from_jets(0, x=[0], z=[0]), Waypoint.from_jets(1, x=[0], y=[0])])
    with pytest.raises(ValueError, match=r"same axes, got waypoints\[1\] with 1 axes after .* with axes x"):
        spline([Waypoint.from_jets(0, x=[0]), Waypoint(1, 1)])


@pytest.mark.parametrize("spline", [*SPLINES, cyclic])
def test_what_is_no_waypoint(spline):
    for wrong in ((1.0, 2.0), 3.0, None):
        with pytest.raises(TypeError, match=r"waypoints\[1\] must be a Waypoint, got"):
            spline([POINTS[0], wrong])
        with pytest.raises(TypeError, match=r"waypoints\[0\] must be a Waypoint, got"):
            spline([wrong, POINTS[1]])


@pytest.mark.parametrize("alpha", [-1e-9, 2 * np.pi, 6.5, 1e9, nan, inf, -inf])
@pytest.mark.parametrize("spline", [TrigSpline, PiecewiseSpline])
def test_alpha_out_of_range(spline, alpha):
    with pytest.raises(ValueError, match=r"alpha must lie in \[0, 2 pi\), got "):
        spline(POINTS, alpha=alpha)


def test_the_message_of_alpha_does_not_contradict_itself():
    """6.28318530717959 as printed with six digits would lie in the range."""
    with pytest.raises(ValueError, match=r"alpha must lie in \[0, 2 pi\), got 6.283185307179586"):
        TrigSpline(POINTS, alpha=2 * np.pi)


@pytest.mark.parametrize("spline", [TrigSpline, PiecewiseSpline])
def test_alpha_of_another_kind(spline):
    with pytest.raises(ValueError, match=r'alpha must lie in \[0, 2 pi\) or be "auto", got \'best\''):
        spline(POINTS, alpha="best")
    for wrong in (None, [1.0], 1j):
        with pytest.raises(TypeError, match=r"alpha must be a number in \[0, 2 pi\), got"):
            spline(POINTS, alpha=wrong)


@pytest.mark.parametrize("alpha", [1.0, 3.0, 6.0])
def test_gamma_that_makes_the_system_singular(alpha):
    """m (mean - gamma) = pi/2 modulo pi, with m = 3 and the mean alpha/2."""
    for turn in (-2, 0, 1):
        gamma = alpha / 2 - (np.pi / 2 + turn * np.pi) / 3
        with pytest.raises(ValueError, match=r"gamma must not make the system singular: .* got .* with m = 3"):
            TrigSpline(POINTS, alpha=alpha, gamma=gamma)
    TrigSpline(POINTS, alpha=alpha, gamma=alpha / 2 - np.pi / 2 / 3 + 1e-3)


def test_gamma_without_a_top_harmonic():
    odd = waypoints([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match=r"gamma requires an even number of coefficients .*, got 5 coefficients"):
        TrigSpline(odd, alpha=1.0, gamma=0.5)
    with pytest.raises(ValueError, match=r"gamma requires .* alpha > 0, got alpha = 0"):
        TrigSpline(POINTS, alpha=0.0, gamma=0.5)


@pytest.mark.parametrize(
    ("gamma", "message"),
    [
        (nan, "gamma must be finite, got nan"),
        ([inf], "gamma must be finite, got inf"),
        ([0.1, 0.2], "gamma must be one number or one per axis, 1, got 2"),
        ([], "gamma must be one number or one per axis, 1, got 0"),
    ],
)
def test_gamma_values(gamma, message):
    with pytest.raises(ValueError, match=message):
        TrigSpline(POINTS, alpha=1.0, gamma=gamma)


def test_gamma_of_another_kind():
    for wrong in ("a", ["a"], 1j):
        with pytest.raises(TypeError, match="gamma must be"):
            TrigSpline(POINTS, alpha=1.0, gamma=wrong)


@pytest.mark.parametrize("gamma", [np.int64(1), np.float32(0.5), np.array([0.25]), (0.25,)])
def test_gamma_may_be_any_number(gamma):
    assert TrigSpline(POINTS, alpha=1.0, gamma=gamma).gamma == (float(np.ravel(gamma)[0]),)


@every_spline
def test_labels(spline):
    two = [Waypoint(t, [t, t]) for t in (0.0, 1.0)]
    with pytest.raises(ValueError, match=r"labels must be unique, got \('x', 'x'\)"):
        spline(two, labels=["x", "x"])
    with pytest.raises(ValueError, match=r"labels must not be empty or contain a dot, got 'x\.y'"):
        spline(two, labels=["x.y", "z"])
    with pytest.raises(ValueError, match="labels must not be empty or contain a dot, got ''"):
        spline(two, labels=["x", ""])
    with pytest.raises(ValueError, match="labels must be one per axis, 2, got 3"):
        spline(two, labels=["x", "y", "z"])
    with pytest.raises(ValueError, match="labels must be one per axis, 2, got 1"):
        spline(two, labels="xy")
    with pytest.raises(TypeError, match="labels must be strings, got 3"):
        spline(two, labels=["x", 3])


def test_labels_of_waypoints_steps_and_stacks():
    with pytest.raises(ValueError, match=r"labels must not be empty or contain a dot, got 'a\.b'"):
        PolySpline([Waypoint.from_jets(t, **{"a.b": [t]}) for t in (0, 1)])
    with pytest.raises(ValueError, match="labels must be unique"):
        Step([1.0, 2.0], labels=["x", "x"])
    x = PolySpline(POINTS, labels="x")
    with pytest.raises(ValueError, match=r"labels must be unique, got \('x', 'x'\)"):
        stack([x, x])
    with pytest.raises(ValueError, match="labels must be one per axis, 2, got 1"):
        stack([x, x], labels=["a"])


@pytest.mark.parametrize("spline", [PolySpline, trig, cyclic])
def test_degree_and_smooth(spline):
    with pytest.raises(ValueError, match=r"degree must be at least [35] for 6 constraints per axis, got 2"):
        spline(POINTS, degree=2)
    for name in ("degree", "smooth"):
        for wrong in (0, -1, 2.5, nan, inf):
            with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1, got {wrong}"):
                spline(POINTS, **{"degree": 9, name: wrong})
        for wrong in ("3", [3], 1j):
            with pytest.raises((TypeError, ValueError), match=f"{name} must be an integer"):
                spline(POINTS, **{"degree": 9, name: wrong})


def test_spare_harmonics_that_cost_nothing():
    """u^3 (1 - u)^3 has no eighth derivative."""
    with pytest.raises(
        ValueError, match=r"must determine every function of zero cost.* got 6 constraints for 8 coefficients"
    ):
        PolySpline(POINTS, degree=7, smooth=8)


def test_cyclic_waypoints_beyond_the_period():
    for period in (1.0, 0.5):
        with pytest.raises(ValueError, match=r"within one period of .* s from the first, got waypoints\[1\].time = 1"):
            TrigSpline.cyclic(POINTS, period)
    for period in (0.0, -1.0, nan, inf):
        with pytest.raises(ValueError, match="period must be finite and above 0, got"):
            TrigSpline.cyclic(POINTS, period)
    with pytest.raises(TypeError, match="period must be a number, got"):
        TrigSpline.cyclic(POINTS, None)


@every_spline
def test_new_values_at_other_times(spline):
    plan = spline(POINTS)
    for points in ([Waypoint(0.0, 0.0), Waypoint(2.0, 1.0)], POINTS[:1], []):
        with pytest.raises(ValueError, match=r"waypoints must keep the times \[0.0, 1.0\], got"):
            plan.with_values(points)
    with pytest.raises(TypeError, match=r"waypoints\[0\] must be a Waypoint, got tuple"):
        plan.with_values([(0.0, 1.0), (1.0, 2.0)])
    with pytest.raises(ValueError, match="same axes"):
        plan.with_values([Waypoint(0.0, 1.0), Waypoint(1.0, [1.0, 2.0])])


def test_new_values_of_other_axes():
    plan = TrigSpline([Waypoint(t, [t, t], 0) for t in (0.0, 1.0)], alpha=1.0, gamma=[0.4, None])
    with pytest.raises(ValueError, match="axes"):
        plan.with_values([Waypoint(t, t, 0.0) for t in (0.0, 1.0)])


def test_times_and_orders_of_samples():
    for t in (nan, [0.0, nan], [[0.0], [nan]], [inf, -inf, nan]):
        with pytest.raises(ValueError, match="times must not be nan, got nan at index"):
            MOVE(t)
        with pytest.raises(ValueError, match="times must not be nan"):
            MOVE.jet(t, 1)
    for wrong in (-1, 0.5, nan, inf):
        with pytest.raises(ValueError, match=f"nu must be an integer of at least 0, got {wrong}"):
            MOVE(0.0, wrong)
        with pytest.raises(ValueError, match="order must be an integer of at least 0, got"):
            MOVE.jet(0.0, wrong)
        with pytest.raises(ValueError, match="nu must be an integer of at least 0, got"):
            MOVE.extrema(wrong)
    with pytest.raises(ValueError, match=r"order must be .*, got 1000"):
        MOVE.jet(0.0, 1000)


def test_whole_numbers_of_any_kind_are_orders():
    for order in (2.0, np.int64(2), np.float64(2)):
        np.testing.assert_array_equal(MOVE.jet([0.3], order), MOVE.jet([0.3], 2))
        np.testing.assert_array_equal(MOVE([0.3], order), MOVE([0.3], 2))
        np.testing.assert_array_equal(MOVE.peak(order), MOVE.peak(2))


def test_infinite_times_are_outside():
    np.testing.assert_array_equal(MOVE([-inf, inf]), [0.0, 1.0])


def test_retime_and_shift():
    for wrong in (0.0, -1.0, nan, inf):
        with pytest.raises(ValueError, match="duration must be finite and above 0, got"):
            MOVE.retime(wrong)
    for wrong in (nan, inf):
        with pytest.raises(ValueError, match="dt must be finite, got"):
            MOVE.shift(wrong)
    with pytest.raises(TypeError, match="dt must be a number, got"):
        MOVE.shift("later")
    with pytest.raises(ValueError, match="times must increase strictly"):
        MOVE.shift(1e18)


def test_steps():
    with pytest.raises(ValueError, match="final must be finite"):
        Step(nan)
    with pytest.raises(ValueError, match="initial must be finite"):
        Step([1.0, 2.0], [0.0, inf])
    with pytest.raises(ValueError, match=r"initial must have the shape of final \(2,\) or be a scalar, got \(3,\)"):
        Step([1.0, 2.0], [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"final must be a scalar or of shape \(naxes,\), got shape \(1, 2\)"):
        Step([[1.0, 2.0]])
    with pytest.raises(ValueError, match="final must be a scalar or of shape"):
        Step([])
    with pytest.raises(ValueError, match="time must be finite, got nan"):
        Step(1.0, time=nan)
    with pytest.raises(TypeError, match="time must be a number"):
        Step(1.0, time=None)
    with pytest.raises((TypeError, ValueError), match="final must be"):
        Step("high")


def test_combinations():
    two = stack([MOVE, MOVE])
    with pytest.raises(ValueError, match=r"same number of axes, got 2 in parts\[1\] after 1"):
        MOVE + two
    for combine in (Sum, Stacked, Joined, stack):
        with pytest.raises(ValueError, match="a combination needs at least one trajectory, got none"):
            combine([])
        with pytest.raises(TypeError, match=r"parts\[0\] must be a Trajectory, got Waypoint"):
            combine(POINTS)
    for factor in (nan, inf):
        with pytest.raises(ValueError, match="factor must be finite, got"):
            factor * MOVE
        with pytest.raises(ValueError, match="factor must be finite, got"):
            Scaled(MOVE, factor)
    with pytest.raises(TypeError, match="must be a Trajectory"):
        Scaled(3.0, 2.0)


def test_fourier_of_a_polynomial():
    with pytest.raises(ValueError, match=r"alpha must be above 0 for Fourier coefficients, got 0 \(a polynomial\)"):
        TrigSpline(POINTS, alpha=0.0).fourier()


def test_functions_of_a_jet():
    with pytest.raises(ValueError, match="function must be finite over the plan, got nan or inf between 0 and 1 s"):
        MOVE.extrema_of(lambda jet: jet[0, 0] * nan, 0)
    with pytest.raises(ValueError, match="must have a duration to be searched for extrema, got a step"):
        Step(1.0).extrema_of(lambda jet: jet[0, 0], 0)
    with pytest.raises(ValueError, match="order must be an integer of at least 0, got -1"):
        MOVE.extrema_of(lambda jet: jet[0, 0], -1)


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (lambda jet: jet[0, 0] * nan, {}, "function must be finite"),
        (lambda jet: jet[0, 0], {"lipschitz": nan}, "lipschitz must be .*got"),
        (lambda jet: jet[0, 0], {"lipschitz": -1.0}, "lipschitz must be .*got"),
        (lambda jet: jet[0, 0], {"lipschitz": inf}, "lipschitz must be .*got"),
        (lambda jet: jet[0, 0], {"lipschitz": [1.0, 2.0]}, "lipschitz must .*got"),
        (lambda jet: jet[0, 0], {"rtol": nan}, "rtol must be .*got nan"),
        (lambda jet: jet[0, 0], {"rtol": -1.0}, "rtol must be .*got -1"),
        (lambda jet: jet[0, 0], {"rtol": 0.0}, "rtol must be .*got 0"),
        (lambda jet: np.stack([jet[0, 0]] * 2), {}, "function must .*"),
    ],
)
def test_bounds_that_would_prove_nothing(function, options, message):
    with pytest.raises(ValueError, match=message):
        MOVE.bounds(function, 0, **{"lipschitz": 1.0, **options})


def test_bounds_of_a_step():
    with pytest.raises(ValueError, match="must have a duration to be searched for extrema, got a step"):
        Step(1.0).bounds(lambda jet: jet[0, 0], 0, 1.0)


@every_spline
def test_times_too_far_apart_for_a_duration(spline):
    """Finite times whose difference is not."""
    with pytest.raises(ValueError, match="duration must be finite"):
        spline([Waypoint(-1e308, 0.0), Waypoint(1e308, 1.0)])
