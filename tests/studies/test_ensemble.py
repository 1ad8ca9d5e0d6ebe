"""Comparisons over draws: against closed forms and a crane by hand, and what they can be turned into."""

import json
import math
import warnings

import control as ct
import numpy as np
import pytest
from ensemble_cases import LAGS, PLANS, TIMES, block, lag, lag_response, run
from scipy import stats
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.studies.ensemble import LEVELS

# Draws


def test_draws_repeat_with_their_seed():
    one, other = (cp.draws(50, seed=7, a=(0, 1), b=stats.norm(2, 3)) for _ in range(2))
    assert list(one) == ["a", "b"]
    for name in one:
        assert one[name].shape == (50,)
        assert one[name].dtype == float
        np.testing.assert_array_equal(one[name], other[name])
    assert not np.array_equal(one["a"], cp.draws(50, seed=8, a=(0, 1))["a"])
    np.testing.assert_array_equal(cp.draws(5, a=(0, 1))["a"], cp.draws(5, seed=0, a=(0, 1))["a"])


def test_each_parameter_has_a_stream_of_its_own():
    alone = cp.draws(20, seed=1, mass=(0, 1))["mass"]
    beside = cp.draws(20, seed=1, aa=stats.uniform(), mass=(0, 1), z=(0, 1))
    np.testing.assert_array_equal(alone, beside["mass"])
    streams = [alone, beside["aa"], beside["z"]]
    assert len(np.unique(np.concatenate(streams))) == 60


@pytest.mark.parametrize(
    ("distribution", "law"),
    [
        ((2.0, 5.0), stats.uniform(2, 3)),
        ([2, 5], stats.uniform(2, 3)),
        (np.array([-1.0, 0.0]), stats.uniform(-1, 1)),
        (stats.norm(10, 2), stats.norm(10, 2)),
        (stats.truncnorm(-1, 1, loc=3), stats.truncnorm(-1, 1, loc=3)),
    ],
)
def test_draws_are_distributed_as_asked(distribution, law):
    values = cp.draws(2000, seed=5, it=distribution)["it"]
    assert stats.kstest(values, law.cdf).pvalue > 1e-3


def test_whole_numbers_are_drawn_as_numbers():
    values = cp.draws(30, n=stats.randint(1, 4))["n"]
    assert values.dtype == float
    assert set(values) == {1.0, 2.0, 3.0}


def test_a_range_of_one_value_is_that_value():
    np.testing.assert_array_equal(cp.draws(3, a=(2.0, 2.0))["a"], [2.0] * 3)


@pytest.mark.parametrize("count", [0, -1, True, 2.0, "3", None])
def test_the_count_is_a_whole_number_from_1(count):
    with pytest.raises(ValueError, match="count must be an integer of at least 1, got"):
        cp.draws(count, a=(0, 1))


@pytest.mark.parametrize(
    "ends", [(2, 1), (math.nan, 1), (0, math.nan), (0, math.inf), (-math.inf, math.inf), (-math.inf, 0)]
)
def test_low_is_not_above_high_and_both_are_finite(ends):
    with pytest.raises(ValueError, match="mass must have finite limits low <= high, got"):
        cp.draws(3, mass=ends)


@pytest.mark.parametrize("what", [3.0, (1, 2, 3), "ab", None, lambda: 1.0])
def test_what_is_no_distribution_is_refused(what):
    with pytest.raises(TypeError, match=r"mass must be \(low, high\) or a distribution of scipy.stats, got"):
        cp.draws(3, mass=what)


# Against closed forms


