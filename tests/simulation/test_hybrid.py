"""Sampled blocks and delays in continuous loops, and discrete loops, compared with steps computed by hand."""

import functools
import math
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan.simulation import Event

METHODS = ("compiled", "python")
LINEAR = ("exact", *METHODS)
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
A = np.array([[-0.3, 1.0], [-2.0, -0.5]])
B = np.array([[0.2], [1.0]])
C = np.array([[1.0, 0.0]])
PLAN = cp.PolySpline([cp.Waypoint(0.33, 0, 0, 0), cp.Waypoint(1.47, 2, 0, 0)], labels=["r"])


def planned(t):
    s = min(max((t - 0.33) / 1.14, 0.0), 1.0)
    return 2 * s**3 * (10 - 15 * s + 6 * s * s)


def plant(**names):
    return ct.ss(A, B, C, 0, **({"inputs": "u", "outputs": "y", "name": "plant"} | names))


def held(x, u, h, a=A, b=B):
    """State of x' = a x + b u a time h later, the input held."""
    n, m = len(a), b.shape[1]
    change = expm(np.block([[a * h, b * h], [np.zeros((m, n + m))]]))
    return change[:n, :n] @ x + change[:n, n:] @ np.atleast_1d(u)


def walked(x, times, instants, sample):
    """States of the plant at the times; `sample(k, t, x)` gives the input that is held from instant k on."""
    out, marks = np.empty((x.size, times.size)), sorted({*instants, *times})
    u, index = np.zeros(B.shape[1]), {t: k for k, t in enumerate(instants)}
    for here, after in pairwise([*marks, marks[-1] + 1.0]):
        if here in index:
            u = sample(index[here], here, x)
        out[:, np.flatnonzero(times == here)] = x[:, None]
        x = held(x, u, after - here)
    return out


# Sampled blocks


@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("first", [0.0, 7.0])
@pytest.mark.parametrize("offset", [0.0, 0.13])
def test_a_sampled_controller(offset, first, method):
    """Two states, with feedthrough, on the error: samples of the plant by its matrix exponential."""
    f, g = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([[0.2, -0.2], [0.5, -0.5]])
    h, d = np.array([[1.0, -0.4]]), np.array([[0.8, -0.8]])
    law = ct.ss(f, g, h, d, 0.2, inputs=["r", "y"], outputs="u", states=["one", "two"], name="law")
    loop = ct.interconnect([plant(), cp.sample_hold(law, 0.2, offset)], inputs="r", outputs=["y", "u"])
    assert [label.split("_", 1)[1] for label in loop.state_labels[2:]] == ["one", "two", "u_held"]
    times = np.unique(np.concatenate([np.linspace(0.0, 2.0, 21), offset + 0.2 * np.arange(9)]))
    z = np.array([0.3, -0.2])
    controls = []

    def sample(k, t, x):
        nonlocal z
        w = np.array([planned(t), x[0]])
        u = h @ z + d @ w
        controls.append((t, u[0]))
        z = f @ z + g @ w
        return u

    states = walked(np.array([0.5, -1.0]), times, [offset + 0.2 * k for k in range(11)], sample)
    start = [0.5, -1.0, 0.3, -0.2, 0.0]
    found = cp.simulate(loop, first + times, PLAN.shift(first), start, method=method, **TIGHT)
    assert found.method == method
    assert np.abs(found.outputs[0] - states[0]).max() <= 1e-8
    assert np.abs(found.states[:2] - states).max() <= 1e-8
    at = np.array([t for t, _ in controls])
    applied = np.array([0.0] + [u for _, u in controls])[np.searchsorted(at, times + 1e-9)]
    assert np.abs(found.outputs[1] - applied).max() <= 1e-8


def test_at_its_samples_the_loop_is_that_of_the_peer():
    """The plant by control.sample_system, and the discrete loop by python-control."""
    law = ct.ss(0.6, [[0.5, -0.5]], 1.0, [[0.3, -0.3]], 0.1, inputs=["r", "y"], outputs="u", name="law")
    discrete = ct.sample_system(plant(), 0.1, "zoh", name="plant", copy_names=True)
    peer_loop = ct.interconnect([discrete, law], inputs="r", outputs="y")
    times = 0.1 * np.arange(31)
    peer = ct.input_output_response(peer_loop, times, PLAN(times), [0.2, 0.1, 0.4])
    loop = ct.interconnect([plant(), cp.sample_hold(law, 0.1)], inputs="r", outputs="y")
    for method in LINEAR:
        found = cp.simulate(loop, times, PLAN, [0.2, 0.1, 0.4, 0.0], method=method, **TIGHT)
        assert np.abs(found.outputs - peer.outputs).max() <= 1e-8


