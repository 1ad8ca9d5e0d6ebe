"""Sample times of a loop with discrete blocks and the steps between them, equal for all functions of time."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.delay_lines import DelayLine, Steps
from ctrlplan.simulation.flow_kernel import FlowKernel
from ctrlplan.simulation.instants import Instants, instants_of
from ctrlplan.simulation.sampled_form import Line, SampledForm
from ctrlplan.simulation.segments import SAMPLES

_KEPT, _ENTRIES = 2**16, 2**19
"""Maximum numbers of instants and of entries of matrices that are kept for further runs."""


class Schedule:
    """Steps of a loop from instant to instant.

    Parameters
    ----------
    form : SampledForm
        The loop.
    instants : Instants
        Sample times of the discrete blocks, and further times at which nothing is due.

    Attributes
    ----------
    held : ndarray of int
        Places among z of what is constant between instants and acts on the flow.
    jumps : list of (ndarray, ndarray)
        J and K of the different instants.
    due : ndarray of int, shape (ninstants,)
        Which of them applies at each instant.
    """

    def __init__(self, form: SampledForm, instants: Instants) -> None:
        self._form, self.instants = form, instants
        self.held = np.setdiff1d(np.flatnonzero(form.a.any(axis=0)), form.moving)
        masks, self.due = np.unique(instants.due, return_inverse=True)
        self.jumps = [form.jump(int(mask)) for mask in masks]
        self._steps: Steps | None = None
        self._growth: float | None = None

    @cached_property
    def places(self) -> list[NDArray[np.intp]]:
        """Instants of each jump."""
        return [np.flatnonzero(self.due == k) for k in range(len(self.jumps))]

    @cached_property
    def read(self) -> NDArray[np.intp]:
        """Functions of time that the jumps read."""
        nw = self._form.signals_w.shape[1]
        return np.flatnonzero(np.any([given[:, :nw].any(axis=0) for _, given in self.jumps], axis=0))

    @cached_property
    def lines(self) -> list[tuple[Line, NDArray[np.intp]]]:
        """Registers of many samples, and the instants at which they are sampled."""
        form, due = self._form, self.instants.due
        return [(line, np.flatnonzero(due >> form.timings.index(line.timing) & 1)) for line in form.lines]

    def steps(self) -> Steps:
        """Steps from z at an instant to z at the next, without functions of time."""
        found = self._steps or self._new_steps()
        if found.matrices.size <= _ENTRIES:
            self._steps = found
        return found

    def growth(self, steps: Steps) -> float:
        """Growth of a perturbation of the states over these steps, about."""
        if self._growth is None:
            self._growth = steps.growth()
        return self._growth

    def _new_steps(self) -> Steps:
        form, moving = self._form, self._form.moving
        kernel = FlowKernel(form.a[:, moving], form.a[:, self.held], np.zeros((moving.size, 0)), 0)
        size, nlengths = form.signals_z.shape[1], self.instants.lengths.size
        flows = np.zeros((nlengths, moving.size, size))
        flows[:, :, np.concatenate([moving, self.held])] = kernel.over(self.instants.lengths)
        pairs, kinds = np.unique(self.due[1:] * nlengths + self.instants.which, return_inverse=True)
        ends = np.searchsorted(pairs, nlengths * np.arange(len(self.jumps) + 1)).tolist()
        matrices = np.empty((pairs.size, size, size))
        for k, (jump, _) in enumerate(self.jumps):
            own = matrices[ends[k] : ends[k + 1]]
            np.matmul(jump[:, moving], flows[pairs[ends[k] : ends[k + 1]] - k * nlengths], out=own)
            own += jump
        lines = (
            DelayLine(
                line.count,
                places,
                line.initial,
                line.from_z,
                np.array([given[:, line.columns] for _, given in self.jumps]),
                self.due[places],
            )
            for line, places in self.lines
        )
        return Steps(matrices, kinds, tuple(lines))


def schedule_of(form: SampledForm, first: float, last: float, tolerance: float) -> Schedule:
    """Schedule of a run between two times [s], kept with the form.

    Raises
    ------
    NotApplicableError
        If there are too many sample times.
    """
    count = sum((last - first) / float(period) for period, _ in form.timings)
    if count > SAMPLES:
        raise NotApplicableError(f"{form.name} has {count:.3g} sample times, more than {SAMPLES:.0e}")

    def new() -> Schedule:
        return Schedule(form, instants_of(form.timings, first, last, tolerance))

    return form.schedules.get((first, last), new) if count <= _KEPT else new()
