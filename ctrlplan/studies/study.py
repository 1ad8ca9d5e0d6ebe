"""A comparison with what a report says around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # comparisons and ensembles make studies of themselves for their pages
    from ctrlplan.planning import Fastest
    from ctrlplan.studies.comparison import Comparison
    from ctrlplan.studies.ensemble import Ensemble
    from ctrlplan.studies.grids import Grid
    from ctrlplan.studies.sweep import Sweep


@dataclass(frozen=True)
class Curves:
    """Curves over one variable, for a figure.

    Attributes
    ----------
    x_label, y_label : str
        Names with units.
    x : ndarray, shape (npoints,)
        The variable.
    rows : dict of str to ndarray
        Curves by name.
    caption : str
        What they show.
    log : bool
        Whether y is drawn in its logarithm.
    """

    x_label: str
    y_label: str
    x: NDArray[np.float64]
    rows: dict[str, NDArray[np.float64]]
    caption: str
    log: bool = False


@dataclass(frozen=True)
class Study:
    """One section of a report.

    Attributes
    ----------
    name : str
        Key in ``results.json``.
    title : str
        Heading.
    comparison : Comparison
        What was compared.
    summary : str
        What the study is, in a paragraph.
    notes : tuple of str
        Findings, one sentence or two each; where a claim fails they say so.
    sweep : Sweep or None
        Metrics over a parameter.
    ensemble : Ensemble or None
        Spread over draws of the loop's parameters.
    sweep_metrics : tuple of str
        Those that ``results.json`` keeps.
    figures : tuple of str
        Keys of `ctrlplan.reports.figures.FIGURES`, in order.
    curves : tuple of Curves
        What its own figures need besides.
    wall : ((float, float), (float, float)) or None
        An obstacle to draw: its sides in x and in z [m].
    claim : tuple of str
        What became of the claim that the trigonometric path is optimal.
    grids : tuple of Grid
        The numbers over alpha and duration that say so.
    fastest : Fastest or None
        A plan as fast as limits allow.
    """

    name: str
    title: str
    comparison: Comparison
    summary: str = ""
    notes: tuple[str, ...] = ()
    sweep: Sweep | None = None
    ensemble: Ensemble | None = None
    sweep_metrics: tuple[str, ...] = ("overshoot_error", "settling_time")
    figures: tuple[str, ...] = ("plans", "responses")
    curves: tuple[Curves, ...] = ()
    wall: tuple[tuple[float, float], tuple[float, float]] | None = None
    claim: tuple[str, ...] = ()
    grids: tuple[Grid, ...] = ()
    fastest: Fastest | None = None

    def results(self) -> dict[str, Any]:
        """Plain data for ``results.json``."""
        data = self.comparison.results()
        if self.sweep is not None:
            data["sweep"] = self.sweep.results(self.sweep_metrics)
        if self.ensemble is not None:
            data["draws"] = self.ensemble.results()
        return data
