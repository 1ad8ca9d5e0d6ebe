"""Command-line interface ``ctrlplan``: reproduce, online, new, report, plan. Study files: `ctrlplan.studies.files`."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import ctrlplan

if TYPE_CHECKING:
    Add: TypeAlias = Callable[..., argparse.Action]
    Commands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]

    from ctrlplan.studies.files import StudyFile
    from ctrlplan.studies.study import Study


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, or 2 on an error, with nothing written."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser(given).parse_args(given)
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


_NEW = "new"

_PLAN_OUT = (
    "output file: .json (plans), .csv, .mat, .npz (samples), .yaml (ROS JointTrajectory), .cam.csv, .cam.st (cams), "
    ".ppoly.json (polynomials) or .c (C99)"
)


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ctrlplan",
        description="Plan reference trajectories for a closed loop, and report their benefit over a step.",
        epilog="""examples:
  ctrlplan new crane.toml --kind crane      # a commented study file
  ctrlplan report crane.toml --out report   # its report, report/index.html
  ctrlplan plan crane.toml --out plan.csv   # its plans alone
  ctrlplan COMMAND --help                   # options and an example of each command""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"ctrlplan {ctrlplan.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_own_studies(commands)
    _add_study_files(commands, given)
    return parser


def _command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], list[Path]], text: str, epilog: str
) -> Add:
    """Add a command, with an example in its help; returned: the function that adds an argument."""
    added = commands.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}.",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.set_defaults(run=run)
    return added.add_argument


def _add_own_studies(commands: Commands) -> None:
    add = _command(
        commands,
        "reproduce",
        _reproduce,
        "run all studies of the paper and write a report",
        "example:\n  ctrlplan reproduce --out report   # some minutes; then open report/index.html",
    )
    add("--out", type=Path, default=Path("report"), help="output folder (default: report)")

    add = _command(
        commands,
        "online",
        _online,
        "run the studies of on-line methods and write a report",
        "example:\n  ctrlplan online --out online   # then open online/index.html",
    )
    add("--out", type=Path, default=Path("online"), help="output folder (default: online)")


def _add_study_files(commands: Commands, given: Sequence[str]) -> None:
    kinds, epilog = _new_kinds() if given[:1] == [_NEW] else ((), "")
    add = _command(commands, _NEW, _new, "write a commented study file to start from", epilog)
    add("out", type=Path, metavar="STUDY", help="new study file, ending in .toml; a file that exists is not replaced")
    add("--kind", choices=kinds, default="linear", help="kind of study (default: linear)")

    add = _command(
        commands,
        "report",
        _report,
        "run the study of a study file and write a report",
        "example:\n  ctrlplan new wall.toml --kind obstacles\n  ctrlplan report wall.toml --out report",
    )
    add("study", type=Path, help="study file (TOML)")
    add("--out", type=Path, default=Path("report"), help="output folder (default: report)")

    add = _command(
        commands,
        "plan",
        _plan,
        "write the trajectories of a study file, without simulation",
        "examples:\n  ctrlplan plan wall.toml --out plan.csv --dt 0.01\n  ctrlplan plan wall.toml --out move.c",
    )
    add("study", type=Path, help="study file (TOML)")
    add("--out", type=Path, required=True, help=_PLAN_OUT)
    add("--dt", type=float, help="sampling period [s] of sampled files (default: 1001 samples)")


def _new_kinds() -> tuple[tuple[str, ...], str]:
    """Kinds of new study files, and their purposes with an example for the help."""
    from ctrlplan.studies.new import study_kinds, study_purpose
    from ctrlplan.studies.schema import SCHEMA

    kinds = study_kinds()
    rows = "\n".join(f"  {kind:<10} {study_purpose(kind)}" for kind in kinds)
    example = "example:\n  ctrlplan new crane.toml --kind crane\n  ctrlplan report crane.toml --out report"
    return kinds, f"kinds:\n{rows}\n\n{example}\n\nJSON Schema of study files for editors:\n  {SCHEMA}"


def _new(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.studies.new import new_study

    return new_study(options.out, options.kind)


def _reproduce(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import PAPER
    from ctrlplan.symbolic import missing_casadi

    reason = missing_casadi()
    if reason:
        _print_status(f"the crane is simulated by Python, which takes ten times as long: {reason}")
    return _all_of(PAPER, options.out, "Path planning with trigonometric splines: studies of the paper")


def _online(options: argparse.Namespace) -> list[Path]:
    _checked_folder(options.out)
    from ctrlplan.studies import ONLINE

    return _all_of(ONLINE, options.out, "On-line methods: replanning, reference governor, time scaling")


def _all_of(studies: Mapping[str, Callable[..., Study]], folder: Path, title: str) -> list[Path]:
    from ctrlplan.reports import write_report
    from ctrlplan.simulation.built_forms import shared_forms
    from ctrlplan.studies.progress import bars_over_plans

    found = []
    with shared_forms():  # studies of one plant have equal loops
        for i, (name, study) in enumerate(studies.items()):
            _print_status(f"running study {name} ({i + 1} of {len(studies)})")
            with bars_over_plans(sys.stderr.isatty()):
                found.append(study(progress=sys.stderr.isatty()))
    _print_status("writing the report")
    return write_report(found, folder, title)


def _report(options: argparse.Namespace) -> list[Path]:
    from ctrlplan.reports import write_report
    from ctrlplan.studies.progress import bars_over_plans

    study_file = _loaded(options.study)
    _checked_folder(options.out)
    plans = len(study_file.plans)
    _print_status(f"running study {study_file.name} ({plans} plan{'s' * (plans > 1)})")
    with bars_over_plans(sys.stderr.isatty()):
        study = study_file.run(progress=sys.stderr.isatty(), status=_print_status)
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
        study_file = load_study(path, status=_print_status)
    for notice in notices:
        _print_status(str(notice.message))
    return study_file


def _checked_folder(folder: Path) -> None:
    """Raise if a folder cannot be written, before any computation."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:  # not os.access, which knows neither full disks nor folders of the system
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise ValueError(f"--out must be a writable folder, got {folder}: {error.strerror or error}") from None


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
