"""A compiled form depends on all objects of its functions; functions that cannot be analysed are run by Python."""

import collections
import collections.abc
import dataclasses
import datetime
import enum
import functools
import io
import itertools
import os
import random
import sys
import time
import types

import control as ct
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import ctrlplan as cp
from ctrlplan.symbolic.references import References

T = np.linspace(0.0, 2.0, 9)


def decay(k, x):
    """x' = -k x^3, which from 1 is 1/sqrt(1 + 2 k t)."""
    return [-k * x[0] ** 3]


def decayed(k):
    return 1.0 / np.sqrt(1.0 + 2.0 * k * T)


def block(update, name="stale"):
    return ct.nlsys(update, None, inputs=0, outputs=1, states=1, name=name)


module = types.ModuleType("module_of_a_user")
module.inner = types.SimpleNamespace(k=1.0)
module.deeper = types.ModuleType("module_of_a_user.deeper")
exec("k = 1.0\ndef gain():\n    return k", module.__dict__)
exec("k = 1.0", module.deeper.__dict__)
sys.modules["module_of_a_user"] = module

number, table, matrix = 1.0, {"gains": [1.0, 2.0]}, np.eye(2)


def called():
    return called_again()


def called_again():
    return number


def rebound():
    return 1.0


class Plant:
    shared = 1.0

    def __init__(self):
        self.k, self.part = 1.0, types.SimpleNamespace(k=1.0)
        self.generator, self.file = np.random.default_rng(), None  # of no use to the equations

    def gain(self):
        return 1.0

    @property
    def seen(self):
        return self.k

    def by_attribute(self, t, x, u, p):
        return decay(self.k, x)

    def by_part(self, t, x, u, p):
        return decay(self.part.k, x)

    def by_class(self, t, x, u, p):
        return decay(self.shared, x)

    def by_method(self, t, x, u, p):
        return decay(self.gain(), x)

    def by_property(self, t, x, u, p):
        return decay(self.seen, x)


class Called:
    def __init__(self):
        self.k = 1.0

    def __call__(self, t, x, u, p):
        return decay(self.k, x)


class Slotted:
    __slots__ = ("k",)

    def __init__(self):
        self.k = 1.0


@dataclasses.dataclass
class Data:
    k: float = 1.0


def by_global():
    def change(k):
        global number
        number = k

    return lambda t, x, u, p: decay(number, x), change


def by_functions_it_calls():
    return (lambda t, x, u, p: decay(called(), x)), by_global()[1]


def by_a_function_bound_anew():
    def change(k):
        global rebound
        rebound = lambda: k  # noqa: E731

    return (lambda t, x, u, p: decay(rebound(), x)), change


def by_a_dictionary():
    return (lambda t, x, u, p: decay(table["gains"][0], x)), lambda k: table["gains"].__setitem__(0, k)


def by_an_array():
    return (lambda t, x, u, p: decay(matrix[0, 0], x)), lambda k: matrix.__setitem__((0, 0), k)


def by_an_array_of_objects():
    boxes = np.array([[1.0], None], dtype=object)
    return (lambda t, x, u, p: decay(boxes[0][0], x)), lambda k: boxes[0].__setitem__(0, k)


def by_a_large_array():
    large = np.ones(100_000)
    return (lambda t, x, u, p: decay(large[77_777], x)), lambda k: large.__setitem__(77_777, k)


def by_a_closure():
    k = 1.0

    def change(value):
        nonlocal k
        k = value

    return (lambda t, x, u, p: decay(k, x)), change


def by_defaults():
    def update(t, x, u, p, k=1.0):
        return decay(k, x)

    return update, lambda k: setattr(update, "__defaults__", (k,))


def by_keyword_defaults():
    def update(t, x, u, p, *, k=1.0):
        return decay(k, x)

    return update, lambda k: update.__kwdefaults__.update(k=k)


def by_an_attribute_of_the_function():
    def update(t, x, u, p):
        return decay(update.k, x)

    update.k = 1.0
    return update, lambda k: setattr(update, "k", k)


def by_a_module():
    return (lambda t, x, u, p: decay(module.k, x)), lambda k: setattr(module, "k", k)


def by_a_function_of_a_module():
    return (lambda t, x, u, p: decay(module.gain(), x)), lambda k: setattr(module, "k", k)


def by_a_module_in_a_module():
    return (lambda t, x, u, p: decay(module.deeper.k, x)), lambda k: setattr(module.deeper, "k", k)


def by_an_object_of_a_module():
    return (lambda t, x, u, p: decay(module.inner.k, x)), lambda k: setattr(module.inner, "k", k)


def by_an_import_inside():
    def update(t, x, u, p):
        from module_of_a_user import k

        return decay(k, x)

    return update, lambda k: setattr(module, "k", k)


