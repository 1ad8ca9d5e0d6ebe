"""Several plans through one loop: what is compared, how it is measured, what is told."""

import html
import json
import re

import control as ct
import numpy as np
import pytest
from linear_table import printed
from scipy.integrate import solve_ivp
from scipy.io import loadmat
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan import metrics
from ctrlplan.reports import verdicts
from ctrlplan.studies import MEASURES, standard_plans

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
TIMES = np.linspace(0.0, 20.0, 4001)
RESPONSE = [
    "settling_time",
    "tracking_settling_time",
    "overshoot_error",
    "overshoot_final",
    "lag_error",
    "iae",
    "ise",
    "itae",
    "iae_final",
    "ise_final",
    "itae_final",
]
CONTROL = ["control_peak", "control_effort", "control_variation"]
PATH = ["wandering", "excess_variation", "turning_points", "outside_box", "reference_jerk"]


def loop(gain, outputs=("y", "u")):
    return cp.plants.integrator_lag_loop(gain, outputs=outputs)


def two_axes(gains=(5.0, 100.0)):
    """Two loops side by side that share nothing: inputs rx, rz; outputs x, z, ux, uz."""
    matrices = [ct.ss(loop(k)) for k in gains]
    side = ct.append(*matrices)
    rows = [0, 2, 1, 3]  # y, u, y, u -> y, y, u, u
    return ct.ss(side.A, side.B, side.C[rows], side.D[rows], inputs=["rx", "rz"], outputs=["x", "z", "ux", "uz"])


@pytest.fixture(scope="module")
def standard():
    return cp.compare(loop(5.0), MOVE, TIMES)


# What is compared


def test_waypoints_alone_give_the_standard_set(standard):
    assert list(standard.plans) == ["step", "polynomial", "trigonometric", "piecewise"]
    assert [type(p).__name__ for p in standard.plans.values()] == [
        "Step",
        "PolySpline",
        "TrigSpline",
        "PiecewiseSpline",
    ]
    assert list(standard.responses) == list(standard.metrics) == list(standard.plans)
    assert standard.waypoints == tuple(MOVE)
    assert standard.outputs == ("y",)
    assert standard.controls == ("u",)


def test_the_standard_plans_meet_the_waypoints():
    points = [cp.Waypoint(1.0, 2.0, 0.0), cp.Waypoint(3.0, -1.0), cp.Waypoint(4.0, 5.0, 0.0)]
    plans = standard_plans(points, alpha=2.5)
    assert plans["trigonometric"].alpha == 2.5
    for name in ("polynomial", "trigonometric", "piecewise"):
        np.testing.assert_allclose(plans[name]([1.0, 3.0, 4.0]), [2.0, -1.0, 5.0], rtol=0, atol=1e-12)
    step = plans["step"]
    assert (step.start, step(0.999), step(1.0), step(9.0)) == (1.0, 2.0, 5.0, 5.0)
    assert standard_plans(points)["trigonometric"].alpha == 1.0


def test_waypoints_may_come_from_a_generator(standard):
    again = cp.compare(loop(5.0), (w for w in MOVE), TIMES)
    assert again.metrics["trigonometric"] == standard.metrics["trigonometric"]
    assert again.waypoints == tuple(MOVE)


def test_alpha_is_that_of_the_trigonometric_plan():
    found = cp.compare(loop(5.0), MOVE, TIMES, alpha=3.0)
    assert found.plans["trigonometric"].alpha == 3.0
    alone = cp.compare(loop(5.0), {"it": cp.TrigSpline(MOVE, alpha=3.0)}, TIMES, waypoints=MOVE)
    assert alone.metrics["it"] == found.metrics["trigonometric"]


def test_named_plans_keep_their_names_and_order(standard):
    plans = {"b": cp.PolySpline(MOVE), "a": cp.Step(1.0)}
    found = cp.compare(loop(5.0), plans, TIMES, waypoints=MOVE)
    assert list(found.metrics) == ["b", "a"]
    assert found.metrics["b"] == standard.metrics["polynomial"]
    assert {k: v for k, v in found.metrics["a"].items() if k not in PATH} == {
        k: v for k, v in standard.metrics["step"].items() if k not in PATH
    }


