"""Symbols go through numpy as numbers do, or raise; CasADi and numpy are left as they were found."""

import math
import warnings
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from scipy.special import erf, expit

import ctrlplan as cp
from ctrlplan.simulation.network import Block

pytestmark = pytest.mark.every_combination

ca = pytest.importorskip("casadi")
symbols = pytest.importorskip("ctrlplan.symbolic.symbols")

MATRIX = np.array([[1.0, -2.0, 0.5], [0.25, 3.0, -1.0]])

EXPRESSIONS = {
    # operators
    "sums": lambda x: [1 + x[0] - 2.0 * x[1], np.float64(3.0) * x[2] / 7, -x[0], +x[1], abs(x[2])],
    "powers": lambda x: [x[0] ** 2, abs(x[1]) ** 1.5, 2.0 ** x[2], np.power(2.0, x[0])],
    "remainders": lambda x: [x[0] % 0.7, x[1] % -0.7, 2.0 % x[2], np.mod(x[0], 0.3), np.fmod(x[1], 0.3)],
    "quotients": lambda x: [x[0] // 0.1, x[1] // -0.3, 1.0 // x[2], np.floor_divide(x[0], 0.1)],
    "in place": lambda x: _in_place(x),
    # products
    "matrix": lambda x: MATRIX @ x,
    "transposed": lambda x: x[:2] @ MATRIX,
    "inner": lambda x: [x @ x, np.dot(x, x), x.dot(x), np.einsum("i,i", x, x), np.vdot(x, x)],
    "outer": lambda x: np.outer(x, x),
    "cross": lambda x: np.cross(x, [1.0, 2.0, 3.0]),
    # functions of one value
    "trigonometric": lambda x: [f(0.2 * v) for v in x for f in (np.sin, np.cos, np.tan, np.arcsin, np.arctan)],
    "hyperbolic": lambda x: [f(v) for v in x for f in (np.sinh, np.cosh, np.tanh, np.arcsinh)],
    "exponential": lambda x: [f(v) for v in x for f in (np.exp, np.expm1, np.exp2, np.cbrt, np.square)],
    "logarithmic": lambda x: [f(abs(v)) for v in x for f in (np.log, np.log1p, np.log2, np.log10, np.sqrt)],
    "special": lambda x: [*erf(x), *expit(x)],
    "angles": lambda x: [*np.radians(x), *np.deg2rad(x), *np.degrees(x), *np.rad2deg(x)],
    "whole": lambda x: [f(v) for v in x for f in (np.floor, np.ceil, np.trunc, np.rint, np.round)],
    "sign": lambda x: [*np.sign(x), *np.abs(x), *np.fabs(x), *np.heaviside(x, 0.5), *np.reciprocal(x)],
    "of plain arrays": lambda x: np.sin(np.array([x[0], x[1]])) + np.sqrt(np.array([abs(x[0]), x[1] ** 2])),
    # of two
    "two": lambda x: [np.hypot(x[0], x[1]), np.arctan2(x[0], x[1]), np.copysign(x[0], x[1]), np.logaddexp(x[0], x[1])],
    "limits": lambda x: [*np.maximum(x, 0.2), *np.minimum(0.2, x), *np.fmax(x, x[0]), *np.fmin(x, x[1])],
    "clips": lambda x: [*np.clip(x, -0.5, 0.5), *x.clip(-0.5, 0.5), np.clip(x[0], None, 0.1), np.clip(x[1], 0.1, None)],
    # conditions
    "where": lambda x: np.where(x > 0.3, x, -2.0 * x),
    "where of scalars": lambda x: [np.where(x[0] >= 0.3, 1, 2.0), np.where(x[1] == 0.0, 1.0, x[1])],
    "where of nothing": lambda x: [np.where(True, x[0], 1.0), np.where([True, False, True], x, 0.0)[1]],
    "select": lambda x: np.select([x > 0.5, x > -0.5], [x, 2.0 * x], default=7.0),
    "logic": lambda x: [
        1.0 * ((x[0] > 0) & (x[1] < 0)),
        1.0 * ((x[0] > 0) | (x[1] < 0)),
        1.0 * ((x[0] > 0) ^ (x[1] < 0)),
        1.0 * ~(x[0] > 0),
        1.0 * np.logical_and(x[0] > 0, x[1] != 0),
        1.0 * np.logical_or(x[0] > 0, x[1] <= 0),
        1.0 * np.logical_not(x[0] > 0),
        1.0 * np.logical_xor(x[0] > 0, x[2] > 0),
    ],
    "conditions times": lambda x: (x > 0.1) * (x < 0.9) * x - 0.5 * (x > 0.5),
    # reductions and shapes
    "sums of all": lambda x: [x.sum(), np.sum(x), sum(x), np.mean(x), x.mean(), np.prod(x)],
    "extremes": lambda x: [x.max(), np.max(x), x.min(), np.amin(x), np.ptp(x) if hasattr(np, "ptp") else 0.0],
    "running": lambda x: [*np.cumsum(x), *np.diff(x), getattr(np, "trapezoid", np.sum)(x)],
    "norm": lambda x: [np.linalg.norm(x), np.linalg.norm([x[0], 1.0])],
    "polynomial": lambda x: [np.polyval([0.1, -0.2, 1.0], x[0]), np.polynomial.Polynomial([1.0, 2.0, 3.0])(x[1])],
    "joined": lambda x: np.hstack([x[1:], -np.sin(x[:1]), np.concatenate([x, [1.0]])]),
    "shaped": lambda x: np.vstack([x, 2.0 * x]).T.reshape(3, 2),
    "turned": lambda x: [*np.roll(x, 1), *np.tile(x, 2), *np.append(x, 1.0), *np.flip(x)],
    "filled": lambda x: _filled(x),
    "unpacked": lambda x: (lambda a, b, c: [c, a, b])(*x),
    "listed": lambda x: [np.mean([x[0], 1.0]), *np.array([x[1], 2.0]) * 3.0, *[v * 2.0 for v in x.tolist()]],
}


def _in_place(x):
    y = x.copy()
    y *= 2.0
    y[0] = x[1]
    y += x
    return y


def _filled(x):
    y = np.empty_like(x)
    y[:] = x[::-1]
    return y


def values_of(expression, numbers):
    x = ca.SX.sym("x", numbers.shape[0])
    column = symbols.column_of(expression(symbols.symbol_array(x)))
    return ca.Function("f", [x], [ca.densify(column)])(numbers).full()


@pytest.mark.parametrize("mode", [0, 1, -1])
@pytest.mark.parametrize("name", EXPRESSIONS)
def test_numpy_means_the_same_of_symbols(name, mode, numpy_mode):
    """At random numbers, and at whole ones, halves and zeros, where functions jump."""
    numpy_mode(mode)
    numbers = np.random.default_rng(0).normal(size=(3, 40)) * 2.0
    special = np.array([0.5, -1.5, 2.5, 1.0, -2.0, 0.3, 0.7, -0.7, 1e-9]).reshape(3, 3)
    numbers = np.hstack([numbers, special, -special, np.ones((3, 1))])
    if name == "where of scalars":
        numbers[1, :5] = 0.0
    expression = EXPRESSIONS[name]
    expected = np.array([np.ravel(expression(column)).astype(float) for column in numbers.T]).T
    # A few roundings of the largest term: sums and products of entries below 10.
    assert np.abs(values_of(expression, numbers) - expected).max() <= 1e-12 * max(1.0, np.abs(expected).max())


@pytest.fixture
def numpy_mode():
    """Sets CasADi's numpy mode, as another package does, and finds it so at the end."""
    options = ca.GlobalOptions
    if not hasattr(options, "setNumpyMode"):
        yield lambda mode: None if mode == 0 else pytest.skip("this CasADi has no numpy mode")
        return
    before, given = options.getNumpyMode(), []
    yield lambda mode: (given.append(mode), options.setNumpyMode(mode))
    after = options.getNumpyMode()
    options.setNumpyMode(before)
    assert after == (given or [before])[-1]


REJECTED = {
    "float": lambda x: float(x[0]),
    "int": lambda x: int(x[0]),
    "index": lambda x: [1.0, 2.0][x[0]],
    "range": lambda x: sum(range(x[0])),
    "if": lambda x: 1.0 if x[0] > 0 else 2.0,
    "while": lambda x: next(1.0 for _ in range(3) if not x[0] > 0),
    "and": lambda x: x[0] > 0 and x[1] > 0,
    "max": lambda x: max(x[0], 1.0),
    "sorted": lambda x: sorted(x)[0],
    "key": lambda x: {0.0: 1.0}.get(x[0], 2.0),
    "member": lambda x: 1.0 if x[0] in (1.0, 2.0) else 2.0,
    "member of a set": lambda x: 1.0 if x[0] in {1.0, 2.0} else 2.0,
    "math": lambda x: math.sin(x[0]),
    "round": lambda x: round(x[0]),
    "floats": lambda x: np.asarray(x, dtype=float)[0],
    "float64": lambda x: np.float64(x[0]),
    "filled": lambda x: np.full(2, x[0], dtype=float)[0],
    "assigned": lambda x: np.zeros(2).__setitem__(0, x[0]) or 1.0,
    "mask": lambda x: x[x > 0][0],
    "sum of conditions": lambda x: (x[0] > 0) + (x[1] > 0),
    "count of conditions": lambda x: np.sum(x > 0),
    "difference of conditions": lambda x: (x[0] > 0) - (x[1] > 0),
    "bits": lambda x: x[0] & 1,
    "finite": lambda x: np.isfinite(x[0]) * 1.0,
    "nan": lambda x: np.nan_to_num(x[0]),
    "any": lambda x: 1.0 if np.any(x) else 2.0,
    "all": lambda x: 1.0 if (x > 0).all() else 2.0,
    "close": lambda x: 1.0 if np.isclose(x[0], 1.0) else 2.0,
    "interp": lambda x: np.interp(x[0], [0.0, 1.0], [0.0, 1.0]),
    "searchsorted": lambda x: np.searchsorted([0.0, 1.0], x[0]),
    "argmax": lambda x: x.argmax(),
    "median": lambda x: np.median(x),
    "maximum of plain arrays": lambda x: np.maximum(np.array([x[0], 1.0]), 0.0)[0],
    "solve": lambda x: np.linalg.solve(np.eye(3), x)[0],
    "complex": lambda x: (x[0] + 1j).real,
    "text": lambda x: len(f"{x[0]:.3f}"),
    "option": lambda x: np.add(x[0], 1.0, where=False),
    "a function of CasADi": lambda x: ca.sin(x[0]),
    "nothing": lambda x: None,
}


@pytest.mark.parametrize("mode", [0, 1])
@pytest.mark.parametrize("name", REJECTED)
def test_no_number_is_made_of_a_symbol(name, mode, numpy_mode):
    numpy_mode(mode)
    x = symbols.symbol_array(ca.SX.sym("x", 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(Exception):  # noqa: B017 (of whatever kind)
            symbols.column_of(REJECTED[name](x))


def test_what_is_equal_to_no_number():
    x = symbols.symbol_array(ca.SX.sym("x", 1))
    assert (x[0] == None) is False  # noqa: E711
    assert x[0] != "text"


# Nothing remains changed

T = np.linspace(0.0, 3.0, 16)
PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["r"])


def pendulum(k):
    return ct.nlsys(
        lambda t, x, u, p: [x[1], -k * np.sin(x[0]) - x[1] + np.clip(u[0], -0.5, 0.5) + np.where(x[0] > 0.2, 0.1, 0.0)],
        None,
        inputs=["r"],
        outputs=["angle", "rate"],
        states=2,
        name="pendulum",
    )


def state_of_casadi():
    classes = {kind: dict(vars(kind)) for kind in (ca.SX, ca.DM, ca.MX, ca.Function)}
    mode = ca.GlobalOptions.getNumpyMode() if hasattr(ca.GlobalOptions, "getNumpyMode") else 0
    return classes, mode, list(warnings.filters), np.geterr()


class Changed(BaseException):
    """Passes through trial calls."""


def attributes_of_casadi():
    return [dict(vars(kind)) for kind in (ca.SX, ca.DM, ca.MX, ca.Function)]


class Looking:
    """Factor -1 that depends on the state of CasADi."""

    before = attributes_of_casadi()

    def __rmul__(self, other):
        if attributes_of_casadi() != self.before or float(ca.SX(2.0)) != 2.0:
            raise Changed
        return other * -1.0


def test_while_a_block_is_traced_casadi_is_as_it_was():
    looking, given = Looking(), []
    system = ct.nlsys(lambda t, x, u, p: [x[0] * p["k"]], None, inputs=0, outputs=1, states=1, name="one")
    found = symbols.column_of([symbols.symbol_array(ca.SX.sym("x", 1))[0] * looking])
    assert found.is_symbolic() is False
    trace = trace_of(system, {"k": looking})
    assert float(trace.update(0.0, [2.0], given, given)) == -2.0
    assert attributes_of_casadi() == Looking.before


def trace_of(system, params):
    """Trace of a block, whatever its parameters refer to."""
    from ctrlplan.symbolic import tracing as module

    block = Block(system, dict(system.params))
    points = list(module._points(params, 0.0, np.ones(1), np.zeros(0)))
    return module._agreed(block, params, module._known(block, points))


@pytest.mark.slow
@pytest.mark.parametrize("mode", [0, 1, -1])
def test_threads_leave_nothing_changed_and_agree(mode, numpy_mode):
    """Loops built and run in threads: the bits of one thread alone."""
    numpy_mode(mode)
    before = state_of_casadi()
    gains = [1.0, 2.0, 3.0] * 2

    def run(k):
        return cp.simulate(pendulum(k), T, PLAN, method="compiled").outputs

    alone = [run(k) for k in gains]
    with ThreadPoolExecutor(4) as executor:
        together = list(executor.map(run, gains))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))
    assert state_of_casadi() == before
    assert float(ca.SX(1.0)) == 1.0


@pytest.mark.slow
def test_threads_share_a_prepared_form():
    """Integrators of one form for many patterns of times, from eight threads."""
    ready = cp.prepare(pendulum(2.0))
    counts = [11, 12, 13, 14]
    alone = {n: cp.simulate(ready, np.linspace(0.0, 3.0, n), PLAN).outputs for n in counts}
    ready = cp.prepare(pendulum(2.0))
    with ThreadPoolExecutor(8) as executor:
        runs = executor.map(lambda n: (n, cp.simulate(ready, np.linspace(0.0, 3.0, n), PLAN).outputs), counts * 8)
        assert all(np.array_equal(found, alone[n]) for n, found in runs)
    assert len(ready._built_forms.forms) == 1


def test_a_sweep_in_threads_leaves_casadi_as_it_was():
    before = state_of_casadi()
    with ThreadPoolExecutor(4) as executor:
        cp.sweep(pendulum, [1.0, 2.0, 3.0, 4.0], {"plan": PLAN}, T, outputs={"angle": "r"}, executor=executor)
    assert state_of_casadi() == before
    assert float(ca.SX(1)) == 1.0
