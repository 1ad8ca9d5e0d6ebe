"""Runs start at equilibrium at the first position of the plan: states in closed form, and records that stay at rest."""

import math

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import equilibrium_at

BEFORE = np.linspace(-3.0, 12.0, 301)  # the plan begins at 0: until then a loop at rest does not move


def move(label="r", first=10.0, last=20.0):
    return cp.PolySpline([cp.Waypoint(0, first, 0, 0), cp.Waypoint(5, last, 0, 0)], labels=[label])


def joined(plan, *blocks, outputs=("y",), derivatives=0, **labels):
    source = cp.create_source_iosystem(plan, derivatives, **labels)
    return ct.interconnect([source, *blocks], inputs=0, outputs=list(outputs), name="whole")


def compared(build, plan=None, times=BEFORE, **options):
    return cp.compare(build, {"move": plan or move()}, times, **options)


def output(found, row=0):
    response = found.responses["move"]
    return np.asarray(response.outputs).reshape(len(response.output_labels), -1)[row]


def rests(found, value=10.0, rtol=1e-7):
    y = output(found)[found.responses["move"].time <= 0.0]
    return np.abs(y - value).max() <= rtol * abs(value)


def pi(kp=3.0, ki=1.0, dt=0, output="q"):
    gain = ki if dt == 0 else ki * dt
    a = 0.0 if dt == 0 else 1.0
    return ct.ss([[a]], [[1, -1]], [[gain]], [[kp, -kp]], dt, inputs=["r", "y"], outputs=[output], name="pi")


def tank(c=2.0):
    """Level h, outflow c sqrt h: no derivative at h = 0, and no number below."""

    def rates(t, x, u, p):
        return [u[0] - p["c"] * math.sqrt(x[0])]

    return ct.nlsys(
        rates, lambda t, x, u, p: x, inputs="q", outputs="y", states="h", params={"c": c}, name="tank", dt=0
    )


# Linear loops


@pytest.mark.parametrize("first", [10.0, -3.0, 1e-6, 1e6])
def test_a_linear_loop_with_the_plan_inside_starts_as_one_with_inputs(first):
    plan, loop = move(first=first, last=2 * first), cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    inside = compared(lambda name, p: joined(p, loop, outputs=("y", "u")), plan)
    outside = compared(loop, plan)
    np.testing.assert_allclose(output(inside), output(outside), rtol=0, atol=1e-9 * abs(first))
    assert rests(inside, first, 1e-12)
    for name, value in outside.metrics["move"].items():
        assert inside.metrics["move"][name] == pytest.approx(value, rel=1e-6, abs=1e-9)


def test_derivatives_that_are_put_out_as_well_are_0_at_rest():
    """The plan's derivatives fed forward: y = r to rounding, from the first sample on."""
    loop = cp.plants.integrator_lag_loop(5.0)
    forward = cp.create_feedforward_iosystem(loop)
    found = compared(lambda name, plan: joined(plan, forward, loop, derivatives=2, suffix="_ref"), move("y"), BEFORE)
    np.testing.assert_allclose(output(found), found.plans["move"](BEFORE), rtol=0, atol=1e-9)


def test_two_axes_and_a_disturbance_that_is_held_as_well():
    """x' = -2 x + 2 r + d: at rest x = r + d/2 with d held at its first value."""
    a = ct.ss(-2.0, [[2.0, 1.0]], 1.0, 0.0, inputs=["rx", "d"], outputs="x", name="a")
    b = ct.ss(-3.0, 3.0, 1.0, 0.0, inputs="rz", outputs="z", name="b")
    wind = cp.PolySpline([cp.Waypoint(6, 4.0, 0, 0), cp.Waypoint(7, 0.0, 0, 0)], labels=["d"])

    def build(name, plan):
        sources = [cp.create_source_iosystem(plan), cp.create_source_iosystem(wind, name="wind")]
        return ct.interconnect([*sources, a, b], inputs=0, outputs=["x", "z"])

    plan = cp.stack([move(), move(first=-1.0, last=4.0)], labels=["rx", "rz"])
    y = np.asarray(compared(build, plan).responses["move"].outputs)[:, BEFORE <= 0.0]
    np.testing.assert_allclose(y, np.array([[12.0], [-1.0]]) * np.ones(y.shape[1]), rtol=1e-12)


def test_inputs_that_are_crossed_by_name_rest_crossed():
    a, b = (ct.ss(-1.0, 1.0, 1.0, 0.0, inputs=f"r{n}", outputs=n, name=f"lag{n}") for n in "xz")
    loop = ct.interconnect([a, b], inputs=["rx", "rz"], outputs=["x", "z"])
    plan = cp.stack([move(), move(first=-1.0, last=4.0)], labels=["rz", "rx"])
    y = np.asarray(compared(loop, plan, outputs=["z", "x"]).responses["move"].outputs)[:, BEFORE <= 0.0]
    np.testing.assert_allclose(y, np.array([[-1.0], [10.0]]) * np.ones(y.shape[1]), rtol=1e-12)


