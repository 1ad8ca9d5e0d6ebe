"""Plans that repeat, against periodic functions in closed form and the plan itself."""

import json
import math
import pickle
from fractions import Fraction
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.interpolate import PPoly

import ctrlplan as cp
from ctrlplan.trajectories import Repeated

POINTS = [(0.4, 2.0), (0.7, 10.0), (1.2, 10.0), (1.5, 5.0), (1.8, 1.0)]
CAM = cp.PiecewiseSpline.cyclic([cp.Waypoint(0.25, 0, 0, 0), *(cp.Waypoint(t + 0.25, y) for t, y in POINTS)], 2.1)
CIRCLE = cp.TrigSpline.cyclic([cp.Waypoint(0.5 * k, [(1, 0, -1, 0)[k], (0, 1, 0, -1)[k]]) for k in range(4)], 2.0)
ZIGZAG = cp.PiecewiseSpline([cp.Waypoint(0, 0), cp.Waypoint(0.3, 1), cp.Waypoint(1, 0)])
MOVE = cp.PolySpline([cp.Waypoint(-3, 2, 0, 0), cp.Waypoint(-1, 0, 0, 0)])
RNG = np.random.default_rng(2)


def folded(t, plan):
    """Times of the first period in exact arithmetic."""
    period = Fraction(plan.end) - Fraction(plan.start)
    return [float(Fraction(plan.start) + (Fraction(s) - Fraction(plan.start)) % period) for s in t]


@pytest.mark.parametrize("count", [5, None])
def test_circle_is_cosine_and_sine_at_all_times(count):
    plan = CIRCLE.repeat(count)
    t = RNG.uniform(0.0, 10.0, 200)
    angle = math.pi * t + 0.5 * math.pi * np.arange(4)[:, None]
    wanted = math.pi ** np.arange(4)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_allclose(plan.jet(t, 3), wanted, rtol=0, atol=1e-12 * math.pi**3)
    assert plan.period == 2.0
    assert (plan.end, plan.duration) == ((10.0, 10.0) if count else (math.inf, math.inf))
    np.testing.assert_array_equal(plan.initial, CIRCLE.initial)


@pytest.mark.parametrize("plan", [CAM, ZIGZAG], ids=["cam", "zigzag"])
@pytest.mark.parametrize("late", [0.0, 1e3, 1e6])
def test_jets_are_those_of_the_period(plan, late):
    """To the change of the plan over the spacing of floating-point times."""
    endless, t = plan.repeat(None), late + RNG.uniform(0.25, 20.0, 300)
    size = np.array([np.ptp(plan(np.linspace(plan.start, plan.end, 99))), *(plan.peak(k)[0] for k in range(1, 5))])
    error = np.abs(endless.jet(t, 3) - plan.jet(folded(t, plan), 3)).max(axis=(1, 2))
    assert (error <= 1e-13 * size[:4] + 4.0 * np.spacing(late + 20.0) * size[1:]).all()


@pytest.mark.parametrize("count", [7, None])
@pytest.mark.parametrize("plan", [CAM, ZIGZAG, CIRCLE], ids=["cam", "zigzag", "circle"])
def test_breakpoints_belong_to_what_follows(plan, count):
    """At each breakpoint the limits from both sides are those of the period, however many periods have passed."""
    found = plan.repeat(count)
    late = 0.0 if count else 1e5 * plan.duration
    times = found.breakpoints_between(found.start + late, found.start + late + 5.0 * plan.duration)
    size = plan.breakpoints.size - 1
    assert times.size == 5 * size
    for k, t in enumerate(times):
        after = plan.jet(plan.breakpoints[k % size], 3)
        before = plan.jet(plan.breakpoints[k % size or size], 3, left=True)
        scale = 1.0 + np.abs(plan.jet(plan.breakpoints, 3)).max(axis=2)
        assert (np.abs(found.jet(t, 3) - after) <= 1e-12 * scale).all()
        if k:
            assert (np.abs(found.jet(t, 3, left=True) - before) <= 1e-9 * scale).all()
    many = found.jet(times, 3)
    size = np.abs(plan.jet(plan.breakpoints, 3)).max(axis=2, keepdims=True)
    apart = np.abs(many - np.stack([found.jet(t, 3) for t in times], axis=2))
    assert (apart <= 16 * np.finfo(float).eps * size).all()  # products of matrices round differently for many times


