"""Maps of a flat plant from its structure: states and controls of a flag by Newton's method, connected with a start.

Evaluated by numpy for arrays of flags, without CasADi.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctrlplan._types import Array
from ctrlplan.symbolic.tape import Tape

_SHORTEST = 2.0**-25
"""Smallest step, relative to the length of a path."""

_SHORTEST_TOGETHER = 2.0**-16
"""The same for many lines, of which those that are given up are tried with detours."""

TRIALS = 2000
"""Maximum number of steps along a path."""

_MOVED = 0.3
"""Distance in scales that a corrector may move."""

_CONTRACTION = 0.5
"""Ratio of successive Newton steps below which states are taken for those of neighbouring flags."""

_LONGEST = 10.0
"""Predicted change of a state in scales, or in its magnitude, above which a step is too long."""

SINGULAR = 1e-8
"""Smallest singular value of scaled slopes at a start below which they count as singular."""

_ITERATIONS = 12
_CONVERGED = 1e-13
"""Newton step in scales after which one more step reaches rounding."""

_CONVERGED_TOGETHER = 1e-8
"""Newton step, with slopes at its start, after which the error is rounding."""

TRIALS_TOGETHER = 100
"""Maximum number of steps along each of many lines."""


class SingularError(ValueError):
    """The states are not determined by a flag.

    Attributes
    ----------
    position : float
        Parameter of the path at which the search ended.
    """

    def __init__(self, message: str, position: float) -> None:
        super().__init__(message)
        self.position = position


@dataclass(frozen=True, eq=False)
class FlatMaps:
    """Flags of extended states, and their inverse.

    Attributes
    ----------
    orders : tuple of int
        Highest derivative of each flat output.
    nstates : int
        Number of states of the plant; those of the extension follow.
    flags, slopes : Tape
        y_j^(i), i < r_j, of all flat outputs as functions of (z, p), and their Jacobian.
    last : Tape
        y_j^(r_j) as functions of (z, mu, p), and their Jacobian by mu: (m, 1 + m).
    controls : Tape
        Controls of the plant as functions of (z, mu, p).
    forward : Tape
        Flags of (x, u, p) with u constant, all up to the highest order.
    sides : Tape
        Functions of (x, u, p) that are positive on the branch of the equations.
    notes : tuple of str
        Operation of each side.
    names : tuple of str
        Names of the entries of z.
    start : ndarray
        z at the operating point, or near it where that is singular.
    scales : ndarray
        Scales of z.
    mu : ndarray
        Controls of the extended plant at the start.
    mu_scales : ndarray
        Their scales.
    affine : bool
        Whether `last` is affine in mu.
    """

    orders: tuple[int, ...]
    nstates: int
    flags: Tape
    slopes: Tape
    last: Tape
    controls: Tape
    forward: Tape
    sides: Tape
    notes: tuple[str, ...]
    names: tuple[str, ...]
    start: Array
    scales: Array
    mu: Array
    mu_scales: Array
    affine: bool

    def angles(self, p: Array) -> NDArray[np.bool_]:
        """States of which multiples of 2 pi have no effect on flags and controls, (nz,)."""

        def values(at: Array) -> Array:
            mu = np.broadcast_to(self.mu[:, None], (self.mu.size, at.shape[1]))
            rows = self.flags(at, p), self.last(at, mu, p), self.controls(at, mu, p)
            return np.concatenate([row.reshape(-1, at.shape[1]) for row in rows])

        shift = 0.1 * self.scales * np.random.default_rng(5).uniform(-1.0, 1.0, self.start.size)
        z = (self.start + shift)[:, None]
        with np.errstate(all="ignore"):
            known, turned = values(z), values(z + math.tau * np.eye(self.start.size))
        size = np.maximum(np.abs(known), 1e-9 * np.abs(known).max(initial=1e-300))
        return np.asarray((np.abs(turned - known) <= 1e-9 * size).all(axis=0))

    def inputs_of(self, z: Array, last: Array, p: Array) -> tuple[Array, Array]:
        """Controls of the extended plant and of the plant for the highest derivatives, (m, ...); nan for none."""
        m, trailing = self.mu.size, z.shape[1:]
        z, last = z.reshape(len(z), -1), last.reshape(m, -1)
        mu = np.broadcast_to(self.mu[:, None], last.shape).copy()
        if self.affine:
            rows = self.last(z, mu, p)
            mu += _solved(rows[:, 1:], last - rows[:, 0])
        else:
            mu = self._connected_controls(z, mu, last, p)
        return mu.reshape(m, *trailing), self.controls(z, mu, p).reshape(-1, *trailing)

    def _connected_controls(self, z: Array, mu: Array, last: Array, p: Array) -> Array:
        """Controls (m, n) for the highest derivatives, connected with given ones along straight lines; nan without."""
        origin = self.last(z, mu, p)[:, 0]
        place, step = np.zeros(last.shape[1]), np.ones(last.shape[1])
        while (todo := np.flatnonzero((place < 1.0) & (step > _SHORTEST))).size:
            goal = np.minimum(place[todo] + step[todo], 1.0)
            wanted = np.where(goal < 1.0, origin[:, todo] + goal * (last[:, todo] - origin[:, todo]), last[:, todo])
            found, good = self._nearby_controls(z[:, todo], mu[:, todo], wanted, p)
            mu[:, todo[good]] = found[:, good]
            place[todo[good]] = goal[good]
            step[todo] *= np.where(good, 2.0, 0.5)
        mu[:, place < 1.0] = np.nan
        return mu

    def _nearby_controls(self, z: Array, mu: Array, last: Array, p: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Controls (m, n) for the highest derivatives by Newton's method, and whether they are near given ones."""

        def distance(first: Array, second: Array) -> Array:
            size = np.maximum(self.mu_scales[:, None], np.maximum(np.abs(first), np.abs(second)))
            return np.asarray(np.max(np.abs(first - second) / size, axis=0))

        with np.errstate(all="ignore"):
            rows = self.last(z, mu, p)
            sign = np.linalg.slogdet(np.moveaxis(rows[:, 1:], -1, 0))[0]
            predicted = found = mu + _solved(rows[:, 1:], last - rows[:, 0])
            for _ in range(_ITERATIONS):
                rows = self.last(z, found, p)
                step = _solved(rows[:, 1:], last - rows[:, 0])
                found = found + step
                size = distance(found, found - step)
                if (size < _CONVERGED).all():
                    break
            same = np.linalg.slogdet(np.moveaxis(self.last(z, found, p)[:, 1:], -1, 0))[0] == sign
            near = (distance(found, predicted) <= _MOVED) & (distance(predicted, mu) <= 10.0 * _MOVED)
            return found, (size < 1e-11) & near & same

    def refined(self, z: Array, flag: Array, p: Array, inverse: Array | None = None) -> tuple[Array, NDArray[np.bool_]]:
        """States z (nz, n) of flags (nz, n) from states near them, and whether they were found.

        `inverse`, (nz, nz, n), are the inverses of the slopes there, or near them.
        Only states to which the steps contract from the first one are found.
        """
        with np.errstate(all="ignore"):
            inverse = inverses(self.slopes(z, p)) if inverse is None else inverse
            scale = self.scales[:, None]
            before = np.full(z.shape[1], np.inf)
            near = np.ones(z.shape[1], dtype=bool)
            for k in range(_ITERATIONS):
                step = np.einsum("ijn,jn->in", inverse, flag - self.flags(z, p))
                z = z + step
                size = np.max(np.abs(step) / (scale + np.abs(z)), axis=0)
                near &= (size < _CONTRACTION * before) | (size < 1e-9)
                if not near.any():
                    break
                if (size < _CONVERGED).all() or (k > 4 and (size >= 0.5 * before).all()):
                    break
                if k % 5 == 4:  # slow: the slopes have changed
                    inverse = inverses(self.slopes(z, p))
                before = size
            found = np.isfinite(size) & (size < 1e-9) & near
        return z, found

    def predicted(
        self, z: Array, flags: Array, goals: Array, near: NDArray[np.intp], p: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """States (nz, n) of flags `goals` (nz, n) from known ones (nz, k) at the indices `near`, and which were found.

        Those to which Newton's method contracts, near the linear prediction.
        """
        with np.errstate(all="ignore"):
            inverse = np.take(inverses(self.slopes(z, p)), near, axis=2)
            start = np.take(z, near, axis=1)
            moved = np.einsum("ijn,jn->in", inverse, goals - np.take(flags, near, axis=1))
            trial, found = self.refined(start + moved, goals, p, inverse)
            found &= self._distances(trial, start + moved) <= _MOVED
            found &= (np.abs(moved) < _LONGEST * np.maximum(self.scales[:, None], np.abs(start))).all(axis=0)
        return trial, found

    def same_side(self, z: Array, p: Array) -> NDArray[np.bool_]:
        """Whether the slopes at states (nz, n) have the orientation of those at the start, or are singular.

        The orientation does not change along paths without singular points.
        """
        with np.errstate(all="ignore"):
            signs = np.linalg.slogdet(np.moveaxis(self.slopes(z, p), -1, 0))[0]
        return np.asarray(signs != -np.linalg.slogdet(self.slopes(self.start, p))[0])

    def followed(
        self,
        z: Array,
        path: Callable[[float], Array],
        p: Array,
        first: float = 0.0,
        last: float = 1.0,
        trials: int = TRIALS,
    ) -> Array:
        """State at the end of a path of flags, connected with the state at its start.

        Parameters
        ----------
        z : ndarray, shape (nz,)
            State at the start.
        path : callable
            Flag (nz,) at a parameter between `first` and `last`.
        p : ndarray
            Parameters.
        trials : int, optional
            Maximum number of steps, those that are too long included.

        Raises
        ------
        SingularError
            If the states are not determined at some point of the path.
        """
        place, step = first, last - first
        flag = path(first)
        slopes = self.slopes(z, p)
        sign = np.linalg.slogdet(slopes)[0]
        for _ in range(trials):
            step = min(step, last - place)
            goal = path(place + step)
            found = self._stepped(z, goal, flag, slopes, sign, p)
            if found is None:
                step *= 0.5
                if step < _SHORTEST * (last - first):
                    raise self._singular(z, place, p)
                continue
            z, slopes = found
            flag = goal
            if place + step >= last:
                return z
            place += step
            step *= 2.0
        raise self._singular(z, place, p)

    def followed_together(self, z: Array, flags: Array, p: Array, trials: int) -> tuple[Array, NDArray[np.bool_]]:
        """States (nz, n) followed from given ones (nz, n) along straight lines to flags (nz, n), and which were found.

        As `followed`, but all lines together.
        """
        z, origin = z.copy(), self.flags(z, p)
        place, step, flag = np.zeros(z.shape[1]), np.ones(z.shape[1]), origin.copy()
        with np.errstate(all="ignore"):
            slopes = self.slopes(z, p)
            signs, inverse = _signs(slopes), inverses(slopes)
            for _ in range(trials):
                todo = np.flatnonzero((place < 1.0) & (step > _SHORTEST_TOGETHER))
                if not todo.size:
                    break
                goal = np.minimum(place[todo] + step[todo], 1.0)
                line = origin[:, todo] + goal * (flags[:, todo] - origin[:, todo])
                wanted = np.where(goal < 1.0, line, flags[:, todo])
                moved = np.einsum("ijn,jn->in", inverse[:, :, todo], wanted - flag[:, todo])
                found, now, good = self._stepped_together(z[:, todo], moved, wanted, signs[todo], p)
                own = todo[good]
                z[:, own], flag[:, own], place[own] = found[:, good], wanted[:, good], goal[good]
                inverse[:, :, own] = inverses(now[:, :, good])
                step[todo] *= np.where(good, 2.0, 0.5)
        return z, place >= 1.0

    def _stepped_together(
        self, z: Array, moved: Array, wanted: Array, signs: Array, p: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """States of the next flags (nz, n), the slopes there, and which steps are not too long; as `_stepped`."""
        predicted = z + moved
        found, slopes = predicted.copy(), self.slopes(predicted, p)
        good = np.asarray((np.abs(moved) < _LONGEST * np.maximum(self.scales[:, None], np.abs(z))).all(axis=0))
        size, active = np.full(good.size, np.inf), np.flatnonzero(good)
        for k in range(_ITERATIONS):
            here = found[:, active]
            step = np.einsum("ijn,jn->in", inverses(slopes[:, :, active]), wanted[:, active] - self.flags(here, p))
            found[:, active] = here + step
            before, size[active] = size[active], self._distances(here + step, here)
            contracts = (k < 2) | (size[active] < _CONTRACTION * before) | (size[active] < 1e-9)
            good[active] &= contracts & (self._distances(here + step, predicted[:, active]) <= _MOVED)
            active = active[good[active]]
            if not active.size:
                break
            slopes[:, :, active] = self.slopes(found[:, active], p)
            active = active[size[active] >= _CONVERGED_TOGETHER]
            if not active.size:
                break
        good &= size < _CONVERGED_TOGETHER
        return found, slopes, good & (_signs(slopes) == signs)

    def followed_simply(self, z: Array, flag: Array, goal: Array, p: Array) -> Array | None:
        """State at the next flag if one step reaches it; otherwise None."""
        slopes = self.slopes(z, p)
        found = self._stepped(z, goal, flag, slopes, float(np.linalg.slogdet(slopes)[0]), p)
        return None if found is None else found[0]

    def _stepped(
        self, z: Array, goal: Array, flag: Array, slopes: Array, sign: float, p: Array
    ) -> tuple[Array, Array] | None:
        """State at the next flag and the slopes there; None if the step is too long."""
        with np.errstate(all="ignore"):
            try:
                predicted: Array = z + np.linalg.solve(slopes, goal - flag)
                found = predicted
                for k in range(_ITERATIONS):
                    now = self.slopes(found, p)
                    step = np.asarray(np.linalg.solve(now, goal - self.flags(found, p)), dtype=float)
                    found = found + step
                    if not np.isfinite(found).all() or self._distance(found, predicted) > _MOVED:
                        return None
                    size = self._distance(found, found - step)
                    if size < _CONVERGED or (k > 3 and size < 1e-11):
                        break
                else:
                    return None
            except np.linalg.LinAlgError:
                return None
            now = self.slopes(found, p)
            same = np.linalg.slogdet(now)[0] == sign and bool(
                (np.abs(predicted - z) < _LONGEST * np.maximum(self.scales, np.abs(z))).all()
            )
        return (found, now) if same else None

    def _distance(self, z: Array, other: Array) -> float:
        """Largest difference of two states, in scales or in magnitudes where these are larger."""
        return float(np.max(np.abs(z - other) / np.maximum(self.scales, np.maximum(np.abs(z), np.abs(other)))))

    def _distances(self, z: Array, other: Array) -> Array:
        """The same of states (nz, n)."""
        size = np.maximum(self.scales[:, None], np.maximum(np.abs(z), np.abs(other)))
        return np.asarray(np.max(np.abs(z - other) / size, axis=0))

    def _singular(self, z: Array, place: float, p: Array) -> SingularError:
        """Error that names the entry of z that is not determined."""
        return SingularError(f"{self.weakest(z, p)} is not determined by the flat outputs there", place)

    def is_regular(self, z: Array, p: Array) -> bool:
        """Whether a state is determined by its flags, and the controls by the highest derivatives, as at the start."""

        def matrices(at: Array) -> tuple[Array, Array]:
            return self.slopes(at, p) * self.scales, self.last(at, self.mu, p)[:, 1:] * self.mu_scales

        pairs = zip(matrices(self.start), matrices(z), strict=True)
        return all(regularity(b, np.abs(a).max(axis=1)) > 1e-6 * regularity(a) for a, b in pairs)

    def weakest(self, z: Array, p: Array) -> str:
        """Name of the entry of z that the flags determine worst."""
        scaled = self.slopes(z, p) * self.scales
        scaled = scaled / np.maximum(np.abs(scaled).max(axis=1, keepdims=True), 1e-300)
        weak = np.linalg.svd(scaled)[2][-1] if np.isfinite(scaled).all() else np.abs(z) / self.scales
        return self.names[int(np.argmax(np.abs(weak)))]


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions of linear systems (m, m, ...) with right sides (m, ...); nan where a matrix is singular."""
    m = right.shape[0]
    trailing = right.shape[1:]
    inverse = inverses(np.broadcast_to(matrix, (m, m, *trailing)).reshape(m, m, -1))
    return np.einsum("ijn,jn->in", inverse, right.reshape(m, -1)).reshape(right.shape)


def _signs(slopes: Array) -> Array:
    """Signs of the determinants of matrices (m, m, n); nan where they are not finite."""
    return np.asarray(np.linalg.slogdet(np.moveaxis(slopes, -1, 0))[0])


def inverses(matrices: Array) -> Array:
    """Inverses of matrices (m, m, n); nan where a matrix is singular."""
    stack = np.moveaxis(matrices, -1, 0)
    try:
        return np.moveaxis(np.asarray(np.linalg.inv(stack), dtype=float), 0, -1)
    except np.linalg.LinAlgError:
        out = np.full(stack.shape, np.nan)
        for k, matrix in enumerate(stack):
            with suppress(np.linalg.LinAlgError):
                out[k] = np.linalg.inv(matrix)
        return np.moveaxis(out, 0, -1)


def regularity(matrix: Array, peaks: Array | float = 0.0) -> float:
    """Smallest singular value relative to the largest entries of rows, at least `peaks`; 0 if not finite."""
    if not np.isfinite(matrix).all():
        return 0.0
    largest = np.maximum(np.abs(matrix).max(axis=1), peaks)[:, None]
    if not largest.all():
        return 0.0
    return float(np.linalg.svd(matrix / largest, compute_uv=False)[-1])
