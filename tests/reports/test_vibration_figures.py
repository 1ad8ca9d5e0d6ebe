"""Figures of shapers and of the vibration left by plans: what they show, and what they reject."""

import math

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

OMEGA = np.linspace(0.5, 30.0, 60)
PLAN = cp.PolySpline(
    [cp.Waypoint.from_jets(0, x=[0, 0, 0], z=[1, 0, 0]), cp.Waypoint.from_jets(1, x=[1, 0, 0], z=[3, 0, 0])]
)
LOOP = ct.tf([100.0], [1.0, 0.4, 100.0], inputs="r", outputs="y")


def values(axes, line=0):
    return axes.lines[line].get_ydata()


def test_a_shaper_is_drawn_at_the_lowest_damping_of_its_modes():
    shaper = cp.Shaper.ei(10.0, 0.1).then(cp.Shaper.zv(21.0, 0.02))
    drawn = shaper.plot(OMEGA)
    (axes,) = drawn.axes.flat
    np.testing.assert_array_equal(values(axes), shaper.residual(OMEGA, 0.02))
    assert [line.get_xdata()[0] for line in axes.lines[1:]] == [10.0, 21.0]
    assert axes.get_xlabel() == "frequency [rad/s]"
    assert axes.get_ylabel() == "residual vibration"
    given = cp.Shaper([0.0, 0.5], [0.5, 0.5])
    np.testing.assert_array_equal(values(given.plot(OMEGA).axes[0, 0]), given.residual(OMEGA))


def test_a_spectrum_is_drawn_with_and_without_the_shaper():
    shaper, spectrum = cp.Shaper.mzv(10.0, 0.1), 3.0 / (1.0 + (OMEGA - 10.0) ** 2)
    below = shaper.plot(OMEGA, response=spectrum).axes[1, 0]
    np.testing.assert_array_equal(values(below), spectrum)
    np.testing.assert_array_equal(values(below, 1), spectrum * shaper.residual(OMEGA, 0.1))
    assert [text.get_text() for text in below.get_legend().get_texts()] == ["without shaper", "with shaper"]


def test_what_a_plan_leaves_is_drawn_axis_by_axis():
    (axes,) = cp.residual_plot(PLAN, OMEGA, 0.03).axes.flat
    for line, wanted in zip(axes.lines, cp.residual_spectrum(PLAN, OMEGA, 0.03), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), wanted)
    assert [line.get_label() for line in axes.lines] == ["x", "z"]


def test_the_magnitude_of_the_loop_is_above():
    upper, lower = cp.residual_plot(PLAN, OMEGA, loop=LOOP).axes.flat
    wanted = 100.0 / np.abs(100.0 - OMEGA**2 + 0.4j * OMEGA)
    np.testing.assert_allclose(values(upper), wanted, rtol=1e-12)
    assert upper.get_yscale() == "log"
    assert lower.get_ylabel() == "residual vibration"
    # Several inputs and outputs: each pair, by name; a discrete loop on the unit circle.
    both = ct.ss(-np.eye(2), np.eye(2), np.eye(2), 0, inputs=["a", "b"], outputs=["p", "q"])
    upper = cp.residual_plot(PLAN, OMEGA, loop=both).axes[0, 0]
    assert [line.get_label() for line in upper.lines] == ["p from a", "p from b", "q from a", "q from b"]
    sampled = ct.ss([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.1)
    upper = cp.residual_plot(PLAN, OMEGA, loop=sampled).axes[0, 0]
    np.testing.assert_allclose(values(upper), 0.5 / np.abs(np.exp(0.1j * OMEGA) - 0.5), rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cp.Shaper.zv(1.0).plot([1.0, 1.0]), r"frequencies must increase strictly, got frequencies\[1\] = 1.0"),
        (lambda: cp.Shaper.zv(1.0).plot([-1.0, 1.0]), r"frequencies must be at least 0, got frequencies\[0\] = -1.0"),
        (lambda: cp.Shaper.zv(1.0).plot([1.0, math.nan]), "frequencies must be finite"),
        (lambda: cp.Shaper.zv(1.0).plot(OMEGA, response=[1.0]), "response must be as many numbers as frequencies, 60"),
        (lambda: cp.Shaper.zv(1.0).plot(OMEGA, response=-OMEGA), "response must be magnitudes of at least 0"),
        (lambda: cp.residual_plot(PLAN, [0.0, 1.0], loop=LOOP), "frequencies must be above 0 where a loop is drawn"),
        (lambda: cp.residual_plot(PLAN, OMEGA, 1.0), r"damping must lie in \[0, 1\), got 1.0"),
        (
            lambda: cp.residual_plot(PLAN, OMEGA, loop=ct.ss([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.2)),
            "frequencies must be at most the Nyquist frequency of the loop, 15.708 rad/s, got 30",
        ),
    ],
)
def test_values_that_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_loops_that_are_rejected():
    with pytest.raises(TypeError, match=r"loop must be a linear control system with inputs, got float; see"):
        cp.residual_plot(PLAN, OMEGA, loop=1.0)
    nonlinear = ct.nlsys(None, lambda t, x, u, p: u**2, inputs="u", outputs="y")
    with pytest.raises(TypeError, match=r"loop must be a linear .* got NonlinearIOSystem; see control.linearize"):
        cp.residual_plot(PLAN, OMEGA, loop=nonlinear)
