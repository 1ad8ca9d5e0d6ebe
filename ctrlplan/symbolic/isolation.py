"""Calls of a block with made-up arguments, which leave nothing behind."""

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
    """Context of trial calls, one thread at a time: the filters of warnings belong to all.

    Warnings and floating-point errors do not show, and the global random
    generators (`random`, `numpy.random`) are left as they were: what another
    thread draws meanwhile is drawn again.
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
    """Result of a trial call, or another value where it raises: arguments outside of its domain.

    An interruption of the program passes; `SystemExit` counts as an error, for
    it was the made-up arguments that a block did not accept.
    """
    try:
        return call()
    except (Exception, SystemExit):
        return otherwise


def same_answer(a: Iterable[ArrayLike] | None, b: Iterable[ArrayLike] | None) -> bool:
    """Whether two results of trial calls are equal, entry by entry, where there are any."""
    if a is None or b is None:
        return a is b
    return all(np.array_equal(one, other, equal_nan=True) for one, other in zip(a, b, strict=True))
