"""Studies of what is done on line: their metrics by hand, and what they claim."""

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies import ONLINE
from ctrlplan.studies import crane_governor as governor
from ctrlplan.studies import online as studies
from ctrlplan.studies.verdicts import verdicts

WAYS = ["off-line", "load feedback", "replanned", "governed", "slowed"]


def response(t, **signals):
    rows = {"x": 0.0, "z": 0.0, "x_ref": 0.0, "z_ref": 0.0, "theta": 0.0, "F": 0.0} | signals
    outputs = np.array([np.broadcast_to(row, t.shape) for row in rows.values()])
    return ct.TimeResponseData(t, outputs, output_labels=list(rows), issiso=False)


def test_metrics_of_a_response_known_in_closed_form():
    t = np.linspace(0.0, 40.0, 40001)
    fall = np.exp(-0.5 * t)
    found = studies.online_metrics(
        np.array([20.0, 11.0]),
        100.0,
        response(
            t,
            x=20.0 - 20.0 * fall + 0.3 * t * np.exp(1.0 - t),
            z=11.0,
            x_ref=20.0 - 20.0 * fall,
            z_ref=11.0,
            theta=0.2 * np.cos(t),
            F=np.clip(150.0 * np.sin(2.0 * np.pi * t / 40.0), -100.0, 100.0),
        ),
    )
    assert found["arrival"] == pytest.approx(2.0 * np.log(200.0), rel=2e-3)  # the bump is 1e-3 by then
    assert found["error_end"] == 0.0  # 5e-7 m: less than a run knows
    assert found["error_reference"] == pytest.approx(0.3, rel=1e-6)
    assert found["sway_peak"] == pytest.approx(0.2, rel=1e-6)
    assert found["sway_end"] == pytest.approx(0.2, rel=1e-6)  # cos(t) is -1 at 37.7
    assert found["force_peak"] == 100.0
    outside = 40.0 * (1.0 - 2.0 * np.arcsin(2.0 / 3.0) / np.pi)
    assert found["limited_time"] == pytest.approx(outside, abs=2e-3)
    assert set(found) == set(studies.ONLINE_MEASURES)


def test_a_load_that_goes_past_its_goal_and_stays_away():
    t = np.linspace(0.0, 40.0, 4001)
    found = studies.online_metrics(np.array([20.0, 11.0]), 1e3, response(t, x=20.0 + 1.5 * np.sin(t) ** 2, z=11.0))
    assert found["arrival"] == np.inf
    assert found["overshoot_goal"] == pytest.approx(1.5, rel=1e-6)
    assert found["error_end"] == pytest.approx(1.5, rel=1e-6)


def test_the_move_asks_for_the_force_of_the_flat_map():
    plan = studies._move()
    forces = studies.CRANE.quantities(plan.jet(np.linspace(0.0, 15.0, 30001), 4))["F"]
    assert studies._peak_force() == pytest.approx(np.abs(forces).max(), rel=1e-6)
    retimed = [
        np.abs(studies.CRANE.quantities(plan.retime(t).jet(np.linspace(0.0, t, 30001), 4))["F"]) for t in (21.6, 21.5)
    ]
    assert retimed[0].max() < 2e3 < retimed[1].max()


@pytest.mark.slow
def test_the_governors_model_is_the_crane_in_small_motion():
    """Rows of the set hold for the nonlinear loop: from rest, its own largest step keeps nine tenths of the limit."""
    found = governor.admissible_set(4e3)
    rest = np.array(governor.filtered_loop().initial_state)
    labels = governor.filtered_loop().state_labels
    x = rest[[labels.index(label) for label in found.states]]
    kappa = found.fraction(x, [0.0], [20.0])
    assert 0.0 < kappa < 1.0
    t = np.linspace(0.0, 40.0, 2001)
    run = cp.simulate(governor.filtered_loop(), t, {"x_command": 20.0 * kappa, "z_command": 10.0})
    force = np.abs(run.outputs[run.output_labels.index("F")]).max()
    assert 0.85 * 4e3 < force < 4e3


