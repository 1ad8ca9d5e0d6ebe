"""The choice of alpha against brute force over a fine grid, quadrature, and what is known of unit moves."""

from itertools import pairwise
from math import hypot, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetitions import examples

import ctrlplan as cp
from ctrlplan import Waypoint
from ctrlplan.planning import OBJECTIVES, AlphaChoice, PeakDerivative, SquaredDerivative
from ctrlplan.studies.crane import obstacle_waypoints

# Scans over all of [0, 2 pi) swing; that the choice itself does not warn is tested with the warning.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

REST = [Waypoint(0, 0, 0, 0), Waypoint(1, 1, 0, 0)]
OBSTACLE = obstacle_waypoints()
POLYLINE = hypot(5, 5) + 10 + hypot(5, 6)


def length(plan):
    """Path length on so many panels that a standstill inside one costs less than 1e-8."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    total, count = 0.0, 3000
    for a, b in pairwise(plan.breakpoints):
        t = (a + (b - a) * (np.arange(count)[:, None] + 0.5 * (nodes + 1)) / count).ravel()
        speed = np.linalg.norm(plan.jet(t, 1)[1], axis=0)
        total += 0.5 * (b - a) / count * float((speed.reshape(count, 16) @ weights).sum())
    return total


def sampled(plan, nu, count=4001):
    """Derivative (naxes, ntime) at samples of every segment, and the weights of Simpson's rule."""
    values, weights = [], []
    for a, b in pairwise(plan.breakpoints):
        t = np.linspace(a, b, count)
        t[0], t[-1] = np.nextafter(a, b), np.nextafter(b, a)
        values.append(plan.jet(t, nu)[nu])
        simpson = np.full(count, 2.0)
        simpson[1::2], simpson[[0, -1]] = 4.0, 1.0
        weights.append(simpson * (b - a) / (3 * (count - 1)))
    return np.concatenate(values, axis=1), np.concatenate(weights)


def naive(plan, name, count=4001):
    """An objective in plain words."""
    kind, _, what = name.partition("_")
    nu = {"velocity": 1, "acceleration": 2, "jerk": 3, "snap": 4}.get(what, 1)
    values, weights = sampled(plan, nu, count)
    if kind == "peak":
        return float(np.abs(values).max())
    if kind == "squared":
        return float(np.square(values).sum(axis=0) @ weights)
    path = float(np.linalg.norm(values, axis=0) @ weights)
    points = np.array([w.position for w in plan.waypoints])
    return path if kind == "path" else path / np.linalg.norm(np.diff(points, axis=0), axis=1).sum() - 1


def brute(waypoints, name, alphas, family=cp.TrigSpline, count=1001, **options):
    return np.array([naive(family(waypoints, alpha=float(a), **options), name, count) for a in alphas])


@pytest.mark.slow
@pytest.mark.parametrize("name", OBJECTIVES)
def test_unit_move_has_no_better_alpha(name):
    found = cp.choose_alpha(REST, name)
    grid = brute(REST, name, np.linspace(0.0, 6.25, 126), count=401)
    # Samples see less than a peak by some 1e-5 of it; on the finer ones the two agree.
    assert found.value <= grid.min() * (1 + 1e-4) + 1e-8
    assert naive(found.plan, name, 20_001) == pytest.approx(found.value, rel=1e-6, abs=1e-9)
    assert found.plan.alpha == found.alpha
    assert found.objective == name


@pytest.mark.parametrize(
    ("name", "alpha", "value"),
    [
        ("peak_velocity", 0.0, 15 / 8),
        ("peak_acceleration", 0.0, 10 / 3**0.5),
        ("squared_velocity", 0.0, 10 / 7),
        ("squared_acceleration", 0.0, 120 / 7),
        ("squared_jerk", 0.0, 720.0),
    ],
)
def test_the_polynomial_is_best_where_it_is_known_to_be(name, alpha, value):
    found = cp.choose_alpha(REST, name)
    assert found.alpha == alpha
    assert found.value == pytest.approx(value, rel=1e-12)
    assert not found.tied


