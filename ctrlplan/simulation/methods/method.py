"""Interface of a simulation method, and how one is chosen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from ctrlplan.simulation.built_forms import NotApplicableError
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.job import Job, Record, fresh_job
from ctrlplan.simulation.prepared import Prepared


class Method(Protocol):
    """A way to run a system.

    A new method is a file with a class of these three members, and its line in
    ``ctrlplan.simulation.methods.METHODS``; for type checkers its name is one
    of ``MethodName`` as well. One that solves differential
    equations may leave segments, scales, delays, samples and events to
    `ctrlplan.simulation.numerical.numerical`, and give the solver alone.
    """

    @property
    def name(self) -> str:
        """Name by which `simulate` takes it, and which its responses have; several methods may share one."""

    def why_not(self, prepared: Prepared) -> str:
        """Reason why the method does not apply to a system, in words; empty where it applies."""

    def run(self, job: Job) -> Record:
        """States at the times of a job, at all of them unless an event ends the run.

        Raises
        ------
        NotApplicableError
            If it turns out only now that the method does not apply.
        SolverError
            If it applies and fails.
        """


def named(methods: Sequence[Method], name: str) -> list[Method]:
    """Methods of one name; all for "auto".

    Raises
    ------
    ValueError
        If there is none.
    """
    found = [method for method in methods if name in ("auto", method.name)]
    if not found:
        known = ", ".join(dict.fromkeys(method.name for method in methods))
        raise ValueError(f"method must be one of auto, {known}, got {name!r}")
    return found


def applicable(methods: Sequence[Method], prepared: Prepared) -> Iterator[Method]:
    """Methods that have no reason against a system, in order."""
    return (method for method in methods if not method.why_not(prepared))


def recorded(job: Job, methods: Sequence[Method]) -> Record:
    """Run by the first method that applies.

    A method that turns out not to apply, or fails, is followed by the next,
    which runs on blocks with the memory that they had before.

    Raises
    ------
    NotApplicableError
        If none applies; the reasons are in the message.
    SolverError
        If the last that applies fails.
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
    requirement = "must be given a system that it applies to"
    raise NotApplicableError("; ".join(f'method "{name}" {requirement}, but {why}' for name, why in reasons.items()))
