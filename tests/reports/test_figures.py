"""Figures: what they draw is what was given, labelled with units, every plan told from every other, nothing hidden."""

import ast
from itertools import combinations, pairwise
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.reports import (
    Picture,
    draw,
    plot_plane,
    plot_plans,
    plot_responses,
    plot_sweep,
    plot_trajectory,
    render_page,
)
from ctrlplan.reports.style import line_styles, page_style, roles_of, to_svg
from ctrlplan.studies import MEASURES, Role, Study, sections
from ctrlplan.studies.crane import obstacle_waypoints
from ctrlplan.studies.linear import NUMBERED, STEP_LIMIT

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(6, 5), cp.Waypoint(10, 1, 0, 0)]
TIMES = np.linspace(0, 20, 801)
STANDARD = ("step", "polynomial", "trigonometric", "piecewise")
# The palette as printed: Okabe and Ito, Color Universal Design, 2008.
OKABE_ITO = {"#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7"}


@pytest.fixture(scope="module")
def compared():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    points = [cp.Waypoint.from_jets(w.time, x=w.jet[:, 0]) for w in MOVE]
    return cp.compare(loop, points, TIMES, alpha=4.0, units={"x": "m", "u": "N"})


@pytest.fixture(scope="module")
def two_axes():
    import control as ct

    loops = [ct.ss(cp.plants.integrator_lag_loop(k)) for k in (5.0, 20.0)]
    side = ct.append(*loops)
    both = ct.ss(side.A, side.B, side.C, side.D, inputs=["rx", "rth"], outputs=["x", "theta"])
    points = [
        cp.Waypoint.from_jets(0, x=[0, 0, 0], theta=[1, 0, 0]),
        cp.Waypoint.from_jets(1, x=[2, 0, 0], theta=[0, 0, 0]),
    ]
    return cp.compare(both, points, np.linspace(0, 10, 201), units={"x": "m", "theta": "rad"})


@pytest.fixture(scope="module")
def craned():
    """Over the wall, with the curves that the studies bring along."""
    points = obstacle_waypoints()
    plans = {"polynomial": cp.PolySpline(points), "trigonometric": cp.TrigSpline(points, alpha=4.0)}
    plans["step"] = cp.Step([20, 11], [0, 10], labels=["x", "z"])
    crane = cp.plants.Crane()

    def loop(name, plan):
        return cp.plants.crane_loop(crane, plan, "setpoint" if name == "step" else "generator")

    found = cp.compare(loop, plans, np.linspace(0, 20, 401), waypoints=points)
    return Study("crane", "Crane", found)


@pytest.fixture(scope="module")
def spread(compared):
    """A lag that is not known well, behind two plans."""
    import control as ct

    loop = ct.nlsys(
        lambda t, x, u, params: (u - x) / params["tau"],
        lambda t, x, u, params: np.array([x[0], u[0] - x[0]]),
        states=1,
        inputs="r",
        outputs=["y", "u"],
        params={"tau": 1.0},
        name="lag",
    )
    plans = {name: compared.plans[name] for name in ("step", "trigonometric")}
    drawn = cp.draws(20, tau=(0.5, 2.0))
    return cp.monte_carlo(loop, drawn, plans, TIMES, progress=False, units={"y": "m", "u": "N"})


