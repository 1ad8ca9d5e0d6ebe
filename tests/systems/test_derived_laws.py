"""Tracking laws derived from equations: error equations in closed form, and the crane's law written by hand."""

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

pytest.importorskip("casadi")

from flat_plants import ARM, CASES, INERTIA, MASS, huygens, pvtol, quadrotor, two_mass

import ctrlplan as cp

FAST, SLOW = [-2.0, -2.5, -3.0, -3.5], [-2.0, -3.0]


def move(labels, ends, starts, order=4, duration=3.0):
    jets = [{label: [p, *[0.0] * order] for label, p in zip(labels, row, strict=True)} for row in (starts, ends)]
    return cp.PolySpline([cp.Waypoint.from_jets(t, **jet) for t, jet in zip((0.0, duration), jets, strict=True)])


def error(poles, first, t):
    """Solution of the error equation from the derivatives `first` at time 0."""
    n = len(poles)
    matrix = np.zeros((n, n))
    matrix[:-1, 1:] = np.eye(n - 1)
    matrix[-1] = -np.real(np.poly(poles))[:0:-1]
    return np.array([(expm(matrix * s) @ np.array(first))[0] for s in t])


def run(plant, flat, law, plan, start, t, params=None, **options):
    source = cp.create_source_iosystem(plan, max(flat.orders), suffix="_ref")
    names = [*plant.output_labels, *flat.input_labels]
    unused = [f"plan.{label}" for label in source.output_labels if label not in law.input_labels]
    loop = ct.interconnect([source, law, plant], inputs=0, outputs=names, name="loop", ignore_outputs=unused)
    own = cp.traits_of(law).initial_state
    return cp.simulate(loop, t, initial_state=[*(own if law.nstates else []), *start], params=params, **options)


CRANE = cp.plants.Crane()
T = np.linspace(0.0, 6.0, 61)


def crane_case():
    flat = cp.flat_system(CRANE.iosystem(), ["x", "z"], at={"R": 10.0})
    plan = move(["x", "z"], [5.0, 10.5], [0.0, 10.0], duration=5.0)
    start = CRANE.equilibrium(0.3, 10.2)[0]
    return CRANE.iosystem(), flat, plan, start, [0.3, 0.2], lambda found: (found.outputs["x"], found.outputs["z"])


def pvtol_case():
    a = INERTIA / (MASS * ARM)
    flat = cp.flat_system(pvtol, huygens)
    plan = move(["y1", "y2"], [4.0, 1.0], [0.0, a])

    def read(found):
        return huygens([found.outputs[name] for name in pvtol.output_labels], None, None)

    return pvtol, flat, plan, [0.1, 0.05, 0.0, 0.0, 0.0, 0.0], [0.1, 0.05], read


def quadrotor_case():
    labels = ["px", "py", "pz", "yaw"]
    flat = cp.flat_system(quadrotor, labels)
    plan = move(labels, [3.0, 1.0, 1.0, 1.2], [0.0] * 4)
    start = np.zeros(12)
    start[:3] = 0.1, -0.05, 0.05
    return quadrotor, flat, plan, start, [0.1, -0.05, 0.05, 0.0], lambda found: [found.outputs[n] for n in labels]


def one_output():
    flat = cp.flat_system(two_mass(0.0), "x2")
    plan = move(["x2"], [1.0], [0.0], order=5)
    return two_mass(0.0), flat, plan, [0.1, 0.0, 0.1, 0.0], [0.1], lambda found: [found.outputs["x2"]]


QUICK = {
    "crane": (crane_case, False, [FAST, FAST]),
    "crane, quasi-static": (crane_case, True, [FAST, SLOW]),
    "pvtol, quasi-static": (pvtol_case, True, [FAST, SLOW]),
    "two masses": (one_output, False, [FAST]),
}
SLOWER = {
    "pvtol": (pvtol_case, False, [FAST, FAST]),
    "quadrotor": (quadrotor_case, False, [FAST, FAST, FAST, SLOW]),
    "quadrotor, quasi-static": (quadrotor_case, True, [FAST, FAST, SLOW, SLOW]),
}


