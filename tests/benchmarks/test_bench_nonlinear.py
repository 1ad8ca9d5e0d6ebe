"""Nonlinear loops compared with right-hand sides written by hand, in turn in one process; ratios of CPU time are
printed, none is asserted.

Compiled loops: the same equations as CasADi functions, solved by CVODES from breakpoint to breakpoint. Loops by Python:
one function of plain numbers, solved by LSODA. The tolerances of the peers are those at which their errors are about
those of `simulate`, whose own are a hundredth of the requested ones.
"""

import math
from itertools import pairwise

import casadi as ca
import control as ct
import numpy as np
import pytest
from in_turn import in_turn
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import ctrlplan as cp
from ctrlplan.simulation.interpreted import Interpreted
from ctrlplan.studies.crane import CRANE, obstacle_waypoints
from ctrlplan.studies.measures import SignalRecord, signal_metrics, wanted_measures

ROUNDS = 5


def interleaved(ours, peer, rounds=ROUNDS):
    """Minimum seconds of both, run in turn, and their last results."""
    rows, results = in_turn(ours, peer, rounds)
    return [min(column) for column in zip(*rows, strict=True)], results


def worst(found, tight):
    """Largest error of any row relative to its largest value."""
    found, tight = np.atleast_2d(found), np.atleast_2d(tight)
    return float((np.abs(found - tight).max(axis=1) / np.abs(tight).max(axis=1)).max())


def show(capsys, benchmark, what, seconds, errors):
    benchmark.extra_info["ratio"] = seconds[0] / seconds[1]
    with capsys.disabled():
        print(
            f"\n{what}: {1e3 * seconds[0]:.2f} ms, by hand {1e3 * seconds[1]:.2f} ms, "
            f"ratio {seconds[0] / seconds[1]:.2f}; errors {errors[0]:.1e} and {errors[1]:.1e}"
        )


def solved_by_cvodes(rates, state, times, breaks, tolerance, parameter=None):
    """Function that integrates rates(t, x, segment) from break to break, of CasADi symbols; built once.

    With the symbol of a parameter, it is a function of its value.
    """
    runs = []
    for k, (left, right) in enumerate(pairwise([times[0], *breaks, times[-1]])):
        grid = np.union1d(times[(times > left) & (times <= right)], right)
        t, x = ca.SX.sym("t"), ca.SX.sym("x", len(state))
        equations = {"t": t, "x": x, "ode": rates(t, x, k)} | ({} if parameter is None else {"p": parameter})
        options = {"reltol": tolerance, "abstol": 1e-2 * tolerance, "linear_multistep_method": "adams"}
        options["max_num_steps"] = 100_000
        runs.append((ca.integrator("run", "cvodes", equations, left, grid, options), np.isin(grid, times)))

    def run(value=0.0):
        x, rows = np.asarray(state), [np.asarray(state)[:, None]]
        for integrator, chosen in runs:
            found = np.asarray(integrator(x0=x, **({} if parameter is None else {"p": value}))["xf"])
            x = found[:, -1]
            rows.append(found[:, chosen])
        return np.hstack(rows)

    return run


def solved_by_python(rates, state, times, breaks, tolerance, method="LSODA", as_list=True):
    """States at the times, by solve_ivp from break to break; rates(t, x, segment) of plain numbers or of an array."""
    state, rows = np.asarray(state, dtype=float), [np.asarray(state, dtype=float)[:, None]]
    options = {"rtol": tolerance, "atol": 1e-2 * tolerance}
    for k, (left, right) in enumerate(pairwise([times[0], *breaks, times[-1]])):
        grid = np.union1d(times[(times > left) & (times <= right)], right)
        found = solve_ivp(
            lambda t, x, k=k: rates(t, x.tolist() if as_list else x, k), (left, right), state, method, grid, **options
        )
        state = found.y[:, -1]
        rows.append(found.y[:, np.isin(grid, times)])
    return np.hstack(rows)


class PLAIN:
    """Functions of plain numbers."""

    sin, cos, tanh, sqrt, fmin, fmax = math.sin, math.cos, math.tanh, math.sqrt, min, max


CASADI = ca
"""The same of CasADi's symbols."""


# The crane of the study


PLAN = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
T = np.linspace(0.0, 30.0, 3001)


