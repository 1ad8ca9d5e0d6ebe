"""Declared properties of blocks for the simulation.

A block of python-control has equations, signals and a time base. Further
properties that `ctrlplan.simulate` uses are declared: times at which the equations
jump, direct feedthrough, a sample period, an initial state. Other attributes of a
block, such as ``delay`` or ``period``, are not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Generic, Self, SupportsFloat, TypeAlias, TypeVar, overload

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._display import Displayed, Facts, Part

if TYPE_CHECKING:
    from ctrlplan.trajectories import Trajectory

S = TypeVar("S")
T = TypeVar("T")
BlockFunction: TypeAlias = Callable[..., ArrayLike]
"""(t, x, u, params) of a block -> values."""
Watched: TypeAlias = Mapping[str, tuple[BlockFunction, float, float]]
"""Name -> (function of (t, x, u, params), lower and upper limit)."""

_ATTRIBUTE = "_ctrlplan_traits"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class BlockTraits(Displayed):
    """Declared properties of a block; see `declare` and `traits_of`.

    Attributes
    ----------
    breakpoints : tuple of float, or None
        Times [s] at which the equations of the block may be discontinuous or
        not smooth in t, such as the edges of a pulse: the integrator stops there.
        None (default) if unknown: switches are then detected if the block can be
        compiled; otherwise, if its functions depend on t, steps are at most as
        long as the distance of two sample times.
    feedthrough : None, bool or ndarray of bool, shape (noutputs, ninputs)
        Direct feedthrough from inputs to outputs; None (default) if unknown.
    initial_state : ndarray, shape (nstates,), or None
        Initial state unless one is passed to `simulate`. Default None: 0.
    longest : float
        Maximum step of the integrator [s]. Default: infinite.
    watched : mapping of str to (callable, float, float)
        Signals of the block of which limit violations are recorded as events:
        function of (t, x, u, params) with time last, lower and upper limit, by
        name. Default: none.
    period : float or None
        Sample period [s] of a discrete-time block in a continuous-time loop;
        requires `sample`. Default None: the block is in continuous time.
    offset : float
        Time of the first sample [s] after the start of the simulation. Default 0.
    sample : callable or None
        Function of (t, x, u, params) that returns the state (nstates,) after a
        sample. Between samples the state is constant and ``outfcn`` gives the
        outputs.
    samples_first : bool
        Whether the block is sampled before other blocks with the same sample
        time. Default False.
    plan : Trajectory or None
        Trajectory of the outputs, axis by axis with derivatives; such a block has
        neither states nor inputs.
    derivatives : int
        Highest derivative of the plan in the outputs. Default 0.
    delay : float or None
        Delay [s] from the inputs to the outputs; such a block has no states.
    initial : float or ndarray, shape (ninputs,)
        Outputs of a delay until the first delayed input. Default 0.
    block : control system or None
        Inner system, whose changes are changes of this block.
    start : float or None
        Time [s] at which a feedforward command starts to move, `preview` before its
        plan. A run from the declared initial state must begin there or earlier; a
        discrete block must have a sample there. Default None.
    preview : float or None
        Time [s] by which a feedforward command starts before its plan. Default None.
    """

    breakpoints: tuple[float, ...] | None = None
    feedthrough: bool | NDArray[np.bool_] | None = None
    initial_state: NDArray[np.float64] | None = None
    longest: float = math.inf
    watched: Watched | None = None
    period: float | None = None
    offset: float = 0.0
    sample: BlockFunction | None = None
    samples_first: bool = False
    plan: Trajectory | None = None
    derivatives: int = 0
    delay: float | None = None
    initial: ArrayLike = 0.0
    block: ct.InputOutputSystem | None = None
    start: float | None = None
    preview: float | None = None

    def _describe(self) -> Iterator[Part]:
        stated = {name: getattr(self, name) for name in _NAMES}
        stated = {name: value for name, value in stated.items() if value is not getattr(_NONE, name)}
        yield f"BlockTraits: {', '.join(stated) or 'none declared'}"
        yield Facts([(name, _shown(value)) for name, value in stated.items()])


def _shown(value: object) -> str:
    """Value of a trait: a name for what is a function or a block."""
    if isinstance(value, Mapping):
        return ", ".join(map(str, value))
    return str(getattr(value, "__name__", None) or getattr(value, "name", None) or repr(value))


_NAMES = tuple(field.name for field in fields(BlockTraits))
_NONE = BlockTraits()


def declare(system: S, **traits: object) -> S:
    """Declare properties of a block for `ctrlplan.simulate`.

    Previously declared traits remain unless they are given again.

    Parameters
    ----------
    system : control system
        Block; python-control ignores the declaration.
    **traits
        Fields of `BlockTraits` by name.

    Returns
    -------
    control system
        The same object.

    Raises
    ------
    TypeError
        If a trait is unknown or of the wrong type.
    ValueError
        If a value is not valid for the block.

    Examples
    --------
    A block with breakpoints. A force acts for one second. Its jumps are declared, so
    that the integrator stops there, for any sample times:

    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> def force(t, x, u, params):
    ...     return 1.0 if 2 <= t < 3 else 0.0
    >>> pulse = cp.declare(ct.nlsys(None, force, inputs=0, outputs="F", name="pulse"), breakpoints=[2, 3])
    >>> mass = ct.tf([1], [1, 0], inputs="F", outputs="v", name="mass")
    >>> loop = ct.interconnect([pulse, mass], inputs=0, outputs="v")
    >>> cp.simulate(loop, [0, 10, 20]).outputs.round(9).tolist()
    [[0.0, 1.0, 1.0]]

    A sampled block. A PI controller computes its output every 0.1 s and holds it
    in between. `sample` returns the states after a sample, here the output and
    the integrated error; ``outfcn`` gives the output between samples, without
    direct feedthrough:

    >>> def sample(t, x, u, params):
    ...     error = u[0] - u[1]
    ...     total = x[1] + 0.1 * params["ki"] * error
    ...     return [params["kp"] * error + total, total]
    >>> controller = ct.nlsys(
    ...     lambda t, x, u, params: [0.0, 0.0],
    ...     lambda t, x, u, params: x[0],
    ...     inputs=["r", "y"], outputs="u", states=["output", "total"], params={"kp": 2.0, "ki": 1.0}, name="pi",
    ... )
    >>> controller = cp.declare(controller, period=0.1, sample=sample, feedthrough=False)
    >>> plant = ct.tf([1], [1, 1], inputs="u", outputs="y", name="plant")
    >>> loop = ct.interconnect([controller, plant], inputs="r", outputs=["y", "u"])
    >>> response = cp.simulate(loop, np.linspace(0, 10, 201), 1.0)
    >>> response.outputs["u"][:4].round(4).tolist()
    [2.1, 2.1, 1.7803, 1.7803]

    A block without direct feedthrough. The output of an observer is an estimate,
    computed by a function of states and measurements together with other values.
    Whether it depends on the input is not known from the code: without the
    declaration trial calls are required to exclude an algebraic loop:

    >>> def observer(x, u, params):
    ...     return x, 3.0 * (u - x)  # estimate, and its rate
    >>> filtered = ct.nlsys(
    ...     lambda t, x, u, params: observer(x, u, params)[1],
    ...     lambda t, x, u, params: observer(x, u, params)[0],
    ...     inputs="y", outputs="estimate", states="estimate", name="observer",
    ... )
    >>> filtered = cp.declare(filtered, feedthrough=False)
    >>> difference = ct.ss([], [], [], [[1, -1]], inputs=["r", "estimate"], outputs="y", name="difference", dt=None)
    >>> loop = ct.interconnect([filtered, difference], inputs="r", outputs="estimate")
    >>> cp.simulate(loop, [0.0, 0.5, 10.0], 1.0).outputs.round(4).tolist()  # (1 - exp(-6 t))/2
    [0.0, 0.4751, 0.5]
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


