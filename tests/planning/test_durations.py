"""Plans as a function of their duration, against plans that are built for each duration, and the search among them."""

import numpy as np
import pytest
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan.planning.durations import PlansByDuration, ReplannedPlans, replanned
from ctrlplan.planning.fastest import _narrowed
from ctrlplan.planning.limits import Limited

RNG = np.random.default_rng(0)
TIMES = [-1.0, 0.5, 1.0, 3.0]
FREE = [
    cp.Waypoint(t, position, *([[0.3, -0.2], [0.1, 0.0]] if i in (0, 3) else []))
    for i, (t, position) in enumerate(zip(TIMES, RNG.normal(size=(4, 2)), strict=True))
]
GIVEN = [cp.Waypoint(t, *jet) for t, jet in zip(TIMES, RNG.normal(size=(4, 3, 2)), strict=True)]
UNEVEN = [
    cp.Waypoint.from_jets(0.0, x=[0.0, 1.0, 0.0], z=[1.0, 0.0]),
    cp.Waypoint.from_jets(1.0, x=[2.0], z=[-1.0, 0.5, 0.0]),
    cp.Waypoint.from_jets(2.5, x=[1.0, 0.0, 0.0], z=[3.0, 0.0]),
]
CLOSED = [cp.Waypoint(0, 0, 1), cp.Waypoint(1, 1), cp.Waypoint(3, 0, 1)]
PLANS = {
    "polynomial": cp.PolySpline(FREE, warn=False),
    "trigonometric": cp.TrigSpline(UNEVEN, alpha=2.0, warn=False),
    "spare harmonics": cp.TrigSpline(UNEVEN, alpha=1.0, degree=7, warn=False),
    "nearly closed": cp.TrigSpline(
        [cp.Waypoint(0, 0, 1), cp.Waypoint(1, 1), cp.Waypoint(3, 0, 1)], alpha=6.0, warn=False
    ),
    "closed": cp.TrigSpline.cyclic(GIVEN, 6.0, warn=False),
    "free entries": cp.PiecewiseSpline(FREE, warn=False),
    "all given": cp.PiecewiseSpline(GIVEN, alpha=1.0, warn=False),
    "uneven": cp.PiecewiseSpline(UNEVEN, warn=False),
    "closed pieces": cp.PiecewiseSpline.cyclic(GIVEN[:3], 4.5, warn=False),
}


def force(jet):
    """Nonlinear in the jet, and infeasible where the first axis accelerates by more than 40."""
    if (jet[2, 0] > 40.0).any():
        raise ValueError("infeasible")
    return {"f": jet[2, 0] * np.cos(jet[0, 0]) + 0.1 * jet[1, 0] ** 2}


@pytest.mark.parametrize("name", PLANS)
def test_replanned_plans_are_sums_of_parts(name):
    plan = PLANS[name]
    for limits, system in (
        ({"velocity": 2.0, "acceleration": (-3.0, 4.0)}, None),
        ({"f": 2.0, f"{plan.labels[0]}_d1": cp.Limits(rms=1.0)}, force),
        ({f"{plan.labels[0]}_d1": cp.Limits(high=1.0, during=(plan.start, plan.start + 1.017))}, None),
    ):
        limited = Limited(plan, limits, system)
        family, durations = ReplannedPlans(plan, limited), plan.duration * np.geomspace(0.02, 50.0, 13)
        wanted = [limited.excess(limited.sampled(replanned(plan.quiet(), d))) for d in durations.tolist()]
        np.testing.assert_allclose(family.excesses(durations), wanted, rtol=1e-9, atol=1e-11)
        np.testing.assert_array_equal([family.excess(d) for d in durations.tolist()], family.excesses(durations))


