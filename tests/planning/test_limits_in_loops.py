"""Limits on signals of loops: names, kinds, and simulated responses against exact ones and naive stepping."""

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan import Limits, Region, Waypoint, fastest, margins

MOVE = cp.PolySpline([Waypoint(0.5, 1, 0, 0), Waypoint(1.5, 3, 0, 0)])
A = np.array([[0.0, 1.0], [-40.0, -5.0]])
B = np.array([[0.0, 0.0], [40.0, 3.0]])
C = np.array([[1.0, 0.0], [-12.0, -2.0]])
D = np.array([[0.0, 0.0], [12.0, 1.0]])
"""A servo with the reference r and its derivative; outputs y and u."""

LINEAR = ct.ss(A, B, C, D, inputs=["r", "r_d1"], outputs=["y", "u"], name="servo")
WRITTEN = ct.nlsys(
    lambda t, x, u, params: A @ x + B @ u,
    lambda t, x, u, params: C @ x + D @ u,
    inputs=["r", "r_d1"], outputs=["y", "u"], states=2, name="servo",
)  # fmt: skip
"""The same servo as functions."""

TRACK = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])


def only(found):
    (row,) = found
    return row


def by_name(found):
    return {row.bound.name: row for row in found}


def dense(plan, count=300_001, tail=2.0):
    """Times and signals of the servo by a fine simulation."""
    t = np.linspace(plan.start, plan.end + tail, count)
    rest = np.linalg.solve(A, -B @ [plan.initial[0], 0.0])
    response = cp.simulate(LINEAR, t, {"r": plan, "r_d1": plan(t, 1)}, rest)
    return t, dict(zip(["y", "u"], response.y[:, :].reshape(2, -1), strict=True))


# Names


@pytest.mark.slow
def test_a_name_is_that_of_the_loop():
    """The default label y of the plan is never meant: y of the loop oscillates beyond the plan."""
    t, signals = dense(MOVE)
    row = only(margins(MOVE, {"y": (0.0, 4.0)}, LINEAR))
    assert row.bound.in_loop
    assert row.value == pytest.approx(signals["y"].max(), rel=1e-8)
    assert row.time == pytest.approx(t[signals["y"].argmax()], abs=1e-4)
    assert only(margins(MOVE, {"plan": {"y": (0.0, 4.0)}}, LINEAR)).value == pytest.approx(3.0, rel=1e-14)
    assert only(margins(MOVE, {"y_d1": 4.0}, LINEAR)).value == pytest.approx(3.75, rel=1e-12)
    assert by_name(margins(MOVE, {"velocity": 4.0, "r": 4.0}, LINEAR)).keys() == {"y_d1", "r"}


def test_a_label_that_is_another_signal_of_the_loop_must_be_told():
    named = cp.PolySpline(MOVE.waypoints, labels=["u"])
    with pytest.raises(
        ValueError, match=r"limits must say whose signal u is.*\{\"plan\": \{...\}, \"loop\": \{...\}\}"
    ):
        margins(named, {"u": 5.0}, LINEAR)
    found = margins(named, {"plan": {"u": 5.0}, "loop": {"u": 10.0, "y": 4.0}}, LINEAR)
    assert sorted(row.bound.in_loop for row in found) == [False, True, True]
    derivative = cp.PolySpline(MOVE.waypoints, labels=["r"])
    assert only(margins(derivative, {"r": 4.0}, LINEAR)).value == pytest.approx(3.0, rel=1e-12)
    assert only(margins(derivative, {"r_d1": 4.0}, LINEAR)).value == pytest.approx(3.75, rel=1e-9)


def test_a_default_label_is_never_meant():
    unnamed = ct.tf([25.0], [1.0, 5.0, 25.0])
    with pytest.raises(
        ValueError, match=r"signals of the loop \(y\[0\], u\[0\]\), .* got 'y'; for the axis of the plan"
    ):
        margins(MOVE, {"y": 4.0}, unnamed)
    assert len(margins(MOVE, {"plan": {"y": 4.0}, "loop": {"y[0]": 4.0}}, unnamed)) == 2
    assert margins(MOVE, {"y_d1": 4.0, "y[0]": 4.0}, unnamed).satisfied


