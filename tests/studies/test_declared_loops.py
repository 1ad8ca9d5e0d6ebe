"""A study file's function is called only where it is declared to return a loop; nothing else of it is code."""

import sys

import pytest
from study_text import to_toml, valid

from ctrlplan.studies.files import StudyError, load_study

HEAD = """
import functools
from typing import Optional, Union

import control as ct

def mark():
    open({mark!r}, "w").close()

def made():
    mark()
    return ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["r"], outputs=["y"])
"""

CALLED = {
    "a base class": "def build() -> ct.InputOutputSystem:\n    return made()\n",
    "a class of its own": "def build() -> ct.StateSpace:\n    return made()\n",
    "in words": "def build() -> 'ct.StateSpace':\n    return made()\n",
    "two classes": "def build() -> ct.StateSpace | ct.TransferFunction:\n    return made()\n",
    "two classes as of old": "def build() -> Union[ct.StateSpace, ct.TransferFunction]:\n    return made()\n",
    "choices with defaults": "def build(gain=1.0, *more, **others) -> ct.StateSpace:\n    return made()\n",
    "cached": "@functools.cache\ndef build() -> ct.StateSpace:\n    return made()\n",
    "imported": "from other_declared import build\n",
}

NOT_CALLED = {
    "nothing said": "def build():\n    return made()\n",
    "None": "def build() -> None:\n    mark()\n",
    "a number": "def build() -> float:\n    mark()\n    return 1.0\n",
    "anything": "def build() -> object:\n    return made()\n",
    "a loop or None": "def build() -> Optional[ct.StateSpace]:\n    return made()\n",
    "a class that nobody knows": "def build() -> 'Nowhere':\n    return made()\n",
    "a lambda": "build = lambda: made()\n",
    "a class": "class build:\n    def __init__(self) -> None:\n        mark()\n",
    "a class of loops": "build = ct.StateSpace\n",
    "an object that can be called": (
        "class Builder:\n    def __call__(self) -> ct.StateSpace:\n        return made()\nbuild = Builder()\n"
    ),
    "a part of a function": "build = functools.partial(made)\n",
    "something needed": "def build(gain) -> ct.StateSpace:\n    return made()\n",
    "something needed by name": "def build(*, gain) -> ct.StateSpace:\n    return made()\n",
}


@pytest.fixture
def study(tmp_path, monkeypatch):
    """A study file with a module beside it; whether the module's function was called is seen by a file."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "other_declared", raising=False)

    def write(text, kind="python:declared_here:build"):
        mark = tmp_path / "called"
        (tmp_path / "declared_here.py").write_text(HEAD.format(mark=str(mark)) + text)
        (tmp_path / "other_declared.py").write_text(HEAD.format(mark=str(mark)) + CALLED["in words"])
        path = tmp_path / "study.toml"
        path.write_text(to_toml(valid(loop={"kind": kind}, units={}, samples=41, plans=[{"family": "step"}])))
        return load_study(path), mark

    return write


@pytest.mark.parametrize("name", CALLED)
def test_a_function_declared_to_return_a_loop_is_called(name, study):
    stated, mark = study(CALLED[name])
    assert not mark.exists()  # reading the file runs nothing
    assert stated.run().comparison.metrics
    assert mark.exists()


@pytest.mark.parametrize("name", NOT_CALLED)
def test_any_other_callable_is_not(name, study):
    stated, mark = study(NOT_CALLED[name])
    with pytest.raises(StudyError, match=r"study\.toml: loop\.kind: must name .* such as def build") as error:
        stated.run()
    assert not mark.exists()
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    "kind",
    [
        "python:os:abort",
        "python:os:getpid",
        "python:builtins:exit",
        "python:sys:exit",
        "python:ctrlplan.cli:main",
        "python:control:rss",
        "python:control:ss",
        "python:numpy.testing:test",
        "python:posix:_exit",
    ],
)
def test_callables_of_installed_modules_are_not_called(kind, study):
    stated, _ = study("", kind)
    with pytest.raises(StudyError, match=r"loop\.kind: must name"):
        stated.run()


@pytest.mark.parametrize("kind", ["python:../declared_here:build", "python:/tmp/declared_here:build", "python:.x:y"])
def test_a_module_is_a_name_and_no_path(kind, study):
    stated, mark = study(CALLED["in words"], kind)
    with pytest.raises(StudyError, match="must be identifiers"):
        stated.run()
    assert not mark.exists()


def test_a_path_inside_a_name_does_not_leave_the_folder(study, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    mark = tmp_path / "called elsewhere"
    (elsewhere / "evil.py").write_text(f"open({str(mark)!r}, 'w').close()\n")
    stated, _ = study("", f"python:{elsewhere}/evil:build")
    with pytest.raises(StudyError):
        stated.run()
    assert not mark.exists()
