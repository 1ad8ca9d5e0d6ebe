"""Reference governor of the crane: a linear model of its horizontal motion, for every length of the rope."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import control as ct
import numpy as np

from ctrlplan._types import Array
from ctrlplan.studies.crane_setup import CRANE, DriveLimits, nominal_waypoints
from ctrlplan.studies.measures import signals_of
from ctrlplan.studies.sections import Curves
from ctrlplan.systems import AdmissibleSet, create_command_filter_iosystem
from ctrlplan.systems.plants import LoadFeedbackLaw, crane_loop
from ctrlplan.trajectories import Step, Trajectory

START = nominal_waypoints(1)[0].position
LAW = LoadFeedbackLaw(load_bandwidth=0.5)
FILTER, LAGS = 0.8, 5
"""Bandwidth [rad/s] and order of the filter after the governor, so that the trolley force is continuous."""
PERIOD = 0.5
"""Period of the governor [s]."""
SHARE, SWAY = 0.9, 0.2
"""Limits of the governor: share of the force limit, and sway [rad]."""
DEPTH = 0.5 * (float(START[1]) + 11.0)
"""Depth at which the model is linearised [m]: the mean of start and goal."""
_STEP = 1e-4
"""Step of central differences in time [s]."""


def filtered_loop(wind: Trajectory | None = None, limits: DriveLimits | None = None) -> ct.InterconnectedSystem:
    """Crane with load feedback and with filters for the commands x_command and z_command."""
    filters = [
        create_command_filter_iosystem(FILTER, 2, LAGS, initial=start, inputs=f"{axis}_command", outputs=f"{axis}_ref")
        for axis, start in zip(("x", "z"), START.tolist(), strict=True)
    ]
    held, inputs = Step(START, START, labels=["x", "z"]), ["x_command", "z_command"]
    return crane_loop(CRANE, held, LAW, reference=filters, inputs=inputs, wind=wind, **(limits or DriveLimits()))


class AtLoadMotion:
    """Admissible references of the crane, by a linear model at the motion of the load that is measured.

    The trolley reference of the load feedback is proportional to the rope
    length. The model, linearised at one depth, takes the states of a crane with
    a rope of that length which has the same motion of the load and the same
    error of the trolley as the crane measured, so that it has the same force.
    The measured trolley position and angle in place of these would mean another
    error, which the drive multiplies by some 10^6 N/m. Vertical acceleration is
    neglected.

    Parameters
    ----------
    force : float
        Limit of the trolley force [N].

    Attributes
    ----------
    references, states : tuple of str
        Governed inputs, and states, of `filtered_loop`.
    """

    references = ("x_command",)

    def __init__(self, force: float) -> None:
        self.states = tuple(filtered_loop().state_labels)
        self._set = admissible_set(force)

    def fraction(self, x: Array, v: Array, r: Array) -> float:
        """Largest admissible fraction of the way from v to r, as of `AdmissibleSet`."""
        return self._set.fraction(model_states(dict(zip(self.states, x, strict=True))), v, r)


@cache
def horizontal_model() -> tuple[ct.StateSpace, Array]:
    """Horizontal motion linearised at the mean depth, and the equilibrium there in its states."""
    loop = filtered_loop()
    rest = np.array(loop.initial_state)
    rest[loop.nstates - 6 :] = CRANE.equilibrium(0.0, DEPTH)[0]
    rest[LAGS] = DEPTH
    linear = ct.linearize(loop, rest, [0.0, DEPTH])
    across = ("x_ref", "trolley", "crane_D", "crane_theta")
    rows = [k for k, label in enumerate(loop.state_labels) if label.startswith(across)]
    outputs = [loop.output_labels.index(label) for label in ("F", "theta")]
    a, b, c = (np.asarray(matrix) for matrix in (linear.A, linear.B, linear.C))
    model = ct.ss(
        a[np.ix_(rows, rows)],
        b[rows, :1],
        c[np.ix_(outputs, rows)],
        np.zeros((2, 1)),
        inputs=["x_command"],
        outputs=["F", "theta"],
        states=[loop.state_labels[k] for k in rows],
    )
    return model, rest[rows]


@cache
def admissible_set(force: float) -> AdmissibleSet:
    """Admissible set of the linear model for 90 % of a force limit."""
    model, rest = horizontal_model()
    limits = {"F": (-SHARE * force, SHARE * force), "theta": (-SWAY, SWAY)}
    return AdmissibleSet(model, limits, PERIOD, margin=0.05, origin=(rest, 0.0))


def model_states(measured: dict[str, float]) -> Array:
    """States of the linear model with the load motion and the trolley error of a crane.

    Parameters
    ----------
    measured : dict of str to float
        States of `filtered_loop` by label.
    """
    model, rest = horizontal_model()
    plant, law = _blocks()
    crane = np.array([measured[f"crane_{label}"] for label in plant.state_labels])
    seen = dict(zip(plant.output_labels, plant.output(0.0, crane, np.zeros(2)), strict=True))
    load = np.array([seen["x"], seen["x_d1"], -CRANE.gravity * np.tan(seen["theta"])])
    jets = [np.array([measured[f"{axis}_ref_filter_{axis}_ref{d}"] for d in _ORDERS]) for axis in ("x", "z")]

    def away(later: float) -> float:
        """Trolley reference of the linear model minus that of the crane."""
        powers = np.array([1.0, later, 0.5 * later**2, later**3 / 6.0])
        x, z = (np.array([jet[k:] @ powers[: 4 - k] for k in range(3)]) for jet in jets)
        moved = [load[k:] @ powers[: 3 - k] for k in range(2)]
        start, gradient = _linear_law()
        at_depth = start + gradient @ np.array([*x, *moved])
        return at_depth - float(law.output(0.0, np.zeros(0), np.array([*x, *z, *moved]))[0])

    trolley = measured["crane_D"] + away(0.0)
    speed = measured["crane_D_d1"] + (away(_STEP) - away(-_STEP)) / (2.0 * _STEP)
    offset = dict(zip(model.state_labels, rest.tolist(), strict=True))["crane_D"]
    moved = measured | {
        "crane_D": trolley,
        "crane_theta": (load[0] - (trolley - offset)) / DEPTH,
        "crane_D_d1": speed,
        "crane_theta_d1": (load[1] - speed) / DEPTH,
    }
    return np.array([moved[label] for label in model.state_labels])


_ORDERS = ("", "_d1", "_d2", "_d3")


@cache
def _blocks() -> tuple[ct.NonlinearIOSystem, ct.NonlinearIOSystem]:
    return CRANE.iosystem(), LAW.build(CRANE)


@cache
def _linear_law() -> tuple[float, Array]:
    """Trolley reference of the linearised law: its value at x = 0, and its gradient to x_ref, its rates, x and x_d1."""
    law = _blocks()[1]
    rest = np.array([0.0, 0.0, 0.0, DEPTH, 0.0, 0.0, 0.0, 0.0])
    gradient = np.asarray(ct.linearize(law, [], rest).D)[0]
    return float(law.output(0.0, np.zeros(0), rest)[0]), gradient[[0, 1, 2, 6, 7]]


def governor_check(response: ct.TimeResponseData, force: float) -> tuple[tuple[str, ...], Curves]:
    """Force that the model of a governor predicts, and whether an admissible reference was always found.

    Parameters
    ----------
    response : control.TimeResponseData
        Of the governed crane.
    force : float
        Limit of the trolley force [N].

    Returns
    -------
    notes : tuple of str
        The result in words.
    curves : Curves
        Simulated and predicted force, and the limit of the governor.
    """
    model, rest = horizontal_model()
    t, signals, limit = np.asarray(response.time), signals_of(response), SHARE * force
    labels, states = list(response.state_labels), np.asarray(response.states)
    rows = {label: states[_row(labels, f"_{label}")] for label in filtered_loop().state_labels}
    own = np.array([rows[label] for label in model.state_labels])
    moved = np.array(
        [model_states(dict(zip(rows, column, strict=True))) for column in zip(*rows.values(), strict=True)]
    )
    gains = np.asarray(model.C)[0]
    predicted, plain = gains @ (moved.T - rest[:, None]), gains @ (own - rest[:, None])
    curves = Curves(
        "time [s]",
        "trolley force [kN]",
        t,
        {
            "simulated": signals["F"] / 1e3,
            "predicted by the linear model": predicted / 1e3,
            "limit of the governor": np.full(t.size, limit / 1e3),
            "negative limit of the governor": np.full(t.size, -limit / 1e3),
        },
        key="governor-force",
        caption="Governed crane: simulated trolley force, and the force that the linear model of the governor predicts "
        "at each time. An admissible reference exists where the model predicts forces within the limit from then on.",
    )
    return (
        f"{_found(response, labels, states, limit)} Its model is linearised at the mean depth of {DEPTH:g} m and "
        "evaluated for the measured motion of the load and error of the trolley: for the states of the simulation it "
        f"predicts the force to within {np.abs(predicted - signals['F']).max():.1g} N (figure). Evaluated for the "
        "measured trolley position and angle, the same model would predict a force of up to "
        f"{np.abs(plain).max() / 1e3:.3g} kN, because the trolley reference of the load feedback is proportional to "
        "the rope length, and would then find no admissible reference.",
    ), curves


def _found(response: ct.TimeResponseData, labels: list[str], states: Array, limit: float) -> str:
    """Whether an admissible reference was always found, and otherwise whether the one held was admissible."""
    t, signals = np.asarray(response.time), signals_of(response)
    infeasible = states[_row(labels, "governor_infeasible")] > 0.5
    if not infeasible.any():
        return "The governor finds an admissible reference at every sample."
    after = t >= t[infeasible][0]
    force, sway = np.abs(signals["F"][after]).max(), np.abs(signals["theta"][after]).max()
    held = "satisfies" if force <= limit and sway <= SWAY else "violates"
    return (
        f"The governor finds no admissible reference for {100.0 * infeasible.mean():.2g} % of the time, first at "
        f"{t[infeasible][0]:.3g} s, and holds the previous one, which {held} the limits of the governor in the "
        f"simulation: from then on the peak force is {force / 1e3:.3g} kN with a limit of {limit / 1e3:.3g} kN, and "
        f"the peak sway {sway:.2g} rad with a limit of {SWAY:g} rad."
    )


def _row(labels: Sequence[str], state: str) -> int:
    """Row of the state of a block by the end of its label, which the block's name precedes."""
    return next(k for k, label in enumerate(labels) if label.endswith(state))
