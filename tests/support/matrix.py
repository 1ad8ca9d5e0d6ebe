"""The test command with other versions of Python and its packages, and with other BLAS kernels: a table of results.

``python3 tests/support/matrix.py --quick`` makes a fresh virtual environment
for the declared minima and for the newest packages of each Python, installs
the package with its tests, runs them, and prints the table that the CHANGELOG
shows. ``--kernels`` runs them in the present environment with each kernel of
OpenBLAS instead, and with one and two threads.
"""

import argparse
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[2]
PACKAGES = ("numpy", "scipy", "control", "casadi", "matplotlib")
PYTHONS = ("3.11", "3.12", "3.13")
KERNELS = ("Nehalem", "Sandybridge", "Haswell", "Zen", "SkylakeX", "Cooperlake", "Sapphirerapids")
WIDE = ("SkylakeX", "Cooperlake", "Sapphirerapids")
"""Kernels of processors with AVX-512, which numpy's own loops then use as well."""

SUMMARY = re.compile(r"\d+ (passed|failed|errors?|skipped|deselected)\b.* in [\d.]+s")
"""Of pytest; Fortran libraries may print after it."""

VERSIONS = f"""
import json, platform
from importlib import metadata
print(json.dumps([platform.python_version(), *(metadata.version(name) for name in {PACKAGES})]))
"""

PROBE = """
import numpy, scipy.linalg, threadpoolctl
numpy.ones((64, 64)) @ numpy.ones((64, 64)), scipy.linalg.solve(numpy.eye(64), numpy.ones(64))
print(*sorted({str(found.get("architecture")) for found in threadpoolctl.threadpool_info()}))
"""

FEATURES = """
import numpy
found = numpy.show_config("dicts")["SIMD Extensions"].get("found", [])
print(*(name for name in found if "512" in name or name == "X86_V4"))
"""


def minima():
    """Constraints that pin every declared package to its minimum."""
    with open(PROJECT / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    declared = [*project["dependencies"], *project["optional-dependencies"]["fast"]]
    pairs = [line.partition(",")[0].split(">=") for line in declared if ">=" in line]
    return [f"{name}=={minimum}" for name, minimum in pairs]


def interpreter(version, given):
    """Path of an interpreter of this version: one of those given, or on PATH; None without."""
    for path in [*given, shutil.which(f"python{version}"), sys.executable]:
        if path and output([path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]) == version:
            return path
    return None


def output(command, **variables):
    """What a command prints; None if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | variables)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def tested(python, options, **variables):
    """Summary of the test run, which is shown as it goes."""
    chosen = ["-m", "not slow"] if options.quick else []
    command = [python, "-m", "pytest", "-q", "-n", "auto", *chosen, *options.tests]
    shown = " ".join(f"{name}={value}" for name, value in variables.items())
    print("+", shown, *command, flush=True)
    last = ""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=PROJECT, env=os.environ | variables
    ) as process:
        for line in process.stdout:
            print(line, end="", flush=True)
            last = line.strip() if SUMMARY.search(line) else last
    return last if process.returncode == 0 else f"FAILED ({process.returncode}): {last}"


def versions(options):
    """Rows of a table: interpreter and packages, then what the tests said."""
    yield ["Python", *PACKAGES, "result"]
    for version, pins in [(PYTHONS[0], minima()), *((version, []) for version in PYTHONS)]:
        python = interpreter(version, options.python)
        if python is None:
            yield [version, *[""] * len(PACKAGES), f"skipped: no python{version} on PATH, see --python"]
            continue
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run([python, "-m", "venv", folder], check=True)
            inside = str(Path(folder, "bin", "python"))
            constraints = Path(folder, "constraints.txt")
            constraints.write_text("\n".join(pins))
            install = [inside, "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", str(constraints)]
            if subprocess.run([*install, ".[test]"], cwd=PROJECT, check=False).returncode:
                yield [
                    version,
                    *[""] * len(PACKAGES),
                    f"FAILED: does not install with {' '.join(pins) or 'the newest'}",
                ]
                continue
            yield [*json.loads(output([inside, "-c", VERSIONS])), tested(inside, options)]


def kernels(options):
    """Rows of a table: kernel and threads of OpenBLAS, then what the tests said."""
    yield ["kernel", "threads", "result"]
    wide = output([sys.executable, "-c", FEATURES]) or ""
    for kernel, threads in itertools.product(options.kernels or KERNELS, options.threads):
        variables = {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": threads}
        if wide and kernel not in WIDE:
            variables["NPY_DISABLE_CPU_FEATURES"] = wide
        loaded = output([sys.executable, "-c", PROBE], **variables)
        if loaded is None:
            yield [kernel, threads, "skipped: this processor does not run it"]
        elif loaded != kernel:
            yield [kernel, threads, f"skipped: the packages installed load {loaded} instead"]
        else:
            yield [kernel, threads, tested(sys.executable, options, **variables)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("tests", nargs="*", help="files and folders of tests; the default is all")
    parser.add_argument("--quick", action="store_true", help="the everyday run, without the slow tests")
    parser.add_argument("--python", action="append", default=[], metavar="PATH", help="an interpreter not on PATH")
    parser.add_argument("--kernels", nargs="*", metavar="NAME", help=f"kernels of OpenBLAS, by default {KERNELS}")
    parser.add_argument(
        "--threads", nargs="+", default=["1", "2"], metavar="N", help="BLAS threads, by default 1 and 2"
    )
    options = parser.parse_intermixed_args()
    rows = list(versions(options) if options.kernels is None else kernels(options))
    print()
    for row in rows:
        print("|", " | ".join(row), "|")
        if row is rows[0]:
            print("|---" * len(row) + "|")
    return any("FAILED" in row[-1] for row in rows)


if __name__ == "__main__":
    sys.exit(main())
