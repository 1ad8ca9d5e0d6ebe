"""Comparisons over draws: the same bits wherever they run, failures recorded, interruptions survived."""

import importlib
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from ensemble_cases import LAGS, PLANS, TIMES, Elsewhere, exploding, lag, lag_response, run, same_bits

import ctrlplan as cp
from ctrlplan.simulation import compiled, prepared
from ctrlplan.studies.ensemble import LEVELS
from ctrlplan.symbolic import tracing as traced


def failing(error, low, high, nominal):
    """Lag that cannot be run with a parameter between two values."""

    def update(t, x, u, params):
        if low < params["tau"] < high:
            raise error
        return (u - x) / params["tau"]

    return lag(update, nominal)


# The same bits wherever they run


@pytest.mark.slow
def test_other_processes_find_the_same_bits(found):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
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
        gains = np.geomspace(0.5, 50.0, 60)
        alone = cp.sweep(cp.plants.integrator_lag_loop, gains, PLANS, TIMES, progress=False)
        shared = cp.sweep(cp.plants.integrator_lag_loop, gains, PLANS, TIMES, executor=client, progress=False)
        for plan, rows in alone.metrics.items():
            for name, row in rows.items():
                np.testing.assert_allclose(shared.metrics[plan][name], row, rtol=1e-14, atol=1e-14 * 100.0)
        ran = client.run(lambda: "ctrlplan" in __import__("sys").modules)
        assert list(ran.values()) == [True, True]  # both had some of it


@pytest.mark.slow
def test_failures_are_the_same_wherever_they_are_found(exploded):
    same_bits(exploded, run(exploding(), exploded.params, Elsewhere(), initial_state=[1.0]))


@pytest.mark.slow
def test_a_few_draws_are_shared_out_too():
    elsewhere = Elsewhere()
    run(lag(), {"tau": np.linspace(0.5, 1.5, 8)}, elsewhere)
    assert len(elsewhere.tasks) > 1


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_a_loop_is_built_once_for_all_plans_and_draws(counted, executor):
    run(lag(), cp.draws(6, tau=(0.5, 1.5)), executor and executor())
    # Without parameters, and with some: two forms of one block.
    assert counted == {"traced": 2, "compiled": 2, "prepared": 1}


@pytest.mark.slow
@pytest.mark.parametrize("executor", [None, Elsewhere])
def test_loops_are_built_once_a_plan(counted, executor):
    built = []

    def build(name, plan):
        built.append(name)
        return lag()

    run(build, cp.draws(6, tau=(0.5, 1.5)), executor and executor())
    assert built == ["step", "ramp"]
    # Nominal runs of equal loops share a form; the draws of each plan have one.
    assert counted == {"traced": 3, "compiled": 3, "prepared": 2}


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_draw_that_explodes_is_recorded_and_the_others_stand(exploded):
    assert [(f.draw, f.params) for f in exploded.failures] == [(2, {"k": 0.5})]
    k = np.array([0.01, 0.05, 0.09])
    curves = 1 / (1 - k[:, None] * TIMES)
    np.testing.assert_allclose(exploded.bands["step"]["y"], np.quantile(curves, LEVELS, axis=0), rtol=1e-6)
    assert np.isnan(exploded.metrics["step"]["iae"]).tolist() == [False, False, True, False]


@pytest.mark.slow
def test_the_message_of_a_draw_that_explodes_says_where(exploded):
    assert exploded.failures[0].message.startswith("SolverError: the solver must reach 10 s, got to 2 s")


