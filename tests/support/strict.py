"""Options of an interpreter in which a test runs a program: every warning is an error, as in the tests themselves."""

_ELSEWHERE = ("matplotlib._fontconfig_pattern", "matplotlib._mathtext", "pyparsing.util")
"""Modules of matplotlib 3.9 that use names which newer pyparsing calls deprecated."""

WARNINGS = ["-W", "error", *(part for name in _ELSEWHERE for part in ("-W", f"ignore::DeprecationWarning:{name}"))]
