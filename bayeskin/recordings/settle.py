"""Settles what a table leaves open: decimal sign, which of several columns is meant, units, sign, zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain

import numpy as np

from bayeskin.errors import InputError
from bayeskin.recordings.checks import refuse_infinite, refuse_invalid
from bayeskin.recordings.columns import Stated
from bayeskin.recordings.headers import Column, parse_header
from bayeskin.recordings.tables import Table
from bayeskin.recordings.units import UNITS
from bayeskin.types import Array


@dataclass(frozen=True)
class SettleSettings:
    """Limits beyond which a table is not clear. Shares are shares of a column's range.

    same : share by which two columns of one quantity may differ
    at_zero : a displacement that starts closer to zero than this share starts at zero
    reported : and beyond this share it is reported
    opposed : correlation of force and displacement below which one of them counts the pull as negative
    """

    same: float = 1e-6
    at_zero: float = 0.05
    reported: float = 0.005
    opposed: float = -0.5


SETTLE = SettleSettings()


@dataclass(frozen=True)
class Settled:
    """The three quantities of a table in SI, (n,) each, with the columns they come from and what was done."""

    columns: Mapping[str, Column]
    values: Mapping[str, Array]
    factors: Mapping[str, float]
    zero_m: float
    notes: tuple[str, ...]


def settled(table: Table, stated: Stated) -> Settled:
    """Returns time, displacement and force of a table in SI units.

    Raises
    ------
    InputError : the numbers cannot be a skin test, the decimal sign is not clear, several columns may be
        meant, the displacement does not start at zero, or a pull seems to be negative; the message names the
        option that decides.
    """
    decimal = _decimal_sign(table)
    raw = {i: numbers.values(decimal) for i, numbers in table.numbers.items()}
    for column in chain.from_iterable(table.candidates.values()):
        refuse_infinite(
            f"{table.where}, row", table.first_row, column.header or column.quantity, raw[column.index]
        )
    columns, notes = _chosen(table, raw, stated)
    factors = {q: _factor(column, stated) for q, column in columns.items()}
    with np.errstate(over="ignore"):  # absurdly large numbers become infinite and are refused
        values = {q: factors[q] * raw[column.index] for q, column in columns.items()}
    refuse_invalid(table.where, table.first_row, *values.values())
    said = [_said(column, stated) for column in columns.values()]
    said += [*_said_of_numbers(table, decimal), *notes, *_ignored(table, columns)]
    displacement_m, zero_m, said_of_zero = _zeroed(table, values["displacement"], stated)
    values["displacement"] = displacement_m
    _refuse_negative_pull(table, columns, values, stated)
    return Settled(columns, values, factors, zero_m, (*said, *said_of_zero))


def _decimal_sign(table: Table) -> str:
    """Returns the decimal sign that makes numbers of all cells, and under which time increases."""
    common = set.intersection(*(set(numbers.read) for numbers in table.numbers.values()))
    if not common:
        problem = "the decimal sign is a point in some columns and a comma in others"
        raise InputError(table.place, problem, "use the same decimal sign in all columns")
    unclear = next((numbers.example for numbers in table.numbers.values() if numbers.example), "")
    if len(common) == 2 and unclear:
        clocks = [table.numbers[column.index] for column in table.candidates["time"]]
        common = {d for d in common if all(np.all(np.diff(clock.values(d)) > 0) for clock in clocks)}
    if len(common) == 1 or (common and not unclear):
        return min(common, key=".,".index)
    decimal, grouped = unclear.replace(",", "."), unclear.replace(",", "").replace(".", "")
    problem = f"numbers such as {unclear!r} may be {decimal} or {grouped}"
    raise InputError(table.place, problem, "write numbers without thousands separators")


def _chosen(table: Table, raw: Mapping[int, Array], stated: Stated) -> tuple[dict[str, Column], list[str]]:
    """Returns the column of each quantity, and notes on columns that hold the same or never change."""
    chosen, notes = {}, []
    for quantity, candidates in table.candidates.items():
        moving = [c for c in candidates if np.ptp(raw[c.index]) > 0] or list(candidates)
        still = [c for c in candidates if c not in moving]
        values = [raw[c.index] * abs(_factor(c, stated)) for c in moving]
        apart = [v for v in values[1:] if not _equal(values[0], v)]
        if apart:
            names = " and ".join(c.label for c in moving)
            remedy = f"choose one: import with --{quantity} NAME or NUMBER"
            raise InputError(table.place, f"{names} are {quantity} columns", remedy)
        chosen[quantity] = moving[0]
        notes += [f"column {c.label} holds the same as {moving[0].label}" for c in moving[1:]]
        notes += [f"column {c.label} never changes" for c in still]
    return chosen, notes


def _equal(a: Array, b: Array) -> bool:
    return bool(np.max(np.abs(a - b)) <= SETTLE.same * np.ptp(a))


def _factor(column: Column, stated: Stated) -> float:
    unit = stated.units.get(column.quantity)
    return unit.factor if unit else UNITS[column.quantity][column.unit]


def _said(column: Column, stated: Stated) -> str:
    """Returns the sentence that says how a column was read."""
    unit = stated.units.get(column.quantity)
    text = f"column {column.label} read as {column.quantity} in {unit.text if unit else column.unit}"
    if unit is None:
        return text
    turned = ", with its sign turned" if unit.factor < 0 else ""
    other = column.unit and column.unit != unit.text.lstrip("+-")
    return f"{text} (stated by --unit{f'; the file says {column.unit!r}' if other else ''}){turned}"


def _said_of_numbers(table: Table, decimal: str) -> list[str]:
    """Returns notes on a decimal comma and on thousands separators."""
    numbers = table.numbers.values()
    comma = decimal == "," and any(set(column.read) == {","} or column.example for column in numbers)
    grouped = any(column.grouped[decimal] for column in numbers)
    return ["a comma is the decimal sign"] * comma + ["numbers have thousands separators"] * grouped


def _ignored(table: Table, columns: Mapping[str, Column]) -> list[str]:
    """Returns the note on columns that no quantity uses, with the reason where a header suggests a use."""
    used = {column.index for candidates in table.candidates.values() for column in candidates}
    used |= {column.index for column in columns.values()}
    ignored = []
    for index, name in enumerate(table.heading.names):
        if name.strip() and index not in used:
            column = parse_header(index, name)
            ignored.append(repr(name.strip()) + (f" ({column.aside})" if column and column.aside else ""))
    return ["ignored columns: " + ", ".join(ignored)] if ignored else []


def _zeroed(table: Table, displacement_m: Array, stated: Stated) -> tuple[Array, float, list[str]]:
    """Returns the displacement from its zero, the displacement [m] that was subtracted, and a note."""
    start_m, travel_m = float(displacement_m[0]), float(np.ptp(displacement_m))
    start_mm = f"{1e3 * start_m:.6g} mm"
    if stated.zero:
        return displacement_m - start_m, start_m, [f"--zero subtracted the first displacement, {start_mm}"]
    if stated.zero is None and abs(start_m) > SETTLE.at_zero * travel_m:
        remedy = (
            "it must be 0 where the skin is at rest; import with --zero to subtract it, "
            "or with --no-zero to keep it"
        )
        raise InputError(table.place, f"the displacement starts at {start_mm}", remedy)
    if abs(start_m) > SETTLE.reported * travel_m:
        return displacement_m, 0.0, [f"the displacement starts at {start_mm}, which was kept"]
    return displacement_m, 0.0, []


def _refuse_negative_pull(
    table: Table, columns: Mapping[str, Column], values: Mapping[str, Array], stated: Stated
) -> None:
    """Raises InputError unless displacement and force grow together, or the user has stated their signs."""
    displacement_m, force_n = values["displacement"], values["force"]
    signed = {q for q, unit in stated.units.items() if unit.signed}
    with np.errstate(all="ignore"):  # a force that hardly changes has no correlation
        opposed = bool(np.corrcoef(displacement_m, force_n)[0, 1] < SETTLE.opposed)
    lowest_m = float(displacement_m.min())
    closing = -lowest_m > float(displacement_m.max()) and "displacement" not in signed
    if not closing and (not opposed or "force" in signed):
        return
    units = {
        q: stated.units[q].text.lstrip("+-") if q in stated.units else c.unit for q, c in columns.items()
    }
    turned = {"displacement": closing, "force": closing != opposed}
    options = " ".join(f"--unit {q}=-{units[q]}" for q, turn in turned.items() if turn)
    if closing:
        force = "rises" if opposed else "falls"
        problem = f"the displacement goes to {1e3 * lowest_m:.4g} mm while the force {force}"
        kept = f"--unit displacement=+{units['displacement']} if the pads came closer"
    else:
        problem = "force or displacement falls while the other rises"
        kept = f"--unit force=+{units['force']} if this is right"
    remedy = f"a pull must count positive; import with {options} to turn it, or {kept}"
    raise InputError(table.place, problem, remedy)
