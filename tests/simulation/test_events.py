"""Crossings of limits compared with closed forms, by every method, and runs that end there."""

import math
import pickle

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan.simulation import Event, Occurrence, budget
from ctrlplan.simulation.events import Departures, Watched, crossings
from ctrlplan.simulation.response import departures_in
from ctrlplan.simulation.simulate import simulate_for_metrics

METHODS = ("exact", "compiled", "python")
ALLOWED = {"exact": 1e-12, "compiled": 1e-7, "python": 1e-7}
T = np.linspace(0.0, 10.0, 21)
UNIT = cp.Step(1.0, initial=1.0)
LAG = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="r", outputs="y", states=["x"], name="lag")
OSCILLATOR = ct.ss(
    [[0, 1], [-1, 0]], [[0], [1]], np.eye(2), 0, inputs="f", outputs=["y", "v"], states=["p", "q"], name="oscillator"
)


def told(response):
    return [(o.name, o.kind) for o in response.events]


def times_of(response):
    return np.array([o.time for o in response.events])


@pytest.mark.parametrize("method", METHODS)
def test_a_lag_on_its_way_to_one(method):
    levels = (0.1, 0.5, 0.9, 0.999)
    events = [Event("y", high=level, name=f"{level}") for level in reversed(levels)]
    found = cp.simulate(LAG, T, 1.0, method=method, events=events)
    assert told(found) == [(f"{level}", "above") for level in levels]
    exact = [-math.log1p(-level) for level in levels]
    assert np.abs(times_of(found) - exact).max() <= 200 * ALLOWED[method]
    assert not any(o.stop for o in found.events)
    assert np.array_equal(found.time, T)


@pytest.mark.parametrize("method", METHODS)
def test_an_oscillation_between_its_limits(method):
    found = cp.simulate(OSCILLATOR, T, None, [1.0, 0.0], method=method, events=[Event("y", low=-0.5, high=0.5)])
    third = math.pi / 3
    exact = [
        (0.0, "above"),
        (third, "inside"),
        (2 * third, "below"),
        (4 * third, "inside"),
        (5 * third, "above"),
        (7 * third, "inside"),
        (8 * third, "below"),
    ]
    assert [o.kind for o in found.events] == [kind for _, kind in exact]
    assert np.abs(times_of(found) - [t for t, _ in exact]).max() <= ALLOWED[method]
    assert {o.name for o in found.events} == {"y"}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [2, 7, 1000])
def test_crossings_do_not_depend_on_the_samples(count, method):
    times = np.linspace(0.0, 3.0, count)
    found = cp.simulate(OSCILLATOR, times, None, [0.0, 1.0], method=method, events=[Event("y", high=0.99)])
    first = math.asin(0.99)
    assert np.abs(times_of(found) - [first, math.pi - first]).max() <= 10 * ALLOWED[method]
    assert found.time.size == count