def planned(t, segment, m):
    """x, x'', z, z'' of the load by equation (2), the harmonics by one sine and one cosine."""
    if segment:
        return PLAN.final[0], 0.0, PLAN.final[1], 0.0
    tau = RATE * (t - PLAN.start)
    c1, s1 = m.cos(tau), m.sin(tau)
    c, s, found = c1, s1, [FOURIER.a0[0], 0.0, FOURIER.a0[1], 0.0]
    for k, ((ax, az), (bx, bz)) in enumerate(HARMONICS, 1):
        x, z, factor = ax * c + bx * s, az * c + bz * s, (k * RATE) ** 2
        found = [found[0] + x, found[1] - factor * x, found[2] + z, found[3] - factor * z]
        c, s = c * c1 - s * s1, s * c1 + c * s1
    return found


def harmonics():
    """(a_x, a_z), (b_x, b_z) of each harmonic; the last one is a_m sin m(tau - gamma)."""
    m, gamma = FOURIER.m[0], FOURIER.gamma
    top = (-FOURIER.am * np.sin(m * gamma), FOURIER.am * np.cos(m * gamma))
    return np.concatenate([np.stack([FOURIER.a.T, FOURIER.b.T], axis=1), [top]]).tolist()


FOURIER, RATE = PLAN.fourier(), PLAN.alpha / PLAN.duration
HARMONICS = harmonics()
TROLLEY, INERTIA, DRUM, G = CRANE.trolley_mass, CRANE.drum_inertia, CRANE.drum_radius, CRANE.gravity
LOAD, F1, F2 = CRANE.load_mass, CRANE.trolley_friction, CRANE.drum_friction
W, TF, HOIST = 5.0, 0.02, INERTIA / DRUM + LOAD * DRUM


def planned_by_jet(t, segment, m):
    """The same read from the plan."""
    if segment:
        return PLAN.final[0], 0.0, PLAN.final[1], 0.0
    jet = PLAN.jet(t, 2)
    return jet[0, 0], jet[2, 0], jet[0, 1], jet[2, 1]


def crane_rates(t, s, segment, m=PLAIN, mass=LOAD, reference=planned):
    """Generator, two PIDs and crane; states as in `crane_loop`."""
    x, x2, z, z2 = reference(t, segment, m)
    hanging = G - z2
    pull = m.sqrt(x2 * x2 + hanging * hanging)
    e1 = x - (DRUM * pull - z * x2) / hanging - s[4]
    e2 = (z * pull - DRUM * x2) / hanging - s[5]
    p1, i1, d1 = 3.0 * TROLLEY * W**2, TROLLEY * W**3, 3.0 * TROLLEY * W - F1
    p2, i2, d2 = 3.0 * HOIST * W**2, HOIST * W**3, 3.0 * HOIST * W - F2 / DRUM
    force = p1 * e1 + s[0] + d1 / TF * (e1 - s[1])
    torque = -DRUM * LOAD * G + p2 * e2 + s[2] + d2 / TF * (e2 - s[3])
    r, theta, d_rate, r_rate, rate = s[5], s[6], s[7], s[8], s[9]
    sine, cosine = m.sin(theta), m.cos(theta)
    d0, dt = (force - F1 * d_rate) / TROLLEY, sine / TROLLEY
    swing = -G * sine - 2.0 * r_rate * rate + DRUM * rate * rate
    t0, tt = (swing - cosine * d0) / r, -cosine * dt / r
    r0, rt = DRUM / INERTIA * (torque - F2 * r_rate / DRUM), DRUM * DRUM / INERTIA
    along = G * cosine + r * rate * rate
    tension = (along - sine * d0 - r0 + DRUM * t0) / (sine * dt + rt + 1.0 / mass - DRUM * tt)
    accelerations = [d0 + dt * tension, r0 + rt * tension, t0 + tt * tension]
    return [i1 * e1, (e1 - s[1]) / TF, i2 * e2, (e2 - s[3]) / TF, d_rate, r_rate, rate, *accelerations]


def in_casadi(rates, **given):
    return lambda t, x, segment: ca.vertcat(*rates(t, ca.vertsplit(x), segment, CASADI, **given))


