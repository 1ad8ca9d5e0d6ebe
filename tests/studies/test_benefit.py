"""The benefit of planning: baselines through the same waypoints in the same time; marks are counted by hand."""

import dataclasses
import json
import math

import control as ct
import numpy as np
import pytest
from linear_table import printed
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan.studies.baselines import baseline_plans, smoother_polynomials
from ctrlplan.studies.benefit import Benefit, Choices, benefit_of
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.required_durations import RequiredDuration
from ctrlplan.trajectories import SCurve, Shaper, Trapezoid

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
VIA = [
    cp.Waypoint.from_jets(1, x=[0, 0, 0], z=[10, 0, 0]),
    cp.Waypoint.from_jets(3, x=[5, 1, 0.1], z=[7, -1, 0]),
    cp.Waypoint.from_jets(4, x=[6, 0, 0], z=[7, 0, 0]),
    cp.Waypoint.from_jets(7, x=[2, 0, 0], z=[11, 0, 0]),
]
TIMES = np.linspace(0, 12, 1201)
TABLES = {"alphas": (0.0, 1.0, 3.0), "factors": (1.0, 1.5)}
NAMES = ["trigonometric", "step", "trapezoid", "S-curve", "shaped step", "shaped S-curve", "quintic (minimum jerk)"]
PRINTED = {
    gain: {
        "step": printed(gain, "step"),
        "trigonometric": printed(gain, "trigonometric"),
        "quintic (minimum jerk)": printed(gain, "quintic"),
    }
    for gain in (5.0, 100.0)
}
SHAPER = Shaper.zvd(20.0, 0.1)


def loop(gain, outputs=("y", "u")):
    return cp.plants.integrator_lag_loop(gain, outputs=outputs)


def worth(system, points, times, *, units=None, **choices):
    """Benefit with choices that the public function does not have."""
    fields = {name: choices.pop(name) for name in ("events", "measures") if name in choices}
    experiment = cp.Experiment({"any": cp.PolySpline(points)}, times, waypoints=points, **fields)
    return benefit_of(experiment, system, Choices(**{"alpha": "auto"} | choices), units=units)


@pytest.fixture(scope="module")
def stiff():
    return worth(loop(100.0), MOVE, TIMES, alpha=1.0, **TABLES)


@pytest.fixture(scope="module")
def soft():
    return worth(loop(5.0), MOVE, TIMES, alpha=1.0, **TABLES)


@pytest.fixture(scope="module")
def baselines():
    return baseline_plans(VIA, None, SHAPER)


# The baselines


@pytest.mark.parametrize("name", ["trapezoid", "S-curve", "shaped S-curve", "quintic per segment", "minimum jerk"])
def test_baselines_pass_every_waypoint_in_its_time(name, baselines):
    plan = baselines[name]
    times = np.array([w.time for w in VIA])
    np.testing.assert_allclose(plan(times), np.transpose([w.position for w in VIA]), rtol=0, atol=1e-9)
    assert (plan.start, plan.end) == pytest.approx((1.0, 7.0), abs=1e-12)
    assert plan.labels == ("x", "z")


def test_there_is_one_baseline_of_each_kind(baselines):
    steps = ["step", "shaped step"]
    profiles = ["trapezoid", "S-curve", "shaped S-curve"]
    assert sorted(baselines) == sorted([*steps, *profiles, "quintic per segment", "minimum jerk"])


@pytest.mark.parametrize(("name", "order"), [("trapezoid", 1), ("S-curve", 2)])
def test_profiles_rest_at_every_waypoint(name, order, baselines):
    times = [w.time for w in VIA]
    for left in (True, False):
        jet = baselines[name].jet(times, order, left=left)
        np.testing.assert_allclose(jet[1:], 0.0, rtol=0, atol=1e-9)
    assert not baselines[name].jumps(order)


def test_an_axis_that_stands_still_on_a_leg_stays_where_it_is(baselines):
    t = np.linspace(3, 4, 101)
    for name in ("trapezoid", "S-curve"):
        np.testing.assert_allclose(baselines[name](t)[1], 7.0, rtol=0, atol=1e-8)


