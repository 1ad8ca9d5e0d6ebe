"""What is no plain number is rejected wherever a trajectory takes numbers."""

import datetime
import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest

from ctrlplan.trajectories import (
    PiecewiseSpline,
    PolySpline,
    Scaled,
    SCurve,
    Shaper,
    Step,
    Transition,
    Trapezoid,
    TrigSpline,
    Waypoint,
    residual_spectrum,
)

pytestmark = pytest.mark.every_combination


class Quantity(float):
    """A number with a unit, as pint's."""

    units = "millisecond"


REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]
MOVE = PolySpline(REST)
WRONG = [
    "3",
    b"3",
    "2.5e0",
    True,
    np.True_,
    1 + 0j,
    np.complex128(2.0),
    np.timedelta64(3, "s"),
    np.datetime64("2024-01-01"),
    pd.Timedelta(seconds=3),
    pd.Timestamp("2024-01-01"),
    datetime.timedelta(seconds=3),
    np.array(3, dtype="m8[s]"),
    np.array(True),
    np.ma.masked,
    Quantity(3.0),
]
SCALARS = {
    "Waypoint.time": lambda x: Waypoint(x, 0.0),
    "from_jets": lambda x: Waypoint.from_jets(x, y=[0.0]),
    "retime": MOVE.retime,
    "shift": MOVE.shift,
    "Step.time": lambda x: Step(1.0, time=x),
    "Trapezoid.time": lambda x: Trapezoid(1.0, velocity=1.0, acceleration=1.0, time=x),
    "TrigSpline.alpha": lambda x: TrigSpline(REST, alpha=x),
    "TrigSpline.gamma": lambda x: TrigSpline(REST, alpha=1.0, gamma=x),
    "TrigSpline.degree": lambda x: TrigSpline(REST, alpha=1.0, degree=x),
    "PolySpline.smooth": lambda x: PolySpline(REST, smooth=x),
    "PiecewiseSpline.alpha": lambda x: PiecewiseSpline(REST, alpha=x),
    "cyclic.period": lambda x: TrigSpline.cyclic(REST, x),
    "Scaled.factor": lambda x: Scaled(MOVE, x),
    "multiplication": lambda x: MOVE * x,
    "division": lambda x: MOVE / x,
    "Shaper.frequency": Shaper.zv,
    "Shaper.damping": lambda x: Shaper.mzv(1.0, x),
    "Shaper.tolerance": lambda x: Shaper.ei(1.0, 0.0, x),
    "Shaper.on_grid": Shaper.zv(1.0).on_grid,
    "fit.tolerance": lambda x: Shaper.fit([1.0], [1.0], tolerance=x),
    "fit.damping": lambda x: Shaper.fit([1.0], [1.0], damping=x),
    "Shaper.derivatives": lambda x: Shaper.zvd(1.0, 0.0, x),
    "Transition.order": lambda x: Transition(x, 1.0),
    "Transition.horizon": lambda x: Transition(2, x),
    "Transition.alpha": lambda x: Transition(2, 1.0, x),
    "radius": lambda x: Transition(2, 1.0).radius(x),
    "nu": lambda x: MOVE(0.5, x),
    "order": lambda x: MOVE.jet(0.5, x),
    "extrema": MOVE.extrema,
}
ARRAYS = {
    "position": lambda x: Waypoint(0.0, x),
    "velocity": lambda x: Waypoint(0.0, [0.0, 0.0], x),
    "a jet of from_jets": lambda x: Waypoint.from_jets(0.0, y=[0.0, *np.atleast_1d(x).tolist()]),
    "Step.final": Step,
    "Step.initial": lambda x: Step([1.0, 2.0], x),
    "Trapezoid.final": lambda x: Trapezoid(x, velocity=1.0, acceleration=1.0),
    "SCurve.velocity": lambda x: SCurve(1.0, velocity=x, acceleration=1.0, jerk=1.0),
    "SCurve.jerk": lambda x: SCurve(1.0, velocity=1.0, acceleration=1.0, jerk=x),
    "Shaper.delays": lambda x: Shaper(x, [0.5, 0.5]),
    "Shaper.weights": lambda x: Shaper([0.0, 1.0], x),
    "residual": lambda x: Shaper.zv(1.0).residual(x),
    "damping": lambda x: Shaper.zv(1.0).residual(1.0, x),
    "fit.frequencies": lambda x: Shaper.fit(x, [1.0, 1.0]),
    "fit.response": lambda x: Shaper.fit([1.0, 2.0], x),
    "spectrum.frequencies": lambda x: residual_spectrum(MOVE, x),
    "spectrum.damping": lambda x: residual_spectrum(MOVE, [1.0, 2.0], x),
}
SEVERAL = [
    [True, False],
    [1.0, True],
    (0.5, np.False_),
    ["1", "2"],
    np.array(["1", "2"]),
    np.array([True, False]),
    np.array([1.0, True], dtype=object),
    [1j, 0j],
    np.array([1 + 0j, 2]),
    pd.to_timedelta([1, 2], unit="s"),
    pd.Series([True, False]),
    np.array([1, 2], dtype="m8[ms]"),
    np.ma.masked_array([1.0, 2.0], mask=[False, True]),
    [Quantity(1.0), 2.0],
]


