"""Limits of a vehicle along a path with stops: margins and minimum duration against closed forms."""

import control.flatsys as fs
import matplotlib.pyplot as plt
import numpy as np
import pytest
from parking import BACKWARD, FORWARD, by_hand, curve, expected, law, parking
from repetitions import one_in

import ctrlplan as cp

PLAN = parking()
DENSE = np.linspace(PLAN.start, PLAN.end, 4001)
FLAT = by_hand()
STRAIGHT = cp.PathPlan(
    [curve((0, [0, 12], [0, 0]), (1, [12, 12], [0, 0])), curve((0, [12, -6], [0, 0]), (1, [6, -6], [0, 0]))],
    [1, -1],
    law(10.0),
)
BENT = cp.PathPlan(
    [FORWARD, curve((0.0, [6, -5, 0, 0], [2, -5, 10, 0]), (1.0, [2, 0, 0, 0], [-4, -9, 0, 0]))], [1, -1], law(5.0)
)


def theirs():
    """The same car as a flat system of python-control, whose maps take one flag at a time."""
    names = {"states": FLAT.state_labels, "inputs": FLAT.input_labels, "outputs": 3}
    return fs.FlatSystem(FLAT.forward, FLAT.reverse, FLAT.updfcn, None, **names)


def peak(name):
    """Peak magnitude on a grid."""
    theta, speed, delta, rate = expected(PLAN, DENSE)
    j = PLAN.jet(DENSE, 2)
    change = j[1, 0] * j[2, 0] + j[1, 1] * j[2, 1]
    moving = np.abs(speed) > 1e-3
    rows = {
        "th": theta,
        "v": speed,
        "delta": delta,
        "rate of delta": rate,
        "rate of v": change[moving] / speed[moving],
        "rate of th": speed * np.tan(delta) / 3.0,
        "x_d2": j[2, 0],
    }
    return float(np.abs(rows[name]).max())


LIMITS = {
    "th": 2.0,
    "v": cp.Limits(-4.0, 4.0, rate=4.0),
    "delta": cp.Limits(-1.0, 1.0, rate=2.0),
    "acceleration": 5.0,
}


@pytest.mark.parametrize("flat", one_in(2, [FLAT, theirs()]), ids=lambda flat: type(flat).__module__)
def test_margins_over_the_whole_path(flat):
    found = {row.bound.name: row for row in cp.margins(PLAN, LIMITS | {"th": cp.Limits(-2.0, 2.0, rate=5.0)}, flat)}
    for name in ("th", "v", "delta", "rate of delta", "rate of v", "rate of th", "x_d2"):
        assert abs(found[name].value) == pytest.approx(peak(name), rel=1e-5)
        assert abs(found[name].value) >= peak(name) * (1.0 - 1e-9)


@pytest.mark.slow
def test_the_same_margins_from_equations():
    pytest.importorskip("casadi")
    from flat_plants import car, car_rate

    own = {row.bound.name: row.value for row in cp.margins(PLAN, LIMITS, FLAT)}
    renamed = {"theta" if name == "th" else name: limit for name, limit in LIMITS.items()}
    for row in cp.margins(PLAN, renamed, cp.plants.KinematicCar(wheelbase=3.0)):
        assert row.value == pytest.approx(own[row.bound.name.replace("theta", "th")], rel=1e-8, abs=1e-9)
    for plant, limits in ((car, LIMITS), (car_rate, LIMITS | {"delta": 1.0, "rate": 2.0})):
        flat = cp.flat_system(plant, ["x", "y"], at={"v": 1.0})
        for row in cp.margins(PLAN, limits, flat):
            known = "rate of delta" if row.bound.name == "rate" else row.bound.name
            assert row.value == pytest.approx(own[known], rel=1e-8, abs=1e-9)


@pytest.mark.slow
def test_with_fixed_shape_the_duration_is_that_of_the_powers_of_time():
    """Of degree 1 in the pace: speed and steering rate; of degree 2: acceleration."""
    limits = {"v": cp.Limits(-2.0, 2.0, rate=0.4), "delta": cp.Limits(-1.0, 1.0, rate=0.3)}
    found = cp.fastest(PLAN, limits, FLAT)
    assert isinstance(found.plan, cp.PathPlan)
    wanted = max(peak("v") / 2.0, peak("rate of delta") / 0.3, np.sqrt(peak("rate of v") / 0.4))
    assert found.duration == pytest.approx(PLAN.duration * wanted, rel=1e-5)
    assert found.margins.satisfied


