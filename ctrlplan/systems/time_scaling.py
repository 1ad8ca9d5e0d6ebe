"""Time scaling: a plan that is slowed down online near actuator limits, as a block."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import control as ct
import numpy as np

from ctrlplan._checks import (
    Range,
    check_kind,
    checked_count,
    checked_finite,
    checked_limits,
    checked_number,
    checked_pair,
)
from ctrlplan._types import Array, Params, Value
from ctrlplan.systems.source import axis_signals
from ctrlplan.traits import declare
from ctrlplan.trajectories import Trajectory
from ctrlplan.trajectories.combined import is_shaped
from ctrlplan.trajectories.files import signal_names
from ctrlplan.trajectories.repeated import one_pass
from ctrlplan.trajectories.retimed import composed


def create_time_scaling_iosystem(
    plan: Trajectory,
    derivatives: int = 2,
    *,
    limits: Mapping[str, Range] | None = None,
    margin: float = 0.1,
    errors: Mapping[str, Sequence[float]] | None = None,
    bandwidth: float | None = None,
    slowest: float = 0.1,
    fastest: float = 1.1,
    catch_up: float | None = None,
    labels: Sequence[str] | str | None = None,
    suffix: str = "",
    name: str = "time_scaling",
) -> ct.NonlinearIOSystem:
    r"""Plan with online time scaling, slowed down near actuator limits.

    The outputs are y_d(sigma(t)) and its derivatives. The rate sigma' is 1
    nominally; it decreases towards `slowest` as an actuator approaches a limit
    or an error grows, and is above 1 afterwards until the delay has been made
    up. The rate passes through as many first-order lags as there are
    derivatives,

    .. math:: \sigma' = \frac{\rho}{(s/w + 1)^n}, \qquad
        \rho = \rho_{min} + (1 - \text{severity})\,
        (\min(\rho_{max}, \max(\rho_{min}, 1 + (t - \sigma)/T)) - \rho_{min}),

    so that sigma is n times continuously differentiable, and the reference as
    often as the plan. The path is that of the plan at any rate.

    States: lag = t - sigma [s], and ``slow[1]``, ..., the states of the lags of
    1 - sigma'; in the zero state the plan is not delayed. Inputs: the signals
    in `limits` (u for ``limits={"u": ...}``), then those in `errors`. Outputs:
    x, x_d1, ... of each axis, as `create_source_iosystem` names them.

    Parameters
    ----------
    plan : Trajectory
        The plan, not shaped.
    derivatives : int, optional
        Highest derivative among the outputs: the order of the flat controller.
    limits : mapping of str to (float, float) or float, optional
        Minimum and maximum of actuator signals, one of which may be infinite; a
        number a for (-a, a). Slowing down requires force itself, above all
        while braking: without damping it can increase the error. An actuator
        that stays near a limit keeps the rate low.
    margin : float, optional
        Fraction of the range between limits, in (0, 0.5], over which the rate
        decreases; of the magnitude of the limit if the other is infinite.
    errors : mapping of str to (float, float), optional
        For axes by their names in the block: tracking error at which the rate
        begins to decrease, and at which it is `slowest`. Errors respond later
        and more smoothly than limits; which of them is better depends on the
        loop. If a limit is known in advance, use `fastest`.
    bandwidth : float, optional
        w [rad/s] of each lag, by default 10 divided by the duration of the plan.
        The force y_d' sigma'' required for slowing down grows with it.
    slowest, fastest : float, optional
        Minimum rate in [0, 1), and maximum rate, at least 1.
    catch_up : float, optional
        Time constant T [s] with which the delay is made up, by default four
        times the delay n/w of the lags.
    labels : sequence of str or str, optional
        Names of the axes in place of those of the plan.
    suffix : str, optional
        Appended to each label of an output.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        In continuous time, with the breakpoints of the plan declared.

    Raises
    ------
    TypeError
        If `plan` is not a trajectory.
    ValueError
        If an argument is out of range, neither limits nor errors are given, the
        delay would oscillate, or an output has the name of an input; if the
        plan is shaped (`Shaper`), since a time scaling would change the delays
        of the shaper.

    References
    ----------
    O. Dahl, L. Nielsen, "Torque-limited path following by online trajectory time
    scaling", IEEE Trans. Robotics and Automation 6 (1990) 554-561.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["x"])
    >>> block = cp.create_time_scaling_iosystem(plan, limits={"u": (-1.0, 1.0)}, suffix="_ref")
    >>> block.input_labels, block.output_labels, block.state_labels
    (['u'], ['x_ref', 'x_ref_d1', 'x_ref_d2'], ['lag', 'slow[1]', 'slow[2]'])

    A PD controller; the command of the actuator slows the plan down:

    >>> law = ct.ss([], [], [], [[20.0, 8.0, 1.0, -20.0, -8.0]], name="law", outputs="u",
    ...             inputs=["x_ref", "x_ref_d1", "x_ref_d2", "x", "x_d1"])
    >>> plant = cp.plants.integrator_chain(2)
    >>> plant.set_inputs(["F"]), plant.set_outputs(["x", "x_d1"])
    (None, None)
    >>> actuator = cp.create_saturation_iosystem(-1.0, 1.0, inputs="u", outputs="F")
    >>> loop = ct.interconnect([block, law, actuator, plant], inputs=0, outputs=["x", "F"])
    >>> found = cp.simulate(loop, np.linspace(0.0, 20.0, 5))
    >>> bool(abs(found.outputs[0, -1] - 1.0) < 1e-3)
    True
    """
    _check_plan(plan)
    highest = checked_count(derivatives, "derivatives")
    for label, value in (("limits", limits), ("errors", errors)):
        if value is not None:
            check_kind(value, label, Mapping, "a mapping of signals to pairs of numbers")
    n = max(highest, 1)
    w, horizon = _checked_times(plan, n, bandwidth, catch_up)
    minimum, maximum, inner = _checked_shares(slowest, fastest, margin)
    own = axis_signals(plan, labels, "")
    bounds = {label: _checked_limits(pair, label, inner) for label, pair in (limits or {}).items()}
    bands = {label: _checked_band(pair, label, own) for label, pair in (errors or {}).items()}
    inputs = [*bounds, *bands]
    outputs = signal_names(axis_signals(plan, labels, suffix), highest)
    _check_signals(inputs, outputs)
    severity = _severity(plan, [*bounds.values()], [(own.index(label), band) for label, band in bands.items()])
    weights = _rate_weights(n, w)

    def update(t: Value, x: Value, u: Value, params: Params) -> Array:
        free = np.fmin(np.fmax(1.0 + x[0] / horizon, minimum), maximum)
        rate = minimum + (1.0 - severity(t, x, u)) * (free - minimum)
        slow = [1.0 - rate, *(x[k] for k in range(1, n + 1))]
        return np.array([x[n], *(w * (slow[k] - slow[k + 1]) for k in range(n))])

    def out(t: Value, x: Value, u: Value, params: Params) -> Array:
        scaling = [sum(weight * x[k + 1] for k, weight in enumerate(row)) for row in weights[:highest]]
        if scaling:
            scaling[0] = 1.0 + scaling[0]
        scaling = [value / math.factorial(k) for k, value in enumerate(scaling, 1)]
        rows = [composed(row, scaling) for row in _series(plan, t - x[0], highest)]
        return np.array([value * math.factorial(k) for row in rows for k, value in enumerate(row)])

    block = ct.nlsys(
        update,
        out,
        states=["lag", *(f"slow[{k}]" for k in range(1, n + 1))],
        inputs=inputs,
        outputs=outputs,
        dt=0,
        name=name,
    )
    # With a delay, the plan starts moving at times that are not among the declared breakpoints.
    return declare(block, feedthrough=False, breakpoints=plan.breakpoints, longest=0.5 * _shortest_move(plan))


def _check_plan(plan: Trajectory) -> None:
    check_kind(plan, "plan", Trajectory)
    if is_shaped(plan):
        raise ValueError(
            f"plan must not be shaped, got a shaped plan of {plan.duration:g} s: a time scaling would change the "
            "delays of the shaper; give the plan before it is shaped"
        )


def _severity(
    plan: Trajectory, bounds: list[tuple[float, float, float]], bands: list[tuple[int, tuple[float, float]]]
) -> Callable[[Value, Value, Value], Value]:
    """Function of (t, x, u): 0 if no signal is near its limits, 1 if one is at its limit.

    The inputs are the signals of `bounds`, then those of `bands`: an axis of the
    plan and the errors between which the rate decreases.
    """

    def severity(t: Value, x: Value, u: Value) -> Value:
        found = [_nearness(u[k], *bound) for k, bound in enumerate(bounds)]
        if bands:
            reference = _series(plan, t - x[0], 0)
            for k, (axis, (soft, hard)) in enumerate(bands, len(bounds)):
                found.append((np.fabs(u[k] - reference[axis][0]) - soft) / (hard - soft))
        worst = found[0]
        for value in found[1:]:
            worst = np.fmax(worst, value)
        return np.fmin(np.fmax(worst, 0.0), 1.0)

    return severity


def _checked_times(plan: Trajectory, n: int, bandwidth: float | None, catch_up: float | None) -> tuple[float, float]:
    """Bandwidth [rad/s] of n lags and time constant [s] with which the delay is made up."""
    plan = one_pass(plan)
    if bandwidth is None and not plan.duration:
        raise ValueError("bandwidth must be given for a plan without duration, got None")
    w = 10.0 / plan.duration if bandwidth is None else checked_finite(bandwidth, "bandwidth", above=0.0)
    horizon = 4.0 * n / w if catch_up is None else checked_finite(catch_up, "catch_up", above=0.0)
    poles = np.roots([*_lags(n, w), 1.0 / horizon])
    if poles.real.max() >= 0.0:
        raise ValueError(
            f"catch_up must be long compared with the lags, {n}/bandwidth = {n / w:g} s, got {horizon:g} s: the time "
            f"scaling would oscillate with {abs(poles[poles.real.argmax()].imag):.3g} rad/s"
        )
    return w, horizon


def _checked_shares(slowest: float, fastest: float, margin: float) -> tuple[float, float, float]:
    """Minimum and maximum rate, and the fraction of the range of limits over which the rate decreases."""
    minimum, maximum, inner = (
        checked_number(value, label)
        for label, value in (("slowest", slowest), ("fastest", fastest), ("margin", margin))
    )
    if not 0.0 < inner <= 0.5:
        raise ValueError(f"margin must lie in (0, 0.5], got {margin}")
    if not 0.0 <= minimum < 1.0:
        raise ValueError(f"slowest must lie in [0, 1), got {slowest}")
    if not 1.0 <= maximum < math.inf:
        raise ValueError(f"fastest must be finite and at least 1, got {fastest}")
    return minimum, maximum, inner


def _check_signals(inputs: Sequence[str], outputs: Sequence[str]) -> None:
    if not inputs:
        raise ValueError("limits or errors must name a signal that slows the plan, got none")
    both = [label for label in inputs if label in outputs or inputs.count(label) > 1]
    if both:
        raise ValueError(f"inputs and outputs must have different names, got {', '.join(both)} twice")


def _series(plan: Trajectory, t: Value, order: int) -> list[list[Value]]:
    """Taylor series of a plan; nan at a time that is not finite."""
    if isinstance(t, float) and not math.isfinite(t):
        return [[math.nan] * (order + 1)] * plan.naxes
    return plan.series(t, order)


def _shortest_move(plan: Trajectory) -> float:
    """Shortest duration [s] of a motion of the plan between two dwells."""
    durations, shortest, lasted = np.diff(plan.breakpoints), math.inf, 0.0
    inside = plan.breakpoints[:-1, None] + durations[:, None] * np.array([0.13, 0.37, 0.61, 0.89])
    moving = np.append(plan.jet(inside, 2)[1:].any(axis=(0, 1, 3)), False)
    for moves, duration in zip(moving.tolist(), np.append(durations, 0.0).tolist(), strict=True):
        lasted += duration if moves else 0.0
        if not moves and lasted:
            shortest, lasted = min(shortest, lasted), 0.0
    return shortest


def _rate_weights(n: int, w: float) -> list[list[float]]:
    """Derivatives 0, 1, ... of -slow[n] as combinations of slow[1], ..., slow[n]."""
    row, rows = np.eye(n)[-1] * -1.0, []
    for _ in range(n):
        rows.append(row.tolist())
        row = w * (np.append(row[1:], 0.0) - row)
    return rows


def _nearness(value: Value, low: float, high: float, reach: float) -> Value:
    """0 at a distance of `reach` or more inside the limits, 1 at a limit."""
    distance = np.fmin(value - low, high - value)
    return 1.0 - distance / reach


def _checked_limits(pair: Range, label: str, margin: float) -> tuple[float, float, float]:
    """Limits, and the distance from them over which the rate decreases."""
    low, high, size = checked_limits(pair, f"limits of {label}")
    both = math.isfinite(low) and math.isfinite(high)
    if not both and 0.0 in (low, high):
        raise ValueError(f"limits of {label} must contain a finite one that is not 0, got {low:g} and {high:g}")
    return low, high, margin * (2.0 * size if both else size)


def _checked_band(pair: Sequence[float], label: str, axes: Sequence[str]) -> tuple[float, float]:
    if label not in axes:
        raise ValueError(f"errors must name axes of the plan, {', '.join(axes)}, got {label!r}")
    soft, hard = checked_pair(pair, f"errors of {label}")
    if not 0.0 <= soft < hard < math.inf:
        raise ValueError(f"errors of {label} must be finite and at least 0, got {soft:g} and {hard:g}")
    return soft, hard


def _lags(n: int, w: float) -> list[float]:
    """Coefficients of (s/w + 1)^n, highest first."""
    return [math.comb(n, k) / w**k for k in range(n, -1, -1)]
