"""Refitted plans compared with directly computed splines and polynomials of scipy; continuity at fits."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import chebyshev
from repetitions import examples
from replanner_oracle import PLAN, TWO, Peer, between, block_outputs, signals, state_of, steps
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint

# The plan that is made: against splines solved for directly


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_after_a_goal_and_a_deviation_it_is_the_plan_and_a_spline_between_two_jets(order, alpha):
    """alpha = rate x remaining time; the deviation in every derivative that is measured."""
    ends = [[0.0] * (order + 1), [1.0] + [0.0] * order]
    plan = cp.TrigSpline(
        [Waypoint.from_jets(t, x=jet) for t, jet in zip((2.0, 7.0), ends, strict=True)], alpha=alpha, warn=False
    )
    replanner = cp.create_replanner_iosystem(
        plan, 0.1, order=order, measured=order, goal_derivatives=min(order, 1), suffix="_r", derivatives=order + 1
    )
    core, rng = replanner.syslist[1], np.random.default_rng(order)
    off = np.zeros((9, 1))
    off[: order + 1, 0] = 0.1 * rng.normal(size=order + 1)
    goal = np.array([[1.3], [-0.2]])[: min(order, 1) + 1]
    for now in (2.0, 3.1, 5.9):
        left = 7.0 - now
        x = core.sample(now, np.zeros(core.nstates), signals(plan, replanner, now, goal=goal, off=off), {})
        last = [0.0] * (order + 1)
        last[0] = 0.3 + (-0.2 * left if order else 0.0)
        last[1:2] = [-0.2] if order else []
        s = np.linspace(0.0, left * (1 - 1e-12), 5)
        added = between(off[: order + 1, 0], last, left, alpha / 5.0 * left, s, order + 1)
        wanted = added + plan.jet(now + s, order + 1)[:, 0]
        found = np.array([block_outputs(plan, replanner, now + v, x) for v in s.tolist()]).T
        size = np.abs(wanted).max(axis=1, keepdims=True) + np.abs(added).max(axis=1, keepdims=True)
        assert (np.abs(found - wanted) <= 1e-9 * size).all()


def test_a_polynomial_plan_fitted_again_is_one_polynomial():
    """From the reference's jet to the new goal in one piece: scipy's, without a correction on top of anything."""
    t = np.linspace(0.0, 11.0, 111)
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0), t, cp.Step(1.5, 1.0, 3.2))
    peer = BPoly.from_derivatives([3.5, 10.0], [PLAN.jet(3.5, 2)[:, 0], [1.5, 0, 0]])
    later = (t >= 3.5) & (t <= 10.0)
    assert np.abs(found.outputs[0, t < 3.5] - PLAN(t[t < 3.5])).max() <= 1e-12
    for nu in range(3):
        wanted = (peer.derivative(nu) if nu else peer)(t[later])
        assert np.abs(found.outputs[nu, later] - wanted).max() <= 1e-11


@pytest.mark.parametrize("horizon", ["shrinking", 2.0])
@pytest.mark.parametrize("seed", range(2))
def test_runs_are_those_of_a_replanner_of_the_peers_polynomials(seed, horizon):
    """Two axes, goals that jump at random times, offsets of the clock: every derivative, all the way."""
    rng = np.random.default_rng(seed)
    plan = cp.PolySpline(TWO, labels=["x", "z"])
    times, targets = np.sort(rng.uniform(0.5, 11.0, 3)), plan.final + rng.normal(size=(4, 2))
    targets[0] = plan.final
    begin = float(rng.uniform(0.0, 0.2))

    def goal(t):
        return targets[np.searchsorted(times, t, side="right")][None]

    replanner = cp.create_replanner_iosystem(plan, 0.3, horizon=horizon, goal_derivatives=0, offset=begin)
    moves = [steps(*zip(times, targets[1:, a], strict=True), initial=targets[0, a]) for a in range(2)]
    t = np.linspace(0.0, 13.0, 131) + 1e-3
    found = cp.simulate(replanner, t - 1e-3, {"x_goal": moves[0], "z_goal": moves[1]})
    peer = Peer(plan, goal, 0.3, horizon=None if horizon == "shrinking" else horizon, begin=begin)
    wanted = peer(t - 1e-3)
    assert (np.abs(found.outputs - wanted).max(axis=1) <= 1e-9 * np.abs(wanted).max(axis=1)).all()


# Joins

NODES = 22


def segments(edges, nodes=NODES):
    """Chebyshev times inside each segment, none at its ends."""
    cosines = np.cos(np.pi * (np.arange(nodes)[::-1] + 0.5) / nodes)
    return np.array([0.5 * (a + b) + 0.5 * (b - a) * cosines for a, b in itertools.pairwise(edges)])


@pytest.mark.parametrize("horizon", ["shrinking", 1.5])
@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_no_derivative_jumps_and_each_is_that_of_the_one_before(order, alpha, horizon):
    """From the outputs of a run alone: each segment as a Chebyshev series, taken to its ends and differentiated."""
    rng = np.random.default_rng(10 * order + int(alpha))
    ends = [[0.0] * (order + 1), [1.0] + [0.0] * order]
    plan = cp.TrigSpline(
        [Waypoint.from_jets(t, x=jet) for t, jet in zip((0.0, 4.0), ends, strict=True)], alpha=alpha, warn=False
    )
    replanner = cp.create_replanner_iosystem(plan, 0.25, order=order, horizon=horizon, goal_derivatives=0)
    goal = steps(
        *[(float(t), float(v)) for t, v in zip(np.sort(rng.uniform(0, 3, 4)), rng.normal(size=4), strict=True)]
    )
    edges = np.append(0.25 * np.arange(17), [4.25, 4.5])
    times = segments(edges)
    flat = np.union1d(times.ravel(), edges)
    found = cp.simulate(replanner, flat, goal)
    outputs = found.outputs.reshape(order + 1, -1)
    assert state_of(found, "fits")[-1] >= 2
    values = outputs[:, np.searchsorted(flat, times)]  # order, segment, node
    cosines = np.cos(np.pi * (np.arange(NODES)[::-1] + 0.5) / NODES)
    series = np.linalg.solve(chebyshev.chebvander(cosines, NODES - 1), values.reshape(-1, NODES).T)
    begins, finishes = (chebyshev.chebval(z, series).reshape(order + 1, -1) for z in (-1.0, 1.0))
    size = np.abs(values).max(axis=(1, 2))
    jumps = np.abs(begins[:, 1:] - finishes[:, :-1]).max(axis=1)
    assert (jumps <= 1e-9 * size).all()
    # A sample at an edge counts to what follows; no derivative jumps, so either limit is it.
    assert (np.abs(outputs[:, np.searchsorted(flat, edges[1:-1])] - begins[:, 1:]).max(axis=1) <= 1e-9 * size).all()
    slopes = chebyshev.chebval(cosines, chebyshev.chebder(series) * 2.0 / 0.25).reshape(order + 1, -1, NODES)
    # What follows from rounding: NODES^2 times the last digit over the segment.
    assert (
        np.abs(slopes[:-1] - values[1:]).max(axis=(1, 2), initial=0.0) <= 1e-9 * (size[1:] + size[:-1] / 0.25)
    ).all()
    # No staircase: between fits it moves as fast as its mean slope says.
    travel = np.abs(values[0]).max() * 1e-3
    assert (np.ptp(values[0, 1:12], axis=1) > travel).mean() > 0.8


@pytest.mark.slow
@examples(40)
@given(
    st.integers(0, 4),
    st.sampled_from([0.0, 1.0, 3.0, 5.0]),
    st.lists(st.tuples(st.floats(0.0, 9.0), st.floats(-5.0, 5.0)), min_size=1, max_size=6),
    st.integers(0, 10**6),
)
def test_no_jump_at_any_fit_whatever_the_goals(order, alpha, moves, seed):
    """The block before and after each sample, at one instant: derivatives 0 to `order`, two axes."""
    rng = np.random.default_rng(seed)
    ends = np.zeros((2, order + 1, 2))
    ends[1, 0] = [1.0, -2.0]
    plan = cp.TrigSpline([Waypoint(t, *jet) for t, jet in zip((0.0, 10.0), ends, strict=True)], alpha=alpha, warn=False)
    options = {} if alpha > 2.0 or rng.random() < 0.5 else {"horizon": 4.0}
    replanner = cp.create_replanner_iosystem(plan, 0.5, order=order, goal_derivatives=0, **options)
    core = replanner.syslist[1]
    x, size, jumps = np.zeros(core.nstates), np.zeros(2 * (order + 1)), []
    for t in np.arange(0.0, 12.0, 0.5).tolist():
        aim = [plan.final + sum(value for time, value in moves if time <= t)]
        before = block_outputs(plan, replanner, t, x, goal=aim)
        x = core.sample(t, x, signals(plan, replanner, t, goal=aim), {})
        after = block_outputs(plan, replanner, t, x, goal=aim)
        jumps.append(np.abs(after - before))
        middle = [block_outputs(plan, replanner, t + s, x, goal=aim) for s in (0.0, 0.2, 0.4)]
        size = np.maximum(size, np.abs(middle).max(axis=0))
    assert (np.max(jumps, axis=0) <= 1e-9 * size).all()


def test_a_derivative_above_the_order_does_jump():
    """Check that the tests above can fail."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, derivatives=3)
    core = replanner.syslist[1]
    x = core.sample(4.0, np.zeros(core.nstates), signals(PLAN, replanner, 4.0, goal=[[2.0]]), {})
    jump = block_outputs(PLAN, replanner, 4.0, x) - PLAN.jet(4.0, 3)[:, 0]
    assert np.abs(jump[:3]).max() <= 1e-12
    assert abs(jump[3] - 60.0 / 6.0**3) <= 1e-10  # minimum jerk over 6 s: 60 x move/H^3
