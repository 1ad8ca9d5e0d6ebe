"""Verdicts and numbers in words."""

import math
import unicodedata

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ctrlplan as cp
from ctrlplan.reports import summary, verdicts
from ctrlplan.studies import MEASURES, Comparison
from ctrlplan.studies.verdicts import TIE, number, unit_of

PLAN = cp.Step(1.0, labels=["x"])
NAN, INF = math.nan, math.inf


def comparison(metric="settling_time", units=None, **values):
    plans = dict.fromkeys(values, PLAN)
    found = {plan: {metric: value} for plan, value in values.items()}
    return Comparison(plans, {}, found, outputs=("y",), controls=("u",), units=units or {})


def verdict(*arguments, **values):
    (found,) = verdicts(comparison(*arguments, **values))
    return found


def test_the_minimum_is_best_and_the_maximum_worst():
    found = verdict(a=2.0, b=1.0, c=3.0)
    assert (found.best, found.worst, found.minimum, found.maximum) == (("b",), ("c",), 1.0, 3.0)
    assert found.sentence == "Settling time: best 1.000 s (b), worst 3.000 s (c), ratio 3.000."


def test_several_plans_may_be_best_or_worst():
    found = verdict(a=1.0, b=1.0, c=3.0)
    assert found.best == ("a", "b")
    assert "best 1.000 s (a and b), worst 3.000 s (c)" in found.sentence
    found = verdict(a=1.0, b=3.0, c=3.0, d=3.0)
    assert found.worst == ("b", "c", "d")
    assert "best 1.000 s (a), worst 3.000 s (b, c and d)" in found.sentence


@pytest.mark.parametrize(("factor", "tied"), [(1 + 0.9 * TIE, True), (1 + 1.1 * TIE, False)])
def test_values_within_one_percent_are_equal(factor, tied):
    found = verdict(a=1.0, b=factor)
    assert (found.best == found.worst == ()) is tied
    assert ("equal for a and b" in found.sentence) is tied
    found = verdict(a=1.0, b=factor, c=2.0)
    assert found.best == (("a", "b") if tied else ("a",))


def test_an_undefined_value_is_not_ranked():
    found = verdict(a=NAN, b=1.0, c=2.0)
    assert (found.best, found.worst) == (("b",), ("c",))
    assert verdicts(comparison(a=NAN, b=1.0)) == []
    assert verdicts(comparison(a=NAN, b=NAN)) == []
    assert verdicts(comparison(a=1.0)) == []


def test_an_infinite_value_is_worst_and_infinite_values_are_equal():
    found = verdict(a=INF, b=1.0)
    assert (found.best, found.worst) == (("b",), ("a",))
    assert found.sentence == "Settling time: best 1.000 s (b), worst never (a)."
    found = verdict(a=INF, b=INF)
    assert found.best == found.worst == ()
    assert "equal for a and b" in found.sentence


def test_zero_is_best_and_is_not_divided_by():
    found = verdict("overshoot_error", a=0.0, b=5.0)
    assert found.sentence == "Overshoot on the tracking error: best 0 % (a), worst 5.000 % (b)."
    found = verdict("overshoot_error", a=1e-13, b=3e-12)
    assert found.best == ()


def test_a_metric_may_be_negative():
    found = verdict("wandering", a=-0.2, b=0.1)
    assert (found.best, found.worst) == (("a",), ("b",))
    assert "best −0.2000 (a), worst 0.1000 (b)." in found.sentence


def test_verdicts_stand_in_the_order_of_the_measures():
    found = {name: dict.fromkeys(reversed(MEASURES), value) for name, value in (("a", 1.0), ("b", 2.0))}
    given_ = Comparison(dict.fromkeys(found, PLAN), {}, found, outputs=("y",))
    assert [v.key for v in verdicts(given_)] == list(MEASURES)


def test_the_summary_counts():
    found = {
        "a": {"settling_time": 1.0, "iae": 1.0, "ise": 1.0},
        "b": {"settling_time": 2.0, "iae": 1.0, "ise": 0.5},
        "c": {"settling_time": 3.0, "iae": 1.0, "ise": 2.0},
    }
    said = summary(Comparison(dict.fromkeys(found, PLAN), {}, found, outputs=("y",)))
    assert said.startswith("Of 2 metrics that differ between the plans, ")
    assert "a is best in 1 and worst in 0; b is best in 1 and worst in 0; c is best in 0 and worst in 2" in said
    assert "within 1 %" in said


def test_where_nothing_tells_them_apart_the_summary_says_so():
    assert summary(comparison(a=1.0, b=1.0)) == "No metric differs between the plans."
    assert summary(comparison(a=1.0)) == "No metric differs between the plans."


@pytest.mark.parametrize(
    ("metric", "unit"),
    [
        ("settling_time", "s"),
        ("overshoot_error", "%"),
        ("iae", "m s"),
        ("ise_final", "m² s"),
        ("itae", "m s²"),
        ("control_peak", "kN"),
        ("control_effort", "kN² s"),
        ("wandering", ""),
        ("outside_box", "m"),
        ("reference_jerk", "m²/s⁵"),
    ],
)
def test_units(metric, unit):
    assert unit_of(comparison(metric, units={"x": "m", "u": "kN"}, a=1.0), metric) == unit
    without = unit_of(comparison(metric, a=1.0), metric)
    assert without == (unit if metric in ("settling_time", "overshoot_error") else "")


def test_axes_of_different_units_have_none_in_common():
    found = {"a": {"iae": 1.0}, "b": {"iae": 2.0}}
    plans = dict.fromkeys(found, cp.Step([1.0, 2.0], labels=["x", "theta"]))
    assert unit_of(Comparison(plans, {}, found, outputs=("x", "theta"), units={"x": "m", "theta": "rad"}), "iae") == ""
    assert unit_of(Comparison(plans, {}, found, outputs=("x", "theta"), units={"x": "m", "theta": "m"}), "iae") == "m s"
    assert unit_of(Comparison(plans, {}, found, outputs=("x", "theta"), units={"x": "m"}), "iae") == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (7.56125, "7.561"),
        (48.6397, "48.64"),
        (100.0, "100.0"),
        (1500.0, "1500"),
        (0.634705, "0.6347"),
        (0.001, "0.001000"),
        (-1.5, "−1.500"),
        (123456.0, "1.235·10⁵"),
        (1.5e-7, "1.500·10⁻⁷"),
        (NAN, "–"),
        (INF, "∞"),
        (-INF, "−∞"),
    ],
)
def test_numbers(value, text):
    assert number(value) == text


@given(st.floats(1e-8, 1e12) | st.floats(-1e12, -1e-8))
def test_a_number_is_told_to_four_digits(value):
    text = unicodedata.normalize("NFKC", number(value).replace("·10", "e")).replace("−", "-")
    assert float(text) == pytest.approx(value, rel=5.0001e-4)
    assert np.sign(float(text)) == np.sign(value)
    assert len(text) <= 10
