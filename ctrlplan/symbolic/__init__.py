"""Equations of python-control's blocks as CasADi expressions, checked against Python.

A block is called with symbols in place of numbers (`tracing`, `symbols`); the
result counts only if it agrees with Python (`comparison`), and only as long as
nothing has changed to which the block's functions refer (`fingerprint`).
"""

from ctrlplan.symbolic.extra import missing_casadi

__all__ = ["missing_casadi"]
