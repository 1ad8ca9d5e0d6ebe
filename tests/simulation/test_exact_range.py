"""Exact responses at the ends of the range of numbers: fast and slow poles, overflow, and loss of digits."""

import warnings

import control as ct
import mpmath as mp
import numpy as np
import pytest
import simulation_oracle
from simulation_oracle import both, constant, gap, polygon, response, step

import ctrlplan as cp
from ctrlplan.simulation import equilibrium_state
from ctrlplan.simulation.exact import exact_states, matrix_product, sampled_states

SMALL = 1e-11
"""Error bound, relative to the largest value of each signal."""
REST = ([0.4, 1.7], [[[0.5, 0.0, 0.0], [2.0, 0.0, 0.0]]])
LATE = ([1.0, 2.0], [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
STIFF = {
    "cascade": lambda f: ([[-f, 0.0], [1.0, -1.0]], [[f], [0.0]]),
    "companion": lambda f: ([[-f, -f], [1.0, 0.0]], [[f], [0.0]]),
    "transposed companion": lambda f: ([[0.0, 1.0], [-f, -f]], [[0.0], [f]]),
    "coupled": lambda f: ([[-f, f], [0.5 * f, -f]], [[1.0], [1.0]]),
    "double pole": lambda f: ([[-1.0, f], [0.0, -1.0]], [[0.0], [1.0]]),
    "nearly double": lambda f: ([[-1.0, f], [0.0, -1.0 - 1e-9]], [[0.0], [1.0]]),
    "triple pole": lambda f: ([[-1.0, f, 0.0], [0.0, -1.0, f], [0.0, 0.0, -1.0]], [[0.0], [0.0], [1.0]]),
    "three rates": lambda f: ([[-f, 0.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, -1.0 / f]], [[f], [0.0], [0.0]]),
}


def states_of(a, b, plan, times, initial=None):
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    start = np.zeros(len(a)) if initial is None else np.asarray(initial, dtype=float)
    return exact_states(a, b, plan.segment_jet_at, plan.breakpoints, np.asarray(times), start)


# Poles times duration far beyond 1e16


@pytest.mark.parametrize(("rate", "duration"), [(1e9, 1e4), (1e12, 1e4), (1e17, 1e-3), (1e17, 1e10), (1e150, 1.0)])
@pytest.mark.parametrize("count", [2, 11, 33, 1001])
def test_a_fast_lag_follows_whatever_the_duration(rate, duration, count):
    # x' = rate (u - x): within |u'|/rate of u once exp(-rate t) has died.
    t = np.linspace(0.0, duration, count)
    system = ct.ss(-rate, rate, 1.0, 0.0)
    plan = cp.PolySpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(0.5 * duration, 1, 0, 0)])
    assert np.abs(cp.simulate(system, t, plan).outputs - plan(t)).max() <= 1e-14 + 2.0 * plan.peak(1)[0] / rate
    for inputs in (1.0, np.ones(count)):
        found = cp.simulate(system, t, inputs).outputs
        exact = -np.expm1(-rate * t)
        assert np.abs(found - exact).max() <= 1e-12


def test_the_printed_case():
    found = cp.simulate(ct.ss(-1e12, 1.0, 1.0, 0.0), np.linspace(0.0, 1e4, 2001) ** 0.9, cp.Step(1.0, time=0.5)).outputs
    assert np.abs(found[-1000:] - 1e-12).max() <= 1e-24
    assert np.abs(found).max() <= 1.000001e-12


@pytest.mark.parametrize("kind", STIFF)
@pytest.mark.parametrize("fast", [1e8, 1e17, 1e60])
def test_stiff_and_defective_systems_in_closed_form(kind, fast):
    plan, signals = both(*REST, 1.0)
    a, b = STIFF[kind](fast)
    n = len(a)
    for count, power in ((4, 1.0), (23, 1.4), (201, 1.0)):
        t = 9.0 * np.linspace(0.0, 1.0, count) ** power
        some = np.unique(np.linspace(0, count - 1, 8).astype(int))
        start = np.linspace(1.0, -1.0, n)
        exact = response(a, b, np.eye(n), np.zeros((n, 1)), signals, t[some], start)[1]
        assert gap(states_of(a, b, plan, t, start)[:, some], exact) <= SMALL


