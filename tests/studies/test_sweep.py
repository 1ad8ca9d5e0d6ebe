"""Comparisons over a parameter: the same numbers however they are computed."""

import dataclasses
import inspect
import json
import tracemalloc
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import control as ct
import numpy as np
import pytest
from linear_table import printed

import ctrlplan as cp
from ctrlplan.studies import MEASURES
from ctrlplan.studies.measures import Measure

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLANS = {"step": cp.Step(1.0), "planned": cp.TrigSpline(MOVE, alpha=1.0)}
TIMES = np.linspace(0.0, 20.0, 1001)
GAINS = [1.0, 5.0, 20.0]
BUILD = cp.plants.integrator_lag_loop


@pytest.fixture(scope="module")
def swept():
    return cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False)


def same(one, other):
    assert one.parameter == other.parameter
    np.testing.assert_array_equal(one.values, other.values)
    assert list(one.metrics) == list(other.metrics)
    for plan, rows in one.metrics.items():
        assert list(rows) == list(other.metrics[plan])
        for name, row in rows.items():
            np.testing.assert_allclose(row, other.metrics[plan][name], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_each_value_is_a_comparison_of_its_own(swept):
    assert swept.values.tolist() == GAINS
    for i, gain in enumerate(GAINS):
        alone = cp.compare(BUILD(gain), PLANS, TIMES).metrics
        for plan, row in alone.items():
            assert list(swept.metrics[plan]) == list(row)
            np.testing.assert_allclose([swept.metrics[plan][name][i] for name in row], list(row.values()), rtol=1e-11)


def test_overshoot_of_the_step_follows_its_closed_form(swept):
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array(GAINS) - 0.25))
    np.testing.assert_allclose(swept.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_a_single_value_is_a_sweep_too(swept):
    alone = cp.sweep(BUILD, 5.0, PLANS, TIMES, progress=False)
    assert alone.values.shape == (1,)
    assert alone.metrics["planned"]["iae"][0] == pytest.approx(swept.metrics["planned"]["iae"][1], rel=1e-12)


def test_waypoints_stand_for_the_standard_plans_even_from_a_generator():
    found = cp.sweep(BUILD, GAINS, (w for w in MOVE), TIMES, progress=False, measures=["overshoot_error"])
    assert list(found.metrics) == ["step", "polynomial", "trigonometric", "piecewise"]
    expected = [printed(gain, "quintic")[0] for gain in (1, 5, 20)]
    np.testing.assert_allclose(found.metrics["polynomial"]["overshoot_error"], expected, rtol=1e-4)
    np.testing.assert_array_equal(
        found.metrics["piecewise"]["overshoot_error"].round(8), found.metrics["polynomial"]["overshoot_error"].round(8)
    )


def test_options_reach_each_comparison():
    found = cp.sweep(
        BUILD, GAINS, PLANS, TIMES, progress=False, measures=["settling_time"], band=0.05, parameter="gain"
    )
    assert found.parameter == "gain"
    assert list(found.metrics["step"]) == ["settling_time"]
    alone = cp.compare(BUILD(20.0), PLANS, TIMES, band=0.05)
    assert found.metrics["step"]["settling_time"][2] == pytest.approx(alone.metrics["step"]["settling_time"], rel=1e-12)


@pytest.mark.parametrize("values", [[1.0, 1.0], [2.0, 1.0], [1.0, np.nan], [1.0, np.inf], [], [[1.0, 2.0]]])
def test_values_must_increase(values):
    with pytest.raises(ValueError, match="values must be finite and increase strictly, got"):
        cp.sweep(BUILD, values, PLANS, TIMES, progress=False)


def test_an_unstable_value_is_infinite_and_stops_nothing():
    found = cp.sweep(BUILD, [-1.0, 5.0], PLANS, TIMES, progress=False)
    for rows in found.metrics.values():
        assert rows["settling_time"][0] == np.inf
        assert np.isfinite(rows["settling_time"][1])


# Many loops at once, and those that cannot be


def two_axes(stiffness):
    """Two oscillators that lean on each other, with positions x and z, and what drives the first."""
    w = np.sqrt(stiffness)
    a = np.zeros((4, 4))
    a[:2, 2:] = np.eye(2)
    a[2:, :2] = [[-stiffness, 0.1], [0.2, -stiffness]]
    a[2:, 2:] = -np.diag([w, 0.3 * w])
    b = np.vstack([np.zeros((2, 2)), -a[2:, :2]])  # at rest where the plans are
    c = np.vstack([np.eye(2, 4), -a[2:3]])
    return ct.ss(
        a, b, c, np.vstack([np.zeros((2, 2)), b[2:3]]), inputs=["x_ref", "z_ref"], outputs=["x", "z", "u"], name="axes"
    )


def plans_of_two_axes():
    points = [
        cp.Waypoint.from_jets(0.3, x=[1.0, 0.0, 0.0], z=[-2.0, 0.0, 0.0]),
        cp.Waypoint.from_jets(2.0, x=[2.0, 0.0, 0.0], z=[0.5, 0.0, 0.0]),
    ]
    return {"quintic": cp.PolySpline(points), "step": cp.Step([2.0, 0.5], [1.0, -2.0], 0.3, ["x", "z"])}


OPTIONS = {
    "all": {},
    "none but two": {"measures": ["overshoot_final", "control_peak"]},
    "a wider band": {"band": 0.1, "measures": ["settling_time", "tracking_settling_time"]},
    "outputs by name": {"outputs": ["z", "x"], "controls": ["u", "x"]},
    "no controls": {"controls": []},
    "a state for all": {"initial_state": np.array([0.1, -0.2, 0.3, 0.0])},
    "a number for all states": {"initial_state": 0.1},
    "waypoints": {"waypoints": [cp.Waypoint(0.3, [1.0, -2.0]), cp.Waypoint(2.0, [2.0, 0.5])]},
    "a measure of one's own": {
        "measures": {"last": Measure("Last", of="run", function=lambda run: run.response.outputs[0, -1])}
    },
    "units": {"units": {"x": "m"}},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_many_loops_of_two_axes_at_once(options):
    values, times = np.geomspace(2.0, 60.0, 3), np.linspace(0.0, 12.0, 301)
    found = cp.sweep(two_axes, values, plans_of_two_axes(), times, progress=False, **options)
    for i, value in enumerate(values):
        for plan, row in cp.compare(two_axes(value), plans_of_two_axes(), times, **options).metrics.items():
            assert list(found.metrics[plan]) == list(row)
            rows = [found.metrics[plan][name][i] for name in row]
            np.testing.assert_allclose(rows, list(row.values()), rtol=1e-9, atol=1e-12)


class Here:
    """Runs a task when it is submitted."""

    def submit(self, function, /, *arguments):
        task = Future()
        task.set_result(function(*arguments))
        return task


# Right and wrong values of every parameter of compare that a sweep has; those that are used up are made for each call.
CHOICES = {
    "outputs": [["z", "x"], ("x", "u"), "xz", ["x", "no"], [], 3, lambda: iter(["z", "x"])],
    "controls": [["u", "x"], ("u", "u"), "u", ["no"], [], 3, lambda: iter(["u"])],
    "waypoints": [OPTIONS["waypoints"]["waypoints"], lambda: iter(OPTIONS["waypoints"]["waypoints"]), [], [1.0], 3],
    "initial_state": [0.1, [0.1, -0.2, 0.3, 0.0], np.nan, [np.inf] * 4, "a", [1.0], [[0.0] * 4], 1j, None],
    "band": [0.1, 1, np.nan, 0.0, -0.1, np.inf, "a", None, [0.02, 0.05]],
    "start": [0.7, 0.0, -3.0, 11.95, 12.0, 50.0, np.nan, np.inf, -np.inf, "a", "0.7", [0.7], 1j, None],
    "measures": [
        ["iae", "control_effort"],
        {"itae"},
        "settling_time",
        ["no"],
        [],
        3,
        lambda: iter(["ise", "itae"]),
        ["wandering"],
        [Measure("Last", of="run", function=lambda run: run.response.outputs[0, -1]), "iae"],
        {"late": Measure("Late", "{y}", "response", lambda seen: np.abs(seen.error[:, -1]))},
        [Measure("Wrong", of="run", function=lambda run: [1.0])],
        {"last": Measure("Last value")},
    ],
    "events": [(), [], [cp.Event("x", high=1.5, stop=True)], [cp.Event("x", high=1.5)], [cp.Event("no", high=1.0)], 3],
    "units": [{"x": "m"}, {"no": "m"}, 3],
    "params": [{}, {"mass": 1.0}, 3, None],
}


def outcome(function):
    """What a function returns, or the kind and words of what it raises."""
    try:
        return function()
    except Exception as error:
        return type(error), str(error)


def test_every_parameter_of_compare_is_among_the_choices():
    known = {
        name for name in inspect.signature(cp.compare).parameters if name in inspect.signature(cp.sweep).parameters
    }
    assert set(CHOICES) == known - {"plans", "timepts"}
    assert {entry.name for entry in dataclasses.fields(cp.Experiment)} <= known


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param(name, value, marks=[] if value is values[0] else pytest.mark.slow)
        for name, values in CHOICES.items()
        for value in values
    ],
)
def test_an_option_means_and_is_checked_the_same_however_loops_are_run(name, value):
    """As in a comparison of each loop by itself."""
    values, times = np.array([2.0, 60.0]), np.linspace(0.0, 12.0, 31)
    lasting = list(value()) if callable(value) else value

    def alone(stiffness):
        return outcome(lambda: cp.compare(two_axes(stiffness), plans_of_two_axes(), times, **{name: lasting}).metrics)

    def swept(executor):
        given = value if lasting is value else value()
        options = {"executor": executor, "progress": False, name: given}
        return outcome(lambda: cp.sweep(two_axes, values, plans_of_two_axes(), times, **options).metrics)

    expected = [alone(stiffness) for stiffness in values]
    for found in (swept(None), swept(Here())):
        if isinstance(expected[0], tuple):
            assert found == expected[0]
            continue
        for i, rows in enumerate(expected):
            assert {plan: list(row) for plan, row in found.items()} == {plan: list(row) for plan, row in rows.items()}
            for plan, row in rows.items():
                of_value = [found[plan][key][i] for key in row]
                np.testing.assert_allclose(of_value, list(row.values()), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("executor", [None, Here()], ids=["together", "one by one"])
@pytest.mark.parametrize(("worth", "kind"), [(3, TypeError), (None, TypeError), (True, ValueError), ({}, ValueError)])
def test_a_sweep_has_no_place_for_the_benefit(worth, kind, executor):
    said = "worth must be False in a sweep over values, which has no place for it, got"
    with pytest.warns(FutureWarning, match="worth= of sweep"), pytest.raises(kind, match=said):
        cp.sweep(BUILD, GAINS, MOVE, TIMES, executor=executor, progress=False, worth=worth)


@pytest.mark.parametrize("start", [0.0, 0.5, 1.75])
def test_metrics_count_from_the_start_that_is_given(start):
    """The error of a lag behind a step is exp(-rate t); its integrals from the start to 20 s."""

    def build(rate):
        return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")

    rates, end = np.array([0.25, 0.5, 0.75, 1.0, 1.5, 2.0]), 20.0
    found = cp.sweep(build, rates, {"step": cp.Step(1.0)}, np.linspace(0.0, end, 2001), progress=False, start=start)
    ends = [np.exp(-rates * t) for t in (start, end)]
    np.testing.assert_allclose(found.metrics["step"]["iae"], (ends[0] - ends[1]) / rates, rtol=1e-5)
    itae = (ends[0] - ends[1] * (1.0 + rates * (end - start))) / rates**2
    np.testing.assert_allclose(found.metrics["step"]["itae"], itae, rtol=1e-5)


@pytest.mark.parametrize(
    "build",
    [
        lambda k: ct.ss([], [], [], [[k, 0.5], [0.25, k]], inputs=["x_ref", "z_ref"], outputs=["x", "z"]),
        lambda k: ct.ss(
            np.diag([-k, 90.0, -1.0]), [[k, 0], [1, 1], [0, 1]], [[1, 0, 0], [0, 0, 1]], 0, inputs=2, outputs=["x", "z"]
        ),
    ],
    ids=["gains without states", "a state that grows and no output shows"],
)
def test_odd_loops_are_measured_as_by_themselves(build):
    values, times = np.array([0.5, 1.0, 2.0, 4.0]), np.linspace(0.0, 12.0, 121)
    plans, options = {"step": cp.Step([1.0, 1.0], labels=["x", "z"])}, {"outputs": list(build(1.0).output_labels)}
    found = cp.sweep(build, values, plans, times, progress=False, **options)
    for i, value in enumerate(values):
        row = cp.compare(build(value), plans, times, **options).metrics["step"]
        of_value = [found.metrics["step"][name][i] for name in row]
        np.testing.assert_allclose(of_value, list(row.values()), rtol=1e-9, atol=1e-12)


def test_a_builder_may_change_one_loop_from_value_to_value():
    """Measured is the loop as it was at each value, not as the builder left it."""
    lag = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y", name="lag")

    def build(rate):
        lag.A[0, 0], lag.B[0, 0] = -rate, rate
        return ct.interconnect([lag], inputs=["r"], outputs=["y"], name="loop")

    rates = np.array([0.25, 0.5, 0.75, 1.0, 1.5, 2.0])
    found = cp.sweep(build, rates, {"step": cp.Step(1.0)}, TIMES, progress=False, measures=["settling_time"])
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], np.log(50.0) / rates, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 7, 13, 14, 15])
def test_a_loop_is_built_once_for_each_value(count):
    built = []
    gains = np.linspace(1.0, 20.0, count)
    found = cp.sweep(
        lambda gain: built.append(gain) or BUILD(gain),
        gains,
        PLANS,
        TIMES,
        progress=False,
        measures=["overshoot_error"],
    )
    assert built == found.values.tolist() == gains.tolist()
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(gains - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_a_builder_may_modify_its_loop_although_some_loops_are_run_separately():
    """First-order lag 1/(s + r): integral of (1 - y)^2 for a step. Loops that grow by exp(20) are run separately."""
    rates, end = np.array([-3.5, -3.0, -2.5, -0.5, 0.5, 1.0, 2.0, 3.0, 4.0]), 10.0
    loop = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y")

    def build(rate):
        loop.A[0, 0] = -rate
        return loop

    times = np.linspace(0.0, end, 2001)
    found = cp.sweep(build, rates, {"step": cp.Step(1.0)}, times, progress=False, measures=["ise"])
    offset, decay = 1.0 - 1.0 / rates, np.exp(-rates * end)
    expected = offset**2 * end + 2.0 * offset * (1.0 - decay) / rates**2 + (1.0 - decay**2) / (2.0 * rates**3)
    # Cubics over intervals h have an error of (r h)^4 / 384, twice that of their squares.
    np.testing.assert_allclose(found.metrics["step"]["ise"], expected, rtol=1e-7)


def test_a_loop_is_built_once_for_each_value_even_where_one_cannot_be():
    built = []

    def build(gain):
        built.append(gain)
        if gain == 5.0:
            raise ValueError("none at 5")
        return BUILD(gain)

    found = cp.sweep(build, np.arange(1.0, 10.0), PLANS, TIMES, progress=False, measures=["overshoot_error"])
    assert built == found.values.tolist() == list(range(1, 10))
    assert [(f.draw, f.params, f.message) for f in found.failures] == [(4, {"value": 5.0}, "ValueError: none at 5")]
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(found.values - 0.25))
    expected[4] = np.nan
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_an_axis_that_starts_elsewhere_starts_at_rest():
    """At rest until the step: with x(0) = x_ref, the axes' errors begin with the jump."""
    times = np.linspace(0.0, 30.0, 3001)
    plans = {"step": cp.Step([2.0, 0.5], [1.0, 0.5], 1.0, ["x", "z"])}
    values = [20.0, 40.0]

    def apart(stiffness):
        """Damping 0.2 and natural frequency sqrt(stiffness), two times over."""
        w = np.sqrt(stiffness)
        a = np.array([[0.0, 1.0], [-stiffness, -0.4 * w]])
        b, c = np.array([[0.0], [stiffness]]), np.array([[1.0, 0.0]])
        return ct.ss(
            np.kron(np.eye(2), a), np.kron(np.eye(2), b), np.kron(np.eye(2), c), np.zeros((2, 2)), inputs=2, outputs=2
        )

    found = cp.sweep(apart, values, plans, times, progress=False, measures=["overshoot_final", "iae"]).metrics["step"]
    expected = 100 * np.exp(-np.pi * 0.2 / np.sqrt(1 - 0.04))
    np.testing.assert_allclose(found["overshoot_final_x"], expected, rtol=1e-4)
    assert np.isnan(found["overshoot_final_z"]).all()
    np.testing.assert_allclose(found["iae_z"], 0.0, atol=1e-12)


