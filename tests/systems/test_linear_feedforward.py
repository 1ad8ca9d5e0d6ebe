"""Feedforward of linear loops: the exact inverse, and errors if there is none."""

import control as ct
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from repetitions import examples
from scipy.linalg import eigvals, expm

import ctrlplan as cp
from ctrlplan.systems.feedforward import create_feedforward_iosystem

T = np.linspace(0.0, 4.0, 81)


def plan_of(order, alpha=1.0, labels=None):
    """From 0 at 0.5 s to 1 at 1.5 s with derivatives up to the order 0 at both ends."""
    points = [cp.Waypoint(t, y, *[0.0] * order) for t, y in ((0.5, 0.0), (1.5, 1.0))]
    return cp.TrigSpline(points, alpha=alpha, labels=labels)


def following(plan, loop, outputs=("y",)):
    """Source, feedforward and loop, joined by their names."""
    feedforward = create_feedforward_iosystem(loop)
    source = cp.create_source_iosystem(plan, feedforward.ninputs - 1, suffix="_ref")
    return ct.interconnect([source, feedforward, loop], inputs=0, outputs=list(outputs))


def named(num, den):
    return ct.tf(num, den, inputs="r", outputs="y", name="loop")


def lag_controller(gain=0.5):
    """Loop of order 3: 5/(s^2 + s) behind a lag."""
    blocks = [
        ct.summing_junction(["r", "-y"], "e"),
        ct.ss(ct.tf([20.0 * gain], [1, 20.0]), inputs="e", outputs="u", name="controller"),
        ct.ss(ct.tf([5.0], [1, 1, 0]), inputs="u", outputs="y", name="plant"),
    ]
    return ct.interconnect(blocks, inputs="r", outputs="y", name="loop")


# Exact tracking


@pytest.mark.parametrize("alpha", [0.0, 1.0, 4.0])
@pytest.mark.parametrize("gain", [0.25, 1.0, 5.0, 1000.0])
def test_the_papers_loop_tracks_its_plan_exactly(gain, alpha):
    plan = plan_of(2, alpha)
    found = cp.simulate(following(plan, cp.plants.integrator_lag_loop(gain)), T)
    assert found.method == "exact"
    assert np.abs(found.outputs - plan(T)).max() < 1e-12


@settings()
@given(st.floats(0.01, 1e4))
def test_its_command_is_the_one_of_the_closed_form(gain):
    block = create_feedforward_iosystem(cp.plants.integrator_lag_loop(gain))
    np.testing.assert_allclose(block.D, [[1.0, 1.0 / gain, 1.0 / gain]], rtol=1e-14, atol=1e-15)


def test_without_it_the_loop_lags():
    plan = plan_of(2)
    bare = cp.simulate(cp.plants.integrator_lag_loop(5.0), T, plan)
    assert np.abs(bare.outputs - plan(T)).max() > 0.3


@examples(60)
@given(
    st.lists(st.floats(-8.0, 2.0), max_size=3),
    st.lists(st.tuples(st.floats(-5.0, 1.0), st.floats(0.1, 5.0)), max_size=2),
    st.floats(0.01, 100.0),
)
def test_the_inverse_of_any_loop_without_zeros(real, pairs, gain):
    # Also for unstable loops.
    den = polynomial.polyfromroots([*real, *(complex(*p) for p in pairs), *(complex(a, -b) for a, b in pairs)]).real
    block = create_feedforward_iosystem(named([gain], den[::-1]))
    assert block.ninputs == den.size
    np.testing.assert_allclose(block.D[0], den / gain, rtol=1e-10, atol=1e-10 * np.abs(den).max() / gain)


@pytest.mark.parametrize("seed", range(5))
def test_states_in_any_coordinates(seed):
    rng = np.random.default_rng(seed)
    order = int(rng.integers(1, 5))
    den = np.poly(-rng.uniform(0.3, 4.0, order))
    system = ct.ss(named([3.0], den))
    turn, _ = np.linalg.qr(rng.normal(size=(order, order)))
    turned = ct.ss(turn @ system.A @ turn.T, turn @ system.B, system.C @ turn.T, 0, inputs="r", outputs="y")
    np.testing.assert_allclose(create_feedforward_iosystem(turned).D[0], den[::-1] / 3.0, rtol=1e-10)


@pytest.mark.parametrize(
    "loop",
    [
        lag_controller(),
        ct.ss(named([3.0], [1.0, 2.0])),
        ct.ss(named([2.0], np.poly([-1.0, -2.0, -3.0, -4.0]))),
        ct.ss(named([2.0], [1.0, 0.0, 0.0])),
        ct.ss(named([1.0], [1.0, -0.5])),
        ct.ss(named([3.0], [1.0])),
    ],
    ids=["order 3", "order 1", "order 4", "double integrator", "unstable", "gain"],
)
def test_other_loops_track_their_plans(loop):
    plan = plan_of(4)
    found = cp.simulate(following(plan, loop), T)
    assert np.abs(found.outputs - plan(T)).max() < 1e-11


