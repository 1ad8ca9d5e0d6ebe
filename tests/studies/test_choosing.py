"""What is chosen for the crane, against quadrature, scipy's splines and dense samples; and the claim of optimality."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from crane_table import SLACK, SMOOTH, computed_slack, computed_smooth
from scipy.integrate import quad
from scipy.interpolate import BPoly, make_interp_spline

import ctrlplan as cp
from ctrlplan.reports import verdicts
from ctrlplan.studies.choosing import (
    clearance_note,
    fastest_notes,
    nominal_fastest,
    optimality_claim,
    optimality_grids,
)
from ctrlplan.studies.crane_setup import nominal_waypoints, obstacle_waypoints
from ctrlplan.systems.plants import Crane, crane_loop

G, DRUM, TROLLEY, LOAD, INERTIA = 9.81, 0.25, 5000.0, 500.0, 50.0
QUINTIC = "quintic per segment (minimum jerk)"
FREED = "minimum jerk through the positions"
PER_SEGMENT = "shortest of one trigonometric spline per segment"
POLYLINE = "polyline (lower bound)"
L0 = 50**0.5 + 10 + 61**0.5


@pytest.fixture(scope="module")
def grids():
    return optimality_grids()


@pytest.fixture(scope="module")
def fast():
    return nominal_fastest()


def quintics(end):
    """One quintic per segment through the paper's waypoints, by scipy."""
    points = obstacle_waypoints(end)
    return BPoly.from_derivatives([w.time for w in points], [w.jet for w in points])


def clamped(end):
    """The quintic spline with four continuous derivatives at A and B, at rest at both ends."""
    points = obstacle_waypoints(end)
    rest = [(1, [0.0, 0.0]), (2, [0.0, 0.0])]
    return make_interp_spline([w.time for w in points], [w.position for w in points], k=5, bc_type=(rest, rest))


def length(velocity, end):
    """Length of a path by adaptive quadrature."""
    edges = [0.0, 6.0, 11.0, end]
    edges = np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in pairwise(edges)] + [[end]])
    return sum(quad(lambda t: np.hypot(*velocity(t)), a, b, epsabs=1e-11, epsrel=1e-12)[0] for a, b in pairwise(edges))


def jerk(third, end):
    edges = [0.0, 6.0, 11.0, end]
    return sum(quad(lambda t: (third(t) ** 2).sum(), a, b, epsabs=1e-9)[0] for a, b in pairwise(edges))


def cell(grid, end, alpha):
    (row,), (column,) = np.flatnonzero(grid.durations == end), np.flatnonzero(grid.alphas == alpha)
    return grid.values[row, column]


# Length and squared jerk over alpha and end time


@pytest.mark.slow
def test_grids_are_of_length_and_squared_jerk(grids):
    assert [(grid.title, grid.unit) for grid in grids] == [
        ("Path length", "m"),
        ("Integral of the squared jerk", "m²/s⁵"),
    ]
    for grid in grids:
        assert grid.values.shape == (grid.durations.size, grid.alphas.size)
        assert {14.0, 16.0, 20.0} <= set(grid.durations)
        assert {0.0, 4.0, 5.0} <= set(grid.alphas)
    assert list(grids[0].baselines) == [QUINTIC, FREED, PER_SEGMENT, POLYLINE]
    assert list(grids[1].baselines) == [QUINTIC, FREED, PER_SEGMENT]
    assert (grids[0].not_ranked, grids[1].not_ranked) == ((POLYLINE,), ())


@pytest.mark.parametrize(
    ("end", "alpha", "metres"),
    [(16.0, 0.0, "33.02"), (16.0, 4.0, "26.36"), (16.0, 5.0, "45.7"), (20.0, 0.0, "105"), (20.0, 4.0, "50")],
)
def test_lengths_are_those_of_math_md(grids, end, alpha, metres):
    digits = len(metres.partition(".")[2])
    assert f"{cell(grids[0], end, alpha):.{digits}f}" == metres


