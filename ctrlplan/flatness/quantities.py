"""States and inputs of python-control's flat systems as functions of the jet of a plan."""

from __future__ import annotations

from collections.abc import Callable

import control.flatsys as fs
import numpy as np
from numpy.typing import NDArray

from ctrlplan._renamed import warn_renamed
from ctrlplan._types import Array
from ctrlplan.flatness.rest import AT_REST
from ctrlplan.flatness.system import FlatSystem
from ctrlplan.flatness.verify import check_maps, checked_plant, undetermined_at_rest, warn_of_output


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
        motion are inconsistent; by the returned function, if the jet is too short
        or has another number of axes.

    Warns
    -----
    UserWarning
        If it is a `LinearFlatSystem` whose output is not its flat output, but a
        multiple of it or, if the plant has zeros, a linear combination of its
        derivatives.

    Notes
    -----
    States and inputs that the flat output does not determine at rest (heading and
    steering angle of a car, quotients of derivatives that are 0 there) are nan
    at rest.
    """
    if isinstance(flat_system, FlatSystem):
        return flat_system.quantities
    plant = checked_plant(flat_system)
    warn_of_output(flat_system)
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
