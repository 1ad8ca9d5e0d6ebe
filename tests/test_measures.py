"""The script of measures on a package of a few lines, in which each number is counted by hand."""

import subprocess
import sys
from pathlib import Path

import measures
import pytest
from strict import WARNINGS

FILES = {
    "__init__.py": '"""Nothing here."""\n',
    "low.py": '''\
"""Any in a docstring does not count."""
from typing import Any, Literal

Method = Literal["a", "b"]


def chosen(method: Method, name: str, *rest: Any, **options: int) -> Any:
    """Two lines of
    a docstring."""
    from ctrlplan.high import top  # Any in a comment does not count

    if method == "a":
        return top
    if name.startswith("step"):
        return 1
    match name:
        case "x" | "y":
            return 2
    return {"left": 1, "right": 2}[name] if name not in ("p", "q") else rest
''',
    "beside.py": "from ctrlplan import low\n",
    "high.py": """\
from dataclasses import dataclass

from ctrlplan import low

@dataclass
class Many:
"""
    + "".join(f"    field_{n}: int\n" for n in range(21))
    + "def long():\n    total = 0\n"
    + "    total += 1\n\n    # why\n" * 60
    + "top = low\n",
}
CONTRACT = """
[tool.importlinter]
root_package = "ctrlplan"
[[tool.importlinter.contracts]]
name = "Floors"
type = "layers"
layers = ["ctrlplan.high", "ctrlplan.low | ctrlplan.beside"]
ignore_imports = ["ctrlplan.low -> ctrlplan.*"]
"""


CONTRACTS = {
    "whole names": CONTRACT,
    "in a container": CONTRACT.replace(
        '["ctrlplan.high", "ctrlplan.low | ctrlplan.beside"]', '["high", "low | beside"]'
    )
    + 'containers = ["ctrlplan"]\n',
}


@pytest.fixture(scope="module", params=CONTRACTS)
def printed(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("measured")
    (folder / "ctrlplan").mkdir()
    (folder / "pyproject.toml").write_text(CONTRACTS[request.param])
    for name, text in FILES.items():
        (folder / "ctrlplan" / name).write_text(text)
    command = [sys.executable, *WARNINGS, measures.__file__, str(folder), "--list"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("what", "number"),
    [
        ("most parameters of a function", 4),
        ("functions of more than 19", 0),
        ("most fields of a dataclass", 21),
        ("signatures with untyped parameters (or `Any` alone)", 1),  # *rest
        ("signatures with `**`", 1),
        ("`Any`", 3),  # the import, *rest, what is returned
        ("modules that import upwards", 2),
        ("imports upwards", 2),  # low -> high, beside -> low on the same floor
        ("imports upwards that the contract does not name", 1),
        ("switches on names of plans", 1),
        ("switches on other strings", 3),
        ("switches on `Literal`", 1),
        ("functions of more than 60 lines", 1),  # 62: def, the first line, 60 more
        ("lines of code", (2 + 10) + 1 + (2 + 2 + 21 + 62 + 1)),  # low; beside; high: imports, class, fields, long, top
        ("modules", 4),
    ],
)
def test_each_number_is_the_one_counted_by_hand(printed, what, number):
    assert f"| {what} | {number} |" in printed.splitlines()


@pytest.mark.parametrize(
    ("code", "kind", "file"),
    [
        ('array.dtype.kind in "iuf"', "others' word", "a.py"),
        ('event.kind == "fall"', "string", "a.py"),
        ('method == "reduce"', "others' word", "a.py"),
        ('method == "exact"', "string", "a.py"),
        ('ufunc == "reduce"', "string", "a.py"),
        ('name.startswith("_")', "others' word", "a.py"),
        ('name.startswith("_d")', "string", "a.py"),
        ('line != "\\n"', "others' word", "a.py"),
        ('cell != "0"', "string", "a.py"),
        ('str(annotation).startswith("ClassVar")', "others' word", "a.py"),
        ('str(annotation).startswith("Array")', "string", "a.py"),
        ('east_asian_width(letter) in "WF"', "others' word", "a.py"),
        ('name in ("only", "measure")', "others' word", "former.py"),
        ('name in ("only", "measure")', "string", "a.py"),
        ('name == "step"', "name of a plan", "a.py"),
        ('flag != "CV_TOO_MUCH_WORK"', "others' word", "a.py"),
        ('flag != "TOO_MUCH_WORK"', "string", "a.py"),
    ],
)
def test_words_of_others_are_told_from_those_of_the_package(code, kind, file):
    (found,) = measures.switches([measures.Module(Path(file), code)])
    assert found.kind == kind


def test_strings_behind_constants_are_found_where_they_are_defined_and_where_they_are_imported():
    first = measures.Module(
        Path("ctrlplan/first.py"), 'WORD = "word"\nCOUNT = 3\nseen = name == WORD or size == COUNT\n'
    )
    text = "from ctrlplan.first import WORD\nif name.startswith(WORD):\n    pass\nWORD = other\n"
    second = measures.Module(Path("ctrlplan/second.py"), text)
    found = [(switch.place, switch.kind) for switch in measures.named_switches([first, second])]
    assert found == [("ctrlplan/first.py:3", "named string"), ("ctrlplan/second.py:2", "named string")]
    assert not list(measures.switches([first, second]))


def test_each_place_is_listed(printed):
    for line in (
        "ctrlplan/high.py:6 Many: 21",
        "ctrlplan/high.py:28 long: 62",
        "ctrlplan/low.py:7 chosen: **options",
        'ctrlplan/low.py:14 if name.startswith("step"):',
        "ctrlplan.beside -> ctrlplan.low",
    ):
        assert f"  {line}" in printed.splitlines()
