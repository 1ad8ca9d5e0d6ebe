"""Draws of linear loops built by a function: solved together, with the results of each alone and of closed forms."""

import math
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from ensemble_cases import PLANS, TIMES, Elsewhere, lag_response, run

import ctrlplan as cp
from ctrlplan.studies.ensemble import LEVELS
from ctrlplan.studies.experiment import Experiment

FEW = TIMES[::4]
DRAWS = cp.draws(17, seed=2, gain=(2.0, 9.0), pole=(0.5, 1.5))


def servo(gain, pole):
    """Loop of gain/(s (s + pole)) in unity feedback, with the control as an output."""
    return ct.ss(
        [[0.0, 1.0], [-gain, -pole]],
        [[0.0], [gain]],
        [[1.0, 0.0], [-gain, 0.0]],
        [[0.0], [gain]],
        inputs="r",
        outputs=["y", "u"],
    )


def lag_of(tau):
    return ct.ss([[-1.0 / tau]], [[1.0 / tau]], [[1.0]], [[0.0]], inputs="r", outputs="y")


def close(one, other, tolerance=1e-12):
    """Metrics and bands equal, relative to the largest value of each."""
    assert list(one.metrics) == list(other.metrics)
    for name in ("metrics", "bands"):
        for plan, rows in getattr(one, name).items():
            assert list(rows) == list(getattr(other, name)[plan])
            for key, row in rows.items():
                known = getattr(other, name)[plan][key]
                scale = max(1.0, np.abs(known[np.isfinite(known)]).max(initial=0.0))
                np.testing.assert_allclose(row, known, rtol=tolerance, atol=tolerance * scale)


@pytest.fixture
def solved(monkeypatch):
    """Numbers of loops solved together."""
    known, counts = Experiment.run_alike, []

    def counting(self, loops, *arguments):
        counts.append(len(loops))
        return known(self, loops, *arguments)

    monkeypatch.setattr(Experiment, "run_alike", counting)
    return counts


def test_draws_of_linear_loops_are_solved_together_and_equal_those_alone(solved, monkeypatch):
    together = run(servo, DRAWS, times=FEW)
    assert sum(solved) == 17
    assert len(solved) <= 3
    monkeypatch.setattr(Experiment, "numbers_of", lambda *_: None)
    solved.clear()
    close(together, run(servo, DRAWS, times=FEW))
    assert solved == []


def test_metrics_and_bands_of_linear_draws_are_those_of_the_closed_form():
    tau = cp.draws(21, seed=3, tau=(0.5, 1.5))["tau"]
    found = run(lag_of, {"tau": tau})
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], tau * math.log(50), rtol=1e-5)
    for plan, curves in lag_response(tau, TIMES).items():
        np.testing.assert_allclose(found.bands[plan]["y"], np.quantile(curves, LEVELS, axis=0), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("executor", [Elsewhere, lambda: ThreadPoolExecutor(2)], ids=["tasks", "threads"])
def test_draws_of_linear_loops_are_solved_together_in_tasks(executor, solved):
    here = run(servo, DRAWS, times=FEW)
    solved.clear()
    close(here, run(servo, DRAWS, executor(), times=FEW, chunk=6), 1e-14)
    assert sum(solved) >= 14


def test_a_draw_that_cannot_be_built_fails_alone_and_loops_of_other_sizes_are_solved_too():
    def build(tau):
        if tau == 1.0:
            raise ValueError("none")
        if tau < 2.0:
            return lag_of(tau)
        idle = ct.ss([[-1.0]], [[0.0]], [[0.0]], [[0.0]])
        return ct.ss(lag_of(tau) + idle, inputs="r", outputs="y")

    tau = np.array([0.5, 0.75, 1.0, 1.25, 2.0, 3.0, 1.5])
    found = run(build, {"tau": tau})
    assert [(f.draw, f.message) for f in found.failures] == [(2, "ValueError: none")]
    settled = np.where(tau * math.log(50) < 10.0, tau * math.log(50), np.inf)
    expected = np.where(tau == 1.0, np.nan, settled)
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], expected, rtol=1e-5)


def test_a_loop_without_nominal_parameters_has_the_first_draw_in_their_place():
    found = run(servo, {"gain": [2.0, 3.0], "pole": [1.0, 1.0]})
    assert found.nominal_draw == 0
    assert found.nominal.metrics == cp.compare(servo(2.0, 1.0), PLANS, TIMES).metrics


def test_bands_have_fewer_times_for_very_many_draws():
    from ctrlplan.studies.draw_results import band_samples

    times = np.linspace(0.0, 10.0, 3456)
    for draws, curves, count in ((1, 1, 1001), (1000, 8, 1001), (10, 20, 409), (10**5, 6, 55), (10**6, 20, 31)):
        found = band_samples(times, draws, curves)
        assert found.size == count
        assert found[[0, -1]].tolist() == [0, 3455]


@pytest.mark.parametrize("executor", [None, lambda: ThreadPoolExecutor(2)], ids=["here", "threads"])
def test_loops_with_different_outputs_are_an_error(executor):
    def build(gain):
        outputs = ["y"] if gain < 3.0 else ["z"]
        return ct.ss([[-gain]], [[gain]], [[1.0]], [[0.0]], inputs="r", outputs=outputs)

    said = (
        "loop must return loops with the same outputs and controls for all draws, got [yz] for draw [0-3] and [yz] for"
    )
    with pytest.raises(ValueError, match=said):
        run(build, {"gain": [1.0, 2.0, 4.0, 2.5]}, executor and executor())
    run(build, {"gain": [1.0, 2.0]})
