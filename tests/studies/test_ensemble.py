"""Comparisons over draws: closed forms, the same bits wherever they run, failures recorded, interruptions survived."""

import importlib
import json
import math
import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import control as ct
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.simulation import compiled, prepared
from ctrlplan.studies.ensemble import LEVELS
from ctrlplan.symbolic import tracing as traced

TIMES = np.linspace(0.0, 10.0, 501)
PLANS = {"step": cp.Step(1.0), "ramp": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)])}
LAGS = cp.draws(21, seed=3, tau=(0.5, 1.5))


def block(update, params, out=None, nstates=1, **names):
    return ct.nlsys(
        update,
        out or (lambda t, x, u, params: x),
        states=nstates,
        inputs="r",
        outputs=names.pop("outputs", "y"),
        params=params,
        name=names.pop("name", "lag"),
    )


def lag(update=None, tau=1.0):
    return block(update or (lambda t, x, u, params: (u - x) / params["tau"]), {"tau": tau})


def lag_by_python(tau=1.0):
    """Same lag, asking its signals for numbers, which symbols do not have."""
    return lag(lambda t, x, u, params: (float(u[0]) - float(x[0])) / params["tau"], tau)


def lag_after_delay(name, plan):
    """Lag behind a delay of 0.5 s, which only the loop's own blocks can run; takes a plan and can be pickled."""
    late = cp.create_delay_iosystem(0.5, inputs="r", outputs="late")
    slow = ct.nlsys(_lag_rate, _lag_out, states=1, inputs="late", outputs="y", params={"tau": 1.0}, name="lag")
    return ct.interconnect([late, slow], inputs="r", outputs="y", name="loop")


def lag_by_python_anew(name, plan):
    return lag_by_python()


def discrete_lag(name="step", plan=None):
    """Of x[k+1] = x[k] + gain (r - x[k]), 50 times a second."""
    return ct.nlsys(_next, _lag_out, states=1, inputs="r", outputs="y", params={"gain": 0.1}, dt=0.02, name="digital")


def _next(t, x, u, params):
    return x + params["gain"] * (u - x)


def _lag_rate(t, x, u, params):
    return (float(u[0]) - float(x[0])) / params["tau"]


def _lag_out(t, x, u, params):
    return x


def failing(error, low, high, nominal):
    """Lag that cannot be run with a parameter between two values."""

    def update(t, x, u, params):
        if low < params["tau"] < high:
            raise error
        return (u - x) / params["tau"]

    return lag(update, nominal)


def exploding(k=0.01):
    """Its x' = k x^2 from 1 is 1/(1 - k t)."""
    return block(lambda t, x, u, params: params["k"] * x * x, {"k": k}, name="explosive")


def lag_response(tau, t):
    """Of tau y' = r - y to the step, and to the ramp that ends at 1 s."""
    tau = np.asarray(tau)[..., None]
    held = np.minimum(t, 1.0)
    step = 1.0 - np.exp(-t / tau)
    ramp = np.where(t <= 1.0, held - tau * (1.0 - np.exp(-held / tau)), 0.0)
    after = 1.0 - tau * (1.0 - np.exp(-1.0 / tau)) * np.exp(-(t - held) / tau)
    return {"step": step, "ramp": np.where(t <= 1.0, ramp, after)}


def run(loop, params, executor=None, plans=PLANS, times=TIMES, progress=False, **options):
    return cp.monte_carlo(loop, params, plans, times, executor=executor, progress=progress, **options)


def same_bits(one, other):
    assert one.finished == other.finished
    assert one.failures == other.failures
    for name in ("metrics", "bands"):
        left, right = getattr(one, name), getattr(other, name)
        assert list(left) == list(right)
        for plan, rows in left.items():
            assert list(rows) == list(right[plan])
            for key, row in rows.items():
                np.testing.assert_array_equal(row, right[plan][key])