def test_inputs_in_another_order_than_the_labels():
    loop = ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), inputs=["a", "b"], outputs=["p", "q"])
    pair = [Waypoint(0, [0, 0], 0, 0), Waypoint(1, [1, 2], 0, 0)]
    crossed = cp.PolySpline(pair, labels=["b", "c"])
    with pytest.raises(ValueError, match="limits must say whose signal b is"):
        margins(crossed, {"b": 3.0}, loop)
    assert margins(cp.PolySpline(pair, labels=["b", "a"]), {"b": 3.0}, loop).satisfied


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"torque": 1.0}, r"signals of the loop \(y, u, r, r_d1\), derivatives of an axis .* got 'torque'"),
        ({"loop": {"velocity": 1.0}}, r"limits must name signals of the loop \(y, u, r, r_d1\), got 'velocity'"),
        ({"motor": Region(("u", "w"), [(0, 0), (1, 0), (0, 1)])}, "got 'w'"),
        ({"plan": {"y": 4.0}, "u": 1.0}, "limits must be by name, or"),
        ({"u": (2.0, 1.0)}, "limits of u must increase"),
        ({"u": (math.nan, 1.0)}, "must be a number, got nan"),
        ({"u": Limits(high=lambda t: t)}, "a signal of a loop, must be numbers, or values at times by along="),
        ({"u": Limits(rms=1.0, period=0.5)}, "period of RMS of u must be at least the duration of the plan"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("loop", [LINEAR, WRITTEN], ids=["exact", "simulated"])
def test_limits_that_do_not_fit_the_loop(loop, limits, message):
    with pytest.raises(ValueError, match=message):
        margins(MOVE, limits, loop)


def test_limits_of_a_loop_without_one():
    with pytest.raises(ValueError, match='limits of "loop" must be given with a loop as system'):
        margins(MOVE, {"loop": {"u": 1.0}})
    with pytest.raises(TypeError, match="limits of loop must be a mapping"):
        margins(MOVE, {"plan": {"y": 4.0}, "loop": 3.0}, LINEAR)


def test_a_time_law_is_not_found_under_limits_of_a_loop():
    with pytest.raises(ValueError, match='limits with hold="path" must be local in time, got those of u'):
        fastest(MOVE, {"u": 10.0}, LINEAR, hold="path")


# Kinds


KINDS = {
    "y": Limits(0.9, 3.2),
    "u": Limits(-9.0, 9.0, rate=(-200.0, 150.0), rms=6.0),
    "motor": Region(("y", "u"), [(0.8, -9.0), (3.5, -10.0), (3.5, 5.0), (0.8, 12.0)]),
}


@pytest.mark.slow
@pytest.mark.parametrize("loop", [LINEAR, WRITTEN], ids=["exact", "simulated"])
def test_every_kind_against_dense_samples(loop):
    t, signals = dense(MOVE)
    y, u = signals["y"], signals["u"]
    found = by_name(margins(MOVE, KINDS, loop, tail=2.0))
    assert found["y"].value == pytest.approx(y.max(), abs=1e-6 * np.ptp(y))
    assert found["u"].value == pytest.approx(u[np.abs(u).argmax()], abs=1e-6 * np.ptp(u))
    rate = np.gradient(u, t)[2:-2]
    worst = rate[np.maximum(rate - 150.0, -200.0 - rate).argmax()]
    assert found["rate of u"].value == pytest.approx(worst, abs=1e-4 * np.ptp(rate))
    during = t <= MOVE.end
    assert found["RMS of u"].value == pytest.approx(math.sqrt(np.mean(u[during] ** 2)), rel=1e-4)
    edges = [row for name, row in found.items() if name.startswith("motor")]
    assert len(edges) == 4
    dx, dy = 2.7, 7.0  # the edge from (3.5, 5) to (0.8, 12)
    slope = dy / dx
    edge = next(row for row in edges if row.bound.name == f"motor: u + {slope:.4g} y")
    assert edge.value == pytest.approx((u + slope * y).max(), abs=1e-6 * np.ptp(u + slope * y))


@pytest.mark.slow
@pytest.mark.parametrize("loop", [LINEAR, WRITTEN], ids=["exact", "simulated"])
def test_an_interval_and_a_table(loop):
    t, signals = dense(MOVE)
    inside = (t >= 0.7) & (t <= 1.1)
    row = only(margins(MOVE, {"u": Limits(-20.0, 12.0, during=(0.7, 1.1))}, loop))
    assert row.value == pytest.approx(signals["u"][inside].max(), rel=1e-6)
    times, high = [0.6, 1.0, 1.4, 2.5], [4.0, 11.0, 8.0, 7.0]
    over = (t >= 0.6 - 1e-9) & (t <= 2.5 + 1e-9)
    gap = np.interp(t[over], times, high) - signals["u"][over]
    table = only(margins(MOVE, {"u": Limits(high=high, along=times)}, loop))
    assert table.fraction * table.bound.scale == pytest.approx(gap.min(), abs=1e-5)
    assert table.time == pytest.approx(t[over][gap.argmin()], abs=1e-3)
    assert table.bound.high == pytest.approx(np.interp(table.time, times, high), rel=1e-6)


@pytest.mark.parametrize(("w", "zeta"), [(3.5, 0.01), (38.3, 0.02), (77.1, 0.005), (156.8, 0.9)])
def test_simulated_extremes_of_oscillating_loops(w, zeta):
    """Values to 1e-8 of their range, where 1e-6 is stated, and rates to 1e-7."""
    a, b = np.array([[0, 1], [-w * w, -2 * zeta * w]]), np.array([[0, 0], [w * w, zeta * w]])
    c, d = np.array([[1, 0], [-5.0, -0.1]]), np.array([[0, 0], [5.0, 0.2]])
    names = {"inputs": ["r", "r_d1"], "outputs": ["y", "u"]}
    written = ct.nlsys(lambda t, x, u, p: a @ x + b @ u, lambda t, x, u, p: c @ x + d @ u, states=2, **names)
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(0.4, 0.3), Waypoint(1, 1, 0, 0)])
    exact = cp.loop_quantities(ct.ss(a, b, c, d, **names)).quantities_of(plan)
    simulated = cp.loop_quantities(written, tail=1.0).quantities_of(plan)
    for name in ("y", "u"):
        for rate, error in ((False, 1e-8), (True, 1e-7)):
            own, other = (r.extremes({name: 1.0}, during=(0.0, 2.0), rate=rate) for r in (exact, simulated))
            assert max(abs(own.low - other.low), abs(own.high - other.high)) <= error * (own.high - own.low)
        assert simulated.rms(name) == pytest.approx(exact.rms(name), rel=1e-8)


