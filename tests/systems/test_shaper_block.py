"""The shaper as a block: like the shaped plan at constant frequency, a mean of the last commands at any."""

import math

import control as ct
import numpy as np
import pytest
from scipy.integrate import trapezoid

import ctrlplan as cp

KINDS = {
    "zv": cp.Shaper.zv,
    "zvd": cp.Shaper.zvd,
    "mzv": cp.Shaper.mzv,
    "ei": cp.Shaper.ei,
    "two_hump_ei": cp.Shaper.two_hump_ei,
    "three_hump_ei": cp.Shaper.three_hump_ei,
}
kinds = pytest.mark.parametrize("kind", KINDS)
PLAN = cp.PolySpline([cp.Waypoint(0.3, 0, 0, 0), cp.Waypoint(2.1, 1, 0, 0)])
DT = 0.1


def alone(block):
    return ct.interconnect([block], inputs=block.input_labels, outputs=block.output_labels)


def rows(response):
    return np.atleast_2d(response.outputs)


def fed(block, commands, frequency=None):
    """Outputs of a block, sample by sample, from its declared initial state."""
    state, found = cp.traits_of(block).initial_state, []
    for k, command in enumerate(np.atleast_2d(np.asarray(commands, dtype=float).T).reshape(len(commands), -1)):
        u = command if frequency is None else np.append(command, frequency[k])
        state = block.sample(k * DT, state, u, {})
        found.append(block.outfcn(k * DT, state, u, {}))
    return np.array(found)


# At constant frequency


