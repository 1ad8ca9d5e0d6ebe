"""Built forms: kept, noticed to be out of date, sent to other processes; and what only python-control runs."""

import math
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.simulation import Event, Prepared, prepare, simulate
from ctrlplan.simulation import prepared as prepared_module

T = np.linspace(0.0, 2.0, 9)
TIGHT = {"rtol": 1e-10, "atol": 1e-12}
PLAN = cp.PolySpline([cp.Waypoint(0.3, 0, 0, 0), cp.Waypoint(1.2, 1, 0, 0)], labels=["r"])


def decay(k=1.0, name="decay"):
    """x' = -k x^3."""
    return ct.nlsys(
        lambda t, x, u, p: -p["k"] * x**3, None, inputs=0, outputs="y", states=1, params={"k": k}, name=name
    )


def cubic(k):
    return lambda t, x, u, p: -k * x**3


def decayed(k, start=1.0):
    return start / np.sqrt(1 + 2 * k * start**2 * T)


def planned_loop():
    """x' = -w x + w r, y = x^3."""
    return ct.nlsys(
        lambda t, x, u, p: p["w"] * (u - x),
        lambda t, x, u, p: x**3,
        inputs="r",
        outputs="y",
        states=1,
        params={"w": 1.0},
        name="planned_loop",
    )


# Prepared in the place of the system


@pytest.mark.parametrize("method", ["auto", "compiled", "python"])
def test_equal_results_compiled_and_interpreted(method):
    system = planned_loop()
    ready = prepare(system)
    assert isinstance(ready, Prepared)
    assert prepare(ready) is ready
    for inputs, start, params in ((PLAN, 0.0, None), (2.0, 0.5, {"w": 3.0}), (np.sin(T), -1.0, None)):
        one, two = (simulate(s, T, inputs, start, method=method, params=params) for s in (system, ready))
        assert np.array_equal(one.outputs, two.outputs)
        assert np.array_equal(one.states, two.states)
        assert (one.method, one.reason, one.sysname) == (two.method, two.reason, two.sysname)
        assert (one.output_labels, one.state_labels, one.input_labels) == (
            two.output_labels,
            two.state_labels,
            two.input_labels,
        )


@pytest.mark.parametrize("method", ["exact", "compiled", "python"])
def test_equal_results_of_a_linear_loop(method):
    loop = cp.plants.integrator_lag_loop(5.0, ["y", "u"])
    one, two = (simulate(s, T, PLAN, method=method) for s in (loop, prepare(loop)))
    assert np.array_equal(one.outputs, two.outputs)
    assert one.outputs.shape == two.outputs.shape == (2, T.size)


def test_what_a_prepared_form_says_of_itself():
    loop = cp.plants.integrator_lag_loop(5.0, ["y", "u"])
    ready = prepare(loop)
    assert (ready.name, ready.nstates, ready.ninputs) == (loop.name, 2, 1)
    assert (ready.input_labels, ready.output_labels) == (["r"], ["y", "u"])
    assert ready.state_labels == loop.state_labels
    assert loop.name in repr(ready)


def test_a_transfer_function_is_prepared_too():
    found = simulate(prepare(ct.tf([1.0], [1.0, 1.0])), T, 1.0)
    assert np.abs(found.outputs + np.expm1(-T)).max() <= 1e-12


def test_the_state_in_which_a_prepared_loop_rests():
    system = decay()
    cp.declare(system, initial_state=np.array([2.0]))
    for one in (system, prepare(system)):
        assert np.abs(simulate(one, T).outputs.ravel() - decayed(1.0, 2.0)).max() <= 1e-7
        assert np.abs(simulate(one, T, None, 1.0).outputs.ravel() - decayed(1.0)).max() <= 1e-7


def test_a_resting_state_given_later_is_noticed():
    system = decay()
    ready = prepare(system)
    assert np.abs(simulate(system, T).outputs).max() == 0.0
    cp.declare(system, initial_state=np.array([1.0]))
    for one in (system, ready):
        assert np.abs(simulate(one, T).outputs.ravel() - decayed(1.0)).max() <= 1e-7


@pytest.mark.parametrize("thing", [None, 3, "loop", [1.0], prepare], ids=["None", "number", "word", "list", "function"])
def test_what_is_no_system(thing):
    for function in (prepare, lambda s: simulate(s, T)):
        with pytest.raises(TypeError, match="system must be a control system, got"):
            function(thing)


# Changes are noticed


