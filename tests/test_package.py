"""The package as a whole: what importing it costs, what it shows, and that every name is where it is said to be."""

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from strict import WARNINGS

import ctrlplan as cp

pytestmark = pytest.mark.every_combination

ROOT = Path(cp.__file__).parent
PROJECT = ROOT.parent
SUBPACKAGES = sorted(m.name for m in pkgutil.walk_packages(cp.__path__, "ctrlplan.") if m.ispkg and "._" not in m.name)

# The names that the design fixes, as far as they are built.
FIXED = (
    "Waypoint",
    "TrigSpline",
    "PolySpline",
    "PiecewiseSpline",
    "Step",
    "stack",
    "trajectory_from_dict",
    "load_trajectory",
    "create_source_iosystem",
    "create_governor_iosystem",
    "plants.integrator_lag_loop",
    "simulate",
    "read_log",
    "fit_feedforward",
    "compare",
    "sweep",
    "monte_carlo",
    "draws",
    "benefit",
    "Experiment",
    "Measure",
    "choose_alpha",
    "optimize_waypoints",
    "fastest",
    "avoid",
    "WaypointSpline",
    "AlphaChoice",
    "Avoidance",
    "Clearance",
    "Fastest",
    "Margins",
    "Optimum",
    "metrics.settling_time",
    "metrics.overshoot",
    "metrics.lag",
    "metrics.iae",
    "metrics.ise",
    "metrics.itae",
    "metrics.effort",
    "metrics.wandering",
)