def gain(rows, source, sink, name):
    return ct.ss([], [], [], np.atleast_2d(rows), inputs=source, outputs=sink, name=name, dt=None)


@pytest.mark.parametrize("method", LINEAR)
def test_two_rates(method):
    """Position every 0.3 s, speed every 0.2 s, the second with an offset of 0.05 s."""
    b = np.array([[0.2, 0.0], [1.0, 1.0]])
    moved = ct.ss(A, b, np.eye(2), 0, inputs=["u", "w"], outputs=["y", "v"], name="plant")
    slow = cp.sample_hold(gain([2.0, -2.0], ["r", "y"], "u", "slow"), 0.3)
    fast = cp.sample_hold(gain(-0.5, "v", "w", "fast"), 0.2, 0.05)
    loop = ct.interconnect([slow, fast, moved], inputs="r", outputs=["y", "v"])
    times = np.linspace(0.0, 3.0, 31)
    instants = sorted(
        [(round(0.3 * k, 9), "u") for k in range(11)] + [(round(0.05 + 0.2 * k, 9), "w") for k in range(16)]
    )
    x, now, inputs = np.array([1.0, 0.5]), 0.0, {"u": 0.0, "w": 0.0}
    expected = np.empty((2, times.size))
    marks = sorted([(t, 0, name) for t, name in instants] + [(round(t, 9), 1, k) for k, t in enumerate(times)])
    for t, kind, what in marks:
        if t > now:
            x, now = held(x, [inputs["u"], inputs["w"]], t - now, b=b), t
        if kind:
            expected[:, what] = x
        else:
            inputs[what] = 2.0 * (planned(t) - x[0]) if what == "u" else -0.5 * x[1]
    found = cp.simulate(loop, times, PLAN, [0.0, 0.0, 1.0, 0.5], method=method, **TIGHT)
    assert np.abs(found.outputs - expected).max() <= 1e-8


@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_blocks_sampled_at_one_instant_pass_on_at_once(order, method):
    """Three gains in a row, the middle one half as often: at common instants all three are new, and a lag of a
    sample, which a discrete block without feedthrough has, stays one sample."""
    blocks = [
        cp.sample_hold(gain([1.0, -1.0], ["r", "y"], "e", "first"), 0.1),
        cp.sample_hold(gain(2.0, "e", "f", "second"), 0.2),
        cp.sample_hold(gain(0.5, "f", "u", "third"), 0.1),
        ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="plant"),
    ]
    loop = ct.interconnect([blocks[i] for i in order], inputs="r", outputs=["y", "e", "f", "u"])
    times = np.round(0.05 * np.arange(41), 9)
    y, e, f, u, rows = 0.0, 0.0, 0.0, 0.0, []
    for k in range(41):
        if k % 2 == 0:
            e = 1.0 - y
            if k % 4 == 0:
                f = 2.0 * e
            u = 0.5 * f
        rows.append([y, e, f, u])
        y += 0.05 * u
    found = cp.simulate(loop, times, 1.0, method=method, **TIGHT)
    assert np.abs(found.outputs - np.array(rows).T).max() <= 1e-9


@pytest.mark.parametrize("method", LINEAR)
def test_a_discrete_block_without_feedthrough_delays_by_a_sample(method):
    late = ct.ss(0.0, 1.0, 1.0, 0.0, 0.5, inputs="e", outputs="u", name="late")
    first = cp.sample_hold(gain(1.0, "r", "e", "first"), 0.5)
    loop = ct.interconnect([cp.sample_hold(late, 0.5), first], inputs="r", outputs=["e", "u"])
    times = 0.25 * np.arange(13)
    ramp = cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(3, 3)])
    found = cp.simulate(loop, times, ramp, method=method)
    now = 0.5 * np.floor(times / 0.5 + 1e-9)
    assert np.abs(found.outputs - [now, np.maximum(now - 0.5, 0.0)]).max() <= 1e-12


