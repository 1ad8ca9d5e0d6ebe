"""Simulation of loops: exact for linear ones, compiled where possible, otherwise by Python.

`simulate` accepts the systems of `control.input_output_response`, unmodified, and
returns a `SimulationResponse`: the `TimeResponseData` of python-control with the
method used, the reason for it, and the events of the run.

=========  ==========================================  =========================================
method     applies to                                  algorithm
=========  ==========================================  =========================================
exact      linear loops with any nesting; plans,       one matrix exponential for each segment
           constants or samples as inputs              of an input; the error is rounding
           with linear discrete blocks, and delays     the recursion from sample time to sample time,
           of what they hold or read                   plans exact in between; the error is rounding
           with delays between continuous blocks       the method of steps with collocation, up to
                                                       20,000 sums of delays; the error is rounding
compiled   nonlinear loops whose blocks can be traced  blocks traced with CasADi symbols, compared
           (``pip install "ctrlplan[fast]"``)          with Python, and integrated by CVODES with
                                                       the exact Jacobian
python     blocks that cannot be traced                flattened, one call of each block per step,
                                                       LSODA from breakpoint to breakpoint
=========  ==========================================  =========================================

A discrete controller is connected to a continuous loop by
`ctrlplan.sample_hold`. A delay is a block that stores its past input, not a
rational approximation. Algebraic loops are solved; if there is no solution, the
error names their blocks. `ctrlplan.Event` records when a signal leaves its limits
and may end the run. Limits of actuator blocks are recorded without it.

Properties and requirements:

- Input signals reach blocks exactly. Errors stay below 1e-6 of the range of each
  output at default tolerances, whatever its unit; otherwise
  ``response.reason`` gives the estimated error and the tolerance that suffices.
- A pulse or a switch in t inside a user's block must be declared:
  ``cp.declare(block, breakpoints=[2.0, 3.0])``. In compiled blocks undeclared
  ones are found. A block run by Python that reads t is evaluated at least once
  between two sample times, so that only shorter pulses must be declared.
- A loop that slides along a discontinuity, is random or diverges ends with an
  error that names block and time, after 60,000 evaluations of its equations plus
  300 per segment; the message states how to smooth or sample the discontinuity.
- A system with states and dt = None is simulated as continuous-time, with a
  warning. Linear responses warn if rounding errors of the matrices change an
  output by more than 1e-6 of its magnitude.
- Trial calls restore the memory of a block and the global random generators,
  provided that no other thread uses the generators.
- ``timeout=`` of `ctrlplan.sweep` and `ctrlplan.monte_carlo` limits each value
  or draw; finished results are kept on Ctrl-C and when a worker process dies.

Examples
--------
Crane with limited force; an event ends the run if the rope becomes slack:

>>> import numpy as np
>>> import ctrlplan as cp
>>> rest = [0.0, 0.0]
>>> ends = [
...     cp.Waypoint.from_jets(0, x=[0, *rest], z=[10, *rest]),
...     cp.Waypoint.from_jets(10, x=[5, *rest], z=[11, *rest]),
... ]
>>> loop = cp.plants.crane_loop(cp.plants.Crane(), cp.PolySpline(ends), force_limits=(-30e3, 30e3))
>>> response = cp.simulate(loop, np.linspace(0, 12, 241), events=[cp.Event("T", low=0.0, stop=True)])
>>> float(response.time[-1]), response.events
(12.0, [])
"""

from typing import TYPE_CHECKING

from ctrlplan import _later
from ctrlplan.simulation.equilibrium import equilibrium_at, equilibrium_state, unstable_poles
from ctrlplan.simulation.events import Event, Occurrence, what_happened
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.prepared import Prepared, prepare, prepared_form, state_space, stated_start, unchanged
from ctrlplan.simulation.response import SimulationResponse, signal_table
from ctrlplan.simulation.simulate import simulate
from ctrlplan.simulation.starts import check_begin

if TYPE_CHECKING:
    from ctrlplan.simulation.log import measured_response, read_log
    from ctrlplan.simulation.loop_response import Extremes, LoopResponse
    from ctrlplan.simulation.predictor import Predictor
    from ctrlplan.simulation.quantities_of_loops import LoopQuantities, loop_quantities
    from ctrlplan.simulation.sampled_response import SampledQuantities
    from ctrlplan.simulation.simulated_response import SimulatedQuantities
    from ctrlplan.simulation.stepper import Stepper

__all__ = [
    "Event",
    "Extremes",
    "LoopQuantities",
    "LoopResponse",
    "Occurrence",
    "Predictor",
    "Prepared",
    "SampledQuantities",
    "SimulatedQuantities",
    "SimulationResponse",
    "SolverError",
    "Stepper",
    "check_begin",
    "equilibrium_at",
    "equilibrium_state",
    "loop_quantities",
    "measured_response",
    "prepare",
    "prepared_form",
    "read_log",
    "signal_table",
    "simulate",
    "state_space",
    "stated_start",
    "unchanged",
    "unstable_poles",
    "what_happened",
]

_HOME = {
    "Extremes": "loop_response",
    "LoopQuantities": "quantities_of_loops",
    "LoopResponse": "loop_response",
    "Predictor": "predictor",
    "SampledQuantities": "sampled_response",
    "SimulatedQuantities": "simulated_response",
    "Stepper": "stepper",
    "loop_quantities": "quantities_of_loops",
    "measured_response": "log",
    "read_log": "log",
}
"""Modules of names that a run does not require; they are loaded when a name is first read."""


__getattr__ = _later.loaded_later(globals(), _HOME)


def __dir__() -> list[str]:
    return [*__all__]