@pytest.fixture(scope="module")
def crane():
    """The prepared loop and its states at tight tolerances."""
    loop = cp.plants.crane_loop(CRANE, PLAN)
    tight = solved_by_python(crane_rates, loop.initial_state, T, [PLAN.end], 1e-13, "DOP853")
    return cp.prepare(loop), tight


EIGHT = (
    *("settling_time", "tracking_settling_time", "overshoot_error", "overshoot_final", "iae", "itae"),
    *("control_peak", "control_effort"),
)
SEEN = ("x", "z"), ("F", "C")
"""Outputs that follow the plan, and controls."""


@pytest.mark.benchmark
def test_draws_with_metrics(benchmark, capsys, crane):
    """Draws of the load mass by `monte_carlo` with eight metrics, compared with runs by hand without any.

    A thousand draws are to cost at most 1.65 times CasADi and CVODES, and at most 1/13 of LSODA at the tolerance 1e-8
    with a right-hand side that reads the plan, `PLAN.jet(t, 2)`: the run by hand of the first benchmark of draws. A
    right-hand side with the sum of harmonics written out is leaner; its tolerance is that of CVODES. The draws beyond
    the first 32 cost what each of a thousand does: metrics of 32 draws are computed together.
    """
    ready, _ = crane
    masses = np.linspace(400.0, 700.0, 128)
    symbol = ca.SX.sym("m")
    peer = solved_by_cvodes(in_casadi(crane_rates, mass=symbol), ready.initial_state, T, [PLAN.end], 1e-10, symbol)

    def ours(count=masses.size):
        plans, options = {"trigonometric": PLAN}, {"outputs": ("x", "z"), "controls": ("F", "C"), "progress": False}
        return cp.monte_carlo(
            lambda name, plan: cp.plants.crane_loop(CRANE, plan),
            {"load_mass": masses[:count]},
            plans,
            T,
            measures=EIGHT,
            **options,
        )

    def by_lsoda(mass, tolerance=1e-10, reference=planned):
        def rates(t, x, k):
            return crane_rates(t, x, k, mass=mass, reference=reference)

        return solved_by_python(rates, ready.initial_state, T, [PLAN.end], tolerance)

    def by_jet():
        return [by_lsoda(mass, 1e-8, planned_by_jet) for mass in masses[:slowly]]

    benchmark.pedantic(ours, rounds=1, warmup_rounds=1)
    first, slowly = 32, 2
    whole, (found, expected) = interleaved(ours, lambda: [peer(mass) for mass in masses], 4)
    building, (_, slow) = interleaved(lambda: ours(first), lambda: [by_lsoda(mass) for mass in masses[:slowly]], 4)
    assert max(worst(a, b) for a, b in zip(expected[:slowly], slow, strict=True)) <= 1e-7
    reading, (_, read) = interleaved(lambda: ours(first), by_jet, 4)
    assert max(worst(a, b) for a, b in zip(expected[:slowly], read, strict=True)) <= 1e-5
    building[0] = min(building[0], reading[0])
    loads = [s[4] + s[5] * np.sin(s[6]) + DRUM * np.cos(s[6]) for s in expected]
    ahead = np.max(loads - PLAN(T)[0], axis=1)
    overshoots = found.metrics["trigonometric"]["overshoot_error_x"]
    assert np.abs(overshoots - 100.0 * np.maximum(ahead, 0.0) / 20.0).max() <= 1e-3
    own = (whole[0] - building[0]) / (masses.size - first)  # without what is done once: two counts
    cvodes, lsoda, jets = whole[1] / masses.size, building[1] / slowly, reading[1] / slowly
    benchmark.extra_info |= {"CVODES": own / cvodes, "LSODA": jets / own, "LSODA, written out": lsoda / own}
    with capsys.disabled():
        print(
            f"\ncrane, a draw with eight metrics: {1e3 * own:.2f} ms, by hand with CasADi and CVODES "
            f"{1e3 * cvodes:.2f} ms, ratio {own / cvodes:.2f}; with LSODA that reads the plan {1e3 * jets:.0f} ms, "
            f"1/{jets / own:.1f}; with its harmonics written out {1e3 * lsoda:.0f} ms, 1/{lsoda / own:.1f}"
        )


