r"""Plans as electronic cams: position, velocity and acceleration at master positions.

A drive interpolates between points by the polynomial of degree 5 that has both
points' position, velocity and acceleration. On an interval of length h derivative
k differs from a plan with the sixth derivative y6 by at most

.. math:: C_k\,h^{6 - k} \max|y_6|, \qquad
    C_0 = \tfrac{1}{46080},\; C_1 = \tfrac{\sqrt 5}{30000},\; C_2 = \tfrac{1}{1920}

(Birkhoff and Priver, Journal of Mathematics and Physics 46, 1967, 440-447; no
smaller constants hold for all plans). A jump d of the acceleration at a point,
which has one value only, adds |d| times the peak of the polynomial, or of its
derivative, with acceleration 1 at that end.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ctrlplan._types import Array
from ctrlplan.trajectories.export.cells import segment_peak
from ctrlplan.trajectories.export.csv_table import CSV
from ctrlplan.trajectories.export.formats import Files, Format, Options, SampledTable, decimal, one_period, plain
from ctrlplan.trajectories.files import signal_names, signal_rows
from ctrlplan.trajectories.trajectory import Trajectory

_TOLERANCE = 1e-6
"""Error of the position between points relative to its range, if no times are given."""

_ORDERS = np.arange(3)
_HERMITE = np.array([1.0 / 46080.0, math.sqrt(5.0) / 30000.0, 1.0 / 1920.0])
_JUMP = np.array([0.01728, 0.0678, 1.0])
"""Maxima of u^3 (1 - u)^2 / 2 on [0, 1], of its derivative (rounded up) and of its second derivative."""


class Cam(NamedTuple):
    """Points of a cam and the error between them."""

    times: Array
    jet: Array  # (3, naxes, npoints)
    error: Array  # (3, naxes)

    def stated(self, plan: Trajectory) -> str:
        """Description of the error."""
        pairs = zip(signal_names(plan.labels, 2), self.error.T.ravel().tolist(), strict=True)
        bounds = ", ".join(f"{plain(name)} {error:.3g}" for name, error in pairs)
        return f"error between points, with polynomials of degree 5, at most: {bounds}"


class CamCSV(Format):
    """Table with columns master, x, x_d1, x_d2, ...; its first line, after #, states the error between points."""

    accepted = ("dt", "timepts")

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        cam = cam_of(one_period(plan, ".cam.csv"), options)
        names = tuple(signal_names(plan.labels, 2))
        table = CSV().encoded(SampledTable(cam.times, names, signal_rows(plan, cam.times, 2)))
        return {path: f"# {cam.stated(plan)}\nmaster" + table.removeprefix("time")}


class CamST(Format):
    """Structured text for CODESYS SoftMotion: a list of global variables with an MC_CAM_REF for each axis.

    Cams are of the type XYVA (byType 3), whose points are an array of SMC_CAMXYVA
    with master position dX, slave position dY and its derivatives dV and dA with respect to the
    master position. The text is the content of a global variable list.
    """

    accepted = ("dt", "timepts")

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        cam = cam_of(one_period(plan, ".cam.st"), options)
        count = cam.times.size
        if count > _ELEMENTS:
            raise ValueError(f"a cam of CODESYS must have at most {_ELEMENTS} points, got {count}; reduce timepts")
        lines = [f"(* {cam.stated(plan)} *)", "VAR_GLOBAL"]
        names = [re.sub(r"[\W_]+", "_", f"cam_{label}", flags=re.ASCII).rstrip("_") for label in plan.labels]
        for axis, name in enumerate(names):
            if [n.lower() for n in names].count(name.lower()) > 1:
                raise ValueError(f"axes must have different names in structured text, got {name!r} twice; rename one")
            points = zip(cam.times.tolist(), *cam.jet[:, axis].tolist(), strict=True)
            rows = [", ".join(f"d{n} := {decimal(v)}" for n, v in zip("XYVA", point, strict=True)) for point in points]
            ends = f"xStart := {decimal(cam.times[0])}, xEnd := {decimal(cam.times[-1])}"
            lines += [
                f"    {name}_points : ARRAY[0..{count - 1}] OF SMC_CAMXYVA := [",
                ",\n".join(f"        ({row})" for row in rows) + "];",
                f"    {name} : MC_CAM_REF := (byType := 3, {ends}, nElements := {count}, pce := ADR({name}_points));",
            ]
        return {path: "\n".join([*lines, "END_VAR"]) + "\n"}


