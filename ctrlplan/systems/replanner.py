"""Replanner: a plan that is refitted online, as a block."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from operator import sub
from typing import Literal, NamedTuple, get_args

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import check_kind, checked_count, checked_finite, real_array
from ctrlplan._types import Array, EventName, Params, Value
from ctrlplan.systems.hybrid import SampledBlock, state_signal
from ctrlplan.systems.source import axis_signals, create_source_iosystem
from ctrlplan.systems.stop_states import StopStates
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.extrema import stationary_times
from ctrlplan.trajectories.files import signal_names
from ctrlplan.trajectories.newton_spline import NewtonSpline
from ctrlplan.trajectories.trajectory import check_end
from ctrlplan.trajectories.transition import (
    Transition,
    coefficients_by,
    extrapolated,
    homing_matrix,
    series,
    taylor_value,
    transition,
    transition_matrix,
)

_ROUNDING, _MATTERS = 1e-12, 1e-6
"""Relative distances, in units of the move, above which a goal is new, and above which a missed one is an event."""

Trigger = Literal["period", "deviation", "goal"]
"""Condition on which a replanner makes a new fit."""

_START, _END, _NAN_INPUT, _UNREACHABLE, _FITS = range(5)
"""Indices of the first states of the correction; goal and coefficients follow."""


def create_replanner_iosystem(
    plan: Trajectory,
    dt: float,
    *,
    order: int = 2,
    horizon: float | Literal["shrinking"] = "shrinking",
    alpha: float | None = None,
    measured: int | None = None,
    goal_derivatives: int | None = None,
    trigger: Trigger = "period",
    threshold: float | None = None,
    min_horizon: float | None = None,
    limits: Mapping[int, ArrayLike] | None = None,
    stop_limits: Mapping[str, object] | None = None,
    derivatives: int | None = None,
    offset: float = 0.0,
    labels: Sequence[str] | str | None = None,
    suffix: str = "",
    name: str = "replanner",
) -> ct.InterconnectedSystem:
    r"""Plan that is refitted online every period.

    Every `dt` seconds a spline is fitted from the present jet to the jet of the
    goal. It is applied as a correction to `plan`: the transition of the same
    family and angular frequency from the present deviation to the change of the
    goal. Without deviation and change of the goal the correction is 0, and the
    plan, of any kind, is followed unchanged. A polynomial between two jets plus
    its correction is that polynomial refitted. For a trigonometric spline this
    holds except for the phase of the top harmonic of the correction, which
    refers to the middle of the remaining time: with the plan's own gamma fits
    would be singular at some times.

    Without `measured` the fit starts at the reference, so that no derivative up
    to `order` jumps. With `measured` it starts at the measurement. This is
    feedback: the reference jumps to the measured state, and the error of a
    controller is reset. It is stable if the loop follows the plan between fits:
    with a period not below the response time of the loop, or with a controller
    that uses the derivatives. With a PID and a shorter period the output drifts.
    Between fits the output is the plan in continuous time. The block runs in
    `ctrlplan.simulate` only.

    States: start and end of the correction [s]; nan_input, 1 if an input was not
    finite; unreachable, 1 if the goal is out of reach; fits, their number;
    ``goal[k]``, the goal at the last fit; ``coefficient[k]``; with `stop_limits`,
    stopped, 1 during a stop and afterwards, stop_start [s] and ``stop[k]``. Inputs:
    with `goal_derivatives`, x_goal, x_goal_d1, ... of each axis x; with `measured`,
    x, x_d1, ...; with `stop_limits`, stop. Outputs: x, x_d1, ... of each axis, as `create_source_iosystem`
    names them.

    Parameters
    ----------
    plan : Trajectory
        Nominal plan. Its end is the goal unless the goal is an input.
    dt : float
        Period of the fits [s], at most the horizon.
    order : int, optional
        Highest derivative that is continuous at a fit.
    horizon : float or "shrinking", optional
        Time from a fit [s] to the end of its correction; "shrinking": the
        remaining time of the plan.
    alpha : float, optional
        Shape parameter [rad] of a transition over the horizon, or with
        "shrinking" over the whole plan, whose angular frequency is kept. By
        default that of a `TrigSpline` with "shrinking", otherwise 0
        (polynomials).
    measured : int, optional
        Highest measured derivative; higher ones are those of the reference.
    goal_derivatives : int, optional
        Highest derivative of the goal among the inputs. The goal is extrapolated
        by its Taylor polynomial.
    trigger : {"period", "deviation", "goal"}, optional
        Fit every period; if the measurement deviates from the reference by more
        than `threshold`; or only for a new goal. The first two also fit for a
        new goal.
    threshold : float, optional
        Euclidean distance over all axes, in their unit.
    min_horizon : float, optional
        With "shrinking": remaining time [s] below which no fit is made, since the
        gains grow with its power -(order + 1). About five time constants of the
        tracking loop; by default five periods, at most half the plan.
    limits : mapping of int to array_like, optional
        Maximum magnitude of a derivative by its order, for all axes or one for
        each, until both plan and correction end. A fit that violates a limit is
        rejected: the last one stays in force. Requires milliseconds per fit.
    stop_limits : mapping, optional
        Limits of acceleration and jerk, as for `Trajectory.stop`. Adds the input
        ``stop``: at a sample at which it is above 0.5 the reference begins to stop,
        all axes together, in minimum time, whatever the other inputs are; rest is
        held until it falls. Then a fit leads to the goal again; where none is
        possible (too near to the end of the plan with "shrinking", or violating
        `limits`), rest is held further.
    derivatives : int, optional
        Highest derivative among the outputs, by default `order`.
    offset : float, optional
        Time of the first fit after the start of a run [s].
    labels : sequence of str or str, optional
        Names of the axes in place of those of the plan.
    suffix : str, optional
        Appended to each label of an output.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.InterconnectedSystem
        The source of the plan and the block with the correction. A run records as
        events when an input is not finite (nan from a sensor: the last valid
        plan stays in force), and when the goal cannot be reached within horizon
        and limits.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If an argument is out of range; the period is above the horizon; the
        sampled map from fit to fit has a spectral radius of 1 or more (for a
        loop that tracks without delay); the plan itself violates a limit; or an
        output has the name of an input.

    References
    ----------
    The paper's conclusion; `ctrlplan.trajectories.transition.Transition` for the
    limit as the period tends to 0, and for the spectral radius.

    Examples
    --------
    A goal that changes at 4 s and is reached at 10 s:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(10, 1, 0, 0)], labels=["x"])
    >>> replanner = cp.create_replanner_iosystem(plan, 0.1, goal_derivatives=0)
    >>> replanner.input_labels, replanner.output_labels
    (['x_goal'], ['x', 'x_d1', 'x_d2'])
    >>> t = np.linspace(0, 12, 121)
    >>> goal = cp.create_source_iosystem(cp.Step(1.5, 1.0, 4.0), labels="x", suffix="_goal", name="goal")
    >>> found = cp.simulate(ct.interconnect([goal, replanner], inputs=0, outputs=replanner.output_labels), t)
    >>> np.round(found.outputs[:, -1], 9).tolist()
    [1.5, 0.0, 0.0]
    """
    check_kind(plan, "plan", Trajectory)
    order = checked_count(order, "order")
    output_order = order if derivatives is None else checked_count(derivatives, "derivatives")
    for label, value in (("measured", measured), ("goal_derivatives", goal_derivatives)):
        if value is not None and checked_count(value, label) > order:
            raise ValueError(f"{label} must be at most order, {order}, got {value}")
    horizons = _Horizons(plan, checked_finite(dt, "dt", above=0.0), order, horizon, alpha, min_horizon)
    trigger_over = _checked_trigger(trigger, threshold, measured, goal_derivatives)
    limited = _checked_limits(plan, limits)
    axes = axis_signals(plan, labels, "")
    stop = None if stop_limits is None else StopStates.of(plan, stop_limits)
    planned = max(output_order, order, 0 if stop is None else 2)
    signals = _Signals(axes, planned, output_order, goal_derivatives, measured, stop is not None, suffix)
    core = _Correction(
        plan, horizons, checked_finite(offset, "offset", minimum=0.0), signals, trigger_over, limited, stop, name
    )
    source = create_source_iosystem(plan, signals.planned, labels=axes, suffix=signals.inside, name=f"{name}_plan")
    return ct.interconnect(
        [source, core], inputs=signals.outer or 0, outputs=signals.outputs, name=name, warn_duplicate=False
    )


class _Horizons:
    """Horizon and transition of a fit at a given time."""

    def __init__(
        self,
        plan: Trajectory,
        period: float,
        order: int,
        horizon: float | Literal["shrinking"],
        alpha: float | None,
        min_horizon: float | None,
    ) -> None:
        check_end(plan)
        self.shrinking = horizon == "shrinking"
        if isinstance(horizon, str) and not self.shrinking:
            raise ValueError(f'horizon must be a number of seconds or "shrinking", got {horizon!r}')
        if self.shrinking and not plan.duration:
            raise ValueError('horizon must be a number of seconds for a plan without duration, got "shrinking"')
        whole = plan.duration if self.shrinking else checked_finite(horizon, "horizon", above=0.0)
        if period > whole:
            what = "the plan's duration" if self.shrinking else "the horizon"
            raise ValueError(f"dt must be at most {what}, {whole:g} s, got {period:g} s")
        if alpha is None:
            own = plan.alpha if isinstance(plan, NewtonSpline) and self.shrinking else 0.0
            alpha = own if own < 2.0 * math.pi else 0.0
        self.whole = Transition(order, whole, alpha)
        self.period, self.order, self.rate = period, order, self.whole.rate
        # Maps from coefficients to jets one period later, from jets to coefficients with the goal reached at rest, and
        # from coefficients to those of such a fit one period later, if they are constant.
        self.step: Array | None = None
        self._home: Array | None = None
        self.again: Array | None = None
        self._start, self._end = plan.start, plan.end
        if self.shrinking:
            self._minimum = _minimum_horizon(min_horizon, period, whole)
            return
        if min_horizon is not None:
            raise ValueError(
                f'min_horizon must be given with horizon = "shrinking" only, got {min_horizon} with {whole:g} s'
            )
        self.step, unit = self.whole.evaluation(period, order), np.eye(order + 1)
        self._home = self.whole.coefficients(np.concatenate([unit, np.zeros_like(unit)]))
        self.again = self._home @ self.step
        radius = self.whole.radius(period)
        if not radius < 1.0:
            raise ValueError(
                "the map from fit to fit must have a spectral radius below 1, "
                f"got {radius:.4g} with dt = {period:g} s, horizon = {whole:g} s and alpha = {alpha:g}"
            )

    def too_short(self, t: float) -> bool:
        """Whether the remaining time of the plan is too short for a fit."""
        return self.shrinking and self._end - t < self._minimum * (1.0 - 1e-9)

    def end(self, t: float) -> float:
        """End time of a fit [s]."""
        return self._end if self.shrinking else t + self.whole.horizon

    def remaining(self, t: float) -> float | None:
        """Horizon [s] of a fit at a time not too close to the end of the plan; None before the plan."""
        if not self.shrinking:
            return self.whole.horizon
        return None if t < self._start else self._end - t

    def transition(self, horizon: float) -> Transition:
        """Transition of a fit over a horizon [s]."""
        return transition(self.order, horizon, self.rate * horizon) if self.shrinking else self.whole

    def home(self, horizon: float) -> Array | None:
        """Matrix from jets to coefficients of a fit that reaches the plan's goal; None if it would lose digits."""
        return homing_matrix(self.order, horizon, self.rate * horizon) if self.shrinking else self._home

    def coefficients(self, horizon: float, jets: list[float], naxes: int) -> Array:
        """Coefficients of a fit over a horizon [s], as `Transition.coefficients_of_row`."""
        matrix = transition_matrix(self.order, horizon, self.rate * horizon) if self.shrinking else None
        if matrix is None:
            return self.transition(horizon).coefficients_of_row(jets)
        return coefficients_by(matrix, jets, naxes)


