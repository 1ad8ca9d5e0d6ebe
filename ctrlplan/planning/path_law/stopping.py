"""Plans that stop smoothly where the path requires a stop, and pass other points with one speed."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from ctrlplan.planning.path_law.spans import Joint, Span, closing_joint, spans_of
from ctrlplan.trajectories import PiecewisePolynomial, Retimed, Trajectory

_NEARLY = 0.1
"""Error of powers that are found from the velocity near a stop."""


class _Point(NamedTuple):
    """Point between two spans, or an end.

    Attributes
    ----------
    zeros : int or None
        Number of derivatives of the law that are 0 at a stop; None where the plan moves.
    ratio : float
        Speed of the plan before a point that it passes, relative to that after it.
    """

    zeros: int | None = None
    ratio: float = 1.0


def stopping(plan: Trajectory, order: int, lap: bool) -> Trajectory:
    """Plan with the same path and stops whose derivatives below an order are continuous, from time 0 on.

    At stops they are 0. Where the plan moves on in its direction with another speed,
    the time law makes both speeds equal.

    Parameters
    ----------
    plan : Trajectory
        Plan with a duration and without jumps of the position.
    order : int
        Order below which derivatives are continuous, at least 2; above the first, the
        plan's own must be 0 where its speed jumps.
    lap : bool
        Whether a cyclic plan stops at a corner between its end and its start.

    Returns
    -------
    Trajectory
        The plan; at its ends it has the speed of the given one.
    """
    start = plan.start
    own = plan.shift(-start)  # so that times have full precision
    spans, joints = spans_of(own, True, (), start)
    closing = closing_joint(own) if lap else None
    ends = closing if own.is_cyclic else None
    joints_and_ends: list[Joint | None] = [ends, *joints, ends]
    times = [float(own.breakpoints[span.segment] + span.start) for span in spans] + [own.end]
    around = zip([None, *spans], [*spans, None], joints_and_ends, strict=True)
    points = [_point(before, after, joint, order) for before, after, joint in around]
    chosen = [k for k, point in enumerate(points) if point != _Point() or k in (0, len(spans))]
    rows, lengths, rate = [], [], 1.0
    for j, k in pairwise(chosen):
        first, last = (0.0 if points[i].zeros is not None else rate for i in (j, k))
        if last and (not first or (k == len(spans) and (closing is not None or not lap))):
            last = 1.0  # after a stop, and where the speed at the end is given
        row, length = _polynomial(times[j], times[k], (first, points[j].zeros), (last, points[k].zeros), order)
        rows.append(row)
        lengths.append(length)
        rate = (last or 1.0) * points[k].ratio
    table = np.zeros((max(map(len, rows)), len(rows), 1))
    for segment, row in enumerate(rows):
        table[: len(row), segment, 0] = row
    law = PiecewisePolynomial(np.concatenate([[0.0], np.cumsum(lengths)]), table[::-1], labels=["s"])
    return Retimed(own, law)


def _point(before: Span | None, after: Span | None, joint: Joint | None, order: int) -> _Point:
    """How the law passes a point between two spans."""
    rests = [span.rests[side] for span, side in ((before, 1), (after, 0)) if span is not None and span.moves]
    inner = before is not None and after is not None
    stops = joint is not None and (joint.corner or (inner and joint.stops))
    if stops or (not inner and all(rests)):
        power = 1.0 + min(rests, default=order)  # of time since the stop, with which the position changes
        return _Point(max(0, math.ceil(order / power - _NEARLY) - 1))
    return _Point(ratio=joint.ratio) if inner and joint is not None else _Point()


def _polynomial(
    start: float, end: float, first: tuple[float, int | None], last: tuple[float, int | None], order: int
) -> tuple[list[float], float]:
    """Coefficients of a law from a time to another one, by powers of the time in between, and its duration [s].

    Ends are rates, 0 at a stop, with the numbers of zeros; elsewhere derivatives of the rate up to order - 2 are 0.
    """
    x = Polynomial([0.0, 1.0])
    if first[0] and last[0]:
        rise = ((x * (1.0 - x)) ** (order - 2)).integ()
        rate = first[0] + (last[0] - first[0]) * rise / float(rise(1.0))
    elif first[0] or last[0]:
        (moving, _), (_, zeros), away = (first, last, x) if first[0] else (last, first, 1.0 - x)
        # Up to the order, 1/(1 - x)^n makes the rate flat in front of its zeros.
        flat = (
            sum((math.comb(zeros - 1 + k, k) * away**k for k in range(order - 1)), Polynomial([0.0])) if zeros else 1.0
        )
        rate = moving * (1.0 - away) ** (zeros or 0) * flat
    else:
        rate = x ** (first[1] or 0) * (1.0 - x) ** (last[1] or 0)
        rate = rate / float(rate.integ()(1.0))
    whole = rate.integ()
    length = (end - start) / float(whole(1.0))
    return [start, *(length ** (1 - k) * c for k, c in enumerate(whole.coef.tolist()) if k)], length