@pytest.fixture(params=["system", "prepared"])
def through(request):
    """Runs a system over and over, as it is or prepared once."""
    kept = {}

    def run(system, *args, **options):
        if request.param == "prepared":
            system = kept.setdefault(id(system), prepare(system))
        return simulate(system, T, *args, **{**TIGHT, **options})

    return run


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_parameters_of_a_block(method, through):
    system = decay()
    for k in (1.0, 2.0, 5.0, 1.0):
        system.params["k"] = k
        found = through(system, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - decayed(k)).max() <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_parameters_of_an_interconnection(method, through):
    wire = ct.ss([], [], [], [[1.0]], inputs="y", outputs="z", name="wire", dt=None)
    loop = ct.interconnect([decay(), wire], inputs=0, outputs="z", params={"k": 3.0})
    for k in (3.0, 4.0, 0.5):
        loop.params["k"] = k
        found = through(loop, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - decayed(k)).max() <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_parameter_that_is_changed_inside_of_an_array(method, through):
    system = ct.nlsys(
        lambda t, x, u, p: -p["k"][1] * x**3,
        None,
        inputs=0,
        outputs="y",
        states=1,
        params={"k": np.array([0.0, 1.0])},
        name="array",
    )
    for k in (1.0, 6.0):
        system.params["k"][1] = k
        found = through(system, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - decayed(k)).max() <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_replaced_function(method, through):
    """Dead functions leave their addresses to new ones, so often that some meet again here."""
    system = decay()
    for k in range(1, 6):
        for _ in range(40):
            system.updfcn = cubic(float(k))
        found = through(system, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - decayed(k)).max() <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_replaced_output(method, through):
    system = decay()
    for factor in (2.0, -3.0):
        system.outfcn = (lambda c: lambda t, x, u, p: c * x)(factor)
        found = through(system, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - factor * decayed(1.0)).max() <= 1e-7


@pytest.mark.parametrize("method", ["auto", "compiled", "python"])
def test_a_number_that_a_function_refers_to(method, through):
    numbers = {"k": 1.0}
    system = ct.nlsys(lambda t, x, u, p: -numbers["k"] * x**3, None, inputs=0, outputs="y", states=1, name="referring")
    for k in (1.0, 4.0):
        numbers["k"] = k
        found = through(system, None, 1.0, method=method)
        assert np.abs(found.outputs.ravel() - decayed(k)).max() <= 1e-8


def lag_loop():
    """x' = -x + u with u = r - y behind a wire."""
    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", name="plant")
    error = ct.ss([], [], [], [[1.0, -1.0]], inputs=["r", "y"], outputs="u", name="error", dt=None)
    return ct.interconnect([plant, error], inputs="r", outputs="y", name="loop"), plant


@pytest.mark.parametrize("method", ["exact", "compiled", "python"])
def test_a_matrix_changed_in_place(method, through):
    loop, plant = lag_loop()
    for a in (-1.0, -3.0, 0.5):
        plant.A[0, 0] = a
        found = through(loop, 1.0, method=method)
        assert np.abs(found.outputs - np.expm1((a - 1) * T) / (a - 1)).max() <= 1e-8


@pytest.mark.parametrize("method", ["exact", "compiled", "python"])
def test_a_matrix_of_the_system_itself(method, through):
    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    for b in (1.0, 2.5):
        plant.B[0, 0] = b
        assert np.abs(through(plant, 1.0, method=method).outputs + b * np.expm1(-T)).max() <= 1e-8


@pytest.mark.parametrize("form", [lambda system: system, prepare], ids=["system", "prepared"])
def test_a_transfer_function_changed_in_place(form):
    system = ct.tf([1.0], [1.0, 1.0])
    runs = form(system)
    for gain in (1.0, 4.0):
        system.num[0][0][-1] = gain
        assert np.abs(simulate(runs, T, 1.0).outputs + gain * np.expm1(-T)).max() <= 1e-8


