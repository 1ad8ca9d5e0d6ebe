"""The command filter against its transfer function and the gamma distribution; its gains; in a loop."""

import math
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.special import gammainc
from scipy.stats import gamma

import ctrlplan as cp
from ctrlplan.systems import command_filter_gains
from ctrlplan.systems.plants import Crane, crane_loop

CASES = [(0.7, 0, 1), (2.0, 0, 3), (3.0, 1, 2), (2.0, 2, 3), (5.0, 2, 5), (0.5, 3, 4), (10.0, 4, 5)]
cases = pytest.mark.parametrize(("w", "derivatives", "order"), CASES)


@cases
def test_each_output_is_a_power_of_s_times_the_filter(w, derivatives, order):
    """s^k/(s/w + 1)^n at ten complex frequencies."""
    block = cp.create_command_filter_iosystem(w, derivatives, order)
    for s in w * np.exp(1j * np.linspace(-1.5, 1.5, 10)):
        found = np.atleast_2d(block(s))[:, 0]
        wanted = [s**k / (s / w + 1) ** order for k in range(derivatives + 1)]
        assert np.abs(found - wanted).max() <= 1e-11 * np.abs(wanted).max()


@cases
def test_all_poles_lie_at_the_bandwidth_and_there_is_no_zero(w, derivatives, order):
    """Characteristic polynomial (s + w)^n by the binomials, and no direct feedthrough."""
    block = cp.create_command_filter_iosystem(w, derivatives, order)
    wanted = [math.comb(order, k) * w**k for k in range(order + 1)]
    assert np.abs(np.poly(block.A) / wanted - 1).max() <= 1e-12
    assert np.all(block.D == 0.0)
    assert block.nstates == order


@cases
def test_the_answer_to_a_step_is_the_gamma_distribution(w, derivatives, order):
    """r is the incomplete gamma function of w t, r_d1 its density, and each further output the derivative of it."""
    block = cp.create_command_filter_iosystem(w, derivatives, order)
    t = np.linspace(0.0, 10.0 / w, 51)
    found = cp.simulate(block, t, cp.Step(3.0))
    outputs = np.atleast_2d(found.outputs)
    assert found.method == "exact"
    assert np.abs(outputs[0] - 3 * gammainc(order, w * t)).max() <= 1e-10
    if derivatives:
        density = gamma(order, scale=1 / w).pdf
        assert np.abs(outputs[1, 1:] - 3 * density(t[1:])).max() <= 1e-10 * w
    for k in range(2, derivatives + 1):
        # Derivatives of the density of n by those of smaller n: p_n' = w (p_(n-1) - p_n).
        row = [gamma(n, scale=1 / w).pdf(t[1:]) for n in range(order - k + 1, order + 1)]
        for _ in range(k - 1):
            row = [w * (a - b) for a, b in pairwise(row)]
        assert np.abs(outputs[k, 1:] - 3 * row[-1]).max() <= 1e-9 * w**k


def test_outputs_are_derivatives_of_one_another_after_jumps_of_the_command():
    """Exactly: the integral of each by an integrator in the same run, over three steps."""
    block = cp.create_command_filter_iosystem(3.0, 3, outputs="r")
    chains = [ct.ss(0, 1, 1, 0, inputs=f"r_d{k}", outputs=f"i{k}", name=f"chain{k}") for k in (1, 2, 3)]
    names = ["r", "r_d1", "r_d2", "r_d3"]
    loop = ct.interconnect([block, *chains], inputs=["r_cmd"], outputs=[*names, "i1", "i2", "i3"])
    command = cp.Step(1.0, time=0.2) + cp.Step(-3.0, time=1.1) + cp.Step(2.5, time=1.2)
    found = cp.simulate(loop, np.linspace(0, 5, 101), command)
    outputs = np.asarray(found.outputs)
    assert found.method == "exact"
    for k in range(3):
        assert np.abs(outputs[4 + k] - outputs[k]).max() <= 1e-11 * np.abs(outputs[k]).max()
    assert outputs[0, -1] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("order", [2, 3, 5])
def test_the_first_derivative_not_output_may_jump_and_none_before_it(order):
    """At a step of height 1, derivative n jumps by w^n and those below do not."""
    w, h = 2.0, 1e-6
    block = cp.create_command_filter_iosystem(w, order - 1)
    found = np.asarray(cp.simulate(block, [0.0, 1.0, 1.0 + h, 2.0], cp.Step(1.0, time=1.0)).outputs)
    assert np.all(found[:, 1] == 0.0)
    assert found[-1, 2] / h == pytest.approx(w**order, rel=1e-4)
    assert np.abs(found[:-1, 2]).max() <= w**order * h**2


