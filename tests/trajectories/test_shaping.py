"""Input shaping: textbook weights, the sensitivity curve, and oscillators that are left at rest."""

import itertools
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import trapezoid
from scipy.linalg import expm

from ctrlplan.planning import fastest, margins
from ctrlplan.trajectories import (
    PolySpline,
    Retimed,
    SCurve,
    Shaper,
    Step,
    Trajectory,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
    trajectory_from_dict,
)

MODES = [(1.0, 0.0), (2.5, 0.05), (7.0, 0.3), (0.2, 0.7)]
modes = pytest.mark.parametrize(("omega", "zeta"), MODES)
SPLINE = PolySpline([Waypoint(0.5, 1.0, 0.0), Waypoint(1.5, 2.0, 0.0)])


def response(plan, omega, zeta, after=0.0):
    """State (y, y') of y'' + 2 zeta omega y' + omega^2 y = omega^2 plan from rest, some time after the end of the plan.

    Exact: segments are polynomials of degree 3, of which a chain of integrators is the generator.
    """
    matrix = np.zeros((6, 6))
    matrix[0, 1] = matrix[2, 3] = matrix[3, 4] = matrix[4, 5] = 1.0
    matrix[1, :3] = [-(omega**2), -2.0 * zeta * omega, omega**2]
    y = np.array([plan.initial[0], 0.0])
    for begin, end in itertools.pairwise(plan.breakpoints):
        jet = plan.jet(begin, 4)[:, 0]
        assert jet[4] == 0.0
        y = (expm(matrix * (end - begin)) @ np.concatenate([y, jet[:4]]))[:2]
    return (expm(matrix * after) @ np.array([*y, plan.final[0], 0.0, 0.0, 0.0]))[:2]


def amplitude(plan, omega, zeta, after=0.0):
    """Of the vibration about the final position that is left: |y + (y' + zeta omega y)/omega_d i|."""
    y, slope = response(plan, omega, zeta, after) - np.array([plan.final[0], 0.0])
    return math.hypot(y, (slope + zeta * omega * y) / (omega * math.sqrt(1.0 - zeta**2)))


# Impulses


@modes
def test_weights_and_delays_are_those_of_the_textbook(omega, zeta):
    root = math.sqrt(1.0 - zeta**2)
    K, half = math.exp(-zeta * math.pi / root), math.pi / (omega * root)
    for shaper, weights in (
        (Shaper.zv(omega, zeta), [1.0, K]),
        (Shaper.zvd(omega, zeta), [1.0, 2.0 * K, K**2]),
        (Shaper.zvd(omega, zeta, 2), [1.0, 3.0 * K, 3.0 * K**2, K**3]),
    ):
        np.testing.assert_allclose(shaper.weights, np.array(weights) / sum(weights), rtol=1e-14)
        np.testing.assert_allclose(shaper.delays, half * np.arange(len(weights)), rtol=1e-15)
        assert shaper.duration == shaper.delays[-1]


def test_the_undamped_ones():
    np.testing.assert_array_equal(Shaper.zv(math.pi).delays, [0.0, 1.0])
    np.testing.assert_array_equal(Shaper.zv(math.pi).weights, [0.5, 0.5])
    np.testing.assert_array_equal(Shaper.zvd(math.pi).weights, [0.25, 0.5, 0.25])


@pytest.mark.parametrize("derivatives", [0, 1, 4, 20, 99])
def test_of_any_order(derivatives):
    """Binomial weights in whole numbers."""
    shaper = Shaper.zvd(1.0, 0.0, derivatives)
    n = derivatives + 1
    np.testing.assert_allclose(shaper.weights, [math.comb(n, k) / 2**n for k in range(n + 1)], rtol=1e-13)


def test_weights_that_sum_to_1_to_rounding_are_made_to():
    shaper = Shaper([0.0, 1.0], [0.5, 0.5 + 4e-13])
    assert math.fsum(shaper.weights) == pytest.approx(1.0, rel=3e-16, abs=0.0)
    assert shaper(Step(8.0)).final[0] == pytest.approx(8.0, rel=3e-16, abs=0.0)


# Residual vibration


@modes
@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_none_is_left_at_the_design_point(omega, zeta, derivatives):
    assert Shaper.zvd(omega, zeta, derivatives).residual(omega, zeta) <= 4e-16


