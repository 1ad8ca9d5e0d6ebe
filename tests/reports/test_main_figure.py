"""The main figure and what all figures of a page have in common: steps, coincident curves, paths, read-out."""

import json
import re
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from drawings import drawn_texts
from matplotlib.figure import Figure

import ctrlplan as cp
from ctrlplan.reports import plot_path, plot_responses, plot_sweep, render_page
from ctrlplan.reports.main_figure import main_figure
from ctrlplan.reports.readout import mark_curves, readout_data
from ctrlplan.reports.style import clip_steps, merge_coincident, page_style, to_svg
from ctrlplan.studies import Role, Study
from ctrlplan.studies.limits import limits_used
from ctrlplan.studies.sections import Paths

TIMES = np.linspace(0.0, 10.0, 401)


def plane_loop(labels=("east", "north")):
    """Two equal loops side by side."""
    one = ct.ss(cp.plants.integrator_lag_loop(20.0, outputs=("y", "u")))
    both = ct.append(one, one)
    outputs = [labels[0], "u1", labels[1], "u2"]
    return ct.ss(both.A, both.B, both.C, both.D, inputs=["r1", "r2"], outputs=outputs)


def planar(units=None):
    points = [cp.Waypoint.from_jets(0, east=[0, 0, 0], north=[0, 0, 0])]
    points += [
        cp.Waypoint.from_jets(3, east=[4.0], north=[1.0]),
        cp.Waypoint.from_jets(6, east=[5, 0, 0], north=[3, 0, 0]),
    ]
    return cp.compare(plane_loop(), points, TIMES, units=units)


@pytest.fixture(scope="module")
def moved():
    return planar({"east": "m", "north": "m", "u1": "V", "u2": "V"})


# Steps


def axes_with(**curves):
    axes = Figure().subplots()
    for name, values in curves.items():
        axes.plot(np.arange(len(values)), values, label=name)
    return axes


ROLES = {"step": Role.STEP, "a": Role.PLANNED, "b": Role.PLANNED}


def test_a_step_beyond_the_others_is_clipped_and_its_peak_is_written():
    axes = axes_with(step=[0.0, -300.0, 1.0], a=[0.0, 1.0, 2.0], b=[1.0, 0.0, -2.0])
    clip_steps(axes, ROLES)
    assert axes.get_ylim() == pytest.approx((-2.0 - 0.08 * 4.0, 2.0 + 0.08 * 4.0))
    assert axes.get_title(loc="left") == "step: peak −300, clipped"


def test_each_clipped_step_is_named_in_full():
    names = ("step", "shaped step with a name that takes more than a line")
    curves = {names[0]: [0.0, -2753.0, 1.0], names[1]: [0.0, 4.5e7, 1.0], "a": [0.0, 1.0, 2.0]}
    axes = axes_with(**curves)
    clip_steps(axes, dict.fromkeys(names, Role.STEP) | {"a": Role.PLANNED})
    lines = axes.get_title(loc="left").split("\n")
    assert lines[0] == "step: peak −2750, clipped"
    assert " ".join(lines[1:]) == f"{names[1]}: peak 4.50·10⁷, clipped"
    assert max(map(len, lines)) <= 44


@pytest.mark.parametrize(
    "curves",
    [
        {"step": [0.0, 2.9, 1.0], "a": [0.0, 1.0, 2.0]},  # by less than half of the range
        {"a": [0.0, 1.0, 200.0], "b": [0.0, 1.0, 2.0]},  # no step
        {"step": [0.0, 300.0, 1.0]},  # nothing else
        {"step": [0.0, 300.0, 1.0], "a": [1.0, 1.0, 1.0]},  # which has no range
        {"step": [0.0, 300.0, 1.0], "a": [0.0, 1e-6, 0.0]},  # an error of the simulation
    ],
)
def test_nothing_else_is_clipped(curves):
    axes = axes_with(**curves)
    before = axes.get_ylim()
    clip_steps(axes, ROLES)
    assert axes.get_ylim() == before
    assert axes.get_title(loc="left") == ""


def test_on_a_logarithmic_axis_the_range_is_one_of_decades():
    axes = axes_with(step=[1.0, 1e9, 1.0], a=[1.0, 10.0, 100.0])
    axes.set_yscale("log")
    clip_steps(axes, ROLES)
    assert axes.get_ylim() == pytest.approx((10.0**-0.16, 10.0**2.16))


