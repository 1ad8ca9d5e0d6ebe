"""One hypothesis profile for all tests: no deadline, for a loaded machine is no fault; what tests import; figures."""

import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent / "support"))

settings.register_profile("ctrlplan", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ctrlplan")


@pytest.fixture(autouse=True)
def _no_figure_is_left_open():
    """Close what a test has drawn: pyplot keeps figures, and warns after twenty."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
