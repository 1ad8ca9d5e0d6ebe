"""Events: times at which a signal crosses its limits."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ctrlplan._display import time_text
from ctrlplan._types import Array, EventName

_BEFORE, _NEWTON, _STEPS = 5, 6, 12
"""Number of samples before a crossing by which it is extrapolated, steps to the root of their polynomial, and maximum
number of values by secants before the interval of the samples is searched."""

_APART = 1e3
"""Distance of two times, in tolerances of a root, above which the slope between them is used."""

Signal = Callable[[Array, Array, Array, Array], Array]
"""(t, x, u, y) at many times, time last -> values (ntime,)."""
Events: TypeAlias = Sequence["Event"] | None
"""Events of a run. None: the limits that blocks declare; a sequence: these in addition; empty: none at all."""


@dataclass(frozen=True)
class Event:
    """Limits of a signal whose crossings are recorded in a run.

    Parameters
    ----------
    signal : str or callable
        Label of an output, state or input of the system; or a function of
        (t, x, u, y), arrays with time last, that returns (ntime,) values.
    low, high : float, optional
        Limits in the unit of the signal; at least one.
    stop : bool, optional
        End the run where the signal leaves its limits.
    name : str, optional
        Name of the crossings; the signal's label unless given.

    Raises
    ------
    ValueError
        If `low` is not below `high`, or neither is given.

    Examples
    --------
    >>> Event("T", low=0.0, stop=True).name
    'T'
    """

    signal: str | Signal
    low: float = -math.inf
    high: float = math.inf
    stop: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.signal, str) and not callable(self.signal):
            raise TypeError(f"signal must be a label or a function of (t, x, u, y), got {self.signal!r}")
        if not self.low < self.high:
            raise ValueError(f"low must be below high, got {self.low} and {self.high}")
        if math.isinf(self.low) and math.isinf(self.high):
            raise ValueError("an event must have a limit, got neither low nor high")
        if not self.name:
            label = self.signal if isinstance(self.signal, str) else getattr(self.signal, "__name__", "event")
            object.__setattr__(self, "name", label)


EventKind = Literal["below", "above", "inside"]
"""How a signal crossed a limit of an event."""


@dataclass(frozen=True)
class Occurrence:
    """Crossing of a limit of an event.

    Attributes
    ----------
    time : float
        Time of the crossing [s], to the accuracy of the run.
    name : str
        Name of the event.
    kind : {"below", "above", "inside"}
        "below" or "above": the signal left its limits, or was outside at the
        start of the run; "inside": it returned within them.
    stop : bool
        Whether the event ended the run.
    """

    time: float
    name: str
    kind: EventKind
    stop: bool = False

    def __str__(self) -> str:
        """Time, name and kind in words."""
        end = ", where the run ends" if self.stop else ""
        if isinstance(self.name, EventName) and (self.kind != "inside" or not self.name.words):
            return (
                f"{time_text(self.time)} s: {what_happened(self.name)}{' (end)' if self.kind == 'inside' else ''}{end}"
            )
        where = "within its limits" if self.kind == "inside" else f"{self.kind} its limit"
        return f"{time_text(self.time)} s: {self.name} {where}{end}"


def what_happened(name: str) -> str:
    """Event in words, as its block declares it.

    For other events: that the signal left its limits.
    """
    if isinstance(name, EventName):
        return f"{name} {name.words}" if name.words else str(name)
    return f"{name} left its limits"


class Departures(NamedTuple):
    """Crossings by which signals left their limits: name of the event, their number, and the first time [s]."""

    name: str
    number: int
    first: float

    @classmethod
    def of(cls, events: Iterable[Occurrence]) -> list[Departures]:
        """Those of located events, in order of the first time."""
        return cls.by_name(cls(event.name, 1, event.time) for event in events if event.kind != "inside")

    @classmethod
    def by_name(cls, found: Iterable[Departures]) -> list[Departures]:
        """Those of one name together, in order of the first time."""
        groups = dict[str, list[Departures]]()
        for one in found:
            groups.setdefault(one.name, []).append(one)
        total = [
            cls(name, sum(one.number for one in group), min(one.first for one in group))
            for name, group in groups.items()
        ]
        return sorted(total, key=lambda one: one.first)


class LaterEvents(ABC):
    """Events of a run that are located when they are required."""

    @abstractmethod
    def __call__(self) -> list[Occurrence]:
        """All crossings up to the end of the run, in order of time."""

    @abstractmethod
    def departures(self) -> list[Departures]:
        """Crossings by which signals left their limits, of each event; only the first is located."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Times, states and inputs of a run, time last; its outputs, and all signals of a network, on demand."""

    t: Array
    x: Array
    u: Array
    outputs: Callable[[], Array]
    signals: Callable[[], Array] | None = None

    @cached_property
    def y(self) -> Array:
        """Outputs, (noutputs, ntime)."""
        return self.outputs()

    @cached_property
    def w(self) -> Array:
        """All signals of the network, (nsignals, ntime)."""
        if self.signals is None:
            raise ValueError("internal signals must come from a network, got a run by python-control")
        return self.signals()

    def at(self, places: NDArray[np.intp]) -> Snapshot:
        """Snapshot at some of the times; outputs and signals are evaluated at all times, once."""
        return Snapshot(
            self.t[places],
            self.x[:, places],
            self.u[:, places],
            lambda: self.y[:, places],
            None if self.signals is None else lambda: self.w[:, places],
        )


