"""Reads recordings from the file formats of laboratories and refuses invalid files in a one-line message."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bayeskin import storage
from bayeskin.errors import InputError
from bayeskin.number_format import number
from bayeskin.probe import bytes_of, refuse_damaged, refuse_endless
from bayeskin.recordings.headers import UNITS, Column
from bayeskin.recordings.tables import Table, read_text, read_workbook
from bayeskin.types import Array, Recording

_WORKBOOKS = {".xlsx", ".xlsm"}
_TEXTS = {".csv", ".tsv", ".txt"}
_STORED = {".h5", ".hdf5"}


@dataclass(frozen=True)
class PlausibleTest:
    """Plausible sizes of an extensometer test on living skin.

    The choice of a unit that a header does not give; the ranges are wide on purpose, and a unit is chosen
    only if it is the only one that fits
    duration_s, travel_m, peak_n : smallest and largest duration, travel and peak force
    interval_s : smallest and largest time between samples

    Refusal of a recording
    samples, least_travel_m : least number of samples, and least travel
    largest_m, largest_n : no skin test exceeds these values; larger values mean that the header does not give
        the unit of the numbers
    """

    duration_s: tuple[float, float] = (5.0, 7200.0)
    travel_m: tuple[float, float] = (5e-5, 0.1)
    peak_n: tuple[float, float] = (0.01, 100.0)
    interval_s: tuple[float, float] = (1e-6, 0.2)
    samples: int = 100
    least_travel_m: float = 1e-5
    largest_m: float = 0.1
    largest_n: float = 1e3

    def range_of(self, quantity: str) -> tuple[float, float]:
        """Returns the smallest and the largest plausible size of a quantity."""
        return {"time": self.duration_s, "displacement": self.travel_m, "force": self.peak_n}[quantity]


PLAUSIBLE = PlausibleTest()


def read_recording(path: Path | str, *, sheet: str | None = None) -> Recording:
    """Reads time, displacement and force from an xlsx, xlsm, csv, tsv, txt or bayeskin h5 file.

    The headers, in English or French, identify the columns and their units (s, ms, min; m, mm, um; N, mN).
    `notes` of the result records how each column was interpreted. Values are converted to SI and are
    otherwise as measured. If time does not start at zero, it is shifted to zero, and a note says so.

    Parameters
    ----------
    path : the file
    sheet : name of the sheet, for a workbook in which several sheets have the columns

    Raises
    ------
    InputError : the file cannot be read, or is not a recording of a skin test; the message says where the
        fault is, what was found and what was expected.
    """
    path = Path(path)
    refuse_endless(path, "a recording")
    kind, accepted = path.suffix.lower(), _WORKBOOKS | _TEXTS | _STORED
    if kind not in accepted:
        raise InputError(path, f"the ending {kind!r}", f"one of {', '.join(sorted(accepted))}")
    if sheet is not None and kind not in _WORKBOOKS:
        raise InputError(f"{path}: sheet {sheet!r}", f"the ending {kind!r}", "a workbook, .xlsx or .xlsm")
    if kind in _STORED:
        return _read_stored(path)
    data = bytes_of(path, "a recording")
    table = read_workbook(path, data, sheet) if kind in _WORKBOOKS else read_text(path, data)
    with np.errstate(over="ignore"):  # absurdly large numbers become infinite and are refused then
        return _to_recording(path.stem, table, hashlib.sha256(data).hexdigest())


def _read_stored(path: Path) -> Recording:
    refuse_damaged(path, "a bayeskin Recording file")
    recording = storage.load(path, Recording)
    arrays = [recording.time_s, recording.displacement_m, recording.force_n]
    valid = len({a.shape for a in arrays}) == 1 and all(a.ndim == 1 and a.dtype.kind == "f" for a in arrays)
    if not valid:
        raise InputError(
            path, "arrays of different shapes or types", "three arrays of numbers with equal lengths"
        )
    _refuse_invalid(str(path), 0, *arrays)
    return recording


def _to_recording(name: str, table: Table, sha256: str) -> Recording:
    notes = list(table.notes)
    values = {}
    for quantity, column in table.columns.items():
        raw = table.values[quantity]
        _refuse_infinite(f"{table.where}, row", table.first_row, column.header, raw)
        unit = column.unit or _guess_unit(table, column, raw)
        values[quantity] = raw * UNITS[quantity][unit]
        stated = "" if column.unit else ", which fits the numbers (the header gives no unit)"
        notes.append(f"column {column.header!r} read as {quantity} in {unit}{stated}")
    used = {column.index for column in table.columns.values()}
    ignored = [h.strip() for i, h in enumerate(table.headers) if i not in used and h.strip()]
    if ignored:
        notes.append("ignored columns: " + ", ".join(map(repr, ignored)))
    time_s, displacement_m, force_n = values["time"], values["displacement"], values["force"]
    _refuse_invalid(table.where, table.first_row, time_s, displacement_m, force_n)
    recording = Recording(time_s, displacement_m, force_n, name, sha256)
    remarks = (*notes, *_remarks_on_clock(time_s), *_remarks_on_sign(displacement_m, force_n))
    return replace(recording, time_s=time_s - time_s[0], notes=remarks)


def _remarks_on_sign(displacement_m: Array, force_n: Array) -> list[str]:
    with np.errstate(all="ignore"):  # a force that hardly changes has no correlation
        correlation = np.corrcoef(displacement_m, force_n)[0, 1]
    if not correlation < -0.5:
        return []
    return ["the force falls where the displacement grows: is the sign of one of them reversed?"]


def _remarks_on_clock(time_s: Array) -> list[str]:
    remarks = []
    if time_s[0] != 0.0:
        remarks.append(f"time starts at {number(time_s[0], 6)} s in the file; shifted to 0")
    intervals = np.diff(time_s)
    gap, usual = int(np.argmax(intervals)), float(np.median(intervals))
    if intervals[gap] > 5 * usual:
        remarks.append(
            f"a gap of {number(intervals[gap])} s after {time_s[gap]:.3f} s "
            f"(samples are {number(usual)} s apart)"
        )
    return remarks


def _guess_unit(table: Table, column: Column, raw: Array) -> str:
    """Returns the only unit with which the numbers can come from a skin test.

    Raises InputError if no unit or several units fit.
    """
    quantity = column.quantity
    size = float(np.ptp(raw) if quantity != "force" else np.max(np.abs(raw)))
    low, high = PLAUSIBLE.range_of(quantity)
    fitting = [unit for unit, factor in UNITS[quantity].items() if low <= size * factor <= high]
    if quantity == "time":
        interval = float(np.median(np.abs(np.diff(raw)))) if len(raw) > 1 else 0.0
        shortest, longest = PLAUSIBLE.interval_s
        fitting = [u for u in fitting if shortest <= interval * UNITS[quantity][u] <= longest]
    if len(fitting) == 1:
        return fitting[0]
    accepted = ", ".join(UNITS[quantity])
    problem = f"no unit, and numbers up to {size:g} that fit {' and '.join(fitting) or 'none'}"
    raise InputError(
        f"{table.where}, column {column.header!r}", problem, f"the unit in the header ({accepted})"
    )


def _refuse_infinite(where: str, first_row: int, what: str, values: Array) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        place = f"{where} {first_row + bad[0]}, column {what!r}"
        raise InputError(place, f"{values[bad[0]]}", "a finite number")


def _refuse_invalid(where: str, first_row: int, time_s: Array, displacement_m: Array, force_n: Array) -> None:
    """Raises InputError unless the arrays (n,) can be a skin test.

    The arrays must have enough samples, finite values, increasing times, plausible sizes, and a displacement
    that changes.
    """
    named = {"time": time_s, "displacement": displacement_m, "force": force_n}
    if len(time_s) < PLAUSIBLE.samples:
        raise InputError(where, f"{len(time_s)} samples", f"at least {PLAUSIBLE.samples}")
    for name, values in named.items():
        _refuse_infinite(f"{where}, row", first_row, name, values)
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        before, after = time_s[back[0]], time_s[back[0] + 1]
        problem = f"time {after:.6g} s after {before:.6g} s"
        raise InputError(
            f"{where}, row {first_row + back[0] + 1}", problem, "times that increase from row to row"
        )
    for name, largest, unit in (
        ("displacement", PLAUSIBLE.largest_m, "m"),
        ("force", PLAUSIBLE.largest_n, "N"),
    ):
        peak = int(np.argmax(np.abs(named[name])))
        value = abs(named[name][peak])
        if value > largest:
            problem = f"a {name} of {value:.4g} {unit}"
            expected = f"at most {largest:g} {unit} (is the column in {'mm' if unit == 'm' else 'mN'}?)"
            raise InputError(f"{where}, row {first_row + peak}", problem, expected)
    travel = float(np.ptp(displacement_m))
    if travel < PLAUSIBLE.least_travel_m:
        problem = f"a displacement that changes by {travel:.3g} m in all"
        raise InputError(where, problem, f"at least {PLAUSIBLE.least_travel_m:g} m (is its unit right?)")
