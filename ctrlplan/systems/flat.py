"""Tracking law of flat plants: linearise by the flat output's flag, then place the poles of the error.

Equations (9)-(11) of the paper, (11) corrected: the sum starts at 0 and is subtracted.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import control as ct
import control.flatsys as fs
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import checked_labels, default_labels
from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Params, System, Value
from ctrlplan.systems.linear_flat import LinearMaps, is_linear, linear_maps
from ctrlplan.trajectories import derivative_name

Array = NDArray[np.float64]

_PROBES = 8
"""Points of each kind at which the maps are looked at."""

_SAME = 1e-6
"""Relative difference up to which numbers count as equal, and singular values as 0."""

_MUST = "static feedback must linearise flat_system"


def create_flat_iosystem(
    flat_system: fs.FlatSystem,
    poles: Sequence[Value],
    name: str = "flat_law",
    *,
    labels: Sequence[str] | str | None = None,
) -> ct.NonlinearIOSystem:
    r"""Law under which flat outputs follow their plan, (9)-(11) corrected.

    With y_1, ..., y_1^(r_1), y_2, ... the flag of the flat outputs,

    .. math:: v_j = y_{d,j}^{(r_j)} - \sum_{k=0}^{r_j - 1} \sigma_{j,k}\,(y_j^{(k)} - y_{d,j}^{(k)}),
        \qquad s^{r_j} + \sum_k \sigma_{j,k} s^k = \prod_k (s - p_{j,k}),

    and u is what `flat_system.reverse` gives for the flag with v_j in the place
    of y_j^(r_j). Plant and law together are chains of r_j integrators, on which
    the errors obey the linear equation with the poles p_j.

    No states. Inputs: of each flat output in turn the references {label}_ref,
    {label}_ref_d1, ... up to order r_j, as `create_source_iosystem` puts them
    out with ``suffix="_ref"``; then the plant's states by name. Outputs: the
    plant's inputs by name.

    Parameters
    ----------
    flat_system : control.flatsys.FlatSystem
        Plant that static feedback linearises, in continuous time. The flag of
        flat output j has r_j + 1 entries, of which y_j, ..., y_j^(r_j - 1) are
        functions of the state alone, and the r_j add up to the number of states.
    poles : sequence of sequences of complex
        For each flat output r_j poles [rad/s], closed under conjugation and
        with negative real parts; one flat sequence where there is one flat output.
    name : str, optional
        Name of the block.
    labels : sequence of str, optional
        Names of the flat outputs: unless given, those of the plant's outputs
        where these are the flat outputs and are named, else y, or y1, y2, ...

    Returns
    -------
    control.NonlinearIOSystem
        Without states and of any time base.

    Raises
    ------
    TypeError
        If `flat_system` is no `control.flatsys.FlatSystem`, or poles or labels are of
        a wrong kind.
    ValueError
        If static feedback does not linearise `flat_system`: a derivative below
        the last depends on an input (the message says which), the decoupling
        matrix is singular, or the flags are too short; if `forward`, `reverse`
        and the plant's equations do not belong together; or if poles or labels
        are wrong.

    Warns
    -----
    UserWarning
        If `flat_system` is a `LinearFlatSystem` whose output is not its flat output,
        which python-control chose, and `labels` does not name it: a multiple of it,
        or, where the plant has zeros, a sum of its derivatives.

    Notes
    -----
    The plant's maps are looked at in a few states, drawn at random from a fixed
    seed and from `reverse`, and in the zero state where it is not singular: a
    plant is refused for what is seen there, and otherwise taken at its word.

    The plant of the loop must put out its states by their names, as those of
    `ctrlplan.plants` do. References are of the flat outputs: that of a
    `LinearFlatSystem` is chosen by python-control and need not be its output; its
    maps are computed here from its matrices, without rounding.

    The law keeps the parameters `flat_system` has now: a loop simulated with
    others shows what an inexact model does.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> from ctrlplan.systems.plants.integrator_chain import integrator_chain
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> chain = integrator_chain(2)
    >>> law = create_flat_iosystem(chain, poles=[-3, -4])
    >>> law.input_labels
    ['y_ref', 'y_ref_d1', 'y_ref_d2', 'y', 'y_d1']
    >>> loop = ct.interconnect(
    ...     [cp.create_source_iosystem(plan, 2, suffix="_ref"), law, chain], inputs=0, outputs=["y"]
    ... )
    >>> found = cp.simulate(loop, [0.0, 0.5, 1.0])
    >>> bool(abs(found.outputs - plan(found.time)).max() < 1e-7)
    True
    """
    plant = checked_plant(flat_system)
    if labels is None:
        warn_of_output(flat_system)
    probes = _random_probes(plant)
    names = _flat_labels(plant, probes, labels)
    _check_linearises(plant, probes, names)
    planned = _planned_probes(plant, probes[0].orders)
    _check_linearises(plant, planned, names)
    orders = probes[0].orders
    gains = _gains(poles, orders)
    references = [
        derivative_name(f"{label}_ref", k) for label, r in zip(names, orders, strict=True) for k in range(r + 1)
    ]
    states = list(plant.system.state_labels)
    if shared := sorted(set(references) & set(states)):
        raise ValueError(f"labels must not make references of the names of states, got {', '.join(shared)}")
    idle = np.zeros(plant.ninputs)

    def law(t: float, x: Value, u: Value, params: Params) -> Value:
        # Below the last derivative the flag does not depend on the input.
        measured = plant.forward(u[len(references) :], idle)
        flag, first = [], 0
        for row, sigma in zip(measured, gains, strict=True):
            r = len(sigma)
            wanted = u[first : first + r + 1]
            v = wanted[r] - sum(sigma[k] * (row[k] - wanted[k]) for k in range(r))
            flag.append(np.array([*row[:r], v]))
            first += r + 1
        return plant.reverse(flag)[1]

    regular = np.concatenate([*planned[0].flag, planned[0].x])

    def law_off_zero(t: float, x: Value, u: Value, params: Params) -> Value:
        # Blocks are first evaluated with all inputs zero, where this plant is singular: there the law is taken
        # elsewhere, and is 0. Without a condition, so that it can be traced.
        idles = math.prod(value == 0.0 for value in u)
        moved = np.empty(regular.size, dtype=u.dtype)
        for i, at in enumerate(regular.tolist()):
            moved[i] = u[i] + idles * at
        return [value * (1.0 - idles) for value in law(t, x, moved, params)]

    zero = np.zeros(len(references) + plant.nstates)
    return ct.nlsys(
        None,
        law_off_zero if _finite(law, 0.0, None, zero, {}) is None else law,
        inputs=[*references, *states],
        outputs=list(plant.system.input_labels),
        dt=None,
        name=name,
    )


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
        probes = _random_probes(plant)
    except ValueError:  # it is regular elsewhere: nothing is known of it
        return
    names = default_labels(plant.ninputs)
    sizes = _sizes(probes)
    for probe in probes:
        _check_derivatives(plant, probe, names)
        _check_reverse(plant, probe, names, sizes)


def hurwitz_coefficients(poles: Sequence[complex], count: int, where: str = "") -> tuple[float, ...]:
    """Coefficients of the monic polynomial with these roots, lowest first.

    Parameters
    ----------
    poles : sequence of complex
        Roots [rad/s], closed under conjugation, with negative real parts.
    count : int
        How many there must be.
    where : str, optional
        Put behind what was given in an error's message: `` in poles[1]``.

    Returns
    -------
    tuple of float
        sigma_0, ..., sigma_(count - 1) of s^count + sum of sigma_k s^k.

    Raises
    ------
    TypeError
        If poles are not numbers.
    ValueError
        If they are not `count`, not closed under conjugation, not finite, or
        not stable.

    Examples
    --------
    >>> hurwitz_coefficients([-1, -2 + 1j, -2 - 1j], 3)
    (5.0, 9.0, 5.0)
    """
    given = np.asarray(poles)
    if given.dtype.kind not in "iufc":
        raise TypeError(f"poles must be numbers, got {poles!r}{where}")
    if given.shape != (count,):
        raise ValueError(f"poles must be as many as the order of the flat output, {count}, got {given.tolist()}{where}")
    if not np.isfinite(given).all() or not (given.real < 0.0).all():
        raise ValueError(f"poles must be finite with negative real parts, got {given.tolist()}{where}")
    # A polynomial is real exactly where its roots are closed under conjugation.
    coefficients = np.atleast_1d(np.poly(given))
    if (np.abs(coefficients.imag) > 1e-9 * np.poly(-np.abs(given))).any():
        raise ValueError(f"poles must be closed under conjugation, got {given.tolist()}{where}")
    return tuple(coefficients.real[:0:-1].tolist())


def _gains(poles: Value, orders: Sequence[int]) -> list[tuple[float, ...]]:
    """Coefficients of each flat output's polynomial."""
    if not np.iterable(poles):
        raise TypeError(f"poles must be one sequence for each flat output, got {poles!r}")
    rows = list(poles)
    if len(orders) == 1 and all(np.ndim(row) == 0 for row in rows):
        return [hurwitz_coefficients(rows, orders[0])]
    if len(rows) != len(orders):
        raise ValueError(f"poles must be one sequence for each of {len(orders)} flat outputs, got {len(rows)}")
    return [hurwitz_coefficients(p, r, f" in poles[{j}]") for j, (p, r) in enumerate(zip(rows, orders, strict=True))]


