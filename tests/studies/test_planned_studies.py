"""Study files with limits, minimum durations, obstacles, sweeps and draws, against closed forms and naive checks."""

import re
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from study_text import to_toml, valid

import ctrlplan as cp
from ctrlplan.reports.page import render_page
from ctrlplan.studies.crane_setup import load_metrics
from ctrlplan.studies.files import load_study
from ctrlplan.studies.reading import StudyError
from ctrlplan.studies.sections import Bands, CraneScene, DrawTable, FastestMove, Paths, PlanMargins, SweepCurves

REST, END = [0.0, 0.0, 0.0], [20.0, 0.0, 0.0]
MOVE = [{"time": 0.0, "x": REST}, {"time": 16.0, "x": END}]
PLANAR = [{"time": 0.0, "x": REST, "z": REST}, {"time": 16.0, "x": END, "z": [1.0, 0.0, 0.0]}]


@pytest.fixture
def loaded(tmp_path):
    """Write changes of the valid file and load it."""

    def load(**changes):
        path = tmp_path / "study.toml"
        path.write_text(to_toml(valid(**{"units": {}, "waypoints": MOVE} | changes)), encoding="utf-8")
        return load_study(path)

    return load


def quintic(**changes):
    return {"family": "polynomial", **changes}


def of_type(study, kind):
    return [section for section in study.sections if isinstance(section, kind)]


# Limits and minimum durations


@pytest.mark.parametrize(
    ("limits", "duration"),
    [
        # The quintic from rest to rest over d in T has the peak velocity 15/8 d/T and acceleration 10/sqrt(3) d/T^2.
        ({"velocity": 2.0}, 15 / 8 * 20 / 2),
        ({"velocity": [2.0]}, 15 / 8 * 20 / 2),
        ({"x_d1": [-1.0, 2.0]}, 15 / 8 * 20 / 2),
        ({"x_d1": {"high": 2.0}}, 15 / 8 * 20 / 2),
        ({"velocity": 9.0, "acceleration": 0.75}, np.sqrt(10 / np.sqrt(3) * 20 / 0.75)),
        ({"acceleration": {"low": -0.75}}, np.sqrt(10 / np.sqrt(3) * 20 / 0.75)),
    ],
)
def test_a_plan_has_the_minimum_duration_under_the_limits(limits, duration, loaded):
    found = loaded(plans=[quintic(fastest="shape")], limits=limits)
    assert found.plans["polynomial"].duration == pytest.approx(duration, rel=1e-9)
    assert found.planned.margins["polynomial"].active.fraction == pytest.approx(0.0, abs=1e-9)


LAG = {"kind": "linear", "num": [5.0], "den": [1.0, 1.0, 0.0]}  # 5/(s^2 + s) in unity feedback


def test_limits_on_signals_of_the_loop(loaded):
    """u = r - y of the loop: the plan of minimum duration, and its largest control by python-control."""
    study = loaded(loop=LAG, plans=[quintic(fastest="shape")], limits={"u": {"high": 12.0, "low": -12.0}}, t_end=60.0)
    plan = study.plans["polynomial"]
    t = np.linspace(plan.start, plan.end + 20.0, 20001)
    response = ct.forced_response(ct.ss(ct.tf([1.0, 1.0, 0.0], [1.0, 1.0, 5.0])), t, plan(t))  # from r to u = r - y
    peak = np.abs(response.outputs).max()
    assert peak == pytest.approx(12.0, rel=1e-3)
    assert study.planned.margins["polynomial"].satisfied
    assert study.planned.local == {}


@pytest.mark.slow
def test_kinds_of_limits_on_signals_of_the_loop(loaded):
    limits = {"u": {"rate": 200.0, "rms": 30.0, "period": 50.0}, "velocity": 20.0}
    study = loaded(loop=LAG, plans=[quintic()], limits=limits, t_end=60.0, benefit=True, samples=41)
    kinds = {row.bound.kind for row in study.planned.margins["polynomial"]}
    assert kinds == {"rate", "rms", "value"}
    assert study.planned.local == {"velocity": 20.0}
    assert study.run().comparison.benefit is not None


def test_bad_limits_on_signals_of_the_loop(loaded):
    with pytest.raises(StudyError, match=r"limits: limits must name signals of the loop .*got 'w'"):
        loaded(loop=LAG, plans=[quintic()], limits={"w": 1.0}, t_end=60.0)
    with pytest.raises(StudyError, match="path"):
        loaded(loop=LAG, plans=[quintic(fastest="path")], limits={"u": 12.0}, t_end=60.0)
    with pytest.raises(StudyError, match=r"limits\.u"):
        loaded(loop=LAG, plans=[quintic()], limits={"u": {"rms": 1.0, "low": 2.0, "high": 1.0}}, t_end=60.0)


