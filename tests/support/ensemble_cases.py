"""Loops with parameters, in each way in which they may be run, and their draws."""

import pickle

import control as ct
import numpy as np

import ctrlplan as cp

TIMES = np.linspace(0.0, 10.0, 501)
PLANS = {"step": cp.Step(1.0), "ramp": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)])}
LAGS = cp.draws(21, seed=3, tau=(0.5, 1.5))


def block(update, params, out=None, nstates=1, **names):
    return ct.nlsys(
        update,
        out or (lambda t, x, u, params: x),
        states=nstates,
        inputs="r",
        outputs=names.pop("outputs", "y"),
        params=params,
        name=names.pop("name", "lag"),
    )


def lag(update=None, tau=1.0):
    return block(update or (lambda t, x, u, params: (u - x) / params["tau"]), {"tau": tau})


def exploding(k=0.01):
    """Its x' = k x^2 from 1 is 1/(1 - k t)."""
    return block(lambda t, x, u, params: params["k"] * x * x, {"k": k}, name="explosive")


def lag_response(tau, t):
    """Of tau y' = r - y to the step, and to the ramp that ends at 1 s."""
    tau = np.asarray(tau)[..., None]
    held = np.minimum(t, 1.0)
    step = 1.0 - np.exp(-t / tau)
    ramp = np.where(t <= 1.0, held - tau * (1.0 - np.exp(-held / tau)), 0.0)
    after = 1.0 - tau * (1.0 - np.exp(-1.0 / tau)) * np.exp(-(t - held) / tau)
    return {"step": step, "ramp": np.where(t <= 1.0, ramp, after)}


def run(loop, params, executor=None, plans=PLANS, times=TIMES, progress=False, **options):
    return cp.monte_carlo(loop, params, plans, times, executor=executor, progress=progress, **options)


def same_bits(one, other):
    assert one.finished == other.finished
    assert one.failures == other.failures
    for name in ("metrics", "bands"):
        left, right = getattr(one, name), getattr(other, name)
        assert list(left) == list(right)
        for plan, rows in left.items():
            assert list(rows) == list(right[plan])
            for key, row in rows.items():
                np.testing.assert_array_equal(row, right[plan][key])


class Elsewhere:
    """Nothing but submit and result; what goes in and comes out is pickled, as on its way to another process."""

    def __init__(self):
        self.tasks = []

    def submit(self, function, /, *arguments, **named):
        self.tasks.append(pickle.dumps((function, arguments, named)))
        return Answer(self, len(self.tasks) - 1)

    def answer(self, k):
        function, arguments, named = pickle.loads(self.tasks[k])
        return pickle.loads(pickle.dumps(function(*arguments, **named)))


class Answer:
    """Has nothing but a result."""

    def __init__(self, owner, k):
        self.owner, self.k = owner, k

    def result(self):
        return self.owner.answer(self.k)
