"""Chooses the columns of time, displacement and force from a heading and from what the user states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from bayeskin.errors import InputError
from bayeskin.recordings.headers import Column, parse_header, unit_in
from bayeskin.recordings.units import QUANTITIES, UNITS, plain, unit_of

Candidates = dict[str, tuple[Column, ...]]  # the columns that may hold each quantity


@dataclass(frozen=True)
class StatedUnit:
    """A unit that the user states: its factor to SI, and whether the sign of the values is stated too.

    text : as the user wrote it, such as "-mm"
    factor : to SI, negative where the values are to change their sign
    signed : whether the text begins with + or -
    """

    text: str
    factor: float
    signed: bool


@dataclass(frozen=True)
class Stated:
    """The statements of the user about a file; everything else is taken from the file.

    columns : the name of the column of a quantity, or its number from 1
    units : the unit of a quantity
    zero : True subtracts the first displacement, False keeps it, None keeps it only if it is zero
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, StatedUnit] = field(default_factory=dict)
    zero: bool | None = None

    def __post_init__(self) -> None:
        for quantity in (*self.columns, *self.units):
            _refuse_other_quantity(quantity)


@dataclass(frozen=True)
class Heading:
    """The names and the units above the columns of a table, (width,) each, with the row of the names.

    fault : why there are no names, where they are empty
    title : cells of the row above the names
    """

    row: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    title: tuple[str, ...] = ()
    fault: str = ""


def stated_unit(quantity: str, text: str) -> StatedUnit:
    """Returns the unit that ``-mm`` or ``N`` states for a quantity. Raises InputError for any other text."""
    _refuse_other_quantity(quantity)
    sign, name = (text[0], text[1:]) if text[:1] in ("+", "-") else ("", text)
    unit = unit_of(name, quantity)
    if unit is None:
        remedy = (
            f"use one of {', '.join(UNITS[quantity])}; a minus before the unit turns the sign of the values"
        )
        raise InputError(f"--unit {quantity}={text}", f"the unit {name!r} is not known", remedy)
    return StatedUnit(text, UNITS[quantity][unit] * (-1.0 if sign == "-" else 1.0), sign != "")


def _refuse_other_quantity(quantity: str) -> None:
    if quantity not in QUANTITIES:
        raise InputError(
            "columns and units", f"{quantity!r} is not known", f"use one of {', '.join(QUANTITIES)}"
        )


def candidates_of(where: str, heading: Heading, stated: Stated) -> list[Candidates]:
    """Returns the columns that may hold each quantity, for each of the tables that stand side by side.

    Columns whose unit belongs to another quantity, and columns that name no measured value, are left out.

    Raises
    ------
    InputError : a quantity has no column, a stated column does not exist, or a unit is missing.
    """
    place = f"{where}, row {heading.row}"
    chosen = {q: _stated_column(place, q, name, heading) for q, name in stated.columns.items()}
    taken = {column.index for column in chosen.values()}
    named = [c for c in _named(heading) if c.index not in taken]
    by_quantity = {
        q: (chosen[q],) if q in chosen else tuple(c for c in named if c.quantity == q and _fits(c))
        for q in QUANTITIES
    }
    for quantity, columns in by_quantity.items():
        if not columns:
            raise _missing(place, quantity, heading, [c for c in named if c.quantity == quantity])
    groups = _side_by_side(by_quantity) if not chosen else None
    _refuse_missing_units(place, by_quantity, stated)
    return groups or [by_quantity]


def _named(heading: Heading) -> list[Column]:
    cells = zip(heading.names, heading.units, strict=True)
    columns = (parse_header(index, name, unit) for index, (name, unit) in enumerate(cells))
    return [column for column in columns if column is not None]


def _fits(column: Column) -> bool:
    return not column.aside and (column.has_unit or not column.unit)


def _stated_column(place: str, quantity: str, wanted: str, heading: Heading) -> Column:
    """Returns the column that the user names for a quantity."""
    if wanted.isdecimal():
        matching = [int(wanted) - 1] if 1 <= int(wanted) <= len(heading.names) else []
    else:
        matching = [i for i, name in enumerate(heading.names) if plain(name) == plain(wanted)]
    if len(matching) != 1:
        problem = heading.fault or f"the columns are {_listed(heading)}"
        raise InputError(
            f"{place}: --{quantity} {wanted}",
            problem,
            f"name one of these columns, or give a number from 1 to {len(heading.names)}",
        )
    index = matching[0]
    name = heading.names[index]
    return Column(index, quantity, name.strip(), unit_in(name, quantity, heading.units[index]))


def _listed(heading: Heading) -> str:
    return ", ".join(f"{n} {name.strip()!r}" for n, name in enumerate(heading.names, 1) if name.strip())[:300]


def _missing(place: str, quantity: str, heading: Heading, near: Sequence[Column]) -> InputError:
    """Returns the error of a quantity without a column; `near` are columns that name it and do not fit."""
    if heading.fault:
        remedy = "write a header, or import with --time 1 --displacement 2 --force 3 (the columns) and --unit"
        return InputError(place, heading.fault, remedy)
    said = [f"column {c.label} is {c.aside or f'in the unit {c.unit!r}'}" for c in near]
    problem = " and ".join(said) or f"there is no {quantity} column among {_listed(heading)}"
    units = ", ".join(UNITS[quantity])
    remedy = f"a {quantity} column in one of {units} is needed; or import with --{quantity} COLUMN"
    return InputError(place, problem, remedy)


def _refuse_missing_units(place: str, columns: Candidates, stated: Stated) -> None:
    """Raises InputError if a column has no unit, or one that is not known, and none is stated."""
    missing = [c for q, group in columns.items() for c in group if not (c.has_unit or q in stated.units)]
    if not missing:
        return
    quantities = dict.fromkeys(c.quantity for c in missing)
    listed = ", ".join(f"{c.label} ({c.unit!r})" if c.unit else c.label for c in missing)
    problem = f"the unit of {listed} is not known"
    options = " ".join(f"--unit {q}=UNIT" for q in quantities)
    units = "; ".join(f"{q}: {', '.join(UNITS[q])}" for q in quantities)
    raise InputError(place, problem, f"write it, or import with {options} ({units})")


def _side_by_side(columns: Candidates) -> list[Candidates] | None:
    """Returns the candidates of tables side by side, or None unless their headers repeat exactly."""
    count = len(columns["time"])
    if count < 2 or any(len(group) != count for group in columns.values()):
        return None
    tables: list[Candidates] = [{q: (columns[q][i],) for q in QUANTITIES} for i in range(count)]
    spans = [sorted(group[0].index for group in table.values()) for table in tables]
    headers = {tuple((q, plain(table[q][0].header), table[q][0].index - span[0]) for q in QUANTITIES)
               for table, span in zip(tables, spans, strict=True)}  # fmt: skip
    apart = all(before[-1] < after[0] for before, after in pairwise(spans))
    return tables if apart and len(headers) == 1 else None