@pytest.mark.slow
def test_the_dwell_counts_in_a_loop():
    signals = dense(MOVE, tail=3.0)[1]
    exact, simulated = (
        only(margins(MOVE, {"y": Limits(rms=5.0, period=4.0)}, loop, tail=3.0)).value for loop in (LINEAR, WRITTEN)
    )
    assert exact == pytest.approx(math.sqrt(np.mean(signals["y"] ** 2)), rel=1e-4)
    assert simulated == pytest.approx(exact, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["shape", pytest.param("waypoints", marks=pytest.mark.slow)])
def test_the_fastest_move_keeps_every_kind(hold):
    limits = {
        "u": Limits(-40.0, 40.0, rate=2500.0),
        "y": Limits(0.9, 3.3),
        "motor": Region(("y", "u"), [(0.0, -60.0), (4.0, -60.0), (4.0, 10.0), (0.0, 60.0)]),
    }
    exact = fastest(MOVE, limits, LINEAR, hold=hold)
    signals = dense(exact.plan)[1]
    assert signals["u"].max() <= 40.0 * (1 + 1e-9)
    assert signals["y"].max() <= 3.3 * (1 + 1e-9)
    assert (signals["u"] + 12.5 * signals["y"]).max() <= 60.0 * (1 + 1e-9)
    shorter = dense(exact.plan.retime(0.995 * exact.duration))[1]
    beyond = [shorter["u"].max() - 40.0, shorter["y"].max() - 3.3, (shorter["u"] + 12.5 * shorter["y"]).max() - 60.0]
    assert max(beyond) > 0.0
    simulated = fastest(MOVE, limits, WRITTEN, hold=hold, durations=(0.9 * exact.duration, 1.1 * exact.duration))
    assert simulated.duration == pytest.approx(exact.duration, rel=1e-5)
    assert simulated.active.bound.name == exact.active.bound.name
    assert "simulated at tolerance 1e-10, over the move and a tail as long as the plan" in str(simulated)
    assert simulated.margins.note.startswith("simulated")
    assert exact.margins.note == "exact, at all times"


