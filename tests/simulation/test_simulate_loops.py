"""Interconnections, nested and with plans inside, against matrices derived by hand."""

import control as ct
import numpy as np
import pytest
from simulation_oracle import both, constant, gap, lag_loop, response, step

import ctrlplan as cp

T = np.unique(np.concatenate([np.random.default_rng(0).uniform(0, 6, 60), [0.0, 0.5, 2.0, 3.0, 6.0]]))
MOVE = ([0.5, 1.2, 2.0], [[[0.0, 0.0, 0.0], [0.8, 1.0], [1.0, 0.0, 0.0]]])
OTHER = ([1.0, 3.3], [[[0.0, 0.0], [-2.0, 1.0]]])
KP, KD = 4.0, 1.5


def named(plan, *labels):
    return cp.stack([plan], labels=list(labels))


def follower(plan):
    """u = r'' + KD (r' - v) + KP (r - p) with the plan nested one level deep; the plant is p'' = u + d."""
    source = cp.create_source_iosystem(named(plan, "r"), derivatives=2)
    law = ct.ss(
        [], [], [], [[KP, KD, 1.0, -KP, -KD]], inputs=["r", "r_d1", "r_d2", "p", "v"], outputs=["u"], name="law"
    )
    inner = ct.interconnect([source, law], inputs=["p", "v"], outputs=["u"], name="controller")
    plant = ct.ss(
        [[0, 1], [0, 0]], [[0], [1]], np.eye(2), np.zeros((2, 1)), inputs=["f"], outputs=["p", "v"], name="plant"
    )
    adder = ct.summing_junction(inputs=["u", "d"], output="f", name="adder")
    return ct.interconnect([inner, adder, plant], inputs=["d"], outputs=["p", "v", "u"], name="whole")


def test_a_flat_feedforward_follows_the_plan_exactly():
    plan, _ = both(*MOVE, 1.0)
    found = cp.simulate(follower(plan), T, method="exact")
    assert np.abs(found.outputs[:2] - plan.jet(T, 1)[:, 0]).max() <= 1e-12
    assert np.abs(found.outputs[2] - plan(T, 2)).max() <= 1e-11


@pytest.mark.parametrize("alpha", [0.0, 1e-9, 1.0, 5.0])
def test_a_plan_with_derivatives_inside_a_nested_loop(alpha):
    plan, (r,) = both(*MOVE, alpha)
    other, (d,) = both(*OTHER, alpha)
    r1 = r.derivative()
    found = cp.simulate(follower(plan), T, other, [0.3, -1.0], method="exact")
    a, b = [[0.0, 1.0], [-KP, -KD]], [[0.0] * 4, [1.0, KP, KD, 1.0]]
    c, e = [[1.0, 0.0], [0.0, 1.0], [-KP, -KD]], [[0.0] * 4, [0.0] * 4, [0.0, KP, KD, 1.0]]
    outputs, states = response(a, b, c, e, [d, r, r1, r1.derivative()], T, [0.3, -1.0])
    assert gap(found.outputs, outputs) <= 1e-11
    assert gap(found.states, states) <= 1e-11
    assert np.abs(found.inputs - other(T)).max() <= 1e-14


def test_a_plan_whose_derivatives_jump_inside_the_loop():
    # The acceleration jumps at 0.5, 2 and 3 s, and samples fall there: a jump belongs to what follows, but at the end.
    plan, (r,) = both([0.5, 2.0, 3.0], [[[0.0, 0.0], [1.0, -0.4], [0.3, 0.0]]], 1.0, each_segment=True)
    r1 = r.derivative()
    found = cp.simulate(follower(plan), T, None, [0.3, -1.0], method="exact")
    a, b = [[0.0, 1.0], [-KP, -KD]], [[0.0] * 3, [KP, KD, 1.0]]
    c, e = [[1.0, 0.0], [0.0, 1.0], [-KP, -KD]], [[0.0] * 3, [0.0] * 3, [KP, KD, 1.0]]
    outputs, _ = response(a, b, c, e, [r, r1, r1.derivative()], T, [0.3, -1.0])
    assert gap(found.outputs, outputs) <= 1e-11


def test_the_command_that_makes_the_lag_loop_exact():
    # k/(s^2 + s) in unity feedback follows r without error when commanded r + (r'' + r')/k.
    k = 3.0
    plan = named(both(*MOVE, 1.0)[0], "x")
    source = cp.create_source_iosystem(plan, derivatives=2)
    command = ct.ss([], [], [], [[1.0, 1 / k, 1 / k]], inputs=["x", "x_d1", "x_d2"], outputs=["r"], name="command")
    planned_loop = ct.interconnect([source, command, cp.plants.integrator_lag_loop(k)], inputs=0, outputs=["y"])
    found = cp.simulate(planned_loop, T, method="exact")
    assert np.abs(found.outputs - plan(T)).max() <= 1e-12


