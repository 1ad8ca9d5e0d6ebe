"""Logs: every format gives the same signals; what is wrong is an error with its place."""

import re

import control as ct
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import ctrlplan as cp

TIMES = np.array([0.0, 0.5, 1.25, 2.0])
POSITION = np.array([0.0, 1.5, -2.25, 1e-3])
FORCE = np.array([10.0, 20.0, 30.0, 40.0])
TABLE = {"time": TIMES, "pos_act": POSITION, "force": FORCE}


def text(separator=",", comma=False, header=True):
    lines = [separator.join(TABLE)] if header else []
    lines += [separator.join(map(repr, row)) for row in zip(*(v.tolist() for v in TABLE.values()), strict=True)]
    whole = "\n".join(lines) + "\n"
    return whole.replace(".", ",") if comma else whole


@pytest.fixture
def written(tmp_path):
    def write(content, name="log.csv"):
        path = tmp_path / name
        path.write_text(content, encoding="utf-8")
        return path

    return write


def check_signals(log):
    assert log.output_labels == ["pos_act", "force"]
    np.testing.assert_array_equal(log.time, TIMES)
    np.testing.assert_array_equal(log.outputs, [POSITION, FORCE])


@pytest.mark.parametrize(
    "content",
    [
        text(),
        text(";"),
        text(";", comma=True),
        f"# drive 3\n\n{text()}# end\n",
        "\ufeff" + text().replace("\n", "\r\n"),
    ],
)
@pytest.mark.parametrize("name", ["log.csv", "log.TXT", "log.dat"])
def test_texts(content, name, written):
    check_signals(cp.read_log(written(content, name)))


def test_a_text_without_header_is_read_by_numbers(written):
    path = written(text(header=False))
    check_signals(cp.read_log(path, signals={"pos_act": 1, "force": 2}))
    check_signals(cp.read_log(path, time=0, signals={"pos_act": 1, "force": 2}))
    with pytest.raises(ValueError, match=r'no header; give signals= by number, for instance \{"y": 1\}'):
        cp.read_log(path)


def test_tables_in_memory():
    check_signals(cp.read_log(TABLE))
    frame = pd.DataFrame(TABLE)
    check_signals(cp.read_log(frame))
    check_signals(cp.read_log(frame.set_index("time")))
    check_signals(cp.read_log(frame.convert_dtypes()))
    assert list(frame.columns) == list(TABLE)


def test_vectors_of_matlab_and_numpy(tmp_path):
    savemat(tmp_path / "flat.mat", TABLE | {"note": "servo", "gain": 3.0})
    check_signals(cp.read_log(tmp_path / "flat.mat"))
    savemat(tmp_path / "deep.mat", {"data": {name: row[:, None] for name, row in TABLE.items()}})
    log = cp.read_log(tmp_path / "deep.mat", time="data.time", signals={"y": "data.pos_act"})
    np.testing.assert_array_equal(log.outputs, POSITION)
    np.savez(tmp_path / "log.npz", **TABLE, period=0.5)
    check_signals(cp.read_log(tmp_path / "log.npz"))


@pytest.mark.parametrize("ending", [".csv", ".mat", ".npz"])
def test_an_exported_response_is_read_back(ending, tmp_path):
    lag = ct.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]], states=["x"], inputs=["r"], outputs=["y"], name="lag")
    response = cp.simulate(lag, TIMES, cp.Step(1.0))
    log = cp.read_log(response.export(tmp_path / f"run{ending}"))
    assert log.output_labels == ["y", "r", "x"]
    np.testing.assert_array_equal(log.time, TIMES)
    np.testing.assert_array_equal(log.y, [response.y[0], response.u[0], response.x[0]])


def test_signals_are_named_and_scaled():
    units = {"time": 1e-3, "y": -2.0}
    log = cp.read_log(TABLE, signals={"y": "pos_act", "again": 1}, units=units)
    np.testing.assert_allclose(log.time, 1e-3 * TIMES, rtol=1e-15)
    np.testing.assert_array_equal(log.y, [-2.0 * POSITION, POSITION])


def test_a_log_is_a_response():
    log = cp.read_log(TABLE)
    assert isinstance(log, cp.SimulationResponse)
    assert (log.method, log.reason, log.events) == ("measured", "4 samples of the table", [])
    assert "measured: 4 samples of the table" in str(log)
    assert log.outputs["force"].tolist() == FORCE.tolist()
    assert list(log.to_pandas().columns) == ["time", "pos_act", "force"]


