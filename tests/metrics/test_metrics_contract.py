"""What every exported metric promises: read off the exports and the signatures, so that a new one is tested too."""

import inspect

import numpy as np
import pandas as pd
import pytest

from ctrlplan import metrics

pytestmark = pytest.mark.every_combination

NAMES = sorted(metrics.__all__)
SIGNALS = ("y", "error", "u", "signal", "path", "jerk")
TIMES = np.array([0.0, 0.5, 1.5, 2.0, 3.0, 4.5, 5.0])
RECORD = np.array([0.0, 2.0, -1.0, 1.5, 0.5, 1.0, 1.0])
REST = {"final": 1.0, "initial": 0.0, "lower": -1.0, "upper": 1.0, "reference": RECORD[::-1], "points": [0.0, 1.0]}


def arguments(name):
    """Return the required arguments, by name, and which of them is the signal."""
    parameters = inspect.signature(getattr(metrics, name)).parameters
    required = [p.name for p in parameters.values() if p.default is inspect.Parameter.empty]
    (signal,) = [p for p in required if p in SIGNALS]
    return {p: {"timepts": TIMES, signal: RECORD, **REST}[p] for p in required}, signal


def call(name, **changes):
    """Call a metric on the standard record with some arguments changed; `signal` stands for the signal."""
    given, signal = arguments(name)
    if "signal" in changes:
        changes[signal] = changes.pop("signal")
    return getattr(metrics, name)(**{**given, **changes})


def test_all_is_what_is_visible():
    visible = {n for n in dir(metrics) if not n.startswith("_")}
    assert visible == set(metrics.__all__)
    assert len(metrics.__all__) == len(set(metrics.__all__))


@pytest.mark.parametrize("name", NAMES)
def test_docstring_has_every_section(name):
    doc = inspect.getdoc(getattr(metrics, name))
    assert len(doc.splitlines()[0]) <= 64
    for section in ("Parameters", "Returns", "Raises", "Examples"):
        assert f"\n{section}\n{'-' * len(section)}\n" in doc
    for parameter in inspect.signature(getattr(metrics, name)).parameters:
        assert parameter in doc


@pytest.mark.parametrize("name", NAMES)
def test_one_record_gives_a_plain_number(name):
    value = call(name)
    assert type(value) is (int if name == "turning_points" else float)
    assert value >= 0 or name == "wandering"


@pytest.mark.parametrize("name", NAMES)
def test_lists_and_integers_are_signals(name):
    assert call(name, timepts=list(TIMES), signal=list(RECORD)) == call(name)
    whole = np.array([0, 3, 1, 2, 2, 1, 1])
    assert call(name, signal=whole) == call(name, signal=whole.astype(float))


@pytest.mark.parametrize("name", [n for n in NAMES if arguments(n)[1] not in ("path", "jerk")])
def test_leading_axes_are_rows_of_their_own(name):
    rows = np.array([[RECORD, 2 * RECORD, RECORD[::-1]], [-RECORD, RECORD**2, 3 - RECORD]])
    values = call(name, signal=rows)
    assert values.shape == (2, 3)
    assert values.dtype == np.float64
    for place in np.ndindex(2, 3):
        assert values[place] == call(name, signal=rows[place])


@pytest.mark.parametrize("name", NAMES)
def test_nan_is_rejected_by_name_and_place(name):
    given, signal = arguments(name)
    bad = RECORD.copy()
    bad[4] = np.nan
    with pytest.raises(ValueError, match=rf"^{signal} must contain no nan, got {signal}\[4\] = nan"):
        getattr(metrics, name)(**{**given, signal: bad})


OTHERS = [(n, p) for n in NAMES for p in REST if p in inspect.signature(getattr(metrics, n)).parameters]


@pytest.mark.parametrize(("name", "other"), OTHERS)
def test_nan_in_the_other_arguments_is_rejected_by_name(name, other):
    bad = np.array(REST[other], dtype=float)
    bad[(-1,) * bad.ndim] = np.nan
    with pytest.raises(ValueError, match=rf"^{other} must contain no nan, got {other}"):
        call(name, **{other: bad})


