"""Plans that are made again, in two other ways: equation (2) in fifty digits, and polynomials of scipy."""

import itertools
import math

import control as ct
import mpmath as mp
import numpy as np
from scipy.interpolate import BPoly

import ctrlplan as cp
from ctrlplan import Waypoint

METHODS = ("compiled", "python")
TIGHT = {"rtol": 1e-11, "atol": 1e-13}
REST = [Waypoint(0, 0, 0, 0), Waypoint(10, 1, 0, 0)]
PLAN = cp.PolySpline(REST, labels=["x"])
NAN_INPUT, UNREACHABLE = cp.traits_of(cp.create_replanner_iosystem(PLAN, 0.5).syslist[1]).watched
"""What the block calls its events: a value was not finite; the goal is out of reach."""


# Independent ways to the same: equation (2) in many digits, and a replanner of scipy's polynomials.


def between(first, last, horizon, alpha, s, highest):
    """Jets (highest + 1, ntime) of the spline (2) from one jet to another, by a direct solution in fifty digits."""
    with mp.workdps(50):
        m, rate = len(first), mp.mpf(alpha or 1) / mp.mpf(horizon)
        middle = mp.mpf(alpha) / 2

        def functions(t, nu):
            tau = rate * t
            if not alpha:
                return [mp.ff(j, nu) * tau ** (j - nu) * rate**nu if j >= nu else mp.mpf(0) for j in range(2 * m)]
            found = [mp.mpf(nu == 0)]
            for k in range(1, m):
                turned = k * tau + nu * mp.pi / 2
                found += [(k * rate) ** nu * mp.cos(turned), (k * rate) ** nu * mp.sin(turned)]
            return [*found, (m * rate) ** nu * mp.sin(m * (tau - middle) + nu * mp.pi / 2)]

        ends = [functions(mp.mpf(t), nu) for t in (0.0, horizon) for nu in range(m)]
        data = mp.matrix([mp.mpf(float(v)) for v in [*first, *last]])
        solved = list(mp.lu_solve(mp.matrix(ends), data))
        times = [mp.mpf(float(t)) for t in np.atleast_1d(s)]
        return np.array([[float(mp.fdot(solved, functions(t, nu))) for t in times] for nu in range(highest + 1)])


class Peer:
    """A replanner of polynomials: the plan and BPoly.from_derivatives on top, limits looked at on a fine grid."""

    def __init__(self, plan, goal, dt, order=2, horizon=None, minimum=None, limits=None, begin=0.0):
        self.plan, self.goal, self.order, self.limits = plan, goal, order, limits or {}
        self.pieces = []
        self.fits, self.unreachable, known = 0, [], None
        minimum = max(dt, min(5 * dt, 0.5 * plan.duration)) if minimum is None else minimum
        for k in itertools.count():
            t = begin + k * dt
            if t > plan.end + 5.0:
                break
            found = goal(t)
            new = known is None or not np.allclose(found, self.ahead(*known, t)[:, :, 0], rtol=1e-10, atol=1e-10)
            late = horizon is None and plan.end - t < minimum - 1e-9
            unreachable = new and late
            if not late and t >= plan.start and (horizon is not None or new):
                end = plan.end if horizon is None else t + horizon
                piece = self.fitted(t, end, found)
                unreachable = not self.within_limits(t, end, piece)
                if not unreachable:
                    self.pieces.append((t, piece))
                    self.fits, known = self.fits + 1, (found, t)
            self.unreachable.append((t, unreachable))

    @staticmethod
    def ahead(goal, then, t):
        """Jet of the goal's Taylor polynomial at later times, (order + 1, naxes, ntime)."""
        s = np.atleast_1d(t) - then
        return np.array(
            [
                sum(goal[k + j][:, None] * s**j / math.factorial(j) for j in range(len(goal) - k))
                for k in range(len(goal))
            ]
        )

    def fitted(self, t, end, goal):
        first, last = self.correction(np.array([t]))[:, :, 0], np.zeros((self.order + 1, self.plan.naxes))
        last[: len(goal)] = self.ahead(goal, t, end)[:, :, 0]
        last[0] -= self.plan.final
        poly = BPoly.from_derivatives([t, end], [first, last])
        rows = [poly.derivative(k) if k else poly for k in range(self.order + 1)]

        def piece(times):
            after = np.zeros((self.order + 1, self.plan.naxes, times.size))
            after[: len(goal)] = self.ahead(goal, t, times)
            after[0] -= self.plan.final[:, None]
            return np.where(times <= end, np.array([row(np.minimum(times, end)).T for row in rows]), after)

        return piece

    def within_limits(self, t, end, piece):
        grid = np.linspace(t, max(end, self.plan.end), 4001)
        whole = np.abs(self.plan.jet(grid, self.order) + piece(grid)).max(axis=(1, 2))
        shares = [whole[nu] / limit for nu, limit in self.limits.items()]
        assert not any(0.9999 < share < 1.0001 for share in shares), "too near a limit to tell on a grid"
        return max(shares, default=0.0) < 1.0

    def correction(self, times):
        found = np.zeros((self.order + 1, self.plan.naxes, times.size))
        for since, piece in self.pieces:
            later = times >= since - 1e-12
            found[:, :, later] = piece(times[later])
        return found

    def __call__(self, times):
        found = self.plan.jet(times, self.order) + self.correction(times)
        return found.transpose(1, 0, 2).reshape(-1, times.size)


# Small helpers


