"""The page as text: whole, self-contained, and saying what the numbers say."""

import platform
import re
import unicodedata
from importlib import metadata
from itertools import pairwise

import pytest
from drawings import drawn_texts

import ctrlplan as cp
from ctrlplan.reports import render_page
from ctrlplan.studies import MEASURES as GENERAL
from ctrlplan.studies import Study
from ctrlplan.studies.crane import CRANE_MEASURES

MEASURES = CRANE_MEASURES | GENERAL


@pytest.fixture
def page(written, read):
    return read(written.html)


def number(text):
    """Read a number as it is printed on the page."""
    return float(unicodedata.normalize("NFKC", text.replace("·10", "e")).replace("−", "-"))


# The document


@pytest.mark.slow
def test_the_document_is_whole(written, page):
    assert written.html.lstrip().lower().startswith("<!doctype html>")
    assert page.attributes["declared"] == ["DOCTYPE html"]
    (html,) = page.all("html")
    assert html.attributes["lang"] == "en"
    (head,), (body,) = page.all("head"), page.all("body")
    assert [e.tag for e in html.children] == ["head", "body"] == [head.tag, body.tag]
    assert any(m.attributes.get("charset", "").lower() == "utf-8" for m in head.all("meta"))
    (viewport,) = head.all("meta", name="viewport")
    assert "width=device-width" in viewport.attributes["content"]
    (title,), (heading,) = head.all("title"), body.all("h1")
    assert title.words() == heading.words() != ""
    assert next(body.all("main"), None) is not None


def test_ids_are_unique(page):
    ids = [e.attributes["id"] for e in page.all() if "id" in e.attributes]
    twice = {i for i in ids if ids.count(i) > 1}
    assert not twice, f"{len(twice)} ids stand for several elements, such as {sorted(twice)[:5]}"


def test_ids_are_names_and_inner_links_lead_somewhere(written, page):
    ids = {e.attributes["id"] for e in page.all() if "id" in e.attributes}
    assert all(i and not re.search(r"\s", i) for i in ids)
    links = [
        v for e in page.all() for k, v in e.attributes.items() if k in ("href", "xlink:href") and v.startswith("#")
    ]
    links += re.findall(r"url\(\s*[\"']?(#[^)\"']*)", written.html)
    assert links
    assert {link[1:] for link in links} <= ids


def test_nothing_is_fetched(written, page):
    for element in page.all():
        assert element.tag not in ("iframe", "object", "embed", "base", "img", "video", "audio")
        for name, value in element.attributes.items():
            if name in ("src", "href", "xlink:href", "srcset", "action", "data", "poster"):
                assert value.startswith(("#", "data:")), f'<{element.tag} {name}="{value}">'
            if not name.startswith("xmlns"):
                assert "//" not in value or element.tag.startswith(("rdf:", "cc:", "dc:")), f"{name}={value}"
    for style in [e.text for e in page.all("style")] + [e.attributes.get("style", "") for e in page.all()]:
        assert "@import" not in style
        assert not re.search(r"url\(\s*[\"']?(?!#|data:)", style)
    for script in page.all("script"):
        assert not re.search(r"\b(fetch|XMLHttpRequest|import|WebSocket|sendBeacon)\b", script.text)


def test_the_heads_of_the_sections_do_not_skip_a_level(page):
    levels = [int(e.tag[1]) for e in page.all() if re.fullmatch("h[1-6]", e.tag)]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels)), levels


# The figures


def test_figures_are_drawings_with_a_caption(page):
    figures = list(page.all("figure"))
    assert len(figures) >= 2
    for figure in figures:
        svgs = [s for s in figure.all("svg") if "width" in s.attributes or s.attributes.get("role") == "img"]
        moving = "animation" in figure.attributes.get("class", "")
        assert len(svgs) == 1 or figure.attributes["class"] == "panels"
        assert all(moving or len(list(svg.all("path"))) > 5 for svg in svgs)
        (caption,) = figure.all("figcaption")
        assert len(caption.words()) > 20
        assert moving or figure.attributes["aria-label"] == caption.words()


def test_figures_name_every_plan(written, page):
    plans = [plan for study in written.results["studies"].values() for plan in study["plans"]]
    names = [name for text in drawn_texts(written.html) for name in text.split(" = ")]  # of curves that coincide
    for plan in set(plans):
        if re.fullmatch(r"\w+", plan):
            assert names.count(plan) >= 2


# The table


