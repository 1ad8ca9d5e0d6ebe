"""Draws of a lag that several files look at, run once."""

import pytest
from ensemble_cases import LAGS, exploding, lag, run


@pytest.fixture(scope="session")
def found():
    return run(lag(), LAGS)


@pytest.fixture(scope="session")
def exploded():
    """Draws of which the third ends at 2 s."""
    return run(exploding(), {"k": [0.01, 0.05, 0.5, 0.09]}, initial_state=[1.0])
