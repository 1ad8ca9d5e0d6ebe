"""Algebraic loops: closed solutions, Newton's iteration, and loops without a solution."""

import math

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import ctrlplan as cp

METHODS = ("exact", "compiled", "python")
NUMERICAL = ("compiled", "python")
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
T = np.linspace(0.0, 4.0, 17)
UNIT = cp.Step(1.0, initial=1.0)


def source(height=1.0):
    return cp.create_source_iosystem(cp.stack([cp.Step(height, initial=height)], labels=["r"]))


def gain(rows, inputs, outputs, name):
    return ct.ss([], [], [], np.atleast_2d(rows), inputs=inputs, outputs=outputs, name=name, dt=None)


def static(function, inputs, outputs, name, **params):
    return ct.nlsys(None, function, inputs=inputs, outputs=outputs, name=name, dt=None, params=params)


def behind(name="behind"):
    """A nonlinear block outside any loop: its output is the cube of y."""
    return static(lambda t, x, u, p: u**3, "y", "cubed", name)


def around(through, *more, outputs=("y", "u")):
    """Unity feedback of 1 around x' = -x + 2 u, y = x + through u."""
    error = gain([1.0, -1.0], ["r", "y"], "u", "error")
    plant = ct.ss(-1.0, 2.0, 1.0, through, inputs="u", outputs="y", name="plant")
    ends = [label for block in more for label in block.output_labels]
    return ct.interconnect([source(), error, plant, *more], inputs=0, outputs=[*outputs, *ends])


def around_exactly(through, x0):
    """u = (1 - x)/(1 + d), so x' = -(1 + 2/(1 + d)) x + 2/(1 + d)."""
    rate, rest = 1 + 2 / (1 + through), 2 / (3 + through)
    x = rest + (x0 - rest) * np.exp(-rate * T)
    u = (1 - x) / (1 + through)
    return x + through * u, u


# Linear loops


@pytest.mark.parametrize("through", [0.5, -0.6, 1.0, 7.0, 1e6])
@pytest.mark.parametrize("method", METHODS)
def test_a_linear_loop(through, method):
    """1 and beyond are no contraction: iterating signals would not end."""
    loop = around(through)
    with pytest.raises(RuntimeError, match="algebraic loop detected"):
        ct.input_output_response(loop, T, 0, [0.3])
    found = cp.simulate(loop, T, None, [0.3], method=method, **TIGHT)
    assert found.method == method
    for row, exact in zip(found.outputs, around_exactly(through, 0.3), strict=True):
        assert np.abs(row - exact).max() <= 1e-8


@pytest.mark.parametrize("method", NUMERICAL)
@pytest.mark.parametrize("through", [0.5, 7.0])
def test_a_linear_loop_next_to_what_is_not_linear(through, method):
    found = cp.simulate(around(through, behind(), outputs=("y",)), T, None, [0.3], method=method, **TIGHT)
    y = around_exactly(through, 0.3)[0]
    assert found.method == method
    assert np.abs(found.outputs - [y, y**3]).max() <= 1e-7
    assert cp.simulate(around(through, behind()), T, None, [0.3]).method == "compiled"


@pytest.mark.parametrize("method", METHODS)
def test_loops_of_many_signals(method):
    """z = F z + g r over five signals in three blocks, in a ring, and a lag of their sum."""
    rng = np.random.default_rng(5)
    parts = [rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=(2, 3))]
    one = gain(parts[0], ["c0", "c1"], ["a0", "a1"], "one")
    two = gain(parts[1], ["a0", "a1"], ["b0", "b1"], "two")
    three = gain(parts[2], ["b0", "b1", "r"], ["c0", "c1"], "three")
    lag = ct.ss(-1.0, [[1.0, 1.0]], 1.0, 0, inputs=["a0", "a1"], outputs="y", name="lag")
    labels = ["a0", "a1", "b0", "b1", "c0", "c1", "y"]
    loop = ct.interconnect([three, source(), lag, two, one], inputs=0, outputs=labels)
    whole = np.zeros((6, 6))
    whole[0:2, 4:6], whole[2:4, 0:2], whole[4:6, 2:4] = parts[0], parts[1], parts[2][:, :2]
    z = np.linalg.solve(np.eye(6) - whole, [0, 0, 0, 0, *parts[2][:, 2]])
    exact = np.vstack([np.repeat(z[:, None], T.size, axis=1), -(z[0] + z[1]) * np.expm1(-T)])
    found = cp.simulate(loop, T, method=method, **TIGHT)
    assert np.abs(found.outputs - exact).max() <= 1e-8 * np.abs(exact).max()


