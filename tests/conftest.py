"""One hypothesis profile for all tests: no deadline, for a loaded machine is no fault; the same examples every time."""

from hypothesis import settings

settings.register_profile("ctrlplan", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ctrlplan")
