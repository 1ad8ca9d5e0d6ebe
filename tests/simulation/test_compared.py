"""States at which a compiled form is compared with Python: both sides of switches and peaks, at bounded cost."""

import casadi
import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import compiled as compiled_module
from ctrlplan.symbolic.comparison import Compared, telling_states

ca = pytest.importorskip("casadi")
switches_module = pytest.importorskip("ctrlplan.symbolic.switches")

OSCILLATION = np.pi * np.arange(13)
"""Times at which sin is 0."""


def oscillator(force, name="wrong"):
    """x'' = -x + force(x), of amplitude 10 from x = 0, x' = 10."""
    return ct.nlsys(lambda t, x, u, p: [x[1], -x[0] + force(x)], None, inputs=0, outputs=2, states=2, name=name)


def is_symbol(value):
    """Whether a function is being traced, which a block must not test; here to make a trace wrong on purpose."""
    return not isinstance(value, float)


def beyond_a_switch(x):
    """Stop at 9: correct up to there, with a wrong stiffness beyond."""
    return np.where(x[0] > 9.0, -(20.0 if is_symbol(x[0]) else 40.0) * (x[0] - 9.0), 0.0)


def beyond_a_limit(x):
    return -(20.0 if is_symbol(x[0]) else 40.0) * np.maximum(x[0] - 9.0, 0.0)


def beyond_a_clip(x):
    return -(20.0 if is_symbol(x[0]) else 40.0) * (x[0] - np.clip(x[0], -9.0, 9.0))


def at_the_peak(x):
    """Without a switch in the trace: the branch is missing in it."""
    try:
        stiff = bool(x[0] > 9.0)
    except TypeError:
        stiff = False
    return -40.0 * (x[0] - 9.0) if stiff else 0.0


def at_a_whole_number(x):
    return (0.0 if is_symbol(x[0]) else 0.01) * np.floor(np.abs(x[0]) / 9.0)


WRONG = [beyond_a_switch, beyond_a_limit, beyond_a_clip, at_the_peak, at_a_whole_number]


@pytest.mark.parametrize("force", WRONG, ids=lambda force: force.__name__)
def test_a_wrong_trace_shows_between_the_times_of_the_run(force):
    """At the times themselves x is near 0, and no trial state is beyond 9."""
    found = cp.simulate(oscillator(force), OSCILLATION, None, [0.0, 10.0])
    assert found.method == "python"
    assert "block wrong cannot be traced (its trace gives" in found.reason


def test_a_wrong_trace_shows_in_a_later_run_on_a_new_side_of_a_switch():
    system = oscillator(beyond_a_switch)
    times = np.linspace(0.0, 10.0, 101)
    assert [cp.simulate(system, times, None, [0.0, v]).method for v in (3.0, 4.0, 10.0)] == [
        "compiled",
        "compiled",
        "python",
    ]


@pytest.mark.skipif(not hasattr(casadi.FunctionBuffer, "stats"), reason="this CasADi does not count evaluations")
@pytest.mark.parametrize("times", [OSCILLATION, np.linspace(0.0, 12.0, 1201)], ids=["few times", "many"])
def test_a_comparison_costs_a_fifth_of_the_run_at_most(monkeypatch, times):
    compared, evaluated = [], []
    agrees, evaluations = compiled_module.agrees, compiled_module.Segment.evaluations

    def noting(segment):
        evaluated.append((len(compared), evaluations(segment)))
        return evaluated[-1][1]

    monkeypatch.setattr(compiled_module, "agrees", lambda *given: compared.append(given[3].size) or agrees(*given))
    monkeypatch.setattr(compiled_module.Segment, "evaluations", noting)
    spring = ct.nlsys(
        lambda t, x, u, p: [x[1], -x[0] - 5.0 * np.maximum(x[0] - 0.5, 0.0)], None, inputs=0, outputs=2, states=2
    )
    assert cp.simulate(spring, times, None, [0.0, 1.0]).method == "compiled"
    assert len(compared) == 1
    assert 12 <= compared[0] <= sum(count for before, count in evaluated if before == 0) / 5