def test_the_table_has_what_results_have(written, page):
    tables = list(page.all("table", class_="metrics"))
    assert len(tables) == len(written.results["studies"])
    for table, study in zip(tables, written.results["studies"].values(), strict=True):
        (head,) = next(table.all("thead")).all("tr")
        names = [th.words().rstrip("†") for th in head.all("th")]
        assert names == ["metric", "unit", *study["plans"], "worst to best"][: 2 + len(study["plans"]) + told(table)]
        rows = list(next(table.all("tbody")).all("tr"))
        known = [k for k in MEASURES if any(k in plan["metrics"] for plan in study["plans"].values())]
        # Of signals of different units there is a row each, in the place of the worst.
        keys = {MEASURES[key].title: key for key in known}
        titles = [next(row.all("th")).words() for row in rows]
        each = [re.fullmatch(r"(.*) \((\w+)\)", title) for title in titles]
        metrics = [title if title in keys else own and own[1] for title, own in zip(titles, each, strict=True)]
        assert set(metrics) == set(keys)
        for row, title, own in zip(rows, titles, each, strict=True):
            key = keys[title] if title in keys else f"{keys[own[1]]}_{own[2]}"
            _, *cells = list(row.all("td"))[: 1 + len(study["plans"])]
            assert len(cells) == len(study["plans"])
            for cell, plan in zip(cells, study["plans"].values(), strict=True):
                value = plan["metrics"].get(key)  # of a run that was ended early not every metric is known
                text = cell.words().rstrip(" ▲▽")
                if value is None:
                    assert not re.search(r"\d", text)
                    assert cell.attributes["data-order"] in ("", "1e999")
                else:
                    assert float(cell.attributes["data-order"]) == value
                    # A value below 1e-6 of its scale is rounding and shown as 0: 100 %, and moves of 1 m and more.
                    known = [found["metrics"].get(key) or 0.0 for found in study["plans"].values()]
                    scale = {"%": 100.0, "m": 1.0}.get(next(row.all("td")).words(), max(known))
                    rounding = 1e-6 * scale if text == "0" else 0.0
                    assert number(text) == pytest.approx(value, rel=5e-4, abs=max(rounding, 1e-9))


def test_every_heading_that_sorts_is_a_button(page):
    for table in page.all("table", class_="metrics"):
        heads = list(table.all("th", scope="col"))
        plain = ("unit", "worst to best")
        assert all(list(head.all("button", type="button")) for head in heads if head.words() not in plain)


def test_units_are_those_of_the_study(own, read):
    (table,) = read(own.html).all("table", class_="metrics")
    units = {
        next(r.all("th")).words(): next(r.all("td", class_="unit")).words()
        for r in table.all("tr")
        if list(r.all("td"))
    }
    assert units["Settling time"] == "s"
    assert units["Overshoot on the tracking error"] == "%"
    assert units["IAE of the tracking error"] == "m s"
    assert units["ISE relative to the final value"] == "m² s"
    assert units["ITAE of the tracking error"] == "m s²"
    assert units["Peak control"] == "N"
    assert units["Control effort"] == "N² s"
    assert units["Peak distance outside the waypoints' bounding box"] == "m"
    assert units["Integral of the squared jerk of the reference"] == "m²/s⁵"


def test_a_plan_has_one_colour_in_the_table_and_in_the_figures(written, page):
    for table in page.all("table", class_="metrics"):
        keys = {}
        for head in table.all("th", scope="col"):
            for key in head.all(class_="key"):
                keys[head.words()] = re.search(r"#[0-9a-fA-F]{6}", key.attributes["style"])[0].lower()
        assert len(set(keys.values())) == len(keys), keys
        drawn = set(re.findall(r"stroke: (#[0-9a-f]{6})", written.html)) | {"#000000"}
        assert set(keys.values()) <= drawn


# The words


def told(table):
    """Whether a table has a column for the difference of best and worst."""
    return any(th.words() == "worst to best" for th in table.all("th"))


def unstable(section):
    """Whether nothing is best in a section, because nothing settles there."""
    (box,) = section.all("p", class_="headline")
    return box.words().startswith("The loop is unstable")


def unranked(section):
    """Plans whose runs were ended early, which notes below the table name."""
    notes = [p.words() for p in section.all("p", class_="mark")]
    return [note[2:].split(":")[0] for note in notes if note.startswith("†") and "are not ranked" in note]


