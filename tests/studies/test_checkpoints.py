"""Sweeps and draws with a checkpoint: what is stored is not run again, and another study is rejected."""

import json
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from ensemble_cases import same_bits

import ctrlplan as cp

TIMES = np.linspace(0.0, 10.0, 101)
PLANS = {"step": cp.Step(1.0), "ramp": cp.PolySpline([cp.Waypoint(0, 0), cp.Waypoint(1, 1)])}
RATES = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]


def lag(rate):
    return ct.ss([[-rate]], [[rate]], [[1.0]], [[0.0]], inputs="r", outputs="y")


def bent(rate):
    """The same, which only Python runs."""
    return ct.nlsys(lambda t, x, u, p: rate * (float(u[0]) - float(x[0])), None, states=1, inputs="r", outputs="y")


def swept(build, folder=None, values=RATES, **options):
    return cp.sweep(build, values, PLANS, TIMES, progress=False, checkpoint=folder, **options)


def drawn(build, folder=None, rates=RATES, **options):
    return cp.monte_carlo(build, {"rate": rates}, PLANS, TIMES, progress=False, checkpoint=folder, **options)


def same(one, other):
    assert one.values.tolist() == other.values.tolist()
    for plan, rows in one.metrics.items():
        for name, row in rows.items():
            np.testing.assert_array_equal(row, other.metrics[plan][name])


class InTurn:
    """Executor with nothing but submit and result; a task runs when its result is read."""

    def submit(self, function, task):
        return SimpleNamespace(result=lambda: function(task))


class Counted:
    """A builder that records the values it has, and is interrupted at one of them."""

    def __init__(self, build, at=None):
        self.build, self.at, self.built = build, at, []

    def __call__(self, rate):
        if rate == self.at:
            raise KeyboardInterrupt
        self.built.append(rate)
        return self.build(rate)


@pytest.mark.parametrize("build", [lag, bent])
@pytest.mark.parametrize("executor", [None, InTurn])
def test_only_what_is_missing_runs_in_a_second_call(build, executor, tmp_path):
    options = {"executor": executor and executor(), "chunk": 2}
    with pytest.warns(UserWarning, match="the sweep was interrupted"):
        first = swept(Counted(build, at=2.5), tmp_path / "new" / "folder", **options)
    assert first.missing == tuple(rate for rate in RATES if rate not in first.values)
    again = Counted(build)
    found = swept(again, tmp_path / "new" / "folder", **options)
    assert sorted(again.built) == list(first.missing)
    assert found.values.tolist() == RATES
    assert found.missing == ()
    np.testing.assert_allclose(found.metrics["step"]["settling_time"], np.log(50.0) / np.array(RATES), rtol=1e-4)
    third = Counted(build)
    same(found, swept(third, tmp_path / "new" / "folder", **options))
    assert third.built == []


@pytest.mark.slow
def test_draws_are_stored_with_their_signals(tmp_path):
    expected = drawn(lag)
    same_bits(expected, drawn(lag, tmp_path))

    def built_once(rate=0.5):
        if rate != 0.5:
            raise AssertionError("built again")
        return lag(rate)

    same_bits(expected, drawn(built_once, tmp_path, executor=InTurn()))


def test_values_without_a_finite_metric_are_restored(tmp_path):
    rates = [-1.0, 0.5, 1.0]  # the first is unstable: its settling time is infinite
    same(swept(lag, tmp_path, rates), swept(lag, tmp_path, rates))


def test_failures_are_run_again(tmp_path):
    def build(rate):
        if rate == 1.5:
            raise ValueError("none yet")
        return lag(rate)

    assert [f.draw for f in swept(build, tmp_path).failures] == [2]
    again = Counted(lag)
    found = swept(again, tmp_path)
    assert (again.built, found.failures) == ([1.5], ())


