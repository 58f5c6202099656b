"""Converts the rows of text and spreadsheet files to columns of numbers; every error names the row."""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.errors import InputError
from bayeskin.recordings.headers import UNITS, Column, choose_columns, is_header, parse_unit
from bayeskin.types import Array

_HEADER_WITHIN = 50  # number of rows searched for the header; laboratory exports put a preamble before it
_CHUNK = 50_000  # number of rows that are in memory as text at a time
MOST_UNPACKED = 2**30  # bytes of a workbook's parts; a sheet of a million rows with three columns has 10^8
Row = Sequence[Any]
Split = Callable[[Iterable[str]], Iterator[Row]]


@dataclass(frozen=True)
class Table:
    """The three columns of a file as numbers in the file's own units, with their origin.

    `values` maps time, displacement and force to arrays (n,). `first_row` is the row number in the file of
    the first element of these arrays.
    """

    columns: dict[str, Column]
    values: dict[str, Array]
    first_row: int
    headers: tuple[str, ...]
    where: str
    notes: tuple[str, ...] = ()


def read_text(path: Path, data: bytes) -> Table:
    """Returns the columns of a csv, tsv or txt file; detects its delimiter, decimal sign and encoding.

    Raises
    ------
    InputError : there is no suitable header, a row has too many or too few cells, or a cell is not a number.
    """
    text, encoding = _decode(path, data)
    split = _choose_split(path, list(islice(_lines(text), _HEADER_WITHIN)))
    try:
        table = _tabulate(str(path), split(_lines(text)))
    except csv.Error as error:
        raise InputError(path, f"text that is not a table ({error})", "a table of rows and columns") from None
    if encoding == "utf-8":
        return table
    return replace(table, notes=(f"text read as {encoding}",))


def read_workbook(path: Path, data: bytes, sheet: str | None) -> Table:
    """Returns the columns of the only sheet of an xlsx file that has them, or those of `sheet`.

    Raises
    ------
    InputError : the file cannot be read, no sheet or several sheets have the columns, or a cell is empty or
        contains text.
    """
    import openpyxl

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as parts:
            unpacked = sum(part.file_size for part in parts.infolist())
        if unpacked > MOST_UNPACKED:
            raise InputError(path, f"{unpacked:.2g} bytes when unpacked", f"at most {MOST_UNPACKED:.2g}")
        book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        names = list(book.sheetnames)
        if sheet is not None and sheet not in names:
            raise InputError(path, f"sheets {names}", f"a sheet {sheet!r}")
        wanted = [sheet] if sheet is not None else [n for n in names if _sheet_has_header(book[n])]
        if len(wanted) != 1:
            problem = f"the columns in {len(wanted)} of the sheets {names}"
            raise InputError(path, problem, "time, displacement and force in one sheet, or the sheet's name")
        return _tabulate(f"{path}: sheet {wanted[0]!r}", book[wanted[0]].iter_rows(values_only=True))
    except InputError:
        raise
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise InputError(path, f"a damaged file ({_one_line(error)})", "an xlsx workbook") from None
    except Exception as error:  # openpyxl passes on any exception of its XML and zip layers
        problem = f"a workbook that cannot be read ({type(error).__name__}: {_one_line(error)})"
        raise InputError(path, problem, "an xlsx workbook") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _sheet_has_header(sheet: Any) -> bool:
    rows = sheet.iter_rows(values_only=True) if hasattr(sheet, "iter_rows") else ()
    return any(is_header(_texts(row)) for row in islice(rows, _HEADER_WITHIN))


def _texts(row: Row) -> list[str]:
    return ["" if cell is None else str(cell) for cell in row]


