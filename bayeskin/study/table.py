"""Reads the table of a study, which has one row for each recording, and refuses a wrong one in one line."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bayeskin.errors import InputError
from bayeskin.probe import bytes_of, refuse_endless

MANDATORY, OPTIONAL = ("recording", "subject"), ("site", "group", "session", "device")
COLUMNS = (*MANDATORY, *OPTIONAL)
_MOST_BYTES = 1_000_000
_FEWEST_SUBJECTS = 2  # smallest number in the study, and in each group
_EXPECTED = "a table with one row for each recording"


@dataclass(frozen=True)
class Entry:
    """One row of the table of a study; what a column that is absent would contain is None.

    where : file and row, for messages
    recording, device : paths, relative ones beside the table
    name : of the recording in results and folders; by default that of its file
    """

    where: str
    recording: Path
    subject: str
    site: str | None = None
    group: str | None = None
    session: str | None = None
    device: Path | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", _as_name(self.recording.stem))


def read_table(path: Path | str) -> tuple[Entry, ...]:
    """Returns the rows of a CSV file with the columns `COLUMNS`, separated by commas, semicolons or tabs.

    The order of the columns is free, and those of `OPTIONAL` may be absent. Relative paths start beside the
    table. Where two files have one name, the names of the recordings begin with their subjects.

    Raises
    ------
    InputError : the table cannot be read; a column is unknown, missing or there twice; a row has too few or
        too many cells; a cell is empty; a file does not exist; a recording is in two rows, or has the
        name of another; the table or a group has one subject only; or a subject is in two groups at one site.
    """
    path = Path(path)
    try:
        text = bytes_of(path, _EXPECTED, _MOST_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path, "it is not text in UTF-8", f"bayeskin needs {_EXPECTED}") from None
    rows = _rows(path, text)
    header = next(rows, None)
    if header is None:
        raise InputError(path, "there is no header", f"write one with columns of {', '.join(COLUMNS)}")
    names = _names(f"{path}, row {header[0]}", header[1])
    entries = tuple(_entry(path, number, names, cells) for number, cells in rows)
    _refuse_recordings_twice(entries)
    entries = _of_different_names(entries)
    refuse_few_subjects(path, entries)
    _refuse_groups_within_a_subject(entries)
    return entries


def _rows(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yields the number in the file and the cells of each row that is not blank."""
    first = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=first.count), strict=True)
    try:
        for cells in reader:
            if cells:
                yield reader.line_num, [cell.strip() for cell in cells]
    except csv.Error as error:
        raise InputError(
            f"{path}, row {reader.line_num}",
            f"it cannot be read as a row of cells ({error})",
            f"bayeskin needs {_EXPECTED}",
        ) from None


def _names(where: str, header: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of the columns in lower case."""
    names = tuple(name.lower() for name in header)
    for name in names:
        if name not in COLUMNS:
            raise InputError(
                where, f"the column {name[:60]!r} is not known", f"use some of {', '.join(COLUMNS)}"
            )
        if names.count(name) > 1:
            raise InputError(where, f"the column {name!r} occurs twice", "each column can occur once")
    for name in MANDATORY:
        if name not in names:
            raise InputError(
                where, f"there is no column {name!r}", f"the columns {' and '.join(MANDATORY)} are needed"
            )
    return names


def _entry(path: Path, number: int, names: Sequence[str], cells: Sequence[str]) -> Entry:
    """Returns a checked row."""
    where = f"{path}, row {number}"
    if len(cells) != len(names):
        raise InputError(
            where, f"the number of cells is {len(cells)}", f"it must be {len(names)}, as in the header"
        )
    row = dict(zip(names, cells, strict=True))
    for name, cell in row.items():
        if not cell:
            raise InputError(_at(where, name), "the cell is empty", "fill it, or leave out the column")
    files = {name: _file(path, where, name, row) for name in ("recording", "device") if name in row}
    texts = {name: cell for name, cell in row.items() if name not in files}
    return Entry(where, **texts, **files)  # type: ignore[arg-type]


def _file(table: Path, where: str, name: str, row: Mapping[str, str]) -> Path:
    """Returns the path of a file that a cell names."""
    file = table.parent / row[name]
    try:
        refuse_endless(file, f"the file of a {name}")
    except InputError as error:
        raise InputError(_at(where, name), f"{row[name]!r}: {error.problem}"[:200], error.remedy) from None
    return file


def _refuse_recordings_twice(entries: Sequence[Entry]) -> None:
    seen: dict[str, str] = {}
    for entry in entries:
        file = os.path.realpath(entry.recording)
        if file in seen:
            raise InputError(
                _at(entry.where, "recording"), f"{entry.recording.name} is also in {seen[file]}",
                "a recording can be in one row only",
            )  # fmt: skip
        seen[file] = entry.where


def _of_different_names(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Returns the rows with a name of its own for each recording."""
    if len({entry.name for entry in entries}) == len(entries):
        return entries
    named = tuple(
        replace(entry, name=_as_name(f"{entry.subject}-{entry.recording.stem}")) for entry in entries
    )
    seen: dict[str, str] = {}
    for entry in named:
        if entry.name in seen:
            raise InputError(
                _at(entry.where, "recording"), f"{entry.recording.name} would be named {entry.name}, "
                f"as in {seen[entry.name]}", "the files of a subject need different names",
            )  # fmt: skip
        seen[entry.name] = entry.where
    return named


def _as_name(text: str) -> str:
    """Returns a text as the name of a run: characters that are not allowed become hyphens."""
    return re.sub(r"^[^A-Za-z0-9]+", "", re.sub(r"[^A-Za-z0-9._-]", "-", text)) or "recording"


def refuse_few_subjects(where: object, entries: Sequence[Entry]) -> None:
    """Raises InputError for fewer than two subjects, in all or in a group."""
    count = len({entry.subject for entry in entries})
    if count < _FEWEST_SUBJECTS:
        raise InputError(
            f"{where}, column 'subject'",
            f"the number of subjects is {count}",
            f"a study needs at least {_FEWEST_SUBJECTS}",
        )
    members: dict[str | None, set[str]] = {}
    for entry in entries:
        members.setdefault(entry.group, set()).add(entry.subject)
    for entry in entries:
        if len(members[entry.group]) < _FEWEST_SUBJECTS:
            raise InputError(
                _at(entry.where, "group"), f"the group {entry.group!r} has one subject only",
                f"a group needs at least {_FEWEST_SUBJECTS}",
            )  # fmt: skip


def _refuse_groups_within_a_subject(entries: Sequence[Entry]) -> None:
    seen: dict[tuple[str, str | None], Entry] = {}
    for entry in entries:
        first = seen.setdefault((entry.subject, entry.site), entry)
        if first.group != entry.group:
            raise InputError(
                _at(entry.where, "group"), f"it is {entry.group!r} for subject {entry.subject}, and "
                f"{first.group!r} in {first.where}", "a subject can be in two groups only at two sites",
            )  # fmt: skip


def _at(where: str, column: str) -> str:
    """Returns the place of a cell, for a message."""
    return f"{where}, column {column!r}"
