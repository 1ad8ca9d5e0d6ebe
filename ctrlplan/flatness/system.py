"""Flat systems with named flat outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import control.flatsys as fs
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import (
    check_kind,
    checked_labels,
    checked_params,
    checked_timepts,
    default_labels,
    finite_vector,
    real_array,
)
from ctrlplan._display import Displayed, Facts, Part, time_text
from ctrlplan._lru import Lru
from ctrlplan._types import Array, Value
from ctrlplan.flatness.on_path import (
    FORWARD,
    CurveMap,
    PathMaps,
    along_formulas,
    pace_degrees,
    reject_path,
    states_on_path,
)
from ctrlplan.flatness.rest import ADVICE, note_of_rest, time_of_rest
from ctrlplan.flatness.verify import checked_plant, random_probes, undetermined_at_rest
from ctrlplan.trajectories import PathPlan, Trajectory
from ctrlplan.trajectories.repeated import jumps_until

if TYPE_CHECKING:
    from ctrlplan.flatness.derived import DerivedFlatSystem

Params = Mapping[str, float] | None
Flag = Sequence[Array]


class FlatSystem(Displayed, fs.FlatSystem):  # type: ignore[misc]
    """Flat system with named flat outputs and vectorised maps.

    A `control.flatsys.FlatSystem`: `forward` and `reverse` can be used by
    `control.flatsys.point_to_point`, and the system can be simulated and
    interconnected as any other. `ctrlplan.fastest` and `ctrlplan.margins` accept
    it as ``system=``.

    Parameters
    ----------
    forward : callable
        ``forward(x, u, params) -> flag``, the inputs held constant: for each
        flat output y_j, ..., y_j^(r_j), shape (r_j + 1,).
    reverse : callable
        ``reverse(flag, params) -> (x, u)``. Rows of the flag have the shape
        (r_j + 1, ...), x (nstates, ...) and u (ninputs, ...): the trailing axes
        are times, all mapped by one call.
    updfcn, outfcn : callable
        As in `control.nlsys`.
    orders : sequence of int
        r_j of each flat output, the highest derivative that `reverse` uses.
    flat_labels : sequence of str
        Names of the flat outputs.
    states, inputs, outputs : sequence of str
        Names of the signals.
    name : str
        Name of the system.
    quantities : callable, optional
        Replaces the method `quantities`, for signals in addition to states and
        inputs.
    params : mapping of str to float, optional
        Default parameters.

    Attributes
    ----------
    orders : tuple of int
        r_j of each flat output, of sum ``nstates + extension``.
    extension : int
        Number of states of the dynamic extension: 0 if static feedback
        linearises the system.
    flat_labels : tuple of str
        Names of the flat outputs, in the order of the flag.

    Raises
    ------
    ValueError
        If the number of orders or labels differs from that of inputs, or the sum
        of the orders is less than the number of states.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> flat = cp.plants.Crane().flat_system()
    >>> flat.orders, flat.extension, flat.flat_labels
    ((4, 4), 2, ('x', 'z'))
    >>> plan = cp.PolySpline([
    ...     cp.Waypoint.from_jets(0.0, x=[0, 0, 0, 0, 0], z=[10, 0, 0, 0, 0]),
    ...     cp.Waypoint.from_jets(15.0, x=[20, 0, 0, 0, 0], z=[11, 0, 0, 0, 0]),
    ... ])
    >>> x, u = flat.states_and_inputs(plan, [0.0, 7.5, 15.0])
    >>> x.shape, u.shape, u[:, 0].tolist()
    ((6, 3), (2, 3), [0.0, -1226.25])
    """

    orders: tuple[int, ...]
    extension: int
    flat_labels: tuple[str, ...]

    _paces: ClassVar[tuple[float, ...]] = (*FORWARD, -1.0)  # maps by formulas are those of forward travel

    def __init__(
        self,
        forward: Callable[..., Flag],
        reverse: Callable[..., tuple[Array, Array]],
        updfcn: Callable[..., ArrayLike],
        outfcn: Callable[..., ArrayLike],
        *,
        orders: Sequence[int],
        flat_labels: Sequence[str],
        states: Sequence[str],
        inputs: Sequence[str],
        outputs: Sequence[str],
        name: str,
        quantities: Callable[[ArrayLike], dict[str, Array]] | None = None,
        params: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(
            forward,
            reverse,
            updfcn,
            outfcn,
            states=list(states),
            inputs=list(inputs),
            outputs=list(outputs),
            name=name,
            params=checked_params(params),
        )
        self.orders = tuple(orders)
        self.extension = sum(self.orders) - len(states)
        self.flat_labels = checked_labels(flat_labels, len(inputs))
        self._own_quantities = quantities
        self._paths: Lru[tuple[object, ...], tuple[object, PathMaps]] = Lru(8)
        self._stops: Lru[tuple[int, float, float], tuple[Trajectory, float | None]] = Lru(8)
        if len(self.orders) != len(inputs) or min(self.orders) < 1:
            raise ValueError(f"orders must be one of at least 1 for each of {len(inputs)} inputs, got {self.orders}")
        if self.extension < 0:
            raise ValueError(
                f"orders must add up to at least the number of states, {len(states)}, got {sum(self.orders)}"
            )

    __repr__ = fs.FlatSystem.__repr__

    def __getstate__(self) -> dict[str, object]:
        """State for a copy or a pickle: derived maps are derived again."""
        return {name: value for name, value in self.__dict__.items() if name != "derived"}

    @cached_property
    def derived(self) -> DerivedFlatSystem:
        """Flat system derived from the equations of this one.

        For laws with a dynamic extension, and for Jacobians. Requires the extra ``fast``.
        """
        from ctrlplan.flatness.deriving import flat_system

        if set(self.flat_labels) <= {*self.output_labels, *self.state_labels}:
            return flat_system(self, self.flat_labels)
        return flat_system(self, lambda x, u, params: [row[0] for row in self.forward(x, u, params)])

    def _describe(self) -> Iterator[Part]:
        outputs = [f"{label} (derivatives up to {r})" for label, r in zip(self.flat_labels, self.orders, strict=True)]
        yield f"{type(self).__name__} {self.name} with flat outputs {', '.join(self.flat_labels)}"
        yield Facts(
            [
                ("flat outputs", ", ".join(outputs)),
                ("states", ", ".join(self.state_labels)),
                ("inputs", ", ".join(self.input_labels)),
                ("outputs", ", ".join(self.output_labels)),
                (
                    "dynamic extension",
                    f"{self.extension} states" if self.extension else "none",
                ),
                ("parameters", ", ".join(f"{name} = {value}" for name, value in self.params.items())),
            ]
        )

    def states_and_inputs(
        self, plan: Trajectory, timepts: ArrayLike, *, start: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """States and inputs along a plan of the flat outputs.

        Parameters
        ----------
        plan : Trajectory
            Plan of the flat outputs, assigned by name if its labels are those of
            the flat outputs, or in order if its labels are the defaults. Before
            its start and after its end the positions are constant. A vehicle that
            stops requires a `PathPlan`, of which the states are continuous and the
            inputs finite at the stops; its forward direction is that of the maps by
            formulas, or of the operating point.
        timepts : array_like, any shape
            Times [s], in any order.
        start : array_like, shape (nstates,), optional
            State at the plan's start, to select one of several states with the
            same flag. Closed-form maps, as those of the crane, have one branch
            and ignore it.

        Returns
        -------
        x : ndarray, shape (nstates, *timepts.shape)
            States, in the order of `state_labels`.
        u : ndarray, shape (ninputs, *timepts.shape)
            Inputs, in the order of `input_labels`.

        Raises
        ------
        TypeError
            If `plan` is not a trajectory.
        ValueError
            If the plan's labels are not those of the flat outputs, a derivative
            below r_j jumps between the times, `start` has a wrong shape, or the
            maps are singular. The message states the signal and the time. If `plan`
            is a `PathPlan` and the rates of the plant are not proportional to some
            of its inputs, or states differ where its segments join.
        """
        plan, times = self._along(plan, timepts, start)
        given = None if start is None else finite_vector(start, "start", str(self.nstates))
        if isinstance(plan, PathPlan):
            x, u = states_on_path(self.path_maps(plan, given), plan, times.ravel())
            self._check_determined(x, u, plan, times.ravel())
        else:
            x, u = self._states_and_inputs(plan, times.ravel(), given)
        shapes = (self.nstates, *times.shape), (self.ninputs, *times.shape)
        return np.asarray(x).reshape(shapes[0]), np.asarray(u).reshape(shapes[1])

    def _states_and_inputs(self, plan: Trajectory, times: Array, start: Array | None) -> tuple[Array, Array]:
        """States and inputs at times (n,) of a plan in time."""
        jet = plan.jet(times, max(self.orders))
        x, u = self.reverse([jet[: r + 1, j] for j, r in enumerate(self.orders)], self.params)
        self._check_determined(x, u, plan, times)
        self._check_moving(plan, times)
        return x, u

    def path_maps(self, plan: PathPlan, start: Array | None = None) -> PathMaps:
        """States and inputs along the curves of a path, for any time law.

        Raises
        ------
        ValueError
            If the inputs of the system do not set its pace, or states are not
            determined along a curve or not continuous at a stop.
        """
        if not self.pace_degrees:
            reject_path(plan, str(self.name))
        key = (
            *map(id, plan.segments),
            plan.directions,
            *self.params.items(),
            None if start is None else start.tobytes(),
        )

        def made() -> tuple[object, PathMaps]:
            maps = PathMaps(plan, self._curve_map, self.pace_degrees, self.orders, self.state_labels, start)
            return plan.segments, maps

        return self._paths.get(key, made)[1]

    @cached_property
    def pace_degrees(self) -> tuple[int, ...]:
        """Powers of the pace in the inputs; empty if they do not set it."""
        try:
            points = self._points()
        except ValueError:  # no point is known at which the maps are finite
            return ()
        return pace_degrees(lambda x, u: self.dynamics(0.0, x, u), points, self._paces)

    def _points(self) -> list[tuple[Array, Array]]:
        """States and inputs at which the equations are finite."""
        return [(probe.x, probe.u) for probe in random_probes(checked_plant(self))]

    def _curve_map(self, curve: Trajectory, direction: int, start: Array | None) -> tuple[CurveMap, int]:
        """Map along a curve at unit pace, and that pace; see `PathMaps`."""
        return along_formulas(lambda flag: self.reverse(flag, self.params), self.orders, direction)

    def quantities(self, jet: ArrayLike) -> dict[str, Array]:
        """Signals of the plant by name, from the jet of the flat outputs.

        Parameters
        ----------
        jet : array_like, shape (order + 1, nflat, ...)
            Derivatives of the flat outputs, up to the order max(orders) for
            inputs, or one less for states.

        Returns
        -------
        dict of str to ndarray, shape (...)
            States, inputs and additional signals of the plant; for a shorter jet
            those that are determined by it.

        Raises
        ------
        ValueError
            If the jet is too short or has another number of axes.
        """
        if self._own_quantities is not None:
            return self._own_quantities(jet)
        values, known = self._checked_jet(jet)
        x, u = self.reverse([values[: r + 1, j] for j, r in enumerate(self.orders)], self.params)
        found = self.signals(np.asarray(x), np.asarray(u))
        return found if known else {name: found[name] for name in self.state_labels}

    def signals(self, x: Array, u: Array) -> dict[str, Array]:
        """Signals by name from states and inputs, (n, ...) each."""
        return dict(zip([*self.state_labels, *self.input_labels], [*x, *u], strict=True))

    def _checked_jet(self, jet: ArrayLike) -> tuple[Array, bool]:
        """Jet up to the highest order, and whether its last derivatives are known; unknown ones are 0."""
        values = real_array(jet, "jet")
        highest, count = max(self.orders), len(self.orders)
        if values.ndim < 2 or len(values) < highest or values.shape[1] != count:
            raise ValueError(
                f"jet must have the shape (order + 1, {count}, ntime) with an order of {highest - 1} for states and "
                f"{highest} for inputs, got {values.shape}"
            )
        known = len(values) > highest
        if not known:  # states do not depend on the last derivatives
            values = np.concatenate([values, np.zeros((1, *values.shape[1:]))])
        return values, known

    def _along(self, plan: Trajectory, timepts: ArrayLike, start: ArrayLike | None) -> tuple[Trajectory, Array]:
        """Plan in the order of the flat outputs, and times, checked."""
        plan = self.matched(plan)
        times = checked_timepts(timepts)
        if not np.isfinite(times).all():
            raise ValueError("timepts must be finite, got inf")
        if start is not None and real_array(start, "start").shape != (self.nstates,):
            raise ValueError(f"start must have the shape ({self.nstates},), got {np.shape(start)}")
        if times.size and not isinstance(plan, PathPlan):
            self._check_smooth(plan, float(times.min()), float(times.max()))
        return plan, times

    @property
    def flat_map(self) -> Callable[..., Sequence[Value]]:
        """Flat outputs as a function of (t, x, u, params)."""
        forward = self.forward
        return lambda t, x, u, params: [row[0] for row in forward(x, u, params)]

    def matched(self, plan: Trajectory) -> Trajectory:
        """Plan with the axes in the order of the flat outputs.

        Raises
        ------
        TypeError, ValueError
            If `plan` is not a trajectory, or has other axes.
        """
        check_kind(plan, "plan", Trajectory)
        if plan.labels in (self.flat_labels, default_labels(len(self.flat_labels))):
            return plan
        if set(plan.labels) == set(self.flat_labels):
            return plan.select(self.flat_labels)
        raise ValueError(
            f"plan must have the axes {', '.join(self.flat_labels)}, the flat outputs of {self.name}, got "
            f"{', '.join(plan.labels)}"
        )

    def _check_smooth(self, plan: Trajectory, first: float, last: float) -> None:
        """Raise if a derivative below r_j jumps between two times."""
        order_of = dict(zip(plan.labels, self.orders, strict=True))
        for jump in jumps_until(plan, max(self.orders) - 1, first, last):
            # At inner breakpoints and the start the value is the right limit, at the end the left limit.
            between = first <= jump.time < last if jump.time == plan.end else first < jump.time <= last
            if between and jump.order < order_of[jump.label]:
                what = "position" if jump.order == 0 else f"derivative {jump.order}"
                raise ValueError(
                    f"plan must be continuous up to derivative {order_of[jump.label] - 1} of {jump.label} between "
                    f"the times given, got one whose {what} jumps by {jump.size:.4g} at {time_text(jump.time)} s"
                )

    def _check_determined(self, x: Array, u: Array, plan: Trajectory, times: Array) -> None:
        """Raise for states and inputs that the plan does not determine."""
        for label, row in zip([*self.state_labels, *self.input_labels], [*x, *u], strict=True):
            wrong = np.broadcast_to(~np.isfinite(row), times.shape)
            if wrong.any():
                k = int(wrong.argmax())
                time, value = float(times[k]), float(np.broadcast_to(row, times.shape)[k])
                raise ValueError(
                    f"{label} of {self.name} must be determined by the plan, got {value:g} at {time:.6g} s: the maps "
                    f"are singular there{note_of_rest(plan, time)}"
                )

    @cached_property
    def _undetermined(self) -> tuple[str, ...]:
        """States and inputs that the flat outputs do not determine at rest, although the maps may be finite there."""
        try:
            found = undetermined_at_rest(checked_plant(self), [r + 1 for r in self.orders])
        except (TypeError, ValueError):  # not in continuous time, or without states
            return ()
        names = [*self.state_labels, *self.input_labels]
        return tuple(name for name, wrong in zip(names, found, strict=True) if wrong)

    def _check_moving(self, plan: Trajectory, times: Array) -> None:
        """Raise if a plan stops between the times and the maps are singular at rest."""
        if not (times.size and self._undetermined):
            return
        key = (id(plan), float(times.min()), float(times.max()))
        time = self._stops.get(key, lambda: (plan, time_of_rest(plan, *key[1:])))[1]
        if time is not None:
            raise ValueError(
                f"{self._undetermined[0]} of {self.name} must be determined by the plan, got one that is at rest at "
                f"{time_text(time)} s: the maps are singular there; {ADVICE}"
            )