class Elsewhere:
    """Nothing but submit and result; what goes in and comes out is pickled, as on its way to another process."""

    def __init__(self):
        self.tasks = []

    def submit(self, function, /, *arguments, **named):
        self.tasks.append(pickle.dumps((function, arguments, named)))
        return Answer(self, len(self.tasks) - 1)

    def answer(self, k):
        function, arguments, named = pickle.loads(self.tasks[k])
        return pickle.loads(pickle.dumps(function(*arguments, **named)))


class Answer:
    """Has nothing but a result."""

    def __init__(self, owner, k):
        self.owner, self.k = owner, k

    def result(self):
        return self.owner.answer(self.k)


@pytest.fixture(scope="module")
def found():
    return run(lag(), LAGS)


@pytest.fixture(scope="module")
def exploded():
    """Draws of which the third ends at 2 s."""
    return run(exploding(), {"k": [0.01, 0.05, 0.5, 0.09]}, initial_state=[1.0])


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
    with pytest.raises(ValueError, match="count must be a whole number from 1, got"):
        cp.draws(count, a=(0, 1))


@pytest.mark.parametrize(
    "ends", [(2, 1), (math.nan, 1), (0, math.nan), (0, math.inf), (-math.inf, math.inf), (-math.inf, 0)]
)
def test_low_is_not_above_high_and_both_are_finite(ends):
    with pytest.raises(ValueError, match="mass must be drawn from low to high, both finite, got"):
        cp.draws(3, mass=ends)


@pytest.mark.parametrize("what", [3.0, (1, 2, 3), "ab", None, lambda: 1.0])
def test_what_is_no_distribution_is_refused(what):
    with pytest.raises(TypeError, match=r"mass must be \(low, high\) or a distribution of scipy.stats, got"):
        cp.draws(3, mass=what)


# Against closed forms


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


def test_waypoints_stand_for_the_standard_plans_even_from_a_generator():
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    result = run(lag(), {"tau": [0.5, 1.0]}, plans=(w for w in move))
    plans = {"step", "polynomial", "trigonometric", "piecewise"}
    assert set(result.metrics) == set(result.bands) == set(result.nominal.plans) == plans
    expected = cp.compare(lag(), move, TIMES, params={"tau": 0.5}).metrics["trigonometric"]["ise"]
    assert result.metrics["trigonometric"]["ise"][0] == pytest.approx(expected, rel=1e-9)


def test_waypoints_are_measured_against_as_in_a_comparison():
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    result = run(lag(), {"tau": [0.5, 1.0]}, plans=move)
    alone = cp.compare(lag(), move, TIMES)
    assert set(result.nominal.metrics["polynomial"]) == set(alone.metrics["polynomial"])
    assert result.nominal.waypoints == alone.waypoints


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


# The same bits wherever they run


@pytest.mark.slow
def test_other_processes_find_the_same_bits(found):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        same_bits(found, run(lag(), LAGS, pool))