def test_limits_of_each_axis_are_a_list(loaded):
    """The second axis moves by 1 instead of 20, and determines the duration."""
    found = loaded(plans=[quintic(fastest="shape")], limits={"velocity": [9.0, 0.1]}, waypoints=PLANAR)
    assert found.plans["polynomial"].duration == pytest.approx(15 / 8 / 0.1, rel=1e-9)


@pytest.mark.slow
def test_another_time_law_on_the_path_is_faster(loaded):
    """It takes 20/2 s at least."""
    plan = loaded(plans=[quintic(fastest="path")], limits={"velocity": 2.0}).plans["polynomial"]
    assert 10.0 <= plan.duration < 18.75
    assert np.abs(plan(np.linspace(0, plan.end, 2001), 1)).max() <= 2.0 * (1 + 1e-9)


@pytest.mark.slow
def test_derivatives_at_the_waypoints_can_be_preserved(loaded):
    """Those of zero at both ends are those of the same shape."""
    plan = loaded(plans=[quintic(fastest="waypoints")], limits={"velocity": 2.0}).plans["polynomial"]
    assert plan.duration == pytest.approx(18.75, rel=1e-9)


def test_a_limit_of_the_crane_is_one_of_the_plan(loaded):
    still = [0.0, 0.0, 0.0, 0.0]
    points = [
        {"time": 0.0, "x": [0.0, *still], "z": [10.0, *still]},
        {"time": 16.0, "x": [20.0, *still], "z": [11.0, *still]},
    ]
    found = loaded(
        loop={"kind": "crane"}, plans=[quintic(fastest="shape")], limits={"F": 6000.0}, waypoints=points, t_end=60.0
    )
    plan, crane = found.plans["polynomial"], cp.plants.Crane()
    jets = plan.jet(np.linspace(0, plan.end, 4001), 4)
    assert np.abs(crane.quantities(jets)["F"]).max() == pytest.approx(6000.0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_margins_and_the_fastest_plan_are_in_the_report(loaded):
    plans = [quintic(fastest="shape"), quintic(name="slow")]
    study = loaded(plans=plans, limits={"velocity": 2.0}, samples=41, t_end=40.0).run()
    (section,) = of_type(study, FastestMove)
    assert section.fastest.duration == pytest.approx(18.75, rel=1e-9)
    assert "Plan polynomial" in section.caption
    assert any("slow violates a limit" in note for note in study.notes)  # 15/8 20/16 = 2.34 > 2
    assert any("polynomial satisfies all limits" in note for note in study.notes)
    assert study.comparison.parameters["limit of velocity"] == "within ±2"
    (table,) = of_type(study, PlanMargins)
    assert table.results()["limits"]["slow"] == {
        "x_d1": {
            "value": pytest.approx(15 / 8 * 20 / 16, rel=1e-12),
            "time": pytest.approx(8.0, abs=1e-6),
            "margin": pytest.approx(1.0 - 15 / 8 * 20 / 16 / 2.0, rel=1e-9),
        }
    }
    page = render_page([study], "limits")
    assert re.search(r"<td[^>]*>violated</td>", page)
    assert re.search(r"<td[^>]*>satisfied</td>", page)


@pytest.mark.slow
def test_a_plan_slower_than_its_waypoints_is_measured_to_its_end(loaded):
    """Straight in one axis: its path has the length of the polyline, and its load moves until the end of the plan."""
    setting = {"plans": [quintic(fastest="shape")], "limits": {"velocity": 1.0}, "t_end": 50.0, "samples": 501}
    found = loaded(**setting).run().comparison  # 37.5 s in place of 16 s
    assert found.metrics["polynomial"]["wandering"] == pytest.approx(0.0, abs=1e-9)
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 16.0, "x": END, "z": [11.0, 0, 0]}]
    found = loaded(**setting, loop={"kind": "crane"}, waypoints=points).run().comparison
    plan, row = found.plans["polynomial"], found.metrics["polynomial"]
    assert plan.end == pytest.approx(37.5, rel=1e-9)
    own = load_metrics(plan, found.responses["polynomial"], plan.end)
    assert {name: row[name] for name in ("error_travel", "error_after", "sway_after")} == {
        name: own[name] for name in ("error_travel", "error_after", "sway_after")
    }
    assert load_metrics(plan, found.responses["polynomial"], 16.0)["sway_after"] > 1.5 * row["sway_after"]


# Obstacles


