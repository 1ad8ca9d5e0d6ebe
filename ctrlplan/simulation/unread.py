"""Parameters that no block reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array, Params, System, Value
from ctrlplan.simulation.interpreted import Interpreted
from ctrlplan.simulation.network import Network
from ctrlplan.symbolic.isolation import tried, untouched
from ctrlplan.symbolic.keeper import Keeper
from ctrlplan.symbolic.references import References
from ctrlplan.symbolic.trials import reads
from ctrlplan.traits import traits_of

_PARAMS = 3
"""Position of the parameters among the arguments of a block's function."""


def is_read(network: Network, name: str, value: Value, start: Array, at_start: Callable[[], Array]) -> bool:
    """Whether a block reads a parameter near the initial state.

    Parameters
    ----------
    network : Network
        The blocks; they are called, and their memory is restored.
    name : str
        Name of the parameter.
    value : object
        Its value.
    start : ndarray, shape (nstates,)
        Initial state.
    at_start : callable
        Returns the initial values of the signals that are functions of time.
    """
    blocks = [i for i, block in enumerate(network.blocks) if not (block.linear or block.is_time_function)]
    functions = {i: [*_functions(network.blocks[i].system)] for i in blocks}
    # A call may take minutes, as with an optimising estimator: only functions that read parameters are called.
    tellers = {i: [f for f in functions[i] if reads(f, _PARAMS)] for i in blocks}
    if not any(tellers.values()):
        return False
    found = References((f"block {network.blocks[i].name}", f) for i in blocks for f in functions[i])
    if found.opaque:  # a call might have side effects: the names in the code decide
        return name in found.names or not found.names.isdisjoint(("keys", "values", "items"))
    keeper = Keeper(found)

    def signals() -> Array:
        return Interpreted(network, {name: value}, (0.0, start)).signals(0.0, start, at_start())

    read: set[str] = set()
    rng = np.random.default_rng(0)
    with untouched():
        w = tried(signals, np.zeros(network.nsignals))
        for i in blocks:
            recorder = _ReadRecorder({**network.blocks[i].params, name: value}, read)
            for scale in (0.0, 0.1, 1.0):
                x, u = start[network.states[i]], network.fed[i](w)
                x, u = (v + scale * rng.standard_normal(v.size) * (1.0 + np.abs(v)) for v in (x, u))
                for function in tellers[i]:
                    tried(partial(function, 10.0 * scale, x.copy(), u.copy(), recorder), None)
    keeper.restore()
    return name in read or _ReadRecorder.ALL in read


def _functions(system: System) -> Iterator[Callable[..., ArrayLike]]:
    """Functions of a block with parameters as an argument."""
    return filter(None, (system.outfcn, system.updfcn, traits_of(system).sample))


class _ReadRecorder(dict[str, Value]):
    """Parameters that record which of them are read."""

    ALL = ""

    def __init__(self, values: Params, read: set[str]) -> None:
        super().__init__(values)
        self.read = read

    def __getitem__(self, key: str) -> Value:
        self.read.add(key)
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        self.read.add(str(key))
        return super().__contains__(key)

    def get(self, key: str, default: Value = None) -> Value:
        self.read.add(key)
        return super().get(key, default)

    def __iter__(self) -> Iterator[str]:
        self.read.add(self.ALL)
        return super().__iter__()

    def keys(self) -> Value:
        self.read.add(self.ALL)
        return super().keys()

    def items(self) -> Value:
        self.read.add(self.ALL)
        return super().items()

    def values(self) -> Value:
        self.read.add(self.ALL)
        return super().values()