@pytest.mark.slow
def test_a_dask_cluster_finds_the_same_bits(found):
    distributed = pytest.importorskip("dask.distributed", reason="dask.distributed is not installed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        same_bits(found, run(lag(), LAGS, client.get_executor()))
        same_bits(found, run(lag(), LAGS, client))
        ran = client.run(lambda: "ctrlplan" in __import__("sys").modules)
        assert list(ran.values()) == [True, True]  # both had some of it


def test_failures_are_the_same_wherever_they_are_found(exploded):
    same_bits(exploded, run(exploding(), exploded.params, Elsewhere(), initial_state=[1.0]))


def test_a_few_draws_are_shared_out_too():
    elsewhere = Elsewhere()
    run(lag(), {"tau": np.linspace(0.5, 1.5, 8)}, elsewhere)
    assert len(elsewhere.tasks) > 1


def test_submit_and_result_will_do_and_every_task_is_handed_out_before_the_first_is_waited_for(found):
    class Waits(Elsewhere):
        """Counts the tasks it has when first asked."""

        waiting = None

        def answer(self, k):
            if self.waiting is None:
                self.waiting = len(self.tasks)
            return super().answer(k)

    elsewhere = Waits()
    same_bits(found, run(lag(), LAGS, elsewhere))
    assert elsewhere.waiting == len(elsewhere.tasks) > 1


# Built once


@pytest.fixture
def counted(monkeypatch):
    """How often blocks are traced, and forms made and compiled."""
    count = {"traced": 0, "compiled": 0, "prepared": 0}

    def counting(owner, name, key):
        known = getattr(owner, name)

        def counts(*arguments, **named):
            count[key] += 1
            return known(*arguments, **named)

        monkeypatch.setattr(owner, name, counts)

    counting(traced, "traced", "traced")
    counting(compiled.Compiled, "__init__", "compiled")
    counting(prepared.Prepared, "__init__", "prepared")
    return count


@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_a_loop_is_built_once_for_all_plans_and_draws(counted, executor):
    run(lag(), cp.draws(6, tau=(0.5, 1.5)), executor and executor())
    # Without parameters, and with some: two forms of one block.
    assert counted == {"traced": 2, "compiled": 2, "prepared": 1}


@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_loops_are_built_once_a_plan(counted, executor):
    built = []

    def build(name, plan):
        built.append(name)
        return lag()

    run(build, cp.draws(6, tau=(0.5, 1.5)), executor and executor())
    assert built == ["step", "ramp"]
    assert counted == {"traced": 4, "compiled": 4, "prepared": 2}


def test_blocks_are_called_no_more_for_more_draws():
    calls = []

    def update(t, x, u, params):
        calls.append(t)
        return (u - x) / params["tau"]

    counts = []
    for count in (2, 9):
        calls.clear()
        run(lag(update), {"tau": np.full(count, 0.75)})
        counts.append(len(calls))
    # What is called is called before the draws.
    assert counts[0] == counts[1]


# Draws that fail


def test_a_draw_that_fails_is_recorded_and_the_others_stand():
    tau = np.array([0.5, 0.6, 1.0, 1.5, 2.0])
    result = run(failing(ValueError("no such lag"), 0.9, 1.1, nominal=0.4), {"tau": tau})
    (failure,) = result.failures
    assert (failure.draw, failure.params, failure.message) == (2, {"tau": 1.0}, "ValueError: no such lag")
    assert result.finished == result.ndraws == 5
    others = np.array([0, 1, 3, 4])
    clean = run(lag(tau=0.4), {"tau": tau[others]})
    for plan, rows in clean.metrics.items():
        for name, row in rows.items():
            np.testing.assert_allclose(result.metrics[plan][name][others], row, rtol=1e-6, atol=1e-6)
            assert math.isnan(result.metrics[plan][name][2])
        np.testing.assert_allclose(result.bands[plan]["y"], clean.bands[plan]["y"], atol=1e-7)
    np.testing.assert_allclose(result.quantiles("settling_time")["step"], np.log(50) * tau[[0, 0, 1, 3, 4]], rtol=1e-5)


def test_a_draw_that_explodes_is_recorded_and_the_others_stand(exploded):
    assert [(f.draw, f.params) for f in exploded.failures] == [(2, {"k": 0.5})]
    k = np.array([0.01, 0.05, 0.09])
    curves = 1 / (1 - k[:, None] * TIMES)
    np.testing.assert_allclose(exploded.bands["step"]["y"], np.quantile(curves, LEVELS, axis=0), rtol=1e-6)
    assert np.isnan(exploded.metrics["step"]["iae"]).tolist() == [False, False, True, False]


def test_the_message_of_a_draw_that_explodes_says_where(exploded):
    assert exploded.failures[0].message.startswith("SolverError: the solver must reach 10 s, got to 2 s")


def test_the_first_draw_may_fail_as_any_other():
    tau = np.array([1.0, 0.5, 2.0])
    result = run(failing(ValueError("no such lag"), 0.9, 1.1, nominal=0.4), {"tau": tau})
    assert [(f.draw, f.message) for f in result.failures] == [(0, "ValueError: no such lag")]
    np.testing.assert_allclose(result.metrics["step"]["settling_time"][1:], np.log(50) * tau[1:], rtol=1e-5)


@pytest.mark.parametrize("low", [0.1, 1.9], ids=["least", "greatest"])
def test_the_least_and_greatest_draws_may_fail_as_any_other(low):
    tau = np.array([1.0, 0.5, 2.0, 1.2])
    result = run(failing(ValueError("no such lag"), low, low + 0.5, nominal=1.0), {"tau": tau})
    assert [f.message for f in result.failures] == ["ValueError: no such lag"]
    assert np.isfinite(result.metrics["step"]["iae"]).sum() == 3


@pytest.mark.parametrize("error", [IndexError("beyond"), KeyError("entry"), AssertionError("not so"), TypeError("it")])
def test_a_draw_may_fail_in_any_way(error):
    result = run(failing(error, 0.9, 1.1, nominal=0.4), {"tau": [0.5, 1.0, 2.0]})
    assert [f.draw for f in result.failures] == [1]
    assert type(error).__name__ in result.failures[0].message


def test_every_draw_may_fail():
    result = run(failing(ArithmeticError("none"), 0.5, 9.0, nominal=0.4), {"tau": [1.0, 1.0]})
    assert [f.draw for f in result.failures] == [0, 1]
    assert result.finished == 2
    assert all(np.isnan(row).all() for rows in result.metrics.values() for row in rows.values())
    json.dumps(result.results(), allow_nan=False)
    assert len(result.to_pandas()) == 2


@pytest.mark.parametrize("tau", [[1.0, 2.0, 4.0, 6.0], [6.0, 4.0, 2.0, 1.0]], ids=["up", "down"])
def test_a_parameter_that_counts_only_beyond_a_limit_is_run_too(tau):
    def update(t, x, u, params):
        return (u - x) / max(params["tau"], 3.0)

    result = run(lag(update), {"tau": tau})
    assert result.failures == ()
    expected = [lag_response([max(value, 3.0)], TIMES)["step"][0, -1] for value in tau]
    ends = np.quantile(expected, LEVELS)
    np.testing.assert_allclose(result.bands["step"]["y"][:, -1], ends, atol=1e-7)


def test_the_notes_tell_of_failures(exploded):
    assert list(exploded.notes())[:3] == [
        "4 draws of k 0.01 to 0.5; the responses below are those of the loop's own parameters.",
        f"1 draws failed; the first, with k = 0.5: {exploded.failures[0].message}",
        "A draw that failed is in no band and no quantile.",
    ]


# Interruptions


class Interrupted(Elsewhere):
    """Is interrupted while some task is waited for; its answers can be cancelled."""

    def __init__(self, at):
        super().__init__()
        self.at, self.cancelled = at, []

    def submit(self, function, /, *arguments, **named):
        answer = super().submit(function, *arguments, **named)
        answer.cancel = lambda: self.cancelled.append(answer.k)
        return answer

    def answer(self, k):
        if k == self.at:
            raise KeyboardInterrupt
        return super().answer(k)


@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_what_an_executor_found_before_an_interruption_is_kept(found):
    executor = Interrupted(1)
    result = run(lag(), LAGS, executor)
    assert 0 < result.finished < result.ndraws == 21
    assert {1, 2} <= set(executor.cancelled)
    n = result.finished
    for plan, rows in result.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(row[:n], found.metrics[plan][name][:n])
            assert np.isnan(row[n:]).all()
    curves = lag_response(LAGS["tau"][:n], TIMES)
    for plan in PLANS:
        np.testing.assert_allclose(result.bands[plan]["y"], np.quantile(curves[plan], LEVELS, axis=0), atol=1e-7)
    assert f"The run was interrupted: {21 - n} draws were not reached." in result.notes()
    assert result.failures == ()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_an_interruption_before_anything_was_found_leaves_the_nominal_run(tmp_path):
    result = run(lag(), LAGS, Interrupted(0))
    assert result.finished == 0
    assert result.nominal.metrics["step"]["settling_time"] == pytest.approx(math.log(50), rel=1e-5)
    json.dumps(result.results(), allow_nan=False)
    assert result.report(tmp_path).exists()


@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_answers_need_not_be_cancelled():
    class Ends(Elsewhere):
        def answer(self, k):
            if k:
                raise KeyboardInterrupt
            return super().answer(k)

    result = run(lag(), LAGS, Ends())
    assert 0 < result.finished < 21


def interrupt_in_draw(monkeypatch, k):
    """Interrupt the run of draw k in this process."""
    module = importlib.import_module("ctrlplan.studies.monte_carlo")
    known = module._of_forms
    done = []

    def one(*arguments):
        done.append(arguments)
        if len(done) == k + 3:  # two before all draws
            raise KeyboardInterrupt
        return known(*arguments)

    monkeypatch.setattr(module, "_of_forms", one)


@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_an_interruption_in_this_process_keeps_what_was_found(monkeypatch, found):
    interrupt_in_draw(monkeypatch, 15)
    result = run(lag(), LAGS)
    n = result.finished
    assert 0 < n <= 15
    np.testing.assert_array_equal(result.metrics["ramp"]["iae"][:n], found.metrics["ramp"]["iae"][:n])
    assert np.isnan(result.metrics["ramp"]["iae"][n:]).all()


@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
@pytest.mark.parametrize("k", [15, 7])
def test_an_interruption_in_this_process_loses_no_draw(monkeypatch, k):
    interrupt_in_draw(monkeypatch, k)
    assert run(lag(), LAGS).finished == k


# What is refused


@pytest.mark.parametrize(
    "params",
    [{}, {"tau": []}, {"tau": [[1.0, 2.0]]}, {"tau": [1.0, 2.0], "other": [1.0]}, {"tau": [1.0, 2.0], "other": 1.0}],
)
def test_there_are_as_many_draws_of_each_parameter(params):
    with pytest.raises(ValueError, match="draws must hold as many values of each parameter, at least one, got shapes"):
        run(lag(), params)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_draws_are_finite(value):
    with pytest.raises(ValueError, match=r"draws must be finite, got (nan|inf|-inf) of 'tau'"):
        run(lag(), {"tau": [1.0, value]})


@pytest.mark.parametrize("loop", [lag, lag_by_python])
def test_a_parameter_that_no_block_reads_is_refused(loop):
    with pytest.raises(ValueError, match="draws must be of parameters of a block, got 'tua', which none reads"):
        run(loop(), {"tau": [1.0, 2.0], "tua": [1.0, 2.0]})


@pytest.mark.parametrize(
    "loop",
    [
        cp.plants.integrator_lag_loop(5.0),
        ct.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]], inputs="r", outputs="y"),
        ct.tf([3.0], [1.0, 3.0], inputs="r", outputs="y"),
        lambda name, plan: cp.plants.unity_feedback_loop([1.0], [1.0, 1.0, 0.0], 4.0),
    ],
    ids=["interconnection", "state space", "transfer function", "builder"],
)
def test_a_linear_loop_has_no_parameters_and_the_error_says_what_has(loop):
    said = (
        "draws must be of parameters of a block, got 'gain', which none reads; .* is linear, and its matrices have no "
        "parameters: give a function of gain that returns a loop in its place"
    )
    with pytest.raises(ValueError, match=said):
        run(loop, {"gain": [1.0, 2.0]})


