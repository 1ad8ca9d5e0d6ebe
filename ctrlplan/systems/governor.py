"""Reference governor: it lets through as much of what is asked for as keeps every limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn, Protocol, runtime_checkable

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_seconds, checked_time
from ctrlplan._types import EventName, Params, System, Value
from ctrlplan.systems.admissible import AdmissibleSet, Limits
from ctrlplan.systems.exposed import state_signals
from ctrlplan.systems.hybrid import refuse_alone
from ctrlplan.traits import DeclaredTrait, declare

Array = NDArray[np.float64]


@runtime_checkable
class Admission(Protocol):
    """What a governor asks: an `AdmissibleSet`, a `ctrlplan.Predictor`, or an object of the user's.

    Attributes
    ----------
    references : sequence of str
        Inputs of the loop that are governed.
    states : sequence of str
        States of the loop, as it labels them.
    """

    @property
    def references(self) -> Sequence[str]:
        """Inputs of the loop that are governed."""

    @property
    def states(self) -> Sequence[str]:
        """States of the loop, as it labels them."""

    def fraction(self, x: Array, v: Array, r: Array) -> float:
        """Largest kappa in [0, 1] for which v + kappa (r - v), held from state x on, is admissible; nan if none is."""


class Governor(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Reference governor; made by `create_governor_iosystem`.

    Attributes
    ----------
    admission : Admission
        What says how far a reference may go.
    period, offset : float
        Samples are taken at offset, offset + period, ... [s] after the run begins.
    initial : ndarray, shape (nreferences,)
        Reference before the first sample.
    """

    period = DeclaredTrait[float]()
    offset = DeclaredTrait[float]()

    def __init__(self, admission: Admission, period: float, offset: float, initial: Array, name: str) -> None:
        references = list(admission.references)
        super().__init__(
            self._no_rates,
            self._held,
            inputs=[*(f"{label}_cmd" for label in references), *state_signals(admission.states)],
            outputs=references,
            states=[*(f"{label}_offset" for label in references), "fraction", "refused", "unread"],
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
                EventName(f"{name}: nothing admissible, reference held"): (_refused, -math.inf, 0.5),
                EventName(f"{name}: input lost, reference held"): (_unread, -math.inf, 0.5),
            },
        )
        self._count = len(references)

    def sample(self, t: float, x: Array, u: Array, params: Params) -> Array:
        """States after a sample: the reference moved as far as is admissible."""
        n = self._count
        if not np.isfinite(u).all():
            return np.array([*x[:n], 0.0, 0.0, 1.0])
        held, asked = x[:n] + self.initial, u[:n]
        kappa = float(self.admission.fraction(u[n:], held, asked))
        if math.isnan(kappa):
            return np.array([*x[:n], 0.0, 1.0, 0.0])
        # The whole way is what was asked for itself, without a rounding error.
        moved = asked if kappa == 1.0 else held + kappa * (asked - held)
        return np.array([*(moved - self.initial), kappa, 0.0, 0.0])

    def _held(self, t: float, x: Value, u: Value, params: Params) -> Value:
        return np.array([x[k] + value for k, value in enumerate(self.initial.tolist())])

    def _no_rates(self, t: float, x: Value, u: Value, params: Params) -> NoReturn:
        refuse_alone(self.name, "takes samples")


