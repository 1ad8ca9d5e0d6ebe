"""Laws of the crane as values: one table of names, typed and checked options, a user's law, old names."""

import inspect
import pickle
from dataclasses import FrozenInstanceError, dataclass, fields
from typing import get_args

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.systems.plants import (
    LAWS,
    Crane,
    DynamicLaw,
    FeedforwardLaw,
    GeneratorLaw,
    Law,
    LoadFeedbackLaw,
    SetpointLaw,
    crane_loop,
)
from ctrlplan.systems.plants.crane.laws import LawName

CRANE = Crane()


def plan(order=5):
    rest = [0.0] * (order - 1)
    ends = ((0.0, 0.0, 10.0), (8.0, 5.0, 9.0))
    return cp.PolySpline([cp.Waypoint.from_jets(t, x=[x, *rest], z=[z, *rest]) for t, x, z in ends])


T = np.linspace(0.0, 9.0, 10)
each_law = pytest.mark.parametrize("name", LAWS)


def outputs(loop):
    return cp.simulate(loop, T).outputs


def test_the_table_is_the_list_of_names():
    assert tuple(LAWS) == get_args(LawName)
    assert all(law.name == name for name, law in LAWS.items())
    assert cp.Law is Law


@each_law
def test_a_name_is_short_for_the_law_with_its_defaults(name):
    law = LAWS[name]
    assert law == type(law)()
    np.testing.assert_array_equal(outputs(crane_loop(CRANE, plan(), name)), outputs(crane_loop(CRANE, plan(), law)))


@each_law
def test_laws_are_frozen_values(name):
    law = LAWS[name]
    assert hash(law) == hash(pickle.loads(pickle.dumps(law)))
    with pytest.raises(FrozenInstanceError):
        law.name = "other"


@each_law
def test_what_a_law_states_is_what_its_block_has(name):
    law = LAWS[name]
    block = law.build(CRANE)
    assert tuple(block.output_labels) == law.outputs
    suffixes = ["", *(f"_d{k}" for k in range(1, law.order + 1))]
    references = [f"{axis}_ref{suffix}" for axis in "xz" for suffix in suffixes]
    assert block.input_labels[: len(references)] == references
    assert not [label for label in block.input_labels[len(references) :] if "_ref" in label]


@each_law
def test_options_of_a_loop_are_fields_of_the_law_by_the_same_name(name):
    """No option is renamed, and none is passed by **options."""
    parameters = inspect.signature(crane_loop).parameters
    assert len(parameters) <= 19
    assert all(p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) for p in parameters.values())
    assert all(p.annotation is not p.empty and "Any" not in p.annotation for p in parameters.values())
    assert {entry.name for entry in fields(LAWS[name])} <= set(parameters)


@pytest.mark.parametrize(
    ("name", "law", "options"),
    [
        ("load_feedback", LoadFeedbackLaw(load_bandwidth=0.4, damping=0.7), {"load_bandwidth": 0.4, "damping": 0.7}),
        ("load_feedback", LoadFeedbackLaw(damping=0.7), {"damping": 0.7}),
        ("dynamic", DynamicLaw(poles=(-2, -2.1, -2.2, -2.3)), {"poles": [-2, -2.1, -2.2, -2.3]}),
    ],
)
def test_options_given_with_a_name_are_those_of_the_law(name, law, options):
    short = outputs(crane_loop(CRANE, plan(), name, **options))
    np.testing.assert_array_equal(short, outputs(crane_loop(CRANE, plan(), law)))


