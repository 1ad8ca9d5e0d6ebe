"""Plans as C99, compiled and compared with Python."""

import ctypes
import shutil
import subprocess
import sys

import numpy as np
import pytest
from trajectory_oracle import waypoints

import ctrlplan as cp
from ctrlplan.trajectories import Waypoint

GCC = shutil.which("gcc")
pytestmark = pytest.mark.skipif(GCC is None, reason="gcc is not installed")
FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]

RNG = np.random.default_rng(7)
REST = [0.0] * 6
PLANS = {
    "degree 11": cp.PolySpline([Waypoint(0.0, [0, 1], 0, 0, 0, 0), Waypoint(1.0, [2, 1.3], 0, 0, 0, 0)]),
    "12 constraints": cp.PolySpline([Waypoint(3.0 * k, *RNG.normal(size=(3, 2))) for k in range(4)], warn=False),
    "degree 39": cp.PolySpline(waypoints(np.linspace(0, 1, 10), [[0.1 * i, 0.5, 0, 0] for i in range(10)]), warn=False),
    "trigonometric": cp.TrigSpline(waypoints([0.0, 1.0, 3.0], [[0, 0, 0], [2.0], [1, 0, 0]]), alpha=3.0),
    "late": cp.TrigSpline(waypoints([0.0, 1.0, 3.0], [[0, 0, 0], [2.0], [1, 0, 0]]), alpha=5.0, warn=False).shift(1e6),
    "piecewise": cp.PiecewiseSpline(
        [Waypoint.from_jets(t, x=[x], z=[z]) for t, x, z in ((0, 0, 9), (1, 3, 8), (2.7, 1, 12), (3, 0, 11))], alpha=1.0
    ),
    "s-curve": cp.SCurve([4.0, -1.0], velocity=1.0, acceleration=0.5, jerk=0.5, time=-3.0),
    "shaped": cp.Shaper.zvd(3.0, 0.1)(cp.SCurve(4.0, velocity=1.0, acceleration=0.5, jerk=0.5)),
    "retimed": cp.Retimed(
        cp.TrigSpline(waypoints([0.0, 1.0, 3.0], [[0, 0, 0], [2.0], [1, 0, 0]]), alpha=2.0),
        cp.SCurve(3.0, velocity=1.0, acceleration=0.5, jerk=0.5),
    ),
    "joined": cp.Trapezoid(1.0, velocity=1, acceleration=1).then(cp.Trapezoid(3.0, 1.0, velocity=2, acceleration=1)),
    "step at the end": cp.PolySpline(waypoints([0, 1], [REST, [1.0, *REST[1:]]])) + cp.Step(1.0, time=1.0),
    "one axis at rest": cp.PolySpline([Waypoint(0, [0, 5], 0, 0), Waypoint(0.01, [1, 5], 0, 0)]),
}


LOOP = """
#include "plan.h"

void jets(const double *times, int count, double out[][PLAN_DERIVATIVES + 1][PLAN_AXES])
{
    for (int i = 0; i < count; i++) {
        plan_jet(times[i], out[i]);
    }
}
"""


class Compiled:
    """Functions of an exported plan, with a loop over times."""

    def __init__(self, plan, folder, derivatives):
        self.shape = (derivatives + 1, plan.naxes)
        source, header = plan.export(folder / "plan.c", derivatives=derivatives)
        assert header == folder / "plan.h"
        (folder / "loop.c").write_text(LOOP)
        subprocess.run([GCC, *FLAGS, "-shared", "-fPIC", source, "loop.c", "-o", "plan.so"], cwd=folder, check=True)
        code = ctypes.CDLL(str(folder / "plan.so"))
        self._jets, self._jetf, self.segment, self.segment_start = (
            getattr(code, name) for name in ("jets", "plan_jetf", "plan_segment", "plan_segment_start")
        )
        self._jets.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p]
        self._jetf.argtypes = [ctypes.c_int, ctypes.c_float, ctypes.c_void_p]
        self.segment.argtypes, self.segment_start.restype = [ctypes.c_double], ctypes.c_double

    def jet(self, times):
        out = np.empty((len(times), *self.shape))
        self._jets(times.ctypes.data, len(times), out.ctypes.data)
        return out.transpose(1, 2, 0)

    def jetf(self, segments, s):
        out = np.empty((len(s), *self.shape), dtype=np.float32)
        for k, t, row in zip(segments.tolist(), s.tolist(), out, strict=True):
            self._jetf(k, t, row.ctypes.data)
        return out.transpose(1, 2, 0)


@pytest.fixture(scope="module", params=PLANS, ids=PLANS)
def pair(request, tmp_path_factory):
    plan = PLANS[request.param]
    return plan, Compiled(plan, tmp_path_factory.mktemp("c"), 3)


def ranges(plan, order):
    found = [plan.extrema(k) for k in range(order + 1)]
    return np.array([e.maximum - e.minimum for e in found])[:, :, None]


