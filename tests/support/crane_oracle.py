"""The crane and its loops written by hand: what the package's crane is compared with, without a line of it.

z points down, the rope leaves the drum (radius b) at the angle theta from the
vertical, R is its length from there to the load, D the trolley's position,
T the rope's tension, F the trolley's force, C the drum's torque::

    (x, z) = (R sin th + D + b cos th, R cos th - b sin th)

    sin th D'' + R'' - b th'' + T/m = g cos th + R th'^2
    cos th D'' + R th''             = -g sin th - 2 R' th' + b th'^2
    M_c D'' - T sin th              = F - f1 D'
    J R''/b - b T                   = C - f2 R'/b

The last line is the paper's (14b). With the rope's winding on the drum, R =
b phi + b th + const, it is J (R''/b - th'') - b T = C - f2 (R'/b - th'), which
conserves energy where nothing damps and nothing drives.

Two PIDs, Kp + Ki/s + Kd s/(Tf s + 1) with a triple pole at -w_c on 1/(s (M s
+ f)): Kp = 3 M w_c^2, Ki = M w_c^3, Kd = 3 M w_c - f, w_c = 5 rad/s and Tf =
0.02 s; M = M_c, f = f1 for the trolley, M = J/b + m b, f = f2/b for the hoist,
whose torque has -b m g added. Of the laws here, "setpoint" gives them the
plan's position, "generator" (15a,b) of its jets, "load_feedback" (15a,b) with
v_x = x_d'' - 2 (x' - x_d') - (x - x_d) in place of x_d'' and the measured x in
that of x_d; "dynamic" is (9)-(11) with the controller states (T - m g, T').
"""

import math
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

M, MC, J, B, F1, F2, G = 500.0, 5000.0, 50.0, 0.25, 20.0, 20.0, 9.81
POLES = (-1.0, -1.2, -1.4, -1.6)


def acceleration(wrap, q, force, torque):
    """D'', R'', theta'', T from the equations of motion, as one linear system."""
    _, r, th, d1, r1, th1 = q
    s, c = math.sin(th), math.cos(th)
    matrix = [[s, 1, -B, 1 / M], [c, 0, r, 0], [MC, 0, 0, -s], [0, J / B, -J if wrap else 0, -B]]
    drum = r1 / B - (th1 if wrap else 0.0)
    right = [G * c + r * th1**2, -G * s - 2 * r1 * th1 + B * th1**2, force - F1 * d1, torque - F2 * drum]
    return np.linalg.solve(matrix, right)


def load_of(q):
    d, r, th, d1, r1, th1 = q
    s, c = math.sin(th), math.cos(th)
    return (
        r * s + d + B * c,
        r * c - B * s,
        r1 * s + r * th1 * c + d1 - B * th1 * s,
        r1 * c - r * th1 * s - B * th1 * c,
    )


def actuator_references(x, x2, z, z2):
    """(15a,b)."""
    pull = math.hypot(x2, G - z2)
    return x - (B * pull - z * x2) / (G - z2), (z * pull - B * x2) / (G - z2)


def pid(mass, friction, error, state, bias, limits, w=5.0, tf=0.02):
    kp, ki, kd = 3 * mass * w**2, mass * w**3, 3 * mass * w - friction
    requested = bias + kp * error + state[0] + kd * (error - state[1]) / tf
    sent = min(max(requested, limits[0]), limits[1])
    back = math.sqrt(ki / kd) * (sent - requested)
    return sent, [ki * error + back, (error - state[1]) / tf]


FREE = (-math.inf, math.inf)


def hand_rate(jet, law, wrap, force_limits=FREE, torque_limits=FREE):
    """Right-hand side over (controller states, crane states)."""

    def with_pids(t, y):
        q, (x, _, x1, _) = y[4:], load_of(y[4:])
        p = jet(t)
        if law == "setpoint":
            d_ref, r_ref = p[0, 0] - B, p[0, 1]
        elif law == "generator":
            d_ref, r_ref = actuator_references(p[0, 0], p[2, 0], p[0, 1], p[2, 1])
        else:
            requested = p[2, 0] - 2 * (x1 - p[1, 0]) - (x - p[0, 0])
            d_ref, r_ref = actuator_references(x, requested, p[0, 1], p[2, 1])
        force, moved = pid(MC, F1, d_ref - q[0], y[:2], 0.0, force_limits)
        torque, wound = pid(J / B + M * B, F2 / B, r_ref - q[1], y[2:4], -B * M * G, torque_limits)
        return np.array([*moved, *wound, *q[3:], *acceleration(wrap, q, force, torque)[:3]])

    sigma = np.poly(POLES)[::-1]  # 1, s, s^2, s^3

    def dynamic(t, y):
        tension, rate, q = M * G + y[0], y[1], y[2:]
        _, r, th, d1, r1, th1 = q
        s, c = math.sin(th), math.cos(th)
        x, z, x1, z1 = load_of(q)
        along, across = np.array([s, c]), np.array([c, -s])
        jets = [np.array([x, z]), np.array([x1, z1])]
        jets.append(np.array([0, G]) - tension * along / M)
        jets.append(-(rate * along + tension * th1 * across) / M)
        p = jet(t)
        v = p[4] - sum(sigma[k] * (jets[k] - p[k]) for k in range(4))
        # -m y'''' = (T'' - T theta'^2) along + (T theta'' + 2 T' theta') across
        pulled = -M * v
        tension2 = along @ pulled + tension * th1**2
        th2 = (across @ pulled - 2 * rate * th1) / tension
        d2, r2 = np.linalg.solve(
            [[s, 1], [c, 0]],
            [G * c + r * th1**2 + B * th2 - tension / M, -G * s - 2 * r1 * th1 + B * th1**2 - r * th2],
        )
        drum1, drum2 = r1 / B - (th1 if wrap else 0), r2 / B - (th2 if wrap else 0)
        force, torque = MC * d2 + F1 * d1 - tension * s, J * drum2 + F2 * drum1 - B * tension
        return np.array([rate, tension2, *q[3:], *acceleration(wrap, q, force, torque)[:3]])

    return dynamic if law == "dynamic" else with_pids


def by_hand(plan, law, wrap, state, t, **limits):
    """Integrated tightly from break to break, the plan held after its end."""
    breaks = [t[0], *[b for b in plan.breakpoints if t[0] < b < t[-1]], t[-1]]
    out = np.empty((len(state), t.size))
    for left, right in pairwise(breaks):
        # Before a break the plan's own derivatives there, after it what follows.
        def jet(moment, right=right, last=left >= plan.end):
            p = plan.jet(min(moment, right), 4, left=moment >= right)
            if last:
                p = np.zeros_like(p)
                p[0] = plan.final
            return p

        inside = (t >= left) & (t <= right)
        requested = np.union1d(t[inside], [left, right])
        found = solve_ivp(
            hand_rate(jet, law, wrap, **limits),
            (left, right),
            state,
            method="LSODA",
            t_eval=requested,
            rtol=1e-10,
            atol=1e-12,
        )
        assert found.success
        out[:, inside] = found.y[:, np.searchsorted(requested, t[inside])]
        state = found.y[:, -1]
    return out
