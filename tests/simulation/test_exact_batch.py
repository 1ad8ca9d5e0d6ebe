"""Exact states of many systems together, at even and uneven times, and between samples of the input."""

import control as ct
import mpmath as mp
import numpy as np
import pytest
from scipy.linalg import expm
from simulation_oracle import both, gap, lag_loop, polygon, response, step

import ctrlplan as cp
from ctrlplan.simulation import exact
from ctrlplan.simulation.exact import exact_states, sampled_states
from ctrlplan.simulation.linear import NotLinearError, linear_form, linear_forms

SMALL = 1e-11
"""Error bound, relative to the largest value of each signal."""
GAINS = [1e-3, 0.25, 0.26, 1.0, 5.0, 40.0, 1e3, 1e5]
REST = ([0.4, 1.7], [[[0.5, 0.0, 0.0], [2.0, 0.0, 0.0]]])
SPEED = ([-0.2, 0.9, 2.0], [[[0.0], [0.3, 2.0, -1.0], [-1.0, 4.0, 3.0]]])


def stacked(systems):
    return (np.stack([np.asarray(matrices[k], dtype=float) for matrices in systems]) for k in range(4))


def run(systems, plan, times, initial=None, **options):
    a, b, *_ = stacked(systems)
    state = np.zeros(a.shape[:2]) if initial is None else np.asarray(initial)
    return exact_states(a, b, plan.segment_jet_at, plan.breakpoints, np.asarray(times), state, **options)


def check(systems, plan, signals, times, initial=None, some=None, tolerance=SMALL):
    """Every system of the batch compared with its closed form, at some samples including the first."""
    found = run(systems, plan, times, initial)
    some = np.arange(len(times)) if some is None else np.asarray(some)
    for i, matrices in enumerate(systems):
        states = response(*matrices, signals, times[some], None if initial is None else initial[i])[1]
        assert gap(found[i][:, some], states) <= tolerance


# Many systems with one input