def marked(row, plans):
    """Plans that a row of the metrics marks as best and as worst, and the note on their difference."""
    cells = list(row.all("td"))
    kinds = dict(zip(plans, (cell.attributes["class"] for cell in cells[1 : 1 + len(plans)]), strict=True))
    note = cells[1 + len(plans)].words() if len(cells) > 1 + len(plans) else ""
    return [p for p in plans if kinds[p] == "better"], [p for p in plans if kinds[p] == "worse"], note


def test_the_table_marks_the_best_and_the_worst_plan_of_each_metric(written, page):
    """Marks and notes follow from the numbers of results.json alone."""
    for section, study in zip(page.all("section"), written.results["studies"].values(), strict=True):
        (table,) = section.all("table", class_="metrics")
        rows = {next(row.all("th")).words(): row for row in next(table.all("tbody")).all("tr")}
        decided = 0
        for key, measure in MEASURES.items():
            if measure.title not in rows:
                continue
            best, worst, note = marked(rows[measure.title], list(study["plans"]))
            values = {p: found["metrics"].get(key) for p, found in study["plans"].items() if p not in unranked(section)}
            if unstable(section):
                assert best == worst == []
                continue
            if None in values.values() or min(values.values()) <= 1e-4 * max(values.values()):
                continue  # infinite, undefined or rounding: told in the tests of the words
            low, high = min(values.values()), max(values.values())
            if high <= 1.0099 * low:
                assert best == worst == []
                assert note in ("equal", "within 1 %")
            elif high > 1.0101 * low and note != "equal":  # which is within the rounding of the metric's scale
                assert {p for p, v in values.items() if v <= 1.0099 * low} <= set(best)
                assert set(best) <= {p for p, v in values.items() if v <= 1.0101 * low}
                assert {p for p, v in values.items() if v >= high / 1.0099} <= set(worst)
                if note:
                    assert float(note.removeprefix("ratio ")) == pytest.approx(high / low, rel=5.1e-3)
                decided += 1
        assert unstable(section) or decided > 3


def test_the_key_table_has_eight_rows_or_columns_at_most(written, page):
    for section, study in zip(page.all("section"), written.results["studies"].values(), strict=True):
        (table,) = section.all("table", class_="leading")
        heads = [th.words() for th in table.all("th", scope="col")]
        names = [th.words().rstrip("†") for th in table.all("th", scope="row")]
        many = len(study["plans"]) > 4
        plans, metrics = (names, heads[1:]) if many else (heads[1:], names)
        assert [p.rstrip("†") for p in plans if p != "worst to best"] == list(study["plans"])
        assert 3 <= len(metrics) <= 8
        assert any(metric.startswith("Settling time") for metric in metrics)


def test_the_headline_has_the_numbers_of_the_best_plan(own, read):
    (box,) = read(own.html).all("p", class_="headline")
    (study,) = own.results["studies"].values()
    found = re.match(
        r"With (\S+) \(duration 10 s\): settling time (\S+) s, overshoot on the tracking error (\S+) %, "
        r"peak control (\S+) N\. With step: settling time (\S+) s,",
        box.words(),
    )
    planned = {p: v["metrics"]["settling_time"] for p, v in study["plans"].items() if p != "step"}
    assert planned[found[1]] <= 1.01 * min(planned.values())
    for text, plan, key in zip(
        found.groups()[1:],
        [*[found[1]] * 3, "step"],
        ("settling_time", "overshoot_error", "control_peak", "settling_time"),
        strict=True,
    ):
        assert number(text) == pytest.approx(study["plans"][plan]["metrics"][key], rel=5e-4)
    assert box.words().endswith("No actuator limits are declared.")


def test_best_and_worst_are_told_by_more_than_colour(page):
    for mark, sign in (("better", "▲"), ("worse", "▽")):
        cells = list(page.all("td", class_=mark))
        assert bool(cells) != all(map(unstable, page.all("section")))
        assert all(sign in cell.words() for cell in cells)
        labels = [next(cell.all("span")).attributes["aria-label"] for cell in cells]
        assert set(labels) <= {"best", "worst", "better than every baseline", "worse than the best baseline"}


def test_versions_are_in_a_fold_of_each_study(page):
    (footer,) = page.all("footer")
    assert f"ctrlplan {cp.__version__}" in footer.words()
    for section in page.all("section"):
        (fold,) = (
            one for one in section.all("details") if next(one.all("summary")).words() == "Parameters and versions"
        )
        said = fold.words()
        assert f"ctrlplan {cp.__version__}" in said
        assert f"Python {platform.python_version()}" in said
        for package in ("control", "numpy", "scipy", "matplotlib"):
            assert f"{package} {metadata.version(package)}" in said


