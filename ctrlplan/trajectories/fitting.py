"""Plans through sampled data, by the smoothing splines of scipy."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import checked_count, checked_vector, real_array
from ctrlplan.trajectories.common import FACTORIALS, Array, bernstein_of_powers
from ctrlplan.trajectories.least_squares import LeastSquares, Solution, divided
from ctrlplan.trajectories.piecewise_polynomial import PiecewisePolynomial
from ctrlplan.trajectories.swing import MAXIMUM_SWING

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_MANY = 50
"""Number of knots above which they are chosen by solutions with half of the digits."""

_DEGREES = (1, 3, 3, 5, 5)
"""Degree of the spline by the highest continuous derivative; even degrees are ill-conditioned."""

_ROUNDING = 1e-9
"""Part of a tolerance for the rounding of the polynomials of a spline."""

_ROUNDINGS = 6
"""Part of a limit for the rounding of constants and values, in spacings of numbers as large as the samples."""

_PARTS = 16
"""Maximum number of parts into which an interval between knots is divided in one step."""


def fit(
    times: ArrayLike,
    values: ArrayLike,
    *,
    tolerance: ArrayLike | None = None,
    smoothing: ArrayLike | None = None,
    continuity: int = 2,
    labels: Sequence[str] | str | None = None,
    warn: bool = True,
) -> PiecewisePolynomial:
    """Plan through samples: an interpolating or smoothing spline.

    By default the plan interpolates the samples (`scipy.interpolate.make_interp_spline`).
    With `tolerance` it is a least-squares spline (`make_lsq_spline`) whose knots, the
    same for all axes, are added where the deviation is larger. With `smoothing` it is,
    axis by axis, the smoothing spline of FITPACK (`splrep`) or, of continuity 0, a
    least-squares spline with knots added until the sum is met. Knots are sample times,
    at both ends as those of the interpolating spline (not-a-knot).

    Parameters
    ----------
    times : array_like, shape (nsamples,)
        Sample times [s], strictly increasing.
    values : array_like, shape (naxes, nsamples), or (nsamples,) for one axis
        Samples.
    tolerance : float or array_like of shape (naxes,), optional
        Maximum deviation from the samples [unit of the axis], above 0.
    smoothing : float or array_like of shape (naxes,), optional
        Maximum sum of the squared deviations of an axis, as the argument `s` of
        `splrep`: about the number of samples times the variance of their noise.
        0 interpolates, up to rounding.
    continuity : int, optional
        Highest derivative that is continuous, from 0 (linear between samples) to 4.
    labels : sequence of str, optional
        Names of the axes.
    warn : bool, optional
        Whether to warn if the plan swings far beyond the samples.

    Returns
    -------
    PiecewisePolynomial
        Its attribute `deviation` is the maximum deviation of its values at the samples,
        by axis, rounding included.
        Peaks and extrema of its derivatives are those of the polynomials, between
        the samples too.

    Raises
    ------
    TypeError
        If an argument does not contain real numbers.
    ValueError
        If shapes differ, a sample is not finite, times do not increase strictly, or
        there are too few samples for the continuity; if `tolerance` and `smoothing`
        are both given; if the tolerance would require more knots than samples, or
        rounding leaves more than `tolerance` or `smoothing` allows.

    Warns
    -----
    UserWarning
        If the range of the plan is more than 3 times that of the samples, as between
        times that are spaced very unevenly.

    Notes
    -----
    The plan starts and ends with the velocity of the data. `jumps` lists what differs
    from rest.

    Examples
    --------
    A noisy record of a move, within 2 mm of the samples:

    >>> import numpy as np
    >>> times = np.linspace(0.0, 4.0, 401)
    >>> noise = np.random.default_rng(1).uniform(-1e-3, 1e-3, 401)
    >>> plan = fit(times, np.sin(times) ** 2 + noise, tolerance=2e-3, labels="x")
    >>> bool(plan.deviation[0] <= 2e-3), plan.breakpoints.size < 40, plan.peak(1).round(1)
    (True, True, array([1.]))
    """
    degree = _DEGREES[_checked_continuity(continuity)]
    moments, rows = _checked_samples(times, values, degree)
    if tolerance is not None and smoothing is not None:
        raise ValueError(f"tolerance and smoothing must not both be given, got {tolerance!r:.40} and {smoothing!r:.40}")
    allowed = _checked_positive(tolerance, "tolerance", len(rows), zero=False)
    sums = _checked_positive(smoothing, "smoothing", len(rows), zero=True)
    middle = _middle(rows)
    centred = rows - middle[:, None]
    if allowed is not None:
        splines = [_within(moments, centred, degree, _without_rounding(allowed, rows))]
    elif sums is not None:
        roots = _without_rounding(np.sqrt(sums / moments.size), rows)
        splines = [_smooth(moments, row, degree, root) for row, root in zip(centred, roots.tolist(), strict=True)]
    else:
        splines = [_interpolating(moments, centred.T, degree)]
    knots = splines[0].t[degree : splines[0].t.size - degree]
    if len(splines) > 1:
        knots = np.unique(np.concatenate([spline.t for spline in splines]))
    table = np.empty((degree + 1, knots.size - 1, len(rows)))
    for k in range(degree + 1):
        table[-1 - k] = np.concatenate([spline(knots[:-1], nu=k) for spline in splines], axis=1) / FACTORIALS[k]
    table[-1] += middle
    plan = PiecewisePolynomial(knots, table, labels=labels)
    errors = _errors(plan, moments, rows)
    deviation = errors.max(axis=1)
    if allowed is not None:
        _refuse_missed("tolerance", "deviation", deviation, allowed, rows, splines * len(rows))
    elif sums is not None:
        with np.errstate(over="ignore"):
            found = np.where(sums > 0.0, (errors**2).sum(axis=1), 0.0)
        _refuse_missed("smoothing", "sum of squared deviations", found, sums, rows, splines)
    plan = PiecewisePolynomial(knots, table, labels=labels, deviation=deviation)
    if warn:
        _warn_of_swing(plan, rows)
    return plan


def _middle(rows: Array) -> Array:
    """Middle value of each axis (naxes,) far from zero, which is subtracted without rounding; 0 of others."""
    low, high = 0.5 * rows.min(axis=1), 0.5 * rows.max(axis=1)
    return np.where(0.5 * np.abs(low + high) > high - low, low + high, 0.0)


def _without_rounding(limits: Array, rows: Array) -> Array:
    """Limits (naxes,) for a spline whose constants and values are rounded afterwards; 0 if there is no room for it."""
    return np.maximum(limits - _ROUNDINGS * np.spacing(np.abs(rows).max(axis=1)), 0.0)


def _errors(plan: PiecewisePolynomial, times: Array, rows: Array) -> Array:
    """Deviations (naxes, nsamples) of the values of a plan, at all times together or one by one."""
    segments = np.searchsorted(plan.breakpoints[1:-1], times, side="right")
    with np.errstate(over="ignore", invalid="ignore"):
        single = plan.segments_jet(segments, times - plan.breakpoints[segments], 0)[0]
    return np.maximum(np.abs(single - rows), np.abs(plan(times).reshape(rows.shape) - rows))


def _refuse_missed(
    name: str, measure: str, found: Array, allowed: Array, rows: Array, splines: Sequence[BSpline]
) -> None:
    """Raise if what was found (naxes,) at the samples is more than the argument of this name allows."""
    reached = found <= allowed
    if reached.all():
        return
    axis = int(reached.argmin())
    spline, nsamples = splines[axis], rows.shape[1]
    start = f"{name} must be at least {found[axis]:.3g}, the {measure} by rounding"
    advice = f"; use a larger {name}, which requires fewer knots" + (", or lower continuity" if spline.k > 1 else "")
    if len(spline.c) < nsamples:
        raise ValueError(
            f"{start} of the polynomials of degree {spline.k} in the {np.unique(spline.t).size - 1} segments of axis "
            f"{axis}, got {allowed[axis]:g}{advice}"
        )
    raise ValueError(
        f"{start} of a spline through all samples of axis {axis}, got {allowed[axis]:g}: it would require more knots "
        f"than the {nsamples} samples, which are rounded by {0.5 * np.spacing(np.abs(rows[axis]).max()):.2g} "
        f"themselves{advice}"
    )


def _warn_of_swing(plan: PiecewisePolynomial, rows: Array) -> None:
    """Warn at the line of the caller's caller if a plan swings far beyond its samples (naxes, nsamples)."""
    low, high = rows.min(axis=1), rows.max(axis=1)
    powers = np.arange(len(plan.coefficients))
    with np.errstate(over="ignore", invalid="ignore"):
        allowed = MAXIMUM_SWING * (high - low) + 1e-9 * np.abs(rows).max(axis=1)  # rounding of constant samples
        relative = plan.coefficients[::-1] * (np.diff(plan.breakpoints) ** powers[:, None])[:, :, None]
        bounds = np.tensordot(bernstein_of_powers(int(powers[-1])), relative, 1)
        if (bounds.max(axis=0).max(axis=0) - bounds.min(axis=0).min(axis=0) <= allowed).all():
            return
    found = plan.extrema()
    excess = np.where(found.maximum - found.minimum > allowed, (found.maximum - found.minimum) / allowed, 0.0)
    axis = int(excess.argmax())
    if excess[axis]:
        factor = MAXIMUM_SWING * excess[axis]
        warnings.warn(
            f"the plan swings over {factor:.3g} times the range of the samples: {plan.labels[axis]} from "
            f"{found.minimum[axis]:.6g} to {found.maximum[axis]:.6g}, where samples stay from {low[axis]:.6g} to "
            f"{high[axis]:.6g}; lower continuity, use a larger tolerance or smoothing, or PiecewiseSpline, or pass "
            "warn=False if this is intended",
            stacklevel=3,
        )