@pytest.mark.parametrize("count", [201, 2001])
def test_the_step_response_in_closed_form_at_every_gain(count):
    """Equation (1) corrected: y = 1 - (w_n/w_p) exp(-xi w_n t) sin(w_p t + arccos xi)."""
    gains = [0.1, 0.24999, 0.25001, 0.3, 1.0, 5.0, 20.0, 100.0, 1000.0]
    t = np.linspace(0.0, 20.0, count)
    found = run([lag_loop(gain) for gain in gains], cp.Step(1.0), t)[:, 1]
    some = np.arange(0, count, count // 100)
    for gain, y in zip(gains, found, strict=True):
        with mp.workdps(50):
            natural, damping = mp.sqrt(mp.mpf(gain)), 1 / (2 * mp.sqrt(mp.mpf(gain)))
            proper = natural * mp.sqrt(1 - damping**2)  # imaginary below 1/4: the same formula holds
            exact = [
                1 - natural / proper * mp.exp(-damping * natural * x) * mp.sin(proper * x + mp.acos(damping))
                for x in map(mp.mpf, t[some])
            ]
            exact = np.array([float(mp.re(value)) for value in exact])
        assert np.abs(y[some] - exact).max() <= 1e-12


def test_the_double_pole_among_others():
    # At k = 1/4: y = 1 - (1 + t/2) exp(-t/2).
    t = np.linspace(0.0, 20.0, 4001)
    found = run([lag_loop(gain) for gain in (0.25, 1000.0)], cp.Step(1.0), t)[0, 1]
    assert np.abs(found - (1 - (1 + t / 2) * np.exp(-t / 2))).max() <= 1e-12


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 5.0])
@pytest.mark.parametrize("count", [41, 4001])
def test_loops_of_every_gain_at_even_times(alpha, count):
    plan, signals = both(*REST, alpha)
    t = np.linspace(0.0, 9.0, count)
    check([lag_loop(gain) for gain in GAINS], plan, signals, t, some=np.arange(0, count, count // 20))


@pytest.mark.parametrize("systems", [GAINS[1:6], [5.0]])
@pytest.mark.parametrize("count", [451, 1801])
def test_breakpoints_that_are_sample_times(systems, count):
    """0.4 and 1.7 s, with few samples and with many in the cells of the move."""
    plan, signals = both(*REST, 4.0)
    t = np.linspace(0.0, 9.0, count)
    assert np.abs(t[:, None] - REST[0]).min(axis=0).max() < 1e-14
    check([lag_loop(gain) for gain in systems], plan, signals, t, some=np.arange(0, count, count // 15))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("even", [True, False])
def test_random_systems_with_random_states(even, seed):
    """Several inputs, breakpoints between the samples, stable and unstable systems side by side."""
    rng = np.random.default_rng([seed, even])
    n, alpha = int(rng.integers(1, 6)), rng.choice([0.0, 1.0, 4.0])
    (first, (one,)), (second, (other,)) = both(*REST, alpha), both(*SPEED, alpha)
    plan = cp.stack([first, second, cp.Step(1.0, time=0.77)], ["a", "b", "c"])
    systems = [
        (rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-1, 0.7), rng.normal(size=(n, 3)), np.eye(n), np.zeros((n, 3)))
        for _ in range(4)
    ]
    t = np.linspace(-0.5, 4.1, 300) if even else np.sort(rng.uniform(-0.5, 4.1, 60))
    initial = rng.normal(size=(4, n))
    some = np.unique([0, t.size - 1, *rng.integers(0, t.size, 20)])
    check(systems, plan, [one, other, step(1.0, 0.0, 0.77)], t, initial, some)


def test_a_batch_finds_what_its_members_find():
    plan, _ = both(*REST, 1.0)
    systems = [lag_loop(gain) for gain in GAINS]
    for t in (np.linspace(0.0, 20.0, 2001), np.linspace(0.0, 20.0, 2001) ** 2 / 20.0):
        together = run(systems, plan, t)
        for i in range(len(systems)):
            a, b, *_ = (matrix[i] for matrix in stacked(systems))
            alone = exact_states(a, b, plan.segment_jet_at, plan.breakpoints, t, np.zeros(2))
            assert gap(together[i], alone) <= SMALL


def test_combinations_of_states_in_their_place():
    plan, signals = both(*REST, 1.0)
    systems = [lag_loop(gain) for gain in GAINS]
    t, some = np.linspace(0.0, 5.0, 501), np.arange(0, 501, 25)
    read = np.stack([[[0.0, 1.0], [1.0, -2.0], [0.0, -gain]] for gain in GAINS])
    found = run(systems, plan, t, read=read)
    for i, matrices in enumerate(systems):
        states = response(*matrices, signals, t[some])[1]
        assert gap(found[i][:, some], read[i] @ states) <= SMALL


def test_systems_without_states():
    plan, _ = both(*REST, 1.0)
    found = exact_states(
        np.zeros((3, 0, 0)), np.zeros((3, 0, 1)), plan.segment_jet_at, [], np.linspace(0, 1, 5), np.zeros((3, 0))
    )
    assert found.shape == (3, 0, 5)


def test_even_samples_with_gaps_before_and_after():
    """A burst of even samples far from both ends of a segment: it is no even segment."""
    plan, signals = both([0.0, 30.0], REST[1], 1.0)
    t = np.concatenate([[-1.0], np.linspace(17.3, 17.4, 101), [40.0]])
    check([lag_loop(5.0), lag_loop(300.0)], plan, signals, t, some=[0, 1, 50, 101, 102])


def test_a_stiff_system_next_to_a_slow_one():
    plan, signals = both(*REST, 1.0)
    systems = [
        ([[-fast, 0.0], [slow, -slow]], [[fast], [0.0]], [[0.0, 1.0]], [[0.0]])
        for fast, slow in ((1e6, 0.03), (1e3, 1.0), (2.0, 1e-3))
    ]
    check(systems, plan, signals, np.linspace(0.0, 10.0, 1001), some=np.arange(0, 1001, 40))


def test_one_system_that_leaves_the_range_of_numbers_spoils_no_other():
    t = np.linspace(0.0, 20.0, 401)
    systems = [([[100.0]], [[1.0]], [[1.0]], [[0.0]]), ([[-1.0]], [[1.0]], [[1.0]], [[0.0]])]
    with np.errstate(over="ignore", invalid="ignore"):
        wild, calm = run(systems, cp.Step(1.0), t)[:, 0]
    inside = t <= 7.0
    assert np.abs(wild[inside][1:] / (np.expm1(100 * t[inside][1:]) / 100) - 1).max() <= 1e-11
    assert not np.isfinite(wild[t >= 7.5]).any()
    assert np.abs(calm - (1 - np.exp(-t))).max() <= 1e-14


# Their matrices


def test_loops_flattened_together_are_those_flattened_alone():
    loops = [cp.plants.integrator_lag_loop(gain, ("y", "u", "e")) for gain in GAINS]
    form = linear_forms(loops)
    for i, gain in enumerate(GAINS):
        alone = linear_form(loops[i])
        for name, expected in zip("abcd", lag_loop(gain), strict=True):
            np.testing.assert_allclose(getattr(form, name)[i], expected, rtol=1e-15)
            np.testing.assert_array_equal(getattr(form, name)[i], getattr(alone, name))
    assert form.sources == ()


@pytest.mark.parametrize(
    "other",
    [
        ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]),
        ct.tf([1.0], [1.0, 1.0]),
        cp.plants.unity_feedback_loop([1.0], [1.0, 2.0, 3.0, 4.0]),
        cp.plants.integrator_lag_loop(5.0, ("u", "y")),
        ct.interconnect(
            [cp.plants.integrator_lag_loop(5.0), ct.ss([], [], [], [[2.0]], inputs="y", outputs="z", dt=0)],
            inputs="r",
            outputs=["z"],
        ),
    ],
    ids=["matrices", "fraction", "order", "outputs", "blocks"],
)
def test_systems_that_differ_in_more_than_numbers(other):
    with pytest.raises(ValueError, match="systems must differ only in numerical values"):
        linear_forms([cp.plants.integrator_lag_loop(5.0), other])


def test_one_nonlinear_block_among_the_systems():
    with pytest.raises(NotLinearError, match="block bent"):
        linear_forms(
            [ct.ss(0, 1, 1, 0), ct.nlsys(None, lambda t, x, u, params: u**3, inputs=1, outputs=1, name="bent")]
        )


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_one_loop_without_a_solution_among_others(bad):
    def loop(through):
        blocks = [
            ct.ss([], [], [], [[through]], inputs="a", outputs="b", name="one", dt=0),
            ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.5]], inputs="b", outputs="a", name="two", dt=0),
        ]
        system = ct.InterconnectedSystem(blocks, inputs=1, outputs=1, inplist=["one.a"], outlist=["two.a"])
        system.set_connect_map(np.array([[0.0, 1.0], [1.0, 0.0]]))
        return system

    values = [0.0, 1.0, 3.0]
    assert np.isfinite(linear_forms([loop(value) for value in values]).a).all()
    values[bad] = 2.0  # 1 - 2/2 = 0
    with pytest.raises(ValueError, match="algebraic loop without a solution, got one of one, two"):
        linear_forms([loop(value) for value in values])