def test_loops_of_several_kinds_are_compared_one_by_one():
    def build(gain):
        if gain < 2.0:
            return ct.tf([gain], [1.0, 1.0, gain], inputs="r", outputs="y", name="fraction")
        return cp.plants.unity_feedback_loop([1.0], [1.0, 1.0, 0.0] if gain < 10.0 else [0.0, 1.0, 1.0, 0.0], gain)

    found = cp.sweep(build, GAINS, PLANS, TIMES, progress=False)
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array(GAINS) - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_fractions_are_swept_together():
    def build(gain):
        return ct.tf([gain], [1.0, 1.0, gain], inputs="r", outputs="y")

    found = cp.sweep(build, GAINS, PLANS, TIMES, progress=False)
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array(GAINS) - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def test_loops_with_a_state_of_their_own_start_there():
    def build(rate):
        loop = ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")
        cp.declare(loop, initial_state=[3.0])
        return loop

    found = cp.sweep(build, [1.0, 2.0], {"step": cp.Step(1.0)}, TIMES, progress=False, measures=["iae"])
    # y - 1 = 2 exp(-rate t), and its integral over 20 s.
    np.testing.assert_allclose(found.metrics["step"]["iae"], [2.0, 1.0], rtol=1e-6)


def test_plans_as_blocks_are_swept_too():
    def build(gain):
        def loop(name, plan):
            return ct.interconnect(
                [cp.create_source_iosystem(plan), cp.plants.integrator_lag_loop(gain)], inputs=0, outputs=["y"]
            )

        return loop

    plans = {"step": cp.Step(1.0, labels=["r"]), "planned": cp.TrigSpline(MOVE, alpha=1.0, labels=["r"])}
    found = cp.sweep(build, GAINS, plans, TIMES, progress=False, measures=["overshoot_error"])
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array(GAINS) - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)


