"""Random draws of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._types import Array


class Frozen(Protocol):
    """A frozen distribution of `scipy.stats`."""

    def rvs(self, size: int, random_state: np.random.Generator) -> ArrayLike:
        """Random values."""


Distribution: TypeAlias = Sequence[float] | Array | Frozen
"""Two numbers, the ends of a uniform distribution, or a frozen distribution of `scipy.stats`."""


def draws(count: int, seed: int = 0, **distributions: Distribution) -> dict[str, Array]:
    """Random parameters, the same for the same seed.

    Parameters
    ----------
    count : int
        Number of draws.
    seed : int, optional
        Seed of the generator. Each parameter has a separate random stream, so
        that adding a parameter does not change the others.
    **distributions
        By name of the parameter: (low, high) of a uniform distribution, or a
        frozen distribution of `scipy.stats`.

    Returns
    -------
    dict of str to ndarray, shape (count,)
        For `monte_carlo`.

    Raises
    ------
    ValueError
        If `count` is not above 0, or low is above high.
    TypeError
        If a distribution is of another type.

    Examples
    --------
    >>> found = draws(3, seed=1, load_mass=(400.0, 600.0))
    >>> bool(400.0 <= found["load_mass"].min() <= found["load_mass"].max() <= 600.0)
    True
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ValueError(f"count must be an integer of at least 1, got {count!r}")
    found = {}
    for name, distribution in distributions.items():
        rng = np.random.default_rng([seed, *name.encode()])
        if hasattr(distribution, "rvs"):
            values = distribution.rvs(size=count, random_state=rng)
        elif np.shape(distribution) == (2,):
            low, high = (float(end) for end in distribution)
            if not -np.inf < low <= high < np.inf:
                raise ValueError(f"{name} must have finite limits low <= high, got {low} and {high}")
            values = rng.uniform(low, high, count)
        else:
            raise TypeError(f"{name} must be (low, high) or a distribution of scipy.stats, got {distribution!r}")
        found[name] = np.asarray(values, dtype=float)
    return found
