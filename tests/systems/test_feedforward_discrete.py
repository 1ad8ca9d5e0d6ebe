"""Feedforward of discrete loops for a plan: exact at samples, zero bands, zero phase error tracking, ripple."""

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.trajectories import Trajectory


def sampled(num, den, dt):
    """A continuous system with zero-order hold."""
    system = ct.sample_system(ct.ss(ct.tf(num, den)), dt)
    return ct.ss(system, inputs="r", outputs="y", name="loop")


def move(duration=1.0, start=0.0, initial=0.0, final=1.0, axes=1):
    ends = [cp.Waypoint(start, [initial] * axes, 0, 0, 0), cp.Waypoint(start + duration, [final] * axes, 0, 0, 0)]
    return cp.PolySpline(ends)


def followed(loop, plan, after, dt, **options):
    """Block, times, outputs and error at all times, four a sample where the loop is continuous."""
    block = cp.create_feedforward_iosystem(loop, plan=plan, **options)
    whole = ct.interconnect([block, loop], inputs=0, outputs=[*loop.output_labels, *loop.input_labels])
    per = 4 if loop.dt == 0 else 1
    times = block.start + dt / per * np.arange(per * round((plan.end + after - block.start) / dt))
    found = cp.simulate(whole, times)
    return block, times, found, np.abs(found.outputs[: loop.noutputs] - plan.jet(times, 0)[0])


# Exact at the samples


@pytest.mark.parametrize(
    ("num", "den", "dt", "duration"),
    [
        ([1], [1, 1], 0.1, 1.0),  # no zero
        ([1, 3], [1, 3, 2], 0.1, 1.03),  # one inside, and an end between samples
        ([1, 0.1], [1, 3, 2], 0.01, 1.0),  # slow: 0.999
        ([2, 1], [1, 1], 0.1, 1.0),  # feedthrough
        ([1], [1, 3, 3, 1], 2.0, 12.0),  # sampling zeros inside 0.9
    ],
)
def test_outputs_are_those_of_the_plan_at_samples(num, den, dt, duration):
    loop, plan = sampled(num, den, dt), move(duration, start=0.37)
    block, _, _, error = followed(loop, plan, 5.0, dt)
    assert error.max() < 1e-11
    degree = loop.nstates - block.zeros.size
    assert block.preview == pytest.approx(degree * dt)
    assert (block.error, block.method, block.stable) == (0.0, "exact", True)


@pytest.mark.parametrize(
    ("num", "den", "dt"),
    [
        ([1], [1, 3, 3, 1], 0.2),  # a sampling zero at -3.2
        ([-1, 1], [1, 3, 3, 1], 0.1),  # 1.105, a zero in the right half plane
        pytest.param([-1, 1], [1, 2, 1], 0.005, marks=pytest.mark.slow),  # 1.005
    ],
)
def test_zeros_outside_of_the_circle_need_a_preview(num, den, dt):
    loop, plan = sampled(num, den, dt), move()
    block, _, _, error = followed(loop, plan, 8.0, dt)
    assert block.error <= 1e-6
    assert error.max() == pytest.approx(block.error, rel=1e-6)
    # One sample less would not do.
    shorter = cp.create_feedforward_iosystem(loop, plan=plan, preview=block.preview - dt)
    assert shorter.error > 1e-6
    assert shorter.preview == pytest.approx(block.preview - dt)


@pytest.mark.parametrize("poles", [[1.0, 0.5], np.exp([0.1j, -0.1j]), [np.exp(-1e-3), 0.3], [0.0, 0.0]])
def test_the_error_of_a_preview_for_poles_that_decay_slowly_or_not(poles):
    loop = ct.ss(ct.tf([-1, 1.15], np.poly(poles).real, 0.1), inputs="r", outputs="y", name="loop")
    block, _, _, error = followed(loop, move(), 70.0, 0.1)
    assert error.max() == pytest.approx(block.error, rel=1e-3)


