"""Time scaling on line: its composition by sympy, its lags in closed form, plans of every kind, wrong arguments."""

import math
import re
from itertools import pairwise
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
import sympy as sp
from numpy.polynomial import Polynomial
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.special import gammainc
from time_scaling_cases import INF, METHODS, ONE, RISE, rest

import ctrlplan as cp

U = {"u": (-1.0, 1.0)}


def identity(duration=10.0):
    """y = t: the block outputs sigma itself, sigma', ..."""
    return cp.PolySpline([cp.Waypoint(0.0, 0.0), cp.Waypoint(duration, duration)], labels=["sigma"])


def pulses(*steps):
    """Jumps (time, size), from 0."""
    found = cp.Step(0.0, time=steps[0][0])
    for time, size in steps:
        found = found + cp.Step(size, time=time)
    return found


def alone(plan, derivatives, t, u, method="auto", **options):
    """Run of the block, its limit at 1 and the margin so that u from 0.5 to 1 is a severity from 0 to 1."""
    block = cp.create_time_scaling_iosystem(plan, derivatives, **({"limits": U, "margin": 0.25} | options))
    found = cp.simulate(block, t, {"u": u}, method=method, rtol=1e-11, atol=1e-12)
    jets = np.asarray(found.outputs).reshape(plan.naxes, derivatives + 1, t.size)
    states = np.asarray(found.states)
    return SimpleNamespace(jets=jets, lag=states[0], sigma=t - states[0], rate=1.0 - states[-1], found=found)


def clock_by_hand(severity, n, w, t, slowest=0.1, fastest=1.1, horizon=None):
    """t - sigma and the n lags of 1 - sigma' from the formula of the docstring, between jumps of a severity (t, y)."""
    horizon = 4 * n / w if horizon is None else horizon
    values, jumps = severity

    def rate(moment, x, value):
        rho = slowest + (1 - value) * (min(fastest, 1 + x[0] / horizon) - slowest)
        return [x[n], *(w * (np.array([1 - rho, *x[1:n]]) - x[1:]))]

    out, state = [], np.zeros(n + 1)
    edges = [t[0], *jumps, t[-1]]
    for value, (left, right) in zip(values, pairwise(edges), strict=True):
        inside = t[(t >= left) & ((t < right) | (right == t[-1]))]
        requested = np.union1d(inside, [left, right])
        run = solve_ivp(
            rate, (left, right), state, method="DOP853", t_eval=requested, rtol=1e-12, atol=1e-13, args=(value,)
        )
        assert run.success
        out.append(run.y[:, np.isin(requested, inside)])
        state = run.y[:, -1]
    return np.hstack(out)


def derivatives_of_sigma(states, w):
    """sigma', ..., sigma^(n) from the lags, each a difference of two: slow[k]' = w (slow[k - 1] - slow[k])."""
    rows, found = list(states[1:]), []
    found.append(1 - rows[-1])
    while len(rows) > 1:
        rows = [w * (a - b) for a, b in pairwise(rows)]
        found.append(-rows[-1])
    return found


def composed_by_sympy(outer, inner):
    """Derivatives of f(s(t)) from those of f, (k, ntime), and of s (from the first), by symbolic differentiation."""
    t = sp.Symbol("t")
    s, f = sp.Function("s")(t), sp.Function("f")
    y, found = f(s), []
    fs, ss = sp.symbols(f"f0:{len(outer)}"), sp.symbols(f"s1:{len(inner) + 1}")
    x = sp.Symbol("x")
    for k in range(len(outer)):
        plain = y.diff(t, k).doit()
        for j in reversed(range(1, k + 1)):
            plain = plain.subs(s.diff(t, j), ss[j - 1])
        plain = plain.replace(
            lambda e: isinstance(e, sp.Subs) and e.expr.has(f),
            lambda e: fs[e.expr.derivative_count],
        ).replace(
            lambda e: isinstance(e, sp.Derivative) and e.has(f),
            lambda e: fs[e.derivative_count],
        )
        plain = plain.subs(f(s), fs[0])
        assert not plain.has(f, x, t), plain
        found.append(sp.lambdify([*fs, *ss], plain)(*outer, *inner) + 0 * outer[0])
    return np.array(found)


# Without disturbance: the plan itself


