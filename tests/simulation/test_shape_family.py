"""Responses as functions of the duration: samples, and the bounds by which durations are excluded."""

import numpy as np
import pytest
from loop_oracle import QUINTIC, S_CURVE, SEPTIC, VIA, random_loop, responses, system_of
from scipy.integrate import trapezoid
from scipy.linalg import expm

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.simulation.impulse_envelope import Envelope

TRAPEZOID = cp.Trapezoid(1.0, velocity=1.5, acceleration=6.0)
MOVING = cp.PolySpline([Waypoint(0, 0, 0.8, 0), Waypoint(1, 1, 0.3, 0)])


def family_of(loop, plan, signals=({"y1": 1.0}, {"y2": 1.0}), rate=False):
    system = cp.loop_quantities(system_of(loop))
    return system.shapes_of(plan, [(weights, rate, None) for weights in signals])


@pytest.mark.parametrize("plan", [QUINTIC, VIA, S_CURVE, TRAPEZOID], ids=["quintic", "via", "s_curve", "trapezoid"])
def test_samples_are_values_of_the_exact_response(plan):
    """At one duration each sample lies within the exact extremes, and the samples come near them."""
    for seed in range(4):
        loop = random_loop(np.random.default_rng([seed, 3]), damping=0.05, order=seed % 2)
        family = family_of(loop, plan)
        durations = np.array([0.05, 0.7, 6.0])
        samples = family.samples(durations)
        for duration, values in zip(durations, samples, strict=True):
            low, high, *_ = family.extremes(duration)
            size = high - low
            assert np.all(values.max(axis=1) <= high + 1e-11 * size)
            assert np.all(values.min(axis=1) >= low - 1e-11 * size)
            assert np.all(values.max(axis=1) >= high - 0.05 * size)
            assert np.all(values.min(axis=1) <= low + 0.05 * size)


def test_samples_at_fixed_places_against_the_oracle():
    loop = random_loop(np.random.default_rng(8), damping=0.1)
    family = family_of(loop, QUINTIC)
    dense = responses(loop, QUINTIC, [0.3, 2.0], steps=256, tail=10)
    samples = family.samples(np.array([0.3, 2.0]))
    scale = np.ptp(dense, axis=2).max()
    np.testing.assert_allclose(samples[:, :, :257], dense[:, :, 1:258], rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(samples[:, :, -1], dense[:, :, -1], rtol=0, atol=1e-11 * scale)


@pytest.mark.parametrize("plan", [QUINTIC, SEPTIC, VIA, S_CURVE, TRAPEZOID, MOVING], ids=lambda p: type(p).__name__)
@pytest.mark.parametrize("seed", range(5))
def test_curvature_bound_by_differences(plan, seed):
    """Second differences by the logarithm of the duration never exceed the bound, jumps of the plan included."""
    rng = np.random.default_rng([seed, 5])
    family = family_of(random_loop(rng, damping=0.02, order=seed % 3), plan)
    step = 1e-3
    for duration in (0.03, 0.3, 3.0):
        samples = family.samples(duration * np.exp(step * np.array([-1.0, 0.0, 1.0])))
        change = np.abs(samples[0] - 2.0 * samples[1] + samples[2]).max(axis=1) / step**2
        bound = family.curvature(np.array([duration * np.exp(-step)]), np.array([duration * np.exp(step)]))[0]
        rounding = 1e-14 * np.abs(samples).max(axis=(0, 2)) / step**2
        assert np.all(change <= bound + rounding), (change, bound)
        assert np.any(change >= 1e-3 * bound)


def test_envelope_and_its_moments_by_quadrature():
    """The bound of an impulse response is at least its magnitude; its moments are those of a monotone bound."""
    rng = np.random.default_rng(1)
    loop = random_loop(rng, damping=0.1)
    along = cp.loop_quantities(system_of(loop)).along(QUINTIC)
    form, rows = along.form, along.signals["y1"]
    envelope = Envelope(form, rows.c, form.b[0])
    a, b, c, _ = loop
    times = np.linspace(0.0, 20.0, 40_001)
    step, x = expm(a * times[1]), b[0]
    values = []
    for _ in times:
        values.append(abs(float((c @ x)[0, 0])))
        x = step @ x
    values = np.array(values)
    later = np.maximum.accumulate(values[::-1])[::-1]
    for power in range(3):
        exact = trapezoid(values * times**power, times)
        smallest = trapezoid(later * times**power, times)
        found = float(envelope.moment(power, np.array([20.0]))[0, 0, 0])
        assert exact < found
        assert smallest <= found * (1 + 1e-6) <= 1.5 * smallest
        largest = float(envelope.largest(power, np.array([20.0]))[0, 0, 0])
        assert (values * times**power).max() <= largest <= 1.3 * (later * times**power).max()


@pytest.mark.parametrize("seed", range(4))
def test_short_and_long_plans(seed):
    """The response differs from that to a step, and from the static one, by at most the stated amounts."""
    loop = random_loop(np.random.default_rng([seed, 9]), damping=0.05)
    loop = (*loop[:3], np.zeros_like(loop[3]) if seed % 2 else loop[3])
    family = family_of(loop, VIA)
    low, high, rates = family.step()
    slow_low, slow_high = family.static()
    for duration in (1e-4, 1e-3, 1e-2):
        own_low, own_high, *_ = family.extremes(duration)
        assert np.all(own_high >= high - rates * duration - 1e-6 * (high - low))
        assert np.all(own_low <= low + rates * duration + 1e-6 * (high - low))
    for duration in (10.0, 1e3, 1e5):
        own_low, own_high, *_ = family.extremes(duration)
        distance = family.from_static(np.array([duration]))[0]
        assert np.all(np.abs(own_high - slow_high) <= distance + 1e-4 * (slow_high - slow_low))
        assert np.all(np.abs(own_low - slow_low) <= distance + 1e-4 * (slow_high - slow_low))
