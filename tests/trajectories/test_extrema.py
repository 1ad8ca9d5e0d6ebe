"""Extrema and bounds are facts about the interval: against roots in many digits, closed forms and dense samples."""

import mpmath as mp
import numpy as np
import pytest
import sympy
from scipy.optimize import brentq
from trajectory_oracle import Direct, waypoints

from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    Retimed,
    SCurve,
    Step,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
)

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

MOVE = PolySpline(waypoints([0.0, 2.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def critical_times(oracle, nu):
    """Roots of the derivative of order nu + 1 in the interval, by the roots of a polynomial in 50 digits."""
    with mp.workdps(oracle.digits):
        if not oracle.alpha:
            powers = oracle.coefficients[nu + 1 :]
            series = [c * mp.ff(j, nu + 1) for j, c in enumerate(powers, nu + 1)]
            found = mp.polyroots(series[::-1], maxsteps=500, extraprec=400)
            u = [z.real for z in found if abs(z.imag) < 1e-20 and 0 < z.real < 1]
        else:  # the trigonometric polynomial as a polynomial in z = exp(i tau)
            m, c = oracle.m, oracle.coefficients
            pairs = [(c[2 * k - 1], c[2 * k]) for k in range(1, len(c) // 2 + len(c) % 2)]
            if oracle.size % 2 == 0:
                pairs.append((-c[-1] * mp.sin(m * oracle.gamma), c[-1] * mp.cos(m * oracle.gamma)))
            series = [mp.mpc(0)] * (2 * m + 1)
            for k, (a, b) in enumerate(pairs, 1):
                turn = mp.mpc(0, k) ** (nu + 1)
                series[m + k] = turn * mp.mpc(a, -b) / 2
                series[m - k] = mp.conj(series[m + k])
            found = mp.polyroots(series[::-1], maxsteps=500, extraprec=400)
            tau = [mp.arg(z) % (2 * mp.pi) for z in found if abs(abs(z) - 1) < 1e-20]
            u = [t / oracle.alpha for t in tau if t < oracle.alpha]
        return [oracle.start + x * oracle.duration for x in u]


def exact_extrema(oracle, nu):
    with mp.workdps(oracle.digits):
        times = [oracle.start, oracle.start + oracle.duration, *critical_times(oracle, nu)]
        values = [mp.fdot(oracle.coefficients, oracle.functions(t, nu)) for t in times]
        low, high = values.index(min(values)), values.index(max(values))
        return [float(v) for v in (values[low], values[high], times[low], times[high])]


@pytest.mark.parametrize("nu", range(4))
@pytest.mark.parametrize("alpha", [0.0, 1.0, np.pi, 5.5])
@pytest.mark.parametrize(
    ("times", "lengths"),
    [([0.0, 2.0], [3, 3]), ([1.0, 1.3, 4.0], [3, 2, 2]), ([0.0, 1.0, 1.1, 2.0], [3, 3, 3, 3])],
    ids=["N6", "N7", "N12"],
)
def test_roots_in_fifty_digits(times, lengths, alpha, nu):
    rng = np.random.default_rng(4)
    jets = [rng.normal(size=k).tolist() for k in lengths]
    low, high, time_low, time_high = exact_extrema(Direct(times, jets, alpha), nu)
    found = TrigSpline(waypoints(times, jets), alpha=alpha).extrema(nu)
    size, duration = max(-low, high), times[-1] - times[0]
    assert abs(found.minimum[0] - low) <= 1e-13 * size
    assert abs(found.maximum[0] - high) <= 1e-13 * size
    assert abs(found.time_min[0] - time_low) <= 1e-6 * duration
    assert abs(found.time_max[0] - time_high) <= 1e-6 * duration


def test_a_polynomial_of_sympy():
    """u^4 (1 - u): its derivatives have the roots 0, 4/5; 0, 3/5; 0, 2/5; 1/5."""
    u = sympy.symbols("u")
    y = u**4 * (1 - u)
    jets = [[float(y.diff(u, k).subs(u, at)) for k in range(3)] for at in (0, 1)]
    plan = PolySpline(waypoints([0.0, 1.0], jets))
    for nu in range(4):
        critical = [r for r in sympy.roots(y.diff(u, nu + 1), u) if 0 <= r <= 1]
        values = {at: float(y.diff(u, nu).subs(u, at)) for at in [0, 1, *critical]}
        found = plan.extrema(nu)
        assert found.maximum[0] == pytest.approx(max(values.values()), abs=1e-13)
        assert found.minimum[0] == pytest.approx(min(values.values()), abs=1e-13)
        assert found.time_max[0] == pytest.approx(float(max(values, key=values.get)), abs=1e-7)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_narrow_peaks(gap):
    """A bump of which a thousand samples would see nothing; in closed form (1 - s^2)^3 has height 1."""
    times = [0.0, 0.5 - gap, 0.5, 0.5 + gap, 1.0]
    rest = [0.0, 0.0, 0.0]
    plan = PiecewiseSpline(waypoints(times, [rest, rest, [1.0, 0.0, 0.0], rest, rest]))
    found = plan.extrema()
    assert abs(found.minimum[0]) <= 1e-15
    assert abs(found.time_max[0] - 0.5) <= 1e-6 * gap
    assert found.maximum[0] == pytest.approx(1.0, rel=1e-13)
    assert plan.peak(1)[0] == pytest.approx(1.875 / gap, rel=1e-9)  # the gap itself is rounded at 0.5
    assert plan.peak(2)[0] == pytest.approx(10 / np.sqrt(3) / gap**2, rel=1e-9)


def test_a_narrow_peak_of_a_function_of_the_jet():
    """1/(y^2 + 1e-6) along y from -1 to 1: height 1e6 where y = 0, a thousandth wide."""
    plan = PolySpline(waypoints([0.0, 1.0], [[-1.0, 0.3], [1.0, 2.0]]))
    found = plan.extrema_of(lambda jet: 1 / (jet[0, 0] ** 2 + 1e-6), 0)
    assert found.maximum[0] == pytest.approx(1e6, rel=1e-12)
    assert plan(found.time_max[0]) == pytest.approx(0.0, abs=1e-9)


def test_many_extrema_of_forty_constraints():
    """cos(39 arccos x): the Chebyshev polynomial swings between -1 and 1, and its slope reaches 39^2 at the ends."""
    x = np.cos(np.pi * np.arange(39, -1, -1) / 39)
    plan = PolySpline([Waypoint(t, v) for t, v in zip(x, np.cos(39 * np.arccos(x)), strict=True)])
    assert plan.extrema().maximum[0] == pytest.approx(1, rel=1e-12)
    assert plan.extrema().minimum[0] == pytest.approx(-1, rel=1e-12)
    assert plan.peak(1)[0] == pytest.approx(39**2, rel=1e-10)


def test_both_limits_of_a_jump_count():
    """Straight segments of slopes 1 and -3; quintic segments whose jerk jumps from 60 to 60 - 120."""
    lines = PiecewiseSpline(waypoints([0.0, 1.0, 2.0], [[0.0], [1.0], [-2.0]]))
    found = lines.extrema(1)
    assert (found.maximum[0], found.minimum[0]) == (pytest.approx(1, rel=1e-14), pytest.approx(-3, rel=1e-14))
    there_and_back = MOVE.retime(1.0).then(1.0 * MOVE.retime(1.0) * -1 + Step(1.0, 1.0))
    assert there_and_back.peak(3)[0] == pytest.approx(60, rel=1e-13)
    found = there_and_back.extrema(3)
    assert (found.maximum[0], found.minimum[0]) == (pytest.approx(60, rel=1e-13), pytest.approx(-60, rel=1e-13))
    apart = stack([lines, lines.shift(0.5)]).extrema_of(lambda jet: jet[1, 0] - jet[1, 1], 1)
    assert (apart.maximum[0], apart.minimum[0]) == (pytest.approx(3, rel=1e-13), pytest.approx(-4, rel=1e-13))


def test_held_positions_count():
    """A step inside a sum, held values outside."""
    plan = MOVE + Step(0.0, initial=3.0, time=-1.0)
    found = plan.extrema()
    assert (found.maximum[0], found.minimum[0]) == (3.0, 0.0)
    assert Step([2.0, -1.0], initial=[0.0, 4.0]).extrema().maximum.tolist() == [2.0, 4.0]
    assert Step([2.0, -1.0], initial=[0.0, 4.0]).extrema().minimum.tolist() == [0.0, -1.0]
    assert Step(2.0).peak(1).tolist() == [0.0]


def test_the_earliest_time_of_an_extremum():
    assert PolySpline(waypoints([3.0, 4.0], [[2.0], [2.0]])).extrema().time_max[0] == 3.0
    lines = PiecewiseSpline(waypoints([0.0, 1.0, 2.0, 3.0], [[0.0], [1.0], [0.0], [1.0]]))
    assert (lines.extrema().time_min[0], lines.extrema().time_max[0]) == (0.0, 1.0)


def test_several_axes_have_their_own():
    plan = stack([MOVE, -2 * MOVE, MOVE.shift(5.0)])
    found = plan.extrema(1)
    np.testing.assert_allclose(found.maximum, np.array([1.875, 0, 1.875]) / 2, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.minimum, [0, -1.875, 0], rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(found.time_max[[0, 2]], [1.0, 6.0], rtol=1e-9)


def test_smooth_functions_of_the_jet():
    """Speed on a circle run with minimum jerk; power y' y'' of minimum jerk in closed form."""
    assert MOVE.extrema_of(lambda jet: jet[0, 0], 0).maximum[0] == pytest.approx(1, rel=1e-15)
    u = sympy.symbols("u")
    y = 10 * u**3 - 15 * u**4 + 6 * u**5
    power = sympy.expand(y.diff(u) * y.diff(u, 2))
    values = [
        float(power.subs(u, r))
        for r in sympy.Poly(power.diff(u), u).nroots(n=30, maxsteps=500)
        if r.is_real and 0 <= r <= 1
    ]
    found = MOVE.extrema_of(lambda jet: jet[1, 0] * jet[2, 0], 2)
    assert found.maximum[0] == pytest.approx(max(values) / 8, rel=1e-13)
    assert found.minimum[0] == pytest.approx(min(values) / 8, rel=1e-13)

    circle = TrigSpline.cyclic([Waypoint(t, [np.cos(t), np.sin(t)]) for t in np.arange(5.0)], 2 * np.pi)
    speed = circle.extrema_of(lambda jet: np.hypot(jet[1, 0], jet[1, 1]), 1)
    assert speed.maximum[0] == pytest.approx(1, rel=1e-13)
    assert speed.minimum[0] == pytest.approx(1, rel=1e-13)


def test_several_functions_at_once():
    found = MOVE.extrema_of(lambda jet: np.stack([jet[1, 0], jet[0, 0] ** 2, 3 - jet[0, 0]]), 1)
    np.testing.assert_allclose(found.maximum, [0.9375, 1.0, 3.0], rtol=1e-13)
    np.testing.assert_allclose(found.minimum, [0.0, 0.0, 2.0], rtol=1e-13, atol=1e-15)


KINKED = {
    "abs": (lambda y: np.abs(y), 0.0, 1.0),
    "abs off centre": (lambda y: np.abs(y - 0.3), 0.0, 1.3),
    "minus abs": (lambda y: -np.abs(y), -1.0, 0.0),
    "max": (lambda y: np.maximum(y, -2 * y), 0.0, 2.0),
    "min": (lambda y: np.minimum(y, 0.5 - y), -1.0, 0.25),
    "clip": (lambda y: np.clip(y, -0.2, 0.7), -0.2, 0.7),
}


@pytest.mark.slow
@pytest.mark.parametrize("harmonic", [1, 3, 8])
@pytest.mark.parametrize("name", KINKED)
def test_kinked_functions(name, harmonic):
    """Of a sine with up to 32 kinks, none at a dyadic time: values at kinks to 1e-8, at smooth extrema exactly."""
    function, low, high = KINKED[name]
    times = np.arange(2 * harmonic + 1) / (2 * harmonic + 1)
    sine = TrigSpline.cyclic(waypoints(times, np.sin(2 * np.pi * harmonic * times + 0.7)[:, None]), 1.0)
    assert sine.peak()[0] == pytest.approx(1, rel=1e-12)
    found = sine.extrema_of(lambda jet: function(jet[0, 0]), 0)
    assert found.minimum[0] == pytest.approx(low, rel=1e-12, abs=1e-8)
    assert found.maximum[0] == pytest.approx(high, rel=1e-12, abs=1e-8)
    assert function(sine(found.time_max[0])) == pytest.approx(found.maximum[0], abs=1e-8)


def test_a_kink_of_minimum_jerk():
    """max(y, 1 - y) has the minimum 1/2 where y crosses it in the middle."""
    found = MOVE.extrema_of(lambda jet: np.maximum(jet[0, 0], 1 - jet[0, 0]), 0)
    assert found.minimum[0] == pytest.approx(0.5, abs=1e-8)
    assert found.time_min[0] == pytest.approx(1.0, abs=1e-8)
    assert found.maximum[0] == 1.0


RISES = {
    "polynomial": MOVE,
    "late": MOVE.shift(1e5),
    "trigonometric": TrigSpline(waypoints([1.0, 4.0], [[0.0, 0.0], [1.0, 0.0]]), alpha=2.5),
    "segments": PiecewiseSpline(waypoints([0.0, 0.1, 3.0], [[0.0, 0.0], [0.04, 1.0], [1.0, 0.0]])),
    "profile": SCurve(1.0, velocity=1.0, acceleration=2.0, jerk=9.0),
    "long": MOVE.retime(1e6),
}


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("name", RISES)
def test_narrow_peaks_of_smooth_functions(name, width):
    """exp(-((y - c)/w)^2) is 1 where y = c, and the jet is smooth there."""
    plan = RISES[name]
    for level in np.random.default_rng(7).uniform(0.02, 0.98, 5):
        found = plan.extrema_of(lambda jet, level=level: 3.0 - np.exp(-(((jet[0, 0] - level) / width) ** 2)), 0)
        assert found.minimum[0] == pytest.approx(2.0, rel=1e-9)
        assert found.maximum[0] == pytest.approx(3.0, rel=1e-9)
        assert plan(found.time_min[0]) == pytest.approx(level, abs=1e-3 * width)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["polynomial", "trigonometric", "segments", "profile"])
def test_pulses_longer_than_the_distance_of_the_samples(name):
    """A function that is 0 but for a part 1/2000 of the duration, and jumps at both ends of it."""
    plan = RISES[name]
    for begin in np.random.default_rng(8).uniform(0.05, 0.9, 10):
        low, high = plan(plan.start + plan.duration * (begin + np.array([0.0, 5e-4])))
        found = plan.extrema_of(lambda jet, low=low, high=high: ((jet[0, 0] > low) & (jet[0, 0] < high)) * jet[0, 0], 0)
        # The largest value is the limit from below at the second jump.
        assert found.maximum[0] == pytest.approx(high, rel=1e-9)
        assert found.minimum[0] == 0.0


def test_both_limits_of_a_jump_of_the_function():
    """The speed changes its sign and its scale where y crosses a level: 15/8 times 4/3 u^2 (1 - u)^2 ... there."""
    level = 0.3
    u = brentq(lambda u: 10 * u**3 - 15 * u**4 + 6 * u**5 - level, 0.0, 1.0, xtol=1e-15)
    there = 15 * (u * (1 - u)) ** 2
    found = MOVE.extrema_of(lambda jet: np.where(jet[0, 0] < level, -3.0, 0.1) * jet[1, 0], 1)
    assert found.minimum[0] == pytest.approx(-3.0 * there, rel=1e-9)
    assert found.time_min[0] == pytest.approx(2.0 * u, rel=1e-9)
    assert found.maximum[0] == pytest.approx(0.1 * 15 / 16, rel=1e-12)


def rough(rng):
    """A function of the jet, of size about 1, with kinks, jumps, cusps or narrow peaks."""
    a, b, c = rng.uniform(-0.7, 0.7, 3)
    width = 10.0 ** rng.uniform(-3, -1)
    return rng.choice(
        [
            lambda y, v: np.exp(-(((y - a) / width) ** 2)) + 0.3 * v,
            lambda y, v: np.abs(y - a) - 0.7 * np.abs(v - b) + c * y * v,
            lambda y, v: np.where(y > a, v, c * y) - 0.2 * y,
            lambda y, v: np.maximum(np.minimum(y, v), np.sin(9.0 * y)),
            lambda y, v: np.interp(y, np.linspace(-1.0, 1.0, 41), np.cos(1.7 * np.arange(41.0))) + c * v,
            lambda y, v: np.tanh((v - b) / width) * np.cos(3.0 * y),
            lambda y, v: np.cbrt(y - a) * (v - b),
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_rough_functions_against_dense_samples(seed):
    """No sample of 4e5 lies beyond what is found, and what is found is attained."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.3, 2.0, 4))
    points = waypoints(times, [[*rng.normal(size=2), 0.0] for _ in times])
    plan = (PolySpline(points), TrigSpline(points, alpha=3.0), PiecewiseSpline(points))[seed % 3]
    size = [plan.peak(nu)[0] for nu in (0, 1)]
    for _ in range(6):
        function = rough(rng)

        def of_jet(jet, function=function):
            return function(jet[0, 0] / size[0], jet[1, 0] / size[1])

        found = plan.extrema_of(of_jet, 1)
        samples = of_jet(plan.jet(np.linspace(plan.start, plan.end, 400_001), 1))
        scale = max(-found.minimum[0], found.maximum[0])
        assert samples.min() >= found.minimum[0] - 1e-9 * scale
        assert samples.max() <= found.maximum[0] + 1e-9 * scale
        # At a jump one of the limits is attained, up to the resolution of times; a cusp is as steep as its cube root.
        near = found.time_max[0] + 1e-13 * plan.duration * np.arange(-40, 41)
        assert of_jet(plan.jet(np.clip(near, plan.start, plan.end), 1)).max() >= found.maximum[0] - 1e-4 * scale


def test_a_lookup_table_of_many_kinks():
    """Piecewise linear through 400 points: its extrema along a monotone move are those of the table."""
    table = np.random.default_rng(2).normal(size=400)
    levels = np.linspace(0.0, 1.0, 400)
    found = MOVE.extrema_of(lambda jet: np.interp(jet[0, 0], levels, table), 0)
    size = np.abs(table).max()
    assert found.maximum[0] == pytest.approx(table.max(), abs=1e-9 * size)
    assert found.minimum[0] == pytest.approx(table.min(), abs=1e-9 * size)
    assert MOVE(found.time_max[0]) == pytest.approx(levels[table.argmax()], abs=1e-8)


@pytest.mark.parametrize("noise", [1e-7, 1e-3])
def test_a_noisy_function_is_said_to_be_unresolved(noise):
    rng = np.random.default_rng(1)
    with pytest.raises(RuntimeError, match=r"function must be resolved to 1e-09 of its largest magnitude, .* noisy"):
        MOVE.extrema_of(lambda jet: 1.0 + jet[0, 0] + noise * rng.normal(size=jet.shape[2]), 0)


@pytest.mark.slow
def test_oscillation_without_end_is_said_to_be_unresolved():
    line = PolySpline(waypoints([0.0, 1.0], [[0.0], [1.0]]))
    with pytest.raises(RuntimeError, match="after 20000 pieces"):
        line.extrema_of(lambda jet: np.sin(1e6 * jet[0, 0] ** 2), 0)


@pytest.mark.parametrize("function", [lambda jet: 3.0, lambda jet: jet[0].T, lambda jet: jet])
def test_a_function_returns_a_value_for_each_time(function):
    with pytest.raises(ValueError, match=r"function must return values of shape \(ntime,\) or \(m, ntime\), got shape"):
        MOVE.extrema_of(function, 0)


def test_a_function_is_finite_over_the_plan():
    with pytest.raises(ValueError, match=r"got nan or inf between 0 and 2 s, such as at 1\."):
        MOVE.extrema_of(lambda jet: np.where(jet[0, 0] > 0.5, np.nan, 0.0), 0)


FAMILIES = {
    "polynomial": PolySpline(waypoints([0.1, 0.4], [[0.0, 0.0], [1.0, 3.0]])),
    "trigonometric": TrigSpline(waypoints([0.1, 0.4], [[0.0, 0.0], [1.0, 3.0]]), alpha=2.0),
    "segments": PiecewiseSpline(waypoints([0.1, 0.2, 0.7], [[0.0, 0.0], [1.0, 3.0], [5.0, 9.0]])),
    "trapezoid": Trapezoid(2.0, velocity=3.0, acceleration=7.0, time=0.1),
    "S-curve": SCurve(2.0, velocity=3.0, acceleration=7.0, jerk=70.0, time=0.1),
    "sum": MOVE.retime(0.3).shift(0.1) + PolySpline(waypoints([0.0, 0.7], [[0.0], [1.0]])),
    "joined": PolySpline(waypoints([0.1, 0.3], [[0.0], [1.0]])).then(PolySpline(waypoints([0.0, 0.7], [[1.0], [9.0]]))),
    "retimed": Retimed(MOVE, PolySpline(waypoints([0.1, 0.8], [[0.0, 1.0], [2.0, 9.0]]))),
    "cyclic": TrigSpline.cyclic(waypoints([0.1, 0.2], [[0.0], [1.0]]), 0.7),
}


def rounded_beyond(plan, rng, count):
    """Plans like it, of other starts and durations, first those whose last segment is rounded to end beyond the end."""
    moved = [plan.retime(rng.uniform(0.1, 9.0)).shift(rng.uniform(-4.0, 1.0)) for _ in range(50 * count)]
    ends = [p.breakpoints[-2] + (p.end - p.breakpoints[-2]) - p.end for p in moved]
    return [moved[i] for i in np.argsort(ends)[: -count - 1 : -1]]


@pytest.mark.parametrize("name", FAMILIES)
def test_times_of_extrema_lie_in_the_plan(name):
    """A time beyond the end by a rounding would have the position held, and rest."""
    for plan in rounded_beyond(FAMILIES[name], np.random.default_rng(3), 4):
        for nu in range(3):
            for found in (plan.extrema(nu), plan.extrema_of(lambda jet, nu=nu: jet[nu, 0], nu)):
                for value, time in ((found.minimum[0], found.time_min[0]), (found.maximum[0], found.time_max[0])):
                    assert plan.start <= time <= plan.end
                    sides = [plan.jet(time, nu, left=left)[nu, 0] for left in (False, time > plan.start)]
                    rounding = plan.peak(nu + 1)[0] * np.spacing(max(-plan.start, plan.end))
                    assert min(abs(side - value) for side in sides) <= 1e-9 * plan.peak(nu)[0] + rounding
        bounds = plan.bounds(lambda jet: jet[0, 0], 0, 1.0)
        assert plan.start <= min(bounds.time_min, bounds.time_max) <= max(bounds.time_min, bounds.time_max) <= plan.end


@pytest.mark.parametrize("alpha", [0.0, 3.0])
@pytest.mark.parametrize("rtol", [0.05, 1e-3])
def test_bounds_contain_every_sample(rtol, alpha):
    points = [Waypoint(0.0, [0.0, 1.0], [1.0, 0.0]), Waypoint(0.7, [2.0, -1.0]), Waypoint(2.0, [1.0, 0.0], [0.0, 3.0])]
    plan = TrigSpline(points, alpha=alpha)

    def clearance(jet):
        return np.hypot(jet[0, 0] - 1.0, jet[0, 1] - 0.2) - 0.1 * np.abs(jet[1, 0])

    found = plan.bounds(clearance, 1, [[1.0, 1.0], [0.1, 0.0]], rtol=rtol)
    samples = clearance(plan.jet(np.linspace(0, 2, 20001), 1))
    assert found.lower <= samples.min()
    assert samples.max() <= found.upper
    spread = samples.max() - samples.min()
    assert found.minimum - found.lower <= 1.0001 * rtol * spread
    assert found.upper - found.maximum <= 1.0001 * rtol * spread
    assert clearance(plan.jet(found.time_min, 1)) == pytest.approx(found.minimum, rel=1e-12)
    assert clearance(plan.jet(found.time_max, 1)) == pytest.approx(found.maximum, rel=1e-12)


@pytest.mark.parametrize("rtol", [0.2, 1e-3, 1e-6])
def test_bounds_of_a_line(rtol):
    """Both are at the ends, and the Lipschitz bound is exact."""
    line = PolySpline(waypoints([0.0, 2.0], [[1.0], [4.0]]))
    found = line.bounds(lambda jet: jet[0, 0], 0, 1.0, rtol=rtol)
    assert found.lower <= 1.0 <= found.minimum
    assert found.maximum <= 4.0 <= found.upper
    assert found.minimum - found.lower <= 3.001 * rtol
    assert found.upper - found.maximum <= 3.001 * rtol


def test_bounds_see_what_samples_miss():
    """A bump 2e-3 wide: a proof finds it."""
    rest = [0.0, 0.0, 0.0]
    plan = PiecewiseSpline(waypoints([0.0, 0.5, 0.501, 0.502, 1.0], [rest, rest, [1.0, 0.0, 0.0], rest, rest]))
    found = plan.bounds(lambda jet: jet[0, 0], 0, 1.0, rtol=1e-2)
    assert 1.0 <= found.upper <= 1.01
    assert -0.01 <= found.lower <= 0.0
    assert found.maximum == pytest.approx(1.0, abs=0.01)


def test_bounds_of_a_jumping_derivative():
    lines = PiecewiseSpline(waypoints([0.0, 1.0, 2.0], [[0.0, 0.0], [1.0], [-2.0, 0.0]]))
    found = lines.bounds(lambda jet: jet[2, 0], 2, [[0.0], [0.0], [1.0]])
    exact = lines.extrema(2)
    assert found.lower <= exact.minimum[0] <= found.minimum + 1e-12
    assert found.maximum - 1e-12 <= exact.maximum[0] <= found.upper


@pytest.mark.parametrize("seed", range(5))
def test_bounds_are_not_rounded_inwards(seed):
    """Of a line the Lipschitz bound is exact, so that only rounding lies between the bounds and the ends."""
    start, end = np.random.default_rng(seed).normal(size=2)
    line = PolySpline(waypoints([0.0, 1.0], [[start], [end]]))
    found = line.bounds(lambda jet: jet[0, 0], 0, 1.0)
    assert found.lower <= min(start, end) <= max(start, end) <= found.upper


def test_bounds_that_cannot_be_reached_are_rejected():
    with pytest.raises(ValueError, match="rtol = 1e-12 must be reached within 200 cells"):
        MOVE.bounds(lambda jet: jet[0, 0], 0, 1.0, rtol=1e-12, max_cells=200)


# What one sample has met is not lost while its surroundings are bisected

SMOOTH = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])


def test_a_cusp_that_one_time_meets_is_not_below_what_was_seen():
    """-|y - c|^0.1 falls by 2 % within the rounding of y: the maximum is at least the largest value evaluated."""
    seen = []

    def cusp(jet):
        seen.append(-(np.abs(jet[0, 0] - 0.5123) ** 0.1))
        return seen[-1]

    found = SMOOTH.extrema_of(cusp, 0)
    assert found.maximum[0] >= max(values.max() for values in seen)
    assert found.maximum[0] > -0.05


@pytest.mark.parametrize("share", [0.3, 0.004, 0.3173])
def test_a_pulse_that_one_sample_meets_is_climbed(share):
    """Its width is a hundredth of the samples' distance; the sample that meets it stands on its flank."""
    seen = []
    SMOOTH.extrema_of(lambda jet: seen.append(jet[0, 0]) or jet[0, 0], 0)
    samples = np.sort(np.concatenate(seen[:-1]))
    at = samples[int(share * samples.size)]
    width = 0.01 * np.diff(samples)[int(share * samples.size)]
    found = SMOOTH.extrema_of(lambda jet: np.exp(-(((jet[0, 0] - at) / width - 1.2) ** 2)), 0)
    assert found.maximum[0] == pytest.approx(1.0, rel=1e-9)


def test_a_short_segment_before_a_long_one_is_searched_as_closely():
    """A pulse of 0.3 ms in the first second of a thousand."""
    rise = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
    plan = rise.then(PolySpline([Waypoint(1, 1, 0, 0), Waypoint(1000, 2, 0, 0)]))
    found = plan.extrema_of(lambda jet: np.exp(-(((jet[0, 0] - 0.61) / 3e-4) ** 2)), 0)
    assert found.maximum[0] == pytest.approx(1.0, rel=1e-9)


def test_extrema_are_computed_once_and_are_the_callers_own(monkeypatch):
    plan = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(2, 1, 0, 0)], alpha=1.0)
    found = plan.extrema(1)
    expected = found.maximum.copy()
    found.maximum[:] = np.nan
    evaluated = []
    segment_jet = TrigSpline.segment_jet
    monkeypatch.setattr(TrigSpline, "segment_jet", lambda *given: evaluated.append(given) or segment_jet(*given))
    np.testing.assert_array_equal(plan.extrema(1).maximum, expected)
    assert evaluated == []
    assert plan.peak(1) == pytest.approx(np.abs(plan(np.linspace(0, 2, 20001), 1)).max(), rel=1e-7)


@pytest.mark.parametrize("start", [0.0, 40.0, 1e6])
@pytest.mark.parametrize("n", [2, 5, 12])
def test_extrema_of_a_retimed_piecewise_spline_are_those_of_its_samples(n, start):
    rng = np.random.default_rng(n)
    times = start + np.cumsum(rng.uniform(0.3, 2.0, n))
    points = [
        Waypoint(float(t), rng.normal(size=2), *([[0.0, 0.0]] if i in (0, n - 1) else [])) for i, t in enumerate(times)
    ]
    plan = PiecewiseSpline(points, warn=False)
    for order in range(4):
        plan.extrema(order)  # its places are kept
    moved = plan.retime(0.37 * plan.duration)
    for order in range(4):
        found = moved.extrema(order)
        sampled = [
            moved.segment_jet(k, np.linspace(0.0, float(b - a), 4001), order)[order]
            for k, (a, b) in enumerate(zip(moved.breakpoints[:-1], moved.breakpoints[1:], strict=True))
        ]
        values, size = np.concatenate(sampled, axis=-1), plan.peak(order) / 0.37**order
        assert (found.maximum >= values.max(axis=-1) - 1e-13 * size).all()
        assert (found.minimum <= values.min(axis=-1) + 1e-13 * size).all()
        assert (found.maximum <= values.max(axis=-1) + 1e-5 * size).all()
        assert (found.minimum >= values.min(axis=-1) - 1e-5 * size).all()
