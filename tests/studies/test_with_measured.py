"""Measured runs in a comparison: the same metrics, figures and pages; what the log lacks is left out."""

import re
from dataclasses import replace

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import MEASURES, Measure
from ctrlplan.studies.verdicts import headline, verdicts

PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
TIMES = np.linspace(0.0, 3.0, 1501)
LOGGED = np.arange(-0.5, 3.5, 1e-3)
OFFSET = 7.3e-3
UNITS = {"y": "m", "u": "N"}
SHORT = ("settling_time", "iae", "overshoot_error", "control_peak", "control_effort", "wandering")


def loop(gain=30.0):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


def compared(plans=None, **options):
    return cp.compare(loop(), plans or {"step": cp.Step(1.0), "quintic": PLAN}, TIMES, units=UNITS, **options)


def machine(plan=PLAN, gain=30.0, noise=0.0, seed=0, command=True, offset=OFFSET, names=("y", "u")):
    """Log of a loop whose time is later than that of the plan."""
    run = cp.simulate(loop(gain), LOGGED, plan)
    rows = dict(zip(("y", "u"), run.outputs, strict=True))
    table = {name: rows[name] for name in names} | ({"r": plan(LOGGED).ravel()} if command else {})
    noisy = np.random.default_rng(seed)
    table = {name: row + noise * np.ptp(row) * noisy.normal(size=row.size) for name, row in table.items()}
    return cp.read_log({"time": LOGGED + offset, **table})


@pytest.fixture(scope="module")
def base():
    return compared()


# Metrics


def test_the_machine_that_is_the_model_has_the_metrics_of_the_model(base):
    found = base.with_measured({"quintic": machine()})
    assert list(found.metrics) == ["step", "quintic", "quintic (measured)"]
    one, other = found.metrics["quintic"], found.metrics["quintic (measured)"]
    assert one.keys() == other.keys()
    for name in one:
        if name == "control_variation":  # interpolation between samples does not change it
            assert other[name] == pytest.approx(one[name], rel=1e-4)
        # Linear interpolation at 1 ms: h^2/8 of a second derivative of up to 30^2.
        scale = found.scales.get(name, 1.0)
        assert other[name] == pytest.approx(one[name], rel=1e-3, abs=2e-4 * scale) or one[name] == other[name]
    assert base.metrics == {name: found.metrics[name] for name in ("step", "quintic")}
    assert list(base.measured) == []


def test_metrics_are_those_of_the_response(base):
    found = base.with_measured({"quintic": machine(gain=20.0, noise=0.01)})
    response = found.responses["quintic (measured)"]
    t, (y, u, _) = response.time, response.outputs
    metrics = found.metrics["quintic (measured)"]
    reference = PLAN(t).ravel()
    assert metrics["iae"] == pytest.approx(float(cp.metrics.iae(t, reference - y)), rel=1e-12)
    assert metrics["control_peak"] == pytest.approx(float(cp.metrics.peak(t, u)), rel=1e-12)
    assert metrics["settling_time"] == float(cp.metrics.settling_time(t, y, 1.0, 0.0, start=0.0))


def test_the_log_is_interpolated_linearly_at_the_times_of_the_comparison(base):
    log = machine(gain=20.0, noise=0.01)
    found = base.with_measured({"quintic": log}, align=OFFSET)
    response = found.responses["quintic (measured)"]
    assert np.isin(TIMES, response.time).all()
    at = np.searchsorted(response.time, TIMES)
    np.testing.assert_allclose(
        response.outputs[:, at], [np.interp(TIMES, log.time - OFFSET, row) for row in log.outputs], rtol=0, atol=1e-12
    )
    own = log.time - OFFSET
    own = own[(own >= 0.0) & (own <= 3.0)]
    assert min(np.diff(response.time)) > 1e-10
    assert max(np.abs(response.time[np.searchsorted(response.time, own - 1e-9)] - own)) < 1e-9
    assert (response.method, "linear interpolation at the 1501 times" in response.reason) == ("measured", True)
    words = "every 1 ms, and linear interpolation at the 1501 times of the simulation from 0 to 3 s"
    assert words in str(found).replace("\n", " ")