@pytest.mark.parametrize("method", LINEAR)
def test_sampled_blocks_in_a_loop_at_one_instant(method):
    """u = r + w/2 and w = u/2: u = 4 r/3."""
    one = cp.sample_hold(gain([1.0, 0.5], ["r", "w"], "u", "one"), 0.5)
    two = cp.sample_hold(gain(0.5, "u", "w", "two"), 0.5)
    loop = ct.interconnect([one, two], inputs="r", outputs=["u", "w"])
    found = cp.simulate(loop, [0.0, 0.6, 1.3], cp.Step(3.0, time=0.9), method=method)
    assert np.abs(found.outputs - [[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]]).max() <= 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_a_sampled_loop_around_a_pendulum(method):
    pendulum = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], -np.sin(x[0]) - 0.1 * x[1] + u[0]]),
        None,
        inputs="u",
        outputs=["y", "v"],
        states=2,
        name="pendulum",
    )
    law = ct.nlsys(
        lambda t, x, u, p: x + 0.1 * (u[0] - u[1]),
        lambda t, x, u, p: np.tanh(x + 2.0 * (u[0] - u[1]) - u[2]),
        inputs=["r", "y", "v"],
        outputs="u",
        states=1,
        dt=0.25,
        name="law",
    )
    loop = ct.interconnect([pendulum, cp.sample_hold(law, 0.25)], inputs="r", outputs=["y", "v", "u"])
    times = np.linspace(0.0, 4.0, 41)
    found = cp.simulate(loop, times, PLAN, [0.4, 0.0, 0.1, 0.0], method=method, **TIGHT)
    x, z, rows = np.array([0.4, 0.0]), 0.1, []
    for k in range(17):
        t = 0.25 * k
        error = planned(t) - x[0]
        u = math.tanh(z + 2 * error - x[1])
        z += 0.1 * error
        inside = times[(times >= t - 1e-12) & (times < t + 0.25 - 1e-12)]
        run = solve_ivp(
            lambda t, x, u=u: [x[1], -math.sin(x[0]) - 0.1 * x[1] + u],
            (t, t + 0.25),
            x,
            "DOP853",
            rtol=1e-12,
            atol=1e-13,
            t_eval=np.append(np.maximum(inside, t), t + 0.25),
        )
        rows += [[*state, u] for state in run.y[:, :-1].T]
        x = run.y[:, -1]
    assert found.method == method
    assert np.abs(found.outputs - np.array(rows).T).max() <= 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_sampled_interconnections_and_their_parameters(method):
    """The block is an interconnection of discrete blocks with a parameter of the run."""
    a = ct.ss(0.5, 1, 1, 0, 0.5, inputs="y", outputs="w", name="a")
    b = ct.nlsys(
        lambda t, x, u, p: p["k"] * x + u,
        lambda t, x, u, p: -x,
        inputs="w",
        outputs="u",
        states=1,
        dt=0.5,
        params={"k": 0.1},
        name="b",
    )
    inner = ct.interconnect([a, b], inputs="y", outputs="u", name="inner")
    whole = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="plant")
    loop = ct.interconnect([whole, cp.sample_hold(inner, 0.5)], inputs=0, outputs="y")
    for params, k in (({}, 0.1), ({"k": -0.3}, -0.3)):
        x, one, two, expected = 1.0, 0.0, 0.0, []
        for _ in range(9):
            expected.append(x)
            u = -two
            one, two = 0.5 * one + x, k * two + one
            x += 0.5 * u
        found = cp.simulate(loop, 0.5 * np.arange(9), None, [1.0, 0, 0, 0], method=method, params=params)
        assert np.abs(found.outputs.ravel() - expected).max() <= 1e-7


def test_events_and_stops_in_a_sampled_loop():
    """x' = u held, u = 1 - x every 0.5 s from 0: straight lines 0, 1/2, 3/4, ...; 0.6 is met at 0.7 s."""
    law = gain([1.0, -1.0], ["r", "y"], "u", "law")
    integrator = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="integrator")
    loop = ct.interconnect([integrator, cp.sample_hold(law, 0.5)], inputs="r", outputs="y")
    for method in LINEAR:
        events = [Event("y", high=0.25, name="early"), Event("y", high=0.6, stop=True)]
        found = cp.simulate(loop, [0.0, 0.5, 3.0], 1.0, method=method, events=events)
        assert np.abs([o.time - t for o, t in zip(found.events, (0.25, 0.7), strict=True)]).max() <= 1e-7
        assert found.time.size == 3
        assert np.abs(found.outputs - [0.0, 0.5, 0.6]).max() <= 1e-7


