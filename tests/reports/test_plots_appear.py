"""Plots are those of pyplot: shown, saved, drawn into given axes, overlaid, and as the user has set them."""

import inspect
import re
import sys
import types
import warnings
from functools import cache

import control as ct
import matplotlib as mpl
import matplotlib.image as mpimg
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.planning import AlphaChoice
from ctrlplan.planning.limits import Limited
from ctrlplan.reports import crane_figures, figures, planning_figures, render_page, vibration_figures
from ctrlplan.reports.style import as_text, page_style
from ctrlplan.studies import Study
from ctrlplan.studies.ensemble import Ensemble
from ctrlplan.studies.sections import Curves, PlanCurves, Responses

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)]
ACROSS = [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[10, 0, 0]), cp.Waypoint.from_jets(2, x=[20, 0, 0], z=[11, 0, 0])]
T = np.linspace(0.0, 2.0, 41)
OMEGA = np.linspace(1.0, 20.0, 96)
PLAN, SMOOTH = cp.PolySpline(MOVE), cp.TrigSpline(MOVE, alpha=2.0)
LIMITS = {"y_d1": 1.0, "y_d2": 2.0}


def response(labels, scale=1.0):
    """Some response with these outputs: what is drawn of it is tested elsewhere."""
    rows = np.stack([scale * np.sin(T + k) for k in range(len(labels))])
    return ct.TimeResponseData(T, rows, issiso=False, output_labels=labels, sysname="loop")


@cache
def compared():
    plans = {"step": cp.Step(1.0), "polynomial": PLAN, "mine": SMOOTH}
    runs = {name: response(["y", "u"], 1.0 + k) for k, name in enumerate(plans)}
    return cp.Comparison(plans, runs, {}, outputs=("y",), controls=("u",), waypoints=tuple(MOVE), units={"y": "m"})


@cache
def craned():
    signals = ["x", "z", "D", "R", "theta", "F", "C", "T", "x_ref"]
    plans = {"step": cp.Step([20, 11], [0, 10], labels=["x", "z"]), "polynomial": cp.PolySpline(ACROSS)}
    runs = {name: response(signals, 2.0 + k) for k, name in enumerate(plans)}
    return cp.Comparison(plans, runs, {}, outputs=("x", "z"), waypoints=tuple(ACROSS))


@cache
def swept():
    rows = {"settling_time": np.array([3.0, 2.0, 1.0]), "overshoot_error": np.array([10.0, 20.0, 30.0])}
    return cp.Sweep("gain", np.array([1.0, 2.0, 3.0]), {"step": rows, "mine": rows})


@cache
def spread():
    bands = {name: {s: np.stack([T + k for k in range(5)]) for s in ("y", "u")} for name in compared().plans}
    return Ensemble(compared(), {"k": np.array([1.0])}, {}, T, bands)


@cache
def chosen():
    alphas = np.linspace(0.0, 6.0, 61)
    return AlphaChoice(2.0, 1.0, SMOOTH, alphas, 1.0 + (alphas - 2.0) ** 2, 5.0, False, "peak_jerk")


@cache
def fastest():
    return cp.fastest(PLAN, LIMITS)


@cache
def curved():
    rows = {name: T + k for k, name in enumerate("ab")}
    return Curves("alpha [rad]", "length [m]", T, rows)


@cache
def looped():
    return cp.plants.crane_loop(cp.plants.Crane(), cp.PolySpline(ACROSS))