def create_governor_iosystem(
    loop: System,
    dt: float | None = None,
    limits: Limits | None = None,
    *,
    initial: ArrayLike = 0.0,
    offset: float = 0.0,
    name: str = "governor",
    **options: Value,
) -> Governor:
    """Reference governor in front of a closed loop.

    Every period the reference moves towards what is asked for,
    v+ = v + kappa (r - v), by the largest kappa in [0, 1] for which the loop,
    with v+ held from now on, keeps its limits for ever. What is admissible
    passes unchanged, kappa = 1. Where nothing is, not even holding, or an input
    is not finite, v is held, and a run by `ctrlplan.simulate` records it as an
    event. What a step of the reference sets off at once, as the derivative of
    the error in a PID, makes every step small: take the derivative of the
    output, or put `create_command_filter_iosystem` behind the governor.

    Inputs: what is asked for, ``<reference>_cmd``, then the states of the
    loop as `expose_states` puts them out. Outputs: the references, by the
    loop's names, held between samples. States: the references as offsets from
    `initial`; fraction, the last kappa, 0 where v was held; refused and unread,
    1 while that is so.

    Parameters
    ----------
    loop : control system or Admission
        A linear loop; or an `AdmissibleSet`, a `ctrlplan.Predictor` for
        nonlinear loops, or any object with `references`, `states` and `fraction`.
    dt : float, optional
        Period [s], above 0: that of the admissible set unless given.
    limits : mapping of str to (float, float), optional
        Least and greatest value of each limited output of a linear loop.
    initial : array_like, optional
        Reference before the first sample, one for all or one each; it must be admissible where the run begins.
    offset : float, optional
        Time of the first sample after a run begins [s], from 0.
    name : str, optional
        Name of the block.
    **options
        For the `AdmissibleSet` of a linear loop: references, margin,
        disturbances, origin.

    Returns
    -------
    Governor
        A continuous `control.NonlinearIOSystem`, which `ctrlplan.simulate` runs.

    Raises
    ------
    TypeError
        If `loop` is none of these, or limits or options are given beside something that has its own.
    ValueError
        If `dt` is missing or is not that of the set, `initial` does not fit, or the
        `AdmissibleSet` refuses; the reason is in the message.

    References
    ----------
    E. G. Gilbert, I. Kolmanovsky, K. T. Tan, "Discrete-time reference governors
    and the nonlinear control of systems with state and control constraints",
    Int. J. Robust Nonlinear Control 5 (1995) 487-504.

    Examples
    --------
    A step that would ask for five times the control there is:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    >>> governor = cp.create_governor_iosystem(loop, 0.05, {"u": (-1.0, 1.0)})
    >>> governed = ct.interconnect([governor, cp.expose_states(loop)], inputs=["r_cmd"], outputs=["y", "u", "r"])
    >>> found = cp.simulate(governed, np.linspace(0.0, 15.0, 301), {"r_cmd": cp.Step(1.0)})
    >>> y, u, r = found.outputs
    >>> round(float(np.abs(u).max()), 6), round(float(y[-1]), 3), round(float(r[0]), 3), float(r[-1])
    (0.999, 1.0, 0.2, 1.0)
    >>> found.state_labels[:2]
    ['governor_r_offset', 'governor_fraction']
    """
    admission = _admission(loop, dt, limits, options)
    own = getattr(admission, "dt", None)
    given = own if dt is None else dt
    if given is None:
        raise ValueError("dt must be given, the period in s")
    period = checked_time(given, "dt", positive=True)
    if own is not None and abs(period - own) > 1e-12 * own:
        raise ValueError(f"dt must be the period of the admissible set, {own:g} s, got {period:g} s")
    start = checked_seconds(offset, "offset", positive=False)
    count = len(admission.references)
    before = np.asarray(initial, dtype=float)
    if before.shape not in ((), (count,)) or not np.isfinite(before).all():
        raise ValueError(f"initial must be a finite number or {count} of them, got {initial!r}")
    return Governor(admission, period, start, np.broadcast_to(before, (count,)).copy(), name)


def _admission(loop: System, dt: float | None, limits: Limits | None, options: dict[str, Value]) -> Admission:
    if isinstance(loop, ct.InputOutputSystem):
        if dt is None or limits is None:
            raise ValueError("dt and limits must be given beside a loop")
        return AdmissibleSet(loop, limits, dt, **options)
    if not isinstance(loop, Admission):
        raise TypeError(
            "loop must be a linear control system or have references, states and fraction, as an AdmissibleSet or "
            f"a Predictor has, got {type(loop).__name__}"
        )
    if limits is not None or options:
        given = ", ".join(["limits"] * (limits is not None) + sorted(options))
        raise TypeError(f"{given} must go with a loop, got a {type(loop).__name__}, which has its own")
    return loop


def _refused(t: Value, x: Value, u: Value, params: Params) -> Value:
    return x[-2]


def _unread(t: Value, x: Value, u: Value, params: Params) -> Value:
    return x[-1]
