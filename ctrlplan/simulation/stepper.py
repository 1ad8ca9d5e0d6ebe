"""Simulation one step at a time, with inputs that are held over each step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite, checked_params, real_array
from ctrlplan._display import Displayed, Facts, Part, counted, number
from ctrlplan._types import Array
from ctrlplan.simulation.held_steps import Grid, Steps, steps_of
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.prepared import Prepared
from ctrlplan.simulation.segments import as_fraction
from ctrlplan.simulation.simulate import checked_state, warn_of_timebase, warn_of_unread
from ctrlplan.simulation.starts import check_begin

_LONGEST = 1e12
"""Longest step [s]."""


class Stepper(Displayed):
    """System simulated step by step; returned by ``cp.prepare(system).start(dt)``.

    For hardware in the loop, and for controllers that are written elsewhere:
    model predictive control, learned policies. Each step advances time by `dt`
    with the inputs held constant; time is the start plus a whole number of
    steps, without accumulated rounding.

    Attributes
    ----------
    dt : float
        Length of a step [s].
    time : float
        Present time [s].
    state : ndarray, shape (nstates,)
        Present state, in the order of ``state_labels``, before the samples that
        are due at the present time; a copy.
    name : str
        Name of the system.
    input_labels, output_labels, state_labels : list of str
        Labels of its signals.

    Notes
    -----
    A continuous linear system is propagated by one matrix exponential, computed
    once; plans inside the loop run with time and are included exactly. Linear
    loops with discrete controllers (`sample_hold`) are propagated from sample to
    sample in the same way. Other systems, and those with delays, are integrated
    at the tolerance given to `start`. Discrete blocks are sampled at their own
    times, also inside a step; a sample that is due at the end of a step reads
    the inputs of the next step. Events are not recorded.

    A step that raises an error leaves time and state unchanged. A stepper must
    not be used by two threads at the same time.

    Examples
    --------
    Predictive control of a cart, with its position and speed weighted against
    the force over the next 20 samples. The first of the forces found by least
    squares is applied, then all are found again from the new measurement:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> dt, horizon, goal = 0.1, 20, np.array([1.0, 0.0])
    >>> cart = ct.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0, inputs="F", outputs=["p", "v"], name="cart")
    >>> model = cart.sample(dt)
    >>> power = [np.linalg.matrix_power(model.A, k) for k in range(horizon + 1)]
    >>> forced = np.zeros((horizon, 2, horizon))  # states after k + 1 samples from the forces
    >>> for k in range(horizon):
    ...     forced[k, :, : k + 1] = np.hstack([power[k - j] @ model.B for j in range(k + 1)])
    >>> weighted = np.vstack([forced.reshape(-1, horizon), 0.3 * np.eye(horizon)])
    >>> stepper = cp.prepare(cart).start(dt)
    >>> y = stepper.outputs()
    >>> for _ in range(100):
    ...     free = np.concatenate([power[k] @ (y - goal) for k in range(1, horizon + 1)])
    ...     forces = np.linalg.lstsq(weighted, np.append(-free, np.zeros(horizon)), rcond=None)[0]
    ...     y = stepper.step(forces[:1])
    >>> stepper.time, bool(np.abs(y - goal).max() < 1e-3)
    (10.0, True)
    """

    def __init__(self, prepared: Prepared, grid: Grid, steps: Steps) -> None:
        self._name, self._grid = prepared.name, grid
        self.input_labels, self.output_labels = list(prepared.input_labels), list(prepared.output_labels)
        self.state_labels = list(prepared.state_labels)
        self._shape, self._steps = (len(self.input_labels),), steps

    @property
    def dt(self) -> float:
        """Length of a step [s]."""
        return float(self._grid.dt)

    @property
    def name(self) -> str:
        """Name of the system."""
        return self._name

    @property
    def time(self) -> float:
        """Present time [s]."""
        return self._grid.time(self._steps.count)

    @property
    def state(self) -> Array:
        """Present state, shape (nstates,)."""
        return self._steps.state

    def step(self, inputs: Mapping[str, float] | ArrayLike | None = None) -> Array:
        """Outputs at the end of a step over which the inputs are held.

        Parameters
        ----------
        inputs : array_like, shape (ninputs,), float, mapping or None, optional
            Values from the present time on: in the order of ``input_labels``, a
            number for all, or by name, where inputs without an entry are 0.

        Returns
        -------
        ndarray, shape (noutputs,)
            Outputs at the new time, with these inputs: before the next ones are
            applied, and before the samples that are due at the new time.

        Raises
        ------
        TypeError
            If inputs are not real numbers.
        ValueError
            If inputs do not fit or are not finite.
        SolverError
            If states do not stay finite, or the integrator fails.
        """
        u = self._array(inputs)
        if not self._steps.finds_nan:
            self._check_finite(u)
        try:
            return self._steps.step(u)
        except SolverError:
            self._check_finite(u)
            raise

    def outputs(self, inputs: Mapping[str, float] | ArrayLike | None = None) -> Array:
        """Outputs at the present time with given inputs, without a step.

        Parameters
        ----------
        inputs : array_like, shape (ninputs,), float, mapping or None, optional
            As for `step`.

        Returns
        -------
        ndarray, shape (noutputs,)
            Outputs just after these inputs are applied, and after the samples that
            are due at the present time.
        """
        u = self._array(inputs)
        self._check_finite(u)
        return self._steps.outputs(u)

    def _array(self, inputs: Mapping[str, float] | ArrayLike | None) -> Array:
        """Inputs (ninputs,); the same object if it is such an array."""
        if type(inputs) is np.ndarray and inputs.dtype == float and inputs.shape == self._shape:
            return inputs
        return self._converted(inputs)

    def _check_finite(self, u: Array) -> None:
        if not np.isfinite(u).all():
            wrong = int((~np.isfinite(u)).argmax())
            raise ValueError(f"inputs must be finite, got {self.input_labels[wrong]} = {u[wrong]}")

    def _converted(self, inputs: Mapping[str, float] | ArrayLike | None) -> Array:
        labels = self.input_labels
        if isinstance(inputs, Mapping):
            for name in inputs:
                if name not in labels:
                    raise ValueError(f"inputs must be among {', '.join(labels) or 'none'}, got {name!r}")
            values = [real_array(inputs.get(name, 0.0), f"input {name}") for name in labels]
            for name, value in zip(labels, values, strict=True):
                if value.shape:
                    raise ValueError(f"input {name} must be a number, got shape {value.shape}")
            return np.array(values).reshape(self._shape)
        given = real_array(0.0 if inputs is None else inputs, "inputs")
        if given.shape not in ((), self._shape):
            names = f"({', '.join(labels)})" if labels else "(the system has no inputs)"
            raise ValueError(f"inputs must be a number or have shape {self._shape} {names}, got shape {given.shape}")
        return np.full(self._shape, given)

    def _describe(self) -> Iterator[Part]:
        yield f"Stepper of {self.name}: {number(self.time)} s, steps of {number(self.dt)} s"
        rows = [("inputs", ", ".join(self.input_labels)), ("outputs", ", ".join(self.output_labels))]
        values = [f"{label} = {number(value)}" for label, value in zip(self.state_labels, self.state, strict=True)]
        yield Facts([*rows, (counted(len(values), "state"), ", ".join(values))])


def started(
    prepared: Prepared,
    dt: float,
    initial_state: ArrayLike | None,
    time: float,
    params: Mapping[str, object] | None,
    rtol: float,
) -> Stepper:
    """Stepper of a system at its start; see `Prepared.start`."""
    step, first = checked_finite(dt, "dt", above=0.0), checked_finite(time, "time")
    tolerance = checked_finite(rtol, "rtol", above=0.0)
    if first + 1e-3 * step == first or step > _LONGEST:
        raise ValueError(f"dt must be resolved by times about {first:g} s and at most {_LONGEST:g} s, got {step:g} s")
    state, given = checked_state(prepared, initial_state), checked_params(params)
    check_begin(prepared.starts, first, initial_state is None)
    warn_of_unread(prepared, given)
    warn_of_timebase(prepared)
    grid = Grid(as_fraction(first), as_fraction(step))
    return Stepper(prepared, grid, steps_of(prepared, grid, state, given, tolerance))
