"""Figures of what was chosen draw what was chosen, with units and limits where they are near enough to be seen."""

from dataclasses import replace

import control as ct
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_hex

import ctrlplan as cp
from ctrlplan.planning.limits import Limited
from ctrlplan.reports.planning_figures import plot_alpha_choice, plot_baselines, plot_limits
from ctrlplan.reports.style import page_style, to_svg
from ctrlplan.studies.baselines import baseline_plans

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)]
PATH = [
    cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[0, 0, 0]),
    cp.Waypoint.from_jets(1, x=[1], z=[2]),
    cp.Waypoint.from_jets(2, x=[3, 0, 0], z=[0, 0, 0]),
]


def labels(drawn):
    return [text.get_text() for legend in drawn.figure.legends for text in legend.get_texts()]


def level(axes):
    """Heights of the horizontal lines of an axes."""
    return sorted(
        float(y[0]) for y in (np.asarray(line.get_ydata()) for line in axes.lines) if y.size == 2 and y[0] == y[1]
    )


# Alpha


@pytest.fixture(scope="module")
def choice():
    return cp.choose_alpha(PATH)


def test_the_objective_is_drawn_where_it_is_below_its_blow_up(choice):
    (axes,) = plot_alpha_choice(choice).axes.flat
    curve, mark = axes.lines
    below = np.isfinite(choice.values) & (choice.alphas < choice.blow_up)
    np.testing.assert_array_equal(curve.get_xdata(), choice.alphas[below])
    np.testing.assert_array_equal(curve.get_ydata(), choice.values[below])
    assert 0 < np.sum(~below) < choice.alphas.size
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (choice.alpha, choice.value)
    assert np.all(curve.get_ydata() >= choice.value * (1 - 1e-9))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("alpha [rad] (0: polynomial)", "path")
    assert axes.get_xlim() == (0.0, 2 * np.pi)
    assert axes.get_yscale() == ("log" if np.ptp(np.log(curve.get_ydata())) > np.log(30) else "linear")


def test_the_legend_names_the_choice_and_where_plans_blow_up(choice):
    drawn = plot_alpha_choice(choice)
    assert labels(drawn) == [f"alpha = {choice.alpha:.4g} rad", "diverges"]
    (band,) = drawn.axes[0, 0].patches
    shown = drawn.axes[0, 0].transData.inverted().transform(band.get_window_extent().corners())[:, 0]
    assert shown.min() == pytest.approx(choice.blow_up, rel=1e-9)
    assert shown.max() == pytest.approx(2 * np.pi, rel=1e-9)


def test_without_a_blow_up_there_is_no_band():
    flat = cp.choose_alpha(MOVE, lambda plan: 5.0 + (plan.alpha - 1.0) ** 2)
    drawn = plot_alpha_choice(flat)
    assert flat.alpha == pytest.approx(1.0, abs=1e-6)
    assert not drawn.axes[0, 0].patches
    assert labels(drawn) == ["alpha = 1 rad"]
    assert drawn.axes[0, 0].get_yscale() == "linear"


def test_objectives_are_named_in_words():
    drawn = cp.choose_alpha(MOVE, "peak_jerk").plot()
    assert drawn.axes[0, 0].get_ylabel() == "peak jerk"


# Limits


@pytest.fixture(scope="module")
def quintic():
    return cp.PolySpline(MOVE)


def test_every_limited_signal_has_a_row_with_its_unit(quintic):
    limited = Limited(quintic, {"y_d1": 1.0, "y_d2": 2.0})
    drawn = plot_limits(quintic, limited, {"y_d1": "m/s"})
    t = np.linspace(0, 2, 2001)
    assert [axes.get_ylabel() for axes in drawn.axes.flat] == ["y_d1 [m/s]", "y_d2"]
    assert drawn.axes[-1, 0].get_xlabel() == "time [s]"
    for k, axes in enumerate(drawn.axes.flat, 1):
        np.testing.assert_allclose(axes.lines[0].get_xdata(), t, rtol=0, atol=1e-12)
        u = t / 2
        expected = (30 * u**2 * (1 - u) ** 2 / 2, 60 * u * (1 - 3 * u + 2 * u**2) / 4)[k - 1]
        np.testing.assert_allclose(axes.lines[0].get_ydata(), expected, rtol=0, atol=1e-12)


