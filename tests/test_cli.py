"""The command: what it writes, what it says where, and how it ends."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.studies import MEASURES

STUDY = """
title = "Over the wall"
t_end = 20.0
samples = 201
[loop]
kind = "linear"
num = [1.0]
den = [1.0, 1.0, 0.0]
gain = 100.0
[[plans]]
family = "polynomial"
[[plans]]
name = "turned"
family = "trigonometric"
alpha = 2.0
[[plans]]
family = "step"
[[waypoints]]
time = 1.0
x = [3.0, 0.0, 0.0]
[[waypoints]]
time = 5.0
x = [5.0, 0.0, 0.0]
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "wall.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


def quintic(t):
    """From 3 to 5 in 4 s from t = 1, at rest with zero acceleration at both ends: value and two derivatives."""
    s = (np.asarray(t) - 1.0) / 4.0
    return (
        3 + 2 * s**3 * (10 - 15 * s + 6 * s**2),
        2 * 30 * s**2 * (1 - s) ** 2 / 4,
        2 * 60 * s * (1 - s) * (1 - 2 * s) / 16,
    )


def python_m(*arguments, **options):
    command = [sys.executable, "-W", "error", "-m", "ctrlplan", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


# plan


def test_plan_writes_csv_whose_values_are_those_of_the_plans(study, tmp_path, capsys):
    out = tmp_path / "plan.csv"
    assert main(["plan", str(study), "--out", str(out)]) == 0
    head, *rows = out.read_text(encoding="utf-8").splitlines()
    names = head.split(",")
    table = dict(zip(names, np.array([row.split(",") for row in rows], dtype=float).T, strict=True))
    t = table["time"]
    assert (t[0], t[-1]) == (1.0, 5.0)
    assert t.size >= 1000
    assert np.all(np.diff(t) > 0)
    assert names[1:4] == ["polynomial.x", "polynomial.x_d1", "polynomial.x_d2"]
    for name, values in zip(names[1:4], quintic(t), strict=True):
        np.testing.assert_allclose(table[name], values, rtol=0, atol=1e-12)
    points = [cp.Waypoint(1, 3, 0, 0), cp.Waypoint(5, 5, 0, 0)]
    turned = cp.TrigSpline(points, alpha=2.0).jet(t, 2)[:, 0]
    for k, name in enumerate(names[4:7]):
        assert name.startswith("turned.x")
        np.testing.assert_allclose(table[name], turned[k], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(table["step.x"], 5.0)  # a step is there at once
    np.testing.assert_array_equal(table["step.x_d1"], 0.0)
    capsys.readouterr()


def test_plan_writes_json_from_which_every_plan_returns(study, tmp_path, capsys):
    out = tmp_path / "plan.json"
    assert main(["plan", str(study), "--out", str(out)]) == 0
    data = json.loads(out.read_text(encoding="utf-8"))
    assert list(data) == ["polynomial", "turned", "step"]
    t = np.linspace(0, 6, 601)
    points = [cp.Waypoint(1, 3, 0, 0), cp.Waypoint(5, 5, 0, 0)]
    expected = {
        "polynomial": cp.PolySpline(points),
        "turned": cp.TrigSpline(points, alpha=2.0),
        "step": cp.Step(5.0, initial=3.0, time=1.0),
    }
    for name, plan in expected.items():
        again = cp.trajectory_from_dict(data[name])
        assert type(again) is type(plan)
        assert again.labels == ("x",)
        np.testing.assert_array_equal(again.jet(t, 2), plan.jet(t, 2))
    capsys.readouterr()


@pytest.mark.parametrize("name", ["plan.csv", "plan.json", "a/new/folder/plan.csv"])
def test_plan_says_the_path_on_stdout_and_progress_on_stderr(name, study, tmp_path, capsys):
    out = tmp_path / name
    assert main(["plan", str(study), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [str(out)]
    assert said.err.splitlines() == ["ctrlplan: plans of wall"]
    assert [p.name for p in out.parent.iterdir() if p != study] == [out.name]


def test_plan_replaces_what_it_wrote_before(study, tmp_path, capsys):
    out = tmp_path / "plan.csv"
    out.write_text("before")
    assert main(["plan", str(study), "--out", str(out)]) == 0
    assert out.read_text().startswith("time,")
    capsys.readouterr()


# report


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    place = tmp_path_factory.mktemp("reported")
    (place / "wall.toml").write_text(STUDY, encoding="utf-8")
    return place / "out", python_m("report", "wall.toml", "--out", "out", cwd=place)


def test_report_writes_a_page_and_its_results(reported):
    folder, done = reported
    assert done.returncode == 0
    assert done.stdout.splitlines() == ["out/index.html", "out/results.json"]
    assert sorted(p.name for p in folder.iterdir()) == ["index.html", "results.json"]
    assert "<title>Over the wall</title>" in (folder / "index.html").read_text(encoding="utf-8")


def test_report_says_its_progress_on_stderr(reported):
    _, done = reported
    assert done.stderr.splitlines() == ["ctrlplan: study wall", "ctrlplan: report"]


def test_results_have_the_stable_keys_and_the_numbers_of_compare(reported):
    folder, _ = reported
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert list(results) == ["studies"]
    assert list(results["studies"]) == ["wall"]
    plans = results["studies"]["wall"]["plans"]
    assert list(plans) == ["polynomial", "turned", "step"]
    loop = cp.plants.integrator_lag_loop(100.0, outputs=("y", "u"))
    points = [cp.Waypoint(1, 3, 0, 0), cp.Waypoint(5, 5, 0, 0)]
    references = {
        "polynomial": cp.PolySpline(points),
        "turned": cp.TrigSpline(points, alpha=2.0),
        "step": cp.Step(5.0, initial=3.0, time=1.0),
    }
    alone = cp.compare(loop, references, np.union1d(np.linspace(1, 20, 201), [1, 5]), waypoints=points).metrics
    for name, plan in plans.items():
        assert list(plan) == ["metrics"]
        assert list(plan["metrics"]) == list(alone[name])
        assert {"settling_time", "overshoot_error"} <= set(plan["metrics"]) <= set(MEASURES)
        for key, value in alone[name].items():
            known = pytest.approx(value, rel=1e-9, abs=1e-12) if np.isfinite(value) else None
            assert plan["metrics"][key] == known


def test_files_can_be_read_by_others(reported):
    folder, _ = reported
    assert all(path.stat().st_mode & 0o444 == 0o444 for path in folder.iterdir())


def test_the_default_folder_is_called_report(study, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["report", study.name]) == 0
    assert sorted(p.name for p in (tmp_path / "report").iterdir()) == ["index.html", "results.json"]
    assert capsys.readouterr().out.splitlines() == ["report/index.html", "report/results.json"]


# The command itself


def test_the_version_comes_from_one_place(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"ctrlplan {cp.__version__}\n"


def test_python_m_is_the_same_command(study, tmp_path):
    done = python_m("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"ctrlplan {cp.__version__}\n", "")
    done = python_m("plan", study, "--out", tmp_path / "plan.txt")
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"ctrlplan: --out must end in \.csv or \.json, got \S+plan\.txt\n", done.stderr)


@pytest.mark.slow
def test_a_wrong_file_ends_python_m_with_2_and_one_line(tmp_path):
    (tmp_path / "wrong.toml").write_text(STUDY.replace("alpha = 2.0", "alpha = 7.0"))
    done = python_m("report", "wrong.toml", "--out", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    said = re.escape("ctrlplan: wrong.toml: plans[1]: alpha must lie in [0, 2 pi), got 7")
    assert re.fullmatch(rf"{said}(\.0)?\n", done.stderr)
    assert [p.name for p in tmp_path.iterdir()] == ["wrong.toml"]


@pytest.mark.parametrize(
    "arguments", [[], ["improve"], ["plan"], ["plan", "wall.toml"], ["report"], ["reproduce", "--gain", "5"]]
)
def test_wrong_usage_is_status_2_with_the_usage(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("usage: ctrlplan")


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert all(command in said for command in ("reproduce", "report", "plan"))


def test_help_and_wrong_usage_do_not_wait_for_the_library():
    code = "import sys, ctrlplan.cli\nassert not {'control', 'matplotlib', 'scipy'} & set(sys.modules), 'loaded'"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_command_is_installed_under_its_name():
    from importlib.metadata import entry_points

    (entry,) = entry_points(group="console_scripts", name="ctrlplan")
    assert entry.value == "ctrlplan.cli:main"
    assert entry.load() is main
