"""States and references from which a linear loop keeps its limits for ever."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, matrix_balance, solve_continuous_lyapunov
from scipy.optimize import linprog, nnls
from scipy.special import comb, factorial

from ctrlplan.trajectories.common import Frozen, checked_time, readonly

Array = NDArray[np.float64]
Limits: TypeAlias = Mapping[str, Sequence[float]]

_SPARED = 0.1
"""Part of the margin that is given away so that rows which hardly matter can be left out."""

_INSIDE = 1e-8
"""Distance that is kept from limits for the rounding of a run, relative to half their distance."""

_FAR = 1e6
"""Where an output has one limit, the other is so many times its size away: of unbounded sets rows have no end."""

_DEGREE = 8
"""Of the polynomials that outputs are over a cell of time."""

_REMAINDER = 1e-10
"""What such a polynomial leaves, relative to the motion at the start."""

_CELLS = 3000
"""Cells after which a loop must have come to rest."""

_SEEN = 1e-7
"""Relative size of what limited outputs show of a direction of the state, from which on it counts."""

_PROVEN = 1e-11
"""Relative error of a proof that a row follows from others."""

_NEAR = 24
"""Rows that are added to a proof at a time."""

_ATTEMPTS = 50
"""Times that this is done."""

_PROOFS = 24
"""Proofs that are kept to be tried on other rows."""

_NEIGHBOURS = 64
"""Rows on which a new proof is tried."""

_Proof: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rows of which others are sums, and the inverse that finds the factors."""