@pytest.mark.parametrize("gain", [1.0, 100.0])
@pytest.mark.parametrize("method", METHODS)
def test_the_settling_of_a_step(gain, method):
    """Last entry into +-2 % of y = 1 - (w_n/w_p) exp(-t/2) sin(w_p t + arccos xi)."""
    wn, xi = math.sqrt(gain), 0.5 / math.sqrt(gain)
    wp = wn * math.sqrt(1 - xi * xi)

    def error(t):
        return -(wn / wp) * np.exp(-t / 2) * np.sin(wp * t + math.acos(xi))

    fine = np.linspace(0.0, 20.0, 200_001)
    k = int(np.flatnonzero(np.abs(error(fine)) > 0.02)[-1])
    exact = brentq(lambda t: abs(error(t)) - 0.02, fine[k], fine[k + 1], xtol=1e-14)
    found = cp.simulate(
        cp.plants.integrator_lag_loop(gain),
        [0.0, 20.0],
        cp.Step(1.0),
        method=method,
        events=[Event("y", low=0.98, high=1.02)],
    )
    assert found.events[-1].kind == "inside"
    assert abs(found.events[-1].time - exact) <= (1e-9 if method == "exact" else 1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_states_inputs_and_functions(method):
    def energy(t, x, u, y):
        return 0.5 * (x[0] ** 2 + x[1] ** 2) + 0.0 * (t + u[0] + y[0])

    events = [
        Event("p", low=0.0),
        Event("f", high=0.5),
        Event(energy, high=0.125),
        Event(lambda t, x, u, y: t, low=-1.0, high=4.0, name="clock"),
    ]
    assert [event.name for event in events] == ["p", "f", "energy", "clock"]
    # p = 1 - cos(t - 1) from 1 s on under a unit force, energy = 1 - cos(t - 1) too.
    found = cp.simulate(OSCILLATOR, T, cp.Step(1.0, time=1.0), method=method, events=events)
    by_name = {name: [o.time for o in found.events if o.name == name] for name in ("f", "energy", "clock")}
    assert abs(by_name["f"][0] - 1.0) <= 1e-12
    assert abs(by_name["clock"][0] - 4.0) <= 1e-12
    rise = math.acos(1 - 0.125)
    turns = [1 + rise, 1 + 2 * math.pi - rise, 1 + 2 * math.pi + rise]
    assert np.abs(np.array(by_name["energy"]) - turns).max() <= 10 * ALLOWED[method]


@pytest.mark.parametrize("method", METHODS)
def test_samples_are_straight_between_the_crossings_too(method):
    """A ramp however it is sampled: y = t - 1 + exp(-t) from 0, and a plan next to it where there are two inputs."""
    times = np.array([0.0, 0.7, 1.9, 2.0, 5.0])
    exact = brentq(lambda t: t - 1 + math.exp(-t) - 2.5, 3, 5, xtol=1e-14)
    events = [Event("y", high=2.5, stop=True), Event("r", high=1.3)]
    found = cp.simulate(LAG, times, times, method=method, events=events)
    assert np.abs(times_of(found) - [1.3, exact]).max() <= 10 * ALLOWED[method]
    assert abs(found.outputs[-1] - 2.5) <= 10 * ALLOWED[method]
    two = ct.ss(-1.0, [[1.0, 1.0]], 1.0, 0, inputs=["r", "d"], outputs="y")
    both = cp.simulate(two, times, {"r": times, "d": UNIT}, method=method, events=[Event("y", high=2.5)])
    exact = brentq(lambda t: t - 2.5, 2, 3)  # the step adds 1 - exp(-t)
    assert np.abs(times_of(both) - [exact]).max() <= 10 * ALLOWED[method]


def test_an_output_hides_an_input_of_the_same_name():
    system = ct.ss([], [], [], [[-1.0]], inputs="s", outputs="s", name="turned")
    found = cp.simulate(system, T, 1.0, events=[Event("s", low=0.0)])
    assert told(found) == [("s", "below")]


# Starts, jumps and short crossings


@pytest.mark.parametrize("method", METHODS)
def test_limits_touched_at_the_beginning(method):
    """On a limit is inside; leaving at the start counts at the first time, entering is no crossing."""
    integrator = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="r", outputs="y")
    leaving = cp.simulate(integrator, [2.0, 5.0], 1.0, 1.0, method=method, events=[Event("y", low=-3.0, high=1.0)])
    assert [(o.kind, o.time) for o in leaving.events] == [("above", 2.0)]
    entering = cp.simulate(integrator, [2.0, 5.0], -1.0, 1.0, method=method, events=[Event("y", low=-9.0, high=1.0)])
    assert entering.events == []
    outside = cp.simulate(integrator, [2.0, 5.0], -1.0, 2.0, method=method, events=[Event("y", high=1.0)])
    assert [o.kind for o in outside.events] == ["above", "inside"]
    assert np.abs(times_of(outside) - [2.0, 3.0]).max() <= 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_from_below_to_above_within_one_step(method):
    wire = ct.ss([], [], [], [[1.0]], inputs="r", outputs="y")
    jump = cp.Step(1.0, initial=-1.0, time=math.pi)
    found = cp.simulate(wire, T, jump, method=method, events=[Event("y", low=-0.5, high=0.5)])
    assert [o.kind for o in found.events] == ["below", "inside", "above"]
    assert np.abs(times_of(found) - [0.0, math.pi, math.pi]).max() <= 1e-12
    steep = cp.PolySpline([cp.Waypoint(math.pi, -1), cp.Waypoint(math.pi + 1e-4, 1)])
    found = cp.simulate(wire, T, steep, method=method, events=[Event("y", low=-0.5, high=0.5)])
    assert [o.kind for o in found.events] == ["below", "inside", "above"]
    assert np.abs(times_of(found) - [0.0, math.pi + 2.5e-5, math.pi + 7.5e-5]).max() <= 1e-12