def test_a_file_has_a_chunk_and_no_other_file_is_left(tmp_path):
    swept(lag, tmp_path, chunk=3)
    names = sorted(path.name[:17] for path in tmp_path.iterdir())
    assert names == ["outcomes-00000000", "outcomes-00000003", "outcomes-00000006", "study.json"]


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (lambda folder: swept(lag, folder, [0.5, 1.0]), "values"),
        (lambda folder: swept(lag, folder, band=0.05), "band"),
        (lambda folder: swept(lag, folder, measures=["iae"]), "measures"),
        (lambda folder: cp.sweep(lag, RATES, PLANS, TIMES[:-1], progress=False, checkpoint=folder), "timepts"),
        (
            lambda folder: cp.sweep(
                lag, RATES, PLANS | {"step": cp.Step(2.0)}, TIMES, progress=False, checkpoint=folder
            ),
            "plans",
        ),
        (lambda folder: drawn(lag, folder), "kind, draws, loop, values"),
    ],
)
def test_the_checkpoint_of_another_study_is_an_error(other, said, tmp_path):
    swept(lag, tmp_path)
    before = sorted(path.read_bytes() for path in tmp_path.iterdir())
    with pytest.raises(ValueError, match=f"checkpoint must be a folder of the same study, .* in {said}; give a new"):
        other(tmp_path)
    assert sorted(path.read_bytes() for path in tmp_path.iterdir()) == before


def test_outcomes_of_an_unknown_study_are_an_error(tmp_path):
    swept(lag, tmp_path)
    (tmp_path / "study.json").unlink()
    before = sorted(path.read_bytes() for path in tmp_path.iterdir())
    with pytest.raises(ValueError, match=r"checkpoint must have the file study.json .* got outcomes without it in"):
        swept(lag, tmp_path)
    assert sorted(path.read_bytes() for path in tmp_path.iterdir()) == before


def test_draws_of_another_loop_are_an_error(tmp_path):
    drawn(lag, tmp_path)
    with pytest.raises(ValueError, match=r"checkpoint must be a folder of the same study, .* in loop; give a new"):
        drawn(lambda rate: lag(2.0 * rate), tmp_path)


def test_a_damaged_file_is_an_error(tmp_path):
    swept(lag, tmp_path)
    (file,) = tmp_path.glob("outcomes-*.npz")
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"checkpoint must have complete files, got .*outcomes-.*; delete it"):
        swept(lag, tmp_path)
    (tmp_path / "study.json").write_text("{")
    with pytest.raises(ValueError, match=r"checkpoint must have a complete study.json, got "):
        swept(lag, tmp_path)


def test_a_file_of_another_layout_is_an_error(tmp_path):
    """As one of a version that stored a text of numpy."""
    swept(lag, tmp_path)
    (file,) = tmp_path.glob("outcomes-*.npz")
    np.savez(file, outcomes=np.array("[]"), data=np.empty(0))
    with pytest.raises(ValueError, match=r"checkpoint must have complete files, got .*outcomes-.*; delete it"):
        swept(lag, tmp_path)


def test_the_version_is_part_of_the_study(tmp_path):
    swept(lag, tmp_path)
    path = tmp_path / "study.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version of ctrlplan": "0.0.1"}))
    with pytest.raises(ValueError, match="in version of ctrlplan; give a new"):
        swept(lag, tmp_path)


@pytest.mark.parametrize("folder", [3, True, ["a"]])
def test_a_checkpoint_is_a_path(folder):
    with pytest.raises(TypeError, match="checkpoint must be the path of a folder, or None, got"):
        swept(lag, folder)


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match=r"checkpoint must be a folder, got .*file, which is a file; give"):
        swept(lag, tmp_path / "file")


