"""Measures of the package's code: signatures, `Any`, imports upwards, switches on strings, long functions, lines.

``python3 tests/support/measures.py`` prints one table; ``--list`` the places
behind each number as well. ``python3 tests/support/measures.py FOLDER``
measures another checkout, so that two commits can be compared by one script:
``git worktree add FOLDER COMMIT`` makes one. How each is counted stands in
the docstring of its function.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import grimp

PACKAGE = "ctrlplan"
MOST_PARAMETERS = 19
MOST_LINES = 60

NAMES_OF_PLANS = {
    *("step", "polynomial", "trigonometric", "piecewise", "trapezoid", "S-curve", "shaped step", "ZV step"),
    *("quintic", "septic", "nonic", "minimum jerk", "minimum snap"),
}
"""Names that standard plans and baselines have had."""

OTHERS = re.compile(
    r"(\bopname|__name__|__module__|\.suffix|\bsolver\.status|\.get_linestyle\(\)|\beast_asian_width\(\w+\))$"
)
"""What takes words that others have fixed: byte code, names of classes, endings of files, results of libraries."""

KINDS = re.compile(r"\bkind\b")
LETTERS = set("biufcmMOSUV")
"""``dtype.kind`` of numpy, which is one of these letters."""

FLAG = re.compile(r"CV_[A-Z_]+|numpy\.random|#000000")
"""Return flags of CVODES, a module of numpy, a colour of matplotlib."""

UFUNC_METHODS = {"__call__", "reduce", "accumulate", "outer"}
"""What numpy passes to ``__array_ufunc__`` as `method`."""

FORMER = {"_renamed.py", "former.py"}
"""Modules of deprecated names, which are strings because nothing has them any more."""

LAYOUT = {tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENDMARKER}
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """One file of the package."""

    path: Path
    text: str

    @cached_property
    def tree(self):
        return ast.parse(self.text)

    @cached_property
    def docstrings(self):
        """Lines of strings that are statements: docstrings of modules, classes, functions and constants."""
        alone = (
            node
            for node in ast.walk(self.tree)
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        return {line for node in alone for line in range(node.lineno, node.end_lineno + 1)}

    @cached_property
    def tokens(self):
        """Tokens of code: no comments, no docstrings, no layout."""
        return [
            token
            for token in tokenize.generate_tokens(io.StringIO(self.text).readline)
            if token.type not in LAYOUT and token.start[0] not in self.docstrings
        ]

    @cached_property
    def code(self):
        """Numbers of the lines that hold code."""
        return {line for token in self.tokens for line in range(token.start[0], token.end[0] + 1)}

    def nodes(self, kind):
        """Nodes of a kind, each with the dotted name of where it stands."""

        def below(node, names):
            for child in ast.iter_child_nodes(node):
                if isinstance(child, kind):
                    yield child, ".".join([*names, getattr(child, "name", "")]).strip(".")
                own = [child.name] if isinstance(child, Function | ast.ClassDef) else []
                yield from below(child, [*names, *own])

        return below(self.tree, [])

    def place(self, node):
        return f"{self.path}:{node.lineno}"


def package(root):
    """Modules of the package under a folder."""
    return [
        Module(path.relative_to(root), path.read_text(encoding="utf-8"))
        for path in sorted((root / PACKAGE).rglob("*.py"))
    ]


# Signatures


def parameters(function):
    """Arguments of a function, without self and cls; those with stars as well."""
    a = function.args
    found = [*a.posonlyargs, *a.args, *filter(None, [a.vararg]), *a.kwonlyargs, *filter(None, [a.kwarg])]
    return [p for p in found if p.arg not in ("self", "cls", "mcs")]


def _fields(node):
    """Annotated fields of a dataclass: the parameters of its constructor. None of another class."""
    names = {n.id for d in node.decorator_list for n in ast.walk(d) if isinstance(n, ast.Name)}
    attributes = {n.attr for d in node.decorator_list for n in ast.walk(d) if isinstance(n, ast.Attribute)}
    if "dataclass" not in names | attributes:
        return None
    return [n for n in node.body if isinstance(n, ast.AnnAssign) and "ClassVar" not in ast.unparse(n.annotation)]


def signatures(modules):
    """Each function and dataclass: number of parameters, place, name, untyped ones, name after ``**``, if a dataclass.

    A parameter is untyped without an annotation, or where it is `Any` itself.
    Nested functions and methods count; lambdas do not.
    """
    for module in modules:
        for node, name in module.nodes(Function):
            given = parameters(node)
            untyped = [p.arg for p in given if p.annotation is None or ast.unparse(p.annotation) == "Any"]
            yield len(given), module.place(node), name, untyped, node.args.kwarg and node.args.kwarg.arg, False
        for node, name in module.nodes(ast.ClassDef):
            if (given := _fields(node)) is not None:
                untyped = [ast.unparse(n.target) for n in given if ast.unparse(n.annotation) == "Any"]
                yield len(given), module.place(node), name, untyped, None, True


# Imports upwards


def _floor(name, floors):
    """Number of the floor of a module, from the top; None of a module that stands on none."""
    for number, members in enumerate(floors):
        if any(name == member or name.startswith(member + ".") for member in members):
            return number
    return None


def _expression(pattern):
    """Regular expression of a name with import-linter's wildcards: * is one part of a name, ** one or more."""
    parts = {"*": r"[^.]+", "**": r"[^.]+(\.[^.]+)*"}
    return re.compile(r"\.".join(parts.get(part, re.escape(part)) for part in pattern.split(".")))