@pytest.mark.parametrize("method", METHODS)
def test_a_jump_of_the_input_is_where_the_plan_says(method):
    through = ct.ss(-1.0, 1.0, 1.0, 1.0, inputs="r", outputs="y")
    found = cp.simulate(through, T, cp.Step(1.0, time=1.7), method=method, events=[Event("y", high=0.5, stop=True)])
    assert abs(found.events[0].time - 1.7) <= 1e-12
    assert found.time[-1] == found.events[0].time
    assert abs(found.outputs[-1] - 1.0) <= 1e-9


def test_a_limit_on_a_discrete_signal_is_crossed_at_a_sample():
    doubling = ct.ss(2.0, 0.0, 1.0, 0.0, 0.5, inputs="r", outputs="y")
    times = 0.5 * np.arange(11)
    found = cp.simulate(doubling, times, None, 1.0, events=[Event("y", high=10.0, stop=True)])
    assert [(o.time, o.kind) for o in found.events] == [(2.0, "above")]
    assert found.time.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert found.outputs.tolist() == [1.0, 2.0, 4.0, 8.0, 16.0]


# Runs that end


@pytest.mark.parametrize("method", METHODS)
def test_a_stop_ends_the_response_on_the_limit(method):
    events = [Event("y", high=0.75, stop=True, name="full"), Event("y", high=0.5), Event("y", high=0.9, name="never")]
    found = cp.simulate(LAG, T, 1.0, method=method, events=events)
    last = math.log(4.0)
    assert told(found) == [("y", "above"), ("full", "above")]
    assert [o.stop for o in found.events] == [False, True]
    assert np.abs(times_of(found) - [math.log(2.0), last]).max() <= ALLOWED[method]
    assert found.time[-1] == found.events[-1].time
    assert np.array_equal(found.time[:-1], T[last > T])
    assert found.outputs.shape == found.time.shape == found.inputs.shape
    assert np.abs(found.outputs + np.expm1(-found.time)).max() <= ALLOWED[method]
    assert abs(found.outputs[-1] - 0.75) <= ALLOWED[method]
    assert np.all(np.diff(found.time) > 0)


@pytest.mark.parametrize("method", METHODS)
def test_the_first_of_several_stops_counts(method):
    events = [Event("y", high=0.9, stop=True, name="late"), Event("y", high=0.3, stop=True, name="soon")]
    found = cp.simulate(LAG, T, 1.0, method=method, events=events)
    assert told(found) == [("soon", "above")]
    assert abs(found.time[-1] + math.log(0.7)) <= ALLOWED[method]


def pulse_at_two(rates):
    """A state with given rates from 0, and a narrow pulse of it at 2: above 0.5 for a few samples."""
    return ct.nlsys(
        rates,
        lambda t, x, u, p: np.exp(-(((x[0] - 2.0) / 0.01) ** 2)),
        inputs=0,
        outputs=["y"],
        states=["x"],
        name="pulse",
    )


@pytest.mark.parametrize("method", ["compiled", "python"])
@pytest.mark.parametrize("end", [2.05, 10.0])
def test_a_run_ends_in_a_short_pulse(method, end):
    times = np.linspace(0.0, end, 1001)
    stop = Event("y", high=0.5, stop=True)
    found = cp.simulate(pulse_at_two(lambda t, x, u, p: [1.0]), times, method=method, events=[stop])
    exact = 2.0 - 0.01 * math.sqrt(math.log(2.0))
    assert [o.stop for o in found.events] == [True]
    assert abs(found.time[-1] - exact) <= 1e-9
    assert np.abs(found.states[0] - found.time).max() <= 1e-9
    assert np.array_equal(found.time[:-1], times[times < exact])


@pytest.mark.parametrize("method", ["compiled", pytest.param("python", marks=pytest.mark.slow)])
def test_a_run_ends_in_a_short_pulse_before_its_solution_does(method):
    def rates(t, x, u, p):
        return [1.0 / np.sqrt(3.0 - x[0])]  # (3 - x)^(3/2) = 3^(3/2) - 1.5 t

    times = np.linspace(0.0, 11.0, 2001)
    stop = Event("y", high=0.5, stop=True)
    with np.errstate(all="ignore"):
        found = cp.simulate(pulse_at_two(rates), times, method=method, events=[stop])
    level = 1.0 + 0.01 * math.sqrt(math.log(2.0))
    assert abs(found.time[-1] - (3.0**1.5 - level**1.5) / 1.5) <= 1e-8
    assert [o.stop for o in found.events] == [True]


