"""Interface of the file formats of exported plans."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_count, checked_finite, checked_timepts
from ctrlplan._types import Array
from ctrlplan.trajectories.files import signal_names, signal_rows
from ctrlplan.trajectories.repeated import Repeated
from ctrlplan.trajectories.trajectory import Trajectory, check_end

Files = Mapping[Path, str | bytes]


class FlatMaps(Protocol):
    """Protocol of flat systems for exports."""

    state_labels: list[str]
    input_labels: list[str]

    def states_and_inputs(self, plan: Trajectory, timepts: ArrayLike) -> tuple[Array, Array]:
        """States (nstates, ntime) and inputs (ninputs, ntime) along a plan."""


@dataclass(frozen=True)
class SampledTable:
    """Signals at common times.

    Attributes
    ----------
    times : ndarray, shape (ntime,)
        Times [s].
    names : tuple of str
        Names of the signals, without the time.
    rows : ndarray, shape (nsignals, ntime)
        Values of the signals.
    """

    times: Array
    names: tuple[str, ...]
    rows: Array

    @classmethod
    def of(cls, times: Array, signals: Mapping[str, tuple[Sequence[str], Array]]) -> SampledTable:
        """Table of groups of signals, each with names and rows.

        A name that an earlier group contains, or the name of the time, gets the
        name of its group as prefix: ``state.y`` for a state with the name of the
        output y.
        """
        names: list[str] = []
        for group, (own, _) in signals.items():
            taken = {"time", *names}
            names += [f"{group}.{name}" if name in taken else name for name in own]
        return cls(times, tuple(names), np.concatenate([rows for _, rows in signals.values()]))

    def __post_init__(self) -> None:
        names = ["time", *self.names]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"columns must have different names, got {name!r} twice; rename an axis")


@dataclass(frozen=True)
class Options:
    """Arguments of `Trajectory.export`.

    Attributes
    ----------
    dt : float or None
        Sampling period [s].
    timepts : array_like or None
        Sample times [s].
    derivatives : int
        Highest derivative.
    flat : FlatMaps or None
        Flat system whose states and inputs are exported as well.
    """

    dt: float | None = None
    timepts: ArrayLike | None = None
    derivatives: int = 2
    flat: FlatMaps | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "derivatives", checked_count(self.derivatives, "derivatives"))
        if self.dt is not None and self.timepts is not None:
            raise ValueError("dt and timepts must not be given together, got both")
        if self.dt is not None:
            object.__setattr__(self, "dt", checked_finite(self.dt, "dt", above=0.0))
        if self.flat is not None and not callable(getattr(self.flat, "states_and_inputs", None)):
            raise TypeError(
                "flat must be a flat system with a method states_and_inputs, as ctrlplan.flatness.FlatSystem, got "
                f"{type(self.flat).__name__}"
            )

    def given(self) -> tuple[str, ...]:
        """Names of the arguments that differ from their defaults."""
        return tuple(name for name, value in vars(Options()).items() if getattr(self, name) is not value)

    def times(self, start: float, end: float) -> Array:
        """Sample times of an interval; default: 1001 from start to end."""
        if self.timepts is not None:
            return sample_times(self.timepts)
        if math.isinf(end):
            raise ValueError(
                "timepts must be given to export a plan that repeats for all future times, got none; or export the "
                "part that repeats, its attribute `plan`"
            )
        if self.dt is None:
            return np.linspace(start, end, 1001)
        count = (end - start) / self.dt
        if count > _SAMPLES:
            raise ValueError(f"dt must give at most {_SAMPLES} samples, got {count:.4g} with dt = {self.dt:g} s")
        return start + self.dt * np.arange(math.ceil(count * (1.0 - 1e-12)) + 1, dtype=float)


_SAMPLES = 100_000_000


class Format(ABC):
    """A file format of plans.

    A new format must define `files`, and `accepted` if it has options; it is
    added to the table ``ENDINGS`` of endings.py.

    Attributes
    ----------
    accepted : tuple of str, class variable
        Options of the format.
    """

    accepted: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents of the files that a plan is written to.

        Parameters
        ----------
        plan : Trajectory
            Plan to be exported.
        path : Path
            Path of the file.
        options : Options
            Options, of which those not in `accepted` have their defaults.

        Raises
        ------
        ValueError
            If the format does not support this plan.
        """


class TableFormat(Format):
    """A file format of sampled signals of plans and responses; a new format must define `encoded`."""

    accepted = ("dt", "timepts", "derivatives", "flat")

    @abstractmethod
    def encoded(self, table: SampledTable) -> str | bytes:
        """Content of the file of a table."""

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        return {path: self.encoded(sampled(plan, options))}


def sampled(plan: Trajectory, options: Options) -> SampledTable:
    """Times, each axis with its derivatives, and states and inputs of a flat system."""
    times = options.times(plan.start, plan.end)
    axes = (signal_names(plan.labels, options.derivatives), signal_rows(plan, times, options.derivatives))
    if options.flat is None:
        return SampledTable(times, tuple(axes[0]), axes[1])
    states, inputs = options.flat.states_and_inputs(plan, times)
    flat = {"state": (options.flat.state_labels, states), "input": (options.flat.input_labels, inputs)}
    return SampledTable.of(times, {"axis": axes, **flat})


def sample_times(timepts: ArrayLike) -> Array:
    """Sample times (ntime,), checked; a sampling period is rejected."""
    times = checked_timepts(timepts)
    if times.ndim != 1:
        got = f"the scalar {times:g}" if times.ndim == 0 else f"shape {times.shape}"
        step = f"{times:g}" if times.ndim == 0 else "dt"
        raise ValueError(
            f"timepts must be sample times of shape (ntime,), got {got}; for one row every {step} s pass "
            f"np.arange(plan.start, plan.end, {step})"
        )
    return times


def with_duration(plan: Trajectory, ending: str) -> Trajectory:
    """The plan, checked to have a duration and an end."""
    check_end(plan, f"a plan written as {ending}")
    if not plan.duration:
        raise ValueError(f"a plan written as {ending} must have a duration, got a step")
    return plan


def one_period(plan: Trajectory, ending: str) -> Trajectory:
    """The plan, checked to have a duration; of one that repeats for all future times, one period."""
    if isinstance(plan, Repeated) and plan.count is None and plan.since == plan.start:
        return plan.plan
    return with_duration(plan, ending)


def decimal(value: float) -> str:
    """Number with a decimal point, as YAML and structured text require, exact to every bit."""
    if not math.isfinite(value):
        raise ValueError(f"numbers in the file must be finite, got {value}")
    mantissa, e, exponent = repr(float(value)).partition("e")
    return mantissa + ("" if "." in mantissa else ".0") + e + exponent


def decimals(values: Sequence[float] | Array) -> str:
    """Numbers between commas."""
    return ", ".join(map(decimal, values))


def plain(name: str) -> str:
    """Name that is valid in a comment of any language."""
    return re.sub(r"[^\w .-]", "_", name, flags=re.ASCII)