# An input between its samples


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("even", [True, False])
def test_random_samples_into_random_systems(even, seed):
    rng = np.random.default_rng([seed, even])
    n, m, count = int(rng.integers(1, 6)), int(rng.integers(1, 4)), int(rng.integers(2, 60))
    a = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-1, 0.5)
    b, initial, samples = rng.normal(size=(n, m)), rng.normal(size=n), rng.normal(size=(m, count))
    t = np.linspace(-1.0, 5.0, count) if even else np.unique(rng.uniform(-1.0, 5.0, count))
    found = sampled_states(a, b, samples[:, : t.size], t, initial)
    signals = [polygon(t, row) for row in samples[:, : t.size]]
    states = response(a, b, np.eye(n), np.zeros((n, m)), signals, t, initial)[1]
    assert gap(found, states) <= SMALL
    np.testing.assert_array_equal(found[:, 0], initial)


@pytest.mark.parametrize("stiffness", [1e3, 1e6])
def test_samples_into_a_slow_mode_next_to_a_fast_one(stiffness):
    rng = np.random.default_rng(3)
    a, b = np.array([[-stiffness, 0.0], [0.03, -0.03]]), np.array([[stiffness], [0.0]])
    t, u = np.linspace(0.0, 30.0, 61), rng.normal(size=61)
    states = response(a, b, np.eye(2), np.zeros((2, 1)), [polygon(t, u)], t)[1]
    assert gap(sampled_states(a, b, u[None], t, np.zeros(2)), states) <= SMALL


