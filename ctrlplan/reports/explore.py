"""Sliders for the shape, the times and the values of a plan, in Jupyter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctrlplan._checks import checked_finite
from ctrlplan._display import number
from ctrlplan._types import Array, Data
from ctrlplan.planning import plan_length
from ctrlplan.simulation import prepare
from ctrlplan.studies.experiment import Experiment
from ctrlplan.studies.measures import MEASURES, Measure, Run, leading_metrics
from ctrlplan.studies.plans import waypoints_given
from ctrlplan.studies.running import Builder, System, check_has_inputs, is_builder
from ctrlplan.trajectories import PolySpline, TrigSpline, Waypoint, derivative_name
from ctrlplan.trajectories.waypoint import ENTRIES

_SAMPLES = 401
"""Number of samples of a curve."""

_LONGER = 1.5
"""Simulated time, as a multiple of the duration of the plan."""

_HIGHEST = 6.25
"""Maximum alpha [rad], below 2 pi."""

_DERIVATIVES = 3
"""Highest derivative that is drawn."""


@dataclass(frozen=True)
class Slider:
    """A number that can be varied.

    Attributes
    ----------
    key : str
        Its name: "alpha", "gamma" (the distance from the mean), "time[1]" and
        "x[1]", "x_d1[1]", ... of waypoint 1.
    group : str
        Heading under which it is shown.
    low, high, value : float
        Range and initial value.
    """

    key: str
    group: str
    low: float
    high: float
    value: float


@dataclass(frozen=True)
class Panel:
    """One drawing, of curves over time or of a path in the plane.

    Attributes
    ----------
    title : str
        Label of the vertical axis.
    across : str
        Label of the horizontal axis.
    curves : tuple of (str, int, int)
        Name, and rows of horizontal and vertical values among the numbers.
    points : tuple of (float, float)
        Waypoints.
    equal : bool
        Whether both axes have one scale.
    """

    title: str
    across: str
    curves: tuple[tuple[str, int, int], ...]
    points: tuple[tuple[float, float], ...] = ()
    equal: bool = False


def explore(waypoints: Iterable[Waypoint], loop: System | Builder | None = None) -> Explorer:
    """Vary a trigonometric plan by sliders, in Jupyter.

    There are sliders for alpha, for gamma where the plan has one, and for the
    times and all prescribed values of the waypoints. The path, the derivatives,
    the response of the loop and the metrics follow.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Two or more; the first time and free entries are not varied.
    loop : control system or callable, optional
        Loop that follows the plan, as for `compare`. Its system is prepared
        once; a callable builds a loop for each plan, which takes longer.

    Returns
    -------
    Explorer
        Shown at the end of a cell. Its attributes plan, response, metrics and
        values are those of the present sliders.

    Raises
    ------
    ImportError
        If anywidget is not installed (extra ``notebook``).
    ValueError
        If no spline exists through the waypoints, or the loop does not fit.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)]
    >>> found = cp.explore(move, cp.plants.integrator_lag_loop(100))
    >>> found.set({"alpha": 2.0, "y[1]": 1.5}).plan.final
    array([1.5])
    """
    return Explorer(Exploration(waypoints, loop))


class Exploration:
    """A plan that depends on sliders, and what follows from it; `explore` shows it.

    Parameters
    ----------
    waypoints, loop
        As for `explore`.

    Attributes
    ----------
    sliders : tuple of Slider
        What can be varied.
    """

    def __init__(self, waypoints: Iterable[Waypoint], loop: System | Builder | None = None) -> None:
        points = PolySpline(waypoints_given(waypoints, "waypoints", "Waypoints"), warn=False)
        self.waypoints, self._labels = points.waypoints, points.labels
        places = np.array([w.position for w in points.waypoints])
        self._span = np.nanmax(places, axis=0) - np.nanmin(places, axis=0)
        self.sliders = tuple(self._sliders(TrigSpline(self.waypoints, alpha=1.0, labels=self._labels, warn=False)))
        self._loop = loop if loop is None or is_builder(loop) else prepare(check_has_inputs(loop))
        self._dt = None if is_builder(loop) else getattr(loop, "dt", None)

    def initial(self) -> dict[str, float]:
        """Initial values of the sliders by key."""
        return {slider.key: slider.value for slider in self.sliders}

    def checked(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values by key, each that of a slider and finite; those that are not given are initial."""
        found = self.initial()
        for key, value in values.items():
            if key not in found:
                raise ValueError(f"values must be of sliders, {', '.join(found)}, got {key!r}")
            found[key] = checked_finite(value, key)
        return found

    def plan(self, values: Mapping[str, float]) -> TrigSpline:
        """Plan of values of the sliders; ValueError if there is none."""
        points = [self._waypoint(i, point, values) for i, point in enumerate(self.waypoints)]
        plan = TrigSpline(points, alpha=values["alpha"], labels=self._labels, warn=False)
        away = values.get("gamma", 0.0)
        if not away:
            return plan
        gamma = [None if mean is None else mean + away for mean in plan.gamma]
        return TrigSpline(points, alpha=values["alpha"], gamma=gamma, labels=self._labels, warn=False)

    def run(self, plan: TrigSpline) -> tuple[Run | None, dict[str, float], dict[str, Measure]]:
        """Response of the loop with metrics; without a loop, metrics of the plan."""
        if self._loop is None:
            measures = {
                "duration": Measure("Duration", "s"),
                "path_length": Measure("Path length"),
                **{name: Measure(f"Peak {name}") for name in ENTRIES[1 : _DERIVATIVES + 1]},
            }
            peaks = [float(plan.peak(nu).max()) for nu in range(1, _DERIVATIVES + 1)]
            return None, dict(zip(measures, [plan.duration, plan_length(plan), *peaks], strict=True)), measures
        experiment = Experiment({"plan": plan}, self._times(plan), waypoints=plan.waypoints)
        run, metrics = experiment.run_plan(self._loop, "plan")
        return run, metrics, MEASURES

    def scene(self, plan: TrigSpline, run: Run | None) -> tuple[list[Panel], Array]:
        """Drawings, and the numbers of their curves, shape (nrows, nsamples)."""
        end = plan.end if run is None else float(run.t[-1])
        t = np.linspace(plan.start, end, _SAMPLES)
        jet = plan.jet(t, _DERIVATIVES)
        rows = [t, *jet.reshape(-1, t.size)]
        naxes = plan.naxes
        followed, acting = ((), ()) if run is None else (run.outputs[:naxes], run.controls)
        place = {name: len(rows) + i for i, name in enumerate(dict.fromkeys((*followed, *acting)))}
        if run is not None:
            rows += [np.interp(t, run.t, run.signals[name]) for name in place]
        panels = []
        if naxes == 2:
            curves = [("plan", 1, 2)]
            curves += [("response", place[followed[0]], place[followed[1]])] if len(followed) == 2 else []
            places = [w.position.tolist() for w in plan.waypoints if np.isfinite(w.position).all()]
            points = tuple((x, z) for x, z in places)
            panels.append(Panel(plan.labels[1], plan.labels[0], tuple(curves), points, equal=True))
        for nu in range(_DERIVATIVES + 1):
            name = ENTRIES[nu]
            own = tuple((derivative_name(label, nu), 0, 1 + nu * naxes + k) for k, label in enumerate(plan.labels))
            if nu == 0:
                own += tuple((f"response {label}", 0, place[label]) for label in followed)
            points = tuple(
                (w.time, float(v)) for w in plan.waypoints for v in w.jet[nu : nu + 1].ravel() if not np.isnan(v)
            )
            panels.append(Panel(name, "time [s]", own, points))
        if acting:
            panels.append(Panel("control", "time [s]", tuple((name, 0, place[name]) for name in acting)))
        return panels, np.array(rows)

    def _times(self, plan: TrigSpline) -> Array:
        """Sample times of the loop, with those of the waypoints, or multiples of the period of a discrete loop."""
        end = plan.start + _LONGER * plan.duration
        if self._dt:
            period = 1.0 if self._dt is True else float(self._dt)
            return np.asarray(plan.start + period * np.arange(int((end - plan.start) / period) + 2))
        return np.union1d(np.linspace(plan.start, end, _SAMPLES), [w.time for w in plan.waypoints])

    def _waypoint(self, i: int, point: Waypoint, values: Mapping[str, float]) -> Waypoint:
        jet = point.jet.copy()
        for (nu, k), key in self._keys(i, point):
            jet[nu, k] = values[key]
        return Waypoint.from_array(values.get(f"time[{i}]", point.time), jet, self._labels)

    def _keys(self, i: int, point: Waypoint) -> Iterator[tuple[tuple[int, int], str]]:
        """Prescribed entries of a waypoint: place in its jet, and key."""
        for k, label in enumerate(self._labels):
            for nu in np.flatnonzero(np.isfinite(point.jet[:, k])).tolist():
                yield (nu, k), f"{derivative_name(label, nu)}[{i}]"

    def _sliders(self, plan: TrigSpline) -> Iterator[Slider]:
        yield Slider("alpha", "shape", 0.0, _HIGHEST, 1.0)
        if any(mean is not None for mean in plan.gamma):
            # Singular where order times distance is an odd multiple of pi/2.
            reach = 0.9 * math.pi / (2 * max(plan.degree))
            yield Slider("gamma", "shape", -reach, reach, 0.0)
        times = [w.time for w in self.waypoints]
        for i, point in enumerate(self.waypoints):
            group = f"waypoint {i}"
            if i:
                low = times[i - 1] + 0.05 * (times[i] - times[i - 1])
                last = i + 1 == len(times)
                high = 2 * times[i] - times[0] if last else times[i + 1] - 0.05 * (times[i + 1] - times[i])
                yield Slider(f"time[{i}]", group, low, high, times[i])
            for (nu, k), key in self._keys(i, point):
                value = float(point.jet[nu, k])
                unit = (float(self._span[k]) or 1.0) / plan.duration**nu
                reach = max(unit * (1.0 if nu == 0 else 4.0), 2.0 * abs(value) if nu else 0.0)
                yield Slider(key, group, value - reach, value + reach, value)


