"""Study files of flat plants: by name, and from a function of a module; what they run, and what is wrong."""

import re

import numpy as np
import pytest
from repetitions import one_in
from study_schema import schema_errors, structure_error
from study_text import to_toml

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.studies.files import StudyError, load_study
from ctrlplan.studies.limits import limits_sentence
from ctrlplan.studies.loops import LOOP_KINDS

pytest.importorskip("casadi")

REST = [0.0, 0.0, 0.0]
PLANTS = {
    "dc-motor": cp.plants.DCMotor,
    "flexible-joint": cp.plants.FlexibleJoint,
    "kinematic-car": cp.plants.KinematicCar,
    "magnetic-levitation": cp.plants.MagneticLevitation,
    "planar-quadrotor": cp.plants.PlanarQuadrotor,
    "two-mass-drive": cp.plants.TwoMassDrive,
}


def motor(**changes):
    """Study of a motor that turns by 2 rad."""
    data = {
        "t_end": 1.5,
        "samples": 151,
        "loop": {"kind": "dc-motor", "poles": [-20.0, -25.0, -30.0], "friction": 0.2},
        "plans": [{"family": "polynomial"}],
        "waypoints": [{"time": 0.0, "angle": [0.0, *REST]}, {"time": 1.0, "angle": [2.0, *REST]}],
    }
    return data | changes


def of_motor(**entries):
    return motor(loop=motor()["loop"] | entries)


def lane(**changes):
    """Study of a lane change at 20 m/s."""
    data = {
        "t_end": 3.0,
        "samples": 61,
        "loop": {"kind": "kinematic-car", "poles": [-2.0, -3.0]},
        "plans": [{"family": "polynomial"}],
        "waypoints": [
            {"time": 0.0, "y": REST, "x": [0.0, 20.0, 0.0]},
            {"time": 3.0, "y": [3.5, 0.0, 0.0], "x": [60.0, 20.0, 0.0]},
        ],
    }
    return data | changes


@pytest.fixture
def stated(tmp_path):
    """Write data as a study file, and modules next to it, and load it."""

    def load(data, **modules):
        for name, text in modules.items():
            (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
        path = tmp_path / "study.toml"
        path.write_text(to_toml(data), encoding="utf-8")
        return load_study(path)

    return load


def same(found, known):
    """Whether two tables of metrics agree to the tolerance of the simulation; some are 0 or nan in both."""
    assert found.keys() == known.keys()
    for name, value in known.items():
        assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-9, nan_ok=True), name


# What runs


def test_every_plant_has_a_kind_with_its_parameters():
    exported = [getattr(cp.plants, name) for name in cp.plants.__all__]
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, cp.plants.Plant)}
    assert kinds - {cp.plants.Plant, cp.plants.Crane} == set(PLANTS.values())
    for kind, plant in PLANTS.items():
        entries = LOOP_KINDS[kind].entries
        own = set(vars(plant()))
        assert own <= set(entries)
        assert set(entries) - own == {"law", "poles", "integral", "input_limits"}
        for name in own & set(plant().flat_system().params):
            assert re.search(rf"parameter {name} of ctrlplan.plants.{plant.__name__} \[.+\]", entries[name].text)


def test_a_study_of_a_plant_is_a_comparison_of_its_flat_loops(stated):
    study = stated(motor())
    found = study.run().comparison
    plant = cp.plants.DCMotor(friction=0.2)
    flat = plant.flat_system()
    alone = cp.compare(
        lambda name, plan: cp.flat_loop(flat, plan, poles=[-20.0, -25.0, -30.0]),
        study.plans,
        study.timepts(None),
        waypoints=study.waypoints,
        controls=["voltage"],
        units=plant.units,
    )
    same(found.metrics["polynomial"], alone.metrics["polynomial"])
    assert found.units == alone.units
    assert found.metrics["polynomial"]["iae"] < 1e-8


