"""Bands over draws in figures and on pages: the quantiles that are drawn and printed are those of the closed form."""

import math
import re

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.reports import render_page
from ctrlplan.reports.figures import plot_bands
from ctrlplan.reports.style import page_style
from ctrlplan.studies import Study
from ctrlplan.studies.ensemble import LEVELS
from ctrlplan.studies.sections import Bands, DrawTable

TIMES = np.linspace(0.0, 6.0, 301)
TAU = np.linspace(0.5, 1.5, 21)  # quantiles at 1, 5, 10, 15, 19
PLANS = {"step": cp.Step(2.0), "ramp": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(6, 6)])}


def lag():
    """tau y' = r - y with the control u = r - y."""

    def update(t, x, u, params):
        return (u - x) / params["tau"]

    def out(t, x, u, params):
        return np.array([x[0], u[0] - x[0]])

    return ct.nlsys(update, out, states=1, inputs="r", outputs=["y", "u"], params={"tau": 1.0}, name="lag")


def refusing():
    """Same lag, which cannot be run with a tau above 2."""

    def update(t, x, u, params):
        if params["tau"] > 2.0:
            raise ValueError("tau is too long & <slow>")
        return (u - x) / params["tau"]

    return ct.nlsys(
        update, lambda t, x, u, params: x, states=1, inputs="r", outputs="y", params={"tau": 1.0}, name="lag"
    )


REFERENCES = {"step": 2.0 + 0.0 * TIMES, "ramp": TIMES}


def responses():
    tau = TAU[:, None]
    return {
        "step": 2 - 2 * np.exp(-TIMES / tau),
        "ramp": TIMES - tau * (1 - np.exp(-TIMES / tau)),
    }


@pytest.fixture(scope="module")
def drawn():
    return cp.monte_carlo(lag(), {"tau": TAU}, PLANS, TIMES, progress=False, units={"y": "m", "u": "N"})


@pytest.fixture(scope="module")
def failed():
    return cp.monte_carlo(refusing(), {"tau": [0.5, 3.0, 1.0]}, PLANS, TIMES, progress=False)


@pytest.fixture(scope="module")
def nothing():
    """Draws of which none was run."""
    return cp.monte_carlo(refusing(), {"tau": [3.0, 4.0]}, PLANS, TIMES, progress=False)


@pytest.fixture(scope="module")
def grid(drawn):
    """Axes of the figure, a row a signal, a column a plan."""
    return drawn.plot().axes


def outline(collection):
    """Lower and upper edge of a filled band."""
    (path,) = collection.get_paths()
    x, y = path.vertices.T
    low, high = (np.array([edge(y[np.isclose(x, t)]) for t in TIMES]) for edge in (np.min, np.max))
    return low, high


# The figure


@pytest.mark.slow
def test_a_row_is_a_signal_and_a_column_a_plan(grid):
    assert [axes.get_title() for axes in grid[0]] == ["step", "ramp"]
    assert [row[0].get_ylabel() for row in grid] == ["y [m]", "error of y [m]", "u [N]"]
    assert {axes.get_xlabel() for axes in grid[-1]} == {"time [s]"}


@pytest.mark.slow
def test_bands_are_drawn_as_they_are(grid):
    for axes, (plan, curves) in zip(grid[0], responses().items(), strict=True):
        expected = np.quantile(curves, LEVELS, axis=0)
        wide, narrow = (outline(collection) for collection in axes.collections)
        np.testing.assert_allclose(wide, expected[[0, 4]], atol=1e-6)
        np.testing.assert_allclose(narrow, expected[[1, 3]], atol=1e-6)
        reference, median = axes.lines
        np.testing.assert_allclose(median.get_ydata(), expected[2], atol=1e-6)
        np.testing.assert_allclose(reference.get_ydata(), REFERENCES[plan], atol=1e-12)


