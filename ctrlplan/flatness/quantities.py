"""States and inputs of python-control's flat systems as functions of the jet of a plan."""

from __future__ import annotations

from collections.abc import Callable

import control.flatsys as fs
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import default_labels
from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Array, Params
from ctrlplan.flatness.on_path import PathTable
from ctrlplan.flatness.rest import AT_REST
from ctrlplan.flatness.system import FlatSystem
from ctrlplan.flatness.verify import check_maps, check_output, checked_plant, random_probes, undetermined_at_rest
from ctrlplan.trajectories import PathPlan


def flat_quantities(flat_system: fs.FlatSystem) -> Callable[[Array], dict[str, Array]]:
    """Deprecated: pass the flat system itself to `fastest` or `margins`.

    Warns
    -----
    FutureWarning
        Always.
    """
    warn_renamed("flat_quantities(flat_system)", "flat_system itself")
    return quantities_of_flat_system(flat_system)


def quantities_of_flat_system(flat_system: fs.FlatSystem) -> Callable[[Array], dict[str, Array]]:
    """States and inputs of a flat system as functions of the jet.

    For a `ctrlplan.flatness.FlatSystem`, its method `quantities`; for other flat
    systems of python-control, by the reverse map, one time after the other.

    Parameters
    ----------
    flat_system : control.flatsys.FlatSystem
        Flat system in continuous time, whose states must be functions of the
        flags without their last entries.

    Returns
    -------
    callable
        Maps a jet (order + 1, nflat, ntime) to states and inputs (ntime,) by
        name. The states require one order less than the inputs.

    Raises
    ------
    TypeError
        If `flat_system` is not a `control.flatsys.FlatSystem`.
    ValueError
        If it is in discrete time, or `forward`, `reverse` and the equations of
        motion are inconsistent; if it is a `LinearFlatSystem` with zeros, whose
        output is not a flat output; by the returned function, if the jet is too
        short or has another number of axes.

    Notes
    -----
    The flat output of a `LinearFlatSystem` is its output, of which that of
    python-control is a multiple. States and inputs that the flat output does not determine at rest (heading and
    steering angle of a car, quotients of derivatives that are 0 there) are nan
    at rest.
    """
    if isinstance(flat_system, FlatSystem):
        return flat_system.quantities
    plant = checked_plant(flat_system)
    check_output(flat_system)
    check_maps(flat_system)
    states, inputs = list(flat_system.state_labels), list(flat_system.input_labels)
    # Not at zero, where some flags are not finite.
    flag = plant.forward(0.1 * np.ones(len(states)), 0.1 * np.ones(len(inputs)))
    lengths = [len(row) for row in flag]
    longest = max(lengths)
    undetermined = undetermined_at_rest(plant, lengths)

    def quantities(jet: Array) -> dict[str, Array]:
        if len(jet) < longest - 1 or jet.shape[1] != len(lengths):
            raise ValueError(
                f"jet must have the shape (order + 1, {len(lengths)}, ntime) with an order of {longest - 2} for states "
                f"and {longest - 1} for inputs, got {jet.shape}"
            )
        known = len(jet) >= longest
        values = jet if known else np.concatenate([jet, np.zeros((1, *jet.shape[1:]))])
        columns: list[NDArray[np.generic]] = []
        with np.errstate(divide="ignore", invalid="ignore"):  # the result is nan
            for k in range(jet.shape[2]):
                x, u = plant.reverse([values[:length, j, k] for j, length in enumerate(lengths)])
                columns.append(np.concatenate([x, u]))
        rows = np.array(columns, dtype=float).T
        if undetermined.any():
            speed = np.abs(values[1]).max(axis=0)
            rows[np.ix_(undetermined, speed <= AT_REST * speed.max())] = np.nan
        names = [*states, *inputs] if known else states
        return dict(zip(names, rows, strict=False))

    return quantities


class QuantitiesOnPath:
    """States and inputs of a flat system as functions of the jet of `PathPlan.with_coordinate`.

    Of the same path with any time laws. A call maps a jet (order + 1, 3, ntime) to
    signals (ntime,) by name: states and inputs that do not depend on the pace, and
    with an order of at least 1 all inputs.

    Parameters
    ----------
    flat_system : control.flatsys.FlatSystem
        Vehicle whose inputs set its pace.
    plan : PathPlan
        The path.

    Raises
    ------
    TypeError, ValueError
        As `quantities_of_flat_system`; if the inputs do not set the pace.
    """

    def __init__(self, flat_system: fs.FlatSystem, plan: PathPlan) -> None:
        self._plant = flat_system if isinstance(flat_system, FlatSystem) else _vectorised(flat_system)
        self._table = PathTable(self._plant.path_maps(plan), plan.pieces)
        self._degrees = np.array(self._plant.pace_degrees)[:, None]
        self._nstates = len(self._plant.state_labels)
        self._names = [*self._plant.state_labels, *self._plant.input_labels]
        paced = [False] * self._nstates + [bool(degree) for degree in self._plant.pace_degrees]
        self._at_any_pace = [name for name, depends in zip(self._names, paced, strict=True) if not depends]

    def __call__(self, jet: Array) -> dict[str, Array]:
        """Signals (ntime,) by name of a jet (order + 1, 3, ntime)."""
        values, _ = self._table.at(jet[0, -1])
        x, u = values[: self._nstates], values[self._nstates :]
        pace = jet[1, -1] if len(jet) > 1 else np.ones(jet.shape[2])
        found = self._plant.signals(x, np.where(self._degrees, u * pace, u))
        return {name: found[name] for name in (self._names if len(jet) > 1 else self._at_any_pace)}

    def rates(self, jet: Array) -> dict[str, Array]:
        """Time derivatives of states and inputs; of those that depend on the pace from a jet of order 2 at least."""
        values, slopes = self._table.at(jet[0, -1])
        pace, change = jet[1, -1], jet[2, -1] if len(jet) > 2 else np.nan
        u, slope = values[self._nstates :], slopes[self._nstates :]
        inputs = np.where(self._degrees, slope * pace**2 + u * change, slope * pace)
        return dict(zip(self._names, [*slopes[: self._nstates] * pace, *inputs], strict=True))


def _vectorised(flat_system: fs.FlatSystem) -> FlatSystem:
    """Flat system of python-control with vectorised maps."""
    plant = checked_plant(flat_system)
    check_output(flat_system)
    check_maps(flat_system)
    orders = random_probes(plant)[0].orders

    def reverse(flag: list[Array], params: Params) -> tuple[Array, Array]:
        with np.errstate(divide="ignore", invalid="ignore"):  # the result is nan
            columns = [plant.reverse([row[:, k] for row in flag]) for k in range(flag[0].shape[1])]
        x, u = (np.array([column[which] for column in columns], dtype=float).T for which in (0, 1))
        return x, u

    return FlatSystem(
        lambda x, u, params: plant.forward(x, u),
        reverse,
        lambda t, x, u, params: plant.rates(x, u)[0],
        lambda t, x, u, params: x,
        orders=orders,
        flat_labels=default_labels(len(orders)),
        states=flat_system.state_labels,
        inputs=flat_system.input_labels,
        outputs=flat_system.state_labels,
        name=flat_system.name,
    )
