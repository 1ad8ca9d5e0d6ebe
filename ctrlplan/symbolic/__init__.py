"""Equations of python-control's blocks as CasADi expressions, checked against Python.

A block is called with symbols in place of numbers (`tracing`, `symbols`); the
result counts only if it agrees with Python (`comparison`), and only as long as
nothing has changed to which the block's functions refer (`fingerprint`).
"""

from importlib.util import find_spec


def missing_casadi() -> str:
    """Reason why nothing can be traced, with what to do; empty where CasADi is installed."""
    return "" if find_spec("casadi") is not None else "CasADi is not installed (pip install ctrlplan[fast])"