def test_a_leg_on_which_nothing_moves_waits():
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1), cp.Waypoint(2, 1), cp.Waypoint(3, 4, 0, 0)]
    for name in ("trapezoid", "S-curve"):
        plan = baseline_plans(points)[name]
        np.testing.assert_allclose(plan(np.linspace(1, 2, 11)), 1.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(plan([0.0, 1.0, 2.0, 3.0]), [0, 1, 1, 4], rtol=0, atol=1e-9)


def test_steps_go_to_the_goal_at_once(baselines):
    np.testing.assert_array_equal(baselines["step"]([0.999, 1.0, 5.0]), [[0, 2, 2], [10, 11, 11]])
    parts = baselines["shaped step"]
    half = np.pi / (20.0 * np.sqrt(1 - 0.01))
    decay = np.exp(-0.1 * np.pi / np.sqrt(1 - 0.01))
    weights = np.array([1.0, 2 * decay, decay**2]) / (1 + decay) ** 2
    np.testing.assert_allclose(parts.breakpoints, 1 + half * np.arange(3), rtol=1e-14)
    reached = parts(1 + half * (np.arange(3) + 0.5))
    np.testing.assert_allclose(reached, [2 * np.cumsum(weights), 10 + np.cumsum(weights)], rtol=1e-14)


def test_profiles_have_the_proportions_of_the_fastest_ones():
    """A move of 3 in 4 s: the trapezoid under v = 2, a = 4 takes 2 s and is slowed down to twice that."""
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 3, 0, 0)]
    found = baseline_plans(points, {"velocity": 2.0, "acceleration": 4.0, "jerk": 32.0})
    assert found["trapezoid"].peak(1) == pytest.approx([2.0 / 2], rel=1e-12)
    assert found["trapezoid"].peak(2) == pytest.approx([4.0 / 4], rel=1e-12)
    ratio = 4.0 / (3 / 2 + 2 / 4 + 4 / 32)
    for order, limit in ((1, 2.0), (2, 4.0), (3, 32.0)):
        assert found["S-curve"].peak(order) == pytest.approx([limit / ratio**order], rel=1e-12)


def test_where_a_limit_is_not_given_it_is_that_of_a_move_in_equal_thirds():
    """v = 1.5, a = 4.5: thirds. With the acceleration reached in half of a third, j = 27, it takes 2/3 + 1/3 + 1/6."""
    found = baseline_plans(MOVE, {"velocity": 1.5})
    np.testing.assert_allclose(found["trapezoid"].breakpoints, np.arange(4) / 3, rtol=0, atol=1e-12)
    for order, limit in ((1, 1.5), (2, 4.5), (3, 27.0)):
        assert found["S-curve"].peak(order) == pytest.approx([limit * (7 / 6) ** order], rel=1e-12)


@pytest.mark.parametrize("kind", [Trapezoid, SCurve])
def test_without_limits_profiles_are_those_of_what_the_polynomial_needs(kind):
    d, took = 3.0, 2.0
    limits = {"velocity": 15 / 8 * d / took, "acceleration": 10 / 3**0.5 * d / took**2, "jerk": 60 * d / took**3}
    if kind is Trapezoid:
        del limits["jerk"]
    expected = kind(5.0, 2.0, time=1.0, **limits).retime(took)
    found = baseline_plans([cp.Waypoint(1, 2, 0, 0), cp.Waypoint(3, 5, 0, 0)])
    t = np.linspace(1, 3, 101)
    name = "S-curve" if kind is SCurve else "trapezoid"
    np.testing.assert_allclose(found[name](t), expected(t), rtol=0, atol=1e-9)


def test_minimum_jerk_is_the_clamped_quintic_spline_of_scipy(baselines):
    times = np.array([w.time for w in VIA])
    rest = [(1, [0.0, 0.0]), (2, [0.0, 0.0])]
    spline = make_interp_spline(times, [w.position for w in VIA], k=5, bc_type=(rest, rest))
    t = np.linspace(1, 7, 301)
    for nu in range(3):
        np.testing.assert_allclose(baselines["minimum jerk"](t, nu), spline(t, nu).T, rtol=0, atol=1e-8)


def test_a_quintic_a_leg_meets_every_entry(baselines):
    for w in VIA:
        np.testing.assert_allclose(baselines["quintic per segment"].jet(w.time, 2), w.jet, rtol=0, atol=1e-9)


def test_where_velocities_alone_are_given_minimum_jerk_chooses_accelerations():
    """Closed form: y''' = -60 t (1 - t), so that y'' = 5 - 30 t^2 + 20 t^3."""
    found = baseline_plans([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)])
    t = np.linspace(0, 1, 51)
    np.testing.assert_allclose(found["minimum jerk"](t, 2), 5 - 30 * t**2 + 20 * t**3, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found["cubic"](t), 3 * t**2 - 2 * t**3, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("rest", "names"),
    [
        (1, ["straight line (minimum jerk)"]),
        (2, ["cubic", "minimum jerk"]),
        (3, ["quintic (minimum jerk)"]),
        (4, ["septic", "minimum jerk"]),
        (5, ["nonic", "minimum jerk"]),
    ],
)
def test_baselines_are_called_what_they_are(rest, names):
    still = [0.0] * (rest - 1)
    found = baseline_plans([cp.Waypoint(0, 0, *still), cp.Waypoint(2, 1, *still)])
    assert [name for name in found if name not in ("step", "trapezoid", "S-curve")] == names


def test_no_shaped_profile_where_the_shaper_takes_the_time_of_the_move():
    slow, quick = Shaper.zvd(2.0), Shaper.zvd(10.0)
    assert "shaped S-curve" not in baseline_plans(MOVE, None, slow)
    assert baseline_plans(MOVE, None, slow)["shaped step"].end == pytest.approx(np.pi)
    assert baseline_plans(MOVE, None, quick)["shaped S-curve"].duration == pytest.approx(1.0, abs=1e-12)


# The limits


