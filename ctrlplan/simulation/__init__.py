"""Simulation of loops: exact for linear ones, compiled where possible, otherwise by Python."""

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