def test_a_step_is_a_set_point_of_the_law(stated):
    """The error of the flat law from rest is that of a chain of integrators with the poles -20, -25, -30."""
    found = stated(motor(plans=[{"family": "step"}])).run().comparison.responses["step"]
    t, p = found.time, np.array([-20.0, -25.0, -30.0])
    # e = sum c_k exp(p_k t) with e(0) = -2 and two derivatives 0 there
    c = np.linalg.solve(np.vander(p, 3, increasing=True).T, [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(found.outputs["angle"], 2.0 + np.exp(np.outer(t, p)) @ c, atol=1e-6)


@pytest.mark.slow
def test_a_lane_change_ends_with_its_plans(stated):
    found = stated(lane(units={"x": "m"})).run().comparison
    assert found.metrics["polynomial"]["overshoot_error"] < 1e-6
    assert {"control_peak_v", "control_peak_delta"} <= set(found.metrics["polynomial"])
    assert found.units["delta"] == "rad"
    assert list(found.plans["polynomial"].labels) == ["y", "x"]


@pytest.mark.parametrize("name", one_in(3, ["quasi_static", "integral", "feedforward", "input_limits"]))
def test_options_of_the_law(name, stated):
    plant = cp.plants.DCMotor()
    loop = {"kind": "dc-motor", "poles": [-20.0, -25.0, -30.0]}
    options = {
        "quasi_static": {"law": "quasi_static"},
        "integral": {"integral": True, "poles": [-10.0, -20.0, -25.0, -30.0]},
        "feedforward": {"law": "feedforward"},
        "input_limits": {"input_limits": {"voltage": [-60.0, 60.0]}},
    }
    laws = {
        "quasi_static": cp.FlatLaw([[-20.0, -25.0, -30.0]], quasi_static=True),
        "integral": cp.FlatLaw([[-10.0, -20.0, -25.0, -30.0]], integral=True),
        "feedforward": cp.Feedforward(),
        "input_limits": cp.FlatLaw([-20.0, -25.0, -30.0]),
    }
    table = loop | options[name]
    if name == "feedforward":
        del table["poles"]
    study = stated(motor(loop=table))
    limits = {"voltage": (-60.0, 60.0)} if name == "input_limits" else None
    known = cp.simulate(
        cp.flat_loop(plant.flat_system(), study.plans["polynomial"], law=laws[name], limits=limits), study.timepts(None)
    )
    found = study.run().comparison.responses["polynomial"]
    np.testing.assert_allclose(found.outputs["angle"], known.outputs["angle"], atol=1e-6)
    if limits:
        assert np.abs(found.outputs["voltage"]).max() <= 60.0


def test_limits_of_inputs_are_those_of_actuators(stated):
    """The report states them, and whether they are reached."""
    table = motor()["loop"] | {"input_limits": {"voltage": [-60.0, 200.0]}}
    found = stated(motor(loop=table, plans=[{"family": "polynomial"}, {"family": "step"}])).run().comparison
    assert found.limits["step"] == {"voltage": (-60.0, 200.0)}
    assert np.max(found.responses["step"].outputs["voltage"]) == 200.0
    assert limits_sentence(found) == "Actuator limits: satisfied; reached: voltage (polynomial), voltage (step)."


@pytest.mark.slow
def test_a_list_of_poles_for_each_flat_output_or_one_for_all(stated):
    both = [stated(lane(loop=lane()["loop"] | {"poles": poles})) for poles in ([-2.0, -3.0], [[-2.0, -3.0]] * 2)]
    first, second = (study.run().comparison.metrics["polynomial"] for study in both)
    same(first, second)


def test_limits_are_those_of_the_plant(stated):
    """The minimum duration under a limit of the voltage is that of `fastest` with the plant."""
    plans = [{"family": "polynomial", "fastest": "shape"}]
    study = stated(motor(limits={"voltage": [-90.0, 90.0]}, plans=plans, t_end=3.0))
    known = cp.fastest(cp.PolySpline(study.waypoints), {"voltage": (-90.0, 90.0)}, cp.plants.DCMotor(friction=0.2))
    assert study.plans["polynomial"].duration == pytest.approx(known.duration, rel=1e-9)
    assert study.planned.margins["polynomial"].satisfied


@pytest.mark.slow
def test_draws_vary_the_plant_and_a_sweep_plant_and_law(stated):
    """The law knows the parameter of a sweep, and not that of a draw."""
    draws = {"count": 2, "parameters": {"inertia": [0.015, 0.02]}}
    sweep = {"parameter": "inertia", "values": [0.015, 0.02]}
    study = stated(motor(draws=draws, sweep=sweep)).run()
    swept, ensemble = (
        next(vars(s) for s in study.sections if type(s).__name__ == kind) for kind in ("SweepCurves", "Bands")
    )
    (sweep,), (ensemble,) = (
        [v for v in part.values() if isinstance(v, cp.Sweep | cp.Ensemble)] for part in (swept, ensemble)
    )
    assert max(sweep.metrics["polynomial"]["iae"]) < 1e-7
    assert min(ensemble.metrics["polynomial"]["iae"]) > 1e-4


PLANT = """
import control as ct
import control.flatsys as fs
import numpy as np
import ctrlplan as cp


def plant(gain: float = 2.0) -> cp.FlatSystem:
    names = ["angle", "speed"]
    arm = ct.nlsys(lambda t, x, u, p: [x[1], gain * u[0] - np.sin(x[0])], None, states=names, inputs=["u"],
                   outputs=names, name="arm")
    return cp.flat_system(arm, "angle")


def other() -> ct.InputOutputSystem:
    return fs.LinearFlatSystem(ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0))


def loop() -> ct.InputOutputSystem:
    return ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="angle")
"""
FROM_MODULE = {"kind": "python:own_plant:plant", "poles": [-8.0, -9.0]}


@pytest.mark.slow
def test_a_function_may_return_a_flat_system(stated):
    """Limits, sweeps and draws, and the same loop as by hand."""
    data = motor(
        loop=FROM_MODULE,
        limits={"u": [-20.0, 20.0]},
        sweep={"parameter": "gain", "values": [1.0, 2.0]},
        plans=[{"family": "polynomial"}, {"family": "step"}],
    )
    study = stated(data, own_plant=PLANT)
    assert study.planned.margins["polynomial"].satisfied
    found = study.run().comparison
    assert found.metrics["polynomial"]["iae"] < 1e-7
    jet = study.plans["polynomial"].jet(np.linspace(0.0, 1.0, 10_001), 2)[:, 0]
    torque = np.abs((jet[2] + np.sin(jet[0])) / 2.0).max()
    assert found.metrics["polynomial"]["control_peak"] == pytest.approx(torque, rel=1e-3)
    assert 0.1 < found.metrics["step"]["iae"] < 2.0


# What is wrong: data, and what the line must mention.
WRONG = {
    "no poles": (motor(loop={"kind": "dc-motor"}), ["loop.poles", "3 of angle", "none"]),
    "too few poles": (of_motor(poles=[-1.0, -2.0]), ["loop.poles", "as many as the order of the flat output, 3"]),
    "an unstable pole": (of_motor(poles=[-1.0, -2.0, 3.0]), ["loop.poles", "negative real parts"]),
    "poles of two outputs": (of_motor(poles=[[-1.0], [-2.0]]), ["loop.poles", "one sequence for each of 1"]),
    "poles in words": (of_motor(poles=["-1"]), ["loop.poles", "'-1'"]),
    "a pole": (of_motor(poles=-1.0), ["loop.poles", "-1.0"]),
    "one pole less with integral": (of_motor(integral=True), ["loop.poles", "4"]),
    "poles of a feedforward": (of_motor(law="feedforward"), ["loop.poles", "feedforward"]),
    "an unknown law": (of_motor(law="lqr"), ["loop.law", "quasi_static", "'lqr'"]),
    "a limit of no input": (
        of_motor(input_limits={"torque": [0.0, 1.0]}),
        ["loop.input_limits", "voltage", "'torque'"],
    ),
    "a limit that decreases": (of_motor(input_limits={"voltage": [1.0, 0.0]}), ["voltage"]),
    "half a limit": (of_motor(input_limits={"voltage": [1.0]}), ["loop.input_limits.voltage"]),
    "an unknown parameter": (of_motor(mass=3.0), ["loop", "resistance", "'mass'"]),
    "a parameter of 0": (of_motor(inertia=0.0), ["inertia must be finite and above 0"]),
    "an unknown steering": (
        lane(loop={"kind": "kinematic-car", "steering": "wheel"}),
        ["loop.steering", "rate", "'wheel'"],
    ),
    "an unknown kind": (motor(loop={"kind": "car"}), ["loop.kind", "kinematic-car", "'car'"]),
    "other axes": (
        motor(waypoints=[{"time": 0.0, "q": REST}, {"time": 1.0, "q": [1.0, 0.0, 0.0]}]),
        ["plan must have the axes angle", "got q"],
    ),
    "a step of a car": (
        lane(plans=[{"family": "step"}]),
        ["plan step must be continuous for kinematic_car", "squared speed"],
    ),
    "a step of a feedforward": (
        motor(loop={"kind": "dc-motor", "law": "feedforward"}, plans=[{"family": "step"}]),
        ["plan step must be continuous for a feedforward"],
    ),
    "a car that stops without a deceleration": (
        lane(t_end=4.0),
        ["plan polynomial must end at rest, or at t_end = 4 s", "3 s"],
    ),
    "the benefit of a car": (lane(benefit=True), ["benefit must be false for kinematic_car, got true"]),
    "a plan to the end of the run": (motor(t_end=1.0), ["t_end", "after the last waypoint"]),
    "poles for a loop": (
        motor(loop=FROM_MODULE | {"kind": "python:own_plant:loop"}),
        ["loop.poles", "a ctrlplan.FlatSystem only", "StateSpace"],
    ),
    "a flat system of python-control": (
        motor(loop=FROM_MODULE | {"kind": "python:own_plant:other"}),
        ["a ctrlplan.FlatSystem", "control.flatsys.LinearFlatSystem", "ctrlplan.flat_system"],
    ),
    "no poles for a flat system": (motor(loop={"kind": "python:own_plant:plant"}), ["loop.poles", "2 of angle"]),
}


@pytest.mark.parametrize("name", one_in(3, WRONG))
def test_what_is_wrong_is_said_in_one_line(name, stated, tmp_path, monkeypatch, capsys):
    data, mentions = WRONG[name]
    (tmp_path / "own_plant.py").write_text(PLANT, encoding="utf-8")
    (tmp_path / "study.toml").write_text(to_toml(data), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["report", "study.toml", "--out", "out"]) == 2
    lines = [
        line for line in capsys.readouterr().err.splitlines() if not re.match("ctrlplan: (running|planning)", line)
    ]
    assert len(lines) == 1, lines
    assert re.search(r"study\.toml: .*\bmust\b.*\bgot\b", lines[0]), lines[0]
    for part in mentions:
        assert part in lines[0], lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", WRONG)
def test_the_schema_says_what_the_reader_says_of_structure(name):
    data, _ = WRONG[name]
    assert bool(schema_errors(data)) == (structure_error(data) is not None)


@pytest.mark.parametrize("data", [motor(), lane(), motor(loop=FROM_MODULE)], ids=["motor", "lane", "module"])
def test_the_schema_accepts_what_is_right(data):
    assert schema_errors(data) == []


def test_errors_of_a_file_are_study_errors(stated):
    with pytest.raises(StudyError, match=r"loop\.poles"):
        stated(of_motor(poles=[-1.0]))
