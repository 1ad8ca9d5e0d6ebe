"""Truncated series against sympy's derivatives."""

import numpy as np
import pytest
import sympy as sp

from ctrlplan.systems import series

T = sp.Symbol("t")
ORDER = 5
A = 2 + sp.sin(3 * T) - T**3 / 4
B = sp.exp(-T) * (sp.Rational(3, 2) + T**2)


def jet(expression, order=ORDER):
    return np.array([float(expression.diff(T, k).subs(T, sp.Rational(1, 3)).evalf(25)) for k in range(order + 1)])


def of(expression, order=ORDER):
    return series.from_jet(jet(expression, order))


def assert_series(found, expression):
    np.testing.assert_allclose(series.to_jet(found), jet(expression, len(found) - 1), rtol=1e-12, atol=1e-12)


def test_entries_are_derivatives_over_factorials():
    found = of(A)
    expected = [sp.diff(A, T, k).subs(T, sp.Rational(1, 3)) / sp.factorial(k) for k in range(ORDER + 1)]
    np.testing.assert_allclose(found, [float(e) for e in expected], rtol=1e-14)
    np.testing.assert_allclose(series.to_jet(found), jet(A), rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "expression"),
    [
        (lambda a, b: series.multiply(a, b), A * B),
        (lambda a, b: series.divide(a, b), A / B),
        (lambda a, b: series.sqrt(a), sp.sqrt(A)),
        (lambda a, b: series.arctan2(a, b), sp.atan2(A, B)),
        (lambda a, b: series.arctan2(-a, -b), sp.atan2(-A, -B)),
        (lambda a, b: series.sqrt(series.multiply(a, a) + series.multiply(b, b)), sp.sqrt(A**2 + B**2)),
    ],
)
def test_operations_are_sympys(function, expression):
    found = function(of(A), of(B))
    assert len(found) == ORDER + 1
    assert_series(found, expression)


@pytest.mark.parametrize("nu", [1, 2, ORDER])
def test_derivatives(nu):
    found = series.derivative(of(A), nu)
    assert len(found) == ORDER + 1 - nu
    assert_series(found, A.diff(T, nu))


@pytest.mark.parametrize("operation", [series.multiply, series.divide, series.arctan2])
def test_results_are_as_long_as_the_shorter(operation):
    whole = operation(of(A), of(B))
    for short in (0, 1, 3):
        for pair in ((of(A, short), of(B)), (of(A), of(B, short))):
            found = operation(*pair)
            assert len(found) == short + 1
            np.testing.assert_allclose(found, whole[: short + 1], rtol=1e-13)


@pytest.mark.parametrize("name", ["multiply", "divide", "arctan2"])
def test_many_points_at_once(name):
    operation = getattr(series, name)
    a = np.stack([of(A), of(B), of(A + B)], axis=1)
    b = np.stack([of(B), of(A), of(A)], axis=1)
    found = operation(a, b)
    for i in range(3):
        np.testing.assert_allclose(found[:, i], operation(a[:, i], b[:, i]), rtol=1e-14)
    np.testing.assert_allclose(series.sqrt(a)[:, 1], series.sqrt(a[:, 1]), rtol=1e-14)
    np.testing.assert_allclose(series.to_jet(series.from_jet(a)), a, rtol=1e-15)
