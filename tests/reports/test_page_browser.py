"""The page in a real browser, opened from the disk: what is seen, at any width, sorted, and printed."""

import base64
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.studies.files import load_study

pytestmark = pytest.mark.slow

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]


@pytest.fixture(scope="module", params=["own", pytest.param("reproduced", marks=pytest.mark.slow)])
def shown(request):
    """The pages that are looked at from every side."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def window(browser):
    """A page in the browser at a width, whole, with the logs of before taken away."""
    from selenium.webdriver.support.wait import WebDriverWait

    def at(written, width=1100, height=900, opened=True):
        browser.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500},
        )
        browser.get("about:blank")
        browser.get_log("browser")
        browser.get_log("performance")
        browser.get((written.folder / "index.html").as_uri())
        WebDriverWait(browser, 60).until(lambda page: page.execute_script("return document.readyState") == "complete")
        if opened:
            browser.execute_script("document.querySelectorAll('details').forEach(fold => { fold.open = true; })")
        return browser

    yield at
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.fixture
def opened(window, shown):
    """One of those pages at a width."""
    return lambda *size: window(shown, *size)


# Opened offline


def test_the_console_is_silent(window, written):
    chrome = window(written)
    for button in chrome.find_elements("css selector", "thead button"):
        button.click()
    assert chrome.get_log("browser") == []


def test_no_request_leaves_the_page(opened, shown):
    chrome = opened()
    messages = [json.loads(entry["message"])["message"] for entry in chrome.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    page = (shown.folder / "index.html").as_uri()
    assert page in asked
    assert [url for url in asked if url != page and not url.startswith("data:")] == []
    assert chrome.execute_script("return performance.getEntriesByType('resource').map(e => e.name)") == []


def test_it_is_drawn_by_the_standard_and_in_its_own_encoding(opened):
    chrome = opened()
    assert chrome.execute_script("return document.compatMode") == "CSS1Compat"
    assert chrome.execute_script("return document.characterSet") == "UTF-8"
    assert chrome.title


# One screen for each study

HEIGHTS = "return Array.from(document.querySelectorAll('section')).map(s => s.getBoundingClientRect().height)"


def test_each_study_is_one_screen_and_four_of_a_phone(window, written):
    for width, height, highest in ((1280, 800, 800), (390, 800, 3200)):
        chrome = window(written, width, height, opened=False)
        heights = chrome.execute_script(HEIGHTS)
        assert heights
        assert max(heights) <= highest
        if width == 1280:
            assert chrome.execute_script("return document.documentElement.scrollHeight") < 9000


def test_a_page_is_below_a_size(written):
    assert len(written.html.encode()) < 1.5e6


@pytest.mark.parametrize("width", [1280, 390])
def test_no_table_is_wider_than_its_page(window, written, width):
    chrome = window(written, width)
    wide = chrome.execute_script(
        "return Array.from(document.querySelectorAll('.scroll')).map(box => box.scrollWidth - box.clientWidth)"
    )
    assert wide
    assert max(wide) <= 1


MANY = {
    "as the reader words it": [f"trigonometric, alpha {0.3 * k:.1f} rad" for k in range(10)],
    "of many words": [f"a trigonometric plan with a long descriptive name, number {k} of ten" for k in range(10)],
    "of one long word": [f"{'a_very_long_name_without_a_blank' * 2}_{k}" for k in range(10)],
}


@pytest.fixture(scope="module", params=MANY)
def many(request, tmp_path_factory):
    """Page of a step and ten plans with long names."""
    plans = {name: cp.TrigSpline(MOVE, alpha=0.3 * k) for k, name in enumerate(MANY[request.param])}
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    found = cp.compare(loop, {"step": cp.Step(1.0)} | plans, np.linspace(0.0, 10.0, 501), waypoints=MOVE)
    folder = tmp_path_factory.mktemp("many")
    found.report(folder)
    return SimpleNamespace(folder=folder, short=request.param == "as the reader words it")


@pytest.mark.parametrize("width", [1280, 1100, 1000, 900, 800, 390])
def test_no_table_of_many_plans_is_wider_than_its_page(window, many, width):
    chrome = window(many, width)
    wide = chrome.execute_script(
        "return Array.from(document.querySelectorAll('.scroll')).map(box => box.scrollWidth - box.clientWidth)"
    )
    assert wide
    assert max(wide) <= 1
    assert chrome.execute_script("return document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("width", [1280, 390])
def test_a_number_is_not_broken_into_lines(window, many, width):
    chrome = window(many, width)
    lines = chrome.execute_script("""
        const lines = [];
        for (const cell of document.querySelectorAll('table.leading td, table.metrics td')) {
          const text = Array.from(cell.childNodes).find(node => node.nodeType === 3 && !node.data.trim().includes(' '));
          const range = document.createRange();
          if (text && getComputedStyle(cell).display !== 'none') {
            range.selectNodeContents(text);
            lines.push(range.getClientRects().length);
          }
        }
        return lines;""")
    assert len(lines) > 100
    assert set(lines) == {1}


def test_a_study_of_eleven_plans_is_one_screen_and_four_of_a_phone(window, many):
    for width, highest in ((1280, 800), (390, 3200)):
        (height,) = window(many, width, 800, opened=False).execute_script(HEIGHTS)
        assert height <= (highest if many.short else 2 * highest)  # names of three lines each


def test_folds_are_closed_at_first_and_open_on_paper(window, shown):
    chrome = window(shown, opened=False)
    count = "return document.querySelectorAll('details[open]').length"
    assert chrome.execute_script(count) == 0
    chrome.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert chrome.execute_script(count) == len(chrome.find_elements("css selector", "details")) > 2
    chrome.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert chrome.execute_script(count) == 0


def test_a_dark_page_is_dark_and_can_be_read(browser, window, shown):
    browser.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    )
    try:
        chrome = window(shown)
        found = chrome.execute_script(CONTRAST)
        assert found["seen"] > 100
        assert found["low"] == []
        ground = chrome.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert max(map(int, ground[4:-1].split(","))) < 60
        filled = "document.querySelector('.drawing svg text')"
        assert min(map(int, chrome.execute_script(f"return getComputedStyle({filled}).fill")[4:-1].split(","))) > 180
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


# The read-out

OUTPUT = "figure.panels .panel[id$=main-output] .drawing"


def read_out(chrome):
    """Lines of the read-out of the output: the time, the axes, and a value for each curve."""
    text = chrome.execute_script(f"return document.querySelector('{OUTPUT} .readout').textContent")
    return [line.strip() for line in text.replace("−", "-").split("\n")]


def test_the_keyboard_reads_all_curves_at_a_time(window, own):
    """Values of the read-out against the responses, simulated again."""
    from selenium.webdriver.common.keys import Keys

    chrome = window(own, opened=False)
    box = chrome.find_element("css selector", OUTPUT)
    for _ in range(41):  # the first shows the left end, each further one a hundredth of the axes
        box.send_keys(Keys.ARROW_RIGHT)
    first, axes, *values = read_out(chrome)
    assert axes == "y [m]"
    time = float(first.removeprefix("time = ").removesuffix(" s"))
    assert 9.0 < time < 13.0
    study = load_study(own.folder.parent / "hoist.toml").run()
    told = {}
    for line in values:
        name, value = line.rsplit(": ", 1)
        told |= dict.fromkeys(name.split(" = "), float(value))
    assert set(told) == set(study.comparison.plans)
    for name, value in told.items():
        response = study.comparison.responses[name]
        outputs = np.asarray(response.outputs)[0]
        # Values have four digits, and curves within 1/500 of the axes are drawn as one.
        near = outputs[np.abs(response.time - time) <= 0.02]
        assert near.min() - 0.03 <= value <= near.max() + 0.03
    box.send_keys(Keys.ESCAPE)
    assert read_out(chrome) == [""]


def test_the_pointer_reads_too(window, own):
    from selenium.webdriver import ActionChains

    chrome = window(own, opened=False)
    box = chrome.find_element("css selector", OUTPUT)
    ActionChains(chrome).move_to_element(box).perform()
    assert read_out(chrome)[0].startswith("time = ")
    assert len(chrome.find_elements("css selector", f"{OUTPUT} .cursor")) == 1


@pytest.mark.parametrize("key", [None, "ENTER"])
def test_an_entry_of_the_legend_hides_its_curve_and_shows_it_again(window, own, key):
    from selenium.webdriver.common.keys import Keys

    chrome = window(own, opened=False)
    (button,) = (b for b in chrome.find_elements("css selector", ".panels .legend button") if b.text == "step")
    shown = f"""return Array.from(document.querySelectorAll("{OUTPUT} [id*=curve-0-]")).filter(
        curve => getComputedStyle(curve).display !== "none").length"""
    before = chrome.execute_script(shown)

    def press():
        button.send_keys(getattr(Keys, key)) if key else button.click()
        return chrome.execute_script(shown), button.get_attribute("aria-pressed")

    assert press() == (before - 2, "false")  # the response and its thin reference
    assert press() == (before, "true")


def test_a_legend_inside_a_drawing_hides_its_curve_too(window, own):
    from selenium.webdriver.common.keys import Keys

    chrome = window(own)
    entry = chrome.find_element("css selector", "[id$=responses-entry-0]")
    assert entry.get_attribute("role") == "button"
    assert entry.get_attribute("aria-label") == "curve step"
    entry.send_keys(Keys.ENTER)
    hidden = "return Array.from(document.querySelectorAll('[id*=responses-curve]')).filter(c => c.style.display).length"
    assert chrome.execute_script(hidden) == 4  # of three axes, and a reference
    assert entry.get_attribute("aria-pressed") == "false"


def test_a_figure_and_its_data_open_alone(window, own):
    """What the links lead to, read by the page itself."""
    chrome = window(own, opened=False)
    figure = f"document.querySelector('{OUTPUT}')"
    content = """
        var links = Array.from(%s.parentElement.querySelectorAll(".links a")), done = arguments[0];
        links.forEach(link => { link.addEventListener("click", event => event.preventDefault()); link.click(); });
        var made = links.map(link => link.href);
        done(made);
    """
    hrefs = chrome.execute_async_script(content % figure)
    assert all(href.startswith("blob:") for href in hrefs)
    chrome.get(hrefs[0])
    assert chrome.execute_script("return document.documentElement.tagName") == "svg"
    assert chrome.execute_script("return document.querySelectorAll('[id*=curve-0-]').length") > 4


def test_without_a_script_everything_is_on_the_page(own, read):
    tree = read(own.html)
    assert not list(tree.all(class_="readout"))
    (legend,) = tree.all("ul", class_="legend")
    names = {name for li in legend.all("li") for name in li.words().split(" = ")}
    assert names == set(next(iter(own.results["studies"].values()))["plans"])
    assert all(fold.children[0].tag == "summary" for fold in tree.all("details"))


# Seen

BOXES = """
return Array.from(document.querySelectorAll(arguments[0])).map(function (e) {
  var b = e.getBoundingClientRect();
  return {left: b.left, right: b.right, width: b.width, height: b.height};
});
"""


FIGURES = "figure svg:not(.dashes)"
"""All drawings, without the samples of dashes in legends."""


@pytest.mark.parametrize("width", [1100, 390])
def test_nothing_overflows_the_page(window, written, width):
    chrome = window(written, width)
    assert chrome.execute_script("return document.documentElement.scrollWidth") <= width
    outside = chrome.execute_script(
        """
        var wide = [], limit = document.documentElement.clientWidth + 0.5;
        document.querySelectorAll("body *").forEach(function (e) {
          if (e.closest(".scroll, .drawing") && !e.matches(".scroll, .drawing")) { return; }
          var b = e.getBoundingClientRect();
          if (b.width && (b.right > limit || b.left < -0.5)) { wide.push(e.tagName + "." + e.className); }
        });
        return wide;
        """
    )
    assert outside == []


@pytest.mark.parametrize(("width", "height"), [(1100, 200), (390, 120)])
def test_figures_are_seen(opened, width, height):
    chrome = opened(width)
    drawings = chrome.execute_script(BOXES, FIGURES)
    assert len(drawings) == len(chrome.find_elements("css selector", ".drawing, figure.animation")) >= 2
    for box in drawings:
        assert box["width"] > 300
        assert box["height"] > height
        assert box["left"] >= 0
    for box in chrome.execute_script(BOXES, "figure .drawing"):
        assert box["left"] >= 0
        assert box["right"] <= width
    for colour in ("#0072b2", "#d55e00"):  # polynomial and trigonometric are on every page
        curves = chrome.execute_script(BOXES, f"figure svg path[style*='stroke: {colour}']")
        assert sum(box["width"] > 100 and box["height"] > 20 for box in curves) >= 3


@pytest.mark.parametrize("width", [1280, 1100, 390])
def test_figures_are_inside_the_window_of_a_screen(opened, width):
    chrome = opened(width)
    for box in chrome.execute_script(BOXES, FIGURES):
        assert box["right"] <= width
    cut = chrome.execute_script(
        "return Array.from(document.querySelectorAll('figure .drawing')).map(e => e.scrollWidth - e.clientWidth)"
    )
    assert max(cut) <= 1


ENLARGED = """
return Array.from(document.querySelectorAll(".inside .drawing")).map(function (box) {
  var svg = box.querySelector("svg"), small = svg.getBoundingClientRect().width;
  box.focus();
  box.scrollLeft = 1e6;
  var large = svg.getBoundingClientRect();
  return {text: 9 * large.width / svg.viewBox.baseVal.width, grown: large.width - small,
    beyond: large.right - box.getBoundingClientRect().right, page: document.documentElement.scrollWidth};
});
"""


def test_figures_wider_than_a_phone_scroll_to_their_end(opened):
    """A figure that is touched is enlarged until its writing, of 9 points, can be read, and scrolls in its box."""
    chrome = opened(390)
    for figure in chrome.execute_script(ENLARGED):
        assert figure["text"] >= 7.0
        assert figure["grown"] > 100
        assert figure["beyond"] <= 1.0
        assert figure["page"] <= 390


def test_figures_of_a_screen_are_not_enlarged(opened):
    chrome = opened(1100)
    for figure in chrome.execute_script(ENLARGED):
        assert figure["grown"] == 0


@pytest.mark.parametrize(("width", "least"), [(1100, 10.0), (390, 5.0)])
def test_writing_in_figures_can_be_read(opened, width, least):
    # Axes are labelled with 9 points; the drawing's own unit is the point.
    pixels = opened(width).execute_script(
        """
        return Array.from(document.querySelectorAll(".drawing svg")).map(
          e => 9 * e.getBoundingClientRect().width / e.viewBox.baseVal.width);
        """
    )
    assert min(pixels) >= least


CONTRAST = """
function light(c) {
  var v = c.map(function (x) { x /= 255; return x <= 0.03928 ? x / 12.92 : Math.pow((x + 0.055) / 1.055, 2.4); });
  return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2];
}
function rgb(text) { return text.match(/[\\d.]+/g).map(Number); }
function ground(e) {
  for (; e; e = e.parentElement) {
    var c = rgb(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0.99) { return c.slice(0, 3); }
  }
  return [255, 255, 255];
}
var low = [], seen = 0;
var walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  var e = walker.currentNode.parentElement;
  if (!walker.currentNode.data.trim() || e.closest("script, style, svg")) { continue; }
  seen += 1;
  var a = light(rgb(getComputedStyle(e).color)), b = light(ground(e));
  var ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  if (ratio < 4.5) { low.push([e.tagName, walker.currentNode.data.trim().slice(0, 30), ratio]); }
}
return {seen: seen, low: low};
"""


def test_writing_stands_out_from_its_ground(opened):
    found = opened().execute_script(CONTRAST)
    assert found["seen"] > 100
    assert found["low"] == []


@pytest.mark.parametrize("width", [1100, 390])
def test_writing_is_large_enough(opened, width):
    sizes = opened(width).execute_script(
        """
        return Array.from(document.querySelectorAll("p, li, td, th, dd, dt, figcaption")).map(
          e => parseFloat(getComputedStyle(e).fontSize));
        """
    )
    assert min(sizes) >= 12


def test_the_table_of_a_phone_scrolls_in_its_own_box(opened):
    chrome = opened(390)
    for box in chrome.execute_script(BOXES, ".scroll"):
        assert box["right"] <= 390
    reached = chrome.execute_script(
        """
        return Array.from(document.querySelectorAll(".scroll")).map(function (box) {
          box.scrollLeft = 1e6;
          return box.querySelector("table").getBoundingClientRect().right - box.getBoundingClientRect().right;
        });
        """
    )
    assert reached
    assert max(reached) <= 1.0


# Sorted

COLUMN = """
var table = document.querySelectorAll("table.metrics")[arguments[0]], column = arguments[1];
return Array.from(table.tBodies[0].rows).map(function (row) {
  return [row.cells[column].dataset.order, row.cells[0].textContent, row.cells[column].textContent.trim()];
});
"""


def rank(order):
    """What a cell says it is, for sorting: numbers, then infinity; nothing where it is undefined."""
    return None if order == "" else math.inf if order == "1e999" else float(order)


def test_each_column_of_numbers_sorts_up_and_down(opened, shown):
    chrome = opened()
    for table, study in enumerate(shown.results["studies"].values()):
        for column, plan in enumerate(study["plans"], 2):
            heading = chrome.find_elements("css selector", "table.metrics")[table].find_elements(
                "css selector", "thead th"
            )[column]
            before = chrome.execute_script(COLUMN, table, column)
            for direction, sign in (("ascending", 1), ("descending", -1)):
                heading.find_element("tag name", "button").click()
                assert heading.get_attribute("aria-sort") == direction
                rows = chrome.execute_script(COLUMN, table, column)
                assert sorted(rows) == sorted(before)
                values = [rank(order) for order, _, _ in rows]
                known = [v for v in values if v is not None]
                assert values[: len(known)] == known, f"undefined cells of {plan} must come last"
                assert known == sorted(known, key=lambda v, s=sign: s * v)


def test_what_never_happens_is_more_than_any_number_and_what_is_undefined_comes_last(opened):
    chrome = opened()
    headings = chrome.find_elements("css selector", "table.metrics thead th")
    heading = next(th for th in headings if th.text.split()[0] == "step")
    button = heading.find_element("tag name", "button")
    column = heading.get_property("cellIndex")
    button.click()
    texts = [text.rstrip(" ▲▽") for _, _, text in chrome.execute_script(COLUMN, 0, column)]
    numbers = [t for t in texts if any(c.isdigit() for c in t)]
    assert "–" in texts
    assert len(numbers) < len(texts)
    undefined = texts.count("–")
    assert texts[-undefined:] == ["–"] * undefined
    endless = len(texts) - len(numbers) - undefined
    assert endless > 0
    assert texts[: len(numbers)] == numbers
    button.click()
    texts = [text.rstrip(" ▲▽") for _, _, text in chrome.execute_script(COLUMN, 0, column)]
    assert texts[endless : endless + len(numbers)] == numbers[::-1]
    assert texts[-undefined:] == ["–"] * undefined


def test_the_names_sort_as_words(opened):
    chrome = opened()
    button = chrome.find_element("css selector", "thead th button")
    given = [name for _, name, _ in chrome.execute_script(COLUMN, 0, 0)]
    button.click()
    assert [name for _, name, _ in chrome.execute_script(COLUMN, 0, 0)] == sorted(given)
    button.click()
    assert [name for _, name, _ in chrome.execute_script(COLUMN, 0, 0)] == sorted(given, reverse=True)


def test_only_the_column_sorted_by_is_marked(opened):
    chrome = opened()
    first, second = chrome.find_elements("css selector", "thead button")[:2]
    first.click()
    second.click()
    marked = chrome.find_elements("css selector", "thead th[aria-sort]")
    assert [th.get_attribute("aria-sort") for th in marked] == ["ascending"]
    assert marked[0].find_element("tag name", "button") == second
    arrow = chrome.execute_script("return getComputedStyle(arguments[0], '::after').content", second)
    assert "↑" in arrow
    second.click()
    assert "↓" in chrome.execute_script("return getComputedStyle(arguments[0], '::after').content", second)


def test_the_keyboard_sorts_too(opened):
    from selenium.webdriver.common.keys import Keys

    chrome = opened()
    button = chrome.find_element("css selector", "thead th button")
    button.send_keys(Keys.ENTER)
    assert len(chrome.find_elements("css selector", "thead th[aria-sort=ascending]")) == 1
    assert chrome.execute_script("return getComputedStyle(arguments[0]).outlineStyle", button) != "none"


def test_rows_stay_whole_when_sorted(opened):
    chrome = opened()
    read = "return Array.from(document.querySelector('table.metrics').tBodies[0].rows).map(r => r.textContent)"
    before = chrome.execute_script(read)
    for button in chrome.find_elements("css selector", "thead button"):
        button.click()
    assert sorted(chrome.execute_script(read)) == sorted(before)


# Printed


def test_on_paper_hints_are_left_out_and_nothing_is_cut(opened):
    chrome = opened(718)  # the width of A4 between its margins, in pixels of CSS
    chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    shown = chrome.execute_script(
        "return Array.from(document.querySelectorAll('.hint, nav')).map(e => getComputedStyle(e).display)"
    )
    assert shown
    assert set(shown) == {"none"}
    for box in chrome.execute_script(BOXES, FIGURES):
        assert box["right"] <= 718
        assert box["height"] <= 1000  # a figure is not broken, so it has to fit one page
    cut = chrome.execute_script(
        "return Array.from(document.querySelectorAll('.scroll, .drawing')).map(e => e.scrollWidth - e.clientWidth)"
    )
    assert max(cut) <= 1
    breaks = chrome.execute_script(
        "return Array.from(document.querySelectorAll('figure, tr')).map(e => getComputedStyle(e).breakInside)"
    )
    assert set(breaks) == {"avoid"}


def test_it_prints(opened):
    chrome = opened()
    made = chrome.execute_cdp_cmd(
        "Page.printToPDF", {"printBackground": False, "paperWidth": 8.27, "paperHeight": 11.69}
    )
    pdf = base64.b64decode(made["data"])
    assert pdf.startswith(b"%PDF-")
    pages = pdf.count(b"/Type /Page\n") or pdf.count(b"/Type /Page ") or pdf.count(b"/Type/Page/")
    sections = len(chrome.find_elements("css selector", "section"))
    assert 2 <= pages <= 9 * sections
