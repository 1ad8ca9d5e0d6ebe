"""Inputs of a block inside a solver are exact, not rounded."""

import control as ct
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import quad

import ctrlplan as cp

T = np.linspace(0, 10, 101)
PLAN = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(10, 1, 0, 0)], alpha=1.0)
METHODS = ["compiled", "python"]


def gate(value):
    """Lag that moves only while its first input is exactly what it should be."""
    return ct.nlsys(
        lambda t, x, u, params: [(u[1] - x[0]) * (u[0] == value)],
        inputs=["enable", "r"],
        outputs="y",
        states="y",
        name="gate",
    )


def lag_response(plan, t):
    """Response of 1/(s + 1) to a plan by quadrature of its convolution."""
    return [quad(lambda s, end=end: float(plan(s)) * np.exp(s - end), 0, end, epsabs=1e-13)[0] for end in t]


def recorder(count):
    """Block without effect that records its inputs."""
    seen = []

    def rates(t, x, u, params):
        seen.append([t, *u])
        return [np.sum(u) - x[0]]

    return ct.nlsys(rates, None, inputs=count, outputs="y", states="y", name="recorder"), seen


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [1.0, 0.1, -7.3e-9, 3.0, 1e300])
def test_a_constant_next_to_a_signal_that_moves_is_exact(value, method):
    found = cp.simulate(gate(value), T, {"enable": value, "r": PLAN}, method=method)
    assert np.abs(found.outputs - lag_response(PLAN, T)).max() < 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_a_constant_out_of_a_plan_or_a_delay_is_exact(method):
    """A planned signal that rests between moves, a source block, and a delay in front of the gate."""
    dwell = cp.PolySpline([cp.Waypoint(-2, 0.1), cp.Waypoint(-1, 0.3)]).then(cp.Step(0.3, 0.3, 0.0))
    t = np.linspace(1, 6, 51)
    late = PLAN.shift(1.0)
    found = cp.simulate(gate(0.3), t, {"enable": dwell, "r": late}, method=method)
    assert np.abs(found.outputs - lag_response(PLAN, t - 1.0)).max() < 1e-7
    source = cp.create_source_iosystem(cp.stack([cp.Step(0.3, 0.3), late], labels=["enable", "r"]))
    loop = ct.interconnect([source, gate(0.3)], inputs=0, outputs="y", warn_duplicate=False)
    found = cp.simulate(loop, t, method=method)
    assert np.abs(found.outputs[0] - lag_response(PLAN, t - 1.0)).max() < 1e-7
    delay = cp.create_delay_iosystem(0.5, inputs=["v", "r_now"], outputs=["enable", "r"], initial=[0.3, 0.0])
    loop = ct.interconnect([delay, gate(0.3)], inputs=["v", "r_now"], outputs="y")
    found = cp.simulate(loop, t, {"v": 0.3, "r_now": late}, method=method)
    assert np.abs(found.outputs - lag_response(PLAN, np.maximum(t - 1.5, 0.0))).max() < 1e-7


@examples(25)
@given(st.lists(st.floats(-1e3, 1e3, allow_subnormal=False), min_size=3, max_size=12), st.floats(-1e6, 1e6))
def test_samples_stay_within_their_range_and_constants_are_bits(samples, constant):
    t = np.linspace(0.0, 1.0, len(samples))
    block, seen = recorder(3)
    found = cp.simulate(block, t, {"u[0]": samples, "u[1]": constant, "u[2]": PLAN}, method="python", rtol=1e-4)
    reached = np.array(seen)[1:]
    assert reached[:, 1].min() >= min(samples)
    assert reached[:, 1].max() <= max(samples)
    assert set(reached[:, 2]) == {constant}
    assert reached[:, 3].min() >= 0.0
    # The lines between the samples, to rounding of the (at most 64) terms that are summed.
    expected = np.interp(reached[:, 0], t, samples)
    assert np.abs(reached[:, 1] - expected).max() <= 64 * np.finfo(float).eps * np.abs(samples).max()
    assert np.array_equal(np.asarray(found.inputs)[0], samples)


