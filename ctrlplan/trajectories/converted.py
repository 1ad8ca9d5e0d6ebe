"""Trajectories from splines of scipy and from results of python-control.

Objects of python-control are recognised by their attributes, so that this module
does not import it.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import MAXIMUM, checked_finite, checked_names, default_labels, real_array
from ctrlplan._display import time_text
from ctrlplan.trajectories.clipped import Clipped
from ctrlplan.trajectories.combined import stack
from ctrlplan.trajectories.common import FACTORIALS, Array
from ctrlplan.trajectories.piecewise_polynomial import PiecewisePolynomial
from ctrlplan.trajectories.polynomial import PolySpline
from ctrlplan.trajectories.trajectory import Trajectory
from ctrlplan.trajectories.trigonometric import TrigSpline
from ctrlplan.trajectories.waypoint import Waypoint

_SAME = 1e-9
"""Difference between plan and basis, relative to the sum of their terms, above which the basis is another one."""

_RESOLVED = 1e-6
"""Maximum deviation of interpolated states and inputs, relative to their range."""

_ROUNDING = 1e-12
"""Deviation relative to the largest of all signals that is attributed to rounding."""

_CONDITION = 3.0**6
"""Maximum sum of the magnitudes of all terms of a polynomial, relative to its Bernstein coefficients."""

_MAXIMUM_SAMPLES = 513
"""Maximum number of samples in a segment."""


def as_trajectory(
    obj: object,
    start: float | None = None,
    end: float | None = None,
    *,
    signals: Sequence[str] | str | None = None,
) -> Trajectory:
    """Trajectory from a spline of scipy or a plan of python-control.

    ================================================ =================================
    Object                                           Trajectory
    ================================================ =================================
    `scipy.interpolate.PPoly` with its subclasses    the same polynomials
    (`CubicSpline`, `PchipInterpolator`, ...),
    `BPoly`, `BSpline` (`make_interp_spline`)
    `control.flatsys.SystemTrajectory`               flat outputs, exact
    the same with `signals`                          states and inputs, interpolated
    `control.optimal.OptimalControlResult`           states and inputs, interpolated
    `Trajectory`                                     itself, or some of its axes
    ================================================ =================================

    Where signals are interpolated, the attribute `deviation` of the trajectory states
    their maximum deviation.

    Parameters
    ----------
    obj : object
        Spline with scalar or vector values, or a plan of python-control.
    start, end : float, optional
        Times [s] within the object. Default: all of it. Required for a
        SystemTrajectory in a `PolyFamily` or `BezierFamily`, which do not contain
        its times.
    signals : sequence of str, optional
        Names of the axes. For plans of python-control, names of states and inputs, or
        of flat outputs where the flat system names them (`flat_labels`); default: the
        flat outputs of a SystemTrajectory, the states of an OptimalControlResult. For
        splines, names for all axes.

    Returns
    -------
    Trajectory
        A PiecewisePolynomial for splines of scipy, B-splines of python-control and
        interpolated signals; a PolySpline or a TrigSpline for flat outputs in
        polynomials or in a `TrigFamily`, stacked if their numbers of functions differ;
        `Clipped` for a part of them. Each interval of a B-spline or a BPoly of a degree
        above 6 is divided into several segments, in which powers keep their digits.

    Raises
    ------
    TypeError
        If `obj` is none of these kinds.
    ValueError
        If times are missing or outside of the object, a signal is unknown, numbers
        are not finite or breakpoints do not increase; if the basis of a
        SystemTrajectory is of another kind; if the states or inputs of a
        SystemTrajectory are not resolved to 1e-6 of their range.

    Warns
    -----
    UserWarning
        If the optimisation of an OptimalControlResult was not successful.

    Notes
    -----
    The option `extrapolate` of a spline of scipy has no effect: as every trajectory, the
    result is constant before its start and after its end. Use ``.repeat(None)`` for a
    spline with ``extrapolate="periodic"``.

    Dots in names of states and inputs become underscores. States and inputs of a
    SystemTrajectory are interpolated by quintic splines in each segment of its
    basis; `deviation` is measured between the samples. States of an
    OptimalControlResult are interpolated by a cubic spline; they are known at its
    samples only, and `deviation` is the maximum error at every second sample if these
    are omitted. It does not contain the error of the optimisation itself, such as that
    of a collocation. Inputs are linear between samples, as python-control
    interpolates them, with a deviation of 0.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.interpolate import CubicSpline
    >>> plan = as_trajectory(CubicSpline([0.0, 1.0, 3.0], [0.0, 1.0, 0.0], bc_type="clamped"), signals="x")
    >>> plan.labels, plan.duration, plan([0.0, 1.0, 3.0]).round(12) + 0.0
    (('x',), 3.0, array([0., 1., 0.]))
    """
    begins = None if start is None else checked_finite(start, "start")
    finish = None if end is None else checked_finite(end, "end")
    names = None if signals is None else checked_names(signals, "signals")
    if names == []:
        raise ValueError("signals must name at least one signal, got none")
    plan: Trajectory
    if isinstance(obj, Trajectory):
        plan = obj if names is None else obj.select(names)
    elif _has(obj, "system", "basis", "coeffs", "flaglen", "eval"):
        plan = _of_flat(obj, begins, finish, names)
    elif _has(obj, "problem", "time", "states", "inputs"):
        plan = _of_optimal(obj, names)
    else:
        plan = _of_spline(obj, names)
    first, last = _part(obj, (plan.start, plan.end), begins, finish)
    return plan if (first, last) == (plan.start, plan.end) else Clipped(plan, first, last)


def _part(obj: object, known: tuple[float, float], start: float | None, end: float | None) -> tuple[float, float]:
    """Times given, or else those of an object, within which they must lie to rounding."""
    if start is None and end is None:
        return known
    near = 4.0 * float(np.spacing(np.abs(known).max()))
    first = known[0] if start is None or abs(start - known[0]) <= near else start
    last = known[1] if end is None or abs(end - known[1]) <= near else end
    if not known[0] <= first < last <= known[1]:
        raise ValueError(
            f"start and end must increase and lie within the {type(obj).__name__}, from {time_text(known[0])} s to "
            f"{time_text(known[1])} s, got {time_text(first)} s and {time_text(last)} s"
        )
    return first, last


def _has(obj: object, *names: str) -> bool:
    return all(hasattr(obj, name) for name in names)


# Splines of scipy


def _of_spline(obj: Any, names: list[str] | None) -> Trajectory:
    from scipy.interpolate import BPoly, BSpline, PPoly

    if isinstance(obj, BSpline):
        knots = real_array(obj.t, "knots")
        real_array(obj.c, "coefficients")
        times = _divided(np.unique(knots[obj.k : len(obj.c) + 1]), obj.k)
        table = np.moveaxis(_taylor(obj, times, obj.k), 1 + obj.axis, 1)
    elif isinstance(obj, BPoly):
        real_array(obj.c, "coefficients")
        degree = len(obj.c) - 1
        times = _divided(real_array(obj.x, "breakpoints"), degree)
        table = np.moveaxis(_taylor(obj, times, degree), 1 + obj.axis, 1)
    elif isinstance(obj, PPoly):
        times, table = real_array(obj.x, "breakpoints"), real_array(obj.c, "coefficients")
        lasting = np.diff(times) != 0.0  # PPoly.from_spline repeats knots
        times, table = np.append(times[:-1][lasting], times[-1]), table[:, lasting]
    else:
        raise TypeError(
            "obj must be a PPoly, BPoly or BSpline of scipy.interpolate, a SystemTrajectory of control.flatsys or an "
            f"OptimalControlResult of control.optimal, got {type(obj).__name__}; fit a spline to samples by "
            "scipy.interpolate.make_interp_spline first, or use BSpline(*tck) for a result of splrep"
        )
    if table.ndim > 3:
        raise ValueError(f"values of the spline must be numbers or vectors, got shape {table.shape[2:]}")
    return PiecewisePolynomial(times, table.reshape(*table.shape[:2], -1), labels=names)


def _divided(times: Array, degree: int) -> Array:
    """Times between which powers of a degree are conditioned as those of degree 6 are, with further ones if required.

    The sum of the magnitudes of all terms of a polynomial, in powers of the time since the start of a part, is up to
    (1 + 2 / parts)^degree times its Bernstein coefficients over the whole interval.
    """
    if degree > MAXIMUM:
        raise ValueError(f"degree of the spline must be at most {MAXIMUM}, got {degree}")
    parts = 1
    while (1.0 + 2.0 / parts) ** degree > _CONDITION:
        parts += 1
    inner = times[:-1, None] + np.diff(times)[:, None] * (np.arange(parts) / parts)
    times = np.append(inner, times[-1])
    return times[np.append(True, np.diff(times) != 0.0)]


def _taylor(spline: Any, times: Array, degree: int) -> Array:
    """Taylor coefficients (degree + 1, nsegments, ...) of a spline of scipy at the start of each segment."""
    return np.stack([spline(times[:-1], nu=k) / FACTORIALS[k] for k in range(degree, -1, -1)])


# Plans of control.flatsys


def _of_flat(obj: Any, start: float | None, end: float | None, names: list[str] | None) -> Trajectory:
    basis, system = obj.basis, obj.system
    whole = _interval(basis, start, end)
    first, last = _part(obj, whole, start, end)
    named = getattr(system, "flat_labels", None)
    flat = list(default_labels(system.ninputs) if named is None else map(_label, named))
    if names is None or (named is not None and {_label(name) for name in names} <= set(flat)):
        chosen = flat if names is None else [_label(name) for name in names]
        return _flat_outputs(obj, [flat.index(name) for name in chosen], *whole, chosen)
    known = [_label(name) for name in (*system.state_labels, *system.input_labels)]
    rows = _rows_of(names, known, "states and inputs")
    breaks = np.asarray(getattr(basis, "breakpoints", whole), dtype=float)
    inner = breaks[(breaks > first) & (breaks < last)]

    def evaluate(t: Array) -> Array:
        try:
            return np.vstack(obj.eval(t))
        except ValueError as error:  # of scipy, for splines that are not as smooth as states and inputs require
            raise ValueError(
                f"states and inputs must be defined by the plan, got from python-control: {error}; use the flat outputs"
            ) from error

    return _interpolated(evaluate, rows, np.array([first, *inner, last]), names)


def _interval(basis: Any, start: float | None, end: float | None) -> tuple[float, float]:
    """Times of a plan: those of its basis, or those given for a basis without."""
    known = None
    if hasattr(basis, "breakpoints"):
        known = float(basis.breakpoints[0]), float(basis.breakpoints[-1])
    elif hasattr(basis, "t0"):
        known = float(basis.t0), float(basis.t0 + basis.T)
    if known is None:
        if start is None or end is None:
            raise ValueError(
                f"start and end must be given for a plan in a {type(basis).__name__}, which does not contain its "
                f"times, got {start} and {end}"
            )
        known = start, end
    return known


def _label(name: str) -> str:
    return name.replace(".", "_")


def _rows_of(names: list[str], known: list[str], kind: str) -> list[int]:
    """Numbers of signals in a list."""
    for name in names:
        if _label(name) not in known:
            raise ValueError(f"signals must be among the {kind} {', '.join(known)}, got {name!r}")
    return [known.index(_label(name)) for name in names]


def _flat_outputs(obj: Any, axes: list[int], start: float, end: float, names: list[str]) -> Trajectory:
    """Flat outputs in the space of the basis, checked between the points that determine them."""
    sizes = [obj.basis.var_ncoefs(axis) for axis in axes]
    if hasattr(obj.basis, "breakpoints"):
        plan: Trajectory = _of_b_splines(obj, axes, names)
    elif len(set(sizes)) == 1:
        plan = _through_points(obj, axes, start, end, names)
    else:
        rows = zip(axes, names, strict=True)
        return stack([_flat_outputs(obj, [axis], start, end, [name]) for axis, name in rows], labels=names)
    check = np.linspace(start, end, 4 * max(sizes) + 3)
    for row, axis in zip(plan.jet(check, 0)[0], axes, strict=True):
        error, size = np.abs(row - _terms(obj, axis, 0, check).sum(axis=0)), np.abs(_terms(obj, axis, 0, check))
        if not error.max() <= _SAME * size.sum(axis=0).max():
            raise ValueError(
                f"the basis must consist of polynomials, B-splines or a TrigFamily, got {type(obj.basis).__name__} and "
                f"a difference of {error.max():.3g}; interpolate its samples by scipy.interpolate.make_interp_spline"
            )
    return plan


def _terms(obj: Any, axis: int, k: int, t: Array) -> Array:
    """Terms (ncoefs, ntime) of a derivative of a flat output."""
    return np.array([c * obj.basis.eval_deriv(j, k, t, var=axis) for j, c in enumerate(obj.coeffs[axis])])


def _of_b_splines(obj: Any, axes: list[int], names: list[str]) -> PiecewisePolynomial:
    """Flat outputs in B-splines, by their derivatives at the start of each segment."""
    from scipy.interpolate import BSpline

    basis = obj.basis
    own = [axis if basis.nvars else 0 for axis in axes]
    highest = max(basis.degree[i] for i in own)
    times = _divided(np.asarray(basis.breakpoints, dtype=float), highest)
    table = np.zeros((highest + 1, times.size - 1, len(axes)))
    for column, (axis, i) in enumerate(zip(axes, own, strict=True)):
        degree, coefficients = basis.degree[i], real_array(obj.coeffs[axis], "coefficients")
        # Not by eval_deriv, which raises where internal knots repeat.
        spline = BSpline(basis.knotpoints[i], coefficients, degree)
        table[highest - degree :, :, column] = _taylor(spline, times, degree)
    return PiecewisePolynomial(times, table, labels=names)


def _through_points(obj: Any, axes: list[int], start: float, end: float, names: list[str]) -> Trajectory:
    """Flat outputs in as many functions each, through as many Chebyshev points: well-conditioned for every alpha."""
    count = obj.basis.var_ncoefs(axes[0])
    fractions = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, max(count, 2)))
    times = np.append(start + (end - start) * fractions[:-1], end)
    rows = np.array([_terms(obj, axis, 0, times).sum(axis=0) for axis in axes])
    rows[:, count:] = np.nan  # a constant is determined at the start, and free at the end
    points = [Waypoint(t, row.tolist()) for t, row in zip(times.tolist(), rows.T, strict=True)]
    alpha = float(getattr(obj.basis, "alpha", 0.0))
    if alpha:
        return TrigSpline(points, alpha=alpha, labels=names, warn=False)
    return PolySpline(points, labels=names, warn=False)


def _interpolated(evaluate: Callable[[Array], Array], rows: list[int], breaks: Array, names: list[str]) -> Trajectory:
    """Quintic splines in each segment through samples, doubled until the deviation between them is small."""
    from scipy.interpolate import make_interp_spline

    pieces = []
    for left, right in itertools.pairwise(breaks.tolist()):
        count = 17
        while True:
            times = np.linspace(left, right, 2 * count - 1)
            values = evaluate(np.append(times[:-1], np.nextafter(right, left)))
            if not np.isfinite(values[rows]).all():
                raise ValueError(
                    f"signals must be finite over the plan, got nan or inf between {left:g} s and {right:g} s"
                )
            spline = make_interp_spline(times[::2], values[rows, ::2].T, k=5)
            error = np.abs(spline(times[1::2]).T - values[rows, 1::2]).max(axis=1)
            allowed = np.maximum(_RESOLVED * np.ptp(values[rows], axis=1), _ROUNDING * np.abs(values).max())
            if (error <= allowed).all():
                break
            if count >= _MAXIMUM_SAMPLES:
                worst = int(np.argmax(error / np.maximum(allowed, np.finfo(float).tiny)))
                raise ValueError(
                    f"signals must be resolved to {_RESOLVED:g} of their range, got a deviation of {error[worst]:.3g} "
                    f"of {names[worst]} with {count} samples between {left:g} s and {right:g} s; use the flat outputs"
                )
            count = 2 * count - 1
        pieces.append((_of_spline(spline, None), error))
    return _joined(pieces, names)


def _joined(pieces: list[tuple[Any, Array]], names: list[str]) -> Trajectory:
    """Consecutive polynomials as one."""
    times = np.concatenate([pieces[0][0].breakpoints[:1], *(plan.breakpoints[1:] for plan, _ in pieces)])
    table = np.concatenate([plan.coefficients for plan, _ in pieces], axis=1)
    deviation = np.max([error for _, error in pieces], axis=0)
    return PiecewisePolynomial(times, table, labels=[_label(name) for name in names], deviation=deviation)


# Results of control.optimal


def _of_optimal(obj: Any, names: list[str] | None) -> Trajectory:
    from scipy.interpolate import make_interp_spline

    system, times = obj.problem.system, real_array(obj.time, "time")
    if system.dt:
        raise ValueError(f"the system must have continuous time, got the sampling period {system.dt}")
    if not getattr(obj, "success", True):
        warnings.warn(f"the optimisation must have succeeded, got: {getattr(obj, 'message', '')}", stacklevel=3)
    if times.size < 5 or not (np.diff(times) > 0.0).all():
        raise ValueError(f"time must be five or more samples that increase strictly, got {times.tolist()!r:.200}")
    given = [(obj.states, system.state_labels, "states"), (obj.inputs, system.input_labels, "inputs")]
    values = np.vstack([_signals(array, len(labels), times.size, kind) for array, labels, kind in given])
    known = [_label(name) for name in (*system.state_labels, *system.input_labels)]
    chosen = known[: len(system.state_labels)] if names is None else names
    rows = _rows_of(chosen, known, "states and inputs")
    table, deviation = np.zeros((4, times.size - 1, len(rows))), np.zeros(len(rows))
    for column, row in enumerate(rows):
        if row >= len(system.state_labels):
            table[2:, :, column] = np.diff(values[row]) / np.diff(times), values[row, :-1]
            continue
        found = make_interp_spline(times, values[row], k=3)
        table[:, :, column] = [found(times[:-1], nu=k) / FACTORIALS[k] for k in (3, 2, 1, 0)]
        fewer = np.unique([*range(0, times.size, 2), times.size - 1])
        coarse = make_interp_spline(times[fewer], values[row, fewer], k=min(3, fewer.size - 1))
        deviation[column] = np.abs(coarse(times) - values[row]).max()
    return PiecewisePolynomial(times, table, labels=[_label(name) for name in chosen], deviation=deviation)


def _signals(array: ArrayLike, count: int, ntime: int, kind: str) -> Array:
    """Signals (count, ntime) of a result, which may be squeezed."""
    found = real_array([] if array is None else array, kind)
    found = found.reshape(1, -1) if found.ndim == 1 else found
    if found.shape != (count, ntime) or not np.isfinite(found).all():
        raise ValueError(
            f"{kind} of the result must be finite and of shape ({count}, {ntime}), got shape {found.shape}; solve with "
            "the default transpose and squeeze"
        )
    return found
