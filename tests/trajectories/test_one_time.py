"""One time of a plan: the reference values in 250 digits, the same bits however it is called, and subclasses."""

import json
import pickle
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, Step, TrigSpline, Waypoint, stack

pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

CASES = json.loads(Path(__file__).with_name("golden_hermite.json").read_text())
RNG = np.random.default_rng(0)
UNEVEN = [  # different entries by axis: two systems
    Waypoint.from_jets(-1.0, x=[0.0, 1.0, 0.0], z=[1.0, 0.0]),
    Waypoint.from_jets(0.25, x=[2.0], z=[-1.0, 0.5, 0.0]),
    Waypoint.from_jets(2.0, x=[1.0, 0.0, 0.0], z=[3.0, 0.0]),
]
EVEN = [Waypoint(t, *jet) for t, jet in zip([0.0, 1.0, 2.0, 3.5], 0.3 * RNG.normal(size=(4, 3, 2)), strict=True)]
TRIG, POLY, PIECES = (
    TrigSpline(EVEN, alpha=2.0, warn=False),
    PolySpline(EVEN, warn=False),
    PiecewiseSpline(EVEN, warn=False),
)
PLANS = {
    "trigonometric": TRIG,
    "polynomial": POLY,
    "piecewise": PIECES,
    "piecewise trigonometric": PiecewiseSpline(EVEN, alpha=1.3, warn=False),
    "small alpha": TrigSpline(EVEN, alpha=1e-9, warn=False),
    "gamma": TrigSpline(EVEN, alpha=2.0, gamma=0.4, warn=False),
    "spare harmonics": TrigSpline(EVEN, alpha=2.0, degree=9, warn=False),
    "cyclic": TrigSpline.cyclic(EVEN, 5.0, warn=False),
    "one axis": PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]),
    "a constant": PolySpline([Waypoint(0, 2.0), Waypoint(1, np.nan)]),
    "uneven trigonometric": TrigSpline(UNEVEN, alpha=3.0, warn=False),
    "uneven polynomial": PolySpline(UNEVEN, warn=False),
    "uneven piecewise": PiecewiseSpline(UNEVEN, alpha=0.5, warn=False),
    "late": TRIG.quiet().shift(1e4),
    "a sum": TRIG + POLY.shift(0.7) - 0.5 * PIECES,
    "stacked": stack([TRIG, POLY.shift(-0.3)], ["a", "b", "c", "d"]),
    "one of two": TRIG.select(["y2"]),
    "joined": PIECES.then(PolySpline([Waypoint(0, PIECES.final, 0, 0), Waypoint(1, [1, -1], 0, 0)])),
    "with a step": POLY + Step([1.0, 2.0], time=1.0),
}
PLANS["saved"] = pickle.loads(pickle.dumps(PLANS["a sum"]))
every = pytest.mark.parametrize("name", PLANS)


def moments(plan):
    inside = np.random.default_rng(1).uniform(plan.start, plan.end, 20)
    return [*inside.tolist(), *plan.breakpoints.tolist(), plan.start - 1.0, plan.end + 1.0, np.inf, -np.inf]


@pytest.mark.parametrize("case", CASES, ids=[f"N{len(c['points'])}-alpha{c['alpha']:.4g}" for c in CASES])
def test_values_and_derivatives_in_many_digits(case):
    points = [Waypoint(t, *jet) for t, jet in case["points"]]
    duration, exact = points[-1].time - points[0].time, np.array(case["values"])
    size = sum(len(jet) for _, jet in case["points"])
    tolerance = 1e-12 if size <= 24 else 1e-10  # as for an array of times
    scale = np.maximum(np.abs(exact).max(axis=1), np.abs(exact[0]).max() / duration ** np.arange(4))
    for plan in [TrigSpline(points, alpha=case["alpha"], warn=False)] + (
        [] if case["alpha"] else [PolySpline(points, warn=False)]
    ):
        found = np.array([plan.jet(t, 3)[:, 0] for t in case["times"]]).T
        assert (np.abs(found - exact).max(axis=1) <= tolerance * scale).all()