def test_the_command_is_the_bounded_solution():
    """For y[k + 1] - 0.5 y[k] = w[k] = 2 r[k] - r[k + 1]: r[k] is the sum of 2^-(i + 1) w[k + i]."""
    dt, plan = 0.1, move()
    loop = ct.ss(ct.tf([-1, 2], [1, -0.5], dt), inputs="r", outputs="y", name="loop")
    _, times, found, _ = followed(loop, plan, 3.0, dt, error=1e-9)
    later = plan(times[:, None] + dt * np.arange(61))
    wanted = (later[:, 1:] - 0.5 * later[:, :-1]) @ 2.0 ** -np.arange(1.0, 61.0)
    # The plan has ended 60 samples later; before the start of the preview the command is 0.
    assert np.abs(found.outputs[1] - wanted)[times >= -1e-9].max() < 1e-12
    assert np.abs(found.outputs[1] - wanted).max() < 1e-8


def test_a_plan_from_another_position_starts_at_rest_there():
    dt, plan = 0.1, move(initial=2.0, final=3.0)
    loop = sampled([-1, 2], [1, 3, 3, 1], dt)
    block = cp.create_feedforward_iosystem(loop, plan=plan)
    whole = ct.interconnect([block, loop], inputs=0, outputs=["y"])
    times = block.start + dt * np.arange(-20, 300)
    found = cp.compare(lambda name, plan: whole, {"plan": plan}, times).responses["plan"]
    assert np.abs(found.outputs[0] - plan(times)).max() < 1.0001e-6
    np.testing.assert_allclose(loop.A @ block.loop_state, block.loop_state - loop.B[:, 0] * 1.0, atol=1e-5)


def test_two_outputs_of_different_relative_degree():
    rng, dt = np.random.default_rng(2), 0.1
    a = 0.3 * rng.normal(size=(4, 4))
    b, c = rng.normal(size=(4, 2)), np.eye(2, 4)
    b[1] = 0.0
    loop = ct.ss(a, b, c, 0, dt, inputs=["r1", "r2"], outputs=["y1", "y2"], name="loop")
    plan = move(axes=2)
    block, _, _, error = followed(loop, plan, 5.0, dt)
    assert block.preview >= 2 * dt
    assert error.max() < max(1e-11, 1.0001 * block.error)


def test_a_pair_on_the_circle_near_1_is_a_notch_that_keeps_ringing_slowly():
    dt, w = 0.1, 3.0
    num = np.poly(np.exp([1j * w * dt, -1j * w * dt])).real
    loop = ct.ss(ct.tf(num / num.sum() * 0.25, [1, -1, 0.25], dt), inputs="r", outputs="y", name="loop")
    block, times, found, error = followed(loop, move(), 20.0, dt)
    ((frequency, amplitudes),) = block.remaining
    assert frequency == pytest.approx(w, rel=1e-9)
    after = found.outputs[1, times > 1.0] - 1.0
    assert np.abs(after).max() == pytest.approx(amplitudes[0], rel=2e-2)
    assert np.abs(after).max() <= amplitudes[0] * (1.0 + 1e-9)
    assert error.max() < 1e-11


def test_a_zero_at_1_holds_no_output():
    loop = ct.ss(ct.tf([1, -1], [1, -1, 0.25], 0.1), inputs="r", outputs="y", name="loop")
    with pytest.raises(ValueError, match=r"^plan must leave the motion of zeros of loop at 1 bounded"):
        cp.create_feedforward_iosystem(loop, plan=move())
    block, _, found, error = followed(loop, move(), 1.0, 0.1, finite=True)
    assert error.max() < 1e-11
    assert block.end_command[0] == pytest.approx(found.outputs[1, round((1.0 - block.start) / 0.1)], rel=1e-9)
    with pytest.raises(ValueError, match=r"^plan must start at 0 for a loop with a zero at 1, "):
        cp.create_feedforward_iosystem(loop, plan=move(initial=1.0, final=2.0))


