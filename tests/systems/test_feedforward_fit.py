"""Feedforward from a log: gains and delays that are known, intervals counted over many logs."""

import math
import re
import warnings

import control as ct
import numpy as np
import pytest
from scipy.signal import lfilter

import ctrlplan as cp

GAINS = {"static": 0.5, "velocity": 0.25, "acceleration": 0.06}
DELAY = 1.3e-3


def moves(*points):
    return cp.PiecewiseSpline([cp.Waypoint(t, y, 0, 0) for t, y in points])


# 10 s of moves between 0.4 s and 1.2 s; and a shorter log of three moves.
PLAN = moves((0, 0), (0.6, 1), (0.8, 1), (1.2, 0.4), (1.4, 0.4), (2.2, 1.5), (2.4, 1.5), (3.6, 0), (3.8, 0), (4.2, 0.6),
             (4.4, 0.6), (5, 1.4), (5.2, 1.4), (6, 0.2), (6.2, 0.2), (6.6, 0.8), (6.8, 0.8), (8, -0.3), (8.2, -0.3),
             (8.7, 0.5), (8.9, 0.5), (9.8, 0), (10, 0))  # fmt: skip
SHORT = moves((0, 0), (0.7, 1), (0.9, 1), (1.4, 0.4), (1.6, 0.4), (2.4, -0.2), (2.6, -0.2))
TIMES = np.arange(0.0, 10.0, 1e-3)


def control_of(plan, t, gains=GAINS, delay=DELAY):
    """The control that the terms need, written out."""
    y, v, a, j = plan.jet(t + delay, 3)[:, 0]
    parts = {"static": np.sign(v), "velocity": v, "acceleration": a, "jerk": j, "gravity": 1.0, "spring": np.sin(y)}
    return sum(gain * parts[name] for name, gain in gains.items())


def coloured(rng, n, rho):
    return lfilter([math.sqrt(1.0 - rho**2)], [1.0, -rho], rng.normal(size=n + 1000))[1000:]


def logged(plan=PLAN, t=TIMES, seed=None, deviation=0.01, rho=0.0, position=None, **options):
    """Log with noise on the control, relative to its peak, and on the position, relative to its range."""
    u = control_of(plan, t, **options)
    table = {"time": t, "u": u}
    rng = np.random.default_rng(seed)
    if seed is not None:
        table["u"] = u + deviation * np.abs(u).max() * coloured(rng, t.size, rho)
    if position is not None:
        y = plan(t).ravel()
        table["y"] = y + position * np.ptp(y) * rng.normal(size=t.size)
    return cp.read_log(table, max_gap=np.inf)


def errors(fit, gains=GAINS):
    return {name: abs(fit.gains[name] / gain - 1.0) for name, gain in gains.items()}


# Accuracy


def test_the_log_is_that_of_the_promise():
    """At least 10 s, friction at least 15 %, acceleration at least a third of the peak control."""
    u = control_of(PLAN, TIMES)
    peak = np.abs(u).max()
    assert GAINS["static"] / peak >= 0.15
    assert GAINS["acceleration"] * PLAN.peak(2)[0] / peak >= 1.0 / 3.0


@pytest.mark.parametrize("seed", range(10))
def test_with_the_plan_gains_to_two_percent_and_the_delay_to_a_fifth_of_a_millisecond(seed):
    fit = cp.fit_feedforward(logged(seed=seed), PLAN)
    assert max(errors(fit).values()) <= 0.02
    assert abs(fit.delay - DELAY) <= 2e-4
    for name, gain in GAINS.items():
        assert abs(fit.gains[name] - gain) <= 4.0 * fit.standard_errors[name]


@pytest.mark.parametrize("seed", range(10))
def test_with_measured_positions_gains_to_five_percent(seed):
    fit = cp.fit_feedforward(logged(seed=seed, position=1e-4))
    assert max(errors(fit).values()) <= 0.05
    for name, gain in GAINS.items():
        assert abs(fit.gains[name] - gain) <= 4.0 * fit.standard_errors[name]
    assert "low-pass filter" in fit.notes[0]


