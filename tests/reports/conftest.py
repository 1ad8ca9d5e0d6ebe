"""Pages written once: a user's own study, and the paper's studies; and one browser for all of them."""

import io
import json
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from strict import WARNINGS

import ctrlplan as cp
from ctrlplan.cli import main

OWN = """
title = "Hoist & swing <fast>"
author = "A. Hoister & <Sons>"
text = ["Why the move is planned.", "A second & <last> paragraph."]
t_end = 30.0
[units]
y = "m"
u = "N"
[loop]
kind = "linear"
num = [1.0]
den = [1.0, 1.0, 0.0]
gain = 5.0
[[plans]]
family = "step"
[[plans]]
family = "polynomial"
[[plans]]
family = "trigonometric"
alpha = 4.0
[[plans]]
family = "piecewise"
[[plans]]
name = "gentle"
family = "trigonometric"
alpha = 2.0
[[plans]]
name = "mild"
family = "trigonometric"
alpha = 0.5
[[waypoints]]
time = 0.0
y = [0.0, 0.0, 0.0]
[[waypoints]]
time = 6.0
y = [5.0]
[[waypoints]]
time = 10.0
y = [10.0, 0.0, 0.0]
"""


@dataclass(frozen=True)
class Written:
    """What a command wrote, and what it said."""

    name: str
    folder: Path
    out: str
    err: str

    @property
    def html(self):
        return (self.folder / "index.html").read_text(encoding="utf-8")

    @property
    def results(self):
        def forbidden(constant):
            raise AssertionError(f"JSON has no {constant}")

        return json.loads((self.folder / "results.json").read_text(encoding="utf-8"), parse_constant=forbidden)


def run(name, folder, *arguments):
    command = [sys.executable, *WARNINGS, "-m", "ctrlplan", *map(str, arguments), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Written(name, folder, done.stdout, done.stderr)


def reported(name, study, folder):
    """Report of a study file, by the command in this process."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert main(["report", str(study), "--out", str(folder)]) == 0, err.getvalue()
    return Written(name, folder, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def own(tmp_path_factory):
    """A user's own study, reported."""
    place = tmp_path_factory.mktemp("own")
    (place / "hoist.toml").write_text(OWN, encoding="utf-8")
    return reported("own", place / "hoist.toml", place / "report")


@pytest.fixture(scope="session")
def reproduced(tmp_path_factory):
    """The paper's studies, reproduced: half a minute, so that what uses it is slow."""
    return run("reproduced", tmp_path_factory.mktemp("reproduced") / "report", "reproduce")


@pytest.fixture(scope="session")
def unstable(tmp_path_factory):
    """A study of a loop that never settles, with names and a title that need care."""
    place = tmp_path_factory.mktemp("unstable")
    text = OWN.replace("gain = 5.0", "gain = -5.0").replace('"gentle"', "\"a <b> & 'c' --> d\"")
    (place / "a strange name.toml").write_text(text, encoding="utf-8")
    return reported("unstable", place / "a strange name.toml", place / "report")


@pytest.fixture(scope="session", params=["own", "unstable", pytest.param("reproduced", marks=pytest.mark.slow)])
def written(request):
    """Each of them."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def swept():
    """The linear loop over a few gains, two of them close about the first jump of the step's settling time."""
    move = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
    plans = {"step": cp.Step(1.0), "polynomial": cp.PolySpline(move), "trigonometric": cp.TrigSpline(move, alpha=1.0)}
    first = 0.25 + (np.pi / (2 * np.log(50.0))) ** 2  # its first extremum is then just 2 % beyond
    gains = np.union1d(np.geomspace(0.25, 1000, 30), [0.9995 * first, 1.0005 * first, 1, 5, 20, 100])
    times = np.linspace(0, 20, 2001)
    return cp.sweep(build, gains, plans, times, progress=False, parameter="gain")


def build(gain):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


# Reading pages

VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


@dataclass
class Element:
    """One element of a page."""

    tag: str
    attributes: dict
    children: list
    text: str = ""

    def all(self, tag=None, **wanted):
        """Every element below with a tag and attributes; `class_` stands for one class among several."""
        kind = wanted.pop("class_", None)
        for child in self.children:
            if (
                tag in (None, child.tag)
                and (kind is None or kind in child.attributes.get("class", "").split())
                and all(child.attributes.get(k) == v for k, v in wanted.items())
            ):
                yield child
            yield from child.all(tag, **wanted, **({} if kind is None else {"class_": kind}))

    def words(self):
        """All text below, blanks as one."""
        return re.sub(r"\s+", " ", self.text).strip()


class Reader(HTMLParser):
    """Builds the tree, and insists that what is opened is closed."""

    def __init__(self):
        super().__init__()
        self.root = Element("", {}, [])
        self.open = [self.root]
        self.declared = []

    def handle_decl(self, decl):
        self.declared.append(decl)

    def handle_starttag(self, tag, attrs):
        element = Element(tag, dict(attrs), [])
        assert len(element.attributes) == len(attrs), f"an attribute twice in <{tag}> at {self.getpos()}"
        self.open[-1].children.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_startendtag(self, tag, attrs):
        self.open[-1].children.append(Element(tag, dict(attrs), []))

    def handle_endtag(self, tag):
        assert self.open[-1].tag == tag, f"</{tag}> closes <{self.open[-1].tag}> at {self.getpos()}"
        self.open.pop()

    def handle_data(self, data):
        # A script is no text of what is around it.
        for element in self.open[-1:] if self.open[-1].tag in ("script", "style") else self.open:
            element.text += data


@pytest.fixture(scope="session")
def read():
    """Read a page or a part of one into its tree."""
    known = {}

    def tree(html):
        if html not in known:
            reader = Reader()
            reader.feed(html)
            reader.close()
            assert len(reader.open) == 1, f"<{reader.open[-1].tag}> is left open"
            reader.root.attributes["declared"] = reader.declared
            known[html] = reader.root
        return known[html]

    return tree


# Looking at pages

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
)


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A headless Chromium that logs its console and its requests."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip(f"no {'chromium' if binary is None else 'chromedriver'} on the path to look at the page with")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=driver))
    # As a window that has the focus, whichever test is the first.
    chrome.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", {"enabled": True})
    yield chrome
    chrome.quit()