PLOTS = {
    "plan.plot": (lambda **k: PLAN.plot(**k), (3, 1)),
    "choice.plot": (lambda **k: chosen().plot(**k), (1, 1)),
    "fastest.plot": (lambda **k: fastest().plot(**k), (2, 1)),
    "comparison.plot": (lambda **k: compared().plot(**k), (3, 1)),
    "sweep.plot": (lambda **k: swept().plot(**k), (2, 1)),
    "ensemble.plot": (lambda **k: spread().plot(**k), (3, 3)),
    "shaper.plot": (lambda **k: cp.Shaper.ei(9.0, 0.1).plot(OMEGA, response=OMEGA, **k), (2, 1)),
    "residual_plot": (lambda **k: cp.residual_plot(PLAN, OMEGA, loop=ct.tf([1.0], [1.0, 1.0]), **k), (2, 1)),
    "plot_shaper": (lambda **k: vibration_figures.plot_shaper(cp.Shaper.zv(9.0), OMEGA, **k), (1, 1)),
    "plot_trajectory": (lambda **k: figures.plot_trajectory(PLAN, **k), (3, 1)),
    "plot_plans": (lambda **k: figures.plot_plans(craned(), 1, **k), (2, 2)),
    "plot_responses": (lambda **k: figures.plot_responses(compared(), **k), (3, 1)),
    "plot_sweep": (lambda **k: figures.plot_sweep(swept(), ("settling_time",), **k), (1, 1)),
    "plot_bands": (lambda **k: figures.plot_bands(spread(), **k), (3, 3)),
    "plot_plane": (lambda **k: figures.plot_plane(swept(), **k), (1, 1)),
    "plot_curves": (lambda **k: figures.plot_curves(curved(), **k), (1, 1)),
    "plot_blocks": (lambda **k: figures.plot_blocks(looped(), **k), (1, 1)),
    "plot_alpha_choice": (lambda **k: planning_figures.plot_alpha_choice(chosen(), **k), (1, 1)),
    "plot_limits": (lambda **k: planning_figures.plot_limits(PLAN, Limited(PLAN, LIMITS), **k), (2, 1)),
    "plot_baselines": (lambda **k: planning_figures.plot_baselines(compared(), **k), (3, 1)),
    "plot_sketch": (lambda **k: crane_figures.plot_sketch(**k), (1, 1)),
    "plot_time": (lambda **k: crane_figures.plot_time(craned(), **k), (6, 1)),
    "plot_step": (lambda **k: crane_figures.plot_step(craned(), **k), (4, 1)),
    "plot_paths": (lambda **k: crane_figures.plot_paths(craned(), None, **k), (1, 1)),
    "plot_motion": (lambda **k: crane_figures.plot_motion(craned(), None, **k), (1, 1)),
    "plot_online": (lambda **k: crane_figures.plot_online(craned(), **k), (4, 1)),
}
DRAWINGS = {"plot_sketch", "plot_blocks", "plot_motion"}  # of things: not curves in the user's colours
SAME = {
    "plot_trajectory",
    "plot_responses",
    "plot_bands",
    "plot_alpha_choice",
    "plot_limits",
    "plot_shaper",
}  # as a method's


def every(first):
    """Parametrise a test by all plots, of which a third is everyday: each plot in a third of the tests."""
    return pytest.mark.parametrize("name", one_in(3, PLOTS, first))


def test_every_plot_is_tested_here():
    """A new plot function, and a new class that plots, is found by its name."""
    twice = {name for name in vars(figures) if name.startswith("plot_") and hasattr(crane_figures, name)}
    functions = {
        f"{module.__name__.split('.')[-1]}.{name}" if name in twice else name
        for module in (figures, crane_figures, planning_figures, vibration_figures)
        for name, value in vars(module).items()
        if name.startswith(("plot_", "residual_plot")) and value.__module__ == module.__name__
    }
    assert not twice
    assert functions == {name for name in PLOTS if "." not in name}
    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] == "ctrlplan"]
    classes = {one for module in modules for one in vars(module).values() if inspect.isclass(one)}
    own = {one.plot.__qualname__ for one in classes if one.__module__.startswith("ctrlplan") and "plot" in vars(one)}
    assert own == {
        "Trajectory.plot",
        "AlphaChoice.plot",
        "Fastest.plot",
        "Comparison.plot",
        "Sweep.plot",
        "Ensemble.plot",
        "Shaper.plot",
    }


