"""What print and Jupyter show of every public object: the same content, as text and as HTML."""

import inspect
import math
import re
import sys
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from html.parser import HTMLParser

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ctrlplan as cp
from ctrlplan._display import Displayed, Facts, Table, number, to_html, to_text
from ctrlplan.studies import Study

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
LANE = [cp.Waypoint(0, [0, 0], [20, 0]), cp.Waypoint(1, [20, 3], [20, 0])]
PLANE = [cp.Waypoint(0, [0, 0], 0, 0), cp.Waypoint(10, [20, 0], 0, 0)]
TIMES = np.linspace(0, 10, 201)
VOID = {"br", "img", "meta", "hr"}


def quintic():
    return cp.PolySpline(MOVE)


@cache
def comparison():
    loop = cp.plants.integrator_lag_loop(5.0, outputs=("y", "u"))
    return cp.compare(loop, MOVE, TIMES, units={"y": "m", "u": "N"})


def swept(gain):
    return cp.plants.integrator_lag_loop(gain, outputs=("y", "u"))


def first_order():
    return ct.ss([[-1.0]], [[1.0]], [[-1.0]], [[1.0]], inputs="r", outputs="u", states="y", name="lag")


def pendulum():
    return ct.nlsys(
        lambda t, x, u, params: np.array([x[1], u[0] - np.sin(x[0]) - x[1]]),
        lambda t, x, u, params: x[0],
        inputs="torque", outputs="angle", states=["angle", "speed"], name="pendulum",
    )  # fmt: skip


def logged_move():
    t = np.linspace(0.0, 1.0, 501)
    jet = quintic().jet(t, 1)[:, 0]
    return cp.read_log({"time": t, "u": 2.0 * jet[1], "y": 0.9 * jet[0]})


