"""What metrics are relative to, which signals they rank together, what is a tie, and how a metric is added."""

import math

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.reports import render_page, summary, verdicts
from ctrlplan.reports.tables import key_table_of
from ctrlplan.simulation import Occurrence
from ctrlplan.studies import MEASURES, Measure, Study
from ctrlplan.studies.units import in_units
from ctrlplan.studies.verdicts import number, unit_of

T = np.linspace(0.0, 8.0, 8001)
MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]


def gain(k, *labels):
    """Outputs k times the references, at once."""
    names = labels or ("y",)
    return ct.ss([], [], [], k * np.eye(len(names)), inputs=[f"r_{n}" for n in names], outputs=list(names))


def trip(peak, end, label="y"):
    return cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, peak, 0), cp.Waypoint(4, end, 0, 0)], labels=[label])


def loop(k, outputs=("y", "u")):
    return cp.plants.integrator_lag_loop(k, outputs=outputs)


# Relative to the range


@pytest.mark.parametrize(
    ("peak", "end"), [(82.0, 0.1), (82.0, 0.0), (-82.0, -0.1), (-5.0, 0.0), (3.0, -1.0), (7.0, 2.0)]
)
def test_a_trip_that_returns_is_relative_to_its_range(peak, end):
    """y = 1.05 r: it runs ahead of a trip by a twentieth of its farthest point in the direction of the net change."""
    plan = trip(peak, end)
    row = cp.compare(gain(1.05), {"trip": plan}, T).metrics["trip"]
    r = plan(T)
    span = r.max() - r.min()
    sign = np.sign(end if abs(end) > 0 else peak)
    assert row["overshoot_error"] == pytest.approx(100 * max(0.0, (0.05 * sign * r).max()) / span, rel=1e-6, abs=1e-9)
    assert row["lag_error"] == pytest.approx(100 * max(0.0, (-0.05 * sign * r).max()) / span, rel=1e-6, abs=1e-9)
    assert row["overshoot_final"] == pytest.approx(100 * (sign * (1.05 * r - end)).max() / span, rel=1e-6)
    outside = np.flatnonzero(np.abs(1.05 * r - end) > 0.02 * span)
    assert row["settling_time"] == pytest.approx(T[outside[-1]], abs=2e-3)
    late = np.flatnonzero(np.abs(0.05 * r) > 0.02 * span)
    assert row["tracking_settling_time"] == pytest.approx(T[late[-1]] if late.size else 0.0, abs=2e-3)


def test_the_smaller_the_net_change_the_less_it_matters():
    """From a net change of 1 % to none nothing jumps: 82 up and 82 back is what is measured."""
    rows = [cp.compare(gain(1.05), {"trip": trip(82.0, end)}, T).metrics["trip"] for end in (0.8, 1e-3, 1e-9, 0.0)]
    for row in rows[1:]:
        assert row["overshoot_error"] == pytest.approx(rows[-1]["overshoot_error"], rel=1e-4)
        assert row["settling_time"] == pytest.approx(rows[-1]["settling_time"], abs=1e-3)
    assert rows[0]["overshoot_error"] < 6.0


def test_a_move_without_reversals_is_relative_to_its_change_as_before():
    """The range of a monotone plan is its change, to the last bit."""
    found = cp.compare(loop(5.0), MOVE, T)
    for name, plan in found.plans.items():
        y = found.responses[name].outputs[0]
        plain = cp.metrics.overshoot(T, y, 1.0, 0.0, reference=plan(T))
        assert found.metrics[name]["overshoot_error"] == pytest.approx(plain, rel=1e-13)


def test_one_axis_that_returns_does_not_spoil_the_other():
    plan = cp.stack([trip(82.0, 0.1), trip(1.0, 2.0)], labels=["x", "z"])
    row = cp.compare(gain(1.05, "x", "z"), {"both": plan}, T).metrics["both"]
    assert row["overshoot_error_x"] == pytest.approx(5.0, rel=1e-2)
    assert row["overshoot_error_z"] == pytest.approx(5.0, rel=1e-6)


# Units


