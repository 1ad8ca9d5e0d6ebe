"""What every exported kind of trajectory promises: read off the exports, so that a new one is tested too."""

import copy
import inspect
import json
import pickle
import sys

import numpy as np
import pytest

from ctrlplan import trajectories
from ctrlplan.trajectories import Trajectory, Waypoint
from ctrlplan.trajectories.export import ENDINGS

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = [pytest.mark.every_combination, pytest.mark.filterwarnings("ignore:the plan swings")]

EXPORTED = {name: getattr(trajectories, name) for name in trajectories.__all__}
KINDS = {
    name: kind
    for name, kind in EXPORTED.items()
    if inspect.isclass(kind) and issubclass(kind, Trajectory) and not inspect.isabstract(kind)
}
NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)

POINTS = [
    Waypoint.from_jets(-1.0, x=[0.0, 1.0, 0.0], z=[1.0, 0.0]),
    Waypoint.from_jets(0.25, x=[2.0], z=[-1.0, 0.5, 0.0]),
    Waypoint.from_jets(2.0, x=[1.0, 0.0, 0.0], z=[3.0, 0.0]),
]
BACK = [Waypoint.from_jets(5.0, x=[1.0, -0.3], z=[3.0, 0.1]), Waypoint.from_jets(6.0, x=[0.0, 0.0], z=[1.0, 2.0])]
ARGUMENTS = {
    "waypoints": lambda: POINTS,
    "alpha": lambda: 1.3,
    "parts": lambda: [trajectories.PolySpline(POINTS), trajectories.TrigSpline(BACK, alpha=2.0)],
    "part": lambda: trajectories.PiecewiseSpline(POINTS),
    "factor": lambda: -1 / 3,
    "labels": lambda: ["z", "x"],
    "final": lambda: [1 / 3, 2.0],
    "velocity": lambda: [0.7, 0.9],
    "acceleration": lambda: 0.8,
    "jerk": lambda: 1.1,
    "plan": lambda: trajectories.PiecewiseSpline(POINTS),
    "start": lambda: -0.7,
    "end": lambda: 1.2,
    "breakpoints": lambda: [0.5, 1.25, 2.0],
    "coefficients": lambda: [[[0.5, -1.0], [1 / 3, 2.0]], [[2.0, 0.0], [-1.0, 1.0]], [[1.0, -3.0], [2.0, 0.7]]],
    "values": lambda: [[1.0, -3.0], [0.5, 0.0]],
    "positions": lambda: [0.5, 1.25, 2.0],
    "squared_rates": lambda: [[0.3, 1.1], [0.6, 2.0], [1.1, 0.7]],
    "start_state": lambda: [[1.0, 2.0], [0.5, -1.0], [0.1, 0.0]],
    "count": lambda: 3,
    "law": lambda: trajectories.PolySpline([Waypoint(3.0, -1.0, 0.7), Waypoint(4.0, 0.1), Waypoint(7.5, 2.0, 0.3)]),
}

CURVES = [
    trajectories.PolySpline([Waypoint(-1.0, [0, 0], [3, 0], [0, 0]), Waypoint(2.0, [6, 2], [2, 2])]),
    trajectories.PiecewiseSpline([Waypoint(-1.0, [6, 2], [-1, -1]), Waypoint(0.5, [4, 0.5]), Waypoint(2.0, [3, -4])]),
]
OWN = {
    "PathPlan": {
        "segments": CURVES,
        "directions": [1, -1],
        "law": trajectories.PolySpline([Waypoint(3.0, -1.0, 0.0, 0.0), Waypoint(7.5, 2.0, 0.0, 0.0)]),
    }
}
"""Arguments of one kind."""