def test_of_many_equilibria_the_one_where_the_outputs_are_at_the_position():
    """Open double integrator behind r'': whatever position is at rest, and the plan's is taken, not that of row 0."""
    plant = ct.ss([[0, 1.0], [0, 0]], [[0], [1.0]], [[0, 1.0], [1.0, 0]], 0, inputs="r_ref_d2", outputs=["v", "y"])

    def build(name, plan):
        source = cp.create_source_iosystem(plan, 2, suffix="_ref")
        return ct.interconnect([source, plant], inputs=0, outputs=["v", "y", "r_ref", "r_ref_d1"])

    found = compared(build, outputs=["y"], controls=())
    np.testing.assert_allclose(output(found, 1), found.plans["move"](BEFORE), rtol=0, atol=1e-8)


@pytest.mark.parametrize("inside", [True, False])
def test_a_sampled_loop_starts_at_rest(inside):
    dt, t = 0.1, 0.1 * np.arange(-30, 121)
    plant = ct.ss([[0.9]], [[0.1]], [[1.0]], [[0.0]], dt, inputs="q", outputs="y", name="plant")
    loop = ct.interconnect([pi(dt=dt), plant], inputs=["r"], outputs=["y"])
    found = compared((lambda name, p: joined(p, pi(dt=dt), plant)) if inside else loop, times=t)
    assert rests(found, 10.0, 1e-12)
    assert output(found)[-1] == pytest.approx(20.0, rel=1e-2)


def test_a_discrete_controller_in_a_continuous_loop_starts_at_rest():
    plant = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="q", outputs="y", name="plant")
    found = compared(lambda name, p: joined(p, cp.sample_hold(pi(dt=0.1), 0.1), plant))
    assert rests(found, 10.0, 1e-9)


def test_a_delay_that_holds_what_goes_in_at_rest():
    plant = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="late", outputs="y", name="plant")

    def build(initial):
        late = cp.create_delay_iosystem(0.2, inputs="q", outputs="late", initial=initial, name="pipe")
        return lambda name, p: joined(p, pi(0.5, 0.5), late, plant)

    assert rests(compared(build(10.0)), 10.0, 1e-8)
    with pytest.warns(UserWarning, match=r"the output of the delay pipe starts at initial = 0, .*initial_state="):
        compared(build(0.0))


@pytest.mark.parametrize("dt", [0, 0.1])
def test_a_delay_whose_output_must_be_given_is_named(dt):
    """The controller has no direct feedthrough: at the zero state nothing differs from the output of the delay."""
    plant = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="late", outputs="y", name="plant")
    integral = pi(0.0, 0.5) if dt == 0 else cp.sample_hold(pi(0.0, 0.5, dt=dt), dt)

    def build(initial):
        late = cp.create_delay_iosystem(0.2, inputs="q", outputs="late", initial=initial, name="pipe")
        return lambda name, p: joined(p, integral, late, plant)

    assert rests(compared(build(10.0)), 10.0, 1e-8)
    with pytest.warns(UserWarning, match=r"delays that start as declared \(pipe at initial = 0\): give their values"):
        compared(build(0.0))


# Loops that are not linear


@pytest.mark.parametrize(("first", "c"), [(10.0, 2.0), (0.25, 1.0), (400.0, 7.0)])
def test_a_plant_that_is_singular_at_zero(first, c):
    """h = r and q = c sqrt r at rest."""
    plan = move(first=first, last=1.5 * first)
    found = compared(lambda name, p: joined(p, pi(), tank(c), outputs=("y", "q")), plan)
    assert rests(found, first)
    assert output(found, 1)[0] == pytest.approx(c * math.sqrt(first), rel=1e-7)


def test_parameters_of_the_run_move_the_equilibrium():
    found = compared(lambda name, p: joined(p, pi(), tank(), outputs=("y", "q")), params={"c": 5.0})
    assert rests(found)
    assert output(found, 1)[0] == pytest.approx(5.0 * math.sqrt(10.0), rel=1e-7)