def test_columns_that_are_not_chosen_may_be_text(written):
    path = written("time,y,state\n0,1,READY\n1,2,\n2,3,MOVE\n")
    assert cp.read_log(path, signals={"y": "y"}).outputs.tolist() == [1.0, 2.0, 3.0]
    frame = pd.DataFrame({"time": [0.0, 1.0], "y": [1, 2], "on": [True, False], "state": ["a", "b"]})
    log = cp.read_log(frame, signals={"y": "y", "on": "on"})
    assert log.y.tolist() == [[1.0, 2.0], [1.0, 0.0]]


# Bad logs


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "time,y\n0,1\n\n1,\n2,3\n",
            "line 4: column 'y' must be a finite number, got an empty cell; correct",
        ),
        ("time,y\n0,1\n1,nan\n", "line 3: column 'y' must be a finite number, got 'nan'"),
        ("time,y\n0,1\n1,NaN\n", "line 3: column 'y' must be a finite number, got 'NaN'"),
        ("time,y\n0,1\n1,inf\n", "line 3: column 'y' must be a finite number, got 'inf'"),
        ("time,y\n0,1\n1,fault\n", "line 3: column 'y' must be a finite number, got 'fault'"),
        ("time,y\n0,1\n12:01,2\n", "line 3: column 'time' must be a finite number, got '12:01'"),
        ("time,y\n# run 2\n0,1\n1,2\n1,3\n", "line 5: times must increase strictly, got 1 after 1 in line 4"),
        ("time,y\n0,1\n1,2\n0.5,3\n", "line 4: times must increase strictly, got 0.5 after 1 in line 3"),
        ("time,y\n0,1\n1,2,3\n", "line 3: must have 2 cells as the first line, got 3"),
        ("time,y\n0,1\n", "must have two or more samples, got 1"),
        ("time,y\n", "must have lines of numbers, got a header only"),
        ("", "must have lines of numbers, got none"),
        ("t_s,y\n0,1\n1,2\n", "must have the column 'time' of times, got t_s, y; pass time='t_s'"),
        ("n,y\n0,1\n1,2\n", "must have a column 'time', got n, y"),
        ("time\n0\n1\n", "must have a column of a signal, got one of times only"),
        ("# log\ntime\ty\n0\t1\n1\t2\n", "line 2: cells must be separated by semicolons or commas, got tabs"),
        ("0\t1\n1\t2\n", "line 1: cells must be separated by semicolons or commas, got tabs; replace them"),
    ],
)
def test_bad_texts_have_a_line(content, message, written):
    path = written(content)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        cp.read_log(path)
    assert str(caught.value).startswith(str(path))


