"""Entries of study files: type, range and meaning, for the reader and for the JSON Schema of editors."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from ctrlplan._types import Data, Value
from ctrlplan.studies.reading import Reader, StructureError, got, is_number, reference


class Kind(ABC):
    """Kind of the values of an entry: one check, and the same condition as a JSON Schema.

    A new kind must define `must`, `fits`, `schema`, and `read` if its values
    contain others.
    """

    @abstractmethod
    def must(self, place: str) -> str:
        """What a value must be, for messages: "a finite number"."""

    @abstractmethod
    def fits(self, value: object) -> bool:
        """Whether a value has the type and the range, without the values in it."""

    @abstractmethod
    def schema(self) -> Data:
        """JSON Schema of the values."""

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Value, checked.

        Raises
        ------
        StructureError
            If the value, or one in it, is of another type or out of its range.
        """
        if not self.fits(value):
            raise wrong(reader, place, self.must(place), value)
        return value


def wrong(reader: Reader, place: str, must: str, value: object) -> StructureError:
    """Error of a value that is not what it must be; None stands for an entry that is missing."""
    return reader.structure(place, f"must be {must}, got {'none' if value is None else got(value)}")


@dataclass(frozen=True)
class Entry:
    """Entry of a table.

    Attributes
    ----------
    kind : Kind
        Kind of its values.
    text : str
        What it means, one phrase.
    required : bool
        Whether it must be given.
    default : object
        Value of an entry that is not given; None for none.
    """

    kind: Kind
    text: str
    required: bool = False
    default: Value = None

    def schema(self) -> Data:
        """JSON Schema of its values, with its meaning and default."""
        default = {} if self.default is None else {"default": self.default}
        return {"description": self.text} | self.kind.schema() | default


Entries: TypeAlias = Mapping[str, Entry]
"""Entries of a table by name."""


@dataclass(frozen=True)
class Number(Kind):
    """Real number.

    Attributes
    ----------
    minimum, above, below : float
        Range: at least `minimum`, above `above`, and below `below`.
    finite : bool
        Whether nan and infinities are excluded.
    """

    minimum: float = -math.inf
    above: float = -math.inf
    below: float = math.inf
    finite: bool = True

    def must(self, place: str) -> str:
        """A finite number and its range."""
        size = f", {self.minimum:g} or more" if self.minimum > -math.inf else ""
        size = f" above {self.above:g}" if self.above > -math.inf else size
        most = f"{' and' if size else ''} below {self.below:g}" if self.below < math.inf else ""
        return f"a {'finite ' * self.finite}number{size}{most}"

    def fits(self, value: Value) -> bool:
        """Whether it is a number in the range."""
        if not is_number(value, self.finite):
            return False
        return not (value < self.minimum or value <= self.above > -math.inf or value >= self.below < math.inf)

    def schema(self) -> Data:
        """Number with its range."""
        low = {} if self.minimum == -math.inf else {"minimum": self.minimum}
        low |= {} if self.above == -math.inf else {"exclusiveMinimum": self.above}
        return {"type": "number"} | low | ({} if self.below == math.inf else {"exclusiveMaximum": self.below})

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Number as a float."""
        return float(super().read(value, place, reader))


@dataclass(frozen=True)
class Whole(Kind):
    """Whole number from `minimum` to `maximum`, which may be written with a decimal point."""

    minimum: int
    maximum: int | None = None

    def must(self, place: str) -> str:
        """A whole number and its range."""
        return f"a whole number, {self.minimum} {'or more' if self.maximum is None else f'to {self.maximum}'}"

    def fits(self, value: Value) -> bool:
        """Whether it is a whole number in the range."""
        inside = is_number(value) and value == int(value) and value >= self.minimum
        return bool(inside and (self.maximum is None or value <= self.maximum))

    def schema(self) -> Data:
        """Integer with its range."""
        high = {} if self.maximum is None else {"maximum": self.maximum}
        return {"type": "integer", "minimum": self.minimum} | high

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Number as an int."""
        return int(super().read(value, place, reader))


