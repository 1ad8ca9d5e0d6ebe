"""Admissible references of a nonlinear loop, by predictive simulation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import Range, check_signals, checked_finite, checked_limits, checked_params
from ctrlplan._display import Displayed, Facts, Part, Table, number
from ctrlplan._types import Array, Frozen, Params, System
from ctrlplan.simulation import methods
from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.interpreted import LoopError, SolverError
from ctrlplan.simulation.memory import kept_memory
from ctrlplan.simulation.prepared import Prepared, prepare
from ctrlplan.simulation.simulate import checked_job, response_to

_TOLERANCES = 1e-6, 1e-8
"""Relative and absolute tolerance of the solver, far below any margin."""

_SHORTEST = 2.0**-20
"""Fractions below this one count as 0."""

_SETTLED = 0.8
"""Fraction of the horizon after which the loop must be in steady state."""

_COUNTS = 20, 100_000
"""Minimum and maximum number of times at which a prediction is evaluated."""


class Predictor(Displayed, Frozen):
    """Admissible references of a nonlinear loop, by simulation.

    `create_governor_iosystem` accepts it in place of a linear loop. A reference
    is admissible at a state if, in a simulation from that state over the
    horizon with the reference held constant,

    - every limited output stays inside its limits by the margin, and
    - the loop is in steady state over the last fifth of the horizon: limited
      outputs are inside by twice the margin, and none moves by more than the
      margin.

    A reference for which the simulation fails or overflows is not admissible.
    Outputs are evaluated at `count` times, closer together after the start;
    peaks in between are estimated by parabolas. Violations beyond the horizon
    are not detected: it must be long compared with the slowest time constant.

    Parameters
    ----------
    system : control system or Prepared
        Continuous and time-invariant, without plans and delays. Sampled blocks
        are predicted as at the start of a run: the sample times of the governor
        must be sample times of these blocks.
    limits : mapping of str to (float, float) or float
        Minimum and maximum of each limited output, one of which may be
        infinite; a number a for (-a, a).
    horizon : float
        Prediction horizon [s], above 0.
    references : sequence of str, optional
        Inputs that are governed, by default all. The others are 0.
    margin : float, optional
        Distance from the limits, relative to half the distance between them;
        with a single limit relative to its magnitude (to 1 if that is 0). In
        (0, 1/2).
    count : int, optional
        Number of times at which a prediction is evaluated, at least 20.
    resolution : float, optional
        Accuracy of the fraction, in (0, 1).
    params : mapping, optional
        Parameters of the blocks.

    Attributes
    ----------
    references, states : tuple of str
        Labels of the governed inputs, and of the states.
    horizon : float
        Prediction horizon [s].

    Raises
    ------
    TypeError
        If `system` is not a control system.
    ValueError
        If the system is discrete or depends on time, a label is unknown, limits
        do not increase, or a number is out of range.

    References
    ----------
    A. Bemporad, "Reference governor for constrained nonlinear systems", IEEE
    Trans. Automatic Control 43 (1998) 415-419.

    Examples
    --------
    Position control of a pendulum with limited torque:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> loop = ct.nlsys(
    ...     lambda t, x, u, params: np.array([x[1], 4 * (u[0] - x[0]) - 3 * x[1]]),
    ...     lambda t, x, u, params: np.array([x[0], 4 * (u[0] - x[0]) - 3 * x[1] + np.sin(x[0])]),
    ...     inputs="r", outputs=["angle", "torque"], states=["angle", "speed"], name="loop",
    ... )
    >>> predictor = Predictor(loop, {"torque": (-1.0, 1.0)}, 10.0)
    >>> predictor.fraction([0.0, 0.0], [0.0], [1.0]), predictor.fraction([0.0, 0.0], [0.0], [0.2])
    (0.234375, 1.0)
    """

    references: tuple[str, ...]
    states: tuple[str, ...]
    horizon: float
    _prepared: Prepared
    _times: Array
    _settled: int
    _rows: list[int]
    _low: Array
    _high: Array
    _inset: Array
    _resolution: float
    _params: Params

    def __init__(
        self,
        system: System | Prepared,
        limits: Mapping[str, Range],
        horizon: float,
        *,
        references: Sequence[str] | None = None,
        margin: float = 0.02,
        count: int = 200,
        resolution: float = 1.0 / 64.0,
        params: Params | None = None,
    ) -> None:
        prepared = prepare(system)
        _check_autonomous(prepared)
        if not prepared.input_labels:
            raise ValueError(f"{prepared.name} must have an input to govern, got none")
        governed = tuple(prepared.input_labels if references is None else references)
        check_signals(governed, "references", prepared.input_labels, "input")
        check_signals(tuple(limits), "limits", prepared.output_labels, "output")
        for label, value, maximum in (("margin", margin, 0.5), ("resolution", resolution, 1.0)):
            if not 0.0 < float(value) < maximum:
                raise ValueError(f"{label} must lie in (0, {maximum:g}), got {value}")
        seconds = checked_finite(horizon, "horizon", above=0.0)
        if isinstance(count, bool) or int(count) != count or not _COUNTS[0] <= count <= _COUNTS[1]:
            raise ValueError(f"count must be a whole number from {_COUNTS[0]} to {_COUNTS[1]}, got {count}")
        bounds = np.array([checked_limits(pair, f"limits of {label}") for label, pair in limits.items()])
        inset = float(margin) * bounds[:, 2]
        # Evenly spaced in the square root of time: the fastest motion follows the change of the reference.
        times = seconds * np.linspace(0.0, 1.0, int(count)) ** 2
        self.__dict__.update(
            references=governed,
            states=tuple(prepared.state_labels),
            horizon=seconds,
            _prepared=prepared,
            _times=times,
            _settled=int(np.searchsorted(times, _SETTLED * seconds)),
            _rows=[prepared.output_labels.index(label) for label in limits],
            _low=bounds[:, 0] + inset,
            _high=bounds[:, 1] - inset,
            _inset=inset,
            _resolution=float(resolution),
            _params=checked_params(params),
        )

    def _describe(self) -> Iterator[Part]:
        yield f"Predictor of {self._prepared.name} over {self.horizon:g} s"
        yield Facts(
            [
                ("references", ", ".join(self.references)),
                ("states", ", ".join(self.states)),
                ("horizon", f"{self.horizon:.6g} s, evaluated at {self._times.size} times"),
                ("accuracy of the fraction", number(self._resolution)),
            ]
        )
        sides = zip(self._rows, self._low - self._inset, self._high + self._inset, self._inset, strict=True)
        names = self._prepared.output_labels
        rows = [(names[row], number(low), number(high), number(inset)) for row, low, high, inset in sides]
        yield Table("Limits", ("output", "minimum", "maximum", "margin"), rows)

    def contains(self, x: ArrayLike, v: ArrayLike) -> bool:
        """Whether a reference, held constant from a state, is admissible.

        Parameters
        ----------
        x : array_like, shape (nstates,)
            State.
        v : array_like, shape (nreferences,)
            Reference.
        """
        state, held = self._checked(x, v)
        return self._admissible(state, held)

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
            Largest kappa in [0, 1] found by bisection for which v + kappa (r - v)
            is admissible: within `resolution`, or within a factor of 2 if it is
            smaller; 1 if r is admissible; nan if neither r nor v is.
        """
        state, held, command = self._checked(x, v, r)
        if self._admissible(state, command):
            return 1.0
        if np.array_equal(held, command) or not self._admissible(state, held):
            return math.nan
        low, high = 0.0, 1.0
        # An arbitrarily short first step must be found, otherwise a distant reference is never reached.
        while high - low > (self._resolution if low else _SHORTEST):
            middle = 0.5 * (low + high)
            if self._admissible(state, held + middle * (command - held)):
                low = middle
            else:
                high = middle
        return low

    def _admissible(self, state: Array, reference: Array) -> bool:
        outputs = self._predicted(state, reference)
        if outputs is None:
            return False
        low, high, inset = self._low, self._high, self._inset
        last = outputs[:, self._settled :]
        minimum, maximum = last.min(axis=1), last.max(axis=1)
        return bool(
            (-_peaks(-outputs) >= low).all()
            and (_peaks(outputs) <= high).all()
            and (minimum >= low + inset).all()
            and (maximum <= high - inset).all()
            and (maximum - minimum <= inset).all()
        )

    def _predicted(self, state: Array, reference: Array) -> Array | None:
        """Limited outputs (nlimits, count) of a simulation, or None if it fails."""
        inputs = dict(zip(self.references, reference.tolist(), strict=True))
        with np.errstate(all="ignore"):
            for method in methods.applicable(methods.METHODS, self._prepared):
                job = checked_job(self._prepared, self._times, inputs, state, *_TOLERANCES, self._params, events=())
                try:
                    with kept_memory(job.network, job.prepared.is_discrete):
                        found = response_to(job, [method])
                except (SolverError, LoopError):
                    return None
                except NotApplicableError:  # not compilable: the next method
                    continue
                outputs = np.atleast_2d(found.y[self._rows, ...].reshape(len(self._rows), -1))
                return outputs if np.isfinite(outputs).all() else None
        raise AssertionError("the method python applies to every system that the constructor accepts")

    def _checked(self, x: ArrayLike, *references: ArrayLike) -> list[Array]:
        found = [np.asarray(x, dtype=float), *(np.atleast_1d(np.asarray(v, dtype=float)) for v in references)]
        sizes = [("x", len(self.states)), *((name, len(self.references)) for name in ("v", "r"))]
        for (name, size), values in zip(sizes, found, strict=False):
            if values.shape != (size,) or not np.isfinite(values).all():
                raise ValueError(f"{name} must have {size} finite entries, got {values.tolist()}")
        return found


def _peaks(values: Array) -> Array:
    """Maxima (nsignals,) of signals (nsignals, ntime), interpolated between samples by parabolas."""
    before, middle, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    bend = 2.0 * middle - before - after
    inner = (middle >= before) & (middle >= after) & (bend > 0.0)
    rise = np.where(inner, (after - before) ** 2 / (8.0 * np.where(inner, bend, 1.0)), 0.0)
    return np.asarray(np.maximum((middle + rise).max(axis=1), np.maximum(values[:, 0], values[:, -1])))


def _check_autonomous(prepared: Prepared) -> None:
    """Raise for a system that its state and constant inputs do not determine."""
    if prepared.is_discrete:
        raise ValueError(f"system must be continuous, got {prepared.name} with dt = {prepared.dt}")
    if prepared.network is None:
        raise ValueError(
            f"system must be supported without python-control's own simulation, but {prepared.unsupported}"
        )
    for block in prepared.network.blocks:
        if block.plan is not None or block.traits.breakpoints:
            raise ValueError(f"system must not depend on time, got the plan or breakpoints of the block {block.name}")
        if block.delay is not None:
            raise ValueError(f"system must have a finite number of states, got the delay of the block {block.name}")
