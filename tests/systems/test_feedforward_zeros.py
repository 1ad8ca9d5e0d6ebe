"""Feedforward of continuous loops for a plan: zeros in the right half plane and on the imaginary axis."""

import re

import control as ct
import numpy as np
import pytest
from repetitions import one_in
from scipy.integrate import quad
from scipy.linalg import eigvals

import ctrlplan as cp
from ctrlplan.trajectories.piecewise_polynomial import PiecewisePolynomial


def bump(duration, start=0.0, initial=0.0, change=1.0):
    """Move whose velocity is proportional to (t/T)^4 (1 - t/T)^4."""
    unit = np.polynomial.Polynomial([0, 0, 0, 0, 1]) * np.polynomial.Polynomial([1, -1]) ** 4
    position = unit.integ()
    coefficients = change * position.coef / position(1.0)
    coefficients[0] = initial
    scaled = coefficients / duration ** np.arange(coefficients.size)
    return PiecewisePolynomial([start, start + duration], scaled[::-1, None, None])


def tf(num, den):
    return ct.tf(num, den, inputs="r", outputs="y", name="loop")


def followed(loop, plan, after=30.0, state=None, **options):
    """Block, times, response and the maximum error of each output by its range."""
    block = cp.create_feedforward_iosystem(loop, plan=plan, **options)
    whole = ct.interconnect([block, loop], inputs=0, outputs=[*loop.output_labels, *loop.input_labels])
    times = np.linspace(block.start, plan.end + after, 4001)
    start = None
    if state is not None:
        own = state(block)
        start = np.concatenate([np.zeros(whole.nstates - own.size), own])
    found = cp.simulate(whole, times, initial_state=start)
    error = np.abs(found.outputs[: loop.noutputs] - plan.jet(times, 0)[0]).max(axis=1)
    extrema = plan.extrema()
    return block, times, found, error / np.maximum(extrema.maximum - extrema.minimum, 1e-300)


# Right half plane


CUBIC = tf([-1, 1], [1, 3, 3, 1])


@pytest.mark.parametrize(
    ("loop", "duration", "preview"),
    [
        (CUBIC, 0.2, 14.489),
        (CUBIC, 2.0, 13.633),
        (tf([1, -1], [1, 2]), 1.0, 14.425),
    ],
)
def test_the_preview_gives_the_stated_error(loop, duration, preview):
    block, _, _, error = followed(loop, bump(duration))
    assert block.preview == pytest.approx(preview, abs=6e-4)
    assert block.start == -block.preview
    assert block.error <= 1e-6
    # The maximum over 4001 times is below that for all times by less than 1 % for these smooth responses.
    assert 0.99e-6 < error[0] < 1.0001e-6


@pytest.mark.parametrize("limit", [1e-3, 1e-9])
def test_a_smaller_error_needs_a_longer_preview(limit):
    block, _, _, error = followed(CUBIC, bump(1.0), error=limit)
    reference = cp.create_feedforward_iosystem(CUBIC, plan=bump(1.0))
    # The error decays as exp(-T) for a zero at 1.
    assert block.preview - reference.preview == pytest.approx(np.log(1e-6 / limit), rel=1e-3)
    assert 0.99 * limit < error[0] < 1.0001 * limit


@pytest.mark.parametrize("given", [0.0, 3.0])
def test_a_given_preview_states_its_error(given):
    block, _, _, error = followed(CUBIC, bump(1.0), preview=given)
    assert (block.preview, block.start) == (given, -given)
    assert block.error == pytest.approx(error[0], rel=1e-2)


def test_the_command_is_the_bounded_solution():
    """For (1 - s)/(s + 2): r - r' = y_d' + 2 y_d, whose bounded solution is an integral over the future."""
    plan = bump(1.0)
    _, times, found, _ = followed(tf([-1, 1], [1, 2]), plan, after=1.0)

    def expected(t):
        tail = 2.0 * np.exp(t - 1.0) if t < 1.0 else 2.0
        if t >= 1.0:
            return tail
        inner = quad(lambda s: np.exp(t - s) * (plan(s, 1) + 2.0 * plan(s)), max(t, 0.0), 1.0, epsabs=1e-13)[0]
        return inner + tail

    for k in range(0, times.size, 400):
        assert found.outputs[1, k] == pytest.approx(expected(times[k]), abs=1e-11)


