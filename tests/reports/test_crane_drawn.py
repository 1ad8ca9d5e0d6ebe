"""The crane drawn is the crane simulated: geometry, limits, waypoints and plans, whatever they are."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawings import drawn_texts
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.reports import CraneAnimation, draw, render_page
from ctrlplan.reports.crane_figures import animation_data, plot_motion, plot_paths, plot_step, plot_time
from ctrlplan.studies import Study, sections
from ctrlplan.studies.files import load_study


def points(*places, start=0.0, order=("x", "z"), step=5.0):
    """Waypoints `step` seconds apart, at rest at both ends."""
    ends = (0, len(places) - 1)
    found = []
    for i, place in enumerate(places):
        jets = {label: [place["xz".index(label)]] + ([0.0, 0.0] if i in ends else []) for label in order}
        found.append(cp.Waypoint.from_jets(start + step * i, **jets))
    return found


def compared(places, plans=None, crane=None, law="generator", **options):
    crane = crane or cp.plants.Crane()
    plans = plans or {"polynomial": cp.PolySpline(places), "trigonometric": cp.TrigSpline(places, alpha=1.0)}
    loops = {key: options.pop(key) for key in ("force_limits", "torque_limits") if key in options}

    def build(name, plan):
        return cp.plants.crane_loop(crane, plan, "setpoint" if plan.jumps(0) else law, **loops)

    start = places[0].time
    times = np.linspace(start, places[-1].time + 5.0, 301)
    return cp.compare(build, plans, times, waypoints=places, controls=("F", "C"), **options)


def wide(drum, **other):
    return cp.plants.Crane(drum_radius=drum, **other)


MOVE = points((0.0, 10.0), (8.0, 6.0), (20.0, 11.0))


def signals(comparison, name):
    response = comparison.responses[name]
    return dict(zip(response.output_labels, np.asarray(response.outputs), strict=True)) | {"t": response.time}


# The rope


def ropes(axes):
    """Ends (top, load) of the ropes that were drawn."""
    return [line.get_xydata() for line in axes.lines if line.get_color() == "#888888"]


@pytest.mark.slow
@pytest.mark.parametrize("drum", [0.05, 0.25, 1.5])
def test_ropes_leave_the_drum_that_was_simulated_and_end_at_the_load(drum):
    found = compared(MOVE, crane=wide(drum))
    for name, axes in zip(("polynomial", "trigonometric"), plot_motion(found, None).axes.flat, strict=True):
        known = signals(found, name)
        times = np.linspace(0.0, 10.0, 13)
        assert len(ropes(axes)) == 13
        for t, (top, load) in zip(times, ropes(axes), strict=True):
            d, r, theta = (np.interp(t, known["t"], known[k]) for k in ("D", "R", "theta"))
            # The point of tangency, and the load R beyond it along the rope (samples are 50 ms apart).
            assert top == pytest.approx([d + drum * math.cos(theta), -drum * math.sin(theta)], abs=2e-3)
            assert load == pytest.approx(top + r * np.array([math.sin(theta), math.cos(theta)]), abs=2e-3)


@pytest.mark.parametrize("drum", [0.05, 1.5])
def test_the_animation_has_the_drum_that_was_simulated(drum):
    found = compared(MOVE, crane=wide(drum))
    data = json.loads(animation_data(found))
    assert data["b"] == pytest.approx(drum, abs=1e-6)
    assert json.dumps(data["b"]) in CraneAnimation(found)._repr_html_()
    for name, (d, r, theta) in data["plans"].items():
        known = signals(found, name)
        t = np.arange(len(d)) / data["rate"]
        x = np.array(d) + data["b"] * np.cos(theta) + np.array(r) * np.sin(theta)
        z = np.array(r) * np.cos(theta) - data["b"] * np.sin(theta)
        # Of frames rounded to a millimetre and a milliradian, on a rope of 11 m.
        np.testing.assert_allclose(x, np.interp(t, known["t"], known["x"]), rtol=0, atol=0.01)
        np.testing.assert_allclose(z, np.interp(t, known["t"], known["z"]), rtol=0, atol=0.01)


def test_a_parameter_of_the_run_is_drawn_as_it_ran():
    found = compared(MOVE, params={"drum_radius": 0.3})
    assert json.loads(animation_data(found))["b"] == pytest.approx(0.3, abs=1e-6)


@pytest.mark.slow
def test_cranes_that_differ_are_each_drawn_as_they_are():
    drums = {"polynomial": 0.25, "trigonometric": 1.0}
    plans = {"polynomial": cp.PolySpline(MOVE), "trigonometric": cp.TrigSpline(MOVE, alpha=1.0)}
    found = cp.compare(
        lambda name, plan: cp.plants.crane_loop(wide(drums[name]), plan), plans, np.linspace(0, 12, 241), waypoints=MOVE
    )
    assert json.loads(animation_data(found))["b"] == pytest.approx(drums, abs=1e-6)


# Limits


def dashed(axes):
    return sorted(line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == "--")


@pytest.mark.slow
def test_limits_drawn_are_those_of_the_loop():
    plans = {"jump": cp.Step([20.0, 11.0], [0.0, 10.0], labels=["x", "z"])}
    found = compared(MOVE, plans, force_limits=(-12e3, 7e3), torque_limits=(-2.5e3, -200.0))
    force, torque, tension, _ = plot_step(found).axes.flat
    assert dashed(force) == [-12.0, 7.0]
    assert dashed(torque) == [-2.5, -0.2]
    assert dashed(tension) == [0.0]
    assert found.limits == {"jump": {"F": (-12e3, 7e3), "C": (-2.5e3, -200.0)}}


def test_without_limits_none_are_drawn():
    force, torque, tension, _ = plot_step(compared(MOVE, {"step": cp.Step([2.0, 10.0], [0.0, 10.0])})).axes.flat
    assert [dashed(axes) for axes in (force, torque, tension)] == [[], [], [0.0]]


def test_the_figure_of_the_step_needs_one():
    with pytest.raises(ValueError, match="must have a step for this figure"):
        plot_step(compared(MOVE))


# Waypoints


def marked(drawn):
    (axes,) = drawn.axes.flat
    return {text.get_text(): text.xy for text in axes.texts}


@pytest.mark.parametrize("inner", [0, 1, 2, 3, 7, 30])
def test_any_number_of_waypoints_is_named(inner):
    places = [(float(i), 10.0 - 0.1 * i) for i in range(inner + 2)]
    found = compared(points(*places, step=3.0), {"piecewise": cp.PiecewiseSpline(points(*places, step=3.0))})
    names = marked(plot_paths(found, None))
    assert len(names) == inner + 2
    assert list(names)[:1] == ["start"]
    assert list(names)[-1:] == ["goal"]
    letters = [*(chr(65 + i) for i in range(26)), "AA", "AB", "AC", "AD"]
    assert list(names)[1:-1] == letters[:inner]
    np.testing.assert_allclose(list(names.values()), places)


@pytest.mark.slow
@pytest.mark.parametrize("places", [((0.0, 10.0), (20.0, 11.0)), ((0.0, 11.0), (20.0, 10.0))])
def test_names_of_waypoints_do_not_cross_the_edge(places):
    """z points down: the deeper end is next to the lower edge."""
    (axes,) = plot_paths(compared(points(*places)), None).axes.flat
    axes.figure.set_size_inches(4.0, 2.5)
    axes.figure.canvas.draw()
    names = [text for text in axes.texts if text.get_text() in ("start", "goal")]
    assert len(names) == 2
    for text in names:
        assert text.get_window_extent().y0 > axes.bbox.y0, text.get_text()


@pytest.mark.slow
def test_waypoints_given_in_part_are_not_marked():
    free = [MOVE[0], cp.Waypoint.from_jets(3.0, x=[math.nan, 1.0], z=[7.0, math.nan]), *MOVE[1:]]
    found = compared(MOVE, {"polynomial": cp.PolySpline(free)})
    names = marked(plot_paths(compared(MOVE), None)) | marked(plot_paths(found, None))
    assert set(names) == {"start", "A", "goal"}
    assert set(marked(plot_paths(replace(found, waypoints=tuple(free)), None))) == {"start", "B", "goal"}


@pytest.mark.slow
def test_figures_need_no_waypoints():
    found = replace(compared(MOVE), waypoints=())
    assert marked(plot_paths(found, None)) == {}
    for axes in plot_motion(found, None).axes.flat:
        assert len(ropes(axes)) == 13
    assert json.loads(animation_data(found))["view"][2] > 20.0


@pytest.mark.slow
def test_axes_named_z_first_are_not_taken_for_x():
    """The same move, its labels the other way round: the same figures."""
    turned = points((0.0, 10.0), (8.0, 6.0), (20.0, 11.0), order=("z", "x"))
    one, other = compared(MOVE), compared(turned)
    assert marked(plot_paths(one, None)) == marked(plot_paths(other, None))
    for plot in (plot_time, lambda c: plot_paths(c, None), lambda c: plot_motion(c, None)):
        for a, b in zip(plot(one).axes.flat, plot(other).axes.flat, strict=True):
            for line, again in zip(a.lines, b.lines, strict=True):
                np.testing.assert_allclose(line.get_xydata(), again.get_xydata(), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_move_that_starts_late_is_drawn_from_its_start():
    late = compared(points((0.0, 10.0), (8.0, 6.0), (20.0, 11.0), start=100.0))
    soon = compared(MOVE)
    for a, b in zip(plot_motion(late, None).axes.flat, plot_motion(soon, None).axes.flat, strict=True):
        np.testing.assert_allclose(ropes(a), ropes(b), rtol=0, atol=1e-5)
        assert a.get_title(loc="left") == b.get_title(loc="left")
    one, other = json.loads(animation_data(late)), json.loads(animation_data(soon))
    assert one["view"] == pytest.approx(other["view"], abs=1e-3)
    for name, frames in one["plans"].items():
        assert len(frames[0]) == pytest.approx(len(other["plans"][name][0]), abs=1)
        np.testing.assert_allclose(np.array(frames)[:, :100], np.array(other["plans"][name])[:, :100], atol=2e-3)


# Plans of any name


@pytest.mark.parametrize("kind", [sections.CranePaths, sections.CraneTime, sections.CraneMotion])
@pytest.mark.parametrize("names", [("gentle",), ("a", "b", "c"), ("jump",), ("step",)])
def test_plans_may_have_any_name(kind, names):
    plans = {
        name: cp.Step([20.0, 11.0], [0.0, 10.0], labels=["x", "z"]) if name in ("jump", "step") else cp.PolySpline(MOVE)
        for name in names
    }
    (picture,) = draw(kind(), Study("it", "It", compared(MOVE, plans))).blocks
    drawn = picture.plot
    assert any(len(axes.lines) > 0 or axes.patches for axes in drawn.axes.flat) or names[0] in ("jump", "step")


@pytest.mark.slow
def test_the_step_is_left_out_by_what_it_does_and_not_by_its_name():
    plans = {"step": cp.PolySpline(MOVE), "smooth": cp.Step([20.0, 11.0], [0.0, 10.0], labels=["x", "z"])}
    found = compared(MOVE, plans)
    drawn = {line.get_label() for line in plot_paths(found).lines[0, 0]}
    assert {label for label in drawn if not label.startswith("_")} == {"step"}
    for axes in plot_time(found).axes.flat[:2]:  # drawn there, but without setting the axes
        low, high = sorted(axes.get_ylim())
        smooth = next(line.get_ydata() for line in axes.lines if line.get_label() == "step")
        assert low < smooth.min() < smooth.max() < high


# The view


@pytest.mark.slow
@pytest.mark.parametrize("scale", one_in(3, [0.1, 1.0, 30.0]))
def test_the_view_of_the_animation_holds_the_whole_way(scale):
    places = points((-5.0 * scale, 10.0 * scale), (40.0 * scale, 20.0 * scale), step=60.0)
    data = json.loads(animation_data(compared(places), ((5.0 * scale, 9.0 * scale), (12.0 * scale, 22.0 * scale))))
    left, top, width, height = data["view"]
    assert left < -5.0 * scale < 40.0 * scale < left + width
    assert top < 0.0 < 22.0 * scale < top + height
    assert max(width, height) < 4 * 45.0 * scale
    assert 0.6 * width - 1e-3 * scale < height < 1.25 * width + 1e-3 * scale


@pytest.mark.slow
def test_a_small_crane_is_animated_as_well_as_a_large_one():
    places = points((0.0, 0.1), (0.002, 0.1))
    data = json.loads(animation_data(compared(places, crane=wide(1e-3))))
    assert data["b"] == pytest.approx(1e-3, rel=1e-4)
    trolley = np.array(data["plans"]["polynomial"][0])
    assert np.unique(trolley).size > 30
    assert trolley[[0, -1]] == pytest.approx([-1e-3, 1e-3], abs=1e-5)
    assert data["view"][2] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("places", one_in(2, [((0.0, 10.0), (200.0, 10.0)), ((3.0, 10.0), (3.0, 90.0))]))
def test_the_view_is_neither_a_strip_nor_a_tower(places):
    data = json.loads(animation_data(compared(points(*places, step=60.0))))
    left, top, width, height = data["view"]
    assert 0.599 < height / width < 1.251
    for x, z in places:
        assert left < x < left + width
        assert top < z < top + height


@pytest.mark.slow
def test_a_run_that_leaves_the_range_of_numbers_is_drawn_up_to_there():
    found = compared(MOVE)
    known = found.responses["polynomial"]
    broken = np.array(known.outputs)
    broken[:, 150:] = np.inf
    lost = np.full_like(broken, np.nan)
    wild = {
        name: SimpleNamespace(time=known.time, outputs=rows, output_labels=known.output_labels)
        for name, rows in (("polynomial", broken), ("trigonometric", lost))
    }
    data = json.loads(animation_data(replace(found, responses=wild)), parse_constant=pytest.fail)
    assert list(data["plans"]) == ["polynomial"]
    assert len(data["plans"]["polynomial"][0]) == math.ceil(known.time[149] * data["rate"])


@pytest.mark.slow
def test_a_long_run_has_no_more_frames_than_can_be_played():
    found = compared(MOVE)
    known = found.responses["polynomial"]
    long = SimpleNamespace(time=known.time * 1e7, outputs=known.outputs, output_labels=known.output_labels)
    data = json.loads(animation_data(replace(found, responses={"polynomial": long, "trigonometric": long})))
    assert len(data["plans"]["polynomial"][0]) <= 20_000


# Study files

CRANE_FILE = """
t_end = {end}
samples = 201
[loop]
kind = "crane"
{loop}
{points}
"""


def crane_file(folder, places, loop="", order="xz", end=60.0):
    rows = []
    for i, place in enumerate(places):
        rest = ", 0.0, 0.0" if i in (0, len(places) - 1) else ""
        entries = [f"{label} = [{place['xz'.index(label)]!r}{rest}]" for label in order]
        rows.append("\n".join(["[[waypoints]]", f"time = {6.0 * i!r}", *entries]))
    path = folder / "crane.toml"
    path.write_text(CRANE_FILE.format(end=end, loop=loop, points="\n".join(rows)))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("inner", [0, 4])
def test_a_crane_study_file_may_have_any_number_of_waypoints(inner, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    places = [(2.0 * i, 10.0 - 0.3 * i) for i in range(inner + 2)]
    path = crane_file(tmp_path, places, "drum_radius = 1.5")
    assert main(["report", path.name, "--out", "out"]) == 0, capsys.readouterr().err
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert '"b": 1.5' in page
    names = ["start", *"ABCDE"[:inner], "goal"]
    assert set(names) <= set(drawn_texts(page))


@pytest.mark.slow
def test_the_order_of_axes_in_a_study_file_does_not_change_what_is_measured(tmp_path):
    places = [(0.0, 10.0), (12.0, 11.0)]
    found = []
    for order in ("xz", "zx"):
        (tmp_path / order).mkdir()
        found.append(load_study(crane_file(tmp_path / order, places, order=order, end=20.0)).run().comparison)
    one, other = found
    assert one.metrics["polynomial"]["error_travel"] < 0.05
    for plan, rows in one.metrics.items():
        for name, value in rows.items():
            assert other.metrics[plan][name] == pytest.approx(value, rel=1e-6, abs=1e-9, nan_ok=True), (plan, name)


# In the browser


PARTS = """
var root = document.querySelector("figure.animation"), of = k => root.querySelector("." + k);
var number = (k, keys) => keys.map(a => Number(of(k).getAttribute(a)));
return {view: root.querySelector("svg").getAttribute("viewBox").split(" ").map(Number),
  rope: number("rope", ["x1", "y1", "x2", "y2"]), load: number("load", ["cx", "cy"]),
  drum: number("drum", ["cx", "r"]), trace: of("trace").getAttribute("points").split(" ").length,
  plan: root.querySelector("select").selectedOptions[0].textContent, clock: of("clock").textContent};
