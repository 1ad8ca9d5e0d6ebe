"""Runs the notebooks, stores them with their outputs, and compares stored outputs with those of a new run.

``python3 tests/support/notebooks.py`` renews all, ``... 00 03`` those whose
names begin so. What differs from run to run is not stored: times, addresses in
memory, identifiers of cells. `tests/test_notebooks.py` runs each again and
compares the text of its outputs: words exactly, numbers to the tolerance that
the metadata of the notebook state, ``{"ctrlplan": {"digits": 4, "zero":
1e-9}}``: numbers agree to so many significant digits, or are both below `zero`
in magnitude. Images are not compared.
"""

import html
import re
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import nbclient
import nbformat

FOLDER = Path(__file__).parents[2] / "notebooks"
LANGUAGE = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
STATED = {"digits": 4, "zero": 1e-9}
TIMEOUT = 120  # s a cell

EMPTY = """\
__import__("os").chdir({folder!r})  # first: that of the notebook before is gone
%reset -f
import warnings
import matplotlib
matplotlib.rc_file_defaults()
warnings.filterwarnings("default", append=True)  # whatever a notebook before has shown is shown again
del warnings, matplotlib
"""
"""What leaves a kernel as a new one is, but for the modules that it has imported."""

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)
_UNSHOWN = re.compile(r"<(style|script|svg)\b.*?</\1>|<!--.*?-->", re.DOTALL)


@dataclass(frozen=True)
class Tolerance:
    """How closely numbers must agree."""

    digits: int
    zero: float

    @classmethod
    def of(cls, notebook):
        """Return that which a notebook states."""
        return cls(**notebook.metadata["ctrlplan"])

    def agree(self, a, b):
        """Whether two numbers agree to half a unit of the last of the significant digits, or both count as zero."""
        largest = max(abs(a), abs(b))
        return largest <= self.zero or abs(a - b) <= 0.5 * 10.0 ** (1 - self.digits) * largest


@contextmanager
def kernel():
    """Kernel for one or several notebooks, as the client that runs it."""
    client = nbclient.NotebookClient(
        nbformat.v4.new_notebook(), timeout=TIMEOUT, kernel_name="python3", record_timing=False
    )
    with client.setup_kernel():
        yield client


def executed(path, client):
    """Run a notebook in a kernel, from an empty namespace and in a folder of its own; returned with its new outputs."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client.nb = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(EMPTY.format(folder=folder))])
        client.execute_cell(client.nb.cells[0], 0)
        client.nb = notebook
        for index, cell in enumerate(notebook.cells):
            client.execute_cell(cell, index)
    for cell in code_cells(notebook):
        cell.outputs = joined(cell.outputs)
    return notebook


def joined(outputs):
    """Return outputs with texts of one stream in one piece: how they are cut depends on the time that they take."""
    found = []
    for output in outputs:
        if found and output.output_type == "stream" and found[-1].get("name") == output.name:
            found[-1].text += output.text
        else:
            found.append(output)
    return found


def code_cells(notebook):
    """Return the cells of a notebook that are code."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(cell):
    """Return what a cell shows as text, an output an item; of HTML the words that are seen, without drawings."""
    found = []
    for output in cell.outputs:
        if output.output_type == "stream":
            found.append(f"{output.name}: {output.text}")
        elif output.output_type == "error":
            found.append(f"{output.ename}: {output.evalue}")
        else:
            found.append(output.data.get("text/plain", ""))
            seen = _UNSHOWN.sub(" ", output.data.get("text/html", ""))
            found.append(html.unescape(re.sub(r"<[^>]*>", " ", seen)))
    return [" ".join(_ADDRESS.sub("", text).split()) for text in found]


def differences(stored, new):
    """Return the cells whose texts differ, as (number, stored, new), by the tolerance that is stored."""
    tolerance = Tolerance.of(stored)
    pairs = zip(code_cells(stored), code_cells(new), strict=True)
    return [
        (i, texts(a), texts(b)) for i, (a, b) in enumerate(pairs, 1) if not same_texts(texts(a), texts(b), tolerance)
    ]


def same_texts(stored, new, tolerance):
    """Whether lists of texts have the same words, and numbers that agree."""
    return len(stored) == len(new) and all(_same(a, b, tolerance) for a, b in zip(stored, new, strict=True))


def _same(stored, new, tolerance):
    stored, new = (text.replace("−", "-").replace("·10^", "e") for text in (stored, new))
    if _NUMBER.sub("#", stored) != _NUMBER.sub("#", new):
        return False
    pairs = zip(_NUMBER.findall(stored), _NUMBER.findall(new), strict=True)
    return all(a == b or tolerance.agree(float(a), float(b)) for a, b in pairs)


def stored_form(notebook):
    """Return a notebook as it is stored: without what differs from run to run."""
    notebook.metadata = nbformat.from_dict(
        LANGUAGE | {"language_info": {"name": "python"}, "ctrlplan": dict(notebook.metadata.get("ctrlplan", STATED))}
    )
    for i, cell in enumerate(notebook.cells):
        cell.id = f"cell-{i}"
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            if "text" in output:
                output.text = _ADDRESS.sub("", output.text)
            data = output.get("data", {})
            for kind in data:
                if kind.startswith("text/"):
                    data[kind] = _ADDRESS.sub("", data[kind])
            if "metadata" in output:
                output.metadata = nbformat.from_dict({})
    return notebook


def main(names):
    """Renew notebooks by the beginnings of their names; all without one."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if not names or path.name.startswith(tuple(names)):
            with kernel() as client:
                nbformat.write(stored_form(executed(path, client)), path)
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
