"""Choosing what the designer left free: shape, derivatives, times, durations, ways around obstacles."""

from ctrlplan import _renamed
from ctrlplan.planning.alpha import AlphaChoice, choose_alpha
from ctrlplan.planning.avoid import Avoidance, avoid
from ctrlplan.planning.clearance import Clearance, Rope, clearance
from ctrlplan.planning.fastest import Fastest, fastest
from ctrlplan.planning.limits import Bound, Limits, Margin, Margins, margins
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