def by_an_attribute():
    plant = Plant()
    return plant.by_attribute, lambda k: setattr(plant, "k", k)


def by_an_attribute_of_an_attribute():
    plant = Plant()
    return plant.by_part, lambda k: setattr(plant.part, "k", k)


def by_the_class():
    return Plant().by_class, lambda k: setattr(Plant, "shared", k)


def by_a_method():
    return Plant().by_method, lambda k: setattr(Plant, "gain", lambda self: k)


def by_a_property():
    plant = Plant()
    return plant.by_property, lambda k: setattr(plant, "k", k)


def by_a_callable_object():
    found = Called()
    return found, lambda k: setattr(found, "k", k)


def by_a_slot():
    slotted = Slotted()
    return (lambda t, x, u, p: decay(slotted.k, x)), lambda k: setattr(slotted, "k", k)


def by_a_dataclass_as_a_tuple():
    data = Data()
    return (lambda t, x, u, p: decay(dataclasses.astuple(data)[0], x)), lambda k: setattr(data, "k", k)


def by_a_named_tuple():
    pair = collections.namedtuple("Pair", "a b")(np.ones(1), 2.0)
    return (lambda t, x, u, p: decay(pair.a[0], x)), lambda k: pair.a.__setitem__(0, k)


def by_a_set():
    gains = {1.0}
    return (lambda t, x, u, p: decay(max(gains), x)), lambda k: (gains.clear(), gains.add(k))


def by_a_partial():
    gains = [1.0]
    return functools.partial(lambda gains, t, x, u, p: decay(gains[0], x), gains), lambda k: gains.__setitem__(0, k)


def by_a_decorated_function():
    plain, change = by_global()
    return functools.wraps(plain)(lambda *given: plain(*given)), change


def by_a_polynomial():
    polynomial = np.polynomial.Polynomial([1.0])
    return (lambda t, x, u, p: decay(polynomial(0.0), x)), lambda k: polynomial.coef.__setitem__(0, k)


def by_a_linear_system():
    system = ct.ss([[1.0]], [[1.0]], [[1.0]], 0.0)
    return (lambda t, x, u, p: decay(system.A[0, 0], x)), lambda k: system.A.__setitem__((0, 0), k)


def by_the_value_of_an_enumeration():
    class Gain(enum.Enum):
        FIRST = [1.0]  # noqa: RUF012

    return (lambda t, x, u, p: decay(Gain.FIRST.value[0], x)), lambda k: Gain.FIRST.value.__setitem__(0, k)


def by_a_metaclass():
    class Meta(type):
        k = 1.0

    class Plain(metaclass=Meta):
        pass

    return (lambda t, x, u, p: decay(Plain.k, x)), lambda k: setattr(Meta, "k", k)


def by_a_class_in_a_class():
    class Outer:
        class Inner:
            k = 1.0

    return (lambda t, x, u, p: decay(Outer.Inner.k, x)), lambda k: setattr(Outer.Inner, "k", k)


def by_a_descriptor():
    class Descriptor:
        k = 1.0

        def __get__(self, instance, owner=None):
            return self.k

    class Holder:
        gain = Descriptor()

    holder = Holder()
    return (lambda t, x, u, p: decay(holder.gain, x)), lambda k: setattr(vars(Holder)["gain"], "k", k)


def by_attributes_made_on_demand():
    class Dynamic:
        def __init__(self):
            self.hidden = {"k": 1.0}

        def __getattr__(self, name):
            return self.hidden[name]

    dynamic = Dynamic()
    return (lambda t, x, u, p: decay(dynamic.k, x)), lambda k: dynamic.hidden.update(k=k)


def by_an_operator():
    class Factor:
        k = 1.0

        def __rmul__(self, other):
            return other * self.k

    factor = Factor()
    return (lambda t, x, u, p: [-(x[0] ** 3) * factor]), lambda k: setattr(factor, "k", k)


def by_a_cached_property():
    class Cached:
        k = 1.0

        @functools.cached_property
        def gain(self):
            return self.k

    cached = Cached()
    return (lambda t, x, u, p: decay(cached.gain, x)), lambda k: vars(cached).update(gain=k)


def by_a_view_of_an_array():
    whole = np.ones(3)
    part = whole[1:]
    return (lambda t, x, u, p: decay(part[0], x)), lambda k: whole.__setitem__(1, k)


def by_a_spline():
    spline = CubicSpline([0.0, 1.0, 2.0], [1.0, 1.0, 1.0])
    return (lambda t, x, u, p: decay(float(spline(0.0)), x)), lambda k: spline.c.__setitem__((-1, 0), k)


def by_new_code():
    def update(t, x, u, p):
        return decay(1.0, x)

    codes = {1.0: update.__code__, 4.0: (lambda t, x, u, p: decay(4.0, x)).__code__}
    return update, lambda k: setattr(update, "__code__", codes[k])


