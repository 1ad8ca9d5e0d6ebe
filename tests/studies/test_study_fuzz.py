"""Random mutations of a valid study file: it runs or it is refused in one line, and nothing else."""

import copy
import io
import json
import math
import re
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples
from study_schema import is_json, schema_errors, structure_error
from study_text import Verbatim, to_toml, valid

from ctrlplan.cli import main
from ctrlplan.studies.files import StudyError, load_study

SCALARS = st.one_of(
    st.sampled_from(
        [0, 1, -1, 3, 0.0, -0.0, 1.0, 2.5, 6.0, 6.5, 16.0, 1e-9, 1e9, math.nan, math.inf, -math.inf, 10**30]
    ),
    st.sampled_from(
        ["", "auto", "step", "polynomial", "linear", "python:", "python:a:b", "crane", "x", "y", "x.y", "a b"]
    ),
    st.sampled_from([True, False, Verbatim("1979-05-27T07:32:00Z"), Verbatim("07:32:00")]),
    st.integers(-20, 20),
    st.floats(-30, 30).map(lambda v: round(v, 3)),
    st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=4),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.sampled_from(["time", "x", "name", "q"]), inner, max_size=2)
    ),
    max_leaves=5,
)
KEYS = st.sampled_from(
    ["x", "z", "time", "alpha", "gamma", "degree", "smooth", "name", "family", "kind", "gain", "extra"]
)


def places(data, path=()):
    """Every path to an entry."""
    pairs = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in pairs:
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def mutated(draw, **more):
    """A valid file with one to three entries replaced, dropped, doubled or added."""
    data = valid(**copy.deepcopy(more))
    data["samples"] = 41
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(sorted(places(data), key=repr)))
        parent = data
        for key in path[:-1]:
            parent = parent[key]
        action = draw(st.sampled_from(["replace", "replace", "drop", "double", "add"]))
        if action == "replace":
            parent[path[-1]] = draw(VALUES)
        elif action == "drop":
            del parent[path[-1]]
        elif isinstance(parent, list):
            parent.insert(path[-1], copy.deepcopy(parent[path[-1]]) if action == "double" else draw(VALUES))
        else:
            parent[draw(KEYS)] = copy.deepcopy(parent[path[-1]]) if action == "double" else draw(VALUES)
    return data


