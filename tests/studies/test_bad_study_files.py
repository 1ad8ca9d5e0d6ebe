"""Every kind of wrong file: one line that says what must hold, what was given and where; status 2; nothing written."""

import math
import re
import tomllib

import pytest
from repetitions import one_in
from study_schema import is_json, schema_errors, structure_error
from study_text import Verbatim, to_toml, valid

from ctrlplan.cli import main
from ctrlplan.studies.files import StudyError, load_study

RULE = re.compile(r"\b(must|requires?)\b.*\bgot\b")


def changed(*path, to):
    """Return the valid file with one entry changed (or added)."""
    data = valid()
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return data


def without(*path):
    """Return the valid file with one entry taken out."""
    data = valid()
    place = data
    for key in path[:-1]:
        place = place[key]
    del place[path[-1]]
    return data


def plan(**choices):
    return valid(plans=[{"name": "mine", **choices}])


def points(*rows):
    return valid(waypoints=[{"time": t, "x": x} for t, x in rows])


def module(text, function="build"):
    """Return a file whose loop is in a module beside it, and the module."""
    return valid(loop={"kind": f"python:NAME:{function}"}, units={}), text


DECLARED = "import control as ct\n\ndef build() -> ct.InputOutputSystem:\n"
REST = [0.0, 0.0, 0.0]
END = [20.0, 0.0, 0.0]
BIG = 10**400

MOVE = [{"time": 0.0, "x": REST}, {"time": 16.0, "x": END}]
QUICK = {"plans": [{"family": "polynomial", "fastest": "shape"}], "waypoints": MOVE}
PLANAR = [{"time": 0.0, "x": REST, "y": REST}, {"time": 16.0, "x": END, "y": REST}]
DISC = {"shape": "disc", "centre": [10.0, 0.5], "radius": 2.0}
AROUND = {"plans": [{"family": "polynomial", "avoid": True}], "waypoints": PLANAR, "obstacles": [DISC], "units": {}}
SWEPT = {"parameter": "gain", "values": [1.0, 2.0]}
DRAWN = {"count": 3, "parameters": {"gain": [1.0, 2.0]}}


