"""The crane's rope: its upper end against the flat maps, its slopes against symbolic derivatives."""

import dataclasses
import functools

import numpy as np
import pytest
import sympy as sp

import ctrlplan as cp
from ctrlplan.systems.plants import Crane

ODD = Crane(drum_radius=0.5, gravity=9.5)


@pytest.mark.parametrize("crane", [Crane(), ODD], ids=["paper", "odd"])
def test_the_upper_end_is_where_the_flat_maps_have_it(crane):
    jet = np.random.default_rng(1).uniform(-4.0, 4.0, (3, 2, 200))
    jet[0, 1] += 9.0  # the load is below the trolley
    found = crane.quantities(jet)
    s, c = np.sin(found["theta"]), np.cos(found["theta"])
    top = crane.rope().top(jet)
    b = crane.drum_radius
    np.testing.assert_allclose(top, [found["D"] + b * c, -b * s], rtol=0, atol=1e-13)
    np.testing.assert_allclose(top, jet[0] - found["R"] * np.array([s, c]), rtol=0, atol=1e-13)


def test_a_load_at_rest_hangs_below_the_drum():
    np.testing.assert_array_equal(
        Crane().rope().top(np.array([[[3.0], [7.0]], [[0], [0]], [[0], [0]]])), [[3.0], [0.0]]
    )


def test_any_shape_of_times():
    jet = np.random.default_rng(2).uniform(-1.0, 1.0, (4, 2, 3, 5))
    rope = Crane().rope()
    top = rope.top(jet)
    assert top.shape == (2, 3, 5)
    np.testing.assert_array_equal(top[:, 1, 2], rope.top(jet[:, :, 1, 2]))


@functools.cache
def symbolic_slopes(crane):
    """Lengths of d top/d (x, z, x'', z'') as a function of these, from D + b cos theta and -b sin theta."""
    x, z, a, f = sp.symbols("x z a f")
    g, b = sp.Rational(str(crane.gravity)), sp.Rational(str(crane.drum_radius))
    pull = sp.sqrt(a**2 + (g - f) ** 2)
    theta = sp.atan2(-a, g - f)
    top = sp.Matrix([x - (b * pull - z * a) / (g - f) + b * sp.cos(theta), -b * sp.sin(theta)])
    jacobian = top.jacobian([x, z, a, f])
    return sp.lambdify([x, z, a, f], [jacobian[:, k].norm() for k in range(4)], "numpy")


PLANS = [
    cp.PolySpline([cp.Waypoint(0, [0, 10], 0, 0), cp.Waypoint(6, [20, 11], 0, 0)]),
    cp.PolySpline([cp.Waypoint(0, [0, 10], 0, 0), cp.Waypoint(2.5, [8, 2], 0, 0)]),
    cp.TrigSpline([cp.Waypoint(0, [0, 3], 0, [1, -2]), cp.Waypoint(6, [-9, 9], 0, 0)], alpha=3.0),
    cp.PolySpline([cp.Waypoint(0, [0, 10], 0, 0), cp.Waypoint(6, [0, 4], 0, 0)]),
]


@pytest.mark.parametrize("crane", [Crane(), ODD], ids=["paper", "odd"])
@pytest.mark.parametrize("plan", PLANS)
def test_slopes_bound_every_partial_derivative_over_the_ranges_of_the_plan(crane, plan):
    slopes = crane.rope().slopes(plan)
    places, falls = plan.extrema(), plan.extrema(2)
    rng = np.random.default_rng(3)
    low = np.concatenate([places.minimum, falls.minimum])
    high = np.concatenate([places.maximum, falls.maximum])
    corners = np.array(np.meshgrid(*[[0.0, 0.5, 1.0]] * 4)).reshape(4, -1)
    shares = np.concatenate([corners, rng.uniform(0.0, 1.0, (4, 2000))], axis=1)
    point = low[:, None] + shares * (high - low)[:, None]
    partials = np.array([np.broadcast_to(row, point[0].shape) for row in symbolic_slopes(crane)(*point)])
    assert np.all(partials.max(axis=1) <= 1e-15 + (1.0 + 1e-12) * slopes[[0, 0, 2, 2], [0, 1, 0, 1]])
    # They are no looser than products of interval ends.
    assert np.all(slopes[[0, 0, 2], [0, 1, 0]] <= 2.0 * partials[:3].max(axis=1))
    np.testing.assert_array_equal(slopes[1], 0.0)


def test_no_two_instants_are_farther_apart_than_slopes_times_peaks():
    plan, rope = PLANS[2], ODD.rope()
    t = np.linspace(0.0, 6.0, 20001)
    speeds = np.hypot(*np.diff(rope.top(plan.jet(t, 2)))) / np.diff(t)
    allowed = sum(rope.slopes(plan)[nu] @ plan.peak(nu + 1) for nu in range(3))
    assert speeds.max() <= allowed


def test_a_rope_cannot_push():
    rope = Crane().rope()
    falls = cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(1, [0, 10], 0, 0)])
    with pytest.raises(ValueError, match=r"g - z'' must be above 0 for a taut rope, got -47.93 m/s\^2 at 0.2113 s"):
        rope.slopes(falls)
    with pytest.raises(ValueError, match=r"g - z'' must be above 0 for a taut rope, got -47.93"):
        rope.top(falls.jet([0.0, 0.5 - np.sqrt(3) / 6], 2))


def test_a_rope_is_frozen_and_equal_by_value():
    rope = Crane().rope()
    assert rope == Crane().rope() != ODD.rope()
    assert rope.order == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        rope.gravity = 0.0