@dataclass(frozen=True)
class Flag(Kind):
    """Boolean."""

    def must(self, place: str) -> str:
        """True or false."""
        return "true or false"

    def fits(self, value: object) -> bool:
        """Whether it is a Boolean."""
        return isinstance(value, bool)

    def schema(self) -> Data:
        """Boolean."""
        return {"type": "boolean"}


@dataclass(frozen=True)
class Text(Kind):
    """String, one of some if `choices` are given."""

    choices: tuple[str, ...] = ()

    def must(self, place: str) -> str:
        """A string, or one of some."""
        return f"one of {', '.join(self.choices)}" if self.choices else "a string"

    def fits(self, value: object) -> bool:
        """Whether it is a string that is allowed."""
        return isinstance(value, str) and (not self.choices or value in self.choices)

    def schema(self) -> Data:
        """String, or the strings that are allowed."""
        return {"type": "string"} | ({"enum": list(self.choices)} if self.choices else {})


@dataclass(frozen=True)
class Anything(Kind):
    """Value that is checked where it is used."""

    def must(self, place: str) -> str:
        """Anything."""
        return "a value"

    def fits(self, value: object) -> bool:
        """Whether it is given."""
        return value is not None

    def schema(self) -> Data:
        """No condition."""
        return {}


@dataclass(frozen=True)
class Listed(Kind):
    """List of values of one kind.

    Attributes
    ----------
    item : Kind
        Kind of the values.
    text : str
        What the list must be: "a list of finite numbers".
    count : int or None
        Length; None for any.
    """

    item: Kind
    text: str
    count: int | None = None

    def must(self, place: str) -> str:
        """The list in words."""
        return self.text

    def fits(self, value: object) -> bool:
        """Whether it is a list of the length."""
        return isinstance(value, list) and self.count in (None, len(value))

    def schema(self) -> Data:
        """Array of the length."""
        size = {} if self.count is None else {"minItems": self.count, "maxItems": self.count}
        return {"type": "array", "items": self.item.schema()} | size

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """List of the values read."""
        if not self.fits(value) or not all(map(self.item.fits, value)):
            raise wrong(reader, place, self.must(place), value)
        return [self.item.read(one, place, reader) for one in value]


@dataclass(frozen=True)
class Table(Kind):
    """Table.

    Attributes
    ----------
    entries : mapping of str to Entry
        Entries that are known.
    rest : Kind or None
        Kind of all other entries; None if there must be none.
    shipped : bool
        Whether it is part of the JSON Schema of the package.
    """

    entries: Entries
    rest: Kind | None = None
    shipped: bool = True

    def must(self, place: str) -> str:
        """A table and its name."""
        return f"a table [{place}]"

    def fits(self, value: object) -> bool:
        """Whether it is a table."""
        return isinstance(value, dict)

    def schema(self) -> Data:
        """Object with its properties."""
        required = [name for name, entry in self.entries.items() if entry.required]
        return (
            {"type": "object", "properties": {name: entry.schema() for name, entry in self.entries.items()}}
            | ({"required": required} if required else {})
            | {"additionalProperties": False if self.rest is None else self.rest.schema()}
        )

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Table of the values read, with the defaults of entries that are missing."""
        table: Data = super().read(value, place, reader)
        if self.rest is None:
            reader.known(table, self.entries, place or "the file")
        inside = f"{place}." if place else ""
        found: Data = {}
        for name, entry in self.entries.items():
            if name in table or entry.required:
                found[name] = entry.kind.read(table.get(name), inside + name, reader)
            elif entry.default is not None:
                found[name] = entry.default
        for name in table:
            if name not in self.entries and self.rest is not None:
                found[name] = self.rest.read(table[name], inside + name, reader)
        return found


@dataclass(frozen=True)
class Variants(Kind):
    """Table whose entries depend on one of them.

    Attributes
    ----------
    key : str
        Name of that entry.
    tables : callable
        Tables by its value, without that entry.
    text : str
        What that entry means.
    named : str
        If not empty, "python:module:name" is a further value, and this is what
        the name is of: "Class".
    own : Table
        Table of such a value.
    otherwise : str
        Entry that stands for that entry if it is missing; empty for none.
    """

    key: str
    tables: Callable[[], Mapping[str, Table]]
    text: str
    named: str = ""
    own: Table = Table({})
    otherwise: str = ""

    def must(self, place: str) -> str:
        """A table and its name."""
        return f"a table [{place}]"

    def fits(self, value: object) -> bool:
        """Whether it is a table."""
        return isinstance(value, dict)

    def schema(self) -> Data:
        """Any of the tables."""
        branches = []
        for name, table in self.tables().items():
            if not table.shipped:
                continue
            branches.append(_tagged(self.key, {"const": name}, table, self.text))
            if self.otherwise:
                named = table.schema()
                named["properties"] |= {self.otherwise: {"const": name}}
                branches.append(named | {"required": [*named.get("required", ()), self.otherwise]})
        if self.named:
            value = {"type": "string", "pattern": "^python:[^:]*:[^:]*$"}
            branches.append(_tagged(self.key, value, self.own, self.text))
        return {"type": "object", "anyOf": branches}

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Table of the values read, with the entry that determines them."""
        data: Data = super().read(value, place, reader)
        stated = data.get(self.key, data.get(self.otherwise))
        known = self.tables()
        table = known.get(stated) if isinstance(stated, str) else None
        if table is None and self.named and reference(stated) is not None:
            table = self.own
        if table is None:
            names = ", ".join([*known, *([f'"python:module:{self.named}"'] if self.named else [])])
            raise reader.structure(f"{place}.{self.key}", f"must be one of {names}, got {got(stated)}")
        entries = {self.key: Entry(Text(), self.text), **table.entries}
        return Table(entries, table.rest).read(data, place, reader) | {self.key: stated}


