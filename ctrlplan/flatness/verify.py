"""Checks of the maps of flat systems: consistency, equations of motion, linearisation by static feedback.

The maps are evaluated at a few states, drawn at random with a fixed seed and
from `reverse`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import control.flatsys as fs
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_labels, default_labels
from ctrlplan._types import Array, Params, System, Value
from ctrlplan.flatness.linear import LinearMaps, is_linear, linear_maps
from ctrlplan.trajectories import derivative_name

_PROBES = 8
"""Points of each kind at which the maps are evaluated."""

_SAME = 1e-6
"""Relative tolerance for equal numbers and zero singular values."""

_MUST = "flat must be linearisable by static feedback"


@dataclass(frozen=True)
class FlatPlant:
    """Maps of a flat system at its default parameters."""

    system: System
    nstates: int
    ninputs: int
    params: Params

    def forward(self, x: Value, u: Value) -> list[Value]:
        """Flags of a state and an input."""
        return list(self.system.forward(x, u, self.params))

    def reverse(self, flag: list[Value]) -> list[Value]:
        """State and input of flags."""
        return [np.ravel(values) for values in self.system.reverse(flag, self.params)]

    def rates(self, x: Array, u: Array) -> list[Value]:
        """Rates of the states."""
        return [self.system.dynamics(0.0, x, u)]


@dataclass(frozen=True)
class Probe:
    """State and input at which the maps are evaluated, with the flag there."""

    x: Array
    u: Array
    flag: list[Array]

    @property
    def orders(self) -> list[int]:
        """Highest derivative of each flat output."""
        return [len(row) - 1 for row in self.flag]


@dataclass(frozen=True)
class _LinearPlant(FlatPlant):
    """A linear flat system with maps correct to rounding; its output is the flat output unless it has zeros."""

    maps: LinearMaps

    def forward(self, x: Value, u: Value) -> list[Value]:
        return self.maps.forward(x, u)

    def reverse(self, flag: list[Value]) -> list[Value]:
        return self.maps.reverse(flag)


def checked_plant(flat_system: System, label: str = "flat_system") -> FlatPlant:
    """Maps of a flat system, checked to be in continuous time with states and inputs."""
    if not isinstance(flat_system, fs.FlatSystem):
        raise TypeError(f"{label} must be a control.flatsys.FlatSystem, got {type(flat_system).__name__}")
    if flat_system.dt not in (None, 0):
        raise ValueError(f"{label} must be in continuous time, got dt = {flat_system.dt}")
    n, m = flat_system.nstates or 0, flat_system.ninputs or 0
    if not (n and m):
        raise ValueError(f"{label} must have states and inputs, got {n} and {m}")
    if is_linear(flat_system):
        maps = linear_maps(flat_system)
        return _LinearPlant(flat_system, n, m, {}, maps if maps.has_zeros else maps.of_output())
    return FlatPlant(flat_system, n, m, dict(flat_system.params))


def check_maps(flat_system: fs.FlatSystem) -> None:
    """Raise if the maps of a flat system are inconsistent with each other or with its equations of motion.

    Raises
    ------
    ValueError
        With a state and an input for which `reverse` is not the inverse of
        `forward`, or the flag is not consistent with its derivatives.
    """
    plant = checked_plant(flat_system)
    if isinstance(plant, _LinearPlant):
        return
    try:
        probes = random_probes(plant)
    except ValueError:  # it may be regular elsewhere
        return
    names = default_labels(plant.ninputs)
    sizes = _sizes(probes)
    for probe in probes:
        _check_derivatives(plant, probe, names)
        _check_reverse(plant, probe, names, sizes)


def check_output(flat_system: fs.FlatSystem) -> None:
    """Raise for a linear system with zeros, whose flat output, as python-control defines it, is not its output."""
    if not is_linear(flat_system):
        return
    maps = linear_maps(flat_system)
    if not maps.has_zeros:
        return
    coefficients = maps.output.tolist()
    name, gain = flat_system.output_labels[0], coefficients[0]
    terms = [f"{value:.6g} {derivative_name('z', k)}" for k, value in enumerate(coefficients) if value]
    at_rest = f"at rest z is {name} times {1.0 / gain:.6g}" if gain else f"at rest {name} is 0"
    raise ValueError(
        f"the flat output of {flat_system.name} must be its output, got a plant with zeros: {name} = "
        f"{' + '.join(terms)}, z the flat output that python-control has chosen; {at_rest}. For a plan of z name it by "
        "labels= of create_flat_iosystem; for limits, or other flat outputs, use ctrlplan.flat_system; for a plan of "
        f"{name} create_feedforward_iosystem"
    )


def undetermined_at_rest(plant: FlatPlant, lengths: Sequence[int]) -> NDArray[np.bool_]:
    """Whether each state and input depends on derivatives in the limit of a slow plan."""

    def found(flag: list[Array], pace: float) -> Array | None:
        """States and inputs along a slower plan; None outside of their domain."""
        slowed = [row * pace ** np.arange(row.size) for row in flag]
        with np.errstate(all="ignore"):
            try:
                both = np.concatenate(plant.reverse(slowed)).astype(float)
            except Exception:  # any exception of a trial call
                return None
        return both if np.isfinite(both).all() else None

    rng = np.random.default_rng(0)
    undetermined: NDArray[np.bool_] = np.zeros(plant.nstates + plant.ninputs, dtype=bool)
    for _ in range(4):
        flags = [[rng.normal(size=length) for length in lengths] for _ in range(2)]
        for first, second in zip(*flags, strict=True):
            second[0] = first[0]  # two motions through one position
        rows = [row for pace in (1e-3, 1e-6) for flag in flags if (row := found(flag, pace)) is not None]
        if len(rows) == 4:
            apart, nearer = np.abs(rows[1] - rows[0]), np.abs(rows[3] - rows[2])
            undetermined |= (nearer > 0.01 * apart) & (nearer > 1e-9 * (1.0 + np.abs(rows[2])))
    return undetermined


def finite_rows(function: Callable[..., Value], *args: Value) -> list[Array] | None:
    """Rows of the result of a map, or None outside of its domain."""
    with np.errstate(all="raise", under="ignore"):
        try:
            rows = [np.atleast_1d(np.asarray(row, dtype=float)) for row in function(*args)]
        except (ArithmeticError, ValueError):
            return None
    return rows if all(np.isfinite(row).all() for row in rows) else None


def random_probes(plant: FlatPlant) -> list[Probe]:
    """Random states and inputs with a finite flag."""
    rng = np.random.default_rng(0)
    draws = [(rng.normal(size=plant.nstates), rng.normal(size=plant.ninputs)) for _ in range(_PROBES)]
    probes = [probe for x, u in draws for probe in _probe(plant, x, u)]
    if not probes:
        with np.errstate(all="ignore"):
            got = plant.forward(*draws[0])  # raises the error of the map, if any
        raise ValueError(f"forward must be finite in some of the random states, got {got}")
    orders = probes[0].orders
    if len(orders) != plant.ninputs or min(orders) < 1 or any(probe.orders != orders for probe in probes):
        raise ValueError(
            f"forward must return one flag per input, {plant.ninputs}, each of two entries or more and of constant "
            f"length, got lengths {[r + 1 for r in probes[-1].orders]}"
        )
    return probes


def planned_probes(plant: FlatPlant, orders: list[int]) -> list[Probe]:
    """States and inputs of random flags of realistic magnitude, and the zero state with the input of the law."""
    rng = np.random.default_rng(1)
    flags = [[rng.normal(size=r + 1) for r in orders] for _ in range(_PROBES)]
    probes = [probe for flag in flags for x, u in _reversed(plant, flag) for probe in _probe(plant, x, u)]
    if not probes:
        with np.errstate(all="ignore"):
            got = plant.reverse(flags[0])
        raise ValueError(f"reverse must be finite for some of the random flags, got {got}")
    for rest in _probe(plant, np.zeros(plant.nstates), np.zeros(plant.ninputs)):
        for _, u in _reversed(plant, [np.append(row[:-1], 0.0) for row in rest.flag]):
            probes += _probe(plant, rest.x, u)
    return probes


def _probe(plant: FlatPlant, x: Array, u: Array) -> Iterator[Probe]:
    """The probe at a state and an input, if its flag is finite."""
    flag = finite_rows(plant.forward, x, u)
    if flag is not None:
        yield Probe(x, u, flag)


def _reversed(plant: FlatPlant, flag: list[Array]) -> Iterator[tuple[Array, Array]]:
    """The state and the input of a flag, if they are finite."""
    found = finite_rows(plant.reverse, flag)
    if found is not None:
        x, u = found
        if (x.size, u.size) != (plant.nstates, plant.ninputs):
            raise ValueError(
                f"reverse must return {plant.nstates} states and {plant.ninputs} inputs, got {x.size} and {u.size}"
            )
        yield x, u


def flat_labels(plant: FlatPlant, probes: list[Probe], labels: Sequence[str] | str | None) -> tuple[str, ...]:
    """Names of the flat outputs: the given ones, those of equal outputs, or y, y1, ..."""
    outputs = list(plant.system.output_labels or [])
    if labels is None and len(outputs) == plant.ninputs and not any("[" in label for label in outputs):
        first = [[row[0] for row in probe.flag] for probe in probes]
        if np.allclose([plant.system.output(0.0, probe.x, probe.u) for probe in probes], first, rtol=_SAME):
            labels = outputs
    return checked_labels(labels, plant.ninputs)


def check_linearises(plant: FlatPlant, probes: list[Probe], names: Sequence[str]) -> None:
    """Raise if static feedback does not give chains of integrators."""
    if isinstance(plant, _LinearPlant):  # its maps are exact
        return
    sizes = _sizes(probes)
    for probe in probes:
        _check_below(plant, probe, names, sizes)
    for probe in probes:
        _check_decoupling(plant, probe, names)
    orders = probes[0].orders
    if sum(orders) != plant.nstates:
        got = ", ".join(f"{r} of {name}" for name, r in zip(names, orders, strict=True))
        raise ValueError(
            f"{_MUST}: the orders of the flat outputs must add up to the number of states, {plant.nstates}, got {got}"
        )
    for probe in probes:
        _check_derivatives(plant, probe, names)
        _check_reverse(plant, probe, names, sizes)


def _sizes(probes: list[Probe]) -> list[Array]:
    """Magnitude of each entry of the flags over all probes."""
    return [np.max(rows, axis=0) for rows in zip(*([np.abs(row) for row in p.flag] for p in probes), strict=True)]


def _varied(plant: FlatPlant, probe: Probe, step: float) -> Iterator[tuple[int, float, list[Array], list[Array]]]:
    """Flags with each input decreased and increased by a step."""
    for j in range(plant.ninputs):
        change = np.zeros(plant.ninputs)
        change[j] = step * max(1.0, abs(probe.u[j]))
        low, high = (finite_rows(plant.forward, probe.x, u) for u in (probe.u - change, probe.u + change))
        if low is not None and high is not None:
            yield j, 2.0 * change[j], low, high


def _check_below(plant: FlatPlant, probe: Probe, names: Sequence[str], sizes: list[Array]) -> None:
    """Raise if a derivative below the last depends on an input."""
    for j, _, low, high in _varied(plant, probe, 0.5):
        for name, below, above, size in zip(names, low, high, sizes, strict=True):
            moved = np.abs(above - below)[:-1] > _SAME * size[:-1]
            if moved.any():
                raise ValueError(
                    f"{_MUST}: no derivative below the last of a flag may depend on an input, got derivative "
                    f"{moved.argmax()} of flat output {name} (the last is {len(below) - 1}), which depends on "
                    f"{plant.system.input_labels[j]}"
                )


def _check_decoupling(plant: FlatPlant, probe: Probe, names: Sequence[str]) -> None:
    """Raise if the decoupling matrix is singular."""
    matrix = np.full((plant.ninputs, plant.ninputs), np.nan)
    for j, change, low, high in _varied(plant, probe, 1e-4):
        below, above = (np.array([row[-1] for row in flag]) for flag in (low, high))
        rounding = 1e-11 * (np.abs(below) + np.abs(above))
        matrix[:, j] = np.where(np.abs(above - below) > rounding, above - below, 0.0) / change
    if np.isnan(matrix).any():
        return
    where = f"at the state {probe.x.round(4).tolist()}"
    for name, r, row in zip(names, probe.orders, matrix, strict=True):
        if not row.any():
            raise ValueError(
                f"{_MUST}: the last derivative of a flag must depend on an input, got derivative {r} of flat output "
                f"{name}, which does not {where}: the flag is too short or the decoupling matrix singular"
            )
    # Scaled, as inputs and flat outputs have different units.
    for axis in (1, 0):
        size = np.abs(matrix).max(axis=axis, keepdims=True)
        matrix = matrix / np.where(size > 0.0, size, 1.0)
    rank = int((np.linalg.svd(matrix, compute_uv=False) > _SAME).sum())
    if rank < plant.ninputs:
        raise ValueError(
            f"{_MUST}: the decoupling matrix of last derivatives must have rank {plant.ninputs}, got {rank} {where}"
        )


def _check_derivatives(plant: FlatPlant, probe: Probe, names: Sequence[str]) -> None:
    """Raise if an entry of a flag is not the derivative of the previous one."""
    try:
        found = finite_rows(plant.rates, probe.x, probe.u)
    except NotImplementedError:  # a flat system without equations of motion
        return
    if found is None:
        return
    # Points along the motion, with changes of the states of at most about 1e-4.
    pace = float(np.max(np.abs(found[0]) / (1.0 + np.abs(probe.x)))) or 1.0
    h = 1e-4 / pace
    flags = [flag for k in (-2, -1, 1, 2) if (flag := finite_rows(plant.forward, probe.x + k * h * found[0], probe.u))]
    if len(flags) < 4:
        return
    for name, row, (a, b, c, d) in zip(names, probe.flag, zip(*flags, strict=True), strict=True):
        rate, given = ((a - d + 8.0 * (c - b)) / (12.0 * h))[:-1], row[1:]
        rounding = 0.1 * _SAME * pace * np.abs(row[:-1])
        wrong = np.abs(rate - given) > _SAME * (np.abs(rate) + np.abs(given)) + rounding
        if wrong.any():
            k = int(wrong.argmax())
            raise ValueError(
                f"forward must return derivatives along the motion of flat_system, got {given[k]:.6g} as derivative "
                f"{k + 1} of flat output {name} where derivative {k} changes at the rate {rate[k]:.6g}"
            )


def _check_reverse(plant: FlatPlant, probe: Probe, names: Sequence[str], sizes: list[Array]) -> None:
    """Raise if reverse is not the inverse of forward; another state with the same flag is accepted."""
    for x, u in _reversed(plant, probe.flag):
        again = finite_rows(plant.forward, x, u) or [np.full(size.shape, np.nan) for size in sizes]
        for name, given, got, size in zip(names, probe.flag, again, sizes, strict=True):
            # python-control's maps of stiff linear systems have rounding errors.
            equal = np.abs(got - given) <= 100.0 * _SAME * size
            if not equal.all():
                k = int(equal.argmin())
                raise ValueError(
                    f"reverse must be the inverse of forward, got {got[k]:.6g} as derivative {k} of "
                    f"flat output {name} for a flag with {given[k]:.6g}"
                )
