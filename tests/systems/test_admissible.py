"""The admissible set compared with brute force: the loop with constant reference on a fine time grid."""

import math

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import ctrlplan as cp

MARGIN = 0.01
SPARED = 0.1 * MARGIN  # margin given up by the set, in half widths


def first_order():
    """u = v - x, x' = v - x: |v - x| only falls."""
    return ct.ss([[-1.0]], [[1.0]], [[-1.0], [1.0]], [[1.0], [0.0]], inputs="r", outputs=["u", "y"], states="x")


def second_order(zeta, w=2.0):
    return ct.ss([[0, 1], [-w * w, -2 * zeta * w]], [[0], [w * w]], [[1, 0]], 0, inputs="r", outputs="y")


def random_loop(rng, n, p, m):
    """Stable, the poles between 0.4 and 6 rad/s, damped at least by 0.2."""
    a = np.zeros((n, n))
    k = 0
    while k < n:
        w, zeta = rng.uniform(0.4, 6.0), rng.uniform(0.2, 1.0)
        if n - k >= 2 and rng.random() < 0.6:
            a[k : k + 2, k : k + 2] = [
                [-zeta * w, w * math.sqrt(1 - zeta**2)],
                [-w * math.sqrt(1 - zeta**2), -zeta * w],
            ]
            k += 2
        else:
            a[k, k] = -w
            k += 1
    mix = rng.standard_normal((n, n)) + 2.0 * np.eye(n)
    a = mix @ a @ np.linalg.inv(mix)
    d = rng.standard_normal((p, m)) * (rng.random((p, m)) < 0.5)
    return ct.ss(a, rng.standard_normal((n, m)), rng.standard_normal((p, n)), d)


def outputs(loop, x, v, horizon=20.0, step=0.005):
    """Outputs with the reference held, by one matrix exponential a step."""
    rest = -np.linalg.solve(loop.A, loop.B @ v)
    z, change = np.asarray(x, dtype=float) - rest, expm(loop.A * step)
    states = z[:, None]
    for _ in range(math.ceil(math.log2(horizon / step))):  # twice as long each time
        states, change = np.hstack([states, change @ states]), change @ change
    return loop.C @ (states + rest[:, None]) + (loop.D @ v)[:, None]


def violates(loop, limits, x, v):
    """Whether an output violates its limits, or its steady state their margin."""
    y = outputs(loop, x, v)
    rest = loop.C @ -np.linalg.solve(loop.A, loop.B @ v) + loop.D @ v
    low, high = np.array(list(limits.values())).T
    half = 0.5 * (high - low)
    beyond = max((y.max(axis=1) - high).max(), (low - y.min(axis=1)).max())
    return beyond > 0.0 or np.any(rest > high - MARGIN * half) or np.any(rest < low + MARGIN * half)


# Closed forms


@pytest.mark.parametrize("dt", [0.01, 0.5])
def test_first_order_with_a_limit_that_only_falls_away(dt):
    found = cp.AdmissibleSet(first_order(), {"u": (-1.0, 2.0)}, dt)
    assert len(found.bounds) == 2
    for x, v in np.random.default_rng(0).uniform(-5.0, 5.0, (300, 2)):
        inside = min(2.0 - (v - x), (v - x) + 1.0)
        if abs(inside) > 2.0 * SPARED:
            assert found.contains([x], [v]) == (inside > 0.0)


def test_first_order_with_a_limit_of_the_state():
    """y runs from x to v: both must be inside, v by the margin."""
    found = cp.AdmissibleSet(first_order(), {"y": (-1.0, 1.0)}, 0.1)
    for x, v in np.random.default_rng(1).uniform(-1.3, 1.3, (300, 2)):
        inside = min(1.0 - abs(x), 1.0 - MARGIN - abs(v))
        if abs(inside) > 2.0 * SPARED:
            assert found.contains([x], [v]) == (inside > 0.0)