@pytest.mark.parametrize("method", METHODS)
def test_a_stop_that_is_not_reached_changes_nothing(method):
    plain = cp.simulate(LAG, T, 1.0, method=method)
    found = cp.simulate(LAG, T, 1.0, method=method, events=[Event("y", high=2.0, stop=True)])
    assert found.events == []
    assert np.array_equal(found.time, T)
    assert np.abs(found.outputs - plain.outputs).max() <= ALLOWED[method]


@pytest.mark.parametrize("method", METHODS)
def test_coming_back_does_not_stop_a_run(method):
    """A run that starts outside the limits of a stop ends at once; without the stop it enters them."""
    found = cp.simulate(LAG, T, None, 2.0, method=method, events=[Event("y", high=1.0)])
    assert told(found) == [("y", "above"), ("y", "inside")]
    assert found.time.size == T.size
    stopped = cp.simulate(LAG, T, None, 2.0, method=method, events=[Event("y", high=1.0, stop=True)])
    assert told(stopped) == [("y", "above")]
    assert stopped.time.tolist() == [0.0]
    assert stopped.outputs.tolist() == [2.0]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["compiled", "python", "auto"])
@pytest.mark.parametrize("level", [2.0, 100.0, 1e6])
def test_a_stop_before_the_solution_ends(level, method):
    """x' = x^2 from 1 is 1/(1 - t): no solution at 2 s, but the run ends before."""
    escaping = ct.nlsys(lambda t, x, u, p: x**2, None, inputs=0, outputs="y", states=1, name="escaping")
    with np.errstate(all="ignore"):
        found = cp.simulate(
            escaping, [0.0, 0.25, 2.0], None, 1.0, method=method, events=[Event("y", high=level, stop=True)]
        )
    assert abs(found.time[-1] - (1 - 1 / level)) <= 1e-6
    assert abs(found.outputs.ravel()[-1] - level) <= 1e-6 * level
    assert np.abs(found.outputs.ravel()[:2] - [1.0, 4 / 3]).max() <= 1e-6


@pytest.mark.parametrize("error", [ValueError, ZeroDivisionError])
@pytest.mark.parametrize("end", [1.5, 3.0, 40.0])
def test_a_block_may_be_undefined_after_a_stop(error, end):
    """x' = 1; the block raises an error above 1.2."""

    def rate(t, x, u, params):
        if x[0] > 1.2:
            raise error("the model is not valid here")
        return np.ones(1)

    ramp, times = ct.nlsys(rate, lambda t, x, u, params: x, outputs="y", states=1, inputs=0), np.linspace(0.0, end, 401)
    found = cp.simulate(ramp, times, events=[Event("y", high=1.0, stop=True)])
    assert found.time[-1] == pytest.approx(1.0, abs=1e-7)
    for events in ([], [Event("y", high=2.0, stop=True)], [Event("y", high=1.0)]):
        with pytest.raises(error, match="not valid here"):
            cp.simulate(ramp, times, events=events)


