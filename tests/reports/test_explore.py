"""Sliders for a plan: the plan that they describe, its response, a real kernel, and the drawing in Chromium."""

import base64
import json
import sys
from pathlib import Path

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.reports import explore as module
from ctrlplan.reports.explore import Exploration

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 0.4), cp.Waypoint(4, 1, 0, 0)]
PLANAR = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[1, 0, 0]), cp.Waypoint.from_jets(4, x=[2, 0, 0], z=[3, 0, 0])]
LAG = ct.ss([[-4.0]], [[4.0]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
SCRIPT = Path(module.__file__).with_name("templates") / "explore.js"

# The plan and its sliders


def test_there_is_a_slider_for_everything_that_is_prescribed():
    found = {slider.key: slider for slider in Exploration(MOVE).sliders}
    assert list(found) == [
        *("alpha", "y[0]", "y_d1[0]", "y_d2[0]", "time[1]", "y[1]"),
        *("time[2]", "y[2]", "y_d1[2]", "y_d2[2]"),
    ]
    assert {key: one.value for key, one in found.items() if one.value} == {
        "alpha": 1.0,
        "time[1]": 2.0,
        "y[1]": 0.4,
        "time[2]": 4.0,
        "y[2]": 1.0,
    }
    assert all(one.low < one.high for one in found.values())
    assert all(one.low <= one.value <= one.high for one in found.values())
    assert "gamma" in {slider.key for slider in Exploration(PLANAR).sliders}  # six constraints: gamma is free


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, cp.TrigSpline(MOVE, alpha=1.0)),
        ({"alpha": 3.0}, cp.TrigSpline(MOVE, alpha=3.0)),
        ({"alpha": 0.0}, cp.PolySpline(MOVE)),
        (
            {"time[1]": 2.5, "y[1]": -0.3, "time[2]": 5.0, "y_d1[2]": 0.2, "y_d2[0]": 0.1},
            cp.TrigSpline([cp.Waypoint(0, 0, 0, 0.1), cp.Waypoint(2.5, -0.3), cp.Waypoint(5, 1, 0.2, 0)], alpha=1.0),
        ),
    ],
)
def test_sliders_describe_the_plan(values, expected):
    found = Exploration(MOVE)
    plan, t = found.plan(found.checked(values)), np.linspace(-1, 6, 141)
    np.testing.assert_allclose(plan.jet(t, 3), expected.jet(t, 3), rtol=0, atol=1e-12)


def test_gamma_counts_from_its_mean():
    found, t = Exploration(PLANAR), np.linspace(0, 4, 101)
    mean = cp.TrigSpline(PLANAR, alpha=1.0).gamma[0]
    plan = found.plan(found.checked({"gamma": 0.2}))
    assert plan.gamma == pytest.approx((mean + 0.2, mean + 0.2), rel=1e-15)
    expected = cp.TrigSpline(PLANAR, alpha=1.0, gamma=[mean + 0.2, mean + 0.2])
    np.testing.assert_allclose(plan(t), expected(t), rtol=0, atol=1e-12)


@pytest.mark.parametrize("key", [slider.key for slider in Exploration(PLANAR).sliders])
@pytest.mark.parametrize("end", ["low", "high"])
def test_both_ends_of_a_slider_have_a_plan(key, end):
    found = Exploration(PLANAR)
    (slider,) = (slider for slider in found.sliders if slider.key == key)
    plan = found.plan(found.checked({key: getattr(slider, end)}))
    assert np.isfinite(plan.jet(np.linspace(plan.start, plan.end, 101), 3)).all()


@pytest.mark.slow
def test_curves_are_those_of_the_plan_and_of_the_loop():
    """Of a first-order lag, against its closed form for a step: see the second plan of the comparison."""
    found = Exploration(MOVE, LAG)
    plan = found.plan(found.initial())
    run, metrics, _ = found.run(plan)
    panels, numbers = found.scene(plan, run)
    curves = {name: numbers[row] for panel in panels for name, _, row in panel.curves}
    t = numbers[0]
    assert (t[0], t[-1], t.size) == (0.0, 6.0, 401)
    for nu, name in enumerate(("y", "y_d1", "y_d2", "y_d3")):
        np.testing.assert_allclose(curves[name], plan(t, nu), rtol=0, atol=1e-12)
    response = ct.forced_response(LAG, np.linspace(0, 6, 60001), plan(np.linspace(0, 6, 60001)))
    exact = np.interp(t, response.time, response.outputs)
    np.testing.assert_allclose(curves["response y"], exact, rtol=0, atol=1e-7)  # first-order hold over 0.1 ms
    alone = cp.compare(LAG, {"plan": plan}, found._times(plan), waypoints=plan.waypoints).metrics["plan"]
    assert metrics == pytest.approx(alone, nan_ok=True)


