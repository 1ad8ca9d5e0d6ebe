"""Plans that are made again while the loop runs, against direct solutions, scipy's polynomials and matrix powers."""

import itertools
import math
from functools import cache

import control as ct
import mpmath as mp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.polynomial import chebyshev
from scipy.interpolate import BPoly
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan import Waypoint

METHODS = ("compiled", "python")
TIGHT = {"rtol": 1e-11, "atol": 1e-13}
REST = [Waypoint(0, 0, 0, 0), Waypoint(10, 1, 0, 0)]
PLAN = cp.PolySpline(REST, labels=["x"])
LOST, MISSED = cp.traits_of(cp.create_replanner_iosystem(PLAN, 0.5).syslist[1]).watched
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


@cache
def map_from_fit_to_fit(order, horizon, alpha, period):
    """Column j: the j-th unit jet, a period later."""
    rest = [0.0] * (order + 1)
    columns = [between(unit, rest, horizon, alpha, period, order)[:, 0] for unit in np.eye(order + 1).tolist()]
    return np.array(columns).T


class Peer:
    """A replanner of polynomials: the plan and BPoly.from_derivatives on top, limits looked at on a fine grid."""

    def __init__(self, plan, goal, dt, order=2, horizon=None, least=None, limits=None, begin=0.0):
        self.plan, self.goal, self.order, self.limits = plan, goal, order, limits or {}
        self.pieces = []
        self.fits, self.missed, known = 0, [], None
        least = max(dt, min(5 * dt, 0.5 * plan.duration)) if least is None else least
        for k in itertools.count():
            t = begin + k * dt
            if t > plan.end + 5.0:
                break
            found = goal(t)
            new = known is None or not np.allclose(found, self.ahead(*known, t)[:, :, 0], rtol=1e-10, atol=1e-10)
            late = horizon is None and plan.end - t < least - 1e-9
            missed = new and late
            if not late and t >= plan.start and (horizon is not None or new):
                end = plan.end if horizon is None else t + horizon
                piece = self.fitted(t, end, found)
                missed = not self.kept(t, end, piece)
                if not missed:
                    self.pieces.append((t, piece))
                    self.fits, known = self.fits + 1, (found, t)
            self.missed.append((t, missed))

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

    def kept(self, t, end, piece):
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


def chain(order, drive, label="x", name="plant"):
    """Integrators from the order-th + 1 derivative to the position, all of them measured."""
    n = order + 1
    outputs = [label, *(f"{label}_d{k}" for k in range(1, n))]
    return ct.ss(np.diag(np.ones(order), 1), np.eye(n)[:, -1:], np.eye(n), 0, inputs=drive, outputs=outputs, name=name)


def ideal(plan, dt, order=2, method="auto", times=None, disturbance=None, **options):
    """Run of a chain of integrators that follows, all of its state measured."""
    replanner = cp.create_replanner_iosystem(
        plan, dt, order=order, measured=order, derivatives=order + 1, suffix="_r", **options
    )
    drives = [f"{label}_r_d{order + 1}" for label in plan.labels]
    plants = [chain(order, drive, label, f"plant_{label}") for drive, label in zip(drives, plan.labels, strict=True)]
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


# 1. Methods


@pytest.fixture(scope="module")
def rich():
    """Two axes, a goal that moves, position and speed measured on lagging plants: by each method."""
    plan = cp.TrigSpline(
        [Waypoint(1.0, [0, 1], 0, 0), Waypoint(5.0, [1, 0], [0.2, 0.1]), Waypoint(9.0, [3, -1], 0, 0)],
        alpha=2.0,
        labels=["x", "z"],
    )
    replanner = cp.create_replanner_iosystem(
        plan, 0.25, measured=1, goal_derivatives=1, suffix="_r", limits={1: [3.0, 3.0], 2: 8.0}, offset=0.1
    )
    a, b = np.array([[0.0, 1.0], [-16.0, -8.0]]), np.array([[0.0, 0.0, 0.0], [16.0, 8.0, 1.0]])
    plants = [
        ct.ss(
            a, b, np.eye(2), 0, inputs=[f"{s}_r", f"{s}_r_d1", f"{s}_r_d2"], outputs=[s, f"{s}_d1"], name=f"plant_{s}"
        )
        for s in "xz"
    ]
    outputs = ["x", "z", *replanner.output_labels]
    loop = ct.interconnect([replanner, *plants], inputs=replanner.input_labels[:4], outputs=[*outputs, "x_d1", "z_d1"])
    t = np.linspace(0.0, 11.0, 221)
    goal = {"x_goal": steps((3.3, 3.5), initial=3.0), "z_goal": cp.Step(-0.6, -1.0, 4.1)}
    state = np.zeros(loop.nstates)
    state[-4:] = [0.05, 0.0, 1.0, -0.1]
    return t, {method: cp.simulate(loop, t, goal, state, method=method, rtol=1e-9, atol=1e-11) for method in METHODS}


def test_compiled_and_python_agree(rich):
    _, runs = rich
    assert [runs[method].method for method in METHODS] == list(METHODS)
    one, other = (runs[method] for method in METHODS)
    assert np.abs(one.outputs - other.outputs).max() <= 1e-6 * np.abs(one.outputs).max()
    assert np.array_equal(state_of(one, "fits"), state_of(other, "fits"))
    assert state_of(one, "fits")[-1] > 10
    assert [str(e) for e in one.events] == [str(e) for e in other.events]


def test_the_loop_of_two_axes_gets_to_its_goals(rich):
    _, runs = rich
    assert np.abs(runs["compiled"].outputs[:2, -1] - [3.5, -0.6]).max() <= 2e-2


def test_it_runs_in_the_hybrid_loop_by_default():
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5), np.linspace(0, 10, 21))
    assert found.method == "compiled"


# 2. In the linear case: a constant law

LINEAR = [
    (1, 1.0, 0.0),
    (1, 0.5, 2.5),
    (2, 1.0, 0.0),
    (2, 2.0, 1.0),
    (3, 1.0, 0.0),
    (3, 4.0, 2.0),
    (4, 1.0, 0.0),
    (4, 3.0, 1.5),
]


def regulated(order, horizon, alpha, period, times, method="auto"):
    """Chain of integrators brought to 0 from a unit jet of every order."""
    plan = cp.Step(0.0, 0.0, labels=["x"])
    replanner = cp.create_replanner_iosystem(
        plan, period, order=order, horizon=horizon, alpha=alpha, measured=order, derivatives=order + 1, suffix="_r"
    )
    plant = chain(order, f"x_r_d{order + 1}")
    loop = ct.interconnect([replanner, plant], inputs=0, outputs=[*plant.output_labels, *replanner.output_labels])
    state = np.zeros(loop.nstates)
    state[-order - 1 :] = unit(order, horizon)
    return cp.simulate(loop, times, None, state, method=method).outputs[: order + 1]


def unit(order, horizon):
    return (-1.0) ** np.arange(order + 1) / horizon ** np.arange(order + 1)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("order", "horizon", "alpha"), LINEAR)
def test_at_its_samples_the_loop_is_the_power_of_a_matrix(order, horizon, alpha, method):
    """The map from fit to fit, by a direct solution: whatever the period."""
    period = 0.15 * horizon
    found = regulated(order, horizon, alpha, period, period * np.arange(9), method)
    state, scale = unit(order, horizon), np.abs(found).max(axis=1)
    for k in range(9):
        assert (np.abs(found[:, k] - state) <= 1e-6 * scale).all()
        state = map_from_fit_to_fit(order, horizon, alpha, period) @ state


@pytest.mark.slow
@pytest.mark.parametrize(("order", "horizon", "alpha"), LINEAR)
def test_the_loop_tends_to_the_constant_law_in_proportion_to_the_period(order, horizon, alpha):
    """Gains by the direct solution (alpha = 0: 6, 4; 60, 36, 9; 840, 480, 120, 16; 15120, ..., 25); slope measured."""
    rest = [0.0] * (order + 1)
    gains = [-between(e, rest, horizon, alpha, 0.0, order + 1)[-1, 0] for e in np.eye(order + 1).tolist()]
    printed = {1: [6, 4], 2: [60, 36, 9], 3: [840, 480, 120, 16], 4: [15120, 8400, 2100, 300, 25]}[order]
    if not alpha:
        assert np.abs(np.array(gains) * horizon ** np.arange(order + 1, 0, -1.0) - printed).max() <= 1e-8
    else:
        last = (order + 1) ** 2 * 0.5 * alpha / math.tan(0.5 * alpha) / horizon
        assert abs(gains[-1] - last) <= 1e-10 * last
    law = np.diag(np.ones(order), 1)
    law[-1] = -np.array(gains)
    times = horizon * np.array([0.0, 0.24, 0.48])
    wanted = np.array([expm(law * t) @ unit(order, horizon) for t in times])[:, 0]
    errors = []
    for share in (0.02, 0.01, 0.005):
        found = regulated(order, horizon, alpha, share * horizon, times)[0]
        errors.append(np.abs(found - wanted).max())
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(slopes - 1.0).max() <= 0.1
    assert errors[-1] <= 0.02


