"""Feedforward gains estimated from a log."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.optimize import brentq

from ctrlplan._checks import check_kind, checked_labels, checked_names, real_array
from ctrlplan._display import Displayed, Facts, Part, Table, number
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params, Value
from ctrlplan.systems.motion import FilteredColumn, Motion, PlannedMotion, SampledMotion
from ctrlplan.systems.regression import LeastSquares, least_squares
from ctrlplan.systems.source import create_source_iosystem
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory, derivative_name

Function: TypeAlias = Callable[[Value], Value]
"""Function of the position."""
Term: TypeAlias = str | tuple[str, Function]
"""Name of a term, or a name with a function of the position."""

_ORDERS = {"static": 1, "velocity": 1, "acceleration": 2, "jerk": 3, "gravity": 0}
"""Derivative of the position that each term depends on."""
TERMS = tuple(_ORDERS)
"""Names of terms that are not functions of the user."""
_FILTERED = frozenset({"static"})
"""Terms that are not linear in the position."""

_THRESHOLD = 0.02
"""Velocity relative to its peak below which samples are left out: static friction is unknown there."""
_LONGEST_DELAY = 0.5
"""Longest delay that is searched for [s], at most a tenth of the log."""
_REACH = 0.8
"""Periods of the cutoff frequency around a standstill that are left out: the filter mixes in what is unknown there."""
_STEPS = 20
"""Steps of the Gauss-Newton method at most."""
_COARSE = 1000
"""Number of samples with which delays on a grid are compared."""
_SINGULAR = 1e7
"""Condition number from which the gains cannot be determined."""
_LARGE_CONDITION = 10.0
"""Condition number from which terms are hard to tell apart."""
_LARGE_ERROR = 0.005
"""Tracking error relative to the range of the plan from which feedback is named as a source of bias."""

_MOVES = {
    frozenset({"static", "velocity"}): "moves at clearly different speeds",
    frozenset({"static", "acceleration"}): "moves with phases of constant velocity, in both directions",
    frozenset({"velocity", "acceleration"}): "moves with phases of constant velocity and short acceleration phases",
    frozenset({"velocity", "jerk"}): "moves of different durations",
    frozenset({"acceleration", "jerk"}): "moves of different durations",
    frozenset({"static", "gravity"}): "moves in both directions",
    frozenset({"velocity", "gravity"}): "moves in both directions",
    frozenset({"acceleration", "gravity"}): "moves in both directions",
    frozenset({"delay", "acceleration"}): "moves with shorter acceleration phases",
    frozenset({"delay", "velocity"}): "moves with shorter acceleration phases",
    frozenset({"delay", "jerk"}): "moves of different durations",
    frozenset({"delay", "static"}): "moves with reversals",
}
"""Moves that distinguish two terms."""
_OTHER_MOVE = "moves over a wider range of positions, in both directions and at different speeds"


_GAP, _LONG_GAP = 2.5, 10.0
"""Intervals between samples, in median ones, that are gaps; and above which a single one may falsify the gains."""

_MISSING = 0.05
"""Fraction of the time in gaps above which confidence intervals are too narrow; at 3 % they hold."""


@dataclass(frozen=True, repr=False)
class FeedforwardFit(Displayed):
    """Feedforward gains with their uncertainty.

    Attributes
    ----------
    gains : dict of str to float
        Gain of each term, in the unit of the control over that of the term.
    intervals : dict of str to (float, float)
        95 % confidence interval of each gain.
    standard_errors : dict of str to float
        Standard error of each gain.
    delay : float
        Time from the control to the motion [s].
    delay_error : float
        Standard error of the delay [s]; infinite where the log does not
        determine it.
    condition : float
        Condition number of the regressors, each scaled to norm 1.
    deviation, correlation : float
        Standard deviation of the residuals, and correlation of successive ones.
    samples : int
        Number of samples used.
    threshold : float
        Samples with a speed below this one were left out.
    control, position : str
        Signals of the log.
    functions : dict of str to callable
        Functions of the position by the names of their terms.
    notes : tuple of str
        How the fit was made, and what the data cannot determine.
    """

    gains: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    standard_errors: dict[str, float]
    delay: float
    delay_error: float
    condition: float
    deviation: float
    correlation: float
    samples: int
    threshold: float
    control: str = "u"
    position: str = "y"
    functions: Mapping[str, Function] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def _describe(self) -> Iterator[Part]:
        yield f"FeedforwardFit of {self.control} with the terms {', '.join(self.gains)}"
        delay = f"{1e3 * self.delay:.4g} ms, standard error {1e3 * self.delay_error:.2g} ms"
        yield Facts(
            [
                ("delay", f"{delay}, from {self.control} to {self.position}"),
                ("residual", f"standard deviation {number(self.deviation)}, correlation {self.correlation:.3g}"),
                ("condition", number(self.condition)),
                ("samples", f"{self.samples} with a speed above {number(self.threshold)}"),
            ]
        )
        rows = [
            (name, number(gain), number(self.standard_errors[name]), *map(number, self.intervals[name]))
            for name, gain in self.gains.items()
        ]
        yield Table("Gains", ("term", "gain", "standard error", "95 % from", "to"), rows)
        yield from self.notes

    def results(self) -> dict[str, object]:
        """Plain data for JSON."""
        return {
            "gains": dict(self.gains),
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
            "delay": self.delay,
            "delay_error": self.delay_error if math.isfinite(self.delay_error) else None,
        }

    @property
    def order(self) -> int:
        """Highest derivative of the position that the terms depend on."""
        return max(_ORDERS.get(name, 0) for name in self.gains)

    def values(self, jet: Value) -> Value:
        """Control of the terms.

        Parameters
        ----------
        jet : sequence of array_like
            Position and derivatives up to `order`.
        """
        return sum(gain * _term(name, self.functions, jet) for name, gain in self.gains.items())

    def create_iosystem(
        self,
        plan: Trajectory | None = None,
        *,
        labels: Sequence[str] | str | None = None,
        suffix: str = "_ref",
        outputs: Sequence[str] | str | None = None,
        name: str = "feedforward",
    ) -> ct.InputOutputSystem:
        """Create the feedforward as a block.

        No states. Inputs: y_ref, y_ref_d1, ... up to `order`, as
        `create_source_iosystem` names its outputs with ``suffix="_ref"``, for the
        position y; none with a plan. Outputs: the control, u; python-control adds
        outputs of the same name, so that it is added to that of a controller u.

        Parameters
        ----------
        plan : Trajectory, optional
            Plan with one axis, or with one that has the label. The block then
            contains the source, and leads the plan by the delay: simulate from
            ``plan.start - delay`` on for the whole lead.
        labels : str, optional
            Name of the plan's axis, by default that of the position.
        suffix : str, optional
            Appended to the label.
        outputs : str, optional
            Name of the output, by default that of the control.
        name : str, optional
            Name of the block.

        Returns
        -------
        control.InputOutputSystem
            Of any time base.

        Raises
        ------
        ValueError
            If the plan has several axes, none of which has the label.
        """
        label = checked_labels([self.position] if labels is None else labels, 1)[0] + suffix
        control = checked_names(self.control if outputs is None else outputs, "outputs", 1)
        signals = [derivative_name(label, k) for k in range(self.order + 1)]

        def out(t: Value, x: Value, u: Value, params: Params) -> Value:
            return np.array([self.values(u)])

        block = ct.nlsys(None, out, inputs=signals, outputs=control, dt=None, name=name)
        if plan is None:
            return block
        axis = plan.select([plan.labels[_axis_of(plan, label.removesuffix(suffix))]])
        lead = axis.shift(-self.delay) if self.delay else axis
        block.name = f"{name} gains"
        declare(block, breakpoints=_reversals(lead) if "static" in self.gains else (), feedthrough=True)
        source = create_source_iosystem(lead, self.order, labels=label, name=f"{name} plan")
        return ct.interconnect([source, block], inputs=0, outputs=control, name=name)


def fit_feedforward(
    log: ct.TimeResponseData,
    plan: Trajectory | None = None,
    *,
    control: str = "u",
    position: str = "y",
    terms: Sequence[Term] = ("static", "velocity", "acceleration"),
) -> FeedforwardFit:
    r"""Estimate feedforward gains from a log.

    The control is regressed on the terms at a later time,

    .. math:: u(t) = K_s\,\mathrm{sign}(\dot y) + K_v\,\dot y + K_a\,\ddot y + ...
              \quad \text{at } t + d,

    with the delay d from the control to the motion, which is estimated together
    with the gains. Samples with a speed below 2 % of its peak are left out, since
    static friction is unknown there. Confidence intervals allow for residuals that
    are correlated as an autoregressive process of first order.

    Parameters
    ----------
    log : TimeResponseData
        Log with the control and, without a plan, the position, as `read_log`
        returns it; with a plan in the time of the plan, as
        ``comparison.measured[name].aligned``.
    plan : Trajectory, optional
        Plan that the machine followed; its derivatives are then the regressors.
        By default, those of the measured position after a low-pass filter without
        phase shift, which acts on the control and the other terms as well.
    control, position : str, optional
        Signals of the log. With a plan of several axes, `position` is the label of
        the axis.
    terms : sequence of str or (str, callable), optional
        "static" (sign of the velocity), "velocity", "acceleration", "jerk",
        "gravity" (a constant), and functions of the position with a name.

    Returns
    -------
    FeedforwardFit

    Raises
    ------
    ValueError
        If a signal or term is unknown, the log does not contain enough motion or
        does not overlap the plan, or the terms cannot be told apart at all.
    TypeError
        If an argument has a wrong type.

    Warns
    -----
    UserWarning
        If there is no plan and samples are missing: a gap of more than 10 median
        intervals, or gaps of more than 2.5 in more than 5 % of the time. Confidence
        intervals do not allow for the interpolation there.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> points = [cp.Waypoint(t, y, 0, 0) for t, y in ((0, 0), (1, 1), (1.5, 1), (3.5, 0), (4, 0.3))]
    >>> plan = cp.PiecewiseSpline(points)
    >>> t = np.linspace(0, 4, 4001)
    >>> _, v, a = plan.jet(t + 2e-3, 2)[:, 0]
    >>> log = cp.read_log({"time": t, "u": 0.5 * np.sign(v) + 2.0 * v + 0.1 * a})
    >>> fit = cp.fit_feedforward(log, plan)
    >>> {name: round(gain, 6) for name, gain in fit.gains.items()}, round(fit.delay, 6)
    ({'static': 0.5, 'velocity': 2.0, 'acceleration': 0.1}, 0.002)
    """
    names, functions = _checked_terms(terms)
    t, signals = _signals(log)
    wanted = (control,) if plan is not None else (control, position)
    for name in wanted:
        if name not in signals:
            raise ValueError(f"log must have the signal {name!r}, got {', '.join(signals)}")
    order = max(2, *(_ORDERS.get(name, 0) for name in names))
    motion: Motion
    if plan is None:
        t, signals = _evenly(t, signals)
        motion = SampledMotion(t, signals[position], order)
        how = f"derivatives of {position} after a low-pass filter of {motion.cutoff:.3g} Hz without phase shift"
    else:
        motion = PlannedMotion(plan, _axis_of(plan, position), order)
        how = "derivatives of the plan"
    data = _Data(t, signals[control], motion, names, functions)
    fit, delay = data.fitted()
    _check_condition(fit, names)
    gains = dict(zip(names, fit.coefficients.tolist(), strict=False))
    widths = fit.half_widths().tolist()
    intervals = {name: (gain - w, gain + w) for (name, gain), w in zip(gains.items(), widths, strict=False)}
    notes = [f"Regressors: {how}."]
    notes += _notes_on_data(fit, names, intervals, delay, data.longest)
    if plan is not None and position in signals:
        notes += _notes_on_feedback(plan, _axis_of(plan, position), t, signals[position])
    return FeedforwardFit(
        gains=gains,
        intervals=intervals,
        standard_errors=dict(zip(names, fit.standard_errors.tolist(), strict=False)),
        delay=delay,
        delay_error=float(fit.standard_errors[-1]) if data.determined(fit) else math.inf,
        condition=fit.condition,
        deviation=fit.deviation,
        correlation=fit.correlation,
        samples=int(np.count_nonzero(data.at(delay)[1])),
        threshold=data.threshold,
        control=control,
        position=position,
        functions=functions,
        notes=tuple(notes),
    )


# Input


def _checked_terms(terms: Sequence[Term]) -> tuple[list[str], dict[str, Function]]:
    """Names of the terms, and the functions of those that have one."""
    if isinstance(terms, str) or not isinstance(terms, Sequence):
        raise TypeError(f"terms must be a sequence of names and (name, function), got {terms!r:.80}")
    names: list[str] = []
    functions: dict[str, Function] = {}
    for term in terms:
        if isinstance(term, str):
            if term not in _ORDERS:
                raise ValueError(f"terms must be among {', '.join(_ORDERS)}, or (name, function), got {term!r}")
            names.append(term)
        elif isinstance(term, tuple) and len(term) == 2 and isinstance(term[0], str) and callable(term[1]):
            if term[0] in _ORDERS or not term[0]:
                raise ValueError(f"terms must have names of their own for functions, got {term[0]!r}")
            names.append(term[0])
            functions[term[0]] = term[1]
        else:
            raise TypeError(f"terms must be names or (name, function of the position), got {term!r:.80}")
    if not names:
        raise ValueError("terms must have at least one term, got none")
    if len(set(names)) < len(names):
        raise ValueError(f"terms must differ from each other, got {', '.join(names)}")
    return names, functions


def _signals(log: ct.TimeResponseData) -> tuple[Array, dict[str, Array]]:
    """Times and signals of a log."""
    check_kind(log, "log", ct.TimeResponseData, "a response, as read_log returns it")
    t = np.asarray(log.time, dtype=float)
    rows = np.asarray(log.outputs, dtype=float).reshape(-1, t.size)
    if t.size < 2 or not np.all(np.diff(t) > 0.0) or not np.isfinite(rows).all():
        raise ValueError("log must have increasing times and finite signals; read it by ctrlplan.read_log")
    return t, dict(zip(log.output_labels, rows, strict=True))


def _evenly(t: Array, signals: Mapping[str, Array]) -> tuple[Array, dict[str, Array]]:
    """Signals at even times, by linear interpolation where the log is uneven; a warning if much is interpolated."""
    steps = np.diff(t)
    if np.ptp(steps) <= 1e-6 * np.median(steps):
        return t, dict(signals)
    gaps = steps[steps > _GAP * np.median(steps)]
    share = float(gaps.sum() / (t[-1] - t[0]))
    if share > _MISSING or steps.max() > _LONG_GAP * np.median(steps):
        warnings.warn(
            f"a log without a plan should be evenly sampled, got gaps of up to {1e3 * steps.max():.3g} ms, "
            f"{100.0 * share:.2g} % of the time: signals are interpolated there, and the intervals of the gains are "
            "too narrow; give the plan, or fit a log without gaps",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )
    even = np.linspace(t[0], t[-1], round(float((t[-1] - t[0]) / np.median(steps))) + 1)
    return even, {name: np.interp(even, t, row) for name, row in signals.items()}


def _axis_of(plan: Trajectory, label: str) -> int:
    """Axis of a plan with a label; the only axis whatever its label."""
    check_kind(plan, "plan", Trajectory)
    if plan.naxes == 1:
        return 0
    if label not in plan.labels:
        raise ValueError(f"position must be a label of the plan's axes {', '.join(plan.labels)}, got {label!r}")
    return plan.labels.index(label)


# Regression


def _term(name: str, functions: Mapping[str, Function], jet: Value) -> Value:
    """Regressor of a term."""
    if name in functions:
        return functions[name](jet[0])
    return _OTHER_TERMS[name](jet) if name in _OTHER_TERMS else jet[_ORDERS[name]]


_OTHER_TERMS: dict[str, Function] = {
    "static": lambda jet: np.sign(jet[1]),
    "gravity": lambda jet: 1.0 + 0.0 * jet[0],
}
"""Regressors that are no derivative, as functions of the jet."""


def _check_function(function: Function, name: str, position: Array) -> None:
    """Raise unless a function of the user gives one finite number per position, or one for all."""
    values = real_array(function(position), f"term {name!r}")
    if values.shape not in ((), position.shape):
        raise ValueError(
            f"term {name!r} must return one value per position, shape {position.shape}, got shape {values.shape}"
        )
    if not np.isfinite(values).all():
        where = int((~np.isfinite(np.broadcast_to(values, position.shape))).argmax())
        raise ValueError(f"term {name!r} must be finite, got nan or inf at position {position[where]:.6g}")


class _Data:
    """Control and regressors of a log, as functions of the delay."""

    def __init__(
        self, t: Array, control: Array, motion: Motion, names: Sequence[str], functions: Mapping[str, Function]
    ) -> None:
        self._motion, self._names, self._functions = motion, names, functions
        jet = motion.jet(t)
        speed, acceleration = (float(np.max(np.abs(row))) for row in jet[1:3])
        if not speed > 0.0:
            raise ValueError("log must contain a motion, got none; align it with the plan, as with_measured does")
        for name, function in functions.items():
            _check_function(function, name, jet[0])
        self.threshold = _THRESHOLD * speed
        self.longest = min(_LONGEST_DELAY, 0.1 * float(t[-1] - t[0]))
        self._dt = float(np.median(np.diff(t)))
        # Time scale of the motion, within which the sum of squares has one minimum.
        self._scale = speed / acceleration if acceleration > 0.0 else self.longest
        self._columns: dict[str, FilteredColumn] = {}
        self._moving: tuple[Array, Array] | None = None
        every = 1
        if isinstance(motion, SampledMotion):
            # Minimum of the neighbourhood that the filter mixes.
            reach = round(_REACH / motion.cutoff / self._dt)
            self._moving = t, minimum_filter1d(np.abs(jet[1]), 2 * reach + 1, mode="nearest")
            moves = np.abs(jet[1]) > max(4.0 * motion.velocity_noise, 0.05 * self.threshold)
            quiet = np.where(moves, jet, 0.0 * jet)  # without the sign of the noise at standstill
            for name in names:
                if name in _FILTERED or name in functions:
                    values = _term(name, functions, quiet if name in _FILTERED else jet)
                    self._columns[name] = FilteredColumn(t, np.broadcast_to(values, t.shape), motion)
            every = max(int(1.0 / (2.0 * motion.cutoff * self._dt)), 1)  # filtered noise is white at this rate
        self.t, self.u = t[::every], motion.smooth(control)[::every]

    def at(self, delay: float) -> tuple[Array, NDArray[np.bool_]]:
        """Columns of the terms (ntime, nterms), and samples that have enough speed, inside the known motion."""
        return self._columns_of(self.t + delay, self._motion.jet(self.t + delay))

    def fitted(self) -> tuple[LeastSquares, float]:
        """Gains and delay: search on a grid, then the Gauss-Newton method."""
        step = min(max(0.1 * self._scale, 0.5 * self._dt), self.longest / 8.0)
        delay = self._roughly(step)
        for _ in range(_STEPS):
            fit = self._linearised(delay)
            if not self.determined(fit):
                return fit, 0.0
            change = float(np.clip(fit.coefficients[-1], -step, step))
            delay += change
            if abs(change) <= 1e-3 * float(fit.standard_errors[-1]) + 1e-12 * self._scale:
                break
        return self._linearised(delay), delay

    def determined(self, fit: LeastSquares) -> bool:
        """Whether the control changes with the delay, so that it has a column."""
        return fit.coefficients.size > len(self._names)

    def _columns_of(self, at: Array, jet: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Columns at some times with their jets, and which of them are used."""
        columns = [
            self._columns[name](at) if name in self._columns else _term(name, self._functions, jet)
            for name in self._names
        ]
        used = (at >= self._motion.start) & (at <= self._motion.end)
        used &= (np.abs(jet[1]) if self._moving is None else np.interp(at, *self._moving)) > self.threshold
        rows = [np.broadcast_to(np.asarray(column, dtype=float), at.shape) for column in columns]
        return np.stack(rows, axis=1), used

    def _roughly(self, step: float) -> float:
        """Delay with the smallest residuals on a grid, at some of the samples, with jets between those of a table."""
        every = max(self.t.size // _COARSE, 1)
        t, u = self.t[::every], self.u[::every]
        count = int(self.longest / step)
        table = np.arange(t[0] - self.longest, t[-1] + self.longest + step, max(0.1 * step, 0.5 * self._dt))
        rows = self._motion.jet(table)
        grid = step * np.arange(-count, count + 1, dtype=float)
        costs = np.full(grid.size, np.inf)
        for k, delay in enumerate(grid.tolist()):
            x, used = self._columns_of(t + delay, np.stack([np.interp(t + delay, table, row) for row in rows]))
            if np.count_nonzero(used) * every >= self._minimum and np.count_nonzero(used) > x.shape[1]:
                x, y = x[used], u[used]
                costs[k] = np.mean((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2)
        equal = grid[costs <= costs.min() * (1.0 + 1e-9)]
        if not np.isfinite(costs).any():
            raise self._too_short()
        return float(equal[np.abs(equal).argmin()])

    def _linearised(self, delay: float) -> LeastSquares:
        """Least squares with the derivative by the delay as last column; its coefficient is a change of the delay."""
        x, used = self.at(delay)
        if np.count_nonzero(used) < self._minimum:
            raise self._too_short()
        h = self._dt  # not less, since an acceleration may jump between two samples
        gains = np.linalg.lstsq(x[used], self.u[used], rcond=None)[0]
        slope = (self.at(delay + h)[0] - self.at(delay - h)[0]) @ gains / (2.0 * h)
        if np.linalg.norm(slope[used]) * self._scale <= 1e-6 * np.linalg.norm((x @ gains)[used]):
            return least_squares(x, self.u, used)
        return least_squares(np.column_stack([x, slope]), self.u, used)

    @property
    def _minimum(self) -> int:
        """Minimum number of samples; filtered ones are independent of each other."""
        return (3 if isinstance(self._motion, SampledMotion) else 10) * (len(self._names) + 1)

    def _too_short(self) -> ValueError:
        must = (
            f"log must have at least {self._minimum} samples with a speed above {self.threshold:.4g}, 2 % of its peak"
        )
        if isinstance(self._motion, SampledMotion):
            return ValueError(
                f"{must}, got fewer at the rate of the low-pass filter of {self._motion.cutoff:.3g} Hz that the noise "
                "of the position requires; give a plan, whose derivatives have no noise, or a longer log"
            )
        return ValueError(f"{must}, got fewer; align the log with the plan, as with_measured does")


# Notes


def _check_condition(fit: LeastSquares, names: Sequence[str]) -> None:
    if fit.condition > _SINGULAR:
        mixed, move = _mixed(fit, names)
        raise ValueError(
            f"terms must be determined by the log, but {mixed} cannot be told apart (condition {fit.condition:.3g}); "
            f"add {move}, or leave a term out"
        )


def _mixed(fit: LeastSquares, names: Sequence[str]) -> tuple[str, str]:
    """Terms that the data distinguish worst, and the moves that would distinguish them."""
    weights = np.abs(fit.directions[-1])
    labels = [*names, "delay"][: weights.size]
    chosen = [labels[k] for k in np.argsort(-weights) if weights[k] > 0.3 * weights.max()]
    pair = frozenset(chosen[:2])
    if len(chosen) == 1:
        return chosen[0], "moves in which it is not 0"
    return f"{', '.join(chosen[:-1])} and {chosen[-1]}", _MOVES.get(pair, _OTHER_MOVE)


def _notes_on_data(
    fit: LeastSquares,
    names: Sequence[str],
    intervals: Mapping[str, tuple[float, float]],
    delay: float,
    longest: float,
) -> Iterator[str]:
    if fit.condition > _LARGE_CONDITION:
        mixed, move = _mixed(fit, names)
        yield (
            f"Condition {fit.condition:.3g}: the log hardly distinguishes {mixed}; the intervals allow for it. Add "
            f"{move} to determine them better."
        )
    unknown = [name for name in names if intervals[name][0] <= 0.0 <= intervals[name][1]]
    if unknown:
        yield f"The interval of {', '.join(unknown)} contains 0: the log does not show this term."
    if fit.coefficients.size == len(names):
        yield "The delay is not determined by these terms and is taken as 0."
    elif delay < -3.0 * float(fit.standard_errors[-1]):
        yield "The delay is negative: the motion is logged before the control, or the log is not aligned with the plan."
    if abs(delay) >= 0.98 * longest:
        yield f"The delay is at the end of the range searched, {longest:.3g} s: align the log with the plan."


def _notes_on_feedback(plan: Trajectory, axis: int, t: Array, measured: Array) -> Iterator[str]:
    reference = plan.jet(t, 0)[0, axis]
    error, span = float(np.max(np.abs(reference - measured))), float(np.ptp(reference))
    if error > _LARGE_ERROR * span > 0.0:
        yield (
            f"The tracking error reaches {100.0 * error / span:.2g} % of the range of the plan: the feedback in the "
            "logged control is correlated with it and a source of bias, since the motion is not that of the plan. Fit "
            "to the measured position (plan=None), or repeat the fit after a round with the new gains."
        )


def _reversals(plan: Trajectory) -> tuple[float, ...]:
    """Times between the breakpoints at which the velocity changes its sign."""
    found: list[float] = []
    edges = np.asarray(plan.breakpoints, dtype=float)

    def velocity(t: Array | float) -> Array:
        return plan.jet(t, 1)[1, 0]

    for start, end in pairwise(edges.tolist()):
        times = np.linspace(start, end, 130)[1:-1]
        signs = np.sign(velocity(times))
        between = np.flatnonzero(signs[:-1] * signs[1:] < 0.0)
        found += [float(brentq(velocity, times[k], times[k + 1], xtol=1e-14)) for k in between]
    return tuple(found)
