"""Metrics of signals that discrete controllers hold, against recursions from instant to instant.

The expected values are integrals, maxima and sums over the held values themselves, whatever the sample times are.
"""

import control as ct
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import ctrlplan as cp

STEP = {"step": cp.Step(1.0)}
END = 10.0
GRIDS = [
    np.linspace(0, END, 101),
    np.linspace(0, END, 301),
    np.linspace(0, END, 1000),
    np.linspace(0, END, 10_001),
    np.unique(np.r_[0.0, END, np.random.default_rng(3).uniform(0, END, 177)]),
    np.array([0.0, 1.37, 2.2, END]),
]
MATRIX = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
"""Flow of 1/(s^2 + s) and of the held control."""


def plant(**names):
    labels = {"inputs": "u", "outputs": "y", "name": "plant"} | names
    return ct.ss([[0, 1], [0, -1.0]], [[0], [1.0]], [[1, 0]], 0, **labels)


def law(period, gain=2.0, **names):
    labels = {"inputs": ["r", "y"], "outputs": "u", "name": "law"} | names
    return ct.ss([[1.0]], [[period, -period]], [[0.5]], [[gain, -gain]], period, **labels)


def loop(period=0.1, offset=0.0, gain=2.0, outputs=("y", "u")):
    blocks = [plant(), cp.sample_hold(law(period, gain), period, offset)]
    return ct.interconnect(blocks, inputs="r", outputs=list(outputs))


def staircase(period=0.1, offset=0.0, gain=2.0, end=END):
    """Times and values of the control: 0 until the first instant."""
    x, xi, t, u = np.zeros(2), 0.0, 0.0, 0.0
    times, values = [0.0], [0.0]
    for k in range(int((end - offset) / period + 1e-9) + 1):
        instant = offset + period * k
        x, t = (expm(MATRIX * (instant - t)) @ np.r_[x, u])[:2], instant
        u, xi = 0.5 * xi + gain * (1.0 - x[0]), xi + period * (1.0 - x[0])
        times.append(instant)
        values.append(u)
    return (np.array(times[1:]), np.array(values[1:])) if offset == 0.0 else (np.array(times), np.array(values))


def expected(times, values, end=END):
    """Effort, peak and total variation of a staircase."""
    lengths = np.diff(np.append(times, end))
    return {
        "control_effort": float(np.sum(values**2 * lengths)),
        "control_peak": float(np.abs(values).max()),
        "control_variation": float(np.abs(np.diff(values)).sum()),
    }


def close(found, wanted, rel=1e-12, suffix=""):
    for name, value in wanted.items():
        assert found[name + suffix] == pytest.approx(value, rel=rel), name


@pytest.mark.parametrize("times", GRIDS, ids=[str(t.size) for t in GRIDS])
@pytest.mark.parametrize(("period", "offset"), [(0.1, 0.0), (0.1, 0.03), (0.07, 0.0123)])
def test_a_held_control_has_the_metrics_of_its_values(times, period, offset):
    found = cp.compare(loop(period, offset), STEP, times)
    close(found.metrics["step"], expected(*staircase(period, offset)))
    response = found.responses["step"]
    np.testing.assert_array_equal(response.time, times)
    np.testing.assert_array_equal(response.outputs, cp.simulate(loop(period, offset), times, STEP["step"]).outputs)


def test_the_known_effort_of_the_example():
    assert expected(*staircase())["control_effort"] == pytest.approx(4.836738325, abs=5e-10)


def two_rates(first, second, offset):
    """Two controls of different periods, their sum, and one of them passed through a delay."""
    blocks = [
        ct.ss([[-1.0, 0.3], [0, -2.0]], np.eye(2), np.eye(2), 0, inputs=["u", "v"], outputs=["y", "z"], name="plant"),
        cp.sample_hold(ct.ss([], [], [], [[3, -3.0]], first, inputs=["r", "y"], outputs="u", name="one"), first),
        cp.sample_hold(
            ct.ss([], [], [], [[1.0, -4.0]], second, inputs=["r", "z"], outputs="v", name="other"), second, offset
        ),
        ct.ss([], [], [], [[1.0, 0.5]], inputs=["u", "v"], outputs="usum", name="sum", dt=None),
    ]
    return ct.interconnect(blocks, inputs="r", outputs=["y", "u", "v", "usum"])