@pytest.mark.parametrize(("end", "alpha"), [(14.0, 5.0), (16.0, 4.0), (20.0, 0.0), (18.0, 4.5)])
def test_cells_against_quadrature(grids, end, alpha):
    plan = cp.TrigSpline(obstacle_waypoints(end), alpha=alpha)
    assert cell(grids[0], end, alpha) == pytest.approx(length(lambda t: plan(t, 1), end), rel=1e-9)
    assert cell(grids[1], end, alpha) == pytest.approx(jerk(lambda t: plan(t, 3), end), rel=1e-9)


@pytest.mark.parametrize("end", [14.0, 16.0, 20.0])
def test_baselines_against_splines_of_scipy(grids, end):
    (row,) = np.flatnonzero(grids[0].durations == end)
    for name, spline in ((QUINTIC, quintics(end)), (FREED, clamped(end))):
        assert grids[0].baselines[name][row] == pytest.approx(length(spline.derivative(), end), rel=1e-8)
        assert grids[1].baselines[name][row] == pytest.approx(jerk(spline.derivative(3), end), rel=1e-8)


def test_the_polyline_and_the_length_of_one_quintic_per_segment(grids):
    baselines = dict(grids[0].baselines)
    np.testing.assert_allclose(baselines.pop(POLYLINE), L0, rtol=1e-12)
    assert f"{L0:.1f}" == "24.9"
    assert all((values > L0).all() for values in baselines.values())
    assert (grids[0].values > L0).all()
    of_end = dict(zip(grids[0].durations, baselines[QUINTIC] / L0, strict=True))
    assert (f"{of_end[16.0]:.2f}", f"{of_end[20.0]:.2f}") == ("1.03", "1.06")


def test_no_trigonometric_spline_per_segment_is_shorter_than_that_of_the_table(grids):
    for end, found in zip(grids[0].durations, grids[0].baselines[PER_SEGMENT], strict=True):
        t = np.linspace(0, end, 2001)
        alphas = np.linspace(0, 5.5, 23)
        ways = [
            np.hypot(*np.diff(cp.PiecewiseSpline(obstacle_waypoints(end), alpha=a, warn=False)(t))).sum()
            for a in alphas.tolist()
        ]
        assert found <= min(ways) * (1 + 1e-6)
        assert found == pytest.approx(min(ways), rel=1e-3)


def test_one_quintic_per_segment_has_the_minimum_jerk_for_its_constraints_and_freed_ones_less(grids):
    least = grids[1].baselines
    assert (grids[1].values > least[QUINTIC][:, None]).all()
    assert (least[PER_SEGMENT] >= least[QUINTIC] * (1 - 1e-9)).all()
    assert (least[FREED] < least[QUINTIC]).all()


# The claim


@pytest.mark.slow
def test_the_claim_is_not_true_and_the_text_gives_the_values(grids):
    claim = optimality_claim(grids)
    text = " ".join(claim)
    assert all(mark == "worse" for grid in grids for row in grid.marks() for mark in row)
    assert "In 36 combinations of alpha and end time" in claim[0]
    assert claim[0].endswith("the claim is true in none of the cases.")
    assert claim[-2:] == (grids[0].verdict, grids[1].verdict)
    shorter = sum(value < 0.999 * row[0] for row in grids[0].values for value in row[1:])
    assert f"shorter in {shorter} of 36 cases" in text
    at_16 = grids[1].values[list(grids[1].durations).index(16.0)]
    assert f"For 16 s its value is {jerk(quintics(16.0).derivative(3), 16.0):.3g} m²/s⁵" in text
    assert f"of a trigonometric plan in the table is {min(at_16[1:]):.3g} m²/s⁵." in text
    assert f"{QUINTIC}, has a length of {length(quintics(16.0).derivative(), 16.0):.4g} m; the polyline" in text
    assert f"the polyline, a lower bound, has {L0:.4g} m." in text
    assert f"the straight line of {401**0.5:.4g} m" in text
    assert "nan" not in text


@pytest.mark.slow
def test_the_shortest_path_of_the_claim_is_the_shortest_of_a_scan(grids):
    alpha, metres = map(
        float, re.search(r"has alpha = ([\d.]+) and a length of ([\d.]+) m", optimality_claim(grids)[1]).groups()
    )
    t = np.linspace(0, 16, 4001)
    alphas = np.linspace(3.9, 4.4, 51)
    ways = [np.hypot(*np.diff(cp.TrigSpline(obstacle_waypoints(), alpha=a)(t))).sum() for a in alphas.tolist()]
    assert alpha == pytest.approx(alphas[np.argmin(ways)], abs=0.011)
    assert metres == pytest.approx(min(ways), abs=0.006)