def test_errors_decay_as_the_loop_has_it():
    loop, plan, start = lag_controller(), plan_of(3), np.array([0.3, -0.2, 0.5])
    found = cp.simulate(following(plan, loop), T, initial_state=start)
    error = [float((loop.C @ expm(loop.A * t) @ start)[0]) for t in T]
    assert np.abs(found.outputs - plan(T) - error).max() < 1e-11


def test_python_controls_own_response_to_the_command():
    loop, plan, t = cp.plants.integrator_lag_loop(5.0), plan_of(3), np.linspace(0.0, 2.0, 4001)
    feedforward = create_feedforward_iosystem(loop)
    command = feedforward.D @ cp.source_samples(plan, t, 2)
    # It takes the command for linear between samples, 5e-4 s apart: an error of their square.
    peer = ct.forced_response(loop, t, command[0])
    assert np.abs(peer.outputs - plan(t)).max() < 1e-5


def test_a_state_that_is_not_seen_in_the_output_does_no_harm():
    hidden = ct.ss([[-1.0, 0.0], [3.0, -2.0]], [[1.0], [1.0]], [[2.0, 0.0]], 0)
    np.testing.assert_allclose(create_feedforward_iosystem(hidden).D, [[0.5, 0.5]])


def test_a_zero_on_a_pole_is_none():
    np.testing.assert_allclose(create_feedforward_iosystem(named([1, 2], np.poly([-2, -3, -1]))).D, [[3, 4, 1]])


# The block


def test_it_is_a_gain_of_any_time_base():
    block = create_feedforward_iosystem(cp.plants.integrator_lag_loop(5.0))
    assert isinstance(block, ct.StateSpace)
    assert (block.nstates, block.dt, block.name) == (0, None, "feedforward")
    assert block.input_labels == ["y_ref", "y_ref_d1", "y_ref_d2"]
    assert block.output_labels == ["r"]
    integrating = create_feedforward_iosystem(named([2.0], [1.0, 1.0, 0.0]))
    assert str(integrating.D[0, 0]) == "0.0"


def test_a_label_of_the_plans_own():
    loop, plan = cp.plants.integrator_lag_loop(5.0), plan_of(2, labels=["height"])
    block = create_feedforward_iosystem(loop, labels="height", suffix="", name="inverse")
    assert (block.name, block.input_labels) == ("inverse", ["height", "height_d1", "height_d2"])
    joined = ct.interconnect([cp.create_source_iosystem(plan, 2), block, loop], inputs=0, outputs=["y", "r"])
    found = cp.simulate(joined, T)
    assert np.abs(found.outputs[0] - plan(T)).max() < 1e-12
    jet = plan.jet(T, 2)[:, 0]
    assert np.abs(found.outputs[1] - jet[0] - (jet[2] + jet[1]) / 5.0).max() < 1e-12


# Zeros


def pi_loop():
    """5/(s + 1) with a PI controller: a zero at -1.5."""
    blocks = [
        ct.summing_junction(["r", "-y"], "e"),
        ct.ss(ct.tf([2.0, 3.0], [1, 0]), inputs="e", outputs="u", name="controller"),
        ct.ss(ct.tf([5.0], [1, 1]), inputs="u", outputs="y", name="plant"),
    ]
    return ct.interconnect(blocks, inputs="r", outputs="y", name="loop")


def pid_loop():
    """A double integrator with a PID controller: a pair of zeros."""
    return ct.ss(ct.feedback(ct.tf([30.0, 40.0, 50.0], [0.001, 1.0, 0.0]) * ct.tf([1.0], [1.0, 0.0, 0.0])), name="loop")


@pytest.mark.parametrize(
    ("loop", "count"),
    [
        (named([1, 2], [1, 2, 3]), 1),
        (named([1, 2, 5], [1, 2, 3, 4]), 2),
        (named([2, 3, 1], [1, 3, 3, 1]), 2),
        (named([1, 4, 3], [1, 2, 5]), 2),  # as many zeros as poles: the order is 0
        (pi_loop(), 1),
    ],
    ids=["one", "a pair", "two", "feedthrough", "PI"],
)
def test_loops_with_zeros_in_the_left_half_plane_track_their_plans(loop, count):
    plan = plan_of(4)
    block = create_feedforward_iosystem(loop)
    assert block.nstates == count
    found = cp.simulate(following(plan, loop), T)
    assert found.method == "exact"
    assert np.abs(found.outputs - plan(T)).max() < 1e-11


