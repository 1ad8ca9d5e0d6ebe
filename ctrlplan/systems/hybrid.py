"""Blocks for `ctrlplan.simulate` only: discrete blocks in a continuous loop, and delays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NoReturn

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, checked_finite, checked_names, checked_vector, one_number
from ctrlplan._renamed import former_signature
from ctrlplan._types import Array, Params, System, Value
from ctrlplan.traits import DeclaredTrait, declare, traits_of


class SampledBlock(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Block without state derivatives, sampled by `ctrlplan.simulate`.

    Attributes
    ----------
    period, offset : float
        Sample times are offset, offset + period, ... [s] after the start of a run.
    """

    period = DeclaredTrait[float]()
    offset = DeclaredTrait[float]()

    def _no_rates(self, t: float, x: Value, u: Value, params: Params) -> NoReturn:
        raise_not_standalone(self.name, "is sampled")


class SampleHold(SampledBlock):
    """Discrete block in a continuous loop; made by `sample_hold`.

    Attributes
    ----------
    block : control system
        The discrete system.
    period, offset : float
        Sample times are offset, offset + period, ... [s] after the start of a run.
    """

    block = DeclaredTrait[ct.InputOutputSystem]()

    def __init__(
        self, block: System, period: float, offset: float, inputs: list[str], outputs: list[str], name: str
    ) -> None:
        super().__init__(
            self._no_rates,
            self._held,
            inputs=inputs,
            outputs=outputs,
            states=[*(block.state_labels or []), *(f"{label}_held" for label in outputs)],
            dt=0,
            name=name,
            params=dict(getattr(block, "params", {})),
        )
        # No direct feedthrough between samples.
        declare(self, block=block, period=period, offset=offset, sample=self.sample, feedthrough=False)
        self._inner = block.nstates or 0

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a sample: those of the block, then held outputs."""
        own = None if isinstance(self.block, ct.StateSpace) else params
        state = x[: self._inner]
        outputs = np.ravel(self.block.output(t, state, u, own))
        following = np.ravel(self.block.dynamics(t, state, u, own)) if self._inner else np.empty(0)
        return np.concatenate([following, outputs])

    def _held(self, t: float, x: Value, u: Value, params: Params) -> Value:
        return x[self._inner :]


class Delay(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Transport delay; made by `create_delay_iosystem`.

    Attributes
    ----------
    delay : float
        Delay [s].
    initial : ndarray, shape (ninputs,)
        Outputs until the first input has passed.
    """

    delay = DeclaredTrait[float]()
    initial = DeclaredTrait[ArrayLike]()

    def __init__(self, delay: float, initial: Array, inputs: list[str], outputs: list[str], name: str) -> None:
        super().__init__(None, self._past, inputs=inputs, outputs=outputs, dt=0, name=name)
        declare(self, delay=delay, initial=initial)

    def _past(self, t: float, x: Value, u: Value, params: Params) -> NoReturn:
        raise_not_standalone(self.name, "is a delay")