@pytest.mark.slow
def test_unless_given_limits_are_what_the_polynomial_needs(stiff):
    assert stiff.limits == pytest.approx({"y_d1": 15 / 8, "y_d2": 10 / 3**0.5, "y_d3": 60.0}, rel=1e-12)


@pytest.mark.slow
def test_an_axis_that_does_not_move_has_no_limit():
    points = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[1, 0, 0]), cp.Waypoint.from_jets(2, x=[4, 0, 0], z=[1, 0, 0])]
    both = ct.append(ct.ss(loop(5.0)), ct.ss(loop(5.0)))
    side = ct.ss(both.A, both.B, both.C[[0, 2, 1, 3]], both.D[[0, 2, 1, 3]], outputs=["x", "z", "ux", "uz"], inputs=2)
    found = worth(side, points, TIMES[::10], alpha=1.0, alphas=(1.0,), factors=(1.0,), decisive=("control_peak",))
    assert found.limits == pytest.approx({"x_d1": 15 / 4, "x_d2": 10 / 3**0.5, "x_d3": 30.0}, rel=1e-12)


# How long each takes under the same limits


def required(found):
    return {one.name: one for one in found.required_durations}


@pytest.mark.slow
def test_the_quintic_takes_exactly_its_own_time(stiff):
    assert required(stiff)["quintic (minimum jerk)"].duration == pytest.approx(1.0, abs=1e-12)


@pytest.mark.slow
def test_the_s_curve_takes_its_closed_form(stiff):
    """Every limit is reached: d/v + v/a + a/j."""
    v, a, j = 15 / 8, 10 / 3**0.5, 60.0
    assert v * (v / a + a / j) < 1 > a**2 / j / v
    assert required(stiff)["S-curve"].duration == pytest.approx(1 / v + v / a + a / j, rel=1e-12)


def test_the_trigonometric_plan_takes_what_its_peaks_need(stiff):
    t = np.linspace(0, 1, 200_001)
    jet = np.abs(cp.TrigSpline(MOVE, alpha=1.0).jet(t, 3)[1:, 0]).max(axis=1)
    limits = np.array([15 / 8, 10 / 3**0.5, 60.0])
    expected = ((jet / limits) ** (1.0 / np.arange(1, 4))).max()
    one = required(stiff)["trigonometric"]
    assert one.duration == pytest.approx(expected, rel=1e-9)
    assert one.limit.startswith("y_d1 within ±1.875 at 0.508 s")


def test_what_jumps_keeps_no_limit_and_says_why(stiff):
    found = required(stiff)
    assert math.isnan(found["step"].duration)
    assert found["step"].limit == "position jumps: no limit on a derivative can hold"
    assert math.isnan(found["trapezoid"].duration)
    assert found["trapezoid"].limit.startswith("limits of y_d3 require")


@pytest.mark.slow
def test_the_sentence_names_the_fastest_and_those_that_cannot(stiff):
    sentence = stiff.verdicts[0]
    assert sentence.startswith(
        "Under the same limits, S-curve has the shortest minimum duration, 0.9543 s (trigonometric"
    )
    assert "trigonometric 1.017 s, " in sentence
    assert "quintic (minimum jerk) 1 s" in sentence
    assert "no duration satisfies them for step, trapezoid, shaped step." in sentence


@pytest.mark.slow
def test_limits_given_hold_all():
    """v = 1, a = 4: the trapezoid takes d/v + v/a, every spline max(peak_k/limit_k)^(1/k)."""
    limits = {"velocity": 1.0, "acceleration": 4.0}
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    found = worth(loop(5.0), MOVE, TIMES, alpha=0.0, limits=limits, **few)
    assert found.limits == limits
    assert required(found)["trapezoid"].duration == pytest.approx(1.25, rel=1e-12)
    assert required(found)["quintic (minimum jerk)"].duration == pytest.approx(15 / 8, rel=1e-12)
    assert required(found)["trigonometric"].duration == pytest.approx(15 / 8, rel=1e-12)
    assert found.verdicts[0].startswith("Under the same limits, trapezoid has the shortest minimum duration, 1.25 s (")
    found = worth(loop(5.0), MOVE, TIMES, alpha=0.0, limits={"velocity": (None, 1.0)}, **few)
    assert required(found)["quintic (minimum jerk)"].duration == pytest.approx(15 / 8, rel=1e-12)


@pytest.mark.slow
def test_a_sign_may_be_a_limit():
    """Never backwards, at most 2 m/s: what `fastest` takes as a limit."""
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    found = worth(loop(5.0), MOVE, TIMES, alpha=0.0, limits={"y_d1": (0.0, 2.0)}, **few)
    assert required(found)["quintic (minimum jerk)"].duration == pytest.approx(15 / 16, rel=1e-6)


def test_no_plan_is_possible_where_limits_are_none_that_time_can_keep():
    lone = (RequiredDuration("step", math.nan, "jumps"), RequiredDuration("quintic", math.nan, "no"))
    found = Benefit(None, {}, lone, (), 1.0)
    assert found.verdicts == ("No plan satisfies these limits at any duration.",)