def test_every_measure_is_taken(standard):
    for found in standard.metrics.values():
        assert list(found) == [*RESPONSE, *CONTROL, *PATH]
        assert set(found) <= set(MEASURES)
        assert all(isinstance(value, float) for value in found.values())


def test_without_waypoints_nothing_is_said_of_wandering():
    found = cp.compare(loop(5.0), {"plan": cp.PolySpline(MOVE)}, TIMES)
    assert not set(PATH) & set(found.metrics["plan"])


def test_only_what_is_wanted_is_measured(standard):
    found = cp.compare(loop(5.0), MOVE, TIMES, measures=("settling_time", "control_effort"))
    for plan, row in found.metrics.items():
        assert row == {name: standard.metrics[plan][name] for name in ("settling_time", "control_effort")}


def test_outputs_and_controls_can_be_named():
    found = cp.compare(loop(5.0, ("u", "e", "y")), {"plan": cp.PolySpline(MOVE)}, TIMES)
    assert (found.outputs, found.controls) == (("y",), ("u",))  # the axis is called y
    other = cp.PolySpline(MOVE, labels=["height"])
    found = cp.compare(loop(5.0, ("u", "e", "y")), {"plan": other}, TIMES, outputs=["y"], controls=["e", "u"])
    assert (found.outputs, found.controls) == (("y",), ("e", "u"))
    assert found.metrics["plan"]["control_peak"] == found.metrics["plan"]["control_peak_u"]
    assert found.metrics["plan"]["control_peak_u"] == pytest.approx(5 * found.metrics["plan"]["control_peak_e"])


@pytest.mark.parametrize(
    ("plans", "options", "kind", "message"),
    [
        ({}, {}, ValueError, "plans must contain at least one trajectory, got none"),
        (MOVE, {"waypoints": MOVE}, ValueError, "waypoints must be given once, got them as plans and as waypoints"),
        ({"a": 1.0}, {}, TypeError, r"plans\['a'\] must be a Trajectory, got float"),
        (
            {"a": cp.Step(1.0), "b": cp.Step([1.0, 2.0])},
            {},
            ValueError,
            "must have the same axes, got 2 in 'b' after 1",
        ),
        ({"a": cp.Step(1.0)}, {"outputs": ["nowhere"]}, ValueError, "among y, u, got 'nowhere'"),
        ({"a": cp.Step(1.0)}, {"outputs": ["y", "u"]}, ValueError, "as many as the plan's axes, 1, got y, u"),
        ({"a": cp.Step(1.0)}, {"controls": ["force"]}, ValueError, "among y, u, got 'force'"),
        ({"a": cp.Step([1.0, 2.0])}, {}, ValueError, r"must have 1 axes \(r\), got 2"),
        ([], {}, ValueError, "at least two waypoints, got 0"),
        (MOVE[:1], {}, ValueError, "at least two waypoints, got 1"),
        (MOVE[::-1], {}, ValueError, r"times must increase strictly, got waypoints\[1\].time = 0.0"),
    ],
)
def test_what_cannot_be_compared_is_refused(plans, options, kind, message):
    with pytest.raises(kind, match=message):
        cp.compare(loop(5.0), plans, TIMES, **options)


@pytest.mark.parametrize("band", [0.0, -0.02, np.nan, np.inf])
def test_a_band_that_is_none_is_refused(band):
    with pytest.raises(ValueError, match="band must"):
        cp.compare(loop(5.0), MOVE, TIMES, band=band)


# How it is measured


def test_metrics_are_those_of_the_plain_functions(standard):
    for name, plan in standard.plans.items():
        y, u = standard.responses[name].outputs
        reference = plan(TIMES)
        plain = {
            "settling_time": metrics.settling_time(TIMES, y, 1.0, 0.0),
            "tracking_settling_time": metrics.tracking_settling_time(TIMES, y, reference, 1.0, 0.0),
            "overshoot_error": metrics.overshoot(TIMES, y, 1.0, 0.0, reference=reference),
            "overshoot_final": metrics.overshoot(TIMES, y, 1.0, 0.0),
            "lag_error": metrics.lag(TIMES, y, 1.0, 0.0, reference=reference),
            "iae": metrics.iae(TIMES, reference - y),
            "ise": metrics.ise(TIMES, reference - y),
            "itae": metrics.itae(TIMES, reference - y),
            "iae_final": metrics.iae(TIMES, 1.0 - y),
            "ise_final": metrics.ise(TIMES, 1.0 - y),
            "itae_final": metrics.itae(TIMES, 1.0 - y),
            "control_peak": metrics.peak(TIMES, u),
            "control_effort": metrics.effort(TIMES, u),
            "control_variation": metrics.total_variation(TIMES, u),
        }
        assert set(plain) == {*RESPONSE, *CONTROL}
        found = {key: standard.metrics[name][key] for key in plain}
        assert found == pytest.approx(plain, rel=1e-12, abs=1e-12)


