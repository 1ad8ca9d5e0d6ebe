"""Plans as coefficients of piecewise polynomials."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from ctrlplan.trajectories.export.cells import cells_of
from ctrlplan.trajectories.export.formats import Files, Format, Options, one_period
from ctrlplan.trajectories.files import signal_names
from ctrlplan.trajectories.trajectory import Trajectory


class PPolyJSON(Format):
    """JSON with the arrays of `scipy.interpolate.PPoly`.

    Entries: ``labels``; ``x``, times of the cells' ends [s], shape (ncells + 1,);
    ``c``, coefficients of the powers of the time since the start of a cell, the
    highest first, shape (degree + 1, ncells, naxes); ``error``, by signal, the
    bound of the distance from the plan, given its exact derivatives; for a plan that
    repeats for all future times ``extrapolate``, "periodic".
    """

    accepted = ("derivatives",)

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        endless = math.isinf(plan.end)
        plan = one_period(plan, ".ppoly.json")
        found = cells_of(plan, options.derivatives, centred=False)
        size = max(cells.coefficients.shape[2] for cells in found)
        columns = []
        for cells in found:
            powers = cells.coefficients / cells.radius ** np.arange(cells.coefficients.shape[2])
            columns.append(np.pad(powers, ((0, 0), (0, 0), (0, size - powers.shape[2]))))
        error = np.max([cells.error for cells in found], axis=0)
        edges = [(cells.start + cells.edges[:-1]).tolist() for cells in found]
        data = {
            "type": "PPoly",
            **({"extrapolate": "periodic"} if endless else {}),
            "labels": list(plan.labels),
            "x": [*(time for times in edges for time in times), plan.end],
            "c": np.concatenate(columns).transpose(2, 0, 1)[::-1].tolist(),
            "error": dict(zip(signal_names(plan.labels, options.derivatives), error.T.ravel().tolist(), strict=True)),
        }
        return {path: json.dumps(data, allow_nan=False) + "\n"}