def test_options_that_change_nothing_would_be_silent():
    """The load's own error under two options differs, so that both take effect."""
    slow, fast = (outputs(crane_loop(CRANE, plan(3), LoadFeedbackLaw(load_bandwidth=w))) for w in (0.2, 2.0))
    assert np.abs(slow - fast).max() > 1e-4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LoadFeedbackLaw(load_bandwidth=0.0), "load_bandwidth must be finite and above 0, got 0"),
        (lambda: LoadFeedbackLaw(damping=np.nan), "damping must be finite and above 0, got nan"),
        (lambda: DynamicLaw(poles=(-1, -2, -3)), "poles must be as many"),
        (lambda: DynamicLaw(poles=(-1, -2, 3, -4)), "poles must be finite with negative real parts"),
        (lambda: crane_loop(CRANE, plan(), "generator", damping=1.0), "'generator' must be among none, got damping"),
        (lambda: crane_loop(CRANE, plan(), "dynamic", damping=1.0), "'dynamic' must be among poles, got damping"),
        (lambda: crane_loop(CRANE, plan(), "pid"), "law must be one of setpoint, generator, .*, got 'pid'"),
    ],
)
def test_wrong_options_are_errors_where_they_are_given(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("law", [None, 3, LoadFeedbackLaw, ["generator"]])
def test_what_is_no_law(law):
    with pytest.raises(TypeError, match="law must be a Law or one of setpoint, generator"):
        crane_loop(CRANE, plan(), law)


def test_options_given_with_a_law_value_are_ambiguous():
    with pytest.raises(TypeError, match="options of a law must be given to the law itself, got damping"):
        crane_loop(CRANE, plan(), LoadFeedbackLaw(), damping=0.7)


# The old name


def test_the_old_name_of_the_setpoint_law_warns_at_the_caller_s_line():
    with pytest.warns(FutureWarning, match='law "still" is deprecated.*use "setpoint"') as caught:
        old = crane_loop(CRANE, plan(), "still")
    assert [w.filename for w in caught] == [__file__]
    np.testing.assert_array_equal(outputs(old), outputs(crane_loop(CRANE, plan(), SetpointLaw())))


# A user's own law


@dataclass(frozen=True)
class Shifted(Law):
    """Figure 3's generator with the trolley's reference shifted."""

    name = "shifted"
    order = 2
    continuity = 0
    shift: float = 0.0

    def build(self, crane):
        inner = GeneratorLaw().build(crane)

        def out(t, x, u, params):
            return inner.outfcn(t, x, u, params) + np.array([self.shift, 0.0])

        return ct.nlsys(None, out, inputs=inner.input_labels, outputs=inner.output_labels, dt=None, name=self.name)


@pytest.mark.slow
def test_a_user_s_law_is_given_like_any_other():
    np.testing.assert_allclose(
        outputs(crane_loop(CRANE, plan(), Shifted())), outputs(crane_loop(CRANE, plan(), "generator")), atol=1e-7
    )
    shifted = crane_loop(CRANE, cp.stack([plan()], labels=["x", "z"]), Shifted(shift=0.5))
    end = cp.simulate(shifted, [0.0, 60.0])
    at_rest = dict(zip(shifted.output_labels, end.outputs[:, -1], strict=True))
    assert at_rest["D"] == pytest.approx(5.5 - CRANE.drum_radius, abs=0.02)


def test_a_user_s_law_in_the_table_has_a_name(monkeypatch):
    monkeypatch.setitem(LAWS, "shifted", Shifted(shift=0.1))
    assert "shifted" in [block.name for block in crane_loop(CRANE, plan(), "shifted").syslist]


def test_a_user_s_law_is_checked():
    kinked = cp.PiecewiseSpline([cp.Waypoint.from_jets(t, x=[x], z=[10.0]) for t, x in ((0, 0), (4, 2), (8, 5))])
    with pytest.raises(ValueError, match=r"the law 'stiff' must be given a plan continuous up to derivative 1"):
        crane_loop(CRANE, kinked, type("Stiff", (Shifted,), {"name": "stiff", "continuity": 1})())
    with pytest.raises(ValueError, match=r"must build a block with the outputs F and C, got one without C and F"):
        crane_loop(CRANE, plan(), type("Wrong", (Shifted,), {"outputs": ("F", "C")})())
    with pytest.raises(ValueError, match=r"outputs of a law must be .* got \('v',\) of the law 'shifted'"):
        crane_loop(CRANE, plan(), type("Odd", (Shifted,), {"outputs": ("v",)})())
    with pytest.raises(TypeError, match="abstract"):
        Law()


def test_limits_go_with_the_pids():
    for law in (DynamicLaw(), FeedforwardLaw()):
        with pytest.raises(
            ValueError, match="force_limits and torque_limits must be given with a law that uses the PIDs"
        ):
            crane_loop(CRANE, plan(), law, force_limits=(-1.0, 1.0))
