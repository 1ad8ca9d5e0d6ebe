"""Parts of the outputs of a run that discrete blocks hold from one of known times to the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.simulation.sampled_form import DelayedForm, SampledForm
from ctrlplan.simulation.sampled_motion import LateSignal
from ctrlplan.simulation.signals import TimeSignal


class HeldOutputs(NamedTuple):
    """Held parts of outputs: right-continuous, constant from each time to the next.

    Attributes
    ----------
    times : ndarray, shape (n,)
        Strictly increasing times [s]; the first is the start of the run.
    rows : ndarray of int, shape (nrows,)
        Outputs that have a held part.
    values : ndarray, shape (nrows, n)
        The held parts.
    """

    times: Array
    rows: NDArray[np.intp]
    values: Array

    def on(self, times: Array, tolerance: float) -> HeldOutputs:
        """The same with times that are sample times but for rounding replaced by these."""
        near = times.take(np.searchsorted(times, self.times - tolerance), mode="clip")
        return self._replace(times=np.where(np.abs(near - self.times) <= tolerance, near, self.times))


def of_sampled(
    form: SampledForm,
    signals: Sequence[TimeSignal],
    instants: Array,
    last: float,
    tolerance: float,
    states: Callable[[Array], Array],
) -> HeldOutputs | None:
    """Held outputs of a linear loop with discrete blocks; None if there are none.

    Parameters
    ----------
    form : SampledForm
        The loop.
    signals : sequence of TimeSignal
        Functions of time, in the order of the form.
    instants : ndarray
        Start of the run and sample times of the discrete blocks [s].
    last : float
        End of the run [s].
    tolerance : float
        Difference of times that counts as rounding [s].
    states : callable
        Maps times (n,) to states (nz, n) after the samples of these times.
    """
    marks, values = [instants], list[Callable[[Array], Array]]()
    begin = 0
    for signal in signals:
        own = form.d[:, begin : begin + signal.width]
        begin += signal.width
        if isinstance(signal, LateSignal) and signal.is_constant and own.any():
            marks.append(signal.breakpoints_between(float(instants[0]), last + tolerance))
            values.append(lambda t, signal=signal, own=own: own @ signal.at(t))  # type: ignore[misc]
    held = _without(form.c, form.moving)
    return _held(marks, tolerance, [lambda t: held @ states(t), *values] if held.any() or values else [])


def of_delayed(
    form: DelayedForm, instants: Array, last: float, tolerance: float, motion: Callable[[Array], tuple[Array, Array]]
) -> HeldOutputs | None:
    """The same of a loop with delays between continuous blocks.

    `motion` maps times to states and functions of time.
    """
    base, delayed = form.base, form.delayed
    held, constant = _without(base.c, base.moving), list[int]()
    marks, changed = {-1: instants}, True
    while changed:
        changed = False
        for k, late in enumerate(form.lates):
            feeding = [j for j, other in enumerate(form.lates) if late.from_w[:, other.columns].any()]
            others = np.setdiff1d(np.flatnonzero(late.from_w.any(axis=0)), delayed)
            if k in marks or late.from_z[:, base.moving].any() or others.size or not set(feeding) <= set(marks):
                continue
            every = np.concatenate([marks[j] for j in (-1, *feeding)]) + late.delay
            marks[k], changed = every[every <= last + tolerance], True
            constant += range(late.columns.start, late.columns.stop)
    direct = base.d.copy()
    direct[:, np.setdiff1d(np.arange(direct.shape[1]), constant)] = 0.0

    def values(t: Array) -> Array:
        z, w = motion(t)
        return np.asarray(held @ z + direct @ w)

    return _held(list(marks.values()), tolerance, [values] if held.any() or direct.any() else [])


def _held(marks: Sequence[Array], tolerance: float, parts: Sequence[Callable[[Array], Array]]) -> HeldOutputs | None:
    """Held outputs from their values after each of some times, one for those that differ by rounding."""
    if not parts:
        return None
    times = np.unique(np.concatenate(marks))
    times = times[np.append(True, np.diff(times) > tolerance)]
    values = np.sum([part(times) for part in parts], axis=0)
    rows = np.flatnonzero(np.any(values != 0.0, axis=1))
    return HeldOutputs(times, rows, values[rows]) if rows.size else None


def _without(matrix: Array, columns: NDArray[np.intp]) -> Array:
    """Matrix with some columns replaced by 0."""
    found = matrix.copy()
    found[:, columns] = 0.0
    return found
