"""Sections are typed data: a user's own type is drawn, placed and kept as the others are, and no name has a meaning."""

import ast
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan import reports
from ctrlplan.reports import Cell, Head, Items, Part, Picture, Svg, Table, Text, draw, plot_blocks, render_page
from ctrlplan.studies import PAPER, Study
from ctrlplan.studies.files import load_study
from ctrlplan.studies.sections import Curves, PlanCurves, Plane, Responses, Section, SweepCurves
from ctrlplan.studies.verdicts import unit_in

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(2, 1, 0, 0)]
TIMES = np.linspace(0, 6, 61)


@pytest.fixture(scope="module")
def compared():
    return cp.compare(cp.plants.integrator_lag_loop(5.0, outputs=("y", "u")), MOVE, TIMES)


@dataclass(frozen=True)
class Durations(Section):
    """Durations of the plans, with a figure of the first, some words, and data for results.json."""

    longest: float
    below: bool = False

    def results(self):
        return {"durations": {"longest": self.longest}}


@draw.register
def _(section: Durations, study: Study) -> Part:
    plans = study.comparison.plans
    rows = [
        [
            name,
            Cell(f"{plan.duration:g}", "better" if plan.duration <= section.longest else "worse", "as wanted"),
            "s & <s>",
        ]
        for name, plan in plans.items()
    ]
    return Part(
        [
            Text(f"At most {section.longest:g} s & <more>."),
            Items([f"{name} lasts." for name in plans]),
            Picture("first", plans["polynomial"].plot(), section.caption or "The first & <best>."),
            Table([Head("plan"), Head("duration"), Head("unit", unit=True)], rows, "durations"),
        ],
        heading="Durations & <limits>",
        below=section.below,
    )


class Unknown(Section):
    """A type for which no function is registered."""


def heads(page):
    return [e.words() for e in page.all() if re.fullmatch("h[1-6]", e.tag)]


def ids_of_figures(page):
    """Ids of the figures in the folds."""
    return [figure.attributes["id"] for figure in page.all("figure") if "id" in figure.attributes]


# A user's own type


@pytest.fixture(scope="module")
def own(compared, tmp_path_factory):
    """The page and the results of a study with a section of one's own between others."""
    sections = (PlanCurves(1), Durations(1.0), Responses(caption="What happens."))
    study = Study("mine", "Mine", compared, notes=("A finding.",), sections=sections)
    return reports.write_report([study], tmp_path_factory.mktemp("own sections"), "Mine")


@pytest.mark.slow
def test_a_section_of_ones_own_is_on_the_page_in_its_place(own, read):
    page = read(own[0].read_text(encoding="utf-8"))
    assert heads(page) == [
        "Mine",
        "Findings",
        "Durations & <limits>",
        "All metrics",
        "All figures",
        "Parameters and versions",
    ]
    assert ids_of_figures(page) == ["mine-first", "mine-plans", "mine-responses"]
    captions = [caption.words() for caption in page.all("figcaption")]
    assert (captions[1], captions[3]) == ("The first & <best>.", "What happens.")
    assert "At most 1 s & <more>." in page.words()
    assert [item.words() for item in page.all("li") if item.words().endswith("lasts.")] == [
        f"{name} lasts." for name in ("step", "polynomial", "trigonometric", "piecewise")
    ]


@pytest.mark.slow
def test_a_table_of_ones_own_has_its_cells_and_marks(own, read):
    page = read(own[0].read_text(encoding="utf-8"))
    (table,) = page.all("table", class_="durations")
    (head,), (body,) = table.all("thead"), table.all("tbody")
    assert [th.words() for th in head.all("th")] == ["plan", "duration", "unit"]
    rows = [[cell.words() for cell in row.children] for row in body.all("tr")]
    assert rows == [
        ["step", "0 ▲", "s & <s>"],
        ["polynomial", "2 ▽", "s & <s>"],
        ["trigonometric", "2 ▽", "s & <s>"],
        ["piecewise", "2 ▽", "s & <s>"],
    ]
    assert {span.attributes["aria-label"] for span in table.all("span")} == {"as wanted"}
    assert all(cell.attributes["scope"] == "row" for cell in body.all("th"))


@pytest.mark.slow
def test_data_of_a_section_is_in_the_results(own):
    data = json.loads(own[1].read_text(encoding="utf-8"))["studies"]["mine"]
    assert data["durations"] == {"longest": 1.0}
    assert set(data) == {"plans", "durations"}


