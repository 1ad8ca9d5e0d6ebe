"""Taylor series of the Newton form at one time, against its definition in many digits, and with symbols."""

import mpmath as mp
import numpy as np
import pytest

from ctrlplan.trajectories.newton import NewtonSystem
from ctrlplan.trajectories.one_time import newton_series, pair_series

ALPHAS = [0.0, 1e-150, 1e-9, 1e-3, 1.0, 3.3, 6.2]
ORDER = 6


def q(alpha, u):
    return 2 / alpha * mp.sin(alpha * u / 2) if alpha else u


def c(alpha, u):
    return mp.cos(alpha * u / 2) if alpha else mp.mpf(1)


def basis(alpha, nodes, u):
    """The functions of the confluent trigonometric Newton form, one factor after another, phi_N included."""
    found, product = [mp.mpf(1)], mp.mpf(1)
    for k, node in enumerate(nodes):
        # phi_(2j-1) has its cosine about the next node; phi_2j none.
        found.append(
            product * q(alpha, u - node) * (c(alpha, u - nodes[k + 1]) if k % 2 == 0 and k + 1 < len(nodes) else 1)
        )
        product *= q(alpha, u - node)
    return found


def series_in_many_digits(function, u, order):
    with mp.workdps(60):
        return [float(v) for v in mp.taylor(function, mp.mpf(u), order)]


@pytest.mark.parametrize("alpha", ALPHAS)
def test_a_pair_is_the_series_of_its_two_products(alpha):
    rng = np.random.default_rng(1)
    for left, right in rng.uniform(-1.0, 1.0, (5, 2)).tolist():
        qq, qc = pair_series(alpha, left, right, ORDER)
        a = mp.mpf(alpha)
        wanted_qq = series_in_many_digits(lambda h: q(a, left + h) * q(a, right + h), 0, ORDER)  # noqa: B023
        wanted_qc = series_in_many_digits(lambda h: q(a, left + h) * c(a, right + h), 0, ORDER)  # noqa: B023
        for k in range(ORDER + 1):
            assert abs(qq[k] - wanted_qq[k]) <= 4e-15 * max(1.0, abs(wanted_qq[k]))
            assert abs(qc[k] - wanted_qc[k]) <= 4e-15 * max(1.0, abs(wanted_qc[k]))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_a_short_series_is_the_beginning_of_a_long_one(alpha, order):
    pair, long = pair_series(alpha, 0.3, -0.4, order), pair_series(alpha, 0.3, -0.4, ORDER)
    for short, whole in zip(pair, long, strict=True):
        assert len(short) == order + 1
        assert short == whole[: order + 1]