# What is asked of the maps


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
class _Probe:
    """State and input at which the maps are looked at, with the flag there."""

    x: Array
    u: Array
    flag: list[Array]

    @property
    def orders(self) -> list[int]:
        return [len(row) - 1 for row in self.flag]


@dataclass(frozen=True)
class _LinearPlant(FlatPlant):
    """A linear flat system with maps of all digits."""

    maps: LinearMaps

    def forward(self, x: Value, u: Value) -> list[Value]:
        return self.maps.forward(x, u)

    def reverse(self, flag: list[Value]) -> list[Value]:
        return self.maps.reverse(flag)


def checked_plant(flat_system: System) -> FlatPlant:
    """Maps of a flat system in continuous time, which has states and inputs."""
    if not isinstance(flat_system, fs.FlatSystem):
        raise TypeError(f"flat_system must be a control.flatsys.FlatSystem, got {type(flat_system).__name__}")
    if flat_system.dt not in (None, 0):
        raise ValueError(f"flat_system must be in continuous time, got dt = {flat_system.dt}")
    n, m = flat_system.nstates or 0, flat_system.ninputs or 0
    if not (n and m):
        raise ValueError(f"flat_system must have states and inputs, got {n} and {m}")
    if is_linear(flat_system):
        return _LinearPlant(flat_system, n, m, {}, linear_maps(flat_system))
    return FlatPlant(flat_system, n, m, dict(flat_system.params))


