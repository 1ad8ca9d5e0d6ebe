"""Plans through samples, against the samples themselves, scipy's own splines and functions that a spline reproduces."""

import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from scipy import interpolate as si

import ctrlplan as cp

RNG = np.random.default_rng(3)
T = np.sort(np.append(RNG.uniform(0.0, 5.0, 298), [0.0, 5.0])) + 7.0
WAVE = np.stack([np.sin(2.0 * T), 100.0 + 30.0 * np.cos(3.0 * T)])
NOISY = WAVE + RNG.normal(size=WAVE.shape) * [[0.01], [1.0]]


def deviation(plan, values):
    return np.abs(plan(T).reshape(-1, T.size) - values).max(axis=1)


@pytest.mark.parametrize("continuity", range(5))
@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("share", [3.0, 0.5, 1e-3])
def test_tolerance_is_met_at_every_sample(continuity, noisy, share):
    values = NOISY if noisy else WAVE
    limits = share * np.array([0.02, 2.0])
    plan = cp.fit(T, values, tolerance=limits, continuity=continuity, labels=["x", "z"], warn=False)
    found = deviation(plan, values)
    assert (found <= limits * (1 + 1e-12)).all()
    assert (np.abs(plan.deviation - found) <= 1e-13 * np.abs(values).max(axis=1)).all()
    assert [jump for jump in plan.jumps(continuity) if plan.start < jump.time < plan.end] == []
    assert plan.breakpoints.size <= T.size
    assert (plan.start, plan.end, plan.labels) == (T[0], T[-1], ("x", "z"))


def test_the_last_sample_alone_beyond_the_tolerance():
    """The straight line through these samples deviates by 0.476 at the last one, by at most 0.381 at others."""
    times, values = np.arange(6.0), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    line = np.polyval(np.polyfit(times, values, 1), times)
    assert (np.abs(line - values) > 0.4).tolist() == [False] * 5 + [True]
    for rows in (values, values[::-1]):
        plan = cp.fit(times, rows, tolerance=0.4, continuity=0)
        assert np.abs(plan(times) - rows).max() <= 0.4


def test_a_swing_between_uneven_times_warns():
    """Quintics through pairs of near samples: their slopes, not the range of the samples, determine the plan."""
    times = np.ravel([(k, k + 1e-4) for k in range(10)])
    values = np.resize([0.0, 1.0], times.size)
    with pytest.warns(UserWarning, match=r"swings over \S+ times the range of the samples: y from .* lower continuity"):
        plan = cp.fit(times, values, continuity=3)
    samples = plan(np.linspace(plan.start, plan.end, 20_001))
    assert np.ptp(samples) > 100.0
    assert (np.abs(plan(times) - values) <= plan.deviation + 1e-14 * np.abs(samples).max()).all()
    for quiet in ({"continuity": 3, "warn": False}, {"continuity": 0}):
        cp.fit(times, values, **quiet)  # a warning would be an error


def test_the_deviation_is_that_of_the_plan():
    """Rounded coefficients of far swings, not the B-spline from which they are computed."""
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.choice([1e-3, 1.0], 60) * rng.uniform(0.2, 1.0, 60))
    values = np.cumsum(rng.normal(size=60))
    plan = cp.fit(times, values, continuity=4, warn=False)
    found = np.abs(plan(times) - values).max()
    assert found > 1e-9
    # Rounding errors of two evaluations are of one size, which is a thousand times that of the B-spline.
    assert 0.02 * found <= plan.deviation[0] <= 50.0 * found
    with pytest.raises(ValueError, match=r"tolerance must be at least .*: it would require more knots than the 60"):
        cp.fit(times, values, continuity=4, tolerance=1e-2 * found, warn=False)


def test_knots_are_few_where_few_suffice():
    """A cubic needs none; a smooth wave as many as the fourth root of its tolerance wants, within a factor."""
    cubic = 1.0 - T + 0.3 * T**3
    assert cp.fit(T, cubic, tolerance=1e-9).breakpoints.size == 2
    sizes = [cp.fit(T, WAVE[0], tolerance=tolerance).breakpoints.size for tolerance in (1e-2, 1e-4)]
    assert sizes[0] < 16
    assert sizes[1] < 16 * 10**0.5 * 1.5
    assert cp.fit(T, NOISY, tolerance=[0.05, 5.0]).breakpoints.size < 30