MADE = {
    "AdmissibleSet": lambda: cp.AdmissibleSet(first_order(), {"u": (-1.0, 1.0)}, 0.1),
    "AlphaChoice": lambda: cp.choose_alpha(MOVE, "peak_jerk"),
    "Avoidance": lambda: cp.avoid(cp.PolySpline(PLANE), [cp.Disc((10.0, 0.0), 1.0)], clearance=0.5),
    "Benefit": lambda: cp.benefit(comparison(), swept(5.0), alphas=[1.0], durations=[1.0]),
    "BlockTraits": lambda: cp.traits_of(cp.create_source_iosystem(quintic(), 2)),
    "Clearance": lambda: cp.clearance(cp.PolySpline(PLANE), [cp.Disc((10.0, 3.0), 1.0)], required=1.5),
    "Clipped": lambda: cp.Clipped(quintic(), 0.0, 0.5),
    "Comparison": comparison,
    "Crane": cp.plants.Crane,
    "DerivedFlatSystem": lambda: cp.flat_system(cp.plants.dc_motor(), "angle"),
    "Disc": lambda: cp.Disc((10.0, 0.0), 1.0),
    "Ensemble": lambda: cp.monte_carlo(swept, cp.draws(4, gain=(1.0, 9.0)), {"a": quintic()}, TIMES, progress=False),
    "Event": lambda: cp.Event("u", low=0.0),
    "Experiment": lambda: cp.Experiment(MOVE, TIMES, measures=["iae"]),
    "Fastest": lambda: cp.fastest(quintic(), {"y_d1": 0.5, "y_d2": 2.0}),
    "FeedforwardFit": lambda: cp.fit_feedforward(logged_move(), quintic(), terms=["velocity", ("spring", np.sin)]),
    "FlatCandidate": lambda: cp.flat_candidates(cp.plants.dc_motor())[0],
    "FlatCheck": lambda: cp.check_flat(cp.plants.dc_motor()),
    "Feedforward": cp.Feedforward,
    "FlatLaw": lambda: cp.FlatLaw([[-1.0, -2.0, -3.0]]),
    "FlatSystem": lambda: cp.plants.Crane().flat_system(),
    "HalfPlane": lambda: cp.HalfPlane((0.0, 1.0), 2.0),
    "Limits": lambda: cp.Limits(high=1.0),
    "Margins": lambda: cp.margins(quintic(), {"y_d1": 1.0, "y_d2": (-5.0, 8.0)}),
    "Measure": lambda: cp.Measure("Error at the end", "{y}", "response", lambda seen: seen.error[:, -1]),
    "Occurrence": lambda: cp.Occurrence(1.5, "u", "above"),
    "MotionProfile": lambda: cp.MotionProfile([0.0, 2.0], [[-0.5]], [[3.0], [1.0]], labels="x"),
    "Optimum": lambda: cp.optimize_waypoints([MOVE[0], cp.Waypoint(0.5, 2), MOVE[1]]),
    "PathPlan": lambda: cp.PathPlan([cp.PolySpline(LANE)], [-1], cp.PolySpline([MOVE[0], cp.Waypoint(8, 1, 0, 0)])),
    "PeakDerivative": lambda: cp.PeakDerivative(3),
    "PiecewiseSpline": lambda: cp.PiecewiseSpline([*MOVE, cp.Waypoint(3, 0, 0, 0)]),
    "PolySpline": quintic,
    "PlannedFeedforward": lambda: cp.create_feedforward_iosystem(
        ct.tf([-1, 1], [1, 2, 1], inputs="r", outputs="y", name="loop"), plan=quintic()
    ),
    "Predictor": lambda: cp.Predictor(pendulum(), {"angle": (-1.0, 1.0)}, 10.0),
    "Stepper": lambda: cp.prepare(swept(5.0)).start(0.1),
    "Prepared": lambda: cp.prepare(swept(5.0)),
    "Rectangle": lambda: cp.Rectangle((0.0, 1.0), (0.0, 1.0)),
    "Region": lambda: cp.Region(("speed", "torque"), [(0, 3), (100, 0), (0, -3), (-100, 0)]),
    "Retimed": lambda: cp.Retimed(quintic(), cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(2, 1)])),
    "SCurve": lambda: cp.SCurve(1.0, velocity=1.0, acceleration=2.0, jerk=10.0),
    "Shaper": lambda: cp.Shaper.zvd(2.0, 0.05),
    "SimulationResponse": lambda: cp.simulate(
        pendulum(), np.linspace(0, 10, 101), cp.Step(0.5), events=[cp.Event("angle", high=0.4)]
    ),
    "SquaredDerivative": lambda: cp.SquaredDerivative(3),
    "Step": lambda: cp.Step(1.0),
    "Study": lambda: Study("servo", "A servo", comparison(), summary="What is compared.", notes=("One finding.",)),
    "Sweep": lambda: cp.sweep(swept, [1.0, 2.0, 5.0], {"a": quintic()}, TIMES, parameter="gain", progress=False),
    "Transition": lambda: cp.Transition(2, 1.0),
    "TVLQR": lambda: cp.TVLQR([[1.0]], [[1.0]]),
    "Trapezoid": lambda: cp.Trapezoid(1.0, velocity=1.0, acceleration=2.0),
    "TrigFamily": lambda: cp.TrigFamily(6, 2.0, alpha=3.0),
    "TrigSpline": lambda: cp.TrigSpline(PLANE, alpha=1.0, labels=["x", "z"]),
    "Waypoint": lambda: cp.Waypoint.from_jets(6.0, x=[5.0, 1.0], z=[None, 0.5]),
}  # fmt: skip
"""One object of each class."""

PLANS = {
    "Clipped",
    "MotionProfile",
    "PathPlan",
    "PiecewiseSpline",
    "PolySpline",
    "Retimed",
    "SCurve",
    "Step",
    "Trapezoid",
    "TrigSpline",
}
IN_JUPYTER = {
    "Waypoint",
    "Comparison",
    "Sweep",
    "Ensemble",
    "AlphaChoice",
    "Optimum",
    "Fastest",
    "Margins",
    "Clearance",
}
IN_JUPYTER |= {
    *PLANS,
    "Crane",
    "FlatSystem",
    "Avoidance",
    "Benefit",
    "SimulationResponse",
    "Experiment",
    "Shaper",
    "FeedforwardFit",
}
DRAWN = {*PLANS, "Fastest", "Optimum", "AlphaChoice", "Avoidance"}

every = pytest.mark.parametrize("name", sorted(MADE))
displayed = pytest.mark.parametrize("name", sorted(IN_JUPYTER))


@cache
def made(name):
    return MADE[name]()


@cache
def html_of(name):
    return made(name)._repr_html_()


