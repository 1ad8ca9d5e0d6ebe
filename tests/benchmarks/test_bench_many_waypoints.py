"""Cost of plans through many waypoints next to scipy and closed forms; ratios and growth are printed, none is asserted.

Each row runs its peer in the same process, in turn, by CPU time.
"""

import tracemalloc
from statistics import median
from time import process_time

import control as ct
import numpy as np
import pytest
from scipy.interpolate import BPoly, PPoly, make_interp_spline, make_lsq_spline, splrep

import ctrlplan as cp
from ctrlplan.trajectories.waypoint import Entries
from ctrlplan.trajectories.waypoint_spline import checked_waypoints

SIZES, ROUNDS = (100, 1000, 10_000), 7


def data(n):
    """Times [s], and positions, velocities and accelerations of three axes."""
    rng = np.random.default_rng(0)
    return np.cumsum(rng.uniform(0.5, 1.5, n)), *rng.normal(size=(3, 3, n))


def at_rest(n):
    row = np.full(n, np.nan)
    row[[0, -1]] = 0.0
    return {1: row, 2: row}


def quintics(times, y, v, a):
    """Power coefficients (6, 3, nsegments) in closed form."""
    h = np.diff(times)
    y0, y1, v0, v1 = y[:, :-1], y[:, 1:], v[:, :-1] * h, v[:, 1:] * h
    a0, a1, d = a[:, :-1] * h * h, a[:, 1:] * h * h, y[:, 1:] - y[:, :-1]
    return np.stack(
        [
            y0,
            v0,
            a0 / 2,
            10 * d - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1,
            -15 * d + 8 * v0 + 7 * v1 + 1.5 * a0 - a1,
            6 * (y1 - y0) - 3 * v0 - 3 * v1 - 0.5 * a0 + 0.5 * a1,
        ]
    )


def seconds(functions, repeat):
    """CPU time of one call of each, median of rounds in turn."""
    rows = []
    for _ in range(ROUNDS):
        row = []
        for function in functions:
            begin = process_time()
            for _ in range(repeat):
                function()
            row.append((process_time() - begin) / repeat)
        rows.append(row)
    return [median(column) for column in zip(*rows, strict=True)]


def report(capsys, benchmark, what, times, sizes=SIZES):
    """Print ratios to the peer, and the growth of the own time from the smallest to the largest size."""
    ratios = [own / peer for own, peer in times]
    growth = times[-1][0] / times[0][0]
    benchmark.extra_info["ratio"] = ratios[min(1, len(ratios) - 1)]
    cells = ", ".join(
        f"{n}: {1e3 * own:.3g} / {1e3 * peer:.3g} ms = {own / peer:.1f}"
        for n, (own, peer) in zip(sizes, times, strict=True)
    )
    with capsys.disabled():
        print(f"\n{what}: {cells}; growth {growth:.0f} for {sizes[-1] // sizes[0]}")