def _checked_continuity(continuity: int) -> int:
    highest = len(_DEGREES) - 1
    order = checked_count(continuity, "continuity")
    if order > highest:
        raise ValueError(f"continuity must be from 0 to {highest}, got {continuity}")
    return order


def _checked_samples(times: ArrayLike, values: ArrayLike, degree: int) -> tuple[Array, Array]:
    """Times (nsamples,) and values (naxes, nsamples), finite, as many as the degree requires."""
    moments, given = real_array(times, "times"), real_array(values, "values")
    if moments.ndim != 1:
        raise ValueError(f"times must have shape (nsamples,), got {moments.shape}")
    rows = given[None] if given.ndim == 1 else given
    if rows.ndim != 2 or rows.shape[1] != moments.size or not len(rows):
        raise ValueError(
            f"values must have shape (naxes, {moments.size}) or ({moments.size},) as times, got {given.shape}"
        )
    for name, array in (("times", moments[None]), ("values", rows)):
        if not np.isfinite(array).all():
            axis, i = np.argwhere(~np.isfinite(array))[0].tolist()
            place = f"[{i}]" if name == "times" or given.ndim == 1 else f"[{axis}, {i}]"
            raise ValueError(f"{name} must be finite, got {name}{place} = {array[axis, i]}; remove such samples first")
    wrong = np.flatnonzero(~(np.diff(moments) > 0.0))
    if wrong.size:
        i = int(wrong[0]) + 1
        advice = "; average samples at the same time first" if moments[i] == moments[i - 1] else "; sort them first"
        raise ValueError(
            f"times must increase strictly, got times[{i}] = {moments[i]} after times[{i - 1}] = {moments[i - 1]}"
            + advice
        )
    if moments.size <= degree:
        raise ValueError(
            f"times must be {degree + 1} or more for a spline of degree {degree}, got {moments.size}; lower continuity"
        )
    if not float(moments[-1]) - float(moments[0]) < np.inf:
        raise ValueError(f"times must span a finite duration, got {moments[0]:g} s to {moments[-1]:g} s")
    return moments, rows


