"""Figures of vibration over frequency: of input shapers, and of plans."""

from __future__ import annotations

import math

import control as ct
import numpy as np
from control import ControlPlot
from numpy.typing import ArrayLike, NDArray

from ctrlplan._checks import check_kind, finite_vector
from ctrlplan._types import System
from ctrlplan.reports.style import (
    AxesLike,
    Drawing,
    as_text,
    axis_styles,
    label_y,
    line_width,
    shade,
)
from ctrlplan.trajectories import Shaper, Trajectory
from ctrlplan.trajectories.residual import checked_modes, residual_spectrum

Array = NDArray[np.float64]

_FREQUENCY = "frequency [rad/s]"


def plot_shaper(
    shaper: Shaper, frequencies: ArrayLike, response: ArrayLike | None = None, *, ax: AxesLike | None = None
) -> ControlPlot:
    """Residual vibration of a shaper over frequency, and a spectrum with and without the shaper.

    Parameters
    ----------
    shaper : Shaper
        The shaper, evaluated at the lowest damping ratio of its modes.
    frequencies : array_like, shape (nfrequencies,)
        Frequencies [rad/s], at least 0, increasing.
    response : array_like, shape (nfrequencies,), optional
        Magnitudes of a measured spectrum.
    ax : Axes or array of Axes, optional
        Where to draw, two axes with `response`; None: an empty current figure, or
        a new one.

    Returns
    -------
    control.ControlPlot
        Of shape (1, 1), with `response` of shape (2, 1).

    Raises
    ------
    TypeError
        If `ax` is neither axes nor an array of them.
    ValueError
        If frequencies do not increase, or the response has another length.
    """
    omega = _checked_frequencies(frequencies)
    spectrum = None if response is None else _checked_magnitudes(response, omega.size)
    rows = ("residual vibration", "spectrum")[: 1 if spectrum is None else 2]
    drawing = Drawing(ax, (len(rows), 1), (6.4, 1.2 + 2.2 * len(rows)), rows=rows)
    damping = min((factor.damping for factor in shaper.factors), default=0.0)
    left = shaper.residual(omega, damping)
    first = drawing.column[0]
    (style,) = axis_styles((f"residual vibration, damping {damping:g}",), first).values()
    first.plot(omega, left, **style)
    for factor in shaper.factors:
        first.axvline(factor.frequency, color=shade(0.5), linestyle=(0, (4, 2)), linewidth=line_width(0.65))
    label_y(first, "residual vibration")
    if spectrum is not None:
        second = drawing.column[1]
        without, shaped = axis_styles(("without shaper", "with shaper"), second).values()
        second.plot(omega, spectrum, **without | {"linestyle": (0, (5, 1.5))})
        second.plot(omega, left * spectrum, **shaped)
        second.legend()
        label_y(second, "spectrum")
    drawing.label_x(_FREQUENCY)
    return drawing.finish(legend=spectrum is None)


