"""Plans and responses as files of other programs: one module a format, one table of endings."""

from ctrlplan.trajectories.export.endings import ENDINGS, check_options, ending_of, export_plan, export_table
from ctrlplan.trajectories.export.formats import FlatMaps, Format, Options, Table, TableFormat, sampled

__all__ = [
    "ENDINGS",
    "FlatMaps",
    "Format",
    "Options",
    "Table",
    "TableFormat",
    "check_options",
    "ending_of",
    "export_plan",
    "export_table",
    "sampled",
]
