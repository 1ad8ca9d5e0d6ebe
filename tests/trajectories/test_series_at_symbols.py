"""`Trajectory.series` at numbers and at symbols of CasADi: every exported class, and combinations."""

import inspect
import math
import warnings
from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest
from trajectory_oracle import Direct, waypoints

from ctrlplan import trajectories
from ctrlplan.trajectories import (
    Clipped,
    Joined,
    MotionProfile,
    PathPlan,
    PiecewisePolynomial,
    PiecewiseSpline,
    PolySpline,
    Retimed,
    Scaled,
    SCurve,
    Selected,
    Stacked,
    Step,
    Sum,
    TimeLaw,
    Trajectory,
    Trapezoid,
    TrigSpline,
    Waypoint,
    stack,
)

casadi = pytest.importorskip("casadi")
# casadi will change the types that numpy's functions return
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")
ORDER = 5


def rest(*points, labels=None):
    return PolySpline([Waypoint(t, p, 0.0, 0.0) for t, p in points], labels=labels)


POINTS = [
    Waypoint.from_jets(-1.0, x=[0.0, 1.0, 0.0], z=[1.0, 0.0]),
    Waypoint.from_jets(0.25, x=[2.0], z=[-1.0, 0.5, 0.0]),
    Waypoint.from_jets(2.0, x=[1.0, 0.4, 0.0], z=[3.0, -0.2]),
]
NEXT = [Waypoint.from_jets(5.0, x=[1.0, -0.3], z=[3.0, 0.1]), Waypoint.from_jets(6.0, x=[0.0, 0.7], z=[1.0, 2.0])]
POLY, TRIG = PolySpline(POINTS), TrigSpline(NEXT, alpha=2.0)
"""Both end in motion: a wrong limit at an end shows."""

BACK = PiecewiseSpline([*POINTS, Waypoint.from_jets(2.5, x=[0.0, 1.0], z=[1.0])])
"""It returns to its first position with another velocity."""

