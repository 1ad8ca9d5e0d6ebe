"""Command of a continuous linear loop with any zeros, for one plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.systems.feedforward.block import Accuracy, Method, PlannedFeedforward
from ctrlplan.systems.feedforward.inverse import Inverse, loop_inverse
from ctrlplan.systems.feedforward.preview import continuous_motion, preview_of
from ctrlplan.systems.feedforward.states import Dynamics, unstable_states
from ctrlplan.systems.feedforward.zeros import (
    Boundary,
    ComplexArray,
    Separation,
    eigenvalues,
    grows,
    largest_size,
    separation,
    tolerance,
    zero_list,
)
from ctrlplan.systems.source import PlanSource
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory

_GROWS = 1e-8
"""Relative size of a growing motion that counts as rounding."""

_SINGULAR = 1e-12
"""Singular value relative to the largest pole or zero up to which a matrix is singular."""


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Arguments of `create_feedforward_iosystem` for a plan."""

    error: float = 1e-6
    preview: float | None = None
    method: Method = "exact"
    finite: bool = False


def planned_feedforward(loop: ct.StateSpace, plan: Trajectory, options: PlanOptions, name: str) -> PlannedFeedforward:
    """Block of a continuous loop for a plan with one axis for each output."""
    if options.method != "exact":
        raise ValueError(f'method must be "exact" for a loop in continuous time, got {options.method!r}')
    inverse, poles = loop_inverse(loop), eigenvalues(loop.A)
    _check_smooth(plan, inverse.orders, loop.output_labels)
    size = largest_size(poles, eigenvalues(inverse.z))
    parts = separation(inverse.z, size, _real_part)
    if parts.boundary or parts.unstable.z.size:
        check_ends(plan)
    start = equilibrium(loop, inverse, parts, plan.initial, 0.0)
    left = [_remainder(group, inverse, plan, start, size) for group in parts.boundary]
    check_growth(left, plan.end, options.finite)
    sources = [PlanSource(plan, max(inverse.orders), f"{name}_plan", plan.labels)]
    preview, error, stable, state = options.preview or 0.0, 0.0, not grows(loop.A, size, _real_part), start.loop
    if parts.unstable.z.size:
        states = unstable_states(_dynamics(parts.unstable.z, parts.unstable.left, inverse, plan))
        shape = inverse.states @ parts.unstable.right
        motion = continuous_motion(loop, stable, parts.unstable.z, shape, states.departure, plan)
        preview, error = preview_of(motion, options.error, options.preview, poles, stable)
        states, state = states.with_preview(preview), state + shape @ motion.state(preview)
        sources.append(PlanSource(states, 0, f"{name}_states", states.labels))
    block = _inverse_block(inverse, parts, sources, loop.input_labels, f"{name}_inverse")
    declare(block, initial_state=start.own)
    known = Accuracy(
        start=plan.start - preview,
        preview=preview,
        error=error,
        zeros=parts.zeros,
        loop_state=state,
        stable=stable,
        remaining=oscillations(left),
        end_command=_end_command(inverse, parts, plan, start) if any(one.grows for one in left) else None,
    )
    return PlannedFeedforward(sources, block, loop.input_labels, name, known)


@dataclass(frozen=True, eq=False)
class Start:
    """Equilibrium with the plan constant at its first position.

    Attributes
    ----------
    internal : ndarray, shape (nzeros,)
        All states of the internal dynamics.
    own : ndarray
        Those of the part that is computed forward.
    loop : ndarray, shape (nstates,)
        States of the loop.
    command : ndarray, shape (ninputs,)
        Inputs of the loop.
    """

    internal: Array
    own: Array
    loop: Array
    command: Array