def test_breakpoints_between_are_half_open_and_complete():
    endless, many = CAM.repeat(None), CAM.repeat(9)
    np.testing.assert_array_equal(endless.breakpoints_between(-math.inf, 15.0), many.breakpoints_between(-1.0, 15.0))
    cuts = np.sort(np.append(RNG.uniform(-1.0, 15.0, 40), many.breakpoints[5:20:3]))
    parts = [endless.breakpoints_between(a, b) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(parts), endless.breakpoints_between(cuts[0], cuts[-1]))
    assert endless.breakpoints_between(7.0, 7.0).size == 0


def test_times_do_not_drift():
    """The kth period of 0.1 s begins at k times 0.1 s, not at a sum of k terms."""
    endless = cp.PiecewiseSpline([cp.Waypoint(0, 0), cp.Waypoint(0.04, 1), cp.Waypoint(0.1, 0)]).repeat(None)
    begins = endless.breakpoints_between(99_999.99, 100_000.35)
    assert set(0.1 * np.arange(1_000_000, 1_000_004)) <= set(begins)


@pytest.mark.parametrize("count", [3, None])
def test_before_it_begins_and_after_it_ends(count):
    plan = CAM.repeat(count)
    np.testing.assert_array_equal(plan.jet([-1e9, 0.0], 2)[0], CAM.initial[:, None].repeat(2, 1))
    assert not plan.jet([-1e9, 0.0], 2)[1:].any()
    if count:
        np.testing.assert_array_equal(plan.jet(1e9, 2), np.concatenate([[CAM.final], np.zeros((2, 1))]))
        np.testing.assert_allclose(plan.jet(plan.end, 2), CAM.jet(CAM.end, 2), rtol=0, atol=1e-12)


def test_repetitions_as_joined_plans():
    """`then` shifts and joins; waypoints, jumps, extrema and values agree."""
    three, joined = ZIGZAG.repeat(3), ZIGZAG.then(ZIGZAG).then(ZIGZAG)
    np.testing.assert_allclose(three.breakpoints, joined.breakpoints, rtol=1e-15)
    assert [w.time for w in three.waypoints] == pytest.approx([w.time for w in joined.waypoints], rel=1e-15)
    assert [w.position.tolist() for w in three.waypoints] == [w.position.tolist() for w in joined.waypoints]
    mine, theirs = three.jumps(2), joined.jumps(2)
    assert [(j.order, j.label) for j in mine] == [(j.order, j.label) for j in theirs]
    np.testing.assert_allclose([j.size for j in mine], [j.size for j in theirs], rtol=1e-12)
    for nu in range(3):
        np.testing.assert_allclose(three.peak(nu), joined.peak(nu), rtol=1e-12)
        assert three.extrema(nu).time_max[0] == pytest.approx(joined.extrema(nu).time_max[0], rel=1e-12)
    assert len(CAM.repeat(3).waypoints) == 18
    assert ZIGZAG.repeat(1) is ZIGZAG


def test_jumps_where_it_repeats():
    """Zigzag: slopes 1/0.3 and -1/0.7; at its first start from rest."""
    found = [(j.order, j.time, round(j.size, 9)) for j in ZIGZAG.repeat(None).jumps(1)]
    up, down = 1 / 0.3, -1 / 0.7
    assert found == [(1, 0.0, round(up, 9)), (1, 0.3, round(down - up, 9)), (1, 1.0, round(up - down, 9))]
    assert CIRCLE.repeat(None).jumps(2)[0].time == 0.0
    assert {jump.time for jump in CIRCLE.repeat(None).jumps(2)} == {0.0}


# Combinations


def test_a_move_leads_to_it():
    plan = MOVE.then(CAM.repeat(None))
    t = np.linspace(-4.0, -1.0, 40)
    np.testing.assert_allclose(plan.jet(t[:-1], 2), MOVE.jet(t[:-1], 2), rtol=0, atol=1e-13)
    t = RNG.uniform(-1.0, 50.0, 100)
    np.testing.assert_allclose(plan.jet(t, 2), CAM.repeat(30).shift(-1.25).jet(t, 2), rtol=0, atol=1e-9)
    assert (plan.since, plan.period, plan.start, plan.end) == (-1.0, CAM.duration, -3.0, math.inf)
    assert plan.initial[0] == 2.0
    assert [w.time for w in plan.waypoints][:3] == [-3.0, -1.0, pytest.approx(-0.6)]