def own_signals(value):
    """Loops whose outputs or controls depend on the value, by kind."""
    other, gains = value > 1.5, [[1.0], [2.0]]
    matrices = [[-value]], [[value]]
    cubic = {"inputs": "r", "states": 1}
    return {
        "output": ct.tf([value], [1.0, 2.0, value], inputs="r", outputs="z" if other else "y"),
        "control": ct.ss(*matrices, gains, 0.0, inputs="r", outputs=["y", "v" if other else "u"]),
        "further control": ct.ss(
            *matrices, gains[: 2 if other else 1], 0.0, inputs="r", outputs=["y", "u"][: 1 + other]
        ),
        "nonlinear": ct.nlsys(lambda t, x, u, p: u - x**3, None, outputs="z" if other else "y", **cubic),
    }


@pytest.mark.parametrize("kind", own_signals(1.0))
@pytest.mark.parametrize("executor", [None, lambda: ThreadPoolExecutor(2)], ids=["here", "threads"])
def test_loops_with_different_signals_are_an_error(kind, executor):
    plans, times = {"step": cp.Step(1.0)}, np.linspace(0.0, 5.0, 101)
    options = {"progress": False, "executor": executor and executor()}
    said = r"build must return loops with the same outputs and controls for all values, got [yzuv, ]+ for [1-3] and"
    with pytest.raises(ValueError, match=said):
        cp.sweep(lambda value: own_signals(value)[kind], [1.0, 2.0, 3.0], plans, times, **options)
    cp.sweep(lambda value: own_signals(value)[kind], [2.0, 3.0], plans, times, **options)