@pytest.mark.benchmark
def test_metrics_of_draws(benchmark, capsys, crane):
    """Eight metrics of many draws together, and of one, next to a compiled run. Goal: a tenth of it for each draw."""
    ready, _ = crane
    masses = np.linspace(400.0, 700.0, 87)
    found = [cp.simulate(ready, T, params={"load_mass": mass}) for mass in masses.tolist()]
    y, u = (np.stack([[run.outputs[ready.output_labels.index(name)] for name in own] for run in found]) for own in SEEN)

    def metrics(some):
        unstable = np.zeros(len(y[some]), dtype=bool)
        record = SignalRecord(T, y[some], u[some], *SEEN, unstable)
        return signal_metrics(record, [PLAN], 0.0, 0.02, wanted_measures(EIGHT))

    def ours():
        return metrics(slice(None))

    def run():
        return cp.simulate(ready, T, method="compiled")

    benchmark.pedantic(ours, rounds=1, warmup_rounds=1)
    (together, whole), (every, _) = interleaved(ours, run, 10)
    (alone, _), (one, _) = interleaved(lambda: metrics(slice(3, 4)), run, 10)
    assert all(every[name][3] == value[0] for name, value in one.items())
    each = together / masses.size
    benchmark.extra_info["ratio"] = each / whole
    with capsys.disabled():
        print(
            f"\neight metrics: {1e3 * each:.2f} ms a draw of {masses.size}, {1e3 * alone:.2f} ms of one run; "
            f"{each / whole:.3f} and {alone / whole:.2f} of a compiled run"
        )


class CraneBlocks:
    """Loop whose right-hand side and outputs, written by hand, call the functions of the blocks in order."""

    def __init__(self, loop):
        _, generator, trolley, hoist, crane = loop.syslist
        self.generator, self.hoist = generator.outfcn, (hoist.updfcn, hoist.outfcn)
        self.crane, self.matrices = (crane.updfcn, crane.outfcn), (trolley.A, trolley.B, trolley.C, trolley.D)
        self.params = loop.params
        self.calls = 0

    def signals(self, t, s, segment):
        """References, force, torque and the outputs of the crane."""
        self.calls += 1
        x, x2, z, z2 = planned(t, segment, PLAIN)
        planned_values = np.array([x, 0.0, x2, z, 0.0, z2])  # the generator reads no first derivative
        reference = self.generator(t, s[:0], planned_values, self.params)
        before = self.crane[1](t, s[4:], np.zeros(2), self.params)
        _, _, c, d = self.matrices
        trolley, hoist = np.array([reference[0], before[2]]), np.array([reference[1], before[3]])
        force, torque = c @ s[:2] + d @ trolley, self.hoist[1](t, s[2:4], hoist, self.params)
        return planned_values, trolley, hoist, np.array([force[0], torque[0]])

    def rates(self, t, s, segment):
        _, trolley, hoist, inputs = self.signals(t, s, segment)
        a, b, _, _ = self.matrices
        parts = a @ s[:2] + b @ trolley, self.hoist[0](t, s[2:4], hoist, self.params)
        return np.concatenate([*parts, self.crane[0](t, s[4:], inputs, self.params)])

    def outputs(self, t, s, segment):
        planned_values, _, _, inputs = self.signals(t, s, segment)
        outputs = self.crane[1](t, s[4:], inputs, self.params)
        return np.concatenate([outputs, inputs, planned_values[[0, 3]]])

    def alone(self, states):
        """Calls of the functions of the blocks, as many as in a run, without anything else."""
        s, u, two = states[:, 0], np.zeros(6), np.ones(2)
        u[3] = 1.0
        for _ in range(self.calls):
            self.generator(0.0, s[:0], u, self.params)
            self.crane[1](0.0, s[4:], two, self.params)
            self.hoist[1](0.0, s[2:4], two, self.params)
            self.hoist[0](0.0, s[2:4], two, self.params)
            self.crane[0](0.0, s[4:], two, self.params)