@pytest.mark.parametrize(
    ("unit", "y", "u", "expected"),
    [
        ("{u}^2 s", "", "deg/s", "(deg/s)^2 s"),
        ("{u}^2 s", "", "N", "N^2 s"),
        ("{u}^2 s", "", "N m", "(N m)^2 s"),
        ("{u}", "", "deg/s", "deg/s"),
        ("{y} s", "m/s", "", "(m/s) s"),
        ("{y}^2/s^5", "m^2", "", "(m^2)^2/s^5"),
        ("{y} s", "", "N", ""),
        ("%", "", "", "%"),
    ],
)
def test_units_of_derived_quantities(unit, y, u, expected):
    assert in_units(unit, y, u) == expected


def test_the_effort_of_a_rate_is_its_square():
    found = cp.compare(loop(5.0), MOVE, T, units={"u": "deg/s", "y": "m/s"})
    assert unit_of(found, "control_effort") == "(deg/s)² s"
    assert unit_of(found, "control_peak") == "deg/s"
    assert unit_of(found, "reference_jerk") == "(m/s)²/s⁵"
    assert "deg/s² s" not in found._repr_html_()


def two_axes(units=None, **options):
    """x = r_x, theta = r_theta, controls F = 3 r_x and M = 500 r_theta."""
    system = ct.ss(
        [], [], [], [[1.0, 0], [0, 1.0], [3.0, 0], [0, 500.0]], inputs=["rx", "rt"], outputs=["x", "theta", "F", "M"]
    )
    plan = cp.stack([trip(2.0, 4.0), trip(0.1, 0.2)], labels=["x", "theta"])
    slow = plan.retime(6.0)
    return cp.compare(system, {"a": plan, "b": slow}, T, controls=["F", "M"], units=units, **options)


@pytest.mark.usefixtures("blank_drawings")
def test_signals_of_different_units_are_not_ranked_together():
    found = two_axes({"x": "m", "theta": "rad", "F": "N", "M": "N m"})
    for row in found.metrics.values():
        for name in ("control_peak", "control_effort", "control_variation", "iae", "ise_final", "itae"):
            assert math.isnan(row[name]), name
        assert row["control_peak_F"] == pytest.approx(12.0, rel=1e-9)
        assert row["control_peak_M"] == pytest.approx(100.0, rel=1e-9)
        assert not math.isnan(row["settling_time"])  # seconds are seconds
        assert not math.isnan(row["overshoot_error"])
    page = render_page([Study("mine", "Mine", found, sections=())], "Page")
    assert "Peak control (F)" in page
    assert "Control effort (M)" in page
    assert unit_of(found, "control_effort_M") == "(N m)² s"
    assert unit_of(found, "iae_theta") == "rad s"
    assert {v.key for v in verdicts(found)} >= {"control_effort_F", "control_effort_M", "iae_x", "iae_theta"}
    assert not {v.key for v in verdicts(found)} & {"control_effort", "iae"}


def test_signals_with_and_without_a_unit_are_not_ranked_together():
    found = two_axes({"F": "N"})
    for row in found.metrics.values():
        assert math.isnan(row["control_effort"])
        assert row["iae"] == max(row["iae_x"], row["iae_theta"])
    assert (unit_of(found, "control_effort_F"), unit_of(found, "control_effort_M")) == ("N² s", "")
    titles = [row[:2] for row in found.metric_table().rows]
    assert ["Control effort (F)", "N² s"] in titles
    assert ["Control effort (M)", ""] in titles


@pytest.mark.slow
@pytest.mark.parametrize("label", ["y", "y[0]"], ids=["of the axis", "of the output"])
def test_the_unit_of_an_output_is_that_of_its_metrics(label):
    """Also of an output that no axis is named like."""
    units = {"iae": "m s", "ise_final": "m² s", "itae": "m s²", "reference_jerk": "m²/s⁵", "outside_box": "m"}
    closed = ct.feedback(ct.tf([5.0], [1.0, 1.0, 0.0]))
    found = cp.compare(closed, MOVE, T, units={label: "m"})
    assert {name: unit_of(found, name) for name in units} == units
    assert ["IAE of the tracking error", "m s"] in [row[:2] for row in found.metric_table().rows]
    swept = cp.sweep(lambda k: ct.feedback(k * closed), [0.5, 1.0], MOVE, T, units={label: "m"}, progress=False)
    assert {name: swept.unit_of(name) for name in units} == units


