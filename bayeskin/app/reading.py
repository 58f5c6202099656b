"""Reads the original of a recording as a person states it, and keeps what was taken for what."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.app.recordings import RecordingFolder
from bayeskin.errors import InputError
from bayeskin.json_files import write_json
from bayeskin.recordings import ALL
from bayeskin.recordings.preview import SheetPreview, preview
from bayeskin.recordings.units import QUANTITIES, UNITS
from bayeskin.report.page.charts import recording_charts
from bayeskin.report.page.parts import Chart
from bayeskin.types import Recording
from bayeskin.workflow.engine import Silent
from bayeskin.workflow.importing import import_recording

ZERO: Mapping[str, bool | None] = {"": None, "subtract": True, "keep": False}


@dataclass(frozen=True)
class Choice:
    """A person's statements about a file; "" leaves a decision to the file.

    sheet : the table that is read
    columns, units : the column and the unit of each quantity, as `bayeskin import` takes them
    zero : whether the first displacement is subtracted, a key of `ZERO`
    """

    sheet: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    zero: str = ""

    @staticmethod
    def from_form(form: Mapping[str, str]) -> Choice:
        """Returns the statements of the page's form."""
        columns = {q: form.get(f"column-{q}", "").strip() for q in QUANTITIES}
        units = {q: form.get(f"unit-{q}", "").strip() for q in QUANTITIES}
        return Choice(form.get("sheet", "").strip(), columns, units, form.get("zero", ""))


@dataclass(frozen=True)
class Reading:
    """The state of a recording's reading.

    choice : the statements under which the recording was read, or was last tried to be read
    answer : the answer of `bayeskin import` for the recording as it is kept; {} where it was never read
    error : the error of the last attempt, or None
    """

    choice: Choice
    answer: Mapping[str, Any]
    error: InputError | None

    @property
    def problem(self) -> str:
        """Returns the error in one line, as the command prints it, or "" if there is none."""
        return str(self.error or "")


def read_as(folder: RecordingFolder, choice: Choice) -> Reading:
    """Reads the original of a recording, and keeps the result if it can be read.

    If it cannot be read, an earlier result stays as it is, and the error is kept beside it.
    """
    before = reading_of(folder)
    try:
        reading = Reading(choice, _imported(folder, choice), None)
    except InputError as error:
        where = error.where.replace(f"{folder.path}/original/", "")
        reading = Reading(choice, before.answer, InputError(where, error.problem, error.remedy))
    said = reading.error
    parts = (said.where, said.problem, said.remedy) if said else None
    write_json(folder.reading, {"choice": asdict(choice), "answer": reading.answer, "error": parts})
    return reading


def _imported(folder: RecordingFolder, choice: Choice) -> dict[str, Any]:
    """Writes the recording as `bayeskin import` does, and returns its answer, or raises InputError."""
    if choice.sheet == ALL:
        raise InputError("table", f"{ALL!r} means all tables", "name a single one")
    if choice.zero not in ZERO:
        raise InputError("zero", f"{choice.zero!r} is not known", f"use one of {', '.join(map(repr, ZERO))}")
    assert folder.original is not None
    units = [f"{quantity}={unit}" for quantity, unit in choice.units.items() if unit]
    columns = {quantity: column or None for quantity, column in choice.columns.items()}
    return import_recording(
        Silent(), folder.original, folder.stored, choice.sheet or None, units, ZERO[choice.zero], **columns
    )


def reading_of(folder: RecordingFolder) -> Reading:
    """Returns the kept state of a recording's reading."""
    try:
        kept = json.loads(folder.reading.read_text(encoding="utf-8"))
        error = InputError(*kept["error"]) if kept["error"] else None
        return Reading(Choice(**kept["choice"]), kept["answer"], error)
    except (OSError, ValueError, TypeError, KeyError):
        return Reading(Choice(), {}, None)


def beginnings(folder: RecordingFolder) -> tuple[SheetPreview, ...]:
    """Returns the first rows of each sheet of the original, and () where none can be shown."""
    original = folder.original
    return _beginnings(original, original.stat().st_mtime_ns) if original else ()


@lru_cache(maxsize=64)
def _beginnings(original: Path, written_ns: int) -> tuple[SheetPreview, ...]:
    """Returns the first rows of a file as it was written at a time, so that it is read only once."""
    try:
        return preview(original)
    except InputError:
        return ()


def can_be_corrected(folder: RecordingFolder) -> bool:
    """Returns whether the original has a table about which a person can state anything."""
    return bool(beginnings(folder))


def charts(folder: RecordingFolder, answer: Mapping[str, Any]) -> tuple[Chart, ...]:
    """Returns the charts of a recording as it was read; none for a recording that was never read."""
    if not answer or not folder.stored.is_file():
        return ()
    return _charts(folder.stored, folder.stored.stat().st_mtime_ns, json.dumps(answer["phases"]))


@lru_cache(maxsize=16)
def _charts(stored: Path, written_ns: int, phases: str) -> tuple[Chart, ...]:
    """Returns the charts of a recording as it was written at a time, so that it is drawn only once."""
    return recording_charts(storage.load(stored, Recording), json.loads(phases))


def unit_options() -> dict[str, list[tuple[str, str]]]:
    """Returns the units that can be stated for each quantity, with the text that a person reads."""
    options = {q: [(unit, unit) for unit in UNITS[q]] for q in QUANTITIES}
    for quantity in ("displacement", "force"):
        options[quantity] += [(f"-{unit}", f"{unit}, sign turned") for unit in UNITS[quantity]]
    return options