@pytest.mark.parametrize("seed", range(4))
def test_the_offset_is_found_by_the_command(base, seed):
    run = base.with_measured({"quintic": machine(gain=20.0, noise=0.01, seed=seed)}).measured["quintic (measured)"]
    assert (run.by, run.signals, run.compared) == ("command", ("r",), "the plan")
    assert run.standard_error == pytest.approx(0.26e-3, rel=0.15)
    assert abs(run.offset - OFFSET) <= 3.0 * run.standard_error


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("names", "by"), [(("y", "u"), "output"), (("u",), "control")])
def test_otherwise_by_a_simulated_signal_with_a_word_on_the_delay(base, names, by, seed):
    log = machine(noise=0.01, seed=seed, command=False, names=names)
    found = base.with_measured({"quintic": log})
    run = found.measured["quintic (measured)"]
    assert (run.by, run.signals, run.compared) == (by, names[:1], "the simulated one")
    assert abs(run.offset - OFFSET) <= 3.0 * run.standard_error < 2e-3
    mark = found.marks["quintic (measured)"]
    assert f"offset and plant delay cannot be told apart by the {by}; log the command" in mark
    assert re.search(r"its time is 7\.\d+ ± 0\.\d+ ms \(standard error\) later than that of the plan", mark)


def test_an_output_that_follows_the_plan_better_than_the_model_is_compared_with_the_plan(base):
    noise = 0.01 * np.random.default_rng(1).normal(size=LOGGED.size)
    log = cp.read_log({"time": LOGGED + OFFSET, "y": PLAN(LOGGED).ravel() + noise})
    run = base.with_measured({"quintic": log}).measured["quintic (measured)"]
    assert run.compared == "the plan"
    assert abs(run.offset - OFFSET) <= 3.0 * run.standard_error


def test_alignment_by_a_name_by_seconds_and_not_at_all(base):
    log = machine(noise=0.01)
    by_name = base.with_measured({"quintic": log}, align="y").measured["quintic (measured)"]
    assert (by_name.by, by_name.signals) == ("output", ("y",))
    for align, offset in ((0.25, 0.25), (-1, -1.0), (None, 0.0)):
        found = base.with_measured({"quintic": log}, align=align)
        run = found.measured["quintic (measured)"]
        assert (run.by, run.offset) == ("given", offset)
        assert f"its time is {abs(offset):g} s {'later' if offset >= 0 else 'earlier'}" in str(found).replace("\n", " ")
        assert np.isnan(run.standard_error)


def test_a_command_of_any_name_is_aligned_by_its_name(base):
    log = machine(noise=0.01)
    renamed = cp.read_log({"time": log.time, "y": log.outputs[0], "Sollwert": log.outputs[2]})
    run = base.with_measured({"quintic": renamed}, align="Sollwert").measured["quintic (measured)"]
    assert (run.by, run.signals) == ("command", ("Sollwert",))
    assert abs(run.offset - OFFSET) <= 3.0 * run.standard_error


# What the log lacks


@pytest.mark.parametrize(
    ("names", "kinds"), [(("y",), {"response", "path"}), (("u",), {"control", "path"}), (("y", "u"), None)]
)
def test_metrics_whose_signals_the_log_lacks_are_left_out(base, names, kinds):
    found = base.with_measured({"quintic": machine(names=names)})
    metrics = found.metrics["quintic (measured)"]
    wanted = [name for name in base.metrics["quintic"] if kinds is None or MEASURES[name].of in kinds]
    assert list(metrics) == wanted
    left = [name for name in ("y", "u") if name not in names]
    assert found.measured["quintic (measured)"].left_out == tuple(left)
    assert (f"not in the log: {', '.join(left)}" in str(found)) == bool(left)
    if left:
        assert "n/a" in str(found)


def planar():
    lag = ct.tf2ss([9.0], [1.0, 6.0, 9.0])
    both = ct.append(lag, lag)
    return ct.ss(both.A, both.B, both.C, both.D, inputs=["x_ref", "z_ref"], outputs=["x", "z"], name="plane")