def imports_upwards(root):
    """Pairs of modules that the contract on floors exempts, and pairs that import upwards, as grimp finds them.

    The contract is the first one of type "layers" over the whole package in
    the checkout's own pyproject.toml; imports for type checkers alone do not
    count, as there. A wildcard counts as each import of the package that it
    matches. Imports between members of one floor ("a | b") count as upwards.
    """
    with open(root / "pyproject.toml", "rb") as file:
        linter = tomllib.load(file)["tool"]["importlinter"]
    layered = [c for c in linter["contracts"] if c["type"] == "layers"]
    contract = next(c for c in layered if c.get("containers", [PACKAGE]) == [PACKAGE])
    start = f"{PACKAGE}." if "containers" in contract else ""  # names are relative to a container
    floors = [[start + member.strip(" ()") for member in re.split(r"[|:]", layer)] for layer in contract["layers"]]
    excluded = linter.get("exclude_type_checking_imports", False)
    sys.path.insert(0, str(root))
    graph = grimp.build_graph(PACKAGE, exclude_type_checking_imports=excluded, cache_dir=None)
    sys.path.remove(str(root))
    pairs = sorted((name, to) for name in graph.modules for to in graph.find_modules_directly_imported_by(name))
    rules = [tuple(map(_expression, rule.split(" -> "))) for rule in contract.get("ignore_imports", [])]
    exempt = [pair for pair in pairs if any(a.fullmatch(pair[0]) and b.fullmatch(pair[1]) for a, b in rules)]
    return exempt, [pair for pair in pairs if _is_upwards(*pair, floors)]


def _is_upwards(importer, imported, floors):
    own, other = _floor(importer, floors), _floor(imported, floors)
    if own is None or other is None:
        return False
    members = (
        [next(m for m in floors[own] if (n + ".").startswith(m + ".")) for n in (importer, imported)]
        if own == other
        else []
    )
    return other < own or len(set(members)) == 2


# Switches on strings


@dataclass(frozen=True)
class Switch:
    """A place where the program's way depends on a string that is written there."""

    place: str
    kind: str  # "Literal", "name of a plan", "others' word", "string" or "named string"
    text: str


def _strings(node):
    """Strings that an expression consists of: one, or a tuple, list or set of them. None otherwise."""
    parts = node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else [node]
    values = [part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    return values if values and len(values) == len(parts) else None


def _literal_names(modules):
    """Names that stand for ``Literal[...]``, and fields of classes that are annotated with one."""
    aliases = {"Literal"}
    for _ in range(2):  # an alias may be made of another
        for module in modules:
            for node, _name in module.nodes(ast.Assign):
                if isinstance(node.value, ast.Subscript | ast.BinOp) and _has(node.value, aliases):
                    aliases |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    fields = {
        node.target.id
        for module in modules
        for owner, _name in module.nodes(ast.ClassDef)
        for node in owner.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and _has(node.annotation, aliases)
    }
    return aliases, fields


def _has(node, names):
    return any(isinstance(n, ast.Name) and n.id in names for n in ast.walk(node))


def _switched(node):
    """What a node compares, and with which strings; None if it is no switch."""
    if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Eq | ast.NotEq | ast.In | ast.NotIn):
        left, right = node.left, node.comparators[0]
        if (values := _strings(right)) is not None:
            return left, values
        if isinstance(node.ops[0], ast.Eq | ast.NotEq) and (values := _strings(left)) is not None:
            return right, values
    called = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args
    if called and node.func.attr in ("startswith", "endswith") and (values := _strings(node.args[0])) is not None:
        return node.func.value, values
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Dict):
        keys = [key for key in node.value.keys if key is not None]
        if keys and len(values := [v for key in keys for v in _strings(key) or ()]) == len(keys):
            return node.slice, values
    if isinstance(node, ast.Match):
        values = [
            pattern.value.value
            for case in node.cases
            for pattern in ast.walk(case.pattern)
            if isinstance(pattern, ast.MatchValue) and isinstance(pattern.value, ast.Constant)
        ]
        if values and all(isinstance(value, str) for value in values):
            return node.subject, values
    return None