def test_a_plan_in_the_plane_shows_its_path():
    found = Exploration(PLANAR)
    plan = found.plan(found.initial())
    panels, numbers = found.scene(plan, None)
    path = panels[0]
    assert (path.across, path.title, path.equal, path.points) == ("x", "z", True, ((0.0, 1.0), (2.0, 3.0)))
    ((_, x, z),) = path.curves
    np.testing.assert_allclose([numbers[x], numbers[z]], plan(numbers[0]), rtol=0, atol=1e-12)
    assert [panel.title for panel in panels[1:]] == ["position", "velocity", "acceleration", "jerk"]


def test_without_a_loop_the_metrics_are_those_of_the_plan():
    """Along the diagonal: the rest-to-rest quintic has the peak velocity 15/8 d/T."""
    found = Exploration(PLANAR)
    _, metrics, _ = found.run(found.plan(found.checked({"alpha": 0.0})))
    assert metrics["duration"] == 4.0
    assert metrics["path_length"] == pytest.approx(np.hypot(2, 2), rel=1e-9)
    assert metrics["velocity"] == pytest.approx(15 / 8 * 2 / 4, rel=1e-12)


def test_a_discrete_loop_is_sampled_at_its_period():
    loop = ct.ss([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.25, inputs=["r"], outputs=["y"])
    found = Exploration(MOVE, loop)
    run, metrics, _ = found.run(found.plan(found.initial()))
    np.testing.assert_allclose(np.diff(run.t), 0.25, rtol=1e-12)
    assert np.isfinite(metrics["iae"])


def test_a_loop_of_each_plan_is_built_for_it():
    crane = cp.plants.Crane()
    points = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[10, 0, 0]), cp.Waypoint.from_jets(8, x=[4, 0, 0], z=[11, 0, 0])]
    found = Exploration(points, lambda name, plan: cp.plants.crane_loop(crane, plan))
    plan = found.plan(found.initial())
    run, metrics, _ = found.run(plan)
    panels, numbers = found.scene(plan, run)
    (_, row_x, row_z) = panels[0].curves[1]
    assert np.abs(numbers[[row_x, row_z], -1] - [4, 11]).max() < 0.1
    assert metrics["path_length" if "path_length" in metrics else "iae_x"] >= 0.0


