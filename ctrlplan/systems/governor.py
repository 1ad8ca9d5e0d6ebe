"""Reference governor: modifies the command so that the loop satisfies its limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Protocol, runtime_checkable

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite, checked_names, checked_vector
from ctrlplan._types import Array, EventName, Params, System, Value
from ctrlplan.systems.admissible import AdmissibleSet, Limits
from ctrlplan.systems.exposed import state_signals
from ctrlplan.systems.hybrid import SampledBlock, state_signal
from ctrlplan.traits import declare


@runtime_checkable
class Admission(Protocol):
    """Interface of admissible references, as a governor calls it.

    `AdmissibleSet` and `ctrlplan.Predictor` implement it, and so can other classes.

    Attributes
    ----------
    references : sequence of str
        Labels of the governed inputs of the loop.
    states : sequence of str
        Labels of the states of the loop.
    """

    @property
    def references(self) -> Sequence[str]:
        """Labels of the governed inputs of the loop."""

    @property
    def states(self) -> Sequence[str]:
        """Labels of the states of the loop."""

    def fraction(self, x: Array, v: Array, r: Array) -> float:
        """Largest admissible fraction of the way from v to r.

        Largest kappa in [0, 1] for which v + kappa (r - v), held constant from
        state x, is admissible; nan if there is none.
        """


class Governor(SampledBlock):
    """Reference governor; made by `create_governor_iosystem`.

    Attributes
    ----------
    admission : Admission
        Admissible references of the loop.
    period, offset : float
        Sample times are offset, offset + period, ... [s] after the start of a run.
    initial : ndarray, shape (nreferences,)
        Reference before the first sample.
    """

    def __init__(
        self,
        admission: Admission,
        period: float,
        offset: float,
        initial: Array,
        inputs: list[str],
        outputs: list[str],
        name: str,
    ) -> None:
        super().__init__(
            self._no_rates,
            self._held,
            inputs=inputs,
            outputs=outputs,
            states=[*(f"{label}_offset" for label in outputs), "fraction", "infeasible", "nan_input"],
            dt=0,
            name=name,
        )
        self.admission, self.initial = admission, initial
        declare(
            self,
            period=period,
            offset=offset,
            sample=self.sample,
            feedthrough=False,  # between samples
            watched={
                EventName(f"{name}: no admissible reference, previous one held"): (
                    partial(state_signal, -2),
                    -math.inf,
                    0.5,
                ),
                EventName(f"{name}: nan at the input, reference held"): (partial(state_signal, -1), -math.inf, 0.5),
            },
        )
        self._count = len(outputs)

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a sample, with the reference moved."""
        n = self._count
        if not np.isfinite(u).all():
            return np.array([*x[:n], 0.0, 0.0, 1.0])
        held, command = x[:n] + self.initial, u[:n]
        kappa = float(self.admission.fraction(u[n:], held, command))
        if math.isnan(kappa):
            return np.array([*x[:n], 0.0, 1.0, 0.0])
        # With kappa = 1 the reference is the command itself, without rounding.
        moved = command if kappa == 1.0 else held + kappa * (command - held)
        return np.array([*(moved - self.initial), kappa, 0.0, 0.0])

    def _held(self, t: float, x: Value, u: Value, params: Params) -> Value:
        return np.array([x[k] + value for k, value in enumerate(self.initial.tolist())])


