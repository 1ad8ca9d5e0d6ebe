"""Waypoints from tables of text: every form of table gives the same points, and what is wrong has its line."""

import re

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.trajectories import Waypoint


@pytest.fixture
def read(tmp_path):
    def write_and_read(text, encoding="utf-8", **options):
        path = tmp_path / "path.csv"
        path.write_bytes(text.encode(encoding))
        return cp.waypoints_from_csv(path, **options)

    return write_and_read


NAMED = [Waypoint.from_jets(0.5, x=[0.0], z=[10.0]), Waypoint.from_jets(2.0, x=[3.25], z=[-6e-3])]
PLAIN = [Waypoint(0.5, [0.0, 10.0]), Waypoint(2.0, [3.25, -6e-3])]


@pytest.mark.parametrize(
    "text",
    [
        "t,x,z\n0.5,0,10\n2,3.25,-6e-3\n",
        "t;x;z\n0.5;0;10\n2;3.25;-6e-3\n",
        "t;x;z\n0,5;0;10,0\n2;3,25;-6e-3",
        "# a path\n\n t , x , z # [s], [m], [m]\r\n 0.5 , 0 , 10\r\n# half way\r\n2.0,3.25,-0.006 # the end\r\n",
        '"t","x","z"\n"0.5",0,10\n2,3.25,-.006\n',
        "\ufefft,x,z\n0.5,0,10\n2,3.25,-6E-3\n",
        "x,t,z\n0,0.5,10\n3.25,2,-6e-3\n",
    ],
)
def test_every_form_of_a_table_gives_the_same_waypoints(text, read):
    assert read(text) == NAMED


@pytest.mark.parametrize(
    "text", ["0.5,0,10\n2,3.25,-6e-3\n", "0,5;0;10\n2;3,25;-6e-3\n", "#\n0.5,0,10\n\n2,3.25,-6e-3"]
)
def test_without_a_header_the_first_column_is_the_time(text, read):
    assert read(text) == PLAIN
    assert read(text, time=0) == PLAIN


def test_columns_are_chosen_by_name_or_number(read):
    text = "n,t,x,z\n1,0.5,0,10\n2,2,3.25,-6e-3\n"
    assert read(text, columns=["x", "z"]) == NAMED
    assert read(text, columns=[2, 3], time=1) == NAMED
    assert [w.labels for w in read(text, columns=["z", "x"])] == [("z", "x")] * 2
    assert read("1,0,0.5,10\n2,3.25,2,-6e-3\n", columns=[1, 3], time=2) == PLAIN
    assert read("time [s],x,z\n0.5,0,10\n2,3.25,-6e-3\n", time="time [s]") == NAMED
    assert read("t,x\n0,1\n1,2\n", columns="x")[1].position.tolist() == [2.0]


POINTS = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 9.0], [-9.0, 14.0]])  # chords of 5, 5 and 13


@pytest.mark.parametrize(("options", "speed"), [({}, 1.0), ({"speed": 2.5}, 2.5), ({"time": None}, 1.0)])
def test_without_times_they_follow_from_the_speed(options, speed, read):
    text = "x,z\n" + "\n".join(f"{x},{z}" for x, z in POINTS)
    found = read(text, **options)
    np.testing.assert_allclose([w.time for w in found], np.array([0, 5, 10, 23]) / speed, rtol=1e-15)
    np.testing.assert_array_equal([w.position for w in found], POINTS)


def test_a_table_without_header_and_times(read):
    text = "0,0\n3,4\n"
    for found in (read(text, time=None), read(text, speed=1.0)):
        assert found == [Waypoint(0.0, [0.0, 0.0]), Waypoint(5.0, [3.0, 4.0])]


def test_derivatives_come_back_from_an_exported_plan(tmp_path):
    points = [Waypoint.from_jets(0, x=[0, 0, 0], z=[9, 1, 0]), Waypoint.from_jets(1.5, x=[2, 1, 0], z=[7, 0, 0])]
    plan = cp.PolySpline(points)
    plan.export(tmp_path / "plan.csv", timepts=[0.0, 1.5])
    found = cp.waypoints_from_csv(tmp_path / "plan.csv", time="time")
    np.testing.assert_array_equal(found[1].jet, plan.jet(1.5, 2))
    assert found[1].labels == ("x", "z")
    some = cp.waypoints_from_csv(tmp_path / "plan.csv", time="time", columns=["x", "x_d1", "z"])
    np.testing.assert_array_equal(some[1].jet, [plan.jet(1.5, 0)[0], [plan(1.5, 1)[0], np.nan]])