@every
def test_one_time_agrees_with_many(name):
    plan = PLANS[name]
    inside = [t for t in moments(plan) if plan.start <= t <= plan.end]
    for left in (False, True):
        many = plan.jet(np.array(inside), 5, left)
        singly = np.stack([plan.jet(t, 5, left) for t in inside], axis=2)
        size = np.abs(many).max(axis=(1, 2))
        size = np.maximum(size, size[0] / plan.duration ** np.arange(6))  # derivatives that are 0
        assert (np.abs(singly - many).max(axis=(1, 2)) <= 1e-11 * size).all()


@every
def test_the_same_bits_however_it_is_called(name):
    plan = PLANS[name]
    for t in moments(plan):
        for left in (False, True):
            jet = plan.jet(t, 3, left)
            assert jet.shape == (4, plan.naxes)
            for other in (np.float64(t), np.array(t)):
                np.testing.assert_array_equal(plan.jet(other, 3, left), jet)
            np.testing.assert_array_equal(plan.jet([t], 3, left)[..., 0], jet)
            np.testing.assert_array_equal(plan.jet(t, 1, left), jet[:2])
        for nu in range(4):
            value = plan(t, nu)
            assert isinstance(value, np.ndarray)
            assert value.shape == (() if plan.naxes == 1 else (plan.naxes,))
            np.testing.assert_array_equal(value, jet_of(plan, t)[nu])


def jet_of(plan, t):
    jet = plan.jet(t, 3)
    return jet[:, 0] if plan.naxes == 1 else jet


def test_threads_and_new_objects_get_the_same_bits():
    def first_call(plan):
        return plan.jet(0.7, 3)

    fresh = [TrigSpline(EVEN, alpha=2.0, warn=False) for _ in range(40)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(first_call, fresh * 2))
    TRIG.jet(np.linspace(0.0, 4.0, 5000), 4)
    for jet in found:
        np.testing.assert_array_equal(jet, TRIG.jet(0.7, 3))


@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("spline", [TrigSpline, PiecewiseSpline])
def test_threads_get_the_same_extrema(spline, alpha):
    """Places that one thread has just found are no first approximations for the others."""
    points = [Waypoint(0, 0, 0, 0), Waypoint(1, 1), Waypoint(3, 2, 0, 0)]
    alone = spline(points, alpha=alpha, warn=False)
    expected = alone.peak(2).tobytes(), alone.extrema(1).time_max.tobytes()
    together, before = threading.Barrier(8), sys.getswitchinterval()

    def first_call(plan):
        together.wait()
        return plan.peak(2).tobytes(), plan.extrema(1).time_max.tobytes()

    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(8) as pool:
            for _ in range(60):
                plan = spline(points, alpha=alpha, warn=False)
                assert set(pool.map(first_call, [plan] * 8)) == {expected}
    finally:
        sys.setswitchinterval(before)


@every
def test_nan_is_an_error(name):
    with pytest.raises(ValueError, match="times must not be nan"):
        PLANS[name].jet(float("nan"), 2)
    with pytest.raises(ValueError, match="times must not be nan"):
        PLANS[name](float("nan"))


def test_the_result_is_the_callers():
    jet = TRIG.jet(0.7, 3)
    jet[:] = 0.0
    assert TRIG.jet(0.7, 3).any()


@pytest.mark.parametrize("method", ["segment_jet", "_sample"])
def test_a_subclass_that_overrides_the_many_overrides_the_one(method):
    def doubled(self, *given):
        return 2.0 * getattr(PolySpline, method)(self, *given)

    changed = type("_Doubled", (PolySpline,), {method: doubled, "__module__": __name__, "__qualname__": "_Doubled"})
    plan = changed(EVEN, warn=False)
    np.testing.assert_allclose(plan.jet(0.7, 3), 2.0 * POLY.jet(0.7, 3), rtol=1e-12)
    np.testing.assert_allclose(plan(0.7, 1), 2.0 * POLY(0.7, 1), rtol=1e-12)
    if method == "segment_jet":  # a sum calls it for its parts
        np.testing.assert_allclose((plan + POLY)(0.7, 1), 3.0 * POLY(0.7, 1), rtol=1e-12)


def test_beyond_floating_point_is_the_error_of_many_times():
    plan = PolySpline([Waypoint(0, 0, 0, 0), Waypoint(1e-100, 1e80, 0, 0)])
    for t in (3e-101, [3e-101]):
        with pytest.raises(ValueError, match="must stay within floating point"):
            plan.jet(t, 3)