@pytest.mark.parametrize("zeta", [0.1, 0.4, 0.7])
@pytest.mark.parametrize("dt", [0.05, 1.0])
def test_a_step_from_rest_is_limited_by_its_overshoot(zeta, dt):
    """Peak 1 + exp(-pi zeta/sqrt(1 - zeta^2)), at a time that is no sample."""
    found = cp.AdmissibleSet(second_order(zeta), {"y": (-1.0, 1.0)}, dt)
    largest = 1.0 / (1.0 + math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)))
    kappa = found.fraction([0.0, 0.0], [0.0], [1.0])
    assert (1.0 - 2.0 * SPARED) * min(largest, 1.0 - MARGIN) <= kappa <= largest


def test_the_margin_at_rest():
    found = cp.AdmissibleSet(first_order(), {"y": (-1.0, 3.0)}, 0.1, margin=0.1)
    for v, inside in ((2.79, True), (2.81, False), (-0.79, True), (-0.81, False)):
        assert found.contains([v], [v]) == inside
    one_sided = cp.AdmissibleSet(first_order(), {"y": (-math.inf, 5.0)}, 0.1, margin=0.1)
    for v, inside in ((4.49, True), (4.51, False), (-1e5, True)):
        assert one_sided.contains([v], [v]) == inside
    of_zero = cp.AdmissibleSet(first_order(), {"y": (0.0, math.inf)}, 0.1, margin=0.1)
    for v, inside in ((0.11, True), (0.09, False), (1e5, True)):
        assert of_zero.contains([v], [v]) == inside


def test_a_loop_without_states():
    gain = ct.ss([], [], [], [[2.0, 1.0]], inputs=["a", "b"], outputs="y")
    found = cp.AdmissibleSet(gain, {"y": (-1.0, 1.0)}, 0.1, margin=0.01)
    assert found.contains([], [0.2, 0.5])
    assert not found.contains([], [0.5, 0.0])
    assert abs(found.fraction([], [0.0, 0.0], [1.0, 0.0]) - 0.495) < 1e-7


@pytest.mark.slow
def test_the_set_does_not_depend_on_the_period():
    loop = second_order(0.3)
    sets = [cp.AdmissibleSet(loop, {"y": (-1.0, 1.0)}, dt) for dt in (0.01, 0.3)]
    assert np.array_equal(sets[0].state_matrix, sets[1].state_matrix)
    assert sets[0].periods > sets[1].periods


# Brute force


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 24))])
def test_inside_nothing_is_violated_and_just_outside_something_is(seed):
    rng = np.random.default_rng(seed)
    n, p, m = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(1, 3))
    loop = random_loop(rng, n, p, m)
    limits = {label: (-rng.uniform(0.5, 3.0), rng.uniform(0.5, 3.0)) for label in loop.output_labels}
    found = cp.AdmissibleSet(loop, limits, 0.05)
    assert found.contains(np.zeros(n), np.zeros(m))
    for _ in range(6):
        x, v = rng.standard_normal(n), rng.standard_normal(m)
        inside, outside = 0.0, 1e3
        while outside - inside > 1e-6 * outside:
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if found.contains(middle * x, middle * v) else (inside, middle)
        assert not violates(loop, limits, inside * x, inside * v)
        # Limits are at least half a half width away from 0, where the ray starts.
        assert violates(loop, limits, 1.02 * inside * x, 1.02 * inside * v)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_limits_on_one_side(seed):
    rng = np.random.default_rng(200 + seed)
    loop = random_loop(rng, 3, 2, 1)
    found = cp.AdmissibleSet(loop, {"y[0]": (-math.inf, 1.5), "y[1]": (-0.5, math.inf)}, 0.1)
    for _ in range(20):
        x, v, far = rng.standard_normal(3), rng.standard_normal(1), 10.0 ** rng.uniform(0.0, 3.0)
        inside, outside = 0.0, far
        while outside - inside > 1e-6 * outside and not found.contains(far * x, far * v):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if found.contains(middle * x, middle * v) else (inside, middle)
        inside = far if found.contains(far * x, far * v) else inside
        y = outputs(loop, inside * x, inside * v)
        assert y[0].max() <= 1.5
        assert y[1].min() >= -0.5
        if inside < far:
            y = outputs(loop, 1.02 * inside * x, 1.02 * inside * v)
            rest = (loop.D - loop.C @ np.linalg.solve(loop.A, loop.B)) @ (1.02 * inside * v)
            assert y[0].max() > 1.5 or y[1].min() < -0.5 or rest[0] > 1.485 or rest[1] < -0.495


