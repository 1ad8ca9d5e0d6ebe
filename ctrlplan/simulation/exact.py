"""Exact response of linear systems to trajectories and to samples.

Between breakpoints the input is analytic. Time is divided into cells in which
the Taylor series of the input converges within a few terms. Series and state
then form a linear system without input (the state with a nilpotent chain as its input),
and one matrix exponential, by scaling and squaring, propagates the state over
every cell. The number of squarings is the minimum for convergence of the Taylor
series; they are computed in double-double arithmetic where terms cancel, as for
matrices far from normal.

With evenly spaced samples every cell contains the same number of them. A table
of exponentials, computed by doubling, then gives all samples from the states at
the starts of the cells by a matrix product, also for several systems with the
same input. Otherwise the cells are halved together, by the same squarings, until
the Taylor series of the state converges in them, and samples are evaluated from
that series. Neither way interpolates or has a stiffness limit. Values that
overflow are infinite, and so is what depends on them; others stay finite.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import lru_cache, reduce
from itertools import repeat
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, pascal

from ctrlplan._types import Array
from ctrlplan.simulation.analytic_segments import TERMS, AnalyticSegment, Jet, spacing
from ctrlplan.simulation.exponential import MANY_STATES, changes_of_many
from ctrlplan.simulation.pairs import pair_product, pair_sum

_CROSSOVER = 8
"""Number of samples in a cell above which a table for all cells is faster than a series in each; and number of states
up to which products of step matrices are faster than single steps."""

_POWERS = 5
"""Number of further powers of a matrix with a computed norm: p (p - 1) <= TERMS + 2."""

_CANCELLED = 16.0
"""Ratio of the terms of a matrix product to its result above which it is computed in twice the digits or avoided."""

_NUMBERS = 2**17
"""Maximum number of entries in an array of exponentials with one for each spacing."""


def exact_states(
    a: Array,
    b: Array,
    jet: Jet,
    breakpoints: Sequence[float],
    timepts: Array,
    initial: Array,
    read: Array | None = None,
) -> Array:
    """States of x' = a x + b w at the sample times.

    Parameters
    ----------
    a, b : ndarray, shapes (..., nstates, nstates) and (..., nstates, ninputs)
        The system; or, along one axis in front, several with the same input.
    jet : callable
        Jets of the input; see `Jet`.
    breakpoints : sequence of float
        Times [s] between which the input is analytic.
    timepts : ndarray, shape (ntime,)
        Sample times [s], increasing.
    initial : ndarray, shape (..., nstates)
        State at the first of them.
    read : ndarray, shape (..., nrows, nstates), optional
        Output matrix: combinations of states to return in place of the states.

    Returns
    -------
    ndarray, shape (..., nstates, ntime) or (..., nrows, ntime)
    """
    if a.ndim == 2:
        return exact_states(a[None], b[None], jet, breakpoints, timepts, initial[None], read)[0]
    scale, a, b, state = _balanced(a, b, initial)
    read = np.diag(scale) if read is None else read * scale
    read = np.broadcast_to(read, (len(a), *read.shape[-2:]))
    out: Array = np.zeros((len(a), read.shape[1], timepts.size))
    if not scale.size:
        return out
    first, last = float(timepts[0]), float(timepts[-1])
    ends = [first, *sorted({float(t) for t in breakpoints if first < t < last}), last]
    places = [*np.searchsorted(timepts, ends[:-1]).tolist(), timepts.size]
    with np.errstate(all="ignore"):
        segments = [
            AnalyticSegment.of(jet, left, right, timepts[begin:end] - left, _CROSSOVER if len(a) == 1 else 1)
            for left, right, begin, end in zip(ends[:-1], ends[1:], places[:-1], places[1:], strict=True)
        ]
        changes = _changes(a, b, segments)
        for segment, own, begin, end in zip(segments, changes, places[:-1], places[1:], strict=True):
            state = _followed_segment(a, b, segment, own, state, read, out[:, :, begin:end])
    return out


def sampled_states(
    a: Array, b: Array, samples: Array, timepts: Array, initial: Array, scale: Array | None = None
) -> Array:
    """States of x' = a x + b u, where u is linear between samples.

    Parameters
    ----------
    a, b : ndarray, shapes (nstates, nstates) and (nstates, ninputs)
        The system.
    samples : ndarray, shape (ninputs, ntime)
        The input at the sample times.
    timepts : ndarray, shape (ntime,)
        Sample times [s], increasing.
    initial : ndarray, shape (nstates,)
        State at the first of them.
    scale : ndarray, shape (nstates,), optional
        Balancing scale of the system matrix, if it is known.

    Returns
    -------
    ndarray, shape (nstates, ntime)
    """
    scale, a, b, state = _balanced(a[None], b[None], initial[None], scale)
    out = np.empty((timepts.size, scale.size))
    out[:1] = state
    steps: Array = np.diff(timepts)
    even = spacing(timepts - timepts[0], float(timepts[-1] - timepts[0]))
    if even:  # spacings that differ only by rounding share an exponential
        steps[:] = even
    terms = np.concatenate([samples[:, :-1], np.diff(samples)]).T  # Taylor terms, in units of each interval
    n = scale.size
    part = max(1, _NUMBERS // max(1, n * (n + 1 if even else n + terms.shape[1])))
    with np.errstate(all="ignore"):
        if even and n > _CROSSOVER:
            changes = changes_over(even * a, even * b, 2)
            change = changes[-1][0, :, :n].copy()  # products with aligned rows are faster
            out[1:] = _one_by_one(repeat(change, len(terms)), terms @ changes[-1][0, :, n:].T, state[0])
            if not np.isfinite(out[-1]).all():  # an overflow stays
                out[:] = _marched(state, changes, terms.T.reshape(2, len(samples), -1))[0].T
            return (out * scale).T
        for begin in range(0, steps.size if n else 0, part):
            these = slice(begin, begin + part)
            spacings, which = np.unique(steps[these], return_inverse=True)
            h = spacings[:, None, None]
            changes = changes_over(h * a, h * b, 2)
            if spacings.size == 1:
                change = np.broadcast_to(changes[-1][:, :, :n], (which.size, n, n))
                forced = terms[these] @ changes[-1][0, :, n:].T
            else:
                change = changes[-1][which]
                forced = (change[:, :, n:] @ terms[these, :, None])[:, :, 0]
            found = out[begin + 1 : these.stop + 1]
            found[:] = _recurrence(change[:, :, :n], forced, out[begin])
            for k in range(_first_overflow(found.T), len(found)):
                series, own = terms[begin + k].reshape(2, -1, 1), [level[which[k]] for level in changes]
                found[k] = _propagated(out[begin + k][:, None], series, own)[:, 0]
    return (out * scale).T


def held_change(a: Array, b: Array, duration: float) -> Array:
    """Matrix (nstates, nstates + ninputs): change of states over a duration, from states and constant inputs."""
    scale, a, b, _ = _balanced(a[None], b[None], np.zeros((1, len(a))))
    with np.errstate(all="ignore"):
        change = changes_over(duration * a, duration * b, 1)[-1][0] if scale.size else np.zeros((0, b.shape[2]))
    change[:, : scale.size] /= scale
    return np.asarray(scale[:, None] * change)


def matrix_product(left: Array, right: Array) -> Array:
    """Matrix product in which 0 times inf is 0 and undefined results are infinite.

    A signal that has overflowed affects only what depends on it.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        product: Array = left @ right
        if np.isfinite(product).all():
            return product
        left_infinite, right_infinite = ~np.isfinite(left), ~np.isfinite(right)
        product = np.where(left_infinite, 0.0, left) @ np.where(right_infinite, 0.0, right)
    votes = np.where(left_infinite, np.sign(left), 0.0) @ np.sign(right) + np.sign(left) @ np.where(
        right_infinite, np.sign(right), 0.0
    )
    touched = left_infinite.astype(float) @ (right != 0.0) + (left != 0.0) @ right_infinite.astype(float) > 0.0
    product[touched] = np.copysign(np.inf, votes[touched])
    product[np.isnan(product)] = np.inf
    return product