CURVES = {"one": TIMES[1:], "two": TIMES[1:] ** 2}
# Every type of section with a figure: of a sweep, of draws, of a loop, or of a comparison alone.
SECTIONS = {
    "Plane": lambda swept, spread, crane: sections.Plane(swept, NUMBERED, STEP_LIMIT, "limit of the step"),
    "SweepCurves": lambda swept, spread, crane: sections.SweepCurves(
        swept, ("settling_time", "overshoot_error", "control_peak", "control_effort")
    ),
    "Bands": lambda swept, spread, crane: sections.Bands(spread),
    "PlanCurves": lambda swept, spread, crane: sections.PlanCurves(),
    "Responses": lambda swept, spread, crane: sections.Responses(),
    "Paths": lambda swept, spread, crane: sections.Paths((cp.Disc((8.0, 8.0), 1.5),)),
    "Curves": lambda swept, spread, crane: sections.Curves("alpha [rad]", "length [m]", TIMES[1:], CURVES),
    "FastestMove": lambda swept, spread, crane: sections.FastestMove(
        cp.fastest(cp.PolySpline(MOVE), {"y_d1": 2.0, "y_d2": 9.0})
    ),
    "CraneSketch": lambda swept, spread, crane: sections.CraneSketch(),
    "LoopBlocks": lambda swept, spread, crane: sections.LoopBlocks(crane, {"plan": "path generator"}),
    "CraneTime": lambda swept, spread, crane: sections.CraneTime(),
    "CraneStep": lambda swept, spread, crane: sections.CraneStep(),
    "CranePaths": lambda swept, spread, crane: sections.CranePaths(((7.0, 13.0), (6.5, 12.0))),
    "CraneMotion": lambda swept, spread, crane: sections.CraneMotion(((7.0, 13.0), (6.5, 12.0))),
    "CraneOnline": lambda swept, spread, crane: sections.CraneOnline(),
}
BASES = (sections.Section, sections.CraneScene)
WITHOUT_FIGURE = {"AnimatedCrane", "ClaimTable", "DrawTable", "FittedGains", "PlanMargins"}


def test_every_type_of_section_is_drawn_here():
    every = {
        name
        for name, value in vars(sections).items()
        if isinstance(value, type) and issubclass(value, sections.Section) and value not in BASES
    }
    assert every == {*SECTIONS, *WITHOUT_FIGURE}


@pytest.fixture(scope="module")
def picture(compared, swept, craned, spread):
    """Figure and caption of a type of section, on real data."""

    def of(name):
        crane = cp.plants.crane_loop(cp.plants.Crane(), craned.comparison.plans["polynomial"])
        section = SECTIONS[name](swept, spread, crane)
        study = craned if name.startswith(("Crane", "Paths")) else Study("it", "It", compared)
        (found,) = (block for block in draw(section, study).blocks if isinstance(block, Picture))
        return found

    return of


KINDS = sorted([*SECTIONS, "two axes: plans", "two axes: responses", "trajectory", "one metric"])


@pytest.fixture(scope="module", params=one_in(2, KINDS))
def figure(request, two_axes, swept, picture):
    """Every kind of figure, on real data."""
    others = {
        "two axes: plans": lambda: plot_plans(two_axes),
        "two axes: responses": lambda: plot_responses(two_axes),
        "trajectory": lambda: two_axes.plans["polynomial"].plot(),
        "one metric": lambda: plot_sweep(swept, ["iae"]),
    }
    if request.param in others:
        return others[request.param]().figure
    with page_style():
        return picture(request.param).plot.figure


def drawing(figure):
    """Whether a figure shows a thing, or one signal in each axes: no curves that a legend would tell apart."""
    single = all(list(by_label(axes)) == [axes.get_ylabel()] for axes in figure.axes)
    return single or all(not axes.axison or axes.get_title(loc="left").find("every") > 0 for axes in figure.axes)


