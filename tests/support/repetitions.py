"""Numbers of examples and cases of one kind: all of them in a run of the whole suite, fewer in the everyday run."""

import pytest
from hypothesis import settings

settings.register_profile("whole", deadline=None, derandomize=True, print_blob=True, max_examples=30)
settings.register_profile("everyday", settings.get_profile("whole"), max_examples=15)


def load(everyday):
    """Load the profile of a run; before test modules are imported, whose decorators read it."""
    settings.load_profile("everyday" if everyday else "whole")


def examples(number):
    """Settings of a test with a share of so many examples: as in the profile, of 100, at least 5."""
    return settings(max_examples=min(number, max(5, number * settings.default.max_examples // 100)))


def one_in(number, cases, first=0):
    """Cases of one kind for `pytest.mark.parametrize`: one in so many is everyday, the others slow."""
    return [
        case if k % number == first % number else pytest.param(case, marks=pytest.mark.slow)
        for k, case in enumerate(cases)
    ]
