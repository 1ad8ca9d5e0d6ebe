"""The command: what it writes, what it says where, and how it ends."""

import html
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from strict import WARNINGS

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.reports import write_all
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
    command = [sys.executable, *WARNINGS, "-m", "ctrlplan", *map(str, arguments)]
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


def test_plan_writes_samples_by_their_period(study, tmp_path, capsys):
    for ending in (".csv", ".mat", ".npz"):
        assert main(["plan", str(study), "--out", str(tmp_path / f"plan{ending}"), "--dt", "0.25"]) == 0
    times = 1.0 + 0.25 * np.arange(17)
    with np.load(tmp_path / "plan.npz") as data:
        np.testing.assert_array_equal(data["time"], times)
        np.testing.assert_allclose(data["polynomial.x_d1"], quintic(times)[1], rtol=0, atol=1e-12)
    table = np.loadtxt(tmp_path / "plan.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 0], times)
    mat = loadmat(tmp_path / "plan.mat", simplify_cells=True)
    np.testing.assert_allclose(mat["turned_x"]["signals"]["values"][-1], 5.0, rtol=1e-12)
    capsys.readouterr()


@pytest.mark.parametrize("ending", [".yaml", ".cam.csv", ".cam.st", ".ppoly.json", ".c"])
def test_plan_writes_one_file_a_plan_of_what_holds_one(ending, study, tmp_path, capsys):
    """A step has no duration and is left out."""
    assert main(["plan", str(study), "--out", str(tmp_path / f"move{ending}")]) == 0
    names = [
        f"move-{plan}{e}" for plan in ("polynomial", "turned") for e in ([".c", ".h"] if ending == ".c" else [ending])
    ]
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / name) for name in names]
    assert {p.name for p in tmp_path.iterdir()} == {study.name, *names}


def test_plan_of_a_study_with_one_plan_keeps_the_name_given(study, tmp_path, capsys):
    head, _, tail = STUDY.partition("[[plans]]\nname = ")
    study.write_text(head + "[[waypoints]]" + tail.partition("[[waypoints]]")[2])
    assert main(["plan", str(study), "--out", str(tmp_path / "move.ppoly.json")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "move.ppoly.json")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plan.c", "--dt", "0.1"], r"dt must not be given for \.c \(only for .*\), got 0\.1"),
        (["plan.json", "--dt", "0.1"], r"dt must not be given for \.json, which holds the plans themselves"),
        (["plan.csv", "--dt", "0"], r"dt must be finite and above 0, got 0\.0"),
        (["plan.csv", "--dt", "1e-300"], r"dt must give at most 100000000 samples, .*"),
    ],
)
def test_plan_says_what_is_wrong_in_one_line(arguments, message, study, tmp_path, capsys):
    assert main(["plan", str(study), "--out", str(tmp_path / arguments[0]), *arguments[1:]]) == 2
    assert re.search(rf"^ctrlplan: .*{message}$", capsys.readouterr().err.splitlines()[-1])
    assert list(tmp_path.iterdir()) == [study]


