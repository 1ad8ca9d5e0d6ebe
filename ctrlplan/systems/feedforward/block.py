"""Feedforward of one plan, as a block without inputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._display import Displayed, Facts, Part, number
from ctrlplan._types import Array, System
from ctrlplan.systems.feedforward.zeros import zero_list
from ctrlplan.traits import declare

Method: TypeAlias = Literal["exact", "zpetc"]
"""How zeros that are not cancelled are treated."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Accuracy:
    """What is known of the command for a plan; the attributes of `PlannedFeedforward`."""

    start: float
    preview: float
    error: float
    zeros: NDArray[np.complex128]
    loop_state: Array
    stable: bool
    method: Method = "exact"
    remaining: tuple[tuple[float, Array], ...] = ()
    end_command: Array | None = None
    gain: tuple[float, float] | None = None
    ripple: Array | None = None


class PlannedFeedforward(Displayed, ct.InterconnectedSystem):  # type: ignore[misc]
    """Command of a linear loop for one plan; made by `create_feedforward_iosystem`.

    No inputs. Outputs: the inputs of the loop. Time is that of the plan: simulations
    begin at `start`, `preview` before the plan, or earlier.

    Attributes
    ----------
    start : float
        Time [s] at which the command starts to move.
    preview : float
        Time [s] from `start` to the start of the plan.
    method : str
        "exact" or "zpetc".
    error : float
        Maximum tracking error for all times, at sample times if the loop is discrete,
        relative to the range of the plan of that output: by the limited preview or
        by "zpetc", otherwise 0. Infinite if the preview is limited and the loop
        unstable.
    zeros : ndarray of complex
        Invariant zeros of the loop.
    loop_state : ndarray, shape (nstates,)
        State of the loop at `start` with error 0: its equilibrium at the first
        position of the plan, plus the remainder of the free motion that a limited
        preview omits.
    stable : bool
        Whether deviations from `loop_state` decay or stay bounded.
    remaining : tuple of (float, ndarray)
        For each pair of zeros on the stability boundary the frequency [rad/s] and the
        amplitudes (ninputs,) of the undamped oscillation of the command after the plan.
    end_command : ndarray, shape (ninputs,), or None
        Command at the end of the plan, if it grows afterwards (``finite=True``).
    gain : (float, float) or None
        For "zpetc" the frequency [rad/s] below which the velocity of the plan has
        99.9 % of its energy, and the gain from plan to output there.
    ripple : ndarray, shape (noutputs,), or None
        For loops with `sample_hold` blocks the maximum error between samples, in the
        unit of each output.
    """

    start: float
    preview: float
    method: Method
    error: float
    zeros: NDArray[np.complex128]
    loop_state: Array
    stable: bool
    remaining: tuple[tuple[float, Array], ...]
    end_command: Array | None
    gain: tuple[float, float] | None
    ripple: Array | None

    def __init__(self, sources: Sequence[System], inverse: System, outputs: Sequence[str], name: str, known: Accuracy):
        feeds = [(k, row) for k, source in enumerate(sources) for row in range(source.noutputs)]
        last = len(sources)
        super().__init__(
            [*sources, inverse],
            connections=[[(last, row), feed] for row, feed in enumerate(feeds)],
            inplist=[],
            outlist=[(last, row) for row in range(inverse.noutputs)],
            inputs=0,
            outputs=list(outputs),
            name=name,
        )
        for value in vars(known).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        self.__dict__.update(vars(known))
        self._outputs = tuple(outputs)
        for block in (inverse, self):
            declare(block, start=known.start, preview=known.preview)

    def _describe(self) -> Iterator[Part]:
        yield f"PlannedFeedforward of {', '.join(self._outputs)} from {self.start:g} s"
        rows = [
            ("preview", f"{self.preview:.6g} s before the plan"),
            ("method", self.method),
            ("zeros of the loop", zero_list(self.zeros) if self.zeros.size else "none"),
            ("error", f"{self.error:.3g} of the move" if np.isfinite(self.error) else "grows: the loop is unstable"),
        ]
        if not self.stable:
            rows.append(("loop", "unstable: no error only from loop_state at the start"))
        for frequency, amplitudes in self.remaining:
            sizes = ", ".join(f"{number(a)} of {n}" for n, a in zip(self._outputs, amplitudes.tolist(), strict=True))
            rows.append((f"oscillation left at {frequency:.4g} rad/s", sizes))
        if self.end_command is not None:
            rows.append(("command at the end of the plan", ", ".join(map(number, self.end_command.tolist()))))
        if self.gain is not None:
            rows.append((f"gain at {self.gain[0]:.4g} rad/s", f"{self.gain[1]:.6g}"))
        if self.ripple is not None:
            rows.append(("ripple between samples", ", ".join(map(number, self.ripple.tolist()))))
        yield Facts(rows)
