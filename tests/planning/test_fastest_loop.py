"""Minimum durations under limits on signals of a loop, against dense samples at many durations."""

import math
from functools import cache

import control as ct
import numpy as np
import pytest
from loop_oracle import QUINTIC, S_CURVE, SEPTIC, VIA, random_loop, responses, system_of
from repetitions import one_in
from scipy.integrate import trapezoid

import ctrlplan as cp
from ctrlplan import Waypoint

SERVO = cp.plants.integrator_lag_loop(1000.0)  # k/(s^2 + s) in unity feedback, k = 1000
SERVO_MATRICES = (
    np.array([[0.0, 1.0], [-1000.0, -1.0]]),
    np.array([[[0.0], [1000.0]]]),
    np.array([[1.0, 0.0]]),
    np.zeros((1, 1, 1)),
)

R, L, K, J, FRICTION = 1.2, 2e-3, 0.06, 3e-5, 1e-5
POSITION_GAIN, GAIN, INTEGRAL = 60.0, 0.06, 4.0


def motor_loop():
    """DC motor (24 V, 10 A) with a PI velocity loop, a P position loop and velocity feedforward."""
    motor = ct.ss(
        [[-R / L, -K / L, 0], [K / J, -FRICTION / J, 0], [0, 1, 0]], [[1 / L], [0], [0]], np.eye(3), np.zeros((3, 1)),
        inputs="u", outputs=["i", "w", "y"], name="motor",
    )  # fmt: skip
    control = ct.ss(
        [[0]],
        [[POSITION_GAIN, 1.0, -1.0, -POSITION_GAIN]],
        [[INTEGRAL]],
        [[GAIN * POSITION_GAIN, GAIN + K, -GAIN, -GAIN * POSITION_GAIN]],
        inputs=["r", "r_d1", "w", "y"],
        outputs="u",
        name="control",
    )
    return ct.interconnect([motor, control], inputs=["r", "r_d1"], outputs=["y", "u", "i", "w"], name="servo")


MOTOR_LIMITS = {"u": (-24.0, 24.0), "i": (-10.0, 10.0), "y": (-0.4, 20.4)}
MOVE = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 20, 0, 0)])


def excess(values, limits):
    """Maximum excess (ndurations,) of values (ndurations, nsignals, ntime), relative to the ranges of the limits."""
    low, high = np.array(limits).T[:, :, None]
    size = np.where(np.isfinite(high - low), high - low, np.where(np.isfinite(high), np.abs(high), np.abs(low)))
    return (np.maximum(values - high, low - values) / size).max(axis=(1, 2))


@cache
def overshoots():
    """Durations, and the peak of the servo's output at each, from dense samples."""
    durations = np.linspace(0.3, 0.8, 3001)
    parts = [responses(SERVO_MATRICES, QUINTIC, part, 600, 600, 0.1) for part in np.array_split(durations, 12)]
    return durations, np.concatenate([part.max(axis=(1, 2)) for part in parts])


@pytest.mark.slow
def test_islands_of_feasible_durations():
    """With 1 % overshoot k = 1000 has three intervals of feasible durations, which 3001 durations show."""
    durations, peaks = overshoots()
    inside = np.diff(np.concatenate([[False], peaks <= 1.01, [False]]).astype(int))
    starts, ends = durations[np.flatnonzero(inside == 1)], durations[np.flatnonzero(inside == -1) - 1]
    assert len(starts) == 3
    step = durations[1] - durations[0]
    assert ends[:2] == pytest.approx([0.3724, 0.629], abs=1e-3)
    limits = {"y": (None, 1.01)}
    for start, span in zip(starts, (None, (0.38, 2.0), (0.64, 2.0)), strict=True):
        found = cp.fastest(QUINTIC, limits, SERVO, durations=span)
        assert start - step <= found.duration <= start + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("span", [None, (0.38, 2.0), (0.64, 2.0)])