@kinds
@pytest.mark.parametrize("zeta", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("measured", [False, True])
def test_at_constant_frequency_it_is_the_shaped_plan(kind, zeta, measured):
    shaper = KINDS[kind](2.0, zeta)
    block = cp.create_shaper_iosystem(shaper, DT, frequency_input="omega" if measured else None)
    t = DT * np.arange(120)
    inputs = {"r_cmd": PLAN} | ({"omega": 2.0} if measured else {})
    found = cp.simulate(alone(block), t, inputs)
    np.testing.assert_allclose(rows(found)[0], shaper.on_grid(DT)(PLAN)(t), rtol=0, atol=1e-12)


@pytest.mark.slow
@kinds
def test_at_another_constant_frequency_it_is_the_shaper_for_that(kind):
    block = cp.create_shaper_iosystem(KINDS[kind](2.0, 0.05), DT, frequency_input="omega")
    t = DT * np.arange(150)
    for omega in (1.0, 1.7, 3.9, 9.0):
        found = cp.simulate(alone(block), t, {"r_cmd": PLAN, "omega": omega})
        wanted = KINDS[kind](omega, 0.05).on_grid(DT)(PLAN)(t)
        np.testing.assert_allclose(rows(found)[0], wanted, rtol=0, atol=1e-12)


@kinds
def test_a_delay_of_whole_samples(kind):
    shaper = KINDS[kind](2.0, 0.03)
    for samples in (1, 3):
        block = cp.create_shaper_iosystem(shaper, shaper.delays[1] / samples, frequency_input="w")
        times = shaper.delays[1] / samples * np.arange(40)
        found = cp.simulate(alone(block), times, {"r_cmd": PLAN, "w": 2.0})
        np.testing.assert_allclose(rows(found)[0], shaper(PLAN)(times), rtol=0, atol=1e-12)


def test_for_several_modes():
    shaper = cp.Shaper.zv(2.0, 0.1).then(cp.Shaper.ei(5.0))
    t = DT * np.arange(120)
    found = cp.simulate(alone(cp.create_shaper_iosystem(shaper, DT)), t, PLAN)
    np.testing.assert_allclose(rows(found)[0], shaper.on_grid(DT)(PLAN)(t), rtol=0, atol=1e-12)
    first = cp.create_shaper_iosystem(cp.Shaper.zv(2.0, 0.1), DT, frequency_input="omega", outputs="inner", name="one")
    second = cp.create_shaper_iosystem(cp.Shaper.ei(5.0), DT, inputs="inner", name="two")
    series = ct.interconnect([first, second], inputs=["r_cmd", "omega"], outputs=["r"])
    found = cp.simulate(series, t, {"r_cmd": PLAN, "omega": 2.0})
    np.testing.assert_allclose(rows(found)[0], shaper.on_grid(DT)(PLAN)(t), rtol=0, atol=1e-12)


def test_several_commands():
    shaper = cp.Shaper.zvd(2.0, 0.1)
    block = cp.create_shaper_iosystem(
        shaper, DT, inputs=["a", "b"], outputs=["c", "d"], frequency_input="w", initial=[0.0, 3.0]
    )
    assert block.input_labels == ["a", "b", "w"]
    assert block.output_labels == ["c", "d"]
    t = DT * np.arange(90)
    found = cp.simulate(alone(block), t, {"a": PLAN, "b": 2.0 * PLAN + cp.Step(3.0, 3.0), "w": 2.0})
    wanted = shaper.on_grid(DT)(PLAN)(t)
    np.testing.assert_allclose(rows(found)[0], wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows(found)[1], 3.0 + 2.0 * wanted, rtol=0, atol=1e-12)


def test_it_starts_with_the_command_before():
    for measured in (None, "w"):
        block = cp.create_shaper_iosystem(cp.Shaper.zv(2.0), DT, initial=5.0, frequency_input=measured)
        inputs = {"r_cmd": 5.0} | ({} if measured is None else {"w": 2.0})
        found = cp.simulate(alone(block), DT * np.arange(50), inputs)
        np.testing.assert_array_equal(rows(found)[0], 5.0)


# In a loop


def loop(block):
    """A lightly damped mode behind the block, with a nonlinear spring that is not deflected far."""

    def rates(t, x, u, params):
        return [x[1], -4.0 * np.sin(x[0] - u[0]) - 0.04 * x[1]]

    plant = ct.nlsys(rates, lambda t, x, u, params: x[0], inputs="r", outputs="y", states=2, name="plant")
    return ct.interconnect([block, plant], inputs=["r_cmd"], outputs=["y", "r"])


@pytest.mark.slow
def test_all_methods_agree():
    block = cp.create_shaper_iosystem(cp.Shaper.mzv(2.0, 0.01), DT)
    t = np.linspace(0.0, 12.0, 241)
    runs = {name: cp.simulate(loop(block), t, cp.Step(0.1), method=name) for name in ("auto", "compiled", "python")}
    for found in runs.values():
        np.testing.assert_allclose(found.outputs, runs["python"].outputs, rtol=0, atol=1e-7)
    # Residual vibration: the spring's sine differs from the mode by (0.1)^2/6; without shaper it is 0.1.
    assert np.abs(runs["auto"].outputs[0, t > 4.0] - 0.1).max() < 2e-4
    linear = ct.interconnect(
        [block, ct.tf([4.0], [1.0, 0.04, 4.0], inputs="r", outputs="y")], inputs=["r_cmd"], outputs=["y", "r"]
    )
    found = cp.simulate(linear, t, cp.Step(0.1))
    assert np.abs(rows(found)[0, t > 4.0] - 0.1).max() < 1e-8


def test_python_control_alone_cannot_run_it():
    with pytest.raises(RuntimeError, match=r"the block shaper, which is sampled, must be run by ctrlplan.simulate"):
        ct.input_output_response(loop(cp.create_shaper_iosystem(cp.Shaper.zv(2.0), DT)), [0.0, 0.1], [1.0, 1.0])


def test_runs_do_not_change_the_block():
    block = cp.create_shaper_iosystem(cp.Shaper.zvd(2.0), DT, frequency_input="w")
    t = DT * np.arange(60)
    both = [cp.simulate(alone(block), t, {"r_cmd": PLAN, "w": 2.0}).outputs for _ in range(2)]
    np.testing.assert_array_equal(*both)


# At varying frequency


@kinds
def test_the_output_stays_within_the_range_of_the_last_commands(kind):
    rng = np.random.default_rng(5)
    shaper = KINDS[kind](2.0, 0.05)
    for commands in (rng.standard_normal(150), np.where(np.arange(150) < 60, 0.0, 0.1), rng.integers(0, 2, 150)):
        frequency = 2.0 * np.exp(0.6 * np.sin(np.cumsum(0.4 * rng.standard_normal(150))))
        block = cp.create_shaper_iosystem(shaper, DT, frequency_input="w")
        found = fed(block, commands, frequency)[:, 0]
        # The longest time that the delays span, at the lowest frequency.
        span = math.ceil(2.0 * shaper.duration / DT) + 2 * shaper.delays.size
        for k, value in enumerate(found):
            last = np.concatenate([[0.0] if k < span else [], commands[max(0, k - span) : k + 1]])
            assert last.min() <= value <= last.max()


@kinds
def test_a_constant_command_is_reached_exactly(kind):
    rng = np.random.default_rng(6)
    shaper = KINDS[kind](2.0, 0.05)
    frequency = 2.0 * np.exp(0.6 * np.sin(np.cumsum(0.4 * rng.standard_normal(400))))
    commands = np.append(rng.standard_normal(100), np.full(300, 0.1))
    block = cp.create_shaper_iosystem(shaper, DT, frequency_input="w")
    assert (fed(block, commands, frequency)[-150:] == 0.1).all()


@pytest.mark.slow
def test_zv_cancels_the_phase_of_the_measured_frequency():
    """At each sample three weights, nonnegative, whose vectors with the phases of the past samples add to zero."""
    zeta = 0.08
    frequency = 2.0 + 0.8 * np.sin(0.1 * np.arange(90))
    block = cp.create_shaper_iosystem(cp.Shaper.zv(2.0, zeta), DT, frequency_input="w")
    now = 80
    weights = np.array([fed(block, np.eye(90)[now - lag], frequency)[now, 0] for lag in range(40)])
    assert (weights >= 0.0).all()
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    assert np.count_nonzero(weights) == 3
    mode, total = zeta + 1j * math.sqrt(1.0 - zeta**2), 0.0
    for lag in range(40):
        turned = trapezoid(frequency[now - lag : now + 1], dx=DT)
        total += weights[lag] * math.sqrt(frequency[now - lag] / frequency[now]) * np.exp(mode * turned)
    assert abs(total) <= 1e-13


# Bad input


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"shaper": 1.0}, TypeError, "shaper must be a Shaper, got float"),
        ({"shaper": cp.Shaper([0.0, 1.0], [0.5, 0.5])}, ValueError, "on a shaper whose modes are known"),
        ({"dt": 0.0}, ValueError, "dt must be finite and above 0"),
        ({"dt": math.nan}, ValueError, "dt must be finite and above 0"),
        ({"dt": 1.6}, ValueError, "dt must be at most 1.5708 s, the delay of the ZV shaper for 2 rad/s"),
        ({"inputs": ["a", "b"]}, ValueError, "outputs must be as many as inputs, 2, got 1"),
        ({"inputs": "r_cmd", "frequency_input": "r_cmd"}, ValueError, "inputs and frequency_input must differ"),
        ({"frequency_input": 3.0}, TypeError, "inputs and frequency_input must be names of signals"),
        ({"initial": [0.0, 1.0]}, ValueError, "initial must be a finite number or 1 of them"),
        (
            {"shaper": cp.Shaper.zv(2.0).then(cp.Shaper.zv(3.0)), "frequency_input": "w"},
            ValueError,
            "shaper must be for one mode if its frequency is measured, got 2 modes",
        ),
    ],
)
def test_arguments_that_are_rejected(options, error, message):
    given = {"shaper": cp.Shaper.zv(2.0), "dt": DT} | options
    with pytest.raises(error, match=message):
        cp.create_shaper_iosystem(given.pop("shaper"), given.pop("dt"), **given)


@pytest.mark.parametrize("frequency", [0.99, 0.0, -2.0, math.nan, 31.5])
def test_measured_frequencies_that_are_rejected(frequency):
    block = cp.create_shaper_iosystem(cp.Shaper.zv(2.0), DT, frequency_input="w")
    with pytest.raises(ValueError, match=r"w of shaper must lie from 1 rad/s, .* to 31.42 rad/s, .* got .* at 0.1 s"):
        fed(block, np.zeros(2), [2.0, frequency])
