"""Command-line interface ``ctrlplan``: reproduce, online, report, plan. Study files: `ctrlplan.studies.files`."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import ctrlplan

if TYPE_CHECKING:
    from ctrlplan.studies.files import StudyFile
    from ctrlplan.studies.study import Study


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, or 2 on an error, with nothing written."""
    options = _parser().parse_args(arguments)
    try:
        paths = options.run(options)
    except OSError as error:
        _print_status(f"--out must be writable, got {options.out}: {error.strerror or error}")
        return 2
    except ValueError as error:
        _print_status(str(error))
        return 2
    for path in paths:
        _print_result(str(path))
    return 0


_PLAN_OUT = (
    "output file: .json (plans), .csv, .mat, .npz (samples), .yaml (ROS JointTrajectory), .cam.csv, .cam.st (cams), "
    ".ppoly.json (polynomials) or .c (C99)"
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ctrlplan",
        description="Plan reference trajectories for a closed loop, and report their benefit over a step.",
    )
    parser.add_argument("--version", action="version", version=f"ctrlplan {ctrlplan.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    reproduce = commands.add_parser("reproduce", help="run all studies of the paper and write a report")
    reproduce.add_argument("--out", type=Path, default=Path("report"), help="output folder (default: report)")
    reproduce.set_defaults(run=_reproduce)

    online = commands.add_parser("online", help="run the studies of on-line methods and write a report")
    online.add_argument("--out", type=Path, default=Path("online"), help="output folder (default: online)")
    online.set_defaults(run=_online)

    report = commands.add_parser("report", help="run the study of a study file and write a report")
    report.add_argument("study", type=Path, help="study file (TOML)")
    report.add_argument("--out", type=Path, default=Path("report"), help="output folder (default: report)")
    report.set_defaults(run=_report)

    plan = commands.add_parser("plan", help="write the trajectories of a study file, without simulation")
    plan.add_argument("study", type=Path, help="study file (TOML)")
    plan.add_argument("--out", type=Path, required=True, help=_PLAN_OUT)
    plan.add_argument("--dt", type=float, help="sampling period [s] of sampled files (default: 1001 samples)")
    plan.set_defaults(run=_plan)
    return parser


def _reproduce(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import PAPER

    return _all_of(PAPER, options.out, "Path planning with trigonometric splines: studies of the paper")


def _online(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import ONLINE

    return _all_of(ONLINE, options.out, "On-line methods: replanning, reference governor, time scaling")


def _all_of(studies: Mapping[str, Callable[..., Study]], folder: Path, title: str) -> list[Path]:
    from ctrlplan.reports import write_report

    found = []
    for name, study in studies.items():
        _print_status(f"running study {name}")
        found.append(study(progress=sys.stderr.isatty()))
    _print_status("writing the report")
    return write_report(found, folder, title)


def _report(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.reports import write_report

    study_file = _loaded(options.study)
    _checked_folder(options.out)
    _print_status(f"running study {study_file.name}")
    study = study_file.run()
    _print_status("writing the report")
    return write_report([study], options.out, study_file.title, study_file.author)


def _plan(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.reports import write_all
    from ctrlplan.studies.plan_files import plan_ending, plan_files
    from ctrlplan.trajectories.export import Options

    wanted = Options(dt=options.dt)
    plan_ending(options.out, wanted)
    study_file = _loaded(options.study)
    _print_status(f"writing the plans of {study_file.name}")
    return write_all(plan_files(study_file, options.out, wanted))


def _loaded(path: Path) -> StudyFile:
    """A study file; warnings about former names are printed in one line each."""
    from ctrlplan.studies.files import load_study

    with warnings.catch_warnings(record=True) as notices:
        warnings.simplefilter("always", FutureWarning)
        study_file = load_study(path)
    for notice in notices:
        _print_status(str(notice.message))
    return study_file


def _checked_folder(folder: Path) -> None:
    """Raise if a folder cannot be written, before any computation."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"--out must be a writable folder, got {folder}")


def _print_status(text: str) -> None:
    """Print one line on stderr, with unprintable characters escaped."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.splitlines()))
    print(f"ctrlplan: {line}", file=sys.stderr, flush=True)


def _print_result(line: str) -> None:
    """Print one line on stdout, with characters escaped that its encoding lacks."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        line.encode(encoding, getattr(sys.stdout, "errors", None) or "strict")
    except UnicodeEncodeError:
        line = line.encode(encoding, "backslashreplace").decode(encoding)
    try:
        print(line, flush=True)
    except OSError:  # closed pipe or full disk: the files are written, and the rest of the output is discarded
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