@pytest.mark.parametrize("method", METHODS)
def test_a_loop_across_the_levels(method):
    """The gain is nested two levels deep, the adder is at the top level, with a direct connection."""
    inside = ct.interconnect([gain(-3.0, "u", "w", "deep")], inputs=["u"], outputs=["w"], name="first")
    floor = ct.interconnect([inside, gain(0.5, "w", "y", "half")], inputs=["u"], outputs=["y", "w"], name="second")
    adder = gain([1.0, 1.0], ["r", "y"], "u", "adder")
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="lag")
    loop = ct.interconnect([source(), floor, adder, lag], inputs=0, outputs=["u", "w", "x"])
    # u = 1 - 1.5 u
    found = cp.simulate(loop, T, method=method, **TIGHT)
    assert np.abs(found.outputs - [0.4 + 0 * T, -1.2 + 0 * T, -0.4 * np.expm1(-T)]).max() <= 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_a_loop_inside_a_loop_with_states(method):
    """u = k (r - x) - u/2 and x' = u: x goes to 1 at the rate k/1.5."""
    law = gain([2.0, -2.0, -0.5], ["r", "x", "u"], "u", "law")
    plant = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="plant")
    loop = ct.interconnect([law, plant, source()], inputs=0, outputs=["x", "u"])
    found = cp.simulate(loop, T, None, 0.25, method=method, **TIGHT)
    x = 1 - 0.75 * np.exp(-T / 0.75)
    assert np.abs(found.outputs - [x, (1 - x) / 0.75]).max() <= 1e-8


@pytest.mark.parametrize("method", NUMERICAL)
def test_two_loops_apart(method):
    one = static(lambda t, x, u, p: u[:1] - 2.0 * u[1:], ["r", "a"], "a", "one")
    two = static(lambda t, x, u, p: u[:1] + 0.5 * u[1:], ["a", "b"], "b", "two")
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="b", outputs="y", name="lag")
    found = cp.simulate(ct.interconnect([two, lag, one, source()], inputs=0, outputs=["a", "b", "y"]), T, method=method)
    assert np.abs(found.outputs - [1 / 3 + 0 * T, 2 / 3 + 0 * T, -2 / 3 * np.expm1(-T)]).max() <= 1e-7


@pytest.mark.parametrize("method", NUMERICAL)
def test_a_loop_whose_gain_is_a_parameter(method):
    """u = r - k u and x' = u: one form for all k, its loop solved again."""
    law = static(lambda t, x, u, p: u[:1] - p["k"] * u[1:], ["r", "u"], "u", "law", k=1.0)
    plant = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="plant")
    ready = cp.prepare(ct.interconnect([law, plant, source()], inputs=0, outputs=["x", "u"]))
    for k in (0.0, 0.5, 3.0, -0.5, 20.0):
        found = cp.simulate(ready, T, method=method, params={"k": k})
        assert found.method == method
        assert np.abs(found.outputs - [T / (1 + k), 1 / (1 + k) + 0 * T]).max() <= 1e-6