def test_of_two_axes_one_may_be_logged():
    plan = cp.stack([PLAN, 2.0 * PLAN], labels=["x", "z"])
    system = planar()
    base = cp.compare(system, {"move": plan}, TIMES)
    run = cp.simulate(system, LOGGED, plan)
    whole = {"time": LOGGED, **dict(zip(run.output_labels, run.outputs, strict=True))}
    for axis in "xz":
        log = cp.read_log({name: whole[name] for name in ("time", axis)})
        metrics = base.with_measured({"move": log}, align=None).metrics["move (measured)"]
        expected = {name: value for name, value in base.metrics["move"].items() if name.endswith(f"_{axis}")}
        assert expected.keys() <= metrics.keys()
        assert not {"settling_time", "iae"} & metrics.keys()
        for name, value in expected.items():
            assert metrics[name] == pytest.approx(value, rel=1e-3, abs=1e-5)
    both = base.with_measured({"move": cp.read_log(whole)})
    assert both.metrics["move (measured)"].keys() == base.metrics["move"].keys()
    assert both.measured["move (measured)"].signals == ("x", "z")
    commands = whole | {"x_ref": plan(LOGGED - 0.02)[0], "z_cmd": plan(LOGGED - 0.02)[1]}
    run = base.with_measured({"move": cp.read_log(commands)}).measured["move (measured)"]
    assert (run.by, run.signals) == ("command", ("x_ref", "z_cmd"))
    assert run.offset == pytest.approx(0.02, abs=1e-9)


def test_measures_of_runs_are_evaluated_where_they_can_be():
    def energy(run):
        return float(np.sum(run.signals["u"] ** 2))

    def poles(run):
        return float(run.system.nstates)

    own = {"energy": Measure("Energy", of="run", function=energy), "poles": Measure("Order", of="run", function=poles)}
    base = compared(measures=own)
    whole = base.with_measured({"quintic": machine()})
    assert whole.metrics["quintic (measured)"]["energy"] > 0.0
    assert "poles" not in whole.metrics["quintic (measured)"]
    assert "not evaluated: poles (AttributeError" in whole.marks["quintic (measured)"]
    lacking = base.with_measured({"quintic": machine(names=("y",))})
    assert "energy" not in lacking.metrics["quintic (measured)"]
    assert "not evaluated: energy (KeyError: 'u')" in lacking.marks["quintic (measured)"]


def test_a_log_that_ends_early_says_what_it_covers(base):
    log = machine()
    early = cp.read_log({"time": log.time[:2000], "y": log.outputs[0][:2000], "r": log.outputs[2][:2000]})
    found = base.with_measured({"quintic": early})
    assert "from 0 to 1.499 s; metrics cover this time only, of 0 to 3 s" in str(found).replace("\n", " ")
    assert found.responses["quintic (measured)"].time[-1] == pytest.approx(1.499, abs=1e-9)


OF_MOVE = ("settling_time", "tracking_settling_time", "overshoot_error", "overshoot_final", "lag_error")


@pytest.mark.parametrize("count", [700, 1200, 1499, 1500, 1501, 2000])
def test_metrics_of_the_move_are_nan_for_a_log_that_ends_before_it(count, base):
    """The move ends at 1 s, sample 1500 of the log."""
    log = machine()
    early = cp.read_log({"time": log.time[:count], "y": log.outputs[0][:count], "u": log.outputs[1][:count]})
    found = base.with_measured({"quintic": early}, align=OFFSET)
    name = "quintic (measured)"
    t, (y, u) = found.responses[name].time, found.responses[name].outputs
    said = f"the log ends {1.501 - 1e-3 * count:.4g} s before the move: settling times, overshoot and lag are not known"
    if count < 1500:
        assert all(np.isnan(found.metrics[name][key]) for key in OF_MOVE)
        assert said in found.marks[name]
        assert found.measured[name].lacking == pytest.approx(1.501 - 1e-3 * count, abs=1e-9)
    else:
        assert not any(np.isnan(found.metrics[name][key]) for key in OF_MOVE)
        assert "before the move" not in found.marks[name]
        assert found.measured[name].lacking == 0.0
    # Integrals and peaks are over the time of the log, as the mark says.
    assert found.metrics[name]["iae"] == pytest.approx(float(cp.metrics.iae(t, PLAN(t).ravel() - y)), rel=1e-12)
    assert found.metrics[name]["control_peak"] == pytest.approx(float(cp.metrics.peak(t, u)), rel=1e-12)
    assert f"{name}: " in headline(found)
    assert "nan" not in headline(found) + str(found)


