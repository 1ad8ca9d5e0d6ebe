"""Fastest time law on a path, next to toppra in one process: ratios of CPU time and durations are printed.

The peer is an optional package. Its time is that of its bare computation on its automatic grid. As its plans violate
the limits between grid points, its duration is that of the plan slowed until the limits hold.
"""

from statistics import median
from time import process_time

import numpy as np
import pytest

import ctrlplan as cp

toppra = pytest.importorskip("toppra")

VELOCITY, ACCELERATION = 2.0, 4.0
LIMITS = {"velocity": VELOCITY, "acceleration": ACCELERATION}


def random_path(count, naxes, seed=1):
    points = np.random.default_rng(seed).normal(size=(naxes, count))
    times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points), axis=0)))
    rest = np.full(count, np.nan)
    rest[[0, -1]] = 0.0
    return cp.PiecewiseSpline.from_arrays(times, points, derivatives={1: rest, 2: rest}, warn=False)


class Path(toppra.interpolator.AbstractGeometricPath):
    """A plan as a path of the peer."""

    def __init__(self, plan):
        self._plan = plan

    def __call__(self, positions, order=0):
        values = self._plan.jet(np.asarray(positions, dtype=float), order)[order]
        return values.T if np.ndim(positions) else values

    dof = property(lambda self: self._plan.naxes)
    path_interval = property(lambda self: np.array([self._plan.start, self._plan.end]))
    waypoints = property(lambda self: None)


def peer(plan):
    toppra.setup_logging("ERROR")
    both = [
        toppra.constraint.JointVelocityConstraint(np.tile([-VELOCITY, VELOCITY], (plan.naxes, 1))),
        toppra.constraint.JointAccelerationConstraint(np.tile([-ACCELERATION, ACCELERATION], (plan.naxes, 1))),
    ]
    method = toppra.algorithm.TOPPRA(both, Path(plan), parametrizer="ParametrizeConstAccel")
    return method.compute_trajectory(0, 0)


def slowed(trajectory):
    """Duration with which the limits hold at many times."""
    t = np.linspace(*trajectory.path_interval, 100_001)
    velocity, acceleration = (np.abs(trajectory(t, order)).max() for order in (1, 2))
    return trajectory.duration * max(1.0, velocity / VELOCITY, (acceleration / ACCELERATION) ** 0.5)


@pytest.mark.benchmark(group="path law")
@pytest.mark.parametrize(("count", "naxes"), [(2, 2), (5, 2), (10, 6), (50, 3), (50, 7)])
def test_fastest_on_a_path(benchmark, capsys, count, naxes):
    plan = random_path(count, naxes)
    found = cp.fastest(plan, LIMITS, hold="path")
    assert found.margins.satisfied
    times = []
    for _ in range(5):
        seconds = []
        for function in (lambda: cp.fastest(plan, LIMITS, hold="path"), lambda: peer(plan)):
            begin = process_time()
            function()
            seconds.append(process_time() - begin)
        times.append(seconds)
    other = slowed(peer(plan))
    benchmark.pedantic(lambda: cp.fastest(plan, LIMITS, hold="path"), rounds=3)
    ratio = median(a / b for a, b in times)
    benchmark.extra_info["ratio"] = ratio
    own, theirs = (1e3 * median(column) for column in zip(*times, strict=True))
    with capsys.disabled():
        print(
            f"\n{count} waypoints, {naxes} axes: {own:.1f} ms, toppra {theirs:.1f} ms, ratio {ratio:.2f}; "
            f"duration {found.duration:.4f} s, toppra {other:.4f} s, ratio {found.duration / other:.4f}"
        )


@pytest.mark.benchmark(group="path law")
@pytest.mark.parametrize(
    ("kind", "count", "naxes"),
    [("spline", 5, 3), ("spline", 50, 3), ("spline", 50, 7), ("lines", 50, 3), ("lines", 50, 7)],
)
def test_fastest_on_a_path_with_limited_jerk(benchmark, capsys, kind, count, naxes):
    """No peer is installed that limits the jerk on a path: the ratio is that to the same without this limit.

    Lines have a stop at each waypoint. Goal: at most 0.5 s for 50 waypoints.
    """
    plan, limits = random_path(count, naxes), LIMITS | {"jerk": 20.0}
    if kind == "lines":
        plan = cp.PiecewiseSpline([cp.Waypoint(point.time, point.position) for point in plan.waypoints])
    found, without = (cp.fastest(plan, own, hold="path") for own in (limits, LIMITS))
    assert found.margins.satisfied
    times = []
    for _ in range(3):
        seconds = []
        for own in (limits, LIMITS):
            begin = process_time()
            cp.fastest(plan, own, hold="path")
            seconds.append(process_time() - begin)
        times.append(seconds)
    benchmark.pedantic(lambda: cp.fastest(plan, limits, hold="path"), rounds=1)
    own, other = (1e3 * median(column) for column in zip(*times, strict=True))
    benchmark.extra_info["ratio"] = own / other
    with capsys.disabled():
        print(
            f"\n{kind}, {count} waypoints, {naxes} axes, jerk: {own:.0f} ms, without {other:.0f} ms, "
            f"ratio {own / other:.2f}; duration {found.duration:.4f} s, without {without.duration:.4f} s"
        )
