"""Plants: parameters with units, equations of motion, flat outputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from types import SimpleNamespace
from typing import ClassVar, Literal, get_args

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, checked_finite
from ctrlplan._display import Displayed, Facts, Part
from ctrlplan._types import Array, Params, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem, flat_system
from ctrlplan.flatness.rest import note_of_rest
from ctrlplan.systems import series
from ctrlplan.systems.plants.closed_form import ClosedFormFlatSystem
from ctrlplan.systems.plants.parameters import check_parameters, defaults_of, parameters_of, values_of
from ctrlplan.systems.series import Taylor
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory

Maps = Literal["closed_form", "derived"]
"""Flat maps by formulas, or derived from the equations."""

At = Mapping[str, float] | None

_POSITIVE = 1e-12
"""Minimum of a condition, relative to its magnitude along a plan, below which it counts as 0."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Signals of a plant.

    Attributes
    ----------
    states, inputs : mapping of str to str
        Units by name.
    outputs : mapping of str to str
        Units of outputs that are not states.
    flat_outputs : tuple of str
        States or outputs that are flat.
    orders : tuple of int
        Highest derivative of each flat output in the maps.
    angles : tuple of str
        States that closed-form maps give modulo 2 pi.
    at : mapping of str to float
        Operating point, in part: the branch of the maps.
    signs : tuple of str
        States and inputs whose sign at the operating point selects a branch.
    """

    states: Mapping[str, str]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str] = field(default_factory=dict)
    flat_outputs: tuple[str, ...]
    orders: tuple[int, ...]
    angles: tuple[str, ...] = ()
    at: Mapping[str, float] = field(default_factory=dict)
    signs: tuple[str, ...] = ()


class Plant(Displayed, ABC):
    """Plant with parameters, equations of motion and flat outputs.

    All plants have this interface: `iosystem` returns the equations as a block,
    `flat_system` the flat system that `ctrlplan.flat_loop` accepts; `ctrlplan.fastest`
    and `ctrlplan.margins` accept the plant itself, with ranges of its parameters. A
    plant of your own in state-space form is derived from `StateSpacePlant`.
    """

    title: ClassVar[str]
    name: ClassVar[str]

    @property
    @abstractmethod
    def signals(self) -> Signals:
        """States, inputs and flat outputs."""

    @abstractmethod
    def iosystem(self, name: str = ...) -> ct.NonlinearIOSystem:
        """Block of the equations of motion."""

    @abstractmethod
    def closed_form(self, name: str, at: Mapping[str, float]) -> ClosedFormFlatSystem:
        """Flat system by formulas on the branch of an operating point."""

    @abstractmethod
    def check(self, plan: Trajectory) -> None:
        """Raise for a plan of the flat outputs that the plant cannot follow."""

    def quantities(self, jet: ArrayLike) -> dict[str, Array]:
        """Signals of the plant by name, from the jet of the flat outputs; see `FlatSystem.quantities`."""
        return self.flat_system().quantities(jet)

    @property
    def units(self) -> dict[str, str]:
        """Units of states, inputs and outputs by name."""
        signals = self.signals
        return {**signals.states, **signals.inputs, **signals.outputs}

    def flat_system(self, name: str | None = None, *, maps: Maps = "closed_form", at: At = None) -> FlatSystem:
        """Flat system of the plant.

        Parameters
        ----------
        name : str, optional
            Name of the system. Default: that of the plant.
        maps : {"closed_form", "derived"}, optional
            Flat maps by the formulas of the literature, or derived from the
            equations, which requires the extra ``fast``. Both agree. Laws
            with a dynamic extension use derived maps with either.
        at : mapping of str to float, optional
            Values of states and inputs that select a branch of the maps, such as
            ``{"v": -1.0}`` for a car in reverse. Default: the usual operation.

        Returns
        -------
        FlatSystem
            With the parameters of the plant, which those of a simulation override.

        Raises
        ------
        ValueError
            If `maps` is unknown, or `at` has unknown names.
        ImportError
            For derived maps without the extra ``fast``.
        """
        if maps not in get_args(Maps):
            raise ValueError(f"maps must be one of {', '.join(get_args(Maps))}, got {maps!r}")
        point = self._point(at)
        return self.closed_form(name or self.name, point) if maps == "closed_form" else self.derived(name, point)

    def derived(self, name: str | None = None, at: At = None) -> DerivedFlatSystem:
        """Flat system derived from the equations; see `flat_system`."""
        block = self.iosystem(name or self.name)
        return flat_system(block, self.signals.flat_outputs, at=self._point(at))

    def _point(self, at: At) -> dict[str, float]:
        """Operating point in part: the given values in place of the usual ones."""
        signals = self.signals
        known = [*signals.states, *signals.inputs]
        if at is not None:
            check_kind(at, "at", Mapping, "a mapping of states and inputs to values")
        for label, value in (at or {}).items():
            if label not in known:
                raise ValueError(
                    f"at must be among the states and inputs of {self.name} ({', '.join(known)}), got {label!r}"
                )
            if checked_finite(value, f"at[{label!r}]") == 0.0 and label in signals.signs:
                raise ValueError(f"at[{label!r}] must be above or below 0, which selects a branch of the maps, got 0")
        return {**signals.at, **(at or {})}

    def _describe(self) -> Iterator[Part]:
        yield self.title
        units = {entry.name: f" {entry.metadata['unit']}".rstrip() for entry in parameters_of(self)}
        rows = [(entry.name, getattr(self, entry.name)) for entry in fields(self)]  # type: ignore[arg-type]
        yield Facts(
            [
                (name.replace("_", " "), f"{value:g}{units[name]}" if name in units else str(value))
                for name, value in rows
            ]
        )
        signals = self.signals
        inputs = ", ".join(f"{name} [{unit}]" for name, unit in signals.inputs.items())
        yield f"Flat outputs: {', '.join(signals.flat_outputs)}. Inputs: {inputs}."


@dataclass(frozen=True, kw_only=True, repr=False)
class StateSpacePlant(Plant):
    """Plant in state-space form with closed-form flat maps.

    A new plant is a frozen dataclass whose fields, made by `parameter`, are its
    parameters. It must define ``title``, ``name``, `signals`, `rates` and `reverse`;
    `flat_outputs` if these are not states, and `conditions` if its maps are
    singular somewhere. The outputs of the block are the states, then the other
    flat outputs.

    Examples
    --------
    A mass on a spring:

    >>> from dataclasses import dataclass
    >>> import ctrlplan as cp
    >>> from ctrlplan.systems.plants.parameters import parameter
    >>> from ctrlplan.systems.plants.plant import Signals, StateSpacePlant
    >>> @dataclass(frozen=True, kw_only=True, repr=False)
    ... class Oscillator(StateSpacePlant):
    ...     mass: float = parameter(2.0, "kg")
    ...     stiffness: float = parameter(8.0, "N/m")
    ...     title, name = "Mass on a spring", "oscillator"
    ...     signals = Signals(
    ...         states={"y": "m", "y_d1": "m/s"}, inputs={"F": "N"}, flat_outputs=("y",), orders=(2,)
    ...     )
    ...
    ...     def rates(self, x, u, p):
    ...         return [x[1], (u[0] - p.stiffness * x[0]) / p.mass]
    ...
    ...     def reverse(self, jet, p, at):
    ...         (y,) = jet
    ...         return [y[0], y[1]], [p.mass * y[2] + p.stiffness * y[0]]
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> x, u = Oscillator(mass=3.0).flat_system().states_and_inputs(plan, [0.0, 0.5, 1.0])
    >>> u.tolist()
    [[0.0, 4.0, 8.0]]
    """

    def __post_init__(self) -> None:
        check_parameters(self)

    @abstractmethod
    def rates(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Derivatives of the states, with the parameters as attributes of `p`.

        Arguments are numbers, arrays, Taylor series or symbols.
        """

    @abstractmethod
    def reverse(
        self, jet: Value, p: SimpleNamespace, at: Mapping[str, float]
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """States and inputs; ``jet[j][k]`` is derivative k of flat output j."""

    def flat_outputs(self, x: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Flat outputs as functions of the states."""
        known = list(self.signals.states)
        return [x[known.index(name)] for name in self.signals.flat_outputs]

    def forward(self, x: Value, u: Value, p: SimpleNamespace) -> Sequence[Value]:
        """Flat outputs with their derivatives up to the orders, for constant inputs.

        From the Taylor series of the motion; a plant whose static law is simulated
        overrides it by formulas, which take less time.
        """
        orders = self.signals.orders
        state = [Taylor.constant(value) for value in x]
        for _ in range(max(orders)):  # each iteration gives one more derivative
            rates = [_as_series(rate, state[0]) for rate in self.rates(state, u, p)]
            state = [Taylor.integral(value, rate) for value, rate in zip(x, rates, strict=True)]
        return [series.to_jet(_as_series(y, state[0]).terms) for y in self.flat_outputs(state, p)]

    def conditions(self, jet: Value, p: SimpleNamespace) -> dict[str, Value]:
        """Smooth functions of the jet that must be above 0 for regular maps, by what they are."""
        return {}

    def iosystem(self, name: str | None = None) -> ct.NonlinearIOSystem:
        """Block of the equations of motion.

        The outputs are the states, then flat outputs that are not states.
        Parameters given to a simulation override those of the plant.

        Parameters
        ----------
        name : str, optional
            Name of the block. Default: that of the plant.
        """
        signals = self.signals
        block = ct.nlsys(
            partial(_update, self),
            partial(_output, self),
            states=list(signals.states),
            inputs=list(signals.inputs),
            outputs=[*signals.states, *signals.outputs],
            name=name or self.name,
            params=defaults_of(self),
        )
        return declare(block, feedthrough=False)

    def closed_form(self, name: str, at: Mapping[str, float]) -> ClosedFormFlatSystem:
        """Flat system by formulas on the branch of an operating point."""
        signals = self.signals
        system = ClosedFormFlatSystem(
            self,
            partial(_forward, self),
            partial(_reverse, self, at),
            partial(_update, self),
            partial(_output, self),
            angles=signals.angles,
            at=at,
            orders=signals.orders,
            flat_labels=signals.flat_outputs,
            states=list(signals.states),
            inputs=list(signals.inputs),
            outputs=[*signals.states, *signals.outputs],
            name=name,
            params=defaults_of(self),
        )
        return declare(system, feedthrough=False)

    def check(self, plan: Trajectory) -> None:
        """Raise for a plan of the flat outputs at which the maps are singular.

        Raises
        ------
        ValueError
            With the quantity that must be above 0, its minimum over the plan and
            the time.
        """
        p, orders = values_of(self, None), self.signals.orders

        def values(jet: Array) -> Array:
            rows = [jet[: r + 1, j] for j, r in enumerate(orders)]
            return np.stack(list(self.conditions(rows, p).values()))

        names = list(self.conditions(np.ones((len(orders), max(orders) + 1)), p))
        if not names or not plan.duration:
            return
        found = plan.extrema_of(values, max(orders))
        for name, low, high, time in zip(names, found.minimum, found.maximum, found.time_min, strict=True):
            if low <= _POSITIVE * max(abs(low), abs(high)):
                raise ValueError(
                    f"{name} of {self.name} must be above 0 along the plan, got {float(low):.4g} at {float(time):.4g} s"
                    f"{note_of_rest(plan, float(time))}"
                )


def _update(plant: StateSpacePlant, t: float, x: Value, u: Value, params: Params | None) -> Value:
    return np.array(plant.rates(x, u, values_of(plant, params)))


def _output(plant: StateSpacePlant, t: float, x: Value, u: Value, params: Params | None) -> Value:
    signals = plant.signals
    if not signals.outputs:
        return x
    flat = plant.flat_outputs(x, values_of(plant, params))
    return np.array([*x, *(flat[signals.flat_outputs.index(name)] for name in signals.outputs)])


def _forward(plant: StateSpacePlant, x: Value, u: Value, params: Params | None = None) -> list[Value]:
    """Flag of states and constant inputs."""
    return [np.array(row) for row in plant.forward(x, u, values_of(plant, params))]


def _as_series(value: Value, like: Taylor) -> Taylor:
    """A rate as a series of the order of another: an input alone is constant."""
    return value if isinstance(value, Taylor) else like * 0.0 + value


def _reverse(
    plant: StateSpacePlant, at: Mapping[str, float], flag: Value, params: Params | None = None
) -> tuple[Value, Value]:
    """States and inputs of flags, nan where the maps are singular."""
    with np.errstate(all="ignore"):
        x, u = plant.reverse(flag, values_of(plant, params), at)
    return np.array(x), np.array(u)
