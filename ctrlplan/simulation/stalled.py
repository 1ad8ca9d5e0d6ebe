"""Why a numerical run does not get on: the block, and what it does there."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from ctrlplan.simulation.network import Block, Network
from ctrlplan.simulation.trials import can_remember, trial_copy, values_of
from ctrlplan.simulation.untouched import untouched

Array = NDArray[np.float64]
Values = Callable[[float, Array, Array], Array | None]
"""(t, state, input) of a block -> its outputs and rates; None outside of its domain."""

_STEPS = 10.0 ** -np.arange(2.0, 13.0)
"""Distances, relative to the scale of an argument, at which a block is asked on both sides."""

_CLOSE = 3
"""First of the distances at which a change counts as one of no distance."""

_JUMP, _STEEP = 0.3, 1e-2
"""Change over a close distance, relative to that over the largest one: of a jump, and of an infinite slope."""

SMOOTHING = (
    "replace it by a steep but continuous function, such as np.tanh(s/width) for np.sign(s) and "
    "np.clip(s/width, 0, 1) for s > 0, or give the block a fixed step by cp.sample_hold"
)


def unrepeatable(network: Network, params: dict[str, object], t: float, x: Array, w: Array) -> str:
    """Block that answers differently to equal arguments, in words; empty where none does.

    Parameters
    ----------
    network : Network
        Blocks, of which the continuous ones are called twice, on copies of what
        they remember.
    params : mapping
        Parameters of the run.
    t, x, w : float, ndarray, ndarray
        Time, state and signals of the network.
    """
    with untouched():
        for i, block, values in _continuous(network, params):
            state, fed = x[network.states[i]], network.fed[i](w)
            first, second = values(t, state, fed), values(t, state, fed)
            if first is not None and second is not None and not np.array_equal(first, second, equal_nan=True):
                return (
                    f"block {block.name} returns different values for equal arguments: it is random, or remembers its "
                    "calls. Give random values as samples of an input, and a memory as states or by cp.sample_hold"
                )
    return ""


def cause(network: Network, params: dict[str, object], t: float, x: Array, w: Array, span: float) -> str:
    """What keeps a solver at a time and state, in words; empty where no block shows it.

    A jump, or an infinite slope, in one of the arguments of a block.
    """
    found = unrepeatable(network, params, t, x, w)
    if found:
        return found
    with untouched():
        for i, block, values in _continuous(network, params):
            state, fed = x[network.states[i]], network.fed[i](w)
            labels = ["t", *(block.system.state_labels or []), *(block.system.input_labels or [])]
            worst, at = 0.0, ""
            for label, change in zip(labels, _changes(values, t, state, fed, span), strict=False):
                if change > worst:
                    worst, at = change, label
            if worst > _JUMP:
                return (
                    f"what block {block.name} returns jumps there with {at}, and the solution stays at the jump: "
                    + SMOOTHING
                )
            if worst > _STEEP:
                return f"what block {block.name} returns has an infinite slope there over {at}: " + SMOOTHING
    return ""


def _continuous(network: Network, params: dict[str, object]) -> Iterator[tuple[int, Block, Values]]:
    """Nonlinear continuous blocks, and their values on copies of what they remember."""
    for i, block in enumerate(network.blocks):
        if block.linear or block.driven or block.period is not None:
            continue
        own = Block(trial_copy(block.system), block.params) if can_remember(block.system) else block
        yield i, block, _values(own, params)


def _values(block: Block, params: dict[str, object]) -> Values:
    output, update = block.output(params), block.update(params)
    states = bool(block.system.nstates)

    def values(t: float, x: Array, u: Array) -> Array | None:
        outputs = values_of(output, t, x.copy(), u.copy())
        rates = values_of(update, t, x.copy(), u.copy()) if states else np.empty(0)
        return None if outputs is None or rates is None else np.concatenate([outputs, rates])

    return values


def _changes(values: Values, t: float, x: Array, u: Array, span: float) -> Iterator[float]:
    """Largest change of values over a close distance of each argument, relative to that over a large one."""
    arguments = np.concatenate([[t], x, u])
    scales = np.maximum(np.abs(arguments), 1.0)
    scales[0] = span
    for j, scale in enumerate(scales.tolist()):
        sizes = []
        for step in _STEPS.tolist():
            sides = []
            for sign in (-1.0, 1.0):
                moved = arguments.copy()
                moved[j] += sign * step * scale
                sides.append(values(float(moved[0]), moved[1 : 1 + x.size], moved[1 + x.size :]))
            apart = None if sides[0] is None or sides[1] is None else np.abs(sides[1] - sides[0])
            sizes.append(np.zeros(1) if apart is None or not np.isfinite(apart).all() else apart)
        count = max(size.size for size in sizes)
        table = np.array([size if size.size == count else np.zeros(count) for size in sizes])
        large = table[:_CLOSE].max(axis=0)
        close = table[_CLOSE:].max(axis=0)
        yield float(np.divide(close, large, out=np.zeros(count), where=large > 0.0).max(initial=0.0))
