"""What modules take from each other: no private names, and no import upwards but those that are named."""

import ast
import tomllib
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import ctrlplan as cp

pytestmark = pytest.mark.every_combination

ROOT = Path(cp.__file__).parent
PROJECT = ROOT.parent
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in ROOT.rglob("*.py")}
every = pytest.mark.parametrize("file", sorted(TREES))

PROTOCOLS = {"_repr_html_", "_replace"}
"""Names that other libraries look for, or that are public in spite of their underscore, as those of named tuples."""

FOREIGN = {"sys._getframe", "functools._lru_cache_wrapper", "argparse._SubParsersAction"}
"""Names of Python itself that have no public equivalent."""

SHOWING = {"plot", "report", "_repr_html_"}
"""Methods that only show, which may import reports."""


@cache
def nodes(tree):
    """All nodes of a module."""
    return tuple(ast.walk(tree))


def is_private(name):
    return name.startswith("_") and not name.startswith("__") and name not in PROTOCOLS


@cache  # what many modules inherit from
def defined(tree):
    """Names that a module defines: functions, classes, variables, and attributes that its objects are given."""
    found = set()
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_own(node.value):
            found.add(node.attr)
        elif isinstance(node, ast.Call):  # fields that are set by name
            found |= {keyword.arg for keyword in node.keywords if keyword.arg}
    return found


def is_own(node):
    """Whether an expression is self, cls or super()."""
    if isinstance(node, ast.Call):
        node = node.func
    return isinstance(node, ast.Name) and node.id in ("self", "cls", "super")


@cache
def inherited(tree):
    """Names that the modules of base classes define: what a class does with objects of its own kind."""
    homes = {
        alias.asname or alias.name: node.module
        for node in nodes(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    bases = {
        base.id
        for node in nodes(tree)
        if isinstance(node, ast.ClassDef)
        for base in node.bases
        if isinstance(base, ast.Name) and base.id in homes
    }
    found = set()
    for base in bases:
        file = homes[base].removeprefix("ctrlplan.").replace(".", "/") + ".py"
        if file in TREES:
            found |= defined(TREES[file]) | inherited(TREES[file])
    return found


@every
def test_no_private_name_of_another_module_is_imported(file):
    modules = {path.removesuffix(".py").rpartition("/")[2] for path in TREES} | {"_pieces"}
    wrong = [
        f"{node.module}.{alias.name}, line {node.lineno}"
        for node in nodes(TREES[file])
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if is_private(alias.name) and alias.name not in modules
    ]
    assert wrong == []


@every
def test_no_private_attribute_of_another_modules_object_is_used(file):
    tree = TREES[file]
    own = defined(tree) | inherited(tree)
    wrong = [
        f"{ast.unparse(node)}, line {node.lineno}"
        for node in nodes(tree)
        if isinstance(node, ast.Attribute)
        and is_private(node.attr)
        and not is_own(node.value)
        and node.attr not in own
        and ast.unparse(node) not in FOREIGN
    ]
    assert wrong == []


def exceptions():
    path = PROJECT / "pyproject.toml"
    if not path.exists():
        pytest.skip("installed without its project file")
    contracts = tomllib.loads(path.read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    return sorted({entry for contract in contracts for entry in contract.get("ignore_imports", ())})


def inner_imports(module):
    """Modules that functions of a module import, each with the names of the functions around the import."""
    tree = TREES[module.removeprefix("ctrlplan.").replace(".", "/") + ".py"]
    found = {}

    def walk(node, inside):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ImportFrom):
                for name in (child.module, *(f"{child.module}.{alias.name}" for alias in child.names)):
                    found.setdefault(name, set()).add(inside)
            walk(child, (*inside, child.name) if isinstance(child, ast.FunctionDef) else inside)

    walk(tree, ())
    return found


def test_every_exception_of_the_import_contract_is_one_that_is_named():
    for entry in exceptions():
        importer, _, imported = entry.partition(" -> ")
        assert "*" not in entry
        around = inner_imports(importer)[imported]
        assert () not in around, f"{entry} must be an import inside a function"
        if imported.startswith("ctrlplan.reports"):  # methods that only show
            assert all(inside[0] in SHOWING for inside in around), (entry, around)
        else:
            assert entry in (
                "ctrlplan.planning.quantities -> ctrlplan.flatness.quantities",  # the adapter
                "ctrlplan.planning.quantities -> ctrlplan.simulation.quantities_of_loops",  # the adapter, for loops
                "ctrlplan.trajectories.chosen -> ctrlplan.planning.alpha",  # TrigSpline(alpha="auto")
                "ctrlplan.trajectories.chosen -> ctrlplan.planning.cycle",  # on_cycle(dt, limits)
                "ctrlplan.trajectories.chosen -> ctrlplan.planning.stop",  # stop(time, limits)
            )


@pytest.mark.parametrize("package", ["simulation", "trajectories"])
def test_names_that_a_package_loads_later_are_those_that_type_checkers_see(package):
    """Their modules are the same, and no module has the name of one of them, which it would replace once loaded."""
    tree = TREES[f"{package}/__init__.py"]
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.name: node.module for node in guarded.body for alias in node.names}
    loaded = import_module(f"ctrlplan.{package}")
    assert {name: f"ctrlplan.{package}.{module}" for name, module in loaded._HOME.items()} == seen
    assert seen.keys() <= set(loaded.__all__)
    assert not seen.keys() & {path.stem for path in (ROOT / package).iterdir()}
    for name in loaded.__all__:
        assert getattr(loaded, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = loaded.nothing
    assert loaded._HOME.keys() <= vars(loaded).keys()  # from the second reading on they are plain attributes