def test_the_state_of_the_loop_at_the_start_gives_no_error():
    for initial in (0.0, 2.0):
        _, _, _, error = followed(CUBIC, bump(1.0, initial=initial), state=lambda block: block.loop_state, preview=2.0)
        assert error[0] < 1e-11


def test_a_plan_from_another_position_starts_at_rest_there():
    plan = bump(1.0, start=3.0, initial=2.0, change=-0.5)
    block = cp.create_feedforward_iosystem(CUBIC, plan=plan)
    times = np.linspace(block.start - 1.0, 20.0, 801)

    def build(name, plan):
        return ct.interconnect([block, CUBIC], inputs=0, outputs=["y", "r"])

    found = cp.compare(build, {"plan": plan}, times, start=3.0).responses["plan"]
    assert np.abs(found.outputs[0] - plan(times)).max() < 0.5e-6 * 1.0001
    assert np.abs(found.outputs[:, times < block.start] - 2.0).max() < 1e-12


@pytest.mark.parametrize(
    "placed",
    one_in(
        2,
        [
            ([1, 200], [-1, -2, -3]),
            ([0.01, 300], [-1, -2, -3]),
            ([1, -2000], [-1, -2, -3]),
            ([1 + 3j, 1 - 3j], [-1, -2 + 4j, -2 - 4j, -3]),
            ([1, 1], [-1, -2, -3]),
            ([1], [-1, 0, -2]),
            ([2, -3, 5], [-1, -2 + 9j, -2 - 9j]),
            ([1], [1j, -1j, -1]),
        ],
    ),
)
def test_zeros_of_any_kind(placed):
    zeros, poles = placed
    plan = cp.TrigSpline(
        [cp.Waypoint(1, 0, 0, 0, 0), cp.Waypoint(2, 3), cp.Waypoint(3, -1), cp.Waypoint(4, 2, 0, 0, 0)], alpha=3.0
    )
    num = np.poly(zeros).real
    _, _, _, error = followed(tf(num / num[-1], np.poly(poles).real), plan)
    assert 0.5e-6 < error[0] < 1.001e-6


def test_a_step_into_a_loop_with_feedthrough():
    _, _, found, error = followed(tf([1, -1], [1, 2]), cp.Step(1.0, time=1.0))
    assert error[0] < 1.0001e-6
    assert abs(found.outputs[1, -1] + 2.0) < 1e-9


def two_by_two(seed, zeros):
    """Random stable loop of orders 1 and 2 with given zeros, in coordinates without structure."""
    rng, n = np.random.default_rng(seed), 3 + len(zeros)
    a, b, c = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((2, n))
    a[3:, 3:], a[3:, :3], a[1, 2], a[[0, 2]] = np.diag(zeros), rng.normal(size=(n - 3, 3)), 1.0, rng.normal(size=(2, n))
    b[[0, 2]], c[0, 0], c[1, 1] = rng.normal(size=(2, 2)), 1.0, 1.0
    a = a - b @ ct.place(a, b, -np.arange(1.0, n + 1.0))
    turn = rng.normal(size=(n, n))
    names = {"inputs": ["r1", "r2"], "outputs": ["y1", "y2"], "name": "loop"}
    return ct.ss(turn @ a @ np.linalg.inv(turn), turn @ b, c @ np.linalg.inv(turn), 0, **names)


def two_axes():
    points = [
        cp.Waypoint(0, [0, 0], 0, 0, 0),
        cp.Waypoint(1, [1, -1], [0.5, 0.5], 0, 0),
        cp.Waypoint(2, [2, 3], 0, 0, 0),
    ]
    return cp.PolySpline(points, labels=["y1", "y2"])


@pytest.mark.parametrize("limit", [1e-7, 1e-9])
def test_a_loop_with_two_inputs(limit):
    loop = two_by_two(0, [1.5, -2.0])
    pencil = np.block([[loop.A, loop.B], [loop.C, np.zeros((2, 2))]])
    finite = eigvals(pencil, np.diag([1.0] * 5 + [0.0] * 2))
    finite = finite[np.abs(finite) < 1e6]
    block, _, _, error = followed(loop, two_axes(), error=limit)
    np.testing.assert_allclose(np.sort(block.zeros.real), np.sort(finite.real), rtol=1e-9)
    assert 0.9 * limit < error.max() < 1.001 * limit