@pytest.mark.parametrize(
    ("name", "alpha", "value"),
    [("peak_jerk", 1.98, 39.39), ("peak_snap", 1.48, 231.46), ("squared_snap", 1.818, 30363.7)],
)
def test_trigonometric_splines_have_smaller_peak_jerk_and_snap(name, alpha, value):
    found = cp.choose_alpha(REST, name)
    assert found.alpha == pytest.approx(alpha, abs=0.005)
    assert found.value == pytest.approx(value, rel=2e-4)
    near = np.linspace(found.alpha - 0.02, found.alpha + 0.02, 41)
    values = brute(REST, name, near, count=40_001 if name.startswith("peak") else 401)
    assert found.value <= values.min() * (1 + 1e-7)
    assert abs(near[values.argmin()] - found.alpha) <= 0.002


@pytest.mark.slow
def test_crane_path_is_minimal_to_a_millionth_of_its_length():
    found = cp.choose_alpha(OBSTACLE, "path")
    alphas = np.concatenate([np.linspace(0, 6.27, 150), np.linspace(found.alpha - 0.05, found.alpha + 0.05, 41)])
    paths = brute(OBSTACLE, "path", alphas)
    assert abs(found.value - length(found.plan)) <= 1e-7 * found.value
    assert found.value <= paths.min() * (1 + 1e-6)
    assert found.value == pytest.approx(26.332, abs=1e-3)
    assert not found.tied


def test_excess_length_gives_the_same_choice_for_the_crane():
    path, excess = cp.choose_alpha(OBSTACLE, "path"), cp.choose_alpha(OBSTACLE, "wandering")
    assert excess.alpha == pytest.approx(path.alpha, abs=1e-6)
    assert excess.value == pytest.approx(path.value / POLYLINE - 1, abs=1e-9)
    assert excess.blow_up > path.alpha


@pytest.mark.slow
@pytest.mark.parametrize("name", ["peak_jerk", "squared_acceleration", "peak_velocity"])
def test_crane_other_objectives(name):
    found = cp.choose_alpha(OBSTACLE, name)
    near = brute(OBSTACLE, name, np.linspace(found.alpha - 0.02, found.alpha + 0.02, 41), count=8001)
    wide = brute(OBSTACLE, name, np.linspace(0, 6.27, 150))
    assert found.value <= near.min() * (1 + 1e-6)
    assert found.value <= wide.min() * (1 + 1e-4)


def random_waypoints(seed):
    rng = np.random.default_rng(seed)
    count, entries, naxes = rng.integers(2, 6), rng.integers(1, 4), rng.integers(1, 4)
    entries = max(entries, 2 if count == 2 else 1)
    times = rng.uniform(-5, 5) + np.cumsum(rng.uniform(0.5, 3.0, count))
    jets = rng.normal(size=(count, entries, naxes)) * np.array([3.0, 1.0, 0.5])[:entries, None]
    return [Waypoint(t, *jet) for t, jet in zip(times.tolist(), jets, strict=True)]


def check_global(seed, family, name, count):
    waypoints = random_waypoints(seed)
    found = cp.choose_alpha(waypoints, name, family=family)
    alphas = np.linspace(0.0, found.alphas[-1], count)
    values = brute(waypoints, name, alphas, family, 401)
    # The best few are refined; samples then miss less than 1e-6.
    for k in np.argsort(values)[:3]:
        plan = family(waypoints, alpha=float(alphas[k]))
        exact = length(plan) if name == "path" else naive(plan, name, 20_001)
        assert found.value <= exact * (1 + 1e-6), (found, alphas[k], exact)
    exact = length(found.plan) if name == "path" else naive(found.plan, name, 20_001)
    assert found.value == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    "seed", [0, 1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", ["path", "peak_acceleration", "squared_jerk"])
def test_random_waypoints_have_no_better_alpha(seed, name):
    check_global(seed, cp.PiecewiseSpline if seed == 3 else cp.TrigSpline, name, 60)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [100, 105])
@pytest.mark.parametrize("name", ["path", "peak_velocity", "peak_jerk", "squared_velocity", "squared_snap"])
def test_many_random_waypoints_have_no_better_alpha(seed, name):
    check_global(seed, cp.PiecewiseSpline if seed % 3 == 0 else cp.TrigSpline, name, 150)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["path", "wandering"])
