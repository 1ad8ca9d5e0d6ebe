"""From one jet to another: closed forms, direct solutions in many digits, and the loops that replanning makes."""

import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from scipy.interpolate import BPoly
from trajectory_oracle import Direct

from ctrlplan.trajectories import PolySpline, TrigSpline, Waypoint
from ctrlplan.trajectories.newton import newton_series, pair_series
from ctrlplan.trajectories.transition import (
    Transition,
    coefficients_by,
    extrapolated,
    homing_matrix,
    series,
    transition,
    transition_matrix,
)

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

ALPHAS = [0.0, 0.05, 1.0, 2.5, 4.0, 5.5]


def direct(horizon, alpha, first, last, start=0.0):
    """Equation (2) through two jets of one axis, solved in fifty digits."""
    return Direct([start, start + horizon], [list(first), list(last)], alpha)


def to_rest(order, horizon, alpha, s, highest):
    """Column j: derivatives 0 to `highest`, s seconds on, of the plan from the j-th unit jet to rest."""
    rest = [0.0] * (order + 1)
    columns = [direct(horizon, alpha, unit, rest).jet([s], highest)[:, 0] for unit in np.eye(order + 1).tolist()]
    return np.array(columns).T


# One transition


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_the_plan_is_that_of_the_direct_solution(order, alpha):
    """Equations (2), (3) by plain linear algebra; horizons of any size, two axes."""
    rng = np.random.default_rng(order)
    for horizon in (1e-3, 0.7, 40.0):
        scale = horizon ** -np.arange(order + 1.0)
        first, last = rng.normal(size=(2, order + 1, 2)) * scale[:, None]
        made = Transition(order, horizon, alpha)
        coefficients = made.coefficients(np.concatenate([first, last]))
        s = np.linspace(0.0, horizon, 7)
        found = made.jet(coefficients, s, order + 1)
        for axis in range(2):
            wanted = direct(horizon, alpha, first[:, axis], last[:, axis]).jet(s, order + 1)
            size = np.abs(wanted).max(axis=1, keepdims=True)
            assert (np.abs(found[:, axis] - wanted) <= 1e-11 * size).all()


@pytest.mark.parametrize("order", [0, 2, 4])
def test_at_alpha_0_it_is_the_polynomial_of_the_peer(order):
    """scipy's BPoly.from_derivatives."""
    rng = np.random.default_rng(1)
    first, last = rng.normal(size=(2, order + 1, 3))
    made = Transition(order, 2.0)
    peer = BPoly.from_derivatives([0.0, 2.0], [first, last])
    s = np.linspace(0.0, 2.0, 9)
    found = made.jet(made.coefficients(np.concatenate([first, last])), s, 2)
    for nu in range(3):
        wanted = (peer.derivative(nu) if nu else peer)(s).T
        assert np.abs(found[nu] - wanted).max() <= 1e-12 * np.abs(wanted).max()


@pytest.mark.parametrize("alpha", ALPHAS)
def test_three_ways_to_its_values_agree(alpha):
    """`jet` at many times, `series` at one, `evaluation` as a matrix."""
    rng = np.random.default_rng(2)
    made = Transition(3, 1.7, alpha)
    coefficients = made.coefficients(rng.normal(size=(8, 2)))
    factorials = [math.factorial(k) for k in range(6)]
    for s in (0.0, 0.3, 1.1, 1.7):
        jet = made.jet(coefficients, np.array([s]), 5)[:, :, 0]
        rows = np.array(series(made.rate, coefficients.T.tolist(), s, s - 1.7, 5)) * factorials
        matrix = made.evaluation(s, 5) @ coefficients
        # Each of the 4 pairs of factors costs at most 20 operations on the sum of the sizes of all terms; the sine of x
        # amplifies the rounding of x by x |cot x|, below 2 + alpha for x up to alpha / 2 = 2.75.
        sizes = [[np.abs(part) for part in pair] for pair in [pair_series(made.rate, s, s - 1.7, 5)] * 4]
        terms = np.array([newton_series(sizes, column, 5) for column in np.abs(coefficients).T.tolist()]) * factorials
        bound = 80 * (2 + alpha) * np.finfo(float).eps * terms.T
        assert (np.abs(rows.T - jet) <= bound).all()
        assert (np.abs(matrix - jet) <= bound).all()