@modes
@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_near_it_the_residual_grows_with_the_next_power(omega, zeta, derivatives):
    """Derivatives up to the given order are 0, the next one is not, as the slope shows."""
    shaper = Shaper.zvd(omega, zeta, derivatives)
    step = 1e-3 * (1.0 - zeta)
    for off in ((step, 0.0), (-step, 0.0), (0.0, step)):
        near, far = (float(shaper.residual(omega * (1.0 + k * off[0]), zeta + k * off[1])) for k in (1.0, 2.0))
        assert math.log2(far / near) == pytest.approx(derivatives + 1, abs=0.02)


def test_the_sensitivity_curve_without_damping():
    """|cos(pi/2 w/w0)| of ZV, and its powers."""
    omega = np.linspace(0.0, 5.0, 101).reshape(1, 101)
    for derivatives in range(3):
        found = Shaper.zvd(2.0, 0.0, derivatives).residual(omega)
        assert found.shape == (1, 101)
        wanted = np.abs(np.cos(0.25 * math.pi * omega)) ** (derivatives + 1)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-15)


@given(st.lists(st.tuples(st.floats(0.01, 2.0), st.floats(-1.0, 2.0)), min_size=1, max_size=5), st.sampled_from(MODES))
def test_residual_as_singer_and_seering_write_it(impulses, mode):
    delays = np.cumsum([delay for delay, _ in impulses])
    weights = np.array([weight for _, weight in impulses])
    weights[0] += 1.0 - weights.sum()
    omega, zeta = mode
    grown = weights * np.exp(zeta * omega * delays)
    angle = omega * math.sqrt(1.0 - zeta**2) * delays
    wanted = math.exp(-zeta * omega * delays[-1]) * math.hypot(grown @ np.cos(angle), grown @ np.sin(angle))
    assert Shaper(delays, weights).residual(omega, zeta) == pytest.approx(wanted, rel=1e-12, abs=1e-14)


@modes
@pytest.mark.parametrize("detuning", [0.5, 0.9, 1.2, 3.0])
def test_residual_is_what_an_oscillator_keeps_of_a_shaped_step(omega, zeta, detuning):
    """Of a unit step the vibration begins with the amplitude 1/sqrt(1 - zeta^2)."""
    for shaper in (Shaper.zv(omega, zeta), Shaper.zvd(omega, zeta), Shaper([0.1, 0.3, 0.9], [0.5, 0.7, -0.2])):
        preserved = amplitude(shaper(Step(1.0)), detuning * omega, zeta) * math.sqrt(1.0 - zeta**2)
        assert preserved == pytest.approx(float(shaper.residual(detuning * omega, zeta)), rel=1e-11, abs=1e-14)


@modes
@pytest.mark.parametrize(
    "plan",
    [
        Step(1.0, -0.5, 0.2),
        SCurve(2.0, 1.0, velocity=3.0, acceleration=20.0, jerk=300.0, time=1.0),
        Trapezoid(-1.0, velocity=8.0, acceleration=30.0),
        SPLINE,
    ],
    ids=["step", "s-curve", "trapezoid", "spline"],
)
def test_an_oscillator_is_left_at_rest_by_the_shaped_plan_only(plan, omega, zeta):
    size = abs(plan.final - plan.initial)[0]
    for shaper in (Shaper.zv(omega, zeta), Shaper.zvd(omega, zeta)):
        shaped = shaper(plan)
        for after in (0.0, 0.7 / omega):
            assert amplitude(shaped, omega, zeta, after) <= 1e-13 * size
        assert amplitude(plan, omega, zeta, plan.start + shaper.duration) > 1e-3 * size
        # Another mode is not.
        assert amplitude(shaped, 1.3 * omega, zeta) > 1e-5 * size


def test_one_after_the_other_for_two_modes():
    first, second = (2.0, 0.05), (5.3, 0.02)
    both = Shaper.zv(*first).then(Shaper.zvd(*second))
    shaped = both(SPLINE)
    assert both.delays.size == 6
    assert both.duration == pytest.approx(Shaper.zv(*first).duration + Shaper.zvd(*second).duration, rel=1e-15)
    for mode in (first, second):
        assert both.residual(*mode) <= 1e-15
        assert amplitude(shaped, *mode) <= 1e-13
    t = np.linspace(0.0, 8.0, 97)
    in_turn = Shaper.zvd(*second)(Shaper.zv(*first)(SPLINE))
    assert np.abs(shaped.jet(t, 2) - in_turn.jet(t, 2)).max() <= 1e-14 * 6