def test_what_the_peer_says_to_such_a_loop():
    law = cp.sample_hold(gain(-1.0, "y", "u", "law"), 0.5)
    loop = ct.interconnect([plant(), law], inputs=0, outputs="y")
    with pytest.raises(RuntimeError, match=r"block law, which is sampled, must be run by ctrlplan.simulate"):
        ct.input_output_response(loop, [0.0, 1.0], 0, [1.0, 0.0, 0.0])
    late = ct.interconnect([plant(), cp.create_delay_iosystem(0.1, inputs="y", outputs="u")], inputs=0, outputs="y")
    with pytest.raises(RuntimeError, match=r"block delay, which is a delay, must be run by ctrlplan"):
        ct.input_output_response(late, [0.0, 1.0], 0, [1.0, 0.0])


@pytest.mark.parametrize("system", ["delayed", "sampled"])
def test_the_exact_method_rejects_them(system):
    bent = ct.nlsys(None, lambda t, x, u, p: np.tanh(u), inputs="r", outputs="y", dt=0.5, name="b")
    cases = {
        "sampled": (cp.sample_hold(bent, 0.5), "block b, which is sampled, is not linear"),
        "delayed": (integrators([1e-6, math.sqrt(0.5)], [-1.0, 0.5]), "delays of 1e-06, 0.707107 s, sample times and"),
    }
    loop, reason = cases[system]
    with pytest.raises(ValueError, match=f'method "exact".*{reason}'):
        cp.simulate(loop, [0.0, 1.0], 1.0 if loop.ninputs else None, method="exact")


HELD = ct.ss(0.5, 1.0, 1.0, 0.0, 0.1, name="held")
LATE = ct.interconnect([cp.create_delay_iosystem(0.2, inputs="a", outputs="b", name="inner")], inputs="a", outputs="b")
LATE.name = "outer"


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ((3, 0.1), TypeError, "block must be a control system, got int"),
        ((HELD, "0.1"), TypeError, "dt must be a number, got '0.1'"),
        ((HELD, True), TypeError, "dt must be a number, got True"),
        ((HELD, 0.0), ValueError, "dt must be finite and above 0, got 0"),
        ((HELD, -0.1), ValueError, "dt must be finite and above 0, got -0.1"),
        ((HELD, math.inf), ValueError, "dt must be finite and above 0, got inf"),
        ((HELD, 0.2), ValueError, "dt must be the period of the block, 0.1 s, got 0.2 s"),
        ((HELD, 0.1, -1.0), ValueError, "offset must be finite and at least 0, got -1"),
        ((HELD, 0.1, math.nan), ValueError, "offset must be finite and at least 0, got nan"),
        ((plant(), 0.1), ValueError, "block must be discrete, got plant with dt = 0: see control.sample_system"),
        ((ct.tf([1], [1, 1], name="lag"), 0.1), ValueError, "block must be discrete, got lag"),
        ((ct.frd([1, 2], [1, 2], name="data"), 0.1), TypeError, "block must have equations, got data with its"),
        ((cp.create_delay_iosystem(0.1, name="late"), 0.1), ValueError, "got late with the delay late; connect the"),
        (
            (LATE, 0.1),
            ValueError,
            "block must be discrete or static, got outer with the delay inner; connect the delay",
        ),
    ],
)
def test_bad_sampled_blocks(arguments, error, match):
    with pytest.raises(error, match=match):
        cp.sample_hold(*arguments)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"delay": 0.0}, ValueError, "delay must be above 0, got 0: leave the block out"),
        ({"delay": -1}, ValueError, "delay must be finite and above 0, got -1"),
        ({"delay": math.inf}, ValueError, "delay must be finite"),
        ({"delay": "1"}, TypeError, "delay must be a number, got '1'"),
        ({"delay": 1.0, "inputs": ["a", "b"]}, ValueError, "outputs must be as many as inputs, 2, got 1"),
        ({"delay": 1.0, "initial": [1.0, 2.0]}, ValueError, "initial must be a finite number or 1 of them"),
        ({"delay": 1.0, "initial": math.nan}, ValueError, "initial must be a finite number"),
    ],
    ids=str,
)
def test_bad_delays(options, error, match):
    with pytest.raises(error, match=match):
        cp.create_delay_iosystem(**options)


# Delays