@pytest.mark.parametrize("measures", [["iae"], ["control_peak"], None])
def test_an_order_of_outputs_that_depends_on_the_value(measures):
    """Signals are known by their labels, for loops solved together and for others."""

    def build(value, order=1):
        return ct.ss([[-value]], [[value]], [[1.0], [2.0]][::order], 0.0, inputs="r", outputs=["y", "u"][::order])

    plans, times = {"step": cp.Step(1.0)}, np.linspace(0.0, 5.0, 101)
    values = np.arange(1.0, 8.0)
    found = cp.sweep(lambda v: build(v, -1 if v > 3.5 else 1), values, plans, times, measures=measures, progress=False)
    expected = cp.sweep(build, values, plans, times, measures=measures, progress=False)
    for name, row in expected.metrics["step"].items():
        np.testing.assert_allclose(found.metrics["step"][name], row, rtol=1e-12)


def test_an_option_that_there_is_not():
    with pytest.raises(TypeError, match="bandwidth"):
        cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False, bandwidth=0.1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"outputs": ["z"]}, "outputs and controls must be among y, got 'z'"),
        ({"controls": ["z"]}, "outputs and controls must be among y, got 'z'"),
        ({"initial_state": np.ones(3)}, "initial_state must be a scalar or have 2 entries"),
    ],
)
def test_what_compare_refuses(options, said):
    with pytest.raises(ValueError, match=said):
        cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False, **options)


