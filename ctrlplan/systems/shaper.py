"""Input shaper as a sampled block, also for a mode whose frequency is measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import check_kind, checked_finite, checked_names, checked_vector
from ctrlplan._types import Array, Params, Value
from ctrlplan.systems.hybrid import SampledBlock
from ctrlplan.traits import declare
from ctrlplan.trajectories import Shaper, ShaperFactor

_SLOWEST = 0.5
"""Lowest frequency of a measured mode, relative to that of the design: it bounds the memory of the block."""


class ShaperBlock(SampledBlock):
    """Input shaper as a block; made by `create_shaper_iosystem`.

    Attributes
    ----------
    shaper : Shaper
        The shaper.
    frequency_input : str or None
        Input with the measured frequency of the mode.
    period, offset : float
        Sample times are 0, period, ... [s] after the start of a run.
    """

    def __init__(
        self,
        shaper: Shaper,
        dt: float,
        frequency_input: str | None,
        inputs: list[str],
        outputs: list[str],
        initial: Array,
        name: str,
    ) -> None:
        self.shaper, self.frequency_input = shaper, frequency_input
        self._dt, self._width = dt, len(inputs)
        if frequency_input is None:
            fixed = shaper.on_grid(dt)
            self._lags, self._weights = np.rint(fixed.delays / dt).astype(np.intp), fixed.weights
            self._length = int(self._lags[-1])
        else:
            factor = shaper.factors[0]
            self._length = (len(factor.weights) - 1) * (int(factor.delay / (_SLOWEST * dt)) + 2)
        past = [f"{label}[{k}]" for label in inputs for k in range(1, self._length + 1)]
        if frequency_input is not None:
            past += [f"{frequency_input}[{k}]" for k in range(1, self._length + 1)]
        super().__init__(
            self._no_rates,
            self._held,
            inputs=inputs + ([] if frequency_input is None else [frequency_input]),
            outputs=outputs,
            states=[*past, *(f"{label}_held" for label in outputs)],
            dt=0,
            name=name,
        )
        before = np.repeat(initial, self._length)
        # A frequency of 0 in the memory is one that has not been measured.
        unknown = np.zeros(0 if frequency_input is None else self._length)
        declare(
            self,
            period=dt,
            sample=self.sample,
            feedthrough=False,
            initial_state=np.concatenate([before, unknown, initial]),
        )

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a sample.

        Past commands, past frequencies, held outputs.
        """
        count = self._width * self._length
        past, command = x[:count].reshape(self._width, self._length), np.asarray(u[: self._width], dtype=float)
        following = [np.column_stack([command, past[:, :-1]]).ravel()]
        if self.frequency_input is None:
            lags, weights = self._lags, self._weights
        else:
            frequency = np.concatenate([[self._checked_frequency(t, float(u[-1]))], x[count : count + self._length]])
            following.append(frequency[:-1])
            lags, weights = _varying_weights(self.shaper.factors[0], frequency, self._dt)
        # Differences from the present command: a constant command is reached exactly.
        shown = np.column_stack([command, past])[:, lags]
        output = command + (shown - command[:, None]) @ weights
        return np.concatenate([*following, np.clip(output, shown.min(axis=1), shown.max(axis=1))])

    def _held(self, t: float, x: Value, u: Value, params: Params) -> Value:
        return x[-self._width :]

    def _checked_frequency(self, t: float, frequency: float) -> float:
        """Measured frequency, checked against the memory and the sample period."""
        factor = self.shaper.factors[0]
        fastest = factor.angle / (self._dt * math.sqrt(1.0 - factor.damping**2))
        if not _SLOWEST * factor.frequency <= frequency <= fastest:
            raise ValueError(
                f"{self.frequency_input} of {self.name} must lie from {_SLOWEST * factor.frequency:.4g} rad/s, half of "
                f"the shaper's frequency, to {fastest:.4g} rad/s, where the delay is one period of {self._dt:g} s, got "
                f"{frequency:.4g} at {t:g} s; design the shaper for the lowest frequency, or sample faster"
            )
        return frequency


