"""Discrete systems, from sample to sample."""

from __future__ import annotations

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.budget import TimeLimitError, check
from ctrlplan.simulation.events import Snapshot, first_stop
from ctrlplan.simulation.interpreted import Interpreted
from ctrlplan.simulation.job import Job, Record
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.signals import breakpoints_of, signal_values

_MAX_STEPS = 1e8
"""Maximum number of steps of a discrete system in a run."""

_MAX_VALUES = 5e8
"""Maximum number of states and signals at all steps, which are stored: 4 GB."""

_TOGETHER = 128
"""Number of samples that are searched together for an event that ends the run."""

_OFF_INSTANT = 1e-5
"""Fraction of the sampling time by which a time may differ from a sample time, in addition to rounding."""


class Discrete:
    """Difference equations by Python.

    At each sample time first the outputs are evaluated, in the order of the signal
    flow, then the updates. Each function of a block is called once per sample, so
    that a block may have memory in addition to its states.
    """

    name = "python"

    def why_not(self, prepared: Prepared) -> str:
        """Reason why a system is not run from sample to sample; empty if it is discrete."""
        if prepared.network is None:
            return prepared.unsupported
        return "" if prepared.is_discrete else f"{prepared.name} is continuous"

    def run(self, job: Job) -> Record:
        """States at every sample of a job."""
        prepared, network = job.prepared, job.blocks
        instants = _sampling_instants(job.times, prepared.dt, job.state.size + network.nsignals)
        time_signals = prepared.time_signals(job.inputs, job.first)
        equations = Interpreted(network, job.params, (job.first, job.state), job.trials)
        near = 8.0 * np.finfo(float).eps * float(np.abs(instants).max())
        breakpoints = np.array(sorted(breakpoints_of(time_signals, instants[0] - near, instants[-1] + near)))
        values = signal_values(time_signals, _on_breakpoints(instants, breakpoints))
        states = np.empty((job.state.size, instants.size))
        signals = np.empty((network.nsignals, instants.size))
        states[:, 0] = job.state

        def snapshot(t: Array, x: Array) -> Snapshot:
            now = signal_values(time_signals, _on_breakpoints(t, breakpoints))
            w = signals[:, np.searchsorted(instants, t, side="right") - 1]
            return Snapshot(t, x, now[: prepared.ninputs], lambda: network.to_outputs(w), lambda: w)

        watched, count = job.watched(), 0  # times with known signals
        stops = any(entry.stop for entry in watched)

        def has_stopped(begin: int) -> bool:
            """Whether an event that ends the run has occurred at the last times, from an index on."""
            return first_stop(watched, snapshot(instants[begin:count], states[:, begin:count])) is not None

        try:
            for k, t in enumerate(instants.tolist()):
                check(t)
                signals[:, k] = equations.signals(t, states[:, k], values[:, k])
                count = k + 1
                following = equations.rates_of(t, states[:, k], signals[:, k])
                if stops and not count % _TOGETHER and has_stopped(count - _TOGETHER):
                    break
                if count < instants.size:
                    states[:, count] = following
        except TimeLimitError:
            raise
        except Exception:  # a block may be undefined after the event
            if not stops or not count or not has_stopped(count - 1 - (count - 1) % _TOGETHER):
                raise

        # Signals are constant between samples: a limit is crossed at the later one.
        return Record(
            instants[:count], states[:, :count], snapshot, lambda k, t: states[:, k], watched, self.name, job.reason
        )


def _sampling_instants(times: Array, dt: float | bool, width: int) -> Array:
    """Sample times of a discrete system from the first time to the last, which include the given times.

    `width` is the number of values that are stored at each of them.
    """
    rounding = 4.0 * np.finfo(float).eps * np.abs(times).max()
    if isinstance(dt, bool):
        spacing = np.diff(times)
        if np.ptp(spacing) > _OFF_INSTANT * spacing.mean() + rounding:
            raise ValueError(
                "timepts must be evenly spaced for a system with unspecified sampling time (dt = True), "
                f"got spacings from {spacing.min():g} to {spacing.max():g} s"
            )
        return times
    period = float(dt)
    if not rounding < 0.1 * period < np.inf:
        raise ValueError(
            f"timepts must resolve sample times {period:g} s apart, got times up to {np.abs(times).max():g} s"
        )
    steps = (times - times[0]) / period
    most = min(_MAX_STEPS, _MAX_VALUES / max(1, width))
    if steps[-1] > most:
        raise ValueError(
            f"timepts must span at most {most:.3g} periods of a discrete system, got {steps[-1]:.3g}, since {width} "
            "states and signals are stored at each; use a shorter run"
        )
    requested = np.round(steps)
    off = np.abs(steps - requested)
    if off.max() > _OFF_INSTANT + rounding / period:
        at = float(times[off.argmax()])
        raise ValueError(
            f"timepts must be whole periods of {period:g} s apart in a discrete system, got {at:g} s, "
            f"{off.max():.2g} periods off"
        )
    if np.any(np.diff(requested) < 1.0):
        raise ValueError(f"timepts must be at least a period of {period:g} s apart in a discrete system, got less")
    instants: Array = times[0] + period * np.arange(requested[-1] + 1.0)
    instants[requested.astype(int)] = times
    return instants


def _on_breakpoints(times: Array, breakpoints: Array) -> Array:
    """Times, replaced by a breakpoint that they equal up to rounding: 29 times 0.01 s is 0.29 s."""
    if not breakpoints.size:
        return times
    after = np.clip(np.searchsorted(breakpoints, times), 1, max(1, breakpoints.size - 1))
    before, following = breakpoints[after - 1], breakpoints[np.minimum(after, breakpoints.size - 1)]
    nearest = np.where(times - before < following - times, before, following)
    return np.where(np.abs(times - nearest) <= 4.0 * np.finfo(float).eps * np.abs(times).max(), nearest, times)