def test_parameters_are_on_the_page(own, read):
    (details,) = read(own.html).all("dl")
    told = dict(zip((e.words() for e in details.all("dt")), (e.words() for e in details.all("dd")), strict=True))
    text = " | ".join(f"{k} {v}" for k, v in told.items())
    for part in ("linear", "[1.0, 1.0, 0.0]", "gain 5.0", "alpha = 4 rad", "alpha = 0.5 rad", "0 to 30 s", "2 %"):
        assert part in text


def test_an_unstable_loop_is_called_so(unstable, read):
    tree = read(unstable.html)
    assert "The loop is unstable: it has a pole at 1.791 1/s." in tree.words()
    (table,) = tree.all("table", class_="metrics")
    (settling,) = (r for r in table.all("tr") if next(r.all("th")).words() == "Settling time")
    assert {cell.words() for cell in settling.all("td") if "data-order" in cell.attributes} == {"never"}
    (study,) = unstable.results["studies"].values()
    assert {plan["metrics"]["settling_time"] for plan in study["plans"].values()} == {None}


def test_titles_and_names_are_text(own, unstable, read):
    assert next(read(own.html).all("h1")).words() == "Hoist & swing <fast>"
    tree = read(unstable.html)
    assert "a <b> & 'c' --> d" in [th.words() for th in tree.all("th", scope="col")]
    assert not list(tree.all("fast"))
    assert not list(tree.all("b"))


def test_author_and_text_of_a_study_file_are_on_the_page(own, read):
    tree = read(own.html)
    (author,) = tree.all("p", class_="author")
    assert author.words() == "A. Hoister & <Sons>"
    (section,) = tree.all("section")
    paragraphs = [p.words() for p in section.all("p")]
    assert paragraphs[:2] == ["Why the move is planned.", "A second & <last> paragraph."]


STABLE = {
    "settling_time",
    "tracking_settling_time",
    "overshoot_error",
    "overshoot_final",
    "lag_error",
    "iae",
    "ise",
    "itae",
    "iae_final",
    "ise_final",
    "itae_final",
    "control_peak",
    "control_effort",
    "control_variation",
    "wandering",
    "excess_variation",
    "turning_points",
    "outside_box",
    "reference_jerk",
}


def test_results_have_the_stable_keys(written):
    results = written.results
    assert list(results) == ["studies"]
    for name, study in results["studies"].items():
        assert set(study) <= {"plans", "sweep", "worth"}
        for plan in study["plans"].values():
            assert list(plan) == ["metrics"]
            if name in ("hoist", "a strange name", "linear"):
                assert set(plan["metrics"]) == STABLE
            assert all(v is None or isinstance(v, float) for v in plan["metrics"].values())


# Several studies on one page


@pytest.fixture(scope="module")
def several():
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    times = [0.1 * i for i in range(201)]
    loops = {name: cp.plants.integrator_lag_loop(k, outputs=("y", "u")) for name, k in (("slow", 1.0), ("fast", 100.0))}
    return [Study(name, f"The {name} loop", cp.compare(loop, move, times)) for name, loop in loops.items()]


@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.slow
def test_several_studies_stand_apart_and_are_found_from_the_top(several, read):
    tree = read(render_page(several, "Both"))
    assert [s.attributes["id"] for s in tree.all("section")] == ["slow", "fast"]
    (nav,) = tree.all("nav")
    assert [(a.attributes["href"], a.words()) for a in nav.all("a")] == [
        ("#slow", "The slow loop"),
        ("#fast", "The fast loop"),
    ]
    assert [h.words() for h in tree.all("h2")] == ["The slow loop", "The fast loop"]
    ids = [e.attributes["id"] for e in tree.all() if "id" in e.attributes]
    assert len(ids) == len(set(ids))


@pytest.mark.slow
def test_the_same_studies_give_the_same_page(several):
    assert render_page(several[:1], "One") == render_page(several[:1], "One")


def test_a_notebook_cell_needs_nothing_from_outside(several, read):
    tree = read(several[0].comparison._repr_html_())
    assert len(list(tree.all("table"))) == 1
    assert not list(tree.all("script"))
    for style in tree.all("style"):
        for rule in re.findall(r"([^{}]+)\{", style.text):
            assert all(part.strip().startswith(".ctrlplan") for part in rule.split(",")), rule
