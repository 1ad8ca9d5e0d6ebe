"""Blocks for python-control interconnections: sources, controllers and plants."""

from ctrlplan.flatness.quantities import flat_quantities
from ctrlplan.systems import plants
from ctrlplan.systems.admissible import AdmissibleSet
from ctrlplan.systems.command_filter import command_filter_gains, command_lead, create_command_filter_iosystem
from ctrlplan.systems.exposed import expose_states, state_signals
from ctrlplan.systems.feedforward import create_feedforward_iosystem
from ctrlplan.systems.flat import create_flat_iosystem, hurwitz_coefficients
from ctrlplan.systems.governor import Admission, Governor, create_governor_iosystem
from ctrlplan.systems.hybrid import Delay, SampleHold, create_delay_iosystem, sample_hold
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.plants import Law
from ctrlplan.systems.replanner import create_replanner_iosystem
from ctrlplan.systems.saturation import create_saturation_iosystem
from ctrlplan.systems.source import PlanSource, create_source_iosystem, source_samples
from ctrlplan.systems.time_scaling import create_time_scaling_iosystem

__all__ = [
    "AdmissibleSet",
    "Admission",
    "Delay",
    "Governor",
    "Law",
    "PlanSource",
    "SampleHold",
    "command_filter_gains",
    "command_lead",
    "create_command_filter_iosystem",
    "create_delay_iosystem",
    "create_feedforward_iosystem",
    "create_flat_iosystem",
    "create_governor_iosystem",
    "create_pid_iosystem",
    "create_replanner_iosystem",
    "create_saturation_iosystem",
    "create_source_iosystem",
    "create_time_scaling_iosystem",
    "expose_states",
    "flat_quantities",
    "hurwitz_coefficients",
    "plants",
    "sample_hold",
    "source_samples",
    "state_signals",
]
