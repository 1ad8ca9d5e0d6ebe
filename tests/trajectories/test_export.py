"""Plans as files of other programs, read back by those programs' own readers or by naive code."""

import csv
import errno
import json
import re
from fractions import Fraction

import numpy as np
import pytest
import yaml
from scipy.interpolate import BPoly, PPoly
from scipy.io import loadmat
from trajectory_oracle import Direct, waypoints

import ctrlplan as cp
from ctrlplan.flatness import FlatSystem
from ctrlplan.trajectories import Trajectory, Waypoint
from ctrlplan.trajectories.export import ENDINGS, TableFormat, cam, cells

PLANE = cp.PolySpline(
    [Waypoint.from_jets(0.5, x=[0, 0, 0], z=[10, 0, 0]), Waypoint.from_jets(2.5, x=[3, 0, 0], z=[8, 0, 0])]
)
TURNED = cp.TrigSpline(waypoints([0.0, 1.0, 3.0], [[0.0, 0.0, 0.0], [2.0], [1.0, 0.0, 0.0]]), alpha=3.0)
CRANE_MOVE = cp.PolySpline(
    [
        Waypoint.from_jets(0.0, x=[0, 0, 0, 0, 0], z=[10, 0, 0, 0, 0]),
        Waypoint.from_jets(15.0, x=[20, 0, 0, 0, 0], z=[11, 0, 0, 0, 0]),
    ]
)
EPS = np.finfo(float).eps


class _Sine(Trajectory):
    """One axis, sin(t) over some seconds, in one segment."""

    def __init__(self, duration, labels=("y",)):
        self._set_fields(labels=tuple(labels), breakpoints=np.array([0.0, duration]))

    def segment_jet(self, segment, s, order):
        return np.sin(s + 0.5 * np.pi * np.arange(order + 1)[:, None, None])

    def map_time(self, origin, target, rate):
        raise NotImplementedError

    def to_dict(self):
        return {"type": "Sine", "duration": self.end}

    @classmethod
    def from_dict(cls, data):
        return cls(data["duration"])


def read_csv(path):
    with open(path, newline="", encoding="utf-8") as file:
        names, *rows = csv.reader(line for line in file if not line.startswith("#"))
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


def read_npz(path):
    with np.load(path) as data:
        return dict(data)


def read_mat(path):
    data = {name: value for name, value in loadmat(path, simplify_cells=True).items() if not name.startswith("__")}
    found = {"time": data.pop("time")}
    for name, signal in data.items():
        np.testing.assert_array_equal(signal["time"], found["time"])
        assert signal["signals"]["dimensions"] == 1
        found[name] = signal["signals"]["values"]
    return found


READERS = {".csv": read_csv, ".npz": read_npz, ".mat": read_mat}
tables = pytest.mark.parametrize("ending", READERS)


# Samples


@tables
def test_samples_are_those_of_the_plan(ending, tmp_path):
    path = tmp_path / f"plan{ending}"
    times = np.array([-1.0, 0.5, 1.7, 2.5, 4.0])
    assert PLANE.export(path, timepts=times, derivatives=1) == (path,)
    found = READERS[ending](path)
    assert list(found) == ["time", "x", "x_d1", "z", "z_d1"]
    np.testing.assert_array_equal(found["time"], times)
    jet = PLANE.jet(times, 1)
    for axis, label in enumerate("xz"):
        np.testing.assert_array_equal(found[label], jet[0, axis])
        np.testing.assert_array_equal(found[f"{label}_d1"], jet[1, axis])


@tables
def test_default_times_are_1001_with_two_derivatives(ending, tmp_path):
    path = tmp_path / f"plan{ending}"
    PLANE.export(str(path))
    found = READERS[ending](path)
    np.testing.assert_array_equal(found["time"], np.linspace(0.5, 2.5, 1001))
    assert list(found)[1:] == ["x", "x_d1", "x_d2", "z", "z_d1", "z_d2"]


