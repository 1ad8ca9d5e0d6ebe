"""States and controls along a plan of the flat outputs.

The states are followed along a grid of the plan, which depends on the plan only;
between the nodes they are interpolated and refined, all times in one call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan._display import time_text
from ctrlplan._types import Array
from ctrlplan.flatness.maps import TRIALS, TRIALS_TOGETHER, FlatMaps, SingularError, inverses
from ctrlplan.flatness.rest import ADVICE, note_of_rest
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.trajectory import check_end

_INTERVALS = 48
"""Intervals of the first grid."""

_PREDICTED = 3e-4
"""Error of the interpolation in scales above which an interval is halved."""

_SINGULAR = 1e-7
"""Smallest singular value of a scaled Jacobian below which it is singular."""

_SEARCHES = 8
"""Refinements of the search for a singular point."""

_MINIMA = 8
"""Local minima at the nodes among which a singular point is searched for."""

_DETOUR = 200
"""Maximum number of steps along one side of a detour."""

_DEEPEST = 24
"""Number of halvings of an interval."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Extended states along a plan.

    Attributes
    ----------
    times : ndarray, shape (n,)
        Nodes, from the start to the end of the plan.
    states, rates : ndarray, shape (nz, n)
        States at the nodes, and their derivatives from the right.
    rates_before : ndarray, shape (nz, n)
        Derivatives from the left.
    inverses : ndarray, shape (nz, nz, n)
        Inverses of the Jacobians of the flags.
    """

    times: Array
    states: Array
    rates: Array
    rates_before: Array
    inverses: Array

    def interpolated(self, t: Array) -> tuple[Array, Array]:
        """States (nz, n) and inverse Jacobians (nz, nz, n) at times between the nodes.

        States by cubic Hermite polynomials, inverses linearly.
        """
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, self.times.size - 2)
        a, b = self.times[k], self.times[k + 1]
        states = _hermite(
            t,
            a,
            b,
            *(
                rows[:, i]
                for rows, i in ((self.states, k), (self.states, k + 1), (self.rates, k), (self.rates_before, k + 1))
            ),
        )
        part = (t - a) / (b - a)
        return states, (1.0 - part) * self.inverses[:, :, k] + part * self.inverses[:, :, k + 1]


def flag_at(plan: Trajectory, orders: tuple[int, ...], t: Array) -> tuple[Array, Array, Array]:
    """Flags without the last entries (nz, n), their derivatives, and the last entries (m, n)."""
    jet = plan.jet(t, max(orders))
    return rows_of(jet, orders)


def rows_of(jet: Array, orders: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Entries of a jet (order + 1, m, ...) as flags, their derivatives, and the last entries."""
    below = np.concatenate([jet[:r, j] for j, r in enumerate(orders)])
    above = np.concatenate([jet[1 : r + 1, j] for j, r in enumerate(orders)])
    return below, above, np.stack([jet[r, j] for j, r in enumerate(orders)])


def grid_of(maps: FlatMaps, plan: Trajectory, p: Array, start: Array | None, name: str) -> Grid:
    """Grid of extended states along a plan, connected with a start.

    Raises
    ------
    ValueError
        With the time and the state that the flat outputs do not determine.
    """
    check_end(plan)
    first, last = float(plan.start), float(plan.end)
    if last <= first:  # a plan at rest
        last = first + 1.0
    nodes = np.union1d(np.linspace(first, last, _INTERVALS + 1), [t for t in plan.breakpoints if first < t < last])
    try:
        z = connected(maps, flag_at(plan, maps.orders, nodes[:1])[0][:, 0], p, start, name, first)
    except ValueError as error:
        raise ValueError(f"{error}{note_of_rest(plan, first)}") from None
    states = [z]
    flags = flag_at(plan, maps.orders, nodes)[0]

    def path(t: float) -> Array:
        return flag_at(plan, maps.orders, np.array([t]))[0][:, 0]

    for k, (a, b) in enumerate(zip(nodes[:-1].tolist(), nodes[1:].tolist(), strict=True)):
        near = maps.followed_simply(states[-1], flags[:, k], flags[:, k + 1], p)
        if near is None:
            try:
                near = maps.followed(states[-1], path, p, a, b)
            except SingularError as error:
                raise _undetermined(name, error, plan) from None
        states.append(near)
    return _halved(maps, plan, p, nodes, np.array(states).T, name)


def _undetermined(name: str, error: SingularError, plan: Trajectory) -> ValueError:
    """Error for a plan that does not determine the states at a time."""
    return ValueError(
        f"states of {name} must be determined along the plan, but {error} at {error.position:.6g} s"
        f"{note_of_rest(plan, error.position)}"
    )