def test_straight_moves_tie_and_the_jerk_is_minimised(name):
    straight = [Waypoint(0, [0, 0], 0, 0), Waypoint(2, [3, 4], 0, 0)]
    found = cp.choose_alpha(straight, name)
    assert found.tied
    assert found.alpha == 0.0
    assert found.value == pytest.approx(5.0 if name == "path" else 0.0, rel=1e-12, abs=1e-12)
    assert found.blow_up > pi


def test_a_tie_minimises_the_jerk_among_the_minimisers():
    # Equal from 2 to 3 only: at rest the squared jerk rises with alpha, so that the minimum is at 2.
    found = cp.choose_alpha(REST, lambda plan: max(2.0 - plan.alpha, 0.0, plan.alpha - 3.0))
    assert found.tied
    assert found.value == pytest.approx(0.0, abs=1e-7)
    assert found.alpha == pytest.approx(2.0, abs=1e-6)


@pytest.mark.slow
def test_a_tie_of_all_is_solved_for_the_minimum_jerk():
    # With four entries at the ends and a jerk at one of them the minimum is inside.
    waypoints = [Waypoint(0, 0, 0, 0, 0), Waypoint(1, 1, 0, 0, 40.0)]
    found = cp.choose_alpha(waypoints, lambda plan: 1.0)
    jerk = cp.choose_alpha(waypoints, "squared_jerk")
    assert found.tied
    assert SquaredDerivative(3)(found.plan) == pytest.approx(jerk.value, rel=1e-9)


@pytest.mark.slow
def test_a_constant_plan_has_no_path():
    found = cp.choose_alpha([Waypoint(0, [1, 2], 0), Waypoint(3, [1, 2], 0)])
    assert (found.alpha, found.value, found.tied) == (0.0, 0.0, True)


def test_the_curve_can_be_drawn():
    found = cp.choose_alpha(OBSTACLE)
    assert (np.diff(found.alphas) > 0).all()
    assert found.alphas[0] == 0.0
    assert 6.0 < found.alphas[-1] < 2 * pi
    assert np.diff(found.alphas).max() < 0.15
    assert found.alpha in found.alphas
    assert found.values.min() == pytest.approx(found.value, rel=1e-12)
    assert found.alphas.shape == found.values.shape
    for values in (found.alphas, found.values):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
    for alpha, value in zip(found.alphas[:-3:7], found.values[:-3:7], strict=True):
        assert value == pytest.approx(length(cp.TrigSpline(OBSTACLE, alpha=float(alpha))), rel=1e-7)


def test_the_blow_up_region_is_told():
    found = cp.choose_alpha(OBSTACLE)
    late = found.alphas >= found.blow_up
    assert late.any()
    assert (found.values[late] > 10.0 * found.value).all()
    assert found.values[np.flatnonzero(late)[0] - 1] <= 10.0 * found.value
    assert length(cp.TrigSpline(OBSTACLE, alpha=0.5 * (found.blow_up + 2 * pi))) > 10.0 * found.value


def test_no_blow_up_is_told_as_two_pi():
    assert cp.choose_alpha(REST, lambda plan: 1.0 + plan.alpha).blow_up == 2 * pi


def test_figure_of_the_choice():
    import matplotlib.pyplot as plt

    drawn = cp.choose_alpha(OBSTACLE).plot()
    assert drawn.lines[0, 0]
    plt.close(drawn.figure)


def test_a_function_of_the_plan_is_an_objective():
    def miss(plan):
        return (plan.alpha - 3.21) ** 2 + 2.0

    found = cp.choose_alpha(REST, miss)
    assert found.alpha == pytest.approx(3.21, abs=1e-6)
    assert found.value == pytest.approx(2.0, rel=1e-12)
    assert found.objective == "miss"


def test_the_deepest_of_many_valleys_is_found():
    def valleys(plan):
        return float(np.cos(6.0 * plan.alpha) + 0.03 * (plan.alpha - 4.5) ** 2)

    found = cp.choose_alpha(OBSTACLE, valleys)
    fine = np.linspace(0.0, 6.25, 200_001)
    values = np.cos(6.0 * fine) + 0.03 * (fine - 4.5) ** 2
    assert found.alpha == pytest.approx(fine[values.argmin()], abs=1e-4)
    assert found.value <= values.min() + 1e-9


def test_objectives_of_any_order():
    found = cp.choose_alpha(REST, PeakDerivative(5))
    assert found.value <= brute_peak(5) * (1 + 1e-6)
    assert "PeakDerivative" in found.objective