@pytest.mark.slow
def test_the_claim_is_counted_where_it_is_true(grids):
    """The words follow the numbers: a plan that is shorter than all baselines is counted."""
    values = grids[0].values.copy()
    values[2, 4] = values[0, 1] = 24.9
    won = optimality_claim((replace(grids[0], values=values), grids[1]))
    assert "the claim is true in 2 of 72 cases." in won[0]


@pytest.mark.parametrize("alpha", [0.0, 1.0, 2.0, 3.0, np.pi])
def test_from_rest_to_rest_every_path_below_pi_has_one_length(alpha):
    x, z = cp.TrigSpline(nominal_waypoints(), alpha=alpha)(np.linspace(0, 15, 2001))
    np.testing.assert_allclose(z, 10 + x / 20, rtol=0, atol=1e-11)
    assert np.abs(np.diff(x)).sum() == pytest.approx(20.0, rel=1e-12)


def test_from_rest_to_rest_the_polynomial_has_the_least_jerk():
    plans = [cp.TrigSpline(nominal_waypoints(), alpha=a) for a in (0.0, 0.5, 1.0, 2.0, 3.0)]
    costs = [quad(lambda t, plan=plan: (plan(t, 3) ** 2).sum(), 0, 15)[0] for plan in plans]
    assert costs == sorted(costs)
    assert costs[0] == pytest.approx(720 * 401 / 15**5, rel=1e-9)


# Minimum duration within limits


def drives(plan):
    """Signals of the crane along a plan, (15) from dense samples; differences in the place of derivatives."""
    t = np.linspace(plan.start, plan.end, 200_001)
    x, z = plan(t)
    across, fall = plan(t, 2)
    theta = np.arctan2(-across, G - fall)
    tension = LOAD * np.hypot(across, G - fall)
    rope = (z * tension / LOAD - DRUM * across) / (G - fall)
    trolley = x - (DRUM * tension / LOAD - z * across) / (G - fall)
    dt = t[1] - t[0]
    rates = [np.gradient(np.gradient(s, dt, edge_order=2), dt, edge_order=2) for s in (trolley, rope)]
    speeds = [np.gradient(s, dt, edge_order=2) for s in (trolley, rope)]
    force = TROLLEY * rates[0] + 20.0 * speeds[0] + LOAD * across
    torque = INERTIA * rates[1] / DRUM + 20.0 * speeds[1] / DRUM - DRUM * tension
    return t, {"theta": theta, "T": tension, "R": rope, "F": force, "C": torque}


def test_the_fastest_move_meets_its_waypoints_and_is_at_its_limit(fast):
    assert fast.plan.duration == fast.duration < 15.0
    np.testing.assert_allclose(fast.plan([0.0, fast.duration]), [[0, 20], [10, 11]], rtol=0, atol=1e-9)
    for nu in range(1, 5):
        np.testing.assert_allclose(fast.plan([0.0, fast.duration], nu), 0.0, rtol=0, atol=1e-9)
    t, signals = drives(fast.plan)
    worst = np.argmax(np.abs(signals["theta"]))
    assert abs(signals["theta"][worst]) == pytest.approx(0.1, rel=1e-8)
    assert fast.active.bound.name == "theta"
    near = np.abs(signals["theta"]) > 0.1 * (1 - 1e-7)
    assert np.abs(t[near] - fast.active.time).min() < 1e-2
    assert np.abs(drives(fast.plan.retime(0.9999 * fast.duration))[1]["theta"]).max() > 0.1


def test_margins_are_what_dense_samples_leave(fast):
    _, signals = drives(fast.plan)
    limits = {"F": (-5e3, 5e3), "C": (-3e3, 1e3), "theta": (-0.1, 0.1), "R": (1.0, 12.0), "T": (0.0, np.inf)}
    assert {row.bound.name for row in fast.margins} == set(limits)
    for row in fast.margins:
        low, high = limits[row.bound.name]
        values = signals[row.bound.name]
        scale = 0.5 * (high - low) if np.isfinite(high) else 1.0
        left = min(high - values.max(), values.min() - low) / scale
        assert row.fraction == pytest.approx(left, rel=1e-3, abs=1e-6), row.bound.name
        assert row.fraction >= 0.0
    fractions = [row.fraction for row in fast.margins]
    assert fractions == sorted(fractions)