def refused_or_run(text):
    """Load and run a file; what it says where it is refused."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "study.toml"
        path.write_text(text, encoding="utf-8")
        try:
            study = load_study(path).run()
        except StudyError as error:
            said = str(error)
            assert said.startswith(f"{path}: ")
            assert len(said.splitlines()) == 1
            assert re.search(r"\b(must|requires?)\b.*\b(got|give)\b", said), said
            assert len(said) < 2000
            return
        assert study.comparison.metrics
        assert study.results()


@pytest.mark.slow
@examples(150)
@given(mutated())
def test_mutated_entries_are_run_or_refused(data):
    refused_or_run(to_toml(data))


@pytest.mark.slow
@examples(100)
@given(st.data())
def test_mutated_text_is_run_or_refused(data):
    text = to_toml(valid() | {"samples": 41})
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text) - 1))
        put = data.draw(
            st.sampled_from(["", "", "\n", '"', "[", "]", "=", ".", ",", "-", "e", "0", "1", "9", "nan", "true", "é"])
        )
        text = text[:at] + put + text[at + data.draw(st.integers(0, 3)) :]
    refused_or_run(text)


FURTHER = {
    "plans": [{"family": "s_curve", "velocity": 3.0, "acceleration": [2.0], "jerk": 4.0, "fastest": "shape"}],
    "limits": {"velocity": 2.0, "x_d2": [-1.0, 1.0], "u": {"high": 3.0}},
    "obstacles": [{"shape": "disc", "centre": [1.0, 2.0], "radius": 0.5}],
    "avoid": {"clearance": 0.1, "max_points": 3},
    "sweep": {"parameter": "gain", "values": {"low": 1.0, "high": 2.0, "count": 3}},
    "draws": {"count": 3, "parameters": {"gain": [1.0, 2.0]}},
    "experiment": {"band": 0.05, "events": [{"signal": "u", "high": 3.0}]},
}


@examples(100)
@given(st.one_of(mutated(), mutated(**FURTHER)))
def test_the_schema_and_the_reader_agree(data):
    """On the structure of every file, up to numbers that JSON does not have."""
    data = tomllib.loads(to_toml(data))
    rejected = structure_error(data) is not None
    if is_json(data) or not rejected:
        assert bool(schema_errors(data)) == rejected


@examples(40)
@given(mutated(), st.sampled_from(["csv", "json"]))
def test_the_command_ends_with_a_file_or_with_status_2(data, suffix):
    with TemporaryDirectory() as folder:
        path, out = Path(folder) / "study.toml", Path(folder) / f"plan.{suffix}"
        path.write_text(to_toml(data), encoding="utf-8")
        status = main(["plan", str(path), "--out", str(out)])
        assert status in (0, 2)
        assert out.exists() == (status == 0)


HOSTILE = st.one_of(
    st.sampled_from(
        [
            '"><img src=x onerror=alert(1)>',
            "</script><script>alert(1)</script>",
            "--><b>",
            "{{ 7 * 7 }}",
            "$x$",
            r"$\frac$",
            "_a",
            "\n",
            "a\tb",
            "\x7f",
            "\u202eabc",
            "\U0001f680",
            "__proto__",
            "=1+1",
            "w" * 300,
        ]
    ),
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12),
)


@st.composite
def named_by_others(draw):
    """A file, mutated or not, whose title, plans, units and axis are called whatever."""
    data = draw(st.one_of(st.just(valid()), mutated()))
    data["samples"] = 41
    data["title"] = draw(HOSTILE)
    for plan in data["plans"] if isinstance(data.get("plans"), list) else ():
        if isinstance(plan, dict) and isinstance(plan.get("family"), str):
            plan["name"] = draw(HOSTILE)
    if isinstance(data.get("units"), dict):
        data["units"] = {key: draw(HOSTILE) for key in data["units"]}
    axis = draw(st.one_of(st.just("x"), HOSTILE))
    for point in data["waypoints"] if isinstance(data.get("waypoints"), list) else ():
        if isinstance(point, dict) and "x" in point:
            point[axis] = point.pop("x")
    if axis != "x" and isinstance(data.get("units"), dict) and "x" in data["units"]:
        data["units"][axis] = data["units"].pop("x")
    return data


TAGS = {*("html", "head", "meta", "link", "title", "style", "body", "header", "main", "section", "footer", "script")}
TAGS |= {*("h1", "h2", "h3", "p", "ul", "li", "dl", "dt", "dd", "a", "nav", "figure", "figcaption", "div", "span")}
TAGS |= {*("table", "thead", "tbody", "tr", "th", "td", "button", "svg", "metadata", "g", "path", "use", "defs")}
TAGS |= {"clippath", "rect", "text", "details", "summary"}


class Tags(HTMLParser):
    """Tags of a page, and attributes that would run something."""

    def __init__(self, text):
        super().__init__()
        self.found, self.handlers = set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.add(tag)
        self.handlers += [key for key, _ in attrs if key.startswith("on")]


@pytest.mark.usefixtures("drawn_if_slow")
# What is promised at the end of all numbers is an answer: that it overflows there is no fault.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.slow
@examples(20)
@given(named_by_others())
def test_the_report_is_a_page_without_foreign_elements_or_status_2_and_nothing(data):
    with TemporaryDirectory() as folder, redirect_stderr(io.StringIO()) as said, redirect_stdout(io.StringIO()):
        path, out = Path(folder) / "study.toml", Path(folder) / "out"
        path.write_text(to_toml(data), encoding="utf-8", newline="")
        status = main(["report", str(path), "--out", str(out)])
        assert status in (0, 2)
        assert all(line.startswith("ctrlplan: ") and line.isprintable() for line in said.getvalue().splitlines())
        if status == 2:
            assert sorted(p.name for p in Path(folder).iterdir()) == ["study.toml"]
            return
        page = Tags((out / "index.html").read_text(encoding="utf-8"))
        assert {tag for tag in page.found if ":" not in tag} <= TAGS
        assert page.handlers == []
        assert json.loads((out / "results.json").read_text(encoding="utf-8"))["studies"]["study"]["plans"]


EXTREMES = {
    "a long run": {"t_end": 1e9},
    "a run without end": {"t_end": 1e20},
    "a run beyond all clocks": {"t_end": 1e300},
    "far away": {"waypoints": [{"time": 0.0, "x": [1e160, 0.0, 0.0]}, {"time": 1.0, "x": [-1e160, 0.0, 0.0]}]},
    "as far as numbers go": {
        "waypoints": [{"time": 0.0, "x": [1e308, 0.0, 0.0]}, {"time": 1.0, "x": [-1e308, 0.0, 0.0]}]
    },
    "hardly a move": {"waypoints": [{"time": 0.0, "x": [0.0, 0.0, 0.0]}, {"time": 1.0, "x": [1e-300, 0.0, 0.0]}]},
    "hardly any time": {"waypoints": [{"time": 0.0, "x": [0.0, 0.0, 0.0]}, {"time": 1e-300, "x": [1.0, 0.0, 0.0]}]},
    "a clock that started long ago": {
        "t_end": 1e9 + 30,
        "waypoints": [{"time": 1e9, "x": [0.0, 0.0, 0.0]}, {"time": 1e9 + 5, "x": [1.0, 0.0, 0.0]}],
    },
    "no move": {"waypoints": [{"time": 0.0, "x": [1.0, 0.0, 0.0]}, {"time": 1.0, "x": [1.0, 0.0, 0.0]}]},
    "a stiff loop": {"loop": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0, 0.0], "gain": 1e12}},
    "a gain beyond reason": {"loop": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0, 0.0], "gain": 1e300}},
    "a plant hardly of second order": {"loop": {"kind": "linear", "num": [1.0], "den": [1e-300, 1.0, 0.0]}},
    "a loop that explodes": {"loop": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0, 0.0], "gain": -1e6}},
    "no gain": {"loop": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0, 0.0], "gain": 0.0}},
    "two samples": {"samples": 2},
}


# What is promised at the end of all numbers is an answer: that it overflows there is no fault.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_are_run_or_refused(name):
    refused_or_run(to_toml(valid(samples=41) | EXTREMES[name]))


@pytest.mark.parametrize("count", [0, 1])
def test_the_mutations_start_from_a_file_that_runs(count):
    data = valid() | {"samples": 41}
    data["plans"] = data["plans"][count:]
    refused_or_run(to_toml(data))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "study.toml"
        path.write_text(to_toml(data))
        assert load_study(path).run().comparison.metrics
