"""The step reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_finite, checked_labels, finite_vector
from ctrlplan._types import Data
from ctrlplan.trajectories.common import Array, mapped_time, readonly
from ctrlplan.trajectories.trajectory import Trajectory


class Step(Trajectory):
    """Step from one position to another.

    Parameters
    ----------
    final : array_like, scalar or shape (naxes,)
        Position from `time` onward.
    initial : array_like, optional
        Position before `time`; default 0.
    time : float, optional
        Time of the step [s]: start and end of this trajectory.
    labels : sequence of str, optional
        Names of the axes.

    Raises
    ------
    ValueError
        If a position is not finite or the shapes differ.

    Examples
    --------
    >>> Step(2.0, time=1.0)([0.0, 1.0, 2.0])
    array([0., 2., 2.])
    """

    initial: Array
    final: Array

    def __init__(
        self,
        final: ArrayLike,
        initial: ArrayLike = 0.0,
        time: float = 0.0,
        labels: Sequence[str] | None = None,
    ) -> None:
        high, low = (
            finite_vector(values, name, "naxes", scalar=True)
            for values, name in ((final, "final"), (initial, "initial"))
        )
        if low.size == 1 and high.size > 1:
            low = np.repeat(low, high.size)
        if low.shape != high.shape:
            raise ValueError(
                f"initial must have the shape of final {np.shape(final)} or be a scalar, got {np.shape(initial)}"
            )
        self._set_fields(
            initial=readonly(low),
            final=readonly(high),
            labels=checked_labels(labels, high.size),
            breakpoints=readonly(np.array([checked_finite(time, "time")])),
        )

    @property
    def polynomial_degree(self) -> int:
        """Degree of a constant; as `Trajectory.polynomial_degree`."""
        return 0

    def to_dict(self) -> Data:
        """Plain data that `trajectory_from_dict` reads."""
        return {
            "type": "Step",
            "final": self.final.tolist(),
            "initial": self.initial.tolist(),
            "time": self.start,
            "labels": list(self.labels),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        return cls(data["final"], data["initial"], data["time"], data["labels"])

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return type(self)(self.final, self.initial, mapped_time(self.start, origin, target, rate), self.labels)

    def segment_jet(self, segment: int, s: Array, order: int) -> Array:
        """Derivatives of a segment; as `Trajectory.segment_jet`."""
        raise AssertionError("a step has no segments")