@pytest.mark.parametrize("name", ["plan.csv", "plan.json", "a/new/folder/plan.csv"])
def test_plan_says_the_path_on_stdout_and_progress_on_stderr(name, study, tmp_path, capsys):
    out = tmp_path / name
    assert main(["plan", str(study), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [str(out)]
    assert said.err.splitlines() == ["ctrlplan: writing the plans of wall"]
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
    assert done.stderr.splitlines() == ["ctrlplan: running study wall (3 plans)", "ctrlplan: writing the report"]


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


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
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


@pytest.mark.slow
def test_python_m_is_the_same_command(study, tmp_path):
    done = python_m("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"ctrlplan {cp.__version__}\n", "")
    done = python_m("plan", study, "--out", tmp_path / "plan.txt")
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"ctrlplan: --out must end in one of \.json, \.csv, .*, got \S+plan\.txt\n", done.stderr)


@pytest.mark.slow
def test_a_wrong_file_ends_python_m_with_2_and_one_line(tmp_path):
    (tmp_path / "wrong.toml").write_text(STUDY.replace("alpha = 2.0", "alpha = 7.0"))
    done = python_m("report", "wrong.toml", "--out", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    said = re.escape("ctrlplan: wrong.toml: plans[1]: alpha must lie in [0, 2 pi), got 7")
    assert re.fullmatch(rf"{said}(\.0)?\n", done.stderr)
    assert [p.name for p in tmp_path.iterdir()] == ["wrong.toml"]


# Names of any kind, and terminals that cannot show them


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.slow
@pytest.mark.parametrize("more", [{"PYTHONIOENCODING": "ascii:strict"}, {}])
def test_a_terminal_without_the_letters_of_a_path_gets_it_all_the_same(more, tmp_path):
    (tmp_path / "üb🚀er.toml").write_text(STUDY, encoding="utf-8")
    environment = {**os.environ, **ASCII, **more}
    done = python_m("plan", "üb🚀er.toml", "--out", "plän.csv", cwd=tmp_path, env=environment, errors="surrogateescape")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.startswith("pl")
    assert done.stdout.endswith("n.csv\n")
    assert (tmp_path / "plän.csv").read_text(encoding="utf-8").startswith("time,")


@pytest.mark.parametrize("errors", ["strict", "surrogateescape"])
def test_an_ascii_terminal_is_told_the_path_in_escapes(errors, study, tmp_path, monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors=errors)
    monkeypatch.setattr(sys, "stdout", terminal)
    assert main(["plan", str(study), "--out", str(tmp_path / "plän.csv")]) == 0
    assert terminal.buffer.getvalue().endswith(rb"/pl\xe4n.csv" + os.linesep.encode())


@pytest.mark.slow
def test_a_reader_who_has_left_is_no_error(study, tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "ctrlplan", "plan", str(study), "--out", str(tmp_path / "plan.csv")]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "ctrlplan: writing the plans of wall\n")
    assert (tmp_path / "plan.csv").exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_terminal_without_room_is_no_error(study, tmp_path):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "ctrlplan", "plan", str(study), "--out", str(tmp_path / "plan.csv")]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "ctrlplan: writing the plans of wall\n")


