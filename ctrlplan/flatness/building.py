"""Maps of a flat plant from its structure."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctrlplan._types import Array
from ctrlplan.flatness.analysis import Analysis
from ctrlplan.flatness.maps import SINGULAR, FlatMaps, regularity
from ctrlplan.symbolic.tape import Tape
from ctrlplan.symbolic.taping import tape_of


def maps_of(analysis: Analysis) -> FlatMaps:
    """Maps of an analysed plant."""
    structure, equations = analysis.structure, analysis.equations
    z, mu, p = structure.z, structure.mu, structure.p
    flags = ca.vertcat(*structure.flags)
    influence = ca.jacobian(structure.last, mu)
    nz = z.numel()
    slopes = tape_of((z, p), ca.jacobian(flags, z), matrix=True)
    start = _regular(structure.point[:nz], structure.scales[:nz], structure.nstates, slopes, equations.values)
    return FlatMaps(
        orders=structure.orders,
        nstates=structure.nstates,
        flags=tape_of((z, p), flags),
        slopes=slopes,
        last=tape_of((z, mu, p), ca.horzcat(structure.last, influence)),
        controls=tape_of((z, mu, p), structure.controls),
        forward=tape_of(equations.variables, _forward(analysis)),
        sides=tape_of(equations.variables, analysis.sides),
        notes=analysis.notes,
        names=(*equations.states, *(str(z[k].name()) for k in range(structure.nstates, nz))),
        start=start,
        scales=structure.scales[:nz],
        mu=structure.point[nz:],
        mu_scales=structure.scales[nz:],
        affine=not ca.depends_on(influence, mu),
    )


def _regular(point: Array, scales: Array, nstates: int, slopes: Tape, p: Array) -> Array:
    """State at the operating point or, where it is singular, near it."""
    rng = np.random.default_rng(0)
    trials = [point]
    trials += [point + scales * (np.arange(point.size) == k) for k in range(nstates, point.size)]
    trials += [point + 0.2 * scales * rng.uniform(-1.0, 1.0, point.size) for _ in range(20)]
    sizes = [regularity(slopes(trial, p) * scales) for trial in trials]
    return trials[0] if sizes[0] > SINGULAR else trials[int(np.argmax(sizes))]


def _forward(analysis: Analysis) -> ca.SX:
    """Flags with the controls constant, all up to the highest order."""
    equations = analysis.equations
    rows = []
    for entry in ca.vertsplit(equations.flat):
        value = entry
        rows.append(value)
        for _ in range(max(analysis.structure.orders)):
            value = ca.cse(ca.jtimes(value, equations.x, equations.rates))
            rows.append(value)
    return ca.vertcat(*rows)