class Explorer:
    """Sliders with the plan, the response and the metrics that follow from them; returned by `explore`.

    Parameters
    ----------
    exploration : Exploration
        What is explored.

    Attributes
    ----------
    widget : anywidget.AnyWidget
        The widget; its trait `values` has the values of the sliders by key, and
        `scene`, `numbers`, `table` and `error` what is drawn.
    """

    def __init__(self, exploration: Exploration) -> None:
        try:
            import anywidget
            import traitlets
        except ImportError:
            raise ImportError('explore requires anywidget; install it with pip install "ctrlplan[notebook]"') from None
        self._exploration = exploration
        self._plan: TrigSpline
        self._run: Run | None = None
        self._metrics: dict[str, float] = {}
        synced: dict[str, Any] = {
            "sliders": traitlets.List([asdict(slider) for slider in exploration.sliders]),
            "values": traitlets.Dict(exploration.initial()),
            "scene": traitlets.List([]),
            "numbers": traitlets.Bytes(b""),
            "table": traitlets.List([]),
            "error": traitlets.Unicode(""),
            "length": traitlets.Int(_SAMPLES),
            "count": traitlets.Int(0),
        }
        self.widget = anywidget.AnyWidget()
        self.widget.add_traits(
            _esm=traitlets.Unicode(Path(__file__).with_name("templates").joinpath("explore.js").read_text("utf-8")).tag(
                sync=True
            ),
            **{name: trait.tag(sync=True) for name, trait in synced.items()},
        )
        self._update(exploration.initial())
        if self.widget.error:
            raise ValueError(self.widget.error)
        self.widget.observe(lambda change: self._update(change["new"]), "values")

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    @property
    def values(self) -> dict[str, float]:
        """Present values of the sliders by key."""
        return dict(self.widget.values)

    def set(self, values: Mapping[str, float]) -> Explorer:
        """Set sliders by key, also beyond their ranges; the others are unchanged.

        Raises
        ------
        ValueError
            If a key is unknown or a value is not finite.
        """
        self.widget.values = self._exploration.checked({**self.values, **values})
        return self

    @property
    def plan(self) -> TrigSpline:
        """Plan of the present sliders; ValueError if there is none, as for the other attributes."""
        self._check()
        return self._plan

    @property
    def waypoints(self) -> tuple[Waypoint, ...]:
        """Waypoints of the plan."""
        return self.plan.waypoints

    @property
    def response(self) -> Any:
        """Response of the loop, as of `simulate`; None without a loop."""
        self._check()
        return None if self._run is None else self._run.response

    @property
    def metrics(self) -> dict[str, float]:
        """Metrics by name: of the response, or of the plan without a loop."""
        self._check()
        return dict(self._metrics)

    def _check(self) -> None:
        if self.widget.error:
            raise ValueError(self.widget.error)

    def _update(self, values: Mapping[str, float]) -> None:
        """Draw the plan of values of the sliders; an error is shown in its place."""
        shown: Data = {"count": self.widget.count + 1, "error": ""}
        try:
            plan = self._exploration.plan(self._exploration.checked(values))
            run, metrics, measures = self._exploration.run(plan)
            panels, numbers = self._exploration.scene(plan, run)
        except (ValueError, TypeError, RuntimeError, ArithmeticError) as error:
            shown["error"] = str(error)
        else:
            self._plan, self._run, self._metrics = plan, run, metrics
            known = {name: measures[name] for name in metrics if name in measures}  # not those of each axis
            rows = leading_metrics(known, lambda name, measure: _cells(measure, metrics[name]))
            shown |= {
                "scene": [asdict(panel) for panel in panels],
                "numbers": _float32(numbers),
                "table": [[title, value, unit] for title, unit, value in rows.values()],
            }
        with self.widget.hold_sync():
            for name, value in shown.items():
                setattr(self.widget, name, value)


def _float32(numbers: Array) -> bytes:
    """Numbers for the drawing, little-endian; those beyond its range become infinite, and are not drawn."""
    with np.errstate(over="ignore"):
        return numbers.astype("<f4").tobytes()


def _cells(measure: Measure, value: float) -> list[str]:
    """Unit of a metric where it is known, and its value."""
    unit = "" if "{" in measure.unit else measure.unit
    return [unit, "n/a" if math.isnan(value) else number(value, unit)]
