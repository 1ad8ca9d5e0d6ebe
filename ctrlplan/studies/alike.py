"""Linear loops that differ in numbers alone, solved and measured together."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctrlplan._checks import real_array
from ctrlplan.simulation import rest_state, state_space, stated_start
from ctrlplan.simulation.exact import exact_states
from ctrlplan.simulation.linear import LinearForm, in_right_half, linear_form
from ctrlplan.studies.comparison import acting_outputs, checked_start, compare, is_builder, tracked_outputs
from ctrlplan.studies.measures import MEASURES, control_metrics, path_metrics, response_metrics
from ctrlplan.trajectories import Trajectory

Array = NDArray[np.float64]
Metrics = dict[str, dict[str, float]]
"""Plan, metric, value."""

_SAMPLES = 2**19
"""Samples of a signal of all the loops that are taken together, at most."""

_FIRST = 4
"""Loops that are taken together at first; then twice as many each time, so that an interruption loses little."""

_MEASURED = ("plans", "timepts", "outputs", "controls", "waypoints", "initial_state", "band", "start", "only")
_WITHOUT_EFFECT = ("alpha", "title", "parameters")
_SHARED = {"loop", *_MEASURED, *_WITHOUT_EFFECT}
"""Arguments of `compare` that are used here; with any other each loop must be compared by itself."""


@dataclass(frozen=True, eq=False)
class Linear:
    """A linear loop as it was when it was built: a builder may change it for the next value.

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


