"""Changes of many states over a time, compared with closed forms in 40 digits."""

import mpmath as mp
import numpy as np
import pytest

from ctrlplan.simulation.exact import changes_over
from ctrlplan.simulation.exponential import MANY_STATES, cancels, changes_of_many, short_change

EPS = np.finfo(float).eps


def of_one_rate(rate, duration):
    """Change of x' = -rate x + w over a duration, from x and from w = 1 and w = t/duration."""
    with mp.workdps(40):
        z = mp.mpf(rate) * mp.mpf(duration)
        rise = -mp.expm1(-z)
        return [float(-rise), float(rise / rate), float((z - rise) / (rate * z))]


@pytest.mark.parametrize("duration", [1e-4, 0.3, 20.0])
def test_every_rate_keeps_its_digits(duration):
    """The relative error of each entry: that of the polynomial, and one more for each square."""
    rates = np.geomspace(1e-9, 1e5, 40)
    b = np.ones((40, 1))
    changes = changes_of_many(-duration * np.diag(rates), duration * b, 2)
    expected = np.array([of_one_rate(rate, duration) for rate in rates.tolist()])
    found = changes[-1]
    assert np.count_nonzero(found[:, :40]) == 40
    for column, want in zip((np.diag(found[:, :40]), found[:, 40], found[:, 41]), expected.T, strict=True):
        assert np.all(np.abs(column - want) <= (4.0 + 2.0 * len(changes)) * EPS * np.abs(want))


@pytest.mark.parametrize("nterms", [1, 2])
@pytest.mark.parametrize("ninputs", [0, 1, 3])
def test_turned_states(ninputs, nterms):
    """The same states in other orthogonal coordinates; rounding of products grows with the number of states."""
    rng = np.random.default_rng(ninputs)
    rates, turn = np.linspace(0.1, 30.0, 50), np.linalg.qr(rng.standard_normal((50, 50)))[0]
    gains = rng.standard_normal((50, ninputs))
    changes = changes_of_many(-turn @ np.diag(rates) @ turn.T, turn @ gains, nterms)
    expected = np.array([of_one_rate(rate, 1.0) for rate in rates.tolist()])
    want = np.hstack(
        [turn @ np.diag(expected[:, 0]) @ turn.T, *(turn @ (expected[:, 1 + k, None] * gains) for k in range(nterms))]
    )
    assert changes[-1].shape == want.shape == (50, 50 + nterms * ninputs)
    assert np.abs(changes[-1] - want).max() <= 50 * EPS * rates.max() * max(1.0, np.abs(gains).max(initial=0.0))
    # Over shorter times: each is the one before, doubled.
    for number, change in enumerate(reversed(changes)):
        decay = np.expm1(-rates * 0.5**number)
        assert np.abs(change[:, :50] - turn @ np.diag(decay) @ turn.T).max() <= 50 * EPS * rates.max()


@pytest.mark.parametrize("gain", [0.1, 3.0])
def test_states_in_series(gain):
    """Powers of a nilpotent matrix: exp(a) has the entries exp(-1) gain^k / k!."""
    n = 40
    found = changes_of_many(gain * np.eye(n, k=1) - np.eye(n), np.zeros((n, 0)), 1)[-1]
    with mp.workdps(40):
        want = [float(mp.exp(-1) * mp.mpf(gain) ** k / mp.factorial(k) - (k == 0)) for k in range(n)]
    size = np.abs(want).max()
    for k in range(n):
        assert np.abs(np.diag(found, k) - want[k]).max() <= n * EPS * size


def test_a_short_change_is_that_of_the_exponential():
    """Norms up to 1, on both sides of the reach of the polynomial."""
    for rate in (1e-12, 0.5, 0.65, 0.651, 1.0):
        found = short_change(-rate * np.eye(3))
        assert np.abs(np.diag(found) - float(mp.expm1(-rate))).max() <= 6.0 * EPS * rate


def test_far_from_normal_is_left_to_more_digits():
    """A gain of 1e6 between two rates: none of the few products is used, and the result has its digits."""
    n = MANY_STATES + 2
    a = np.diag(-np.linspace(1.0, 2.0, n))
    a[0, -1] = 1e6
    assert changes_of_many(a, np.zeros((n, 0)), 1) is None
    found = changes_over(a, np.zeros((n, 0)), 1)[-1]
    with mp.workdps(40):
        want = float(mp.mpf(10) ** 6 * (mp.exp(-1) - mp.exp(-2)))
    assert abs(found[0, -1] - want) <= 100.0 * EPS * want
    assert np.abs(np.diag(found) - np.expm1(np.diag(a))).max() <= 100.0 * EPS


def test_overflow_and_cancellation():
    n = MANY_STATES
    none = np.zeros((n, 0))
    for factor in (1e200, np.inf):
        with np.errstate(all="ignore"):
            assert changes_of_many(factor * np.eye(n), none, 1) is None
    assert changes_of_many(1e3 * np.eye(n), none, 1) is None
    one = np.array([[10.0, 10.0], [10.0, 10.0]])
    other = np.array([[10.0, 10.0], [-10.0, -10.0]])
    assert cancels(one, other, one @ other)
    assert not cancels(one, one, one @ one)
    assert not cancels(np.eye(2), np.eye(2), np.eye(2))