def test_a_source_inside_is_as_good_as_an_input():
    plan, signals = both(*MOVE, 1.0)
    loop = cp.plants.integrator_lag_loop(5.0, ["y", "u", "e"])
    planned_loop = ct.interconnect(
        [cp.create_source_iosystem(named(plan, "r")), loop], inputs=0, outputs=["y", "u", "e"]
    )
    found = cp.simulate(planned_loop, T, initial_state=[0.1, -0.4], method="exact")
    assert found.method == "exact"
    assert gap(found.outputs, response(*lag_loop(5.0), signals, T, [0.1, -0.4])[0]) <= 1e-11


@pytest.mark.slow
def test_several_sources_and_inputs():
    """x' = A x + B (d1, d2) + E (p, p', q): the order of blocks, of axes and of derivatives all matter."""
    p, (ps,) = both(*MOVE, 1.0)
    q, (qs,) = both(*OTHER, 0.0)
    a = np.array([[-1.0, 2.0, 0.0], [-2.0, -0.5, 0.3], [0.0, 1.0, -3.0]])
    b = np.array([[1.0, 0.0], [0.5, -1.0], [0.0, 2.0]])
    e = np.array([[0.0, 1.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.7], [0.0, -1.0, 3.0, 0.0]])
    first = cp.create_source_iosystem(named(p, "p"), derivatives=1, name="first")
    second = cp.create_source_iosystem(cp.stack([q, cp.Step(1.0, time=2.5)], ["q", "s"]), name="second")
    c = [[1, 0, 0], [0, 0, 1]]
    plant = ct.ss(a, np.hstack([b, e]), c, 0, inputs=["d1", "d2", "p", "p_d1", "q", "s"], outputs=["x", "z"])
    whole = ct.interconnect([second, plant, first], inputs=["d2", "d1"], outputs=["z", "x"])
    found = cp.simulate(whole, T, {"d1": q, "d2": 0.1}, [1.0, 0.0, -1.0], method="exact")
    signals = [qs, constant(0.1), ps, ps.derivative(), qs, step(1.0, 0.0, 2.5)]
    outputs, states = response(a, np.hstack([b, e]), c, np.zeros((2, 6)), signals, T, [1.0, 0.0, -1.0])
    assert gap(found.outputs, outputs[::-1]) <= 1e-11
    assert gap(found.states, states) <= 1e-11
    assert found.input_labels == ["d2", "d1"]
    assert np.abs(found.inputs - [np.full(T.size, 0.1), q(T)]).max() <= 1e-14


def test_several_axes_with_derivatives_each():
    """Into the states and straight through to the outputs, a weight of its own for each of x, x', x'', z, z', z''."""
    x, (xs,) = both(*MOVE, 1.0)
    z, (zs,) = both(*OTHER, 0.0)
    source = cp.create_source_iosystem(cp.stack([x, z], labels=["x", "z"]), derivatives=2)
    b = [[1.0, -2.0, 0.3, 0.5, 1.5, -0.7], [0.2, 0.4, -0.6, 3.0, -1.0, 2.0]]
    c, d = [[1.0, 0.0], [1.0, -1.0]], [[0.0, 1.0, 2.0, -3.0, 0.5, 0.25], [5.0, 0.0, -1.0, 0.0, 1.0, 1.5]]
    plant = ct.ss([[-1.0, 0.5], [0.0, -3.0]], b, c, d, inputs=source.output_labels, outputs=["p", "q"], name="plant")
    planned_loop = ct.interconnect([plant, source], inputs=0, outputs=["p", "q"])
    signals = [xs, xs.derivative(), xs.derivative().derivative(), zs, zs.derivative(), zs.derivative().derivative()]
    outputs, states = response([[-1.0, 0.5], [0.0, -3.0]], b, c, d, signals, T, [0.5, -0.5])
    for method, allowed in (("exact", 1e-11), ("python", 1e-6)):
        found = cp.simulate(planned_loop, T, None, [0.5, -0.5], method=method)
        assert gap(found.outputs, outputs) <= allowed
        assert gap(found.states, states) <= allowed
    alone = cp.simulate(source, T).outputs
    assert gap(alone, [s(T) for s in signals]) <= 1e-12