def visible(figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def boxes(figure):
    """Boxes of the legends and of everything that the axes cover, ticks and labels included."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    return (
        [legend.get_window_extent(renderer) for legend in figure.legends],
        [axes.get_tightbbox(renderer) for axes in visible(figure)],
        renderer,
    )


@pytest.fixture(scope="module")
def drawn(figure):
    """The boxes of a figure, drawn once."""
    return boxes(figure)


def curves(axes):
    """Lines that are drawn, without the markers and the thin references."""
    return [line for line in axes.lines if line.get_linestyle() != "None" and line.get_linewidth() >= 1.0]


def circles(axes):
    """Points of the prescribed values."""
    return [tuple(point) for marks in axes.collections for point in marks.get_offsets().tolist()]


def axes_of(drawn):
    """All axes of a plot, row by row."""
    return list(drawn.axes.flat)


def by_label(axes):
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


# All figures


def test_the_legend_stands_outside_the_axes(figure, drawn):
    legends, covered, _ = drawn
    assert all(axes.get_legend() is None for axes in figure.axes)
    if drawing(figure):
        assert not legends
        return
    assert len(legends) == 1
    for box in covered:
        assert not legends[0].overlaps(box)
    width, height = figure.canvas.get_width_height()
    assert legends[0].x0 >= 0
    assert legends[0].x1 <= width
    assert legends[0].y1 <= height


def test_nothing_is_drawn_beyond_the_edge(figure, drawn):
    width, height = figure.canvas.get_width_height()
    for box in drawn[1]:
        assert -1 <= box.x0 < box.x1 <= width + 1
        assert -1 <= box.y0 < box.y1 <= height + 1


def test_axes_do_not_run_into_each_other(drawn):
    for one, other in combinations(drawn[1], 2):
        overlap = min(one.x1, other.x1) - max(one.x0, other.x0), min(one.y1, other.y1) - max(one.y0, other.y0)
        assert min(overlap) <= 2.0


def test_every_axis_is_labelled(figure):
    for axes in visible(figure):
        if not axes.axison:
            continue  # a drawing has no axes to label
        assert axes.get_ylabel()
    bottom = min(axes.get_position().y0 for axes in visible(figure))
    for axes in visible(figure):
        if axes.axison and axes.get_position().y0 == pytest.approx(bottom, abs=1e-6):
            assert axes.get_xlabel()


@pytest.mark.parametrize("name", SECTIONS)
def test_every_figure_has_a_caption(name, picture):
    with page_style():
        assert picture(name).caption.strip().endswith(".")


@pytest.mark.parametrize("kind", [sections.Plane, sections.SweepCurves])
def test_a_figure_of_a_sweep_needs_one(kind):
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'sweep'"):
        kind()


# Told apart


def lab(linear):
    """CIE L*, a*, b* of linear RGB (D65)."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    f = np.cbrt(np.maximum(xyz / [0.9505, 1.0, 1.089], 1e-9))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


# Linear RGB as it is seen without red or green cones (Machado, Oliveira and Fernandes 2009, severity 1).
BLIND = {
    "nobody": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
}


def planned(*names):
    """Roles of plans, of which those called step are steps."""
    return {name: Role.STEP if name == "step" else Role.PLANNED for name in names}


@pytest.mark.parametrize("names", [STANDARD, ("a", "b", "c", "d"), (*STANDARD, "mine", "yours")])
@pytest.mark.parametrize("eyes", BLIND)
def test_colours_are_told_apart_by_every_reader(names, eyes):
    colours = [to_hex(style["color"]) for style in line_styles(planned(*names)).values()]
    assert len(set(colours)) == len(names)
    seen = []
    for colour in colours:
        c = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
        linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        seen.append(lab(np.clip(np.asarray(BLIND[eyes]) @ linear, 0, 1)))
    for one, other in combinations(seen, 2):
        assert np.linalg.norm(one - other) > 15


def test_the_standard_plans_have_colours_of_okabe_and_ito():
    assert {to_hex(style["color"]) for style in line_styles(planned(*STANDARD)).values()} <= OKABE_ITO


@pytest.mark.parametrize("names", [STANDARD, ("a", "b", "c", "d"), (*STANDARD, "mine", "yours")])
def test_dashes_tell_them_apart_without_colours(names):
    dashes = [repr(style["linestyle"]) for style in line_styles(planned(*names)).values()]
    assert len(set(dashes)) == len(names)


def test_a_plan_looks_the_same_whoever_stands_beside_it():
    """On one page: a figure with other plans keeps the looks of those that are known from the first."""
    page = line_styles(planned(*STANDARD))
    others = line_styles(planned("x", "trigonometric", "y", "step"), page)
    assert {name: others[name] for name in ("trigonometric", "step")} == {
        name: page[name] for name in ("trigonometric", "step")
    }
    colours = [style["color"] for style in others.values()]
    assert len(set(colours)) == len(colours)


def test_colours_are_by_role_and_order_and_not_by_name():
    one = line_styles(planned(*STANDARD))
    other = line_styles({"trigonometric": Role.STEP, "a": Role.PLANNED, "step": Role.PLANNED, "b": Role.PLANNED})
    looks = [[(style["color"], style["linestyle"]) for style in styles.values()] for styles in (one, other)]
    assert looks[0] == looks[1]


def test_baselines_do_not_take_the_colours_of_planned_references():
    roles = {"a": Role.BASELINE, "step": Role.STEP, "b": Role.BASELINE, "mine": Role.PLANNED, "again": Role.STEP}
    styles = line_styles(roles)
    alone = line_styles(planned("step", "mine"))
    assert {name: styles[name] for name in alone} == alone
    assert len({style["color"] for style in styles.values()}) == len(roles)


def test_a_plan_keeps_its_colour_and_dashes_in_every_panel(compared):
    styles = line_styles(roles_of(compared))
    for drawn in (plot_plans(compared), plot_responses(compared)):
        for axes in axes_of(drawn):
            for line in curves(axes):
                style = styles[line.get_label()]
                assert to_hex(line.get_color()) == to_hex(style["color"])


def test_the_legend_names_every_plan_once(compared, swept):
    for drawn, names in (
        (plot_plans(compared), compared.plans),
        (plot_responses(compared), compared.plans),
        (plot_sweep(swept), swept.metrics),
    ):
        assert drawn.figure.legends == [drawn.legend]
        assert [text.get_text() for text in drawn.legend.get_texts()] == list(names)


# Plans


@pytest.mark.slow
def test_labels_of_plans_carry_units(compared, two_axes):
    labels = [axes.get_ylabel() for axes in axes_of(plot_plans(compared))]
    assert labels == ["x position [m]", "x velocity [m/s]", "x acceleration [m/s²]"]
    labels = [axes.get_ylabel() for axes in axes_of(plot_plans(two_axes, 1))]
    assert labels == ["x position [m]", "theta position [rad]", "x velocity [m/s]", "theta velocity [rad/s]"]
    assert plot_plans(compared).axes[-1, 0].get_xlabel() == "time [s]"
    labels = [axes.get_ylabel() for axes in axes_of(plot_plans(compared, 4))]
    assert labels[3:] == ["x jerk [m/s³]", "x snap [m/s⁴]"]


def test_without_units_none_is_made_up(compared):
    loop = cp.plants.integrator_lag_loop(5.0)
    drawn = plot_plans(cp.compare(loop, MOVE, TIMES))
    assert [axes.get_ylabel() for axes in axes_of(drawn)] == [
        "y position",
        "y velocity [1/s]",
        "y acceleration [1/s²]",
    ]


def test_plans_are_drawn_as_they_are(compared):
    for order, axes in enumerate(axes_of(plot_plans(compared))):
        lines = by_label(axes)
        assert set(lines) == {name for name in compared.plans if name != "step" or order == 0}
        for name, line in lines.items():
            t, y = line.get_data()
            known = ~np.isnan(y)
            assert known.mean() > 0.98
            np.testing.assert_allclose(y[known], compared.plans[name](t[known], order), rtol=0, atol=1e-9)
            assert t[0] < 0 < 10 < t[-1]


def test_prescribed_values_are_circles_and_free_ones_are_not(compared):
    marks = [[point for point in circles(axes) if not np.isnan(point).any()] for axes in axes_of(plot_plans(compared))]
    assert marks == [[(0, 0), (6, 5), (10, 1)], [(0, 0), (10, 0)], [(0, 0), (10, 0)]]


def test_no_line_is_drawn_through_a_jump():
    # Positions alone: the velocity jumps at both ends, and at the join.
    plan = cp.PiecewiseSpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1), cp.Waypoint(2, 0)])
    found = cp.Comparison({"legs": plan}, {}, {}, outputs=("y",))
    for axes in (plot_plans(found, 1).axes[1, 0], plot_trajectory(plan, 1).axes[1, 0]):
        (line,) = curves(axes)
        t, v = line.get_data()
        assert {1.0, -1.0, 0.0} == set(v[~np.isnan(v)].round(9))
        for (t0, t1), (v0, v1) in zip(pairwise(t), pairwise(v), strict=True):
            assert np.isnan(v0) or np.isnan(v1) or abs(v1 - v0) < 1e-9, f"a line from {t0} to {t1}"