@pytest.fixture(scope="module", params=[30e3, 2e3], ids=lambda force: f"{force:g} N")
def governed(request):
    """Undisturbed governed crane with a limit of the force."""
    force = request.param
    limits = {"force_limits": (-force, force), "torque_limits": studies.TORQUE_LIMITS}
    scenario = studies.Scenario(studies._fixed_goal(), studies._move(), force=force)
    found = cp.simulate(studies.WAYS["governed"](scenario, limits), np.linspace(0.0, 50.0, 501))
    rows = [
        next(k for k, name in enumerate(found.state_labels) if name.endswith(f"_{label}"))
        for label in governor.filtered_loop().state_labels
    ]
    return force, found, found.states[rows]


@pytest.mark.slow
def test_the_governed_crane_always_finds_an_admissible_reference(governed):
    """Nothing disturbs: the governor holds no reference, the load arrives, and the limit is satisfied."""
    force, found, _ = governed
    infeasible = [k for k, label in enumerate(found.state_labels) if label == "governor_infeasible"]
    assert found.states[infeasible].max() == 0.0
    assert not [event for event in found.events if "no admissible reference" in event.name]
    signals = dict(zip(found.output_labels, found.outputs, strict=True))
    assert np.abs(signals["F"]).max() < force
    assert np.abs(signals["theta"]).max() < governor.SWAY
    assert signals["x"][-1] == pytest.approx(20.0, abs=1e-3)
    notes, curves = governor.governor_check(found, force)
    assert notes[0].startswith("The governor finds an admissible reference at every sample.")
    np.testing.assert_array_equal(curves.rows["simulated"], signals["F"] / 1e3)


@pytest.mark.slow
def test_the_force_predicted_at_the_motion_of_the_load_is_that_of_the_simulation(governed):
    """Linearised at the true depth, or at the mean depth for the same motion; for other states it is far beyond."""
    force, found, states = governed
    loop = governor.filtered_loop()
    simulated = dict(zip(found.output_labels, found.outputs, strict=True))["F"]
    curves = governor.governor_check(found, force)[1]
    np.testing.assert_allclose(curves.rows["predicted by the linear model"], simulated / 1e3, atol=1e-3)
    at = int(np.searchsorted(found.time, 0.5))
    predicted = {}
    for depth in (10.0, governor.DEPTH):
        rest = np.array(loop.initial_state)
        rest[-6:] = studies.CRANE.equilibrium(0.0, depth)[0]
        rest[loop.state_labels.index("z_ref_filter_z_ref")] = depth
        linear = ct.linearize(loop, rest, [0.0, depth])
        predicted[depth] = (np.asarray(linear.C) @ (states[:, at] - rest))[loop.output_labels.index("F")]
    assert predicted[10.0] == pytest.approx(simulated[at], rel=0.05)
    assert predicted[governor.DEPTH] > 10.0 * simulated[at]


@pytest.mark.slow
def test_the_states_of_the_model_have_the_load_motion_of_the_crane(governed):
    """Load position and velocity of the linear crane, x = D - D(0) + R theta, and the error of its trolley."""
    _, found, states = governed
    signals = dict(zip(found.output_labels, found.outputs, strict=True))
    labels = governor.horizontal_model()[0].state_labels
    start = governor.horizontal_model()[1][labels.index("crane_D")]
    for at in range(0, found.time.size, 50):
        measured = dict(zip(governor.filtered_loop().state_labels, states[:, at].tolist(), strict=True))
        own = dict(zip(labels, governor.model_states(measured).tolist(), strict=True))
        assert own["crane_D"] - start + 10.5 * own["crane_theta"] == pytest.approx(signals["x"][at], abs=1e-9)
        assert own["crane_D_d1"] + 10.5 * own["crane_theta_d1"] == pytest.approx(signals["x_d1"][at], abs=1e-9)
        # The law by hand, w = 0.5 rad/s, zeta = 1: (15a) with the commanded x'', and linear at z = 10.5 m.
        x_ref, x_ref_d1, x_ref_d2 = (own[f"x_ref_filter_x_ref{d}"] for d in ("", "_d1", "_d2"))
        z, hanging = measured["z_ref_filter_z_ref"], 9.81 - measured["z_ref_filter_z_ref_d2"]
        across = x_ref_d2 - (signals["x_d1"][at] - x_ref_d1) - 0.25 * (signals["x"][at] - x_ref)
        reference = signals["x"][at] - (0.25 * np.hypot(across, hanging) - z * across) / hanging
        linear = signals["x"][at] - 0.25 + 10.5 / 9.81 * across
        assert linear - own["crane_D"] == pytest.approx(reference - signals["D"][at], abs=1e-7)