@pytest.mark.parametrize("seed", range(5))
def test_a_short_log_is_within_three_standard_errors(seed):
    t = np.arange(0.0, 2.6, 1e-3)
    for rho in (0.0, 0.9):
        fit = cp.fit_feedforward(logged(SHORT, t, seed, rho=rho), SHORT)
        for name, gain in GAINS.items():
            assert abs(fit.gains[name] - gain) <= 3.2 * fit.standard_errors[name]
            row = next(line for line in str(fit).splitlines() if line.strip().startswith(name))
            assert f"{fit.standard_errors[name]:.4g}" in row
    assert fit.correlation == pytest.approx(0.9, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_intervals_contain_the_true_gain_as_often_as_they_say(rho):
    t = np.arange(0.0, 2.6, 1e-3)
    inside = np.zeros(len(GAINS))
    for seed in range(80):
        fit = cp.fit_feedforward(logged(SHORT, t, seed, rho=rho), SHORT)
        inside += [
            low <= gain <= high for gain, (low, high) in zip(GAINS.values(), fit.intervals.values(), strict=True)
        ]
    assert ((inside >= 0.88 * 80) & (inside <= 0.99 * 80)).all()


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_intervals_from_positions_contain_the_true_gain_at_least_as_often(rho):
    inside = np.zeros(len(GAINS))
    for seed in range(50):
        fit = cp.fit_feedforward(logged(seed=seed, position=1e-4, rho=rho))
        inside += [
            low <= gain <= high for gain, (low, high) in zip(GAINS.values(), fit.intervals.values(), strict=True)
        ]
    assert (inside >= 0.88 * 50).all()


ALL = {"static": -0.4, "velocity": 0.3, "acceleration": 0.05, "jerk": 2e-3, "gravity": 1.7, "spring": -0.8}
TERMS = ["static", "velocity", "acceleration", "jerk", "gravity", ("spring", np.sin)]


def test_without_noise_every_term_is_exact():
    fit = cp.fit_feedforward(logged(gains=ALL, delay=-0.012), PLAN, terms=TERMS)
    assert max(errors(fit, ALL).values()) < 1e-6
    assert abs(fit.delay + 0.012) < 1e-9
    assert list(fit.gains) == list(ALL)


def test_from_positions_without_noise_every_term_is_close():
    """The filter acts on both sides, so what remains is the interpolation between samples."""
    fit = cp.fit_feedforward(logged(gains=ALL, position=0.0), terms=TERMS)
    assert max(errors(fit, ALL).values()) < 5e-3


@pytest.mark.parametrize("delay", [-0.15, 0.0, 0.04, 0.3])
def test_delays_of_any_size(delay):
    fit = cp.fit_feedforward(logged(seed=3, delay=delay), PLAN)
    assert abs(fit.delay - delay) <= 2e-4
    assert abs(fit.delay - delay) <= 4.0 * fit.delay_error
    assert ("The delay is negative" in str(fit)) == (delay < 0.0)


def test_units_of_the_log_do_not_matter():
    plain, table = cp.fit_feedforward(logged(seed=5), PLAN), logged(seed=5)
    scaled = cp.read_log({"time": table.time, "u": 1e6 * table.outputs})
    micro = cp.fit_feedforward(scaled, 1e-9 * PLAN)
    for name, power in (("static", 1e6), ("velocity", 1e15), ("acceleration", 1e15)):
        assert micro.gains[name] == pytest.approx(power * plain.gains[name], rel=1e-6)
    assert micro.delay == pytest.approx(plain.delay, rel=1e-4)


def test_uneven_samples_of_positions():
    t = np.sort(np.random.default_rng(2).uniform(0.0, 10.0, 20000))
    with pytest.warns(UserWarning, match="intervals of the gains are too narrow"):
        fit = cp.fit_feedforward(logged(t=t, seed=1, position=1e-5))
    assert max(errors(fit).values()) <= 0.02


def test_missing_samples_of_positions():
    """A few lost samples do no harm; long gaps do, unless the plan is given."""
    rng = np.random.default_rng(4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cp.fit_feedforward(logged(t=TIMES[rng.random(TIMES.size) > 0.1], seed=1, position=1e-4))
        cp.fit_feedforward(logged(t=TIMES + rng.uniform(-4e-4, 4e-4, TIMES.size), seed=1, position=1e-4))
    keep = np.ones(TIMES.size, dtype=bool)
    keep[3000:3040] = False
    half = TIMES[rng.random(TIMES.size) > 0.5]
    for t, gap in ((TIMES[keep], "41 ms, 0.41 %"), (half, "ms, ")):
        with pytest.warns(UserWarning, match=rf"got gaps of up to .*{gap}.* of the time"):
            cp.fit_feedforward(logged(t=t, seed=1, position=1e-4))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cp.fit_feedforward(logged(t=t, seed=1), PLAN)


def test_one_axis_of_a_plan_of_several():
    both = cp.stack([PLAN, 2.0 * PLAN], labels=["x", "z"])
    log = logged(seed=1)
    fit = cp.fit_feedforward(log, both, position="z")
    assert fit.gains["acceleration"] == pytest.approx(
        0.5 * cp.fit_feedforward(log, PLAN).gains["acceleration"], rel=1e-6
    )
    with pytest.raises(ValueError, match="position must be a label of the plan's axes x, z, got 'y'"):
        cp.fit_feedforward(log, both)


# What the data cannot tell


def test_what_the_data_cannot_tell_apart_is_said_with_the_move_that_would():
    """One speed in one direction: its sign and the velocity are nearly the same."""
    plan = cp.Trapezoid(1.0, velocity=1.0, acceleration=20.0)
    t = np.arange(0.0, 1.1, 1e-3)
    fit = cp.fit_feedforward(logged(plan, t, 0), plan)
    assert fit.condition > 10.0 > cp.fit_feedforward(logged(seed=0), PLAN).condition
    pair = "(static and velocity|velocity and static)"
    said = rf"the log hardly distinguishes {pair}.* Add moves at clearly different speeds"
    assert re.search(said, " ".join(fit.notes))


def test_terms_that_are_the_same_are_an_error():
    one_way = moves((0, 0), (1, 1), (1.2, 1), (2, 2))
    log = logged(one_way, np.arange(0.0, 2.0, 1e-3), 0)
    message = "static and gravity|gravity and static"
    with pytest.raises(
        ValueError, match=rf"({message}) cannot be told apart .* add moves in both directions, or leave"
    ):
        cp.fit_feedforward(log, one_way, terms=["static", "velocity", "acceleration", "gravity"])


def test_a_term_that_is_not_there_is_named():
    fit = cp.fit_feedforward(logged(seed=11), PLAN, terms=["static", "velocity", "acceleration", "gravity"])
    low, high = fit.intervals["gravity"]
    assert (low <= 0.0 <= high) == ("The interval of gravity contains 0" in str(fit))
    assert abs(fit.gains["gravity"]) <= 4.0 * fit.standard_errors["gravity"]


def test_feedback_is_named_as_a_source_of_bias_where_the_error_is_large():
    for error, said in ((0.02, True), (1e-4, False)):
        y = (1.0 - error) * PLAN(TIMES).ravel()
        log = cp.read_log({"time": TIMES, "u": control_of(PLAN, TIMES), "y": y})
        assert (
            "the feedback in the logged control is correlated" in str(cp.fit_feedforward(log, PLAN)).replace("\n", " ")
        ) == said


def test_the_threshold_is_stated():
    fit = cp.fit_feedforward(logged(seed=0), PLAN)
    speed = PLAN.peak(1)[0]
    assert fit.threshold == pytest.approx(0.02 * speed, rel=1e-3)
    moving = np.abs(PLAN.jet(TIMES + fit.delay, 1)[1, 0]) > fit.threshold
    assert fit.samples == np.count_nonzero(moving)
    assert f"{fit.samples} with a speed above {fit.threshold:.4g}" in str(fit)


# As a block


@pytest.mark.slow
def test_the_block_is_the_sum_of_its_terms():
    fit = cp.fit_feedforward(logged(gains=ALL, delay=0.0), PLAN, terms=TERMS)
    block = fit.create_iosystem()
    assert (block.input_labels, block.output_labels, block.nstates) == (
        ["y_ref", "y_ref_d1", "y_ref_d2", "y_ref_d3"],
        ["u"],
        0,
    )
    source = cp.create_source_iosystem(PLAN, 3, suffix="_ref")
    both = ct.interconnect([source, block], inputs=0, outputs=["u"])
    t = np.linspace(0.05, 9.95, 1001)
    moving = np.abs(PLAN.jet(t, 1)[1, 0]) > 1e-9
    expected = control_of(PLAN, t, ALL, 0.0)
    np.testing.assert_allclose(cp.simulate(both, t).outputs[0, moving], expected[moving], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["compiled", "python"])
def test_the_block_with_a_plan_leads_by_the_delay(method):
    fit = cp.fit_feedforward(logged(delay=0.02), PLAN)
    block = fit.create_iosystem(PLAN, outputs="torque", name="ff")
    assert (block.ninputs, block.output_labels, block.name) == (0, ["torque"], "ff")
    mass = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["torque"], outputs=["v"], name="mass")
    t = np.linspace(-0.02, 10.0, 2005)
    response = cp.simulate(ct.interconnect([block, mass], inputs=0, outputs=["torque", "v"]), t, method=method)
    expected = control_of(PLAN, t, delay=0.02)
    moving = np.abs(PLAN.jet(t + 0.02, 1)[1, 0]) > 1e-3
    np.testing.assert_allclose(response.outputs[0, moving], expected[moving], rtol=1e-6, atol=1e-6)


def test_the_block_stops_the_integrator_where_the_velocity_changes_its_sign():
    """The integral of sign(v) along a plan with a reversal inside a segment: T_1 - (T - T_1), in closed form."""
    plan = cp.PolySpline([cp.Waypoint(0, 0, 1), cp.Waypoint(1, 0, -2)])  # v = 1 - 2 t - 3 (t^2 - ...): a root inside
    fit = cp.fit_feedforward(logged(gains={"static": 1.0}, delay=0.0), PLAN, terms=["static"])
    integrator = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["q"], name="integrator")
    loop = ct.interconnect([fit.create_iosystem(plan), integrator], inputs=0, outputs=["q"])
    roots = np.roots(np.polyder(np.polyfit(np.linspace(0, 1, 4), plan(np.linspace(0, 1, 4)).ravel(), 3)))
    (turn,) = [root for root in roots if 0.0 < root < 1.0]
    assert abs(cp.simulate(loop, [0.0, 0.5, 1.0]).outputs[0, -1] - (2.0 * turn - 1.0) * fit.gains["static"]) < 1e-9