class _TriggerOver(NamedTuple):
    """Condition of a fit, and the deviation above which it holds."""

    kind: Trigger
    threshold: float


class _Signals:
    """Names and indices of inputs and outputs."""

    def __init__(
        self,
        labels: tuple[str, ...],
        planned: int,
        output_order: int,
        goal: int | None,
        measured: int | None,
        stop: bool,
        suffix: str,
    ) -> None:
        goals = [] if goal is None else signal_names([f"{label}_goal" for label in labels], goal)
        seen = [] if measured is None else signal_names(list(labels), measured)
        self.planned, self.output_order, self.goal, self.measured = planned, output_order, goal, measured
        self.outer = [*goals, *seen, *(["stop"] if stop else [])]
        self.outputs = signal_names([label + suffix for label in labels], output_order)
        self.inside = "_planned"
        while {*self.outer, *self.outputs} & {*signal_names([label + self.inside for label in labels], planned)}:
            self.inside += "_"
        self.inner = signal_names([label + self.inside for label in labels], planned)
        both = [name for name in self.outputs if name in self.outer]
        if both:
            raise ValueError(
                f"suffix must make outputs differ from inputs, got {suffix!r} and {', '.join(both)} in both"
            )
        n = len(self.inner)
        self.goal_rows = slice(n, n + len(goals))
        self.seen_rows = slice(n + len(goals), n + len(goals) + len(seen))

    @property
    def feedthrough(self) -> NDArray[np.bool_]:
        """Direct feedthrough: from each entry of the plan to its output only."""
        found = np.zeros((len(self.outputs), len(self.inner) + len(self.outer)), dtype=bool)
        found[np.arange(len(self.outputs)), self.passed] = True
        return found

    @property
    def goals(self) -> list[slice]:
        """Inputs of each derivative of the goal."""
        rows, each = self.goal_rows, 0 if self.goal is None else self.goal + 1
        return [slice(rows.start + k, rows.stop, each) for k in range(each)]

    @property
    def measurements(self) -> list[tuple[int, int]]:
        """Index of each measured input and of the planned one: all axes of one derivative after another."""
        if self.measured is None:
            return []
        seen, planned = self.measured + 1, self.planned + 1
        naxes, first = len(self.inner) // planned, self.seen_rows.start
        return [(first + axis * seen + k, axis * planned + k) for k in range(seen) for axis in range(naxes)]

    @property
    def passed(self) -> list[int]:
        """Index of the planned input of each output."""
        each, naxes = self.planned + 1, len(self.inner) // (self.planned + 1)
        return [axis * each + k for axis in range(naxes) for k in range(self.output_order + 1)]


