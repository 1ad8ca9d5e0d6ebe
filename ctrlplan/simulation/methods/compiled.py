"""Continuous systems compiled by CasADi and solved by CVODES (SUNDIALS)."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ctrlplan._types import Array
from ctrlplan.simulation.built_forms import DisagreementError, expect_closer_states, expects_closer_states
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.interruptions import passing_interruptions
from ctrlplan.simulation.job import Job, Record, fresh_job
from ctrlplan.simulation.numerical import VISITED, Attempt, equations_of, numerical
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.segments import NetworkRun
from ctrlplan.symbolic import missing_casadi
from ctrlplan.symbolic.comparison import telling_states

if TYPE_CHECKING:
    from ctrlplan.simulation.compiled import CompiledSolver

_SHARE = 5
"""Evaluations of the equations in a run per state at which the compiled form is compared with Python."""

_CLOSE, _STRETCHES, _BETWEEN = 400, 8, 60
"""A run with fewer times is repeated in some intervals with this many times each, to find where it switches."""

_STEPS, _STEPS_WITH_STOPS = 20_000, 2_000
"""Maximum number of steps of a segment; fewer if an event may end the run, after which there may be no solution."""


class CompiledMethod:
    """CVODES with the exact Jacobian, on compiled equations that are compared with Python along the run."""

    name = "compiled"

    def why_not(self, prepared: Prepared) -> str:
        """Reason why a system cannot be compiled, if it is known before tracing its blocks."""
        if prepared.is_discrete:
            return f"{prepared.name} is discrete (dt = {prepared.dt})"
        return prepared.unsupported or missing_casadi()

    def run(self, job: Job) -> Record:
        """States at the times of a job, within its tolerances.

        Raises
        ------
        NotCompiledError
            If a block cannot be traced at these parameters, or disagrees with Python.
        """
        fresh = fresh_job(job)
        with passing_interruptions():
            try:
                return numerical(job, self, self)
            except DisagreementError:  # an object used by a function may have changed since it was traced
                return numerical(fresh, self, self)

    def solver(self, attempt: Attempt[CompiledSolver]) -> CompiledSolver:
        """CVODES on the compiled form."""
        job = attempt.job
        form = job.prepared.compiled(job.params, attempt.time_signals, job.first, job.state, job.trials)
        from ctrlplan.simulation.compiled import CompiledSolver  # the form exists, hence CasADi is installed

        known = equations_of(job, attempt.copies) if form.has_loops else None
        if known is not None:  # an algebraic loop without a solution gives a clearer error here
            known.signals(job.first, job.state, attempt.time_signals.at(job.times[:1])[:, 0])
        max_steps = _STEPS_WITH_STOPS if attempt.stops else _STEPS
        return CompiledSolver(form, job.params, attempt.tolerances, attempt.scales, max_steps=max_steps)

    def check(self, attempt: Attempt[CompiledSolver]) -> None:
        """Compare with Python, at states of the run."""
        solver, job = attempt.solver, attempt.job
        if solver.near_undefined(*attempt.visited):
            raise SolverError(
                f"the solver must reach {job.times[-1]:g} s, got to a state at which the equations are undefined"
            )
        wrong = _disagreement(attempt, solver) if attempt.copies.blocks else ""
        if wrong:
            raise job.prepared.discard(solver.form, wrong)

    def expects_closer_states(self, attempt: Attempt[CompiledSolver]) -> bool:
        """Whether a run of an equal loop was repeated with closer states, as one of another plan in a study."""
        return expects_closer_states(attempt.solver.form, attempt.job.rtol)

    def expect_closer_states(self, attempt: Attempt[CompiledSolver]) -> None:
        """Let later runs of equal loops begin with closer states."""
        expect_closer_states(attempt.solver.form, attempt.job.rtol)


def _disagreement(attempt: Attempt[CompiledSolver], solver: CompiledSolver) -> str:
    """Disagreement of a compiled form with Python at states of a run; empty if none, or if no comparison is due."""
    job, run, form = attempt.job, attempt.run, solver.form
    p = form.parameters(job.params)
    values = attempt.time_values(run.times) if form.nswitches else np.empty((0, run.times.size))
    if not form.compared.is_due(form.sides(run.times, run.states, values, p)):
        return ""
    count = max(1, solver.evaluations // _SHARE) if solver.evaluations else VISITED
    t, x = _closer(run, solver)
    values = attempt.time_signals.at(t)
    w, sides = form.signals(t, x, values, p), form.sides(t, x, values, p)
    places = telling_states(sides, np.concatenate([w, x]), count)
    # Each block is compared at the inputs that the form computes: if all agree, so does the whole.
    return form.disagreement(attempt.copies, job.params, t[places], x[:, places], w[:, places])


def _closer(run: NetworkRun, solver: CompiledSolver) -> tuple[Array, Array]:
    """Times and states of a run, with further ones in between if there are few."""
    times, states = [run.times], [run.states]
    marks = np.unique(np.linspace(0, run.times.size - 1, _STRETCHES + 1).astype(int))
    for k, following in pairwise(marks.tolist() if run.times.size < _CLOSE else []):
        left, right = float(run.times[k]), float(run.times[following])
        series = run.series(left)
        right = min(right, series.right)
        grid = np.linspace(left, right, _BETWEEN + 1)[1:]
        with suppress(SolverError):
            found = solver.advance(series, left, grid, run.states[:, k])
            times.append(grid)
            states.append(found)
    t, x = np.concatenate(times), np.concatenate(states, axis=1)
    order = np.argsort(t, kind="stable")
    return t[order], x[:, order]
