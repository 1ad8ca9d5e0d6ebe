"""Checks of a flat system's maps: that they belong together, to its motion, and that static feedback linearises it.

The maps are evaluated at a few states, drawn at random from a fixed seed and
from `reverse`: a system is rejected for what is found there.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import control.flatsys as fs
import numpy as np

from ctrlplan._checks import checked_labels, default_labels
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Array, Params, System, Value
from ctrlplan.flatness.linear import LinearMaps, is_linear, linear_maps
from ctrlplan.trajectories import derivative_name

_PROBES = 8
"""Points of each kind at which the maps are evaluated."""

_SAME = 1e-6
"""Relative difference up to which numbers count as equal, and singular values as 0."""

_MUST = "flat must be linearisable by static feedback"


@dataclass(frozen=True)
class FlatPlant:
    """A flat system's maps at its own parameters."""

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
    """A linear flat system with maps of all digits."""

    maps: LinearMaps

    def forward(self, x: Value, u: Value) -> list[Value]:
        return self.maps.forward(x, u)

    def reverse(self, flag: list[Value]) -> list[Value]:
        return self.maps.reverse(flag)


def checked_plant(flat_system: System, label: str = "flat_system") -> FlatPlant:
    """Maps of a flat system in continuous time, which has states and inputs."""
    if not isinstance(flat_system, fs.FlatSystem):
        raise TypeError(f"{label} must be a control.flatsys.FlatSystem, got {type(flat_system).__name__}")
    if flat_system.dt not in (None, 0):
        raise ValueError(f"{label} must be in continuous time, got dt = {flat_system.dt}")
    n, m = flat_system.nstates or 0, flat_system.ninputs or 0
    if not (n and m):
        raise ValueError(f"{label} must have states and inputs, got {n} and {m}")
    if is_linear(flat_system):
        return _LinearPlant(flat_system, n, m, {}, linear_maps(flat_system))
    return FlatPlant(flat_system, n, m, dict(flat_system.params))


def check_maps(flat_system: fs.FlatSystem) -> None:
    """Raise where the maps of a flat system do not belong together, or to its motion.

    Raises
    ------
    ValueError
        With what was found: a state and an input whose flag `reverse` does not
        return to, or whose flag changes at other rates than it states.
    """
    plant = checked_plant(flat_system)
    if isinstance(plant, _LinearPlant):
        return
    try:
        probes = random_probes(plant)
    except ValueError:  # it is regular elsewhere: nothing is known of it
        return
    names = default_labels(plant.ninputs)
    sizes = _sizes(probes)
    for probe in probes:
        _check_derivatives(plant, probe, names)
        _check_reverse(plant, probe, names, sizes)


def warn_of_output(flat_system: fs.FlatSystem) -> None:
    """Warn where a linear system's flat output, which python-control chose, is not its output."""
    if not is_linear(flat_system):
        return
    coefficients = linear_maps(flat_system).output
    name, chosen = flat_system.output_labels[0], f"the flat output of {flat_system.name} is not its output"
    gain = float(coefficients[0])
    if not coefficients[1:].any():
        if abs(gain - 1.0) > _SAME:
            warnings.warn(
                f"{chosen}, but {name} is {gain:.6g} times it: a plan of {name} must be multiplied by "
                f"{1.0 / gain:.6g}, or flat_system be a control.flatsys.FlatSystem whose flat output it is",
                stacklevel=outside_stacklevel(),
            )
        return
    terms = [f"{value:.6g} {derivative_name('z', k)}" for k, value in enumerate(coefficients.tolist()) if value]
    at_rest = f"{name} is 0 wherever z is at rest"
    if gain:
        at_rest = f"it leads {name} from rest to rest where its positions are those of {name} times {1.0 / gain:.6g}"
    warnings.warn(
        f"{chosen}, since the plant has zeros: {name} = {' + '.join(terms)}, z the flat output. A plan is one of z, "
        f"not of {name}; {at_rest}, and on the way {name} differs from its plan by the derivatives of z",
        stacklevel=outside_stacklevel(),
    )


def finite_rows(function: Callable[..., Value], *args: Value) -> list[Array] | None:
    """What a map returns, row by row, or None outside of its domain."""
    with np.errstate(all="raise", under="ignore"):
        try:
            rows = [np.atleast_1d(np.asarray(row, dtype=float)) for row in function(*args)]
        except (ArithmeticError, ValueError):
            return None
    return rows if all(np.isfinite(row).all() for row in rows) else None


