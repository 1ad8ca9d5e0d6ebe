"""What a user's own kind of trajectory must define, and what it gets for that."""

import json
import threading
import types
from itertools import pairwise

import numpy as np
import pytest
from natural import NaturalCubic
from scipy.interpolate import CubicSpline

import ctrlplan as cp
from ctrlplan.trajectories import Trajectory, Waypoint
from ctrlplan.trajectories.newton import NewtonSystem
from ctrlplan.trajectories.waypoint_spline import families, family_name

POINTS = [Waypoint(1.0, [0.0, 1.0]), Waypoint(2.0, [3.0, 0.5]), Waypoint(4.0, [1.0, -2.0]), Waypoint(5.5, [2.0, 0.0])]
PLAN = NaturalCubic(POINTS, labels=["x", "z"])
NAIVE = CubicSpline([1.0, 2.0, 4.0, 5.5], [p.position for p in POINTS], bc_type="natural")
T = np.linspace(1.0, 5.5, 301)


def ramp(**fields):
    """A class of the name Ramp whose fields are those given."""

    def define(body):
        body["__annotations__"] = {"slope": float}
        body["__init__"] = lambda self: self._set_fields(
            **{"labels": ("y",), "breakpoints": np.array([0.0, 1.0]), "slope": 2.0} | fields
        )
        body["segment_jet"] = lambda self, segment, s, order: np.stack(
            [[self.slope * s], *([[0.0 * s + (k == 0) * self.slope] for k in range(order)])]
        )
        body["map_time"] = lambda self, origin, target, rate: self
        body["to_dict"] = lambda self: {"type": "_Ramp"}
        body["from_dict"] = classmethod(lambda cls, data: cls())

    return types.new_class("_Ramp", (Trajectory,), exec_body=define)


# A spline of a user's own


@pytest.mark.parametrize("nu", range(4))
def test_it_is_evaluated_as_scipy_does(nu):
    expected = NAIVE(T, nu).T
    if nu == 3:  # jumps: scipy's value at a join belongs to what follows, too, but not at the end
        expected[:, -1] = NAIVE(5.5 - 1e-9, 3)
    np.testing.assert_allclose(PLAN(T, nu), expected, rtol=0, atol=1e-11)


def test_it_holds_its_ends_and_has_extrema():
    np.testing.assert_array_equal(PLAN([-3.0, 9.0]), [[0.0, 2.0], [1.0, 0.0]])
    np.testing.assert_array_equal(PLAN([-3.0, 9.0], 1), 0.0)
    fine = NAIVE(np.linspace(1.0, 5.5, 200_001), 1)
    np.testing.assert_allclose(PLAN.peak(1), np.abs(fine).max(axis=0), rtol=1e-8)


def test_it_is_retimed_shifted_saved_and_combined(tmp_path):
    moved = PLAN.retime(9.0).shift(2.0)
    np.testing.assert_allclose(moved(3.0 + 2.0 * (T - 1.0), 1), NAIVE(T, 1).T / 2.0, rtol=0, atol=1e-11)
    PLAN.save(tmp_path / "plan.json")
    for again in (cp.load_trajectory(tmp_path / "plan.json"), cp.trajectory_from_dict(PLAN.to_dict())):
        assert type(again) is NaturalCubic
        np.testing.assert_array_equal(again.jet(T, 3), PLAN.jet(T, 3))
        assert again.waypoints == PLAN.waypoints
    both = cp.stack([PLAN.select("x"), cp.PolySpline([Waypoint(0, 0), Waypoint(1, 1)], labels=["q"])])
    np.testing.assert_array_equal(both(T)[0], PLAN(T)[0])
    np.testing.assert_array_equal((2.0 * PLAN).jet(T, 2), 2.0 * PLAN.jet(T, 2))


