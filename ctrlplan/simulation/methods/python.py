"""Continuous systems by Python: LSODA with the functions of the blocks."""

from __future__ import annotations

from ctrlplan.simulation.interpreted import InterpretedSolver, SolverError
from ctrlplan.simulation.job import Job, Record
from ctrlplan.simulation.numerical import Attempt, NumericalSolver, equations_of, numerical
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.signals import signal_values
from ctrlplan.simulation.stalled import unrepeatable
from ctrlplan.symbolic.isolation import same_answer, tried, untouched


class Python:
    """LSODA from segment to segment; each block is called once per step, in the order of the signal flow."""

    name = "python"

    def why_not(self, prepared: Prepared) -> str:
        """Reason why a system cannot be run by LSODA; empty if it can."""
        if prepared.network is None:
            return prepared.unsupported
        if prepared.is_discrete:
            return f"{prepared.name} is discrete (dt = {prepared.dt})"
        return "" if prepared.has_blocks else f"{prepared.name} came from another process without its blocks"

    def run(self, job: Job) -> Record:
        """States at the times of a job, within its tolerances."""
        return numerical(job, self)

    def solver(self, attempt: Attempt[NumericalSolver]) -> NumericalSolver:
        """LSODA with the equations of the network."""
        if attempt.equations is None:
            raise TypeError(self.why_not(attempt.job.prepared))
        _check_repeatable(attempt)
        return InterpretedSolver(attempt.equations, attempt.tolerances, attempt.scales)

    def check(self, attempt: Attempt[NumericalSolver]) -> None:
        """Nothing to check: the equations are not compiled."""


def _check_repeatable(attempt: Attempt[NumericalSolver]) -> None:
    """Raise if state derivatives are random: such a loop has no solution."""
    job = attempt.job
    tests, values = equations_of(job, attempt.copies), signal_values(attempt.time_signals, job.times[:1])[:, 0]
    if tests is None:
        return
    with untouched():
        first, second = (tried(lambda: tests.rates(job.first, job.state, values), None) for _ in range(2))
        if same_answer(first, second):
            return
        w = tried(lambda: tests.signals(job.first, job.state, values), None)
    found = unrepeatable(attempt.copies, job.params, job.first, job.state, w) if w is not None else ""
    if found:
        raise SolverError(f"the solver must reach {job.times[-1]:g} s, got to {job.first:g} s: {found}")