@pytest.mark.parametrize(
    ("make", "quasi_static", "poles"),
    [*QUICK.values(), *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOWER.values())],
    ids=[*QUICK, *SLOWER],
)
def test_errors_decay_with_the_poles(make, quasi_static, poles):
    """From rest near the start of the plan: the states of the extension are those of rest."""
    plant, flat, plan, start, first, read = make()
    law = cp.create_flat_iosystem(flat, poles, quasi_static=quasi_static)
    assert law.nstates == (0 if quasi_static else flat.extension)
    found = run(plant, flat, law, plan, start, T, method="compiled", rtol=1e-10)
    for row, wanted, e0, roots in zip(read(found), np.atleast_2d(plan(T)), first, poles, strict=True):
        expected = error(roots, [e0, *[0.0] * (len(roots) - 1)], T)
        np.testing.assert_allclose(row - wanted, expected, atol=1e-7)


@pytest.mark.slow
def test_number_of_poles_is_stated():
    flat = cp.flat_system(CRANE.iosystem(), ["x", "z"], at={"R": 10.0})
    with pytest.raises(ValueError, match=r"poles\[1\]") as raised:
        cp.create_flat_iosystem(flat, [FAST, FAST], quasi_static=True)
    assert "2" in str(raised.value)
    for poles in ([[-1.0] * 3, FAST], [FAST], [[-1.0, -2.0, -3.0, 0.5], FAST], [[-1.0, -2.0, -3.0, -1 + 1j], FAST]):
        with pytest.raises(ValueError, match="poles"):
            cp.create_flat_iosystem(flat, poles)


