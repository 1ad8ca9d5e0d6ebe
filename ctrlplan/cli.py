"""The ``ctrlplan`` command: reproduce, online, report, plan. Study files: `ctrlplan.studies.files`."""

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
    """Run the command and return its exit status: 0, or 2 where nothing was written."""
    options = _parser().parse_args(arguments)
    try:
        paths = options.run(options)
    except OSError as error:
        _say(f"--out must be writable, got {options.out}: {error.strerror or error}")
        return 2
    except ValueError as error:
        _say(str(error))
        return 2
    for path in paths:
        _tell(str(path))
    return 0


_PLAN_OUT = (
    "file to write: .json (plans), .csv, .mat, .npz (samples), .yaml (ROS JointTrajectory), .cam.csv, .cam.st (cams), "
    ".ppoly.json (polynomials) or .c (C99)"
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ctrlplan", description="Planned references for control loops, and reports of what they gain over a step."
    )
    parser.add_argument("--version", action="version", version=f"ctrlplan {ctrlplan.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    reproduce = commands.add_parser("reproduce", help="run every study of the paper and write its report")
    reproduce.add_argument("--out", type=Path, default=Path("report"), help="folder to write into (default: report)")
    reproduce.set_defaults(run=_reproduce)

    online = commands.add_parser("online", help="run what is done while the loop runs, and write its report")
    online.add_argument("--out", type=Path, default=Path("online"), help="folder to write into (default: online)")
    online.set_defaults(run=_online)

    report = commands.add_parser("report", help="run a study of your own and write its report")
    report.add_argument("study", type=Path, help="study file (TOML)")
    report.add_argument("--out", type=Path, default=Path("report"), help="folder to write into (default: report)")
    report.set_defaults(run=_report)

    plan = commands.add_parser("plan", help="write only the trajectories of a study")
    plan.add_argument("study", type=Path, help="study file (TOML)")
    plan.add_argument("--out", type=Path, required=True, help=_PLAN_OUT)
    plan.add_argument("--dt", type=float, help="sampling period [s] of sampled files (default: 1001 samples)")
    plan.set_defaults(run=_plan)
    return parser


def _reproduce(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import PAPER

    return _all_of(PAPER, options.out, "Path planning with trigonometric splines: the paper's studies")


def _online(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import ONLINE

    return _all_of(ONLINE, options.out, "On line: planning again, governing, and slowing the clock")


def _all_of(studies: Mapping[str, Callable[..., Study]], folder: Path, title: str) -> list[Path]:
    from ctrlplan.reports import write_report

    found = []
    for name, study in studies.items():
        _say(f"study {name}")
        found.append(study(progress=sys.stderr.isatty()))
    _say("report")
    return write_report(found, folder, title)


def _report(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.reports import write_report

    stated = _stated(options.study)
    _checked_folder(options.out)
    _say(f"study {stated.name}")
    study = stated.run()
    _say("report")
    return write_report([study], options.out, stated.title)


def _plan(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.reports import write_all
    from ctrlplan.studies.plan_files import plan_ending, plan_files
    from ctrlplan.trajectories.export import Options

    wanted = Options(dt=options.dt)
    plan_ending(options.out, wanted)
    stated = _stated(options.study)
    _say(f"plans of {stated.name}")
    return write_all(plan_files(stated, options.out, wanted))


def _stated(path: Path) -> StudyFile:
    """A study file; notices of former names are said in one line each."""
    from ctrlplan.studies.files import load_study

    with warnings.catch_warnings(record=True) as notices:
        warnings.simplefilter("always", FutureWarning)
        stated = load_study(path)
    for notice in notices:
        _say(str(notice.message))
    return stated


def _checked_folder(folder: Path) -> None:
    """Refuse, before any work, a folder that cannot be written."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"--out must be a folder that can be written, got {folder}")


def _say(text: str) -> None:
    """One line on stderr, whatever names are in it."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.splitlines()))
    print(f"ctrlplan: {line}", file=sys.stderr, flush=True)


def _tell(line: str) -> None:
    """One line on stdout, as far as its encoding goes: what was to be written is written by then."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        line.encode(encoding, getattr(sys.stdout, "errors", None) or "strict")
    except UnicodeEncodeError:
        line = line.encode(encoding, "backslashreplace").decode(encoding)
    try:
        print(line, flush=True)
    except OSError:  # nobody reads it, or there is no room for it; what is left of it goes nowhere
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
