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
    found = []
    for _ in range(order + 1):
        found.append(float(expression.subs(T, sp.Rational(1, 3)).evalf(25)))
        expression = expression.diff(T)
    return np.array(found)


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
        (lambda a, b: series.sincos(a)[0], sp.sin(A)),
        (lambda a, b: series.sincos(b)[1], sp.cos(B)),
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


# Series in arithmetic written for numbers


@pytest.mark.parametrize(
    ("formula", "expression"),
    [
        (lambda a, b: a + b - a * b, A + B - A * B),
        (lambda a, b: (2.0 - a) / (b + 3.0), (2 - A) / (B + 3)),
        (lambda a, b: 1.5 / b - -a * 0.25, sp.Rational(3, 2) / B + A / 4),
        (lambda a, b: np.sin(a) * np.cos(b) / 2.0, sp.sin(A) * sp.cos(B) / 2),
        (lambda a, b: np.float64(2.0) * a + np.float64(1.0), 2 * A + 1),
        (lambda a, b: np.array(2.0) - a, 2 - A),
    ],
)
def test_formulas_of_numbers_take_series(formula, expression):
    found = formula(series.Taylor(of(A)), series.Taylor(of(B)))
    assert isinstance(found, series.Taylor)
    assert_series(found.terms, expression)


def test_arrays_next_to_series_are_constants_at_each_time():
    terms = np.stack([of(A, 3), of(B, 3)], axis=1)  # of two functions, as of two times
    gains = np.array([2.0, -3.0])
    found = gains * series.Taylor(terms) - gains
    assert found.terms.shape == (4, 2)
    assert_series(found.terms[:, 0], 2 * A - 2)
    assert_series(found.terms[:, 1], -3 * B + 3)


def test_the_shorter_series_decides():
    short, long = series.Taylor(of(A, 2)), series.Taylor(of(B, 4))
    for found in (short + long, long - short, short * long, long / short):
        assert len(found.terms) == 3


def test_integrals_start_at_the_given_value():
    found = series.Taylor.integral(np.array(float((A).subs(T, sp.Rational(1, 3)))), series.Taylor(of(A.diff(T), 3)))
    assert_series(found.terms, A)
