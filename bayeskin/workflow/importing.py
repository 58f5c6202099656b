"""Imports recordings: reads the tables of a file, and writes each as an HDF5 file of bayeskin."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.json_files import plain
from bayeskin.number_format import number
from bayeskin.recordings import (
    ALL,
    Reading,
    Stated,
    describe,
    describe_json,
    phase_noise,
    read_markers,
    read_tables,
    segment,
    shown,
    stated_unit,
)
from bayeskin.types import Markers
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.output_paths import check_ending, check_folder


def import_recording(
    reporter: Reporter,
    file: Path,
    out: Path,
    sheet: str | None = None,
    units: Sequence[str] = (),
    zero: bool | None = None,
    markers: Path | None = None,
    **columns: str | None,
) -> dict[str, Any]:
    """Reads `file`, writes it to `out` as an HDF5 file of bayeskin, and returns the command's answer.

    What was taken for what in the file is reported. With `sheet` "all", each table of the file becomes a file
    of its own, whose name is that of `out` with the table's name added.

    units : texts such as "force=mN" or "displacement=-mm", which also turns the sign
    zero : True makes the first displacement zero, False keeps the zero of the file
    markers : file with tracks of points on the skin, which are written beside `out` (`markers_beside`)
    columns : the name or number of the column of `time`, `displacement` and `force`

    Raises InputError, with nothing written, for a file that is no recording of a test or is not clear.
    """
    stated = _stated(columns, units, zero)
    imported = _read(file, out, sheet, stated, markers)
    _write(imported, reporter, named=sheet == ALL)
    return _answer(imported) if sheet == ALL else plain({"ok": True, **imported[0].answer})


def import_recordings(
    reporter: Reporter, files: Sequence[Path], out: Path, sheet: str | None = None, units: Sequence[str] = (),
    zero: bool | None = None, **columns: str | None,
) -> dict[str, Any]:  # fmt: skip
    """Reads several files in the same way, and writes each to a folder under its own name, ending in .h5.

    out : the folder; the other arguments are those of `import_recording`
    Raises InputError, with nothing written, where one of the files cannot be imported.
    """
    check_folder("-o", out)
    if out.suffix == ".h5":
        raise InputError(f"-o {out}", "several recordings go to a folder", "use the name of a folder")
    outs = [out / f"{file.stem}.h5" for file in files]
    for file, to in zip(files, outs, strict=True):
        if outs.count(to) > 1:
            raise InputError(file, f"several files would become {to.name}", "import one of them alone")
    stated = _stated(columns, units, zero)
    imported = [
        item for file, to in zip(files, outs, strict=True) for item in _read(file, to, sheet, stated, None)
    ]
    _write(imported, reporter, named=True)
    return _answer(imported)


@dataclass(frozen=True)
class _Imported:
    """A recording that can be written to `out`, its tracks of points, and what the command says of it."""

    reading: Reading
    out: Path
    answer: dict[str, Any]
    markers: Markers | None = None


def _read(
    file: Path, out: Path, sheet: str | None, stated: Stated, markers: Path | None
) -> list[_Imported]:  # fmt: skip
    """Returns the recordings of a file. Raises InputError where it cannot be imported."""
    check_ending(out, ".h5")
    if markers is not None and sheet == ALL:
        raise InputError(
            f"--markers {markers}",
            f"markers belong to a single table, not to --sheet {ALL}",
            "choose a table with --sheet NAME",
        )
    readings = read_tables(file, sheet=sheet, stated=stated)
    outs = [out] if sheet != ALL else _outs(out, [reading.table for reading in readings])
    imported = [
        _Imported(reading, to, _facts(reading, to, stated))
        for reading, to in zip(readings, outs, strict=True)
    ]
    if markers is None:
        return imported
    (only,) = imported
    tracks = read_markers(markers, only.reading.recording, only.reading.start_s)
    facts = _facts_of_markers(tracks, markers_beside(out), only.answer["text"])
    return [replace(only, markers=tracks, answer=only.answer | facts)]


def _write(imported: Sequence[_Imported], reporter: Reporter, named: bool) -> None:
    """Writes recordings and reports the notes on their reading; `named` puts the file's name before each."""
    for item in imported:
        for note in item.reading.recording.notes:
            reporter.log(f"{shown(item.out.name)}: {note}" if named else note)
        storage.save(item.out, item.reading.recording)
        if item.markers is not None:
            storage.save(markers_beside(item.out), item.markers)