def test_a_cyclic_plan_is_in_its_periodic_steady_state():
    """The response of the servo to each harmonic, by its transfer function from r with the derivative."""
    points = [Waypoint(0, 0), Waypoint(0.5, 1), Waypoint(1.0, 0), Waypoint(1.5, -1)]
    cycle = cp.TrigSpline.cyclic(points, 2.0)
    t = np.linspace(0, 2, 4000, endpoint=False)
    bins = np.fft.rfft(cycle(t)) / t.size
    s = 2j * np.pi * np.arange(bins.size) / 2.0
    gain = np.array([C[1] @ np.linalg.solve(z * np.eye(2) - A, B @ [1.0, z]) + D[1] @ [1.0, z] for z in s[:200]])
    power = np.abs(gain * bins[:200]) ** 2
    expected = math.sqrt(power[0] + 2.0 * power[1:].sum())
    for loop in (LINEAR, WRITTEN):
        assert only(margins(cycle, {"u": Limits(rms=50.0)}, loop)).value == pytest.approx(expected, rel=1e-5)


# Sampled loops


def sampled_loop(dt):
    """P controller with velocity feedforward, sampled, and a lag with an integrator."""
    plant = ct.ss([[0, 1], [0, -2.0]], [[0], [2.0]], [[1, 0]], [[0]], inputs="u", outputs="y", name="plant")
    law = ct.ss([], [], [], [[8.0, -8.0, 1.0]], dt, inputs=["r", "y", "r_d1"], outputs="u", name="law")
    return ct.interconnect([plant, cp.sample_hold(law, dt)], inputs=["r", "r_d1"], outputs=["y", "u"], name="loop")


def stepped(plan, dt, until, fine=64):
    """Output at `fine` times per sample, and the held input, by the plant's matrix exponential."""
    a, b = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([0.0, 2.0])
    augmented = np.zeros((3, 3))
    augmented[:2, :2], augmented[:2, 2] = a, b
    step = expm(augmented * dt / fine)
    x, outputs, held = np.array([plan.initial[0], 0.0]), [], []
    for k in range(round(until / dt)):
        t = plan.start + k * dt
        u = 8.0 * (float(plan(t)) - x[0]) + float(plan(t, 1))
        held.append(u)
        for _ in range(fine):
            x = (step @ np.append(x, u))[:2]
            outputs.append(x[0])
    return np.array(outputs), np.array(held)


def test_a_sampled_loop_against_naive_stepping():
    dt = 0.05
    y, u = stepped(TRACK, dt, 3.0)
    limits = {"y": (-0.1, 1.5), "u": Limits(-9.0, 9.0, rate=100.0, rms=4.0)}
    found = by_name(margins(TRACK, limits, sampled_loop(dt), tail=2.0))
    assert found["y"].value == pytest.approx(y.max(), abs=1e-5)
    assert found["u"].value == pytest.approx(u[np.abs(u).argmax()], abs=1e-7)
    assert abs(found["rate of u"].value) == pytest.approx(np.abs(np.diff(u)).max() / dt, rel=1e-6)
    assert found["RMS of u"].value == pytest.approx(math.sqrt(np.mean(u[:20] ** 2)), rel=1e-6)


