"""Signals with a held part: metrics of piecewise polynomials with known jumps, by exact integration."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from ctrlplan.metrics._control import magnitude, varied
from ctrlplan.metrics._error import absolute
from ctrlplan.metrics._evaluation import Evaluation
from ctrlplan.metrics._held import Held
from ctrlplan.metrics._response import exceeded, settled

REST = Polynomial([0.3, -1.1, 0.9, -0.17])
"""A cubic, which the cubics between samples reproduce."""

HELD = Held(np.array([0.0, 0.35, 1.2, 1.25, 2.9, 3.6]), np.array([0.5, -0.8, 0.4, 1.7, -0.2, 0.3]))
GRIDS = [np.linspace(0, 4, 9), np.linspace(0, 4, 57), np.array([0, 0.4, 1.1, 2.2, 2.9, 3.3, 4.0])]


def pieces(rest, t):
    """Start, end and polynomial of each part of the signal between jumps."""
    marks = np.append(HELD.times[HELD.times < t[-1]], t[-1])
    return [(a, b, rest + value) for a, b, value in zip(marks[:-1], marks[1:], HELD.values, strict=False)]


def cuts(a, b, p):
    """Ends, zeros and stationary points of a polynomial in an interval."""
    roots = np.concatenate([p.roots(), p.deriv().roots()]) if p.degree() else np.empty(0)
    real = np.real(roots[np.abs(np.imag(roots)) < 1e-12])
    return np.unique(np.concatenate([[a, b], real[(real > a) & (real < b)]]))


def integral(p, a, b):
    return p.integ()(b) - p.integ()(a)


def expected(rest, t):
    """Integrals of magnitude, timed magnitude and square, peak, variation and maximum."""
    area = timed = square = change = 0.0
    values, ends = [], []
    for a, b, p in pieces(rest, t):
        marks = cuts(a, b, p)
        for left, right in pairwise(marks):
            area += abs(integral(p, left, right))
            timed += abs(integral(p * Polynomial([0, 1]), left, right))
        square += integral(p * p, a, b)
        values += p(marks).tolist()
        change += np.abs(np.diff(p(marks))).sum()
        ends.append((p(a), p(b)))
    change += sum(abs(after[0] - before[1]) for before, after in pairwise(ends))
    return area, timed, square, np.abs(values).max(), change, max(values)


def found(rest, t):
    f = rest(t) + HELD.at(t)
    evaluation = Evaluation(t)
    rows = evaluation.add(f[None], "f", [HELD])
    later = [
        absolute(evaluation, rows),
        absolute(evaluation, rows, float(t[0])),
        evaluation.squares(rows),
        magnitude(evaluation, rows),
        varied(evaluation, rows),
        exceeded(evaluation, rows, np.ones(1), 1.0),
    ]
    *values, percent = (float(one()[0]) for one in later)
    return *values, percent / 100


@pytest.mark.parametrize("t", GRIDS, ids=["even", "fine", "uneven"])
@pytest.mark.parametrize("rest", [Polynomial([0.0]), Polynomial([0.9]), REST], ids=["held", "shifted", "cubic"])
def test_integrals_and_extrema(rest, t):
    np.testing.assert_allclose(found(rest, t), expected(rest, t), rtol=1e-11)


@pytest.mark.parametrize("t", GRIDS, ids=["even", "fine", "uneven"])
@pytest.mark.parametrize(
    ("band", "entry"), [(2.0, 0.0), (1.5, 2.9), (0.45, 2.9), (0.31, 2.9), (0.25, np.inf), (0.75, 2.9)]
)
def test_a_held_signal_enters_a_band_at_a_jump(t, band, entry):
    evaluation = Evaluation(t)
    rows = evaluation.add(HELD.at(t)[None], "y", [HELD])
    later = settled(evaluation, rows, np.zeros(1), np.ones(1), band, 0.0)
    assert later()[0] == entry


@pytest.mark.parametrize(("band", "entry"), [(0.45, 3.05), (0.35, 3.65), (0.05, np.inf)])
def test_an_entry_between_jumps_is_a_crossing(band, entry):
    """The signal is 3.5 - t from 2.9 s on and 4 - t from 3.6 s on."""
    t, line = np.linspace(0, 4, 33), Polynomial([3.7, -1.0])
    evaluation = Evaluation(t)
    rows = evaluation.add((line(t) + HELD.at(t))[None], "y", [HELD])
    later = settled(evaluation, rows, np.zeros(1), np.ones(1), band, 0.0)
    assert later()[0] == pytest.approx(entry, abs=1e-12)


def test_a_jump_at_the_last_sample_counts():
    t, held = np.linspace(0, 3, 4), Held(np.array([0.0, 1.5, 3.0]), np.array([1.0, 2.0, 5.0]))
    evaluation = Evaluation(t)
    rows = evaluation.add(held.at(t)[None], "u", [held])
    values = [one()[0] for one in (evaluation.squares(rows), magnitude(evaluation, rows), varied(evaluation, rows))]
    assert values == [7.5, 5.0, 4.0]


def test_signals_with_and_without_a_held_part_in_one_evaluation():
    t = np.linspace(0, 4, 41)
    smooth = np.sin(t)
    alone = Evaluation(t)
    first = [one()[0] for one in (lambda e, r: (e.squares(r), magnitude(e, r)))(alone, alone.add(smooth[None], "u"))]
    both = Evaluation(t)
    rows = both.add(np.array([HELD.at(t), smooth]), "u", [HELD, None])
    values = [one() for one in (both.squares(rows), magnitude(both, rows))]
    assert [value[1] for value in values] == first
    *_, square, largest, _, _ = expected(Polynomial([0.0]), t)
    np.testing.assert_allclose([value[0] for value in values], [square, largest], rtol=1e-12)


def test_an_infinite_signal_with_a_held_part():
    t, f = np.linspace(0, 4, 5), np.array([0.5, 1.0, 2.0, np.inf, np.inf])
    evaluation = Evaluation(t)
    rows = evaluation.add(f[None], "u", [HELD])
    values = [one()[0] for one in (evaluation.squares(rows), magnitude(evaluation, rows), varied(evaluation, rows))]
    assert values == [np.inf] * 3


def test_a_signal_with_nan_raises_its_name():
    t = np.linspace(0, 4, 5)
    evaluation = Evaluation(t)
    rows = evaluation.add(np.array([[0.0, 1.0, np.nan, 0.0, 0.0]]), "u", [HELD])
    with pytest.raises(ValueError, match="u must contain no nan"):
        evaluation.squares(rows)()
