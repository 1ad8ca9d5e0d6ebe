"""Crane of the paper's section 5: parameters, equations, flat maps, control laws and loops."""

from ctrlplan.systems.plants.crane.blocks import (
    create_crane_feedforward_iosystem,
    create_dynamic_law_iosystem,
    create_generator_iosystem,
    create_load_feedback_iosystem,
    create_setpoint_iosystem,
    create_still_iosystem,
)
from ctrlplan.systems.plants.crane.crane import Crane
from ctrlplan.systems.plants.crane.laws import (
    LAWS,
    DynamicLaw,
    FeedforwardLaw,
    GeneratorLaw,
    Law,
    LoadFeedbackLaw,
    SetpointLaw,
)
from ctrlplan.systems.plants.crane.loop import crane_loop
from ctrlplan.systems.plants.crane.rope import CraneRope

__all__ = [
    "LAWS",
    "Crane",
    "CraneRope",
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
]
