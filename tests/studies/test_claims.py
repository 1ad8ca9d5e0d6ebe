"""Claims of the page about the crane, each computed without the package: by hand-written models and plain sums."""

import math
import re

import numpy as np
import pytest
from crane_oracle import B, by_hand, hand_rate, pid

import ctrlplan as cp
from ctrlplan.reports import render_page
from ctrlplan.studies import MEASURES, Study
from ctrlplan.studies import crane as studies
from ctrlplan.studies.crane_setup import CRANE_MEASURES

T = np.linspace(0.0, 2.0, 201)


# Peak forces

NOMINAL = {
    "polynomial": cp.PolySpline(studies.nominal_waypoints()),
    "trigonometric": cp.TrigSpline(studies.nominal_waypoints(), alpha=1.0),
    "piecewise": cp.PiecewiseSpline(studies.nominal_waypoints()),
}
FIRST_ORDER = {
    "polynomial": cp.PolySpline(studies.first_order_waypoints()),
    "trigonometric": cp.TrigSpline(studies.first_order_waypoints(), alpha=np.pi / 3, gamma=np.pi / 2),
    "piecewise": cp.PiecewiseSpline(studies.first_order_waypoints()),
}
OBSTACLE = {
    "polynomial": cp.PolySpline(studies.obstacle_waypoints()),
    "trigonometric": cp.TrigSpline(studies.obstacle_waypoints(), alpha=4.0),
    "piecewise": cp.PiecewiseSpline(studies.obstacle_waypoints()),
}


def noted(plans, end):
    """What the page says of peak forces, from a comparison of its own with the plans of a study."""
    points = next(iter(plans.values())).waypoints
    found = studies._compared({name: (plan, {}) for name, plan in plans.items()}, points, end, "Claims")
    return studies._limits_note(found)


def force_of(plan, times):
    """Trolley force at times near each other, from an integration by hand from rest."""
    start = [0.0, 0.0, 0.0, 0.0, plan.initial[0] - B, plan.initial[1], 0.0, 0.0, 0.0, 0.0]
    t = np.union1d([plan.start], times)
    states = by_hand(plan, "generator", False, start, t)
    found = []
    for time, state in zip(t, states.T, strict=True):
        force_rate = hand_rate(lambda moment: plan.jet(moment, 4), "generator", False)(time, state)[0]
        error = force_rate / 625e3  # rate of the integral of the PID is Ki times the error, Ki = M w^3
        found.append(pid(5000.0, 20.0, error, state[:2], 0.0, (-math.inf, math.inf))[0])
    return np.array(found)[np.searchsorted(t, times)]


def jump_of(plan, time, order):
    """Jump of a derivative at a time by samples on each side, relative to its peak; 0 outside of the plan."""
    h = 1e-6
    sides = []
    for side in (-1.0, 1.0):
        at = time + side * h
        inside = plan.start < at < plan.end
        sides.append(plan.jet(at, order)[order] if inside else np.zeros(2))
    return np.abs(sides[1] - sides[0]).max() / max(
        np.abs(plan(np.linspace(plan.start, plan.end, 201), order)).max(), 1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plans", "end", "orders"),
    [
        (NOMINAL, 30.0, {"polynomial": 3, "trigonometric": 3, "piecewise": 3}),
        (FIRST_ORDER, 60.0, {"polynomial": 1, "trigonometric": 2, "piecewise": 1}),
        (OBSTACLE, 30.0, {"polynomial": 3, "trigonometric": 3, "piecewise": 3}),
    ],
    ids=["nominal", "first-order", "obstacle"],
)
def test_peak_forces_follow_the_discontinuities_that_are_named(plans, end, orders):
    note = noted(plans, end)
    said = dict(re.findall(r"(\w+) ([\d.]+) kN at", note))
    for name, plan in plans.items():
        (time,) = re.findall(rf"{name} {said[name]} kN at ([\d.]+) s", note)
        ((derivative, at),) = re.findall(rf"of the (\w+) at ([\d.]+) s \([^)]*\b{name}\b[^)]*\)", note)
        order = ("position", "velocity", "acceleration", "jerk").index(derivative)
        assert order == orders[name]
        assert jump_of(plan, float(at), order) > 0.05
        assert all(jump_of(plan, float(at), lower) < 1e-3 for lower in range(1, order))
        around = float(at) + np.linspace(1e-9 if float(at) == plan.start else 0.0, 0.5, 26)
        peak = np.abs(force_of(plan, np.clip(around, plan.start, end))).max()
        assert peak == pytest.approx(1e3 * float(said[name]), rel=0.05)
        assert 0.0 <= float(time) - float(at) <= 0.5 + 0.05


def test_the_jerk_of_one_quintic_per_segment_is_discontinuous_at_the_via_points():
    plan = OBSTACLE["piecewise"]
    for time in (6.0, 11.0):
        assert jump_of(plan, time, 3) > 0.05
        assert max(jump_of(plan, time, order) for order in (0, 1, 2)) < 1e-4


# Path lengths


def length(plan):
    path = plan(np.linspace(plan.start, plan.end, 20001))
    return np.hypot(*np.diff(path, axis=1)).sum()