def test_path_metrics_are_those_of_the_plain_functions():
    points = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(6, 5), cp.Waypoint(10, 1, 0, 0)]
    found = cp.compare(loop(5.0), points, np.linspace(0, 30, 301), alpha=4.0).metrics
    t = np.linspace(0, 10, 40001)
    for name in ("polynomial", "trigonometric", "piecewise"):
        plan = standard_plans(points, 4.0)[name]
        assert found[name]["wandering"] == pytest.approx(metrics.wandering(t, plan(t), [0, 5, 1]), rel=1e-6, abs=1e-9)
        assert found[name]["excess_variation"] == pytest.approx(
            metrics.excess_variation(t, plan(t), [0, 5, 1]), rel=1e-6, abs=1e-9
        )
        assert found[name]["turning_points"] == metrics.turning_points(t, plan(t), [0, 5, 1])
        assert found[name]["outside_box"] == pytest.approx(metrics.outside_box(t, plan(t), [0, 5, 1]), rel=1e-6)
        jerk = metrics.jerk_cost(t, plan(t, 3))
        assert found[name]["reference_jerk"] == pytest.approx(jerk, rel=1e-6)


@pytest.mark.parametrize("gain", [1.0, 5.0, 20.0, 100.0, 1000.0])
def test_the_step_has_its_closed_form(gain):
    # y = 1 - (w_n/w_p) exp(-t/2) sin(w_p t + arccos xi); E(s) = (s + 1)/(s^2 + s + k).
    wp, wn = np.sqrt(gain - 0.25), np.sqrt(gain)
    phase = np.arccos(0.5 / wn)
    found = cp.compare(loop(gain), {"step": cp.Step(1.0)}, np.linspace(0, 40, 40001)).metrics["step"]
    assert found["overshoot_error"] == pytest.approx(100 * np.exp(-0.5 * np.pi / wp), rel=1e-6)
    assert found["overshoot_final"] == found["overshoot_error"]
    assert found["lag_error"] == pytest.approx(100.0, rel=1e-9)
    assert found["ise"] == pytest.approx((gain + 1) / (2 * gain), rel=1e-6)
    assert found["control_peak"] == pytest.approx(gain, rel=1e-9)
    assert found["control_effort"] == pytest.approx(gain * (gain + 1) / 2, rel=1e-6)

    def error(t):
        return wn / wp * np.exp(-0.5 * t) * np.sin(wp * t + phase)

    t = np.linspace(0, 40, 400001)
    last = np.flatnonzero(np.abs(error(t)) > 0.02)[-1]
    settled = brentq(lambda s: abs(error(s)) - 0.02, t[last], t[last + 1], xtol=1e-14)
    assert found["settling_time"] == pytest.approx(settled, rel=1e-8)
    # Extrema of the control k e follow each other by pi/w_p; between them it goes by their distance.
    turns = (np.arange(1, 2000) * np.pi - phase + np.arctan(2 * wp)) / wp
    swings = gain * error(np.concatenate([[0.0], turns[turns < 40], [40.0]]))
    assert found["control_variation"] == pytest.approx(np.abs(np.diff(swings)).sum(), rel=1e-5)