@pytest.mark.parametrize(("ratio", "periods"), [(1.0, 1.0), (2.0, 2.0), (1.5, 3.0), (0.4, 2.0), (1 / 3, 1.0)], ids=str)
def test_combinations_repeat_with_the_common_period(ratio, periods):
    first, second = CIRCLE.repeat(None), CIRCLE.retime(2.0 * ratio).repeat(None).shift(0.3)
    t = RNG.uniform(-1.0, 40.0, 300)
    lists = {
        "+": (first + second, first.jet(t, 2) + second.jet(t, 2)),
        "-": (first - 0.5 * second, first.jet(t, 2) - 0.5 * second.jet(t, 2)),
        "/": (second / 4.0, 0.25 * second.jet(t, 2)),
        "stack": (
            cp.stack([first, second], labels=list("abcd")),
            np.concatenate([first.jet(t, 2), second.jet(t, 2)], axis=1),
        ),
    }
    for name, (plan, wanted) in lists.items():
        np.testing.assert_allclose(plan.jet(t, 2), wanted, rtol=0, atol=1e-9 * (1 / ratio) ** 2, err_msg=name)
        assert plan.end == math.inf, name
    assert lists["+"][0].period == pytest.approx(2.0 * periods, rel=1e-12)


def test_sum_with_a_plan_that_ends():
    """It repeats once the other has ended."""
    step, endless = cp.Step(5.0, 1.0, 3.3), ZIGZAG.repeat(None)
    plan = step + endless
    t = np.append(RNG.uniform(-1.0, 9.0, 100), [3.3, np.nextafter(3.3, 0.0)])
    np.testing.assert_allclose(plan(t), step(t) + endless(t), rtol=0, atol=1e-13)
    assert plan.since == 3.3
    assert [jump.time for jump in plan.jumps(0)] == [3.3]


def test_periods_without_a_common_multiple():
    with pytest.raises(ValueError, match=r"common multiple of at most 1000 periods, got 2 s and 3\.14159265 s; repeat"):
        CIRCLE.repeat(None) + CIRCLE.retime(math.pi).repeat(None)


def test_part_of_it():
    part = cp.Clipped(CAM.repeat(None), 7.0, 12.5)
    t = RNG.uniform(7.0, 12.5, 50)
    np.testing.assert_allclose(part.jet(t, 3), CAM.repeat(10).jet(t, 3), rtol=1e-12, atol=1e-12)
    assert cp.as_trajectory(CAM.repeat(None), 7.0, 12.5).end == 12.5


def test_stop_of_a_running_cam():
    limits = {"acceleration": 200.0, "jerk": 4000.0}
    endless, many = CAM.repeat(None), CAM.repeat(10)
    for plan in (endless.stop(9.3, limits), endless.stop(9.3, limits, synchronize="path")):
        assert 9.3 < plan.end < 20.0
        np.testing.assert_array_equal(plan.jet(9.2, 2), many.jet(9.2, 2))
        assert np.abs(plan.jet(plan.end, 1)[1]).max() < 1e-9


# Storing and showing


def made():
    return {
        "cam": CAM.repeat(None),
        "three": CAM.repeat(3),
        "lead": MOVE.then(ZIGZAG.repeat(None)),
        "sum": CIRCLE.repeat(None) + CIRCLE.retime(3.0).repeat(None),
        "shaped": cp.Shaper.zv(10.0)(ZIGZAG.repeat(None)),
        "late": ZIGZAG.repeat(None).shift(1e5),
    }


@pytest.mark.parametrize("name", made())
def test_saved_and_read_again(name, tmp_path):
    plan = made()[name]
    plan.save(tmp_path / "plan.json")
    json.loads((tmp_path / "plan.json").read_text(), parse_constant=pytest.fail)  # no Infinity, which is not JSON
    t = RNG.uniform(plan.start - 1.0, plan.start + 30.0, 50)
    for again in (cp.load_trajectory(tmp_path / "plan.json"), pickle.loads(pickle.dumps(plan))):
        np.testing.assert_array_equal(again.jet(t, 3), plan.jet(t, 3))
        assert (again.end, again.period, again.since) == (plan.end, plan.period, plan.since)