@pytest.mark.parametrize("fast", [1e8, 1e17, 1e60])
@pytest.mark.parametrize("power", [1.0, 1.3])
def test_samples_into_stiff_systems_in_closed_form(fast, power):
    t = 9.0 * np.linspace(0.0, 1.0, 25) ** power
    u = np.random.default_rng(2).normal(size=25)
    for kind in ("cascade", "companion", "three rates"):
        a, b = map(np.array, STIFF[kind](fast))
        exact = response(a, b, np.eye(len(a)), np.zeros((len(a), 1)), [polygon(t, u)], t)[1]
        assert gap(sampled_states(a, b, u[None], t, np.zeros(len(a))), exact) <= SMALL


@pytest.mark.parametrize("unit", [1e-300, 1e-100, 1e-12, 1e12, 1e14])
def test_time_scales_far_from_a_second(unit):
    for count in (5, 201):
        t = unit * np.linspace(0.0, 5.0, count)
        found = cp.simulate(ct.ss(-1.0 / unit, 1.0 / unit, 1.0, 0.0), t, 1.0).outputs
        assert np.abs(found + np.expm1(-t / unit)).max() <= 1e-13
        ramp = cp.simulate(ct.ss(-1.0 / unit, 1.0 / unit, 1.0, 0.0), t, t / unit).outputs
        assert np.abs(ramp - (t / unit + np.expm1(-t / unit))).max() <= 1e-13


@pytest.mark.parametrize("unit", [1e-13, 1e-9, 1e9, 1e13])
@pytest.mark.parametrize("alpha", [0.0, 1.0, 5.0])
def test_plans_of_any_duration(unit, alpha):
    """A power of two as the unit changes no digit, so that a second says what it must be."""
    unit = 2.0 ** np.round(np.log2(unit))
    t = np.linspace(0.0, 2.0, 33)

    def run(scale):
        points = [cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(scale, 1, 0, 0)]
        plan = cp.TrigSpline(points, alpha=alpha, warn=False) if alpha else cp.PolySpline(points)
        system = ct.ss(np.array([[-3.0, -50.0], [1.0, 0.0]]) / scale, [[50.0 / scale], [0.0]], [[0.0, 1.0]], 0.0)
        return cp.simulate(system, scale * t, plan).outputs

    assert np.abs(run(unit) - run(1.0)).max() <= SMALL


def test_what_is_beyond_the_range_says_so():
    t = np.linspace(0.0, 1e10, 5)
    for matrices in ((-1e300, 1.0, 1.0, 0.0), (-1e-5, 1e306, 1e-306, 0.0)):
        with pytest.raises(ValueError, match="the system matrices A and B times the duration must be below 1e308"):
            cp.simulate(ct.ss(*matrices), t, cp.Step(1.0))
    far = ct.series(ct.ss(-1.0, 1e200, 1.0, 0.0), ct.ss(-1.0, 1.0, 1e200, 0.0))
    assert np.isposinf(cp.simulate(far, [0.0, 1.0], 1.0).outputs[1])
    points = [cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(1e-25, 1, 0, 0)]
    short, one = cp.PolySpline(points), cp.PolySpline([cp.Waypoint(0.0, 0, 0, 0), cp.Waypoint(1.0, 1, 0, 0)])
    found = cp.simulate(ct.ss(-1e25, 1e25, 1.0, 0.0), [0.0, 1e-25, 2e-25], short)  # higher derivatives are 0
    expected = cp.simulate(ct.ss(-1.0, 1.0, 1.0, 0.0), [0.0, 1.0, 2.0], one)
    np.testing.assert_allclose(found.outputs, expected.outputs, rtol=1e-12, atol=0.0)
    plan = cp.TrigSpline(points, alpha=1.0)
    with pytest.raises(
        ValueError,
        match=r"derivatives of inputs up to order 17 must not overflow, got an overflow on a segment of 1e-25 s",
    ):
        cp.simulate(ct.ss(-1e25, 1e25, 1.0, 0.0), [0.0, 1e-25, 2e-25], plan)
    for matrices in ((np.nan, 1.0, 1.0, 0.0), (-1.0, np.inf, 1.0, 0.0), (-1.0, 1.0, 1.0, np.nan)):
        with pytest.raises(ValueError, match=r"[ABD] of broken must be finite, got nan or inf"):
            cp.simulate(ct.ss(*matrices, name="broken"), [0.0, 1.0], 1.0)