@pytest.mark.parametrize("times", [np.linspace(0, 2, 33), np.linspace(0, 2, 2001)], ids=["33", "2001"])
@pytest.mark.parametrize(("first", "second", "offset"), [(0.1, 0.03, 0.0), (0.05, 0.05 * np.sqrt(2), 0.013)])
def test_several_rates(first, second, offset, times):
    matrix = np.zeros((4, 4))
    matrix[:2] = [[-1.0, 0.3, 1, 0], [0, -2.0, 0, 1]]
    every = [(k * first, 2) for k in range(int(2 / first + 1e-9) + 1)]
    every += [(offset + k * second, 3) for k in range(int((2 - offset) / second + 1e-9) + 1)]
    z, t, held = np.zeros(4), 0.0, {}
    for instant, which in sorted((round(t, 12), which) for t, which in every):
        z, t = expm(matrix * (instant - t)) @ z, instant
        z[which] = 3 * (1 - z[0]) if which == 2 else 1.0 - 4 * z[1]
        held[instant] = z[2:].copy()
    marks, values = np.array(list(held)), np.array(list(held.values())).T
    found = cp.compare(two_rates(first, second, offset), STEP, times, controls=["u", "v", "usum"]).metrics["step"]
    for name, row in (("u", values[0]), ("v", values[1]), ("usum", values[0] + 0.5 * values[1])):
        close(found, expected(marks, row, 2.0), suffix=f"_{name}")


@pytest.mark.parametrize("initial", [0.0, 0.7])
@pytest.mark.parametrize("delay", [0.2, 0.25, 0.333, 5.0])
@pytest.mark.parametrize("size", [101, 1234])
def test_a_delayed_held_control(delay, initial, size):
    late = cp.create_delay_iosystem(delay, initial=initial, inputs="u", outputs="ulate")
    blocks = [plant(), cp.sample_hold(law(0.1), 0.1), late]
    both = ct.interconnect(blocks, inputs="r", outputs=["y", "ulate"])
    times, values = staircase()
    times, values = np.append(0.0, times + delay), np.append(initial, values)
    inside = times <= END + 1e-9
    grid = np.linspace(0, END, size)
    found = cp.compare(both, STEP, grid, controls=["ulate"], initial_state=0.0).metrics["step"]
    close(found, expected(times[inside], values[inside]))


@pytest.mark.parametrize("size", [60, 1001])
def test_a_held_control_in_a_loop_with_a_delay_between_continuous_blocks(size):
    slow = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="v", outputs="y", name="slow")
    late = cp.create_delay_iosystem(0.37, inputs="w", outputs="v")
    fast = ct.ss(-3.0, 3.0, 1.0, 0.0, inputs="u", outputs="w", name="fast")
    held = ct.ss([], [], [], [[0.8, -0.8]], 0.1, inputs=["r", "y"], outputs="u", name="law")
    further = cp.create_delay_iosystem(0.15, inputs="u", outputs="ulate", name="further")
    blocks = [slow, late, fast, cp.sample_hold(held, 0.1), further]
    both = ct.interconnect(blocks, inputs="r", outputs=["y", "u", "ulate"])
    values = cp.simulate(both, 0.1 * np.arange(51), STEP["step"]).outputs[1]  # its sample times
    found = cp.compare(both, STEP, np.linspace(0, 5, size), controls=["u", "ulate"]).metrics["step"]
    marks = 0.1 * np.arange(51)
    close(found, expected(marks, values, 5.0), 1e-9, "_u")
    marks, values = np.append(0.0, marks + 0.15), np.append(0.0, values)
    close(found, expected(marks[marks <= 5.0], values[marks <= 5.0], 5.0), 1e-9, "_ulate")


@pytest.mark.parametrize("size", [101, 997])
def test_a_run_that_an_event_ends(size):
    times, values = staircase()

    def position(t):
        x, k = np.zeros(2), 0
        for k, start in enumerate(times):
            if start > t:
                break
            x = (expm(MATRIX * (min(t, times[k + 1]) - start)) @ np.r_[x, values[k]])[:2]
        return x[0]

    end = brentq(lambda t: position(t) - 0.65, 0.1, 3.0, xtol=1e-15)
    grid = np.linspace(0, END, size)
    found = cp.compare(loop(), STEP, grid, events=[cp.Event("y", high=0.65, stop=True)])
    assert found.stopped["step"] == pytest.approx(end, abs=1e-9)
    inside = times <= end
    close(found.metrics["step"], expected(times[inside], values[inside], end), 1e-8)


def test_metrics_count_from_the_first_sample_of_their_interval():
    times, values = staircase()
    grid = np.linspace(0, END, 333)
    start = grid[grid >= 2.05][0]
    found = cp.compare(loop(), STEP, grid, start=2.05).metrics["step"]
    before = values[times <= start][-1]
    marks, inside = times[times > start], values[times > start]
    close(found, expected(np.append(start, marks), np.append(before, inside)))


GAINS = [1.0, 2.0, 2.7]


def built(gain):
    return loop(gain=gain)