def fresh(code):
    """Run code in an interpreter of its own, which must end well and say nothing."""
    done = subprocess.run([sys.executable, *WARNINGS, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# What importing it loads


# What is imported one after the other in a process: each may load no less than what was imported before it.
CHAINS = [
    [
        ("ctrlplan", {"control", "matplotlib", "scipy", "numpy", "jinja2", "tqdm", "pandas"}),
        ("ctrlplan.metrics", {"control", "matplotlib", "scipy", "jinja2", "tqdm", "pandas"}),
        ("ctrlplan.trajectories", {"control", "matplotlib", "jinja2", "tqdm", "pandas"}),
        ("ctrlplan.planning", {"control", "matplotlib", "jinja2", "tqdm", "pandas"}),
        ("ctrlplan.studies", {"matplotlib.backends.backend_svg", "jinja2", "pandas"}),
    ],
    [("ctrlplan.cli", {"control", "matplotlib", "scipy", "pandas"})],
]


@pytest.mark.parametrize("chain", CHAINS, ids=["library", "command"])
def test_an_import_loads_only_what_is_required(chain):
    steps = (
        f"import {what}\nloaded = {without!r} & set(sys.modules)\nassert not loaded, ({what!r}, loaded)\n"
        for what, without in chain
    )
    fresh("import sys\n" + "".join(steps))


@pytest.mark.slow
def test_names_are_loaded_on_first_use():
    fresh(
        "import sys, ctrlplan as cp\n"
        "cp.Waypoint\n"
        "assert 'ctrlplan.trajectories' in sys.modules\n"
        "assert not {'control', 'matplotlib', 'ctrlplan.systems', 'ctrlplan.studies'} & set(sys.modules)\n"
        "cp.metrics.iae\n"
        "assert 'control' not in sys.modules\n"
        "cp.simulate\n"
        "assert 'control' in sys.modules\n"
    )


@pytest.mark.slow
def test_planning_works_where_control_is_not_installed():
    fresh(
        "import sys\n"
        "sys.modules['control'] = sys.modules['matplotlib'] = None\n"
        "import ctrlplan as cp\n"
        "plan = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], alpha=1.0)\n"
        "assert abs(plan(0.5) - 0.5) < 1e-12 and plan.peak(1)[0] > 1.875\n"
        "assert abs(cp.metrics.iae([0, 1, 2], [1, 1, 1]) - 2) < 1e-14\n"
    )


# What it shows


def test_every_name_is_there_and_is_listed():
    assert len(cp.__all__) == len(set(cp.__all__))
    for name in cp.__all__:
        assert getattr(cp, name) is not None
    assert set(dir(cp)) == {*cp.__all__, "__version__"}


def test_every_name_is_that_of_its_home():
    for name in cp.__all__:
        thing = getattr(cp, name)
        home = thing.__name__ if inspect.ismodule(thing) else thing.__module__
        assert home.startswith("ctrlplan.")
        assert thing.__doc__


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'ctrlplan' has no attribute 'Spline'"):
        cp.Spline  # noqa: B018
    assert not hasattr(cp, "_nothing")


def test_star_brings_exactly_the_names():
    names = {}
    exec("from ctrlplan import *", names)
    assert names.keys() - {"__builtins__"} == set(cp.__all__)


@pytest.mark.parametrize("name", FIXED)
def test_names_of_the_design_are_there(name):
    thing = cp
    for part in name.split("."):
        thing = getattr(thing, part)
    assert callable(thing)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("Waypoint", ["time", "position", "velocity", "acceleration", "jerk", "snap"]),
        ("create_source_iosystem", ["plan", "derivatives"]),
        ("plants.integrator_lag_loop", ["gain"]),
        ("simulate", ["system", "timepts", "inputs", "initial_state"]),
        ("read_log", ["path_or_frame"]),
        ("fit_feedforward", ["log", "plan"]),
        ("compare", ["loop", "plans", "timepts"]),
        ("sweep", ["build", "values", "plans", "timepts"]),
        ("monte_carlo", ["loop", "draws", "plans", "timepts"]),
        ("benefit", ["comparison", "loop"]),
        ("Experiment", ["plans", "timepts"]),
        ("Measure", ["title", "unit", "of", "function"]),
        ("create_governor_iosystem", ["loop", "dt", "limits"]),
        ("choose_alpha", ["waypoints", "objective"]),
        ("optimize_waypoints", ["waypoints"]),
        ("fastest", ["plan", "limits"]),
        ("avoid", ["plan", "obstacles"]),
        ("Step", ["final", "initial", "time", "labels"]),
        ("metrics.settling_time", ["timepts", "y", "final", "initial", "band"]),
        ("metrics.overshoot", ["timepts", "y", "final", "initial", "reference"]),
    ],
)
def test_parameters_of_the_design_come_first(name, parameters):
    thing = cp
    for part in name.split("."):
        thing = getattr(thing, part)
    known = inspect.signature(thing).parameters.values()
    assert [p.name for p in known][: len(parameters)] == parameters
    assert all(p.kind is p.POSITIONAL_OR_KEYWORD for p in list(known)[: len(parameters)])


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_all_is_exactly_what_is_visible(name):
    module = importlib.import_module(name)
    exported = module.__all__
    assert len(exported) == len(set(exported))
    files = {m.name for m in pkgutil.iter_modules(module.__path__)}
    visible = {n for n in dir(module) if not n.startswith("_")} - files
    assert visible == set(exported) - files
    for export in exported:
        assert getattr(module, export).__doc__


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_every_public_function_and_class_is_described(name):
    module = importlib.import_module(name)
    for export in module.__all__:
        thing = getattr(module, export)
        if inspect.isfunction(thing) or inspect.isclass(thing):
            first = inspect.getdoc(thing).splitlines()[0]
            assert re.match(r"[A-Z(].*[.:]$", first) or first.endswith(","), f"{name}.{export}: {first}"


# Not for users: what printing renders, and what other folders of the package read.
INTERNAL = {"Table", "Linear", "TimeSignal", "TimeSignals", "DisagreementError", "Limited", "NewtonSpline", "PathMaps"}


def results_of(thing):
    """Classes of the package that a function returns, or that fields and public methods of a class have."""
    things = [inspect.unwrap(thing)]
    annotations = [getattr(things[0], "__annotations__", {}).get("return", "")] if inspect.isfunction(things[0]) else []
    if inspect.isclass(thing):
        annotations += [text for name, text in inspect.get_annotations(thing).items() if name[0] != "_"]
        methods = [getattr(m, "__func__", m) for name, m in vars(thing).items() if name[0] != "_"]
        annotations += [m.__annotations__.get("return", "") for m in methods if inspect.isfunction(m)]
    known = vars(sys.modules[things[0].__module__])
    found = [known.get(word) for text in annotations for word in re.findall(r"[A-Za-z_]\w*", str(text))]
    return {kind for kind in found if inspect.isclass(kind) and kind.__module__.startswith("ctrlplan.")}


