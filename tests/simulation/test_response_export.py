"""Responses as files, read back by the readers of their formats."""

import csv

import control as ct
import numpy as np
import pytest
from scipy.io import loadmat

import ctrlplan as cp

LAG = ct.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]], states=["x"], inputs=["r"], outputs=["y"], name="lag")


def read(path):
    if path.suffix == ".npz":
        with np.load(path) as data:
            return dict(data)
    if path.suffix == ".mat":
        data = {k: v for k, v in loadmat(path, simplify_cells=True).items() if not k.startswith("__")}
        return {k: v if k == "time" else v["signals"]["values"] for k, v in data.items()}
    with path.open(newline="", encoding="utf-8") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize("ending", [".csv", ".mat", ".npz"])
def test_signals_read_back_are_those_of_the_response(ending, tmp_path):
    times = np.linspace(0.0, 3.0, 31)
    response = cp.simulate(LAG, times, cp.Step(1.0))
    assert response.export(str(tmp_path / f"run{ending}")) == tmp_path / f"run{ending}"
    found = read(tmp_path / f"run{ending}")
    assert list(found) == ["time", "y", "r", "x"]
    np.testing.assert_array_equal(found["time"], times)
    np.testing.assert_allclose(found["y"], 1.0 - np.exp(-2.0 * times), rtol=0, atol=1e-12)
    for name, rows in (("y", response.y), ("r", response.u), ("x", response.x)):
        np.testing.assert_array_equal(found[name], rows[0])


def test_signals_of_one_name_are_told_apart(tmp_path):
    system = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], states=["y"], inputs=["y"], outputs=["y"])
    cp.simulate(system, [0.0, 1.0], cp.Step(1.0)).export(tmp_path / "run.csv")
    assert list(read(tmp_path / "run.csv")) == ["time", "y", "input.y", "state.y"]


def test_a_system_without_inputs_and_states(tmp_path):
    plan = cp.PolySpline([cp.Waypoint(0, 0, 0), cp.Waypoint(1, 1, 0)])
    response = cp.simulate(cp.create_source_iosystem(plan), [0.0, 0.5, 1.0])
    response.export(tmp_path / "run.npz")
    found = read(tmp_path / "run.npz")
    assert list(found) == ["time", *response.output_labels]
    np.testing.assert_allclose(found[response.output_labels[0]], [0.0, 0.5, 1.0], atol=1e-15)


def test_what_cannot_be_written(tmp_path):
    response = cp.simulate(LAG, [0.0, 1.0], cp.Step(1.0))
    for name in ("run.c", "run.yaml", "run.cam.csv.x", "run"):
        with pytest.raises(ValueError, match=r"path must end in one of \.csv, \.mat, \.npz, got"):
            response.export(tmp_path / name)
    with pytest.raises(OSError, match="nowhere"):
        response.export(tmp_path / "nowhere" / "run.csv")
    assert list(tmp_path.iterdir()) == []
