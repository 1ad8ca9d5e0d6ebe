"""The recipes of the README's table "to add one", followed in a copy of the package, and the new things that appear.

Every recipe is a new file or two and the lines that it says; nothing else of
the copy is changed. One process imports the copy and looks for all of them: it
is another one, because this one has imported the package as it is.
"""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from strict import WARNINGS

import ctrlplan


@dataclass(frozen=True)
class Recipe:
    """What is added to the package, and what is then to be seen.

    `says` is the recipe in the README's words, `files` are new ones with their
    text, `lines` are (file, line after which, line) of files in the package.
    `seen` runs in the copy, in a folder of its own.
    """

    says: str
    files: dict = field(default_factory=dict)
    lines: tuple = ()
    seen: str = ""


COMMON = '''
import contextlib
import io
import json
from pathlib import Path
from unittest.mock import patch
import control as ct
import numpy as np
import ctrlplan as cp
from ctrlplan.cli import main
MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
STUDY = """
title = "Of my own"
t_end = 6.0
samples = 301
[loop]
kind = "linear"
num = [1.0]
den = [1.0, 1.0, 0.0]
gain = 5.0
[[plans]]
family = "polynomial"
[[waypoints]]
time = 0.0
x = [0.0]
[[waypoints]]
time = 1.0
x = [2.0]
[[waypoints]]
time = 2.0
x = [1.0]
"""

def page(*command):
    """Page, its drawings blank, and results that a command writes."""
    said = io.StringIO()
    blank = patch("ctrlplan.reports.shown.to_svg", lambda figure, key: "<svg></svg>")
    with blank, contextlib.redirect_stderr(said):
        assert main([*command, "--out", "out"]) == 0, said.getvalue()
    found = json.loads(Path("out", "results.json").read_text())["studies"]
    return Path("out", "index.html").read_text(), found
'''

RECIPES = {}

RECIPES["metric"] = Recipe(
    says="a metric: a function, its name in `metrics/__init__.py`, and one entry of `MEASURES`",
    files={
        "metrics/_last.py": '''
"""The error that a record ends with."""

import numpy as np


def last_error(timepts, error):
    """Magnitude of the error at the last sample, one for each row."""
    return np.abs(np.asarray(error))[..., -1]
'''
    },
    lines=(
        ("metrics/__init__.py", "", "from ctrlplan.metrics._last import last_error"),
        ("metrics/__init__.py", "__all__ = [", '    "last_error",'),
        (
            "studies/measures.py",
            "MEASURES = {",
            '    "last_error": Measure("Error at the end", "{y}", "response", '
            "lambda seen: metrics.last_error(seen.t, seen.error)),",
        ),
    ),
    seen="""
assert cp.metrics.last_error([0.0, 1.0], [0.0, -2.0]) == 2.0
loop = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 3.0)  # 3/(s + 1) in unity feedback keeps 1/4
found = cp.compare(loop, {"mine": cp.PolySpline(MOVE)}, np.linspace(0, 20, 401))
assert abs(found.metrics["mine"]["last_error"] - 0.25) < 1e-9
Path("study.toml").write_text(STUDY)
html, results = page("report", "study.toml")
assert "Error at the end" in html
assert "last_error" in results["study"]["plans"]["polynomial"]["metrics"]
""",
)

RECIPES["objective"] = Recipe(
    says="an objective: a function of a plan, one line in `OBJECTIVES`",
    lines=(
        (
            "planning/objectives.py",
            "OBJECTIVES: dict[ObjectiveName, Objective] = {",
            '    "speed_midway": speed_midway,',
        ),
        (
            "planning/objectives.py",
            "Objective = Callable[[Trajectory], float]",
            '''

def speed_midway(plan):
    """Speed in the middle of a plan."""
    return float(np.linalg.norm(plan(0.5 * (plan.start + plan.end), 1)))

''',
        ),
    ),
    seen="""
choice = cp.choose_alpha(MOVE, "speed_midway")
slow = [float(cp.TrigSpline(MOVE, alpha=a, warn=False)(0.5, 1)) for a in np.linspace(0, 5, 51)]
assert choice.value <= min(slow) * (1 + 1e-6)
assert abs(choice.value - float(choice.plan(0.5, 1))) < 1e-12
""",
)

