"""Sections of a study: contents of its page in addition to the metrics, as data.

Each section is a small frozen class, which `ctrlplan.reports.draw` draws
according to its type.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # comparisons and ensembles make studies of themselves for their pages
    import control as ct

    from ctrlplan.planning import Fastest, Margins, Obstacle
    from ctrlplan.studies.ensemble import Ensemble
    from ctrlplan.studies.grids import Grid
    from ctrlplan.studies.sweep import Sweep
    from ctrlplan.systems import FeedforwardFit

Wall: TypeAlias = tuple[tuple[float, float], tuple[float, float]] | None
"""Obstacle of a crane: limits in x and in z (down) [m]; None for no obstacle."""

Place: TypeAlias = tuple[float, float]
"""Offset of a label from its point, right and up [pt]."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Section of a study; a new type is a subclass and a function that draws it.

    Attributes
    ----------
    caption : str
        Caption of its figure, in place of the default of its type.

    Examples
    --------
    A section with a figure and a table of its own:

    >>> from dataclasses import dataclass
    >>> import ctrlplan as cp
    >>> from ctrlplan.reports import Part, Picture, Table, draw
    >>> from ctrlplan.studies import Study
    >>> from ctrlplan.studies.sections import Section
    >>> @dataclass(frozen=True)
    ... class Durations(Section):
    ...     longest: float
    >>> @draw.register
    ... def _(section: Durations, study: Study) -> Part:
    ...     plan = next(iter(study.comparison.plans.values()))
    ...     rows = [[name, f"{plan.duration:g}"] for name, plan in study.comparison.plans.items()]
    ...     picture = Picture("plan", plan.plot(), section.caption or "The first plan.")
    ...     table = Table(["plan", f"duration, at most {section.longest:g} [s]"], rows)
    ...     return Part([picture, table], heading="Durations")

    It stands in ``Study(..., sections=(Durations(2.0),))`` as any other.
    """

    caption: str = ""

    def results(self) -> dict[str, object]:
        """Plain data for ``results.json``, by key; empty by default."""
        return {}


# Comparisons


@dataclass(frozen=True)
class PlanCurves(Section):
    """References of the comparison and their derivatives.

    Attributes
    ----------
    derivatives : int
        Highest derivative.
    """

    derivatives: int = 2


@dataclass(frozen=True)
class Responses(Section):
    """Output, error and control of each plan of the comparison."""


@dataclass(frozen=True)
class Paths(Section):
    """Paths of plans with two axes in their plane.

    Attributes
    ----------
    obstacles : tuple of Obstacle
        What the plans must keep clear of.
    """

    obstacles: tuple[Obstacle, ...] = ()


@dataclass(frozen=True)
class Curves(Section):
    """Curves over one variable.

    Attributes
    ----------
    x_label, y_label : str
        Names with units.
    x : ndarray, shape (npoints,)
        The variable.
    rows : dict of str to ndarray
        Curves by name.
    log : bool
        Whether the y axis is logarithmic.
    paired : bool
        Whether consecutive curves form pairs, drawn in one colour.
    key : str
        Id of the figure on the page.
    """

    x_label: str
    y_label: str
    x: NDArray[np.float64]
    rows: Mapping[str, NDArray[np.float64]]
    log: bool = False
    paired: bool = False
    key: str = "curves"


@dataclass(frozen=True)
class FittedGains(Section):
    """Feedforward fitted to the logs of measured runs.

    Attributes
    ----------
    fits : dict of str to FeedforwardFit
        Fits by the name of the measured run.
    """

    fits: Mapping[str, FeedforwardFit]

    def results(self) -> dict[str, object]:
        """Gains, their intervals and the delay of each fit."""
        return {"feedforward": {name: fit.results() for name, fit in self.fits.items()}}


# Sweeps and draws


@dataclass(frozen=True)
class Plane(Section):
    """Settling time versus overshoot on the tracking error, one point per value of a sweep.

    Attributes
    ----------
    sweep : Sweep
        With both metrics.
    numbered : dict of str to dict of float to (float, float)
        Plan, value of the parameter, offset: values that are written next to
        their points.
    limit : (float, float) or None
        Settling time [s] and overshoot [%] of a limit point to mark.
    limit_label : str
            What the limit point is.
    further : dict of str to (float, float)
        Further points to be marked, by what they are.
    """

    sweep: Sweep
    numbered: Mapping[str, Mapping[float, Place]] = field(default_factory=dict)
    limit: tuple[float, float] | None = None
    limit_label: str = "limit"
    further: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def results(self) -> dict[str, object]:
        """The two metrics over the parameter."""
        return {"sweep": self.sweep.results(("overshoot_error", "settling_time"))}


@dataclass(frozen=True)
class SweepCurves(Section):
    """Metrics versus the parameter of a sweep.

    Attributes
    ----------
    sweep : Sweep
        With these metrics.
    metrics : tuple of str
        Names of the metrics.
    in_results : tuple of str or None
        Metrics that are written to ``results.json``; all, unless given.
    """

    sweep: Sweep
    metrics: tuple[str, ...] = ("settling_time", "overshoot_error")
    in_results: tuple[str, ...] | None = None

    def results(self) -> dict[str, object]:
        """The metrics of `in_results`, over the parameter."""
        names = self.metrics if self.in_results is None else self.in_results
        return {"sweep": self.sweep.results(names)} if names else {}


@dataclass(frozen=True)
class Bands(Section):
    """Quantiles of signals over draws.

    Attributes
    ----------
    ensemble : Ensemble
        The draws.
    """

    ensemble: Ensemble


@dataclass(frozen=True)
class DrawTable(Section):
    """Quantiles of metrics over draws; the nominal loop is that of the study.

    Attributes
    ----------
    ensemble : Ensemble
        The draws.
    """

    ensemble: Ensemble

    def results(self) -> dict[str, object]:
        """Draws, metrics and failures."""
        return {"draws": self.ensemble.results()}


# Planning


@dataclass(frozen=True)
class FastestMove(Section):
    """A plan of minimum duration within limits.

    Attributes
    ----------
    fastest : Fastest
        The plan, and its margins.
    """

    fastest: Fastest


@dataclass(frozen=True)
class PlanMargins(Section):
    """Margins of plans to their limits.

    Attributes
    ----------
    margins : dict of str to Margins
        By plan.
    """

    margins: Mapping[str, Margins]

    def results(self) -> dict[str, object]:
        """Value nearest to each limit, its time and the margin, by plan and limit."""
        rows = {
            plan: {row.bound.name: {"value": row.value, "time": row.time, "margin": row.fraction} for row in margins}
            for plan, margins in self.margins.items()
        }
        return {"limits": rows}


@dataclass(frozen=True)
class ClaimTable(Section):
    """Check whether the trigonometric path is optimal.

    Attributes
    ----------
    claim : tuple of str
        Findings, one sentence or more each.
    grids : tuple of Grid
        Metrics over alpha and duration.
    """

    claim: tuple[str, ...]
    grids: tuple[Grid, ...]


# Cranes and loops


@dataclass(frozen=True)
class CraneSketch(Section):
    """A crane and its variables."""


@dataclass(frozen=True)
class LoopBlocks(Section):
    """Blocks and connections of a loop.

    Attributes
    ----------
    loop : control.InterconnectedSystem
        The loop.
    titles : dict of str to str
        Titles in place of the names of blocks.
    """

    loop: ct.InterconnectedSystem
    titles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CraneTime(Section):
    """Load, tracking error, sway and controls of cranes versus time."""


@dataclass(frozen=True)
class CraneStep(Section):
    """Controls, rope tension and sway of a crane for a step, with the limits of its loop."""


@dataclass(frozen=True)
class CraneOnline(Section):
    """Load, distance from the goal, sway and force of cranes versus time."""


@dataclass(frozen=True)
class CraneScene(Section):
    """Section that shows cranes in the plane.

    Attributes
    ----------
    wall : ((float, float), (float, float)) or None
        Obstacle to draw.
    """

    wall: Wall = None


@dataclass(frozen=True)
class CranePaths(CraneScene):
    """Paths of the load in the plane."""


@dataclass(frozen=True)
class CraneMotion(CraneScene):
    """Trolley, rope and load at equal time intervals."""


@dataclass(frozen=True)
class AnimatedCrane(CraneScene):
    """Animation of trolley, rope and load.

    Attributes
    ----------
    shown : str
        Plan shown first; unless given, the first trigonometric plan, or else
        the first plan that is not a step.
    """

    signals: ClassVar[tuple[str, ...]] = ("x", "z", "D", "R", "theta")
    """Required outputs of the loops: load, trolley, length and angle of the rope."""

    shown: str = ""
