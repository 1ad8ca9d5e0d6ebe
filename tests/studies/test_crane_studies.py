"""The three simulations of the paper against an independent integration of the crane by hand."""

import math

import numpy as np
import pytest
from crane_table import SLACK, TABLE, computed

import ctrlplan as cp
from ctrlplan.reports import verdicts
from ctrlplan.studies import crane as studies
from ctrlplan.studies.crane_setup import load_metrics
from ctrlplan.systems.plants import Crane, crane_loop


def first_order(**options):
    return cp.TrigSpline(studies.first_order_waypoints(), **options)


# Plan, last waypoint, end of the run.
RUNS = {
    "nominal polynomial": (lambda: cp.PolySpline(studies.nominal_waypoints()), 15, 30),
    "nominal trigonometric": (lambda: cp.TrigSpline(studies.nominal_waypoints(), alpha=1.0), 15, 30),
    "first-order polynomial": (lambda: cp.PolySpline(studies.first_order_waypoints()), 30, 60),
    "first-order trigonometric": (lambda: first_order(alpha=math.pi / 3, gamma=math.pi / 2), 30, 60),
    "first-order trigonometric, alpha pi": (lambda: first_order(alpha=math.pi), 30, 60),
    "obstacle polynomial": (lambda: cp.PolySpline(studies.obstacle_waypoints()), 16, 30),
    "obstacle trigonometric": (lambda: cp.TrigSpline(studies.obstacle_waypoints(), alpha=4.0), 16, 30),
}


@pytest.mark.slow
@pytest.mark.parametrize("row", TABLE)
def test_the_table_is_the_integration_by_hand(row):
    assert computed(row) == pytest.approx(TABLE[row], rel=5e-3)  # three digits are stored, two of some


@pytest.mark.parametrize("row", TABLE)
def test_load_errors_and_sway_are_those_of_the_table(row):
    make, last, end = RUNS[row]
    expected = TABLE[row]
    plan = make()
    loop = crane_loop(Crane(), plan)
    t = np.linspace(0, end, 100 * end + 1)
    found = cp.simulate(loop, t, initial_state=loop.initial_state)
    out = dict(zip(found.output_labels, np.asarray(found.outputs), strict=True))
    error = np.hypot(*([out["x"], out["z"]] - plan(t)))
    sway = np.abs(out["theta"])
    measured = (error[t <= last].max(), error[t >= last].max(), sway[t >= last].max())
    assert measured == pytest.approx(expected, rel=0.02)
    metrics = load_metrics(plan, found, last)
    assert (metrics["error_travel"], metrics["error_after"], metrics["sway_after"]) == pytest.approx(measured, rel=1e-3)
    assert metrics["slack_time"] == 0.0
    way = np.hypot(*np.diff([out["x"], out["z"]], axis=1)).sum()
    assert metrics["load_path"] == pytest.approx(way, rel=1e-4)


def test_the_first_order_trigonometric_plan_is_the_papers():
    """12 + 2 sin, here in the height of the second simulation: x and z in proportion."""
    t = np.linspace(0, 30, 31)
    x, z = first_order(alpha=math.pi / 3, gamma=math.pi / 2)(t)
    angle = math.pi / 3 * t / 30 - math.pi / 2
    np.testing.assert_allclose(z, 12 + 2 * np.sin(angle), atol=1e-12)
    np.testing.assert_allclose(x, 40 + 40 * np.sin(angle), atol=1e-11)


def test_path_lengths_over_the_obstacle():
    points = studies.obstacle_waypoints()
    for plan, expected in ((cp.PolySpline(points), 33.02), (cp.TrigSpline(points, alpha=4.0), 26.36)):
        t = np.linspace(0, 16, 100001)
        length = np.hypot(*np.diff(plan(t), axis=1)).sum()
        assert length == pytest.approx(expected, abs=0.005)
        loop = crane_loop(Crane(), plan)
        found = cp.simulate(loop, np.linspace(0, 17, 18), initial_state=loop.initial_state)
        assert load_metrics(plan, found, 16.0)["path_length"] == pytest.approx(length, rel=1e-5)


