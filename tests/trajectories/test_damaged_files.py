"""Damaged files of trajectories: one ValueError, whatever is wrong."""

import contextlib
import copy
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

from ctrlplan.trajectories import (
    PathPlan,
    PiecewiseSpline,
    PolySpline,
    Retimed,
    SCurve,
    Shaper,
    Step,
    TimeLaw,
    Trajectory,
    Trapezoid,
    TrigSpline,
    Waypoint,
    load_trajectory,
    stack,
    trajectory_from_dict,
)

pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]
MOVE = PolySpline(REST)
SAVED = [
    plan.to_dict()
    for plan in (
        MOVE,
        TrigSpline(REST, alpha=2.0, gamma=0.3, degree=4),
        TrigSpline.cyclic(REST, 3.0),
        PiecewiseSpline([REST[0], Waypoint(0.4, 0.2), REST[1]], alpha=1.0),
        Step([1.0, 2.0], 0.0, 0.5),
        SCurve(2.0, velocity=1, acceleration=1, jerk=1),
        Trapezoid(2.0, velocity=1, acceleration=1),
        MOVE + MOVE,
        2.0 * MOVE,
        stack([MOVE, MOVE], ["a", "b"]).select("b"),
        MOVE.then(MOVE + Step(1.0, 1.0)),
        Shaper.zv(5.0)(MOVE),
        Retimed(MOVE, PolySpline([Waypoint(0, 0), Waypoint(3, 1)])),
        PathPlan([PolySpline([Waypoint(0, [0, 0], [1, 0]), Waypoint(1, [1, 1], [1, 2])])], [1], MOVE),
        TimeLaw([0, 1, 2], [[0, 4], [2, 4], [4, 0]], 1.0),
    )
]
HOSTILE = [
    None,
    True,
    False,
    "",
    "3",
    "PolySpline",
    [],
    {},
    [[]],
    [None],
    {"type": "Step"},
    0,
    -1,
    10**400,
    -(10**5000),
    1e308,
    -1e308,
    5e-324,
    1e160,
    1e-160,
    0.5,
    101,
    math.nan,
    math.inf,
    -math.inf,
]


def places(data, path=()):
    """Every place in nested data."""
    if path:
        yield path
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from places(value, (*path, key))


def loaded_or_rejected(data):
    """A plan that works, or a ValueError; nothing else, and no warning."""
    try:
        plan = trajectory_from_dict(data)
    except ValueError:
        return
    assert isinstance(plan, Trajectory)
    try:
        values = plan.jet(np.linspace(plan.start, plan.end, 5), 1)
    except ValueError as error:
        assert "floating point" in str(error)  # noqa: PT017 -- a plan of 1e-160 s has no such derivative
        return
    assert np.isfinite(values).all()


@pytest.mark.slow
@examples(400)
@given(st.data())
def test_one_entry_replaced_or_missing(data):
    damaged = copy.deepcopy(data.draw(st.sampled_from(SAVED)))
    for _ in range(data.draw(st.integers(1, 2))):
        where = data.draw(st.sampled_from(sorted(places(damaged), key=str)))
        inner = damaged
        for key in where[:-1]:
            inner = inner[key]
        if isinstance(inner, dict) and data.draw(st.booleans()):
            del inner[where[-1]]
        else:
            inner[where[-1]] = copy.deepcopy(data.draw(st.sampled_from(HOSTILE)))
        if not list(places(damaged)):
            break
    loaded_or_rejected(damaged)


json_like = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.slow
@examples(300)
@given(st.sampled_from(SAVED), json_like, st.data())
def test_any_json_in_any_place(saved, value, data):
    damaged = copy.deepcopy(saved)
    damaged[data.draw(st.sampled_from(sorted(damaged)))] = value
    loaded_or_rejected(damaged)
    loaded_or_rejected(value)


@examples(200)
@given(st.sampled_from(SAVED), st.data())
def test_bytes_missing_or_changed(saved, data):
    text = bytearray(json.dumps(saved).encode())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text) - 1))
        if data.draw(st.booleans()):
            text[at] = data.draw(st.integers(0, 255))
        else:
            del text[at : at + data.draw(st.integers(1, 40))]
    with contextlib.suppress(UnicodeDecodeError, json.JSONDecodeError):
        loaded_or_rejected(json.loads(bytes(text).decode()))


def nested(kind, depth):
    """A file whose parts lie as deep in one another."""
    inner = json.dumps(MOVE.to_dict())
    return f'{{"type": "{kind}", "labels": ["y"], "factor": 1.0, "parts": [' * depth + inner + "]}" * depth


CONTENTS = {
    "lists without end": "[" * 100_000,
    "deep lists": "[" * 100_000 + "]" * 100_000,
    "deep sums": nested("Sum", 3000),
    "deep multiples": nested("Scaled", 100_000),
    "a huge exponent": '{"type": "Step", "final": [1e999], "initial": [0], "time": 0, "labels": ["y"]}',
    "a huge whole number": '{"type": "Step", "final": [1'
    + "0" * 400
    + '], "initial": [0], "time": 0, "labels": ["y"]}',
    "more digits than Python reads": '{"type": "Step", "final": [' + "1" * 5000 + '], "time": 0, "labels": ["y"]}',
    "a time beyond floats": '{"type": "PolySpline", "waypoints": [{"time": 1' + "0" * 400 + ', "jet": [[1.0]]}]}',
    "nan": '{"type": "PolySpline", "waypoints": [{"time": 0, "jet": [[NaN]]}, {"time": 1, "jet": [[1], [2]]}]}',
    "infinity": '{"type": "Step", "final": [-Infinity], "initial": [0], "time": 0, "labels": ["y"]}',
    "a truth value": '{"type": "PolySpline", "waypoints": [{"time": true, "jet": [[1]]}, {"time": 2, "jet": [[1]]}]}',
    "a number as text": '{"type": "PolySpline", "waypoints": [{"time": "0", "jet": [[1]]}, {"time": 2, "jet": [[1]]}]}',
    "a byte order mark": "\ufeff{}",
    "a null byte": '{"type": "Step\x00"}',
    "half of a file": json.dumps(MOVE.to_dict())[:40],
    "two files": json.dumps(MOVE.to_dict()) * 2,
    "nothing": "",
}


@pytest.mark.parametrize("name", CONTENTS)
def test_what_a_damaged_file_holds(name, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(CONTENTS[name], encoding="utf-8")
    with pytest.raises(ValueError, match=r"plan\.json must contain a saved trajectory: "):
        load_trajectory(path)


def test_data_that_are_no_json(tmp_path):
    for content in (b"\xff\xfe", b"\x80", bytes(range(256)), "{}".encode("utf-16")):
        (tmp_path / "plan.json").write_bytes(content)
        with pytest.raises(ValueError, match="must contain a saved trajectory: "):
            load_trajectory(tmp_path / "plan.json")


@pytest.mark.slow
def test_data_nested_without_end():
    data = MOVE.to_dict()
    for _ in range(5000):
        data = {"type": "Sum", "parts": [data], "labels": ["y"]}
    with pytest.raises(ValueError, match="nested so deeply"):
        trajectory_from_dict(data)
    data["parts"] = [data]
    with pytest.raises(ValueError, match="nested so deeply"):
        trajectory_from_dict(data)
