"""Plants and the loops around them, one file each."""

from ctrlplan.systems.plants.crane import Crane
from ctrlplan.systems.plants.crane_loop import LAWS, crane_loop
from ctrlplan.systems.plants.linear import integrator_lag_loop, unity_feedback_loop

__all__ = ["LAWS", "Crane", "crane_loop", "integrator_lag_loop", "unity_feedback_loop"]