def test_obstacle_waypoints_are_the_papers():
    for plan in (cp.PolySpline(studies.obstacle_waypoints()), cp.PiecewiseSpline(studies.obstacle_waypoints())):
        np.testing.assert_allclose(plan.jet(6.0, 2), [[5, 5], [1, -1], [0.1, -0.15]], atol=1e-9)
        np.testing.assert_allclose(plan.jet(11.0, 2), [[15, 5], [2, 1], [0.1, 1]], atol=1e-9)
    assert [w.time for w in studies.obstacle_waypoints(20.0)] == [0, 6, 11, 20]


@pytest.mark.slow
def test_time_with_a_slack_rope_is_measured_and_marked():
    plan = cp.Step([20, 11], [0, 10], labels=["x", "z"])
    loop = crane_loop(Crane(), plan, "setpoint", force_limits=studies.FORCE_LIMITS, torque_limits=studies.TORQUE_LIMITS)
    t = np.linspace(0, 30, 3001)
    found = cp.simulate(loop, t, initial_state=loop.initial_state)
    tension = np.asarray(found.outputs)[found.output_labels.index("T")]
    metrics = load_metrics(plan, found, 15.0)
    assert tension.min() < 0
    assert metrics["slack_time"] == pytest.approx(0.01 * (tension < 0).sum(), abs=0.011)
    assert metrics["sway_after"] > 0.1
    assert math.isnan(metrics["path_length"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nominal", "first_order", "obstacle"])
def test_studies_run_whole(name, baselines, monkeypatch):
    monkeypatch.setattr(studies, "nominal_benefit", lambda: baselines)
    study = getattr(studies, f"crane_{name}_study")(progress=False)
    found = study.comparison
    assert {"step", "polynomial", "trigonometric", "piecewise"} <= found.metrics.keys()
    for row, expected in TABLE.items():
        case, _, plan = row.partition(" ")
        if case.replace("-", "_") == name:
            values = found.metrics[plan]
            assert (values["error_travel"], values["error_after"], values["sway_after"]) == pytest.approx(
                expected, rel=0.02
            )
    assert any("step" in note and "slack" in note for note in study.notes)
    if name == "nominal":
        assert found.metrics["C4 polynomial, dynamic law"]["error_travel"] < 1e-6
        assert any("+0.00030" in note and "-0.87" in note for note in study.notes)
    if name == "obstacle":
        lengths = {plan: found.metrics[plan]["path_length"] for plan in ("polynomial", "trigonometric")}
        assert lengths == pytest.approx({"polynomial": 33.02, "trigonometric": 26.36}, abs=0.005)


def test_linearised_loops_of_the_study_have_the_slowest_poles_of_the_notes():
    grows = studies._slowest(studies._linear_loop("generator"))
    damped = studies._slowest(studies._linear_loop("load_feedback"))
    assert grows.real == pytest.approx(0.00030, abs=5e-6)
    assert abs(grows.imag) == pytest.approx(0.990, abs=5e-4)
    assert damped.real == pytest.approx(-0.87, abs=5e-3)


@pytest.fixture(scope="module")
def nominal():
    """The step and one plan of the nominal study."""
    points = studies.nominal_waypoints()
    plans = {"step": (studies._step(points), studies._STEP), "polynomial": (cp.PolySpline(points), {})}
    return studies._compared(plans, points, 30.0, "Nominal")


def test_linearised_loops_of_the_page_have_the_poles_of_the_nonlinear_loop():
    """Linear blocks, and central differences of the whole crane with its PIDs, setpoints held."""
    from ctrlplan.studies.crane import CRANE, linear_pendulum_loop

    start = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    loop = cp.plants.crane_loop(CRANE, start, "setpoint")
    x, step = np.array(loop.initial_state), 1e-5
    columns = [(loop.dynamics(0.0, x + step * e, []) - loop.dynamics(0.0, x - step * e, [])) for e in np.eye(x.size)]
    expected = np.linalg.eigvals(np.transpose(columns) / (2.0 * step))
    found = np.concatenate([linear_pendulum_loop(10.0).poles(), CRANE.linear_hoist_loop().poles()])
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), atol=1e-5)
    assert [block.name for block in linear_pendulum_loop(10.0).syslist] == ["trolley_pid", "trolley", "pendulum"]