def test_the_mark_is_where_the_signal_comes_nearest(quintic):
    drawn = plot_limits(quintic, Limited(quintic, {"y_d1": 1.0, "y_d2": (-2.0, 5.0)}))
    speed, acceleration = (axes.lines[1] for axes in drawn.axes.flat)
    assert (speed.get_xdata()[0], speed.get_ydata()[0]) == pytest.approx((1.0, 15 / 16), rel=1e-9)
    peak = 10 / 3**0.5 / 4
    braking = 2 * (0.5 + 3**0.5 / 6)
    assert (acceleration.get_xdata()[0], acceleration.get_ydata()[0]) == pytest.approx((braking, -peak), rel=1e-9)


def test_limits_that_are_near_are_lines_and_all_are_words(quintic):
    drawn = plot_limits(quintic, Limited(quintic, {"y_d1": 1.0, "y_d2": (-2.0, 500.0)}))
    assert level(drawn.axes[0, 0]) == [-1.0, 1.0]
    assert level(drawn.axes[1, 0]) == [-2.0]
    titles = [axes.get_title(loc="left") for axes in drawn.axes.flat]
    assert titles[0] == "within ±1; 6.25 % left"
    assert titles[1].startswith("from -2 to 500; ")
    low, high = drawn.axes[1, 0].get_ylim()
    assert high - low < 10.0  # a limit of 500 would flatten the curve


def test_a_constant_signal_has_a_figure_too():
    still = cp.PolySpline([cp.Waypoint(0, 3), cp.Waypoint(1, 3)])
    drawn = plot_limits(still, Limited(still, {"y": (2.0, 4.0)}))
    assert level(drawn.axes[0, 0]) == pytest.approx([2.0, 4.0])
    assert drawn.axes[0, 0].get_title(loc="left") == "from 2 to 4; 100 % left"


def test_a_limit_that_is_broken_is_not_said_to_be_left(quintic):
    drawn = plot_limits(quintic, Limited(quintic, {"y_d1": 0.75}))
    assert drawn.axes[0, 0].get_title(loc="left") == "within ±0.75; 25 % beyond"


def test_the_fastest_plan_draws_its_limits():
    found = cp.fastest(cp.PolySpline(PATH), {"velocity": 2.0, "x_d2": (-8.0, 6.0)})
    drawn = found.plot({"x_d1": "m/s", "z_d1": "m/s", "x_d2": "m/s²"})
    assert [axes.get_ylabel() for axes in drawn.axes.flat] == ["x_d1 [m/s]", "z_d1 [m/s]", "x_d2 [m/s²]"]
    assert any("; 0 % left" in axes.get_title(loc="left") for axes in drawn.axes.flat)
    for axes, (low, high) in zip(drawn.axes.flat, [(-2, 2), (-2, 2), (-8, 6)], strict=True):
        row = axes.lines[0].get_ydata()
        assert low * (1 + 1e-9) <= row.min() < row.max() <= high * (1 + 1e-9)


# Rivals


@pytest.fixture(scope="module")
def compared():
    t = np.linspace(0, 8, 401)
    loop = cp.plants.integrator_lag_loop(100.0, outputs=("y", "u"))
    plans = {"trigonometric": cp.TrigSpline(MOVE, alpha=1.0)} | baseline_plans(MOVE)
    return cp.compare(loop, plans, t, waypoints=MOVE, units={"y": "m", "u": "N"})


