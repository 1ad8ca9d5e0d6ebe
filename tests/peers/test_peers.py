"""python-control's own tests and examples, every simulation in them compared with `ctrlplan.simulate`.

The test files are those of the installed package, the examples those of its
source distribution. They run in a process of their own with the plugin of
this folder, which makes each call of `input_output_response` and
`forced_response` with ctrlplan too (`adapter`) and records what differs
(`comparison`). What may differ stands in exceptions.toml, by test and call.

The whole is its own step of CI, ``python3 -m pytest tests/peers -m peers``; the
everyday run takes the sample stated at `SAMPLE`.
"""

import json
import os
import platform
import subprocess
import sys
import tomllib
from collections import Counter
from importlib import metadata, util
from pathlib import Path

import control
import pytest

import ctrlplan as cp

HERE = Path(__file__).parent
TESTS = Path(control.__file__).parent / "tests"
VERSION = metadata.version("control")
TABLE = tomllib.loads((HERE / "exceptions.toml").read_text(encoding="utf-8"))

KINDS, CALLS = 15, 72
"""Kinds and calls that may differ, at most."""

SAMPLE = {"timeresp_test.py": 5, "iosys_test.py": 5, "nlsys_test.py": 2, "trdata_test.py": 3, "interconnect_test.py": 5}
"""Everyday run: of each file the tests whose name's CRC-32 this number divides."""

OF_DOCUMENTATION = "docstrings_test.py"
"""Reads docstrings alone, by a package that need not be here."""


def versions():
    """What a result depends on."""
    return ", ".join(
        [
            f"Python {platform.python_version()}",
            *(f"{n} {metadata.version(n)}" for n in ("control", "numpy", "scipy", "casadi")),
        ]
    )


def listed():
    """Calls of the table: (test, call) to kind."""
    found = {}
    for kind in TABLE["kinds"]:
        for line in kind["calls"]:
            test, _, numbers = line.rpartition(": ")
            for part in numbers.split(","):
                first, _, last = part.strip().partition("-")
                for call in range(int(first), int(last or first) + 1):
                    assert (test, call) not in found, f"{test}: {call} stands twice in the table"
                    found[test, call] = kind["name"]
    return found


def run(folder, *arguments, **environment):
    """Calls by test, and those that differ with what does, of a run of pytest in a process of its own."""
    record = folder / "record"
    record.mkdir()
    paths = [str(HERE), str(Path(cp.__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = (
        os.environ
        | environment
        | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "CTRLPLAN_PEERS": str(record),
            "MPLBACKEND": "Agg",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYCONTROL_TEST_EXAMPLES": "1",
        }
    )
    options = ["-p", "plugin", "-p", "no:cacheprovider", "-q", "--tb=short", "-c", os.devnull, "--rootdir", str(folder)]
    command = [sys.executable, "-m", "pytest", *options, *map(str, arguments)]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stdout[-3000:] + done.stderr[-3000:]
    calls, differing = Counter(), {}
    for path in record.iterdir():
        for entry in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
            if "calls" in entry:
                calls[entry["test"]] += entry["calls"]
            else:
                differing[entry["test"], entry["call"]] = "; ".join(map(": ".join, entry["differs"]))
    return calls, differing


def check(calls, differing):
    """Fail where an unlisted call differs, and where a listed one agrees or is not made any more."""
    known = {key: kind for key, kind in listed().items() if key[0] in calls}
    unlisted = [f"{test}: {call}: {text:.400}" for (test, call), text in differing.items() if (test, call) not in known]
    agreeing = [f"{test}: {call} ({kind})" for (test, call), kind in known.items() if (test, call) not in differing]
    gone = [f"{test}: {call} of {calls[test]} ({kind})" for (test, call), kind in known.items() if call > calls[test]]
    summary = f"{sum(calls.values())} calls in {len(calls)} tests, {len(differing)} differ ({versions()})"
    print(summary)
    for title, entries in (
        ("differ and are not listed", unlisted),
        ("are listed and do not differ", [e for e in agreeing if e not in gone]),
        ("are listed and are no longer made", gone),
    ):
        assert not entries, f"{len(entries)} calls {title}; {summary}:\n" + "\n".join(entries[:40])


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
    assert len(listed()) <= CALLS


def test_a_sample_of_its_tests_agrees(tests, tmp_path):
    files = [tests / name for name in SAMPLE]
    calls, differing = run(tmp_path, "-p", "no:xdist", *files, CTRLPLAN_PEERS_SAMPLE=json.dumps(SAMPLE))
    check(calls, differing)
    assert sum(calls.values()) >= 100


@pytest.mark.peers
def test_all_of_its_tests_and_examples_agree(tests, examples, tmp_path):
    ignored = [] if util.find_spec("numpydoc") else [f"--ignore={tests / OF_DOCUMENTATION}"]
    arguments = ["-n", "2", "--dist", "worksteal", *ignored, HERE / "examples.py", tests]
    calls, differing = run(tmp_path, *arguments, CTRLPLAN_PEERS_EXAMPLES=str(examples))
    check(calls, differing)
    missing = {test for test, _ in listed()} - set(calls)
    assert not missing, f"{sorted(missing)} are listed and make no calls ({versions()})"
    assert sum(calls.values()) >= TABLE["calls"]
