"""Loops that differ in their sources only are compiled once in a context of `shared_forms`."""

import math
from contextlib import nullcontext
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.simulation import compiled, numerical
from ctrlplan.simulation.built_forms import NotApplicableError, shared_forms
from ctrlplan.simulation.job import with_event_times
from ctrlplan.symbolic import tracing

pytest.importorskip("casadi")
TIMES = np.linspace(0.0, 4.0, 81)
PLANS = {
    "polynomial": cp.PolySpline([cp.Waypoint(0.0, 0.0, 0.0), cp.Waypoint(1.0, 1.0, 0.0)]),
    "trigonometric": cp.TrigSpline([cp.Waypoint(0.0, 0.0, 0.0), cp.Waypoint(1.5, 2.0, 0.0)], alpha=1.0),
}


def damped(plan, rate=2.0):
    """x' = rate (r - x) - x^3, with the source of r inside."""

    def update(t, x, u, params):
        return [rate * (u[0] - x[0]) - x[0] ** 3]

    return fed(plan, update)


def fed(plan, update):
    block = ct.nlsys(update, None, inputs=["r"], outputs=["y"], states=1, name="damped")
    source = cp.create_source_iosystem(cp.stack([plan], labels=["r"]), suffix="", name="plan")
    return ct.interconnect([source, block], inputs=0, outputs=["y"])


@pytest.fixture
def built(monkeypatch):
    """Networks that were compiled."""
    networks, whole = [], compiled.Compiled.__init__

    def init(self, network, traces):
        networks.append(network)
        whole(self, network, traces)

    monkeypatch.setattr(compiled.Compiled, "__init__", init)
    return networks


def reference(plan, rate):
    """The same by classical Runge-Kutta steps of 1/400 s, which end where the plans end; error below 1e-9."""
    x, h, found = 0.0, 1.0 / 400.0, [0.0]

    def slope(t, x):
        return rate * (float(plan(t)) - x) - x**3

    for k in range(20 * (TIMES.size - 1)):
        t = k * h
        a = slope(t, x)
        b = slope(t + h / 2, x + h / 2 * a)
        c = slope(t + h / 2, x + h / 2 * b)
        x += h / 6 * (a + 2 * b + 2 * c + slope(t + h, x + h * c))
        if (k + 1) % 20 == 0:
            found.append(x)
    return np.array(found)


def test_loops_with_other_plans_share_a_form(built):
    with shared_forms():
        for plan in PLANS.values():
            found = cp.simulate(damped(plan), TIMES, method="compiled")
            assert np.abs(found.outputs - reference(plan, 2.0)).max() <= 1e-7
    assert len(built) == 1


def test_without_the_context_each_loop_has_its_own(built):
    for plan in PLANS.values():
        cp.simulate(damped(plan), TIMES, method="compiled")
    assert len(built) == 2


def test_another_number_in_a_function_is_another_form(built):
    plan = PLANS["polynomial"]
    with shared_forms():
        for rate in (2.0, 3.0, 2.0):
            found = cp.simulate(damped(plan, rate), TIMES, method="compiled")
            assert np.abs(found.outputs - reference(plan, rate)).max() <= 1e-7
    assert len(built) == 2


def test_a_context_inside_another_one_shares_its_forms(built):
    with shared_forms():
        for plan in PLANS.values():
            with shared_forms():
                cp.simulate(damped(plan), TIMES, method="compiled")
    assert len(built) == 1


def test_compare_compiles_a_loop_once(built):
    cp.compare(lambda name, plan: damped(plan), PLANS, TIMES, outputs=["y"])
    assert len(built) == 1


def test_integrators_of_a_form_share_its_derivatives(monkeypatch):
    """x' = -x^3 from 1 is 1/sqrt(1 + 2 t); each number of sample times has an integrator of its own."""
    given, whole = [], compiled.ca.integrator
    monkeypatch.setattr(compiled.ca, "integrator", lambda *all: given.append({**all[-1]["cache"]}) or whole(*all))
    decaying = cp.prepare(ct.nlsys(lambda t, x, u, p: -(x**3), None, inputs=0, outputs=["x"], states=1, name="cubic"))
    for count in (11, 21, 31):
        times = np.linspace(0.0, 2.0, count)
        found = cp.simulate(decaying, times, None, 1.0, method="compiled")
        assert np.abs(found.outputs - 1.0 / np.sqrt(1.0 + 2.0 * times)).max() <= 1e-8
    assert given[0] == {}
    assert len(given) > 2
    assert all(found["jacF"].name() == "jacF" for found in given[1:])


def test_a_block_that_cannot_be_compiled_is_tried_in_each_loop(built):
    def branching(t, x, u, params):
        return [math.copysign(1.0, u[0] - x[0])]

    with shared_forms():
        for plan in PLANS.values():
            with pytest.raises(NotApplicableError, match="damped cannot be traced"):
                cp.simulate(fed(plan, branching), TIMES, method="compiled")
    assert not built


