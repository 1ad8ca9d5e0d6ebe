"""The crane's laws as blocks: names, formulas, finite at zero, and rejected arguments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

from ctrlplan.systems.plants import (
    Crane,
    create_crane_feedforward_iosystem,
    create_dynamic_law_iosystem,
    create_generator_iosystem,
    create_load_feedback_iosystem,
    create_setpoint_iosystem,
)

CRANE = Crane(load_mass=430.0, trolley_mass=3100.0, drum_inertia=70.0, drum_radius=0.5, gravity=9.5)
MAKERS = [
    create_setpoint_iosystem,
    create_generator_iosystem,
    create_load_feedback_iosystem,
    create_dynamic_law_iosystem,
    create_crane_feedforward_iosystem,
]


def names(order):
    return [axis + (f"_d{k}" if k else "") for axis in ("x_ref", "z_ref") for k in range(order + 1)]


@pytest.mark.parametrize(
    ("make", "inputs", "outputs"),
    [
        (create_setpoint_iosystem, ["x_ref", "z_ref"], ["D_ref", "R_ref"]),
        (create_generator_iosystem, names(2), ["D_ref", "R_ref"]),
        (create_load_feedback_iosystem, [*names(2), "x", "x_d1"], ["D_ref", "R_ref"]),
        (
            create_dynamic_law_iosystem,
            [*names(4), "x", "z", "x_d1", "z_d1", "R", "theta", "D_d1", "R_d1", "theta_d1"],
            ["F", "C"],
        ),
        (create_crane_feedforward_iosystem, names(4), ["F", "C"]),
    ],
)
def test_blocks_are_joined_by_these_names(make, inputs, outputs):
    block = make(CRANE, name="law")
    assert (block.name, block.input_labels, block.output_labels) == ("law", inputs, outputs)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("wrap", [False, True])
def test_blocks_are_finite_at_zero(make, wrap):
    block = make(Crane(rope_wrap=wrap))
    zero = np.zeros(block.ninputs)
    assert np.isfinite(block.output(0.0, np.zeros(block.nstates), zero)).all()
    assert np.isfinite(block.dynamics(0.0, np.zeros(block.nstates), zero)).all()


REFERENCES = st.tuples(
    st.floats(-20, 20), st.floats(-3, 3), st.floats(-6, 6), st.floats(2, 20), st.floats(-3, 3), st.floats(-6, 6)
)


def assert_hangs(crane, references, x, z, x2, z2):
    """Trolley at D and rope of length R hold the load at (x, z), along (-x'', g - z'')."""
    d, r = references
    angle = math.atan2(-x2, crane.gravity - z2)
    found = [
        r * math.sin(angle) + d + crane.drum_radius * math.cos(angle),
        r * math.cos(angle) - crane.drum_radius * math.sin(angle),
    ]
    np.testing.assert_allclose(found, [x, z], rtol=1e-12, atol=1e-11)


@given(REFERENCES)
@examples(50)
def test_generator_puts_the_drives_where_the_load_hangs_as_planned(u):
    found = create_generator_iosystem(CRANE).output(0.0, [], u)
    assert_hangs(CRANE, found, u[0], u[3], u[2], u[5])
    flat = CRANE.quantities(np.reshape(u, (2, 3)).T)
    np.testing.assert_allclose(found, [flat["D"], flat["R"]], rtol=1e-12, atol=1e-11)


@given(REFERENCES, st.floats(-20, 20), st.floats(-2, 2), st.floats(0.1, 3), st.floats(0.5, 1.5))
@examples(50)
def test_load_feedback_commands_the_acceleration_of_the_law(u, dx, dv, w, zeta):
    block = create_load_feedback_iosystem(CRANE, w, zeta)
    found = block.output(0.0, [], [*u, u[0] + dx, u[1] + dv])
    requested = u[2] - 2 * zeta * w * dv - w**2 * dx
    scale = 1 + abs(requested)
    d, r = found
    angle = math.atan2(-requested, CRANE.gravity - u[5])
    np.testing.assert_allclose(r * math.sin(angle) + d + 0.5 * math.cos(angle), u[0] + dx, atol=1e-10 * scale)
    np.testing.assert_allclose(r * math.cos(angle) - 0.5 * math.sin(angle), u[3], atol=1e-10 * scale)


def test_load_feedback_on_plan_is_the_generator():
    u = [3.0, 0.4, -0.8, 9.0, -0.2, 1.1]
    found = create_load_feedback_iosystem(CRANE, 2.0, 0.8).output(0.0, [], [*u, 3.0, 0.4])
    np.testing.assert_allclose(found, create_generator_iosystem(CRANE).output(0.0, [], u), rtol=1e-15)


def test_still_is_rest():
    state, _ = CRANE.equilibrium(3.0, 8.0)
    np.testing.assert_array_equal(create_setpoint_iosystem(CRANE).output(0.0, [], [3.0, 8.0]), state[:2])


@pytest.mark.parametrize("wrap", [False, True])
def test_dynamic_law_on_plan_is_the_feedforward(wrap):
    crane = Crane(rope_wrap=wrap)
    jet = np.array([[3.0, 0.5, -1.2, 0.4, 0.7], [9.0, -0.3, 2.0, -0.6, 1.5]])
    q = crane.quantities(jet.T)
    measured = [*jet[:, 0], *jet[:, 1], *(q[n] for n in ("R", "theta", "D_d1", "R_d1", "theta_d1"))]
    law = create_dynamic_law_iosystem(crane)
    state = [q["T"] - crane.load_mass * crane.gravity, q["T_d1"]]
    forward = create_crane_feedforward_iosystem(crane).output(0.0, [], jet.ravel())
    np.testing.assert_allclose(law.output(0.0, state, [*jet.ravel(), *measured]), forward, rtol=1e-11)
    np.testing.assert_allclose(forward, [q["F"], q["C"]], rtol=1e-15)
    rates = law.dynamics(0.0, state, [*jet.ravel(), *measured])
    np.testing.assert_allclose(rates, [q["T_d1"], q["T_d2"]], rtol=1e-10)


@pytest.mark.parametrize(
    "poles",
    [
        (-1, -1, -1),
        (-1, -1, -1, -1, -1),
        (-1, -1, -1, 0.0),
        (-1, -1, -1, 0.5),
        (-1, -1, 1j, -1j),
        (-1, -1, -1, -1 + 1j),
        (-1, -1, -1, math.nan),
    ],
)
def test_poles_must_be_four_stable_and_in_pairs(poles):
    with pytest.raises(ValueError, match="poles"):
        create_dynamic_law_iosystem(CRANE, poles)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["load_bandwidth", "damping"])
def test_load_feedback_needs_positive_numbers(name, value):
    with pytest.raises(ValueError, match=f"{name} must be finite and above 0"):
        create_load_feedback_iosystem(CRANE, **{name: value})


def test_feedforward_rejects_what_would_push_the_rope():
    u = np.zeros(10)
    u[7] = 9.6
    with pytest.raises(ValueError, match=r"g - z'' must be above 0 for a taut rope, got -0\.1"):
        create_crane_feedforward_iosystem(CRANE).output(0.0, [], u)