PLANS = {
    "PolySpline": POLY,
    "TrigSpline": TrigSpline(POINTS, alpha=1.3),
    "PiecewiseSpline": PiecewiseSpline(POINTS),
    "Step": Step([1.0, 2.0], [0.0, -1.0], 0.3),
    "Joined": Joined([POLY, TRIG]),
    "Sum": Sum([POLY, TRIG.shift(-4.5)]),
    "Stacked": Stacked([POLY, TRIG.shift(-4.5)], labels=["p", "q", "r", "s"]),
    "Scaled": Scaled(PiecewiseSpline(POINTS), -1 / 3),
    "Selected": Selected(POLY, ["z", "x"]),
    "Trapezoid": Trapezoid([3.0, 1.0], 0.5, velocity=1.0, acceleration=0.7, time=-1.0),
    "SCurve": SCurve([3.0, 1.0], 0.5, velocity=1.0, acceleration=0.7, jerk=2.0, time=-1.0),
    "Retimed": Retimed(PiecewiseSpline(POINTS), PolySpline([Waypoint(3.0, -1.0, 0.5), Waypoint(7.0, 2.0, 0.4)])),
    "PathPlan": PathPlan(
        [POLY, PolySpline([Waypoint(0.0, [1.0, 3.0], [-0.4, 0.2]), Waypoint(2.0, [0.0, 1.0], [-1.0, -2.0])])],
        [1, -1],
        [rest((3.0, -1.0), (7.0, 2.0)), rest((0.0, 0.0), (2.5, 2.0))],
    ),
    "Clipped": Clipped(PiecewiseSpline(POINTS), -0.6, 1.1),
    "MotionProfile": MotionProfile([-0.5, 1.0, 3.0], [[2.0, -1.0], [0.0, 0.5]], [[1.0, 2.0], [0.5, -0.3], [0.1, 0.0]]),
    "PiecewisePolynomial": PiecewisePolynomial([-0.5, 1.0, 3.0], [[[2.0, 0.3], [0.0, 0.5]], [[1.0, 2.0], [0.5, -0.3]]]),
    "TimeLaw": TimeLaw([-1.0, 0.5, 1.0, 2.0], [[0.0, 1.0, 0.5], [2.0, 0.2, 0.75], [1.0, 0.5, 1.0]], -0.5),
    "Repeated": BACK.repeat(3),
    # kinds with options
    "of a higher degree": PolySpline(POINTS, degree=9),
    "trigonometric of a higher degree": TrigSpline(POINTS, alpha=2.0, degree=7),
    "with gamma": TrigSpline(NEXT, alpha=2.0, gamma=0.7),
    "of small alpha": TrigSpline(POINTS, alpha=1e-9),
    "closed": TrigSpline.cyclic([Waypoint(0.5, 0.0), Waypoint(1.0, 1.0), Waypoint(3.0, 0.5)], 4.0),
    "piecewise, trigonometric": PiecewiseSpline(POINTS, alpha=4.0),
    "at a late start": rest((1e5, 0.0), (1e5 + 2, 3.0)),
    "retimed and shifted": TrigSpline(POINTS, alpha=1.3).retime(7.0).shift(2.5),
    "stopped": POLY.stop(1.2, {"acceleration": 9.0, "jerk": 40.0}),
    "stopped on its path": POLY.stop(-0.3, {"acceleration": 40.0, "jerk": 400.0}, synchronize="path"),
    "on its path with a given squared rate": Retimed(POLY, TimeLaw([-1.0, 1.0, 2.0], [[0, 40], [60, 1], [40, 0]])),
    # one made of another
    "joined of scaled": (2.0 * POLY).then(2.0 * TRIG),
    "joined of stacked": stack([rest((0, 0), (1, 1)), rest((0, 2), (3, 1))]).then(
        stack([rest((0, 1), (2, 5)), rest((0.5, 1), (1, 0))])
    ),
    "joined of sums": (rest((0, 0), (1, 1)) + rest((0.5, 0), (2, 1))).then(rest((0, 2), (1, 3)) + Step(0.0)),
    "joined of joined": rest((0, 0), (1, 1)).then(rest((0, 1), (1, 4))).then(rest((0, 4), (2, 0))),
    "joined with a jump between": rest((0, 0), (1, 1)).then(Step(3.0, 1.0)).then(rest((0, 3), (1, 4))),
    "begun by a jump": Step(1.0, 0.0, 2.0).then(rest((0, 1), (1, 4))),
    "ended by a jump": rest((0, 0), (1, 1)).then(Step(3.0, 1.0)),
    "sum of steps": Step(1.0, time=1.0) + Step(-3.0, time=2.0) + Step([0.5], time=3.5),
    "selected of stacked": stack([POLY, rest((0, 0), (1, 1), labels=["w"])]).select(["w", "x"]),
    "difference, scaled": 0.5 * (PiecewiseSpline(POINTS) - Step([1.0, 1.0], time=0.5)),
}
every = pytest.mark.parametrize("name", PLANS)
both = pytest.mark.parametrize("symbol", ["SX", "MX"])


def moments(plan):
    """Before, random ones in each segment, the start, every breakpoint, the end, after."""
    rng = np.random.default_rng(7)
    edges, size = plan.breakpoints, plan.duration or 1.0
    segments = [rng.uniform(a, b, 4) for a, b in pairwise(edges)]
    return np.concatenate([edges[0] - size * rng.random(3), *segments, edges, edges[-1] + size * rng.random(3)])


def coefficients(plan, t, order):
    """From the jet at one number: (naxes, order + 1)."""
    return plan.jet(t, order).T / [math.factorial(k) for k in range(order + 1)]


def traced(plan, order, symbol="SX"):
    t = getattr(casadi, symbol).sym("t")
    rows = plan.series(t, order)
    assert len(rows) == plan.naxes
    assert all(len(row) == order + 1 for row in rows)
    function = casadi.Function("series", [t], [casadi.vertcat(*[value for row in rows for value in row])])
    return lambda moment: np.array(function(float(moment))).reshape(plan.naxes, order + 1)


def sizes(plan, order):
    """Maximum of each coefficient over the times: (naxes, order + 1)."""
    return np.abs([coefficients(plan, t, order) for t in moments(plan)]).max(axis=0)


def test_every_exported_kind_is_here():
    kinds = {
        name
        for name in trajectories.__all__
        if inspect.isclass(kind := getattr(trajectories, name))
        and issubclass(kind, Trajectory)
        and not inspect.isabstract(kind)
    }
    assert kinds == {type(plan).__name__ for plan in PLANS.values()}


@every
def test_at_a_number_it_is_the_jet_over_factorials(name):
    plan = PLANS[name]
    for order in (0, 1, ORDER):
        for t in moments(plan):
            found = plan.series(float(t), order)
            assert [len(row) for row in found] == [order + 1] * plan.naxes
            wanted = coefficients(plan, t, order)
            assert np.abs(np.array(found) - wanted).max() <= 1e-15 * np.abs(wanted).max()