def evaluations(run, monkeypatch):
    """Number of times at which a run by Python evaluates the signals, for derivatives or outputs."""
    count, evaluated = 0, Interpreted._signals

    def counted(*arguments):
        nonlocal count
        count += 1
        return evaluated(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(Interpreted, "_signals", counted)
        run()
    return count


@pytest.mark.benchmark
def test_crane_by_compiled(benchmark, capsys, crane):
    ready, tight = crane
    peer = solved_by_cvodes(in_casadi(crane_rates), ready.initial_state, T, [PLAN.end], 1e-10)

    def ours():
        return cp.simulate(ready, T, method="compiled")

    benchmark.pedantic(ours, rounds=3, warmup_rounds=3)
    seconds, (found, theirs) = interleaved(ours, peer)
    errors = worst(found.states, tight), worst(theirs, tight)
    assert max(errors) <= 1e-8
    show(capsys, benchmark, "crane, compiled, 3001 samples", seconds, errors)


@pytest.mark.benchmark
def test_draws_by_compiled(benchmark, capsys, crane):
    """Draws of the load mass, one run each."""
    ready, _ = crane
    masses = np.linspace(400.0, 700.0, 20).tolist()
    symbol = ca.SX.sym("m")
    rates = in_casadi(crane_rates, mass=symbol)
    peer = solved_by_cvodes(rates, ready.initial_state, T, [PLAN.end], 1e-10, symbol)

    def ours():
        return [cp.simulate(ready, T, method="compiled", params={"load_mass": mass}).states for mass in masses]

    def theirs():
        return [peer(mass) for mass in masses]

    benchmark.pedantic(ours, rounds=1, warmup_rounds=1)
    seconds, (found, expected) = interleaved(ours, theirs, 3)
    apart = max(worst(a, b) for a, b in zip(found, expected, strict=True))
    assert apart <= 1e-7
    show(capsys, benchmark, "20 draws of the crane, compiled", seconds, (apart, apart))


@pytest.mark.benchmark
def test_crane_by_python(benchmark, capsys, crane, monkeypatch):
    """Next to plain numbers, and to the functions of the blocks with vectors, called by hand once each in order.

    LSODA may continue with its method for stiff equations long after the first transient, which rounding decides: a
    run then has a third more evaluations. The same functions are therefore compared by evaluation.
    """
    ready, tight = crane
    loop = CraneBlocks(cp.plants.crane_loop(CRANE, PLAN))

    def ours():
        return cp.simulate(ready, T, method="python")

    def peer():
        return solved_by_python(crane_rates, ready.initial_state, T, [PLAN.end], 1e-10)

    def by_blocks():
        loop.calls = 0
        states = solved_by_python(loop.rates, ready.initial_state, T, [PLAN.end], 1e-10, as_list=False)
        places = zip(T.tolist(), states.T, (PLAN.end <= T).tolist(), strict=True)
        return states, np.array([loop.outputs(*place) for place in places]).T

    benchmark.pedantic(ours, rounds=1, warmup_rounds=1)
    seconds, (found, theirs) = interleaved(ours, peer, 3)
    errors = worst(found.states, tight), worst(theirs, tight)
    assert max(errors) <= 1e-7
    show(capsys, benchmark, "crane, python, 3001 samples", seconds, errors)
    seconds, (found, (states, outputs)) = interleaved(ours, by_blocks, 3)
    assert worst(found.outputs, outputs) <= 1e-6
    show(capsys, benchmark, "  next to the same functions by hand", seconds, (errors[0], worst(states, tight)))
    count = evaluations(ours, monkeypatch)
    each = seconds[0] / count, seconds[1] / loop.calls
    benchmark.extra_info["ratio"] = each[0] / each[1]
    with capsys.disabled():
        print(
            f"  by evaluation: {1e6 * each[0]:.1f} us ({count}), by hand {1e6 * each[1]:.1f} us ({loop.calls}), "
            f"ratio {each[0] / each[1]:.2f}"
        )
    parts, _ = interleaved(lambda: loop.alone(states), peer, 3)
    with capsys.disabled():
        print(f"  the functions alone: {1e3 * parts[0]:.1f} ms, {parts[0] / parts[1]:.2f} of plain numbers")


# A saturated loop and an aircraft that takes off and lands vertically


SHORT = np.linspace(0.0, 20.0, 2001)
EPS = 0.3


def quintic(t, first, last, distance):
    s = (t - first) / (last - first)
    return distance * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def saturated_loop():
    plan = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(1.5, 3, 0, 0)], labels=["r"])
    law = ct.ss([], [], [], [[4.0, -4.0, -2.0]], inputs=["r", "x", "v"], outputs="u_cmd", name="law", dt=None)
    plant = ct.ss([[0, 1], [0, -1]], [[0], [1]], np.eye(2), 0, inputs="u", outputs=["x", "v"], name="plant")
    blocks = [cp.create_source_iosystem(plan), law, cp.create_saturation_iosystem(-0.5, 2.0), plant]
    return ct.interconnect(blocks, inputs=0, outputs=["x", "u"])


