"""Plants and closed loops, one file each; the crane is a package.

All plants have one interface, that of `Plant`: ``plant.iosystem()`` is the block
of its equations, ``plant.flat_system()`` its flat system, for `ctrlplan.flat_loop`;
``plant.units`` are the units of its signals. `ctrlplan.fastest` and
`ctrlplan.margins` accept the plant itself. In study files they are kinds of
loops, by the names in the last column.

====================== =================================== ========================
plant                  flat outputs                        kind
====================== =================================== ========================
`Crane`                x, z of the load                    ``"crane"``
`DCMotor`              angle                               ``"dc-motor"``
`FlexibleJoint`        q1, angle of the link               ``"flexible-joint"``
`KinematicCar`         x, y of the rear axle               ``"kinematic-car"``
`MagneticLevitation`   gap                                 ``"magnetic-levitation"``
`PlanarQuadrotor`      x, z of the centre of mass          ``"planar-quadrotor"``
`TwoMassDrive`         load angle; with damping y          ``"two-mass-drive"``
====================== =================================== ========================
"""

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
