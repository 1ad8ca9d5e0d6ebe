"""The exact response of a linear system to trajectories.

Between breakpoints the input is analytic. It is cut into cells so short that
its Taylor series dies within a few terms; series and state together are then a
linear system without input (a nilpotent chain in front of the loop), and one
matrix exponential, by scaling and squaring, carries the state over every cell.
The cells are then halved, all at once and through the same squarings, until the
state's own Taylor series converges in them, and the samples are read off that
series: any spacing, no interpolation, and no stiffness limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, pascal

Array = NDArray[np.float64]

_TERMS = 18
"""Taylor terms of the input in a cell."""

Jet = Callable[[float, float, Array, int], Array]
"""(moment, origin, s, order) -> derivatives (order + 1, ninputs, ntime) at origin + s
of the analytic functions that hold at `moment`."""


def exact_states(a: Array, b: Array, jet: Jet, breakpoints: Sequence[float], timepts: Array, initial: Array) -> Array:
    """States of x' = a x + b w at the sample times.

    Parameters
    ----------
    a, b : ndarray, shapes (nstates, nstates) and (nstates, ninputs)
        The system.
    jet : callable
        Jets of the input, see `Jet`.
    breakpoints : sequence of float
        Times [s] between which the input is analytic.
    timepts : ndarray, shape (ntime,)
        Sample times [s], increasing.
    initial : ndarray, shape (nstates,)
        State at the first of them.

    Returns
    -------
    ndarray, shape (nstates, ntime)
    """
    if not a.size:
        return np.empty((0, timepts.size))
    # Scaling by powers of two changes no digit and lets the cells be longer.
    balanced, scaling = matrix_balance(a, permute=False)
    scale = np.diag(scaling)
    driven: Array = b / scale[:, None]
    first, last = float(timepts[0]), float(timepts[-1])
    inner = sorted({float(t) for t in breakpoints if first < t < last})
    out = np.empty((len(a), timepts.size))
    state: Array = initial / scale
    for left, right in zip([first, *inner], [*inner, last], strict=True):
        begin, end = np.searchsorted(timepts, [left, right], side="left")
        end += right == last
        samples: Array = timepts[begin:end] - left
        values, state = _leg(np.asarray(balanced, dtype=float), driven, jet, left, right, samples, state)
        out[:, begin:end] = values
    return out * scale[:, None]


def _leg(a: Array, b: Array, jet: Jet, left: float, right: float, samples: Array, state: Array) -> tuple[Array, Array]:
    """States at the samples (times since `left`) and at the end of one analytic leg."""
    moment, duration = 0.5 * (left + right), right - left
    ncells = _ncells(lambda s, order: jet(moment, left, s, order), duration)
    h = duration / ncells
    starts = h * np.arange(ncells, dtype=float)
    series = jet(moment, left, starts, _TERMS - 1)  # (terms, ninputs, ncells), about the cells' starts
    series *= (h ** np.arange(_TERMS, dtype=float) / _FACTORIALS)[:, None, None]
    levels = max(0, int(np.ceil(np.log2(max(1.0, float(np.linalg.norm(h * a, 1)))))))
    *halvings, (change, carry_input) = _propagators(a, b, h, levels)
    states = np.empty((len(a), ncells + 1))
    states[:, 0] = state
    forced = carry_input @ series.reshape(-1, ncells)
    for k in range(ncells):
        states[:, k + 1] = states[:, k] + (change @ states[:, k] + forced[:, k])
    end, states = states[:, -1], states[:, :-1]
    if not samples.size:
        return np.empty((len(a), 0)), end
    cells = np.arange(ncells)
    for change, carry_input in reversed(halvings):
        h *= 0.5
        first, second = _halved(series)
        middle = states + (change @ states + carry_input @ first.reshape(carry_input.shape[1], -1))
        states = np.stack([states, middle], axis=2).reshape(len(a), -1)
        series = np.stack([first, second], axis=3).reshape(*series.shape[:2], -1)
        cells = (2 * cells[:, None] + np.arange(2)).ravel()
        if cells.size > 4 * samples.size + 64:  # stiff: only cells with samples in them matter
            used = np.isin(cells, np.minimum(samples / h, cells[-1]).astype(np.intp))
            cells, states, series = cells[used], states[:, used], series[:, :, used]
    where = np.clip(np.searchsorted(cells, samples / h, side="right") - 1, 0, cells.size - 1)
    sigma = samples / h - cells[where]
    return _evaluated(_taylor(h * a, h * b, states, series), where, sigma), end


def _ncells(jet: Callable[[Array, int], Array], duration: float) -> int:
    """Cells in which the input's Taylor series dies within the terms kept."""
    order = _TERMS + 7
    size = np.abs(jet(np.linspace(0.0, duration, 9), order)).max(axis=2)  # (order + 1, ninputs)
    ncells = 1
    while ncells < 4096:
        terms = size * ((duration / ncells) ** np.arange(order + 1) / _LONG_FACTORIALS)[:, None]
        # Terms larger than the input itself would cancel, and cost digits.
        if np.all(terms[_TERMS:] <= 1e-17 * terms.max(axis=0)) and np.all(terms.sum(axis=0) <= 8.0 * terms[0]):
            break
        ncells *= 2
    return ncells