def saturated_rates(t, x, segment, m):
    r = quintic(t, 0.5, 1.5, 3.0) if segment == 1 else 0.0 if segment == 0 else 3.0
    return [x[1], -x[1] + m.fmin(m.fmax(4.0 * (r - x[0]) - 2.0 * x[1], -0.5), 2.0)]


def command(t, x, segment):
    """Input of the saturation, of plain numbers or arrays."""
    r = quintic(t, 0.5, 1.5, 3.0) if segment == 1 else 0.0 if segment == 0 else 3.0
    return 4.0 * (r - x[0]) - 2.0 * x[1]


def saturated_with_crossings(run, breaks, tolerance):
    """States of a run by hand, and the times at which the command crosses a limit.

    Each is located by brentq and CVODES from the last sample, to rounding, as in `simulate`.
    """
    s, x, p = ca.SX.sym("s"), ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    options = {"reltol": tolerance, "abstol": 1e-2 * tolerance, "linear_multistep_method": "adams"}
    steps = [
        ca.integrator(
            "step",
            "cvodes",
            {"t": s, "x": x, "p": p, "ode": p[1] * in_casadi(saturated_rates)(p[0] + s * p[1], x, k)},
            0.0,
            1.0,
            options,
        )
        for k in range(3)
    ]

    def found():
        states = run()
        segments = np.searchsorted(breaks, SHORT, side="right")
        u = np.concatenate([command(SHORT[segments == k], states[:, segments == k], k) for k in range(3)])
        sides, times = (u > 2.0).astype(int) - (u < -0.5), []
        for k in np.flatnonzero(np.diff(sides)).tolist():
            level, segment = 2.0 if max(sides[k : k + 2]) > 0 else -0.5, segments[k]

            def beyond(t, k=k, level=level, segment=segment):
                state = states[:, k]
                if t > SHORT[k]:
                    state = np.asarray(steps[segment](x0=state, p=[SHORT[k], t - SHORT[k]])["xf"])[:, 0]
                return command(t, state, segment) - level

            times.append(brentq(beyond, SHORT[k], SHORT[k + 1], xtol=1e-14, rtol=1e-14))
        return states, times

    return found


@pytest.mark.benchmark
def test_saturated_loop_with_its_events(benchmark, capsys):
    """The peer locates the same crossings of the limits."""
    ready, breaks = cp.prepare(saturated_loop()), [0.5, 1.5]
    run = solved_by_cvodes(in_casadi(saturated_rates), [0.0] * 2, SHORT, breaks, 1e-10)
    peer = saturated_with_crossings(run, breaks, 1e-10)
    tight = solved_by_python(lambda t, x, k: saturated_rates(t, x, k, PLAIN), [0.0] * 2, SHORT, breaks, 1e-13, "DOP853")

    def ours():
        return cp.simulate(ready, SHORT, None, [0.0] * 2, method="compiled")

    benchmark.pedantic(ours, rounds=3, warmup_rounds=3)
    seconds, (found, (states, times)) = interleaved(ours, peer, 20)
    errors = worst(found.states, tight), worst(states, tight)
    assert max(errors) <= 1e-8
    assert len(times) == 4
    assert [event.time for event in found.events] == pytest.approx(times, abs=1e-7)
    show(capsys, benchmark, "saturated loop with its events, 2001 samples", seconds, errors)


def pvtol(t, x, u, params):
    s, c = np.sin(x[2]), np.cos(x[2])
    return np.array([x[3], x[4], x[5], -u[0] * s + EPS * u[1] * c, u[0] * c + EPS * u[1] * s - 1.0, u[1]])


def hover(t, x, u, params):
    """Height by thrust, position by tilt."""
    z_ref, px, pz, th, vx, vz, w = (u[k] for k in range(7))
    thrust = (1.0 + 2.0 * (z_ref - pz) - 2.0 * vz) / np.cos(th)
    return np.array([thrust, 9.0 * (0.3 * np.tanh(px + 1.5 * vx) - th) - 5.0 * w])