class AdmissibleSet(Frozen):
    r"""Maximal output admissible set of a linear loop.

    The pairs of a state x and a constant reference v from which every limited
    output stays within its limits at all times, between samples too, as
    finitely many inequalities

    .. math:: G x + F v \le h.

    Over a cell of time an output is a polynomial to rounding, and lies between
    its least and greatest Bernstein coefficient, which are linear in x and v.
    At rest outputs keep a margin from the limits; then what they do beyond some
    time cannot matter. A row is left out where the others imply it; a tenth
    of the margin is given away for that.

    Parameters
    ----------
    loop : control.StateSpace or control.TransferFunction
        Continuous and stable, linear interconnections included.
    limits : mapping of str to (float, float)
        Least and greatest value of each limited output. One may be infinite;
        it then stands for a million times the other (or 1) away from it.
    dt : float
        Period of the governor [s], above 0.
    references : sequence of str, optional
        Inputs that are governed: all but the disturbances unless given. What
        is neither is 0.
    margin : float, optional
        Distance from the limits at rest, relative to half the distance between
        two, to the size of one alone (to 1 where that is 0); in (0, 1).
    disturbances : mapping of str to float, optional
        Greatest magnitude of inputs that may do as they like: the set holds
        whatever they do.

    Attributes
    ----------
    references, states : tuple of str
        Labels of v and x.
    dt : float
        Period [s].
    state_matrix, reference_matrix, bounds : ndarray, shapes (nrows, nstates), (nrows, nreferences), (nrows,)
        G, F and h, in units of half the distance between limits, or of the size of one.
    periods : int
        After how many periods no inequality is needed.

    Raises
    ------
    TypeError
        If `loop` is no linear system.
    ValueError
        If it is discrete, not stable or without reference, a label is unknown,
        limits do not increase, a number is out of range, or nothing is
        admissible.

    References
    ----------
    E. G. Gilbert, K. T. Tan, "Linear systems with state and control
    constraints", IEEE Trans. Automatic Control 36 (1991) 1008-1020; with
    disturbances I. Kolmanovsky, E. G. Gilbert, "Theory and computation of
    disturbance invariant sets", Math. Problems in Engineering 4 (1998) 317-367.

    Examples
    --------
    >>> import control as ct
    >>> lag = ct.ss([[-1.0]], [[1.0]], [[-1.0]], [[1.0]], inputs="r", outputs="u", states="y")
    >>> found = AdmissibleSet(lag, {"u": (-1.0, 1.0)}, 0.1)
    >>> found.contains([0.0], [0.9]), found.contains([0.0], [1.1]), found.contains([1.0], [1.9])
    (True, False, True)
    >>> round(found.fraction([0.0], [0.0], [2.0]), 2)
    0.5
    """

    references: tuple[str, ...]
    states: tuple[str, ...]
    dt: float
    state_matrix: Array
    reference_matrix: Array
    bounds: Array
    periods: int
    _rows: Array
    _margin: float

    def __init__(
        self,
        loop: Any,
        limits: Limits,
        dt: float,
        *,
        references: Sequence[str] | None = None,
        margin: float = 0.01,
        disturbances: Mapping[str, float] | None = None,
    ) -> None:
        period = checked_time(dt, "dt", positive=True)
        share = float(margin)
        if not 0.0 < share < 1.0:
            raise ValueError(f"margin must lie in (0, 1), got {margin}")
        problem = _problem(loop, limits, references, dict(disturbances or {}))
        rows, last = _determined(problem, share)
        of_reference = rows.reference - rows.state @ problem.rest
        self.__dict__.update(
            references=problem.references,
            states=problem.states,
            dt=period,
            state_matrix=readonly(rows.state),
            reference_matrix=readonly(of_reference),
            bounds=readonly(rows.bound),
            _rows=np.hstack([rows.state, of_reference]),
            periods=math.ceil(last / period),
            _margin=share,
        )

    def __repr__(self) -> str:
        return f"<AdmissibleSet of {len(self.bounds)} rows from {self.periods} periods of {self.dt:g} s>"

    def contains(self, x: ArrayLike, v: ArrayLike) -> bool:
        """Whether a state and a reference are in the set.

        Parameters
        ----------
        x : array_like, shape (nstates,)
            State.
        v : array_like, shape (nreferences,)
            Reference.
        """
        return bool((self._rows @ np.concatenate([x, v], dtype=float) <= self.bounds).all())

    def fraction(self, x: ArrayLike, v: ArrayLike, r: ArrayLike) -> float:
        """Part of the way from v to r that is admissible at a state.

        Parameters
        ----------
        x : array_like, shape (nstates,)
            State.
        v, r : array_like, shape (nreferences,)
            Reference that is held, and the one asked for.

        Returns
        -------
        float
            Largest kappa in [0, 1] for which x and v + kappa (r - v) are in the
            set, 1 exactly where x and r are. Where there is none: 0 if x and v
            are outside by no more than the margin, as after a period they may
            be by rounding and by what was given away; nan if they are farther
            outside or not finite.
        """
        point = np.concatenate([x, v, r], dtype=float)
        if not np.isfinite(point).all():
            return math.nan
        n, end = len(self.states), -len(self.references)
        room = self.bounds - self._rows @ point[:end]
        rise = self.reference_matrix @ (point[end:] - point[n:end])
        after = room - rise
        if after.min(initial=0.0) >= 0.0:
            return 1.0
        least = room.min()
        if least >= 0.0:
            over = after < 0.0
            return float((room[over] / rise[over]).min())
        return _inside(room, rise, 0.0 if least >= -self._margin else math.nan)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Loop x' = a x + b v + e w, y = c x + d v + f w: y in units of `scale`, w within 1."""

    a: Array
    c: Array
    e: Array
    f: Array
    rest: Array  # state at rest, by the reference
    gain: Array  # outputs at rest
    low: Array
    high: Array
    middle: Array  # between limits, or near the only one
    labels: tuple[str, ...]
    references: tuple[str, ...]
    states: tuple[str, ...]

    @property
    def slowest(self) -> float:
        """Rate [1/s] at which the slowest motion dies out."""
        return float(-np.linalg.eigvals(self.a).real.max()) if self.a.size else 1.0


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells of time, and over each the outputs as polynomials.

    Attributes
    ----------
    ends : ndarray, shape (ncells,)
        Where they end [s].
    rows : ndarray, shape (ncells, noutputs, degree + 1, nstates)
        Bernstein coefficients of c exp(a t).
    needed : int
        Those after which outputs that have kept their limits keep them for ever.
    """

    ends: Array
    rows: Array
    needed: int


@dataclass(frozen=True, eq=False)
class _Rows:
    """Inequalities state @ z + reference @ v <= bound in the distance z of the state from rest."""

    state: Array
    reference: Array
    bound: Array


def _problem(
    loop: Any, limits: Limits, references: Sequence[str] | None, disturbances: Mapping[str, float]
) -> _Problem:
    if isinstance(loop, ct.TransferFunction):
        loop = ct.ss(loop, name=loop.name, inputs=loop.input_labels, outputs=loop.output_labels)
    if not isinstance(loop, ct.StateSpace):
        raise TypeError(
            f"loop must be a control.StateSpace or TransferFunction, got {type(loop).__name__}; "
            "of others ctrlplan.Predictor says what is admissible"
        )
    if loop.dt not in (None, 0):
        raise ValueError(f"loop must be continuous, got {loop.name} with dt = {loop.dt}")
    inputs, outputs = list(loop.input_labels), list(loop.output_labels)
    governed = (
        tuple(label for label in inputs if label not in disturbances) if references is None else tuple(references)
    )
    if not governed:
        raise ValueError(f"references must name an input of {loop.name} at least, got none")
    for name, given, known in (
        ("references", governed, inputs),
        ("disturbances", tuple(disturbances), [label for label in inputs if label not in governed]),
        ("limits", tuple(limits), outputs),
    ):
        for label in given:
            if label not in known:
                raise ValueError(f"{name} must be of {', '.join(known) or 'no signal'}, got {label!r}")
    if len(set(governed)) < len(governed):
        raise ValueError(f"references must not name an input twice, got {', '.join(governed)}")
    if not limits:
        raise ValueError("limits must name an output at least, got none")
    for label, most in disturbances.items():
        if not (math.isfinite(most) and most >= 0.0):
            raise ValueError(f"disturbances of {label} must be finite and at least 0, got {most}")
    a, b, c, d = _matrices(loop)
    poles = np.linalg.eigvals(a)
    if poles.size and not poles.real.max() < -1e-9 * np.abs(poles).max():
        worst = poles[poles.real.argmax()]
        raise ValueError(f"loop must be stable, got a pole of {loop.name} at {worst:.3g} 1/s")
    pairs = np.array([_checked_limits(label, pair) for label, pair in limits.items()])
    scale = np.array([_scale(*pair) for pair in pairs.tolist()])
    rows, columns = [outputs.index(label) for label in limits], [inputs.index(label) for label in governed]
    shaken = [inputs.index(label) for label in disturbances]
    sizes = np.array([float(most) for most in disturbances.values()])
    c, d = c[rows] / scale[:, None], d[rows] / scale[:, None]
    rest = np.asarray(-np.linalg.solve(a, b[:, columns]), dtype=float)
    low, high = pairs.T / scale
    return _Problem(
        a,
        c,
        b[:, shaken] * sizes,
        d[:, shaken] * sizes,
        rest,
        c @ rest + d[:, columns],
        np.where(np.isfinite(low), low, high - _FAR),
        np.where(np.isfinite(high), high, low + _FAR),
        np.where(np.isfinite(low + high), 0.5 * (low + high), np.where(np.isfinite(low), low, high)),
        tuple(limits),
        governed,
        tuple(loop.state_labels),
    )


def _matrices(loop: ct.StateSpace) -> tuple[Array, Array, Array, Array]:
    """Matrices of a linear system: those that python-control keeps of an interconnection come by differences."""
    if not isinstance(loop, ct.InterconnectedSystem):
        a, b, c, d = (np.asarray(m, dtype=float) for m in (loop.A, loop.B, loop.C, loop.D))
        return a, b, c, d
    x, u = np.zeros(loop.nstates), np.zeros(loop.ninputs)
    columns = [(x + one, u) for one in np.eye(x.size)] + [(x, u + one) for one in np.eye(u.size)]
    found = [[np.array([f(0.0, *at) for at in columns]).T for f in (loop.dynamics, loop.output)]]
    (rates, outputs) = found[0]
    n = x.size
    return rates[:, :n].reshape(n, n), rates[:, n:].reshape(n, -1), outputs[:, :n], outputs[:, n:]


def _checked_limits(label: str, pair: Sequence[float]) -> tuple[float, float]:
    if np.shape(pair) != (2,):
        raise ValueError(f"limits of {label} must be two numbers, got {pair!r}")
    low, high = float(pair[0]), float(pair[1])
    if not low < high or (math.isinf(low) and math.isinf(high)):
        raise ValueError(f"limits of {label} must increase and one of them be finite, got {low:g} and {high:g}")
    return low, high


def _scale(low: float, high: float) -> float:
    """Half the distance of two limits, or the size of the only one."""
    if math.isfinite(low) and math.isfinite(high):
        return 0.5 * (high - low)
    return abs(low if math.isfinite(low) else high) or 1.0


def _inside(room: Array, rise: Array, otherwise: float) -> float:
    """Largest kappa in [0, 1] with room - kappa rise >= 0, where some room is below 0."""
    short = room < 0.0
    if (rise[short] >= 0.0).any():
        return otherwise
    least = (room[short] / rise[short]).max()
    over = ~short & (rise > room)
    most = min(1.0, (room[over] / rise[over]).min(initial=1.0))
    return float(most) if least <= most else otherwise


def _determined(problem: _Problem, margin: float) -> tuple[_Rows, float]:
    """Rows that determine the set, and the time [s] up to which they look."""
    seen = _seen(problem)
    cells = _cells(problem, seen, margin)
    lost, in_all = _erosion(problem, cells)
    high, low = problem.high - _INSIDE, problem.low + _INSIDE
    at_rest = (low + margin + in_all)[:, None], (high - margin - in_all)[:, None]
    _check_rest(problem, *at_rest)
    polytope = _Polytope(problem, seen, _SPARED * margin)
    polytope.take(np.zeros((len(high), 1, len(problem.a))), *at_rest, np.zeros(1))
    rows = _elevated(cells.rows[: cells.needed])
    count, p, each, n = rows.shape
    rows, lost = rows.swapaxes(0, 1).reshape(p, count * each, n), lost[:count].swapaxes(0, 1).reshape(p, -1)
    ends = np.repeat(cells.ends[:count], each)
    # Coarse in time first: between two rows that are kept others follow sooner than after one.
    for places in _by_halving(ends.size):
        polytope.take(rows[:, places], low[:, None] + lost[:, places], high[:, None] - lost[:, places], ends[places])
    return polytope.reduced()


def _by_halving(count: int) -> Iterator[NDArray[np.intp]]:
    """Numbers below a count: multiples of a power of 2, then of half of it that are new, and so on to all."""
    stride = 1 << max(count - 1, 0).bit_length()
    yield np.arange(0, count, stride)
    while stride > 1:
        stride //= 2
        yield np.arange(stride, count, 2 * stride)


def _seen(problem: _Problem) -> Array:
    """Directions (nstates, nseen) of the state that the limited outputs show, as long as they show as much.

    They are coordinates in which the norm of a state is what the outputs' free
    motion from there amounts to, the integral of its square: it never grows.
    """
    if not problem.a.size:
        return np.zeros((0, 0))
    balanced, scaling = matrix_balance(problem.a, permute=False)
    c = problem.c @ scaling
    size, directions = np.linalg.eigh(solve_continuous_lyapunov(balanced.T, -c.T @ c))
    length = np.sqrt(np.maximum(size, 0.0))
    shown = length > _SEEN * length.max(initial=0.0)
    return np.asarray(scaling @ (directions[:, shown] / length[shown]))


def _cells(problem: _Problem, seen: Array, margin: float) -> _Cells:
    """Cells up to where the loop is at rest, or nearly.

    In the coordinates `seen` no free motion grows: a derivative of an output is
    nowhere later larger than it may be at the beginning of a cell, which bounds
    what its Taylor polynomial leaves. The square of a state's size is what it
    loses until t, no more than limits are wide, and what is left then: that
    bounds the size.
    """
    a, n, widths = problem.a, len(problem.a), problem.high - problem.low
    powers = [np.eye(n)]
    for _ in range(_DEGREE + 1):
        powers.append(powers[-1] @ a)
    orders = np.arange(_DEGREE + 1)
    # From powers of s in [0, 1] to Bernstein's polynomials, divided by factorials.
    basis = np.tril(comb(orders[:, None], orders) / comb(_DEGREE, orders)) / factorial(orders)
    moved, back, t, needed = np.eye(n), np.linalg.pinv(seen), 0.0, 0
    first = _norm(problem.c @ seen)
    ends: list[float] = []
    found: list[Array] = []
    while True:
        if len(ends) == _CELLS:
            raise ValueError(
                f"loop must come to rest sooner beside its fastest motion, got motion after {t:.3g} s that takes more "
                f"than {_CELLS} cells of time"
            )
        bend = _norm(problem.c @ powers[-1] @ moved @ seen)
        h = (_REMAINDER * first * factorial(_DEGREE + 1) / bend) ** (1.0 / (_DEGREE + 1)) if bend else math.inf
        h = min(h, 1.0 / problem.slowest)
        series = np.stack([power * h**k for k, power in enumerate(powers[:-1])])
        found.append(np.einsum("ij,jpn->pin", basis, (problem.c @ series) @ moved))
        moved, t = expm(a * h) @ moved, t + h
        ends.append(t)
        left = _norm(problem.c @ moved @ seen)
        if not needed:
            kept = 1.0 - np.linalg.norm(back @ moved @ seen, 2) ** 2 if seen.size else 1.0
            if kept > 0.0 and left * math.sqrt(t * float(widths @ widths) / kept) <= margin:
                needed = len(ends)
        # Disturbances add up until nothing moves.
        if needed and (left <= _REMAINDER * first or not problem.e.any()):
            return _Cells(np.array(ends), np.array(found), needed)


def _norm(rows: Array) -> float:
    return float(np.linalg.norm(rows, axis=1).max(initial=0.0))


def _elevated(rows: Array) -> Array:
    """Bernstein coefficients, along the last axis but one, of the same polynomials at a degree one higher."""
    part = (np.arange(1, rows.shape[2]) / rows.shape[2])[:, None]
    inner = part * rows[:, :, :-1] + (1.0 - part) * rows[:, :, 1:]
    return np.concatenate([rows[:, :, :1], inner, rows[:, :, -1:]], axis=2)


def _erosion(problem: _Problem, cells: _Cells) -> tuple[Array, Array]:
    """What disturbances can make of each output: over each cell, (ncells, noutputs, degree + 2), and in all.

    It is the integral of the size of c exp(a t) e. A polynomial is nowhere
    larger than the one whose Bernstein coefficients are the sizes of its own,
    and these add up to the coefficients of the integral.
    """
    size = np.abs(cells.rows @ problem.e).sum(axis=3)
    lengths = np.diff(cells.ends, prepend=0.0)[:, None, None] / size.shape[2]
    sums = np.cumsum(np.concatenate([np.zeros_like(size[:, :, :1]), lengths * size], axis=2), axis=2)
    before = np.cumsum(sums[:, :, -1], axis=0) - sums[:, :, -1] + np.abs(problem.f).sum(axis=1)
    found = sums + before[:, :, None]
    return found, found[-1, :, -1]


def _check_rest(problem: _Problem, low: Array, high: Array) -> None:
    """Refuse limits between which the loop cannot rest."""
    p, m = problem.gain.shape
    both = np.vstack([problem.gain, -problem.gain])
    # Any reference, and a room of at most 1 that it leaves on all sides: there always is one, if negative.
    found: Any = linprog(
        [*[0.0] * m, -1.0],
        np.column_stack([both, np.ones(2 * p)]),
        np.concatenate([high, -low]).ravel(),
        bounds=[*[(None, None)] * m, (None, 1.0)],
    )
    room = float(found.x[-1])
    if room <= 0.0:
        raise ValueError(
            f"limits of {', '.join(problem.labels)} must leave a reference at which the loop rests inside them by the "
            f"margin, whatever the disturbances, got {abs(room):.3g} of half their distance too little"
        )


class _Polytope:
    """Rows that are kept, each with a bound on z and v; and proofs that others follow from them.

    A row follows if it is a sum of kept ones with factors of at least 0, which
    are found by nonnegative least squares: some twenty times faster than a
    linear program of this size.
    """

    def __init__(self, problem: _Problem, seen: Array, spare: float) -> None:
        self._gain, self._seen, self._spare = problem.gain, seen, spare
        u, s, _ = np.linalg.svd(problem.gain, full_matrices=False)
        self._rest = u[:, s > 1e-12 * s.max(initial=0.0)]  # outputs at rest, by as many coordinates as they have
        # Bounds are taken from the middle between limits, as near to it as outputs at rest come.
        self._centre = self._rest @ (self._rest.T @ problem.middle)
        self._columns = np.zeros((seen.shape[1] + self._rest.shape[1] + 1, 0))
        self._columns = self._column(np.zeros((1, len(seen))), np.zeros((1, len(self._gain))), np.ones(1))
        self._kept: list[tuple[Array, Array, float, float]] = []
        self._proofs: list[_Proof] = []

    def take(self, rows: Array, low: Array, high: Array, ends: Array) -> None:
        """Keep what does not follow of low <= rows @ z + gain @ v <= high.

        Rows (noutputs, ntime, nstates), limits (noutputs, ntime), and the times
        of the ends of their cells; of time 0 nothing is given away.
        """
        p, count, n = rows.shape
        outputs = np.repeat(np.eye(p), count, axis=0)
        state = np.concatenate([rows, -rows]).reshape(2 * p * count, n)
        output, bound = np.concatenate([outputs, -outputs]), np.concatenate([high, -low]).ravel()
        spared = bound - np.tile(np.where(ends > 0.0, self._spare, 0.0), 2 * p)
        columns, kept = self._column(state, output, bound), self._column(state, output, spared)
        left = np.arange(bound.size)
        for known in self._proofs:
            left = left[_unproven(known, columns[:, left])]
        self._proofs = []
        while left.size:
            k, left = int(left[0]), left[1:]
            proof = self._proof(columns[:, k])
            if proof is not None:
                self._proofs = [proof, *self._proofs[: _PROOFS - 1]]
                # What stands next is of the same output and of nearly the same time.
                near, far = left[:_NEIGHBOURS], left[_NEIGHBOURS:]
                left = np.concatenate([near[_unproven(proof, columns[:, near])], far])
                continue
            self._kept.append((state[k], output[k], float(spared[k]), float(ends[k % count])))
            self._columns = np.hstack([self._columns, kept[:, [k]]])

    def reduced(self) -> tuple[_Rows, float]:
        """Rows that do not follow from the rest of them, and the time [s] up to which they look."""
        needed = []
        for k, row in enumerate(self._kept):
            column = self._columns[:, k + 1].copy()
            self._columns[:, k + 1] = 0.0
            if self._proof(column) is None:
                self._columns[:, k + 1] = column
                needed.append(row)
        state = np.array([row[0] for row in needed]).reshape(len(needed), len(self._seen))
        output = np.array([row[1] for row in needed]).reshape(len(needed), len(self._gain))
        bound = np.array([row[2] for row in needed])
        return _Rows(state, output @ self._gain, bound), max([row[3] for row in needed], default=0.0)

    def _column(self, state: Array, output: Array, bound: Array) -> Array:
        """Rows as columns (coordinates and bound) of length 1."""
        found = np.vstack([(state @ self._seen).T, (output @ self._rest).T, bound - output @ self._centre])
        return np.asarray(found / np.linalg.norm(found, axis=0))

    def _proof(self, column: Array) -> _Proof | None:
        """Kept columns of which a column is a sum: of a few near it, and more as they are missed."""
        every, missed = self._columns, column
        near = np.empty(0, dtype=np.intp)
        for _ in range(_ATTEMPTS):
            gain = missed @ every
            if gain.max() <= _PROVEN * np.linalg.norm(missed):
                return None
            new = np.argpartition(gain, -_NEAR)[-_NEAR:] if gain.size > _NEAR else np.arange(gain.size)
            near = np.union1d(near, new)
            try:
                factors, rest = nnls(every[:, near], column)
            except RuntimeError:
                return None
            used = factors > 0.0
            near, generators = near[used], every[:, near[used]]
            missed = column - generators @ factors[used]
            if rest <= _PROVEN:
                return generators, np.linalg.pinv(generators)
        return None  # nothing is proven: the row is kept


def _unproven(proof: _Proof, columns: Array) -> NDArray[np.bool_]:
    """Which columns are no sum of those of a proof."""
    generators, inverse = proof
    missed = columns - generators @ np.maximum(inverse @ columns, 0.0)
    return np.einsum("ij,ij->j", missed, missed) > _PROVEN**2