def to_rectangle(points, x, z):
    """Distance of points (2, n) from a rectangle, naively."""
    across = np.maximum.reduce([x[0] - points[0], np.zeros(points.shape[1]), points[0] - x[1]])
    above = np.maximum.reduce([z[0] - points[1], np.zeros(points.shape[1]), points[1] - z[1]])
    return np.hypot(across, above)


TWO_AXES = """
import control as ct

def build() -> ct.StateSpace:
    lag = ct.ss([[-9.0]], [[9.0]], [[1.0]], [[0.0]])
    both = ct.append(lag, lag)
    both.set_outputs(["x", "z"])
    return both
"""


@pytest.mark.slow
def test_a_plan_is_led_around_the_obstacles(loaded, tmp_path):
    (tmp_path / "two_axes.py").write_text(TWO_AXES)
    obstacle = {"shape": "rectangle", "x": [8.0, 12.0], "z": [-3.0, 1.0]}
    found = loaded(
        plans=[quintic(avoid=True), quintic(name="straight")],
        waypoints=PLANAR,
        obstacles=[obstacle],
        avoid={"clearance": 0.5, "load": 0.25},
        loop={"kind": "python:two_axes:build"},
    )
    t = np.linspace(0, 16, 20001)
    around, straight = found.plans["polynomial"], found.plans["straight"]
    assert to_rectangle(around(t), obstacle["x"], obstacle["z"]).min() >= 0.75 - 1e-9
    assert to_rectangle(straight(t), obstacle["x"], obstacle["z"]).min() == 0.0
    assert found.planned.clearances["polynomial"].lower >= 0.5 - 1e-9
    assert found.planned.clearances["straight"].minimum < 0.0
    study = replace(found, samples=21).run()
    (paths,) = of_type(study, Paths)
    assert paths.obstacles == (cp.Rectangle((8.0, 12.0), (-3.0, 1.0)),)


def test_obstacles_have_every_shape(loaded):
    shapes = [
        {"shape": "rectangle", "x": [8.0, 12.0], "z": [3.0, float("inf")]},
        {"shape": "disc", "centre": [10.0, -4.0], "radius": 1.0},
        {"shape": "half_plane", "normal": [0.0, 2.0], "offset": 40.0},
    ]
    found = loaded(plans=[quintic()], waypoints=PLANAR, obstacles=shapes)
    expected = (cp.Rectangle((8, 12), (3, np.inf)), cp.Disc((10, -4), 1.0), cp.HalfPlane((0, 2), 40.0))
    assert found.planned.obstacles == expected
    clear = cp.clearance(found.plans["polynomial"], expected)
    assert found.planned.clearances["polynomial"].minimum == clear.minimum


def test_the_rope_of_a_crane_avoids_as_well(loaded):
    """A wall above the line: the load could pass beneath, its rope could not."""
    obstacle = {"shape": "disc", "centre": [10.0, 5.0], "radius": 1.0}
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 16.0, "x": END, "z": [11.0, 0, 0]}]
    setting = {"loop": {"kind": "crane"}, "waypoints": points, "obstacles": [obstacle], "plans": [quintic(avoid=True)]}
    t = np.linspace(0, 16, 2001)
    free = loaded(**setting, avoid={"clearance": 0.2}).plans["polynomial"]
    np.testing.assert_array_equal(free(t), cp.PolySpline(free.waypoints[:1] + free.waypoints[-1:])(t))
    led = loaded(**setting, avoid={"clearance": 0.2, "rope": True}).plans["polynomial"]
    crane = cp.plants.Crane()
    top = crane.rope().top(led.jet(t, crane.rope().order))
    ways = np.linspace(0.0, 1.0, 201)[:, None, None] * (top - led(t)) + led(t)
    assert np.hypot(ways[:, 0] - 10.0, ways[:, 1] - 5.0).min() - 1.0 >= 0.2 - 1e-3


@pytest.mark.slow
def test_the_scenes_of_a_crane_show_a_wall_and_the_paths_all_obstacles(loaded):
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 16.0, "x": END, "z": [11.0, 0, 0]}]
    wall = {"shape": "rectangle", "x": [7.0, 13.0], "z": [12.0, 13.0]}
    setting = {"loop": {"kind": "crane"}, "waypoints": points, "plans": [quintic()], "samples": 21}
    study = loaded(**setting, obstacles=[wall]).run()
    assert {section.wall for section in of_type(study, CraneScene)} == {((7.0, 13.0), (12.0, 13.0))}
    assert not of_type(study, Paths)
    disc = {"shape": "disc", "centre": [10.0, 1.0], "radius": 0.5}
    (paths,) = of_type(loaded(**setting, obstacles=[disc, wall]).run(), Paths)
    assert paths.obstacles == (cp.Disc((10.0, 1.0), 0.5), cp.Rectangle((7.0, 13.0), (12.0, 13.0)))