def test_a_division_by_a_state():
    """m h'' = F/h - 9.81 with a PI and velocity feedback: F = 9.81 h at rest."""

    def rates(t, x, u, p):
        return [x[1], u[0] / x[0] - 9.81]

    plant = ct.nlsys(rates, lambda t, x, u, p: x, inputs="F", outputs=["y", "v"], states=2, name="plant", dt=0)
    law = ct.ss([[0.0]], [[1, -1, 0]], [[20.0]], [[50, -50, -30.0]], inputs=["r", "y", "v"], outputs="F", name="law")
    found = compared(lambda name, p: joined(p, law, plant, outputs=("y", "F")))
    assert rests(found)
    assert output(found, 1)[0] == pytest.approx(98.1, rel=1e-7)


def test_a_nonlinear_loop_with_inputs_rests_as_well():
    bent = ct.nlsys(lambda t, x, u, p: u - x**3, lambda t, x, u, p: x, inputs="r", outputs="y", states=1, name="bent")
    y = output(compared(bent, move(first=8.0, last=27.0)))
    np.testing.assert_allclose(y[BEFORE <= 0.0], 2.0, rtol=1e-8)  # x^3 = r: an error that the loop keeps


def test_where_the_zero_state_is_no_equilibrium_a_plan_from_0_starts_elsewhere():
    """x'' = u - 9.81 under PD and a spring of 4: y = -9.81/(4 + kp) at rest."""

    def rates(t, x, u, p):
        return [x[1], 6.0 * (u[0] - x[0]) - 4.0 * x[0] - 5.0 * x[1] - 9.81 + 0.0 * x[0] ** 2]

    hung = ct.nlsys(rates, lambda t, x, u, p: x[:1], inputs="r", outputs="y", states=2, name="hung")
    y = output(compared(hung, move(first=0.0, last=1.0)))
    np.testing.assert_allclose(y[BEFORE <= 0.0], -0.981, rtol=1e-8)


@pytest.mark.slow
def test_what_only_python_control_runs_rests_too():
    class Own(ct.NonlinearIOSystem):
        def _rhs(self, t, x, u):
            return np.array([np.ravel(u)[0] - x[0] ** 3])

    own = Own(lambda t, x, u, p: None, lambda t, x, u, p: x, inputs="r", outputs="y", states=1, name="own")
    with pytest.warns(UserWarning, match="run by control") as caught:
        y = output(compared(own, move(first=8.0, last=27.0)))
    assert not [w for w in caught if "equilibrium" in str(w.message)]
    np.testing.assert_allclose(y[BEFORE <= 0.0], 2.0, rtol=1e-6)


# What is stated, what is given, what is not found


def test_a_block_that_states_its_start_has_it_and_the_others_rest_with_it():
    """A filter that starts at 4 holds the lag behind it at 4, whatever the plan is."""
    smooth = cp.create_command_filter_iosystem(2.0, 1, 2, initial=4.0, inputs="r", outputs="w")
    lag = ct.nlsys(
        lambda t, x, u, p: u - np.sinh(x), lambda t, x, u, p: x, inputs="w", outputs="y", states=1, name="lag"
    )

    rates = [label for label in smooth.output_labels if label != "w"]
    found = compared(
        lambda name, p: ct.interconnect(
            [cp.create_source_iosystem(p), smooth, lag], inputs=0, outputs=["y", "w", *rates]
        )
    )
    assert output(found, 1)[0] == 4.0
    assert output(found)[0] == pytest.approx(math.asinh(4.0), rel=1e-8)


def test_a_loop_that_states_its_start_has_it():
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")

    def build(name, plan):
        loop = joined(plan, lag)
        return cp.declare(loop, initial_state=[3.0])

    assert output(compared(build))[0] == 3.0
    assert output(compared(build, initial_state=[7.0]))[0] == 7.0


def test_a_start_that_is_nan_is_no_start():
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")
    with pytest.raises(ValueError, match="initial_state of lag must be a finite number"):
        cp.declare(lag, initial_state=[math.nan])


def drifting():
    """x' = 1: no state of it is at rest."""
    return ct.nlsys(
        lambda t, x, u, p: [1.0 + 0.0 * x[0], u[0] - x[1]],
        lambda t, x, u, p: x[1:],
        inputs="r",
        outputs="y",
        states=2,
        name="drifting",
    )


