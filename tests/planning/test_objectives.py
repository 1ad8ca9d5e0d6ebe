"""Objectives of a plan against closed forms, quadrature and exact roots of polynomials."""

from itertools import pairwise
from math import asinh, cos, pi, sin, sqrt
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.integrate import quad
from scipy.interpolate import BPoly, PPoly
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.planning import OBJECTIVES, PeakDerivative, SquaredDerivative, plan_excess_length, plan_length
from ctrlplan.planning.objectives import ObjectiveName, declared_size, of_size, plan_lengths

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]
MOVE = cp.PolySpline(REST)
TIMES = [0.0, 1.5, 2.0, 4.0]
JETS = np.random.default_rng(2).normal(size=(4, 3, 2)) * np.array([3.0, 2.0, 1.0])[:, None]
POINTS = [Waypoint(t, *jet) for t, jet in zip(TIMES, JETS, strict=True)]
PLANS = {
    "polynomial": cp.PolySpline(POINTS, warn=False),
    "trigonometric": cp.TrigSpline(POINTS, alpha=4.0, warn=False),
    "piecewise": cp.PiecewiseSpline(POINTS),
    "piecewise trigonometric": cp.PiecewiseSpline(POINTS, alpha=3.0),
    "one axis": cp.TrigSpline(POINTS, alpha=2.0, warn=False).select("y1"),
    "three axes": cp.stack(
        [cp.TrigSpline(POINTS, alpha=1.0, warn=False), cp.PolySpline(REST, labels=["up"]).retime(4.0)]
    ),
}
NAMES = {
    "path": plan_length,
    "wandering": plan_excess_length,
    **{f"peak_{name}": PeakDerivative(k) for k, name in enumerate(["velocity", "acceleration", "jerk", "snap"], 1)},
    **{
        f"squared_{name}": SquaredDerivative(k)
        for k, name in enumerate(["velocity", "acceleration", "jerk", "snap"], 1)
    },
}


class Loops(cp.Trajectory):
    """A straight line for 1 s, then for 2 s a line with circles of radius 1/4, some a second."""

    breakpoints, labels, waypoints = np.array([0.0, 1.0, 3.0]), ("x", "z"), ()

    def __init__(self, turns):
        vars(self)["turns"] = turns

    def segment_jet(self, segment, s, order):
        line, rate = [s + segment, np.ones_like(s)], 2 * pi * self.turns
        jet = [line[k] if k < 2 else np.zeros_like(s) for k in range(order + 1)]
        circle = [0.25 * (1j * rate) ** k * np.exp(1j * rate * s) if segment else 0.0 * s for k in range(order + 1)]
        return np.array([[x + c.imag, c.real] for x, c in zip(jet, circle, strict=True)])

    def segment_series(self, segment, s, order):
        raise NotImplementedError

    map_time = to_dict = from_dict = segment_series


def integral(plan, integrand):
    """Integral over time of a function of one time, segment by segment, by adaptive quadrature."""
    edges = plan.breakpoints.tolist()
    return sum(quad(integrand, a, b, epsabs=0, epsrel=1e-12, limit=400)[0] for a, b in pairwise(edges))


def quintics():
    """Quintic segments of the same data, by scipy."""
    return PPoly.from_bernstein_basis(BPoly.from_derivatives(TIMES, JETS))


def test_names_lead_to_the_objectives():
    assert dict(OBJECTIVES) == NAMES


@pytest.mark.parametrize("name", PLANS)
def test_plan_length_is_the_integral_of_the_speed(name):
    plan = PLANS[name]
    expected = integral(plan, lambda t: float(np.linalg.norm(plan.jet(t, 1)[1])))
    # These plans turn round, and nearly stop there.
    assert plan_length(plan) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("alpha", [2.75, 2.8, 5.5, 5.6])
