"""Points in time with prescribed entries: what may be given, and what is kept of it."""

import copy
import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctrlplan.trajectories import Waypoint

nan = np.nan


def test_one_axis_from_scalars():
    point = Waypoint(1, 2, 3, 4, 5, 6)
    assert point.time == 1.0
    assert point.naxes == 1
    np.testing.assert_array_equal(point.jet, [[2], [3], [4], [5], [6]])
    entries = [point.position, point.velocity, point.acceleration, point.jerk, point.snap]
    np.testing.assert_array_equal(entries, [[2], [3], [4], [5], [6]])
    assert point.complete
    assert point.labels is None


def test_names_of_the_entries():
    point = Waypoint(time=1.0, position=2.0, velocity=3.0, acceleration=4.0, jerk=5.0, snap=6.0)
    assert point == Waypoint(1, 2, 3, 4, 5, 6)


def test_several_axes_and_the_scalar_zero():
    point = Waypoint(6.0, [5.0, 5.0], [1.0, -1.0], 0)
    np.testing.assert_array_equal(point.jet, [[5, 5], [1, -1], [0, 0]])
    np.testing.assert_array_equal(Waypoint(0, 0, [1.0, 2.0, 3.0]).jet, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(Waypoint(0, (1, 2), np.zeros(2), 0.0).jet, [[1, 2], [0, 0], [0, 0]])
    np.testing.assert_array_equal(Waypoint(0, [1.0], 2.0).jet, [[1], [2]])


def test_none_and_nan_leave_an_entry_free():
    point = Waypoint(0, 1.0, None, 2.0)
    np.testing.assert_array_equal(point.jet, [[1], [nan], [2]])
    assert not point.complete
    np.testing.assert_array_equal(Waypoint(0, [1, nan], nan, [nan, 3]).jet, [[1, nan], [nan, nan], [nan, 3]])
    assert Waypoint(0, 1.0, None, None).jet.shape == (1, 1)
    np.testing.assert_array_equal(Waypoint(0, 1.0).velocity, [nan])
    np.testing.assert_array_equal(Waypoint(0, [1.0, 2.0]).snap, [nan, nan])
    np.testing.assert_array_equal(Waypoint(0, None, 1.0).jet, [[nan], [1]])


def test_axis_by_axis():
    point = Waypoint.from_jets(0.5, x=[0.0, 1.0, 2.0], z=[10.0], yaw=[None, 3.0])
    assert point.labels == ("x", "z", "yaw")
    np.testing.assert_array_equal(point.jet, [[0, 10, nan], [1, nan, 3], [2, nan, nan]])
    assert Waypoint.from_jets(0, x=range(9)).jet.shape == (9, 1)
    assert Waypoint.from_jets(0, x=[]).jet.shape == (1, 1)


def test_the_callers_arrays_stay_the_callers():
    position = np.array([1.0, 2.0])
    point = Waypoint(0, position, position)
    position[:] = 9
    np.testing.assert_array_equal(point.jet, [[1, 2], [1, 2]])


def test_nothing_can_be_changed():
    point = Waypoint(0, [1.0, 2.0], [0, 0])
    with pytest.raises(AttributeError, match="Waypoint is immutable"):
        point.time = 3.0
    with pytest.raises(AttributeError, match="Waypoint is immutable"):
        del point.jet
    for array in (point.jet, point.position, point.velocity):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 3.0


def test_huge_numbers_are_numbers():
    """Finite entries whose sum overflows."""
    point = Waypoint(0, 1.7e308, 1.7e308)
    assert point.complete
    np.testing.assert_array_equal(point.jet, [[1.7e308], [1.7e308]])


def test_copies():
    for point in (Waypoint(1 / 3, [1, nan], 0), Waypoint.from_jets(0, x=[1], z=[2, 3])):
        for again in (copy.copy(point), copy.deepcopy(point), pickle.loads(pickle.dumps(point))):
            assert again == point
            assert hash(again) == hash(point)
            assert not again.jet.flags.writeable


def test_equality_and_hash():
    assert Waypoint(0, [1, nan]) == Waypoint(0.0, [1.0, None])
    assert Waypoint(0, 1) != Waypoint(0, 2)
    assert Waypoint(0, 1) != Waypoint(1, 1)
    assert Waypoint(0, 1) != Waypoint(0, 1, 0)
    assert Waypoint.from_jets(0, x=[1]) != Waypoint(0, 1)
    assert Waypoint(0, 1) != "waypoint"
    assert len({Waypoint(0, 1), Waypoint(0, 1), Waypoint(0, 2)}) == 2
    negative = Waypoint(-0.0, -0.0)
    assert negative == Waypoint(0.0, 0.0)
    assert hash(negative) == hash(Waypoint(0.0, 0.0))


@pytest.mark.parametrize(
    "point", [Waypoint(1 / 3, 2.0, nan, 1e-300), Waypoint(0, [1, nan], 0), Waypoint.from_jets(-1, x=[1, 2], z=[1 / 7])]
)
def test_repr_makes_an_equal_one(point):
    assert eval(repr(point), {"Waypoint": Waypoint, "nan": nan}) == point


number = st.floats(allow_nan=False, allow_infinity=False, width=64)


@given(st.lists(st.lists(number, min_size=2, max_size=2), min_size=1, max_size=5), number)
def test_plain_data_restores_every_bit(rows, time):
    point = Waypoint(time, *rows)
    again = Waypoint.from_dict(json.loads(json.dumps(point.to_dict(), allow_nan=False)))
    assert again.jet.tobytes() == point.jet.tobytes()
    assert (again.time, again.labels) == (time, None)


def test_plain_data_of_free_entries_and_names():
    point = Waypoint.from_jets(1 / 3, x=[None, 1.0], z=[2.0])
    data = point.to_dict()
    assert data == {"time": 1 / 3, "jet": [[None, 2.0], [1.0, None]], "labels": ["x", "z"]}
    assert Waypoint.from_dict(data) == point


@given(st.floats(0.1, 10.0), number)
def test_scaled_is_the_same_point_passed_faster(rate, time):
    point = Waypoint(0, [1.0, -2.0], [3.0, nan], [0.5, 1.0])
    scaled = point.scaled(time, rate)
    assert scaled.time == time
    np.testing.assert_allclose(scaled.jet, point.jet * rate ** np.arange(3)[:, None], rtol=1e-15)


def test_waypoints_are_equal_if_they_prescribe_the_same():
    short, long = Waypoint(1.0, [2.0, 3.0]), Waypoint(1.0, [2.0, 3.0], [np.nan, np.nan], [np.nan, np.nan])
    assert short == long
    assert len({short, long}) == 1
    assert short.to_dict() == long.to_dict()
    assert short != Waypoint(1.0, [2.0, 3.0], [np.nan, np.nan], [np.nan, 0.0])
    assert short != Waypoint(1.0, [2.0, np.nan])
    free = Waypoint(1.0, np.nan, np.nan)
    assert free == Waypoint.from_dict(free.to_dict()) == Waypoint(1.0, np.nan)


def test_a_waypoint_is_constructed_once():
    point = Waypoint(1.0, [2.0, 3.0], [0.0, 1.0])
    with pytest.raises(AttributeError, match="immutable"):
        point.__init__(5.0, [7.0, 7.0])
    assert point == Waypoint(1.0, [2.0, 3.0], [0.0, 1.0])