@pytest.mark.skipif(os.name == "nt", reason="names of files are texts there")
def test_a_file_name_that_is_no_text_is_a_name(tmp_path, capsys):
    path = Path(os.fsdecode(bytes(tmp_path) + b"/caf\xe9\n\x1b[31m.toml"))
    try:
        path.write_text(STUDY)
    except OSError:
        pytest.skip("the file system does not take this name")
    assert main(["plan", str(path), "--out", str(tmp_path / "plan.json")]) == 0
    said = capsys.readouterr().err
    assert said.splitlines() == [r"ctrlplan: writing the plans of caf\udce9 \x1b[31m"]
    assert main(["plan", f"{path}x", "--out", str(tmp_path / "plan.json")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="names of files are texts there")
def test_a_page_of_a_file_whose_name_is_no_text_is_written(tmp_path, capsys):
    path = Path(os.fsdecode(bytes(tmp_path) + b'/"><img src=x onerror=hit()>\xe9.toml'))
    path.write_text(
        STUDY.replace('title = "Over the wall"', "benefit = true").replace("samples = 201", "samples = 101")
    )
    assert main(["report", str(path), "--out", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "<img" not in page
    assert "&#34;&gt;&lt;img src=x onerror=hit()&gt;\N{REPLACEMENT CHARACTER}" in page
    capsys.readouterr()


# A plan that fails


FAILING = """
t_end = 4.0
samples = 41
[loop]
kind = "python:tangent_loop:build"
[[plans]]
family = "polynomial"
[[plans]]
name = "far <b>"
family = "step"
[[waypoints]]
time = 0.0
y = [0.0, 0.0, 0.0]
[[waypoints]]
time = 3.0
y = [{goal}, 0.0, 0.0]
"""

# x = r tan(r t) for a constant r: with r = 0.6 it leaves all bounds at 2.6 s; the plan is below 0.6 until 3 s.
TANGENT = """
import control as ct

def build() -> ct.NonlinearIOSystem:
    return ct.nlsys(lambda t, x, u, p: [u[0] ** 2 + x[0] ** 2], None, inputs=["r"], outputs=["y"], states=["y"])
"""


@pytest.fixture
def failing(tmp_path, monkeypatch):
    def at(goal):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "tangent_loop.py").write_text(TANGENT)
        (tmp_path / "tangent.toml").write_text(FAILING.format(goal=goal))
        return main(["report", "tangent.toml", "--out", "out"])

    return at


@pytest.mark.slow
def test_a_plan_that_fails_is_a_row_with_its_reason_beside_the_others(failing, tmp_path, capsys):
    assert failing(0.6) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    (found,) = json.loads((tmp_path / "out" / "results.json").read_text())["studies"].values()
    assert list(found["plans"]) == ["polynomial"]
    assert list(found["failures"]) == ["far <b>"]
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    (row,) = re.findall(r'<th scope="row" class="short">far &lt;b&gt;</th><td class="words"[^>]*>(.*?)</td>', page)
    assert html.unescape(row) == found["failures"]["far <b>"] != ""


@pytest.mark.slow
def test_where_every_plan_fails_nothing_is_written(failing, tmp_path, capsys):
    assert failing(30.0) == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("ctrlplan: tangent.toml: loop: ")
    assert not (tmp_path / "out").exists()


# Written whole or not at all


def test_a_folder_that_cannot_be_written_is_rejected_before_a_study_runs(study, tmp_path, monkeypatch, capsys):
    def full(**given):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    for words in (["reproduce"], ["online"], ["report", str(study)]):
        assert main([*words, "--out", str(tmp_path / "new")]) == 2
        errors = capsys.readouterr().err.splitlines()
        assert errors[-1].startswith("ctrlplan: --out must be a writable folder, got ")
        assert errors[-1].endswith(": No space left on device")
        assert not any("running" in line for line in errors)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_without_room_for_the_page_nothing_is_left(study, tmp_path):
    resource = pytest.importorskip("resource", reason="there are no limits of the size of files here")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results.json").write_text("before")
    code = "import sys; from ctrlplan.cli import main; sys.exit(sum(main([*sys.argv[1:4], o]) for o in sys.argv[4:]))"
    arguments = ["report", study, "--out", tmp_path / "out", tmp_path / "new/folder"]
    done = subprocess.run(
        [sys.executable, *WARNINGS, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )
    assert done.returncode == 2 + 2, done.stderr
    ends = [line for line in done.stderr.splitlines() if line.startswith("ctrlplan: --out must be writable, got")]
    assert len(ends) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "wall.toml"]
    assert [(p.name, p.read_text()) for p in (tmp_path / "out").iterdir()] == [("results.json", "before")]


@pytest.mark.parametrize("ended", [OSError(28, "No space left on device"), KeyboardInterrupt(), MemoryError()])
def test_what_ends_while_files_are_written_leaves_what_was_there(ended, tmp_path, monkeypatch):
    def interrupted(handle):
        raise ended

    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "a.txt").write_text("before")
    monkeypatch.setattr(os, "fsync", interrupted)
    for folder in ("old", "new/deep"):
        with pytest.raises(type(ended)):
            write_all({tmp_path / folder / "a.txt": "after", tmp_path / folder / "b.txt": "after"})
    assert [p.name for p in tmp_path.rglob("*")] == ["old", "a.txt"]
    assert (tmp_path / "old" / "a.txt").read_text() == "before"


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


def test_reproduce_says_what_takes_long_without_casadi(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ctrlplan.studies.PAPER", {})
    monkeypatch.setattr("ctrlplan.reports.write_report", lambda *given: [])
    assert main(["reproduce", "--out", str(tmp_path)]) == 0
    assert "pip install" not in capsys.readouterr().err
    monkeypatch.setattr("ctrlplan.symbolic.extra.find_spec", lambda name: None)
    assert main(["reproduce", "--out", str(tmp_path)]) == 0
    assert "takes ten times as long: CasADi is not installed (pip install ctrlplan[fast])" in capsys.readouterr().err
