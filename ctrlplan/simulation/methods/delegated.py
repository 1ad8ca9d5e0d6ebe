"""Systems that only python-control can run, by `control.input_output_response`."""

from __future__ import annotations

import threading
import warnings

import control as ct
import numpy as np

from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array
from ctrlplan.simulation.events import Snapshot
from ctrlplan.simulation.job import Job, Record
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.scales import RELATIVE
from ctrlplan.simulation.signals import signal_values

DELEGATED = threading.RLock()
"""Lock of runs by python-control, which stores the parameters of a run in the system."""


class Delegated:
    """Runs by `control.input_output_response`, without events, of blocks that override the equations of their class."""

    name = "python"

    def why_not(self, prepared: Prepared) -> str:
        """Reason why a system need not be run by python-control; empty if no other method applies."""
        return "" if prepared.network is None else f"{prepared.name} has no block that only python-control runs"

    def run(self, job: Job) -> Record:
        """States at the times of a job, within its tolerances."""
        prepared = job.prepared
        warnings.warn(
            f"{prepared.unsupported}: run by control.input_output_response, without events",
            UserWarning,
            stacklevel=outside_stacklevel(),
        )
        u = signal_values(job.inputs, job.times) if job.inputs else np.zeros((0, job.times.size))
        with DELEGATED:
            response = ct.input_output_response(
                prepared.system,
                job.times,
                u if job.inputs else 0,
                job.state,
                params=job.params or None,
                solve_ivp_method="LSODA",
                solve_ivp_kwargs={"rtol": job.rtol, "atol": RELATIVE if job.atol is None else job.atol},
            )
        outputs: Array = response.y.reshape(len(prepared.output_labels), job.times.size)

        def snapshot(t: Array, x: Array) -> Snapshot:
            at = np.searchsorted(job.times, t, side="right") - 1
            return Snapshot(t, x, u[:, at], lambda: outputs[:, at])

        return Record(
            job.times, response.x, snapshot, lambda k, t: response.x[:, k], (), self.name, prepared.unsupported
        )