def traits_of(system: object) -> BlockTraits:
    """Declared traits of a block, or the defaults.

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
    # Of the object itself, not of its class or by __getattr__.
    found = getattr(system, "__dict__", {}).get(_ATTRIBUTE, _NONE)
    return found if isinstance(found, BlockTraits) else _NONE


class DeclaredTrait(Generic[T]):
    """Attribute of a block class for the declared trait of the same name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, block: None, owner: type) -> Self: ...

    @overload
    def __get__(self, block: object, owner: type | None = None) -> T: ...

    def __get__(self, block: object | None, owner: type | None = None) -> Self | T:
        return self if block is None else getattr(traits_of(block), self._name)

    def __set__(self, block: object, value: T) -> None:
        declare(block, **{self._name: value})


_OF_ANY_SYSTEM = frozenset({"initial_state", "start", "preview"})
"""Traits that interconnections and linear systems have as well."""


def _check_kind(system: ct.InputOutputSystem, traits: Mapping[str, object], label: str) -> None:
    """Raise if a trait has no effect on a system of this type."""
    if isinstance(system, ct.NonlinearIOSystem) and not isinstance(system, ct.InterconnectedSystem | ct.StateSpace):
        return
    if not isinstance(system, ct.InputOutputSystem):
        raise TypeError(f"system must be a control system, got {type(system).__name__}")
    inner = isinstance(system, ct.InterconnectedSystem)
    for name in traits:
        if name not in _OF_ANY_SYSTEM:
            what = "an interconnection: declare it for its block" if inner else "a linear system: use a nonlinear block"
            raise TypeError(f"{name} has no effect on {label}, {what}")


