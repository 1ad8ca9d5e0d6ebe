"""Logs in study files: marked columns and curves, fitted gains, and errors with the place."""

import json
import re

import numpy as np
import pytest
from study_schema import schema_errors, structure_error
from study_text import to_toml, valid

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.studies.files import StudyError, load_study

LOGGED = np.arange(-0.5, 29.0, 0.01)


@pytest.fixture
def folder(tmp_path):
    """Folder with logs of a loop with another gain, in other units."""
    study = load_study(write(tmp_path))
    for name in ("poly", "step"):
        run = cp.simulate(cp.plants.unity_feedback_loop([1.0], [1.0, 1.0, 0.0], 4.0, outputs=("y", "u")), LOGGED,
                          study.plans[name])  # fmt: skip
        y, u = run.outputs
        rows = np.stack([1e3 * (LOGGED + 0.25), 1e3 * y, u, study.plans[name](LOGGED).ravel()])
        lines = ["t_ms;pos;torque;r;state", *(";".join([*map(repr, row), "RUN"]) for row in rows.T.tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines), encoding="utf-8")
    return tmp_path


TABLE = {
    "log": "poly.csv",
    "time": "t_ms",
    "signals": {"y": "pos", "u": "torque", "r": "r"},
    "units": {"time": 1e-3, "y": 1e-3},
}


def write(folder, **changes):
    path = folder / "study.toml"
    path.write_text(to_toml(valid(**changes)), encoding="utf-8")
    return path


@pytest.mark.slow
def test_logs_are_marked_columns_and_curves(folder, capsys):
    path = write(folder, measured={"poly": TABLE, "step": TABLE | {"log": "step.csv", "align": "r"}})
    assert main(["report", str(path), "--out", str(folder / "out")]) == 0
    capsys.readouterr()
    plans = json.loads((folder / "out" / "results.json").read_text(encoding="utf-8"))["studies"]["study"]["plans"]
    assert {"poly (measured)", "step (measured)"} <= plans.keys()
    text = (folder / "out" / "index.html").read_text(encoding="utf-8")
    words = re.sub(r"<[^>]*>", "", text)
    assert "poly (measured)†" in words
    assert "found from the command r compared with the plan" in words
    found = load_study(path).run().comparison
    assert found.measured["poly (measured)"].offset == pytest.approx(0.25, abs=1e-9)
    assert found.measured["step (measured)"].offset == pytest.approx(0.25, abs=0.005)
    assert found.metrics["poly (measured)"]["control_peak"] != found.metrics["poly"]["control_peak"]


@pytest.mark.slow
def test_a_path_is_enough_where_columns_have_the_labels(folder):
    log = cp.read_log(folder / "poly.csv", time="t_ms", signals=TABLE["signals"], units=TABLE["units"])
    log.export(folder / "plain.npz")
    found = load_study(write(folder, measured={"poly": "plain.npz"})).run().comparison
    assert found.measured["poly (measured)"].offset == pytest.approx(0.25, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("align", "offset"), [(0.1, 0.1), (False, 0.0), (True, 0.25), ("auto", 0.25)])
def test_alignment(align, offset, folder):
    found = load_study(write(folder, measured={"poly": TABLE | {"align": align}})).run().comparison
    assert found.measured["poly (measured)"].offset == pytest.approx(offset, abs=1e-9)


@pytest.mark.slow
def test_fitted_gains(folder, capsys):
    """u = y' + y'' of the plant 1/(s^2 + s), which is followed from its measured position."""
    terms = ["velocity", "acceleration"]
    path = write(folder, measured={"poly": TABLE | {"fit": {"terms": terms}}})
    assert main(["report", str(path), "--out", str(folder / "out")]) == 0
    capsys.readouterr()
    study = json.loads((folder / "out" / "results.json").read_text(encoding="utf-8"))["studies"]["study"]
    fit = study["feedforward"]["poly (measured)"]
    assert fit["gains"] == pytest.approx({"velocity": 1.0, "acceleration": 1.0}, rel=0.01)
    assert abs(fit["delay"]) < 2e-3
    words = re.sub(r"<[^>]*>", " ", (folder / "out" / "index.html").read_text(encoding="utf-8"))
    assert "Feedforward fitted to the log" in words
    assert re.search(r"poly \(measured\)\s+velocity\s+(1\.0|0\.99)", words)
    on_plan = load_study(write(folder, measured={"poly": TABLE | {"fit": {"terms": terms, "from": "plan"}}})).run()
    assert "Regressors: derivatives of the plan." in str(on_plan.sections[0].fits["poly (measured)"])
    assert load_study(write(folder, measured={"poly": TABLE | {"fit": False}})).run().results().keys() == {"plans"}


