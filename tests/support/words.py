"""Counts of the words that the package does not use: in names, in strings, in docstrings and in comments.

``python3 tests/support/words.py`` prints one table; ``--list`` the places
behind each number as well. ``python3 tests/support/words.py FOLDER`` counts
in another checkout, so that two commits can be compared by one script.

Strings are those that are no docstrings (messages, labels, titles, names of
signals) and the text of templates. Phrases of ordinary English do not count
("at least", "least squares"), nor do old names in calls of what `_renamed`
defines, which warn. README.md counts as a column of its own.
"""

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("name", "string", "docstring", "comment", "README")


@dataclass(frozen=True)
class Word:
    """A word, what is written instead, and how each is recognised.

    Attributes
    ----------
    word, instead : str
        As in the house style.
    prose : str
        Regular expression for text in lower case, underscores read as spaces.
    names : str
        Regular expression for a part of a name between underscores; empty where
        the word is ordinary in names.
    allowed : str
        Regular expression of the phrases that do not count.
    """

    word: str
    instead: str
    prose: str
    names: str = ""
    allowed: str = ""


WORDS = (
    Word("leg", "segment", r"legs?", r"legs?"),
    Word(
        "least, greatest",
        "minimum, maximum, peak",
        r"least|greatest",
        r"least|greatest",
        r"at( the very)? least|least[- ]squares|least recently|least[- ]significant",
    ),
    Word(
        "most", "maximum, peak", r"most", r"most", r"at( the very)? most|most (of|often|recent(ly)?|important|common)"
    ),
    Word("asked", "commanded, required", r"asks?|asked|asking", r"asks?|asked"),
    Word("put out", "output", r"puts? out|put(ting)? out", r"puts"),
    Word("driven", "input", r"driven|drives(?= by)", r"driven|drives"),
    Word("refuse", "reject, raise", r"refus(e|es|ed|al|als|ing)", r"refus(e|es|ed|al|als)"),
    Word("overrule, insist", "override, require", r"overrul\w+|insist\w*", r"overrul\w+|insist\w*"),
    Word("at once", "direct feedthrough, immediately", r"at once"),
    Word("worth", "benefit", r"worth", r"worth"),
    Word("rival", "baseline", r"rivals?", r"rivals?"),
    Word("needs, takes", "required duration, duration", r"(?<=\w )takes? \d|needs? \d", r"needs|takes"),
    Word("kept", "satisfied", r"(limits?|constraints?|required)( is| are| was| were)?( not)? kept", r"kept"),
    Word(
        "win, lose",
        "best, worst",
        r"wins?|loses?|winners?|losers?",
        r"wins?|loses?|winners?|losers?",
        r"loses? (a |its |their |all |some )?(digits?|accuracy|precision|worker)",
    ),
    Word("let", "limit, allow", r"(does not|do not|which|that) lets?"),
    Word("lost", "nan, missing", r"(inputs?|signals?|measurements?|samples?) (is |are |was |were )?lost", r"lost"),
    Word(
        "clock",
        "time law, time scaling",
        r"clocks?|laws? of time",
        r"clocks?",
        r"(wall|plc|cpu|system|monotonic)[- ]clocks?",
    ),
    Word("come to rest sooner", "too slow for", r"comes? to rest sooner"),
    Word("for ever", "for all future times", r"for ?ever", r"forever"),
    Word("in any case", "otherwise, always", r"in any case"),
    Word("anew", "again", r"anew|made again", r"anew"),
    Word("beside", "next to, in addition to", r"besides?", r"besides?"),
    Word("hang on", "depend on", r"hangs? on", r"hangs?"),
    Word("look at", "evaluate", r"look(s|ed|ing)? at", r"looked"),
    Word("make of", "states and inputs", r"mak(es?|ing) of|made of (it|them)"),
    Word(
        "afterwards",
        "residual, after the move",
        r"(sway|error|vibration|deviation)s? afterwards|on the way",
        r"afterwards",
    ),
    Word("wander", "excess path length", r"wander(s|ed|ing)?", r"wander(s|ed|ing)?"),
    Word("turning point", "reversal", r"turning points?"),
    Word("still law, trouble", "set-point law, scenario", r"still laws?|generator laws?|troubles?", r"troubles?"),
    Word("as it likes", "unknown but bounded", r"as (it|they|he|one) likes?"),
    Word("get through", "fail", r"(get|gets|got) through"),
)
FIXED = ("wandering", "turning_points", "worth", "rivals")
"""Names of metrics, and keys of study files and results, that scripts use and that remain; in prose they are quoted."""

