"""Blocks for python-control interconnections: sources, controllers and plants.

The required arguments of every ``create_*_iosystem`` come first; all others are
keywords: ``inputs=``, ``outputs=`` and ``name=`` as in python-control. Blocks of a
plan have ``labels=`` and ``suffix=`` instead: `control.interconnect` connects a
plan by its labels, so it must have those of the inputs (``labels=["r"]``), or the
source a suffix.

Off line: `create_source_iosystem` (a plan with its derivatives),
`create_flat_iosystem` (flat control), `create_feedforward_iosystem` (its linear
feedforward), `create_pid_iosystem`, `create_saturation_iosystem`,
`create_delay_iosystem`, `create_command_filter_iosystem`,
`create_shaper_iosystem` (input shaping of a command), `sample_hold` (discrete
blocks in continuous loops), and the plants and loops of `plants`.

On line, in place of the source of the plan:

`create_replanner_iosystem`
    Refits the plan every period, from the reference to a moving goal, or from
    measurements. Without a disturbance the plan is unchanged; each fit adds a
    correction of the same spline family. If the map from fit to fit is unstable
    with the given period, horizon and alpha, an error gives its spectral radius.
    If the goal is out of reach or a measurement is nan, the last valid plan
    stays in force and an event is recorded. A fit from measurements is feedback:
    the loop must follow the plan between fits. A fit takes 10 to 20 microseconds
    for two axes and jets of order 2.
`create_governor_iosystem`
    Reference governor: moves the reference towards the command by the largest
    step for which the loop satisfies its limits for all future times, also
    between samples. Linear loops use an `AdmissibleSet`, computed once; nonlinear
    loops a `ctrlplan.Predictor`, which predicts the response by simulation.
`create_time_scaling_iosystem`
    Time scaling: slows the plan down as an error grows or an actuator approaches
    its limit, and makes up the delay afterwards. The path does not change.

``ctrlplan online`` compares them on a crane in four scenarios: a gust, twice the
payload, a goal that changes during the move, and limited force.

Examples
--------
A governor limits the control signal of a linear loop:

>>> import control as ct
>>> import numpy as np
>>> import ctrlplan as cp
>>> loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
>>> governor = cp.create_governor_iosystem(loop, 0.05, {"u": (-1.0, 1.0)})
>>> governed = ct.interconnect([governor, cp.expose_states(loop)], inputs=["r_cmd"], outputs=["y", "u", "r"])
>>> y, u, r = cp.simulate(governed, np.linspace(0, 20, 401), {"r_cmd": cp.Step(1.0)}).outputs
>>> bool(np.abs(u).max() <= 1.0), round(float(y[-1]), 3)
(True, 1.0)
"""

from ctrlplan.flatness.quantities import flat_quantities
from ctrlplan.systems import plants
from ctrlplan.systems.admissible import AdmissibleSet
from ctrlplan.systems.command_filter import command_filter_gains, command_lead, create_command_filter_iosystem
from ctrlplan.systems.exposed import expose_states, state_signals
from ctrlplan.systems.feedforward import PlannedFeedforward, create_feedforward_iosystem
from ctrlplan.systems.feedforward_fit import FeedforwardFit, fit_feedforward
from ctrlplan.systems.flat import create_flat_iosystem
from ctrlplan.systems.flat_feedforward import create_flat_feedforward_iosystem, reference_window
from ctrlplan.systems.flat_loop import TVLQR, Feedforward, FlatLaw, flat_loop
from ctrlplan.systems.governor import Admission, Governor, create_governor_iosystem
from ctrlplan.systems.hybrid import Delay, SampleHold, create_delay_iosystem, sample_hold
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.plants import Law
from ctrlplan.systems.poles import hurwitz_coefficients
from ctrlplan.systems.replanner import create_replanner_iosystem
from ctrlplan.systems.saturation import create_saturation_iosystem
from ctrlplan.systems.shaper import ShaperBlock, create_shaper_iosystem
from ctrlplan.systems.source import PlanSource, create_source_iosystem, source_samples
from ctrlplan.systems.time_scaling import create_time_scaling_iosystem

__all__ = [
    "TVLQR",
    "AdmissibleSet",
    "Admission",
    "Delay",
    "Feedforward",
    "FeedforwardFit",
    "FlatLaw",
    "Governor",
    "Law",
    "PlanSource",
    "PlannedFeedforward",
    "SampleHold",
    "ShaperBlock",
    "command_filter_gains",
    "command_lead",
    "create_command_filter_iosystem",
    "create_delay_iosystem",
    "create_feedforward_iosystem",
    "create_flat_feedforward_iosystem",
    "create_flat_iosystem",
    "create_governor_iosystem",
    "create_pid_iosystem",
    "create_replanner_iosystem",
    "create_saturation_iosystem",
    "create_shaper_iosystem",
    "create_source_iosystem",
    "create_time_scaling_iosystem",
    "expose_states",
    "fit_feedforward",
    "flat_loop",
    "flat_quantities",
    "hurwitz_coefficients",
    "plants",
    "reference_window",
    "sample_hold",
    "source_samples",
    "state_signals",
]