def chain(order, signal, label="x", name="plant"):
    """Integrators from the order-th + 1 derivative to the position, all of them measured."""
    n = order + 1
    outputs = [label, *(f"{label}_d{k}" for k in range(1, n))]
    return ct.ss(np.diag(np.ones(order), 1), np.eye(n)[:, -1:], np.eye(n), 0, inputs=signal, outputs=outputs, name=name)


def ideal(plan, dt, order=2, method="auto", times=None, disturbance=None, **options):
    """Run of a chain of integrators that follows, all of its state measured."""
    replanner = cp.create_replanner_iosystem(
        plan, dt, order=order, measured=order, derivatives=order + 1, suffix="_r", **options
    )
    accelerations = [f"{label}_r_d{order + 1}" for label in plan.labels]
    plants = [
        chain(order, signal, label, f"plant_{label}") for signal, label in zip(accelerations, plan.labels, strict=True)
    ]
    outputs = [*replanner.output_labels, *(label for p in plants for label in p.output_labels)]
    goals = [label for label in replanner.input_labels if "_goal" in label]
    loop = ct.interconnect([replanner, *plants], inputs=goals or 0, outputs=outputs, name="loop")
    state = np.zeros(loop.nstates)
    first = plan.jet(times[0], order).T.ravel()
    state[-first.size :] = first if disturbance is None else first + disturbance
    inputs = {f"{label}_goal": float(v) for label, v in zip(plan.labels, plan.final, strict=True)} if goals else None
    return cp.simulate(loop, times, inputs, state, method=method, **TIGHT)


def state_of(found, label, scope="replanner"):
    rows = [k for k, name in enumerate(found.state_labels) if name.endswith(f"{scope}_correction_{label}")]
    assert len(rows) == 1
    return found.states[rows[0]]


def happened(found, name):
    return [(round(event.time, 9), event.kind) for event in found.events if event.name == name]


def steps(*moves, initial=1.0):
    """Goal that moves at some times: (time, to) each."""
    goal, before = cp.Step(0.0, 0.0, 0.0) + cp.Step(initial, initial, 0.0), initial
    for time, value in moves:
        goal, before = goal + cp.Step(value - before, 0.0, time), value
    return goal


# Plans of every kind, and what the block inside gets and puts on its outputs

INNER = [Waypoint(0, 0, 0, 0), Waypoint(4, 2, 0.3), Waypoint(7, -1), Waypoint(10, 1, 0, 0)]
FREE = [Waypoint(0, 0, 0, 0), Waypoint(6, 0.4, None, 0.1), Waypoint(10, 1, 0.2)]
TWO = [Waypoint(0, [0, 3], 0, 0), Waypoint(3, [1, 2]), Waypoint(10, [1, -1], 0, 0)]
PLANS = {
    "polynomial": PLAN,
    "polynomial, inner waypoints": cp.PolySpline(INNER),
    "polynomial, two axes": cp.PolySpline(TWO),
    "trigonometric, alpha 1": cp.TrigSpline(REST, alpha=1.0),
    "trigonometric, alpha 5": cp.TrigSpline(REST, alpha=5.0, warn=False),
    "trigonometric, inner waypoints, alpha 4": cp.TrigSpline(INNER, alpha=4.0),
    "trigonometric, entries free, in motion at the end": cp.TrigSpline(FREE, alpha=2.0),
    "trigonometric, gamma given": cp.TrigSpline(REST, alpha=3.0, gamma=1.2),
    "piecewise": cp.PiecewiseSpline(INNER),
    "piecewise, trigonometric": cp.PiecewiseSpline(TWO, alpha=1.5),
    "joined": cp.TrigSpline([*REST[:1], Waypoint(6, 2, 0, 0)], alpha=5.0, warn=False).then(
        cp.PolySpline([Waypoint(6, 2, 0, 0), Waypoint(10, 1, 0, 0)])
    ),
    "sum": 2.0 * cp.TrigSpline(REST, alpha=2.0) + cp.PolySpline(INNER),
    "cyclic": cp.TrigSpline.cyclic([Waypoint(0, 0), Waypoint(3, 1, 0), Waypoint(6, 0.5)], 10.0),
}


def signals(plan, replanner, t, goal=None, off=0.0):
    """Inputs of the inner block at a time, the plant where the plan is but for a deviation."""
    core = replanner.syslist[1]
    jet = plan.jet(t, 8)
    values = {}
    for a, label in enumerate(plan.labels):
        for k in range(9):
            tail = f"_d{k}" if k else ""
            values[f"{label}_planned{tail}"] = jet[k, a]
            values[f"{label}{tail}"] = jet[k, a] + (np.broadcast_to(off, (9, plan.naxes))[k, a])
        aim = np.atleast_2d(plan.final if goal is None else goal)
        for k, row in enumerate([*aim, *np.zeros((8, plan.naxes))]):
            values[f"{label}_goal" + (f"_d{k}" if k else "")] = row[a]
    return np.array([values[label] for label in core.input_labels])


def block_outputs(plan, replanner, t, x, **options):
    core = replanner.syslist[1]
    return np.asarray(core.outfcn(t, x, signals(plan, replanner, t, **options), {}), dtype=float)


def conveyor(position, speed, at=0.0):
    """Goal at a position at some time, moving on for ever, and its name for a run."""
    line = cp.PolySpline(
        [Waypoint(-50.0, position - speed * (50.0 + at), speed), Waypoint(50.0, position + speed * (50.0 - at), speed)]
    )
    return {"x_goal": line, "x_goal_d1": speed}
