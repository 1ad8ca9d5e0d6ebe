"""Fingerprint of a system: a value that is equal only if nothing that a run depends on has changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import System
from ctrlplan.symbolic.references import References
from ctrlplan.traits import traits_of


def fingerprint(system: System) -> tuple[object, ...]:
    """Fingerprint of a system, equal only if nothing that a run depends on has changed."""
    params = getattr(system, "params", None)
    own = (id(system), str(system.name), system.dt, value_token(params) if params else ())
    # Labels with their numbers; lists of them would be sorted at each reading.
    labels = tuple(tuple(index.items()) for index in (system.input_index, system.output_index, system.state_index))
    if isinstance(system, ct.InterconnectedSystem):
        maps = tuple(np.asarray(m).tobytes() for m in (system.connect_map, system.input_map, system.output_map))
        return (own, labels, maps, tuple(fingerprint(block) for block in system.syslist))
    if isinstance(system, ct.StateSpace):
        return (own, labels, tuple(np.asarray(m).tobytes() for m in (system.A, system.B, system.C, system.D)))
    if isinstance(system, ct.TransferFunction):
        return (own, labels, _frozen([system.num, system.den]))
    # The functions themselves, not their addresses, which may be reused after deletion.
    functions = tuple(_frozen(getattr(system, name, None)) for name in ("updfcn", "outfcn"))
    # Traits are immutable and compared by identity.
    traits = traits_of(system)
    return (
        own,
        labels,
        functions,
        traits,
        () if traits.block is None else fingerprint(traits.block),
        _referred(system),
    )


def _frozen(value: object) -> object:
    """Hashable value that changes with a value."""
    if isinstance(value, Mapping):
        return tuple((key, _frozen(entry)) for key, entry in value.items())
    if isinstance(value, list | tuple):
        return tuple(_frozen(entry) for entry in value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes() if value.dtype != object else tuple(map(_frozen, value.ravel()))
    try:
        hash(value)
    except TypeError:
        return id(value)
    return value


def _referred(system: System) -> tuple[object, ...]:
    """Fingerprint of the objects that the functions of a block refer to, if they may be compiled."""
    traits = traits_of(system)
    if traits.plan is not None or traits.delay is not None:
        return ()
    found = References(roots_of(system))
    return found.tokens, found.cached


def value_token(value: object) -> tuple[object, ...]:
    """Fingerprint of a parameter."""
    return References([("params", value)]).tokens


def array_token(values: ArrayLike) -> tuple[object, ...]:
    """Fingerprint of an array of numbers."""
    array = np.asarray(values, dtype=float)
    return array.shape, array.tobytes()


def roots_of(system: System) -> Iterator[tuple[str, object]]:
    """Functions of a block in a compiled form; those of a sampled block are run by Python."""
    for name in ("outfcn",) if traits_of(system).period is not None else ("outfcn", "updfcn"):
        function = getattr(system, name, None)
        if function is not None:
            yield getattr(function, "__name__", name), function