def test_each_derivative_is_that_of_python(pair):
    """To 1e-12 of its range at 10^5 times, breakpoints and times outside included."""
    plan, compiled = pair
    inside = RNG.uniform(plan.start, plan.end, 99_000)
    outside = np.concatenate([plan.start - RNG.uniform(0, 9, 400), plan.end + RNG.uniform(0, 9, 400)])
    times = np.concatenate([inside, outside, np.repeat(plan.breakpoints, 200 // plan.breakpoints.size + 1)])
    assert times.size >= 99_900
    error = np.abs(compiled.jet(times) - plan.jet(times, 3))
    allowed = 1e-12 * ranges(plan, 3)
    allowed[0] += 4.0 * np.finfo(float).eps * np.abs(plan.extrema().maximum)[:, None]  # rounding, far from 0
    assert (error <= allowed).all()


def test_single_precision_by_segment_and_time(pair):
    plan, compiled = pair
    durations = np.diff(plan.breakpoints)
    segments = RNG.integers(0, durations.size, 5_000)
    s = np.minimum(RNG.uniform(0.0, durations[segments]), durations[segments]).astype(np.float32)
    found = compiled.jetf(segments, s)
    size = ranges(plan, 0)[0]
    for segment in range(durations.size):
        own = segments == segment
        exact = plan.segment_jet(segment, s[own].astype(float), 0)[0]
        offset = np.abs(exact).max(axis=1, keepdims=True)  # a float itself rounds a position by 6e-8 of its size
        assert (np.abs(found[0][:, own] - exact) <= np.maximum(1e-6 * size, 6e-8 * offset)).all()
        assert compiled.segment_start(segment) == plan.breakpoints[segment]


def test_segments_are_those_of_the_breakpoints(pair):
    plan, compiled = pair
    times = np.concatenate([plan.breakpoints, RNG.uniform(plan.start, plan.end, 100), [plan.start - 1, plan.end + 1]])
    expected = [sum(b <= t for b in plan.breakpoints[1:-1]) for t in times]
    assert [compiled.segment(t) for t in times.tolist()] == expected


def test_a_segment_that_does_not_exist_is_the_nearest(pair):
    plan, compiled = pair
    last = plan.breakpoints.size - 2
    asked = np.array([-5, 2**30]), np.array([0.0, 0.0], dtype=np.float32)
    np.testing.assert_array_equal(compiled.jetf(*asked), compiled.jetf(np.array([0, last]), asked[1]))
    assert np.isnan(compiled.jet(np.array([np.nan]))).any()


@pytest.mark.parametrize("derivatives", [0, 1, 5])
def test_other_numbers_of_derivatives(derivatives, tmp_path):
    plan = PLANS["trigonometric"]
    times = np.linspace(-1.0, 4.0, 501)
    error = np.abs(Compiled(plan, tmp_path, derivatives).jet(times) - plan.jet(times, derivatives))
    assert (error <= 1e-12 * ranges(plan, derivatives)).all()


@pytest.mark.parametrize("name", ["2nd move", "int", "_x", "über-plan"])
def test_any_file_name_gives_a_name_of_c(name, tmp_path):
    plan = cp.PolySpline([Waypoint(0, [0, 0], 0), Waypoint(1, [1, 2], 0)], labels=["*/ x", 'a"\n\\'])
    source, header = plan.export(tmp_path / f"{name}.c")
    assert header.name == f"{name}.h"
    subprocess.run([GCC, *FLAGS, "-c", source, "-o", tmp_path / "plan.o"], check=True)


def test_the_header_states_the_bound_of_the_error(tmp_path):
    _, header = PLANS["trigonometric"].export(tmp_path / "plan.c", derivatives=2)
    lines = [line.split() for line in header.read_text().splitlines() if line.startswith(" *   ")]
    stated = {name: float(bound) for _, name, bound in lines}
    for k, name in enumerate(["y:", "y_d1:", "y_d2:"]):
        assert 0.0 < stated[name] <= 1e-13 * PLANS["trigonometric"].peak(k)[0]


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_the_header_is_one_of_cpp_too(tmp_path):
    _, header = PLANS["degree 11"].export(tmp_path / "plan.c")
    (tmp_path / "main.cpp").write_text(f'#include "{header.name}"\nint main() {{ return plan_segment(0.0); }}\n')
    subprocess.run(["g++", *FLAGS[2:], "-c", "main.cpp"], cwd=tmp_path, check=True)


def test_no_function_of_a_library_is_called(tmp_path):
    source, _ = PLANS["degree 11"].export(tmp_path / "plan.c")
    subprocess.run([GCC, *FLAGS, "-ffreestanding", "-c", source, "-o", tmp_path / "plan.o"], check=True)
    nm = shutil.which("nm")
    if nm is None or sys.platform != "linux":
        pytest.skip("nm is not installed")
    undefined = subprocess.run([nm, "-u", tmp_path / "plan.o"], check=True, capture_output=True, text=True).stdout
    assert {name.split()[-1] for name in undefined.splitlines()} <= {"_GLOBAL_OFFSET_TABLE_"}


def test_coefficients_beyond_single_precision_are_rejected(tmp_path):
    with pytest.raises(ValueError, match=r"must lie within single precision for C, got .* up to 3\.33e\+50"):
        (1e50 * PLANS["trigonometric"]).export(tmp_path / "plan.c")
    assert list(tmp_path.iterdir()) == []
