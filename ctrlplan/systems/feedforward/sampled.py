"""Command of a continuous loop with sampled controllers, and its ripple between samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import control as ct
import numpy as np
from scipy.linalg import block_diag, expm

from ctrlplan._types import Array, System
from ctrlplan.systems.feedforward.block import PlannedFeedforward
from ctrlplan.systems.feedforward.discrete import DiscreteCommand, discrete_command
from ctrlplan.systems.feedforward.planned import PlanOptions
from ctrlplan.systems.feedforward.zeros import eigenvalues
from ctrlplan.systems.hybrid import SampleHold, sample_hold
from ctrlplan.systems.source import PlanSource
from ctrlplan.traits import declare, traits_of
from ctrlplan.trajectories import Trajectory

_BETWEEN = 16
"""Number of times in a period at which the output is compared with the plan."""

_AFTER = 20_000
"""Maximum number of samples after the plan."""


def is_sampled(loop: object) -> bool:
    """Whether a system is an interconnection that contains a sampled block."""
    return isinstance(loop, ct.InterconnectedSystem) and any(
        isinstance(block, SampleHold) or traits_of(block).period is not None or is_sampled(block)
        for block in loop.syslist
    )


def sampled_feedforward(
    loop: ct.InterconnectedSystem, plan: Trajectory, options: PlanOptions, name: str
) -> PlannedFeedforward:
    """Block of a loop with `sample_hold` blocks for a plan with one axis for each output."""
    sampled = _sampled_loop(loop)
    command = discrete_command(sampled.loop, plan, options)
    source = PlanSource(command.signals, 0, f"{name}_plan", command.signals.labels)
    block = sample_hold(command.inverse_block(f"{name}_inverse"), sampled.dt)
    declare(block, initial_state=np.concatenate([command.start.own, command.start.command]))
    known = replace(command.known, ripple=_ripple(sampled, command, plan))
    return PlannedFeedforward([source], block, loop.input_labels, name, known)


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """Loop with held signals, from sample to sample.

    Attributes
    ----------
    loop : control.StateSpace
        The loop at its samples: states of the continuous blocks, then of the sampled
        ones, before the sample; outputs after it.
    dt : float
        Period [s].
    between : ndarray, shape (ntime, noutputs, nstates + ninputs)
        Outputs at times 0, ..., dt after a sample from states and inputs at the sample.
    """

    loop: ct.StateSpace
    dt: float
    between: Array


def _sampled_loop(loop: ct.InterconnectedSystem) -> SampledLoop:
    blocks = _leaves(loop)
    dt = _common_period(blocks)
    frozen = ct.linearize(_frozen(loop), 0, 0)
    # Columns of the frozen loop: continuous states x, states q and outputs h of sampled blocks; rows: u of these.
    x, q, h, u = _places(blocks)
    a, b, c = np.asarray(frozen.A), np.asarray(frozen.B), np.asarray(frozen.C)
    inner = [block.block for block in blocks if isinstance(block, SampleHold)]
    aq, bq, cq, dq = (block_diag(*(np.asarray(getattr(one, name)) for one in inner)) for name in "ABCD")
    nx, nq, m = len(x), len(q), loop.ninputs
    # At a sample: h = cq q + dq u with u = ux x + uh h + ur r.
    ux, uh, ur = a[np.ix_(u, x)], a[np.ix_(u, h)], b[u]
    closing = np.eye(len(h)) - dq @ uh
    if np.linalg.cond(closing) > 1e12:
        raise ValueError("sampled blocks of loop must not form an algebraic loop without a solution, got one")
    held = np.linalg.solve(closing, np.hstack([dq @ ux, cq, dq @ ur]))  # h from (x, q, r)
    seen = uh @ held + np.hstack([ux, np.zeros((len(u), nq)), ur])
    updated = bq @ seen + np.hstack([np.zeros((nq, nx)), aq, np.zeros((nq, m))])
    # Between samples x' = a x + [a_h, b] (h, r), which are constant.
    drive = np.hstack([a[np.ix_(x, h)], b[x]])
    constant = np.vstack([held, np.hstack([np.zeros((m, nx + nq)), np.eye(m)])])
    start = np.eye(nx, nx + nq + m)
    flow = np.block([[a[np.ix_(x, x)], drive], [np.zeros((drive.shape[1], nx + drive.shape[1]))]])
    outputs = np.hstack([c[:, x], c[:, h], np.asarray(frozen.D)])
    steps = [np.vstack([start, constant])]
    change = expm(dt / _BETWEEN * flow)
    for _ in range(_BETWEEN):
        steps.append(change @ steps[-1])
    whole = np.vstack([steps[-1][:nx], updated])
    between = np.array([outputs @ step for step in steps])
    n = nx + nq
    at_samples = ct.ss(
        whole[:, :n], whole[:, n:], between[0][:, :n], between[0][:, n:], dt,
        inputs=loop.input_labels, outputs=loop.output_labels, name=loop.name,
    )  # fmt: skip
    return SampledLoop(at_samples, dt, between)


def _leaves(system: System) -> list[System]:
    """Innermost blocks, in the order of their states."""
    if isinstance(system, ct.InterconnectedSystem) and not isinstance(system, ct.StateSpace):
        return [leaf for block in system.syslist for leaf in _leaves(block)]
    return [system]


def _common_period(blocks: list[System]) -> float:
    """Period of the sampled blocks; raises for blocks of other kinds."""
    periods = {}
    for block in blocks:
        if isinstance(block, SampleHold):
            if not isinstance(block.block, ct.StateSpace):
                raise TypeError(
                    f"sampled blocks of loop must be linear, got {block.name}, {type(block.block).__name__}"
                )
            if block.offset:
                raise ValueError(f"sampled blocks of loop must have offset 0, got {block.offset:g} s of {block.name}")
            periods[block.period] = block.name
        elif not isinstance(block, ct.StateSpace) or block.dt not in (None, 0):
            raise TypeError(
                f"blocks of loop must be linear and continuous, or sampled by sample_hold, got {block.name}, "
                f"{type(block).__name__}"
            )
    if len(periods) > 1:
        (first, a), (second, b) = list(periods.items())[:2]
        raise ValueError(f"sampled blocks of loop must have one period, got {first:g} s of {a} and {second:g} s of {b}")
    return float(next(iter(periods)))


def _frozen(system: System) -> System:
    """Loop in which sampled blocks hold their states, with integrals of their inputs as further states."""
    if isinstance(system, SampleHold):
        nq, nh, nu = system.block.nstates, system.noutputs, system.ninputs
        a, b = np.zeros((nq + nh + nu, nq + nh + nu)), np.vstack([np.zeros((nq + nh, nu)), np.eye(nu)])
        c = np.eye(nh, nq + nh + nu, nq)
        return ct.ss(
            a, b, c, 0, name=system.name, inputs=system.input_labels, outputs=system.output_labels,
            remove_useless_states=False,
        )  # fmt: skip
    if not isinstance(system, ct.InterconnectedSystem) or isinstance(system, ct.StateSpace):
        return system
    found = ct.InterconnectedSystem(
        [_frozen(block) for block in system.syslist],
        connections=[],
        inplist=[],
        outlist=[],
        inputs=system.input_labels,
        outputs=system.output_labels,
        name=system.name,
        params=system.params,
    )
    found.set_connect_map(system.connect_map)
    found.set_input_map(system.input_map)
    found.set_output_map(system.output_map)
    return found


def _places(blocks: list[System]) -> tuple[list[int], list[int], list[int], list[int]]:
    """Rows of the frozen loop: continuous states, then states, outputs and inputs of sampled blocks."""
    found: tuple[list[int], list[int], list[int], list[int]] = ([], [], [], [])
    first = 0
    for block in blocks:
        sampled = isinstance(block, SampleHold)
        counts = (0, block.block.nstates, block.noutputs, block.ninputs) if sampled else (block.nstates, 0, 0, 0)
        for places, count in zip(found, counts, strict=True):
            places += range(first, first + count)
            first += count
    return found


def _ripple(sampled: SampledLoop, command: DiscreteCommand, plan: Trajectory) -> Array:
    """Maximum deviation of each output from the plan at any time, from samples and times between them."""
    loop, known = sampled.loop, command.known
    sizes = np.abs(np.concatenate([eigenvalues(loop.A), known.zeros]))
    slowest = float(sizes[sizes < 1.0 - 1e-9].max(initial=0.0))
    after = min(_AFTER, math.ceil(10.0 / -math.log(slowest)) if slowest > 0.0 else 0) + loop.nstates
    commands = command.values(after)
    states = np.empty((loop.nstates, commands.shape[1]))
    state = command.start.loop if known.stable else known.loop_state
    for k, value in enumerate(commands.T):
        states[:, k] = state
        state = loop.A @ state + loop.B @ value
    given, largest = np.vstack([states, commands]), np.zeros(loop.noutputs)
    times = known.start + sampled.dt * np.arange(commands.shape[1])
    for k, rows in enumerate(sampled.between):
        wanted = plan.jet(times + sampled.dt * k / _BETWEEN, 0)[0]
        largest = np.maximum(largest, np.abs(rows @ given - wanted).max(axis=1))
    return largest
