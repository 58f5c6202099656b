"""Imports recordings: reads the tables of a file, and writes each as an HDF5 file of bayeskin."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.json_files import plain
from bayeskin.recordings import (
    ALL,
    Reading,
    Stated,
    describe,
    describe_json,
    phase_noise,
    read_tables,
    segment,
    shown,
    stated_unit,
)
from bayeskin.workflow.engine import Reporter
from bayeskin.workflow.output_paths import check_ending


def import_recording(
    reporter: Reporter,
    file: Path,
    out: Path,
    sheet: str | None = None,
    units: Sequence[str] = (),
    zero: bool | None = None,
    **columns: str | None,
) -> dict[str, Any]:
    """Reads `file`, writes it to `out` as an HDF5 file of bayeskin, and returns the command's answer.

    What was taken for what in the file is reported. With `sheet` "all", each table of the file becomes a file
    of its own, whose name is that of `out` with the table's name added.

    units : texts such as "force=mN" or "displacement=-mm", which also turns the sign
    zero : True makes the first displacement zero, False keeps the zero of the file
    columns : the name or number of the column of `time`, `displacement` and `force`

    Raises InputError, with nothing written, for a file that is no recording of a test or is not clear.
    """
    check_ending(out, ".h5")
    stated = Stated({q: name for q, name in columns.items() if name is not None}, _units(units), zero)
    readings = read_tables(file, sheet=sheet, stated=stated)
    outs = [out] if sheet != ALL else _outs(out, [reading.table for reading in readings])
    answers = [_answer(reading, to, stated) for reading, to in zip(readings, outs, strict=True)]
    for reading, to in zip(readings, outs, strict=True):
        for note in reading.recording.notes:
            reporter.log(f"{shown(to.name)}: {note}" if sheet == ALL else note)
        storage.save(to, reading.recording)
    if sheet != ALL:
        return plain({"ok": True, **answers[0]})
    text = "\n\n".join(answer.pop("text") for answer in answers)
    return plain({"ok": True, "recordings": answers, "text": text})


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


def _answer(reading: Reading, out: Path, stated: Stated) -> dict[str, Any]:
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
