"""Every field of an experiment means the same however loops are run: checked against closed forms of a lag."""

import dataclasses
import math
from concurrent.futures import Future

import control as ct
import numpy as np
import pytest
from study_text import to_toml

import ctrlplan as cp
from ctrlplan.studies import Measure, Stability
from ctrlplan.studies.files import load_study

END = 8.0
MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
BASE = {
    "plans": {"step": cp.Step(1.0), "move": cp.PolySpline(MOVE)},
    "timepts": np.linspace(0.0, END, 1601),
    "waypoints": MOVE,
}


def linear():
    """x' = r - x with y = x, its double w, the control u = r - x, and v = 3 u."""
    c, d = [[1.0], [2.0], [-1.0], [-3.0]], [[0.0], [0.0], [1.0], [3.0]]
    return ct.ss([[-1.0]], [[1.0]], c, d, inputs=["r"], outputs=["y", "w", "u", "v"], name="lag")


def bent():
    """The same with parameters: x' = rate (r - x) + 0 other, of which nothing is known to be linear."""
    return ct.nlsys(
        lambda t, x, u, p: [p["rate"] * (u[0] - x[0]) + 0.0 * p["other"] * x[0] ** 2],
        lambda t, x, u, p: [x[0], 2.0 * x[0], u[0] - x[0], 3.0 * (u[0] - x[0])],
        inputs=["r"],
        outputs=["y", "w", "u", "v"],
        states=1,
        params={"rate": 1.0, "other": 0.0},
        name="lag",
    )


@dataclasses.dataclass
class Case:
    """A value of a field, and metrics of the step with it; of the standard value they are others."""

    value: object
    metrics: dict
    stated: object = None  # in a study file, where that is written in another way
    names: tuple = ()  # of all metrics, where these are fewer
    others: dict = dataclasses.field(default_factory=dict)  # metrics in some ways, where plans follow the waypoints


def area(start, end, rate=1.0, size=1.0):
    """Integral of the error of the lag behind a step."""
    return size * (math.exp(-rate * start) - math.exp(-rate * end)) / rate


HALF = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 0.5, 0, 0)]
TO_HALF = {"iae": area(0, END, size=0.5)}
CASES = {
    "plans": Case({"step": cp.Step(2.0)}, {"iae": area(0, END, size=2.0)}, others={"benefit": {}, "file": {}}),
    "timepts": Case(np.linspace(0.0, 1.5, 301), {"iae": area(0, 1.5)}),
    "waypoints": Case(HALF, {"iae": area(0, END)}, others={"benefit": TO_HALF, "file": TO_HALF}),
    "start": Case(0.5, {"iae": area(0.5, END), "settling_time": math.log(50.0) - 0.5}),
    "band": Case(0.1, {"settling_time": math.log(10.0)}),
    "outputs": Case(["w"], {"overshoot_final": 100.0 * (1.0 - 2.0 * math.exp(-END))}),
    "controls": Case(["v"], {"control_peak": 3.0}),
    "initial_state": Case([0.5], {"iae": area(0, END, size=0.5)}),
    "params": Case({"rate": 2.0}, {"iae": area(0, END, rate=2.0)}),
    "events": Case(
        [cp.Event("y", high=0.5, stop=True)],
        {"iae": 0.5, "control_variation": 0.5},
        [{"signal": "y", "high": 0.5, "stop": True}],
    ),
    "measures": Case(["iae", "settling_time"], {"iae": area(0, END)}, names=("settling_time", "iae")),
}
STANDARD = {
    "iae": area(0, END),
    "settling_time": math.log(50.0),
    "overshoot_final": 0.0,
    "control_peak": 1.0,
    "control_variation": 1.0 - math.exp(-END),
}


class Here:
    """Runs a task when it is submitted."""

    def submit(self, function, /, *arguments):
        task = Future()
        task.set_result(function(*arguments))
        return task


def loop_of(fields):
    return bent() if "params" in fields else linear()


def compare(fields, tmp_path):
    return cp.compare(loop_of(fields), **fields).metrics


def last_of(found):
    assert found.failures == ()
    return {plan: {name: row[-1] for name, row in rows.items()} for plan, rows in found.metrics.items()}