@pytest.mark.parametrize(("dt", "last"), [(0.25, 8), (0.3, 7), (2.0, 1), (3.0, 1), (0.1, 20)])
def test_a_sampling_period_reaches_the_end(dt, last, tmp_path):
    """The count is that of rational numbers: 2 s in steps of 0.1 s are 20, though 20 * 0.1 is rounded."""
    assert last == -(-Fraction(2) // Fraction(str(dt)))
    PLANE.export(tmp_path / "plan.csv", dt=dt, derivatives=0)
    np.testing.assert_array_equal(read_csv(tmp_path / "plan.csv")["time"], 0.5 + dt * np.arange(last + 1))


def test_mat_has_the_structure_that_from_workspace_requires(tmp_path):
    path = tmp_path / "plan.mat"
    PLANE.export(path, timepts=[0.5, 1.0, 2.5], derivatives=0)
    signal = loadmat(path)["x"][0, 0]
    assert signal["time"].shape == (3, 1)
    assert signal["signals"][0, 0]["values"].shape == (3, 1)
    assert signal["signals"][0, 0]["dimensions"].tolist() == [[1.0]]


def test_names_in_mat_are_those_of_matlab(tmp_path):
    path = tmp_path / "plan.mat"
    move = cp.PolySpline([Waypoint(0, [0, 0], 0), Waypoint(1, [1, 2], 0)], labels=["joint 1", "2nd"])
    move.export(path, derivatives=1)
    assert list(read_mat(path)) == ["time", "joint_1", "joint_1_d1", "s_2nd", "s_2nd_d1"]
    for labels in (["a b", "a_b"], ["y" * 64, "z"]):
        with pytest.raises(ValueError, match=r"signals must have different names of at most 63 letters.*rename"):
            cp.PolySpline(move.waypoints, labels=labels).export(tmp_path / "no.mat")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("label", ["file", "args", "a/b", "ü", 'say "x", y'])
def test_any_label_is_a_name_in_npz_and_csv(label, tmp_path):
    move = cp.PolySpline(waypoints([0, 1], [[0.0, 0.0], [1.0, 0.0]]), labels=[label])
    for ending in (".npz", ".csv"):
        move.export(tmp_path / f"plan{ending}", timepts=[0.0, 0.5], derivatives=0)
        np.testing.assert_array_equal(READERS[ending](tmp_path / f"plan{ending}")[label], move([0.0, 0.5]))


def test_two_columns_of_one_name_are_rejected(tmp_path):
    move = cp.PolySpline([Waypoint(0, [0, 0], 0), Waypoint(1, [1, 2], 0)], labels=["x", "x_d1"])
    for ending in (".csv", ".mat", ".npz"):
        with pytest.raises(ValueError, match="columns must have different names, got 'x_d1' twice"):
            move.export(tmp_path / f"plan{ending}")
    with pytest.raises(ValueError, match="got 'time' twice"):
        cp.PolySpline(move.waypoints, labels=["x", "time"]).export(tmp_path / "plan.npz")


# States and inputs along the plan


def double_integrator():
    """x'' = u, written by hand."""
    return FlatSystem(
        lambda x, u, params: [np.array([x[0], x[1], u[0]])],
        lambda flag, params: (np.array([flag[0][0], flag[0][1]]), np.array([flag[0][2]])),
        lambda t, x, u, params: [x[1], u[0]],
        lambda t, x, u, params: x[:1],
        orders=[2],
        flat_labels=["y"],
        states=["position", "speed"],
        inputs=["force"],
        outputs=["y"],
        name="double integrator",
    )


FLAT = {
    "crane": (CRANE_MOVE, cp.plants.Crane().flat_system()),
    "by hand": (TURNED, double_integrator()),
    "chain": (TURNED, cp.plants.integrator_chain(3)),
}


@pytest.mark.parametrize(("plan", "flat"), FLAT.values(), ids=FLAT)
@tables
def test_states_and_inputs_read_back_are_those_of_the_flat_system(ending, plan, flat, tmp_path):
    path = tmp_path / f"plan{ending}"
    times = np.linspace(plan.start, plan.end, 7)
    plan.export(path, timepts=times, derivatives=0, flat=flat)
    found = READERS[ending](path)
    x, u = flat.states_and_inputs(plan, times)
    named = [f"state.{name}" if name in plan.labels else name for name in flat.state_labels] + list(flat.input_labels)
    if ending == ".mat":
        named = [name.replace(".", "_") for name in named]
    assert list(found) == ["time", *plan.labels, *named]
    np.testing.assert_array_equal([found[name] for name in named], np.concatenate([x, u]))


def test_effort_in_ros_is_that_of_the_inputs(tmp_path):
    crane = cp.plants.Crane().flat_system()
    CRANE_MOVE.export(tmp_path / "plan.yaml", timepts=[0.0, 5.0, 7.5], flat=crane)
    points = yaml.safe_load((tmp_path / "plan.yaml").read_text())["points"]
    effort = crane.states_and_inputs(CRANE_MOVE, [0.0, 5.0, 7.5])[1]
    np.testing.assert_array_equal([point["effort"] for point in points], effort.T)


def test_effort_must_be_one_number_a_joint(tmp_path):
    plan = cp.stack([TURNED, TURNED], labels=["a", "b"])

    class OneInput:
        state_labels, input_labels = ["x"], ["u"]

        def states_and_inputs(self, plan, timepts):
            return np.zeros((1, len(timepts))), np.zeros((1, len(timepts)))

    with pytest.raises(ValueError, match=r"inputs of the flat system must be one per axis .* 2, got 1: u"):
        plan.export(tmp_path / "plan.yaml", flat=OneInput())


def test_effort_that_is_not_finite_is_not_written(tmp_path):
    class Singular:
        state_labels, input_labels = ["x"], ["u"]

        def states_and_inputs(self, plan, timepts):
            return np.zeros((1, len(timepts))), np.full((1, len(timepts)), np.nan)

    with pytest.raises(ValueError, match="numbers in the file must be finite, got nan"):
        TURNED.export(tmp_path / "plan.yaml", flat=Singular())
    assert list(tmp_path.iterdir()) == []


def test_what_a_flat_system_rejects_is_not_written(tmp_path):
    step = cp.Step([1.0, 2.0], labels=["x", "z"])
    with pytest.raises(ValueError, match="plan must be continuous up to derivative 3"):
        step.export(tmp_path / "plan.csv", timepts=[-1.0, 1.0], flat=cp.plants.Crane().flat_system())
    with pytest.raises(TypeError, match=r"flat must be a flat system with a method states_and_inputs.*got float"):
        PLANE.export(tmp_path / "plan.csv", flat=1.0)
    assert list(tmp_path.iterdir()) == []


# ROS


def test_a_joint_trajectory_is_the_message_of_ros(tmp_path):
    path = tmp_path / "plan.yaml"
    move = cp.PolySpline(PLANE.waypoints, labels=['sh"oulder', "el\nbow 🤖"])
    times = np.array([0.5, 1.0 + 1 / 3, 2.5])
    move.export(path, timepts=times)
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert found["joint_names"] == ['sh"oulder', "el\nbow 🤖"]
    expected = move.jet(times, 2)  # one call for all times: a single time may round otherwise
    for k, point in enumerate(found["points"]):
        assert list(point) == ["positions", "velocities", "accelerations", "time_from_start"]
        for nu, name in enumerate(("positions", "velocities", "accelerations")):
            np.testing.assert_array_equal(point[name], expected[nu, :, k])
    assert [point["time_from_start"] for point in found["points"]] == [
        {"sec": 0, "nanosec": 0},
        {"sec": 0, "nanosec": 833333333},
        {"sec": 2, "nanosec": 0},
    ]


def test_small_numbers_stay_numbers_in_yaml(tmp_path):
    """YAML 1.1 reads 1e-05 as a text."""
    (1e-6 * PLANE).export(tmp_path / "plan.yaml", timepts=[0.7], derivatives=0)
    point = yaml.safe_load((tmp_path / "plan.yaml").read_text())["points"][0]
    assert point["positions"] == (1e-6 * PLANE(np.array([0.7]))[:, 0]).tolist()
    assert "velocities" not in point


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"timepts": [0.0, 1.0]}, "must increase by at least 1 ns from the plan's start at 0.5 s on, got 0 s to 1 s"),
        ({"timepts": [1.0, 1.0]}, "must increase by at least 1 ns"),
        ({"timepts": [1.0, 1.0 + 1e-10]}, "must increase by at least 1 ns"),
        ({"derivatives": 3}, "derivatives must be at most 2 in a JointTrajectory.*got 3"),
    ],
)
def test_what_a_joint_trajectory_cannot_hold(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        PLANE.export(tmp_path / "plan.yaml", **arguments)
    assert list(tmp_path.iterdir()) == []


# Polynomials


def read_ppoly(path):
    data = json.loads(path.read_text())
    return PPoly(np.array(data["c"]), np.array(data["x"]), extrapolate=False), data


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.5, 3.0, 5.0])
def test_polynomials_are_within_the_stated_error_of_the_trigonometric_spline(alpha, tmp_path):
    """Against 50 digits. Derivatives at the anchors have errors of their own: 2e-14 of their size."""
    times, jets = [0.0, 1.0, 3.0], [[0.0, 0.0, 0.0], [2.0], [1.0, 0.0, 0.0]]
    plan = cp.TrigSpline(waypoints(times, jets), alpha=alpha, warn=False)
    plan.export(tmp_path / "plan.ppoly.json", derivatives=3)
    spline, data = read_ppoly(tmp_path / "plan.ppoly.json")
    t = np.linspace(0.0, 3.0, 503)
    exact = Direct(times, jets, alpha).jet(t, 3)
    for nu, name in enumerate(["y", "y_d1", "y_d2", "y_d3"]):
        peak = np.abs(exact[nu]).max()
        assert data["error"][name] <= 1e-13 * peak
        assert np.abs(spline(t, nu)[:, 0] - exact[nu]).max() <= data["error"][name] + 2e-14 * peak