def test_a_slow_zero_inside_is_told_from_one_on_the_circle_if_another_is_far():
    num = np.poly([-1e5, 0.99995])
    loop = ct.ss(ct.tf(num / num.sum(), [1, 0, 0, 0], 0.01), inputs="r", outputs="y", name="loop")
    block, _, _, error = followed(loop, move(), 2.0, 0.01)
    np.testing.assert_allclose(np.sort(block.zeros.real), [-1e5, 0.99995], rtol=1e-9)
    assert block.remaining == ()
    assert error.max() < 1e-8


# Bands


@pytest.mark.parametrize(
    ("degree", "zeros"),
    [(2, [-1.0]), (3, [-3.732, -0.268]), (4, [-9.899, -1.0, -0.101])],
)
def test_sampling_zeros_of_integrators(degree, zeros):
    """Åström, Hagander, Sternby (1984): of 1/s^n they tend to those of the Euler polynomials."""
    loop = sampled([1], np.eye(1, degree + 1)[0], 0.01)
    block = cp.create_feedforward_iosystem(loop, plan=move(), method="zpetc")
    np.testing.assert_allclose(np.sort(block.zeros.real), zeros, atol=6e-4)


@pytest.mark.parametrize(("dt", "zero"), [(0.1, "-0.9355"), (0.01, "-0.9934"), (0.001, "-0.9993")])
def test_zeros_that_ring_are_rejected(dt, zero):
    with pytest.raises(ValueError, match=rf'^zeros of loop must not ring from sample to sample, got {zero}, .*"zpetc"'):
        cp.create_feedforward_iosystem(sampled([1], [1, 2, 1], dt), plan=move())


def with_zero(zero):
    zeros = [zero, np.conj(zero)] if np.imag(zero) else [zero]
    num = np.poly(zeros).real
    return ct.ss(ct.tf(num / num.sum(), [1, 0, 0, 0], 0.1), inputs="r", outputs="y", name="loop")


@pytest.mark.parametrize(
    ("zero", "accepted"),
    [
        (-0.89, True),
        (-0.91, False),
        (-1.1, False),
        (-1.12, True),
        (0.91j, False),
        (0.95 * np.exp(0.5j), True),
        (0.95 * np.exp(0.55j), False),
        (0.95, True),
        (1.05, True),
        (1.05 * np.exp(0.5j), True),
    ],
)
def test_bands_of_zeros(zero, accepted):
    loop = with_zero(zero)
    if accepted:
        block, _, _, error = followed(loop, move(), 3.0, 0.1)
        assert error.max() <= max(block.error, 1e-11) * (1.0 + 1e-6)
    else:
        with pytest.raises(ValueError, match=r"^zeros of loop must not ring"):
            cp.create_feedforward_iosystem(loop, plan=move())


# Zero phase error tracking


class _Sine(Trajectory):
    """Sine over some seconds."""

    rate: float

    def __init__(self, rate, end):
        self._set_fields(labels=("y",), breakpoints=np.array([0.0, end]), rate=rate)

    def segment_jet(self, segment, s, order):
        n = np.arange(order + 1)[:, None, None]
        return self.rate**n * np.sin(self.rate * s + 0.5 * np.pi * n)

    def map_time(self, origin, target, rate):
        raise NotImplementedError

    def to_dict(self):
        raise NotImplementedError

    @classmethod
    def from_dict(cls, data):
        raise NotImplementedError


@pytest.mark.parametrize(("frequency", "gain"), [(2.0, 0.99736), (10.0, 0.93606)])
def test_its_gain_at_a_frequency(frequency, gain):
    dt, plan = 0.01, _Sine(2.0 * np.pi * frequency, 2.0)
    block, times, found, _ = followed(sampled([1], [1, 3, 3, 1], dt), plan, 0.5, dt, method="zpetc")
    inside = (times > 0.2) & (times < 1.8)
    ratio = found.outputs[0, inside] @ plan(times[inside]) / np.sum(plan(times[inside]) ** 2)
    assert ratio == pytest.approx(gain, abs=6e-6)
    # No phase: the output is a multiple of the plan at each sample.
    assert np.abs(found.outputs[0, inside] - ratio * plan(times[inside])).max() < 1e-9
    assert block.preview == pytest.approx(2 * dt)  # relative degree 1, one zero not cancelled