@pytest.mark.parametrize(("name", "other"), [pair for pair in OTHERS if pair[1] not in ("lower", "upper")])
def test_levels_and_points_are_finite(name, other):
    bad = np.array(REST[other], dtype=float)
    bad[(-1,) * bad.ndim] = -np.inf
    with pytest.raises(ValueError, match=rf"^{other} must be finite, got {other}.* = -inf"):
        call(name, **{other: bad})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("timepts", "message"),
    [
        ([0.0, 1.0, 2.0, 2.0, 3.0, 4.0, 5.0], r"timepts must increase strictly, got timepts\[3\] = 2.0 after 2.0"),
        ([0.0, 1.0, 2.0, 1.5, 3.0, 4.0, 5.0], r"timepts must increase strictly, got timepts\[3\] = 1.5 after 2.0"),
        ([0.0, 1.0, 2.0, 2.5, 3.0, 4.0, np.inf], r"timepts must be finite, got timepts\[6\] = inf"),
        ([0.0, np.nan, 2.0, 2.5, 3.0, 4.0, 5.0], r"timepts must contain no nan, got timepts\[1\] = nan"),
        ([0.0], r"timepts must be 1-D with at least 2 samples, got shape \(1,\)"),
        ([TIMES], r"timepts must be 1-D with at least 2 samples, got shape \(1, 7\)"),
        (TIMES[:-1], r"must have 6 samples on its last axis, as timepts has, got shape \(7,\)"),
    ],
)
def test_wrong_times_are_rejected(name, timepts, message):
    with pytest.raises(ValueError, match=message):
        call(name, timepts=timepts)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [RECORD + 0j, RECORD.astype(str), [[0.0], [1.0, 2.0]], RECORD.astype(object)])
def test_what_is_not_real_is_a_type_error(name, kind):
    with pytest.raises(TypeError, match=rf"^{arguments(name)[1]} must be an array of real numbers, got "):
        call(name, signal=kind)


@pytest.mark.parametrize("name", NAMES)
def test_a_scalar_is_no_signal(name):
    with pytest.raises(ValueError, match=r"got shape \(\)"):
        call(name, signal=1.0)


INFINITE = [n for n in NAMES if n not in ("lag", "saturation_time", "turning_points")]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("place", range(7))
def test_a_diverged_record_is_infinite_and_silent(name, place):
    record = RECORD.copy()
    record[place] = np.inf
    value = call(name, signal=record)
    assert value == np.inf if name in INFINITE else np.isfinite(value)
    record[place:] = np.inf
    value = call(name, signal=record)
    assert value == np.inf if name in INFINITE else np.isfinite(value)
    record[place] = -np.inf
    assert not np.isnan(call(name, signal=record))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("size", [1e300, 1e308, 5e-324])
def test_huge_and_tiny_values_are_silent(name, size):
    wild = size * np.array([0.0, 1.0, -1.0, 1.0, 1.0, -1.0, 0.5])
    assert call(name, signal=wild) >= -1
    close = np.array([0.0, 1e-300, 1e-150, 1e-9, 1.0, 2.0, 3.0])
    assert call(name, signal=wild, timepts=close) >= -1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [2, 3, 4, 5, 6])
def test_short_records_have_a_value(name, count):
    changes = {"timepts": TIMES[:count], "signal": RECORD[:count]}
    if name == "tracking_settling_time":
        changes["reference"] = RECORD[:count][::-1]
    assert not np.isnan(call(name, **changes))


@pytest.mark.parametrize("name", NAMES)
def test_the_arguments_are_left_alone(name):
    before = TIMES.copy(), RECORD.copy()
    frozen = TIMES.copy(), RECORD.copy()
    for array in frozen:
        array.setflags(write=False)
    call(name, timepts=frozen[0], signal=frozen[1])
    np.testing.assert_array_equal(frozen, before)


class Quantity(np.ndarray):
    """Numbers with a unit, as pint's and astropy's."""

    units = "millisecond"


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "times",
    [
        np.arange(TIMES.size).astype("m8[s]"),
        pd.to_timedelta(np.arange(TIMES.size), unit="s"),
        pd.date_range("2024-01-01", periods=TIMES.size),
        TIMES.view(Quantity),
    ],
    ids=lambda times: type(times).__name__ + str(times.dtype),
)
def test_times_and_signals_carry_no_unit(name, times):
    with pytest.raises(TypeError, match="timepts must be plain numbers"):
        call(name, timepts=times)
    with pytest.raises(TypeError, match="must be plain numbers"):
        call(name, signal=times)


@pytest.mark.parametrize("name", NAMES)
def test_masked_samples_are_no_samples(name):
    masked = np.ma.masked_array(RECORD, mask=np.arange(RECORD.size) == 2)
    with pytest.raises(ValueError, match="must have no masked values"):
        call(name, signal=masked)