@pytest.mark.slow
def test_the_law_is_that_of_the_crane_written_by_hand():
    """From corresponding starts, tension m g at rest: the same controls along a plan, from an error."""
    plant, flat, plan, start, _, _ = crane_case()
    derived = cp.create_flat_iosystem(flat, [FAST, FAST])
    by_hand = cp.plants.create_dynamic_law_iosystem(CRANE, FAST)
    found = run(plant, flat, derived, plan, start, T, method="compiled", rtol=1e-10)
    source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    names = [*plant.output_labels, "F", "C"]
    loop = ct.interconnect([source, by_hand, CRANE.iosystem()], inputs=0, outputs=names, name="by_hand")
    known = cp.simulate(loop, T, initial_state=[0.0, 0.0, *start], method="compiled", rtol=1e-10)
    for name in ("x", "z", "F", "C", "T"):
        size = np.ptp(known.outputs[name])
        np.testing.assert_allclose(found.outputs[name] / size, known.outputs[name] / size, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("quasi_static", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_integral_action_leaves_no_steady_offset(quasi_static):
    """Payload 10 % heavier than the law knows: with the integral the load reaches its place."""
    plant, flat, plan, start, _, _ = crane_case()
    t = np.linspace(0.0, 25.0, 26)
    offsets = {}
    for integral in (False, True):
        poles = [FAST + [-1.5] * integral, (SLOW if quasi_static else FAST) + [-1.5] * integral]
        law = cp.create_flat_iosystem(flat, poles, quasi_static=quasi_static, integral=integral)
        heavy = {"load_mass": 1.1 * CRANE.load_mass}
        found = run(plant, flat, law, plan, start, t, params=heavy, method="compiled")
        offsets[integral] = abs(found.outputs["z"][-1] - 10.5)
    assert offsets[False] > 0.05
    assert offsets[True] < 1e-6


@pytest.mark.slow
def test_the_extension_starts_where_it_is_told_to():
    flat = cp.flat_system(CRANE.iosystem(), ["x", "z"], at={"R": 10.0})
    law = cp.create_flat_iosystem(flat, [FAST, FAST], start=[600.0, 3.0])
    np.testing.assert_array_equal(cp.traits_of(law).initial_state, [600.0, 3.0])
    for wrong in ([1.0], [1.0, np.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match="start"):
            cp.create_flat_iosystem(flat, [FAST, FAST], start=wrong)
    wheel = cp.flat_system(CASES["unicycle"].plant, ["x", "y"], at={"v": 1.0})
    for speed in (0.0, 1e-9):
        with pytest.raises(ValueError, match=r"start must be .* at which the law of unicycle is regular"):
            cp.create_flat_iosystem(wheel, [[-1.0, -2.0]] * 2, start=[speed])


def test_labels_and_suffix_name_the_references():
    flat = cp.flat_system(two_mass(0.0), "x2")
    law = cp.create_flat_iosystem(flat, FAST, labels="load", suffix="_d")
    assert law.input_labels == ["load_d", *(f"load_d_d{k}" for k in range(1, 5)), "x1", "v1", "x2", "v2"]
    with pytest.raises(ValueError, match="names of states"):
        cp.create_flat_iosystem(flat, FAST, suffix="")


@pytest.mark.slow
def test_python_control_simulates_the_loop_as_well():
    """It evaluates all blocks with zero signals first, where the maps are singular."""
    plant, flat, plan, start, _, _ = crane_case()
    law = cp.create_flat_iosystem(flat, [FAST, SLOW], quasi_static=True)
    source = cp.create_source_iosystem(plan, 4, suffix="_ref")
    loop = ct.interconnect([source, law, plant], inputs=0, outputs=plant.output_labels, name="loop")
    t = np.linspace(0.0, 0.5, 3)
    ours = cp.simulate(loop, t, initial_state=start)
    theirs = ct.input_output_response(loop, t, 0.0, start, solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-8})
    np.testing.assert_allclose(ours.outputs["x"], theirs.outputs[0], atol=1e-6)


def test_no_quasi_static_law_where_a_control_is_prolonged():
    coupled = ct.nlsys(
        lambda t, x, u, p: [
            x[3],
            x[4],
            x[5],
            -np.sin(x[2]) * (u[0] ** 2 + u[1] ** 2 + 0.1 * u[0] * u[1]),
            np.cos(x[2]) * (u[0] ** 2 + u[1] ** 2 + 0.1 * u[0] * u[1]) - 9.81,
            5.0 * (u[1] ** 2 - u[0] ** 2),
        ],
        None,
        states=["x", "z", "th", "vx", "vz", "w"],
        inputs=["left", "right"],
        outputs=["x", "z", "th", "vx", "vz", "w"],
        name="coupled",
    )
    flat = cp.flat_system(coupled, ["x", "z"], at={"th": 0.0})
    assert (flat.orders, flat.extension) == ((5, 5), 4)
    with pytest.raises(ValueError, match="quasi_static must be False"):
        cp.create_flat_iosystem(flat, [FAST, SLOW], quasi_static=True)


def test_every_plant_of_the_table_has_a_law():
    for name in ("levitation, voltage", "flexible joint", "two-link arm", "car"):
        flat = cp.flat_system(CASES[name].plant, CASES[name].outputs, at=CASES[name].at)
        law = cp.create_flat_iosystem(flat, [[-1.0 - 0.5 * k for k in range(r)] for r in flat.orders])
        assert law.noutputs == flat.ninputs


def test_references_and_states_all_zero_need_their_input_too():
    """A lift at height 0, and a vehicle that hovers at the origin: their weight is carried there as well."""
    lift = ct.nlsys(lambda t, x, u, p: [x[1], u[0] - 9.81], None, states=["h", "v"], inputs=["a"], name="lift")
    flat = cp.flat_system(lift, "h")
    for integral in (False, True):
        law = cp.create_flat_iosystem(flat, [-1.0, -2.0, -3.0][: 2 + integral], integral=integral)
        own = np.zeros(law.nstates or 0)
        assert law.output(0.0, own, np.zeros(law.ninputs)).tolist() == [9.81]
    block = cp.create_flat_feedforward_iosystem(flat)
    assert block.output(0.0, np.zeros(0), np.zeros(3)).tolist() == [0.0, 0.0, 9.81]
    states = ["x", "z", "th", "vx", "vz", "w"]
    hover = ct.nlsys(
        lambda t, x, u, p: [x[3], x[4], x[5], -np.sin(x[2]) * u[0], np.cos(x[2]) * u[0] - 9.81, u[1]],
        None,
        states=states,
        inputs=["lift", "turn"],
        outputs=states,
        name="hover",
    )
    flat = cp.flat_system(hover, ["x", "z"])
    for quasi_static in (False, True):
        law = cp.create_flat_iosystem(flat, [FAST, SLOW if quasi_static else FAST], quasi_static=quasi_static)
        own = cp.traits_of(law).initial_state if law.nstates else np.zeros(0)
        np.testing.assert_allclose(law.output(0.0, own, np.zeros(law.ninputs)), [9.81, 0.0], atol=1e-14)


def test_a_plan_with_the_default_labels_reaches_the_law():
    flat = cp.flat_system(two_mass(0.0), "x2")
    plan = cp.PolySpline([cp.Waypoint(0, 0, *[0] * 4), cp.Waypoint(1, 2, *[0] * 4)])
    loop = cp.flat_loop(flat, plan, poles=[-2.0, -3.0, -4.0, -5.0])
    found = cp.simulate(loop, [0.0, 0.5, 1.0], rtol=1e-10)
    np.testing.assert_allclose(found.outputs["x2"], plan(found.time), atol=1e-7)


def test_flat_outputs_of_different_orders_give_a_loop_without_warnings():
    motors = ct.nlsys(
        lambda t, x, u, p: [x[1], u[0], u[1]], None, states=["a", "va", "b"], inputs=["ua", "ub"], name="motors"
    )
    flat = cp.flat_system(motors, ["a", "b"])
    assert flat.orders == (2, 1)
    loop = cp.flat_loop(flat, move(["a", "b"], [1.0, 2.0], [0.0, 0.0]), poles=[[-1.0, -2.0], [-3.0]])
    assert cp.simulate(loop, [0.0, 3.0]).outputs["b"][-1] == pytest.approx(2.0, abs=1e-6)


def test_a_law_without_states_is_rejected_near_its_singular_heading():
    """A quarter turn of a car whose speed is determined by x only."""
    flat = cp.flat_system(CASES["unicycle"].plant, ["x", "y"], at={"v": 1.0})
    poles = [[-1.0], [-1.0, -2.0]]
    law = cp.FlatLaw(poles, quasi_static=True)
    for turn, good in ((1.4, True), (1.5, False), (2.0, False)):
        w = turn / 5.0
        t = np.linspace(0.0, 5.0, 11)
        arc = [
            cp.Waypoint.from_jets(
                s,
                x=[np.sin(w * s) / w, np.cos(w * s), -w * np.sin(w * s), -w * w * np.cos(w * s)],
                y=[(1.0 - np.cos(w * s)) / w, np.sin(w * s), w * np.cos(w * s), -w * w * np.sin(w * s)],
            )
            for s in t
        ]
        plan = cp.PiecewiseSpline(arc)
        if good:
            found = cp.simulate(cp.flat_loop(flat, plan, law=law), t, rtol=1e-10)
            np.testing.assert_allclose([found.outputs["x"], found.outputs["y"]], plan(t), atol=1e-6)
        else:
            with pytest.raises(ValueError, match=r"quasi_static must be False for this plan of unicycle.* law with st"):
                cp.flat_loop(flat, plan, law=law)
            assert cp.flat_loop(flat, plan, poles=[[-1.0, -2.0]] * 2).nstates == 4
