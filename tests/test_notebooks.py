"""Every notebook runs from the top in a kernel of its own, is short, and is kept without its outputs."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LONGEST = 20  # lines of code a cell: more is a module that has not been written yet


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    nbformat = pytest.importorskip("nbformat")
    return nbformat.read(path, as_version=4)


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_outputs_are_stripped(notebook):
    assert code(notebook)
    for cell in code(notebook):
        assert cell.outputs == []
        assert cell.execution_count is None


def test_cells_are_short(notebook):
    for cell in code(notebook):
        lines = [line for line in cell.source.splitlines() if line.strip()]
        assert 0 < len(lines) <= LONGEST, cell.source


def test_it_defines_no_algorithm(notebook):
    import ast

    for cell in code(notebook):
        for node in ast.walk(ast.parse(cell.source)):
            assert not isinstance(node, ast.ClassDef | ast.AsyncFunctionDef), cell.source
            if isinstance(node, ast.FunctionDef):
                assert len(node.body) <= 5, cell.source


def test_it_claims_something(notebook):
    assert any("assert " in cell.source for cell in code(notebook))


def test_it_tells_a_story(notebook):
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")


@pytest.mark.slow
def test_it_runs(notebook, path):
    nbclient = pytest.importorskip("nbclient")
    client = nbclient.NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()
    said = [
        out for cell in code(notebook) for out in cell.outputs if out.output_type == "stream" and out.name == "stderr"
    ]
    assert not [out.text for out in said if "Warning" in out.text]
