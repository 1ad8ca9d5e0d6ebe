"""Tables as CSV: a header line, then one line per time."""

from __future__ import annotations

import bz2
import csv
import gzip
import io
import lzma
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ctrlplan._files import write_bytes
from ctrlplan.trajectories.export.formats import Options, SampledTable, TableFormat, sampled
from ctrlplan.trajectories.trajectory import Trajectory

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


class CSV(TableFormat):
    """Comma-separated values, exact to every bit.

    Names that a spreadsheet would read as a formula get an apostrophe as prefix.
    """

    def encoded(self, table: SampledTable) -> str:
        """Text of the file; as `TableFormat.encoded`."""
        names = (f"'{name}" if name.startswith(_FORMULA) else name for name in table.names)
        columns = np.concatenate([table.times[None], table.rows]).T
        rows = (",".join(map(repr, row)) for row in columns.tolist())  # the shortest decimals that read back the same
        return "\n".join([csv_line(["time", *names]), *rows, ""])


def csv_line(names: list[str]) -> str:
    """Names between commas, quoted where necessary."""
    line = io.StringIO(newline="")
    csv.writer(line, lineterminator="\r\n").writerow(names)  # csv then quotes names that contain either character
    return line.getvalue()[:-2]


def write_csv(plan: Trajectory, path: str | os.PathLike[str], options: Options) -> None:
    """Write samples of a plan to a file of any name, which numpy's suffixes compress."""
    packers: dict[str, Callable[[bytes], bytes]] = {".gz": gzip.compress, ".bz2": bz2.compress, ".xz": lzma.compress}
    write_bytes(path, packers.get(Path(path).suffix, bytes)(CSV().encoded(sampled(plan, options)).encode()))