@pytest.mark.parametrize(("num", "den"), [([1], [1, 2, 1]), ([1, 2], [1, 3, 3, 1]), ([1], [1, 3, 3, 1])])
def test_its_error_and_gain_are_stated(num, den):
    dt, plan = 0.1, move()
    loop = sampled(num, den, dt)
    block, _, _, error = followed(loop, plan, 5.0, dt, method="zpetc")
    assert block.method == "zpetc"
    assert error.max() == pytest.approx(block.error, rel=1e-6)
    frequency, gain = block.gain
    fast = [zero for zero in block.zeros if abs(zero) > 0.9 and abs(np.angle(zero)) > np.pi / 6]
    b = np.poly(fast).real
    assert gain == pytest.approx(abs(np.polyval(b, np.exp(1j * frequency * dt)) / np.polyval(b, 1.0)) ** 2, rel=1e-9)
    assert 2.0 * np.pi < frequency < np.pi / dt


@pytest.mark.parametrize(("zeros", "poles"), [([-0.9355], [0.9577, 0.718, 0.51]), ([-1.5, 0.9], [0.958, 0.72, 0.5])])
def test_rounding_of_the_division_is_no_direct_influence(zeros, poles):
    """In a companion form the division by a zero leaves 1e-16 where the influence of the input is 0."""
    num, den = np.poly(zeros), np.poly(poles)
    loop = ct.ss(ct.tf(num * den.sum() / num.sum(), den, 0.02), inputs="r", outputs="y", name="loop")
    block, _, _, error = followed(loop, move(), 3.0, 0.02, method="zpetc")
    b = np.poly(zeros[:1]) / (1.0 - zeros[0])
    times = 0.02 * np.arange(-2, 152)
    wanted = np.convolve(np.convolve(move()(times), b), b[::-1])[2:-2] - move()(times[1:-1])
    assert error.max() == pytest.approx(np.abs(wanted).max(), rel=1e-6)
    assert error.max() == pytest.approx(block.error, rel=1e-6)


def test_slow_zeros_outside_are_pre_actuated_in_it():
    dt = 0.1
    loop = sampled(np.polymul([-1, 1], [1, 2]), [1, 6, 15, 20, 15], dt)
    block, _, _, error = followed(loop, move(), 20.0, dt, method="zpetc")
    assert block.zeros.real.max() == pytest.approx(np.exp(dt), rel=2e-2)
    assert block.preview > 5.0
    assert error.max() <= block.error * (1.0 + 1e-6)


def test_it_is_for_one_input():
    loop = ct.ss(0.5 * np.eye(2), np.eye(2), np.eye(2), 0, 0.1, inputs=["r1", "r2"], outputs=["y1", "y2"])
    with pytest.raises(
        ValueError, match=r'^method must be "exact" for a loop with 2 inputs, got "zpetc", for one input$'
    ):
        cp.create_feedforward_iosystem(loop, plan=move(axes=2), method="zpetc")


# Sampled controllers of continuous plants


DT = 0.02


def controller(**options):
    system = ct.ss(
        [[1.0]], [[1.6 * DT, -1.6 * DT]], [[1.0]], [[3.0, -3.0]], DT, inputs=["r", "y"], outputs="u", name="pi"
    )
    return cp.sample_hold(system, DT, **options)


def loop_of(num, den, *blocks):
    plant = ct.ss(ct.tf(num, den), inputs="u", outputs="y", name="plant")
    return ct.interconnect([*(blocks or (controller(),)), plant], inputs="r", outputs="y", name="loop")


