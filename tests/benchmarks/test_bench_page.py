"""CPU time of a page compared with saving its figures alone, in one process; the ratio is printed, not asserted.

It should be 2 at most: figures are built, laid out and drawn once, and the page adds texts and tables.
"""

import io
import time

import numpy as np
import pytest

import ctrlplan as cp
from ctrlplan.reports import render_page, shown
from ctrlplan.reports.style import page_style
from ctrlplan.studies import Study

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
