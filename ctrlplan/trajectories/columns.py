"""Columns of numbers in text files, with the line of each number for messages."""

from __future__ import annotations

import csv
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctrlplan._types import Array

Column = str | int
"""A column by its name in the header, or by its number from 0."""


class Columns(ABC):
    """Columns of numbers, each of the same number of rows.

    A new source must define `title`, `header`, `width`, `numbers` and `spot`.

    Attributes
    ----------
    title : str
        What the columns are read from, for messages.
    header : list of str or None
        Names of the columns, None if they have none.
    width : int
        Number of columns.
    """

    title: str
    header: list[str] | None
    width: int

    @abstractmethod
    def numbers(self, columns: Sequence[int], hint: str = "") -> Array:
        """Numbers of some columns, (nrows, ncolumns).

        Raises
        ------
        ValueError
            If one is missing or not finite, with its place and the hint.
        """

    @abstractmethod
    def spot(self, row: int) -> str:
        """Where a row is: "line 12"."""

    def name(self, column: int) -> str:
        """Description of a column."""
        return repr(self.header[column]) if self.header else f"number {column}"

    def column(self, column: Column) -> int:
        """Number of a column."""
        if isinstance(column, int) and not isinstance(column, bool):
            if 0 <= column < self.width:
                return column
            raise ValueError(f"{self.title} must have a column {column}, got {self.width} columns, from 0")
        if self.header is None:
            raise ValueError(f"{self.title} must have a header with {column!r}, got numbers; give columns by number")
        if column not in self.header:
            raise ValueError(f"{self.title} must have a column {column!r}, got {', '.join(self.header)}")
        return self.header.index(column)

    def increasing(self, column: int, hint: str = "") -> Array:
        """Times of the rows.

        Raises
        ------
        ValueError
            If they do not increase strictly, with the place.
        """
        times = self.numbers([column], hint)[:, 0]
        wrong = np.flatnonzero(~(np.diff(times) > 0.0))
        if wrong.size:
            k = int(wrong[0]) + 1
            raise ValueError(
                f"{self.title}, {self.spot(k)}: times must increase strictly, got {times[k]:g} after {times[k - 1]:g} "
                f"in {self.spot(k - 1)}{hint}"
            )
        return times


class CsvColumns(Columns):
    """Columns of a CSV file, checked when they are read.

    Cells are separated by semicolons if the first line contains one, and decimal
    commas are then allowed; otherwise by commas. Text after # is a comment. The
    first line may be a header.

    Parameters
    ----------
    path : str or path
        File to be read, UTF-8.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.title = os.fspath(path)
        rows = self._rows(Path(path))
        if not rows:
            raise ValueError(f"{self.title} must have lines of numbers, got none")
        line, first = rows[0]
        if len(first) == 1 and "\t" in first[0]:
            raise ValueError(
                f"{self.title}, line {line}: cells must be separated by semicolons or commas, got tabs; replace them"
            )
        self.header = self._header(*rows[0])
        self.width = len(rows[0][1])
        self._cells = rows[self.header is not None :]
        if not self._cells:
            raise ValueError(f"{self.title} must have lines of numbers, got a header only")
        for line, cells in self._cells:
            if len(cells) != self.width:
                raise ValueError(
                    f"{self.title}, line {line}: must have {self.width} cells as the first line, got {len(cells)}"
                )

    def numbers(self, columns: Sequence[int], hint: str = "") -> Array:
        """Numbers of some columns; as `Columns.numbers`."""
        found = np.empty((len(self._cells), len(columns)))
        names = [self.name(column) for column in columns]
        for row, (line, cells) in enumerate(self._cells):
            for k, column in enumerate(columns):
                number = self._number(cells[column])
                if number is None or not math.isfinite(number):
                    got = repr(cells[column]) if cells[column] else "an empty cell"
                    must = f"column {names[k]} must be a finite number"
                    raise ValueError(f"{self.title}, line {line}: {must}, got {got}{hint}")
                found[row, k] = number
        return found

    def spot(self, row: int) -> str:
        """Line of a row."""
        return f"line {self._cells[row][0]}"

    def _rows(self, path: Path) -> list[tuple[int, list[str]]]:
        """Line numbers and cells of all lines that are not empty."""
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path} must be text in UTF-8, got {error}") from None
        lines = [(k, line.partition("#")[0].strip()) for k, line in enumerate(text.split("\n"), 1)]
        lines = [(k, line) for k, line in lines if line]
        self._semicolons = bool(lines) and ";" in lines[0][1]
        delimiter = ";" if self._semicolons else ","
        try:
            return [(k, [c.strip() for c in next(csv.reader([line], delimiter=delimiter))]) for k, line in lines]
        except csv.Error as error:
            raise ValueError(f"{path} must be a table, got {error}") from None

    def _header(self, line: int, cells: list[str]) -> list[str] | None:
        """Names of the columns; None if the first line contains numbers."""
        numeric = [self._number(cell) is not None for cell in cells]
        if all(numeric):
            return None
        if any(numeric) or "" in cells or len(set(cells)) < len(cells):
            raise ValueError(
                f"{self.title}, line {line}: the first line must be numbers or different names, got {', '.join(cells)}"
            )
        return cells

    def _number(self, cell: str) -> float | None:
        """Number in a cell; None if it is not a number."""
        try:
            return None if "_" in cell else float(cell.replace(",", ".") if self._semicolons else cell)
        except ValueError:
            return None
