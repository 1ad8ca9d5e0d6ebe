"""The table of the linear study: settling times and overshoots to every digit printed."""

import numpy as np
import pytest
from linear_table import GAINS, TABLE, computed
from linear_table import PLANS as NAMES

import ctrlplan as cp
from ctrlplan import metrics

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLANS = {
    "step": cp.Step(1.0),
    "trigonometric": cp.TrigSpline(MOVE, alpha=1.0),
    "quintic": cp.PolySpline(MOVE),
}
T = np.linspace(0.0, 15.0, 30_001)


def half_a_digit(printed):
    return 0.5000001 * 10.0 ** -len(printed.partition(".")[2])


@pytest.mark.parametrize("plan", NAMES)
@pytest.mark.parametrize("gain", GAINS)
def test_the_table_is_the_closed_form_to_every_digit(gain, plan):
    values = tuple(f"{value:.6g}" for value in computed(gain, plan))
    assert values == TABLE[gain][NAMES.index(plan)]


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
