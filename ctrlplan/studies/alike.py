"""Linear loops of the same structure, solved together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import real_array
from ctrlplan._types import Array
from ctrlplan.simulation import state_space, stated_start
from ctrlplan.simulation.equilibrium import equilibrium_of
from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.linear import LinearForm, in_right_half, linear_form
from ctrlplan.studies.running import System, acting_outputs, tracked_outputs
from ctrlplan.trajectories import Trajectory


@dataclass(frozen=True, eq=False)
class Linear:
    """Matrices of a linear loop, copied: a builder may modify the loop for the next value.

    Attributes
    ----------
    labels, tracked, acting : tuple of str
        Its outputs; those that follow the plan; those that are controls.
    form : LinearForm
        Its matrices.
    starts : dict of str to ndarray, shape (nstates,)
        States at the first sample, by plan.
    """

    labels: tuple[str, ...]
    tracked: tuple[str, ...]
    acting: tuple[str, ...]
    form: LinearForm
    starts: dict[str, Array]

    def fits(self, other: Linear) -> bool:
        """Whether two loops have the same structure."""
        same = (getattr(self.form, name).shape == getattr(other.form, name).shape for name in "abcd")
        return self.labels == other.labels and all(same)


def numbers_of(
    loop: System,
    first: Trajectory,
    held: Mapping[str, Array],
    duration: float,
    outputs: Sequence[str] | None = None,
    controls: Sequence[str] | None = None,
    initial_state: ArrayLike | None = None,
) -> Linear | None:
    """Matrices of a linear loop; None if it must be run separately.

    Parameters
    ----------
    loop : control system
        As `compare` takes it.
    first : Trajectory
        The first of the plans.
    held : mapping of str to ndarray, shape (naxes,)
        First position of each plan.
    duration : float
        Length of the run [s].
    outputs, controls, initial_state
        As for `compare`.
    """
    try:
        system = state_space(loop)
        form, stated = linear_form(system), stated_start(system)
        if form.sources or stated is not None or form.b.shape[1] != first.naxes:
            return None
        tracked = tracked_outputs(system, outputs, first)
        acting = acting_outputs(system, controls)
        if initial_state is not None:
            state = np.broadcast_to(real_array(initial_state, "initial_state"), (system.nstates,))
            starts = dict.fromkeys(held, state)
        else:
            starts = {name: equilibrium_of(form, position) for name, position in held.items()}
    except (AttributeError, TypeError, ValueError):  # reported when the loop is run separately
        return None
    if initial_state is None and not _at_rest(form, starts, held):
        return None  # reported when the loop is run separately
    if any(form.sensitivity(duration)):
        return None  # `simulate` warns about the loss of digits
    return Linear(tuple(system.output_labels), tracked, acting, form, starts)


def _at_rest(form: LinearForm, starts: Mapping[str, Array], held: Mapping[str, Array]) -> bool:
    """Whether states are equilibria with the plans held at their first positions."""
    for name, position in held.items():
        moved = form.a @ starts[name] + form.b @ position
        terms = np.abs(form.a) @ np.abs(starts[name]) + np.abs(form.b) @ np.abs(position)
        if np.any(np.abs(moved) > 1e-6 * terms.max(initial=0.0)):
            return False
    return True


def outputs_together(
    loops: Sequence[Linear], names: Sequence[str], plans: Mapping[str, Trajectory], times: Array
) -> tuple[dict[str, Array], NDArray[np.bool_]]:
    """Outputs of loops of the same structure, and whether each is unstable.

    Parameters
    ----------
    loops : sequence of Linear
        The loops.
    names : sequence of str
        Outputs wanted.
    plans : mapping of str to Trajectory
        The plans at their inputs.
    times : ndarray, shape (ntime,)
        Sample times [s].

    Returns
    -------
    dict of str to ndarray, shape (nloops, nnames, ntime)
        By plan.
    ndarray of bool, shape (nloops,)
    """
    rows = [loops[0].labels.index(name) for name in names]
    a, b, c, d = (np.stack([getattr(loop.form, name) for loop in loops]) for name in "abcd")
    form = LinearForm(a, b, c, d, ())
    unstable = np.asarray(in_right_half(np.linalg.eigvals(form.a)).any(axis=1))
    starts = {name: np.stack([loop.starts[name] for loop in loops]) for name in plans}
    return {name: _outputs(form, rows, plan, times, starts[name]) for name, plan in plans.items()}, unstable


def _outputs(form: LinearForm, rows: list[int], plan: Trajectory, times: Array, initial: Array) -> Array:
    """Some of the outputs, shape (nloops, nrows, ntime), with a plan at the inputs."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = exact_states(form.a, form.b, plan.segment_jet_at, list(plan.breakpoints), times, initial, form.c[:, rows])
        for k, row in enumerate(rows):
            if form.d[:, row].any():
                out[:, k] += form.d[:, row] @ plan.jet(times, 0)[0]
    if not np.isfinite(out[..., -1]).all():  # after an overflow
        out[np.isnan(out)] = np.inf
    return out
