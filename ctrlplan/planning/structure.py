"""Dependence of quantities on a parameter: affine or linear fractional, by the operations that compute them.

A number that stands for the parameter p is passed through the user's code. Each
operation on it is carried out on rational functions of p, N(p)/D(p), whose degrees
follow from the operations, not from values. What is no rational operation (a sine,
a comparison, a conversion to float) raises `NotRationalError`.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from ctrlplan._types import Value
from ctrlplan.trajectories.common import Array

Atom = tuple[float, float]
"""Factor 1 + r p or p of a denominator, by its coefficients."""

_CHECKS = "ctrlplan._checks"
"""Module whose conversions to float only validate a value."""


class NotRationalError(TypeError):
    """A parameter enters by something else than a rational operation."""


class Rational(NDArrayOperatorsMixin):
    """Rational function of a parameter, for numbers and arrays over time.

    Parameters
    ----------
    terms : sequence
        Coefficients of the numerator, numbers or arrays, lowest first.
    atoms : mapping of Atom to int
        Factors of the denominator and their powers.
    nominal : float
        Value of the parameter for checks.
    timed : bool, optional
        Whether it depends on time; arrays do.
    """

    def __init__(self, terms: Sequence[Value], atoms: Mapping[Atom, int], nominal: float, timed: bool = False) -> None:
        self.terms, self.atoms, self.nominal = list(terms), dict(atoms), nominal
        self.timed = timed or any(isinstance(term, np.ndarray) for term in terms)

    @classmethod
    def parameter(cls, nominal: float) -> Rational:
        """The parameter itself."""
        return cls([0.0, 1.0], {}, nominal)

    def __call__(self, p: float) -> Value:
        """Value at a value of the parameter."""
        top = sum(term * p**k for k, term in enumerate(self.terms))
        return top / np.prod([(a + b * p) ** power for (a, b), power in self.atoms.items()])

    @property
    def is_monotone(self) -> bool:
        """Whether it is affine or linear fractional, and monotone between poles."""
        return len(self.terms) <= 2 and sum(self.atoms.values()) <= 1

    @property
    def is_affine(self) -> bool:
        """Whether it is affine."""
        return len(self.terms) <= 2 and not self.atoms

    def has_pole(self, low: float, high: float) -> bool:
        """Whether the denominator vanishes between two values of the parameter."""
        return any((a + b * low) * (a + b * high) <= 0.0 for a, b in self.atoms)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Value, **kwargs: Value) -> Value:
        """Result of a rational operation of numpy."""
        known = _OPERATIONS.get(ufunc)
        if method != "__call__" or kwargs or known is None:
            raise NotRationalError(f"{ufunc.__name__} of a parameter is no rational operation")
        if any(isinstance(x, np.ndarray) and x.dtype == object for x in inputs):
            return NotImplemented  # numpy operates on the elements
        return known(*(x if isinstance(x, Rational) else Rational([x], {}, self.nominal) for x in inputs))

    def __pow__(self, power: Value) -> Value:
        """Whole power."""
        if not isinstance(power, int) or power < 0:
            raise NotRationalError(f"the power {power!r} of a parameter is no rational operation")
        found: Value = Rational([1.0], {}, self.nominal)
        for _ in range(power):
            found = found * self
        return found

    def __len__(self) -> int:
        lengths = [len(term) for term in self.terms if isinstance(term, np.ndarray) and term.ndim]
        if not lengths:
            raise TypeError("a number has no length")
        return lengths[0]

    def __getitem__(self, place: Value) -> Rational:
        terms = [term[place] if isinstance(term, np.ndarray) and term.ndim else term for term in self.terms]
        return Rational(terms, self.atoms, self.nominal, self.timed)

    def __iter__(self) -> Iterator[Rational]:
        return (self[k] for k in range(len(self)))

    def __float__(self) -> float:
        if sys._getframe(1).f_globals.get("__name__") != _CHECKS:
            raise NotRationalError("a parameter was converted to a float")
        return float(self(self.nominal))

    def __bool__(self) -> bool:
        raise NotRationalError("a parameter was compared")


def _sum(a: Rational, b: Rational) -> Rational:
    atoms = {atom: max(a.atoms.get(atom, 0), b.atoms.get(atom, 0)) for atom in {*a.atoms, *b.atoms}}
    rows = [_extended(x, atoms) for x in (a, b)]
    size = max(map(len, rows))
    rows = [row + [0.0] * (size - len(row)) for row in rows]
    return Rational([x + y for x, y in zip(*rows, strict=True)], atoms, a.nominal, a.timed or b.timed)


def _extended(x: Rational, atoms: Mapping[Atom, int]) -> list[Value]:
    """Numerator over a denominator that contains that of x."""
    terms = x.terms
    for (a, b), power in atoms.items():
        for _ in range(power - x.atoms.get((a, b), 0)):
            terms = _product_of(terms, [a, b])
    return terms


def _product_of(a: Sequence[Value], b: Sequence[Value]) -> list[Value]:
    found: list[Value] = [0.0] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            found[i + j] = found[i + j] + x * y
    return found


def _product(a: Rational, b: Rational) -> Rational:
    atoms = {atom: a.atoms.get(atom, 0) + b.atoms.get(atom, 0) for atom in {*a.atoms, *b.atoms}}
    return Rational(_product_of(a.terms, b.terms), atoms, a.nominal, a.timed or b.timed)


def _quotient(a: Rational, b: Rational) -> Rational:
    if len(b.terms) == 1 and not b.atoms:
        return Rational([term / b.terms[0] for term in a.terms], a.atoms, a.nominal, a.timed or b.timed)
    if len(b.terms) > 2 or b.timed:
        raise NotRationalError("a denominator depends on time, or not affinely on a parameter")
    constant, slope = float(b.terms[0]), float(b.terms[1]) if len(b.terms) > 1 else 0.0
    unit = constant if constant else slope
    if not unit:
        raise NotRationalError("a denominator is 0")
    atoms = dict(a.atoms)
    inverted = Rational([1.0 / unit], {}, a.nominal)
    for (c, d), power in b.atoms.items():  # a denominator of the denominator is a factor
        for _ in range(power):
            inverted = _product(inverted, Rational([c, d], {}, a.nominal))
    if len(b.terms) > 1:
        atom = (constant / unit, slope / unit)
        atoms[atom] = atoms.get(atom, 0) + 1
    return Rational(_product_of(a.terms, inverted.terms), atoms, a.nominal, a.timed)


_OPERATIONS: dict[Any, Callable[..., Rational]] = {
    np.add: _sum,
    np.subtract: lambda a, b: _sum(a, -b),
    np.multiply: _product,
    np.true_divide: _quotient,
    np.negative: lambda a: Rational([operator.neg(term) for term in a.terms], a.atoms, a.nominal, a.timed),
    np.positive: lambda a: a,
    np.square: lambda a: _product(a, a),
}


def as_rational(values: Value, nominal: float) -> list[Rational]:
    """Signal over time as one rational function, or as one for each time."""
    if isinstance(values, Rational):
        return [values]
    array = np.asarray(values)
    if array.dtype != object:
        return [Rational([array.astype(float)], {}, nominal)]
    return [x if isinstance(x, Rational) else Rational([float(x)], {}, nominal) for x in array.ravel().tolist()]


def values_at(signal: Sequence[Rational], p: float) -> Array:
    """Values over time at a value of the parameter."""
    return np.concatenate([np.atleast_1d(np.asarray(part(p), dtype=float)) for part in signal])