@pytest.mark.parametrize("level", [0.0, 1.0, -3.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("method", METHODS)
def test_a_signal_at_rest_on_its_limit(method, sign, level):
    """It is inside until it leaves, from 2.53 s to 4.53 s, and inside again at the end: between output times."""
    plan = cp.PolySpline([cp.Waypoint(2.53 + k, level + sign * (k == 1), 0) for k in range(3)])
    unit = ct.ss([], [], [], 1.0, inputs="r", outputs="y", name="unit")
    limits = {"high": level} if sign > 0 else {"low": level}
    found = cp.simulate(unit, T, plan, events=[Event("y", **limits)], method=method)
    assert [one.kind for one in found.events] == ["above" if sign > 0 else "below", "inside"]
    # Squares of times of 1e-7 s are the rounding errors of the values.
    assert np.abs(times_of(found) - [2.53, 4.53]).max() <= (1e-11 if level == 0.0 else 1e-7)


def test_a_signal_that_leaves_its_limit_at_an_output_time():
    """It leaves zero upwards at 0 and downwards at 1 s, where it is on both limits."""
    plan = cp.PolySpline([cp.Waypoint(0.0, 0, 1), cp.Waypoint(1.0, 0, -1), cp.Waypoint(2.0, 0, 1)])
    unit = ct.ss([], [], [], 1.0, inputs="r", outputs="y", name="unit")
    found = cp.simulate(unit, [0.0, 0.5, 1.0, 1.5, 2.0], plan, events=[Event("y", low=0.0), Event("y", high=0.0)])
    assert np.abs(times_of(found) - [0.0, 1.0, 1.0, 2.0]).max() <= 1e-11


def test_a_held_signal_leaves_its_limit_at_a_sample():
    """A counter, and one that is sampled in a continuous loop: inside as long as it equals the limit."""
    counter = ct.nlsys(lambda t, x, u, p: x + 1.0, lambda t, x, u, p: x, inputs=0, outputs="n", states=1, dt=0.25)
    discrete = cp.simulate(counter, np.arange(0.0, 5.0, 0.25), events=[Event("n", high=5.0)])
    assert told(discrete) == [("n", "above")]
    assert times_of(discrete) == [1.5]
    clock = ct.ss(0.0, 0.0, 1.0, 0.0, inputs="nothing", outputs="c", name="clock")
    counting = ct.ss(1.0, 1.0, 1.0, 0.0, 0.25, inputs="c", outputs="n", name="counting")
    loop = ct.interconnect([clock, cp.sample_hold(counting, 0.25)], inputs=["nothing"], outputs=["n"])
    for method in ("auto", "python"):
        held = cp.simulate(
            loop, [0.0, 0.6, 1.1, 4.0], 0.0, [1.0, 0.0, 0.0], events=[Event("n", high=5.0)], method=method
        )
        assert times_of(held) == pytest.approx([1.5], abs=1e-10)


def test_a_discrete_run_ends_soon_after_a_stop():
    """A counter: blocks are evaluated at most 128 samples after the event."""
    calls = []

    def count(t, x, u, params):
        calls.append(t)
        return x + 1.0

    counter = ct.nlsys(count, lambda t, x, u, params: x, inputs=0, outputs="y", states=1, dt=1.0)
    for high in (-1.0, 0.5, 126.5, 127.5, 500.0):
        calls.clear()
        found = cp.simulate(counter, np.arange(3000.0), events=[Event("y", high=high, stop=True)])
        end = max(0.0, math.floor(high) + 1.0)
        assert found.time[-1] == found.outputs[0, -1] == end
        assert len(calls) <= end + 129


class OutsideOfModelError(Exception):
    """Raised by blocks outside of the range of their model."""


def defined_up_to(limit, value):
    if value > limit:
        raise OutsideOfModelError("the model is not valid here")
    return value


def ramp_and(*blocks, dt=0):
    """y' = 1, or steps of dt."""
    rate = (lambda t, x, u, p: x + dt) if dt else (lambda t, x, u, p: np.ones(1))
    ramp = ct.nlsys(rate, lambda t, x, u, p: x, outputs="y", states=1, inputs=0, dt=dt, name="ramp")
    return ct.interconnect([ramp, *blocks], inputs=[], outputs=["y", "v"], inplist=[], outlist=["y", "v"])


def reading(t, x, u, params):
    return [defined_up_to(1.2, u[0])]


def output_of(source, dt=0):
    return ct.nlsys(None, reading, inputs=source, outputs="v", dt=dt, name="block")


def update_of(source, dt):
    return ct.nlsys(reading, lambda t, x, u, p: x, inputs=source, outputs="v", states=1, dt=dt, name="block")


READERS = {
    "output": ramp_and(output_of("y")),
    "output of a sampled block": ramp_and(cp.sample_hold(output_of("y", 0.25), 0.25)),
    "update of a sampled block": ramp_and(cp.sample_hold(update_of("y", 0.25), 0.25)),
    "delayed": ramp_and(cp.create_delay_iosystem(0.05, inputs="y", outputs="w"), output_of("w")),
    "output in a discrete loop": ramp_and(output_of("y", 0.03125), dt=0.03125),
    "update in a discrete loop": ramp_and(update_of("y", 0.03125), dt=0.03125),
}


@pytest.mark.parametrize("method", ["auto", "python"])
@pytest.mark.parametrize("name", READERS)
def test_any_block_may_be_undefined_after_a_stop(name, method):
    """y = t leaves its limits at 1.01 or at the sample after it; the block is undefined above 1.2."""
    times = np.linspace(0.0, 10.0, 321)
    found = cp.simulate(READERS[name], times, events=[Event("y", high=1.01, stop=True)], method=method)
    assert found.time[-1] == pytest.approx(1.03125 if "discrete" in name else 1.01, abs=1e-7)
    assert found.outputs[0] == pytest.approx(found.time, abs=1e-7)
    with pytest.raises(OutsideOfModelError, match="not valid here"):
        cp.simulate(READERS[name], times, events=[Event("y", high=4.0, stop=True)], method=method)


@pytest.mark.parametrize("method", ["auto", "python"])
@pytest.mark.parametrize("dt", [0, 0.5])
def test_a_time_limit_holds_in_runs_that_may_stop(method, dt):
    def slow(t, x, u, params):
        budget.check(t)
        return -x

    loop = ct.nlsys(slow, lambda t, x, u, p: x, inputs=0, outputs=["y"], states=1, dt=dt)
    with pytest.raises(budget.TimeLimitError), budget.time_limit(0.0):
        cp.simulate(loop, np.linspace(0.0, 5.0, 11), None, 1.0, events=[Event("y", low=0.5, stop=True)], method=method)


def test_a_stop_of_an_unstable_loop_that_leaves_the_range_of_numbers():
    # x = exp(1000 t) is infinite from 0.71 s on.
    unstable = ct.ss(1000.0, 1.0, 1.0, 0.0, outputs="y")
    found = cp.simulate(unstable, [0.0, 10.0], None, 1.0, events=[Event("y", high=2.0, stop=True)])
    assert found.method == "exact"
    assert abs(found.time[-1] - math.log(2.0) / 1000) <= 1e-12
    assert abs(found.outputs[-1] - 2.0) <= 1e-9


# What blocks declare


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_saturation_says_when_it_acts(method):
    """Asked for 2 exp(-t) - 1 within [-0.5, 0.5]: above until ln(4/3), below from ln 4 on."""
    lag = ct.ss(-1.0, 0.0, 2.0, 0.0, inputs="nothing", outputs="w", name="fading")
    offset = ct.ss([], [], [], [[1.0, -1.0]], inputs=["w", "one"], outputs="u_cmd", name="offset", dt=None)
    blocks = [lag, offset, cp.create_saturation_iosystem(-0.5, 0.5)]
    loop = ct.interconnect(blocks, inputs=["one", "nothing"], outputs=["u"])
    times = np.linspace(0.0, 3.0, 4)
    found = cp.simulate(loop, times, {"one": 1.0}, 1.0, method=method)
    assert told(found) == [("u", "above"), ("u", "inside"), ("u", "below")]
    assert np.abs(times_of(found) - [0.0, math.log(4 / 3), math.log(4.0)]).max() <= 1e-8
    assert np.array_equal(found.time, times)
    requested = 2 * np.exp(-times) - 1
    assert np.abs(found.outputs - np.clip(requested, -0.5, 0.5)).max() <= 1e-8
    assert cp.simulate(loop, times, {"one": 1.0}, 1.0, method=method, events=()).events == []
    both = cp.simulate(loop, times, {"one": 1.0}, 1.0, method=method, events=[Event("u", high=0.2, name="mine")])
    assert {o.name for o in both.events} == {"u", "mine"}
    mine = [o for o in both.events if o.name == "mine"]
    assert abs(mine[1].time - math.log(2 / 1.2)) <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_limits_of_a_pid(method):
    kp, ki, kd, tf, high = 4.0, 3.0, 0.5, 0.1, 2.5
    pid = cp.create_pid_iosystem(kp, ki, kd, tf, limits=(-1.0, high), name="limited")
    plant = ct.ss([[-1, 1], [0, -2]], [[0], [1]], [[1, 0]], 0, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([pid, plant], inputs="r", outputs=["y"])
    found = cp.simulate(loop, T, cp.Step(1.0, time=1.0), method=method, rtol=1e-10, atol=1e-12)
    back = math.sqrt(ki / kd)

    def requested(x):
        error = 1.0 - x[2]
        return kp * error + x[0] + kd / tf * (error - x[1])

    def rate(t, x):
        out = min(max(requested(x), -1.0), high)
        error = 1.0 - x[2]
        return [ki * error + back * (out - requested(x)), (error - x[1]) / tf, x[3] - x[2], out - 2 * x[3]]

    def at_limit(t, x):
        return requested(x) - high

    run = solve_ivp(rate, (0.0, 9.0), np.zeros(4), "DOP853", rtol=1e-12, atol=1e-12, events=at_limit, max_step=0.01)
    exact = [1.0, *(1.0 + run.t_events[0])]
    assert len(exact) >= 2
    assert told(found) == [("u", "above"), ("u", "inside"), ("u", "above"), ("u", "inside")][: len(exact)]
    assert np.abs(times_of(found) - exact).max() <= 1e-7


def test_a_pid_without_limits_declares_nothing():
    pid = cp.create_pid_iosystem(1.0, 1.0, 1.0, 0.1, bias=0.5)
    plant = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="plant")
    assert cp.simulate(ct.interconnect([pid, plant], inputs="r", outputs="y"), T, 1.0).events == []


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_one_limit_of_a_saturation(method):
    block = cp.create_saturation_iosystem(-math.inf, 1.0, inputs="r", outputs="y")
    ramp = cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(4, 2), cp.Waypoint(8, 0)])  # t - t^2/8
    found = cp.simulate(block, T, ramp, method=method)
    root = math.sqrt(8.0)
    assert np.abs(times_of(found) - [4 - root, 4 + root]).max() <= 1e-9
    assert [o.kind for o in found.events] == ["above", "inside"]


