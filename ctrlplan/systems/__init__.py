"""Blocks that python-control interconnects: plans, laws and plants."""

from ctrlplan.systems import plants
from ctrlplan.systems.feedforward import create_feedforward_iosystem
from ctrlplan.systems.flat import create_flat_iosystem, hurwitz_coefficients
from ctrlplan.systems.pid import create_pid_iosystem
from ctrlplan.systems.source import PlanSource, create_source_iosystem, source_samples

__all__ = [
    "PlanSource",
    "create_feedforward_iosystem",
    "create_flat_iosystem",
    "create_pid_iosystem",
    "create_source_iosystem",
    "hurwitz_coefficients",
    "plants",
    "source_samples",
]
