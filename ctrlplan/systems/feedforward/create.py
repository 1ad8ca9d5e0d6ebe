"""Feedforward of a linear loop: the command for exact tracking of a plan."""

from __future__ import annotations

from collections.abc import Sequence

import control as ct
import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import check_kind, checked_finite, checked_labels, checked_names
from ctrlplan._renamed import former_signature
from ctrlplan._types import Array, System
from ctrlplan.systems.feedforward.block import Method, PlannedFeedforward
from ctrlplan.systems.feedforward.discrete import discrete_feedforward
from ctrlplan.systems.feedforward.inverse import loop_inverse
from ctrlplan.systems.feedforward.planned import PlanOptions, planned_feedforward
from ctrlplan.systems.feedforward.sampled import is_sampled, sampled_feedforward
from ctrlplan.systems.feedforward.zeros import eigenvalues, largest_size, tolerance, zero_list
from ctrlplan.trajectories import Trajectory, derivative_name
from ctrlplan.trajectories.trajectory import check_end


@former_signature("label", "name", renamed={"label": "labels"}, implied={"label": {"suffix": ""}})
def create_feedforward_iosystem(
    loop: ct.StateSpace | ct.TransferFunction | ct.InterconnectedSystem,
    *,
    plan: Trajectory | None = None,
    error: float = 1e-6,
    preview: float | None = None,
    method: Method = "exact",
    finite: bool = False,
    labels: Sequence[str] | str | None = None,
    suffix: str = "_ref",
    name: str = "feedforward",
) -> ct.StateSpace | PlannedFeedforward:
    r"""Exact inverse of a linear loop: the command with which it follows a plan.

    The output y of a loop without zeros is flat. With the transfer function
    g/(s^n + a_(n-1) s^(n-1) + ... + a_0) from its input to y, the command

    .. math:: r = \frac1g \Bigl(y_d^{(n)} + \sum_{k=0}^{n-1} a_k\, y_d^{(k)}\Bigr)

    gives y = y_d if the loop starts on the plan; for k/(s^2 + s) in unity
    feedback it is y_d + (y_d'' + y_d')/k. Errors evolve with the poles of the
    loop: they decay in a stable loop, and grow in an unstable one, which follows
    the plan only if it starts on it exactly.

    A loop with zeros, such as any with a PI, PD or PID controller, has internal
    dynamics whose poles are the zeros: the block computes them, with as many
    states. Loops of several inputs and as many outputs are inverted output by output.

    The inverse of a plant alone is the feedforward of velocity, acceleration and
    higher derivatives. Its output is added to that of the controller, whose zeros
    then do not matter: y = y_d if the error is 0 at the start.

    Without `plan`, for continuous loops with zeros in the left half plane:

    States: the internal dynamics, as many as zeros, 0 at the start: the plan starts at
    0, or at an equilibrium that the initial state must give. Inputs: y_ref, y_ref_d1, ... up to
    the relative degree of y, with y an output of the loop, as
    `create_source_iosystem` names its outputs with ``suffix="_ref"``. Outputs:
    the inputs of the loop, under their names.

    With `plan`, for all loops: States: the internal dynamics of the zeros that are
    stable or on the stability boundary, at equilibrium at the start. No inputs.
    Outputs: the inputs of the loop, under their names. See Notes.

    Parameters
    ----------
    loop : control.StateSpace, control.TransferFunction or control.InterconnectedSystem
        The loop, or a plant, with as many inputs as outputs; interconnections of
        linear blocks are accepted. With `plan` it may be discrete, or a continuous
        loop with `sample_hold` blocks of one period.
    plan : Trajectory, optional
        The plan, one axis for each output, with as many continuous derivatives as
        the relative degree minus 1. It starts at any position that the loop can hold.
    error : float, optional
        Maximum tracking error by a limited preview, relative to the range of the plan
        of each output. Default 1e-6.
    preview : float, optional
        Time [s] by which the command starts before the plan, in place of the one
        that `error` requires.
    method : {"exact", "zpetc"}, optional
        For discrete loops with one input: "zpetc" does not cancel zeros that
        "exact" rejects, see Notes.
    finite : bool, optional
        Accept a command that grows after the end of the plan, by zeros on the
        imaginary axis or the unit circle. Default False.
    labels : sequence of str or str, optional
        Names of the plan's axes, one for each output of the loop, by default those
        of the outputs. With `plan`: axes of the plan, by default those named as the
        outputs, or all in their order.
    suffix : str, optional
        Appended to the labels of the inputs, without `plan`.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.StateSpace or PlannedFeedforward
        Without `plan` in continuous time; without zeros a static gain, of any time
        base. With `plan` a block of the time base of the loop, which states
        the preview, the start, errors and what remains after the plan.

    Raises
    ------
    TypeError
        If the loop is not linear, or an argument has the wrong type.
    ValueError
        If the loop has another number of inputs than outputs, a transfer function of
        0, or no inverse; if a label with the suffix is a signal of the loop. Without
        `plan` if it is discrete or has zeros that are not in the left half plane (the
        message lists them: the command would grow without bound). With `plan`
        if the loop cannot follow it, as the Notes say.

    Notes
    -----
    *Zeros in the right half plane.* The bounded command starts before the plan
    (pre-actuation). It starts `preview` seconds early, from rest, and omits what
    came before; the tracking error is then the free response of the loop to the
    omitted part, which sets the preview for a given `error`. Simulations begin at
    ``plan.start - preview``, the attribute `start` of the block, or earlier. For an
    unstable loop this error grows, and `preview` must be given: the run starts
    from the attribute `loop_state`.

    *Zeros on the imaginary axis.* A simple pair leaves the command oscillating
    after the plan, with an amplitude that the block states. Zeros at 0: the loop
    cannot hold an output other than 0, and the plan must end there. With q zeros at 0
    the command stays bounded only if the integrals of t^i y_d(t) are 0 for i < q - 1.

    *Discrete loops.* Tracking is exact at the samples. Zeros with abs(z) <= 0.9 are
    cancelled, those with abs(z) >= 1/0.9 by pre-actuation. Those between make the command
    ring from sample to sample and are rejected, unless they are slow: within 30
    degrees of +1. "zpetc", zero phase error tracking control, leaves these and all
    others outside 0.9 uncancelled and compensates their phase and static gain;
    the remaining gain error is stated. Between the samples of `sample_hold` loops the
    output deviates from the plan by a ripple, which is computed and stated.

    References
    ----------
    Devasia, Chen and Paden, Nonlinear inversion-based output tracking, IEEE
    Transactions on Automatic Control 41 (1996); Tomizuka, Zero phase error tracking
    algorithm for digital control, Journal of Dynamic Systems 109 (1987).

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> loop = cp.plants.integrator_lag_loop(4.0)
    >>> feedforward = cp.create_feedforward_iosystem(loop)
    >>> feedforward.input_labels, feedforward.D.tolist()
    (['y_ref', 'y_ref_d1', 'y_ref_d2'], [[1.0, 0.25, 0.25]])
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> source = cp.create_source_iosystem(plan, derivatives=2, suffix="_ref")
    >>> following = ct.interconnect([source, feedforward, loop], inputs=0, outputs=["y"])
    >>> found = cp.simulate(following, [0.0, 0.5, 1.0])
    >>> bool(abs(found.outputs - plan(found.time)).max() < 1e-12)
    True

    A loop with a zero at 1 rad/s in the right half plane, whose output first moves
    in the wrong direction after a step. The command starts 13.7 s before the plan:

    >>> loop = ct.tf([-1, 1], [1, 2, 1], inputs="r", outputs="y", name="loop")
    >>> feedforward = cp.create_feedforward_iosystem(loop, plan=plan)
    >>> print(feedforward)
    PlannedFeedforward of r from -13.7196 s
      preview            13.7196 s before the plan
      method             exact
      zeros of the loop  1
      error              1e-06 of the move
    >>> following = ct.interconnect([feedforward, loop], inputs=0, outputs=["y", "r"])
    >>> times = np.linspace(cp.traits_of(feedforward).start, 5.0, 1001)
    >>> found = cp.simulate(following, times)
    >>> bool(abs(found.outputs["y"] - plan(times)).max() < 1e-6)
    True

    A digital PI controller of a lag, sampled every 20 ms: the command starts one
    sample before the plan, and the output is that of the plan at the samples.

    >>> gains = [[1.0]], [[0.04, -0.04]], [[1.0]], [[3.0, -3.0]]
    >>> controller = ct.ss(*gains, 0.02, inputs=["r", "y"], outputs="u", name="controller")
    >>> plant = ct.tf([1], [1, 1], inputs="u", outputs="y", name="plant")
    >>> loop = ct.interconnect([cp.sample_hold(controller, 0.02), plant], inputs="r", outputs="y", name="loop")
    >>> feedforward = cp.create_feedforward_iosystem(loop, plan=plan)
    >>> print(feedforward)
    PlannedFeedforward of r from -0.02 s
      preview                 0.02 s before the plan
      method                  exact
      zeros of the loop       0.9867
      error                   0 of the move
      ripple between samples  0.0003339
    """
    options = _checked_options(plan, error, preview, method, finite)
    if plan is None:
        return _block_of(loop, labels, suffix, name)
    if is_sampled(loop):
        _check_square(loop)
        return sampled_feedforward(loop, _matched(plan, labels, loop), options, name)
    system = _checked_loop(loop)
    following = _matched(plan, labels, loop)
    if system.dt in (None, 0):
        return planned_feedforward(system, following, options, name)
    return discrete_feedforward(system, following, options, name)


