"""Signals of a loop along a plan, for limits: the loop starts at rest at the first position of the plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from ctrlplan._checks import check_kind, checked_finite
from ctrlplan._types import Array, System
from ctrlplan.simulation.equilibrium import linear_equilibrium
from ctrlplan.simulation.exact_response import ExactResponse, Motion
from ctrlplan.simulation.linear import LinearForm
from ctrlplan.simulation.loop_form import LoopForm, Rows
from ctrlplan.simulation.loop_inputs import Fed, fed_signals, same_axis, tracked
from ctrlplan.simulation.loop_response import LoopResponse, LoopSignals
from ctrlplan.simulation.plan_cells import PlanCells
from ctrlplan.simulation.prepared import Prepared, prepared_form
from ctrlplan.simulation.sampled_response import SampledQuantities, has_exact_signals
from ctrlplan.simulation.shape_family import LoopSignal, ShapeFamily
from ctrlplan.simulation.simulated_response import SimulatedQuantities
from ctrlplan.trajectories import Trajectory


class LoopQuantities(LoopSignals):
    """Signals of a loop along a plan; returned by `loop_quantities`.

    Attributes
    ----------
    name : str
        Name of the loop.
    names : tuple of str
        Names of its signals: outputs, then inputs that have other names.
    inputs : tuple of str
        Names of its inputs in order.
    """

    kind, note = "exact", "exact, at all times"

    def __init__(self, loop: System | Prepared) -> None:
        super().__init__(prepared_form(loop))
        if self._prepared.linear is None:
            raise TypeError(
                f"loop must be linear and continuous, got {self._prepared.name}, where {self._prepared.not_linear}"
            )
        self._linear: LinearForm = self._prepared.linear
        self._forms: dict[tuple[Fed | None, ...], LoopForm] = {}

    def quantities_of(self, plan: Trajectory, *, refined: bool = True) -> LoopResponse:
        """Response of the loop to a plan.

        The loop starts at rest at the first position of the plan.

        Parameters
        ----------
        plan : Trajectory
            Plan with a duration.
        refined : bool, optional
            No effect: extrema are exact.

        Returns
        -------
        LoopResponse
            With the methods ``extremes`` and ``rms``.

        Raises
        ------
        ValueError
            If the plan does not fit the inputs of the loop; if the loop is unstable
            or has no equilibrium at the first position of the plan; if an
            integrator drifts after the plan.
        """
        return self.along(plan).response(plan)

    def shapes_of(
        self, plan: Trajectory, signals: Sequence[tuple[Mapping[str, float], bool, tuple[float, float] | None]]
    ) -> ShapeFamily:
        """Signals along plans of the shape of one, as functions of the duration.

        Parameters
        ----------
        plan : Trajectory
            Plan with a duration.
        signals : sequence of (mapping of str to float, bool, (float, float) or None)
            Weighted sums of signals by name, whether their time derivatives are
            meant, and the part of the plan as fractions of its duration.
        """
        along = self.along(plan)
        chosen = [LoopSignal(*one) for one in signals]
        return ShapeFamily(along.form, along.signals, along.cells, along.start, chosen)

    def along(self, plan: Trajectory) -> AlongPlan:
        """The loop with the inputs connected to a plan, for this plan and others of the same axes."""
        check_kind(plan, "plan", Trajectory)
        fed = fed_signals(self._prepared.input_labels, plan, self.name)
        fed += _fed_by_sources(self._linear, plan, self.name)
        order = max((k for entry in fed if entry for k in entry[1:]), default=0)
        pick = np.zeros((order + 1, self._linear.b.shape[1], plan.naxes))
        for column, entry in enumerate(fed):
            if entry is not None:
                pick[entry[1], column, entry[0]] = 1.0
        form = self._forms.get(tuple(fed))
        if form is None:
            form = self._forms[tuple(fed)] = LoopForm(self._linear.a, self._linear.b @ pick, self.name)
        return AlongPlan(self._prepared, self._linear, form, pick, plan)


class AlongPlan:
    """Loop whose inputs are connected to a plan and its derivatives.

    The inputs are ``pick[k] @ r^(k)``, summed over the derivatives of the plan.
    """

    def __init__(self, prepared: Prepared, linear: LinearForm, form: LoopForm, pick: Array, plan: Trajectory) -> None:
        self.form, self.plan = form, plan
        self._linear, self._prepared, self._pick = linear, prepared, pick
        outputs = prepared.output_labels
        c, d = linear.c * form.scale, np.moveaxis(linear.d @ pick, 0, 1)
        self.signals = {name: Rows(c[i : i + 1], d[i : i + 1]) for i, name in enumerate(outputs)}
        for i, name in enumerate(prepared.input_labels):
            self.signals.setdefault(name, Rows(np.zeros((1, len(linear.a))), pick[:, i][None]))

    @cached_property
    def cells(self) -> PlanCells:
        """The plan in units of its duration."""
        return PlanCells(self.plan, self.form.order + 2)

    @cached_property
    def start(self) -> Array:
        """State at rest at the first position of the plan, in balanced coordinates."""
        return self.rest_at(self.plan)

    def rest_at(self, plan: Trajectory) -> Array:
        """State at rest at the first position of a plan, in balanced coordinates.

        Raises
        ------
        ValueError
            If there is none.
        """
        linear, stated = self._linear, self._prepared.stated
        given = np.full(len(linear.a), np.nan) if stated is None else stated
        free, supplied = np.isnan(given), self._pick[0] @ plan.initial
        rows = tracked(self._prepared.output_labels, plan.labels)
        state = linear_equilibrium(
            linear.a,
            linear.b @ supplied,
            linear.c[rows],
            linear.d[rows] @ supplied,
            plan.initial,
            np.where(free, 0.0, given),
            free,
        )
        if state is not None:  # states that blocks declare are not changed
            scale, moved = self.form.scale, linear.a @ state + linear.b @ supplied
            size = np.abs(self.form.a).sum(axis=1) * np.abs(state / scale).max(initial=0.0)
            size += np.abs(linear.b) @ np.abs(supplied) / scale
            if np.any(np.abs(moved / scale) > 1e-9 * size):
                state = None
        if state is None:
            place = ", ".join(f"{label} = {x:.4g}" for label, x in zip(plan.labels, plan.initial.tolist(), strict=True))
            raise ValueError(
                f"the loop must start at rest at the first position of the plan, got {self._prepared.name} without an "
                f"equilibrium at {place}: an integrator has an input that is not 0 there, or a block declares another "
                "initial state"
            )
        return np.asarray(state / self.form.scale)

    def response(self, plan: Trajectory) -> ExactResponse:
        """Response to a plan with the same axes."""
        same = plan is self.plan
        cells, start = (self.cells, self.start) if same else (PlanCells(plan, self.form.order + 2), self.rest_at(plan))
        motion = Motion(self.form, cells, plan.duration, start)
        return ExactResponse(motion, self.signals, plan)


def loop_quantities(
    loop: System | Prepared, *, tail: float | None = None
) -> LoopQuantities | SampledQuantities | SimulatedQuantities:
    """Signals of a loop along a plan, for limits on them.

    `fastest` and `margins` call it for a loop that they are given. The plan is
    the input of the loop, as for `simulate`: axis by axis, or by name where the
    inputs are named after the axes; inputs r, r_d1, r_d2 are the plan r and its
    derivatives. Inputs with other names are 0. Instead, the plan may be the
    source of a block inside (`create_source_iosystem`).

    Parameters
    ----------
    loop : control system or Prepared
        Loop, closed or open. The response of a linear continuous one is exact, and
        that of a linear one with discrete blocks whose sample times repeat. That of
        others is simulated.
    tail : float, optional
        Time after the plan [s] over which a simulated response is considered;
        default: the duration of the plan. Exact responses are considered at all
        times.

    Returns
    -------
    LoopQuantities, SampledQuantities or SimulatedQuantities
        With the attributes ``names`` and ``inputs``, and the method
        ``quantities_of(plan)``.

    Raises
    ------
    TypeError
        If `loop` is not a control system.
    ValueError
        If `tail` is negative, a discrete loop has no sampling time, or a linear loop
        with discrete blocks, or in discrete time, is unstable.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> move = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> response = cp.loop_quantities(cp.plants.integrator_lag_loop(5.0)).quantities_of(move)
    >>> found = response.extremes({"y": 1.0})
    >>> bool(abs(found.low) < 1e-12), round(found.high, 4), round(found.time_high, 3)
    (True, 1.4445, 1.96)
    """
    prepared = prepared_form(loop)
    if prepared.linear is not None:
        return LoopQuantities(prepared)
    if prepared.sampled is not None and has_exact_signals(prepared.sampled):
        if tail is not None:
            checked_finite(tail, "tail", minimum=0.0)
        return SampledQuantities(prepared, prepared.sampled)
    return SimulatedQuantities(prepared, tail)


def _fed_by_sources(form: LinearForm, plan: Trajectory, name: str) -> list[Fed | None]:
    """Axis of a plan and derivative for each output of the sources inside a loop."""
    found: list[Fed | None] = []
    for source, high in form.sources:
        for axis in range(source.naxes):
            same = same_axis(plan, source, axis)
            if same is None:
                raise ValueError(
                    f"sources in {name} must be those of the plan under limits, got another plan with the axis "
                    f"{source.labels[axis]}: its duration does not change with that of the plan"
                )
            found += [(same, k) for k in range(high + 1)]
    return found
