"""Reads recordings from the files of laboratories, and refuses what is not clear in one line."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.probe import bytes_of, refuse_damaged, refuse_endless
from bayeskin.recordings.checks import PLAUSIBLE, refuse_invalid, remarks_on_clock
from bayeskin.recordings.columns import Stated
from bayeskin.recordings.headers import Column
from bayeskin.recordings.settle import settled
from bayeskin.recordings.tables import Table, Unreadable, tables_of
from bayeskin.recordings.text import rows_of_text
from bayeskin.recordings.workbooks import WORKBOOKS, rows_of_array, sheets_of_workbook
from bayeskin.types import Recording

ALL = "all"  # this name of a sheet stands for every table of the file
_TEXTS = (".csv", ".tsv", ".txt", ".dat", ".asc", ".tra", ".lvm", ".mach-1")
_STORED = (".h5", ".hdf5")
_ENDINGS = (*WORKBOOKS, *_TEXTS, ".npy", *_STORED)
_NOTHING_STATED = Stated()


@dataclass(frozen=True)
class Reading:
    """A recording with what was taken for what in its file.

    table : the name of the table in its file, "" where the file has only one
    columns : the column of each quantity; none for a file of bayeskin
    factors : the factor from the numbers in the file to SI, negative where the sign was turned
    zero_m : the displacement in the file that became zero
    """

    recording: Recording
    table: str = ""
    columns: Mapping[str, Column] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    zero_m: float = 0.0


def read_recording(
    path: Path | str, *, sheet: str | None = None, stated: Stated = _NOTHING_STATED
) -> Recording:
    """Reads time, displacement and force from a table, a workbook, or a file of bayeskin.

    The headers, in several languages, identify the columns and their units. `notes` of the result records how
    each column was interpreted. Values are converted to SI and are otherwise as measured. If time does not
    start at zero, it is shifted to zero, and a note says so.

    Parameters
    ----------
    path : xlsx, xlsm, xls, csv, tsv, txt, dat, asc, tra, lvm, npy, or an h5 file of bayeskin
    sheet : name of the table, for a file that has several
    stated : columns, units and zero that the file does not make clear

    Raises
    ------
    InputError : the file cannot be read, is not a recording of a skin test, or can be understood in several
        ways; the message says where the fault is, what it is, and what helps.
    """
    return read_tables(path, sheet=sheet, stated=stated)[0].recording


def read_tables(
    path: Path | str, *, sheet: str | None = None, stated: Stated = _NOTHING_STATED
) -> tuple[Reading, ...]:
    """Reads the only table of a file, or the table `sheet`, or with `sheet` "all" every table that it has.

    Tables are the sheets of a workbook, specimens side by side, and tables one below the other. Tables of
    fewer samples than a recording are left out if the file has others. Raises InputError as `read_recording`.
    """
    path = Path(path)
    refuse_endless(path, "a recording")
    kind = path.suffix.lower()
    if kind not in _ENDINGS:
        raise InputError(path, f"the ending {kind!r} is not known", f"use one of {', '.join(_ENDINGS)}")
    if kind in _STORED:
        if sheet is not None or stated != _NOTHING_STATED:
            raise InputError(
                path,
                "a file of bayeskin has one table with known columns and units",
                "leave out the options that state them",
            )
        return (Reading(_read_stored(path)),)
    data = bytes_of(path, "a recording")
    tables, notes = _tables(path, kind, data, sheet, stated)
    chosen, left_out = _chosen(path, tables, sheet)
    name, sha256 = shown(path.stem), hashlib.sha256(data).hexdigest()
    readings = []
    for label, table in chosen:
        of_several = f" {label}" if sheet == ALL else ""
        readings.append(_reading(name + of_several, label, table, stated, sha256, (*notes, *left_out)))
    return tuple(readings)


def shown(path: Path | str) -> str:
    """Returns the name of a file as text; bytes that are not UTF-8 are written as \\xe9."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


@dataclass(frozen=True)
class _Labelled:
    """A table of a file, or the error of a table that has the columns, and the names that choose it."""

    label: str
    names: tuple[str, ...]
    table: Table | Unreadable | InputError

    @property
    def rows(self) -> int:
        return PLAUSIBLE.samples if isinstance(self.table, InputError) else self.table.rows