@pytest.mark.parametrize(
    ("num", "den", "method", "initial"),
    [
        ([1], [1, 1], "exact", 2.0),
        pytest.param([1, 4], [1, 3, 2], "exact", 0.0, marks=pytest.mark.slow),
        ([-1, 30], [1, 12, 20], "exact", 2.0),
        pytest.param([1], [1, 1, 0], "zpetc", 2.0, marks=pytest.mark.slow),
    ],
)
def test_the_ripple_is_that_of_the_simulation(num, den, method, initial):
    loop, plan = loop_of(num, den), move(initial=initial, final=initial + 1.0)
    block = cp.create_feedforward_iosystem(loop, plan=plan, method=method)
    whole = ct.interconnect([block, loop], inputs=0, outputs=["y", "r"])
    times = block.start + DT / 16 * np.arange(16 * round((3.0 - block.start) / DT))
    found = cp.compare(lambda name, plan: whole, {"plan": plan}, times).responses["plan"]
    error = np.abs(found.outputs[0] - plan(times))
    assert block.ripple[0] == pytest.approx(error.max(), rel=1e-4, abs=1e-8)
    assert error[::16].max() <= max(1.01 * block.error, 1e-7)
    if method == "exact":
        assert 1e-6 < block.ripple[0] < 1e-2


def test_nested_loops_are_those_of_their_blocks():
    inner = ct.interconnect([controller()], inputs=["r", "y"], outputs=["u"], name="inner")
    plan = move()
    flat, nested = (
        cp.create_feedforward_iosystem(loop_of([1], [1, 1], *blocks), plan=plan) for blocks in ((), (inner,))
    )
    assert flat.ripple == pytest.approx(nested.ripple, rel=1e-12)
    np.testing.assert_allclose(flat.zeros, nested.zeros, rtol=1e-12)


def test_the_loop_at_its_samples():
    """A proportional controller of an integrator: y[k + 1] = (1 - K h) y[k] + K h r[k]."""
    gain = cp.sample_hold(ct.ss([], [], [], [[2.0, -2.0]], DT, inputs=["r", "y"], outputs="u", name="p"), DT)
    block, times, found, error = followed(loop_of([1], [1, 0], gain), move(), 1.0, DT)
    plan = move()
    expected = (plan(times[::4] + DT) - (1.0 - 2.0 * DT) * plan(times[::4])) / (2.0 * DT)
    np.testing.assert_allclose(found.outputs[1, ::4], expected, atol=1e-7)
    assert error[0, ::4].max() < 1e-7
    assert block.ripple[0] == pytest.approx(error.max(), rel=2e-2)


def test_the_block_of_a_discrete_model_runs_in_the_continuous_loop():
    """A design by a model at samples, wrapped by sample_hold, in the loop with the real plant."""
    plan = move()
    block = cp.create_feedforward_iosystem(sampled([3.0], [1, 3.0], DT), plan=plan)
    plant = ct.ss(ct.tf([3.0], [1, 3.0]), inputs="r", outputs="y", name="plant")
    whole = ct.interconnect([cp.sample_hold(block, DT), plant], inputs=0, outputs=["y"])
    times = block.start + DT * np.arange(100)
    assert np.abs(cp.simulate(whole, times).outputs.ravel() - plan(times)).max() < 1e-7
    with pytest.raises(ValueError, match=r"^timepts must begin a whole number of periods of 0.02 s from -0.02 s"):
        cp.simulate(whole, times - 0.013)


def test_runs_begin_at_a_sample():
    dt, loop = 0.1, sampled([1], [1, 1], 0.1)
    block = cp.create_feedforward_iosystem(loop, plan=move())
    whole = ct.interconnect([block, loop], inputs=0, outputs=["y"])
    times = block.start + dt * np.arange(20)
    with pytest.raises(
        ValueError, match=r"^timepts must begin a whole number of periods of 0.1 s from -0.1 s, a sample"
    ):
        cp.simulate(whole, times - 0.05, initial_state=0.0)
    with pytest.raises(ValueError, match=r"^timepts must begin at -0.1 s or earlier, .* got 0 s"):
        cp.simulate(whole, times + dt)
    assert cp.simulate(whole, times - 3 * dt).time.size == 20