def _checked_positive(value: ArrayLike | None, name: str, naxes: int, *, zero: bool) -> Array | None:
    """Numbers (naxes,) above 0, or of at least 0."""
    if value is None:
        return None
    found = checked_vector(value, name, naxes)
    if not (found >= 0.0 if zero else found > 0.0).all():
        raise ValueError(f"{name} must be {'at least' if zero else 'above'} 0, got {value!r:.80}")
    return found


def _interpolating(times: Array, columns: Array, degree: int) -> BSpline:
    from scipy.interpolate import make_interp_spline

    return make_interp_spline(times, columns, k=degree)


def _smooth(times: Array, row: Array, degree: int, limit: float) -> BSpline:
    """Smoothing spline of one axis whose root mean square of deviations is at most `limit`.

    The knots of FITPACK are written beyond its arrays for degrees below 3, where the
    intervals between all samples are used up before its sum is reached, and where squares
    of samples underflow. So it is given cubics and quintics of samples near 1 only.
    """
    from scipy.interpolate import BSpline, splrep

    if degree < 3:
        return _within(times, row[None], degree, np.array([limit]), mean=True)
    exponent = int(np.frexp(np.abs(row).max())[1])
    scaled, root = np.ldexp(row, -exponent), min(float(np.ldexp(limit, -exponent)), 2.0)
    if root <= np.finfo(float).eps:
        return _interpolating(times, row[:, None], degree)
    total = root**2 * row.size
    # FITPACK reaches its sum to 1e-3; instead of its messages, the sum is measured.
    (knots, coefficients, _), *_ = splrep(times, scaled, k=degree, s=total / 1.001, full_output=1, quiet=1)
    spline = BSpline(knots, coefficients[: knots.size - degree - 1, None], degree)
    with np.errstate(over="ignore", invalid="ignore"):
        found = ((spline(times)[:, 0] - scaled) ** 2).sum() <= total * (1.0 - _ROUNDING)
    if not found:
        return _interpolating(times, row[:, None], degree)
    return BSpline(knots, np.ldexp(spline.c, exponent), degree)