def test_the_poles_of_the_block_are_the_zeros():
    block = create_feedforward_iosystem(pi_loop())
    np.testing.assert_allclose(block.poles(), [-1.5], rtol=1e-12)
    # From y_d to r: the inverse of the loop.
    s = 0.3 + 0.7j
    inverse = (block(s) @ np.array([1.0, s])).item()
    assert inverse == pytest.approx(1.0 / pi_loop()(s), rel=1e-12)


def test_a_pid_loop_follows_a_plan():
    loop = pid_loop()
    loop = ct.ss(loop, inputs="r", outputs="y", name="loop")
    plan = plan_of(4)
    np.testing.assert_allclose(cp.simulate(following(plan, loop), T).outputs.ravel(), plan(T), atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_loops_of_several_inputs(seed):
    """Random stable square systems whose zeros are stable: each output follows its own plan."""
    rng = np.random.default_rng(seed)
    while True:
        n, m = int(rng.integers(3, 6)), 2
        a = rng.normal(size=(n, n)) - 3.0 * np.eye(n)
        b, c = rng.normal(size=(n, m)), rng.normal(size=(m, n))
        loop = ct.ss(a, b, c, 0, inputs=["r1", "r2"], outputs=["y1", "y2"], name="loop")
        # Invariant zeros from the pencil.
        pencil = np.block([[a, b], [c, np.zeros((m, m))]])
        zeros = eigvals(pencil, np.diag([1.0] * n + [0.0] * m))
        zeros = zeros[np.isfinite(zeros) & (np.abs(zeros) < 1e6)]
        if (zeros.real < -0.1).all() and np.linalg.cond(c @ b) < 50.0:
            break
    block = create_feedforward_iosystem(loop)
    assert block.input_labels == ["y1_ref", "y1_ref_d1", "y2_ref", "y2_ref_d1"]
    assert block.nstates == n - 2
    np.testing.assert_allclose(np.sort_complex(block.poles()), np.sort_complex(zeros), rtol=1e-6, atol=1e-6)
    plan = cp.stack([plan_of(2), 2.0 * plan_of(2, alpha=0.0)], labels=["y1", "y2"])
    source = cp.create_source_iosystem(plan, 1, suffix="_ref")
    joined = ct.interconnect([source, block, loop], inputs=0, outputs=["y1", "y2"])
    np.testing.assert_allclose(cp.simulate(joined, T).outputs, plan(T), atol=1e-9)


def test_several_outputs_that_the_inputs_move_alike():
    loop = ct.ss(-np.eye(2), np.ones((2, 2)), np.eye(2), 0, outputs=["p", "q"])
    with pytest.raises(ValueError, match=r"^the outputs of loop, p, q, must depend on its inputs .*singular"):
        create_feedforward_iosystem(loop)


# No inverse


@pytest.mark.parametrize(
    ("loop", "zeros"),
    [
        (named([-1, 3], [1, 4, 3]), "3"),
        (named([1, 0], [1, 1]), "0"),
        (named([1, 0, 4], [1, 3, 3, 1]), r".*2j, .*\+2j"),
        (named([1, 0, 0], [1, 2, 3]), ".*0.*, .*0.*"),
        (named([1, 1, -2], [1, 3, 3, 1]), "-2, 1"),
    ],
)
def test_zeros_that_are_not_stable_require_a_plan(loop, zeros):
    with pytest.raises(ValueError, match=f"^loop must have its zeros in the left half plane, got {zeros}: the command"):
        create_feedforward_iosystem(loop)


def test_feedforward_of_the_plant_is_added_to_a_controller_with_zeros():
    """A PD position loop: with u = (y_d' + 0.024 y_d'' + 8e-5 y_d^(3))/12 added, the error stays 0."""
    plant = ct.tf([12.0], [8e-5, 0.024, 1.0, 0.0], inputs="u", outputs="y", name="plant")
    controller = ct.tf([0.15, 5.0], [0.001, 1.0], inputs="e", outputs="u", name="controller")
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(0.5, 3, 0, 0, 0)])
    feedforward = create_feedforward_iosystem(plant)
    np.testing.assert_allclose(feedforward.D[0], np.array([0.0, 1.0, 0.024, 8e-5]) / 12, rtol=1e-9, atol=1e-15)
    source = cp.create_source_iosystem(plan, 3, suffix="_ref")
    error = ct.summing_junction(["y_ref", "-y"], "e")
    loop = ct.interconnect([source, feedforward, error, controller, plant], inputs=0, outputs=["y"])
    t = np.linspace(0.0, 0.6, 61)
    np.testing.assert_allclose(cp.simulate(loop, t).outputs.ravel(), plan(t), atol=3e-9)