def test_a_stiff_loop_rests_where_its_slow_states_do():
    # By hand, x1 = x2 = 1; next to 1e18 a rate of 1 is no integrator.
    assert np.abs(equilibrium_state(ct.ss([[-1e18, 0], [1, -1]], [[1e18], [0]], [[0, 1]], 0), 1.0) - 1.0).max() <= 1e-12
    # A slow integrator after them that is not in equilibrium at 1: there is no equilibrium.
    loop = ct.ss([[-1e18, 0, 0], [1, -1, 0], [0, 1e-9, 0]], [[1e18], [0], [0]], [[0, 0, 1]], 0)
    assert equilibrium_state(loop, 1.0).tolist() == [0.0, 0.0, 0.0]


# Overflow


@pytest.mark.parametrize(
    ("rate", "count"),
    [(100.0, 2), (100.0, 51), (100.0, 5001), (1e4, 501), (1e9, 6), (1e9, 51), (1e60, 2), (1e60, 9)],
)
def test_an_unstable_plant_at_rest_stays_there(rate, count):
    t = np.linspace(0.0, 50.0, count)
    system = ct.ss(rate, 1.0, 1.0, 0.0)
    for inputs in (None, 0.0, np.zeros(count), cp.Step(1.0, time=60.0)):
        assert not cp.simulate(system, t, inputs).outputs.any()
    for bent in (t**1.2, t**2):
        assert not cp.simulate(system, bent, np.zeros(count)).outputs.any()
        assert not cp.simulate(system, bent).outputs.any()


@pytest.mark.parametrize("count", [4, 41, 401])
def test_at_rest_until_the_plan_begins(count):
    # x' = 1000 x + u: 0 until u begins at 1 s, beyond all numbers soon after.
    t = np.linspace(0.0, 30.0, count)
    plan, _ = both(*LATE, 1.0)
    late = np.where(t > 1.0, 1.0, 0.0)
    for inputs, begin in ((plan, 1.0), (-plan, 1.0), (late, t[late.argmax() - 1])):
        found = cp.simulate(ct.ss(1e3, 1.0, 1.0, 0.0), t, inputs).outputs
        assert not found[t <= begin].any()
        sign = -1.0 if inputs is not plan and inputs is not late else 1.0
        assert (found[t > begin + 1.0] == sign * np.inf).all()


@pytest.mark.parametrize("power", [1.0, 1.1])
@pytest.mark.parametrize("count", [2, 11, 101, 1001])
def test_growth_from_a_tiny_state_is_followed_to_the_last_number(count, power):
    """exp(rate t) is beyond the range of numbers while x0 exp(rate t) is not."""
    t = 10.0 * np.linspace(0.0, 1.0, count) ** power
    for rate in (100.0, 130.0):
        with mp.workdps(30):
            exact = np.array([float(mp.mpf(1e-300) * mp.exp(mp.mpf(rate) * mp.mpf(x))) for x in t])
        for found in (
            states_of([[rate]], [[1.0]], cp.Step(0.0), t, [1e-300])[0],
            sampled_states(np.array([[rate]]), np.ones((1, 1)), np.zeros((1, count)), t, np.array([1e-300]))[0],
        ):
            # Rounding of the rate changes growth by eps rate t.
            assert np.abs(found / exact - 1.0).max() <= 1e-11


def test_signs_of_what_has_overflowed():
    t = np.linspace(0.0, 50.0, 26)
    up, down = cp.simulate(ct.ss(np.diag([100.0, 100.0]), [[1.0], [-1.0]], np.eye(2), 0), t, 1.0).outputs
    assert (up[t > 8.0] == np.inf).all()
    assert (down[t > 8.0] == -np.inf).all()


@pytest.mark.parametrize(("rate", "count"), [(100.0, 3), (100.0, 51), (100.0, 401), (1e5, 26), (1e60, 51)])
@pytest.mark.parametrize("method", ["plan", "number", "samples"])
def test_outputs_that_do_not_see_an_overflowing_state_stay_finite(method, rate, count):
    # The unstable state is decoupled, or driven by the stable one; neither acts on it.
    t = np.linspace(0.0, 50.0, count)
    inputs = {"plan": cp.Step(1.0), "number": 1.0, "samples": np.ones(count)}[method]
    for coupling in (0.0, 1.0, -1e-3):
        system = ct.ss([[rate, coupling], [0.0, -1.0]], [[1.0], [1.0]], [[0.0, 1.0], [1.0, 1.0]], [[2.0], [0.0]])
        seen, wild = cp.simulate(system, t, inputs).outputs
        assert np.abs(seen - (3.0 - np.exp(-t))).max() <= 1e-12
        assert np.isinf(wild[-1])
        assert not np.isnan(wild).any()


