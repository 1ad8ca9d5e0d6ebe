"""Where a linear loop rests, and whether it does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space

from ctrlplan._checks import real_array
from ctrlplan.simulation.exact import state_scale
from ctrlplan.simulation.linear import LinearForm, NotLinearError, in_right_half, linear_form
from ctrlplan.simulation.prepared import Prepared

Array = NDArray[np.float64]


def rest_state(system: Any, position: ArrayLike) -> Array:
    """State at which a linear loop rests when its inputs are held.

    Parameters
    ----------
    system : control system
        Linear and continuous; of others the zero state is returned.
    position : array_like, shape (ninputs,)
        What the inputs are held at.

    Returns
    -------
    ndarray, shape (nstates,)
        A solution of A x + B w = 0, with outputs as near w as it allows; zero
        where there is none.
    """
    held = np.atleast_1d(real_array(position, "position"))
    if not held.any():
        return np.zeros(system.nstates or 0)
    try:
        form = _form(system)
    except NotLinearError:
        return np.zeros(system.nstates or 0)
    if form.b.shape[1] != held.size:
        return np.zeros(len(form.a))
    # Rows and columns of one size: beside a fast pole a slow one is not taken for an integrator.
    scale, supplied = state_scale(form.a), form.b @ held
    rates = form.a * scale
    size = np.abs(np.column_stack([rates, supplied])).max(axis=1, initial=0.0)
    size[size == 0.0] = 1.0
    rates, supplied = rates / size[:, None], supplied / size
    state: Array = np.linalg.lstsq(rates, -supplied, rcond=None)[0]
    left = np.abs(rates @ state + supplied).max(initial=0.0)
    if left > 1e-9 * max(np.abs(state).max(initial=0.0), np.abs(supplied).max(initial=0.0)):
        return np.zeros(len(form.a))
    # Where integrators leave a choice, the outputs should be what is asked for.
    idle, tracked = null_space(rates), form.c[: held.size] * scale
    if idle.size and len(tracked) == held.size:
        missing = held - tracked @ state - form.d[: held.size] @ held
        state = state + idle @ np.linalg.lstsq(tracked @ idle, missing, rcond=None)[0]
    return state * scale


def unstable_poles(system: Any) -> NDArray[np.complex128]:
    """Poles in the right half plane of a linear continuous system; of others none are known."""
    try:
        poles = np.linalg.eigvals(_form(system).a).astype(complex)
    except NotLinearError:
        return np.empty(0, dtype=complex)
    return poles[in_right_half(poles)]


def _form(system: Any) -> LinearForm:
    if not isinstance(system, Prepared):
        return linear_form(system)
    if system.linear is None:
        raise NotLinearError(system.not_linear)
    return system.linear