def test_first_of_each_island(span):
    """The limit is attained at the minimum duration, and violated at all shorter ones of the search."""
    found = cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO, durations=span)
    shorter = np.geomspace(max(found.searched[0], 0.02), found.duration * (1.0 - 1e-6), 150)
    peaks = responses(SERVO_MATRICES, QUINTIC, shorter, 600, 600, 0.1).max(axis=(1, 2))
    assert peaks.min() > 1.01 - 1e-5  # of samples
    assert found.active.value == pytest.approx(1.01, abs=1e-11)
    assert found.active.bound.name == "y"
    assert found.margins.satisfied
    at = responses(SERVO_MATRICES, QUINTIC, [found.duration], 20_000, 20_000, 0.01).max()
    assert 1.01 - 1e-6 <= at <= 1.01 + 1e-9
    assert found.statement == (
        f"no duration from {found.searched[0]:.4g} s to {found.duration:.6g} s satisfies every limit with a margin "
        "above 0.001 of its range"
    )
    assert found.statement.split(" satisfies")[0] in " ".join(str(found).split())


@pytest.mark.parametrize("plan", [MOVE, cp.SCurve(20.0, velocity=300, acceleration=6000, jerk=4e5)])
def test_motor_satisfies_its_limits_in_the_simulation(plan):
    """The answer, simulated with 200,001 samples, keeps each limit to 1e-9 of its range, and one is attained."""
    loop = motor_loop()
    found = cp.fastest(plan, MOTOR_LIMITS, loop)
    source = cp.create_source_iosystem(found.plan, 1, labels="r")
    closed = ct.interconnect([source, loop], inputs=0, outputs=["y", "u", "i", "w"])
    times = np.linspace(0.0, 3.0 * found.duration, 200_001)
    response = cp.simulate(closed, times)
    ratios = []
    for name, (low, high) in MOTOR_LIMITS.items():
        values = response.outputs[name]
        assert values.max() <= high + 1e-9 * (high - low)
        assert values.min() >= low - 1e-9 * (high - low)
        ratios.append(max((values.max() - high) / (high - low), (low - values.min()) / (high - low)))
    assert max(ratios) > -1e-6
    assert found.duration < 0.2
    assert found.searched[0] < 0.02


def test_motor_at_shorter_durations():
    """None of 200 shorter durations has a margin above 1e-3 of the range."""
    form = cp.prepare(motor_loop()).linear
    loop = (form.a, np.moveaxis(form.b[:, :, None], 1, 0), form.c, np.moveaxis(form.d[:, :, None], 1, 0))
    found = cp.fastest(MOVE, MOTOR_LIMITS, motor_loop())
    shorter = np.geomspace(found.searched[0], found.duration * (1.0 - 1e-9), 200)
    values = responses(loop, MOVE, shorter, 400, 800, 0.1)
    limits = [MOTOR_LIMITS["y"], MOTOR_LIMITS["u"], MOTOR_LIMITS["i"], (-math.inf, math.inf)]
    assert excess(values[:, :3], limits[:3]).min() > -1e-3


def random_problem(seed, stream=21):
    """Random loop, plan, limits of two outputs that hold at rest at both ends, and dense excesses."""
    rng = np.random.default_rng([seed, stream])
    loop = random_loop(rng, order=int(seed % 5 == 4))
    plan = (QUINTIC, SEPTIC, S_CURVE)[seed % 3]
    a, b, c, d = loop
    gain = (d[0] - c @ np.linalg.solve(a, b[0]))[:, 0]
    spare = np.abs(gain) * rng.uniform(0.01, 0.5, 2)
    limits = np.array([np.minimum(gain, 0.0) - spare, np.maximum(gain, 0.0) + spare * rng.uniform(0.2, 1.0, 2)]).T
    return loop, plan, limits