def connected(maps: FlatMaps, flag: Array, p: Array, start: Array | None, name: str, time: float) -> Array:
    """State of a flag, connected with the operating point or a given state by regular flags.

    The path is a straight line or, where that passes a singular point (a vehicle
    that turns round), the first of a fixed list of detours.
    """
    z = maps.start if start is None else start
    return _connected(maps, flag, p, z, max(maps.orders), _DETOUR, f"{name}{_when(time)}")


def connected_with_neighbour(maps: FlatMaps, flag: Array, p: Array, z: Array, name: str) -> Array:
    """State of a flag, connected with that of the flag before it in a sequence.

    Detours are tried in first derivatives only, and given up early: sequences of
    plans that are infeasible for the plant are tried in large numbers.
    """
    return _connected(maps, flag, p, z, 2, _DETOUR // 5, name)


def connected_with_neighbours(maps: FlatMaps, flags: Array, p: Array, z: Array) -> tuple[Array, NDArray[np.bool_]]:
    """States (nz, n) of flags (nz, n), each connected with a given one, and which were found.

    As `connected_with_neighbour`, all together.
    """
    trial, found = maps.followed_together(z, flags, p, TRIALS_TOGETHER)
    left = np.flatnonzero(~found)
    detours = list(_detours(maps.orders, maps.flags(z[:, left], p), flags[:, left], 2)) if left.size else []
    if not detours:
        return trial, found
    count, trials = len(detours), _DETOUR // 5
    between, good = maps.followed_together(np.tile(z[:, left], count), np.concatenate(detours, axis=1), p, trials)
    ways = np.flatnonzero(good)
    ends, good[ways] = maps.followed_together(between[:, ways], flags[:, np.tile(left, count)[ways]], p, trials)
    for k in reversed(range(count)):  # the first of them that is found
        own = np.flatnonzero(good[ways] & (ways // left.size == k))
        trial[:, left[ways[own] % left.size]] = ends[:, own]
    found[left] = good.reshape(count, -1).any(axis=0)
    return trial, found


def _connected(maps: FlatMaps, flag: Array, p: Array, z: Array, orders: int, trials: int, name: str) -> Array:
    try:
        return _straight(maps, z, flag, p)
    except SingularError as error:
        for detour in _detours(maps.orders, maps.flags(z, p), flag, orders):
            try:
                return _straight(maps, _straight(maps, z, detour, p, trials), flag, p, trials)
            except SingularError:
                continue
        raise ValueError(
            f"states of {name} must be connected with the operating point, but {error}; give start= or "
            "another operating point at="
        ) from None


def _straight(maps: FlatMaps, z: Array, flag: Array, p: Array, trials: int = TRIALS) -> Array:
    """State of a flag, connected with a state by a straight line of flags."""
    origin = maps.flags(z, p)
    return maps.followed(z, lambda s: origin + s * (flag - origin) if s < 1.0 else flag, p, trials=trials)


def _detours(orders: tuple[int, ...], origin: Array, goal: Array, count: int) -> Iterator[Array]:
    """Flags (nz, ...) between two others, off the straight line by their distance in a derivative below `count`."""
    order = np.concatenate([np.arange(r) for r in orders])
    distance = np.abs(goal - origin)
    for nu in range(1, min(count, max(orders))):
        rows = np.flatnonzero(order == nu)
        size = distance[rows].max(axis=0, initial=0.0)
        for row in rows:
            for sign in (1.0, -1.0):
                detour = 0.5 * (origin + goal)
                detour[row] += sign * size
                yield detour


def _rates(maps: FlatMaps, z: Array, above: Array, p: Array) -> Array:
    """Z' from the derivatives of the flags."""
    slopes = np.moveaxis(maps.slopes(z, p), -1, 0)
    return np.asarray(np.linalg.solve(slopes, above.T[..., None])[..., 0].T, dtype=float)


def _halved(maps: FlatMaps, plan: Trajectory, p: Array, times: Array, states: Array, name: str) -> Grid:
    """Grid with intervals halved until the interpolation predicts their middles."""
    scale = maps.scales[:, None]
    for _ in range(_DEEPEST):
        rates, before = _both_rates(maps, plan, p, times, states)
        middle = 0.5 * (times[:-1] + times[1:])
        predicted = _hermite(middle, times[:-1], times[1:], states[:, :-1], states[:, 1:], rates[:, :-1], before[:, 1:])
        found, good = maps.refined(predicted, flag_at(plan, maps.orders, middle)[0], p)
        error = np.max(np.abs(found - predicted) / scale, axis=0)
        split = ~good | ~(error <= _PREDICTED)
        if not split.any():
            grid = Grid(times, states, rates, before, inverses(maps.slopes(states, p)))
            _check_regular(maps, plan, grid, p, name)
            _check_inputs(maps, plan, grid, p, name)
            return grid
        new = np.flatnonzero(split)
        extra = found[:, new]
        for i in np.flatnonzero(~good[new]):
            k = int(new[i])
            extra[:, i] = _middle(maps, plan, p, float(times[k]), float(middle[k]), states[:, k], name)
        order = np.argsort(np.concatenate([times, middle[new]]), kind="stable")
        times = np.concatenate([times, middle[new]])[order]
        states = np.concatenate([states, extra], axis=1)[:, order]
    raise ValueError(
        f"states of {name} must be determined along the plan, but they change without bound near "
        f"{float(middle[new[0]]):.6g} s"
    )


def _check_regular(maps: FlatMaps, plan: Trajectory, grid: Grid, p: Array, name: str) -> None:
    """Raise if the states or the controls pass a singular point, also between nodes and without a change of sign."""

    def matrices(times: Array) -> tuple[Array, Array]:
        below, _, last = flag_at(plan, maps.orders, times)
        near, slopes = grid.interpolated(times)
        refined, found = maps.refined(near, below, p, slopes)
        z = np.where(found, refined, near)
        mu = np.broadcast_to(maps.mu[:, None], last.shape) if maps.affine else maps.inputs_of(z, last, p)[0]
        return _stacked(maps.slopes(z, p), maps.scales), _stacked(maps.last(z, mu, p)[:, 1:], maps.mu_scales)

    peaks = [np.abs(part).max(axis=(0, 2), initial=1e-300)[:, None] for part in matrices(grid.times)]

    def sizes(times: Array) -> Array:
        both = zip(matrices(times), peaks, strict=True)
        return np.array([np.linalg.svd(part / peak, compute_uv=False)[:, -1] for part, peak in both])

    time, size = _lowest(lambda times: np.asarray(sizes(times).min(axis=0)), grid.times)
    if size >= _SINGULAR:
        return
    of_states, of_controls = sizes(np.array([time]))[:, 0].tolist()
    if of_states <= of_controls:
        weak = maps.weakest(grid.interpolated(np.array([time]))[0][:, 0], p)
        raise ValueError(
            f"states of {name} must be determined along the plan, but {weak} is not determined by the flat outputs at "
            f"{time_text(time)} s{note_of_rest(plan, time)}"
        )
    raise ValueError(
        f"inputs of {name} must be determined along the plan, but their influence on the highest derivatives of the "
        f"flat outputs is singular at {time_text(time)} s; choose a plan that does not pass this point"
    )


def _check_inputs(maps: FlatMaps, plan: Trajectory, grid: Grid, p: Array, name: str) -> None:
    """Raise if controls at the nodes are not finite, or on another branch of the equations."""
    u = maps.inputs_of(grid.states, flag_at(plan, maps.orders, grid.times)[2], p)[1]
    wrong = ~np.isfinite(u).all(axis=0)
    if wrong.any():
        raise ValueError(
            f"inputs of {name} must be determined along the plan, got none with its highest derivatives at "
            f"{float(grid.times[int(wrong.argmax())]):.6g} s; choose another plan, or another operating point at="
        )
    check_branch(maps, grid.states[: maps.nstates], u, p, grid.times, name)


def _stacked(matrices: Array, scales: Array) -> Array:
    """Matrices (n, rows, columns) with scaled columns, of matrices (rows, columns, n); 0 where they are not finite."""
    found = np.moveaxis(matrices, -1, 0) * scales
    return np.where(np.isfinite(found).all(axis=(1, 2), keepdims=True), found, 0.0)


def _lowest(size: Callable[[Array], Array], times: Array) -> tuple[float, float]:
    """Time and value of the smallest value of a function, from its local minima at given times."""
    found = size(times)
    padded = np.concatenate([[np.inf], found, [np.inf]])
    minima = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:]))
    minima = minima[np.argsort(found[minima], kind="stable")[:_MINIMA]]
    low, high = times[np.maximum(minima - 1, 0)], times[np.minimum(minima + 1, times.size - 1)]
    columns = np.arange(minima.size)
    for _ in range(_SEARCHES):
        fine = np.linspace(low, high, 17)
        values = size(fine.ravel()).reshape(fine.shape)
        k = np.argmin(values, axis=0)
        low, high = fine[np.maximum(k - 1, 0), columns], fine[np.minimum(k + 1, 16), columns]
    best = int(np.argmin(values[k, columns]))
    return float(fine[k[best], best]), float(values[k[best], best])


