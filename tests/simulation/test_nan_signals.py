"""A nan affects only what depends on it."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp


def _loop_with_a_sensor_that_fails():
    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", name="plant")
    sensor = ct.nlsys(
        None,
        lambda t, x, u, params: np.array([np.where(abs(t - 1.5) < 0.5, np.nan, u[0])]),
        inputs="y",
        outputs="y_seen",
        name="sensor",
        dt=0,
    )
    careful = ct.nlsys(
        lambda t, x, u, params: np.array([x[0] if np.isnan(u[0]) else u[0]]),
        lambda t, x, u, params: np.array([x[0] if np.isnan(u[0]) else u[0]]),
        states=1,
        inputs="y_seen",
        outputs="held",
        name="careful",
        dt=0.1,
    )
    swing = ct.nlsys(
        lambda t, x, u, params: np.array([x[1], -np.sin(x[0])]),
        lambda t, x, u, params: np.array([x[0]]),
        states=2,
        outputs="angle",
        inputs="u",
        name="swing",
    )
    return ct.interconnect(
        [plant, sensor, cp.sample_hold(careful, 0.1), swing],
        inputs=["u"],
        outputs=["y", "held", "angle", "y_seen"],
        name="loop",
    )


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_the_rest_of_the_loop_goes_on(method):
    t = np.linspace(0.0, 3.0, 61)
    found = cp.simulate(_loop_with_a_sensor_that_fails(), t, 1.0, method=method)
    y, held, angle, seen = found.outputs
    assert np.abs(y - (1.0 - np.exp(-t))).max() < 1e-7
    assert np.isfinite(angle).all()
    missing = np.abs(t - 1.5) < 0.45
    assert np.isnan(seen[missing]).all()
    assert np.ptp(held[missing]) == 0.0
    assert held[missing][0] == pytest.approx(1.0 - np.exp(-1.0), abs=0.1)
    assert np.isfinite(held).all()
