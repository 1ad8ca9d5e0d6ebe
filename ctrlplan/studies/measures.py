"""Metrics of responses: `MEASURES` is their only list."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal, TypeAlias, get_args

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan import metrics
from ctrlplan._display import MISSING, ROWS, Displayed, Facts, Part, number
from ctrlplan._types import Array
from ctrlplan.metrics._control import magnitude, varied
from ctrlplan.metrics._error import absolute
from ctrlplan.metrics._evaluation import Evaluation, Later, rows_together
from ctrlplan.metrics._held import Held
from ctrlplan.metrics._response import exceeded, settled
from ctrlplan.planning import SquaredDerivative
from ctrlplan.simulation import Occurrence, Prepared, SimulationResponse
from ctrlplan.trajectories import Trajectory, Waypoint

Kind = Literal["", "response", "control", "path", "run"]
"""Argument of the function of a measure."""

Function: TypeAlias = Callable[..., Any]
"""Function of a `Tracked`, `Acting`, `Path` or `Run`, according to the kind of its measure."""

_TURNED = 1e-9
"""Net change, relative to the range of a plan, below which the plan returns to its start."""


@dataclass(frozen=True)
class Tracked:
    """Outputs that follow a plan: argument of a `Measure` of responses.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Sample times [s] from `start` on.
    y, reference : ndarray, shapes (naxes, ntime)
        Outputs and positions of the plan; `y` may have more rows if the
        reference has one.
    initial, final : ndarray, shape (naxes,)
        First and last position of the plan.
    span : ndarray, shape (naxes,)
        Range of the plan, maximum minus minimum.
    band, start : float
        Half width of the settling band relative to the range, and the start of
        the interval of the metrics [s].
    held : tuple of Held or None
        Part of each output that discrete blocks hold between known times; None
        without one.
    """

    t: Array
    y: Array
    reference: Array
    initial: Array
    final: Array
    span: Array
    band: float
    start: float
    held: tuple[Held | None, ...] = ()

    @cached_property
    def error(self) -> Array:
        """Reference minus output, (naxes, ntime)."""
        return self.reference - self.y

    @cached_property
    def remainder(self) -> Array:
        """Final position minus output, (naxes, ntime)."""
        return self.final[:, None] - self.y

    @cached_property
    def origin(self) -> Array:
        """Final position minus the range, in the direction of the move: initial value of relative metrics.

        The first position for a plan without reversals. The direction is that of the net change or, for a plan that
        returns to its start, that of its largest excursion.
        """
        net = self.final - self.initial
        far = self.reference - self.initial[:, None]
        farthest = far[np.arange(len(far)), np.abs(far).argmax(axis=1)]
        direction = np.sign(np.where(np.abs(net) > _TURNED * self.span, net, farthest))
        direction = np.where(direction == 0.0, 1.0, direction)
        return np.where(self.span == np.abs(net), self.initial, self.final - direction * self.span)


@dataclass(frozen=True)
class Acting:
    """Controls: argument of a `Measure` of controls.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Sample times [s] from `start` on.
    u : ndarray, shape (ncontrols, ntime)
        Controls.
    start : float
        Time [s] from which it is measured.
    held : tuple of Held or None
        Part of each control that discrete blocks hold between known times; None
        without one.
    """

    t: Array
    u: Array
    start: float
    held: tuple[Held | None, ...] = ()


@dataclass(frozen=True)
class Path:
    """A plan between its waypoints: argument of a `Measure` of paths.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    t : ndarray, shape (ntime,)
        Times [s] from the first waypoint to the last (`move_end`).
    path, points : ndarray, shapes (naxes, ntime) and (naxes, nwaypoints)
        Positions of the plan, and of the waypoints.
    """

    plan: Trajectory
    t: Array
    path: Array
    points: Array

    @cached_property
    def steps(self) -> bool:
        """Whether the position is discontinuous, so that there is no path."""
        return bool(self.plan.jumps(0))


@dataclass(frozen=True, eq=False)
class Run:
    """Simulation of one plan in its loop: argument of a `Measure` of runs.

    Attributes
    ----------
    plan : Trajectory
        The reference.
    system : control system, Prepared or None
        The loop; None for a measured run.
    response : SimulationResponse
        Response of the loop, as returned by `simulate`.
    outputs, controls : tuple of str
        Outputs that follow the plan, and outputs that are controls.
    last : float
        Time at which the plan reaches the last waypoint [s] (`move_end`), or
        its end without waypoints.
    unstable : ndarray of complex, or None
        Poles in the right half plane; None if the loop is nonlinear.
    doubt : str
        Warning that the run may not start at equilibrium; otherwise empty.
    stop : Occurrence or None
        Event that ended the run.
    held : mapping of str to Held
        Parts of outputs that discrete blocks hold between known times.
    """

    plan: Trajectory
    system: ct.InputOutputSystem | Prepared | None
    response: SimulationResponse
    outputs: tuple[str, ...]
    controls: tuple[str, ...]
    last: float
    unstable: NDArray[np.complex128] | None = None
    doubt: str = ""
    stop: Occurrence | None = None
    held: Mapping[str, Held] = field(default_factory=dict)

    @property
    def is_unstable(self) -> bool:
        """Whether the loop is known to be unstable."""
        return self.unstable is not None and self.unstable.size > 0

    @cached_property
    def t(self) -> Array:
        """Sample times [s], (ntime,)."""
        return np.asarray(self.response.time)

    @cached_property
    def signals(self) -> dict[str, Array]:
        """Outputs of the loop (ntime,) by their labels."""
        return signals_of(self.response)

    def rows(self, names: tuple[str, ...]) -> Array:
        """Some of the outputs, (nnames, ntime)."""
        return np.array([self.signals[name] for name in names]).reshape(-1, self.t.size)

    @property
    def held_parts(self) -> tuple[Held | None, ...]:
        """Held parts of the outputs, then of the controls."""
        return tuple(self.held.get(name) for name in (*self.outputs, *self.controls))


@dataclass(frozen=True, repr=False)
class Measure(Displayed):
    """A metric: title, unit and function. Smaller values are better for all metrics.

    Attributes
    ----------
    title : str
        Title in tables and figures.
    unit : str
        Unit, with ``{y}`` and ``{u}`` for the units of output and control.
    of : {"response", "control", "path", "run"} or ""
        Argument of `function`: `Tracked`, `Acting`, `Path` or `Run`. Empty
        without a function: the measure then describes a value that the function
        of a measure of runs returns under its name.
    function : callable, optional
        Maps a `Tracked` or `Acting` to one value for each axis or control, a
        `Path` to one value, and a `Run` to one value or to a mapping of names to
        values: metrics that share their computation.
    name : str
        Key of the metric in a comparison; by default, the title.
    definition : str
        What is computed, with unit and normalisation, in a sentence or two for
        the page; a text that several metrics have is shown once.

    Examples
    --------
    A metric of the user is an entry of `MEASURES`, or of the ``measures`` of a comparison:

    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> late = cp.Measure("Error at the end", "{y}", "response", lambda seen: np.abs(seen.error[:, -1]))
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    >>> loop = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 3.0)
    >>> found = cp.compare(loop, move, np.linspace(0, 20, 401), measures={"late": late})
    >>> round(found.metrics["step"]["late"], 9)  # 3/(s + 1) in unity feedback has a steady-state error of 1/4
    0.25
    """

    title: str
    unit: str = ""
    of: Kind = ""
    function: Function | None = None
    name: str = ""
    definition: str = ""

    def __post_init__(self) -> None:
        if self.of not in get_args(Kind):
            raise ValueError(f'of must be "response", "control", "path" or "run", got {self.of!r}')
        if bool(self.of) != (self.function is not None):
            raise ValueError(f"of and function must be given together, got only {'of' if self.of else 'function'}")

    def _describe(self) -> Iterator[Part]:
        yield f"Measure {self.name or self.title}"
        yield Facts(
            [
                ("title", self.title),
                ("unit", self.unit.replace("{y}", "[output]").replace("{u}", "[control]")),
                ("of", self.of),
                ("function", getattr(self.function, "__name__", "") if self.function else ""),
                ("definition", self.definition),
            ]
        )


@dataclass(frozen=True)
class _Shared:
    """Function of a `Tracked` or `Acting` whose computation is shared with others of the same signals."""

    start: Callable[[Evaluation, Any], Later]

    def __call__(self, seen: Tracked | Acting) -> Array:
        return self.start(Evaluation(seen.t), seen)()


def _added(evaluation: Evaluation, seen: Tracked | Acting, signal: str, name: str) -> slice:
    """Rows of a signal, with the parts of it that are held; messages call it `name`."""
    rows = getattr(seen, signal)
    if isinstance(seen, Acting):
        return evaluation.add(rows, name, seen.held)
    return evaluation.add(rows, name, [None if part is None else part.negative() for part in seen.held])


def _settling(signal: str) -> _Shared:
    """Settling time of a signal of a `Tracked`, `error` or `remainder`."""
    return _Shared(
        lambda evaluation, seen: settled(
            evaluation, _added(evaluation, seen, signal, "y"), seen.final, seen.origin, seen.band, seen.start
        )
    )


def _exceeding(signal: str, side: float) -> _Shared:
    """Overshoot for the side -1 of a signal, which is a reference minus an output, or lag for the side 1."""
    return _Shared(
        lambda evaluation, seen: exceeded(
            evaluation, _added(evaluation, seen, signal, "y"), seen.final - seen.origin, side
        )
    )


def _area(signal: str, timed: bool = False) -> _Shared:
    """Integral of the magnitude of a signal, or of this times the time since the start."""
    return _Shared(
        lambda evaluation, seen: absolute(
            evaluation, _added(evaluation, seen, signal, "error"), seen.start if timed else None
        )
    )


def _square(signal: str) -> _Shared:
    """Integral of the square of a signal."""
    return _Shared(lambda evaluation, seen: evaluation.squares(_added(evaluation, seen, signal, signal)))


def _of_path(metric: Callable[[Array, Array, Array], float | Array]) -> Callable[[Path], float | Array]:
    """Metric of a path and its waypoints; nan for steps, which have no path."""
    return lambda seen: np.nan if seen.steps else metric(seen.t, seen.path, seen.points)


_SETTLING = (
    "Settling times: from the start of the plans to the last entry of the output into the band around its final value, "
    "or around the reference for the tracking error. The band is relative to the range of the plan on the axis, "
    "maximum minus minimum; for a move without reversals this is the planned change."
)
_PERCENT = (
    "Overshoot and lag: maximum by which the output is ahead of, and behind, the reference or the final value, in the "
    "direction of the move, in percent of the range of the plan on the axis."
)
_ERROR = (
    "IAE, ISE and ITAE: integrals of the absolute error, of its square, and of the absolute error times the time since "
    "the start, over the simulated time; in the unit of the output times s, its square times s, and times s²."
)
_CONTROL = (
    "Control effort: integral of the square of the control, in its unit squared times s. Total variation: sum of its "
    "rises and falls, jumps included, in its unit."
)
_PATH = (
    "Excess path length: length of the planned path divided by that of the polyline through the waypoints, minus 1. "
    "Excess total variation: rises and falls of the axes beyond those of the waypoints, relative to these. Extra "
    "reversals: changes of direction of the axes beyond those of the waypoints. All three have no unit."
)
_JERK = (
    "Integral of the squared jerk: summed over the axes, in the unit of the plan squared per s⁵; infinite if position, "
    "velocity or acceleration is discontinuous."
)
MEASURES = {
    "settling_time": Measure(
        "Settling time",
        "s",
        "response",
        _settling("remainder"),
        definition=_SETTLING,
    ),
    "tracking_settling_time": Measure(
        "Settling time of the tracking error",
        "s",
        "response",
        _settling("error"),
        definition=_SETTLING,
    ),
    "overshoot_error": Measure(
        "Overshoot on the tracking error",
        "%",
        "response",
        _exceeding("error", -1.0),
        definition=_PERCENT,
    ),
    "overshoot_final": Measure(
        "Overshoot on the final value",
        "%",
        "response",
        _exceeding("remainder", -1.0),
        definition=_PERCENT,
    ),
    "lag_error": Measure(
        "Peak lag behind the reference",
        "%",
        "response",
        _exceeding("error", 1.0),
        definition=_PERCENT,
    ),
    "iae": Measure(
        "IAE of the tracking error",
        "{y} s",
        "response",
        _area("error"),
        definition=_ERROR,
    ),
    "ise": Measure(
        "ISE of the tracking error",
        "{y}^2 s",
        "response",
        _square("error"),
        definition=_ERROR,
    ),
    "itae": Measure(
        "ITAE of the tracking error",
        "{y} s^2",
        "response",
        _area("error", timed=True),
        definition=_ERROR,
    ),
    "iae_final": Measure(
        "IAE relative to the final value",
        "{y} s",
        "response",
        _area("remainder"),
        definition=_ERROR,
    ),
    "ise_final": Measure(
        "ISE relative to the final value",
        "{y}^2 s",
        "response",
        _square("remainder"),
        definition=_ERROR,
    ),
    "itae_final": Measure(
        "ITAE relative to the final value",
        "{y} s^2",
        "response",
        _area("remainder", timed=True),
        definition=_ERROR,
    ),
    "control_peak": Measure(
        "Peak control",
        "{u}",
        "control",
        _Shared(lambda evaluation, seen: magnitude(evaluation, _added(evaluation, seen, "u", "u"))),
    ),
    "control_effort": Measure("Control effort", "{u}^2 s", "control", _square("u"), definition=_CONTROL),
    "control_variation": Measure(
        "Total variation of the control",
        "{u}",
        "control",
        _Shared(lambda evaluation, seen: varied(evaluation, _added(evaluation, seen, "u", "u"))),
        definition=_CONTROL,
    ),
    "wandering": Measure("Excess path length", "", "path", _of_path(metrics.wandering), definition=_PATH),
    "excess_variation": Measure(
        "Excess total variation", "", "path", _of_path(metrics.excess_variation), definition=_PATH
    ),
    "turning_points": Measure("Extra reversals", "", "path", _of_path(metrics.turning_points), definition=_PATH),
    "outside_box": Measure(
        "Peak distance outside the waypoints' bounding box", "{y}", "path", _of_path(metrics.outside_box)
    ),
    "reference_jerk": Measure(
        "Integral of the squared jerk of the reference",
        "{y}^2/s^5",
        "path",
        lambda seen: jerk_cost(seen.plan),
        definition=_JERK,
    ),
}
"""The metrics of a comparison by name, in the order of the tables."""


_EMPTY = frozenset({MISSING, number(0.0)})
"""Cells of metrics that have no value or are 0."""

_LEADING = (
    "settling_time",
    "",
    "tracking_settling_time",
    "overshoot_error",
    "overshoot_final",
    "iae",
    "control_peak",
    "control_effort",
    "wandering",
)


def leading_metrics(
    measures: Mapping[str, Measure], cells_of: Callable[[str, Measure], Sequence[str]]
) -> dict[str, list[str]]:
    """Rows of a short table by metric: settling time, measures of the user, then the most important, at most eight.

    Parameters
    ----------
    measures : mapping of str to Measure
        In the order in which they are shown.
    cells_of : callable
        Maps a name and its measure to cells: the unit, then a value for each
        plan. Rows that repeat another one, hold no value, or are 0 for every
        plan are omitted.
    """
    found: dict[tuple[str, ...], str] = {}
    for name in sorted(measures, key=_rank):
        row = tuple(cells_of(name, measures[name]))
        if any(cell not in _EMPTY for cell in row[1:]):
            found.setdefault(row, name)
        if len(found) == ROWS:
            break
    rows = {name: [_short_title(name, measures[name]), *row] for row, name in found.items()}
    return {name: rows[name] for name in measures if name in rows}


def _short_title(name: str, measure: Measure) -> str:
    """Title of a metric without the definition in brackets that some of `MEASURES` have."""
    return measure.title.partition(" (")[0] if name in MEASURES else measure.title


def _rank(name: str) -> int:
    """Place of a metric among those that a short table shows, whichever signal it is of."""
    known = max((key for key in MEASURES if name == key or name.startswith(f"{key}_")), key=len, default="")
    return _LEADING.index(known) if known in _LEADING else len(_LEADING)


def signals_of(response: ct.TimeResponseData) -> dict[str, Array]:
    """Outputs (ntime,) of a response by their labels."""
    rows = np.asarray(response.outputs).reshape(-1, np.size(response.time))
    return dict(zip(response.output_labels, rows, strict=True))


@dataclass(frozen=True)
class SignalRecord:
    """Signals of one loop with a plan, or of several loops.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Sample times [s].
    y, u : ndarray, shapes (nloops, naxes, ntime) and (nloops, ncontrols, ntime)
        Outputs that follow the plan, and controls.
    axes, controls : tuple of str
        Labels of the plan's axes, and of the controls.
    unstable : ndarray of bool, shape (nloops,)
        Whether a loop is unstable, so that it never settles.
    held : tuple of tuple of Held or None, optional
        For each loop, parts of its outputs, then of its controls, that discrete
        blocks hold between known times.
    """

    t: Array
    y: Array
    u: Array
    axes: tuple[str, ...]
    controls: tuple[str, ...]
    unstable: NDArray[np.bool_]
    held: tuple[tuple[Held | None, ...], ...] = ()

    def held_parts(self, some: slice, of: slice) -> list[tuple[Held | None, ...]]:
        """Held parts of outputs or controls of some loops, for each of `_rows`."""
        loops = [parts[of] for parts in self.held[some]]
        return loops if len(loops) < 2 else list(zip(*loops, strict=True))


def signal_metrics(
    record: SignalRecord, plans: Sequence[Trajectory], start: float, band: float, measures: Mapping[str, Measure]
) -> dict[str, Array]:
    """Metrics of responses and controls.

    Each is the maximum over the axes or controls; for more than one of these
    it is followed by the values of each, with its label appended to the name.

    Parameters
    ----------
    record : SignalRecord
        The signals.
    plans : sequence of Trajectory
        Reference of the outputs: one for all loops, or one for each.
    start, band : float
        Start of the interval of the metrics [s], and the settling band.
    measures : mapping of str to Measure
        Metrics to compute.

    Returns
    -------
    dict of str to ndarray, shape (nloops,)
    """
    known = slice(int(np.searchsorted(record.t, start)), None)  # no copy of the rows
    t, course = record.t[known], _Course.of(plans, record.t[known])
    parts, count = [], rows_together(record.t.size)
    for first in range(0, len(record.y), count):
        some = slice(first, first + count)
        y, u = record.y[some, :, known], record.u[some, :, known]
        of_y, of_u = (record.held_parts(some, of) for of in (slice(y.shape[1]), slice(y.shape[1], None)))
        acting = [Acting(t, rows, start, held) for rows, held in _with_held(_rows(u), of_u)]
        kinds: list[_Seen] = [
            ("response", _tracked(t, y, course.some(some), band, start, of_y), record.axes),
            ("control", acting, record.controls),
        ]
        parts.append(_values(kinds, measures, record.unstable[some], Evaluation(t)))
    if len(parts) == 1:
        return parts[0]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


_Seen = tuple[Kind, "Sequence[Tracked | Acting]", tuple[str, ...]]


def _values(
    kinds: list[_Seen], measures: Mapping[str, Measure], unstable: NDArray[np.bool_], evaluation: Evaluation
) -> dict[str, Array]:
    """Metrics of the signals of each kind, by label, of loops that are unstable or not."""
    found: dict[str, Array] = {}
    wanted = [
        {name: [_later(function, evaluation, one) for one in seen] for name, function in _functions(kind, measures)}
        for kind, seen, labels in kinds
        if labels
    ]
    for own, labels in zip(wanted, (labels for _, _, labels in kinds if labels), strict=True):
        tables = {name: _table([value() for value in values], len(unstable)) for name, values in own.items()}
        for name in SETTLING_TIMES if unstable.any() else ():
            if name in tables:
                tables[name][unstable] = np.inf
        if tables:
            found |= dict(zip(tables, np.fmax.reduce(np.array(list(tables.values())), axis=2), strict=True))
        for name, table in tables.items() if len(labels) > 1 else ():
            found |= {f"{name}_{label}": row for label, row in zip(labels, table.T, strict=True)}
    return found


def _later(function: Function, evaluation: Evaluation, seen: Tracked | Acting) -> Callable[[], Any]:
    """Value of a measure, whose computation is shared if possible, when it is called."""
    return function.start(evaluation, seen) if isinstance(function, _Shared) else partial(function, seen)


SETTLING_TIMES = ("settling_time", "tracking_settling_time")
"""Metrics that are infinite for an unstable loop, and discontinuous along a parameter."""


def _rows(signals: Array) -> list[Array]:
    """Rows (nrows, ntime) for one call: all signals of one loop, or one signal of all loops."""
    return [signals[0]] if len(signals) == 1 else list(signals.swapaxes(0, 1))


def _with_held(
    rows: list[Array], held: list[tuple[Held | None, ...]]
) -> Iterator[tuple[Array, tuple[Held | None, ...]]]:
    """Rows with their held parts, if any are known."""
    return zip(rows, held or [()] * len(rows), strict=True)


@dataclass(frozen=True)
class _Course:
    """Positions of plans at sample times, and their ends and ranges, (nplans, naxes, ...)."""

    reference: Array
    initial: Array
    final: Array
    span: Array

    @classmethod
    def of(cls, plans: Sequence[Trajectory], t: Array) -> _Course:
        extrema = [plan.extrema() for plan in plans]
        initial, final = (np.array([getattr(plan, name) for plan in plans]) for name in ("initial", "final"))
        span = np.maximum([one.maximum - one.minimum for one in extrema], np.abs(final - initial))
        return cls(np.stack([plan.jet(t, 0)[0] for plan in plans]), initial, final, span)

    def some(self, loops: slice) -> _Course:
        """The same for some of the loops."""
        if len(self.span) == 1:
            return self
        return _Course(self.reference[loops], self.initial[loops], self.final[loops], self.span[loops])


def _tracked(
    t: Array, y: Array, course: _Course, band: float, start: float, held: list[tuple[Held | None, ...]]
) -> list[Tracked]:
    """Arguments of measures of responses, for each of `_rows`."""
    found = []
    for k, (rows, parts) in enumerate(_with_held(_rows(y), held)):
        own = (0,) if len(y) == 1 else (slice(None), k)
        of_plan = (course.reference[own], course.initial[own], course.final[own], course.span[own])
        found.append(Tracked(t, rows, *of_plan, band, start, parts))
    return found


def _table(found: Sequence[Any], nloops: int) -> Array:
    """Values (nloops, nsignals) of a measure, from those of each signal."""
    values = [np.atleast_1d(np.asarray(one, dtype=float)) for one in found]
    if nloops == 1:
        return values[0].reshape(1, -1).copy()
    table = np.stack(values, axis=1)
    if len(table) != nloops:
        raise ValueError(f"a measure must give one value for each of {nloops} rows, got {len(table)}")
    return table


def run_metrics(run: Run, measures: Mapping[str, Measure]) -> dict[str, float]:
    """Metrics of measures of runs.

    Raises
    ------
    TypeError
        If a value is neither a number nor a mapping of names to numbers.
    ValueError
        If a name returned is that of another metric.
    """
    found: dict[str, float] = {}
    for name, function in _functions("run", measures):
        values = function(run)
        if not isinstance(values, Mapping):
            if np.ndim(values):
                raise TypeError(
                    f"measures[{name!r}] must return a number or a mapping of names to numbers, got {values!r:.80}"
                )
            found[name] = float(values)
            continue
        for key, value in values.items():
            if (measures.get(key, _NONE).of and key != name) or key in MEASURES:
                raise ValueError(
                    f"measures[{name!r}] must return metrics with unique names, got {key!r}, which is another metric"
                )
            found[key] = float(value)
    return found


def path_metrics(
    plan: Trajectory, waypoints: tuple[Waypoint, ...], measures: Mapping[str, Measure] | None = None
) -> dict[str, float]:
    """Metrics of the path of a reference between its waypoints."""
    points = np.array([w.position for w in waypoints]).T
    functions = _functions("path", MEASURES if measures is None else measures)
    if len(waypoints) < 2 or not functions or np.isnan(points).any():
        return {}
    t = np.linspace(waypoints[0].time, move_end(plan, waypoints), 2001)
    seen = Path(plan, t, plan.jet(t, 0)[0], points)
    return {name: float(function(seen)) for name, function in functions}


def move_end(plan: Trajectory, waypoints: Sequence[Waypoint]) -> float:
    """Time at which a plan reaches its last waypoint [s].

    The time of the waypoint, or the end of a plan that is elsewhere at that time and
    ends later, such as one that `fastest` has slowed down.
    """
    if not waypoints:
        return plan.end
    last, away = waypoints[-1].time, plan(waypoints[-1].time) - waypoints[-1].position
    size = np.abs([w.position for w in waypoints])
    elsewhere = bool(np.any(np.abs(away) > 1e-6 * np.nanmax(size, axis=0, initial=0.0)))
    return plan.end if elsewhere and last < plan.end < np.inf else last


def jerk_cost(plan: Trajectory) -> float:
    """Integral of the squared jerk, inf where position, velocity or acceleration jumps."""
    return np.inf if plan.jumps(2) else SquaredDerivative(3)(plan)


Chosen = tuple["str | Measure", ...] | None
"""Metrics to compute: names of `MEASURES` and measures of the user, each with its name; None for all."""


def checked_measures(given: Collection[str | Measure] | Mapping[str, Measure] | None) -> Chosen:
    """Metrics to compute, from the argument of a comparison.

    Parameters
    ----------
    given : collection of str or Measure, mapping of str to Measure, or None
        A collection of names of `MEASURES` and measures of the user, or a
        mapping that is added to all of `MEASURES`.

    Raises
    ------
    TypeError
        If it is a string, or an entry is neither a name nor a measure.
    ValueError
        If a name is unknown or repeated, or a measure has no function and there
        is no measure of runs that could return it.
    """
    if given is None:
        return None
    own: list[Measure] = []
    names: list[str] = []
    if isinstance(given, Mapping):
        for key, value in given.items():
            if not isinstance(value, Measure):
                raise TypeError(f"measures[{key!r}] must be a Measure, got {type(value).__name__}")
            if MEASURES.get(key) is not value:
                own.append(replace(value, name=key))
        names = list(MEASURES)
    else:
        listed = f"a collection of names and Measures, of {', '.join(MEASURES)}"
        if isinstance(given, str) or not isinstance(given, Iterable):
            what = f"the string {given!r}" if isinstance(given, str) else f"{given!r:.80}"
            raise TypeError(f"measures must be {listed}, got {what}")
        for one in given:
            if isinstance(one, Measure):
                own.append(replace(one, name=one.name or one.title))
            elif not isinstance(one, str):
                raise TypeError(f"measures must be {listed}, got {one!r:.80}")
            elif one not in MEASURES:
                raise ValueError(f"measures must be among {', '.join(MEASURES)}, or be Measures, got {one!r}")
            else:
                names.append(one)
    _check_own(own)
    return (*own, *dict.fromkeys(names))


def _check_own(own: list[Measure]) -> None:
    of_runs = any(measure.of == "run" for measure in own)
    seen: set[str] = set()
    for measure in own:
        if measure.name in MEASURES or measure.name in seen:
            whose = "a name of MEASURES" if measure.name in MEASURES else "repeated"
            raise ValueError(f"measures must have unique names, got {measure.name!r}, which is {whose}")
        seen.add(measure.name)
        if not measure.of and not of_runs:
            raise ValueError(
                f"measures[{measure.name!r}] must have a function, or come from a measure of runs, got neither"
            )


def wanted_measures(chosen: Chosen) -> dict[str, Measure]:
    """Measures by name, those of the user first, the others in the order of `MEASURES`."""
    if chosen is None:
        return dict(MEASURES)
    names = {one for one in chosen if isinstance(one, str)}
    return own_measures(chosen) | {name: measure for name, measure in MEASURES.items() if name in names}


def own_measures(chosen: Chosen) -> dict[str, Measure]:
    """Measures of the user by name."""
    return {one.name: one for one in chosen or () if isinstance(one, Measure)}


def shown_measures(chosen: Chosen, found: Iterable[Mapping[str, float]]) -> dict[str, Measure]:
    """All measures of a comparison, those of the user first.

    A name that a measure of runs returns without a description becomes its title.
    """
    own = {
        name: measure
        for name, measure in own_measures(chosen).items()
        if measure.of != "run" or any(name in values for values in found)
    }
    returned = dict.fromkeys(name for values in found for name in values)
    described = tuple({**own, **MEASURES})
    plain = {name: Measure(name) for name in returned if not name.startswith(described)}
    return own | plain | MEASURES


def checked_names(names: Iterable[str], known: Collection[str], what: str) -> tuple[str, ...]:
    """Checked names, each among the known ones.

    Raises
    ------
    TypeError
        If they are a string.
    ValueError
        If one is unknown.
    """
    listed = ", ".join(known) or "none"
    if isinstance(names, str):
        raise TypeError(f"{what} must be a collection of names, of {listed}, got the string {names!r}")
    found = tuple(names)
    for name in found:
        if name not in known:
            raise ValueError(f"{what} must be among {listed}, got {name!r}")
    return found


_NONE = Measure("")


def _functions(of: Kind, measures: Mapping[str, Measure]) -> list[tuple[str, Function]]:
    """Functions of the measures of one kind, by name."""
    return [
        (name, measure.function)
        for name, measure in measures.items()
        if measure.of == of and measure.function is not None
    ]
