"""States and references from which a linear loop satisfies its limits for all future times."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog

from ctrlplan._checks import Range, check_signals, checked_finite, checked_limits, checked_number
from ctrlplan._display import Displayed, Facts, Part, counted
from ctrlplan._types import Array, System
from ctrlplan.systems.output_cells import Problem, elevated, erosion, output_cells, seen_directions
from ctrlplan.systems.polytope import Polytope, Rows
from ctrlplan.trajectories.common import readonly
from ctrlplan.trajectories.fields import Fields

Limits: TypeAlias = Mapping[str, Range]

_SPARED = 0.1
"""Fraction of the margin given up so that nearly redundant rows can be omitted."""

_INSIDE = 1e-8
"""Distance from the limits for rounding errors of a run, relative to half their distance."""

_FAR = 1e6
"""Distance of the other limit of an output with one limit, relative to its size: unbounded sets need no finite rows."""


class AdmissibleSet(Displayed, Fields):
    r"""Maximal output admissible set of a linear loop.

    The pairs of a state x and a constant reference v from which every limited
    output satisfies its limits for all future times, also between samples, as
    finitely many inequalities

    .. math:: G x + F v \le h.

    Over a short time interval an output is a polynomial to rounding accuracy and
    lies between its minimum and maximum Bernstein coefficients, which are linear
    in x and v. In steady state outputs have a margin from the limits, so that
    a finite time interval suffices. Redundant rows are omitted; a tenth of the
    margin is given up for that.

    Parameters
    ----------
    loop : control.StateSpace or control.TransferFunction
        Continuous-time and stable; linear interconnections are accepted.
    limits : mapping of str to (float, float) or float
        Minimum and maximum of each limited output; a number a for (-a, a). One
        of them may be infinite: it is placed at a distance of 1e6 times the
        magnitude of the other (or 1e6 if that is 0).
    dt : float
        Period of the governor [s], above 0.
    references : sequence of str, optional
        Inputs that are governed, by default all but the disturbances. Other
        inputs are 0.
    margin : float, optional
        Distance from the limits in steady state, relative to half the distance
        between them; with a single limit relative to its magnitude (to 1 if
        that is 0). In (0, 1).
    disturbances : mapping of str to float, optional
        Bounds on the magnitude of unknown disturbance inputs; the set is robust
        to all disturbances within them.
    origin : (array_like, array_like), optional
        State and reference at the operating point of a linearised loop; limits
        then apply to deviations of the outputs from their values there.

    Attributes
    ----------
    references, states : tuple of str
        Labels of the references v and the states x.
    dt : float
        Period of the governor [s].
    state_matrix, reference_matrix, bounds : ndarray, shapes (nrows, nstates), (nrows, nreferences), (nrows,)
        G, F and h, scaled by half the distance between the limits, or by the
        magnitude of a single limit.
    periods : int
        Number of periods after which no further inequality is required.

    Raises
    ------
    TypeError
        If `loop` is not a linear system.
    ValueError
        If the loop is discrete, not stable or has no reference, a label is
        unknown, limits do not increase, a number is out of range, or the set is
        empty.

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
        loop: System,
        limits: Limits,
        dt: float,
        *,
        references: Sequence[str] | None = None,
        margin: float = 0.01,
        disturbances: Mapping[str, float] | None = None,
        origin: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        period = checked_finite(dt, "dt", above=0.0)
        share = checked_number(margin, "margin")
        if not 0.0 < share < 1.0:
            raise ValueError(f"margin must lie in (0, 1), got {margin}")
        problem = _problem(loop, limits, references, dict(disturbances or {}))
        rows, last = _determined(problem, share)
        of_reference = rows.reference - rows.state @ problem.equilibrium
        bounds = rows.bound + _shift(rows.state, of_reference, origin)
        self._set_fields(
            references=problem.references,
            states=problem.states,
            dt=period,
            state_matrix=readonly(rows.state),
            reference_matrix=readonly(of_reference),
            bounds=readonly(bounds),
            _rows=np.hstack([rows.state, of_reference]),
            periods=math.ceil(last / period),
            _margin=share,
        )

    def _describe(self) -> Iterator[Part]:
        periods = f"{counted(self.periods, 'period')} of {self.dt:g} s"
        yield f"AdmissibleSet of {counted(len(self.bounds), 'row')} from {periods}"
        yield Facts(
            [
                ("references", ", ".join(self.references)),
                ("states", ", ".join(self.states)),
                ("inequalities G x + F v <= h", str(len(self.bounds))),
                ("determined by the first", periods),
                ("margin of the steady state", f"{100.0 * self._margin:.4g} % of half the distance between limits"),
            ]
        )

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
        """Largest admissible fraction of the way from v to r.

        Parameters
        ----------
        x : array_like, shape (nstates,)
            State.
        v, r : array_like, shape (nreferences,)
            Present reference and commanded reference.

        Returns
        -------
        float
            Largest kappa in [0, 1] for which x and v + kappa (r - v) are in the
            set; exactly 1 if x and r are. If there is none: 0 if x and v are
            outside by at most the margin, which rounding and the omitted rows
            can cause after a period; nan if they are farther outside or not
            finite.
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
        minimum = room.min()
        if minimum >= 0.0:
            over = after < 0.0
            return float((room[over] / rise[over]).min())
        return _inside(room, rise, 0.0 if minimum >= -self._margin else math.nan)


def _problem(
    loop: System, limits: Limits, references: Sequence[str] | None, disturbances: Mapping[str, float]
) -> Problem:
    if isinstance(loop, ct.TransferFunction):
        loop = ct.ss(loop, name=loop.name, inputs=loop.input_labels, outputs=loop.output_labels)
    if not isinstance(loop, ct.StateSpace):
        raise TypeError(
            f"loop must be a control.StateSpace or TransferFunction, got {type(loop).__name__}; "
            "use ctrlplan.Predictor for nonlinear loops"
        )
    if loop.dt not in (None, 0):
        raise ValueError(f"loop must be continuous, got {loop.name} with dt = {loop.dt}")
    inputs, outputs = list(loop.input_labels), list(loop.output_labels)
    governed = (
        tuple(label for label in inputs if label not in disturbances) if references is None else tuple(references)
    )
    check_signals(governed, "references", inputs, "input")
    if disturbances:
        others = [label for label in inputs if label not in governed]
        check_signals(tuple(disturbances), "disturbances", others, "input")
    check_signals(tuple(limits), "limits", outputs, "output")
    a, b, c, d = _matrices(loop)
    poles = np.linalg.eigvals(a)
    if poles.size and not poles.real.max() < -1e-9 * np.abs(poles).max():
        worst = poles[poles.real.argmax()]
        shown = worst if np.imag(worst) else np.real(worst)
        raise ValueError(f"loop must be stable, got a pole of {loop.name} at {shown:.3g} 1/s")
    found = np.array([checked_limits(pair, f"limits of {label}") for label, pair in limits.items()])
    pairs, scale = found[:, :2], found[:, 2]
    rows, columns = [outputs.index(label) for label in limits], [inputs.index(label) for label in governed]
    shaken = [inputs.index(label) for label in disturbances]
    sizes = np.array(
        [
            checked_finite(magnitude, f"disturbances of {label}", minimum=0.0)
            for label, magnitude in disturbances.items()
        ]
    )
    c, d = c[rows] / scale[:, None], d[rows] / scale[:, None]
    equilibrium = np.asarray(-np.linalg.solve(a, b[:, columns]), dtype=float)
    low, high = pairs.T / scale
    return Problem(
        a,
        c,
        b[:, shaken] * sizes,
        d[:, shaken] * sizes,
        equilibrium,
        c @ equilibrium + d[:, columns],
        np.where(np.isfinite(low), low, high - _FAR),
        np.where(np.isfinite(high), high, low + _FAR),
        np.where(np.isfinite(low + high), 0.5 * (low + high), np.where(np.isfinite(low), low, high)),
        tuple(limits),
        governed,
        tuple(loop.state_labels),
    )


def _matrices(loop: ct.StateSpace) -> tuple[Array, Array, Array, Array]:
    """Matrices of a linear system; python-control computes those of an interconnection by finite differences."""
    if not isinstance(loop, ct.InterconnectedSystem):
        a, b, c, d = (np.asarray(m, dtype=float) for m in (loop.A, loop.B, loop.C, loop.D))
        return a, b, c, d
    x, u = np.zeros(loop.nstates), np.zeros(loop.ninputs)
    columns = [(x + one, u) for one in np.eye(x.size)] + [(x, u + one) for one in np.eye(u.size)]
    found = [[np.array([f(0.0, *at) for at in columns]).T for f in (loop.dynamics, loop.output)]]
    (rates, outputs) = found[0]
    n = x.size
    return rates[:, :n].reshape(n, n), rates[:, n:].reshape(n, -1), outputs[:, :n], outputs[:, n:]


def _inside(room: Array, rise: Array, otherwise: float) -> float:
    """Largest kappa in [0, 1] with room - kappa rise >= 0, if some entries of room are negative."""
    short = room < 0.0
    if (rise[short] >= 0.0).any():
        return otherwise
    lower = (room[short] / rise[short]).max()
    over = ~short & (rise > room)
    upper = min(1.0, (room[over] / rise[over]).min(initial=1.0))
    return float(upper) if lower <= upper else otherwise


def _shift(state: Array, reference: Array, origin: tuple[ArrayLike, ArrayLike] | None) -> Array | float:
    """Shift of the bounds of rows by an operating point."""
    if origin is None:
        return 0.0
    given = [np.atleast_1d(np.asarray(values, dtype=float)) for values in origin]
    sizes = [(state.shape[1],), (reference.shape[1],)]
    if [values.shape for values in given] != sizes or not all(np.isfinite(values).all() for values in given):
        raise ValueError(f"origin must be {sizes[0][0]} states and {sizes[1][0]} references, finite, got {origin!r}")
    return state @ given[0] + reference @ given[1]


def _determined(problem: Problem, margin: float) -> tuple[Rows, float]:
    """Irredundant rows of the set, and the last time [s] that they constrain."""
    seen = seen_directions(problem)
    cells = output_cells(problem, seen, margin)
    eroded, in_all = erosion(problem, cells)
    high, low = problem.high - _INSIDE, problem.low + _INSIDE
    steady = (low + margin + in_all)[:, None], (high - margin - in_all)[:, None]
    _check_equilibrium(problem, *steady)
    polytope = Polytope(problem, seen, _SPARED * margin)
    polytope.add(np.zeros((len(high), 1, len(problem.a))), *steady, np.zeros(1))
    rows = elevated(cells.rows[: cells.needed])
    count, p, each, n = rows.shape
    rows, eroded = rows.swapaxes(0, 1).reshape(p, count * each, n), eroded[:count].swapaxes(0, 1).reshape(p, -1)
    ends = np.repeat(cells.ends[:count], each)
    # Coarse in time first: rows between two known ones are more often redundant.
    for places in _by_halving(ends.size):
        polytope.add(rows[:, places], low[:, None] + eroded[:, places], high[:, None] - eroded[:, places], ends[places])
    return polytope.reduced()


def _by_halving(count: int) -> Iterator[NDArray[np.intp]]:
    """Indices below a count in bit-reversed blocks: multiples of a power of 2, then of half of it, and so on."""
    stride = 1 << max(count - 1, 0).bit_length()
    yield np.arange(0, count, stride)
    while stride > 1:
        stride //= 2
        yield np.arange(stride, count, 2 * stride)


def _check_equilibrium(problem: Problem, low: Array, high: Array) -> None:
    """Raise if no steady state satisfies the limits with their margin."""
    p, m = problem.gain.shape
    both = np.vstack([problem.gain, -problem.gain])
    # Maximise the distance from all limits (at most 1, negative if infeasible) over the references.
    found: Any = linprog(
        [*[0.0] * m, -1.0],
        np.column_stack([both, np.ones(2 * p)]),
        np.concatenate([high, -low]).ravel(),
        bounds=[*[(None, None)] * m, (None, 1.0)],
    )
    room = float(found.x[-1])
    if room <= 0.0:
        raise ValueError(
            f"limits of {', '.join(problem.labels)} must allow a steady state inside them by the margin under all "
            f"disturbances, got limits too narrow by {abs(room):.3g} of half their distance"
        )