# Sweeps and draws


def overshoot(gain):
    """Overshoot of the step response of gain/(s^2 + s + gain) [%], in closed form."""
    damping = 1 / (2 * np.sqrt(gain))
    return 100 * np.exp(-np.pi * damping / np.sqrt(1 - damping**2))


@pytest.mark.parametrize("values", [[2.0, 4.0, 8.0], {"low": 2.0, "high": 8.0, "count": 3, "scale": "log"}])
def test_a_sweep_is_over_a_parameter_of_the_loop(values, loaded):
    study = loaded(
        plans=[{"family": "step"}, quintic()],
        samples=2001,
        sweep={"parameter": "gain", "values": values, "metrics": ["overshoot_error"]},
    ).run()
    (section,) = of_type(study, SweepCurves)
    found = section.sweep
    np.testing.assert_allclose(found.values, [2.0, 4.0, 8.0], rtol=1e-15)
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], overshoot(found.values), rtol=1e-4)
    assert list(study.results()["sweep"]) == ["gain", "step", "polynomial"]
    assert section.metrics == ("overshoot_error",)


def test_draws_are_of_parameters_of_the_loop(loaded):
    study = loaded(
        plans=[{"family": "step"}],
        samples=2001,
        draws={"count": 6, "seed": 3, "parameters": {"gain": [2.0, 8.0]}},
    ).run()
    (bands,), (table,) = of_type(study, Bands), of_type(study, DrawTable)
    gains = bands.ensemble.params["gain"]
    assert gains.size == 6
    assert 2.0 <= gains.min() < gains.max() <= 8.0
    np.testing.assert_array_equal(gains, cp.draws(6, seed=3, gain=(2.0, 8.0))["gain"])
    np.testing.assert_allclose(bands.ensemble.metrics["step"]["overshoot_error"], overshoot(gains), rtol=1e-4)
    assert study.results()["draws"]["finished"] == 6
    assert table.ensemble is bands.ensemble


@pytest.mark.slow
def test_draws_of_a_crane_are_unknown_to_its_law(loaded):
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 4.0, "x": [2.0, 0, 0], "z": [10.5, 0, 0]}]
    study = loaded(
        loop={"kind": "crane"},
        plans=[quintic()],
        waypoints=points,
        t_end=6.0,
        samples=61,
        draws={"count": 2, "seed": 1, "parameters": {"load_mass": [600.0, 700.0]}},
    ).run()
    (bands,) = of_type(study, Bands)
    masses, t = bands.ensemble.params["load_mass"], np.union1d(np.linspace(0, 6, 61), [0.0, 4.0])
    loop = cp.plants.crane_loop(cp.plants.Crane(), study.comparison.plans["polynomial"], "generator")
    for mass, peak in zip(masses, bands.ensemble.metrics["polynomial"]["force_peak"], strict=True):
        response = cp.simulate(loop, t, params={"load_mass": mass})
        force = response.outputs[response.output_labels.index("F")]
        assert peak == pytest.approx(np.abs(force).max(), rel=1e-6)


OWN = """
import control as ct

def build({argument}) -> ct.StateSpace:
    return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs=["r"], outputs=["x"])
"""


def test_a_function_of_a_module_is_called_with_the_parameter(loaded, tmp_path):
    (tmp_path / "rated_loop.py").write_text(OWN.format(argument="rate=1.0"))
    study = loaded(
        loop={"kind": "python:rated_loop:build"},
        plans=[{"family": "step"}],
        samples=4001,
        sweep={"parameter": "rate", "values": [1.0, 4.0]},
        draws={"count": 3, "parameters": {"rate": [1.0, 4.0]}},
    ).run()
    (section,), (bands,) = of_type(study, SweepCurves), of_type(study, Bands)
    settling = section.sweep.metrics["step"]["settling_time"]
    np.testing.assert_allclose(settling, np.log(50.0) / np.array([1.0, 4.0]), rtol=1e-6)
    rates = bands.ensemble.params["rate"]
    np.testing.assert_allclose(bands.ensemble.metrics["step"]["settling_time"], np.log(50.0) / rates, rtol=1e-6)


def test_a_function_without_the_argument_is_an_error(loaded, tmp_path):
    (tmp_path / "fixed_loop.py").write_text("rate = 1.0\n" + OWN.format(argument=""))
    study = loaded(
        loop={"kind": "python:fixed_loop:build"},
        plans=[{"family": "step"}],
        samples=41,
        sweep={"parameter": "rate", "values": [1.0, 4.0]},
    )
    with pytest.raises(StudyError, match=r"loop\.kind: must name a function .* unexpected keyword argument 'rate'"):
        study.run()