def test_it_is_made_again_through_other_waypoints_with_its_options():
    plan = NaturalCubic(POINTS, labels=["x", "z"], weight=3.0)
    values = [Waypoint(w.time, 2.0 * w.position) for w in POINTS]
    for other in (plan.through(values), plan.with_values(values)):
        assert (type(other), other.weight, other.labels) == (NaturalCubic, 3.0, ("x", "z"))
        np.testing.assert_allclose(other(T), 6.0 * NAIVE(T).T, rtol=0, atol=1e-11)
    assert plan.quiet() is plan
    with pytest.raises(ValueError, match=r"must keep the times \[1.0, 2.0, 4.0, 5.5\]"):
        plan.with_values(values[:-1])
    with pytest.raises(ValueError, match="must keep the number of axes, 2, got 1"):
        plan.through([Waypoint(0, 0), Waypoint(1, 1)])


@pytest.mark.slow
def test_functions_of_waypoint_splines_accept_it():
    found = cp.fastest(PLAN, {"velocity": 3.0}, hold="waypoints")
    assert type(found.plan) is NaturalCubic
    # Speeds of the spline scale with the reciprocal of its duration.
    assert found.duration == pytest.approx(4.5 * np.abs(NAIVE(np.linspace(1, 5.5, 100_001), 1)).max() / 3.0, rel=1e-7)
    for hold in ("shape", "path"):
        assert cp.fastest(PLAN, {"velocity": 3.0}, hold=hold).duration <= found.duration * (1.0 + 1e-9)


def test_it_is_simulated_exactly_like_any_plan():
    control = pytest.importorskip("control")
    lag = control.ss([[-1.0, 0.0], [0.0, -2.0]], np.eye(2), [[1.0, 1.0]], 0, inputs=["x", "z"], outputs="y", name="lag")
    source = cp.create_source_iosystem(PLAN, name="plan")
    loop = control.interconnect([source, lag], inputs=[], outputs=["y"])
    found = cp.simulate(loop, T, method="exact")
    naive = cp.simulate(loop, T, method="python", rtol=1e-10)
    np.testing.assert_allclose(found.outputs, naive.outputs, rtol=0, atol=1e-7)


# Fields


def test_a_field_that_is_not_declared_is_an_error_that_says_how_to():
    with pytest.raises(AttributeError, match=r"annotated in the class, as ``way: float``, got way$"):
        ramp(way=1.0)()


def test_a_field_is_set_once():
    plan = ramp()()
    with pytest.raises(AttributeError, match=r"_Ramp is immutable; slope is set already"):
        plan._set_fields(slope=3.0)
    with pytest.raises(AttributeError, match="Ramp is immutable"):
        plan.slope = 3.0


def test_arrays_of_a_user_become_read_only_copies():
    times = np.array([0.0, 1.0])
    plan = ramp(breakpoints=times)()
    assert not plan.breakpoints.flags.writeable
    times[1] = 5.0
    assert plan.end == 1.0


# Names of kinds


def define(module, name="Twin", qualname=None):
    body = {key: ramp().__dict__[key] for key in ("__init__", "segment_jet", "map_time", "to_dict", "from_dict")}
    body |= {"__module__": module, "__qualname__": qualname or name}
    return type(Trajectory)(name, (Trajectory,), body)


@pytest.fixture
def kinds(monkeypatch):
    monkeypatch.setattr(Trajectory, "kinds", dict(Trajectory.kinds))
    return Trajectory.kinds


def test_two_kinds_of_one_name_are_an_error(kinds):
    first = define("one")
    with pytest.raises(ValueError, match=r"different names.* got Twin in two after that in one; rename the class"):
        define("two")
    assert Trajectory.kinds["Twin"] is first
    with pytest.raises(ValueError, match="got PolySpline in one"):
        define("one", "PolySpline")
    assert Trajectory.kinds["PolySpline"] is cp.PolySpline


def test_a_class_that_is_defined_again_replaces_itself(kinds):
    define("__main__")
    again = define("__main__")
    assert Trajectory.kinds["Twin"] is again


def test_abstract_and_private_kinds_have_no_name(kinds):
    define("one", "_Twin")
    assert not {"_Twin", "WaypointSpline", "NewtonSpline", "Trajectory"} & set(kinds)


# Breakpoints


