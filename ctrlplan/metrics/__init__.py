"""What a response and a plan are worth: plain functions of times and signals.

Every function takes sample times first, (ntime,), strictly increasing and not necessarily even, and signals with time
last. Where leading axes are allowed, (..., ntime), a single record gives a float and more give an array (...). Between
samples a signal is taken for a cubic, so that a smooth signal's metrics are of fourth order in the sample spacing.
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
