"""Comparisons over a parameter: the same numbers however they are computed."""

import json
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import MEASURES

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLANS = {"step": cp.Step(1.0), "planned": cp.TrigSpline(MOVE, alpha=1.0)}
TIMES = np.linspace(0.0, 20.0, 1001)
GAINS = [1.0, 5.0, 20.0]
BUILD = cp.plants.integrator_lag_loop


@pytest.fixture(scope="module")
def swept():
    return cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False)


def same(one, other):
    assert one.parameter == other.parameter
    np.testing.assert_array_equal(one.values, other.values)
    assert list(one.metrics) == list(other.metrics)
    for plan, rows in one.metrics.items():
        assert list(rows) == list(other.metrics[plan])
        for name, row in rows.items():
            np.testing.assert_allclose(row, other.metrics[plan][name], rtol=1e-12, atol=1e-12)


def test_each_value_is_a_comparison_of_its_own(swept):
    assert swept.values.tolist() == GAINS
    for i, gain in enumerate(GAINS):
        alone = cp.compare(BUILD(gain), PLANS, TIMES).metrics
        for plan, row in alone.items():
            np.testing.assert_array_equal([swept.metrics[plan][name][i] for name in row], list(row.values()))


def test_overshoot_of_the_step_follows_its_closed_form(swept):
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array(GAINS) - 0.25))
    np.testing.assert_allclose(swept.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_a_single_value_is_a_sweep_too(swept):
    alone = cp.sweep(BUILD, 5.0, PLANS, TIMES, progress=False)
    assert alone.values.shape == (1,)
    assert alone.metrics["planned"]["iae"][0] == swept.metrics["planned"]["iae"][1]


def test_waypoints_stand_for_the_standard_plans_even_from_a_generator():
    found = cp.sweep(BUILD, GAINS, (w for w in MOVE), TIMES, progress=False, only=["overshoot_error"])
    assert list(found.metrics) == ["step", "polynomial", "trigonometric", "piecewise"]
    # MATH.md, section 2.
    np.testing.assert_allclose(found.metrics["polynomial"]["overshoot_error"], [16.0148, 44.4532, 48.4222], rtol=1e-4)
    np.testing.assert_array_equal(
        found.metrics["piecewise"]["overshoot_error"].round(8), found.metrics["polynomial"]["overshoot_error"].round(8)
    )


def test_options_reach_each_comparison():
    found = cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False, only=["settling_time"], band=0.05, parameter="gain")
    assert found.parameter == "gain"
    assert list(found.metrics["step"]) == ["settling_time"]
    alone = cp.compare(BUILD(20.0), PLANS, TIMES, band=0.05)
    assert found.metrics["step"]["settling_time"][2] == alone.metrics["step"]["settling_time"]


@pytest.mark.parametrize("values", [[1.0, 1.0], [2.0, 1.0], [1.0, np.nan], [1.0, np.inf], [], [[1.0, 2.0]]])
def test_values_must_increase(values):
    with pytest.raises(ValueError, match="values must be finite and increase strictly, got"):
        cp.sweep(BUILD, values, PLANS, TIMES, progress=False)


def test_an_unstable_value_is_infinite_and_stops_nothing():
    found = cp.sweep(BUILD, [-1.0, 5.0], PLANS, TIMES, progress=False)
    for rows in found.metrics.values():
        assert rows["settling_time"][0] == np.inf
        assert np.isfinite(rows["settling_time"][1])


# The bar


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor])
def test_progress_is_a_bar_on_stderr(executor, capsys):
    if executor is None:
        cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=True, parameter="gain k")
    else:
        with executor(1) as pool:
            cp.sweep(BUILD, GAINS, PLANS, TIMES, pool, progress=True, parameter="gain k")
    said = capsys.readouterr()
    assert said.out == ""
    assert "gain k" in said.err
    assert "/3" in said.err


def test_progress_is_shown_unless_it_is_declined(capsys):
    cp.sweep(BUILD, GAINS[:1], PLANS, TIMES)
    assert "/1" in capsys.readouterr().err


def test_without_progress_nothing_is_said(capfd):
    cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False)
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


# Where it runs


def test_threads_find_the_same(swept):
    with ThreadPoolExecutor(2) as pool:
        same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, pool, progress=False))


def test_processes_find_the_same(swept):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, executor=pool, progress=False))


def test_any_object_with_submit_will_do(swept):
    class Later:
        """Runs nothing until it is asked, and then the last first."""

        def __init__(self):
            self.tasks = []

        def submit(self, function, /, *arguments, **named):
            task = Future()
            self.tasks.append((task, function, arguments, named))
            return Answer(self, task)

        def run(self):
            while self.tasks:
                task, function, arguments, named = self.tasks.pop()
                task.set_result(function(*arguments, **named))

    class Answer:
        """Has nothing but a result."""

        def __init__(self, owner, task):
            self.owner, self.task = owner, task

        def result(self):
            self.owner.run()
            return self.task.result()

    same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, Later(), progress=False))


def test_a_build_that_fails_is_heard_of():
    def build(gain):
        raise ZeroDivisionError(f"no loop at {gain}")

    with pytest.raises(ZeroDivisionError, match="no loop at 1"):
        cp.sweep(build, GAINS, PLANS, TIMES, progress=False)
    with ThreadPoolExecutor(2) as pool, pytest.raises(ZeroDivisionError, match="no loop at 1"):
        cp.sweep(build, GAINS, PLANS, TIMES, pool, progress=False)


# What it can be turned into


def test_to_pandas_has_a_row_a_value_and_a_column_a_plan_and_metric(swept):
    table = swept.to_pandas()
    assert table.index.tolist() == GAINS
    assert table.index.name == swept.parameter
    assert table.columns.names == ["plan", "metric"]
    for plan, rows in swept.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(table[plan, name], row)


def test_results_are_plain_and_null_where_infinite():
    found = cp.sweep(BUILD, [-1.0, 5.0], PLANS, TIMES, progress=False, parameter="gain")
    data = json.loads(json.dumps(found.results(["settling_time", "overshoot_error"]), allow_nan=False))
    assert list(data) == ["gain", "step", "planned"]
    assert data["gain"] == [-1.0, 5.0]
    assert list(data["step"]) == ["settling_time", "overshoot_error"]
    assert data["step"]["settling_time"] == [None, found.metrics["step"]["settling_time"][1]]


def test_merged_sweeps_stand_in_order(swept):
    odd = cp.sweep(BUILD, [0.5, 10.0, 50.0], PLANS, TIMES, progress=False)
    both = cp.sweep(BUILD, [0.5, 1.0, 5.0, 10.0, 20.0, 50.0], PLANS, TIMES, progress=False)
    same(both, swept.merged(odd))
    same(both, odd.merged(swept))


def test_every_measure_is_swept(swept):
    known = [name for name in MEASURES if not name.startswith("control")]
    assert set(swept.metrics["step"]) <= set(known)
    assert {"settling_time", "overshoot_error", "iae", "itae_final"} <= set(swept.metrics["step"])