# 3. Period, horizon and alpha that do not go together


def made(order, horizon, alpha, period):
    return cp.create_replanner_iosystem(cp.Step(0.0), period, order=order, horizon=horizon, alpha=alpha)


def test_the_pages_example_is_allowed_and_what_is_above_the_bound_is_refused_with_the_figure():
    assert abs(radius(2, 1.0, 3.3, 0.1) - 0.961) < 5e-4
    made(2, 1.0, 3.3, 0.1)
    figure = radius(2, 2.0, 4.0, 0.1)
    assert figure > 1.0
    message = (
        "the map from fit to fit must have a spectral radius below 1, "
        f"got {figure:.4g} with dt = 0.1 s, horizon = 2 s and alpha = 4"
    )
    with pytest.raises(ValueError) as raised:
        made(2, 2.0, 4.0, 0.1)
    assert str(raised.value) == message


def radius(order, horizon, alpha, period):
    return float(np.abs(np.linalg.eigvals(map_from_fit_to_fit(order, horizon, alpha, period))).max())


@settings(max_examples=40)
@given(
    st.integers(0, 4),
    st.one_of(st.just(0.0), st.floats(0.1, 6.0)),
    st.floats(0.02, 1.0),
    st.sampled_from([1e-2, 1.0, 50.0]),
)
def test_accepted_where_the_radius_is_below_1_and_nowhere_else(order, alpha, share, horizon):
    figure = radius(order, horizon, alpha, share * horizon)
    assume(abs(figure - 1.0) > 1e-6)
    if figure < 1.0:
        made(order, horizon, alpha, share * horizon)
    else:
        with pytest.raises(ValueError, match="spectral radius below 1"):
            made(order, horizon, alpha, share * horizon)


def test_a_fixed_horizon_is_one_of_polynomials_unless_alpha_is_given():
    plan = cp.TrigSpline(REST, alpha=4.0)
    with pytest.raises(ValueError, match=r"alpha = 4$"):
        cp.create_replanner_iosystem(plan, 0.05, horizon=1.0, alpha=4.0)
    block = cp.create_replanner_iosystem(plan, 0.05, horizon=1.0)
    assert block.syslist[1]._horizons.rate == 0.0


# 4. Nothing in the way

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
TRIGGERS = {
    "period": {},
    "period, goal": {"goal_derivatives": 0},
    "goal": {"goal_derivatives": 0, "trigger": "goal"},
    "measured": {"measured": 2, "suffix": "_r"},
    "position measured": {"measured": 0, "suffix": "_r"},
    "measured, goal": {"measured": 1, "goal_derivatives": 0, "suffix": "_r"},
    "deviation": {"measured": 2, "suffix": "_r", "trigger": "deviation", "threshold": 1e-12},
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


def put_out(plan, replanner, t, x, **options):
    core = replanner.syslist[1]
    return np.asarray(core.outfcn(t, x, signals(plan, replanner, t, **options), {}), dtype=float)


@pytest.mark.parametrize("trigger", TRIGGERS)
@pytest.mark.parametrize("name", PLANS)
def test_undisturbed_every_plan_is_followed_as_it_was_made(name, trigger):
    """Sample by sample on a plant that is where the plan is, to 1e-10 of each derivative's size."""
    plan = PLANS[name]
    replanner = cp.create_replanner_iosystem(plan, 0.4, min_horizon=1.0, **TRIGGERS[trigger])
    core, fits = replanner.syslist[1], []
    x = np.zeros(core.nstates)
    size = np.abs(plan.jet(np.linspace(0, 10, 201), 2)).max(axis=2).T.ravel()
    for t in (0.4 * np.arange(26)).tolist():
        x = core.sample(t, x, signals(plan, replanner, t), {})
        fits.append(x[4])
        for s in (t, t + 0.13, t + 0.39):
            if s <= plan.end:
                wanted = plan.jet(s, 2).T.ravel()
                assert (np.abs(put_out(plan, replanner, s, x) - wanted) <= 1e-10 * size).all()
    assert x[3] == 0.0
    if trigger in ("measured", "position measured", "measured, goal"):
        assert fits[-1] == 23  # at 0, 0.4, ..., 8.8
    if trigger in ("goal", "deviation"):
        assert fits[-1] <= 1


@pytest.mark.parametrize("name", ["polynomial", "trigonometric, alpha 5", "piecewise", "joined"])
@pytest.mark.parametrize("trigger", ["period", "period, goal", "goal"])
def test_undisturbed_in_a_run(name, trigger):
    plan, t = PLANS[name], np.linspace(0.0, 10.0, 101)
    replanner = cp.create_replanner_iosystem(plan, 0.25, **TRIGGERS[trigger])
    found = cp.simulate(replanner, t, None if trigger == "period" else float(plan.final[0]))
    wanted = plan.jet(t, 2)[:, 0]
    assert (np.abs(found.outputs - wanted).max(axis=1) <= 1e-10 * np.abs(wanted).max(axis=1)).all()
    assert found.events == []


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("polynomial", {}),
        ("trigonometric, alpha 5", {}),
        ("piecewise, trigonometric", {"goal_derivatives": 0}),
        ("joined", {"trigger": "deviation", "threshold": 1e-3}),
    ],
)
def test_undisturbed_with_a_plant_that_follows(name, options):
    """A chain of integrators driven by the plan's third derivative is where the plan is, to the solver's error."""
    plan, t = PLANS[name], np.linspace(0.0, 10.0, 101)
    found = ideal(plan, 0.5, times=t, **options)
    wanted = plan.jet(t, 0)[0]
    rows = [found.output_labels.index(label) for label in plan.labels]
    assert np.abs(found.outputs[rows] - wanted).max() <= 1e-7
    assert (state_of(found, "fits")[-1] > 5) == (options.get("trigger") is None)


def test_a_plant_that_passes_the_reference_on_at_once():
    """What is measured at a fit is what was there just before it: no loop from a fit to itself."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, measured=2, suffix="_r")
    wires = ct.ss([], [], [], np.eye(3), inputs=replanner.output_labels, outputs=["x", "x_d1", "x_d2"], name="wires")
    loop = ct.interconnect([replanner, wires], inputs=0, outputs=["x", "x_d1", "x_d2"])
    t = np.linspace(0.0, 11.0, 111)
    for method in METHODS:
        found = cp.simulate(loop, t, method=method)
        assert np.abs(found.outputs - PLAN.jet(t, 2)[:, 0]).max() <= 1e-10


def test_an_acceleration_that_is_commanded_and_measured():
    """A double integrator driven by x_r_d2: its acceleration depends on the reference at once."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, measured=2, suffix="_r")
    plant = ct.ss(
        [[0, 1], [0, 0]],
        [[0], [1]],
        [[1, 0], [0, 1], [0, 0]],
        [[0], [0], [1]],
        inputs="x_r_d2",
        outputs=["x", "x_d1", "x_d2"],
    )
    loop = ct.interconnect([replanner, plant], inputs=0, outputs=["x", "x_r", "x_r_d1", "x_r_d2", "x_d1", "x_d2"])
    t = np.linspace(0.0, 11.0, 45)
    found = cp.simulate(loop, t, **TIGHT)
    assert np.abs(found.outputs[0] - PLAN(t)).max() <= 1e-7


def test_a_sensor_that_samples_at_the_same_instants_changes_nothing():
    """What is measured at a fit is what the sensor has just taken: neither its first 0 nor a period old."""
    plan = cp.PolySpline([Waypoint(0, 5, 0, 0), Waypoint(10, 6, 0, 0)], labels=["x"])
    t, runs = np.linspace(0.0, 12.0, 49), []
    for sampled in (False, True):
        replanner = cp.create_replanner_iosystem(plan, 0.25, order=1, measured=0, suffix="_r")
        outputs = "p" if sampled else "x"
        plant = ct.ss([[-9.0]], [[9.0, 1.0]], [[1.0]], 0, inputs=["x_r", "x_r_d1"], outputs=outputs, name="plant")
        sensor = cp.sample_hold(ct.ss([], [], [], [[1.0]], inputs="p", outputs="x", name="sensor", dt=None), 0.25)
        blocks = [replanner, plant, sensor] if sampled else [replanner, plant]
        loop = ct.interconnect(blocks, inputs=0, outputs=[outputs, "x_r", "x_r_d1"] + ["x"] * sampled)
        state = np.zeros(loop.nstates)
        state[loop.state_labels.index("plant_x[0]")] = 5.1
        runs.append(cp.simulate(loop, t, None, state, **TIGHT).outputs[:3])
    assert abs(runs[0][0, -1] - 6.0) <= 1e-2
    assert np.abs(runs[1] - runs[0]).max() <= 1e-8