@pytest.mark.parametrize("plan", [PLAN, cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(10, 1, 0, 0)])])
@pytest.mark.parametrize("method", METHODS)
def test_a_plan_stays_within_its_range_where_a_block_is_undefined_beyond(plan, method):
    """Square roots of the plan, of what is left of it, and of its velocity, which all begin or end at 0."""

    def rates(t, x, u, params):
        return [np.sqrt(u[0]), np.sqrt(1.0 - u[0]), np.sqrt(u[1])]

    block = ct.nlsys(rates, None, inputs=["r", "r_d1"], outputs=3, states=3, name="roots")
    loop = ct.interconnect(
        [cp.create_source_iosystem(cp.stack([plan], labels=["r"]), 1), block], inputs=0, outputs=block.output_labels
    )
    found = cp.simulate(loop, [0.0, 5.0, 10.0], method=method)
    functions = (lambda t: plan(t), lambda t: 1.0 - plan(t), lambda t: plan(t, 1))
    expected = [quad(lambda t, f=f: np.sqrt(max(0.0, float(f(t)))), 0, 10, limit=400)[0] for f in functions]
    assert np.abs(found.outputs[:, -1] - expected).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_delayed_signal_stays_within_the_range_of_what_was_delayed(method):
    samples = np.clip(np.sin(7.0 * T), 0.0, 1.0)
    block = ct.nlsys(lambda t, x, u, params: [np.sqrt(u[0] * (1.0 - u[0]))], inputs="v", outputs="y", states="y")
    late = cp.create_delay_iosystem(0.25, inputs="r", outputs="v")
    found = cp.simulate(ct.interconnect([late, block], inputs="r", outputs="y"), T, samples, method=method)
    assert np.isfinite(found.outputs).all()


def test_a_number_of_the_gear_is_an_index():
    """A table look-up by a planned integer, as in the cruise control of python-control."""
    table = [40.0, 25.0, 16.0, 12.0, 10.0]

    def rates(t, x, u, params):
        return [u[1] * table[int(u[0]) - 1] - x[0]]

    block = ct.nlsys(rates, None, inputs=["gear", "r"], outputs="y", states="y", name="vehicle")
    found = cp.simulate(block, T, {"gear": 4.0, "r": PLAN})
    assert np.abs(found.outputs - 12.0 * np.array(lag_response(PLAN, T))).max() < 1e-6
    assert found.method == "python"


@pytest.mark.parametrize("method", METHODS)
def test_a_plan_whose_terms_cancel_is_followed_to_their_rounding(method):
    """A shaped S-curve: where its jerk cancels, what is left is rounding, which no shorter segment makes smaller."""
    curve = cp.SCurve([9.0], velocity=2.3, acceleration=0.9, jerk=1.7, labels=["r"])
    plan = cp.Shaper.zv(0.93, 0.02)(curve)
    block = ct.nlsys(
        lambda t, x, u, params: [u[0] + 0.3 * u[2] + 0.1 * u[3] - x[0]],
        inputs=["r", "r_d1", "r_d2", "r_d3"],
        outputs="y",
        states="y",
        name="lag",
    )
    plain = ct.ss([[-1.0]], [[1.0, 0.0, 0.3, 0.1]], [[1.0]], [[0.0] * 4], inputs=block.input_labels, outputs="y")
    t = np.linspace(0, 15, 151)
    loops = [
        ct.interconnect([cp.create_source_iosystem(plan, 3), system], inputs=0, outputs="y")
        for system in (block, plain)
    ]
    found, exact = cp.simulate(loops[0], t, method=method), cp.simulate(loops[1], t, method="exact")
    assert np.abs(found.outputs - exact.outputs).max() < 1e-7
