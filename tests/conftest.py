"""One hypothesis profile for all tests: no deadline, for a loaded machine is no fault; and what tests import."""

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent / "support"))

settings.register_profile("ctrlplan", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ctrlplan")