def build(kind):
    """An example from the names of the arguments that the constructor requires; labels where they may be given."""
    given = dict(OWN.get(kind.__name__, {}))
    for name, parameter in inspect.signature(kind).parameters.items():
        if parameter.default is inspect.Parameter.empty and name not in given:
            assert name in ARGUMENTS, f"say in ARGUMENTS what the argument {name} of {kind.__name__} may be"
            given[name] = ARGUMENTS[name]()
    if kind is trajectories.Repeated:  # of a plan that returns to its first position
        given["plan"] = trajectories.PiecewiseSpline([*POINTS, Waypoint.from_jets(2.5, x=[0.0, 1.0], z=[1.0])])
    return kind(**given, labels=["p", "q", "r", "s"]) if kind is trajectories.Stacked else kind(**given)


PLANS = {name: build(kind) for name, kind in KINDS.items()}
MOVES = {name: plan for name, plan in PLANS.items() if plan.duration}
every = pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
moving = pytest.mark.parametrize("plan", MOVES.values(), ids=MOVES)


def times(plan, count=41):
    """Before, inside and after."""
    return plan.start + np.linspace(-0.25, 1.25, count) * (plan.duration or 1.0)


def segments(plan):
    return list(zip(plan.breakpoints[:-1].tolist(), plan.breakpoints[1:].tolist(), strict=True))


def sizes(plan, order):
    """Largest of each derivative of each axis at a few hundred points."""
    return np.abs(plan.jet(times(plan, 601), order)).max(axis=2)


def test_there_are_as_many_as_the_design_names():
    assert {"TrigSpline", "PolySpline", "PiecewiseSpline", "Step", "Sum", "Scaled", "Stacked", "Joined"} <= set(KINDS)


def test_kinds_that_can_be_read_are_the_exported_ones():
    """A private or abstract class is no kind that a file may name."""
    own = {n for n, k in Trajectory.kinds.items() if getattr(sys.modules[k.__module__], n, None) is k}
    own = {n for n in own if Trajectory.kinds[n].__module__.startswith("ctrlplan.")}  # not those of examples
    assert own == set(KINDS)


def test_all_is_what_is_visible():
    assert len(EXPORTED) == len(trajectories.__all__)
    assert list(trajectories.__all__) == sorted(trajectories.__all__, key=lambda n: (n.islower(), n))
    assert dir(trajectories) == sorted(trajectories.__all__)
    loaded = {n for n, thing in vars(trajectories).items() if getattr(thing, "__module__", "").startswith("ctrlplan.")}
    assert loaded - {"__getattr__", "__dir__"} <= set(trajectories.__all__)


@pytest.mark.parametrize("name", EXPORTED)
def test_docstring(name):
    doc = inspect.getdoc(EXPORTED[name])
    assert doc
    assert len(doc.splitlines()[0]) <= 64


@every
def test_attributes(plan):
    assert plan.breakpoints[0] == plan.start
    assert plan.breakpoints[-1] == plan.end
    assert plan.duration == plan.end - plan.start
    assert (np.diff(plan.breakpoints) > 0).all()
    assert len(plan.labels) == len(set(plan.labels)) == plan.naxes
    assert plan.initial.shape == plan.final.shape == (plan.naxes,)


@every
def test_shapes(plan):
    for shape in [(), (3,), (0,), (2, 3)]:
        t = np.full(shape, plan.start)
        squeezed = shape if plan.naxes == 1 else (plan.naxes, *shape)
        assert plan(t).shape == plan(t, 2).shape == squeezed
        assert plan.jet(t, 2).shape == plan.jet(t, 2, left=True).shape == (3, plan.naxes, *shape)
    np.testing.assert_array_equal(plan([0, 1, 2]), plan(np.array([0.0, 1.0, 2.0])))


@every
def test_polynomial_degree_is_that_of_the_segments(plan):
    degree = plan.polynomial_degree
    if degree is not None and plan.duration:
        jets = plan.jet(plan.breakpoints[:-1, None] + np.diff(plan.breakpoints)[:, None] * [0.2, 0.8], degree + 1)
        # Relative to the lower derivatives over the shortest segment: the rounding of differences.
        scale = np.abs(jets[:-1]).max() * np.diff(plan.breakpoints).min() ** -(degree + 1.0)
        assert np.abs(jets[degree + 1]).max() <= 1e-12 * scale