RECIPES["plant"] = Recipe(
    says="a plant: one file, one export",
    files={
        "systems/plants/tank.py": '''
"""A tank that leaks."""

import control as ct


def tank(area=1.0, name="tank"):
    """Level z of a tank of an area [m^2] under an inflow q [m^3/s]; it leaks z m^3/s."""
    return ct.nlsys(lambda t, x, u, params: (u - x) / area, inputs="q", outputs="z", states="z", name=name)
'''
    },
    lines=(
        ("systems/plants/__init__.py", "", "from ctrlplan.systems.plants.tank import tank"),
        ("systems/plants/__init__.py", "__all__ = [", '    "tank",'),
    ),
    seen='''
t = np.linspace(0, 5, 51)
assert np.abs(cp.simulate(cp.plants.tank(2.0), t, 1.0).outputs - (1 - np.exp(-t / 2))).max() < 1e-7
Path("study.toml").write_text(STUDY.replace('kind = "linear"', 'kind = "python:mine:build"').replace(
    """num = [1.0]
den = [1.0, 1.0, 0.0]
gain = 5.0
""", ""))
Path("mine.py").write_text("""
import control as ct
import ctrlplan as cp
def build() -> ct.InputOutputSystem:
    control = cp.create_pid_iosystem(10.0, 10.0, 0.0, 0.1, inputs=["r", "z"], outputs="q")
    return ct.interconnect([control, cp.plants.tank()], inputs=["r"], outputs=["z", "q"])
""")
html, results = page("report", "study.toml")
assert results["study"]["plans"]["polynomial"]["metrics"]["settling_time"] > 0
''',
)

RECIPES["study"] = Recipe(
    says="a study: one file, one line in `PAPER` or `ONLINE`",
    files={
        "studies/lag.py": '''
"""A lag behind a step and a plan."""

import control as ct
import numpy as np

from ctrlplan.studies.comparison import compare
from ctrlplan.studies.study import Study
from ctrlplan.trajectories import Waypoint


def lag_study(progress=True):
    """What a lag makes of the standard plans."""
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="lag")
    found = compare(lag, [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], np.linspace(0, 8, 401))
    return Study("lag", "A lag of one second", found, "What a lag makes of a plan.")
'''
    },
    lines=(
        ("studies/__init__.py", "", "from ctrlplan.studies.lag import lag_study"),
        ("studies/__init__.py", "PAPER = {", '    "lag": lag_study,'),
    ),
    seen="""
from ctrlplan.studies import PAPER
for name in list(PAPER):
    if name != "lag":
        del PAPER[name]  # they take half a minute
html, results = page("reproduce")
assert "A lag of one second" in html and "What a lag makes of a plan." in html
assert abs(results["lag"]["plans"]["step"]["metrics"]["settling_time"] - np.log(50)) < 1e-6
""",
)

RECIPES["section"] = Recipe(
    says="a frozen dataclass derived from `Section` in `studies/sections.py`, and a function under `@draw.register`",
    lines=(
        (
            "studies/sections.py",
            "# Cranes and loops",
            '''
@dataclass(frozen=True)
class Phase(Section):
    """One output against its reference, with the largest difference of each plan."""

    output: str = "y"
''',
        ),
        (
            "reports/sections.py",
            "from ctrlplan.studies.study import Study",
            "from ctrlplan.studies.sections import Phase",
        ),
        ("reports/sections.py", "from functools import singledispatch", "import numpy as np"),
        (
            "reports/sections.py",
            "# Cranes and loops",
            """
@draw.register
def _(section: Phase, study: Study) -> Part:
    import numpy as np

    from ctrlplan.reports.style import Drawing

    drawing, rows = Drawing(None, (1, 1), (5.0, 4.0)), []
    for name, response in study.comparison.responses.items():
        reference = study.comparison.plans[name](response.time)
        output = np.atleast_2d(response.outputs)[response.output_labels.index(section.output)]
        drawing.column[0].plot(reference, output, label=name)
        rows.append([name, number(float(np.abs(reference - output).max()))])
    drawing.label_x("reference")
    picture = Picture("phase", drawing.finish(), section.caption or "Output over reference.")
    return Part([picture, Table(["plan", "largest difference"], rows)], heading="Output over reference")
""",
        ),
    ),
    seen="""
from ctrlplan.reports import draw, write_page
from ctrlplan.studies import Study
from ctrlplan.studies.sections import Phase, PlanCurves
found = cp.compare(cp.plants.integrator_lag_loop(5.0), {"mine": cp.PolySpline(MOVE)}, np.linspace(0, 5, 101))
study = Study("own", "Own", found, sections=(PlanCurves(), Phase()))
html = write_page([study], "own.html", "Own").read_text()
assert '<figure id="own-phase"' in html and "largest difference" in html
picture, table = draw(Phase(caption="Mine."), study).blocks
assert isinstance(picture.plot, ct.ControlPlot) and picture.caption == "Mine."
assert len(picture.plot.axes.ravel()[0].lines) == 1
assert [row[0] for row in table.rows] == ["mine"]
""",
)