def test_polynomials_of_a_polynomial_have_its_degree(tmp_path):
    PLANE.export(tmp_path / "plan.ppoly.json")
    spline, data = read_ppoly(tmp_path / "plan.ppoly.json")
    assert spline.c.shape[0] == 6
    assert data["labels"] == ["x", "z"]
    assert (spline.x[0], spline.x[-1]) == (0.5, 2.5)
    t = np.linspace(0.5, 2.5, 101)
    for nu in range(3):
        for axis, label in enumerate("xz"):
            bound = data["error"][label + (f"_d{nu}" if nu else "")]
            assert np.abs(spline(t, nu)[:, axis] - PLANE(t, nu)[axis]).max() <= bound + 4 * EPS * PLANE.peak(nu)[axis]


def test_polynomials_of_a_late_plan_keep_its_digits(tmp_path):
    late = TURNED.shift(1e6)
    late.export(tmp_path / "plan.ppoly.json", derivatives=3)
    spline, data = read_ppoly(tmp_path / "plan.ppoly.json")
    t = 1e6 + np.linspace(0.0, 3.0, 1001)
    for nu, name in enumerate(["y", "y_d1", "y_d2", "y_d3"]):
        peak = float(late.peak(nu)[0])
        assert np.abs(spline(t, nu)[:, 0] - late(t, nu)).max() <= data["error"][name] + 2e-14 * peak


