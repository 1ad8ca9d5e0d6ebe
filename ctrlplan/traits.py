"""What a block declares to the simulation.

python-control knows of a block its equations, its signals and its time base.
What else `ctrlplan.simulate` should know, the block declares: times at which
its equations jump, direct feedthrough, a sample period, a start state. Nothing
else is read off a block: an attribute that happens to be called ``delay`` or
``period`` means nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

S = TypeVar("S")

_ATTRIBUTE = "_ctrlplan_traits"


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockTraits:
    """Declared properties of a block; set by `declare`, read by `traits_of`.

    Attributes
    ----------
    breakpoints : tuple of float, or None
        Times [s] at which the equations of the block may jump or bend, as a
        pulse or a switch in t does: the integrator stops there. None (default)
        where they are not known: switches are looked for where the block can be
        compiled; otherwise, if its functions read t, no step is longer than the
        distance of two sample times.
    feedthrough : None, bool or ndarray of bool, shape (noutputs, ninputs)
        Which outputs depend directly on which inputs; None (default) where it
        is not known.
    initial_state : ndarray, shape (nstates,), or None
        State at which a run starts unless `simulate` is given one. Default None: 0.
    longest : float
        Longest step from stop to stop [s] that the block allows. Default: infinite.
    watched : mapping of str to (callable, float, float)
        Signals of the block whose limits are recorded as events: name, function
        of (t, x, u, params), time last, lower and upper limit. Default: none.
    period : float or None
        Time between samples [s] of a block that is discrete in a continuous
        loop; needs `sample`. Default None: the block is continuous.
    offset : float
        Time of the first sample [s] after the run begins. Default 0.
    sample : callable or None
        Function of (t, x, u, params) that returns the state after a sample, as
        (nstates,). Between samples the state is held and ``outfcn`` gives the outputs.
    samples_first : bool
        Whether the block is sampled before the other blocks that are due.
        Default False.
    plan : Trajectory or None
        Trajectory that the outputs follow, axis by axis with its derivatives;
        such a block has neither states nor inputs.
    derivatives : int
        Highest derivative of the plan among the outputs. Default 0.
    delay : float or None
        Time [s] by which the outputs are the inputs delayed; such a block has
        no states.
    initial : float or ndarray, shape (ninputs,)
        Outputs of a delay before the first input has passed. Default 0.
    block : control system or None
        System inside, whose changes are changes of this block.
    """

    breakpoints: tuple[float, ...] | None = None
    feedthrough: bool | NDArray[np.bool_] | None = None
    initial_state: NDArray[np.float64] | None = None
    longest: float = math.inf
    watched: Mapping[str, tuple[Callable[..., Any], float, float]] | None = None
    period: float | None = None
    offset: float = 0.0
    sample: Callable[..., Any] | None = None
    samples_first: bool = False
    plan: Any = None
    derivatives: int = 0
    delay: float | None = None
    initial: ArrayLike = 0.0
    block: Any = None


_NAMES = tuple(field.name for field in fields(BlockTraits))
_NONE = BlockTraits()


def declare(system: S, **traits: Any) -> S:
    """Declare traits of a block to `ctrlplan.simulate`.

    Traits declared before stay unless they are given again.

    Parameters
    ----------
    system : control system
        Block that is declared; python-control ignores the declaration.
    **traits
        Fields of `BlockTraits` by name.

    Returns
    -------
    control system
        The same object.

    Raises
    ------
    TypeError
        If a trait is unknown or of the wrong kind.
    ValueError
        If a value does not fit the block.

    Examples
    --------
    A torque that is applied for one second, and a controller without direct
    feedthrough:

    >>> import control as ct
    >>> import ctrlplan as cp
    >>> pulse = ct.nlsys(None, lambda t, x, u, params: [1.0 if 2 <= t < 3 else 0.0], inputs=0, outputs="torque", dt=0)
    >>> cp.traits_of(cp.declare(pulse, breakpoints=[2, 3])).breakpoints
    (2.0, 3.0)

    A block that counts samples, every 0.1 s:

    >>> def count(t, x, u, params):
    ...     return [x[0] + 1]
    >>> counter = ct.nlsys(lambda t, x, u, params: [0.0], lambda t, x, u, params: x, inputs=0, outputs="n", states="n")
    >>> response = cp.simulate(cp.declare(counter, period=0.1, sample=count, feedthrough=False), [0.0, 0.25, 0.5])
    >>> response.outputs[0].tolist()
    [1.0, 3.0, 6.0]
    """
    for name in traits:
        if name not in _NAMES:
            raise TypeError(f"traits must be among {', '.join(_NAMES)}, got {name!r}")
    found = replace(traits_of(system), **{name: _checked(name, value, system) for name, value in traits.items()})
    label = _label(system)
    if (found.period is None) != (found.sample is None):
        raise ValueError(f"period and sample of {label} must be declared together")
    _check_kind(system, traits, label)
    _check_function_of_time(found, system, label)
    setattr(system, _ATTRIBUTE, found)
    return system


def traits_of(system: Any) -> BlockTraits:
    """Traits that a block has declared; the defaults where it has declared none.

    Parameters
    ----------
    system : control system

    Returns
    -------
    BlockTraits

    Examples
    --------
    >>> import ctrlplan as cp
    >>> plan = cp.Step(1.0, time=2.0)
    >>> cp.traits_of(cp.create_source_iosystem(plan)).plan is plan
    True
    """
    # Of the object itself: a class or a foreign __getattr__ declares nothing.
    found = getattr(system, "__dict__", {}).get(_ATTRIBUTE, _NONE)
    return found if isinstance(found, BlockTraits) else _NONE


class DeclaredTrait:
    """Attribute of a block class that reads and sets a declared trait of the same name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, block: Any, owner: type | None = None) -> Any:
        return self if block is None else getattr(traits_of(block), self._name)

    def __set__(self, block: Any, value: Any) -> None:
        declare(block, **{self._name: value})


