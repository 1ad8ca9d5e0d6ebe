"""Whatever a name, label, title, unit or note says, it is text: on the page, in its figures, in the browser."""

import base64
import hashlib
import json
import re
import unicodedata
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drawings import drawn_texts
from hostile import CONTROL, MARKUP, NOT_WRITTEN_SO, SHOWN, TEXTS, mixed, study
from repetitions import one_in

import ctrlplan as cp
from ctrlplan.reports import CraneAnimation, comparison_fragment, plot_plans, render_page, shown, write_page
from ctrlplan.reports.parts import Panels
from ctrlplan.reports.style import to_svg
from ctrlplan.studies import Study
from ctrlplan.studies.sections import PlanCurves
from ctrlplan.studies.verdicts import unit_in

DIRECTIONS = set("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def seen(text):
    """A text as a reader must see it: blanks as one, and a sign where there is nothing to see."""
    unseen = [c in DIRECTIONS or unicodedata.category(c) in ("Cc", "Cs", "Cn") for c in text]
    return " ".join(
        "".join("\ufffd" if hidden and not c.isspace() else c for c, hidden in zip(text, unseen, strict=True)).split()
    )


DRAWN = {
    "svg",
    "g",
    "defs",
    "style",
    "path",
    "use",
    "text",
    "tspan",
    "rect",
    "clippath",
    "circle",
    "line",
    "polyline",
    "desc",
}
"""Elements of drawings."""


def structure(tree):
    """Tags with the names of their attributes; a drawing, whose texts are laid out by their lengths, is one tag."""
    found = []
    for child in tree.children:
        if child.tag == "svg":
            assert {e.tag for e in child.all()} <= DRAWN
            found.append((child.tag,))
        else:
            found.extend([(child.tag, *child.attributes), *structure(child)])
    return found


@pytest.fixture(scope="module")
def plain(read):
    """The structure of the page where every text is a word, with figures or without."""

    @cache
    def of(drawn):
        return structure(read(render_page([study(lambda role: role, drawn)], "page")))

    return of


# On the page


@pytest.fixture
def undrawn(monkeypatch):
    """Pages without the main figure, for what is said of their texts alone."""
    monkeypatch.setattr(shown, "main_figure", lambda study: Panels([], [], "Nothing is drawn here."))


@pytest.mark.parametrize("name", TEXTS)
def test_no_element_and_no_attribute_comes_from_a_text(name, undrawn, plain, read):
    tree = read(render_page([study(lambda role: f"{TEXTS[name]} {role}", drawn=False)], TEXTS[name]))
    assert structure(tree) == plain(False)
    words = tree.words()
    for role in SHOWN:
        text = TEXTS[name].replace("^2", "²") if role == "unit" else TEXTS[name]  # which a unit is printed with
        assert seen(f"{text} {role}") in words, role
    assert next(tree.all("title")).words() == seen(TEXTS[name])


@cache
def drawn_page(offset):
    """A page with all figures, and another text of the list in each place."""
    return render_page([study(mixed(offset))], "page")


OFFSETS = pytest.mark.parametrize("offset", range(0, len(TEXTS), 22))


@pytest.mark.slow
@OFFSETS
def test_nor_where_figures_are_drawn(offset, plain, read):
    tree = read(drawn_page(offset))
    assert structure(tree) == plain(True)
    for element in tree.all():
        assert not [key for key in element.attributes if key.startswith("on")]
        for key in ("href", "xlink:href"):
            assert element.attributes.get(key, "#").startswith(("#", "data:,"))


@pytest.mark.slow
@pytest.mark.usefixtures("blank_drawings")
@pytest.mark.parametrize(
    "names", [("a b", "a-b", "a b"), ("", "!", "?"), ("a", "a-plans", "a-plans-2"), ("\udcff", "-")]
)
def test_ids_are_unique_and_plain_whatever_studies_are_called(names, read):
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    found = cp.compare(cp.plants.integrator_lag_loop(5.0), move, np.linspace(0, 3, 31))
    tree = read(render_page([Study(name, "it", found, sections=(PlanCurves(),)) for name in names], "page"))
    ids = [e.attributes["id"] for e in tree.all() if "id" in e.attributes]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[\w.-]+", i) for i in ids)
    links = [e.attributes["href"][1:] for e in tree.all("a")]
    assert links == [e.attributes["id"] for e in tree.all("section")]


@pytest.mark.parametrize("name", [*MARKUP, *CONTROL])
def test_a_notebook_cell_takes_them_as_text_too(name, read):
    one, other = (study(text, drawn=False).comparison for text in (str, lambda role: f"{TEXTS[name]} {role}"))
    assert structure(read(comparison_fragment(other))) == structure(read(comparison_fragment(one)))
    moving = read(CraneAnimation(other)._repr_html_())
    assert structure(moving) == structure(read(CraneAnimation(one)._repr_html_()))
    (data, _) = moving.all("script")
    assert list(json.loads(data.text)["plans"]) == list(other.plans)


def test_the_policy_allows_the_script_of_the_page_and_nothing_else(undrawn, read):
    tree = read(render_page([study(str, drawn=False)], "page"))
    (policy,) = (
        m.attributes["content"] for m in tree.all("meta") if m.attributes.get("http-equiv") == "Content-Security-Policy"
    )
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    (script,) = (s for s in tree.all("script") if s.attributes.get("type") != "application/json")
    digest = base64.b64encode(hashlib.sha256(script.text.encode()).digest()).decode()
    assert rules["default-src"] == "'none'"
    assert rules["script-src"] == f"'sha256-{digest}'"
    assert rules["base-uri"] == rules["form-action"] == "'none'"
    assert rules["img-src"] == "data:"
    head = next(tree.all("head"))
    assert [e.tag for e in head.children].index("meta") == 0
    assert head.children[1].attributes["content"] == policy  # before anything that it rules


@pytest.mark.parametrize("name", CONTROL)
def test_a_page_with_any_character_can_be_written_and_read(name, undrawn, tmp_path):
    path = write_page([study(lambda role: f"{TEXTS[name]} {role}", drawn=False)], tmp_path, TEXTS[name])
    text = path.read_bytes().decode("utf-8")
    assert not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]", text)