@dataclass(frozen=True, eq=False)
class Watched:
    """Signal of a run and its limits: an event with its label resolved."""

    name: str
    value: Callable[[Snapshot], Array]
    low: float
    high: float
    stop: bool = False

    def side(self, values: Array) -> NDArray[np.int_]:
        """-1 below, 0 inside, 1 above the limits."""
        return (values > self.high).astype(int) - (values < self.low).astype(int)

    def limit(self, side: int, other: int) -> float:
        """Limit that separates two adjacent sides."""
        return self.high if max(side, other) > 0 else self.low


def crossings(
    watched: Watched, times: Array, values: Array, value_at: Callable[[int, float], float]
) -> Iterator[Occurrence]:
    """Crossings of limits in a record, in order of time, each located by root finding when it is required.

    Parameters
    ----------
    watched : Watched
        Signal and limits.
    times, values : ndarray, shape (ntime,)
        The record.
    value_at : callable
        Maps k and a time between times[k] and times[k + 1] to the signal.
    """
    sides = watched.side(values)
    if sides[0]:
        yield Occurrence(float(times[0]), watched.name, _KINDS[int(sides[0])], watched.stop)
    time = -math.inf
    for k in np.flatnonzero(np.diff(sides)).tolist():
        before, after = int(sides[k]), int(sides[k + 1])
        # Between below and above, both limits are crossed.
        stages = [(before, 0), (0, after)] if before * after < 0 else [(before, after)]
        for left, right in stages:
            level = watched.limit(left, right)
            interval = float(times[k]), float(times[k + 1])
            at_ends = float(values[k]) - level, float(values[k + 1]) - level
            function = partial(_beyond, value_at, k, level)
            if 0.0 in at_ends:
                root = _root_from(function, *interval, *at_ends, level)
            else:
                root = _root(function, *interval, *at_ends, _expected(times, values, k, level))
            # Both limits may be within a rounding error of time.
            time = root if left == before else max(root, time)
            yield Occurrence(time, watched.name, _KINDS[right], watched.stop and right != 0)


def first_stop(watched: Iterable[Watched], seen: Snapshot) -> int | None:
    """Index of the first time at which an event that ends the run has occurred; None if there is none."""
    beyond = [entry.side(entry.value(seen)) != 0 for entry in watched if entry.stop]
    where = np.flatnonzero(np.any(beyond, axis=0)) if beyond else np.zeros(0, dtype=np.intp)
    return int(where[0]) if where.size else None


def departures_of(
    watched: Watched, times: Array, values: Array, value_at: Callable[[int, float], float]
) -> list[Departures]:
    """Number and first of the crossings by which a signal left its limits, the only one located; empty without any.

    Arguments are those of `crossings`.
    """
    sides = watched.side(values)
    count = int(sides[0] != 0) + int(np.count_nonzero((sides[1:] != sides[:-1]) & (sides[1:] != 0)))
    # The first crossing is one of them: the start, if the signal is outside there.
    return [Departures(watched.name, count, next(crossings(watched, times, values, value_at)).time)] if count else []


def watched_events(events: Sequence[Event], labels: Mapping[str, tuple[str, int]]) -> list[Watched]:
    """Events with their labels resolved.

    Parameters
    ----------
    events : sequence of Event
        Events given by the user.
    labels : mapping of str to (kind, int)
        "x", "u" or "y", and the row, of every label.
    """
    if isinstance(events, Event):
        raise TypeError("events must be a sequence of Event, got a single Event")
    found = []
    for event in events:
        if not isinstance(event, Event):
            raise TypeError(f"events must be Event, got {type(event).__name__}")
        found.append(Watched(event.name, _value(event.signal, labels), event.low, event.high, event.stop))
    return found


_KINDS: dict[int, EventKind] = {-1: "below", 0: "inside", 1: "above"}


def _value(signal: str | Signal, labels: Mapping[str, tuple[str, int]]) -> Callable[[Snapshot], Array]:
    if isinstance(signal, str):
        if signal not in labels:
            raise ValueError(f"signal of an event must be among {', '.join(labels)}, got {signal!r}")
        kind, row = labels[signal]
        return partial(_row, kind, row)
    function = signal

    def value(seen: Snapshot) -> Array:
        values = np.asarray(function(seen.t, seen.x, seen.u, seen.y), dtype=float)
        if values.shape != seen.t.shape:
            raise ValueError(f"signal of an event must return {seen.t.size} values, got shape {values.shape}")
        return values

    return value


