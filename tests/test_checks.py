"""Checks of what a user gives: what they accept, what they say, and that they take the value before its name."""

import ast
import inspect
import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from ctrlplan import _checks
from ctrlplan._checks import check_kind, checked_finite, checked_limits, checked_names, checked_range, checked_vector

CHECKS = {
    name: function
    for name, function in vars(_checks).items()
    if inspect.isfunction(function) and not name.startswith("_") and function.__module__ == _checks.__name__
}
NAMELESS = {"checked_labels", "checked_params", "default_labels"}
"""What is always called labels or params."""


@pytest.mark.parametrize("check", [CHECKS[name] for name in sorted(set(CHECKS) - NAMELESS)])
def test_the_parameters_of_every_check_are_value_and_name(check):
    assert list(inspect.signature(check).parameters)[1] == "name"


@pytest.mark.slow
def test_so_does_every_check_of_one_module_alone():
    """Also those of their own modules: no function that checks begins with what the value is called."""
    wrong = [
        f"{path.name}: {node.name}"
        for path in Path(_checks.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and re.match(r"_?check(ed)?_", node.name)
        if [a.arg for a in node.args.args if a.arg not in ("self", "cls")][:1] in (["name"], ["label"])
    ]
    assert wrong == []


@pytest.mark.parametrize("value", [2, 2.0, np.float64(2.0), np.int8(2), np.array(2.0), Fraction(2)])
def test_a_finite_number_of_any_kind(value):
    found = checked_finite(value, "gain", above=1.0, minimum=2.0)
    assert (found, type(found)) == (2.0, float)


@pytest.mark.parametrize(
    ("value", "bounds", "kind", "message"),
    [
        (math.inf, {}, ValueError, "gain must be finite, got inf"),
        (math.nan, {"above": 0.0}, ValueError, "gain must be finite and above 0, got nan"),
        (0.0, {"above": 0.0}, ValueError, "gain must be finite and above 0, got 0.0"),
        (-1, {"minimum": 0.0}, ValueError, "gain must be finite and at least 0, got -1.0"),
        (10**400, {}, ValueError, "gain must be within floating point, got 1000"),
        (True, {}, TypeError, "gain must be a number, got True"),
        ("1", {}, TypeError, "gain must be a number, got '1'"),
        (1j, {}, TypeError, "gain must be a number, got 1j"),
        ([1.0], {}, TypeError, r"gain must be a number, got \[1.0\]"),
        (None, {}, TypeError, "gain must be a number, got None"),
        (np.timedelta64(1, "s"), {}, TypeError, "gain must be a number, got "),
    ],
)
def test_what_is_no_finite_number(value, bounds, kind, message):
    with pytest.raises(kind, match=f"^{message}"):
        checked_finite(value, "gain", **bounds)


def test_at_a_bound_that_is_allowed():
    assert checked_finite(0, "gain", minimum=0.0) == 0.0
    assert checked_finite(5e-324, "gain", above=0.0) == 5e-324


@pytest.mark.parametrize("given", [3, 3.0, np.array(3.0), (-3, 3), [-3.0, 3.0], np.array([-3.0, 3.0])])
def test_limits_and_their_short_form(given):
    assert checked_range(given, "limits") == (-3.0, 3.0)
    assert checked_limits(given, "limits") == (-3.0, 3.0, 3.0)


def test_limits_of_one_side():
    assert checked_range((-math.inf, math.inf), "limits") == (-math.inf, math.inf)
    assert checked_limits((-math.inf, 5.0), "limits") == (-math.inf, 5.0, 5.0)
    assert checked_limits((0.0, math.inf), "limits") == (0.0, math.inf, 1.0)
    with pytest.raises(ValueError, match=r"^limits must contain a finite one, got -inf and inf$"):
        checked_limits((-math.inf, math.inf), "limits")


def test_a_vector_is_a_copy_of_its_own():
    given = np.array([1.0, 2.0])
    found = checked_vector(given, "initial", 2)
    found[0] = 5.0
    assert given.tolist() == [1.0, 2.0]
    assert checked_vector(3, "initial", 2).tolist() == [3.0, 3.0]
    for wrong in ([1.0], [1.0, math.nan], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match=r"^initial must be a finite number or 2 of them, got \["):
            checked_vector(wrong, "initial", 2)
    with pytest.raises(TypeError, match=r"^initial must be real numbers, got 'ab'$"):
        checked_vector("ab", "initial", 2)


def test_names_of_signals():
    assert checked_names("u", "inputs", 1) == ["u"]
    assert checked_names(("r", "y"), "inputs") == ["r", "y"]
    assert checked_names((label for label in "ab"), "inputs", 2) == ["a", "b"]
    for wrong in (5, [1, 2], [""], "", None):
        with pytest.raises(TypeError, match=r"^inputs must be names of signals, got "):
            checked_names(wrong, "inputs")
    with pytest.raises(ValueError, match=r"^inputs must be 2 names, got 1: \['u'\]$"):
        checked_names("u", "inputs", 2)
    with pytest.raises(ValueError, match=r"^inputs must differ from each other, got u, v, u$"):
        checked_names(["u", "v", "u"], "inputs")


def test_kinds():
    check_kind(3, "order", int)
    with pytest.raises(TypeError, match=r"^order must be a str, got int$"):
        check_kind(3, "order", str)
    with pytest.raises(TypeError, match=r"^block must be a control system, got int$"):
        check_kind(3, "block", str, "a control system")


@pytest.mark.parametrize("values", [[True, False], np.array([True]), True])
def test_truth_values_are_no_numbers(values):
    with pytest.raises(TypeError, match="values must be numbers, got truth values"):
        _checks.array_of_numbers(values, "values")