def test_in_every_response_the_plans_set_the_axes():
    loop = cp.plants.integrator_lag_loop(400.0, outputs=("y", "u"))
    found = cp.compare(loop, [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)], TIMES, units={"u": "N"})
    control = plot_responses(found).axes.flat[-1]
    others = np.concatenate([r.outputs[1] for name, r in found.responses.items() if name != "step"])
    low, high = control.get_ylim()
    assert others.min() - 0.1 * np.ptp(others) <= low < high <= others.max() + 0.1 * np.ptp(others)
    assert control.get_title(loc="left") == "step: peak 400, clipped"  # u(0) = k (1 - 0)


# Curves that coincide


def test_curves_that_coincide_in_all_axes_are_one_with_all_names():
    x = np.linspace(0.0, 1.0, 50)
    one = axes_with(a=x, b=x + 1e-3, c=x**2)
    other = axes_with(a=2.0 * x, b=2.0 * x, c=2.0 * x)
    assert merge_coincident([one, other]) == {"a": ["a", "b"]}
    assert [line.get_label() for line in one.lines] == ["a = b", "c"]
    assert [line.get_label() for line in other.lines] == ["a = b", "c"]


@pytest.mark.parametrize("b", [[0.0, 0.5, 1.0], [0.0, np.nan, 1.0], [0.0, 1.0]])
def test_curves_that_differ_stay_apart(b):
    axes = axes_with(a=[0.0, 0.6, 1.0], b=b)
    assert merge_coincident([axes]) == {}
    assert [line.get_label() for line in axes.lines] == ["a", "b"]


# Paths


def test_a_planar_plan_shows_its_path_whatever_its_axes_are_called(moved):
    plot = plot_path(moved, [cp.Disc((2.5, 2.0), 0.5)])
    (axes,) = plot.axes.flat
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("east [m]", "north [m]")
    lines = {line.get_label(): line for line in axes.lines}
    assert "step" not in lines
    response = moved.responses["polynomial"]
    way = response.time <= 6.0
    np.testing.assert_array_equal(lines["polynomial"].get_xdata(), np.asarray(response.outputs)[0][way])
    np.testing.assert_array_equal(lines["polynomial"].get_ydata(), np.asarray(response.outputs)[2][way])
    assert {text.get_text(): text.xy for text in axes.texts} == {"start": (0, 0), "A": (4, 1), "goal": (5, 3)}
    (obstacle,) = axes.collections
    corners = np.concatenate([path.vertices for path in obstacle.get_paths()])
    np.testing.assert_allclose(np.hypot(*(corners - [2.5, 2.0]).T), 0.5, atol=2e-3)


@pytest.mark.parametrize("units", [None, {"east": "m", "north": "rad"}])
def test_the_page_of_a_comparison_shows_the_path_where_both_axes_have_one_unit(units):
    found = planar(units)
    sections = [type(section) for section in found.sections()]
    assert (Paths in sections) == (units is None)
    keys = [picture.key for picture in main_figure(Study("it", "It", found, sections=found.sections())).pictures]
    assert keys[0] == ("main-path" if units is None else "main-output")
    assert keys[1:] == ["main-error", "main-control"]


def test_the_error_of_a_planar_plan_is_the_distance(moved):
    with page_style():
        panels = main_figure(Study("it", "It", moved))
    (axes,) = panels.pictures[1].plot.axes.flat
    assert axes.get_ylabel() == "distance from reference [m]"
    lines = {name: line for line in axes.lines for name in line.get_label().split(" = ")}
    response, plan = moved.responses["trigonometric"], moved.plans["trigonometric"]
    expected = np.hypot(*(np.asarray(response.outputs)[[0, 2]] - plan(response.time)))
    np.testing.assert_allclose(lines["trigonometric"].get_ydata(), expected, atol=1e-9)


# The read-out


