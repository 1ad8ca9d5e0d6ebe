"""Plans that stop smoothly where the path requires a stop."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.polynomial import Polynomial

from ctrlplan.planning.path_law.spans import Joint, Span, closing_joint, spans_of
from ctrlplan.trajectories import PiecewisePolynomial, Retimed, Trajectory

_NEARLY = 0.1
"""Error of powers that are found from the velocity near a stop."""

Stop = int | None
"""Number of derivatives of a time law that are 0 at a stop; None where the plan moves."""


def stopping(plan: Trajectory, order: int, lap: bool) -> tuple[Trajectory, tuple[float, ...]]:
    """Plan with the same path and the same stops, whose derivatives below an order are 0 at each of them.

    The time law from stop to stop is a polynomial with a rate that is 0 at the
    stops only.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration and without jumps of the position.
    order : int
        Order below which derivatives are 0 at stops, at least 2.
    lap : bool
        Whether a cyclic plan stops at a corner between its end and its start.

    Returns
    -------
    plan : Trajectory
        The plan; at its ends it has the speed of the given one.
    corners : tuple of float
        Times [s] of stops at corners of the path.
    """
    start = plan.start
    own = plan.shift(-start)  # so that times have full precision
    spans, joints = spans_of(own, True, (), start)
    closing = closing_joint(own) if lap and own.is_cyclic else None
    points: list[Joint | None] = [closing, *joints, closing]
    times = [float(own.breakpoints[span.segment] + span.start) for span in spans] + [own.end]
    beside = zip([None, *spans], [*spans, None], points, strict=True)
    kinds = [_stop(before, after, joint, order) for before, after, joint in beside]
    chosen = [k for k, kind in enumerate(kinds) if kind is not None or k in (0, len(spans))]
    rows = [_polynomial(times[j], times[k], kinds[j], kinds[k]) for j, k in pairwise(chosen)]
    table = np.zeros((max(map(len, rows)), len(rows), 1))
    for segment, row in enumerate(rows):
        table[: len(row), segment, 0] = row
    law = PiecewisePolynomial([times[k] for k in chosen], table[::-1], labels=["s"])
    corners = [k for k, joint in enumerate(points) if joint is not None and joint.corner]
    return Retimed(own, law).shift(start), tuple(start + times[k] for k in corners)


def _stop(before: Span | None, after: Span | None, joint: Joint | None, order: int) -> Stop:
    """Derivatives of the law that are 0 between two spans, so that those of the plan are below an order."""
    rests = [span.rests[side] for span, side in ((before, 1), (after, 0)) if span is not None and span.moves]
    if joint is None or not joint.corner:
        inner = before is not None and after is not None
        if not (joint is not None and joint.stops if inner else all(rests)):
            return None
    power = 1.0 + min(rests, default=order)  # of time since the stop, with which the position changes
    return max(0, math.ceil(order / power - _NEARLY) - 1)


def _polynomial(start: float, end: float, first: Stop, last: Stop) -> list[float]:
    """Coefficients of a law from a time to another one, by powers of the time in between."""
    x = Polynomial([0.0, 1.0])
    if first is None or last is None:  # 1 at an end in motion
        zeros, rest = (first, 1.0 - x) if last is None else (last, x)
        rate = (1.0 - rest) ** (zeros or 0) * (1.0 + (zeros or 0) * ((zeros or 0) + 2) * rest)
    else:
        rate = x**first * (1.0 - x) ** last
    length, whole = end - start, rate.integ()
    return [start, *(length ** (1 - k) * c / whole(1.0) for k, c in enumerate(whole.coef.tolist()) if k)]