@pytest.mark.parametrize(
    ("limits", "system"),
    [({"velocity": 2.0, "acceleration": 1.0}, None), ({"v": cp.Limits(-2.0, 2.0, rate=1.0)}, FLAT)],
    ids=["axes", "car"],
)
def test_each_segment_has_the_fastest_time_law(limits, system):
    """On a straight line: a trapezoid of the speed, of duration L/V + V/A."""
    found = cp.fastest(STRAIGHT.shift(3.0), limits, system, hold="path")
    assert isinstance(found.plan, cp.PathPlan)
    assert found.plan.start == 3.0
    best = np.array([12.0 / 2.0 + 2.0, 6.0 / 2.0 + 2.0])
    got = np.diff(found.plan.stops)
    assert (got >= best * (1.0 - 1e-9)).all()
    assert (got <= best * 1.001).all()
    t = np.linspace(3.0, found.plan.end, 2001)
    assert np.abs(expected(found.plan, t)[1]).max() <= 2.0 * (1.0 + 1e-9)
    assert np.abs(found.plan(t, 2)).max() <= 1.0 + 1e-9
    assert found.margins.satisfied
    assert "fixed path" in repr(found)


def duration_at(fastest):
    """Duration with the fastest possible rate at each point of the path, by a fine sum: without accelerations."""
    total = 0.0
    for segment, direction in zip(PLAN.segments, PLAN.directions, strict=True):
        unit = cp.PathPlan([segment], [direction], law(1.0))
        # Without the ends, where the curve has no direction and next to nothing is left out.
        t = (np.arange(20, 19980) + 0.5) / 20000
        _, speed, delta, rate = expected(unit, t)
        ds = unit.laws[0](t, 1)
        total += np.sum(ds / fastest(direction, speed / ds, delta, rate / ds)) / 20000
    return total