def limited(plan, gain):
    """`damped` with a smooth limit of its source by another block."""

    def update(t, x, u, params):
        return [2.0 * (u[0] - x[0]) - x[0] ** 3]

    source = cp.create_source_iosystem(cp.stack([plan], labels=["p"]), suffix="", name="plan")
    limit = ct.nlsys(None, lambda t, x, u, params: [np.tanh(gain * u[0])], inputs=["p"], outputs=["r"], name="limit")
    block = ct.nlsys(update, None, inputs=["r"], outputs=["y"], states=1, name="damped")
    return ct.interconnect([source, limit, block], inputs=0, outputs=["y"])


@pytest.mark.parametrize(("context", "once"), [(shared_forms, True), (nullcontext, False)])
def test_a_block_of_several_loops_is_traced_once(monkeypatch, context, once):
    names, whole, plan = [], tracing.traced, PLANS["polynomial"]
    monkeypatch.setattr(tracing, "traced", lambda block, *others: names.append(block.name) or whole(block, *others))
    with context():
        for gain in (1.0, 3.0):
            found = cp.simulate(limited(plan, gain), TIMES, method="compiled")

            def rates(t, x, gain=gain):
                return 2.0 * (np.tanh(gain * float(plan(min(t, 1.0)))) - x) - x**3

            peer = solve_ivp(rates, TIMES[[0, -1]], [0.0], t_eval=TIMES, rtol=1e-10, atol=1e-12, max_step=0.05)
            assert np.abs(found.outputs - peer.y[0]).max() <= 1e-7
    assert sorted(names) == ["damped"] * (1 if once else 2) + ["limit"] * 2


def test_times_of_events_divide_the_intervals_of_samples():
    """No interval is longer than 1/399 of the run, and equal intervals are divided equally."""
    event = [object()]
    for times in (np.linspace(0.0, 10.0, 101), np.array([0.0, 0.3, 5.0, 5.001, 9.0])):
        found = with_event_times(times, event, lambda: np.zeros((1, 1)))
        assert np.isin(times, found).all()
        assert np.diff(found).max() <= np.ptp(times) / 399 * (1.0 + 1e-9)
        for left, right in pairwise(times.tolist()):
            inside = found[(left <= found) & (found <= right)]
            np.testing.assert_allclose(np.diff(inside), (right - left) / (inside.size - 1), rtol=1e-9)
    dense = np.linspace(0.0, 1.0, 2001)
    assert with_event_times(dense, event, lambda: np.zeros((1, 1))) is dense


TURNS = 1e4
"""Angle of `turning` after 1 s of the plan at 1 [rad]."""


def turning(distance):
    """An angle of thousands of turns and the integral of its cosine, with the plan of the rate inside."""

    def update(t, x, u, params):
        return [TURNS * u[0], np.cos(x[0])]

    def output(t, x, u, params):
        return [x[1]]

    block = ct.nlsys(update, output, inputs=["r"], outputs=["y"], states=["phi", "y"], name="turning")
    points = [cp.Waypoint(0.0, 0.0, 0.0, 0.0), cp.Waypoint(1.0, distance, 0.0, 0.0)]
    source = cp.create_source_iosystem(cp.PolySpline(points, labels=["r"]), name="plan")
    return ct.interconnect([source, block], inputs=0, outputs=["y"])


def integral_of_cosine(distance, times):
    """The last state of `turning` in closed form but for one integral, by 20 Gauss points in each 1/8000 s."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    edges = np.linspace(0.0, 1.0, 8001)
    t = edges[:-1, None] + np.diff(edges)[:, None] * (nodes + 1.0) / 2.0
    angle = TURNS * distance * t**4 * (2.5 - 3.0 * t + t**2)
    total = np.concatenate([[0.0], np.cumsum(np.cos(angle) @ weights / 2.0 * np.diff(edges))])
    return np.interp(times, edges, total)


@pytest.mark.slow
def test_a_run_begins_with_the_tolerances_that_one_of_an_equal_loop_required(monkeypatch):
    runs, go = [], numerical.Attempt.go
    monkeypatch.setattr(numerical.Attempt, "go", lambda self: runs.append(self) or go(self))
    times, counts = np.linspace(0.0, 1.0, 41), []
    for context in (shared_forms, nullcontext):
        with context():
            for distance in (1.0, 0.75):
                runs.clear()
                found = cp.simulate(turning(distance), times, method="compiled")
                counts.append(len(runs))
                assert np.abs(found.outputs - integral_of_cosine(distance, times)).max() <= 1e-7
    assert counts == [2, 1, 2, 2]