def brute_peak(nu):
    return min(np.abs(sampled(cp.TrigSpline(REST, alpha=float(a)), nu)[0]).max() for a in np.linspace(0.0, 5.0, 41))


@pytest.mark.parametrize("name", ["speed", "", "Path"])
def test_names_that_are_no_objectives(name):
    with pytest.raises(ValueError, match=f"objective must be one of path, wandering.*or a function, got '{name}'"):
        cp.choose_alpha(REST, name)


@pytest.mark.parametrize("objective", [None, 3, ["path"]])
def test_objectives_of_the_wrong_kind(objective):
    with pytest.raises(TypeError, match="objective must be a name or a function of a plan, got"):
        cp.choose_alpha(REST, objective)


def test_nan_is_rejected():
    with pytest.raises(ValueError, match=r"objective must return a number.* got nan at alpha = 2\.\d+"):
        cp.choose_alpha(REST, lambda plan: np.nan if plan.alpha > 2.0 else 1.0)
    with pytest.raises(ValueError, match=r"objective must return a number.* got nan at alpha = 0"):
        cp.choose_alpha([Waypoint(0, 1, 0), Waypoint(1, 1, 0)], "wandering")


@pytest.mark.parametrize("value", [None, "high", np.ones(2)])
def test_objectives_must_return_a_number(value):
    with pytest.raises(TypeError, match=r"objective must return a number.* got"):
        cp.choose_alpha(REST, lambda plan: value)


def test_infinite_objectives():
    with pytest.raises(ValueError, match="objective must be finite for some alpha, got inf"):
        cp.choose_alpha(REST, lambda plan: np.inf)
    found = cp.choose_alpha(REST, lambda plan: plan.alpha if plan.alpha > 1.5 else np.inf)
    assert 1.5 < found.alpha < 1.5 + 1e-6
    assert np.isinf(found.values[0])


def test_an_error_of_the_objective_is_its_own():
    def broken(plan):
        raise KeyError("broken")

    with pytest.raises(KeyError, match="broken"):
        cp.choose_alpha(REST, broken)


@pytest.mark.slow
def test_singular_alphas_are_left_out():
    # Position and speed at the ends, acceleration alone between: singular at alphas that the data decide.
    waypoints = [Waypoint(0, None, 0), Waypoint(1, 1, None), Waypoint(2, None, 3)]
    found = cp.choose_alpha(waypoints, "squared_velocity")
    fine = brute(waypoints, "squared_velocity", np.linspace(0, 5.5, 151))
    assert found.value <= fine.min() * (1 + 1e-6)


def test_a_singular_polynomial_leaves_the_others():
    # Slopes at both ends, a position and an acceleration half-way: no parabola or cubic is determined at alpha 0.
    waypoints = [Waypoint(0, None, 1), Waypoint(1, 0), Waypoint(2, None, -1), Waypoint(2.5, 0.3)]
    values = []
    for alpha in np.linspace(0, 5.5, 56):
        try:
            values.append(naive(cp.TrigSpline(waypoints, alpha=float(alpha)), "path", 401))
        except ValueError:
            values.append(np.inf)
    assert cp.choose_alpha(waypoints).value <= min(values) * (1 + 1e-4)


def test_alphas_none_of_which_gives_a_plan():
    with pytest.raises(ValueError, match="free entries must not make the system singular"):
        cp.choose_alpha([Waypoint(0, None, 0), Waypoint(1, None, 1)])


@pytest.mark.slow
def test_options_reach_the_family():
    phase = cp.choose_alpha(OBSTACLE, gamma=1.0)
    assert phase.plan.gamma == (1.0, 1.0)
    grid = []
    for alpha in np.linspace(0.02, 6.0, 80):
        try:
            grid.append(naive(cp.TrigSpline(OBSTACLE, alpha=float(alpha), gamma=1.0), "path"))
        except ValueError:
            grid.append(np.inf)
    assert phase.value <= min(grid) * (1 + 1e-6)
    higher = cp.choose_alpha(OBSTACLE, "squared_jerk", degree=7)
    assert higher.plan.degree == (7, 7)
    # More harmonics can do no worse on the integral that they are chosen by.
    assert higher.value < cp.choose_alpha(OBSTACLE, "squared_jerk").value
    assert cp.choose_alpha(OBSTACLE, labels=["a", "b"]).plan.labels == ("a", "b")