def by_a_plan_of_a_user_inside_another():
    class _Level(cp.PolySpline):
        levels = [1.0]  # noqa: RUF012

        def segment_jet(self, segment, s, order):
            return super().segment_jet(segment, s, order) * self.levels[0]

    stacked = cp.stack([_Level([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)])])
    return (lambda t, x, u, p: decay(2.0 * float(stacked(0.5)), x)), lambda k: _Level.levels.__setitem__(0, k)


def by_a_chain_of_dictionaries():
    chain = collections.ChainMap({"k": 1.0})
    return (lambda t, x, u, p: decay(chain["k"], x)), lambda k: chain.update(k=k)


def by_a_subclass_of_a_mapping():
    class Gains(collections.abc.Mapping):
        def __init__(self):
            self.hidden = {"k": 1.0}

        def __getitem__(self, key):
            return self.hidden[key]

        def __iter__(self):
            return iter(self.hidden)

        def __len__(self):
            return len(self.hidden)

    gains = Gains()
    return (lambda t, x, u, p: decay(gains.get("k"), x)), lambda k: gains.hidden.update(k=k)


def by_ten_levels_of_functions():
    gains = [1.0]

    def deeper(levels):
        inner = deeper(levels - 1) if levels else lambda: gains[0]
        return lambda: inner()

    function = deeper(10)
    return (lambda t, x, u, p: decay(function(), x)), lambda k: gains.__setitem__(0, k)


WAYS = [way for name, way in sorted(globals().items()) if name.startswith("by_")]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
@pytest.mark.parametrize("method", ["auto", "compiled"])
def test_what_a_function_refers_to_may_change(way, method):
    update, change = way()
    system = block(update)
    try:
        for k in (1.0, 4.0, 1.0):
            change(k)
            found = cp.simulate(system, T, None, 1.0, method=method)
            assert found.method == "compiled"
            assert np.abs(found.states[0] - decayed(k)).max() <= 1e-6
    finally:
        change(1.0)


def test_a_prepared_form_notices_as_well():
    update, change = by_an_array()
    ready = cp.prepare(block(update))
    for k in (1.0, 9.0):
        change(k)
        assert np.abs(cp.simulate(ready, T, None, 1.0).states[0] - decayed(k)).max() <= 1e-6
    change(1.0)


@pytest.mark.parametrize("where", ["block", "run", "interconnection"])
def test_what_a_parameter_refers_to_may_change(where):
    gains = [1.0]
    params = {"law": lambda x: -gains[0] * x[0] ** 3}
    own = params if where == "block" else {}
    system = ct.nlsys(
        lambda t, x, u, p: [p["law"](x)], None, inputs=0, outputs=["y"], states=1, params=own, name="inner"
    )
    if where == "interconnection":
        system = ct.interconnect([system], inputs=0, outputs=["y"], params=params)
    for gains[0] in (1.0, 4.0, 1.0):
        found = cp.simulate(system, T, None, 1.0, params=params if where == "run" else None)
        assert found.method == "compiled"
        assert np.abs(found.states[0] - decayed(gains[0])).max() <= 1e-6


def test_one_form_while_nothing_changes(monkeypatch):
    """An object with parts of no use to the equations, a property and a matrix: traced once."""
    from ctrlplan.symbolic import tracing as traced_module

    traces = []
    plain = traced_module.traced
    monkeypatch.setattr(traced_module, "traced", lambda *given: traces.append(given) or plain(*given))

    class Mass(Plant):
        @property
        def inverse(self):
            return 1.0 / self.k

        def update(self, t, x, u, p):
            return decay(matrix[1, 1] * self.inverse, x)

    system = block(Mass().update)
    for _ in range(3):
        assert cp.simulate(system, T, None, 1.0, method="compiled").method == "compiled"
    assert len(traces) == 1


# Functions that cannot be analysed


def with_random_numbers():
    generator = np.random.default_rng(1)
    return lambda t, x, u, p: [-x[0] + 0.0 * generator.normal()]


def with_global_random_numbers():
    return lambda t, x, u, p: [-x[0] + 0.0 * np.random.normal()]  # noqa: NPY002


def with_python_random_numbers():
    gauss = random.gauss
    return lambda t, x, u, p: [-x[0] + 0.0 * gauss(0.0, 1.0)]


def with_the_clock():
    return lambda t, x, u, p: [-x[0] + 0.0 * time.perf_counter()]


def with_the_date():
    return lambda t, x, u, p: [-x[0] + 0.0 * datetime.datetime.now().second]


def with_the_environment():
    return lambda t, x, u, p: [-x[0] * float(os.environ.get("A_GAIN", "1"))]