def _tables(
    path: Path, kind: str, data: bytes, sheet: str | None, stated: Stated
) -> tuple[list[_Labelled], tuple[str, ...]]:
    """Returns the tables of a file in their order, and notes. A sheet of the name `sheet` is read alone."""
    if kind == ".npy":
        return _labelled("", tables_of(str(path), rows_of_array(path, data), stated)), ()
    sheets = sheets_of_workbook(path, kind, data)
    if sheets is None:
        rows, delimiter, notes = rows_of_text(path, data)
        return _labelled("", tables_of(str(path), rows, stated, delimiter == " ")), notes
    tables = []
    for name in [sheet] if sheet is not None and sheet in sheets else sheets:
        try:
            tables += _labelled(name, tables_of(f"{path}: sheet {name!r}", sheets[name], stated))
        except InputError as error:
            tables.append(_Labelled(name, (name,), error))
    return tables, ()


def _labelled(sheet: str, tables: Sequence[Table | Unreadable]) -> list[_Labelled]:
    """Returns the tables of a sheet or text with their names. Short ones count only if there is no other."""
    long = [table for table in tables if table.rows >= PLAUSIBLE.samples] or tables
    titles = [table.title for table in long]
    labelled = []
    for number, table in enumerate(long, start=1):
        numbered = "" if table.title and titles.count(table.title) == 1 else str(number)
        own = " ".join(filter(None, (numbered, table.title)))
        label = sheet if sheet and len(long) == 1 else f"{sheet} {own}".strip()
        names = (label, sheet, table.title, "" if sheet else str(number))
        labelled.append(_Labelled(label, tuple(filter(None, names)), table))
    return labelled


def _chosen(
    path: Path, tables: Sequence[_Labelled], sheet: str | None
) -> tuple[list[tuple[str, Table]], list[str]]:
    """Returns the tables to read with their labels, and a note on others. Raises InputError if unclear."""
    labels = [entry.label for entry in tables]
    wanted = [entry for entry in tables if sheet in (None, ALL) or sheet in entry.names]
    if not wanted and tables:
        raise InputError(
            path, f"it has no sheet or table {sheet!r}", f"use one of {', '.join(map(repr, labels))}"
        )
    long = [entry for entry in wanted if entry.rows >= PLAUSIBLE.samples] or wanted
    fitting = [entry for entry in long if not isinstance(entry.table, Unreadable)]
    if not fitting:
        unreadable = [entry.table for entry in long if isinstance(entry.table, Unreadable)]
        longest = max(unreadable, key=lambda table: table.rows, default=None)
        raise (
            longest.error
            if longest
            else InputError(path, "it has no rows of numbers", "a recording needs a header and numbers")
        )
    if len(fitting) > 1 and sheet != ALL:
        problem = f"{len(fitting)} of its tables {', '.join(map(repr, labels))} can be recordings"
        raise InputError(path, problem, "import with --sheet NAME, or with --sheet all")
    readable = []
    for entry in fitting:
        if isinstance(entry.table, InputError):
            raise entry.table
        if isinstance(entry.table, Table):
            readable.append((entry.label, entry.table))
    left_out = [entry.label for entry in wanted if entry not in fitting]
    return readable, [f"tables left out: {', '.join(map(repr, left_out))}"] if left_out else []


def _reading(
    name: str, label: str, table: Table, stated: Stated, sha256: str, notes: Sequence[str]
) -> Reading:
    """Returns the recording of a table, in SI units."""
    quantities = settled(table, stated)
    time_s = quantities.values["time"]
    remarks = (*notes, *quantities.notes, *remarks_on_clock(time_s))
    recording = Recording(
        time_s - time_s[0],
        quantities.values["displacement"],
        quantities.values["force"],
        name,
        sha256,
        remarks,
    )
    return Reading(recording, label, quantities.columns, quantities.factors, quantities.zero_m)


def _read_stored(path: Path) -> Recording:
    refuse_damaged(path, "a Recording in its own HDF5 form")
    recording = storage.load(path, Recording)
    arrays = [recording.time_s, recording.displacement_m, recording.force_n]
    valid = len({a.shape for a in arrays}) == 1 and all(a.ndim == 1 and a.dtype.kind == "f" for a in arrays)
    if not valid:
        raise InputError(
            path, "its arrays differ in shape or type", "it needs three arrays of numbers with equal lengths"
        )
    refuse_invalid(str(path), 0, *arrays)
    return recording