# Shown


@every(0)
def test_a_plot_is_known_to_pyplot_and_current(name):
    draw, shape = PLOTS[name]
    drawn = draw()
    assert plt.get_fignums() == [1]
    assert plt.gcf() is drawn.figure
    assert isinstance(drawn, ct.ControlPlot)
    assert drawn.axes.shape == drawn.lines.shape == shape
    for axes, lines in zip(drawn.axes.flat, drawn.lines.flat, strict=True):
        assert axes.figure is drawn.figure
        assert lines == list(axes.lines)
    again = draw()
    assert plt.get_fignums() == [1, 2]
    assert again.figure is not drawn.figure


@pytest.mark.slow
@pytest.mark.parametrize("name", one_in(3, [name for name in PLOTS if name.endswith(".plot")]))
def test_a_plot_is_what_savefig_writes(name, tmp_path):
    drawn = PLOTS[name][0]()
    plt.savefig(tmp_path / "it.png", dpi=50)
    written = mpimg.imread(tmp_path / "it.png")
    width, height = drawn.figure.get_size_inches()
    np.testing.assert_allclose(written.shape[:2], (50 * height, 50 * width), rtol=0, atol=1)
    colour = np.array(to_rgb(drawn.lines[0, 0][0].get_color()))
    apart = np.abs(written.reshape(-1, written.shape[-1])[:, :3] - colour).max(axis=1)
    assert apart.min() <= 2.5 / 255.0  # a thin line's colour is mixed with the paper's, by versions in different shares


@pytest.fixture
def windows(monkeypatch):
    """Figures that a backend with windows has shown."""
    shown = []
    module = types.ModuleType("recording_backend")
    module.FigureCanvas = FigureCanvasAgg
    module.show = lambda *args, **kwargs: shown.append(plt.get_fignums())
    monkeypatch.setitem(sys.modules, "recording_backend", module)
    before = mpl.get_backend()
    plt.switch_backend("module://recording_backend")
    yield shown
    plt.close("all")
    plt.switch_backend(before)


def test_a_script_shows_what_it_has_plotted(windows):
    PLAN.plot()
    plt.show()
    assert windows == [[1]]
    plt.close("all")
    for alpha in (0.5, 1.0, 1.5):
        cp.TrigSpline(MOVE, alpha=alpha).plot()
    chosen().plot()
    plt.show()
    assert windows[1:] == [[1, 2, 3, 4]]


def test_a_figure_that_was_made_and_is_empty_is_drawn_in():
    figure = plt.figure(figsize=(3.0, 5.0))
    assert PLAN.plot().figure is figure
    assert tuple(figure.get_size_inches()) == (3.0, 5.0)
    assert PLAN.plot().figure is not figure
    with_title = plt.figure()
    with_title.suptitle("not empty")
    assert PLAN.plot().figure is not with_title


@pytest.mark.slow
def test_a_title_leaves_the_layout_and_other_figures_alone():
    drawn = cp.TrigSpline(ACROSS, alpha=1.0).plot()
    other, axes = plt.subplots()
    before = axes.get_position().bounds
    drawn.set_plot_title("Two axes")
    assert drawn.figure.get_suptitle() == "Two axes"
    assert axes.get_position().bounds == before
    drawn.figure.canvas.draw()
    title = drawn.figure._suptitle.get_window_extent()
    assert not title.overlaps(drawn.legend.get_window_extent())
    assert not any(title.overlaps(a.get_tightbbox()) for a in drawn.axes.flat)
    assert other.get_suptitle() == ""
    again = cp.PolySpline(ACROSS).plot(ax=drawn.axes)
    drawn.figure.canvas.draw()
    boxes = [again.legend.get_window_extent(), *(a.get_tightbbox() for a in again.axes.flat)]
    for box, other_boxes in ((title, boxes), (boxes[0], boxes[1:])):
        assert not any(box.overlaps(one) for one in other_boxes)


# Given axes