def test_the_response_is_that_of_an_independent_integration():
    def rates(t, x):
        s = min(t, 1.0)
        return [x[1], 5.0 * (s**3 * (10 - 15 * s + 6 * s * s) - x[0]) - x[1]]

    t = np.linspace(0, 12, 601)
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    first = solve_ivp(rates, (0, 1), [0, 0], t_eval=t[t <= 1], **options)
    second = solve_ivp(rates, (1, 12), first.y[:, -1], t_eval=t[t >= 1], **options)
    expected = np.concatenate([first.y[0], second.y[0][1:]])
    found = cp.compare(loop(5.0), {"plan": cp.PolySpline(MOVE)}, t).responses["plan"].outputs[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


def test_the_band_is_the_one_asked_for():
    wide = cp.compare(loop(1.0), {"step": cp.Step(1.0)}, TIMES, band=0.05)
    narrow = cp.compare(loop(1.0), {"step": cp.Step(1.0)}, TIMES)
    y = wide.responses["step"].outputs[0]
    assert wide.metrics["step"]["settling_time"] == metrics.settling_time(TIMES, y, 1.0, 0.0, band=0.05)
    assert wide.metrics["step"]["settling_time"] < narrow.metrics["step"]["settling_time"]
    assert wide.parameters["settling band"] == "5 %"
    assert narrow.parameters["settling band"] == "2 %"


def test_metrics_scale_with_the_move_and_do_not_move_with_the_clock(standard):
    later = [cp.Waypoint(w.time + 100, 3 * w.position, 0, 0) for w in MOVE]
    found = cp.compare(loop(5.0), later, TIMES + 100).metrics
    powers = dict.fromkeys([*RESPONSE, *CONTROL, *PATH], 0) | dict.fromkeys(
        ["iae", "iae_final", "itae", "itae_final"], 1
    )
    powers |= {"ise": 2, "ise_final": 2, "control_peak": 1, "control_effort": 2, "control_variation": 1}
    powers |= {"outside_box": 1, "reference_jerk": 2}
    for plan, row in standard.metrics.items():
        scaled = {key: 3.0 ** powers[key] * value for key, value in row.items()}
        assert found[plan] == pytest.approx(scaled, rel=1e-7, abs=1e-8, nan_ok=True)


@pytest.mark.slow
def test_times_before_the_plans_begin_do_not_count():
    early = np.union1d(np.linspace(-5, 0, 101), TIMES)
    found = cp.compare(loop(5.0), MOVE, early)
    alone = cp.compare(loop(5.0), MOVE, TIMES)
    for plan, row in alone.metrics.items():
        assert found.metrics[plan] == pytest.approx(row, rel=1e-9, abs=1e-9, nan_ok=True)
        assert np.abs(found.responses[plan].outputs[:, :100]).max() == 0.0


# More axes


@pytest.mark.slow
def test_each_axis_has_its_own_metrics_and_the_worst_stands_first():
    move = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[0, 0, 0]), cp.Waypoint.from_jets(1, x=[2, 0, 0], z=[-3, 0, 0])]
    both = cp.compare(two_axes(), move, TIMES)
    assert (both.outputs, both.controls) == (("x", "z"), ("ux", "uz"))
    alone = {
        "x": cp.compare(loop(5.0), [cp.Waypoint(w.time, w.jet[0, 0], 0, 0) for w in move], TIMES),
        "z": cp.compare(loop(100.0), [cp.Waypoint(w.time, w.jet[0, 1], 0, 0) for w in move], TIMES),
    }
    for plan, row in both.metrics.items():
        for name in RESPONSE:
            for axis, single in alone.items():
                assert row[f"{name}_{axis}"] == pytest.approx(single.metrics[plan][name], rel=1e-8, abs=1e-9)
            assert row[name] == max(row[f"{name}_x"], row[f"{name}_z"])
        for name in CONTROL:
            assert row[f"{name}_ux"] == pytest.approx(alone["x"].metrics[plan][name], rel=1e-8)
            assert row[f"{name}_uz"] == pytest.approx(alone["z"].metrics[plan][name], rel=1e-8)
            assert row[name] == max(row[f"{name}_ux"], row[f"{name}_uz"])
        jerk = sum(single.metrics[plan]["reference_jerk"] for single in alone.values())
        assert row["reference_jerk"] == pytest.approx(jerk, rel=1e-12)


def test_an_axis_that_does_not_move_is_undefined_and_hides_no_other():
    plan = cp.PolySpline(
        [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[1, 0, 0]), cp.Waypoint.from_jets(1, x=[1, 0, 0], z=[1, 0, 0])]
    )
    row = cp.compare(two_axes(), {"plan": plan}, TIMES).metrics["plan"]
    assert np.isnan(row["settling_time_z"])
    assert np.isnan(row["overshoot_error_z"])
    assert row["settling_time"] == row["settling_time_x"] < np.inf
    assert row["iae_z"] == pytest.approx(0.0, abs=1e-9)