def check_random(seed, count, steps):
    loop, plan, limits = random_problem(seed)
    poles = np.abs(np.linalg.eigvals(loop[0]))
    tail = min(14_000, math.ceil(15.0 * poles.max() / poles.min() / 0.1))  # over two periods of the slowest mode
    named = {"y1": tuple(limits[0]), "y2": tuple(limits[1])}
    if excess(responses(loop, plan, [1e-6], steps, tail, 0.1), limits)[0] <= 0.0:  # as a step
        with pytest.raises(ValueError, match="limits must include one that a shorter plan would violate"):
            cp.fastest(plan, named, system_of(loop))
        return
    found = cp.fastest(plan, named, system_of(loop))
    low = max(found.searched[0], found.duration / 300.0)
    shorter = np.geomspace(low, found.duration * (1.0 - 1e-9), count)
    below = np.concatenate(
        [
            excess(responses(loop, plan, part, steps, tail, 0.1), limits)
            for part in np.array_split(shorter, -(-count // 200))
        ]
    )
    assert below.min() > -1e-3, "a shorter duration has a margin"
    at = excess(responses(loop, plan, [found.duration], 20_000, 20_000, 0.02), limits)[0]
    assert -1e-4 <= at <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("seed", one_in(2, [2, 3, 104, 103]))
def test_random_loops(seed):
    check_random(seed, 100, 400)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_many_random_loops(seed):
    check_random(100 + seed, 1000, 500)


@pytest.mark.slow
def test_sum_of_signals_is_a_region():
    """An edge of a region limits a sum: two axes that move together stay within a diamond."""
    loop = ct.ss(
        -np.diag([3.0, 8.0]), np.diag([3.0, 8.0]), [[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]], np.zeros((3, 2)),
        inputs=["a", "b"], outputs=["y1", "y2", "d"], name="pair",
    )  # fmt: skip
    plan = cp.stack([QUINTIC, QUINTIC], labels=("a", "b"))
    region = cp.Region(("y1", "y2"), [(-0.1, 0.0), (0.0, -0.1), (1.1, 1.0), (1.0, 1.1)])  # |y1 - y2| <= 0.1
    whole = cp.fastest(plan, {"pair": region}, loop)
    difference = cp.fastest(plan, {"d": (-0.1, 0.1)}, loop)
    assert whole.duration == pytest.approx(difference.duration, rel=1e-9)


@pytest.mark.slow
def test_root_mean_square_with_a_value():
    """The root mean square of the speed is that of the samples, and decides where it is violated longest."""
    loop = ct.ss(SERVO_MATRICES[0], SERVO_MATRICES[1][0], np.eye(2), np.zeros((2, 1)), inputs="r", outputs=["y", "v"])
    found = cp.fastest(QUINTIC, {"v": cp.Limits(rms=3.0), "y": (None, 1.05)}, loop)
    times = np.linspace(0.0, found.duration, 100_001)
    v = cp.simulate(loop, times, found.plan).outputs["v"]
    assert math.sqrt(trapezoid(v**2, times) / found.duration) == pytest.approx(3.0, rel=1e-8)
    assert found.active.bound.name == "RMS of v"
    assert "RMS of v evaluated at durations at most" in found.statement
    alone = cp.fastest(QUINTIC, {"y": (None, 1.05)}, loop)
    assert alone.duration < found.duration
    assert "RMS" not in alone.statement


def test_rate_of_a_signal():
    """With the rate of the voltage limited as well, the move takes longer, and the rate is attained."""
    found = cp.fastest(SEPTIC, {"y": cp.Limits(-0.1, 1.1, rate=3.0)}, SERVO)
    times = np.linspace(0.0, 3.0, 300_001)
    y = cp.simulate(SERVO, times, found.plan).outputs
    assert np.abs(np.gradient(y, times)).max() == pytest.approx(3.0, rel=1e-6)
    assert found.active.bound.name == "rate of y"


def test_part_of_the_plan():
    """A limit in an interval of the plan is stretched with it; the tail after the plan is limited from its end on."""
    given = SEPTIC.retime(2.0)
    found = cp.fastest(given, {"y": cp.Limits(0.999, 1.001, during=(2.0, 1e9))}, SERVO)
    times = np.linspace(found.duration, found.duration + 20.0, 200_001)
    y = cp.simulate(SERVO, np.append(0.0, times), found.plan).outputs[1:]
    assert np.abs(y - 1.0).max() == pytest.approx(1e-3, rel=1e-6)


def test_limits_of_plan_and_loop_together():
    """A velocity limit of the plan is active where it requires more time than the loop."""
    loose = cp.fastest(QUINTIC, {"loop": {"y": (None, 1.5)}, "plan": {"velocity": 2.0}}, SERVO)
    assert loose.duration == pytest.approx(15 / 16, rel=1e-12)
    assert loose.active.bound.name == "y_d1"
    assert loose.statement == "every shorter one violates a limit of the plan"
    given = cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO, durations=(0.36, 0.4))
    assert (given.duration, given.statement) == (0.36, "shorter ones not searched")
    tight = cp.fastest(QUINTIC, {"loop": {"y": (None, 1.01)}, "plan": {"velocity": 6.0}}, SERVO)
    assert tight.duration == pytest.approx(cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO).duration, rel=1e-9)


