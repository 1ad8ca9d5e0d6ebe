"""Blocks whose command starts before its plan: a run must begin early enough, and at a sample."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ctrlplan.simulation.network import Block
from ctrlplan.traits import traits_of

_OFF_SAMPLE = 1e-5
"""Fraction of a period by which the start of a run may differ from a sample time."""


class CommandStart(NamedTuple):
    """Start of a command.

    Attributes
    ----------
    name : str
        Name of the block.
    start, preview : float
        Time [s] at which it starts, and by how much before its plan.
    period, offset : float
        Of a discrete block [s]; a period of 0 is continuous time.
    """

    name: str
    start: float
    preview: float
    period: float
    offset: float


def command_starts(blocks: Iterable[Block]) -> tuple[CommandStart, ...]:
    """Declared starts of the commands among some blocks."""
    found = []
    for block in blocks:
        own = block.traits
        held = own if own.start is not None or own.block is None else traits_of(own.block)
        if held.start is not None:
            dt = block.system.dt
            period = own.period or (0.0 if dt is None or isinstance(dt, bool) else float(dt))
            found.append(CommandStart(block.name, held.start, held.preview or 0.0, period, own.offset))
    return tuple(found)


def check_begin(starts: Sequence[CommandStart], begin: float, at_rest: bool) -> None:
    """Raise for a run that misses the start of a command, if it begins at rest, or its samples.

    Parameters
    ----------
    starts : sequence of CommandStart
        Starts of the commands in the loop.
    begin : float
        First time of the run [s].
    at_rest : bool
        Whether the loop is at its declared initial state or equilibrium then.
    """
    for one in starts:
        rounding = 1e-12 * max(abs(begin), abs(one.start))
        if at_rest and begin > one.start + rounding + _OFF_SAMPLE * one.period:
            raise ValueError(
                f"timepts must begin at {one.start:.10g} s or earlier, where the command of block {one.name} starts, "
                f"{one.preview:.6g} s before its plan, got {begin:.10g} s; begin at cp.traits_of(block).start, or give "
                "the state of the loop as initial_state"
            )
        if one.period:
            samples = (begin + one.offset - one.start) / one.period
            if abs(samples - round(samples)) > _OFF_SAMPLE + rounding / one.period:
                raise ValueError(
                    f"timepts must begin a whole number of periods of {one.period:g} s from {one.start:.10g} s, a "
                    f"sample of block {one.name}, got {begin:.10g} s; begin at cp.traits_of(block).start"
                )