def create_governor_iosystem(
    loop: System,
    dt: float | None = None,
    limits: Limits | None = None,
    *,
    initial: ArrayLike = 0.0,
    offset: float = 0.0,
    references: Sequence[str] | None = None,
    margin: float | None = None,
    disturbances: Mapping[str, float] | None = None,
    origin: tuple[ArrayLike, ArrayLike] | None = None,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    name: str = "governor",
) -> Governor:
    """Reference governor in front of a closed loop.

    Every period the reference v moves towards the command r,
    v+ = v + kappa (r - v), by the largest kappa in [0, 1] for which the loop,
    with v+ held constant, satisfies its limits for all future times. An
    admissible command passes unchanged, kappa = 1. If no reference is
    admissible, not even the present one, or an input is not finite, v is held
    and `ctrlplan.simulate` records an event. Direct feedthrough of the
    reference, as through the derivative of the error in a PID, makes every step
    small: take the derivative of the output, or connect
    `create_command_filter_iosystem` after the governor.

    States: the references as offsets from `initial`, ``<reference>_offset``;
    fraction, the last kappa, 0 where v was held; infeasible and nan_input, 1 while
    no reference is admissible or an input is not finite. Inputs: the commands,
    ``<reference>_cmd``, then the states of the loop as `expose_states` names
    them, ``<state>_state``. Outputs: the references, by the loop's names, held
    between samples.

    Parameters
    ----------
    loop : control system or Admission
        A linear loop; or an `AdmissibleSet`, a `ctrlplan.Predictor` for
        nonlinear loops, or any object with `references`, `states` and `fraction`.
    dt : float, optional
        Period [s], above 0; by default that of the admissible set.
    limits : mapping of str to (float, float) or float, optional
        Minimum and maximum of each limited output of a linear loop; a number a
        for (-a, a).
    initial : array_like, optional
        Reference before the first sample, a number for all or one for each; it
        must be admissible at the start of a run.
    offset : float, optional
        Time of the first sample after the start of a run [s], at least 0.
    references, margin, disturbances, origin : optional
        Arguments of the `AdmissibleSet` of a linear loop, with its defaults.
    inputs : sequence of str or str, optional
        Names of the commands, or of all inputs.
    outputs : sequence of str or str, optional
        Names of the references, by default those of the loop.
    name : str, optional
        Name of the block.

    Returns
    -------
    Governor
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If `loop` is none of these, or arguments of an `AdmissibleSet` are given
        with an object that is one already.
    ValueError
        If `dt` is missing or differs from that of the set, `initial` or names do
        not fit, or the `AdmissibleSet` raises; the message gives the reason.

    References
    ----------
    E. G. Gilbert, I. Kolmanovsky, K. T. Tan, "Discrete-time reference governors
    and the nonlinear control of systems with state and control constraints",
    Int. J. Robust Nonlinear Control 5 (1995) 487-504.

    Examples
    --------
    A step for which the loop would require five times the available control:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    >>> governor = cp.create_governor_iosystem(loop, 0.05, {"u": 1.0})
    >>> governor.input_labels, governor.output_labels
    (['r_cmd', 'plant_x_0_state', 'plant_x_1_state'], ['r'])
    >>> governed = ct.interconnect([governor, cp.expose_states(loop)], inputs=["r_cmd"], outputs=["y", "u", "r"])
    >>> found = cp.simulate(governed, np.linspace(0.0, 15.0, 301), {"r_cmd": cp.Step(1.0)})
    >>> y, u, r = found.outputs
    >>> round(float(np.abs(u).max()), 6), round(float(y[-1]), 3), round(float(r[0]), 3), float(r[-1])
    (0.999, 1.0, 0.2, 1.0)
    >>> found.state_labels[:2]
    ['governor_r_offset', 'governor_fraction']
    """
    options = {"references": references, "margin": margin, "disturbances": disturbances, "origin": origin}
    given = {label: value for label, value in options.items() if value is not None}
    admission = _admission(loop, dt, limits, given)
    own = getattr(admission, "dt", None)
    period = own if dt is None else dt
    if period is None:
        raise ValueError("dt must be given, the period in s")
    period = checked_finite(period, "dt", above=0.0)
    if own is not None and abs(period - own) > 1e-12 * own:
        raise ValueError(f"dt must be the period of the admissible set, {own:g} s, got {period:g} s")
    start = checked_finite(offset, "offset", minimum=0.0)
    before = checked_vector(initial, "initial", len(admission.references))
    commands = _command_names(admission, inputs)
    governed = list(admission.references)
    if outputs is not None:
        governed = checked_names(outputs, "outputs", len(governed))
    return Governor(admission, period, start, before, commands, governed, name)


def _command_names(admission: Admission, inputs: Sequence[str] | str | None) -> list[str]:
    """Names of all inputs: commands, then states of the loop."""
    states = state_signals(admission.states)
    if inputs is None:
        return [*(f"{label}_cmd" for label in admission.references), *states]
    given = checked_names(inputs, "inputs")
    count = len(admission.references)
    if len(given) not in (count, count + len(states)):
        raise ValueError(
            f"inputs must be names of {count} commands, or of them and {len(states)} states, got {len(given)}"
        )
    return given if len(given) > count else checked_names([*given, *states], "inputs")


def _admission(loop: System, dt: float | None, limits: Limits | None, options: dict[str, Value]) -> Admission:
    if isinstance(loop, ct.InputOutputSystem):
        if dt is None or limits is None:
            raise ValueError("dt and limits must be given with a loop")
        return AdmissibleSet(loop, limits, dt, **options)
    if not isinstance(loop, Admission):
        raise TypeError(
            "loop must be a linear control system or have references, states and fraction, as an AdmissibleSet or "
            f"a Predictor has, got {type(loop).__name__}"
        )
    if limits is not None or options:
        given = ", ".join(["limits"] * (limits is not None) + sorted(options))
        raise TypeError(
            f"{given} must be given with a linear loop only, got a {type(loop).__name__}, which has its own"
        )
    return loop