def test_unknown_options_are_rejected():
    with pytest.raises(TypeError, match="gama"):
        cp.choose_alpha(REST, gama=1.0)
    with pytest.raises(TypeError, match="gamma"):
        cp.choose_alpha(REST, family=cp.PiecewiseSpline, gamma=1.0)


@pytest.mark.parametrize("waypoints", [[], [Waypoint(0, 1)]])
def test_too_few_waypoints(waypoints):
    with pytest.raises(ValueError, match=f"a plan must have at least two waypoints, got {len(waypoints)}"):
        cp.choose_alpha(waypoints)


def test_waypoints_may_come_from_a_generator():
    assert cp.choose_alpha(w for w in OBSTACLE).alpha == cp.choose_alpha(OBSTACLE).alpha


@pytest.mark.slow
def test_piecewise_splines_have_an_alpha_too():
    found = cp.choose_alpha(OBSTACLE, "peak_jerk", family=cp.PiecewiseSpline)
    assert isinstance(found.plan, cp.PiecewiseSpline)
    values = brute(OBSTACLE, "peak_jerk", np.linspace(0, 5.5, 40), cp.PiecewiseSpline)
    assert found.value <= values.min() * (1 + 1e-5)
    assert found.alpha > 0.0


@pytest.mark.parametrize("family", [cp.TrigSpline, cp.PiecewiseSpline])
def test_auto_is_the_shortest_path(family):
    plan = family(OBSTACLE, alpha="auto")
    assert plan.alpha == cp.choose_alpha(OBSTACLE, family=family).alpha
    assert plan.labels == ("x", "z")
    again = cp.trajectory_from_dict(plan.to_dict())
    assert again.alpha == plan.alpha
    t = np.linspace(0, 16, 33)
    np.testing.assert_array_equal(again(t), plan(t))


@pytest.mark.slow
def test_auto_with_options():
    plan = cp.TrigSpline(OBSTACLE, alpha="auto", gamma=1.0, labels=["a", "b"])
    assert plan.alpha == cp.choose_alpha(OBSTACLE, gamma=1.0).alpha
    assert (plan.gamma, plan.labels) == ((1.0, 1.0), ("a", "b"))


def test_auto_is_saved_as_a_number(tmp_path):
    plan = cp.TrigSpline(OBSTACLE, alpha="auto")
    plan.save(tmp_path / "plan.json")
    assert cp.load_trajectory(tmp_path / "plan.json").alpha == plan.alpha
    assert '"auto"' not in (tmp_path / "plan.json").read_text()


def test_auto_stays_what_it_was_for_new_values():
    plan = cp.TrigSpline(OBSTACLE, alpha="auto")
    moved = plan.with_values([Waypoint(w.time, *(3.0 * w.jet)) for w in OBSTACLE])
    assert moved.alpha == plan.alpha
    np.testing.assert_allclose(moved([3.0, 9.0]), 3.0 * plan([3.0, 9.0]), rtol=1e-12)


def test_a_transition_has_nothing_to_choose_by():
    with pytest.raises(ValueError, match=r"alpha must be a number in \[0, 2 pi\) here, got 'auto'"):
        cp.Transition(2, 1.0, "auto")


@pytest.mark.parametrize("family", [cp.TrigSpline, cp.PiecewiseSpline])
def test_other_words_are_no_alpha(family):
    with pytest.raises(ValueError, match=r"alpha must lie in .* or be \"auto\", got 'Auto'"):
        family(REST, alpha="Auto")


def test_a_choice_stands_for_its_alpha():
    found = cp.choose_alpha(OBSTACLE)
    assert isinstance(found, AlphaChoice)
    assert float(found) == found.alpha
    assert cp.TrigSpline(OBSTACLE, alpha=found).alpha == found.alpha
    assert f"{found.alpha:.6g}" in repr(found)
    assert f"{found.value:.6g}" in repr(found)
    with pytest.raises(AttributeError):
        found.alpha = 0.0


