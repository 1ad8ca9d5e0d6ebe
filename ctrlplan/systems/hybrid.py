"""Blocks that only `ctrlplan.simulate` runs: discrete ones in a continuous loop, and pure delays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_seconds
from ctrlplan._types import Params, System, Value
from ctrlplan.traits import DeclaredTrait, declare

Array = NDArray[np.float64]


class SampleHold(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Discrete block in a continuous loop; made by `sample_hold`.

    Attributes
    ----------
    block : control system
        What takes the samples.
    period, offset : float
        It takes them at offset, offset + period, ... [s] after the run begins.
    """

    block = DeclaredTrait[ct.InputOutputSystem]()
    period = DeclaredTrait[float]()
    offset = DeclaredTrait[float]()

    def __init__(self, block: System, period: float, offset: float, name: str) -> None:
        held = [f"{label}_held" for label in block.output_labels]
        super().__init__(
            self._no_rates,
            self._held,
            inputs=block.input_labels,
            outputs=block.output_labels,
            states=[*(block.state_labels or []), *held],
            dt=0,
            name=name,
            params=dict(getattr(block, "params", {})),
        )
        # No direct feedthrough between samples.
        declare(self, block=block, period=period, offset=offset, sample=self.sample, feedthrough=False)
        self._inner = block.nstates or 0

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a sample: the block's next ones, and the outputs that are held."""
        own = None if isinstance(self.block, ct.StateSpace) else params
        state = x[: self._inner]
        outputs = np.ravel(self.block.output(t, state, u, own))
        following = np.ravel(self.block.dynamics(t, state, u, own)) if self._inner else np.empty(0)
        return np.concatenate([following, outputs])

    def _held(self, t: float, x: Value, u: Value, params: Params) -> Value:
        return x[self._inner :]

    def _no_rates(self, t: float, x: Value, u: Value, params: Params) -> NoReturn:
        refuse_alone(self.name, "takes samples")


class Delay(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Block that puts out later what goes in; made by `create_delay_iosystem`.

    Attributes
    ----------
    delay : float
        How much later [s].
    initial : ndarray, shape (ninputs,)
        What it puts out before anything has come through.
    """

    delay = DeclaredTrait[float]()
    initial = DeclaredTrait[ArrayLike]()

    def __init__(self, delay: float, initial: Array, inputs: list[str], outputs: list[str], name: str) -> None:
        super().__init__(None, self._past, inputs=inputs, outputs=outputs, dt=0, name=name)
        declare(self, delay=delay, initial=initial)

    def _past(self, t: float, x: Value, u: Value, params: Params) -> NoReturn:
        refuse_alone(self.name, "has a memory of its input")


def sample_hold(block: System, dt: float, offset: float = 0.0, name: str | None = None) -> SampleHold:
    """Discrete-time block for a continuous loop, its outputs held between samples.

    python-control refuses to join the two kinds; the block that is returned
    it joins, and `ctrlplan.simulate` runs the loop from sample to sample.
    Blocks that take a sample at the same instant see each other's new outputs
    where these pass on at once.

    States: those of the block, then the held outputs. Inputs and outputs: its own.

    Parameters
    ----------
    block : control system
        Discrete, or without states.
    dt : float
        Period [s], above 0; that of the block, where it has one.
    offset : float, optional
        Time of the first sample after a run begins [s], from 0; outputs are 0 until then.
    name : str, optional
        Name of the block: that of `block` unless given.

    Returns
    -------
    SampleHold
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If `block` is no control system.
    ValueError
        If it is continuous with states, has another period, or a time is out of range.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> plant = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y")
    >>> gain = ct.ss([], [], [], [[1.0, -1.0]], 0.1, inputs=["r", "y"], outputs="u", name="controller")
    >>> loop = ct.interconnect([cp.sample_hold(gain, 0.1), plant], inputs="r", outputs="y")
    >>> found = cp.simulate(loop, [0.0, 0.1, 0.2], 1.0)
    >>> found.outputs.round(3).tolist()
    [0.0, 0.1, 0.19]
    """
    if not isinstance(block, ct.InputOutputSystem):
        raise TypeError(f"block must be a control system, got {type(block).__name__}")
    period = checked_seconds(dt, "dt", positive=True)
    start = checked_seconds(offset, "offset", positive=False)
    if block.dt == 0 and (block.nstates or isinstance(block, ct.TransferFunction)):
        raise ValueError(f"block must be discrete, got {block.name} with dt = 0: see control.sample_system")
    if isinstance(block.dt, float | int) and block.dt is not True and block.dt and abs(block.dt - period) > 1e-12 * dt:
        raise ValueError(f"dt must be the period of the block, {block.dt:g} s, got {period:g} s")
    if isinstance(block, ct.TransferFunction):
        block = ct.ss(block, name=block.name, inputs=block.input_labels, outputs=block.output_labels)
    return SampleHold(block, period, start, name or block.name)


def create_delay_iosystem(
    delay: float,
    inputs: Sequence[str] | str = ("u",),
    outputs: Sequence[str] | str = ("y",),
    initial: ArrayLike = 0.0,
    name: str = "delay",
) -> Delay:
    """Transport delay: outputs are the inputs, some time ago.

    No states that python-control knows; `ctrlplan.simulate` keeps the past as
    series and stops where a jump comes through, so that nothing is approximated
    by a rational function.

    Parameters
    ----------
    delay : float
        How much later [s], above 0.
    inputs, outputs : sequence of str or str, optional
        Names of the signals, as many of each.
    initial : array_like, optional
        What is put out before anything has come through, one for all or one each.
    name : str, optional
        Name of the block.

    Returns
    -------
    Delay
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    ValueError
        If the delay is not above 0, or inputs, outputs and initial do not fit.

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> late = cp.create_delay_iosystem(0.5)
    >>> cp.simulate(late, [0.0, 0.5, 1.0], cp.Step(1.0)).outputs.round(9).tolist()
    [0.0, 1.0, 1.0]
    """
    seconds = checked_seconds(delay, "delay", positive=True)
    given, made = ([names] if isinstance(names, str) else list(names) for names in (inputs, outputs))
    if len(given) != len(made) or not given:
        raise ValueError(f"outputs must be as many as inputs, {len(given)}, got {len(made)}")
    before = np.asarray(initial, dtype=float)
    if before.shape not in ((), (len(given),)) or not np.isfinite(before).all():
        raise ValueError(f"initial must be a finite number or {len(given)} of them, got {initial!r}")
    return Delay(seconds, np.broadcast_to(before, (len(given),)).copy(), given, made, name)


def refuse_alone(name: str, why: str) -> NoReturn:
    """Say who runs a block that python-control cannot run by itself."""
    raise RuntimeError(f"a loop with the block {name}, which {why}, must be run by ctrlplan.simulate")
