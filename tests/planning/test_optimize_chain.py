"""Optima without a spline of continuous conjugates, next to dense least squares of samples of unit splines."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan import Waypoint

NODES, GAUSS = np.polynomial.legendre.leggauss(30)

CASES = {
    "trigonometric": {"alpha": 1.0},
    "another alpha": {"alpha": 3.0, "order": 3},
    "more entries than needed": {"order": 4},
    "jumps": {"derivative": 4, "continuity": 2},
    "jumps of trigonometric splines": {"alpha": 2.0, "derivative": 2, "order": 3, "continuity": 1},
}


def table_of(rng, n, order=2, share=1.0):
    """Positions and nothing else between a start and an end at rest, or a share of random entries."""
    table = rng.normal(size=(n, order + 1))
    if share < 1.0:
        return np.where(rng.random(table.shape) < share, table, np.nan)
    table[1:-1, 1:], table[[0, -1], 1:] = np.nan, 0.0
    return table


def waypoints(times, table):
    return [Waypoint(float(t), *jet) for t, jet in zip(times, table, strict=True)]


def naive(times, table, derivative=3, order=None, alpha=0.0, continuity=None):
    """Equations of the free entries of one axis: a row for each Gauss node, a column for each entry.

    Returns the matrix of the cost's root, its right side, and the columns (waypoint, order, side).
    """
    order = derivative - 1 if order is None else order
    continuity = order if continuity is None else continuity
    known = np.full((len(times), order + 1), np.nan)
    known[:, : table.shape[1]] = table
    columns = [
        (k, nu, side)
        for k in range(len(times))
        for nu in range(order + 1)
        for side in ((0, 1) if nu > continuity and 0 < k < len(times) - 1 else (0,))
        if math.isnan(known[k, nu])
    ]
    split = {(k, nu) for k, nu, side in columns if side}
    matrix, right = np.zeros((len(times) - 1, NODES.size, len(columns))), np.zeros((len(times) - 1, NODES.size))
    for k, duration in enumerate(np.diff(times)):
        at, weight = 0.5 * duration * (1.0 + NODES), np.sqrt(0.5 * duration * GAUSS)
        for end in (0, 1):
            for nu in range(order + 1):
                jets = np.zeros((2, order + 1))
                jets[end, nu] = 1.0
                given = [Waypoint(0.0, *jets[0]), Waypoint(duration, *jets[1])]
                unit = cp.TrigSpline(given, alpha=alpha, warn=False) if alpha else cp.PolySpline(given, warn=False)
                effect = weight * unit(at, derivative)
                if math.isnan(known[k + end, nu]):
                    side = 1 - end if (k + end, nu) in split else 0
                    matrix[k, :, columns.index((k + end, nu, side))] += effect
                else:
                    right[k] -= effect * known[k + end, nu]
    return matrix.reshape(right.size, len(columns)), right.ravel(), columns


@pytest.mark.parametrize("case", CASES)
def test_entries_are_those_of_dense_least_squares(case):
    """Rounding of the dense equations is the tolerance: their condition times the unit of rounding."""
    rng = np.random.default_rng(3)
    for n in (2, 3, 6, 13):
        times = np.cumsum(rng.uniform(0.5, 2.0, n))
        table = table_of(rng, n)
        best = cp.optimize_waypoints(waypoints(times, table), **CASES[case])
        matrix, right, columns = naive(times, table, **CASES[case])
        found, _, rank, singular = np.linalg.lstsq(matrix, right, rcond=None)
        assert best.unique == (rank == len(columns))
        residual = matrix @ found - right
        assert best.cost == pytest.approx(residual @ residual, rel=1e-9)
        condition = singular[0] / singular[-1] if singular.size else 1.0
        for (k, nu, side), value in zip(columns, found, strict=True):
            before = side == 0 and k > 0
            t = np.nextafter(times[k], -math.inf) if before else times[k]
            assert best.plan(t, nu) == pytest.approx(value, rel=1e-9, abs=1e-14 * condition * np.abs(found).max())


@pytest.mark.parametrize("case", CASES)
def test_no_other_entries_of_many_waypoints_cost_less(case):
    """The cost is a square: its least value is where no entry changes it, here along random directions."""
    rng = np.random.default_rng(4)
    n = 300
    times, table = np.cumsum(rng.uniform(0.5, 2.0, n)), table_of(rng, n)
    options = CASES[case]
    best = cp.optimize_waypoints(waypoints(times, table), **options)
    assert best.unique
    derivative = options.get("derivative", 3)
    half = 0.5 * np.diff(times)[:, None]
    t, weight = (times[:-1, None] + half * (1.0 + NODES)).ravel(), (half * GAUSS).ravel()
    value = best.plan(t, derivative)
    assert best.cost == pytest.approx(weight @ value**2, rel=1e-10)
    for _ in range(3):  # splines of the family that are 0 wherever an entry is prescribed
        other = rng.normal(size=(n, options.get("order", derivative - 1) + 1))
        other[:, :3][~np.isnan(table)] = 0.0
        change = cp.PiecewiseSpline(waypoints(times, other), alpha=options.get("alpha", 0.0), warn=False)(t, derivative)
        assert abs(weight @ (value * change)) <= 1e-9 * math.sqrt(best.cost * (weight @ change**2))


def test_more_entries_than_needed_change_nothing():
    """The spline of minimum jerk has a continuous jerk and snap: it is found among splines with these entries too."""
    rng = np.random.default_rng(5)
    times, table = np.cumsum(rng.uniform(0.5, 2.0, 400)), table_of(rng, 400)
    given = waypoints(times, table)
    t = np.linspace(times[0], times[-1], 4001)
    plain, rich = (cp.optimize_waypoints(given, order=order).plan.jet(t, 2) for order in (2, 4))
    np.testing.assert_allclose(rich, plain, rtol=0, atol=1e-10 * np.abs(plain).max())


@given(st.integers(0, 10**6), st.integers(2, 7), st.integers(1, 4), st.sampled_from([0.0, 1.0, 4.0]), st.data())
@examples(100)
def test_whether_it_is_unique_is_the_rank_of_dense_equations(seed, n, derivative, alpha, data):
    rng = np.random.default_rng(seed)
    order = data.draw(st.integers(max(1, derivative - 2), derivative))
    continuity = data.draw(st.integers(0, order))
    table = table_of(rng, n, order, share=rng.uniform(0.2, 0.8))
    table[0, 0] = 1.0
    times = np.cumsum(rng.uniform(0.5, 2.0, n))
    options = {"derivative": derivative, "order": order, "alpha": alpha, "continuity": continuity}
    best = cp.optimize_waypoints(waypoints(times, table), **options)
    matrix, _, columns = naive(times, table, **options)
    singular = np.linalg.svd(matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300), compute_uv=False)
    gap = singular / singular.max(initial=1e-300)
    if not ((gap > 1e-12) & (gap < 1e-8)).any():  # neither by rounding alone
        assert best.unique == bool(len(matrix) >= len(columns) and (gap > 1e-10).all())