# What the loop makes of each


@pytest.mark.parametrize("gain", PRINTED)
def test_figures_of_the_linear_loop(gain, soft, stiff):
    found = {5.0: soft, 100.0: stiff}[gain].comparison.metrics
    for name, expected in PRINTED[gain].items():
        measured = (found[name]["overshoot_error"], found[name]["settling_time"])
        assert measured == pytest.approx(expected, rel=2e-5), name


def shaped_settling(gain):
    """Settling time of a step in three parts, by the closed form of the step response."""
    w, xi = math.sqrt(gain), 0.5 / math.sqrt(gain)
    damped = w * math.sqrt(1 - xi**2)
    decay = math.exp(-math.pi * xi / math.sqrt(1 - xi**2))
    delays = np.arange(3) * math.pi / damped
    weights = np.array([1.0, 2 * decay, decay**2]) / (1 + decay) ** 2

    def error(t):
        s = np.subtract.outer(t, delays)
        ring = (w / damped) * np.exp(-xi * w * np.maximum(s, 0)) * np.sin(damped * s + math.acos(xi))
        return np.where(s >= 0, ring, 1.0) @ weights

    t = np.linspace(0, 12, 120_001)
    last = np.flatnonzero(np.abs(error(t)) > 0.02)[-1]
    return brentq(lambda x: abs(error(np.array([x]))[0]) - 0.02, t[last], t[last + 1], xtol=1e-13)


@pytest.mark.parametrize("gain", PRINTED)
def test_the_shaped_step_is_made_for_the_loop_and_settles_before_the_plan(gain, soft, stiff):
    """The comparison can be lost: shaping wins in a lightly damped linear loop."""
    found = {5.0: soft, 100.0: stiff}[gain].comparison
    damped = math.sqrt(gain - 0.25)
    np.testing.assert_allclose(found.plans["shaped step"].breakpoints, np.arange(3) * np.pi / damped, rtol=1e-9)
    settles = {name: values["settling_time"] for name, values in found.metrics.items()}
    assert settles["shaped step"] == pytest.approx(shaped_settling(gain), rel=1e-4)
    assert settles["shaped step"] < 0.5 * settles["trigonometric"]


def test_all_go_through_the_loop_in_the_same_time(stiff):
    assert list(stiff.comparison.plans) == NAMES
    assert list(stiff.comparison.metrics) == list(stiff.comparison.responses) == NAMES
    for name, plan in stiff.comparison.plans.items():
        if "step" not in name:
            assert plan.end == pytest.approx(1.0, abs=1e-12)
    assert stiff.comparison.plans["trigonometric"].alpha == 1.0


@pytest.mark.slow
def test_a_mode_can_be_given_and_none_is_guessed_where_there_is_none():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    given = worth(loop(5.0), MOVE, TIMES, mode=(40.0, 0.0), alpha=1.0, **few).comparison.plans
    np.testing.assert_allclose(given["shaped step"].breakpoints, [0, np.pi / 40, np.pi / 20], rtol=1e-14)
    overdamped = worth(loop(0.2), MOVE, TIMES, alpha=1.0, **few).comparison.plans
    built = worth(lambda name, plan: loop(5.0), MOVE, TIMES, alpha=1.0, **few).comparison.plans
    for plans in (overdamped, built):
        assert not [name for name in plans if "shaped" in name]


@pytest.mark.slow
def test_the_mode_of_a_sampled_loop_is_that_of_its_continuous_one():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    dt = 0.2  # poles at exp(-0.1 ± 2j): the left half of the disc
    sampled = ct.c2d(ct.ss(loop(100.0)), dt)
    system = ct.ss(sampled.A, sampled.B, sampled.C, sampled.D, dt, inputs=["r"], outputs=["y", "u"])
    plans = worth(system, MOVE, dt * np.arange(61), alpha=1.0, **few).comparison.plans
    np.testing.assert_allclose(plans["shaped step"].breakpoints[1], np.pi / math.sqrt(99.75), rtol=1e-9)


@pytest.mark.slow
def test_alpha_can_be_chosen():
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 3), cp.Waypoint(2, 1, 0, 0)]
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    found = worth(loop(100.0), points, TIMES[::4], **few)
    assert found.comparison.plans["trigonometric"].alpha == found.alpha == cp.choose_alpha(points).alpha


# The tables over alpha and duration


def test_there_is_a_table_for_settling_and_one_for_the_control(stiff):
    settling, control = stiff.grids
    assert (settling.title, settling.unit) == ("Settling time", "s")
    assert (control.title, control.unit) == ("Peak control", "{u}")
    for grid in stiff.grids:
        np.testing.assert_array_equal(grid.durations, [1.0, 1.5])
        np.testing.assert_array_equal(grid.alphas, [0.0, 1.0, 3.0])
        assert grid.values.shape == (2, 3)
        assert list(grid.baselines) == NAMES[1:]
        assert grid.not_ranked == ("step", "shaped step")