def _named_strings(module):
    """Constants of a module that are strings, by name."""
    return {
        target.id: node.value.value
        for node in module.tree.body
        if isinstance(node, ast.Assign) and _strings(ast.Tuple([node.value])) is not None
        for target in node.targets
        if isinstance(target, ast.Name)
    }


class _Spelled(ast.NodeTransformer):
    """Puts strings in place of the constants that hold them."""

    def __init__(self, known):
        self.known = known

    def visit_Name(self, node):
        value = self.known.get(node.id) if isinstance(node.ctx, ast.Load) else None
        return node if value is None else ast.copy_location(ast.Constant(value), node)


def named_switches(modules):
    """Places that compare with a string that a constant of a module holds, by its name; as of `switches`.

    A constant that is used in several places is how a module marks what
    another library carries for it (labels of matplotlib's artists), or the
    name of its own part (an output, a file, a family), which stands once.
    """
    constants = {".".join(module.path.with_suffix("").parts): _named_strings(module) for module in modules}
    for module in modules:
        own = dict(constants[".".join(module.path.with_suffix("").parts)])
        for node in module.tree.body:
            if isinstance(node, ast.ImportFrom):
                found = constants.get(node.module, {})
                own |= {alias.asname or alias.name: found[alias.name] for alias in node.names if alias.name in found}
        before = {(found.lineno, found.col_offset) for found in ast.walk(module.tree) if _switched(found)}
        for node in ast.walk(_Spelled(own).visit(ast.parse(module.text))):
            if not (found := _switched(node)) or (node.lineno, node.col_offset) in before:
                continue
            if not _is_others(ast.unparse(found[0]), found[1]):
                yield Switch(module.place(node), "named string", module.text.splitlines()[node.lineno - 1].strip())


def switches(modules):
    """Places that compare with strings written there, by what they compare.

    Found are ``==``, ``!=``, ``in (...)`` and ``not in (...)`` with strings,
    ``startswith`` and ``endswith`` of strings, `match` over strings, and a
    dictionary with strings as keys that is indexed where it is written.
    "Literal": what is compared is an argument, variable or field annotated
    with ``Literal`` (mypy checks its values); "name of a plan": one of
    `NAMES_OF_PLANS` is among the strings; "others' word": a word that is not
    the package's own, by `_is_others`, or a deprecated name in a module that
    warns of it (`FORMER`); "string": any other.
    """
    aliases, fields = _literal_names(modules)
    for module in modules:
        yield from _switches_below(module, module.tree, frozenset(), aliases, fields)


def _switches_below(module, node, known, aliases, fields):
    if isinstance(node, Function):
        own = {p.arg for p in parameters(node) if p.annotation is not None and _has(p.annotation, aliases)}
        known = known - {p.arg for p in parameters(node)} | own
        known = known | {
            n.target.id
            for n in ast.walk(node)
            if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name) and _has(n.annotation, aliases)
        }
    found = _switched(node)
    if found is not None:
        subject, values = found
        declared = (isinstance(subject, ast.Name) and subject.id in known) or (
            isinstance(subject, ast.Attribute) and subject.attr in fields
        )
        kind = _kind(ast.unparse(subject), values, module, declared)
        line = module.text.splitlines()[node.lineno - 1].strip()
        yield Switch(module.place(node), kind, line)
    for child in ast.iter_child_nodes(node):
        yield from _switches_below(module, child, known, aliases, fields)


def _kind(subject, values, module, declared):
    if _is_others(subject, values):
        return "others' word"
    if declared:
        return "Literal"
    if module.path.name in FORMER:
        return "others' word"
    return "name of a plan" if NAMES_OF_PLANS & set(values) else "string"