@pytest.mark.usefixtures("blank_drawings")
def test_a_section_may_stand_below_the_metrics(compared, read):
    page = read(render_page([Study("mine", "Mine", compared, sections=(Durations(1.0, below=True),))], "Mine"))
    assert heads(page) == ["Mine", "All metrics", "Durations & <limits>", "Parameters and versions"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_sections_of_one_type_have_ids_of_their_own(compared, read):
    two = tuple(Curves("a", "b", TIMES, {"c": k * TIMES}, caption=f"Number {k}.") for k in (1, 2))
    studies = [Study(name, "It", compared, sections=(*two, Durations(1.0))) for name in ("it", "it-curves", "it")]
    page = read(render_page(studies, "It"))
    ids = [element.attributes["id"] for element in page.all() if "id" in element.attributes]
    assert len(ids) == len(set(ids))
    assert ids_of_figures(page)[:3] == ["it-first", "it-curves", "it-curves-2"]


@pytest.mark.slow
def test_a_figure_that_is_svg_already_is_put_in_as_it_is(compared, read):
    @dataclass(frozen=True)
    class Dot(Section):
        """A dot."""

    @draw.register
    def _(section: Dot, study: Study) -> Part:
        return Part([Svg("dot", reports.page.Markup('<svg viewBox="0 0 1 1"><circle r="1"/></svg>'), "A dot.")])

    page = read(render_page([Study("it", "It", compared, sections=(Dot(),))], "It"))
    (figure,) = (figure for figure in page.all("figure") if "panels" not in figure.attributes.get("class", ""))
    assert figure.attributes["id"] == "it-dot"
    assert [circle.attributes["r"] for circle in figure.all("circle")] == ["1"]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
def test_a_section_of_ones_own_joins_those_of_a_study_file(tmp_path, read):
    text = 't_end = 6.0\n[loop]\nkind = "linear"\nnum = [5.0]\nden = [1.0, 1.0, 0.0]\n'
    text += "".join(f"[[waypoints]]\ntime = {t}\ny = [{y}, 0.0, 0.0]\n" for t, y in ((0.0, 0.0), (2.0, 1.0)))
    (tmp_path / "lag.toml").write_text(text, encoding="utf-8")
    study = load_study(tmp_path / "lag.toml").run()
    study = replace(study, sections=(*study.sections, Durations(9.0)))
    page = read(render_page([study], "Lag"))
    assert ids_of_figures(page) == ["lag-first", "lag-plans", "lag-responses"]
    assert "Durations & <limits>" in heads(page)


# What cannot be drawn


def test_a_type_without_a_function_is_named(compared):
    with pytest.raises(TypeError, match=r"sections must be of a type that can be drawn, got Unknown; register"):
        render_page([Study("it", "It", compared, sections=(Unknown(),))], "It")


@pytest.mark.parametrize(
    ("section", "got"), [("plans", "str"), (PlanCurves, "the class PlanCurves"), (None, "NoneType")]
)
def test_sections_must_be_sections(section, got, compared):
    message = rf"sections must be instances of subclasses of Section, got {got} as sections\[1\]"
    with pytest.raises(TypeError, match=message):
        Study("it", "It", compared, sections=(Responses(), section))


def test_each_key_of_the_results_is_given_once(compared, swept):
    twice = Study("it", "It", compared, sections=(Plane(swept), SweepCurves(swept)))
    with pytest.raises(ValueError, match=r"unique keys in results.json, got sweep again from sections\[1\], Swee"):
        twice.results()
    once = Study("it", "It", compared, sections=(Plane(swept), SweepCurves(swept, in_results=())))
    assert once.results()["sweep"] == swept.results(("overshoot_error", "settling_time"))
    alone = Study("it", "It", compared, sections=(SweepCurves(swept, ("iae",)),))
    assert alone.results()["sweep"] == swept.results(("iae",))


def test_a_row_has_a_cell_for_each_heading():
    with pytest.raises(ValueError, match=r"rows\[1\] must have 2 cells, one per heading, got 1"):
        Table(["plan", "value"], [["a", "b"], ["c"]])


# Nothing is told apart by a name


@pytest.mark.slow
def test_reports_know_no_name_of_a_plan_and_no_study_of_the_paper():
    """Neither names of plans as constants, nor modules of the paper's studies."""
    names = {"step", "polynomial", "trigonometric", "piecewise", *PAPER}
    root = Path(reports.__file__).parent
    for path in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant):
                assert node.value not in names, f"{path.name}:{node.lineno}"
            if isinstance(node, ast.ImportFrom):
                assert node.module not in {f"ctrlplan.studies.{name}" for name in ("linear", "crane", "crane_setup")}
    for path in sorted(root.rglob("*.html")):
        assert not re.search(rf'"({"|".join(names)})"', path.read_text(encoding="utf-8")), path.name


@pytest.mark.parametrize(
    ("unit", "shown"), [("{y}^3 s", "m³ s"), ("{y}^2/s^10", "m²/s¹⁰"), ("{u}^-1", "N⁻¹"), ("s", "s"), ("x^n", "x^n")]
)
def test_powers_are_superscripts_whatever_they_are(unit, shown, compared):
    assert unit_in(replace(compared, units={"y": "m", "u": "N"}), unit) == shown


# Loops as blocks


def block(name, inputs, outputs):
    return ct.nlsys(None, lambda t, x, u, params: np.resize(u, len(outputs)), inputs=inputs, outputs=outputs, name=name)


def test_blocks_of_any_loop_stand_to_the_right_of_those_that_they_follow():
    parts = [
        block("a", ["r"], ["p"]),
        block("b", ["p"], ["q"]),
        block("c", ["p"], ["s"]),
        block("d", ["q", "s"], ["v"]),
    ]
    loop = ct.interconnect(parts, inputs="r", outputs="v")
    drawn = plot_blocks(loop, {"d": "$plant$"})
    place = {text.get_text(): text.get_position() for text in drawn.axes[0, 0].texts}
    assert place["a"][0] < place["b"][0] == place["c"][0] < place[r"\$plant\$"][0]
    assert place["b"][1] > place["c"][1]
    assert {"p", "q", "s"} <= set(place)
    plt.close(drawn.figure)


def test_feedback_goes_around_and_a_block_may_follow_itself():
    plant = ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]], inputs=["u", "y"], outputs=["y"], name="plant")
    law = block("law", ["e", "y"], ["u"])
    loop = ct.interconnect([law, plant], inputs="e", outputs="y")
    drawn = plot_blocks(loop)
    words = [text.get_text() for text in drawn.axes[0, 0].texts]
    assert sorted(words) == ["law", "plant", "u", "y", "y"]
    drawn.figure.canvas.draw()
    plt.close(drawn.figure)