_ELEMENTS = 32767  # nElements is an INT


def cam_of(plan: Trajectory, options: Options) -> Cam:
    """Points at the breakpoints and the given times, or as many as `_TOLERANCE` requires.

    Raises
    ------
    ValueError
        If position or velocity jump inside of the plan, or a time lies outside of it.
    """
    inner = [jump for jump in plan.jumps(2) if plan.start < jump.time < plan.end]
    for jump in inner:
        if jump.order < 2:
            raise ValueError(
                f"{('position', 'velocity')[jump.order]} of a cam must be continuous, got a jump of {jump.label} by "
                f"{jump.size:.4g} at {jump.time:g} s"
            )
    jumps = [(jump.time, plan.labels.index(jump.label), abs(jump.size)) for jump in inner]
    peaks = np.array([segment_peak(plan, segment, 6) for segment in range(plan.breakpoints.size - 1)])
    if options.timepts is None and options.dt is None:
        times = _resolving(plan, peaks, jumps)
    else:
        wanted = options.times(plan.start, plan.end)
        times = np.union1d(wanted if options.dt is None else np.minimum(wanted, plan.end), plan.breakpoints)
    if times[0] < plan.start or times[-1] > plan.end:
        raise ValueError(
            f"timepts of a cam must lie between the plan's start {plan.start:g} s and end {plan.end:g} s, got "
            f"{times[0]:g} s to {times[-1]:g} s"
        )
    return Cam(times, plan.jet(times, 2), _error(plan, times, peaks, jumps))


def _resolving(plan: Trajectory, peaks: Array, jumps: list[tuple[float, int, float]]) -> Array:
    """Times of points between which the error of the position is at most `_TOLERANCE` of its range.

    Before a jump of the acceleration there is one short interval.

    Parameters
    ----------
    plan : Trajectory
        The plan.
    peaks : ndarray, shape (nsegments, naxes)
        Bounds of the sixth derivative.
    jumps : list of (float, int, float)
        Time [s], axis and magnitude of each jump of an acceleration.
    """
    extrema = plan.extrema()
    allowed = _TOLERANCE * (extrema.maximum - extrema.minimum)
    with np.errstate(divide="ignore", invalid="ignore"):
        longest = np.where(peaks > 0.0, (allowed / _HERMITE[0] / peaks) ** (1.0 / 6.0), np.inf).min(axis=1)
    last = np.full(longest.size, np.inf)
    for time, axis, size in jumps:
        segment = int(np.searchsorted(plan.breakpoints, time)) - 1
        # Half of the longest interval has 1/64 of the other error.
        length = min(0.5 * longest[segment], math.sqrt(63.0 / 64.0 * allowed[axis] / (_JUMP[0] * size)))
        last[segment] = min(last[segment], length)
    parts: list[Array] = []
    for (begin, end), length, short in zip(pairwise(plan.breakpoints.tolist()), longest, last, strict=True):
        count = math.ceil(max((end - begin) / length, 1.0))
        if short < (end - begin) / count:
            count = math.ceil(max((end - short - begin) / length, 1.0))
            parts += [np.linspace(begin, end - short, count + 1), np.array([end])]
        else:
            parts.append(np.linspace(begin, end, count + 1))
    return np.unique(np.concatenate(parts))


def _error(plan: Trajectory, times: Array, peaks: Array, jumps: list[tuple[float, int, float]]) -> Array:
    """Bound (3, naxes) of the error between points; jumps as for `_resolving`."""
    h = np.diff(times)
    segment = np.searchsorted(plan.breakpoints, times[:-1], side="right") - 1
    error = _HERMITE[:, None, None] * h[:, None] ** (6 - _ORDERS)[:, None, None] * peaks[segment]
    for time, axis, size in jumps:
        before = int(np.searchsorted(times, time)) - 1
        error[:, before, axis] += _JUMP * h[before] ** (2 - _ORDERS) * size
    return error.max(axis=1)
