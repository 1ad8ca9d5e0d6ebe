"""Equations of python-control's blocks as CasADi expressions, verified against Python.

A block is called with symbols in place of numbers (`tracing`, `symbols`). The
result is used only if it agrees with Python (`comparison`), and only while the
objects that the block's functions refer to are unchanged (`fingerprint`).
"""

from ctrlplan.symbolic.extra import missing_casadi

__all__ = ["missing_casadi"]
