"""The trigonometric basis: python-control's own tests, 50-digit arithmetic, conditioning, bad input."""

import copy
import math
import pickle
import warnings

import control as ct
import control.flatsys as fs
import mpmath
import numpy as np
import pytest
from control.tests import flatsys_test

import ctrlplan as cp

EPS = float(np.finfo(float).eps)
THEIRS = flatsys_test.TestFlatSys()
ALPHAS = [1e-9, 1e-3, 0.5, math.pi, 6.28]
alphas = pytest.mark.parametrize("alpha", ALPHAS)


def inner(f, g):
    """Mean product over [-1/2, 1/2] of two lists of harmonics (1, sin, cos, sin 2, ...) with the same parity."""
    return mpmath.fsum(a * b * GRAM[i, j] for i, a in enumerate(f) for j, b in enumerate(g))


GRAM = {}


def set_gram(alpha, size):
    """Exact mean products of the harmonics."""

    def mean_of_cosine(n):
        return mpmath.mpf(1) if n == 0 else 2 * mpmath.sin(n * alpha / 2) / (n * alpha)

    GRAM.clear()
    for i in range(size):
        for j in range(size):
            p, q, sign = (i + 1) // 2, (j + 1) // 2, -1 if i % 2 else 1
            same = i % 2 == j % 2
            GRAM[i, j] = (mean_of_cosine(abs(p - q)) + sign * mean_of_cosine(p + q)) / 2 if same else mpmath.mpf(0)


def harmonics_of(alpha, size):
    """Coefficients of each function in the harmonics, by Gram-Schmidt in extended arithmetic."""
    set_gram(alpha, size)
    rows = []
    for i in range(size):
        row = [mpmath.mpf(i == j) for j in range(size)]
        for _ in range(2):
            for former in rows:
                weight = inner(row, former) / inner(former, former)
                row = [a - weight * b for a, b in zip(row, former, strict=True)]
        sign = 1 if i % 4 in (0, 1) else -1  # 1 - cos v grows outwards, cos v does not
        scale = sign / (size * mpmath.sqrt(inner(row, row) * (2 * i + 1)))
        rows.append([scale * a for a in row])
    return rows