REGION = cp.Region(("v", "delta"), [(2, 0), (0.5, 0.9), (-0.5, 0.9), (-2, 0), (-0.5, -0.9), (0.5, -0.9)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "fastest"),
    [
        (
            {"v": (-1.0, 2.0), "delta": cp.Limits(-0.9, 0.9, rate=0.5)},
            lambda way, v, delta, rate: np.minimum((2.0 if way > 0 else 1.0) / abs(v), 0.5 / np.abs(rate)),
        ),
        pytest.param(
            {"narrow": REGION},
            lambda way, v, delta, rate: (2.0 - 1.5 * np.abs(delta) / 0.9) / np.abs(v),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["speed, steering angle and steering rate", "region"],
)
def test_without_limits_of_accelerations_a_limit_is_active_everywhere(limits, fastest):
    """Cells are refined until signals are within 0.5 % of a limit, as a mean over time."""
    found = cp.fastest(PLAN, limits, FLAT, hold="path")
    best = duration_at(fastest)
    assert best * (1.0 - 1e-6) <= found.duration <= 1.005 * best
    assert found.margins.satisfied


@pytest.mark.slow
def test_the_fastest_parking_manoeuvre():
    """Satisfies all limits on a grid, and is faster than that of fixed shape; different speeds forward and backward."""
    limits = {"v": cp.Limits(-1.0, 2.0, rate=1.0), "delta": cp.Limits(-0.9, 0.9, rate=0.5)}
    found, shape = (cp.fastest(PLAN, limits, FLAT, hold=hold) for hold in ("path", "shape"))
    assert found.duration < 0.6 * shape.duration
    t = np.linspace(0.0, found.duration, 4001)
    _, speed, delta, rate = expected(found.plan, t)
    assert speed.max() <= 2.0 * (1.0 + 1e-9)
    assert speed.min() >= -1.0 * (1.0 + 1e-9)
    assert np.abs(delta).max() <= 0.9
    assert np.abs(rate).max() <= 0.5 * (1.0 + 1e-9)
    drawn = found.plot()
    assert drawn.axes.shape == (4, 1)
    plt.close(drawn.figure)


@pytest.mark.slow
def test_durations_that_are_given():
    limits = {"velocity": 2.0, "acceleration": 1.0}
    longer = cp.fastest(STRAIGHT, limits, hold="path", durations=(20.0, 30.0))
    given = cp.fastest(STRAIGHT, limits, hold="path", ends="given")  # at rest
    assert given.duration == cp.fastest(STRAIGHT, limits, hold="path").duration
    assert longer.duration == pytest.approx(20.0)
    assert longer.feasible == ((longer.duration, 30.0),)
    with pytest.raises(ValueError, match=r"for some duration from 5 to 12 s, got a minimum of 13\.00"):
        cp.fastest(STRAIGHT, limits, hold="path", durations=(5.0, 12.0))
    with pytest.raises(ValueError, match="limits must include one that a shorter plan would violate, got none"):
        cp.fastest(PLAN, {"delta": 1.0}, FLAT, hold="path")


@pytest.mark.slow
def test_limits_that_are_not_convex_have_a_smooth_time_law():
    """A jerk: not the fastest law, but one that satisfies all limits; shorter than the plan of fixed shape."""
    limits = {"v": 2.0, "jerk": 2.0}
    found, shape = (cp.fastest(STRAIGHT, limits, FLAT, hold=hold) for hold in ("path", "shape"))
    assert isinstance(found.plan, cp.PathPlan)
    assert found.margins.satisfied
    assert found.duration < 0.99 * shape.duration


def test_a_curve_that_is_too_narrow_is_named_at_its_place():
    assert peak("delta") == pytest.approx(0.871, abs=1e-3)
    with pytest.raises(ValueError, match=r"at any duration, got delta = -0\.87\d* at rest at x = 2\.\d+, y = -1\.1"):
        cp.fastest(PLAN, {"v": 2.0, "delta": 0.6}, FLAT, hold="path")
    assert not cp.margins(PLAN, {"delta": 0.6}, FLAT).satisfied


def test_a_steering_angle_that_jumps_has_no_rate():
    assert cp.margins(BENT, {"delta": 1.2}, FLAT).satisfied
    for call in (cp.margins, cp.fastest):
        with pytest.raises(
            ValueError, match=r"rate of delta require .* continuous, got \S+ before and 0\.4\S* after 5 s"
        ):
            call(BENT, {"delta": cp.Limits(-1.2, 1.2, rate=1.0)}, FLAT)


def test_what_is_no_vehicle_and_what_is_no_path():
    load = cp.PathPlan([FORWARD, BACKWARD], [1, -1], law(5.0), labels=["x", "z"])
    with pytest.raises(ValueError, match="its states at the stops, at 0 s, 5 s, 10 s"):
        cp.margins(load, {"F": 1e4}, cp.plants.Crane().flat_system())
    with pytest.raises(TypeError, match='hold="waypoints", got a PathPlan'):
        cp.fastest(PLAN, {"v": 2.0}, FLAT, hold="waypoints")
    with pytest.raises(ValueError, match=r"delta must be determined by the plan, got nan .*give a PathPlan"):
        cp.margins(
            cp.PolySpline([cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(4, [4, 3], 0, 0)]), {"delta": 1.0}, theirs()
        )
    with pytest.raises(ValueError, match=r"limits must name derivatives of an axis .*quantities .*delta.*got 'speed'"):
        cp.margins(PLAN, {"speed": 1.0}, FLAT)


@pytest.mark.slow
def test_limits_of_derivatives_need_no_vehicle():
    for system in (None, lambda jet: {"kinetic": jet[1, 0] ** 2 + jet[1, 1] ** 2}):
        limits = {"velocity": 1.0} | ({} if system is None else {"kinetic": (None, 1.5)})
        found = cp.fastest(PLAN, limits, system)
        size = np.abs(PLAN(DENSE, 1)).max()
        wanted = max(size, 0.0 if system is None else np.hypot(*PLAN(DENSE, 1)).max() / np.sqrt(1.5))
        assert found.duration == pytest.approx(PLAN.duration * wanted, rel=1e-5)
        assert isinstance(found.plan, cp.PathPlan)
        faster = cp.fastest(PLAN, limits, system, hold="path")
        assert faster.margins.satisfied
        assert faster.duration < found.duration


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"v": (0.0, 1.0)}, r"got v from 0 to 1, which allows no motion backward at x = 12, y = 0$"),
        ({"v": cp.Limits(high=0.0), "th": 1.0}, r"got v at most 0, which allows no motion forward at x = "),
    ],
)
def test_a_limit_that_forbids_a_direction_of_travel_is_named(limits, message):
    """From 0 forward to 12, and back to 6."""
    with pytest.raises(ValueError, match=r"^limits must allow the plan to move along its path, " + message):
        cp.fastest(STRAIGHT, limits, FLAT, hold="path")
