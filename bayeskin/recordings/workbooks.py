"""Yields the rows of the sheets of xlsx and xls workbooks, and those of a numpy array."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.errors import InputError
from bayeskin.recordings.text import NumberedRow, Rows

WORKBOOKS = (".xlsx", ".xlsm", ".xls")  # the endings of workbooks
MOST_UNPACKED = 2**30  # bytes of a workbook's parts; a sheet of a million rows with three columns has 10^8
_MOST_ROWS, _MOST_COLUMNS = 2**20, 4096  # a sheet cannot have more rows, and a recording needs few columns
_EARLY_EXCEL = (b"\x09\x00", b"\x09\x02", b"\x09\x04", b"\x09\x08")  # the first record of a workbook


def sheets_of_workbook(path: Path, kind: str, data: bytes) -> Mapping[str, Rows] | None:
    """Returns the rows of the sheets of a workbook, or None for a text. The content decides, not the name."""
    if data.startswith(b"PK\x03\x04") or kind in (".xlsx", ".xlsm"):
        return sheets_of_xlsx(path, data)
    if data.startswith(b"\xd0\xcf\x11\xe0") or (kind == ".xls" and data[:2] in _EARLY_EXCEL):
        return sheets_of_xls(path, data)
    return None


def sheets_of_xlsx(path: Path, data: bytes) -> Mapping[str, Rows]:
    """Returns the rows of each sheet of an xlsx file, by the sheet's name.

    The dimension that a sheet states is not used, because some programs do not update it. Raises InputError,
    at once or while rows are read, for a file that cannot be read or unpacks to too much.
    """
    import openpyxl

    def rows(sheet: Any) -> Iterator[NumberedRow]:
        sheet.reset_dimensions()
        return _guarded(path, sheet.iter_rows(values_only=True))

    with _faults_named(path, "an xlsx workbook"):
        with zipfile.ZipFile(io.BytesIO(data)) as parts:
            unpacked = sum(part.file_size for part in parts.infolist())
        if unpacked > MOST_UNPACKED:
            raise InputError(
                path, f"it has {unpacked:.2g} bytes when unpacked", f"it can have at most {MOST_UNPACKED:.2g}"
            )
        book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        sheets = [sheet for sheet in book.worksheets if hasattr(sheet, "reset_dimensions")]
        return {sheet.title: partial(rows, sheet) for sheet in sheets}


def sheets_of_xls(path: Path, data: bytes) -> Mapping[str, Rows]:
    """Returns the rows of each sheet of an xls file (Excel 2 to 2003), by the sheet's name.

    Raises InputError, at once or while rows are read, for a file that cannot be read.
    """
    import xlrd

    cell_kinds = {xlrd.XL_CELL_TEXT: str, xlrd.XL_CELL_NUMBER: float, xlrd.XL_CELL_BOOLEAN: bool}

    def cell(kind: int, value: Any) -> Any:
        if kind in (xlrd.XL_CELL_EMPTY, xlrd.XL_CELL_BLANK):
            return None
        return cell_kinds[kind](value) if kind in cell_kinds else f"date or error {value!r}"

    def rows(number: int) -> Iterator[NumberedRow]:
        with _faults_named(path, "an xls workbook"):
            sheet = book.sheet_by_index(number)
        cells = (
            [cell(kind, value) for kind, value in zip(sheet.row_types(i), sheet.row_values(i), strict=True)]
            for i in range(sheet.nrows)
        )
        return _guarded(path, cells)

    with _faults_named(path, "an xls workbook"):
        book = xlrd.open_workbook(file_contents=data, logfile=io.StringIO(), on_demand=True, ragged_rows=True)
        return {name: partial(rows, number) for number, name in enumerate(book.sheet_names())}


def rows_of_array(path: Path, data: bytes) -> Rows:
    """Returns the rows of a two-dimensional or structured array in an npy file; field names are its header.

    Nothing in the file is unpickled. Raises InputError for any other array.
    """
    expected = "an npy file with a table of numbers, (samples, columns)"
    with _faults_named(path, expected):
        file = io.BytesIO(data)
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        shape, _, dtype = read_header[version](file)
        if dtype.hasobject or np.prod(shape, dtype=float) * dtype.itemsize > len(data):
            raise InputError(
                path, f"it contains an array of shape {shape} and type {dtype}", f"bayeskin needs {expected}"
            )
        file.seek(0)
        array = np.load(file, allow_pickle=False)
        names = array.dtype.names
        columns = [array[name] for name in names] if names else list(array.T) if array.ndim == 2 else []
        if not columns or any(c.ndim != 1 or c.dtype.kind not in "iuf" for c in columns):
            raise InputError(
                path, f"it contains an array of shape {shape} and type {dtype}", f"bayeskin needs {expected}"
            )
    header = [names] if names else []
    return lambda: enumerate([*header, *zip(*(c.tolist() for c in columns), strict=True)], start=1)


def _guarded(path: Path, rows: Iterable[Sequence[Any]]) -> Iterator[NumberedRow]:
    """Yields the numbered rows of a sheet. Raises InputError for a fault of the file or a sheet too large."""
    with _faults_named(path, "a workbook"):
        for number, row in enumerate(rows, start=1):
            if number > _MOST_ROWS or len(row) > _MOST_COLUMNS:
                problem = f"a sheet has {number} rows and {len(row)} columns or more"
                raise InputError(
                    path, problem, f"it can have at most {_MOST_ROWS} rows and {_MOST_COLUMNS} columns"
                )
            yield number, row


@contextmanager
def _faults_named(path: Path, expected: str) -> Iterator[None]:
    """Turns every error of a library that reads a user's file into an InputError that names the file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # openpyxl, xlrd and numpy pass on any exception of the layers below them
        said = " ".join(str(error).split())[:120]
        problem = f"it cannot be read ({type(error).__name__}: {said})"
        raise InputError(path, problem, f"bayeskin needs {expected}") from None
