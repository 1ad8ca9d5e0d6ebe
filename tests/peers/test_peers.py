"""python-control's own tests and examples, every simulation in them compared with `ctrlplan.simulate`.

The test files are those of the installed package, the examples those of its
source distribution. They run in a process of their own with the plugin of
this folder, which makes each call of `input_output_response` and
`forced_response` with ctrlplan too (`adapter`) and records what differs
(`comparison`). Accepted differences are listed in exceptions.toml, by test and call.

The whole is a separate step of CI, ``python3 -m pytest tests/peers -m peers``; the
everyday run takes the sample stated at `SAMPLE`.
"""

import io
import json
import math
import os
import platform
import subprocess
import sys
import tomllib
from collections import Counter
from contextlib import redirect_stdout
from importlib import metadata, util
from pathlib import Path

import control
import numpy as np
import pytest

import ctrlplan as cp

HERE = Path(__file__).parent
TESTS = Path(control.__file__).parent / "tests"
VERSION = metadata.version("control")
TABLE = tomllib.loads((HERE / "exceptions.toml").read_text(encoding="utf-8"))

KINDS, CALLS = 15, 72
"""Maximum number of kinds and calls that may differ."""

SAMPLE = {"timeresp_test.py": 5, "iosys_test.py": 5, "nlsys_test.py": 2, "trdata_test.py": 3, "interconnect_test.py": 5}
"""Of each file the tests whose name's CRC-32 twice this number divides; four times the number in the everyday run."""

OF_DOCUMENTATION = "docstrings_test.py"
"""Tests of docstrings only, by a package that may be missing."""

SAME_ROUNDING = {"OPENBLAS_CORETYPE": "Nehalem"} if platform.machine() in ("x86_64", "AMD64") else {}
"""The OpenBLAS kernel that every such processor runs.

An optimiser that does not converge makes other calls after a different rounding error: with kernels
for AVX-512 one test makes 21 calls more, in two of which a car turns thousands of times.
"""


def versions():
    """What a result depends on."""
    return ", ".join(
        [
            f"Python {platform.python_version()}",
            *(f"{n} {metadata.version(n)}" for n in ("control", "numpy", "scipy", "casadi")),
        ]
    )


def listed(table):
    """Calls of a table: (test, call) to kind."""
    found = {}
    for kind in table["kinds"]:
        for line in kind["calls"]:
            test, _, numbers = line.rpartition(": ")
            for part in numbers.split(","):
                first, _, last = part.strip().partition("-")
                for call in range(int(first), int(last or first) + 1):
                    assert (test, call) not in found, f"{test}: {call} stands twice in the table"
                    found[test, call] = kind["name"]
    return found


def without_wide_instructions():
    """Names of the instructions found in this processor that not every one has: numpy rounds differently with them."""
    found = np.show_config("dicts").get("SIMD Extensions", {}).get("found", [])
    return " ".join([*os.environ.get("NPY_DISABLE_CPU_FEATURES", "").split(), *found])