@pytest.mark.parametrize("build", [lambda gain: None, lambda mass, friction: None, cp.plants.integrator_lag_loop])
def test_a_function_of_the_parameters_is_not_taken_for_one_of_a_plan(build):
    table = {"gain": [1.0, 2.0], "mass": [1.0, 2.0], "friction": [1.0, 2.0]}
    said = "loop must be a control system whose blocks read the parameters, a function whose parameters are named as"
    with pytest.raises(ValueError, match=said):
        run(build, table)


def test_a_builder_may_have_further_arguments_named_as_the_parameters():
    result = run(lambda name, plan, tau=2.0: lag(tau=tau), {"tau": [0.5, 1.0]})
    np.testing.assert_allclose(result.metrics["step"]["settling_time"], np.log(50) * np.array([0.5, 1.0]), rtol=1e-5)
    assert result.nominal.metrics["step"]["settling_time"] == pytest.approx(2.0 * math.log(50), rel=1e-5)


@pytest.mark.parametrize("start", [None, 0.5])
def test_metrics_of_draws_count_from_the_start_that_a_comparison_takes(start):
    """The earliest start of a plan unless given: of both plans for both, though each draw runs plan by plan."""
    plans = {"step": cp.Step(1.0, time=2.0), "ramp": cp.PolySpline([cp.Waypoint(1, 0), cp.Waypoint(2, 1)])}
    result = run(lag(), {"tau": [0.5, 1.0]}, plans=plans, start=start, measures=["settling_time", "itae"])
    for k, tau in enumerate((0.5, 1.0)):
        alone = cp.compare(lag(), plans, TIMES, params={"tau": tau}, start=start, measures=["settling_time", "itae"])
        for plan, row in alone.metrics.items():
            np.testing.assert_allclose([result.metrics[plan][n][k] for n in row], list(row.values()), rtol=1e-9)
    since = 1.0 if start is None else start
    np.testing.assert_allclose(
        result.metrics["step"]["settling_time"], 2.0 - since + np.log(50) * np.array([0.5, 1.0]), rtol=1e-5
    )