class Alike:
    """Loops that wait to be measured together, as `compare` measures each.

    Parameters
    ----------
    given : mapping
        Arguments of `compare` but the loop. With some of them no loop is
        accepted: each must then be compared by itself.

    Attributes
    ----------
    waiting : dict of int to Linear
        By the number of the loop.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        signature = inspect.signature(compare)
        bound = signature.bind(None, **given)
        bound.apply_defaults()
        self._given = SimpleNamespace(**bound.arguments)
        own = [name for name in signature.parameters if name not in _SHARED]
        self._possible = _ordered(self._given.timepts) and all(
            bound.arguments[name] is signature.parameters[name].default for name in own
        )
        self._size, self._most = _FIRST, max(2, _SAMPLES // max(1, self._given.timepts.size))
        plans, begin = self._given.plans, self._given.timepts[:1]
        self._held = {k: plan.jet(begin, 0, left=True)[0, :, 0] for k, plan in plans.items()} if self._possible else {}
        self._first = next(iter(plans.values()))
        self.waiting: dict[int, Linear] = {}

    @property
    def full(self) -> bool:
        """Whether as many wait as are taken together."""
        return len(self.waiting) >= self._size

    def linear(self, loop: Any) -> Linear | None:
        """The numbers of a loop; None where it cannot be measured together with others."""
        if not self._possible or is_builder(loop):
            return None
        try:
            system = state_space(loop)
            form, stated = linear_form(system), stated_start(system)
            if form.sources or stated is not None or form.b.shape[1] != self._first.naxes:
                return None
            tracked = tracked_outputs(system, self._given.outputs, self._first)
            acting = acting_outputs(system, self._given.controls)
            starts = self._starts(system)
        except (AttributeError, TypeError, ValueError):  # what is wrong is for `compare` to say
            return None
        if self._given.initial_state is None and not self._at_rest(form, starts):
            return None  # which is to be said of the loop concerned
        if any(form.sensitivity(float(self._given.timepts[-1] - self._given.timepts[0]))):
            return None  # `simulate` says which digits are lost
        return Linear(tuple(system.output_labels), tracked, acting, form, starts)

    def _starts(self, system: Any) -> dict[str, Array]:
        """States at the first sample by plan: as given, or at rest where the plan is."""
        initial = self._given.initial_state
        if initial is not None:
            state = np.broadcast_to(real_array(initial, "initial_state"), (system.nstates,))
            return dict.fromkeys(self._held, state)
        return {name: rest_state(system, position) for name, position in self._held.items()}

    def _at_rest(self, form: LinearForm, starts: Mapping[str, Array]) -> bool:
        """Whether states are equilibria with the plans held at their first positions."""
        for name, position in self._held.items():
            moved = form.a @ starts[name] + form.b @ position
            terms = np.abs(form.a) @ np.abs(starts[name]) + np.abs(form.b) @ np.abs(position)
            if np.any(np.abs(moved) > 1e-6 * terms.max(initial=0.0)):
                return False
        return True

    def fits(self, linear: Linear) -> bool:
        """Whether a loop differs from those that wait in numbers alone."""
        other = next(iter(self.waiting.values()), linear)
        same = (getattr(other.form, name).shape == getattr(linear.form, name).shape for name in "abcd")
        return other.labels == linear.labels and all(same)

    def clear(self) -> None:
        """Begin again, with twice as many."""
        self.waiting, self._size = {}, min(2 * self._size, self._most)

    def metrics(self) -> dict[int, Metrics]:
        """Metrics of those that wait, by their numbers."""
        loops = list(self.waiting.values())
        return dict(zip(self.waiting, _metrics(self._given, loops), strict=True)) if loops else {}


def _metrics(given: Any, loops: list[Linear]) -> list[Metrics]:
    """What `compare` finds of each loop."""
    plans, times, labels = given.plans, given.timepts, list(loops[0].labels)
    first, tracked, acting = next(iter(plans.values())), loops[0].tracked, loops[0].acting
    if given.only is not None and not any(name.startswith("control") for name in given.only):
        acting = ()
    rows = [labels.index(name) for name in (*tracked, *acting)]
    start = checked_start(given.start, plans.values(), times)
    a, b, c, d = (np.stack([getattr(loop.form, name) for loop in loops]) for name in "abcd")
    form = LinearForm(a, b, c, d, ())
    unstable = in_right_half(np.linalg.eigvals(form.a)).any(axis=1)
    each = tuple(map(str, range(len(loops))))
    found: list[Metrics] = [{} for _ in loops]
    for name, plan in plans.items():
        initial = np.stack([loop.starts[name] for loop in loops])
        signals = _outputs(form, rows, plan, times, initial).swapaxes(0, 1)
        axes = [plan] if plan.naxes == 1 else [plan.select([label]) for label in plan.labels]
        # One axis of all loops is measured like the axes of one.
        responses = [
            response_metrics(times, y, axis, start, given.band, each, given.only)
            for y, axis in zip(signals[: len(axes)], axes, strict=True)
        ]
        controls = [control_metrics(times, u, start, each, given.only) for u in signals[len(axes) :]]
        values = _of_loops(responses, first.labels, each)
        values |= {key: np.where(unstable, np.inf, row) for key, row in values.items() if "settling_time" in key}
        values |= _of_loops(controls, acting, each)
        of_plan = path_metrics(plan, given.waypoints, given.only)
        for i, metrics in enumerate(found):
            metrics[name] = {key: float(row[i]) for key, row in values.items()} | of_plan
    return found


def _ordered(times: Array) -> bool:
    return times.ndim == 1 and times.size > 1 and bool(np.isfinite(times).all() and np.all(np.diff(times) > 0.0))


def _of_loops(measured: list[dict[str, float]], labels: Sequence[str], each: Sequence[str]) -> dict[str, Array]:
    """Metrics (nloops,) as `compare` names them, from those of each label: the worst, and each where there are more."""
    names = [name for name in measured[0] if name in MEASURES] if measured else []
    # Of one loop alone there is the worst, which it is.
    keys = {name: [f"{name}_{i}" for i in each] if len(each) > 1 else [name] for name in names}
    rows = {name: np.array([[found[key] for key in keys[name]] for found in measured]) for name in names}
    worst = {name: np.fmax.reduce(row) for name, row in rows.items()}
    if len(labels) > 1:
        for name, row in rows.items():
            worst |= {f"{name}_{label}": values for label, values in zip(labels, row, strict=True)}
    return worst


def _outputs(form: LinearForm, rows: list[int], plan: Trajectory, times: Array, initial: Array) -> Array:
    """Some of the outputs, shape (nloops, nrows, ntime), with a plan at the inputs."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = exact_states(form.a, form.b, plan._jet_beside, list(plan.breakpoints), times, initial, form.c[:, rows])
        for k, row in enumerate(rows):
            if form.d[:, row].any():
                out[:, k] += form.d[:, row] @ plan.jet(times, 0)[0]
    if not np.isfinite(out[..., -1]).all():  # what has left the range of numbers does not come back
        out[np.isnan(out)] = np.inf
    return out