def _finite(function: Callable[..., Value], *args: Value) -> list[Array] | None:
    """What a map returns, row by row, or None outside of its domain."""
    with np.errstate(all="raise", under="ignore"):
        try:
            rows = [np.atleast_1d(np.asarray(row, dtype=float)) for row in function(*args)]
        except (ArithmeticError, ValueError):
            return None
    return rows if all(np.isfinite(row).all() for row in rows) else None


def _random_probes(plant: FlatPlant) -> list[_Probe]:
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


def _planned_probes(plant: FlatPlant, orders: list[int]) -> list[_Probe]:
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


def _probe(plant: FlatPlant, x: Array, u: Array) -> Iterator[_Probe]:
    """The probe at a state and an input, if the flag is finite there."""
    flag = _finite(plant.forward, x, u)
    if flag is not None:
        yield _Probe(x, u, flag)


def _reversed(plant: FlatPlant, flag: list[Array]) -> Iterator[tuple[Array, Array]]:
    """The state and the input of a flag, if they are finite."""
    found = _finite(plant.reverse, flag)
    if found is not None:
        x, u = found
        if (x.size, u.size) != (plant.nstates, plant.ninputs):
            raise ValueError(
                f"reverse must return {plant.nstates} states and {plant.ninputs} inputs, got {x.size} and {u.size}"
            )
        yield x, u