def test_order_is_one_above_the_derivatives_unless_given():
    assert [cp.create_command_filter_iosystem(1.0, k).nstates for k in (0, 1, 4)] == [1, 2, 5]
    assert cp.create_command_filter_iosystem(1.0, 1, 4).noutputs == 2
    assert cp.create_command_filter_iosystem(1.0).output_labels == ["r", "r_d1", "r_d2"]


def test_names():
    block = cp.create_command_filter_iosystem(1.0, 1, 3, inputs="x_ref", outputs="x")
    assert block.input_labels == ["x_ref"]
    assert block.output_labels == ["x", "x_d1"]
    assert block.state_labels == ["x", "x_d1", "x_d2"]
    assert block.name == "x_filter"
    assert cp.create_command_filter_iosystem(1.0, name="f").name == "f"
    assert block.dt == 0


@pytest.mark.parametrize("kind", ["ramp", "sine"])
def test_it_lags_by_n_over_w(kind):
    """A ramp is delayed by n/w, a slow sine by about as much."""
    w, order, t = 5.0, 3, np.linspace(10, 14, 41)
    block = cp.create_command_filter_iosystem(w, 0, order)
    if kind == "ramp":
        ramp = cp.PolySpline([cp.Waypoint(0, 0.0), cp.Waypoint(20, 20.0)])
        found = np.asarray(cp.simulate(block, np.append(0, t), ramp).outputs)[1:]
        assert np.abs(found - (t - order / w)).max() <= 1e-9
    else:
        assert -np.angle(block(0.01j)) / 0.01 == pytest.approx(order / w, rel=1e-4)


# The lead


@pytest.mark.parametrize("order", [1, 2, 3, 5])
@pytest.mark.parametrize("w", [0.3, 4.0])
def test_the_lead_is_the_inverse_of_the_filter(w, order):
    lead = command_filter_gains(w, order)
    block = cp.create_command_filter_iosystem(w, 0, order)
    assert len(lead) == order + 1
    for s in w * np.exp(1j * np.linspace(-2.5, 2.5, 8)):
        assert abs(np.polyval(lead[::-1], s) * block(s) - 1) <= 1e-11


def led(plan, w, derivatives, order, outputs):
    """Source with all derivatives that the lead weighs, their sum, and the filter."""
    source = cp.create_source_iosystem(plan, order)
    names = source.output_labels
    weighted = ct.ss([], [], [], [command_filter_gains(w, order)], inputs=names, outputs=["r_cmd"], name="lead")
    block = cp.create_command_filter_iosystem(w, derivatives, order)
    return ct.interconnect([source, weighted, block], inputs=0, outputs=outputs, name="led")


@pytest.mark.parametrize(("w", "derivatives", "order"), [(2.0, 0, 1), (2.0, 2, 3), (0.5, 1, 2), (20.0, 3, 4)])
def test_behind_its_lead_a_plan_comes_out_exactly(w, derivatives, order):
    """Minimum-jerk-like moves in closed form; from rest, so that the filter starts on the plan."""
    plan = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0, 0, 0), cp.Waypoint(2.5, 3, 0, 0, 0, 0)], labels=["y"])
    names = ["r", *(f"r_d{k}" for k in range(1, derivatives + 1))]
    t = np.linspace(0, 4, 81)
    found = cp.simulate(led(plan, w, derivatives, order, names), t)
    assert found.method == "exact"
    rise = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
    tau = np.clip((t - 0.5) / 2.0, 0, 1)
    for k, row in enumerate(np.atleast_2d(found.outputs)):
        wanted = 3 * rise.deriv(k)(tau) / 2.0**k if k else 3 * rise(tau)
        assert np.abs(row - wanted).max() <= 1e-10 * np.abs(wanted).max()


def test_without_the_lead_it_does_not():
    plan = cp.PolySpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(2.0, 3, 0, 0)])
    t = np.linspace(0, 2, 21)
    found = np.asarray(cp.simulate(cp.create_command_filter_iosystem(2.0, 0, 3), t, plan).outputs)
    assert np.abs(found - plan(t)).max() > 0.5


def test_a_filter_that_starts_next_to_the_plan_comes_to_it_by_its_own_poles():
    """The difference is the free response of the filter: for n = 2, (1 + w t) exp(-w t) of the first offset."""
    plan = cp.PolySpline([cp.Waypoint(0.0, 1, 0, 0, 0), cp.Waypoint(2.0, 3, 0, 0, 0)], labels=["y"])
    t, w = np.linspace(0, 4, 41), 3.0
    found = np.asarray(cp.simulate(led(plan, w, 0, 2, ["r"]), t).outputs)
    assert np.abs(found - plan(t) + (1 + w * t) * np.exp(-w * t)).max() <= 1e-10


# In a loop