# One trajectory


def test_a_trajectory_marks_its_waypoints():
    plan = cp.TrigSpline(MOVE, alpha=2.0)
    drawn = plan.plot(3)
    assert drawn.axes.shape == (4, 1)
    for order, axes in enumerate(axes_of(drawn)):
        (line,) = curves(axes)
        t, y = line.get_data()
        known = ~np.isnan(y)
        np.testing.assert_allclose(y[known], plan(t[known], order), rtol=0, atol=1e-9)
    assert [circles(axes) for axes in axes_of(drawn)] == [
        [(0, 0), (6, 5), (10, 1)],
        [(0, 0), (10, 0)],
        [(0, 0), (10, 0)],
        [],
    ]


def test_each_axis_of_a_trajectory_is_marked_and_named():
    points = [cp.Waypoint.from_jets(0, x=[0.0, 0.0], z=[3.0]), cp.Waypoint.from_jets(2, x=[1.0], z=[4.0, 0.5])]
    drawn = cp.PolySpline(points).plot(1, units=["m", "m"])
    assert [axes.get_ylabel() for axes in axes_of(drawn)] == ["position [m]", "velocity [m/s]"]
    assert [text.get_text() for text in drawn.legend.get_texts()] == ["x", "z"]
    marks = [set(circles(axes)) for axes in axes_of(drawn)]
    assert marks == [{(0, 0), (2, 1), (0, 3), (2, 4)}, {(0, 0), (2, 0.5)}]
    colours = {to_hex(line.get_color()) for line in curves(drawn.axes[0, 0])}
    assert len(colours) == 2


