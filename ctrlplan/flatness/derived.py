"""Flat systems derived from the equations of a plant and the names of its flat outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_finite, checked_params
from ctrlplan._display import Facts, Part
from ctrlplan._lru import Lru
from ctrlplan._types import Array, Params, Value
from ctrlplan.flatness.along import (
    Grid,
    at_rest,
    check_branch,
    connected,
    connected_with_neighbour,
    connected_with_neighbours,
    grid_of,
    note_of_still,
    on_branch,
    rows_of,
    states_along,
)
from ctrlplan.flatness.maps import SINGULAR, TRIALS_TOGETHER, FlatMaps, regularity
from ctrlplan.flatness.on_path import FORWARD, CurveMap
from ctrlplan.flatness.system import FlatSystem
from ctrlplan.symbolic.tape import Tape
from ctrlplan.trajectories import Repeated, Trajectory
from ctrlplan.trajectories.trajectory import check_end

if TYPE_CHECKING:
    from ctrlplan.flatness.analysis import Analysis


_PERIODIC = 1e-6
"""Difference of states one period apart, relative to their size, that is attributed to rounding."""


_STRIDE = 16
"""Number of flags of a sequence from one to the next from which the states of those between them are predicted."""

_TURN_SAMPLES = 401
"""Times at which angles along a plan are evaluated."""


class DerivedFlatSystem(FlatSystem):
    """Flat system whose maps follow from its equations.

    Attributes
    ----------
    maps : FlatMaps
        The maps, evaluated by numpy.
    operating_point : dict of str to float
        States and inputs at which the branches of the equations were chosen.
    notes : tuple of str
        Operations that are not smooth, with the branch that was chosen, and
        what else was assumed.
    """

    _paces = FORWARD  # in backward travel the inputs themselves change sign

    def __init__(
        self,
        maps: FlatMaps,
        equations: tuple[Tape, Tape, Tape, Tape],
        analysis: Analysis | None,
        *,
        flat_labels: Sequence[str],
        states: Sequence[str],
        inputs: Sequence[str],
        outputs: Sequence[str],
        operating_point: Mapping[str, float],
        params: Mapping[str, float],
        notes: Sequence[str],
        name: str,
    ) -> None:
        rates, measured, flat, slopes = equations
        self._names = tuple(params)
        super().__init__(
            self._forward,
            self._reverse,
            partial(_evaluated, rates, self._names),
            partial(_evaluated, measured, self._names),
            orders=maps.orders,
            flat_labels=flat_labels,
            states=states,
            inputs=inputs,
            outputs=outputs,
            name=name,
            params=params,
        )
        self.maps = maps
        self._outputs, self._flat, self._slopes = measured, flat, slopes
        self._equations, self._analysis = equations, analysis
        self.operating_point = dict(operating_point)
        self.notes = tuple(notes)
        self._plans: Lru[int, tuple[Trajectory, Trajectory]] = Lru(8)
        self._grids: Lru[tuple[int, bytes, bytes], tuple[Trajectory, Grid]] = Lru(8)

    def __getstate__(self) -> dict[str, object]:
        """State for a pickle: the maps, without the expressions from which laws are derived."""
        return {**self.__dict__, "_analysis": None}

    @property
    def derived(self) -> DerivedFlatSystem:
        """The same object."""
        return self

    @property
    def analysis(self) -> Analysis:
        """Expressions of the maps.

        Raises
        ------
        ValueError
            If the system was read from a pickle, which does not contain them.
        """
        if self._analysis is None:
            raise ValueError(
                f"{self.name} must have its equations for a tracking law, but a pickle has the maps only; derive it "
                "again with ctrlplan.flat_system in this process"
            )
        return self._analysis

    def with_params(self, params: Mapping[str, float]) -> DerivedFlatSystem:
        """Same plant with other values of parameters.

        Parameters
        ----------
        params : mapping of str to float
            Values by name; the others stay. The operating point stays, too.

        Raises
        ------
        ValueError
            If a name is unknown, or a value is not finite.
        """
        return DerivedFlatSystem(
            self.maps,
            self._equations,
            self._analysis,
            flat_labels=self.flat_labels,
            states=self.state_labels,
            inputs=self.input_labels,
            outputs=self.output_labels,
            operating_point=self.operating_point,
            params=dict(zip(self._names, self._values(params).tolist(), strict=True)),
            notes=self.notes,
            name=str(self.name),
        )

    def _describe(self) -> Iterator[Part]:
        yield from super()._describe()
        at = ", ".join(f"{name} = {value:.6g}" for name, value in self.operating_point.items())
        yield Facts([("operating point", at), *(("note", note) for note in self.notes)])

    def matched(self, plan: Trajectory) -> Trajectory:
        """Plan with the axes in the order of the flat outputs; the same object at each call."""
        return self._plans.get(id(plan), lambda: (plan, super(DerivedFlatSystem, self).matched(plan)))[1]

    def _states_and_inputs(self, plan: Trajectory, times: Array, start: Array | None) -> tuple[Array, Array]:
        """States and inputs along a plan.

        The states are connected with the operating point, or with `start` at the
        plan's start, and followed along the plan, also through points where a
        map by formulas would need another branch (a car that turns round). The
        result does not depend on the other times of a call.
        """
        plan, times = self._folded(plan, times)
        p = self.parameter_values()
        first = None if start is None else self._extended(start, plan, p)
        jet = plan.jet(times, max(self.orders))
        z, u = states_along(self.maps, self._grid(plan, p, first), jet, times, p, str(self.name))
        self._check_determined(z[: self.maps.nstates], u, plan, times)
        return z[: self.maps.nstates], u

    def _points(self) -> list[tuple[Array, Array]]:
        """States and inputs near the operating point."""
        rng, maps = np.random.default_rng(0), self.maps
        x = maps.start[: maps.nstates]
        u = maps.controls(maps.start[:, None], maps.mu[:, None], self.parameter_values())[:, 0]
        sizes = (maps.scales[: maps.nstates], np.maximum(np.abs(u), 1.0))
        near = [rng.uniform(-0.2, 0.2, (2, size.size)) * size for size in sizes]
        return [(x + dx, u + du) for dx, du in zip(*near, strict=True)]

    def _curve_map(self, curve: Trajectory, direction: int, start: Array | None) -> tuple[CurveMap, int]:
        """Map along a curve at unit pace, and that pace: followed along the curve, forward or backward by its start."""
        p = self.parameter_values()
        if start is None:
            along, _ = super()._curve_map(curve, direction, None)
            s = curve.breakpoints[:1]
            start = along(curve.jet(s, max(self.orders)), s)[0][:, 0]
        grid = self._grid(curve, p, self._extended(start, curve, p))

        def along_grid(jet: Array, s: Array) -> tuple[Array, Array]:
            z, u = states_along(self.maps, grid, jet, s, p, str(self.name))
            return z[: self.maps.nstates], u

        return along_grid, 1

    def _check_determined(self, x: Array, u: Array, plan: Trajectory, times: Array) -> None:
        super()._check_determined(x, u, plan, times)
        check_branch(self.maps, x, u, self.parameter_values(), times, str(self.name))

    def extension_along(self, plan: Trajectory, time: float) -> Array:
        """States of the extension (extension,) at a time of a plan."""
        return self.extended_along(plan, time)[self.maps.nstates :, 0]

    def extended_along(self, plan: Trajectory, timepts: ArrayLike) -> Array:
        """States (nstates + extension, ntime) of the extended plant."""
        plan, times = self._folded(*self._along(plan, timepts, None))
        p, jet = self.parameter_values(), plan.jet(times.ravel(), max(self.orders))
        z, u = states_along(self.maps, self._grid(plan, p, None), jet, times.ravel(), p, str(self.name))
        self._check_determined(z[: self.maps.nstates], u, plan, times.ravel())
        return z

    def linearised(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """Jacobians of the rates.

        Returns
        -------
        tuple of ndarray, shapes (nstates, nstates) and (nstates, ninputs)
            By states and by inputs.
        """
        n = self.maps.nstates
        found = self._slopes(np.asarray(x, dtype=float), np.asarray(u, dtype=float), self.parameter_values())
        return found[:, :n], found[:, n:]

    @property
    def flat_map(self) -> Callable[..., Sequence[Value]]:
        """Flat outputs as a function of (t, x, u, params)."""
        return partial(_evaluated, self._flat, self._names)

    def quantities(self, jet: ArrayLike) -> dict[str, Array]:
        """States, inputs and outputs by name; see `FlatSystem`."""
        values, known = self._checked_jet(jet)
        if not np.isfinite(values).all():
            raise ValueError("jet must be finite, got nan or inf")
        return self._quantities(values, known, None)

    def feasible_quantities(self, jets: ArrayLike) -> dict[str, Array]:
        """Signals by name along several plans, nan where undetermined.

        Parameters
        ----------
        jets : array_like, shape (order + 1, nflat, nplans, ntime)
            Derivatives of the flat outputs along each plan, as for `quantities`.

        Returns
        -------
        dict of str to ndarray, shape (nplans, ntime)
        """
        values, known = self._checked_jet(jets)
        return self._quantities(values, known, np.repeat(np.arange(values.shape[2]), values.shape[3]))

    def _quantities(self, values: Array, known: bool, groups: NDArray[np.intp] | None) -> dict[str, Array]:
        """Signals by name of a jet whose last derivatives are known or not; `groups` as for `_states`."""
        below, _, last = rows_of(values, self.orders)
        p = self._values(self.params)
        trailing = below.shape[1:]
        z = self._states_or_nan(below.reshape(len(below), -1), p, groups)
        x = z[: self.maps.nstates]
        if known:
            found = self.signals(x, self.maps.inputs_of(z, last.reshape(len(last), -1), p)[1])
        else:
            found = dict(zip(self.state_labels, x, strict=True))
        return {name: row.reshape(trailing) for name, row in found.items()}

    def signals(self, x: Array, u: Array) -> dict[str, Array]:
        """States, inputs and outputs by name; see `FlatSystem`."""
        p = self.parameter_values()
        # Another branch of operations that are not smooth: not determined by the maps.
        u = np.where(on_branch(self.maps, x, u, p), u, np.nan)
        outputs = np.broadcast_to(self._outputs(x, u, p[:, None]), (len(self.output_labels), x.shape[1]))
        return dict(zip(self.output_labels, outputs, strict=True)) | super().signals(x, u)

    def _folded(self, plan: Trajectory, times: Array) -> tuple[Trajectory, Array]:
        """Plan with an end, and times; of one that repeats for all future times, its first pass.

        The states along the repeated part must be periodic.
        """
        if not isinstance(plan, Repeated) or plan.count is not None:
            return plan, times
        ends, p = np.array([plan.since, plan.plan.end]), self.parameter_values()
        jet, grid = plan.plan.jet(ends, max(self.orders)), self._grid(plan.plan, p, None)
        z = states_along(self.maps, grid, jet, ends, p, str(self.name))[0]
        apart = np.abs(z[:, 1] - z[:, 0])
        if not (apart <= _PERIODIC * (np.abs(z).max(axis=1) + self.maps.scales[: len(z)])).all():
            check_end(plan, f"a plan along which states of {self.name} are not periodic")
        return plan.plan, plan.first_pass(times.ravel()).reshape(times.shape)

    def check_limits(self, plan: Trajectory, names: Set[str]) -> None:
        """Raise for limits of angles that turn too far along a plan.

        A jet does not state the number of turns: an angle must stay within half a turn
        of the operating point.

        Parameters
        ----------
        plan : Trajectory
            Plan of the flat outputs.
        names : set of str
            Limited signals.
        """
        angles = zip(self.state_labels, self._angles[: self.maps.nstates].tolist(), strict=True)
        limited = [k for k, (name, is_angle) in enumerate(angles) if is_angle and name in names]
        if not limited:
            return
        x = self.states_and_inputs(plan, np.linspace(plan.start, plan.end, _TURN_SAMPLES))[0]
        turned = np.abs(x - self.maps.start[: self.maps.nstates, None]).max(axis=1)
        for k in limited:
            if turned[k] >= math.pi:
                raise ValueError(
                    f"{self.state_labels[k]} must stay within half a turn of the operating point to be limited, got "
                    f"{turned[k]:.4g} rad; limit the parts of the plan one by one with at= for each, or evaluate "
                    "states_and_inputs"
                )

    def _grid(self, plan: Trajectory, p: Array, start: Array | None) -> Grid:
        """Grid of a plan, kept for the next call."""
        key = (id(plan), p.tobytes(), b"" if start is None else start.tobytes())
        return self._grids.get(key, lambda: (plan, grid_of(self.maps, plan, p, start, str(self.name))))[1]

    def parameter_values(self) -> Array:
        """Default parameters in the order of the maps."""
        return self._values(self.params)

    def _values(self, params: Mapping[str, float] | None) -> Array:
        """Parameters in the order of the maps."""
        given = {**self.params, **checked_params(params)}
        for name in given:
            if name not in self._names:
                known = ", ".join(self._names) or "none"
                raise ValueError(f"params must be among the parameters of {self.name} ({known}), got {name!r}")
        return np.array([checked_finite(given[name], f"params[{name!r}]") for name in self._names], dtype=float)

    def _forward(self, x: ArrayLike, u: ArrayLike, params: Mapping[str, float] | None = None) -> list[Array]:
        """Flags of states and constant inputs, all up to the highest order, as python-control requires."""
        state, inputs = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        if (state.shape[:1], inputs.shape[:1]) != ((self.nstates,), (self.ninputs,)):
            raise ValueError(
                f"x and u must be {self.nstates} states and {self.ninputs} inputs, got shapes {state.shape} and "
                f"{inputs.shape}"
            )
        rows = self.maps.forward(state, inputs, self._values(params))
        return list(np.split(rows, len(self.orders)))

    def _reverse(self, flag: Sequence[ArrayLike], params: Mapping[str, float] | None = None) -> tuple[Array, Array]:
        """States and inputs of flags, connected with the operating point."""
        rows = [np.asarray(row, dtype=float) for row in flag]
        if len(rows) != len(self.orders) or any(len(row) <= r for row, r in zip(rows, self.orders, strict=True)):
            wanted = ", ".join(f"{r + 1} of {label}" for label, r in zip(self.flat_labels, self.orders, strict=True))
            raise ValueError(f"flag must be {wanted} entries, got {', '.join(str(len(row)) for row in rows)}")
        below = np.concatenate([row[:r] for row, r in zip(rows, self.orders, strict=True)])
        last = np.stack([row[r] for row, r in zip(rows, self.orders, strict=True)])
        p = self._values(params)
        z = self._states(below.reshape(len(below), -1), p)
        u = self.maps.inputs_of(z, last.reshape(len(last), -1), p)[1]
        check_branch(self.maps, z[: self.maps.nstates], u, p, np.full(z.shape[1], np.nan), str(self.name))
        trailing = below.shape[1:]
        return z[: self.maps.nstates].reshape(-1, *trailing), u.reshape(-1, *trailing)

    def _states(self, flags: Array, p: Array, groups: NDArray[np.intp] | None = None) -> Array:
        """Extended states (nz, n) of flags (nz, n), connected with the operating point.

        Those of some flags of a long sequence first, from which those between them are
        predicted. Angles are continuous from each flag to the next. With `groups` (n,),
        numbers that increase, nan for all flags of a group of which one is not connected,
        instead of an error.
        """
        z, count = np.full(flags.shape, np.nan), flags.shape[1]
        lost = np.zeros(count, dtype=bool)
        if count > 2 * _STRIDE:
            nodes = np.append(np.arange(0, count - 1, _STRIDE), count - 1)
            z[:, nodes] = self._connected(z[:, nodes], flags[:, nodes], p, None if groups is None else groups[nodes])
            if groups is not None:
                lost = np.isin(groups, groups[nodes][np.isnan(z[0, nodes])])
            self._predict(z, flags, ~lost, p)
        rest = np.flatnonzero(~lost)
        z[:, rest] = self._connected(z[:, rest], flags[:, rest], p, None if groups is None else groups[rest])
        z[:, lost] = np.nan
        finite = np.isfinite(z[0])
        turning = np.ix_(self._angles, finite)
        z[turning] = np.unwrap(z[turning])
        return z

    def _predict(self, z: Array, flags: Array, wanted: NDArray[np.bool_], p: Array) -> None:
        """Fill in extended states (nz, n) that are predicted from the nearest known ones, as long as some are found."""
        left = np.flatnonzero(wanted & np.isnan(z[0]))
        known = np.flatnonzero(~np.isnan(z[0]))
        while left.size:
            after = np.minimum(np.searchsorted(known, left), known.size - 1)
            before = np.maximum(after - 1, 0)
            near = known[np.where(np.abs(known[before] - left) <= np.abs(known[after] - left), before, after)]
            sources, which = np.unique(near, return_inverse=True)
            trial, found = self.maps.predicted(z[:, sources], flags[:, sources], flags[:, left], which, p)
            found = self._determined(trial, found, flags[:, left], p)
            if not found.any():
                return
            z[:, left[found]] = trial[:, found]
            known, left = np.union1d(known, left[found]), left[~found]

    def _connected(self, z: Array, flags: Array, p: Array, groups: NDArray[np.intp] | None = None) -> Array:
        """Extended states (nz, n) of flags (nz, n), of which some are known: the others are nan."""
        maps, z = self.maps, z.copy()
        left = np.flatnonzero(np.isnan(z[0]))
        starts = np.repeat(maps.start[:, None], z.shape[1], axis=1)
        while left.size:
            trial, found = maps.refined(starts[:, left], flags[:, left], p)
            found = self._determined(trial, found & maps.same_side(trial, p), flags[:, left], p)
            z[:, left[found]] = trial[:, found]
            left = left[~found]
            if left.size > 1:
                trial, found = maps.followed_together(starts[:, left], flags[:, left], p, TRIALS_TOGETHER)
                z[:, left[found]] = trial[:, found]
                left = left[~found]
            if not left.size:
                break
            if groups is None:
                k = left[:1]
                z[:, k] = self._connected_alone(z, flags, int(k[0]), p)[:, None]
                starts[:, left] = z[:, k]
                left = left[1:]
                continue
            own, first, place = np.unique(groups[left], return_index=True, return_inverse=True)
            k = left[first]
            before = np.where(np.isfinite(z[:, k - 1]) & (groups[k - 1] == own) & (k > 0), z[:, k - 1], starts[:, k])
            trial, found = connected_with_neighbours(maps, flags[:, k], p, before)
            z[:, k] = np.where(found, trial, np.nan)
            starts[:, left] = trial[:, place]
            z[:, np.isin(groups, own[~found])] = np.nan
            left = np.setdiff1d(left[found[place]], k)
        return z

    def _connected_alone(self, z: Array, flags: Array, k: int, p: Array) -> Array:
        """Extended state of one of several flags, connected with the one before it."""
        maps, name = self.maps, str(self.name)
        try:
            if k:
                return connected_with_neighbour(maps, flags[:, k], p, z[:, k - 1], name)
            return connected(maps, flags[:, k], p, maps.start, name, np.nan)
        except ValueError as error:
            raise ValueError(f"{error}{note_of_still(maps.orders, flags[:, k])}") from None

    def _determined(self, z: Array, found: NDArray[np.bool_], flags: Array, p: Array) -> NDArray[np.bool_]:
        """Which found states (nz, n) are determined by their flags; at rest many may have the same flag."""
        found = found.copy()
        for j in np.flatnonzero(found & at_rest(self.maps.orders, flags)):
            found[j] = self._is_regular(z[:, j], p)
        return found

    def _states_or_nan(self, flags: Array, p: Array, groups: NDArray[np.intp] | None = None) -> Array:
        """Extended states (nz, n) of flags (nz, n); nan at rest if they are not determined there."""
        still = at_rest(self.maps.orders, flags)
        z = np.full(flags.shape, np.nan)
        if not still.all():
            z[:, ~still] = self._states(flags[:, ~still], p, None if groups is None else groups[~still])
        if still.any():
            with suppress(ValueError):
                z[:, still] = self._states(flags[:, still], p, None if groups is None else groups[still])
        return z

    def _is_regular(self, z: Array, p: Array) -> bool:
        """Whether the flags determine an extended state."""
        maps = self.maps
        peaks = np.abs(maps.slopes(maps.start, p) * maps.scales).max(axis=1)
        return regularity(maps.slopes(z, p) * maps.scales, peaks) >= SINGULAR

    @cached_property
    def _angles(self) -> NDArray[np.bool_]:
        """States of the extended plant that are angles."""
        return self.maps.angles(self.parameter_values())

    def _extended(self, state: Array, plan: Trajectory, p: Array) -> Array:
        """Extended state at the start of a plan for a given state of the plant."""
        maps = self.maps
        jet = plan.jet(np.array([plan.start]), max(self.orders))
        flag = rows_of(jet, self.orders)[0][:, 0]
        z = np.concatenate([state, maps.start[maps.nstates :]])
        # The states of the extension that are nearest to the flag.
        for _ in range(50):
            slopes = maps.slopes(z, p)[:, maps.nstates :]
            step = np.linalg.lstsq(slopes, flag - maps.flags(z, p), rcond=None)[0] if slopes.size else np.empty(0)
            z[maps.nstates :] += step
            if not step.size or np.max(np.abs(step) / (maps.scales[maps.nstates :])) < 1e-12:
                break
        if not self._is_regular(z, p):
            raise ValueError(
                f"start must be a state of {self.name} that the flat outputs determine, got one where "
                f"{maps.weakest(z, p)} is not determined; give the state at the plan's start"
            )
        return z


def _evaluated(tape: Tape, names: Sequence[str], t: float, x: Value, u: Value, params: Params) -> Value:
    """Result of a tape as a function of a block, of numbers or symbols."""
    return np.array(tape.at((x, u, [params[name] for name in names])))