# Words


def test_an_occurrence_in_words():
    assert str(Occurrence(1.25, "u", "above")) == "1.25 s: u above its limit"
    assert str(Occurrence(1.25, "u", "inside")) == "1.25 s: u within its limits"
    assert str(Occurrence(0.5, "T", "below", stop=True)) == "0.5 s: T below its limit, where the run ends"


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"signal": "y"}, ValueError, "must have a limit, got neither low nor high"),
        ({"signal": "y", "low": 1.0, "high": 1.0}, ValueError, "low must be below high, got 1.0 and 1.0"),
        ({"signal": "y", "low": 2.0, "high": 1.0}, ValueError, "low must be below high, got 2.0 and 1.0"),
        ({"signal": "y", "high": math.nan}, ValueError, "low must be below high"),
        ({"signal": 3, "high": 1.0}, TypeError, "signal must be a label or a function"),
        ({"signal": None, "high": 1.0}, TypeError, "signal must be a label or a function"),
    ],
)
def test_bad_events(arguments, error, match):
    with pytest.raises(error, match=match):
        Event(**arguments)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("events", "error", "match"),
    [
        ([Event("w", high=1.0)], ValueError, "signal of an event must be among r, x, y, got 'w'"),
        (["y"], TypeError, "events must be Event, got str"),
        ([Event(lambda t, x, u, y: 0.0, high=1.0)], ValueError, r"must return \d+ values, got shape \(\)"),
        ([Event(lambda t, x, u, y: y, high=1.0)], ValueError, r"must return \d+ values, got shape \(1, \d+\)"),
    ],
    ids=["label", "kind", "scalar", "matrix"],
)
def test_bad_events_of_a_run(events, error, match, method):
    with pytest.raises(error, match=match):
        cp.simulate(LAG, T, 1.0, method=method, events=events)