@pytest.mark.parametrize("run", [swept, drawn])
@pytest.mark.parametrize("place", ["file/new", "loop/new"])
def test_a_folder_that_cannot_be_made(run, place, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    built = Counted(lag)
    with pytest.raises(OSError, match=r"checkpoint must be a folder that can be made, .*new: .*; give another path"):
        run((lambda rate=0.5: built(rate)) if run is drawn else built, tmp_path / place)
    assert len(built.built) <= (run is drawn)  # the nominal loop


def test_a_folder_that_cannot_be_written_to_is_enough_for_stored_values(tmp_path, monkeypatch):
    found = swept(lag, tmp_path, RATES[:3])
    study = (tmp_path / "study.json").read_bytes()

    def refused(**options):
        raise PermissionError(13, "Permission denied", str(options["dir"]))

    monkeypatch.setattr("ctrlplan.studies.checkpoint.tempfile.TemporaryFile", refused)
    same(found, swept(lag, tmp_path, RATES[:3]))
    other = tmp_path / "other"
    other.mkdir()
    (other / "study.json").write_bytes(study)
    built = Counted(lag)
    with pytest.raises(PermissionError, match=r"checkpoint must be a folder .*other: Permission denied; give another"):
        swept(built, other, RATES[:3])
    assert built.built == []


class Disk:
    """Disk that is full for some of the files that are written to it."""

    def __init__(self, monkeypatch, full):
        from ctrlplan.studies import checkpoint

        self.write, self.full, self.files = checkpoint.write_bytes, full, 0
        monkeypatch.setattr(checkpoint, "write_bytes", self)

    def __call__(self, path, data):
        self.files += 1
        if self.files in self.full:
            raise OSError(28, "No space left on device", str(path))
        self.write(path, data)


@pytest.mark.parametrize("executor", [None, InTurn])
def test_a_disk_that_is_full_until_the_end_loses_no_result(executor, tmp_path, monkeypatch):
    Disk(monkeypatch, range(2, 100))
    expected = swept(bent)
    with pytest.warns(UserWarning, match="No space left") as said:
        found = swept(bent, tmp_path, chunk=2, executor=executor and executor())
    same(expected, found)
    assert [str(one.message) for one in said] == [
        f"checkpoint {tmp_path} cannot be written (No space left on device): {text}"
        for text in (
            "2 finished values so far are kept in memory; the runs go on, and writing is tried again",
            "5 finished values are not stored; they are run again by a second call",
        )
    ]
    assert all(one.filename == __file__ for one in said)
    monkeypatch.undo()
    again = Counted(bent)
    same(expected, swept(again, tmp_path))
    assert again.built == RATES[2:]


def test_a_disk_that_is_full_for_a_time_keeps_every_value(tmp_path, monkeypatch):
    Disk(monkeypatch, [1])
    with pytest.warns(UserWarning, match=r"cannot be written \(No space left on device\): 2 finished") as said:
        found = swept(bent, tmp_path, chunk=2)
    assert len(said) == 1
    again = Counted(bent)
    same(found, swept(again, tmp_path))
    assert again.built == []


def test_an_interruption_on_a_full_disk_returns_what_is_finished(tmp_path, monkeypatch):
    Disk(monkeypatch, range(1, 100))
    with (
        pytest.warns(UserWarning, match="the sweep was interrupted: 3 of 7"),
        pytest.warns(UserWarning, match="No space left on device.: 3 finished values are not stored"),
    ):
        found = swept(Counted(bent, at=2.0), tmp_path)
    assert found.values.tolist() == RATES[:3]


def test_an_empty_text_is_no_folder(tmp_path, monkeypatch):
    """As of a variable of a job's script that is not set."""
    monkeypatch.chdir(tmp_path)
    for run in (swept, drawn):
        with pytest.raises(ValueError, match="checkpoint must be a folder, got an empty text"):
            run(lag, "")
    assert not list(tmp_path.iterdir())


def test_values_are_stored_without_a_copy_of_the_names_for_each(tmp_path):
    """A number has eight bytes, so that names for each value would be several times as long."""
    rates = np.linspace(0.5, 3.5, 120)
    found = swept(lag, tmp_path, rates)
    (file,) = tmp_path.glob("outcomes-*.npz")
    numbers = sum(row.size for rows in found.metrics.values() for row in rows.values())
    values = rates.size * len(PLANS)
    assert file.stat().st_size <= 8 * numbers + 100 * values + 4000
    same(found, swept(lag, tmp_path, rates))