def test_a_transition_made_before_is_used_again():
    assert transition(2, 1.25, 0.5) is transition(2, 1.25, 0.5)
    assert (transition(2, 1.25, 0.5).horizon, transition(2, 1.25, 0.5).alpha) == (1.25, 0.5)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_matrices_of_a_transition_to_zero_and_to_a_jet(alpha):
    """Both against the spline solved in fifty digits."""
    first, last, horizon = [0.3, -1.0, 0.5], [2.0, 0.4, -0.2], 1.7
    for end in (last, [0.0] * 3):
        wanted = direct(horizon, alpha, first, end).jet([0.6], 2)[:, 0]
        found = [coefficients_by(transition_matrix(2, horizon, alpha), [*first, *end], 1)]
        if not any(end):
            found.append(homing_matrix(2, horizon, alpha) @ np.array(first)[:, None])
        for coefficients in found:
            rows = Transition(2, horizon, alpha).jet(coefficients, np.array([0.6]), 2)[:, 0, 0]
            np.testing.assert_allclose(rows, wanted, rtol=1e-11, atol=1e-12)


def test_matrices_that_would_lose_digits_are_none():
    assert transition_matrix(2, 1.0, 6.28) is None
    assert homing_matrix(2, 1.0, 6.28) is None


# What is kept when a spline is fitted again on what remains: the angular frequency alpha/duration and, where the
# number of constraints is even, the absolute gamma; at fixed alpha the plan moves

JETS = ([0.3, -1.0, 0.5], [2.0, 0.4, -0.2])


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0, 4.0, 5.0])
@pytest.mark.parametrize("later", [0.1, 0.37, 0.8])
def test_fitted_again_with_its_frequency_and_gamma_a_spline_is_itself(alpha, later):
    """On the interval that remains, alpha = rate x what remains, the absolute gamma kept."""
    start, duration = 2.0, 3.0
    first, last = JETS
    plan = TrigSpline([Waypoint(start, *first), Waypoint(start + duration, *last)], alpha=alpha)
    now, rate = start + later * duration, alpha / duration
    jet = plan.jet(now, 2)[:, 0]
    left = start + duration - now
    gamma = plan.gamma[0] - rate * (now - start)
    t = np.linspace(now, plan.end, 23)

    def off(**options):
        again = TrigSpline([Waypoint(now, *jet), Waypoint(plan.end, *last)], **options)
        return np.abs(again(t) - plan(t)).max() / np.ptp(plan(np.linspace(start, plan.end, 99)))

    singular = abs(math.cos(3 * (0.5 * rate * left - gamma)))
    assert off(alpha=rate * left, gamma=gamma) <= 1e-10 / min(1.0, singular)
    assert off(alpha=alpha) > 1e-7
    assert off(alpha=rate * left) > 1e-7


def test_with_constant_alpha_the_plan_changes_slightly():
    """0.1 to 2 % of the move, at fixed alpha."""
    plan = TrigSpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)], alpha=2.0)
    now = 0.3
    again = TrigSpline([Waypoint(now, *plan.jet(now, 2)[:, 0]), Waypoint(1, 1, 0, 0)], alpha=2.0)
    t = np.linspace(now, 1.0, 101)
    assert 1e-3 < np.abs(again(t) - plan(t)).max() < 2e-2


@pytest.mark.parametrize("alpha", [1.0, 3.0, 5.0])
def test_an_odd_number_of_constraints_requires_the_frequency_only(alpha):
    plan = TrigSpline([Waypoint(0.0, 0.0, 0.5, 1.0), Waypoint(2.0, 1.0, 0.0)], alpha=alpha)
    now = 0.6
    jet = plan.jet(now, 2)[:, 0]
    t = np.linspace(now, 2.0, 31)
    again = TrigSpline([Waypoint(now, *jet), Waypoint(2.0, 1.0, 0.0)], alpha=alpha * 0.7)
    assert np.abs(again(t) - plan(t)).max() <= 1e-11
    other = TrigSpline([Waypoint(now, *jet), Waypoint(2.0, 1.0, 0.0)], alpha=alpha)
    assert np.abs(other(t) - plan(t)).max() > 1e-5