@pytest.mark.parametrize("name", made())
def test_shown(name):
    plan = made()[name]
    text = str(plan)
    assert "nan" not in text
    assert ("for all future times" in text) == (plan.end == math.inf)
    assert "<svg" in plan._repr_html_()
    drawn = plan.plot(1)
    x = np.concatenate([line.get_xdata() for line in np.ravel(drawn.lines[0, 0])])
    assert np.isfinite(x).all()
    assert x.max() < plan.start + 1.2 * (plan.since - plan.start + (plan.count or 1) * plan.period)
    plt.close(drawn.figure)


def test_exports(tmp_path):
    endless = CAM.repeat(None)
    for ending in (".cam.csv", ".cam.st"):  # master positions of one period
        endless.export(tmp_path / f"a{ending}")
        CAM.export(tmp_path / f"b{ending}")
        one, other = ((tmp_path / f"{name}{ending}").read_text().replace(",", " ").split() for name in "ab")
        assert len(one) == len(other)
        for first, second in zip(one, other, strict=True):  # equal but for rounding at the ends
            assert first == second or abs(float(first) - float(second)) <= 1e-12
    endless.export(tmp_path / "a.ppoly.json")
    data = json.loads((tmp_path / "a.ppoly.json").read_text())
    spline, t = PPoly(data["c"], data["x"], extrapolate=data["extrapolate"]), RNG.uniform(0.3, 20.0, 50)
    np.testing.assert_allclose(spline(t)[:, 0], endless(t), rtol=0, atol=1e-10)
    times = np.linspace(0.0, 20.0, 41)
    for ending in (".csv", ".mat", ".npz", ".yaml"):
        with pytest.raises(ValueError, match="timepts must be given to export a plan that repeats for all"):
            endless.export(tmp_path / f"a{ending}")
        with pytest.raises(ValueError, match="timepts must be given"):
            endless.export(tmp_path / f"a{ending}", dt=0.1)
    endless.export(tmp_path / "a.csv", timepts=times)
    written = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written[:, 1], endless(times), rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match=r"a plan written as \.cam\.csv must have an end"):
        MOVE.then(endless).export(tmp_path / "c.cam.csv")


def test_on_cycle():
    found = CAM.repeat(None).on_cycle(0.03)
    assert found.period / 0.03 == pytest.approx(round(found.period / 0.03), abs=1e-9)
    assert found.count is None
    assert CIRCLE.repeat(4).on_cycle(0.5).period == 2.0
    with pytest.raises(ValueError, match="must be put on the cycle before it repeats"):
        MOVE.then(CAM.repeat(None)).on_cycle(0.03)


# Bad input

STEP = cp.Step(1.0)
BAD = {
    "open": (
        lambda: MOVE.repeat(None),
        r"positions must agree where a plan repeats, got \[0.0\] at its end at -1 s and",
    ),
    "step": (lambda: STEP.repeat(2), "must have a duration to be repeated, got a step at 0 s"),
    "zero": (lambda: CAM.repeat(0), "count must be an integer of at least 1, or None for all future times, got 0"),
    "half": (lambda: CAM.repeat(1.5), "got 1.5"),
    "inf": (lambda: CAM.repeat(math.inf), "None for all future times, got inf"),
    "nan": (lambda: CAM.repeat(math.nan), "got nan"),
    "huge": (lambda: CAM.repeat(10**9), "at most 10000000 segments, got 6000000000; None repeats"),
    "since": (
        lambda: Repeated(CAM, None, 1.0),
        "since must be a breakpoint of the plan before its end at 2.35 s, got 1",
    ),
    "since end": (lambda: Repeated(CAM, None, CAM.end), "since must be a breakpoint"),
    "twice": (lambda: CAM.repeat(None).repeat(2), "must have an end"),
    "infinite time": (lambda: CAM.repeat(None)(math.inf), "times must be finite"),
    "late": (
        lambda: CAM.repeat(None)(1e16),
        "times must resolve the segments of a plan that repeats with a",
    ),
    "all": (lambda: CAM.repeat(None).breakpoints_between(0.0, math.inf), "t1 must be finite"),
    "many": (lambda: CAM.repeat(None).breakpoints_between(0.0, 1e9), "at most 10000000 breakpoints"),
    "order": (lambda: CAM.repeat(None).breakpoints_between(2.0, 1.0), "t1 must not be below t0"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("count", ["2", True, [2], 1j])
def test_counts_of_another_type(count):
    with pytest.raises(TypeError, match="count must be an integer of at least 1, or None for all future times, got"):
        CAM.repeat(count)