@both
@every
def test_at_a_symbol_it_is_the_same_in_every_segment_before_and_after(name, symbol):
    """Breakpoints included: there it is what follows, at the end the plan's own."""
    plan = PLANS[name]
    function, size = traced(plan, ORDER, symbol), sizes(plan, ORDER)
    assert size[:, 0].min() > 0
    for t in moments(plan):
        wanted = coefficients(plan, t, ORDER)
        assert np.all(np.abs(function(t) - wanted) <= 1e-11 * size + 1e-300), t


@every
def test_a_short_series_at_a_symbol_is_the_beginning_of_a_long_one(name):
    plan = PLANS[name]
    long, size = traced(plan, ORDER), sizes(plan, ORDER)
    for order in (0, 2):
        short = traced(plan, order)
        for t in moments(plan):
            assert np.all(np.abs(short(t) - long(t)[:, : order + 1]) <= 1e-12 * size[:, : order + 1])


@pytest.mark.parametrize("name", [name for name in PLANS if PLANS[name].duration])
def test_outside_it_is_held_with_every_derivative_0_exactly(name):
    """Near and far, where the splines themselves would be huge."""
    plan = PLANS[name]
    function = traced(plan, ORDER)
    for away in (1e-3, 1e6, math.inf):
        for t, held in [(plan.start - away, plan.initial), (plan.end + away, plan.final)]:
            for found in (function(t), np.array(plan.series(t, ORDER))):
                assert np.array_equal(found[:, 0], held)
                assert np.all(found[:, 1:] == 0.0)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 3.0])
def test_at_a_symbol_against_the_equations_of_the_paper_in_many_digits(alpha):
    """(3) solved in 50 digits, its derivatives term by term."""
    times, jets = [0.5, 1.5, 4.0], [[1.0, 0.0, 0.0], [2.0, None, None], [-1.0, 0.5, 0.0]]
    points = waypoints(times, [[math.nan if v is None else v for v in jet] for jet in jets])
    plan = TrigSpline(points, alpha=alpha) if alpha else PolySpline(points)
    exact, function = Direct(times, jets, alpha), traced(plan, ORDER)
    t = np.random.default_rng(1).uniform(0.5, 4.0, 8)
    wanted = (
        exact.jet(t, ORDER).reshape(ORDER + 1, -1) / np.array([math.factorial(k) for k in range(ORDER + 1)])[:, None]
    )
    size = np.abs(wanted).max(axis=1)
    for moment, column in zip(t, wanted.T, strict=True):
        assert np.all(np.abs(function(moment)[0] - column) <= 1e-11 * size)
        assert np.all(np.abs(np.array(plan.series(moment, ORDER)[0]) - column) <= 1e-11 * size)


def test_at_a_symbol_of_a_piecewise_plan_in_closed_form():
    """Two minimum-jerk segments: 10 s^3 - 15 s^4 + 6 s^5 each, about any time by mpmath."""
    plan = PiecewiseSpline([Waypoint(1.0, 0, 0, 0), Waypoint(3.0, 4, 0, 0), Waypoint(4.0, 3, 0, 0)])
    function = traced(plan, ORDER)

    def rise(s):
        return s**3 * (10 - 15 * s + 6 * s**2)

    segments = [(1.0, 3.0, lambda t: 4 * rise((t - 1) / 2)), (3.0, 4.0, lambda t: 4 - rise(t - 3))]
    for left, right, segment in segments:
        for t in np.linspace(left, right, 9)[:-1]:
            with mp.workdps(30):
                wanted = np.array([float(v) for v in mp.taylor(segment, mp.mpf(float(t)), ORDER)])
            assert np.abs(function(t)[0] - wanted).max() <= 1e-11


def test_symbols_of_one_plan_in_an_expression_may_be_differentiated():
    """The derivative that CasADi takes of coefficient k is (k + 1) times the next, inside each segment."""
    plan, t = PLANS["Joined"], casadi.SX.sym("t")
    rows = plan.series(t, ORDER)
    column = casadi.vertcat(*[value for row in rows for value in row])
    slope = casadi.Function("slope", [t], [casadi.jacobian(column, t)])
    size = sizes(plan, ORDER)
    for moment in [-0.5, 0.3, 1.9, 2.2, 2.9]:
        found, wanted = np.array(slope(moment)).reshape(2, -1), coefficients(plan, moment, ORDER)
        for k in range(ORDER):
            assert np.all(np.abs(found[:, k] - (k + 1) * wanted[:, k + 1]) <= 1e-10 * (k + 1) * size[:, k + 1])