@pytest.mark.slow
def test_metrics_are_those_of_the_closed_form(found):
    tau, end = LAGS["tau"], TIMES[-1]
    assert found.ndraws == found.finished == 21
    assert found.failures == ()
    np.testing.assert_array_equal(found.params["tau"], tau)
    step, ramp = found.metrics["step"], found.metrics["ramp"]
    np.testing.assert_allclose(step["settling_time"], tau * math.log(50), rtol=1e-5)
    np.testing.assert_allclose(step["iae_final"], tau * (1 - np.exp(-end / tau)), rtol=1e-5)
    np.testing.assert_allclose(step["ise_final"], tau / 2 * (1 - np.exp(-2 * end / tau)), rtol=1e-5)
    # The ramp's error grows to tau (1 - exp(-1/tau)) at its end, and its area is tau y(end).
    greatest = tau * (1 - np.exp(-1 / tau))
    np.testing.assert_allclose(ramp["lag_error"], 100 * greatest, rtol=1e-5)
    np.testing.assert_allclose(ramp["iae"], tau * (1 - greatest * np.exp(-(end - 1) / tau)), rtol=1e-5)
    np.testing.assert_allclose(ramp["settling_time"], 1 + tau * np.log(50 * greatest), rtol=1e-5)


@pytest.mark.slow
def test_bands_are_quantiles_of_the_closed_form(found):
    assert found.levels == LEVELS == (0.05, 0.25, 0.5, 0.75, 0.95)
    np.testing.assert_array_equal(found.timepts, TIMES)
    for plan, curves in lag_response(LAGS["tau"], TIMES).items():
        assert list(found.bands[plan]) == ["y"]
        np.testing.assert_allclose(found.bands[plan]["y"], np.quantile(curves, LEVELS, axis=0), atol=1e-7)


def test_quantiles_of_a_metric_are_values_that_were_drawn(found):
    tau = np.sort(LAGS["tau"])
    for plan, middle in found.quantiles("settling_time").items():
        assert np.isin(middle, found.metrics[plan]["settling_time"]).all()
    # Of 21 values in order, the smallest at or below which the share lies.
    ranks = [math.ceil(21 * level) - 1 for level in LEVELS]
    np.testing.assert_allclose(found.quantiles("settling_time")["step"], tau[ranks] * math.log(50), rtol=1e-5)


def test_a_metric_that_is_infinite_in_some_draws_has_quantiles():
    slow = run(lag(), {"tau": [0.5, 1.0, 20.0]})
    times = slow.quantiles("settling_time")["step"]
    np.testing.assert_allclose(times[:3], [0.5 * math.log(50)] * 2 + [math.log(50)], rtol=1e-5)
    assert times[3:].tolist() == [math.inf] * 2


@pytest.mark.slow
def test_two_parameters_are_drawn_together():
    """m x'' + c x' + k x = k r: an oscillator, with its overshoot and its response to the step."""
    drawn = cp.draws(25, seed=2, mass=stats.uniform(0.5, 1.0), damping=(0.4, 1.2))

    def update(t, x, u, params):
        return np.array([x[1], (4.0 * (u[0] - x[0]) - params["damping"] * x[1]) / params["mass"]])

    def out(t, x, u, params):
        return np.array([x[0], 4.0 * (u[0] - x[0])])

    own = {"mass": 1.0, "damping": 0.5}
    spring = block(update, own, out, nstates=2, outputs=["y", "u"], name="spring")
    result = run(spring, drawn, plans={"step": cp.Step(1.0)})
    decay = drawn["damping"] / (2 * drawn["mass"])
    turning = np.sqrt(4.0 / drawn["mass"] - decay**2)
    np.testing.assert_allclose(
        result.metrics["step"]["overshoot_final"], 100 * np.exp(-math.pi * decay / turning), rtol=1e-5
    )
    np.testing.assert_allclose(result.metrics["step"]["control_peak"], 4.0, rtol=1e-7)
    a, w = decay[:, None], turning[:, None]
    y = 1 - np.exp(-a * TIMES) * (np.cos(w * TIMES) + a / w * np.sin(w * TIMES))
    assert list(result.bands["step"]) == ["y", "u"]
    np.testing.assert_allclose(result.bands["step"]["y"], np.quantile(y, LEVELS, axis=0), atol=1e-6)
    np.testing.assert_allclose(result.bands["step"]["u"], np.quantile(4 - 4 * y, LEVELS, axis=0), atol=4e-6)


