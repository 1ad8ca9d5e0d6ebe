"""Figures of the paper's crane, and the integration by hand that they come from.

``python3 tests/support/crane_table.py`` prints them. Plans are plain linear
algebra (`trajectory_oracle.Direct`), the loop is `crane_oracle.hand_rate`,
integrated by LSODA with a relative tolerance of 1e-10: no line of the package
is in it. The crane starts at rest at the first waypoint, D = x - b, R = z.
"""

import cmath
import math

import numpy as np
from crane_oracle import (
    F1,
    F2,
    FREE,
    MC,
    B,
    G,
    J,
    M,
    acceleration,
    actuator_references,
    by_hand,
    hand_rate,
    load_of,
    pid,
)
from scipy.integrate import solve_ivp
from trajectory_oracle import Direct

REST = [0.0, 0.0]
NOMINAL = [0.0, 15.0], {"x": [[0.0, *REST], [20.0, *REST]], "z": [[10.0, *REST], [11.0, *REST]]}
FIRST_ORDER = [0.0, 30.0], {"x": [[0.0], [20.0]], "z": [[10.0], [11.0]]}
OBSTACLE = (
    [0.0, 6.0, 11.0, 16.0],
    {
        "x": [[0.0, *REST], [5.0, 1.0, 0.1], [15.0, 2.0, 0.1], [20.0, *REST]],
        "z": [[10.0, *REST], [5.0, -1.0, -0.15], [5.0, 1.0, 1.0], [11.0, *REST]],
    },
)
"""Times of waypoints, and by axis what is prescribed at each: position, velocity, acceleration."""

PLANS = {
    "nominal polynomial": (NOMINAL, 0.0, None),
    "nominal trigonometric": (NOMINAL, 1.0, None),
    "first-order polynomial": (FIRST_ORDER, 0.0, None),
    "first-order trigonometric": (FIRST_ORDER, math.pi / 3, math.pi / 2),
    "first-order trigonometric, alpha pi": (FIRST_ORDER, math.pi, None),
    "obstacle polynomial": (OBSTACLE, 0.0, None),
    "obstacle trigonometric": (OBSTACLE, 4.0, None),
}
"""Waypoints, alpha and gamma (None: the mean of the constraints' abscissae)."""

TABLE = {
    "nominal polynomial": (0.00245, 0.00254, 0.00191),
    "nominal trigonometric": (0.00232, 0.00238, 0.00173),
    "first-order polynomial": (0.6955, 1.3266, 0.1206),
    "first-order trigonometric": (0.000518, 1.2981, 0.1180),
    "first-order trigonometric, alpha pi": (0.00116, 0.00110, 0.0112),
    "obstacle polynomial": (0.0847, 0.0718, 0.0312),
    "obstacle trigonometric": (0.0108, 0.00536, 0.00332),
}
"""Largest error of the load during the move and after it [m], and largest sway after it [rad].

The load is compared with its plan, which is held after its end, until twice
the end of the move; until 30 s over the obstacle.
"""

SMOOTH = {"septic": (2.293e-4, 2949), "nonic": (2.009e-4, 3401), "alpha = 3": (2.392e-4, 4261)}
"""Of the nominal move: largest sway after it [rad], and largest force of the trolley [N], through the generator."""

SLACK = 5.8655
"""Time at which a step of the nominal move, its drives limited, leaves the rope slack [s]."""
FORCE_LIMITS, TORQUE_LIMITS = (-30e3, 30e3), (-3e3, 1e3)


class Curve:
    """A plan of x and z as `by_hand` takes it: derivatives up to the second, held after the end."""

    def __init__(self, end, functions):
        self.breakpoints, self.end, self.functions = np.array([0.0, end]), end, functions
        self.final = self.jet(end)[0]

    def jet(self, t, order=4, left=False):
        values = np.zeros((order + 1, 2))
        values[:3] = [[function(min(t, self.end), nu) for function in self.functions] for nu in range(3)]
        return values


def spline(waypoints, alpha, gamma):
    """Function of (t, nu) for x and for z."""
    times, axes = waypoints
    return Curve(times[-1], [_one_axis(Direct(times, jets, alpha, gamma)) for jets in axes.values()])


