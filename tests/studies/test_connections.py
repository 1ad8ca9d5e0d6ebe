"""A reference that reaches nothing is an error: which signals reach which is said by hand for every loop."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import Measure

T = np.linspace(0.0, 4.0, 401)
UNUSED = pytest.mark.filterwarnings("ignore:Unused:UserWarning")  # python-control's own word on loops made wrong here


def move(label, rest=3):
    still = [0.0] * (rest - 1)
    return cp.PolySpline([cp.Waypoint(0, 1.0, *still), cp.Waypoint(1, 3.0, *still)], labels=[label])


def flat_loop(plan, labels, derivatives=2):
    """Plan, flat law and a chain of two integrators, joined by the names of the labels."""
    chain = cp.plants.integrator_chain(2)
    law = cp.create_flat_iosystem(chain, poles=[-3, -4], labels=labels)
    source = cp.create_source_iosystem(plan, derivatives, suffix="_ref")
    return ct.interconnect([source, law, chain], inputs=0, outputs=["y"], name="whole")


def axes(names):
    """First-order loops side by side; only those whose names are given are fed by the input of their name."""
    blocks = [ct.ss(-2.0, 2.0, 1.0, 0.0, inputs=f"r_{n}", outputs=f"y_{n}", name=n) for n in ("a", "b")]
    return ct.interconnect(blocks, inputs=[f"r_{n}" for n in names], outputs=["y_a", "y_b"], name="pair")


@UNUSED
@pytest.mark.parametrize(("label", "laws"), [("gap", "y"), ("height", "z"), ("y", "gap")])
def test_a_plan_whose_labels_are_not_those_of_the_law(label, laws):
    with pytest.raises(
        ValueError, match=rf"references must be connected .* whole, got {label} of block plan that"
    ) as e:
        cp.compare(lambda name, plan: flat_loop(plan, [laws]), {"move": move(label)}, T, outputs=["y"])
    assert f"flat_law.{laws}_ref" in str(e.value)  # what is open is named


def test_the_same_loop_with_one_name_runs_and_follows():
    found = cp.compare(lambda name, plan: flat_loop(plan, ["gap"]), {"move": move("gap")}, T, outputs=["y"])
    y = np.asarray(found.responses["move"].outputs).ravel()
    assert np.abs(y - found.plans["move"](T)).max() <= 1e-6


@UNUSED
@pytest.mark.parametrize("derivatives", [0, 1])
def test_a_derivative_that_the_law_reads_and_nothing_puts_out(derivatives):
    with pytest.raises(ValueError, match=rf"y_ref_d{derivatives + 1} unconnected; give the source more"):
        cp.compare(lambda name, plan: flat_loop(plan, ["y"], derivatives), {"move": move("y")}, T)


@UNUSED
def test_an_input_that_reaches_no_output():
    idle = ct.ss([[-1.0, 0.0], [0.0, -2.0]], [[1.0], [0.0]], [[0.0, 1.0]], 0.0, inputs="r", outputs="y", name="idle")
    with pytest.raises(ValueError, match="input r that affects none of y"):
        cp.compare(idle, {"move": move("r")}, T)
    with pytest.raises(ValueError, match="input r that affects none of y"):
        cp.sweep(lambda value: idle, [1.0, 2.0], {"move": move("r")}, T, progress=False)


def test_what_an_input_moves_only_through_states_is_reached():
    chain = ct.ss(np.diag([1.0, 1.0], 1) - np.eye(3), [[0], [0], [1.0]], [[1.0, 0, 0]], 0.0, inputs="r", outputs="y")
    assert "iae" in cp.compare(chain, {"move": move("r")}, T).metrics["move"]


@UNUSED
def test_one_of_two_axes_that_reaches_nothing():
    plan = cp.stack([move("r_a"), 2.0 * move("r_b")], labels=["r_a", "r_b"])

    def build(labels):
        def built(name, plan):
            source = cp.create_source_iosystem(cp.stack([plan], labels=labels))
            return ct.interconnect([source, *axes(["a", "b"]).syslist], inputs=0, outputs=["y_a", "y_b"])

        return built

    assert "iae" in cp.compare(build(["r_a", "r_b"]), {"both": plan}, T).metrics["both"]
    with pytest.raises(ValueError, match="got r_b of block plan that affects none of y_a, y_b"):
        cp.compare(build(["r_a", "other"]), {"both": plan}, T)


@UNUSED
def test_a_reference_that_only_a_record_reads():
    """x_ref stands among the outputs, and the law reads another name."""
    lag = ct.ss(-2.0, 2.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")

    def build(name, plan):
        source = cp.create_source_iosystem(plan, suffix="_ref")
        return ct.interconnect([source, lag], inputs=0, outputs=["y", "x_ref"])

    with pytest.raises(ValueError, match="got x of block plan that affects none of y"):
        cp.compare(build, {"move": move("x")}, T, outputs=["y"])


def test_a_second_source_for_the_record_is_no_reference_that_is_lost():
    lag = ct.ss(-2.0, 2.0, 1.0, 0.0, inputs="r", outputs="y", name="lag")

    def build(name, plan):
        sources = [cp.create_source_iosystem(plan), cp.create_source_iosystem(plan, name="shown", suffix="_shown")]
        return ct.interconnect([*sources, lag], inputs=0, outputs=["y", "r_shown"])

    assert "iae" in cp.compare(build, {"move": move("r")}, T, outputs=["y"]).metrics["move"]


@UNUSED
def test_a_disturbance_that_is_connected_to_nothing():
    lag = ct.ss(-2.0, [[2.0, 1.0]], 1.0, 0.0, inputs=["r", "d"], outputs="y", name="lag")

    def build(label):
        def built(name, plan):
            push = cp.stack([cp.Step(0.5, time=2.0)], labels=[label])
            sources = [cp.create_source_iosystem(plan), cp.create_source_iosystem(push, name="push")]
            return ct.interconnect([*sources, lag], inputs=0, outputs=["y"])

        return built

    assert "iae" in cp.compare(build("d"), {"move": move("r")}, T).metrics["move"]
    with pytest.raises(ValueError, match=r"got gust of block push that affect no output; .* lag\.d"):
        cp.compare(build("gust"), {"move": move("r")}, T)


# Names that are none


LOOP = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
PLANS = {"move": move("r")}


def OF_RUNS(function):
    return Measure("mine", of="run", function=function)


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"measures": ["settling"]}, ValueError, "measures must be among settling_time, .*, got 'settling'"),
        ({"measures": ["settling_time", "Iae"]}, ValueError, "must be among settling_time, .* iae, .*, got 'Iae'"),
        ({"measures": "settling_time"}, TypeError, "of settling_time, .*, got the string 'settling_time'"),
        ({"measures": ""}, TypeError, "got the string ''"),
        ({"measures": ["late", OF_RUNS(lambda run: {"early": 1.0})]}, ValueError, "or be Measures, got 'late'"),
        ({"outputs": "y"}, TypeError, "outputs must be a collection of names, of y, u, got the string 'y'"),
        ({"controls": "u"}, TypeError, "controls must be a collection of names, of y, u, got the string 'u'"),
        ({"controls": ["u", "v"]}, ValueError, "among y, u, got 'v'"),
        ({"units": {"velocity": "m/s"}}, ValueError, "units must be among r, y, u, .*, got 'velocity'"),
        ({"units": {"y": 3}}, TypeError, r"units\['y'\] must be a string, got 3"),
        ({"units": "m"}, TypeError, "units must be a mapping of labels to units, got str"),
        ({"measures": {"late": "Late"}}, TypeError, r"measures\['late'\] must be a Measure, got str"),
        ({"measures": [3]}, TypeError, "measures must be a collection of names and Measures, of .*, got 3"),
        ({"measures": 3}, TypeError, "measures must be a collection of names and Measures, of .*, got 3"),
        ({"measures": [Measure("Late", name="iae")]}, ValueError, "unique names, got 'iae'"),
        ({"measures": 2 * [OF_RUNS(float)]}, ValueError, "unique names, got 'mine', which is repeated"),
        ({"measures": {"iae": Measure("Mine")}}, ValueError, "unique names, got 'iae'"),
        ({"measures": {"late": Measure("Late")}}, ValueError, "must have a function, or come from a measure of runs"),
        (
            {"measures": [OF_RUNS(lambda run: [3.0])]},
            TypeError,
            "must return a number or a mapping of names to numbers",
        ),
        ({"measures": [OF_RUNS(lambda run: {"iae": 3.0})]}, ValueError, "unique names, got 'iae'"),
    ],
)
def test_names_that_are_none_are_errors_with_those_that_are(options, kind, message):
    with pytest.raises(kind, match=message):
        cp.compare(LOOP, PLANS, T, **options)


def test_units_of_derivatives_and_of_signals_inside_are_known():
    units = {"r": "m", "r_d2": "m/s^2", "u": "N", "e": "m"}
    assert cp.compare(LOOP, PLANS, T, units=units).units == units


def test_what_the_path_is_asked_for_is_given():
    """Metrics of the path, too, are those that are wanted."""
    points = [cp.Waypoint(0, 1.0, 0, 0), cp.Waypoint(1, 3.0, 0, 0)]
    row = cp.compare(LOOP, points, T, measures=("reference_jerk", "iae")).metrics["polynomial"]
    assert set(row) == {"reference_jerk", "iae"}
    assert row["reference_jerk"] == pytest.approx(720.0 * 2.0**2, rel=1e-9)  # 720 D^2/T^5 of the quintic


def test_a_gain_of_zero_is_connected():
    """One value of a parameter is no wire that is missing: the output stays where it is, and never settles."""
    swept = cp.sweep(cp.plants.integrator_lag_loop, [0.0, 1.0, 5.0], {"step": cp.Step(1.0)}, T, progress=False)
    assert swept.failures == ()
    assert swept.metrics["step"]["iae"][0] == pytest.approx(4.0, rel=1e-9)


# Labels of flat laws


def labelled(flat, poles, plan):
    """Plan, law with its default labels, and plant, connected by their names."""
    law = cp.create_flat_iosystem(flat, poles)
    source = cp.create_source_iosystem(plan, max(flat.orders), suffix="_ref")
    return ct.interconnect([source, law, flat], inputs=0, outputs=list(flat.flat_labels), name="whole")


FLAT = {
    "motor": (
        cp.plants.DCMotor().flat_system(),
        [-20, -25, -30],
        [cp.Waypoint(0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0)],
    ),
    "joint": (
        cp.plants.FlexibleJoint().flat_system(),
        [-9, -10, -11, -12],
        [cp.Waypoint(0, 0, 0, 0, 0, 0), cp.Waypoint(1, 2, 0, 0, 0, 0)],
    ),
    "crane": (
        cp.plants.Crane().flat_system(),
        [[-2, -2.5, -3, -3.5]] * 2,
        [cp.Waypoint(0, [0, 10], 0, 0, 0, 0), cp.Waypoint(9, [2, 11], 0, 0, 0, 0)],
    ),
}


@UNUSED
@pytest.mark.parametrize("name", [*list(FLAT)[:2], pytest.param("crane", marks=pytest.mark.slow)])
def test_default_labels_of_a_law_are_its_flat_outputs(name):
    """A plan of the flat outputs, by name, follows; another one reaches nothing, which is an error."""
    pytest.importorskip("casadi")
    flat, poles, points = FLAT[name]
    t = np.linspace(0.0, points[-1].time, 101)
    plan = cp.PolySpline(points, labels=flat.flat_labels)
    start = {"initial_state": None if name != "crane" else [0.0, 0.0, *flat.states_and_inputs(plan, 0.0)[0]]}
    if name == "crane":
        start["initial_state"][:2] = flat.derived.extension_along(plan, 0.0)
    found = cp.compare(lambda _, plan: labelled(flat, poles, plan), {"move": plan}, t, **start)
    assert found.metrics["move"]["iae"] < 1e-5
    other = cp.PolySpline(points, labels=[f"{label}_load" for label in flat.flat_labels])
    with pytest.raises(
        ValueError, match=rf"references must be connected .* whole, got {other.labels[0]}.* of block plan"
    ):
        cp.compare(lambda _, plan: labelled(flat, poles, plan), {"move": other}, t)