def test_axes_follow_the_outputs_of_their_names():
    loop, plan = two_by_two(0, [1.5, -2.0]), two_axes()
    turned = plan.select(["y2", "y1"])
    block = cp.create_feedforward_iosystem(loop, plan=turned)
    whole = ct.interconnect([block, loop], inputs=0, outputs=["y1", "y2"])
    times = np.linspace(block.start, 10.0, 101)
    assert np.abs(cp.simulate(whole, times).outputs - plan(times)).max() < 4.001e-6


# Singular influence of the inputs


@pytest.mark.parametrize("through", [0.0, 1.0])
def test_outputs_whose_highest_derivatives_depend_on_the_same_input(through):
    a = np.array([[-1.0, 0.2, 0.0], [0.0, -2.0, 1.0], [0.3, 0.0, -3.0]])
    b = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    names = {"inputs": ["r1", "r2"], "outputs": ["y1", "y2"], "name": "loop"}
    loop = ct.ss(a, b, np.eye(2, 3), through * np.ones((2, 2)), **names)
    block = cp.create_feedforward_iosystem(loop)
    # y1' = r1 + ..., y2' = r1 + ...; y2'' - y1'' depends on r2.
    assert block.input_labels == ["y1_ref", "y1_ref_d1", "y1_ref_d2", "y2_ref", "y2_ref_d1", "y2_ref_d2"]
    s = 0.3 + 0.7j
    powers = np.kron(np.eye(2), s ** np.arange(3)[:, None])
    np.testing.assert_allclose(block(s) @ powers, np.linalg.inv(loop(s)), rtol=1e-9, atol=1e-12)
    assert followed(loop, two_axes(), after=3.0)[3].max() < 1e-12


# On the imaginary axis


@pytest.mark.parametrize(("duration", "amplitude"), [(1.0, 0.902), (2.0, 0.655), (4.0, 0.143)])
def test_a_pair_leaves_an_oscillation_of_stated_amplitude(duration, amplitude):
    w, plan = 3.0, bump(duration)
    block, times, found, error = followed(tf([1, 0, w**2], w**2 * np.array([1, 2, 1])), plan)
    ((frequency, amplitudes),) = block.remaining
    # The residue at j w of w^2 (s + 1)^2/(s^2 + w^2) y_d.
    real = quad(lambda t: plan(t, 1) * np.cos(w * t), 0.0, duration, epsabs=1e-12)[0]
    imaginary = quad(lambda t: plan(t, 1) * np.sin(w * t), 0.0, duration, epsabs=1e-12)[0]
    expected = np.hypot(real, imaginary)
    assert expected == pytest.approx(amplitude, abs=6e-4)
    assert frequency == pytest.approx(w, rel=1e-12)
    assert amplitudes[0] == pytest.approx(expected * abs(1j * w + 1.0) ** 2, rel=1e-8)
    after = found.outputs[1, times > duration]
    assert np.ptp(after) / 2.0 == pytest.approx(amplitudes[0], rel=1e-3)
    assert error[0] < 1e-12


def test_equal_pairs_of_different_outputs_stay_bounded():
    pair = ct.ss(tf([1, 0, 9], [9, 18, 9]))
    loop = ct.append(pair, pair)
    loop = ct.ss(loop, inputs=["r1", "r2"], outputs=["y1", "y2"], name="loop")
    block, _, _, error = followed(loop, cp.stack([bump(1.0), 0.0 * bump(1.0)], ["y1", "y2"]), after=5.0)
    single = cp.create_feedforward_iosystem(tf([1, 0, 9], [9, 18, 9]), plan=bump(1.0)).remaining[0][1][0]
    total = np.array([amplitudes for _, amplitudes in block.remaining]).sum(axis=0)
    np.testing.assert_allclose(total, [single, 0.0], atol=1e-9)
    assert error[0] < 1e-12