def test_an_event_alone_is_no_sequence():
    with pytest.raises(TypeError, match="events must be"):
        cp.simulate(LAG, T, 1.0, events=Event("y", high=0.5))


# Events that are located when they are read


def limited():
    """Saturated PID of a nonlinear plant: compiled, with events that its blocks declare."""
    plant = ct.nlsys(
        lambda t, x, u, params: np.array([x[1], u[0] - np.sin(x[0])]),
        lambda t, x, u, params: x[:1],
        inputs="u",
        outputs="y",
        states=2,
        name="pendulum",
    )
    limits = cp.create_saturation_iosystem(-1.5, 1.5, inputs="v", outputs="u", name="limits")
    gain = ct.ss([], [], [], [[40.0, -40.0]], inputs=["r", "y"], outputs="v", name="gain")
    return ct.interconnect([gain, limits, plant], inputs="r", outputs=["y", "u"], name="limited")


def test_departures_are_counted_and_the_first_is_located():
    """y = sin t, v = cos t: v is above 0.9 at the start."""
    events = [Event("y", low=-0.5, high=0.5), Event("v", high=0.9, name="far"), Event("y", high=0.99, name="far")]
    later = simulate_for_metrics(OSCILLATOR, T, None, [0.0, 1.0], events=events)[0]
    found = departures_in(later)
    assert [(one.name, one.number) for one in found] == [("far", 4), ("y", 4)]
    assert np.abs([found[0].first, found[1].first - math.pi / 6]).max() <= 1e-11
    assert found == Departures.of(later.events)
    assert departures_in(cp.simulate(OSCILLATOR, T, None, [0.5, 0.0], events=[Event("y", high=0.6)])) == []


