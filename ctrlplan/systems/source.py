"""A plan as a block of a python-control loop."""

from __future__ import annotations

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_count
from ctrlplan._types import Params
from ctrlplan.traits import DeclaredTrait, declare
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.files import signal_names, signal_rows

Array = NDArray[np.float64]


class PlanSource(ct.NonlinearIOSystem):  # type: ignore[misc]
    """Block that puts out a plan and its derivatives; made by `create_source_iosystem`.

    Attributes
    ----------
    plan : Trajectory
        What is put out.
    derivatives : int
        Highest derivative put out.
    breakpoints : ndarray
        Times [s] at which the output or a derivative of it may jump: an
        integrator should stop there.
    """

    plan = DeclaredTrait[Trajectory]()
    derivatives = DeclaredTrait[int]()

    def __init__(self, plan: Trajectory, derivatives: int, name: str, suffix: str) -> None:
        labels = signal_names([label + suffix for label in plan.labels], derivatives)
        super().__init__(None, self._output, inputs=0, outputs=labels, dt=None, name=name)
        declare(self, plan=plan, derivatives=derivatives)

    @property
    def breakpoints(self) -> Array:
        """Breakpoints of the plan."""
        return np.asarray(self.plan.breakpoints)

    def _output(self, t: float, x: Array, u: Array, params: Params) -> Array:
        return self.plan.jet(t, self.derivatives).T.ravel()


def create_source_iosystem(
    plan: Trajectory, derivatives: int = 0, name: str = "plan", *, suffix: str = ""
) -> PlanSource:
    """Plan as an input/output system without inputs or states.

    Outputs are named axis by axis after the plan's labels: x, x_d1, x_d2, z,
    z_d1, ...; `control.interconnect` joins them by these names.

    Parameters
    ----------
    plan : Trajectory
        What is put out, at every time: held before its start and after its end.
    derivatives : int, optional
        Highest derivative put out beside the position.
    name : str, optional
        Name of the block.
    suffix : str, optional
        Put behind each label: ``suffix="_ref"`` gives x_ref, x_ref_d1, ...,
        where the plant has outputs x and z of its own.

    Returns
    -------
    PlanSource
        A `control.NonlinearIOSystem`, of any time base.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If `derivatives` is not a whole number from 0.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["r"])
    >>> driven = ct.interconnect(
    ...     [cp.create_source_iosystem(plan), cp.plants.integrator_lag_loop(5)], inputs=0, outputs=["y"]
    ... )
    >>> driven.output_labels
    ['y']
    """
    return PlanSource(_checked_plan(plan), checked_count(derivatives, "derivatives"), name, suffix)


def source_samples(plan: Trajectory, timepts: ArrayLike, derivatives: int = 0) -> Array:
    """Samples of a plan in the order of its source block's outputs.

    The input signal for `control.forced_response`, which takes it for linear
    between samples.

    Parameters
    ----------
    plan : Trajectory
        What is sampled.
    timepts : array_like, shape (ntime,)
        Times [s].
    derivatives : int, optional
        Highest derivative beside the position.

    Returns
    -------
    ndarray, shape (ntime,) for a single signal, (nsignals, ntime) for more
    """
    times = np.atleast_1d(np.asarray(timepts, dtype=float))
    samples = signal_rows(_checked_plan(plan), times, checked_count(derivatives, "derivatives"))
    return samples[0] if len(samples) == 1 else samples


def _checked_plan(plan: Trajectory) -> Trajectory:
    if not isinstance(plan, Trajectory):
        raise TypeError(f"plan must be a Trajectory, got {type(plan).__name__}")
    return plan
