"""Replanners with a fixed horizon on integrators: a constant linear law, and where it is stable."""

import math
from functools import cache

import control as ct
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from repetitions import examples
from replanner_oracle import METHODS, REST, between, chain
from scipy.linalg import expm

import ctrlplan as cp


@cache
def map_from_fit_to_fit(order, horizon, alpha, period):
    """Column j: the j-th unit jet, a period later."""
    rest = [0.0] * (order + 1)
    columns = [between(unit, rest, horizon, alpha, period, order)[:, 0] for unit in np.eye(order + 1).tolist()]
    return np.array(columns).T


# In the linear case: a constant law

LINEAR = [
    (1, 1.0, 0.0),
    (1, 0.5, 2.5),
    (2, 1.0, 0.0),
    (2, 2.0, 1.0),
    (3, 1.0, 0.0),
    (3, 4.0, 2.0),
    (4, 1.0, 0.0),
    (4, 3.0, 1.5),
]


def regulated(order, horizon, alpha, period, times, method="auto"):
    """Chain of integrators brought to 0 from a unit jet of every order."""
    plan = cp.Step(0.0, 0.0, labels=["x"])
    replanner = cp.create_replanner_iosystem(
        plan, period, order=order, horizon=horizon, alpha=alpha, measured=order, derivatives=order + 1, suffix="_r"
    )
    plant = chain(order, f"x_r_d{order + 1}")
    loop = ct.interconnect([replanner, plant], inputs=0, outputs=[*plant.output_labels, *replanner.output_labels])
    state = np.zeros(loop.nstates)
    state[-order - 1 :] = unit(order, horizon)
    return cp.simulate(loop, times, None, state, method=method).outputs[: order + 1]


def unit(order, horizon):
    return (-1.0) ** np.arange(order + 1) / horizon ** np.arange(order + 1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("order", "horizon", "alpha"), LINEAR)
def test_at_its_samples_the_loop_is_the_power_of_a_matrix(order, horizon, alpha, method):
    """The map from fit to fit, by a direct solution: whatever the period."""
    period = 0.15 * horizon
    found = regulated(order, horizon, alpha, period, period * np.arange(9), method)
    state, scale = unit(order, horizon), np.abs(found).max(axis=1)
    for k in range(9):
        assert (np.abs(found[:, k] - state) <= 1e-6 * scale).all()
        state = map_from_fit_to_fit(order, horizon, alpha, period) @ state


@pytest.mark.slow
@pytest.mark.parametrize(("order", "horizon", "alpha"), LINEAR)
def test_the_loop_tends_to_the_constant_law_in_proportion_to_the_period(order, horizon, alpha):
    """Gains by the direct solution (alpha = 0: 6, 4; 60, 36, 9; 840, 480, 120, 16; 15120, ..., 25); slope measured."""
    rest = [0.0] * (order + 1)
    gains = [-between(e, rest, horizon, alpha, 0.0, order + 1)[-1, 0] for e in np.eye(order + 1).tolist()]
    printed = {1: [6, 4], 2: [60, 36, 9], 3: [840, 480, 120, 16], 4: [15120, 8400, 2100, 300, 25]}[order]
    if not alpha:
        assert np.abs(np.array(gains) * horizon ** np.arange(order + 1, 0, -1.0) - printed).max() <= 1e-8
    else:
        last = (order + 1) ** 2 * 0.5 * alpha / math.tan(0.5 * alpha) / horizon
        assert abs(gains[-1] - last) <= 1e-10 * last
    law = np.diag(np.ones(order), 1)
    law[-1] = -np.array(gains)
    times = horizon * np.array([0.0, 0.24, 0.48])
    wanted = np.array([expm(law * t) @ unit(order, horizon) for t in times])[:, 0]
    errors = []
    for share in (0.02, 0.01, 0.005):
        found = regulated(order, horizon, alpha, share * horizon, times)[0]
        errors.append(np.abs(found - wanted).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(slopes - 1.0).max() <= 0.1
    assert errors[-1] <= 0.02


# Period, horizon and alpha that do not go together


def made(order, horizon, alpha, period):
    return cp.create_replanner_iosystem(cp.Step(0.0), period, order=order, horizon=horizon, alpha=alpha)


def test_an_alpha_above_pi_may_be_stable_where_fits_are_sampled_and_an_error_has_the_radius():
    """Continuous fits are stable below alpha = pi; a period moves that bound."""
    assert abs(radius(2, 1.0, 3.3, 0.1) - 0.961) < 5e-4
    made(2, 1.0, 3.3, 0.1)
    figure = radius(2, 2.0, 4.0, 0.1)
    assert figure > 1.0
    message = (
        "the map from fit to fit must have a spectral radius below 1, "
        f"got {figure:.4g} with dt = 0.1 s, horizon = 2 s and alpha = 4"
    )
    with pytest.raises(ValueError) as raised:
        made(2, 2.0, 4.0, 0.1)
    assert str(raised.value) == message


def radius(order, horizon, alpha, period):
    return float(np.abs(np.linalg.eigvals(map_from_fit_to_fit(order, horizon, alpha, period))).max())


@examples(40)
@given(
    st.integers(0, 4),
    st.one_of(st.just(0.0), st.floats(0.1, 6.0)),
    st.floats(0.02, 1.0),
    st.sampled_from([1e-2, 1.0, 50.0]),
)
def test_accepted_where_the_radius_is_below_1_and_nowhere_else(order, alpha, share, horizon):
    figure = radius(order, horizon, alpha, share * horizon)
    assume(abs(figure - 1.0) > 1e-6)
    if figure < 1.0:
        made(order, horizon, alpha, share * horizon)
    else:
        with pytest.raises(ValueError, match="spectral radius below 1"):
            made(order, horizon, alpha, share * horizon)


def test_a_fixed_horizon_is_one_of_polynomials_unless_alpha_is_given():
    plan = cp.TrigSpline(REST, alpha=4.0)
    with pytest.raises(ValueError, match=r"alpha = 4$"):
        cp.create_replanner_iosystem(plan, 0.05, horizon=1.0, alpha=4.0)
    block = cp.create_replanner_iosystem(plan, 0.05, horizon=1.0)
    assert block.syslist[1]._horizons.rate == 0.0
