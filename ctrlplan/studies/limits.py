"""Limits declared by the actuators of a loop, for the figures."""

from __future__ import annotations

from ctrlplan._types import System
from ctrlplan.traits import traits_of


def limits_of(loop: System) -> dict[str, tuple[float, float]]:
    """Limits of a loop's outputs by their labels.

    Parameters
    ----------
    loop : control system
        Loop with PID controllers and saturations, also inside nested networks,
        that declare their limits.

    Returns
    -------
    dict of str to (float, float)
        Minimum and maximum in the unit of the output; one may be infinite.
        Outputs without limits are omitted.
    """
    found: dict[str, tuple[float, float]] = {}
    for block in getattr(loop, "syslist", None) or ():
        found |= limits_of(block)
    for name, (_, low, high) in (traits_of(loop).watched or {}).items():
        found[name] = (float(low), float(high))
    known = loop.output_labels or ()
    return {name: pair for name, pair in found.items() if name in known}