@pytest.mark.slow
def test_bands_of_the_error_are_those_of_the_reference_less_the_output(grid):
    for axes, (plan, curves) in zip(grid[1], responses().items(), strict=True):
        expected = np.quantile(REFERENCES[plan] - curves, LEVELS, axis=0)
        wide, narrow = (outline(collection) for collection in axes.collections)
        np.testing.assert_allclose(wide, expected[[0, 4]], atol=1e-6)
        np.testing.assert_allclose(narrow, expected[[1, 3]], atol=1e-6)
        (median,) = axes.lines
        np.testing.assert_allclose(median.get_ydata(), expected[2], atol=1e-6)


def test_bands_of_the_control_are_drawn_too(grid):
    for axes, (plan, curves) in zip(grid[2], responses().items(), strict=True):
        expected = np.quantile(REFERENCES[plan] - curves, LEVELS, axis=0)
        np.testing.assert_allclose(outline(axes.collections[0]), expected[[0, 4]], atol=1e-6)


def test_plans_share_the_scale_of_a_row_which_the_step_does_not_set(grid):
    """The first column is the step: where its bands leave the axes, its peak is written above them."""
    clipped = 0
    for row in grid:
        assert row[0].get_ylim() == row[1].get_ylim()
        low, high = row[0].get_ylim()
        step, ramp = (np.array(outline(axes.collections[0])) for axes in row)
        assert low < ramp.min()
        assert ramp.max() < high
        beyond = step.min() < low or step.max() > high
        (said,) = re.findall(r"peak (\S+), clipped", row[0].get_title(loc="left")) or [""]
        assert bool(said) == beyond
        if beyond:
            assert float(said) == pytest.approx(step.flat[np.abs(step).argmax()], rel=5e-3)
            clipped += 1
    assert clipped > 0


def test_rows_have_scales_of_their_own(grid):
    assert len({row[0].get_ylim() for row in grid}) > 1


def test_the_legend_says_what_the_bands_hold(drawn):
    legend = drawn.plot().legend
    assert [text.get_text() for text in legend.get_texts()] == ["reference", "5 to 95 %", "25 to 75 %", "median"]


@pytest.mark.slow
def test_without_units_none_is_made_up(failed):
    labels = [axes.get_ylabel() for axes in failed.plot().axes.flat]
    assert {"y", "error of y"} <= set(labels)
    assert not any("[" in label for label in labels)


def test_one_plan_is_one_column():
    alone = cp.monte_carlo(lag(), {"tau": TAU[:2]}, {"step": PLANS["step"]}, TIMES, progress=False)
    assert alone.plot().axes.shape == (3, 1)


def test_plans_keep_their_colours(grid):
    for column in grid.T:
        colours = {axes.lines[-1].get_color() for axes in column}
        assert len(colours) == 1
    assert grid[0, 0].lines[-1].get_color() != grid[0, 1].lines[-1].get_color()


def test_draws_of_which_none_was_run_are_drawn_without_bands(nothing):
    assert all(not axes.collections for axes in plot_bands(nothing).axes.flat)


def test_figures_of_a_page_do_not_pile_up_in_pyplot(drawn):
    before = plt.get_fignums()
    with page_style():
        drawn.plot()
    assert plt.get_fignums() == before


def test_a_figure_of_bands_needs_draws():
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'ensemble'"):
        Bands()


# The page


@pytest.fixture(scope="module")
def page(drawn, tmp_path_factory, read):
    path = drawn.report(tmp_path_factory.mktemp("drawn"), title="Lags & <draws>")
    assert path.name == "index.html"
    return read(path.read_text(encoding="utf-8"))


def spread(page):
    """Rows of the table of draws: title, unit and a cell a plan."""
    first, second = page.all("table", class_="metrics")
    rows = {}
    for row in next(first.all("tbody")).all("tr"):
        title, unit, *cells = row.children
        rows[title.words()] = (unit.words(), cells)
    return rows, second


def numbers(cell):
    return [float(text) for text in re.findall(r"[\d.]+", cell.words())]


