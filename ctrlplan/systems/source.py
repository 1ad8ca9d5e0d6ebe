"""Plan as a block of a python-control interconnection."""

from __future__ import annotations

import math
from collections.abc import Sequence

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import check_kind, checked_count, checked_labels
from ctrlplan._renamed import former_signature
from ctrlplan._types import Array, Params
from ctrlplan.traits import DeclaredTrait, declare
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.files import signal_names, signal_rows


class PlanSource(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Source of a plan; made by `create_source_iosystem`.

    Attributes
    ----------
    plan : Trajectory
        The plan.
    derivatives : int
        Highest derivative among the outputs.
    breakpoints : ndarray
        Times [s] at which an output or one of its derivatives may jump, where an
        integrator should stop.
    """

    plan = DeclaredTrait[Trajectory]()
    derivatives = DeclaredTrait[int]()

    def __init__(self, plan: Trajectory, derivatives: int, name: str, axes: Sequence[str]) -> None:
        outputs = signal_names(axes, derivatives)
        super().__init__(None, self._output, inputs=0, outputs=outputs, dt=None, name=name)
        declare(self, plan=plan, derivatives=derivatives)

    @property
    def breakpoints(self) -> Array:
        """Breakpoints of the plan."""
        return np.asarray(self.plan.breakpoints)

    def _output(self, t: float, x: Array, u: Array, params: Params) -> Array:
        return self.plan.jet(t, self.derivatives).T.ravel()


@former_signature("name")
def create_source_iosystem(
    plan: Trajectory,
    derivatives: int = 0,
    *,
    labels: Sequence[str] | str | None = None,
    suffix: str = "",
    name: str = "plan",
) -> PlanSource:
    """Source of a plan and its derivatives.

    No states. No inputs. Outputs: the position of each axis and its
    derivatives, x, x_d1, x_d2, z, z_d1, ... for a plan with the labels x and z
    (y for a plan without labels). `control.interconnect` connects them by name.

    Parameters
    ----------
    plan : Trajectory
        The plan; constant before its start and after its end.
    derivatives : int, optional
        Highest derivative among the outputs; derivative nu has the unit of the
        plan over s^nu.
    labels : sequence of str or str, optional
        Names of the axes in place of those of the plan.
    suffix : str, optional
        Appended to each label: ``suffix="_ref"`` gives x_ref, x_ref_d1, ..., for
        a plant with outputs x and z.
    name : str, optional
        Name of the block.

    Returns
    -------
    PlanSource
        A `control.NonlinearIOSystem`, of any time base.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If `derivatives` is not a non-negative integer, or the number of labels
        differs from the number of axes.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> source = cp.create_source_iosystem(plan, labels="r")
    >>> loop = ct.interconnect([source, cp.plants.integrator_lag_loop(5)], inputs=0, outputs=["y", "r"])
    >>> cp.simulate(loop, [0.0, 0.5, 1.0]).outputs[1].tolist()
    [0.0, 0.5, 1.0]
    """
    check_kind(plan, "plan", Trajectory)
    return PlanSource(plan, checked_count(derivatives, "derivatives"), name, axis_signals(plan, labels, suffix))


def axis_signals(plan: Trajectory, labels: Sequence[str] | str | None, suffix: str) -> tuple[str, ...]:
    """Signal name of each axis: its label, or the one given instead, with the suffix."""
    own = plan.labels if labels is None else checked_labels(labels, plan.naxes)
    return tuple(label + suffix for label in own)


def switches_of(plan: Trajectory) -> dict[str, object]:
    """Traits of a block that is a function of a plan: its breakpoints.

    Those of a plan that repeats for all future times are declared for the first pass,
    and steps are short enough to find all others.
    """
    if math.isfinite(plan.end):
        return {"breakpoints": plan.breakpoints}
    return {"breakpoints": plan.breakpoints, "longest": 0.5 * float(np.diff(plan.breakpoints).min())}


def source_samples(plan: Trajectory, timepts: ArrayLike, derivatives: int = 0) -> Array:
    """Samples of a plan in the order of the outputs of its source.

    They can be used as input of `control.forced_response`, which interpolates
    linearly between samples.

    Parameters
    ----------
    plan : Trajectory
        The plan.
    timepts : array_like, shape (ntime,)
        Times [s].
    derivatives : int, optional
        Highest derivative in addition to the position.

    Returns
    -------
    ndarray, shape (ntime,) for a single signal, otherwise (nsignals, ntime)
    """
    check_kind(plan, "plan", Trajectory)
    times = np.atleast_1d(np.asarray(timepts, dtype=float))
    samples = signal_rows(plan, times, checked_count(derivatives, "derivatives"))
    return samples[0] if len(samples) == 1 else samples