@pytest.mark.parametrize("centred", [True, False])
def test_the_bound_of_coarse_cells_holds_and_is_no_larger_than_needed(centred, monkeypatch):
    """Four cells of degree 5 for sin over 2 s; the remainder of a Taylor polynomial is close to its bound."""
    monkeypatch.setattr(cells, "DEGREE", 5)
    monkeypatch.setattr(cells, "_CELLS", 4)
    plan = _Sine(2.0)
    (found,) = cells.cells_of(plan, 3, centred=centred)
    assert found.coefficients.shape == (4, 1, 6)
    s = np.linspace(0.0, 2.0, 4001)
    cell = np.minimum((2.0 * s).astype(int), 3)
    w = (s - found.anchors[cell]) / found.radius
    for nu in range(4):
        polynomials = [np.polynomial.Polynomial(c[0]).deriv(nu) for c in found.coefficients]
        values = np.array([polynomials[k](x) for k, x in zip(cell, w, strict=True)]) / found.radius**nu
        error = np.abs(values - np.sin(s + 0.5 * np.pi * nu)).max()
        assert 0.25 * found.error[nu, 0] <= error <= found.error[nu, 0]


def test_cells_are_as_many_as_floating_point_requires():
    """To the unit roundoff: twice as many would change nothing, half as many are not enough."""
    (found,) = cells.cells_of(_Sine(20.0), 0, centred=True)
    count, unit = found.anchors.size, 0.5 * EPS
    for n, enough in ((count, True), (count // 2, False)):
        assert ((10.0 / n) ** 16 / 20922789888000 <= unit) == enough  # 16!


# Cams


def hermite(table, label):
    """Polynomials of degree 5 between points, by scipy."""
    jets = np.array([table[label], table[f"{label}_d1"], table[f"{label}_d2"]]).T
    return BPoly.from_derivatives(table["master"], jets)


def stated_errors(path):
    line = path.read_text().splitlines()[0]
    return {name: float(error) for name, error in re.findall(r"(\w+) ([\d.e+-]+)(?:,|$)", line)}


def test_the_constants_of_the_error_are_those_of_the_peano_kernel():
    """The largest error for |y6| <= 1 is the integral of the kernel: |(x - s)_+^5 / 5! less its interpolant|."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    nodes, weights, x = 0.5 * (nodes + 1.0), 0.5 * weights, np.linspace(0.0, 1.0, 201)
    total = np.zeros((3, x.size))
    for s, weight in zip(nodes, weights, strict=True):
        ends = [[0.0, 0.0, 0.0], [(1 - s) ** 5 / 120, (1 - s) ** 4 / 24, (1 - s) ** 3 / 6]]
        interpolant = BPoly.from_derivatives([0.0, 1.0], ends)
        for nu, factor in enumerate((120, 24, 6)):
            total[nu] += weight * np.abs(np.clip(x - s, 0.0, None) ** (5 - nu) / factor - interpolant(x, nu))
    # The integrand has kinks: 400 nodes are good to 1e-4.
    np.testing.assert_allclose(total.max(axis=1), cam._HERMITE, rtol=1e-3)


@pytest.mark.parametrize("arguments", [{}, {"dt": 0.25}, {"timepts": [0.0, 0.1, 0.7, 1.1, 2.0, 2.9]}])
def test_a_cam_is_within_the_stated_error_of_the_plan(arguments, tmp_path):
    path = tmp_path / "plan.cam.csv"
    TURNED.export(path, **arguments)
    table, stated = read_csv(path), stated_errors(path)
    assert list(table) == ["master", "y", "y_d1", "y_d2"]
    assert table["master"][0] == TURNED.start
    assert table["master"][-1] == TURNED.end
    np.testing.assert_array_equal([table["y"], table["y_d1"], table["y_d2"]], TURNED.jet(table["master"], 2)[:, 0])
    t, curve = np.linspace(0.0, 3.0, 20001), hermite(table, "y")
    for nu, name in enumerate(["y", "y_d1", "y_d2"]):
        error = np.abs(curve(t, nu) - TURNED(t, nu)).max()
        rounding = 1e-13 * TURNED.peak(nu)[0] / np.diff(table["master"]).min() ** nu
        assert error <= 1.005 * stated[name] + rounding  # three digits are written
        assert error >= 0.1 * stated[name]


def test_points_of_a_cam_are_as_many_as_the_position_requires(tmp_path):
    TURNED.export(tmp_path / "plan.cam.csv")
    extrema = TURNED.extrema()
    wanted = 1e-6 * float(extrema.maximum[0] - extrema.minimum[0])
    assert 0.5 * wanted <= stated_errors(tmp_path / "plan.cam.csv")["y"] <= wanted


@pytest.mark.parametrize(
    "plan",
    [
        cp.Trapezoid(1.0, velocity=1.0, acceleration=2.0),
        cp.Trapezoid([3e-6, 2e-6], velocity=1e-3, acceleration=40.0).shift(7.0),
        cp.PiecewiseSpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0), cp.Waypoint(2, 0.5, 0)]),
        cp.PiecewiseSpline([cp.Waypoint(0, 0, 0), cp.Waypoint(0.3, 40, 90), cp.Waypoint(9, 41, 2)], alpha=2.5),
    ],
)
def test_points_of_a_cam_keep_the_position_where_the_acceleration_jumps(plan, tmp_path):
    plan.export(tmp_path / "plan.cam.csv")
    table, t = read_csv(tmp_path / "plan.cam.csv"), np.linspace(plan.start, plan.end, 100_001)
    for label, values in zip(plan.labels, plan.jet(t, 0)[0], strict=True):
        assert np.abs(hermite(table, label)(t) - values).max() <= 1.001e-6 * np.ptp(values)
    assert table["master"].size < 100


def test_a_jump_of_the_acceleration_is_in_the_error(tmp_path):
    """A cam has one acceleration a point: that after the jump."""
    plan = cp.Trapezoid(3.0, velocity=1.0, acceleration=0.5)
    plan.export(tmp_path / "plan.cam.csv", dt=0.5)
    table, stated = read_csv(tmp_path / "plan.cam.csv"), stated_errors(tmp_path / "plan.cam.csv")
    t, curve = np.linspace(0.0, 5.0, 50001), hermite(table, "y")
    for nu, name in enumerate(["y", "y_d1", "y_d2"]):
        error = np.abs(curve(t, nu) - plan(t, nu))
        if nu == 2:  # at the points themselves the sides differ
            error = error[~np.isin(t, plan.breakpoints)]
        assert 0.99 * stated[name] <= error.max() <= 1.01 * stated[name]


@pytest.mark.parametrize("ending", [".cam.csv", ".cam.st"])
def test_what_no_cam_can_hold(ending, tmp_path):
    path = tmp_path / f"plan{ending}"
    line = cp.PolySpline(waypoints([0, 1], [[0.0], [1.0]]))
    for plan, message in (
        (line + cp.Step(2.0, time=0.5), "position of a cam must be continuous, got a jump of y by 2 at 0.5 s"),
        (line.then(2.0 * line - cp.Step(-1.0, -1.0)), "velocity of a cam must be continuous.*of y by 1 at 1 s"),
        (cp.Step(1.0), "must have a duration, got a step"),
    ):
        with pytest.raises(ValueError, match=message):
            plan.export(path)
    with pytest.raises(ValueError, match=r"timepts of a cam must lie between .* 0 s and end 3 s, got -1 s to 3 s"):
        TURNED.export(path, timepts=[-1.0, 2.0])
    with pytest.raises(ValueError, match=f"derivatives must not be given for {re.escape(ending)}"):
        TURNED.export(path, derivatives=3)
    assert list(tmp_path.iterdir()) == []


def test_structured_text_has_the_points_of_the_table(tmp_path):
    PLANE.export(tmp_path / "plan.cam.csv", dt=0.5)
    PLANE.export(tmp_path / "plan.cam.st", dt=0.5)
    table, text = read_csv(tmp_path / "plan.cam.csv"), (tmp_path / "plan.cam.st").read_text()
    assert text.splitlines()[1] == "VAR_GLOBAL"
    assert text.endswith("END_VAR\n")
    for label in "xz":
        name = rf"cam_{label}"
        points = re.search(rf"{name}_points : ARRAY\[0\.\.4\] OF SMC_CAMXYVA := \[(.*?)\];", text, re.DOTALL)[1]
        number = r"(-?\d+\.\d+(?:e[+-]\d+)?)"
        rows = re.findall(rf"\(dX := {number}, dY := {number}, dV := {number}, dA := {number}\)", points)
        columns = [table[key] for key in ("master", label, f"{label}_d1", f"{label}_d2")]
        np.testing.assert_array_equal(np.array(rows, dtype=float).T, columns)
        whole = rf"{name} : MC_CAM_REF := \(byType := 3, xStart := 0\.5, xEnd := 2\.5, nElements := 5, "
        assert re.search(whole + rf"pce := ADR\({name}_points\)\);", text)


def test_names_in_structured_text_are_those_of_the_language(tmp_path):
    points = [Waypoint(0, [0, 0], 0), Waypoint(1, [1, 2], 0)]
    cp.PolySpline(points, labels=["joint 1", "é__*)"]).export(tmp_path / "plan.cam.st")
    text = (tmp_path / "plan.cam.st").read_text(encoding="utf-8")
    assert re.findall(r"(\w+) : MC_CAM_REF", text) == ["cam_joint_1", "cam"]
    assert text.count("*)") == 1
    with pytest.raises(ValueError, match="axes must have different names in structured text"):
        cp.PolySpline(points, labels=["a", "A"]).export(tmp_path / "no.cam.st")
    with pytest.raises(ValueError, match="a cam of CODESYS must have at most 32767 points, got 40001"):
        TURNED.export(tmp_path / "no.cam.st", timepts=np.linspace(0, 3, 40001))


# A format of one's own


class _Lines(TableFormat):
    """One line a signal."""

    def encoded(self, table):
        return "".join(f"{name} {row[-1]}\n" for name, row in zip(table.names, table.rows, strict=True))


def test_a_format_of_ones_own_is_one_class_and_one_entry(tmp_path, monkeypatch):
    monkeypatch.setitem(ENDINGS, ".lines", _Lines())
    PLANE.export(tmp_path / "plan.lines", derivatives=0)
    assert (tmp_path / "plan.lines").read_text() == "x 3.0\nz 8.0\n"
    cp.simulate(cp.create_source_iosystem(PLANE), [0.5, 2.5]).export(tmp_path / "run.lines")
    assert (tmp_path / "run.lines").read_text() == "x 3.0\nz 8.0\n"


# Requests that cannot be met


def test_an_unknown_ending_names_those_that_are_known(tmp_path):
    for name in ("plan.txt", "plan", "plan.csv.zip", "plan.json", ".csv"):
        with pytest.raises(ValueError, match=r"path must end in one of \.csv, \.mat.*, got .*" + re.escape(name)):
            PLANE.export(tmp_path / name)
    PLANE.export(tmp_path / "PLAN.CSV", derivatives=0)
    assert read_csv(tmp_path / "PLAN.CSV").keys() == {"time", "x", "z"}


@pytest.mark.parametrize(
    ("ending", "arguments", "message"),
    [
        (".csv", {"dt": 0.1, "timepts": [0.0]}, "dt and timepts must not be given together, got both"),
        (".csv", {"dt": 0.0}, "dt must be finite and above 0, got 0"),
        (".csv", {"dt": 1e-9}, "dt must give at most 100000000 samples, got 2e\\+09 with dt = 1e-09 s"),
        (".csv", {"timepts": 0.1}, "timepts must be sample times of shape"),
        (".csv", {"derivatives": -1}, "derivatives must be an integer of at least 0, got -1"),
        (".c", {"dt": 0.1}, r"dt must not be given for \.c \(only for \.csv.*\), got 0.1"),
        (".ppoly.json", {"timepts": [0.0]}, r"timepts must not be given for \.ppoly\.json"),
        (".c", {"flat": FLAT["crane"][1]}, r"flat must not be given for \.c"),
        (".c", {"derivatives": 9}, "derivatives of a plan in polynomials must be at most 8, got 9"),
        (".ppoly.json", {"derivatives": 9}, "must be at most 8, got 9"),
    ],
)
def test_arguments_that_contradict(ending, arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        PLANE.export(tmp_path / f"plan{ending}", **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_folder_that_is_not_there_and_a_full_disk(ending, tmp_path, monkeypatch):
    with pytest.raises(OSError, match="nowhere"):
        PLANE.export(tmp_path / "nowhere" / f"plan{ending}")
    path = tmp_path / f"plan{ending}"
    path.write_text("before")

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        PLANE.export(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("ending", [".c", ".ppoly.json"])
def test_polynomials_beyond_floating_point_are_rejected(ending, tmp_path):
    with pytest.raises(ValueError, match=r"derivatives up to 16 must stay within floating point.*choose a time unit"):
        TURNED.retime(1e-30).export(tmp_path / f"plan{ending}")
    with pytest.raises(ValueError, match="must have a duration, got a step"):
        cp.Step(1.0).export(tmp_path / f"plan{ending}")
    assert list(tmp_path.iterdir()) == []