@pytest.mark.parametrize("method", ["auto", *NUMERICAL])
def test_a_parameter_at_which_a_loop_is_singular(method):
    law = static(lambda t, x, u, p: u[:1] - p["k"] * u[1:], ["r", "u"], "u", "law", k=1.0)
    plant = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="plant")
    loop = ct.interconnect([law, plant, source()], inputs=0, outputs=["x", "u"])
    assert np.abs(cp.simulate(loop, T, method=method).outputs[0] - T / 2).max() <= 1e-7
    with pytest.raises(RuntimeError, match=r"loop of the blocks law must have a solution"):
        cp.simulate(loop, T, method=method, params={"k": -1.0})


@pytest.mark.parametrize("method", NUMERICAL)
def test_what_only_looks_like_a_loop(method):
    """A static block of two lines, one of which feeds the other through a second block."""
    lines = static(lambda t, x, u, p: np.array([np.sin(u[0]), u[1] ** 2 + u[0]]), ["r", "b"], ["a", "c"], "lines")
    middle = static(lambda t, x, u, p: np.cos(u), "a", "b", "middle")
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="c", outputs="y", name="lag")
    loop = ct.interconnect([lines, middle, lag, source(0.7)], inputs=0, outputs=["c", "y"])
    c = math.cos(math.sin(0.7)) ** 2 + 0.7
    assert np.abs(cp.simulate(loop, T, method=method, **TIGHT).outputs - [c + 0 * T, -c * np.expm1(-T)]).max() <= 1e-8


# Feedthrough that is not there at the start


def gated(rate_of_clock, out):
    """The gate is the first of the blocks; it passes 2 r, from a later block."""
    gate = ct.nlsys(
        lambda t, x, u, p: np.array([rate_of_clock + 0.0 * x[0]]), out, inputs="u", outputs="g", states=1, name="gate"
    )
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="g", outputs="y", name="lag")
    return ct.interconnect([gate, lag, gain(2.0, "r", "u", "double")], inputs="r", outputs=["y", "g"])


@pytest.mark.parametrize("method", NUMERICAL)
def test_feedthrough_that_opens_with_a_state(method):
    """g = max(q - 1, 0) u with q = t and u = 2."""
    loop = gated(1.0, lambda t, x, u, p: np.fmax(x[0] - 1.0, 0.0) * u)
    found = cp.simulate(loop, T, 1.0, method=method, **TIGHT)
    s = np.maximum(T - 1.0, 0.0)
    assert np.abs(found.outputs - [2 * (s + np.expm1(-s)), 2 * s]).max() <= 1e-7


@pytest.mark.parametrize("method", NUMERICAL)
def test_feedthrough_that_opens_with_time(method):
    loop = gated(0.0, lambda t, x, u, p: np.fmax(t - 1.0, 0.0) * u + x)
    found = cp.simulate(loop, T, 1.0, method=method, **TIGHT)
    s = np.maximum(T - 1.0, 0.0)
    assert np.abs(found.outputs - [2 * (s + np.expm1(-s)), 2 * s]).max() <= 1e-7


@pytest.mark.parametrize("method", NUMERICAL)
def test_a_loop_that_closes_later(method):
    """u = r - a(t) u through a static block that is 0 until 1 s, next to a loop that is always closed."""
    idle = static(lambda t, x, u, p: np.fmax(t - 1.0, 0.0) * u, "u", "f", "idle")
    adder = gain([1.0, -1.0], ["r", "f"], "u", "adder")
    always = gain([1.0, -0.5], ["r", "v"], "v", "always")
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="v", outputs="y", name="lag")
    loop = ct.interconnect([idle, adder, always, lag, source()], inputs=0, outputs=["u", "v", "y"])
    found = cp.simulate(loop, T, method=method)
    exact = [1 / (1 + np.maximum(T - 1, 0)), 2 / 3 + 0 * T, -2 / 3 * np.expm1(-T)]
    assert np.abs(found.outputs - exact).max() <= 1e-7


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_loop_that_closes_between_the_samples(method):
    """y = x + u from 5.2 to 5.8 s, y = x else; u = 1 - y."""
    plant = ct.nlsys(
        lambda t, x, u, p: -x + u,
        lambda t, x, u, p: x + (t >= 5.2) * (t < 5.8) * u,
        inputs="u",
        outputs="y",
        states=1,
        name="plant",
    )
    cp.declare(plant, breakpoints=(5.2, 5.8))
    loop = ct.interconnect([plant, gain([1.0, -1.0], ["r", "y"], "u", "adder"), source()], inputs=0, outputs=["y"])
    # x' = 1 - 2 x outside and (1 - 3 x)/2 in between.
    times = np.arange(0.0, 9.0)
    before = 0.5 * -math.expm1(-2 * 5.2)
    behind_it = 1 / 3 + (before - 1 / 3) * math.exp(-1.5 * 0.6)
    x = np.where(times < 5.2, -0.5 * np.expm1(-2 * times), 0.5 + (behind_it - 0.5) * np.exp(-2 * (times - 5.8)))
    found = cp.simulate(loop, times, method=method, **TIGHT)
    assert np.abs(found.outputs.ravel() - x).max() <= 1e-7


