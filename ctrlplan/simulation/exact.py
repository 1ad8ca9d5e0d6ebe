"""The exact response of linear systems to trajectories and to samples.

Between breakpoints the input is analytic. It is cut into cells so short that
its Taylor series dies within a few terms; series and state together are then a
linear system without input (a nilpotent chain behind the loop's state), and one
matrix exponential, by scaling and squaring, carries the state over every cell.

Where samples are evenly spaced, every cell holds the same number of them, and
one table of exponentials, made by doubling, reads all samples off the states at
the cells' beginnings: a matrix product. Several systems with one input go
through it together. Elsewhere the cells are halved, all at once and through the
same squarings, until the state's own Taylor series converges in them, and the
samples are read off that series. Neither interpolates, and neither has a
stiffness limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, pascal

Array = NDArray[np.float64]

_TERMS = 18
"""Taylor terms of the input in a cell."""

_NUMBERS = 2**20
"""Numbers in an array of exponentials, where there is one for each spacing."""

Jet = Callable[[float, float, Array, int], Array]
"""(moment, origin, s, order) -> derivatives (order + 1, ninputs, ntime) at origin + s
of the analytic functions that hold at `moment`."""


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
        Jets of the input, see `Jet`.
    breakpoints : sequence of float
        Times [s] between which the input is analytic.
    timepts : ndarray, shape (ntime,)
        Sample times [s], increasing.
    initial : ndarray, shape (..., nstates)
        State at the first of them.
    read : ndarray, shape (..., nrows, nstates), optional
        Combinations of states wanted in place of the states.

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
    inner = sorted({float(t) for t in breakpoints if first < t < last})
    for left, right in zip([first, *inner], [*inner, last], strict=True):
        begin, end = np.searchsorted(timepts, [left, right], side="left")
        end += right == last
        state = _leg(a, b, jet, left, right, timepts[begin:end] - left, state, read, out[:, :, begin:end])
    return out


def sampled_states(a: Array, b: Array, samples: Array, timepts: Array, initial: Array) -> Array:
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

    Returns
    -------
    ndarray, shape (nstates, ntime)
    """
    scale, a, b, state = _balanced(a[None], b[None], initial[None])
    out = np.empty((timepts.size, scale.size))
    out[:1] = state
    steps: Array = np.diff(timepts)
    even = _spacing(timepts - timepts[0], float(timepts[-1] - timepts[0]))
    if even:  # spacings that differ by rounding alone share an exponential
        steps[:] = even
    drive = np.concatenate([samples[:, :-1], np.diff(samples)]).T  # Taylor terms in the time of each interval
    part = _NUMBERS // max(1, scale.size * (scale.size + drive.shape[1]))
    for begin in range(0, steps.size if scale.size else 0, max(1, part)):
        these = slice(begin, begin + max(1, part))
        spacings, which = np.unique(steps[these], return_inverse=True)
        h = spacings[:, None, None]
        change = _changes(h * a, h * b, 2)[-1][0][which]
        forced = change[:, :, scale.size :] @ drive[these, :, None]
        out[begin + 1 : these.stop + 1] = _recurrence(change[:, :, : scale.size], forced, out[begin])
    return (out * scale).T


def _balanced(a: Array, b: Array, initial: Array) -> tuple[Array, Array, Array, Array]:
    """Scale (nstates,) of the states, and systems and initial states in it.

    Powers of two, which change no digit, and let the cells be longer.
    """
    scale: Array = matrix_balance(np.abs(a).max(axis=0), permute=False, separate=True)[1][0] if a.size else np.ones(0)
    return scale, a * (scale / scale[:, None]), b / scale[:, None], initial / scale


def _leg(
    a: Array,
    b: Array,
    jet: Jet,
    left: float,
    right: float,
    samples: Array,
    state: Array,
    read: Array,
    out: Array,
) -> Array:
    """Write what is read at the samples (times since `left`) of one analytic leg, and return the states at its end."""
    moment, duration = 0.5 * (left + right), right - left

    def series(starts: Array, h: float) -> Array:
        """Taylor terms (nterms, ninputs, ncells) about the cells' starts, in units of h."""
        factor = h ** np.arange(nterms, dtype=float) / _FACTORIALS[:nterms]
        return jet(moment, left, starts, nterms - 1) * factor[:, None, None]

    ncells, nterms = _cells(lambda s, order: jet(moment, left, s, order), duration)
    per = _samples_per_cell(samples, duration, duration / ncells)
    if per:
        return _even_leg(a, b, series, duration, nterms, per, samples, state, read, out)
    h = duration / ncells
    terms = series(h * np.arange(ncells, dtype=float), h)
    ends = np.empty_like(state)
    for i in range(len(a)):
        values, ends[i] = _any_leg(h * a[i], h * b[i], terms, samples / h, state[i])
        np.matmul(read[i], values, out=out[i])
    return ends


