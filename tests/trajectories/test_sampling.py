"""Many times in one call: uniform, sorted and arbitrary ones agree with the jets at a few times."""

import tracemalloc

import mpmath
import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy.interpolate import BPoly
from trajectory_oracle import Direct, waypoints

from ctrlplan.trajectories import PiecewiseSpline, PolySpline, TrigSpline, Waypoint, sampling, stack
from ctrlplan.trajectories.newton import NewtonSystem

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

EPS = np.finfo(float).eps
ALPHAS = [0.0, 0.3, 1.0, 3.0, 5.5]
COUNTS = [257, 1000, 4097, 4500, 5000, 6500, 20_000, 100_000]


def random_plan(size, alpha, kind=TrigSpline, naxes=1):
    """Through Chebyshev-like times with jets of 1 to 3 entries, so that N = 6 to 40 stays moderate."""
    rng = np.random.default_rng(size)
    count = max(2, size // 2)
    times = 3.0 + 2.0 * np.cos(np.pi * np.arange(count - 1, -1, -1) / (count - 1))
    lengths = np.full(count, size // count)
    lengths[[0, -1]] += [(size - lengths.sum() + 1) // 2, (size - lengths.sum()) // 2]
    points = [
        Waypoint(
            t,
            *rng.normal(size=(k, naxes)),
        )
        for t, k in zip(times, lengths, strict=True)
    ]
    return kind(points, alpha=alpha)


def swinging(size):
    """The Chebyshev polynomial of the highest degree, with the largest cancellation of Taylor terms."""
    x = np.cos(np.pi * np.arange(size - 1, -1, -1) / (size - 1))
    return PolySpline([Waypoint(t, (-1.0) ** i) for i, t in enumerate(x)])


def few_at_a_time(plan, t, order):
    return np.concatenate([plan.jet(part, order) for part in np.array_split(t, -(-t.size // 250))], axis=2)


def disagreement(plan, t, order=2, tolerance=1e-13):
    """Maximum difference from the jets themselves; 1 is the tolerance plus what the rounding of times allows."""
    got = plan.jet(t, order)
    picked = np.unique(np.concatenate([np.arange(0, t.size, max(1, t.size // 3000)), np.arange(t.size - 30, t.size)]))
    exact = few_at_a_time(plan, t[picked], order + 1)
    size = np.abs(exact).max(axis=2)[:, :, None]
    allowed = tolerance * size[:-1] + 4 * EPS * plan.duration * size[1:]
    return float((np.abs(got[:, :, picked] - exact[:-1]) / allowed).max())


def orders_of(plan, count, rng):
    """Evenly spaced, sorted, and unsorted times in the interval."""
    inside = rng.uniform(plan.start, plan.end, count)
    return {"uniform": np.linspace(plan.start, plan.end, count), "sorted": np.sort(inside), "arbitrary": inside}


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("size", [6, 12, 24, 40])
def test_all_paths_agree_with_the_jets(size, alpha):
    plan = random_plan(size, alpha, naxes=2)
    rng = np.random.default_rng(1)
    for count in COUNTS:
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("size", [6, 12, 24, 40])
def test_all_paths_agree_where_taylor_terms_cancel(size):
    plan = swinging(size)
    rng = np.random.default_rng(1)
    for count in COUNTS:
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("order", [0, 1, 3, 4])
@pytest.mark.parametrize("alpha", [0.0, 2.0, 5.5])
def test_other_orders_of_derivatives(alpha, order):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(2)
    for count in (5000, 30_000):
        for name, t in orders_of(plan, count, rng).items():
            assert disagreement(plan, t, order=order) <= 1, (name, count)
            np.testing.assert_allclose(
                plan(t, order), plan.jet(t, order)[order, 0], rtol=0, atol=1e-12 * plan.peak(order)[0]
            )


@pytest.mark.parametrize("alpha", [0.0, 4.0])
def test_a_part_of_the_interval(alpha):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(3)
    for low, high in [(0.0, 0.01), (0.4, 0.6), (0.999, 1.0)]:
        a, b = plan.start + plan.duration * np.array([low, high])
        for name, t in {"uniform": np.linspace(a, b, 7000), "sorted": np.sort(rng.uniform(a, b, 7000))}.items():
            assert disagreement(plan, t) <= 1, (name, low)
        assert disagreement(plan, rng.uniform(a, b, 7000)) <= 1
    assert disagreement(plan, np.linspace(plan.end, plan.start, 9000)) <= 1


@pytest.mark.parametrize("alpha", [0.0, 4.0])
def test_times_outside_are_mixed_in(alpha):
    plan = random_plan(12, alpha)
    rng = np.random.default_rng(4)
    wide = rng.uniform(plan.start - plan.duration, plan.end + plan.duration, 30_000)
    for t in (wide, np.sort(wide), np.linspace(plan.start - 1, plan.end + 1, 30_000)):
        assert disagreement(plan, t) <= 1
        outside = (t < plan.start) | (t > plan.end)
        jet = plan.jet(t, 2)
        np.testing.assert_array_equal(jet[1:, :, outside], 0)
        np.testing.assert_array_equal(
            jet[0][:, t < plan.start], np.repeat(plan.initial[:, None], (t < plan.start).sum(), 1)
        )
        np.testing.assert_array_equal(jet[0][:, t > plan.end], np.repeat(plan.final[:, None], (t > plan.end).sum(), 1))


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_several_segments(alpha):
    """Some with many samples, some with few; a join among the times."""
    times = [0.0, 1.0, 1.001, 4.0, 9.0]
    rng = np.random.default_rng(5)
    segments = PiecewiseSpline(waypoints(times, rng.normal(size=(5, 3)).tolist()), alpha=alpha)
    plan = stack([segments, segments.shift(0.3) + 2 * segments])
    for count in (6000, 50_000):
        for name, t in orders_of(plan, count, rng).items():
            if name == "arbitrary":
                t[count // 2] = 4.0
            assert disagreement(plan, t) <= 1, (name, count)


@pytest.mark.parametrize("duration", [1e-6, 1e6])
def test_short_and_long_plans_far_from_the_origin(duration):
    jets = [[0.0, 1.0 / duration], [2.0, 0.0], [1.0, -1.0 / duration]]
    rng = np.random.default_rng(6)
    for start in (0.0, 1e6 * duration):
        plan = TrigSpline(waypoints(start + duration * np.array([0.0, 0.4, 1.0]), jets), alpha=2.0)
        for name, t in orders_of(plan, 8000, rng).items():
            assert disagreement(plan, t) <= 1, (name, start)


def test_against_fifty_digits():
    """Not the package's own jets: equation (2) solved directly."""
    times, jets = [0.0, 0.3, 1.0], [[0.0, 1.0, 2.0], [1.0, -1.0], [0.5, 0.0, 3.0]]
    plan, oracle = TrigSpline(waypoints(times, jets), alpha=3.0), Direct(times, jets, 3.0)
    rng = np.random.default_rng(7)
    for t in orders_of(plan, 5000, rng).values():
        some = np.r_[0:5000:400, 4999]
        exact = oracle.jet(t[some], 2)
        size = np.abs(exact).max(axis=1, keepdims=True)
        assert (np.abs(plan.jet(t, 2)[:, 0, some] - exact) / size).max() <= 2e-13


@pytest.mark.parametrize("alpha", [0.0, 3.0])
def test_very_many_times_against_fifty_digits(alpha):
    """Taylor series in cells: the third derivative too, the last cell short, one cell across a gap."""
    times, jets = [0.0, 0.3, 1.0], [[0.0, 1.0, 2.0], [1.0, -1.0], [0.5, 0.0, 3.0]]
    plan, oracle = TrigSpline(waypoints(times, jets), alpha=alpha), Direct(times, jets, alpha)
    rng, count = np.random.default_rng(7), 300_500
    given = orders_of(plan, count, rng)
    inside = given["arbitrary"]
    given["with a gap"] = np.sort(np.where(inside > 0.5, 0.9 + 0.1 * inside, 0.2 * inside))
    given["dense at one end"] = np.sort(inside**3)
    for name, t in given.items():
        found = plan.jet(t, 3)[:, 0]
        gap = int(np.diff(t).argmax()) if name != "arbitrary" else 0
        some = np.unique(np.r_[0 : count : count // 17, gap : gap + 2, count - 500 : count : 100, count - 1])
        exact = oracle.jet(t[some], 3)
        size = np.abs(found).max(axis=1, keepdims=True)
        assert (np.abs(found[:, some] - exact) / size).max() <= 2e-14, name


@pytest.mark.parametrize("count", [300_001, 301_056, 302_000])
def test_cells_of_sorted_times_agree_with_the_jets(count):
    """Whole cells only, and a last cell of few times; equal times; times that are close together."""
    plan = random_plan(12, 1.0, naxes=2)
    rng = np.random.default_rng(5)
    for name, t in orders_of(plan, count, rng).items():
        assert disagreement(plan, t, order=3) <= 1, name
    a, b = plan.start + plan.duration * np.array([0.3, 0.30001])
    t = np.sort(rng.uniform(a, b, count))
    assert disagreement(plan, t) <= 1
    t[1000:9000] = t[1000]
    assert disagreement(plan, t) <= 1


def test_times_that_are_all_the_same():
    plan = random_plan(12, 2.0)
    t = np.full(5000, plan.start + 0.3)
    np.testing.assert_allclose(plan.jet(t, 2), np.repeat(plan.jet(t[:1], 2), 5000, axis=2), rtol=1e-13)
    t[:100] = plan.start
    assert disagreement(plan, np.sort(t)) <= 1


def test_almost_uniform_times_are_not_taken_for_uniform():
    """A hiccup of one sample in a million is seen."""
    plan = random_plan(12, 1.0)
    t = np.linspace(plan.start, plan.end, 50_001)
    t[33_333] += 0.4 * plan.duration / 50_000
    assert plan(t)[33_333] == pytest.approx(float(plan(t[33_333])), rel=1e-14)
    warped = plan.start + plan.duration * np.linspace(0, 1, 50_000) ** 1.0001
    assert disagreement(plan, warped) <= 1


def test_axes_that_vanish_or_stand_still():
    points = [Waypoint(0.0, [0.0, 5.0, 1e-200, 0.0], 0), Waypoint(1.0, [0.0, 5.0, 2e-200, 1e200], 0)]
    plan = TrigSpline(points, alpha=1.0)
    rng = np.random.default_rng(8)
    for t in orders_of(plan, 9000, rng).values():
        jet, exact = plan.jet(t, 2), few_at_a_time(plan, t, 2)
        size = np.abs(exact).max(axis=2, keepdims=True)
        np.testing.assert_array_equal(jet[:, 0], 0)
        np.testing.assert_allclose(jet[0, 1], 5.0, rtol=1e-14)
        assert (np.abs(jet - exact)[:, 2:] <= 1e-13 * size[:, 2:]).all()


@pytest.mark.parametrize("name", ["uniform", "sorted", "arbitrary"])
@pytest.mark.parametrize("segments", [1, 3])
def test_memory_is_a_small_multiple_of_the_result(segments, name):
    if segments == 1:
        plan = random_plan(12, 1.0, naxes=2)
    else:
        points = [Waypoint(float(i), *np.random.default_rng(i).normal(size=(3, 2))) for i in range(segments + 1)]
        plan = PiecewiseSpline(points, alpha=1.0)
    t = orders_of(plan, 1_000_000, np.random.default_rng(9))[name]
    plan.jet(t[:10_000], 2)
    tracemalloc.start()
    result = plan.jet(t, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert result.shape == (3, 2, t.size)
    assert peak <= 2.5 * result.nbytes


# The parts of which interpolants are made


@pytest.mark.parametrize("size", [1, 2, 3, 12, 25, 33, 64, 129])
def test_products_are_chebyshev_polynomials(size):
    """Against numpy's Clenshaw recurrence, for random series and for each polynomial alone, at both ends as well."""
    t = np.append(np.random.default_rng(size).uniform(0.0, 5.0, 300), [0.0, 2.5, 5.0])
    series = np.concatenate([np.random.default_rng(1).normal(size=(3, size)), np.eye(size)])
    out = np.empty((len(series), 1, t.size))
    sampling.evaluate([sampling.Part(sampling.in_products(series), 0, t.size, 0.0, 5.0)], t, out)
    exact = chebyshev.chebval(t / 2.5 - 1.0, series.T)
    # Rounding of x and of each square, multiplied by the derivative of the polynomials, at most size^2.
    assert (np.abs(out[:, 0] - exact) <= 4 * EPS * size**2 * np.abs(series).sum(axis=1)[:, None]).all()
    assert sampling.Interpolant.of(series[:, None]).is_finite
    with np.errstate(over="ignore"):
        assert not sampling.Interpolant.of(series[:, None] + 1e308).is_finite


@pytest.mark.parametrize("alpha", [1e-9, 0.7, 3.0, 6.2, 2 * np.pi])
@pytest.mark.parametrize("size", [1, 2, 3, 12, 25])
def test_products_of_sines_are_all_harmonics(size, alpha):
    """Cosines and sines of multiples of the angle, in forty digits, from their values at the points alone."""
    degree, t = size // 2, np.append(np.random.default_rng(size).uniform(0.0, 5.0, 100), [0.0, 2.5, 5.0])
    with mpmath.workdps(40):

        def harmonics(u):
            angles = [mpmath.mpf(alpha) * (mpmath.mpf(v) - 0.5) for v in u.tolist()]
            functions = [(f, k) for f in (mpmath.cos, mpmath.sin) for k in range(f is mpmath.sin, degree + 1)]
            return np.array([[float(f(k * w)) for w in angles] for f, k in functions])

        points, products = sampling.collocation(alpha, size)
        given, exact = harmonics(points), harmonics(t / 5.0)
    assert products.shape == (points.size, 2 * degree + 1)
    out = np.empty((len(exact), 1, t.size))
    sampling.evaluate([sampling.Part(given @ products, 0, t.size, 0.0, 5.0)], t, out, alpha)
    # As for polynomials: rounding of x, multiplied by the derivative of the polynomials.
    assert (np.abs(out[:, 0] - exact) <= 8 * EPS * (size + 1) ** 2 * np.abs(exact).max(axis=1)[:, None]).all()


@pytest.mark.parametrize("alpha", [0.0, 1e-9, 0.7, 3.0, 2 * np.pi])
def test_functions_between_nodes_in_fifty_digits(alpha):
    """Products of sines and cosines, differentiated by mpmath; near a node as well."""
    times, given = np.array([0.0, 0.3, 1.0]), ((0, 1, 2), (0,), (0, 1))
    system = NewtonSystem(alpha, times, given)
    nodes = system._nodes.tolist()
    u = np.array([1e-9, 0.21, 0.3 + 1e-7, 0.8, 1.0 - 1e-4])
    with mpmath.workdps(50):
        half = mpmath.mpf(alpha) / 2

        def function(k, at):
            def angle(i):
                return at - mpmath.mpf(nodes[i])

            product = mpmath.mpf(1)
            for i in range(k):
                product *= mpmath.sin(half * angle(i)) / half if alpha else angle(i)
            return product * (mpmath.cos(half * angle(k)) if k % 2 else 1)

        exact = [
            [mpmath.taylor(lambda at, k=k: function(k, at), mpmath.mpf(v), 3) for v in u.tolist()]
            for k in range(system.size)
        ]
    exact = np.array(exact, dtype=float).transpose(2, 0, 1)
    for order in range(4):
        found = system.taylor_between(u, order)
        assert found.shape == (order + 1, system.size, u.size)
        size = np.abs(exact[: order + 1]).max(axis=2, keepdims=True)
        assert (np.abs(found - exact[: order + 1]) <= 20 * EPS * size).all()


@pytest.mark.parametrize("alpha", [0.0, 1e-9, 0.7, 3.0, 2 * np.pi])
def test_series_at_waypoints_in_turn_are_those_of_all_times(alpha):
    """The factors of the pairs as matrices; with other orders at each waypoint, more functions, and gamma."""
    rng = np.random.default_rng(3)
    for given, options in (
        (((0, 1, 2),) * 4, {}),
        (((0,),), {}),
        (((0, 1), (0,), (0, 1, 2, 3)), {}),
        (((0, 1), (0, 1)), {"size": 6}),
        (((0, 1, 2), (0, 1, 2)), {"gamma": 0.3} if alpha > 1.0 else {}),
    ):
        times = np.cumsum(rng.uniform(0.2, 1.0, len(given)))
        times = (times - times[0]) / (times[-1] - times[0] or 1.0)
        system = NewtonSystem(alpha, times, given, **options)
        count = system.order_index.size
        series = system.taylor(times, int(system.order_index.max()))
        wanted = series[:count, system.order_index, system.waypoint_index].T
        size = np.abs(series[:count]).max(axis=(1, 2))
        assert (np.abs(system._triangle - wanted) <= 20 * EPS * size).all()


@pytest.mark.parametrize("n", [3, 18, 19, 40])
@pytest.mark.parametrize("left", [False, True])
def test_times_in_any_order_of_few_and_many_segments(n, left):
    """As sorted: to rounding between breakpoints, in every bit at them; against scipy's polynomials."""
    rng = np.random.default_rng(n)
    times, rows = np.cumsum(rng.uniform(0.5, 1.5, n)), rng.normal(size=(3, n))
    plan = PiecewiseSpline.from_arrays(times, rows[0], derivatives={1: rows[1], 2: rows[2]}, warn=False)
    t = np.sort(np.append(rng.uniform(times[0], times[-1], 100 * n), times[1:]))
    mixed = rng.permutation(t.size)
    found, back = plan.jet(t, 2, left=left), np.empty((3, 1, t.size))
    back[:, :, mixed] = plan.jet(t[mixed], 2, left=left)
    assert (np.abs(back - found) <= 64 * EPS * np.abs(found).max(axis=2, keepdims=True)).all()
    at = np.searchsorted(t, times[1:])
    np.testing.assert_array_equal(back[:, 0, at], rows[:, 1:])
    exact = BPoly.from_derivatives(times, rows.T)
    assert np.abs(back[0, 0] - exact(t)).max() <= 1e-13 * np.abs(rows).max()


def test_functions_at_nodes_and_of_high_orders_are_those_of_all_times():
    system = NewtonSystem(1.0, np.array([0.0, 0.5, 1.0]), ((0, 1), (0, 1), (0, 1)))
    for u in (np.array([0.2, 0.5]), np.array([1e-200, 0.7, 0.5 + 1e-14, 1.0])):  # at nodes, or near
        near = np.abs(u[:, None] - [0.0, 0.5, 1.0]).min(axis=1) < 1e-9
        found = system.taylor_between(u, 3)
        np.testing.assert_array_equal(found[:, :, near], system.taylor(u[near], 3).transpose(1, 0, 2))
        np.testing.assert_array_equal(found[:, :, ~near], system.taylor_between(u[~near], 3))
    u = np.array([0.2, 0.7])
    np.testing.assert_array_equal(system.taylor_between(u, 5), system.taylor(u, 5).transpose(1, 0, 2))


@pytest.mark.parametrize("alpha", [0.0, 1e-9, 0.7, 3.0, 2 * np.pi])
@pytest.mark.parametrize("count", [7, 300])
@pytest.mark.parametrize("order", [0, 1, 3, 5])
def test_jets_are_sums_of_the_functions(alpha, count, order):
    rng = np.random.default_rng(5)
    system = NewtonSystem(alpha, np.array([0.0, 0.3, 1.0]), ((0, 1, 2), (0,), (0, 1)))
    coefficients, u = rng.normal(size=(system.size, 3)), np.sort(rng.uniform(size=count))
    series = system.taylor(u, order)
    wanted = np.einsum("ma,mkt->kat", coefficients, series)
    size = np.einsum("ma,mk->ka", np.abs(coefficients), np.abs(series).max(axis=2))
    assert (np.abs(system.jet(coefficients, u, order) - wanted) <= 50 * EPS * size[:, :, None]).all()


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_plans_with_the_same_relative_times_share_their_system(alpha):
    """Twice as long: each derivative is divided by a power of two, in every bit. Other options are other systems."""
    rng = np.random.default_rng(13)
    jets, powers = rng.normal(size=(2, 3, 2)), 0.5 ** np.arange(3)[:, None]

    def plan(times, scale, **options):
        points = [Waypoint(t, *(jet * scale)) for t, jet in zip(times, jets, strict=True)]
        return TrigSpline(points, alpha=alpha, **options) if alpha else PolySpline(points, **options)

    short, long, rich = plan([0.0, 1.5], 1.0), plan([4.0, 7.0], powers), plan([0.0, 1.5], 1.0, degree=7)
    assert short._parts[0][1] is long._parts[0][1]
    assert rich._parts[0][1] is not short._parts[0][1]
    t = np.linspace(0.0, 1.5, 385)
    np.testing.assert_array_equal(long.jet(4.0 + 2.0 * t, 2), short.jet(t, 2) * powers[:, :, None])
    np.testing.assert_array_equal(long.jet(4.75, 2), short.jet(0.375, 2) * powers)


ENDS = {
    "polynomial": lambda points: PolySpline(points),
    "trigonometric": lambda points: TrigSpline(points, alpha=2.3),
    "nearly closed": lambda points: TrigSpline(points, alpha=6.2),
    "piecewise": lambda points: PiecewiseSpline(points),
    "piecewise trigonometric": lambda points: PiecewiseSpline(points, alpha=1.7),
}


@pytest.mark.parametrize("kind", ENDS)
def test_ends_have_the_entries_of_waypoints_in_every_bit(kind):
    """Whatever the way of calling, also where an entry is free."""
    rng = np.random.default_rng(11)
    jets = rng.normal(size=(3, 3, 2))
    jets[0, 1, 0] = jets[2, 2, 1] = np.nan
    plan = ENDS[kind]([Waypoint(float(t), *jet) for t, jet in zip([0.3, 1.0, 2.1], jets, strict=True)])
    t = np.linspace(plan.start, plan.end, 1001)
    for k, end in ((0, plan.start), (-1, plan.end)):
        for found in (plan.jet(end, 2), plan.jet([end], 2)[..., 0], plan.jet(t, 2)[..., k]):
            assert ((found == jets[k]) | np.isnan(jets[k])).all()
        assert np.abs(plan.jet(end, 4) - plan.jet(t, 4)[..., k]).max() <= 1e-11 * np.abs(plan.jet(t, 4)).max()
        nearby = plan.jet(end + (1e-9 if k == 0 else -1e-9), 2)
        slack = 1e-12 * np.abs(plan.jet(t, 2)).max(axis=2) + 2e-9 * np.abs(plan.jet(t, 3)[1:]).max(axis=2)
        assert (np.abs(plan.jet(end, 2) - nearby) <= slack).all()


@pytest.mark.parametrize("kind", ENDS)
@pytest.mark.parametrize("count", [300, 2000])
def test_ends_among_many_times_in_any_order(kind, count):
    """Once, many times or never, sorted or not: the entries there in every bit, and other values elsewhere."""
    rng = np.random.default_rng(14)
    jets = rng.normal(size=(3, 3, 2))
    for marks in ([0.3, 1.0, 2.1], [0.0, 1.0, 2.1]):
        plan = ENDS[kind]([Waypoint(t, *jet) for t, jet in zip(marks, jets, strict=True)])
        inside = rng.uniform(*plan.breakpoints[[0, -1]], count)
        begin, end = np.full(count // 3, plan.start), np.full(count // 4, plan.end)
        given = {
            "both once": np.r_[plan.start, np.sort(inside), plan.end],
            "both many times": np.r_[begin, np.sort(inside), end],
            "start only": np.r_[plan.start, np.sort(inside)],
            "end only": np.r_[np.sort(inside), end],
            "neither": inside,
            "mixed": rng.permutation(np.r_[begin, inside, end]),
            "one inside": np.r_[inside, plan.end, inside],
            "descending": np.sort(np.r_[plan.start, inside, plan.end])[::-1],
            "only starts": begin if begin.size > 256 else np.repeat(begin, 3),
        }
        for name, t in given.items():
            found = plan.jet(t, 2)
            for moment, jet in ((plan.start, jets[0]), (plan.end, jets[2])):
                assert (found[:, :, t == moment] == jet[:, :, None]).all(), name
            few = np.concatenate([plan.jet(part, 2) for part in np.array_split(t, 10)], axis=2)
            assert (np.abs(found - few) <= 1e-12 * np.abs(few).max(axis=2, keepdims=True)).all(), name


def times_of_segments(plan, count, rng):
    """Times that are hard to assign to segments."""
    marks, inside = plan.breakpoints, rng.uniform(plan.start, plan.end, count)
    return {
        **orders_of(plan, count, rng),
        "at breakpoints": rng.choice(marks, count),
        "sorted at breakpoints": np.sort(rng.choice(marks, count)),
        "next to breakpoints": np.nextafter(rng.choice(marks[1:], count), -np.inf),
        "one breakpoint": np.full(count, marks[marks.size // 2]),
        "descending": np.sort(inside)[::-1],
        "repeated": np.repeat(inside[: count // 5], 5),
        "one segment": np.linspace(marks[1], marks[2], count),
        "outside": rng.uniform(plan.start - 1.0, plan.end + 1.0, count),
    }


@pytest.mark.parametrize("alpha", [0.0, 2.0])
@pytest.mark.parametrize("count", [300, 2000, pytest.param(70_000, marks=pytest.mark.slow)])
def test_a_piecewise_spline_at_many_times_and_at_each(count, alpha):
    """Some entries are free on one axis, so that there are several groups of functions."""
    rng = np.random.default_rng(12)
    jets = rng.normal(size=(9, 3, 3))
    jets[4, 1:, 1] = jets[6, 2, 2] = jets[0, 2, 1] = np.nan
    marks = np.cumsum(rng.uniform(0.2, 1.0, 9)) - 2.0
    plan = PiecewiseSpline([Waypoint(t, *jet) for t, jet in zip(marks.tolist(), jets, strict=True)], alpha=alpha)
    peaks = np.array([plan.peak(nu) for nu in range(5)])
    for name, t in times_of_segments(plan, count, rng).items():
        for left in (False, True):
            found = plan.jet(t, 3, left)
            for i in rng.choice(count, 12):
                exact = plan.jet(float(t[i]), 3, left)
                assert (np.abs(found[:, :, i] - exact) <= 1e-12 * peaks[:4]).all(), (name, left, t[i])


@pytest.mark.parametrize("count", [1, 31, 255, 256, 300, 777, 1023, 1024, 1025, 2047])
def test_fewer_times_than_a_cell_in_a_short_segment(count):
    cubic = PolySpline(waypoints([0.0, 2.0, 4.0], [[0.0], [1.0], [0.0]]))
    other = PiecewiseSpline(waypoints([0.0, 3.997, 5.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    plan = stack([cubic, other], labels=["a", "b"])
    t = np.linspace(3.997, 4.0, count, endpoint=False)
    for order in range(3):
        found = plan(t, order)
        exact = np.array([plan(x, order) for x in t.tolist()]).T
        assert np.abs(found - exact).max() <= 1e-13 * plan.peak(order).max()
