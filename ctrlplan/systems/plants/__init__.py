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
from ctrlplan.systems.plants.dc_motor import DCMotor, dc_motor
from ctrlplan.systems.plants.flexible_joint import FlexibleJoint, flexible_joint
from ctrlplan.systems.plants.integrator_chain import integrator_chain
from ctrlplan.systems.plants.kinematic_car import KinematicCar
from ctrlplan.systems.plants.linear import integrator_lag_loop, unity_feedback_loop
from ctrlplan.systems.plants.magnetic_levitation import MagneticLevitation
from ctrlplan.systems.plants.planar_quadrotor import PlanarQuadrotor
from ctrlplan.systems.plants.plant import Plant
from ctrlplan.systems.plants.two_mass_drive import TwoMassDrive

__all__ = [
    "LAWS",
    "Crane",
    "DCMotor",
    "DynamicLaw",
    "FeedforwardLaw",
    "FlexibleJoint",
    "GeneratorLaw",
    "KinematicCar",
    "Law",
    "LoadFeedbackLaw",
    "MagneticLevitation",
    "PlanarQuadrotor",
    "Plant",
    "SetpointLaw",
    "TwoMassDrive",
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
