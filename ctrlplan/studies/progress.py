"""Bars on stderr: how many runs are done, and which one is running."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from tqdm import tqdm

_PLANS: ContextVar[bool] = ContextVar("bars over the plans of an experiment", default=False)


@contextmanager
def bars_over_plans(shown: bool) -> Iterator[None]:
    """Show, or do not show, a bar over the plans of each experiment that runs in this thread."""
    before = _PLANS.set(shown)
    try:
        yield
    finally:
        _PLANS.reset(before)


@contextmanager
def bar(count: int, label: str, progress: bool) -> Iterator[Callable[[], object]]:
    """Bar over runs, within which those of single plans have none."""
    with bars_over_plans(False):
        if not progress:  # a disabled bar would still import multiprocessing for its lock
            yield _nothing
            return
        with tqdm(total=count, desc=label, leave=False) as shown:
            yield shown.update


def _nothing() -> None:
    """Count a run without a bar."""


def each_plan(names: Sequence[str]) -> Iterator[str]:
    """Names of plans in order, with a bar if it is to be shown: the plan that runs, and how many are done."""
    if not _PLANS.get():
        yield from names
        return
    with tqdm(total=len(names), desc="plans", leave=False) as shown:
        for name in names:
            shown.set_postfix_str(name)
            yield name
            shown.update()
