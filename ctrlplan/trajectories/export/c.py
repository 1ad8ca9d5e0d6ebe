"""Plans as C99 source and header, without memory allocation or libraries."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ctrlplan._types import Array
from ctrlplan.trajectories.export.cells import Cells, cells_of, taylor
from ctrlplan.trajectories.export.formats import Files, Format, Options, plain, with_duration
from ctrlplan.trajectories.files import signal_names
from ctrlplan.trajectories.trajectory import Trajectory

_HEADER = """\
/* Plan from @START@ s to @END@ s; axes in this order: @LABELS@.
 *
 * Polynomials of degree @DEGREE@ in @CELLS@ cells. Bound of their error, added to the rounding of the plan's own
 * values:
@ERRORS@ */
#ifndef @UPPER@_H
#define @UPPER@_H

#ifdef __cplusplus
extern "C" {
#endif

#define @UPPER@_AXES @AXES@
#define @UPPER@_DERIVATIVES @DERIVATIVES@
#define @UPPER@_SEGMENTS @SEGMENTS@
#define @UPPER@_START @START@
#define @UPPER@_END @END@

/* Position and derivatives, jet[k][axis] the k-th, at a time [s]. Constant at the initial position before
 * the start, and at the final one after the end. */
void @NAME@_jet(double t, double jet[@UPPER@_DERIVATIVES + 1][@UPPER@_AXES]);

/* Segment at a time [s], from 0; the first before the start, the last after the end. */
int @NAME@_segment(double t);

/* Start of a segment [s]. */
double @NAME@_segment_start(int segment);

/* The same jet in single precision, at a time s [s] since the start of a segment. A segment number out of range is
 * clipped, and a time outside of the segment extrapolates the polynomial at that end. */
void @NAME@_jetf(int segment, float s, float jet[@UPPER@_DERIVATIVES + 1][@UPPER@_AXES]);

#ifdef __cplusplus
}
#endif

#endif
"""

_SOURCE = """\
#include "@FILE@"

#define AXES @UPPER@_AXES
#define DERIVATIVES @UPPER@_DERIVATIVES
#define SEGMENTS @UPPER@_SEGMENTS
#define DEGREE @DEGREE@
#define CELLS @CELLS@

/* Of each segment: start [s], first cell, cells per second and inverse radius of a cell [1/s]. */
static const double starts[SEGMENTS] = @STARTS@;
static const int firsts[SEGMENTS + 1] = @FIRSTS@;
static const double rates[SEGMENTS] = @RATES@;
static const double inverses[SEGMENTS] = @INVERSES@;
static const float rates_f[SEGMENTS] = @RATES_F@;
static const float inverses_f[SEGMENTS] = @INVERSES_F@;

/* Of each cell: centre [s] from the start of its segment, and coefficients of the powers of
 * (time - centre) / radius, the highest first. */
static const double centres[CELLS] = @CENTRES@;
static const float centres_f[CELLS] = @CENTRES_F@;
static const double coefficients[CELLS][AXES][DEGREE + 1] = @COEFFICIENTS@;
static const float coefficients_f[CELLS][AXES][DEGREE + 1] = @COEFFICIENTS_F@;

/* Before the start, at the end and after it. */
static const double held[3][DERIVATIVES + 1][AXES] = @HELD@;

int @NAME@_segment(double t)
{
    int low = 0, high = SEGMENTS;
    while (high - low > 1) {
        int middle = low + (high - low) / 2;
        if (t < starts[middle]) {
            high = middle;
        } else {
            low = middle;
        }
    }
    return low;
}

double @NAME@_segment_start(int segment)
{
    return starts[segment < 0 ? 0 : segment < SEGMENTS ? segment : SEGMENTS - 1];
}
"""

_JET = """
void @NAME@_jet@F@(@ARGUMENTS@, @REAL@ jet[DERIVATIVES + 1][AXES])
{
@PLACE@    int first = firsts[segment], count = firsts[segment + 1] - first;
    @REAL@ place = s * rates@_F@[segment], inverse = inverses@_F@[segment];
    int cell = first + (place > 0 ? (place < (@REAL@)count ? (int)place : count - 1) : 0);
    @REAL@ w = (s - centres@_F@[cell]) * inverse;
    for (int axis = 0; axis < AXES; axis++) {
        const @REAL@ *c = coefficients@_F@[cell][axis];
        @REAL@ value[DERIVATIVES + 1] = {0}, power = 1;
        for (int i = 0; i <= DEGREE; i++) {
            for (int k = DERIVATIVES; k > 0; k--) {
                value[k] = value[k] * w + (@REAL@)k * value[k - 1];
            }
            value[0] = value[0] * w + c[i];
        }
        for (int k = 0; k <= DERIVATIVES; k++) {
            jet[k][axis] = value[k] * power;
            power *= inverse;
        }
    }
}
"""

_DOUBLE = """\
    if (t < @UPPER@_START || t >= @UPPER@_END) {
        int place = t < @UPPER@_START ? 0 : t > @UPPER@_END ? 2 : 1;
        for (int k = 0; k <= DERIVATIVES; k++) {
            for (int axis = 0; axis < AXES; axis++) {
                jet[k][axis] = held[place][k][axis];
            }
        }
        return;
    }
    int segment = @NAME@_segment(t);
    double s = t - starts[segment];
