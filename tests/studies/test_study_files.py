"""A study file is what it says: every family, loop and unit that it can state."""

import csv
import io
import tomllib
from pathlib import Path

import control as ct
import numpy as np
import pytest
from natural import NaturalCubic
from repetitions import one_in
from study_text import VALID, Verbatim, to_toml, valid

import ctrlplan as cp
from ctrlplan.studies.files import StudyError, StudyFile, build_loop, load_study
from ctrlplan.studies.plan_files import plan_files
from ctrlplan.trajectories.export import Options
from ctrlplan.trajectories.waypoint_spline import families

FAMILIES = {"step": cp.Step, **{name: k for name, k in families().items() if k.__module__.startswith("ctrlplan.")}}
REST = [{"time": 0.0, "x": [0.0, 0.0, 0.0]}, {"time": 16.0, "x": [20.0, 0.0, 0.0]}]
PROFILE = {"velocity": 3.0, "acceleration": 2.0, "jerk": 4.0}

# The study file of the design, around a linear loop.
DESIGN = """
title = "Over the wall"
t_end = 30.0
[loop]
kind = "linear"
num = [1.0]
den = [1.0, 1.0, 0.0]
gain = 100.0
[[plans]]
name = "trigonometric"
family = "trigonometric"  # polynomial, piecewise, step
alpha = 4.0
[[waypoints]]
time = 0.0
x = [0.0, 0.0, 0.0]       # position, velocity, acceleration, ... as many as prescribed
[[waypoints]]
time = 6.0
x = [5.0, 1.0, 0.1]
[[waypoints]]
time = 16.0
x = [20.0, 0.0, 0.0]
"""


@pytest.fixture
def stated(tmp_path):
    """Write data or text as a study file and load it."""

    def load(data, name="study.toml"):
        path = tmp_path / name
        path.write_text(data if isinstance(data, str) else to_toml(data), encoding="utf-8")
        return load_study(path)

    return load


def test_the_writer_of_these_tests_writes_toml():
    odd = valid(when=Verbatim("1979-05-27"), odd=[1, [True, 'q"\n'], {"a b": -2.5e300}], nan=float("inf"))
    again = tomllib.loads(to_toml(odd))
    assert str(again.pop("when")) == odd.pop("when")
    assert again == odd


def test_the_example_of_the_design(stated):
    found = stated(DESIGN, "wall.toml")
    assert isinstance(found, StudyFile)
    assert (found.name, found.title, found.t_end) == ("wall", "Over the wall", 30.0)
    assert found.waypoints == (
        cp.Waypoint.from_jets(0.0, x=[0, 0, 0]),
        cp.Waypoint.from_jets(6.0, x=[5, 1, 0.1]),
        cp.Waypoint.from_jets(16.0, x=[20, 0, 0]),
    )
    (plan,) = found.plans.values()
    assert isinstance(plan, cp.TrigSpline)
    assert (plan.alpha, plan.labels) == (4.0, ("x",))
    t = np.linspace(-1, 17, 181)
    np.testing.assert_array_equal(plan(t, 1), cp.TrigSpline(found.waypoints, alpha=4.0)(t, 1))


def test_running_it_is_comparing_its_plans(stated):
    study = stated(DESIGN).run()
    plan = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(6, 5, 1, 0.1), cp.Waypoint(16, 20, 0, 0)], alpha=4.0)
    times = np.union1d(np.linspace(0, 30, 4001), [0.0, 6.0, 16.0])
    loop = cp.plants.integrator_lag_loop(100.0, outputs=("y", "u"))
    alone = cp.compare(loop, {"trigonometric": plan}, times, waypoints=plan.waypoints)
    assert study.comparison.metrics == alone.metrics
    assert study.comparison.title == study.title == "Over the wall"
    assert study.name == "study"
    assert list(study.results()["plans"]) == ["trigonometric"]


