"""The JSON Schema of study files says what their reader says."""

import inspect
import re
import tomllib

import pytest
from study_schema import schema_errors, structure_error, validator
from study_text import VALID, valid

from ctrlplan.planning.obstacles import Disc, HalfPlane, Rectangle
from ctrlplan.studies import files
from ctrlplan.studies.loops import LOOP_KINDS
from ctrlplan.studies.planned import OBSTACLES, is_shipped
from ctrlplan.studies.schema import SCHEMA, schema_text
from ctrlplan.trajectories.waypoint_spline import families

REST = [{"time": 0.0, "x": [0.0, 0.0, 0.0]}, {"time": 16.0, "x": [20.0, 0.0, 0.0]}]
CHANGES = {
    "nothing": {},
    "CSV": {"waypoints": "path.csv"},
    "CSV with a speed": {"waypoints": {"csv": "path.csv", "columns": ["x", 2], "time": 0, "speed": 2.0}},
    "limits": {"limits": {"velocity": 1.0, "acceleration": [1.0, 2.0], "F": {"high": 3}}},
    "plans": {
        "plans": [{"name": "polynomial", "fastest": "path"}, {"family": "step"}, {"family": "python:a:B", "q": 1}]
    },
    "shape": {"plans": [{"family": "trigonometric", "alpha": "auto", "gamma": [0.5]}]},
    "obstacles": {
        "obstacles": [
            {"shape": "disc", "centre": [1, 2], "radius": 3},
            {"shape": "rectangle", "x": [1, 2], "z": [3, 4]},
            {"shape": "half_plane", "normal": [1, 2], "offset": 0},
        ],
        "avoid": {"clearance": 0, "load": 1.0, "rope": True, "max_points": 2},
    },
    "sweep": {"sweep": {"parameter": "gain", "values": [1, 2], "metrics": ["iae"]}},
    "grid": {"sweep": {"parameter": "gain", "values": {"low": 1, "high": 2, "count": 3, "scale": "log"}}},
    "draws": {"draws": {"count": 3, "seed": 2, "parameters": {"gain": [1, 2]}}},
    "module": {"loop": {"kind": "python:a.b:c"}},
    "crane": {"loop": {"kind": "crane", "law": "still", "force_limits": [-1, 2], "load_mass": 3, "rope_wrap": True}},
    "experiment": {
        "experiment": {
            "start": 1,
            "initial_state": [0, 1.5],
            "params": {"m": 2, "law": {"k": [1]}},
            "events": [{"signal": "u", "high": 3, "stop": True}],
        }
    },
    "measured": {
        "measured": {"poly": {"log": "log.csv", "signals": {"y": 1}, "align": False, "fit": True}, "step": "a.mat"}
    },
    "text": {"author": "A. Engineer", "text": ["One.", "Two."]},
}


def test_the_schema_of_the_package_is_that_of_the_reader():
    """To write it: python -c "from ctrlplan.studies.schema import *; SCHEMA.write_text(schema_text())"."""
    assert SCHEMA.read_text(encoding="utf-8") == schema_text()


@pytest.mark.parametrize("name", CHANGES)
def test_it_accepts_what_the_reader_accepts(name):
    data = valid(**CHANGES[name])
    assert structure_error(data) is None
    assert schema_errors(data) == []


def test_it_accepts_the_files_of_the_documentation():
    text = inspect.cleandoc(files.__doc__)
    blocks = re.findall(r"\.\. code-block:: toml\n\n((?:    .*\n|\n)+)", text)
    whole, further = (tomllib.loads(inspect.cleandoc(block)) for block in blocks)
    for data in (whole, VALID | further):
        assert structure_error(data) is None
        assert schema_errors(data) == []


def test_it_has_every_family_loop_and_obstacle():
    branches = validator().schema["properties"]["plans"]["items"]["anyOf"]
    named = {branch["properties"]["family"].get("const") for branch in branches if "family" in branch["properties"]}
    own = {name for name, kind in families().items() if is_shipped(kind)}
    assert named == own | {"step", None}
    loops = validator().schema["properties"]["loop"]["anyOf"]
    assert {branch["properties"]["kind"].get("const") for branch in loops} == {*LOOP_KINDS, None}
    for kind, table in zip((Rectangle, Disc, HalfPlane), OBSTACLES.item.tables().values(), strict=True):
        assert list(table.entries) == list(inspect.signature(kind).parameters)


@pytest.mark.parametrize("family", ["trigonometric", "s_curve"])
def test_options_without_a_default_are_required(family):
    """Those of the class: alpha; velocity, acceleration and jerk."""
    kind = families()[family]
    for name, one in inspect.signature(kind).parameters.items():
        if name in kind.options and one.default is one.empty:
            options = {other: 1.0 for other in kind.options if other != name}
            data = valid(plans=[{"family": family, **options}], waypoints=REST)
            assert "must be" in structure_error(data)
            assert schema_errors(data)