@pytest.mark.parametrize("method", ["compiled", "python"])
@pytest.mark.parametrize("how", ["set", "in place"])
def test_maps_of_an_interconnection(how, method, through):
    """x' = -x + c x + r, y = x^3: the wire back has the gain c."""
    plant = ct.nlsys(lambda t, x, u, p: -x + u, lambda t, x, u, p: x, inputs="u", outputs="y", states=1, name="plant")
    loop = ct.interconnect(
        [plant], connections=[["plant.u", "plant.y"]], inplist=["plant.u"], inputs="r", outlist=["plant.y"], outputs="y"
    )
    for c in (1.0, -2.0, 0.5):
        if how == "set":
            loop.set_connect_map(np.array([[c]]))
        else:
            loop.connect_map[0, 0] = c
        exact = T if c == 1.0 else np.expm1((c - 1) * T) / (c - 1)
        assert np.abs(through(loop, 1.0, method=method).outputs - exact).max() <= 1e-8
    loop.set_input_map(np.array([[2.0]]))
    assert np.abs(through(loop, 1.0, method=method).outputs - 2 * exact).max() <= 1e-8
    loop.set_output_map(np.array([[-1.0]]))
    assert np.abs(through(loop, 1.0, method=method).outputs + 2 * exact).max() <= 1e-8


def test_a_replaced_plan_and_a_replaced_delay(through):
    source = cp.create_source_iosystem(PLAN)
    late = cp.create_delay_iosystem(0.25, inputs="r", outputs="y")
    loop = ct.interconnect([source, late], inputs=0, outputs="y")
    assert np.abs(through(loop).outputs.ravel() - PLAN.shift(0.25)(T)).max() <= 1e-9
    cp.declare(late, delay=0.5)
    assert np.abs(through(loop).outputs.ravel() - PLAN.shift(0.5)(T)).max() <= 1e-9
    source.plan = -2.0 * PLAN
    assert np.abs(through(loop).outputs.ravel() + 2 * PLAN.shift(0.5)(T)).max() <= 1e-9
    late.initial = np.array([7.0])
    assert np.abs(through(loop).outputs.ravel()[0] - 7.0) <= 1e-12


def test_the_block_inside_of_a_sampled_one(through):
    inner = ct.ss([], [], [], [[2.0]], inputs="r", outputs="y", name="inner", dt=None)
    system = cp.sample_hold(inner, 0.5)
    assert through(system, 1.0).outputs.tolist() == [2.0] * T.size
    inner.D[0, 0] = 3.0
    assert through(system, 1.0).outputs.tolist() == [3.0] * T.size
    system.offset = 0.5
    assert through(system, 1.0).outputs.tolist() == [0.0] * 2 + [3.0] * (T.size - 2)


def test_labels_that_are_changed(through):
    system = decay()
    through(system, None, 1.0)
    system.set_outputs(["renamed"])
    assert list(through(system, None, 1.0).output_labels) == ["renamed"]


@pytest.mark.slow
def test_the_forms_that_are_kept_do_not_grow_without_bound():
    systems = [decay(k) for k in np.linspace(1.0, 2.0, 40)]
    for system in systems:
        simulate(system, T[:2], None, 1.0)
    assert len(prepared_module._FORMS) <= prepared_module._CACHE_SIZE
    changed = decay()
    for k in np.linspace(1.0, 2.0, 40):
        changed.params["k"] = k
        simulate(changed, T[:2], None, 1.0)
    assert len(prepared_module._FORMS) <= prepared_module._CACHE_SIZE
    ready = prepare(planned_loop())
    for k in range(20):
        with pytest.warns(UserWarning, match=f"params 'p{k}' is read by no block"):
            simulate(ready, T[:2], 1.0, params={f"p{k}": 1.0})
    assert len(ready._built_forms.forms) <= 8
    form = ready._built_forms.forms[-1].form
    for n in range(2, 150):
        with pytest.warns(UserWarning, match="params 'p19' is read by no block"):
            simulate(ready, np.linspace(0.0, 1.0 + 0.01 * n, n), 1.0, params={"p19": 1.0})
    assert max(len(kept) for kept in (form._integrators, form._maps)) <= 64


# Other processes


def sent(ready):
    return pickle.loads(pickle.dumps(ready))


def test_a_linear_form_goes_to_another_process_and_back():
    plan = cp.create_source_iosystem(PLAN)
    loop = ct.interconnect([plan, cp.plants.integrator_lag_loop(5.0)], inputs=0, outputs=["y"])
    ready = prepare(loop)
    here, there = simulate(ready, T), simulate(sent(ready), T)
    assert there.method == "exact"
    assert np.array_equal(here.outputs, there.outputs)
    assert there.sysname == here.sysname