@pytest.mark.parametrize("name", [name for name in cp.__all__ if name not in ("metrics", "plants")])
def test_results_and_what_they_consist_of_are_public(name):
    modules = [cp, *map(importlib.import_module, SUBPACKAGES)]
    public = {id(getattr(module, export)) for module in modules for export in module.__all__}
    missing = {kind.__name__ for kind in results_of(getattr(cp, name)) if id(kind) not in public}
    assert missing <= INTERNAL


@pytest.mark.parametrize("name", SUBPACKAGES)
def test_every_field_of_a_result_is_described(name):
    module = importlib.import_module(name)
    for kind in (getattr(module, export) for export in module.__all__):
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            words = set(re.findall(r"\w+", " ".join(base.__doc__ or "" for base in kind.__mro__)))
            given = {field.name for field in dataclasses.fields(kind) if field.name[0] != "_"}
            assert given <= words, f"{name}.{kind.__name__}"


def test_subpackages_are_those_of_the_map():
    assert "ctrlplan.planning" in SUBPACKAGES
    assert {"ctrlplan.trajectories", "ctrlplan.systems", "ctrlplan.simulation", "ctrlplan.metrics"} <= set(SUBPACKAGES)
    assert {"ctrlplan.studies", "ctrlplan.reports", "ctrlplan.systems.plants"} <= set(SUBPACKAGES)


# Its index


INDEX, GLOSSARY = cp.__doc__.split("\nGlossary\n")


def test_the_index_is_two_screens():
    lines = cp.__doc__.splitlines()
    assert len(lines) <= 100
    assert max(map(len, lines)) <= 110
    assert len(GLOSSARY.strip().splitlines()) <= 12


def test_every_export_is_in_the_index():
    assert [name for name in cp.__all__ if not re.search(rf"\b{name}\b", INDEX)] == []


def test_every_name_in_the_index_exists():
    rows = re.findall(r"^    ([A-Za-z_, ]+?)(?:  .*)?$", INDEX, re.MULTILINE)
    listed = {name for row in rows for name in row.split(", ")}
    compound = set(re.findall(r"\b(?:[a-z]+(?:_[a-z]+)+|[A-Z][a-z]+[A-Z]\w+)\b", INDEX))
    assert len(listed) > 40
    assert {name for name in listed | compound if name not in cp.__all__} == set()


@pytest.mark.parametrize("line", GLOSSARY.strip("\n").splitlines())
def test_the_glossary_explains_terms_that_are_used(line):
    term = re.match(r"    (\w+)  ", line)
    used = [path for path in ROOT.rglob("*.py") if term and re.search(rf"\b{term[1]}\b", path.read_text("utf-8"))]
    assert len(used) > 3 or line.startswith("               ")


# One version, and what the package carries


def test_the_version_is_in_one_place():
    assert re.fullmatch(r"\d+\.\d+\.\d+", cp.__version__)
    assert metadata.version("ctrlplan") == cp.__version__
    written = [p for p in ROOT.rglob("*.py") if f'"{cp.__version__}"' in p.read_text(encoding="utf-8")]
    assert written == [ROOT / "__init__.py"]


def test_the_project_reads_its_version_from_the_package():
    path = PROJECT / "pyproject.toml"
    if not path.exists():
        pytest.skip("installed without its project file")
    project = tomllib.loads(path.read_text(encoding="utf-8"))
    assert "version" not in project["project"]
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "ctrlplan.__version__"}


def test_the_newest_change_is_this_version():
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest[1] == cp.__version__


def test_it_carries_its_licence_its_types_and_its_templates():
    for name in ("LICENSE", "py.typed", "CHANGELOG.md", "reports/templates/page.html"):
        assert (ROOT / name).is_file()


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_every_file_says_what_it_is(path):
    assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))


@pytest.mark.slow
def test_documents_that_are_cited_are_in_the_repository():
    """Whoever reads a file has the documents that it refers to."""
    folders = [PROJECT / "ctrlplan", PROJECT / "tests", PROJECT / "notebooks"]
    files = [
        path for folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".ipynb", ".toml", ".md")
    ]
    cited = {
        (path.relative_to(PROJECT), name)
        for path in [*files, PROJECT / "README.md", PROJECT / "pyproject.toml"]
        for name in re.findall(r"\b[A-Z]{3,}\.md\b", path.read_text(encoding="utf-8"))
    }
    present = {path.name for path in [*PROJECT.glob("*.md"), *files]}
    assert cited
    assert not {(str(path), name) for path, name in cited if name not in present}