def _flat_labels(plant: FlatPlant, probes: list[_Probe], labels: Sequence[str] | str | None) -> tuple[str, ...]:
    """Names of the flat outputs: the given ones, those of the outputs that they are, or y, y1, ..."""
    outputs = list(plant.system.output_labels or [])
    if labels is None and len(outputs) == plant.ninputs and not any("[" in label for label in outputs):
        first = [[row[0] for row in probe.flag] for probe in probes]
        if np.allclose([plant.system.output(0.0, probe.x, probe.u) for probe in probes], first, rtol=_SAME):
            labels = outputs
    return checked_labels(labels, plant.ninputs)


def _check_linearises(plant: FlatPlant, probes: list[_Probe], names: Sequence[str]) -> None:
    """Refuse maps of which the law would not make chains of integrators."""
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


def _sizes(probes: list[_Probe]) -> list[Array]:
    """Size of each entry of the flags, over all probes."""
    return [np.max(rows, axis=0) for rows in zip(*([np.abs(row) for row in p.flag] for p in probes), strict=True)]


def _varied(plant: FlatPlant, probe: _Probe, step: float) -> Iterator[tuple[int, float, list[Array], list[Array]]]:
    """Flags with each input in turn a step lower and higher."""
    for j in range(plant.ninputs):
        change = np.zeros(plant.ninputs)
        change[j] = step * max(1.0, abs(probe.u[j]))
        low, high = (_finite(plant.forward, probe.x, u) for u in (probe.u - change, probe.u + change))
        if low is not None and high is not None:
            yield j, 2.0 * change[j], low, high


def _check_below(plant: FlatPlant, probe: _Probe, names: Sequence[str], sizes: list[Array]) -> None:
    """Refuse where a derivative below the last depends on an input."""
    for j, _, low, high in _varied(plant, probe, 0.5):
        for name, below, above, size in zip(names, low, high, sizes, strict=True):
            moved = np.abs(above - below)[:-1] > _SAME * size[:-1]
            if moved.any():
                raise ValueError(
                    f"{_MUST}: no derivative below the last of a flag may depend on an input, got derivative "
                    f"{moved.argmax()} of flat output {name} (the last is {len(below) - 1}), which depends on "
                    f"{plant.system.input_labels[j]}"
                )


def _check_decoupling(plant: FlatPlant, probe: _Probe, names: Sequence[str]) -> None:
    """Refuse where the inputs cannot set the last derivatives."""
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


def _check_derivatives(plant: FlatPlant, probe: _Probe, names: Sequence[str]) -> None:
    """Refuse where an entry of a flag is not the derivative of the one before."""
    try:
        found = _finite(plant.rates, probe.x, probe.u)
    except NotImplementedError:  # a flat system may come without equations of motion
        return
    if found is None:
        return
    # Points along the motion, so close that no state changes by more than about 1e-4.
    pace = float(np.max(np.abs(found[0]) / (1.0 + np.abs(probe.x)))) or 1.0
    h = 1e-4 / pace
    flags = [flag for k in (-2, -1, 1, 2) if (flag := _finite(plant.forward, probe.x + k * h * found[0], probe.u))]
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


def _check_reverse(plant: FlatPlant, probe: _Probe, names: Sequence[str], sizes: list[Array]) -> None:
    """Refuse where reverse does not undo forward; another state of the same flag will do."""
    for x, u in _reversed(plant, probe.flag):
        again = _finite(plant.forward, x, u) or [np.full(size.shape, np.nan) for size in sizes]
        for name, given, got, size in zip(names, probe.flag, again, sizes, strict=True):
            # python-control's own maps of stiff linear systems lose some of the digits.
            kept = np.abs(got - given) <= 100.0 * _SAME * size
            if not kept.all():
                k = int(kept.argmin())
                raise ValueError(
                    f"reverse must undo forward, got a state and an input with {got[k]:.6g} as derivative {k} of flat "
                    f"output {name} for a flag with {given[k]:.6g}"
                )