# The state that a run begins with


@pytest.mark.slow
@pytest.mark.parametrize("gain", [5.0, 100.0])
def test_the_loop_rests_at_the_first_position(gain):
    shifted = [cp.Waypoint(w.time, w.position + 7.0, 0, 0) for w in MOVE]
    found, standard = (cp.compare(loop(gain), points, TIMES) for points in (shifted, MOVE))
    for plan, row in standard.metrics.items():
        assert found.metrics[plan] == pytest.approx(row, rel=1e-8, abs=1e-8, nan_ok=True)
        y = found.responses[plan].outputs[0]
        assert y[0] == pytest.approx(7.0, abs=1e-12)
        np.testing.assert_allclose(y - 7.0, standard.responses[plan].outputs[0], rtol=0, atol=1e-9)


def test_a_loop_with_a_constant_error_rests_at_its_own_output():
    # 4/(s + 1) in unity feedback stays at 4/5 of what it is asked for.
    closed = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 4.0)
    plan = cp.PolySpline([cp.Waypoint(2, 10, 0, 0), cp.Waypoint(3, 20, 0, 0)])
    response = cp.compare(closed, {"plan": plan}, np.linspace(0, 20, 2001)).responses["plan"]
    np.testing.assert_allclose(response.outputs[response.time <= 2], 8.0, rtol=1e-12)
    assert response.outputs[-1] == pytest.approx(16.0, rel=1e-12)


@pytest.mark.slow
def test_the_loop_rests_at_the_first_position_whatever_its_outputs_are_called():
    shifted = [cp.Waypoint(w.time, w.position + 7.0, 0, 0) for w in MOVE]
    found = cp.compare(loop(5.0, ("u", "e", "y")), shifted, TIMES, controls=["u"])
    for response in found.responses.values():
        np.testing.assert_allclose(response.outputs[2, 0], 7.0, rtol=0, atol=1e-12)
    standard = cp.compare(loop(5.0), MOVE, TIMES)
    for plan, row in standard.metrics.items():
        assert found.metrics[plan] == pytest.approx(row, rel=1e-8, abs=1e-8, nan_ok=True)


def test_the_initial_state_can_be_given():
    found = cp.compare(loop(5.0), {"step": cp.Step(1.0)}, TIMES, initial_state=[0.0, 1.0])
    assert found.responses["step"].states[:, 0].tolist() == [0.0, 1.0]


def test_every_plan_begins_at_its_own_first_position():
    plans = {"up": cp.Step(1.0, initial=0.0), "down": cp.Step(1.0, initial=4.0)}
    found = cp.compare(loop(5.0), plans, TIMES)
    assert found.responses["up"].outputs[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert found.responses["down"].outputs[0, 0] == pytest.approx(4.0, abs=1e-12)
    assert found.metrics["up"]["overshoot_error"] == pytest.approx(found.metrics["down"]["overshoot_error"], rel=1e-9)


# What is told


@pytest.mark.parametrize(
    ("num", "den", "gain", "pole"),
    [([1], [1, 1, 0], -6.0, "2 1/s"), ([1], [1, -1, 5], 4.25, "0.5 ± 3j 1/s"), ([1], [1, -3], 1.0, "2 1/s")],
)
def test_an_unstable_loop_is_reported_as_such(num, den, gain, pole, tmp_path):
    closed = cp.plants.unity_feedback_loop(num, den, gain, outputs=("y", "u"))
    found = cp.compare(closed, MOVE, TIMES)
    (note,) = found.notes
    assert f"unstable: it has a pole at {pole}" in note
    assert note in html.unescape(found._repr_html_())
    for row in found.metrics.values():
        assert row["settling_time"] == row["tracking_settling_time"] == np.inf
    found.save(tmp_path / "it.json")
    assert json.loads((tmp_path / "it.json").read_text())["plans"]["step"]["metrics"]["settling_time"] is None


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_a_loop_that_leaves_the_range_of_numbers_is_reported_too(tmp_path):
    found = cp.compare(loop(-1e4), MOVE, np.linspace(0, 30, 301))
    assert found.notes
    assert found.metrics["polynomial"]["iae"] == np.inf
    assert found.metrics["polynomial"]["settling_time"] == np.inf
    assert "never" in found.report(tmp_path).read_text(encoding="utf-8")


def test_a_loop_that_keeps_an_error_never_settles_and_says_so():
    closed = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 4.0)
    found = cp.compare(closed, MOVE, TIMES)
    assert all(row["settling_time"] == np.inf for row in found.metrics.values())
    (note,) = found.notes
    assert "step, polynomial, trigonometric, piecewise" in note
    assert "does not settle" in note
    assert "unstable" not in note


