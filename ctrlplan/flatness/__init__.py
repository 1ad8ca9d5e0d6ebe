"""Differential flatness: states and inputs as functions of flat outputs."""

from ctrlplan.flatness.system import FlatSystem

__all__ = ["FlatSystem"]