@pytest.fixture(scope="module")
def found():
    """The four studies."""
    return {name: study(progress=False) for name, study in ONLINE.items()}


@pytest.mark.slow
class TestWhole:
    def test_every_scenario_has_five_control_schemes(self, found):
        for study in found.values():
            assert list(study.comparison.metrics) == WAYS
            for values in study.comparison.metrics.values():
                assert set(values) == set(studies.ONLINE_MEASURES)

    def test_limits_of_the_drives_hold_in_every_run(self, found):
        for name, study in found.items():
            force = 2e3 if name == "online-saturated" else 30e3
            for response in study.comparison.responses.values():
                signals = dict(zip(response.output_labels, response.outputs, strict=True))
                assert np.abs(signals["F"]).max() <= force * (1 + 1e-9)
                assert signals["C"].min() >= -3e3 * (1 + 1e-9)
                assert signals["C"].max() <= 1e3 * (1 + 1e-9)

    def test_what_the_notes_claim(self, found):
        gust, payload, goal, saturated = (found[name].comparison.metrics for name in ONLINE)
        # Planning again is a feedback where the generator has none.
        assert gust["off-line"]["arrival"] == np.inf
        assert gust["replanned"]["arrival"] < gust["load feedback"]["arrival"]
        assert gust["replanned"]["limited_time"] > 0.0 == gust["load feedback"]["limited_time"]
        # A payload that nobody knows of costs nothing that planning could mend.
        assert payload["replanned"]["arrival"] == pytest.approx(payload["off-line"]["arrival"], rel=1e-3)
        # A moved goal is met when the plan was to end, not a move later.
        assert goal["replanned"]["arrival"] < 15.0 < goal["off-line"]["arrival"]
        assert min(goal, key=lambda way: goal[way]["arrival"]) == "replanned"
        # With too little force the ways that do nothing about it never arrive.
        assert saturated["off-line"]["arrival"] == saturated["load feedback"]["arrival"] == np.inf
        assert saturated["governed"]["limited_time"] == 0.0
        assert saturated["governed"]["overshoot_goal"] < 0.05
        assert saturated["slowed"]["overshoot_goal"] < 0.5 * saturated["load feedback"]["overshoot_goal"]

    def test_no_scheme_is_best_in_all_scenarios(self, found):
        winners = {next(v.best for v in verdicts(study.comparison) if v.key == "arrival") for study in found.values()}
        assert len(winners) > 1

    def test_the_reference_of_a_moved_goal_does_not_jump(self, found):
        run = found["online-goal"].comparison.responses["replanned"]
        x = run.outputs[run.output_labels.index("x_ref")]
        step = np.diff(run.time).max()
        fourth = np.abs(np.diff(x, 4)).max() / step**4
        # Four times differentiable: differences of order 4 stay near the derivative, a jump of order 3 would be 1/step.
        assert fourth < 2.0

    def test_a_limit_known_before_the_start_is_satisfied(self, found):
        (note,) = [
            note
            for note in found["online-saturated"].notes
            if note.startswith("A plan that takes the limit into account")
        ]
        assert "with an overshoot of 0 m." in note