# Loops that are not linear


def implicit(function, name="bent"):
    """u = r - f(u) with the plan r, x' = -x + u."""
    points = [cp.Waypoint(0.5, 0.2, 0, 0), cp.Waypoint(2.5, 3.0, 0, 0)]
    plan = cp.create_source_iosystem(cp.PolySpline(points, labels=["r"]))
    blocks = [
        static(lambda t, x, u, p: function(u), "u", "f", name),
        gain([1.0, -1.0], ["r", "f"], "u", "adder"),
        ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="lag"),
    ]
    return ct.interconnect([plan, *blocks], inputs=0, outputs=["y", "u"])


def planned(t):
    s = min(max((t - 0.5) / 2.0, 0.0), 1.0)
    return 0.2 + 2.8 * s**3 * (10 - 15 * s + 6 * s * s)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [
        lambda u: np.tanh(4.0 * u),
        lambda u: u**3,
        lambda u: np.fmin(np.fmax(6.0 * u, -1.0), 1.0),
        lambda u: np.sign(u) * np.sqrt(np.abs(u)),
    ],
    ids=["tanh", "cubic", "limited", "root"],
)
def test_a_loop_that_is_solved_by_iteration(function):
    loop = implicit(function)

    def solved(t):
        return brentq(lambda u: u + float(function(u)) - planned(t), -10, 10, xtol=1e-15, rtol=1e-15)

    exact, state = [], [0.1]
    for left, right in ((0.0, 0.5), (0.5, 2.5), (2.5, 4.0)):
        inside = T[(left <= T) & (right > T)]
        run = solve_ivp(
            lambda t, x: -x + solved(t),
            (left, right),
            state,
            rtol=1e-9,
            atol=1e-11,
            method="LSODA",
            t_eval=np.append(inside, right),
        )
        exact += run.y[0, :-1].tolist()
        state = run.y[:, -1]
    exact.append(state[0])
    for method in ("auto", "python"):
        found = cp.simulate(loop, T, None, 0.1, method=method)
        assert found.method == "python"
        assert np.abs(found.outputs[1] - [solved(t) for t in T]).max() <= 1e-9
        assert np.abs(found.outputs[0] - exact).max() <= 1e-6
    assert "adder" in cp.simulate(loop, T, None, 0.1).reason
    with pytest.raises(ValueError, match=r"algebraic loop of the blocks bent, adder is not linear"):
        cp.simulate(loop, T, None, 0.1, method="compiled")


def test_a_loop_of_two_signals_by_iteration():
    """a = r - tanh(b), b = a + a^3: rest found by nested bisection."""
    one = static(lambda t, x, u, p: u[:1] - np.tanh(u[1:]), ["r", "b"], "a", "one")
    two = static(lambda t, x, u, p: u + u**3, "a", "b", "two")
    found = cp.simulate(ct.interconnect([one, two, source(2.0)], inputs=0, outputs=["a", "b"]), [0.0, 1.0])
    a = brentq(lambda a: a - 2.0 + math.tanh(a + a**3), 0.0, 2.0, xtol=1e-15)
    assert np.abs(found.outputs - [[a, a], [a + a**3] * 2]).max() <= 1e-12