@moving
def test_jets_of_a_segment_at_many_times_are_those_at_few(plan):
    """Also a little outside of the segment, where its function continues."""
    low, high = segments(plan)[0]
    for beyond in (0.0, 0.01):
        s = np.linspace(-beyond, 1.0 + beyond, 600) * (high - low)
        found = plan.segment_jet(0, s, 4)
        few = np.concatenate([plan.segment_jet(0, part, 4) for part in np.split(s, 6)], axis=2)
        size = np.abs(few).max(axis=2, keepdims=True)
        assert (np.abs(found - few) <= 1e-12 * size.max(axis=1, keepdims=True)).all()


@moving
@pytest.mark.parametrize("nu", [0, 1, 3, 5])
def test_derivatives_at_fractions_of_all_segments_are_those_at_these_times(plan, nu):
    fractions = np.array([0.1, 0.45, 0.9])
    inside = plan.breakpoints[:-1, None] + np.diff(plan.breakpoints)[:, None] * fractions
    found, wanted = plan.at_fractions(fractions, nu), plan.jet(inside, nu)[nu]
    assert found.shape == (plan.naxes, plan.breakpoints.size - 1, 3)
    size = sizes(plan, nu + 1)[nu:].max(axis=0)  # of the derivative, and of its change by rounding of times
    assert (np.abs(found - wanted) <= 1e-12 * size[:, None, None]).all()


@every
def test_value_and_jet_are_the_same_in_any_order(plan):
    t = times(plan)
    jet = plan.jet(t, 4)
    tolerance = 1e-14 * sizes(plan, 4)
    for nu in range(5):
        values = plan(t, nu).reshape(plan.naxes, -1)
        assert (np.abs(values - jet[nu]).max(axis=1) <= tolerance[nu]).all()
    shuffled = np.random.default_rng(0).permutation(t.size)
    assert (np.abs(plan.jet(t[shuffled], 4) - jet[:, :, shuffled]).max(axis=2) <= tolerance).all()


@every
def test_one_axis_squeezes(plan):
    if plan.naxes == 1:
        assert plan([0.0, 1.0]).shape == (2,)
    else:
        assert plan([0.0, 1.0]).shape == (plan.naxes, 2)


@moving
def test_jet_k_grows_by_the_integral_of_jet_k_plus_1(plan):
    """Gauss-Legendre over part of every segment: no step size, no cancellation."""
    for a, b in segments(plan):
        a, b = a + 0.05 * (b - a), b - 0.1 * (b - a)
        increase = np.diff(plan.jet([a, b], 5), axis=2)[:-1, :, 0]
        integral = 0.5 * (b - a) * plan.jet(a + 0.5 * (b - a) * (NODES + 1), 5)[1:] @ WEIGHTS
        assert (np.abs(increase - integral) <= 1e-12 * np.maximum(sizes(plan, 4), (b - a) * sizes(plan, 5)[1:])).all()


@every
def test_ends_are_held(plan):
    far = np.array([-1e6, -1e-9, 1e-9, 1e6]) + np.array([plan.start, plan.start, plan.end, plan.end])
    jet = plan.jet(far, 4)
    np.testing.assert_array_equal(jet[1:], 0)
    np.testing.assert_array_equal(jet[0], np.array([plan.initial, plan.initial, plan.final, plan.final]).T)
    np.testing.assert_array_equal(plan.jet(plan.end, 0)[0], plan.final)
    np.testing.assert_array_equal(plan.jet(plan.start, 0, left=True)[0], plan.initial)
    if plan.duration:
        assert np.abs(plan.jet(plan.end, 3)[1:]).max() > 0


@every
def test_limits_at_breakpoints(plan):
    """The right limit and, on request, the left one: the value 1e-9 s away, up to the next derivative times that."""
    size = np.maximum(sizes(plan, 3)[1:], 1.0)
    for t in plan.breakpoints:
        last = t == plan.end and plan.duration
        right, left = plan.jet(t, 2), plan.jet(t, 2, left=True)
        if not last:
            assert (np.abs(right - plan.jet(t + 1e-9, 2)) <= 1e-8 * size).all()
        else:
            np.testing.assert_array_equal(right, left)
        assert (np.abs(left - plan.jet(t - 1e-9, 2)) <= 1e-8 * size).all()


