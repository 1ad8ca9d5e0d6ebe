"""Former names work for one release, say what to write instead, and mean what the new ones mean."""

import numpy as np
import pytest
from study_text import to_toml, valid

import ctrlplan as cp
from ctrlplan import reports
from ctrlplan.cli import main
from ctrlplan.reports import verdicts
from ctrlplan.studies.files import StudyError, load_study

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
TIMES = np.linspace(0.0, 12.0, 601)
PLANS = {"step": cp.Step(1.0), "planned": cp.TrigSpline(MOVE, alpha=2.0)}
LOOP = cp.plants.integrator_lag_loop(100.0, outputs=("y", "u"))


def lag():
    import control as ct

    return ct.nlsys(
        lambda t, x, u, p: [(u[0] - x[0]) / p["tau"]], None, inputs="r", outputs="y", states=1, params={"tau": 1.0}
    )


def test_only_is_measures():
    with pytest.warns(FutureWarning, match="only= of compare is deprecated .* use measures="):
        found = cp.compare(LOOP, PLANS, TIMES, only=["iae", "control_peak"])
    assert found.metrics == cp.compare(LOOP, PLANS, TIMES, measures=["iae", "control_peak"]).metrics
    with pytest.warns(FutureWarning), pytest.raises(ValueError, match=r"only must be among .*, got 'no'"):
        cp.compare(LOOP, PLANS, TIMES, only=["no"])
    with pytest.warns(FutureWarning), pytest.raises(TypeError, match="got the string 'iae'"):
        cp.compare(LOOP, PLANS, TIMES, only="iae")


def test_measure_is_a_measure_of_runs():
    def last(plan, response):
        return {"last": response.time[-1]}

    with pytest.warns(FutureWarning, match="measure= of compare .* whose function is given a run"):
        found = cp.compare(LOOP, PLANS, TIMES, measure=last, measures={"last": cp.Measure("Last", "s")})
    assert found.metrics["step"]["last"] == TIMES[-1]
    assert found.measures["last"].title == "Last"
    with pytest.warns(FutureWarning):
        found = cp.compare(LOOP, PLANS, TIMES, measure=last, only=["iae"])
    assert list(found.metrics["step"]) == ["last", "iae"]
    for wrong in (lambda plan, response: 1.0, 3):
        with pytest.warns(FutureWarning), pytest.raises(TypeError, match="measure must"):
            cp.compare(LOOP, PLANS, TIMES, measure=wrong)


@pytest.mark.slow
def test_worth_is_the_benefit():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("settling_time",)}
    with pytest.warns(FutureWarning, match=r"worth= of compare .* use benefit\(comparison, loop\)"):
        found = cp.compare(LOOP, PLANS, TIMES, waypoints=MOVE, worth=few)
    compared = cp.compare(LOOP, PLANS, TIMES, waypoints=MOVE)
    new = cp.benefit(compared, LOOP, alphas=[1.0], durations=[1.0])
    assert found.benefit.alpha == new.alpha == 2.0
    assert found.benefit.comparison.metrics == new.comparison.metrics
    assert [one.name for one in found.benefit.required_durations] == [one.name for one in new.required_durations]
    with pytest.warns(FutureWarning, match="use Comparison.benefit"):
        assert found.worth is found.benefit
    with pytest.warns(FutureWarning):
        assert cp.compare(LOOP, PLANS, TIMES, worth=False).benefit is None


@pytest.mark.slow
def test_worth_takes_its_choices_and_options_as_it_did():
    few = {"alphas": (1.0,), "factors": (1.0,), "decisive": ("half",)}
    with pytest.warns(FutureWarning):
        found = cp.compare(
            LOOP,
            PLANS,
            TIMES,
            waypoints=MOVE,
            only=["iae"],
            measures={"half": cp.Measure("Half", "m")},
            measure=lambda plan, response: {"half": 0.0},
            worth=few | {"measure": lambda plan, response, last: {"half": 0.5 * last}, "band": 0.1, "title": "Own"},
        )
    assert found.metrics["step"] == {"half": 0.0, "iae": found.metrics["step"]["iae"]}
    inner = found.benefit.comparison
    assert inner.title == "Own"
    assert inner.parameters["settling band"] == "10 %"
    assert inner.metrics["trigonometric"]["half"] == 0.5
    assert [grid.title for grid in found.benefit.grids] == ["Half"]


@pytest.mark.parametrize(("worth", "kind"), [(3, TypeError), (None, TypeError), (True, ValueError)])
def test_worth_that_cannot_be_asked(worth, kind):
    with pytest.warns(FutureWarning), pytest.raises(kind, match=r"worth (must be|needs waypoints)"):
        cp.compare(LOOP, {"step": cp.Step(1.0)}, TIMES, worth=worth)