def test_a_loop_that_is_not_linear_with_states_in_it():
    """A lag with nonlinear feedthrough: y = x + 0.5 sin(u), u = 1 - y."""
    bent = ct.nlsys(
        lambda t, x, u, p: -x + u,
        lambda t, x, u, p: x + 0.5 * np.sin(u),
        inputs="u",
        outputs="y",
        states=1,
        name="bent",
    )
    loop = ct.interconnect([bent, gain([1.0, -1.0], ["r", "y"], "u", "adder"), source()], inputs=0, outputs=["y", "u"])

    def solved(x):
        return brentq(lambda u: u - 1 + x + 0.5 * math.sin(u), -5, 5, xtol=1e-15)

    run = solve_ivp(lambda t, x: -x + solved(x[0]), (0, 4), [0.0], "DOP853", rtol=1e-12, atol=1e-12, t_eval=T)
    u = np.array([solved(x) for x in run.y[0]])
    found = cp.simulate(loop, T, **TIGHT)
    assert np.abs(found.outputs - [1 - u, u]).max() <= 1e-8


# No solution


def test_a_singular_linear_loop_that_is_run_exactly():
    """y = x - u and u = r - y: the message names the blocks of the loop only."""
    far = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="y", outputs="z", name="far")
    for method in ("auto", "exact"):
        with pytest.raises(ValueError, match=r"algebraic loop.*error, plant") as caught:
            cp.simulate(around(-1.0, far), T, method=method)
    assert "far" not in str(caught.value)


@pytest.mark.parametrize("method", ["auto", *NUMERICAL])
def test_a_singular_linear_loop_next_to_what_is_not_linear(method):
    with pytest.raises((RuntimeError, ValueError), match=r"algebraic loop.*error, plant") as caught:
        cp.simulate(around(-1.0, behind("far")), T, method=method)
    assert "far" not in str(caught.value)


@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_loop_without_a_solution(method):
    """u = 1 + u^2 has none; another loop, which has one, is not named."""
    square = static(lambda t, x, u, p: 1.0 + u**2, "u", "v", "square")
    wire = gain(1.0, "v", "u", "wire")
    good = gain([1.0, -0.5], ["r", "w"], "w", "good")
    lag = ct.ss(-1.0, [[1.0, 1.0]], 1.0, 0, inputs=["u", "w"], outputs="y", name="lag")
    loop = ct.interconnect([good, square, wire, lag, source()], inputs=0, outputs=["y"])
    with pytest.raises(RuntimeError, match=r"algebraic loop of the blocks square, wire must have a solution.*at 0 s"):
        cp.simulate(loop, T, method=method)


@pytest.mark.parametrize("method", ["auto", "python"])
def test_a_loop_that_loses_its_solution_on_the_way(method):
    """u = r(t) + u^2 has one up to r = 1/4; the time is in the message."""
    ramp = cp.create_source_iosystem(cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(4, 1)], labels=["r"]))
    square = static(lambda t, x, u, p: u[:1] + u[1:] ** 2, ["r", "u"], "u", "square")
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="lag")
    loop = ct.interconnect([ramp, square, lag], inputs=0, outputs=["y", "u"])
    found = cp.simulate(loop, [0.0, 0.5, 0.9], method=method)
    assert np.abs(found.outputs[1] - 0.5 * (1 - np.sqrt(1 - found.time))).max() <= 1e-9
    with pytest.raises(RuntimeError, match=r"blocks square must have a solution.* at 1(\.\d+)? s"):
        cp.simulate(loop, T, method=method)


# Levels with inputs among their outputs