def grid(shape):
    return plt.subplots(*shape, squeeze=False)


@every(1)
def test_a_plot_is_drawn_in_the_axes_given(name):
    draw, shape = PLOTS[name]
    figure, axes = grid(shape)
    drawn = draw(ax=axes)
    assert plt.get_fignums() == [1]
    assert drawn.figure is figure
    np.testing.assert_array_equal(drawn.axes, axes)
    assert list(figure.axes) == list(axes.flat)
    assert not figure.legends
    assert all(a.get_visible() for a in axes.flat)


@every(2)
def test_rows_and_columns_of_axes_are_as_good_as_a_column(name):
    draw, shape = PLOTS[name]
    if min(shape) > 1:
        with pytest.raises(ValueError, match=rf"ax must be axes of shape \({shape[0]}, {shape[1]}\), got shape"):
            draw(ax=grid(shape)[1].ravel())
        return
    figure, axes = plt.subplots(1, max(shape))
    drawn = draw(ax=axes)
    assert drawn.axes.shape == shape
    assert list(drawn.axes.flat) == list(figure.axes)
    assert draw(ax=list(figure.axes)).figure is figure


@pytest.mark.parametrize(
    "name", [name for name, (_, shape) in PLOTS.items() if name not in ("plan.plot", "plot_trajectory")]
)
def test_another_number_of_axes_is_an_error_that_states_the_shape(name):
    draw, shape = PLOTS[name]
    _, axes = plt.subplots(1, 5)
    wanted = "one axes" if shape == (1, 1) else f"axes of shape {(max(shape),) if 1 in shape else shape}"
    with pytest.raises(ValueError, match=re.escape(f"ax must be {wanted}, got shape (5,)")):
        draw(ax=axes)
    assert not any(a.lines or a.get_ylabel() for a in axes)


def test_the_error_names_what_each_axes_shows():
    _, axes = plt.subplots(2)
    with pytest.raises(ValueError, match=r"from the top they show y, error of y, u$"):
        compared().plot(axes)


@pytest.mark.every_combination
@pytest.mark.parametrize(
    ("given", "got"),
    [
        ("axes", "str"),
        (3, "int"),
        ({"a": 1}, "dict"),
        ([None, None], "NoneType"),
        (True, "bool"),
    ],
)
@every(0)
def test_what_is_no_axes_is_an_error(name, given, got):
    with pytest.raises(TypeError, match=f"ax must be matplotlib axes or an array of them, got {got}"):
        PLOTS[name][0](ax=given)


def test_a_plot_given_for_its_axes_is_an_error_that_says_so():
    drawn = PLAN.plot()
    for given in (drawn, drawn.figure):
        with pytest.raises(TypeError, match=r"give its \.axes"):
            SMOOTH.plot(ax=given)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_n_axes_get_the_derivatives_up_to_n_minus_1(count):
    drawn = PLAN.plot(ax=plt.subplots(count)[1])
    assert drawn.axes.shape == (count, 1)
    for nu, (line,) in enumerate(drawn.lines.flat):
        t, y = line.get_data()
        known = ~np.isnan(y)
        np.testing.assert_allclose(y[known], PLAN(t[known], nu), rtol=0, atol=1e-9)


def test_axes_against_the_derivatives_stated_are_an_error():
    _, axes = plt.subplots(3)
    with pytest.raises(ValueError, match=r"ax must be axes of shape \(5,\), got shape \(3,\); .* velocity, .* snap"):
        PLAN.plot(4, ax=axes)
    with pytest.raises(ValueError, match=r"ax must be axes of shape \(2,\), got shape \(1,\)"):
        PLAN.plot(1, ax=axes[0])
    with pytest.raises(ValueError, match=r"got shape \(0,\)"):
        PLAN.plot(ax=[])


