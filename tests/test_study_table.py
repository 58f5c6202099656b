"""The table of a study: what it may look like; anything else is refused in one line with its place."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys.fuzzed_files import refused

from bayeskin.errors import InputError
from bayeskin.study import read_table

SOUND = """recording,subject,site,group,session,device
a.h5,anna,arm,keloid,1,d.toml
b.h5,anna,leg,control,1,d.toml
c.h5,bela,arm,keloid,1,d.toml
d.h5,bela,arm,keloid,2,d.toml
e.h5,cora,leg,control,1,d.toml
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """The path of a table, beside which the files that it names lie."""
    for name in ("a.h5", "b.h5", "c.h5", "d.h5", "e.h5", "d.toml"):
        (tmp_path / name).touch()
    (tmp_path / "link.h5").symlink_to("a.h5")
    return tmp_path / "study.csv"


def read(table: Path, text: str):
    table.write_text(text, encoding="utf-8")
    return read_table(table)


def test_a_table_is_read_with_its_rows_in_order(table: Path) -> None:
    first, *_, last = read(table, SOUND)
    assert (first.recording, first.device) == (table.parent / "a.h5", table.parent / "d.toml")
    assert (first.subject, first.site, first.group, first.session) == ("anna", "arm", "keloid", "1")
    assert last.where == f"{table}, row 6"


def test_optional_columns_may_be_absent_and_columns_come_in_any_order(table: Path) -> None:
    entries = read(table, "Subject;Recording\nanna;a.h5\n\nbela;b.h5\n")
    assert [entry.subject for entry in entries] == ["anna", "bela"]
    assert {entry.group for entry in entries} == {None}
    assert entries[1].where.endswith("row 4")  # the blank row counts


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("a.h5", "x.h5", "row 2, column 'recording': 'x.h5': there is no such file"),
        ("a.h5", "", "row 2, column 'recording': the cell is empty"),
        ("bela,arm,keloid,2", "bela,arm,,2", "row 5, column 'group': the cell is empty"),
        ("e.h5", "a.h5", "row 6, column 'recording': a.h5 is also in .*row 2"),
        ("e.h5", "link.h5", "row 6, column 'recording': link.h5 is also in .*row 2"),
        ("session", "visit", "row 1: the column 'visit' is not known; use some of recording"),
        ("session", "site", "row 1: the column 'site' occurs twice"),
        ("subject", "device", "twice"),
        ("subject", "", "row 1: the column ''"),
        ("anna,leg,control", "anna,leg,scar", "row 3, column 'group': the group 'scar' has one subject"),
        ("bela,arm,keloid,2", "bela,arm,control,2", "row 5, column 'group': it is 'control' for .* bela"),
        ("cora,leg,control,1,d.toml", "cora,leg", "row 6: the number of cells is 3; it must be 6"),
        ("d.toml\nb", "no.toml\nb", "row 2, column 'device': 'no.toml': there is no such file"),
        ("a.h5", ".", "row 2, column 'recording': '.': it is a folder"),
        ("a.h5", "a\x00.h5", "row 2, column 'recording'"),
        ("a.h5", "a" * 5000, "row 2, column 'recording'"),
        ("a.h5", '"a.h5', "cannot be read as a row of cells"),
        ("recording,", "", "row 1: there is no column 'recording'"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_its_row_and_column(
    table: Path, before: str, after: str, said: str
) -> None:
    with pytest.raises(InputError, match=said) as stop:
        read(table, SOUND.replace(before, after, 1))
    assert "\n" not in str(stop.value)
    assert str(table) in str(stop.value)


@pytest.mark.parametrize("text", ["", "\n\n", "recording,subject\n", "recording,subject\na.h5,anna\n"])
def test_a_table_without_two_subjects_is_refused(table: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"there is no header|number of subjects"):
        read(table, text)


def test_bytes_that_are_no_text_are_refused(table: Path) -> None:
    table.write_bytes(b"recording,subject\n\xff\xfe")
    with pytest.raises(InputError, match="UTF-8"):
        read_table(table)
    with pytest.raises(InputError, match="no such file"):
        read_table(table.with_name("none.csv"))


HEADERS = st.sampled_from(["recording", "subject", "site", "group", "session", "device", "age", ""])
CELLS = st.sampled_from(["a.h5", "b.h5", "c.h5", "d.toml", "anna", "bela", "x", "1", "", " "]) | st.text()


def test_any_table_is_read_or_refused_in_one_line(table: Path) -> None:
    ended = set[bool]()

    @settings(max_examples=300, deadline=None, database=None, derandomize=True)
    @given(
        st.lists(HEADERS, max_size=7) | st.just(["recording", "subject", "group"]),
        st.lists(st.lists(CELLS, max_size=6) | st.tuples(CELLS, CELLS, CELLS), max_size=5),
        st.sampled_from(",;\t"),
    )
    def run(header: list[str], rows: list[list[str]], delimiter: str) -> None:
        out = io.StringIO()
        csv.writer(out, delimiter=delimiter).writerows([header, *rows])
        table.write_text(out.getvalue(), encoding="utf-8", errors="replace")
        ended.add(refused(read_table, table))

    run()
    assert True in ended


def test_any_choice_of_sound_rows_is_read_or_refused_in_one_line(table: Path) -> None:
    """Rows of a sound table, some of them left out, repeated or with one cell from another row."""
    header, *rows = (line.split(",") for line in SOUND.splitlines())
    ended = set[bool]()

    @settings(max_examples=200, deadline=None, database=None, derandomize=True)
    @given(st.lists(st.tuples(st.sampled_from(rows), st.sampled_from(rows), st.integers(0, 20)), max_size=6))
    def run(chosen: list[tuple[list[str], list[str], int]]) -> None:
        mixed = [[*row[:at], *other[at : at + 1], *row[at + 1 :]] for row, other, at in chosen]
        table.write_text("\n".join(",".join(row) for row in [header, *mixed]))
        ended.add(refused(read_table, table))

    run()
    assert ended == {True, False}
