"""Loops with switching, sliding, friction, noise or divergence: a result, or an error with block and time."""

import control as ct
import mpmath as mp
import numpy as np
import pytest
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.simulation.compiled import CompiledSolver
from ctrlplan.simulation.interpreted import (
    _A_SEGMENT,
    _CALLS,
    _EVALUATIONS,
    _PASSING,
    _REVIEWED,
    InterpretedSolver,
)

METHODS = ["auto", "python"]
DOCUMENTED = _EVALUATIONS + _REVIEWED + _CALLS + _PASSING + 10 * _A_SEGMENT
"""Evaluations after which a loop of a few segments has ended."""


def counted(rates, states=1, name="plant"):
    count = [0]

    def calls(t, x, u, params):
        count[0] += 1
        return rates(t, x, u)

    return ct.nlsys(calls, inputs="u", outputs=states, states=states, name=name), count


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("span", [2.0, 500.0])
@pytest.mark.parametrize("kind", ["branch", "where", "clip"])
def test_a_tank_that_overflows(kind, span, method):
    """The level rises at the inflow's rate and stays at 1: to the tolerance of the run."""
    rules = {
        "branch": lambda t, x, u: [0.0 if (x[0] >= 1 and u[0] > 0) else u[0]],
        "where": lambda t, x, u: [np.where((x[0] >= 1) * (u[0] > 0), 0.0, u[0])],
        "clip": lambda t, x, u: [u[0] * (x[0] < 1.0)],
    }
    block, count = counted(rules[kind], name="tank")
    t = np.linspace(0, span, 101)
    found = cp.simulate(block, t, 0.7, method=method)
    assert np.abs(found.outputs - np.minimum(0.7 * t, 1.0)).max() < 1e-6
    assert count[0] < DOCUMENTED


SLIDING = {
    "sign": (lambda t, x, u: [-np.sign(x[0]) + 0.3], [1.0], 1.0 / 0.7),
    "branch": (lambda t, x, u: [-1.0 if x[0] > 0.25 else 1.0], [1.0], 0.75),
    "super-twisting": (
        lambda t, x, u: [-1.5 * np.sqrt(np.abs(x[0])) * np.sign(x[0]) + x[1], -1.1 * np.sign(x[0]) + 0.5 * np.cos(t)],
        [1.0, 0.0],
        None,
    ),
    "friction": (lambda t, x, u: [x[1], 0.5 - np.sign(x[1])], [0.0, 1.0], 2.0),
    "hysteresis of no width": (lambda t, x, u: [x[1], 0.4 - np.sign(x[1] + x[0])], [1.0, 0.0], None),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", SLIDING)
def test_a_solution_that_stays_at_a_jump_names_block_and_time(case, method):
    rates, start, arrival = SLIDING[case]
    block, count = counted(rates, len(start), "slider")
    with pytest.raises(cp.SolverError, match=r"block slider .*is discontinuous there in .*np\.tanh") as caught:
        cp.simulate(block, np.linspace(0, 20, 21), 0.0, start, method=method)
    assert count[0] < DOCUMENTED
    if arrival is not None:
        reached = float(str(caught.value).split("got to ")[1].split(" s:")[0])
        assert arrival - 1e-3 < reached < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("method", one_in(2, METHODS))
def test_an_infinite_slope_names_its_block(method):
    """x' = -cbrt(x) is at 0 after 3/2 s, and there it is not defined how to go on for an integrator."""
    block, count = counted(lambda t, x, u: [-np.cbrt(x[0])], name="root")
    with pytest.raises(cp.SolverError, match=r"block root .*(infinite slope|discontinuous)") as caught:
        cp.simulate(block, np.linspace(0, 10, 11), 0.0, [1.0], method=method)
    assert abs(float(str(caught.value).split("got to ")[1].split(" s:")[0]) - 1.5) < 1e-2
    assert count[0] < DOCUMENTED


@pytest.mark.parametrize("method", METHODS)
def test_a_smoothed_switch_runs(method):
    """The replacement in the error message works: the sliding value of u is 0.3, in closed form atanh."""
    block, _ = counted(lambda t, x, u: [-np.tanh(x[0] / 1e-3) + 0.3], name="slider")
    found = cp.simulate(block, np.linspace(0, 5, 6), 0.0, [1.0], method=method)
    assert abs(found.outputs[-1] - 1e-3 * np.arctanh(0.3)) < 1e-9


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["generator", "global", "memory"])
def test_a_block_that_answers_twice_differently_is_named(kind, method):
    rng, calls = np.random.default_rng(0), []

    def memory():
        calls.append(1)
        return float(len(calls))

    draws = {"generator": rng.normal, "global": lambda: np.random.normal(), "memory": memory}  # noqa: NPY002
    draw = draws[kind]
    block, _ = counted(lambda t, x, u: [draw() - x[0]], name="noisy")
    lag = ct.ss(-1, 1, 1, 0, inputs="y[0]", outputs="z", name="filter")
    loop = ct.interconnect([block, lag], inputs="u", outputs="z")
    with pytest.raises(cp.SolverError, match="got to 0 s: block noisy returns different values for equal arguments"):
        cp.simulate(loop, np.linspace(0, 10, 11), 0.0, method=method)