def derivative(row, alpha, v, k):
    """Derivative k by position of a sum of harmonics at the angle v."""
    return mpmath.fsum(
        a * (n * alpha) ** k * (mpmath.sin if i % 2 else mpmath.cos)(n * v + k * mpmath.pi / 2)
        for i, a in enumerate(row)
        if (n := (i + 1) // 2) or not k
    )


@pytest.mark.parametrize("size", [1, 2, 7, 8, 12])
@alphas
def test_derivatives_against_extended_arithmetic(alpha, size):
    basis = cp.TrigFamily(size, 2.5, t0=-0.75, alpha=alpha)
    t = np.array([-0.75, -0.3, 0.5, 1.1, 1.75])
    lost = 2 * size * math.ceil(max(0.0, -math.log10(alpha)) + 1)  # digits that the harmonics cancel, squared
    with mpmath.workdps(50 + lost):
        angle = mpmath.mpf(alpha)
        rows = harmonics_of(angle, size)
        for i in range(size):
            for k in range(6):
                place = [(mpmath.mpf(x) + 0.75) / 2.5 - 0.5 for x in t.tolist()]
                wanted = [float(derivative(rows[i], angle, angle * u, k) / mpmath.mpf(2.5) ** k) for u in place]
                found = basis.eval_deriv(i, k, t)
                # Markov: derivative k of a polynomial of degree i grows by up to i^2 (i^2 - 1) ...
                bound = 1e-14 / size * math.prod(2 * (max(i, 1) ** 2 + alpha * i) / 2.5 for _ in range(k))
                np.testing.assert_allclose(found, wanted, rtol=0, atol=10 * bound)


@alphas
@pytest.mark.parametrize("size", [5, 6, 20])
def test_functions_are_orthogonal(alpha, size):
    """As conditioned as Legendre polynomials, whatever alpha."""
    basis = cp.TrigFamily(size, 3.0, t0=1.0, alpha=alpha)
    nodes, weights = np.polynomial.legendre.leggauss(120)
    values = np.array([basis.eval_deriv(i, 0, 2.5 + 1.5 * nodes) for i in range(size)])
    gram = (values * (0.5 * weights)) @ values.T
    np.testing.assert_allclose(gram, np.diag(1.0 / (2 * np.arange(size) + 1)) / size**2, rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("size", [5, 6])
def test_space_is_that_of_equation_2(size):
    """The harmonics themselves are in the span; the top one of an even number is the sine about the middle only."""
    alpha, t = 2.0, np.linspace(0.0, 1.0, 50)
    basis = cp.TrigFamily(size, 1.0, alpha=alpha)
    columns = np.array([basis.eval_deriv(i, 0, t) for i in range(size)]).T
    m = size // 2
    inside = [np.cos(k * alpha * t) for k in range((size + 1) // 2)]
    inside += [np.sin(k * alpha * t) for k in range(1, (size + 1) // 2)]
    inside.append(np.sin(m * alpha * (t - 0.5)))
    for wanted in inside:
        left = np.linalg.lstsq(columns, wanted, rcond=None)[0]
        np.testing.assert_allclose(columns @ left, wanted, rtol=0, atol=1e-13)
    beyond = np.cos((m + size % 2) * alpha * (t - 0.5))
    assert np.abs(columns @ np.linalg.lstsq(columns, beyond, rcond=None)[0] - beyond).max() > 1e-4


def test_small_alpha_is_legendre():
    basis = cp.TrigFamily(6, 2.0, t0=-1.0, alpha=1e-12)
    t = np.linspace(-1.0, 1.0, 9)
    for i in range(6):
        legendre = np.polynomial.Legendre.basis(i)
        for k in range(3):
            np.testing.assert_allclose(6 * basis.eval_deriv(i, k, t), legendre.deriv(k)(t), rtol=0, atol=2e-13 * 30**k)


# python-control's flatsys_test.py, on the interval of each test


# Nearer to 2 pi these moves are larger than their distance by orders of magnitude, as the ends nearly coincide.
@pytest.mark.parametrize("alpha", [1e-6, 2.0, 4.0])
@pytest.mark.parametrize(("xf", "uf", "Tf"), [([1, 0], [0], 2), ([0, 1], [0], 3), ([1, 1], [1], 4)])
def test_double_integrator(xf, uf, Tf, alpha):
    THEIRS.test_double_integrator(xf, uf, Tf, cp.TrigFamily(6, Tf, alpha=alpha))


@pytest.fixture
def car():
    """The vehicle of their fixture, built as there."""
    return flatsys_test.TestFlatSys.vehicle_flat.__wrapped__(THEIRS)


@pytest.mark.parametrize("size", [6, 8])
@pytest.mark.parametrize("alpha", [1e-6, 2.0])
def test_kinematic_car(car, size, alpha):
    THEIRS.test_kinematic_car(car, cp.TrigFamily(size, 10, alpha=alpha))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("basis", "guess", "constraints", "method"),
    [
        (cp.TrigFamily(8, 10, alpha=1.0), "prev", None, None),
        (cp.TrigFamily(8, 10, alpha=1.0), "linear", None, None),
        (cp.TrigFamily(8, 10, alpha=1.0), None, None, None),
        (cp.TrigFamily(8, 10, alpha=1.0), "prev", None, "trust-constr"),
        (cp.TrigFamily([7, 9], 10, alpha=1.0, vars=2), "prev", None, None),
        (cp.TrigFamily(8, 10, alpha=1.0), "linear", None, "slsqp"),
        (cp.TrigFamily(8, 10, alpha=1.0), None, ([8, -0.1], [12, 0.1]), None),
    ],
)
def test_kinematic_car_ocp(car, basis, guess, constraints, method):
    THEIRS.test_kinematic_car_ocp(car, basis, guess, constraints, method)


@pytest.mark.parametrize("size", [8, 10])
def test_flat_cost_constr(size):
    THEIRS.test_flat_cost_constr(cp.TrigFamily(size, 10, alpha=2.0))


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.01, 1.0, 4.0])
def test_flat_solve_ocp(alpha):
    THEIRS.test_flat_solve_ocp(cp.TrigFamily(9, 10, alpha=alpha))


@pytest.mark.parametrize(("alpha", "T"), [(1e-6, 1), (1.0, 1), (2.0, 100)])
def test_basis_derivs(alpha, T):
    THEIRS.test_basis_derivs(cp.TrigFamily(4, T, alpha=alpha), 4, T)


@pytest.mark.parametrize(
    "basis",
    [
        cp.TrigFamily(4, 1, alpha=1.0),
        cp.TrigFamily(4, 1, alpha=1.0, vars=2),
        cp.TrigFamily([4, 3], 1, alpha=1.0, vars=2),
    ],
)
def test_basis_class(basis):
    THEIRS.test_basis_class(basis)


# Times, copies, bad input


def test_times_of_any_shape_give_the_same_values():
    basis = cp.TrigFamily(5, 2.0, t0=300.0, alpha=1.0, vars=2)
    t = np.linspace(299.5, 302.5, 6)
    table = basis.eval_deriv(4, 2, t, var=1)
    np.testing.assert_array_equal(basis.eval_deriv(4, 2, t.reshape(2, 3), var=1), table.reshape(2, 3))
    np.testing.assert_allclose([basis.eval_deriv(4, 2, x, var=1) for x in t.tolist()], table, rtol=1e-14)
    assert basis.var_ncoefs(1) == 5
    assert basis.N == 10
    assert np.shape(basis(0, 300.0, var=0)) == ()


def test_a_late_interval_is_the_early_one_moved():
    plant = fs.LinearFlatSystem(ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0))
    ends = ([0, 0], [0], [1, 0], [0])
    early = fs.point_to_point(plant, 2.0, *ends, basis=cp.TrigFamily(6, 2.0, alpha=2.0))
    timepts = np.array([512.0, 514.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        late = fs.point_to_point(plant, timepts, *ends, basis=cp.TrigFamily(6, 2.0, t0=512.0, alpha=2.0))
    t = np.linspace(0.0, 2.0, 9)
    for moved, wanted in zip(late.eval(512.0 + t), early.eval(t), strict=True):
        np.testing.assert_allclose(moved, wanted, rtol=0, atol=1e-12)


def test_copies_and_pickles_are_equal():
    basis = cp.TrigFamily([4, 6], 2.0, t0=0.5, alpha=1.0, vars=2)
    assert repr(basis) == "TrigFamily([4, 6], 2, t0=0.5, alpha=1, vars=2)"
    for copied in (copy.deepcopy(basis), pickle.loads(pickle.dumps(basis))):
        assert vars(copied) == vars(basis)
    with pytest.raises(AttributeError, match="immutable"):
        basis.T = 3.0


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"N": 0}, ValueError, "N must be an integer of at least 1, got 0"),
        ({"N": 2.5}, ValueError, "N must be an integer"),
        ({"N": "6"}, TypeError, "N must be an integer"),
        ({"N": [4, 4]}, ValueError, "N must be one number without vars, got 2"),
        ({"N": [4], "vars": 2}, ValueError, "one for each of 2 variables, got 1"),
        ({"vars": 0}, ValueError, "vars must be an integer of at least 1"),
        ({"T": 0.0}, ValueError, "T must be finite and above 0, got 0"),
        ({"T": math.inf}, ValueError, "T must be finite"),
        ({"t0": math.nan}, ValueError, "t0 must be finite"),
        ({"alpha": 0.0}, ValueError, "alpha must be finite and above 0, got 0"),
        ({"alpha": 2 * math.pi}, ValueError, "alpha must be above 0 and below 2 pi, got 6.28"),
        ({"alpha": "auto"}, TypeError, "alpha must be a number"),
    ],
)
def test_bad_arguments(arguments, error, match):
    with pytest.raises(error, match=match):
        cp.TrigFamily(**({"N": 6, "T": 1.0, "alpha": 1.0} | arguments))


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((4, 0, 0.0), "i must be below the number of basis functions, 4, got 4"),
        ((-1, 0, 0.0), "i must be an integer of at least 0"),
        ((0, -1, 0.0), "k must be an integer of at least 0"),
        ((0, 0, math.nan), "times must not be nan"),
    ],
)
def test_bad_evaluation(arguments, match):
    with pytest.raises(ValueError, match=match):
        cp.TrigFamily(4, 1.0, alpha=1.0).eval_deriv(*arguments)


@pytest.mark.parametrize("var", [None, 2])
def test_bad_variable(var):
    with pytest.raises(ValueError, match=f"var must be the number of a variable, below 2, got {var}"):
        cp.TrigFamily(4, 1.0, alpha=1.0, vars=2).eval_deriv(0, 0, 0.0, var=var)