def test_breakpoints_are_between_half_open():
    inf = float("inf")
    assert PLAN.breakpoints_between(1.0, 4.0).tolist() == [1.0, 2.0]
    assert PLAN.breakpoints_between(1.5, 4.1).tolist() == [2.0, 4.0]
    assert PLAN.breakpoints_between(-inf, inf).tolist() == [1.0, 2.0, 4.0, 5.5]
    assert PLAN.breakpoints_between(2.0, 2.0).size == 0
    assert cp.Step(1.0, time=3.0).breakpoints_between(3.0, 4.0).tolist() == [3.0]
    edges = np.sort(np.append(np.random.default_rng(0).uniform(0.0, 7.0, 20), [0.0, 7.0, *PLAN.breakpoints]))
    parts = [PLAN.breakpoints_between(a, b) for a, b in pairwise(edges)]
    assert np.concatenate(parts).tolist() == PLAN.breakpoints.tolist()
    for wrong, message in (((2.0, 1.0), "t1 must not be below t0"), ((np.nan, 1.0), "t0 must be a number, got nan")):
        with pytest.raises(ValueError, match=message):
            PLAN.breakpoints_between(*wrong)


def test_breakpoints_between_are_the_callers_own():
    PLAN.breakpoints_between(0.0, 9.0)[:] = 0.0
    assert PLAN.breakpoints.tolist() == [1.0, 2.0, 4.0, 5.5]


# Families that waypoints choose


def test_families_are_by_name():
    found = families()
    assert {"trigonometric", "polynomial", "piecewise", "s_curve", "trapezoid", "NaturalCubic"} <= set(found)
    assert found["NaturalCubic"] is NaturalCubic
    assert found["s_curve"] is cp.SCurve


def test_a_family_of_two_kinds_is_an_error(kinds):
    body = {"__module__": "one", "__qualname__": "Other", "family": "polynomial"}
    other = type(cp.PolySpline)("Other", (cp.PolySpline,), body)
    with pytest.raises(ValueError, match="got 'polynomial' of PolySpline and of Other"):
        families()
    assert family_name(other) == "polynomial"
    kinds.pop("Other")
    derived = type(cp.PolySpline)("Other", (cp.PolySpline,), {"__module__": "one", "__qualname__": "Other"})
    assert families()["Other"] is derived  # the family of its base is not its own


REST = [Waypoint(2.0, [0.0, 1.0], 0, 0), Waypoint(10.0, [4.0, 1.0], 0, 0)]


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (cp.SCurve, {"velocity": 1.0, "acceleration": 0.5, "jerk": 0.5}),
        (cp.Trapezoid, {"velocity": 1.0, "acceleration": 1.0}),
    ],
)
def test_profiles_are_made_from_two_waypoints_at_rest(kind, options):
    plan = kind.from_waypoints(REST, **options)
    assert plan.to_dict() == kind([4.0, 1.0], [0.0, 1.0], time=2.0, **options).to_dict()
    for point in REST:
        np.testing.assert_array_equal(plan.jet(point.time, 1), point.jet[:2])  # a trapezoid's acceleration jumps there
    wrong = {
        "must have exactly two waypoints, got 3": [*REST, Waypoint(20.0, [5.0, 0.0])],
        r"at rest at its waypoints, got waypoints\[1\]": [REST[0], Waypoint(10.0, [4.0, 1.0], [0.1, 0.0])],
        r"positions prescribed, got waypoints\[0\]": [Waypoint(0.0, [np.nan, 1.0]), REST[1]],
        "within the 1 s between its waypoints, got ": [REST[0], Waypoint(3.0, [4.0, 1.0])],
    }
    for message, points in wrong.items():
        with pytest.raises(ValueError, match=message):
            kind.from_waypoints(points, **options)


# Threads


def test_threads_that_share_a_factorised_system_get_their_own_scales():
    system = NewtonSystem(1.0, np.array([0.0, 1.0]), ((0, 1, 2), (0, 1, 2)))
    wrong, durations = [], [1.5, 2.5, 3.5, 4.5]
    naive = {d: [d**k / [1.0, 1.0, 2.0][k] for k in system.order_index] for d in durations}

    def use(first):
        for i in range(400):
            d = durations[(first + i) % 4]
            if not np.allclose(system.taylor_scale(d)[:, 0], naive[d], rtol=1e-15):
                wrong.append(d)

    threads = [threading.Thread(target=use, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_plain_data_of_a_users_kind_is_json():
    assert json.loads(json.dumps(PLAN.to_dict()))["weight"] == 1.0
