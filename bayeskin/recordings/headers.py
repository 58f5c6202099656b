"""Recognises what a header says of a column: time, displacement or force, the unit, or another quantity."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from bayeskin.recordings.units import QUANTITIES, UNITS, is_unit, plain, unit_of
from bayeskin.recordings.vocabulary import ASIDE, JAPANESE, SYMBOLS, WORDS

_BRACKETS = re.compile(r"[\[({<]([^\[\](){}<>]*)[\])}>]")
_COMMENT = re.compile(r"^\s*(?:#+|%+|//+|!+)\s*")  # numpy and other programs begin a header like this
_RULE = re.compile(r"[-=_+|*.\s]*")


@dataclass(frozen=True)
class Column:
    """A recognised column.

    index : its place in the row, from 0
    quantity : time, displacement or force
    header : its text in the file
    unit : the standard name of its unit, an unknown unit as it is written, or "" where none is given
    aside : the reason why it is no measured value of the quantity ("a set point"), or ""
    """

    index: int
    quantity: str
    header: str
    unit: str
    aside: str = ""

    @property
    def has_unit(self) -> bool:
        """Returns whether the unit is a known unit of the quantity."""
        return self.unit in UNITS[self.quantity]

    @property
    def label(self) -> str:
        """Returns how messages call the column: its header, or its number where it has none."""
        return repr(self.header) if self.header else str(self.index + 1)


def without_comment(text: str) -> str:
    """Returns a header without the sign that makes it a comment."""
    return _COMMENT.sub("", text)


def parse_header(index: int, header: str, unit_below: str = "") -> Column | None:
    """Returns the column that a header describes, or None if it names none or several of the quantities.

    The unit stands in brackets, after a comma, underscore, slash or blank (`time_s`, `Force N`), or in the
    row of units, whose cell is `unit_below`.
    """
    words = _words(header)
    named = _quantities(header, words)
    if len(named) != 1:
        return None
    quantity = named.pop()
    unit = unit_in(header, quantity, unit_below)
    if quantity == "time" and unit == "min":
        words = [word for word in words if word != "min"]
    return Column(index, quantity, header.strip(), unit, _aside(header, words))


def unit_in(header: str, quantity: str, unit_below: str = "") -> str:
    """Returns the unit that a header and the cell below it give to a quantity, or "" if they give none.

    A unit that is not known is returned as it is written. Two different units give both, as "mm, m".
    """
    text = _narrow(header)
    bracketed = [part.strip() for part in _BRACKETS.findall(text)]
    known = [unit for unit in (unit_of(part, quantity) for part in bracketed) if unit]
    outside = _BRACKETS.sub(" ", text).strip()
    last = re.split(r"[\s_,;:/]+", outside)[-1]
    if not known and unit_of(last, quantity) and last != outside:
        known = [unit_of(last, quantity) or ""]
    below = unit_below.strip("[](){}<> ")
    if below:
        known.append(unit_of(below, quantity) or below)
    if not known and "%" in text:
        return "%"
    if not known:
        return bracketed[-1] if bracketed else ""
    return ", ".join(dict.fromkeys(known))


def names_quantities(headers: Sequence[str]) -> int:
    """Returns how many of the three quantities a row names."""
    columns = (parse_header(index, header) for index, header in enumerate(headers))
    return len({column.quantity for column in columns if column is not None})


def is_unit_row(cells: Sequence[str]) -> bool:
    """Returns whether a row such as ``s; mm; N`` or ``(s), (mm), (MPa)`` holds units below their columns."""
    units = [is_unit(cell.strip("[](){}<> ")) for cell in cells]
    named = [
        cell for cell, unit in zip(cells, units, strict=True) if not unit and _quantities(cell, _words(cell))
    ]
    return sum(units) >= 2 and not named


def is_rule(cells: Sequence[str]) -> bool:
    """Returns whether a row only draws a line, as ``-----``."""
    return all(_RULE.fullmatch(cell) for cell in cells)


def _narrow(header: str) -> str:
    """Returns a header without a comment sign, and with ASCII letters and brackets for wide ones."""
    return unicodedata.normalize("NFKC", without_comment(header))


def _words(header: str) -> list[str]:
    """Returns the words of a header, without units in brackets; "Load1" and "load" are the same word."""
    text = _BRACKETS.sub(lambda m: " " if is_unit(m[1]) else f" {m[1]} ", _narrow(header))
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    words = re.findall(r"[^\W\d_]+\d*", plain(text))
    return [re.sub(r"\d+$", "", word) if re.match(r"[^\W\d_]{3}", word) else word for word in words]


def _quantities(header: str, words: Sequence[str]) -> set[str]:
    """Returns the quantities that a header names."""
    named = {WORDS[word] for word in words if word in WORDS}
    named |= {q for q in QUANTITIES if any(word in _narrow(header) for word in JAPANESE[q])}
    if not named:
        names = [word for word in words if not is_unit(word)] or list(words)
        named = {SYMBOLS[names[0]]} if len(names) == 1 and names[0] in SYMBOLS else set()
    return named


def _aside(header: str, words: Sequence[str]) -> str:
    """Returns the reason why a header names no measured value, or ""."""
    listed = [ASIDE[word] for word in words if word in ASIDE]
    japanese = (reason for word, reason in ASIDE.items() if not word.isascii() and word in _narrow(header))
    return next(chain(listed, japanese), "")
