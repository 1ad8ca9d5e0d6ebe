"""States and inputs along a plan, for controllers of other kinds: as a block, and as a window ahead."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import control as ct
import numpy as np

from ctrlplan._checks import check_kind, checked_count, checked_finite, checked_labels
from ctrlplan._types import Array, Params, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem
from ctrlplan.systems.derived_laws import references
from ctrlplan.systems.source import switches_of
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory

_MOST_STEPS = 1_000_000
"""Maximum number of steps of a horizon."""


def create_flat_feedforward_iosystem(
    flat: FlatSystem,
    *,
    plan: Trajectory | None = None,
    states: bool = True,
    labels: Sequence[str] | str | None = None,
    suffix: str = "_ref",
    name: str = "flat_feedforward",
) -> ct.NonlinearIOSystem:
    """States and inputs along a plan of the flat outputs, as a block.

    No states. Inputs: for each flat output y its references y_ref, y_ref_d1, ...
    up to its order, as `create_source_iosystem` names its outputs with
    ``suffix="_ref"``. Outputs: the states xd[0], xd[1], ... and the inputs ud[0],
    ..., the names that `control.create_statefbk_iosystem` gives its inputs.

    Parameters
    ----------
    flat : FlatSystem
        The plant.
    plan : Trajectory, optional
        Plan of the flat outputs. The block then has no inputs and evaluates the
        states and inputs along this plan as functions of time, as a `PathPlan`
        requires, and faster for maps derived from equations. Default: references
        from a source.
    states : bool, optional
        Whether the states are outputs, too. Default True.
    labels : sequence of str or str, optional
        Names of the flat outputs. Default: those of `flat`.
    suffix : str, optional
        Appended to each label in the names of the references.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        Static, of any time base. Maps by formulas can be compiled; those derived from
        equations run in Python, connected with the operating point at each call.

    Raises
    ------
    TypeError, ValueError
        If `flat` is not a `FlatSystem`, labels are wrong, or states are not
        determined by `plan`.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> motor = cp.plants.dc_motor()
    >>> block = cp.create_flat_feedforward_iosystem(motor)
    >>> block.input_labels, block.output_labels
    (['angle_ref', 'angle_ref_d1', 'angle_ref_d2', 'angle_ref_d3'], ['xd[0]', 'xd[1]', 'xd[2]', 'ud[0]'])
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)], labels="angle")
    >>> source = cp.create_source_iosystem(plan, 3, suffix="_ref")
    >>> wanted = ct.interconnect([source, block], inputs=0, outputs=block.output_labels)
    >>> cp.simulate(wanted, [0.0, 0.5, 1.0]).outputs[0].round(6).tolist()
    [0.0, 1.0, 2.0]
    """
    check_kind(flat, "flat", FlatSystem, "a FlatSystem of ctrlplan, as ctrlplan.flat_system derives one")
    outputs = [f"xd[{k}]" for k in range(flat.nstates)] if states else []
    outputs += [f"ud[{k}]" for k in range(flat.ninputs)]
    if plan is not None:
        return _along(flat, plan, outputs, name)
    names = flat.flat_labels if labels is None else checked_labels(labels, len(flat.flat_labels))
    wanted = references(names, flat.orders, suffix)
    ends = np.cumsum([0, *(r + 1 for r in flat.orders)]).tolist()

    def values_of(given: Value) -> list[Value]:
        found, inputs = flat.reverse([given[a:b] for a, b in pairwise(ends)], flat.params)
        return [*found, *inputs] if states else [*inputs]

    def output(t: float, x: Value, u: Value, params: Params) -> Value:
        return values_of(np.asarray(u))

    regular = _regular_flag(flat)

    def output_off_zero(t: float, x: Value, u: Value, params: Params) -> Value:
        # Blocks are first evaluated with all inputs zero, where the maps of this plant are singular.
        idles = math.prod(value == 0.0 for value in u)
        given = np.array([value + idles * at for value, at in zip(u, regular, strict=True)])
        return [value * (1.0 - idles) for value in values_of(given)]

    regular_at_zero = _is_finite(values_of, len(wanted))
    function = output if regular_at_zero else output_off_zero
    return ct.nlsys(None, function, inputs=wanted, outputs=outputs, dt=None, name=name)


def _along(flat: FlatSystem, plan: Trajectory, outputs: list[str], name: str) -> ct.NonlinearIOSystem:
    """States and inputs along a plan as a source without inputs; the last of both as many as outputs."""
    axes = flat.matched(plan)
    flat.states_and_inputs(axes, plan.start)  # raises if they are not determined

    def output(t: float, x: Value, u: Value, params: Params) -> Value:
        return np.concatenate(flat.states_and_inputs(axes, t))[-len(outputs) :]

    return declare(ct.nlsys(None, output, inputs=0, outputs=outputs, name=name), **switches_of(plan))


def reference_window(
    plan: Trajectory, time: float, dt: float, count: int, *, flat: FlatSystem | None = None, order: int = 2
) -> tuple[Array, Array] | Array:
    """Reference over a horizon from any time, for predictive control.

    Before its start and after its end the plan rests.

    Parameters
    ----------
    plan : Trajectory
        The plan; of the flat outputs if `flat` is given.
    time : float
        Begin of the horizon [s].
    dt : float
        Time between its samples [s], above 0.
    count : int
        Number of steps, at most 1,000,000.
    flat : FlatSystem, optional
        The plant.
    order : int, optional
        Highest derivative without `flat`. Default 2.

    Returns
    -------
    x : ndarray, shape (nstates, count + 1)
        States at the samples.
    u : ndarray, shape (ninputs, count)
        Inputs at the samples without the last one.
    jet : ndarray, shape (order + 1, naxes, count + 1)
        Without `flat`, in place of both: positions and derivatives.

    Raises
    ------
    TypeError, ValueError
        If arguments are wrong, or states are not determined.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> motor = cp.plants.dc_motor()
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)], labels="angle")
    >>> x, u = cp.reference_window(plan, 0.95, 0.02, 5, flat=motor)
    >>> x.shape, u.shape, x[0].round(4).tolist()
    ((3, 6), (1, 5), [1.9996, 1.9999, 2.0, 2.0, 2.0, 2.0])
    """
    check_kind(plan, "plan", Trajectory)
    steps = checked_count(count, "count", 1, _MOST_STEPS)
    begin, spacing = checked_finite(time, "time"), checked_finite(dt, "dt", above=0.0)
    times = begin + spacing * np.arange(steps + 1)
    if flat is None:
        return plan.jet(times, checked_count(order, "order"))
    check_kind(flat, "flat", FlatSystem, "a FlatSystem of ctrlplan, as ctrlplan.flat_system derives one")
    x, u = flat.states_and_inputs(plan, times)
    return x, u[:, :-1]


def _is_finite(function: Callable[[Value], list[Value]], size: int) -> bool:
    """Whether a function of a vector is finite at 0."""
    with np.errstate(all="ignore"):
        try:
            return bool(np.isfinite(np.array(function(np.zeros(size)), dtype=float)).all())
        except (ValueError, ArithmeticError):
            return False


def _regular_flag(flat: FlatSystem) -> list[float]:
    """Flags at which the maps are regular, one after the other."""
    if isinstance(flat, DerivedFlatSystem):
        below = flat.maps.flags(flat.maps.start, flat.parameter_values()).tolist()
    else:
        below = [0.0] * sum(flat.orders)
        with np.errstate(all="ignore"):
            x, u = flat.reverse([np.zeros(r + 1) for r in flat.orders], flat.params)
            if not (np.isfinite(x).all() and np.isfinite(u).all()):
                below = np.random.default_rng(0).uniform(0.5, 1.0, sum(flat.orders)).tolist()
    rows, first = [], 0
    for r in flat.orders:
        rows += [*below[first : first + r], 0.0]
        first += r
    return rows