"""

_SINGLE = """\
    segment = segment < 0 ? 0 : segment < SEGMENTS ? segment : SEGMENTS - 1;
"""


class C99(Format):
    """Header and source in one folder: ``NAME_jet(t, jet)`` for a file called ``NAME.c``.

    Polynomials are centred in their cell. A variant in single precision takes a
    segment and the time since its start.
    """

    accepted = ("derivatives",)

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        found = cells_of(with_duration(plan, ".c"), options.derivatives, centred=True)
        name = re.sub(r"^(?![A-Za-z])", "plan_", re.sub(r"\W", "_", path.stem, flags=re.ASCII))
        header = path.with_suffix(".h")
        entries = _numbers(plan, options.derivatives) | _entries(found) | _single(plan, found)
        error = np.max([cells.error for cells in found], axis=0).T.ravel().tolist()
        signals = zip(map(plain, signal_names(plan.labels, options.derivatives)), error, strict=True)
        entries |= {
            "NAME": name,
            "UPPER": name.upper(),
            "FILE": header.name,
            "LABELS": ", ".join(map(plain, plan.labels)),
            "ERRORS": "".join(f" *   {signal}: {bound:.3g}\n" for signal, bound in signals),
        }
        double = {"F": "", "_F": "", "REAL": "double", "ARGUMENTS": "double t", "PLACE": _filled(_DOUBLE, entries)}
        single = {"F": "f", "_F": "_f", "REAL": "float", "ARGUMENTS": "int segment, float s", "PLACE": _SINGLE}
        bodies = [_filled(_JET, entries | kind) for kind in (double, single)]
        return {path: _filled(_SOURCE, entries) + "".join(bodies), header: _filled(_HEADER, entries)}


def _numbers(plan: Trajectory, derivatives: int) -> dict[str, str]:
    """Entries of the plan as a whole."""
    held = np.zeros((3, derivatives + 1, plan.naxes))
    held[0, 0], held[1], held[2, 0] = plan.initial, plan.jet(plan.end, derivatives), plan.final
    return {
        "START": repr(plan.start),
        "END": repr(plan.end),
        "AXES": str(plan.naxes),
        "DERIVATIVES": str(derivatives),
        "HELD": _array(held),
    }


def _entries(found: list[Cells]) -> dict[str, str]:
    """Tables in double precision."""
    counts = [cells.anchors.size for cells in found]
    degree = max(cells.coefficients.shape[2] for cells in found) - 1
    return {
        "SEGMENTS": str(len(found)),
        "CELLS": str(sum(counts)),
        "DEGREE": str(degree),
        "FIRSTS": "{" + ", ".join(map(str, [0, *np.cumsum(counts).tolist()])) + "}",
        "STARTS": _array([cells.start for cells in found]),
        "RATES": _array([cells.anchors.size / cells.edges[-1] for cells in found]),
        "INVERSES": _array([1.0 / cells.radius for cells in found]),
        "CENTRES": _array(np.concatenate([cells.anchors for cells in found])),
        "COEFFICIENTS": _array(_padded([cells.coefficients for cells in found], degree)),
    }


def _single(plan: Trajectory, found: list[Cells]) -> dict[str, str]:
    """Tables in single precision, about centres and with radii rounded to it."""
    degree = max(cells.coefficients.shape[2] for cells in found) - 1
    with np.errstate(over="ignore", under="ignore"):
        inverses = np.array([1.0 / cells.radius for cells in found]).astype(np.float32)
        centres = [cells.anchors.astype(np.float32) for cells in found]
        tables = [
            taylor(plan, k, centres[k].astype(float), 1.0 / float(inverses[k]), cells.coefficients.shape[2] - 1)
            for k, cells in enumerate(found)
        ]
        coefficients = _padded(tables, degree).astype(np.float32)
        rates = np.array([cells.anchors.size / cells.edges[-1] for cells in found]).astype(np.float32)
    if not (np.isfinite(coefficients).all() and np.isfinite([inverses, rates]).all()):
        raise ValueError(
            "positions and durations of segments must lie within single precision for C, got coefficients of up to "
            f"{np.abs(_padded(tables, degree)).max():.3g}; choose units nearer to the plan's"
        )
    return {
        "RATES_F": _array(rates, single=True),
        "INVERSES_F": _array(inverses, single=True),
        "CENTRES_F": _array(np.concatenate(centres), single=True),
        "COEFFICIENTS_F": _array(coefficients, single=True),
    }


def _padded(tables: Iterable[Array], degree: int) -> Array:
    """Coefficients (ncells, naxes, degree + 1) of all cells, the highest first."""
    return np.concatenate([np.pad(t, ((0, 0), (0, 0), (0, degree + 1 - t.shape[2]))) for t in tables])[:, :, ::-1]


def _array(values: object, single: bool = False) -> str:
    """Nested initialiser of C, exact to every bit."""
    if isinstance(values, np.ndarray) and values.ndim > 1:
        return "{\n" + ",\n".join(_array(row, single) for row in values) + "}"
    numbers = np.asarray(values).tolist()
    return "{" + ", ".join(f"{v:.8e}f" if single else repr(v) for v in numbers) + "}"


def _filled(text: str, entries: dict[str, str]) -> str:
    """Text with the placeholders replaced by entries."""
    return re.sub(r"@(\w+?)@", lambda found: entries[found[1]], text)
