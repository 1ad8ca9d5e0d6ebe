"""Tracking laws of flat plants that are derived from equations: with a dynamic extension, or quasi-static."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_signals, checked_range, finite_vector
from ctrlplan._types import Array, Params, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem
from ctrlplan.symbolic.tape import Tape
from ctrlplan.systems.poles import checked_gains
from ctrlplan.traits import declare
from ctrlplan.trajectories import derivative_name

InputLimits = Mapping[str, tuple[float, float]]
"""Lower and upper limits of inputs of a plant by name."""


def create_derived_law(
    flat: DerivedFlatSystem,
    poles: Value,
    *,
    quasi_static: bool,
    integral: bool,
    start: ArrayLike | None,
    labels: Sequence[str],
    suffix: str,
    name: str,
    limits: InputLimits | None = None,
) -> ct.NonlinearIOSystem:
    """Tracking law of a flat plant from its equations; see `create_flat_iosystem`."""
    from ctrlplan.flatness.feedback import law_with_states, law_without_states, pole_counts

    analysis = flat.analysis
    counts = pole_counts(analysis, quasi_static, str(flat.name))
    gains = checked_gains(poles, [count + int(integral) for count in counts])
    bounds = input_bounds(limits, flat)
    if quasi_static:
        law = law_without_states(analysis, gains, integral, str(flat.name))
    else:
        law = law_with_states(analysis, gains, integral, bounds)
    first = _initial(flat, start, law.extension)
    return _block(
        flat,
        law.control,
        law.rates,
        np.concatenate([first, np.zeros(len(labels) * integral)]),
        bounds if quasi_static else None,
        labels,
        suffix,
        integral,
        name,
    )


def references(labels: Sequence[str], orders: Sequence[int], suffix: str) -> list[str]:
    """Names of the references of flat outputs with their derivatives."""
    return [derivative_name(label + suffix, k) for label, r in zip(labels, orders, strict=True) for k in range(r + 1)]


def _block(
    flat: DerivedFlatSystem,
    control: Tape,
    rates: Tape,
    initial: Array,
    bounds: tuple[Array, Array] | None,
    labels: Sequence[str],
    suffix: str,
    integral: bool,
    name: str,
) -> ct.NonlinearIOSystem:
    wanted = references(labels, flat.orders, suffix)
    states = list(flat.state_labels)
    if shared := sorted(set(wanted) & set(states)):
        raise ValueError(f"labels and suffix must not give references the names of states, got {', '.join(shared)}")
    p = flat.parameter_values().tolist()
    count, extension = len(wanted), initial.size - len(labels) * integral
    regular = _regular_arguments(flat, count, extension, initial.size)

    def divided(values: Value) -> tuple[Value, Value, Value, Value]:
        return values[:count], values[count : count + len(states)], values[count + len(states) :], p

    # Blocks are first evaluated with all inputs zero, where many plants are singular.
    zeros = [0.0] * (count + len(states))
    guarded = not _is_finite((control, rates), divided([*zeros, *initial.tolist()]))
    guarded_at_zero = not (guarded or _is_finite((control, rates), divided([0.0] * len(regular))))

    def arguments(x: Value, u: Value) -> tuple[tuple[Value, Value, Value, Value], Value]:
        # Where zero is singular the law is evaluated at a regular point and multiplied by 0. Without a branch, so that
        # it can be traced.
        signals = [*u, *x] if guarded_at_zero else u if guarded else [1.0]
        idles = math.prod(_number(value) == 0.0 for value in signals)
        given = [_number(value) + idles * at for value, at in zip([*u, *x], regular, strict=True)]
        return divided(given), 1.0 - idles

    def output(t: float, x: Value, u: Value, params: Params) -> Value:
        given, factor = arguments(x, u)
        values = control.at(given)
        if bounds is not None:
            values = [np.minimum(np.maximum(v, low), high) for v, low, high in zip(values, *bounds, strict=True)]
        return [value * factor for value in values]

    def update(t: float, x: Value, u: Value, params: Params) -> Value:
        given, factor = arguments(x, u)
        return [value * factor for value in rates.at(given)]

    own = [f"{name}_w{k + 1}" for k in range(extension)]
    own += [f"{name}_{label}_integral" for label in labels] if integral else []
    block = ct.nlsys(
        update if own else None,
        output,
        states=own or None,
        inputs=[*wanted, *states],
        outputs=list(flat.input_labels),
        dt=0 if own else None,
        name=name,
    )
    return declare(block, initial_state=initial) if own else block


def _is_finite(tapes: Sequence[Tape], given: Sequence[Value]) -> bool:
    """Whether the results of tapes are finite numbers."""
    return bool(np.isfinite([value for tape in tapes for value in tape.at(given)]).all())


def _number(value: Value) -> Value:
    """Python's number in place of numpy's, which is slower; symbols as they are."""
    return float(value) if isinstance(value, np.floating) else value


def _regular_arguments(flat: DerivedFlatSystem, count: int, extension: int, own: int) -> list[float]:
    """References, states of the plant and of the law at which the maps are regular."""
    maps = flat.maps
    below = maps.flags(maps.start, flat.parameter_values())
    rows, first = [], 0
    for r in maps.orders:
        rows += [*below[first : first + r].tolist(), 0.0]
        first += r
    law = maps.start[maps.nstates :].tolist() if extension else []
    return [*rows[:count], *maps.start[: maps.nstates].tolist(), *law, *[0.0] * (own - extension)]


def _initial(flat: DerivedFlatSystem, start: ArrayLike | None, extension: int) -> Array:
    """States of the extension at the beginning."""
    if start is None:
        return flat.maps.start[flat.maps.nstates :][:extension].copy()
    found = finite_vector(start, "start", str(extension))
    if found.size != extension:
        raise ValueError(f"start must be {extension} states of the extension, got {found.size}")
    maps, p = flat.maps, flat.parameter_values()
    point = [flat.operating_point[name] for name in flat.state_labels]
    if not maps.is_regular(np.concatenate([point, found]), p):
        raise ValueError(
            f"start must be states of the extension at which the law of {flat.name} is regular, got {found.tolist()}, "
            "at which it is singular with the states of the operating point"
        )
    return found


def input_bounds(limits: InputLimits | None, flat: FlatSystem) -> tuple[Array, Array] | None:
    """Lower and upper limits of the inputs of a plant, infinite where none is given."""
    if limits is None:
        return None
    names = list(flat.input_labels)
    check_signals(tuple(limits), "limits", tuple(names), "input")
    pairs = {name: checked_range(pair, f"limits[{name!r}]") for name, pair in limits.items()}
    low, high = (np.array([pairs.get(name, (-np.inf, np.inf))[k] for name in names]) for k in (0, 1))
    return low, high