@pytest.mark.slow
def test_the_notes_say_which_limit_where_and_what_the_others_leave(fast):
    (note,) = fastest_notes(fast)
    assert f"is {fast.duration:.4g} s. The active limit is theta at {fast.active.time:.3g} s." in note
    for name in "RFC":
        assert re.search(rf"\b{name} [\d.]+", note)
    assert "theta" not in note.partition("Margins of the other limits:")[2].partition("With an optimized time law")[0]
    other = float(re.search(r"With an optimized time law on the same path the minimum duration is ([\d.]+) s", note)[1])
    assert 0.5 * fast.duration < other < fast.duration


# The wall


def test_clearance_is_that_of_dense_samples():
    """Disc of 0.5 m about the load, and its rope up to the drum, from the wall x in [7, 13], z in [6.5, 12]."""
    points = obstacle_waypoints()
    plans = {
        "polynomial": cp.PolySpline(points),
        "trigonometric": cp.TrigSpline(points, alpha=4.0),
        "piecewise": cp.PiecewiseSpline(points),
        "step": cp.Step([20.0, 11.0], [0.0, 10.0]),
    }
    note = clearance_note(plans)
    found = dict(re.findall(r"(\w+) (-?[\d.]+ m \(\w+\))", note))
    assert set(found) == {"polynomial", "trigonometric", "piecewise"}  # a step takes no way
    for name, said in found.items():
        t = np.linspace(0, 16, 4001)
        (x, z), (across, fall) = plans[name](t), plans[name](t, 2)
        lean = across / np.hypot(across, G - fall)
        top = np.array([x + across / (G - fall) * (z - DRUM * lean), DRUM * lean])

        def beyond(p):
            aside = np.maximum(np.maximum(7.0 - p[0], p[0] - 13.0), 0.0)
            above = np.maximum(np.maximum(6.5 - p[1], p[1] - 12.0), 0.0)
            inside = np.minimum.reduce([p[0] - 7.0, 13.0 - p[0], p[1] - 6.5, 12.0 - p[1]])
            return np.where(inside > 0.0, -inside, np.hypot(aside, above))

        load = beyond(np.array([x, z])).min() - 0.5
        share = np.linspace(0, 1, 101)[:, None, None]
        lines = share * top + (1 - share) * np.array([x, z])
        rope = beyond(np.moveaxis(lines, 1, 0)).min()
        least, part = (load, "load") if load < rope else (rope, "rope")
        assert said == f"{least:.2f} m ({part})"


# The nominal move compared its baselines


@pytest.mark.slow
def test_the_nominal_move_beside_its_baselines(baselines):
    names = ["trigonometric", "step", "trapezoid", "S-curve", "shaped step", "shaped S-curve", "quintic (minimum jerk)"]
    assert list(baselines.comparison.plans) == [*names, "septic", "nonic"]
    half = np.pi * np.sqrt(10.5 / G)
    np.testing.assert_allclose(baselines.comparison.plans["shaped step"].breakpoints, [0, half, 2 * half], rtol=1e-12)
    required = {one.name: one for one in baselines.required_durations}
    # 15/8 of 20 m in 15 s is the limit of 2.5 m/s itself.
    assert required["quintic (minimum jerk)"].duration == pytest.approx(15.0, rel=1e-9)
    t = np.linspace(0, 1, 100_001)
    unit = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], alpha=1.0)
    assert required["trigonometric"].duration == pytest.approx(20 / 2.5 * unit(t, 1).max(), rel=1e-8)
    assert np.isnan(required["step"].duration)


