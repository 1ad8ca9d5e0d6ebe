"""Availability of CasADi."""

from __future__ import annotations

from importlib.util import find_spec


def missing_casadi() -> str:
    """Reason why blocks cannot be traced; empty with CasADi."""
    return "" if find_spec("casadi") is not None else "CasADi is not installed (pip install ctrlplan[fast])"