def test_a_trajectory_without_waypoints_or_duration_is_drawn_too():
    assert len(axes_of(cp.Step(1.0).plot())) == 3
    assert len(axes_of((2.0 * cp.PolySpline(MOVE) + cp.PolySpline(MOVE)).plot())) == 3


def test_different_units_have_none_in_common():
    points = [cp.Waypoint.from_jets(0, x=[0.0], th=[3.0]), cp.Waypoint.from_jets(2, x=[1.0], th=[4.0])]
    labels = [axes.get_ylabel() for axes in axes_of(cp.PolySpline(points).plot(0, units=["m", "rad"]))]
    assert not any("[m]" in label or "[rad]" in label for label in labels)


# Responses


def test_labels_of_responses_carry_units(compared, two_axes):
    assert [a.get_ylabel() for a in axes_of(plot_responses(compared))] == ["y [m]", "error of y [m]", "u [N]"]
    labels = [a.get_ylabel() for a in axes_of(plot_responses(two_axes))]
    assert labels == ["x [m]", "error of x [m]", "theta [rad]", "error of theta [rad]"]


def test_responses_are_drawn_as_they_are(compared):
    output, error, control = axes_of(plot_responses(compared))
    for name, response in compared.responses.items():
        y, u = response.outputs
        for axes, signal in ((output, y), (error, compared.plans[name](TIMES) - y), (control, u)):
            line = by_label(axes)[name]
            np.testing.assert_array_equal(line.get_xdata(), TIMES)
            np.testing.assert_allclose(line.get_ydata(), signal, rtol=0, atol=1e-12)
    thin = [line for line in output.lines if line.get_linewidth() < 1.0]
    assert len(thin) == len(compared.plans)
    for line, plan in zip(thin, compared.plans.values(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), plan(TIMES))


def test_a_comparison_draws_its_responses(compared):
    assert len(axes_of(compared.plot())) == len(axes_of(plot_responses(compared))) == 3


@pytest.mark.slow
def test_a_loop_without_controls_and_one_that_explodes_are_drawn_too(tmp_path):
    alone = cp.compare(cp.plants.integrator_lag_loop(5.0), MOVE, TIMES)
    assert len(axes_of(alone.plot())) == 2
    wild = cp.compare(cp.plants.integrator_lag_loop(-1e4), MOVE, np.linspace(0, 30, 301))
    to_svg(wild.plot().figure, "wild")


# Sweeps


