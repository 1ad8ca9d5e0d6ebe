"""Fastest crossing of a path by the crane as a nonlinear program of CasADi and IPOPT on a fine grid."""

import math

import numpy as np
import pytest


def optimum(plan, guess, limits, count=300):
    """Duration with b at the nodes of an even grid, by IPOPT.

    The trolley is at x_load + l sin(sway), and its force that of its acceleration, of friction and of the load; time
    derivatives are differences along the path. Near the ends b is linear: otherwise the program begins with a jump.
    """
    casadi = pytest.importorskip("casadi")
    s = np.linspace(plan.start, plan.end, count + 1)
    h, p = s[1] - s[0], plan.jet(s[1:-1], 2)
    b = casadi.MX.sym("b", count + 1)
    slope = (b[2:] - b[:-2]) / (2 * h)
    x2, z2 = (p[2, axis] * b[1:-1] + 0.5 * p[1, axis] * slope for axis in (0, 1))
    rate = casadi.sqrt(b[1:-1])
    between = 0.5 * (rate[1:] + rate[:-1])
    rows = []
    if "F" in limits:
        trolley = p[0, 0] - (0.25 * casadi.sqrt(x2**2 + (9.81 - z2) ** 2) - p[0, 1] * x2) / (9.81 - z2)
        velocity = between * (trolley[1:] - trolley[:-1]) / h
        acceleration = rate[1:-1] * (velocity[1:] - velocity[:-1]) / h
        force = 5000.0 * acceleration + 10.0 * (velocity[1:] + velocity[:-1]) + 500.0 * x2[1:-1]
        rows.append(force / limits["F"])
    if "theta" in limits:
        rows.append(x2 / (math.tan(limits["theta"]) * (9.81 - z2)))
    if "velocity" in limits:
        rows += [p[1, axis] * rate / limits["velocity"] for axis in (0, 1)]
    size = sum(row.shape[0] for row in rows)
    rows += [b[k - 1] - 2 * b[k] + b[k + 1] for k in (1, 2, 3, count - 3, count - 2, count - 1)]
    high = np.append(np.ones(size), np.zeros(6))
    time = 2 * h * casadi.sum1(1 / (casadi.sqrt(b[1:]) + casadi.sqrt(b[:-1])))
    problem = {"x": b, "f": time, "g": casadi.vertcat(*rows)}
    solver = casadi.nlpsol("solver", "ipopt", problem, {"ipopt.print_level": 0, "print_time": False})
    solved = solver(x0=0.9 * (plan.duration / guess) ** 2, lbx=1e-4, lbg=-high, ubg=high)
    assert solver.stats()["success"]
    return float(solved["f"])