@pytest.mark.slow
def test_the_fastest_move_of_a_sampled_loop():
    dt = 0.05
    found = fastest(TRACK, {"u": 3.0, "y": (-0.1, 1.3)}, sampled_loop(dt), durations=(0.5, 3.0), tail=2.0)
    y, u = stepped(found.plan, dt, found.duration + 2.0)
    assert u.max() == pytest.approx(3.0, abs=1e-5) or y.max() == pytest.approx(1.3, abs=1e-4)
    assert np.abs(u).max() <= 3.0 + 1e-6
    assert y.max() <= 1.3 + 1e-5


def test_a_plan_shorter_than_the_sampling_period_is_a_step():
    """Samples see the start and the end of the plan only, whatever happens between them."""
    dt = 0.2
    shape = cp.TrigSpline(
        [Waypoint(0, 0, 0, 0, 0), Waypoint(1, 1), Waypoint(2, 0.5), Waypoint(3, 1, 0, 0, 0)], alpha=4.0
    )
    held, outputs, x = 0.0, [], np.zeros(2)
    step = expm(np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 2.0], [0.0, 0.0, 0.0]]) * dt / 64)
    for k in range(20):
        held = 8.0 * (float(k > 0) - x[0])
        for _ in range(64):
            x = (step @ np.append(x, held))[:2]
            outputs.append(x[0])
    for duration in (0.19, 0.02, 1e-3, 1e-5):
        row = only(margins(shape.retime(duration), {"y": (None, 3.0)}, sampled_loop(dt)))
        assert row.value == pytest.approx(max(outputs), abs=1e-4)
    with pytest.raises(ValueError, match=r"a plan of .* s satisfies all of them; pass durations="):
        fastest(TRACK, {"u": 1e3}, sampled_loop(dt))


def test_short_plans_into_the_continuous_part_of_a_sampled_loop():
    """An acceleration feedforward that is not sampled: a double integrator follows, whatever the sampling period."""
    plant = ct.ss([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0]], 0, inputs=["u", "r_d2"], outputs="y", name="plant")
    law = ct.ss([[0.0]], [[1.0, -1.0]], [[-1.0]], [[1.5, -1.5]], 0.2, inputs=["r", "y"], outputs="u", name="law")
    loop = ct.interconnect([plant, cp.sample_hold(law, 0.2)], inputs=["r", "r_d2"], outputs=["y", "u"], name="loop")
    for duration in (1.0, 0.05, 1e-3):
        found = by_name(margins(TRACK.retime(duration), {"y": (None, 1.5), "u": 1.0}, loop))
        assert found["y"].value == pytest.approx(1.0, abs=1e-9)
        assert found["u"].value == pytest.approx(0.0, abs=1e-9)


def test_a_discrete_loop_is_evaluated_at_its_samples():
    """y[k+1] = 0.7 y[k] + 0.3 r[k]."""
    loop = ct.ss([[0.7]], [[0.3]], [[1.0], [-1.0]], [[0.0], [1.0]], 0.1, inputs="r", outputs=["y", "e"], name="lag")
    y, values = 0.0, []
    for k in range(31):
        values.append(float(TRACK(0.1 * k)) - y)
        y = 0.7 * y + 0.3 * float(TRACK(0.1 * k))
    row, rate = (
        by_name(margins(TRACK, {"e": Limits(-1.0, 1.0, rate=2.0)}, loop, tail=2.0))[n] for n in ("e", "rate of e")
    )
    assert row.value == pytest.approx(max(values), abs=1e-9)
    steps = np.diff(values) / 0.1
    assert abs(rate.value) == pytest.approx(np.abs(steps).max(), abs=1e-7)


