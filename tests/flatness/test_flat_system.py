"""The flat-system interface on plants in closed form: shapes, the plant's own equations, bad input."""

import math
from itertools import pairwise

import control.flatsys as fs
import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from numpy.polynomial.chebyshev import chebpts1

import ctrlplan as cp
from ctrlplan.flatness import FlatSystem
from ctrlplan.systems.plants.integrator_chain import integrator_chain


def load_plan(start=0.0, labels=("x", "z")):
    """Rest to rest with four derivatives zero at the ends, and a waypoint passed in motion."""
    points = [(0.0, [0.0, 10.0]), (4.0, [9.0, 9.0]), (9.0, [12.0, 11.0])]
    rest = [[0.0, 0.0]] * 4
    given = [rest, [], rest]
    points = [cp.Waypoint(start + t, p, *d) for (t, p), d in zip(points, given, strict=True)]
    return cp.PolySpline(points, labels=list(labels))


def turn(order, labels=None):
    rest = [0.0] * (order - 1)
    points = [cp.Waypoint.from_jets(0.0, y=[0.0, *rest]), cp.Waypoint.from_jets(2.0, y=[1.5, *rest])]
    return cp.PolySpline(points, labels=labels)


CASES = {
    "crane": (cp.plants.Crane().flat_system(), load_plan(), (4, 4), 2, ("x", "z")),
    "crane, rope wrapped": (cp.plants.Crane(rope_wrap=True).flat_system(), load_plan(), (4, 4), 2, ("x", "z")),
    "motor": (cp.plants.dc_motor(), turn(4), (3,), 0, ("angle",)),
    "joint": (cp.plants.flexible_joint(), turn(5), (4,), 0, ("q1",)),
    "chains": (integrator_chain(2, 2), cp.stack([turn(3), turn(3)], labels=["y1", "y2"]), (2, 2), 0, ("y1", "y2")),
}
each_plant = pytest.mark.parametrize(("flat", "plan", "orders", "extension", "labels"), CASES.values(), ids=list(CASES))
each_pair = pytest.mark.parametrize(("flat", "plan"), [case[:2] for case in CASES.values()], ids=list(CASES))


@each_plant
def test_what_the_system_states(flat, plan, orders, extension, labels):
    assert isinstance(flat, FlatSystem)
    assert isinstance(flat, fs.FlatSystem)
    assert (flat.orders, flat.extension, flat.flat_labels) == (orders, extension, labels)
    assert sum(flat.orders) == flat.nstates + flat.extension


@each_pair
def test_states_and_inputs_obey_the_equations_of_motion(flat, plan):
    """x' = f(x, u), with x' from interpolants of degree 39 on eighths of each segment, which converge to rounding."""
    edges = [np.linspace(*ends, 9) for ends in pairwise(plan.breakpoints)]
    for first, last in (panel for row in edges for panel in pairwise(row)):
        t = first + (last - first) * (chebpts1(40) + 1.0) / 2.0
        x, u = flat.states_and_inputs(plan, t)
        rates = np.array([Chebyshev.fit(t, row, 39).deriv()(t) for row in x])
        found = np.array([flat.dynamics(now, *both) for now, *both in zip(t, x.T, u.T, strict=True)]).T
        size = np.abs(rates).max(axis=1, keepdims=True) + np.abs(x).max(axis=1, keepdims=True) + 1e-3
        np.testing.assert_allclose(found / size, rates / size, atol=1e-8)