@pytest.mark.slow
def test_every_later_time_follows():
    """Finite determination, by linear programs: over the set no output leaves its limits at any time."""
    loop = random_loop(np.random.default_rng(3), 3, 2, 1)
    limits = {"y[0]": (-1.0, 2.0), "y[1]": (-1.0, 1.0)}
    found = cp.AdmissibleSet(loop, limits, 0.1)
    rows = np.hstack([found.state_matrix, found.reference_matrix])
    rest = -np.linalg.solve(loop.A, loop.B)
    for t in np.concatenate([np.linspace(0.0, 0.1, 5), np.linspace(0.137, 3 * found.periods * 0.1, 40)]):
        moved = loop.C @ expm(loop.A * t)
        output = np.hstack([moved, loop.D + (loop.C - moved) @ rest])
        for row, (low, high) in zip(output, limits.values(), strict=True):
            for sign, limit in ((1.0, high), (-1.0, -low)):
                maximum = linprog(-sign * row, A_ub=rows, b_ub=found.bounds, bounds=(None, None))
                assert maximum.status == 0
                assert -maximum.fun <= limit + 1e-6


@pytest.mark.slow
def test_no_row_is_superfluous():
    found = cp.AdmissibleSet(second_order(0.3), {"y": (-1.0, 1.0)}, 0.1)
    rows = np.hstack([found.state_matrix, found.reference_matrix])
    for k, row in enumerate(rows):
        others = np.arange(len(rows)) != k
        maximum = linprog(-row, A_ub=rows[others], b_ub=found.bounds[others], bounds=(None, None))
        assert maximum.status == 3 or -maximum.fun > found.bounds[k] - 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_fraction_is_the_farthest_admissible_one(seed):
    rng = np.random.default_rng(100 + seed)
    loop = random_loop(rng, 3, 2, 2)
    found = cp.AdmissibleSet(loop, {"y[0]": (-1.0, 1.0), "y[1]": (-2.0, 1.0)}, 0.05)
    for _ in range(40):
        x, v, r = 0.3 * rng.standard_normal(3), 0.1 * rng.standard_normal(2), 2.0 * rng.standard_normal(2)
        kappa = found.fraction(x, v, r)
        grid = np.linspace(0.0, 1.0, 401)
        allowed = [k for k in grid if found.contains(x, v + k * (r - v))]
        if math.isnan(kappa) or (kappa == 0.0 and not found.contains(x, v)):
            assert not allowed
        else:
            assert found.contains(x, v + (kappa - 1e-12) * (r - v)) or kappa == 0.0
            assert allowed[-1] <= kappa <= allowed[-1] + 1.0 / 400.0
            assert (kappa == 1.0) == found.contains(x, r)


def test_where_holding_is_not_admissible():
    found = cp.AdmissibleSet(first_order(), {"u": (-1.0, 1.0)}, 0.1)
    assert math.isnan(found.fraction([0.0], [1.5], [2.0]))
    assert found.fraction([0.0], [1.5], [0.5]) == 1.0
    assert abs(found.fraction([0.0], [1.5], [-2.5]) - 2.5 / 4.0) < 1e-3
    assert found.fraction([0.0], [1.0], [2.0]) == 0.0
    assert math.isnan(found.fraction([math.nan], [0.0], [0.0]))
    assert math.isnan(found.fraction([0.0], [0.0], [math.nan]))
    assert math.isnan(found.fraction([0.0], [0.0], [math.inf]))


