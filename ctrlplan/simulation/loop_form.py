"""Stable linear loop whose inputs are derivatives of one plan, and its exact propagation.

x' = A x + sum_k B_k r^(k),  y = C x + sum_k D_k r^(k)

Time is divided into cells whose lengths are powers of two. In a cell the input is
a Taylor polynomial, and one matrix maps the state at its start and the terms of the
input to the states at Chebyshev nodes; it does not depend on the plan, so that one
matrix for each length serves all plans and all durations. A cell is short where a
mode that has not decayed since the last breakpoint requires it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur, solve_continuous_lyapunov, solve_sylvester

from ctrlplan._types import Array
from ctrlplan.simulation.exact import changes_over, state_scale
from ctrlplan.simulation.linear import in_right_half

NTERMS = 18
"""Number of Taylor terms of an input in a cell."""

NODES = 24
"""Number of Chebyshev nodes of a cell."""

_REACH = 10.0
"""Product of a pole and the length of a cell up to which the nodes resolve its mode to 1e-13."""

_DECAY = 36.0
"""Exponent after which a mode has decayed to rounding."""

_ILL = 1e8
"""Condition of the eigenvectors above which they are not used."""

SIGMA = 0.5 + 0.5 * np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
"""Chebyshev nodes of a cell, as fractions of its length."""

_FACTORIALS = np.cumprod(np.concatenate([[1.0], np.arange(1.0, 64.0)]))


@dataclass(frozen=True, eq=False)
class Rows:
    """Outputs y = c x + sum_k d[k] r^(k) of a loop; c (nrows, nstates), d (nrows, order + 1, naxes)."""

    c: Array
    d: Array

    @property
    def order(self) -> int:
        """Highest derivative of the plan that contributes directly."""
        used = np.flatnonzero(self.d.any(axis=(0, 2)))
        return int(used.max(initial=0))

    def static(self, position: Array, state: Array) -> Array:
        """Values (nrows,) at a state, with the plan constant at a position."""
        return np.asarray(self.c @ state + self.d[:, 0] @ position)


@dataclass(frozen=True, eq=False)
class Kernel:
    """Propagation over a cell of one length, without the initial state itself.

    Attributes
    ----------
    nodes : ndarray, shape (NODES, nstates, nstates + nterms * naxes)
        Changes of the state from the start of the cell to its nodes, by the state
        and the Taylor terms of the plan in units of the length.
    end : ndarray, shape (nstates, nstates + nterms * naxes)
        The same to the end of the cell.
    """

    nodes: Array
    end: Array


class LoopForm:
    """Linear loop with derivatives of a plan as inputs, in balanced coordinates.

    Parameters
    ----------
    a : ndarray, shape (nstates, nstates)
        System matrix.
    b : ndarray, shape (order + 1, nstates, naxes)
        Input matrices of the derivatives of the plan.
    name : str
        Name of the loop, for messages.

    Raises
    ------
    ValueError
        If a pole is unstable, or undamped at a frequency other than 0.
    """

    def __init__(self, a: Array, b: Array, name: str) -> None:
        self.scale = state_scale(a)
        self.a: Array = a * (self.scale / self.scale[:, None])
        self.b: Array = b / self.scale[:, None]
        self.name = name
        self.order, self.nstates, self.naxes = len(b) - 1, len(a), b.shape[2]
        self.poles: NDArray[np.complex128] = np.linalg.eigvals(self.a).astype(complex)
        self.integrators = _count_integrators(self.a, self.poles)
        moving = self.poles[np.argsort(np.abs(self.poles))[self.integrators :]]
        self._check_poles(moving)
        self._alive = self._decay_times(moving)
        self._kernels: dict[int, Kernel] = {}

    def _check_poles(self, poles: NDArray[np.complex128]) -> None:
        unstable = poles[in_right_half(poles) & (poles.imag >= 0.0)]
        if unstable.size:
            worst = complex(unstable[unstable.real.argmax()])
            raise ValueError(
                f"the loop must be stable for limits on its signals, got {self.name} with a pole at {_pole(worst)} in "
                "the right half plane: its response grows without bound"
            )
        undamped = poles[(poles.real > -1e-9 * np.abs(poles)) & (poles.imag >= 0.0)]
        if undamped.size:
            raise ValueError(
                f"modes of the loop must be damped for limits on its signals at all times, got {self.name} with an "
                f"undamped pole at {_pole(complex(undamped[0]))}: its response does not settle"
            )

    def _decay_times(self, poles: NDArray[np.complex128]) -> tuple[Array, Array]:
        """Times [s] after which modes have decayed, increasing, and the largest magnitude of a pole that remains."""
        if not poles.size:
            return np.zeros(0), np.zeros(1)
        spread = math.log(min(self.condition, 1e12)) if math.isfinite(self.condition) else math.log(1e12)
        times = (_DECAY + spread) / -poles.real
        by = np.argsort(times)
        sizes = np.abs(poles[by])
        left = np.maximum.accumulate(sizes[::-1])[::-1]
        return times[by], np.append(left, 0.0)

    @cached_property
    def _modes(self) -> NDArray[np.complex128]:
        """Eigenvectors of the stable modes, in the coordinates of `split`."""
        stable, stable_left = self.split[2:]
        return np.asarray(np.linalg.eig(stable_left @ self.a @ stable)[1].astype(complex))

    @cached_property
    def condition(self) -> float:
        """Condition number of the eigenvectors of the stable modes; infinite for a defective matrix."""
        if self.integrators == self.nstates:
            return 1.0
        found = float(np.linalg.cond(self._modes))
        return found if math.isfinite(found) else math.inf

    @cached_property
    def split(self) -> tuple[Array, Array, Array, Array]:
        """Bases (nstates, .) and left bases (., nstates) of the integrators and of the stable modes."""
        n, m = self.nstates, self.integrators
        if not m:
            return np.zeros((n, 0)), np.zeros((0, n)), np.eye(n), np.eye(n)
        limit = float(np.sort(np.abs(self.poles))[m - 1]) * (1.0 + 1e-6) + 1e-300
        t, z, count = schur(self.a, output="real", sort=lambda re, im: bool(np.hypot(re, im) <= limit))
        if count != m:
            raise ValueError(f"integrators of {self.name} must be separable from its slow poles, got {count} of {m}")
        # Some releases of scipy reject equations without unknowns.
        y = solve_sylvester(t[:m, :m], -t[m:, m:], -t[:m, m:]) if m < n else np.zeros((n, 0))
        return z[:, :m], z[:, :m].T - y @ z[:, m:].T, z[:, :m] @ y + z[:, m:], z[:, m:].T

    @cached_property
    def nilpotent(self) -> Array:
        """Matrix of the integrators, in the coordinates of `split`."""
        right, left = self.split[:2]
        found: Array = left @ self.a @ right
        found[np.abs(found) <= 1e-7 * np.abs(self.a).max(initial=0.0)] = 0.0
        return found

    def settled(self, state: Array, position: Array, scale: float) -> Array:
        """State that the loop approaches from a state, with the plan constant at a position.

        Parameters
        ----------
        state : ndarray, shape (nstates,)
            State in balanced coordinates.
        position : ndarray, shape (naxes,)
            Position of the plan.
        scale : float
            Largest magnitude of the states along the plan.

        Raises
        ------
        ValueError
            If an integrator drifts, since its input is not zero.
        """
        constant, projection = self.settling(position)
        if self.integrators:
            left = self.split[1]
            drift = self.nilpotent @ (left @ state) + left @ self.b[0] @ position
            terms = np.abs(self.nilpotent).sum() * scale + np.abs(left) @ np.abs(self.b[0]) @ np.abs(position)
            if np.any(np.abs(drift) > 1e-8 * (terms + 1e-300)):
                raise ValueError(
                    f"the input of an integrator of {self.name} must be 0 at the end of the plan, got a drift of its "
                    f"state: limits on signals of the loop are not satisfied at all later times"
                )
        return np.asarray(constant + projection @ state)

    def settling(self, position: Array) -> tuple[Array, Array]:
        """State x1 and matrix P: the loop approaches x1 + P x from a state x, with the plan at a position."""
        right, left, stable, stable_left = self.split
        forced = stable_left @ self.b[0] @ position
        return stable @ np.linalg.solve(stable_left @ self.a @ stable, -forced), right @ left

    def decay_bounds(self, c: Array, states: Array) -> Array:
        """Bounds (nrows, nstates_given) of |c e^(A s) x| for all s >= 0, for states without integrator part."""
        stable, stable_left = self.split[2:]
        if not stable.size:
            return np.zeros((len(c), states.shape[1]))
        if self.condition <= _ILL:
            weights = np.linalg.solve(self._modes, (stable_left @ states).astype(complex))
            return np.asarray(np.abs(c @ stable @ self._modes) @ np.abs(weights))
        p = self._lyapunov
        inner = np.linalg.solve(p, (c @ stable).T)
        size = np.sqrt(np.maximum(np.einsum("ri,ir->r", c @ stable, inner), 0.0))
        own = stable_left @ states
        return np.asarray(size[:, None] * np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", own, p, own), 0.0)))

    @cached_property
    def _lyapunov(self) -> Array:
        """P with A' P + P A = -I of the stable modes: x' P x does not increase."""
        stable, stable_left = self.split[2:]
        a = stable_left @ self.a @ stable
        found = solve_continuous_lyapunov(a.T, -np.eye(len(a)))
        return np.asarray(0.5 * (found + found.T))

    def kernel(self, level: int) -> Kernel:
        """Propagation over a cell of 2^level seconds."""
        found = self._kernels.get(level)
        if found is None:
            found = self._kernels[level] = self._new_kernel(2.0**level)
        return found

    def _new_kernel(self, length: float) -> Kernel:
        n, m = self.nstates, (self.order + 1) * self.naxes
        sigma = np.append(SIGMA, 1.0)[:, None, None]
        b = np.moveaxis(self.b, 0, 1).reshape(n, m)
        if not n:
            width = (NTERMS + self.order) * self.naxes
            return Kernel(np.zeros((NODES, 0, width)), np.zeros((0, width)))
        changes = changes_over(length * sigma * self.a, length * sigma * b, NTERMS)[-1]
        own = changes[..., n:].reshape(sigma.size, n, NTERMS, self.order + 1, self.naxes)
        own = own * sigma[..., None, None] ** np.arange(NTERMS)[:, None, None]
        forced = np.zeros((sigma.size, n, NTERMS + self.order, self.naxes))
        for k in range(self.order + 1):  # term j of the k-th derivative, from term j + k of the plan
            factor = _FACTORIALS[k : k + NTERMS] / _FACTORIALS[:NTERMS] / length**k
            forced[:, :, k : k + NTERMS] += own[..., k, :] * factor[:, None]
        whole = np.concatenate([changes[..., :n], forced.reshape(sigma.size, n, -1)], axis=-1)
        return Kernel(whole[:-1], whole[-1])

    def schedule(self, duration: float, longest: float, whole: bool = True) -> tuple[Array, NDArray[np.intp]]:
        """Starts [s] and levels of the cells from a breakpoint on; the last may end after `duration`.

        Raises
        ------
        ValueError
            If there are too many, since a fast mode is hardly damped, and the `whole` duration is required.
        """
        times, sizes = self._alive
        starts, levels, s = [], [], 0.0
        edges = [*times.tolist(), math.inf]
        cells = 0
        for k, edge in enumerate(edges):
            until = min(edge, duration)
            if s >= until:
                continue
            limit = min(longest, _REACH / sizes[k] if sizes[k] > 0.0 else math.inf)
            level = math.floor(math.log2(limit)) if math.isfinite(limit) else math.ceil(math.log2(until))
            count = max(1, math.ceil((until - s) / 2.0**level * (1.0 - 1e-12)))
            cells += count
            if cells > _MOST and whole:
                self.raise_unsettled()
            count -= max(0, cells - _MOST)
            starts.append(s + 2.0**level * np.arange(count))
            levels.append(np.full(count, level))
            s += 2.0**level * count
            if cells >= _MOST:
                break
        return np.concatenate(starts), np.concatenate(levels)

    @cached_property
    def tail_schedule(self) -> tuple[Array, NDArray[np.intp]]:
        """Starts [s] and levels of the cells after the plan, until all modes have decayed or there are too many."""
        times = self._alive[0]
        if not times.size:
            return np.zeros(0), np.zeros(0, dtype=np.intp)
        return self.schedule(float(times[-1]), math.inf, whole=False)

    def check_settled(self) -> None:
        """Raise unless all modes have decayed within the cells after the plan."""
        if self.tail_schedule[1].size >= _MOST:
            self.raise_unsettled()

    def raise_unsettled(self) -> NoReturn:
        """Raise for modes that decay so slowly that their response is not evaluated to its end."""
        slow = complex(self.poles[np.argmax(self.poles.real / np.maximum(np.abs(self.poles), 1e-300))])
        raise ValueError(
            f"modes of the loop must decay within {_MOST} cells of the response, got {self.name} with a pole at "
            f"{_pole(slow)}, whose oscillation hardly decays; give the loop more damping, or leave the mode out"
        )


_MOST = 100_000
"""Maximum number of cells of a response."""


def _pole(value: complex) -> str:
    return f"{value.real:.4g}" if not value.imag else f"{value.real:.4g} ± {abs(value.imag):.4g}j rad/s"


def _count_integrators(a: Array, poles: NDArray[np.complex128]) -> int:
    """Number of poles at 0, those of a double integrator included, which rounding moves to 1e-8 of the largest."""
    if not a.size:
        return 0
    size = float(np.abs(a).max())
    if not size:
        return len(a)
    rows = np.abs(a).max(axis=1, keepdims=True)
    scaled = a / np.where(rows > 0.0, rows, 1.0)
    deficiency = int(np.count_nonzero(np.linalg.svd(scaled, compute_uv=False) <= 1e-12))
    small = np.sort(np.abs(poles)) / size
    for count in range(min(len(a), 4 * deficiency), 0, -1):
        if count < deficiency:
            break
        chain = count - deficiency + 1
        if small[count - 1] <= 10.0 * (len(a) * 2e-16) ** (1.0 / chain):
            return count
    return 0
