"""Hypothesis profiles without deadlines, which a loaded machine would miss; everyday cases; figures; order of tests."""

import gc
import os
import sys
import zlib
from pathlib import Path

import pytest
import repetitions

# Matrices are small here: more threads of BLAS only wait for each other, and tests run in several processes already.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Programs that tests start import compiled modules: to compile the package takes a second.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

HERE = Path(__file__).parent

collect_ignore = ["support"]  # no tests: what they import, under one name and not again as tests.support.NAME


def everyday(config):
    """Whether the run leaves out the slow tests."""
    return "not slow" in config.getoption("markexpr")


def pytest_configure(config):
    """Fewer examples of each hypothesis in the everyday run."""
    repetitions.load(everyday(config))


def pytest_addoption(parser):
    parser.addoption(
        "--all-combinations",
        action="store_true",
        help="run all combinations of lists of cases; without it, an eighth of those in which no case is new",
    )


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config, items):
    """Of all combinations of several lists of cases, those not needed to have each case of each list once are slow,
    and an eighth of them is run. Of the cases of a test that are left, a third is everyday.
    """
    ours = [item for item in items if HERE in item.path.parents]  # another package's tests are all run
    families = {}
    for item in ours:
        if len(lists := list(item.iter_markers("parametrize"))) > 1:
            values = {(names, _case(item, names)) for names in map(_names, lists)}
            families.setdefault(item.nodeid.partition("[")[0], []).append((item, values))
    left_out = set()
    for cases in families.values():
        known, chosen = set(), set()
        _choose([case for case in cases if not case[0].get_closest_marker("slow")], known, chosen)
        everyday = set(chosen)
        _choose(cases, known, chosen)
        for item, _ in cases:
            if item not in everyday and not item.get_closest_marker("slow"):
                item.add_marker("slow")
            redundant = item not in chosen and not item.get_closest_marker("every_combination")
            if redundant and zlib.crc32(item.nodeid.encode()) % 8:  # the same in each process, whichever files are run
                left_out.add(item)
    if left_out and not config.getoption("all_combinations", False):
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]
    _leave_a_third(ours)


def _leave_a_third(items):
    """Make slow two thirds of the cases of each test that has more than two: the same in all tests of a file, which
    share what they compute for a case.
    """
    tests = {}
    for item in items:
        if not any(map(item.get_closest_marker, ("slow", "every_combination"))):
            tests.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for name, cases in tests.items():
        first = zlib.crc32(name.partition("::")[0].encode()) % 3
        for k, item in enumerate(cases if len(cases) > 2 else ()):
            if k % 3 != first:
                item.add_marker("slow")


def _choose(cases, known, chosen):
    """Add to the chosen tests until all values of these cases are known."""
    for enough in (set.isdisjoint, lambda values, known: not values <= known):  # all values new, then any of them
        for item, values in cases:
            if item not in chosen and enough(values, known):
                known |= values
                chosen.add(item)


def _names(mark):
    """The parameters of one list of cases."""
    return tuple(mark.args[0].replace(",", " ").split()) if isinstance(mark.args[0], str) else tuple(mark.args[0])


def _case(item, names):
    """The case of one list which a test takes."""
    return tuple(id(item.callspec.params[name]) for name in names)


# Imports and collected tests stay until the end: a third of the time of collection went into looking for garbage there.
gc.disable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Look for garbage from now on, among what is made from now on, and not after each 700 objects."""
    gc.enable()
    gc.set_threshold(50_000)
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown():
    """Close what a test has drawn: pyplot keeps figures, and warns after twenty."""
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture
def blank_drawings(monkeypatch):
    """Pages with blank drawings, for tests of what is around them."""
    monkeypatch.setattr("ctrlplan.reports.shown.to_svg", lambda figure, key: "<svg></svg>")


@pytest.fixture
def drawn_if_slow(request):
    """Pages with blank drawings in everyday tests only: what differs from case to case is drawn in the slow ones."""
    if not request.node.get_closest_marker("slow"):
        request.getfixturevalue("blank_drawings")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each process runs tests that follow each other, so that they share what files compute once; then it steals."""
    if config.getoption("dist") != "load":  # another was chosen
        return None
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)
