"""The beginning of a file names its columns as the reader of recordings does, for exports of many kinds."""

from __future__ import annotations

from pathlib import Path

import pytest
from toys.laboratory_exports import EXPORTS, NAMED, Export
from toys.laboratory_files import text

from bayeskin.errors import InputError
from bayeskin.recordings import Stated, read_tables, stated_unit
from bayeskin.recordings.preview import ABOVE, BELOW, preview


@pytest.mark.parametrize("export", [e for e in EXPORTS if e.resolved], ids=lambda e: e.name)
def test_the_names_of_the_columns_stand_where_the_reader_takes_them(export: Export, tmp_path: Path) -> None:
    path = tmp_path / export.name
    path.write_bytes(export.data)
    sheets = preview(path)
    units = {quantity: stated_unit(quantity, unit) for quantity, unit in export.units.items()}
    stated = Stated(export.columns, units, export.zero)
    for reading in read_tables(path, sheet=export.sheet, stated=stated):
        for column in reading.columns.values():
            names = [sheet.names[column.index] for sheet in sheets if column.index < len(sheet.names)]
            assert any(name.startswith(column.header) for name in names), (column, sheets)


def test_rows_stand_as_they_stand_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.csv"
    path.write_bytes(text([["made by hand"], [], *NAMED], ";"))
    (sheet,) = preview(path)
    assert [number for number, _ in sheet.rows] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert [cells for _, cells in sheet.rows[2:]] == [tuple(row) for row in NAMED[: BELOW + 1]]
    assert len(sheet.rows) <= ABOVE + BELOW


def test_a_file_without_numbers_is_refused_and_a_file_of_bayeskin_needs_no_preview(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("Dear reader,\nthis is no table.\n")
    with pytest.raises(InputError, match="no rows of numbers"):
        preview(tmp_path / "letter.txt")
    assert preview(tmp_path / "stored.h5") == ()
