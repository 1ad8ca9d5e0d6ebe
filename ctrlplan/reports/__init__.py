"""Tables, figures and pages: where results are shown."""

from ctrlplan import _renamed
from ctrlplan.reports.crane_figures import plot_motion, plot_online, plot_paths, plot_sketch, plot_step, plot_time
from ctrlplan.reports.explore import Explorer
from ctrlplan.reports.figures import (
    plot_bands,
    plot_blocks,
    plot_curves,
    plot_plane,
    plot_plans,
    plot_responses,
    plot_sweep,
    plot_trajectory,
)
from ctrlplan.reports.page import CraneAnimation, comparison_fragment, render_page, write_all, write_page, write_report
from ctrlplan.reports.parts import Cell, Head, Items, MetricsTable, Part, Picture, Svg, Table, Text
from ctrlplan.reports.path_figure import plot_path
from ctrlplan.reports.planning_figures import plot_baselines
from ctrlplan.reports.sections import draw
from ctrlplan.studies.verdicts import Verdict, summary, verdicts

__all__ = [
    "Cell",
    "CraneAnimation",
    "Explorer",
    "Head",
    "Items",
    "MetricsTable",
    "Part",
    "Picture",
    "Svg",
    "Table",
    "Text",
    "Verdict",
    "comparison_fragment",
    "draw",
    "plot_bands",
    "plot_baselines",
    "plot_blocks",
    "plot_curves",
    "plot_motion",
    "plot_online",
    "plot_path",
    "plot_paths",
    "plot_plane",
    "plot_plans",
    "plot_responses",
    "plot_sketch",
    "plot_step",
    "plot_sweep",
    "plot_time",
    "plot_trajectory",
    "render_page",
    "summary",
    "verdicts",
    "write_all",
    "write_page",
    "write_report",
]

__getattr__ = _renamed.renamed_members(__name__, {"plot_rivals": "plot_baselines"})