def test_each_draw_is_a_comparison_of_its_own(found):
    for k in (0, 7, 20):
        alone = cp.compare(lag(), PLANS, TIMES, params={"tau": LAGS["tau"][k]}).metrics
        for plan, rows in alone.items():
            assert set(rows) == set(found.metrics[plan])
            np.testing.assert_allclose([found.metrics[plan][name][k] for name in rows], list(rows.values()), rtol=1e-9)


def test_the_nominal_run_has_the_loops_own_parameters(found):
    alone = cp.compare(lag(), PLANS, TIMES)
    assert found.nominal.metrics == alone.metrics
    np.testing.assert_array_equal(found.nominal.responses["ramp"].outputs, alone.responses["ramp"].outputs)


@pytest.mark.slow
def test_order_and_company_of_draws_change_no_bit(found):
    order = np.random.default_rng(0).permutation(21)[:12]
    mixed = run(lag(), {"tau": LAGS["tau"][order]})
    for plan, rows in mixed.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(row, found.metrics[plan][name][order])


def test_one_draw_is_an_ensemble_too():
    single = run(lag(), {"tau": 2.0})
    assert single.ndraws == 1
    for plan, (curve,) in lag_response([2.0], TIMES).items():
        np.testing.assert_allclose(single.bands[plan]["y"], np.tile(curve, (5, 1)), atol=1e-7)


@pytest.mark.slow
def test_bands_of_a_long_run_are_kept_at_some_of_its_times():
    times = np.linspace(0.0, 10.0, 3456)
    long = run(lag(), {"tau": [0.5, 1.0, 2.0]}, times=times)
    assert long.timepts.size <= 1001
    assert long.timepts[[0, -1]].tolist() == [0.0, 10.0]
    assert np.isin(long.timepts, times).all()
    curves = lag_response([0.5, 1.0, 2.0], long.timepts)["step"]
    np.testing.assert_allclose(long.bands["step"]["y"], np.quantile(curves, LEVELS, axis=0), atol=1e-7)


def test_options_reach_each_draw():
    result = run(lag(), {"tau": [0.5, 1.0]}, band=0.05, measures=["settling_time"], units={"y": "m"})
    assert result.nominal.units == {"y": "m"}
    assert list(result.metrics["step"]) == ["settling_time"]
    np.testing.assert_allclose(result.metrics["step"]["settling_time"], np.log(20) * np.array([0.5, 1.0]), rtol=1e-5)


