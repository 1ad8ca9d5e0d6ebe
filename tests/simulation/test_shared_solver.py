"""LSODA of older scipy has one state for all threads: concurrent runs use another solver, with the same result."""

from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import interpreted

T = np.linspace(0.0, 5.0, 51)


def decay(rate):
    """x' = -rate x^2 from 1: x = 1 / (1 + rate t)."""
    return ct.nlsys(lambda t, x, u, p: [-rate * x[0] ** 2], None, inputs=0, outputs=1, states=1, name="decay")


def run(rate):
    return cp.simulate(decay(rate), T, None, 1.0, method="python").outputs


def test_runs_in_threads_do_not_disturb_each_other():
    rates = np.linspace(0.5, 4.0, 12)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(run, rates))
    assert max(np.abs(y - 1.0 / (1.0 + rate * T)).max() for rate, y in zip(rates, found, strict=True)) < 1e-6


@pytest.mark.slow
def test_a_run_inside_the_block_of_another_run():
    def rates(t, x, u, p):
        return [-run(1.0)[0, -1] * x[0]]

    outer = ct.nlsys(rates, None, inputs=0, outputs=1, states=1, name="outer")
    t = np.linspace(0.0, 0.1, 3)
    found = cp.simulate(outer, t, None, 1.0, method="python").outputs
    assert np.abs(found - np.exp(-t / 6.0)).max() < 1e-6


@pytest.mark.parametrize("shared", [False, True])
def test_the_only_lsoda_is_held_by_one_run_and_given_back(monkeypatch, shared):
    monkeypatch.setattr(interpreted, "_SHARED", shared)
    with interpreted._implicit() as first, interpreted._implicit() as second:
        assert (first.__name__, second.__name__) == ("LSODA", "BDF" if shared else "LSODA")
        assert np.abs(run(2.0) - 1.0 / (1.0 + 2.0 * T)).max() < 1e-6
    with interpreted._implicit() as again:
        assert again.__name__ == "LSODA"


def test_the_other_solver_takes_several_states(monkeypatch):
    """An oscillator from (1, 0): cos t and -sin t."""
    monkeypatch.setattr(interpreted, "_SHARED", True)
    loop = ct.nlsys(lambda t, x, u, p: [x[1], -x[0]], None, inputs=0, outputs=2, states=2, name="oscillator")
    with interpreted._implicit():
        found = cp.simulate(loop, T, None, [1.0, 0.0], method="python").outputs
    np.testing.assert_allclose(found, [np.cos(T), -np.sin(T)], rtol=0, atol=1e-6)
