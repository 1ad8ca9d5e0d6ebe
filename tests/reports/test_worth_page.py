"""Sections of the page: is it worth it, as fast as limits allow, is the trigonometric path optimal."""

import json
import math
import re
import unicodedata
from dataclasses import replace

import numpy as np
import pytest
from drawings import drawn_texts
from linear_table import printed

import ctrlplan as cp
from ctrlplan.reports import render_page, write_report
from ctrlplan.studies import Study
from ctrlplan.studies.benefit import Benefit
from ctrlplan.studies.grids import Grid
from ctrlplan.studies.required_durations import RequiredDuration
from ctrlplan.studies.sections import ClaimTable, FastestMove

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
TIMES = np.linspace(0, 10, 501)
WORTH, FASTEST, OPTIMAL = "Benefit of planning", "Minimum duration within limits", "Is the trigonometric path optimal?"


def loop(gain):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


@pytest.fixture(scope="module")
def study():
    """All three sections, the numbers of the last made by hand."""
    compared = cp.compare(loop(100.0), MOVE, TIMES, units={"y": "m", "u": "N", "y_d1": "m/s"})
    compared = compared.with_benefit(cp.benefit(compared, loop(100.0), alphas=(0.0, 1.0, 3.0), durations=(1.0, 1.5)))
    grid = Grid(
        "Length & width",
        "m²/s⁵",
        np.array([14.0, 16.0]),
        np.array([0.0, 1.0, 2.5]),
        np.array([[3.0, 1.0, math.nan], [math.inf, 2.0, 2.001]]),
        {"minimum jerk": np.array([2.0, 2.0]), "bound": np.array([0.5, 0.5])},
        not_ranked=("bound",),
    )
    fast = cp.fastest(cp.PolySpline(MOVE), {"y_d1": 2.5, "y_d2": (-100.0, 200.0)})
    return Study("mine", "Mine", compared, sections=(FastestMove(fast), ClaimTable(("The claim <fails>.",), (grid,))))


@pytest.fixture(scope="module")
def written(study, tmp_path_factory):
    """The page and its results, as files."""
    return write_report([study], tmp_path_factory.mktemp("worth"), "Page")


@pytest.fixture(scope="module")
def html(written):
    return written[0].read_text(encoding="utf-8")


@pytest.fixture
def shown(read):
    """Words of a page with one comparison, and the page."""

    def of(comparison):
        page = read(render_page([Study("mine", "Mine", comparison, sections=())], "Page"))
        return page.words(), page

    return of


@pytest.fixture(scope="module")
def page(html, read):
    return read(html)


def heads(page):
    return [e.words() for e in page.all() if re.fullmatch("h[1-6]", e.tag)]


def rows(table):
    """Cells of the body of a table."""
    (body,) = table.all("tbody")
    return [[cell.words() for cell in row.children] for row in body.all("tr")]


def titles(table):
    (head,) = table.all("thead")
    return [th.words() for th in head.all("th")]


def tables(page, kind):
    return list(page.all("table", class_=kind))


def number(text):
    return float(unicodedata.normalize("NFKC", text.rstrip(" ▲▽").replace("·10", "e")).replace("−", "-"))


# The page


@pytest.mark.slow
def test_each_section_has_its_heading_once_and_at_one_level(page):
    assert [heads(page).count(title) for title in (FASTEST, WORTH, OPTIMAL)] == [1, 1, 1]
    levels = {e.tag for e in page.all() if e.words() in (FASTEST, WORTH, OPTIMAL, "Metrics") and e.tag[0] == "h"}
    assert len(levels) == 1


def test_sections_are_there_only_where_they_were_asked_for(shown):
    _, plain = shown(cp.compare(loop(5.0), MOVE, TIMES))
    assert not {FASTEST, WORTH, OPTIMAL} & set(heads(plain))


@pytest.mark.slow
def test_nothing_is_left_to_fill_in_and_nothing_is_undefined(html, page):
    words = page.words()
    assert not re.search(r"\{\w*\}|\{\{|\{%|\bnan\b|\bNone\b|\binf\b", words)
    assert "{u}" not in html
    for cell in [
        cell
        for kind in ("durations", "margins", "grid", "metrics", "baselines")
        for t in tables(page, kind)
        for cell in t.all("td")
    ]:
        assert cell.words() or "unit" in cell.attributes.get("class", "")


@pytest.mark.slow
def test_words_of_others_are_escaped(html):
    assert "The claim &lt;fails&gt;." in html
    assert "Length &amp; width" in html


@pytest.mark.slow
def test_without_units_there_are_no_brackets(shown, study):
    worth = replace(study.comparison.benefit, comparison=replace(study.comparison.benefit.comparison, units={}))
    words, _ = shown(replace(study.comparison, units={}, benefit=worth))
    assert "Peak control over duration and alpha:" in words
    assert "[]" not in words
    assert not re.search(r"\{\w*\}|\bnan\b", words)


# Benefit of planning


