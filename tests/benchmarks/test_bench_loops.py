"""Cost of nonlinear loops beside python-control's and hand-written scipy's, interleaved in one process.

The closed crane loop of the study `crane-obstacle`: trigonometric plan, alpha = 4, 30 s, 3001 samples, relative
tolerance 1e-8, absolute 1e-10. Ratios are printed, none is asserted.
"""

import math
from statistics import median
from time import perf_counter

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlplan as cp
from ctrlplan.simulation import prepared
from ctrlplan.studies.crane import CRANE, obstacle_waypoints

PLAN = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
T = np.linspace(0.0, 30.0, 3001)
RTOL, ATOL = 1e-8, 1e-10
ROUNDS = 3


def crane_loop():
    return cp.plants.crane_loop(CRANE, PLAN)


def by_hand(mass=CRANE.load_mass, rtol=RTOL, atol=ATOL):
    """The same loop as one function of plain numbers, LSODA from break to break; states as in `crane_loop`."""
    g, b, friction, drum_friction = CRANE.gravity, CRANE.drum_radius, CRANE.trolley_friction, CRANE.drum_friction
    trolley, inertia, w, tf = CRANE.trolley_mass, CRANE.drum_inertia, 5.0, 0.02
    hoist = inertia / b + CRANE.load_mass * b
    p1, i1, d1 = 3.0 * trolley * w**2, trolley * w**3, 3.0 * trolley * w - friction
    p2, i2, d2 = 3.0 * hoist * w**2, hoist * w**3, 3.0 * hoist * w - drum_friction / b
    bias, final, end = -b * CRANE.load_mass * g, PLAN.final, PLAN.end

    def rates(t, s):
        if t < end:
            jet = PLAN.jet(t, 2)
            x, x2, z, z2 = jet[0, 0], jet[2, 0], jet[0, 1], jet[2, 1]
        else:
            x, x2, z, z2 = final[0], 0.0, final[1], 0.0
        hanging = g - z2
        pull = math.sqrt(x2 * x2 + hanging * hanging)
        e1 = x - (b * pull - z * x2) / hanging - s[4]
        e2 = (z * pull - b * x2) / hanging - s[5]
        force = p1 * e1 + s[0] + d1 / tf * (e1 - s[1])
        torque = bias + p2 * e2 + s[2] + d2 / tf * (e2 - s[3])
        r, theta, d_rate, r_rate, rate = s[5], s[6], s[7], s[8], s[9]
        sine, cosine = math.sin(theta), math.cos(theta)
        d0, dt = (force - friction * d_rate) / trolley, sine / trolley
        swing = -g * sine - 2.0 * r_rate * rate + b * rate * rate
        t0, tt = (swing - cosine * d0) / r, -cosine * dt / r
        r0, rt = b / inertia * (torque - drum_friction * r_rate / b), b * b / inertia
        along = g * cosine + r * rate * rate
        tension = (along - sine * d0 - r0 + b * t0) / (sine * dt + rt + 1.0 / mass - b * tt)
        accelerations = [d0 + dt * tension, r0 + rt * tension, t0 + tt * tension]
        return [i1 * e1, (e1 - s[1]) / tf, i2 * e2, (e2 - s[3]) / tf, d_rate, r_rate, rate, *accelerations]

    state, rows = crane_loop().initial_state, []
    for left, right in ((0.0, end), (end, T[-1])):
        inside = T[(left <= T) & (right >= T)]
        found = solve_ivp(rates, (left, right), state, "LSODA", t_eval=inside, rtol=rtol, atol=atol)
        state = found.y[:, -1]
        rows.append(found.y[:, : -1 if right < T[-1] else None])
    return np.hstack(rows)


def interleaved(*functions):
    """Median seconds of each, run in turn, and their last results."""
    rows = []
    for _ in range(ROUNDS):
        seconds, results = [], []
        for function in functions:
            begin = perf_counter()
            results.append(function())
            seconds.append(perf_counter() - begin)
        rows.append(seconds)
    return [median(column) for column in zip(*rows, strict=True)], results