@pytest.fixture(scope="module")
def commanded():
    """Crane behind two filters that start at its first position; commands jump at 1 s."""
    plan = cp.PolySpline(
        [cp.Waypoint.from_jets(t, x=[x, 0, 0], z=[z, 0, 0]) for t, x, z in ((0, 1.0, 10.0), (6, 4.0, 9.0))]
    )
    filters = [
        cp.create_command_filter_iosystem(w, 2, 3, inputs=f"{axis}_cmd", outputs=f"{axis}_ref")
        for axis, w in (("x", 1.5), ("z", 2.0))
    ]
    cp.declare(filters[0], initial_state=[1.0, 0.0, 0.0])
    cp.declare(filters[1], initial_state=[10.0, 0.0, 0.0])
    loop = crane_loop(Crane(), plan, reference=filters, inputs=["x_cmd", "z_cmd"])
    t = np.linspace(0, 12, 121)
    requested = {"x_cmd": cp.Step(4.0, 1.0, 1.0), "z_cmd": cp.Step(9.0, 10.0, 1.0)}
    return loop, t, cp.simulate(loop, t, requested)


def test_a_loop_starts_its_filters_where_they_say(commanded):
    """States in the order of the blocks: x, its derivatives, z, its derivatives, law and PIDs, then the crane's."""
    loop, _, _ = commanded
    start = dict(zip(loop.state_labels, loop.initial_state, strict=True))
    assert start["x_ref_filter_x_ref"] == 1.0
    assert start["z_ref_filter_z_ref"] == 10.0
    assert start["crane_D"] == 1.0 - 0.25
    assert start["crane_R"] == 10.0
    assert sum(value != 0.0 for value in start.values()) == 4


def test_references_in_a_loop_are_what_the_filters_make_of_the_commands(commanded):
    """Before the step the crane is in equilibrium."""
    _, t, found = commanded
    outputs = dict(
        zip(found.output_labels, np.asarray(found.outputs).reshape(len(found.output_labels), -1), strict=True)
    )
    since = np.maximum(t - 1.0, 0.0)
    assert np.abs(outputs["x_ref"] - 1 - 3 * gammainc(3, 1.5 * since)).max() <= 1e-7
    assert np.abs(outputs["z_ref"] - 10 + gammainc(3, 2.0 * since)).max() <= 1e-7
    before = t <= 1.0
    assert np.abs(outputs["x"][before] - 1.0).max() <= 1e-9
    assert np.abs(outputs["T"][before] - 500 * 9.81).max() <= 1e-5
    assert np.abs(outputs["x"] - outputs["x_ref"]).max() <= 0.02  # the law got the derivatives that it needs


def test_without_its_initial_state_a_filter_starts_at_0():
    plan = cp.PolySpline([cp.Waypoint.from_jets(t, x=[x, 0, 0], z=[10.0, 0, 0]) for t, x in ((0, 0.0), (6, 4.0))])
    filters = [cp.create_command_filter_iosystem(1.0, 2, inputs=f"{a}_cmd", outputs=f"{a}_ref") for a in "xz"]
    loop = crane_loop(Crane(), plan, reference=filters, inputs=["x_cmd", "z_cmd"])
    assert np.all(loop.initial_state[:6] == 0.0)


BAD = [
    (ValueError, r"bandwidth must be finite and above 0, got 0\.0", (0.0,)),
    (ValueError, r"bandwidth must be finite and above 0, got -1\.0", (-1,)),
    (ValueError, "bandwidth must be finite and above 0, got inf", (math.inf,)),
    (ValueError, "bandwidth must be finite and above 0, got nan", (math.nan,)),
    (TypeError, "bandwidth must be a number, got 'a'", ("a",)),
    (ValueError, "derivatives must be an integer of at least 0, got -1", (1.0, -1)),
    (ValueError, r"derivatives must be an integer of at least 0, got 1\.5", (1.0, 1.5)),
    (TypeError, "derivatives must be an integer of at least 0, got '2'", (1.0, "2")),
    (ValueError, "order must be an integer of at least 3, got 2", (1.0, 2, 2)),
    (ValueError, "order must be an integer of at least 1, got 0", (1.0, 0, 0)),
    (TypeError, "order must be an integer of at least 3, got True", (1.0, 2, True)),
]


@pytest.mark.parametrize(("kind", "message", "given"), BAD, ids=[str(case[2]) for case in BAD])
def test_bad_input_of_the_filter(kind, message, given):
    with pytest.raises(kind, match=message):
        cp.create_command_filter_iosystem(*given)


@pytest.mark.parametrize(
    ("kind", "message", "given"),
    [
        (ValueError, "bandwidth must be finite and above 0", (0.0, 2)),
        (TypeError, "bandwidth must be a number", (None, 2)),
        (ValueError, "order must be an integer of at least 1, got 0", (1.0, 0)),
        (ValueError, r"order must be an integer of at least 1, got 2\.5", (1.0, 2.5)),
    ],
)
def test_bad_input_of_the_lead(kind, message, given):
    with pytest.raises(kind, match=message):
        command_filter_gains(*given)
