"""Tables, figures and pages: where results are shown."""

from ctrlplan.reports.figures import FIGURES, plot_plane, plot_plans, plot_responses, plot_sweep, plot_trajectory
from ctrlplan.reports.page import CraneAnimation, comparison_fragment, render_page, write_all, write_page, write_report
from ctrlplan.reports.words import Verdict, summary, verdicts

__all__ = [
    "FIGURES",
    "CraneAnimation",
    "Verdict",
    "comparison_fragment",
    "plot_plane",
    "plot_plans",
    "plot_responses",
    "plot_sweep",
    "plot_trajectory",
    "render_page",
    "summary",
    "verdicts",
    "write_all",
    "write_page",
    "write_report",
]
