"""A plan whose run fails is recorded with its reason, and the others are kept."""

import json
import os
import re

import control as ct
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.cli import main
from ctrlplan.reports import render_page
from ctrlplan.studies import Study

TIMES = np.linspace(0.0, 3.0, 301)
PLANS = {"far": cp.Step(2.0), "near": cp.Step(0.5), "planned": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 0.5)])}


def tangent():
    """Loop x' = r^2 + x^2, x(0) = 0: x = r tan(r t) for a constant r, which has no value at t = pi/(2 r)."""
    return ct.nlsys(
        lambda t, x, u, params: [u[0] ** 2 + x[0] ** 2], None, inputs=["r"], outputs=["y"], states=["y"], name="tangent"
    )


@pytest.fixture(scope="module")
def compared():
    return cp.compare(tangent(), PLANS, TIMES, initial_state=[0.0])


def test_the_others_are_kept_as_they_are_alone(compared):
    assert list(compared.failures) == ["far"]
    assert list(compared.plans) == list(compared.responses) == list(compared.metrics) == ["near", "planned"]
    # near: x = 0.5 tan(t / 2), finite over the run, which ends before pi.
    np.testing.assert_allclose(np.ravel(compared.responses["near"].outputs), 0.5 * np.tan(0.5 * TIMES), rtol=1e-5)
    alone = cp.compare(tangent(), {"near": PLANS["near"]}, TIMES, initial_state=[0.0])
    assert compared.metrics["near"] == alone.metrics["near"]


def test_the_reason_is_what_the_run_raised(compared):
    with pytest.raises(RuntimeError) as alone:
        cp.compare(tangent(), {"far": PLANS["far"]}, TIMES, initial_state=[0.0])
    assert compared.failures["far"] == str(alone.value)
    assert any(compared.failures["far"] in note and "far" in note for note in compared.notes)
    assert "far failed" in repr(compared)


def headline_of(page):
    """Headline of the first study of a page, above all folds."""
    (line,) = re.findall(r'<p class="headline">(.*?)</p>', page)
    assert page.index(line) < page.index("<details>")
    return line


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_the_headline_names_it(compared):
    assert "Failed, without values: far." in headline_of(render_page([Study("one", "One", compared)], "Page"))


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_the_headline_names_plans_whose_runs_an_event_ended():
    """Ramps from 0 to 1 pass 0.5 at half of their duration."""
    ramps = {f"in {t:g} s": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(t, 1.0)]) for t in (1.0, 2.0)}
    low = cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 0.4)])
    passed = ct.ss([], [], [], [[1.0]], inputs=["r"], outputs=["y"], name="passed")
    found = cp.compare(passed, ramps | {"low": low}, TIMES, events=[cp.Event("y", high=0.5, stop=True)])
    said = headline_of(render_page([Study("one", "One", found)], "Page"))
    assert "With low" in said
    assert "Not ranked, because an event ended the run: in 1 s (0.5 s), in 2 s (1 s)." in said


def at_rate(rate):
    """Loop x' = r^2 + rate^2 x^2: with r = 2, x leaves every bound at t = pi/(4 rate)."""
    return ct.nlsys(
        lambda t, x, u, params: [u[0] ** 2 + rate**2 * x[0] ** 2], None, inputs=["r"], outputs=["y"], states=["y"]
    )


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_the_headline_of_a_sweep_and_of_draws_tells_how_many_failed(tmp_path):
    options = {"initial_state": [0.0], "progress": False}
    far = {"far": PLANS["far"]}
    swept = cp.sweep(at_rate, [0.01, 0.1, 1.0, 2.0], far, TIMES, parameter="rate", **options)
    said = headline_of(swept.report(tmp_path / "swept.html").read_text(encoding="utf-8"))
    assert said.endswith("Failed, without values: 2 of 4, first at 1.")
    drawn = cp.monte_carlo(at_rate, {"rate": [0.01, 1.0, 2.0, 0.1]}, far, TIMES, **options)
    said = headline_of(drawn.report(tmp_path / "drawn.html").read_text(encoding="utf-8"))
    assert said.endswith("Of 4 draws, 2 failed.")


def test_results_name_it_beside_the_plans(compared, tmp_path):
    assert list(compared.results()["plans"]) == ["near", "planned"]
    assert compared.results()["failures"] == compared.failures
    compared.save(tmp_path / "found.json")
    data = json.loads((tmp_path / "found.json").read_text())
    assert data["failures"] == compared.failures
    assert set(data["plans"]) == {"near", "planned"}


def test_without_failures_results_are_as_before():
    found = cp.compare(cp.plants.integrator_lag_loop(5.0), PLANS, TIMES)
    assert found.failures == {}
    assert set(found.results()) == {"plans"}


