"""Result of a simulation."""

from __future__ import annotations

from collections.abc import Sequence

import control as ct
from numpy.typing import ArrayLike

from ctrlplan._types import Array
from ctrlplan.simulation.events import Occurrence


class SimulationResponse(ct.TimeResponseData):  # type: ignore[misc] # python-control has no types
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
