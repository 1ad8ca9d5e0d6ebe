"""Feedforward of a linear loop: the command for exact tracking of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import control as ct
import numpy as np
from scipy.linalg import null_space

from ctrlplan._checks import checked_labels
from ctrlplan._renamed import former_signature
from ctrlplan._types import Array
from ctrlplan.trajectories import derivative_name

_SMALL = 1e-9
"""Relative size up to which numbers count as 0."""


@former_signature("label", "name", renamed={"label": "labels"}, implied={"label": {"suffix": ""}})
def create_feedforward_iosystem(
    loop: ct.StateSpace | ct.TransferFunction,
    *,
    labels: Sequence[str] | str | None = None,
    suffix: str = "_ref",
    name: str = "feedforward",
) -> ct.StateSpace:
    r"""Exact inverse of a linear loop whose zeros are in the left half plane.

    The output y of a loop without zeros is flat. With the transfer function
    g/(s^n + a_(n-1) s^(n-1) + ... + a_0) from its input to y, the command

    .. math:: r = \frac1g \Bigl(y_d^{(n)} + \sum_{k=0}^{n-1} a_k\, y_d^{(k)}\Bigr)

    gives y = y_d if the loop starts on the plan; for k/(s^2 + s) in unity
    feedback it is y_d + (y_d'' + y_d')/k. Errors decay with the poles of the
    loop.

    A loop with zeros, such as any with a PI, PD or PID controller, has internal
    dynamics whose poles are the zeros: the block computes them, with as many
    states. Loops of several inputs and as many outputs are inverted output by output.

    The inverse of a plant alone is the feedforward of velocity, acceleration and
    higher derivatives. Its output is added to that of the controller, whose zeros
    then do not matter: y = y_d if the error is 0 at the start.

    States: the internal dynamics, as many as zeros, 0 at the start: the plan starts at
    0, or at an equilibrium that the initial state must give. Inputs: y_ref, y_ref_d1, ... up to
    the relative degree of y, with y an output of the loop, as
    `create_source_iosystem` names its outputs with ``suffix="_ref"``. Outputs:
    the inputs of the loop, under their names.

    Parameters
    ----------
    loop : control.StateSpace or control.TransferFunction
        The loop, or a plant: linear and continuous-time, with as many inputs as
        outputs; interconnections of linear blocks are accepted.
    labels : sequence of str or str, optional
        Names of the plan's axes, by default those of the outputs of the loop.
    suffix : str, optional
        Appended to the label.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.StateSpace
        In continuous time; without zeros a static gain, of any time base.

    Raises
    ------
    TypeError
        If the loop is not linear.
    ValueError
        If it is discrete, has another number of inputs than outputs, a transfer
        function of 0, highest derivatives that depend on the inputs in fewer
        combinations than outputs, or zeros that are not in the left half plane (the
        message lists them: the command would grow without bound); or if a label
        with the suffix is a signal of the loop.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> loop = cp.plants.integrator_lag_loop(4.0)
    >>> feedforward = create_feedforward_iosystem(loop)
    >>> feedforward.input_labels, feedforward.D.tolist()
    (['y_ref', 'y_ref_d1', 'y_ref_d2'], [[1.0, 0.25, 0.25]])
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> source = cp.create_source_iosystem(plan, derivatives=2, suffix="_ref")
    >>> following = ct.interconnect([source, feedforward, loop], inputs=0, outputs=["y"])
    >>> found = cp.simulate(following, [0.0, 0.5, 1.0])
    >>> bool(abs(found.outputs - plan(found.time)).max() < 1e-12)
    True
    """
    system = _checked_loop(loop)
    given, reached = list(loop.input_labels), list(loop.output_labels)
    axes = [label + suffix for label in checked_labels(reached if labels is None else labels, len(reached))]
    if shared := sorted(set(axes) & {*given, *reached}):
        raise ValueError(
            f"labels and suffix must not name a signal of the loop, to which it would be added, got {shared[0]!r}"
        )
    a, b, c, d = (np.asarray(m, dtype=float) for m in (system.A, system.B, system.C, system.D))
    orders, inverse = _inverse(a, b, c, d, reached)
    names = [derivative_name(axis, k) for axis, r in zip(axes, orders, strict=True) for k in range(r + 1)]
    states = len(inverse[0])
    return ct.ss(*inverse, inputs=names, outputs=given, dt=0 if states else None, name=name)


def _checked_loop(loop: ct.StateSpace | ct.TransferFunction) -> ct.StateSpace:
    if not isinstance(loop, ct.StateSpace | ct.TransferFunction):
        raise TypeError(f"loop must be linear, a StateSpace or TransferFunction, got {type(loop).__name__}")
    if loop.dt not in (None, 0):
        raise ValueError(f"loop must be in continuous time, got dt = {loop.dt}")
    if loop.ninputs != loop.noutputs or not loop.ninputs:
        raise ValueError(f"loop must have as many inputs as outputs, got {loop.ninputs} and {loop.noutputs}")
    fraction = isinstance(loop, ct.TransferFunction)
    if fraction and loop.ninputs > 1:
        raise TypeError("loop with several inputs must be a StateSpace, got a TransferFunction; use control.ss")
    given = (loop.num[0][0], loop.den[0][0]) if fraction else (loop.A, loop.B, loop.C, loop.D)
    if not all(np.isfinite(numbers).all() for numbers in given):
        raise ValueError(f"loop must have finite coefficients, got {' and '.join(str(n.tolist()) for n in given)}")
    if fraction and given[0].size > given[1].size:
        raise ValueError("loop must be proper, got a numerator of higher degree than the denominator")
    return ct.ss(loop)


def _inverse(a: Array, b: Array, c: Array, d: Array, names: Sequence[str]) -> tuple[list[int], tuple[Array, ...]]:
    """Orders of the derivatives of the outputs, and the state-space matrices of the inverse.

    Each output is differentiated until an input appears: y^(r) = c A^r x + e u. The
    zeros are the eigenvalues of the motion with all outputs and their first r - 1
    derivatives equal to 0; they do not affect the inputs, or there are none, if each
    c A^r is a linear combination of the rows before.
    """
    chains = [_chain(a, b, row, through) for row, through in zip(c, d, strict=True)]
    for chain, name in zip(chains, names, strict=True):
        if chain is None:
            what = "" if len(names) == 1 else f" to {name}"
            raise ValueError(f"the transfer function of loop{what} must not be 0, got 0")
    known = [chain for chain in chains if chain is not None]
    orders = [len(chain.rows) for chain in known]
    last, influence = np.array([chain.last for chain in known]), np.array([chain.influence for chain in known])
    inverse = _inverse_of(influence, names)
    rows = np.reshape([row for chain in known for row in chain.rows], (sum(orders), len(a)))
    norms = np.linalg.norm(rows, axis=1)
    basis = rows / norms[:, None]
    parts = np.linalg.lstsq(basis.T, last.T, rcond=None)[0].T
    rest = np.linalg.norm(last - parts @ basis, axis=1)
    if (rest <= _SMALL * (np.linalg.norm(last, axis=1) + np.abs(parts).sum(axis=1))).all():
        empty = np.zeros((0, 0))
        gains = inverse @ _columns(-parts / norms, np.eye(len(names)), orders) + 0.0  # no -0
        return orders, (empty, np.zeros((0, gains.shape[1])), np.zeros((len(names), 0)), gains)
    hidden = null_space(basis) if sum(orders) else np.eye(len(a))
    motion = a - b @ inverse @ last
    zeros = np.linalg.eigvals(hidden.T @ motion @ hidden)
    _check_zeros(zeros, a)
    # x from the derivatives of the outputs, in norms, and from the hidden coordinates.
    from_rows = np.linalg.pinv(basis)
    return orders, (
        hidden.T @ motion @ hidden,
        _columns(hidden.T @ motion @ from_rows / norms, hidden.T @ b @ inverse, orders),
        -inverse @ last @ hidden,
        _columns(-inverse @ last @ from_rows / norms, inverse, orders),
    )


class _Chain(NamedTuple):
    """Rows of an output and its derivatives below the order at which an input appears, and that order's rows."""

    rows: list[Array]
    last: Array
    influence: Array


def _chain(a: Array, b: Array, row: Array, through: Array) -> _Chain | None:
    """Chain of one output; None if no input has an effect on it."""
    if np.any(through != 0.0):
        return _Chain([], row, through)
    rows = [row]
    for _ in range(len(a)):
        influence = rows[-1] @ b
        sizes = np.linalg.norm(rows[-1]) * np.linalg.norm(b, axis=0)
        if (np.abs(influence) > _SMALL * sizes).any():
            return _Chain(rows, rows[-1] @ a, influence)
        rows.append(rows[-1] @ a)
    return None


def _inverse_of(influence: Array, names: Sequence[str]) -> Array:
    """Inverse of the influence of the inputs on the highest derivatives."""
    scaled = influence / np.abs(influence).max(axis=1, keepdims=True)
    sizes = np.abs(scaled).max(axis=0)
    if not sizes.all() or np.linalg.svd(scaled / sizes, compute_uv=False)[-1] < _SMALL:
        raise ValueError(
            f"the highest derivatives of the outputs of loop, {', '.join(names)}, must depend on its inputs "
            "independently, got a singular matrix"
        )
    return np.asarray(np.linalg.inv(influence), dtype=float) if len(names) > 1 else 1.0 / influence


def _columns(below: Array, highest: Array, orders: Sequence[int]) -> Array:
    """Columns for y, y', ..., y^(r) of each output from those of derivatives below r, and of the highest ones."""
    parts, first = [], 0
    for j, r in enumerate(orders):
        parts += [below[:, first : first + r], highest[:, j : j + 1]]
        first += r
    return np.hstack(parts)


def _check_zeros(zeros: Array, a: Array) -> None:
    """Raise unless all zeros are in the left half plane."""
    size = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))
    if (zeros.real < -1e-8 * max(size, float(np.abs(zeros).max()))).all():
        return
    got = ", ".join(f"{zero:.4g}" for zero in np.real_if_close(np.sort_complex(zeros)))
    raise ValueError(
        f"loop must have its zeros in the left half plane, got {got}: the command would grow without bound; if these "
        "are zeros of the controller, give the plant alone and add the output of the block to that of the controller"
    )
