"""Plan the reference that a closed loop should follow, and show what that is worth.

Imported beside python-control: ``import control as ct; import ctrlplan as cp``.
"""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

_EXPORTS = {
    "traits": ("BlockTraits", "declare", "traits_of"),
    "trajectories": (
        "PiecewiseSpline",
        "PolySpline",
        "Retimed",
        "SCurve",
        "Shaper",
        "Step",
        "Trajectory",
        "Transition",
        "Trapezoid",
        "TrigSpline",
        "Waypoint",
        "WaypointSpline",
        "load_trajectory",
        "stack",
        "trajectory_from_dict",
    ),
    "planning": (
        "AlphaChoice",
        "Avoidance",
        "Clearance",
        "Disc",
        "Fastest",
        "HalfPlane",
        "Limits",
        "Margins",
        "Optimum",
        "PeakDerivative",
        "Rectangle",
        "SquaredDerivative",
        "avoid",
        "choose_alpha",
        "clearance",
        "fastest",
        "margins",
        "optimize_waypoints",
    ),
    "systems": (
        "AdmissibleSet",
        "Law",
        "command_filter_gains",
        "command_lead",
        "create_command_filter_iosystem",
        "create_delay_iosystem",
        "create_feedforward_iosystem",
        "create_flat_iosystem",
        "create_governor_iosystem",
        "create_pid_iosystem",
        "create_replanner_iosystem",
        "create_saturation_iosystem",
        "create_source_iosystem",
        "create_time_scaling_iosystem",
        "expose_states",
        "flat_quantities",
        "plants",
        "sample_hold",
        "source_samples",
    ),
    "simulation": (
        "Event",
        "Occurrence",
        "Predictor",
        "Prepared",
        "SimulationResponse",
        "SolverError",
        "prepare",
        "simulate",
    ),
    "studies": (
        "Benefit",
        "Comparison",
        "Ensemble",
        "Experiment",
        "Measure",
        "Sweep",
        "benefit",
        "compare",
        "draws",
        "monte_carlo",
        "sweep",
    ),
}
_HOME = {name: module for module, names in _EXPORTS.items() for name in names}

__all__ = sorted([*_HOME, "metrics"])


def __getattr__(name: str) -> Any:
    if name == "metrics":
        return import_module("ctrlplan.metrics")
    if name not in _HOME:
        raise AttributeError(f"module 'ctrlplan' has no attribute {name!r}")
    return getattr(import_module(f"ctrlplan.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