def test_values_are_those_of_runs_of_their_own(stiff):
    """The plan is made and simulated alone, and its control's peak is read off a fine record."""
    t = np.linspace(0, 12, 120_001)
    for i, duration in enumerate((1.0, 1.5)):
        points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(duration, 1, 0, 0)]
        for j, alpha in enumerate((0.0, 1.0, 3.0)):
            y, u = cp.simulate(loop(100.0), t, cp.TrigSpline(points, alpha=alpha)).outputs
            last = np.flatnonzero(np.abs(y - 1) > 0.02)[-1]
            assert t[last] <= stiff.grids[0].values[i, j] + 1e-4 <= t[last + 1] + 2e-4
            assert stiff.grids[1].values[i, j] == pytest.approx(np.abs(u).max(), rel=1e-4)


def test_alpha_zero_is_the_quintic_and_rows_of_the_move_itself_are_the_comparison(stiff):
    for grid, key in zip(stiff.grids, ("settling_time", "control_peak"), strict=True):
        np.testing.assert_allclose(grid.values[:, 0], grid.baselines["quintic (minimum jerk)"], rtol=1e-9)
        assert grid.values[0, 1] == stiff.comparison.metrics["trigonometric"][key]
        for name, values in grid.baselines.items():
            assert values[0] == stiff.comparison.metrics[name][key]


def test_steps_do_not_depend_on_the_duration(stiff):
    for grid in stiff.grids:
        for name in ("step", "shaped step"):
            assert grid.baselines[name][1] == pytest.approx(grid.baselines[name][0], rel=1e-9)


@pytest.mark.slow
def test_longer_plans_are_run_longer():
    """Waypoints passed at speeds in proportion, and a record that outlasts the plan."""
    points = [cp.Waypoint(1, 0, 0, 0), cp.Waypoint(2, 2, 4, 0), cp.Waypoint(3, 3, 0, 0)]
    times = np.linspace(0, 4, 401)
    options = {"alpha": 1.0, "alphas": (2.0,), "decisive": ("iae",)}
    (grid,) = worth(loop(400.0), points, times, factors=(3.0,), **options).grids
    scaled = cp.TrigSpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(4, 2, 4 / 3, 0), cp.Waypoint(7, 3, 0, 0)], alpha=2.0)
    t = np.linspace(0, 8, 8001)
    y = cp.simulate(loop(400.0), t, scaled).outputs[0]
    error = np.abs(scaled(t) - y)
    assert grid.values[0, 0] == pytest.approx(np.sum(0.5 * (error[1:] + error[:-1]) * 1e-3), rel=1e-3)
    np.testing.assert_array_equal(grid.durations, [6.0])


@pytest.mark.slow
@pytest.mark.parametrize("factors", [(0.75, 2.0), (2.0, 0.75)])
def test_a_shaper_too_slow_for_some_of_the_durations(factors):
    """Period 1.41 s: a move of 2 s leaves room for it, one of 0.75 s does not."""
    found = worth(loop(20.0), MOVE, TIMES, alpha=1.0, alphas=(1.0,), factors=factors, decisive=("settling_time",))
    (grid,) = found.grids
    shaped = dict(zip(factors, grid.baselines["shaped S-curve"].tolist(), strict=True))
    assert math.isnan(shaped[0.75])
    assert math.isfinite(shaped[2.0])
    json.dumps(found.results(), allow_nan=False)


@pytest.mark.slow
def test_a_loop_without_controls_has_a_table_of_settling_alone():
    found = worth(loop(100.0, ("y",)), MOVE, TIMES, alpha=1.0, alphas=(1.0,), factors=(1.0,))
    assert [grid.title for grid in found.grids] == ["Settling time"]


@pytest.mark.slow
def test_a_move_there_and_back_is_settled_relative_to_its_range():
    """The end is the beginning: a step there is none, and has no figure; every other plan has a range."""
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1), cp.Waypoint(2, 0, 0, 0)]
    found = worth(loop(100.0), points, TIMES, alpha=1.0, alphas=(0.0, 1.0), factors=(1.0,))
    assert np.isfinite(found.grids[0].values).all()
    assert np.isnan(found.grids[0].baselines["step"]).all()
    assert "nan" not in " ".join(found.verdicts)
    plan = found.comparison.plans["trigonometric"]
    y = cp.simulate(loop(100.0), t := np.linspace(0, 12, 120_001), plan).outputs[0]
    last = np.flatnonzero(np.abs(y) > 0.02 * plan(t).max())[-1]
    assert found.grids[0].values[0, 1] == pytest.approx(t[last], abs=2e-4)


@pytest.mark.slow
def test_a_run_that_is_ended_loses():
    """At alpha = 3 the plan of 1 s asks for more than 15, every other for less."""
    ends = [cp.Event("u", high=15.0, stop=True)]
    few = {"alphas": (0.0, 1.0, 3.0), "factors": (1.0, 1.5), "decisive": ("settling_time",)}
    (table,) = worth(loop(100.0), MOVE, TIMES, alpha=1.0, events=ends, **few).grids
    assert table.values[0, 2] == math.inf
    assert np.isfinite(table.values[1]).all()
    assert table.marks()[0][2] == "worse"


