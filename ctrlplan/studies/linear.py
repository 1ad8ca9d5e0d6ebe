"""The paper's section 2: a step and plans through k/(s^2 + s) in unity feedback."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import control as ct
import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from ctrlplan.simulation.exact import exact_states
from ctrlplan.studies.benefit import benefit
from ctrlplan.studies.comparison import Comparison, compare
from ctrlplan.studies.running import Builder
from ctrlplan.studies.sections import PlanCurves, Plane, Responses, SweepCurves
from ctrlplan.studies.study import Study
from ctrlplan.studies.sweep import Sweep, settling_jumps, sweep
from ctrlplan.studies.units import scientific
from ctrlplan.systems import create_feedforward_iosystem, create_source_iosystem
from ctrlplan.systems.plants import integrator_lag_loop
from ctrlplan.trajectories import PolySpline, Step, Trajectory, TrigSpline, Waypoint

Array = NDArray[np.float64]

WAYPOINTS = (Waypoint(0.0, 0.0, 0.0, 0.0), Waypoint(1.0, 1.0, 0.0, 0.0))
GAIN = 5.0
GAINS = (0.25, 1000.0)
TIMEPTS = np.linspace(0.0, 20.0, 8001)
NUMBERED = {
    "step": {1.0: (-26, -4), 5.0: (-34, 12), 20.0: (-34, 0), 100.0: (-34, 0), 1000.0: (-36, 2)},
    "trigonometric": {1.0: (26, 4), 5.0: (30, 0), 20.0: (44, 22), 100.0: (-14, 12), 1000.0: (34, 20)},
}
"""Gains marked in figure 1, with the offsets of their labels [pt]; of two plans only, so that labels do not overlap."""
DENSE = 30.0
"""Gain above which those around the jumps are dense enough for curves."""
BAND = 0.02
"""Half width of the settling band, relative to the move."""
SWEPT = ("settling_time", "overshoot_error", "control_peak", "control_effort")
FED = "trigonometric, feedforward"
STEP_LIMIT = (-np.log(BAND) / 0.5, 100.0)
"""Limit of settling time [s] and overshoot [%] of the step response for infinite gain."""


def linear_plans() -> dict[str, Trajectory]:
    """Step, quintic, and the trigonometric spline of the paper's figures (alpha = 1)."""
    return {
        "step": Step(1.0),
        "polynomial": PolySpline(WAYPOINTS),
        "trigonometric": TrigSpline(WAYPOINTS, alpha=1.0),
    }