@pytest.mark.slow
def test_the_s_curve_of_the_needs_sways_as_far_as_is_allowed(baselines):
    """A jerk limit of 0.4 alone would take 20/2.5 + 2.5/0.6 + 0.6/0.4 s: it is retimed to 0.06 rad of sway."""
    alone = 20 / 2.5 + 2.5 / 0.6 + 0.6 / 0.4
    (one,) = (one for one in baselines.required_durations if one.name == "S-curve")
    stretch = one.duration / alone
    across, fall = 0.6 / stretch**2, 0.03 / stretch**2
    assert np.arctan2(across, G - fall) == pytest.approx(0.06, rel=1e-6)
    assert "theta" in one.limit


@pytest.mark.slow
def test_values_of_the_crane_are_those_of_runs_of_their_own(baselines):
    settling, sway, force = baselines.grids
    assert [grid.unit for grid in baselines.grids] == ["s", "rad", "N"]
    plan = cp.TrigSpline(nominal_waypoints(), alpha=3.0)
    profile = baselines.comparison.plans["S-curve"]
    t = np.linspace(0, 40, 4001)
    limits = {"force_limits": (-30e3, 30e3), "torque_limits": (-3e3, 1e3)}
    for given, law, column in ((plan, "generator", None), (profile, "generator", "S-curve")):
        made = crane_loop(Crane(), given, law, **limits)
        out = cp.simulate(made, t, initial_state=made.initial_state)
        rows = dict(zip(out.output_labels, np.asarray(out.outputs), strict=True))
        swayed, pushed = np.abs(rows["theta"][t >= 15]).max(), np.abs(rows["F"]).max()
        found = [g.values[1, 3] if column is None else g.baselines[column][1] for g in (sway, force)]
        assert found == pytest.approx([swayed, pushed], rel=5e-3)
    assert (np.diff(settling.values[:, :4], axis=1) < 0).all()  # it wins over the polynomial where alpha is below pi


@pytest.mark.slow
def test_what_jumps_takes_no_path_and_the_others_the_straight_line(baselines):
    lengths = {name: values["path_length"] for name, values in baselines.comparison.metrics.items()}
    for name, found in lengths.items():
        assert found == pytest.approx(np.nan if "step" in name else 401**0.5, rel=1e-6, nan_ok=True), name


@pytest.mark.slow
def test_limited_drives_are_never_asked_for_more_than_they_have(baselines):
    force = baselines.grids[2]
    peaks = [np.nanmax(rows) for rows in force.baselines.values() if not np.isnan(rows).all()]
    assert max(force.values.max(), *peaks) <= 30e3 * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_figures_of_smooth_plans_are_the_integration_by_hand(name):
    sway, force = computed_smooth(name)
    assert (f"{sway:.3e}", round(force)) == (f"{SMOOTH[name][0]:.3e}", SMOOTH[name][1])


@pytest.mark.slow
def test_the_time_of_the_slack_rope_is_the_integration_by_hand():
    assert computed_slack() == pytest.approx(SLACK, abs=0.5e-4)


@pytest.mark.slow
def test_every_smooth_baseline_goes_through_the_flat_map(baselines):
    """Residual sway and force of septic, nonic and alpha = 3 through the same generator."""
    rows = baselines.comparison.metrics
    for name in ("septic", "nonic"):
        assert (rows[name]["sway_after"], rows[name]["force_peak"]) == pytest.approx(SMOOTH[name], rel=1e-3)
    sway, force = baselines.grids[1:]
    assert (sway.values[1, 3], force.values[1, 3]) == pytest.approx(SMOOTH["alpha = 3"], rel=5e-3)
    assert {row[3] for row in sway.marks()} == {"worse"}  # alpha = 3 is not the best in sway at any duration
    s = np.linspace(0, 1, 101)
    for name, curve in (
        ("septic", s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)),
        ("nonic", s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)),
    ):
        plan = baselines.comparison.plans[name]
        np.testing.assert_allclose(plan(15 * s), [20 * curve, 10 + curve], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_step_is_valid_up_to_the_slack_rope_and_is_not_ranked(baselines):
    found = baselines.comparison
    assert found.stopped["step"] == pytest.approx(SLACK, abs=1e-3)
    assert str(SLACK) in found.marks["step"]
    assert found.responses["step"].time[-1] == found.stopped["step"]
    assert not any("step" in (*verdict.best, *verdict.worst) for verdict in verdicts(found))
    assert all(np.isnan(grid.baselines["step"]).all() for grid in baselines.grids)