def integrators(delays, weights, initial=0.0):
    """x' = the sum of weights times x some time ago."""
    names = [f"x{k}" for k in range(len(delays))]
    pasts = [
        cp.create_delay_iosystem(d, inputs="x", outputs=name, initial=initial, name=f"delay{k}")
        for k, (d, name) in enumerate(zip(delays, names, strict=True))
    ]
    moved = ct.ss(0.0, [weights], 1.0, np.zeros((1, len(weights))), inputs=names, outputs="x", name="integrator")
    return ct.interconnect([moved, *pasts], inputs=0, outputs="x")


def by_steps(times, delay=1.0):
    """x' = -x(t - d) from 1, which it always was: the sum of (-1)^k (t - (k - 1) d)^k/k! up to (k - 1) d <= t."""
    rows = []
    for t in times:
        terms = range(math.floor(t / delay + 1e-9) + 2)
        rows.append(
            math.fsum(
                (-1) ** k * math.exp(k * math.log(max(t - (k - 1) * delay, 1e-300)) - math.lgamma(k + 1)) for k in terms
            )
        )
    return np.array(rows)


@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("first", [0.0, -3.0])
def test_a_decay_by_what_was(first, method):
    times = np.linspace(0.0, 12.0, 49)
    found = cp.simulate(integrators([1.0], [-1.0], 1.0), first + times, None, 1.0, method=method, **TIGHT)
    assert found.method == method
    assert np.abs(found.outputs.ravel() - by_steps(times)).max() <= 1e-8
    # The first intervals in full: 1 - t, then 1 - t + (t - 1)^2/2.
    assert np.abs(found.outputs.ravel()[:5] - (1 - times[:5])).max() <= 1e-8
    middle = times[4:9]
    assert np.abs(found.outputs.ravel()[4:9] - (1 - middle + 0.5 * (middle - 1) ** 2)).max() <= 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("count", [32, 301])
def test_a_delay_much_shorter_than_the_run(count, method):
    times = np.linspace(0.0, 5.0, count)
    found = cp.simulate(integrators([0.01], [-1.0], 1.0), times, None, 1.0, method=method, **TIGHT)
    assert np.abs(found.outputs.ravel() - by_steps(times, 0.01)).max() <= 1e-8


@pytest.mark.parametrize("method", METHODS)
def test_two_delays_without_a_common_measure(method):
    """1/(s - a exp(-d1 s) - b exp(-d2 s)) as its series: binomials times powers of t - i d1 - j d2."""
    d1, d2, a, b = 1.0, math.sqrt(0.5), -1.2, 0.7
    times = np.linspace(0.0, 7.0, 57)

    def exact(t):
        total = 0.0
        for i in range(8):
            for j in range(11):
                s = t - i * d1 - j * d2
                if s >= 0:
                    total += math.comb(i + j, i) * a**i * b**j * s ** (i + j) / math.factorial(i + j)
        return total

    found = cp.simulate(integrators([d1, d2], [a, b]), times, None, 1.0, method=method, **TIGHT)
    assert np.abs(found.outputs.ravel() - [exact(t) for t in times]).max() <= 1e-8


def method_of_steps(rate, delays, initial, end, times):
    """Scalar x' = rate(t, x, pasts), constant before 0: dense output of one segment is the past of the next."""
    marks = {0.0, end}
    for _ in range(12):
        marks |= {t + d for t in marks for d in delays if t + d < end}
    marks = sorted(marks)
    kept = [marks[0]]
    for t in marks[1:]:
        if t - kept[-1] > 1e-9:
            kept.append(t)
    segments, x = [], initial

    def past(t):
        if t <= 0.0:
            return initial
        for right, run in segments:
            if t <= right:
                return float(run(t)[0])
        return x

    for left, right in pairwise(kept):
        run = solve_ivp(
            lambda t, x: [rate(t, x[0], [past(t - d) for d in delays])],
            (left, right),
            [x],
            "DOP853",
            rtol=1e-12,
            atol=1e-13,
            dense_output=True,
            max_step=0.1,
        )
        segments.append((right, run.sol))
        x = run.y[0, -1]
    return np.array([past(t) for t in times])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_bent_loop_with_two_delays(method):
    """x' = 2 y/(1 + y^6) - x + z/2 with y and z the state 2 and sqrt 2 s ago."""
    delays = (2.0, math.sqrt(2.0))
    times = np.linspace(0.0, 12.0, 25)

    def rate(t, x, u, p):
        return 2.0 * u[0] / (1.0 + u[0] ** 6) - x + 0.5 * u[1]

    pasts = [
        cp.create_delay_iosystem(d, inputs="x", outputs=name, initial=0.5, name=f"delay_{name}")
        for d, name in zip(delays, "ab", strict=True)
    ]
    bent = ct.nlsys(rate, None, inputs=["a", "b"], outputs="x", states=1, name="bent")
    loop = ct.interconnect([*pasts, bent], inputs=0, outputs="x")
    exact = method_of_steps(lambda t, x, u: rate(t, x, u, None), delays, 0.5, 12.0, times)
    found = cp.simulate(loop, times, None, 0.5, method=method, **TIGHT)
    assert found.method == method
    assert np.abs(found.outputs.ravel() - exact).max() <= 1e-7