def _middle(maps: FlatMaps, plan: Trajectory, p: Array, a: float, b: float, z: Array, name: str) -> Array:
    try:
        return maps.followed(z, lambda t: flag_at(plan, maps.orders, np.array([t]))[0][:, 0], p, a, b)
    except SingularError as error:
        raise _undetermined(name, error, plan) from None


def _both_rates(maps: FlatMaps, plan: Trajectory, p: Array, times: Array, states: Array) -> tuple[Array, Array]:
    """Derivatives of the states from the right and from the left."""
    above = flag_at(plan, maps.orders, times)[1]
    rates = _rates(maps, states, above, p)
    # The highest derivative may jump at a breakpoint: from the left by a time that is less by rounding.
    earlier = np.nextafter(times, -np.inf)
    earlier[0] = times[0]
    before = _rates(maps, states, flag_at(plan, maps.orders, earlier)[1], p)
    return rates, before


def _hermite(t: Array, a: Array, b: Array, za: Array, zb: Array, ra: Array, rb: Array) -> Array:
    """Cubic Hermite polynomials between states at a and b."""
    h = b - a
    s = (t - a) / h
    return (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * za
        + s * (1.0 - s) ** 2 * h * ra
        + s**2 * (3.0 - 2.0 * s) * zb
        + s**2 * (s - 1.0) * h * rb
    )