# Disturbances


def shaken(zeta=0.3):
    return ct.ss(
        [[0, 1], [-4, -4 * zeta]], [[0, 0.5], [4, 1]], [[1, 0]], [[0, 0.2]], inputs=["r", "w"], outputs="y", states=2
    )


def worst(t, maximum):
    """Sup of y at t over |w| <= most from 0: what w = sign c e^(a (t - s)) b makes, and w passed on."""
    loop, h = shaken(), 0.004
    step = expm(loop.A * h)
    swing, size = loop.B[:, 1], 0.0
    for _ in range(round(t / h)):
        following = step @ swing
        size += 0.5 * h * (abs(swing[0]) + abs(following[0]))
        swing = following
    return maximum * (size + 0.2)


def test_disturbances_take_their_worst_from_the_limits_at_rest():
    maximum = 0.2
    found = cp.AdmissibleSet(shaken(), {"y": (-1.0, 1.0)}, 0.05, disturbances={"w": maximum})
    assert found.references == ("r",)
    room = 1.0 - MARGIN - worst(30.0, maximum)
    assert found.contains([0.998 * room, 0.0], [0.998 * room])
    assert not found.contains([1.002 * room, 0.0], [1.002 * room])


def test_no_bang_bang_disturbance_breaks_a_limit_and_one_does_just_outside():
    maximum, loop = 0.2, shaken()
    found = cp.AdmissibleSet(loop, {"y": (-1.0, 1.0)}, 0.05, disturbances={"w": maximum})
    times = np.linspace(0.0, 4.0, 41)
    lost = np.array([worst(t, maximum) for t in times])
    moved = np.array([(loop.C @ expm(loop.A * t))[0] for t in times])
    rng, broken = np.random.default_rng(5), 0
    for _ in range(20):
        x, v = rng.standard_normal(2), 0.1 * rng.standard_normal(1)
        inside, outside = 0.0, 100.0
        while outside - inside > 1e-6 * outside:
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if found.contains(middle * x, v) else (inside, middle)
        if not inside:
            continue

        def beyond(scale, x=x, v=v):
            rest = np.array([v[0], 0.0])
            free = moved @ (scale * x - rest) + v[0]
            return (np.abs(free) + lost).max() - 1.0

        assert beyond(inside) <= 0.0
        broken += beyond(1.05 * inside) > 0.0
    assert broken >= 15


def test_disturbances_that_leave_nothing():
    short = worst(30.0, 2.0) + MARGIN - 1.0
    with pytest.raises(
        ValueError, match=rf"must allow a steady state .* got limits too narrow by {short:.3g} of half their"
    ):
        cp.AdmissibleSet(shaken(), {"y": (-1.0, 1.0)}, 0.05, disturbances={"w": 2.0})


# What is given


def test_interconnections_count_with_the_matrices_of_their_blocks():
    inside = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    plain = ct.ss([[-1.0, -5.0], [1.0, 0.0]], [[5.0], [0.0]], [[0.0, -5.0]], [[5.0]], inputs="r", outputs="u")
    sets = [cp.AdmissibleSet(loop, {"u": (-1.0, 1.0)}, 0.05) for loop in (inside, plain)]
    assert sets[0].states == tuple(inside.state_labels)
    for x, v in zip(*np.random.default_rng(2).uniform(-1, 1, (2, 200, 2)), strict=True):
        assert sets[0].contains(x, v[:1]) == sets[1].contains(x, v[:1])


def test_transfer_functions_and_parts_of_the_inputs():
    found = cp.AdmissibleSet(ct.tf([2.0], [1.0, 2.0], inputs="r", outputs="y"), {"y": (-1.0, 1.0)}, 0.1)
    assert (found.references, len(found.states), found.dt) == (("r",), 1, 0.1)
    part = cp.AdmissibleSet(shaken(), {"y": (-1.0, 1.0)}, 0.1, references=["r"])
    assert part.reference_matrix.shape[1] == 1