NATURAL = '''
"""The natural cubic spline."""

import numpy as np
from scipy.interpolate import CubicSpline

from ctrlplan.trajectories.waypoint_spline import WaypointSpline


class NaturalSpline(WaypointSpline):
    """Natural cubic spline through positions."""

    family = "natural"
    _spline: CubicSpline

    def __init__(self, waypoints, *, labels=None):
        points = tuple(waypoints)
        times = np.array([point.time for point in points])
        names = labels or points[0].labels or [f"y{i + 1}" for i in range(points[0].naxes)]
        spline = CubicSpline(times, [point.position for point in points], bc_type="natural")
        self._set_fields(waypoints=points, labels=tuple(names), breakpoints=times, _spline=spline)

    def segment_jet(self, segment, s, order):
        c = self._spline.c[:, segment]  # (4, naxes), the highest power first
        rows = []
        for _ in range(order + 1):
            rows.append(sum(c[-1 - k][:, None] * s**k for k in range(len(c))) + 0.0 * s)
            c = c[:-1] * np.arange(len(c) - 1, 0, -1)[:, None] if len(c) > 1 else 0.0 * c
        return np.array(rows)
'''

RECIPES["family"] = Recipe(
    says="one file, its name in `trajectories/__init__.py` and in `_EXPORTS` of `ctrlplan/__init__.py`",
    files={"trajectories/natural.py": NATURAL},
    lines=(
        ("trajectories/__init__.py", "", "from ctrlplan.trajectories.natural import NaturalSpline"),
        ("trajectories/__init__.py", "__all__ = [", '    "NaturalSpline",'),
        ("__init__.py", '    "trajectories": (', '        "NaturalSpline",'),
    ),
    seen="""
from scipy.interpolate import CubicSpline
assert "NaturalSpline" in cp.__all__ and "NaturalSpline" in dir(cp)
way = cp.NaturalSpline([cp.Waypoint(0, [0, 0]), cp.Waypoint(2, [5, 1]), cp.Waypoint(4, [10, 0])])
t = np.linspace(0, 4, 41)
exact = CubicSpline([0, 2, 4], [[0, 0], [5, 1], [10, 0]], bc_type="natural")
for nu in range(3):
    assert np.abs(way(t, nu) - exact(t, nu).T).max() < 1e-12
assert cp.avoid(way, [cp.Disc((2.0, 0.0), 0.5)], clearance=0.5).clearance.certified
assert abs(cp.fastest(way, {"y1_d1": 5.0}, hold="waypoints").duration - 2.0) < 1e-9
way.save("way.json")
assert np.array_equal(cp.load_trajectory("way.json")(t), way(t))
Path("study.toml").write_text(STUDY.replace('family = "polynomial"', 'family = "natural"'))
html, results = page("report", "study.toml")
assert list(results["study"]["plans"]) == ["natural"]
""",
)

RECIPES["method"] = Recipe(
    says="a method: a class with `name`, `why_not(prepared)` and `run(job)`, one file, one line in `METHODS`",
    files={
        "simulation/methods/rk4.py": '''
"""Classical Runge-Kutta steps of at most 1/64 s."""

import numpy as np

from ctrlplan.simulation.interpreted import InterpretedSolver
from ctrlplan.simulation.numerical import numerical


class RK4Solver(InterpretedSolver):
    """Classical Runge-Kutta steps between two times of a grid."""

    def advance(self, series, left, grid, state):
        """States at the times of a grid, (nstates, ngrid)."""
        found, t, x = [], left, state
        for end in grid.tolist():
            steps = max(1, int(np.ceil((end - t) * 64.0)))
            h = (end - t) / steps
            for k in range(steps):
                x = self.step(series, t + k * h, h, x)
            t = end
            found.append(x)
        return np.array(found).T.reshape(state.size, grid.size)

    def step(self, series, t, h, x):
        """State after a step of h seconds."""

        def rate(at, state):
            return self.rates(np.array([at]), state[:, None], series(at)[:, None])[:, 0]

        k1 = rate(t, x)
        k2 = rate(t + h / 2, x + h / 2 * k1)
        k3 = rate(t + h / 2, x + h / 2 * k2)
        k4 = rate(t + h, x + h * k3)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


class RK4:
    """Continuous systems by the classical Runge-Kutta method."""

    name = "rk4"

    def why_not(self, prepared):
        """Reason why a system is not continuous."""
        return "" if prepared.has_blocks and not prepared.is_discrete else f"{prepared.name} is not continuous"

    def run(self, job):
        """States at the times of a job."""
        return numerical(job, self)

    def solver(self, attempt):
        """Solver on the network's equations."""
        return RK4Solver(attempt.equations, attempt.tolerances, attempt.scales)

    def check(self, attempt):
        """Nothing to check."""
'''
    },
    lines=(
        ("simulation/methods/__init__.py", "", "from ctrlplan.simulation.methods.rk4 import RK4"),
        ("simulation/methods/__init__.py", "    Delegated(),", "    RK4(),"),
    ),
    seen="""
cubic = ct.nlsys(lambda t, x, u, p: -(x**3), None, inputs=0, outputs="x", states="x", name="cubic")
t = np.linspace(0, 2, 21)
found = cp.simulate(cubic, t, initial_state=1.0, method="rk4")
assert found.method == "rk4"
assert np.abs(found.outputs - (1 + 2 * t) ** -0.5).max() < 1e-7
try:
    cp.simulate(cubic, t, initial_state=1.0, method="rk5")
except ValueError as error:
    assert "rk4" in str(error)
else:
    raise AssertionError("an unknown method must be an error")
""",
)

