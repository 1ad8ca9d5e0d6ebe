"""Differential flatness: states and inputs as functions of flat outputs."""

from ctrlplan.flatness.basis import TrigFamily
from ctrlplan.flatness.candidates import FlatCandidate, FlatCheck, check_flat, flat_candidates
from ctrlplan.flatness.derived import DerivedFlatSystem
from ctrlplan.flatness.deriving import flat_system
from ctrlplan.flatness.errors import NotFlatError
from ctrlplan.flatness.system import FlatSystem

__all__ = [
    "DerivedFlatSystem",
    "FlatCandidate",
    "FlatCheck",
    "FlatSystem",
    "NotFlatError",
    "TrigFamily",
    "check_flat",
    "flat_candidates",
    "flat_system",
]
