"""What several files look at, run once: draws of a lag, and the baselines of the nominal move."""

import pytest
from ensemble_cases import LAGS, exploding, lag, run

from ctrlplan.studies.choosing import nominal_benefit


@pytest.fixture(scope="session")
def found():
    return run(lag(), LAGS)


@pytest.fixture(scope="session")
def exploded():
    """Draws of which the third ends at 2 s."""
    return run(exploding(), {"k": [0.01, 0.05, 0.5, 0.09]}, initial_state=[1.0])


@pytest.fixture(scope="session")
def baselines():
    """The nominal move compared with its baselines."""
    return nominal_benefit()
