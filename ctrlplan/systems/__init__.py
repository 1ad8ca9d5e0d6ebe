"""Blocks that python-control interconnects: plans, laws and plants."""

from ctrlplan.systems import plants
from ctrlplan.systems.source import PlanSource, create_source_iosystem, source_samples

__all__ = ["PlanSource", "create_source_iosystem", "plants", "source_samples"]