class Read(HTMLParser):
    """Elements of a fragment: their tags with the names of attributes, and the text of each that has one."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.texts, self.hidden = [], [], [], 0
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if tag in ("p", "dt", "dd", "td", "th", "caption"):
            self.texts.append("")

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "svg", "figcaption"} & set(self.open) and data.strip():
            self.texts[-1] += data

    def structure(self):
        return [(tag, *attributes) for tag, attributes in self.elements if tag not in ("path", "use", "g", "defs")]


def columns(line):
    """Columns that a terminal needs for a line."""
    return sum(
        0 if unicodedata.combining(letter) else 2 if unicodedata.east_asian_width(letter) in ("W", "F") else 1
        for letter in line
    )


# Every export


def classes():
    found = [value for name in cp.__all__ if inspect.isclass(value := getattr(cp, name))]
    return {kind.__name__ for kind in found if not inspect.isabstract(kind) and not issubclass(kind, Exception)}


def test_every_exported_class_is_printed_here():
    assert {*classes(), "Crane", "FlatSystem", "Study"} == set(MADE)


@pytest.mark.parametrize("start", [0.0, 5e4, 1.7e9])
def test_times_long_after_the_origin_are_told_apart(start):
    """Such as seconds since 1970."""
    plan = cp.PolySpline([cp.Waypoint(start, 0, 0, 0), cp.Waypoint(start + 1.25, 1, 0, 0)])
    first, middle, last = (f"{start + t:.3f}".rstrip("0").rstrip(".") for t in (0.0, 0.625, 1.25))
    assert f"from {first} s to {last} s" in repr(plan)
    assert f"at {middle} s" in repr(cp.margins(plan, {"velocity": 1.0}))
    with pytest.raises(ValueError, match=f"got {first} s after {last} s"):
        plan.breakpoints_between(start + 1.25, start)


@every
def test_repr_is_one_line_with_the_name_of_the_class(name):
    text = repr(made(name))
    assert name.removesuffix("Traits") in text or name == "Study"
    assert "\n" not in text
    assert " at 0x" not in text


@every
def test_print_fits_and_shows_no_address(name):
    text = str(made(name))
    assert " at 0x" not in text
    assert text == "\n".join(line.rstrip() for line in text.split("\n")).strip("\n")
    if isinstance(made(name), Displayed):
        assert max(map(columns, text.split("\n"))) < 100
        assert "\n" in text or name == "BlockTraits"


@every
def test_text_needs_no_figure(name, monkeypatch):
    found = made(name)
    monkeypatch.setitem(sys.modules, "ctrlplan.reports", None)
    monkeypatch.setitem(sys.modules, "ctrlplan.reports.inline", None)
    assert str(found)
    assert repr(found)


# As HTML


@displayed
def test_html_has_the_content_of_the_text(name):
    read, text = Read(html_of(name)), str(made(name))
    close = "".join(text.split())
    for part in read.texts:
        assert "".join(part.split()) in close
    words = {word for part in read.texts for word in part.split()}
    assert set(text.split()) <= words


@displayed
def test_html_is_accessible(name):
    html = html_of(name)
    read = Read(html)
    tags = [tag for tag, _ in read.elements]
    assert tags.count("table") == tags.count("caption")
    assert all("scope" in attributes for tag, attributes in read.elements if tag == "th")
    drawings = [attributes for tag, attributes in read.elements if attributes.get("role") == "img"]
    assert len(drawings) == tags.count("svg") == (name in DRAWN)
    assert all(attributes["aria-label"] for attributes in drawings)
    assert "script" not in tags
    assert tags.count("style") == 1  # of an element inside a drawing it would hold for the whole page
    outside = re.sub(r"<svg.*</svg>", "", html, flags=re.DOTALL)
    assert not re.search(r"#[0-9a-f]{3,6}\b|rgb|(white|black)(?!-)", outside)  # colours are those of the page around


@pytest.mark.parametrize("name", sorted(DRAWN))
def test_figures_leave_nothing_behind(name):
    before, settings = plt.get_fignums(), dict(mpl.rcParams)
    html = made(name)._repr_html_()
    assert plt.get_fignums() == before
    assert dict(mpl.rcParams) == settings
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    assert {*re.findall(r'href="#([^"]+)"', html), *re.findall(r"url\(#([^)]+)\)", html)} <= set(ids)
    assert "currentColor" in html
    assert html_of(name) == html


def test_ids_of_different_figures_differ():
    first, second = (re.findall(r'\bid="([^"]+)"', html_of(name)) for name in ("PolySpline", "SCurve"))
    assert not set(first) & set(second)


@pytest.mark.slow
def test_threads_draw_as_one_does():
    names = ["PolySpline", "Comparison", "TrigSpline"] * 2
    alone = [html_of(name) for name in names]
    settings = dict(mpl.rcParams)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda name: made(name)._repr_html_(), names)) == alone
        assert list(pool.map(lambda name: str(made(name)), names)) == [str(made(name)) for name in names]
    assert dict(mpl.rcParams) == settings
    assert plt.get_fignums() == []


def test_figures_obey_the_settings_of_the_user():
    with mpl.rc_context({"lines.linewidth": 3.25}):
        assert "stroke-width: 3.25" in quintic()._repr_html_()


# Names are text

NAMES = st.text(st.characters(), min_size=1, max_size=80) | st.sampled_from(
    ["<b>", "</td><script>", "&lt;", '"><img src=x>', "\x1b[31m", "a\nb\tc", "\u202egnp", "计划" * 30, "$x$", "\udcff"]
)


@given(NAMES, NAMES, NAMES)
def test_whatever_stands_in_a_cell_is_text(name, value, unit):
    def parts(name, value, unit):
        table = Table(name, (unit, name), [(name, value), (unit, value)], {(0, 1)})
        return [name, value, Facts([(name, value), (unit, "x")]), table, unit]

    read, plain = (Read(to_html(parts(*texts), str)) for texts in ((name, value, unit), ("a", "b", "c")))
    if value.split():
        assert read.structure() == plain.structure()
    text = to_text(parts(name, value, unit))
    assert max(map(columns, text.split("\n"))) < 100
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]", text)
    text.encode()  # a terminal can write it


@given(NAMES.filter(lambda name: "." not in name))
def test_labels_of_a_plan_are_text(label):
    step = cp.Step(1.0, labels=[label])
    parts = [part for part in step._describe() if not hasattr(part, "draw")]
    plain = [part for part in cp.Step(1.0)._describe() if not hasattr(part, "draw")]
    assert Read(to_html(parts, str)).structure() == Read(to_html(plain, str)).structure()
    assert len(repr(step).splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("label", ["<b>", "a & b", '"', "$x$"])
def test_labels_in_a_figure_are_text(label):
    read, plain = (Read(cp.PolySpline(PLANE, labels=[x, "z"])._repr_html_()) for x in (label, "x"))
    assert read.structure() == plain.structure()
    assert label in " ".join(read.texts)


# What is said


def rows(text):
    """Rows of a text as lists of words separated by two blanks or more."""
    return [re.split(r"\s{2,}", line.strip()) for line in text.splitlines()]


def test_a_plan_shows_its_waypoints_and_peaks():
    found = rows(str(quintic()))  # the minimum-jerk move from 0 to 1 in 1 s
    assert found[0] == ["PolySpline of y from 0 s to 1 s"]
    assert ["0", "0, 0, 0"] in found
    assert ["1", "1, 0, 0"] in found
    assert ["peak velocity [1/s]", f"{15 / 8:.4g}"] in found
    assert ["peak acceleration [1/s^2]", f"{10 / math.sqrt(3):.4g}"] in found
    assert ["peak jerk [1/s^3]", "60"] in found


def test_a_peak_above_a_jump_is_infinite():
    """The acceleration of a trapezoidal profile jumps; at the ends of a plan nothing is known of the motion outside."""
    found = rows(str(cp.Trapezoid(1.0, velocity=1.0, acceleration=2.0)))
    assert ["peak acceleration [1/s^2]", "2"] in found
    assert ["peak jerk [1/s^3]", "inf"] in found
    moving = rows(str(cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(4, 4)])))
    assert ["peak acceleration [1/s^2]", "0"] in moving


def test_entries_that_are_free_are_called_so():
    assert rows(str(made("Waypoint")))[-3:] == [["x", "z"], ["position", "5", "free"], ["velocity", "1", "0.5"]]
    plan = cp.TrigSpline([MOVE[0], cp.Waypoint(0.4, math.nan, 2.0), MOVE[1]], alpha=1.0, warn=False)
    assert ["0.4", "free, 2"] in rows(str(plan))


def test_steps_show_when_they_jump():
    assert ["position jumps at", "2 s"] in rows(str(cp.Step(1.0, time=2.0)))
    shaped = rows(str(cp.Shaper.zv(2.0)(cp.Step(1.0))))
    assert ["position jumps at", f"0 s, {math.pi / 2:.6g} s"] in shaped
    assert ["input shaper", "2 impulses"] in shaped


def test_many_waypoints_are_shortened_and_their_peaks_left_out(monkeypatch):
    def peak(self, nu=0):
        raise AssertionError("the peaks of so many segments take too long")

    monkeypatch.setattr(cp.PiecewiseSpline, "peak", peak)
    text = str(cp.PiecewiseSpline([cp.Waypoint(k, k % 2, 0, 0) for k in range(300)]))
    assert "300 waypoints" in text
    assert "call peak(order)" in text
    assert len(text.splitlines()) < 25


@pytest.mark.filterwarnings("ignore:the plan swings")
def test_a_plan_beyond_floating_point_is_printed_all_the_same():
    tiny = cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1e-120, 1e300)])
    assert "n/a" in str(tiny) or "inf" in str(tiny)


def test_fastest_shows_its_limits_and_the_active_one():
    found = rows(str(made("Fastest")))
    assert ["minimum duration", f"{15 / 8 / 0.5:.6g} s"] in found
    assert ["active limit", "y_d1 within ±0.5, at 1.875 s"] in found
    assert ["y_d1", "within ±0.5", "0.5", "1.875", "0 %"] in found
    assert [row[:2] for row in found if row[0] == "y_d2"] == [["y_d2", "within ±2"]]


def test_a_comparison_shows_eight_metrics():
    found = comparison()
    text = str(found)
    head = next(k for k, row in enumerate(rows(text)) if row[0] == "metric")
    table = [row for row in rows(text)[head:] if len(row) > 1]
    assert table[0] == ["metric", "unit", *found.plans]
    assert len(table) <= 9
    titles = {titles_of(name): name for name in found.measures}
    main = {titles_of(name) for name in ("settling_time", "overshoot_error", "control_peak")}
    assert main <= {row[0] for row in table}
    for title, *cells in table[1:]:
        values = [found.metrics[plan][titles[title]] for plan in found.plans]
        shown = [cell.removesuffix("*") for cell in cells[-len(values) :]]
        for value, cell in zip(values, shown, strict=True):
            assert cell == "n/a" if math.isnan(value) else float(cell) == pytest.approx(value, rel=6e-4, abs=1e-8)
        lowest = min(value for value in values if not math.isnan(value))
        if any(cell.endswith("*") for cell in cells):  # the lowest one is the best, in every metric
            assert cells[-len(values) :][values.index(lowest)].endswith("*")


def titles_of(name):
    return comparison().measures[name].title.partition(" (")[0]


def test_metrics_that_coincide_or_do_not_apply_are_left_out():
    step = {"a": cp.Step(1.0), "b": cp.Step(2.0)}
    found = cp.compare(swept(5.0), step, TIMES)
    shown = [row[0] for row in rows(str(found)) if len(row) > 1]
    # Of steps the error's settling time is that of the output, and there is no path.
    assert found.metrics["a"]["tracking_settling_time"] == found.metrics["a"]["settling_time"]
    assert titles_of("settling_time") in shown
    assert titles_of("tracking_settling_time") not in shown
    assert titles_of("wandering") not in shown


def test_measures_of_ones_own_come_first():
    own = cp.Measure("Error at the end", "{y}", "response", lambda seen: np.abs(seen.error[:, -1]))
    found = cp.compare(swept(5.0), MOVE, TIMES, measures={"late": own}, units={"y": "m"})
    head = next(k for k, row in enumerate(rows(str(found))) if row[0] == "metric")
    assert rows(str(found))[head + 1][:2] == ["Error at the end", "m"]


def test_failures_and_reservations_are_printed():
    def build(name, plan):
        if name == "bad":
            raise ValueError("no such loop")
        return swept(5.0)

    found = cp.compare(build, {"good": quintic(), "bad": cp.Step(1.0)}, TIMES)
    assert "no such loop" in str(found)
    assert "(bad failed)" in repr(found)


def test_a_sweep_and_an_ensemble_show_the_range_of_their_metrics():
    found = made("Sweep")
    values = found.metrics["a"]["overshoot_error"]
    assert [titles_of("overshoot_error"), "%", f"{min(values):.4g} to {max(values):.4g}"] in rows(str(found))
    assert ["gain", "1 to 5"] in rows(str(found))
    drawn = made("Ensemble")
    middle = sorted(drawn.metrics["a"]["overshoot_error"])[1]  # the lower median of four
    (row,) = (row for row in rows(str(drawn)) if row[0] == titles_of("overshoot_error"))
    assert row[2].startswith(f"{middle:.4g} (")


def test_no_more_metrics_of_an_ensemble_are_sorted_than_are_shown(monkeypatch):
    computed = []
    found, quantiles = made("Ensemble"), cp.Ensemble.quantiles
    monkeypatch.setattr(cp.Ensemble, "quantiles", lambda self, name: computed.append(name) or quantiles(self, name))
    assert len(rows(str(found))) > 8
    assert 8 <= len(computed) < len(found.nominal.measures)


def test_a_response_shows_method_reason_signals_and_events():
    found = made("SimulationResponse")
    text = " ".join(str(found).split())
    assert f"method {found.method}: {found.reason}" in text
    assert "states angle, speed" in text
    assert "inputs torque" in text
    (row,) = (row for row in rows(str(found)) if row[0] == "angle")
    y = np.asarray(found.outputs).ravel()
    assert row[1:] == [f"{value:.4g}" for value in (y.min(), y.max(), y[-1])]
    assert f"Event at {found.events[0]}" in text


def test_only_our_own_flat_systems_are_shown_so():
    theirs = ct.flatsys.LinearFlatSystem(ct.ss([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]]))
    assert not isinstance(theirs, Displayed)
    assert "Flat" in str(theirs)
    assert ["flat outputs", "x (derivatives up to 4), z (derivatives up to 4)"] in rows(str(made("FlatSystem")))
    assert repr(made("FlatSystem")) == ct.flatsys.FlatSystem.__repr__(made("FlatSystem"))


def test_only_declared_traits_are_shown():
    assert str(cp.traits_of(first_order())) == "BlockTraits: none declared"
    assert {row[0] for row in rows(str(made("BlockTraits")))[1:]} == {"plan", "derivatives"}


def test_objects_as_parameters_of_a_report_stay_in_one_line(tmp_path):
    found = cp.compare(swept(5.0), {"a": quintic()}, TIMES, parameters={"plan": quintic(), "crane": cp.plants.Crane()})
    found.save(tmp_path / "found.json")
    assert "<PolySpline of y from 0 s to 1 s>" in (tmp_path / "found.json").read_text()


def test_a_new_kind_of_trajectory_is_shown_by_what_it_inherits():
    class RampOfAUser(cp.Trajectory):
        def __init__(self):
            self._set_fields(labels=("y",), breakpoints=np.array([0.0, 2.0]))

        def segment_jet(self, segment, s, order):
            return np.stack([3.0 * s, np.full_like(s, 3.0), *[np.zeros_like(s)] * (order - 1)])[: order + 1, None]

        def map_time(self, origin, target, rate):
            return self

        def to_dict(self):
            return {"type": "RampOfAUser"}

        @classmethod
        def from_dict(cls, data):
            return cls()

    assert rows(str(RampOfAUser()))[0] == ["RampOfAUser of y from 0 s to 2 s"]
    assert ["peak velocity [1/s]", "3"] in rows(str(RampOfAUser()))


# Numbers


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0, "", "0"),
        (-0.0, "", "0"),
        (1 / 3, "", "0.3333"),
        (-2.5, "m", "-2.5"),
        (12345.6, "N", "12346"),
        (5e-10, "m", "5e-10"),
        (1.23456e7, "", "1.235e+07"),
        (math.nan, "s", "n/a"),
        (math.inf, "s", "never"),
        (math.inf, "m", "inf"),
        (-math.inf, "s", "-inf"),
    ],
)
def test_numbers_have_four_digits(value, unit, text):
    assert number(value, unit) == text


def test_tables_too_wide_go_on_below():
    heads = ["name", *(f"column {k}" for k in range(30))]
    text = to_text(["Title", Table("Wide", heads, [["row", *map(str, range(30))]])])
    lines = text.splitlines()
    assert max(map(len, lines)) < 100
    assert [line.split()[1:] for line in lines if line.strip().startswith("row")] != []
    shown = [cell for line in lines if line.strip().startswith("row") for cell in line.split()[1:]]
    assert shown == [str(k) for k in range(30)]