def linear_study(progress: bool = True, count: int = 121, finest: float = 1e-3) -> Study:
    """Figure 1 and the figures of section 2.

    Parameters
    ----------
    progress : bool, optional
        Show a bar on stderr.
    count : int, optional
        Gains from whose loops jumps of settling times are predicted: as many evenly
        spaced in their square root, the frequency of the loop, and half as many in
        their logarithm. Of the latter, those below 30 are swept, with gains around the
        jumps.
    finest : float, optional
        Relative spacing of gains to which jumps of a settling time are located.

    Returns
    -------
    Study
        Named "linear": a comparison at gain 5, and a sweep from 0.25 to 1000.
    """
    plans = linear_plans()
    fed: Mapping[str, Builder] = {FED: _fed_loop}
    comparison = compare(
        lambda name, plan: fed.get(name, _plain_loop)(name, plan),
        plans | {FED: plans["trigonometric"]},
        TIMEPTS,
        waypoints=WAYPOINTS,
        title="Linear loop k/(s² + s), k = 5",
        parameters={
            "plant": "k/(s² + s), unity feedback",
            "gain k": f"{GAIN:g}; sweep {GAINS[0]:g} to {GAINS[1]:g}",
            "move": "0 to 1 in 1 s, zero velocity and acceleration at both ends",
            "trigonometric": "alpha = 1 rad, m = 3, gamma = mean",
            "polynomial": "degree 5",
            "simulated time": f"{TIMEPTS[-1]:g} s",
        },
    )
    comparison = comparison.with_benefit(benefit(comparison, _loop(GAIN)))
    swept = _refined_sweep(count, finest, progress)
    return Study(
        "linear",
        "Linear loop (section 2, figure 1)",
        comparison,
        summary=(
            "Unity feedback with a proportional controller around 1/(s² + s), open loop k/(s² + s). The reference "
            "moves from 0 to 1: as a step, and as plans with a duration of 1 s. Only the reference differs between "
            "the runs. Overshoot is measured on the tracking error, as in the paper. The settling time is the time "
            "of the last entry into the band of ±2 % of the move."
        ),
        notes=tuple(_notes(comparison, swept)),
        sections=(
            Plane(
                swept,
                NUMBERED,
                STEP_LIMIT,
                "step, k → ∞",
                {"trigonometric, k → ∞": (_enters_band(TrigSpline(WAYPOINTS, alpha=1.0)), 0.0)},
                caption=f"Settling time versus overshoot on the tracking error for gains from {GAINS[0]:g} to "
                f"{GAINS[1]:g} (figure 1 of the paper). Curves are interrupted where the settling time is "
                "discontinuous.",
            ),
            SweepCurves(
                swept,
                ("settling_time", "overshoot_error", "control_peak", "control_effort"),
                in_results=(),  # as part of the plane
                caption="The same metrics versus the gain, with peak control and control effort ∫u² dt.",
            ),
            PlanCurves(),
            Responses(),
        ),
    )


def _plain_loop(name: str, plan: Trajectory) -> ct.StateSpace:
    """Loop at the study's gain."""
    return _loop(GAIN)


def _fed_loop(name: str, plan: Trajectory) -> ct.InterconnectedSystem:
    """Loop at the study's gain, the plan's derivatives fed forward."""
    loop = _loop(GAIN)
    forward = create_feedforward_iosystem(integrator_lag_loop(GAIN))
    source = create_source_iosystem(plan, forward.ninputs - 1, suffix="_ref")
    return ct.interconnect([source, forward, loop], inputs=0, outputs=["y", "u"], name="fed loop")


def _loop(gain: float) -> ct.StateSpace:
    return integrator_lag_loop(gain, outputs=("y", "u"))


@lru_cache(maxsize=1)
def _matrices() -> tuple[tuple[Array, Array], ...]:
    """A, B, C and D of the loop: each for gain 0, and its derivative; they are affine functions of the gain."""
    zero, one = ([np.asarray(getattr(_loop(gain), name)) for name in "ABCD"] for gain in (0.0, 1.0))
    return tuple((m, n - m) for m, n in zip(zero, one, strict=True))


def _swept_loop(gain: float) -> ct.StateSpace:
    """The same loop in one block, which is built faster than three."""
    a, b, c, d = (zero + gain * slope for zero, slope in _matrices())
    return ct.StateSpace(a, b, c, d, inputs="r", outputs=["y", "u"], name="loop")


