"""python-control's examples as tests in a separate process of pytest, one for each script or notebook."""

from __future__ import annotations

import json
import os
import runpy
from pathlib import Path

import pytest
from matplotlib import pyplot as plt

FOLDER = Path(os.environ.get("CTRLPLAN_PEERS_EXAMPLES", "."))
EXAMPLES = sorted(path.name for path in FOLDER.iterdir() if path.suffix in (".py", ".ipynb"))


def code_of(notebook):
    """Code cells without the lines for IPython."""
    cells = [c["source"] for c in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"]
    for source in cells:
        text = source if isinstance(source, str) else "".join(source)
        yield "\n".join(line for line in text.split("\n") if line.lstrip()[:1] not in ("%", "!", "?"))


@pytest.mark.parametrize("name", EXAMPLES)
def test_example(name, monkeypatch):
    """One script or notebook, from its own folder."""
    plt.close("all")
    monkeypatch.chdir(FOLDER)
    monkeypatch.syspath_prepend(str(FOLDER))
    if name.endswith(".py"):
        runpy.run_path(name, run_name="__main__")
        return
    names, failures = {"__name__": "__main__", "display": print}, []
    for cell in code_of(Path(name)):
        try:
            exec(compile(cell, name, "exec"), names)
        except Exception as error:  # written for older versions of numpy: the cells after it may run
            failures.append(f"{type(error).__name__}: {error}")
    assert not failures
