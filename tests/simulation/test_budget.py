"""Time limit of a run, with a clock that advances by a second at every reading."""

import threading
from itertools import count
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import budget
from ctrlplan.simulation.budget import TimeLimitError, check, time_limit

TIMES = np.linspace(0.0, 10.0, 11)


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    ticks = count()
    monkeypatch.setattr(budget, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))


def looks_until_it_raises():
    for k in range(1000):
        try:
            check()
        except TimeLimitError:
            return k
    return None


def test_without_a_limit_nothing_is_checked():
    assert looks_until_it_raises() is None
    with time_limit(None):
        assert looks_until_it_raises() is None


def test_a_limit_raises_once_its_time_has_passed():
    with time_limit(5.0):
        for _ in range(5):
            check(0.25)
        with pytest.raises(TimeLimitError, match=r"within timeout = 5 s, got to t = 0\.25 s in that time"):
            check(0.25)


def test_a_limit_ends_with_its_context_however_it_is_left():
    with pytest.raises(ZeroDivisionError), time_limit(1.0):
        raise ZeroDivisionError
    assert looks_until_it_raises() is None


def test_the_outer_limit_stands_after_the_inner_one():
    with time_limit(50.0):
        with time_limit(5.0):
            assert looks_until_it_raises() < 10
        assert 10 < looks_until_it_raises() < 60


def test_every_run_has_the_whole_time():
    """Each run requires more than half of the limit."""
    seen = []
    loop = lag(lambda t, x, u, params: seen.append(t) or float(u[0]) - x)
    cp.simulate(loop, TIMES, cp.Step(1.0), method="python")
    with time_limit(1.5 * len(seen)):
        for _ in range(3):
            cp.simulate(loop, TIMES, cp.Step(1.0), method="python")


def test_a_limit_is_of_its_own_thread():
    found = []
    with time_limit(5.0):
        other = threading.Thread(target=lambda: found.append(looks_until_it_raises()))
        other.start()
        other.join()
        assert looks_until_it_raises() is not None
    assert found == [None]


def lag(rate):
    return ct.nlsys(rate, None, states=1, inputs="r", outputs="y", name="lag")


def test_a_run_by_python_ends_between_two_evaluations():
    seen = []

    def rate(t, x, u, params):
        seen.append(t)
        return float(u[0]) - x

    cp.simulate(lag(rate), TIMES, cp.Step(1.0), method="python")
    needed = len(seen)
    seen.clear()
    with time_limit(20.0), pytest.raises(TimeLimitError, match="timeout = 20 s"):
        cp.simulate(lag(rate), TIMES, cp.Step(1.0), method="python")
    assert len(seen) < needed


def test_a_discrete_run_ends_between_two_samples():
    digital = ct.nlsys(lambda t, x, u, p: 0.5 * x + u, None, states=1, inputs="r", outputs="y", dt=0.1, name="digital")
    with time_limit(20.0), pytest.raises(TimeLimitError, match="timeout = 20 s, got to t = "):
        cp.simulate(digital, np.linspace(0.0, 10.0, 101), cp.Step(1.0))


def test_a_compiled_run_ends_between_two_segments():
    pytest.importorskip("casadi")
    points = [cp.Waypoint(float(k), float(k % 2), 0.0) for k in range(60)]
    loop, plan = lag(lambda t, x, u, p: u - np.tanh(x)), cp.PiecewiseSpline(points)
    times = np.linspace(0.0, 59.0, 60)
    assert cp.simulate(loop, times, plan, method="compiled").method == "compiled"
    with time_limit(20.0), pytest.raises(TimeLimitError, match="timeout = 20 s"):
        cp.simulate(loop, times, plan, method="compiled")


def test_a_linear_run_is_exact_and_evaluates_nothing():
    with time_limit(1.0):
        assert cp.simulate(cp.plants.integrator_lag_loop(5.0), TIMES, cp.Step(1.0)).method == "exact"
