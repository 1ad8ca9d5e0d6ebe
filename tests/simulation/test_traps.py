"""Differences between simulations by python-control and by this package for plans, loops and blocks."""

import warnings

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

METHODS = ("exact", "compiled", "python")
NUMERICAL = ("compiled", "python")


def late_pulse(start):
    """There and back within 0.2 s, after a long rest."""
    points = [cp.Waypoint(start, 0, 0, 0), cp.Waypoint(start + 0.1, 1, 0), cp.Waypoint(start + 0.2, 0, 0, 0)]
    return cp.PolySpline(points, labels=["r"])


def from_plan(plan, *blocks, outputs=("y",), derivatives=0):
    source = cp.create_source_iosystem(plan, derivatives)
    return ct.interconnect([source, *blocks], inputs=0, outputs=list(outputs))


# 1. A plan that starts late from rest


def test_a_late_plan_is_skipped_by_the_peer_and_not_here():
    # x' = -x + r: after the pulse x is exp(-t) times the integral of exp(s) r(s), by Gauss quadrature by segments.
    plan = late_pulse(500.0)
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")
    loop = from_plan(plan, lag)
    times = np.array([0.0, 250.0, 500.2, 500.5, 501.0])
    nodes, weights = np.polynomial.legendre.leggauss(30)
    s = 500.0 + 0.1 * (nodes + 1.0)
    integral = 0.1 * weights @ (np.exp(s - 500.2) * np.array([plan(float(t)) for t in s]).ravel())
    exact = np.where(times >= 500.2, integral * np.exp(500.2 - times), 0.0)
    assert exact[2] > 0.05
    peer = ct.input_output_response(loop, times, 0, 0.0).outputs.ravel()
    assert np.abs(peer).max() == 0.0
    for method in METHODS:
        found = cp.simulate(loop, times, method=method)
        assert found.method == method
        assert np.abs(found.outputs.ravel() - exact).max() <= 1e-8


@pytest.mark.parametrize("method", NUMERICAL)
def test_a_late_plan_into_a_bent_block_is_not_skipped(method):
    """The same pulse immediately and after ten minutes at rest ends in the same state."""
    bent = ct.nlsys(lambda t, x, u, p: -np.tanh(x) + 9 * u, None, inputs="r", outputs="y", states=1, name="bent")
    late, soon = from_plan(late_pulse(600.0), bent), from_plan(late_pulse(0.0), bent)
    after = np.array([0.2, 0.5, 1.0])
    found = cp.simulate(late, np.append(0.0, 600.0 + after), method=method).outputs.ravel()[1:]
    early = cp.simulate(soon, np.append(0.0, after), method=method).outputs.ravel()[1:]
    assert early.min() > 0.3
    assert np.abs(found - early).max() <= 1e-7
    peer = ct.input_output_response(late, np.append(0.0, 600.0 + after), 0, 0.0)
    assert np.abs(peer.outputs).max() == 0.0


# 2. Static blocks are first evaluated at zero inputs


def dividing():
    """u = r/|y|: 0/0 where everything is 0; the lag behind it starts at 1 and never comes to 0."""
    divider = ct.nlsys(None, lambda t, x, u, p: u[:1] / u[1:], inputs=["r", "y"], outputs="u", name="divider", dt=None)
    lag = ct.nlsys(lambda t, x, u, p: -x + u, None, inputs="u", outputs="y", states=1, name="lag")
    return ct.interconnect([divider, lag], inputs="r", outputs=["y"])


def test_a_block_that_is_not_finite_at_zero():
    # x' = -x + r/x: x^2 = r + (x0^2 - r) exp(-2 t)
    loop, times = dividing(), np.linspace(0.0, 3.0, 13)
    exact = np.sqrt(2.0 - np.exp(-2.0 * times))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        with pytest.raises(RuntimeError, match="algebraic loop detected"):
            ct.input_output_response(loop, times, 2.0 * np.ones(times.size), 1.0)
    for method in ("auto", *NUMERICAL):
        assert np.abs(cp.simulate(loop, times, 2.0, 1.0, method=method).outputs - exact).max() <= 1e-7


# 3. Blocks that share a parameter's name


def sharing():
    def gain(name, source, sink, k):
        return ct.nlsys(
            None, lambda t, x, u, p: p["k"] * u, inputs=source, outputs=sink, params={"k": k}, name=name, dt=None
        )

    lag = ct.nlsys(lambda t, x, u, p: -x + u, None, inputs="b", outputs="y", states=1, name="lag")
    return ct.interconnect([gain("first", "r", "a", 2.0), gain("second", "a", "b", 5.0), lag], inputs="r", outputs="y")


