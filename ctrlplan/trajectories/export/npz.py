"""Tables as numpy arrays, one per signal."""

from __future__ import annotations

import io
import zipfile

from numpy.lib.format import write_array

from ctrlplan.trajectories.export.formats import SampledTable, TableFormat


class NPZ(TableFormat):
    """Archive for `numpy.load`: ``time`` and each signal by its name, shape (ntime,)."""

    def encoded(self, table: SampledTable) -> bytes:
        """Content of the file; as `TableFormat.encoded`."""
        data = io.BytesIO()
        # Not by numpy.savez, whose arguments cannot be names of signals.
        with zipfile.ZipFile(data, "w") as archive:
            for name, row in zip(("time", *table.names), (table.times, *table.rows), strict=True):
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    write_array(member, row)
        return data.getvalue()