@pytest.mark.parametrize("known", [True, False], ids=["units", "no units"])
def test_a_sweep_lists_controls_as_a_comparison_does(known):
    units = {"x": "m", "theta": "rad", "F": "N", "M": "N m"} if known else None
    found, plans = two_axes(units), two_axes().plans

    def system(k):
        gains = [[k, 0], [0, k], [3.0 * k, 0], [0, 500.0 * k]]
        return ct.ss([], [], [], gains, inputs=["rx", "rt"], outputs=["x", "theta", "F", "M"])

    swept = cp.sweep(system, [0.5, 1.0], plans, T, units=units, controls=["F", "M"], progress=False)
    for name in ("control_effort_F", "control_effort_M", "iae_x") if known else ("control_effort", "iae"):
        assert swept.title_of(name) == found.measures[name].title
        assert swept.unit_of(name) == unit_of(found, name)
    rows = [row[:2] for row in swept.metric_table().rows]
    assert (["Control effort (M)", "(N m)² s"] if known else ["Control effort", ""]) in rows
    assert not any("_" in title for title, _ in rows)


@pytest.mark.parametrize("units", [None, {"x": "m", "theta": "m", "F": "N", "M": "N"}])
def test_signals_that_are_not_known_to_differ_have_a_worst(units):
    for row in two_axes(units).metrics.values():
        assert row["control_peak"] == pytest.approx(100.0, rel=1e-9)
        assert row["iae"] == max(row["iae_x"], row["iae_theta"])


def test_the_report_says_that_figures_are_the_worst_of_the_axes():
    said = two_axes().parameters["metrics"]
    assert "maximum over the outputs x, theta" in said
    assert " and maximum over the controls F, M" in said
    assert "metrics" not in cp.compare(loop(5.0), MOVE, T).parameters


# Ties


def named(metric, a, b, **more):
    """Two plans through one loop, and metrics of one's own choice."""
    found = cp.compare(loop(100.0), {"a": cp.PolySpline(MOVE), "b": cp.Step(1.0)}, T, **more)
    for plan, value in (("a", a), ("b", b)):
        found.metrics[plan][metric] = value
    (verdict,) = (v for v in verdicts(found) if v.key == metric)
    return verdict


@pytest.mark.parametrize(
    ("metric", "scale"),
    [("overshoot_error", 100.0), ("lag_error", 100.0), ("iae", 8.0), ("settling_time", 8.0), ("itae_final", 64.0)],
)
def test_rounding_is_a_tie_and_says_within_how_much(metric, scale):
    """The plan is 1 long, the run 8 s: a difference of a millionth of the scale is rounding, of ten is not."""
    tie = named(metric, 0.0, 0.5e-6 * scale)
    assert (tie.best, tie.worst) == ((), ())
    assert f"equal for a and b, within {number(0.5e-6 * scale)}" in tie.sentence
    real = named(metric, 0.0, 1e-5 * scale)
    assert (real.best, real.worst) == (("a",), ("b",))


def test_what_is_rounding_depends_on_the_size_of_the_signals():
    """Micrometres: 1e-9 is a thousandth of the move and wins; metres: it is nothing."""
    small = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1e-6, 0, 0)]
    found = cp.compare(loop(100.0), {"a": cp.PolySpline(small), "b": cp.Step(1e-6)}, T)
    (verdict,) = (v for v in verdicts(found) if v.key == "iae")
    assert verdict.best == ("a",)
    assert named("iae", 1e-9, 2e-9).best == ()


def test_a_small_effort_next_to_that_of_a_step_is_a_value():
    """The effort is quadratic: controls of 3e-4 and 6e-4 in 8 s, next to a control of 1, are far above rounding."""
    plans = {"a": cp.Step(3e-4), "b": cp.Step(6e-4), "step": cp.Step(1.0)}
    loop = ct.ss([], [], [], [[1.0], [1.0]], inputs="r", outputs=["y", "u"])
    found = cp.compare(loop, plans, T)
    (verdict,) = (v for v in verdicts(found) if v.key == "control_effort")
    assert (verdict.best, verdict.minimum) == (("a",), pytest.approx(8.0 * 9e-8, rel=1e-12))
    (row,) = (line for line in key_table_of(found).rows if line[0].text.startswith("Control effort"))
    assert [cell.text for cell in row[1:4]] == ["7.200·10⁻⁷", "2.880·10⁻⁶", "8.000"]