def _check_function_of_time(traits: BlockTraits, system: ct.InputOutputSystem, label: str) -> None:
    """Raise unless a delay or the source of a plan has the required signals."""
    if traits.delay is None and traits.plan is None:
        return
    if traits.delay is not None and traits.plan is not None:
        raise ValueError(f"{label} must be a delay or the source of a plan, got both")
    inputs, outputs, states = system.ninputs or 0, system.noutputs, system.nstates or 0
    wanted = inputs if traits.plan is None else traits.plan.naxes * (traits.derivatives + 1)
    if states or outputs != wanted or (traits.plan is not None and inputs):
        kind = "a delay" if traits.delay is not None else f"the source of a plan with {traits.derivatives} derivatives"
        raise ValueError(
            f"{label} must have no states and the signals of {kind}, got {inputs} inputs, {outputs} outputs "
            f"and {states} states"
        )


def _checked(name: str, value: object, system: ct.InputOutputSystem) -> Any:  # type of the field
    label = f"{name} of {_label(system)}"
    check = _CHECKS.get(name)
    return value if check is None else check(value, label, system)


def _label(system: ct.InputOutputSystem) -> str:
    return str(getattr(system, "name", None) or type(system).__name__)


def _seconds(value: object, label: str) -> float:
    if isinstance(value, bool | str) or not isinstance(value, SupportsFloat) or np.asarray(value).dtype.kind == "c":
        raise TypeError(f"{label} must be a number of seconds, got {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{label} must be a number of seconds, got {value!r}") from None


def _breakpoints(value: object, label: str, system: ct.InputOutputSystem) -> tuple[float, ...] | None:
    if value is None:
        return None
    entries = value if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) else [value]
    times = sorted({_seconds(entry, label) for entry in entries})
    if not all(map(math.isfinite, times)):
        raise ValueError(f"{label} must be finite times, got {value!r:.80}")
    return tuple(times)


def _feedthrough(value: object, label: str, system: ct.InputOutputSystem) -> bool | NDArray[np.bool_] | None:
    if value is None or isinstance(value, bool | np.bool_):
        return value if value is None else bool(value)
    found = np.asarray(value)
    shape = (system.noutputs, system.ninputs or 0)
    if found.dtype.kind != "b" or found.shape != shape:
        raise ValueError(f"{label} must be True, False or truth values of shape {shape}, got {value!r:.80}")
    found = found.copy()
    found.flags.writeable = False
    return found


def _initial_state(value: ArrayLike | None, label: str, system: ct.InputOutputSystem) -> NDArray[np.float64] | None:
    if value is None:
        return None
    found, count = np.asarray(value, dtype=float), system.nstates or 0
    if found.shape not in ((), (count,)) or not np.isfinite(found).all():
        raise ValueError(f"{label} must be a finite number or {count} of them, got {value!r:.80}")
    found = np.broadcast_to(found, (count,)).copy()
    found.flags.writeable = False
    return found


def _positive(value: object, label: str, system: ct.InputOutputSystem) -> float | None:
    if value is None:
        return None
    found = _seconds(value, label)
    if not found > 0.0:
        raise ValueError(f"{label} must be above 0 s, got {value}")
    return found


def _offset(value: object, label: str, system: ct.InputOutputSystem) -> float:
    found = _seconds(value, label)
    if not 0.0 <= found < math.inf:
        raise ValueError(f"{label} must be finite and at least 0 s, got {value}")
    return found


def _time(value: object, label: str, system: ct.InputOutputSystem) -> float | None:
    if value is None:
        return None
    found = _seconds(value, label)
    if not math.isfinite(found):
        raise ValueError(f"{label} must be finite, got {value}")
    return found


def _function(value: object, label: str, system: ct.InputOutputSystem) -> object:
    if value is not None and not callable(value):
        raise TypeError(f"{label} must be a function of (t, x, u, params), got {value!r:.80}")
    return value


def _watched(value: Watched | None, label: str, system: ct.InputOutputSystem) -> Watched | None:
    for name, entry in (value or {}).items():
        if len(entry) != 3 or not callable(entry[0]) or not float(entry[1]) < float(entry[2]):
            raise ValueError(
                f"{label} must map names to (function, low, high), low below high, got {name!r}: {entry!r:.80}"
            )
    return dict(value) if value else None


_CHECKS: dict[str, Callable[[Any, str, ct.InputOutputSystem], object]] = {
    "breakpoints": _breakpoints,
    "feedthrough": _feedthrough,
    "initial_state": _initial_state,
    "longest": _positive,
    "watched": _watched,
    "period": _positive,
    "offset": _offset,
    "sample": _function,
    "delay": _positive,
    "start": _time,
    "preview": _time,
}
