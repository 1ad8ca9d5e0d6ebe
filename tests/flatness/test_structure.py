"""Orders, extension and verdict of plants of textbooks, in any units; messages for plants that are not flat."""

import math

import control as ct
import numpy as np
import pytest

pytest.importorskip("casadi")

from flat_plants import CASES, ball, car, cart, pvtol, system, two_mass, unicycle
from repetitions import one_in

import ctrlplan as cp
from ctrlplan import NotFlatError

FLAT = {name: case for name, case in CASES.items() if case.orders}
NOT_FLAT = {name: case for name, case in CASES.items() if not case.orders}


def derived(case, plant=None, **options):
    return cp.flat_system(plant or case.plant, case.outputs, **{"at": case.at, **options})


@pytest.mark.parametrize("name", one_in(3, FLAT))
def test_orders_and_extension(name):
    case = FLAT[name]
    flat = derived(case)
    assert (flat.orders, flat.extension) == (case.orders, case.extension)
    assert sum(flat.orders) == case.plant.nstates + flat.extension


@pytest.mark.parametrize("case", NOT_FLAT.values(), ids=list(NOT_FLAT))
def test_internal_dynamics(case):
    with pytest.raises(NotFlatError, match=f"internal dynamics of dimension {case.internal}") as raised:
        derived(case)
    assert raised.value.internal == case.internal


def scaled(case, states, inputs, outputs, time):
    """The same plant in other units: x = states X, u = inputs U, y = outputs Y, t = time tau."""
    plant, n = case.plant, case.plant.nstates
    params = dict(plant.params)

    def full_units(x, u):
        return (np.array([v * size for v, size in zip(*pair, strict=True)]) for pair in ((x, states), (u, inputs)))

    def rates(t, x, u, _):
        full = plant.updfcn(0.0, *full_units(x, u), params)
        return [full[i] * (time / states[i]) for i in range(n)]

    def flat(x, u, _):
        x, u = full_units(x, u)
        if callable(case.outputs):
            rows = case.outputs(x, u, params)
        else:
            labels = list(plant.output_labels)
            measured = plant.outfcn(0.0, x, u, params) if plant.outfcn else x
            rows = [
                measured[labels.index(name)] if name in labels else x[plant.state_labels.index(name)]
                for name in case.outputs
            ]
        return [row / size for row, size in zip(rows, outputs, strict=True)]

    names = [*plant.state_labels]
    other = ct.nlsys(rates, None, states=names, inputs=plant.input_labels, outputs=names, name="scaled")
    size = dict(zip([*names, *plant.input_labels], [*states, *inputs], strict=True))
    return other, flat, {name: value / size[name] for name, value in case.at.items()}