def test_two_exact_loops_tie_though_their_rounding_differs():
    """The loop fed with the plan's derivatives follows to rounding, whatever the plan."""
    plans = {"quintic": cp.PolySpline(MOVE), "trig": cp.TrigSpline(MOVE, alpha=1.0)}
    forward = cp.create_feedforward_iosystem(loop(5.0, ("y",)))

    def build(name, plan):
        source = cp.create_source_iosystem(plan, 2, suffix="_ref")
        return ct.interconnect([source, forward, loop(5.0)], inputs=0, outputs=["y", "u"])

    found = cp.compare(build, plans, T)
    tied = {v.key: v for v in verdicts(found)}
    for metric in ("overshoot_error", "lag_error", "iae", "ise", "itae"):
        assert tied[metric].best == ()
    assert "10⁻⁶ of the scale" in summary(found)


# Runs that are ended


def test_a_run_that_is_ended_is_measured_up_to_then_and_says_so():
    plans = {"step": cp.Step(1.0), "plan": cp.PolySpline(MOVE)}
    found = cp.compare(loop(100.0), plans, T, events=[cp.Event("y", high=1.3, stop=True)])
    (name,) = found.stopped
    t, y = found.responses["step"].time, found.responses["step"].outputs[0]
    assert (name, found.stopped[name]) == ("step", t[-1])
    assert y[-1] == pytest.approx(1.3, rel=1e-9)
    area = np.sum(0.5 * (np.abs(1 - y[1:]) + np.abs(1 - y[:-1])) * np.diff(t))
    assert found.metrics["step"]["iae"] == pytest.approx(area, rel=1e-3)
    assert found.metrics["step"]["overshoot_error"] == pytest.approx(30.0, rel=1e-9)
    assert "metrics cover the time before it and are not ranked" in found.marks["step"]
    (note,) = (note for note in found.notes if note.startswith("Events in the run with step"))
    assert f"The run ended at {t[-1]:.4g} s; metrics cover the time before it." in note
    assert all("step" not in (*v.best, *v.worst) for v in verdicts(found))
    assert "not ranked" in summary(found).lower()


def test_a_run_that_is_ended_at_once_has_nothing_to_measure():
    found = cp.compare(loop(100.0), {"step": cp.Step(1.0)}, T, events=[cp.Event("u", high=50.0, stop=True)])
    assert "iae" not in found.metrics["step"]
    assert found.stopped["step"] == 0.0


# A metric of one's own


def late(seen):
    return np.abs(seen.error[:, -1])


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_a_metric_is_added_by_one_entry_of_the_list(monkeypatch, tmp_path):
    """The README's recipe: a function, and an entry of MEASURES; it is then computed, saved, shown and swept."""
    monkeypatch.setitem(MEASURES, "late", Measure("Error at the end", "{y}", "response", late))
    monkeypatch.setitem(
        MEASURES, "swing", Measure("Range of the control", "{u}", "control", lambda s: np.ptp(s.u, axis=1))
    )
    monkeypatch.setitem(MEASURES, "speed", Measure("Peak speed", "{y}/s", "path", lambda s: s.plan.peak(1).max()))
    closed = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 3.0, outputs=("y", "u"))
    found = cp.compare(closed, MOVE, T, units={"y": "m"})
    row = found.metrics["polynomial"]
    assert row["late"] == pytest.approx(0.25, rel=1e-9)  # 3/(s + 1) in unity feedback keeps a quarter
    assert row["swing"] == pytest.approx(np.ptp(found.responses["polynomial"].outputs[1]), rel=1e-12)
    assert row["speed"] == pytest.approx(15 / 8, rel=1e-12)
    assert {"late", "swing", "speed"} <= set(found.to_pandas().index)
    assert found.results()["plans"]["polynomial"]["metrics"]["late"] == row["late"]
    page = found.report(tmp_path).read_text(encoding="utf-8")
    assert "Error at the end" in page
    assert {"late", "swing"} <= {v.key for v in verdicts(found)}
    swept = cp.sweep(
        lambda k: cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], k), [1.0, 3.0, 9.0], MOVE, T, progress=False
    )
    np.testing.assert_allclose(swept.metrics["polynomial"]["late"], [1 / 2, 1 / 4, 1 / 10], rtol=1e-6)