def test_a_polynomial_fitted_again_is_itself():
    first, last = JETS
    plan = PolySpline([Waypoint(0.0, *first), Waypoint(3.0, *last)])
    again = PolySpline([Waypoint(1.1, *plan.jet(1.1, 2)[:, 0]), Waypoint(3.0, *last)])
    t = np.linspace(1.1, 3.0, 31)
    assert np.abs(again(t) - plan(t)).max() <= 1e-12


# The law that replanning tends to


def closed_form_gains(order):
    """At H = 1, alpha = 0: y = (1 - s)^m times the Taylor polynomial of jet/(1 - s)^m, differentiated m times at 0."""
    m = order + 1
    gains = []
    for j in range(m):
        top = sum(math.comb(m - 1 + i - j, i - j) * (-1) ** (m - i) * math.comb(m, m - i) for i in range(j, m))
        gains.append(-math.factorial(m) * top / math.factorial(j))
    return gains


@pytest.mark.parametrize(
    ("order", "gains"), [(1, [6, 4]), (2, [60, 36, 9]), (3, [840, 480, 120, 16])], ids=["1", "2", "3"]
)
def test_printed_gains(order, gains):
    assert closed_form_gains(order) == gains  # the other derivation says the same
    assert np.abs(Transition(order, 1.0).gains() / gains - 1.0).max() <= 1e-12


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("horizon", [0.02, 1.0, 3.0, 500.0])
def test_gains_of_polynomials_for_every_horizon(order, horizon):
    """k_j scales as H^-(b + 1 - j); order 4 is 15120, 8400, 2100, 300, 25."""
    wanted = np.array(closed_form_gains(order)) / horizon ** np.arange(order + 1, 0, -1.0)
    if order == 4:
        assert closed_form_gains(4) == [15120, 8400, 2100, 300, 25]
    assert np.abs(Transition(order, horizon).gains() / wanted - 1.0).max() <= 1e-11


@pytest.mark.parametrize("alpha", [0.3, 1.0, 2.5, math.pi, 4.0, 5.5])
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_gains_of_trigonometric_plans(order, alpha):
    """All of them by the direct solution in many digits, the last by (b + 1)^2 (alpha/2) cot(alpha/2)/H."""
    for horizon in (0.4, 2.0):
        found = Transition(order, horizon, alpha).gains()
        wanted = -to_rest(order, horizon, alpha, 0.0, order + 1)[-1]
        scale = np.array(closed_form_gains(order)) / horizon ** np.arange(order + 1, 0, -1.0)
        assert (np.abs(found - wanted) <= 1e-10 * np.maximum(scale, np.abs(wanted))).all()
        last = (order + 1) ** 2 * 0.5 * alpha / math.tan(0.5 * alpha) / horizon
        assert abs(found[-1] - last) <= 1e-10 * max(abs(last), 1.0 / horizon)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_law_is_stable_below_pi_marginal_there_and_unstable_above(order):
    """By the roots of its characteristic polynomial; the last gain is (order + 1)^2 (alpha/2) cot(alpha/2)/horizon."""

    def fastest(alpha):
        return np.roots([1.0, *Transition(order, 1.0, alpha).gains()[::-1]]).real.max()

    assert all(fastest(alpha) < -1e-2 for alpha in (0.0, 1.0, 2.0, 3.0))
    # The roots' sum is minus the last gain: at pi it is 0, and they are not all on the left.
    assert abs(Transition(order, 1.0, math.pi).gains()[-1]) <= 1e-10
    assert all(fastest(alpha) > 1e-2 for alpha in (3.3, 4.0, 5.0))


# The map from fit to fit


def sampled_radius(order, horizon, alpha, period):
    return float(np.abs(np.linalg.eigvals(to_rest(order, horizon, alpha, period, order))).max())