def test_without_options_it_interpolates():
    plan = cp.fit(T, NOISY)
    wanted = si.make_interp_spline(T, NOISY.T, k=3)
    s = np.linspace(T[0], T[-1], 1001)
    for nu in range(3):
        size = np.abs(wanted(s, nu=nu)).max(axis=0)
        assert (np.abs(plan(s, nu) - wanted(s, nu=nu).T).max(axis=1) <= 1e-10 * size).all()
    assert (plan.deviation <= 1e-12 * np.abs(NOISY).max(axis=1)).all()
    assert cp.fit(T, NOISY, smoothing=0.0).breakpoints.tolist() == plan.breakpoints.tolist()


def test_smoothing_is_that_of_splrep():
    sums = T.size * np.array([0.01, 1.0]) ** 2
    plan = cp.fit(T, NOISY, smoothing=sums, continuity=4)
    assert (((plan(T) - NOISY) ** 2).sum(axis=1) <= sums).all()
    for axis, (row, s) in enumerate(zip(NOISY, sums, strict=True)):
        wanted = si.BSpline(*si.splrep(T, row, k=5, s=s / 1.001))
        np.testing.assert_allclose(plan(T)[axis], wanted(T), rtol=0, atol=1e-10 * np.abs(row).max())
    np.testing.assert_allclose(plan.deviation, deviation(plan, NOISY), rtol=1e-9)
    true = np.stack([2.0 * np.cos(2.0 * T), -90.0 * np.sin(3.0 * T)])
    inside = np.abs(T - 9.5) < 2.0
    assert (np.abs(plan(T, 1) - true)[:, inside].max(axis=1) < [0.1, 10.0]).all()


def test_peaks_hold_between_the_samples():
    """The peak is attained and exceeded nowhere."""
    plan = cp.fit(T, NOISY, tolerance=[0.05, 5.0], continuity=4)
    s = np.linspace(plan.start, plan.end, 20_001)
    for nu in range(7):
        values = plan.jet(s, nu)[nu]
        assert (np.abs(values).max(axis=1) <= plan.peak(nu) * (1 + 1e-12)).all()
        assert (np.abs(values).max(axis=1) >= 0.98 * plan.peak(nu)).all()


def test_many_times_are_those_one_by_one():
    plan = cp.fit(T, NOISY, tolerance=[0.02, 2.0])
    s = np.concatenate([RNG.uniform(plan.start, plan.end, 500), plan.breakpoints])
    for left in (False, True):
        many = plan.jet(s, 5, left=left)
        np.testing.assert_array_equal(many, np.stack([plan.jet(t, 5, left=left) for t in s], axis=2))
    beyond = plan.jet([T[0] - 1.0, *s, T[-1] + 1.0], 2)
    np.testing.assert_array_equal(beyond[:, :, 1:-1], plan.jet(s, 2))
    assert not beyond[1:, :, [0, -1]].any()


def test_a_step_and_unevenly_spaced_samples():
    t = np.cumsum(np.append(0.0, 10.0 ** RNG.uniform(-4, 0, 400)))
    y = np.where(t > 0.4 * t[-1], 1.0, 0.0) + 1e-3 * np.sin(t)
    for tolerance in (0.3, 1e-2, 1e-5):
        plan = cp.fit(t, y, tolerance=tolerance)
        assert np.abs(plan(t) - y).max() <= tolerance * (1 + 1e-12)


def test_one_axis_and_its_round_trip(tmp_path):
    plan = cp.fit(T, WAVE[0], tolerance=1e-3, labels="x")
    assert plan([7.5, 8.0]).shape == (2,)
    assert plan.deviation.shape == (1,)
    plan.save(tmp_path / "plan.json")
    assert cp.load_trajectory(tmp_path / "plan.json").to_dict() == plan.to_dict()
    assert "deviation of x" in str(plan)


