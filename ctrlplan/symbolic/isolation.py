"""Trial calls of blocks without side effects."""

from __future__ import annotations

import pickle
import random
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._lru import BUILDING

T = TypeVar("T")


@contextmanager
def untouched() -> Iterator[None]:
    """Context of trial calls, one thread at a time because warning filters are global.

    Warnings and floating-point errors are suppressed, and the states of the global
    random generators (`random`, `numpy.random`) are restored: numbers that another
    thread draws meanwhile are drawn again.
    """
    with BUILDING:
        drawn, legacy = random.getstate(), np.random.get_state(legacy=False)  # noqa: NPY002
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        finally:
            if random.getstate() != drawn:
                random.setstate(drawn)
            if pickle.dumps(np.random.get_state(legacy=False)) != pickle.dumps(legacy):  # noqa: NPY002
                np.random.set_state(legacy)  # noqa: NPY002


def tried(call: Callable[[], T], otherwise: T) -> T:
    """Result of a trial call, or another value if it raises, for arguments outside of its domain.

    KeyboardInterrupt is passed on. `SystemExit` is treated as an error, since the
    block rejected the trial arguments.
    """
    try:
        return call()
    except (Exception, SystemExit):
        return otherwise


def same_answer(a: Iterable[ArrayLike] | None, b: Iterable[ArrayLike] | None) -> bool:
    """Whether two results of trial calls exist and are equal, entry by entry."""
    if a is None or b is None:
        return a is b
    return all(np.array_equal(one, other, equal_nan=True) for one, other in zip(a, b, strict=True))