def test_a_goal_that_is_sampled_at_the_same_instants_is_seen_at_once():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    hold = cp.sample_hold(ct.ss([], [], [], [[1.0]], inputs="wish", outputs="x_goal", name="hold", dt=None), 0.5)
    loop = ct.interconnect([replanner, hold], inputs="wish", outputs=replanner.output_labels)
    t = np.linspace(0.0, 12.0, 121)
    wish = cp.Step(1.5, 1.0, 3.2)
    assert np.abs(cp.simulate(loop, t, wish).outputs - cp.simulate(replanner, t, wish).outputs).max() <= 1e-10


# The plan that is made: against splines solved for directly


@pytest.mark.parametrize("alpha", [0.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_after_a_goal_and_a_deviation_it_is_the_plan_and_a_spline_between_two_jets(order, alpha):
    """alpha = rate x remaining time; the deviation in every derivative that is measured."""
    ends = [[0.0] * (order + 1), [1.0] + [0.0] * order]
    plan = cp.TrigSpline(
        [Waypoint.from_jets(t, x=jet) for t, jet in zip((2.0, 7.0), ends, strict=True)], alpha=alpha, warn=False
    )
    replanner = cp.create_replanner_iosystem(
        plan, 0.1, order=order, measured=order, goal_derivatives=min(order, 1), suffix="_r", derivatives=order + 1
    )
    core, rng = replanner.syslist[1], np.random.default_rng(order)
    off = np.zeros((9, 1))
    off[: order + 1, 0] = 0.1 * rng.normal(size=order + 1)
    goal = np.array([[1.3], [-0.2]])[: min(order, 1) + 1]
    for now in (2.0, 3.1, 5.9):
        left = 7.0 - now
        x = core.sample(now, np.zeros(core.nstates), signals(plan, replanner, now, goal=goal, off=off), {})
        last = [0.0] * (order + 1)
        last[0] = 0.3 + (-0.2 * left if order else 0.0)
        last[1:2] = [-0.2] if order else []
        s = np.linspace(0.0, left * (1 - 1e-12), 5)
        added = between(off[: order + 1, 0], last, left, alpha / 5.0 * left, s, order + 1)
        wanted = added + plan.jet(now + s, order + 1)[:, 0]
        found = np.array([put_out(plan, replanner, now + v, x) for v in s.tolist()]).T
        size = np.abs(wanted).max(axis=1, keepdims=True) + np.abs(added).max(axis=1, keepdims=True)
        assert (np.abs(found - wanted) <= 1e-9 * size).all()


def test_a_polynomial_plan_fitted_again_is_one_polynomial():
    """From the reference's jet to the new goal in one piece: scipy's, without a correction on top of anything."""
    t = np.linspace(0.0, 11.0, 111)
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0), t, cp.Step(1.5, 1.0, 3.2))
    peer = BPoly.from_derivatives([3.5, 10.0], [PLAN.jet(3.5, 2)[:, 0], [1.5, 0, 0]])
    later = (t >= 3.5) & (t <= 10.0)
    assert np.abs(found.outputs[0, t < 3.5] - PLAN(t[t < 3.5])).max() <= 1e-12
    for nu in range(3):
        wanted = (peer.derivative(nu) if nu else peer)(t[later])
        assert np.abs(found.outputs[nu, later] - wanted).max() <= 1e-11


@pytest.mark.parametrize("horizon", ["shrinking", 2.0])
@pytest.mark.parametrize("seed", range(2))
def test_runs_are_those_of_a_replanner_of_the_peers_polynomials(seed, horizon):
    """Two axes, goals that jump at random times, offsets of the clock: every derivative, all the way."""
    rng = np.random.default_rng(seed)
    plan = cp.PolySpline(TWO, labels=["x", "z"])
    times, targets = np.sort(rng.uniform(0.5, 11.0, 3)), plan.final + rng.normal(size=(4, 2))
    targets[0] = plan.final
    begin = float(rng.uniform(0.0, 0.2))

    def goal(t):
        return targets[np.searchsorted(times, t, side="right")][None]

    replanner = cp.create_replanner_iosystem(plan, 0.3, horizon=horizon, goal_derivatives=0, offset=begin)
    moves = [steps(*zip(times, targets[1:, a], strict=True), initial=targets[0, a]) for a in range(2)]
    t = np.linspace(0.0, 13.0, 131) + 1e-3
    found = cp.simulate(replanner, t - 1e-3, {"x_goal": moves[0], "z_goal": moves[1]})
    peer = Peer(plan, goal, 0.3, horizon=None if horizon == "shrinking" else horizon, begin=begin)
    wanted = peer(t - 1e-3)
    assert (np.abs(found.outputs - wanted).max(axis=1) <= 1e-9 * np.abs(wanted).max(axis=1)).all()


# 5. Joins

NODES = 22


def legs(edges, nodes=NODES):
    """Chebyshev times inside each leg, none at its ends."""
    cosines = np.cos(np.pi * (np.arange(nodes)[::-1] + 0.5) / nodes)
    return np.array([0.5 * (a + b) + 0.5 * (b - a) * cosines for a, b in itertools.pairwise(edges)])


@pytest.mark.parametrize("horizon", ["shrinking", 1.5])
@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_no_derivative_jumps_and_each_is_that_of_the_one_before(order, alpha, horizon):
    """From the outputs of a run alone: each leg as a Chebyshev series, taken to its ends and differentiated."""
    rng = np.random.default_rng(10 * order + int(alpha))
    ends = [[0.0] * (order + 1), [1.0] + [0.0] * order]
    plan = cp.TrigSpline(
        [Waypoint.from_jets(t, x=jet) for t, jet in zip((0.0, 4.0), ends, strict=True)], alpha=alpha, warn=False
    )
    replanner = cp.create_replanner_iosystem(plan, 0.25, order=order, horizon=horizon, goal_derivatives=0)
    goal = steps(
        *[(float(t), float(v)) for t, v in zip(np.sort(rng.uniform(0, 3, 4)), rng.normal(size=4), strict=True)]
    )
    edges = np.append(0.25 * np.arange(17), [4.25, 4.5])
    times = legs(edges)
    flat = np.union1d(times.ravel(), edges)
    found = cp.simulate(replanner, flat, goal)
    outputs = found.outputs.reshape(order + 1, -1)
    assert state_of(found, "fits")[-1] >= 2
    values = outputs[:, np.searchsorted(flat, times)]  # order, leg, node
    cosines = np.cos(np.pi * (np.arange(NODES)[::-1] + 0.5) / NODES)
    series = np.linalg.solve(chebyshev.chebvander(cosines, NODES - 1), values.reshape(-1, NODES).T)
    begins, finishes = (chebyshev.chebval(z, series).reshape(order + 1, -1) for z in (-1.0, 1.0))
    size = np.abs(values).max(axis=(1, 2))
    jumps = np.abs(begins[:, 1:] - finishes[:, :-1]).max(axis=1)
    assert (jumps <= 1e-9 * size).all()
    # A sample at an edge counts to what follows; no derivative jumps, so either limit is it.
    assert (np.abs(outputs[:, np.searchsorted(flat, edges[1:-1])] - begins[:, 1:]).max(axis=1) <= 1e-9 * size).all()
    slopes = chebyshev.chebval(cosines, chebyshev.chebder(series) * 2.0 / 0.25).reshape(order + 1, -1, NODES)
    # What follows from rounding: NODES^2 times the last digit over the leg.
    assert (
        np.abs(slopes[:-1] - values[1:]).max(axis=(1, 2), initial=0.0) <= 1e-9 * (size[1:] + size[:-1] / 0.25)
    ).all()
    # No staircase: between fits it moves as fast as its mean slope says.
    travel = np.abs(values[0]).max() * 1e-3
    assert (np.ptp(values[0, 1:12], axis=1) > travel).mean() > 0.8


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.integers(0, 4),
    st.sampled_from([0.0, 1.0, 3.0, 5.0]),
    st.lists(st.tuples(st.floats(0.0, 9.0), st.floats(-5.0, 5.0)), min_size=1, max_size=6),
    st.integers(0, 10**6),
)
def test_no_jump_at_any_fit_whatever_the_goals(order, alpha, moves, seed):
    """The block before and after each sample, at one instant: derivatives 0 to `order`, two axes."""
    rng = np.random.default_rng(seed)
    ends = np.zeros((2, order + 1, 2))
    ends[1, 0] = [1.0, -2.0]
    plan = cp.TrigSpline([Waypoint(t, *jet) for t, jet in zip((0.0, 10.0), ends, strict=True)], alpha=alpha, warn=False)
    options = {} if alpha > 2.0 or rng.random() < 0.5 else {"horizon": 4.0}
    replanner = cp.create_replanner_iosystem(plan, 0.5, order=order, goal_derivatives=0, **options)
    core = replanner.syslist[1]
    x, size, jumps = np.zeros(core.nstates), np.zeros(2 * (order + 1)), []
    for t in np.arange(0.0, 12.0, 0.5).tolist():
        aim = [plan.final + sum(value for time, value in moves if time <= t)]
        before = put_out(plan, replanner, t, x, goal=aim)
        x = core.sample(t, x, signals(plan, replanner, t, goal=aim), {})
        after = put_out(plan, replanner, t, x, goal=aim)
        jumps.append(np.abs(after - before))
        middle = [put_out(plan, replanner, t + s, x, goal=aim) for s in (0.0, 0.2, 0.4)]
        size = np.maximum(size, np.abs(middle).max(axis=0))
    assert (np.max(jumps, axis=0) <= 1e-9 * size).all()


