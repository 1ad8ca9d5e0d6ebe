"""More harmonics than constraints: the spare ones minimise int (y^(k))^2."""

import mpmath as mp
import numpy as np
import pytest
from scipy.linalg import null_space
from trajectory_oracle import miss, waypoints

from ctrlplan.trajectories import PolySpline, TrigSpline

# Data drawn at random and every alpha: most of these plans swing, on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:the plan swings")

NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)

DATA = {
    "rest to rest": ([0.0, 2.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
    "through points": ([1.0, 1.7, 2.0, 4.0], [[0.0, 0.0, 0.0], [2.0], [1.0, -1.0], [0.5, 0.0, 0.0]]),
    "velocity free": ([0.0, 1.0, 3.0], [[0.0, 0.0, 0.0], [2.0, None, 1.0], [1.0, 0.0]]),
}


def minimum(times, jets, degree, alpha, smooth):
    """Naive, in 60 digits: the conditions of Lagrange for the minimum of int (y^(smooth))^2 under the constraints."""
    given = [(t, k, v) for t, jet in zip(times, jets, strict=True) for k, v in enumerate(jet) if v is not None]
    with mp.workdps(60):
        space = Space(times, [t for t, _, _ in given], degree, alpha)
        rows = [space(t, k) for t, k, _ in given]
        quadrature = [
            [mp.sqrt(w) * f for f in space(mp.mpf(float(x)), smooth)] for x, w in zip(*space.quadrature(), strict=True)
        ]
        n, m = space.size, len(rows)
        system, right = mp.zeros(n + m, n + m), mp.zeros(n + m, 1)
        weighted = mp.matrix(quadrature)
        gram = weighted.T * weighted
        for i in range(n):
            for j in range(n):
                system[i, j] = gram[i, j]
        for i, row in enumerate(rows):
            right[n + i] = mp.mpf(given[i][2])
            for j, f in enumerate(row):
                system[n + i, j] = system[j, n + i] = f
        solved = mp.lu_solve(system, right)
        best = mp.matrix([solved[i] for i in range(n)])
        cost = float((best.T * gram * best)[0])

    def values(t, nu):
        with mp.workdps(60):
            return np.array([float(mp.fdot(best, space(x, nu))) for x in t])

    return values, cost


class Space:
    """Functions of (2) with gamma the mean of the constraints, or powers."""

    def __init__(self, times, constraints, degree, alpha):
        self.start, self.duration, self.degree, self.alpha = times[0], times[-1] - times[0], degree, mp.mpf(alpha)
        self.size = 2 * degree if alpha else degree + 1
        self.gamma = self.alpha * (mp.fsum(constraints) / len(constraints) - self.start) / self.duration

    def quadrature(self):
        return self.start + 0.5 * self.duration * (NODES + 1), 0.5 * self.duration * WEIGHTS

    def __call__(self, t, nu):
        u = (mp.mpf(float(t)) - self.start) / self.duration
        if not self.alpha:
            powers = [mp.ff(j, nu) * u ** (j - nu) if j >= nu else mp.mpf(0) for j in range(self.size)]
            return [p / mp.mpf(self.duration) ** nu for p in powers]
        rate = self.alpha / self.duration
        found = [mp.mpf(nu == 0)]
        for k in range(1, self.degree):
            turned = k * self.alpha * u + nu * mp.pi / 2
            found += [(k * rate) ** nu * mp.cos(turned), (k * rate) ** nu * mp.sin(turned)]
        top = self.degree * (self.alpha * u - self.gamma) + nu * mp.pi / 2
        return [*found, (self.degree * rate) ** nu * mp.sin(top)]


def cost(plan, smooth):
    t = plan.start + 0.5 * plan.duration * (NODES + 1)
    return 0.5 * plan.duration * WEIGHTS @ plan(t, smooth) ** 2


@pytest.mark.parametrize("smooth", [1, 3])
@pytest.mark.parametrize("alpha", [0.0, 2.0, 5.5])
@pytest.mark.parametrize("data", DATA)
@pytest.mark.parametrize("extra", [1, 3])
def test_the_smoothest_of_all_through_the_waypoints(data, alpha, smooth, extra):
    times, jets = DATA[data]
    count = sum(v is not None for jet in jets for v in jet)
    degree = (count + 1) // 2 + extra if alpha else count - 1 + 2 * extra
    points = waypoints(times, jets)
    options = {"degree": degree, "smooth": smooth}
    plan = TrigSpline(points, alpha=alpha, **options) if alpha else PolySpline(points, **options)
    exact, smallest = minimum(times, jets, degree, alpha, smooth)
    assert plan.degree == (degree,)
    assert miss(plan) <= 1e-12
    assert cost(plan, smooth) == pytest.approx(smallest, rel=1e-13)
    t = np.linspace(plan.start, plan.end, 21)
    for nu in range(3):
        values = exact(t, nu)
        np.testing.assert_allclose(plan(t, nu), values, rtol=0, atol=1e-12 * np.abs(values).max())


@pytest.mark.parametrize("alpha", [0.0, 3.0])
def test_every_change_that_keeps_the_waypoints_costs_more(alpha):
    """The cost is quadratic: at its minimum both directions of every free function increase it equally."""
    times, jets = DATA["through points"]
    degree, smooth = (7 if alpha else 12), 3
    plan = TrigSpline(waypoints(times, jets), alpha=alpha, degree=degree, smooth=smooth)
    given = [(t, k) for t, jet in zip(times, jets, strict=True) for k in range(len(jet))]
    space = Space(times, [t for t, _ in given], degree, alpha)

    def functions(t, nu):
        return np.array([[float(f) for f in space(x, nu)] for x in t]).T

    free = null_space(np.array([functions([t], k)[:, 0] for t, k in given]))
    assert free.shape[1] == space.size - len(given)
    t = plan.start + 0.5 * plan.duration * (NODES + 1)
    weights, jerk = 0.5 * plan.duration * WEIGHTS, plan(t, smooth)
    for direction in free.T @ functions(t, smooth):
        direction = direction * np.sqrt(cost(plan, smooth) / (weights @ direction**2))
        up, down = (weights @ (jerk + s * direction) ** 2 for s in (1e-3, -1e-3))
        assert up > cost(plan, smooth)
        assert down > cost(plan, smooth)
        assert abs(up - down) <= 1e-9 * cost(plan, smooth)


def test_the_polynomial_minimises_what_it_is_known_to():
    """The rest-to-rest move with m entries minimises int (y^(m))^2: additional degrees have no effect."""
    for m in (2, 3, 4):
        points = waypoints([0.0, 1.0], [[0.0] * m, [1.0] + [0.0] * (m - 1)])
        t = np.linspace(0, 1, 21)
        np.testing.assert_allclose(PolySpline(points, degree=2 * m + 6, smooth=m)(t), PolySpline(points)(t), atol=1e-13)


def test_the_degree_that_the_constraints_need_changes_nothing():
    """N = 6 needs m = 3 or a quintic; N = 7 a full trigonometric polynomial of degree 3."""
    t = np.linspace(0, 1, 21)
    for lengths in ([3, 3], [4, 3]):
        points = waypoints([0.0, 1.0], [[0.3] * k for k in lengths])
        np.testing.assert_array_equal(TrigSpline(points, alpha=2.0, degree=3)(t), TrigSpline(points, alpha=2.0)(t))
    points = waypoints([0.0, 1.0], [[0.3] * 3, [0.1] * 3])
    np.testing.assert_array_equal(PolySpline(points, degree=5)(t), PolySpline(points)(t))


def test_an_even_space_for_an_odd_number_of_constraints():
    """Seven constraints in m = 4 of (2): gamma stays the mean of the constraints."""
    plan = TrigSpline(waypoints([0.0, 1.0], [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), alpha=2.0, degree=4)
    assert plan.gamma[0] == pytest.approx(2.0 * 3 / 7, rel=1e-14)
    assert plan.fourier()[0].m == 4
    assert miss(plan) <= 1e-12


def test_with_values_keeps_the_degree():
    times, jets = DATA["through points"]
    plan = TrigSpline(waypoints(times, jets), alpha=2.0, degree=7, smooth=2)
    doubled = [[2 * v for v in jet] for jet in jets]
    again = plan.with_values(waypoints(times, doubled))
    t = np.linspace(1, 4, 31)
    np.testing.assert_allclose(again(t), 2 * plan(t), rtol=1e-13)
    assert again.degree == (7,)