def lower():
    """The cube of an input, and the input itself."""
    return ct.interconnect(
        [behind()],
        inplist=["behind.y"],
        inputs=["a"],
        outlist=["behind.cubed", "behind.y"],
        outputs=["b", "c"],
        name="lower",
    )


@pytest.mark.parametrize("method", NUMERICAL)
def test_an_input_that_is_output(method):
    """u = r - 2 x into x' = -x^3 + u, read at the block's input."""
    bent = ct.nlsys(lambda t, x, u, p: -(x**3) + u, None, inputs="u", outputs="y", states=1, name="bent")
    loop = ct.interconnect(
        [bent, gain(-2.0, "y", "w", "law")],
        connections=[["bent.u", "law.w"], ["law.y", "bent.y"]],
        inplist=["bent.u"],
        inputs="r",
        outlist=["bent.y", "bent.u"],
        outputs=["y", "u"],
    )
    run = solve_ivp(lambda t, x: -(x**3) + 1 - 2 * x, (0, 4), [0.0], "DOP853", rtol=1e-12, atol=1e-12, t_eval=T)
    found = cp.simulate(loop, T, 1.0, method=method, **TIGHT)
    assert np.abs(found.outputs - [run.y[0], 1 - 2 * run.y[0]]).max() <= 1e-8


@pytest.mark.parametrize("method", NUMERICAL)
def test_a_wire_back_to_a_level_that_outputs_its_input(method):
    """a = r + a/2: a is twice r, and the other output its cube."""
    loop = ct.interconnect(
        [lower()],
        connections=[["lower.a", ("lower", "c", 0.5)]],
        inplist=["lower.a"],
        inputs="r",
        outlist=["lower.b", "lower.c"],
        outputs=["z", "w"],
    )
    found = cp.simulate(loop, T, 1.0, method=method)
    assert np.abs(found.outputs - [[8.0], [2.0]]).max() <= 1e-9


@pytest.mark.parametrize("method", ["auto", *NUMERICAL])
def test_a_wire_that_feeds_itself(method):
    """Joined to itself without a gain no number solves it, or any does."""
    loop = ct.interconnect(
        [lower()], connections=[["lower.a", "lower.c"]], inputs=0, outlist=["lower.b"], outputs=["z"], name="joined"
    )
    with pytest.raises((ValueError, RuntimeError), match=r"must not form a loop without a block.*joined|loop"):
        cp.simulate(loop, T, method=method)


@pytest.mark.parametrize("kind", ["saturating", "quadratic"])
@pytest.mark.parametrize("scale", [1e-14, 1e-10, 1e-4, 1.0, 1e6, 1e10, 1e14])
def test_signals_of_any_size(scale, kind):
    """Pressures of 1e10 Pa and charges of 1e-14 C: the same loop in other units has the same solution."""

    def forward(e):
        return np.tanh(e) if kind == "saturating" else e

    def back(y):
        return 0.5 * y + 0.1 * np.sin(y) if kind == "saturating" else 0.7 * y + 0.2 * y * abs(y)

    blocks = [
        ct.nlsys(
            None, lambda t, x, u, p: [scale * forward((u[0] - u[1]) / scale)], inputs=["r", "z"], outputs="y", name="a"
        ),
        ct.nlsys(None, lambda t, x, u, p: [scale * back(u[0] / scale)], inputs="y", outputs="z", name="b"),
    ]
    loop = ct.interconnect(blocks, inputs="r", outputs=["y", "z"])
    times = np.linspace(0.0, 1.0, 5)
    found = cp.simulate(loop, times, scale * np.sin(times))
    y = [brentq(lambda y, r=r: y - forward(r - back(y)), -2.0, 2.0, xtol=1e-15) for r in np.sin(times)]
    # The slope of the residual is at least 1: the error is at most its rounding errors.
    assert np.abs(found.outputs[0] / scale - y).max() <= 1e-12
    assert np.abs(found.outputs[1] / scale - back(np.array(y))).max() <= 2e-12
