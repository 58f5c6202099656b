"""Converts the cells of a column to numbers, whatever their decimal sign and thousands separators.

A cell such as ``1,234`` is 1234 or 1.234. A column keeps both readings until other cells of the table tell
which of them is right.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import date, time, timedelta
from typing import Any

import numpy as np

from bayeskin.types import Array

DECIMALS = (".", ",")
_BLANKS = " \u00a0\u2009\u202f"
_PLAIN = frozenset("0123456789+-eE")
_NOT_FINITE = frozenset(("nan", "inf", "infinity"))


def _patterns(decimal: str, other: str) -> tuple[str, str]:
    """Returns the patterns of numbers without and with thousands separators."""
    sign, by = re.escape(decimal), f"by_{'point' if decimal == '.' else 'comma'}"
    ungrouped = rf"[+-]?(?:\d+(?:{sign}\d*)?|{sign}\d+)(?:[eE][+-]?\d+)?(?<!,)"
    grouped = (
        rf"[+-]?[1-9]\d{{0,2}}(?P<{by}>[{other}'’{_BLANKS}])\d{{3}}(?:(?P={by})\d{{3}})*(?:{sign}\d*)?(?<!,)"
    )
    return ungrouped, grouped


_UNGROUPED = {decimal: re.compile(_patterns(decimal, other)[0]) for decimal, other in (".,", ",.")}
_GROUPED = {decimal: re.compile(_patterns(decimal, other)[1]) for decimal, other in (".,", ",.")}
_ANY = re.compile("|".join(f"(?:{pattern})" for pattern in (*_patterns(".", ","), *_patterns(",", "."))))


def is_number(cell: Any) -> bool:
    """Returns whether a cell looks like a number in some notation."""
    if isinstance(cell, str):
        text = cell.strip().replace("−", "-")
        return bool(_ANY.fullmatch(text)) or text.lstrip("+-").lower() in _NOT_FINITE
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def describe_cell(cell: Any) -> str:
    """Returns a clause about a cell that is not a number, for a message."""
    if cell is None or not str(cell).strip():
        return "the cell is empty, or has a formula whose value is not stored in the file"
    if isinstance(cell, date | time | timedelta) or re.match(r"\s*\d+:\d\d", str(cell)):
        return f"the cell contains a date or a time of day, {str(cell).strip()[:40]!r}"
    return f"the cell contains {cell!r}"[:80]


class Numbers:
    """The numbers of one column, chunk by chunk, for each decimal sign with which every cell is a number.

    read : the arrays (chunk,) by decimal sign; a sign that cannot be right is absent
    grouped : whether a cell has thousands separators, by decimal sign
    example : a cell whose value depends on the decimal sign, or ""
    """

    def __init__(self) -> None:
        self.read: dict[str, list[Array]] = {decimal: [] for decimal in DECIMALS}
        self.grouped = dict.fromkeys(DECIMALS, False)
        self.example = ""

    def parsed(self, cells: Sequence[Any]) -> dict[str, Array]:
        """Returns cells as numbers, by decimal sign. Raises ValueError if no sign fits them all."""
        texts = [cell.strip() for cell in cells if isinstance(cell, str)]
        signs = set("".join(texts)) - _PLAIN
        if not signs & {".", ","}:
            return dict.fromkeys(self.read, _floats(cells, texts, ".", signs))
        chunk = {}
        for decimal in self.read:
            with suppress(ValueError):
                chunk[decimal] = _floats(cells, texts, decimal, signs)
        if not chunk:
            raise ValueError("no decimal sign makes numbers of all cells")
        if len(chunk) == 2 and not self.example:
            self.example = next(text for text in texts if "." in text or "," in text)
        for decimal in chunk:
            self.grouped[decimal] |= bool(signs - {decimal}) and any(map(_GROUPED[decimal].fullmatch, texts))
        return chunk

    def append(self, chunk: Mapping[str, Array]) -> None:
        """Adds a parsed chunk; the signs that do not fit it are given up."""
        self.read = {decimal: [*self.read[decimal], values] for decimal, values in chunk.items()}

    def first_wrong(self, cells: Sequence[Any]) -> tuple[int, str]:
        """Returns the index of the first wrong cell of a refused chunk, and what it must be."""
        possible = set(self.read)
        for index, cell in enumerate(cells):
            before, possible = possible, {decimal for decimal in possible if _fits(cell, decimal)}
            if not possible:
                other = is_number(cell) and any(_fits(cell, decimal) for decimal in DECIMALS)
                sign = f" with the decimal sign {next(iter(before))!r}, as in the rows above" if other else ""
                return index, f"it must be a number{sign}"
        raise AssertionError("every cell is a number")

    def values(self, decimal: str) -> Array:
        """Returns all numbers (n,) as they are with a decimal sign that is possible."""
        return np.concatenate(self.read[decimal])


def _fits(cell: Any, decimal: str) -> bool:
    try:
        _floats([cell], [cell.strip()] if isinstance(cell, str) else [], decimal, set("any"))
    except ValueError:
        return False
    return True


def _floats(cells: Sequence[Any], texts: Sequence[str], decimal: str, signs: set[str]) -> Array:
    """Returns cells as floats (n,). `texts` are those of them that are texts, `signs` their further signs."""
    if len(texts) < len(cells):
        if not all(isinstance(cell, str) or is_number(cell) for cell in cells):
            raise ValueError("a cell that is neither a text nor a number")
        cells = [_number(cell.strip(), decimal) if isinstance(cell, str) else cell for cell in cells]
    elif signs <= {decimal}:
        cells = texts if decimal == "." else [text.replace(",", ".") for text in texts]
    else:
        cells = [_number(text, decimal) for text in texts]
    try:
        return np.array(cells, dtype=float)
    except OverflowError:
        raise ValueError("a number beyond floating point") from None


def _number(text: str, decimal: str) -> float:
    """Returns the number that a text is with a decimal sign. Raises ValueError if it is none."""
    text = text.replace("−", "-")
    if _UNGROUPED[decimal].fullmatch(text) or text.lstrip("+-").lower() in _NOT_FINITE:
        return float(text.replace(decimal, "."))
    if _GROUPED[decimal].fullmatch(text):
        kept = "".join(c for c in text if c.isdigit() or c in f"+-{decimal}")
        return float(kept.replace(decimal, "."))
    raise ValueError(text)
