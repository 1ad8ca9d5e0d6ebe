"""What a block declares, and that nothing else of it is read."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

T = np.linspace(0, 3, 31)
PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(2, 1, 0)])


def lag():
    """A lag of 1 s as a nonlinear block."""
    return ct.nlsys(lambda t, x, u, params: [u[0] - x[0]], inputs="u", outputs="y", states="y", name="lag")


ATTRIBUTES = {
    "delay": 0.3,
    "initial": 20.0,
    "period": 0.5,
    "offset": 0.1,
    "sample": lambda t, x, u, params: [5.0],
    "samples_first": True,
    "watched": {"u": (lambda t, x, u, params: u[0], -0.1, 0.1)},
    "feedthrough": True,
    "breakpoints": (0.55,),
    "longest": 1e-9,
    "initial_state": [7.0],
    "plan": cp.Step(3.0),
    "derivatives": 2,
    "block": "anything",
    "traits": 3,
}


@pytest.mark.parametrize("name", [*ATTRIBUTES, "all"])
@pytest.mark.parametrize("method", ["auto", "python"])
def test_attributes_of_a_users_object_are_no_traits(name, method):
    block = lag()
    for key, value in ATTRIBUTES.items():
        if name in (key, "all"):
            setattr(block, key, value)
    plain = cp.simulate(lag(), T, PLAN, method=method)
    found = cp.simulate(block, T, PLAN, method=method)
    assert np.array_equal(found.outputs, plain.outputs)
    assert found.events == []


def test_attributes_of_a_loop_are_no_traits():
    """The state at which a loop starts is declared; an attribute of that name is not read."""
    loop = ct.interconnect(
        [lag(), ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="y", outputs="z")], inputs="u", outputs="z"
    )
    loop.initial_state = [7.0, 7.0]
    assert np.asarray(cp.simulate(loop, T).states)[:, 0].tolist() == [0.0, 0.0]
    cp.declare(loop, initial_state=[7.0, 8.0])
    assert np.asarray(cp.simulate(loop, T).states)[:, 0].tolist() == [7.0, 8.0]


def test_an_object_that_answers_every_name_declares_nothing():
    class Everything(ct.NonlinearIOSystem):
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)
            return 0.3

    block = Everything(lambda t, x, u, params: [u[0] - x[0]], None, inputs="u", outputs="y", states="y", name="lag")
    assert cp.traits_of(block).delay is None
    assert np.array_equal(cp.simulate(block, T, PLAN).outputs, cp.simulate(lag(), T, PLAN).outputs)


def test_a_declared_sampled_block_against_its_recursion():
    """A user's own integrator of samples, in closed loop with a lag of 1 s: by hand."""
    dt, gain = 0.25, 0.8
    law = ct.nlsys(
        lambda t, x, u, params: [0.0, 0.0],
        lambda t, x, u, params: [x[1]],
        inputs=["r", "y"],
        outputs="u",
        states=["sum", "held"],
        name="law",
        dt=0,
    )

    def sample(t, x, u, params):
        return [x[0] + gain * dt * (u[0] - u[1]), x[0] + 0.5 * (u[0] - u[1])]

    cp.declare(law, period=dt, sample=sample, feedthrough=False)
    loop = ct.interconnect([law, lag()], inputs="r", outputs="y")
    t = dt * np.arange(13)
    y, total, expected = 0.0, 0.0, []
    for k in range(t.size):
        expected.append(y)
        r = float(PLAN(t[k]))
        u, total = total + 0.5 * (r - y), total + gain * dt * (r - y)
        y = u + (y - u) * np.exp(-dt)
    found = cp.simulate(loop, t, PLAN)
    assert np.abs(found.outputs - expected).max() < 1e-7


def test_traits_given_again_replace_and_others_stay():
    block = cp.declare(cp.declare(lag(), breakpoints=[2, 1], feedthrough=False), breakpoints=3.0)
    assert cp.traits_of(block).breakpoints == (3.0,)
    assert cp.traits_of(block).feedthrough is False


def test_a_trait_declared_later_is_seen_by_the_next_run():
    block = lag()
    before = cp.simulate(block, T)
    cp.declare(block, initial_state=1.0)
    after = cp.simulate(block, T)
    assert before.outputs[0] == 0.0
    np.testing.assert_allclose(after.outputs, np.exp(-T), rtol=1e-7)


