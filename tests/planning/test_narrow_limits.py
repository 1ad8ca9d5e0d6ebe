"""Limits of a velocity that change within a short part of the path."""

import numpy as np
import pytest

import ctrlplan as cp

MOVE = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
ACCELERATION = 5.0


def optimum(limit, place):
    """Minimum duration by v(x)^2 = min over z of limit(z)^2 + 2 a abs(x - z), on a grid that is fine about a place."""
    near = np.geomspace(1e-12, 1.0, 40_000)
    times = np.unique(np.clip(np.concatenate([place - near, place + near, np.linspace(0.0, 1.0, 20_001)]), 0.0, 1.0))
    x = MOVE(times)
    _, first = np.unique(x, return_index=True)
    x, squares = x[first], np.minimum(limit(times[first]), 1.0) ** 2
    squares[[0, -1]] = 0.0
    shifted = 2.0 * ACCELERATION * x
    squares = np.minimum(
        shifted + np.minimum.accumulate(squares - shifted),
        np.minimum.accumulate((squares + shifted)[::-1])[::-1] - shifted,
    )
    # 1/v of a v^2 that is linear between the points has the integral 2 h/(v_0 + v_1).
    v = np.sqrt(np.maximum(squares, 0.0))
    return float((2.0 * np.diff(x) / (v[1:] + v[:-1])).sum())


def fastest(limit):
    limits = {"y_d1": cp.Limits(low=-1.0, high=limit), "y_d2": ACCELERATION}
    return cp.fastest(MOVE, limits, hold="path")


@pytest.mark.parametrize(
    ("limit", "place"),
    [
        (lambda t: 1.0 - 0.99 * np.exp(-(((t - 0.5) / 1e-4) ** 2)), 0.5),
        (lambda t: 1.0 - 0.95 * np.exp(-(((t - 0.7123) / 3e-4) ** 2)), 0.7123),
        (lambda t: 1.0 - 0.95 * np.exp(-(((t - 0.312) / 1e-4) ** 2)), 0.312),
        (lambda t: 0.01 + np.sqrt(np.abs(t - 0.3)), 0.3),
        (lambda t: 1e-6 + np.abs(t - 0.3), 0.3),
    ],
)
def test_a_narrow_limit_slows_the_plan_there_only(limit, place):
    found = fastest(limit)
    assert found.margins.satisfied
    assert optimum(limit, place) * (1.0 - 1e-5) <= found.duration <= 1.01 * optimum(limit, place)


def test_two_narrow_limits():
    def limit(t):
        return 1.0 - 0.95 * np.exp(-(((t - 0.4) / 3e-4) ** 2)) - 0.9 * np.exp(-(((t - 0.7) / 2e-4) ** 2))

    found = fastest(limit)
    assert found.margins.satisfied
    assert found.duration < 2.0


@pytest.mark.parametrize(
    ("limits", "time"),
    [
        ({"high": lambda t: 1.0 - np.exp(-(((t - 0.5) / 0.01) ** 2))}, "0.5"),
        ({"high": lambda t: np.abs(t - 0.3)}, "0.3"),
        ({"high": [1.0, 0.0, 1.0], "along": [0.0, 0.6, 1.0]}, "0.6"),
    ],
)
def test_a_limit_of_0_is_never_passed(limits, time):
    with pytest.raises(ValueError, match=rf"y_d1 must not be 0 where the path moves, .* at {time} s of the given plan"):
        cp.fastest(MOVE, {"y_d1": cp.Limits(low=-1.0, **limits), "y_d2": ACCELERATION}, hold="path")


@pytest.mark.parametrize("width", [1e-3, 1e-4])
def test_with_limits_of_the_jerk_and_given_speeds(width):
    """The dip costs no time but its own: next to it the plan is as fast as with a limit of 0.05 at one place."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0.5, 0), cp.Waypoint(1, 1, 0.5, 0)])

    def dip(t):
        return 1.0 - 0.95 * np.exp(-(((t - 0.4123) / width) ** 2))

    limits = {"y_d1": cp.Limits(low=-1.0, high=dip), "y_d2": ACCELERATION}
    given = cp.fastest(plan, limits, hold="path", ends="given")
    free = cp.fastest(plan, limits, hold="path")
    smooth = cp.fastest(plan, limits | {"y_d3": 1e3}, hold="path")
    assert all(found.margins.satisfied for found in (given, free, smooth))
    # From 0.05 to 1 the velocity takes 0.19 s and 0.1 m; it is 1 elsewhere, but for the given 0.5 at the ends.
    place = float(plan(0.4123))
    shortest = place + (1.0 - place) + 2 * (0.19 - (1.0 - 0.05**2) / (2 * ACCELERATION))
    # Both are near their minimum, up to a percent; that with the jerk limited is no shorter than the other minimum.
    assert shortest * 0.999 <= free.duration <= 1.03 * shortest
    assert shortest * 0.999 <= smooth.duration <= 1.03 * shortest
    assert shortest <= given.duration <= 1.1 * shortest


@pytest.mark.slow
def test_limits_that_cannot_be_resolved_are_satisfied_with_a_warning():
    with pytest.warns(
        UserWarning, match=r"the plan is slowed by the factor .* limits over time change within a short part"
    ):
        found = fastest(lambda t: 1e-7 + np.sqrt(np.abs(t - 0.3)))
    assert found.margins.satisfied


@pytest.mark.parametrize("least", [1e-2, 1e-3])
def test_a_limit_like_a_square_root_is_satisfied(least):
    def limit(t):
        return least + np.sqrt(np.abs(t - 0.3))

    found = fastest(limit)
    assert found.margins.satisfied
    assert optimum(limit, 0.3) * (1.0 - 1e-5) <= found.duration <= 1.01 * optimum(limit, 0.3)


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        (
            {"y_d1": cp.Limits(lambda s: 0.1 + 0.0 * s, lambda s: 0.4 + 0.0 * s)},
            r"limits of y_d1 must include 0, the value at rest, got from 0.1 to 0.4 at 3 s of the given plan",
        ),
        (
            {"y_d1": cp.Limits([-1.0, 0.2, 0.2], [1.0, 1.0, 1.0], along=[3.0, 3.9, 4.0]), "y_d2": 1.0},
            r"limits of y_d1 must include 0, the value at rest, got from 0.2 to 1 at 4 s of the given plan",
        ),
        ({"y": 0.5}, r"limits must be satisfied at rest, at any duration, got y = 1 at rest at y = 1"),
    ],
)
def test_limits_that_no_time_law_satisfies_at_rest(limits, said):
    plan = cp.PolySpline([cp.Waypoint(3, 0, 0, 0), cp.Waypoint(4, 1, 0, 0)])
    with pytest.raises(ValueError, match=said):
        cp.fastest(plan, limits, hold="path")