@pytest.mark.parametrize("values", [["0.5", "1.0"], [0.5 + 0j], np.ma.masked_array([0.5, 1.0], [0, 1])])
def test_draws_are_plain_numbers(values):
    with pytest.raises(
        (TypeError, ValueError), match=r"draws\['tau'\] must (be real numbers|have no masked values), got"
    ):
        run(lag(), {"tau": values})


@pytest.mark.parametrize(
    "read",
    [
        lambda params: params.get("tau", 1.0),
        lambda params: params["tau"] if len(params) else 1.0,
        lambda params: {"tau": 1.0, **params}["tau"],
        lambda params: ({"tau": 1.0} | params)["tau"],
        lambda params: (lambda tau=1.0: tau)(**params),
        lambda params: dict(params).get("tau", 1.0),
    ],
)
def test_a_parameter_may_be_read_in_any_way_and_need_not_be_declared(read):
    loop = block(lambda t, x, u, params: (u - x) / read(params), {})
    result = run(loop, {"tau": [0.5, 1.0]}, plans={"step": cp.Step(1.0)})
    assert result.failures == ()
    np.testing.assert_allclose(result.metrics["step"]["settling_time"], np.log(50) * result.params["tau"], rtol=1e-5)


def test_a_parameter_may_be_read_where_the_loop_is_allowed_to_be():
    """The lag begins at 5, and refuses to be below 4."""

    def update(t, x, u, params):
        if float(x[0]) < 4.0:
            raise ValueError("too low")
        return (u - x) / params.get("tau", 1.0)

    result = run(block(update, {}), {"tau": [0.5, 1.0]}, plans={"step": cp.Step(6.0)}, initial_state=[5.0])
    expected = 6 - np.exp(-TIMES / 0.5)
    np.testing.assert_allclose(
        result.bands["step"]["y"][4], (6 - np.exp(-TIMES / 1.0)) * 0.05 + expected * 0.95, atol=1e-6
    )