def sweep_together(fields, tmp_path):
    found = cp.sweep(lambda value: loop_of(fields), [1.0, 2.0, 3.0, 4.0], progress=False, **fields)
    return last_of(found)


def sweep_one_by_one(fields, tmp_path):
    return last_of(cp.sweep(lambda value: loop_of(fields), [1.0, 2.0], progress=False, executor=Here(), **fields))


def monte_carlo(fields, tmp_path):
    return last_of(cp.monte_carlo(bent(), {"other": [1.0, 2.0]}, progress=False, **fields))


def monte_carlo_of_a_function(fields, tmp_path):
    return last_of(cp.monte_carlo(lambda other: loop_of(fields), {"other": [1.0, 2.0]}, progress=False, **fields))


def benefit(fields, tmp_path):
    loop = loop_of(fields)
    return cp.benefit(cp.compare(loop, **fields), loop, alphas=[1.0], durations=[1.0]).comparison.metrics


def study_file(fields, tmp_path):
    """The fields as they are written in a file; times from 0 to the end."""
    times, stated = fields["timepts"], {name: fields[name] for name in fields if name not in BASE}
    for name, value in stated.items():
        if value is CASES[name].value and CASES[name].stated is not None:
            stated[name] = CASES[name].stated
    text = to_toml(
        {
            "t_end": float(times[-1]),
            "samples": times.size,
            "loop": {"kind": "python:lag_of_test:build"},
            "waypoints": [{"time": w.time, "r": w.jet[:, 0].tolist()} for w in fields["waypoints"]],
            "plans": [{"name": name, "family": "step" if name == "step" else "polynomial"} for name in fields["plans"]],
        }
    )
    table = "".join(f"{name} = {as_toml(value)}\n" for name, value in stated.items())
    (tmp_path / "study.toml").write_text(f"{text}\n[experiment]\n{table}")
    kind = bent if "params" in fields else linear
    (tmp_path / "lag_of_test.py").write_text(
        "import sys\nimport control\n\n\ndef build() -> control.InputOutputSystem:\n"
        f"    return sys.modules[{__name__!r}].{kind.__name__}()\n"
    )
    return load_study(tmp_path / "study.toml").run().comparison.metrics


