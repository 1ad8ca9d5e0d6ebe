"""Result of a simulation."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._display import ROWS, Displayed, Facts, Part, Table, number, shortened
from ctrlplan._lru import BUILDING
from ctrlplan._types import Array
from ctrlplan.simulation.events import Departures, LaterEvents, Occurrence

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
    outputs : array_like, shape (noutputs, ntime), or callable
        Outputs of the system; a function without arguments returns them when they
        are first read, and requires `output_labels`.
    states, inputs : array_like, shapes (nstates, ntime) and (ninputs, ntime), optional
        Its states and inputs.
    method : str, optional
        Name of the method used: "exact", "compiled" or "python".
    reason : str or callable, optional
        Why that method was chosen; where an output is uncertain, also the
        estimated error and the tolerance that suffices. A function without
        arguments returns it when it is first read.
    events : sequence of Occurrence or callable, optional
        Crossings of the limits of events, in order of time. A function without
        arguments returns them when they are first read.
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
    x: Array
    u: Array
    input_labels: list[str]
    output_labels: list[str]
    state_labels: list[str]
    method: str
    _y: Array
    _outputs: Callable[[], Array] | None = None

    def __init__(
        self,
        time: ArrayLike,
        outputs: ArrayLike | Callable[[], Array],
        states: ArrayLike | None = None,
        inputs: ArrayLike | None = None,
        *,
        method: str = "",
        reason: str | Callable[[], str] = "",
        events: Sequence[Occurrence] | Callable[[], Sequence[Occurrence]] = (),
        output_labels: Sequence[str] | None = None,
        **labels: object,
    ) -> None:
        given = np.empty((len(output_labels or ()), np.size(time))) if callable(outputs) else outputs
        super().__init__(time, given, states, inputs, output_labels=output_labels, **labels)
        self._outputs = outputs if callable(outputs) else None
        self._reason, self.method = reason, method
        self._events = events if callable(events) else list(events)

    @property
    def y(self) -> Array:
        """Outputs, (noutputs, ntime), never squeezed."""
        evaluate = self._outputs
        if evaluate is not None:
            self._y, self._outputs = evaluate(), None
        return self._y

    @y.setter
    def y(self, values: Array) -> None:
        self._y, self._outputs = values, None

    @property
    def reason(self) -> str:
        """Why the method was chosen, and where an output is uncertain the estimated error."""
        found = self._reason
        if callable(found):
            self._reason = found = found()
        return found

    @property
    def events(self) -> list[Occurrence]:
        """Crossings of the limits of events, in order of time."""
        found = self._events
        if callable(found):
            with BUILDING:  # they are located by the solver of the run: one thread at a time
                found = self._events
                self._events = found = list(found()) if callable(found) else found
        return found

    def __getstate__(self) -> dict[str, object]:
        """State with the outputs, the reason and the events, which are otherwise evaluated when they are read."""
        return self.__dict__ | {"_y": self.y, "_outputs": None, "_reason": self.reason, "_events": self.events}

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


def departures_in(response: SimulationResponse) -> list[Departures]:
    """Crossings by which signals left their limits, of each event; events that are not located yet are only counted."""
    found = response._events
    if isinstance(found, LaterEvents):
        with BUILDING:  # as for the events themselves
            return found.departures()
    return Departures.of(response.events)


def signal_table(response: ct.TimeResponseData) -> SampledTable:
    """Outputs, inputs and states of a response by their labels."""
    from ctrlplan.trajectories.export import SampledTable

    groups = {
        "output": (response.output_labels, response.y),
        "input": (response.input_labels, response.u),
        "state": (response.state_labels, response.x),
    }
    return SampledTable.of(response.t, {name: (labels, rows) for name, (labels, rows) in groups.items() if labels})