@pytest.mark.parametrize("times", [[0.0, 1.0, 0.5], [0.0], [0.0, np.nan], [[0.0, 1.0]]], ids=str)
def test_times_must_increase(times):
    with pytest.raises(ValueError, match="timepts must be"):
        cp.sweep(BUILD, GAINS, PLANS, times, progress=False)


def test_an_unstable_loop_among_others_spoils_none_of_them():
    found = cp.sweep(BUILD, [-400.0, -1.0, 1.0, 5.0], PLANS, np.linspace(0.0, 60.0, 3001), progress=False)
    for rows in found.metrics.values():
        assert np.isinf(rows["settling_time"][:2]).all()
        assert np.isinf(rows["tracking_settling_time"][:2]).all()
        assert np.isinf(rows["iae"][0])
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(np.array([1.0, 5.0]) - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"][2:], expected, rtol=1e-5)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_values():
    times = np.linspace(0.0, 20.0, 20_001)
    tracemalloc.start()
    cp.sweep(BUILD, np.geomspace(0.25, 1000.0, 400), PLANS, times, progress=False, measures=["settling_time"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 128e6  # which y of both plans would be alone, and its metrics take several times as much


# The bar


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor])
def test_progress_is_a_bar_on_stderr(executor, capsys):
    if executor is None:
        cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=True, parameter="gain k")
    else:
        with executor(1) as pool:
            cp.sweep(BUILD, GAINS, PLANS, TIMES, executor=pool, progress=True, parameter="gain k")
    said = capsys.readouterr()
    assert said.out == ""
    assert "gain k" in said.err
    assert "/3" in said.err


