"""Whether the extra package is there that symbolic work needs."""

from __future__ import annotations

from importlib.util import find_spec


def missing_casadi() -> str:
    """Reason why nothing can be traced, with what to do; empty where CasADi is installed."""
    return "" if find_spec("casadi") is not None else "CasADi is not installed (pip install ctrlplan[fast])"