def test_gains_and_sums_in_the_connections():
    """Each wire with a gain of its own, two of them into one input, an inner input read as an output."""
    plan, (r,) = both(*MOVE, 1.0)
    slow = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="slow")
    fast = ct.ss(-5.0, 5.0, 1.0, 0.5, inputs="u", outputs="y", name="fast")
    source = cp.create_source_iosystem(named(plan, "r"), name="plan")
    whole = ct.interconnect(
        [slow, fast, source],
        connections=[["slow.u", ("fast", "y", 2.0), ("plan", "r", -0.3)], ["fast.u", "-slow.y"]],
        inplist=[["fast.u"]],
        inputs=["d"],
        outlist=[[("slow", "y", 3.0)], "slow.u"],
        outputs=["three", "into"],
    )
    # fast.u = d - x1, fast.y = x2 + (d - x1)/2, slow.u = 2 fast.y - 0.3 r
    a, b = [[-2.0, 2.0], [-5.0, -5.0]], [[1.0, -0.3], [5.0, 0.0]]
    c, e = [[3.0, 0.0], [-1.0, 2.0]], [[0.0, 0.0], [1.0, -0.3]]
    found = cp.simulate(whole, T, cp.Step(0.5, time=1.7), method="exact")
    outputs, states = response(a, b, c, e, [step(0.5, 0.0, 1.7), r], T)
    assert gap(found.outputs, outputs) <= 1e-11
    assert gap(found.states, states) <= 1e-11


def test_a_controller_with_feedthrough_in_the_loop():
    # C = 8 (s + 1)/(s + 10) = 8 - 72/(s + 10), G = 1/(s (s + 2)), unity feedback.
    plan, signals = both(*MOVE, 1.0)
    lead = ct.ss(-10.0, 1.0, -72.0, 8.0, inputs="e", outputs="u", name="lead")
    plant = ct.ss([[-2, 0], [1, 0]], [[1], [0]], [[0, 1]], 0, inputs="u", outputs="y", name="plant")
    error = ct.summing_junction(inputs=["r", "-y"], output="e", name="error")
    loop = ct.interconnect([plant, lead, error], inputs="r", outputs=["y", "u"])
    a, b = [[-2.0, -8.0, -72.0], [1.0, 0.0, 0.0], [0.0, -1.0, -10.0]], [[8.0], [0.0], [1.0]]
    found = cp.simulate(loop, T, plan, [0.2, 0.1, -0.3], method="exact")
    outputs, states = response(a, b, [[0, 1, 0], [0, -8, -72]], [[0], [8]], signals, T, [0.2, 0.1, -0.3])
    assert gap(found.outputs, outputs) <= 1e-11
    assert gap(found.states, states) <= 1e-11


@pytest.mark.parametrize("gain", [1.0, 20.0])
def test_a_loop_around_a_plant_with_feedthrough(gain):
    # P = 2 + 1/(s + 1): u = gain (r - y) = gain (r - x)/(1 + 2 gain) at the state x of 1/(s + 1).
    plan, signals = both(*MOVE, 1.0)
    loop = cp.plants.unity_feedback_loop([2.0, 3.0], [1.0, 1.0], gain, outputs=("y", "u", "e"))
    through = gain / (1 + 2 * gain)
    a, c = [[-1 - through]], [[1 - 2 * through], [-through], [-through / gain]]
    found = cp.simulate(loop, T, plan, method="exact")
    outputs, _ = response(a, [[through]], c, [[2 * through], [through], [through / gain]], signals, T)
    assert gap(found.outputs, outputs) <= 1e-11


def algebraic(plan, through, outputs=("y", "u")):
    """Unity feedback around y = x + through u, x' = -x + 2 u, with a plan inside."""
    source = cp.create_source_iosystem(named(plan, "r"))
    error = ct.summing_junction(inputs=["r", "-y"], output="u", name="error")
    plant = ct.ss(-1.0, 2.0, 1.0, through, inputs="u", outputs="y", name="plant")
    return ct.interconnect([source, error, plant], inputs=0, outputs=list(outputs))


def test_an_algebraic_loop_with_a_solution_is_solved():
    # u = r - x - u, so u = (r - x)/2: x' = -2 x + r and y = (x + r)/2.
    plan, signals = both(*MOVE, 1.0)
    found = cp.simulate(algebraic(plan, 1.0), T, initial_state=[0.4], method="exact")
    outputs, states = response([[-2.0]], [[1.0]], [[0.5], [-0.5]], [[0.5], [0.5]], signals, T, [0.4])
    assert gap(found.outputs, outputs) <= 1e-11
    assert gap(found.states, states) <= 1e-11