KINDS = {
    "polynomial": rest((0.5, 0.0), (4.0, 1.0)),
    "trigonometric": cp.TrigSpline([cp.Waypoint(0.5, 1, 0, 0), cp.Waypoint(4, -1, 0.3, 0)], alpha=2.0),
    "trigonometric of odd size": cp.TrigSpline(
        [cp.Waypoint(0, 0, 0), cp.Waypoint(1, 2), cp.Waypoint(4, 1, 0)], alpha=3.0
    ),
    "piecewise": cp.PiecewiseSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 2), cp.Waypoint(4, 1, 0, 0)]),
    "piecewise, trigonometric": cp.PiecewiseSpline(
        [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 2), cp.Waypoint(4, 1, 0, 0)], alpha=1.0
    ),
    "step": cp.Step(2.0, 1.0, 1.7),
    "joined": rest((0, 0), (2, 1)).then(rest((0, 1), (1.5, 3))),
    "scaled": -2.5 * rest((0.5, 0.0), (4.0, 1.0)),
    "sum": rest((0, 0), (2, 1)) + rest((1, 0), (4, 1)),
    "stacked": cp.stack([rest((0, 0), (2, 1)), cp.TrigSpline([cp.Waypoint(1, 1, 0), cp.Waypoint(4, 2, 0)], alpha=1.0)]),
    "selected": cp.stack([rest((0, 0), (2, 1)), rest((1, 5), (4, 1))]).select(["y2", "y1"]),
    "stacked, scaled, then joined": (2.0 * cp.stack([rest((0, 0), (2, 1)), rest((0, 0), (1, 1))])).then(
        cp.stack([rest((0, 2), (2, 1)), rest((0, 2), (1, 1))])
    ),
    "ends in a jump": rest((0, 0), (4, 1)).then(cp.Step(3.0, 1.0, 4.0)),
    "sum of steps": cp.Step(1.0, time=1.0) + cp.Step(0.5, time=3.5),
    "closed": cp.TrigSpline.cyclic([cp.Waypoint(0, 0), cp.Waypoint(1, 1), cp.Waypoint(3, 0.5)], 4.0),
}
every_kind = pytest.mark.parametrize("kind", KINDS)
TIMES = np.unique(np.append(np.linspace(-0.5, 6.0, 66), [1.0, 1.5, 2.0, 4.0]))


