"""Trajectories that are used inside a computation only, and cannot be retimed or saved."""

from __future__ import annotations

from typing import ClassVar, NoReturn, Self

from ctrlplan._types import Data
from ctrlplan.trajectories.trajectory import Trajectory


class InternalTrajectory(Trajectory):
    """Base class of a trajectory that no user is given.

    Attributes
    ----------
    what : str
        Description of it in messages.
    """

    can_be_stored = False
    what: ClassVar[str]

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Not defined."""
        self._reject()

    def to_dict(self) -> Data:
        """Not defined."""
        self._reject()

    @classmethod
    def from_dict(cls, data: Data) -> Trajectory:
        """Not defined."""
        cls._reject()

    @classmethod
    def _reject(cls) -> NoReturn:
        raise TypeError(f"{cls.what} cannot be retimed or saved")