def test_a_derivative_above_the_order_does_jump():
    """So that the tests above could fail."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, derivatives=3)
    core = replanner.syslist[1]
    x = core.sample(4.0, np.zeros(core.nstates), signals(PLAN, replanner, 4.0, goal=[[2.0]]), {})
    jump = put_out(PLAN, replanner, 4.0, x) - PLAN.jet(4.0, 3)[:, 0]
    assert np.abs(jump[:3]).max() <= 1e-12
    assert abs(jump[3] - 60.0 / 6.0**3) <= 1e-10  # minimum jerk over 6 s: 60 x move/H^3


# 6. Goals


def conveyor(position, speed, at=0.0):
    """Goal at a position at some time, moving on for ever, and its name for a run."""
    line = cp.PolySpline(
        [Waypoint(-50.0, position - speed * (50.0 + at), speed), Waypoint(50.0, position + speed * (50.0 - at), speed)]
    )
    return {"x_goal": line, "x_goal_d1": speed}


RUN = np.linspace(0.0, 13.0, 131)


@pytest.mark.parametrize("speed", [-0.3, 0.7])
@pytest.mark.parametrize(
    "plan", [PLAN, cp.TrigSpline(REST, alpha=3.0, labels=["x"])], ids=["polynomial", "trigonometric"]
)
def test_a_conveyor_is_met_exactly_and_followed_from_there(plan, speed):
    found = cp.simulate(cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1), RUN, conveyor(2.0, speed))
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (2.0 + speed * RUN[after])).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - speed).max() <= 1e-9
    assert np.abs(found.outputs[2, after]).max() <= 1e-8
    assert found.events == []  # it goes on as it was taken to


def test_a_conveyor_whose_speed_changes_is_met_all_the_same():
    """Accelerated between 3 and 5 s; then it is constant."""
    line = (
        cp.PolySpline([Waypoint(-50.0, -5.0, 0.1), Waypoint(3.0, 0.3, 0.1)])
        .then(cp.PolySpline([Waypoint(3.0, 0.3, 0.1, 0), Waypoint(5.0, 1.0, 0.5, 0)]))
        .then(cp.PolySpline([Waypoint(5.0, 1.0, 0.5), Waypoint(50.0, 23.5, 0.5)]))
    )
    fast = cp.PolySpline([Waypoint(3.0, 0.1, 0.0), Waypoint(5.0, 0.5, 0.0)])
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, {"x_goal": line, "x_goal_d1": fast})
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (1.0 + 0.5 * (RUN[after] - 5.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - 0.5).max() <= 1e-9
    assert state_of(found, "fits")[-1] >= 8


def test_a_goal_that_accelerates_is_followed_to_its_second_derivative():
    """x = t^2/20 with both derivatives, order 3."""
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(10, 1, 0, 0, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, order=3, goal_derivatives=2)
    square = cp.PolySpline([Waypoint(0, 0, 0), Waypoint(20, 20)])
    slope = cp.PolySpline([Waypoint(0, 0), Waypoint(20, 2)])
    found = cp.simulate(replanner, RUN, {"x_goal": square, "x_goal_d1": slope, "x_goal_d2": 0.1})
    after = RUN >= 10.0 - 1e-9
    wanted = [RUN[after] ** 2 / 20, RUN[after] / 10, np.full(after.sum(), 0.1)]
    assert np.abs(found.outputs[:3, after] - wanted).max() <= 1e-8
    assert found.events == []


def test_a_plan_that_ends_in_motion_onto_the_conveyor_it_was_made_for():
    """The goal is what the plan itself leads to: nothing to plan again, and it goes on."""
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(10, 5, 0.5, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, conveyor(5.0, 0.5, at=10.0))
    during, after = RUN < 9.95, RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[:, during] - plan.jet(RUN[during], 2)[:, 0]).max() <= 1e-9
    assert np.abs(found.outputs[0, after] - (5.0 + 0.5 * (RUN[after] - 10.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - 0.5).max() <= 1e-9
    assert found.events == []


@pytest.mark.parametrize("speed", [0.5, 0.0, -0.2])
def test_a_plan_that_ends_in_motion_onto_another_goal(speed):
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(10, 5, 0.5, 0)], labels=["x"])
    replanner = cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=1)
    found = cp.simulate(replanner, RUN, conveyor(5.3, speed, at=10.0))
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (5.3 + speed * (RUN[after] - 10.0))).max() <= 1e-9
    assert np.abs(found.outputs[1, after] - speed).max() <= 1e-9


def test_a_goal_that_passes_through_0_goes_on_as_it_was_taken_to():
    """Rounding is no move of a goal, however small the goal."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, goal_derivatives=1, min_horizon=3.0)
    found = cp.simulate(replanner, RUN, conveyor(0.0, 1.0, at=9.0))
    assert np.abs(found.outputs[0, RUN > 10.0] - (RUN[RUN > 10.0] - 9.0)).max() <= 1e-9
    assert found.events == []


@pytest.mark.parametrize("method", METHODS)
def test_a_resting_goal_given_with_its_derivatives_is_not_new(method):
    """Rounding is none in what a plan arrives with (1e-17 for 0), nor in what the solver keeps: no fit, no event."""
    plan = cp.TrigSpline([Waypoint(0, [0, 1], 0, 0), Waypoint(9, [3, -1], 0, 0)], alpha=2.0, labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(
        plan, 0.25, measured=0, goal_derivatives=2, suffix="_r", trigger="deviation", threshold=5.0
    )
    a, b = np.array([[0.0, 1.0], [-16.0, -8.0]]), np.array([[0.0, 0.0, 0.0], [16.0, 8.0, 1.0]])
    plants = [
        ct.ss(a, b, [[1, 0]], 0, inputs=[f"{s}_r", f"{s}_r_d1", f"{s}_r_d2"], outputs=s, name=f"plant_{s}")
        for s in "xz"
    ]
    goals = replanner.input_labels[:6]
    loop = ct.interconnect([replanner, *plants], inputs=goals, outputs=["x", "z", *replanner.output_labels])
    state = np.zeros(loop.nstates)
    state[-4:] = [0.05, 0.0, 1.0, -0.1]
    t = np.linspace(0.0, 14.0, 57)
    found = cp.simulate(loop, t, {"x_goal": 3.0, "z_goal": -1.0}, state, method=method)
    assert state_of(found, "fits")[-1] == 0
    assert found.events == []
    assert np.abs(found.outputs[[2, 5]] - plan(t)).max() <= 1e-10


@pytest.mark.parametrize("name", ["polynomial", "trigonometric, alpha 1", "trigonometric, alpha 5"])
def test_a_run_that_begins_too_late_for_a_fit_needs_none(name):
    """The goal rests where the plan ends: nothing is missed."""
    plan = PLANS[name]
    replanner = cp.create_replanner_iosystem(plan, 0.25, goal_derivatives=2)
    t = np.linspace(9.5, 12.0, 11)
    found = cp.simulate(replanner, t, {f"{plan.labels[0]}_goal": 1.0})
    assert found.events == []
    assert np.abs(found.outputs - plan.jet(t, 2)[:, 0]).max() <= 1e-10


@pytest.mark.parametrize("moment", [1e6, -1e6])
def test_a_conveyor_met_in_absolute_time(moment):
    """A clock of 1e6 s has 1e-10 s to tell: no false event from it."""
    goal = conveyor(2.0, 0.3, at=0.0)
    replanner = cp.create_replanner_iosystem(PLAN.shift(moment), 0.5, goal_derivatives=1)
    found = cp.simulate(replanner, moment + RUN, {"x_goal": goal["x_goal"].shift(moment), "x_goal_d1": 0.3})
    after = RUN >= 10.0 - 1e-9
    assert np.abs(found.outputs[0, after] - (2.0 + 0.3 * RUN[after])).max() <= 1e-8
    assert found.events == []


def test_shrinking_stops_and_a_goal_moved_too_late_is_an_event():
    """min_horizon 2 s: the last fit at 8 s or before; the goal that moves at 8.6 s is not reached, and comes back."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, min_horizon=2.0)
    t = np.linspace(0.0, 12.0, 241)
    for method in METHODS:
        found = cp.simulate(replanner, t, steps((7.9, 1.2), (8.6, 3.0), (10.8, 1.2)), method=method)
        fits = state_of(found, "fits")
        moved = np.flatnonzero(np.diff(fits)) + 1
        assert t[moved].tolist() == pytest.approx([8.0])
        assert happened(found, MISSED) == [(9.0, "above"), (11.0, "inside")]
        assert len(found.events) == 2
        peer = BPoly.from_derivatives([8.0, 10.0], [PLAN.jet(8.0, 2)[:, 0], [1.2, 0, 0]])
        held = (t >= 8.0) & (t <= 10.0)
        assert np.abs(found.outputs[0, held] - peer(t[held])).max() <= 1e-10
        assert np.abs(found.outputs[0, t >= 10.0] - 1.2).max() <= 1e-10


def test_the_least_horizon_is_five_periods_and_half_the_plan_at_most():
    """The last fit of a plant that is measured, by its count."""
    t = np.array([0.0, 10.0])
    assert state_of(ideal(PLAN, 0.5, times=t), "fits")[-1] == 16  # 0, ..., 7.5
    assert state_of(ideal(PLAN, 2.0, times=t), "fits")[-1] == 3  # 0, 2, 4
    assert state_of(ideal(PLAN, 0.5, times=t, min_horizon=0.5), "fits")[-1] == 20  # 0, ..., 9.5
    assert state_of(ideal(PLAN, 0.5, times=t, min_horizon=10.0), "fits")[-1] == 1


def test_a_fixed_horizon_never_stops():
    """Fits at every period for as long as the run, and a goal is met after the plan's end as well as before it."""
    t = np.linspace(0.0, 30.0, 121)
    replanner = cp.create_replanner_iosystem(PLAN, 0.25, horizon=2.0, goal_derivatives=0)
    found = cp.simulate(replanner, t, steps((20.1, 3.0)))
    assert state_of(found, "fits").tolist() == (np.arange(121) + 1).tolist()
    assert np.abs(found.outputs[0, t <= 20.0] - PLAN(t[t <= 20.0])).max() <= 1e-9
    assert abs(found.outputs[0, -1] - 3.0) <= 1e-3
    assert found.events == []


# 7. Triggers


def drifting(rate, **options):
    """Position that drifts off the reference at a constant rate; derivative 0 is measured."""
    plan = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(10, [1, 2], 0, 0)], labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.1, measured=0, suffix="_r", min_horizon=1.0, **options)
    plant = ct.ss(
        np.zeros((2, 2)), np.eye(2, 4), np.eye(2), 0, inputs=["ex", "ez", "ax", "az"], outputs=["x", "z"], name="plant"
    )
    speeds = ct.ss([], [], [], np.eye(2), inputs=["x_r_d1", "z_r_d1"], outputs=["ux", "uz"], name="speeds")
    drift = ct.summing_junction(["ux", "wx"], "ex", name="sx"), ct.summing_junction(["uz", "wz"], "ez", name="sz")
    loop = ct.interconnect(
        [replanner, speeds, *drift, plant],
        inputs=["wx", "wz", "ax", "az"],
        outputs=["x", "z", *replanner.output_labels],
    )
    t = np.linspace(0.0, 10.0, 101)
    return t, cp.simulate(loop, t, {"wx": rate[0], "wz": rate[1]})