@pytest.mark.parametrize("size", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("alpha", ALPHAS)
def test_a_combination_is_the_series_of_its_definition(alpha, size):
    """Odd and even numbers of functions; the nodes may repeat."""
    rng = np.random.default_rng(size)
    nodes = rng.choice([0.0, 0.3, 1.0, 0.7], size + size % 2).tolist()
    column = rng.normal(size=size).tolist()
    for u in (0.3, 0.81):
        npairs = size // 2
        factors = [pair_series(alpha, u - nodes[2 * j], u - nodes[2 * j + 1], ORDER) for j in range(npairs)]
        found = newton_series(factors, column, ORDER)

        def combined(v):
            functions = basis(mp.mpf(alpha), [mp.mpf(n) for n in nodes], v)
            return mp.fdot(column, functions[:size])

        wanted = np.array(series_in_many_digits(combined, u, ORDER))
        assert np.abs(np.array(found) - wanted).max() <= 2e-14 * max(1.0, np.abs(wanted).max())


PATTERNS = {
    "two jets": (np.array([0.0, 1.0]), ((0, 1, 2), (0, 1, 2)), None),
    "two jets, gamma given": (np.array([0.0, 1.0]), ((0, 1, 2), (0, 1, 2)), 0.4),
    "odd": (np.array([0.0, 0.4, 1.0]), ((0, 1), (0,), (0, 1)), None),
    "uneven": (np.array([0.0, 0.2, 0.5, 1.0]), ((0, 1, 2, 3), (0,), (0, 1), (0,)), None),
    "with gaps": (np.array([0.0, 0.5, 1.0]), ((0, 2), (0,), (0, 1, 2)), None),
    "one entry": (np.array([0.0, 1.0]), ((0,), ()), None),
}


@pytest.mark.parametrize("alpha", [0.0, 0.01, 2.0, 5.5])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_series_of_a_system_are_what_taylor_gives_at_many_times(pattern, alpha):
    times, given, gamma = PATTERNS[pattern]
    system = NewtonSystem(alpha, times, given, gamma if alpha else None)
    rng = np.random.default_rng(2)
    coefficients = rng.normal(size=(system.size, 2))
    u = np.array([0.0, 0.1, 0.5, 0.77, 1.0])
    table = np.einsum("mkt,ma->akt", system.taylor(u, ORDER), coefficients)
    for i, time in enumerate(u.tolist()):
        rows = np.array(system.series(coefficients, time, ORDER))
        assert np.abs(rows - table[:, :, i]).max() <= 1e-13 * np.abs(table).max()


@pytest.mark.parametrize("alpha", [0.0, 1.0, 4.0])
def test_series_meet_the_jets_that_were_prescribed(alpha):
    """Whatever the basis: at its waypoints a plan has the entries that are given."""
    times, given, _ = PATTERNS["uneven"]
    system = NewtonSystem(alpha, times, given)
    data = np.random.default_rng(3).normal(size=(system.size, 1))  # Taylor data
    coefficients = system.coefficients(data)
    for value, waypoint, order in zip(data[:, 0], system.waypoint_index, system.order_index, strict=True):
        (row,) = system.series(coefficients, float(times[waypoint]), 3)
        assert abs(row[order] - value) <= 1e-12


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
@pytest.mark.parametrize("kind", ["SX", "MX"])
@pytest.mark.parametrize("alpha", [0.0, 1e-150, 2.0])
def test_the_time_and_the_coefficients_may_be_symbols(alpha, kind):
    """What is traced is the same function, checked against the definition at times it was not traced at."""
    casadi = pytest.importorskip("casadi")
    symbol = getattr(casadi, kind)
    time, column = symbol.sym("t"), [symbol.sym(f"c{k}") for k in range(5)]
    nodes = [0.0, 1.0, 0.3, 0.3]
    factors = [pair_series(alpha, time - nodes[2 * j], time - nodes[2 * j + 1], 3) for j in range(2)]
    traced = casadi.Function("f", [time, *column], newton_series(factors, column, 3))
    values = np.random.default_rng(4).normal(size=5).tolist()
    for u in (0.0, 0.25, 1.0):

        def combined(v):
            return mp.fdot(values, basis(mp.mpf(alpha), [mp.mpf(n) for n in nodes], v)[:5])

        wanted = series_in_many_digits(combined, u, 3)
        found = [float(v) for v in traced(u, *values)]
        assert np.abs(np.array(found) - wanted).max() <= 1e-14 * max(1.0, np.abs(wanted).max())


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
def test_a_symbol_of_time_in_the_series_of_a_system():
    casadi = pytest.importorskip("casadi")
    times, given, gamma = PATTERNS["two jets, gamma given"]
    system = NewtonSystem(2.0, times, given, gamma)
    coefficients = np.random.default_rng(5).normal(size=(6, 1))
    time = casadi.SX.sym("u")
    traced = casadi.Function("f", [time], system.series(coefficients, time, 4)[0])
    wanted = np.einsum("mkt,ma->akt", system.taylor(np.array([0.37]), 4), coefficients)[0, :, 0]
    assert np.abs(np.array([float(v) for v in traced(0.37)]) - wanted).max() <= 1e-13 * np.abs(wanted).max()