@pytest.mark.slow
def test_baselines_are_drawn_with_what_the_loop_makes_of_them(compared):
    drawn = plot_baselines(compared)
    reference, output, control = (axes for axes in drawn.axes.flat if axes.get_visible())
    shown = (reference.get_ylabel(), output.get_ylabel(), control.get_ylabel())
    assert shown == ("reference of y [m]", "y [m]", "u [N]")
    assert control.get_xlabel() == "time [s]"
    for axes, row in ((output, 0), (control, 1)):
        lines = {line.get_label(): line for line in axes.lines}
        assert list(lines) == list(compared.plans)
        for name, response in compared.responses.items():
            np.testing.assert_array_equal(lines[name].get_ydata(), np.asarray(response.outputs)[row])
    for line in reference.lines:
        plan = compared.plans[line.get_label()]
        np.testing.assert_array_equal(line.get_ydata(), plan(compared.responses["step"].time))


def test_the_legend_names_all_and_no_two_look_alike(compared):
    drawn = plot_baselines(compared)
    assert labels(drawn) == list(compared.plans)
    looks = {(to_hex(line.get_color()), str(line._unscaled_dash_pattern)) for line in drawn.axes[0, 0].lines}
    assert len(looks) == len(compared.plans)


def test_a_step_does_not_flatten_what_the_others_ask_for(compared):
    control = [axes for axes in plot_baselines(compared).axes.flat if axes.get_visible()][-1]
    others = np.array([r.outputs[1] for name, r in compared.responses.items() if name != "step"])
    step = np.abs(compared.responses["step"].outputs[1]).max()
    assert step > 4 * np.abs(others).max()
    margin = 0.08 * np.ptp(others)
    assert control.get_ylim() == pytest.approx((others.min() - margin, others.max() + margin))
    assert control.get_title(loc="left") == "step: peak 100, clipped"


def test_a_step_is_found_by_its_role_and_not_by_its_name(compared):
    """Names exchanged: the same curves in the same colours, and the control of the jump left out again."""
    names = {name: f"plan {k}" for k, name in enumerate(compared.plans)} | {"step": "polynomial"}

    def renamed(found):
        return {names[name]: value for name, value in found.items()}

    other = replace(
        compared,
        plans=renamed(compared.plans),
        responses=renamed(compared.responses),
        metrics=renamed(compared.metrics),
        roles=renamed(compared.roles),
    )
    one, again = plot_baselines(compared), plot_baselines(other)
    assert [line.get_color() for line in one.lines[0, 0]] == [line.get_color() for line in again.lines[0, 0]]
    assert one.axes[2, 0].get_ylim() == again.axes[2, 0].get_ylim()
    assert again.axes[2, 0].get_title(loc="left") == "polynomial: peak 100, clipped"


def test_baselines_of_two_axes_stand_side_by_side():
    loops = [ct.ss(cp.plants.integrator_lag_loop(k)) for k in (50.0, 200.0)]
    side = ct.append(*loops)
    both = ct.ss(side.A, side.B, side.C, side.D, inputs=["rx", "rz"], outputs=["x", "z"])
    found = cp.compare(both, baseline_plans(PATH), np.linspace(0, 5, 201), waypoints=PATH, units={"x": "m", "z": "mm"})
    drawn = plot_baselines(found)
    assert [axes.get_ylabel() for axes in drawn.axes.flat] == [
        "reference of x [m]",
        "reference of z [mm]",
        "x [m]",
        "z [mm]",
    ]
    bottom = drawn.axes[-1]
    assert [axes.get_xlabel() for axes in bottom] == ["time [s]", "time [s]"]
    z = dict(zip(found.plans, drawn.axes[1, 1].lines, strict=True))
    np.testing.assert_array_equal(z["S-curve"].get_ydata(), found.responses["S-curve"].outputs[1])


@pytest.mark.slow
def test_drawings_of_a_page_do_not_depend_on_the_users_settings(quintic):
    limited = Limited(quintic, {"y_d1": 1.0})

    def drawing():
        with page_style():
            return to_svg(plot_limits(quintic, limited).figure, "it")

    first = drawing()
    with mpl.rc_context({"lines.linewidth": 9.0, "axes.grid": False, "font.size": 20}):
        assert drawing() == first
    assert first.startswith("<svg")