def residual_plot(
    plan: Trajectory,
    frequencies: ArrayLike,
    damping: ArrayLike = 0.0,
    *,
    loop: System | None = None,
    ax: AxesLike | None = None,
) -> ControlPlot:
    """Plot the vibration that a plan leaves in a mode over frequency.

    Parameters
    ----------
    plan : Trajectory
        The plan, also shaped.
    frequencies : array_like, shape (nfrequencies,)
        Undamped natural frequencies [rad/s], at least 0, increasing.
    damping : float or array_like, shape (nfrequencies,), optional
        Damping ratio in [0, 1), the same for all frequencies or one for each.
    loop : linear control system, optional
        A loop whose magnitude from each input to each output is drawn above, on
        logarithmic axes: its peaks are the modes.
    ax : Axes or array of Axes, optional
        Axes to plot in, two with `loop`. Default: the current figure if it is
        empty, otherwise a new one.

    Returns
    -------
    control.ControlPlot
        With `figure`, `axes` and `lines`, of shape (1, 1), with `loop` of (2, 1).

    Raises
    ------
    TypeError
        If `plan` is not a trajectory, `loop` not a linear system with inputs, or
        `ax` neither axes nor an array of them.
    ValueError
        If frequencies do not increase, are not positive with a loop, or are beyond
        the Nyquist frequency of a discrete loop; if a damping ratio is out of
        range.

    See Also
    --------
    residual_spectrum : the values.

    Examples
    --------
    >>> import control as ct
    >>> import numpy as np
    >>> import ctrlplan as cp
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> loop = ct.tf([100.0], [1.0, 0.4, 100.0], inputs="r", outputs="y")
    >>> drawn = cp.residual_plot(plan, np.linspace(1.0, 30.0, 291), 0.02, loop=loop)
    >>> drawn.axes.shape
    (2, 1)
    """
    check_kind(plan, "plan", Trajectory)
    omega = _checked_frequencies(frequencies)
    _, zeta = checked_modes(omega, damping)
    curves = {} if loop is None else _magnitudes(loop, omega)
    rows = ("magnitude of the loop", "residual vibration")[0 if curves else 1 :]
    drawing = Drawing(ax, (len(rows), 1), (6.4, 1.2 + 2.2 * len(rows)), rows=rows)
    lowest = drawing.column[-1]
    left = np.atleast_2d(residual_spectrum(plan, omega, zeta))
    for style, values in zip(axis_styles(plan.labels, lowest).values(), left, strict=True):
        lowest.plot(omega, values, **style)
    label_y(lowest, "residual vibration")
    if curves:
        upper = drawing.column[0]
        for style, values in zip(axis_styles(curves, upper).values(), curves.values(), strict=True):
            upper.plot(omega, values, **style)
        upper.set_yscale("log")
        label_y(upper, "magnitude")
        for axes in drawing.column:
            if len(axes.get_legend_handles_labels()[0]) > 1:
                axes.legend()
    drawing.label_x(_FREQUENCY)
    return drawing.finish(legend=not curves and plan.naxes > 1)


def _checked_frequencies(frequencies: ArrayLike) -> Array:
    omega = finite_vector(frequencies, "frequencies", "nfrequencies")
    for i in np.flatnonzero(omega < 0.0).tolist():
        raise ValueError(f"frequencies must be at least 0, got frequencies[{i}] = {omega[i]}")
    for i in np.flatnonzero(np.diff(omega) <= 0.0).tolist():
        raise ValueError(
            f"frequencies must increase strictly, got frequencies[{i + 1}] = {omega[i + 1]} after {omega[i]}"
        )
    return omega


def _checked_magnitudes(response: ArrayLike, count: int) -> Array:
    size = finite_vector(response, "response", "nfrequencies")
    if size.size != count:
        raise ValueError(f"response must be as many numbers as frequencies, {count}, got {size.size}")
    for i in np.flatnonzero(size < 0.0).tolist():
        raise ValueError(f"response must be magnitudes of at least 0, got response[{i}] = {size[i]}")
    return size


def _magnitudes(loop: System, omega: Array) -> dict[str, Array]:
    """Magnitude of a linear loop from each input to each output, by name."""
    if not isinstance(loop, ct.LTI) or not loop.ninputs:
        kind = "a system without inputs" if isinstance(loop, ct.LTI) else type(loop).__name__
        raise TypeError(f"loop must be a linear control system with inputs, got {kind}; see control.linearize")
    if omega[0] == 0.0:
        raise ValueError("frequencies must be above 0 where a loop is drawn, got frequencies[0] = 0.0")
    discrete = not isinstance(loop.dt, bool) and loop.dt
    if discrete and omega[-1] > math.pi / loop.dt:
        raise ValueError(
            f"frequencies must be at most the Nyquist frequency of the loop, {math.pi / loop.dt:g} rad/s, "
            f"got {omega[-1]}"
        )
    found = np.abs(loop(np.exp(1j * omega * loop.dt) if discrete else 1j * omega, squeeze=False))
    pairs = [(o, i) for o in range(loop.noutputs) for i in range(loop.ninputs)]
    names = [as_text(f"{loop.output_labels[o]} from {loop.input_labels[i]}") for o, i in pairs]
    return dict(zip(names, (found[pair] for pair in pairs), strict=True))