def states_along(maps: FlatMaps, grid: Grid, jet: Array, t: Array, p: Array, name: str) -> tuple[Array, Array]:
    """Extended states (nz, n) and controls of the plant (m, n) of a jet (order + 1, m, n) at times (n,).

    Raises
    ------
    ValueError
        With the time at which states are not determined.
    """
    below, _, last = rows_of(jet, maps.orders)
    inside = np.clip(t, grid.times[0], grid.times[-1])
    near, slopes = grid.interpolated(inside)
    z, found = maps.refined(near, below, p, slopes)
    for k in np.flatnonzero(~found):
        z[:, k] = _followed_from_grid(maps, grid, p, float(t[k]), below[:, k], name)
    return z, maps.inputs_of(z, last, p)[1]


def _followed_from_grid(maps: FlatMaps, grid: Grid, p: Array, t: float, flag: Array, name: str) -> Array:
    """State at a time that interpolation does not reach: before the start, after the end, or near a singular point."""
    k = int(np.clip(np.searchsorted(grid.times, t) - 1, 0, grid.times.size - 1))
    z = grid.states[:, k] if t < grid.times[-1] else grid.states[:, -1]
    try:
        return _straight(maps, z, flag, p)
    except SingularError as error:
        raise ValueError(
            f"states of {name} must be determined along the plan, but {error} at {t:.6g} s"
            f"{note_of_still(maps.orders, flag)}"
        ) from None


def note_of_still(orders: tuple[int, ...], flag: Array) -> str:
    """End of a message about a flag (nz,) that does not determine the states: what to do if it is one at rest."""
    return f"; the plan is at rest there, and {ADVICE}" if at_rest(orders, flag) else ""


def at_rest(orders: tuple[int, ...], flags: Array) -> NDArray[np.bool_]:
    """Whether all derivatives of flags (nz, ...) are 0."""
    derivatives = np.concatenate([np.arange(r) > 0 for r in orders])
    return ~flags[derivatives].any(axis=0)


def check_branch(maps: FlatMaps, x: Array, u: Array, p: Array, t: Array, name: str) -> None:
    """Raise if an operation that is not smooth leaves the branch of the operating point."""
    wrong = ~on_branch(maps, x, u, p)
    if wrong.any():
        k = int(wrong.argmax())
        note = maps.notes[int((~(maps.sides(x[:, k], u[:, k], p) > 0.0)).argmax())]
        raise ValueError(
            f"equations of {name} must stay on the branch of the operating point ({note}), got another one"
            f"{_when(float(t[k]))}; derive the flat system with at= on that branch, or choose another plan"
        )


def on_branch(maps: FlatMaps, x: Array, u: Array, p: Array) -> NDArray[np.bool_]:
    """Whether states (nstates, n) and controls (m, n) are on the branch of the operating point, (n,)."""
    if not maps.notes:
        return np.ones(x.shape[1], dtype=bool)
    return np.asarray((maps.sides(x, u, p) > 0.0).all(axis=0))


def _when(time: float) -> str:
    """Time in a message; nothing for flags without one, which is nan."""
    return "" if np.isnan(time) else f" at {time_text(time)} s"