def test_each_axis_of_a_log_that_ends_before_the_move():
    points = [cp.Waypoint(0, [0, 0], [0, 0]), cp.Waypoint(1, [1, 2], [0, 0])]
    two = ct.ss(-9 * np.eye(2), 9 * np.eye(2), np.eye(2), 0, inputs=["a", "b"], outputs=["a", "b"])
    base = cp.compare(two, {"cubic": cp.PolySpline(points, labels=["a", "b"])}, TIMES)
    run = base.responses["cubic"]
    log = cp.read_log({"time": run.time[:300], "a": run.outputs[0][:300], "b": run.outputs[1][:300]})
    metrics = base.with_measured({"cubic": log}, align=None).metrics["cubic (measured)"]
    assert all(np.isnan(metrics[f"{key}{axis}"]) for key in OF_MOVE for axis in ("", "_a", "_b"))
    assert metrics.keys() == base.metrics["cubic"].keys()


# What is shown


def test_measured_runs_are_not_ranked(base):
    found = base.with_measured({"quintic": machine(noise=0.01), "step": machine(cp.Step(1.0))})
    assert [verdict.best for verdict in verdicts(found)] == [verdict.best for verdict in verdicts(base)]
    assert found.ranked == found.simulated == ["step", "quintic"]
    assert "Not ranked, because measured: quintic (measured), step (measured)" in str(found).replace("\n", " ")
    assert headline(found).startswith(headline(base).partition(" No actuator")[0])
    assert "quintic (measured): no settling time within the simulated time, overshoot" in headline(found)
    title, *_ = str(found).split("\n")
    assert title.startswith("Comparison of step, quintic, quintic (measured), step (measured)")


def test_every_log_has_its_own_column(base):
    found = base.with_measured({"quintic": machine()}).with_measured({"quintic": machine(gain=20.0)})
    assert list(found.measured) == ["quintic (measured)", "quintic (measured 2)"]
    rows = found.results()["plans"]
    assert set(rows) == set(found.metrics)
    assert list(found.to_pandas().columns) == list(found.metrics)


def test_figures_show_the_measured_run_once(base):
    found = base.with_measured({"quintic": machine(gain=20.0, noise=0.01)})
    plot = found.plot()
    labels = [text.get_text() for text in plot.legend.get_texts()]
    assert labels == ["step", "quintic", "quintic (measured)"]
    for axes, label in zip(plot.axes[:, 0], ("y", None, "u"), strict=True):
        lines = [line for line in axes.lines if line.get_label() == "quintic (measured)"]
        assert len(lines) == 1
        assert lines[0].get_linestyle() == "-"
        if label:
            response = found.responses["quintic (measured)"]
            row = response.outputs[response.output_labels.index(label)]
            np.testing.assert_array_equal(lines[0].get_ydata(), row)
    colours = {line.get_color() for line in plot.axes[0, 0].lines if not line.get_label().startswith("_")}
    assert len(colours) == 3
    plt.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("names", [("y", "u"), ("y",), ("u",)])
def test_pages_mark_the_measured_run(base, names, tmp_path):
    logs = {"quintic": machine(gain=20.0, names=names), "step": machine(cp.Step(1.0), names=names)}
    found = base.with_measured(logs)
    text = found.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "quintic (measured)†" in re.sub(r"<[^>]*>", "", text)
    assert re.search(r"† quintic \(measured\): resampled: 300\d of 4000 samples, every 1 ms", text)
    assert "found from the command r" in text
    found.export(tmp_path / "runs.csv")
    header = (tmp_path / "runs.csv").read_text(encoding="utf-8").split("\n")[0]
    assert "quintic (measured).r" in header


@pytest.mark.slow
def test_cranes_are_drawn_with_what_was_logged(tmp_path):
    crane = cp.plants.Crane()
    ends = [cp.Waypoint.from_jets(t, x=[x, 0, 0], z=[z, 0, 0]) for t, x, z in ((0, 0, 10), (10, 5, 9))]
    plan = cp.PolySpline(ends)
    t = np.linspace(0.0, 14.0, 701)
    base = cp.compare(lambda name, plan: cp.plants.crane_loop(crane, plan), {"poly": plan}, t, waypoints=ends)
    run = base.responses["poly"]
    rows = dict(zip(run.output_labels, run.outputs, strict=True))
    for names in (("x", "z"), ("x", "theta"), tuple(rows)):
        log = cp.read_log({"time": t + 3.0, **{name: rows[name] for name in names}})
        found = base.with_measured({"poly": log})
        assert [type(one) for one in found.sections()] == [type(one) for one in base.sections()]
        assert found.measured["poly (measured)"].offset == pytest.approx(3.0, abs=1e-3)
        if "theta" in names and len(names) == 2:
            found.report(tmp_path / "page.html")


