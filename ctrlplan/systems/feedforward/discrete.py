"""Command of a discrete linear loop for one plan, exact at the samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.systems.feedforward.block import Accuracy, PlannedFeedforward
from ctrlplan.systems.feedforward.inverse import Inverse, loop_inverse
from ctrlplan.systems.feedforward.planned import (
    PlanOptions,
    Remainder,
    Start,
    check_ends,
    check_growth,
    equilibrium,
    motion_left,
    oscillations,
)
from ctrlplan.systems.feedforward.preview import discrete_motion, preview_of
from ctrlplan.systems.feedforward.reference import MAXIMUM, Reference, held_samples
from ctrlplan.systems.feedforward.zeros import (
    Boundary,
    ComplexArray,
    Separation,
    eigenvalues,
    grows,
    separation,
    zero_list,
)
from ctrlplan.systems.source import PlanSource
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory

_CANCELLED = 0.9
"""Magnitude of a zero up to which it is cancelled, and above whose inverse it is pre-actuated, at any angle."""

_SLOW = np.pi / 6.0
"""Angle of a zero up to which its mode is slow: at least 12 samples a period."""


def discrete_feedforward(loop: ct.StateSpace, plan: Trajectory, options: PlanOptions, name: str) -> PlannedFeedforward:
    """Block of a discrete loop for a plan with one axis for each output."""
    if isinstance(loop.dt, bool):
        raise ValueError(
            "loop must have a sampling time in seconds, got dt = True; give it to control.ss or control.tf"
        )
    command = discrete_command(loop, plan, options)
    source = PlanSource(command.signals, 0, f"{name}_plan", command.signals.labels)
    block = command.inverse_block(f"{name}_inverse")
    declare(block, initial_state=command.start.own)
    return PlannedFeedforward([source], block, loop.input_labels, name, command.known)


@dataclass(frozen=True, eq=False)
class DiscreteCommand:
    """Command of a discrete loop for a plan.

    Attributes
    ----------
    loop : control.StateSpace
        The loop at its samples.
    inverse : Inverse
        Its inverse, for "zpetc" that of the loop without the zeros that are not cancelled.
    parts : Separation
        The zeros.
    start : Start
        Equilibrium before the plan.
    given : ndarray, shape (nsignals, nsamples)
        Inputs of the internal states that are computed forward, then the part of
        the command that does not depend on them.
    signals : Trajectory
        The same as functions of time.
    known : Accuracy
        What is known of the command.
    """

    loop: ct.StateSpace
    inverse: Inverse
    parts: Separation
    start: Start
    given: Array
    signals: Trajectory
    known: Accuracy

    def inverse_block(self, name: str) -> ct.StateSpace:
        """System from `signals` to the command."""
        rest, own = self.parts.rest, len(self.parts.rest.z)
        inputs = self.loop.ninputs
        k, d = np.eye(own, own + inputs), np.eye(inputs, own + inputs, own)
        labels = [f"{name}_{label}" for label in self.signals.labels]
        return ct.ss(
            rest.z, k, self.inverse.c @ rest.right, d, float(self.loop.dt),
            inputs=labels, outputs=self.loop.input_labels, name=name,
        )  # fmt: skip

    def values(self, after: int) -> Array:
        """Commands (ninputs, ncommands) at all samples, and at further ones after the end of `signals`."""
        rest, own = self.parts.rest, len(self.parts.rest.z)
        given = np.hstack([self.given, np.repeat(self.given[:, -1:], after, axis=1)])
        states, state = np.empty((own, given.shape[1])), self.start.own
        for k in range(given.shape[1] if own else 0):
            states[:, k] = state
            state = rest.z @ state + given[:own, k]
        return np.asarray(self.inverse.c @ rest.right @ states + given[own:])


def discrete_command(loop: ct.StateSpace, plan: Trajectory, options: PlanOptions) -> DiscreteCommand:
    """Command of a loop with a sampling time for a plan with one axis for each output."""
    check_ends(plan)
    inverse, dt = loop_inverse(loop), float(loop.dt)
    zeros = eigenvalues(inverse.z)
    inverted, uncancelled = loop, zeros[:0]
    if options.method == "zpetc":
        inverted, uncancelled = _without_fast_zeros(loop, zeros)
        inverse = loop_inverse(inverted, inverse.orders[0] + uncancelled.size)
    else:
        _check_ringing(zeros)
    reference = Reference(plan, dt, uncancelled)
    parts = separation(inverse.z, 1.0, _outside)
    start = equilibrium(inverted, inverse, parts, plan.initial, 1.0)
    lead = max(inverse.orders)
    rows = reference.rows(-lead, inverse.orders)  # from sample -lead of the plan to its end
    left = [_remainder(group, inverse, start, rows) for group in parts.boundary]
    check_growth(left, plan.end, options.finite)
    ahead = _ahead(loop, inverse, parts, start, rows, plan, options, lead)
    values = np.vstack([parts.rest.left @ inverse.k @ ahead.rows, inverse.d @ ahead.rows])
    values[len(parts.rest.z) :] += inverse.c @ parts.unstable.right @ ahead.states
    before = np.concatenate(
        [
            parts.rest.left @ inverse.held(inverse.k, 1.0) @ plan.initial,
            start.command - inverse.c @ parts.rest.right @ start.own,
        ]
    )
    first = plan.start - (lead + ahead.count) * dt
    known = Accuracy(
        start=first,
        preview=(lead + ahead.count) * dt,
        method=options.method,
        error=ahead.error + reference.error(),
        zeros=zeros,
        loop_state=ahead.loop_state,
        stable=ahead.stable,
        remaining=oscillations(left, dt),
        gain=reference.gain() if options.method == "zpetc" else None,
    )
    command = DiscreteCommand(loop, inverse, parts, start, values, held_samples(first, dt, values, before), known)
    if any(one.grows for one in left):
        return replace(command, known=replace(known, end_command=command.values(0)[:, -1]))
    return command


@dataclass(frozen=True, eq=False)
class _Ahead:
    """Preview of a plan: samples before those of the look-ahead, and the states of unstable zeros.

    Attributes
    ----------
    count : int
        Number of samples.
    error : float
        Tracking error by the preview.
    stable : bool
        Whether the loop is stable.
    loop_state : ndarray
        State of the loop at the first sample.
    rows, states : ndarray, shapes (sum(r + 1), nsamples) and (nunstable, nsamples)
        Samples of the reference and of the states, with the preview.
    """

    count: int
    error: float
    stable: bool
    loop_state: Array
    rows: Array
    states: Array


def _ahead(
    loop: ct.StateSpace,
    inverse: Inverse,
    parts: Separation,
    start: Start,
    rows: Array,
    plan: Trajectory,
    options: PlanOptions,
    lead: int,
) -> _Ahead:
    """Preview that the zeros outside of the unit circle require."""
    stable, unstable = not grows(loop.A, 1.0, _outside), parts.unstable
    given = None if options.preview is None else max(math.ceil(options.preview / loop.dt - 1e-6) - lead, 0)
    if given is not None and given > MAXIMUM:
        raise ValueError(f"preview must be at most {MAXIMUM} samples of {loop.dt:g} s, got {options.preview:g} s")
    count, error, state, states = given or 0, 0.0, start.loop, np.zeros((0, rows.shape[1]))
    if unstable.z.size:
        states = _backward(unstable.z, unstable.left @ inverse.k @ rows)
        still, shape = unstable.left @ start.internal, inverse.states @ unstable.right
        motion = discrete_motion(loop, stable, unstable.z, shape, states[:, 0] - still, plan)
        preview, error = preview_of(motion, options.error, given, eigenvalues(loop.A), stable)
        if preview > MAXIMUM:
            raise ValueError(
                f"zeros of loop outside of the unit circle must require at most {MAXIMUM} samples of preview, got "
                f"{preview:.3g} for {zero_list(unstable.zeros)}; sample more slowly, or give a shorter preview="
            )
        count, state = int(preview), start.loop + shape @ motion.state(preview)
        back, before = np.linalg.inv(unstable.z), [states[:, 0] - still]
        for _ in range(count):
            before.append(back @ before[-1])
        states = np.hstack([still[:, None] + np.array(before[:0:-1]).reshape(count, len(still)).T, states])
    rows = np.hstack([np.repeat(rows[:, :1], count, axis=1), rows])
    return _Ahead(count, error, stable, state, rows, states if states.size else np.zeros((0, rows.shape[1])))


def _backward(z: Array, given: Array) -> Array:
    """Bounded states (n, nsamples) of x[k + 1] = z x[k] + given[k] with unstable z, at rest at the end."""
    state = np.linalg.solve(np.eye(len(z)) - z, given[:, -1])
    back, states = np.linalg.inv(z), [state]
    for column in given.T[-2::-1]:
        state = back @ (state - column)
        states.append(state)
    return np.array(states[::-1]).T


def _remainder(group: Boundary, inverse: Inverse, start: Start, rows: Array) -> Remainder:
    """Motion of zeros on the unit circle after the plan."""
    given, state = group.left @ inverse.k @ rows, group.left @ start.internal
    largest = np.abs(state)
    for column in given.T[:-1]:
        state = group.z @ state + column
        largest = np.maximum(largest, np.abs(state))
    terms = np.abs(group.left @ inverse.k) @ np.abs(rows).max(axis=1)
    return motion_left(group, state, largest, given[:, -1], terms, inverse.c, 1.0, 1.0)


def _check_ringing(zeros: ComplexArray) -> None:
    size = np.abs(zeros)
    ringing = zeros[(size > _CANCELLED) & (size < 1.0 / _CANCELLED) & _is_fast(zeros)]
    if ringing.size:
        raise ValueError(
            f"zeros of loop must not ring from sample to sample, got {zero_list(ringing)}, with abs(z) between 0.9 and "
            '1/0.9 and not near +1: the command would oscillate between samples. Give method="zpetc" for a loop with '
            "one input, which does not cancel them, or choose another sampling time"
        )


def _without_fast_zeros(loop: ct.StateSpace, zeros: ComplexArray) -> tuple[ct.StateSpace, ComplexArray]:
    """Loop of the same static gain without the zeros that zero phase error tracking does not cancel, and these."""
    if loop.ninputs > 1:
        raise ValueError(f'method must be "exact" for a loop with {loop.ninputs} inputs, got "zpetc", for one input')
    uncancelled = zeros[(np.abs(zeros) > _CANCELLED) & _is_fast(zeros)]
    c, d = loop.C.astype(complex), loop.D
    for zero in uncancelled:
        # c (A - zero)^-1 (z - A)^-1 B = G(z)/(z - zero), as G(zero) = 0.
        c, d = np.linalg.solve((loop.A - zero * np.eye(loop.nstates)).T, c.T).T, np.zeros_like(loop.D)
    inverted = ct.ss(loop.A, loop.B, (c * np.prod(1.0 - uncancelled)).real, d, loop.dt)
    return inverted, uncancelled


def _is_fast(zeros: ComplexArray) -> NDArray[np.bool_]:
    return np.asarray(np.abs(np.angle(zeros)) > _SLOW)


def _outside(zero: complex) -> float:
    return abs(zero) - 1.0
