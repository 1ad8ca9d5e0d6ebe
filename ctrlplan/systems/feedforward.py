"""Feedforward of a linear loop: the command for exact tracking of a plan."""

from __future__ import annotations

from collections.abc import Sequence

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
    r"""Exact inverse of a linear loop without finite zeros.

    The output y of such a loop is flat. With the transfer function
    g/(s^n + a_(n-1) s^(n-1) + ... + a_0) from its input to y, the command

    .. math:: r = \frac1g \Bigl(y_d^{(n)} + \sum_{k=0}^{n-1} a_k\, y_d^{(k)}\Bigr)

    gives y = y_d if the loop starts on the plan; for k/(s^2 + s) in unity
    feedback it is y_d + (y_d'' + y_d')/k. Errors decay with the poles of the
    loop.

    The inverse of a plant alone is the feedforward of velocity, acceleration and
    higher derivatives. Its output is added to that of the controller, whose zeros
    then do not matter: y = y_d if the error is 0 at the start.

    No states. Inputs: y_ref, y_ref_d1, ... up to order n, with y the output of
    the loop, as `create_source_iosystem` names its outputs with
    ``suffix="_ref"``. Outputs: the input r of the loop, under its name.

    Parameters
    ----------
    loop : control.StateSpace or control.TransferFunction
        The loop, or a plant: linear and continuous-time, with one input and one output;
        interconnections of linear blocks are accepted.
    labels : sequence of str or str, optional
        Name of the plan's axis, by default that of the output of the loop.
    suffix : str, optional
        Appended to the label.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.StateSpace
        Static gain with n + 1 inputs and one output, of any time base.

    Raises
    ------
    TypeError
        If the loop is not linear.
    ValueError
        If it is discrete, has more than one input or output, a transfer function
        of 0, or finite zeros (the message lists them; the inverse is then not a
        sum of derivatives); or if the label with the suffix is a signal of the
        loop.

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
    given, reached = loop.input_labels[0], loop.output_labels[0]
    label = checked_labels([reached] if labels is None else labels, 1)[0] + suffix
    if label in (given, reached):
        raise ValueError(
            f"labels and suffix must not name a signal of the loop, to which it would be added, got {label!r}"
        )
    gains = _inverse(*(np.asarray(m, dtype=float) for m in (system.A, system.B, system.C, system.D)))
    names = [derivative_name(label, k) for k in range(gains.size)]
    return ct.ss([], [], [], [gains], inputs=names, outputs=[given], dt=None, name=name)


def _checked_loop(loop: ct.StateSpace | ct.TransferFunction) -> ct.StateSpace:
    if not isinstance(loop, ct.StateSpace | ct.TransferFunction):
        raise TypeError(f"loop must be linear, a StateSpace or TransferFunction, got {type(loop).__name__}")
    if loop.dt not in (None, 0):
        raise ValueError(f"loop must be in continuous time, got dt = {loop.dt}")
    if (loop.ninputs, loop.noutputs) != (1, 1):
        raise ValueError(f"loop must have one input and one output, got {loop.ninputs} and {loop.noutputs}")
    fraction = isinstance(loop, ct.TransferFunction)
    given = (loop.num[0][0], loop.den[0][0]) if fraction else (loop.A, loop.B, loop.C, loop.D)
    if not all(np.isfinite(numbers).all() for numbers in given):
        raise ValueError(f"loop must have finite coefficients, got {' and '.join(str(n.tolist()) for n in given)}")
    if fraction and given[0].size > given[1].size:
        raise ValueError("loop must be proper, got a numerator of higher degree than the denominator")
    return ct.ss(loop)


def _inverse(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Gains of y, y', ..., y^(n) whose weighted sum is the input.

    y^(k) = c A^k x until the input appears, y^(n) = c A^n x + g r. The zeros are
    the eigenvalues of the motion with y and its first n - 1 derivatives equal
    to 0; they do not affect the input, or there are none, if c A^n is a linear
    combination of the rows before it.
    """
    rows = [c[0]]
    for _ in range(len(a)):
        rows.append(rows[-1] @ a)
    markov = [float(d[0, 0]), *(float(row @ b[:, 0]) for row in rows[:-1])]
    sizes = [0.0, *(float(np.linalg.norm(row) * np.linalg.norm(b)) for row in rows[:-1])]
    seen = [abs(value) > _SMALL * size for value, size in zip(markov, sizes, strict=True)]
    if not any(seen):
        raise ValueError("the transfer function of loop must not be 0, got 0")
    order = seen.index(True)
    gain, last = markov[order], rows[order]
    norms = np.array([np.linalg.norm(row) for row in rows[:order]])
    basis = np.reshape(rows[:order], (order, len(a))) / norms[:, None]
    parts = np.linalg.lstsq(basis.T, last, rcond=None)[0]
    if np.linalg.norm(last - parts @ basis) > _SMALL * (np.linalg.norm(last) + np.abs(parts).sum()):
        hidden = null_space(basis) if order else np.eye(len(a))
        zeros = np.linalg.eigvals(hidden.T @ (a - np.outer(b, last) / gain) @ hidden)
        got = ", ".join(f"{zero:.4g}" for zero in np.real_if_close(np.sort_complex(zeros)))
        raise ValueError(
            f"loop must have no finite zeros for its inverse to be a sum of derivatives, got {got}; if they are those "
            "of the controller, give the plant alone and add the output of the block to that of the controller"
        )
    return np.append(-parts / norms, 1.0) / gain + 0.0  # no -0
