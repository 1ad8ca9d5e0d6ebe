"""The page as text: whole, self-contained, and saying what the numbers say."""

import re
import unicodedata
from importlib import metadata
from itertools import pairwise

import pytest

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
        (svg,) = (s for s in figure.all("svg") if "viewbox" in s.attributes)
        moving = "animation" in figure.attributes.get("class", "")
        assert moving or len(list(svg.all("path"))) > 20
        (caption,) = figure.all("figcaption")
        assert len(caption.words()) > 20
        assert moving or figure.attributes["aria-label"] == caption.words()


def test_figures_name_every_plan(written, page):
    plans = [plan for study in written.results["studies"].values() for plan in study["plans"]]
    comments = re.findall(r"<!-- (.*?) -->", written.html)  # drawn letter by letter, with the text beside it
    for plan in set(plans):
        if re.fullmatch(r"\w+", plan):
            assert comments.count(plan) >= 2


# The table


def test_the_table_has_what_results_have(written, page):
    tables = list(page.all("table", class_="metrics"))
    assert len(tables) == len(written.results["studies"])
    for table, study in zip(tables, written.results["studies"].values(), strict=True):
        (head,) = next(table.all("thead")).all("tr")
        names = [th.words().rstrip("†") for th in head.all("th")]
        assert names == ["metric", "unit", *study["plans"]]
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
            _, *cells = row.all("td")
            assert len(cells) == len(study["plans"])
            for cell, plan in zip(cells, study["plans"].values(), strict=True):
                value = plan["metrics"].get(key)  # of a run that was ended early not every metric is known
                text = cell.words().rstrip(" ▲▽")
                if value is None:
                    assert not re.search(r"\d", text)
                    assert cell.attributes["data-order"] in ("", "1e999")
                else:
                    assert float(cell.attributes["data-order"]) == value
                    assert number(text) == pytest.approx(value, rel=5e-4, abs=1e-9)


def test_every_heading_that_sorts_is_a_button(page):
    for table in page.all("table", class_="metrics"):
        heads = list(table.all("th", scope="col"))
        assert all(list(head.all("button", type="button")) for head in heads if head.words() != "unit")


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


def unstable(section):
    """Whether nothing is won in a section, because nothing settles there."""
    (box,) = section.all("p", class_="verdict")
    return box.words().startswith("The loop is unstable")


def unranked(section):
    """Plans whose runs were ended early, which the verdict names."""
    found = re.search(r"Not ranked, since [^:]*: ([^.]*)\.", next(section.all("p", class_="verdict")).words())
    return found[1].split(", ") if found else []


def test_the_verdict_names_winner_and_loser_of_each_metric(written, page):
    for section, study in zip(page.all("section"), written.results["studies"].values(), strict=True):
        (verdicts,) = section.all("ul", class_="verdicts")
        sentences = {li.words().split(":")[0]: li.words() for li in verdicts.all("li")}
        if unstable(section):
            assert not sentences
            continue
        told = 0
        for key, measure in MEASURES.items():
            values = {p: found["metrics"].get(key) for p, found in study["plans"].items() if p not in unranked(section)}
            if None in values.values():
                continue  # infinite or undefined: told in the tests of the words
            sentence = sentences[measure.title]
            low, high = min(values.values()), max(values.values())
            if high - low > 2e-3 * high:
                if ": equal for " in sentence:  # within the rounding of the metric's scale, which is said
                    assert ", within " in sentence
                    continue
                best, worst = (next(p for p, v in values.items() if v == end) for end in (low, high))
                first, last = re.split(r"\), worst ", sentence.split(": best ", 1)[1])
                assert best in first
                assert worst in last
                told += 1
        assert told > 5


def test_the_summary_counts_wins_and_losses(page):
    for section in page.all("section"):
        (box,) = section.all("p", class_="verdict")
        (verdicts,) = section.all("ul", class_="verdicts")
        if unstable(section):
            continue
        decided = [li.words() for li in verdicts.all("li") if ": equal for " not in li.words()]
        assert box.words().startswith(f"Of {len(decided)} metrics")
        (table,) = section.all("table", class_="metrics")
        heads = [th.words().rstrip("†") for th in table.all("th", scope="col")][2:]
        for column, plan in enumerate(heads):
            if plan in unranked(section):
                assert f"{plan} is best" not in box.words()
                continue
            cells = [list(row.all("td"))[1 + column] for row in table.all("tr") if list(row.all("td"))]
            wins, losses = (sum(mark in c.attributes["class"].split() for c in cells) for mark in ("better", "worse"))
            assert f"{plan} is best in {wins} and worst in {losses}" in box.words()


def test_best_and_worst_are_told_by_more_than_colour(page):
    for mark, sign in (("better", "▲"), ("worse", "▽")):
        cells = list(page.all("td", class_=mark))
        assert bool(cells) != all(map(unstable, page.all("section")))
        assert all(sign in cell.words() for cell in cells)
        labels = [next(cell.all("span")).attributes["aria-label"] for cell in cells]
        assert set(labels) <= {"best", "worst", "better than every baseline", "worse than the best baseline"}


def test_versions_are_on_the_page(page):
    (footer,) = page.all("footer")
    said = footer.words()
    assert f"ctrlplan {cp.__version__}" in said
    assert re.search(r"Python 3\.\d+\.\d+", said)
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