# What is wrong -> (data or text of the file, what the line must mention beside the file itself).
WRONG = {
    "not TOML": ("title = \n", ["TOML", "line 1"]),
    "not TOML to the end": ("title = [", ["TOML"]),
    "not TOML: a key twice": ("t_end = 1\nt_end = 2\n", ["TOML", "line 2"]),
    "not UTF-8": (b"title = '\xff\xfe'\n", []),
    "not TOML: nested too deep": ("a = " + 100_000 * "[", ["TOML", "nested"]),
    "not TOML: a number too long": (f"a = {'9' * 5000}\n", ["TOML"]),
    "not TOML: zeros alone": (b"\x00" * 1000, ["TOML"]),
    "larger than any study": (b"# " + b"x" * 2**20, ["1048576 bytes"]),
    "a name of many letters": (valid(**{"k" * 100_000: 1.0}), ["kkk", "…"]),
    "a list of many numbers": (valid(title=[0] * 50_000), ["title", "…"]),
    "a name that writes on the screen": (valid(**{"\x1b[2J\x07": 1.0}), ["x1b[2J"]),
    "empty": ("", ["waypoint"]),
    # Unknown keys, at every level
    "unknown key": (valid(tile="Over the wall"), ["tile"]),
    "unknown table": (valid(metrics={"band": 0.05}), ["metrics"]),
    "unknown key of the loop": (changed("loop", "gian", to=5.0), ["loop", "gian"]),
    "unknown key of a plan": (changed("plans", 1, "alpah", to=1.0), ["plans[1]", "alpah"]),
    "choice of another family": (changed("plans", 1, "alpha", to=1.0), ["plans[1]", "alpha"]),
    "unit of nothing": (changed("units", "q", to="m"), ["units", "q"]),
    # Waypoints
    "no waypoints": (without("waypoints"), ["waypoints", "got none"]),
    "empty waypoints": (valid(waypoints=[]), ["waypoints", "got 0"]),
    "one waypoint": (points((0.0, REST)), ["waypoints", "got 1"]),
    "waypoints are a number": (valid(waypoints=3), ["waypoints", "3"]),
    "waypoints are a table": (valid(waypoints={"time": 0.0, "x": REST}), ["waypoints"]),
    "waypoints are numbers": (valid(waypoints=[1.0, 2.0]), ["waypoints"]),
    "no such CSV file": (valid(waypoints="none.csv"), ["waypoints", "none.csv"]),
    "a CSV file without a path": (valid(waypoints={"csv": 3}), ["waypoints.csv", "3"]),
    "a CSV file with another entry": (valid(waypoints={"csv": "none.csv", "alpha": 3}), ["waypoints", "'alpha'"]),
    "a study file as CSV": (valid(waypoints="study.toml"), ["waypoints", "line"]),
    "repeated times": (points((0.0, REST), (6.0, [5.0]), (6.0, END)), ["waypoints[2].time", "6.0"]),
    "unsorted times": (points((0.0, REST), (16.0, END), (6.0, [5.0])), ["waypoints[2].time", "6.0", "16.0"]),
    "no time": (without("waypoints", 1, "time"), ["waypoints[1].time", "none"]),
    "time of nan": (changed("waypoints", 1, "time", to=math.nan), ["waypoints[1].time", "nan"]),
    "time of inf": (changed("waypoints", 2, "time", to=math.inf), ["waypoints[2].time", "inf"]),
    "time of -inf": (changed("waypoints", 0, "time", to=-math.inf), ["waypoints[0].time", "-inf"]),
    "time in words": (changed("waypoints", 1, "time", to="6.0"), ["waypoints[1].time", "'6.0'"]),
    "time is true": (changed("waypoints", 1, "time", to=True), ["waypoints[1].time", "True"]),
    "time is a list": (changed("waypoints", 1, "time", to=[6.0]), ["waypoints[1].time", "[6.0]"]),
    "time is a date": (changed("waypoints", 1, "time", to=Verbatim("1979-05-27")), ["waypoints[1].time"]),
    "time beyond all numbers": (changed("waypoints", 2, "time", to=BIG), ["waypoints[2].time"]),
    "no axis": (without("waypoints", 1, "x"), ["waypoints[1]", "axis"]),
    "jet of inf": (changed("waypoints", 1, "x", to=[5.0, math.inf]), ["waypoints[1]", "velocity", "inf"]),
    "position of -inf": (changed("waypoints", 0, "x", to=[-math.inf]), ["waypoints[0]", "position", "-inf"]),
    "jet is a number": (changed("waypoints", 1, "x", to=5.0), ["waypoints[1].x", "5.0"]),
    "jet in words": (changed("waypoints", 1, "x", to="5.0"), ["waypoints[1].x", "'5.0'"]),
    "jet with words": (changed("waypoints", 1, "x", to=[5.0, "0.0"]), ["waypoints[1].x", "'0.0'"]),
    "jet with true": (changed("waypoints", 1, "x", to=[5.0, True]), ["waypoints[1].x", "True"]),
    "jet of lists": (changed("waypoints", 1, "x", to=[[5.0], [0.0]]), ["waypoints[1].x", "[[5.0], [0.0]]"]),
    "jet is a table": (changed("waypoints", 1, "x", to={"position": 5.0}), ["waypoints[1].x"]),
    "jet beyond all numbers": (changed("waypoints", 1, "x", to=[BIG]), ["waypoints[1]"]),
    "jets of unequal axes": (changed("waypoints", 1, "z", to=[1.0]), ["waypoints[1]", "x, z"]),
    "another axis": (valid(waypoints=[{"time": 0.0, "x": REST}, {"time": 6.0, "z": END}]), ["waypoints[1]", "z"]),
    "dot in a label": (
        valid(waypoints=[{"time": 0.0, "x.y": REST}, {"time": 6.0, "x.y": END}]),
        ["labels", "dot", "'x.y'"],
    ),
    "empty label": (valid(waypoints=[{"time": 0.0, "": REST}, {"time": 6.0, "": END}]), ["labels", "''"]),
    "label cls": (
        valid(waypoints=[{"time": 0.0, "cls": REST}, {"time": 6.0, "cls": [0.0, "a"]}]),
        ["waypoints", "cls"],
    ),
    "singular free entries": (points((0.0, REST), (8.0, [math.nan, 1.0]), (16.0, END)), ["singular"]),
    "no positions at all": (points((0.0, [math.nan, 1.0]), (16.0, [math.nan, 1.0])), ["singular"]),
    "nothing prescribed": (points((0.0, []), (16.0, [])), ["waypoints"]),
    # Plans
    "plans are a number": (valid(plans=3), ["plans", "3"]),
    "plans are names": (valid(plans=["step"]), ["plans", "'step'"]),
    "unknown family": (plan(family="bspline"), ["plans[0].family", "'bspline'", "trigonometric"]),
    "no family": (plan(), ["plans[0].family", "'mine'"]),
    "neither name nor family": (valid(plans=[{}]), ["plans[0].family", "None"]),
    "family is a list": (plan(family=["step"]), ["plans[0].family", "['step']"]),
    "family is a table": (plan(family={}), ["plans[0].family", "{}"]),
    "name is a number": (valid(plans=[{"name": 3, "family": "step"}]), ["plans[0].name", "3"]),
    "name is empty": (valid(plans=[{"name": "", "family": "step"}]), ["plans[0].name", "''"]),
    "name given twice": (
        valid(plans=[{"family": "step"}, {"name": "step", "family": "polynomial"}]),
        ["plans[1].name", "'step'"],
    ),
    "no alpha": (plan(family="trigonometric"), ["plans[0]", "alpha", "none"]),
    "alpha below 0": (plan(family="trigonometric", alpha=-0.1), ["plans[0]", "alpha", "-0.1"]),
    "alpha of 6.5": (plan(family="trigonometric", alpha=6.5), ["plans[0]", "alpha must lie in [0, 2 pi)", "6.5"]),
    "alpha of 2 pi": (plan(family="trigonometric", alpha=2 * math.pi), ["plans[0]", "alpha", "6.28"]),
    "alpha out of range in legs": (plan(family="piecewise", alpha=7.0), ["plans[0]", "alpha", "7"]),
    "alpha of nan": (plan(family="trigonometric", alpha=math.nan), ["plans[0]", "alpha", "nan"]),
    "alpha of inf": (plan(family="trigonometric", alpha=math.inf), ["plans[0]", "alpha", "inf"]),
    "alpha in words": (plan(family="trigonometric", alpha="4.0"), ["plans[0]", "alpha", "'4.0'"]),
    "alpha is true": (plan(family="trigonometric", alpha=True), ["plans[0]", "alpha", "True"]),
    "alpha is a list": (plan(family="trigonometric", alpha=[1.0]), ["plans[0]", "alpha", "[1.0]"]),
    "alpha beyond all numbers": (plan(family="trigonometric", alpha=BIG), ["plans[0]", "alpha"]),
    "gamma where there is none": (plan(family="trigonometric", alpha=1.0, gamma=0.5), ["plans[0]", "gamma"]),
    "gamma of nan": (plan(family="trigonometric", alpha=1.0, gamma=math.nan), ["plans[0]", "gamma", "nan"]),
    "gamma in words": (plan(family="trigonometric", alpha=1.0, gamma="mean"), ["plans[0]", "gamma", "'mean'"]),
    "gamma is true": (
        plan(family="trigonometric", alpha=1.0, gamma=True)
        | {"waypoints": [{"time": 0.0, "x": REST}, {"time": 16.0, "x": END}]},
        ["plans[0]", "gamma", "True"],
    ),
    "gammas of other axes": (plan(family="trigonometric", alpha=1.0, gamma=[0.5, 0.5]), ["plans[0]", "gamma", "2"]),
    "gamma that is singular": (
        # gamma adds a multiple of the function that has cos m(tau - gamma_mean) and vanishes at every constraint; where
        # m (gamma_mean - gamma) is an odd multiple of pi/2 no multiple gives it. Here m = 3, the mean in the middle.
        plan(family="trigonometric", alpha=1.0, gamma=0.5 + math.pi / 6)
        | {"waypoints": [{"time": 0.0, "x": REST}, {"time": 16.0, "x": END}]},
        ["plans[0]", "gamma"],
    ),
    "degree too low": (plan(family="polynomial", degree=3), ["plans[0]", "degree", "3"]),
    "degree of 8.5": (plan(family="polynomial", degree=8.5), ["plans[0]", "degree", "8.5"]),
    "degree of inf": (plan(family="polynomial", degree=math.inf), ["plans[0]", "degree", "inf"]),
    "degree of nan": (plan(family="polynomial", degree=math.nan), ["plans[0]", "degree", "nan"]),
    "degree in words": (plan(family="polynomial", degree="high"), ["plans[0]", "degree", "'high'"]),
    "smooth of 0": (plan(family="polynomial", degree=9, smooth=0), ["plans[0]", "smooth", "0"]),
    # The run
    "no t_end": (without("t_end"), ["t_end", "none"]),
    "t_end too early": (valid(t_end=15.0), ["t_end", "15", "16"]),
    "t_end with the last waypoint": (valid(t_end=16.0), ["t_end", "16"]),
    "t_end of nan": (valid(t_end=math.nan), ["t_end", "nan"]),
    "t_end of inf": (valid(t_end=math.inf), ["t_end", "inf"]),
    "t_end in words": (valid(t_end="30"), ["t_end", "'30'"]),
    "t_end is true": (valid(t_end=True), ["t_end", "True"]),
    "t_end beyond all numbers": (valid(t_end=BIG), ["t_end"]),
    "one sample": (valid(samples=1), ["samples", "1"]),
    "half a sample": (valid(samples=100.5), ["samples", "100.5"]),
    "samples in words": (valid(samples="many"), ["samples", "'many'"]),
    "samples for gigabytes": (valid(samples=1e7), ["samples", "at most", "GB of memory", "got 10000000"]),
    "number longer than Python prints": (f"samples = 0x{'F' * 5000}\n" + to_toml(without("samples")), ["samples"]),
    "samples without end": (valid(samples=10**9), ["samples", "1"]),
    "title is a number": (valid(title=3), ["title", "3"]),
    "author is a number": (valid(author=3), ["author", "3"]),
    "text is a number": (valid(text=[3]), ["text", "[3]"]),
    "worth in words": (valid(worth="yes"), ["worth", "'yes'"]),
    "worth is a number": (valid(worth=1), ["worth", "1"]),
    "benefit in words": (valid(benefit="yes"), ["benefit", "'yes'"]),
    "benefit by both names": (valid(benefit=True, worth=True), ["worth", "both"]),
    "experiment is no table": (valid(experiment=3), ["experiment", "table", "3"]),
    "unknown entry of the experiment": (valid(experiment={"plans": 3}), ["experiment", "'plans'"]),
    "start in words": (valid(experiment={"start": "late"}), ["experiment.start", "'late'"]),
    "start after the end": (valid(experiment={"start": 40.0}), ["experiment", "start", "40"]),
    "band of zero": (valid(experiment={"band": 0.0}), ["experiment", "band", "0.0"]),
    "unknown measure": (valid(experiment={"measures": ["speed"]}), ["experiment", "measures", "'speed'"]),
    "one measure": (valid(experiment={"measures": "iae"}), ["experiment", "measures", "'iae'"]),
    "an event without a limit": (valid(experiment={"events": [{"signal": "u"}]}), ["experiment", "limit"]),
    "an event of nothing": (valid(experiment={"events": [{"low": 1.0}]}), ["experiment.events[0].signal", "none"]),
    "events are numbers": (valid(experiment={"events": [1.0]}), ["experiment.events", "1.0"]),
    "units are a list": (valid(units=["m"]), ["units", "['m']"]),
    "unit is a number": (changed("units", "x", to=1.0), ["units", "1.0"]),
    # Limits and minimum durations
    "limits are a number": (valid(limits=3.0), ["limits", "table", "3.0"]),
    "limit of zero": (valid(**QUICK, limits={"velocity": 0.0}), ["limits.velocity", "above 0", "0.0"]),
    "limit in words": (valid(**QUICK, limits={"velocity": "2"}), ["limits.velocity", "'2'"]),
    "limit of nothing": (valid(**QUICK, limits={"speed": 2.0}), ["plans[0].fastest", "speed"]),
    "limit of another side": (valid(limits={"x_d1": {"max": 2.0}}), ["limits.x_d1", "low, high", "'max'"]),
    "limit without sides": (valid(limits={"x_d1": {}}), ["limits.x_d1", "finite"]),
    "limit of three numbers": (valid(limits={"x_d1": [1.0, 2.0, 3.0]}), ["limits", "x_d1"]),
    "limit that decreases": (valid(limits={"x_d1": [2.0, -2.0]}), ["limits", "x_d1"]),
    "fastest without limits": (valid(**QUICK), ["plans[0].fastest", "[limits]", "none"]),
    "fastest by another name": (
        valid(plans=[{"family": "polynomial", "fastest": "time"}], limits={"velocity": 1.0}),
        ["plans[0].fastest", "shape, waypoints, path", "'time'"],
    ),
    "fastest step": (
        valid(plans=[{"family": "step", "fastest": "shape"}], limits={"velocity": 1.0}),
        ["plans[0].fastest", "duration"],
    ),
    "fastest beyond the end": (valid(**QUICK, limits={"velocity": 0.1}), ["t_end", "polynomial", "375 s"]),
    # Obstacles
    "obstacles are a table": (valid(obstacles={"shape": "disc"}), ["obstacles", "tables"]),
    "obstacle without a shape": (valid(**AROUND | {"obstacles": [{"radius": 1.0}]}), ["obstacles[0].shape", "None"]),
    "obstacle of another shape": (valid(**AROUND | {"obstacles": [DISC | {"shape": "ball"}]}), ["'ball'"]),
    "obstacle with an unknown entry": (valid(**AROUND | {"obstacles": [DISC | {"r": 1.0}]}), ["obstacles[0]", "'r'"]),
    "disc without a radius": (
        valid(**AROUND | {"obstacles": [{"shape": "disc", "centre": [1.0, 2.0]}]}),
        ["obstacles[0].radius", "none"],
    ),
    "disc of negative radius": (valid(**AROUND | {"obstacles": [DISC | {"radius": -1.0}]}), ["radius", "-1.0"]),
    "rectangle that decreases": (
        valid(**AROUND | {"obstacles": [{"shape": "rectangle", "x": [2.0, 1.0], "z": [0.0, 1.0]}]}),
        ["obstacles[0]", "x"],
    ),
    "half-plane without a normal": (
        valid(**AROUND | {"obstacles": [{"shape": "half_plane", "normal": [0.0, 0.0], "offset": 1.0}]}),
        ["obstacles[0]", "normal"],
    ),
    "obstacle of one axis": (valid(obstacles=[DISC]), ["obstacles", "two axes"]),
    "avoid nothing": (valid(plans=[{"family": "polynomial", "avoid": True}]), ["plans[0].avoid", "[[obstacles]]"]),
    "avoid in words": (valid(plans=[{"family": "polynomial", "avoid": "yes"}]), ["plans[0].avoid", "'yes'"]),
    "avoid with a negative clearance": (valid(**AROUND, avoid={"clearance": -1.0}), ["avoid.clearance", "-1.0"]),
    "avoid with a rope of no crane": (valid(**AROUND, avoid={"rope": True}), ["avoid.rope", "crane"]),
    "obstacle at a waypoint": (
        valid(**AROUND | {"obstacles": [DISC | {"centre": [0.0, 0.0]}]}),
        ["plans[0].avoid", "obstacle"],
    ),
    "avoid and another path": (
        valid(
            **AROUND | {"plans": [{"family": "polynomial", "avoid": True, "fastest": "waypoints"}]},
            limits={"velocity": 9.0},
        ),
        ["plans[0].fastest", "'waypoints'".replace("'", '"')],
    ),
    # Sweeps and draws
    "sweep is a list": (valid(sweep=[1.0]), ["sweep", "table", "[1.0]"]),
    "sweep of nothing": (valid(sweep={"values": [1.0]}), ["sweep.parameter", "none"]),
    "sweep of no number": (valid(sweep=SWEPT | {"parameter": "num"}), ["sweep.parameter", "gain", "'num'"]),
    "sweep without values": (valid(sweep={"parameter": "gain"}), ["sweep.values", "none"]),
    "sweep over no value": (valid(sweep=SWEPT | {"values": []}), ["sweep.values", "[]"]),
    "sweep that decreases": (valid(sweep=SWEPT | {"values": [2.0, 1.0]}), ["sweep.values", "increase", "[2.0, 1.0]"]),
    "sweep in words": (valid(sweep=SWEPT | {"values": "1 to 9"}), ["sweep.values", "'1 to 9'"]),
    "sweep without an end": (valid(sweep=SWEPT | {"values": {"low": 1.0, "count": 3}}), ["sweep.values.high", "none"]),
    "sweep on a log scale from 0": (
        valid(sweep=SWEPT | {"values": {"low": 0.0, "high": 1.0, "count": 3, "scale": "log"}}),
        ["sweep.values.low", "above 0"],
    ),
    "sweep of too many values": (
        valid(sweep=SWEPT | {"values": {"low": 1.0, "high": 2.0, "count": 10**9}}),
        ["sweep.values.count", "100000"],
    ),
    "sweep of an unknown metric": (valid(sweep=SWEPT | {"metrics": ["speed"]}), ["sweep.metrics", "'speed'"]),
    "draws without a number": (valid(draws={"parameters": {"gain": [1.0, 2.0]}}), ["draws.count", "none"]),
    "no draws": (valid(draws=DRAWN | {"count": 0}), ["draws.count", "0"]),
    "half a draw": (valid(draws=DRAWN | {"count": 2.5}), ["draws.count", "2.5"]),
    "draws of nothing": (valid(draws=DRAWN | {"parameters": {}}), ["draws.parameters", "none"]),
    "draws of one number": (valid(draws=DRAWN | {"parameters": {"gain": 2.0}}), ["draws.parameters.gain", "2.0"]),
    "draws that decrease": (valid(draws=DRAWN | {"parameters": {"gain": [2.0, 1.0]}}), ["draws.parameters.gain", "2"]),
    "draws of an unknown parameter": (
        valid(draws=DRAWN | {"parameters": {"mass": [1.0, 2.0]}}),
        ["draws.parameters.mass", "gain", "'mass'"],
    ),
    "seed of -1": (valid(draws=DRAWN | {"seed": -1}), ["draws.seed", "-1"]),
    # The loop
    "no loop": (without("loop"), ["loop", "none"]),
    "loop is a word": (valid(loop="linear"), ["loop", "'linear'"]),
    "no kind": (without("loop", "kind"), ["loop.kind", "None"]),
    "unknown kind": (changed("loop", "kind", to="quadratic"), ["loop.kind", "'quadratic'", "linear"]),
    "kind is a number": (changed("loop", "kind", to=3), ["loop.kind", "3"]),
    "kind is a list": (changed("loop", "kind", to=["linear"]), ["loop.kind", "['linear']"]),
    "no num": (without("loop", "num"), ["loop.num", "none"]),
    "no den": (without("loop", "den"), ["loop.den", "none"]),
    "num in words": (changed("loop", "num", to=["1.0"]), ["loop", "num", "'1.0'"]),
    "num is true": (changed("loop", "num", to=[True]), ["loop", "num", "True"]),
    "num of nothing": (changed("loop", "num", to=[]), ["loop", "num", "[]"]),
    "num of 0": (changed("loop", "num", to=[0.0]), ["loop", "num", "[0.0]"]),
    "num of lists": (changed("loop", "num", to=[[1.0], [2.0]]), ["loop", "num"]),
    "den of 0": (changed("loop", "den", to=[0.0, 0.0]), ["loop", "den", "[0.0, 0.0]"]),
    "den of nan": (changed("loop", "den", to=[1.0, math.nan]), ["loop", "den", "nan"]),
    "den beyond all numbers": (changed("loop", "den", to=[BIG, 1]), ["loop", "den"]),
    "improper plant": (changed("loop", "num", to=[1.0, 0.0, 0.0, 1.0]), ["loop", "num", "3 over 2"]),
    "gain of nan": (changed("loop", "gain", to=math.nan), ["loop", "gain", "nan"]),
    "gain of inf": (changed("loop", "gain", to=math.inf), ["loop", "gain", "inf"]),
    "gain in words": (changed("loop", "gain", to="5.0"), ["loop", "gain", "'5.0'"]),
    "gain is true": (changed("loop", "gain", to=True), ["loop", "gain", "True"]),
    "gain is a list": (changed("loop", "gain", to=[5.0]), ["loop", "gain", "[5.0]"]),
    "gain beyond all numbers": (changed("loop", "gain", to=BIG), ["loop", "gain"]),
    "loop without a solution": (
        valid(loop={"kind": "linear", "num": [-1.0, 0.0], "den": [1.0, 1.0], "gain": 1.0}),
        ["loop", "gain"],
    ),
    "no module": (changed("loop", "kind", to="python:"), ["loop.kind", "'python:'"]),
    "empty module": (valid(loop={"kind": "python::build"}), ["loop.kind", "'python::build'"]),
    "no such module": (valid(loop={"kind": "python:nowhere_to_be_found:build"}), ["loop.kind", "nowhere_to_be_found"]),
    "key beside a module": (valid(loop={"kind": "python:a:b", "gain": 2.0}), ["loop", "gain"]),
    "no such function": (module("def other(): pass\n"), ["loop.kind", "build"]),
    "module with a mistake": (module("def build(:\n"), ["loop", "NAME"]),
    "module that fails": (module("1 / 0\n"), ["loop", "NAME"]),
    "function that fails": (
        module(f"{DECLARED}    raise RuntimeError('no\\nplant')\n"),
        ["loop", "NAME", "no plant"],
    ),
    "function that ends Python": (module(f"{DECLARED}    raise SystemExit(0)\n"), ["loop", "NAME", "SystemExit"]),
    "module that ends Python": (module("raise SystemExit(0)\n"), ["loop", "NAME", "SystemExit"]),
    "function that says too much": (module(f"{DECLARED}    raise ValueError('x' * 100_000)\n"), ["loop", "NAME"]),
    "function that wants more": (
        module(DECLARED.replace("()", "(gain)") + "    pass\n"),
        ["NAME", "no required arguments, got gain"],
    ),
    "no function": (module("build = 3\n"), ["loop", "NAME"]),
    "function without a loop": (module(f"{DECLARED}    return None\n"), ["loop", "NAME", "NoneType"]),
    "function without its data": (module(f"{DECLARED}    return open('nowhere.csv')\n"), ["loop", "nowhere.csv"]),
    "loop of other axes": (
        module(f"{DECLARED}    return ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])\n"),
        ["loop", "axes"],
    ),
}
OF_THE_RUN = ("unit of nothing", "empty module", "no such module", "sweep of an unknown metric")
# What only the loop can tell is not known where only the plans are asked for.
LOADED = [name for name, (case, _) in WRONG.items() if not isinstance(case, tuple) and name not in OF_THE_RUN]