def builder(error):
    """Loops of which that of one plan cannot be built."""

    def build(name, plan):
        if name == "near":
            raise error
        return ct.interconnect(
            [cp.create_source_iosystem(plan), ct.tf([1.0], [1.0, 1.0], inputs="y", outputs="out", name="lag")],
            inputs=0,
            outputs=["out"],
        )

    return build


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("gain must be\nabove 0, got -1"), "gain must be above 0, got -1"),
        (KeyError("mass"), "KeyError: 'mass'"),
        (ZeroDivisionError(), "ZeroDivisionError"),
        (MemoryError(), "MemoryError"),
        (RecursionError("too deep"), "too deep"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_whatever_a_builder_raises_is_the_reason_in_one_line(error, told):
    found = cp.compare(builder(error), PLANS, TIMES, outputs=["out"])
    assert found.failures == {"near": told}
    assert list(found.metrics) == ["far", "planned"]


def test_what_a_measure_raises_of_one_plan_is_its_reason():
    def measure(run):
        return 1.0 / (run.plan.final[0] - 2.0) if run.plan.final[0] == 0.5 else [][0]

    ratio = cp.Measure("Ratio", of="run", function=measure)
    found = cp.compare(cp.plants.integrator_lag_loop(5.0), PLANS, TIMES, measures={"ratio": ratio})
    assert list(found.failures) == ["far"]
    assert found.failures["far"].startswith("IndexError")
    assert set(found.responses) == set(found.metrics) == {"near", "planned"}


def test_an_error_that_meets_all_plans_is_raised():
    def build(name, plan):
        raise LookupError(name)

    with pytest.raises(LookupError, match="far"):
        cp.compare(build, PLANS, TIMES)
    with pytest.raises(ValueError, match="outputs"):
        cp.compare(cp.plants.integrator_lag_loop(5.0), PLANS, TIMES, outputs=["speed"])


@pytest.mark.parametrize("ended", [KeyboardInterrupt, SystemExit])
def test_an_interruption_reaches_the_caller(ended):
    with pytest.raises(ended):
        cp.compare(builder(ended()), PLANS, TIMES, outputs=["out"])


@pytest.mark.slow
def test_a_value_of_a_sweep_at_which_a_plan_fails_is_a_failure_of_the_sweep():
    def build(rate):
        return ct.nlsys(
            lambda t, x, u, params: [u[0] ** 2 + rate * x[0] ** 2], None, inputs=["r"], outputs=["y"], states=["y"]
        )

    some = {name: PLANS[name] for name in ("far", "near")}
    found = cp.sweep(build, [1e-3, 1.0], some, TIMES, progress=False, parameter="rate", initial_state=[0.0])
    (failure,) = found.failures
    assert failure.params == {"rate": 1.0}
    assert "far" in failure.message


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_a_crane_that_cannot_follow_some_plans_is_reported_with_the_others(tmp_path, capsys):
    """Ten metres in 3.5 s with 2 kN and feedback of the load: the rope goes slack with every smooth plan."""
    places = "".join(
        f"[[waypoints]]\ntime = {t}\nx = [{x}, 0.0, 0.0]\nz = [9.0, 0.0, 0.0]\n" for t, x in ((0.0, 0.0), (3.5, 10.0))
    )
    loop = '[loop]\nkind = "crane"\nlaw = "load_feedback"\nforce_limits = [-2000.0, 2000.0]\n'
    (tmp_path / "hasty.toml").write_text(f"t_end = 40.0\nsamples = 401\n{loop}{places}")
    assert main(["report", str(tmp_path / "hasty.toml"), "--out", str(tmp_path / "out")]) == 0
    (found,) = json.loads((tmp_path / "out" / "results.json").read_text())["studies"].values()
    assert list(found["plans"]) == ["step", "polynomial", "trigonometric", "piecewise"]
    assert "failures" not in found
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    for plan in ("polynomial", "trigonometric", "piecewise"):
        (said,) = re.findall(rf"† {plan}: an event ended the run \((.*?)\); (.*?);", page)
        assert said == (said[0], "metrics cover the time before it and are not ranked")
        assert "rope tension below its limit, where the run ends" in said[0]
    assert capsys.readouterr().err.splitlines() == [
        "ctrlplan: running study hasty (4 plans)",
        "ctrlplan: writing the report",
    ]


def test_what_ends_a_save_leaves_the_file_of_before(compared, tmp_path, monkeypatch):
    path = tmp_path / "found.json"
    compared.save(path)
    before = path.read_text()

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        compared.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["found.json"]
    assert path.read_text() == before