@pytest.mark.parametrize("stop", [False, True])
def test_events_read_later_are_those_of_simulate(stop):
    events = [Event("y", high=0.9, stop=stop), Event("y", low=0.25, high=0.75)]
    now = cp.simulate(limited(), T, 1.0, events=events)
    later, end, _ = simulate_for_metrics(limited(), T, 1.0, events=events)
    assert now.method == later.method == "compiled"
    copied = pickle.loads(pickle.dumps(later))
    assert told(later) == told(copied) == told(now)
    assert len(told(now)) > 3
    assert np.abs(times_of(later) - times_of(now)).max() <= 1e-12
    assert [one.name for one in later.events].count("u") > 0
    assert (end is None) == (not stop)
    assert end is None or (end.stop and later.time[-1] == end.time)
    assert np.array_equal(later.time, now.time)
    assert np.array_equal(later.outputs, now.outputs)


@pytest.mark.parametrize("stop", [False, True])
def test_departures_of_events_that_are_not_located_are_those_of_simulate(stop):
    events = [Event("y", high=0.9, stop=stop), Event("y", low=0.25, high=0.75)]
    later = departures_in(simulate_for_metrics(limited(), T, 1.0, events=events)[0])
    every = Departures.of(cp.simulate(limited(), T, 1.0, events=events).events)
    assert [one[:2] for one in later] == [one[:2] for one in every]
    assert np.abs(np.subtract([one.first for one in later], [one.first for one in every])).max() <= 1e-9
    assert max(one.number for one in later) > 1


def test_functions_of_the_user_are_not_called_later():
    calls = []

    def height(t, x, u, y):
        calls.append(t.size)
        return y[0]

    found, *_ = simulate_for_metrics(limited(), T, 1.0, events=[Event(height, high=0.5)])
    count = len(calls)
    assert count
    assert found.events
    assert len(calls) == count


# Roots between two samples


def watched(value):
    """Crossings of 0 by a function of time between two samples, and the number of its values."""
    times, seen = np.array([0.0, 1.0]), []

    def at(k, t):
        seen.append(t)
        return float(value(t))

    entry = Watched("s", lambda snapshot: snapshot.t, -math.inf, 0.0)
    found = list(crossings(entry, times, np.array([float(value(t)) for t in times]), at))
    return found, len(seen)


@pytest.mark.parametrize(
    ("value", "time"),
    [
        (lambda t: t - 0.3, 0.3),
        (lambda t: t**3 - 0.2, 0.2 ** (1 / 3)),
        (lambda t: math.tanh(40 * (t - 0.7)), 0.7),
        (lambda t: math.exp(9 * t) - 50.0, math.log(50.0) / 9),
        (lambda t: t - 0.9 if t < 0.8 else 5 * (t - 0.8) - 0.1, 0.82),
        (lambda t: -1.0 + 0.1 * t if t < 1.0 else 4e4, 1.0),
        (lambda t: -1.0 if t < 0.6 else 2.0, 0.6),
    ],
    ids=["line", "cubic", "tanh", "exponential", "kink", "jump at the sample", "jump between samples"],
)
def test_roots_between_two_samples(value, time):
    found, _ = watched(value)
    assert [o.kind for o in found] == ["above"]
    assert abs(found[0].time - time) <= 2e-12
    assert value(found[0].time) >= 0.0


def test_a_value_between_two_samples_is_computed_once():
    """Its rounding may differ the next time, also in its sign."""
    seen = {}

    def value(t):
        seen[t] = seen.get(t, 0) + 1
        return (t - 0.4) ** 3 + 1e-17 * (-1.0) ** seen[t]

    found, _ = watched(value)
    assert len(found) == 1
    assert abs(found[0].time - 0.4) <= 1e-5
    assert max(count for t, count in seen.items() if 0.0 < t < 1.0) == 1


def test_few_values_locate_a_crossing():
    """A smooth crossing is found by secants, a jump at a sample by a value just before it."""
    assert watched(lambda t: math.exp(t) - 2.0)[1] <= 8
    assert watched(lambda t: -1.0 + 0.1 * t if t < 1.0 else 4e4)[1] <= 6