def test_impulses_that_meet_are_one():
    """ZV after ZV is ZVD, and 0.1 + 0.2 is 0.3."""
    for omega, zeta in MODES:
        twice, wanted = Shaper.zv(omega, zeta).then(Shaper.zv(omega, zeta)), Shaper.zvd(omega, zeta)
        np.testing.assert_allclose(twice.delays, wanted.delays, rtol=1e-15)
        np.testing.assert_allclose(twice.weights, wanted.weights, rtol=1e-15)
    both = Shaper([0.0, 0.1, 0.3], [0.2, 0.3, 0.5]).then(Shaper([0.0, 0.2], [0.5, 0.5]))
    np.testing.assert_allclose(both.delays, [0.0, 0.1, 0.2, 0.3, 0.5], rtol=1e-15)
    np.testing.assert_allclose(both.weights, [0.1, 0.15, 0.1, 0.4, 0.25], rtol=1e-15)
    alone = Shaper([0.0], [1.0]).then(Shaper([0.0], [1.0]))
    assert (alone.delays.tolist(), alone.weights.tolist()) == ([0.0], [1.0])


# Shaped plans


def test_a_shaped_plan_is_the_sum_of_delayed_parts():
    points = [Waypoint.from_jets(1.0, x=[0.0, 0.3], z=[2.0, 1.0]), Waypoint.from_jets(3.0, x=[1.0, 0.0], z=[-1.0])]
    plan = TrigSpline(points, alpha=2.0)
    shaper = Shaper([0.25, 1.0, 4.0], [0.5, -0.3, 0.8])
    shaped = shaper(plan)
    t = np.linspace(0.0, 8.0, 161) + 1e-3
    wanted = 0.5 * plan.jet(t - 0.25, 3) - 0.3 * plan.jet(t - 1.0, 3) + 0.8 * plan.jet(t - 4.0, 3)
    np.testing.assert_allclose(shaped.jet(t, 3), wanted, rtol=0, atol=1e-12)
    assert isinstance(shaped, Trajectory)
    assert shaped.labels == plan.labels
    assert (shaped.start, shaped.end) == (1.25, 7.0)
    np.testing.assert_array_equal(shaped.breakpoints, [1.25, 2.0, 3.25, 4.0, 5.0, 7.0])


def test_a_shaped_step_is_a_staircase():
    shaped = Shaper([0.0, 1.0, 3.0], [0.25, 0.5, 0.25])(Step([4.0, 0.0], [0.0, 8.0], 1.0))
    np.testing.assert_array_equal(shaped.breakpoints, [1.0, 2.0, 4.0])
    t = [0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 9.0]
    np.testing.assert_array_equal(shaped(t), [[0, 1, 1, 3, 3, 4, 4], [8, 6, 6, 2, 2, 0, 0]])
    np.testing.assert_array_equal(shaped.jet(4.0, 0, left=True)[0], [3.0, 2.0])
    jumps = [(jump.time, jump.size) for jump in shaped.jumps(1) if jump.label == "y1"]
    assert jumps == [(1.0, 1.0), (2.0, 2.0), (4.0, 1.0)]


