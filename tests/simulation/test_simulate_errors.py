"""Bad input: what must hold, what was given, where."""

import datetime

import control as ct
import numpy as np
import pytest

import ctrlplan as cp

pytestmark = pytest.mark.every_combination

T = np.linspace(0.0, 2.0, 11)
PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)], labels=["r"])
LOOP = cp.plants.integrator_lag_loop(5.0)
TWO = ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), inputs=["r", "d"], name="two")
BENT = ct.nlsys(lambda t, x, u, p: -(x**3) + u, None, inputs=["r"], outputs=1, states=1, name="bent")


@pytest.mark.parametrize(
    "timepts",
    [
        [0.0, 1.0, 1.0],
        [0.0, 2.0, 1.0],
        [0.0, np.nan, 1.0],
        [0.0, np.inf],
        [-np.inf, 0.0],
        [0.0],
        [],
        1.0,
        [[0.0, 1.0], [2.0, 3.0]],
    ],
    ids=str,
)
@pytest.mark.parametrize("system", [LOOP, BENT], ids=["linear", "bent"])
def test_times(system, timepts):
    with pytest.raises(ValueError, match="timepts must be two or more finite times that increase strictly, got"):
        cp.simulate(system, timepts, PLAN)


@pytest.mark.parametrize("method", ["compile", "Exact", "", None])
def test_methods(method):
    with pytest.raises(ValueError, match=r"method must be one of auto, exact, .*python, got"):
        cp.simulate(LOOP, T, PLAN, method=method)


@pytest.mark.parametrize("method", ["auto", "exact", "python"])
@pytest.mark.parametrize(
    ("system", "inputs", "match"),
    [
        (LOOP, {"d": 0.1}, "inputs must be among r, got 'd'"),
        (TWO, {"r": PLAN, "y": 0.1}, "inputs must be among r, d, got 'y'"),
        (LOOP, cp.stack([PLAN, PLAN], ["a", "b"]), r"inputs must have 1 axes \(r\), got 2"),
        (TWO, PLAN, r"inputs must have 2 axes \(r, d\), got 1"),
        (TWO, {"d": cp.stack([PLAN, PLAN], ["a", "b"])}, "input d must be a trajectory of one axis, got 2"),
        (TWO, {"d": T[:-1]}, r"input d must be .*11 samples, got shape \(10,\)"),
        (TWO, {"d": np.ones((2, 11))}, r"input d must be .*got shape \(2, 11\)"),
        (TWO, np.ones((3, 11)), r"inputs must have shape \(2, 11\), got \(3, 11\)"),
        (TWO, np.ones((2, 12)), r"inputs must have shape \(2, 11\), got \(2, 12\)"),
        (TWO, T, r"inputs must have shape \(2, 11\), got \(11,\)"),
        (TWO, {"d": np.where(T > 0.5, np.nan, 0.0)}, "input d must be finite, got nan or inf at index 3"),
        (LOOP, np.where(T > 0.5, np.inf, 0.0), "input r must be finite, got nan or inf at index 3"),
        (TWO, {"d": np.nan}, "input d must be finite"),
        (LOOP, np.inf, "input r must be finite"),
    ],
    ids=lambda value: None,
)
def test_inputs(system, inputs, match, method):
    with pytest.raises(ValueError, match=match):
        cp.simulate(system, T, inputs, method=method)


def test_a_system_without_inputs_takes_none():
    planned_loop = ct.interconnect([cp.create_source_iosystem(PLAN), LOOP], inputs=0, outputs=["y"])
    with pytest.raises(ValueError, match="inputs must be among none, got 'r'"):
        cp.simulate(planned_loop, T, {"r": PLAN})
    with pytest.raises(ValueError, match="inputs must have 0 axes"):
        cp.simulate(planned_loop, T, PLAN)


@pytest.mark.parametrize("method", ["exact", "python"])
@pytest.mark.parametrize("initial", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], []], ids=str)
def test_initial_states(initial, method):
    with pytest.raises(ValueError, match=r"initial_state must be a scalar or have 2 entries, got shape"):
        cp.simulate(LOOP, T, PLAN, initial, method=method)


@pytest.mark.parametrize("method", ["exact", "python"])
@pytest.mark.parametrize("initial", [[np.nan, 0.0], [0.0, np.inf], np.nan], ids=str)
def test_initial_states_that_are_not_numbers(initial, method):
    # Let through, they would come back as a loop that has left the range of numbers.
    with pytest.raises(ValueError, match="initial_state must be finite"):
        cp.simulate(LOOP, T, PLAN, initial, method=method)


@pytest.mark.parametrize(
    ("system", "inputs", "match"),
    [
        (BENT, PLAN, "bent"),
        (ct.interconnect([BENT, LOOP], connections=[["bent.r", "loop.y"]], inplist=["loop.r"], outlist=["bent.y[0]"]),
         PLAN, "bent"),
    ],
    ids=["nonlinear", "nonlinear inside"],
)  # fmt: skip
def test_the_exact_method_says_why_it_cannot(system, inputs, match):
    with pytest.raises(ValueError, match=f'method "exact" .*{match}'):
        cp.simulate(system, T, inputs, method="exact")