@pytest.mark.parametrize("method", METHODS)
def test_a_delay_in_a_saturated_loop(method):
    """x' = sat(2 (1 - x(t - 0.6))) within 0.8: kinks inside segments."""
    late = cp.create_delay_iosystem(0.6, inputs="x", outputs="seen")
    law = gain([2.0, -2.0], ["r", "seen"], "u_cmd", "law")
    integrator = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="integrator")
    loop = ct.interconnect([late, law, cp.create_saturation_iosystem(-0.8, 0.8), integrator], inputs="r", outputs="x")
    times = np.linspace(0.0, 6.0, 25)
    found = cp.simulate(loop, times, 1.0, method=method)
    exact = method_of_steps(lambda t, x, u: min(max(2 * (1 - u[0]), -0.8), 0.8), (0.6,), 0.0, 6.0, times)
    assert np.abs(exact).max() > 1.2
    assert np.abs(found.outputs - exact).max() <= 1e-5


@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("delay", [0.25, math.pi / 3])
def test_a_delayed_plan_is_the_plan_later(delay, alpha, method):
    points = [cp.Waypoint(0.4, 0, 0, 0), cp.Waypoint(1.1, 1, -0.3), cp.Waypoint(2.7, 0.5, 0, 0)]
    plan = cp.TrigSpline(points, alpha=alpha, labels=["u"]) if alpha else cp.PolySpline(points, labels=["u"])
    late = cp.create_delay_iosystem(delay)
    loop = ct.interconnect([cp.create_source_iosystem(plan), late], inputs=0, outputs=["y", "u"])
    times = np.linspace(0.0, 5.0, 101)
    for found in (
        cp.simulate(loop, times, method=method).outputs[0],
        cp.simulate(late, times, plan, method=method).outputs.ravel(),
    ):
        assert np.abs(found - plan.shift(delay)(times)).max() <= 1e-9


@pytest.mark.parametrize("method", LINEAR)
def test_what_is_output_before_anything_has_come_through(method):
    late = cp.create_delay_iosystem(0.7, inputs=["a", "b"], outputs=["c", "d"], initial=[3.0, -2.0])
    times = np.array([0.0, 0.3, 0.7 - 1e-9, 0.7 + 1e-9, 1.0, 2.0])
    found = cp.simulate(late, times, {"a": 1.0, "b": cp.Step(5.0, time=0.2)}, method=method)
    assert np.abs(found.outputs - [[3, 3, 3, 1, 1, 1], [-2, -2, -2, 0, 5, 5]]).max() <= 1e-12


@pytest.mark.parametrize("method", LINEAR)
def test_a_jump_passes_at_its_time(method):
    """Through two delays in a row, 1.15 s after 0.3 s, and into an integrator: a ramp from 1.45 s on."""
    one, two = (
        cp.create_delay_iosystem(0.8, inputs="r", outputs="w", name="one"),
        cp.create_delay_iosystem(0.35, inputs="w", outputs="u", name="two"),
    )
    integrator = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="integrator")
    loop = ct.interconnect([two, integrator, one], inputs="r", outputs=["u", "y"])
    times = np.array([0.0, 1.0, 1.45 - 1e-9, 1.45 + 1e-9, 2.0, 3.0])
    found = cp.simulate(loop, times, cp.Step(2.0, time=0.3), method=method, events=[Event("u", high=1.0)])
    assert np.abs(found.outputs[0] - [0, 0, 0, 2, 2, 2]).max() <= 1e-12
    assert np.abs(found.outputs[1] - 2 * np.maximum(times - 1.45, 0.0)).max() <= 1e-8
    assert abs(found.events[0].time - 1.45) <= 1e-9


