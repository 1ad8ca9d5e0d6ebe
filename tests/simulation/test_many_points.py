"""Functions of CasADi at many points by numpy, compared with CasADi at each point."""

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies.crane import CRANE, obstacle_waypoints
from ctrlplan.symbolic import missing_casadi

if missing_casadi():
    pytest.skip(missing_casadi(), allow_module_level=True)

import casadi as ca

from ctrlplan.symbolic import many_points as module
from ctrlplan.symbolic.many_points import ManyPoints, many_points

NUMBERS = [0.0, 1.0, -1.0, 0.5, -0.3, 2.0, 3.0, -2.5, 1e-9, 700.0, -1e300, np.inf, -np.inf, np.nan]
PAIRS = np.array(np.meshgrid(NUMBERS, NUMBERS)).reshape(2, -1)
ONE = {
    *(ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE, ca.OP_INV, ca.OP_SQ, ca.OP_SQRT, ca.OP_EXP, ca.OP_LOG, ca.OP_EXPM1),
    *(ca.OP_LOG1P, ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_SINH, ca.OP_COSH),
    *(ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH, ca.OP_ATANH, ca.OP_NOT, ca.OP_FABS, ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL),
}


def each(function, *arguments):
    """Results of CasADi, point by point."""
    points = [[a if a.ndim == 1 else a[:, k] for a in arguments] for k in range(arguments[0].shape[1])]
    return np.hstack([np.asarray(function(*given)) for given in points])


@pytest.mark.parametrize("kind", sorted(module._OPERATIONS))
def test_every_operation(kind):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    value = ca.SX.unary(kind, x) if kind in ONE else ca.SX.binary(kind, x, y)
    function = ca.Function("f", [x, y], [value])
    arguments = PAIRS[:1], PAIRS[1:]
    found, expected = ManyPoints(function)(arguments), each(function, *arguments)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=1e-15, atol=0.0)


@pytest.mark.parametrize("npoints", [1, 255, 256, 257, 3001])
def test_blocks_parameters_and_results_without_operations(npoints, monkeypatch):
    monkeypatch.setattr(module, "_MEMORY", 256)
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    rows = ca.vertcat(x[1], 4.0, p[1], x[0] * p[0] + ca.sin(x[2]), ca.if_else(x[0] > 0, x[1], p[0]), x[1])
    function = ca.Function("f", [ca.SX.sym("none", 0), x, p], [rows])
    rng = np.random.default_rng(0)
    arguments = np.empty((0, npoints)), rng.normal(size=(3, npoints)), rng.normal(size=2)
    kept = [given.copy() for given in arguments]
    np.testing.assert_allclose(ManyPoints(function)(arguments), each(function, *arguments), rtol=1e-14, atol=1e-15)
    for given, before in zip(arguments, kept, strict=True):
        np.testing.assert_array_equal(given, before)


def test_a_function_without_counterpart_is_left_to_casadi():
    x = ca.SX.sym("x")
    assert many_points(ca.Function("f", [x], [ca.erf(x)])) is None


def test_outputs_of_a_run_are_those_of_parts_of_it():
    """Many samples are evaluated by numpy, few of them by CasADi."""
    ready = cp.prepare(cp.plants.crane_loop(CRANE, cp.TrigSpline(obstacle_waypoints(), alpha=4.0)))
    found = cp.simulate(ready, np.linspace(0.0, 30.0, 301), method="compiled")
    form = ready._built_forms.forms[-1].form
    t, x, p = found.time, found.states, form.parameters({})
    values = ready.time_signals([], 0.0).at(t)
    parts = [form.outputs(t[k], x[:, k], values[:, k], p) for k in np.array_split(np.arange(t.size), 7)]
    np.testing.assert_allclose(found.outputs, np.hstack(parts), rtol=1e-14, atol=1e-14)