@pytest.mark.parametrize("name", ["crane", "car", "trailer", "pvtol", "levitation, voltage", "machine"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_verdict_in_other_units(name, seed):
    check_units(name, seed)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
@pytest.mark.parametrize("seed", range(2, 4))
def test_verdict_of_all_plants_in_other_units(name, seed):
    check_units(name, seed)


def check_units(name, seed):
    """States, inputs, outputs and the unit of time times 1e-6 to 1e6."""
    case = CASES[name]
    rng = np.random.default_rng(seed)
    n, m = case.plant.nstates, case.plant.ninputs
    states, inputs, outputs = (10.0 ** rng.choice([-6.0, 0.0, 6.0], size) for size in (n, m, m))
    plant, flat, at = scaled(case, states, inputs, outputs, 10.0 ** rng.choice([-6.0, 6.0]))
    # In these units an equilibrium cannot be looked for from 0, as the rest of the operating point.
    known = derived(case).operating_point if case.orders else dict(case.at)
    sizes = dict(zip(case.plant.state_labels + case.plant.input_labels, [*states, *inputs], strict=True))
    at = {key: value / sizes[key] for key, value in known.items()} or at
    if case.orders:
        found = cp.flat_system(plant, flat, at=at)
        assert (found.orders, found.extension) == (case.orders, case.extension)
    else:
        with pytest.raises(NotFlatError) as raised:
            cp.flat_system(plant, flat, at=at)
        assert raised.value.internal == case.internal


def test_small_coefficients_count():
    weak = system("weak", "x v", "u", lambda x, v, u: [v, 1e-10 * u])
    assert cp.flat_system(weak, "x").orders == (2,)


def test_messages_name_the_reason():
    with pytest.raises(NotFlatError, match="no control has an effect on v"):
        cp.flat_system(system("apart", "x v", "u", lambda x, v, u: [u, -v]), "v")
    double = system("double", "x y v w", "a b", lambda x, y, v, w, a, b: [v, w, a, b])
    for other in (lambda x, u, p: [x[0], x[0]], lambda x, u, p: [x[0], x[0] ** 2], lambda x, u, p: [x[0], x[2]]):
        with pytest.raises(NotFlatError, match="y1, y2 and their derivatives depend on each other"):
            cp.flat_system(double, other)
    with pytest.raises(NotFlatError, match=r"do not determine 2 of its states.*dimension 2"):
        cp.flat_system(pvtol, ["x", "y"])


def test_direct_feedthrough():
    lag = system("lag", "x", "u", lambda x, u: [u - x])
    with pytest.raises(NotFlatError, match="dimension 1"):
        cp.flat_system(lag, lambda x, u, params: [x[0] + u[0]])
    strange = system("strange", "x1 x2 x3", "u1 u2", lambda x1, x2, x3, u1, u2: [u1, u2, u1 * u2])
    flat = cp.flat_system(strange, lambda x, u, params: [x[2] - x[0] * u[1], x[1]], at={"u1": 1.0, "u2": 0.7})
    assert (flat.orders, flat.extension) == ((2, 3), 2)


@pytest.mark.parametrize("plant", [cart, ball], ids=["cart", "ball"])
def test_plants_with_one_input_and_no_flat_output(plant):
    for name in plant.state_labels:
        with pytest.raises(NotFlatError, match="no output of this plant is flat"):
            cp.flat_system(plant, name)


def test_other_outputs_may_be_flat():
    with pytest.raises(NotFlatError) as raised:
        cp.flat_system(two_mass(2.0), "x2")
    assert "no output of this plant" not in str(raised.value)


def test_stability_of_the_internal_dynamics_is_stated():
    with pytest.raises(NotFlatError, match=r"stable .*-25"):
        cp.flat_system(two_mass(2.0), "x2")
    ahead = system("ahead", "x v", "u", lambda x, v, u: [v, u])
    with pytest.raises(NotFlatError, match="unstable"):
        cp.flat_system(ahead, lambda x, u, params: [x[0] - x[1]])


@pytest.mark.slow
def test_seed_and_repetition_do_not_matter():
    first, second = (derived(CASES["crane"]) for _ in range(2))
    np.random.default_rng(7).random(100)
    assert first.orders == second.orders
    jet = np.array([[2.0, 10.0], [0.1, 0.0], [0.2, 0.1], [0.0, 0.0], [0.0, 0.3]])[..., None]
    one, other = first.quantities(jet), second.quantities(jet)
    assert all(np.array_equal(one[key], other[key]) for key in one)


def test_operations_that_are_not_smooth_are_replaced_by_their_branch():
    rubbing = system("rubbing", "x v", "u", lambda x, v, u: [v, u - 0.3 * np.sign(v) - 0.1 * v * np.abs(v)])
    flat = cp.flat_system(rubbing, "x", at={"v": 2.0})
    assert flat.orders == (2,)
    assert any("sign of v" in note for note in flat.notes)
    plan = cp.PolySpline([cp.Waypoint(0.0, 0.0, 1.0), cp.Waypoint(1.0, 1.0, 1.0)], labels=["x"])
    _, u = flat.states_and_inputs(plan, [0.5])
    v, a = float(plan(0.5, 1)), float(plan(0.5, 2))
    assert u[0, 0] == pytest.approx(a + 0.3 + 0.1 * v * v, rel=1e-12)
    back = cp.PolySpline([cp.Waypoint(0.0, 0.0, 1.0), cp.Waypoint(1.0, 0.0, -1.0)], labels=["x"])
    with pytest.raises(ValueError, match=r"branch.*sign of v.* s"):
        flat.states_and_inputs(back, np.linspace(0.0, 1.0, 11))
    with pytest.raises(ValueError, match="sign of v at 0"):
        cp.flat_system(rubbing, "x")


def test_what_cannot_be_analysed():
    with pytest.raises(ValueError, match="continuous time"):
        cp.flat_system(ct.ss([[0.5]], [[1.0]], [[1.0]], 0.0, 0.1, name="sampled"), "y[0]")
    moving = ct.nlsys(lambda t, x, u, p: [x[1], u[0] * np.cos(t)], None, states=["x", "v"], inputs="u", outputs=2)
    with pytest.raises(ValueError, match=r"time.*v"):
        cp.flat_system(moving, "x")
    with pytest.raises(ValueError, match="remainder"):
        cp.flat_system(system("wheel", "x", "u", lambda x, u: [u + np.mod(x, 2.0)]), "x")
    with pytest.raises(ValueError, match="as many as the controls"):
        cp.flat_system(unicycle, ["x"])
    with pytest.raises(ValueError, match="'q'"):
        cp.flat_system(unicycle, ["x", "q"])
    with pytest.raises(ValueError, match="at must have names"):
        cp.flat_system(unicycle, ["x", "y"], at={"speed": 1.0})
    with pytest.raises(TypeError, match="flat_outputs must be given"):
        cp.flat_system(unicycle)
    delayed = ct.interconnect(
        [car, cp.create_delay_iosystem(0.1, inputs="order", outputs="v", name="line")],
        inputs=["order", "delta"],
        outputs=["x", "y", "th"],
        name="late",
    )
    with pytest.raises(ValueError, match="delay in block line"):
        cp.flat_system(delayed, ["x", "y"])


def test_interconnections_and_their_algebraic_loops():
    """Two masses from two blocks joined by a spring, without a loop; a gain in a loop with itself, solved."""
    motor = system("motor", "x1 v1", "u force", lambda x1, v1, u, force: [v1, u - force])
    load = system("load", "x2 v2", "push", lambda x2, v2, push: [v2, push / 2.0])
    spring = ct.nlsys(
        None,
        lambda t, x, u, p: [50.0 * (u[0] - u[1])] * 2,
        inputs=["x1", "x2"],
        outputs=["force", "push"],
        name="spring",
    )
    plant = ct.interconnect(
        [motor, load, spring], inputs=["u"], outputs=["x1", "v1", "x2", "v2"], name="joined", warn_duplicate=False
    )
    flat = cp.flat_system(plant, "x2")
    whole = cp.flat_system(two_mass(0.0), "x2")
    plan = cp.PolySpline([cp.Waypoint(0.0, 0.0, 0, 0, 0, 0), cp.Waypoint(2.0, 1.0, 0, 0, 0, 0)], labels=["x2"])
    t = np.linspace(0.0, 2.0, 21)
    np.testing.assert_allclose(flat.states_and_inputs(plan, t)[1], whole.states_and_inputs(plan, t)[1], atol=1e-10)
    lag = system("lag", "x", "e", lambda x, e: [e - x])
    gain = ct.nlsys(None, lambda t, x, u, p: [u[0] - 0.5 * u[1]], inputs=["r", "e"], outputs=["e"], name="gain")
    looped = ct.interconnect([lag, gain], inputs=["r"], outputs=["x"], name="looped", warn_duplicate=False)
    flat = cp.flat_system(looped, "x")  # e = r/1.5
    line = cp.PolySpline([cp.Waypoint(0.0, 0.0, 0), cp.Waypoint(1.0, 1.0, 0)], labels=["x"])
    _, u = flat.states_and_inputs(line, t[:10])
    np.testing.assert_allclose(u[0], 1.5 * (line(t[:10], 1) + line(t[:10])).ravel(), rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_inputs_that_are_not_controls_are_parameters():
    windy = cp.plants.Crane().iosystem(wind=True)
    flat = cp.flat_system(windy, ["x", "z"], inputs=["F", "C"], at={"R": 10.0, "wind": 0.0})
    assert flat.params["wind"] == 0.0
    assert any("wind is constant" in note for note in flat.notes)
    with pytest.raises(ValueError, match="name the controls with inputs="):
        cp.flat_system(windy, ["x", "z"], at={"R": 10.0})


def test_equations_that_divide_by_a_state_start_away_from_zero():
    """CasADi has an operation of its own for 1/x."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], 1.0 / x[0] + u[0] / x[0]], None, states=["gap", "v"], inputs=["u"], name="plant"
    )
    flat = cp.flat_system(plant, "gap")
    assert flat.orders == (2,)
    assert flat.operating_point["gap"] != 0.0
    assert flat.operating_point["u"] == pytest.approx(-1.0)


def test_names_of_parameters_and_scales_are_checked():
    plant = ct.nlsys(
        lambda t, x, u, p: [p["a"] * u[0] * p.get("b", 1.0)], None, states=1, inputs=1, params={"a": 2.0}, name="plant"
    )
    assert cp.flat_system(plant, "x[0]", params={"b": 3.0}).params == {"a": 2.0, "b": 3.0}
    with pytest.raises(ValueError, match=r"params must be among the parameters of plant \(a\), got 'c'"):
        cp.flat_system(plant, "x[0]", params={"c": 3.0})
    with pytest.raises(ValueError, match="scales"):
        cp.flat_system(plant, "x[0]", scales={"x": 3.0})


def test_functions_of_flat_outputs_follow_the_parameters():
    plant = ct.nlsys(
        lambda t, x, u, p: [p["a"] * x[1], u[0]], None, states=2, inputs=1, params={"a": 1.0, "b": 5.0}, name="plant"
    )
    flat = cp.flat_system(plant, lambda x, u, p: [p["a"] * p["b"] * x[0]], params={"a": 2.0})
    for a in (2.0, 3.0):
        found = flat.forward([1.0, 1.0], [1.0], {"a": a})[0]
        np.testing.assert_allclose(found, [5.0 * a, 5.0 * a * a, 5.0 * a * a], rtol=1e-15)


def test_signals_that_pass_a_block_many_times():
    """Forty channels of one block in series: a chain without a loop."""
    count = 40
    amplifier = ct.nlsys(None, lambda t, x, u, p: u, inputs=count, outputs=count, name="A")
    plant = ct.nlsys(lambda t, x, u, p: [u[0]], None, states=["x"], inputs=["u"], outputs=["x"], name="P")
    chain = [[f"A.u[{k + 1}]", f"A.y[{k}]"] for k in range(count - 1)]
    system = ct.interconnect(
        [amplifier, plant],
        connections=[*chain, ["P.u", f"A.y[{count - 1}]"]],
        inplist=["A.u[0]"],
        inputs=["u"],
        outlist=["P.x"],
        outputs=["x"],
    )
    assert cp.flat_system(system, "x").orders == (1,)


def test_flat_outputs_do_not_take_the_name_of_another_signal():
    plant = ct.nlsys(lambda t, x, u, p: [x[1], u[0]], None, states=["y", "v"], inputs=["u"], name="plant")
    assert cp.flat_system(plant, lambda x, u, p: [x[0]]).flat_labels == ("y",)
    flat = cp.flat_system(plant, lambda x, u, p: [2.0 * x[0]])
    assert flat.flat_labels == ("flat_y",)
    plan = cp.PolySpline([cp.Waypoint(0.0, 0.0, 0.0, 0.0), cp.Waypoint(1.0, 2.0, 0.0, 0.0)])
    found = cp.simulate(cp.flat_loop(flat, plan, poles=[-3.0, -4.0]), [0.0, 1.0])
    assert found.outputs["flat_y"][-1] == pytest.approx(2.0)
    assert found.outputs["y"][-1] == pytest.approx(1.0)


def test_inputs_that_are_not_controls_and_parameters_have_different_names():
    plant = ct.nlsys(
        lambda t, x, u, p: [u[0] + p["wind"] * u[1]],
        None,
        states=["v"],
        inputs=["F", "wind"],
        params={"wind": 3.0},
        name="plant",
    )
    with pytest.raises(ValueError, match="names of parameters, got wind of plant"):
        cp.flat_system(plant, "v", inputs="F")


def _by_math(t, x, u, p):
    return [math.sin(x[0]) + u[0]]


def _by_branch(t, x, u, p):
    if x[0] > 0.0:
        return [u[0]]
    return [2.0 * u[0]]


def _without_parameter(t, x, u, p):
    return [p["k"] * x[0] + u[0]]


@pytest.mark.parametrize(
    ("update", "line"),
    [
        (_by_math, r"TypeError.* in test_structure\.py, line \d+: return \[math\.sin"),
        (_by_branch, r"branch on a signal.* line \d+: if x\[0\] > 0\.0:"),
        (_without_parameter, r"KeyError: 'k', in test_structure\.py, line \d+: return \[p\["),
    ],
)
def test_blocks_that_cannot_be_traced_are_named_with_the_line(update, line):
    plant = ct.nlsys(update, None, states=["x"], inputs=["u"], name="plant")
    with pytest.raises(ValueError, match=f"block plant cannot be .*{line}"):
        cp.flat_system(plant, "x")


@pytest.mark.parametrize(
    ("outputs", "reason"),
    [
        (lambda x, u, p: [x[9]], r"IndexError: .*, in test_structure\.py, line \d+"),
        (lambda x, u, p: [math.sin(x[0])], r"TypeError: .* line \d+: \(lambda x, u, p: \[math"),
        (lambda x, u: [x[0]], r"takes 2 positional arguments but 3 were given$"),
        (lambda x, u, p: None, r"'NoneType'$"),
    ],
)
def test_functions_of_flat_outputs_that_fail_are_named_with_the_line(outputs, reason):
    with pytest.raises(TypeError, match=rf"flat_outputs must be a function h\(x, u, params\) .*{reason}"):
        cp.flat_system(two_mass(0.0), outputs)


def test_parameters_that_are_no_numbers_and_systems_without_states():
    plant = ct.nlsys(lambda t, x, u, p: [u[0] / p["m"]], None, states=["v"], inputs=["F"], params={"m": 2.0}, name="p")
    with pytest.raises(ValueError, match=r"params\['m'\] must be finite, got nan"):
        cp.flat_system(plant, "v", params={"m": np.nan})
    with pytest.raises(ValueError, match="finite"):
        cp.flat_system(plant, "v", params={"m": 0.0})
    with pytest.raises(ValueError, match="system must have states and inputs, got 0 and 1"):
        cp.flat_system(ct.ss([], [], [], [[1.0]]))


def test_smooth_functions_take_the_place_of_operations_at_their_kink():
    """A vehicle under water with quadratic drag that begins at rest, as the error says."""

    def plant(size):
        return system("diver", "x v", "F", lambda x, v, F: [v, (F - 30.0 * v * size(v)) / 50.0])

    with pytest.raises(ValueError, match=r"abs of v at 0; .*, such as np\.sqrt\(x\*\*2 \+ d\*\*2\) for abs"):
        cp.flat_system(plant(np.abs), "x")
    flat = cp.flat_system(plant(lambda v: np.sqrt(v**2 + 1e-8)), "x")
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0), cp.Waypoint(4, 0, 0, 0)], labels="x")
    t = np.linspace(0.0, 4.0, 41)
    _, v, a = plan.jet(t, 2)[:, 0]
    _, force = flat.states_and_inputs(plan, t)
    np.testing.assert_allclose(force[0], 50.0 * a + 30.0 * v * np.sqrt(v**2 + 1e-8), atol=1e-10)