def test_a_chain_passes_overflow_on_only_downstream():
    # x1 stable -> x2 unstable -> x3 stable, x4 by itself, in another order of states.
    a = np.array([[-1.0, 0, 0, 0], [1.0, 200.0, 0, 0], [0, 1.0, -2.0, 0], [0, 0, 0, -3.0]])
    b, order = np.array([[1.0], [0], [0], [1.0]]), [2, 0, 3, 1]
    t = np.linspace(0.0, 20.0, 41)
    found = states_of(a[np.ix_(order, order)], b[order], cp.Step(1.0), t)
    third, first, fourth, second = found
    assert np.abs(first + np.expm1(-t)).max() <= 1e-13
    assert np.abs(fourth + np.expm1(-3.0 * t) / 3.0).max() <= 1e-13
    assert np.isposinf(second[t > 4.0]).all()
    assert np.isposinf(third[t > 4.0]).all()
    # x2 = (exp(200 t) - 1)/200 - ... until then: by partial fractions of 1/(s (s + 1) (s - 200)).
    early = t < 3.4
    exact = np.exp(200.0 * t[early]) / (200.0 * 201.0) - 1.0 / 200.0 + np.exp(-t[early]) / 201.0
    assert np.abs(second[early] - exact).max() <= 1e-11 * exact.max()


def test_a_batch_with_systems_that_outgrow_its_cells():
    systems = [np.diag([rate, -1.0]) for rate in (1e3, -1e3, 1e8, 0.0)]
    a, b = np.stack(systems), np.ones((4, 2, 1))
    for t in (np.linspace(0.0, 10.0, 101), np.linspace(0.0, 10.0, 37) ** 1.1):
        initial = np.zeros((4, 2))
        found = exact_states(a, b, cp.Step(1.0).segment_jet_at, [], t, initial)
        assert np.abs(found[:, 1] + np.expm1(-t)).max() <= 1e-13
        assert np.abs(found[1, 0] + np.expm1(-1e3 * t) / 1e3).max() <= 1e-16
        assert np.abs(found[3, 0] - t).max() <= 1e-13
        assert np.isposinf(found[[0, 2], 0, 1 + t.searchsorted(1.0) :]).all()
        at_rest = exact_states(a, b, cp.Step(0.0).segment_jet_at, [], t, initial)
        assert not at_rest.any()


def test_zero_times_infinity_is_zero():
    left = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, -1.0], [-3.0, 0.0]])
    right = np.array([[np.inf, 1.0, np.inf], [5.0, -np.inf, np.inf]])
    found = matrix_product(left, right)
    assert found.tolist() == [[np.inf, 1.0, np.inf], [10.0, -np.inf, np.inf], [np.inf] * 3, [-np.inf, -3.0, -np.inf]]
    stack = matrix_product(np.stack([left, left]), np.stack([right, right]))
    assert np.array_equal(stack, np.stack([found, found]))


# Loss of digits


@pytest.mark.parametrize(
    ("turns", "warned"),
    [(1e5, False), (1e8, False), (1e12, True), (1e16, True)],
)
def test_a_phase_that_doubles_do_not_hold_is_said(turns, warned):
    """Rounding of w changes the phase by eps w t."""
    t = np.linspace(0.0, 1e4, 41)
    w = turns / t[-1] * 1.1
    system = ct.ss([[0.0, w], [-w, 0.0]], [[0.0], [w]], np.eye(2), 0.0, name="ringing")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = cp.simulate(system, t, 1.0).outputs
    exact = response(*(np.asarray(m) for m in (system.A, system.B, system.C, system.D)), [constant(1.0)], t)[0]
    assert len(caught) == warned
    assert all("outputs y[0], y[1] of ringing are uncertain by" in str(warning.message) for warning in caught)
    if not warned:
        assert gap(found, exact) <= 1e-6