@pytest.mark.parametrize("values", [[2.0], [2.0, 2.0]])
def test_a_parameter_of_equal_draws_is_looked_for_too(values):
    with pytest.raises(ValueError, match="draws must be of parameters of a block, got 'tua'"):
        run(lag(), {"tua": values})


def test_equal_draws_of_a_parameter_are_no_mistake():
    result = run(lag(), {"tau": [2.0, 2.0]})
    np.testing.assert_allclose(result.metrics["step"]["iae_final"], 2 * (1 - math.exp(-5)), rtol=1e-5)


def test_a_limit_far_away_is_a_parameter():
    """The rate of y' = clip(40 (100 - y), -limit, limit) is the limit until 40 (100 - y) falls below it."""

    def update(t, x, u, params):
        return np.clip(40.0 * (u - x), -params["limit"], params["limit"])

    loop = block(update, {"limit": 1000.0}, name="drive")
    result = run(loop, {"limit": [500.0, 1000.0, 2000.0]}, plans={"step": cp.Step(100.0)})
    np.testing.assert_allclose(result.bands["step"]["y"][2, TIMES <= 0.06], 1000.0 * TIMES[TIMES <= 0.06], rtol=1e-6)


def test_a_disturbance_that_comes_later_is_a_parameter():
    """Once d is added after 5 s, the lag settles at 1 + d."""

    def update(t, x, u, params):
        return u - x + params["d"] * np.where(t > 5.0, 1.0, 0.0)

    loop = block(update, {"d": 0.0}, name="disturbed")
    result = run(loop, {"d": [0.1, 0.2, 0.3]}, plans={"step": cp.Step(1.0)})
    expected = 1 - math.exp(-10) + np.quantile([0.1, 0.2, 0.3], LEVELS) * (1 - math.exp(-5))
    np.testing.assert_allclose(result.bands["step"]["y"][:, -1], expected, atol=1e-4)


