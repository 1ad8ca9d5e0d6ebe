"""Comparisons over draws: arguments that are rejected, parameters and loops of every kind."""

import math
import pickle
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from ensemble_cases import LAGS, PLANS, TIMES, Elsewhere, block, lag, lag_response, run, same_bits

import ctrlplan as cp
from ctrlplan.studies.ensemble import LEVELS


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


# What is refused


@pytest.mark.parametrize(
    "params",
    [{}, {"tau": []}, {"tau": [[1.0, 2.0]]}, {"tau": [1.0, 2.0], "other": [1.0]}, {"tau": [1.0, 2.0], "other": 1.0}],
)
def test_there_are_as_many_draws_of_each_parameter(params):
    said = "draws must have equally many values of each parameter, at least one, got shapes"
    with pytest.raises(ValueError, match=said):
        run(lag(), params)


@pytest.mark.parametrize("params", [[1.0, 2.0], "tau", None])
def test_draws_are_a_mapping(params):
    with pytest.raises(TypeError, match=r"draws must be a mapping of names to values, .* got "):
        run(lag(), params)


@pytest.mark.parametrize("build", [lag(), lambda **values: lag()])
@pytest.mark.parametrize("name", [1, None, ("tau",)])
def test_names_of_draws_are_text(build, name):
    with pytest.raises(TypeError, match=r"draws must have names of parameters as keys, got "):
        run(build, {name: [1.0, 2.0]})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_draws_are_finite(value):
    with pytest.raises(ValueError, match=r"draws must be finite, got draws\['tau'\]\[1\] = (nan|inf|-inf)$"):
        run(lag(), {"tau": [1.0, value]})


@pytest.mark.parametrize("loop", [lag, lag_by_python])
def test_a_parameter_that_no_block_reads_is_refused(loop):
    with pytest.raises(ValueError, match="draws must be of parameters of a block, got 'tua', which no block reads"):
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
        "draws must be of parameters of a block, got 'gain', which no block reads; .* is linear, with constant "
        "matrices; give a function of gain that returns a loop in its place"
    )
    with pytest.raises(ValueError, match=said):
        run(loop, {"gain": [1.0, 2.0]})


@pytest.mark.parametrize("build", [lambda gain: None, lambda mass, friction: None, cp.plants.integrator_lag_loop])
def test_a_function_of_the_parameters_is_not_taken_for_one_of_a_plan(build):
    table = {"gain": [1.0, 2.0], "mass": [1.0, 2.0], "friction": [1.0, 2.0]}
    said = "loop must be a control system whose blocks read the parameters, a function whose arguments have the names"
    with pytest.raises(ValueError, match=said):
        run(build, table)


def of_others(k, b=1.0):
    return cp.plants.integrator_lag_loop(k * b)


def of_any_positions(*arguments):
    return cp.plants.integrator_lag_loop(3.0)


@pytest.mark.parametrize(
    ("build", "arguments"), [(of_others, "k, b"), (of_any_positions, "arguments"), (lambda a=1, b=2: None, "a, b")]
)
def test_a_function_of_other_arguments_is_rejected(build, arguments):
    said = rf"of the draws \(q\), or a function of a plan's name and the plan, got .* with the arguments {arguments}$"
    with pytest.raises(ValueError, match=said):
        run(build, {"q": [1.0, 2.0]})


@pytest.mark.parametrize("build", [lambda a, b: lag(), lambda n, p, /: lag(), lambda a, b, tau=1.0, *more: lag()])
def test_a_function_of_a_plan_may_have_arguments_of_any_name(build):
    result = run(build, {"tau": [0.5, 1.0]})
    np.testing.assert_allclose(result.metrics["step"]["settling_time"], np.log(50) * np.array([0.5, 1.0]), rtol=1e-5)


def test_a_function_that_returns_no_loop_for_a_draw_is_the_failure_of_this_draw():
    result = run(lambda tau: None if tau == 2.0 else lag(tau=tau), {"tau": [1.0, 2.0, 3.0]})
    said = "TypeError: loop must return a control system, got None"
    assert [(one.draw, one.message) for one in result.failures] == [(1, said)]


@pytest.mark.parametrize("loop", [lambda name, plan: None, lambda name, plan: [lag()]])
def test_a_function_of_a_plan_that_returns_no_loop(loop):
    got = type(loop("", None)).__name__.removesuffix("Type")
    with pytest.raises(TypeError, match=f"^loop must return a control system, got {got}$"):
        run(loop, {"tau": [1.0, 2.0]})
    with pytest.raises(TypeError, match=f"^loop must return a control system, got {got}$"):
        cp.compare(loop, {"step": cp.Step(1.0)}, TIMES)


def test_draws_are_no_truth_values():
    for values in ([True, False], np.array([True, False])):
        with pytest.raises(TypeError, match=r"draws\['tau'\] must be numbers, got truth values"):
            run(lag(), {"tau": values})


@pytest.mark.parametrize(
    "build",
    [lambda **values: lag(**values), lambda tau, **values: lag(tau=tau), lambda *rest, **values: lag(*rest, **values)],
)
def test_a_function_of_any_keyword_takes_the_draws(build):
    result = run(build, {"tau": [0.5, 1.0]})
    np.testing.assert_allclose(result.metrics["step"]["settling_time"], np.log(50) * np.array([0.5, 1.0]), rtol=1e-5)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
    with pytest.raises(ValueError, match="loop must have inputs for the plans, got none"):
        run(loop, {"tau": [0.5, 1.0]})


# Loops that cannot be compiled


@pytest.mark.slow
def test_a_loop_that_only_python_runs_is_run_in_this_process(found):
    result = run(lag_by_python(), {"tau": LAGS["tau"][:4]})
    assert result.failures == ()
    for plan, rows in result.metrics.items():
        for name, row in rows.items():
            np.testing.assert_allclose(row, found.metrics[plan][name][:4], rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_a_loop_that_only_python_runs_can_not_be_sent():
    with pytest.raises(
        ValueError, match="the loop must be picklable for other processes, got lag must be linear or compiled"
    ):
        run(lag_by_python(), {"tau": [0.5, 1.0]}, Elsewhere())


@pytest.mark.slow
def test_a_function_that_cannot_be_pickled_can_not_be_sent():
    with pytest.raises(
        ValueError, match=r"the loop must be picklable for other processes, got .* move the builder into a module"
    ):
        run(lambda name, plan: lag_by_python(), {"tau": [0.5, 1.0]}, Elsewhere())


@pytest.mark.slow
def test_a_loop_is_not_taken_for_a_function_that_builds_it():
    loop = ct.nlsys(_lag_rate, _lag_out, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag")
    pickle.dumps(loop)
    with pytest.raises(
        ValueError, match=r"the loop must be picklable for other processes, got .* move the builder into a module"
    ):
        run(loop, {"tau": [0.5, 1.0]}, Elsewhere())


@pytest.mark.slow
@pytest.mark.parametrize("build", [lag_by_python_anew, lag_after_delay, discrete_lag])
def test_a_function_that_builds_the_loop_is_sent_in_its_place(build):
    drawn = {"gain" if build is discrete_lag else "tau": np.linspace(0.5, 1.0, 5)}
    here = run(build, drawn, times=TIMES[::5])
    assert here.failures == ()
    same_bits(here, run(build, drawn, Elsewhere(), times=TIMES[::5]))


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