LOST = {
    "an integrator of the reference": lambda: ct.ss(0.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", name="open"),
    "a state that drifts": drifting,
    "a discrete block that is not linear": lambda: ct.nlsys(
        lambda t, x, u, p: 0.5 * x + 0.5 * u + 0.0 * x**2,
        lambda t, x, u, p: x,
        inputs="r",
        outputs="y",
        states=1,
        dt=0.5,
    ),
}


@pytest.mark.parametrize("kind", LOST)
def test_where_no_equilibrium_is_found_that_is_said(kind):
    times = np.arange(0.0, 12.5, 0.5)
    build = lambda name, plan: joined(plan, LOST[kind]())  # noqa: E731
    with pytest.warns(UserWarning, match=r"move: no equilibrium .* first position 10: .*give initial_state="):
        found = compared(build, times=times)
    (note,) = [note for note in found.notes if "equilibrium" in note]
    assert "initial_state=" in note
    count = found.responses["move"].nstates
    given = compared(build, times=times, initial_state=[10.0] * count)  # a warning would be an error here
    assert not [note for note in given.notes if "equilibrium" in note]
    assert output(given)[0] == 10.0


def test_a_run_that_fails_for_want_of_a_start_says_so():
    """1/x without an equilibrium: the run fails at 0, and the reason stands in a note of the error."""
    singular = ct.nlsys(
        lambda t, x, u, p: [1.0 / float(x[0]) + 1e3], lambda t, x, u, p: x + 0.0 * u, inputs="r", outputs="y", states=1
    )
    with pytest.raises(Exception) as caught:
        compared(lambda name, plan: joined(plan, singular))
    assert any("no equilibrium" in note and "initial_state=" in note for note in getattr(caught.value, "__notes__", ()))


@pytest.mark.slow
def test_each_draw_rests_at_its_own_parameters():
    table = {"c": np.array([2.0, 5.0])}
    first = {
        name: cp.Measure(name, of="run", function=lambda run, row=row: run.response.outputs[row][0])
        for name, row in (("first", 1), ("level", 0))
    }
    found = cp.monte_carlo(
        lambda name, plan: joined(plan, pi(), tank(), outputs=("y", "q")),
        table,
        {"move": move()},
        BEFORE,
        progress=False,
        outputs=["y"],
        controls=["q"],
        measures=first,
    )
    np.testing.assert_allclose(found.metrics["move"]["first"], table["c"] * math.sqrt(10.0), rtol=1e-7)
    np.testing.assert_allclose(found.metrics["move"]["level"], 10.0, rtol=1e-7)


def test_a_sweep_of_loops_without_an_equilibrium_says_so_as_well():
    """Integrators of the reference, many at once: as each by itself."""
    build = lambda k: ct.ss(0.0, k, 1.0, 0.0, inputs="r", outputs="y")  # noqa: E731
    with pytest.warns(UserWarning, match="no equilibrium .* initial_state="):
        swept = cp.sweep(build, [1.0, 2.0, 3.0], {"move": move()}, BEFORE, progress=False)
    with pytest.warns(UserWarning, match="no equilibrium"):
        alone = cp.compare(build(2.0), {"move": move()}, BEFORE)
    assert swept.metrics["move"]["iae"][1] == pytest.approx(alone.metrics["move"]["iae"], rel=1e-9)


def test_the_search_for_an_equilibrium_ends():
    """Rates that are noise have none: the search gives up after a known number of evaluations."""
    rng, calls = np.random.default_rng(0), []

    def rates(t, x, u, p):
        calls.append(t)
        return u - x + rng.standard_normal(3)

    noisy = ct.nlsys(rates, lambda t, x, u, p: x[:1], inputs="r", outputs="y", states=3, name="noisy")
    _, doubt = equilibrium_at(noisy, move(), 0.0, [0])
    assert doubt == "none was found by iteration"
    assert len(calls) < 20_000


def test_a_discrete_block_that_remembers_is_not_called():
    """What a trial call leaves behind in a user's block would change the run."""
    calls = []

    def update(t, x, u, p):
        calls.append(t)
        return 0.5 * x + 0.5 * u

    block = ct.nlsys(update, lambda t, x, u, p: x, inputs="r", outputs="y", states=1, dt=0.5, name="counting")
    _, doubt = equilibrium_at(block, move(), 0.0, [0])
    assert calls == []
    assert "counting" in doubt


@pytest.mark.slow
@pytest.mark.parametrize("initial", [10.0, 0.0])
def test_a_governor_holds_its_own_first_reference(initial):
    """The loop states nothing, the governor holds `initial`: at rest where that is the plan's first position."""
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    governor = cp.create_governor_iosystem(loop, 0.05, {"u": (-30.0, 30.0)}, initial=[initial])

    def build(name, plan):
        source = cp.create_source_iosystem(cp.stack([plan], labels=["r_cmd"]))
        exposed = cp.expose_states(loop)
        return ct.interconnect([source, governor, exposed], inputs=0, outputs=["y", "u", "r"])

    times = np.linspace(0.0, 12.0, 241)
    if initial == 10.0:
        assert output(compared(build, times=times, outputs=["y"]))[0] == pytest.approx(10.0, rel=1e-9)
    else:
        with pytest.warns(UserWarning, match="governor, a sampled block, cannot be computed"):
            compared(build, times=times, outputs=["y"])