def test_a_double_pair_grows():
    loop = tf(np.polymul([1, 0, 9], [1, 0, 9]), np.poly([-1, -2, -3, -4, -5]))
    with pytest.raises(
        ValueError, match=r"^plan must leave the motion of zeros of loop at .*3j bounded, got a command"
    ):
        cp.create_feedforward_iosystem(loop, plan=bump(1.0))
    assert followed(loop, bump(1.0), after=1.0, finite=True)[3][0] < 1e-11


RETURN = bump(1.0) + bump(1.0, start=2.0, change=-1.0)
"""From 0 to 1 and back to 0: its integral is 2."""

EQUAL_AREAS = RETURN - RETURN.shift(4.0)
"""Its integral is 0, that of t times it is -8."""


@pytest.mark.parametrize(
    ("numerator", "plan", "after"),
    [
        ([1, 0], RETURN, 2.0),  # r = (s + 1)^3/s y_d ends at the integral of y_d
        ([1, 0, 0], EQUAL_AREAS, 8.0),  # at the double integral
        ([1, 0], EQUAL_AREAS, 0.0),
    ],
)
def test_zeros_at_0_whose_command_stays_bounded(numerator, plan, after):
    block, _, found, error = followed(tf(numerator, [1, 3, 3, 1]), plan, after=40.0)
    assert error[0] < 1e-11
    assert (block.remaining, block.end_command) == ((), None)
    assert found.outputs[1, -1] == pytest.approx(after, abs=1e-10)


@pytest.mark.parametrize(
    ("numerator", "plan", "at_end"),
    [([1, 0], bump(1.0), 3.5), ([1, 0, 0], RETURN, 3.0 + 0.5), ([1, 0, 0, 0], EQUAL_AREAS, None)],
)
def test_zeros_at_0_whose_command_grows(numerator, plan, at_end):
    loop = tf(numerator, [1, 3, 3, 1])
    with pytest.raises(
        ValueError, match=r"^plan must leave the motion of zeros of loop at 0.* bounded, .* finite=True"
    ):
        cp.create_feedforward_iosystem(loop, plan=plan)
    block, times, found, error = followed(loop, plan, after=1.0, finite=True)
    assert error[0] < 1e-11
    place = np.interp(plan.end, times, found.outputs[1])
    assert block.end_command[0] == pytest.approx(place, rel=1e-3)


def test_a_loop_that_holds_no_output_starts_at_0():
    with pytest.raises(ValueError, match=r"^plan must start at 0 for a loop with a zero at 0, .*, got \[2.\]; shift"):
        cp.create_feedforward_iosystem(tf([1, 0], [1, 2, 1]), plan=bump(1.0, initial=2.0))


@pytest.mark.parametrize("far", [-1e6, -1e8])
def test_a_slow_zero_is_told_from_one_on_the_axis_if_another_is_fast(far):
    slow = np.poly([-0.05, far]) / abs(far)
    block = cp.create_feedforward_iosystem(ct.ss(tf(slow, [1, 6, 11, 6])))
    np.testing.assert_allclose(np.sort(block.poles().real), [far, -0.05], rtol=1e-7)
    pair = np.poly([0.3j, -0.3j, far]).real / abs(far)
    block, _, _, error = followed(tf(pair, np.poly([-1, -2, -3, -4])), bump(1.0), after=5.0)
    assert [frequency for frequency, _ in block.remaining] == pytest.approx([0.3], rel=1e-7)
    assert error[0] < 1e-8
    double = tf(np.poly([3j, -3j, 3j, -3j, far]).real / abs(far), np.poly(-np.arange(1.0, 7.0)))
    with pytest.raises(ValueError, match=r"^plan must leave the motion of zeros of loop at .*j bounded") as raised:
        cp.create_feedforward_iosystem(double, plan=bump(1.0))
    # Rounding moves double zeros apart by its square root, and their mean by itself; the message has four digits.
    named = re.findall(r"([\d.]+)j", str(raised.value).partition(" bounded")[0])
    assert np.mean([float(frequency) for frequency in named]) == pytest.approx(3.0, abs=1e-3)


# Unstable loops


