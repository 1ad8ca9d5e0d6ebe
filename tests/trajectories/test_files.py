"""Trajectories as JSON and CSV: numbers to the last bit, and what is not a trajectory is rejected in one line."""

import errno
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from trajectory_oracle import waypoints

from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    Step,
    TrigSpline,
    Waypoint,
    derivative_name,
    load_trajectory,
    stack,
    trajectory_from_dict,
)

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

number = st.floats(-1e6, 1e6, allow_nan=False)
MOVE = PolySpline(waypoints([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def through_json(plan):
    return trajectory_from_dict(json.loads(json.dumps(plan.to_dict(), allow_nan=False)))


def assert_same_bits(plan, again):
    t = np.concatenate([np.linspace(plan.start - 1, plan.end + 1, 101), plan.breakpoints])
    np.testing.assert_array_equal(again.jet(t, 4), plan.jet(t, 4))
    assert again.labels == plan.labels
    assert again.to_dict() == plan.to_dict()


@examples(60)
@given(
    st.lists(st.tuples(st.floats(1e-3, 10), st.lists(number, min_size=1, max_size=3)), min_size=2, max_size=5),
    st.floats(0, 6.28),
    st.floats(-1e9, 1e9),
)
def test_every_bit_returns(rows, alpha, start):
    times = start + np.cumsum([gap for gap, _ in rows])
    points = waypoints(times, [jet for _, jet in rows])
    for plan in (TrigSpline(points, alpha=alpha), PolySpline(points), PiecewiseSpline(points, alpha=alpha)):
        assert_same_bits(plan, through_json(plan))


def test_every_option_returns():
    times, jets = [0.0, 1 / 3, 1.0], [[0.1, None, 0.2], [1.0], [0.7, 0.0]]
    points = waypoints(times, jets)
    named = [Waypoint.from_jets(0, x=[0.1, 1.0], z=[1.0, 0.0]), Waypoint.from_jets(1, x=[1 / 3], z=[2.0, 0.0])]
    plans = [
        TrigSpline(points, alpha=2.0, degree=5, smooth=2, labels="height"),
        TrigSpline(waypoints([0.0, 1.0], [[0.0, 1.0], [1.0, 0.0]]), alpha=2.0, gamma=0.1),
        TrigSpline(named, alpha=1.0, gamma=[None, 1 / 7]),
        PolySpline(points, degree=8, smooth=2),
        TrigSpline.cyclic(points, 1.7, gamma=None, degree=4),
        PiecewiseSpline(named, alpha=1 / 3, labels=["a", "b"]),
        Step([1 / 3, 2.0], [0.1, 0.2], 0.7, labels=["x", "z"]),
    ]
    for plan in plans:
        again = through_json(plan)
        assert_same_bits(plan, again)
        assert type(again) is type(plan)
    trig = through_json(plans[2])
    assert trig.alpha == 1.0
    assert trig.gamma == plans[2].gamma
    assert through_json(plans[0]).degree == (5,)


def test_combinations_of_combinations_return():
    wave = TrigSpline(waypoints([0.1, 1.3], [[1.0, 1 / 3], [0.2]]), alpha=2.0)
    plan = stack([(2 / 3) * wave.shift(1e6) + Step(1.0, time=0.2), MOVE.then(MOVE.retime(1 / 3) + Step(1.0, 1.0))])
    assert_same_bits(plan, through_json(plan))
    moved = plan.shift(1 / 3).retime(1e5)
    assert_same_bits(moved, through_json(moved))


def test_the_file_is_json_that_others_can_read(tmp_path):
    path = tmp_path / "plan.json"
    MOVE.save(path)
    data = json.loads(path.read_text(encoding="utf-8"))
    assert data["type"] == "PolySpline"
    assert data["waypoints"][1] == {"time": 1.0, "jet": [[1.0], [0.0], [0.0]], "labels": ["y"]}
    assert path.read_text().endswith("}\n")
    assert_same_bits(MOVE, load_trajectory(str(path)))


def test_csv_columns_and_values(tmp_path):
    points = [Waypoint.from_jets(0, x=[0, 1 / 3], z=[1]), Waypoint.from_jets(2, x=[1], z=[2, 1])]
    plan = TrigSpline(points, alpha=2.0)
    path = tmp_path / "plan.csv"
    plan.to_csv(path)
    assert path.read_text().splitlines()[0] == "time,x,x_d1,x_d2,z,z_d1,z_d2"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert table.shape == (1001, 7)
    t = np.linspace(0, 2, 1001)
    np.testing.assert_array_equal(table[:, 0], t)
    for nu in range(3):
        np.testing.assert_array_equal(table[:, [1 + nu, 4 + nu]].T, plan.jet(t, 2)[nu])
    plan.to_csv(path, [0.5, -1.0, 7.0], order=0)
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table, np.column_stack([[0.5, -1.0, 7.0], plan([0.5, -1.0, 7.0]).T]))
    assert path.read_text().splitlines()[0] == "time,x,z"


def test_names_of_derivatives():
    assert [derivative_name("x", k) for k in range(3)] == ["x", "x_d1", "x_d2"]


GOOD = MOVE.to_dict()
BAD = {
    "unknown family": ({"type": "Bezier"}, r"type must be one of .*PolySpline.*, got 'Bezier'"),
    "no type": ({"waypoints": []}, "type must be one of .*, got None"),
    "a type that is no name": ({"type": ["PolySpline"]}, "type must be one of"),
    "the abstract class": ({"type": "Trajectory"}, "type must be one of"),
    "a class inside": (GOOD | {"type": "NewtonSpline"}, "type must be one of"),
    "another class inside": ({"type": "_Combined", "parts": [GOOD], "labels": ["y"]}, "type must be one of"),
    "a list": ([GOOD], "type must be one of"),
    "an entry missing": ({"type": "PolySpline"}, "a PolySpline must have the entry 'waypoints'"),
    "alpha missing": (GOOD | {"type": "TrigSpline"}, "a TrigSpline must have the entry 'alpha'"),
    "a time missing": (GOOD | {"waypoints": [{"jet": [[1.0]]}] * 2}, "must have the entry 'time'"),
    "alpha out of range": (GOOD | {"type": "TrigSpline", "alpha": 7.0}, r"alpha must lie in \[0, 2 pi\), got 7"),
    "waypoints that are a number": (GOOD | {"waypoints": 5}, "must"),
    "waypoints that are texts": (GOOD | {"waypoints": ["a", "b"]}, "must"),
    "a jet that is a number": (GOOD | {"waypoints": [{"time": 0, "jet": 5}] * 2}, "must"),
    "a jet without entries": (GOOD | {"waypoints": [{"time": 0, "jet": []}] * 2}, "jet must be a table"),
    "a jet of texts": (GOOD | {"waypoints": [{"time": 0, "jet": [["a"]]}] * 2}, "must"),
    "a ragged jet": (GOOD | {"waypoints": [{"time": 0, "jet": [[1, 2], [3]]}] * 2}, "must"),
    "too few waypoints": (GOOD | {"waypoints": GOOD["waypoints"][:1]}, "at least two waypoints, got 1"),
    "waypoints in no order": (GOOD | {"waypoints": GOOD["waypoints"][::-1]}, "times must increase strictly"),
    "parts missing": ({"type": "Sum", "parts": [], "labels": []}, "must|at least one"),
    "a part missing": ({"type": "Scaled", "parts": [], "labels": [], "factor": 1.0}, "must|at least one"),
    "labels that do not fit": (
        {"type": "Sum", "parts": [GOOD], "labels": ["a", "b"]},
        "labels must be one per axis",
    ),
    "labels that are not unique": (
        {"type": "Stacked", "parts": [GOOD, GOOD], "labels": ["a", "a"]},
        "labels must be unique",
    ),
    "parts of other axes": (
        {"type": "Sum", "parts": [GOOD, Step([1.0, 2.0]).to_dict()], "labels": ["a"]},
        "parts must have the same number of axes",
    ),
    "parts that do not join": ({"type": "Joined", "parts": [GOOD, GOOD], "labels": ["a"]}, "must"),
    "a factor that is a text": (
        {"type": "Scaled", "parts": [GOOD], "labels": ["a"], "factor": "x"},
        "factor must be a number",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_not_a_trajectory_is_rejected(name, tmp_path):
    """From plain data as ValueError; from a file with its name in front."""
    data, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        trajectory_from_dict(data)
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=rf"plan\.json must contain a saved trajectory: .*({message})"):
        load_trajectory(path)


@pytest.mark.parametrize("content", [b"", b"{", b"not json", b"\xff\xfe\x00", b"[]", b"null", b"3"])
def test_files_that_hold_something_else(content, tmp_path):
    path = tmp_path / "plan.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="must contain a saved trajectory: "):
        load_trajectory(path)


def test_files_that_cannot_be_read_or_written(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_trajectory(tmp_path / "none.json")
    for write in (MOVE.save, MOVE.to_csv):
        with pytest.raises(OSError, match="nowhere"):
            write(tmp_path / "nowhere" / "plan")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_of_a_wrong_request(tmp_path):
    for arguments in ({"timepts": [0.0, np.nan]}, {"order": -1}, {"timepts": [0.0], "order": 0.5}):
        with pytest.raises(ValueError, match="must"):
            MOVE.to_csv(tmp_path / "plan.csv", **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".gz", ".bz2", ".xz"])
def test_a_table_is_compressed_as_its_ending_says(ending, tmp_path):
    path = tmp_path / f"plan.csv{ending}"
    MOVE.to_csv(path, [0.25, 0.5], order=0)
    np.testing.assert_array_equal(np.loadtxt(path, delimiter=",", skiprows=1)[:, 1], MOVE([0.25, 0.5]))


@pytest.mark.parametrize("write", ["save", "to_csv"])
def test_a_write_that_fails_leaves_the_plan_before(write, tmp_path, monkeypatch):
    path = tmp_path / "plan"
    path.write_text("before")

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        getattr(MOVE, write)(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_table_of_no_times_has_its_names_alone(tmp_path):
    plan = PolySpline([Waypoint(0, 0, 0), Waypoint(1, 1, 0)])
    plan.to_csv(tmp_path / "none.csv", [], order=1)
    assert (tmp_path / "none.csv").read_text() == "time,y,y_d1\n"


def test_an_order_of_a_table_may_be_any_whole_number(tmp_path):
    plan = PolySpline([Waypoint(0, 0, 0), Waypoint(1, 1, 0)])
    plan.to_csv(tmp_path / "a.csv", [0.5], order=1.0)
    plan.to_csv(tmp_path / "b.csv", [0.5], order=1)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.parametrize("times", [[True, False], np.array([0.0, 1.0]) > 0.5, True])
def test_a_mask_is_no_time(times, tmp_path):
    plan = PolySpline([Waypoint(0, 0, 0), Waypoint(1, 1, 0)])
    for asked in (plan, lambda t: plan.jet(t, 1), lambda t: plan.to_csv(tmp_path / "a.csv", t)):
        with pytest.raises(TypeError, match="times must be numbers, got truth values"):
            asked(times)