def test_deviation_fits_only_above_the_threshold():
    """3-4-5: the distance grows by 0.01 a period; above 0.025 at every third sample, from 0 on again after each fit."""
    t, found = drifting((0.06, 0.08), trigger="deviation", threshold=0.025)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert np.allclose(t[fits], np.arange(0.3, 9.05, 0.3))
    assert state_of(found, "fits")[0] == 0


def test_a_distance_below_the_threshold_is_let_be():
    """Drift of 1.0 in all, the threshold at 1.01; without a trigger there are as many fits as periods."""
    _, found = drifting((0.06, 0.08), trigger="deviation", threshold=1.01)
    assert state_of(found, "fits")[-1] == 0
    _, found = drifting((0.06, 0.08))
    assert state_of(found, "fits")[-1] == 91


def test_deviation_heeds_a_new_goal_as_well():
    replanner = cp.create_replanner_iosystem(
        PLAN, 0.5, measured=0, goal_derivatives=0, suffix="_r", trigger="deviation", threshold=0.5
    )
    core = replanner.syslist[1]
    x = np.zeros(core.nstates)
    x = core.sample(1.0, x, signals(PLAN, replanner, 1.0), {})
    assert x[4] == 0
    x = core.sample(1.5, x, signals(PLAN, replanner, 1.5, goal=[[1.1]]), {})
    assert x[4] == 1
    lifted = float(put_out(PLAN, replanner, 2.0, x)[0] - PLAN(2.0))
    x = core.sample(2.0, x, signals(PLAN, replanner, 2.0, goal=[[1.1]], off=lifted), {})
    assert x[4] == 1
    x = core.sample(2.5, x, signals(PLAN, replanner, 2.5, goal=[[1.1]], off=0.6), {})
    assert x[4] == 2


def test_goal_fits_for_new_goals_only():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, trigger="goal", horizon=2.0)
    t = np.linspace(0.0, 14.0, 57)
    found = cp.simulate(replanner, t, steps((2.2, 2.0), (4.0, 1.0), (9.1, 1.5), (9.2, 1.7), (12.9, -1.0)))
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert t[fits].tolist() == [2.5, 4.0, 9.5, 13.0]
    assert state_of(found, "fits")[0] <= 1


# 8. Limits


def grid_peaks(found, order):
    """Greatest magnitudes of the derivatives 0 to `order` in a record of one axis."""
    return np.abs(found.outputs[: order + 1]).max(axis=1)


FINE = np.linspace(0.0, 13.0, 2601)


@pytest.mark.parametrize("method", METHODS)
def test_a_goal_out_of_reach_is_not_taken_and_one_within_is_taken_up_again(method):
    """Speed up to 0.6: at 4 s the goal goes to where it would take more, at 6 s back to where it takes less."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, limits={1: 0.6})
    found = cp.simulate(replanner, FINE, steps((2.2, 1.3), (4.2, 4.0), (6.1, 1.5)), method=method)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    assert FINE[fits].tolist() == pytest.approx([2.5, 6.5])
    assert happened(found, MISSED) == [(4.5, "above"), (6.5, "inside")]
    assert len(found.events) == 2
    peer = BPoly.from_derivatives([2.5, 10.0], [PLAN.jet(2.5, 2)[:, 0], [1.3, 0, 0]])
    beyond = BPoly.from_derivatives(
        [4.5, 10.0], [[peer.derivative(k)(4.5) if k else peer(4.5) for k in range(3)], [4.0, 0, 0]]
    )
    assert beyond.derivative()(np.linspace(4.5, 10.0, 99)).max() > 0.6
    held = (FINE >= 2.5) & (FINE < 6.5)
    assert np.abs(found.outputs[0, held] - peer(FINE[held])).max() <= 1e-10
    assert np.abs(found.outputs[:, -1] - [1.5, 0, 0]).max() <= 1e-9
    assert 0.25 < grid_peaks(found, 1)[1] <= 0.6


@pytest.mark.parametrize("horizon", ["shrinking", 3.0])
@pytest.mark.parametrize("seed", range(2))
def test_limits_hold_and_the_same_goals_are_taken_as_by_the_peer(seed, horizon):
    """Random goals, limits on position, speed and acceleration; BPoly on a grid says which fits keep them."""
    rng = np.random.default_rng(100 + seed)
    times, targets = np.sort(rng.uniform(0.5, 11.0, 8)), np.append(1.0, 1.0 + rng.normal(size=8))
    limits = {0: 1.8, 1: 0.65, 2: 0.55}
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0, limits=limits, horizon=horizon)
    found = cp.simulate(replanner, FINE, steps(*zip(times.tolist(), targets[1:].tolist(), strict=True)))
    for nu, limit in limits.items():
        assert np.abs(found.outputs[nu]).max() <= limit * (1 + 1e-9)

    def goal(t):
        return np.array([[targets[np.searchsorted(times, t, side="right")]]])

    peer = Peer(PLAN, goal, 0.5, horizon=None if horizon == "shrinking" else horizon, limits=limits)
    assert any(missed for _, missed in peer.missed)
    coarse = np.linspace(0, 13, 131)
    wanted = peer(coarse)
    assert np.abs(found.outputs[:, ::20] - wanted).max() <= 1e-9
    changes = [
        (t, m) for (t, m), (_, before) in zip(peer.missed[1:], peer.missed, strict=False) if m != before and t <= 13
    ]
    assert happened(found, MISSED) == [(round(t, 9), "above" if m else "inside") for t, m in changes]


@pytest.mark.parametrize("name", ["trigonometric, inner waypoints, alpha 4", "piecewise", "joined"])
def test_limits_hold_on_plans_with_joins_and_for_each_axis_its_own(name):
    """Every fit that is taken keeps them to the end of the run, on a grid; and some are, and some are not."""
    plan = PLANS[name]
    rng = np.random.default_rng(5)
    limit = 1.1 * float(plan.peak(1)[0])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0, limits={1: [limit]}, order=2)
    moves = [(0.2 + k, float(1.0 + 4.0 * limit * rng.normal())) for k in range(8)]
    found = cp.simulate(replanner, FINE, steps(*moves))
    assert np.abs(found.outputs[1]).max() <= limit * (1 + 1e-9)
    assert 0 < state_of(found, "fits")[-1] < 9
    assert happened(found, MISSED)


def test_each_axis_has_its_limit():
    plan = cp.PolySpline([Waypoint(0, [0, 0], 0, 0), Waypoint(10, [1, 1], 0, 0)], labels=["x", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0, limits={1: [0.2, 0.6]}, trigger="goal")
    core = replanner.syslist[1]
    for goal, taken in (([1.0, 2.5], 1), ([1.2, 1.0], 0), ([1.0, 3.5], 0), ([0.9, 0.0], 1)):
        x = core.sample(0.0, np.zeros(core.nstates), signals(plan, replanner, 0.0, goal=[goal]), {})
        assert (x[4], x[3]) == (taken, 1 - taken)
        speed = 15 / 8 * np.abs(goal) / 10.0  # minimum jerk
        assert bool((speed <= [0.2, 0.6]).all()) == bool(taken)


@pytest.mark.parametrize("trigger", ["period", "goal"])
def test_limits_hold_where_the_correction_ends_before_the_plan(trigger):
    """Fixed horizon: at its end the goal's change stays on top of a plan that still goes on."""
    replanner = cp.create_replanner_iosystem(
        PLAN, 0.5, horizon=1.0, goal_derivatives=0, trigger=trigger, limits={0: 1.2}
    )
    found = cp.simulate(replanner, FINE, steps((1.1, 1.5)))
    assert np.abs(found.outputs[0]).max() <= 1.2
    assert happened(found, MISSED)[0] == (1.5, "above")
    found = cp.simulate(replanner, FINE, steps((1.1, 1.15)))
    assert np.abs(found.outputs[0]).max() == pytest.approx(1.15, abs=1e-3)
    assert found.events == []