# Bad input


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"control": "torque"}, ValueError, "log must have the signal 'torque', got u"),
        ({"plan": None}, ValueError, "log must have the signal 'y', got u"),
        ({"plan": "plan"}, TypeError, "plan must be a Trajectory, got str"),
        ({"terms": ["friction"]}, ValueError, "terms must be among static, velocity, acceleration, jerk, gravity, or"),
        ({"terms": []}, ValueError, "terms must have at least one term"),
        ({"terms": "static"}, TypeError, "terms must be a sequence of names"),
        ({"terms": ["static", "static"]}, ValueError, "terms must differ from each other"),
        ({"terms": [("static", np.sin)]}, ValueError, "terms must have names of their own"),
        ({"terms": [("spring", 3.0)]}, TypeError, r"terms must be names or \(name, function of the position\)"),
        ({"plan": PLAN.shift(100.0)}, ValueError, "log must contain a motion, got none; align it with the plan"),
    ],
)
def test_bad_arguments(options, error, message):
    arguments = {"plan": PLAN} | options
    with pytest.raises(error, match=message):
        cp.fit_feedforward(logged(seed=0), **arguments)


def test_bad_logs():
    with pytest.raises(TypeError, match="log must be a response, as read_log returns it, got str"):
        cp.fit_feedforward("log.csv", PLAN)
    short = cp.read_log({"time": TIMES[:35], "u": np.zeros(35)})
    with pytest.raises(ValueError, match="log must have at least 40 samples with a speed above"):
        cp.fit_feedforward(short, PLAN)
    noisy = logged(seed=0, position=0.3)
    with pytest.raises(
        ValueError, match=r"low-pass filter of .* Hz that the noise of the position requires; give a plan"
    ):
        cp.fit_feedforward(noisy)
    still = cp.read_log({"time": TIMES, "u": np.zeros(TIMES.size), "y": np.zeros(TIMES.size)})
    with pytest.raises(ValueError, match="log must contain a motion, got none"):
        cp.fit_feedforward(still)


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (
            lambda y: np.where(y > 0.5, np.nan, y),
            ValueError,
            "term 'spring' must be finite, got nan or inf at position",
        ),
        (lambda y: y[:3], ValueError, r"term 'spring' must return one value per position, shape .*, got shape \(3,\)"),
        (lambda y: "stiff", TypeError, "term 'spring' must be real numbers, got 'stiff'"),
    ],
)
@pytest.mark.parametrize("plan", [PLAN, None])
def test_functions_of_the_position_return_finite_numbers(function, error, message, plan):
    log = logged(seed=0, position=1e-5)
    with pytest.raises(error, match=message):
        cp.fit_feedforward(log, plan, terms=("velocity", ("spring", function)))