@pytest.mark.slow
def test_a_step_ends_where_the_rope_goes_slack(nominal):
    """The first root of the tension, by an independent look at a run that goes on."""
    plan = nominal.plans["step"]
    loop = crane_loop(Crane(), plan, "setpoint", force_limits=studies.FORCE_LIMITS, torque_limits=studies.TORQUE_LIMITS)
    t = np.linspace(5.0, 6.5, 15001)
    found = cp.simulate(loop, np.concatenate([[0.0], t]), events=())
    tension = np.asarray(found.outputs)[found.output_labels.index("T")][1:]
    at = int(np.flatnonzero(tension < 0.0)[0])
    root = t[at - 1] + (t[at] - t[at - 1]) * tension[at - 1] / (tension[at - 1] - tension[at])
    assert nominal.stopped == {"step": pytest.approx(root, abs=1e-5)}
    assert nominal.stopped["step"] == pytest.approx(SLACK, abs=5e-4)
    assert nominal.responses["step"].time[-1] == nominal.stopped["step"]
    assert nominal.responses["polynomial"].time[-1] == 30.0


@pytest.mark.slow
def test_what_a_step_did_outside_the_model_is_not_reported(nominal):
    row = nominal.results()["plans"]["step"]["metrics"]
    assert row["error_after"] is None
    assert row["sway_after"] is None
    assert row["slack_time"] == 0.0
    assert row["error_limited"] is None
    assert "slack" in nominal.marks["step"]
    assert any("The run ended at 5.866 s; metrics cover the time before it." in note for note in nominal.notes)
    assert all("step" not in (*v.best, *v.worst) for v in verdicts(nominal))
    note = studies._step_note(nominal)
    assert "slack at 5.87 s" in note
    assert "nan" not in note


@pytest.mark.slow
def test_the_poles_of_the_pids_are_those_of_their_loops(nominal):
    """Roots of (M s^2 + f s) s (Tf s + 1) + (Kp s + Ki)(Tf s + 1) + Kd s^2, gains of a triple pole at -5."""
    said = nominal.parameters["PID controllers"]
    crane, w, tf = Crane(), 5.0, 0.02
    b = crane.drum_radius
    drives = (
        (crane.trolley_mass, crane.trolley_friction),
        (crane.drum_inertia / b + crane.load_mass * b, crane.drum_friction / b),
    )
    for mass, friction in drives:
        kp, ki, kd = 3 * mass * w**2, mass * w**3, 3 * mass * w - friction
        closed = np.polymul(np.polymul([mass, friction, 0], [1, 0]), [tf, 1])
        closed = np.polyadd(closed, np.polymul([kp, ki], [tf, 1]))
        closed = np.polyadd(closed, [kd, 0, 0])
        for pole in np.roots(closed):
            if pole.imag > 0:
                assert f"−{-pole.real:.3g} ± {pole.imag:.3g}j" in said


def test_drives_are_at_their_limits_and_do_not_leave_them(nominal):
    (note,) = (note for note in nominal.notes if note.startswith("Events in the run with step"))
    assert "F was at its limit" in note
    assert "C was at its limit" in note
    assert "left its limits" not in note.replace("rope tension left its limits", "")


def test_no_control_of_the_crane_is_ranked_with_another_unit(nominal):
    row = nominal.metrics["polynomial"]
    assert math.isnan(row["control_peak"])
    found = nominal.responses["polynomial"]
    force = np.abs(np.asarray(found.outputs)[found.output_labels.index("F")]).max()
    assert row["control_peak_F"] == pytest.approx(force, rel=5e-3)  # between samples, too
    assert "control_effort_C" in nominal.measures
    assert "maximum over the outputs x, z" in nominal.parameters["metrics"]