@pytest.mark.parametrize("method", ["auto", "exact"])
def test_an_algebraic_loop_without_a_solution_is_rejected(method):
    # y = x - u and u = r - y leave u undetermined.
    loop = algebraic(both(*MOVE, 1.0)[0], -1.0)
    with pytest.raises(ValueError, match="algebraic loop"):
        cp.simulate(loop, T, method=method)


def test_an_algebraic_loop_is_found_at_any_depth():
    inner = algebraic(both(*MOVE, 1.0)[0], -1.0, ["y"])
    behind = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="y", outputs="z", name="behind")
    with pytest.raises(ValueError, match=r"algebraic loop.*error, plant"):
        cp.simulate(ct.interconnect([inner, behind], inputs=0, outputs=["z"]), T)


@pytest.mark.parametrize("gains", [(1e6,), (1e4, 1e4, 1e4), (1e-4, 1e-4, 1e-4, 1e12), (1e8,)])
def test_large_gains_in_a_row_are_no_algebraic_loop(gains):
    """The plant has no feedthrough, so there is no loop without delay, whatever the scale of the signals."""
    plan, signals = both(*MOVE, 1.0)
    source = cp.create_source_iosystem(named(plan, "r"))
    error = ct.summing_junction(inputs=["r", "-y"], output="s0", name="error")
    chain = [
        ct.ss([], [], [], [[g]], inputs=f"s{i}", outputs=f"s{i + 1}", name=f"gain{i}") for i, g in enumerate(gains)
    ]
    total = float(np.prod(gains))
    plant = ct.ss(-1.0, 1.0 / total, 5.0, 0.0, inputs=f"s{len(gains)}", outputs="y", name="plant")
    planned_loop = ct.interconnect([source, error, *chain, plant], inputs=0, outputs=["y"])
    found = cp.simulate(planned_loop, T, method="exact")
    assert gap(found.outputs, response([[-6.0]], [[1.0]], [[5.0]], [[0.0]], signals, T)[0]) <= 1e-11


@pytest.mark.slow
def test_three_floors():
    """A loop in a loop in a loop, each with a plan of its own."""
    plan, (r,) = both(*MOVE, 1.0)
    floors, signals = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u0", outputs="y0", name="plant"), []
    for i in range(3):
        source = cp.create_source_iosystem(named((i + 1.0) * plan.shift(0.5 * i), "r"), name=f"plan{i}")
        error = ct.summing_junction(inputs=[f"u{i + 1}", f"-y{i}", "r"], output=f"u{i}", name=f"error{i}")
        inner = [floors, source, error]
        floors = ct.interconnect(inner, inputs=[f"u{i + 1}"], outputs=[f"y{i}"], name=f"floor{i}")
        floors = ct.interconnect(
            [floors, ct.ss([], [], [], [[1.0]], inputs=f"y{i}", outputs=f"y{i + 1}", name=f"wire{i}")],
            inputs=[f"u{i + 1}"],
            outputs=[f"y{i + 1}"],
            name=f"wired{i}",
        )
        signals.append((i + 1.0) * r.shift(0.5 * i))
    found = cp.simulate(floors, T, 0.25, 1.5, method="exact")
    outputs, _ = response([[-4.0]], [[1.0] * 4], [[1.0]], [[0.0] * 4], [constant(0.25), *signals], T, [1.5])
    assert gap(found.outputs, outputs) <= 1e-11


def test_a_source_alone():
    plan, (r,) = both(*MOVE, 1.0)
    found = cp.simulate(cp.create_source_iosystem(named(plan, "r"), derivatives=2), T)
    r1 = r.derivative()
    assert found.method == "exact"
    assert gap(found.outputs, [r(T), r1(T), r1.derivative()(T)]) <= 1e-12


def test_static_blocks_alone():
    plan, (r,) = both(*MOVE, 1.0)
    found = cp.simulate(ct.ss([], [], [], [[2.0], [-3.0]]), T, plan, method="exact")
    assert gap(found.outputs, [2 * r(T), -3 * r(T)]) <= 1e-13


@pytest.mark.parametrize("method", ["auto", "exact", "python"])
def test_a_transfer_function_is_a_system_too(method):
    plan, signals = both(*MOVE, 1.0)
    found = cp.simulate(ct.tf([2.0, 3.0], [1.0, 2.0]), T, plan, method=method, rtol=1e-10, atol=1e-12)
    # 2 - 1/(s + 2)
    outputs, _ = response([[-2.0]], [[1.0]], [[-1.0]], [[2.0]], signals, T)
    assert gap(found.outputs, outputs) <= (1e-8 if method == "python" else 1e-11)