def test_the_first_draw_may_fail_as_any_other():
    tau = np.array([1.0, 0.5, 2.0])
    result = run(failing(ValueError("no such lag"), 0.9, 1.1, nominal=0.4), {"tau": tau})
    assert [(f.draw, f.message) for f in result.failures] == [(0, "ValueError: no such lag")]
    np.testing.assert_allclose(result.metrics["step"]["settling_time"][1:], np.log(50) * tau[1:], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("low", [0.1, 1.9], ids=["least", "greatest"])
def test_the_least_and_greatest_draws_may_fail_as_any_other(low):
    tau = np.array([1.0, 0.5, 2.0, 1.2])
    result = run(failing(ValueError("no such lag"), low, low + 0.5, nominal=1.0), {"tau": tau})
    assert [f.message for f in result.failures] == ["ValueError: no such lag"]
    assert np.isfinite(result.metrics["step"]["iae"]).sum() == 3


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("tau", [[1.0, 2.0, 4.0, 6.0], [6.0, 4.0, 2.0, 1.0]], ids=["up", "down"])
def test_a_parameter_that_counts_only_beyond_a_limit_is_run_too(tau):
    def update(t, x, u, params):
        return (u - x) / max(params["tau"], 3.0)

    result = run(lag(update), {"tau": tau})
    assert result.failures == ()
    expected = [lag_response([max(value, 3.0)], TIMES)["step"][0, -1] for value in tau]
    ends = np.quantile(expected, LEVELS)
    np.testing.assert_allclose(result.bands["step"]["y"][:, -1], ends, atol=1e-7)


@pytest.mark.slow
def test_the_notes_tell_of_failures(exploded):
    assert list(exploded.notes())[:3] == [
        "4 draws: k 0.01 to 0.5. The responses below are those of the nominal loop.",
        f"1 of 4 draws failed. The first, with k = 0.5: {exploded.failures[0].message}",
        "Failed draws are excluded from bands and quantiles.",
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


@pytest.mark.slow
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
    assert f"The run was interrupted; {21 - n} draws were not run." in result.notes()
    assert result.failures == ()


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_an_interruption_before_anything_was_found_leaves_the_nominal_run(tmp_path):
    result = run(lag(), LAGS, Interrupted(0))
    assert result.finished == 0
    assert result.nominal.metrics["step"]["settling_time"] == pytest.approx(math.log(50), rel=1e-5)
    json.dumps(result.results(), allow_nan=False)
    assert result.report(tmp_path).exists()


@pytest.mark.parametrize("measures", [None, ["iae"]])
@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_metrics_without_a_finished_draw_are_nan(measures):
    calls = []

    def build(tau=1.0):
        calls.append(tau)
        if len(calls) > 1:  # the nominal loop is first
            raise KeyboardInterrupt
        return cp.plants.integrator_lag_loop(tau)

    found = cp.monte_carlo(build, {"tau": [1.0, 2.0, 3.0]}, PLANS, TIMES, progress=False, measures=measures)
    assert found.interrupted
    assert found.finished == 0
    assert list(found.metrics) == list(PLANS)
    for plan, rows in found.metrics.items():
        assert list(rows) == list(found.nominal.metrics[plan])
        assert "iae" in rows
        assert all(row.shape == (3,) and np.isnan(row).all() for row in rows.values())
    assert np.isnan(found.quantiles("iae")["step"]).all()
    assert np.isnan(found.best("iae")["step"])


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
    known = module._run
    done = []

    def one(*arguments):
        done.append(arguments)
        if len(done) == len(PLANS) * (k + 2) + 1:  # two before all draws
            raise KeyboardInterrupt
        return known(*arguments)

    monkeypatch.setattr(module, "_run", one)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
def test_an_interruption_in_this_process_keeps_what_was_found(monkeypatch, found):
    interrupt_in_draw(monkeypatch, 15)
    result = run(lag(), LAGS)
    n = result.finished
    assert 0 < n <= 15
    np.testing.assert_array_equal(result.metrics["ramp"]["iae"][:n], found.metrics["ramp"]["iae"][:n])
    assert np.isnan(result.metrics["ramp"]["iae"][n:]).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:monte_carlo was interrupted:UserWarning")
@pytest.mark.parametrize("k", [15, 7])
def test_an_interruption_in_this_process_loses_no_draw(monkeypatch, k):
    interrupt_in_draw(monkeypatch, k)
    assert run(lag(), LAGS).finished == k


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