def _check_kind(system: Any, traits: Mapping[str, Any], label: str) -> None:
    """Raise where a trait would have no effect on a system of this kind."""
    if isinstance(system, ct.NonlinearIOSystem) and not isinstance(system, ct.InterconnectedSystem | ct.StateSpace):
        return
    if not isinstance(system, ct.InputOutputSystem):
        raise TypeError(f"system must be a control system, got {type(system).__name__}")
    inner = isinstance(system, ct.InterconnectedSystem)
    for name in traits:
        if name != "initial_state":
            what = "an interconnection: declare it on its block" if inner else "a linear system: make a nonlinear block"
            raise TypeError(f"{name} has no effect on {label}, {what}")


def _check_function_of_time(traits: BlockTraits, system: Any, label: str) -> None:
    """Raise unless a delay, or the source of a plan, has the signals that belong to it."""
    if traits.delay is None and traits.plan is None:
        return
    if traits.delay is not None and traits.plan is not None:
        raise ValueError(f"{label} must be a delay or the source of a plan, got both")
    inputs, outputs, states = system.ninputs or 0, system.noutputs, system.nstates or 0
    wanted = inputs if traits.delay is not None else traits.plan.naxes * (traits.derivatives + 1)
    if states or outputs != wanted or (traits.plan is not None and inputs):
        kind = "a delay" if traits.delay is not None else f"the source of a plan with {traits.derivatives} derivatives"
        raise ValueError(
            f"{label} must have no states and as many signals as {kind} has, got {inputs} inputs, {outputs} outputs "
            f"and {states} states"
        )


def _checked(name: str, value: Any, system: Any) -> Any:
    label = f"{name} of {_label(system)}"
    check = _CHECKS.get(name)
    return value if check is None else check(value, label, system)


def _label(system: Any) -> str:
    return str(getattr(system, "name", None) or type(system).__name__)


def _seconds(value: Any, label: str) -> float:
    if isinstance(value, bool | str) or not np.isrealobj(value):
        raise TypeError(f"{label} must be a number of seconds, got {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{label} must be a number of seconds, got {value!r}") from None


def _breakpoints(value: Any, label: str, system: Any) -> tuple[float, ...] | None:
    if value is None:
        return None
    entries = value if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) else [value]
    times = sorted({_seconds(entry, label) for entry in entries})
    if not all(map(math.isfinite, times)):
        raise ValueError(f"{label} must be finite times, got {value!r:.80}")
    return tuple(times)


def _feedthrough(value: Any, label: str, system: Any) -> bool | NDArray[np.bool_] | None:
    if value is None or isinstance(value, bool | np.bool_):
        return value if value is None else bool(value)
    found = np.asarray(value)
    shape = (system.noutputs, system.ninputs or 0)
    if found.dtype.kind != "b" or found.shape != shape:
        raise ValueError(f"{label} must be True, False or truth values of shape {shape}, got {value!r:.80}")
    found = found.copy()
    found.flags.writeable = False
    return found


def _initial_state(value: Any, label: str, system: Any) -> NDArray[np.float64] | None:
    if value is None:
        return None
    found, count = np.asarray(value, dtype=float), system.nstates or 0
    if found.shape not in ((), (count,)) or not np.isfinite(found).all():
        raise ValueError(f"{label} must be a finite number or {count} of them, got {value!r:.80}")
    found = np.broadcast_to(found, (count,)).copy()
    found.flags.writeable = False
    return found


def _positive(value: Any, label: str, system: Any) -> float | None:
    if value is None:
        return None
    found = _seconds(value, label)
    if not found > 0.0:
        raise ValueError(f"{label} must be above 0 s, got {value}")
    return found


def _offset(value: Any, label: str, system: Any) -> float:
    found = _seconds(value, label)
    if not 0.0 <= found < math.inf:
        raise ValueError(f"{label} must be finite and at least 0 s, got {value}")
    return found


def _function(value: Any, label: str, system: Any) -> Any:
    if value is not None and not callable(value):
        raise TypeError(f"{label} must be a function of (t, x, u, params), got {value!r:.80}")
    return value


def _watched(value: Any, label: str, system: Any) -> Mapping[str, Any] | None:
    for name, entry in (value or {}).items():
        if len(entry) != 3 or not callable(entry[0]) or not float(entry[1]) < float(entry[2]):
            raise ValueError(
                f"{label} must map names to (function, low, high), low below high, got {name!r}: {entry!r:.80}"
            )
    return dict(value) if value else None


_CHECKS: dict[str, Callable[[Any, str, Any], Any]] = {
    "breakpoints": _breakpoints,
    "feedthrough": _feedthrough,
    "initial_state": _initial_state,
    "longest": _positive,
    "watched": _watched,
    "period": _positive,
    "offset": _offset,
    "sample": _function,
    "delay": _positive,
}