def test_nothing_is_printed_where_fitpack_fails():
    """A sum far below what FITPACK reaches is met by interpolation."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan = cp.fit(T, NOISY[0], smoothing=1e-26)
    assert ((plan(T) - NOISY[0]) ** 2).sum() <= 1e-24


def test_samples_of_the_largest_numbers():
    values = 1e308 * np.array([0.0, 1.0, 1.0, -0.5, -0.5, 0.0])
    plan = cp.fit(np.arange(6.0), values, continuity=0)
    np.testing.assert_allclose(plan([0.0, 0.5, 1.0, 3.5]), [0.0, 5e307, 1e308, -5e307], rtol=1e-14)


def without(values, i, value):
    found = np.array(values)
    found[..., i] = value
    return found


BAD = {
    "text": (lambda: cp.fit(["a", "b"], [1, 2]), TypeError, "times must be real numbers"),
    "text in values": (lambda: cp.fit(T, ["x"] * T.size), TypeError, "values must be real numbers"),
    "dates": (lambda: cp.fit(np.arange(9).astype("M8[s]"), np.zeros(9)), TypeError, r"plain numbers \(times in sec"),
    "nan": (
        lambda: cp.fit(T, without(WAVE, 4, np.nan)),
        ValueError,
        r"values must be finite, got values\[0, 4\] = nan",
    ),
    "nan time": (
        lambda: cp.fit(without(T, 4, np.nan), WAVE),
        ValueError,
        r"times must be finite, got times\[4\] = nan",
    ),
    "inf": (lambda: cp.fit(T, without(WAVE[0], 2, np.inf)), ValueError, r"values\[2\] = inf; remove"),
    "repeated": (lambda: cp.fit([0, 1, 1, 2, 3], range(5)), ValueError, r"times\[2\] = 1.0 after times\[1\] = 1.0; av"),
    "unsorted": (lambda: cp.fit([0, 2, 1, 3, 4], range(5)), ValueError, r"got times\[2\] = 1.0 after .* = 2.0; sort"),
    "lengths": (
        lambda: cp.fit(T, WAVE[:, :-1]),
        ValueError,
        r"shape \(naxes, 300\) or \(300,\) as times, got \(2, 299",
    ),
    "transposed": (lambda: cp.fit(T, WAVE.T), ValueError, r"got \(300, 2\)"),
    "scalar": (lambda: cp.fit(1.0, 2.0), ValueError, r"times must have shape \(nsamples,\), got \(\)"),
    "few": (lambda: cp.fit([0, 1, 2], [0, 1, 0]), ValueError, "4 or more for a spline of degree 3, got 3; lower cont"),
    "span": (
        lambda: cp.fit([-1e308, 0, 1, 1e308], [0, 1, 0, 1]),
        ValueError,
        "times must span a finite duration, got -1e",
    ),
    "none": (lambda: cp.fit([], []), ValueError, "4 or more"),
    "both": (lambda: cp.fit(T, WAVE, tolerance=1, smoothing=1), ValueError, "must not both be given, got 1 and 1"),
    "zero": (lambda: cp.fit(T, WAVE, tolerance=0), ValueError, "tolerance must be above 0, got 0"),
    "negative": (
        lambda: cp.fit(T, WAVE, smoothing=[1, -1]),
        ValueError,
        r"smoothing must be at least 0, got \[1, -1\]",
    ),
    "nan tolerance": (lambda: cp.fit(T, WAVE, tolerance=np.nan), ValueError, "tolerance must be a finite number or 2"),
    "three": (lambda: cp.fit(T, WAVE, tolerance=[1, 2, 3]), ValueError, "tolerance must be a finite number or 2"),
    "knots": (
        lambda: cp.fit(T, NOISY, tolerance=[1.0, 1e-19]),
        ValueError,
        "tolerance must be at least .* of axis 1, got 1e-19: it would require more knots than the 300 samples",
    ),
    "continuity": (lambda: cp.fit(T, WAVE, continuity=5), ValueError, "continuity must be from 0 to 4, got 5"),
    "labels": (lambda: cp.fit(T, WAVE, labels="x"), ValueError, "labels must be one per axis, 2, got 1"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    call, kind, message = BAD[name]
    with pytest.raises(kind) as caught:
        call()
    assert re.search(message, str(caught.value)), str(caught.value)


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_a_tolerance_near_the_noise_takes_many_knots_of_least_squares(spacing):
    """The spline is that of scipy on the same knots, which are fewer than samples."""
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 10.0, 3000) if spacing == "even" else np.sort(rng.uniform(0.0, 10.0, 3000))
    y = np.sin(t) + 1e-3 * rng.normal(size=t.size)
    plan = cp.fit(t, y, tolerance=2e-3, continuity=2)
    assert 200 < plan.breakpoints.size < 2000
    assert plan.deviation[0] <= 2e-3
    assert np.abs(plan(t) - y).max() == pytest.approx(plan.deviation[0], rel=1e-9)
    degree = 3
    knots = np.concatenate([[plan.start] * degree, plan.breakpoints, [plan.end] * degree])
    peer = si.make_lsq_spline(t, y, knots, k=degree)
    np.testing.assert_allclose(plan(t), peer(t), rtol=0, atol=1e-12)


def root_of_squares(plan, times, values):
    return np.sqrt(((plan(times) - values) ** 2).sum())


CRASHES = """
import numpy as np, ctrlplan as cp
rng = np.random.default_rng(0)
t = np.arange(100.0)
for values in ((rng.random(100) < 0.5) * 1.0, (t > 50.0) * 1.0, np.eye(1, 100, 40)[0], rng.normal(size=100)):
    for scale, total in ((1.0, 1e-6), (1.0, 1e-2), (1e-160, 1e-315), (1e-160, 5e-324), (1e-300, 5e-324)):
        for continuity in range(5):
            plan = cp.fit(t, scale * values, smoothing=total, continuity=continuity, warn=False)
            found = ((plan(t) - scale * values) ** 2).sum()
            assert found <= total, (scale, total, continuity, found)
