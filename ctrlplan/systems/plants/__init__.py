"""Plants and the loops around them, one file each."""

from ctrlplan.systems.plants.linear import integrator_lag_loop, unity_feedback_loop

__all__ = ["integrator_lag_loop", "unity_feedback_loop"]