def equilibrium(loop: ct.StateSpace, inverse: Inverse, parts: Separation, position: Array, shift: float) -> Start:
    """Equilibrium at a position; `shift` is 0 for differential and 1 for difference equations.

    Raises
    ------
    ValueError
        If the loop cannot hold the position.
    """
    held, found = inverse.held(inverse.k, shift) @ position, list[Array]()
    for part in (parts.rest, parts.unstable):
        inner, given = part.z - shift * np.eye(len(part.z)), part.left @ held
        state = _least_squares(inner, -given, _SINGULAR * parts.size)
        terms = np.abs(inner) @ np.abs(state) + np.abs(part.left) @ np.abs(held)
        if np.any(np.abs(inner @ state + given) > _GROWS * terms.max(initial=0.0)):
            raise ValueError(
                f"plan must start at 0 for a loop with a zero at {shift:g}, which holds no other output, got "
                f"{np.array2string(position, separator=', ')}; shift its positions by the first one"
            )
        found.append(state)
    internal = parts.rest.right @ found[0] + parts.unstable.right @ found[1]
    command = inverse.c @ internal + inverse.held(inverse.d, shift) @ position
    rows = np.vstack([loop.A - shift * np.eye(loop.nstates), loop.C])
    right = np.concatenate([-loop.B @ command, position - loop.D @ command])
    state = np.linalg.lstsq(rows, right, rcond=None)[0] if loop.nstates else np.zeros(0)
    return Start(internal, found[0], state, command)


def _least_squares(matrix: Array, right: Array, limit: float) -> Array:
    """Solution of smallest norm, in which singular values up to a limit count as 0."""
    if not right.size:
        return right
    u, values, v = np.linalg.svd(matrix)
    large = values > limit
    return np.asarray(v[large].T @ (u[:, large].T @ right / values[large]))


def check_ends(plan: Trajectory) -> None:
    """Raise for a plan that never ends."""
    if not np.isfinite(plan.end):
        raise ValueError("plan must end, got one without an end; give a number of repetitions")


def _check_smooth(plan: Trajectory, orders: list[int], outputs: list[str]) -> None:
    """Raise unless the derivatives of each axis below its order are continuous."""
    highest = max(orders) - 1
    for jump in plan.jumps(highest) if highest >= 0 else ():
        axis = plan.labels.index(jump.label)
        if jump.order < orders[axis]:
            raise ValueError(
                f"derivative {jump.order} of plan axis {jump.label!r} must be continuous for output {outputs[axis]!r}, "
                f"of relative degree {orders[axis]}, got a jump of {jump.size:.3g} at {jump.time:g} s; use waypoints "
                f"with derivatives up to {orders[axis] - 1} at all ends"
            )


# Zeros on the stability boundary


@dataclass(frozen=True, eq=False)
class Remainder:
    """Motion that equal zeros on the stability boundary leave behind at the end of a plan.

    Attributes
    ----------
    group : Boundary
        The zeros.
    amplitudes : ndarray, shape (ninputs,)
        Amplitudes of the oscillation of the command; 0 for a zero at rest.
    grows : bool
        Whether the command grows after the plan.
    """

    group: Boundary
    amplitudes: Array
    grows: bool


def motion_left(
    group: Boundary,
    end: NDArray[np.inexact],
    largest: Array,
    held: NDArray[np.inexact],
    terms: Array,
    c: Array,
    shift: float,
    size: float,
) -> Remainder:
    """Motion of a group of zeros after a plan.

    Parameters
    ----------
    group : Boundary
        The zeros.
    end, held : ndarray, shape (n,)
        State and input at the end.
    largest, terms : ndarray, shape (n,)
        Maximum magnitudes of the states, and of the terms of the input, so far.
    c : ndarray, shape (ninputs, nzeros)
        Output matrix of the inverse.
    shift : float
        0 for differential and 1 for difference equations.
    size : float
        Magnitude of the largest pole or zero.
    """
    inner = group.z - shift * np.eye(len(end))
    if abs(group.zero - shift) <= tolerance(shift, size):
        motion, scale = inner @ end + held, np.abs(inner) @ largest + terms
        return Remainder(group, np.zeros(len(c)), bool(np.any(np.abs(motion) > _GROWS * scale)))
    departure = end + np.linalg.solve(inner, held)
    nilpotent = group.z - group.zero * np.eye(len(end))
    growing = np.abs(nilpotent @ departure) > tolerance(group.zero, size) * largest
    factor = 2.0 if group.zero.imag else 1.0
    return Remainder(group, factor * np.abs(c @ group.right @ departure), bool(growing.any()))