print("done")
"""


def test_smoothing_of_any_continuity_and_size_leaves_the_process_alive():
    """FITPACK itself ends the process for degree 1, and where squares of the samples underflow."""
    run = subprocess.run([sys.executable, "-c", CRASHES], capture_output=True, text=True, timeout=300)
    assert (run.returncode, run.stdout.strip()) == (0, "done"), run.stderr


@pytest.mark.parametrize("noise", [0.1, 1e-3])
def test_smoothing_without_continuous_velocity_takes_few_knots(noise):
    """A polyline of 4 parts under noise: the sum is met, by far fewer knots than samples, near the true polyline."""
    rng = np.random.default_rng(8)
    t = np.linspace(0.0, 4.0, 2001)
    true = np.interp(t, [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 2.0, -1.0, 0.0, 3.0])
    values = true + noise * rng.normal(size=t.size)
    total = 1.05 * ((values - true) ** 2).sum()
    plan = cp.fit(t, values, smoothing=total, continuity=0)
    assert ((plan(t) - values) ** 2).sum() <= total
    assert plan.breakpoints.size < 60
    assert root_of_squares(plan, t, true) < 0.4 * np.sqrt(total)
    peer = si.make_lsq_spline(t, values, np.concatenate([[0.0], plan.breakpoints, [4.0]]), k=1)
    np.testing.assert_allclose(plan(t), peer(t), rtol=0, atol=1e-12)


def test_smoothing_without_continuous_velocity_near_every_sample():
    """Many knots, which are chosen by normal equations; each axis has its own sum."""
    rng = np.random.default_rng(9)
    t = np.sort(rng.uniform(0.0, 10.0, 1500))
    values = np.stack([np.sin(t), 5.0 * np.cos(t)]) + rng.normal(size=(2, t.size)) * [[0.01], [0.1]]
    sums = t.size * np.array([0.006, 0.07]) ** 2
    plan = cp.fit(t, values, smoothing=sums, continuity=0)
    assert (((plan(t) - values) ** 2).sum(axis=1) <= sums).all()
    assert 200 < plan.breakpoints.size < t.size


@pytest.mark.parametrize(
    ("offset", "samples", "tolerance"),
    [(0.0, 20_000, 1e-6), (1e9, 20_000, 1e-6), (-1e9, 20_000, 1e-6), (1e9, 20_000, 9e-7), (1e12, 5000, 1e-3)],
)
def test_a_far_origin_takes_the_knots_of_a_near_one(offset, samples, tolerance):
    """Samples, constants and values of the plan are rounded, by less than 7 spacings of numbers together."""
    t = np.linspace(0.0, 100.0, samples)
    values = np.sin(t) + offset
    plan = cp.fit(t, values, tolerance=tolerance)
    assert np.abs(plan(t) - values).max() <= tolerance
    near = cp.fit(t, np.sin(t), tolerance=tolerance - 7.0 * np.spacing(abs(offset) + 1.0))
    assert plan.breakpoints.size < 1.5 * near.breakpoints.size + 10


def test_a_far_origin_of_one_axis_and_of_smoothing():
    t = np.linspace(0.0, 20.0, 2000)
    values = np.stack([np.sin(t), np.cos(t) - 1e9])
    plan = cp.fit(t, values, tolerance=[1e-9, 1e-5])
    assert (np.abs(plan(t) - values).max(axis=1) <= [1e-9, 1e-5]).all()
    noise = 1e-3 * np.random.default_rng(4).normal(size=t.size)
    for continuity in (0, 2, 4):
        near, far = (
            cp.fit(t, np.sin(t) + noise + offset, smoothing=t.size * 1e-6, continuity=continuity)
            for offset in (0.0, 1e9)
        )
        assert ((far(t) - (np.sin(t) + noise + 1e9)) ** 2).sum() <= t.size * 1e-6
        np.testing.assert_allclose(far(t) - 1e9, near(t), rtol=0, atol=2e-4)


def test_a_tolerance_below_the_rounding_of_samples():
    """Through all samples without deviation, or the message names their rounding: 1 is rounded by 2**-53."""
    t = np.linspace(0.0, 10.0, 200)
    plan = cp.fit(t, np.sin(t) + 1e9, tolerance=1e-12)
    np.testing.assert_array_equal(plan(t), np.sin(t) + 1e9)
    noise = np.append(1.0, np.random.default_rng(0).uniform(-1.0, 1.0, 20_000))
    with pytest.raises(ValueError, match=r"a spline through all samples of axis 0, .* which are rounded by 1.1e-16"):
        cp.fit(np.linspace(0.0, 100.0, noise.size), noise, tolerance=1e-18, warn=False)


def test_constant_samples():
    """Two knots, or the samples themselves below their rounding."""
    t = np.linspace(0.0, 10.0, 500)
    for constant in (1e15, 0.1, -8.1, 0.0):
        values = np.full(t.size, constant)
        for continuity in (0, 2, 4):
            for tolerance in (1e-17, 1e-12 * max(1.0, abs(constant))):
                plan = cp.fit(t, values, continuity=continuity, tolerance=tolerance)
                assert np.abs(plan(t) - values).max() <= tolerance
            assert plan.breakpoints.size == 2
            plan = cp.fit(t, values, continuity=continuity, smoothing=1e-20)
            assert ((plan(t) - values) ** 2).sum() <= 1e-20


UNEVEN = np.cumsum(10.0 ** np.random.default_rng(0).uniform(-12.0, 3.0, 300))


@pytest.mark.parametrize("total", [1e-2, 2e-14])
def test_a_sum_that_rounding_exceeds_is_refused(total):
    """Quintics through noise swing far between very uneven times; a polyline does not."""
    values = np.random.default_rng(7).normal(size=UNEVEN.size)
    plan = cp.fit(UNEVEN, values, smoothing=total, continuity=0)
    assert ((plan(UNEVEN) - values) ** 2).sum() <= total
    with pytest.raises(ValueError, match="of axis 1, got"):  # not of the one that interpolates
        cp.fit(UNEVEN, [np.zeros(UNEVEN.size), values], smoothing=[0.0, total], continuity=4, warn=False)
    exact = cp.fit(UNEVEN, values, continuity=4, warn=False)
    assert exact.deviation[0] > 1.0
    with pytest.raises(
        ValueError, match=r"smoothing must be at least .*, the sum of squared deviations by rounding of"
    ):
        cp.fit(UNEVEN, values, smoothing=total, continuity=4, warn=False)


@pytest.mark.parametrize("continuity", range(5))
@pytest.mark.parametrize("total", 10.0 ** np.arange(-16.0, 3.0, 3.0))
def test_smoothing_holds_wherever_there_is_a_plan(continuity, total):
    for values in (np.sin(UNEVEN), np.sqrt(UNEVEN), 1e6 + np.log(UNEVEN)):
        try:
            plan = cp.fit(UNEVEN, values, smoothing=total, continuity=continuity, warn=False)
        except ValueError:
            continue
        assert ((plan(UNEVEN) - values) ** 2).sum() <= total


@pytest.mark.parametrize(("continuity", "degree"), [(1, 3), (4, 5)])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_least_squares_of_the_knots(continuity, degree, offset):
    """Oracle: the QR decomposition of scipy; both are exact to rounding times the condition number."""
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 10.0, 700))
    y = np.sin([t, 2.0 * t]) + rng.normal(scale=1e-3, size=(2, t.size)) + offset
    plan = cp.fit(t, y, tolerance=[2e-3, 1.5e-3], continuity=continuity)
    knots = np.concatenate([[t[0]] * degree, plan.breakpoints, [t[-1]] * degree])
    oracle = si.make_lsq_spline(t, y.T - offset, knots, k=degree)
    assert 60 < plan.breakpoints.size < t.size
    np.testing.assert_allclose(plan(t), oracle(t).T + offset, rtol=0, atol=1e-11 + 4.0 * np.spacing(offset))


@pytest.mark.parametrize(("continuity", "half"), [(2, 2), (4, 3)])
def test_few_samples_for_the_frequency_are_followed_to_the_ends(continuity, half):
    """Knots at all samples of an end do not determine the derivatives there: such plans swung by powers of ten."""
    t = np.sort(np.random.default_rng([200, 1, 6]).uniform(0.0, 10.0, 200))
    y = np.sin(t) + 0.2 * np.sin(5.0 * t) + 0.1 * np.sin(t**2.2)
    plan = cp.fit(t, y, tolerance=1e-3, continuity=continuity)
    assert not np.isin(np.append(t[1:half], t[-half:-1]), plan.breakpoints).any()
    assert np.abs(plan(np.linspace(t[0], t[-1], 5001))).max() <= 2.0


@pytest.mark.parametrize("continuity", [0, 2, 4])
def test_overflow_of_a_fit_is_an_error_and_no_warning(continuity):
    t = np.linspace(0.0, 10.0, 500)
    values = 5e306 * (np.sin(t) + 1e-3 * np.random.default_rng(0).normal(size=t.size))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="coefficients must be finite"):
            cp.fit(t, values, tolerance=1e304, continuity=continuity)
        small = cp.fit(t, values / 1e300, tolerance=1e4, continuity=continuity)
    assert np.abs(small(t) - values / 1e300).max() <= 1e4


@pytest.mark.parametrize("size", [6, 7, 8, 9, 12])
def test_tolerances_of_few_samples(size):
    values = np.random.default_rng(size).normal(size=size)
    for tolerance in (1e-9, 0.1, 1.0, 10.0):
        for continuity in range(5):
            plan = cp.fit(np.arange(size), values, tolerance=tolerance, continuity=continuity, warn=False)
            assert plan.deviation[0] <= tolerance
            assert np.abs(plan(np.arange(size)) - values).max() <= tolerance


@pytest.mark.skipif(not hasattr(si, "generate_knots"), reason="least squares by QR came with scipy 1.15")
def test_rounding_of_a_least_squares_spline_is_not_said_to_be_of_all_samples():
    """Quintics with large coefficients between pairs of near samples, and few knots in a long constant part."""
    times = np.append(np.ravel([(k, k + 1e-9) for k in range(10)]), np.linspace(11.0, 20.0, 91))
    values = np.append(np.resize([0.0, 1.0], 20), np.zeros(91))
    with pytest.raises(
        ValueError, match=r"the polynomials of degree 5 in the \d\d segments of axis 0, got 1e-06; use"
    ) as e:
        cp.fit(times, values, tolerance=1e-6, continuity=4, warn=False)
    assert "samples" not in str(e.value)
    plan = cp.fit(times, values, tolerance=0.01, continuity=0)
    assert np.abs(plan(times) - values).max() <= 0.01


@pytest.mark.parametrize("continuity", range(5))
@pytest.mark.parametrize("options", [{}, {"tolerance": 1e-13}, {"tolerance": 0.5}, {"smoothing": 1000.0}])
def test_the_deviation_holds_for_values_of_the_plan_to_the_last_digit(continuity, options):
    """White noise, of which rounding is the whole deviation of an interpolating spline."""
    t = np.linspace(0.0, 100.0, 4000)
    values = np.random.default_rng(0).normal(size=t.size)
    plan = cp.fit(t, values, continuity=continuity, warn=False, **options)
    together = np.abs(plan(t) - values).max()
    single = np.abs([plan(time) for time in t.tolist()] - values).max()
    assert plan.deviation[0] == max(together, single)
    assert plan.deviation[0] <= options.get("tolerance", np.inf)
