"""`ctrlplan new`: a file of every kind, which is valid, runs, and is never written over another."""

import json
import re
import sys
import tomllib

import numpy as np
import pytest
from study_schema import schema_errors

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.studies.new import study_kinds, study_purpose
from ctrlplan.studies.progress import bars_over_plans


@pytest.fixture
def written(tmp_path, monkeypatch, capsys):
    """Write a new study file of a kind, with few samples, values and draws."""
    monkeypatch.chdir(tmp_path)

    def write(kind):
        assert main(["new", "mine.toml", "--kind", kind]) == 0
        names = capsys.readouterr().out.splitlines()
        path = tmp_path / "mine.toml"
        text = re.sub(r"samples = \d+", "samples = 61", path.read_text(encoding="utf-8"))
        path.write_text(re.sub(r"count = \d+", "count = 3", text), encoding="utf-8")
        return path, names

    return write


PLANTS = {
    "dc-motor",
    "flexible-joint",
    "kinematic-car",
    "magnetic-levitation",
    "planar-quadrotor",
    "two-mass-drive",
}


RUN = PLANTS - {"dc-motor", "planar-quadrotor", "two-mass-drive"}
"""Plants whose files are run; the others differ in their plant only, and are read and planned."""


def test_there_is_a_kind_for_each_loop_and_each_way_of_planning():
    assert set(study_kinds()) == PLANTS | {
        "linear",
        "crane",
        "python",
        "flat",
        "csv",
        "fastest",
        "obstacles",
        "sweep",
        "draws",
    }
    assert study_kinds()[0] == "linear"


EVERYDAY = {"linear", "crane", "draws", "kinematic-car"}


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=() if kind in EVERYDAY else pytest.mark.slow)
        for kind in study_kinds()
        if kind not in PLANTS - RUN
    ],
)
def test_a_new_file_is_valid_and_runs(kind, written, tmp_path, capsys):
    if kind in PLANTS | {"flat"}:
        pytest.importorskip("casadi")
    path, names = written(kind)
    assert names[0] == "mine.toml"
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)
    assert schema_errors(tomllib.loads(path.read_text(encoding="utf-8"))) == []
    assert main(["report", "mine.toml", "--out", "out"]) == 0, capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["studies"]["mine"]
    assert all(row["metrics"] for row in found["plans"].values())
    assert ("sweep" in found) == (kind == "sweep")
    assert ("draws" in found) == (kind in ("draws", "flexible-joint"))
    assert main(["plan", "mine.toml", "--out", "plan.json"]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("kind", sorted(PLANTS - RUN))
def test_a_new_file_of_another_plant_is_valid(kind, written, capsys):
    path, _ = written(kind)
    assert schema_errors(tomllib.loads(path.read_text(encoding="utf-8"))) == []
    assert main(["plan", "mine.toml", "--out", "plan.json"]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("kind", study_kinds())
def test_a_new_file_is_commented(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "it's mine.toml", "--kind", kind]) == 0
    lines = (tmp_path / "it's mine.toml").read_text(encoding="utf-8").splitlines()
    assert lines[0] == f"# {study_purpose(kind)}"
    assert "ctrlplan report 'it'\"'\"'s mine.toml'" in lines[1]
    assert sum("#" in line for line in lines) >= 6
    assert max(map(len, lines)) <= 120
    capsys.readouterr()


@pytest.mark.parametrize(
    ("kind", "there"), [("linear", "mine.toml"), ("csv", "waypoints.csv"), ("python", "my_loop.py")]
)
def test_what_exists_is_not_replaced_and_nothing_else_written(kind, there, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / there).write_text("before")
    assert main(["new", "mine.toml", "--kind", kind]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"ctrlplan: a new file must not exist yet, got {there}; choose another name or folder\n"
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [(there, "before")]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("mine.txt", "a study file must end in .toml, got mine.txt"),
        ("none/mine.toml", "a new file must be writable, got none/mine.toml: No such file or directory"),
        ("file/mine.toml", "a new file must be writable, got file/mine.toml: Not a directory"),
    ],
)
def test_a_place_without_room_is_an_error_in_one_line(path, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file")
    assert main(["new", path]) == 2
    assert capsys.readouterr().err == f"ctrlplan: {message}\n"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("command", ["reproduce", "online", "new", "report", "plan"])
def test_help_has_an_example_of_each_command(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    said = capsys.readouterr().out
    assert re.search(rf"examples?:\n(  .*\n)*  ctrlplan {command} ", said)


def test_help_of_new_has_every_kind_and_the_schema(capsys):
    with pytest.raises(SystemExit):
        main(["new", "--help"])
    said = capsys.readouterr().out
    for kind in study_kinds():
        assert re.search(rf"\n  {kind} +{re.escape(study_purpose(kind))}", said)
    assert "study.schema.json" in said


def test_an_unknown_kind_is_an_error_of_usage(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["new", str(tmp_path / "mine.toml"), "--kind", "ship"])
    assert ended.value.code == 2
    assert "invalid choice: 'ship'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_progress_says_what_runs(written, capsys):
    written("fastest")
    assert main(["report", "mine.toml", "--out", "out"]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "ctrlplan: planning scaled in minimum time",
        "ctrlplan: running study mine (3 plans)",
        "ctrlplan: writing the report",
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_progress_counts_the_plans_on_a_terminal(written, capsys, monkeypatch):
    written("fastest")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TQDM_MININTERVAL", "0")
    assert main(["report", "mine.toml", "--out", "out"]) == 0
    said = capsys.readouterr().err.replace("\r", "\n")
    running = re.findall(r"plans: +\d+%.* (\d)/3 .*?, (?:[^,\]]*/[^,\]]*, )?(\w[^\]]*)\]", said)
    assert {int(done) for done, _ in running} >= {0, 1, 2}
    assert len({name for _, name in running}) == 3


@pytest.mark.slow
def test_a_bar_over_runs_has_none_over_their_plans(capsys):
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    events = [cp.Event("y", high=2.0)]  # loops with events run one by one
    with bars_over_plans(True):
        cp.sweep(cp.plants.integrator_lag_loop, [1, 2], move, np.linspace(0, 5, 51), events=events, parameter="gain")
        said = capsys.readouterr().err
        assert "gain" in said
        assert "plans" not in said
        cp.compare(cp.plants.integrator_lag_loop(1.0), move, np.linspace(0, 5, 51))
        assert "plans" in capsys.readouterr().err
    cp.compare(cp.plants.integrator_lag_loop(1.0), move, np.linspace(0, 5, 51))
    assert capsys.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_progress_names_sweeps(written, capsys):
    written("sweep")
    assert main(["report", "mine.toml", "--out", "out"]) == 0
    assert "ctrlplan: running the sweep over gain" in capsys.readouterr().err.splitlines()
