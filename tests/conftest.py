"""One hypothesis profile for all tests: no deadline, for a loaded machine is no fault; figures; order of tests."""

import gc
import os
import sys

import pytest
from hypothesis import settings

# Matrices are small here: more threads of BLAS only wait for each other, and tests run in several processes already.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

collect_ignore = ["support"]  # no tests: what they import, under one name and not again as tests.support.NAME

settings.register_profile("ctrlplan", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ctrlplan")

# Imports and collected tests stay until the end: a third of the time of collection went into looking for garbage there.
gc.disable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Look for garbage from now on, among what is made from now on."""
    gc.enable()
    gc.freeze()


@pytest.fixture(autouse=True)
def _no_figure_is_left_open():
    """Close what a test has drawn: pyplot keeps figures, and warns after twenty."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each process runs tests that follow each other, so that they share what files compute once; then it steals."""
    if config.getoption("dist") != "load":  # another was chosen
        return None
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)
