"""Optimisation of the shape parameter alpha over its whole range."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ctrlplan._display import Displayed, Facts, Figure, Part, number, title_of
from ctrlplan.planning.objectives import (
    Objective,
    ObjectiveName,
    SquaredDerivative,
    checked_objective,
    declared_size,
    objective_values,
)
from ctrlplan.planning.scalar_search import bisected, scan
from ctrlplan.trajectories import Trajectory, TrigSpline, Waypoint
from ctrlplan.trajectories.common import Array, readonly
from ctrlplan.trajectories.newton_spline import given_entries
from ctrlplan.trajectories.waypoint_spline import checked_waypoints

if TYPE_CHECKING:
    from control import ControlPlot

    from ctrlplan.reports.style import AxesLike

_TIE = 1e-9
_BLOWN = 10.0


@dataclass(frozen=True, repr=False)
class AlphaChoice(Displayed):
    """Optimum shape parameter, and the objective over alpha.

    ``float(choice)`` is alpha, so a choice can be passed as the argument `alpha`
    of a spline.

    Attributes
    ----------
    alpha : float
        Shape parameter [rad] that minimises the objective.
    value : float
        Minimum of the objective.
    plan : Trajectory
        Plan with this alpha.
    alphas, values : ndarray, shape (npoints,)
        Values of alpha, increasing, and the objective there; inf where the
        waypoints do not determine a plan.
    blow_up : float
        Alpha [rad] above which the objective always exceeds ten times its
        minimum; 2 pi if there is none.
    tied : bool
        Whether the minimum is not unique, so that the integral of the squared
        jerk determined alpha.
    objective : str
        Name of the objective.
    """

    alpha: float
    value: float
    plan: Trajectory
    alphas: Array = field(compare=False)
    values: Array = field(compare=False)
    blow_up: float
    tied: bool
    objective: str

    def __float__(self) -> float:
        return self.alpha

    def _describe(self) -> Iterator[Part]:
        objective = self.objective.replace("_", " ")
        yield f"Optimal alpha = {self.alpha:.6g} rad: {objective} {self.value:.6g}"
        yield Facts(
            [
                ("alpha", f"{self.alpha:.6g} rad"),
                ("objective", f"{objective}, {self.value:.6g}"),
                ("at alpha = 0 (polynomial)", number(float(self.values[0]))),
                (
                    "above ten times the minimum from alpha =",
                    f"{number(self.blow_up)} rad" if self.blow_up < 2.0 * math.pi else "",
                ),
                ("decided by", "integral of the squared jerk, at equal objective" if self.tied else ""),
                ("plan", title_of(self.plan)),
            ]
        )
        yield Figure("Position and velocity of the plan over time.", 2, lambda axes: self.plan.plot(ax=axes))

    def plot(self, *, ax: AxesLike | None = None) -> ControlPlot:
        """Plot the objective over alpha up to `blow_up`, with the optimum.

        Parameters
        ----------
        ax : Axes, optional
            Axes to plot in; default: the current figure if it is empty,
            otherwise a new one.

        Returns
        -------
        control.ControlPlot
            Of shape (1, 1).
        """
        from ctrlplan.reports.planning_figures import plot_alpha_choice

        return plot_alpha_choice(self, ax=ax)


def choose_alpha(
    waypoints: Iterable[Waypoint],
    objective: ObjectiveName | Objective = "path",
    *,
    family: Callable[..., Trajectory] = TrigSpline,
    **options: Any,
) -> AlphaChoice:
    """Shape parameter that minimises an objective over [0, 2 pi).

    The objective is evaluated on a grid, which is finer for more constraints, and
    every local minimum that may be the global one is refined. If the minimum is
    not unique (the path length of a straight move does not depend on alpha), the
    integral of the squared jerk is minimised among the minimisers.

    Parameters
    ----------
    waypoints : iterable of Waypoint
        Prescribed positions and derivatives.
    objective : str or callable, optional
        Objective to be minimised: "path" (length), "wandering" (excess path
        length relative to the waypoint polyline), "peak_velocity",
        "peak_acceleration", "peak_jerk", "peak_snap", "squared_velocity", ...,
        "squared_snap", an objective such as ``PeakDerivative(5)``, or any
        function of a plan that returns a number. Axes must have the same unit.
    family : callable, optional
        Class of the plan, with an argument `alpha`: `TrigSpline` or
        `PiecewiseSpline`.
    **options
        Further arguments of the family: gamma, degree, labels, ...

    Returns
    -------
    AlphaChoice
        With the attributes alpha, value (of the objective), plan, alphas and
        values (the objective over alpha), blow_up, tied and objective (its name).

    Raises
    ------
    ValueError
        If there is no plan for any alpha, or the objective returns nan.

    Examples
    --------
    The minimum peak jerk of a unit move, which is 60 for the polynomial:

    >>> import ctrlplan as cp
    >>> found = cp.choose_alpha([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], "peak_jerk")
    >>> round(found.alpha, 2), round(found.value, 2)
    (1.98, 39.39)
    """
    points = checked_waypoints(waypoints)
    goal = checked_objective(objective)
    if not callable(family):
        raise TypeError(f"family must be TrigSpline, PiecewiseSpline or a function like them, got {family!r}")

    # Candidates swing where alpha is too large: only the optimum may warn.
    quiet = options | {"warn": False} if _can_be_quiet(family) else options

    def plan_of(alpha: float) -> Trajectory:
        return family(points, alpha=alpha, **quiet)

    search = _Search(plan_of, goal)
    grid = _grid(points)
    alphas, values = scan(search, grid, values=search.values(grid))
    best = float(values.min())
    if math.isinf(best):
        raise search.rejection or ValueError("objective must be finite for some alpha, got inf for all of [0, 2 pi)")
    declared = declared_size(goal)
    scale = abs(best) if declared is None else declared
    level = best + _TIE * scale
    tied = np.flatnonzero(values <= level)
    # A single minimum ties one grid point; a plateau, or several equal minima, tie points further apart.
    flat = bool(np.ptp(alphas[tied]) > 0.5 * np.diff(alphas).max())
    if flat:
        alpha, value = _smoothest(search, plan_of, alphas, tied, level)
    else:
        alpha, value = float(alphas[tied[0]]), best
    return AlphaChoice(
        alpha=alpha,
        value=value,
        plan=family(points, alpha=alpha, **options),
        alphas=readonly(alphas),
        values=readonly(values),
        blow_up=_blow_up(alphas, values, best + (_BLOWN - 1.0) * scale),
        tied=flat,
        objective=objective if isinstance(objective, str) else str(getattr(objective, "__name__", objective)),
    )


def _can_be_quiet(family: Callable[..., Trajectory]) -> bool:
    """Whether a family has an argument `warn`."""
    try:
        return "warn" in inspect.signature(family).parameters
    except ValueError:  # a compiled function without a signature
        return False


class _Search:
    """Objective as a function of alpha; inf where there is no plan."""

    def __init__(self, plan_of: Callable[[float], Trajectory], goal: Objective) -> None:
        self._plan_of, self._goal = plan_of, goal
        self.rejection: ValueError | None = None

    def __call__(self, alpha: float) -> float:
        return self.values(np.array([alpha])).item()

    def values(self, alphas: Array) -> Array:
        """Values at several alphas."""
        found = np.full(alphas.size, math.inf)
        plans, places = [], []
        for k, alpha in enumerate(alphas.tolist()):
            try:
                plans.append(self._plan_of(alpha))
            except ValueError as rejection:  # with free entries the system may be singular at some alphas
                self.rejection = self.rejection or rejection
            else:
                places.append(k)
        for k, value in zip(places, objective_values(self._goal, plans), strict=True):
            if np.ndim(value) or not isinstance(value, Real | np.ndarray):
                raise TypeError(f"objective must return a number, got {value!r:.60} at alpha = {alphas[k]:.6g}")
            if not float(value) > -math.inf:
                raise ValueError(f"objective must return a number above -inf, got {value} at alpha = {alphas[k]:.6g}")
            found[k] = float(value)
        return found


def _grid(points: tuple[Waypoint, ...]) -> Array:
    """Grid from 0 to just below 2 pi that resolves the highest harmonic."""
    _, patterns = given_entries(points)
    count = max(sum(map(len, pattern)) for pattern in patterns)
    return np.linspace(0.0, 2.0 * math.pi * 0.995, 33 + 3 * count)


def _smoothest(
    search: Callable[[float], float],
    plan_of: Callable[[float], Trajectory],
    alphas: Array,
    tied: NDArray[np.intp],
    level: float,
) -> tuple[float, float]:
    """Minimiser of the integral of the squared jerk among the minimisers of the objective."""
    jerk = _Search(plan_of, SquaredDerivative(3))
    costs = np.array([jerk(alpha) for alpha in alphas[tied].tolist()])
    # The first of equal values: the polynomial, if it is among them.
    k = int(tied[int(np.argmax(costs <= costs.min() * (1.0 + 1e-12)))])
    here = float(alphas[k])
    low, high = (
        _level_edge(search, here, float(alphas[k + step]), level) if 0 <= k + step < alphas.size else here
        for step in (-1, 1)
    )
    if low < high:
        found = minimize_scalar(jerk, bounds=(low, high), method="bounded", options={"xatol": 1e-8})
        if found.fun < costs.min() * (1.0 - 1e-12):
            here = float(found.x)
    return here, search(here)


def _level_edge(search: Callable[[float], float], inside: float, outside: float, level: float) -> float:
    """Limit, towards a neighbour, of the interval in which the objective is at its minimum."""
    if search(outside) <= level:
        return outside
    return bisected(lambda alpha: search(alpha) <= level, inside, outside, 1e-9)[0]


def _blow_up(alphas: Array, values: Array, bound: float) -> float:
    """Alpha above which the objective always exceeds a bound."""
    last = int(np.flatnonzero(values <= bound)[-1])
    return float(alphas[last + 1]) if last + 1 < alphas.size else 2.0 * math.pi