@every
def test_extrema_are_attained_and_exceeded_by_no_sample(plan):
    for nu in range(4):
        found = plan.extrema(nu)
        t = np.concatenate([times(plan, 2001), plan.breakpoints])
        samples = np.concatenate([plan.jet(t, nu)[nu], plan.jet(plan.breakpoints, nu, left=True)[nu]], axis=1)
        slack = 1e-12 * sizes(plan, nu)[nu]
        if plan.duration and nu:  # zero outside is no value of the plan
            inside = (t >= plan.start) & (t <= plan.end)
            samples = np.concatenate(
                [plan.jet(t[inside], nu)[nu], plan.jet(plan.breakpoints[1:], nu, left=True)[nu]], 1
            )
        assert (samples.min(axis=1) >= found.minimum - slack).all()
        assert (samples.max(axis=1) <= found.maximum + slack).all()
        for values, at in ((found.minimum, found.time_min), (found.maximum, found.time_max)):
            limits = [[plan.jet(s, nu, left=side)[nu, axis] for side in (False, True)] for axis, s in enumerate(at)]
            assert (np.abs(np.array(limits) - values[:, None]).min(axis=1) <= slack).all()
        np.testing.assert_array_equal(plan.peak(nu), np.maximum(abs(found.minimum), abs(found.maximum)))


@moving
def test_retime_scales_jets_by_powers(plan):
    slow = plan.retime(3.0 * plan.duration)
    assert slow.start == plan.start
    assert slow.duration == pytest.approx(3.0 * plan.duration, rel=1e-15)
    np.testing.assert_allclose(slow.breakpoints - slow.start, 3.0 * (plan.breakpoints - plan.start), rtol=1e-14)
    t = np.setdiff1d(times(plan), plan.breakpoints)
    scaled = plan.jet(t, 4) / 3.0 ** np.arange(5)[:, None, None]
    got = slow.jet(plan.start + 3.0 * (t - plan.start), 4)
    assert (np.abs(got - scaled).max(axis=2) <= 1e-12 * sizes(slow, 4)).all()
    np.testing.assert_allclose(slow.peak(2), plan.peak(2) / 9.0, rtol=1e-11)


@every
def test_shift_moves_the_times(plan):
    late = plan.shift(10.5)
    np.testing.assert_allclose(late.breakpoints, plan.breakpoints + 10.5, rtol=1e-15)
    t = np.setdiff1d(times(plan), plan.breakpoints)
    assert (np.abs(late.jet(t + 10.5, 3) - plan.jet(t, 3)).max(axis=2) <= 1e-12 * sizes(plan, 3)).all()
    assert late.labels == plan.labels


@every
def test_json_restores_every_bit(plan, tmp_path):
    path = tmp_path / "plan.json"
    plan.save(path)
    t = np.concatenate([times(plan), plan.breakpoints, np.linspace(plan.start, plan.end, 5000)])
    text = json.dumps(plan.to_dict(), allow_nan=False)
    for again in (trajectories.trajectory_from_dict(json.loads(text)), trajectories.load_trajectory(path)):
        assert again == plan
        assert len({again, plan, plan.shift(1.0)}) == 2
        assert type(again) is type(plan)
        assert again.labels == plan.labels
        assert again.to_dict() == plan.to_dict()
        np.testing.assert_array_equal(again.breakpoints, plan.breakpoints)
        np.testing.assert_array_equal(again.jet(t, 4), plan.jet(t, 4))
        np.testing.assert_array_equal(again.jet(t, 2, left=True), plan.jet(t, 2, left=True))
    assert json.loads(path.read_text()) == json.loads(text)
    assert plan.to_dict()["type"] == type(plan).__name__