def _is_others(subject, values):
    """Whether strings are words that others have fixed.

    What Python, numpy, scipy, Unicode and the file system return (`OTHERS`);
    letters of ``dtype.kind``; what `FLAG` lists; methods of numpy's functions; ``ClassVar`` of an
    annotation; and signs without a letter or a digit: the underscore of
    Python's private names and matplotlib's hidden labels, its solid line, an
    end of line, a quote.
    """
    return (
        OTHERS.search(subject) is not None
        or (KINDS.search(subject) is not None and set("".join(values)) <= LETTERS)
        or all(map(FLAG.fullmatch, values))
        or (subject == "method" and set(values) <= UFUNC_METHODS)
        or (subject.startswith("str(annotation)") and values == ["ClassVar"])
        or not any(letter.isalnum() for value in values for letter in value)
    )


# Sizes


def words(modules, word="Any"):
    """How often a word stands in each module's code; comments, docstrings and other strings are left out."""
    return {m.path: sum(t.type == tokenize.NAME and t.string == word for t in m.tokens) for m in modules}


def lengths(modules):
    """Lines of code of each function: from ``def`` to its end, functions inside included.

    Blank lines, lines of comments alone, docstrings and decorators are not
    counted; the signature is.
    """
    for module in modules:
        for node, name in module.nodes(Function):
            count = len(module.code & set(range(node.lineno, node.end_lineno + 1)))
            yield count, module.place(node), name


def lines(modules):
    """Lines of code of the package: neither blank, nor of comments or docstrings alone."""
    return sum(len(module.code) for module in modules)


# The table


def _named(rows):
    return [f"{place} {name}: {count}" for count, place, name, *_ in rows]


def _listed(found, kind):
    return [f"{switch.place} {switch.text}" for switch in found if switch.kind == kind]


def measured(root):
    """Rows of the table, (what, number), and the places behind each of them."""
    modules = package(root)
    given = sorted(signatures(modules), key=lambda row: -row[0])
    functions, classes = ([row for row in given if row[5] is one] for one in (False, True))
    exempt, upwards = imports_upwards(root)
    found = [*switches(modules), *named_switches(modules)]
    kinds = Counter(switch.kind for switch in found)
    long = sorted((row for row in lengths(modules) if row[0] > MOST_LINES), reverse=True)
    untyped = [row for row in given if row[3]]
    wide = [row for row in untyped if row[0] >= 8]
    many = [row for row in given if row[4]]
    anys = words(modules)
    return [
        ("most parameters of a function", functions[0][0], _named(functions[:12])),
        (f"functions of more than {MOST_PARAMETERS}", sum(row[0] > MOST_PARAMETERS for row in functions), []),
        ("most fields of a dataclass", classes[0][0], _named(classes[:8])),
        (
            "signatures with untyped parameters (or `Any` alone)",
            len(untyped),
            [f"{place} {name}: {', '.join(names)}" for _, place, name, names, *_ in untyped],
        ),
        ("of these, of 8 parameters or more", len(wide), _named(wide)),
        ("signatures with `**`", len(many), [f"{place} {name}: **{star}" for _, place, name, _, star, _ in many]),
        ("`Any`", sum(anys.values()), [f"{path}: {n}" for path, n in sorted(anys.items(), key=lambda x: -x[1]) if n]),
        ("modules that import upwards", len({a for a, _ in upwards}), [f"{a} -> {b}" for a, b in upwards]),
        ("imports upwards", len(upwards), []),
        (
            "imports upwards that the contract does not name",
            len(set(upwards) - set(exempt)),
            [f"{a} -> {b}" for a, b in sorted(set(upwards) - set(exempt))],
        ),
        ("switches on names of plans", kinds["name of a plan"], _listed(found, "name of a plan")),
        ("switches on other strings", kinds["string"], _listed(found, "string")),
        ("switches on strings that a constant holds", kinds["named string"], _listed(found, "named string")),
        ("switches on words of Python, numpy, scipy, files", kinds["others' word"], _listed(found, "others' word")),
        ("switches on `Literal`", kinds["Literal"], _listed(found, "Literal")),
        (f"functions of more than {MOST_LINES} lines", len(long), _named(long)),
        ("lines of code", lines(modules), []),
        ("modules", len(modules), []),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[2], help="a checkout; this one")
    parser.add_argument("--list", action="store_true", help="the places behind each number")
    options = parser.parse_args()
    rows = measured(options.folder.resolve())
    print("| what | number |\n|---|---|")
    for what, number, _ in rows:
        print(f"| {what} | {number} |")
    for what, _, places in rows if options.list else []:
        if places:
            print(f"\n{what}:")
            print(*(f"  {place}" for place in places), sep="\n")


if __name__ == "__main__":
    main()