def _beyond(value_at: Callable[[int, float], float], k: int, level: float, t: float) -> float:
    return value_at(k, t) - level


def _row(kind: str, row: int, seen: Snapshot) -> Array:
    return np.asarray(getattr(seen, kind)[row])


def _expected(times: Array, values: Array, k: int, level: float) -> tuple[float, float]:
    """Time at which a signal is expected to be at a level after times[k], and its slope there.

    By the polynomial through the last samples before, as there may be a kink at the level.
    """
    first = max(0, k + 1 - _BEFORE) if k else 0
    last = max(k, 1)
    t, terms = (times[first : last + 1] - times[k]).tolist(), (values[first : last + 1] - level).tolist()
    for n in range(1, len(t)):  # divided differences
        for j in range(len(t) - 1, n - 1, -1):
            terms[j] = (terms[j] - terms[j - 1]) / (t[j] - t[j - n])
    at, slope = 0.0, math.nan
    for _ in range(_NEWTON):
        value, slope = terms[-1], 0.0
        for node, term in zip(t[-2::-1], terms[-2::-1], strict=True):
            value, slope = term + (at - node) * value, value + (at - node) * slope
        if not slope:
            return math.nan, math.nan
        at -= value / slope
    return float(times[k]) + at, slope


def _root(
    function: Callable[[float], float],
    left: float,
    right: float,
    at_left: float,
    at_right: float,
    expected: tuple[float, float],
) -> float:
    """Root of a function, rounded to the side on which it is at `right`.

    It is first searched near an expected root with a slope.
    """
    if at_left * at_right >= 0.0:
        return right
    crossed = [right]
    known = dict[float, float]()  # a value may differ by rounding when it is computed again

    def value(t: float) -> float:
        if t <= left or t >= right:
            return at_left if t <= left else at_right
        if t not in known:
            known[t] = function(t)
            if known[t] * at_right >= 0.0:
                crossed.append(t)
        return known[t]

    tolerance = _tolerance(left, right)
    found, low, high = _near(value, (left, right), (at_left, at_right), *expected, tolerance)
    if found is not None:
        return found
    brentq(value, low, high, xtol=tolerance, rtol=1e-14)
    return min(crossed)


def _root_from(
    function: Callable[[float], float], left: float, right: float, at_left: float, at_right: float, level: float
) -> float:
    """The same for a signal that is on its limit, which is inside, at one end; it may be held there for some time.

    The end itself, if the signal may have left it immediately: a power of the time up to the sixth is not
    distinguished from the limit before the root that is found.
    """
    leaves = at_left == 0.0
    beyond, low, high = at_right if leaves else at_left, left, right
    while high - low > _tolerance(left, right):
        middle = 0.5 * (low + high)
        if (function(middle) * beyond > 0.0) == leaves:
            high = middle
        else:
            low = middle
    part = (high - left if leaves else right - high) / (right - left)
    is_held = abs(beyond) * part**6 > 16.0 * np.finfo(float).eps * max(abs(level), abs(beyond))
    return high if is_held else left if leaves else right


def _tolerance(left: float, right: float) -> float:
    """Tolerance of a root in an interval of time [s]."""
    return 1e-12 * (right - left) + 1e-14 * max(abs(left), abs(right), right - left)


def _near(
    value: Callable[[float], float],
    ends: tuple[float, float],
    at_ends: tuple[float, float],
    t: float,
    slope: float,
    tolerance: float,
) -> tuple[float | None, float, float]:
    """Root by secants within a tolerance, on the side of the right end, and the ends of the interval that is left.

    The root is None if it is not found in a few steps. The first time and slope are expected ones. A step that leaves
    the interval is replaced by one to its chord, the second of two in succession by one to the right end, where the
    signal may jump.
    """
    (low, high), (at_low, at_high) = ends, at_ends
    side, before, at_before, is_chord = at_high, math.nan, math.nan, False
    for _ in range(_STEPS):
        if low < t < high and slope * side > 0.0:
            is_chord = False
        else:
            slope = (at_high - at_low) / (high - low)
            t = high - tolerance if is_chord else low - at_low / slope
            is_chord = not is_chord
            if not low < t < high:
                break
        found = value(t)
        if abs(t - before) > _APART * tolerance:
            slope = (found - at_before) / (t - before)
        before, at_before = t, found
        crossed = found * side >= 0.0
        if crossed:
            high, at_high = t, found
        else:
            low, at_low = t, found
            if high - low <= 1.5 * tolerance:
                return high, low, high
        change = found / slope if slope * side > 0.0 else math.inf
        if abs(change) > tolerance:
            t += 0.5 * tolerance - change  # probably on the side of the right end
        elif crossed:
            return t, low, high
        else:
            t += 2.0 * abs(change) + float(np.spacing(t))
    return None, low, high
