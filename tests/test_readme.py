"""The README: its length and order, its program and its lines as they stand, its figures, links and commands."""

import contextlib
import importlib
import io
import re
import shlex
from pathlib import Path

import control as ct
import numpy as np
import pytest
from readme_figure import figure

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.planning import plan_length
from ctrlplan.studies.crane import obstacle_waypoints

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
LINES = TEXT.splitlines()
PROGRAM = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)[1]
JOBS = re.findall(r"^\| (.+?) \| `(.+?)` \| (.+?) \|$", TEXT[: TEXT.index("## What is verified")], re.MULTILINE)


def section(heading):
    """Text between a heading and the next."""
    return TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Names that the program leaves, what it printed, and the folder in which it ran."""
    folder, names, said = tmp_path_factory.mktemp("readme"), {}, io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said):
        exec(PROGRAM, names)
    return names, said.getvalue(), folder


# Its form


def test_it_can_be_read_in_ten_minutes():
    assert len(LINES) <= 120


def test_it_has_this_order():
    """What it is, the commands, a figure, the program, where planning does not pay, jobs, evidence, citing, adding."""
    marks = [
        "ctrlplan plans the reference",
        "python3 -m pip install . && ctrlplan reproduce --out report\n",
        'python3 -m pip install ".[test]" && python3 -m pytest -n auto\n',
        "![",
        "## Your loop in twelve lines",
        "## When planning does not pay",
        "## What to call",
        "## What is verified",
        "## How to cite",
        "## How to add",
    ]
    places = [TEXT.index(mark) for mark in marks]
    assert places == sorted(places)
    assert re.findall(r"^## .*", TEXT, re.MULTILINE)[0] == "## Your loop in twelve lines"
    assert TEXT.index("| ratio |") > TEXT.index("## What is verified")


def test_its_links_lead_somewhere():
    targets = [target for target in re.findall(r"\]\(([^)]+)\)", TEXT) if not target.startswith("https://")]
    assert len(targets) > 10
    assert not [target for target in targets if not (ROOT / target).is_file()]


def test_files_and_names_in_it_exist():
    names = set(re.findall(r"\bcp((?:\.[A-Za-z_]+)+)\(?", TEXT))
    assert len(names) > 20
    for name in names:
        thing = cp
        for part in name.strip(".").split("."):
            thing = getattr(thing, part)
    for path in re.findall(r"`((?:tests|ctrlplan|\.ci)/[^`\s]+)`", TEXT):
        assert (ROOT / path).exists(), path


def test_figures_are_told_in_words():
    """A package index shows no pictures of a repository without an address."""
    for words, target in re.findall(r"!\[(.*?)\]\((.*?)\)", TEXT):
        assert len(words.split()) > 8, target


def test_the_package_is_cited_by_its_version():
    assert f"ctrlplan {cp.__version__}," in section("How to cite")


# Its program


def test_the_program_has_twelve_lines(ran):
    assert len(PROGRAM.splitlines()) == 12
    _, said, folder = ran
    for title in ("Settling time", "Overshoot on the final value"):
        assert re.search(rf"^ *{title} .*\*$", said, re.MULTILINE)  # the best value marked
    assert (folder / "servo.html").stat().st_size > 10_000


def test_the_program_shows_what_is_said(ran):
    found = ran[0]["result"].metrics
    said = section("Your loop in twelve lines").split("```")[2]
    settled = [float(number) for number in re.findall(r"([\d.]+) s\b", said)]
    assert settled == [round(found[plan]["settling_time"], 2) for plan in ("step", "planned")]
    overshoot = [float(number) for number in re.findall(r"([\d.]+) %", said)]
    assert overshoot == [round(found[plan]["overshoot_final"], 1) for plan in ("step", "planned")]


def test_the_metrics_of_the_program_are_those_of_the_transfer_function(ran):
    """Overshoot and voltage by scipy's state space, at times of its own."""
    from scipy.signal import lsim

    names = ran[0]
    words = re.search(r"!\[(.*?)\]", TEXT)[1]
    t = np.linspace(0.0, 0.6, 6001)
    output, voltage = (ct.ss(system) for system in (names["loop"], ct.feedback(names["C"], names["P"])))
    for plan, reference in (("Step", np.ones_like(t)), ("Planned move", names["plan"](t))):
        y, u = (lsim((s.A, s.B, s.C, s.D), reference, t)[1] for s in (output, voltage))
        percent, volts = re.search(rf"{plan}: (\d+) % overshoot, (\d+) V", words).groups()
        assert round(100.0 * (y.max() - 1.0)) == int(percent)
        assert round(np.abs(u).max()) == int(volts)