@pytest.mark.slow
def test_all_baselines_are_in_the_table_of_the_section(study, page):
    (beside,) = tables(page, "baselines")
    assert titles(beside) == ["metric", "unit", *study.comparison.benefit.comparison.plans, "worst to best"]
    expected = {"step", "trapezoid", "S-curve", "shaped step", "quintic (minimum jerk)"}
    assert expected <= set(titles(beside))
    found = {row[0]: row[2:-1] for row in rows(beside)}
    metrics = study.comparison.benefit.comparison.metrics
    for title, key in (("Settling time", "settling_time"), ("Peak control", "control_peak")):
        for text, values in zip(found[title], metrics.values(), strict=True):
            assert number(text) == pytest.approx(values[key], rel=5e-4)
    settles = [printed(100, plan)[1] for plan in ("trigonometric", "step")]
    assert [number(text) for text in found["Settling time"]][:2] == pytest.approx(settles, rel=3e-4)


def test_needs_are_shown_with_the_limit_that_is_active_and_where(study, page):
    (table,) = tables(page, "durations")
    assert titles(table) == [
        "plan",
        "minimum duration [s]",
        "active limit",
        "limits at the given duration",
    ]
    shown = rows(table)
    for (name, text, why, satisfied), one in zip(shown, study.comparison.benefit.required_durations, strict=True):
        assert (name, why, satisfied) == (one.name, one.limit, one.satisfied)
        if math.isnan(one.duration):
            assert text == "–"
        else:
            assert number(text) == pytest.approx(one.duration, rel=5e-4)
    takes = {name: text for name, text, *_ in shown}
    satisfied = {name: words for name, _, _, words in shown}
    assert satisfied["quintic (minimum jerk)"] == satisfied["S-curve"] == "satisfied"
    plan = study.comparison.benefit.comparison.plans["trigonometric"]
    beyond = np.abs(plan(np.linspace(0, 1, 20_001), 2)).max() / (10.0 / math.sqrt(3.0)) - 1.0
    assert beyond > np.abs(plan(np.linspace(0, 1, 20_001), 1)).max() / 1.875 - 1.0 > 0.0
    assert satisfied["trigonometric"] == f"y_d2 exceeded by {100 * beyond:.3g} %"
    assert takes["quintic (minimum jerk)"] == "1.000"
    assert takes["S-curve"] == "0.9543 ▲"
    winners = [row.children[0].words() for row in table.all("tr") if list(row.all("td", class_="better"))]
    assert winners == ["S-curve"]


def test_alpha_and_limits_are_said_in_words(page):
    assert "A trigonometric plan (alpha = 1 rad) is compared with" in page.words()
    limits = f"y_d1 within ±1.875; y_d2 within ±{10 / math.sqrt(3):.6g}; y_d3 within ±60"
    assert f"Minimum duration of each plan under the same limits ({limits}):" in page.words()


def test_verdicts_are_there(study, page):
    for sentence in study.comparison.benefit.verdicts:
        assert sentence in page.words()


@pytest.mark.slow
def test_limits_of_every_form_and_the_note_are_said(study, shown):
    limits = {"velocity": 3, "y_d1": (-2.0, 3.0), "y_d2": [None, 3.0], "y_d3": np.array([-2.0, 3.0])}
    words, _ = shown(
        replace(study.comparison, benefit=replace(study.comparison.benefit, limits=limits, note="Rope & drum."))
    )
    expected = "velocity within ±3; y_d1 from -2 to 3; y_d2 at most 3; y_d3 from -2 to 3"
    assert f"Minimum duration of each plan under the same limits ({expected}):" in words
    assert "Rope & drum." in words


def test_tables_over_alpha_and_duration_are_those_of_the_grids(study, page):
    shown = tables(page, "grid")
    grids = (*study.sections[1].grids, *study.comparison.benefit.grids)
    assert len(shown) == len(grids) == 3
    for table, grid in zip(shown, grids, strict=True):
        alphas = [f"alpha {a:.3g}" if a else "alpha 0 (polynomial)" for a in grid.alphas]
        assert titles(table) == ["duration [s]", *alphas, *grid.baselines]
        for row, duration, values, k in zip(rows(table), grid.durations, grid.values, range(9), strict=False):
            assert float(row[0]) == pytest.approx(duration, rel=1e-3)
            expected = [*values, *(baseline[k] for baseline in grid.baselines.values())]
            for text, value in zip(row[1:], expected, strict=True):
                if math.isfinite(value):
                    assert number(text) == pytest.approx(value, rel=5e-4)
                else:
                    assert not re.search(r"\d", text)


def test_units_are_in_the_headings_of_the_tables(page):
    for heading in ("Settling time [s]", "Peak control [N]", "Length & width [m²/s⁵]"):
        assert f"{heading} over duration and alpha:" in page.words()