@each_pair
def test_reverse_undoes_forward(flat, plan):
    """`forward` comes from the equations of motion, `reverse` from the flat output alone."""
    x, u = flat.states_and_inputs(plan, np.linspace(plan.start, plan.end, 9)[1:-1])
    for state, inputs in zip(x.T, u.T, strict=True):
        flag = flat.forward(state, inputs)
        assert [len(row) - 1 for row in flag] == list(flat.orders)
        again = flat.reverse(flag)
        np.testing.assert_allclose(again[0], state, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(again[1], inputs, rtol=1e-9, atol=1e-7)


@each_pair
def test_many_times_in_one_call_are_the_same_numbers(flat, plan):
    t = np.linspace(plan.start - 1.0, plan.end + 1.0, 12).reshape(3, 4)
    x, u = flat.states_and_inputs(plan, t)
    assert (x.shape, u.shape) == ((flat.nstates, 3, 4), (flat.ninputs, 3, 4))
    for where in np.ndindex(t.shape):
        one, inputs = flat.states_and_inputs(plan, t[where])
        assert (one.shape, inputs.shape) == ((flat.nstates,), (flat.ninputs,))
        np.testing.assert_allclose(one, x[(slice(None), *where)], rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(inputs, u[(slice(None), *where)], rtol=1e-12, atol=1e-10)
    assert flat.states_and_inputs(plan, [])[0].shape == (flat.nstates, 0)


@each_pair
def test_quantities_are_the_states_and_inputs_by_name(flat, plan):
    t = np.linspace(plan.start, plan.end, 11)
    found = flat.quantities(plan.jet(t, max(flat.orders)))
    x, u = flat.states_and_inputs(plan, t)
    for name, row in zip([*flat.state_labels, *flat.input_labels], [*x, *u], strict=True):
        np.testing.assert_array_equal(found[name], row)
    short = flat.quantities(plan.jet(t, max(flat.orders) - 1))
    assert set(flat.state_labels) <= set(short)
    assert not set(flat.input_labels) & set(short)
    for name, row in zip(flat.state_labels, x, strict=True):
        np.testing.assert_allclose(short[name], row, rtol=1e-13, atol=1e-13)


@each_pair
def test_outside_its_interval_a_plan_is_held(flat, plan):
    x, u = flat.states_and_inputs(plan, [plan.start - 5.0, plan.start, plan.end, plan.end + 5.0])
    np.testing.assert_allclose(x[:, [0, 3]], x[:, [1, 2]], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(u[:, [0, 3]], u[:, [1, 2]], rtol=1e-9, atol=1e-6)


@each_pair
def test_python_control_plans_on_it(flat, plan):
    """`point_to_point` from rest to rest with a polynomial of just enough coefficients is the spline."""
    x, u = flat.states_and_inputs(plan, [plan.start, plan.end])
    count = 2 * (max(flat.orders) + 1)
    basis = fs.PolyFamily(count, T=plan.duration)
    found = fs.point_to_point(flat, plan.duration, x[:, 0], u[:, 0], x[:, 1], u[:, 1], basis=basis)
    order = max(flat.orders) + 1
    ends = [
        cp.Waypoint(t, plan(t), *[np.zeros(plan.naxes)] * (order - 1)) for t in (plan.start, plan.end)
    ]  # held inputs: every derivative of the flat output is zero at equilibrium
    straight = cp.PolySpline(ends, labels=list(plan.labels))
    t = np.linspace(0.0, plan.duration, 9)
    states, inputs = found.eval(t)
    expected = flat.states_and_inputs(straight, t)
    for got, wanted in zip((states, inputs), expected, strict=True):
        size = np.abs(wanted).max(axis=1, keepdims=True) + 1e-6
        np.testing.assert_allclose(got / size, wanted / size, atol=1e-6)


# Plans and their axes


def test_axes_are_taken_by_name():
    flat, plan = CASES["crane"][:2]
    swapped = plan.select(["z", "x"])
    np.testing.assert_array_equal(flat.states_and_inputs(swapped, 2.0)[0], flat.states_and_inputs(plan, 2.0)[0])
    unnamed = load_plan(labels=("y1", "y2"))
    np.testing.assert_array_equal(flat.states_and_inputs(unnamed, 2.0)[0], flat.states_and_inputs(plan, 2.0)[0])
    with pytest.raises(ValueError, match=r"plan must have the axes x, z, the flat outputs of crane, got a, b"):
        flat.states_and_inputs(load_plan(labels=("a", "b")), 2.0)
    with pytest.raises(ValueError, match=r"axes x, z, .*, got y"):
        flat.states_and_inputs(turn(5), 2.0)
    with pytest.raises(TypeError, match="plan must be a Trajectory, got list"):
        flat.states_and_inputs([1.0], 2.0)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(
    ("times", "both_sides"), [([0.5, 1.5], True), ([0.5, 1.0], True), ([0.5, 0.9], False), ([1.0, 1.5], False)]
)
def test_a_jump_counts_where_the_times_are_on_both_sides_of_it(order, times, both_sides):
    """0, then (t - 1)^order: its derivative of that order jumps by order!; the motor needs those below 3 continuous."""
    motor = cp.plants.dc_motor()
    powers = lambda t: [math.perm(order, k) * (t - 1.0) ** max(order - k, 0) for k in range(4)]  # noqa: E731
    moving = cp.PolySpline([cp.Waypoint(t, *powers(t)) for t in (1.0, 2.0)])
    plan = cp.PolySpline([cp.Waypoint(t, 0.0, 0.0) for t in (0.0, 1.0)]).then(moving)
    if both_sides and order < 3:
        wanted = (
            rf"continuous up to derivative 2 of y .* whose derivative {order} jumps by {math.factorial(order)} at 1 s"
        )
        with pytest.raises(ValueError, match=wanted):
            motor.states_and_inputs(plan, times)
    else:
        x, _ = motor.states_and_inputs(plan, times)
        np.testing.assert_allclose(x[0], [max(t - 1.0, 0.0) ** order for t in times], atol=1e-12)


def test_a_plan_that_starts_in_motion_is_taken_on_its_interval_only():
    motor = cp.plants.dc_motor()
    moving = cp.PolySpline([cp.Waypoint(0.0, 0.0, 1.0, 0.0), cp.Waypoint(1.0, 1.0, 2.0, 0.0)])
    x, _ = motor.states_and_inputs(moving, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(x[1, [0, 2]], [1.0, 2.0], rtol=1e-12)
    for outside, where in ((-0.1, "0"), (1.1, "1")):
        with pytest.raises(ValueError, match=rf"whose derivative 1 jumps by .* at {where} s"):
            motor.states_and_inputs(moving, [outside, 0.5])


def test_times_and_starts_of_a_wrong_kind():
    flat, plan = CASES["crane"][:2]
    with pytest.raises(ValueError, match="times must not be nan"):
        flat.states_and_inputs(plan, [0.0, np.nan])
    with pytest.raises(ValueError, match="timepts must be finite"):
        flat.states_and_inputs(plan, [0.0, np.inf])
    with pytest.raises(ValueError, match=r"start must have the shape \(6,\), got \(2,\)"):
        flat.states_and_inputs(plan, 0.0, start=[0.0, 1.0])
    same = flat.states_and_inputs(plan, 1.0, start=flat.states_and_inputs(plan, 0.0)[0])
    np.testing.assert_array_equal(same[0], flat.states_and_inputs(plan, 1.0)[0])


def test_a_slack_rope_is_named():
    drop = cp.PolySpline(
        [
            cp.Waypoint.from_jets(0.0, x=[0, 0, 0, 0, 0], z=[10, 0, 0, 0, 0]),
            cp.Waypoint.from_jets(1.0, x=[0, 0, 0, 0, 0], z=[20, 0, 0, 0, 0]),
        ]
    )
    with pytest.raises(ValueError, match="g - z'' must be above 0 for a taut rope"):
        CASES["crane"][0].states_and_inputs(drop, np.linspace(0, 1, 21))


# Systems written by hand


def unicycle(**changes):
    """Speed and heading from x' and y'; a quotient is undetermined at rest."""

    def reverse(flag, params=None):
        (x, vx, *_), (y, vy, *_) = flag
        with np.errstate(invalid="ignore", divide="ignore"):
            heading = 2.0 * np.arctan(vy / (vx + np.hypot(vx, vy)))
        return np.array([x, y, heading]), np.array([np.hypot(vx, vy), 0.0 * vx])

    given = {
        "orders": (2, 2),
        "flat_labels": ("x", "y"),
        "states": ["x", "y", "heading"],
        "inputs": ["v", "w"],
        "outputs": ["x", "y", "heading"],
        "name": "unicycle",
    }
    motion = lambda t, x, u, params: np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[1]])  # noqa: E731
    return FlatSystem(lambda x, u, params=None: [], reverse, motion, lambda t, x, u, params: x, **given | changes)


def test_a_signal_that_the_plan_does_not_determine_is_named_with_its_time():
    flat = unicycle()
    assert flat.extension == 1
    move = cp.PolySpline([cp.Waypoint(3, [0, 0], [0, 0], [0, 0]), cp.Waypoint(5, [1, 1], [0, 0], [0, 0])])
    with pytest.raises(ValueError, match=r"heading of unicycle must be determined by the plan, got nan at 5 s"):
        flat.states_and_inputs(move, [4.0, 5.0])
    x, u = flat.states_and_inputs(move, 4.0)
    assert x[2] == pytest.approx(np.pi / 4)
    assert u[0] == pytest.approx(np.hypot(*move(4.0, 1)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"orders": (2,)}, r"orders must be one of at least 1 for each of 2 inputs, got \(2,\)"),
        ({"orders": (2, 0)}, r"orders must be one of at least 1"),
        ({"orders": (1, 1)}, r"orders must add up to at least the number of states, 3, got 2"),
        ({"flat_labels": ("x",)}, "labels must be one per axis, 2, got 1"),
        ({"flat_labels": ("x", "x")}, "labels must be unique"),
    ],
)
def test_what_a_flat_system_must_state(changes, message):
    with pytest.raises(ValueError, match=message):
        unicycle(**changes)


def test_jets_of_a_wrong_shape():
    with pytest.raises(ValueError, match=r"order of 1 for states and 2 for inputs, got \(2, 3, 4\)"):
        unicycle().quantities(np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match=r"got \(1, 2, 4\)"):
        unicycle().quantities(np.zeros((1, 2, 4)))
