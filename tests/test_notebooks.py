"""Every notebook is a lesson: short cells, one claim, stored with the outputs that a new run gives again."""

import ast
import re
from pathlib import Path

import pytest

pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
import nbformat
from words import in_text

from notebooks import FOLDER, Tolerance, code_cells, differences, executed, kernel, same_texts, stored_form, texts

NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LONGEST = 12  # lines of code a cell: more is a module that has not been written yet
LARGEST = 400_000  # bytes


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    return nbformat.read(path, as_version=4)


def trees(notebook):
    return [ast.parse(cell.source) for cell in code_cells(notebook)]


# What is stored


def test_it_is_stored_as_the_script_stores_it(path, notebook):
    assert path.stat().st_size < LARGEST
    again = stored_form(nbformat.read(path, as_version=4))
    assert nbformat.writes(again) == nbformat.writes(notebook)
    counts = [cell.execution_count for cell in code_cells(notebook)]
    assert counts == list(range(1, len(counts) + 1))


def test_it_shows_what_it_does(notebook):
    shown = [cell for cell in code_cells(notebook) if cell.outputs]
    assert len(shown) >= 0.5 * len(code_cells(notebook))
    assert any("image/png" in output.get("data", {}) for cell in shown for output in cell.outputs)


def test_no_errors_warnings_times_or_addresses_are_stored(notebook):
    said = [text for cell in code_cells(notebook) for text in texts(cell)]
    assert not [text for text in said if re.search(r": False\b", text)]  # a comparison that failed
    assert not [text for text in said if text.startswith("stderr:") or "Traceback" in text]
    assert not [text for text in said if re.search(r"0x[0-9a-f]{6}|Wall time|CPU times", text)]


# How it is written


def test_cells_are_short(notebook):
    for cell in code_cells(notebook):
        lines = [line for line in cell.source.splitlines() if line.strip()]
        assert 0 < len(lines) <= LONGEST, cell.source


def test_it_defines_no_algorithm(notebook):
    for tree in trees(notebook):
        for node in ast.walk(tree):
            assert not isinstance(node, ast.ClassDef | ast.AsyncFunctionDef)
            if isinstance(node, ast.FunctionDef):
                assert len(node.body) <= 5, node.name


def test_it_claims_one_thing(notebook):
    assert sum(isinstance(node, ast.Assert) for tree in trees(notebook) for node in ast.walk(tree)) == 1


def test_it_uses_the_package_by_its_public_names(notebook):
    imported = set()
    for tree in trees(notebook):
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                imported |= {(name.name, name.asname) for name in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add((node.module, None))
            assert not (isinstance(node, ast.Attribute) and node.attr.startswith("_")), node.attr
    assert {name for name in imported if name[0].startswith("ctrlplan")} == {("ctrlplan", "cp")}


def test_it_has_a_title_and_text(notebook):
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    assert sum(cell.cell_type == "markdown" for cell in notebook.cells) >= 4


def test_it_is_in_the_words_of_the_field(notebook):
    found = [(word.word, row) for cell in notebook.cells for row in cell.source.splitlines() for word in in_text(row)]
    assert not found


def test_the_first_is_seven_cells():
    assert NOTEBOOKS[0].name == "00_your_loop.ipynb"
    assert len(code_cells(nbformat.read(NOTEBOOKS[0], as_version=4))) == 7


# How long a program of a newcomer is


def lines(cells):
    """Number of lines of code in cells, without blank ones."""
    return sum(bool(line.strip()) for cell in cells for line in cell.source.splitlines())


def program(name, heading):
    """Cells of a notebook from its imports and a heading to the report."""
    cells = nbformat.read(FOLDER / name, as_version=4).cells
    imports = next(cell for cell in cells if cell.cell_type == "code")
    first = next(k for k, cell in enumerate(cells) if cell.source.startswith(heading))
    last = next(k for k, cell in enumerate(cells) if k > first and ".report(" in cell.source)
    return [imports, *(cell for cell in cells[first : last + 1] if cell.cell_type == "code")]


@pytest.mark.parametrize(
    ("name", "heading", "most"),
    [
        ("07_your_own_plant.ipynb", "## The equations", 39),
        ("08_cars_and_quadrotors.ipynb", "## A lane change", 15),
        ("08_cars_and_quadrotors.ipynb", "## A planar quadrotor", 20),
    ],
)
def test_programs_from_equations_to_report_are_short(name, heading, most):
    """Imports included; that they run is tested below."""
    assert lines(program(name, heading)) <= most


# That it runs


@pytest.fixture(scope="module")
def client():
    """One kernel for all notebooks: half of the time of one would be that of its imports."""
    with kernel() as client:
        yield client


@pytest.mark.slow
def test_a_new_run_gives_the_same_outputs(notebook, path, client):
    assert differences(notebook, executed(path, client)) == []


# How outputs are compared


@pytest.mark.parametrize(
    ("stored", "new", "same"),
    [
        ("T = 1.234 s", "T = 1.2344 s", True),
        ("T = 1.234 s", "T = 1.235 s", False),  # 8.1e-4 apart
        ("T = 1.234 s", "T = 1.234 m", False),
        ("1e-16", "-3e-13", True),
        ("error 2e-8", "error 3e-8", False),
        ("−4.107·10^−4", "-0.0004107", True),
        ("0.0", "1.0", False),
        ("[1. 2.]", "[1. 2. 3.]", False),
        ("x_d1 is 5", "x_d2 is 5", False),
        ("nan", "nan", True),
        ("inf", "nan", False),
        ("alpha", "beta", False),
        ("12", "12.004", True),
    ],
)
def test_words_are_compared_exactly_and_numbers_by_four_digits(stored, new, same):
    assert same_texts([stored], [new], Tolerance(4, 1e-9)) is same


def test_a_missing_output_is_a_difference():
    assert not same_texts(["a"], [], Tolerance(4, 1e-9))


def test_what_differs_from_run_to_run_is_not_stored():
    from nbformat.v4 import new_code_cell, new_notebook, new_output

    output = new_output("execute_result", {"text/plain": "<object at 0x7f3ad19bc150>"}, execution_count=1)
    cell = new_code_cell("x", outputs=[output], metadata={"execution": {"iopub.execute_input": "2026-01-01"}})
    form = stored_form(new_notebook(cells=[cell]))
    assert form.cells[0].metadata == {}
    assert form.cells[0].outputs[0].data["text/plain"] == "<object>"
    assert form.metadata["ctrlplan"] == {"digits": 4, "zero": 1e-9}


def test_html_is_compared_by_its_words():
    from nbformat.v4 import new_code_cell, new_output

    shown = "<style>p {}</style><p>Settling &amp; <b>2.5</b> s</p><svg><text>7</text></svg><script>t = 3</script>"
    cell = new_code_cell("x", outputs=[new_output("display_data", {"text/html": shown, "text/plain": "<A>"})])
    assert texts(cell) == ["<A>", "Settling & 2.5 s"]


def test_the_folder_is_that_of_the_repository():
    assert Path(__file__).parents[1] / "notebooks" == FOLDER
    assert len(NOTEBOOKS) == 9