def test_a_loop_without_inputs_is_refused_as_in_a_comparison():
    source = cp.create_source_iosystem(PLANS["ramp"])
    loop = ct.interconnect([source, lag()], [["lag.r", "plan.y"]], outlist=["lag.y"], outputs="y", name="loop")
    with pytest.raises(ValueError, match="loop must have inputs for the plans, got one without"):
        run(loop, {"tau": [0.5, 1.0]})


# Loops that cannot be compiled


def test_a_loop_that_only_python_runs_is_run_in_this_process(found):
    result = run(lag_by_python(), {"tau": LAGS["tau"][:4]})
    assert result.failures == ()
    for plan, rows in result.metrics.items():
        for name, row in rows.items():
            np.testing.assert_allclose(row, found.metrics[plan][name][:4], rtol=1e-4, atol=1e-6)


def test_a_loop_that_only_python_runs_can_not_be_sent():
    with pytest.raises(ValueError, match="the loop must go to other processes, but lag must be linear or compiled"):
        run(lag_by_python(), {"tau": [0.5, 1.0]}, Elsewhere())


def test_a_function_that_cannot_be_pickled_can_not_be_sent():
    with pytest.raises(ValueError, match=r"the loop must go to other processes, but .* give a function that builds it"):
        run(lambda name, plan: lag_by_python(), {"tau": [0.5, 1.0]}, Elsewhere())