@pytest.mark.slow
def test_a_metric_of_one_comparison_is_computed_and_swept():
    measures = {"late": Measure("Error at the end", "{y}", "response", late)}
    closed = cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], 3.0)
    found = cp.compare(closed, MOVE, T, measures=[Measure("Error at the end", "{y}", "response", late, "late")])
    assert found.metrics["step"] == {"late": pytest.approx(0.25, rel=1e-9)}
    build = lambda k: cp.plants.unity_feedback_loop([1.0], [1.0, 1.0], k)  # noqa: E731
    swept = cp.sweep(build, [1.0, 3.0], MOVE, T, progress=False, measures=measures)
    np.testing.assert_allclose(swept.metrics["step"]["late"], [1 / 2, 1 / 4], rtol=1e-6)


def test_a_measure_may_use_an_array_for_one_signal_after_the_other():
    """The IAE of twice the error, in the memory of the error, is twice that of the error."""

    def doubled(seen):
        error = seen.error.copy()
        once = cp.metrics.iae(seen.t, error)
        error *= 2.0
        return cp.metrics.iae(seen.t, error) / once

    ratio = Measure("IAE of twice the error", "", "response", doubled, "ratio")
    found = cp.compare(loop(1.0, outputs=("y",)), MOVE, T, measures=["ise", ratio])
    assert {row["ratio"] for row in found.metrics.values()} == {2.0}


def test_a_metric_that_a_function_returns_is_shown_by_its_name_alone():
    last = Measure("Ends", of="run", function=lambda run: {"last": run.response.outputs[0, -1]})
    found = cp.compare(loop(5.0), MOVE, T, measures={"ends": last})
    assert "ends" not in found.measures
    assert found.measures["last"].title == "last"
    assert "last" in {v.key for v in verdicts(found)}
    assert ">last<" in found._repr_html_()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Late", "", "outputs", late), "of must be"),
        (("Late", "", "response"), "of and function must be given together, got only of"),
        (("Late", "", "", late), "of and function must be given together, got only function"),
    ],
)
def test_a_measure_that_is_not_whole(arguments, message):
    with pytest.raises(ValueError, match=message):
        Measure(*arguments)


# Options


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"start": 50.0}, ValueError, "start must leave at least two of timepts, which end at 8 s, got 50.0"),
        ({"start": 8.0}, ValueError, "start must leave at least two of timepts"),
        ({"start": math.nan}, ValueError, "start must be a finite time"),
        ({"start": math.inf}, ValueError, "start must be a finite time"),
        ({"start": "a"}, TypeError, "start must be real numbers, got 'a'"),
        ({"start": True}, TypeError, "start must be a number, got True"),
        ({"start": np.timedelta64(1, "s")}, TypeError, "start must be plain numbers"),
        ({"start": [1.0]}, TypeError, "start must be a number, got"),
        ({"band": "wide"}, TypeError, "band must be real numbers, got 'wide'"),
        ({"band": True}, TypeError, "band must be a number, got True"),
        ({"band": math.nan, "measures": ["iae"]}, ValueError, "band must be a finite number above 0"),
        ({"waypoints": 3}, TypeError, "waypoints must be Waypoints, got int"),
        ({"measures": 3}, TypeError, "measures must be"),
    ],
)
def test_options_are_checked_before_anything_runs(options, kind, message):
    def build(name, plan):
        raise AssertionError("nothing should be built")

    with pytest.raises(kind, match=message):
        cp.compare(build, MOVE, T, **options)


def test_plans_that_begin_after_the_record():
    late_move = [cp.Waypoint(100, 0, 0, 0), cp.Waypoint(101, 1, 0, 0)]
    with pytest.raises(
        ValueError, match="timepts must extend beyond the start of the plans at 100 s, got 8 s as the last"
    ):
        cp.compare(loop(5.0), late_move, T)