@former_signature("name")
def sample_hold(
    block: System,
    dt: float,
    offset: float = 0.0,
    *,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str | None = None,
) -> SampleHold:
    """Discrete-time block for a continuous loop, with held outputs.

    python-control does not connect discrete and continuous systems. It connects
    the block that is returned, and `ctrlplan.simulate` runs the loop from sample
    to sample. Blocks sampled at the same time read each other's new outputs
    where these have direct feedthrough.

    States: those of the block, then the held outputs, ``<output>_held``.
    Inputs: those of the block. Outputs: those of the block.

    Parameters
    ----------
    block : control system
        Discrete-time or static.
    dt : float
        Period [s], above 0; it must be that of the block if the block has one.
    offset : float, optional
        Time of the first sample after the start of a run [s], at least 0;
        outputs are 0 until then.
    inputs, outputs : sequence of str or str, optional
        Names of the signals, by default those of `block`.
    name : str, optional
        Name of the block, by default that of `block`.

    Returns
    -------
    SampleHold
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If `block` is not a control system or has a frequency response only, or another
        argument has the wrong type.
    ValueError
        If it is continuous with states, contains a delay, or has another period, a
        time is out of range, or the number of names differs from the number of signals.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> plant = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y")
    >>> gain = ct.ss([], [], [], [[1.0, -1.0]], 0.1, inputs=["r", "y"], outputs="u", name="controller")
    >>> sampled = cp.sample_hold(gain, 0.1)
    >>> sampled.state_labels
    ['u_held']
    >>> loop = ct.interconnect([sampled, plant], inputs="r", outputs="y")
    >>> found = cp.simulate(loop, [0.0, 0.1, 0.2], 1.0)
    >>> found.outputs.round(3).tolist()
    [0.0, 0.1, 0.19]
    """
    check_kind(block, "block", ct.InputOutputSystem, "a control system")
    if isinstance(block, ct.FrequencyResponseData):
        raise TypeError(f"block must have equations, got {block.name} with its frequency response only; fit a model")
    for delay in _delays(block):
        raise ValueError(
            f"block must be discrete or static, got {block.name} with the delay {delay}; connect the delay to the "
            "inputs or outputs of what is sampled"
        )
    period = checked_finite(dt, "dt", above=0.0)
    start = checked_finite(offset, "offset", minimum=0.0)
    if block.dt == 0 and (block.nstates or isinstance(block, ct.TransferFunction)):
        raise ValueError(f"block must be discrete, got {block.name} with dt = 0: see control.sample_system")
    if isinstance(block.dt, float | int) and block.dt is not True and block.dt and abs(block.dt - period) > 1e-12 * dt:
        raise ValueError(f"dt must be the period of the block, {block.dt:g} s, got {period:g} s")
    if isinstance(block, ct.TransferFunction):
        block = ct.ss(block, name=block.name, inputs=block.input_labels, outputs=block.output_labels)
    given = block.input_labels if inputs is None else checked_names(inputs, "inputs", block.ninputs)
    held = block.output_labels if outputs is None else checked_names(outputs, "outputs", block.noutputs)
    return SampleHold(block, period, start, given, held, name or block.name)


def _delays(block: System) -> Iterator[str]:
    """Names of the delays in a block."""
    if traits_of(block).delay is not None:
        yield block.name
    for inner in getattr(block, "syslist", ()):
        yield from _delays(inner)


@former_signature("inputs", "outputs", "initial", "name")
def create_delay_iosystem(
    delay: float,
    *,
    initial: ArrayLike = 0.0,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str = "delay",
) -> Delay:
    """Transport delay: y(t) = u(t - delay).

    No states for python-control: `ctrlplan.simulate` stores the past input as
    Chebyshev series and stops the integrator where a jump arrives, without a
    rational approximation. Inputs: u. Outputs: y.

    Parameters
    ----------
    delay : float
        Delay [s], above 0.
    initial : array_like, optional
        Outputs until the first input has passed, a number for all or one for
        each, in the unit of the inputs.
    inputs, outputs : sequence of str or str, optional
        Names of the signals, equally many of each; by default u and y.
    name : str, optional
        Name of the block.

    Returns
    -------
    Delay
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If the delay is not above 0, or inputs, outputs and initial do not fit.

    Examples
    --------
    An integrator with a delayed input:

    >>> import control as ct
    >>> import ctrlplan as cp
    >>> late = cp.create_delay_iosystem(0.5, outputs="u_late")
    >>> integrator = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u_late", outputs="y")
    >>> plant = ct.interconnect([late, integrator], inputs="u", outputs="y")
    >>> cp.simulate(plant, [0.0, 0.5, 1.0], cp.Step(1.0)).outputs.round(9).tolist()
    [0.0, 0.0, 0.5]
    """
    if one_number(delay, "delay") == 0.0:
        raise ValueError("delay must be above 0, got 0: leave the block out and connect its input directly")
    seconds = checked_finite(delay, "delay", above=0.0)
    given = checked_names("u" if inputs is None else inputs, "inputs")
    delayed = checked_names("y" if outputs is None else outputs, "outputs")
    if len(given) != len(delayed) or not given:
        raise ValueError(f"outputs must be as many as inputs, {len(given)}, got {len(delayed)}")
    return Delay(seconds, checked_vector(initial, "initial", len(given)), given, delayed, name)


def state_signal(row: int, t: Value, x: Value, u: Value, params: Params) -> Value:
    """State of a block as a signal with declared limits."""
    return x[row]


def raise_not_standalone(name: str, why: str) -> NoReturn:
    """Raise for a block that python-control cannot simulate."""
    raise RuntimeError(f"a loop with the block {name}, which {why}, must be run by ctrlplan.simulate")