@pytest.mark.parametrize("seed", range(5))
def test_no_zero_is_missed(seed):
    rng = np.random.default_rng(seed)
    order = int(rng.integers(2, 7))
    zeros = np.sort(rng.uniform(-10, 10, rng.integers(1, order)))
    zeros[-1] = abs(zeros[-1]) + 0.1
    loop = named(np.poly(zeros), np.poly(-rng.uniform(0.1, 10, order)))
    with pytest.raises(ValueError, match="zeros in the left half plane") as refusal:
        create_feedforward_iosystem(loop)
    told = [float(word) for word in str(refusal.value).rpartition("got ")[2].partition(":")[0].split(", ")]
    np.testing.assert_allclose(told, np.sort(zeros), rtol=1e-3)


@pytest.mark.parametrize(
    ("loop", "error", "message"),
    [
        (named([0.0], [1, 1]), ValueError, "the transfer function of loop must not be 0, got 0"),
        (ct.ss([[-1.0]], [[0.0]], [[1.0]], 0), ValueError, "the transfer function of loop must not be 0, got 0"),
        (
            ct.tf([1], [1, 0.5], 0.1),
            ValueError,
            "loop must be in continuous time unless plan= is given, got dt = 0.1: ",
        ),
        (
            ct.tf([1], [1, 0.5], True),
            ValueError,
            "loop must be in continuous time unless plan= is given, got dt = True: ",
        ),
        (
            ct.ss(-np.eye(2), np.eye(2), np.ones((1, 2)), 0),
            ValueError,
            "loop must have as many inputs as outputs, got 2 and 1",
        ),
        (
            cp.plants.integrator_lag_loop(5.0, outputs=("y", "u")),
            ValueError,
            "loop must have as many inputs as outputs, got 1 and 2",
        ),
        (ct.tf([1], [1, np.inf]), ValueError, "loop must have finite coefficients, got .* and .*inf"),
        (ct.ss([[np.nan]], [[1]], [[1]], 0), ValueError, "loop must have finite coefficients, got .*nan"),
        (ct.tf([1, 0, 0], [1, 1]), ValueError, "loop must be proper, got a numerator of higher degree"),
        (
            ct.nlsys(None, lambda t, x, u, params: u, inputs=1, outputs=1),
            TypeError,
            "loop must be linear, a StateSpace",
        ),
        (ct.frd([1, 2], [1, 2]), TypeError, "loop must be linear, .* got FrequencyResponseData"),
        (5.0, TypeError, "loop must be linear, .* got float"),
    ],
)
def test_other_loops_are_rejected(loop, error, message):
    with pytest.raises(error, match=f"^{message}"):
        create_feedforward_iosystem(loop)


@pytest.mark.parametrize("label", ["r", "y"])
def test_a_label_that_would_be_added_to_the_loops_own_signal_is_rejected(label):
    with pytest.raises(ValueError, match=f"^labels and suffix must not name a signal of the loop, .* got '{label}'$"):
        create_feedforward_iosystem(cp.plants.integrator_lag_loop(5.0), labels=label, suffix="")


@pytest.mark.parametrize(
    ("zeros", "poles"),
    [
        ([-9451.1, -5555.44, -126.2], [-5928.6, -4322.88, -31.58, -15.92, -13.37]),
        ([-7786, -730, -89, -72, -4, -0.11], [-8123, -78, -64, -43, -41, -0.9, -0.3]),
        ([-3119.7, -2064.2, -66.4, -26.4], [-427.2, -87.5, -15.7, -2.5, -0.9, -0.43]),
        ([-133.3], [-772, -634, -229, -77, -48, -0.7, -0.35]),
        ([], [-5228, -302, -237, -6.5, -4.5, -4.4, -0.75]),
    ],
)
def test_poles_and_zeros_of_all_magnitudes(zeros, poles):
    """The inverse against the product of poles and zeros; coefficients of the polynomials spread over 20 decades."""
    gain = np.prod(np.negative(poles)) / np.prod(np.negative(zeros))
    block = create_feedforward_iosystem(ct.ss(named(gain * np.poly(zeros), np.poly(poles))))
    assert block.ninputs == len(poles) - len(zeros) + 1
    np.testing.assert_allclose(np.sort(block.poles().real), np.sort(zeros), rtol=1e-9)
    for s in 1j * 10.0 ** np.arange(-2.0, 5.0):
        expected = np.prod(s - np.array(poles)) / np.prod(s - np.array(zeros)) / gain
        # Forming the polynomials' coefficients rounds them, which counts for their smallest zeros.
        assert (block(s) @ s ** np.arange(block.ninputs)).item() == pytest.approx(expected, rel=1e-7)