RECIPES["law"] = Recipe(
    says="one line in `LAWS` gives it a name",
    lines=(
        (
            "systems/plants/crane/laws.py",
            "        FeedforwardLaw(),",
            "        OffsetLaw(),",
        ),
        (
            "systems/plants/crane/laws.py",
            "        return blocks.create_crane_feedforward_iosystem(crane)",
            '''

@dataclass(frozen=True)
class OffsetLaw(Law):
    """Set points that are wrong by a constant [m]."""

    name = "offset"
    order = 0
    continuity = -1
    offset: float = 0.1

    def build(self, crane):
        """Block of x_ref and z_ref, outputs D_ref and R_ref."""
        return ct.nlsys(
            None,
            lambda t, x, u, params: [u[0] - crane.drum_radius + self.offset, u[1]],
            inputs=["x_ref", "z_ref"],
            outputs=["D_ref", "R_ref"],
            name="offset",
        )

''',
        ),
    ),
    seen='''
rest = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
crane = cp.plants.Crane()
loop = cp.plants.crane_loop(crane, rest, "offset")
assert "offset" in [block.name for block in loop.syslist]
found = cp.simulate(loop, np.linspace(0, 0.5, 51), initial_state=loop.initial_state)
plain = cp.simulate(cp.plants.crane_loop(crane, rest, "setpoint"), np.linspace(0, 0.5, 51))
force = [r.outputs[r.output_labels.index("F")][0] for r in (found, plain)]
# At first the PID alone acts on the error of 0.1 m: Kp + Kd/Tf, and Kd = 3 M w - f with the trolley's mass.
kp, kd = 3 * 5000 * 5.0**2, 3 * 5000 * 5.0 - 20.0
assert abs(force[0] - force[1] - 0.1 * (kp + kd / 0.02)) < 1e-6 * force[0]
Path("study.toml").write_text("""
title = "Offset"
t_end = 4.0
samples = 41
[loop]
kind = "crane"
law = "offset"
[[plans]]
family = "polynomial"
[[waypoints]]
time = 0.0
x = [0.0, 0.0, 0.0]
z = [10.0, 0.0, 0.0]
[[waypoints]]
time = 2.0
x = [0.1, 0.0, 0.0]
z = [10.0, 0.0, 0.0]
""")
html, results = page("report", "study.toml")
assert results["study"]["plans"]["polynomial"]["metrics"]["error_after"] > 0
''',
)

RUNNER = """
import json, os, sys, tempfile, traceback

common, recipes = json.load(sys.stdin)
found = {}
for name, seen in recipes.items():
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names = {"__name__": name}
        try:
            exec(compile(common + seen, f"<{name}>", "exec"), names)
            found[name] = ""
        except BaseException:
            found[name] = traceback.format_exc()
        os.chdir("/")
print(json.dumps(found))
"""


def added(path, after, line):
    """Write a line into a file after another that stands there once; before the imports where that is empty."""
    text = path.read_text(encoding="utf-8")
    if after:
        assert text.count(f"{after}\n") == 1, f"{after!r} must stand once in {path.name}"
        text = text.replace(f"{after}\n", f"{after}\n{line}\n")
    else:
        text = text.replace("\nfrom ", f"\n{line}\nfrom ", 1)
    path.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """What became of each recipe: its traceback, or nothing."""
    root = tmp_path_factory.mktemp("recipes")
    package = root / "ctrlplan"
    shutil.copytree(Path(ctrlplan.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    for recipe in RECIPES.values():
        for name, text in recipe.files.items():
            assert not (package / name).exists()
            (package / name).write_text(text.lstrip(), encoding="utf-8")
        for name, after, line in recipe.lines:
            added(package / name, after, line)
    command = [sys.executable, *WARNINGS, "-c", RUNNER]
    given = json.dumps([COMMON, {name: recipe.seen for name, recipe in RECIPES.items()}])
    paths = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths, "MPLBACKEND": "agg"}
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False, env=environment, cwd=root)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_in_the_readme_word_for_word(name):
    readme = Path(__file__).parents[1].joinpath("README.md").read_text(encoding="utf-8")
    table = readme[readme.index("| to add one |") :].split("\n\n")[0]
    assert RECIPES[name].says in table


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_what_a_recipe_adds_appears(seen, name):
    assert not seen[name], seen[name]