def test_progress_is_shown_unless_it_is_declined(capsys):
    cp.sweep(BUILD, GAINS[:1], PLANS, TIMES)
    assert "/1" in capsys.readouterr().err


def test_without_progress_nothing_is_said(capfd):
    cp.sweep(BUILD, GAINS, PLANS, TIMES, progress=False)
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


# Where it runs


def test_threads_find_the_same(swept):
    with ThreadPoolExecutor(2) as pool:
        same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, executor=pool, progress=False))


@pytest.mark.slow
def test_processes_find_the_same(swept):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, executor=pool, progress=False))


def test_any_object_with_submit_will_do(swept):
    class Later:
        """Runs nothing until it is asked, and then the last first."""

        def __init__(self):
            self.tasks = []

        def submit(self, function, /, *arguments, **named):
            task = Future()
            self.tasks.append((task, function, arguments, named))
            return Answer(self, task)

        def run(self):
            while self.tasks:
                task, function, arguments, named = self.tasks.pop()
                task.set_result(function(*arguments, **named))

    class Answer:
        """Has nothing but a result."""

        def __init__(self, owner, task):
            self.owner, self.task = owner, task

        def result(self):
            self.owner.run()
            return self.task.result()

    same(swept, cp.sweep(BUILD, GAINS, PLANS, TIMES, executor=Later(), progress=False))