def test_a_run_that_is_too_short_says_so_of_the_plans_concerned():
    slow = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(30, 1, 0, 0)])
    (note,) = cp.compare(loop(5.0), {"fast": cp.Step(1.0), "slow": slow}, TIMES).notes
    assert note.startswith("slow: the output does not settle")


def test_a_stable_loop_that_settles_needs_no_note(standard):
    assert standard.notes == ()


def test_where_the_planned_reference_loses_the_verdict_says_so(standard):
    # At this gain the step settles first (7.56125 s against 8.02597 s, see linear_table.py).
    found = {v.key: v for v in verdicts(standard)}
    verdict = found["settling_time"]
    assert verdict.best == ("step",)
    assert set(verdict.worst) == {"polynomial", "trigonometric", "piecewise"}
    assert "best 7.561 s (step)" in verdict.sentence
    assert "worst 8.026 s (" in verdict.sentence
    assert found["overshoot_error"].worst == ("step",)


@pytest.mark.usefixtures("blank_drawings")
def test_a_plan_that_takes_its_time_loses_and_is_reported_so(tmp_path):
    slow = cp.TrigSpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(15, 1, 0, 0)], alpha=1.0)
    found = cp.compare(loop(1000.0), {"step": cp.Step(1.0), "planned": slow}, np.linspace(0, 30, 6001))
    verdict = next(v for v in verdicts(found) if v.key == "settling_time")
    assert (verdict.best, verdict.worst) == (("step",), ("planned",))
    page = found.report(tmp_path).read_text(encoding="utf-8")
    row = page.partition('<th scope="row" class="short">Settling time [s]')[2]
    cells = re.findall(r'<td class="(\w+)" data-head="(\w+)">', row.partition("</tr>")[0])
    assert cells[:2] == [("better", "step"), ("worse", "planned")]


# What it can be turned into


def test_to_pandas_has_a_row_a_metric_and_a_column_a_plan(standard):
    table = standard.to_pandas()
    assert list(table.columns) == list(standard.plans)
    assert list(table.index) == [*RESPONSE, *CONTROL, *PATH]
    assert (table.index.name, table.columns.name) == ("metric", "plan")
    for plan, row in standard.metrics.items():
        np.testing.assert_array_equal(table[plan], list(row.values()))


def test_saved_json_holds_the_metrics_and_the_plans(standard, tmp_path):
    path = tmp_path / "comparison.json"
    standard.save(path)

    def forbidden(constant):
        raise AssertionError(f"JSON has no {constant}")

    data = json.loads(path.read_text(encoding="utf-8"), parse_constant=forbidden)
    assert data["title"] == standard.title
    assert data["parameters"] == {"settling band": "2 %"}
    for plan, row in standard.metrics.items():
        saved = data["plans"][plan]["metrics"]
        assert list(saved) == list(row)
        for name, value in row.items():
            assert saved[name] == (value if np.isfinite(value) else None)
        again = cp.trajectory_from_dict(data["plans"][plan]["trajectory"])
        np.testing.assert_array_equal(again(TIMES), standard.plans[plan](TIMES))
    assert data["plans"]["step"]["metrics"]["reference_jerk"] is None  # infinite
    assert data["plans"]["step"]["metrics"]["wandering"] is None  # undefined


def test_in_a_notebook_it_is_a_table_with_the_best_values_marked(standard):
    cell = standard._repr_html_()
    assert cell.count("<table") == cell.count("</table>") == 1
    for plan in standard.plans:
        assert plan in cell
    settling = [standard.metrics[plan]["settling_time"] for plan in standard.plans]
    row = cell[cell.index("Settling time") :].partition("</tr>")[0]
    assert [f"<strong>{value:.4g}</strong>*" in row for value in settling] == [
        value == min(settling) for value in settling
    ]


