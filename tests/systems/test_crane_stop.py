"""Residual sway after stops of the crane: with limited jerk under the generator, of class C4 under the full law."""

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems.plants import Crane, crane_loop

ZEROS = [0.0] * 4
MOVE = cp.PolySpline(
    [
        cp.Waypoint.from_jets(0.0, x=[0.0, *ZEROS], z=[10.0, *ZEROS]),
        cp.Waypoint.from_jets(15.0, x=[20.0, *ZEROS], z=[11.0, *ZEROS]),
    ]
)
DRIVES = {"F": 30e3, "C": (-3e3, 1e3)}
CRANE = Crane()


def smooth_stop(time):
    """From the jet of the plan to rest with four derivatives, position free, as short as the drives allow."""
    x, z = MOVE.jet(time, 4).T.tolist()
    free = [None, *ZEROS]
    ends = [cp.Waypoint.from_jets(time, x=x, z=z), cp.Waypoint.from_jets(time + 4.0, x=free, z=free)]
    found = cp.fastest(cp.PolySpline(ends, warn=False), DRIVES, CRANE, hold="waypoints")
    return cp.Clipped(MOVE, MOVE.start, time).then(found.plan), found


def residual_sway(plan, law):
    """Peak sway in 20 s after the plan [rad], and peak force [N]."""
    t = np.append(np.linspace(0.0, plan.end, 801)[:-1], np.linspace(plan.end, plan.end + 20.0, 801))
    run = cp.simulate(crane_loop(CRANE, plan, law), t, rtol=1e-10)
    rows = dict(zip(run.output_labels, np.asarray(run.outputs), strict=True))
    return np.abs(rows["theta"][t >= plan.end]).max(), np.abs(rows["F"]).max()


def pendulum_sway(plan, time):
    """Residual sway [rad] of a pendulum of the final length below a trolley that follows (15a) with its jumps.

    After the jerk of the load jumps by c the velocity of the trolley D = x + (R/g) x'' jumps by (R/g) c, which no
    trolley follows; this is the order of magnitude of what remains.
    """
    jumps = [j for j in plan.jumps(3) if j.order == 3 and j.time >= time and j.label == "x"]
    length, g = float(plan.final[1]), 9.81
    return max(abs(j.size) for j in jumps) * length / g / np.sqrt(g * length)


@pytest.mark.slow
@pytest.mark.parametrize(
    "time", [6.0, pytest.param(4.0, marks=pytest.mark.slow), pytest.param(9.0, marks=pytest.mark.slow)]
)
def test_a_stop_of_class_c4_leaves_no_sway(time):
    limited = MOVE.stop(time, {"acceleration": [1.0, 0.5], "jerk": [2.0, 1.0]})
    sway, _ = residual_sway(limited, "generator")
    smooth, found = smooth_stop(time)
    assert smooth.jumps(4) == ()
    assert not np.abs(smooth.jet(smooth.end, 4)[1:]).max() > 1e-9
    for law in ("dynamic", "feedforward"):
        nominal, force = residual_sway(smooth, law)
        assert nominal <= 1e-6
        assert force <= 30e3 * (1 + 1e-6)
    assert sway > 1e3 * 1e-6  # with a jerk that jumps
    assert sway < pendulum_sway(limited, time)
    assert found.active.bound.name in DRIVES
    assert smooth.end < limited.end + 1.0


@pytest.mark.slow
def test_the_generator_requires_more_than_a_limited_jerk():
    """With the same reference generator the sway after the smooth stop is a third of that after the limited one."""
    limited = MOVE.stop(6.0, {"acceleration": [1.0, 0.5], "jerk": [2.0, 1.0]})
    smooth, _ = smooth_stop(6.0)
    assert residual_sway(smooth, "generator")[0] < 0.5 * residual_sway(limited, "generator")[0]