@pytest.mark.slow
@examples(8)
@given(
    size=st.floats(1e-6, 1e6),
    duration=st.floats(1e-6, 1e6),
    start=st.sampled_from([0.0, -3.0, 1e3]),
    name=st.sampled_from(["path", "peak_jerk", "squared_jerk"]),
)
def test_neither_size_nor_time_unit_changes_the_choice(size, duration, start, name):
    rate = 16.0 / duration
    other = [
        Waypoint(start * duration + w.time / rate, *(size * rate**k * row for k, row in enumerate(w.jet)))
        for w in OBSTACLE
    ]
    ours, theirs = cp.choose_alpha(OBSTACLE, name), cp.choose_alpha(other, name)
    nu = {"path": 0, "peak_jerk": 3, "squared_jerk": 5}[name]
    power = 2 if name == "squared_jerk" else 1
    # The objective is flat at its minimum: the error of alpha is the square root of that of its values.
    assert theirs.alpha == pytest.approx(ours.alpha, abs=1e-4)
    assert theirs.value == pytest.approx(ours.value * size**power * rate**nu, rel=1e-8)


# Splines through other waypoints, of the same kind and shape


@pytest.mark.parametrize(
    "plan",
    [
        cp.TrigSpline(OBSTACLE, alpha=2.0),
        cp.TrigSpline(OBSTACLE, alpha=2.0, gamma=1.0),
        cp.TrigSpline(OBSTACLE, alpha=3.0, degree=7, smooth=2),
        cp.PolySpline(OBSTACLE),
        cp.PolySpline(OBSTACLE, degree=13),
        cp.PiecewiseSpline(OBSTACLE, alpha=1.0),
    ],
    ids=["trigonometric", "gamma", "degree", "polynomial", "polynomial degree", "piecewise"],
)
def test_through_keeps_kind_and_shape(plan):
    rng = np.random.default_rng(3)
    options = {k: v for k, v in plan.to_dict().items() if k not in ("type", "waypoints", "labels")}
    for times, entries in (([0.0, 6.0, 11.0, 16.0], 3), ([1.0, 2.0, 2.5, 7.0], 3), ([3.0, 4.0, 6.0, 8.0, 9.0], 2)):
        points = [Waypoint(t, *rng.normal(size=(entries, 2))) for t in times]
        found, expected = plan.through(points), type(plan)(points, labels=plan.labels, **options)
        assert type(found) is type(plan)
        assert found.waypoints == tuple(points)
        assert found.labels == ("x", "z")
        t = np.linspace(points[0].time, points[-1].time, 41)
        np.testing.assert_allclose(
            found.jet(t, 3), expected.jet(t, 3), rtol=1e-12, atol=1e-12 * np.abs(expected.jet(t, 3)).max()
        )


@pytest.mark.parametrize("kind", ["TrigSpline", "PolySpline", "PiecewiseSpline"])
def test_through_wants_as_many_axes(kind):
    plan = {
        "TrigSpline": cp.TrigSpline(OBSTACLE, alpha=1.0, gamma=[1.0, None]),
        "PolySpline": cp.PolySpline(OBSTACLE),
        "PiecewiseSpline": cp.PiecewiseSpline(OBSTACLE),
    }[kind]
    for naxes in (1, 3):
        with pytest.raises(ValueError, match=f"must keep the number of axes, 2, got {naxes}"):
            plan.through([Waypoint(0, np.zeros(naxes), 0), Waypoint(1, np.ones(naxes), 0)])


def test_through_checks_times():
    plan = cp.TrigSpline(OBSTACLE, alpha=1.0)
    with pytest.raises(ValueError, match="times must increase strictly"):
        plan.through([Waypoint(1, [0, 0]), Waypoint(0, [1, 1])])
    with pytest.raises(ValueError, match="at least two waypoints"):
        plan.through([Waypoint(1, [0, 0])])


def test_through_of_a_closed_plan_stays_within_its_period():
    plan = cp.TrigSpline.cyclic([Waypoint(0, 0), Waypoint(1, 1), Waypoint(2, -1)], 3.0)
    moved = plan.through([Waypoint(1, 0), Waypoint(1.5, 2), Waypoint(3, -1)])
    assert moved.duration == 3.0
    np.testing.assert_allclose(moved([1.0, 1.5, 3.0, 4.0]), [0, 2, -1, 0], atol=1e-14)
    with pytest.raises(ValueError, match="within one period"):
        plan.through([Waypoint(0, 0), Waypoint(1, 1), Waypoint(5, -1)])