@pytest.mark.parametrize("method", NUMERICAL)
def test_blocks_that_share_a_name_of_a_parameter(method):
    # Each its own: 10 in all. python-control takes the last for both: 25.
    times = np.linspace(0.0, 3.0, 13)
    peer = ct.input_output_response(
        sharing(), times, np.ones(times.size), 0.0, solve_ivp_kwargs={"rtol": 1e-10, "atol": 1e-12}
    )
    assert np.abs(peer.outputs + 25.0 * np.expm1(-times)).max() <= 1e-7
    with pytest.warns(UserWarning, match=r"first and second both have a parameter 'k', 2\.0 and 5\.0.*gives both 5\.0"):
        found = cp.simulate(sharing(), times, 1.0, method=method)
    assert np.abs(found.outputs + 25.0 * np.expm1(-times)).max() <= 1e-6
    with pytest.warns(UserWarning, match="use different keys"):
        given = cp.simulate(sharing(), times, 1.0, method=method, params={"k": 3.0})
    assert np.abs(given.outputs + 9.0 * np.expm1(-times)).max() <= 1e-6


def test_blocks_that_agree_on_a_parameter_need_no_warning():
    def lag(name, source, sink):
        return ct.nlsys(
            lambda t, x, u, p: p["w"] * (u - x),
            None,
            inputs=source,
            outputs=sink,
            states=1,
            params={"w": 2.0},
            name=name,
        )

    loop = ct.interconnect([lag("one", "r", "a"), lag("two", "a", "y")], inputs="r", outputs="y")
    times = np.linspace(0.0, 3.0, 13)
    found = cp.simulate(loop, times, 1.0)
    assert np.abs(found.outputs - (1 - (1 + 2 * times) * np.exp(-2 * times))).max() <= 1e-7


# 4. Inputs are samples to python-control


def test_samples_lose_digits_that_plans_keep():
    """x' = r'' on 301 samples, as a trolley has it: linear interpolation has an error of 1e-4, the plan itself none."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(15, 20, 0, 0)], labels=["r"])
    names = ["r", "r_d1", "r_d2"]
    second = ct.ss([[0, 1], [0, 0]], [[0] * 3, [0, 0, 1]], [[1, 0]], 0, inputs=names, outputs="y", name="trolley")
    times = np.linspace(0.0, 15.0, 301)
    peer = ct.forced_response(second, times, cp.source_samples(plan, times, 2)).outputs.ravel()
    assert 1e-5 < np.abs(peer - plan(times)).max() < 1e-2
    loop = from_plan(plan, second, derivatives=2)
    for method, allowed in (("exact", 1e-11), ("compiled", 1e-6), ("python", 1e-6)):
        found = cp.simulate(loop, times, method=method)
        assert np.abs(found.outputs.ravel() - plan(times)).max() <= allowed


def test_a_callable_input_is_rejected_with_a_reason():
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0)
    with pytest.raises(TypeError):
        ct.input_output_response(lag, [0.0, 1.0], np.sin)
    with pytest.raises((TypeError, ValueError), match="input"):
        cp.simulate(lag, [0.0, 1.0], np.sin)


# 5. Sources without inputs, static blocks of any time base, samples in a continuous loop


def test_a_source_without_inputs_runs_alone_and_inside():
    plan = late_pulse(1.0)
    behind = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="behind")
    unknown = ct.nlsys(None, lambda t, x, u, p: plan(t), inputs=None, outputs="r", name="unknown", dt=None)
    with pytest.raises(TypeError, match="must define number of inputs"):
        ct.interconnect([unknown, behind], inputs=0, outputs="y")
    source = cp.create_source_iosystem(plan)
    assert (source.ninputs, source.dt) == (0, None)
    times = np.linspace(0.0, 2.0, 21)
    alone = cp.simulate(source, times)
    wire = ct.nlsys(None, lambda t, x, u, p: u, inputs="r", outputs="y", name="wire", dt=None)
    inside = cp.simulate(ct.interconnect([source, wire], inputs=0, outputs="y"), times)
    assert np.abs(alone.outputs.ravel() - plan(times)).max() <= 1e-14
    assert np.abs(inside.outputs.ravel() - plan(times)).max() <= 1e-14


def test_a_static_block_defaults_to_continuous_time():
    silent = ct.nlsys(None, lambda t, x, u, p: u, inputs="y", outputs="z", name="silent")
    assert silent.dt == 0
    held = ct.ss(0.5, 1.0, 1.0, 0.0, 0.1, inputs="r", outputs="y", name="held")
    with pytest.raises(ValueError, match="incompatible timebases"):
        ct.interconnect([held, silent], inputs="r", outputs="z")
    for dt in (None, 0.1):
        free = ct.nlsys(None, lambda t, x, u, p: 2 * u, inputs="y", outputs="z", name="free", dt=dt)
        loop = ct.interconnect([held, free], inputs="r", outputs="z")
        found = cp.simulate(loop, 0.1 * np.arange(6), 1.0)
        assert np.abs(found.outputs - 4 * (1 - 0.5 ** np.arange(6))).max() <= 1e-14


def test_discrete_with_continuous_is_rejected_by_the_peer_and_run_here():
    """x' = u, u = -x held for 0.5 s: x halves at every sample, straight in between."""
    plant = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="plant")
    law = ct.ss([], [], [], [[-1.0]], 0.5, inputs="y", outputs="u", name="law")
    with pytest.raises(ValueError, match="incompatible timebases"):
        ct.interconnect([plant, law], inputs=0, outputs="y")
    loop = ct.interconnect([plant, cp.sample_hold(law, 0.5)], inputs=0, outputs="y")
    times = np.linspace(0.0, 4.0, 33)
    found = cp.simulate(loop, times, None, [1.0, 0.0])
    exact = np.interp(times, 0.5 * np.arange(9), 0.5 ** np.arange(9.0))
    assert np.abs(found.outputs.ravel() - exact).max() <= 1e-8