def test_without_plans_the_standard_set_is_compared(stated):
    data = valid()
    del data["plans"]
    assert list(stated(data).plans) == ["step", "polynomial", "trigonometric", "piecewise"]


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_every_family_can_be_asked_for(family, stated):
    options = getattr(FAMILIES[family], "options", ())
    choice = {"alpha": 1.5} if "alpha" in options else {}
    limits = {name: value for name, value in PROFILE.items() if name in options}
    points = {"waypoints": REST} if limits else {}
    (plan,) = stated(valid(plans=[{"family": family, **choice, **limits}], **points)).plans.values()
    assert type(plan) is FAMILIES[family]
    assert [float(getattr(plan, name)[0]) for name in limits] == list(limits.values())
    assert plan.labels == ("x",)
    assert plan(16.0) == pytest.approx(20.0, abs=1e-12)
    assert plan(-1.0) == pytest.approx(0.0, abs=1e-12)
    if choice:
        assert plan.alpha == 1.5


def test_families_are_those_of_the_design():
    assert set(FAMILIES) == {"trigonometric", "polynomial", "piecewise", "step", "s_curve", "trapezoid"}


NATURAL = """
from natural import NaturalCubic

class Heavy(NaturalCubic):
    family = "heavy"
"""


@pytest.fixture
def kinds(monkeypatch):
    monkeypatch.setattr(cp.Trajectory, "kinds", dict(cp.Trajectory.kinds))


@pytest.mark.parametrize("by", ["imported", "module"])
def test_a_spline_of_a_users_own_can_be_asked_for(by, stated, tmp_path, kinds):
    points = [{"time": 0.0, "x": [0.0]}, {"time": 6.0, "x": [5.0]}, {"time": 16.0, "x": [20.0]}]
    (tmp_path / "mine_natural.py").write_text(NATURAL)
    family = {"imported": "NaturalCubic", "module": "python:mine_natural:Heavy"}[by]
    for _ in range(2):  # a module that is loaded again defines the same kind again
        study = stated(valid(plans=[{"family": family, "weight": 2.0}], waypoints=points))
        ((name, plan),) = study.plans.items()
        assert isinstance(plan, NaturalCubic)
        assert name == {"imported": "NaturalCubic", "module": "heavy"}[by]
        np.testing.assert_allclose(plan([0.0, 6.0, 16.0]), [0.0, 10.0, 40.0], rtol=0, atol=1e-12)
        assert type(plan).__name__ in " ".join(map(str, study.parameters().values()))
    assert study.run().comparison.metrics[name]


@pytest.mark.parametrize(
    ("family", "message"),
    [
        ("python:mine_natural:Nothing", "must name a class of a module.*AttributeError"),
        ("python:mine_natural:np", "derived from WaypointSpline, got module"),
        ("python:mine_natural:Polynomial", "derived from WaypointSpline, got Polynomial"),
        ("python:mine_natural:WaypointSpline", "derived from WaypointSpline, got WaypointSpline"),
        ("python:nowhere_at_all:Heavy", "must name a class of a module.*nowhere_at_all"),
        ("python:a b:Heavy", "must be identifiers"),
        ("python:mine_natural:Broken", "construction must not fail, got KeyError: 'lost'"),
    ],
)
def test_a_kind_that_cannot_be_made_says_why(family, message, stated, tmp_path, kinds):
    broken = "\nclass Broken(NaturalCubic):\n    def __init__(self, *args, **kwargs):\n        raise KeyError('lost')\n"
    others = "import numpy as np\nfrom numpy.polynomial import Polynomial\nfrom ctrlplan import WaypointSpline\n"
    (tmp_path / "mine_natural.py").write_text(others + NATURAL + broken)
    with pytest.raises(StudyError, match=rf"plans\[0\].*{message}") as error:
        stated(valid(plans=[{"family": family}]))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("plan", "waypoints", "message"),
    [
        (
            {"family": "s_curve", "velocity": 3.0, "acceleration": 2.0},
            REST,
            "jerk: must be a finite number or a list of finite numbers, got none",
        ),
        ({"family": "trapezoid", "velocity": 3.0, "acceleration": 2.0}, None, "must have exactly two waypoints, got 3"),
        ({"family": "s_curve", **PROFILE, "velocity": 1.0}, REST, "within the 16 s between its waypoints, got 2"),
        (
            {"family": "s_curve", **PROFILE, "velocity": [1.0, 2.0]},
            REST,
            r"velocity must be a scalar or of shape \(1,\)",
        ),
    ],
)
def test_a_profile_that_does_not_fit_the_waypoints_says_why(plan, waypoints, message, stated):
    data = valid(plans=[plan]) if waypoints is None else valid(plans=[plan], waypoints=waypoints)
    with pytest.raises(StudyError, match=rf"plans\[0\][:.].*{message}"):
        stated(data)


