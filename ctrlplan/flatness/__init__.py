"""Differential flatness: plants whose states and inputs follow from their flat outputs."""

from ctrlplan.flatness.system import FlatSystem

__all__ = ["FlatSystem"]