def test_limits_on_the_speed_of_a_plan_and_a_conveyor_together():
    """Peak of the plan 0.1875; 0.15 more on top of it is beyond 0.3 though either alone is not."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, horizon=1.0, goal_derivatives=1, limits={1: 0.3})
    found = cp.simulate(replanner, FINE, conveyor(1.0, 0.15, at=0.0))
    assert np.abs(found.outputs[1]).max() <= 0.3 * (1 + 1e-9)
    assert happened(found, MISSED)[0] == (0.0, "above")


def test_what_is_measured_beyond_the_limits_is_not_begun_from():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=1, suffix="_r", limits={1: 0.5})
    core = replanner.syslist[1]
    off = np.zeros((9, 1))
    for speed, taken in ((0.2, 1), (0.4, 0), (-0.6, 1), (-0.8, 0)):
        off[1] = speed  # the plan's own is 0.12 to 0.19 here
        x = core.sample(4.0, np.zeros(core.nstates), signals(PLAN, replanner, 4.0, off=off), {})
        assert (x[4], x[3]) == (taken, 1 - taken)


def test_a_plan_that_breaks_its_limits_says_which_by_how_much_and_when():
    peak, time = 15 / 8 / 10, 5.0
    message = f"plan must keep limits\\[1\\] = 0.18, got {peak:.6g} of x at {time:g} s"
    with pytest.raises(ValueError, match=message):
        cp.create_replanner_iosystem(PLAN, 0.5, limits={1: 0.18})
    cp.create_replanner_iosystem(PLAN, 0.5, limits={1: peak})
    two = cp.PolySpline([Waypoint(2, [0, 0], 0, 0), Waypoint(12, [1, -2], 0, 0)], labels=["x", "z"])
    with pytest.raises(ValueError, match=r"limits\[1\] = 0.3, got -0.375 of z at 7 s"):
        cp.create_replanner_iosystem(two, 0.5, limits={1: [0.2, 0.3]})


# 9. Lost values


def gap(source, sink, name, begin, end):
    """Sensor that puts out nan for a while."""

    def seen(t, x, u, params):
        lost = (t > begin) * (t < end)
        return np.array([np.where(lost, np.nan, value) for value in u])

    return ct.nlsys(None, seen, inputs=source, outputs=sink, name=name, dt=0)


@pytest.mark.parametrize("method", METHODS)
def test_a_sensor_that_fails_for_a_while(method):
    """Fits at 0 to 3 s; none at 3.5 to 5 s, while the last good plan is held; again from 5.5 s on."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=1, derivatives=1, suffix="_r", min_horizon=1.0)
    plant = ct.ss(
        [[0, 1], [-9, -6]], [[0, 0], [9, 6]], np.eye(2), 0, inputs=["x_r", "x_r_d1"], outputs=["p", "v"], name="plant"
    )
    sensor = gap(["p", "v"], ["x", "x_d1"], "sensor", 3.3, 5.2)
    loop = ct.interconnect([replanner, plant, sensor], inputs=0, outputs=["p", "x_r", "x_r_d1", "x", "v", "x_d1"])
    t = np.linspace(0.0, 14.0, 281)
    state = np.zeros(loop.nstates)
    state[-2] = 0.1
    found = cp.simulate(loop, t, None, state, method=method)
    assert found.method == method
    assert np.isfinite(found.outputs[[0, 1, 2, 4]]).all()
    assert np.isfinite(found.states).all()
    assert np.isnan(found.outputs[3, (t > 3.31) & (t < 5.19)]).all()
    assert happened(found, LOST) == [(3.5, "above"), (5.5, "inside")]
    assert len(found.events) == 2
    fits = np.flatnonzero(np.diff(state_of(found, "fits"), prepend=0.0))
    assert np.allclose(t[fits], [0, 0.5, 1, 1.5, 2, 2.5, 3, 5.5, 6, 6.5, 7, 7.5, 8, 8.5, 9])
    # Held: one polynomial from 3 s to the goal, found from what came out before anything was lost.
    x0, v0 = (float(found.outputs[k, t.searchsorted(3.0 - 1e-9)]) for k in (1, 2))
    held = (t >= 3.0 - 1e-9) & (t < 5.45)
    coefficients = np.polynomial.Polynomial.fit(t[held], found.outputs[1, held], 5)
    assert np.abs(coefficients(t[held]) - found.outputs[1, held]).max() <= 1e-10
    assert np.abs([coefficients(3.0) - x0, coefficients.deriv()(3.0) - v0]).max() <= 1e-8
    assert np.abs([coefficients(10.0) - 1.0, coefficients.deriv()(10.0), coefficients.deriv(2)(10.0)]).max() <= 1e-6
    assert abs(found.outputs[0, -1] - 1.0) <= 1e-3


