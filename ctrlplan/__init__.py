"""Planned references for closed loops: what to call for what, in the order of work.

Used alongside python-control: ``import control as ct; import ctrlplan as cp``. Each name below has a
docstring with an example, ``help(cp.compare)``; the README has a line of code for each job.

Plan a move
    Waypoint                  time, position and derivatives that a plan must meet; None leaves one free
    TrigSpline, PolySpline    one spline through all waypoints: trigonometric, polynomial (alpha = 0)
    PiecewiseSpline           one spline for each segment, continuous in the derivatives left free
    SCurve, Trapezoid, Step   moves with limited jerk, with limited acceleration, without limits
    PathPlan                  path of a vehicle that stops and turns back: curves, directions, time laws
    Clipped, MotionProfile    part of a plan; what a stop (``plan.stop``) consists of
    Shaper                    input shaping of any plan, against known modes or a measured spectrum
    residual_spectrum         vibration that a plan leaves in a mode, by frequency; residual_plot draws it
    stack                     plans of single axes as one plan
    waypoints_from_csv        waypoints from a table, with times or at a speed
    fit                       plan through samples, within a tolerance or smoothed
    as_trajectory             plans from splines of scipy and from results of python-control
    load_trajectory, trajectory_from_dict    stored plans
    Trajectory                what all plans have: values, extrema, stop, repeat, plot, export, algebra
    WaypointSpline            base class of a spline of your own
Choose what is left free
    choose_alpha              shape by an objective: PeakDerivative, SquaredDerivative -> AlphaChoice
    optimize_waypoints        derivatives and times at via points, by minimum jerk or snap -> Optimum
    fastest                   minimum duration under limits, of a loop's signals too -> Fastest, Retimed
    Limits, Region            limits on one side, of a rate, of an RMS, over time; a region of two signals
    margins                   how near a plan is to its limits, and when, for which parameters -> Margins
    loop_quantities           signals of a loop along a plan, for limits on them
    avoid, clearance          around Rectangle, Disc, HalfPlane -> Avoidance, Clearance: certified
Build the loop
    create_source_iosystem    plan as a block with outputs y, y_d1, ...; source_samples: the same as arrays
    create_pid_iosystem       PID with limits and anti-windup
    create_saturation_iosystem, create_delay_iosystem    limits of an actuator, transport delay
    flat_system               flat system of a plant, from its equations -> DerivedFlatSystem, NotFlatError
    FlatSystem                flat system from maps of your own
    TrigFamily                trigonometric basis for control.flatsys
    flat_candidates           which outputs are flat -> FlatCandidate
    check_flat                maps against the equations -> FlatCheck
    flat_loop                 plan, law and flat plant as one loop; laws: FlatLaw, TVLQR, Feedforward
    create_flat_feedforward_iosystem    states and inputs along a plan, for a controller of your own
    reference_window          states and inputs ahead, for model predictive control
    create_flat_iosystem      flat control of a flat plant
    create_feedforward_iosystem    command with which a linear loop follows a plan -> PlannedFeedforward
    fit_feedforward           feedforward gains and delay from a log -> FeedforwardFit
    sample_hold               discrete block in a continuous loop; expose_states: states among the outputs
    create_shaper_iosystem    input shaping of an operator's commands, also for a measured frequency
    create_command_filter_iosystem    filter with derivative outputs; command_filter_gains: its feedforward
    plants                    crane, car, quadrotor, levitation, drives, ... -> Plant; Law: laws of the crane
    declare, traits_of        what the simulation must know of a block of your own -> BlockTraits
Simulate
    simulate                  response of any python-control system -> SimulationResponse; exact if linear
    prepare                   the built form, for many runs -> Prepared; .start(dt): step by step -> Stepper
    Event                     a limit whose crossing is recorded or ends the run -> Occurrence
    SolverError               raised where an integrator fails
    read_log                  measured signals of a machine, for a Comparison, as a response
Compare and report
    compare                   plans in one loop, with metrics, figures and a page -> Comparison
    benefit                   planning against steps, profiles and shaped steps -> Benefit
    sweep                     over a parameter -> Sweep
    monte_carlo, draws        over random parameters -> Ensemble
    Experiment, Measure       what is compared, once, for many loops; a metric of your own
    explore                   sliders for a plan and its response, in Jupyter
    metrics                   settling time, overshoot, IAE, ... as functions of (timepts, signal)
On line
    create_replanner_iosystem       fits the plan again while the loop runs; Transition: its linear law
    create_governor_iosystem        reference within limits; AdmissibleSet (linear), Predictor (nonlinear)
    create_time_scaling_iosystem    slows the plan as an error grows
Without Python
    ``ctrlplan new STUDY.toml``, ``ctrlplan report``, ``ctrlplan plan``: see `ctrlplan.studies.files`
Old names, which warn
    command_lead, flat_quantities

Glossary
    jet        position and derivatives at one time, an array (order + 1, naxes)
    flag       jet of one flat output up to the order that states and inputs need
    alpha      shape parameter of a trigonometric spline [rad], from 0 (the polynomial) to below 2 pi:
               the duration of the plan in the angle tau of its basis, equation (4)
    gamma      phase of its highest harmonic; by default the mean of tau over the constraints
    segment    part of a plan between two waypoints
    degree     highest power of a polynomial, highest harmonic of a trigonometric spline
    order      highest derivative that something has or reads
    benefit    what a plan gains over the baselines: step, trapezoid, S-curve, shaped step, quintic
"""

from importlib import import_module
from typing import Any

from ctrlplan import _later

__version__ = "0.2.0"

_EXPORTS = {
    "traits": ("BlockTraits", "declare", "traits_of"),
    "trajectories": (
        "Clipped",
        "MotionProfile",
        "PathPlan",
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
        "as_trajectory",
        "fit",
        "load_trajectory",
        "residual_spectrum",
        "stack",
        "trajectory_from_dict",
        "waypoints_from_csv",
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
        "Region",
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
        "FeedforwardFit",
        "Law",
        "PlannedFeedforward",
        "command_filter_gains",
        "command_lead",
        "create_command_filter_iosystem",
        "create_delay_iosystem",
        "create_feedforward_iosystem",
        "TVLQR",
        "Feedforward",
        "FlatLaw",
        "create_flat_feedforward_iosystem",
        "create_flat_iosystem",
        "flat_loop",
        "reference_window",
        "create_governor_iosystem",
        "create_pid_iosystem",
        "create_replanner_iosystem",
        "create_saturation_iosystem",
        "create_shaper_iosystem",
        "create_source_iosystem",
        "create_time_scaling_iosystem",
        "expose_states",
        "fit_feedforward",
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
        "Stepper",
        "loop_quantities",
        "prepare",
        "read_log",
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
    "flatness": (
        "DerivedFlatSystem",
        "FlatCandidate",
        "FlatCheck",
        "FlatSystem",
        "NotFlatError",
        "TrigFamily",
        "check_flat",
        "flat_candidates",
        "flat_system",
    ),
    "reports.explore": ("explore",),
    "reports.vibration_figures": ("residual_plot",),
}
_HOME = {name: module for module, names in _EXPORTS.items() for name in names}

_FOLDERS = frozenset({"metrics"})
"""Folders that are public as a whole."""

__all__ = sorted([*_HOME, *_FOLDERS])


def __getattr__(name: str) -> Any:
    if name in _FOLDERS:
        return import_module(f"ctrlplan.{name}")
    return _later.loaded_later(globals(), _HOME)(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