@pytest.fixture(scope="module")
def margins(read):
    """Table of the margins of a quantity of a name."""

    @cache
    def of(quantity):
        plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
        return read(cp.fastest(plan, {quantity: 2.0}, lambda jet: {quantity: jet[1, 0]})._repr_html_())

    return of


@pytest.mark.parametrize("name", one_in(3, MARKUP))  # all in the page, above
def test_tables_of_margins_take_them_as_text_too(name, margins):
    assert structure(margins(TEXTS[name])) == structure(margins("speed"))
    assert seen(TEXTS[name]) in margins(TEXTS[name]).words()


def test_units_that_look_like_a_place_for_units_are_units():
    found = replace(named(["one"]), units={"y": "{u}", "u": "{y}^2"})
    assert [unit_in(found, unit) for unit in ("{y} s", "{u}^2 s", "{y}^2/s^5")] == ["{u} s", "({y}^2)² s", "{u}²/s⁵"]
    assert unit_in(replace(found, units={"y": "m"}), "{u} s") == ""


# In figures


def named(names):
    """Plans of these names."""
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    plans = {name: cp.TrigSpline(move, alpha=0.5 + 0.1 * k) for k, name in enumerate(names)}
    return cp.compare(
        cp.plants.integrator_lag_loop(5.0, outputs=("y", "u")), plans, np.linspace(0, 3, 61), waypoints=move
    )


def legend(figure):
    (one,) = figure.legends
    return one.get_texts()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", one_in(2, [name for name in NOT_WRITTEN_SO if name not in ("emoji", "Chinese", "Arabic")])
)
def test_the_legend_names_a_plan_by_its_letters(name):
    text = NOT_WRITTEN_SO[name]
    figure = plot_plans(named([text, "plain", "_b"])).figure
    assert [t.get_text() for t in legend(figure)] == [text, "plain", "_b"]
    assert not any(t.get_parse_math() for t in legend(figure))
    drawn = drawn_texts(to_svg(figure, "it"))
    assert text in drawn
    assert "_b" in drawn


def test_an_empty_name_has_its_place_in_the_legend():
    figure = plot_plans(named(["", "other"])).figure
    assert [t.get_text() for t in legend(figure)] == ["", "other"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["emoji", *(pytest.param(name, marks=pytest.mark.slow) for name in CONTROL)])