def run(folder, *arguments, **environment):
    """Calls by test, and those that differ, of a separate process of pytest."""
    record = folder / "record"
    record.mkdir()
    support = str(HERE.parent / "support")  # without the project's settings: what conftest.py imports
    paths = [str(HERE), support, str(Path(cp.__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = (
        os.environ
        | environment
        | SAME_ROUNDING
        | {
            "NPY_DISABLE_CPU_FEATURES": without_wide_instructions(),
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "CTRLPLAN_PEERS": str(record),
            "MPLBACKEND": "Agg",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYCONTROL_TEST_EXAMPLES": "1",
        }
    )
    options = ["-p", "plugin", "-p", "no:cacheprovider", "--assert=plain", "-q", "--tb=short"]
    options += ["-c", os.devnull, "--rootdir", str(folder)]
    command = [sys.executable, "-m", "pytest", *options, *map(str, arguments)]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stdout[-3000:] + done.stderr[-3000:]
    calls, differing, spent = Counter(), {}, []
    for path in record.iterdir():
        for entry in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
            if "calls" not in entry:
                differing[entry["test"], entry["call"]] = "; ".join(map(": ".join, entry["differs"]))
                continue
            spent.append((entry["cpu"], entry["ours"], entry["test"]))
            if entry["calls"]:
                calls[entry["test"]] += entry["calls"]
    show_cost(spent, calls)
    return calls, differing


def show_cost(spent, calls):
    """Print CPU time of all tests, the part that comparisons take, and the ten longest tests."""
    total, ours = (sum(entry[k] for entry in spent) for k in (0, 1))
    print(f"\n{total:.0f} s of CPU time, {ours:.0f} s of it in comparisons; the longest tests:")
    for cpu, compared, test in sorted(spent, reverse=True)[:10]:
        print(f"{cpu:8.1f} s, {compared:6.1f} s in {calls[test]:6d} comparisons  {test}")


def check(calls, differing, table=TABLE):
    """Fail if an unlisted call differs, or a listed one agrees or is no longer made."""
    known = {key: kind for key, kind in listed(table).items() if key[0] in calls}
    summary = f"{sum(calls.values())} calls in {len(calls)} tests, {len(differing)} differ ({versions()})"
    print(summary)
    for title, entries in (
        ("differ and are not listed", [key for key in differing if key not in known]),
        ("are listed and are no longer made", [(test, call) for test, call in known if call > calls[test]]),
        ("are listed and do not differ", [key for key in known if key not in differing]),
    ):
        lines = [f"{test}: {call}: {known.get((test, call)) or differing[test, call]:.400}" for test, call in entries]
        assert not lines, f"{len(lines)} calls {title}; {summary}:\n" + "\n".join(lines[:60])


@pytest.fixture(scope="session")
def examples():
    """The folder of python-control's examples, from its source distribution."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "ctrlplan" / "peers"
    folder = cache / f"control-{VERSION}" / "examples"
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pip", "download", "-q", "--no-binary", ":all:", "--no-deps"]
        done = subprocess.run(
            [*command, "-d", str(cache), f"control=={VERSION}"], capture_output=True, text=True, check=False
        )
        if done.returncode:
            pytest.skip(f"the source distribution of control {VERSION} could not be downloaded: {done.stderr[-300:]}")
        import tarfile

        with tarfile.open(cache / f"control-{VERSION}.tar.gz") as archive:
            archive.extractall(cache, filter="data")
    return folder


@pytest.fixture(scope="session")
def tests():
    """The test files of the installed package."""
    if not TESTS.is_dir():
        pytest.skip(f"control {VERSION} was installed without its tests")
    return TESTS


def test_the_table_keeps_its_bounds():
    names = [kind["name"] for kind in TABLE["kinds"]]
    assert len(names) == len(set(names)) <= KINDS
    assert all(len(kind["reason"]) > 40 for kind in TABLE["kinds"])
    assert len(listed(TABLE)) <= CALLS


OWN = """
import control as ct
import numpy as np

def test_rounding():
    assert not np.show_config("dicts").get("SIMD Extensions", {}).get("found")
    ct.forced_response(ct.ss(-1, 1, 1, 0), [0, 1, 2], 1.0)  # made where numpy uses no wide instructions

def test_two():
    ct.forced_response(ct.ss(-1, 1, 1, 0), [0, 1, 2], 1.0)
    ct.forced_response(ct.ss(0.5, 1, 1, 0, None), [0, 1, 2], 1.0)  # discrete there, continuous here
"""


TESTS_OF_OWN = {"test_rounding": 1, "test_two": 2}
"""Numbers of their calls."""


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Two files of tests, run: their calls, those that differ, and what was printed."""
    folder = tmp_path_factory.mktemp("own")
    for name in ("b_test.py", "optimal_test.py"):
        (folder / name).write_text(OWN)
    with redirect_stdout(io.StringIO()) as printed:
        calls, differing = run(folder, "-p", "no:xdist", folder)
    return calls, differing, printed.getvalue()


@pytest.mark.slow
def test_calls_are_counted_and_one_that_differs_is_found(own):
    calls, differing, _ = own
    assert calls == {
        f"{name}_test.py::{test}": k for name in ("b", "optimal") for k, test in enumerate(TESTS_OF_OWN, 1)
    }
    assert set(differing) == {(f"{name}_test.py::test_two", 2) for name in ("b", "optimal")}
    # x' = x / 2 + 1 and x+ = x / 2 + 1, from 0.
    assert f"{2 * math.expm1(1.0):.6g}"[:6] in differing["b_test.py::test_two", 2]
    assert "for 1.5" in differing["b_test.py::test_two", 2]


@pytest.mark.slow
def test_the_longest_tests_go_first_and_their_cost_is_shown(own):
    calls, _, printed = own
    assert list(calls) == [f"{name}_test.py::{test}" for name in ("optimal", "b") for test in TESTS_OF_OWN]
    assert sum("in      2 comparisons" in line for line in printed.splitlines()) == 2


def test_the_check_fails_where_the_table_and_the_run_are_at_odds():
    table = {"kinds": [{"name": "kind", "calls": ["a_test.py::test_one: 2, 4-5"]}]}
    calls, text = Counter({"a_test.py::test_one": 5}), "outputs"
    differing = {("a_test.py::test_one", call): text for call in (2, 4, 5)}
    check(calls, differing, table)
    check(Counter({"b_test.py::test_two": 1}), {}, table)  # a part of the tests
    with pytest.raises(AssertionError, match=r"1 calls differ and are not listed.*control [0-9.]+(?s:.*)test_one: 3"):
        check(calls, {**differing, ("a_test.py::test_one", 3): text}, table)
    with pytest.raises(AssertionError, match=r"1 calls are listed and do not differ(?s:.*)test_one: 4: kind"):
        check(calls, {key: text for key in differing if key[1] != 4}, table)
    with pytest.raises(AssertionError, match=r"1 calls are listed and are no longer made(?s:.*)test_one: 5: kind"):
        check(Counter({"a_test.py::test_one": 4}), {key: text for key in differing if key[1] != 5}, table)


@pytest.mark.slow
@pytest.mark.parametrize(("part", "minimum"), [(4, 20), (2, 50)])
def test_a_sample_of_its_tests_agrees(part, minimum, tests, tmp_path):
    files, sample = [tests / name for name in SAMPLE], {name: part * number for name, number in SAMPLE.items()}
    calls, differing = run(tmp_path, "-p", "no:xdist", *files, CTRLPLAN_PEERS_SAMPLE=json.dumps(sample))
    check(calls, differing)
    assert sum(calls.values()) >= minimum


@pytest.mark.peers
def test_all_of_its_tests_and_examples_agree(tests, examples, tmp_path):
    ignored = [] if util.find_spec("numpydoc") else [f"--ignore={tests / OF_DOCUMENTATION}"]
    arguments = ["-n", "2", "--dist", "load", "--maxschedchunk", "1", *ignored, HERE / "examples.py", tests]
    calls, differing = run(tmp_path, *arguments, CTRLPLAN_PEERS_EXAMPLES=str(examples))
    check(calls, differing)
    missing = {test for test, _ in listed(TABLE)} - set(calls)
    assert not missing, f"{sorted(missing)} are listed and make no calls ({versions()})"
    assert sum(calls.values()) >= TABLE["calls"]