def _answer(imported: Sequence[_Imported]) -> dict[str, Any]:
    """Returns the command's answer for several recordings."""
    text = "\n\n".join(item.answer["text"] for item in imported)
    facts = [{key: value for key, value in item.answer.items() if key != "text"} for item in imported]
    return plain({"ok": True, "recordings": facts, "text": text})


def markers_beside(recording: Path) -> Path:
    """Returns the file of the tracks that were imported with a recording."""
    return recording.with_name(f"{recording.stem}-markers.h5")


def _facts_of_markers(markers: Markers, out: Path, text: str) -> dict[str, Any]:
    """Returns what the command says of tracks, after the text on their recording."""
    facts = {
        "out": shown(out), "points": len(markers.points), "images": len(markers.time_s),
        "first_s": markers.time_s[0], "last_s": markers.time_s[-1],
        "not_seen": int(np.sum(~np.isfinite(markers.position_m[..., 0]))),
    }  # fmt: skip
    sentence = (
        f"markers: {facts['points']} points in {facts['images']} images, {number(markers.time_s[0])} to "
        f"{number(markers.time_s[-1], 5)} s\nwritten to {facts['out']}"
    )
    return {"markers": facts, "text": f"{text}\n\n{sentence}"}


def _stated(columns: Mapping[str, str | None], units: Sequence[str], zero: bool | None) -> Stated:
    """Returns what the user states of a file. Raises InputError for a unit that is not QUANTITY=UNIT."""
    return Stated({q: name for q, name in columns.items() if name is not None}, _units(units), zero)


def _units(texts: Sequence[str]) -> Mapping[str, Any]:
    """Returns the stated unit of each quantity. Raises InputError for a text that is not QUANTITY=UNIT."""
    units = {}
    for text in texts:
        quantity, equals, unit = text.partition("=")
        if not equals or quantity in units:
            raise InputError(
                f"--unit {text}",
                f"{quantity} has another unit already" if equals else "it states no unit",
                "write --unit QUANTITY=UNIT, once for each quantity",
            )
        units[quantity] = stated_unit(quantity, unit)
    return units


def _outs(out: Path, tables: Sequence[str]) -> list[Path]:
    """Returns the file of each of several tables: the name of the table is added to that of `out`."""
    names = [re.sub(r"[^\w.-]+", "-", table).strip("-.") for table in tables]
    names = [
        name if name and names.count(name) == 1 else f"{number}-{name}".strip("-")
        for number, name in enumerate(names, start=1)
    ]
    return [out.with_name(f"{out.stem}-{name}{out.suffix}") for name in names]


def _facts(reading: Reading, out: Path, stated: Stated) -> dict[str, Any]:
    """Returns what the command says of a recording. Raises InputError where it is no recording of a test."""
    recording = reading.recording
    phases = segment(recording)
    noise = phase_noise(recording, phases)
    units = {q: unit.text.lstrip("+-") for q, unit in stated.units.items()}
    columns = {
        q: {
            "number": column.index + 1,
            "header": column.header,
            "unit": units.get(q, column.unit),
            "factor_to_si": reading.factors[q],
        }
        for q, column in reading.columns.items()
    }
    text = f"{describe(replace(recording, notes=()), phases, noise)}\n\nwritten to {shown(out)}"
    facts = {"table": reading.table, "columns": columns, "zero_m": reading.zero_m}
    return {"out": shown(out), **facts, **describe_json(recording, phases, noise), "text": text}