def test_choices_reach_the_plan(stated):
    plans = [
        {"family": "trigonometric", "alpha": 1.0, "gamma": 0.4, "name": "turned"},
        {"family": "trigonometric", "alpha": 1.0, "degree": 7, "name": "spare"},
        {"family": "polynomial", "degree": 9, "smooth": 4, "name": "long"},
    ]
    data = valid(plans=plans)
    data["waypoints"][1]["x"] = [5.0, 1.0]  # eight constraints: an even number has a gamma
    found = stated(data).plans
    assert found["turned"].gamma == (0.4,)
    assert found["spare"].degree == (7,)
    assert found["long"].degree == (9,)
    points = stated(data).waypoints
    expected = cp.PolySpline(points, degree=9, smooth=4)
    np.testing.assert_array_equal(found["long"](np.arange(17.0)), expected(np.arange(17.0)))


@pytest.mark.slow
@pytest.mark.parametrize("family", one_in(2, ["trigonometric", "piecewise"]))
def test_alpha_can_be_left_to_be_chosen(family, stated):
    """The shortest path, of all that a scan finds; from then on alpha is a number."""
    stated_file = stated(valid(plans=[{"family": family, "alpha": "auto"}]))
    (plan,) = stated_file.plans.values()
    kind, t = FAMILIES[family], np.linspace(0, 16, 1001)

    def way(alpha):
        return np.abs(np.diff(kind(stated_file.waypoints, alpha=alpha, warn=False)(t))).sum()

    assert way(plan.alpha) <= min(map(way, np.linspace(0.0, 6.0, 61))) + 1e-5
    assert f"alpha = {plan.alpha:g} rad" in " ".join(map(str, stated_file.parameters().values()))
    assert '"auto"' not in written(stated_file, ".json")


def test_a_gamma_cannot_be_chosen(stated):
    with pytest.raises(StudyError, match=r"plans\[0\]\.gamma: must be .*, got 'auto'"):
        stated(valid(plans=[{"family": "trigonometric", "alpha": 1.0, "gamma": "auto"}]))


@pytest.mark.slow
def test_a_file_can_ask_whether_planning_is_worth_it(stated):
    assert stated(valid()).run().comparison.benefit is None
    data = valid(benefit=True, plans=[{"family": "polynomial"}], samples=601)
    found = stated(data).run().comparison
    assert found.benefit.comparison.units == {"x": "m", "u": "N"}
    assert {"trigonometric", "step", "trapezoid", "S-curve", "shaped step", "minimum jerk"} <= set(
        found.benefit.comparison.plans
    )
    assert list(found.results()) == ["plans", "worth"]


def test_the_family_may_be_the_name(stated):
    assert list(stated(valid(plans=[{"name": "polynomial"}])).plans) == ["polynomial"]
    found = stated(valid(plans=[{"name": "mine", "family": "polynomial"}, {"family": "step"}])).plans
    assert list(found) == ["mine", "step"]


@pytest.mark.parametrize(
    ("waypoints", "text"),
    [
        ("path.csv", "t,x,x_d1,x_d2\n0,0,0,0\n6,5,1,0\n16,20,0,0\n"),
        ({"csv": "path.csv", "time": "time", "columns": ["x", "x_d1", "x_d2"]},
         "n;time;x;x_d1;x_d2\n1;0,0;0;0;0\n2;6,0;5;1;0\n3;16,0;20;0;0\n"),
    ],
)  # fmt: skip
def test_waypoints_may_be_those_of_a_csv_file(waypoints, text, stated, tmp_path):
    """Its path counts from the study file."""
    (tmp_path / "path.csv").write_text(text)
    assert stated(valid(waypoints=waypoints)).waypoints == stated(valid()).waypoints