def test_labels_and_titles_of_the_user_stay():
    _, axes = plt.subplots(3)
    for a in axes:
        a.set(ylabel="mine", xlabel="mine as well")
        a.set_title("my title", loc="left")
    compared().plot(axes)
    assert {a.get_ylabel() for a in axes} == {"mine"}
    assert {a.get_xlabel() for a in axes} == {"mine as well"}
    assert all(a.get_title(loc="left").startswith("my title") for a in axes)


@pytest.mark.slow
def test_a_part_of_a_figure_can_be_drawn_in():
    figure = plt.figure(layout="constrained")
    left, right = figure.subfigures(1, 2)
    drawn = cp.TrigSpline(ACROSS, alpha=1.0).plot(ax=left.subplots(3))
    drawn.set_plot_title("left")
    again = compared().plot(right.subplots(3))
    assert (drawn.figure, again.figure) == (left, right)
    figure.canvas.draw()
    assert left.legends == [drawn.legend]
    assert right.legends == [again.legend]


# Overlaid


@every(1)
def test_a_plot_can_be_drawn_over_itself(name):
    draw, shape = PLOTS[name]
    first = draw()
    limits = [(a.yaxis_inverted(), a.get_ylabel()) for a in first.axes.flat]
    before = [len(lines) for lines in first.lines.flat]
    second = draw(ax=first.axes)
    assert plt.get_fignums() == [1]
    assert second.axes.shape == shape
    assert [(a.yaxis_inverted(), a.get_ylabel()) for a in first.axes.flat] == limits
    assert [len(lines) for lines in second.lines.flat] == before
    for axes, old, new in zip(first.axes.flat, first.lines.flat, second.lines.flat, strict=True):
        assert list(axes.lines) == old + new
    assert len(first.figure.legends) <= 1


def looks(line):
    return to_hex(line.get_color()), line._unscaled_dash_pattern, line.get_label()


def test_two_plans_in_one_axes_are_told_apart():
    first = PLAN.plot()
    second = SMOOTH.plot(ax=first.axes)
    third = cp.Step(1.0).plot(ax=first.axes)
    lines = [drawn.lines[0, 0][0] for drawn in (first, second, third)]
    for what in zip(*map(looks, lines), strict=True):
        assert len(set(what)) == 3
    assert [text.get_text() for text in third.legend.get_texts()] == ["y", "y (2)", "y (3)"]
    first.axes[0, 0].legend(["polynomial", "trigonometric", "step"])
    shown = first.axes[0, 0].get_legend().legend_handles
    assert [h.get_color() for h in shown] == [line.get_color() for line in lines]


def test_a_plan_is_drawn_on_the_axes_of_a_response():
    run = cp.simulate(cp.plants.integrator_lag_loop(5.0, outputs=("y", "u")), T, PLAN).plot()
    numbers = plt.get_fignums()
    drawn = PLAN.plot(ax=run.axes[0, 0])
    assert plt.get_fignums() == numbers
    assert drawn.figure is run.figure
    (line,), (old,) = drawn.lines[0, 0], run.lines[0, 0]
    t, y = line.get_data()
    np.testing.assert_allclose(y, PLAN(t), rtol=0, atol=1e-12)
    assert line.axes is old.axes
    # python-control's own blue is a shade of our first colour: the next one is taken.
    assert to_hex(line.get_color()) == "#d55e00"
    assert len(drawn.legend.get_texts()) == 2
    assert run.axes[0, 0].get_ylabel() == "y"
    assert not run.axes[1, 0].collections


