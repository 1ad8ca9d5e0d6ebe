"""Adapter of plants for planning: signals of a system as functions of the jet of a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from ctrlplan._renamed import renamed_argument
from ctrlplan.trajectories import PathPlan, Trajectory
from ctrlplan.trajectories.common import Array

Quantities = Callable[[Array], Mapping[str, Array]]
"""Maps a jet (order + 1, naxes, ntime) to signals (ntime,) by name."""


class Response(Protocol):
    """Signals of a loop along one plan; see `ctrlplan.simulation.loop_response.LoopResponse`."""

    def extremes(
        self,
        weights: Mapping[str, float],
        *,
        during: tuple[float, float] | None = None,
        rate: bool = False,
        line: tuple[float, float] | None = None,
    ) -> Extremes:
        """Minimum and maximum of a weighted sum of signals minus a line, and their times."""

    def rms(self, name: str, period: float | None = None) -> float:
        """Root of the mean square of a signal."""

    def ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Values at rest before the plan and in steady state after it; nan if not known."""

    def values(self, weights: Mapping[str, float], times: Array, *, rate: bool = False) -> Array:
        """Weighted sum of signals at times during the plan."""


class Extremes(Protocol):
    """Minimum and maximum, and their times [s]."""

    @property
    def low(self) -> float:
        """Minimum."""

    @property
    def high(self) -> float:
        """Maximum."""

    @property
    def time_low(self) -> float:
        """Time of the minimum."""

    @property
    def time_high(self) -> float:
        """Time of the maximum."""


class Loop(Protocol):
    """Protocol of a loop whose signals depend on the whole plan."""

    @property
    def names(self) -> Sequence[str]:
        """Inputs, outputs and exposed states."""

    @property
    def inputs(self) -> Sequence[str]:
        """Inputs in order."""

    @property
    def note(self) -> str:
        """How the signals are computed."""

    def quantities_of(self, plan: Trajectory, *, refined: bool = True) -> Response:
        """Signals along a plan; extrema of a simulated one may be those of samples."""


class ShapesOf(Protocol):
    """Signals of a loop along plans of one shape; see `ctrlplan.simulation.shape_family.ShapeFamily`."""

    def step(self) -> tuple[Array, Array, Array]:
        """Minima and maxima for a step, and rates by which those of a short plan differ per second."""

    def static(self) -> tuple[Array, Array]:
        """Minima and maxima (nsignals,) that the signals approach for long durations, nan if there are none."""

    def from_static(self, durations: Array) -> Array:
        """Bounds (ndurations, nsignals) of the distance from the signals that are approached for long durations."""

    def samples(self, durations: Array) -> Array:
        """Values (ndurations, nsignals, nsamples)."""

    def curvature(self, low: Array, high: Array) -> Array:
        """Bounds (nintervals, nsignals) of the second derivative by the logarithm of the duration."""

    def extremes(self, duration: float) -> tuple[Array, Array, Array, Array]:
        """Minima, maxima (nsignals,) and their times [s] since the start."""

    def value(self, duration: float, signal: int, time: float) -> tuple[float, float]:
        """Minimum and maximum of a signal at a time [s] since the start."""


class Shapes(Protocol):
    """Protocol of a loop with a fast response to plans of one shape."""

    def shapes_of(
        self, plan: Trajectory, signals: Sequence[tuple[Mapping[str, float], bool, tuple[float, float] | None]]
    ) -> ShapesOf:
        """Weighted sums of signals, or their rates, within fractions of the plan, as functions of its duration."""


class HasQuantities(Protocol):
    """Protocol of plants whose signals are functions of the jet of a plan, such as a flat system or a crane."""

    @property
    def quantities(self) -> Quantities:
        """Method or function from a jet to signals by name."""


