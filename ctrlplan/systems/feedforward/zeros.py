"""Zeros of a loop, separated by the stability of the internal dynamics of its inverse."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, schur, solve_sylvester

from ctrlplan._types import Array

ComplexArray = NDArray[np.complex128]

Distance: TypeAlias = Callable[[complex], float]
"""Signed distance of a pole or zero from the stability boundary, positive if it is unstable."""

_ON_BOUNDARY = 1e-8
"""Distance from the stability boundary, relative to the zero itself, up to which a zero is on it."""

_UNCERTAIN = 1e-10
"""The same relative to the largest pole or zero, whose rounding errors move the others."""

_NILPOTENT = 1e-10
"""Relative size of a power of a matrix that counts as 0."""

_ROUNDED = 1e-13
"""Rounding error of a power relative to the largest pole or zero."""

_APART = 4.0
"""Ratio of the magnitudes of zeros from which on they are decoupled."""

_MULTIPLE = 3
"""Highest multiplicity of zeros on the boundary that is found."""


@dataclass(frozen=True, eq=False)
class Part:
    """Invariant subspace of the internal dynamics.

    Attributes
    ----------
    z : ndarray, shape (n, n)
        The dynamics in it.
    right, left : ndarray, shapes (nzeros, n) and (n, nzeros)
        Basis, and the projection: eta = right @ own, own = left @ eta.
    """

    z: Array
    right: Array
    left: Array

    @property
    def zeros(self) -> ComplexArray:
        """The zeros of this part."""
        return np.linalg.eigvals(self.z).astype(complex) if self.z.size else np.zeros(0, dtype=complex)


def whole(z: Array) -> Part:
    """The internal dynamics as one part."""
    return Part(z, np.eye(len(z)), np.eye(len(z)))


def separated(part: Part, belongs: Callable[[complex], bool]) -> tuple[Part, Part]:
    """Part with the zeros for which a function of them is true, and the part with the others.

    By an ordered real Schur form and a Sylvester equation; of a complex pair the zero
    with the positive imaginary part is tested.
    """
    if not part.z.size:
        return part, part
    t, q, count = schur(part.z, output="real", sort=lambda re, im: belongs(complex(re, abs(im))))
    y = _coupling(t, count)
    first, second = q[:, :count], q[:, :count] @ y + q[:, count:]
    first_left, second_left = q[:, :count].T - y @ q[:, count:].T, q[:, count:].T
    return (
        Part(t[:count, :count], part.right @ first, first_left @ part.left),
        Part(t[count:, count:], part.right @ second, second_left @ part.left),
    )


def decoupled(part: Part) -> Part:
    """The same part with a block diagonal z, a block for all zeros of similar magnitude.

    Rounding errors of slow states then do not grow with fast zeros in derivatives.
    """
    sizes = np.sort(np.abs(eigenvalues(part.z)))
    parts, rest = [], part
    for before, after in pairwise(sizes.tolist()):
        if after > _APART * before:
            limit = math.sqrt(before * after)
            slow, rest = separated(rest, lambda zero, limit=limit: abs(zero) < limit)  # type: ignore[misc]
            parts.append(slow)
    parts.append(rest)
    return Part(
        block_diag(*(one.z for one in parts)),
        np.hstack([one.right for one in parts]),
        np.vstack([one.left for one in parts]),
    )


@dataclass(frozen=True, eq=False)
class Boundary:
    """Equal zeros on the stability boundary; of complex pairs those with the positive imaginary part.

    Attributes
    ----------
    zero : complex
        On the imaginary axis, or the unit circle: the mean of the members.
    members : ndarray of complex
        The zeros as computed, moved by rounding.
    z, right, left : ndarray
        As of `Part`, complex.
    """

    zero: complex
    members: ComplexArray
    z: ComplexArray
    right: ComplexArray
    left: ComplexArray


def boundary_zeros(z: Array, zeros: ComplexArray, size: float, distance: Distance) -> list[Boundary]:
    """Groups of equal zeros on the stability boundary.

    Rounding moves the zeros of a defective matrix by a root of the rounding error,
    their mean only by the rounding error itself. Nearby zeros are equal if their
    part of z, minus the mean, is 0 or nilpotent.

    Parameters
    ----------
    z : ndarray, shape (n, n)
        Internal dynamics.
    zeros : ndarray of complex, shape (n,)
        Its eigenvalues.
    size : float
        Magnitude of the largest pole or zero.
    distance : callable
        Signed distance of a zero from the boundary, positive if unstable.
    """
    free, found = np.ones(zeros.size, dtype=bool), []
    for k in range(min(_MULTIPLE, zeros.size), 0, -1):
        for zero in zeros:
            near = np.argsort(np.abs(zeros - zero), kind="stable")[:k]
            mean = complex(zeros[near].mean())
            if not free[near].all() or abs(distance(mean)) > tolerance(mean, size):
                continue
            group = _group(z, zeros, near, mean)
            if group is None or not _is_small_or_nilpotent(group.z - mean * np.eye(k), mean, size):
                continue
            free[near] = False
            if abs(mean.imag) <= tolerance(mean, size):
                found.append(replace(group, zero=complex(mean.real)))
            elif mean.imag > 0.0:
                found.append(group)
    return sorted(found, key=lambda group: (group.zero.imag, group.zero.real))


@dataclass(frozen=True, eq=False)
class Separation:
    """Internal dynamics of an inverse, separated by stability.

    Attributes
    ----------
    zeros : ndarray of complex
        All zeros.
    size : float
        Magnitude of the largest pole or zero; 1 for difference equations.
    boundary : list of Boundary
        Groups of zeros on the stability boundary.
    unstable, rest : Part
        The unstable part, and the part that is stable or on the boundary.
    """

    zeros: ComplexArray
    size: float
    boundary: list[Boundary]
    unstable: Part
    rest: Part


def separation(z: Array, size: float, distance: Distance) -> Separation:
    """Separation of the internal dynamics z of a loop whose largest pole has a given magnitude.

    For difference equations the size is 1, the radius of the boundary.
    """
    zeros = eigenvalues(z)
    groups = boundary_zeros(z, zeros, size, distance)
    unstable, rest = separated(whole(z), _unstable_test(zeros, groups, distance))
    return Separation(zeros, size, groups, decoupled(unstable), rest)


def eigenvalues(matrix: Array) -> ComplexArray:
    """Eigenvalues as complex numbers, also of an empty matrix."""
    return np.linalg.eigvals(matrix).astype(complex) if matrix.size else np.zeros(0, dtype=complex)


def tolerance(zero: complex, size: float) -> float:
    """Distance that counts as rounding for a zero, where the largest pole or zero has a given magnitude."""
    return _ON_BOUNDARY * abs(zero) + _UNCERTAIN * size


def largest_size(*values: ComplexArray) -> float:
    """Largest magnitude of poles and zeros."""
    return float(np.abs(np.concatenate(values)).max(initial=0.0))


def grows(a: Array, size: float, distance: Distance) -> bool:
    """Whether free motions of a system grow: by unstable poles, or multiple ones on the boundary."""
    poles = eigenvalues(a)
    groups = boundary_zeros(a, poles, size, distance)
    is_unstable = _unstable_test(poles, groups, distance)
    multiple = (np.linalg.norm(one.z - one.zero * np.eye(len(one.z))) > tolerance(one.zero, size) for one in groups)
    return any(map(is_unstable, poles)) or any(multiple)


def zero_list(zeros: ComplexArray) -> str:
    """Zeros for a message."""
    return ", ".join(f"{zero:.4g}" for zero in np.real_if_close(np.sort_complex(zeros)))


def _unstable_test(zeros: ComplexArray, groups: Sequence[Boundary], distance: Distance) -> Callable[[complex], bool]:
    """Function that is true for unstable zeros, and false for stable ones and those on the boundary."""
    on = {complex(member) for group in groups for member in group.members}
    on |= {member.conjugate() for member in on}
    unstable = [distance(zero) > 0.0 and complex(zero) not in on for zero in zeros]
    return lambda zero: unstable[int(np.argmin(np.abs(zeros - zero)))]


def _group(z: Array, zeros: ComplexArray, near: NDArray[np.intp], mean: complex) -> Boundary | None:
    """Invariant subspace of some zeros; None if others are as near to their mean."""
    distances = np.abs(zeros - mean)
    inside = distances[near].max()
    outside = np.delete(distances, near).min(initial=np.inf)
    if not inside < outside:
        return None
    limit = min(0.5 * (inside + outside), np.finfo(float).max)
    t, q, count = schur(z.astype(complex), output="complex", sort=lambda zero: bool(abs(zero - mean) < limit))
    if count != near.size:
        return None
    left = q[:, :count].conj().T - _coupling(t, count) @ q[:, count:].conj().T
    return Boundary(mean, zeros[near], t[:count, :count], q[:, :count], left)


def _coupling(t: NDArray[np.inexact], count: int) -> NDArray[np.inexact]:
    """Matrix y for which [[1, y], [0, 1]] makes a triangular matrix block diagonal, with a first block of `count`."""
    if count in (0, len(t)):
        return np.zeros((count, len(t) - count))
    return np.asarray(solve_sylvester(t[:count, :count], -t[count:, count:], -t[:count, count:]))


def _is_small_or_nilpotent(matrix: ComplexArray, zero: complex, size: float) -> bool:
    """Whether the part of equal zeros, minus the zero, or a power of it, is 0 up to rounding."""
    norm = float(np.linalg.norm(matrix))
    if norm <= tolerance(zero, size):
        return True
    # Rounding moves entries by 1e-16 of the largest pole or zero, of which the power has a multiple.
    limit = max(_NILPOTENT, _ROUNDED * size / norm)
    return bool(np.linalg.norm(np.linalg.matrix_power(matrix / norm, len(matrix))) <= limit)