@pytest.mark.parametrize(
    ("measured", "message"),
    [
        ({"cubic": TABLE}, "measured.cubic: must be of one of the plans trigonometric, poly, legs, step, got 'cubic'"),
        ({"poly": {}}, "measured.poly"),
        ({"poly": TABLE | {"log": "none.csv"}}, "measured.poly: must be a file that can be read, got"),
        ({"poly": TABLE | {"time": "time"}}, "must have the column 'time' of times, got t_ms, pos"),
        ({"poly": TABLE | {"signals": {"y": "state"}, "units": {}}}, "line 2: column 'state' must be a finite number"),
        ({"poly": TABLE | {"units": {"x": 1.0}}}, "measured.poly: units must be of time, y, u, r, got 'x'"),
        ({"poly": TABLE | {"align": "x"}}, "measured.poly: align must be"),
        ({"poly": TABLE | {"align": 1e4}}, "measured.poly: logs['poly'] must overlap the simulated time"),
        ({"poly": TABLE | {"fit": {"control": "v"}}}, "measured.poly.fit: log must have the signal 'v'"),
        ({"poly": TABLE | {"fit": {"terms": ["friction"]}}}, "measured.poly.fit"),
        ({"poly": 3.0}, "measured.poly"),
    ],
)  # fmt: skip
def test_what_is_wrong_has_its_place(measured, message, folder, capsys):
    path = write(folder, measured=measured)
    assert main(["report", str(path), "--out", str(folder / "out")]) == 2
    said = capsys.readouterr().err
    assert message in said.replace("\n", " ")
    assert not (folder / "out").exists()


def test_a_plan_is_written_before_there_is_a_log(tmp_path, capsys):
    path = write(tmp_path, measured={"poly": "later.csv"})
    assert main(["plan", str(path), "--out", str(tmp_path / "plan.csv")]) == 0
    capsys.readouterr()
    with pytest.raises(StudyError, match=r"measured\.poly: must be a file that can be read"):
        load_study(path).run()


def test_the_schema_knows_the_tables():
    whole = TABLE | {"max_gap": 0.1, "align": False, "fit": {"control": "u", "position": "y", "terms": ["jerk"]}}
    for good in ("log.csv", TABLE, whole, TABLE | {"fit": True, "align": 0.5, "time": 0}):
        assert schema_errors(valid(measured={"poly": good})) == []
        assert structure_error(valid(measured={"poly": good})) is None
    for wrong in (3, {"time": "t"}, TABLE | {"clock": 1}, TABLE | {"fit": {"terms": ["friction"]}}):
        assert schema_errors(valid(measured={"poly": wrong}))
        assert structure_error(valid(measured={"poly": wrong}))


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_cranes_have_measured_runs(tmp_path):
    points = [{"time": t, "x": [x, 0.0, 0.0], "z": [z, 0.0, 0.0]} for t, x, z in ((0.0, 0.0, 10.0), (12.0, 5.0, 9.0))]
    changes = {"loop": {"kind": "crane"}, "waypoints": points, "units": {}, "t_end": 16.0, "samples": 401,
               "plans": [{"name": "poly", "family": "polynomial"}]}  # fmt: skip
    run = load_study(write(tmp_path, **changes)).run().comparison.responses["poly"]
    rows = dict(zip(run.output_labels, run.outputs, strict=True))
    np.savez(tmp_path / "log.npz", time=run.time + 2.0, x=rows["x"], z=rows["z"], theta=rows["theta"])
    path = write(tmp_path, **changes, measured={"poly": "log.npz"})
    study = load_study(path).run()
    assert study.comparison.measured["poly (measured)"].offset == pytest.approx(2.0, abs=1e-3)
    assert main(["report", str(path), "--out", str(tmp_path / "out")]) == 0