def _checked_options(
    plan: Trajectory | None, error: float, preview: float | None, method: Method, finite: bool
) -> PlanOptions:
    """Arguments for a plan, checked."""
    if plan is not None:
        check_kind(plan, "plan", Trajectory)
        check_end(plan)
    if method not in ("exact", "zpetc"):
        raise ValueError(f'method must be "exact" or "zpetc", got {method!r:.80}')
    if not isinstance(finite, bool | np.bool_):
        raise TypeError(f"finite must be True or False, got {finite!r:.80}")
    limit = checked_finite(error, "error", above=0.0)
    ahead = None if preview is None else checked_finite(preview, "preview", minimum=0.0)
    options = PlanOptions(error=limit, preview=ahead, method=method, finite=bool(finite))
    if plan is None and options != PlanOptions():
        given = [key for key, value in vars(PlanOptions()).items() if getattr(options, key) != value]
        raise ValueError(f"{', '.join(given)} must be given together with plan=, got no plan")
    return options


def _block_of(
    loop: ct.StateSpace | ct.TransferFunction, labels: Sequence[str] | str | None, suffix: str, name: str
) -> ct.StateSpace:
    """Block for any plan, of a loop whose zeros are stable."""
    if is_sampled(loop):
        raise ValueError(f"loop {loop.name} with sampled blocks requires plan=: {_LATER}")
    system = _checked_loop(loop)
    if system.dt not in (None, 0):
        raise ValueError(f"loop must be in continuous time unless plan= is given, got dt = {loop.dt}: {_LATER}")
    given, reached = list(loop.input_labels), list(loop.output_labels)
    axes = [label + suffix for label in checked_labels(reached if labels is None else labels, len(reached))]
    if shared := sorted(set(axes) & {*given, *reached}):
        raise ValueError(
            f"labels and suffix must not name a signal of the loop, to which it would be added, got {shared[0]!r}"
        )
    inverse = loop_inverse(system)
    _check_zeros(eigenvalues(inverse.z), system.A)
    names = [derivative_name(axis, k) for axis, r in zip(axes, inverse.orders, strict=True) for k in range(r + 1)]
    dt = 0 if inverse.z.size else None
    return ct.ss(inverse.z, inverse.k, inverse.c, inverse.d, inputs=names, outputs=given, dt=dt, name=name)