@pytest.mark.parametrize("value", WRONG, ids=repr)
@pytest.mark.parametrize("place", SCALARS)
def test_one_number(place, value):
    if value is np.ma.masked and place in ("multiplication", "division"):
        pytest.skip("numpy multiplies by a mask itself")
    with pytest.raises((TypeError, ValueError)):
        SCALARS[place](value)


@pytest.mark.parametrize("value", [*WRONG, *SEVERAL], ids=repr)
@pytest.mark.parametrize("place", [place for place in ARRAYS if "from_jets" not in place])
def test_several_numbers(place, value):
    with pytest.raises((TypeError, ValueError), match=r"must"):
        ARRAYS[place](value)


@pytest.mark.parametrize("value", [[0.0, "1"], [0.0, True], [1j], [np.timedelta64(1, "s")], [[0.0]], "12"])
def test_jets_by_axis(value):
    with pytest.raises((TypeError, ValueError), match="jet of axis y must be"):
        Waypoint.from_jets(0.0, y=value)


def test_the_message_names_what_was_given():
    with pytest.raises(TypeError, match="time must be a number, got '3'"):
        Waypoint("3", 0)
    with pytest.raises(TypeError, match="time must be a number, got True"):
        Waypoint(True, 0)
    with pytest.raises(ValueError, match="velocity must be numbers, got 'fast'"):
        Waypoint(0, [0, 1], [1.0, "fast"])
    with pytest.raises(ValueError, match="position must be numbers, got False"):
        Waypoint(0, [0.0, False])
    with pytest.raises(TypeError, match="duration must be a number, got"):
        MOVE.retime(np.timedelta64(2, "s"))


@pytest.mark.parametrize("kind", [int, np.int8, np.uint64, np.float32, np.float64, Fraction, Decimal, np.array])
def test_numbers_of_any_kind(kind):
    point = Waypoint(kind(2), kind(3), kind(1))
    assert point == Waypoint(2.0, 3.0, 1.0)
    assert type(point.time) is float
    assert MOVE.retime(kind(2)).duration == 2.0
    assert MOVE.shift(kind(2)).start == 2.0
    assert Step(kind(2)).final.tolist() == [2.0]
    assert Trapezoid(kind(3), velocity=kind(1), acceleration=kind(1)).end == 4.0
    assert TrigSpline(REST, alpha=kind(2)).alpha == 2.0
    assert Waypoint(0, [kind(1), None, math.nan]).jet[0, 0] == 1.0


TIMES = [
    pd.to_timedelta([0.2, 0.4], unit="s"),
    pd.Series(pd.to_timedelta([0.2, 0.4], unit="s")),
    np.array([0, 1], dtype="m8[s]"),
    pd.date_range("2024-01-01", periods=2),
    [datetime.timedelta(seconds=0.2)],
    np.timedelta64(1, "s"),
    np.array([0.2 + 0j]),
    np.ma.masked_array([0.2, 0.4], mask=[True, False]),
    ["0.2"],
    Quantity(1.0),
]


@pytest.mark.parametrize("times", TIMES, ids=repr)
def test_times_are_plain_seconds(times, tmp_path):
    path = tmp_path / "plan.csv"
    for call in (MOVE, lambda t: MOVE.jet(t, 1), lambda t: MOVE.to_csv(path, t)):
        with pytest.raises((TypeError, ValueError), match="times must"):
            call(times)
    assert not path.exists()


def test_times_of_pandas_without_a_unit():
    np.testing.assert_array_equal(MOVE(pd.Series([0.2, 0.4])), MOVE([0.2, 0.4]))
    np.testing.assert_array_equal(MOVE(pd.Index([0, 1])), MOVE([0.0, 1.0]))
    np.testing.assert_array_equal(MOVE(np.ma.masked_array([0.2, 0.4])), MOVE([0.2, 0.4]))


@pytest.mark.parametrize(
    ("timepts", "said"),
    [
        (1e-3, r"got the scalar 0.001; for one row every 0.001 s pass np.arange\(plan.start, plan.end, 0.001\)"),
        (np.float64(0.5), "got the scalar 0.5"),
        ([[0.0, 0.5], [0.7, 1.0]], r"got shape \(2, 2\)"),
    ],
)
def test_a_sampling_period_is_no_table(timepts, said, tmp_path):
    with pytest.raises(ValueError, match=rf"timepts must be sample times of shape \(ntime,\), {said}"):
        MOVE.to_csv(tmp_path / "plan.csv", timepts)
    assert list(tmp_path.iterdir()) == []