class HasRates(Protocol):
    """Protocol of signals as functions of a jet that know their time derivatives."""

    def __call__(self, jet: Array) -> Mapping[str, Array]:
        """Signals (ntime,) by name of a jet (order + 1, naxes, ntime)."""

    def rates(self, jet: Array) -> Mapping[str, Array]:
        """Time derivatives (ntime,) of signals by name, of a jet with one order more."""


System = Quantities | HasQuantities
"""Argument of `fastest` and `margins`; or a control.flatsys.FlatSystem."""


def quantities_of(system: Any) -> Quantities | None:
    """Function from the jet to the signals of a system by name; None for None.

    Parameters
    ----------
    system : flat system, plant with a method `quantities`, or callable, optional
        For a `control.flatsys.FlatSystem` without that method, states and inputs
        are evaluated by its reverse map, one time after the other.

    Raises
    ------
    TypeError
        If `system` is none of these.
    ValueError
        If the maps of a flat system are inconsistent, or it is in discrete time.
    """
    if system is None:
        return None
    if not isinstance(system, type):
        own = getattr(system, "quantities", None)
        if callable(own):
            return own
        if hasattr(system, "forward") and hasattr(system, "reverse"):
            from ctrlplan.flatness.quantities import quantities_of_flat_system

            return quantities_of_flat_system(system)
        if callable(system) and not hasattr(system, "ninputs"):  # python-control's systems are callable
            return system
    raise TypeError(
        "system must be a flat system, a plant with a method quantities (as Crane has), a loop, or a function of a "
        f"jet, got {f'the class {system.__name__}' if isinstance(system, type) else type(system).__name__}"
    )


def feasible_quantities_of(system: Any) -> Quantities | None:
    """Function from jets of several plans to signals that are nan for infeasible plans; None if there is none.

    The shapes are (order + 1, naxes, nplans, ntime) and (nplans, ntime).
    """
    own = getattr(system, "feasible_quantities", None)
    return own if callable(own) and not isinstance(system, type) else None


def path_quantities(system: Any, plan: Trajectory) -> HasRates | None:
    """Function from the jet of `PathPlan.with_coordinate` to the signals of a vehicle; None for others.

    Parameters
    ----------
    system : object
        System of the limited signals.
    plan : Trajectory
        The plan; a `PathPlan` and a flat system, or a plant with a method
        ``flat_system``, are evaluated through the path parameter, for any time law.

    Raises
    ------
    ValueError
        If the inputs of a flat system do not set its pace, or states are not
        determined along the path.
    """
    if not isinstance(plan, PathPlan) or isinstance(system, type):
        return None
    own = getattr(system, "flat_system", None)
    flat = own() if callable(own) else system
    if not (hasattr(flat, "forward") and hasattr(flat, "reverse")):
        return None
    from ctrlplan.flatness.quantities import QuantitiesOnPath

    return QuantitiesOnPath(flat, plan)


def loop_of(system: Any, tail: float | None = None) -> Loop | None:
    """Signals of a loop along plans; None for a system of another kind.

    Parameters
    ----------
    system : object
        A loop of python-control that is not a flat system, or an object with a
        method ``quantities_of(plan)``.
    tail : float, optional
        Time [s] after a plan for which a loop is simulated.
    """
    if system is None or isinstance(system, type):
        return None
    if callable(getattr(system, "quantities_of", None)):
        return system
    flat = callable(getattr(system, "quantities", None)) or (hasattr(system, "forward") and hasattr(system, "reverse"))
    if flat or not hasattr(system, "ninputs"):
        return None
    from ctrlplan.simulation.quantities_of_loops import loop_quantities

    return loop_quantities(system, tail=tail)


def shapes_given(loop: Any) -> Shapes | None:
    """The loop, if its response to plans of one shape is known as a function of the duration."""
    return loop if callable(getattr(loop, "shapes_of", None)) else None


def system_given(system: System | None, quantities: System | None) -> System | None:
    """The argument ``system``, or its deprecated name ``quantities``."""
    return renamed_argument("quantities", quantities, "system", system)