def test_plan_length_where_the_path_nearly_stops_more_than_once_in_a_panel(alpha):
    points = [
        Waypoint(0, [0, 10], 0, 0),
        Waypoint(6, [5, 5], [1, -1], [0.1, -0.15]),
        Waypoint(11, [15, 5], [2, 1], [0.1, 1]),
        Waypoint(14, [20, 11], 0, 0),
    ]
    plan = cp.TrigSpline(points, alpha=alpha, warn=False)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    panels = np.linspace(0.0, 14.0, 4001)
    times = panels[:-1, None] + 14.0 / 4000 * (1.0 + nodes) / 2
    expected = float((np.hypot(*plan.jet(times, 1)[1]) @ weights).sum()) * 14.0 / 8000
    assert plan_length(plan) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("count", [1, 3, 200])
def test_lengths_of_many_plans_are_those_of_each(count):
    rng = np.random.default_rng(4)
    shapes = rng.normal(size=(count, *JETS.shape))
    kinds = cp.PiecewiseSpline, cp.PolySpline
    plans = [
        kinds[k % 2]([Waypoint(t, *jet) for t, jet in zip(TIMES, jets, strict=True)], warn=False)
        for k, jets in enumerate(shapes)
    ]
    assert plan_lengths(plans) == pytest.approx([plan_length(plan) for plan in plans], rel=1e-14)
    assert plan_lengths([plan.select("y1") for plan in plans]) == pytest.approx(
        [plan_length(plan.select("y1")) for plan in plans], rel=1e-14
    )
    assert plan_lengths([]).size == 0


@pytest.mark.parametrize("turns", [1, 12, 60])
def test_plan_length_of_many_turns_in_one_segment(turns):
    """With more turns than one interpolant of the velocity on the segment resolves."""
    rate = 0.5 * pi * turns  # of the velocity on the circle
    turn = quad(lambda a: sqrt(1 + rate**2 + 2 * rate * cos(a)), 0, 2 * pi, epsabs=0, epsrel=1e-12)[0]
    assert plan_length(Loops(turns)) == pytest.approx(1.0 + 2.0 * turn / (2 * pi), rel=1e-9)


def test_plan_length_of_a_half_circle():
    points = [Waypoint(t, [2 * cos(t), 2 * sin(t)]) for t in (0.0, pi / 2, pi)]
    assert plan_length(cp.TrigSpline(points, alpha=pi)) == pytest.approx(2 * pi, rel=1e-14)


def test_plan_length_of_a_parabola():
    parabola = cp.PolySpline([Waypoint(t, [t, t * t]) for t in (0.0, 1.0, 3.0)])
    assert plan_length(parabola) == pytest.approx((6 * sqrt(37) + asinh(6)) / 4, rel=1e-14)


def test_plan_length_counts_the_way_there_and_back():
    there_and_back = MOVE.then(cp.PolySpline([Waypoint(1, 1, 0, 0), Waypoint(3, -2, 0, 0)]))
    assert plan_length(there_and_back) == pytest.approx(4.0, rel=1e-14)


@pytest.mark.parametrize("alpha", np.linspace(3.2, 6.2, 30).tolist())
def test_plan_length_of_a_straight_move_that_reverses(alpha):
    plan = cp.TrigSpline([Waypoint(0, [0, 10], 0, 0), Waypoint(15, [20, 11], 0, 0)], alpha=alpha, warn=False)
    t = np.linspace(0.0, 15.0, 4001)[1:-1]  # at rest at both ends
    slope = plan.jet(t, 1)[1, 0]
    cells = np.flatnonzero(slope[1:] * slope[:-1] < 0.0)
    turns = [brentq(lambda s: plan.jet(s, 1)[1, 0], *t[k : k + 2], xtol=1e-14) for k in cells.tolist()]
    way = np.abs(np.diff(plan.jet([0.0, *turns, 15.0], 0)[0, 0])).sum()
    assert plan_length(plan) == pytest.approx(way * np.hypot(20.0, 1.0) / 20.0, rel=1e-8)


@pytest.mark.parametrize("miss", [1e-2, 1e-4, 0.0])
def test_plan_length_where_the_path_nearly_stops(miss):
    # x = t^2, z = miss t through t = 0: the speed hypot(2 t, miss) has its minimum inside a panel.
    a, b = -0.7, 1.3
    plan = cp.PolySpline([Waypoint(t, [t * t, miss * t]) for t in (a, 0.4, b)])

    def primitive(t):
        return t * sqrt(t * t + miss**2 / 4) + (miss**2 / 4 * asinh(2 * t / miss) if miss else 0.0)

    expected = primitive(b) - primitive(a) if miss else a * a + b * b
    assert plan_length(plan) == pytest.approx(expected, rel=1e-7)


