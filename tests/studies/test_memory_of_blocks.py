"""Studies of loops with a controller that remembers: every run as with a new controller."""

import control as ct
import numpy as np

import ctrlplan as cp

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLAN = cp.PolySpline(MOVE)
TIMES = np.linspace(0.0, 2.0, 101)


class Law:
    """PI controller with its integral as an attribute."""

    def __init__(self):
        self.total = 0.0

    def __call__(self, error):
        self.total += 0.08 * error
        return 2.0 * error + self.total


def held(law):
    block = ct.nlsys(None, lambda t, x, u, p: [law(u[0] - u[1])], inputs=["r", "y"], outputs="u", dt=0.02, name="law")
    return cp.sample_hold(block, 0.02)


def loop(controller, gain=1.0):
    plant = ct.nlsys(
        lambda t, x, u, p: [-x[0] - 0.1 * np.sin(x[0]) + p.get("gain", gain) * u[0]],
        inputs="u",
        outputs="y",
        states=1,
        params={"gain": gain},
        name="plant",
    )
    return ct.interconnect([controller, plant], inputs="r", outputs=["y", "u"], params={"gain": gain})


def iae(gain=1.0, plan=PLAN):
    return cp.compare(loop(held(Law()), gain), {"a": plan}, TIMES).metrics["a"]["iae"]


def test_plans_of_a_comparison():
    law = Law()
    given = cp.compare(loop(held(law)), MOVE, TIMES)
    built = cp.compare(lambda name, plan: loop(held(Law())), MOVE, TIMES)
    assert len(given.metrics) > 2
    assert {k: v["iae"] for k, v in given.metrics.items()} == {k: v["iae"] for k, v in built.metrics.items()}
    assert law.total == 0.0


def test_a_sweep_with_one_controller_in_all_loops():
    controller, gains = held(Law()), [0.5, 1.0, 2.0]
    found = cp.sweep(lambda gain: loop(controller, gain), gains, {"a": PLAN, "b": PLAN}, TIMES, progress=False)
    for name in ("a", "b"):
        np.testing.assert_array_equal(found.metrics[name]["iae"], [iae(gain) for gain in gains])


def test_draws_of_a_parameter():
    gains = [0.5, 1.0, 2.0]
    given = loop(held(Law()))
    found = cp.monte_carlo(given, {"gain": gains}, {"a": PLAN, "b": PLAN}, TIMES, progress=False, measures=["iae"])
    for name in ("a", "b"):
        np.testing.assert_allclose(found.metrics[name]["iae"], [iae(gain) for gain in gains], rtol=1e-6)


def test_the_benefit():
    law = Law()
    given = loop(held(law))
    options = {"alphas": [1.0], "durations": [1.0]}
    found = cp.benefit(cp.compare(given, MOVE, TIMES), given, **options)
    again = cp.benefit(cp.compare(given, MOVE, TIMES), lambda name, plan: loop(held(Law())), **options)
    assert str(found) == str(again)
    assert law.total == 0.0