def test_a_loop_is_not_taken_for_a_function_that_builds_it():
    loop = ct.nlsys(_lag_rate, _lag_out, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag")
    pickle.dumps(loop)
    with pytest.raises(ValueError, match=r"the loop must go to other processes, but .* give a function that builds it"):
        run(loop, {"tau": [0.5, 1.0]}, Elsewhere())


@pytest.mark.slow
@pytest.mark.parametrize("build", [lag_by_python_anew, lag_after_delay, discrete_lag])
def test_a_function_that_builds_the_loop_is_sent_in_its_place(build):
    drawn = {"gain" if build is discrete_lag else "tau": np.linspace(0.5, 1.0, 9)}
    here = run(build, drawn, times=TIMES[::5])
    assert here.failures == ()
    same_bits(here, run(build, drawn, Elsewhere(), times=TIMES[::5]))


def test_a_delay_delays_every_draw():
    result = run(lag_after_delay, {"tau": [0.5, 0.75, 1.0]}, plans={"step": cp.Step(1.0)})
    late = np.maximum(TIMES - 0.5, 0.0)
    expected = np.quantile(lag_response([0.5, 0.75, 1.0], late)["step"], LEVELS, axis=0)
    np.testing.assert_allclose(result.bands["step"]["y"], expected, atol=1e-6)


def test_a_discrete_loop_takes_parameters_too():
    gain = np.array([0.02, 0.05, 0.1])
    result = run(discrete_lag(), {"gain": gain}, plans={"step": cp.Step(1.0)})
    curves = 1 - (1 - gain[:, None]) ** np.arange(TIMES.size)
    np.testing.assert_allclose(result.bands["step"]["y"], np.quantile(curves, LEVELS, axis=0), atol=1e-12)


@pytest.mark.filterwarnings("ignore:block own .*run by control.input_output_response:UserWarning")  # it is
def test_a_loop_that_only_python_control_runs_takes_parameters_too():
    class Own(ct.NonlinearIOSystem):
        """Computes its rates in a way of its own."""

        def _rhs(self, t, x, u):
            return super()._rhs(t, x, u)

    loop = Own(_lag_rate, _lag_out, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="own")
    result = run(loop, {"tau": [0.5, 1.0]}, plans={"step": cp.Step(1.0)}, times=np.linspace(0, 10, 2001))
    np.testing.assert_allclose(result.metrics["step"]["iae_final"], [0.5, 1.0], rtol=1e-3)


def test_all_plans_are_measured_on_the_outputs_that_a_comparison_takes():
    """Those named like the axes of the first plan, though each draw runs plan by plan."""
    loop = block(
        lambda t, x, u, params: (u - x) / params["tau"],
        {"tau": 1.0},
        lambda t, x, u, params: np.array([u[0], x[0]]),
        outputs=["r_seen", "y"],
    )
    plans = {"step": cp.Step(1.0), "ramp": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)], labels=["height"])}
    result = run(loop, {"tau": [0.5, 2.0]}, plans=plans, measures=["iae_final"])
    for k, tau in enumerate((0.5, 2.0)):
        alone = cp.compare(loop, plans, TIMES, params={"tau": tau}, measures=["iae_final"]).metrics
        for plan, row in alone.items():
            assert result.metrics[plan]["iae_final"][k] == pytest.approx(row["iae_final"], rel=1e-9)


@pytest.mark.filterwarnings("ignore:block own .*run by control.input_output_response:UserWarning")
def test_draws_of_a_loop_that_only_python_control_runs_do_not_mix_in_threads():
    """It keeps the parameters of a run in the system, which all threads share."""

    class Own(ct.NonlinearIOSystem):
        def _rhs(self, t, x, u):
            return super()._rhs(t, x, u)

    loop = Own(_lag_rate, _lag_out, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="own")
    tau, times = np.linspace(0.5, 2.0, 12), np.linspace(0, 10, 401)
    alone = run(loop, {"tau": tau}, None, {"step": cp.Step(1.0)}, times, measures=["iae_final"])
    with ThreadPoolExecutor(4) as pool:
        same_bits(alone, run(loop, {"tau": tau}, pool, {"step": cp.Step(1.0)}, times, measures=["iae_final"]))


# The bar


@pytest.mark.slow
@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_progress_is_a_bar_on_stderr(executor, capsys):
    run(lag(), {"tau": np.linspace(0.5, 1.0, 24)}, executor and executor(), progress=True)
    said = capsys.readouterr()
    assert said.out == ""
    assert "draws" in said.err
    assert "/24" in said.err


def test_progress_is_shown_unless_it_is_declined(capsys):
    cp.monte_carlo(lag(), {"tau": [0.5, 1.0]}, PLANS, TIMES)
    assert "/2" in capsys.readouterr().err


@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_without_progress_nothing_is_said(executor, capfd):
    run(lag(), {"tau": [0.5, 1.0]}, executor and executor())
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


# What it can be turned into


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
