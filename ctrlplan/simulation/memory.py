"""Memory of discrete blocks other than their states, the same at the beginning of each of many runs."""

from __future__ import annotations

import io
import pickle
import random
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FunctionType, MethodType, ModuleType
from weakref import WeakKeyDictionary

import control as ct
import numpy as np

from ctrlplan._renamed import outside_stacklevel
from ctrlplan._types import Frozen, System, Value
from ctrlplan.simulation.network import Block, Network
from ctrlplan.symbolic.keeper import Keeper
from ctrlplan.symbolic.libraries import is_impure, is_pure
from ctrlplan.symbolic.references import References
from ctrlplan.traits import traits_of

_GENERATORS = (random.Random, np.random.Generator, np.random.RandomState, np.random.BitGenerator)
"""Random generators, whose state is memory like any other."""

_GO_ON = (io.IOBase, *_GENERATORS)
"""Objects whose contents are not compared after a run: files go on from run to run, generators are restored."""

_RUNNING = threading.RLock()
"""Held during runs of blocks with memory, since loops may share objects."""

_CHANGED: WeakKeyDictionary[System, bool] = WeakKeyDictionary()
"""Blocks that a run has changed and that cannot be restored, and whether a warning was given."""


@contextmanager
def kept_memory(network: Network | None, is_discrete: bool) -> Iterator[None]:
    """Context of a run after which discrete blocks have the same memory as before.

    One thread at a time, if there are such blocks.

    Parameters
    ----------
    network : Network or None
        The blocks; their own functions are run.
    is_discrete : bool
        Whether the system is discrete, with all blocks.

    Warns
    -----
    UserWarning
        Once, if a previous run has changed an object that cannot be restored, such
        as a generator.
    """
    blocks = _remembering(network, is_discrete) if network is not None else []
    if not blocks:
        yield
        return
    with _RUNNING:
        memories = [_Memory(block) for block in blocks]
        try:
            yield
        finally:
            for memory in memories:
                memory.restore()


class _Memory:
    """Memory of a block before a run."""

    def __init__(self, block: Block) -> None:
        self._system = block.system
        found = References((f"block {block.name}", function) for function in _functions(block.system))
        self._keeper, self._complete = Keeper(found), found.complete
        drawn = {id(value): value for value in (*found.hidden, *found.objects) if isinstance(value, _GENERATORS)}
        self._generators = [rewind for value in drawn.values() if (rewind := _rewinding(value)) is not None]
        doubtful = [*found.hidden, *filter(_of_library, found.objects)]
        self._doubtful = [(value, _pickled(value)) for value in doubtful if not _goes_on(value)]
        if _CHANGED.get(block.system) is False:
            _CHANGED[block.system] = True
            warnings.warn(
                f"block {block.name} has objects that cannot be restored after a run, such as a generator: runs after "
                "the first start with what the block remembers; give a function that builds the loop",
                UserWarning,
                stacklevel=outside_stacklevel(),
            )

    def restore(self) -> None:
        """Restore what the block remembers, and note whether that is not possible."""
        self._keeper.restore()
        for rewind in self._generators:
            rewind()
        if not self._complete or any(_differs(value, before) for value, before in self._doubtful):
            _CHANGED.setdefault(self._system, False)


def _remembering(network: Network, is_discrete: bool) -> list[Block]:
    """Discrete blocks that may have memory."""
    pairs = zip(network.blocks, network.remember, strict=True)
    return [block for block, remembers in pairs if remembers and (is_discrete or block.period is not None)]


def _functions(system: System) -> Iterator[Callable[..., Value]]:
    """Functions of a block, and of the system that it samples."""
    if isinstance(system, ct.StateSpace):
        return
    if isinstance(system, ct.InterconnectedSystem):
        for block in system.syslist:
            yield from _functions(block)
        return
    traits = traits_of(system)
    if traits.block is not None:
        yield from _functions(traits.block)
    yield from filter(None, (system.updfcn, system.outfcn, traits.sample))


def _goes_on(value: object) -> bool:
    """Whether an object has no memory of a run, goes on, or is restored: a cache, a file, a random generator."""
    return isinstance(value, _GO_ON) or hasattr(value, "cache_info") or is_impure(type(value))


def _rewinding(value: object) -> Callable[[], None] | None:
    """Function that restores the present state of a random generator; None for those of the whole process.

    The functions of the modules `random` and `numpy.random` share the latter with all
    other code. A generator of the operating system has no state.
    """
    shared = [getattr(function, "__self__", None) for function in (random.random, np.random.normal)]
    if any(value is one for one in shared) or isinstance(value, random.SystemRandom):
        return None
    if isinstance(value, random.Random):
        return partial(value.setstate, value.getstate())
    if isinstance(value, np.random.RandomState):
        return partial(value.set_state, value.get_state(legacy=False))
    bits = value.bit_generator if isinstance(value, np.random.Generator) else value
    return partial(setattr, bits, "state", bits.state) if isinstance(bits, np.random.BitGenerator) else None


def _of_library(value: object) -> bool:
    """Whether an object of a library has attributes, which may refer to others that are not found."""
    no_memory = (Frozen, type, ModuleType, FunctionType, MethodType, partial, ct.InputOutputSystem)
    return is_pure(type(value).__module__) and hasattr(value, "__dict__") and not isinstance(value, no_memory)


def _differs(value: object, before: bytes | None) -> bool:
    """Whether an object may differ from what it was."""
    if before is not None:
        return _pickled(value) != before
    return isinstance(value, Iterator) or hasattr(value, "step") or not is_pure(type(value).__module__)


def _pickled(value: object) -> bytes | None:
    """State of an object; None if it cannot be read."""
    if isinstance(value, Iterator):
        return None
    try:
        return pickle.dumps(value)
    except Exception:  # any exception of an object
        return None