def create_shaper_iosystem(
    shaper: Shaper,
    dt: float,
    *,
    frequency_input: str | None = None,
    initial: ArrayLike = 0.0,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str = "shaper",
) -> ShaperBlock:
    r"""Input shaper as a sampled block, for commands of an operator.

    At every sample the output is a weighted mean of the last commands, with the
    weights of ``shaper.on_grid(dt)``, held until the next sample. It lies within
    the range of these commands and is equal to a constant command exactly.

    With `frequency_input` the frequency of the mode is measured, as that of a load
    on a rope, :math:`\sqrt{g/L}`. Each delay is then replaced by commands now, k
    and k + 1 samples ago, with the phases of the measured frequency over these
    samples. The sway that a change of the trolley's velocity excites depends on the
    length of the rope at that time: an earlier command counts with the square root
    of its frequency over the present one. At constant frequency the weights are those
    of ``on_grid``.

    States: for each command its last values, ``r_cmd[1]``, ...; those of the
    frequency; the held outputs, ``r_held``. Inputs: the command r_cmd, then the
    frequency [rad/s]. Outputs: r. The residual vibration does not depend on the
    period, but the number of states does: a tenth to a hundredth of the delay is
    a good choice.

    Parameters
    ----------
    shaper : Shaper
        A shaper whose modes are known, with `frequency_input` for one mode, and
        designed for its lowest frequency.
    dt : float
        Period [s], at most the shortest delay of the shaper.
    frequency_input : str, optional
        Name of the input with the undamped natural frequency [rad/s]. It must
        not fall below half of the shaper's frequency.
    initial : array_like, optional
        Command before the start of a run, a number for all or one for each: the
        declared initial state.
    inputs, outputs : sequence of str or str, optional
        Names of the commands and of the shaped commands, equally many of each; by
        default r_cmd and r.
    name : str, optional
        Name of the block.

    Returns
    -------
    ShaperBlock
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If the modes of the shaper are not known, or are several with
        `frequency_input`; if `dt` is out of range, or names do not fit. In a run,
        if the measured frequency is out of range or nan.

    References
    ----------
    Singhose, Porter, Kenison and Kriikku, Effects of hoisting on the input shaping
    control of gantry cranes, Control Engineering Practice 8, 2000.

    Examples
    --------
    A lightly damped mode of 2 rad/s, without and with the shaper:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> mode = ct.tf([4.0], [1.0, 0.04, 4.0], inputs="r", outputs="y")
    >>> block = cp.create_shaper_iosystem(cp.Shaper.zv(2.0, 0.01), 0.05)
    >>> shaped = ct.interconnect([block, mode], inputs="r_cmd", outputs=["y", "r"])
    >>> t = np.linspace(0.0, 10.0, 201)
    >>> bool(abs(cp.simulate(shaped, t, cp.Step(1.0)).outputs[0, 40:] - 1.0).max() < 1e-6)
    True
    """
    check_kind(shaper, "shaper", Shaper)
    period = checked_finite(dt, "dt", above=0.0)
    commands = checked_names("r_cmd" if inputs is None else inputs, "inputs")
    shaped = checked_names("r" if outputs is None else outputs, "outputs")
    if len(commands) != len(shaped) or not commands:
        raise ValueError(f"outputs must be as many as inputs, {len(commands)}, got {len(shaped)}")
    start = checked_vector(initial, "initial", len(commands))
    shaper.on_grid(period)  # raises for unknown modes and for too long a period
    if frequency_input is not None:
        checked_names([*commands, frequency_input], "inputs and frequency_input")
        if len(shaper.factors) != 1:
            raise ValueError(
                f"shaper must be for one mode if its frequency is measured, got {len(shaper.factors)} modes; use one "
                "block for each mode, in series"
            )
    return ShaperBlock(shaper, period, frequency_input, commands, shaped, start, name)


def _varying_weights(factor: ShaperFactor, frequency: Array, dt: float) -> tuple[NDArray[np.intp], Array]:
    """Weights of the present and all past commands, for measured frequencies, the present one first."""
    measured = frequency > 0.0
    frequency = np.where(measured, frequency, frequency[measured][-1])
    turns = 0.5 * dt * math.sqrt(1.0 - factor.damping**2) * (frequency[1:] + frequency[:-1])
    phase = np.concatenate([[0.0], np.cumsum(turns)])
    power = np.zeros(frequency.size)  # weights of a power of the delay
    power[0] = 1.0
    total = factor.weights[0] * power
    for weight in factor.weights[1:]:
        power = _delayed(factor, frequency, phase, power)
        total += weight * power
    # While the frequency varies, weights near 0 may be slightly negative.
    lags = np.flatnonzero(total > 0.0)
    left: Array = total[lags]
    return lags, left / left.sum()


def _delayed(factor: ShaperFactor, frequency: Array, phase: Array, weights: Array) -> Array:
    """Weights after one more delay, which is that at the time of each command."""
    following = np.zeros(weights.size)
    for lag in np.flatnonzero(weights).tolist():
        k = int(np.searchsorted(phase, phase[lag] + factor.angle, side="right")) - 1
        places = np.array([lag, k, k + 1])
        # A change of velocity excites a sway proportional to the root of 1/frequency at its time.
        amplitudes = np.sqrt(frequency[places[1:]] / frequency[lag])
        np.add.at(following, places, weights[lag] * factor.taps(phase[places[1:]] - phase[lag], amplitudes))
    return following