@pytest.mark.parametrize("name", PLANS)
def test_plans_of_one_shape(name):
    plan = PLANS[name]
    limited = Limited(plan, {"velocity": 2.0, "f": 2.0}, force)
    family, durations = PlansByDuration(plan, limited), plan.duration * np.geomspace(0.02, 50.0, 13)
    wanted = [limited.excess(limited.sampled(plan.quiet().retime(d))) for d in durations.tolist()]
    np.testing.assert_allclose(family.excesses(durations), wanted, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_a_shortest_duration_is_where_the_peak_meets_the_limit(alpha):
    """Against a root of the peak itself, of plans built one after the other."""
    points = [cp.Waypoint(0, 0, 0.4, 0), cp.Waypoint(1, 2), cp.Waypoint(3, 1, 0.2, 0)]
    plan = cp.TrigSpline(points, alpha=alpha, warn=False)
    found = cp.fastest(plan, {"acceleration": 2.0}, hold="waypoints")

    def excess(duration):
        moved = [cp.Waypoint(duration * w.time / 3.0, *w.jet) for w in points]
        return float(cp.TrigSpline(moved, alpha=alpha, warn=False).peak(2)[0]) - 2.0

    low, high = found.duration * (1 - 1e-3), found.duration * (1 + 1e-3)
    assert found.duration == pytest.approx(brentq(excess, low, high, xtol=1e-15), rel=1e-12)
    assert found.margins.satisfied
    assert found.margins.active.fraction <= 1e-12


def test_the_search_goes_on_while_the_violation_falls():
    """20 in 1 s and 0.2: 187.5 s; a limit that is a million times as low."""
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 20, 0, 0)])
    for limit in (0.2, 2e-7):
        found = cp.fastest(move, {"velocity": limit}, hold="waypoints")
        assert found.duration == pytest.approx(20 * 1.875 / limit, rel=1e-12)
        assert found.searched[0] <= found.duration <= found.searched[1]


def test_the_search_ends_where_the_violation_does_not_fall():
    move = cp.PolySpline([cp.Waypoint(0, 0, 1.0, 0), cp.Waypoint(1, 20, 0, 0)])
    with pytest.raises(ValueError, match=r"got y_d1 = 1 of the waypoint at 0 s, where it must be within ±0.2"):
        cp.fastest(move, {"velocity": 0.2}, hold="waypoints")
    still = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 20, 0, 0)])
    with pytest.raises(ValueError, match="for a wider search pass durations"):
        cp.fastest(still, {"velocity": 0.2}, hold="waypoints", durations=(1.0, 64.0))


@pytest.mark.parametrize(
    ("function", "ends", "root"),
    [
        (lambda t: 2.0 - t**2, (1.0, 2.0), np.sqrt(2.0)),
        (lambda t: t**3 - 5.0, (1.0, 2.0), 5.0 ** (1.0 / 3.0)),
        (lambda t: np.where(t < 1.3, 1.0, -1e-9), (1.0, 2.0), 1.3),  # a jump
        (lambda t: np.where(t < 1.7, np.inf, 1.8 - t), (1.0, 2.0), 1.8),
        (lambda t: np.where(t < 1.7, 1.8 - t, -np.inf), (1.0, 2.0), 1.7),
        (lambda t: np.cbrt(1.1 - t), (1.0, 2.0), 1.1),  # an infinite slope
        (lambda t: (1.25 - t) ** 9, (1.0, 2.0), 1.25),
    ],
)
def test_a_change_of_sign_is_narrowed_to_rounding(function, ends, root):
    found = _narrowed(function, np.array(ends), function(np.array(ends)))
    assert function(np.array([found]))[0] <= 0.0
    # Where the function is 0 by rounding, every point is a root.
    assert found == pytest.approx(root, rel=2e-15, abs=0.0) or function(np.array([found]))[0] == 0.0


@pytest.mark.parametrize("hold", ["shape", "waypoints"])
def test_the_peak_of_the_excess_is_that_between_samples(hold):
    family = ReplannedPlans if hold == "waypoints" else PlansByDuration
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    found = family(move, Limited(move, {"y_d2": 3.0})).peak(2.0)
    # The acceleration of the quintic 10 s^3 - 15 s^4 + 6 s^5 is 60 s - 180 s^2 + 120 s^3.
    assert found is not None
    assert found[0] == 0
    # Both extrema, at 1/2 -+ sqrt(3)/6, have the same magnitude.
    assert min(abs(found[1] - 0.5 + np.sqrt(3) / 6), abs(found[1] - 0.5 - np.sqrt(3) / 6)) < 1e-6


def test_a_limit_over_an_interval_has_no_such_peak():
    move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    assert PlansByDuration(move, Limited(move, {"y_d1": cp.Limits(-1, 1, during=(0.2, 0.5))})).peak(2.0) is None
