"""Limits over ranges of parameters: closed forms at corners, and draws that are worse than no result."""

import itertools
import math

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan import Limits, Region, Waypoint, fastest, margins
from ctrlplan.planning.structure import NotRationalError, Rational

MOVE = cp.PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)])
TURN = cp.PolySpline([Waypoint(0, 0, 0, 0, 0), Waypoint(2, 6.28, 0, 0, 0)])
REST = [0.0] * 4
LIFT = cp.PolySpline(
    [Waypoint.from_jets(0, x=[0, *REST], z=[10, *REST]), Waypoint.from_jets(12, x=[20, *REST], z=[8, *REST])]
)


def mass(load=1.0, friction=0.1):
    """Force of a mass with friction."""
    return lambda jet: {"force": load * jet[2, 0] + friction * jet[1, 0]}


def rotor(inertia=1.0, constant=2.0):
    """Current and voltage of a motor: linear fractional in the constant, and not."""

    def quantities(jet):
        current = inertia * jet[2, 0] / constant
        return {"current": current, "voltage": 3.0 * current + constant * jet[1, 0]}

    return quantities


def servo(k=1.0, zeta=0.5):
    """Second-order closed loop; its overshoot has its maximum inside of the range of zeta for a slow move."""
    w = 12.0 * math.sqrt(k)
    return ct.ss(
        [[0, 1], [-w * w, -2 * zeta * w]], [[0], [w * w]], [[1, 0], [-k, 0]], [[0], [k]], inputs="r", outputs=["y", "u"]
    )


def by_name(found):
    return {row.bound.name: row for row in found}


# Proved


def test_an_affine_force_is_worst_at_a_corner():
    params = {"load": (0.8, 1.3), "friction": (0.0, 2.0)}
    found = margins(MOVE, {"force": 12.0}, mass, params=params)
    t = np.linspace(0, 1, 100_001)
    peaks = {
        corner: np.abs(corner[0] * MOVE(t, 2) + corner[1] * MOVE(t, 1)).max()
        for corner in itertools.product((0.8, 1.3), (0.0, 2.0))
    }
    worst = max(peaks, key=lambda corner: peaks[corner])
    assert found.coverage == found.active.coverage == "proved"
    assert tuple(found.active.parameters.values()) == worst
    assert abs(found.active.value) == pytest.approx(peaks[worst], rel=1e-8)
    assert "with load = 1.3, friction = 2" in str(found)


@pytest.mark.slow
def test_a_linear_fractional_current_is_proved_and_a_voltage_is_not():
    params = {"constant": (0.5, 4.0)}
    found = by_name(margins(MOVE, {"current": 20.0, "voltage": 40.0}, rotor, params=params))
    assert found["current"].coverage == "proved"
    assert found["current"].parameters == {"constant": 0.5}
    assert abs(found["current"].value) == pytest.approx(10 / math.sqrt(3) / 0.5, rel=1e-9)
    assert found["voltage"].coverage.startswith("sampled, ")
    assert found["voltage"].coverage.endswith(" points, corners and interior")
    assert margins(MOVE, {"current": Limits(rms=20.0)}, rotor, params=params).coverage.startswith("sampled")
    assert (
        margins(MOVE, {"current": Limits(rms=20.0, rate=99.0)}, rotor, params={"inertia": (1, 2)}).coverage == "proved"
    )


@pytest.mark.slow
def test_a_pole_in_the_range_is_not_proved():
    def divided(p=1.0):
        return lambda jet: {"q": jet[1, 0] / (p + 2.0)}

    assert margins(MOVE, {"q": 3.0}, divided, params={"p": (-1.0, 1.0)}).coverage == "proved"
    assert margins(MOVE, {"q": 1e9}, divided, params={"p": (-3.0, 1.5)}).coverage.startswith("sampled")


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [
        lambda p=1.0: lambda jet: {"q": np.sin(p) * jet[1, 0]},
        lambda p=1.0: lambda jet: {"q": math.sin(p) * jet[1, 0]},
        lambda p=1.0: lambda jet: {"q": p * p * jet[1, 0]},
        lambda p=1.0: lambda jet: {"q": jet[1, 0] / (p + jet[0, 0])},
        lambda p=1.0: lambda jet: {"q": (p * jet[1, 0]) * (1.0 + p * jet[0, 0])},
        lambda p=1.0: lambda jet: {"q": jet[1, 0] * (1.0 if p > 1.2 else 2.0)},
        lambda p=1.0: lambda jet: {"q": np.maximum(p, 1.2) * jet[1, 0]},
        lambda p=1.0: lambda jet: {"q": jet[1, 0] / p + jet[0, 0] / (p + 1.0)},
        lambda p=1.0: lambda jet: {"q": np.asarray([p], dtype=float)[0] * jet[1, 0]},
        lambda p=1.0: lambda jet: {"q": cp._checks.checked_finite(p, "p") ** 2 * jet[1, 0]},
    ],
)
def test_what_is_not_affine_is_not_proved(function):
    assert margins(MOVE, {"q": 9.0}, function, params={"p": (0.9, 1.6)}).coverage.startswith("sampled, ")