@pytest.mark.slow
def test_names_are_escaped_wherever_they_are_shown(tmp_path):
    plans = {"<b>&": cp.Step(1.0), 'quo"te': cp.PolySpline(MOVE)}
    found = cp.compare(loop(5.0), plans, TIMES, title="<i>a & b</i>", parameters={"<u>": "<s>"})
    for text in (found._repr_html_(), found.report(tmp_path).read_text(encoding="utf-8")):
        for raw in ("<b>", "<i>", "<u>", "<s>"):
            assert raw not in text
        assert "&lt;b&gt;&amp;" in text


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_report_writes_a_page_into_a_folder_or_a_file(standard, tmp_path):
    assert standard.report(tmp_path / "new" / "folder") == tmp_path / "new" / "folder" / "index.html"
    assert standard.report(tmp_path / "it.html") == tmp_path / "it.html"
    assert (tmp_path / "it.html").read_text() == (tmp_path / "new" / "folder" / "index.html").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["it.html", "new"]


def test_a_comparison_cannot_be_changed(standard):
    with pytest.raises(AttributeError):
        standard.title = "other"


def test_one_loop_of_several_may_be_unstable():
    """A builder's loops differ from plan to plan: each is told by itself, whichever comes last."""
    closed = {"good": loop(5.0), "bad": cp.plants.unity_feedback_loop([1], [1, -3], 1.0, outputs=("y", "u"))}
    for order in (("good", "bad"), ("bad", "good")):
        plans = {name: cp.PolySpline(MOVE) for name in order}
        found = cp.compare(lambda name, plan: closed[name], plans, TIMES)
        (note,) = found.notes
        assert note.startswith("bad: the loop is unstable: it has a pole at 2 1/s")
        assert found.metrics["bad"]["settling_time"] == np.inf
        assert found.metrics["good"]["settling_time"] == pytest.approx(printed(5, "quintic")[1], rel=1e-4)
        assert "settling_time" in {v.key for v in verdicts(found)}


# Responses as files


def read_csv(path):
    names, *rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


def test_responses_are_exported_plan_by_plan(standard, tmp_path):
    assert standard.export(tmp_path / "runs.csv") == tmp_path / "runs.csv"
    standard.export(tmp_path / "runs.npz")
    standard.export(tmp_path / "runs.mat")
    table = read_csv(tmp_path / "runs.csv")
    mat = loadmat(tmp_path / "runs.mat", simplify_cells=True)
    np.testing.assert_array_equal(table["time"], TIMES)
    with np.load(tmp_path / "runs.npz") as data:
        assert list(data) == list(table)
        for name, response in standard.responses.items():
            for row, label in zip(response.y, response.output_labels, strict=True):
                np.testing.assert_array_equal(table[f"{name}.{label}"], row)
                np.testing.assert_array_equal(data[f"{name}.{label}"], row)
                np.testing.assert_array_equal(mat[f"{name}_{label}"]["signals"]["values"], row)
    assert sum(name.startswith("step.") for name in table) == sum(name.startswith("polynomial.") for name in table) > 2


def test_a_run_that_was_stopped_has_nan_in_the_file(tmp_path):
    """The lag 1/(s + 1) of a unit step passes 0.5 at log 2; the slow plan stays below."""
    plans = {"fast": cp.Step(1.0), "slow": cp.Step(0.4)}
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
    times = np.linspace(0.0, 2.0, 21)
    result = cp.compare(lag, plans, times, events=[cp.Event("y", high=0.5, stop=True)])
    result.export(tmp_path / "runs.csv")
    table = read_csv(tmp_path / "runs.csv")
    assert set(times) <= set(table["time"])
    after = table["time"] > np.log(2.0) + 1e-9
    assert np.isnan(table["fast.y"][after]).all()
    at = np.isin(table["time"], times) & ~after
    np.testing.assert_allclose(table["fast.y"][at], 1.0 - np.exp(-table["time"][at]), atol=1e-9)
    at = np.isin(table["time"], times)
    np.testing.assert_allclose(table["slow.y"][at], 0.4 * (1.0 - np.exp(-times)), atol=1e-9)


def test_a_comparison_is_exported_to_tables_only(standard, tmp_path):
    with pytest.raises(ValueError, match=r"path must end in one of \.csv, \.mat, \.npz, got .*runs\.c"):
        standard.export(tmp_path / "runs.c")
    assert list(tmp_path.iterdir()) == []