@pytest.mark.parametrize("derivatives", [0, 2, 4])
@every_kind
def test_at_the_zero_state_the_block_is_the_plan_at_the_time_and_goes_with_it(kind, derivatives):
    """Before the start, at every breakpoint and after the end: 1e-12 of the largest value, and no state moves."""
    plan = KINDS[kind]
    block = cp.create_time_scaling_iosystem(plan, derivatives, limits=U, bandwidth=3.0)
    zero = np.zeros(block.nstates)
    found = np.array([block.output(t, zero, [0.2]) for t in TIMES]).T.reshape(plan.naxes, derivatives + 1, -1)
    wanted = plan.jet(TIMES, derivatives).transpose(1, 0, 2)
    assert np.all(np.abs(found - wanted) <= 1e-12 * np.abs(wanted).max(axis=2, keepdims=True))
    for t in TIMES:
        assert np.all(block.dynamics(t, zero, [0.2]) == 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_with_nothing_wrong_a_run_outputs_the_plan_at_rate_1(method):
    plan = KINDS["polynomial"]
    found = alone(plan, 3, np.linspace(0, 6, 61), 0.4, method)
    wanted = plan.jet(np.linspace(0, 6, 61), 3).transpose(1, 0, 2)
    assert found.found.method == method
    assert np.abs(found.jets - wanted).max() <= 1e-12 * np.abs(wanted).max()
    assert np.abs(found.rate - 1).max() <= 1e-12
    assert np.abs(found.lag).max() <= 1e-12


# The time scaling: closed forms of its lags


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_at_the_largest_severity_the_rate_falls_as_equal_lags_do(n):
    """1 - sigma' is (1 - slowest) times the incomplete gamma function of w t; severity 1 does not catch up."""
    w, minimum, t = 2.0, 0.25, np.linspace(0, 4, 41)
    found = alone(identity(), n, t, 1.0, bandwidth=w, slowest=minimum)
    fallen = (1 - minimum) * gammainc(n, w * t)
    assert np.abs(found.rate - (1 - fallen)).max() <= 1e-9
    # Of the integral of the incomplete gamma function: t P(n, wt) - (n/w) P(n + 1, wt).
    delay = (1 - minimum) * (t * gammainc(n, w * t) - n / w * gammainc(n + 1, w * t))
    assert np.abs(found.lag - delay).max() <= 1e-9
    assert np.abs(found.jets[0, 0] - (t - delay)).max() <= 1e-9
    assert np.abs(found.jets[0, 1] - (1 - fallen)).max() <= 1e-9


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_time_scaling_slows_and_catches_up_as_its_formula_says(n, method):
    """Against the formula of the docstring by scipy: severities 0, 0.4, 1, 0.2, 0."""
    w, t = 6.0, np.linspace(0, 12, 121)
    severity = ([0.0, 0.4, 1.0, 0.2, 0.0], [1.0, 2.0, 3.5, 5.0])
    u = pulses((1.0, 0.7), (2.0, 0.3), (3.5, -0.4), (5.0, -0.6))
    hand = clock_by_hand(severity, n, w, t, slowest=0.2, fastest=1.5)
    found = alone(identity(20.0), n, t, u, method, bandwidth=w, slowest=0.2, fastest=1.5)
    assert np.abs(found.lag - hand[0]).max() <= 1e-8
    assert np.abs(np.asarray(found.found.states) - hand).max() <= 1e-8
    for k, wanted in enumerate([t - hand[0], *derivatives_of_sigma(hand, w)][: n + 1]):
        assert np.abs(found.jets[0, k] - wanted).max() <= 1e-8 * max(1.0, np.abs(wanted).max())
    # The case is demanding: slower, then faster, both near the limits.
    assert found.rate.min() < 0.5
    assert found.rate.max() > 1.15


def test_the_defaults_are_those_of_the_docstring():
    """w of 10 over the duration, T of 4 n/w, rates of 0.1 and 1.1, a margin of a tenth of the range."""
    plan, t = rest((0, 0), (5, 1)), np.linspace(0, 9, 91)
    block = cp.create_time_scaling_iosystem(plan, limits=U)
    found = cp.simulate(block, t, {"u": pulses((1.0, 0.95), (4.0, -0.95))}, rtol=1e-11, atol=1e-12)
    hand = clock_by_hand(([0.0, 0.75, 0.0], [1.0, 4.0]), 2, 2.0, t)
    assert np.abs(np.asarray(found.states) - hand).max() <= 1e-9


def test_catch_up_is_the_time_constant_of_the_lag():
    """With lags that are fast, a lag so small that it is not limited falls as exp(-t/T)."""
    t = np.linspace(0, 6, 121)
    found = alone(identity(20.0), 1, t, pulses((0.0, 1.0), (0.2, -1.0)), bandwidth=400.0, catch_up=2.0, fastest=3.0)
    late = t > 0.5
    slope = np.polyfit(t[late], np.log(found.lag[late]), 1)[0]
    assert abs(slope + 0.5) <= 2e-3  # the lags take 1/(w T) of it


# The jets


@pytest.fixture(scope="module")
def slowed():
    """A plan of two axes, derivatives 0 to 4, on a time scaling that slows twice and catches up."""
    times = np.linspace(0.0, 16.0, 3201)
    u = pulses((2.0, 1.0), (4.0, -0.3), (5.0, -0.7), (7.0, 0.8), (7.5, -0.8))
    plan = cp.PolySpline(
        [
            cp.Waypoint.from_jets(0.5, x=[0, 0, 0, 0, 0], z=[1, 0, 0, 0, 0]),
            cp.Waypoint.from_jets(8.5, x=[3, 0, 0, 0, 0], z=[-1, 0, 0, 0, 0]),
        ]
    )
    return plan, times, alone(plan, 4, times, u, bandwidth=5.0, fastest=1.4)


@pytest.mark.slow
def test_jets_are_those_of_the_plan_composed_with_the_time_scaling(slowed):
    """By sympy's derivatives of f(s(t)) to order 4, those of the plan in closed form and those of s by its lags."""
    _, _, found = slowed
    tau = (found.sigma - 0.5) / 8.0
    inside = (tau > 0) & (tau < 1)
    inner = derivatives_of_sigma(np.asarray(found.found.states)[:, inside], 5.0)
    assert abs(inner[0] - 1).max() > 0.5
    for axis, (start, move) in enumerate([(0.0, 3.0), (1.0, -2.0)]):
        outer = [
            move * RISE.deriv(k)(tau[inside]) / 8.0**k if k else start + move * RISE(tau[inside]) for k in range(5)
        ]
        wanted = composed_by_sympy(outer, inner)
        assert np.all(np.abs(found.jets[axis][:, inside] - wanted) <= 1e-10 * np.abs(wanted).max(axis=1, keepdims=True))


def test_acceleration_is_what_the_docstring_says(slowed):
    """y'' = y_d'' sigma'^2 + y_d' sigma''."""
    plan, _, found = slowed
    first, second = derivatives_of_sigma(np.asarray(found.found.states), 5.0)[:2]
    jet = plan.jet(found.sigma, 2)
    wanted = jet[2] * first**2 + jet[1] * second
    assert np.abs(found.jets[:, 2] - wanted).max() <= 1e-12 * np.abs(wanted).max()
    assert np.abs(jet[1] * second).max() >= 0.1 * np.abs(wanted).max()  # the second term counts


@pytest.mark.parametrize("k", range(4))
def test_each_output_is_the_integral_of_the_next(slowed, k):
    """From jump to jump of the input, by Simpson's rule on 3201 samples: slowing, standing slow, catching up."""
    _, times, found = slowed
    for left, right in pairwise([0.0, 0.5, 2.0, 4.0, 5.0, 7.0, 7.5, 16.0]):
        part = (times >= left - 1e-9) & (times <= right + 1e-9)
        grown = cumulative_simpson(found.jets[:, k + 1, part], x=times[part], initial=0)
        wanted = found.jets[:, k, part] - found.jets[:, k, part][:, :1]
        size = np.abs(found.jets[:, k + 1]).max()
        assert np.abs(grown - wanted).max() <= 2e-6 * size


@pytest.mark.parametrize("method", METHODS)
def test_integrators_behind_the_outputs_output_the_outputs_before(method):
    """In one run, so to the solver's tolerance: the integral of output k + 1 is output k, for k = 0 to 3."""
    plan = rest((0.0, 0.0), (6.0, 1.0), labels=["x"])
    names = ["x", "x_d1", "x_d2", "x_d3", "x_d4"]
    scaling = cp.create_time_scaling_iosystem(plan, 4, limits=U, margin=0.25, bandwidth=4.0)
    chains = [ct.ss(0, 1, 1, 0, inputs=name, outputs=f"i_{name}", name=f"int_{name}") for name in names[1:]]
    loop = ct.interconnect([scaling, *chains], inputs=["u"], outputs=[*names, *(f"i_{name}" for name in names[1:])])
    u = pulses((1.0, 0.9), (2.5, -0.9), (3.0, 1.0), (3.3, -1.0))
    found = cp.simulate(loop, np.linspace(0, 10, 101), {"u": u}, method=method, rtol=1e-10, atol=1e-11)
    outputs = np.asarray(found.outputs)
    for k in range(4):
        assert np.abs(outputs[5 + k] - outputs[k]).max() <= 1e-8 * np.abs(outputs[k + 1]).max()
    assert np.asarray(found.states)[0].max() > 1.0  # a lag of seconds


# Smoothness, bounds, path


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_sigma_is_n_times_continuously_differentiable_where_severity_jumps(n):
    """sigma^(n) changes over h by no more than a multiple of h, sigma^(n + 1) jumps by -w^n (1 - slowest)."""
    w, jump, h = 2.0, 1.0, 1e-4
    t = np.array([0.0, 0.5, jump - 2 * h, jump - h, jump, jump + h, jump + 2 * h, 2.0])
    found = alone(identity(), n, t, cp.Step(1.0, time=jump), bandwidth=w, slowest=0.1)
    for k in range(n + 1):
        steps = np.diff(found.jets[0, k, 2:7])
        assert np.abs(steps).max() <= 1.01 * max(1.0, w**n * 0.9) * h
    before, after = np.diff(found.jets[0, n, 2:4])[0] / h, np.diff(found.jets[0, n, 4:6])[0] / h
    flat = 1.0 if n == 0 else 0.0
    assert abs(before - flat) <= 1e-6
    assert abs(after + 0.9 * w**n) <= 0.9 * w**n * n * w * h  # by the lag's own fall in a step


@pytest.mark.parametrize("n", [1, 3])
def test_outputs_depend_on_the_input_through_states_alone(n):
    block = cp.create_time_scaling_iosystem(rest((0, 0), (2, 1)), n, limits=U)
    state = np.linspace(0.1, 0.4, n + 1)
    assert np.array_equal(block.output(1.0, state, [0.0]), block.output(1.0, state, [1.0]))
    assert cp.traits_of(block).feedthrough is False
    assert not np.array_equal(block.dynamics(1.0, state, [0.0]), block.dynamics(1.0, state, [1.0]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_rate_stays_between_slowest_and_fastest(n, seed):
    """Whatever the input does: 40 random severities, default catching up."""
    rng = np.random.default_rng(seed)
    t, values = np.arange(0.0, 20.01, 0.05), rng.choice([0.0, 0.6, 0.8, 1.0, 3.0, -2.0], 41)
    minimum, maximum = rng.uniform(0.0, 0.5), rng.uniform(1.0, 2.5)
    steps = [(0.5 * i, float(b - a)) for i, (a, b) in enumerate(pairwise(np.append(0.0, values)))]
    found = alone(identity(30.0), n, t, pulses(*steps), bandwidth=4.0, slowest=minimum, fastest=maximum)
    assert found.rate.min() >= minimum - 1e-9
    assert found.rate.max() <= maximum + 1e-9
    assert np.all(np.diff(found.sigma) >= -1e-9)
    assert found.lag.min() >= -1e-9
    assert found.rate.min() < 0.8  # slowed at all


# 1/(w T) from which on s (s/w + 1)^n + 1/T has a root to the right: cos(pi/2n)^-n tan(pi/2n) ... by Routh for n = 2, 3.
MARGINAL = {2: 2.0, 3: 8.0 / 9.0}


@pytest.mark.parametrize("n", MARGINAL)
def test_a_catch_up_with_which_the_lag_would_swing_indefinitely_is_rejected(n):
    """At the bound by Routh's criterion: just below it is rejected, just above it the lag settles above `slowest`."""
    w = 10.0
    bound = 1.0 / (w * MARGINAL[n])
    with pytest.raises(
        ValueError, match=r"catch_up must be long compared with the lags, \d/bandwidth = 0\.\d s, got 0\.\d+ s"
    ):
        cp.create_time_scaling_iosystem(identity(30.0), n, limits=U, bandwidth=w, catch_up=0.99 * bound)
    options = {"bandwidth": w, "catch_up": 1.5 * bound, "fastest": 3.0, "slowest": 0.1}
    found = alone(identity(60.0), n, np.linspace(0, 40, 2001), pulses((0.0, 1.0), (3.0, -1.0)), **options)
    assert found.lag.min() < -0.05  # it overshoots
    assert found.rate.min() >= 0.1 - 1e-9
    assert abs(found.lag[-1]) <= 1e-6


def test_with_slowest_0_the_plan_may_stand_still_and_goes_on():
    t = np.linspace(0, 90, 901)  # 19 s of delay, at half a second per second
    found = alone(identity(20.0), 2, t, pulses((1.0, 1.0), (20.0, -1.0)), bandwidth=5.0, slowest=0.0, fastest=1.5)
    stood = (t > 10) & (t < 20)
    assert np.ptp(found.sigma[stood]) <= 1e-8
    assert np.abs(found.jets[0, 1:, stood]).max() <= 1e-8
    assert found.lag.max() > 18.5
    assert abs(found.lag[-1]) <= 1e-6


def test_the_path_is_the_plans_own_whatever_the_rate():
    """x is the time and z a cubic of it: z = x^3/20 - x + 1 on every sample, in a run with four rates."""
    curve = Polynomial([1.0, -1.0, 0.0, 0.05])
    plan = cp.PolySpline(
        [
            cp.Waypoint.from_jets(0.0, x=[0.0, 1.0], z=[1.0, -1.0]),
            cp.Waypoint.from_jets(6.0, x=[6.0, 1.0], z=[curve(6.0), curve.deriv()(6.0)]),
        ]
    )
    t = np.linspace(0.0, 9.0, 181)
    found = alone(plan, 2, t, pulses((1.0, 0.8), (3.0, 0.2), (4.0, -1.0)), bandwidth=3.0)
    (x, x1, _), (z, z1, _) = found.jets
    assert np.abs(z - curve(x)).max() <= 1e-9
    moving = x < 6.0 - 1e-6
    assert np.abs(z1 - curve.deriv()(x) * x1)[moving].max() <= 1e-9  # along the tangent
    assert np.ptp(x1[moving]) > 0.5


@pytest.mark.parametrize("fastest", [1.1, 2.0])
def test_the_lag_is_made_up_for_afterwards(fastest):
    t = np.linspace(0, 40, 401)
    found = alone(identity(50.0), 2, t, pulses((1.0, 1.0), (2.0, -1.0)), bandwidth=10.0, fastest=fastest)
    assert 0.5 < found.lag.max() < 1.0
    assert abs(found.lag[-1]) <= 1e-6
    assert abs(found.jets[0, 0, -1] - 40.0) <= 1e-6
    assert np.abs(found.jets[0, 1, -1] - 1.0) <= 1e-6


def test_with_fastest_1_the_lag_is_kept():
    t = np.linspace(0, 40, 401)
    found = alone(identity(50.0), 2, t, pulses((1.0, 1.0), (2.0, -1.0)), bandwidth=10.0, fastest=1.0)
    assert np.all(np.diff(found.lag) >= -1e-9)
    # One second at severity 1, in and out through the same lags.
    assert abs(found.lag[-1] - 0.9) <= 1e-8
    assert found.rate.max() <= 1 + 1e-9


# Plans of every kind, compiled


@every_kind
def test_a_plan_of_every_kind_runs_compiled_behind_a_slowed_time_scaling(kind):
    """Value, rate and acceleration by the chain rule on the plan's own numbers at sigma, which comes by hand."""
    plan, w = KINDS[kind], 4.0
    t = np.linspace(0.0, 8.0, 81) + 1e-4  # no sample at a break
    t[0] = 0.0
    hand = clock_by_hand(([0.0, 0.8, 0.0], [1.0, 2.2]), 2, w, t)
    found = alone(plan, 2, t, pulses((1.0, 0.9), (2.2, -0.9)), "compiled", bandwidth=w)
    assert found.found.method == "compiled"
    assert np.abs(found.lag - hand[0]).max() <= 1e-8
    first, second = derivatives_of_sigma(hand, w)
    jet = plan.jet(t - hand[0], 2)
    wanted = np.array([jet[0], jet[1] * first, jet[2] * first**2 + jet[1] * second]).transpose(1, 0, 2)
    assert np.all(np.abs(found.jets - wanted) <= 1e-6 * (np.abs(wanted).max(axis=2, keepdims=True) + 1e-3))


@pytest.mark.parametrize("method", METHODS)
@every_kind
def test_samples_at_breakpoints_are_the_plans_own(kind, method):
    """Right-continuous inside, the plan's own value at the end, by both methods."""
    plan = KINDS[kind]
    t = np.unique(np.concatenate([[-1.0], plan.breakpoints, [7.0]]))
    found = alone(plan, 1, t, 0.1, method, bandwidth=1.0)
    wanted = plan.jet(t, 1).transpose(1, 0, 2)
    assert np.abs(found.jets - wanted).max() <= 1e-11 * np.abs(wanted).max()


@pytest.mark.parametrize("method", METHODS)
def test_a_plan_that_starts_late_is_held_and_begins_later_by_the_lag(method):
    plan, t = rest((5.0, 2.0), (7.0, 3.0)), np.linspace(0, 14, 281)
    u = pulses((1.0, 1.0), (3.0, -1.0))
    found = alone(plan, 2, t, u, method, bandwidth=20.0, fastest=1.0)
    lag = 0.9 * 2.0  # kept: fastest is 1
    assert abs(found.lag[-1] - lag) <= 1e-8
    wanted = plan.jet(t - lag, 2).transpose(1, 0, 2)
    late = t > 4.5
    assert np.abs(found.jets - wanted)[:, :, late].max() <= 1e-7
    assert np.abs(found.jets[0, 0, ~late] - 2.0).max() <= 1e-12
    assert np.all(found.jets[0, 1:, ~late] == 0.0)
    after = t > 7.0 + lag + 0.01
    assert np.all(found.jets[0, 0, after] == plan.final)
    assert np.all(found.jets[0, 1:, after] == 0.0)


def move_after_move(order):
    """1 m in 2 s, rest, 1 m in half a second; a ramp (0), cubics (1), quintics (2)."""
    return cp.PiecewiseSpline([cp.Waypoint(t, p, *[0.0] * order) for t, p in [(0, 0), (2, 1), (30, 1), (30.5, 2)]])


LATE = {
    "one move, late": rest((30.0, 0.0), (30.5, 1.0), order=2),
    "ramps": move_after_move(0),
    "cubics": move_after_move(1),
    "quintics": move_after_move(2),
    "stacked": cp.stack([move_after_move(1), rest((0, 0), (20, 1))]).select(["y1"]),
    "joined": rest((0, 0), (2, 1), order=1)
    .then(cp.PolySpline([cp.Waypoint(0, 1), cp.Waypoint(28, 1)]))
    .then(rest((0, 1), (0.5, 2), order=1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("case", "fastest"), [*((case, 1.0) for case in LATE), ("one move, late", 1.02), ("cubics", 1.02)]
)
def test_no_move_behind_a_slowed_time_scaling_is_skipped(case, fastest, method):
    """At rest for long before a short move, which starts later than planned: the integral must be that of the move."""
    plan = cp.stack([LATE[case]], labels=["x"])
    options = {"bandwidth": 20.0, "fastest": fastest, "catch_up": 300.0}
    scaling = cp.create_time_scaling_iosystem(plan, 2, limits=U, **options)
    chain = ct.ss(0, 1, 1, 0, inputs=["x_d1"], outputs=["p"], name="chain")
    loop = ct.interconnect([scaling, chain], inputs=["u"], outputs=["x", "p", "x_d2"])
    found = cp.simulate(loop, np.linspace(0, 42, 43), {"u": pulses((0.0, 1.0), (9.0, -1.0))}, method=method)
    x, p, _ = np.asarray(found.outputs)
    assert np.asarray(found.states)[0, 30] > 4.0
    assert x[-1] == plan.final[0]
    assert abs(p[-1] - plan.final[0]) <= 1e-6


def test_a_short_segment_in_a_long_run_costs_no_hundred_thousand_segments():
    """The longest step is that of whole moves, here of 1 s and 59 s, a millisecond apart."""
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0), cp.Waypoint(1.001, 1, 0, 0), cp.Waypoint(60, 2, 0, 0)]
    scaling = cp.create_time_scaling_iosystem(cp.PiecewiseSpline(points), 2, limits=U)
    assert 0.1 <= cp.traits_of(scaling).longest <= 1.0


# What it is


def test_names_and_attributes():
    plan = cp.stack([rest((1, 0), (2, 1), labels=["x"]), rest((1.5, 0), (4, 1), labels=["z"])])
    block = cp.create_time_scaling_iosystem(plan, 1, limits={"F": (-1, 1)}, suffix="_ref", name="clock")
    assert block.name == "clock"
    assert block.output_labels == ["x_ref", "x_ref_d1", "z_ref", "z_ref_d1"]
    assert block.state_labels == ["lag", "slow[1]"]
    assert block.input_labels == ["F"]
    assert block.dt == 0
    assert np.array_equal(cp.traits_of(block).breakpoints, [1.0, 1.5, 2.0, 4.0])
    source = cp.create_source_iosystem(plan, 1, suffix="_ref")
    assert block.output_labels == source.output_labels


@pytest.mark.parametrize("method", METHODS)
def test_without_derivatives_there_is_one_lag_and_the_position_alone(method):
    t = np.linspace(0, 6, 61)
    found = alone(KINDS["piecewise"], 0, t, pulses((0.5, 1.0), (2.0, -1.0)), method, bandwidth=3.0)
    assert found.found.state_labels == ["lag", "slow[1]"]
    hand = clock_by_hand(([0.0, 1.0, 0.0], [0.5, 2.0]), 1, 3.0, t)
    assert np.abs(found.jets[0, 0] - KINDS["piecewise"](t - hand[0])).max() <= 1e-8


def test_a_plan_without_duration_needs_a_bandwidth():
    step = cp.Step(2.0, time=1.0)
    with pytest.raises(ValueError, match="bandwidth must be given for a plan without duration, got None"):
        cp.create_time_scaling_iosystem(step, limits=U)
    block = cp.create_time_scaling_iosystem(step, limits=U, bandwidth=1.0)
    assert block.output(1.5, [0.0, 0, 0], [0])[0] == 2.0
    assert block.output(1.5, [0.6, 0, 0], [0])[0] == 0.0


BOTH = (TypeError, ValueError)
BAD = [
    (TypeError, "plan must be a Trajectory, got str", {"plan": "x"}),
    (ValueError, "derivatives must be an integer of at least 0, got -1", {"derivatives": -1}),
    (ValueError, "derivatives must be an integer of at least 0, got 1.5", {"derivatives": 1.5}),
    (ValueError, "limits or errors must name a signal", {"limits": None}),
    (ValueError, "limits or errors must name a signal", {"limits": {}, "errors": {}}),
    *((ValueError, "limits of u must increase", {"limits": {"u": pair}}) for pair in ((1, -1), (1, 1))),
    *((BOTH, "limits of u must be", {"limits": {"u": pair}}) for pair in ((math.nan, 1), (1,), -3, "ab", (1, 2, 3))),
    (ValueError, "limits of u must contain a finite one", {"limits": {"u": (-INF, INF)}}),
    (ValueError, "limits of u must contain a finite one that is not 0", {"limits": {"u": (0, INF)}}),
    (ValueError, "errors must name axes of the plan, x, got 'z'", {"errors": {"z": (0, 1)}}),
    *(
        (BOTH, "errors of x must", {"errors": {"x": pair}})
        for pair in ((1, 1), (1, 0.5), (-1, 1), (0, INF), (math.nan, 1), (1,), (None, 1))
    ),
    (ValueError, "inputs and outputs must have different names, got x ", {"errors": {"x": (0, 1)}, "suffix": ""}),
    (ValueError, "inputs and outputs must have different names", {"limits": {"x_ref_d1": (0, 1)}}),
    (ValueError, "inputs and outputs must have different names", {"limits": {"x": (0, 1)}, "errors": {"x": (0, 1)}}),
    *((ValueError, "margin must", {"margin": m}) for m in (0, -1, 0.6, math.nan)),
    (ValueError, "margin must", {"margin": -1, "limits": None, "errors": {"x": (0, 1)}}),
    *((ValueError, "slowest must", {"slowest": s}) for s in (-0.1, 1, math.nan)),
    *((ValueError, "fastest must", {"fastest": f}) for f in (0.9, INF, math.nan)),
    *((ValueError, "bandwidth must be finite and above 0", {"bandwidth": b}) for b in (0, -1, INF, math.nan)),
    *((ValueError, "catch_up must be finite and above 0", {"catch_up": c}) for c in (0, -1, INF, math.nan)),
    (TypeError, "bandwidth must be a number, got 'a'", {"bandwidth": "a"}),
    (TypeError, "slowest must be a number, got 'a'", {"slowest": "a"}),
    (TypeError, "fastest must be a number, got None", {"fastest": None}),
    (TypeError, "margin must be a number, got 'a'", {"margin": "a"}),
    (TypeError, "limits of u must be", {"limits": {"u": ("a", "b")}}),
    (TypeError, "limits must be a mapping", {"limits": [("u", (-1, 1))]}),
]


def _name(case):
    return ",".join(f"{k}={v}" for k, v in case[2].items())


@pytest.mark.parametrize(("kind", "message", "given"), BAD, ids=map(_name, BAD))
def test_bad_input_is_rejected_by_name(kind, message, given):
    options = {"plan": ONE, "derivatives": 2, "limits": U, "suffix": "_ref"} | given
    with pytest.raises(kind, match=re.escape(message)):
        cp.create_time_scaling_iosystem(**options)


SHAPED = cp.Shaper.zv(6.0)(ONE)


@pytest.mark.parametrize(
    "plan",
    [
        SHAPED,
        0.5 * SHAPED,
        SHAPED.shift(3.0),
        cp.stack([cp.Step(1.0), SHAPED], labels=["a", "y"]),
        rest((-1.0, 0.0), (0.0, 0.0)).then(SHAPED),
    ],
)
def test_a_shaped_plan_is_rejected_wherever_it_stands(plan):
    """Slowing down stretches the delays between the impulses, which depend on the period of the mode."""
    with pytest.raises(
        ValueError, match=r"plan must not be shaped, got a shaped plan of .* give the plan before it is shaped"
    ):
        cp.create_time_scaling_iosystem(plan, limits=U, suffix="_ref")