def test_operations_on_a_parameter_against_numbers():
    x = np.array([0.3, -2.0, 1.7])

    def of(p):
        a = (2.0 * p - x) / (1.0 + 0.5 * p) + x
        return [a, a * 3.0 - (-p) + 1.0 / p, +a / (2.0 / p), (p - 1.0) ** 2 + np.square(p) * x]

    traced = of(Rational.parameter(1.0))
    for p in (0.4, 1.0, 2.9):
        for found, expected in zip(traced, of(p), strict=True):
            np.testing.assert_allclose(found(p), expected, rtol=1e-13)
    assert traced[0].is_monotone
    assert not traced[0].is_affine
    assert not traced[1].is_monotone
    for forbidden in (float, bool, np.sin, lambda p: p < 1.0, lambda p: p**0.5, lambda p: 1.0 / (p * x), len):
        with pytest.raises((NotRationalError, TypeError)):
            forbidden(Rational.parameter(1.0))


@pytest.mark.slow
def test_the_load_of_a_crane():
    crane = cp.plants.Crane()
    params = {"load_mass": (400, 700), "trolley_friction": (0.0, 60.0), "gravity": 9.80}
    found = margins(LIFT, {"F": 6e3, "C": (-3e3, 1e3), "velocity": 5.0}, crane, params=params)
    assert found.coverage == "proved"
    t = np.linspace(0, 12, 20_001)
    jet = LIFT.jet(t, 4)
    for name, scale in (("F", 6e3), ("C", 2e3)):
        worst = math.inf
        for load, friction in itertools.product((400.0, 700.0), (0.0, 60.0)):
            own = cp.plants.Crane(load_mass=load, trolley_friction=friction, gravity=9.80).quantities(jet)[name]
            high, low = (6e3, -6e3) if name == "F" else (1e3, -3e3)
            worst = min(worst, (high - own.max()) / scale, (own.min() - low) / scale)
        assert by_name(found)[name].fraction == pytest.approx(worst, abs=1e-7)
    assert by_name(found)["x_d1"].parameters == {}


@pytest.mark.parametrize("system", [cp.plants.dc_motor, lambda **values: cp.plants.dc_motor(**values)])
def test_a_function_that_returns_a_flat_system(system):
    params = {"inertia": (0.005, 0.02), "resistance": (0.8, 1.2)}
    found = margins(TURN, {"voltage": 130.0, "current": 100.0}, system, params=params)
    assert found.coverage == "proved"
    t = np.linspace(0, 2, 20_001)
    R, L, K, b = 1.2, 0.5, 0.01, 0.1
    voltage = (L * (0.02 * TURN(t, 3) + b * TURN(t, 2)) + R * (0.02 * TURN(t, 2) + b * TURN(t, 1))) / K + K * TURN(t, 1)
    assert abs(by_name(found)["voltage"].value) == pytest.approx(np.abs(voltage).max(), rel=1e-7)


