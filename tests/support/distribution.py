"""Builds sdist and wheel, checks them, and installs the wheel into an empty environment without the checkout.

``python3 tests/support/distribution.py`` requires `build` and `twine`. In the
new environment, from a folder of its own, the command must give its version,
write and run a study file, and the first program of the README must run: the README as the wheel carries
it, which is what a package index shows.
"""

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]

PROGRAM = """
import re
from importlib import metadata
from pathlib import Path
import ctrlplan

assert Path(ctrlplan.__file__).is_relative_to({prefix!r}), ctrlplan.__file__
about = metadata.metadata("ctrlplan")
assert about["Version"] == ctrlplan.__version__ == {version!r}
readme = about.get_payload() or about["Description"]
assert readme.strip() == Path({readme!r}).read_text(encoding="utf-8").strip()
exec(re.search("```python\\n(.*?)```", readme, re.DOTALL)[1], {{}})
assert Path("servo.html").stat().st_size > 10_000
"""


def run(*command, cwd):
    """Run a command that must succeed, in a folder, without the checkout on Python's path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    print("+", *(part for part in command if "\n" not in part), flush=True)
    environment["MPLBACKEND"] = "agg"
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}")
    return done.stdout


def main():
    """Build, check, install, run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        made, place, work = folder / "dist", folder / "venv", folder / "work"
        work.mkdir()
        run(sys.executable, "-m", "build", "--outdir", str(made), str(ROOT), cwd=folder)
        source, wheel = sorted(made.glob("*.tar.gz")), sorted(made.glob("*.whl"))
        assert len(source) == len(wheel) == 1, sorted(made.iterdir())
        run(sys.executable, "-m", "twine", "check", "--strict", str(source[0]), str(wheel[0]), cwd=folder)
        venv.create(place, with_pip=True)
        python = place / ("Scripts" if os.name == "nt" else "bin") / "python"
        run(str(python), "-m", "pip", "install", "-q", str(wheel[0]), cwd=work)
        command = str(python.with_name("ctrlplan"))
        version = run(command, "--version", cwd=work).split()[-1]
        run(command, "new", "own.toml", "--kind", "python", cwd=work)
        run(command, "report", "own.toml", "--out", "own", cwd=work)
        text = PROGRAM.format(prefix=str(place), version=version, readme=str(ROOT / "README.md"))
        print(run(str(python), "-c", text, cwd=work), end="")
        print(f"{source[0].name} and {wheel[0].name}: installed, and run")


if __name__ == "__main__":
    main()
