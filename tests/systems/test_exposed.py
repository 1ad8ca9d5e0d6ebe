"""Systems with their states among the outputs, compared with the plain ones."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems import state_signals

TIMES = np.linspace(0.0, 4.0, 41)
PLAN = cp.PolySpline([cp.Waypoint(0.0, 0, 0), cp.Waypoint(3.0, 1.0, 0)])
TIGHT = {"rtol": 1e-10, "atol": 1e-12}


def pendulum(**more):
    return ct.nlsys(
        lambda t, x, u, p: np.array([x[1], -p["g"] * np.sin(x[0]) - 0.4 * x[1] + u[0]]),
        lambda t, x, u, p: [x[0]],
        inputs="u",
        outputs="y",
        states=["angle", "rate"],
        params={"g": 2.0},
        name="pendulum",
        **more,
    )


def loop(law=None):
    law = law or cp.create_pid_iosystem(6.0, 2.0, 3.0, 0.1, limits=(-4.0, 5.0))
    return ct.interconnect([law, pendulum()], inputs="r", outputs=["y", "u"], name="loop")


def discrete_law():
    return ct.ss(0.6, [[0.5, -0.5]], 1.0, [[1.3, -1.3]], 0.1, inputs=["r", "y"], outputs="u", states="z", name="law")


SYSTEMS = {
    "state space": lambda: ct.ss([[0, 1], [-2, -1]], [[0], [1]], [[1, 0]], [[0.5]], inputs="r", outputs="y", name="s"),
    "transfer function": lambda: ct.tf([1.0, 3.0], [1.0, 1.0, 2.0], inputs="r", outputs="y", name="s"),
    "nonlinear": lambda: pendulum(),
    "outputs are states": lambda: ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - x[0] ** 3 - x[1]]), None, inputs="r", states=2, outputs=["a", "b"]
    ),
    "linear loop": lambda: cp.plants.integrator_lag_loop(2.0, outputs=("y", "u")),
    "loop": loop,
    "nested": lambda: ct.interconnect(
        [loop(), ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="q", outputs="r", name="lag")],
        inputs="q",
        outputs=["y", "r", "u"],
        name="outer",
    ),
    "sampled": lambda: loop(cp.sample_hold(discrete_law(), 0.1)),
    "delayed": lambda: ct.interconnect(
        [cp.create_delay_iosystem(0.3, inputs="y", outputs="late"), discrete_free("late"), pendulum()],
        inputs="r",
        outputs=["y"],
    ),
    "with a plan": lambda: ct.interconnect(
        [cp.create_source_iosystem(cp.Step(1.0, labels=["d"])), ct.summing_junction(["r", "d"], "u"), pendulum()],
        inputs="r",
        outputs="y",
    ),
}


def discrete_free(measured):
    return ct.ss([], [], [], [[1.0, -1.0]], inputs=["r", measured], outputs="u", name="law")


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", ["auto", "python"])
def test_the_same_system_with_its_states(name, method):
    plain = SYSTEMS[name]()
    exposed = cp.expose_states(plain)
    assert exposed.name == plain.name
    assert exposed.input_labels == plain.input_labels
    n, p = exposed.nstates, plain.noutputs
    assert exposed.output_labels == [*plain.output_labels, *state_signals(exposed.state_labels)]
    start = 0.1 * np.arange(1, n + 1)
    one, two = (cp.simulate(s, TIMES, PLAN, start, method=method, **TIGHT) for s in (plain, exposed))
    assert one.method == two.method
    assert np.abs(two.y[:p] - one.y).max() <= 1e-8
    assert np.array_equal(two.y[p:], two.x)
    assert np.abs(two.x - one.x).max() <= 1e-8


@pytest.mark.parametrize("name", ["state space", "nonlinear", "outputs are states", "linear loop", "loop", "nested"])
def test_python_control_runs_it_as_well(name):
    plain = SYSTEMS[name]()
    exposed = cp.expose_states(plain)
    x, u = np.linspace(0.3, 1.0, plain.nstates), np.array([0.7])
    assert np.allclose(exposed.dynamics(0.2, x, u), plain.dynamics(0.2, x, u), rtol=0, atol=1e-14)
    assert np.allclose(exposed.output(0.2, x, u), [*plain.output(0.2, x, u), *x], rtol=0, atol=1e-14)


def test_linear_interconnections_stay_linear():
    plain = SYSTEMS["linear loop"]()
    exposed = cp.expose_states(plain)
    assert np.allclose(np.sort_complex(exposed.poles()), np.sort_complex(plain.poles()))
    assert np.array_equal(exposed.C, np.vstack([plain.C, np.eye(2)]))


def test_what_a_block_says_of_itself_is_kept():
    law = cp.create_pid_iosystem(6.0, 2.0, 3.0, 0.1, limits=(-0.5, 5.0))
    exposed = cp.expose_states(law)
    assert cp.traits_of(exposed).watched == cp.traits_of(law).watched
    found = cp.simulate(cp.expose_states(loop(law)), TIMES, cp.Step(-1.0))
    assert [event.name for event in found.events][:1] == ["u"]
    block = pendulum()
    cp.declare(block, feedthrough=False)
    assert not cp.traits_of(cp.expose_states(block)).feedthrough.any()
    block = ct.nlsys(lambda t, x, u, p: -x, lambda t, x, u, p: u, inputs=2, outputs=2, states=1)
    cp.declare(block, feedthrough=[[True, False], [False, True]])
    assert cp.traits_of(cp.expose_states(block)).feedthrough.tolist() == [[True, False], [False, True], [False, False]]
    assert block.noutputs == 2


def test_parameters_and_the_initial_state_are_kept():
    plain = SYSTEMS["loop"]()
    cp.declare(plain, initial_state=[0.0, 0.0, 0.4, 0.0])
    exposed = cp.expose_states(plain, name="open")
    assert (exposed.name, exposed.params["g"]) == ("open", 2.0)
    assert cp.traits_of(exposed).initial_state.tolist() == [0.0, 0.0, 0.4, 0.0]
    runs = [cp.simulate(s, TIMES, PLAN, params={"g": 3.0}, **TIGHT).y[0] for s in (plain, exposed)]
    assert runs[0][0] == 0.4
    assert np.abs(runs[0] - runs[1]).max() <= 1e-8


def test_discrete_systems():
    plain = discrete_law()
    found = cp.expose_states(plain)
    assert (found.dt, found.output_labels) == (0.1, ["u", "z_state"])


def test_without_states_nothing_is_added():
    plain = ct.ss([], [], [], [[2.0]], inputs="a", outputs="b", name="gain")
    found = cp.expose_states(plain, name="other")
    assert (found.name, found.output_labels, plain.name) == ("other", ["b"], "gain")


def test_names():
    assert state_signals(["a", "p_x[0]", "p.x[0]", "p_x_0"]) == [
        "a_state",
        "p_x_0_state",
        "p_x_0_state_",
        "p_x_0_state__",
    ]
    assert state_signals([]) == []


def test_what_is_rejected():
    with pytest.raises(ValueError, match=r"outputs of s must not have the name of a state output, got 'x_0_state'"):
        cp.expose_states(cp.expose_states(SYSTEMS["state space"]()))
    with pytest.raises(TypeError, match="system must be a control system with states, got float"):
        cp.expose_states(1.0)

    class Own(ct.NonlinearIOSystem):
        def _out(self, t, x, u):
            return x

    with pytest.raises(TypeError, match="block own must have updfcn and outfcn, got a Own"):
        cp.expose_states(Own(lambda t, x, u, p: -x, None, inputs=1, outputs=1, states=1, name="own"))


def test_a_block_that_outputs_its_states_may_be_exposed_inside():
    inner = cp.expose_states(pendulum())
    law = ct.ss([], [], [], [[3.0, -3.0, -1.0]], inputs=["r", "y", "rate_state"], outputs="u", name="law")
    plain = ct.interconnect([law, inner], inputs="r", outputs=["y", "angle_state"], name="loop")
    exposed = cp.expose_states(plain)
    one, two = (cp.simulate(s, TIMES, PLAN, **TIGHT) for s in (plain, exposed))
    assert np.abs(two.y - [*one.y, *one.x]).max() <= 1e-8