def pvtol_loop():
    names = ["px", "pz", "th", "vx", "vz", "w"]
    plan = cp.PolySpline([cp.Waypoint(1, 0, 0, 0), cp.Waypoint(3, 2, 0, 0)], labels=["z_ref"])
    plant = ct.nlsys(pvtol, None, inputs=["u1", "u2"], outputs=names, states=6, name="pvtol")
    law = ct.nlsys(None, hover, inputs=["z_ref", *names], outputs=["u1", "u2"], name="hover", dt=None)
    return ct.interconnect([plant, law, cp.create_source_iosystem(plan)], inputs=0, outputs=[*names, "u1", "u2"])


def pvtol_rates(t, x, segment, m):
    z_ref = quintic(t, 1.0, 3.0, 2.0) if segment == 1 else 0.0 if segment == 0 else 2.0
    thrust = (1.0 + 2.0 * (z_ref - x[1]) - 2.0 * x[4]) / m.cos(x[2])
    moment = 9.0 * (0.3 * m.tanh(x[0] + 1.5 * x[3]) - x[2]) - 5.0 * x[5]
    s, c = m.sin(x[2]), m.cos(x[2])
    return [x[3], x[4], x[5], -thrust * s + EPS * moment * c, thrust * c + EPS * moment * s - 1.0, moment]


@pytest.mark.benchmark
@pytest.mark.parametrize(
    ("name", "loop", "rates", "start", "breaks", "events"),
    [
        ("saturated loop without events", saturated_loop, saturated_rates, [0.0] * 2, [0.5, 1.5], ()),
        ("PVTOL", pvtol_loop, pvtol_rates, [1.0, 0.5, -0.2, 0.0, 0.3, 0.1], [1.0, 3.0], None),
    ],
)
def test_short_loops_by_compiled(name, loop, rates, start, breaks, events, benchmark, capsys):
    ready = cp.prepare(loop())
    peer = solved_by_cvodes(in_casadi(rates), start, SHORT, breaks, 1e-10)
    tight = solved_by_python(lambda t, x, k: rates(t, x, k, PLAIN), start, SHORT, breaks, 1e-13, "DOP853")

    def ours():
        return cp.simulate(ready, SHORT, None, start, method="compiled", events=events)

    benchmark.pedantic(ours, rounds=3, warmup_rounds=3)
    seconds, (found, theirs) = interleaved(ours, peer, 20)
    errors = worst(found.states, tight), worst(theirs, tight)
    assert max(errors) <= 1e-8
    show(capsys, benchmark, f"{name}, 2001 samples", seconds, errors)


# A pendulum with a sampled law, and with samples as its input


PERIOD = 0.01
AT_SAMPLES = np.linspace(0.0, 10.0, 1001)
SWING = cp.PolySpline([cp.Waypoint(0.5, 0, 0, 0), cp.Waypoint(4.5, 1.0, 0, 0)], labels=["r"])
LAW = ([[1, 0], [0, 0.6]], [[PERIOD, -PERIOD], [0.4, -0.4]], [[30.0, -60.0]], [[100.0, -100.0]])


def pendulum(t, x, u, params):
    return [x[1], -9.81 * np.sin(x[0]) - 0.3 * x[1] * np.abs(x[1]) + u[0]]


def pendulum_block():
    return ct.nlsys(pendulum, None, inputs="u", outputs=["q", "w"], states=2, name="pendulum")


def sampled_by_hand(method, rtol, atol):
    """solve_ivp from sample to sample."""
    x, xi, out, r = np.zeros(2), [0.0, 0.0], np.empty((2, AT_SAMPLES.size)), SWING(AT_SAMPLES).tolist()
    times = AT_SAMPLES.tolist()
    for k, (left, right) in enumerate(pairwise([*times, times[-1]])):
        out[:, k] = x
        if right == left:
            return out
        e = r[k] - x[0]
        u = 30.0 * xi[0] - 60.0 * xi[1] + 100.0 * e
        xi = [xi[0] + PERIOD * e, 0.6 * xi[1] + 0.4 * e]

        def rates(t, s, u=u):
            return s[1], -9.81 * math.sin(s[0]) - 0.3 * s[1] * abs(s[1]) + u

        x = solve_ivp(rates, (left, right), x, method, rtol=rtol, atol=atol).y[:, -1]
    return out