def state_scale(a: Array) -> Array:
    """Balancing scale (nstates,) of a system matrix, powers of two."""
    if not a.size:
        return np.ones(0)
    with np.errstate(invalid="ignore"):  # scipy also converts the scale to an index, which is not used
        scale: Array = matrix_balance(a, permute=False, separate=True)[1][0]
    return scale


def largest_change(a: Array, duration: float) -> float:
    """Largest magnitude in exp(a t) - 1 for t = duration, duration/2, ..., 0."""
    with np.errstate(all="ignore"):
        changes = changes_over(duration * a, np.zeros((len(a), 0)), 1)
    return max(float(np.abs(change).max(initial=0.0)) for change in changes)


def _balanced(a: Array, b: Array, initial: Array, scale: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """Balancing scale (nstates,), and systems and initial states in it.

    Powers of two, which cause no rounding; balancing allows longer cells.
    """
    if scale is None:
        scale = state_scale(a[0] if len(a) == 1 else np.abs(a).max(axis=0)) if a.size else np.ones(0)
    if (scale == 1.0).all():
        return scale, a, b, initial
    return scale, a * (scale / scale[:, None]), b / scale[:, None], initial / scale


_Changes = dict[float, list[Array]]
"""`changes_over` a whole cell (1), and parts of a cell, in cells."""


def _changes(a: Array, b: Array, segments: Sequence[AnalyticSegment]) -> list[_Changes]:
    """Changes of states in each segment with evenly spaced samples.

    Few states are computed in one call: then the number of calls is what takes time.
    """
    wanted = [(k, s, part) for k, s in enumerate(segments) if s.per for part in {1.0, s.first, s.rest or 0.0} - {0.0}]
    found: list[_Changes] = [{} for _ in segments]
    (count, n), m = a.shape[:2], b.shape[2]
    for group in [wanted] if wanted and count * n <= _CROSSOVER else [[one] for one in wanted]:
        times = np.array([part * s.h for _, s, part in group])[:, None, None, None]
        nterms = max(s.nterms for _, s, _ in group)
        halvings = max(s.per.bit_length() - 1 if part == 1.0 else 0 for _, s, part in group)
        flat_a, flat_b = ((times * x).reshape(len(group) * count, *x.shape[1:]) for x in (a, b))
        levels = [level.reshape(len(group), count, n, -1) for level in changes_over(flat_a, flat_b, nterms, halvings)]
        for i, (k, s, part) in enumerate(group):
            found[k][part] = [level[i, ..., : n + s.nterms * m] for level in levels]
    return found


def _followed_segment(
    a: Array, b: Array, segment: AnalyticSegment, changes: _Changes, state: Array, read: Array, out: Array
) -> Array:
    """Compute outputs at the samples of a segment; return the states at its end."""
    while segment.per and not np.isfinite(changes[1.0][-1]).all():  # an unstable system overflows within a cell
        segment = segment.shorter()
        (changes,) = _changes(a, b, [segment])
    if segment.per:
        return _even_segment(segment, changes, state, read, out)
    h = segment.h
    terms = segment.series(round(segment.duration / h))
    ends = np.empty_like(state)
    for i in range(len(a)):
        values, ends[i] = _any_segment(h * a[i], h * b[i], terms, segment.samples / h, state[i])
        out[i] = matrix_product(read[i], values)
    return ends


def _even_segment(segment: AnalyticSegment, changes: _Changes, state: Array, read: Array, out: Array) -> Array:
    """The same for evenly spaced samples."""
    (count, n), per, last = state.shape, segment.per, segment.last
    whole, remainder = divmod(segment.samples.size, per)
    cells = segment.series(max(last, whole) + 1)
    nterms, m = cells.shape[:2]
    chain = cells.reshape(-1, cells.shape[2])
    known = np.empty((count, cells.shape[2], n + len(chain)))
    known[:, :, :n] = _marched(state, changes[1.0], cells[:, :, :-1]).swapaxes(1, 2)
    known[:, :, n:] = chain.T

    table = np.zeros((count, n, per, known.shape[2]))  # from the start of a cell to its samples
    if segment.first:
        table[:, :, 0] = _in_cell(changes[segment.first][-1], segment.first, nterms, m)
    have = 1
    for change in changes[1.0][-per.bit_length() : -1]:
        time = have / per
        step = _in_cell(change, time, nterms, m)
        table[:, :, have : 2 * have] = _followed(table[:, :, :have], step, _shift(nterms, m, time))
        have *= 2
    rows = (read @ table.reshape(count, n, -1)).reshape(count, -1, *table.shape[2:]).swapaxes(2, 3)
    rows[:, :, :n] += read[..., None]
    main = out[:, :, : whole * per].reshape(*out.shape[:2], whole, per)
    np.matmul(known[:, None, :whole], rows, out=main)
    out[:, :, whole * per :] = (known[:, None, whole : whole + 1] @ rows[..., :remainder])[:, :, 0]
    for i in _overflowed(out):
        main[i] = matrix_product(known[i, :whole], rows[i])
        out[i, :, whole * per :] = matrix_product(known[i, whole : whole + 1], rows[i, ..., :remainder])[:, 0]
    if segment.rest is None:
        ending, last = table[:, :, remainder - 1], whole if remainder else whole - 1
    elif segment.rest:
        ending = _in_cell(changes[segment.rest][-1], segment.rest, nterms, m)
    else:
        return known[:, last, :n]
    return known[:, last, :n] + matrix_product(ending, known[:, last, :, None])[:, :, 0]


def _in_cell(change: Array, part: float, nterms: int, m: int) -> Array:
    """Change over a part of a cell from the input terms of the whole cell."""
    n = change.shape[-2]
    return np.concatenate([change[..., :n], change[..., n:] * np.repeat(part ** np.arange(nterms), m)], axis=-1)


def _any_segment(a: Array, b: Array, series: Array, samples: Array, state: Array) -> tuple[Array, Array]:
    """States of one system at arbitrary samples, and at the end of the segment; the unit of time is a cell."""
    n, ncells = len(a), series.shape[2]
    changes = changes_over(a, b, len(series))
    states = _marched(state[None], [change[None] for change in changes], series)[0]
    end, states = states[:, -1], states[:, :-1]
    if not samples.size:
        return np.empty((n, 0)), end
    ending = samples >= ncells
    where = np.minimum(samples, ncells - 1.0).astype(np.intp)
    sigma, h = np.where(ending, 0.0, samples - where), 1.0
    for level in range(len(changes) - 2, -1, -1):
        if not sigma.any():
            break
        h *= 0.5
        first, second = _halved(series)
        middle = _propagated(states, first, changes[: level + 1])
        states = np.stack([states, middle], axis=2).reshape(n, -1)
        series = np.stack([first, second], axis=3).reshape(*first.shape[:2], 2 * first.shape[2])
        later = sigma >= 0.5  # doubling and this difference are exact; repeated until all remainders are 0
        where, sigma = 2 * where + later, 2.0 * sigma - later
        if states.shape[1] > 4 * samples.size + 64:  # stiff: only cells that contain samples are required
            used, where = np.unique(where, return_inverse=True)
            states, series = states[:, used], series[:, :, used]
    found = _evaluated(_taylor(h * a, h * b, states, series), where, sigma) if sigma.any() else states[:, where]
    found[:, ending] = end[:, None]
    return found, end


def changes_over(a: Array, b: Array, nterms: int, halvings: int = 0) -> list[Array]:
    """Change of states over ..., 1/4, 1/2, 1 units of time, with a minimum number of halvings.

    Matrices (..., n, n + nterms * ninputs) from states and Taylor terms of the
    input, each in its own unit of time. By Taylor series up to the time given by
    `_products` for each system, then by squaring. The change is squared instead
    of the transition matrix: next to a fast mode a slow one would otherwise lose
    a digit every three squarings.
    """
    if a.ndim == 2:
        return [change[0] for change in changes_over(a[None], b[None], nterms, halvings)]
    if len(a) == 1 and a.shape[1] >= MANY_STATES and nterms <= 2 and not halvings:
        quick = changes_of_many(a[0], b[0], nterms)
        if quick is not None:
            return [change[None] for change in quick]
    products, minimum = _products(a, b)
    levels = max(halvings, int(minimum.max()))
    found = _doubled(products, minimum, nterms, levels)
    n = a.shape[1]
    own = np.array([change[..., :n] for change in found])
    cancelled = np.any(_cancelling(own[:-1], own[:-1], own[1:]), axis=0, out=np.zeros(len(a), dtype=bool))
    large = np.abs(products[0, :, :, :n]).sum(axis=1).max(axis=1) > 0.25 * _CANCELLED
    if large.any():
        powers = products[:, large, :, :n]
        cancelled[large] |= np.any(_cancelling(powers[:1], powers[:-1], powers[1:]), axis=0)
    if cancelled.any():
        precise = _doubled_precisely(products[0, cancelled], minimum[cancelled], nterms, levels)
        for change, better in zip(found, precise, strict=True):
            change[cancelled] = np.where(np.isfinite(better).all(axis=(1, 2), keepdims=True), better, change[cancelled])
    return found


def _products(a: Array, b: Array) -> tuple[Array, NDArray[np.intp]]:
    """Products a^k [a, b] (nproducts, nsystems, n, n + ninputs) over a time of 2^-halvings, and halvings (nsystems,).

    The number of halvings ensures convergence of the Taylor series: the roots of
    the norms of the powers of the matrix are at most 1. For a nonnormal matrix
    they are much smaller than its norm. Al-Mohy and Higham, A new scaling and squaring algorithm for
    the matrix exponential, SIAM J. Matrix Anal. Appl. 31 (2009), 970-989:
    ``norm(a^k) <= max(norm(a^p)^(1/p), norm(a^(p+1))^(1/(p+1)))^k`` for k >= p (p - 1).
    """
    norm = np.abs(a).sum(axis=1).max(axis=1)
    if not (np.isfinite(norm).all() and np.isfinite(b).all()):
        raise ValueError("the system matrices A and B times the duration must be below 1e308, got an overflow")
    halvings = np.ceil(np.log2(np.maximum(norm, 1.0)))
    n = a.shape[1]
    both = np.concatenate([a, b], axis=2) * 0.5 ** halvings[:, None, None]
    products = np.empty((TERMS + 1, *both.shape))
    products[0] = both
    for k in range(_POWERS):
        np.matmul(both[..., :n], products[k], out=products[k + 1])
    if halvings.any():
        sizes = np.abs(products[: _POWERS + 1, ..., :n]).sum(axis=2).max(axis=2)
        roots = sizes ** (1.0 / np.arange(1.0, _POWERS + 2.0)[:, None])
        root = np.maximum(roots[:-1], roots[1:]).min(axis=0)
        # The bounds prevent overflow of the products and of scaled rounding errors.
        saved = np.floor(-np.log2(np.clip(root, 2.0**-50, 1.0))) * (np.abs(b).max(axis=(1, 2), initial=0.0) < 1e200)
        saved = np.minimum(saved, halvings)
        halvings, factor = halvings - saved, 2.0 ** saved[:, None, None]
        for k in range(_POWERS + 1):
            products[k] *= factor ** (k + 1.0)
    for k in range(_POWERS, TERMS):
        np.matmul(products[0, ..., :n], products[k], out=products[k + 1])
    return products, halvings.astype(np.intp)


def _doubled(products: Array, minimum: NDArray[np.intp], nterms: int, levels: int) -> list[Array]:
    """Changes over 2^-levels, ..., 1/2, 1 units of time: by the series up to 2^-minimum, then by squaring."""
    n, m = products.shape[2], products.shape[3] - products.shape[2]
    shift, powers = _shift(nterms, m, 1.0), np.repeat(0.5 ** np.arange(nterms), m)
    orders = np.arange(1.0, len(products) + 1.0)[:, None, None, None]
    found: list[Array] = []
    for level in range(levels, -1, -1):
        change, squared = np.empty((len(minimum), n, n + nterms * m)), minimum > level
        if squared.any():
            before = found[-1][squared]
            after = _followed(before[:, :, None, :], before, shift)[:, :, 0]
            after[..., n:] *= powers
            change[squared] = after
        if not squared.all():
            terms, shorter = (products, minimum) if not squared.any() else (products[:, ~squared], minimum[~squared])
            if (shorter < level).any():
                terms = terms * (0.5 ** (level - shorter[:, None, None])) ** orders
            # einsum gives equal sums for equal rows, which matmul does not guarantee.
            sums = np.einsum("kr,jk->rj", terms.reshape(orders.size, -1), _WEIGHTS[:nterms])
            change[~squared] = _arranged(sums, n, m)
        found.append(change)
    return found


def _cancelling(left: Array, right: Array, result: Array) -> NDArray[np.bool_]:
    """Matrix products (...) with cancellation: terms much larger than factors and result, and than 1."""
    terms = (np.abs(left) @ np.abs(right)).max(axis=(-2, -1))
    sizes = (np.abs(matrix).max(axis=(-2, -1), initial=1.0) for matrix in (left, right, result))
    found: NDArray[np.bool_] = terms > _CANCELLED * reduce(np.maximum, sizes)
    return found


def _doubled_precisely(both: Array, minimum: NDArray[np.intp], nterms: int, levels: int) -> list[Array]:
    """The same as `_doubled` in double-double arithmetic, from [a, b] over a time of 2^-minimum."""
    n, m = both.shape[1], both.shape[2] - both.shape[1]
    powers = np.concatenate([np.ones(n), np.repeat(0.5 ** np.arange(nterms), m)])
    shift, orders = _shift(nterms, m, 1.0), np.arange(1.0, TERMS + 2.0)
    products = [(both, np.zeros_like(both))]
    while len(products) < orders.size:
        products.append(pair_product((both[..., :n], np.zeros_like(both[..., :n])), products[-1]))
    series = [np.stack(half, axis=-1) for half in zip(*products, strict=True)]
    change, errors = (np.zeros((len(minimum), n, powers.size)) for _ in range(2))
    found: list[Array] = []
    for level in range(levels, -1, -1):
        squared = minimum > level
        if squared.any():
            old = change[squared], errors[squared]
            new = pair_sum(old, old, pair_product((old[0][..., :n], old[1][..., :n]), old))
            if m:
                more = pair_product((old[0][..., n:], old[1][..., n:]), (shift, np.zeros_like(shift)), m)
                forced = pair_sum((new[0][..., n:], new[1][..., n:]), more)
                new[0][..., n:], new[1][..., n:] = forced
            change[squared], errors[squared] = new[0] * powers, new[1] * powers
        if not squared.all():
            part = 0.5 ** (level - minimum[~squared, None, None, None])
            terms, small = ((half[~squared] * part**orders).reshape(-1, orders.size) for half in series)
            sums = pair_product((terms, small), (_WEIGHTS[:nterms].T, _WEIGHTS_ERROR[:nterms].T))
            change[~squared], errors[~squared] = (_arranged(half, n, m) for half in sums)
        found.append(change.copy())
    return found


def _arranged(sums: Array, n: int, m: int) -> Array:
    """Change of states (nsystems, n, n + nterms * m) from sums (nsystems * n * (n + m), nterms) of products."""
    sums = sums.reshape(-1, n, n + m, sums.shape[-1])
    forced = sums[:, :, n:].swapaxes(2, 3).reshape(len(sums), n, -1)
    return np.concatenate([sums[:, :, :n, 0], forced], axis=2)


@lru_cache(maxsize=64)
def _shift(nterms: int, m: int, time: float) -> Array:
    """Change of the Taylor terms of the input over a time."""
    k = np.arange(nterms)
    powers = time ** np.maximum(k - k[:, None], 0.0)
    return np.kron(_PASCAL[:nterms, :nterms] * powers - np.eye(nterms), np.eye(m))


def _followed(early: Array, change: Array, terms: Array) -> Array:
    """Changes of states over given times (..., n, ntime, width), followed by one more change."""
    n = change.shape[-2]
    both = early + change[..., None, :] + early[..., :n] @ change[..., None, :, :]
    both[..., n:] += early[..., n:] @ terms
    if not np.isfinite(both.sum()):
        both = early + change[..., None, :] + matrix_product(early[..., :n], change[..., None, :, :])
        both[..., n:] += matrix_product(early[..., n:], terms)
        both[np.isnan(both)] = np.inf
    return both


def _marched(state: Array, changes: list[Array], series: Array) -> Array:
    """States (nsystems, n, ncells + 1) at the ends of cells, with the input terms (nterms, ninputs, ncells)."""
    (count, n), ncells = state.shape, series.shape[2]
    rows = np.empty((ncells + 1, count, n))
    rows[0] = state
    change = changes[-1][..., :n].copy()  # products with aligned rows are faster
    forced = np.moveaxis(changes[-1][..., n:] @ series.reshape(-1, ncells), 2, 0).copy()
    if count == 1:
        rows[1:, 0] = _one_by_one(repeat(change[0], ncells), forced[:, 0], state[0])
    else:
        for k in range(ncells):
            state = state + ((change @ state[:, :, None])[:, :, 0] + forced[k])
            rows[k + 1] = state
    states = np.moveaxis(rows, 0, 2)
    for i in _overflowed(states):
        found = states[i]
        for k in range(_first_overflow(found), ncells + 1):
            if k:
                before, terms = found[:, k - 1, None], series[:, :, k - 1, None]
                found[:, k] = _propagated(before, terms, [change[i] for change in changes])[:, 0]
    return states


def _overflowed(values: Array) -> list[int]:
    """Indices of the systems whose values (nsystems, nrows, ntime) are not all finite."""
    suspect = np.flatnonzero(~np.isfinite(values.sum(axis=(1, 2))))  # a sum overflows more easily
    return [i for i in suspect.tolist() if not np.isfinite(values[i]).all()]


def _first_overflow(states: Array) -> int:
    """Index of the first time at which a state is not finite; the number of times if all are finite."""
    overflowed = ~np.isfinite(states).all(axis=0)
    return int(overflowed.argmax()) if overflowed.any() else overflowed.size


def _propagated(states: Array, series: Array, changes: list[Array]) -> Array:
    """States (n, ncells) of one system after the last of given changes, with the input terms in each cell.

    If that change has overflowed, by shorter ones: states that are 0 or do not
    depend on what has overflowed are then not affected.
    """
    change = changes[-1]
    known = np.concatenate([states, series.reshape(-1, series.shape[2])])
    after: Array = states + matrix_product(change, known)
    if np.isfinite(after).all():
        return after
    after = np.where(np.isinf(states), states, np.where(np.isnan(after), np.inf, after))
    used = np.isfinite(known) & (known != 0.0)
    grown = np.isfinite(states) & ((~np.isfinite(change)).astype(float) @ used > 0.0)
    cells = grown.any(axis=0)
    if len(changes) == 1 or not cells.any():
        return after
    last, grown, series = len(changes) - 1, grown[:, cells], series[:, :, cells]
    level = max(0, bisect_left(range(last), True, key=lambda k: not np.isfinite(changes[k]).all()) - 1)
    halves = 0.5 ** np.arange(len(series))[:, None, None]
    now = _propagated(states[:, cells], series * halves ** (last - level), changes[: level + 1])
    while level < last and np.isfinite(now[grown]).any():
        _, second = _halved(series * halves ** (last - level - 1))
        now = _propagated(now, second, changes[: level + 1])
        level += 1
    after[:, cells] = now if level == last else np.where(grown, now, after[:, cells])
    return after


def _recurrence(change: Array, forced: Array, state: Array) -> Array:
    """States (nsteps, n) after each of the steps x + change x + forced, shapes (nsteps, n, n) and (nsteps, n).

    For few states in sqrt(nsteps) blocks: the affine map of each block is
    computed for all blocks together, then the state from block to block.
    """
    nsteps, n = forced.shape
    if n > _CROSSOVER:
        return _one_by_one(change, forced, state)
    per = int(np.ceil(nsteps**0.5))
    steps = np.zeros((per * -(-nsteps // per), n, n + 1))
    steps[:nsteps, :, :n], steps[:nsteps, :, n] = change, forced
    steps = steps.reshape(-1, per, n, n + 1)
    for j in range(1, per):
        before = steps[:, j - 1]
        steps[:, j] += before + steps[:, j, :, :n] @ before
    if per > 1:
        whole = steps[: nsteps // per, :, :, :n]
        if _cancelling(change[per - 1 :: per], whole[:, -2], whole[:, -1]).any():
            return _one_by_one(change, forced, state)
    starts = np.empty((len(steps), 1, n, 1))
    for k, block in enumerate(steps[:, -1]):
        starts[k, 0] = state[:, None]
        state = state + (block[:, :n] @ state + block[:, n])
    return (starts + (steps[..., :n] @ starts + steps[..., n:])).reshape(-1, n)[:nsteps]


def _one_by_one(change: Iterable[Array], forced: Array, state: Array) -> Array:
    """The same, one step after the other."""
    found = np.empty(forced.shape)
    for own, given, after in zip(change, forced, found, strict=True):
        own.dot(state, out=after)
        after += given
        after += state
        state = after
    return found


def _halved(series: Array) -> tuple[Array, Array]:
    """Taylor terms (nterms, ninputs, ncells) of the first and second half of each cell, in units of a half."""
    nterms = len(series)
    halves = 0.5 ** np.arange(nterms, dtype=float)
    # The polynomial of the cell about its midpoint, in units of its second half.
    second = (_PASCAL[:nterms, :nterms] * halves) @ series.reshape(nterms, -1)
    return series * halves[:, None, None], second.reshape(series.shape)


def _taylor(a: Array, b: Array, states: Array, series: Array) -> list[Array]:
    """Taylor terms of the state over the shortest time of `changes_over`."""
    terms = [states]
    for j in range(TERMS + 1):
        following = matrix_product(a, terms[-1])
        if j < len(series):
            following = following + b @ series[j]
        terms.append(following / (j + 1))
    return terms


def _evaluated(terms: list[Array], where: NDArray[np.intp], sigma: Array) -> Array:
    """Taylor series of the cells `where`, evaluated at the fractions sigma."""
    out = np.take(terms[-1], where, axis=1)
    gathered = np.empty_like(out)
    for term in reversed(terms[:-1]):
        out *= sigma
        out += np.take(term, where, axis=1, out=gathered, mode="clip")
    if not np.isfinite(out).all():
        starts = np.take(terms[0], where, axis=1)
        out = np.where(np.isinf(starts), starts, np.where(np.isnan(out), np.inf, out))
    return out


_PASCAL: Array = np.triu(pascal(TERMS, kind="upper")).astype(float)
_RATIOS = [[Fraction(factorial(j), factorial(i + j + 1)) for i in range(TERMS + 1)] for j in range(TERMS)]
_WEIGHTS: Array = np.array(_RATIOS, dtype=float)
"""j!/(i + j + 1)!: factor of a^i b in the change of states by Taylor term j of the input."""
_WEIGHTS_ERROR: Array = np.array([[ratio - Fraction(float(ratio)) for ratio in row] for row in _RATIOS], dtype=float)
"""Their rounding errors."""
