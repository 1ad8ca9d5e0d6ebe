"""Which prescribed entries determine a piecewise spline: the rank of its equations, computed without rounding."""

import itertools
import math

import numpy as np
import pytest

import ctrlplan as cp

PRIME = 2**31 - 1


def rank(matrix):
    """Rank over the integers modulo a large prime."""
    rows = [[value % PRIME for value in row] for row in matrix]
    found = 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(found, len(rows)) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        inverse = pow(rows[found][column], -1, PRIME)
        for i in range(found + 1, len(rows)):
            if factor := rows[i][column] * inverse % PRIME:
                rows[i] = [(a - factor * b) % PRIME for a, b in zip(rows[i], rows[found], strict=True)]
        found += 1
    return found


def is_determined(times, given):
    """Whether all coefficients of the polynomials are determined, by the conditions of the class's docstring."""
    size, last = len(given[0]), len(times) - 2
    counts = [2 * size] * (last + 1)
    counts[0] -= size - sum(given[0])
    counts[last] -= size - sum(given[-1])
    firsts = np.concatenate([[0], np.cumsum(counts)]).tolist()

    def derivative(segment, time, order):
        """Factors of all coefficients, of the powers of the time since the start of each segment."""
        row, since = [0] * firsts[-1], time - times[segment]
        for power in range(order, counts[segment]):
            row[firsts[segment] + power] = math.perm(power, order) * since ** (power - order)
        return row

    rows = []
    for k, order in itertools.product(range(len(times)), range(size)):
        beside = [segment for segment in (k - 1, k) if 0 <= segment <= last]
        if given[k][order]:
            rows += [derivative(segment, times[k], order) for segment in beside]
        elif len(beside) == 2:
            for own in (order, 2 * size - 1 - order):
                before, after = (derivative(segment, times[k], own) for segment in beside)
                rows.append([a - b for a, b in zip(before, after, strict=True)])
    if len(rows) != firsts[-1]:
        return False
    lengths = np.linalg.norm(np.array(rows, dtype=float), axis=1, keepdims=True)
    values = np.linalg.svd(rows / np.where(lengths > 0.0, lengths, 1.0), compute_uv=False)
    return bool(values[-1] > 1e-11 * values[0]) or rank(rows) == firsts[-1]  # far above rounding, or without it


def is_accepted(times, given):
    table = np.where(given, np.random.default_rng(0).normal(size=(len(times), len(given[0]))), np.nan)
    derivatives = {k: table[:, k] for k in range(1, len(given[0]))}
    try:
        plan = cp.PiecewiseSpline.from_arrays(times, table[:, 0], derivatives=derivatives, warn=False)
    except ValueError as error:
        if "must be determined by the prescribed ones" not in str(error):
            raise
        return False
    for left, own in ((False, slice(0, -1)), (True, slice(1, None))):  # at rest before the start and after the end
        jet = plan.jet(times[own], len(given[0]) - 1, left=left)[:, 0].T
        np.testing.assert_allclose(jet[given[own]], table[own][given[own]], rtol=1e-9, atol=1e-9)
    return True


JERK_ALONE = [[1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 1], [1, 0, 0, 0]]
UNEVEN = [[1, 0, 0, 1], [1, 0, 1, 0], [1, 0, 1, 1], [1, 0, 0, 0]]


@pytest.mark.parametrize(
    ("times", "given", "determined"),
    [
        (
            [0, 1, 2, 3],
            JERK_ALONE,
            False,
        ),  # a polynomial of degree 4 over the first two segments, with one condition less
        ([0, 1, 2, 3], JERK_ALONE[::-1], False),
        ([0, 1, 3, 7], JERK_ALONE, False),
        ([0, 1, 3, 7], UNEVEN, False),
        ([0, 1, 2, 3], UNEVEN, True),  # whether it is singular depends on the times
    ],
)
def test_patterns_that_are_singular(times, given, determined):
    given = np.array(given, dtype=bool)
    assert is_determined(times, given) is determined
    assert is_accepted(times, given) is determined


def patterns(count, size):
    """All patterns of derivatives at waypoints with positions, with the highest order at one of them."""
    for bits in itertools.product([False, True], repeat=count * (size - 1)):
        given = np.column_stack([np.ones(count, dtype=bool), np.reshape(bits, (count, size - 1))])
        if given[:, -1].any():
            yield given


@pytest.mark.parametrize("times", [[0, 1, 2], [0, 1, 5], [0, 3, 4]])
def test_all_patterns_of_three_waypoints(times):
    every = list(patterns(3, 3))
    assert [is_accepted(times, given) for given in every] == [is_determined(times, given) for given in every]


@pytest.mark.slow
@pytest.mark.parametrize("times", [[0, 1, 2, 3], [0, 1, 3, 7], [0, 5, 6, 9]])
def test_all_patterns_of_four_waypoints(times):
    every = list(patterns(4, 4))
    wrong = [given.astype(int).tolist() for given in every if is_accepted(times, given) != is_determined(times, given)]
    assert wrong == []