def draws(count, ranges):
    rng = np.random.default_rng(7)
    rows = {name: rng.uniform(low, high, count) for name, (low, high) in ranges.items()}
    return [dict(zip(rows, values, strict=True)) for values in zip(*rows.values(), strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("count", [300, 2_000])
def test_no_draw_is_worse_than_what_is_proved(count):
    ranges = {"load_mass": (300.0, 800.0), "trolley_mass": (4e3, 7e3), "drum_inertia": (30.0, 80.0)}
    limits = {"F": 8e3, "C": (-4e3, 2e3), "motor": Region(("F", "D_d1"), [(9e3, 0), (0, 9), (-9e3, 0), (0, -9)])}
    found = by_name(margins(LIFT, limits, cp.plants.Crane(), params=ranges))
    assert {row.coverage for row in found.values()} == {"proved"}
    jet = LIFT.jet(np.linspace(0, 12, 201), 4)
    for values in draws(count, ranges):
        own = cp.plants.Crane(**values).quantities(jet)
        assert (8e3 - np.abs(own["F"]).max()) / 8e3 >= found["F"].fraction - 1e-9
        assert min(2e3 - own["C"].max(), own["C"].min() + 4e3) / 3e3 >= found["C"].fraction - 1e-9
        edge = found["motor: D_d1 + 0.001 F"]
        assert (9.0 - (own["D_d1"] + 1e-3 * own["F"]).max()) / 9.0 >= edge.fraction - 1e-9


# Sampled


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, 3_000])
def test_no_draw_is_worse_than_what_is_sampled_by_a_hundredth(count):
    """Quantities with their worst parameters inside of the ranges, against draws at dense samples."""

    def system(p=0.5, q=0.5, s=0.5):
        def quantities(jet):
            hump = np.exp(-((p - 0.37) ** 2) / 0.02 - ((q - 0.61) ** 2) / 0.08)
            return {
                "a": hump * jet[1, 0] * (1.0 + 0.3 * s),
                "b": np.sin(5.0 * p * jet[0, 0] + q) * jet[2, 0] / (1.0 + s),
            }

        return quantities

    ranges = {"p": (0.0, 1.0), "q": (0.0, 1.0), "s": (-0.2, 0.4)}
    found = by_name(margins(MOVE, {"a": 3.0, "b": 9.0}, system, params=ranges))
    assert all(row.coverage.startswith("sampled") for row in found.values())
    assert found["a"].parameters["p"] == pytest.approx(0.37, abs=0.02)
    jet = MOVE.jet(np.linspace(0, 1, 501), 2)
    for values in draws(count, ranges):
        own = system(**values)(jet)
        for name, limit in (("a", 3.0), ("b", 9.0)):
            assert 1.0 - np.abs(own[name]).max() / limit >= found[name].fraction - 0.02  # 1 % of the range


@pytest.mark.slow
def test_a_closed_loop_is_sampled():
    ranges = {"k": (0.5, 1.5), "zeta": (0.2, 0.9)}
    found = margins(MOVE, {"y": (-0.5, 1.5), "u": 1.0}, servo, params=ranges)
    assert found.coverage.startswith("sampled, ")
    assert found.note == "exact, at all times"
    worst = by_name(found)
    for values in draws(15, ranges):
        own = by_name(margins(MOVE, {"y": (-0.5, 1.5), "u": 1.0}, servo(**values)))
        for name, row in own.items():
            assert row.fraction >= worst[name].fraction - 0.02
    again = margins(MOVE, {"y": (-0.5, 1.5), "u": 1.0}, servo(**worst["u"].parameters))
    assert by_name(again)["u"].fraction == pytest.approx(worst["u"].fraction, abs=1e-9)


# Minimum duration


def test_the_fastest_move_for_the_heaviest_load_in_closed_form():
    """The force m a of the quintic is 10 m / (sqrt(3) T^2)."""
    found = fastest(MOVE, {"force": 4.0}, mass, params={"load": (0.8, 1.3), "friction": 0.0})
    assert found.duration == pytest.approx(math.sqrt(1.3 * 10 / math.sqrt(3) / 4.0), rel=1e-8)
    assert found.active.parameters == {"load": 1.3}
    assert found.margins.coverage == "proved"
    assert "proved" in str(found)


@pytest.mark.slow
def test_the_fastest_move_keeps_each_limit_for_all_parameters():
    ranges = {"load_mass": (400.0, 700.0), "drum_radius": (0.2, 0.3)}
    limits = {"F": 5e3, "C": (-2.5e3, 1e3), "theta": 0.12}
    found = fastest(LIFT, limits, cp.plants.Crane(), params=ranges)
    jet = found.plan.jet(np.linspace(0, found.duration, 2001), 4)
    for values in draws(100, ranges):
        own = cp.plants.Crane(**values).quantities(jet)
        assert np.abs(own["F"]).max() <= 5e3 * 1.01
        assert own["C"].min() >= -2.5e3 * 1.01
        assert np.abs(own["theta"]).max() <= 0.12 * 1.01
    shorter = fastest(LIFT, limits, cp.plants.Crane(**found.active.parameters))
    assert found.duration == pytest.approx(shorter.duration, rel=1e-6)


