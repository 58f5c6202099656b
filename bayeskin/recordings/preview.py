"""Shows the first rows of a file as they stand in it, so that a person can say which column holds what."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from bayeskin.errors import InputError
from bayeskin.probe import bytes_of
from bayeskin.recordings.headers import is_rule, is_unit_row
from bayeskin.recordings.numbers import is_number
from bayeskin.recordings.text import TEXT, Rows, header_cells, rows_of_text
from bayeskin.recordings.workbooks import rows_of_array, sheets_of_workbook

ABOVE, BELOW = 4, 5  # rows that are shown above and from the first row of numbers
MOST_COLUMNS, LONGEST_CELL = 60, 80
_ARRAY, _STORED = ".npy", (".h5", ".hdf5")
Row = tuple[int, tuple[str, ...]]  # its number in the file, and its cells as text


@dataclass(frozen=True)
class SheetPreview:
    """The rows of a sheet around its first row of numbers.

    sheet : its name, "" for a text; rows : their numbers in the file, and their cells as text
    names : the texts right above the first numbers, one for each column
    """

    sheet: str
    rows: tuple[Row, ...]
    names: tuple[str, ...]


def preview(path: Path) -> tuple[SheetPreview, ...]:
    """Returns the beginnings of all sheets of a file that have numbers; none for a file of bayeskin.

    Raises InputError for a file that cannot be read.
    """
    kind = path.suffix.lower()
    if kind in _STORED:
        return ()
    data = bytes_of(path, "a recording")
    sheets: Mapping[str, Rows] | None
    if kind == _ARRAY:
        sheets = {"": rows_of_array(path, data)}
    elif (sheets := sheets_of_workbook(path, kind, data)) is None:
        sheets = {"": rows_of_text(path, data)[0]}
    shown = (_beginning(name, rows) for name, rows in sheets.items())
    return tuple(sheet for sheet in shown if sheet is not None)


def _beginning(name: str, rows: Rows) -> SheetPreview | None:
    """Returns the beginning of a sheet, or None if it has no numbers or cannot be read.

    Its numbers begin with the first of several rows that have numbers.
    """
    recent: deque[Row] = deque(maxlen=ABOVE + TEXT.run)
    numbered, run = rows(), 0
    try:
        for number, row in islice(numbered, TEXT.header_within):
            recent.append((number, _texts(row)))
            run = run + 1 if sum(map(is_number, row)) > 1 else 0
            if run == TEXT.run:
                below = [(n, _texts(cells)) for n, cells in islice(numbered, BELOW - run)]
                above = [row for row in list(recent)[:-run] if row[1] and not is_rule(row[1])]
                return SheetPreview(name, (*recent, *below), _names(above, len(_texts(row))))
    except InputError:
        return None
    return None


def _texts(row: Any) -> tuple[str, ...]:
    """Returns the cells of a row as text, without the empty cells at its end."""
    texts = ["" if cell is None else str(cell).strip()[:LONGEST_CELL] for cell in row[:MOST_COLUMNS]]
    while texts and not texts[-1]:
        texts.pop()
    return tuple(texts)


def _names(above: Sequence[Row], width: int) -> tuple[str, ...]:
    """Returns a text for each column, from the nearest row above that has one for each; a unit is added."""
    units: tuple[str, ...] = ("",) * width
    for _, texts in reversed(above):
        cells = texts if len(texts) > 1 else header_cells(texts[0], width) or ()
        if len(cells) < width:
            continue
        if not is_unit_row(cells):
            return tuple(f"{name} {unit}".strip() for name, unit in zip(cells, units, strict=False))
        units = tuple(cells[:width])
    return units