def parametrised():
    """The same loop with the gain in a nonlinear block in front of the law."""
    scale = ct.nlsys(
        None, lambda t, x, u, p: p.get("gain", 2.0) * (u[0] - u[1]), inputs=["r", "y"], outputs="e", name="scale"
    )
    inner = ct.ss([], [], [], [[1.0]], 0.1, inputs="e", outputs="u", name="law")
    return ct.interconnect([plant(), scale, cp.sample_hold(inner, 0.1)], inputs="r", outputs=["y", "u"])


def proportional(gain):
    """Times and values of the control of a proportional law."""
    x, values = np.zeros(2), []
    for _ in range(101):
        values.append(gain * (1.0 - x[0]))
        x = (expm(MATRIX * 0.1) @ np.r_[x, values[-1]])[:2]
    return 0.1 * np.arange(101), np.array(values)


@pytest.mark.parametrize("size", [101, 334])
def test_monte_carlo_of_a_function(size):
    draws = {"gain": np.array(GAINS)}
    found = cp.monte_carlo(built, draws, STEP, np.linspace(0, END, size), progress=False)
    for k, gain in enumerate(GAINS):
        close({name: values[k] for name, values in found.metrics["step"].items()}, expected(*staircase(gain=gain)))
    assert found.timepts.size == size


@pytest.mark.parametrize("size", [101, 334])
def test_monte_carlo_of_a_loop_with_parameters(size):
    draws = {"gain": np.array(GAINS)}
    found = cp.monte_carlo(parametrised(), draws, STEP, np.linspace(0, END, size), progress=False)
    for k, gain in enumerate(GAINS):
        metrics = {name: values[k] for name, values in found.metrics["step"].items()}
        close(metrics, expected(*proportional(gain)), 1e-6)


def test_sweep():
    found = cp.sweep(built, GAINS, STEP, np.linspace(0, END, 222), progress=False)
    for k, gain in enumerate(GAINS):
        close({name: values[k] for name, values in found.metrics["step"].items()}, expected(*staircase(gain=gain)))


@pytest.mark.parametrize("size", [41, 333])
@pytest.mark.parametrize("traced", [True, False])
def test_a_nonlinear_loop_with_a_saturated_control(size, traced):
    """The control passes a saturation, which has no states, and a delay."""

    def limited(t, x, u, p):
        return np.clip(u, -0.8, 0.8) if traced else np.array([max(-0.8, min(0.8, float(u[0])))])

    def swing(t, x, u, p):
        if traced:
            return np.array([x[1], -np.sin(x[0]) - 0.5 * x[1] + u[0]])
        return np.array([float(x[1]), -float(np.sin(float(x[0]))) - 0.5 * float(x[1]) + float(u[0])])

    pendulum = ct.nlsys(swing, lambda t, x, u, p: x[:1], states=2, inputs="usat", outputs="y", name="pendulum")
    clip = ct.nlsys(None, limited, inputs="u", outputs="usat", name="clip")
    late = cp.create_delay_iosystem(0.13, inputs="u", outputs="ulate", name="late")
    blocks = [pendulum, clip, late, cp.sample_hold(law(0.2), 0.2, 0.05)]
    whole = ct.interconnect(blocks, inputs="r", outputs=["y", "u", "usat", "ulate"])
    x, xi, u, t = np.zeros(2), 0.0, 0.0, 0.0
    marks, values = [0.0], [0.0]
    for k in range(25):
        instant, held = 0.05 + 0.2 * k, float(np.clip(u, -0.8, 0.8))
        right = lambda _, x, held=held: [x[1], -np.sin(x[0]) - 0.5 * x[1] + held]  # noqa: E731
        x, t = solve_ivp(right, (t, instant), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1], instant
        u, xi = 0.5 * xi + 2.0 * (1.0 - x[0]), xi + 0.2 * (1.0 - x[0])
        marks.append(instant)
        values.append(u)
    found = cp.compare(whole, STEP, np.linspace(0, 5, size), controls=["u", "usat", "ulate"]).metrics["step"]
    marks, values = np.array(marks), np.array(values)
    close(found, expected(marks, values, 5.0), 1e-6, "_u")
    close(found, expected(marks, np.clip(values, -0.8, 0.8), 5.0), 1e-6, "_usat")
    marks = np.append(0.0, marks[1:] + 0.13)
    close(found, expected(marks[marks <= 5.0], values[marks <= 5.0], 5.0), 1e-6, "_ulate")


