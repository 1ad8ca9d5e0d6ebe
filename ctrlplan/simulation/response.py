"""What a simulation returns."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import control as ct
from numpy.typing import ArrayLike

from ctrlplan._types import Array
from ctrlplan.simulation.events import Occurrence
from ctrlplan.trajectories.export import Table, export_table


class SimulationResponse(ct.TimeResponseData):  # type: ignore[misc] # python-control has no types
    """Response of a system, with the method that computed it and its events.

    A `control.TimeResponseData` in all else: its signals, labels, indexing,
    ``plot()`` and ``to_pandas()`` are python-control's.

    Parameters
    ----------
    time : array_like, shape (ntime,)
        Times [s].
    outputs : array_like, shape (noutputs, ntime)
        Outputs of the system.
    states, inputs : array_like, shapes (nstates, ntime) and (ninputs, ntime), optional
        Its states and inputs.
    method : str, optional
        Name of the method that ran: "exact", "compiled", "python".
    reason : str, optional
        Why that method was chosen, in words; and where an output is uncertain,
        the estimated error and the tolerance that suffices.
    events : sequence of Occurrence, optional
        Crossings of the limits that were watched, in order of time.
    **labels
        Further arguments of `control.TimeResponseData`.

    Attributes
    ----------
    t : ndarray, shape (ntime,)
        Times [s].
    y, x, u : ndarray, shapes (noutputs, ntime), (nstates, ntime) and (ninputs, ntime)
        Outputs, states and inputs, never squeezed.
    method, reason : str
        As above.
    events : list of Occurrence
        As above.

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
        """Write times and signals, in the format of the path's ending: .csv, .mat or .npz.

        Columns are the outputs, inputs and states by their labels. A label that
        an earlier signal has gets ``input.`` or ``state.`` before it.

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
        return export_table(signal_table(self), path)


def signal_table(response: ct.TimeResponseData) -> Table:
    """Outputs, inputs and states of a response by their labels."""
    groups = {
        "output": (response.output_labels, response.y),
        "input": (response.input_labels, response.u),
        "state": (response.state_labels, response.x),
    }
    return Table.of(response.t, {name: (labels, rows) for name, (labels, rows) in groups.items() if labels})
