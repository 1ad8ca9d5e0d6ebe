"""Cost of the minimum duration under limits on signals of a loop, against simulations of it in one process.

Wanted in CPU time on one core: 20 runs of `simulate` with 2001 samples over move and tail plus 50 ms on the DC motor,
40 runs plus 100 ms for damping from 0.005 and largest pole times duration to 1e4. Ratios to these are printed, none is
asserted.
"""

import math
from statistics import median
from time import process_time

import control as ct
import numpy as np
import pytest
from loop_oracle import QUINTIC, random_loop, system_of
from scipy.linalg import block_diag

import ctrlplan as cp
from ctrlplan import Waypoint

ENDS = [Waypoint(0, 0, 0, 0, 0), Waypoint(1, 20, 0, 0, 0)]
PLANS = {
    "quintic": cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 20, 0, 0)]),
    "trigonometric": cp.TrigSpline(ENDS, alpha=3.0),
    "s_curve": cp.SCurve(20.0, velocity=300, acceleration=6000, jerk=4e5),
}


def motor_loop():
    """DC motor (24 V, 10 A) with a PI velocity loop, a P position loop and velocity feedforward."""
    r, inductance, k, inertia, friction = 1.2, 2e-3, 0.06, 3e-5, 1e-5
    motor = ct.ss(
        [[-r / inductance, -k / inductance, 0], [k / inertia, -friction / inertia, 0], [0, 1, 0]],
        [[1 / inductance], [0], [0]],
        np.eye(3),
        np.zeros((3, 1)),
        inputs="u",
        outputs=["i", "w", "y"],
        name="motor",
    )
    control = ct.ss(
        [[0]], [[60.0, 1.0, -1.0, -60.0]], [[4.0]], [[3.6, 0.12, -0.06, -3.6]],
        inputs=["r", "r_d1", "w", "y"], outputs="u", name="control",
    )  # fmt: skip
    return ct.interconnect([motor, control], inputs=["r", "r_d1"], outputs=["y", "u", "i", "w"], name="servo")


@pytest.fixture
def against(benchmark, capsys, request):
    """Benchmark the search, then measure search and simulation in turn; print CPU times and the share of the goal."""

    def run(search, simulation, runs, constant, rounds=7):
        benchmark.pedantic(search, rounds=rounds, warmup_rounds=1)
        times = []
        for _ in range(rounds):
            seconds = []
            for function in (search, simulation):
                begin = process_time()
                function()
                seconds.append(process_time() - begin)
            times.append(seconds)
        share = median(a / (runs * b + constant) for a, b in times)
        benchmark.extra_info["share"] = share
        own, one = (1e3 * median(column) for column in zip(*times, strict=True))
        with capsys.disabled():
            print(f"\n{request.node.name}: {own:.1f} ms, simulate {one:.2f} ms, {share:.2f} of the goal")

    return run


@pytest.mark.benchmark(group="loop limits")
@pytest.mark.parametrize("name", PLANS)
def test_motor(against, name):
    """Peer: `simulate` of the loop with the plan found, over move and tail."""
    loop, plan = motor_loop(), PLANS[name]
    limits = {"u": (-24.0, 24.0), "i": (-10.0, 10.0), "y": (-0.4, 20.4)}
    found = cp.fastest(plan, limits, loop)
    source = cp.create_source_iosystem(found.plan, 1, labels="r")
    closed = ct.interconnect([source, loop], inputs=0, outputs=["y", "u", "i", "w"])

    times = np.linspace(0.0, found.duration + 28.0 / 39.0, 2001)
    against(lambda: cp.fastest(plan, limits, loop), lambda: cp.simulate(closed, times), 20, 0.05)
    assert found.margins.satisfied
    assert found.active.fraction < 1e-9


@pytest.mark.benchmark(group="loop limits")
@pytest.mark.parametrize("seed", [103, 106, 108, 120, 148, 153])
def test_weakly_damped(against, seed):
    """Peer: `simulate` of the loop with the plan found, over move and tail."""
    rng = np.random.default_rng([seed, 21])
    a, b, c, d = loop = random_loop(rng)
    gain = (d[0] - c @ np.linalg.solve(a, b[0]))[:, 0]
    limits = {f"y{i + 1}": (min(g, 0.0) - 0.1 * abs(g), max(g, 0.0) + 0.1 * abs(g)) for i, g in enumerate(gain)}
    system = system_of(loop)
    found = cp.fastest(QUINTIC, limits, system)
    poles = np.linalg.eigvals(a)
    tail = 28.0 / float(np.abs(poles.real).min())
    times = np.linspace(0.0, found.duration + tail, 2001)
    against(lambda: cp.fastest(QUINTIC, limits, system), lambda: cp.simulate(system, times, found.plan), 40, 0.1)
    assert found.margins.satisfied
    assert math.isfinite(found.duration)


@pytest.mark.benchmark(group="loop limits")
def test_slow_move_of_a_weakly_damped_mode(against):
    """A slow loop with a mode of 100 rad/s and damping 0.005: largest pole times duration is 1e4."""

    def mode(w, damping):
        im = w * math.sqrt(1.0 - damping**2)
        return np.array([[-damping * w, im], [-im, -damping * w]])

    a, b = block_diag(mode(0.12, 0.4), mode(100.0, 0.005)), np.array([[0.0], [1.0], [0.0], [1.0]])
    c = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    c = c / -(c @ np.linalg.solve(a, b))
    system = ct.ss(a, b, np.vstack([c[0] + 0.3 * c[1], c[1]]) / [[1.3], [1.0]], np.zeros((2, 1)), inputs="r")
    names = system.output_labels
    limits = {names[0]: (-0.02, 1.02), names[1]: (-0.5, 1.5)}
    found = cp.fastest(QUINTIC, limits, system)
    times = np.linspace(0.0, found.duration + 28.0 / 0.048, 2001)
    against(lambda: cp.fastest(QUINTIC, limits, system), lambda: cp.simulate(system, times, found.plan), 40, 0.1)
    assert found.margins.satisfied
    assert 9e3 < 100.0 * found.duration < 1.2e4