def test_its_figure_is_drawn_of_the_program(ran):
    names = ran[0]
    left, right = figure().axes
    for axes, system in ((left, names["loop"]), (right, ct.feedback(names["C"], names["P"]))):
        drawn = [line.get_ydata() for line in axes.lines if line.get_linewidth() > 1.5]
        for line, plan in zip(drawn, (cp.Step(1.0), names["plan"]), strict=True):
            np.testing.assert_array_equal(line, cp.simulate(system, names["t"], plan).outputs)


# Its table of jobs


def test_there_is_a_job_a_line():
    assert len(JOBS) >= 20
    assert len({job for job, _, _ in JOBS}) == len(JOBS)


@pytest.mark.parametrize("line", [job[1] for job in JOBS], ids=[job[0] for job in JOBS])
def test_a_line_runs_after_the_program(line, ran, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if line.startswith("ctrlplan "):
        with pytest.raises(SystemExit) as ended:
            main([*shlex.split(line)[1:], "--help"])
        assert ended.value.code == 0
    else:
        exec(line, dict(ran[0]))


@pytest.mark.parametrize("module", re.findall(r'`help\("(.*?)"\)`', TEXT))
def test_modules_that_are_referred_to_have_a_reference(module):
    assert importlib.import_module(module).__doc__.count("\n") > 20


# Where planning does not pay


def test_a_move_faster_than_the_loop():
    stated = re.search(
        r"k = 5 .*? step settles in ([\d.]+) s, the plan of 1 s in ([\d.]+) s", section("When planning does not pay")
    )
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    plans = {"step": cp.Step(1.0), "planned": cp.TrigSpline(move, alpha=1.0)}
    found = cp.compare(cp.plants.integrator_lag_loop(5.0), plans, np.linspace(0, 20, 4001), measures=["settling_time"])
    assert [float(number) for number in stated.groups()] == [
        round(found.metrics[plan]["settling_time"], 1) for plan in plans
    ]


def test_a_mode_that_is_known():
    stated = re.search(
        r"k = 100 a ZV-shaped step settles in ([\d.]+) s, the trigonometric plan in ([\d.]+) s",
        section("When planning does not pay"),
    )
    damping = 0.5 / np.sqrt(100.0)  # s^2 + s + 100
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    plans = {"shaped": cp.Shaper.zv(10.0, damping)(cp.Step(1.0)), "planned": cp.TrigSpline(move, alpha=1.0)}
    loop = cp.plants.integrator_lag_loop(100.0)
    found = cp.compare(loop, plans, np.linspace(0, 10, 4001), measures=["settling_time"])
    assert [float(number) for number in stated.groups()] == [
        round(found.metrics[plan]["settling_time"], 2) for plan in plans
    ]


def test_segments_are_shorter_than_the_best_trigonometric_spline():
    stated = re.search(
        r"segments is ([\d.]+) m long,\s+that of the best trigonometric spline ([\d.]+) m",
        section("When planning does not pay"),
    )
    points = obstacle_waypoints()
    lengths = plan_length(cp.PiecewiseSpline(points)), cp.choose_alpha(points, "path").value
    assert [float(number) for number in stated.groups()] == [round(length, 2) for length in lengths]