@pytest.mark.parametrize("method", METHODS)
def test_a_goal_that_is_lost_for_a_while(method):
    """Between 3.3 and 5.2 s: the goal of before is kept, the one of afterwards taken up."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    loop = ct.interconnect(
        [replanner, gap("wish", "x_goal", "radio", 3.3, 5.2)], inputs="wish", outputs=replanner.output_labels
    )
    t = np.linspace(0.0, 12.0, 121)
    found = cp.simulate(loop, t, steps((2.2, 1.2), (4.0, 0.5)), method=method)
    assert np.isfinite(found.outputs).all()
    assert happened(found, LOST) == [(3.5, "above"), (5.5, "inside")]
    first = BPoly.from_derivatives([2.5, 10.0], [PLAN.jet(2.5, 2)[:, 0], [1.2, 0, 0]])
    jet = [first.derivative(k)(5.5) if k else first(5.5) for k in range(3)]
    second = BPoly.from_derivatives([5.5, 10.0], [jet, [0.5, 0, 0]])
    before, after = (t >= 2.5) & (t < 5.45), (t >= 5.5) & (t <= 10.0)
    assert np.abs(found.outputs[0, before] - first(t[before])).max() <= 1e-10
    assert np.abs(found.outputs[0, after] - second(t[after])).max() <= 1e-10


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_lost_and_holds_everything(value):
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, measured=0, goal_derivatives=0, suffix="_r")
    core = replanner.syslist[1]
    before = core.sample(1.0, np.zeros(core.nstates), signals(PLAN, replanner, 1.0, goal=[[1.3]]), {})
    for label in ("x", "x_goal"):
        u = signals(PLAN, replanner, 1.5, goal=[[1.7]])
        u[core.input_labels.index(label)] = value
        after = core.sample(1.5, before, u, {})
        assert after[2] == 1.0
        assert np.array_equal(np.delete(after, 2), np.delete(before, 2))


# 10. Bad input

TRIG = cp.TrigSpline(REST, alpha=1.0)
BAD = [
    ({"dt": 0.0}, "dt must be finite and above 0, got 0.0"),
    ({"dt": -0.1}, "dt must be finite and above 0, got -0.1"),
    ({"dt": math.nan}, "dt must be finite and above 0, got nan"),
    ({"dt": 10.5}, "dt must be at most the plan's duration, 10 s, got 10.5 s"),
    ({"dt": 1.5, "horizon": 1.0}, "dt must be at most the horizon, 1 s, got 1.5 s"),
    ({"horizon": 0.0}, "horizon must be finite and above 0, got 0.0"),
    ({"horizon": math.inf}, "horizon must be finite and above 0, got inf"),
    ({"horizon": "growing"}, "horizon must be a number of seconds or \"shrinking\", got 'growing'"),
    ({"min_horizon": 0.1}, "min_horizon must lie between dt, 0.5 s, and the plan's duration, 10 s, got 0.1 s"),
    ({"min_horizon": 10.1}, "min_horizon must lie between dt, 0.5 s, and the plan's duration, 10 s, got 10.1 s"),
    ({"min_horizon": -1.0}, "min_horizon must be finite and above 0, got -1.0"),
    ({"min_horizon": 1.0, "horizon": 2.0}, 'min_horizon must go with horizon = "shrinking", got 1.0 with 2 s'),
    ({"trigger": "always"}, "trigger must be one of period, deviation, goal, got 'always'"),
    ({"trigger": "goal"}, 'goal_derivatives must be given for trigger = "goal", got None'),
    ({"trigger": "deviation"}, 'measured must be given for trigger = "deviation", got None'),
    (
        {"trigger": "deviation", "measured": 0, "suffix": "_r"},
        'threshold must be given for trigger = "deviation", got None',
    ),
    (
        {"trigger": "deviation", "measured": 0, "suffix": "_r", "threshold": 0.0},
        "threshold must be finite and above 0, got 0.0",
    ),
    ({"threshold": 0.1}, "threshold must go with trigger = \"deviation\", got 0.1 with 'period'"),
    ({"measured": 3, "suffix": "_r"}, "measured must be at most order, 2, got 3"),
    ({"measured": -1, "suffix": "_r"}, "measured must be a whole number from 0, got -1"),
    ({"goal_derivatives": 3}, "goal_derivatives must be at most order, 2, got 3"),
    ({"goal_derivatives": 1.5}, "goal_derivatives must be a whole number from 0, got 1.5"),
    ({"order": -1}, "order must be a whole number from 0, got -1"),
    ({"derivatives": -1}, "derivatives must be a whole number from 0, got -1"),
    ({"alpha": 6.5}, "alpha must lie in [0, 2 pi), got 6.5"),
    ({"alpha": -0.5}, "alpha must lie in [0, 2 pi), got -0.5"),
    ({"measured": 1}, "suffix must tell outputs from inputs, got '' and x, x_d1 among both"),
    (
        {"goal_derivatives": 0, "suffix": "_goal"},
        "suffix must tell outputs from inputs, got '_goal' and x_goal among both",
    ),
    ({"offset": -0.1}, "offset must be finite and at least 0, got -0.1"),
    ({"offset": math.inf}, "offset must be finite and at least 0, got inf"),
    ({"limits": {1: 0.0}}, "limits[1] must be above 0, one number or 1, got 0.0"),
    ({"limits": {1: math.nan}}, "limits[1] must be above 0, one number or 1, got nan"),
    ({"limits": {1: [1.0, 2.0]}}, "limits[1] must be above 0, one number or 1, got [1.0, 2.0]"),
    ({"limits": {-1: 1.0}}, "orders of limits must be a whole number from 0, got -1"),
]


@pytest.mark.parametrize(("options", "message"), BAD, ids=lambda v: ", ".join(v) if isinstance(v, dict) else "")
def test_bad_values_get_one_line(options, message):
    with pytest.raises(ValueError) as raised:
        cp.create_replanner_iosystem(PLAN, **({"dt": 0.5} | options))
    assert str(raised.value) == message


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("x", 0.5), {}, "plan must be a Trajectory, got str"),
        ((None, 0.5), {}, "plan must be a Trajectory, got NoneType"),
        ((PLAN, "0.5s"), {}, "dt must be a number, got '0.5s'"),
        ((PLAN, 0.5), {"horizon": None}, "horizon must be a number, got None"),
        ((PLAN, 0.5), {"order": "2"}, "order must be a whole number from 0, got '2'"),
        ((PLAN, 0.5), {"measured": True}, "measured must be a whole number from 0, got True"),
        ((PLAN, 0.5), {"limits": [1.0]}, "limits must be a mapping of orders to magnitudes, got list"),
        ((PLAN, 0.5), {"limits": {1: "fast"}}, "limits[1] must be real numbers, got 'fast'"),
    ],
)
def test_wrong_kinds_get_one_line(arguments, options, message):
    with pytest.raises(TypeError) as raised:
        cp.create_replanner_iosystem(*arguments, **options)
    assert str(raised.value) == message


def test_a_plan_without_duration_cannot_shrink():
    with pytest.raises(ValueError, match="horizon must be a number of seconds for a plan without duration"):
        cp.create_replanner_iosystem(cp.Step(1.0), 0.1)
    cp.create_replanner_iosystem(cp.Step(1.0), 0.1, horizon=1.0)


# 11. Times, names and loops


@pytest.mark.parametrize("moment", [1e6, -1e6, 123.456])
def test_absolute_times(moment):
    """The same run later, to what a clock of that size can tell."""
    goal, t = steps((3.2, 1.5)), np.linspace(-1.0, 12.0, 131)
    here = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.4, goal_derivatives=0, offset=0.1), t, goal)
    plan = PLAN.shift(moment)
    there = cp.simulate(
        cp.create_replanner_iosystem(plan, 0.4, goal_derivatives=0, offset=0.1), moment + t, goal.shift(moment)
    )
    assert np.abs(here.outputs - there.outputs).max() <= 1e-9
    assert np.array_equal(state_of(here, "fits"), state_of(there, "fits"))
    assert np.abs(here.outputs[0, t > 10.0] - 1.5).max() <= 1e-9


@pytest.mark.parametrize("begin", [-3.0, 2.0, 8.6, 10.5])
def test_a_run_begins_before_or_within_or_after_the_plan(begin):
    """Samples count from the run's beginning; a goal given before the plan's start waits for it."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.4, goal_derivatives=0, offset=0.15)
    t = begin + np.linspace(0.0, 15.0, 301)
    found = cp.simulate(replanner, t, 1.5)
    fits = np.flatnonzero(np.diff(state_of(found, "fits"))) + 1
    instants = begin + 0.15 + 0.4 * np.arange(40)
    first = instants[(instants >= 0.0) & (instants <= 8.0)][:1]
    assert np.abs(t[fits] - first).max(initial=0.0) <= 1e-9
    assert fits.size == first.size
    if first.size:
        peer = BPoly.from_derivatives([first[0], 10.0], [PLAN.jet(first[0], 2)[:, 0], [1.5, 0, 0]])
        inside = (t >= first[0] - 1e-9) & (t <= 10.0)
        assert np.abs(found.outputs[0, inside] - peer(t[inside])).max() <= 1e-10
        assert np.abs(found.outputs[0, t < first[0] - 1e-9] - PLAN(t[t < first[0] - 1e-9])).max() <= 1e-12
        assert found.events == []
    else:  # too late for it
        assert np.abs(found.outputs[0] - PLAN(t)).max() <= 1e-12
        assert happened(found, MISSED) == [(round(begin + 0.15, 9), "above")]


def test_a_plant_is_not_brought_onto_a_plan_that_has_not_begun():
    """Shrinking waits for the start; a fixed horizon does not."""
    late = PLAN.shift(5.0)
    for horizon, count in (("shrinking", 0), (2.0, 4)):
        replanner = cp.create_replanner_iosystem(late, 0.5, horizon=horizon, measured=0, suffix="_r")
        core = replanner.syslist[1]
        x = np.zeros(core.nstates)
        for t in (0.0, 0.5, 1.0, 1.5):
            x = core.sample(t, x, signals(late, replanner, t, off=0.2), {})
        assert x[4] == count
    replanner = cp.create_replanner_iosystem(late, 0.5, measured=0, suffix="_r")
    core = replanner.syslist[1]
    assert core.sample(5.0, np.zeros(core.nstates), signals(late, replanner, 5.0, off=0.2), {})[4] == 1


def test_names_of_what_comes_in_and_goes_out():
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=["x", "y", "z"])
    replanner = cp.create_replanner_iosystem(
        plan, 0.5, measured=1, goal_derivatives=1, derivatives=1, suffix="_ref", name="planner"
    )
    assert replanner.name == "planner"
    assert replanner.output_labels == ["x_ref", "x_ref_d1", "y_ref", "y_ref_d1", "z_ref", "z_ref_d1"]
    assert replanner.input_labels == [
        "x_goal", "x_goal_d1", "y_goal", "y_goal_d1", "z_goal", "z_goal_d1", "x", "x_d1", "y", "y_d1", "z", "z_d1"
    ]  # fmt: skip
    plain = cp.create_replanner_iosystem(plan, 0.5, order=1)
    assert (plain.ninputs, plain.output_labels) == (0, ["x", "x_d1", "y", "y_d1", "z", "z_d1"])
    assert cp.create_replanner_iosystem(cp.PolySpline(REST), 0.5).output_labels == ["y", "y_d1", "y_d2"]


