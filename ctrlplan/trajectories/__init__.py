"""Functions of time with exact derivatives: the references of a control loop.

``plan(t, nu)`` is the derivative nu, ``plan.jet(t, order)`` all up to an order,
``plan.extrema(nu)`` and ``plan.peak(nu)`` the extrema between samples too,
``plan.plot()`` a figure that ``plt.show()`` shows (``ax=drawn.axes`` overlays a
second plan). Plans are added, scaled, shifted (``shift``), retimed
(``retime``), joined (``then``), repeated (``repeat``), stacked (`stack`) and split
(``select``), and stopped (``stop``) or brought to a constant velocity
(``to_velocity``) in minimum time; ``plan.save(path)`` writes JSON that
`load_trajectory` restores exactly.

Before its start a plan holds its first position, after its end the last, with
all derivatives zero. Times are in seconds, signals are (channel, time).
"""

from typing import TYPE_CHECKING

from ctrlplan import _later

if TYPE_CHECKING:
    from ctrlplan.trajectories.clipped import Clipped
    from ctrlplan.trajectories.combined import Joined, Scaled, Selected, Stacked, Sum, stack
    from ctrlplan.trajectories.continuity import Jump
    from ctrlplan.trajectories.converted import as_trajectory
    from ctrlplan.trajectories.extrema import Bounds, Extrema
    from ctrlplan.trajectories.files import derivative_name, load_trajectory, trajectory_from_dict
    from ctrlplan.trajectories.fitting import fit
    from ctrlplan.trajectories.motion_profile import MotionProfile
    from ctrlplan.trajectories.path_plan import PathPlan
    from ctrlplan.trajectories.piecewise import PiecewiseSpline
    from ctrlplan.trajectories.piecewise_polynomial import PiecewisePolynomial
    from ctrlplan.trajectories.polynomial import PolySpline
    from ctrlplan.trajectories.profiles import SCurve, Trapezoid
    from ctrlplan.trajectories.repeated import Repeated
    from ctrlplan.trajectories.residual import residual_spectrum
    from ctrlplan.trajectories.retimed import Retimed
    from ctrlplan.trajectories.shaper_factor import ShaperFactor
    from ctrlplan.trajectories.shaping import Shaper
    from ctrlplan.trajectories.step import Step
    from ctrlplan.trajectories.time_law import TimeLaw
    from ctrlplan.trajectories.trajectory import Trajectory
    from ctrlplan.trajectories.transition import Transition
    from ctrlplan.trajectories.trigonometric import FourierCoefficients, TrigSpline
    from ctrlplan.trajectories.waypoint import Waypoint
    from ctrlplan.trajectories.waypoint_csv import waypoints_from_csv
    from ctrlplan.trajectories.waypoint_spline import WaypointSpline

__all__ = [
    "Bounds",
    "Clipped",
    "Extrema",
    "FourierCoefficients",
    "Joined",
    "Jump",
    "MotionProfile",
    "PathPlan",
    "PiecewisePolynomial",
    "PiecewiseSpline",
    "PolySpline",
    "Repeated",
    "Retimed",
    "SCurve",
    "Scaled",
    "Selected",
    "Shaper",
    "ShaperFactor",
    "Stacked",
    "Step",
    "Sum",
    "TimeLaw",
    "Trajectory",
    "Transition",
    "Trapezoid",
    "TrigSpline",
    "Waypoint",
    "WaypointSpline",
    "as_trajectory",
    "derivative_name",
    "fit",
    "load_trajectory",
    "residual_spectrum",
    "stack",
    "trajectory_from_dict",
    "waypoints_from_csv",
]

_HOME = {
    "Bounds": "extrema",
    "Clipped": "clipped",
    "Extrema": "extrema",
    "FourierCoefficients": "trigonometric",
    "Joined": "combined",
    "Jump": "continuity",
    "MotionProfile": "motion_profile",
    "PathPlan": "path_plan",
    "PiecewisePolynomial": "piecewise_polynomial",
    "PiecewiseSpline": "piecewise",
    "PolySpline": "polynomial",
    "Repeated": "repeated",
    "Retimed": "retimed",
    "SCurve": "profiles",
    "Scaled": "combined",
    "Selected": "combined",
    "Shaper": "shaping",
    "ShaperFactor": "shaper_factor",
    "Stacked": "combined",
    "Step": "step",
    "Sum": "combined",
    "TimeLaw": "time_law",
    "Trajectory": "trajectory",
    "Transition": "transition",
    "Trapezoid": "profiles",
    "TrigSpline": "trigonometric",
    "Waypoint": "waypoint",
    "WaypointSpline": "waypoint_spline",
    "as_trajectory": "converted",
    "derivative_name": "files",
    "fit": "fitting",
    "load_trajectory": "files",
    "residual_spectrum": "residual",
    "stack": "combined",
    "trajectory_from_dict": "files",
    "waypoints_from_csv": "waypoint_csv",
}
"""Module of each name, loaded when the name is first read."""


__getattr__ = _later.loaded_later(globals(), _HOME)


def __dir__() -> list[str]:
    return [*__all__]