def test_waypoints_of_a_csv_file_at_a_speed(stated, tmp_path):
    (tmp_path / "path.csv").write_text("z,x\n10,0\n6,3\n")
    data = valid(waypoints={"csv": "path.csv", "speed": 2.0}, units={}, plans=[{"family": "piecewise"}])
    assert [w.time for w in stated(data).waypoints] == [0.0, 2.5]
    crane = valid(waypoints={"csv": "path.csv", "speed": 2.0}, units={}, loop={"kind": "crane"})
    assert stated(crane).waypoints[1].labels == ("x", "z")


def test_several_axes_keep_their_order_and_their_own_jets(stated):
    data = valid(
        units={},
        plans=[{"family": "polynomial"}],
        waypoints=[
            {"time": 0, "x": [0.0, 0.0, 0.0], "z": [10]},
            {"time": 4, "x": [1.0], "z": [8, 0.5]},
            {"time": 9, "x": [2.0, 0.0], "z": [11, 0, 0]},
        ],
    )
    plan = stated(data).plans["polynomial"]
    assert plan.labels == ("x", "z")
    assert plan.degree == (5, 5)
    np.testing.assert_allclose(plan([0, 4, 9]), [[0, 1, 2], [10, 8, 11]], rtol=0, atol=1e-12)
    assert plan(4.0, 1)[1] == pytest.approx(0.5, abs=1e-12)


def test_an_entry_of_nan_is_free(stated):
    data = valid(plans=[{"family": "polynomial"}])
    data["waypoints"][1]["x"] = [5.0, float("nan"), 0.25]
    plan = stated(data).plans["polynomial"]
    assert plan.degree == (7,)
    assert plan(6.0, 2) == pytest.approx(0.25, abs=1e-12)


def test_whole_numbers_are_numbers(stated):
    data = valid(t_end=30)
    data["loop"] |= {"num": [1], "den": [1, 1, 0], "gain": 5}
    data["waypoints"][0] = {"time": 0, "x": [0, 0, 0]}
    found = stated(data)
    assert (found.t_end, found.waypoints[0].time) == (30.0, 0.0)
    assert found.run().comparison.metrics == stated(valid()).run().comparison.metrics


def test_title_samples_and_units_can_be_left_out(stated):
    data = valid()
    for key in ("title", "samples", "units", "plans"):
        del data[key]
    del data["loop"]["gain"]
    found = stated(data, "hoist.toml")
    assert (found.title, found.samples, found.units) == ("hoist", 4001, {})
    loop = build_loop(found.loop, found.path)
    np.testing.assert_allclose(np.sort(loop.poles()), np.sort(np.roots([1, 1, 1])))


def test_units_reach_the_comparison(stated):
    found = stated(valid()).run().comparison
    assert found.units == {"x": "m", "u": "N"}


@pytest.mark.filterwarnings("ignore:the plan swings")
def test_every_waypoint_is_a_sample(stated):
    data = valid(samples=7)
    data["waypoints"][1]["time"] = np.pi
    found = stated(data).run().comparison
    for response in found.responses.values():
        assert {0.0, np.pi, 16.0, 30.0} <= set(response.time)


def test_parameters_say_how_it_was_made(stated):
    told = {k: str(v) for k, v in stated(valid()).run().comparison.parameters.items()}
    text = " | ".join(f"{k}: {v}" for k, v in told.items())
    for part in ("linear", "gain: 5", "[1.0, 1.0, 0.0]", "alpha = 2 rad", "alpha = 0.5 rad", "0 to 30 s", "101", "2 %"):
        assert part in text
    assert sum(key.startswith("waypoint") for key in told) == 3