@pytest.fixture
def wrong(tmp_path, monkeypatch):
    """Write the wrong file, in a folder of its own, and give what its line must mention."""
    monkeypatch.chdir(tmp_path)

    def write(name):
        case, mentions = WRONG[name]
        place = tmp_path / "given"
        place.mkdir()
        path = place / "study.toml"
        if isinstance(case, tuple):
            data, text = case
            own = "own_" + re.sub(r"\W", "_", name)
            (place / f"{own}.py").write_text(text)
            mentions = [m.replace("NAME", own) for m in mentions]
            path.write_text(to_toml(data).replace("NAME", own))
        elif isinstance(case, bytes):
            path.write_bytes(case)
        else:
            path.write_text(case if isinstance(case, str) else to_toml(case), encoding="utf-8")
        return path, mentions

    return write


ANNOUNCED = re.compile(
    r"ctrlplan: (running study \w+ \(\d plans?\)|writing the plans of \w+|planning \w+ (in minimum time|around .*))"
)


def refused(arguments, capsys):
    """Return the one line that a refused command says, beside what it announces."""
    assert main([str(a) for a in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if not ANNOUNCED.fullmatch(line)]
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("name", WRONG)
def test_report_refuses_it_in_one_line(name, wrong, capsys, tmp_path):
    path, mentions = wrong(name)
    line = refused(["report", path, "--out", tmp_path / "out"], capsys)
    assert line.startswith("ctrlplan: ")
    assert "study.toml" in line
    assert RULE.search(line), line
    assert len(line) < 2000
    assert line.isprintable()
    for part in mentions:
        assert part in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", one_in(3, LOADED))  # all in a report, above
def test_plan_refuses_it_too(name, wrong, capsys, tmp_path):
    path, _ = wrong(name)
    line = refused(["plan", path, "--out", tmp_path / "out" / "plan.csv"], capsys)
    assert "study.toml" in line
    assert RULE.search(line), line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", one_in(3, WRONG, 1))
def test_the_schema_rejects_what_is_wrong_in_structure(name, wrong):
    """And nothing that the reader accepts; numbers that JSON does not have are left to the reader."""
    path, _ = wrong(name)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        return
    rejected = structure_error(data) is not None
    if is_json(data) or not rejected:
        assert bool(schema_errors(data)) == rejected
    with pytest.raises(StudyError):
        load_study(path).run()


def test_what_was_written_before_stays(wrong, capsys, tmp_path):
    path, _ = wrong("alpha of 6.5")
    out = tmp_path / "out"
    out.mkdir()
    (out / "index.html").write_text("before")
    refused(["report", path, "--out", out], capsys)
    assert [(p.name, p.read_text()) for p in out.iterdir()] == [("index.html", "before")]


@pytest.mark.parametrize("command", ["report", "plan"])
def test_a_missing_file(command, capsys, tmp_path):
    out = tmp_path / "plan.json"
    line = refused([command, tmp_path / "nowhere.toml", "--out", out], capsys)
    assert "nowhere.toml" in line
    assert RULE.search(line)
    assert not out.exists()


@pytest.mark.parametrize("command", ["report", "plan"])
def test_a_folder_for_a_file(command, capsys, tmp_path):
    out = tmp_path / "plan.json"
    line = refused([command, tmp_path, "--out", out], capsys)
    assert str(tmp_path) in line
    assert RULE.search(line)
    assert not out.exists()


@pytest.mark.parametrize("where", ["place", "place/deeper/still"])
def test_an_out_folder_that_is_a_file(where, capsys, tmp_path):
    (tmp_path / "study.toml").write_text(to_toml(valid()))
    (tmp_path / "place").write_text("a file")
    line = refused(["report", tmp_path / "study.toml", "--out", tmp_path / where], capsys)
    assert "--out must be" in line
    assert f"got {tmp_path / where}" in line
    assert (tmp_path / "place").read_text() == "a file"
    line = refused(["reproduce", "--out", tmp_path / where], capsys)
    assert "--out must be" in line


@pytest.mark.slow
def test_an_out_folder_whose_files_cannot_be_replaced_gets_neither(capsys, tmp_path):
    (tmp_path / "study.toml").write_text(to_toml(valid()))
    (tmp_path / "out" / "results.json").mkdir(parents=True)
    assert main(["report", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "--out must be" in capsys.readouterr().err.splitlines()[-1]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["results.json"]


@pytest.mark.parametrize("name", ["plan.txt", "plan", "plan.csv.gz", ".csv", "plan.CSVX"])
def test_an_out_file_of_another_kind(name, capsys, tmp_path):
    (tmp_path / "study.toml").write_text(to_toml(valid()))
    line = refused(["plan", tmp_path / "study.toml", "--out", tmp_path / name], capsys)
    assert "--out must end in one of .json, .csv, .mat," in line
    assert name in line
    assert [p.name for p in tmp_path.iterdir()] == ["study.toml"]


@pytest.mark.parametrize("where", ["plan.csv", "file/plan.csv"])
def test_an_out_file_that_cannot_be_written(where, capsys, tmp_path):
    (tmp_path / "study.toml").write_text(to_toml(valid()))
    (tmp_path / "file").write_text("a file")
    (tmp_path / "plan.csv").mkdir()
    line = refused(["plan", tmp_path / "study.toml", "--out", tmp_path / where], capsys)
    assert "--out must be" in line
    assert where in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "plan.csv", "study.toml"]
    assert not list((tmp_path / "plan.csv").iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_a_loop_that_is_unstable_is_no_error(capsys, tmp_path):
    (tmp_path / "study.toml").write_text(to_toml(changed("loop", "gain", to=-5.0)))
    assert main(["report", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "unstable" in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert '"settling_time": null' in (tmp_path / "out" / "results.json").read_text(encoding="utf-8")