def test_no_overshoot_at_all():
    """A limit at the steady state itself can only be met by a loop that does not overshoot."""
    loop = ct.ss([[-2.0, 2.0], [0.0, -5.0]], [[0.0], [5.0]], [[1.0, 0.0]], [[0.0]], inputs="r", outputs="y")
    with pytest.raises(ValueError, match="limits must include one that a shorter plan would violate"):
        cp.fastest(QUINTIC, {"y": (0.0, 1.0)}, loop)
    assert cp.margins(QUINTIC, {"y": (0.0, 1.0)}, loop).satisfied


@pytest.mark.slow
def test_integrators():
    """A double integrator behind a lag, fed by the acceleration of the plan: the acceleration is that of the lag."""
    a, b = np.array([[-20.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0.0, 0.0, 20.0], [0, 0, 0], [0, 0, 0]])
    loop = ct.ss(a, b, np.eye(3), np.zeros((3, 3)), inputs=["r", "r_d1", "r_d2"], outputs=["acc", "v", "y"])
    plan = cp.PolySpline([Waypoint(0, 2, 0, 0), Waypoint(1, 5, 0, 0)])
    found = cp.fastest(plan, {"acc": 12.0, "y": (1.9, 5.1)}, loop)
    lag = (a[:1, :1], np.array([[[0.0]], [[0.0]], [[20.0]]]), np.eye(1), np.zeros((1, 1, 1)))
    durations = np.geomspace(found.searched[0], found.duration, 200)
    peaks = np.abs(responses(lag, plan, durations, 4000, 1000)).max(axis=(1, 2))
    assert peaks[-1] == pytest.approx(12.0, rel=1e-6)
    assert peaks[:-1].min() > 12.0 * (1.0 - 2e-3)
    margin = next(row for row in found.margins if row.bound.name == "y")
    assert margin.fraction == pytest.approx(0.1 / 1.6, rel=1e-10)  # of half the range


def test_an_integrator_of_the_plan():
    """The level of a tank after a closed plan is proportional to the duration, and is reached at the end."""
    tank = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="tank")
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(0.5, 1), Waypoint(1, 0, 0, 0)])
    level = np.polynomial.legendre.leggauss(20)
    area = float(0.5 * level[1] @ plan(0.5 + 0.5 * level[0]))
    found = cp.fastest(plan, {"y": cp.Limits(0.3, 1.0, during=(1.0, 2.0))}, tank)
    assert found.duration == pytest.approx(0.3 / area, rel=1e-11)