def random_probes(plant: FlatPlant) -> list[Probe]:
    """Random states and inputs, where the flag is finite."""
    rng = np.random.default_rng(0)
    draws = [(rng.normal(size=plant.nstates), rng.normal(size=plant.ninputs)) for _ in range(_PROBES)]
    probes = [probe for x, u in draws for probe in _probe(plant, x, u)]
    if not probes:
        with np.errstate(all="ignore"):
            got = plant.forward(*draws[0])  # says itself what is wrong, where it fails
        raise ValueError(f"forward must be finite in some of the states probed, got {got} and the like")
    orders = probes[0].orders
    if len(orders) != plant.ninputs or min(orders) < 1 or any(probe.orders != orders for probe in probes):
        raise ValueError(
            f"forward must return as many flags as inputs, {plant.ninputs}, each of two entries or more and always "
            f"as long, got lengths {[r + 1 for r in probes[-1].orders]}"
        )
    return probes


def planned_probes(plant: FlatPlant, orders: list[int]) -> list[Probe]:
    """States and inputs of random flags, which have the plant's own size; and the zero state under the law's input."""
    rng = np.random.default_rng(1)
    flags = [[rng.normal(size=r + 1) for r in orders] for _ in range(_PROBES)]
    probes = [probe for flag in flags for x, u in _reversed(plant, flag) for probe in _probe(plant, x, u)]
    if not probes:
        with np.errstate(all="ignore"):
            got = plant.reverse(flags[0])
        raise ValueError(f"reverse must be finite for some of the flags probed, got {got} and the like")
    for rest in _probe(plant, np.zeros(plant.nstates), np.zeros(plant.ninputs)):
        for _, u in _reversed(plant, [np.append(row[:-1], 0.0) for row in rest.flag]):
            probes += _probe(plant, rest.x, u)
    return probes


def _probe(plant: FlatPlant, x: Array, u: Array) -> Iterator[Probe]:
    """The probe at a state and an input, if the flag is finite there."""
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
    """Names of the flat outputs: the given ones, those of the outputs that they are, or y, y1, ..."""
    outputs = list(plant.system.output_labels or [])
    if labels is None and len(outputs) == plant.ninputs and not any("[" in label for label in outputs):
        first = [[row[0] for row in probe.flag] for probe in probes]
        if np.allclose([plant.system.output(0.0, probe.x, probe.u) for probe in probes], first, rtol=_SAME):
            labels = outputs
    return checked_labels(labels, plant.ninputs)


def check_linearises(plant: FlatPlant, probes: list[Probe], names: Sequence[str]) -> None:
    """Raise for maps of which the law would not make chains of integrators."""
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
    """Size of each entry of the flags, over all probes."""
    return [np.max(rows, axis=0) for rows in zip(*([np.abs(row) for row in p.flag] for p in probes), strict=True)]


def _varied(plant: FlatPlant, probe: Probe, step: float) -> Iterator[tuple[int, float, list[Array], list[Array]]]:
    """Flags with each input in turn a step lower and higher."""
    for j in range(plant.ninputs):
        change = np.zeros(plant.ninputs)
        change[j] = step * max(1.0, abs(probe.u[j]))
        low, high = (finite_rows(plant.forward, probe.x, u) for u in (probe.u - change, probe.u + change))
        if low is not None and high is not None:
            yield j, 2.0 * change[j], low, high


def _check_below(plant: FlatPlant, probe: Probe, names: Sequence[str], sizes: list[Array]) -> None:
    """Raise where a derivative below the last depends on an input."""
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
    """Raise where the inputs cannot set the last derivatives."""
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
                f"{name}, which depends on none {where}: a flag too short or a singular decoupling matrix"
            )
    # Inputs and flat outputs have units of their own.
    for axis in (1, 0):
        size = np.abs(matrix).max(axis=axis, keepdims=True)
        matrix = matrix / np.where(size > 0.0, size, 1.0)
    rank = int((np.linalg.svd(matrix, compute_uv=False) > _SAME).sum())
    if rank < plant.ninputs:
        raise ValueError(
            f"{_MUST}: the decoupling matrix, last derivatives by inputs, must have rank {plant.ninputs}, "
            f"got {rank} {where}"
        )


def _check_derivatives(plant: FlatPlant, probe: Probe, names: Sequence[str]) -> None:
    """Raise where an entry of a flag is not the derivative of the one before."""
    try:
        found = finite_rows(plant.rates, probe.x, probe.u)
    except NotImplementedError:  # a flat system may come without equations of motion
        return
    if found is None:
        return
    # Points along the motion, so close that no state changes by more than about 1e-4.
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
    """Raise where reverse does not undo forward; another state with the same flag is accepted."""
    for x, u in _reversed(plant, probe.flag):
        again = finite_rows(plant.forward, x, u) or [np.full(size.shape, np.nan) for size in sizes]
        for name, given, got, size in zip(names, probe.flag, again, sizes, strict=True):
            # python-control's own maps of stiff linear systems lose some of the digits.
            kept = np.abs(got - given) <= 100.0 * _SAME * size
            if not kept.all():
                k = int(kept.argmin())
                raise ValueError(
                    f"reverse must undo forward, got a state and an input with {got[k]:.6g} as derivative {k} of flat "
                    f"output {name} for a flag with {given[k]:.6g}"
                )