def with_a_counter():
    counter = itertools.count()
    return lambda t, x, u, p: [-x[0] + 0.0 * next(counter)]


def with_a_generator():
    steps = (k for k in range(10**9))
    return lambda t, x, u, p: [-x[0] + 0.0 * next(steps)]


def with_an_open_file():
    file = io.StringIO("some text")
    return lambda t, x, u, p: [-x[0] + 0.0 * len(file.read())]


def with_a_cache():
    gain = functools.lru_cache(lambda: 1.0)
    return lambda t, x, u, p: [-gain() * x[0]]


def with_globals_by_name():
    return lambda t, x, u, p: [-globals()["num" + "ber"] * x[0]]


def with_evaluated_text():
    return lambda t, x, u, p: [-eval("number") * x[0]]


def with_a_hidden_function():
    ufunc = np.frompyfunc(lambda v: number * v, 1, 1)
    return lambda t, x, u, p: [-ufunc(x[0])]


def with_too_many_objects():
    many = [(k,) for k in range(30_000)]
    return lambda t, x, u, p: [-x[0] + 0.0 * len(many)]


HIDDEN = [way for name, way in sorted(globals().items()) if name.startswith("with_")]


@pytest.mark.parametrize("way", HIDDEN, ids=lambda way: way.__name__)
def test_what_cannot_be_followed_is_run_by_python(way):
    system = block(way(), "hidden")
    found = cp.simulate(system, T, None, 1.0)
    assert found.method == "python"
    assert found.reason.startswith("block hidden refers to")
    assert "can change without notice" in found.reason
    assert np.abs(found.states[0] - np.exp(-T)).max() <= 1e-6
    with pytest.raises(ValueError, match="block hidden refers to"):
        cp.simulate(system, T, None, 1.0, method="compiled")


# The fingerprint itself


def tokens(*roots):
    return References([("root", root) for root in roots]).tokens


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, 1.0),
        (1, True),
        (0.0, -0.0),
        ("1", 1),
        ([1.0, 2.0], (1.0, 2.0)),
        ([[1.0], 2.0], [1.0, [2.0]]),
        ([[], [1]], [[1], []]),
        (np.zeros(4), np.zeros((2, 2))),
        (np.zeros(2), np.zeros(2, dtype=np.int64)),
        (np.float32(1.0), np.float64(1.0)),
        (np.datetime64(1, "s"), np.datetime64(1, "ms")),
        (np.ma.array([1.0, 2.0], mask=[0, 1]), np.ma.array([1.0, 2.0], mask=[1, 0])),
        ({"a": 1, "b": 2}, {"a": 2, "b": 1}),
        ({1, 2}, {1, 3}),
        (float("nan"), 1.0),
        (collections.defaultdict(list), collections.defaultdict(dict)),
    ],
    ids=str,
)
def test_values_that_differ_have_fingerprints_that_differ(one, other):
    assert tokens(one) != tokens(other)
    assert tokens(one) == tokens(one)


def test_what_is_shared_differs_from_what_is_equal():
    part = [1.0]
    assert tokens([part, part]) != tokens([[1.0], [1.0]])


def test_an_import_inside_a_package_is_followed():
    """As ``from . import part`` in a module of a package: the names may be those of a level above."""
    package, part = types.ModuleType("package_of_a_user"), types.ModuleType("package_of_a_user.part")
    package.part, part.k = part, 1.0
    sys.modules |= {"package_of_a_user": package, "package_of_a_user.part": part}
    known = {"__name__": "package_of_a_user.model", "__package__": "package_of_a_user"}
    exec("def update(t, x, u, p):\n    from .part import k\n    return [-k * x[0] ** 3]", known)
    exec("def other(t, x, u, p):\n    from . import part\n    return [-part.k * x[0] ** 3]", known)
    for name in ("update", "other"):
        system = block(known[name])
        for part.k in (1.0, 4.0):
            assert (
                np.abs(cp.simulate(system, T, None, 1.0, method="compiled").states[0] - decayed(part.k)).max() <= 1e-6
            )


class Unwilling:
    """Object without accessible contents."""

    __slots__ = ("__weakref__",)

    def __getattr__(self, name):
        raise RuntimeError(name)


def test_an_object_that_cannot_be_looked_into():
    unwilling = Unwilling()
    found = cp.simulate(block(lambda t, x, u, p: [-x[0] + 0.0 * (unwilling is None)]), T, None, 1.0)
    assert np.abs(found.states[0] - np.exp(-T)).max() <= 1e-6


def test_references_in_a_circle():
    circle = [1.0]
    circle.append(circle)
    before = tokens(circle)
    assert tokens(circle) == before
    circle[0] = 2.0
    assert tokens(circle) != before


def test_the_fingerprint_of_nan_is_that_of_nan():
    assert tokens([float("nan"), None]) == tokens([float("nan"), None])