def _propagators(a: Array, b: Array, h: float, levels: int) -> list[tuple[Array, Array]]:
    """Change of state over h/2^levels, ..., h/2, h, as maps of the state before and of the input's terms.

    The shortest by Taylor series, each next one from two of the one before;
    shapes (n, n) and (n, terms * ninputs). The change, not the state: beside a
    fast mode, squaring would cost a slow one a digit every three levels.
    """
    n, m = b.shape
    short = h * 0.5**levels
    width = n + _TERMS * m
    units = np.zeros((_TERMS, m, width))
    units.reshape(-1, width)[:, n:] = np.eye(_TERMS * m)
    carry = np.sum(_taylor(short * a, short * b, np.eye(n, width), units)[1:], axis=0)
    maps = [(carry[:, :n], carry[:, n:])]
    first, second = (half[:, :, n:].reshape(_TERMS * m, -1) for half in _halved(units))
    for _ in range(levels):
        change, driven = maps[-1]
        early = driven @ first
        maps.append((2.0 * change + change @ change, early + change @ early + driven @ second))
    return maps


def _halved(series: Array) -> tuple[Array, Array]:
    """Taylor terms (terms, ninputs, ncells) of the first and second half of each cell, in their own time."""
    first = series * _HALVES[:, None, None]
    return first, (_SECOND_HALF @ series.reshape(_TERMS, -1)).reshape(series.shape)


def _taylor(a: Array, b: Array, states: Array, series: Array) -> list[Array]:
    """Taylor terms of the state over a unit of time, where norm(a) <= 1."""
    terms = [states]
    for j in range(_TERMS + 1):
        following = a @ terms[-1]
        if j < _TERMS:
            following = following + b @ series[j]
        terms.append(following / (j + 1))
    return terms


def _evaluated(terms: list[Array], where: NDArray[np.intp], sigma: Array) -> Array:
    """Taylor series of cells `where`, a fraction sigma into them."""
    out = np.take(terms[-1], where, axis=1)
    gathered = np.empty_like(out)
    for term in reversed(terms[:-1]):
        out *= sigma
        out += np.take(term, where, axis=1, out=gathered, mode="clip")
    return out


_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, _TERMS)]))
_LONG_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, _TERMS + 8)]))
_HALVES: Array = 0.5 ** np.arange(_TERMS, dtype=float)
# The polynomial of the whole cell about its middle, in the time of its second half.
_SECOND_HALF = np.triu(pascal(_TERMS, kind="upper")).astype(float) * _HALVES