# 6. Loops without inputs


def test_a_loop_without_inputs_has_plain_outputs_and_plots():
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    lag = ct.nlsys(lambda t, x, u, p: -x + u, None, inputs="r", outputs="y", states=1, name="lag")
    loop = from_plan(late_pulse(1.0), lag)
    times = np.linspace(0.0, 2.0, 21)
    peer = ct.input_output_response(loop, times, 0, 0.0)
    found = cp.simulate(loop, times)
    assert peer.outputs.shape == found.outputs.shape == (1, times.size)
    assert peer.inputs.shape == found.inputs.shape == (0, times.size)
    with pytest.raises(ValueError, match="no inputs"):
        peer.plot()
    with pytest.raises(ct.ControlDimension):
        ct.linearize(loop, [0.0], [])
    drawn = found.plot()
    assert np.size(drawn.lines) >= 1
    plt.close("all")


# 9. Outputs of the same name


def test_outputs_of_the_same_name_are_summed_as_by_the_peer():
    one = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="one")
    two = ct.ss(-2.0, 2.0, 1.0, 0.0, inputs="r", outputs="y", name="two")
    bent = ct.nlsys(None, lambda t, x, u, p: u**2, inputs="y", outputs="z", name="bent", dt=0)
    loop = ct.interconnect([one, two, bent], inputs="r", outputs=["y", "z"])
    times = np.linspace(0.0, 3.0, 13)
    total = -np.expm1(-times) - np.expm1(-2 * times)
    peer = ct.input_output_response(
        loop, times, np.ones(times.size), 0.0, solve_ivp_kwargs={"rtol": 1e-10, "atol": 1e-12}
    )
    assert np.abs(peer.outputs - [total, total**2]).max() <= 1e-7
    for method in NUMERICAL:
        found = cp.simulate(loop, times, 1.0, method=method, rtol=1e-10, atol=1e-12)
        assert np.abs(found.outputs - [total, total**2]).max() <= 1e-7
    linear = ct.interconnect([one, two], inputs="r", outputs=["y"])
    assert np.abs(cp.simulate(linear, times, 1.0, method="exact").outputs - total).max() <= 1e-12


def test_unused_outputs_of_a_source_warn_in_the_peer_alone():
    plan = late_pulse(1.0)
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")
    blocks = [cp.create_source_iosystem(plan, 2), lag]
    with pytest.warns(UserWarning, match="Unused output"):
        loop = ct.interconnect(blocks, inputs=0, outputs="y")
    quiet = ct.interconnect(blocks, inputs=0, outputs="y", ignore_outputs=["plan.r_d1", "plan.r_d2"])
    times = np.linspace(0.0, 2.0, 21)
    for method in METHODS:
        assert np.array_equal(
            cp.simulate(loop, times, method=method).outputs, cp.simulate(quiet, times, method=method).outputs
        )
