"""Contract of all exported blocks, by the exports, so that a new one is also tested."""

import doctest
import inspect
import re
import warnings

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan import systems


def is_old(function):
    """Whether a name is an old one, which only warns."""
    return inspect.getdoc(function).startswith("Old name of ")


BLOCKS = {
    name: getattr(home, name)
    for home in (cp, systems, cp.plants)
    for name in home.__all__
    if (name.startswith("create_") or name == "sample_hold") and not is_old(getattr(home, name))
}
every = pytest.mark.parametrize("name", sorted(BLOCKS))

PLAN = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)], labels=["x"])
ARGUMENTS = {
    "bandwidth": 2.0,
    "shaper": cp.Shaper.zv(2.0),
    "block": ct.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1, inputs="e", outputs="u", states="memory", name="filter"),
    "crane": cp.plants.Crane(),
    "delay": 0.5,
    "dt": 0.1,
    "flat": cp.plants.integrator_chain(2),
    "high": 2.0,
    "kd": 0.5,
    "ki": 2.0,
    "kp": 3.0,
    "loop": cp.plants.integrator_lag_loop(5.0),
    "low": -1.0,
    "plan": PLAN,
    "poles": [-1.0, -2.0],
    "tf": 0.1,
}
FURTHER = {
    "create_governor_iosystem": {
        "loop": cp.plants.integrator_lag_loop(5.0, outputs=("y", "u")),
        "dt": 0.1,
        "limits": {"u": (-1.0, 1.0)},
    },
    "create_replanner_iosystem": {"goal_derivatives": 0},
    "create_time_scaling_iosystem": {"limits": {"u": (-1.0, 1.0)}},
}


def parameters(name):
    return inspect.signature(BLOCKS[name]).parameters


def build(name, /, **options):
    """An example of a block from the arguments that it requires."""
    given = {}
    for label, parameter in parameters(name).items():
        if parameter.default is parameter.empty and label not in FURTHER.get(name, {}):
            assert label in ARGUMENTS, f"say in ARGUMENTS what the argument {label} of {name} may be"
            given[label] = ARGUMENTS[label]
    return BLOCKS[name](**(given | FURTHER.get(name, {}) | options))