def _within(times: Array, rows: Array, degree: int, limits: Array, *, mean: bool = False) -> BSpline:
    """Least-squares spline of all axes, with knots added where samples deviate by more than limits (naxes,).

    The limits are those of each sample or, with `mean`, of the root mean square.
    """
    problem = LeastSquares(times, rows, degree)
    chosen, last = np.array([0, problem.places.size - 1]), problem.places.size - 1
    if not mean and limits.all():
        chosen = problem.first_knots(limits)
    while chosen.size <= last and limits.all():  # all places are those of the interpolating spline
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                found = problem.solve(problem.places[chosen])
                if chosen.size <= _MANY:
                    found = problem.corrected(found)
                worst, reached = _judged(found, limits, mean)
                if not found.is_correct and (reached or not np.isfinite(worst).all()):  # these are the knots
                    found = problem.corrected(found)
                    worst, reached = _judged(found, limits, mean)
        except np.linalg.LinAlgError:
            break
        if reached:
            return found.spline()
        if not np.isfinite(worst).all():
            break
        chosen = divided(chosen, _parts(chosen, worst, degree))
    return _interpolating(times, rows.T, degree)


def _judged(found: Solution, limits: Array, mean: bool) -> tuple[Array, bool]:
    """Deviation of each interval relative to the limits, and whether they are kept."""
    excess = (np.abs(found.deviations) / (limits * (1.0 - _ROUNDING))[:, None]).max(axis=0)
    worst = _by_interval(excess, found.chosen, mean)
    return worst, bool((worst <= 1.0).all() or (mean and (excess**2).mean() <= 1.0))


def _by_interval(excess: Array, chosen: NDArray[np.intp], mean: bool) -> Array:
    """Maximum or root mean square of the samples in each interval; the last sample belongs to the last one."""
    if not mean:
        return np.maximum.reduceat(excess, chosen[:-1])
    sizes = np.diff(chosen)
    sizes[-1] += 1
    return np.sqrt(np.add.reduceat(excess**2, chosen[:-1]) / sizes)


def _parts(chosen: NDArray[np.intp], worst: Array, degree: int) -> NDArray[np.intp]:
    """Numbers of parts of intervals where the relative deviations exceed 1.

    A deviation is proportional to the power degree + 1 of the length of an interval. If
    there is a single sample between knots, the nearest intervals with more are divided.
    """
    several, exceeds = chosen[1:] - chosen[:-1] > 1, worst > 1.0
    wanted = np.minimum(np.maximum(np.ceil(worst ** (1.0 / (degree + 1))), 2.0), _PARTS)
    parts = np.where(exceeds, wanted, 1.0).astype(int)
    active = exceeds & several
    served = active.copy()
    served[1:] |= active[:-1]
    served[:-1] |= active[1:]
    waiting = np.flatnonzero(exceeds & ~served)
    if waiting.size:
        numbers = np.arange(parts.size)
        before = np.maximum.accumulate(np.where(several, numbers, -parts.size))[waiting]
        after = np.minimum.accumulate(np.where(several, numbers, 2 * parts.size)[::-1])[::-1][waiting]
        nearer = waiting - before <= after - waiting
        np.maximum.at(parts, before[nearer], parts[waiting[nearer]])
        nearer = waiting - before >= after - waiting
        np.maximum.at(parts, after[nearer], parts[waiting[nearer]])
    return parts