def _tagged(key: str, value: Data, table: Table, text: str) -> Data:
    """JSON Schema of a table with the entry that determines its other entries."""
    found = table.schema()
    properties = {key: {"description": text} | value} | found["properties"]
    return found | {"properties": properties, "required": [key, *found.get("required", ())]}


@dataclass(frozen=True)
class Tables(Kind):
    """List of tables.

    Attributes
    ----------
    item : Table or Variants
        Kind of the tables.
    minimum : int
        Minimum number.
    """

    item: Table | Variants
    minimum: int = 0

    def must(self, place: str) -> str:
        """Tables, their number and their name."""
        return f"{f'at least {self.minimum} ' if self.minimum else ''}tables [[{place}]]"

    def fits(self, value: object) -> bool:
        """Whether it is a list of tables."""
        return isinstance(value, list) and all(isinstance(one, dict) for one in value)

    def schema(self) -> Data:
        """Array of objects."""
        low = {"minItems": self.minimum} if self.minimum else {}
        return {"type": "array", "items": self.item.schema()} | low

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """List of the tables read."""
        tables = super().read(value, place, reader)
        if len(tables) < self.minimum:
            raise reader.structure(place, f"must be {self.must(place)}, got {len(tables)}")
        return [self.item.read(table, f"{place}[{i}]", reader) for i, table in enumerate(tables)]


@dataclass(frozen=True)
class OneOf(Kind):
    """Value of one of several kinds that differ in type."""

    kinds: tuple[Kind, ...]

    def must(self, place: str) -> str:
        """All kinds in words."""
        *first, last = (kind.must(place) for kind in self.kinds)
        return f"{', '.join(first)} or {last}"

    def fits(self, value: object) -> bool:
        """Whether one fits."""
        return any(kind.fits(value) for kind in self.kinds)

    def schema(self) -> Data:
        """Any of the schemas."""
        return {"anyOf": [kind.schema() for kind in self.kinds]}

    def read(self, value: Value, place: str, reader: Reader) -> Value:
        """Value as the first kind that fits reads it."""
        for kind in self.kinds:
            if kind.fits(value):
                return kind.read(value, place, reader)
        raise wrong(reader, place, self.must(place), value)


NUMBERS = Listed(Number(), "a list of finite numbers")
TEXTS = Listed(Text(), "a list of strings")
PAIR = Listed(Number(), "two finite numbers", 2)