def outputs(block, seed=0):
    """Outputs of a block at random states and inputs; of one that samples, the next state."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=block.nstates or 0), rng.normal(size=block.ninputs or 0)
    sample = cp.traits_of(block).sample
    if cp.traits_of(block).delay is not None:
        return cp.simulate(block, [0.0, 1.0], cp.Step(1.0)).outputs
    return block.output(0.3, x, u) if sample is None else sample(0.3, x, u, {})


# Signatures


@every
def test_what_it_needs_is_positional_and_the_rest_is_named(name):
    known = list(parameters(name).values())
    kinds = [p.kind for p in known]
    assert set(kinds) == {inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY}
    assert kinds == sorted(kinds)
    for p in known:
        if p.kind is p.KEYWORD_ONLY:
            assert p.default is not p.empty, f"{p.name} is needed, and must come before the keywords"
        assert p.annotation is not p.empty
    assert known[-1].name == "name"
    assert isinstance(known[-1].default, str | None)
    assert len(known) <= 19


@every
def test_its_signals_are_named_by_inputs_and_outputs_or_by_labels_and_suffix(name):
    known = parameters(name)
    names = [label for label in known if label in ("inputs", "outputs", "labels", "suffix")]
    assert names in (["inputs", "outputs"], ["labels", "suffix"])
    assert list(known)[-3:] == [*names, "name"]
    for label in names:
        assert known[label].kind is inspect.Parameter.KEYWORD_ONLY
        assert (known[label].default is None) == (label != "suffix")
    assert not {"input", "output", "label"} & set(known)


@every
def test_the_name_is_that_of_the_block(name):
    assert build(name, name="mine").name == "mine"
    default = parameters(name)["name"].default
    assert default is None or build(name).name == default


# Docstrings


@every
def test_the_docstring_has_its_sections_and_every_parameter(name):
    doc = inspect.getdoc(BLOCKS[name])
    for section in ("Parameters", "Returns", "Raises", "Examples"):
        assert re.search(rf"^{section}\n-+$", doc, re.MULTILINE), section
    listed = doc.partition("Parameters\n")[2].partition("\nReturns\n")[0]
    described = [entry for row in re.findall(r"^(\w[\w, ]*) : ", listed, re.MULTILINE) for entry in row.split(", ")]
    assert sorted(described) == sorted(parameters(name))


@every
def test_the_docstring_names_states_inputs_and_outputs(name):
    doc = re.sub(r"\s+", " ", inspect.getdoc(BLOCKS[name]))
    block = build(name)
    assert "States: " in doc or "No states" in doc
    assert "Inputs: " in doc or "No inputs" in doc
    assert "Outputs: " in doc
    if isinstance(block, ct.InterconnectedSystem):
        block = block.syslist[-1]
        labels = [*block.state_labels, *build(name).input_labels, *build(name).output_labels]
    else:
        labels = [*block.state_labels, *block.input_labels, *block.output_labels]
    if name == "sample_hold":  # those of another block
        labels = ["_held"]
    for label in labels:
        stem = re.sub(r"(_d\d+|\[\d+\])$", "", label)
        assert stem in doc, f"{name} does not name {label}"


@every
def test_the_example_connects_it(name):
    tests = doctest.DocTestFinder(recurse=False).find(BLOCKS[name], name, globs={})
    code = "".join(example.source for test in tests for example in test.examples)
    assert re.search(rf"\b{name}\(", code)
    assert "ct.interconnect(" in code


# Names that are given


@every
def test_signals_are_renamed_and_nothing_else_changes(name):
    plain = build(name)
    if "inputs" in parameters(name):
        inputs = [f"in{k}" for k in range(plain.ninputs)]
        results = [f"out{k}" for k in range(plain.noutputs)]
        named = build(name, inputs=inputs, outputs=results)
        assert (named.input_labels, named.output_labels) == (inputs, results)
    else:
        crane = "crane" in parameters(name)
        plan = parameters(name).get("plan")
        planned = plan is not None and plan.default is plan.empty
        old = {"x": "a", "z": "b"} if crane else {"x": "a"} if planned else {"y": "a"}
        suffix = parameters(name)["suffix"].default
        named = build(name, labels=list(old.values()), suffix="_q")
        side = "input_labels" if suffix else "output_labels"
        wanted = [
            re.sub(rf"^({'|'.join(old)}){suffix}(?=_d|$)", lambda found: f"{old[found[1]]}_q", label)
            if suffix in label
            else label
            for label in getattr(plain, side)
        ]
        assert getattr(named, side) == wanted
        assert wanted != getattr(plain, side)
    assert named.nstates == plain.nstates
    if not isinstance(plain, ct.InterconnectedSystem):
        np.testing.assert_array_equal(outputs(named), outputs(plain))


def test_a_replanner_with_labels_reads_the_goal_of_that_name():
    replanner = build("create_replanner_iosystem", labels="p", suffix="_r", measured=0)
    assert replanner.input_labels == ["p_goal", "p"]
    assert replanner.output_labels == ["p_r", "p_r_d1", "p_r_d2"]
    plain, t = build("create_replanner_iosystem"), np.linspace(0.0, 1.5, 7)
    found = [cp.simulate(block, t, cp.Step(1.5, 1.0, 0.4)).outputs for block in (plain, build_renamed())]
    np.testing.assert_array_equal(*found)


def build_renamed():
    return build("create_replanner_iosystem", labels="p", suffix="_r")


def test_a_governor_takes_the_names_of_its_commands_or_of_all_inputs():
    own = build("create_governor_iosystem").input_labels
    assert build("create_governor_iosystem", inputs="wish").input_labels == ["wish", *own[1:]]
    with pytest.raises(ValueError, match=r"^inputs must be names of 1 commands, or of them and 2 states, got 2$"):
        build("create_governor_iosystem", inputs=["wish", "more"])
    renamed = build("create_governor_iosystem", outputs="v")
    assert (renamed.output_labels, renamed.state_labels[0]) == (["v"], "v_offset")


def test_a_filter_takes_one_name_or_a_name_for_each_output():
    assert build("create_command_filter_iosystem", outputs="q").output_labels == ["q", "q_d1", "q_d2"]
    each = build("create_command_filter_iosystem", outputs=["pos", "vel", "acc"])
    assert (each.output_labels, each.name) == (["pos", "vel", "acc"], "pos_filter")
    with pytest.raises(ValueError, match=r"^outputs must be 3 names, got 2"):
        build("create_command_filter_iosystem", outputs=["pos", "vel"])


@pytest.mark.parametrize("side", ["inputs", "outputs"])
@pytest.mark.parametrize("name", [name for name in sorted(BLOCKS) if "inputs" in parameters(name)])
def test_names_that_do_not_fit(name, side):
    with pytest.raises(TypeError, match=f"^{side} must be names of signals, got 5"):
        build(name, **{side: 5})
    with pytest.raises(ValueError, match=r"^(inputs|outputs) must be .*(, got|inputs,) 9"):
        build(name, **{side: [f"s{k}" for k in range(9)]})
    with pytest.raises(ValueError, match=f"^{side} must differ from each other, got a, a|^{side} must be .*, got 2"):
        build(name, **{side: ["a", "a"]})


# Limits


@pytest.mark.parametrize("short", [2.0, 2, np.float64(2.0), np.array(2.0)])
def test_one_number_is_the_limit_of_the_magnitude(short):
    pids = [cp.create_pid_iosystem(3.0, 1.0, 2.0, 0.1, limits=limits) for limits in (short, (-2.0, 2.0))]
    for error in (-5.0, -0.01, 0.01, 5.0):
        np.testing.assert_array_equal(*(pid.output(0.0, [0.1, 0.0], [error, 0.0]) for pid in pids))
    loop = FURTHER["create_governor_iosystem"]["loop"]
    found = [cp.AdmissibleSet(loop, {"u": limits}, 0.1) for limits in (short, (-2.0, 2.0))]
    np.testing.assert_array_equal(*(one.bounds for one in found))
    clocks = [cp.create_time_scaling_iosystem(PLAN, limits={"u": limits}) for limits in (short, (-2.0, 2.0))]
    np.testing.assert_array_equal(*(clock.dynamics(0.3, [0.1, 0.0, 0.0], [1.95]) for clock in clocks))
    plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    loops = [
        cp.plants.crane_loop(cp.plants.Crane(), plan, "setpoint", force_limits=limits) for limits in (short, (-2, 2))
    ]
    state = cp.traits_of(loops[0]).initial_state + 0.5
    np.testing.assert_array_equal(*(loop.dynamics(0.0, state, []) for loop in loops))


@pytest.mark.parametrize(
    ("limits", "kind", "message"),
    [
        (0.0, ValueError, "must be finite and above 0, got 0.0"),
        (-1, ValueError, "must be finite and above 0, got -1.0"),
        (np.inf, ValueError, "must be finite and above 0, got inf"),
        (True, TypeError, "must be a number, got True"),
        ((1.0, -1.0), ValueError, "must increase, got 1 and -1"),
        ((1.0,), ValueError, r"must be two numbers, got \(1.0,\)"),
        ("ab", ValueError, "must be two numbers, got 'ab'"),
    ],
)
def test_limits_that_are_none(limits, kind, message):
    with pytest.raises(kind, match=f"^limits {message}"):
        cp.create_pid_iosystem(3.0, 1.0, 2.0, 0.1, limits=limits)
    with pytest.raises(kind, match=f"^limits of u {message}"):
        cp.AdmissibleSet(FURTHER["create_governor_iosystem"]["loop"], {"u": limits}, 0.1)
    plan = cp.Step([0.0, 10.0], [0.0, 10.0], labels=["x", "z"])
    with pytest.raises(kind, match=f"^torque_limits {message}"):
        cp.plants.crane_loop(cp.plants.Crane(), plan, "setpoint", torque_limits=limits)


# Old forms, for one release

CRANE = ARGUMENTS["crane"]
LOOP = ARGUMENTS["loop"]
CHAIN = ARGUMENTS["flat"]
BLOCK = ARGUMENTS["block"]
OLD = [
    ("create_pid_iosystem", (3.0, 1.0, 2.0, 0.1, 0.5, (-1, 1), 0.2, "p"), {},
     {"bias": 0.5, "limits": (-1, 1), "tracking_time": 0.2, "name": "p"},
     "bias, limits, tracking_time, name by position in create_pid_iosystem is deprecated.*bias=, limits=, "),
    ("create_pid_iosystem", (3.0, 1.0, 2.0, 0.1), {"output": "F"}, {"outputs": "F"}, "output= is.*use outputs="),
    ("create_saturation_iosystem", (-1.0, 1.0, "a", "b", "s"), {}, {"inputs": "a", "outputs": "b", "name": "s"},
     "inputs, outputs, name by position in create_saturation_iosystem"),
    ("create_saturation_iosystem", (-1.0, 1.0), {"input": "a"}, {"inputs": "a"}, "input= is.*use inputs="),
    ("create_delay_iosystem", (0.5, "a", "b", 2.0, "d"), {},
     {"inputs": "a", "outputs": "b", "initial": 2.0, "name": "d"},
     "inputs, outputs, initial, name by position in create_delay_iosystem"),
    ("create_command_filter_iosystem", (2.0,), {"input": "a"}, {"inputs": "a"}, "input= is deprecated"),
    ("create_command_filter_iosystem", (2.0,), {"output": "q"}, {"outputs": "q"}, "output= is deprecated"),
    ("create_source_iosystem", (PLAN, 2, "mine"), {}, {"name": "mine"}, "name by position in create_source_iosystem"),
    ("create_flat_iosystem", (CHAIN, [-1.0, -2.0], "mine"), {}, {"name": "mine"}, "name by position"),
    ("create_flat_iosystem", (), {"flat_system": CHAIN, "poles": [-1.0, -2.0]}, {"flat": CHAIN, "poles": [-1.0, -2.0]},
     "flat_system= is deprecated.*use flat="),
    ("create_feedforward_iosystem", (LOOP, "q", "mine"), {}, {"labels": "q", "suffix": "", "name": "mine"},
     "label, name by position in create_feedforward_iosystem.*use labels=, name=, suffix=''"),
    ("create_feedforward_iosystem", (LOOP,), {"label": "q"}, {"labels": "q", "suffix": ""},
     "label= is deprecated.*use labels=, suffix=''"),
    ("create_feedforward_iosystem", (LOOP, None, "mine"), {}, {"name": "mine"}, "label, name by position"),
    ("sample_hold", (BLOCK, 0.1, 0.0, "mine"), {}, {"name": "mine"}, "name by position in sample_hold"),
    ("create_setpoint_iosystem", (CRANE, "mine"), {}, {"name": "mine"}, "name by position in create_setpoint_iosystem"),
    ("create_generator_iosystem", (CRANE, "mine"), {}, {"name": "mine"}, "name by position"),
    ("create_load_feedback_iosystem", (CRANE, 1.0, 0.8, "mine"), {}, {"name": "mine"}, "name by position"),
    ("create_load_feedback_iosystem", (CRANE,), {"bandwidth": 0.5}, {"load_bandwidth": 0.5},
     "bandwidth= is deprecated.*use load_bandwidth="),
    ("create_dynamic_law_iosystem", (CRANE, [-1, -2, -3, -4], "mine"), {}, {"name": "mine"}, "name by position"),
    ("create_crane_feedforward_iosystem", (CRANE, "mine"), {}, {"name": "mine"}, "name by position"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "args", "kwargs", "new", "message"), OLD)
def test_an_old_form_gives_the_same_block_with_a_warning(name, args, kwargs, new, message):
    known = parameters(name).values()
    count = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in known)
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        wanted = BLOCKS[name](*args[:count], **new)
    with pytest.warns(FutureWarning, match=message) as caught:
        found = BLOCKS[name](*args, **kwargs)
    ours = [warning for warning in caught if warning.category is FutureWarning]  # others: control with numpy 2.5
    assert [warning.filename for warning in ours] == [__file__]
    for labels in ("input_labels", "output_labels", "state_labels", "name"):
        assert getattr(found, labels) == getattr(wanted, labels)
    np.testing.assert_array_equal(outputs(found), outputs(wanted))


def test_old_and_new_names_together_are_an_error():
    with pytest.raises(TypeError, match=r"^output= is the deprecated name of outputs=; only one of them may be given"):
        cp.create_pid_iosystem(3.0, 1.0, 2.0, 0.1, output="F", outputs="F")
    with pytest.raises(TypeError, match=r"^label= is the deprecated name of labels=; only one of them may be given"):
        cp.create_feedforward_iosystem(LOOP, "q", labels="q")
    with pytest.raises(TypeError, match="positional argument"):
        cp.create_source_iosystem(PLAN, 2, "mine", name="other")
    with pytest.raises(TypeError, match="positional argument"):
        cp.create_source_iosystem(PLAN, 2, "mine", "_ref")


def test_create_still_iosystem_is_the_old_name_of_the_setpoint_law():
    with pytest.warns(
        FutureWarning, match="^create_still_iosystem is deprecated.*use create_setpoint_iosystem"
    ) as caught:
        found = cp.plants.create_still_iosystem(CRANE, labels=["a", "b"], name="mine")
    assert caught[0].filename == __file__
    wanted = cp.plants.create_setpoint_iosystem(CRANE, labels=["a", "b"], name="mine")
    assert (found.name, found.input_labels, found.output_labels) == ("mine", wanted.input_labels, wanted.output_labels)
    np.testing.assert_array_equal(outputs(found), outputs(wanted))


def test_command_lead_is_the_old_name_of_the_gains():
    with pytest.warns(FutureWarning, match="^command_lead is deprecated.*use command_filter_gains"):
        assert cp.command_lead(2.0, 2) == cp.command_filter_gains(2.0, 2) == (1.0, 1.0, 0.25)