def test_a_response_is_drawn_on_the_axes_of_a_plan():
    drawn = PLAN.plot(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = response(["y"]).plot(ax=drawn.axes)
    assert run.figure is drawn.figure
    legend = drawn.axes[0, 0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["y", "loop"]
    (plan,), (output,) = drawn.lines[0, 0], run.lines[0, 0]
    assert [handle.get_color() for handle in legend.legend_handles] == [plan.get_color(), output.get_color()]


def test_a_plan_beside_a_response_has_a_figure_of_its_own():
    run = response(["y"]).plot()
    assert PLAN.plot(0).figure is not run.figure


# As the user has set it


@pytest.mark.parametrize("name", one_in(3, [name for name in PLOTS if name not in DRAWINGS]))
def test_the_users_settings_are_obeyed(name):
    mine = {
        "lines.linewidth": 4.0,
        "font.size": 13.0,
        "figure.figsize": [5.0, 4.0],
        "axes.grid": True,
        "axes.facecolor": "#ffffee",
        "axes.prop_cycle": mpl.cycler(color=["#111199", "#991111", "#119911", "#777711", "#117777"]),
        "legend.frameon": False,
    }
    with mpl.rc_context(mine):
        drawn = PLOTS[name][0]()
        assert {key: mpl.rcParams[key] for key in mine} == mine
    axes = drawn.axes[0, 0]
    assert tuple(drawn.figure.get_size_inches()) == (5.0, 4.0)
    assert to_hex(axes.get_facecolor()) == "#ffffee"
    assert axes.xaxis.get_gridlines()[0].get_visible()
    assert axes.xaxis.label.get_fontsize() == pytest.approx(13.0)
    colours = {to_hex(line.get_color()) for line in axes.lines if line.get_label()[0] not in "_r"}
    fixed = {"#e69f00", "#8a3c00", "#d55e00"}  # marks and limits
    assert colours - fixed <= {"#111199", "#991111", "#119911", "#777711", "#117777"}
    solid = [line.get_linewidth() for line in axes.lines if line.get_linestyle() != "None"]
    assert max(solid) in (pytest.approx(4.0), pytest.approx(2.6), pytest.approx(2.8))
    if drawn.legend is not None:
        assert not drawn.legend.get_frame_on()


def test_dashes_of_the_users_cycle_are_taken():
    dashes = ["--", ":", "-."]
    with mpl.rc_context({"axes.prop_cycle": mpl.cycler(linestyle=dashes)}):
        lines = [cp.TrigSpline(ACROSS, alpha=1.0).plot().lines[0, 0][k] for k in (0, 1)]
        assert [line.get_linestyle() for line in lines] == dashes[:2]
        first = PLAN.plot()
        assert SMOOTH.plot(ax=first.axes).lines[0, 0][0].get_linestyle() == ":"


def test_nothing_is_invisible_on_a_dark_background():
    with plt.style.context("dark_background"):
        drawn = compared().plot()
        plan = PLAN.plot()
        drawings = [draw() for draw, _ in (PLOTS[name] for name in sorted(DRAWINGS))]
    for one in (drawn, plan, *drawings):
        for axes in one.axes.flat:
            ground = to_hex(axes.get_facecolor())
            assert ground == "#000000"
            assert not any(to_hex(line.get_color()) == ground for line in axes.lines)
            for patch in axes.patches:
                assert to_hex(patch.get_edgecolor()) != ground
    with mpl.rc_context({"axes.facecolor": "black", "text.color": "white"}):  # and no cycle
        step = compared().plot().lines[0, 0][1]
    assert to_hex(step.get_color()) == "#ffffff"


@every(2)
def test_settings_are_the_same_after_a_plot(name):
    before = dict(mpl.rcParams)
    PLOTS[name][0]()
    assert dict(mpl.rcParams) == before


def test_colours_without_a_setting_are_okabe_and_itos():
    both = cp.TrigSpline(ACROSS, alpha=1.0).plot()
    over = cp.PolySpline(ACROSS).plot(ax=both.axes)
    colours = [to_hex(line.get_color()) for drawn in (both, over) for line in drawn.lines[0, 0]]
    assert len(set(colours)) == 4
    assert set(colours) <= {"#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7"}


def test_texts_for_tex_hold_no_commands_of_a_user():
    with mpl.rc_context({"text.usetex": True}):
        assert as_text("y_d1 50% #2 {a} ~^\\") == r"y\_d1 50\% \#2 \{a\} \~{}\^{}\textbackslash{}"
    assert as_text("y_d1 $x$") == r"y_d1 \$x\$"


@pytest.mark.parametrize("name", one_in(3, [name for name in PLOTS if name not in SAME], 1))
def test_legend_and_axes_do_not_run_into_each_other(name):
    drawn = PLOTS[name][0]()
    drawn.figure.canvas.draw()
    boxes = [axes.get_tightbbox() for axes in drawn.figure.axes]
    for legend in drawn.figure.legends:
        assert not any(legend.get_window_extent().overlaps(box) for box in boxes)
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            overlap = min(one.x1, other.x1) - max(one.x0, other.x0), min(one.y1, other.y1) - max(one.y0, other.y0)
            assert min(overlap) <= 2.0


# Pages


@every(0)
def test_a_figure_of_a_page_is_unknown_to_pyplot_and_in_its_own_style(name):
    with mpl.rc_context({"lines.linewidth": 9.0, "figure.figsize": (2.0, 2.0)}), page_style():
        drawn = PLOTS[name][0]()
        assert mpl.rcParams["lines.linewidth"] == 1.6
    assert plt.get_fignums() == []
    assert tuple(drawn.figure.get_size_inches()) != (2.0, 2.0)
    PLAN.plot()
    assert plt.get_fignums() == [1]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["agg", "module://recording_backend"])
def test_a_page_of_many_figures_warns_of_none(backend, windows):
    plt.switch_backend(backend)
    with mpl.rc_context({"figure.max_open_warning": 1}):
        page = render_page([Study("it", "It", compared(), sections=(PlanCurves(), Responses()))], "It")
    assert page.count('class="drawing"') == 5  # of these two sections, and three of the main figure
    assert plt.get_fignums() == []


@pytest.mark.slow
def test_a_page_does_not_draw_in_an_empty_figure_of_the_user():
    figure = plt.figure()
    render_page([Study("it", "It", compared(), sections=(PlanCurves(),))], "It")
    assert figure.axes == []


# Old names


def test_order_is_an_old_name():
    with pytest.warns(FutureWarning, match="order= is deprecated .* use derivatives=") as seen:
        drawn = PLAN.plot(order=1)
    assert drawn.axes.shape == (2, 1)
    assert seen[0].filename == __file__


# Notebooks


CELLS = (
    ("import ctrlplan as cp\nmove = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]\nplan = cp.PolySpline(move)", 0),
    ("plan.plot()", 1),
    ("plan.plot()\nplan.plot(1)\ncp.Step(1.0).plot();", 3),
    ("for alpha in (0.5, 1.0):\n    cp.TrigSpline(move, alpha=alpha).plot()", 2),
    ("drawn = plan.plot()\ncp.TrigSpline(move, alpha=2.0).plot(ax=drawn.axes)", 1),
    ("import matplotlib.pyplot as plt\nplan.plot()\nplt.show()\nplan.plot()\nplt.show()", 2),
    # What ipywidgets' interact does for each value: the output is cleared, the function called, the figures shown.
    (
        "from IPython.display import clear_output\n"
        "from matplotlib_inline.backend_inline import flush_figures\n"
        "for alpha in (0.5, 1.0, 1.5):\n"
        "    flush_figures()\n"
        "    clear_output(wait=True)\n"
        "    cp.TrigSpline(move, alpha=alpha).plot()\n"
        "    flush_figures()",
        1,
    ),
    ("print(plt.get_fignums())", 0),
)


@pytest.mark.slow
def test_a_cell_of_a_notebook_shows_each_figure_once():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source, _ in CELLS])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    for cell, (source, count) in zip(notebook.cells, CELLS, strict=True):
        images = [out for out in cell.outputs if "image/png" in out.get("data", {})]
        assert len(images) == count, source
        assert not [out.text for out in cell.outputs if out.output_type == "stream" and out.name == "stderr"]
    assert notebook.cells[-1].outputs[0].text == "[]\n"