@moving
def test_json_of_a_plan_that_was_moved(plan):
    """What retiming and shifting leave in the numbers is restored too."""
    moved = plan.retime(plan.duration / 7).shift(1 / 3)
    again = trajectories.trajectory_from_dict(json.loads(json.dumps(moved.to_dict())))
    t = times(moved)
    np.testing.assert_array_equal(again.jet(t, 3), moved.jet(t, 3))


@every
def test_copies(plan):
    t = times(plan)
    for again in (copy.copy(plan), copy.deepcopy(plan), pickle.loads(pickle.dumps(plan))):
        assert type(again) is type(plan)
        np.testing.assert_array_equal(again.jet(t, 3), plan.jet(t, 3))
        assert again.to_dict() == plan.to_dict()
        with pytest.raises(AttributeError):
            again.labels = ()


def arrays(plan):
    return [plan.breakpoints, plan.initial, plan.final, *(w.jet for w in plan.waypoints)]


@every
def test_nothing_can_be_changed(plan):
    for name in ("breakpoints", "labels", "anything_new"):
        with pytest.raises(AttributeError, match="is immutable"):
            setattr(plan, name, None)
    with pytest.raises(AttributeError, match="is immutable"):
        del plan.labels
    assert not any(array.flags.writeable for array in arrays(plan))


@every
def test_nothing_can_be_changed_after_pickling(plan):
    again = pickle.loads(pickle.dumps(plan))
    assert not any(array.flags.writeable for array in arrays(again))


@every
def test_results_are_the_callers_own(plan):
    """Writing into what was returned does not change the plan."""
    t = times(plan)
    before = plan.jet(t, 2)
    for array in (plan(t), plan.jet(t, 2), plan.extrema().minimum, plan.peak()):
        array[...] = 99.0
    np.testing.assert_array_equal(plan.jet(t, 2), before)


@every
def test_algebra(plan):
    t = times(plan)
    jet = plan.jet(t, 2)
    np.testing.assert_array_equal((plan + plan).jet(t, 2), 2 * jet)
    np.testing.assert_array_equal((0.5 * plan).jet(t, 2), 0.5 * jet)
    np.testing.assert_array_equal((plan - plan).jet(t, 2), 0)
    both = trajectories.stack([plan, plan], labels=[f"axis{i}" for i in range(2 * plan.naxes)])
    np.testing.assert_array_equal(both.jet(t, 2), np.concatenate([jet, jet], axis=1))
    np.testing.assert_array_equal(plan.then(plan - plan + trajectories.Step(plan.final, plan.final)).final, plan.final)


@every
def test_repr_says_what_it_is(plan):
    assert type(plan).__name__ in repr(plan)
    assert plan.labels[0] in repr(plan)


@every
def test_csv(plan, tmp_path):
    path = tmp_path / "plan.csv"
    t = times(plan, 13)
    plan.to_csv(path, t, order=1)
    header, *rows = path.read_text().splitlines()
    assert header.split(",") == ["time"] + [f"{name}{suffix}" for name in plan.labels for suffix in ("", "_d1")]
    values = np.array([[float(v) for v in row.split(",")] for row in rows]).T
    np.testing.assert_array_equal(values[0], t)
    np.testing.assert_array_equal(values[1:], plan.jet(t, 1).transpose(1, 0, 2).reshape(-1, t.size))


@moving
@pytest.mark.parametrize("ending", ENDINGS)
def test_it_is_exported_to_every_format(plan, ending, tmp_path):
    """Except that a cam has no jump of position or velocity."""
    path = tmp_path / f"plan{ending}"
    if ".cam" in ending and any(jump.order < 2 for jump in plan.jumps(1) if plan.start < jump.time < plan.end):
        with pytest.raises(ValueError, match=r"(position|velocity) of a cam must be continuous, got a jump"):
            plan.export(path)
        return
    files = plan.export(path)
    assert set(tmp_path.iterdir()) == set(files)
    assert all(file.stat().st_size for file in files)
