"""Comparisons of plans in one loop or many, and the studies of the paper."""

from ctrlplan.studies.benefit import Benefit, benefit
from ctrlplan.studies.comparison import Comparison
from ctrlplan.studies.crane import crane_first_order_study, crane_nominal_study, crane_obstacle_study
from ctrlplan.studies.draws import draws
from ctrlplan.studies.ensemble import Ensemble, Failure
from ctrlplan.studies.experiment import Experiment, Measured
from ctrlplan.studies.former import compare, sweep
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.linear import linear_study
from ctrlplan.studies.measured import MeasuredRun
from ctrlplan.studies.measures import MEASURES, Acting, Measure, Path, Run, Tracked
from ctrlplan.studies.monte_carlo import monte_carlo
from ctrlplan.studies.online import (
    online_goal_study,
    online_gust_study,
    online_payload_study,
    online_saturated_study,
)
from ctrlplan.studies.plans import standard_plans
from ctrlplan.studies.required_durations import RequiredDuration
from ctrlplan.studies.roles import Role, Stability
from ctrlplan.studies.sections import Section
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep

PAPER = {
    "linear": linear_study,
    "crane-nominal": crane_nominal_study,
    "crane-first-order": crane_first_order_study,
    "crane-obstacle": crane_obstacle_study,
}
"""Studies of the paper by name: functions of ``progress`` that return a `Study`."""

ONLINE = {
    "online-gust": online_gust_study,
    "online-payload": online_payload_study,
    "online-goal": online_goal_study,
    "online-saturated": online_saturated_study,
}
"""Studies of on-line methods by name, likewise."""

__all__ = [
    "MEASURES",
    "ONLINE",
    "PAPER",
    "Acting",
    "Benefit",
    "Comparison",
    "Ensemble",
    "Experiment",
    "Failure",
    "Grid",
    "Measure",
    "Measured",
    "MeasuredRun",
    "Path",
    "RequiredDuration",
    "Role",
    "Run",
    "Section",
    "Stability",
    "Study",
    "Sweep",
    "Tracked",
    "benefit",
    "compare",
    "crane_first_order_study",
    "crane_nominal_study",
    "crane_obstacle_study",
    "draws",
    "linear_study",
    "monte_carlo",
    "online_goal_study",
    "online_gust_study",
    "online_payload_study",
    "online_saturated_study",
    "standard_plans",
    "sweep",
]
