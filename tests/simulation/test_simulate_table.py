"""The table of the linear study: settling times and overshoots to every digit printed."""

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan import metrics

# k: step, trigonometric (alpha = 1), quintic, a move of 1 in 1 s; overshoot on the error [%] and settling time [s].
TABLE = {
    1: (("16.3034", "8.07635"), ("16.0211", "8.56714"), ("16.0148", "8.56693")),
    5: (("48.6397", "7.56125"), ("44.5425", "8.02597"), ("44.4532", "8.02505")),
    20: (("70.2256", "7.82524"), ("48.8553", "7.62643"), ("48.4222", "7.61252")),
    100: (("85.4468", "7.60094"), ("11.4917", "3.42085"), ("10.7596", "3.39506")),
    1000: (("95.1535", "7.75851"), ("0.634705", "0.847783"), ("0.646697", "0.850593")),
}
MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLANS = {
    "step": cp.Step(1.0),
    "trigonometric": cp.TrigSpline(MOVE, alpha=1.0),
    "quintic": cp.PolySpline(MOVE),
}
T = np.linspace(0.0, 15.0, 30_001)


def half_a_digit(printed):
    return 0.5000001 * 10.0 ** -len(printed.partition(".")[2])


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("gain", TABLE)
def test_overshoot_and_settling(gain, plan):
    found = cp.simulate(cp.plants.integrator_lag_loop(gain), T, PLANS[plan], method="exact")
    overshoot, settling = TABLE[gain][list(PLANS).index(plan)]
    reference = PLANS[plan](T)
    assert abs(metrics.overshoot(T, found.outputs, 1.0, 0.0, reference) - float(overshoot)) <= half_a_digit(overshoot)
    assert abs(metrics.settling_time(T, found.outputs, 1.0, 0.0) - float(settling)) <= half_a_digit(settling)


@pytest.mark.parametrize("gain", [0.3, 1.0, 5.0, 20.0, 100.0, 1000.0])
def test_overshoot_of_the_step_in_closed_form(gain):
    # The first peak is half a period after the jump: 100 exp(-pi xi w_n/w_p) = 100 exp(-pi/(2 w_p)).
    found = cp.simulate(cp.plants.integrator_lag_loop(gain), T, cp.Step(1.0), method="exact")
    exact = 100 * np.exp(-np.pi / (2 * np.sqrt(gain - 0.25)))
    assert abs(metrics.overshoot(T, found.outputs, 1.0, 0.0) - exact) <= 1e-6


@pytest.mark.parametrize(("plan", "limit"), [("trigonometric", 0.8619), ("quintic", 0.8647)])
def test_the_limit_of_settling_is_the_reference_itself(plan, limit):
    """No gain settles before the plan is in the band: 0.8619 s and 0.8647 s, where the paper says 1 s."""
    assert abs(metrics.settling_time(T, PLANS[plan](T), 1.0, 0.0) - limit) <= 0.5e-4
    found = cp.simulate(cp.plants.integrator_lag_loop(1e6), T, PLANS[plan], method="exact")
    assert abs(metrics.settling_time(T, found.outputs, 1.0, 0.0) - limit) <= 1e-3


@pytest.mark.parametrize(("plan", "overshoot", "settling"), [("step", 48, 7.6), ("trigonometric", 44, 8.0)])
def test_what_the_paper_prints_at_gain_5(plan, overshoot, settling):
    # It truncates the percents.
    found = cp.simulate(cp.plants.integrator_lag_loop(5), T, PLANS[plan], method="exact")
    assert np.floor(metrics.overshoot(T, found.outputs, 1.0, 0.0, PLANS[plan](T))) == overshoot
    assert round(metrics.settling_time(T, found.outputs, 1.0, 0.0), 1) == settling