@pytest.mark.benchmark
@pytest.mark.parametrize("work", ["construct", "with_values"])
def test_free_entries_beside_make_interp_spline(work, benchmark, capsys):
    times = []
    for n in SIZES:
        t, y, _, _ = data(n)
        given, rest = at_rest(n), [(1, np.zeros(3)), (2, np.zeros(3))]
        plan = cp.PiecewiseSpline.from_arrays(t, y, derivatives=given)

        def ours(t=t, y=y, given=given, plan=plan):
            if work == "construct":
                return cp.PiecewiseSpline.from_arrays(t, y, derivatives=given)
            return plan.with_values(y, derivatives=given)

        def peer(t=t, y=y, rest=rest):
            return make_interp_spline(t, y.T, k=5, bc_type=(rest, rest))

        at = np.linspace(t[0], t[-1], 3001)
        assert np.abs(ours()(at) - peer()(at).T).max() <= 1e-12 * np.abs(peer()(at)).max()
        times.append(seconds((ours, peer), max(1, 3000 // n)))
        if n == SIZES[-2]:
            benchmark.pedantic(ours, rounds=5, warmup_rounds=1)
    report(capsys, benchmark, f"free entries, {work}, next to make_interp_spline(k=5)", times)


@pytest.mark.benchmark
@pytest.mark.parametrize("work", ["construct", "with_values"])
def test_all_entries_given_beside_closed_forms(work, benchmark, capsys):
    closed, bernstein = [], []
    for n in SIZES:
        t, y, v, a = data(n)
        plan = cp.PiecewiseSpline.from_arrays(t, y, derivatives={1: v, 2: a})

        def ours(t=t, y=y, v=v, a=a, plan=plan):
            if work == "construct":
                return cp.PiecewiseSpline.from_arrays(t, y, derivatives={1: v, 2: a})
            return plan.with_values(y, derivatives={1: v, 2: a})

        def peer(t=t, y=y, v=v, a=a):
            return quintics(t, y, v, a)

        spline = PPoly(peer()[::-1].transpose(0, 2, 1) / np.diff(t)[:, None] ** np.arange(5, -1, -1)[:, None, None], t)
        at = np.linspace(t[0], t[-1], 3001)
        assert np.abs(ours()(at) - spline(at).T).max() <= 1e-11 * np.abs(spline(at)).max()
        own, other = seconds((ours, peer), max(1, 3000 // n))
        closed.append((own, other))
        if n <= 1000:
            rows = np.stack([y.T, v.T, a.T], axis=1)
            begin = process_time()
            BPoly.from_derivatives(t, rows)
            bernstein.append((own, process_time() - begin))
        if n == SIZES[-2]:
            benchmark.pedantic(ours, rounds=5, warmup_rounds=1)
    report(capsys, benchmark, f"all entries given, {work}, next to closed-form quintics", closed)
    report(capsys, benchmark, f"all entries given, {work}, next to BPoly", bernstein, SIZES[:2])


@pytest.mark.benchmark
def test_one_time_beside_ppoly(benchmark, capsys):
    times = []
    for n in (10, *SIZES):
        t, y, v, a = data(n)
        plan = cp.PiecewiseSpline.from_arrays(t, y, derivatives={1: v, 2: a})
        coefficients = quintics(t, y, v, a)[::-1].transpose(0, 2, 1)
        spline = PPoly(coefficients / np.diff(t)[:, None] ** np.arange(5, -1, -1)[:, None, None], t)
        parts, at = [spline, spline.derivative(1), spline.derivative(2)], 0.3 * t[-1] + 0.7 * t[0]

        def ours(plan=plan, at=at):
            return plan.jet(at, 2)

        def peer(parts=parts, at=at):
            return np.array([part(at) for part in parts])

        assert np.abs(ours() - peer()).max() <= 1e-10 * np.abs(peer()).max()
        times.append(seconds((ours, peer), 300))
    benchmark.pedantic(ours, rounds=5, iterations=100, warmup_rounds=1)
    report(capsys, benchmark, "jet(t, 2) at one time, next to three PPoly", times, (10, *SIZES))


@pytest.mark.benchmark
def test_reading_waypoints(benchmark, capsys):
    times = []
    for n in SIZES:
        t, y, _, _ = data(n)
        points = [cp.Waypoint(moment, position) for moment, position in zip(t.tolist(), y.T, strict=True)]

        def ours(points=points):
            return Entries.of(checked_waypoints(points))

        def peer(points=points):
            return np.array([point.time for point in points]), np.array([point.jet for point in points])

        times.append(seconds((ours, peer), max(1, 3000 // n)))
        if n == SIZES[-2]:
            benchmark.pedantic(ours, rounds=5, warmup_rounds=1)
    report(capsys, benchmark, "reading waypoints, next to np.array of their jets", times)


@pytest.mark.benchmark
@pytest.mark.parametrize("derivative", [3, 4])
def test_optimum_waypoints_beside_make_interp_spline(derivative, benchmark, capsys):
    times, sizes = [], (10, 100, 1000)
    for n in sizes:
        t, y, _, _ = data(n)
        rest = [np.zeros(3)] * (derivative - 1)
        points = [
            cp.Waypoint(moment, position, *(rest if i in (0, n - 1) else []))
            for i, (moment, position) in enumerate(zip(t.tolist(), y.T, strict=True))
        ]
        ends = [(k, np.zeros(3)) for k in range(1, derivative)]

        def ours(points=points):
            return cp.optimize_waypoints(points, derivative=derivative)

        def peer(t=t, y=y, ends=ends):
            return make_interp_spline(t, y.T, k=2 * derivative - 1, bc_type=(ends, ends))

        at = np.linspace(t[0], t[-1], 1001)
        assert np.abs(ours().plan(at) - peer()(at).T).max() <= 1e-11 * np.abs(peer()(at)).max()
        times.append(seconds((ours, peer), max(1, 300 // n)))
    benchmark.pedantic(ours, rounds=5, warmup_rounds=1)
    degree = 2 * derivative - 1
    report(capsys, benchmark, f"optimize_waypoints({derivative}) next to make_interp_spline(k={degree})", times, sizes)


@pytest.mark.benchmark
@pytest.mark.parametrize("option", ["tolerance", "smoothing"])
def test_fit_beside_splrep(option, benchmark, capsys):
    """Noise of 0.01: the peer is given the sum of squares that our plan has reached."""
    times, sizes = [], (100, 1000, 10_000)
    for n in sizes:
        t = np.linspace(0.0, 10.0, n)
        y = np.sin(3 * t) + 0.3 * np.sin(7 * t) + np.random.default_rng(0).normal(scale=0.01, size=n)
        chosen = {"tolerance": 0.06} if option == "tolerance" else {"smoothing": 1.2e-4 * n}

        def ours(t=t, y=y, chosen=chosen):
            return cp.fit(t, y, **chosen)

        reached = float(((ours()(t) - y) ** 2).sum())

        def peer(t=t, y=y, reached=reached):
            return splrep(t, y, s=reached)

        assert ours().breakpoints.size <= 1.5 * peer()[0].size
        times.append(seconds((ours, peer), max(1, 1000 // n)))
    benchmark.pedantic(ours, rounds=3)
    report(capsys, benchmark, f"fit({option}=) next to splrep of the same deviation", times, sizes)


@pytest.mark.benchmark
def test_fit_near_the_noise_beside_least_squares(benchmark, capsys):
    """Noise of the tolerance. Peer: make_lsq_spline on the knots that our plan has. Goal: at most 2."""
    times, sizes = [], (1000, 5000, 20_000)
    for n in sizes:
        t = np.linspace(0.0, 10.0, n)
        y = np.sin(t) + np.random.default_rng(1).normal(scale=1e-3, size=n)

        def ours(t=t, y=y):
            return cp.fit(t, y, tolerance=1e-3)

        knots = np.concatenate([[t[0]] * 3, ours().breakpoints, [t[-1]] * 3])

        def peer(t=t, y=y, knots=knots):
            return make_lsq_spline(t, y, knots, k=3)

        np.testing.assert_allclose(ours()(t), peer()(t), rtol=0, atol=1e-12)
        times.append(seconds((ours, peer), 1))
    benchmark.pedantic(ours, rounds=1)
    report(capsys, benchmark, "fit near the noise next to make_lsq_spline of the same knots", times, sizes)


def knots_of_scipy(t, y, tolerance):
    """Spline on the first knots of the search of FITPACK whose largest deviation is within a tolerance."""
    from scipy.interpolate import generate_knots  # from scipy 1.15 on

    for knots in generate_knots(t, y, k=3, s=1e-30):
        spline = make_lsq_spline(t, y, knots, k=3)
        if np.abs(spline(t) - y).max() <= tolerance:
            break
    return spline


@pytest.mark.benchmark
@pytest.mark.parametrize("tolerance", [1e-3, 2e-3, 4e-3])
def test_fit_near_the_noise_beside_knots_of_scipy(tolerance, benchmark, capsys):
    """Noise of 1e-3. Peer: the search of scipy for knots, `generate_knots`, to the same largest deviation."""
    times, knots, sizes = [], [], (200, 1000)
    for n in sizes:
        t = np.linspace(0.0, 10.0, n)
        y = np.sin(t) + np.random.default_rng(1).normal(scale=1e-3, size=n)

        def ours(t=t, y=y):
            return cp.fit(t, y, tolerance=tolerance)

        def peer(t=t, y=y):
            return knots_of_scipy(t, y, tolerance)

        assert ours().deviation[0] <= tolerance >= np.abs(peer()(t) - y).max()
        knots.append(f"{ours().breakpoints.size} for {peer().t.size - 6}")
        times.append(seconds((ours, peer), 1))
    benchmark.pedantic(ours, rounds=1)
    title = f"fit to {tolerance:g} next to generate_knots (knots: {', '.join(knots)})"
    report(capsys, benchmark, title, times, sizes)


@pytest.mark.benchmark
def test_growth_of_what_uses_a_plan(benchmark, capsys, tmp_path):
    """Two decades of segments: each of these is to grow by about a hundred, and memory as well."""
    lag = ct.tf([1.0], [1.0, 1.0], inputs="u", outputs="y")
    rows: dict[str, list[float]] = {}
    for n in SIZES:
        t, y, _, _ = data(n)
        given = at_rest(n)
        tracemalloc.start()
        plan = cp.PiecewiseSpline.from_arrays(0.01 * t, y, derivatives=given)
        rows.setdefault("memory", []).append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        at, one = np.linspace(plan.start, plan.end, 2 * n), plan.select(["y1"])
        points = plan.waypoints
        work = {
            "retime": lambda plan=plan: plan.retime(2.0 * plan.duration),
            "save": lambda plan=plan: plan.save(tmp_path / "plan.json"),
            "load": lambda: cp.load_trajectory(tmp_path / "plan.json"),
            "jet": lambda plan=plan, at=at: plan.jet(at, 2),
            "extrema": lambda plan=plan: plan.extrema(1),
            "margins": lambda plan=plan: cp.margins(plan, {"velocity": 1e9}),
            "optimum": lambda points=points: cp.optimize_waypoints(points, alpha=1.0),
            "source": lambda plan=plan, at=at, n=n: [
                cp.create_source_iosystem(plan).output(time, [], []) for time in at[:: n // 50].tolist()
            ],
            "simulate": lambda one=one, at=at: cp.simulate(lag, at, one),
        }
        for name, function in work.items():
            begin = process_time()
            function()
            rows.setdefault(name, []).append(process_time() - begin)
    benchmark.pedantic(lambda: plan.jet(at, 2), rounds=3)
    with capsys.disabled():
        for name, values in rows.items():
            unit, factor = ("MB", 1e-6) if name == "memory" else ("ms", 1e3)
            cells = ", ".join(f"{factor * value:.3g}" for value in values)
            print(f"\n{name}: {cells} {unit}; growth {values[-1] / max(values[0], 1e-9):.0f} for 100", end="")
        print()


@pytest.mark.benchmark
def test_free_times_next_to_given_times(benchmark, capsys):
    """Peer: the same optimum at given times, of which a search over times needs many."""
    times, sizes = [], (10, 100, 300)
    for n in sizes:
        t, y, _, _ = data(n)
        rest = [np.zeros(3)] * 2
        points = [
            cp.Waypoint(moment, position, *(rest if i in (0, n - 1) else []))
            for i, (moment, position) in enumerate(zip(t.tolist(), y.T, strict=True))
        ]
        given = cp.optimize_waypoints(points)
        begin = process_time()
        free = cp.optimize_waypoints(points, free_times=True)
        middle = process_time()
        cp.optimize_waypoints(points)
        times.append((middle - begin, process_time() - middle))
        assert free.cost < given.cost
    benchmark.pedantic(lambda: cp.optimize_waypoints(points[:30], free_times=True), rounds=2)
    report(capsys, benchmark, "optimize_waypoints(free_times=True) next to given times", times, sizes)
