"""Export of plans and responses to files of other programs: one module per format."""

from ctrlplan.trajectories.export.endings import ENDINGS, check_options, ending_of, export_plan, export_table
from ctrlplan.trajectories.export.formats import FlatMaps, Format, Options, SampledTable, TableFormat, sampled

__all__ = [
    "ENDINGS",
    "FlatMaps",
    "Format",
    "Options",
    "SampledTable",
    "TableFormat",
    "check_options",
    "ending_of",
    "export_plan",
    "export_table",
    "sampled",
]