@pytest.mark.parametrize(
    ("poles", "message"),
    [
        ([1.1, 0.5], r"pole at 1\.1 outside of the unit circle"),
        ([0.9 + 0.9j, 0.9 - 0.9j], r"pole at 0\.9 ± 0\.9j outside of the unit circle"),
        ([-1.01, 0.2], r"pole at -1\.01 outside of the unit circle"),
    ],
)
def test_an_unstable_discrete_loop_is_rejected_as_a_continuous_one(poles, message):
    den = np.poly(poles).real
    loop = ct.ss(ct.tf([den.sum()], den, 0.1), inputs="r", outputs="y")
    for function in (margins, fastest):
        with pytest.raises(ValueError, match=message):
            function(TRACK, {"y": 5.0}, loop)


def test_discrete_integrators_are_no_unstable_poles():
    """Three integrators, whose poles rounding moves by the cube root of its size."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    a, b, c = turn @ (np.eye(3) + np.eye(3, k=1)) @ turn.T, turn @ [[0.0], [0.0], [1.0]], [[1.0, 0.0, 0.0]] @ turn.T
    chain = ct.ss(a, b, c, 0, 0.1, inputs="r", outputs="y")
    assert np.abs(np.linalg.eigvals(chain.A)).max() > 1.0 + 1e-9
    assert margins(TRACK, {"y": (-1e6, 1e6)}, chain).satisfied


@pytest.mark.parametrize(
    "limit", [Limits(-1.0, 2.0, during=(0.0, 0.5)), Limits([-1.0, -1.0], [2.0, 2.0], along=[0.0, 0.5])]
)
@pytest.mark.parametrize("dt", [0, 0.1])
def test_an_interval_before_the_plan_is_rejected(limit, dt):
    late = cp.PolySpline([Waypoint(100.0, 0.0, 0.0, 0.0), Waypoint(101.0, 1.0, 0.0, 0.0)], labels=["r"])
    lag = ct.ss([[0.0 if dt else -1.0]], [[1.0]], [[1.0]], 0, dt, inputs="r", outputs="y", name="lag")
    with pytest.raises(ValueError, match=r"y must apply after the start of the plan at 100 s, got .* to 0\.5 s"):
        margins(late, {"y": limit}, lag)


def test_a_region_of_the_loop_and_the_plan_is_rejected():
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="r", outputs="y", name="lag")
    plan = cp.PolySpline([Waypoint(0.0, 0.0, 0.0, 0.0), Waypoint(1.0, 1.0, 0.0, 0.0)], labels=["r"])
    corners = [(2.0, 0.0), (0.0, 3.0), (-2.0, 0.0), (0.0, -3.0)]
    with pytest.raises(ValueError, match=r"region motor must .*, got y of the loop and r_d1 of the plan"):
        margins(plan, {"motor": Region(("y", "r_d1"), corners)}, lag)


# Nonlinear loops


def pendulum_loop():
    """A pendulum under computed torque with an error in its mass."""

    def rates(t, x, u, params):
        torque = 1.2 * (20.0 * (u[0] - x[0]) + 8.0 * (u[1] - x[1])) + 9.0 * np.sin(x[0])
        return np.array([x[1], torque - 10.0 * np.sin(x[0])])

    def outputs(t, x, u, params):
        return np.array([x[0], 1.2 * (20.0 * (u[0] - x[0]) + 8.0 * (u[1] - x[1])) + 9.0 * np.sin(x[0])])

    return ct.nlsys(rates, outputs, inputs=["r", "r_d1"], outputs=["angle", "torque"], states=2, name="pendulum")


def test_a_nonlinear_loop_starts_at_rest_and_is_simulated_over_its_tail():
    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

    plan = cp.PolySpline([Waypoint(0, 0.4, 0, 0), Waypoint(1, 1.4, 0, 0)])
    loop = pendulum_loop()

    def equal(q):
        return 24.0 * (0.4 - q) - np.sin(q)

    start = brentq(equal, 0.0, 1.0, xtol=1e-15)

    def rates(t, x):
        at = min(t, 1.0)
        torque = 1.2 * (20.0 * (float(plan(at)) - x[0]) + 8.0 * ((float(plan(at, 1)) if t < 1.0 else 0.0) - x[1]))
        return [x[1], torque + 9.0 * np.sin(x[0]) - 10.0 * np.sin(x[0])]

    first = solve_ivp(rates, (0, 1), [start, 0.0], rtol=1e-11, atol=1e-13, dense_output=True, method="DOP853")
    then = solve_ivp(rates, (1, 2), first.y[:, -1], rtol=1e-11, atol=1e-13, dense_output=True, method="DOP853")
    t = np.linspace(0, 2, 100_001)
    x = np.where(t < 1.0, first.sol(np.minimum(t, 1.0)), then.sol(np.maximum(t, 1.0)))
    r, r1 = plan(t), np.where(t < 1.0, plan(t, 1), 0.0)
    torque = 1.2 * (20.0 * (r - x[0]) + 8.0 * (r1 - x[1])) + 9.0 * np.sin(x[0])
    found = by_name(margins(plan, {"torque": (-30.0, 30.0), "angle": (0.0, 2.0)}, loop))
    assert found["torque"].value == pytest.approx(torque.max(), abs=1e-6 * np.ptp(torque))
    low, high = x[0].min(), x[0].max()
    assert found["angle"].value == pytest.approx(low if low < 2.0 - high else high, abs=1e-6 * (high - low))


@pytest.mark.slow
def test_limits_violated_in_steady_state_or_at_the_start():
    plan = cp.PolySpline([Waypoint(0, 0.4, 0, 0), Waypoint(1, 1.4, 0, 0)])
    with pytest.raises(ValueError, match="limits must be satisfied in steady state, at any duration, got torque = "):
        fastest(plan, {"torque": 9.0}, pendulum_loop())
    with pytest.raises(ValueError, match="limits must be satisfied at the start, at any duration, got angle = "):
        fastest(plan, {"angle": (0.5, 3.0)}, pendulum_loop())
    with pytest.raises(ValueError, match="limits must be satisfied in steady state, at any duration, got y = 3 "):
        fastest(MOVE, {"y": (0.0, 2.0)}, LINEAR)


def test_a_rate_of_what_jumps_in_a_loop():
    steps = cp.PiecewiseSpline([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, 0)])
    for loop in (LINEAR, WRITTEN):
        with pytest.raises(ValueError, match="a signal with a limited rate must be continuous, got u that jumps"):
            margins(steps, {"u": Limits(rate=1.0)}, loop)
        assert margins(steps, {"u": 100.0}, loop).satisfied


def test_loops_without_a_known_start():
    open_loop = ct.nlsys(lambda t, x, u, p: np.array([1.0 + u[0] ** 2]), None, inputs=1, outputs=1, states=1)
    with pytest.raises(ValueError, match="the loop must be at rest at the first position of the plan"):
        margins(TRACK, {"y[0]": 1.0}, open_loop)


@pytest.mark.slow
def test_a_loop_that_diverges():
    runaway = ct.nlsys(
        lambda t, x, u, p: np.array([x[0] ** 3 + x[0] + u[0]]), None, inputs="r", outputs="y", states=1, name="runaway"
    )
    for search in ({}, {"durations": (0.9, 1.1)}):
        with pytest.raises(RuntimeError, match=r"the solver must reach .* the solution cannot be continued"):
            (fastest if search else margins)(TRACK, {"y": 3.0}, runaway, **search)


def test_a_tail_that_is_far_longer_than_the_plan():
    quick = MOVE.retime(1e-3)
    exact, simulated = (only(margins(quick, {"y": (0.0, 6.0)}, loop, tail=3.0)).value for loop in (LINEAR, WRITTEN))
    assert simulated == pytest.approx(exact, abs=3e-6)


def test_the_tail_is_checked():
    with pytest.raises(ValueError, match="tail must be finite and at least 0"):
        margins(TRACK, {"u": 1.0}, WRITTEN, tail=-1.0)
    with pytest.raises(ValueError, match=r"an interval of limits must begin before 2\.5 s, where the simulation ends"):
        margins(MOVE, {"u": Limits(high=1.0, during=(3.0, 4.0))}, WRITTEN)
    assert margins(MOVE, {"u": Limits(high=100.0, during=(3.0, 4.0))}, LINEAR).satisfied


def test_a_source_inside_the_loop_is_the_plan():
    source = cp.create_source_iosystem(TRACK, 1, labels="r")
    loop = ct.interconnect([source, WRITTEN], inputs=0, outputs=["y", "u"])
    inside = margins(TRACK, {"y": (-1, 2), "u": 30.0}, loop)
    fed = margins(TRACK, {"y": (-1, 2), "u": 30.0}, WRITTEN)
    for row in inside:
        assert row.fraction == pytest.approx(by_name(fed)[row.bound.name].fraction, abs=1e-7)
    with pytest.raises(ValueError, match="for other durations make the plan an input of the loop"):
        fastest(TRACK, {"u": 30.0}, loop)


@pytest.mark.slow
@pytest.mark.parametrize("loop", [LINEAR, WRITTEN], ids=["exact", "simulated"])
def test_a_figure_shows_the_signals_of_the_loop(loop):
    t, signals = dense(MOVE)
    limits = {"u": Limits(-9.0, 30.0, rate=400.0, rms=20.0), "y": (0.5, 4.0)}
    found = fastest(MOVE, limits, loop, durations=(0.99, 1.01)) if loop is LINEAR else None
    limited = cp.planning.limits.Limited(MOVE, limits, loop)
    times = np.linspace(MOVE.start, MOVE.end, 101)
    rows = dict(zip([b.name for b in limited.bounds], limited.shown(MOVE, times), strict=True))
    np.testing.assert_allclose(rows["u"], np.interp(times, t, signals["u"]), atol=1e-4)
    np.testing.assert_allclose(rows["y"], np.interp(times, t, signals["y"]), atol=1e-5)
    slope = np.interp(times, t, np.gradient(signals["u"], t))
    np.testing.assert_allclose(rows["rate of u"][1:-1], slope[1:-1], atol=1e-3 * np.ptp(slope))
    assert rows["RMS of u"][-1] == pytest.approx(math.sqrt(np.mean(signals["u"][t <= MOVE.end] ** 2)), rel=0.03)
    if found is not None:
        assert found.plot().axes.shape == (4, 1)


@pytest.mark.parametrize("end", [1.0, 1.05, 0.7])
def test_the_error_of_a_sampled_loop_by_its_recursion(end):
    """The plan breaks at sample instants, or not: the error contains the plan between them."""
    plan = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(end, 1, 0, 0)])
    plant = ct.ss(-1, 1, 1, 0, inputs="u", outputs="y", name="plant")
    gain = cp.sample_hold(ct.ss([], [], [], [[5.0]], 0.1, inputs="e", outputs="u", name="gain"), 0.1)
    junction = ct.summing_junction(["r", "-y"], "e", name="junction")
    loop = ct.interconnect([gain, plant, junction], inputs="r", outputs=["y", "u", "e"])
    fractions, y, errors = np.linspace(0.0, 0.1, 4001), 0.0, []
    for k in range(14):
        r = plan(np.minimum(0.1 * k + fractions, end))
        held = 5.0 * (r[0] - y)
        path = held + (y - held) * np.exp(-fractions)
        errors.append(np.abs(r - path).max())
        y = path[-1]
    found = only(margins(plan, {"e": 1.0}, loop))
    assert found.value == pytest.approx(max(errors), rel=1e-7)  # the grid of the recursion is 25 us
    assert fastest(plan, {"e": 0.2}, loop).margins.satisfied