def _even_leg(
    a: Array,
    b: Array,
    series: Callable[[Array, float], Array],
    duration: float,
    nterms: int,
    per: int,
    samples: Array,
    state: Array,
    read: Array,
    out: Array,
) -> Array:
    """Same, for evenly spaced samples, a power of two of them, `per`, in each cell."""
    count, n = state.shape
    h = per * float(samples[-1] - samples[0]) / (samples.size - 1)
    whole, rest = divmod(samples.size, per)
    last = int(duration // h)  # the cell in which the leg ends
    cells = series(h * np.arange(max(last, whole) + 1, dtype=float), h)
    chain = cells.reshape(-1, cells.shape[2])
    changes = _changes(h * a, h * b, nterms, halvings=per.bit_length() - 1)
    whole_cell = changes[-1][0]
    known = np.empty((count, cells.shape[2], n + len(chain)))
    known[:, :, :n] = _marched(state, whole_cell[..., :n], whole_cell[..., n:] @ chain[:, :-1]).swapaxes(1, 2)
    known[:, :, n:] = chain.T

    table = np.zeros((count, n, per, known.shape[2]))  # from a cell's beginning to its samples
    if samples[0]:
        table[:, :, 0] = _changes(h * a, h * b, nterms, samples[0] / h)[-1][0]
    have = 1
    for change in changes[-per.bit_length() : -1]:
        table[:, :, have : 2 * have] = _followed(table[:, :, :have], *change)
        have *= 2
    rows = (read @ table.reshape(count, n, -1)).reshape(count, -1, *table.shape[2:]).swapaxes(2, 3)
    rows[:, :, :n] += read[..., None]
    main = out[:, :, : whole * per].reshape(*out.shape[:2], whole, per)
    np.matmul(known[:, None, :whole], rows, out=main)
    out[:, :, whole * per :] = (known[:, None, whole : whole + 1] @ rows[..., :rest])[:, :, 0]
    if samples[-1] == duration:
        ending, last = table[:, :, rest - 1], whole if rest else whole - 1
    else:
        ending = _changes(h * a, h * b, nterms, duration / h - last)[-1][0]
    return known[:, last, :n] + (ending @ known[:, last, :, None])[:, :, 0]


def _any_leg(a: Array, b: Array, series: Array, samples: Array, state: Array) -> tuple[Array, Array]:
    """States of one system at any samples, and at the end of the leg; the unit of time is a cell."""
    n, (nterms, _, ncells) = len(a), series.shape
    *halvings, (change, _) = _changes(a, b, nterms)
    states = _marched(state[None], change[None, :, :n], (change[:, n:] @ series.reshape(-1, ncells))[None])[0]
    end, states = states[:, -1], states[:, :-1]
    if not samples.size:
        return np.empty((n, 0)), end
    cells, h = np.arange(ncells), 1.0
    for change, _ in reversed(halvings):
        h *= 0.5
        first, second = _halved(series)
        own = change[:, n:] * np.repeat(h ** -np.arange(nterms, dtype=float), b.shape[1])  # terms in their own time
        middle = states + (change[:, :n] @ states + own @ first.reshape(-1, first.shape[2]))
        states = np.stack([states, middle], axis=2).reshape(n, -1)
        series = np.stack([first, second], axis=3).reshape(nterms, b.shape[1], 2 * first.shape[2])
        cells = (2 * cells[:, None] + np.arange(2)).ravel()
        if cells.size > 4 * samples.size + 64:  # stiff: only cells with samples in them matter
            used = np.isin(cells, np.minimum(samples / h, cells[-1]).astype(np.intp))
            cells, states, series = cells[used], states[:, used], series[:, :, used]
    where = np.clip(np.searchsorted(cells, samples / h, side="right") - 1, 0, cells.size - 1)
    sigma = samples / h - cells[where]
    return _evaluated(_taylor(h * a, h * b, states, series), where, sigma), end


def _cells(jet: Callable[[Array, int], Array], duration: float) -> tuple[int, int]:
    """Number of cells in which the input's Taylor series dies, and of its terms."""
    order = _TERMS + 7
    size = np.abs(jet(np.linspace(0.0, duration, 9), order)).max(axis=2)  # (order + 1, ninputs)
    ncells = 1
    while ncells < 4096:
        terms = size * ((duration / ncells) ** np.arange(order + 1) / _LONG_FACTORIALS)[:, None]
        # Terms larger than the input itself would cancel, and cost digits.
        if np.all(terms[_TERMS:] <= 1e-17 * terms.max(axis=0)) and np.all(terms.sum(axis=0) <= 8.0 * terms[0]):
            break
        ncells *= 2
    return ncells, min(_TERMS, int(np.flatnonzero(size.any(axis=1)).max(initial=0)) + 1)


def _samples_per_cell(samples: Array, duration: float, longest: float) -> int:
    """Power of two of evenly spaced samples for each cell; 0 where they are uneven, or too few to be worth it."""
    step = _spacing(samples, duration) if samples.size >= 32 else 0.0
    if not step or max(samples[0], duration - samples[-1]) > step:
        return 0
    # Longer cells than the square root and the table costs more than the march.
    most = min(longest / step - 1.0, 2.0 * samples.size**0.5)
    return 2 ** int(np.log2(most)) if most >= 8.0 else 0


def _spacing(samples: Array, duration: float) -> float:
    """Spacing of evenly spaced samples, to rounding of the leg's own clock; 0 where they are not."""
    if samples.size < 2:
        return 0.0
    step = float(samples[-1] - samples[0]) / (samples.size - 1)
    beside = np.abs(samples - (samples[0] + step * np.arange(samples.size)))
    return step if beside.max() <= 4.0 * np.finfo(float).eps * duration else 0.0


def _changes(a: Array, b: Array, nterms: int, time: float = 1.0, halvings: int = 0) -> list[tuple[Array, Array]]:
    """Change of states and of the input's Taylor terms over ..., time/4, time/2, time; at least so many halvings.

    States (..., n, n + nterms * ninputs) from states and terms; terms, which
    all systems share, from terms. The shortest by its Taylor series, each next
    one from two of the one before. The change, not the state: beside a fast
    mode, squaring would cost a slow one a digit every three levels.
    """
    n, m = b.shape[-2:]
    k = np.arange(nterms)
    norm = float(np.abs(time * a).sum(axis=-2).max(initial=1.0))
    levels = max(halvings, int(np.ceil(np.log2(norm))))
    short = time * 0.5**levels
    rate = np.zeros((*a.shape[:-2], n + nterms * m, n + nterms * m))
    rate[..., :n, :n], rate[..., :n, n : n + m] = short * a, short * b
    rate[..., n:, n:] = np.diag(np.repeat(short * k[1:], m), m)
    term: Array = np.eye(n, n + nterms * m)
    states = np.zeros((*a.shape[:-2], n, n + nterms * m))
    for j in range(1, _TERMS + 2):
        term = term @ rate / j
        states += term
    shift = _PASCAL[:nterms, :nterms] * short ** np.maximum(k - k[:, None], 0.0) - np.eye(nterms)
    found = [(states, np.kron(shift, np.eye(m)))]
    for _ in range(levels):
        states, terms = found[-1]
        found.append((_followed(states[..., None, :], states, terms)[..., 0, :], 2.0 * terms + terms @ terms))
    return found


def _followed(early: Array, states: Array, terms: Array) -> Array:
    """Changes of states over some times (..., n, ntime, width), followed by one more change."""
    n = states.shape[-2]
    both = early + states[..., None, :] + early[..., :n] @ states[..., None, :, :]
    both[..., n:] += early[..., n:] @ terms
    return both


def _marched(state: Array, change: Array, forced: Array) -> Array:
    """States (nsystems, n, ncells + 1) at the ends of cells, from what the input adds in each (nsystems, n, ncells)."""
    states = np.empty((*forced.shape[:2], forced.shape[2] + 1))
    states[:, :, 0] = state
    for k in range(forced.shape[2]):
        state = state + ((change @ state[:, :, None])[:, :, 0] + forced[:, :, k])
        states[:, :, k + 1] = state
    return states


def _recurrence(change: Array, forced: Array, state: Array) -> Array:
    """States (nsteps, n) after each of the steps x + change x + forced, shapes (nsteps, n, n) and (nsteps, n, 1).

    In blocks of as many steps as there are blocks: all blocks side by side
    from a state still unknown, then that state from block to block.
    """
    nsteps, n = change.shape[:2]
    per = int(np.ceil(nsteps**0.5))
    steps = np.zeros((per * -(-nsteps // per), n, n + 1))
    steps[:nsteps, :, :n], steps[:nsteps, :, n:] = change, forced
    steps = steps.reshape(-1, per, n, n + 1)
    for j in range(1, per):
        before = steps[:, j - 1]
        steps[:, j] += before + steps[:, j, :, :n] @ before
    starts = np.empty((len(steps), 1, n, 1))
    for k, block in enumerate(steps[:, -1]):
        starts[k, 0] = state[:, None]
        state = state + (block[:, :n] @ state + block[:, n])
    return (starts + (steps[..., :n] @ starts + steps[..., n:])).reshape(-1, n)[:nsteps]


def _halved(series: Array) -> tuple[Array, Array]:
    """Taylor terms (nterms, ninputs, ncells) of the first and second half of each cell, in their own time."""
    nterms = len(series)
    halves = 0.5 ** np.arange(nterms, dtype=float)
    # The polynomial of the whole cell about its middle, in the time of its second half.
    second = (_PASCAL[:nterms, :nterms] * halves) @ series.reshape(nterms, -1)
    return series * halves[:, None, None], second.reshape(series.shape)


def _taylor(a: Array, b: Array, states: Array, series: Array) -> list[Array]:
    """Taylor terms of the state over a unit of time, where norm(a) <= 1."""
    terms = [states]
    for j in range(_TERMS + 1):
        following = a @ terms[-1]
        if j < len(series):
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
_PASCAL: Array = np.triu(pascal(_TERMS, kind="upper")).astype(float)