@pytest.mark.parametrize("method", LINEAR)
@pytest.mark.parametrize("jump", [0.0, 0.1, 0.73])
def test_jumps_that_go_round_indefinitely(jump, method):
    """y = -y(t - 1)/2 + r has no state; the step is back at half its size every second."""
    late = cp.create_delay_iosystem(1.0, inputs="y", outputs="past")
    adder = gain([1.0, -0.5], ["r", "past"], "y", "adder")
    loop = ct.interconnect([late, adder], inputs="r", outputs="y")
    times = np.linspace(0.0, 15.0, 311)
    rounds = np.floor(times - jump + 1e-9)
    exact = np.where(rounds >= 0, (1 - (-0.5) ** (rounds + 1)) / 1.5, 0.0)
    found = cp.simulate(loop, times, cp.Step(1.0, time=jump), method=method)
    assert np.abs(found.outputs.ravel() - exact).max() <= 1e-12


def test_two_rounds_without_a_common_measure():
    """y = y(t - 1)/2 - 0.3 y(t - sqrt(1/2)) + r: as many jumps as there are sums of the two delays."""
    root = math.sqrt(0.5)
    blocks = [
        cp.create_delay_iosystem(1.0, inputs="y", outputs="one", name="d1"),
        cp.create_delay_iosystem(root, inputs="y", outputs="two", name="d2"),
        gain([1.0, 0.5, -0.3], ["r", "one", "two"], "y", "adder"),
    ]
    times = np.linspace(0.0, 4.0, 81)
    exact = [
        sum(
            math.comb(i + j, i) * 0.5**i * (-0.3) ** j
            for i in range(6)
            for j in range(7)
            if t >= 0.1 + i + j * root - 1e-9
        )
        for t in times
    ]
    found = cp.simulate(ct.interconnect(blocks, inputs="r", outputs="y"), times, cp.Step(1.0, time=0.1))
    assert np.abs(found.outputs.ravel() - exact).max() <= 1e-12


@pytest.mark.parametrize("method", LINEAR)
def test_a_sampled_law_whose_control_comes_late(method):
    """u = -x/2 taken every 0.5 s comes 0.2 s later: straight lines, their slopes one behind the other."""
    law = cp.sample_hold(gain(-0.5, "x", "u_cmd", "law"), 0.5)
    late = cp.create_delay_iosystem(0.2, inputs="u_cmd", outputs="u")
    integrator = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="u", outputs="x", name="integrator")
    loop = ct.interconnect([integrator, late, law], inputs=0, outputs="x")
    times = np.round(0.1 * np.arange(51), 9)
    x, slope, requested, rows = 1.0, 0.0, 0.0, []
    for k in range(51):
        if k % 5 == 0:
            requested = -0.5 * x
        if k % 5 == 2:
            slope = requested
        rows.append(x)
        x += 0.1 * slope
    found = cp.simulate(loop, times, None, [1.0, 0.0], method=method, **TIGHT)
    assert np.abs(found.outputs.ravel() - rows).max() <= 1e-8


@pytest.mark.parametrize("method", LINEAR)
def test_a_sampled_jump_arrives_at_its_time(method):
    """h = 1 from 0.01 s on comes 0.2 s later into an integrator, whatever the sample times of the response."""
    held = cp.sample_hold(gain(1.0, "r", "h", "unit"), 0.3333, 0.01)
    late = cp.create_delay_iosystem(0.2, inputs="h", outputs="w")
    moved = ct.ss(0.0, 1.0, 1.0, 0.0, inputs="w", outputs="x", name="moved")
    loop = ct.interconnect([held, late, moved], inputs="r", outputs=["x", "w"])
    times = np.array([0.0, 0.0952, 0.1, 0.22004, 0.2747])
    found = cp.simulate(loop, times, 1.0, method=method, **TIGHT)
    assert np.abs(found.outputs[0] - np.maximum(times - 0.21, 0.0)).max() <= 1e-10
    assert found.outputs[1].tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize("method", LINEAR)
def test_a_run_with_a_delay_that_stops(method):
    found = cp.simulate(
        integrators([1.0], [-1.0], 1.0),
        [0.0, 0.5, 9.0],
        None,
        1.0,
        method=method,
        events=[Event("x", low=-0.4, stop=True)],
    )
    # 1 - t + (t - 1)^2/2 = -0.4
    last = 2.0 - math.sqrt(0.2)
    assert abs(found.time[-1] - last) <= 1e-7
    assert np.abs(found.outputs.ravel() - [1.0, 0.5, -0.4]).max() <= 1e-7


# Discrete loops