@pytest.mark.slow
def test_the_page_has_the_table_of_draws_before_that_of_the_loop(page):
    heads = [e.words() for e in page.all() if re.fullmatch("h[1-6]", e.tag)]
    assert heads[0] == "Lags & <draws>"
    assert heads.index("Metrics over the draws") < heads.index("Metrics at the nominal parameters")
    rows, nominal = spread(page)
    unit, cells = rows["Settling time"]
    assert unit == "s"
    assert len(cells) == 2
    # The median, and from which to which nine tenths of the draws are.
    np.testing.assert_allclose(numbers(cells[0]), math.log(50) * TAU[[10, 1, 19]], rtol=1e-3)
    assert re.fullmatch(r"[\d.]+ \([\d.]+ to [\d.]+\)", cells[0].words())
    assert float(cells[0].attributes["data-order"]) == pytest.approx(math.log(50), rel=1e-5)
    assert rows["IAE of the tracking error"][0] == "m s"
    assert next(nominal.all("tbody")) is not None


@pytest.mark.slow
def test_the_page_shows_bands_and_responses(page):
    figures = {figure.attributes["id"]: figure for figure in page.all("figure") if "id" in figure.attributes}
    assert list(figures) == ["draws-bands", "draws-responses"]
    for figure in figures.values():
        assert len(list(figure.all("svg"))) == 1
        (caption,) = figure.all("figcaption")
        assert caption.words() == figure.attributes["aria-label"]


@pytest.mark.slow
def test_the_page_says_what_was_drawn(page):
    (findings,) = (e for e in page.all("ul") if "21 draws" in e.words())
    assert "21 draws: tau 0.5 to 1.5" in findings.words()
    assert "failed" not in findings.words()


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_the_page_says_what_failed(failed, read):
    study = Study("draws", "Draws", failed.nominal, notes=tuple(failed.notes()), sections=(Bands(failed),))
    text = read(render_page([study], "Draws")).words()
    assert "1 of 3 draws failed. The first, with tau = 3: ValueError: tau is too long & <slow>" in text


@pytest.mark.usefixtures("blank_drawings")
def test_the_report_says_what_failed(failed, tmp_path, read):
    text = read(failed.report(tmp_path / "failed.html").read_text(encoding="utf-8")).words()
    assert "1 of 3 draws failed. The first, with tau = 3: ValueError: tau is too long & <slow>" in text
    assert (tmp_path / "failed.html").exists()


@pytest.mark.usefixtures("blank_drawings")
def test_a_page_without_any_draw_that_was_run_is_whole(nothing, tmp_path, read):
    text = read(nothing.report(tmp_path).read_text(encoding="utf-8")).words()
    assert "2 draws failed" in text


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_values_that_are_never_reached_are_words_that_sort_last(tmp_path, read):
    slow = cp.monte_carlo(lag(), {"tau": [0.5, 9.0, 9.5]}, PLANS, TIMES, progress=False)
    rows, _ = spread(read(slow.report(tmp_path).read_text(encoding="utf-8")))
    cell = rows["Settling time"][1][0]
    assert cell.words() == "never (1.956 to never)"
    assert cell.attributes["data-order"] == "1e999"


def test_results_of_a_study_hold_its_draws(drawn):
    study = Study("draws", "Draws", drawn.nominal, sections=(DrawTable(drawn),))
    assert study.results()["draws"] == drawn.results()


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_a_metric_of_one_plan_only_is_on_the_page(tmp_path, read):
    def last(run):
        return {"last": float(run.response.outputs[0, -1])} if run.plan is PLANS["step"] else {}

    measures = {"last": cp.Measure("Last value", "m"), "ends": cp.Measure("Ends", of="run", function=last)}
    found = cp.monte_carlo(lag(), {"tau": TAU[:4]}, PLANS, TIMES, progress=False, measures=measures)
    rows, _ = spread(read(found.report(tmp_path).read_text(encoding="utf-8")))
    step, ramp = rows["Last value"][1]
    ends = 2 - 2 * np.exp(-6 / TAU[:4])
    np.testing.assert_allclose(numbers(step), [ends[1], ends[3], ends[0]], rtol=1e-3)
    assert ramp.attributes["data-order"] == ""