def test_an_output_that_hides_an_unstable_mode_is_said():
    # (s - 3)/((s - 3)(s + 1.3)): stable, with a state that grows as exp(3 t).
    system = ct.ss([[1.7, 3.9], [1.0, 0.0]], [[1.0], [0.0]], [[1.0, -3.0]], 0.0, name="hiding")
    short, long = np.linspace(0.0, 5.0, 51), np.linspace(0.0, 40.0, 51)
    found = cp.simulate(system, short, 1.0).outputs
    assert np.abs(found + np.expm1(-1.3 * short) / 1.3).max() <= 1e-6
    with pytest.warns(
        UserWarning, match=r"outputs y\[0\] of hiding are uncertain by .*remove very fast or very unstable modes"
    ):
        cp.simulate(system, long, 1.0)


def test_a_difference_of_overflowed_states_is_said():
    system = ct.ss(np.diag([100.0, 100.0]), [[1.0], [1.0]], [[1.0, -1.0], [1.0, 0.0]], 0.0, name="apart")
    t = np.linspace(0.0, 50.0, 51)
    with pytest.warns(UserWarning, match=r"outputs y\[0\] of apart are undefined from 8 s on"):
        found = cp.simulate(system, t, 1.0)
    assert not np.isnan(found.outputs).any()


@pytest.mark.parametrize("kind", STIFF)
def test_nothing_is_said_of_stiff_systems_that_keep_their_digits(kind):
    for fast in (1e6, 1e13, 1e30):
        a, b = STIFF[kind](fast)
        system = ct.ss(a, b, np.eye(len(a)), 0.0)
        for inputs in (1.0, cp.Step(1.0, time=3.0)):
            cp.simulate(system, np.linspace(0.0, 1e4, 101), inputs)
        rest = np.linalg.solve(np.asarray(a) / np.abs(a).max(axis=1)[:, None], -np.ravel(b) / np.abs(a).max(axis=1))
        cp.simulate(system, np.linspace(0.0, 1e4, 101), 1.0, rest)


@pytest.mark.parametrize("kind", ["step", "samples"])
@pytest.mark.parametrize("seed", range(8))
def test_random_chains_up_to_and_beyond_the_range_of_numbers(kind, seed, monkeypatch):
    """Stable and unstable states in any order, from zero, tiny and huge states."""
    # Triangular as they are: a zero must stay one where others grow beyond the oracle's digits.
    monkeypatch.setattr(simulation_oracle, "_schur", lambda a: (mp.eye(a.rows), a))
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    chain = np.triu(rng.normal(size=(n, n)), 1) * (rng.random((n, n)) < 0.5) * 10.0 ** rng.uniform(-2, 2)
    chain[range(n), range(n)] = np.where(rng.random(n) < 0.5, 1, -1) * 10.0 ** rng.uniform(-1, 3.5, n)
    b = rng.normal(size=(n, 1)) * (rng.random((n, 1)) < 0.4)
    start = rng.normal(size=n) * (rng.random(n) < 0.5) * 10.0 ** rng.choice([0, -100, -200, 100])
    t = np.linspace(0.0, rng.choice([1.0, 5.0, 40.0]), int(rng.choice([4, 33])))
    u = rng.normal(size=t.size) * (np.arange(t.size) > t.size // 3)
    order = rng.permutation(n)
    a, inputs, initial = chain[np.ix_(order, order)], b[order], start[order]
    if kind == "step":
        found, signal = states_of(a, inputs, cp.Step(0.5, time=t[2]), t, initial), step(0.5, 0.0, t[2])
    else:
        found, signal = sampled_states(a, inputs, u[None], t, initial), polygon(t, u)
    exact = response(chain, b, np.eye(n), np.zeros((n, 1)), [signal], t, start)[1]
    for row, true in zip(found[np.argsort(order)], exact, strict=True):
        inside = np.logical_and.accumulate(np.isfinite(true))
        near = inside & (np.abs(true) < 1e300)
        biggest = np.maximum.accumulate(np.where(inside, np.abs(true), 0.0))
        between = 1e-13 * np.abs(start).max()  # what decays fast may have been large between two times
        assert np.all(np.abs(row[near] - true[near]) <= 1e-10 * biggest[near] + between + 1e-240)
        assert not row[true == 0.0].any()
        assert not np.isfinite(row[~inside]).any()
