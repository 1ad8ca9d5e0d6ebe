"""Plants and closed loops, one file each; the crane is a package."""

from ctrlplan.systems.plants.crane import (
    LAWS,
    Crane,
    DynamicLaw,
    FeedforwardLaw,
    GeneratorLaw,
    Law,
    LoadFeedbackLaw,
    SetpointLaw,
    crane_loop,
    create_crane_feedforward_iosystem,
    create_dynamic_law_iosystem,
    create_generator_iosystem,
    create_load_feedback_iosystem,
    create_setpoint_iosystem,
    create_still_iosystem,
)
from ctrlplan.systems.plants.dc_motor import dc_motor
from ctrlplan.systems.plants.flexible_joint import flexible_joint
from ctrlplan.systems.plants.integrator_chain import integrator_chain
from ctrlplan.systems.plants.linear import integrator_lag_loop, unity_feedback_loop

__all__ = [
    "LAWS",
    "Crane",
    "DynamicLaw",
    "FeedforwardLaw",
    "GeneratorLaw",
    "Law",
    "LoadFeedbackLaw",
    "SetpointLaw",
    "crane_loop",
    "create_crane_feedforward_iosystem",
    "create_dynamic_law_iosystem",
    "create_generator_iosystem",
    "create_load_feedback_iosystem",
    "create_setpoint_iosystem",
    "create_still_iosystem",
    "dc_motor",
    "flexible_joint",
    "integrator_chain",
    "integrator_lag_loop",
    "unity_feedback_loop",
]