def test_letters_that_the_font_lacks_are_told_by_their_numbers(name):
    figure = plot_plans(named([TEXTS[name], TEXTS[name] + "!"])).figure
    one, other = (t.get_text() for t in legend(figure))
    assert one != other
    assert len(one) < 300
    lost = {
        c for c in TEXTS[name][:20] if unicodedata.category(c) in ("Cc", "Cs", "Cn", "So", "Lo") and not c.isspace()
    }
    if name != "no character":
        assert all(f"<U+{ord(c):04X}>" in one for c in lost)
    to_svg(figure, "it")  # in which a letter without a shape would be a warning, and here an error


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NOT_WRITTEN_SO, "ids", "zero", "lines"])
def test_labels_of_axes_and_titles_are_text_as_well(name):
    text = TEXTS[name].replace(".", "")
    found = named(["one", "two"])
    renamed = {key: cp.TrigSpline(plan.waypoints, alpha=plan.alpha, labels=[text]) for key, plan in found.plans.items()}
    figure = plot_plans(replace(found, plans=renamed, units={text: text})).figure
    drawn = "\n".join(drawn_texts(to_svg(figure, "it")))
    if name in ("formula", "wrong formula", "command", "one dollar", "dollars", "underscores", "powers"):
        # The position has no power of ours in its unit, so that matplotlib draws it without its formulas.
        assert f"{text} position [{text}]" in drawn
    for axes in figure.axes:
        assert "position" in axes.get_ylabel() or "velocity" in axes.get_ylabel() or "acceleration" in axes.get_ylabel()


def test_a_plan_named_with_an_underscore_keeps_its_colour_in_all_figures():
    found = named(["_a", "b"])
    labels = {line.get_label() for line in plot_plans(found).axes[0, 0].lines if line.get_linewidth() > 1.0}
    assert len(labels) == 2


# In the browser


STATE = """
return {
  hit: typeof window.hit, text: document.body.innerText.toWellFormed(), title: document.title,
  elements: Array.from(document.querySelectorAll("*")).map(e => e.tagName.toLowerCase())
    .filter(t => ["img", "iframe", "object", "embed", "base", "audio", "video", "form", "input", "b", "i"].includes(t)),
  scripts: document.querySelectorAll("script:not([type])").length,
  handlers: Array.from(document.querySelectorAll("*")).filter(
    e => e.getAttributeNames().some(n => n.startsWith("on"))).length,
  plans: Array.from(document.querySelectorAll("figure.animation option")).map(o => o.textContent.toWellFormed()),
};
"""


@pytest.fixture
def opened(browser, tmp_path):
    def at(page):
        path = tmp_path / "index.html"
        path.write_text(page, encoding="utf-8")
        browser.get("about:blank")
        browser.get_log("browser")
        browser.get(path.as_uri())
        return browser

    return at


def check(chrome):
    chrome.execute_script("document.querySelectorAll('details').forEach(fold => { fold.open = true; })")
    for choose in chrome.find_elements("css selector", "figure.animation select"):
        for option in choose.find_elements("css selector", "option"):
            option.click()
            chrome.execute_script("arguments[0].dispatchEvent(new Event('change'))", choose)
    for button in chrome.find_elements("css selector", "thead button"):
        chrome.execute_script("arguments[0].click(); arguments[0].focus()", button)
    found = chrome.execute_script(STATE)
    assert found["hit"] == "undefined"
    assert found["elements"] == []
    assert found["scripts"] == 1
    assert found["handlers"] == 0
    assert chrome.get_log("browser") == []
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", TEXTS)
def test_a_browser_runs_nothing_that_a_text_says(name, undrawn, opened):
    found = check(opened(render_page([study(lambda role: f"{TEXTS[name]} {role}", drawn=False)], "page")))
    text = " ".join(found["text"].split())
    assert seen(f"{TEXTS[name]} reason") in text
    assert [" ".join(plan.split()) for plan in found["plans"]] == [
        " ".join(f"{TEXTS[name]} {role}".encode("utf-16", "surrogatepass").decode("utf-16", "replace").split())
        for role in ("one", "two")
    ]


@pytest.mark.slow
@OFFSETS
def test_nor_where_it_stands_in_a_figure(offset, opened):
    check(opened(drawn_page(offset)))


@pytest.mark.slow
def test_the_policy_stops_a_script_that_got_in_all_the_same(browser, tmp_path):
    html = render_page([study(str, drawn=False)], "page")
    path = tmp_path / "index.html"
    for told in (
        "<script>window.hit=1</script>",
        "<img src=x onerror='window.hit=1'>",
        "<svg onload='window.hit=1'></svg>",
    ):
        path.write_text(html.replace("<h1>", told + "<h1>"), encoding="utf-8")
        browser.get(path.as_uri())
        assert browser.execute_script("return typeof window.hit") == "undefined"
    browser.get_log("browser")
