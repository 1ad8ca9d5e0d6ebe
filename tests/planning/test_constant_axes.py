"""Plans with axes that are constant or linear up to rounding: derivatives that are rounding are no jumps."""

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import ctrlplan as cp

LIMITS = {"velocity": 1.0, "acceleration": 1.0}
TIMES = np.linspace(0.0, 9.0, 61)
WAVE = np.sin(1.1 * TIMES) + 0.3 * TIMES


def fitted(rows):
    return cp.fit(TIMES, rows)


def loosely_fitted(rows):
    return cp.fit(TIMES, rows, tolerance=1e-5)


def converted(rows):
    return cp.as_trajectory(make_interp_spline(TIMES, np.transpose(rows), k=5))


def crane_move():
    """Fit of a move of a crane at constant height, with four continuous derivatives."""
    x = np.linspace(0.0, 1.0, 241)
    return cp.fit(
        12.0 * x, [17.0 * x**5 * (126 + x * (-420 + x * (540 + x * (-315 + 70 * x)))), 0 * x + 6.3], continuity=4
    )


@pytest.mark.parametrize("constant", [0.2, -73.0, 4e4])
@pytest.mark.parametrize("made", [fitted, loosely_fitted, converted])
def test_a_constant_axis_makes_no_stops(made, constant):
    """The optimum is that of the axis that moves alone, up to the grid of the time law; a stop costs a second."""
    alone = cp.fastest(made([WAVE]), LIMITS, hold="path")
    found = cp.fastest(made([WAVE, np.full(TIMES.size, constant)]), LIMITS, hold="path")
    assert found.stops == alone.stops
    assert found.plan.duration == pytest.approx(alone.plan.duration, rel=5e-4)


def test_a_corner_of_two_axes_is_still_a_stop():
    corner = cp.PiecewiseSpline(
        [cp.Waypoint(0.0, [0.0, 0.0]), cp.Waypoint(1.0, [1.0, 1e-4]), cp.Waypoint(2.0, [2.0, 0.0])]
    )
    assert cp.fastest(corner, LIMITS, hold="path").stops == (1.0,)


@pytest.mark.parametrize("hold", ["path", "shape"])
def test_a_fit_at_constant_height_has_limits_up_to_the_jerk(hold):
    plan = crane_move()
    assert [j for j in plan.jumps(4) if plan.start < j.time < plan.end or j.label == "y2"] == []
    shortest = cp.fastest(plan.select(["y1"]), LIMITS, hold=hold).plan.duration
    assert cp.fastest(plan, LIMITS, hold=hold).plan.duration == pytest.approx(shortest, rel=5e-4)


def test_margins_and_export_of_a_fit_at_constant_height(tmp_path):
    plan = crane_move()
    assert len(list(cp.margins(plan, {"velocity": 5.0, "y2_d2": 1.0}))) == 3
    (path,) = plan.export(tmp_path / "move.cam.csv")
    assert path.stat().st_size > 0


def test_margin_of_a_line_of_which_the_acceleration_is_rounding():
    plan = cp.fit(TIMES, [np.cos(TIMES), 0.4 + 0.2 * TIMES])
    (margin,) = cp.margins(plan, {"y2_d2": 1.0})
    assert abs(margin.value) < 1e-9


def test_fastest_line_with_a_limit_of_the_jerk():
    """A line is travelled at the limit of the velocity, length/velocity, up to the ends of the time law."""
    plan = cp.fit(TIMES, 0.5 * TIMES)
    found = cp.fastest(plan, {"velocity": 2.0, "jerk": 4.0}, hold="path")
    assert found.stops == ()
    assert 4.5 / 2.0 - 1e-9 <= found.plan.duration <= 4.5 / 2.0 * (1.0 + 1e-3)