def test_a_linear_form_with_samples_after_a_run_with_them():
    ready = prepare(cp.plants.integrator_lag_loop(5.0))
    here = simulate(ready, T, np.sin(T))
    there = simulate(sent(ready), T, np.sin(T))
    assert here.method == there.method
    assert np.array_equal(here.outputs, there.outputs)
    peer = ct.forced_response(cp.plants.integrator_lag_loop(5.0), T, np.sin(T))
    assert np.abs(there.outputs - peer.outputs).max() <= 1e-7


@pytest.mark.parametrize("options", [{}, {"method": "compiled"}, {"params": {"w": 2.0}}], ids=str)
def test_a_compiled_form_goes_to_another_process_and_back(options):
    ready = prepare(planned_loop())
    here = simulate(ready, T, PLAN, 0.2, **options)
    arrived = sent(sent(ready))
    there = simulate(arrived, T, PLAN, 0.2, **options)
    assert there.method == "compiled"
    assert np.array_equal(here.outputs, there.outputs)
    other = np.linspace(0.0, 3.0, 17)
    assert np.array_equal(
        simulate(ready, other, 1.0, **options).outputs, simulate(arrived, other, 1.0, **options).outputs
    )


def test_other_values_of_the_parameters_in_another_process():
    ready = prepare(planned_loop())
    simulate(ready, T, PLAN, params={"w": 2.0})
    arrived = sent(ready)
    for w in (1.0, 4.0):
        here, there = (simulate(one, T, PLAN, params={"w": w}) for one in (ready, arrived))
        assert np.array_equal(here.outputs, there.outputs)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"params": {"w": 3.0}}, "without its blocks|came from another process"),
        ({"method": "python"}, "without its blocks|came from another process"),
    ],
    ids=str,
)
def test_what_a_form_without_its_blocks_cannot_do(options, match):
    """No wrong numbers: parameters that it was not compiled for are rejected."""
    ready = prepare(planned_loop())
    simulate(ready, T, PLAN)
    with pytest.raises(ValueError, match=match):
        simulate(sent(ready), T, PLAN, **options)


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_a_linear_form_without_its_blocks_is_not_run_by_equations(method):
    with pytest.raises(ValueError, match=r"without its blocks|came from another process"):
        simulate(sent(prepare(cp.plants.integrator_lag_loop(5.0))), T, PLAN, method=method)


def saturated():
    """y' = -y + u, u = 2 (r - y) within 0.5."""
    law = ct.ss([], [], [], [[2.0, -2.0]], inputs=["r", "y"], outputs="u_cmd", name="law", dt=None)
    lag = ct.ss(-1.0, 1.0, 1.0, 0.0, inputs="u", outputs="y", name="lag")
    blocks = [law, cp.create_saturation_iosystem(-0.5, 0.5), lag]
    return ct.interconnect(blocks, inputs="r", outputs=["y", "u"])


def test_events_in_another_process():
    ready = prepare(saturated())
    events = [Event("y", high=0.2), Event("y", high=0.35, stop=True)]
    # y = (1 - exp(-t))/2 while the limit acts: to y = 0.35 at least.
    here, there = (simulate(one, T, 0.7, events=events) for one in (ready, sent_after(ready)))
    for found in (here, there):
        mine = [o for o in found.events if o.name == "y"]
        assert np.abs([o.time - t for o, t in zip(mine, (-math.log(0.6), -math.log(0.3)), strict=True)]).max() <= 1e-7
        assert abs(found.outputs[0, -1] - 0.35) <= 1e-7


def test_declared_events_in_another_process():
    ready = prepare(saturated())
    here, there = (simulate(one, T, 1.0) for one in (ready, sent_after(ready)))
    assert [(o.name, o.kind) for o in here.events] == [("u", "above")]
    assert there.events == here.events


def test_breakpoints_that_blocks_declare_in_another_process():
    def rate(t, x, u, p):
        return np.array([-x[0] + 50.0 * (t > 90.0) * (t < 90.1)])

    system = ct.nlsys(rate, None, inputs=0, outputs="y", states=1, name="bump")
    cp.declare(system, breakpoints=(90.0, 90.1))
    times = np.array([0.0, 89.0, 91.0])
    exact = 50.0 * (np.exp(90.1 - 91.0) - np.exp(90.0 - 91.0))
    ready = prepare(system)
    simulate(ready, times, method="compiled")
    for one in (ready, sent(ready)):
        assert abs(simulate(one, times).outputs.ravel()[-1] - exact) <= 1e-6


def sent_after(ready):
    simulate(ready, T, 1.0)
    return sent(ready)


def ends(ready, level):
    return simulate(ready, T, level).outputs[-1]