# Wins and losses, counted by hand


def grid(values, not_ranked=(), **baselines):
    values = np.array(values, dtype=float)
    return Grid(
        "Length",
        "m",
        np.arange(1.0, len(values) + 1),
        np.arange(values.shape[1]) * 1.0,
        values,
        {name: np.array(row, dtype=float) for name, row in baselines.items()},
        not_ranked,
    )


def test_marks_are_against_the_best_baseline_of_each_row():
    found = grid([[5, 3, 1], [5, 3, 1]], one=[4, 2], two=[2, 6])
    assert [found.best(0), found.best(1)] == [("two", 2.0), ("one", 2.0)]
    assert found.marks() == [["worse", "worse", "better"], ["worse", "worse", "better"]]
    assert found.verdict == (
        "Length: of 4 trigonometric plans, 2 are better and 2 are worse than the best baseline of the same duration "
        "(two, one); the better ones have alpha = 2 and durations of 1 s, 2 s."
    )


def test_baselines_that_stand_beside_do_not_count():
    found = grid([[5, 3]], one=[4], step=[1], not_ranked=("step",))
    assert found.best(0) == ("one", 4.0)
    assert found.marks() == [["worse", "better"]]


@pytest.mark.parametrize(
    ("value", "baseline", "mark"),
    [
        (1.0, 1.0, ""),
        (1.0009, 1.0, ""),
        (0.9991, 1.0, ""),
        (1.002, 1.0, "worse"),
        (0.998, 1.0, "better"),
        (0.0, 0.0, ""),
        (0.0, 1e-30, "better"),
        (math.inf, 1.0, "worse"),
        (1.0, math.inf, "better"),
        (math.inf, math.inf, ""),
        (math.nan, 1.0, ""),
        (math.nan, math.inf, ""),
    ],
)
def test_marks_of_ties_and_of_what_is_infinite_or_undefined(value, baseline, mark):
    assert grid([[value]], one=[baseline]).marks() == [[mark]]


def test_an_undefined_baseline_does_not_count_where_it_is_undefined():
    found = grid([[2], [2]], one=[math.nan, 1], two=[3, math.nan])
    assert found.marks() == [["better"], ["worse"]]
    assert [found.best(i)[0] for i in (0, 1)] == ["two", "one"]


def test_no_one_wins_where_every_baseline_is_undefined():
    found = grid([[2.0, 2.0], [2.0, 3.0]], one=[math.nan, 2.5])
    assert found.marks() == [["", ""], ["better", "worse"]]
    assert "nan" not in found.verdict


def test_a_plan_wins_where_every_baseline_never_arrives():
    found = grid([[math.inf, 2.0]], one=[math.inf])
    assert found.marks() == [["", "better"]]
    assert "of 1 trigonometric plans, 1 are better and 0 are worse" in found.verdict


def test_the_polynomial_is_no_trigonometric_plan():
    """Alpha 0 is shown and marked, and not counted."""
    found = grid([[1, 3], [1, 3]], one=[2, 2])
    assert found.marks() == [["better", "worse"], ["better", "worse"]]
    assert found.verdict == (
        "Length: of 2 trigonometric plans, 0 are better and 2 are worse than the best baseline of the same duration "
        "(one)."
    )


# As data


def test_results_are_json_with_keys_that_stay(stiff, soft):
    for found in (stiff, soft):
        data = json.loads(json.dumps(found.results(), allow_nan=False))
        assert list(data) == ["plans", "needs", "grids"]
        assert list(data["plans"]) == list(found.comparison.plans)
        assert data["needs"]["step"] is None
        assert data["needs"]["quintic (minimum jerk)"] == pytest.approx(1.0, abs=1e-12)
        assert [list(table) for table in data["grids"]] == 2 * [["title", "durations", "alphas", "values", "rivals"]]
        for table, own in zip(data["grids"], found.grids, strict=True):
            np.testing.assert_array_equal(np.array(table["values"], dtype=float), own.values)


def test_what_is_infinite_or_undefined_is_null():
    lone = Benefit(
        cp.compare(loop(5.0), {"step": cp.Step(1.0)}, TIMES),
        {},
        (RequiredDuration("step", math.nan, "jumps"),),
        (grid([[math.inf, 1.0]], one=[math.nan]),),
        1.0,
    )
    data = lone.results()
    assert data["needs"] == {"step": None}
    assert data["grids"][0]["values"] == [[None, 1.0]]
    assert data["grids"][0]["rivals"] == {"one": [None]}


# From a comparison


@pytest.mark.slow
def test_compare_asks_when_it_is_asked_to(stiff):
    compared = cp.compare(loop(100.0), MOVE, TIMES, units={"y": "m"})
    found = cp.benefit(compared, loop(100.0), alphas=(0.0, 1.0, 3.0), durations=(1.0, 1.5))
    assert found.comparison.metrics == stiff.comparison.metrics
    assert found.comparison.units == {"y": "m"}
    assert found.results() == stiff.results()
    shown = compared.with_benefit(found)
    assert shown.results()["worth"] == stiff.results()
    assert list(shown.plans) == ["step", "polynomial", "trigonometric", "piecewise"]
    assert "worth" not in compared.results()