def test_a_start_counts_for_every_metric():
    found = cp.compare(loop(5.0), MOVE, T, start=2.0)
    y = found.responses["polynomial"].outputs[0]
    known = T >= 2.0
    expected = cp.metrics.settling_time(T[known], y[known], 1.0, 0.0, start=2.0)
    assert found.metrics["polynomial"]["settling_time"] == pytest.approx(expected, rel=1e-12)
    assert found.metrics["polynomial"]["iae"] == pytest.approx(cp.metrics.iae(T[known], 1.0 - y[known]), rel=1e-9)


# Events in words


def test_an_event_keeps_its_words_whatever_it_is_called():
    event = cp.Event("u", high=15.0, name="tank: level")
    found = cp.compare(loop(100.0), {"step": cp.Step(1.0)}, T, events=[event])
    (note,) = (note for note in found.notes if "tank" in note)
    assert note.startswith("Events in the run with step: tank: level left its limits ")
    assert str(Occurrence(1.25, "tank: level", "above")) == "1.25 s: tank: level above its limit"
    assert str(Occurrence(1.25, "tank: level", "inside")) == "1.25 s: tank: level within its limits"


def test_an_actuator_is_at_its_limit_and_does_not_leave_it():
    limited = cp.create_saturation_iosystem(-1.0, 1.0, inputs="v", outputs="u", name="drive")
    plant = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="plant")
    law = ct.ss([], [], [], [[4.0, -4.0]], inputs=["r", "y"], outputs="v", name="law")
    whole = ct.interconnect([law, limited, plant], inputs=["r"], outputs=["y", "u"], name="whole")
    found = cp.compare(whole, {"step": cp.Step(1.0, labels=["r"])}, T, outputs=["y"])
    (note,) = (note for note in found.notes if note.startswith("Events in the run with step: u"))
    assert "u was at its limit (at 0 s)." in note
    occurrence = found.responses["step"].events[0]
    assert occurrence.name == "u"
    assert str(occurrence) == "0 s: u was at its limit"


@pytest.mark.slow
def test_many_loops_at_once_name_and_rank_as_one():
    """A sweep of linear loops takes the same names, metrics of the path, and signals that have no worst."""
    build = lambda k: ct.ss([], [], [], k * np.eye(2), inputs=["rx", "rt"], outputs=["x", "theta"])  # noqa: E731
    points = [cp.Waypoint.from_jets(t, x=[x, 0, 0], theta=[a, 0, 0]) for t, x, a in ((0, 0, 0), (1, 2, 0.1))]
    for options in ({"measures": ["reference_jerk", "iae"]}, {"units": {"x": "m", "theta": "rad"}}):
        swept = cp.sweep(build, [0.5, 0.9], points, T, progress=False, **options)
        for plan, row in cp.compare(build(0.9), points, T, **options).metrics.items():
            assert set(swept.metrics[plan]) == set(row)
            for name, value in row.items():
                assert swept.metrics[plan][name][1] == pytest.approx(value, rel=1e-9, abs=1e-12, nan_ok=True)
    for options, kind in (({"measures": ["nothing"]}, ValueError), ({"measures": "iae"}, TypeError)):
        with pytest.raises(kind, match="settling_time"):
            cp.sweep(build, [0.5, 0.9], points, T, progress=False, **options)


def test_rounding_is_shown_as_0_in_the_table_of_a_sweep():
    """The plan's inverse is its command: y = r but for rounding, in each loop."""
    plans = {"planned": cp.PolySpline(MOVE)}

    def build(k):
        forward = cp.create_feedforward_iosystem(loop(k, ("y",)))
        return lambda name, plan: ct.interconnect(
            [cp.create_source_iosystem(plan, 2, suffix="_ref"), forward, loop(k)], inputs=0, outputs=["y", "u"]
        )

    swept = cp.sweep(build, [5.0, 6.0], plans, T[::10], progress=False)
    assert (swept.metrics["planned"]["lag_error"] > 0.0).any()
    assert [row for row in swept.metric_table().rows if "lag" in row[0] or "Overshoot" in row[0]] == []