def test_a_batch_is_compared_in_the_first_runs_and_in_random_ones(monkeypatch):
    compared = []
    agrees = compiled_module.agrees
    monkeypatch.setattr(compiled_module, "agrees", lambda *given: compared.append(run) or agrees(*given))
    ready = cp.prepare(
        ct.nlsys(
            lambda t, x, u, p: [-p["k"] * x[0] ** 3],
            None,
            inputs=0,
            outputs=1,
            states=1,
            params={"k": 1.0},
            name="batch",
        )
    )
    for run in range(1, 17):
        cp.simulate(ready, np.linspace(0.0, 1.0, 5), None, 1.0, params={"k": float(run)})
    # One of 3 and 4, of 5 to 8, of 9 to 16.
    assert compared[:2] == [1, 2]
    assert [int(np.ceil(np.log2(run))) for run in compared[2:]] == [2, 3, 4]


def test_both_sides_of_every_switch_come_first():
    """A switch that changes often does not displace one that changes once."""
    sides = np.ones((2, 1000))
    sides[0, 1::2] = -1.0
    sides[1, 700:] = -1.0
    signals = np.linspace(0.0, 1.0, 1000)[None] ** 2
    signals[0, 333] = 5.0
    places = telling_states(sides, signals, 20)
    assert places.size == 20
    assert {699, 700, 333, 0, 999} <= set(places.tolist())
    assert np.all(np.diff(places) > 0)


@pytest.mark.parametrize("maximum", [1, 3, 50])
def test_without_switches_places_are_spread(maximum):
    places = telling_states(np.ones((0, 7)), np.sin(np.arange(7.0))[None], maximum)
    assert 1 <= places.size <= min(maximum, 7)
    assert np.unique(places).size == places.size


def test_a_form_without_switches_is_compared_once_and_at_random():
    compared = Compared(0)
    sides = np.ones((0, 4))
    due = [compared.is_due(sides) for _ in range(64)]
    assert due[0]
    assert [sum(due[2**k : 2 ** (k + 1)]) for k in range(6)] == [1] * 6


x = ca.SX.sym("x")
y = ca.SX.sym("y")
SWITCHED = {
    "less": (x < y, lambda x, y: x - y),
    "equal": (ca.eq(x, y), lambda x, y: np.abs(x - y)),
    "abs": (ca.fabs(x), lambda x, y: x),
    "sign": (ca.sign(x - 2.0 * y), lambda x, y: x - 2.0 * y),
    "fmax": (ca.fmax(x, y), lambda x, y: x - y),
    "fmin": (ca.fmin(x, 3.0), lambda x, y: x - 3.0),
    "floor": (ca.floor(x), lambda x, y: np.sin(np.pi * x)),
    "fmod": (ca.fmod(x, y), lambda x, y: np.sin(np.pi * x / y)),
    "copysign": (ca.copysign(x, y), lambda x, y: y),
    "inside": (ca.exp(ca.fabs(ca.sin(x) * y)), lambda x, y: np.sin(x) * y),
}


@pytest.mark.parametrize("name", SWITCHED)
def test_the_arguments_of_switches(name):
    expression, argument = SWITCHED[name]
    function = ca.Function("f", [x, y], [expression])
    numbers = np.random.default_rng(0).normal(size=(2, 50))
    found = switches_module.switch_arguments(function)(numbers[:1], numbers[1:]).full()
    assert found.shape[0] == 1
    expected = argument(*numbers)
    assert np.all((np.sign(found[0]) == np.sign(expected)) | (np.sign(found[0]) == -np.sign(expected)))
    assert abs(np.sum(np.sign(found[0]) * np.sign(expected))) == 50  # the same sign everywhere, or the other


def test_of_many_draws_the_first_and_a_random_one_are_compared(monkeypatch):
    compared = []
    agrees = compiled_module.agrees
    monkeypatch.setattr(compiled_module, "agrees", lambda *given: compared.append(given[2].get("k")) or agrees(*given))
    block = ct.nlsys(
        lambda t, x, u, p: [-p["k"] * (x[0] - u[0]) ** 3],
        None,
        inputs=["r"],
        outputs=["y"],
        states=1,
        params={"k": 1.0},
    )
    gains = np.linspace(1.0, 2.0, 12)
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["r"])
    times = np.linspace(0.0, 2.0, 21)
    cp.monte_carlo(block, {"k": gains}, {"plan": plan}, times, outputs={"y": "r"}, progress=False)
    drawn = [k for k in compared if k is not None]
    assert gains[0] in drawn
    assert set(drawn) & set(gains[1:])