@pytest.fixture(scope="module")
def tight():
    return by_hand(rtol=1e-12, atol=1e-13)


def worst(response, tight):
    """Greatest error of the crane's positions, relative to their size."""
    states = np.asarray(response.states)[4:7]
    return float(np.max(np.abs(states - tight[4:7]).max(axis=1) / np.abs(tight[4:7]).max(axis=1)))


@pytest.mark.benchmark
def test_nonlinear_loop_beside_input_output_response(benchmark, capsys, tight):
    loop = crane_loop()
    ready = cp.prepare(loop)

    def compiled():
        return cp.simulate(ready, T, method="compiled", rtol=RTOL, atol=ATOL)

    def built():
        prepared._FORMS.clear()
        return cp.simulate(crane_loop(), T, method="compiled", rtol=RTOL, atol=ATOL)

    def interpreted():
        return cp.simulate(ready, T, method="python", rtol=RTOL, atol=ATOL)

    def peer():
        options = {"rtol": RTOL, "atol": ATOL}
        return ct.input_output_response(
            loop, T, 0, loop.initial_state, solve_ivp_method="LSODA", solve_ivp_kwargs=options
        )

    compiled()
    benchmark.pedantic(compiled, rounds=10, warmup_rounds=1)
    (own, building, python, other), (fast, _, plain, theirs) = interleaved(compiled, built, interpreted, peer)
    errors = [worst(response, tight) for response in (fast, plain, theirs)]
    assert errors[0] <= errors[2]
    assert errors[1] <= errors[2]
    benchmark.extra_info |= {"compiled": other / own, "built": other / building, "python": other / python}
    with capsys.disabled():
        print(
            f"\ncrane loop, input_output_response {other:.2f} s (error {errors[2]:.1e}): compiled {1e3 * own:.1f} ms, "
            f"{other / own:.0f} times faster (error {errors[0]:.1e}); with building {1e3 * building:.0f} ms, "
            f"{other / building:.0f} times; python {1e3 * python:.0f} ms, {other / python:.1f} times "
            f"(error {errors[1]:.1e})"
        )


@pytest.mark.benchmark
def test_draws_beside_runs_by_hand(benchmark, capsys, tight):
    """A hundred draws, and eight runs by hand, each scaled to a thousand."""
    count, sample = 100, 8
    table = cp.draws(count, seed=1, load_mass=(400.0, 700.0))
    only = ("settling_time", "overshoot_error")

    def ours():
        return cp.monte_carlo(
            lambda name, plan: cp.plants.crane_loop(CRANE, plan),
            table,
            {"trigonometric": PLAN},
            T,
            progress=False,
            outputs=("x", "z"),
            controls=("F", "C"),
            measures=only,
        )

    def peer():
        return [by_hand(mass) for mass in table["load_mass"][:sample]]

    benchmark.pedantic(ours, rounds=1, warmup_rounds=1)
    (own, other), (found, rows) = interleaved(ours, peer)
    own, other = 1000.0 / count * own, 1000.0 / sample * other
    assert not found.failures
    overshoot = [100.0 * max(0.0, np.max(np.sign(20.0) * (x_load(states) - PLAN(T)[0]))) / 20.0 for states in rows]
    x_overshoot = found.metrics["trigonometric"]["overshoot_error_x"][:sample]
    assert np.abs(x_overshoot - overshoot).max() <= 1e-3
    benchmark.extra_info["ratio"] = other / own
    with capsys.disabled():
        print(f"\n1000 draws with metrics: {own:.1f} s, by hand {other:.0f} s, {other / own:.1f} times faster")


def x_load(states):
    d, r, theta = states[4:7]
    return d + r * np.sin(theta) + CRANE.drum_radius * np.cos(theta)