@pytest.mark.parametrize(
    ("traits", "kind", "message"),
    [
        ({"delays": 0.1}, TypeError, "traits must be among breakpoints, .* got 'delays'"),
        ({"breakpoints": [0.0, np.nan]}, ValueError, "breakpoints of lag must be finite times"),
        ({"breakpoints": "12"}, TypeError, "breakpoints of lag must be a number of seconds, got '12'"),
        ({"breakpoints": np.array([1, 2], dtype="m8[s]")}, TypeError, "breakpoints of lag must be a number of seconds"),
        ({"feedthrough": [[True, False]]}, ValueError, r"feedthrough of lag must be .* of shape \(1, 1\)"),
        ({"feedthrough": 1.0}, ValueError, "feedthrough of lag must be True, False or truth values"),
        ({"initial_state": [1.0, 2.0]}, ValueError, "initial_state of lag must be a finite number or 1 of them"),
        ({"initial_state": np.inf}, ValueError, "initial_state of lag must be a finite number"),
        ({"longest": 0.0}, ValueError, "longest of lag must be above 0 s"),
        ({"period": -1.0, "sample": len}, ValueError, "period of lag must be above 0 s"),
        ({"period": 1.0}, ValueError, "period and sample of lag must be declared together"),
        ({"sample": len}, ValueError, "period and sample of lag must be declared together"),
        ({"period": 1.0, "sample": 3}, TypeError, "sample of lag must be a function"),
        ({"offset": -0.1}, ValueError, "offset of lag must be finite and at least 0 s"),
        ({"delay": 0.5}, ValueError, "lag must have no states and the signals of a delay"),
        ({"plan": PLAN}, ValueError, "lag must have no states and the signals of the source of a plan"),
        ({"watched": {"u": (len, 2.0, 1.0)}}, ValueError, "watched of lag must map names"),
    ],
)
def test_traits_that_do_not_fit(traits, kind, message):
    with pytest.raises(kind, match=message):
        cp.declare(lag(), **traits)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (ct.ss(-1, 1, 1, 0, name="plant"), "breakpoints has no effect on plant, a linear system"),
        (ct.tf([1], [1, 1], name="plant"), "breakpoints has no effect on plant, a linear system"),
        (
            ct.interconnect([lag()], inputs="u", outputs="y", name="loop"),
            "breakpoints has no effect on loop, an interconnection: declare it for its block",
        ),
        ("plant", "system must be a control system, got str"),
    ],
)
def test_traits_without_effect_are_rejected(system, message):
    with pytest.raises(TypeError, match=message):
        cp.declare(system, breakpoints=[1.0])


# Commands that start before their plans


def early(**traits):
    """A ramp from -2 s on, two seconds before a plan, at the input of a lag."""
    ramp = ct.nlsys(
        None, lambda t, x, u, params: np.maximum(t + 2.0, 0.0), inputs=0, outputs="u", name="ramp", **traits
    )
    return ct.interconnect([cp.declare(ramp, start=-2.0, preview=2.0, breakpoints=[-2.0]), lag()], outputs="y")


def test_a_run_that_misses_the_start_of_a_command_is_rejected():
    message = (
        r"^timepts must begin at -2 s or earlier, where the command of block ramp starts, 2 s before its plan, got 0"
    )
    with pytest.raises(ValueError, match=message):
        cp.simulate(early(), T)
    with pytest.raises(ValueError, match=message):
        cp.prepare(early()).start(0.1)


def test_a_run_from_a_given_state_may_begin_later():
    # x = (t + 2) - 1 + exp(-(t + 2))
    found = cp.simulate(early(), T, initial_state=1.0 + np.exp(-2.0))
    np.testing.assert_allclose(found.outputs[0], T + 1.0 + np.exp(-T - 2.0), atol=1e-7)
    found = cp.simulate(early(), T - 2.5)
    expected = np.maximum(T - 1.5 + np.exp(0.5 - T), 0.0) * (T > 0.5)
    np.testing.assert_allclose(found.outputs[0], expected, atol=1e-7)


@pytest.mark.parametrize("name", ["start", "preview"])
def test_wrong_times_of_a_command(name):
    with pytest.raises(TypeError, match=f"^{name} of lag must be a number of seconds, got 'soon'"):
        cp.declare(lag(), **{name: "soon"})
    with pytest.raises(ValueError, match=f"^{name} of lag must be finite, got inf"):
        cp.declare(lag(), **{name: np.inf})
