"""Responses of loops: exact where they are linear, compiled where they can be, otherwise by Python.

`simulate` takes the systems that `control.input_output_response` takes,
unmodified, and returns a `SimulationResponse`: python-control's
`TimeResponseData` with the method that ran, the reason for it, and the events
of the run.

=========  ==========================================  =========================================
method     applies to                                  how
=========  ==========================================  =========================================
exact      linear loops, nested at will, with plans,   one matrix exponential for each segment
           constants or samples as inputs              of an input; the error is that of rounding
compiled   nonlinear loops whose blocks can be traced  blocks traced with CasADi symbols, compared
           (``pip install "ctrlplan[fast]"``)          with Python, and integrated by CVODES with
                                                       the exact Jacobian
python     blocks that cannot be traced                flattened, each block called once a step,
                                                       LSODA from breakpoint to breakpoint
=========  ==========================================  =========================================

A discrete controller joins a continuous loop through
`ctrlplan.sample_hold`; a delay is a block that stores its past input, not a
rational approximation; algebraic loops are solved, and named where they have no
solution. `ctrlplan.Event` records where a signal leaves a range, and may end
the run there. Limits of actuators are recorded without one.

What a run guarantees, and what it requires:

- Inputs reach blocks exactly. Errors stay below 1e-6 of the range of each
  output at default tolerances, whatever its unit; otherwise
  ``response.reason`` gives the estimated error and the tolerance that suffices.
- Declare a pulse or a switch in t inside a block of your own:
  ``cp.declare(block, breakpoints=[2.0, 3.0])``. In compiled blocks undeclared
  ones are found. A block that Python runs and that reads t is evaluated at least
  once between two sample times: a shorter pulse must be declared.
- A loop that slides along a switch, is random or grows without bound ends with
  an error that names block and time, after 60,000 evaluations of its equations
  and 300 a segment; the error says how to smooth or sample the switch.
- A system with states and dt = None is simulated as continuous-time, with a
  warning. Linear responses warn where rounding of the matrices alone changes an
  output by more than 1e-6.
- Trial calls leave the memory of a block and the global random generators as
  they were, provided that no other thread draws.
- ``timeout=`` of `ctrlplan.sweep` and `ctrlplan.monte_carlo` limits each value
  or draw; finished results are kept on Ctrl-C and when a worker process dies.

Examples
--------
The crane with limited force; the run ends where the rope becomes slack:

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

from ctrlplan.simulation.equilibrium import equilibrium_at, equilibrium_state, unstable_poles
from ctrlplan.simulation.events import Event, Occurrence, what_happened
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.predictor import Predictor
from ctrlplan.simulation.prepared import Prepared, prepare, prepared_form, state_space, stated_start
from ctrlplan.simulation.response import SimulationResponse, signal_table
from ctrlplan.simulation.simulate import simulate

__all__ = [
    "Event",
    "Occurrence",
    "Predictor",
    "Prepared",
    "SimulationResponse",
    "SolverError",
    "equilibrium_at",
    "equilibrium_state",
    "prepare",
    "prepared_form",
    "signal_table",
    "simulate",
    "state_space",
    "stated_start",
    "unstable_poles",
    "what_happened",
]