def test_units_that_differ_have_no_common_metric():
    plan = cp.stack([PLAN, 2.0 * PLAN], labels=["x", "z"])
    system = planar()
    base = cp.compare(system, {"move": plan}, TIMES, units={"x": "m", "z": "rad"})
    run = cp.simulate(system, LOGGED, plan)
    log = cp.read_log({"time": LOGGED, **dict(zip(run.output_labels, run.outputs, strict=True))})
    found = base.with_measured({"move": log})
    assert np.isnan(found.metrics["move"]["iae"])
    assert np.isnan(found.metrics["move (measured)"]["iae"])
    assert found.metrics["move (measured)"]["iae_x"] == pytest.approx(found.metrics["move"]["iae_x"], rel=1e-3)


def test_a_comparison_made_by_hand_has_measured_runs_too(base):
    found = replace(base, experiment=None).with_measured({"quintic": machine()})
    assert found.metrics["quintic (measured)"]["iae"] == pytest.approx(found.metrics["quintic"]["iae"], rel=1e-3)


# Bad input


@pytest.mark.parametrize(
    ("logs", "options", "error", "message"),
    [
        ({"cubic": machine()}, {}, ValueError, "logs must be among step, quintic, got 'cubic'"),
        ({}, {}, ValueError, "logs must have at least one log"),
        (machine(), {}, TypeError, "logs must be a mapping of plans to logs, got SimulationResponse"),
        ({"quintic": "log.csv"}, {}, TypeError, r"logs\['quintic'\] must be a response.* read_log"),
        ({"quintic": machine(names=())}, {}, ValueError, r"must have one of the signals y, u, got r; name its"),
        ({"quintic": machine()}, {"align": "speed"}, ValueError, 'align must be "auto" or among y, u, r, got'),
        ({"quintic": machine()}, {"align": float("nan")}, ValueError, "align must be finite"),
        ({"quintic": machine()}, {"align": True}, TypeError, "align must be a number"),
        ({"quintic": machine(offset=100.0)}, {"align": None}, ValueError, "must overlap the simulated time, 0 to 3 s"),
        ({"quintic": machine()}, {"align": -50.0}, ValueError, r"with an offset of -50 s; give align= in seconds"),
    ],
)  # fmt: skip
def test_bad_logs(base, logs, options, error, message):
    with pytest.raises(error, match=message):
        base.with_measured(logs, **options)


def test_a_log_without_the_move_cannot_be_aligned(base):
    still = cp.read_log({"time": LOGGED, "y": np.zeros(LOGGED.size)})
    with pytest.raises(ValueError, match=r"must contain the move .* y is constant or does not follow it; give align="):
        base.with_measured({"quintic": still})
    assert "quintic (measured)" in base.with_measured({"quintic": still}, align=None).metrics


def test_a_command_in_other_units_is_an_error(base):
    log = cp.read_log({"time": LOGGED, "y": PLAN(LOGGED).ravel(), "r": 1e3 * PLAN(LOGGED).ravel()})
    with pytest.raises(ValueError, match=r"command r of logs\['quintic'\] must follow the plan, .* give its units="):
        base.with_measured({"quintic": log})
    run = base.with_measured({"quintic": log}, align="y").measured["quintic (measured)"]
    assert abs(run.offset) < 1e-9


def test_what_remains_after_alignment_is_stated(base):
    found = base.with_measured({"quintic": machine(noise=0.01)})
    residual = found.measured["quintic (measured)"].residual
    assert residual == pytest.approx(0.01, rel=0.1)
    assert f"is then {100.0 * residual:.2g} % of the range" in str(found).replace("\n", " ")


def test_two_axes_need_a_command_that_names_its_axis():
    plan = cp.stack([PLAN, 2.0 * PLAN], labels=["x", "z"])
    base = cp.compare(planar(), {"move": plan}, TIMES)
    log = cp.read_log({"time": LOGGED, "x": PLAN(LOGGED).ravel(), "Sollwert": PLAN(LOGGED).ravel()})
    with pytest.raises(ValueError, match="name a command by the label of its axis with _ref or _cmd"):
        base.with_measured({"move": log}, align="Sollwert")