@examples(50)
@given(st.floats(0.1, 50.0), st.floats(0.0, 0.99), st.integers(0, 3), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_rounding_does_not_move_the_ends(omega, zeta, derivatives, initial, final):
    shaped = Shaper.zvd(omega, zeta, derivatives)(Step(final, initial, 2.0))
    assert shaped.initial[0] == pytest.approx(initial, rel=1e-15, abs=1e-300)
    assert shaped.final[0] == pytest.approx(final, rel=1e-15, abs=1e-300)
    assert math.fsum(Shaper.zvd(omega, zeta, derivatives).weights) == pytest.approx(1.0, rel=3e-16)


def test_a_shaped_plan_is_a_trajectory_like_others(tmp_path):
    shaped = Shaper.zvd(3.0, 0.1)(stack([SPLINE, Step(1.0)]))
    shaped.save(tmp_path / "plan.json")
    t = np.linspace(0.0, 4.0, 41)
    np.testing.assert_array_equal(type(shaped).from_dict(shaped.to_dict()).jet(t, 2), shaped.jet(t, 2))
    assert shaped.shift(1.0).end == pytest.approx(shaped.end + 1.0, rel=1e-15)


# The object


def test_it_cannot_be_changed():
    delays, weights = np.array([0.0, 1.0]), np.array([0.5, 0.5])
    shaper = Shaper(delays, weights)
    delays[:], weights[:] = 9.0, 9.0
    for made in (shaper, pickle.loads(pickle.dumps(shaper))):
        assert (made.delays.tolist(), made.weights.tolist()) == ([0.0, 1.0], [0.5, 0.5])
        assert not made.delays.flags.writeable
        assert not made.weights.flags.writeable
        with pytest.raises(AttributeError, match="immutable"):
            made.delays = delays
    assert repr(shaper) == "<Shaper of 2 impulses over 1 s>"


@pytest.mark.parametrize(
    ("delays", "weights", "message"),
    [
        ([0.0, 1.0], [1.0], "weights must be as many as delays, 2, got 1"),
        ([0.0, 0.0], [0.5, 0.5], r"delays must increase strictly, got delays\[1\] = 0.0 after 0.0"),
        ([0.0, 2.0, 1.0], [0.5, 0.5, 0.0], r"delays must increase strictly, got delays\[2\] = 1.0 after 2.0"),
        ([-1.0, 2.0], [0.5, 0.5], "delays must be at least 0, got -1.0"),
        ([0.0, 1.0], [0.5, 0.4], "weights must sum to 1, got 0.9"),
        ([0.0, 1.0], [math.nan, 0.5], "weights must be finite"),
        ([0.0, math.inf], [0.5, 0.5], "delays must be finite"),
        ([], [], r"delays must be of shape \(nimpulses,\), got shape \(0,\)"),
        (0.0, 1.0, r"delays must be of shape \(nimpulses,\), got shape \(\)"),
        (["a"], [1.0], "delays must be numbers"),
    ],
)
def test_impulses_that_are_rejected(delays, weights, message):
    with pytest.raises(ValueError, match=message):
        Shaper(delays, weights)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "frequency must be finite and above 0, got 0.0"),
        ((-1.0,), "frequency must be finite and above 0, got -1.0"),
        ((math.inf,), "frequency must be finite and above 0, got inf"),
        ((1.0, 1.0), r"damping must lie in \[0, 1\), got 1.0"),
        ((1.0, -0.1), r"damping must lie in \[0, 1\), got -0.1"),
        ((1.0, math.nan), r"damping must lie in \[0, 1\), got nan"),
    ],
)
def test_modes_that_are_rejected(arguments, message):
    for make in (Shaper.zv, Shaper.zvd):
        with pytest.raises(ValueError, match=message):
            make(*arguments)


def test_other_arguments_that_are_rejected():
    shaper = Shaper.zv(1.0)
    with pytest.raises(ValueError, match="derivatives must be an integer of at least 0, got -1"):
        Shaper.zvd(1.0, 0.0, -1)
    with pytest.raises(ValueError, match=r"frequency must be at least 0 and finite, got \[1.0, -1.0\]"):
        shaper.residual([1.0, -1.0])
    with pytest.raises(ValueError, match=r"damping must lie in \[0, 1\), got 1.5"):
        shaper.residual(1.0, 1.5)
    with pytest.raises(TypeError, match="plan must be a Trajectory, got float"):
        shaper(1.0)
    with pytest.raises(TypeError, match="other must be a Shaper, got float"):
        shaper.then(1.0)


# The time scale is that of the mode


SHAPED = Shaper.zv(6.0)(SPLINE)
UNIT_RATE = PolySpline([Waypoint(1.0, SHAPED.start), Waypoint(1.0 + SHAPED.duration, SHAPED.end)])
MADE_OF_SHAPED = {
    "itself": SHAPED,
    "shaped step": Shaper.zvd(3.0)(Step(1.0)),
    "shaped twice": Shaper.zv(2.0)(SHAPED),
    "multiple": -2.0 * SHAPED,
    "sum": SPLINE + SHAPED,
    "stacked": stack([SPLINE, SHAPED], labels=["a", "b"]),
    "selected": stack([SPLINE, SHAPED], labels=["a", "b"]).select("b"),
    "joined": PolySpline([Waypoint(0.0, 0.0), Waypoint(1.0, 1.0)]).then(SHAPED),
    "shifted in time": Retimed(SHAPED, PolySpline([Waypoint(1.0, 0.5), Waypoint(SHAPED.duration + 1.0, SHAPED.end)])),
    "read from a file": trajectory_from_dict(SHAPED.to_dict()),
    "shifted": SHAPED.shift(7.0),
}