def test_free_positions_have_no_slider_and_no_point():
    points = [PLANAR[0], cp.Waypoint.from_jets(1.5, x=[1.5], z=[np.nan, 0.25]), PLANAR[1]]
    found = Exploration(points)
    assert {"x[1]", "z_d1[1]"} <= set(found.initial())
    assert "z[1]" not in found.initial()
    panels, _ = found.scene(found.plan(found.initial()), None)
    assert panels[0].points == ((0.0, 1.0), (2.0, 3.0))
    assert (1.5, 0.25) in panels[2].points


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"beta": 1.0}, ValueError, "values must be of sliders, alpha, .*, got 'beta'"),
        ({"alpha": np.nan}, ValueError, "alpha must be finite"),
        ({"alpha": "1"}, TypeError, "alpha must be"),
    ],
)
def test_values_that_no_slider_has_are_errors(values, error, message):
    with pytest.raises(error, match=message):
        Exploration(MOVE).checked(values)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((MOVE[:1],), "at least two waypoints"),
        ((MOVE, 3), "loop must be"),
        ((MOVE, ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])), "axes"),
    ],
)
def test_what_cannot_be_explored_is_an_error_at_once(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        cp.explore(*arguments)


def test_without_anywidget_the_error_has_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(ImportError, match=r'^explore requires anywidget; install it with pip install "ctrlplan\[note'):
        cp.explore(MOVE)


# The widget


def test_a_change_of_a_trait_changes_everything_else():
    found = cp.explore(MOVE, LAG)
    assert found.set({"alpha": 2.0, "y[2]": 1.5}) is found
    assert found.values["y[2]"] == 1.5
    assert found.plan(4.0) == pytest.approx(1.5, abs=1e-12)
    assert found.waypoints[-1].position == (1.5,)
    rows = np.frombuffer(found.widget.numbers, "<f4").reshape(-1, found.widget.length)
    np.testing.assert_allclose(rows[1], found.plan(np.linspace(0, 6, 401)), rtol=0, atol=1e-6)
    assert np.ravel(found.response.outputs)[-1] == pytest.approx(1.5, abs=1e-2)
    assert found.metrics["settling_time"] > 0.0
    assert found.widget.table[0][:2] == ["Settling time", f"{found.metrics['settling_time']:.4g}"]


def test_the_table_has_the_metrics_of_all_axes_together():
    loop = ct.append(LAG, LAG)
    loop.set_inputs(["r1", "r2"])
    loop.set_outputs(["x", "z"])
    found = cp.explore(PLANAR, loop)
    titles = [row[0] for row in found.widget.table]
    assert titles[0] == "Settling time"
    assert "settling_time_x" in found.metrics
    assert not [title for title in titles if "_" in title]


def test_values_without_a_plan_show_the_error_and_raise():
    found = cp.explore(MOVE, LAG)
    before = found.widget.numbers
    found.set({"time[1]": 9.0})
    assert "times must increase strictly" in found.widget.error
    assert found.widget.numbers == before
    for name in ("plan", "response", "metrics", "waypoints"):
        with pytest.raises(ValueError, match="times must increase strictly"):
            getattr(found, name)
    assert found.set({"time[1]": 2.0}).plan.duration == 4.0
    assert found.widget.error == ""


def test_a_loop_that_diverges_is_drawn_as_far_as_numbers_go():
    fast = ct.ss([[400.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
    found = cp.explore(MOVE, fast)
    assert found.widget.error == ""
    assert len(found.widget.numbers) % (4 * found.widget.length) == 0


def test_it_is_shown_as_a_widget():
    data = cp.explore(MOVE)._repr_mimebundle_()
    shown = data[0] if isinstance(data, tuple) else data
    assert "application/vnd.jupyter.widget-view+json" in shown


# A real kernel


@pytest.mark.slow
def test_a_slider_moved_in_the_front_end_is_answered_by_the_kernel(tmp_path):
    """The message of a front end, as ipywidgets sends it, and the answers of the kernel."""
    manager = pytest.importorskip("jupyter_client.manager")
    kernel, client = manager.start_new_kernel(kernel_name="python3", cwd=str(tmp_path))
    try:
        code = (
            "import ctrlplan as cp\n"
            "move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 0.4), cp.Waypoint(4, 1, 0, 0)]\n"
            "found = cp.explore(move, cp.plants.integrator_lag_loop(100.0, outputs=('y', 'u')))\n"
            "print(found.widget.model_id, flush=True)\n"
        )
        ident = next(m["content"]["text"] for m in executed(client, code) if m["msg_type"] == "stream").strip()
        values = Exploration(MOVE).initial() | {"alpha": 2.0, "y[1]": 0.7}
        content = {"comm_id": ident, "data": {"method": "update", "state": {"values": values}, "buffer_paths": []}}
        sent = client.session.msg("comm_msg", content)
        client.shell_channel.send(sent)
        state, buffers = {}, {}
        for message in until_idle(client, sent["header"]["msg_id"]):
            data = message["content"].get("data", {})
            if message["msg_type"] == "comm_msg" and data.get("method") == "update":
                state |= data["state"]
                buffers |= {path[0]: b for path, b in zip(data["buffer_paths"], message["buffers"], strict=True)}
        assert "error" not in state  # unchanged
        assert state["count"] == 2
        rows = np.frombuffer(bytes(buffers["numbers"]), "<f4").reshape(-1, 401)
        expected = cp.TrigSpline([MOVE[0], cp.Waypoint(2, 0.7), MOVE[2]], alpha=2.0)
        np.testing.assert_allclose(rows[1], expected(np.linspace(0, 6, 401)), rtol=0, atol=1e-6)
        said = executed(client, "print(found.plan.alpha, round(float(found.plan(2.0)), 12))")
        assert "".join(m["content"]["text"] for m in said if m["msg_type"] == "stream") == "2.0 0.7\n"
    finally:
        client.stop_channels()
        kernel.shutdown_kernel(now=True)


def executed(client, code):
    """Messages of a cell."""
    return list(until_idle(client, client.execute(code)))


def until_idle(client, ident):
    """Messages that a request causes, until the kernel is idle again."""
    while True:
        message = client.get_iopub_msg(timeout=120)
        if message["parent_header"].get("msg_id") != ident:
            continue
        assert message["msg_type"] != "error", message["content"]
        if message["msg_type"] == "status" and message["content"]["execution_state"] == "idle":
            return
        yield message


# The drawing in a browser

STUB = """
const done = arguments[arguments.length - 1], state = JSON.parse(arguments[1]), heard = {};
const decoded = (text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
state.numbers = decoded(state.numbers);
window.sent = [];
window.model = {
  get: (name) => state[name],
  set: (name, value) => { state[name] = value; },
  save_changes: () => window.sent.push(JSON.parse(JSON.stringify(state.values))),
  on: (name, call) => { heard[name] = call; },
  off: (name) => { delete heard[name]; },
};
window.answer = (text) => {
  Object.assign(state, JSON.parse(text));
  state.numbers = decoded(state.numbers);
  heard["change:count"]();
};
document.body.innerHTML = "";
import("data:text/javascript;base64," + arguments[0]).then((module) => {
  module.default.render({ model: window.model, el: document.body });
  done("");
}, (error) => done(String(error)));
"""


def state_of(found):
    """State of a widget as a front end has it, as JSON."""
    names = ("sliders", "values", "scene", "table", "error", "count", "length")
    state = {name: getattr(found.widget, name) for name in names}
    return json.dumps(state | {"numbers": base64.b64encode(found.widget.numbers).decode()})


@pytest.fixture
def drawn(browser, tmp_path):
    """Render a widget in a page by its script, with a stub in place of its model."""

    def render(found):
        page = tmp_path / "page.html"
        page.write_text("<!doctype html><meta charset=utf-8><body></body>", encoding="utf-8")
        browser.get(page.as_uri())
        browser.get_log("browser")
        script = base64.b64encode(SCRIPT.read_bytes()).decode()
        assert browser.execute_async_script(STUB, script, state_of(found)) == ""
        return browser

    return render


CURVE = """
const svg = document.querySelectorAll(".drawings svg")[arguments[0]];
const all = (selector) => Array.from(svg.querySelectorAll(selector));
const tick = (kind) => all(".tick-" + kind).map((t) => [Number(t.dataset.value), Number(t.getAttribute(kind))]);
const path = all("path").find((p) => p.dataset.name === arguments[1]);
return [tick("x"), tick("y"), path.getAttribute("d")];
"""


def curve(page, panel, name):
    """Points of a curve in the units of its axes, read from the positions of their ticks."""
    across, up, path = page.execute_script(CURVE, panel, name)
    points = np.array([part.split() for part in path.replace("M", "L").split("L")[1:]], dtype=float).T
    found = []
    for ticks, places in zip((across, up), points, strict=True):
        assert 2 <= len(ticks) <= 7
        (v0, p0), (v1, p1) = ticks[0], ticks[-1]
        found.append(v0 + (places - p0) * (v1 - v0) / (p1 - p0))
    return np.array(found)


@pytest.mark.slow
def test_the_curves_are_drawn_in_the_units_of_their_axes(drawn):
    found = cp.explore(PLANAR)
    page = drawn(found)
    t = np.linspace(0, 4, 401)
    assert len(page.find_elements("css selector", ".drawings svg")) == 5
    x, z = curve(page, 0, "plan")
    # A point is written to 0.01 of 300 or 150 units of the drawing, over at most the length that the axes show.
    np.testing.assert_allclose([x, z], found.plan(t), rtol=0, atol=2e-3)
    times, speed = curve(page, 2, "z_d1")
    np.testing.assert_allclose(times, t, rtol=0, atol=1e-3)
    np.testing.assert_allclose(speed, found.plan(t, 1)[1], rtol=0, atol=1e-3)
    assert page.get_log("browser") == []


@pytest.mark.slow
def test_a_slider_sends_values_and_the_answer_is_drawn(drawn):
    found = cp.explore(MOVE, LAG)
    page = drawn(found)
    control = page.find_element("css selector", "input[name='alpha']")
    move = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'));"
    page.execute_script(move, control, 2.5)
    page.execute_script(move, control, 3.0)  # before the answer: sent after it
    sent = page.execute_script("return window.sent")
    assert [values["alpha"] for values in sent] == [2.5]
    assert sent[0] == found.values | {"alpha": 2.5}
    page.execute_script("window.answer(arguments[0])", state_of(found.set(sent[0])))
    assert [values["alpha"] for values in page.execute_script("return window.sent")] == [2.5, 3.0]
    page.execute_script("window.answer(arguments[0])", state_of(found.set({"alpha": 3.0})))
    _, y = curve(page, 0, "y")
    expected = cp.TrigSpline(MOVE, alpha=3.0)
    np.testing.assert_allclose(y, expected(np.linspace(0, 6, 401)), rtol=0, atol=1e-3)
    cells = [cell.text for cell in page.find_elements("css selector", "td")]
    assert found.widget.table[0][1] in cells
    page.execute_script("window.answer(arguments[0])", state_of(found.set({"time[1]": 9.0})))
    assert "times must increase" in page.find_element("css selector", ".error").text
    assert page.get_log("browser") == []


@pytest.mark.slow
def test_every_slider_has_a_label_and_a_reading(drawn):
    found = cp.explore(PLANAR)
    page = drawn(found)
    for slider in found.widget.sliders:
        control = page.find_element("css selector", f"input[name='{slider['key']}']")
        assert float(control.get_attribute("value")) == pytest.approx(slider["value"], abs=1e-12)
        label = page.execute_script("return arguments[0].closest('label').querySelector('span').textContent", control)
        assert label == slider["key"].split("[")[0]