@pytest.mark.slow
def test_a_pool_of_processes():
    forms = [prepare(planned_loop()), prepare(ct.ss(-1.0, 1.0, 1.0, 0.0))]
    expected = [[ends(ready, level) for level in (1.0, 2.0)] for ready in forms]
    exact = -math.expm1(-2.0)
    assert np.abs(np.array(expected) - [[exact**3, 8 * exact**3], [exact, 2 * exact]]).max() <= 1e-7
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = [
            list(pool.map(simulated_in_another_process, *zip(*((ready, level) for level in (1.0, 2.0)), strict=True)))
            for ready in forms
        ]
    assert found == expected


def simulated_in_another_process(ready, level):
    return float(simulate(ready, T, level).outputs[-1])


def if_on_a_state():
    return ct.nlsys(
        lambda t, x, u, p: -x if x[0] > 0.5 else -2 * x, None, inputs=0, outputs="y", states=1, name="branching"
    )


@pytest.mark.parametrize(
    ("system", "run"),
    [
        (planned_loop(), False),
        (if_on_a_state(), True),
        (cp.create_delay_iosystem(0.5), True),
        (cp.sample_hold(ct.ss([], [], [], [[1.0]], name="held", dt=None), 0.5), True),
    ],
    ids=["not compiled yet", "not traceable", "delay", "sampled"],
)
def test_what_cannot_be_sent_says_why(system, run):
    ready = prepare(system)
    if run:
        simulate(ready, T, None if system.ninputs == 0 else 1.0, 1.0)
    with pytest.raises(TypeError, match=rf"{system.name} must be linear or compiled, without delays and samples"):
        pickle.dumps(ready)


# What only python-control runs


class Halved(ct.NonlinearIOSystem):
    """Rates of its own: half of what its update says."""

    def _rhs(self, t, x, u):
        return 0.5 * super()._rhs(t, x, u)


class Doubled(ct.NonlinearIOSystem):
    """Outputs of its own."""

    def _out(self, t, x, u):
        return 2.0 * super()._out(t, x, u)


def odd(kind):
    return kind(
        lambda t, x, u, p: -p["k"] * x + u, None, inputs="u", outputs="y", states=1, params={"k": 1.0}, name="odd"
    )


@pytest.mark.parametrize("nested", [False, True], ids=["alone", "inside"])
@pytest.mark.parametrize(
    ("kind", "exact"),
    [
        (Halved, lambda k: (1 - np.exp(-k * T / 2)) / k),
        (Doubled, lambda k: 2 * (1 - np.exp(-k * T)) / k),
    ],
)
def test_a_block_with_equations_of_its_own(kind, exact, nested):
    system = odd(kind)
    if nested:
        wire = ct.ss([], [], [], [[1.0]], inputs="y", outputs="z", name="wire", dt=None)
        system = ct.interconnect([system, wire], inputs="u", outputs="z", name="around")
    for params, k in ((None, 1.0), ({"k": 3.0}, 3.0)):
        with pytest.warns(UserWarning, match=r"block odd \((Halved|Doubled)\).*control.input_output_response"):
            found = simulate(system, T, 1.0, params=params, **TIGHT)
        peer = ct.input_output_response(
            system, T, np.ones(T.size), params=params or {}, solve_ivp_method="LSODA", solve_ivp_kwargs=TIGHT
        )
        assert np.array_equal(found.outputs, peer.outputs)
        assert np.array_equal(found.states, peer.states)
        assert np.abs(found.outputs - exact(k)).max() <= 1e-8
        assert (found.method, found.events) == ("python", [])
        assert "odd" in found.reason


def test_inputs_and_states_of_a_delegated_run():
    system = odd(Halved)
    with pytest.warns(UserWarning, match="odd"):
        found = simulate(system, T, {"u": PLAN}, 2.0)
    peer = ct.input_output_response(
        system, T, PLAN(T), 2.0, solve_ivp_method="LSODA", solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-10}
    )
    assert np.array_equal(found.outputs, peer.outputs)


@pytest.mark.parametrize("method", ["exact", "compiled"])
def test_a_method_that_is_insisted_on_is_not_delegated(method):
    with pytest.raises(ValueError, match=rf'method "{method}".*odd'):
        simulate(odd(Halved), T, 1.0, method=method)


# What the docstring says