@pytest.mark.parametrize("factor", [0.5, 1.01, 3.0])
@pytest.mark.parametrize("name", MADE_OF_SHAPED)
def test_a_shaped_plan_is_not_retimed(name, factor):
    """Delays that scale with the duration would leave the vibration that the shaper is there for."""
    plan = MADE_OF_SHAPED[name]
    with pytest.raises(ValueError, match="the delays of the shaper would change with it"):
        plan.retime(factor * plan.duration)
    with pytest.raises(ValueError, match="the delays of the shaper would change with it"):
        Retimed(plan, PolySpline([Waypoint(0.0, plan.start), Waypoint(factor * plan.duration, plan.end)]))


@pytest.mark.parametrize("name", MADE_OF_SHAPED)
def test_a_shaped_plan_can_be_shifted_but_not_retimed(name):
    plan = MADE_OF_SHAPED[name]
    t = np.linspace(plan.start - 0.1, plan.end + 0.1, 58)
    for moved in (
        plan.shift(3.0),
        plan.retime(plan.duration).shift(3.0),
        plan.retime(plan.duration * (1 + 1e-15)).shift(3.0),
    ):
        np.testing.assert_allclose(moved(t + 3.0), plan(t), rtol=0, atol=1e-12)


def test_a_law_of_rate_1_on_average_is_not_enough():
    law = PolySpline([Waypoint(SHAPED.start, SHAPED.start, 1.2), Waypoint(SHAPED.end, SHAPED.end, 1.2)])
    with pytest.raises(ValueError, match=r"law must have the rate 1 where the plan is shaped, got 0\.\d+ to 1\.2"):
        Retimed(SHAPED, law)


@pytest.mark.parametrize("hold", ["shape", "path"])
@pytest.mark.parametrize("limits", [{"velocity": 0.7}, {"speed": 0.7}, {"velocity": 3.0, "acceleration": 1.0}])
def test_fastest_does_not_undo_shaping(limits, hold):
    quantities = (lambda jet: {"speed": np.abs(jet[1, 0])}) if "speed" in limits else None
    with pytest.raises(
        ValueError,
        match=r"(a shaped plan must keep its duration|law must have the rate 1 where the plan is shaped).*, then shape",
    ):
        fastest(SHAPED, limits, quantities, hold=hold)


@modes
def test_a_plan_made_fastest_before_it_is_shaped(omega, zeta):
    """What the message says to do leaves no vibration and keeps limits of derivatives."""
    limits = {"velocity": 0.7, "acceleration": 2.0}
    found = Shaper.zv(omega, zeta)(fastest(PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]), limits).plan)
    assert margins(found, limits).active.fraction >= -1e-12
    t = np.linspace(found.start, found.end, 200_001)
    # Exact for every reference: the convolution with the response to an impulse, by the trapezoidal rule.
    mode = (-zeta + 1j * math.sqrt(1.0 - zeta**2)) * omega
    left = trapezoid(found(t, 1) * np.exp(mode * (found.end - t)), t)
    alone = trapezoid(found(t, 1), t)
    assert abs(left) <= 1e-8 * alone


@pytest.mark.parametrize("wrong", [0.95, 1.05])
def test_what_retiming_would_do_to_a_shaper(wrong):
    """The delays of a ZV shaper scaled by 5 %: a residual of |cos(pi/2 1.05)|, where it was 0."""
    shaper = Shaper.zv(6.0)
    scaled = Shaper(wrong * shaper.delays, shaper.weights)
    assert shaper.residual(6.0) <= 1e-15
    assert scaled.residual(6.0) == pytest.approx(abs(math.cos(0.5 * math.pi * wrong)), rel=1e-12)


def test_delays_that_are_not_representable_are_reported():
    """Times near 2^48 s are 1/16 s apart, near 2^35 s 8 us: a delay of pi/3 s is rounded by a part of that."""
    shaper = Shaper.zv(3.0)

    def late(start):
        return PolySpline([Waypoint(start, 0, 0, 0), Waypoint(start + 1.0, 1, 0, 0)])

    with pytest.raises(ValueError, match=r"delays must be representable, got an error of .* origin nearer"):
        shaper(late(2.0**48))
    with pytest.warns(UserWarning, match="delays must be representable"):
        shaper(late(2.0**35))
    assert shaper(late(2.0**20)).duration == pytest.approx(1.0 + math.pi / 3.0, rel=1e-9)