@pytest.mark.slow
def test_the_fastest_move_of_a_closed_loop_over_its_parameters():
    ranges = {"k": (0.7, 1.3), "zeta": (0.4, 0.9)}
    limits = {"y": (-0.1, 1.02), "u": 0.4}
    found = fastest(MOVE, limits, servo, params=ranges)
    for values in draws(12, ranges):
        assert margins(found.plan, limits, servo(**values)).active.fraction >= -0.02
    alone = fastest(MOVE, limits, servo(**found.active.parameters))
    assert found.duration >= alone.duration * (1 - 1e-9)


@pytest.mark.slow
def test_fixed_values_alone():
    fixed = margins(LIFT, {"F": 6e3}, cp.plants.Crane(), params={"load_mass": 700})
    plain = margins(LIFT, {"F": 6e3}, cp.plants.Crane(load_mass=700.0))
    assert fixed.active.fraction == plain.active.fraction
    assert (fixed.coverage, fixed.active.parameters) == ("", {})
    quick = fastest(LIFT, {"F": 6e3}, cp.plants.Crane(), params={"load_mass": 700})
    assert quick.duration == fastest(LIFT, {"F": 6e3}, cp.plants.Crane(load_mass=700.0)).duration
    waypoints = fastest(MOVE, {"force": 4.0}, mass, hold="waypoints", params={"load": (0.8, 1.3), "friction": 0.0})
    assert waypoints.duration == pytest.approx(math.sqrt(1.3 * 10 / math.sqrt(3) / 4.0), rel=1e-8)


# Bad input


def returns_nothing(p=1.0):
    return None


def by_position(p, /):
    return servo(p)


@pytest.mark.parametrize(
    ("system", "params", "error", "message"),
    [
        (cp.plants.Crane(), {"load": (1, 2)}, ValueError, r"of Crane \(load_mass, .*rope_wrap\), got 'load'"),
        (cp.plants.Crane(), {"load_mass": (700, 400)}, ValueError, r"\['load_mass'\] must increase, got 700 and 400"),
        (cp.plants.Crane(), {"load_mass": (400, math.nan)}, ValueError, r"\['load_mass'\] must be a number, got nan"),
        (cp.plants.Crane(), {"load_mass": (400, math.inf)}, ValueError, r"params\['load_mass'\] must be finite"),
        (cp.plants.Crane(), {"load_mass": math.nan}, ValueError, r"params\['load_mass'\] must be finite, got nan"),
        (cp.plants.Crane(), {"load_mass": (-5, 400)}, ValueError, r"must be finite and above 0.*load_mass = -5"),
        (cp.plants.Crane(), {"load_mass": (1, 2, 3)}, ValueError, r"params\['load_mass'\] must be two numbers"),
        (cp.plants.Crane(), {"load_mass": "heavy"}, TypeError, r"params\['load_mass'\] must be a number"),
        (cp.plants.Crane(), 500.0, TypeError, "params must be a mapping of names to numbers or pairs"),
        (servo, {"mass": (1, 2)}, ValueError, r"params must be among the parameters of servo \(k, zeta\), got 'mass'"),
        (servo(), {"k": (1, 2)}, TypeError, "system must be a plant with parameters by name .* got StateSpace"),
        (cp.plants.integrator_chain(2), {"k": (1, 2)}, TypeError, "with params, system must be .* got FlatSystem"),
        (None, {"k": (1, 2)}, TypeError, "with params, system must be a plant .* got NoneType"),
        (returns_nothing, {"p": (1, 2)}, TypeError, "system must return a loop or a flat system, got NoneType"),
        (by_position, {"p": (1, 2)}, TypeError, "of by_position must be accepted by keyword, got p by"),
        (lambda p, q: servo(p), {"p": (1, 2)}, ValueError, "params must give q, which <lambda> requires"),
    ],
)  # fmt: skip
def test_parameters_that_are_none(system, params, error, message):
    for function in (margins, fastest):
        with pytest.raises(error, match=message):
            function(LIFT if isinstance(system, cp.plants.Crane) else MOVE, {"F": 1.0}, system, params=params)


def test_a_time_law_is_not_found_over_ranges():
    with pytest.raises(ValueError, match='hold must be "shape" or "waypoints" with ranges of parameters'):
        fastest(MOVE, {"force": 4.0}, mass, hold="path", params={"load": (1, 2)})


def test_an_error_states_the_parameters():
    with pytest.raises(ValueError, match=r"pole .* \(at k = -"):
        margins(
            MOVE, {"y": 2.0}, lambda k=1.0: ct.ss([[-k]], [[k]], [[1]], [[0]], outputs="y"), params={"k": (-1.0, 2.0)}
        )
