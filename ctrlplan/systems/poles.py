"""Poles of error equations: checked, and as polynomials."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctrlplan._types import Value


def hurwitz_coefficients(poles: Sequence[complex], count: int, where: str = "") -> tuple[float, ...]:
    """Coefficients of a monic polynomial with given stable roots.

    Parameters
    ----------
    poles : sequence of complex
        Roots [rad/s], closed under conjugation, with negative real parts.
    count : int
        Required number of poles.
    where : str, optional
        Place of the poles, appended to error messages: `` in poles[1]``.

    Returns
    -------
    tuple of float
        sigma_0, ..., sigma_(count - 1) of s^count + sum of sigma_k s^k, lowest
        order first.

    Raises
    ------
    TypeError
        If poles are not numbers.
    ValueError
        If their number is not `count`, or they are not closed under conjugation,
        not finite or not stable.

    Examples
    --------
    >>> hurwitz_coefficients([-1, -2 + 1j, -2 - 1j], 3)
    (5.0, 9.0, 5.0)
    """
    given = np.asarray(poles)
    if given.dtype.kind not in "iufc":
        raise TypeError(f"poles must be numbers, got {poles!r}{where}")
    if given.shape != (count,):
        raise ValueError(f"poles must be as many as the order of the flat output, {count}, got {given.tolist()}{where}")
    if not np.isfinite(given).all() or not (given.real < 0.0).all():
        raise ValueError(f"poles must be finite with negative real parts, got {given.tolist()}{where}")
    # A polynomial is real exactly where its roots are closed under conjugation.
    coefficients = np.atleast_1d(np.poly(given))
    if (np.abs(coefficients.imag) > 1e-9 * np.poly(-np.abs(given))).any():
        raise ValueError(f"poles must be closed under conjugation, got {given.tolist()}{where}")
    return tuple(coefficients.real[:0:-1].tolist())


def checked_gains(poles: Value, orders: Sequence[int]) -> list[tuple[float, ...]]:
    """Coefficients of the error polynomial of each flat output, lowest order first.

    Raises
    ------
    TypeError, ValueError
        If poles are not one stable set of as many as the order for each output.
    """
    if not np.iterable(poles):
        raise TypeError(f"poles must be one sequence for each flat output, got {poles!r}")
    rows = list(poles)
    if len(orders) == 1 and all(np.ndim(row) == 0 for row in rows):
        return [hurwitz_coefficients(rows, orders[0])]
    if len(rows) != len(orders):
        raise ValueError(f"poles must be one sequence for each of {len(orders)} flat outputs, got {len(rows)}")
    return [hurwitz_coefficients(p, r, f" in poles[{j}]") for j, (p, r) in enumerate(zip(rows, orders, strict=True))]
