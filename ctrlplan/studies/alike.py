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
from ctrlplan.simulation.linear import LinearForm, LinearParts, in_right_half, linear_parts, stacked_form
from ctrlplan.studies.running import System, acting_outputs, tracked_outputs
from ctrlplan.trajectories import Trajectory


@dataclass(frozen=True, eq=False)
class Linear:
    """Numbers of a linear loop, copied: a builder may modify the loop for the next value.

    Attributes
    ----------
    labels, tracked, acting : tuple of str
        Its outputs; those that follow the plan; those that are controls.
    parts : LinearParts
        Its blocks.
    """

    labels: tuple[str, ...]
    tracked: tuple[str, ...]
    acting: tuple[str, ...]
    parts: LinearParts

    def fits(self, other: Linear) -> bool:
        """Whether two loops have the same structure."""
        return self.labels == other.labels and self.parts.fits(other.parts)

    def is_of(self, loop: System) -> bool:
        """Whether a loop has these labels and numbers."""
        try:
            system = state_space(loop)
            return tuple(system.output_labels) == self.labels and self.parts.equals(linear_parts(system))
        except (AttributeError, TypeError, ValueError):
            return False


def numbers_of(
    loop: System, first: Trajectory, outputs: Sequence[str] | None = None, controls: Sequence[str] | None = None
) -> Linear | None:
    """Numbers of a linear loop; None if it must be run separately.

    Parameters
    ----------
    loop : control system
        As `compare` takes it.
    first : Trajectory
        The first of the plans.
    outputs, controls
        As for `compare`.
    """
    try:
        system = state_space(loop)
        parts = linear_parts(system)
        if parts.has_sources or stated_start(system) is not None or parts.ninputs != first.naxes:
            return None
        tracked = tracked_outputs(system, outputs, first)
        acting = acting_outputs(system, controls)
    except (AttributeError, TypeError, ValueError):  # reported when the loop is run separately
        return None
    return Linear(tuple(system.output_labels), tracked, acting, parts)


@dataclass(frozen=True, eq=False)
class Together:
    """Loops of the same structure, solved together.

    Attributes
    ----------
    labels : tuple of str
        Outputs of the loops.
    form : LinearForm
        Matrices of the loops, stacked.
    starts : dict of str to ndarray, shape (nloops, nstates)
        States at the first sample, by plan.
    """

    labels: tuple[str, ...]
    form: LinearForm
    starts: dict[str, Array]

    @classmethod
    def of(
        cls, loops: Sequence[Linear], held: Mapping[str, Array], duration: float, initial_state: ArrayLike | None
    ) -> tuple[Together, NDArray[np.intp]]:
        """Loops that can be solved together, and their indices; `simulate` reports on the others.

        Parameters
        ----------
        loops : sequence of Linear
            The loops.
        held : mapping of str to ndarray, shape (naxes,)
            First position of each plan.
        duration : float
            Length of the run [s].
        initial_state
            As for `compare`.

        Raises
        ------
        ValueError
            If an algebraic loop has no unique solution, or the initial state does not fit.
        """
        form = stacked_form([loop.parts for loop in loops])
        usable = ~form.is_sensitive(duration)
        if initial_state is not None:
            state = np.broadcast_to(real_array(initial_state, "initial_state"), form.a.shape[:2])
            starts = dict.fromkeys(held, state)
        else:
            each = [LinearForm(*matrices, ()) for matrices in zip(form.a, form.b, form.c, form.d, strict=True)]
            starts = {
                name: np.array([equilibrium_of(one, position) for one in each]) for name, position in held.items()
            }
            usable &= _at_rest(form, starts, held)
        chosen = np.flatnonzero(usable)
        a, b, c, d = (matrices[chosen] for matrices in (form.a, form.b, form.c, form.d))
        kept = {name: state[chosen] for name, state in starts.items()}
        return cls(loops[0].labels, LinearForm(a, b, c, d, ()), kept), chosen

    def is_unstable(self) -> NDArray[np.bool_]:
        """Whether each loop is unstable, shape (nloops,)."""
        return np.asarray(in_right_half(self.form.poles).any(axis=1))

    def outputs(self, labels: Sequence[str], name: str, plan: Trajectory, times: Array) -> Array:
        """Outputs of the loops, shape (nloops, nlabels, ntime).

        Parameters
        ----------
        labels : sequence of str
            Outputs wanted.
        name, plan : str, Trajectory
            The plan at the inputs.
        times : ndarray, shape (ntime,)
            Sample times [s].
        """
        rows = [self.labels.index(label) for label in labels]
        return _outputs(self.form, rows, plan, times, self.starts[name])


def _at_rest(form: LinearForm, starts: Mapping[str, Array], held: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Whether states are equilibria with the plans held at their first positions, shape (nloops,)."""
    found = np.ones(len(form.a), dtype=bool)
    for name, position in held.items():
        states = starts[name][..., None]
        moved = (form.a @ states)[..., 0] + form.b @ position
        terms = (np.abs(form.a) @ np.abs(states))[..., 0] + np.abs(form.b) @ np.abs(position)
        found &= ~np.any(np.abs(moved) > 1e-6 * terms.max(axis=1, keepdims=True, initial=0.0), axis=1)
    return found


def _outputs(form: LinearForm, rows: list[int], plan: Trajectory, times: Array, initial: Array) -> Array:
    """Some of the outputs, shape (nloops, nrows, ntime), with a plan at the inputs."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = exact_states(form.a, form.b, plan.segment_jet_at, list(plan.breakpoints), times, initial, form.c[:, rows])
        direct = form.d[:, rows]
        if direct.any():
            reference = plan.jet(times, 0)[0]
            for i, k, j in np.argwhere(direct).tolist():  # row by row, which stays in the cache
                out[i, k] += direct[i, k, j] * reference[j]
    if not np.isfinite(out[..., -1]).all():  # after an overflow
        out[np.isnan(out)] = np.inf
    return out
