"""Cause of a stalled numerical run: a block that is discontinuous, steep or random."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ctrlplan._types import Array, Params
from ctrlplan.simulation.network import Block, Network
from ctrlplan.symbolic.isolation import untouched
from ctrlplan.symbolic.trials import can_remember, trial_copy, values_of

Values = Callable[[float, Array, Array], Array | None]
"""(t, state, input) of a block -> its outputs and state derivatives; None outside its domain."""

_STEPS = 10.0 ** -np.arange(2.0, 13.0)
"""Distances, relative to the scale of an argument, at which a block is evaluated on both sides."""

_CLOSE, _LAST = 3, 4
"""Index of the first small distance, and the number of the smallest ones that decide."""

_JUMP, _STEEP, _DROP = 0.7, 0.15, 0.02
"""Change of values over a tenth of a distance, relative to that over the distance: 0.1 if they are smooth, 1 at a
jump, in between for an infinite slope; next to a jump it drops once the distance is too small to reach the jump."""

_ROUNDING = 1e-13
"""Relative change of values below which it counts as rounding."""

SMOOTHING = (
    "replace it with a steep continuous function, such as np.tanh(s/width) for np.sign(s) and "
    "np.clip(s/width, 0, 1) for s > 0, or give the block a fixed step by cp.sample_hold"
)


def unrepeatable(network: Network, params: Params, t: float, x: Array, w: Array) -> str:
    """Message on a block with different values for equal arguments; empty if there is none.

    Parameters
    ----------
    network : Network
        Network; its continuous blocks are called twice, on copies with their
        memory.
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
                    f"block {block.name} returns different values for equal arguments: it is random or depends on "
                    "earlier calls; give random values as samples of an input, and a memory as states or by "
                    "cp.sample_hold"
                )
    return ""


def cause(network: Network, params: Params, t: float, x: Array, w: Array, span: float) -> str:
    """Message on the cause of a stalled solver; empty if no block shows one.

    The cause is a discontinuity or an infinite slope in an argument of a block.
    """
    found = unrepeatable(network, params, t, x, w)
    if found:
        return found
    with untouched():
        for i, block, values in _continuous(network, params):
            state, fed = x[network.states[i]], network.fed[i](w)
            labels = ["t", *(block.system.state_labels or []), *(block.system.input_labels or [])]
            kinds = dict(zip(labels, _kinds(values, t, state, fed, span), strict=False))
            for kind, words, then in _WORDS:
                at = next((label for label, found in kinds.items() if found == kind), None)
                if at is not None:
                    return f"block {block.name} {words} {at}{then}: {SMOOTHING}"
    return ""


def _continuous(network: Network, params: Params) -> Iterator[tuple[int, Block, Values]]:
    """Nonlinear continuous blocks, and their values on copies with their memory."""
    for i, block in enumerate(network.blocks):
        if block.linear or block.is_time_function or block.period is not None:
            continue
        own = Block(trial_copy(block.system), block.params) if can_remember(block.system) else block
        yield i, block, _values(own, params)


def _values(block: Block, params: Params) -> Values:
    output, update = block.output(params), block.update(params)
    states = bool(block.system.nstates)

    def values(t: float, x: Array, u: Array) -> Array | None:
        outputs = values_of(output, t, x.copy(), u.copy())
        rates = values_of(update, t, x.copy(), u.copy()) if states else np.empty(0)
        return None if outputs is None or rates is None else np.concatenate([outputs, rates])

    return values


def _kinds(values: Values, t: float, x: Array, u: Array, span: float) -> Iterator[str]:
    """Kind of values over each argument: smooth (""), "jump" or infinite "slope"."""
    arguments = np.concatenate([[t], x, u])
    scales = np.maximum(np.abs(arguments), 1.0)
    scales[0] = span
    for j, scale in enumerate(scales.tolist()):
        pairs = []
        for step in _STEPS.tolist():
            sides = []
            for sign in (-1.0, 1.0):
                moved = arguments.copy()
                moved[j] += sign * step * scale
                sides.append(values(float(moved[0]), moved[1 : 1 + x.size], moved[1 + x.size :]))
            pairs.append(sides)
        known = [(low, high) for low, high in pairs if low is not None and high is not None]
        if len(known) < _STEPS.size or len({side.size for pair in known for side in pair}) > 1:
            yield ""
            continue
        low, high = (np.array(sides) for sides in zip(*known, strict=True))
        with np.errstate(all="ignore"):
            found = {_kind(np.abs(h - g), np.abs(h).max(initial=0.0)) for g, h in zip(low.T, high.T, strict=True)}
        yield next((kind for kind in ("jump", "slope") if kind in found), "")


_WORDS = (
    ("jump", "is discontinuous there in", ", and the solution stays at the discontinuity"),
    ("slope", "has an infinite slope there in", ""),
)
"""Kinds of `_kind` with their words; the first one found is reported."""


def _kind(changes: Array, size: float) -> str:
    """Kind of a value by its changes over decreasing distances."""
    if not np.isfinite(changes).all():
        return ""
    real = changes > _ROUNDING * size
    both = real[1:] & real[:-1]
    ratios = np.divide(changes[1:], changes[:-1], out=np.full(changes.size - 1, np.nan), where=both)
    last = ratios[-_LAST:][both[-_LAST:]]
    # A change that vanishes from one distance to the next: the jump lies in between.
    vanished = np.append(changes[1:] <= np.maximum(_DROP * changes[:-1], _ROUNDING * size), False) & real
    stays = np.array([bool(np.all(changes[k + 1 :] <= _DROP * changes[k])) for k in range(changes.size)])
    flat = np.append(False, ratios > 0.5 * _JUMP)
    if bool((vanished & stays & flat)[_CLOSE:].any()):
        return "jump"
    if last.size < 2 or np.median(last) <= _STEEP:
        return ""
    return "jump" if np.median(last) > _JUMP else "slope"