def test_an_unstable_loop_needs_the_exact_start():
    loop = tf([-1, 1], np.poly([0.5, -1, -2]))
    with pytest.raises(ValueError, match=r"^loop must be stable for a preview to be computed, got poles -2, -1, 0.5: "):
        cp.create_feedforward_iosystem(loop, plan=bump(1.0))
    block, _, _, error = followed(loop, bump(1.0), after=3.0, preview=2.0, state=lambda block: block.loop_state)
    assert (block.stable, block.error) == (False, np.inf)
    assert error[0] < 1e-11
    assert "unstable: no error only from loop_state at the start" in str(block)


def test_without_zeros_an_unstable_loop_starts_at_rest():
    block, _, _, error = followed(tf([1], np.poly([0.5, -1, -2])), bump(1.0), after=5.0)
    assert (block.stable, block.error, block.preview) == (False, 0.0, 0.0)
    assert error[0] < 1e-11
    assert np.abs(block.loop_state).max() < 1e-14


def test_a_double_integrator_does_not_forget_a_limited_preview():
    with pytest.raises(ValueError, match=r"^loop must be stable for a preview to be computed, got poles -1, 0, 0: "):
        cp.create_feedforward_iosystem(tf([-1, 1], [1, 1, 0, 0]), plan=bump(1.0))


# Runs


def test_runs_begin_before_the_preview():
    block = cp.create_feedforward_iosystem(CUBIC, plan=bump(1.0))
    whole = ct.interconnect([block, CUBIC], inputs=0, outputs=["y"])
    traits = cp.traits_of(block)
    assert (traits.start, traits.preview) == (block.start, block.preview) == (-block.preview, block.preview)
    message = r"^timepts must begin at -14\.0\d+ s or earlier, where the command of block feedforward.* got 0 s; begin"
    with pytest.raises(ValueError, match=message):
        cp.simulate(whole, [0.0, 1.0])
    with pytest.raises(ValueError, match=message):
        cp.prepare(whole).start(0.1, time=0.0)
    with pytest.raises(ValueError, match=message):
        cp.compare(lambda name, plan: whole, {"plan": bump(1.0)}, [0.0, 1.0, 2.0])
    assert cp.simulate(whole, [0.0, 1.0], initial_state=0.0).time.size == 2


# Errors


MOVE = bump(1.0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"plan": 3.0}, TypeError, "plan must be a Trajectory, got float"),
        ({"plan": MOVE, "error": 0.0}, ValueError, "error must be finite and above 0, got 0.0"),
        ({"plan": MOVE, "error": "small"}, TypeError, "error must be a number, got 'small'"),
        ({"plan": MOVE, "preview": -1.0}, ValueError, "preview must be finite and at least 0, got -1.0"),
        ({"plan": MOVE, "method": "best"}, ValueError, 'method must be "exact" or "zpetc", got \'best\''),
        ({"plan": MOVE, "method": "zpetc"}, ValueError, 'method must be "exact" for a loop in continuous time'),
        ({"plan": MOVE, "finite": 1}, TypeError, "finite must be True or False, got 1"),
        ({"preview": 1.0}, ValueError, "preview must be given together with plan=, got no plan"),
        (
            {"plan": cp.stack([MOVE, MOVE])},
            ValueError,
            "plan must have one axis for each output of loop, y, got y1, y2",
        ),
        ({"plan": MOVE, "labels": "z"}, ValueError, "labels must be axes of plan, y, got 'z'"),
        (
            {"plan": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)])},
            ValueError,
            "derivative 1 of plan axis 'y' must be continuous for output 'y', of relative degree 2, got a jump of 1 at",
        ),
    ],
)
def test_wrong_arguments(arguments, error, message):
    with pytest.raises(error, match=f"^{message.replace('(', '[(]')}"):
        cp.create_feedforward_iosystem(CUBIC, **arguments)


def test_outputs_of_which_some_have_names_of_axes():
    plan = cp.stack([MOVE, MOVE], ["y2", "z"])
    with pytest.raises(ValueError, match=r"^axes of plan must be named as the outputs .* of which y2 would follow by"):
        cp.create_feedforward_iosystem(two_by_two(0, [-2.0]), plan=plan)


def test_zeros_that_are_too_fast_for_the_plan():
    with pytest.raises(
        ValueError, match=r"^zeros of loop that are not stable must be below .* got 1e\+06 rad/s; model"
    ):
        cp.create_feedforward_iosystem(tf(np.poly([1e6]), [1, 2, 1]), plan=MOVE)
