"""Linear flat systems of python-control: what their flat output is, and the digits of their maps."""

import control as ct
import control.flatsys as fs
import numpy as np
import pytest
from numpy.polynomial import Polynomial

import ctrlplan as cp
from ctrlplan.flatness.linear import linear_maps
from ctrlplan.flatness.quantities import quantities_of_flat_system
from ctrlplan.systems.flat import create_flat_iosystem

PLAN = cp.PolySpline([cp.Waypoint.from_jets(0, y=[0] * 7), cp.Waypoint.from_jets(1, y=[1, 0, 0, 0, 0, 0, 0])])
"""From 0 to 1 in 1 s, at rest to order 6."""


def lags(*times):
    """Lags one behind the other, x_j = (T_(j+1) s + 1) x_(j+1) and u = (T_1 s + 1) x_1; and the Polynomials of s."""
    n = len(times)
    a = np.diag([-1.0 / T for T in times]) + np.diag([1.0 / T for T in times[1:]], -1)
    factors = [Polynomial([1.0])]
    for T in times[::-1]:
        factors.append(factors[-1] * Polynomial([1.0, T]))
    system = ct.ss(a, np.eye(n)[:, :1] / times[0], np.eye(n)[-1:], 0.0, inputs="u", outputs="y")
    return system, factors[::-1]  # u by the last state, then x_1, ..., x_n by it


@pytest.mark.parametrize(
    "times",
    [
        (0.5, 0.002),
        (1e-3, 2e-3, 3.0),
        (2e-3, 0.7, 0.03, 0.4),
        (5e-3, 0.02, 0.1, 0.3, 1.0),
        (0.01, 0.02, 0.05, 0.1, 0.2, 0.5),
    ],
)
def test_time_constants_far_apart_cost_no_digits(times):
    """Each state is a polynomial of d/dt of the last one: closed form, term by term of one sign."""
    system, factors = lags(*times)
    quantities = quantities_of_flat_system(fs.LinearFlatSystem(system))
    jet = PLAN.jet(np.linspace(0.0, 1.0, 41), len(times))
    found = quantities(jet)
    for name, factor in zip(["u", *system.state_labels], factors, strict=True):
        terms = factor.coef[:, None] * jet[: factor.coef.size, 0]
        # Rounding of the coefficients of A, of the plan and of sums of n + 1 terms.
        assert (np.abs(found[name] - terms.sum(axis=0)) <= 1e-14 * len(times) * np.abs(terms).sum(axis=0)).all()


def test_the_law_of_such_a_plant_keeps_them_too():
    times = (5e-3, 0.02, 0.1, 0.3, 1.0)
    system, factors = lags(*times)
    law = create_flat_iosystem(fs.LinearFlatSystem(system), [-3.0, -4.0, -5.0, -6.0, -7.0])
    assert law.input_labels[0] == "y_ref"
    jet = PLAN.jet(0.37, 5)[:, 0]
    states = [factor.coef @ jet[: factor.coef.size] for factor in factors[1:]]
    got = law.output(0.0, np.zeros(0), np.concatenate([jet, states]))[0]
    assert got == pytest.approx(factors[0].coef @ jet, rel=1e-9)


def told(num, den):
    """Plant num/den, the error of its flat output, and the coefficients of the output by the flag."""
    flat = fs.LinearFlatSystem(ct.ss(ct.tf(num, den), outputs="y"))
    with pytest.raises(ValueError, match="must be its output, got a plant with zeros") as caught:
        quantities_of_flat_system(flat)
    with pytest.raises(ValueError, match="got a plant with zeros"):
        create_flat_iosystem(flat, -1.0 - np.arange(len(den) - 1))
    return flat, str(caught.value), linear_maps(flat).output


@pytest.mark.parametrize(
    ("num", "lags", "words"),
    [
        ([1.0, 3.0], [0.02, 0.001], "y = 150000 z + 50000 z_d1,"),
        ([0.1, 0.0, 2.0], [0.5, 0.01], "y = 400 z + 20 z_d2,"),
        ([-0.2, 1.0], [0.05], "y = 20 z + -4 z_d1,"),
        ([2.0, 0.5, 1.0], [0.5], "y = 2 z + -3 z_d1 + 4 z_d2,"),
    ],
)
def test_a_plant_with_zeros_is_told_apart(num, lags, words):
    """By the numerator over the leading coefficient of the denominator, whichever the states are."""
    den = np.poly1d([1.0, 0.0])
    for lag in lags:
        den *= np.poly1d([lag, 1.0])
    wanted = np.zeros(den.order + 1)
    wanted[: len(num)] = np.array(num[::-1]) / den.coeffs[0]
    _, message, output = told(num, den.coeffs)
    if len(num) <= den.order:
        assert words in message
    assert f"at rest z is y times {1.0 / wanted[0]:.6g}. For" in message
    np.testing.assert_allclose(output, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def test_a_zero_at_the_origin_leaves_no_position_to_plan():
    _, message, output = told([1.0, 0.0], [1.0, 3.0, 2.0])
    assert "at rest y is 0. For a plan of z" in message
    np.testing.assert_array_equal(output, [0.0, 1.0, 0.0])


def test_what_the_message_says_leads_the_output_to_its_final_value():
    flat, _, output = told([1.0, 3.0], np.polymul([1.0, 0.0], np.polymul([0.02, 1.0], [0.001, 1.0])))
    law = create_flat_iosystem(flat, [-20.0, -25.0, -30.0], labels="z")
    plant = ct.ss(
        flat.A,
        flat.B,
        np.vstack([np.eye(3), flat.C]),
        0.0,
        inputs=flat.input_labels,
        outputs=[*flat.state_labels, "y"],
        name="plant",
    )
    source = cp.create_source_iosystem(90.0 / output[0] * cp.stack([PLAN], labels=["z"]), 3, suffix="_ref")
    loop = ct.interconnect([source, law, plant], inputs=0, outputs=["y"])
    t = np.linspace(0.0, 1.5, 31)
    found = cp.simulate(loop, t)
    jet = 90.0 * PLAN.jet(t, 1)[:, 0]
    np.testing.assert_allclose(found.outputs[0], jet[0] + jet[1] / 3.0, rtol=0, atol=1e-5)


def test_a_fast_zero_is_one():
    """1 ms next to time constants of seconds changes the output by little, and not to rounding."""
    _, message, _ = told([1e-3, 1.0], [6.0, 5.0, 1.0, 0.0])
    assert "y = 0.166667 z + 0.000166667 z_d1," in message


def test_what_is_not_controllable_is_an_error():
    """python-control's own check is by rank and by rounding; here nothing is rounded."""
    flat = fs.LinearFlatSystem(ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0.0))
    flat.B = np.array([[1.0], [0.0]])
    with pytest.raises(ValueError, match="a linear flat system must be controllable"):
        quantities_of_flat_system(flat)


def test_coefficients_beyond_floating_point_are_an_error():
    flat = fs.LinearFlatSystem(ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0.0))
    flat.A = np.array([[-1e200, 1.0], [0.0, -1e200]])
    with pytest.raises(ValueError, match=r"flat maps of .* must stay within floating point"):
        quantities_of_flat_system(flat)