# Errors


def nonlinear(t, x, u, params):
    return np.tanh(u[0] - u[1])


OTHER = ct.ss([], [], [], [[1.0]], 0.03, inputs="y", outputs="z", name="slow")


@pytest.mark.parametrize(
    ("blocks", "error", "message"),
    [
        (
            [cp.sample_hold(ct.nlsys(None, nonlinear, inputs=["r", "y"], outputs="u", dt=DT, name="sat"), DT)],
            TypeError,
            "sampled blocks of loop must be linear, got sat, NonlinearIOSystem",
        ),
        ([controller(offset=0.01)], ValueError, "sampled blocks of loop must have offset 0, got 0.01 s of pi"),
        (
            [controller(), cp.sample_hold(OTHER, 0.03)],
            ValueError,
            "sampled blocks of loop must have one period, got 0.02 s of pi and 0.03 s of slow",
        ),
        (
            [controller(), cp.create_delay_iosystem(0.1, inputs="z", outputs="zz")],
            TypeError,
            "blocks of loop must be linear and continuous, or sampled by sample_hold, got delay, Delay",
        ),
    ],
)
def test_other_sampled_loops_are_rejected(blocks, error, message):
    plant = ct.ss(ct.tf([1], [1, 1]), inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([*blocks, plant], inputs="r", outputs="y", name="loop", check_unused=False)
    with pytest.raises(error, match=f"^{message}"):
        cp.create_feedforward_iosystem(loop, plan=move())


def test_sampled_loops_have_as_many_inputs_as_outputs():
    plant = ct.ss(ct.tf([1], [1, 1]), inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([controller(), plant], inputs="r", outputs=["y", "u"], name="loop")
    with pytest.raises(ValueError, match=r"^loop must have as many inputs as outputs, got 1 and 2$"):
        cp.create_feedforward_iosystem(loop, plan=move())


def test_previews_of_too_many_samples():
    slow = ct.ss(ct.tf([-1, 1 + 1e-7], [1, -0.5], 0.01), inputs="r", outputs="y", name="loop")
    with pytest.raises(
        ValueError, match=r"^zeros of loop outside of the unit circle must require at most 5000000 samp"
    ):
        cp.create_feedforward_iosystem(slow, plan=move())
    with pytest.raises(ValueError, match=r"^preview must be at most 5000000 samples of 0.01 s, got 1e\+09 s$"):
        cp.create_feedforward_iosystem(slow, plan=move(), preview=1e9)


def test_sampled_loops_require_a_plan():
    with pytest.raises(
        ValueError, match=r"^loop loop with sampled blocks requires plan=: the command depends on later"
    ):
        cp.create_feedforward_iosystem(loop_of([1], [1, 1]))


def test_a_loop_without_a_sampling_time():
    with pytest.raises(ValueError, match=r"^loop must have a sampling time in seconds, got dt = True; give it to"):
        cp.create_feedforward_iosystem(ct.tf([1], [1, 0.5], True), plan=move())


def test_matrices_of_a_sampled_loop():
    """The sampled loop against the exact discretisation, written out."""
    from ctrlplan.systems.feedforward.sampled import _sampled_loop

    found = _sampled_loop(loop_of([1], [1, 1, 0])).loop
    a, b = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[1.0], [0.0]])
    flow = expm(DT * np.block([[a, b], [np.zeros((1, 3))]]))
    phi, gamma = flow[:2, :2], flow[:2, 2:]
    ki, kp, c = 1.6 * DT, 3.0, np.array([[0.0, 1.0]])
    whole = np.block([[phi - gamma * kp @ c, gamma], [-ki * c, np.ones((1, 1))]])
    np.testing.assert_allclose(found.A, whole, atol=1e-13)
    np.testing.assert_allclose(found.B, np.vstack([gamma * kp, [[ki]]]), atol=1e-13)
    np.testing.assert_allclose(found.C, [[0.0, 1.0, 0.0]], atol=1e-13)