def test_three_axes_each_to_its_goal():
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=["x", "y", "z"])
    replanner = cp.create_replanner_iosystem(plan, 0.5, goal_derivatives=0)
    found = cp.simulate(
        replanner, np.linspace(0, 11, 23), {"x_goal": 1.0, "y_goal": -1.0, "z_goal": cp.Step(5.0, 3.0, 4.2)}
    )
    assert np.abs(found.outputs[:, -1] - [1, 0, 0, -1, 0, 0, 5, 0, 0]).max() <= 1e-9
    for row, begin, first, to in ((3, 0.0, np.zeros(3), -1.0), (6, 4.5, plan.jet(4.5, 2)[:, 2], 5.0)):
        peer = BPoly.from_derivatives([begin, 10.0], [first, [to, 0, 0]])
        later = (found.time >= begin) & (found.time <= 10.0)
        assert np.abs(found.outputs[row, later] - peer(found.time[later])).max() <= 1e-10
    assert np.abs(found.outputs[0] - plan(found.time)[0]).max() <= 1e-10


@pytest.mark.parametrize("suffix", ["_planned", "_planned_", "_goal_planned"])
def test_no_suffix_meets_a_name_inside(suffix):
    t = np.linspace(0, 10, 11)
    found = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, suffix=suffix, goal_derivatives=0), t, 1.0)
    assert np.abs(found.outputs - PLAN.jet(t, 2)[:, 0]).max() <= 1e-10


def test_no_label_meets_a_name_inside():
    labels = ["x", "x_planned", "x_goal"]
    plan = cp.PolySpline([Waypoint(0, [0, 0, 0], 0, 0), Waypoint(10, [1, 2, 3], 0, 0)], labels=labels)
    t = np.linspace(0, 10, 11)
    found = cp.simulate(cp.create_replanner_iosystem(plan, 0.5, order=0), t)
    assert np.abs(found.outputs - plan(t)).max() <= 1e-10


def test_joined_to_a_plant_by_names():
    """The reference goes to the plant, its position back, and nothing warns; the goal is met after a push."""
    replanner = cp.create_replanner_iosystem(PLAN, 0.1, measured=0, goal_derivatives=0, derivatives=1, suffix="_r")
    plant = ct.ss(
        [[0, 1], [-25, -10]],
        [[0, 0, 0], [25, 10, 1]],
        [[1, 0]],
        0,
        inputs=["x_r", "x_r_d1", "push"],
        outputs="x",
        name="plant",
    )
    loop = ct.interconnect([replanner, plant], inputs=["x_goal", "push"], outputs=["x", "x_r", "x_r_d1"], name="loop")
    t = np.linspace(0.0, 15.0, 151)
    found = cp.simulate(loop, t, {"x_goal": cp.Step(1.4, 1.0, 5.0), "push": cp.Step(0, 2.0, 2.0)})
    assert found.method == "compiled"
    assert abs(found.outputs[0, -1] - 1.4) <= 2e-3
    nested = ct.interconnect([loop], inputs=["x_goal", "push"], outputs=["x", "x_r", "x_r_d1"], name="nested")
    again = cp.simulate(nested, t, {"x_goal": cp.Step(1.4, 1.0, 5.0), "push": cp.Step(0, 2.0, 2.0)})
    assert np.abs(again.outputs[0] - found.outputs[0]).max() <= 1e-7


def test_two_replanners_in_one_loop():
    """Each its own clock, axis and name."""
    blocks = [
        cp.create_replanner_iosystem(cp.PolySpline(REST, labels=["a"]), 0.5, order=1, goal_derivatives=0, name="first"),
        cp.create_replanner_iosystem(
            cp.TrigSpline(REST, alpha=2.0, labels=["b"]), 0.3, order=1, goal_derivatives=0, name="second"
        ),
    ]
    loop = ct.interconnect(blocks, inputs=["a_goal", "b_goal"], outputs=["a", "a_d1", "b", "b_d1"])
    t = np.linspace(0, 11, 111)
    found = cp.simulate(loop, t, {"a_goal": 2.0, "b_goal": cp.Step(0.0, 1.0, 3.1)})
    assert np.abs(found.outputs[:, -1] - [2, 0, 0, 0]).max() <= 1e-9
    alone = cp.simulate(blocks[1], t, cp.Step(0.0, 1.0, 3.1))
    assert np.abs(found.outputs[2:] - alone.outputs).max() <= 1e-10
    late = cp.simulate(loop, t, {"a_goal": cp.Step(2.0, 1.0, 9.8), "b_goal": 1.0})
    assert [e.name for e in late.events] == [MISSED.replace("replanner", "first")]


def test_python_controls_own_simulation_is_refused():
    replanner = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0)
    with pytest.raises(RuntimeError, match=r"plans again every period, must be run by ctrlplan\.simulate"):
        ct.input_output_response(replanner, np.linspace(0, 10, 11), np.ones(11))


def test_a_run_can_be_made_again():
    """Nothing is kept from one run to the next."""
    replanner, t = cp.create_replanner_iosystem(PLAN, 0.5, goal_derivatives=0), np.linspace(0, 11, 23)
    first = cp.simulate(replanner, t, cp.Step(2.0, 1.0, 3.0))
    cp.simulate(replanner, t, -5.0)
    assert np.array_equal(cp.simulate(replanner, t, cp.Step(2.0, 1.0, 3.0)).outputs, first.outputs)


def test_jets_above_the_order_are_put_out_too():
    """derivatives above and below `order`: the plan's own where nothing was fitted."""
    t = np.linspace(0.0, 9.99, 31)
    many = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, order=1, derivatives=4), t)
    assert np.abs(many.outputs - PLAN.jet(t, 4)[:, 0]).max() <= 1e-12
    few = cp.simulate(cp.create_replanner_iosystem(PLAN, 0.5, order=3, derivatives=0, goal_derivatives=0), t, 1.5)
    peer = BPoly.from_derivatives([0.0, 10.0], [[0] * 4, [0.5, 0, 0, 0]])
    assert np.abs(np.ravel(few.outputs) - PLAN(t) - peer(t)).max() <= 1e-10


def test_a_fit_some_periods_after_the_last_one_begins_where_the_reference_is_by_then():
    """Fixed horizon, new goals only: three periods between two fits."""
    replanner = cp.create_replanner_iosystem(
        cp.Step(0.0, 0.0, labels=["x"]), 0.25, horizon=2.0, goal_derivatives=0, trigger="goal"
    )
    t = np.linspace(0.0, 6.0, 61)
    found = cp.simulate(replanner, t, steps((2.0, 1.0), (2.75, -1.0), initial=0.0))
    first = BPoly.from_derivatives([2.0, 4.0], [[0, 0, 0], [1, 0, 0]])
    jet = [first.derivative(k)(2.75) if k else first(2.75) for k in range(3)]
    second = BPoly.from_derivatives([2.75, 4.75], [jet, [-1, 0, 0]])
    early, late = (t >= 2.0) & (t < 2.75), (t >= 2.75) & (t <= 4.75)
    assert np.abs(found.outputs[0, early] - first(t[early])).max() <= 1e-12
    assert np.abs(found.outputs[0, late] - second(t[late])).max() <= 1e-12
    assert np.abs(found.outputs[0, t > 4.75] + 1.0).max() <= 1e-12


IN_MOTION = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(7.3, 5, 1.0, 0)], labels=["x"])


def random_times():
    """Of which t + (7.3 - t) is not always 7.3."""
    times = np.random.default_rng(0).uniform(0.0, 6.0, 200)
    assert (times + (7.3 - times) < 7.3).sum() > 5
    return times.tolist()


def test_a_plan_that_ends_in_motion_meets_its_goal_at_every_fit_time():
    """At the very end, where the correction's end and the plan's are one but for rounding."""
    replanner = cp.create_replanner_iosystem(IN_MOTION, 0.1, goal_derivatives=1)
    core = replanner.syslist[1]
    for t in random_times():
        aim = [[5.5 - 0.8 * (7.3 - t)], [0.8]]
        x = core.sample(t, np.zeros(core.nstates), signals(IN_MOTION, replanner, t, goal=aim), {})
        assert x[4] == 1
        assert np.abs(put_out(IN_MOTION, replanner, 7.3, x) - [5.5, 0.8, 0.0]).max() <= 1e-9


def test_limits_do_not_count_the_arrival_twice():
    """A goal 1 cm off, with a fifth of the peak speed to spare, is taken at every time."""
    limit = 1.2 * float(IN_MOTION.peak(1)[0])
    replanner = cp.create_replanner_iosystem(IN_MOTION, 0.1, goal_derivatives=1, limits={1: limit})
    core = replanner.syslist[1]
    refused = 0
    for t in random_times():
        aim = [[5.01 - (7.3 - t)], [1.0]]
        added = BPoly.from_derivatives([t, 7.3], [[0, 0, 0], [0.01, 0, 0]])
        s = np.linspace(t, 7.3, 99)
        assert np.abs(IN_MOTION(s, 1) + added.derivative()(s)).max() < limit
        refused += core.sample(t, np.zeros(core.nstates), signals(IN_MOTION, replanner, t, goal=aim), {})[3]
    assert refused == 0