def test_labels_of_a_sweep_carry_units(swept):
    axes = axes_of(plot_sweep(swept))
    assert [a.get_ylabel() for a in axes] == ["Settling time [s]", "Overshoot on the tracking error [%]"]
    assert {a.get_xlabel() for a in axes} == {"gain"}
    assert {a.get_xscale() for a in axes} == {"log"}


def test_a_sweep_is_drawn_as_it_is_and_broken_where_it_jumps(swept):
    settling, overshoot = axes_of(plot_sweep(swept))
    for plan, rows in swept.metrics.items():
        line = by_label(overshoot)[plan]
        np.testing.assert_array_equal(line.get_ydata(), rows["overshoot_error"])
        np.testing.assert_array_equal(line.get_xdata(), swept.values)
        k, ts = by_label(settling)[plan].get_data()
        known = ~np.isnan(ts)
        np.testing.assert_array_equal(k[known], swept.values)
        np.testing.assert_array_equal(ts[known], rows["settling_time"])
        assert np.all(np.diff(k) > 0)
    k, ts = by_label(settling)["step"].get_data()
    first = 0.25 + (np.pi / (2 * np.log(50.0))) ** 2
    gap = int(np.flatnonzero(np.isnan(ts))[0])
    assert k[gap - 1] < first < k[gap + 1] < 1.002 * first
    assert k[gap - 1] < k[gap] < k[gap + 1]
    assert ts[gap + 1] > ts[gap - 1] + 1.0


@pytest.mark.slow
def test_values_at_which_a_loop_never_settles_are_drawn_too():
    found = cp.sweep(cp.plants.integrator_lag_loop, [-2.0, -1.0, 1.0, 2.0], MOVE, TIMES, progress=False)
    settling, _ = axes_of(found.plot())
    for line in by_label(settling).values():
        k, ts = line.get_data()
        assert set(k[np.isfinite(ts)]) == {1.0, 2.0}


@pytest.mark.slow
def test_every_measure_can_be_swept_and_drawn(swept):
    names = [name for name in MEASURES if name in swept.metrics["step"]]
    figure = plot_sweep(swept, names).figure
    assert len(visible(figure)) == len(names)
    to_svg(figure, "all")


def test_figure_1_is_the_plane_of_settling_and_overshoot(swept):
    (axes,) = axes_of(plot_plane(swept, limit=STEP_LIMIT))
    assert axes.get_xlabel() == "settling time ±2 % [s]"
    assert axes.get_ylabel() == "overshoot on the tracking error [%]"
    (star,) = (line for line in axes.lines if line.get_marker() == "*")
    assert tuple(star.get_xydata()[0]) == STEP_LIMIT == pytest.approx((7.824, 100.0), rel=1e-5)
    dots = [line for line in axes.lines if line.get_marker() == "." and len(line.get_xdata()) == swept.values.size]
    assert len(dots) == len(swept.metrics)
    for line, rows in zip(dots, swept.metrics.values(), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), rows["settling_time"])
        np.testing.assert_array_equal(line.get_ydata(), rows["overshoot_error"])
    # Everything lies within the axes.
    points = np.concatenate([line.get_xydata() for line in dots])
    assert np.all(
        (points >= [axes.get_xlim()[0], axes.get_ylim()[0]]) & (points <= [axes.get_xlim()[1], axes.get_ylim()[1]])
    )


@pytest.mark.slow
def test_gains_beside_the_circles_can_be_read(swept):
    with page_style():
        figure = plot_plane(swept, numbered=NUMBERED).figure
    _, _, renderer = boxes(figure)
    (axes,) = figure.axes
    written = {text: text.get_window_extent(renderer) for text in axes.texts}
    assert {text.get_text() for text in written} == {"1", "5", "20", "100", "1000"}
    frame = axes.get_window_extent(renderer)
    for text, box in written.items():
        assert frame.x0 <= box.x0
        assert frame.y0 <= box.y0, f"{text.get_text()} runs into the axis"
    for (one, a), (other, b) in combinations(written.items(), 2):
        assert not a.overlaps(b), f"{one.get_text()} and {other.get_text()} hide each other"