"""


@pytest.mark.slow
def test_the_animation_plays_the_crane_that_was_simulated(browser, tmp_path):
    found = compared(MOVE, crane=wide(1.5))
    path = tmp_path / "index.html"
    path.write_text(
        render_page([Study("it", "It", found, sections=(sections.AnimatedCrane(),))], "It"), encoding="utf-8"
    )
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get(path.as_uri())
    shown = browser.execute_script(PARTS)
    assert shown["plan"] == "trigonometric"
    assert shown["view"] == json.loads(animation_data(found))["view"]
    # At rest at (0, 10): the rope hangs straight down from the drum, whose middle is b to the left of the load.
    assert shown["rope"] == pytest.approx([0.0, 0.0, 0.0, 10.0], abs=2e-3)
    assert shown["load"] == pytest.approx([0.0, 10.0], abs=2e-3)
    assert shown["drum"] == pytest.approx([-1.5, 1.5], abs=2e-3)
    assert shown["trace"] > 50
    (choose,) = browser.find_elements("css selector", "figure.animation select")
    browser.execute_script("arguments[0].selectedIndex = 0; arguments[0].dispatchEvent(new Event('change'))", choose)
    assert browser.execute_script(PARTS)["plan"] == "polynomial"
    browser.execute_script("document.querySelectorAll('details').forEach(folded => { folded.open = true; })")
    browser.find_element("css selector", "figure.animation .play").click()
    for _ in range(10_000):
        moved = browser.execute_script(PARTS)
        if moved["load"][0] > 1.0:
            break
    known = signals(found, "polynomial")
    t = np.interp(moved["load"][0], known["x"], known["t"])
    assert float(moved["clock"].split()[0]) == pytest.approx(t, abs=0.1)
    assert moved["load"][1] == pytest.approx(np.interp(t, known["t"], known["z"]), abs=0.01)
    assert browser.get_log("browser") == []