def _one_axis(exact):
    c = [float(value) for value in exact.coefficients]
    rate = float(exact.rate)
    if not exact.alpha:
        # About the middle of the move, where its powers are small: an integrator follows errors of rounding too.
        middle = [
            sum(v * math.comb(k, j) / 2 ** (k - j) for k, v in enumerate(exact.coefficients) if k >= j)
            for j in range(len(c))
        ]
        shape = np.polynomial.Polynomial([float(value) for value in middle])
        powers = [(rate**nu * shape.deriv(nu).coef[::-1]).tolist() for nu in range(3)]
        return lambda t, nu: _horner(powers[nu], rate * t - 0.5)
    pairs = len(c) // 2 if len(c) % 2 else exact.m - 1
    waves = [(k, c[2 * k - 1] - 1j * c[2 * k]) for k in range(1, pairs + 1)]
    if len(c) % 2 == 0:
        waves.append((exact.m, -1j * c[-1] * np.exp(-1j * exact.m * float(exact.gamma))))
    turning = [[(w * (1j * k * rate) ** nu, 1j * k * rate) for k, w in waves] for nu in range(3)]
    return lambda t, nu: (
        (c[0] if nu == 0 else 0.0) + sum((weight * cmath.exp(turn * t)).real for weight, turn in turning[nu])
    )


def _horner(powers, s):
    value = 0.0
    for power in powers:
        value = value * s + power
    return value


def smooth_step(*coefficients):
    """The nominal move along a polynomial s^j (c_0 + c_1 s + ...) of s = t/15, j the number of coefficients less 1."""
    shape = np.polynomial.Polynomial([0.0] * (len(coefficients)) + list(coefficients))
    curves = [shape.deriv(nu) for nu in range(3)]

    def axis(start, change):
        return lambda t, nu: (start if nu == 0 else 0.0) + change * curves[nu](t / 15.0) / 15.0**nu

    return Curve(15.0, [axis(0.0, 20.0), axis(10.0, 1.0)])


def along(plan, end):
    """Times and states of the loop whose drives get (15a,b) of the plan as references."""
    # After a jump of the jerk the references' velocity jumps, and the force peaks within milliseconds.
    after = np.linspace(0.0, 0.2, 1001)
    t = np.unique(np.concatenate([np.linspace(0.0, end, round(200 * end) + 1), after, plan.end + after]))
    x, z = plan.jet(0.0)[0]
    return t, by_hand(plan, "generator", False, np.array([0.0, 0.0, 0.0, 0.0, x - B, z, 0.0, 0.0, 0.0, 0.0]), t)


def computed(row):
    """The row of `TABLE`."""
    plan = spline(*PLANS[row])
    t, states = along(plan, 30.0 if row.startswith("obstacle") else 2 * plan.end)
    load = np.array([load_of(q)[:2] for q in states[4:].T])
    error = np.hypot(*(load - [plan.jet(moment)[0] for moment in t]).T)
    after = t >= plan.end
    return error[t <= plan.end].max(), error[after].max(), np.abs(states[6][after]).max()


def computed_smooth(name):
    """The row of `SMOOTH`."""
    plan = {
        "septic": lambda: smooth_step(35.0, -84.0, 70.0, -20.0),
        "nonic": lambda: smooth_step(126.0, -420.0, 540.0, -315.0, 70.0),
        "alpha = 3": lambda: spline(NOMINAL, 3.0, None),
    }[name]()
    t, states = along(plan, 30.0)
    forces = []
    for moment, y in zip(t, states.T, strict=True):
        p = plan.jet(moment) if moment <= plan.end else np.vstack([plan.final, np.zeros((4, 2))])
        d_ref = actuator_references(p[0, 0], p[2, 0], p[0, 1], p[2, 1])[0]
        forces.append(pid(MC, F1, d_ref - y[4], y[:2], 0.0, FREE)[0])
    return np.abs(states[6][t >= plan.end]).max(), np.abs(forces).max()


def computed_slack():
    """`SLACK`: the first zero of the tension, as an event of the integrator."""
    limits = {"force_limits": FORCE_LIMITS, "torque_limits": TORQUE_LIMITS}
    held = np.zeros((5, 2))
    held[0] = 20.0, 11.0
    rate = hand_rate(lambda _: held, "setpoint", False, **limits)

    def tension(_, y):
        force = pid(MC, F1, held[0, 0] - B - y[4], y[:2], 0.0, FORCE_LIMITS)[0]
        torque = pid(J / B + M * B, F2 / B, held[0, 1] - y[5], y[2:4], -B * M * G, TORQUE_LIMITS)[0]
        return acceleration(False, y[4:], force, torque)[3]

    tension.terminal, tension.direction = True, -1.0
    start = [0.0, 0.0, 0.0, 0.0, -B, 10.0, 0.0, 0.0, 0.0, 0.0]
    found = solve_ivp(rate, (0.0, 20.0), start, method="LSODA", events=tension, rtol=1e-9, atol=1e-10, max_step=0.01)
    return float(found.t_events[0][0])


def main():
    for row in TABLE:
        print(f'    "{row}": ({", ".join(f"{value:.4g}" for value in computed(row))}),')
    for name in SMOOTH:
        sway, force = computed_smooth(name)
        print(f'    "{name}": ({sway:.3e}, {force:.0f}),')
    print(f"SLACK = {computed_slack():.4f}")


if __name__ == "__main__":
    main()