@pytest.mark.slow
@pytest.mark.parametrize("method", one_in(2, METHODS, 1))
def test_noise_as_a_function_of_time_is_found(method):
    def rates(t, x, u):
        return [float(int(abs(np.sin(12345.678 * t)) * 1e8) % 1000) / 1000 - x[0]]

    block, count = counted(rates, name="noisy")
    with pytest.raises(cp.SolverError, match=r"block noisy .*is discontinuous there in t"):
        cp.simulate(block, np.linspace(0, 10, 11), 0.0, method=method)
    assert count[0] < DOCUMENTED


@pytest.mark.parametrize("method", METHODS)
def test_a_solution_that_explodes_ends_where_it_does(method):
    block, count = counted(lambda t, x, u: [x[0] ** 2], name="fire")
    with pytest.raises(cp.SolverError, match=r"got to (1|0\.9999\d*) s"):
        cp.simulate(block, np.linspace(0, 10, 11), 0.0, [1.0], method=method)
    assert count[0] < DOCUMENTED


@pytest.mark.parametrize("method", METHODS)
def test_a_relay_that_switches_without_sliding_runs(method):
    """x'' = -sign(x): parabolas of period 4 sqrt(2 x0), in closed form."""
    block, count = counted(lambda t, x, u: [x[1], -np.sign(x[0])], 2, "relay")
    t = np.linspace(0, 20, 201)
    found = cp.simulate(block, t, 0.0, [1.0, 0.0], method=method)
    quarter = np.sqrt(2.0)
    phase = np.mod(t, 4 * quarter)
    half = np.where(phase < 2 * quarter, phase, phase - 2 * quarter)
    sign = np.where(phase < 2 * quarter, 1.0, -1.0)
    # From one turning point to the next: down over the first quarter, up against the turn over the second.
    expected = np.where(half < quarter, 1.0 - half**2 / 2, -(1.0 - (2 * quarter - half) ** 2 / 2)) * sign
    assert np.abs(found.outputs[0] - expected).max() < 1e-6
    assert count[0] < DOCUMENTED


def test_a_long_run_is_no_stall():
    """Far more evaluations than are reviewed, of a regular oscillation: no message."""
    block, count = counted(lambda t, x, u: [x[1], -x[0] * abs(x[0]) ** 0.0], 2, "oscillator")
    found = cp.simulate(block, np.linspace(0, 400, 5), 0.0, [1.0, 0.0], method="python", rtol=1e-9)
    assert count[0] > _EVALUATIONS / 10
    assert np.abs(found.outputs[0] - np.cos(found.time)).max() < 1e-5


def test_an_algebraic_loop_without_a_solution_ends_soon():
    """y = 1 + y^2 has no real solution: the blocks are named, after a few calls."""
    count = [0]

    def out(t, x, u, params):
        count[0] += 1
        return [1.0 + u[0] ** 2]

    block = ct.nlsys(None, out, inputs="y", outputs="v", name="square", dt=0)
    other = ct.nlsys(None, lambda t, x, u, params: [u[0]], inputs="v", outputs="y", name="wire", dt=0)
    loop = ct.interconnect([block, other], inputs=0, outputs="y")
    with pytest.raises(RuntimeError, match=r"algebraic loop of the blocks square, wire .* at 0 s"):
        cp.simulate(loop, [0.0, 1.0])
    assert count[0] < 20_000


# A signal of a delay that dies away keeps the rounding errors of its terms


def integrator_with_delay(offset):
    """Loop y' = r - y(t - 0.5), from equilibrium at an offset."""
    plant = ct.nlsys(lambda t, x, u, params: [u[0]], lambda t, x, u, params: x, inputs="d", outputs="y", states=1)
    delay = cp.create_delay_iosystem(0.5, inputs="e", outputs="d")
    error = ct.summing_junction(["r", "-y"], "e")
    return ct.interconnect([plant, delay, error], inputs="r", outputs=["y"])


def method_of_steps(t):
    """Unit step response from rest, e = r - y and y' = e(t - 0.5): sum of (-1)^k (t - (k + 1)/2)^(k + 1)/(k + 1)!."""
    with mp.workdps(60):
        terms = range(int(2 * t))
        return float(sum((-1) ** k * (mp.mpf(t) - mp.mpf(k + 1) / 2) ** (k + 1) / mp.factorial(k + 1) for k in terms))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["compiled", "python"])
@pytest.mark.parametrize(("offset", "height"), [(0.0, 1.0), (1e4, 1e-3)])
def test_a_delayed_signal_that_dies_away_takes_no_more_segments(method, offset, height, monkeypatch):
    solver = {"compiled": CompiledSolver, "python": InterpretedSolver}[method]
    advance, segments = solver.advance, []
    monkeypatch.setattr(solver, "advance", lambda self, *args: segments.append(args[1]) or advance(self, *args))
    t = np.linspace(0.0, 60.0, 121)
    found = cp.simulate(
        integrator_with_delay(offset), t, cp.Step(offset + height, offset), [offset], method=method
    ).outputs
    expected = offset + height * np.array([method_of_steps(s) for s in t])
    assert np.abs(found - expected).max() <= 1e-6 * height
    late, early = sum(s >= 30.0 for s in segments), sum(s < 30.0 for s in segments)
    assert late <= 2 * early
