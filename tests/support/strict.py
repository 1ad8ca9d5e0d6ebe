"""Options of an interpreter in which a test runs a program: every warning is an error, as in the tests themselves."""

import importlib.util
from pathlib import Path

_CONTROL = Path(importlib.util.find_spec("control").origin).parent

_ELSEWHERE = (
    "matplotlib._fontconfig_pattern",
    "matplotlib._mathtext",
    "pyparsing.util",
    *sorted(f"control.{path.stem}" for path in _CONTROL.glob("*.py")),
)
"""Modules that use what other packages call deprecated: of matplotlib 3.9 (pyparsing), and of control (numpy 2.5)."""

WARNINGS = ["-W", "error", *(part for name in _ELSEWHERE for part in ("-W", f"ignore::DeprecationWarning:{name}"))]