def test_a_gain_alone():
    """Without states the signal is a multiple of the plan: its rate is limited in closed form."""
    gain = ct.ss([], [], [], [[2.0]], inputs="r", outputs="y", name="gain")
    found = cp.fastest(QUINTIC, {"y": cp.Limits(-1.0, 3.0, rate=3.0)}, gain)
    assert found.duration == pytest.approx(2.0 * 15 / 8 / 3.0, rel=1e-11)
    with pytest.raises(ValueError, match="limits must include one that a shorter plan would violate"):
        cp.fastest(QUINTIC, {"y": (-1.0, 3.0)}, gain)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e-4, 1e-6])
def test_hardly_damped_mode(damping):
    """The overshoot after the move is that of the undamped mode, in closed form, up to the damping."""
    w = 100.0
    loop = ct.ss([[0.0, w], [-w, -2.0 * damping * w]], [[0.0], [w]], [[1.0, 0.0]], [[0.0]], inputs="r", outputs="y")
    found = cp.fastest(QUINTIC, {"y": (-0.01, 1.01)}, loop)

    def amplitude(duration):  # |int r'(t) e^(i w t) dt|, of a quintic
        t = np.linspace(0.0, duration, 20_001)
        return abs(trapezoid(QUINTIC.retime(duration)(t, 1) * np.exp(1j * w * t), t))

    assert amplitude(found.duration) == pytest.approx(0.01, rel=20.0 * damping + 1e-6)
    assert found.active.bound.name == "y"


@pytest.mark.slow
def test_far_from_the_origin():
    """Positions of a million with a range of 1, at a time of a million seconds."""
    far = cp.PolySpline([Waypoint(1e6, 1e6, 0, 0), Waypoint(1e6 + 1, 1e6 + 1, 0, 0)])
    found = cp.fastest(far, {"y": (1e6 - 1.0, 1e6 + 1.01)}, SERVO)
    near = cp.fastest(QUINTIC, {"y": (-1.0, 1.01)}, SERVO)
    assert found.duration == pytest.approx(near.duration, rel=1e-8)


@pytest.mark.slow
def test_waypoints_held():
    """With rest at both waypoints the spline has the same shape at every duration."""
    shape = cp.fastest(QUINTIC, {"y": (None, 1.05)}, SERVO)
    held = cp.fastest(QUINTIC, {"y": (None, 1.05)}, SERVO, hold="waypoints", durations=(0.1, 1.0))
    assert held.duration == pytest.approx(shape.duration, rel=1e-9)


@pytest.mark.slow
def test_what_cannot_be_satisfied():
    with pytest.raises(ValueError, match=r"hold=\"path\" must be local in time, got those of y, of a signal of a loop"):
        cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO, hold="path")
    with pytest.raises(ValueError, match=r"at any duration, got y = 1 .* it must be at most 0.9"):
        cp.fastest(QUINTIC, {"y": (None, 0.9)}, SERVO)
    with pytest.raises(ValueError, match=r"at any duration, got y = 0 .* it must be from 0.1 to 2"):
        cp.fastest(QUINTIC, {"y": (0.1, 2.0)}, SERVO)
    with pytest.raises(ValueError, match=r"satisfied for some duration .* static response to the path"):
        cp.fastest(VIA, {"y": (None, VIA.extrema().maximum[0] - 0.01)}, SERVO)
    with pytest.raises(ValueError, match=r"from 0.1 to 0.2 s, got none; nearest at"):
        cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO, durations=(0.1, 0.2))
    with pytest.raises(ValueError, match="resolution must be"):
        cp.fastest(QUINTIC, {"y": (None, 1.01)}, SERVO, resolution=0.0)
    runaway = ct.ss([[0.3]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="runaway")
    with pytest.raises(ValueError, match=r"runaway with a pole at 0\.3 in"):
        cp.fastest(QUINTIC, {"y": 2.0}, runaway)