def test_the_figure_of_the_baselines_names_all(html, study):
    texts = drawn_texts(html)
    names = {name for text in texts for name in text.split(" = ")}  # of curves that coincide
    for plan in study.comparison.benefit.comparison.plans:
        assert plan in names
    for label in ("reference of y [m]", "y [m]", "u [N]", "time [s]", "y_d1 [m/s]"):
        assert label in texts


# Minimum duration within limits


def test_the_active_limit_and_the_margins_of_the_others(page):
    """15/8 of 1 m at 2.5 m/s takes 0.75 s; the acceleration then comes to 10/sqrt 3/0.75^2."""
    (table,) = tables(page, "margins")
    assert "The minimum duration is 0.7500 s. The active limit is y_d1, reached at 0.3750 s." in page.words()
    assert titles(table) == ["limit", "unit", "permitted range", "value nearest to the limit", "time [s]", "margin"]
    peak = 10 / 3**0.5 / 0.75**2
    left = 100 * (100 - peak) / 150
    at = 0.75 * (0.5 + 3**0.5 / 6)
    assert rows(table) == [
        ["y_d1", "m/s", "within ±2.5", "2.500", "0.3750", "0 %"],
        ["y_d2", "", "from -100 to 200", f"−{peak:.2f}", f"{at:.4f}", f"{left:.3g} %"],
    ]


# Is the trigonometric path optimal?


def test_marks_of_wins_losses_and_ties(page):
    table = tables(page, "grid")[0]
    (body,) = table.all("tbody")
    marks = [[cell.attributes["class"] for cell in row.all("td")] for row in body.all("tr")]
    assert marks == [["worse", "better", "", "reference", ""], ["worse", "", "", "reference", ""]]
    assert rows(table) == [
        ["14", "3.000 ▽", "1.000 ▲", "–", "2.000", "0.5000"],
        ["16", "∞ ▽", "2.000", "2.001", "2.000", "0.5000"],
    ]
    symbols = [span.attributes["aria-label"] for span in table.all("span")]
    assert symbols == ["worse than the best baseline", "better than every baseline", "worse than the best baseline"]


# Odd cases


@pytest.mark.slow
def test_a_table_where_nothing_is_defined_has_a_page(study, shown):
    """Such as of settling, for a move there and back."""
    one, _ = study.comparison.benefit.grids
    baselines = dict.fromkeys(one.baselines, np.full(2, math.nan))
    bare = replace(one, values=np.full((2, 3), math.nan), baselines=baselines)
    words, page = shown(replace(study.comparison, benefit=replace(study.comparison.benefit, grids=(bare,))))
    assert not re.search(r"\bnan\b", words)
    (table,) = tables(page, "grid")
    assert {text for row in rows(table) for text in row[1:]} == {"–"}


@pytest.mark.slow
def test_limits_that_no_plan_can_keep_have_a_page(study, shown):
    required = tuple(
        RequiredDuration(one.name, math.nan, "never") for one in study.comparison.benefit.required_durations
    )
    words, page = shown(
        replace(study.comparison, benefit=replace(study.comparison.benefit, required_durations=required))
    )
    assert "No plan satisfies these limits at any duration." in words
    (table,) = tables(page, "durations")
    assert {row[1] for row in rows(table)} == {"–"}
    assert not list(table.all("td", class_="better"))


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_a_worth_without_needs_or_tables_has_a_page(study, shown):
    bare = Benefit(study.comparison.benefit.comparison, {}, (), (), 1.0)
    assert WORTH in heads(shown(replace(study.comparison, benefit=bare))[1])


def test_the_results_are_those_of_the_study(study, written, tmp_path):
    def forbidden(constant):
        raise AssertionError(f"JSON has no {constant}")

    data = json.loads(written[1].read_text(encoding="utf-8"), parse_constant=forbidden)
    found = data["studies"]["mine"]["worth"]
    assert found == json.loads(json.dumps(study.comparison.benefit.results()))
    assert list(found) == ["plans", "needs", "grids"]
    study.comparison.save(tmp_path / "saved.json")
    assert json.loads((tmp_path / "saved.json").read_text())["worth"] == found


# The paper's studies


@pytest.mark.slow
def test_the_reproduction_asks_all_three(reproduced, read):
    page = read(reproduced.html)
    asked = {name: study["worth"] for name, study in reproduced.results["studies"].items() if "worth" in study}
    assert [heads(page).count(title) for title in (FASTEST, WORTH, OPTIMAL)] == [1, len(asked), 1]
    assert not re.search(r"\{\w*\}|\bnan\b|\bNone\b", page.words())
    assert re.search(r"The active limit is theta, reached at [\d.]+ s\.", page.words())
    for row in ("Path length [m]", "Integral of the squared jerk [m²/s⁵]", "Residual sway [rad]"):
        assert f"{row} over duration and alpha:" in page.words()
    assert all(found["needs"]["step"] is None for found in asked.values())
    assert asked["crane-nominal"]["needs"]["quintic (minimum jerk)"] == pytest.approx(15.0, rel=1e-9)