def test_each_block_is_called_once_a_step():
    calls = {"first": 0, "second": 0, "rates": 0}

    def counting(name, function):
        def called(t, x, u, p):
            calls[name] += 1
            return function(x, u)

        return called

    blocks = [
        ct.nlsys(None, counting("second", lambda x, u: np.sin(u)), inputs="a", outputs="b", name="second", dt=None),
        ct.nlsys(None, counting("first", lambda x, u: np.tanh(u)), inputs="y", outputs="a", name="first", dt=None),
        ct.nlsys(counting("rates", lambda x, u: -u), None, inputs="b", outputs="y", states=1, name="plant"),
    ]
    loop = ct.interconnect(blocks, inputs=0, outputs="y")
    ready = prepare(loop)
    simulate(ready, [0.0, 0.1], None, 1.0, method="python")
    for name in calls:
        calls[name] = 0
    simulate(ready, [0.0, 50.0], None, 1.0, method="python")
    assert calls["rates"] > 100
    # In addition to the steps, a few calls for feedthrough and for the outputs.
    assert all(0 <= calls[name] - calls["rates"] <= 50 for name in ("first", "second"))


def test_auto_takes_the_first_method_that_can_be_taken():
    assert simulate(cp.plants.integrator_lag_loop(5.0), T, PLAN).method == "exact"
    assert simulate(planned_loop(), T, PLAN).method == "compiled"
    assert simulate(if_on_a_state(), T, None, 1.0).method == "python"
    for method, system, inputs in (
        ("exact", planned_loop(), PLAN),
        ("compiled", if_on_a_state(), None),
    ):
        with pytest.raises(ValueError, match=rf'method "{method}"'):
            simulate(system, T, inputs, 1.0, method=method)
    for method in ("exact", "compiled", "python"):
        assert simulate(cp.plants.integrator_lag_loop(5.0), T, PLAN, method=method).method == method


@pytest.mark.parametrize("method", ["compiled", "python"])
def test_tolerances_are_those_of_the_solver(method):
    loop = decay()
    errors = [
        np.abs(
            simulate(loop, T, None, 3.0, method=method, rtol=rtol, atol=rtol / 100).outputs - decayed(1.0, 3.0)
        ).max()
        for rtol in (1e-4, 1e-7, 1e-10)
    ]
    assert all(error <= 30 * rtol for error, rtol in zip(errors, (1e-4, 1e-7, 1e-10), strict=True))
    assert errors[2] < 1e-3 * errors[0]


@pytest.mark.slow
def test_a_solver_that_fails_says_when():
    """x' = x^2 from 1 ends at 1 s."""
    escaping = ct.nlsys(lambda t, x, u, p: x**2, None, inputs=0, outputs="y", states=1, name="escaping")
    for method in ("auto", "compiled", "python"):
        with np.errstate(all="ignore"), pytest.raises(RuntimeError, match=r"must reach 2 s.* s"):
            simulate(escaping, [0.0, 2.0], None, 1.0, method=method)


def ending():
    """x' = -sqrt(x) - 0.1 from 1 passes 0 after the integral of dx/(sqrt(x) + 0.1), 2 - 0.2 ln 11 = 1.52 s."""
    return ct.nlsys(lambda t, x, u, p: -np.sqrt(x) - 0.1, None, inputs=0, outputs="y", states=1, name="ending")


@pytest.mark.parametrize("method", ["auto", "compiled", "python"])
def test_equations_that_are_not_defined_beyond_an_instant(method):
    """Nothing may be output for what is not there."""
    with np.errstate(all="ignore"), pytest.raises(RuntimeError, match="must reach 3 s"):
        simulate(ending(), [0.0, 1.0, 3.0], None, 1.0, method=method)


def test_the_instant_beyond_which_equations_are_not_defined():
    with np.errstate(all="ignore"), pytest.raises(RuntimeError, match=r"got to 1\.5\d* s"):
        simulate(ending(), [0.0, 1.0, 3.0], None, 1.0, method="python")


@pytest.mark.parametrize("method", ["auto", "python"])
@pytest.mark.parametrize("where", ["rates", "outputs"])
def test_a_wrong_number_of_values(where, method):
    def two(t, x, u, p):
        return np.array([x[0], 0.0])

    def one(t, x, u, p):
        return -x

    functions = (two, one) if where == "rates" else (one, two)
    system = ct.nlsys(*functions, inputs=0, outputs="y", states=1, name="miscounted")
    with pytest.raises((ValueError, TypeError), match="miscounted"):
        simulate(system, T, None, 1.0, method=method)
