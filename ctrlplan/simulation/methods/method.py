"""Interface of a simulation method, and the choice of a method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.job import Job, Record, fresh_job
from ctrlplan.simulation.prepared import Prepared


class Method(Protocol):
    """Method of simulation.

    A new method is a class with these three members and a line in
    ``ctrlplan.simulation.methods.METHODS``; for type checkers its name is added to
    ``MethodName``. A method that solves differential equations can use
    `ctrlplan.simulation.numerical.numerical` for segments, scales, delays, samples
    and events, and define only the solver.
    """

    @property
    def name(self) -> str:
        """Name of the method in `simulate` and in responses; several methods may share one."""

    def why_not(self, prepared: Prepared) -> str:
        """Reason why the method does not apply to a system; empty if it applies."""

    def run(self, job: Job) -> Record:
        """States at the times of a job, up to an event that ends the run.

        Raises
        ------
        NotApplicableError
            If the method does not apply, which is known only during the run.
        SolverError
            If the method fails.
        """


def named(methods: Sequence[Method], name: str) -> list[Method]:
    """Methods with a given name; all for "auto".

    Raises
    ------
    ValueError
        If there is no such method.
    """
    found = [method for method in methods if name in ("auto", method.name)]
    if not found:
        known = ", ".join(dict.fromkeys(method.name for method in methods))
        raise ValueError(f"method must be one of auto, {known}, got {name!r}")
    return found


def applicable(methods: Sequence[Method], prepared: Prepared) -> Iterator[Method]:
    """Methods that apply to a system, in order."""
    return (method for method in methods if not method.why_not(prepared))


def recorded(job: Job, methods: Sequence[Method]) -> Record:
    """Record by the first method that applies.

    If it fails or turns out not to apply, the next one runs, on blocks with the
    memory that they had before.

    Raises
    ------
    NotApplicableError
        If none applies; the message gives the reasons.
    SolverError
        If the last one that applies fails.
    """
    reasons: dict[str, str] = {}
    why = job.reason
    for place, method in enumerate(methods):
        reason = method.why_not(job.prepared)
        if not reason:
            fresh = fresh_job(job)
            try:
                return method.run(replace(job, reason=why))
            except NotApplicableError as error:
                reason = str(error)
            except SolverError as error:
                if not any(applicable(methods[place + 1 :], job.prepared)):
                    raise
                reason = f'method "{method.name}" failed: {error}'
            job = fresh
        reasons.setdefault(method.name, reason)
        why = job.reason or reason
    raise NotApplicableError(
        "; ".join(f'method "{name}" must apply to the system, but {why}' for name, why in reasons.items())
    )
