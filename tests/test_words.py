"""Public names, messages and docstrings in the field's words: none of the list in `words`."""

import importlib
import inspect
from dataclasses import fields, is_dataclass
from functools import cache, cached_property
from pathlib import Path

import pytest
import words

import ctrlplan as cp

pytestmark = pytest.mark.every_combination

PACKAGE = Path(cp.__file__).parent
SHORT = ("trajectories", "planning", "metrics", "flatness", "symbolic")
"""Folders whose public summaries have at most 64 characters."""

FOLDERS = (*SHORT, "systems", "simulation", "studies", "reports")

FORMER = PACKAGE / "studies" / "former.py"
"""Module of arguments that work for one release, with their names in its messages."""

FILES = [
    *(path for folder in FOLDERS for path in sorted((PACKAGE / folder).rglob("*")) if path.suffix in (".py", ".html")),
    *sorted(PACKAGE.glob("*.py")),
]
FILES.remove(FORMER)
"""Modules, and templates of the page."""


def public_names(module):
    """Names that a module exports, with the parameters and public attributes of each, as dotted names."""
    for export in module.__all__:
        thing = getattr(module, export)
        yield export
        if callable(thing) and not isinstance(thing, type(module)):
            yield from (f"{export}.{name}" for name in parameters_of(thing))
        if isinstance(thing, type):
            own = {name for kind in thing.__mro__ if kind.__module__.startswith("ctrlplan") for name in vars(kind)}
            own |= {f.name for f in fields(thing)} if is_dataclass(thing) else set()
            for name in sorted(n for n in own if not n.startswith("_")):
                yield f"{export}.{name}"
                method = inspect.getattr_static(thing, name, None)
                method = getattr(method, "__func__", method)
                if inspect.isfunction(method):
                    yield from (f"{export}.{name}.{parameter}" for parameter in parameters_of(method))


def parameters_of(function):
    try:
        return list(inspect.signature(function).parameters)
    except ValueError:  # a class without a signature of its own
        return []


def deprecated(module, dotted):
    """Whether a name is one that warns."""
    thing = getattr(module, dotted.partition(".")[0])
    for part in dotted.split(".")[1:]:
        thing = inspect.getattr_static(thing, part, None)
    former = type(thing).__name__ == "FormerAttribute"
    return former or (getattr(thing, "__doc__", None) or "").startswith("Deprecated")


@pytest.mark.parametrize("name", ["ctrlplan", *(f"ctrlplan.{folder}" for folder in FOLDERS)])
def test_public_names_have_none_of_the_words(name):
    module = importlib.import_module(name)
    names = list(public_names(module)) if hasattr(module, "__all__") else []
    found = [(name, word.instead) for name in names for word in words.in_name(name.rpartition(".")[2])]
    assert [row for row in found if not deprecated(module, row[0])] == []


@pytest.mark.parametrize("folder", SHORT)
def test_summaries_of_public_names_are_short(folder):
    module = importlib.import_module(f"ctrlplan.{folder}")
    long = {}
    for export in getattr(module, "__all__", ()):
        thing = getattr(module, export)
        own = [k for k in getattr(thing, "__mro__", ()) if k.__module__.startswith("ctrlplan")]
        methods = {f"{export}.{n}": m for kind in own for n, m in vars(kind).items() if not n.startswith("_")}
        for name, described in {export: thing, **methods}.items():
            if isinstance(described, property | cached_property | classmethod) or callable(described):
                summary = (inspect.getdoc(described) or "").partition("\n")[0]
                long |= {name: summary} if len(summary) > 64 else {}
    assert long == {}


@cache  # each file is read once for all kinds
def words_in(path):
    return (words.in_template if path.suffix == ".html" else words.in_module)(path)


@pytest.mark.parametrize("kind", ["string", "docstring", "comment"])
@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_texts_have_none_of_the_words(path, kind):
    found = [row for row in words_in(path) if row[0] == kind]
    assert [(line, word.instead, text) for _, word, line, text in found] == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("the path of least length", ["least, greatest"]),
        ("at least two; least squares", []),
        ("at most 3 of most recent runs", []),
        ("force_asked", ["asked"]),
        ("legs, a leg, elegant legends", ["leg", "leg"]),
        ("puts out what drives it at once", ["put out", "at once"]),
        ("outputs of the drive, driven by u", ["driven"]),
        ("it refuses; refusal", ["refuse", "refuse"]),
        ("limits are kept, and files are kept", ["kept"]),
        ("the objective `wandering`, which wanders", ["wander"]),
        ("beside the plan", ["beside"]),
        ("a plan loses digits", []),
        ("the PLC clock, another clock", ["clock"]),
    ],
)
def test_words_are_found_in_texts(text, found):
    assert [word.word for word in words.in_text(text)] == found


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("least_squares", []),
        ("LegRoot", ["leg"]),
        ("_MOST_STEPS", ["most"]),
        ("wandering", []),
        ("r_asked", ["asked"]),
        ("almost", []),
        ("plan_kept", ["kept"]),
    ],
)
def test_words_are_found_in_names(name, found):
    assert [word.word for word in words.in_name(name)] == found


def test_a_module_is_counted_by_hand(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(
        '"""The least one."""\n'
        "# asked for\n"
        "leg = 1\n"
        'text = f"{leg} of the greatest"\n'
        'warn_renamed("legs", "segments")\n'
        "def legs():\n"
        '    """Deprecated name of `segments`."""\n',
        encoding="utf-8",
    )
    found = [(kind, word.word, line) for kind, word, line, _ in words.in_module(file)]
    strings = [("string", "least, greatest", 4)]
    assert sorted(found) == sorted(
        [("docstring", "least, greatest", 1), ("comment", "asked", 2), ("name", "leg", 3), *strings]
        + [("name", "leg", 4)] * any(row == ("name", "leg", 4) for row in found)  # Python 3.12 reads into f-strings
    )
