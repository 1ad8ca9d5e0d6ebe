"""Tables for MATLAB and Simulink."""

from __future__ import annotations

import io
import re

from ctrlplan.trajectories.export.formats import SampledTable, TableFormat


class MAT(TableFormat):
    """MAT file (level 5): ``time``, and each signal as a structure with time.

    A structure has the fields ``time`` (ntime, 1), ``signals.values`` (ntime, 1)
    and ``signals.dimensions``, as the Simulink block From Workspace requires.
    Characters of names that MATLAB does not allow are replaced by underscores.
    """

    def encoded(self, table: SampledTable) -> bytes:
        """Content of the file; as `TableFormat.encoded`."""
        from scipy.io import savemat  # it adds a twentieth to the import of the package

        time = table.times[:, None]
        variables: dict[str, object] = {"time": time}
        for name, row in zip(table.names, table.rows, strict=True):
            allowed = re.sub(r"^(?![A-Za-z])", "s_", re.sub(r"\W", "_", name, flags=re.ASCII))
            if allowed in variables or len(allowed) > 63:
                raise ValueError(
                    f"signals must have different names of at most 63 letters, digits and underscores in MATLAB, got "
                    f"{name!r}, which becomes {allowed!r}; rename an axis"
                )
            variables[allowed] = {"time": time, "signals": {"values": row[:, None], "dimensions": 1.0}}
        data = io.BytesIO()
        savemat(data, variables)
        return data.getvalue()