def check_growth(left: Sequence[Remainder], end: float, finite: bool) -> None:
    """Raise if the command grows after the plan, unless it is used up to its end only."""
    growing = [zero for one in left if one.grows for zero in one.group.members]
    if growing and not finite:
        raise ValueError(
            f"plan must leave the motion of zeros of loop at {zero_list(np.array(growing))} bounded, got a command "
            f"that grows after {end:g} s. For q zeros at 0 (discrete: at 1) the plan must end at 0, and the integrals "
            "of t^i y_d(t) must be 0 for i < q - 1; for multiple pairs the Fourier transform of y_d' must be 0 at "
            "their frequency. Choose such a plan, or give finite=True for a command that is used up to the end of the "
            "plan only"
        )


def oscillations(left: Sequence[Remainder], dt: float | None = None) -> tuple[tuple[float, Array], ...]:
    """Frequency [rad/s] and amplitudes of each bounded oscillation that remains."""
    found = []
    for one in left:
        frequency = one.group.zero.imag if dt is None else float(np.angle(one.group.zero)) / dt
        if frequency and not one.grows:
            found.append((frequency, one.amplitudes))
    return tuple(found)


def _remainder(group: Boundary, inverse: Inverse, plan: Trajectory, start: Start, size: float) -> Remainder:
    dynamics = _dynamics(group.z, group.left, inverse, plan)
    end, seen = dynamics.forward(group.left @ start.internal)
    extrema = plan.extrema()
    peaks = np.maximum(np.abs(extrema.minimum), np.abs(extrema.maximum))
    terms = inverse.held(np.abs(dynamics.k), 0.0) @ peaks
    return motion_left(group, end, np.abs(seen).max(axis=1), dynamics.held(plan.final), terms, inverse.c, 0.0, size)


# The block


def _dynamics(z: Array | ComplexArray, left: Array | ComplexArray, inverse: Inverse, plan: Trajectory) -> Dynamics:
    return Dynamics(z, left @ inverse.k, inverse.orders, plan)


def _end_command(inverse: Inverse, parts: Separation, plan: Trajectory, start: Start) -> Array:
    """Command at the end of the plan, with the plan at rest."""
    own, _ = _dynamics(parts.rest.z, parts.rest.left, inverse, plan).forward(start.own)
    unstable = parts.unstable
    held = np.linalg.solve(unstable.z, unstable.left @ inverse.held(inverse.k, 0.0) @ plan.final)
    internal = parts.rest.right @ own - unstable.right @ held
    return np.asarray(inverse.c @ internal + inverse.held(inverse.d, 0.0) @ plan.final)


def _inverse_block(
    inverse: Inverse, parts: Separation, sources: Sequence[PlanSource], outputs: Sequence[str], name: str
) -> ct.StateSpace:
    """Inverse with all outputs of the sources as inputs: the plan with its derivatives, then unstable states."""
    inputs = [f"{source.name}_{label}" for source in sources for label in source.output_labels]
    wide = max(inverse.orders) + 1
    columns = [j * wide + i for j, r in enumerate(inverse.orders) for i in range(r + 1)]
    rest = parts.rest
    k, d = np.zeros((len(rest.z), len(inputs))), np.zeros((len(outputs), len(inputs)))
    k[:, columns], d[:, columns] = rest.left @ inverse.k, inverse.d
    d[:, len(inverse.orders) * wide :] = inverse.c @ parts.unstable.right
    return ct.ss(rest.z, k, inverse.c @ rest.right, d, inputs=inputs, outputs=outputs, dt=0, name=name)


def _real_part(zero: complex) -> float:
    return zero.real
