"""Cost of derived flat maps and of reference windows, with the peer in the same process; ratios are printed."""

from statistics import median
from time import process_time

import control.flatsys as fs
import numpy as np
import pytest

pytest.importorskip("casadi")

from flat_plants import CASES, G, quadrotor

import ctrlplan as cp

COUNT = 10_000
REST = [0.0] * 4
LIFT = cp.PolySpline(
    [cp.Waypoint.from_jets(0.0, x=[0, *REST], z=[10, *REST]), cp.Waypoint.from_jets(15.0, x=[20, *REST], z=[11, *REST])]
)


def seconds(function, rounds=5):
    """Median of the CPU time of a call."""
    times = []
    for _ in range(rounds):
        begin = process_time()
        function()
        times.append(process_time() - begin)
    return median(times)


@pytest.fixture
def told(benchmark, capsys, request):
    """Benchmark a call, and print its time with those of peers by name."""

    def run(ours, peers):
        benchmark.pedantic(ours, rounds=3, warmup_rounds=1)
        own = seconds(ours)
        text = ", ".join(f"{other * 1e3:.3g} ms {name}, ratio {own / other:.3g}" for name, other in peers.items())
        with capsys.disabled():
            print(f"\n{request.node.name}: {own * 1e3:.3g} ms; {text}")

    return run


def test_crane_map_at_ten_thousand_times(told):
    """The goal is 20 times the CPU time of the formulas."""
    crane = cp.plants.Crane()
    flat, by_hand = cp.flat_system(crane.iosystem(), ["x", "z"], at={"R": 10.0}), crane.flat_system()
    t = np.linspace(0.0, 15.0, COUNT)
    for got, wanted in zip(flat.states_and_inputs(LIFT, t), by_hand.states_and_inputs(LIFT, t), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-9)
    told(
        lambda: flat.states_and_inputs(LIFT, t),
        {"by formulas": seconds(lambda: by_hand.states_and_inputs(LIFT, t))},
    )


def _composed(s, f, df, ddf):
    """Taylor coefficients up to order 2 of a function of a series."""
    return np.array([f(s[0]), df(s[0]) * s[1], df(s[0]) * s[2] + 0.5 * ddf(s[0]) * s[1] ** 2])


def _product(a, b):
    return np.array([sum(a[i] * b[k - i] for i in range(k + 1)) for k in range(min(len(a), len(b)))])


_SINE = np.sin, np.cos, lambda x: -np.sin(x)
_COSINE = np.cos, lambda x: -np.sin(x), lambda x: -np.cos(x)


def reverse(flag, params):
    """Map of the quadrotor by hand, one time after the other as python-control calls it."""
    half = np.array([1.0, 1.0, 0.5])
    ax, ay, az = (flag[k][2:5] * half for k in range(3))
    az = az + np.array([G, 0.0, 0.0])
    yaw = flag[3][:3] * half
    s, c = (
        _composed(yaw, np.sin, np.cos, lambda x: -np.sin(x)),
        _composed(yaw, np.cos, lambda x: -np.sin(x), lambda x: -np.cos(x)),
    )
    ahead, side = _product(ax, c) + _product(ay, s), _product(ax, s) - _product(ay, c)
    square = _product(ax, ax) + _product(ay, ay) + _product(az, az)
    inverse = _composed(square, lambda x: x**-0.5, lambda x: -0.5 * x**-1.5, lambda x: 0.75 * x**-2.5)
    roll = _composed(
        _product(side, inverse), np.arcsin, lambda x: (1.0 - x * x) ** -0.5, lambda x: x * (1.0 - x * x) ** -1.5
    )
    level = _composed(az, lambda x: 1.0 / x, lambda x: -1.0 / x**2, lambda x: 2.0 / x**3)
    pitch = _composed(
        _product(ahead, level), np.arctan, lambda x: 1.0 / (1.0 + x * x), lambda x: -2.0 * x / (1.0 + x * x) ** 2
    )
    sr, cr, sp, cpitch = (_composed(angle, *functions)[:2] for angle in (roll, pitch) for functions in (_SINE, _COSINE))
    droll, dpitch, dyaw = (np.array([angle[1], 2.0 * angle[2]]) for angle in (roll, pitch, yaw))
    p = droll - _product(sp, dyaw)
    q = _product(cr, dpitch) + _product(_product(sr, cpitch), dyaw)
    r = _product(_product(cr, cpitch), dyaw) - _product(sr, dpitch)
    torques = [
        0.02 * p[1] - (0.025 - 0.04) * q[0] * r[0],
        0.025 * q[1] - (0.04 - 0.02) * p[0] * r[0],
        0.04 * r[1] - (0.02 - 0.025) * p[0] * q[0],
    ]
    position, velocity = ([flag[k][order] for k in range(3)] for order in (0, 1))
    x = [*position, *velocity, roll[0], pitch[0], yaw[0], p[0], q[0], r[0]]
    return np.array(x), np.array([1.2 * np.sqrt(square[0]), *torques])


def test_quadrotor_and_trajectories_of_python_control(told):
    """The goal is a fiftieth of the CPU time of `SystemTrajectory.eval` with a map by hand."""
    case = CASES["quadrotor"]
    flat = cp.flat_system(case.plant, case.outputs, at=case.at)
    by_hand = fs.FlatSystem(
        flat.forward, reverse, quadrotor.updfcn, None, states=12, inputs=4, outputs=12, name="quadrotor"
    )
    start, hover = np.zeros(12), np.array([1.2 * G, 0.0, 0.0, 0.0])
    end = np.zeros(12)
    end[[0, 1, 2, 8]] = 3.0, 1.0, 1.0, 0.5
    theirs = fs.point_to_point(by_hand, [0.0, 3.0], start, hover, end, hover, basis=fs.PolyFamily(10))
    plan = cp.as_trajectory(theirs, 0.0, 3.0)
    plan = cp.stack([plan], labels=list(flat.flat_labels))
    few, t = np.linspace(0.0, 3.0, 50), np.linspace(0.0, 3.0, COUNT)
    for got, wanted in zip(flat.states_and_inputs(plan, few), theirs.eval(few), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-7, atol=1e-7)
    one = seconds(lambda: theirs.eval(few)) / few.size
    told(lambda: flat.states_and_inputs(plan, t), {"of python-control": COUNT * one})


def test_reference_window_without_a_plant(told):
    """The goal is 1.5 times the CPU time of the jet."""
    times = 3.0 + 0.1 * np.arange(51)
    np.testing.assert_array_equal(cp.reference_window(LIFT, 3.0, 0.1, 50), LIFT.jet(times, 2))

    def windows():
        for _ in range(200):
            cp.reference_window(LIFT, 3.0, 0.1, 50)

    def jets():
        for _ in range(200):
            LIFT.jet(3.0 + 0.1 * np.arange(51), 2)

    told(windows, {"200 jets": seconds(jets)})


@pytest.mark.parametrize("count", [10, 1000])
def test_reference_window_of_the_crane(count, told):
    """The goal is 2 ms and 20 us a point once the grid of the plan is made."""
    flat = cp.flat_system(cp.plants.Crane().iosystem(), ["x", "z"], at={"R": 10.0})
    x, u = cp.reference_window(LIFT, 3.0, 10.0 / count, count, flat=flat)
    assert (x.shape, u.shape) == ((6, count + 1), (2, count))
    told(lambda: cp.reference_window(LIFT, 3.0, 10.0 / count, count, flat=flat), {"goal": 2e-3 + 20e-6 * (count + 1)})