def _refined_sweep(count: int, finest: float, progress: bool) -> Sweep:
    """Sweep over the gain, refined between gains where a settling time jumps, or changes steeply.

    Nearly all jumps are known before the sweep; it finds the others.
    """
    even = np.linspace(GAINS[0] ** 0.5, GAINS[1] ** 0.5, count)[1:-1] ** 2
    base = np.union1d(np.geomspace(*GAINS, count // 2), list(NUMBERED["step"]))
    own = np.union1d(base[base < DENSE], [*NUMBERED["step"], GAINS[1]])
    gains = np.union1d(own, _around_jumps(np.union1d(even, base), finest))
    plans = linear_plans()
    found = _swept(gains, plans, SWEPT, progress)
    while True:
        settling = [rows["settling_time"] for rows in found.metrics.values()]
        jump, steep = (np.any([settling_jumps(found.values, r, s) for r in settling], axis=0) for s in (3.0, 1.5))
        widest = np.select([jump, steep], [finest, max(finest, 0.02)], np.inf)
        parts = np.minimum(_parts(found.values, widest), 16)
        if parts.max() == 1:
            return found
        gains = np.setdiff1d(_divided(found.values, parts), found.values)
        found = found.merged(_swept(gains, plans, SWEPT, progress))


def _swept(gains: Array, plans: dict[str, Trajectory], measures: tuple[str, ...], progress: bool) -> Sweep:
    """Metrics at gains."""
    found = sweep(_swept_loop, gains, plans, TIMEPTS, progress=progress, parameter="gain", measures=measures)
    if found.interrupted:  # an incomplete sweep is not a result
        raise KeyboardInterrupt
    return found


def _parts(gains: Array, widest: ArrayLike) -> NDArray[np.intp]:
    """Numbers of parts, powers of two, of intervals of gains so that none is wider, relative to the gain."""
    return 2 ** np.ceil(np.log2(np.maximum(np.log(gains[1:] / gains[:-1]) / np.log1p(widest), 1.0))).astype(np.intp)


def _divided(gains: Array, parts: NDArray[np.intp]) -> Array:
    """Gains with the intervals between them divided into parts, evenly in the logarithm."""
    left = np.repeat(np.arange(parts.size), parts)
    part = (np.arange(left.size) - (np.cumsum(parts) - parts)[left]) / parts[left]
    return np.append(gains[left] * (gains[left + 1] / gains[left]) ** part, gains[-1])


def _around_jumps(gains: Array, finest: float) -> Array:
    """Gains on both sides of the jumps of settling times, on a subdivision of gains.

    The jumps are predicted from the loops of these gains, and enclosed to `finest`. One
    more gain is up to 24 times as far on the side where the extremum is outside of the
    band: there the curve begins like a square root.
    """
    parts = _parts(gains, finest)
    fine, ends = _divided(gains, parts), np.cumsum(parts)
    around = []
    for plan in linear_plans().values():
        change = _changes(gains, fine, parts, plan)
        jump = np.flatnonzero(change)
        where = np.searchsorted(ends, jump, side="right")
        far = np.clip(np.where(change[jump] > 0.0, jump + 24, jump - 23), ends[where] - parts[where], ends[where])
        around += [fine[jump], fine[jump + 1], fine[far]]
    return np.concatenate(around)


def _changes(gains: Array, fine: Array, parts: NDArray[np.intp], plan: Trajectory) -> Array:
    """Changes of the last extremum outside of the settling band between neighbours of `fine`; 0 where it is the same.

    By interpolation from the loops of `gains`, whose intervals are divided into `parts`.
    """
    errors, free = _errors(gains, plan)
    frequency = np.sqrt(gains), np.sqrt(fine)  # errors are analytic functions of it
    extremum, ended = _last_extremum_outside(*CubicSpline(frequency[0], free)(frequency[1]).T)
    after = np.nan_to_num(np.diff(np.floor(extremum)))
    # During the move: by the last sample outside, between gains where it changes by more than it does with an extremum.
    changed = np.repeat(settling_jumps(gains, _last_outside(errors), 1.5), parts)
    some = np.flatnonzero(ended & (np.append(changed, False) | np.append(False, changed)))
    last = np.full(fine.size, np.nan)
    last[some] = _last_outside(CubicSpline(frequency[0], errors)(frequency[1][some]))
    during = np.diff(last)
    return np.where(ended[1:] & ended[:-1], np.where(np.abs(during) > 1.0, during, 0.0), after)


def _errors(gains: Array, plan: Trajectory) -> tuple[Array, Array]:
    """Difference from the final value during the move, and the free motion after it.

    Returns
    -------
    ndarray, shape (ngains, 257)
        Difference of the output from its final value at even times of the move.
    ndarray, shape (ngains, 4)
        This at the end of the move, and its derivative; sum and product of the poles.
    """
    a, b, c, _ = (zero + gains[:, None, None] * slope for zero, slope in _matrices())
    read = np.concatenate([c[:, :1], c[:, :1] @ a], axis=1)
    times = np.linspace(WAYPOINTS[0].time, WAYPOINTS[-1].time, 257)
    rest = np.asarray(np.linalg.solve(a, -b), dtype=float)
    states = exact_states(a, b, plan.segment_jet_at, list(plan.breakpoints), times, 0.0 * rest[..., 0], read)
    errors = states - read @ rest
    return errors[:, 0], np.column_stack([errors[..., -1], np.trace(a, axis1=1, axis2=2), np.linalg.det(a)])


def _last_outside(errors: Array) -> Array:
    """Number of samples up to the last one outside of the settling band, for each row."""
    return errors.shape[1] - np.argmax(np.abs(errors[:, ::-1]) > BAND, axis=1).astype(float)


def _last_extremum_outside(error: Array, slope: Array, total: Array, product: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Number of the last extremum outside of the settling band after the move, for increasing gains.

    Continued to real numbers: the settling time jumps where it passes an integer.
    nan if all extrema are inside. Second, whether there is no extremum outside after
    the end of the move. Arguments as by `_errors`.
    """
    # The error is Re(size exp(pole t)), with extrema where Re(pole size exp(pole t)) = 0.
    pole = 0.5 * total + 1j * np.sqrt(np.maximum(product - 0.25 * total**2, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):  # at the double pole
        size = error - 1j * (slope - pole.real * error) / pole.imag
        time = np.log(BAND * np.abs(pole) / (np.abs(size) * pole.imag)) / pole.real
        angle = np.unwrap(np.nan_to_num(np.angle(pole * size)))
        number = np.where(time > 0.0, (angle + pole.imag * time) / np.pi - 0.5, np.nan)
        return number, ~((np.floor(number) + 0.5) * np.pi >= angle)


def _notes(comparison: Comparison, swept: Sweep) -> list[str]:
    """Findings of the study, and the differences from section 2 of the paper."""
    step, plan = comparison.metrics["step"], comparison.metrics["trigonometric"]
    gains, trig, poly = swept.values, swept.metrics["trigonometric"], swept.metrics["polynomial"]
    peak_gain, peak = overshoot_peak(gains, trig["overshoot_error"])
    later = trig["settling_time"] > swept.metrics["step"]["settling_time"]
    last = {name: rows["overshoot_error"][-1] for name, rows in swept.metrics.items()}
    band = TrigSpline(WAYPOINTS, alpha=1.0)
    enters = _enters_band(band)
    return [
        f"At k = 5 the step has an overshoot of {step['overshoot_error']:.4g} % and a settling time of "
        f"{step['settling_time']:.4g} s, the trigonometric plan {plan['overshoot_error']:.4g} % and "
        f"{plan['settling_time']:.4g} s. The paper prints 48 %, 7.6 s, 44 % and 8 s: the same values, with the "
        "overshoots truncated. At this gain the plan settles later than the step. At small gains planning has no "
        "benefit, as the paper says.",
        "Equation (1) as printed omits the factor k, and the minus sign in ξ = −cos φ, where φ is the argument of the "
        "complex pole with negative imaginary part. With both corrections it is the step response of this loop, "
        "y = 1 − (ω_n/ω_p) exp(−ξ ω_n t) sin(ω_p t + arccos ξ) with ω_n = √k and ξ = 1/(2 √k).",
        "The paper says that the response to the trigonometric spline has no closed form. It has one: the spline is "
        "the output of an autonomous linear system, so that the response of loop and plan is a matrix exponential. "
        "All curves of this study are computed in this way, without numerical integration.",
        f"For large gains the paper states a limit of 1 s for the settling time of the plan, the end of the plan. The "
        f"limit is {enters:.4g} s: at this time the reference enters the ±2 % band, and for large gains the output "
        f"follows the reference. At k = 1000 the settling time is {trig['settling_time'][-1]:.4g} s.",
        f"The paper says that the overshoot of the plan rises to about 50 % and then falls to 0 as the gain increases. "
        f"Its maximum is {peak:.5g} % at k = {peak_gain:.2f}; at k = 1000 it is {last['trigonometric']:.3g} %.",
        f"For k → ∞ the step tends to the point ({STEP_LIMIT[0]:.4g} s, 100 %) of figure 1, as in the "
        f"paper; at k = 1000 the overshoot is {last['step']:.4g} %. The settling time is a discontinuous function of "
        "the gain: it jumps where an extremum of the oscillation crosses the edge of the band. The grid of gains is "
        "refined at these jumps.",
        f"The step settles earlier than the trigonometric plan {_shares(gains, later)}, and at no gain above "
        f"k = {gains[later].max():.3g}; the paper states k = 10."
        if later.any()
        else "The trigonometric plan settles earlier than the step at every gain.",
        "With feedforward of the derivatives of the plan (input r + (r'' + r')/k in place of r), the tracking error "
        f"of the same loop at k = 5 is {_digits(comparison.metrics[FED])}. This is flatness-based control of a linear "
        "plant.",
        "The quintic polynomial and the trigonometric spline have similar results, as the paper predicts. The "
        f"polynomial settles earlier {_shares(gains, poly['settling_time'] < trig['settling_time'])}. The benefit "
        "comes from planning, not from the type of spline.",
    ]


def overshoot_peak(gains: Array, overshoot: Array) -> tuple[float, float]:
    """Gain at which the overshoot of the trigonometric plan peaks, and the peak [%], between the gains swept."""
    plan = linear_plans()["trigonometric"]

    def overshoot_at(frequency: Array) -> Array:
        found = _swept(frequency**2, {"it": plan}, ("overshoot_error",), progress=False)
        return found.metrics["it"]["overshoot_error"]

    frequency, values = np.sqrt(gains), overshoot
    while True:
        top = int(np.argmax(values))
        low, high = frequency[[max(top - 1, 0), min(top + 1, frequency.size - 1)]].tolist()
        if high - low < 0.25:  # a smooth function there
            break
        frequency = np.linspace(low, high, 9)
        values = overshoot_at(frequency)
    curve = Chebyshev.interpolate(overshoot_at, 8, domain=[low, high])
    level = curve.deriv().roots()
    found = [low, high, *level.real[(level.imag == 0.0) & (level.real > low) & (level.real < high)].tolist()]
    best = max(found, key=curve)
    return float(best**2), float(curve(best))


def _shares(gains: Array, where: NDArray[np.bool_]) -> str:
    """Share of the range of gains, by length of the range, since gains are not evenly spaced."""
    shares = []
    for scale in (np.log(gains), gains):
        edges = np.concatenate([scale[:1], 0.5 * (scale[1:] + scale[:-1]), scale[-1:]])
        shares.append(100.0 * float(np.diff(edges)[where].sum() / (edges[-1] - edges[0])))
    return f"on {shares[0]:.0f} % of the range of gains on a logarithmic scale ({shares[1]:.0f} % on a linear one)"


def _digits(found: dict[str, float]) -> str:
    """Peak error of a plan from 0 to 1, in words."""
    worst = max(found["overshoot_error"], found["lag_error"]) / 100.0
    return "at rounding level" if worst < 1e-12 else f"at most {scientific(worst, 1)}"


def _enters_band(plan: Trajectory) -> float:
    """Time at which a plan from 0 to 1 enters the 2 % band, by bisection."""
    low, high = plan.start, plan.end
    while high - low > 1e-13:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float(plan(middle)) < 0.98 else (low, middle)
    return high
