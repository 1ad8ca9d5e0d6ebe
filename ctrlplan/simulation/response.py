"""Result of a simulation."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import control as ct
from numpy.typing import ArrayLike

from ctrlplan._display import ROWS, Displayed, Facts, Part, Table, number, shortened
from ctrlplan._types import Array
from ctrlplan.simulation.events import Occurrence

if TYPE_CHECKING:
    from ctrlplan.trajectories.export import SampledTable


class SimulationResponse(Displayed, ct.TimeResponseData):  # type: ignore[misc] # python-control has no types
    """Time response of a system, with the method used and its events.

    A `control.TimeResponseData`: signals, labels, indexing, ``plot()`` and
    ``to_pandas()`` are those of python-control.

    Parameters
    ----------
    time : array_like, shape (ntime,)
        Times [s].
    outputs : array_like, shape (noutputs, ntime)
        Outputs of the system.
    states, inputs : array_like, shapes (nstates, ntime) and (ninputs, ntime), optional
        Its states and inputs.
    method : str, optional
        Name of the method used: "exact", "compiled" or "python".
    reason : str, optional
        Why that method was chosen; where an output is uncertain, also the
        estimated error and the tolerance that suffices.
    events : sequence of Occurrence, optional
        Crossings of the limits of events, in order of time.
    **labels
        Further arguments of `control.TimeResponseData`.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Times [s].
    y, x, u : ndarray, shapes (noutputs, ntime), (nstates, ntime) and (ninputs, ntime)
        Outputs, states and inputs, never squeezed.
    method : str
        Name of the method used.
    reason : str
        Why it was chosen, and where an output is uncertain the estimated error.
    events : list of Occurrence
        Crossings of the limits of events, in order of time.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> response = cp.simulate(cp.plants.integrator_lag_loop(5.0), [0.0, 1.0, 2.0], cp.Step(1.0))
    >>> response.method, response.reason, response.events
    ('exact', 'linear and continuous', [])
    >>> response.outputs.shape, response.time.tolist()
    ((3,), [0.0, 1.0, 2.0])
    """

    t: Array
    y: Array
    x: Array
    u: Array
    input_labels: list[str]
    output_labels: list[str]
    state_labels: list[str]
    method: str
    reason: str
    events: list[Occurrence]

    def __init__(
        self,
        time: ArrayLike,
        outputs: ArrayLike,
        states: ArrayLike | None = None,
        inputs: ArrayLike | None = None,
        *,
        method: str = "",
        reason: str = "",
        events: Sequence[Occurrence] = (),
        **labels: object,
    ) -> None:
        super().__init__(time, outputs, states, inputs, **labels)
        self.method, self.reason, self.events = method, reason, list(events)

    def export(self, path: str | os.PathLike[str]) -> Path:
        """Write times and signals to a file, in the format of its ending.

        The endings are .csv, .mat and .npz. Columns are the outputs, inputs and
        states by their labels, with the prefix ``input.`` or ``state.`` for a
        label of an earlier signal.

        Parameters
        ----------
        path : str or path
            File to be written, in an existing folder.

        Returns
        -------
        Path
            File written.

        Raises
        ------
        ValueError
            If the ending is unknown, or names are not unique in the format.
        OSError
            If the file cannot be written; an existing file is then unchanged.
        """
        from ctrlplan.trajectories.export import export_table

        return export_table(signal_table(self), path)

    def _describe(self) -> Iterator[Part]:
        times = f"{self.t.size} times" + (f" from {self.t[0]:.6g} to {self.t[-1]:.6g} s" if self.t.size else "")
        yield f"{type(self).__name__} of {', '.join(self.output_labels or ()) or 'no output'} at {times}"
        yield Facts(
            [
                ("method", f"{self.method}: {self.reason}" if self.method and self.reason else self.method),
                ("time", times),
                ("inputs", ", ".join(self.input_labels or ())),
                ("states", ", ".join(self.state_labels or ())),
            ]
        )
        if self.y.size and self.output_labels:
            values = self.y.reshape(len(self.output_labels), -1)
            rows = [
                (label, *(number(float(value)) for value in (row.min(), row.max(), row[-1])))
                for label, row in zip(self.output_labels, values, strict=True)
            ]
            yield Table("Outputs", ("output", "minimum", "maximum", "final value"), shortened(rows))
        for event in self.events[:ROWS]:
            yield f"Event at {event}"
        if len(self.events) > ROWS:
            yield f"{len(self.events) - ROWS} more events"


def signal_table(response: ct.TimeResponseData) -> SampledTable:
    """Outputs, inputs and states of a response by their labels."""
    from ctrlplan.trajectories.export import SampledTable

    groups = {
        "output": (response.output_labels, response.y),
        "input": (response.input_labels, response.u),
        "state": (response.state_labels, response.x),
    }
    return SampledTable.of(response.t, {name: (labels, rows) for name, (labels, rows) in groups.items() if labels})
