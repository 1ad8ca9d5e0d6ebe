"""Metrics of responses and plans: functions of sample times and signals.

The first argument of every function is an array of sample times, (ntime,), strictly increasing but not necessarily
even; signals have time last. Where leading axes are allowed, (..., ntime), a single signal gives a float and several
give an array (...). Between samples a signal is interpolated by cubics: for smooth signals the error of the metrics is
of fourth order in the sample spacing.
"""

from ctrlplan.metrics._control import effort, peak, saturation_time, total_variation
from ctrlplan.metrics._error import iae, ise, itae
from ctrlplan.metrics._path import excess_variation, jerk_cost, outside_box, path_length, turning_points, wandering
from ctrlplan.metrics._response import lag, overshoot, settling_time, tracking_settling_time

__all__ = [
    "effort",
    "excess_variation",
    "iae",
    "ise",
    "itae",
    "jerk_cost",
    "lag",
    "outside_box",
    "overshoot",
    "path_length",
    "peak",
    "saturation_time",
    "settling_time",
    "total_variation",
    "tracking_settling_time",
    "turning_points",
    "wandering",
]
