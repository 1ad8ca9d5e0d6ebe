"""The paper's studies as the command reproduces them: slow, for the sweep is a real one."""

import re

import numpy as np
import pytest
from drawings import drawn_texts
from linear_table import printed
from scipy.optimize import brentq

import ctrlplan as cp

pytestmark = pytest.mark.slow

PRINTED = {
    "step": printed(5, "step"),
    "trigonometric": printed(5, "trigonometric"),
    "polynomial": printed(5, "quintic"),
}


def step_settles(gain):
    """Last entry of the step response into 2 %: after its last extremum outside, and before the one that follows."""
    wp, wn = np.sqrt(gain - 0.25), np.sqrt(gain)
    outside = np.floor(2 * np.log(50.0) * wp / np.pi)

    def beyond(t):
        return abs(wn / wp * np.exp(-0.5 * t) * np.sin(wp * t + np.arccos(0.5 / wn))) - 0.02

    return brentq(beyond, outside * np.pi / wp, (outside + 1) * np.pi / wp, xtol=1e-14)


@pytest.fixture(scope="module")
def linear(reproduced):
    return reproduced.results["studies"]["linear"]


def test_only_paths_on_stdout_and_progress_on_stderr(reproduced):
    assert reproduced.out.splitlines() == [str(reproduced.folder / n) for n in ("index.html", "results.json")]
    assert sorted(p.name for p in reproduced.folder.iterdir()) == ["index.html", "results.json"]
    assert "ctrlplan: running study linear (1 of 4)" in reproduced.err.splitlines()
    assert "Traceback" not in reproduced.err
    assert "Warning" not in reproduced.err


def test_the_plans_at_gain_5_have_the_printed_metrics(linear):
    assert set(linear["plans"]) == {*PRINTED, "trigonometric, feedforward"}
    for plan, (overshoot, settling) in PRINTED.items():
        found = linear["plans"][plan]["metrics"]
        assert found["overshoot_error"] == pytest.approx(overshoot, rel=1e-5)
        assert found["settling_time"] == pytest.approx(settling, rel=1e-5)


def test_the_sweep_is_arrays_of_one_length(linear):
    gains = linear["sweep"]["gain"]
    assert (gains[0], gains[-1]) == (0.25, 1000.0)
    assert np.all(np.diff(gains) > 0)
    assert set(linear["sweep"]) == {"gain", *PRINTED}
    for plan in PRINTED:
        assert set(linear["sweep"][plan]) == {"overshoot_error", "settling_time"}
        for row in linear["sweep"][plan].values():
            assert len(row) == len(gains)
            assert all(isinstance(value, float) for value in row)


def test_the_sweep_passes_through_the_comparison(linear):
    gains = np.array(linear["sweep"]["gain"])
    after = int(np.searchsorted(gains, 5.0))
    for plan in PRINTED:
        for name, row in linear["sweep"][plan].items():
            between = row[after - 1 : after + 1]
            assert min(between) <= linear["plans"][plan]["metrics"][name] <= max(between)


def test_every_jump_of_the_step_is_located(linear):
    # The n-th extremum of the response leaves 2 % where exp(-n pi/(2 w_p)) = 0.02, w_p^2 = k - 1/4.
    gains, settling = (np.array(row) for row in (linear["sweep"]["gain"], linear["sweep"]["step"]["settling_time"]))
    wp = np.arange(1, 200) * np.pi / (2 * np.log(50.0))
    jumps = 0.25 + wp**2
    jumps = jumps[jumps < 1000.0]
    assert jumps.size == 78
    after = np.searchsorted(gains, jumps)
    spacing = gains[after] / gains[after - 1] - 1.0
    assert spacing.max() <= 1e-3 * (1 + 1e-9)
    assert np.all(settling[after] > settling[after - 1])


def test_the_step_settles_as_its_closed_form_does_at_every_gain(linear):
    gains, settling = linear["sweep"]["gain"][1:], linear["sweep"]["step"]["settling_time"][1:]
    # Beside a jump the response touches the band: its settling time is as the square root of the response's error.
    np.testing.assert_allclose(settling, [step_settles(k) for k in gains], rtol=1e-5)


def test_the_page_says_what_the_paper_says_otherwise(reproduced, read):
    text = read(reproduced.html).words()
    for part in (
        "48 %, 7.6 s, 44 % and 8 s",
        "0.8619 s",
        "7.824 s",
        "a limit of 1 s for the settling time of the plan",
        "Equation (1)",
    ):
        assert part in text
    assert re.search(r"The step settles earlier than the trigonometric plan on \d+ % of the range of gains", text)
    assert "51.065 % at k = 12.50" in text
    assert not re.search(r"at \d+ of \d+ gains|% of the gains", text)  # a refined grid counts some gains twice


def test_figure_1_draws_the_limit_point_and_every_gain_asked_for(reproduced):
    texts = drawn_texts(reproduced.html)
    assert {"step, k → ∞", "trigonometric, k → ∞"} <= set(texts)
    for gain in ("1", "5", "20", "100", "1000"):
        assert gain in texts
    assert "settling time ±2 % [s]" in texts
    assert "overshoot on the tracking error [%]" in texts


def test_the_plans_overshoot_least_where_the_loop_is_stiff(linear):
    for plan in ("trigonometric", "polynomial"):
        assert linear["sweep"][plan]["overshoot_error"][-1] < 1.0
        assert linear["sweep"][plan]["settling_time"][-1] < 0.87
    assert linear["sweep"]["step"]["overshoot_error"][-1] == pytest.approx(95.1535, rel=1e-5)
    loop = cp.plants.integrator_lag_loop(1000.0)
    alone = cp.compare(loop, {"step": cp.Step(1.0)}, np.linspace(0, 20, 8001)).metrics["step"]
    assert linear["sweep"]["step"]["settling_time"][-1] == pytest.approx(alone["settling_time"], rel=1e-12)