def test_where_the_trigonometric_path_is_longer_than_that_of_the_polynomial():
    """Above alpha = 5 much longer; for 20 s both are much longer than the polyline."""
    polyline = sum(math.dist(a, b) for a, b in [((0, 10), (5, 5)), ((5, 5), (15, 5)), ((15, 5), (20, 11))])
    for end in (14.0, 16.0, 20.0):
        points = studies.obstacle_waypoints(end)
        polynomial = length(cp.PolySpline(points))
        assert length(cp.TrigSpline(points, alpha=5.6, warn=False)) > 10.0 * polynomial
        if end == 20.0:
            shapes = [cp.TrigSpline(points, alpha=alpha, warn=False) for alpha in np.linspace(0.5, 5.5, 11)]
            assert min(polynomial, *map(length, shapes)) > 1.8 * polyline
    assert polyline == pytest.approx(24.9, abs=0.05)


@pytest.mark.slow
def test_one_quintic_per_segment_is_the_shortest_of_the_figure():
    for end in (14.0, 16.0, 20.0):
        points = studies.obstacle_waypoints(end)
        shapes = [cp.TrigSpline(points, alpha=alpha, warn=False) for alpha in np.linspace(0.05, 5.6, 38)]
        assert length(cp.PiecewiseSpline(points)) < min(map(length, (cp.PolySpline(points), *shapes)))
    assert studies._piecewise_lengths().startswith("is the shortest for all values")


# Speeds at the ends


def test_speeds_of_the_first_order_splines_at_their_ends():
    """x = 40 + 40 sin(tau - pi/2) and z in proportion: at rest at the start only, at alpha = pi at both ends."""
    points = studies.first_order_waypoints()
    size = math.hypot(20.0, 1.0)
    paper, mean = cp.TrigSpline(points, alpha=np.pi / 3, gamma=np.pi / 2), cp.TrigSpline(points, alpha=np.pi / 3)
    rate = np.pi / 3 / 30.0
    for plan, gamma in ((paper, np.pi / 2), (mean, np.pi / 6)):
        # y = a + c sin(tau - gamma), y(0) = 0 and y(alpha) = size, so that c = size/(sin(alpha - gamma) + sin gamma).
        c = size / (math.sin(np.pi / 3 - gamma) + math.sin(gamma))
        for time, tau in ((0.0, 0.0), (30.0, np.pi / 3)):
            expected = abs(c * rate * math.cos(tau - gamma))
            assert np.hypot(*plan(time, 1)) == pytest.approx(expected, abs=1e-12)
    assert np.hypot(*paper(0.0, 1)) < 1e-12 < 0.5 < np.hypot(*mean(0.0, 1))
    still = cp.TrigSpline(points, alpha=np.pi)
    assert max(np.hypot(*still(time, 1)) for time in (0.0, 30.0)) < 1e-12
    assert np.hypot(*cp.PolySpline(points)(0.0, 1)) == pytest.approx(size / 30.0, rel=1e-12)


# The sway


def closed_loop_poles(integral):
    """Trolley and pendulum by hand, R = 10 m: M D'' = F - f D' + m g theta, R theta'' = -g theta - D''."""
    mass, load, f1, g, r, w, tf = 5000.0, 500.0, 20.0, 9.81, 10.0, 5.0, 0.02
    kp, ki, kd = 3 * mass * w**2, integral * mass * w**3, 3 * mass * w - f1
    # States D, D', theta, theta', integral of -D, filtered -D; F = kp e + ki int(e) + kd (e - filtered)/tf.
    force = np.array([-kp - kd / tf, -f1, load * g, 0.0, ki, -kd / tf]) / mass
    rows = [[0, 1, 0, 0, 0, 0], force, [0, 0, 0, 1, 0, 0], (-np.array([0, 0, g, 0, 0, 0]) - force) / r]
    return np.linalg.eigvals(np.array([*rows, [-1, 0, 0, 0, 0, 0], [-1 / tf, 0, 0, 0, 0, -1 / tf]]))


def test_the_sway_grows_because_of_the_integral_action():
    """With it the pair of the sway is to the right of the imaginary axis, without it to the left."""
    pairs = [[pole for pole in closed_loop_poles(k) if 0.5 < pole.imag < 1.3] for k in (1.0, 0.0)]
    (grows,), (decays,) = pairs
    assert grows.real == pytest.approx(0.00030, abs=5e-6)
    assert grows.imag == pytest.approx(0.990, abs=5e-4)
    assert decays.real < 0.0


# Units and normalisations


@pytest.mark.slow
def test_each_unit_and_normalisation_is_explained_once():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    found = cp.compare(loop, [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], T, units={"y": "m", "u": "N"})
    page = render_page([Study("one", "One", found)], "Page")
    for measure in MEASURES.values():
        if measure.unit == "%" or measure.unit.count(" ") or "^" in measure.unit or "/" in measure.unit:
            assert measure.definition
        if measure.definition:
            assert page.count(measure.definition) == 1
    assert {CRANE_MEASURES[name].definition for name in ("error_travel", "error_after", "sway_after")} != {""}
    for said in (
        "percent of the range of the plan",
        "squared times s",
        "polyline through the waypoints, minus 1",
        "s⁵",
    ):
        assert said in page