def test_a_name_like_that_of_a_derivative_is_an_axis_where_the_axis_is_missing(read):
    assert read("t,motor_d1\n0,1\n1,2\n")[0].labels == ("motor_d1",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,1\n1,\n", "line 3: column 'x' must be a finite number, got an empty cell"),
        ("t,x\n0,1\n# gap\n\n1\n", "line 5: must have 2 cells as the first line, got 1"),
        ("t,x\n0,1\n1,2,3\n", "line 3: must have 2 cells as the first line, got 3"),
        ("t,x\n0,1\n1,two\n", "line 3: column 'x' must be a finite number, got 'two'"),
        ("0,1\n1,two\n", "line 2: column number 1 must be a finite number, got 'two'"),
        ("t,x\n0,1\n1,nan\n", "line 3: column 'x' must be a finite number, got 'nan'"),
        ("t,x\n0,inf\n1,1\n", "line 2: column 'x' must be a finite number, got 'inf'"),
        ("t,x\n0,1\nNaN,NaN\n", "line 3: column 't' must be a finite number, got 'NaN'"),
        ("t,x\n0,1\n1,1_000\n", "line 3: column 'x' must be a finite number, got '1_000'"),
        ("t,x\n0,1\n1;2\n", "line 3: must have 2 cells as the first line, got 1"),
        ("t;x\n0;1.234,5\n", "line 2: column 'x' must be a finite number, got '1.234,5'"),
        ("t,x\n0,1\n2,1\n# back\n1,1\n", "line 5: times must increase strictly, got 1 after 2 in line 3"),
        ("t,x\n0,1\n2,1\n2,1\n", "line 4: times must increase strictly, got 2 after 2 in line 3"),
        (
            "x,z\n0,1\n2,1\n2,1\n",
            "line 4: positions must differ from those of the line before, .* got those of line 3",
        ),
        ("t,x\n0,1\n1,2a\n2,3b\n", "line 3: column 'x' must be a finite number, got '2a'"),
        ("0,1a\n1,2\n", "line 1: the first line must be numbers or different names, got 0, 1a"),
        ("t,x,x\n0,1,2\n", "line 1: the first line must be numbers or different names, got t, x, x"),
        ("t,,x\n0,1,2\n", "line 1: the first line must be numbers or different names, got t, , x"),
        ("", "must have lines of numbers, got none"),
        ("# nothing\n\n", "must have lines of numbers, got none"),
        ("t,x\n", "must have lines of numbers, got a header only"),
        ("t\n0\n1\n", "must have a column of positions, got one of times only; pass time=None if it is none"),
        ("time,x\n0,1\n1,2\n", r"must have the column 't' of times, got time, x; pass time='time'"),
        ("T [s],x\n0,1\n1,2\n", r"must have the column 't' of times, got T \[s\], x; pass time='T \[s\]'"),
        ("t,x,x_d2\n0,1,1\n1,2,2\n", "columns must have x_d1 where they have x_d2, got x, x_d2"),
    ],
)
def test_what_is_wrong_has_its_line(text, message, read):
    with pytest.raises(ValueError, match=message):
        read(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": "s"}, "must have the column 's' of times, got t, x; pass time='t'"),
        ({"time": 2}, "must have a column 2, got 2 columns, from 0"),
        ({"columns": ["y"]}, "must have a column 'y', got t, x"),
        ({"columns": ["x", 1]}, "columns must differ from each other, got 'x', 'x'"),
        ({"speed": 2.0}, "speed must not be given for a file with times, got 2 and the column 't'; pass time=None"),
        ({"time": None, "columns": ["x"], "speed": 0.0}, "speed must be finite and above 0, got 0.0"),
    ],
)
def test_arguments_that_do_not_fit_the_file(options, message, read):
    with pytest.raises(ValueError, match=re.escape(message)):
        read("t,x\n0,1\n1,2\n", **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": 2.0}, "time must be the name or the number of a column, or None, got 2.0"),
        ({"time": True}, "time must be the name or the number of a column, or None, got True"),
        ({"columns": 1}, "columns must be names or numbers of columns, got 1"),
        ({"speed": "2"}, "speed must be a number, got '2'"),
    ],
)
def test_arguments_of_other_kinds(options, message, read):
    with pytest.raises(TypeError, match=message):
        read("0,1\n1,2\n", **options)


def test_names_need_a_header(read):
    with pytest.raises(ValueError, match="must have a header with 'x', got numbers; give columns by number"):
        read("0,1\n1,2\n", columns=["x"])


def test_files_that_cannot_be_read(tmp_path, read):
    with pytest.raises(FileNotFoundError):
        cp.waypoints_from_csv(tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"path\.csv must be text in UTF-8, got"):
        read("t,größe\n0,1\n", encoding="latin-1")
    with pytest.raises(ValueError, match=r"path\.csv must be a table, got field larger than"):
        read("t,x\n0," + "1" * 200_000)