@pytest.mark.parametrize("number", [1, np.float32(0.5), np.float64(0.5), np.int64(1)], ids=str)
def test_numbers_of_other_types(number):
    assert POLY.series(number, 2) == POLY.series(float(number), 2)


# What is rejected


@pytest.mark.parametrize(
    "t", ["0.5", None, 0.5 + 0j, [0.1, 0.2], (0.1,), np.array([0.1, 0.2]), np.array(["a"])], ids=repr
)
@pytest.mark.parametrize("name", ["PolySpline", "Step", "Sum", "Joined"])
def test_what_is_no_time_is_rejected_by_name(name, t):
    with pytest.raises(TypeError, match="t must be one number or a symbol, got"):
        PLANS[name].series(t, 2)


@pytest.mark.parametrize("name", ["PolySpline", "Step", "Stacked", "Joined"])
def test_a_truth_value_is_no_time(name):
    with pytest.raises(TypeError, match="must be numbers, got truth values"):
        PLANS[name].series(True, 2)


@pytest.mark.parametrize("name", ["PolySpline", "Step", "Stacked"])
def test_nan_is_no_time(name):
    with pytest.raises(ValueError, match="must not be nan"):
        PLANS[name].series(math.nan, 2)


@pytest.mark.parametrize("at", ["number", "symbol"])
@pytest.mark.parametrize("name", ["PolySpline", "Step", "Stacked", "Joined"])
def test_an_order_that_is_none_is_rejected(name, at):
    t = 0.3 if at == "number" else casadi.SX.sym("t")
    for order, kind in [(-1, ValueError), (1.5, ValueError), ("2", TypeError), (None, TypeError), (101, ValueError)]:
        with pytest.raises(kind, match="order must be"):
            PLANS[name].series(t, order)


@pytest.fixture
def foreign():
    """A kind of a user's own, y = t on [0, 1], which says nothing of symbols."""

    class Ramp(Trajectory):
        def __init__(self):
            self._set_fields(labels=("y",), breakpoints=np.array([0.0, 1.0]))

        def segment_jet(self, segment, s, order):
            out = np.zeros((order + 1, 1, s.size))
            out[:2] = np.array([s, np.ones_like(s)])[: order + 1, None]
            return out

        def map_time(self, origin, target, rate):
            return self

        def to_dict(self):
            return {"type": "Ramp"}

        @classmethod
        def from_dict(cls, data):
            return cls()

    yield Ramp()
    Trajectory.kinds.pop("Ramp")


def test_a_kind_that_cannot_take_symbols_says_so(foreign):
    """Alone and as a part; numbers it takes."""
    assert foreign.series(0.25, 2) == [[0.25, 1.0, 0.0]]
    for plan in (foreign, 2.0 * foreign, foreign.then(rest((0, 1), (1, 2))), stack([foreign, POLY])):
        with pytest.raises(TypeError, match="the time of a Ramp must be a number, got SX"):
            plan.series(casadi.SX.sym("t"), 2)


@pytest.mark.slow
def test_no_warning_of_our_own_at_a_symbol():
    """But for casadi's about numpy, which it shows once."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for plan in PLANS.values():
            plan.series(casadi.SX.sym("t"), 3)
    assert {entry.category for entry in seen} <= {FutureWarning}


@pytest.mark.parametrize("lead", [False, True])
def test_plans_that_repeat_for_all_future_times(lead):
    """At breakpoints of the first and of late periods what follows, before the start the first position."""
    endless = BACK.repeat(None)
    plan = rest((-4.0, (1.0, 3.0)), (-2.5, (0.0, 1.0)), labels=["x", "z"]).then(endless) if lead else endless
    function = traced(plan, ORDER)
    late = plan.since + 1e4 * plan.period
    edges = [*plan.breakpoints_between(plan.start, plan.start + 12.0), *plan.breakpoints_between(late, late + 8.0)]
    rng = np.random.default_rng(3)
    times = [plan.start - 1.0, *edges, *rng.uniform(plan.start, 40.0, 30)]
    size = np.abs([coefficients(plan, t, ORDER) for t in times]).max(axis=0)
    for t in times:
        assert (np.abs(function(t) - coefficients(plan, t, ORDER)) <= 1e-9 * size + 1e-300).all(), t