@pytest.mark.parametrize("dt", [0.1, True])
def test_a_discrete_loop_with_a_plan_inside(dt):
    """Sampled plant, law with a saturation, plan as a source: a hand loop."""
    period = 1.0 if dt is True else dt
    plan = PLAN if dt == 0.1 else cp.PolySpline([cp.Waypoint(3, 0, 0), cp.Waypoint(11, 2, 0)], labels=["r"])
    a, b = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.02], [0.2]])
    moved = ct.ss(a, b, np.array([[1.0, 0.0]]), 0, dt, inputs="u", outputs="y", name="plant")
    law = ct.nlsys(
        lambda t, x, u, p: 0.9 * x + 0.3 * (u[0] - u[1]),
        lambda t, x, u, p: np.clip(x + 4.0 * (u[0] - u[1]), -p["limit"], p["limit"]),
        inputs=["r", "y"],
        outputs="u",
        states=1,
        dt=dt,
        params={"limit": 1.5},
        name="law",
    )
    loop = ct.interconnect([cp.create_source_iosystem(plan), law, moved], inputs=0, outputs=["y", "u"])
    for first in (0.0, 4.0 * period):
        times = first + period * np.arange(31)
        x, z, rows = np.array([0.1, -0.3]), 0.2, []
        for t in times:
            error = float(plan(t)) - x[0]
            u = float(np.clip(z + 4 * error, -0.8, 0.8))
            rows.append([x[0], u])
            x, z = a @ x + b[:, 0] * u, 0.9 * z + 0.3 * error
        found = cp.simulate(loop, times, None, [0.2, 0.1, -0.3], params={"limit": 0.8})
        assert found.method == "python"
        assert np.abs(found.outputs - np.array(rows).T).max() <= 1e-12
        # Without a sampling time only even times say how many steps lie between them: one each.
        some = np.array([0, 3, 4, 11, 30]) if dt is not True else np.arange(20)
        coarse = cp.simulate(loop, times[some], None, [0.2, 0.1, -0.3], params={"limit": 0.8})
        assert np.abs(coarse.outputs - found.outputs[:, some]).max() <= 1e-12


@pytest.mark.parametrize("method", ["auto", "python"])
@pytest.mark.parametrize(
    ("times", "at"), [([0.0, 0.1, 0.25], "0.25"), ([0.03, 0.1, 0.23], "0.1"), ([0.0, 0.1000011], "0.100001")]
)
def test_times_between_the_samples(times, at, method):
    with pytest.raises(ValueError, match=rf"timepts must be whole periods of 0\.1 s apart.*got {at} s"):
        cp.simulate(HELD, times, 1.0, method=method)


def test_a_discrete_system_is_not_compiled():
    with pytest.raises(ValueError, match=r'method "compiled" .*is discrete \(dt = 0\.1\)'):
        cp.simulate(HELD, [0.0, 0.1], 1.0, method="compiled")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["compiled", "python"])
def test_the_memory_of_a_sampled_block_is_not_integrated(method, monkeypatch):
    """A delay line of 400 samples before an integrator: the equations that are integrated have one state."""
    from ctrlplan.simulation.numerical import Attempt

    shapes = []
    slopes = Attempt.__dict__["_slopes"].func
    recorded = functools.cached_property(lambda self: shapes.append(found := slopes(self)) or found)
    recorded.__set_name__(Attempt, "_slopes")
    monkeypatch.setattr(Attempt, "_slopes", recorded)
    line = ct.ss(np.eye(400, k=-1), np.eye(400, 1), np.eye(1, 400, 399), [[0.0]], 0.01, inputs="r", outputs="late")

    def rates(t, x, u, params):
        return [u[0] - x[0] ** 3]

    plant = ct.nlsys(rates, lambda t, x, u, params: x[0], inputs="late", outputs="y", states=1, name="plant")
    loop = ct.interconnect([cp.sample_hold(line, 0.01, name="line"), plant], inputs="r", outputs=["y", "late"])
    t = np.array([0.0, 3.99, 4.0, 6.0])
    found = cp.simulate(loop, t, cp.Step(1.0), method=method)
    np.testing.assert_array_equal(found.outputs[1], [0.0, 0.0, 1.0, 1.0])
    wanted = cp.simulate(ct.interconnect([plant], inputs="late", outputs="y"), [0.0, 2.0], cp.Step(1.0))
    assert float(found.outputs[0, -1]) == pytest.approx(float(np.ravel(wanted.outputs)[-1]), abs=1e-7)
    assert {found.shape[1:] for found in shapes} == {(1, 1)}
