"""Loops of flat plants: the plan, a law as a value, and the plant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import control as ct
import control.flatsys as fs
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

from ctrlplan._checks import check_kind, check_signals, checked_vector, real_array
from ctrlplan._display import Displayed, Facts, Part, time_text
from ctrlplan._types import Array, EventName, Params, Value
from ctrlplan.flatness import DerivedFlatSystem, FlatSystem, flat_system
from ctrlplan.systems.derived_laws import InputLimits, create_derived_law, input_bounds
from ctrlplan.systems.flat import create_flat_iosystem, derived_system_of
from ctrlplan.systems.source import create_source_iosystem, switches_of
from ctrlplan.traits import declare, traits_of
from ctrlplan.trajectories import PathPlan, Trajectory
from ctrlplan.trajectories.trajectory import check_end

_CHECKED = 401
"""Times along a plan at which a law without states must be regular."""

_SETTLED = 1e-9
"""Size of the rates at the end of a plan, relative to their terms, below which the plant rests there."""

_DECAYING = 1e-11
"""Decay rate of a stationary regulator, relative to its fastest pole, up to which it is due to rounding."""


@dataclass(frozen=True, repr=False)
class FlatLaw(Displayed):
    """Flat tracking law as a value; see `create_flat_iosystem`.

    Attributes
    ----------
    poles : sequence of sequences of complex
        Poles [rad/s] of the tracking error of each flat output.
    quasi_static : bool
        Whether the law has no states of the extension.
    integral : bool
        Whether the law contains the integral of each error.
    """

    poles: Sequence[Value]
    quasi_static: bool = False
    integral: bool = False

    def create(self, flat: FlatSystem, plan: Trajectory, limits: InputLimits | None) -> ct.NonlinearIOSystem:
        """Block of the law, its extension at the start of the plan."""
        if isinstance(plan, PathPlan):
            stops = ", ".join(f"{time_text(time)} s" for time in plan.stops)
            raise ValueError(
                f"law must be a Feedforward or TVLQR for a PathPlan, got a FlatLaw: it computes inputs of {flat.name} "
                f"from positions and their derivatives, which do not determine them at the stops, at {stops}"
            )
        derived = derived_system_of(flat, self.quasi_static or self.integral or limits is not None)
        if derived is None:
            return create_flat_iosystem(flat, self.poles, labels=flat.flat_labels, name="law")
        start = None if self.quasi_static else derived.extension_along(plan, plan.start)
        if self.quasi_static and derived.extension:
            from ctrlplan.flatness.feedback import check_law_along

            times = np.linspace(plan.start, plan.end, _CHECKED)
            check_law_along(derived.analysis, derived.extended_along(plan, times), times, str(flat.name))
        return create_derived_law(
            derived,
            self.poles,
            quasi_static=self.quasi_static,
            integral=self.integral,
            start=start if derived.extension else None,
            labels=flat.flat_labels,
            suffix="_ref",
            name="law",
            limits=limits,
        )

    def _describe(self) -> Iterator[Part]:
        yield f"FlatLaw with the poles {', '.join(map(str, self.poles))}"
        yield Facts([("quasi-static", str(self.quasi_static)), ("integral action", str(self.integral))])


@dataclass(frozen=True)
class Feedforward:
    """Inputs along the plan without feedback."""

    def create(self, flat: FlatSystem, plan: Trajectory, limits: InputLimits | None) -> ct.NonlinearIOSystem:
        """Block of the inputs as functions of time."""

        def output(t: float, x: Value, u: Value, params: Params) -> Value:
            return clipped(flat.states_and_inputs(plan, t)[1])

        clipped = _clipping(flat, limits)
        block = ct.nlsys(None, output, inputs=0, outputs=list(flat.input_labels), name="law")
        return declare(block, **switches_of(plan))


@dataclass(frozen=True, repr=False, eq=False)
class TVLQR(Displayed):
    r"""Time-varying linear quadratic regulator along a plan.

    The control is u_d - R^-1 B' P (x - x_d), with

    .. math:: -P' = A'P + P A - P B R^{-1} B' P + Q, \quad P(T) = P_T

    and A, B the linearisation along the plan. For the linearised plant it minimises
    the integral of e'Q e + v'R v, v the feedback, plus e'P_T e at the end. After the
    end of the plan the stationary gain there is used.

    Attributes
    ----------
    Q, R : array_like, shapes (nstates, nstates) and (ninputs, ninputs)
        Weights of errors and of feedback.
    final : array_like, shape (nstates, nstates), optional
        P_T. Default: the stationary solution at the end of the plan, where one
        exists; a vehicle at rest has none.
    """

    Q: ArrayLike
    R: ArrayLike
    final: ArrayLike | None = None

    def _describe(self) -> Iterator[Part]:
        yield "TVLQR: gains from a Riccati equation along the plan"
        final = "stationary" if self.final is None else "given"
        yield Facts(
            [("Q", str(np.asarray(self.Q).tolist())), ("R", str(np.asarray(self.R).tolist())), ("final", final)]
        )

    def gains(self, flat: FlatSystem, plan: Trajectory) -> tuple[Value, Array]:
        """Gain within the plan as a function of time, and after its end.

        Both (ninputs, nstates).

        Raises
        ------
        ImportError
            If the Jacobians of the flat system must be derived without the extra ``fast``.
        ValueError
            If weights have wrong shapes or are not positive, or `final` is required.
        """
        flat = flat.derived
        check_end(plan)
        n, m = flat.nstates, flat.ninputs
        q, r = _weight(self.Q, "Q", n, strict=False), _weight(self.R, "R", m, strict=True)
        inverse = np.linalg.inv(r)

        def slopes(t: float) -> tuple[Array, Array]:
            x, u = flat.states_and_inputs(plan, t)
            return flat.linearised(x, u)

        a, b = slopes(plan.end)
        stationary = _stationary(a, b, q, r) if self._rests(flat, plan) else None
        last = stationary if self.final is None else _weight(self.final, "final", n, strict=False)
        if last is None:
            raise ValueError(
                f"final must be given for {flat.name}: there is no stationary gain at the end of the plan, since the "
                "plant is not at rest there or not stabilisable"
            )

        def rate(t: float, flat_p: Array) -> Array:
            a, b = slopes(t)
            p = flat_p.reshape(n, n)
            found = a.T @ p + p @ a - p @ b @ inverse @ b.T @ p + q
            return np.asarray(-found.ravel(), dtype=float)

        solution = solve_ivp(
            rate,
            (plan.end, plan.start),
            np.ravel(last),
            rtol=1e-8,
            atol=1e-10 * max(1.0, float(np.abs(last).max())),
            dense_output=True,
            method="LSODA",
        )
        if not solution.success:
            raise ValueError(
                f"the Riccati equation of {flat.name} must have a solution along the plan: {solution.message}"
            )

        def gain(t: float) -> Array:
            p = solution.sol(t).reshape(n, n)
            return np.asarray(inverse @ slopes(t)[1].T @ p, dtype=float)

        after = np.zeros((m, n)) if stationary is None else inverse @ b.T @ stationary
        return gain, after

    def create(self, flat: FlatSystem, plan: Trajectory, limits: InputLimits | None) -> ct.NonlinearIOSystem:
        """Block of the law."""
        gain, after = self.gains(flat, plan)
        clipped = _clipping(flat, limits)

        def output(t: float, x: Value, u: Value, params: Params) -> Value:
            states, inputs = flat.states_and_inputs(plan, t)
            k = after if t > plan.end else gain(max(t, plan.start))
            return clipped(inputs - k @ (np.asarray(u) - states))

        states = list(flat.state_labels)
        block = ct.nlsys(None, output, inputs=states, outputs=list(flat.input_labels), name="law")
        return declare(block, breakpoints=plan.breakpoints)

    def _rests(self, flat: DerivedFlatSystem, plan: Trajectory) -> bool:
        """Whether the plant is at rest at the end of the plan."""
        x, u = flat.states_and_inputs(plan, plan.end)
        rates = np.abs(np.asarray(flat.dynamics(0.0, x, u), dtype=float))
        a, b = flat.linearised(x, u)
        terms = np.abs(a) @ (np.abs(x) + flat.maps.scales[: flat.nstates]) + np.abs(b) @ (np.abs(u) + 1.0)
        return bool((rates <= _SETTLED * terms).all())


FlatLoopLaw = FlatLaw | Feedforward | TVLQR
"""Laws of `flat_loop`."""


def flat_loop(
    flat: fs.FlatSystem,
    plan: Trajectory,
    *,
    poles: Sequence[Value] | None = None,
    law: FlatLoopLaw | None = None,
    limits: InputLimits | None = None,
    initial_state: ArrayLike | None = None,
    disturbances: Sequence[str] | str | None = None,
) -> ct.InterconnectedSystem:
    """Loop of a flat plant that follows a plan of its flat outputs.

    Parameters
    ----------
    flat : FlatSystem
        The plant.
    plan : Trajectory
        Plan of the flat outputs; for a vehicle that stops a `PathPlan`, with the laws
        Feedforward and TVLQR.
    poles : sequence of sequences of complex, optional
        Short form of ``law=FlatLaw(poles)``.
    law : FlatLaw, Feedforward or TVLQR, optional
        The law. One of `poles` and `law` is required.
    limits : mapping of str to pair of float, optional
        Limits of inputs of the plant by name: they are saturated. The states of a
        `FlatLaw` follow what is applied; see `create_flat_iosystem`.
    initial_state : array_like, shape (nstates,), optional
        Initial state of the plant. Default: that of the plan at its start.
    disturbances : sequence of str or str, optional
        Parameters of the plant, such as inputs that are constant for the maps
        (wind), that become inputs of the loop. Only with flat systems from equations.

    Returns
    -------
    control.InterconnectedSystem
        Outputs: the flat outputs, the states, the outputs and the inputs of the
        plant. The initial state is declared.

    Raises
    ------
    TypeError, ValueError
        If arguments are wrong, the plan is a step, or the states along it are not
        determined.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> motor = cp.plants.dc_motor()
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)], labels="angle")
    >>> loop = cp.flat_loop(motor, plan, poles=[-20, -25, -30])
    >>> found = cp.simulate(loop, [0.0, 0.5, 1.0])
    >>> found.outputs["angle"].round(6).tolist()
    [0.0, 1.0, 2.0]
    """
    flat = _own(flat)
    check_kind(plan, "plan", Trajectory)
    if (poles is None) == (law is None):
        raise TypeError("one of poles and law must be given, got " + ("neither" if law is None else "both"))
    chosen = FlatLaw(poles) if poles is not None else law
    if not isinstance(chosen, FlatLaw | Feedforward | TVLQR):
        raise TypeError(f"law must be a FlatLaw, Feedforward or TVLQR, got {type(chosen).__name__}")
    axes = flat.matched(plan)
    _check_no_step(axes, flat)
    plant = _limited(_plant(flat, disturbances), flat, limits)
    controller = chosen.create(flat, axes, limits)
    blocks = [controller, plant]
    unused: list[str] = []
    if isinstance(chosen, FlatLaw):
        source = create_source_iosystem(axes, max(flat.orders), labels=flat.flat_labels, suffix="_ref", name="plan")
        blocks.insert(0, source)
        unused = [f"plan.{label}" for label in source.output_labels if label not in controller.input_labels]
    names = [*plant.output_labels, *flat.input_labels]
    loop = ct.interconnect(
        blocks,
        inputs=list(plant.input_labels)[flat.ninputs :] or 0,
        outputs=list(dict.fromkeys(names)),
        name=f"{flat.name}_loop",
        ignore_outputs=unused,
    )
    _check_limits(flat, axes, limits)
    first = flat.states_and_inputs(axes, plan.start)[0] if initial_state is None else initial_state
    own = traits_of(controller).initial_state if controller.nstates else None
    start = checked_vector(first, "initial_state", flat.nstates) if np.ndim(first) else _wrong_state(first, flat)
    return declare(loop, initial_state=np.concatenate([np.zeros(0) if own is None else own, start]))


def _check_no_step(plan: Trajectory, flat: FlatSystem) -> None:
    """Raise for a plan whose position jumps."""
    for jump in plan.jumps(0)[:1]:
        raise ValueError(
            f"plan must be continuous for a law of {flat.name}, got a step of {jump.label} by {jump.size:.4g} at "
            f"{time_text(jump.time)} s; give a plan at rest at the goal, and initial_state= from which it is approached"
        )


def _check_limits(flat: FlatSystem, plan: Trajectory, limits: InputLimits | None) -> None:
    """Raise if an input with which the plant rests at an end of the plan is beyond its limits."""
    bounds = input_bounds(limits, flat)
    if bounds is None:
        return
    for time in (plan.start, plan.end):
        if plan.jet(time, 2)[1:].any():
            continue
        u = flat.states_and_inputs(plan, time)[1]
        slack = 1e-9 * np.abs(u)
        for name, value, low, high, room in zip(flat.input_labels, u, *bounds, slack, strict=True):
            if not low - room <= value <= high + room:
                raise ValueError(
                    f"limits[{name!r}] must contain the input with which {flat.name} is at rest at {time:g} s, "
                    f"{value:.6g}, got {low:g} to {high:g}"
                )


def _own(flat: fs.FlatSystem) -> FlatSystem:
    """Flat system of this package for one of python-control."""
    if isinstance(flat, fs.LinearFlatSystem):
        return flat_system(flat, list(flat.output_labels))
    if isinstance(flat, fs.FlatSystem) and not isinstance(flat, FlatSystem):
        return derived_system_of(flat, True) or flat
    check_kind(flat, "flat", FlatSystem, "a flat system")
    return flat


def _wrong_state(given: Value, flat: FlatSystem) -> Array:
    raise ValueError(f"initial_state must have the shape ({flat.nstates},), got {given!r:.40}")


def _limited(plant: ct.NonlinearIOSystem, flat: FlatSystem, limits: InputLimits | None) -> ct.NonlinearIOSystem:
    """The plant with limits of its inputs declared, which reports state."""
    bounds = input_bounds(limits, flat)
    if bounds is None:
        return plant
    rows = zip(flat.input_labels, *(side.tolist() for side in bounds), strict=True)
    watched = {
        EventName(label, "was at its limit"): (partial(_input, k), low, high)
        for k, (label, low, high) in enumerate(rows)
        if math.isfinite(low) or math.isfinite(high)
    }
    return declare(plant, watched=watched)


def _input(k: int, t: Value, x: Value, u: Value, params: Params) -> Value:
    return u[k]


def _clipping(flat: FlatSystem, limits: InputLimits | None) -> Callable[[Array], Array]:
    """Function that limits the inputs of a plant."""
    bounds = input_bounds(limits, flat)
    return (lambda values: values) if bounds is None else (lambda values: np.clip(values, *bounds))


def _plant(flat: FlatSystem, disturbances: Sequence[str] | str | None) -> ct.NonlinearIOSystem:
    """The plant with its flat outputs and states among its outputs, and disturbances among its inputs."""
    wanted = [disturbances] if isinstance(disturbances, str) else list(disturbances or [])
    if wanted:
        check_signals(wanted, "disturbances", tuple(flat.params), "parameter")
    labels, states, measured = flat.flat_labels, list(flat.state_labels), list(flat.output_labels)
    names = list(dict.fromkeys([*labels, *states, *measured]))
    # Functions and numbers only: a block that refers to other objects cannot be compiled.
    count, known_params, rates, outputs, flat_map = (
        flat.ninputs,
        dict(flat.params),
        flat.updfcn,
        flat.outfcn,
        flat.flat_map,
    )

    def own(u: Value, params: Params) -> dict[str, Value]:
        return {**known_params, **params, **dict(zip(wanted, u[count:], strict=True))}

    def update(t: float, x: Value, u: Value, params: Params) -> Value:
        return rates(t, x, u[:count], own(u, params))

    def output(t: float, x: Value, u: Value, params: Params) -> Value:
        given = own(u, params)
        known = dict(zip(states, x, strict=True))
        known |= dict(zip(measured, outputs(t, x, u[:count], given), strict=True))
        if not set(labels) <= set(known):
            known |= dict(zip(labels, flat_map(t, x, u[:count], given), strict=True))
        return [known[name] for name in names]

    return ct.nlsys(
        update, output, states=states, inputs=[*flat.input_labels, *wanted], outputs=names, name=str(flat.name)
    )


def _weight(matrix: ArrayLike, name: str, size: int, *, strict: bool) -> Array:
    """Symmetric weight, positive definite if `strict`, otherwise semidefinite."""
    found = real_array(matrix, name)
    if found.shape != (size, size):
        raise ValueError(f"{name} must be a symmetric matrix of shape ({size}, {size}), got shape {found.shape}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must be finite, got nan or inf")
    excess = np.abs(found - found.T) - 1e-9 * np.abs(found).max()
    if (excess > 0.0).any():
        i, j = divmod(int(excess.argmax()), size)
        raise ValueError(
            f"{name} must be symmetric, got {found[i, j]:.6g} at [{i}, {j}] and {found[j, i]:.6g} at [{j}, {i}]; give "
            f"({name} + {name}.T) / 2"
        )
    smallest = float(np.linalg.eigvalsh(found)[0])
    if smallest < 0.0 - 1e-12 * float(np.abs(found).max()) or (strict and smallest <= 0.0):
        raise ValueError(
            f"{name} must be positive {'definite' if strict else 'semidefinite'}, got eigenvalue {smallest:.4g}"
        )
    return found


def _stationary(a: Array, b: Array, q: Array, r: Array) -> Array | None:
    """Stationary solution of the Riccati equation; None if there is none."""
    try:
        found = np.asarray(solve_continuous_are(a, b, q, r), dtype=float)
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.isfinite(found).all():
        return None
    # A vehicle that stops has a speed of 1e-15 by rounding: its poles then are no faster than that.
    closed = np.linalg.eigvals(a - b @ np.linalg.solve(r, b.T @ found))
    return found if (closed.real < -_DECAYING * np.abs(closed).max()).all() else None
