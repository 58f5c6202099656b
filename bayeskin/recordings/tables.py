"""Finds the tables of a sheet or a text: rows of numbers below a heading, one below or beside the other."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, dropwhile, islice, pairwise, takewhile
from typing import Any

from bayeskin.errors import InputError
from bayeskin.recordings.columns import Candidates, Heading, Stated, candidates_of
from bayeskin.recordings.headers import is_rule, is_unit_row, names_quantities, without_comment
from bayeskin.recordings.numbers import Numbers, describe_cell, is_number
from bayeskin.recordings.text import NumberedRow, Rows, header_cells
from bayeskin.types import Array

_CHUNK = 50_000  # number of rows that are in memory as text at a time
_ABOVE = 4  # rows above the numbers that may be their heading
_SECTION = re.compile(r"<(?!END|DATA|INFO|divider|Mach-1 File)([^<>]+)>")  # Mach-1 names its functions so
_THOUSANDS, _GROUP = re.compile(r"[+-]?[1-9]\d{0,2}"), re.compile(r"\d{3}(?:[.,]\d*)?")
Row = Sequence[Any]
Line = tuple[int, list[str]]  # a row that holds no numbers


@dataclass(frozen=True)
class Table:
    """The candidate columns of one table, with their numbers in the file's own units.

    where : its file and sheet, for messages
    title : the text above its heading, or ""
    candidates : the columns that may hold each quantity
    numbers : the numbers of each of these columns, by the column's index
    first_row : the row in the file of the first numbers
    heading : names and units of all columns
    """

    where: str
    title: str
    candidates: Candidates
    numbers: dict[int, Numbers]
    first_row: int
    heading: Heading

    @property
    def place(self) -> str:
        """Returns where its heading stands, for messages."""
        return f"{self.where}, row {self.heading.row}"

    @property
    def rows(self) -> int:
        """Returns the number of rows of numbers."""
        parts = next(iter(next(iter(self.numbers.values())).read.values()))
        return sum(map(len, parts))


@dataclass(frozen=True)
class Unreadable:
    """Rows of numbers without columns of time, displacement and force, and the error that says so."""

    title: str
    rows: int
    error: InputError


def tables_of(where: str, rows: Rows, stated: Stated, by_blanks: bool = False) -> list[Table | Unreadable]:
    """Returns the tables of a sheet or a text, in the order of the file.

    by_blanks : whether blanks separate the columns, so that a row of numbers has to be complete

    Raises
    ------
    InputError : a row within a table has a cell that is no number, or too few or too many cells.
    """
    tables: list[Table | Unreadable] = []
    rows = partial(_without_dividers, rows)
    numbered, width = rows(), 0
    while True:
        above, section, first = _next_numbers(numbered)
        if first is None:
            return tables
        lines = [(n, _names_in(texts, first[1]) if by_blanks else texts) for n, texts in above]
        if tables and isinstance(tables[-1], Table):
            _refuse_interruption(where, lines, first, width)
        width = len(_texts(first[1]))
        try:
            heading = _heading(where, lines, first)
            groups = candidates_of(where, heading, stated)
        except InputError as error:
            count, numbered = _skipped(chain([first], numbered))
            tables.append(Unreadable(section, count, error))
            continue
        reader = _Reader(where, heading, by_blanks)
        if len(groups) == 1:
            numbers, _, numbered = reader.read(groups[0], chain([first], numbered))
            tables.append(Table(where, section, groups[0], numbers, first[0], heading))
            continue
        read = [reader.read(group, _from(rows(), first[0])) for group in groups]
        last = max(end for _, end, _ in read)
        for group, title, (numbers, end, _) in zip(groups, _titles(heading, groups), read, strict=True):
            reader.refuse_numbers_after(numbers, _from(rows(), end), last)
            tables.append(Table(where, title, group, numbers, first[0], heading))
        numbered = _from(rows(), last)


def _without_dividers(rows: Rows) -> Iterator[NumberedRow]:
    """Yields rows without those by which a Mach-1 divides the steps of one function."""
    return (row for row in rows() if row[1] != ["<divider>"])


def _texts(row: Row) -> list[str]:
    texts = ["" if cell is None else str(cell) for cell in row]
    while texts and not texts[-1].strip():
        texts.pop()
    return texts


def _names_in(texts: list[str], row: Row) -> list[str]:
    """Returns the names in a line whose columns are set by blanks, above a row of numbers."""
    return header_cells(texts[0], len(row)) or texts


def _holds_numbers(row: Row) -> bool:
    return len(list(islice(filter(is_number, row), 2))) == 2


def _next_numbers(numbered: Iterator[NumberedRow]) -> tuple[list[Line], str, NumberedRow | None]:
    """Returns the last rows before the next row of numbers, the section they name, and the row of numbers."""
    above: deque[Line] = deque(maxlen=_ABOVE)
    section = ""
    for number, row in numbered:
        if _holds_numbers(row):
            return list(above), section, (number, row)
        texts = _texts(row)
        if not is_rule(texts):
            above.append((number, texts))
            named = _SECTION.fullmatch(texts[0].strip())
            section = named[1] if named and len(texts) == 1 else section
    return list(above), section, None


def _refuse_interruption(where: str, above: Sequence[Line], first: NumberedRow, width: int) -> None:
    """Raises InputError for numbers that continue the table above them after rows without numbers."""
    if not above:
        raise InputError(
            f"{where}, row {first[0] - 1}",
            f"it is empty, although numbers follow in row {first[0]}",
            "rows of numbers must follow each other",
        )
    if len(_texts(first[1])) == width and not any(names_quantities(texts) >= 2 for _, texts in above):
        problem = f"{' '.join(above[0][1])[:60]!r} stands between rows of numbers"
        raise InputError(f"{where}, row {above[0][0]}", problem, "rows of numbers must follow each other")


def _heading(where: str, above: Sequence[Line], first: NumberedRow) -> Heading:
    """Returns the names and units that stand right above the first row of numbers."""
    number, row = first
    width = len(_texts(row))
    lines = list(reversed(above))
    units: tuple[str, ...] = ()
    if lines and is_unit_row(lines[0][1]):
        units = tuple(lines.pop(0)[1])
    named = lines[0] if lines else (number, [])
    if len(named[1]) > 1 and width == 2 * len(named[1]):
        problem = f"{len(named[1])} names stand above rows of {width} cells"
        raise InputError(
            f"{where}, row {named[0]}", problem, "the delimiter must not be the decimal sign as well"
        )
    if len(named[1]) < width:
        said = f"only {' '.join(named[1])[:80]!r} stands" if lines else "no names stand"
        fault = f"{said} above rows of {width} cells"
        return Heading(named[0], ("",) * width, _filled(units, width), fault=fault)
    names = (without_comment(named[1][0]), *named[1][1:])
    title = lines[1][1] if len(lines) > 1 else []
    return Heading(named[0], names, _filled(units, len(names)), tuple(title))


def _filled(cells: tuple[str, ...], width: int) -> tuple[str, ...]:
    return (*cells, *("",) * width)[:width]


def _titles(heading: Heading, groups: Sequence[Candidates]) -> list[str]:
    """Returns for each of several tables side by side the only text above its columns, or ""."""
    starts = [min(column.index for columns in group.values() for column in columns) for group in groups]
    above = [heading.title[start:end] for start, end in pairwise([*starts, None])]
    texts = [{cell.strip() for cell in cells if cell.strip()} for cells in above]
    return [cells.pop() if len(cells) == 1 else "" for cells in texts]


def _skipped(numbered: Iterator[NumberedRow]) -> tuple[int, Iterator[NumberedRow]]:
    """Returns the number of rows of numbers that follow, and the rows after them."""
    count = 0
    for number, row in numbered:
        if not _holds_numbers(row):
            return count, chain([(number, row)], numbered)
        count += 1
    return count, iter(())


def _from(rows: Iterator[NumberedRow], number: int) -> Iterator[NumberedRow]:
    return dropwhile(lambda row: row[0] < number, rows)


@dataclass(frozen=True)
class _Reader:
    """Reads the rows of numbers below one heading; `exact` asks for as many cells as there are names."""

    where: str
    heading: Heading
    exact: bool

    def read(
        self, group: Candidates, numbered: Iterator[NumberedRow]
    ) -> tuple[dict[int, Numbers], int, Iterator[NumberedRow]]:
        """Returns the numbers of a table's columns, the row at which the table ends, and the rows from there.

        The table ends where no column has a number. Only one chunk of rows is in memory as text at a time.
        """
        needed = {column.index: Numbers() for columns in group.values() for column in columns}
        last = 0
        while chunk := list(islice(numbered, _CHUNK)):
            try:
                parsed = {i: numbers.parsed([row[i] for _, row in chunk]) for i, numbers in needed.items()}
                end = len(chunk)
            except (ValueError, IndexError):
                end = self._end(needed, chunk)
                parsed = {i: self._parsed(i, numbers, chunk[:end]) for i, numbers in needed.items()}
            self._refuse_ragged(chunk[:end])
            self._refuse_blank_thousands(needed, chunk[:end])
            for i, values in parsed.items():
                needed[i].append(values)
            if end < len(chunk):
                return needed, chunk[end][0], chain(chunk[end:], numbered)
            last = chunk[-1][0]
        return needed, last + 1, iter(())

    def refuse_numbers_after(self, needed: dict[int, Numbers], rows: Iterator[NumberedRow], end: int) -> None:
        """Raises InputError if a table has numbers between its own end and row `end`, where all end."""
        for number, row in takewhile(lambda row: row[0] < end, rows):
            if any(i < len(row) and is_number(row[i]) for i in needed):
                raise InputError(
                    f"{self.where}, row {number}",
                    "it has numbers below an empty cell",
                    "a column must not have a gap",
                )

    def _end(self, needed: dict[int, Numbers], chunk: Sequence[NumberedRow]) -> int:
        """Returns the index of the row at which the table ends. Raises InputError for an incomplete row."""
        for k, (number, row) in enumerate(chunk):
            bad = [i for i in needed if i >= len(row) or not is_number(row[i])]
            if len(bad) == len(needed):
                return k
            if bad and bad[0] >= len(row):
                raise self._ragged(number, row)
            if bad:
                raise InputError(
                    self._place(number, bad[0]), describe_cell(row[bad[0]]), "it must be a number"
                )
        return len(chunk)

    def _parsed(self, i: int, numbers: Numbers, chunk: Sequence[NumberedRow]) -> dict[str, Array]:
        """Returns a column of a chunk. Raises InputError for the first cell whose notation differs."""
        cells = [row[i] for _, row in chunk]
        try:
            return numbers.parsed(cells)
        except ValueError:
            k, remedy = numbers.first_wrong(cells)
            raise InputError(
                self._place(chunk[k][0], i), f"the cell contains {cells[k]!r}"[:80], remedy
            ) from None

    def _place(self, number: int, i: int) -> str:
        return f"{self.where}, row {number}, column {self.heading.names[i].strip() or i + 1!r}"

    def _refuse_ragged(self, chunk: Sequence[NumberedRow]) -> None:
        width = len(self.heading.names)
        if {len(row) for _, row in chunk} <= {width}:
            return
        for number, row in chunk:
            if (len(row) < width and self.exact) or len(_texts(row)) > width:
                raise self._ragged(number, row)

    def _refuse_blank_thousands(self, needed: dict[int, Numbers], chunk: Sequence[NumberedRow]) -> None:
        """Raises InputError if blanks set the columns and two of them may be one number, such as 1 234.5."""
        if not self.exact or not chunk:
            return
        for left in sorted({j for i in needed for j in (i - 1, i) if 0 <= j < len(self.heading.names) - 1}):
            pairs = ((str(row[left]), str(row[left + 1])) for _, row in chunk)
            if all(_THOUSANDS.fullmatch(a) and _GROUP.fullmatch(b) for a, b in pairs):
                number, row = chunk[0]
                cells = f"'{row[left]} {row[left + 1]}' in columns {left + 1} and {left + 2}"
                problem = f"{cells} may be one number"
                raise InputError(f"{self.where}, row {number}", problem, "use another delimiter than blanks")

    def _ragged(self, number: int, row: Row) -> InputError:
        remedy = f"it must be {len(self.heading.names)}, as in the header"
        return InputError(f"{self.where}, row {number}", f"the number of cells is {len(row)}", remedy)