@pytest.mark.parametrize("missing", ["states", "inputs"])
def test_a_system_without_stated_sizes_is_named_with_what_to_give(missing):
    sizes = {"states": 1, "inputs": 1, "outputs": 1}
    del sizes[missing]
    system = ct.nlsys(lambda t, x, u, p: -x + u, lambda t, x, u, p: x, name="lag", **sizes)
    with pytest.raises(
        ValueError, match=rf"system must declare its number of {missing}, got lag .* construct it with {missing}="
    ):
        cp.simulate(system, [0.0, 1.0], 1.0, 0.0)


# What is no plain number


class Quantity:
    """As a value of pint or astropy: it turns into an array without its unit."""

    units = "millisecond"

    def __init__(self, values):
        self.values = np.asarray(values, dtype=float)

    def __array__(self, dtype=None, copy=None):
        return self.values

    def __len__(self):
        return len(self.values)


KINDS = {
    "time differences": lambda values: (1000 * np.asarray(values)).astype("m8[ms]"),
    "dates": lambda values: np.datetime64("2026-01-01") + (1000 * np.asarray(values)).astype("m8[ms]"),
    "standard time differences": lambda values: [datetime.timedelta(seconds=float(v)) for v in values],
    "standard dates": lambda values: [datetime.datetime(2026, 1, 1 + k) for k in range(len(values))],
    "units": Quantity,
    "complex": lambda values: np.asarray(values) + 0j,
    "complex in a list": lambda values: [*list(values)[:-1], 1j],
    "strings": lambda values: [str(v) for v in values],
    "masked": lambda values: np.ma.masked_greater(np.asarray(values), np.asarray(values)[-2]),
    "functions": lambda values: np.sin,
}  # fmt: skip
DISCRETE = ct.ss(0.5 * np.eye(2), np.ones((2, 1)), np.ones((1, 2)), 0, 0.2, name="discrete")
WIDE = ct.nlsys(lambda t, x, u, p: u - x**3, None, inputs=["r"], outputs=2, states=2, name="wide")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("system", [LOOP, WIDE, DISCRETE], ids=["linear", "nonlinear", "discrete"])
def test_times_inputs_and_states_that_are_no_plain_numbers(system, kind):
    made, error = KINDS[kind], ValueError if kind == "masked" else TypeError
    with pytest.raises(error, match="timepts must"):
        cp.simulate(system, made(T))
    for inputs in (made(T), {system.input_labels[0]: made(T)}):
        with pytest.raises(error, match=r"input.* must"):
            cp.simulate(system, T, inputs)
    if kind != "functions":
        with pytest.raises(error, match=r"input.* must"):
            cp.simulate(system, T, [made(T)])
    with pytest.raises(error, match="initial_state must"):
        cp.simulate(system, T, 0.0, made([1.0, 2.0]) if kind != "functions" else np.sin)


@pytest.mark.parametrize("value", [np.timedelta64(1, "s"), datetime.timedelta(seconds=1), 1j, "1", np.ma.masked])
def test_single_values_that_are_no_plain_numbers(value):
    error = ValueError if value is np.ma.masked else TypeError
    for inputs in (value, {"r": value}, [value]):
        with pytest.raises(error, match=r"input.* must"):
            cp.simulate(LOOP, T, inputs)
    with pytest.raises(error, match="initial_state must"):
        cp.simulate(LOOP, T, 0.0, value)


def test_whole_numbers_booleans_and_masks_of_nothing_are_numbers():
    expected = cp.simulate(LOOP, T, np.ones(11), [1.0, 0.0]).outputs
    for ones in (
        [1] * 11,
        [True] * 11,
        np.ones(11, dtype=np.float32),
        np.ma.array(np.ones(11)),
        np.ones(11, dtype=object),
    ):
        assert np.array_equal(cp.simulate(LOOP, T.tolist(), ones, (1, False)).outputs, expected)


def test_a_matrix_that_was_set_to_complex_numbers():
    system = ct.ss(-1.0, 1.0, 1.0, 0.0, name="turned")
    system.A = np.array([[-1.0 + 2.0j]])
    with pytest.raises(TypeError, match="A of turned must be real numbers, got complex numbers"):
        cp.simulate(system, T, 1.0)


@pytest.mark.parametrize(
    "run",
    [
        lambda params: cp.simulate(LOOP, T, PLAN, params=params),
        lambda params: cp.simulate(BENT, T, PLAN, params=params),
        lambda params: cp.prepare(BENT).start(0.1, params=params),
        lambda params: cp.Experiment({"r": PLAN}, T, params=params),
        lambda params: cp.Experiment({"r": PLAN}, T).run_plan(BENT, "r", params),
        lambda params: cp.compare(LOOP, {"r": PLAN}, T, params=params),
        lambda params: cp.sweep(lambda gain: LOOP, [1.0], {"r": PLAN}, T, params=params, progress=False),
        lambda params: cp.monte_carlo(BENT, {"k": [1.0]}, {"r": PLAN}, T, params=params, progress=False),
        lambda params: cp.flat_system(BENT, ["y[0]"], params=params),
        lambda params: cp.flat_candidates(BENT, params=params),
    ],
)
@pytest.mark.parametrize("wrong", [[1], "k", 3, [], [("k", 1.0)], {1: 2.0}])
def test_params_that_are_no_mapping_of_names(run, wrong):
    what = (
        "params must have names as keys, such as 'mass', got 1"
        if isinstance(wrong, dict)
        else f"params must be a mapping of names to values, such as .'mass': 2.0., got {type(wrong).__name__}"
    )
    with pytest.raises(TypeError, match=what):
        run(wrong)
