"""Optimisation of plans: shape, derivatives, times, duration, obstacle avoidance.

Limits are satisfied over the whole interval, not only at samples. In the order of work:

`choose_alpha`
    Shape parameter of a trigonometric spline by an objective: path length, a
    peak, a squared derivative, or a user's function.
`optimize_waypoints`
    Free derivatives at via points, and their times, by minimum jerk or snap.
`fastest`
    Minimum duration under limits on derivatives, on quantities of a plant, or on
    signals of a loop. ``hold`` selects what is preserved: the shape, with all
    times in proportion; the derivatives at the waypoints, where feasibility is
    not monotone in the duration and the feasible set is reported; or only the
    path. Limits that no duration satisfies raise an error with the reason.
`margins`
    Margin of a given plan to each limit, and its time. Both also for the worst
    case over ranges of parameters.
`Limits`, `Region`
    Limits on one side, of a rate, of a root mean square, in an interval of time
    or as a function of time; convex regions of two signals.
`avoid`, `clearance`
    Paths around obstacles, and the certified distance to them. The rope of a
    crane is inclined where the load accelerates: check its clearance again
    after a plan was retimed. A half-plane excludes paths above an obstacle:
    ``HalfPlane((0, -1), -2.0)`` keeps the load below z = 2.

Limits on derivatives have a closed-form solution. For a crane `fastest` takes
about a tenth of a second (one second with ``hold="path"``),
`choose_alpha` 40 ms.

Examples
--------
>>> import ctrlplan as cp
>>> rest = [0.0] * 4
>>> start = cp.Waypoint.from_jets(0, x=[0, *rest], z=[10, *rest])
>>> goal = cp.Waypoint.from_jets(15, x=[20, *rest], z=[11, *rest])
>>> straight = cp.TrigSpline([start, goal], alpha=1.0)
>>> limits = {"velocity": 3.0, "F": 5e3, "C": (-3e3, 1e3), "theta": 0.1, "R": (1.0, 12.0)}
>>> found = cp.fastest(straight, limits, cp.plants.Crane())
>>> round(found.duration, 1), found.active.bound.name
(16.6, 'x_d1')
"""

from ctrlplan import _renamed
from ctrlplan.planning.alpha import AlphaChoice, choose_alpha
from ctrlplan.planning.avoid import Avoidance, avoid
from ctrlplan.planning.bounds import Bound, Limits, Region
from ctrlplan.planning.clearance import Clearance, Rope, clearance
from ctrlplan.planning.fastest import Fastest, fastest
from ctrlplan.planning.limits import Margin, Margins, margins
from ctrlplan.planning.objectives import OBJECTIVES, PeakDerivative, SquaredDerivative, plan_excess_length, plan_length
from ctrlplan.planning.obstacles import Disc, HalfPlane, Obstacle, Rectangle
from ctrlplan.planning.optimize import Optimum, optimize_waypoints

__all__ = [
    "OBJECTIVES",
    "AlphaChoice",
    "Avoidance",
    "Bound",
    "Clearance",
    "Disc",
    "Fastest",
    "HalfPlane",
    "Limits",
    "Margin",
    "Margins",
    "Obstacle",
    "Optimum",
    "PeakDerivative",
    "Rectangle",
    "Region",
    "Rope",
    "SquaredDerivative",
    "avoid",
    "choose_alpha",
    "clearance",
    "fastest",
    "margins",
    "optimize_waypoints",
    "plan_excess_length",
    "plan_length",
]

__getattr__ = _renamed.renamed_members(__name__, {"path_length": "plan_length", "wandering": "plan_excess_length"})
