"""Flat systems of plants by formulas, with angles that are continuous along a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._lru import Lru
from ctrlplan._types import Array, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem
from ctrlplan.flatness.on_path import CurveMap
from ctrlplan.trajectories import Trajectory

if TYPE_CHECKING:
    from ctrlplan.systems.plants.plant import Plant

_TURN = 2.0 * np.pi

_INTERVALS = 64
"""Intervals between breakpoints in which turns are counted at first."""

_HALVINGS = 30
"""Maximum number of halvings of an interval."""


class ClosedFormFlatSystem(FlatSystem):
    """Flat system of a plant of `ctrlplan.plants`, with closed-form maps.

    The maps give angles in [-pi, pi]; `states_and_inputs` makes them continuous
    along a plan, which it checks as a whole, also between the times given.

    Parameters
    ----------
    plant : Plant
        The plant.
    forward, reverse, updfcn, outfcn, **options
        As for `FlatSystem`.
    angles : sequence of str, optional
        States that are angles.
    at : mapping of str to float, optional
        Operating point, in part: the branch of the maps.

    Attributes
    ----------
    operating_point : dict of str to float
        Values of states and inputs that select the branch of the maps.
    """

    def __init__(
        self,
        plant: Plant,
        forward: Callable[..., Value],
        reverse: Callable[..., Value],
        updfcn: Callable[..., Value],
        outfcn: Callable[..., Value],
        *,
        angles: Sequence[str] = (),
        at: Mapping[str, float] | None = None,
        orders: Sequence[int],
        flat_labels: Sequence[str],
        states: Sequence[str],
        inputs: Sequence[str],
        outputs: Sequence[str],
        name: str,
        params: Mapping[str, float],
        quantities: Callable[[ArrayLike], dict[str, Array]] | None = None,
    ) -> None:
        super().__init__(
            forward,
            reverse,
            updfcn,
            outfcn,
            orders=orders,
            flat_labels=flat_labels,
            states=states,
            inputs=inputs,
            outputs=outputs,
            name=name,
            params=params,
            quantities=quantities,
        )
        self.plant = plant
        self.operating_point = dict(at or {})
        self._angles = [list(states).index(label) for label in angles]
        self._plans: Lru[int, tuple[Trajectory, Array, Array]] = Lru(8)

    @cached_property
    def derived(self) -> DerivedFlatSystem:
        """The same plant with maps derived from its equations, for laws (extra ``fast``)."""
        return self.plant.derived(str(self.name), self.operating_point)

    def with_params(self, params: Mapping[str, float]) -> FlatSystem:
        """Same plant with other values of parameters.

        Parameters
        ----------
        params : mapping of str to float
            Values by name; the others stay.

        Raises
        ------
        ValueError
            If a name is unknown, or a value is out of its range.
        """
        for name in params:
            if name not in self.params:
                known = ", ".join(self.params)
                raise ValueError(f"params must be among the parameters of {self.name} ({known}), got {name!r}")
        plant: Any = self.plant  # a dataclass
        other: Plant = replace(plant, **params)
        return other.flat_system(str(self.name), at=self.operating_point)

    def _states_and_inputs(self, plan: Trajectory, times: Array, start: Array | None) -> tuple[Array, Array]:
        """States and inputs along a plan, of which the whole is checked; angles are continuous.

        They begin with a value in [-pi, pi] or, with `start`, nearest to that of `start`.
        """
        _, nodes, angles = self._plans.get(id(plan), lambda: (plan, *self._followed(plan)))
        x, u = super()._states_and_inputs(plan, times, start)
        return self._turned(x, times, nodes, angles, start), u

    def _curve_map(self, curve: Trajectory, direction: int, start: Array | None) -> tuple[CurveMap, int]:
        """Map along a curve at unit pace with continuous angles, and that pace."""
        along, pace = super()._curve_map(curve, direction, start)
        nodes, angles = self._continuous(curve, along)

        def continuous(jet: Array, s: Array) -> tuple[Array, Array]:
            x, u = along(jet, s)
            return self._turned(x, s, nodes, angles, start), u

        return continuous, pace

    def _followed(self, plan: Trajectory) -> tuple[Array, Array]:
        """Nodes (n,) of a plan and the continuous angles (nangles, n) there."""
        self.plant.check(plan)
        return self._continuous(plan, super()._curve_map(plan, 1, None)[0])

    def _continuous(self, plan: Trajectory, along: CurveMap) -> tuple[Array, Array]:
        """Nodes between which no angle changes by more than an eighth of a turn, and the continuous angles there."""
        if not (self._angles and plan.duration):
            return np.array([plan.start]), np.zeros((len(self._angles), 1))

        def angles(times: Array) -> Array:
            return np.asarray(along(plan.jet(times, max(self.orders)), times)[0])[self._angles]

        nodes = np.unique([np.linspace(a, b, _INTERVALS + 1) for a, b in pairwise(plan.breakpoints)])
        values = angles(nodes)
        for _ in range(_HALVINGS):
            change = np.abs(_within_half_turn(np.diff(values, axis=1))).max(axis=0)
            split = np.flatnonzero(change > _TURN / 8.0)
            if not split.size:
                break
            middle = 0.5 * (nodes[split] + nodes[split + 1])
            nodes = np.insert(nodes, split + 1, middle)
            values = np.insert(values, split + 1, angles(middle), axis=1)
        steps = _within_half_turn(np.diff(values, axis=1))
        return nodes, np.concatenate([values[:, :1], values[:, :1] + np.cumsum(steps, axis=1)], axis=1)

    def _turned(self, x: Array, times: Array, nodes: Array, angles: Array, start: Array | None) -> Array:
        """States with angles near those at the nodes, which begin near those of a start."""
        x = np.array(x)
        for row, values in zip(self._angles, angles, strict=True):
            near = np.interp(times, nodes, values)
            if start is not None:
                near = near + _nearest_turns(float(start[row]) - values[0])
            x[row] += _nearest_turns(near - x[row])
        return x


def _nearest_turns(angle: Value) -> Value:
    """Whole turns nearest to an angle."""
    return _TURN * np.round(angle / _TURN)


def _within_half_turn(angle: Array) -> Array:
    """Angle without whole turns."""
    return np.asarray(angle - _nearest_turns(angle))