class _Correction(SampledBlock):
    """Jets of a plan plus those of the last fitted transition."""

    def __init__(
        self,
        plan: Trajectory,
        horizons: _Horizons,
        offset: float,
        signals: _Signals,
        trigger: _TriggerOver,
        limits: tuple[tuple[int, Array], ...],
        stop: StopStates | None,
        name: str,
    ) -> None:
        naxes, order, ngoals = plan.naxes, horizons.order, signals.goal_rows.stop - signals.goal_rows.start
        states = ["start", "end", "nan_input", "unreachable", "fits"]
        states += [f"goal[{k}]" for k in range(ngoals)]
        states += [f"coefficient[{k}]" for k in range(naxes * 2 * (order + 1))]
        fitted = slice(5 + ngoals, len(states))
        states += [] if stop is None else stop.labels
        super().__init__(
            self._no_rates,
            self._output,
            inputs=[*signals.inner, *signals.outer],
            outputs=signals.outputs,
            states=states,
            dt=0,
            name=f"{name}_correction",
        )
        declare(
            self,
            period=horizons.period,
            offset=offset,
            sample=self.sample,
            samples_first=True,  # the measurement may have direct feedthrough from the reference
            feedthrough=signals.feedthrough,
            watched={
                EventName(f"{name}: nan at the input"): (partial(state_signal, _NAN_INPUT), -math.inf, 0.5),
                EventName(f"{name}: goal out of reach"): (partial(state_signal, _UNREACHABLE), -math.inf, 0.5),
            },
        )
        self._plan, self._horizons, self._signals = plan, horizons, signals
        self._trigger, self._limits = trigger, limits
        self._bounds = self._bounds_of(horizons.whole) if limits else None
        self._positions = dict(limits).get(0)
        self._passed, self._naxes, self._order = signals.passed, naxes, order
        self._seen, self._period = signals.measurements, horizons.period
        self._again = horizons.again if signals.measured is None and not ngoals else None
        self._final = plan.final.tolist()
        self._goal, self._fitted, self._goals = slice(5, 5 + ngoals), fitted, signals.goals
        inputs = np.arange(len(signals.inner) + len(signals.outer))
        self._goal_inputs = np.concatenate([inputs[:0], *(inputs[rows] for rows in self._goals)])
        self._stop, self._stopped = stop, slice(fitted.stop, len(states))
        extrema = plan.extrema()
        self._range = float((extrema.maximum - extrema.minimum).max())
        self._scales = [horizons.whole.horizon**k for k in range(order + 1)]
        # The goal is the end of the plan, with the plan's derivatives if shrinking, otherwise with zero derivatives.
        self._arrival = [self._final, *[[0.0] * naxes] * order]
        if horizons.shrinking:
            arrival = _without_rounding(plan.jet(plan.end, order), np.array(self._scales)[:, None], self._range)
            self._arrival = arrival.tolist()
        self._arrival_row = [value for row in self._arrival for value in row]

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a fit; unchanged if none is due."""
        after, values = x.copy(), u.tolist()
        finite = math.isfinite(sum(values))
        after[_NAN_INPUT] = 0.0 if finite else 1.0
        state = x.tolist()
        stopped = self._is_stopped(state)
        if self._stop is not None and values[-1] > 0.5:
            if not stopped:
                after[self._stopped] = self._stop.begun(t, self._reference(t, state, u, 2))
            return after
        if not finite:
            return after
        goal = [values[rows] for rows in self._goals]
        due, late = stopped or self._is_due(t, state, values), self._horizons.too_short(t)
        after[_UNREACHABLE] = 0.0
        if late or not due:
            miss = self._distance(t, state, goal) if stopped else self._miss(t, state, goal) if goal else 0.0
            after[_UNREACHABLE] = 1.0 if late and miss > _MATTERS else 0.0
            due = due or miss > _ROUNDING
        horizon = self._horizons.remaining(t) if due and not late else None
        if horizon is None:
            return after
        if self._again is not None and not stopped and self._is_next(t, state):
            coefficients = self._again.dot(x[self._fitted].reshape(-1, self._naxes))
        else:
            coefficients = self._coefficients(horizon, self._deviation(t, x, state, u, values), goal)
        if self._limits and not self._within_limits(t, self._horizons.transition(horizon), coefficients, goal):
            after[_UNREACHABLE] = 1.0
            return after
        after[_START], after[_END], after[_UNREACHABLE] = t, self._horizons.end(t), 0.0
        after[_FITS] = state[_FITS] + 1.0
        if goal:
            after[self._goal] = u[self._goal_inputs]
        after[self._fitted] = coefficients.ravel()
        if stopped:
            after[self._stopped] = 0.0
        return after

    def _coefficients(self, horizon: float, begins: list[float], goal: list[list[float]]) -> Array:
        """Coefficients of the correction from a jet, in one list, to the change of the goal."""
        home = None if goal else self._horizons.home(horizon)
        if home is not None:
            return home.dot(np.array(begins).reshape(-1, self._naxes))
        changes = map(sub, itertools.chain.from_iterable(_extrapolated(goal, horizon)), self._arrival_row)
        row = [*begins, *changes]
        return self._horizons.coefficients(horizon, row + [0.0] * (2 * len(begins) - len(row)), self._naxes)

    def _is_stopped(self, x: list[float]) -> bool:
        """Whether the reference stops or has stopped."""
        return self._stop is not None and x[self._stopped.start] > 0.5

    def _distance(self, t: float, x: list[float], goal: list[list[float]]) -> float:
        """Distance of the stopped reference from the goal, relative to the move."""
        target = np.array(goal[0] if goal else self._final)
        position = self._stop_jets(t, x, 0)[0]
        return float(np.abs(target - position).max()) / max(self._range, float(np.abs(target).max())) or 0.0

    def _stop_jets(self, t: float, x: list[float], order: int) -> Array:
        """Jet (order + 1, naxes) of the stop."""
        return np.array([] if self._stop is None else self._stop.jets(t, x[self._stopped], order)).T

    def _reference(self, t: float, x: list[float], u: Array, order: int) -> Array:
        """Jet (order + 1, naxes) of the reference while it is not stopped."""
        planned = u[: len(self._signals.inner)].reshape(self._naxes, -1)[:, : order + 1].T
        return planned + np.array(self._corrections(t, x, order)).T

    def _is_due(self, t: float, x: list[float], values: list[float]) -> bool:
        """Whether a fit is due though the goal has not moved."""
        if self._trigger.kind == "deviation":
            own = self._corrections(t, x, 0)
            off = [values[i] - values[j] - value for (i, j), (value,) in zip(self._seen, own, strict=False)]
            return math.hypot(*off) > self._trigger.threshold
        # From the reference to the same goal over the remaining time the fit would be the same plan.
        return self._trigger.kind == "period" and (self._signals.measured is not None or not self._horizons.shrinking)

    def _miss(self, t: float, x: list[float], goal: list[list[float]]) -> float:
        """Distance of the goal from its extrapolation by the last fit or the plan, relative to the move."""
        if x[_FITS] > 0.5:
            begin, end, each = self._goal.start, self._goal.stop, self._naxes
            expected = _extrapolated([x[k : k + each] for k in range(begin, end, each)], t - x[_START])
        elif any(value for row in self._arrival[1 : len(goal)] for value in row):
            return math.inf  # after its end the plan has zero derivatives, which requires a fit
        else:
            expected = self._arrival
        size = max(self._range, *map(abs, goal[0]), *map(abs, expected[0]))
        far = max(
            [
                abs(a - b) * scale
                for row, own, scale in zip(goal, expected, self._scales, strict=False)
                for a, b in zip(row, own, strict=True)
            ]
        )
        return far / size if size else math.inf if far else 0.0

    def _deviation(self, t: float, x: Array, state: list[float], u: Array, values: list[float]) -> list[float]:
        """Jet at the start of a fit minus that of the plan: all axes of one derivative after another."""
        seen = [values[i] - values[j] for i, j in self._seen]
        if self._signals.measured == self._order:
            return seen
        if self._is_stopped(state):
            planned = u[: len(self._signals.inner)].reshape(self._naxes, -1)[:, : self._order + 1].T
            own = (self._stop_jets(t, state, self._order) - planned).ravel().tolist()
        elif self._horizons.step is not None and self._is_next(t, state):
            own = self._horizons.step.dot(x[self._fitted].reshape(-1, self._naxes)).ravel().tolist()
        else:
            own = [value for row in zip(*self._corrections(t, state, self._order), strict=True) for value in row]
        return seen + own[len(seen) :] if seen else own

    def _within_limits(self, t: float, found: Transition, coefficients: Array, goal: list[list[float]]) -> bool:
        """Whether the plan with a correction satisfies the limits until the end of both."""
        if self._is_bounded(found, coefficients, goal):
            return True
        met, targets = self._horizons.end(t), np.array(goal).reshape(-1, self._naxes)
        end = max(met, self._plan.end)
        edges = np.unique([t, met, end, *self._plan.breakpoints.tolist()])
        for left, right in itertools.pairwise(edges[edges >= t].tolist()):

            def jet(s: Array, order: int, left: float = left, right: float = right) -> Array:
                planned = self._plan.segment_jet_at(0.5 * (left + right), left, s, order)
                if right <= met:
                    return planned + found.jet(coefficients, s + (left - t), order)
                after_end = extrapolated(targets, left - t)
                after_end = np.concatenate([after_end, np.zeros((order + 1, self._naxes))])[: order + 1]
                after_end[0] -= self._plan.final if len(goal) else 0.0
                return planned + np.stack([extrapolated(after_end, value) for value in s.tolist()], axis=2)

            for nu, limit in self._limits:
                times = stationary_times(jet, right - left, nu)
                if (np.abs(jet(times, nu)[nu]).max(axis=1) > limit * (1.0 + 1e-9)).any():
                    return False
        return True

    def _is_bounded(self, found: Transition, coefficients: Array, goal: list[list[float]]) -> bool:
        """Whether bounds of the plan and of the correction satisfy the limits together."""
        bounds = self._bounds if found is self._horizons.whole else self._bounds_of(found)
        if bounds is None or any(value for row in goal[1:] for value in row):
            return False
        matrix, room = bounds
        if np.count_nonzero(np.abs(matrix.dot(coefficients)) > room):
            return False
        # After the end of the correction the plan is shifted to the goal.
        position = self._positions
        if position is None:
            return True
        shift = np.abs(np.array(goal[0]) - self._plan.final) if goal else 0.0
        return bool((shift + self._plan.peak(0) <= position).all())

    def _bounds_of(self, found: Transition) -> tuple[Array, Array] | None:
        """Matrix from coefficients to values that enclose limited derivatives, and bounds of these values."""
        matrices, rooms = [], []
        for nu, limit in self._limits:
            matrix = found.enclosure(nu)
            if matrix is None:
                return None
            matrices.append(matrix)
            # What the plan leaves of the limit, with half of the tolerance for rounding.
            rooms.append(np.tile(limit * (1.0 + 0.5e-9) - self._plan.peak(nu), (len(matrix), 1)))
        return np.concatenate(matrices), np.concatenate(rooms)

    def _output(self, t: Value, x: Value, u: Value, params: Params) -> Array:
        added = itertools.chain.from_iterable(self._corrections(t, x, self._signals.output_order))
        found = [u[row] + value for row, value in zip(self._passed, added, strict=True)]
        if self._stop is not None:
            stopped = x[self._stopped.start] > 0.5
            states = [x[k] for k in range(self._stopped.start, self._stopped.stop)]
            jets = itertools.chain.from_iterable(self._stop.jets(t, states, self._signals.output_order))
            found = [value * (1.0 - stopped) + held * stopped for value, held in zip(found, jets, strict=True)]
        return np.array(found)

    def _is_next(self, t: float, x: list[float]) -> bool:
        """Whether the last fit was one period before."""
        return abs(t - x[_START] - self._period) <= 1e-15 * abs(t)

    def _corrections(self, t: Value, x: Value, order: int) -> list[list[Value]]:
        """Jets of the correction axis by axis, numeric or symbolic."""
        live = t <= x[_END]
        now = (t if live else x[_END]) if isinstance(live, bool) else np.fmin(t, x[_END])
        columns, goals = (
            [[x[k] for k in range(rows.start + axis, rows.stop, self._naxes)] for axis in range(self._naxes)]
            for rows in (self._fitted, self._goal)
        )
        rows = series(self._horizons.rate, columns, now - x[_START], now - x[_END], order)
        changed = (x[_FITS] > 0.5) * (1.0 - live)
        found = []
        for row, goal, final in zip(rows, goals, self._final, strict=True):
            after_end = [row[0] * (1.0 - live) if not goal else changed * -final, *[0.0] * order]
            for k in range(min(order + 1, len(goal))):
                after_end[k] = after_end[k] + changed * taylor_value(goal[k:], t - x[_START])
            found.append([value * live * math.factorial(k) + after_end[k] for k, value in enumerate(row)])
        return found


def _extrapolated(rows: list[list[float]], time: float) -> list[list[float]]:
    """Derivatives, each by axis, of the Taylor polynomials after `time` seconds; as `extrapolated`."""
    if len(rows) == 1:
        return rows
    columns = [[taylor_value(column[k:], time) for k in range(len(rows))] for column in zip(*rows, strict=True)]
    return [list(row) for row in zip(*columns, strict=True)]


def _without_rounding(jet: Array, scale: Array, size: float) -> Array:
    """Jet with derivatives of the size of rounding errors replaced by 0."""
    small = np.abs(jet * scale) <= 1e-9 * max(size, float(np.abs(jet[0]).max()))
    small[0] = False
    return np.where(small, 0.0, jet)


def _minimum_horizon(given: float | None, period: float, whole: float) -> float:
    """Remaining time [s] below which no fit is made."""
    if given is None:
        return max(period, min(5.0 * period, 0.5 * whole))
    minimum = checked_finite(given, "min_horizon", above=0.0)
    if not period <= minimum <= whole:
        raise ValueError(
            f"min_horizon must lie between dt, {period:g} s, and the plan's duration, {whole:g} s, got {minimum:g} s"
        )
    return minimum


def _checked_trigger(trigger: Trigger, threshold: float | None, measured: int | None, goal: int | None) -> _TriggerOver:
    if trigger not in get_args(Trigger):
        raise ValueError(f"trigger must be one of {', '.join(get_args(Trigger))}, got {trigger!r}")
    if trigger == "goal" and goal is None:
        raise ValueError('goal_derivatives must be given for trigger = "goal", got None')
    if trigger != "deviation":
        if threshold is not None:
            raise ValueError(
                f'threshold must be given with trigger = "deviation" only, got {threshold} with {trigger!r}'
            )
        return _TriggerOver(trigger, 0.0)
    if measured is None:
        raise ValueError('measured must be given for trigger = "deviation", got None')
    if threshold is None:
        raise ValueError('threshold must be given for trigger = "deviation", got None')
    return _TriggerOver(trigger, checked_finite(threshold, "threshold", above=0.0))


def _checked_limits(plan: Trajectory, limits: Mapping[int, ArrayLike] | None) -> tuple[tuple[int, Array], ...]:
    """Limits by order, one for each axis, which the plan itself must satisfy."""
    if limits is not None:
        check_kind(limits, "limits", Mapping, "a mapping of orders to magnitudes")
    found = []
    for key, value in (limits or {}).items():
        nu = checked_count(key, "orders of limits")
        limit = real_array(value, f"limits[{nu}]")
        if limit.shape not in ((), (plan.naxes,)) or not (limit > 0.0).all():
            raise ValueError(f"limits[{nu}] must be above 0, one number or {plan.naxes}, got {value!r}")
        limit = np.broadcast_to(limit, (plan.naxes,))
        extrema = plan.extrema(nu)
        for axis, label in enumerate(plan.labels):
            low, high = float(extrema.minimum[axis]), float(extrema.maximum[axis])
            worst, time = (
                (high, float(extrema.time_max[axis])) if high >= -low else (low, float(extrema.time_min[axis]))
            )
            if abs(worst) > limit[axis] * (1.0 + 1e-9):
                raise ValueError(
                    f"plan must satisfy limits[{nu}] = {limit[axis]:g}, got {worst:.6g} of {label} at {time:.6g} s"
                )
        found.append((nu, limit))
    return tuple(found)