@pytest.mark.slow
def test_compare_hands_on_what_it_was_given():
    plans = {"mine": cp.PolySpline(MOVE)}
    measures = {"last": cp.Measure("Last", "s", "run", lambda run: run.t[-1])}
    options = {"waypoints": MOVE, "band": 0.05, "start": 0.25, "controls": ("u",), "measures": measures}
    found = cp.compare(loop(100.0), plans, TIMES, **options)
    gain = cp.benefit(found, loop(100.0), limits={"velocity": 3.0}, alphas=1.0, durations=1.0)
    inner = gain.comparison
    assert gain.limits == {"velocity": 3.0}
    assert inner.plans["trigonometric"].alpha == 1.0  # no plan of the comparison has another
    assert inner.metrics["trigonometric"]["last"] == TIMES[-1]
    own = found.metrics["mine"]
    assert inner.metrics["quintic (minimum jerk)"]["settling_time"] == pytest.approx(own["settling_time"], rel=1e-9)
    assert inner.metrics["quintic (minimum jerk)"]["iae"] == pytest.approx(own["iae"], rel=1e-9)


@pytest.mark.slow
def test_compare_judges_the_trigonometric_plan_that_it_was_given():
    plans = {"poly": cp.PolySpline(MOVE), "mine": cp.TrigSpline(MOVE, alpha=2.5)}
    found = cp.compare(loop(100.0), plans, TIMES[::4], waypoints=MOVE)
    gain = cp.benefit(found, loop(100.0), alphas=[1.0], durations=[1.0])
    assert gain.alpha == 2.5
    assert gain.comparison.metrics["trigonometric"] == found.metrics["mine"]
    assert {name: role.value for name, role in gain.comparison.roles.items()} == {
        "trigonometric": "planned",
        "step": "step",
        "trapezoid": "baseline",
        "S-curve": "baseline",
        "shaped step": "step",
        "shaped S-curve": "baseline",
        "quintic (minimum jerk)": "baseline",
    }


@pytest.mark.slow
def test_further_metrics_can_be_decisive():
    few = {"alphas": (0.0, 1.0), "factors": (1.0, 2.0), "decisive": ("half",)}
    found = worth(
        loop(100.0),
        MOVE,
        TIMES,
        alpha=1.0,
        measures={"half": cp.Measure("Peak speed times time", "m", "run", lambda run: run.plan.peak(1)[0] * run.last)},
        **few,
    )
    (table,) = found.grids
    assert (table.title, table.unit) == ("Peak speed times time", "m")
    np.testing.assert_allclose(table.values[:, 0], 15 / 8, rtol=1e-12)  # speed falls as the time grows
    assert found.comparison.metrics["trapezoid"]["half"] < 15 / 8


@pytest.mark.slow
def test_what_cannot_be_asked():
    without = cp.compare(loop(5.0), {"step": cp.Step(1.0)}, TIMES)
    with pytest.raises(ValueError, match=r"comparison must have waypoints, .*got none"):
        cp.benefit(without, loop(5.0))
    with pytest.raises(ValueError, match="comparison must be returned by compare"):
        cp.benefit(dataclasses.replace(without, experiment=None), loop(5.0))
    with pytest.raises(TypeError, match="comparison must be a Comparison, got StateSpace"):
        cp.benefit(ct.ss(loop(5.0)), loop(5.0))
    compared = cp.compare(loop(5.0), MOVE, TIMES)
    for wrong in (0.0, [1.0, -1.0]):
        with pytest.raises(ValueError, match="durations must be above 0, got"):
            cp.benefit(compared, loop(5.0), durations=wrong)
    for name in ("alphas", "durations"):
        for wrong in ([], np.nan, [[1.0]]):
            with pytest.raises(ValueError, match=f"{name} must be finite numbers, one or more, got"):
                cp.benefit(compared, loop(5.0), **{name: wrong})
    with pytest.raises(TypeError, match=r"waypoints must be Waypoints, got Step"):
        cp.Experiment({"step": cp.Step(1.0)}, TIMES, waypoints=[cp.Step(1.0)])
    with pytest.raises(ValueError, match="limits of velocity must be finite and above 0, got -1"):
        worth(loop(5.0), MOVE, TIMES, alpha=1.0, limits={"velocity": -1.0})
    with pytest.raises(ValueError, match=r"decisive"):
        worth(loop(5.0), MOVE, TIMES, alpha=1.0, decisive=("beauty",), alphas=(1.0,), factors=(1.0,))


# Smoother baselines


