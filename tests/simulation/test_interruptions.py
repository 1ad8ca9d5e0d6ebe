"""Ctrl-C and SystemExit reach the caller of a run, from Python's equations and from inside CVODES alike."""

import signal
import threading

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import interruptions

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread(),
    reason="signals of a timer are handled in the main thread alone",
)


def fast():
    """Pendulum of a thousand radians per second, for which a run of an hour takes much longer than a test."""
    return ct.nlsys(lambda t, x, u, p: [x[1], -1e6 * np.sin(x[0])], inputs=0, outputs=2, states=2, name="fast")


@pytest.fixture
def alarm():
    """Set a handler of a timer's signal that raises some exception, until the test is over."""
    before = signal.getsignal(signal.SIGALRM)

    def start(error):
        def handler(number, frame):
            raise error

        signal.signal(signal.SIGALRM, handler)
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        return handler

    yield start
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("method", ["compiled", "auto", "python"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit(3)])
def test_what_a_handler_raises_reaches_the_caller(error, method, alarm, capfd):
    system = fast()
    cp.simulate(system, [0.0, 0.001], None, [1.0, 0.0], method=method)  # compiled before
    handler = alarm(error)
    kind = error if isinstance(error, type) else type(error)
    with pytest.raises(kind) as caught:
        cp.simulate(system, np.linspace(0, 3600, 360001), None, [1.0, 0.0], method=method)
    if isinstance(error, SystemExit):
        assert caught.value.code == 3
    assert signal.getsignal(signal.SIGALRM) is handler
    # The form can be used again.
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    found = cp.simulate(system, [0.0, 0.001], None, [1.0, 0.0], method=method)
    assert np.isfinite(found.outputs).all()


@pytest.mark.slow
def test_an_interruption_of_a_comparison_reaches_the_caller(alarm):
    system = ct.nlsys(
        lambda t, x, u, p: [x[1], -1e6 * np.sin(x[0]) + 0.0 * u[0]],
        inputs="r",
        outputs=["y", "v"],
        states=2,
        name="fast",
    )
    alarm(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        cp.compare(system, {"step": cp.Step(1.0)}, np.linspace(0, 3600, 360001), initial_state=[1.0, 0.0])


def test_a_signal_while_handlers_are_exchanged_reaches_the_caller_and_leaves_them(alarm, monkeypatch):
    class Signals:
        def __iter__(self):
            yield signal.SIGALRM
            signal.raise_signal(signal.SIGALRM)
            yield signal.SIGTERM

    system = fast()
    cp.simulate(system, [0.0, 0.001], None, [1.0, 0.0], method="compiled")  # compiled before
    handler = alarm(KeyboardInterrupt)
    monkeypatch.setattr(interruptions, "_SIGNALS", Signals())
    with pytest.raises(KeyboardInterrupt):
        cp.simulate(system, [0.0, 0.001], None, [1.0, 0.0], method="compiled")
    assert signal.getsignal(signal.SIGALRM) is handler


@pytest.mark.slow
def test_a_handler_that_raises_nothing_is_called_and_the_run_goes_on(alarm):
    """A timer of a user's program: its handler runs during CVODES, and the result does not change."""
    system, calls = fast(), []
    before = signal.getsignal(signal.SIGALRM)
    signal.signal(signal.SIGALRM, lambda number, frame: calls.append(number))
    t = np.linspace(0, 5, 501)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
        found = cp.simulate(system, t, None, [1.0, 0.0], method="compiled")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    plain = cp.simulate(system, t, None, [1.0, 0.0], method="compiled")
    assert calls
    assert np.array_equal(found.outputs, plain.outputs)


def test_runs_in_other_threads_leave_handlers_alone():
    system, before = fast(), signal.getsignal(signal.SIGINT)
    found = []
    thread = threading.Thread(
        target=lambda: found.append(cp.simulate(system, [0.0, 1.0], None, [1.0, 0.0], method="compiled"))
    )
    thread.start()
    thread.join()
    assert len(found) == 1
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_a_handler_that_simulates_the_same_system_does_not_change_the_run(alarm):
    system, t, inner = fast(), np.linspace(0, 0.5, 3), []
    before = signal.getsignal(signal.SIGALRM)
    plain = cp.simulate(system, t, None, [1.0, 0.0], method="compiled")
    signal.signal(
        signal.SIGALRM,
        lambda number, frame: inner.append(cp.simulate(system, t, None, [0.5, 0.0], method="compiled")),
    )
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        found = cp.simulate(system, t, None, [1.0, 0.0], method="compiled")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert np.array_equal(found.outputs, plain.outputs)
    assert np.array_equal(inner[0].outputs, cp.simulate(system, t, None, [0.5, 0.0], method="compiled").outputs)