@pytest.mark.slow
def test_the_read_out_knows_where_each_curve_is():
    """Points of a drawn curve, taken back through the box and the scales, are those that were drawn."""
    figure = Figure(figsize=(5, 4), layout="constrained")
    linear, symlog = figure.subplots(2, 1)
    x = np.linspace(0.0, 10.0, 11)
    linear.plot(x, np.exp(0.5 * x), label="it", linestyle="-")
    linear.set_yscale("log")
    symlog.plot(x, 10.0**x, label="it")
    symlog.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    mark_curves(figure)
    svg = to_svg(figure, "key")
    data = json.loads(readout_data(figure, "key"))
    for axes, values in zip(data["axes"], (np.exp(0.5 * x), 10.0**x), strict=True):
        ((key, entry),) = axes["curves"].items()
        assert entry == ["it", False]
        path = re.search(rf'id="{key}"><path d="([^"]*)"', svg)[1]
        points = np.array([[float(v) for v in pair.split()] for pair in re.split("[ML]", path)[1:]])
        left, top, width, height = axes["box"]
        low, high, *_ = axes["x"]
        np.testing.assert_allclose(low + (points[:, 0] - left) / width * (high - low), x, atol=1e-3 * 10)
        part = 1.0 - (points[:, 1] - top) / height
        first, last, kind, *more = axes["y"]
        if kind == "log":
            found = np.log10(first) + part * (np.log10(last) - np.log10(first))
            np.testing.assert_allclose(found, np.log10(values), atol=1e-2)
        else:
            edge, scale = more
            flat = scale / (1.0 - 1.0 / 10.0)  # matplotlib's own definition of the scale

            def mapped(value, edge=edge, flat=flat):
                return np.where(value <= edge, value * flat, edge * (flat + np.log10(np.maximum(value, edge) / edge)))

            np.testing.assert_allclose(mapped(first) + part * (mapped(last) - mapped(first)), mapped(values), atol=2e-2)


def test_a_figure_without_curves_has_no_read_out():
    assert readout_data(Figure(), "key") == ""


# Limits and sweeps


@pytest.mark.slow
def test_limits_of_each_run_with_margins_and_the_active_one():
    """A PI loop that saturates for the step, and a gentle plan with a margin that is known."""
    pid = cp.create_pid_iosystem(2.0, 1.0, 0.0, 0.1, limits=(-1.0, 0.5), inputs=("r", "y"), outputs="u", name="pid")
    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([pid, plant], inputs="r", outputs=["y", "u"])
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(8, 0.3, 0, 0)]
    plans = {"step": cp.Step(0.3), "gentle": cp.PolySpline(move)}
    found = cp.compare(loop, plans, TIMES, units={"u": "V"})
    step, gentle = limits_used(found)
    assert (step.plan, step.signal, step.low, step.high) == ("step", "u", -1.0, 0.5)
    assert step.value == 0.5
    assert step.share == 0.0
    assert 0.0 < step.at_limit < 0.5
    u = np.asarray(found.responses["gentle"].outputs)[1]
    assert gentle.value == u.max()
    assert gentle.margin == pytest.approx(0.5 - u.max())
    assert gentle.share == pytest.approx(1.0 - u.max() / 0.5)
    assert gentle.at_limit == 0.0
    page = render_page([Study("it", "It", found)], "It")
    assert "Actuator limits: satisfied; reached: u (step)." in page
    assert "u (active)" in page
    assert "−1.000 to 0.5000 V" in page


@pytest.mark.slow
def test_a_sweep_writes_its_page(tmp_path):
    def build(gain):
        if gain > 50.0:
            raise ValueError("the gain & the <loop> are too high")
        return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))

    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    units = {"y": "m", "u": "V"}
    found = cp.sweep(build, [1.0, 5.0, 20.0, 100.0], move, TIMES, parameter="gain", units=units, progress=False)
    page = found.report(tmp_path, title="Gains & <more>").read_text(encoding="utf-8")
    assert "Gains &amp; &lt;more&gt;" in page
    assert "gain = 100" in page
    assert "the gain &amp; the &lt;loop&gt; are too high" in page
    texts = drawn_texts(page)
    assert {"Settling time [s]", "gain"} <= {text.strip() for text in texts}
    labels = [axes.get_ylabel() for axes in plot_sweep(found, ["iae", "control_peak", "control_effort"]).axes.flat]
    assert labels == ["IAE of the tracking error [m s]", "Peak control [V]", "Control effort [V² s]"]
    assert found.merged(replace(found, values=found.values + 0.5)).units == units


def test_a_sweep_without_results_has_no_page(tmp_path):
    found = replace(
        cp.sweep(cp.plants.integrator_lag_loop, [1.0], [cp.Waypoint(0, 0), cp.Waypoint(1, 1)], TIMES, progress=False),
        metrics={},
    )
    with pytest.raises(ValueError, match="a report must have metrics, got a sweep in which every value failed"):
        found.report(tmp_path)
    assert not list(tmp_path.iterdir())