@pytest.mark.parametrize("bend", [1.0, 1.3])
@pytest.mark.parametrize("numbers", [2**20, 5000])
def test_a_ramp_at_many_samples(bend, numbers, monkeypatch):
    # x' = -x + t: x = t - 1 + exp(-t), whatever the times, and however many are computed together.
    monkeypatch.setattr(exact, "_NUMBERS", numbers)
    t = 20.0 * np.linspace(0.0, 1.0, 20_001) ** bend
    found = sampled_states(np.array([[-1.0]]), np.array([[1.0]]), t[None], t, np.zeros(1))[0]
    assert np.abs(found - (t - 1 + np.exp(-t))).max() <= 1e-13


def test_next_to_forced_response():
    """Which takes its input for linear between even samples, too."""
    rng = np.random.default_rng(5)
    system = ct.ss([[0.0, 1.0], [-4.0, -0.6]], [[0.0, 0.5], [1.0, 0.0]], np.eye(2), np.zeros((2, 2)))
    t, u = np.linspace(0.0, 10.0, 1001), rng.normal(size=(2, 1001))
    found = sampled_states(system.A, system.B, u, t, np.array([1.0, -1.0]))
    assert gap(found, ct.forced_response(system, t, u, [1.0, -1.0]).states) <= 1e-10


@pytest.mark.parametrize(("n", "m"), [(1, 150), (2, 100), (8, 20), (9, 20), (40, 60)])
@pytest.mark.parametrize("even", [True, False])
def test_samples_of_many_inputs(even, n, m):
    rng = np.random.default_rng([n, m])
    a, b, initial = rng.normal(size=(n, n)) / n**0.5 - np.eye(n), rng.normal(size=(n, m)), rng.normal(size=n)
    t = np.linspace(0.0, 3.0, 31) if even else np.sort(rng.uniform(0.0, 3.0, 31))
    u = np.where(np.arange(m)[:, None] % 2, rng.normal(size=(m, 31)), np.sin(t + np.arange(m)[:, None]))
    states, zero = [initial], np.zeros((m, n))
    for k, h in enumerate(np.diff(t)):  # state, input and change of the input form one system without input
        whole = np.block([[a * h, b * h, 0 * b], [zero, np.zeros((m, m)), np.eye(m)], [zero, np.zeros((m, 2 * m))]])
        states.append((expm(whole) @ np.concatenate([states[-1], u[:, k], u[:, k + 1] - u[:, k]]))[:n])
    found = sampled_states(a, b, u, t, initial)
    assert gap(found, np.transpose(states)) <= SMALL
    system = ct.ss(a, b, np.eye(n), 0)
    assert np.array_equal(cp.simulate(system, t, u, initial).states, found)
    assert np.array_equal(cp.simulate(system, t, list(u), initial).states, found)


def test_many_inputs_with_the_same_breakpoints_are_solved_by_segments(monkeypatch):
    from ctrlplan.simulation.methods import exact as method

    monkeypatch.setattr(method, "moment_states", None)  # for many different breakpoints only
    t, values = np.linspace(0.0, 4.0, 101), np.linspace(-1.0, 2.0, 60)
    system = ct.ss(-1.0, np.ones((1, 60)), 1.0, np.zeros((1, 60)))
    found = cp.simulate(system, t, values).outputs
    assert np.abs(found - values.sum() * (1.0 - np.exp(-t))).max() <= 1e-13 * np.abs(values).sum()
    steps = [cp.Step(value, time=1.0) for value in values]
    found = cp.simulate(system, t, steps).outputs
    assert np.abs(found - values.sum() * (1.0 - np.exp(np.minimum(1.0 - t, 0.0)))).max() <= 1e-13 * np.abs(values).sum()


def test_samples_without_states_or_inputs():
    t = np.linspace(0.0, 2.0, 9)
    assert sampled_states(np.zeros((0, 0)), np.zeros((0, 1)), np.ones((1, 9)), t, np.zeros(0)).shape == (0, 9)
    found = sampled_states(np.array([[-1.0]]), np.zeros((1, 0)), np.zeros((0, 9)), t, np.array([2.0]))
    assert np.abs(found[0] - 2 * np.exp(-t)).max() <= 1e-15
