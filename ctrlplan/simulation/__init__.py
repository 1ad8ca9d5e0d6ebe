"""Responses of loops: exact where they are linear, compiled where they can be, right in any case."""

from ctrlplan.simulation.events import Event, Occurrence
from ctrlplan.simulation.interpreted import SolverError
from ctrlplan.simulation.predictor import Predictor
from ctrlplan.simulation.prepared import Prepared, prepare, state_space, stated_start
from ctrlplan.simulation.rest import rest_state, unstable_poles
from ctrlplan.simulation.simulate import simulate

__all__ = [
    "Event",
    "Occurrence",
    "Predictor",
    "Prepared",
    "SolverError",
    "prepare",
    "rest_state",
    "simulate",
    "state_space",
    "stated_start",
    "unstable_poles",
]