def as_toml(value):
    """A value in one line of TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {as_toml(one)}" for name, one in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(as_toml, value))}]"
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


WAYS = {
    "compare": compare,
    "sweep, together": sweep_together,
    "sweep, one by one": sweep_one_by_one,
    "monte_carlo": monte_carlo,
    "monte_carlo of a function": monte_carlo_of_a_function,
    "benefit": benefit,
    "file": study_file,
}


def test_every_field_is_among_the_cases():
    assert list(CASES) == [entry.name for entry in dataclasses.fields(cp.Experiment)]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("field", CASES)
def test_a_field_means_the_same_in_every_way(field, way, tmp_path):
    case = CASES[field]
    metrics = WAYS[way](BASE | {field: case.value}, tmp_path)
    row = metrics["step"]
    expected = case.others.get(way, case.metrics)
    for name, value in expected.items():
        assert row[name] == pytest.approx(value, rel=1e-3, abs=1e-6), name
    if case.names:
        assert tuple(row) == case.names
    if field == "waypoints" and way not in case.others:
        # The plan to 1 leaves the box of waypoints that end at 0.5.
        assert metrics["move"]["outside_box"] == pytest.approx(0.5, rel=1e-9)
    elif field == "plans" and way != "benefit":
        assert list(metrics) == ["step"]


@pytest.mark.parametrize("way", WAYS)
def test_the_standard_values_give_other_metrics(way, tmp_path):
    """Each case above would be told from a field that is not read."""
    row = WAYS[way](BASE, tmp_path)["step"]
    for name, value in STANDARD.items():
        assert row[name] == pytest.approx(value, rel=1e-3, abs=1e-3), name
    for field, case in CASES.items():
        others = [name for name, value in case.metrics.items() if abs(value - STANDARD[name]) > 0.01]
        assert others or case.names or case.others, field


# The value itself


@pytest.mark.slow
def test_linear_loops_together_are_measured_as_by_themselves():
    experiment = cp.Experiment(MOVE, BASE["timepts"])
    loops = [cp.plants.integrator_lag_loop(gain, outputs=("y", "u")) for gain in (0.5, 4.0, 30.0)]
    together = experiment.run_alike(loops)
    for found, loop in zip(together, loops, strict=True):
        alone = experiment.run(loop).metrics
        assert list(found.metrics) == list(alone)
        for plan, row in alone.items():
            assert list(found.metrics[plan]) == list(row)
            np.testing.assert_allclose(list(found.metrics[plan].values()), list(row.values()), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(
    ("fields", "loops"),
    [
        ({}, [bent()]),
        ({}, [linear(), cp.plants.integrator_lag_loop(5.0)]),
        ({"events": [cp.Event("y", high=0.5)]}, [linear()]),
        ({"measures": [Measure("End", of="run", function=lambda run: run.t[-1])]}, [linear()]),
        ({"timepts": [0.0]}, [linear()]),
        ({}, []),
    ],
    ids=["not linear", "other sizes", "events", "a measure of runs", "one sample", "none"],
)
def test_loops_that_cannot_be_run_together_are_told(fields, loops):
    times = fields.pop("timepts", BASE["timepts"])
    if len(times) < 2:
        experiment = cp.Experiment({"step": cp.Step(1.0)}, times)
    else:
        experiment = cp.Experiment({"step": cp.Step(1.0)}, times, **fields)
    assert experiment.run_alike(loops) is None


def test_a_run_measure_is_given_the_whole_run():
    seen = []
    measure = Measure("Seen", "{u}", "run", lambda run: seen.append(run) or np.abs(run.signals["u"]).max())
    found = cp.compare(linear(), **BASE | {"measures": [measure]})
    assert found.metrics["step"] == {"Seen": 1.0}
    assert [run.last for run in seen] == [1.0, 1.0]
    assert [run.plan for run in seen] == list(BASE["plans"].values())
    assert found.measures["Seen"].unit == "{u}"
    assert "settling band" not in found.parameters  # which nothing here is measured by
    assert "settling band" in cp.compare(linear(), **BASE | {"measures": [measure, "iae"]}).parameters


def test_an_experiment_keeps_what_it_was_given_once():
    points, outputs = iter(MOVE), iter(["y"])
    experiment = cp.Experiment(points, BASE["timepts"], outputs=outputs, measures=iter(["iae"]))
    first, second = (experiment.run(linear()).metrics for _ in range(2))
    assert first == second
    assert list(first) == ["step", "polynomial", "trigonometric", "piecewise"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        experiment.band = 0.1
    assert dataclasses.replace(experiment, band=0.1).band == 0.1


@pytest.mark.parametrize(
    ("loop", "stability"),
    [
        (linear(), Stability.STABLE),
        (bent(), Stability.UNKNOWN),
        (ct.ss([[1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y"), Stability.UNSTABLE),
        (
            lambda name, plan: ct.ss(
                [[1.0 if name == "step" else -1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="r", outputs="y"
            ),
            Stability.MIXED,
        ),
    ],
    ids=["stable", "not linear", "unstable", "mixed"],
)
def test_stability_is_a_value(loop, stability):
    found = cp.compare(loop, BASE["plans"], BASE["timepts"])
    assert found.stability is stability
    assert any("unstable" in note for note in found.notes) == (stability in (Stability.UNSTABLE, Stability.MIXED))


def test_roles_do_not_depend_on_names():
    plans = {"planned": cp.Step(1.0), "step": cp.PolySpline(MOVE), "shaped": cp.Shaper.zv(5.0)(cp.Step(1.0))}
    roles = cp.compare(linear(), plans, BASE["timepts"]).roles
    assert {name: role.value for name, role in roles.items()} == {
        "planned": "step",
        "step": "planned",
        "shaped": "step",
    }


def test_draws_see_the_events_that_blocks_declare():
    """As the nominal loop does: an actuator at its limit is an event of every draw."""
    limited = cp.create_saturation_iosystem(-1.0, 1.0, inputs="v", outputs="u", name="drive")
    plant = ct.nlsys(
        lambda t, x, u, p: [p["rate"] * (u[0] - x[0])], None, inputs=["u"], outputs=["y"], states=1,
        params={"rate": 1.0}, name="plant",
    )  # fmt: skip
    law = ct.ss([], [], [], [[4.0, -4.0]], inputs=["r", "y"], outputs="v", name="law")
    whole = ct.interconnect([law, limited, plant], inputs=["r"], outputs=["y", "u"], name="whole")
    count = Measure("Events", of="run", function=lambda run: len(run.response.events), name="events")
    plans = {"step": cp.Step(1.0, labels=["r"])}
    options = {"outputs": ["y"], "measures": [count], "progress": False}
    found = cp.monte_carlo(whole, {"rate": [0.5, 1.0, 2.0]}, plans, BASE["timepts"], **options)
    assert found.nominal.metrics["step"]["events"] > 0
    assert (found.metrics["step"]["events"] > 0).all()


@pytest.mark.slow
def test_plans_tie_where_their_values_differ_by_rounding():
    """Of lags behind a step, from the closed form of iae: 1 - exp(-T) in every draw; 0.05 % is no rounding."""
    plans = {"one": cp.Step(1.0), "same": cp.Step(1.0 + 1e-9), "larger": cp.Step(1.0005)}
    found = cp.monte_carlo(bent(), {"other": [1.0, 2.0]}, plans, BASE["timepts"], progress=False)
    assert found.best("iae") == {"one": 1.0, "same": 1.0, "larger": 0.0}
    assert found.nominal.scales["iae"] == pytest.approx(1.0005 * END, rel=1e-9)


@pytest.mark.parametrize("executor", [None, Here()], ids=["here", "executor"])
def test_a_function_of_the_draws_builds_a_loop_for_each(executor):
    """The first draw stands for the nominal loop where the function has no values of its own."""
    gains = np.array([1.0, 5.0, 20.0])
    plans, times = {"step": cp.Step(1.0)}, np.linspace(0.0, 20.0, 2001)
    build = cp.plants.integrator_lag_loop
    found = cp.monte_carlo(build, {"gain": gains}, plans, times, executor=executor, progress=False)
    expected = 100 * np.exp(-0.5 * np.pi / np.sqrt(gains - 0.25))
    np.testing.assert_allclose(found.metrics["step"]["overshoot_error"], expected, rtol=1e-5)
    assert found.nominal_draw == 0
    assert "the loop has no nominal parameters" in found.nominal.notes[-1]
    given = cp.monte_carlo(lambda gain=2.0: build(gain), {"gain": gains}, plans, times, progress=False)
    assert given.nominal_draw is None
    own = 100 * math.exp(-0.5 * math.pi / math.sqrt(1.75))
    assert given.nominal.metrics["step"]["overshoot_error"] == pytest.approx(own, rel=1e-5)


def test_a_draw_whose_function_fails_is_its_failure():
    def build(gain):
        if gain > 2.0:
            raise ValueError("no such gain")
        return cp.plants.integrator_lag_loop(gain)

    found = cp.monte_carlo(build, {"gain": [1.0, 3.0]}, {"step": cp.Step(1.0)}, BASE["timepts"], progress=False)
    assert [(f.draw, f.message) for f in found.failures] == [(1, "ValueError: no such gain")]
    with pytest.raises(ValueError, match="no such gain"):
        cp.monte_carlo(build, {"gain": [3.0, 4.0]}, {"step": cp.Step(1.0)}, BASE["timepts"], progress=False)


def test_signals_that_differ_in_unit_have_no_worst_in_sweeps_and_draws():
    units = {"u": "N", "v": "m"}
    options = {"controls": ["u", "v"], "units": units, "progress": False, "measures": ["control_peak"]}
    plans = {"step": cp.Step(1.0)}
    swept = cp.sweep(lambda value: linear(), [1.0, 2.0], plans, BASE["timepts"], **options)
    drawn = cp.monte_carlo(bent(), {"other": [1.0, 2.0]}, plans, BASE["timepts"], **options)
    for found in (swept, drawn):
        row = found.metrics["step"]
        assert np.isnan(row["control_peak"]).all()
        np.testing.assert_allclose(row["control_peak_v"], 3.0, rtol=1e-6)
