"""Recognises the columns of a recording from their headers: time, displacement or force, and the unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from bayeskin.errors import InputError

QUANTITIES = ("time", "displacement", "force")

# These factors convert to SI. Units are compared in lower case, so MN is read as mN. No skin test reaches a
# meganewton.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "displacement": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "force": {"N": 1.0, "mN": 1e-3},
}
_SPELLINGS = {
    **{name.lower(): name for table in UNITS.values() for name in table},
    **dict.fromkeys(("sec", "second", "seconds", "seconde", "secondes"), "s"),
    **dict.fromkeys(("minute", "minutes"), "min"),
    **dict.fromkeys(("μm", "micron", "microns", "micrometre", "micrometres"), "um"),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
    **dict.fromkeys(("newton", "newtons"), "N"),
}
_WORDS = {
    "time": {"t", "time", "temps"},
    "displacement": {"d", "disp", "displ", "displacement", "depl", "deplacement", "lvdt"}
    | {"extension", "allongement", "course", "stroke"},
    "force": {"f", "rf", "force", "effort", "reaction", "load", "charge"},
}


@dataclass(frozen=True)
class Column:
    """A recognised column: its index, quantity and header, and its unit ("" if the header gives none)."""

    index: int
    quantity: str
    header: str
    unit: str

    @property
    def has_unit_of_its_quantity(self) -> bool:
        return self.unit == "" or self.unit in UNITS[self.quantity]


def _without_accents(text: str) -> str:
    """Returns the text in lower case, without accents, and with a single sign for micro."""
    plain = unicodedata.normalize("NFKD", text)
    return "".join(c for c in plain if not unicodedata.combining(c)).lower().strip()


def parse_unit(text: str) -> str:
    """Returns the standard name of a unit ("mm" for "Millimètres"), or the text itself if it is unknown."""
    return _SPELLINGS.get(_without_accents(text).rstrip("."), text.strip())


def parse_header(index: int, header: str) -> Column | None:
    """Returns the column that a header describes, or None if the column is not needed.

    The unit stands in brackets, or at the end after an underscore, blank, comma or slash (`time_s`,
    `Force N`).
    """
    bracketed = re.search(r"[\[({<]([^\])}>]*)[\])}>]", header)
    name = header if bracketed is None else header[: bracketed.start()] + " " + header[bracketed.end() :]
    words = [word for word in re.split(r"[^a-zμ]+", _without_accents(name)) if word]
    unit = parse_unit(bracketed.group(1)) if bracketed else ""
    if bracketed is None and len(words) > 1 and words[-1] in _SPELLINGS:
        unit = _SPELLINGS[words.pop()]
    meant = {q for q in QUANTITIES if _WORDS[q].intersection(words)}
    return Column(index, meant.pop(), header.strip(), unit) if len(meant) == 1 else None


def recognise(headers: Sequence[str]) -> list[Column]:
    """Returns all columns of a header row that could be time, displacement or force."""
    columns = (parse_header(index, header) for index, header in enumerate(headers))
    return [column for column in columns if column is not None]


def is_header(headers: Sequence[str]) -> bool:
    """Returns whether a row names at least two of the three quantities, which makes it the header."""
    return len({column.quantity for column in recognise(headers)}) >= 2


def choose_columns(where: str, headers: Sequence[str]) -> dict[str, Column]:
    """Returns the column of each quantity.

    A column is ignored if its unit does not belong to its quantity ("Displacement rate (mm/s)") and another
    column of this quantity has a suitable unit or none.

    Raises
    ------
    InputError : a quantity has no column, two columns, or a unit that is not known.
    """
    columns = recognise(headers)
    chosen = {}
    for quantity in QUANTITIES:
        named = [c for c in columns if c.quantity == quantity]
        fitting = [c for c in named if c.has_unit_of_its_quantity]
        accepted = ", ".join(UNITS[quantity])
        if not named:
            listed = ", ".join(repr(h.strip()) for h in headers if h.strip()) or "no header"
            raise InputError(where, listed[:200], f"a {quantity} column with one of the units {accepted}")
        if not fitting:
            raise InputError(
                where, f"column {named[0].header!r}", f"{quantity} with one of the units {accepted}"
            )
        if len(fitting) > 1:
            candidates = " and ".join(repr(c.header) for c in fitting)
            raise InputError(where, f"{candidates}, each a {quantity} column", f"one {quantity} column")
        chosen[quantity] = fitting[0]
    return chosen
