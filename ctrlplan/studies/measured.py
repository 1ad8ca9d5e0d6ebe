"""Measured runs in a comparison: alignment with the plan, resampling, metrics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import control as ct
import numpy as np

from ctrlplan._checks import checked_finite
from ctrlplan._display import time_text
from ctrlplan._types import Array
from ctrlplan.simulation import SimulationResponse, measured_response
from ctrlplan.studies.alignment import Known, Offset, OfPlan, OfSamples, Pair, find_offset
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measures import (
    MEASURES,
    Run,
    checked_names,
    move_end,
    run_metrics,
    signals_of,
    wanted_measures,
)

if TYPE_CHECKING:  # comparisons are extended by measured runs
    from ctrlplan.studies.comparison import Comparison

Align: TypeAlias = Literal["auto"] | str | float | None
"""How a log is aligned with its plan."""

_SUFFIXES = ("_ref", "_cmd", "_set", "_d", "_des")
_UNLIKE = 0.2
"""Difference of a command from the plan, relative to its range, from which it is not that of the plan."""

_OF_MOVE = ("settling_time", "tracking_settling_time", "overshoot_error", "overshoot_final", "lag_error")
"""Metrics that are not known without the whole move; others are over the time of the log."""

_STEP = 1.001
"""Time from the end of a log to that of the move, in steps of the log, up to which the log has the whole move."""

AlignedBy = Literal["command", "output", "control", "given"]
"""By what the time of a log was aligned."""

_COMMANDS = ("r", "r_cmd", "ref", "reference", "cmd", "command", "setpoint")
"""Names of a command in a log: a label with a suffix, or for one axis one of these."""


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """A log in a comparison, and how it was aligned.

    Attributes
    ----------
    plan : str
        Plan that the machine followed.
    log : TimeResponseData
        Log as given, in its own time.
    offset : float
        Time of the log minus time of the plan [s].
    standard_error : float
        Standard error of the offset [s]; nan if it was given.
    signals : tuple of str
        Signals of the log by which the offset was found; empty if it was given.
    by : {"command", "output", "control", "given"}
        What these signals are.
    compared : str
        What they were compared with: "the plan" or "the simulated one".
    residual : float
        Root mean square of the differences that remain after alignment, relative
        to the range of the signals; 0 if the offset was given.
    resampling : str
        How the log was resampled, in a sentence.
    left_out : tuple of str
        Outputs and controls of the comparison that the log does not contain.
    failures : dict of str to str
        Reasons of measures of runs that could not be evaluated.
    lacking : float
        Time [s] from the end of the log to the end of the move, 0 if the log has
        all of it. Metrics of the whole move are otherwise nan.
    """

    plan: str
    log: ct.TimeResponseData
    offset: float
    standard_error: float
    signals: tuple[str, ...]
    by: AlignedBy
    compared: str
    residual: float
    resampling: str
    left_out: tuple[str, ...] = ()
    failures: dict[str, str] = field(default_factory=dict)
    lacking: float = 0.0

    @property
    def aligned(self) -> SimulationResponse:
        """The log with its own samples in the time of the plan."""
        signals = signals_of(self.log)
        t = np.asarray(self.log.time) - self.offset
        reason = f"{t.size} samples, {self.offset:.6g} s earlier than logged"
        return measured_response(t, np.array([*signals.values()]), list(signals), reason, f"Measured with {self.plan}")

    def sentences(self) -> Iterator[str]:
        """What a reader of the metrics must know."""
        yield self.resampling
        if self.lacking:
            yield f"the log ends {self.lacking:.4g} s before the move: settling times, overshoot and lag are not known"
        if self.by == "given":
            yield f"its time is {abs(self.offset):.6g} s {self._order} than that of the plan, as given"
        else:
            error = max(1e3 * self.standard_error, 1e-4)
            digits = max(1 - math.floor(math.log10(error)), 0)
            size = f"{1e3 * abs(self.offset):.{digits}f} ± {error:.2g} ms (standard error)"
            rms = max(100.0 * self.residual, 1e-3)
            yield (
                f"its time is {size} {self._order} than that of the plan, found from the {self.by} "
                f"{', '.join(self.signals)} compared with {self.compared} (the rms of the difference is then {rms:.2g} "
                "% of the range)"
            )
        if self.by in ("output", "control"):
            yield f"offset and plant delay cannot be told apart by the {self.by}; log the command to separate them"
        if self.left_out:
            yield f"not in the log: {', '.join(self.left_out)}"
        if self.failures:
            reasons = (f"{name} ({reason})" for name, reason in self.failures.items())
            yield f"not evaluated: {', '.join(reasons)}"
        yield "measured runs are not ranked"

    @property
    def _order(self) -> str:
        return "later" if self.offset >= 0.0 else "earlier"


def with_measured(comparison: Comparison, logs: Mapping[str, ct.TimeResponseData], align: Align = "auto") -> Comparison:
    """Comparison with measured runs; see `Comparison.with_measured`."""
    if not isinstance(logs, Mapping):
        raise TypeError(f"logs must be a mapping of plans to logs, got {type(logs).__name__}")
    if not logs:
        raise ValueError("logs must have at least one log, got none")
    checked_names(logs, comparison.simulated, "logs")
    for plan, log in logs.items():
        comparison = _Alongside(comparison, plan, _checked_log(log, plan)).added(align)
    return comparison


def _checked_log(log: object, plan: str) -> ct.TimeResponseData:
    if not isinstance(log, ct.TimeResponseData):
        raise TypeError(
            f"logs[{plan!r}] must be a response, as read_log returns it, got {type(log).__name__}; read files by "
            "ctrlplan.read_log"
        )
    t, rows = np.asarray(log.time), np.asarray(log.outputs)
    if t.ndim != 1 or t.size < 2 or not np.all(np.diff(t) > 0.0) or not np.isfinite(t).all():
        raise ValueError(f"times of logs[{plan!r}] must be two or more, finite and increasing")
    if not np.isfinite(rows).all():
        raise ValueError(f"signals of logs[{plan!r}] must be finite, got nan or inf; read them by ctrlplan.read_log")
    return log


class _Alongside:
    """A log alongside the simulated run of its plan."""

    def __init__(self, comparison: Comparison, plan: str, log: ct.TimeResponseData) -> None:
        self.comparison, self.plan, self.log = comparison, plan, log
        self.t = np.asarray(log.time)
        self.signals = signals_of(log)
        self.reference = comparison.plans[plan]
        self.simulated = comparison.responses[plan]
        wanted = (*comparison.outputs, *comparison.controls)
        self.left_out = tuple(name for name in wanted if name not in self.signals)
        if len(self.left_out) == len(wanted):
            raise ValueError(
                f"logs[{plan!r}] must have one of the signals {', '.join(wanted)}, got {', '.join(self.signals)}; "
                'name its columns by read_log(..., signals={"'
                f"{wanted[0]}"
                '": ...})'
            )

    def added(self, align: Align) -> Comparison:
        """Comparison with this run."""
        offset, by, names, compared = self._offset(align)
        t, where = self._times(offset.seconds)
        where += f"; {offset.others} other offsets fit as well" if offset.others else ""
        rows = [np.interp(t, self.t - offset.seconds, row) for row in self.signals.values()]
        response = measured_response(t, np.array(rows), list(self.signals), where, f"Measured with {self.plan}")
        lacking = self._lacking(offset.seconds)
        metrics, failures = self._metrics(response, lacking)
        run = MeasuredRun(
            self.plan,
            self.log,
            offset.seconds,
            offset.standard_error,
            names,
            by,
            compared,
            offset.residual,
            where,
            self.left_out,
            failures,
            lacking,
        )
        old, name = self.comparison, self._name()
        limits = {k: pair for k, pair in old.limits.get(self.plan, {}).items() if k in self.signals}
        return replace(
            old,
            plans=old.plans | {name: self.reference},
            responses=old.responses | {name: response},
            metrics=old.metrics | {name: metrics},
            marks=old.marks | {name: "; ".join(run.sentences())},
            limits=old.limits | {name: limits},
            roles=old.roles | ({name: old.roles[self.plan]} if self.plan in old.roles else {}),
            measured=old.measured | {name: run},
        )

    def _name(self) -> str:
        """Name of the run, with a number from the second log of a plan on."""
        name, count = f"{self.plan} (measured)", 1
        while name in self.comparison.plans:
            count += 1
            name = f"{self.plan} (measured {count})"
        return name

    # Alignment

    def _offset(self, align: Align) -> tuple[Offset, AlignedBy, tuple[str, ...], str]:
        """Offset, by what it was found, the signals, and what they were compared with."""
        if align is None:
            return Offset(0.0, math.nan, 0.0), "given", (), ""
        if not isinstance(align, str):
            return Offset(checked_finite(align, "align"), math.nan, 0.0), "given", (), ""
        if align != "auto" and align not in self.signals:
            raise ValueError(f'align must be "auto" or among {", ".join(self.signals)}, got {align!r}')
        by, choices = self._choices(align)
        found = [(find_offset(self.t, list(pairs.values())), pairs) for pairs in choices]
        offset, pairs = min(found, key=lambda one: one[0].residual)
        names = tuple(pairs)
        if not math.isfinite(offset.residual):
            raise ValueError(
                f"logs[{self.plan!r}] must contain the move of the plan for its offset to be found, but "
                f"{', '.join(names)} is constant or does not follow it; give align= in seconds, or None"
            )
        if by == "command" and offset.residual > _UNLIKE:
            raise ValueError(
                f"command {', '.join(names)} of logs[{self.plan!r}] must follow the plan, got an rms difference of "
                f"{100.0 * offset.residual:.2g} % of its range; give its units= to read_log, the name of another "
                "signal by align=, or the offset in seconds"
            )
        simulated = any(isinstance(pair.known, OfSamples) for pair in pairs.values())
        return offset, by, names, "the simulated one" if simulated else "the plan"

    def _choices(self, align: str) -> tuple[AlignedBy, list[dict[str, Pair]]]:
        """By what the log is aligned, and alternative sets of logged signals with the known ones."""
        commands = self._commands(None if align == "auto" else align)
        if commands:
            return "command", [{name: self._pair(name, known) for name, known in commands.items()}]
        old = self.comparison
        names = [align]
        if align == "auto":
            names = [name for name in old.outputs if name in self.signals]
            names = names or [name for name in old.controls if name in self.signals]
        lacking = [name for name in names if name not in self._simulated]
        if lacking:
            raise ValueError(
                f"align must name a signal of the simulated run ({', '.join(self._simulated)}) or a command of the "
                f"plan, got {lacking[0]!r}; name a command by the label of its axis with _ref or _cmd"
            )
        choices = [{name: self._pair(name, self._simulated[name]) for name in names}]
        if all(name in old.outputs for name in names):  # a machine may track better than the model
            axes = {name: OfPlan(self.reference, old.outputs.index(name)) for name in names}
            choices.append({name: self._pair(name, known) for name, known in axes.items()})
            return "output", choices
        return "control", choices

    def _commands(self, only: str | None) -> dict[str, Known]:
        """Logged commands with the axis of the plan, or the simulated signal, that they equal."""
        old, labels = self.comparison, self.reference.labels
        inputs = list(self.simulated.input_labels or ())
        found: dict[str, Known] = {}
        for axis, (label, output) in enumerate(zip(labels, old.outputs, strict=True)):
            names = [inputs[axis]] if len(inputs) == len(labels) else []
            names += [own + suffix for own in (label, output) for suffix in _SUFFIXES]
            names += [label, *(_COMMANDS if len(labels) == 1 else ())]
            if only is not None:
                alone = len(labels) == 1 and only not in self._simulated
                names = [only] if alone or only in names else []
            taken = (*old.outputs, *old.controls)
            name = next((name for name in names if name in self.signals and name not in taken), None)
            if name is not None:
                known = self._simulated.get(name)
                found[name] = OfPlan(self.reference, axis) if known is None or self._follows(name, axis) else known
        return found

    def _follows(self, name: str, axis: int) -> bool:
        """Whether a simulated signal is the plan itself."""
        t, row = np.asarray(self.simulated.time), signals_of(self.simulated)[name]
        return bool(np.allclose(row, self.reference.jet(t, 0)[0, axis], rtol=0.0, atol=1e-9 * (np.ptp(row) or 1.0)))

    @property
    def _simulated(self) -> dict[str, Known]:
        """Signals of the simulated run that are finite throughout."""
        t, rows = np.asarray(self.simulated.time), signals_of(self.simulated)
        return {name: OfSamples(t, row) for name, row in rows.items() if np.isfinite(row).all()}

    def _pair(self, name: str, known: Known) -> Pair:
        values = self.signals[name]
        return Pair(values, known, float(np.ptp(values)) or 1.0)

    # Resampling and metrics

    def _times(self, offset: float) -> tuple[Array, str]:
        """Times of the log and of the simulated run where both are known, and how they were chosen."""
        logged, simulated = self.t - offset, np.asarray(self.simulated.time)
        experiment = self.comparison.experiment
        given = simulated if experiment is None else experiment.timepts
        first, last = max(logged[0], given[0]), min(logged[-1], given[-1])
        own = logged[(logged >= first) & (logged <= last)]
        common = given[(given >= first) & (given <= last)]
        if not last > first or own.size < 2:
            raise ValueError(
                f"logs[{self.plan!r}] must overlap the simulated time, {given[0]:.6g} to {given[-1]:.6g} s, got "
                f"{logged[0]:.6g} to {logged[-1]:.6g} s with an offset of {offset:.6g} s; give align= in seconds, or "
                'align="auto" to find it'
            )
        step = float(np.median(np.diff(self.t)))
        near = np.searchsorted(common, own)
        apart = np.full(own.size, np.inf)
        for k in (near - 1, near):  # samples that differ from a common time by rounding
            inside = (k >= 0) & (k < common.size)
            apart[inside] = np.minimum(apart[inside], np.abs(own - np.take(common, k, mode="clip"))[inside])
        where = (
            f"resampled: {own.size} of {self.t.size} samples, every {1e3 * step:.4g} ms, and linear interpolation at "
            f"the {common.size} times of the simulation from {time_text(first)} to {time_text(last)} s"
        )
        if first > given[0] + step or last < given[-1] - step:
            where += f"; metrics cover this time only, of {time_text(given[0])} to {time_text(given[-1])} s"
        return np.union1d(common, own[apart > 1e-6 * step]), where

    def _lacking(self, offset: float) -> float:
        """Time [s] from the last sample of the log to the end of the move, 0 up to a step of the log."""
        rest = move_end(self.reference, self.comparison.waypoints) - (float(self.t[-1]) - offset)
        return rest if float(np.median(np.diff(self.t))) * _STEP < rest < math.inf else 0.0

    def _metrics(self, response: SimulationResponse, lacking: float) -> tuple[dict[str, float], dict[str, str]]:
        """Metrics whose signals the log contains, and reasons of those that could not be evaluated."""
        old = self.comparison
        held = {name: name in self.signals for name in (*old.outputs, *old.controls)}
        run = Run(
            self.reference,
            None,
            response,
            tuple(name for name in old.outputs if held[name]),
            tuple(name for name in old.controls if held[name]),
            move_end(self.reference, old.waypoints),
        )
        experiment = old.experiment or Experiment(
            {self.plan: self.reference}, np.asarray(self.simulated.time), waypoints=old.waypoints
        )
        found: dict[str, float] = {}
        failures: dict[str, str] = {}
        for name, measure in wanted_measures(experiment.measures).items():
            if measure.of == "run":
                try:
                    found |= run_metrics(run, {name: measure})
                except Exception as error:  # of a function for which the log lacks a signal
                    failures[name] = f"{type(error).__name__}: {error}"
        axes = tuple(label for label, name in zip(self.reference.labels, old.outputs, strict=True) if held[name])
        found |= experiment.metrics_of_signals(run, axes, old.controls)
        for name in set(MEASURES) - set(old.measures):
            if name in found:  # over signals in different units
                found[name] = math.nan
        if lacking:
            unknown = (key for name in _OF_MOVE for key in (name, *(f"{name}_{label}" for label in axes)))
            found |= {key: math.nan for key in unknown if key in found}
        return found, failures
