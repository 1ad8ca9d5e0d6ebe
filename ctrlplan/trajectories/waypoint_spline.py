"""Interface of trajectories through waypoints, and their families."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, Self

from ctrlplan._checks import check_kind
from ctrlplan._types import Data
from ctrlplan.trajectories.common import mapped_time
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.waypoint import Waypoint


class FromWaypoints(ABC):
    """Interface of trajectory classes with a constructor from waypoints.

    Study files refer to such a class by its family.

    Attributes
    ----------
    family : str, class variable
        Name of the family; default: the name of the class.
    options : tuple of str, class variable
        Keyword arguments that are allowed in a study file.
    """

    family: ClassVar[str] = ""
    options: ClassVar[tuple[str, ...]] = ()

    @classmethod
    @abstractmethod
    def from_waypoints(cls, waypoints: Iterable[Waypoint], **options: Any) -> Trajectory:
        """Trajectory of this class through waypoints.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            Two or more, times increasing.
        **options
            Arguments named in `options`.

        Raises
        ------
        ValueError
            If the class does not support such waypoints, or an option is wrong.
        """


class WaypointSpline(Trajectory, FromWaypoints):
    """Spline through waypoints that can be rebuilt through others.

    `avoid`, ``fastest(hold="waypoints")``, `choose_alpha` and study files accept
    every subclass.

    A new subclass must define

    - a constructor ``(waypoints, *, labels=None, ...)`` that sets the fields
      `waypoints`, `labels`, `breakpoints` and its own fields by
      ``self._set_fields(...)`` (see `Trajectory`);
    - `segment_jet`, the derivatives between two breakpoints;
    - `options`, the names of further constructor arguments, each stored in a
      field of that name, if there are any.

    `through`, `with_values`, `map_time`, `to_dict` and `from_dict` are inherited.
    `map_time` rebuilds the spline through waypoints at other times. A subclass for
    which that changes the path must override it.

    Attributes
    ----------
    waypoints : tuple of Waypoint
        Prescribed positions and derivatives, two or more.

    Examples
    --------
    The natural cubic spline of scipy, through positions:

    >>> import numpy as np
    >>> from scipy.interpolate import CubicSpline
    >>> import ctrlplan as cp
    >>> class Natural(cp.WaypointSpline):
    ...     _spline: CubicSpline
    ...
    ...     def __init__(self, waypoints, *, labels=None):
    ...         points = tuple(waypoints)
    ...         times = np.array([point.time for point in points])
    ...         names = labels or points[0].labels or [f"y{i + 1}" for i in range(points[0].naxes)]
    ...         spline = CubicSpline(times, [point.position for point in points], bc_type="natural")
    ...         self._set_fields(waypoints=points, labels=tuple(names), breakpoints=times, _spline=spline)
    ...
    ...     def segment_jet(self, segment, s, order):
    ...         c = self._spline.c[:, segment]  # (4, naxes), the highest power first
    ...         rows = []
    ...         for _ in range(order + 1):
    ...             rows.append(sum(c[-1 - k][:, None] * s**k for k in range(len(c))) + 0.0 * s)
    ...             c = c[:-1] * np.arange(len(c) - 1, 0, -1)[:, None] if len(c) > 1 else 0.0 * c
    ...         return np.array(rows)
    >>> plan = Natural([cp.Waypoint(0, [0, 0]), cp.Waypoint(2, [5, 1]), cp.Waypoint(4, [10, 0])])
    >>> cp.avoid(plan, [cp.Disc((2.0, 0.0), 0.5)], clearance=0.5).clearance.certified
    True
    >>> round(cp.fastest(plan, {"y1_d1": 5.0}, hold="waypoints").duration, 9)
    2.0
    """

    is_linear: ClassVar[bool] = False
    """Whether positions at fixed times depend linearly on the entries of the waypoints."""

    waypoints: tuple[Waypoint, ...]

    @classmethod
    def from_waypoints(cls, waypoints: Iterable[Waypoint], **options: Any) -> Self:
        """Spline of this class through waypoints."""
        kind: Any = cls  # with the constructor of the subclass
        found: Self = kind(waypoints, **options)
        return found

    def through(self, waypoints: Iterable[Waypoint]) -> Self:
        """Spline of the same class and options through other waypoints.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            Of as many axes as before, at any times.

        Raises
        ------
        ValueError
            If the axes differ in number; otherwise as the constructor.
        """
        points = same_axes(checked_waypoints(waypoints), self.naxes)
        return type(self).from_waypoints(points, labels=self.labels, **self._own_options())

    def with_values(self, waypoints: Iterable[Waypoint]) -> Self:
        """Spline of the same class and times through other values.

        Parameters
        ----------
        waypoints : iterable of Waypoint
            As many as before and at the same times.

        Raises
        ------
        ValueError
            If a time differs.
        """
        return self.through(same_times(waypoints, self.waypoints))

    def quiet(self) -> Self:
        """The same spline without warnings of other methods."""
        return self

    def map_time(self, origin: float, target: float, rate: float) -> Self:
        """Same path at other times; as `Trajectory.map_time`."""
        return self.through(w.scaled(mapped_time(w.time, origin, target, rate), rate) for w in self.waypoints)

    def to_dict(self) -> Data:
        """Plain data: type, waypoints, labels and options."""
        return {
            "type": type(self).__name__,
            "waypoints": [w.to_dict() for w in self.waypoints],
            "labels": list(self.labels),
            **self._own_options(),
        }

    @classmethod
    def from_dict(cls, data: Data) -> Self:
        """Trajectory from the plain data of `to_dict`."""
        points = [Waypoint.from_dict(w) for w in data["waypoints"]]
        chosen = {name: data[name] for name in cls.options if name in data}
        return cls.from_waypoints(points, labels=data["labels"], **chosen)

    def _own_options(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.options}


def families() -> dict[str, type[FromWaypoints]]:
    """Trajectory classes with a constructor from waypoints, by family.

    Returns
    -------
    dict of str to type
        Classes of this package and all others that have been imported.

    Raises
    ------
    ValueError
        If two classes have the same family.
    """
    found: dict[str, type[FromWaypoints]] = {}
    for kind in Trajectory.kinds.values():
        if issubclass(kind, FromWaypoints):
            name = family_name(kind)
            if name in found:
                raise ValueError(
                    f"families of trajectories must have different names, got {name!r} of {found[name].__name__} "
                    f"and of {kind.__name__}"
                )
            found[name] = kind
    return found


def family_name(kind: type[FromWaypoints]) -> str:
    """Name of a family: that defined in the class itself, or the name of the class."""
    return str(kind.__dict__.get("family", kind.__name__))


def checked_waypoints(waypoints: Iterable[Waypoint], minimum: int = 2) -> tuple[Waypoint, ...]:
    """Waypoints as a tuple: a minimum number, with equal axes, at increasing times."""
    check_kind(waypoints, "waypoints", Iterable, "a sequence of Waypoint")
    points = tuple(waypoints)
    if len(points) < minimum:
        number = {1: "one waypoint", 2: "two waypoints"}[minimum]
        raise ValueError(f"a plan must have at least {number}, got {len(points)}")
    return increasing(points)


def increasing(points: tuple[Waypoint, ...]) -> tuple[Waypoint, ...]:
    """Waypoints, checked for equal axes and increasing times."""
    before: Waypoint | None = None
    for i, point in enumerate(points):
        if not isinstance(point, Waypoint):
            raise TypeError(f"waypoints[{i}] must be a Waypoint, got {type(point).__name__}")
        if before is not None:
            if point.naxes != before.naxes or point.labels != before.labels:
                raise ValueError(
                    f"waypoints must have the same axes, got waypoints[{i}] with {_axes(point)} "
                    f"after waypoints[{i - 1}] with {_axes(before)}"
                )
            if not point.time > before.time:
                raise ValueError(
                    f"times must increase strictly, got waypoints[{i}].time = {point.time} "
                    f"after waypoints[{i - 1}].time = {before.time}"
                )
        before = point
    return points


def _axes(point: Waypoint) -> str:
    return f"{point.naxes} axes" if point.labels is None else f"axes {', '.join(point.labels)}"


def same_times(waypoints: Iterable[Waypoint], before: tuple[Waypoint, ...]) -> tuple[Waypoint, ...]:
    """Waypoints, checked for the times and the number of axes of others."""
    points = tuple(waypoints)
    for i, point in enumerate(points):
        if not isinstance(point, Waypoint):
            raise TypeError(f"waypoints[{i}] must be a Waypoint, got {type(point).__name__}")
    times = [w.time for w in before]
    if [w.time for w in points] != times:
        raise ValueError(f"waypoints must keep the times {times}, got {[w.time for w in points]}")
    return same_axes(points, before[0].naxes)


def same_axes(points: tuple[Waypoint, ...], naxes: int) -> tuple[Waypoint, ...]:
    """Waypoints, checked for a number of axes."""
    if points[0].naxes != naxes:
        raise ValueError(f"waypoints must keep the number of axes, {naxes}, got {points[0].naxes}")
    return points