@pytest.mark.parametrize("size", [101, 450])
def test_errors_of_a_held_output(size):
    """Metrics of responses where the output that follows the plan is the held control itself."""
    times, values = staircase()
    found = cp.compare(loop(), STEP, np.linspace(0, END, size), outputs=["u"], band=0.1).metrics["step"]
    error, lengths = 1.0 - values[:-1], np.diff(times)
    squares = (times[1:] ** 2 - times[:-1] ** 2) / 2
    wanted = {
        "iae": np.sum(np.abs(error) * lengths),
        "ise": np.sum(error**2 * lengths),
        "itae": np.sum(np.abs(error) * squares),
        "overshoot_error": 100.0 * (values.max() - 1.0),
        "lag_error": 100.0 * (1.0 - values.min()),
        "settling_time": np.inf,
    }
    close(found, wanted)


@pytest.mark.parametrize("size", [101, 450])
def test_a_held_output_settles_at_an_instant(size):
    feed = cp.sample_hold(ct.ss(0.8, 1.0, 0.2, 0.0, 0.1, inputs="r", outputs="y", name="lag"), 0.1)
    whole = ct.interconnect([feed], inputs="r", outputs="y")
    found = cp.compare(whole, STEP, np.linspace(0, END, size)).metrics["step"]
    values = 1.0 - 0.8 ** np.arange(101)
    first = np.flatnonzero(np.abs(values - 1.0) > 0.02)[-1] + 1
    assert found["settling_time"] == pytest.approx(0.1 * first, abs=1e-12)


@pytest.mark.parametrize("size", [401, 1750])
def test_an_error_between_a_smooth_plan_and_a_held_output(size):
    """The output samples the plan: r - y is a saw with known jumps."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(4, 1, 0, 0)])
    hold = cp.sample_hold(ct.ss([], [], [], [[1.0]], 0.13, inputs="r", outputs="y", name="hold"), 0.13)
    whole = ct.interconnect([hold], inputs="r", outputs="y")
    found = cp.compare(whole, {"plan": plan}, np.linspace(0, 4, size)).metrics["plan"]
    iae = ise = largest = 0.0
    for k in range(31):
        left, right = 0.13 * k, min(4.0, 0.13 * (k + 1))
        start = float(plan(left))
        iae += quad(lambda t, start=start: float(plan(t)) - start, left, right, epsabs=1e-14)[0]
        ise += quad(lambda t, start=start: (float(plan(t)) - start) ** 2, left, right, epsabs=1e-14)[0]
        largest = max(largest, float(plan(right)) - start)
    close(found, {"iae": iae, "ise": ise, "lag_error": 100.0 * largest}, 2e-8)


@pytest.mark.parametrize("size", [1001, 4003])
def test_a_signal_with_a_held_part(size):
    """A control that is the sum of a smooth signal and of a held one: known jumps, smooth in between."""
    both = ct.ss([], [], [], [[1.0, 0.5]], inputs=["y", "u"], outputs="umix", name="sum", dt=None)
    blocks = [plant(), cp.sample_hold(law(0.3), 0.3), both]
    whole = ct.interconnect(blocks, inputs="r", outputs=["y", "umix"])
    times, values = staircase(0.3)
    x, effort, largest, change, before = np.zeros(2), 0.0, 0.0, 0.0, None
    for start, stop, u in zip(times, np.append(times[1:], END), values, strict=True):

        def signal(t, start=start, x=x, u=u):
            return (expm(MATRIX * (t - start)) @ np.r_[x, u])[0] + 0.5 * u

        fine = np.array([signal(t) for t in np.linspace(start, stop, 201)])
        effort += quad(lambda t, signal=signal: signal(t) ** 2, start, stop, epsabs=1e-13)[0]
        largest = max(largest, np.abs(fine).max())
        change += np.abs(np.diff(fine)).sum() + (0.0 if before is None else abs(fine[0] - before))
        x, before = (expm(MATRIX * (stop - start)) @ np.r_[x, u])[:2], fine[-1]
    found = cp.compare(whole, STEP, np.linspace(0, END, size)).metrics["step"]
    assert found["control_effort"] == pytest.approx(effort, rel=2e-7)
    assert found["control_peak"] == pytest.approx(largest, rel=1e-6)
    assert found["control_variation"] == pytest.approx(change, rel=1e-5)


def test_metrics_of_a_continuous_loop_remain():
    """Without discrete blocks, the metrics are those of the samples."""
    whole = ct.interconnect(
        [plant(), ct.ss([], [], [], [[2.0, -2.0]], inputs=["r", "y"], outputs="u", name="law")],
        inputs="r",
        outputs=["y", "u"],
    )
    times = np.linspace(0, END, 301)
    found = cp.compare(whole, STEP, times)
    u = found.responses["step"].outputs[1]
    metrics = found.metrics["step"]
    assert metrics["control_effort"] == cp.metrics.effort(times, u)
    assert metrics["control_peak"] == cp.metrics.peak(times, u)
    assert metrics["control_variation"] == cp.metrics.total_variation(times, u)