def test_a_build_that_fails_is_heard_of():
    def build(gain):
        raise ZeroDivisionError(f"no loop at {gain}")

    with pytest.raises(ZeroDivisionError, match="no loop at 1"):
        cp.sweep(build, GAINS, PLANS, TIMES, progress=False)
    with ThreadPoolExecutor(2) as pool, pytest.raises(ZeroDivisionError, match="no loop at 1"):
        cp.sweep(build, GAINS, PLANS, TIMES, executor=pool, progress=False)


# What it can be turned into


def test_to_pandas_has_a_row_a_value_and_a_column_a_plan_and_metric(swept):
    table = swept.to_pandas()
    assert table.index.tolist() == GAINS
    assert table.index.name == swept.parameter
    assert table.columns.names == ["plan", "metric"]
    for plan, rows in swept.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(table[plan, name], row)


def test_results_are_plain_and_null_where_infinite():
    found = cp.sweep(BUILD, [-1.0, 5.0], PLANS, TIMES, progress=False, parameter="gain")
    data = json.loads(json.dumps(found.results(["settling_time", "overshoot_error"]), allow_nan=False))
    assert list(data) == ["gain", "step", "planned"]
    assert data["gain"] == [-1.0, 5.0]
    assert list(data["step"]) == ["settling_time", "overshoot_error"]
    assert data["step"]["settling_time"] == [None, found.metrics["step"]["settling_time"][1]]


@pytest.mark.slow
def test_merged_sweeps_stand_in_order(swept):
    odd = cp.sweep(BUILD, [0.5, 10.0, 50.0], PLANS, TIMES, progress=False)
    both = cp.sweep(BUILD, [0.5, 1.0, 5.0, 10.0, 20.0, 50.0], PLANS, TIMES, progress=False)
    same(both, swept.merged(odd))
    same(both, odd.merged(swept))


def test_every_measure_is_swept(swept):
    known = [name for name in MEASURES if not name.startswith("control")]
    assert set(swept.metrics["step"]) <= set(known)
    assert {"settling_time", "overshoot_error", "iae", "itae_final"} <= set(swept.metrics["step"])


@pytest.mark.parametrize("fast", [1e10, 1e11])
def test_lost_digits_are_said_the_same_of_a_loop_alone_and_among_others(fast):
    """A step excites an undamped loop, and after 1e10 turns the last digits of its frequency decide."""

    def loop(rate):
        a, b = [[0.0, rate], [-rate, 0.0]], [[0.0], [rate]]
        return ct.ss(a, b, [[1.0, 0.0]], [[0.0]], inputs="r", outputs="y", name="undamped")

    times, plans = np.linspace(0.0, 10.0, 101), {"step": cp.Step(1.0)}
    with pytest.warns(UserWarning, match="are uncertain by") as alone:
        cp.compare(loop(fast), plans, times)
    with pytest.warns(UserWarning, match="are uncertain by") as swept:
        cp.sweep(loop, [1.0, 2.0, 3.0, fast], plans, times, progress=False)
    assert [str(entry.message) for entry in swept] == [str(entry.message) for entry in alone]
