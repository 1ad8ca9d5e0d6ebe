"""Nonlinear loops compared with right-hand sides written by hand, in turn in one process; ratios of CPU time are
printed, none is asserted.

Compiled loops: the same equations as CasADi functions, solved by CVODES from breakpoint to breakpoint. Loops by Python:
one function of plain numbers, solved by LSODA. The tolerances of the peers are those at which their errors are about
those of `simulate`, whose own are a hundredth of the requested ones.
"""

import math
from itertools import pairwise
from statistics import median
from time import process_time

import casadi as ca
import control as ct
import numpy as np
import pytest
from scipy.integrate import LSODA, solve_ivp

import ctrlplan as cp
from ctrlplan.studies.crane import CRANE, obstacle_waypoints

ROUNDS = 5


def interleaved(ours, peer, rounds=ROUNDS):
    """Minimum seconds of both, run in turn, and their last results."""
    rows = []
    for _ in range(rounds):
        seconds, results = [], []
        for function in (ours, peer):
            begin = process_time()
            results.append(function())
            seconds.append(process_time() - begin)
        rows.append(seconds)
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


def solved_by_cvodes(rates, state, times, breaks, rtol, atol, kind="adams"):
    """Function that integrates rates(t, x, segment) of CasADi symbols from break to break, built once."""
    runs = []
    for k, (left, right) in enumerate(pairwise([times[0], *breaks, times[-1]])):
        grid = np.union1d(times[(times > left) & (times <= right)], right)
        t, x = ca.SX.sym("t"), ca.SX.sym("x", len(state))
        equations = {"t": t, "x": x, "ode": rates(t, x, k)}
        options = {"reltol": rtol, "abstol": atol, "linear_multistep_method": kind, "max_num_steps": 100_000}
        runs.append((ca.integrator("run", "cvodes", equations, left, grid, options), np.isin(grid, times)))

    def run():
        x, rows = np.asarray(state), [np.asarray(state)[:, None]]
        for integrator, asked in runs:
            found = np.asarray(integrator(x0=x)["xf"])
            x = found[:, -1]
            rows.append(found[:, asked])
        return np.hstack(rows)

    return run


# The crane of the study


PLAN = cp.TrigSpline(obstacle_waypoints(), alpha=4.0)
T = np.linspace(0.0, 30.0, 3001)




def planned(t, segment, sin=math.sin, cos=math.cos):
    """x, x'', z, z'' of the load by equation (2), the harmonics by one sine and one cosine."""
    if segment:
        return PLAN.final[0], 0.0, PLAN.final[1], 0.0
    tau = RATE * (t - PLAN.start)
    c1, s1 = cos(tau), sin(tau)
    c, s, found = c1, s1, [C.a0[0], 0.0, C.a0[1], 0.0]
    for k, ((ax, az), (bx, bz)) in enumerate(HARMONICS, 1):
        x, z, factor = ax * c + bx * s, az * c + bz * s, (k * RATE) ** 2
        found = [found[0] + x, found[1] - factor * x, found[2] + z, found[3] - factor * z]
        c, s = c * c1 - s * s1, s * c1 + c * s1
    return found


def harmonics():
    """(a_x, a_z), (b_x, b_z) of each harmonic; the last one is a_m sin m(tau - gamma)."""
    m, gamma = C.m[0], C.gamma
    top = (-C.am * np.sin(m * gamma), C.am * np.cos(m * gamma))
    return np.concatenate([np.stack([C.a.T, C.b.T], axis=1), [top]]).tolist()


C, RATE = PLAN.fourier(), PLAN.alpha / PLAN.duration
HARMONICS = harmonics()
TROLLEY, INERTIA, DRUM, G = CRANE.trolley_mass, CRANE.drum_inertia, CRANE.drum_radius, CRANE.gravity
LOAD, F1, F2 = CRANE.load_mass, CRANE.trolley_friction, CRANE.drum_friction
W, TF, HOIST = 5.0, 0.02, INERTIA / DRUM + LOAD * DRUM


def crane_rates(t, s, segment, sin=math.sin, cos=math.cos, sqrt=math.sqrt):
    """Generator, two PIDs and crane; states as in `crane_loop`."""
    x, x2, z, z2 = planned(t, segment, sin, cos)
    hanging = G - z2
    pull = sqrt(x2 * x2 + hanging * hanging)
    e1 = x - (DRUM * pull - z * x2) / hanging - s[4]
    e2 = (z * pull - DRUM * x2) / hanging - s[5]
    p1, i1, d1 = 3.0 * TROLLEY * W**2, TROLLEY * W**3, 3.0 * TROLLEY * W - F1
    p2, i2, d2 = 3.0 * HOIST * W**2, HOIST * W**3, 3.0 * HOIST * W - F2 / DRUM
    force = p1 * e1 + s[0] + d1 / TF * (e1 - s[1])
    torque = -DRUM * LOAD * G + p2 * e2 + s[2] + d2 / TF * (e2 - s[3])
    r, theta, d_rate, r_rate, rate = s[5], s[6], s[7], s[8], s[9]
    sine, cosine = sin(theta), cos(theta)
    d0, dt = (force - F1 * d_rate) / TROLLEY, sine / TROLLEY
    swing = -G * sine - 2.0 * r_rate * rate + DRUM * rate * rate
    t0, tt = (swing - cosine * d0) / r, -cosine * dt / r
    r0, rt = DRUM / INERTIA * (torque - F2 * r_rate / DRUM), DRUM * DRUM / INERTIA
    along = G * cosine + r * rate * rate
    tension = (along - sine * d0 - r0 + DRUM * t0) / (sine * dt + rt + 1.0 / LOAD - DRUM * tt)
    accelerations = [d0 + dt * tension, r0 + rt * tension, t0 + tt * tension]
    return [i1 * e1, (e1 - s[1]) / TF, i2 * e2, (e2 - s[3]) / TF, d_rate, r_rate, rate, *accelerations]


def in_casadi(rates):
    return lambda t, x, segment: ca.vertcat(*rates(t, ca.vertsplit(x), segment, ca.sin, ca.cos, ca.sqrt))


def by_lsoda(rates, state, times, breaks, rtol, atol, method="LSODA"):
    """States at the times, by solve_ivp from break to break."""
    state, rows = np.asarray(state, dtype=float), [np.asarray(state, dtype=float)[:, None]]
    for k, (left, right) in enumerate(pairwise([times[0], *breaks, times[-1]])):
        grid = np.union1d(times[(times > left) & (times <= right)], right)
        found = solve_ivp(
            lambda t, x, k=k: rates(t, x.tolist(), k), (left, right), state, method, grid, rtol=rtol, atol=atol
        )
        state = found.y[:, -1]
        rows.append(found.y[:, np.isin(grid, times)])
    return np.hstack(rows)