def test_the_printed_radius():
    """m = 3, alpha = 3.3, P = 0.1 H."""
    assert round(Transition(2, 1.0, 3.3).radius(0.1), 3) == 0.961
    assert round(sampled_radius(2, 1.0, 3.3, 0.1), 3) == 0.961


@examples(40)
@given(
    st.integers(0, 4),
    st.one_of(st.just(0.0), st.floats(0.05, 6.0)),
    st.floats(0.01, 1.0),
    st.sampled_from([1e-3, 1.0, 60.0]),
)
def test_radius_by_the_direct_solution(order, alpha, share, horizon):
    period = share * horizon
    found, wanted = Transition(order, horizon, alpha).radius(period), sampled_radius(order, horizon, alpha, period)
    # Eigenvalues of a nearly nilpotent map move by roots of the rounding error.
    assert abs(found - wanted) <= 1e-6 * max(1.0, wanted) or max(found, wanted) < 1e-2


def test_a_period_of_the_whole_horizon_comes_to_rest_at_once():
    for order in range(4):
        assert Transition(order, 2.0, 1.0).radius(2.0) <= 1e-2  # nilpotent, to the root of rounding


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_map_tends_to_the_law(order):
    """log(radius)/period -> the law's slowest root, the difference proportional to the period."""
    slowest = np.roots([1.0, *closed_form_gains(order)[::-1]]).real.max()
    made = Transition(order, 1.0)
    off = [math.log(made.radius(period)) / period - slowest for period in (0.02, 0.01, 0.005)]
    assert abs(off[0] / off[1] - 2.0) < 0.15
    assert abs(off[1] / off[2] - 2.0) < 0.08


# Small parts


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_extrapolated_is_a_taylor_polynomial(n):
    rng = np.random.default_rng(n)
    jet, time = rng.normal(size=(n, 2)), 1.7
    wanted = [
        [sum(jet[k + j, a] * time**j / math.factorial(j) for j in range(n - k)) for a in range(2)] for k in range(n)
    ]
    assert np.abs(extrapolated(jet, time) - wanted).max() <= 1e-14 * np.abs(wanted).max()
    assert np.array_equal(extrapolated(jet, 0.0), jet)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1, 1.0), "order must be an integer of at least 0, got -1"),
        ((1.5, 1.0), "order must be an integer of at least 0, got 1.5"),
        ((2, 0.0), "horizon must be finite and above 0, got 0.0"),
        ((2, math.nan), "horizon must be finite and above 0, got nan"),
        ((2, 1.0, -0.1), r"alpha must lie in \[0, 2 pi\), got -0.1"),
        ((2, 1.0, 2 * math.pi), r"alpha must lie in \[0, 2 pi\), got 6.28"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        Transition(*arguments)


def test_a_radius_requires_a_period():
    with pytest.raises(ValueError, match="period must be finite and above 0, got 0"):
        Transition(2, 1.0).radius(0)


def test_a_transition_cannot_be_changed():
    made = Transition(2, 1.0)
    with pytest.raises(AttributeError, match="immutable"):
        made.horizon = 2.0


@pytest.mark.filterwarnings("ignore::FutureWarning")  # casadi will change the types that numpy's functions return
@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_time_and_coefficients_may_be_symbols(alpha):
    casadi = pytest.importorskip("casadi")
    past, ahead = casadi.SX.sym("p"), casadi.SX.sym("a")
    column = [casadi.SX.sym(f"c{k}") for k in range(6)]
    (row,) = series(alpha / 2.0, [column], past, ahead, 3)
    traced = casadi.Function("f", [past, ahead, *column], row)
    jets = np.random.default_rng(3).normal(size=(6, 1))
    values = Transition(2, 2.0, alpha).coefficients(jets)[:, 0].tolist()
    with mp.workdps(40):
        wanted = direct(2.0, alpha, jets[:3, 0], jets[3:, 0]).jet([0.7], 3)[:, 0] / [1, 1, 2, 6]
    found = np.array([float(v) for v in traced(0.7, 0.7 - 2.0, *values)])
    assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()
