"""Trigonometric basis functions for `control.flatsys`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import control.flatsys as fs
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_count, checked_finite, checked_timepts
from ctrlplan._types import Array, Frozen
from ctrlplan.trajectories.common import FACTORIALS, readonly
from ctrlplan.trajectories.quadrature import gauss


class TrigFamily(Frozen, fs.BasisFamily):  # type: ignore[misc]
    r"""Trigonometric basis functions for `control.flatsys`.

    The functions span the trigonometric splines of equation (2) of the paper,

    .. math::
        a_0 + \sum_{k=1}^{m-1} (a_k \cos k\tau + b_k \sin k\tau)
            + a_m \sin m(\tau - \alpha/2), \quad \tau = \alpha (t - t_0)/T

    for N = 2m, and the full trigonometric polynomial of degree m for N = 2m + 1.
    They are not the harmonics, which become linearly dependent as alpha tends to
    0, but the orthogonal functions that follow from 1, sin v, cos v, sin 2v,
    cos 2v, ... with v = tau - alpha/2, in this order. Over the interval function i
    has the root mean square 1/(N sqrt(2 i + 1)), and it tends to the Legendre
    polynomial of degree i divided by N as alpha tends to 0. The factor 1/N gives the
    functions the size of Bernstein polynomials and B-splines, on which the
    tolerances of optimisers with finite differences depend. Each function is computed
    by a recurrence with three terms, which does not lose digits for any alpha.

    Parameters
    ----------
    N : int or sequence of int
        Number of basis functions; with `vars`, of each variable.
    T : float
        Duration of the interval [s].
    t0 : float, optional
        Start of the interval [s].
    alpha : float
        Angle tau over the interval [rad], above 0 and below 2 pi.
    vars : int, optional
        Number of variables (flat outputs). By default the basis is that of a single
        variable, for all flat outputs.

    Attributes
    ----------
    N : int
        Total number of basis functions.
    nvars : int or None
        Number of variables.
    T, t0, alpha : float
        The arguments.

    Raises
    ------
    TypeError
        If an argument is not a number.
    ValueError
        If `N`, `vars` or `T` is not positive, alpha is not in (0, 2 pi), or the
        numbers of functions are not one for each variable.

    Examples
    --------
    >>> import control as ct, control.flatsys as fs, ctrlplan as cp
    >>> plant = fs.LinearFlatSystem(ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0))
    >>> basis = cp.TrigFamily(6, 2.0, alpha=3.0)
    >>> move = fs.point_to_point(plant, 2.0, [0, 0], [0], [1, 0], [0], basis=basis)
    >>> move.eval([0.0, 1.0, 2.0])[0][0].round(9) + 0.0
    array([0. , 0.5, 1. ])
    """

    N: int
    nvars: int | None
    coef_offset: list[int]
    coef_length: list[int]
    T: float
    t0: float
    alpha: float

    def __init__(
        self, N: int | Iterable[int], T: float, *, t0: float = 0.0, alpha: float, vars: int | None = None
    ) -> None:
        nvars = None if vars is None else checked_count(vars, "vars", 1)
        sizes = [checked_count(n, "N", 1) for n in (N if isinstance(N, Iterable) else [N] * (nvars or 1))]
        if len(sizes) != (nvars or 1):
            wanted = "one number without vars" if nvars is None else f"one number, or one for each of {nvars} variables"
            raise ValueError(f"N must be {wanted}, got {len(sizes)}: {sizes}")
        angle = checked_finite(alpha, "alpha", above=0.0)
        if angle >= 2.0 * math.pi:
            raise ValueError(f"alpha must be above 0 and below 2 pi, got {angle:g}")
        self.__dict__.update(
            N=sum(sizes),
            nvars=nvars,
            coef_offset=[sum(sizes[:i]) for i in range(len(sizes))],
            coef_length=sizes,
            T=checked_finite(T, "T", above=0.0),
            t0=checked_finite(t0, "t0"),
            alpha=angle,
        )

    def __repr__(self) -> str:
        sizes = self.N if self.nvars is None else self.coef_length
        count = "" if self.nvars is None else f", vars={self.nvars}"
        return f"TrigFamily({sizes}, {self.T:g}, t0={self.t0:g}, alpha={self.alpha:g}{count})"

    def eval_deriv(self, i: int, k: int, t: ArrayLike, var: int | None = None) -> Any:
        """Derivative of a basis function.

        Parameters
        ----------
        i : int
            Number of the function, from 0.
        k : int
            Order of the derivative.
        t : array_like
            Times [s], of any shape; they may lie outside of the interval.
        var : int, optional
            Number of the variable, required if there are two or more.

        Returns
        -------
        float, or ndarray of the shape of `t`
            In 1/s^k.

        Raises
        ------
        ValueError
            If there is no such function or variable, or `k` is negative.
        """
        function, order = checked_count(i, "i"), checked_count(k, "k")
        if function >= self._size(var):
            raise ValueError(f"i must be below the number of basis functions, {self._size(var)}, got {function}")
        times = checked_timepts(t)
        position = (times - self.t0) / self.T - 0.5
        scale = float(FACTORIALS[order]) / (self._size(var) * self.T**order)
        if not times.ndim:
            return scale * _at_one(self.alpha, max(self.coef_length), order, float(position))[function]
        return scale * _taylor(self.alpha, function + 1, position.ravel(), order)[function, order].reshape(times.shape)

    def _size(self, var: int | None) -> int:
        """Number of basis functions of a variable."""
        if self.nvars is None or (self.nvars == 1 and var is None):
            return self.coef_length[0]
        if var is None:
            raise ValueError(f"var must be the number of a variable, below {self.nvars}, got None")
        number = checked_count(var, "var")
        if number >= self.nvars:
            raise ValueError(f"var must be the number of a variable, below {self.nvars}, got {number}")
        return self.coef_length[number]


@lru_cache(maxsize=64)
def _at_one(alpha: float, size: int, order: int, position: float) -> tuple[float, ...]:
    """Taylor coefficient of an order of all functions at one position: python-control evaluates one by one."""
    return tuple(_taylor(alpha, size, np.array([position]), order)[:, order, 0].tolist())


def _taylor(alpha: float, size: int, position: Array, order: int) -> Array:
    """Taylor coefficients (size, order + 1, ntime) about positions on the interval [-1/2, 1/2]."""
    found = np.empty((size, order + 1, position.size))
    square, odd = _factors(alpha, position, order)
    for parity in range(min(size, 2)):
        start, means, ratios = _recurrence(alpha, (size + 1 - parity) // 2, parity)
        before = np.zeros_like(square)
        now = start * (odd if parity else np.eye(order + 1, 1) + before)
        found[parity] = now
        for j in range(len(means)):
            before, now = now, (_product(square, now) - means[j] * now - ratios[j] * before) / ratios[j + 1]
            found[parity + 2 * j + 2] = now
    return found / np.sqrt(2.0 * np.arange(size) + 1.0)[:, None, None]


def _factors(alpha: float, position: Array, order: int) -> tuple[Array, Array]:
    """Taylor coefficients (order + 1, ntime) of 2 (1 - cos v)/alpha^2 and sin(v)/alpha, v = alpha position."""
    sine, cosine = np.sin(alpha * position), np.cos(alpha * position)
    square, odd = np.empty((2, order + 1, position.size))
    square[0], odd[0] = (2.0 / alpha * np.sin(0.5 * alpha * position)) ** 2, sine / alpha
    for k in range(1, order + 1):
        sign = (-1.0) ** ((k - 1) // 2) / FACTORIALS[k]
        square[k] = sign * 2.0 * (sine / alpha if k == 1 else alpha ** (k - 2) * (sine if k % 2 else cosine))
        odd[k] = (-1.0) ** (k // 2) / FACTORIALS[k] * alpha ** (k - 1) * (cosine if k % 2 else sine)
    return square, odd


@lru_cache(maxsize=64)
def _recurrence(alpha: float, count: int, parity: int) -> tuple[float, Array, Array]:
    """Scale of the first of `count` even or odd orthonormal functions, and coefficients of the recurrence."""
    nodes, weights = gauss(2 * count + int(2.0 * alpha) * (count + 1) + 16)
    square, odd = (rows[0] for rows in _factors(alpha, nodes - 0.5, 0))
    first = odd if parity else np.ones_like(nodes)
    start = 1.0 / math.sqrt(weights @ first**2)
    means, ratios = np.zeros(count - 1), np.zeros(count)
    before, now = np.zeros_like(nodes), start * first
    for j in range(count - 1):
        means[j] = weights @ (square * now**2)
        rest = (square - means[j]) * now - ratios[j] * before
        ratios[j + 1] = math.sqrt(weights @ rest**2)
        before, now = now, rest / ratios[j + 1]
    return start, readonly(means), readonly(ratios)


def _product(left: Array, right: Array) -> Array:
    """Product of two truncated Taylor series (order + 1, ntime)."""
    return np.stack([(left[: k + 1] * right[k::-1]).sum(axis=0) for k in range(len(left))])
