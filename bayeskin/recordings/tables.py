"""Rows of text or spreadsheet files, as they stand, to columns of numbers; every fault names its row."""

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

_HEADER_WITHIN = 50  # rows searched for the header; laboratory exports put a preamble before it
_CHUNK = 50_000  # rows held as text at a time
MOST_UNPACKED = 2**30  # bytes of a workbook's parts; a sheet of a million rows with three columns has 10^8
Row = Sequence[Any]
Split = Callable[[Iterable[str]], Iterator[Row]]


@dataclass(frozen=True)
class Table:
    """The three columns of a file as numbers in the file's own units, and where they came from.

    values maps time, displacement and force to arrays (n,); first_row is the file's number of row 0.
    """

    columns: dict[str, Column]
    values: dict[str, Array]
    first_row: int
    headers: tuple[str, ...]
    where: str
    notes: tuple[str, ...] = ()


def read_text(path: Path, data: bytes) -> Table:
    """Columns of a csv, tsv or txt file: delimiter, decimal sign and encoding found by looking.

    Raises
    ------
    InputError : no such header, a row with too many or too few cells, a cell that is no number.
    """
    text, encoding = _decode(path, data)
    split = _choose_split(path, list(islice(_lines(text), _HEADER_WITHIN)))
    try:
        table = _tabulate(str(path), split(_lines(text)))
    except csv.Error as error:
        raise InputError(path, f"text that is not a table ({error})", "rows of cells") from None
    if encoding == "utf-8":
        return table
    return replace(table, notes=(f"text read as {encoding}",))


def read_workbook(path: Path, data: bytes, sheet: str | None) -> Table:
    """Columns of the one sheet of an xlsx file that has them (or of `sheet`).

    Raises
    ------
    InputError : unreadable file, no or several sheets with the columns, an empty or textual cell.
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
            found = f"the columns in {len(wanted)} of the sheets {names}"
            raise InputError(path, found, "time, displacement and force in one sheet, or its name given")
        return _tabulate(f"{path}: sheet {wanted[0]!r}", book[wanted[0]].iter_rows(values_only=True))
    except InputError:
        raise
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise InputError(path, f"a damaged file ({_one_line(error)})", "an xlsx workbook") from None
    except Exception as error:  # openpyxl lets whatever its XML and zip layers raise through
        found = f"a workbook that cannot be read ({type(error).__name__}: {_one_line(error)})"
        raise InputError(path, found, "an xlsx workbook") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _sheet_has_header(sheet: Any) -> bool:
    rows = sheet.iter_rows(values_only=True) if hasattr(sheet, "iter_rows") else ()
    return any(is_header(_texts(row)) for row in islice(rows, _HEADER_WITHIN))


def _texts(row: Row) -> list[str]:
    return ["" if cell is None else str(cell) for cell in row]


def _decode(path: Path, data: bytes) -> tuple[str, str]:
    """Text, and the encoding that it was in: Unicode, or what a Western European Windows writes."""
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
    raise InputError(path, "bytes that are not text", "text in UTF-8, UTF-16 with its mark, or Windows-1252")


def _lines(text: str) -> Iterator[str]:
    """The lines one by one: ten million of them as a list would take a gigabyte."""
    return (found[1] for found in re.finditer(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)", text))


def _split_by(delimiter: str) -> Split:
    return lambda lines: csv.reader(lines, delimiter=delimiter, strict=True)


def _split_by_blanks(lines: Iterable[str]) -> Iterator[Row]:
    """Cells parted by blanks; a unit in brackets belongs to the word before it."""
    cell = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?|\S")
    return (cell.findall(line) for line in lines)


def _choose_split(path: Path, lines: Sequence[str]) -> Split:
    """The way of cutting lines into cells under which one of the first lines is a header."""
    for split in (*map(_split_by, ";\t,"), _split_by_blanks):
        try:
            if any(is_header(row) for row in split(lines)):
                return split
        except csv.Error:
            continue
    first = next((line.strip() for line in lines if line.strip()), "")
    found = f"no header (the first line is {first[:60]!r})"
    raise InputError(path, found, "a header that names a time, a displacement and a force column")


def _tabulate(where: str, rows: Iterable[Row]) -> Table:
    """Header, then an optional row of units, then numbers to the end."""
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
    """The columns with the units of a row such as ``s; mm; N`` filled in; None if the row is no such row."""
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
    """The needed columns as floats, one chunk of rows in memory as text at a time."""
    filled = _until_blank(where, rows)
    parts = []
    while chunk := list(islice(filled, _CHUNK)):
        _refuse_ragged(where, chunk, needed, len(headers))
        parts.append([_floats(where, chunk, index, headers[index].strip()) for index in needed])
    return list(np.concatenate(parts, axis=1))


def _until_blank(where: str, rows: Iterable[tuple[int, Row]]) -> Iterator[tuple[int, Row]]:
    """The rows up to the first blank one, after which nothing but blank rows may come."""
    blank = 0
    for number, row in rows:
        if _blank(row):
            blank = blank or number
        elif blank:
            raise InputError(f"{where}, row {blank}", f"an empty row before row {number}", "numbers")
        else:
            yield number, row


def _refuse_ragged(where: str, chunk: list[tuple[int, Row]], needed: list[int], width: int) -> None:
    for number, row in chunk:
        if len(row) != width and (len(row) <= max(needed) or not _blank(row[width:])):
            raise InputError(
                f"{where}, row {number}", f"{len(row)} cells", f"{width} cells, as in the header"
            )


def _floats(where: str, chunk: list[tuple[int, Row]], index: int, header: str) -> Array:
    """One column of a chunk; a comma is taken as the decimal sign unless points stand there too."""
    cells = [row[index] for _, row in chunk]
    signs = {sign for sign in ",." if any(isinstance(c, str) and sign in c for c in cells)}
    if signs == {","}:
        cells = [c.replace(",", ".") if isinstance(c, str) else c for c in cells]
    try:
        if any(cell is None or isinstance(cell, bool) for cell in cells):
            raise ValueError
        return np.array(cells, dtype=float)
    except (ValueError, TypeError, OverflowError):
        fault = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        place = f"{where}, row {chunk[fault][0]}, column {header!r}"
        raise InputError(place, _describe_cell(chunk[fault][1][index]), "a number") from None


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