_QUOTED = re.compile(rf"^(?:{'|'.join(FIXED)})$|[\"'`]({'|'.join(FIXED)})[\"'`]|\b({'|'.join(FIXED)})(?=\(|$)", re.M)
_PROSE = [re.compile(rf"\b(?:{word.prose})\b") for word in WORDS]
_ANY = re.compile(rf"\b(?:{'|'.join(word.prose for word in WORDS)})\b")
_ALLOWED = [re.compile(rf"\b(?:{word.allowed})\b") if word.allowed else None for word in WORDS]
_NAMES = [re.compile(rf"(?:{word.names})") if word.names else None for word in WORDS]


def in_text(text):
    """Words of the list in a text, once for each time they occur."""
    plain = re.sub(r"[\s_]+", " ", _QUOTED.sub("", text)).lower()
    if not _ANY.search(plain):
        return []
    found = []
    for word, pattern, allowed in zip(WORDS, _PROSE, _ALLOWED, strict=True):
        rest = allowed.sub("", plain) if allowed else plain
        found += [word] * sum(1 for _ in pattern.finditer(rest))
    return found


@cache  # a module has the same names many times
def in_name(name):
    """Words of the list that are parts of a name."""
    if name in FIXED:
        return []
    parts = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().replace("least_squares", "").split("_")
    return [
        word
        for word, pattern in zip(WORDS, _NAMES, strict=True)
        if pattern and any(pattern.fullmatch(part) for part in parts)
    ]


def strings(tree):
    """Nodes of string constants: docstrings, and the others but for old names in calls of what `_renamed` defines."""
    nodes = list(ast.walk(tree))
    docstrings = [
        node.value
        for node in nodes
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    skipped = {id(node) for node in docstrings}
    for node in nodes:
        if isinstance(node, ast.Call) and re.search(r"renamed|former", ast.unparse(node.func)):
            skipped |= {id(inner) for inner in ast.walk(node)}
    others = [
        node
        for node in nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped
    ]
    return docstrings, others


def deprecated(tree, text):
    """Names of the functions that stand for a new name and warn."""
    return {
        node.name
        for node in ([] if "Deprecated name of" not in text else ast.walk(tree))
        if isinstance(node, ast.FunctionDef) and (ast.get_docstring(node) or "").startswith("Deprecated name of")
    }


def in_module(path):
    """Each word found in a module as (kind, word, line, text)."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    old = deprecated(tree, text)
    docstrings, others = strings(tree)
    found = [("docstring", word, node.lineno, node.value) for node in docstrings for word in in_text(node.value)]
    found += [("string", word, node.lineno, node.value) for node in others for word in in_text(node.value)]
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME and token.string not in old:
            found += [("name", word, token.start[0], token.string) for word in in_name(token.string)]
        if token.type == tokenize.COMMENT:
            found += [("comment", word, token.start[0], token.string) for word in in_text(token.string)]
    return found


def in_template(path):
    """Each word found in the text of a template, line by line, without its tags; none in scripts."""
    if path.suffixes == [".js", ".html"]:
        return []
    rows = re.sub(r"<[^<>]*>|\{[%#].*?[%#]\}|\{\{.*?\}\}", " ", path.read_text(encoding="utf-8")).splitlines()
    return [("string", word, line, row) for line, row in enumerate(rows, 1) for word in in_text(row)]


def in_package(root):
    """Each word found in ctrlplan/ and README.md of a checkout as (path, kind, word, line, text)."""
    found = []
    for path in sorted((root / "ctrlplan").rglob("*")):
        read = {".py": in_module, ".html": in_template}.get(path.suffix)
        if read:
            found += [(path.relative_to(root), *row) for row in read(path)]
    for line, row in enumerate((root / "README.md").read_text(encoding="utf-8").splitlines(), 1):
        found += [(Path("README.md"), "README", word, line, row) for word in in_text(row)]
    return found


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("root", nargs="?", type=Path, default=ROOT, help="a checkout; this one by default")
    parser.add_argument("--list", action="store_true", help="print each place")
    options = parser.parse_args()
    found = in_package(options.root)
    if options.list:
        for path, kind, word, line, text in found:
            print(f"{path}:{line}: {kind}: {word.word} -> {word.instead}: {' '.join(text.split()):.90}")
    counts = Counter((word.word, kind) for _, kind, word, _, _ in found)
    print(f"{'word':<20}" + "".join(f"{kind:>10}" for kind in KINDS) + f"{'all':>8}")
    for name in [word.word for word in WORDS]:
        row = [counts[name, kind] for kind in KINDS]
        print(f"{name:<20}" + "".join(f"{n:>10}" for n in row) + f"{sum(row):>8}")
    sums = [sum(counts[word.word, kind] for word in WORDS) for kind in KINDS]
    print(f"{'all':<20}" + "".join(f"{n:>10}" for n in sums) + f"{sum(sums):>8}")


if __name__ == "__main__":
    main()