def test_a_plant_that_passes_its_input_on_has_a_loop(stated):
    # (s + 2)/(s + 1) in unity feedback is (s + 2)/(2 s + 3): from 1/2 to 2/3 with a time constant of 2/3 s.
    data = valid(loop={"kind": "linear", "num": [1.0, 2.0], "den": [1.0, 1.0]}, plans=[{"family": "step"}], units={})
    data |= {"waypoints": [{"time": 0.0, "x": [0.0]}, {"time": 1.0, "x": [1.0]}], "samples": 61}
    response = stated(data).run().comparison.responses["step"]
    expected = 2 / 3 - np.exp(-1.5 * response.time) / 6
    np.testing.assert_allclose(response.outputs[0], expected, rtol=0, atol=1e-12)


# Loops of the user's own, beside the file

LOOP = """
import control as ct

def build() -> ct.StateSpace:
    return ct.ss([[-{rate}]], [[{rate}]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
"""


@pytest.mark.slow
def test_a_loop_is_found_next_to_the_file(tmp_path):
    (tmp_path / "hoist_loop.py").write_text(LOOP.format(rate=4.0))
    path = tmp_path / "study.toml"
    path.write_text(to_toml(valid(loop={"kind": "python:hoist_loop:build"}, units={})))
    study = load_study(path).run()
    own = ct.ss([[-4.0]], [[4.0]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
    times = np.union1d(np.linspace(0, 30, 101), [0.0, 6.0, 16.0])
    alone = cp.compare(own, load_study(path).plans, times, waypoints=study.comparison.waypoints)
    assert study.comparison.metrics == alone.metrics
    assert study.comparison.parameters["loop kind"] == "python:hoist_loop:build"


def test_two_studies_may_have_loops_of_one_name(tmp_path):
    settled = []
    for rate in (1.0, 4.0):
        folder = tmp_path / f"rate{rate:g}"
        folder.mkdir()
        (folder / "twin_loop.py").write_text(LOOP.format(rate=rate))
        path = folder / "study.toml"
        stated = valid(loop={"kind": "python:twin_loop:build"}, units={}, plans=[{"family": "step"}], samples=4001)
        path.write_text(to_toml(stated))
        settled.append(load_study(path).run().comparison.metrics["step"]["settling_time"])
    assert settled == pytest.approx([np.log(50.0), np.log(50.0) / 4], rel=1e-6)


def test_the_search_path_is_left_as_it_was(tmp_path):
    import sys

    before = list(sys.path)
    (tmp_path / "tidy_loop.py").write_text(LOOP.format(rate=1.0))
    path = tmp_path / "study.toml"
    path.write_text(to_toml(valid(loop={"kind": "python:tidy_loop:build"}, units={})))
    load_study(path).run()
    assert sys.path == before


def test_a_nonlinear_loop_is_compared_too(tmp_path):
    (tmp_path / "curved_loop.py").write_text(
        "import control as ct\nimport numpy as np\n\n"
        "def build() -> ct.NonlinearIOSystem:\n"
        "    return ct.nlsys(lambda t, x, u, p: np.tanh(20 * (u - x)), None, inputs=1, outputs=['y'], states=1)\n"
    )
    path = tmp_path / "study.toml"
    path.write_text(
        to_toml(valid(loop={"kind": "python:curved_loop:build"}, units={}, plans=[{"family": "polynomial"}]))
    )
    response = load_study(path).run().comparison.responses["polynomial"]
    assert response.method != "exact"
    assert np.ravel(response.outputs)[-1] == pytest.approx(20.0, rel=1e-3)


# Plans as data


def written(study, ending):
    """Text of the one file that holds all plans."""
    ((_, text),) = plan_files(study, Path(f"plan{ending}"), Options()).items()
    return text


def test_plans_as_json_restore_every_bit(stated):
    import json

    found = stated(valid())
    data = json.loads(written(found, ".json"))
    assert list(data) == ["trigonometric", "poly", "legs", "step"]
    t = np.linspace(-1, 17, 1001)
    for name, plan in found.plans.items():
        np.testing.assert_array_equal(cp.trajectory_from_dict(data[name]).jet(t, 2), plan.jet(t, 2))


def test_plans_as_csv_are_their_samples(stated):
    found = stated(valid())
    head, *lines = written(found, ".csv").splitlines()
    names = head.split(",")
    table = np.array([line.split(",") for line in lines], dtype=float).T
    assert names[0] == "time"
    assert len(names) == len(set(names)) == 1 + 3 * len(found.plans)
    assert {0.0, 6.0, 16.0} <= set(table[0])
    for name, plan in found.plans.items():
        rows = table[[names.index(f"{name}.{x}") for x in ("x", "x_d1", "x_d2")]]
        np.testing.assert_array_equal(rows, plan.jet(table[0], 2)[:, 0])


NAMES = [
    "fast, then slow",
    'the "best"',
    "fast;slow",
    "two\nlines",
    "two\r\nlines",
    "a\rreturn",
    '"',
    '",\n"',
    " ",
    "é🚀",
]


@pytest.mark.parametrize("name", NAMES)
def test_csv_has_as_many_names_as_columns_whatever_the_plan_is_called(stated, name):
    found = stated(valid(plans=[{"name": name, "family": "polynomial"}]))
    head, *rows = csv.reader(io.StringIO(written(found, ".csv"), newline=""))
    assert head == ["time", *(f"{name}.{x}" for x in ("x", "x_d1", "x_d2"))]
    assert {len(row) for row in rows} == {4}


@pytest.mark.parametrize("name", ['=HYPERLINK("http://evil.example")', "+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_spreadsheet_takes_no_name_of_a_plan_for_a_formula(stated, name):
    found = stated(valid(plans=[{"name": name, "family": "polynomial"}]))
    head, *_ = csv.reader(io.StringIO(written(found, ".csv"), newline=""))
    assert head == ["time", *(f"'{name}.{x}" for x in ("x", "x_d1", "x_d2"))]


def test_csv_names_no_two_columns_alike(stated):
    points = [{"time": 0.0, "x": [0.0], "x_d1": [0.0]}, {"time": 1.0, "x": [1.0], "x_d1": [2.0]}]
    data = valid(plans=[{"family": "polynomial"}], waypoints=points, units={})
    try:
        head = written(stated(data), ".csv").splitlines()[0].split(",")
    except StudyError:
        return  # names that would be alike are refused
    assert len(head) == len(set(head))


def test_a_study_error_is_a_value_error():
    assert issubclass(StudyError, ValueError)


def test_the_data_of_these_tests_is_valid(stated):
    assert list(stated(VALID).plans) == ["trigonometric", "poly", "legs", "step"]


def crane_study(**loop):
    return {
        "t_end": 10.0,
        "samples": 501,
        "loop": {"kind": "crane", "force_limits": [-30e3, 30e3], "torque_limits": [-3e3, 1e3], **loop},
        "plans": [{"family": "step"}, {"family": "polynomial"}],
        "waypoints": [
            {"time": 0.0, "x": [0.0, 0.0, 0.0], "z": [10.0, 0.0, 0.0]},
            {"time": 9.0, "x": [20.0, 0.0, 0.0], "z": [11.0, 0.0, 0.0]},
        ],
    }


@pytest.mark.slow
def test_a_crane_of_a_file_ends_at_the_slack_rope(stated):
    found = stated(crane_study()).run().comparison
    assert found.stopped == {"step": pytest.approx(5.866, abs=1e-3)}
    assert found.responses["step"].time[-1] == found.stopped["step"]
    assert "slack" in found.marks["step"]


@pytest.mark.slow
def test_the_old_name_of_a_law_is_read_with_a_notice(stated):
    with pytest.warns(FutureWarning, match='law "still" is deprecated.*use "setpoint"'):
        old = stated(crane_study(law="still")).run().comparison
    new = stated(crane_study(law="setpoint")).run().comparison
    np.testing.assert_array_equal(old.responses["polynomial"].outputs, new.responses["polynomial"].outputs)


@pytest.mark.parametrize("law", ["pid", 3, ["generator"], True])
def test_an_unknown_law_is_named_with_those_there_are(stated, law):
    with pytest.raises(
        StudyError, match=r"loop\.law: must be one of setpoint, generator, load_feedback, dynamic, feed"
    ):
        stated(crane_study(law=law))
