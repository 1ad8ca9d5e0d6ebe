"""Peaks of the excess over limits, next to dense samples."""

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.planning.limits import Limited
from ctrlplan.planning.peaks import excess_at_peaks
from ctrlplan.studies.crane import CRANE, nominal_waypoints, obstacle_waypoints

PLANS = {
    "polynomial": cp.PolySpline(nominal_waypoints(5)).retime(5.5),
    "piecewise": cp.PiecewiseSpline(obstacle_waypoints(), warn=False).retime(20.0),
}


@pytest.mark.parametrize("name", PLANS)
@pytest.mark.parametrize("factor", [1.0, 1.0 + 1e-4, 0.999])
def test_the_highest_peak_of_a_plan_next_to_dense_samples(name, factor):
    plan, limits = PLANS[name], {"acceleration": 1.0, "theta": (-0.1, 0.3)}
    found = excess_at_peaks(plan, Limited(plan, limits, CRANE))(factor)
    moved = plan.retime(factor * plan.duration)
    jet = moved.jet(np.linspace(moved.start, moved.end, 200_001), 4)
    theta = CRANE.quantities(jet)["theta"]
    samples = max(np.abs(jet[2]).max() - 1.0, (theta.max() - 0.3) / 0.2, (-0.1 - theta.min()) / 0.2)
    # The time of a peak moves with the duration, and its value by the square of that.
    assert found == pytest.approx(samples, abs=1e-8 + 10.0 * (factor - 1.0) ** 2)


def test_a_peak_at_a_breakpoint():
    """An acceleration that jumps from -1 m/s^2 to 2 m/s^2."""
    line = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, -1), cp.Waypoint(2, 0, 0, 0)]
    plan = cp.PolySpline(line[:2], warn=False).then(cp.PolySpline([cp.Waypoint(1, 1, 0, 2), line[2]], warn=False))
    limited = Limited(plan, {"acceleration": 8.0})
    t = np.linspace(0, 2, 400_001)
    assert excess_at_peaks(plan, limited)(1.0) == pytest.approx(np.abs(plan(t, 2)).max() / 8.0 - 1.0, abs=1e-8)
    first = cp.SCurve(1.0, velocity=1.0, acceleration=1.0, jerk=2.0)
    limited = Limited(first, {"jerk": 4.0})
    assert excess_at_peaks(first, limited)(1.0) == pytest.approx(-0.5, abs=1e-12)