def test_it_is_immutable():
    found = cp.AdmissibleSet(first_order(), {"u": (-1.0, 1.0)}, 0.1)
    with pytest.raises(AttributeError, match="immutable"):
        found.dt = 1.0
    with pytest.raises(ValueError, match="read-only"):
        found.bounds[0] = 5.0
    assert "2 rows" in repr(found)


GOOD = {"limits": {"u": (-1.0, 1.0)}, "dt": 0.1}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"limits": {"z": (-1, 1)}}, "limits must be among the outputs u, y, got 'z'"),
        ({"limits": {}}, "limits must name at least one output"),
        ({"limits": {"u": (1, 1)}}, "limits of u must increase, got 1 and 1"),
        ({"limits": {"u": (math.nan, 1)}}, "limits of u must be a number, got nan"),
        ({"limits": {"u": (-math.inf, math.inf)}}, "must contain a finite one"),
        ({"limits": {"u": (1, 2, 3)}}, "limits of u must be two numbers"),
        ({"limits": {"u": (1, 2)}}, "must allow a steady state .* too narrow by 2.01 of half"),  # u rests at 0
        ({"dt": 0.0}, "dt must be finite and above 0, got 0.0"),
        ({"dt": math.nan}, "dt must be finite"),
        ({"margin": 0.0}, r"margin must lie in \(0, 1\), got 0.0"),
        ({"margin": 1.0}, r"margin must lie in \(0, 1\), got 1.0"),
        ({"references": ["q"]}, "references must be among the inputs r, got 'q'"),
        ({"references": ["r", "r"]}, "references must not name an input twice"),
        ({"references": []}, "references must name at least one input"),
        ({"disturbances": {"r": 1.0}}, "references must name at least one input, got none"),
        ({"disturbances": {"r": 1.0}, "references": ["r"]}, r"disturbances must be among the inputs \(none\), got 'r'"),
    ],
)
def test_what_is_rejected(given, message):
    with pytest.raises(ValueError, match=message):
        cp.AdmissibleSet(first_order(), **{**GOOD, **given})


@pytest.mark.parametrize(
    ("pole", "message"), [(0.5, "pole of .* at 0.5 1/s"), (0.0, "got a pole of .* at 0 1/s"), (-0.0, "stable")]
)
def test_loops_that_are_not_stable(pole, message):
    with pytest.raises(ValueError, match=message):
        cp.AdmissibleSet(ct.ss([[pole]], [[1]], [[1]], 0, inputs="r", outputs="u"), **GOOD)


def test_loops_of_other_kinds():
    with pytest.raises(ValueError, match=r"continuous, got .* dt = 0.1"):
        cp.AdmissibleSet(ct.ss([[0.5]], [[1]], [[1]], 0, 0.1, inputs="r", outputs="u"), **GOOD)
    with pytest.raises(TypeError, match="StateSpace or TransferFunction, got NonlinearIOSystem"):
        cp.AdmissibleSet(ct.nlsys(lambda t, x, u, p: -x, None, inputs=1, outputs=1, states=1), **GOOD)
    with pytest.raises(ValueError, match="disturbances of w must be finite and at least 0, got -1"):
        cp.AdmissibleSet(shaken(), {"y": (-1, 1)}, 0.1, disturbances={"w": -1.0})


@pytest.mark.slow
def test_a_loop_that_swings_on_and_on():
    slow = ct.ss([[-1e-7, 300.0], [-300.0, -1.0]], [[1], [1]], [[1, 0]], 0, inputs="r", outputs="u")
    with pytest.raises(ValueError, match="time constants of the loop must not be too far apart"):
        cp.AdmissibleSet(slow, **GOOD)