@pytest.mark.slow
def test_waypoints_stand_for_the_standard_plans_even_from_a_generator():
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    result = run(lag(), {"tau": [0.5, 1.0]}, plans=(w for w in move))
    plans = {"step", "polynomial", "trigonometric", "piecewise"}
    assert set(result.metrics) == set(result.bands) == set(result.nominal.plans) == plans
    expected = cp.compare(lag(), move, TIMES, params={"tau": 0.5}).metrics["trigonometric"]["ise"]
    assert result.metrics["trigonometric"]["ise"][0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_waypoints_are_measured_against_as_in_a_comparison():
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    result = run(lag(), {"tau": [0.5, 1.0]}, plans=move)
    alone = cp.compare(lag(), move, TIMES)
    assert set(result.nominal.metrics["polynomial"]) == set(alone.metrics["polynomial"])
    assert result.nominal.waypoints == alone.waypoints


@pytest.mark.slow
def test_runs_that_an_event_ends_count_as_far_as_they_go():
    """The fast one stays below 0.9 no longer than tau ln 10; the slow ones to the end."""
    stop = [cp.Event("y", high=0.9, stop=True)]
    times = np.linspace(0.0, 2.0, 201)
    tau = np.array([0.5, 1.0, 2.0, 4.0])
    result = run(lag(), {"tau": tau}, plans={"step": cp.Step(1.0)}, times=times, events=stop)
    curves = lag_response(tau, times)["step"]
    after = times > 0.5 * math.log(10) + 0.02
    np.testing.assert_allclose(
        result.bands["step"]["y"][:, after], np.quantile(curves[1:, after], LEVELS, axis=0), atol=1e-7
    )
    before = times < 0.5 * math.log(10) - 0.02
    np.testing.assert_allclose(
        result.bands["step"]["y"][:, before], np.quantile(curves[:, before], LEVELS, axis=0), atol=1e-7
    )


@pytest.mark.slow
def test_the_last_value_before_an_event_stands_at_no_other_time():
    stop = [cp.Event("y", high=0.9, stop=True)]
    times = np.linspace(0.0, 2.0, 21)
    result = run(lag(), {"tau": [0.5, 4.0]}, plans={"step": cp.Step(1.0)}, times=times, events=stop)
    after = times > 0.5 * math.log(10)
    only = lag_response([4.0], times)["step"][:, after]
    np.testing.assert_allclose(result.bands["step"]["y"][:, after], np.tile(only, (5, 1)), atol=1e-7)


def test_bands_are_undefined_where_every_draw_has_ended():
    stop = [cp.Event("y", high=0.5, stop=True)]
    result = run(lag(), {"tau": [0.5, 1.0]}, events=stop)
    after = math.log(2) + 0.02 < TIMES
    for plan in ("step", "ramp"):
        band = result.bands[plan]["y"]
        assert np.isnan(band[:, TIMES > 3.0]).all()
    assert np.isnan(result.bands["step"]["y"][:, after]).all()


# Against a right-hand side written by hand

CRANE = {"load_mass": [350.0, 500.0, 800.0], "trolley_friction": [20.0, 300.0, 60.0]}


def crane_rate(plan, mass, friction):
    """Crane of crane_oracle.py under two PIDs on D and R, which know of a load of 500 kg and a friction of 20 N s/m."""
    trolley, inertia, b, drum, g, w, tf = 5000.0, 50.0, 0.25, 20.0, 9.81, 5.0, 0.02

    def pid(own, damping, error, state, bias):
        kp, ki, kd = 3 * own * w**2, own * w**3, 3 * own * w - damping
        lag_rate = (error - state[1]) / tf
        return bias + kp * error + state[0] + kd * lag_rate, [ki * error, lag_rate]

    def rate(t, y):
        d, r, th, d1, r1, th1 = y[4:]
        s, c = math.sin(th), math.cos(th)
        x_ref, z_ref = plan(min(t, plan.end))
        force, moved = pid(trolley, 20.0, x_ref - b - d, y[:2], 0.0)
        torque, wound = pid(inertia / b + 500.0 * b, drum / b, z_ref - r, y[2:4], -b * 500.0 * g)
        matrix = [[s, 1, -b, 1 / mass], [c, 0, r, 0], [trolley, 0, 0, -s], [0, inertia / b, 0, -b]]
        right = [
            g * c + r * th1**2,
            -g * s - 2 * r1 * th1 + b * th1**2,
            force - friction * d1,
            torque - drum * r1 / b,
        ]
        return [*moved, *wound, d1, r1, th1, *np.linalg.solve(matrix, right)[:3]]

    return rate


@pytest.mark.slow
def test_draws_of_the_crane_are_the_hand_written_right_hand_side():
    rest = [0.0, 0.0]
    points = [cp.Waypoint.from_jets(0, x=[0.0, *rest], z=[10.0, *rest])]
    points += [cp.Waypoint.from_jets(3, x=[2.0, *rest], z=[9.0, *rest])]
    plan = cp.PolySpline(points)
    times = np.linspace(0, 4, 81)
    result = run(
        lambda name, plan: cp.plants.crane_loop(cp.plants.Crane(), plan, "setpoint"),
        CRANE,
        plans={"planned": plan},
        times=times,
        controls=["theta", "D", "R"],
    )
    assert result.failures == ()
    curves = {name: [] for name in ("x", "z", "theta", "D", "R")}
    start = cp.plants.crane_loop(cp.plants.Crane(), plan, "setpoint").initial_state
    for mass, friction in zip(*CRANE.values(), strict=True):
        rate = crane_rate(plan, mass, friction)
        before, after = times <= 3.0, times >= 3.0
        early = solve_ivp(rate, (0, 3), start, "LSODA", times[before], rtol=1e-10, atol=1e-11)
        late = solve_ivp(rate, (3, 4), early.y[:, -1], "LSODA", times[after], rtol=1e-10, atol=1e-11)
        assert early.success
        assert late.success
        d, r, th = np.hstack([early.y, late.y[:, 1:]])[4:7]
        s, c = np.sin(th), np.cos(th)
        states = {"x": r * s + d + 0.25 * c, "z": r * c - 0.25 * s, "theta": th, "D": d, "R": r}
        for name, row in states.items():
            curves[name].append(row)
    assert np.ptp(curves["theta"], axis=0).max() > 1e-4  # the draws do differ
    for name, rows in curves.items():
        np.testing.assert_allclose(
            result.bands["planned"][name], np.quantile(rows, LEVELS, axis=0), rtol=1e-6, atol=1e-7
        )
    peaks = np.abs(np.stack([curves[name] for name in ("theta", "D", "R")])).max(axis=2)
    for name, row in zip(("theta", "D", "R"), peaks, strict=True):
        np.testing.assert_allclose(result.metrics["planned"][f"control_peak_{name}"], row, rtol=2e-3)
    # Both loops rest on integrals: the last values say how well the metrics are those of these curves.
    misses = np.abs(plan(times)[0] - np.array(curves["x"]))
    areas = (0.5 * (misses[:, 1:] + misses[:, :-1]) * np.diff(times)).sum(axis=1)
    np.testing.assert_allclose(result.metrics["planned"]["iae_x"], areas, rtol=1e-2)


# What it can be turned into


@pytest.mark.slow
def test_results_are_plain_and_null_where_nothing_is_known(exploded):
    data = json.loads(json.dumps(exploded.results(), allow_nan=False))
    assert data["params"] == {"k": [0.01, 0.05, 0.5, 0.09]}
    assert data["finished"] == 4
    assert set(data["plans"]) == set(PLANS)
    row = exploded.metrics["ramp"]["iae"]
    assert data["plans"]["ramp"]["iae"] == [row[0], row[1], None, row[3]]
    assert data["plans"]["ramp"]["settling_time"] == [None] * 4  # it never settles
    assert data["failures"] == [{"draw": 2, "params": {"k": 0.5}, "message": exploded.failures[0].message, "plan": ""}]


def test_to_pandas_has_a_row_a_draw_and_a_column_a_parameter_or_metric(found):
    table = found.to_pandas()
    assert table.index.tolist() == list(range(21))
    assert table.index.name == "draw"
    assert table.columns.names == ["plan", "metric"]
    np.testing.assert_array_equal(table["params", "tau"], LAGS["tau"])
    for plan, rows in found.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(table[plan, name], row)
    assert table.shape == (21, 1 + sum(len(rows) for rows in found.metrics.values()))


def test_a_metric_may_be_known_of_one_plan_only():
    def last(run):
        return {"last": float(run.response.outputs[-1])} if run.plan is PLANS["step"] else {}

    result = run(lag(), {"tau": [0.5, 1.0, 2.0]}, measures=[cp.Measure("last", of="run", function=last)])
    np.testing.assert_allclose(result.quantiles("last")["step"][2], 1 - math.exp(-10), rtol=1e-6)


def test_bands_of_a_loop_that_diverges_in_some_draws_are_infinite():
    """y' = (r - y)/tau with the step: where tau = -1/400, -inf is reached within 2 s; no level is nan."""

    def build(rate):
        return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="lag")

    rates = np.array([1.0, -400.0, 2.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = cp.monte_carlo(build, {"rate": rates}, {"step": cp.Step(1.0)}, TIMES, progress=False)
    band, last = found.bands["step"]["y"], float(found.timepts[-1])
    assert not np.isnan(band).any()
    # Levels 0.05 and 0.25 are between the smallest value and the next one, level 0.5 is that one.
    assert band[:2, -1].tolist() == [-math.inf] * 2
    stable = 1.0 - np.exp(-np.array([1.0, 2.0]) * last)
    np.testing.assert_allclose(band[2:, -1], np.interp([0.0, 0.5, 0.9], [0.0, 1.0], stable), rtol=1e-9)
