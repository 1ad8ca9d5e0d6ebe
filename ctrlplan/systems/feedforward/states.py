"""States of internal dynamics along a plan: forward from its start, or backward from its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ctrlplan._types import Array
from ctrlplan.systems.feedforward.inverse import first_columns
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.common import FACTORIALS
from ctrlplan.trajectories.internal import InternalTrajectory

_TERMS = 24
"""Number of Taylor terms in a cell."""

_REACH = 2.0
"""Product of a zero and the length of a cell up to which the Taylor series of the states is used."""

_MOST = 50_000
"""Maximum number of cells of a plan."""


@dataclass(frozen=True, eq=False)
class Dynamics:
    """x' = z x + k Y, where Y contains y, ..., y^(r) of each axis of a plan.

    Attributes
    ----------
    z : ndarray, shape (n, n)
        Real or complex.
    k : ndarray, shape (n, sum(r + 1))
        Input matrix.
    orders : sequence of int
        r of each axis.
    plan : Trajectory
        The plan.
    """

    z: NDArray[np.inexact]
    k: NDArray[np.inexact]
    orders: list[int]
    plan: Trajectory

    def held(self, position: Array) -> NDArray[np.inexact]:
        """Input k Y with the plan constant at a position."""
        return self.k[:, first_columns(self.orders)] @ position

    def inputs(self, segment: int, s: Array, order: int) -> NDArray[np.inexact]:
        """Derivatives (order + 1, n, ntime) of k Y at times since the start of a segment."""
        jet = self.plan.segment_jet(segment, s, order + max(self.orders))
        found = np.zeros((order + 1, len(self.k), s.size), dtype=self.k.dtype)
        column = 0
        for axis, r in enumerate(self.orders):
            for i in range(r + 1):
                found += self.k[:, column, None] * jet[i : i + order + 1, axis][:, None, :]
                column += 1
        return found

    def forward(self, start: NDArray[np.inexact]) -> tuple[NDArray[np.inexact], NDArray[np.inexact]]:
        """States at the end, and at the starts of all cells (n, ncells), from the state at the start."""
        state, seen = start, [start]
        for cells in self.cells():
            change = expm(cells.length * self.z)
            for response in cells.response.T:
                state = change @ state + response
                seen.append(state)
        return state, np.array(seen).T

    def cells(self) -> list[Cells]:
        """Cells of all segments."""
        spans = np.diff(self.plan.breakpoints)
        fastest = float(np.abs(np.linalg.eigvals(self.z)).max(initial=0.0))
        if fastest * spans.sum() > _REACH * _MOST:
            raise ValueError(
                f"zeros of loop that are not stable must be below {_REACH * _MOST / spans.sum():.3g} rad/s for a plan "
                f"of {spans.sum():g} s, got {fastest:.4g} rad/s; model the loop without such fast dynamics"
            )
        return [self._cells(segment, float(span), fastest) for segment, span in enumerate(spans)]

    def _cells(self, segment: int, span: float, fastest: float) -> Cells:
        count = max(1, int(np.ceil(span * fastest / _REACH)))
        while True:
            length = span / count
            starts = length * np.arange(count).astype(float)
            inputs = self.inputs(segment, starts, _TERMS - 1)
            terms = inputs * (length ** np.arange(_TERMS) / FACTORIALS[:_TERMS])[:, None, None]
            sizes = np.abs(terms).max(axis=(1, 2))
            if sizes[-4:].max() <= 1e-17 * sizes.max():
                break
            count *= 2
            if count > _MOST:
                raise ValueError(
                    f"derivatives of plan must stay within those of {_MOST} polynomials in a segment of {span:g} s, "
                    "got faster ones"
                )
        return Cells(length, terms, series(self.z, length, terms, np.zeros(terms.shape[1:])).sum(axis=0))


def unstable_states(dynamics: Dynamics) -> _UnstableStates:
    """Bounded states of unstable internal dynamics along a plan, as a trajectory."""
    return _UnstableStates(dynamics)


@dataclass(frozen=True, eq=False)
class Cells:
    """Equal cells of a segment.

    Attributes
    ----------
    length : float
        Length of a cell [s].
    terms : ndarray, shape (nterms, n, ncells)
        Taylor terms of the input at the start of each cell, in units of the length.
    response : ndarray, shape (n, ncells)
        State at the end of each cell from 0 at its start.
    """

    length: float
    terms: NDArray[np.inexact]
    response: NDArray[np.inexact]


def series(
    z: NDArray[np.inexact], length: float, terms: NDArray[np.inexact], starts: NDArray[np.inexact]
) -> NDArray[np.inexact]:
    """Taylor terms (nterms + 1, n, ncells) of the states, from those of the input and the states at the starts."""
    found = [starts.astype(terms.dtype)]
    for k, term in enumerate(terms):
        found.append(length * (z @ found[-1] + term) / (k + 1))
    return np.array(found)


class _UnstableStates(InternalTrajectory):
    """States of the unstable part of internal dynamics: bounded, hence backward from the end of the plan.

    They begin at equilibrium, at the start of a preview jump to the free motion that
    leads to the state at the start of the plan, and end at equilibrium.
    """

    what = "the course of internal states"
    initial: Array
    final: Array
    dynamics: Dynamics
    ahead: int
    _held: Array
    _departure: Array
    _lengths: tuple[float, ...]
    _series: tuple[Array, ...]

    def __init__(self, dynamics: Dynamics) -> None:
        plan = dynamics.plan
        first, last = (-np.linalg.solve(dynamics.z, dynamics.held(position)) for position in (plan.initial, plan.final))
        state, rows = last, []
        cells = dynamics.cells()
        for own in reversed(cells):
            change, starts = expm(-own.length * dynamics.z), []
            for response in own.response.T[::-1]:
                state = change @ (state - response)
                starts.append(state)
            rows.append(series(dynamics.z, own.length, own.terms, np.array(starts[::-1]).T))
        self._set_fields(
            labels=tuple(f"x{i}" for i in range(len(first))),
            breakpoints=plan.breakpoints,
            initial=first,
            final=last,
            dynamics=dynamics,
            ahead=0,
            _held=first,
            _departure=state - first,
            _lengths=tuple(own.length for own in cells),
            _series=tuple(rows[::-1]),
        )

    @property
    def departure(self) -> Array:
        """State at the start of the plan minus the equilibrium before it."""
        return self._departure

    def with_preview(self, preview: float) -> _UnstableStates:
        """The same with a free motion before the start of the plan."""
        if not preview:
            return self
        fastest = float(np.abs(np.linalg.eigvals(self.dynamics.z)).max())
        marks = [0.0]  # times before the plan, farther apart where fast modes are not present any more
        while marks[-1] < preview:
            marks.append(min(preview, max(4.0 / fastest, 2.0 * marks[-1])))
        start = self.dynamics.plan.start
        times = np.concatenate([start - np.array(marks[:0:-1]), self.breakpoints])
        return self._with_fields(breakpoints=times, ahead=len(marks) - 1)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        z, own = self.dynamics.z, segment - self.ahead
        if own < 0:
            before = self.breakpoints[segment] - self.breakpoints[self.ahead]
            free = expm((before + s)[:, None, None] * z) @ self._departure
            found = [free.T + self._held[:, None]]
            forced: NDArray[np.inexact] = np.zeros((order, len(z), s.size))
            forced[:1] = -(z @ self._held)[:, None]
        else:
            length, terms = self._lengths[own], self._series[own]
            cell = np.clip((s / length).astype(np.intp), 0, terms.shape[2] - 1)
            sigma = s / length - cell
            value = np.zeros((len(z), s.size))
            for term in terms[::-1]:
                value = value * sigma + term[:, cell]
            found = [value]
            forced = self.dynamics.inputs(own, s, order - 1) if order else np.zeros((0, len(z), s.size))
        for term in forced:
            found.append(z @ found[-1] + term)
        return np.array(found)