def test_plan_length_of_one_axis_is_the_way_between_its_turns():
    cubic = cp.PolySpline([Waypoint(t, t**3 - t) for t in (-1.5, -0.6, 0.7, 2.0)])
    turn = 2 / (3 * sqrt(3))  # height of the turns at -+1/sqrt 3
    assert plan_length(cubic) == pytest.approx((turn + 1.875) + 2 * turn + (turn + 6.0), rel=1e-7)


@pytest.mark.parametrize(
    ("nu", "peak"), [(0, 1.0), (1, 15 / 8), (2, 10 / sqrt(3)), (3, 60.0), (4, 360.0), (5, 720.0), (6, 0.0)]
)
def test_peaks_of_the_minimum_jerk_move(nu, peak):
    assert PeakDerivative(nu)(MOVE) == pytest.approx(peak, rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("nu", range(6))
def test_peaks_of_quintic_segments_by_their_roots(nu):
    peak = 0.0
    for axis in range(2):
        pieces = PPoly(quintics().c[:, :, axis], quintics().x)
        pieces = pieces.derivative(nu) if nu else pieces
        for segment, (a, b) in enumerate(pairwise(TIMES)):
            values = np.poly1d(pieces.c[:, segment])
            roots = [r.real for r in values.deriv().roots if abs(r.imag) < 1e-9 and 0 < r.real < b - a]
            peak = max(peak, *(abs(values(s)) for s in [0.0, b - a, *roots]))
    assert PeakDerivative(nu)(cp.PiecewiseSpline(POINTS)) == pytest.approx(peak, rel=1e-9)


@pytest.mark.parametrize("nu", [1, 2, 3, 4])
@pytest.mark.parametrize("name", ["polynomial", "trigonometric", "three axes"])
def test_peaks_are_those_of_dense_samples(name, nu):
    plan = PLANS[name]
    dense = np.abs(plan.jet(np.linspace(plan.start, plan.end, 100_001), nu)[nu]).max()
    peak = PeakDerivative(nu)(plan)
    assert dense * (1 - 1e-12) <= peak <= dense * (1 + 1e-6)


@pytest.mark.parametrize(("nu", "cost"), [(1, 10 / 7), (2, 120 / 7), (3, 720.0), (4, 43200.0), (5, 720.0**2)])
def test_costs_of_the_minimum_jerk_move(nu, cost):
    assert SquaredDerivative(nu)(MOVE) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("nu", [0, 1, 2, 3, 4])
def test_costs_of_quintic_segments_are_exact(nu):
    expected = 0.0
    for axis in range(2):
        pieces = PPoly(quintics().c[:, :, axis], quintics().x)
        pieces = pieces.derivative(nu) if nu else pieces
        for segment, length in enumerate(np.diff(TIMES)):
            squared = np.poly1d(pieces.c[:, segment]) ** 2
            expected += squared.integ()(length)
    assert SquaredDerivative(nu)(cp.PiecewiseSpline(POINTS)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("nu", [1, 3, 4])
@pytest.mark.parametrize("name", ["trigonometric", "piecewise trigonometric", "three axes"])
def test_costs_are_integrals(name, nu):
    plan = PLANS[name]
    expected = integral(plan, lambda t: float(np.square(plan.jet(t, nu)[nu]).sum()))
    assert SquaredDerivative(nu)(plan) == pytest.approx(expected, rel=1e-10)


def test_excess_length_is_relative_to_the_polyline():
    plan = PLANS["trigonometric"]
    polyline = sum(np.linalg.norm(b - a) for a, b in zip(JETS[:, 0], JETS[1:, 0], strict=False))
    path = integral(plan, lambda t: float(np.linalg.norm(plan.jet(t, 1)[1])))
    assert plan_excess_length(plan) == pytest.approx(path / polyline - 1, rel=1e-7)


def test_a_straight_move_has_no_excess_length():
    assert plan_excess_length(cp.PolySpline([Waypoint(0, [0, 3], 0, 0), Waypoint(2, [3, -1], 0, 0)])) == pytest.approx(
        0.0, abs=1e-14
    )


def test_excess_length_is_undefined_without_a_polyline():
    still = cp.PolySpline([Waypoint(0, 1, 0), Waypoint(1, 1, 0)])
    assert np.isnan(plan_excess_length(still))
    assert np.isnan(
        plan_excess_length(cp.TrigSpline([Waypoint(0, 1, 0), Waypoint(0.7, None, 2), Waypoint(2, 3, 0)], alpha=1.0))
    )


@pytest.mark.parametrize("objective", [plan_length, PeakDerivative(1), SquaredDerivative(3)])
def test_a_step_has_no_path(objective):
    assert objective(cp.Step(2.0)) == 0.0


@pytest.mark.parametrize("kind", [PeakDerivative, SquaredDerivative])
@pytest.mark.parametrize(
    ("nu", "error", "message"),
    [
        (-1, ValueError, "nu must be an integer of at least 0, got -1"),
        (1.5, ValueError, "nu must be an integer of at least 0, got 1.5"),
        (101, ValueError, "nu must be at most 100, got 101"),
        ("2", TypeError, "nu must be an integer of at least 0, got '2'"),
        (True, TypeError, "nu must be an integer of at least 0, got True"),
    ],
)
def test_orders_that_are_no_orders(kind, nu, error, message):
    with pytest.raises(error, match=message):
        kind(nu)


factors = st.floats(1e-3, 1e3)


@examples(15)
@given(
    factor=factors, duration=factors, shift=st.floats(-1e3, 1e3), name=st.sampled_from(["trigonometric", "piecewise"])
)
def test_scales_of_amplitude_and_time(factor, duration, shift, name):
    plan = PLANS[name]
    other = (factor * plan).retime(duration).shift(shift)
    rate = plan.duration / duration
    assert plan_length(other) == pytest.approx(factor * plan_length(plan), rel=1e-8)
    for nu in (1, 3):
        # The times of a plan that starts late have the rounding of that start.
        slack = 1e-9 + 1e-13 * abs(shift) / duration
        assert PeakDerivative(nu)(other) == pytest.approx(factor * rate**nu * PeakDerivative(nu)(plan), rel=slack)
        expected = factor**2 * rate ** (2 * nu - 1) * SquaredDerivative(nu)(plan)
        assert SquaredDerivative(nu)(other) == pytest.approx(expected, rel=slack)


@examples(15)
@given(angle=st.floats(-pi, pi))
def test_a_turned_path_is_as_long(angle):
    turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]])
    turned = cp.TrigSpline(
        [Waypoint(t, *(jet @ turn.T)) for t, jet in zip(TIMES, JETS, strict=True)], alpha=4.0, warn=False
    )
    assert plan_length(turned) == pytest.approx(plan_length(PLANS["trigonometric"]), rel=1e-8)
    assert plan_excess_length(turned) == pytest.approx(plan_excess_length(PLANS["trigonometric"]), rel=1e-8)
    assert SquaredDerivative(3)(turned) == pytest.approx(SquaredDerivative(3)(PLANS["trigonometric"]), rel=1e-10)


def test_the_names_of_objectives_are_their_type():
    assert set(get_args(ObjectiveName)) == set(OBJECTIVES)


@pytest.mark.slow
def test_an_objective_of_a_users_own_may_declare_its_size():
    """Excess of a fraction: what ties is a part of 1, not of a minimum that is nearly 0."""

    @of_size(1.0)
    def excess(plan):
        return OBJECTIVES["wandering"](plan)

    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    own, known = (cp.choose_alpha(points, objective) for objective in (excess, "wandering"))
    assert (own.alpha, own.tied, own.blow_up) == (known.alpha, known.tied, known.blow_up)
    assert own.tied
    assert declared_size(excess) == 1.0
    assert declared_size(OBJECTIVES["path"]) is None
