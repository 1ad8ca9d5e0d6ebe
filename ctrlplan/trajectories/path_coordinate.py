"""The path parameter of a `PathPlan` as a coordinate that identifies the curve as well.

The parameters of all analytic pieces of all curves are placed on one axis, with gaps
between them. A value of this coordinate then determines the piece, also at its
ends, where the values of a function on both sides of a stop or of a breakpoint
differ; and functions of the coordinate can be continued beyond the ends of a piece,
as differences of high order require.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ctrlplan.trajectories.combined import Stacked
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.continuity import Jump
from ctrlplan.trajectories.internal import InternalTrajectory
from ctrlplan.trajectories.retimed import Retimed
from ctrlplan.trajectories.trajectory import Trajectory

LABEL = "path_parameter"
"""Name of the coordinate."""

_LEFT, _RIGHT = slice(None, -1), slice(1, None)

Numbers = NDArray[np.intp]


class Pieces:
    """Analytic pieces of curves, numbered in the order of travel.

    Attributes
    ----------
    curves : tuple of Trajectory
        The curves.
    curve : ndarray of int, shape (npieces,)
        Number of the curve of each piece.
    segment : ndarray of int, shape (npieces,)
        Number of the piece within its curve.
    intervals : list of (float, float)
        First and last parameter of each piece.
    offsets : ndarray, shape (npieces,)
        Coordinate minus parameter on each piece.
    """

    def __init__(self, curves: Sequence[Trajectory]) -> None:
        self.curves = tuple(curves)
        counts = [curve.breakpoints.size - 1 for curve in curves]
        self.curve = np.repeat(np.arange(len(counts)), counts)
        self.segment = np.concatenate([np.arange(count) for count in counts])
        self._first = np.cumsum([0, *counts])
        begins, ends = (np.concatenate([curve.breakpoints[part] for curve in curves]) for part in (_LEFT, _RIGHT))
        self.intervals = list(zip(begins.tolist(), ends.tolist(), strict=True))
        lengths = ends - begins
        gap = float(lengths.max())
        placed = begins[0] + np.concatenate([[0.0], np.cumsum(lengths[:-1] + gap)])
        self.offsets = readonly(placed - begins)
        self._limits = placed[1:] - 0.5 * gap
        self._begins = begins

    def number(self, curve: int, segment: int) -> int:
        """Number of a piece of a curve."""
        return int(self._first[curve]) + segment

    def located(self, coordinate: Array) -> tuple[Numbers, Array]:
        """Numbers of the pieces, and the parameters of their curves, for values of the coordinate."""
        numbers = np.searchsorted(self._limits, coordinate)
        return numbers, coordinate - self.offsets[numbers]

    def jet(self, numbers: Numbers, s: Array, order: int) -> Array:
        """Positions and derivatives by the parameter, shape (order + 1, 2, n)."""
        found = np.empty((order + 1, 2, s.size))
        for number in np.unique(numbers).tolist():
            own = np.flatnonzero(numbers == number)
            curve = self.curves[self.curve[number]]
            found[:, :, own] = curve.segment_jet(int(self.segment[number]), s[own] - self._begins[number], order)
        return found


def path_coordinate(parts: Sequence[Retimed], pieces: Pieces) -> Trajectory:
    """The coordinate over time, one axis.

    Parameters
    ----------
    parts : sequence of Retimed
        The curves with their time laws, one after the other in time.
    pieces : Pieces
        The pieces of the curves.
    """
    return _Coordinate(parts, pieces)


def with_coordinate(plan: Trajectory, coordinate: Trajectory) -> Trajectory:
    """Plan with its path coordinate as a further axis, for functions of the jet of both."""
    return _WithCoordinate((plan, coordinate), (*plan.labels, LABEL))


class _WithCoordinate(Stacked):
    def jumps(self, order: int) -> tuple[Jump, ...]:
        """Jumps of the derivatives; those of the coordinate itself are gaps between the pieces."""
        return tuple(jump for jump in super().jumps(order) if jump.order or jump.label != LABEL)


class _Coordinate(InternalTrajectory):
    what = "the coordinate of a path"

    parts: tuple[Retimed, ...]
    pieces: Pieces
    _segments: list[tuple[int, int]]  # part, and segment of the part

    def __init__(self, parts: Sequence[Retimed], pieces: Pieces) -> None:
        times = [parts[0].start, *(time for part in parts for time in part.breakpoints[1:].tolist())]
        self._set_fields(
            labels=(LABEL,),
            breakpoints=readonly(np.array(times)),
            parts=tuple(parts),
            pieces=pieces,
            _segments=[(k, j) for k, part in enumerate(parts) for j in range(part.breakpoints.size - 1)],
        )

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        k, own = self._segments[segment]
        inner, piece = self.parts[k].law_jet(own, s, order)
        found = inner.copy()
        found[0] += self.pieces.offsets[self.pieces.number(k, piece)]
        return found

    @property
    def in_batches(self) -> bool:
        """Whether segments are evaluated together, as those of a part are."""
        return any(part.in_batches for part in self.parts)

    def segments_jet(self, segments: NDArray[np.intp], s: Array, order: int) -> Array:
        """Derivatives, each time in its own segment; as `Trajectory.segments_jet`."""
        found, first = np.empty((order + 1, 1, s.size)), 0
        for k, part in enumerate(self.parts):
            last = first + part.breakpoints.size - 1
            own = np.flatnonzero((segments >= first) & (segments < last))
            inner, pieces = part.laws_jet(segments[own] - first, s[own], order)
            found[:, :, own] = inner
            found[0, 0, own] += self.pieces.offsets[self.pieces.number(k, 0) + pieces]
            first = last
        return found

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return type(self)([part.map_time(origin, target, rate) for part in self.parts], self.pieces)