@pytest.mark.slow
def test_sweep_with_params_is_monte_carlo():
    table = {"tau": [0.5, 1.0, 2.0]}
    with pytest.warns(FutureWarning, match=r"sweep with params= .* use monte_carlo\(loop, draws, plans, timepts\)"):
        found = cp.sweep(lag(), plans=PLANS, timepts=TIMES, params=table, progress=False, measures=["iae"])
    new = cp.monte_carlo(lag(), table, PLANS, TIMES, progress=False, measures=["iae"])
    assert isinstance(found, cp.Ensemble)
    with pytest.warns(FutureWarning):
        titled = cp.sweep(lag(), plans=PLANS, timepts=TIMES, params=table, progress=False, title="Lag", only=["iae"])
    assert titled.nominal.title == "Lag"
    assert list(titled.metrics["step"]) == ["iae"]
    for plan, rows in new.metrics.items():
        np.testing.assert_array_equal(found.metrics[plan]["iae"], rows["iae"])
    with pytest.warns(FutureWarning):
        found = cp.sweep(lag(), None, MOVE, TIMES, params={"tau": [1.0]}, progress=False, worth={"alphas": [1.0]})
    assert found.nominal.benefit.comparison.metrics["step"]["iae"] == pytest.approx(1.0, rel=1e-4)


@pytest.mark.slow
def test_sweep_takes_its_arguments_as_it_did(capsys):
    new = cp.sweep(cp.plants.integrator_lag_loop, [1.0, 5.0], PLANS, TIMES, progress=False, measures=["iae"])
    with pytest.warns(FutureWarning, match="executor= and progress="):
        found = cp.sweep(cp.plants.integrator_lag_loop, [1.0, 5.0], PLANS, TIMES, None, False, measures=["iae"])
    assert capsys.readouterr().err == ""
    np.testing.assert_array_equal(found.metrics["planned"]["iae"], new.metrics["planned"]["iae"])
    with pytest.warns(FutureWarning, match="alpha= of sweep .*standard_plans"):
        found = cp.sweep(cp.plants.integrator_lag_loop, [1.0, 5.0], MOVE, TIMES, progress=False, alpha=2.0)
    np.testing.assert_allclose(found.metrics["trigonometric"]["iae"], new.metrics["planned"]["iae"], rtol=1e-12)
    assert "reference_jerk" in found.metrics["polynomial"]
    with pytest.warns(FutureWarning, match="title= of sweep"):
        cp.sweep(cp.plants.integrator_lag_loop, [1.0], PLANS, TIMES, progress=False, title="No effect")


def test_arguments_of_a_sweep_are_given_once():
    with pytest.raises(TypeError, match=r"sweep\(\) got multiple values for argument 'plans'"):
        cp.sweep(cp.plants.integrator_lag_loop, [1.0], PLANS, TIMES, plans=PLANS)
    with pytest.raises(TypeError, match="unexpected keyword argument 'bandwidth'"):
        cp.sweep(cp.plants.integrator_lag_loop, [1.0], PLANS, TIMES, bandwidth=0.1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'bandwidth'"):
        cp.compare(LOOP, PLANS, TIMES, bandwidth=0.1)


def test_the_notice_names_the_line_that_calls():
    with pytest.warns(FutureWarning) as said:
        cp.compare(LOOP, PLANS, TIMES, only=["iae"])
    assert [one.filename for one in said] == [__file__]


def test_a_study_file_may_say_worth(tmp_path, capsys):
    path = tmp_path / "study.toml"
    path.write_text(to_toml(valid(worth=True)))
    with pytest.warns(FutureWarning, match="study.toml: worth = is deprecated .*; use benefit ="):
        assert load_study(path).benefit
    assert main(["plan", str(path), "--out", str(tmp_path / "plan.csv")]) == 0
    first = capsys.readouterr().err.splitlines()[0]
    assert first == f"ctrlplan: {path}: worth = is deprecated and will be removed in the next release; use benefit ="
    path.write_text(to_toml(valid(worth=1)))
    with pytest.raises(StudyError, match="worth: must be true or false, got 1"):
        load_study(path)


@pytest.mark.slow
def test_former_attributes_of_a_benefit_and_a_verdict_warn():
    found = cp.benefit(cp.compare(LOOP, MOVE, TIMES), LOOP, alphas=(1.0,), durations=(1.0,))
    grid, verdict = found.grids[0], verdicts(found.comparison)[0]
    renamed = [
        (found, "needs", "required_durations"),
        (grid, "rivals", "baselines"),
        (grid, "beside", "not_ranked"),
        (verdict, "winners", "best"),
        (verdict, "losers", "worst"),
        (verdict, "least", "minimum"),
        (verdict, "greatest", "maximum"),
    ]
    for value, old, new in renamed:
        kind = type(value).__name__
        with pytest.warns(FutureWarning, match=rf"{kind}\.{old} is deprecated.*use {kind}\.{new}"):
            assert getattr(value, old) is getattr(value, new)


def test_the_figure_of_baselines_has_a_former_name():
    with pytest.warns(FutureWarning, match="plot_rivals is deprecated.*use ctrlplan.reports.plot_baselines"):
        assert reports.plot_rivals is reports.plot_baselines