def test_smoother_polynomials_are_at_rest_to_higher_orders():
    """Between two waypoints the septic and the nonic, by their Hermite data; through more, those and the points."""
    two = [cp.Waypoint.from_jets(1, x=[0, 0, 0], z=[10, 0, 0]), cp.Waypoint.from_jets(3, x=[4, 0, 0], z=[9, 0, 0])]
    for points, names in ((two, ["septic", "nonic"]), (VIA, ["septic per segment", "nonic per segment"])):
        found = smoother_polynomials(points)
        assert list(found) == names
        for plan, order in zip(found.values(), (3, 4), strict=True):
            assert plan.labels == ("x", "z")
            for point in (points[0], points[-1]):
                np.testing.assert_allclose(plan.jet(point.time, order)[1:], 0.0, rtol=0, atol=1e-8)
            for point in points:
                np.testing.assert_allclose(plan.jet(point.time, 2)[: len(point.jet)], point.jet, rtol=0, atol=1e-8)
            assert not plan.jumps(order - 1)


def test_ends_that_are_not_at_rest_have_no_smoother_polynomial():
    assert smoother_polynomials([cp.Waypoint(0, 0, 1.0, 0), cp.Waypoint(1, 1, 0, 0)]) == {}
    assert smoother_polynomials([cp.Waypoint(0, 0, None, 0), cp.Waypoint(1, 1, 0, 0)]) == {}


@pytest.mark.slow
def test_further_baselines_are_compared_and_count():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    found = worth(loop(100.0), MOVE, TIMES, alpha=1.0, baselines=smoother_polynomials, **few)
    assert {"septic", "nonic"} <= set(found.comparison.plans)
    assert {"septic", "nonic"} <= set(found.grids[0].baselines)
    assert {"septic", "nonic"} <= {one.name for one in found.required_durations}


@pytest.mark.slow
def test_own_limits_are_said_to_be_so_and_given_ones_are_not():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    own = worth(loop(100.0), MOVE, TIMES, alpha=1.0, note="Mine.", **few)
    assert own.note.startswith("Mine. The limits are not those of a plant")
    given = worth(loop(100.0), MOVE, TIMES, alpha=1.0, note="Mine.", limits={"velocity": 3.0}, **few)
    assert given.note == "Mine."


def test_rounding_beside_the_scale_is_no_defeat():
    tied = Grid("Overshoot", "%", np.ones(1), np.ones(1), np.array([[3e-7]]), {"one": np.zeros(1)}, scale=100.0)
    assert tied.marks() == [[""]]
    lost = Grid("Overshoot", "%", np.ones(1), np.ones(1), np.array([[3e-3]]), {"one": np.zeros(1)}, scale=100.0)
    assert lost.marks() == [["worse"]]


def test_no_plan_is_run_twice():
    """Baselines and planned reference at the duration of the waypoints are in the comparison and in the tables."""
    ran = []

    def build(name, plan):
        ran.append((name, plan.end))
        source = cp.create_source_iosystem(plan, 0, suffix="_ref")
        inside = ct.ss(loop(100.0), inputs="y_ref", outputs=["y", "u"])
        return ct.interconnect([source, inside], inputs=0, outputs=["y", "u"])

    points = [cp.Waypoint.from_jets(w.time, y=[w.position[0], 0.0, 0.0]) for w in MOVE]
    found = worth(build, points, TIMES, alpha=1.0, mode=(20.0, 0.1), **TABLES)
    own = len(found.comparison.plans)
    # Then alpha = 3, then all of the other duration. The quintic is the trigonometric plan with alpha = 0.
    assert len(ran) == own + 1 + (2 + own - 1)
    alone = cp.compare(build, {"polynomial": cp.TrigSpline(points, alpha=0.0)}, TIMES, waypoints=points)
    for grid in found.grids:
        row = int(np.flatnonzero(grid.durations == 1.0)[0])
        key = next(k for k, m in found.comparison.measures.items() if m.title == grid.title)
        assert grid.values[row, 1] == found.comparison.metrics["trigonometric"][key]
        assert grid.values[row, 0] == pytest.approx(alone.metrics["polynomial"][key], rel=1e-9)
        for name, values in grid.baselines.items():
            assert values[row] == found.comparison.metrics[name][key] or math.isnan(values[row])


def test_the_tables_compute_only_the_measures_of_runs_that_they_show():
    seen = []

    def counted(key):
        def value(run):
            seen.append(key)
            return float(np.abs(run.signals["u"]).max())

        return cp.Measure(key, of="run", function=value)

    measures = {"first": counted("first"), "second": counted("second")}
    found = worth(loop(5.0), MOVE, TIMES, measures=measures, alpha=1.0, decisive=("first",), **TABLES)
    # The comparison of all plans has both; what the table adds has the first only.
    assert seen.count("second") == len(found.comparison.plans) < seen.count("first")
    assert np.isfinite(found.grids[0].values).all()


def test_the_tables_keep_measures_of_runs_that_return_what_they_show():
    def values(run):
        return {"largest": float(np.abs(run.signals["u"]).max()), "other": 1.0}

    measures = {"largest": cp.Measure("Largest"), "both": cp.Measure("Both", of="run", function=values)}
    found = worth(loop(5.0), MOVE, TIMES, measures=measures, alpha=1.0, decisive=("largest",), **TABLES)
    assert np.isfinite(found.grids[0].values).all()