def test_a_crane_whose_rope_is_slack_at_once_is_measured(loaded):
    """The mass of 300 kg: the step of the rope lets the load fall from the first sample on."""
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 16.0, "x": END, "z": [11.0, 0, 0]}]
    study = loaded(
        loop={"kind": "crane", "load_mass": 300.0, "force_limits": [-30e3, 30e3]},
        plans=[{"family": "step"}],
        waypoints=points,
        samples=41,
    ).run()
    assert study.comparison.stopped == {"step": 0.0}
    row = study.comparison.metrics["step"]
    assert row["load_path"] == 0.0
    assert row["slack_time"] == 0.0


@pytest.mark.slow
def test_a_sweep_with_a_plan_without_metrics_has_a_figure_and_null(loaded, tmp_path):
    """The step's rope is slack from the first sample on: it has no settling time for any value."""
    points = [{"time": 0.0, "x": REST, "z": [10.0, 0, 0]}, {"time": 16.0, "x": END, "z": [11.0, 0, 0]}]
    study = loaded(
        loop={"kind": "crane", "force_limits": [-30e3, 30e3]},
        plans=[{"family": "step"}, quintic()],
        waypoints=points,
        samples=41,
        sweep={"parameter": "load_mass", "values": [300.0, 320.0], "metrics": ["settling_time"]},
    ).run()
    found = study.results()["sweep"]
    assert found["step"] == {"settling_time": [None, None]}
    assert all(value > 0.0 for value in found["polynomial"]["settling_time"])
    (section,) = of_type(study, SweepCurves)
    assert np.isnan(section.sweep.column("step", "settling_time")).all()
    lines = section.sweep.plot(("settling_time",)).axes[0, 0].get_lines()
    assert sum(np.isfinite(line.get_ydata()).any() for line in lines) == 1


# Input shapers


ZVD = {"kind": "zvd", "frequency": 3.0, "damping": 0.1}


def test_a_plan_is_shaped(loaded):
    ei = {"kind": "ei", "frequency": 7.0, "tolerance": 0.1}
    found = loaded(plans=[quintic(), quintic(name="shaped", shaper=[ZVD, ei])]).plans
    shaper = cp.Shaper.zvd(3.0, 0.1).then(cp.Shaper.ei(7.0, 0.0, 0.1))
    t = np.linspace(0.0, 20.0, 201)
    np.testing.assert_allclose(found["shaped"](t), shaper(found["polynomial"])(t), rtol=0, atol=1e-12)
    assert found["shaped"].duration == pytest.approx(16.0 + shaper.duration, rel=1e-14)


def test_a_plan_is_shaped_after_its_duration_is_found(loaded):
    """The limits hold for the shaped plan as well, with a margin: each is a mean of delayed plans."""
    study = loaded(plans=[quintic(fastest="shape", shaper=[ZVD])], limits={"velocity": 2.0})
    shaper = cp.Shaper.zvd(3.0, 0.1)
    assert study.plans["polynomial"].duration == pytest.approx(15 / 8 * 20 / 2 + shaper.duration, rel=1e-9)
    wanted = cp.margins(study.plans["polynomial"], {"velocity": 2.0}).active.fraction
    assert study.planned.margins["polynomial"].active.fraction == pytest.approx(wanted, rel=1e-12)
    assert wanted > 0.0


@pytest.mark.parametrize(
    ("shaper", "message"),
    [
        ([{"kind": "zvd"}], r"plans\[0\].shaper\[0\].frequency: must be a finite number above 0, got none"),
        ([ZVD | {"frequency": 0.0}], r"shaper\[0\].frequency: must be a finite number above 0, got 0"),
        ([ZVD | {"damping": 1.0}], r"shaper\[0\].damping: must be a finite number, 0 or more and below 1, got 1"),
        ([ZVD | {"damping": -0.1}], r"shaper\[0\].damping: must be a finite number, 0 or more and below 1, got -0.1"),
        ([ZVD, ZVD | {"kind": "zzz"}], r"shaper\[1\].kind: must be .*zv.*zvd.*mzv.*ei.* got 'zzz'"),
        ([ZVD | {"tolerance": 0.1}], r"shaper\[0\].tolerance: must be given for an ei kind, got 'zvd'"),
    ],
)
def test_shapers_that_are_rejected(shaper, message, loaded):
    with pytest.raises(StudyError, match=message):
        loaded(plans=[quintic(shaper=shaper)])