def _decode(path: Path, data: bytes) -> tuple[str, str]:
    """Returns the text and its encoding: Unicode, or the encoding of Western European Windows."""
    if not data.strip():
        raise InputError(path, "an empty file", "a header row and rows of numbers")
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    for encoding in ("utf-16",) if utf16 else ("utf-8-sig", "cp1252"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text, encoding.removesuffix("-sig")
    raise InputError(
        path, "bytes that are not text", "text in UTF-8, UTF-16 with a byte order mark, or Windows-1252"
    )


def _lines(text: str) -> Iterator[str]:
    """Returns an iterator over the lines, because a list of ten million lines would take a gigabyte."""
    return (match[1] for match in re.finditer(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)", text))


def _split_by(delimiter: str) -> Split:
    return lambda lines: csv.reader(lines, delimiter=delimiter, strict=True)


def _split_by_blanks(lines: Iterable[str]) -> Iterator[Row]:
    """Splits lines into cells at blanks; a unit in brackets belongs to the word before it."""
    cell = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?|\S")
    return (cell.findall(line) for line in lines)


def _choose_split(path: Path, lines: Sequence[str]) -> Split:
    """Returns the function that splits lines into cells such that one of the first lines is a header."""
    for split in (*map(_split_by, ";\t,"), _split_by_blanks):
        try:
            if any(is_header(row) for row in split(lines)):
                return split
        except csv.Error:
            continue
    first = next((line.strip() for line in lines if line.strip()), "")
    problem = f"no header (the first line is {first[:60]!r})"
    raise InputError(path, problem, "a header that names a time, a displacement and a force column")


def _tabulate(where: str, rows: Iterable[Row]) -> Table:
    """Returns the table of rows with a header, an optional row of units, and then numbers to the end."""
    numbered = enumerate(rows, start=1)
    header_row, headers = next(
        ((n, _texts(row)) for n, row in islice(numbered, _HEADER_WITHIN) if is_header(_texts(row))), (0, [])
    )
    if not header_row:
        raise InputError(where, "no header", "a header that names a time, a displacement and a force column")
    columns = choose_columns(f"{where}, row {header_row}", headers)
    first = next(((n, row) for n, row in numbered if not _blank(row)), None)
    if first is None:
        raise InputError(where, "no row below the header", "rows of numbers")
    units = _unit_row(columns, first[1])
    if units is not None:
        columns = units
        first = next(((n, row) for n, row in numbered if not _blank(row)), first)
    needed = [columns[quantity].index for quantity in columns]
    values = _numbers(where, chain([first], numbered), needed, headers)
    by_quantity = dict(zip(columns, values, strict=True))
    return Table(columns, by_quantity, first[0], tuple(headers), where)


def _blank(row: Row) -> bool:
    return all(cell is None or (isinstance(cell, str) and not cell.strip()) for cell in row)


def _unit_row(columns: dict[str, Column], row: Row) -> dict[str, Column] | None:
    """Returns the columns with the units from a row such as ``s; mm; N``, or None if it is not such a row."""
    filled = {}
    for quantity, column in columns.items():
        cell = row[column.index] if column.index < len(row) else None
        unit = parse_unit(cell.strip("[]() ")) if isinstance(cell, str) else ""
        if unit not in UNITS[quantity]:
            return None
        filled[quantity] = replace(column, unit=column.unit or unit)
    return filled


def _numbers(
    where: str, rows: Iterable[tuple[int, Row]], needed: list[int], headers: list[str]
) -> list[Array]:
    """Returns the needed columns as floats; only one chunk of rows is in memory as text at a time."""
    filled = _until_blank(where, rows)
    parts = []
    while chunk := list(islice(filled, _CHUNK)):
        _refuse_ragged(where, chunk, needed, len(headers))
        parts.append([_floats(where, chunk, index, headers[index].strip()) for index in needed])
    return list(np.concatenate(parts, axis=1))


def _until_blank(where: str, rows: Iterable[tuple[int, Row]]) -> Iterator[tuple[int, Row]]:
    """Yields the rows up to the first blank row; only blank rows may follow it."""
    blank = 0
    for number, row in rows:
        if _blank(row):
            blank = blank or number
        elif blank:
            raise InputError(f"{where}, row {blank}", f"an empty row before row {number}", "a row of numbers")
        else:
            yield number, row


def _refuse_ragged(where: str, chunk: list[tuple[int, Row]], needed: list[int], width: int) -> None:
    for number, row in chunk:
        if len(row) != width and (len(row) <= max(needed) or not _blank(row[width:])):
            raise InputError(
                f"{where}, row {number}", f"{len(row)} cells", f"{width} cells, as in the header"
            )


def _floats(where: str, chunk: list[tuple[int, Row]], index: int, header: str) -> Array:
    """Returns one column of a chunk; a comma is the decimal sign unless the column contains points too."""
    cells = [row[index] for _, row in chunk]
    signs = {sign for sign in ",." if any(isinstance(c, str) and sign in c for c in cells)}
    if signs == {","}:
        cells = [c.replace(",", ".") if isinstance(c, str) else c for c in cells]
    try:
        if any(cell is None or isinstance(cell, bool) for cell in cells):
            raise ValueError
        return np.array(cells, dtype=float)
    except (ValueError, TypeError, OverflowError):
        bad = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        place = f"{where}, row {chunk[bad][0]}, column {header!r}"
        raise InputError(place, _describe_cell(chunk[bad][1][index]), "a number") from None


def _is_number(cell: Any) -> bool:
    if cell is None or isinstance(cell, bool):
        return False
    try:
        np.array([cell], dtype=float)
    except (ValueError, TypeError, OverflowError):
        return False
    return True


def _describe_cell(cell: Any) -> str:
    if cell is None or not str(cell).strip():
        return "an empty cell, or a formula whose value is not stored in the file"
    return repr(cell)[:60]
