"""Blocks that python-control interconnects: plans, laws and plants.

Every ``create_*_iosystem`` takes what it requires first and the rest by
keyword: ``inputs=``, ``outputs=`` and ``name=`` as in python-control. Blocks
that follow a plan have ``labels=`` and ``suffix=`` instead: a plan joins a loop
by its labels, so give it those of the inputs that it is for
(``labels=["r"]``), or give the source a suffix.

Off line: `create_source_iosystem` (a plan with its derivatives),
`create_flat_iosystem` (flat control), `create_feedforward_iosystem` (its linear
feedforward), `create_pid_iosystem`, `create_saturation_iosystem`,
`create_delay_iosystem`, `create_command_filter_iosystem`, `sample_hold`
(discrete blocks in continuous loops), and the plants and loops of `plants`.

On line, a block in the place of the plan responds to what is not known before the run:

`create_replanner_iosystem`
    Fits the plan again every period, from the reference to a goal that moves,
    or from what is measured. Without a disturbance the plan is unchanged; each
    fit adds a correction in the family of the plan. A period, horizon and alpha
    of which the map from fit to fit is unstable are an error that gives its
    spectral radius. While a goal is out of reach, or a measurement is nan, the
    last valid plan is followed, and an event is recorded. A fit from what is
    measured is feedback: it requires a loop that follows the plan between fits.
    A fit takes 10 to 20 microseconds for two axes and jets of order 2.
`create_governor_iosystem`
    Reference governor: moves the reference towards the command by the largest
    step for which the loop satisfies its limits for all future times. Of linear
    loops by an `AdmissibleSet`, computed once, between the samples too; of
    nonlinear loops by a `ctrlplan.Predictor`, which simulates the loop ahead.
`create_time_scaling_iosystem`
    Time scaling: the plan slows as an error grows or an actuator comes near its
    limit, and then catches up. The path does not change.

``ctrlplan online`` compares them on a crane in four scenarios: a gust, a payload
twice as heavy, a goal that moves on the way, too little force.

Examples
--------
A governor keeps the control of a linear loop within its limits:

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
from ctrlplan.systems.feedforward import create_feedforward_iosystem
from ctrlplan.systems.flat import create_flat_iosystem, hurwitz_coefficients
from ctrlplan.systems.governor import Admission, Governor, create_governor_iosystem
from ctrlplan.systems.hybrid import Delay, SampleHold, create_delay_iosystem, sample_hold
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.plants import Law
from ctrlplan.systems.replanner import create_replanner_iosystem
from ctrlplan.systems.saturation import create_saturation_iosystem
from ctrlplan.systems.source import PlanSource, create_source_iosystem, source_samples
from ctrlplan.systems.time_scaling import create_time_scaling_iosystem

__all__ = [
    "AdmissibleSet",
    "Admission",
    "Delay",
    "Governor",
    "Law",
    "PlanSource",
    "SampleHold",
    "command_filter_gains",
    "command_lead",
    "create_command_filter_iosystem",
    "create_delay_iosystem",
    "create_feedforward_iosystem",
    "create_flat_iosystem",
    "create_governor_iosystem",
    "create_pid_iosystem",
    "create_replanner_iosystem",
    "create_saturation_iosystem",
    "create_source_iosystem",
    "create_time_scaling_iosystem",
    "expose_states",
    "flat_quantities",
    "hurwitz_coefficients",
    "plants",
    "sample_hold",
    "source_samples",
    "state_signals",
]