def test_gaps_in_time_are_errors(written):
    t = np.delete(np.arange(200) * 1e-3, slice(100, 150))
    path = written("time,y\n" + "".join(f"{a!r},0\n" for a in t.tolist()))
    message = (
        r"line 102: times must have no gap above 0\.01 s \(10 times the median step\), got 0\.051 s after line 101"
    )
    with pytest.raises(ValueError, match=message):
        cp.read_log(path)
    assert cp.read_log(path, max_gap=0.051).time.size == 150
    assert cp.read_log(path, max_gap=np.inf).time.size == 150
    with pytest.raises(ValueError, match=r"no gap above 0\.05 s \(max_gap\)"):
        cp.read_log(path, max_gap=0.05)
    with pytest.raises(ValueError, match="max_gap must be above 0, got nan"):
        cp.read_log(path, max_gap=np.nan)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (TABLE | {"force": [1.0, np.nan, 3.0, 4.0]}, "the table, index 1: column 'force' must be a finite number"),
        (TABLE | {"time": [0.0, 1.0, 1.0, 2.0]}, "the table, index 2: times must increase strictly, got 1 after 1"),
        (pd.DataFrame(TABLE | {"force": [1, 2, None, 4]}), "the frame, row 2: column 'force' must be a finite number"),
        (pd.DataFrame(TABLE | {"force": list("abcd")}), "the frame, row 0: column 'force' must be a finite number"),
        (pd.DataFrame(TABLE | {"force": ["1", "2", "3", "4"]}), "column 'force' must be a finite number, got '1'"),
        (pd.DataFrame(TABLE).astype({"force": "Int64"}).replace({"force": {30: pd.NA}}), "row 2: column 'force'"),
        (pd.DataFrame([[0, 1], [1, 2]], columns=["time", "time"]), "different names, got time, time"),
        ({"time": TIMES}, "the table must have a column of a signal"),
        ({"time": [0.0, 1.0], "y": [1.0, 2.0, 3.0]}, "a signal with 2 values, as many as times, got y with 3"),
        ({"time": 1.0, "y": 2.0}, "the table: column 'time' must be a vector"),
    ],
)  # fmt: skip
def test_bad_tables_have_a_row(table, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        cp.read_log(table)


def test_columns_of_other_lengths_are_left_out_unless_they_are_named():
    table = TABLE | {"period": np.array([0.5]), "spectrum": np.zeros((4, 7))}
    check_signals(cp.read_log(table))
    with pytest.raises(ValueError, match="columns of the same length, got 'time': 4, 'period': 1"):
        cp.read_log(table, signals={"y": "period"})
    with pytest.raises(ValueError, match=r"the table: column 'spectrum' must be a vector, got shape \(4, 7\)"):
        cp.read_log(table, signals={"y": "spectrum"})


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"time": "clock"}, ValueError, "pass time='time'"),
        ({"time": 7}, ValueError, "must have a column 7, got 3 columns, from 0"),
        ({"time": True}, TypeError, "time must be the name or the number of a column, got True"),
        ({"time": None}, TypeError, "time must be the name or the number of a column, got None"),
        ({"signals": {"y": "pos"}}, ValueError, "must have a column 'pos', got time, pos_act, force"),
        ({"signals": {}}, ValueError, "signals must name at least one column"),
        ({"signals": ["pos_act"]}, TypeError, "signals must be a mapping of labels to columns"),
        ({"signals": {"": "pos_act"}}, TypeError, "signals must have labels that are strings"),
        ({"signals": {"y": None}}, TypeError, r"signals\['y'\] must be the name or the number"),
        ({"units": {"y": 1.0}}, ValueError, "units must be of time, pos_act, force, got 'y'"),
        ({"units": {"force": "kN"}}, TypeError, r"units\['force'\] must be the factor .* got 'kN'"),
        ({"units": {"force": 0}}, ValueError, r"units\['force'\] must not be 0"),
        ({"units": {"force": np.nan}}, ValueError, r"units\['force'\] must be finite"),
        ({"units": {"time": -1.0}}, ValueError, r"units\['time'\] must be finite and above 0"),
        ({"units": 2.0}, TypeError, "units must be a mapping"),
    ],
)
def test_bad_arguments(options, error, message):
    with pytest.raises(error, match=message):
        cp.read_log(TABLE, **options)


def test_dates_are_not_seconds():
    frame = pd.DataFrame(TABLE | {"time": pd.date_range("2026-01-01", periods=4, freq="s")})
    with pytest.raises(TypeError, match=r"must be numbers \(times in seconds\), got values of type datetime64"):
        cp.read_log(frame)


def test_bad_files(tmp_path):
    for name in ("log.xlsx", "log"):
        with pytest.raises(ValueError, match=r"must end in one of \.csv, \.txt, \.dat, \.mat, \.npz, or be a"):
            cp.read_log(tmp_path / name)
    for name in ("log.csv", "log.mat", "log.npz"):
        with pytest.raises(FileNotFoundError):
            cp.read_log(tmp_path / name)
        (tmp_path / name).write_bytes(b"\xff\x00 no log")
        with pytest.raises(ValueError, match=re.escape(str(tmp_path / name))):
            cp.read_log(tmp_path / name)
    with (tmp_path / "new.mat").open("wb") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(128))
    with pytest.raises(ValueError, match=r"before version 7\.3; write it by save\(\.\.\., '-v7'\)"):
        cp.read_log(tmp_path / "new.mat")
    np.savez(tmp_path / "objects.npz", time=TIMES, y=np.array([{}, {}, {}, {}]))
    with pytest.raises(ValueError, match="must be a NPZ file of numbers"):
        cp.read_log(tmp_path / "objects.npz")
    with pytest.raises(TypeError, match="path_or_frame must be a path, a DataFrame or a mapping"):
        cp.read_log(3)
