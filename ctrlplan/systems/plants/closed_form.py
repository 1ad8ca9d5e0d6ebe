"""Flat systems of plants by formulas, with angles that are continuous along a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._lru import Lru
from ctrlplan._types import Array, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem
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
    along a plan. A plan is checked as a whole, also between the times given.

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
        self._plans: Lru[int, tuple[Trajectory, Trajectory, tuple[Array, Array]]] = Lru(8)

    @cached_property
    def derived(self) -> DerivedFlatSystem:
        """The same plant with maps derived from its equations, for laws (extra ``fast``)."""
        return self.plant.derived(str(self.name), self.operating_point)

    def states_and_inputs(
        self, plan: Trajectory, timepts: ArrayLike, *, start: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """States and inputs along a plan; see `FlatSystem`.

        Angles are continuous along the plan, from a value in [-pi, pi] at its start
        or, with `start`, from the value nearest to that of `start`.

        Raises
        ------
        TypeError, ValueError
            As for `FlatSystem`, and if the maps are singular somewhere on the plan,
            also between the times given.
        """
        known = self._plans.get(id(plan), lambda: self._followed(plan))
        x, u = super().states_and_inputs(known[1], timepts, start=start)
        nodes, turned = known[2]
        for row, values in zip(self._angles, turned, strict=True):
            near = np.interp(np.asarray(timepts, dtype=float), nodes, values)
            if start is not None:
                near = near + _nearest_turns(float(np.asarray(start, dtype=float)[row]) - values[0])
            x[row] += _nearest_turns(near - x[row])
        return x, u

    def _followed(self, plan: Trajectory) -> tuple[Trajectory, Trajectory, tuple[Array, Array]]:
        """A plan, itself with the axes in order, and its angles (nangles, n) at nodes (n,)."""
        matched = self.matched(plan)
        self.plant.check(matched)
        if not (self._angles and matched.duration):
            return plan, matched, (np.array([matched.start]), np.zeros((len(self._angles), 1)))
        return plan, matched, self._turned(matched)

    def _turned(self, plan: Trajectory) -> tuple[Array, Array]:
        """Nodes between which no angle changes by more than an eighth of a turn, and the continuous angles there."""
        nodes = np.unique([np.linspace(a, b, _INTERVALS + 1) for a, b in pairwise(plan.breakpoints)])
        values = self._principal(plan, nodes)
        for _ in range(_HALVINGS):
            change = np.abs(_within_half_turn(np.diff(values, axis=1))).max(axis=0)
            split = np.flatnonzero(change > _TURN / 8.0)
            if not split.size:
                break
            middle = 0.5 * (nodes[split] + nodes[split + 1])
            nodes = np.insert(nodes, split + 1, middle)
            values = np.insert(values, split + 1, self._principal(plan, middle), axis=1)
        steps = _within_half_turn(np.diff(values, axis=1))
        return nodes, np.concatenate([values[:, :1], values[:, :1] + np.cumsum(steps, axis=1)], axis=1)

    def _principal(self, plan: Trajectory, times: Array) -> Array:
        """Angles (nangles, n) as the maps give them."""
        jet = plan.jet(times, max(self.orders))
        x, _ = self.reverse([jet[: r + 1, j] for j, r in enumerate(self.orders)], self.params)
        return np.asarray(x)[self._angles]


def _nearest_turns(angle: Value) -> Value:
    """Whole turns nearest to an angle."""
    return _TURN * np.round(angle / _TURN)


def _within_half_turn(angle: Array) -> Array:
    """Angle without whole turns."""
    return np.asarray(angle - _nearest_turns(angle))