_LATER = "the command depends on later samples of the plan"


def _checked_loop(loop: ct.StateSpace | ct.TransferFunction) -> ct.StateSpace:
    if not isinstance(loop, ct.StateSpace | ct.TransferFunction):
        raise TypeError(f"loop must be linear, a StateSpace or TransferFunction, got {type(loop).__name__}")
    _check_square(loop)
    fraction = isinstance(loop, ct.TransferFunction)
    if fraction and loop.ninputs > 1:
        raise TypeError("loop with several inputs must be a StateSpace, got a TransferFunction; use control.ss")
    given = (loop.num[0][0], loop.den[0][0]) if fraction else (loop.A, loop.B, loop.C, loop.D)
    if not all(np.isfinite(numbers).all() for numbers in given):
        raise ValueError(f"loop must have finite coefficients, got {' and '.join(str(n.tolist()) for n in given)}")
    if fraction and given[0].size > given[1].size:
        raise ValueError("loop must be proper, got a numerator of higher degree than the denominator")
    return ct.ss(loop) if fraction else loop


def _check_square(loop: System) -> None:
    if loop.ninputs != loop.noutputs or not loop.ninputs:
        raise ValueError(f"loop must have as many inputs as outputs, got {loop.ninputs} and {loop.noutputs}")


def _check_zeros(zeros: NDArray[np.complex128], a: Array) -> None:
    """Raise unless all zeros are in the left half plane."""
    size = largest_size(eigenvalues(a), zeros)
    if all(zero.real < -tolerance(zero, size) for zero in zeros):
        return
    raise ValueError(
        f"loop must have its zeros in the left half plane, got {zero_list(zeros)}: the command would grow without "
        "bound. Give plan= for a bounded command of this plan; or, if these are zeros of the controller, give the "
        "plant alone and add the output of the block to that of the controller"
    )


def _matched(plan: Trajectory, labels: Sequence[str] | str | None, loop: System) -> Trajectory:
    """Plan with one axis for each output of the loop, in their order."""
    outputs = list(loop.output_labels)
    if labels is not None:
        axes = checked_names(labels, "labels", len(outputs))
        for axis in axes:
            if axis not in plan.labels:
                raise ValueError(f"labels must be axes of plan, {', '.join(plan.labels)}, got {axis!r}")
    elif set(outputs) <= set(plan.labels):
        axes = outputs
    elif plan.naxes != len(outputs):
        raise ValueError(
            f"plan must have one axis for each output of loop, {', '.join(outputs)}, got {', '.join(plan.labels)}; "
            "choose axes by labels="
        )
    elif shared := set(outputs) & set(plan.labels):
        raise ValueError(
            f"axes of plan must be named as the outputs of loop, {', '.join(outputs)}, or all differently, got "
            f"{', '.join(plan.labels)}, of which {', '.join(sorted(shared))} would follow by its position; give labels="
        )
    else:
        axes = list(plan.labels)
    return plan if tuple(axes) == plan.labels else plan.select(axes)
