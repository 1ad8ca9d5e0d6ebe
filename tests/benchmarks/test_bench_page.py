"""CPU time of a page compared with saving its figures alone, in one process; the ratio is printed, not asserted.

It should be 2 at most: figures are built, laid out and drawn once, and the page adds texts and tables.
"""

import io
import shutil
import time

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.reports import render_page, shown
from ctrlplan.reports.style import page_style
from ctrlplan.studies import Study

PAINTED = """
const done = arguments[0];
new PerformanceObserver((list, observer) => {
  const first = list.getEntries().find(entry => entry.name === 'first-contentful-paint');
  if (first) { observer.disconnect(); done(first.startTime); }
}).observe({type: 'paint', buffered: true});
"""

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]


@pytest.fixture(scope="module")
def study():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    return Study("bench", "Bench", cp.compare(loop, MOVE, np.linspace(0.0, 20.0, 8001), units={"y": "m", "u": "N"}))


def test_a_page_and_its_figures_alone(benchmark, study, monkeypatch):
    figures = []
    drawn = shown.to_svg
    monkeypatch.setattr(shown, "to_svg", lambda figure, key: (figures.append(figure), drawn(figure, key))[1])
    page = benchmark(render_page, [study], "Bench")
    assert page.count('class="drawing"') == 5
    made = figures[-5:]
    pages, saved = [], []
    for _ in range(5):
        start = time.process_time()
        render_page([study], "Bench")
        pages.append(time.process_time() - start)
        start = time.process_time()
        with page_style():
            for figure in made:
                figure.savefig(io.StringIO(), format="svg")
        saved.append(time.process_time() - start)
    ratio = min(pages) / min(saved)
    print(f"\npage {1e3 * min(pages):.0f} ms, its figures alone {1e3 * min(saved):.0f} ms, ratio {ratio:.2f}")


def test_first_paint(benchmark, study, tmp_path):
    """Time until a browser has painted something of the page; printed, not asserted."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no chromium or no chromedriver on the path")
    page = tmp_path / "index.html"
    page.write_text(render_page([study], "Bench"), encoding="utf-8")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=driver))
    painted = []

    def opened():
        chrome.get(page.as_uri())
        # Paint entries are written after the frame is presented.
        painted.append(chrome.execute_async_script(PAINTED))

    try:
        benchmark.pedantic(opened, rounds=5, warmup_rounds=1)
    finally:
        chrome.quit()
    assert min(painted) > 0.0
    print(
        f"\nfirst paint after {min(painted):.0f} to {max(painted):.0f} ms, page of {page.stat().st_size / 1e3:.0f} kB"
    )
