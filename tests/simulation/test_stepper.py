"""A stepper against `simulate` with the same piecewise constant inputs, and against exponentials in 40 digits."""

import re
import threading
import warnings

import control as ct
import mpmath
import numpy as np
import pytest

import ctrlplan as cp
from tests.support.stairs import held, stepped

RNG = np.random.default_rng(5)


def stable(n, inputs, outputs, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    a -= (np.linalg.eigvals(a).real.max() + 0.3) * np.eye(n)
    return ct.ss(
        a, rng.standard_normal((n, inputs)), rng.standard_normal((outputs, n)), rng.standard_normal((outputs, inputs))
    )


def against_simulate(system, values, dt, initial_state=None, start=0.0, **options):
    """Largest differences of states and outputs from `simulate`, relative to their ranges."""
    prepared = cp.prepare(system)
    plan = held(values, dt, prepared.input_labels, start) if prepared.ninputs else None
    count = np.atleast_2d(values).shape[1]
    times = np.array([start + k * dt for k in range(count + 1)])
    response = cp.simulate(system, times, plan, initial_state, **options)
    stepper = prepared.start(dt, initial_state, time=start, **options)
    before, after, states = stepped(stepper, values)
    outputs = response.y.reshape(-1, count + 1)
    apart = np.abs(states - response.x).max(axis=1, initial=0.0) / np.maximum(np.ptp(response.x, axis=1), 1e-300)
    span = np.maximum(np.ptp(outputs, axis=1, keepdims=True), 1e-300)
    return (
        max(
            apart.max(initial=0.0),
            np.abs((before - outputs[:, :-1]) / span).max(),
            np.abs((after[:, -1] - outputs[:, -1]) / span[:, 0]).max(),
        ),
        response,
    )


@pytest.mark.parametrize(("n", "inputs", "outputs"), [(1, 1, 1), (3, 2, 1), (10, 2, 3), (24, 1, 2), (0, 2, 2)])
def test_linear_systems_equal_simulate(n, inputs, outputs):
    system = stable(n, inputs, outputs) if n else ct.ss([], [], [], np.ones((outputs, inputs)))
    values = RNG.standard_normal((inputs, 300))
    apart, response = against_simulate(system, values, 0.05, 1.0)
    assert response.method == "exact"
    assert apart <= 1e-12


def test_a_step_is_one_exponential():
    """Fast and slow modes together, against 40 digits: the slow one keeps its digits over 2000 steps."""
    a = np.array([[-1e5, 300.0, 0.0], [0.0, -1e-5, 2.0], [0.0, 0.0, -3.0]])
    b, c, dt, count = np.array([[1.0], [0.5], [1.0]]), np.array([[0.0, 1.0, 1.0]]), 1e-3, 2000
    stepper = cp.prepare(ct.ss(a, b, c, [[0.25]])).start(dt, [1.0, 2.0, 3.0])
    for _ in range(count):
        y = stepper.step(0.7)
    with mpmath.workdps(40):
        whole = mpmath.zeros(4)
        whole[:3, :3], whole[:3, 3] = mpmath.matrix(a.tolist()), mpmath.matrix(b.tolist())
        exact = mpmath.expm(whole * mpmath.mpf(dt) * count) * mpmath.matrix([1.0, 2.0, 3.0, 0.7])
        expected = np.array([float(exact[k]) for k in range(3)])
    assert np.abs(stepper.state - expected).max() <= 1e-12 * np.abs(expected).max()
    assert y == pytest.approx(expected[1] + expected[2] + 0.25 * 0.7, rel=1e-12)


def test_outputs_are_those_before_the_next_inputs_are_applied():
    stepper = cp.prepare(ct.tf([1.0, 2.0], [1.0, 1.0])).start(1.0)  # y = u + x, x' = -x + u
    x = 1.0 - np.exp(-1.0)
    assert stepper.outputs(3.0) == pytest.approx([3.0], abs=1e-15)
    assert stepper.step(1.0) == pytest.approx([1.0 + x], rel=1e-15)
    assert stepper.outputs(-2.0) == pytest.approx([-2.0 + x], rel=1e-14)
    assert (stepper.time, stepper.state) == (1.0, pytest.approx([x], rel=1e-15))


def test_time_does_not_accumulate_rounding():
    stepper = cp.prepare(ct.tf([1], [1, 1])).start(0.1)
    for _ in range(3):
        stepper.step(0.0)
    assert stepper.time == 0.3
    later = cp.prepare(ct.tf([1], [1, 1])).start(0.1, time=0.7)
    later.step(0.0)
    assert later.time == 0.8


@pytest.mark.parametrize("unstable", [False, True])
def test_plans_inside_the_loop_run_with_time(unstable):
    plan = cp.TrigSpline([cp.Waypoint(0.13, 0, 0, 0), cp.Waypoint(1.7, 40, 0, 0)], alpha=1.0, labels=["r"])
    source = cp.create_source_iosystem(plan + cp.Step(1.0, time=0.5, labels=["r"]), 0)
    plant = ct.tf([3.0], [1.0, -4.0 if unstable else 4.0, 0.0], inputs="e", outputs="y", name="plant")
    mix = ct.summing_junction(["r", "u", "-y"] if not unstable else ["r", "u"], "e")
    loop = ct.interconnect([source, plant, mix], inputs=["u"], outputs=["y", "e"])
    apart, response = against_simulate(loop, RNG.standard_normal((1, 200)), 0.01)
    assert response.method == "exact"
    assert apart <= 1e-12


def test_an_unstable_plant_is_held_by_feedback_from_outside():
    """The response to the plan alone grows by 1e43: it is not computed apart from that to the inputs."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(8, 1, 0, 0)], labels=["d"])
    source = cp.create_source_iosystem(plan)
    plant = ct.tf([1.0], [1.0, -10.0], inputs="e", outputs="y", name="plant")
    mix = ct.summing_junction(["d", "u"], "e")
    loop = ct.interconnect([source, plant, mix], inputs=["u"], outputs=["y"])
    stepper, y, dt = cp.prepare(loop).start(0.01), 0.0, 0.01
    for _ in range(1000):
        y = float(stepper.step(-20.0 * y)[0])
    # Steady state of x' = 10 x + 1 - 20 x_k under a hold: x = -1/(10 - 20).
    assert y == pytest.approx(0.1, rel=1e-9)
    assert stepper.time == 1000 * dt


def sampled_loop(period, offset=0.0, second=None):
    controller = ct.ss([[1.0]], [[0.3 * period]], [[1.0]], [[0.8]], period, inputs="e", outputs="v", name="pi")
    blocks = [
        cp.sample_hold(controller, period, offset=offset),
        ct.ss([[0, 1], [-2.0, -0.7]], [[0], [1]], [[1, 0]], 0, inputs="v", outputs="p", name="plant"),
        ct.summing_junction(["r", "-p"], "e", name="error"),
    ]
    if second is not None:
        lag = ct.ss([[0.5]], [[0.5]], [[1.0]], [[0.0]], second, inputs="p", outputs="seen", name="slow")
        blocks.append(cp.sample_hold(lag, second))
    return ct.interconnect(blocks, inputs=["r"], outputs=["p", "v", *(["seen"] if second else [])])


@pytest.mark.parametrize(
    ("dt", "period", "offset", "second"),
    [(0.1, 0.1, 0.0, None), (0.1, 0.03, 0.01, None), (0.02, 0.05, 0.0, None), (0.07, 0.05, 0.02, 0.11)],
)
def test_discrete_blocks_are_sampled_at_their_own_times(dt, period, offset, second):
    loop = sampled_loop(period, offset, second)
    values = RNG.standard_normal((1, 40))
    plan = held(values, dt, ["r"])
    response = cp.simulate(loop, [k * dt for k in range(40)], plan, rtol=1e-12)
    before, after, _ = stepped(cp.prepare(loop).start(dt), values)
    outputs = response.y.reshape(len(before), -1)
    span = np.ptp(outputs, axis=1)
    assert (np.abs(before - outputs).max(axis=1) / span).max() <= 1e-9  # the tolerance of simulate
    # The position is continuous; held outputs change at the next sample, after the step.
    assert after[0, :-1] == pytest.approx(before[0, 1:], abs=1e-14 * span[0])


def test_a_sampled_linear_loop_is_exact():
    """Integrator with a discrete gain: y_(k + 1) = y_k + T (u - y_k) at the samples, straight in between."""
    gain = cp.sample_hold(ct.ss([], [], [], [[1.0]], 0.3, inputs="e", outputs="v", name="gain"), 0.3)
    plant = ct.tf([1], [1, 0], inputs="v", outputs="y", name="plant")
    loop = ct.interconnect([gain, plant, ct.summing_junction(["r", "-y"], "e")], inputs="r", outputs=["y", "v"])
    stepper = cp.prepare(loop).start(0.1)
    y = v = 0.0
    for k in range(60):
        v = 2.0 - y if k % 3 == 0 else v
        assert stepper.outputs(2.0) == pytest.approx([y, v], rel=1e-13)
        y += 0.1 * v
        assert stepper.step(2.0) == pytest.approx([y, v], rel=1e-13)


def pendulum(name="pendulum"):
    def rate(t, x, u, params):
        return [x[1], -params["g"] * np.sin(x[0]) - 0.3 * x[1] + u[0]]

    return ct.nlsys(rate, None, inputs="u", states=["angle", "speed"], outputs=2, params={"g": 9.81}, name=name)


def untraceable():
    def rate(t, x, u, params):
        return [float(x[1]), -9.81 * float(np.sin(float(x[0]))) - 0.3 * float(x[1]) + float(u[0])]

    return ct.nlsys(rate, None, inputs="u", states=["angle", "speed"], outputs=2, name="black")


@pytest.mark.parametrize("system", [pendulum(), untraceable()], ids=["compiled", "python"])
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_nonlinear_systems_equal_simulate(system, size):
    values = size * RNG.standard_normal((1, 25))
    apart, response = against_simulate(system, values, 0.1)
    assert response.method in ("compiled", "python")
    assert apart <= 2e-7  # the tolerance of simulate, 1e-8, of both, and what grows
    tight, _ = against_simulate(system, values, 0.1, rtol=1e-11)
    assert tight <= 1e-9


def test_parameters_reach_the_blocks():
    values = RNG.standard_normal((1, 10))
    apart, _ = against_simulate(pendulum(), values, 0.1, [0.3, 0.0], params={"g": 1.6})
    assert apart <= 2e-7


@pytest.mark.parametrize("delay", [0.05, 0.1, 0.234])
def test_delays_store_what_was_stepped(delay):
    plant = ct.tf([1.0], [1.0, 1.0], inputs="e", outputs="y", name="plant")
    late = cp.create_delay_iosystem(delay, inputs="y", outputs="yd", name="late")
    mix = ct.summing_junction(["r", "-yd"], "e")
    loop = ct.interconnect([plant, late, mix], inputs="r", outputs=["y", "yd"])
    apart, _ = against_simulate(loop, np.repeat(RNG.standard_normal((1, 8)), 3, axis=1), 0.1)
    assert apart <= 1e-7


def test_a_delayed_input_arrives_between_steps():
    late = cp.create_delay_iosystem(0.25, inputs="u", outputs="v", name="late")
    plant = ct.tf([1.0], [1.0, 0.0], inputs="v", outputs="y", name="plant")
    stepper = cp.prepare(ct.interconnect([late, plant], inputs="u", outputs=["y", "v"])).start(0.1)
    found = [stepper.step(float(k)) for k in range(8)]
    # y is the integral of the delayed input: half a step of each value reaches each step.
    expected = np.cumsum([0.0, 0.0, 0.0, 0.05, 0.15, 0.25, 0.35, 0.45])
    assert np.array(found)[:, 0] == pytest.approx(expected, abs=1e-9)
    assert np.array(found)[:, 1] == pytest.approx([0, 0, 0, 1, 2, 3, 4, 5], abs=1e-9)


def test_a_nonlinear_plant_with_a_discrete_controller_and_a_plan():
    plan = cp.PolySpline([cp.Waypoint(0.05, 0, 0, 0), cp.Waypoint(1.5, 1, 0, 0)], labels=["r"])
    controller = ct.ss([], [], [], [[8.0]], 0.04, inputs="e", outputs="v", name="p")
    blocks = [
        cp.create_source_iosystem(plan),
        cp.sample_hold(controller, 0.04, offset=0.01),
        ct.nlsys(
            lambda t, x, u, params: [x[1], -9.81 * np.sin(x[0]) - 2.0 * x[1] + u[0] + u[1]],
            lambda t, x, u, params: x[0],
            inputs=["v", "d"],
            outputs="y",
            states=2,
            name="plant",
        ),
        ct.summing_junction(["r", "-y"], "e"),
    ]
    loop = ct.interconnect(blocks, inputs="d", outputs=["y", "v", "r"])
    apart, _ = against_simulate(loop, RNG.standard_normal((1, 20)), 0.1)
    assert apart <= 2e-7


@pytest.mark.parametrize("factor", [1, 3])
def test_discrete_systems_step_by_whole_periods(factor):
    nonlinear = ct.nlsys(
        lambda t, x, u, params: [0.9 * x[0] + np.sin(u[0]), x[0] * u[1]],
        lambda t, x, u, params: x[0] + u[0],
        inputs=2,
        outputs=1,
        states=2,
        dt=0.1,
        name="nonlinear",
    )
    linear = ct.ss([[0.5, 0.2], [0.0, -0.7]], np.eye(2), [[1.0, 1.0]], [[0.0, 1.0]], 0.1)
    values = RNG.standard_normal((2, 15))
    for system in (nonlinear, linear):
        x, expected = np.array([1.0, -1.0]), []
        for u in values.T:
            for _ in range(factor):
                x = np.ravel(system.dynamics(0.0, x, u))
            expected.append(np.ravel(system.output(0.0, x, u)))
        stepper = cp.prepare(system).start(0.1 * factor, [1.0, -1.0])
        _, after, states = stepped(stepper, values)
        np.testing.assert_allclose(after.T, expected, rtol=1e-13)
        assert states[:, -1] == pytest.approx(x, rel=1e-13)
        assert stepper.time == pytest.approx(1.5 * factor, rel=1e-15)


def test_a_discrete_block_with_memory_is_sampled_once():
    class Counter:
        def __init__(self):
            self.calls = 0

    counter = Counter()

    def output(t, x, u, params):
        counter.calls += 1
        return counter.calls + 0.0 * u[0]

    block = ct.nlsys(None, output, inputs="e", outputs="v", dt=0.1, name="counter")
    plant = ct.tf([1.0], [1.0, 0.0], inputs="v", outputs="y", name="plant")
    loop = ct.interconnect([cp.sample_hold(block, 0.1), plant], inputs="e", outputs=["y", "v"])
    prepared = cp.prepare(loop)
    before = counter.calls
    stepper = prepared.start(0.1)
    first = counter.calls - before
    for k in range(1, 6):
        stepper.outputs(0.0)
        assert stepper.step(0.0)[1] == counter.calls
        assert counter.calls - before - first == k
        assert np.array_equal(stepper.outputs(0.0), stepper.outputs(0.0))


def test_the_declared_start_and_all_forms_of_a_start():
    system = cp.declare(ct.ss([[-1.0, 0], [0, -2.0]], np.ones((2, 1)), np.eye(2), 0), initial_state=[1.0, 2.0])
    prepared = cp.prepare(system)
    assert prepared.start(0.1).state.tolist() == [1.0, 2.0]
    assert prepared.start(0.1, 3).state.tolist() == [3.0, 3.0]
    assert prepared.start(0.1, [4, 5]).state.tolist() == [4.0, 5.0]
    assert cp.prepare(ct.tf([1], [1, 1])).start(0.1).state.tolist() == [0.0]


def test_inputs_by_name_number_and_array():
    stepper = cp.prepare(ct.ss([], [], [], np.eye(2), inputs=["a", "b"], outputs=["c", "d"])).start(1.0)
    assert stepper.outputs({"b": 2}).tolist() == [0.0, 2.0]
    assert stepper.outputs(3).tolist() == [3.0, 3.0]
    assert stepper.outputs([1, 2]).tolist() == [1.0, 2.0]
    assert stepper.outputs().tolist() == [0.0, 0.0]


SYSTEMS = {
    "linear": lambda: stable(2, 2, 2),
    "sampled": lambda: ct.interconnect(
        [cp.sample_hold(ct.ss([], [], [], np.eye(2), 0.1, inputs=["a", "b"], outputs=["c", "d"], name="z"), 0.1)],
        inputs=["a", "b"],
        outputs=["c", "d"],
    ),
    "discrete": lambda: ct.ss([[0.5]], [[1.0, 0.0]], [[1.0]], [[0.0, 1.0]], 0.1),
    "nonlinear": lambda: ct.nlsys(
        lambda t, x, u, params: [-(x[0] ** 3) + u[0] - u[1]], None, inputs=2, outputs=1, states=1, name="n"
    ),
}


@pytest.mark.parametrize("kind", SYSTEMS)
def test_wrong_inputs_are_rejected_and_change_nothing(kind):
    stepper = cp.prepare(SYSTEMS[kind]()).start(0.1)
    labels = stepper.input_labels
    stepper.step([1.0, 2.0])
    state, time = stepper.state, stepper.time
    wrong = [
        ([1.0, np.nan], ValueError, f"inputs must be finite, got {re.escape(labels[1])} = nan"),
        ([np.inf, 0.0], ValueError, "inputs must be finite"),
        ([1.0], ValueError, r"inputs must be a number or have shape \(2,\)"),
        (np.ones((2, 3)), ValueError, r"got shape \(2, 3\)"),
        ({"other": 1.0}, ValueError, "inputs must be among"),
        ({labels[0]: [1.0, 2.0]}, ValueError, "must be a number"),
        (["a", "b"], TypeError, "inputs must be real numbers"),
        ([1j, 0.0], TypeError, "complex"),
    ]
    for inputs, error, message in wrong:
        for method in (stepper.step, stepper.outputs):
            with pytest.raises(error, match=message):
                method(inputs)
    assert np.array_equal(stepper.state, state)
    assert stepper.time == time
    again = cp.prepare(SYSTEMS[kind]()).start(0.1)
    again.step([1.0, 2.0])
    assert np.array_equal(stepper.step([0.5, -1.0]), again.step([0.5, -1.0]))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"dt": 0.0}, ValueError, "dt must be finite and above 0"),
        ({"dt": np.nan}, ValueError, "dt must be finite and above 0"),
        ({"dt": "fast"}, TypeError, "dt must be a number"),
        ({"dt": 1e-20, "time": 1.0}, ValueError, "dt must be resolved by times about 1 s"),
        ({"dt": 0.1, "initial_state": [1, 2, 3]}, ValueError, "initial_state must be a scalar or have 2 entries"),
        ({"dt": 0.1, "initial_state": np.nan}, ValueError, "initial_state must be finite"),
        ({"dt": 0.1, "time": np.inf}, ValueError, "time must be finite"),
        ({"dt": 0.1, "rtol": 0.0}, ValueError, "rtol must be finite and above 0"),
    ],
)
def test_wrong_arguments_of_start(options, error, message):
    with pytest.raises(error, match=message):
        cp.prepare(stable(2, 1, 1)).start(**options)


def test_the_step_of_a_discrete_system_is_a_multiple_of_its_period():
    with pytest.raises(ValueError, match=r"dt must be a multiple of the sampling period 0\.1 s"):
        cp.prepare(ct.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1)).start(0.25)
    stepper = cp.prepare(ct.ss([[0.5]], [[1.0]], [[1.0]], 0, True)).start(0.25)
    stepper.step(1.0)
    assert (stepper.time, stepper.state.tolist()) == (0.25, [1.0])


def test_the_length_of_a_step_cannot_be_changed():
    stepper = cp.prepare(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, name="lag")).start(0.1)
    for name in ("dt", "name", "time"):
        with pytest.raises(AttributeError):
            setattr(stepper, name, 0.2)
    stepper.step(1.0)
    assert (stepper.dt, stepper.name, stepper.time) == (0.1, "lag", 0.1)


def test_a_block_that_only_python_control_runs_cannot_be_stepped():
    class Odd(ct.NonlinearIOSystem):
        def _rhs(self, t, x, u, params=None):
            return -np.asarray(x)

    odd = Odd(lambda t, x, u, params: [0.0], None, inputs=1, outputs=1, states=1, name="odd")
    with pytest.raises(TypeError, match=r"block odd .*overrides the equations.*control\.nlsys"):
        cp.prepare(odd).start(0.1)


def test_a_system_without_timebase_warns():
    system = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, dt=None)
    with pytest.warns(UserWarning, match="no timebase"):
        cp.prepare(system).start(0.1)


def test_an_unread_parameter_warns():
    with pytest.warns(UserWarning, match="'h' is read by no block"):
        cp.prepare(pendulum()).start(0.1, params={"h": 1.0})


def test_states_that_overflow_are_an_error():
    stepper = cp.prepare(ct.tf([1], [1, -100.0])).start(1.0)
    for _ in range(3):
        stepper.step(1.0)
    with pytest.raises(cp.SolverError, match="must stay finite"):
        stepper.step(1.0)
    assert np.isfinite(stepper.state).all()


def test_a_failed_step_can_be_repeated():
    def rate(t, x, u, params):
        if u[0] > 5.0:
            raise ArithmeticError("out of range")
        return [-float(x[0]) + float(u[0])]

    stepper = cp.prepare(ct.nlsys(rate, None, inputs=1, outputs=1, states=1, name="picky")).start(0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stepper.step(1.0)
        state = stepper.state
        with pytest.raises(ArithmeticError, match="out of range"):
            stepper.step(6.0)
        assert np.array_equal(stepper.state, state)
        assert stepper.step(1.0) == pytest.approx([1.0 - np.exp(-0.2)], rel=1e-8)


def test_two_steppers_of_one_form_do_not_share_anything():
    prepared = cp.prepare(pendulum())
    alone = stepped(prepared.start(0.1), np.ones((1, 20)))[2]
    found = {}

    def run(name):
        found[name] = stepped(prepared.start(0.1), np.ones((1, 20)))[2]

    threads = [threading.Thread(target=run, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(alone, other) for other in found.values())


def test_the_state_is_a_copy():
    stepper = cp.prepare(stable(2, 1, 1)).start(0.1)
    stepper.state[:] = 7.0
    y = stepper.step(1.0)
    y[:] = 9.0
    again = cp.prepare(stable(2, 1, 1)).start(0.1)
    again.step(1.0)
    assert np.array_equal(stepper.state, again.state)


def test_it_describes_itself():
    stepper = cp.prepare(ct.tf([1], [1, 1], inputs="r", outputs="y", name="lag")).start(0.1)
    stepper.step(1.0)
    text = str(stepper)
    assert text.startswith("Stepper of lag: 0.1 s, steps of 0.1 s")
    assert "= 0.09516" in text