@pytest.mark.benchmark
def test_sampled_law(benchmark, capsys):
    """solve_ivp at its own best: RK45, whose steps are shorter than a period anyway."""
    names = {"inputs": ["r", "q"], "outputs": "u", "name": "law"}
    law = cp.sample_hold(ct.ss(*LAW, PERIOD, **names), PERIOD)
    ready = cp.prepare(ct.interconnect([pendulum_block(), law], inputs="r", outputs=["q", "w", "u"]))

    def ours():
        return cp.simulate(ready, AT_SAMPLES, SWING)

    def peer():
        return sampled_by_hand("RK45", 1e-8, 1e-10)

    benchmark.pedantic(ours, rounds=1, warmup_rounds=3)
    seconds, (found, theirs) = interleaved(ours, peer, 3)
    tight = sampled_by_hand("DOP853", 1e-13, 1e-14)
    errors = worst(found.states[:2], tight), worst(theirs, tight)
    assert found.method == "compiled"
    assert max(errors) <= 1e-8
    show(capsys, benchmark, "sampled law, 1000 periods", seconds, errors)


def driven(samples, tolerance):
    """The pendulum with interpolated samples by hand, as one segment."""

    def rates(t, x):
        torque = np.interp(t, T, samples)
        return x[1], -9.81 * math.sin(x[0]) - 0.3 * x[1] * abs(x[1]) + torque

    options = {"rtol": tolerance, "atol": 1e-2 * tolerance}
    return solve_ivp(rates, (T[0], T[-1]), [0.0, 0.0], "LSODA", T, **options).y


def driven_line_by_line(samples):
    """The same with tight tolerances, from sample to sample."""
    x = np.zeros(2)
    out = [x]
    for (left, first), (right, last) in pairwise(zip(T.tolist(), samples.tolist(), strict=True)):

        def rates(t, s, left=left, first=first, slope=(last - first) / (right - left)):
            return s[1], -9.81 * math.sin(s[0]) - 0.3 * s[1] * abs(s[1]) + first + slope * (t - left)

        x = solve_ivp(rates, (left, right), x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        out.append(x)
    return np.array(out).T


@pytest.mark.benchmark
@pytest.mark.parametrize("kind", ["31 knots", "random"])
def test_samples_as_input(kind, benchmark, capsys):
    rng = np.random.default_rng(0)
    knots, torques = np.linspace(0.0, 30.0, 31), rng.uniform(-5.0, 5.0, 31)
    samples = np.interp(T, knots, torques) if kind == "31 knots" else rng.uniform(-5.0, 5.0, T.size)
    ready = cp.prepare(pendulum_block())

    def ours():
        return cp.simulate(ready, T, samples)

    def peer():
        return driven(samples, 1e-9)

    benchmark.pedantic(ours, rounds=1, warmup_rounds=3)
    seconds, (found, theirs) = interleaved(ours, peer, 2)
    tight = driven_line_by_line(samples)
    errors = worst(found.states, tight), worst(theirs, tight)
    assert errors[0] <= 1e-8
    assert errors[1] <= 1e-5
    show(capsys, benchmark, f"input of 3001 samples, {kind}", seconds, errors)


@pytest.mark.benchmark
def test_samples_on_lines_next_to_a_plan(benchmark, capsys):
    """31 knots sampled at 3001 times, next to a plan with as many segments."""
    rng = np.random.default_rng(0)
    knots, torques = np.linspace(0.0, 30.0, 31), rng.uniform(-5.0, 5.0, 31)
    samples = np.interp(T, knots, torques)
    points = [cp.Waypoint(t, torque, 0, 0) for t, torque in zip(knots.tolist(), torques.tolist(), strict=True)]
    plan, ready = cp.PiecewiseSpline(points), cp.prepare(pendulum_block())

    def ours():
        return cp.simulate(ready, T, samples)

    def other():
        return cp.simulate(ready, T, plan)

    benchmark.pedantic(ours, rounds=1, warmup_rounds=3)
    seconds, _ = interleaved(ours, other)
    with capsys.disabled():
        print(f"\nsamples on 30 lines: {1e3 * seconds[0]:.1f} ms, plan of 30 segments {1e3 * seconds[1]:.1f} ms")