def test_circles_stand_at_the_gains_written_beside_them(swept):
    (axes,) = axes_of(plot_plane(swept, numbered=NUMBERED))
    circles = {tuple(line.get_xydata()[0]) for line in axes.lines if line.get_marker() == "o"}
    for text in axes.texts:
        assert tuple(text.xy) in circles
        gain = int(np.flatnonzero(swept.values == float(text.get_text()))[0])
        rows = [(r["settling_time"][gain], r["overshoot_error"][gain]) for r in swept.metrics.values()]
        assert tuple(text.xy) in rows


@pytest.mark.parametrize(
    ("numbered", "message"),
    [
        ({"mine": {1.0: (0, 9)}}, r"numbered must be of plans of the sweep \(step, .*\), got 'mine'"),
        ({"step": {7.77: (0, 9)}}, "numbered must be of values of the sweep, got 7.77 for step; .* is the nearest"),
    ],
)
def test_only_points_of_the_sweep_are_numbered(swept, numbered, message):
    with pytest.raises(ValueError, match=message):
        plot_plane(swept, numbered=numbered)


def test_a_plane_of_any_loop_says_what_its_parameter_and_its_band_are():
    """No gain of the paper, no figure 1 and no band of 2 %."""
    found = cp.sweep(
        cp.plants.integrator_lag_loop, [2.0, 4.0], MOVE, TIMES, parameter="stiffness", band=0.05, progress=False
    )
    (block,) = draw(sections.Plane(found), Study("it", "It", None)).blocks
    assert block.caption.startswith("Settling time versus overshoot on the tracking error for stiffness from 2 to 4.")
    assert block.plot.axes[0, 0].get_xlabel() == "settling time ±5 % [s]"
    assert not [line for line in block.plot.lines[0, 0] if line.get_marker() in ("*", "o")]


# Manners


@pytest.mark.slow
def test_figures_of_a_page_do_not_pile_up_in_pyplot(compared, swept):
    before = plt.get_fignums()
    with page_style():
        for _ in range(3):
            compared.plot()
            compared.plans["polynomial"].plot()
            swept.plot()
            plot_plans(compared)
            plot_plane(swept)
    assert plt.get_fignums() == before


@pytest.mark.slow
def test_a_page_leaves_no_window_open(compared, swept, monkeypatch):
    monkeypatch.setattr(mpl, "get_backend", lambda: "QtAgg")  # where pyplot would manage them
    before = plt.get_fignums()
    render_page([Study("it", "It", compared, sections=(sections.Plane(swept), sections.PlanCurves()))], "It")
    assert plt.get_fignums() == before


def test_where_there_are_windows_a_figure_has_one(compared, monkeypatch):
    monkeypatch.setattr(mpl, "get_backend", lambda: "TkAgg")
    before = plt.get_fignums()
    drawn = compared.plot()
    assert len(plt.get_fignums()) == len(before) + 1
    plt.close(drawn.figure)
    assert plt.get_fignums() == before


def test_settings_of_the_user_are_left_alone(compared, swept):
    before = dict(mpl.rcParams)
    to_svg(plot_plane(swept).figure, "it")
    compared.plot()
    assert dict(mpl.rcParams) == before


@pytest.mark.slow
def test_settings_of_the_user_do_not_change_a_page(compared):
    study = Study("it", "It", compared, sections=(sections.Responses(),))
    with plt.style.context("dark_background"):
        dark = render_page([study], "It")
    assert dark == render_page([study], "It")


def imports(path):
    """Names of the modules that a file imports."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.slow
def test_only_reports_use_pyplot():
    root = Path(cp.__file__).parent
    users = {p.relative_to(root).parts[0] for p in root.rglob("*.py") if "matplotlib.pyplot" in set(imports(p))}
    assert users == {"reports"}


def test_derivatives_of_a_quotient_have_its_unit_in_brackets():
    """A plan in deg/s: its derivative is in (deg/s)/s, and not in deg/s/s."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)])
    labels = [axes.get_ylabel() for axes in axes_of(plot_trajectory(plan, 2, units=["deg/s"]))]
    assert labels == ["position [deg/s]", "velocity [(deg/s)/s]", "acceleration [(deg/s)/s²]"]
