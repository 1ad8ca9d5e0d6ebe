"""Evaluation of analytic functions at many times from exact jets at few.

A Chebyshev interpolant of each derivative is built from exact jets, once for a
segment, and evaluated by matrix products. Very many sorted times are divided into
cells. In each cell the Taylor series about its centre, from the exact jet there,
gives the values: by one matrix product for all cells if the times are evenly
spaced, otherwise by one per cell. All are as accurate as the jets: series are
truncated below rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan.trajectories.common import FACTORIALS, Array

if TYPE_CHECKING:
    from ctrlplan.trajectories.trajectory import Trajectory

FEW = 256
"""Number of times up to which the jets themselves are evaluated."""

_CELLS = 30_000
"""Number of sorted times from which cells are faster than an interpolant with many terms."""

_SHORT = 14
"""Number of terms of an interpolant that is faster than cells."""

_MAX_TERMS = 24
_PRODUCT = 2**18  # maximum multiplications of a matrix product in one thread
_CHUNK = 4104  # not a power of two, to avoid cache conflicts between rows


def sample(
    jet: Callable[[Array, int], Array],
    proxy: Array | None,
    duration: float,
    t: Array,
    orders: tuple[int, int],
    out: Array,
) -> None:
    """Derivatives at many times.

    Parameters
    ----------
    jet : callable
        Maps times (ntime,) and an order to (order + 1, naxes, ntime).
    proxy : ndarray or None
        Chebyshev coefficients of the derivatives, from `chebyshev_proxy`.
    duration : float
        Length [s] of the segment, from 0, in which the function is analytic.
    t : ndarray, shape (ntime,)
        Times [s] in that segment.
    orders : (int, int)
        Lowest and highest order of the derivatives.
    out : ndarray, shape (norders, naxes, ntime)
        Place of the result.
    """
    if (proxy is None or t.size > (_CELLS if proxy.shape[2] > _SHORT else 10 * _CELLS)) and _sample_cells(
        jet, duration, t, orders, out
    ):
        return
    if proxy is None:
        _sample_chunks(jet, t, orders, out)
    else:
        _sample_proxy(proxy, duration, t, out)


def _sample_cells(
    jet: Callable[[Array, int], Array], duration: float, t: Array, orders: tuple[int, int], out: Array
) -> bool:
    """Derivatives at sorted times by Taylor series in cells; False if times are not sorted, or series too long."""
    low, high = orders
    size = np.abs(jet(np.linspace(0.0, duration, 9), high + _MAX_TERMS + 2)).max(axis=2)
    if _is_uniform(t, duration):
        step = float(t[-1] - t[0]) / (t.size - 1)
        for cell in (2048, 1024, 512, 256, 128, 64):
            terms = _taylor_terms(size, 0.5 * cell * step, low, high)
            if terms is not None:
                _sample_uniform(jet, float(t[0]), step, cell, terms, low, out)
                return True
    elif t[-1] > t[0] and bool(np.all(t[1:] >= t[:-1])):
        for cell in (4096, 2048, 1024, 512, 256):
            ncells = -(-t.size // cell)
            terms = _taylor_terms(size, 0.5 * float(t[-1] - t[0]) / ncells, low, high)
            if terms is not None:
                _sample_sorted(jet, t, ncells, terms, low, out)
                return True
    return False


def sample_in_batches(plan: Trajectory, t: Array, low: int, high: int, left: bool) -> Array:
    """Derivatives low to high (high - low + 1, naxes, ntime) of a trajectory whose segments are evaluated together."""
    times, last = plan.breakpoints, plan.breakpoints.size - 2
    segments = np.searchsorted(times, t, side="left" if left else "right") - 1
    if not left:
        segments[t == times[-1]] = last
    inside = np.flatnonzero((segments >= 0) & (segments <= last))
    found = plan.segments_jet(segments[inside], t[inside] - times[segments[inside]], high)[low:]
    if inside.size == t.size:
        return found
    out = np.zeros((high - low + 1, plan.naxes, t.size))
    out[:, :, inside] = found
    if low == 0:
        out[0] += np.where(segments < 0, plan.initial[:, None], 0.0) + np.where(
            segments > last, plan.final[:, None], 0.0
        )
    return out


def _is_uniform(t: Array, duration: float) -> bool:
    """Whether the times are evenly spaced up to rounding of times within the segment."""
    step = (t[-1] - t[0]) / (t.size - 1)
    slack = 4.0 * np.finfo(float).eps * duration
    if not step > 0.0 or abs(t[1] - t[0] - step) > slack:
        return False
    ramp = step * np.arange(min(t.size, 2 * _CHUNK))
    beyond = np.empty_like(ramp)
    for first in range(0, t.size, ramp.size):
        part = t[first : first + ramp.size]
        excess = np.subtract(part, ramp[: part.size], out=beyond[: part.size])
        base = t[0] + first * step
        if excess.max() - base > slack or base - excess.min() > slack:
            return False
    return True


def _taylor_terms(size: Array, radius: float, low: int, high: int) -> int | None:
    """Number of significant terms of the series, from the magnitudes (order, naxes) of the derivatives."""
    powers = radius ** np.arange(_MAX_TERMS + 3) / FACTORIALS[: _MAX_TERMS + 3]
    tails = np.stack([size[nu : nu + _MAX_TERMS + 3] * powers[:, None] for nu in range(low, high + 1)])
    small = tails <= 0.25 * np.finfo(float).eps * tails.max(axis=1, keepdims=True)
    # Terms larger than the value would cancel and lose digits.
    if np.any(tails.sum(axis=1) > 4.0 * tails[:, 0]):
        return None
    # Two terms in a row, so that an odd or even function does not end its series early.
    done = (small[:, 1:-1] & small[:, 2:]).all(axis=(0, 2))
    return int(done.argmax()) + 1 if done.any() else None


def _sample_uniform(
    jet: Callable[[Array, int], Array], first: float, step: float, cell: int, terms: int, low: int, out: Array
) -> None:
    norders, naxes, count = out.shape
    ncells = count // cell
    centres = first + step * (0.5 * (cell - 1) + cell * np.arange(ncells + 1, dtype=float))
    jets = jet(centres, low + norders + terms - 2)
    radius = 0.5 * cell * step
    powers = np.linspace(-1.0 + 1.0 / cell, 1.0 - 1.0 / cell, cell) ** np.arange(terms)[:, None]
    scale = radius ** np.arange(terms) / FACTORIALS[:terms]
    main = ncells * cell
    block = max(1, _PRODUCT // (terms * cell))
    for row in range(norders):
        table = np.ascontiguousarray(np.moveaxis(jets[low + row : low + row + terms], 0, -1) * scale)
        for axis in range(naxes):
            whole = out[row, axis, :main].reshape(ncells, cell)
            for begin in range(0, ncells, block):
                np.matmul(table[axis, begin : min(begin + block, ncells)], powers, out=whole[begin : begin + block])
            if main < count:
                np.matmul(table[axis, ncells], powers[:, : count - main], out=out[row, axis, main:])


def _sample_sorted(jet: Callable[[Array, int], Array], t: Array, ncells: int, terms: int, low: int, out: Array) -> None:
    norders, naxes, _ = out.shape
    edges: Array = np.linspace(t[0], t[-1], ncells + 1)
    centres, radius = 0.5 * (edges[:-1] + edges[1:]), 0.5 * float(t[-1] - t[0]) / ncells
    jets = jet(centres, low + norders + terms - 2)
    scale = radius ** np.arange(terms) / FACTORIALS[:terms]
    table = np.stack([np.moveaxis(jets[nu : nu + terms], 0, -1) for nu in range(low, low + norders)]) * scale
    table = np.moveaxis(table, 2, 0).reshape(ncells, -1, terms)
    flat = out.reshape(norders * naxes, t.size)  # a view
    bounds = np.searchsorted(t, edges[1:-1]).tolist()
    for k, (first, last) in enumerate(zip([0, *bounds], [*bounds, t.size], strict=True)):
        if first < last:
            powers = np.empty((terms, last - first))
            powers[0] = 1.0
            x = (t[first:last] - centres[k]) / radius
            for n in range(1, terms):
                np.multiply(powers[n - 1], x, out=powers[n])
            np.matmul(table[k], powers, out=flat[:, first:last])


def _sample_proxy(coefficients: Array, duration: float, t: Array, out: Array) -> None:
    nrows, naxes, size = coefficients.shape
    flat, target = coefficients.reshape(nrows * naxes, size), out.reshape(nrows * naxes, t.size)  # views
    middle = radius = 0.5 * duration
    part = max(1, min(_CHUNK, _PRODUCT // flat.size))
    basis = np.empty((max(size, 2), min(_CHUNK, t.size)))
    basis[0] = 1.0
    for first in range(0, t.size, _CHUNK):
        x = (t[first : first + _CHUNK] - middle) / radius
        terms = basis[:, : x.size]
        terms[1] = x
        top = 1  # T_{top + k} = 2 T_top T_k - T_{top - k}: doubles the number in each pass
        while top < size - 1:
            more = min(top, size - 1 - top)
            block = terms[top + 1 : top + more + 1]
            np.multiply(2.0 * terms[top], terms[1 : more + 1], out=block)
            block -= terms[top - more : top][::-1]
            top += more
        for begin in range(0, x.size, part):
            end = min(begin + part, x.size)
            np.matmul(flat, terms[:size, begin:end], out=target[:, first + begin : first + end])


def _sample_chunks(jet: Callable[[Array, int], Array], t: Array, orders: tuple[int, int], out: Array) -> None:
    for begin in range(0, t.size, _CHUNK):
        out[:, :, begin : begin + _CHUNK] = jet(t[begin : begin + _CHUNK], orders[1])[orders[0] :]
