"""Sentences that the stages say, as a page prints them: symbols, units with prefixes, minus signs."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

from bayeskin.report.page.numbers import interval, number, quantity
from bayeskin.report.style import GREEK, unit_text

_GREEK = {**GREEK, "sd": GREEK["sigma"]}
_NAME = re.compile(rf"(?<![\w./-])([A-Za-z]|{'|'.join(_GREEK)})_([a-z]\w*)(?![\w/(]|\.\w)")
_NUMBER = r"(?<![\w.-])(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)"
_UNIT = r"(Pa|N|m\^2)(?![\w^])"


def prose(text: str) -> Markup:
    """Text, escaped, with ``E_c`` as a symbol and ``5.08e+04 Pa`` as 50.8 kPa."""
    pieces, end = Markup(), 0
    text = _numbers(text)
    for found in _NAME.finditer(text):
        head, tail = found.groups()
        pieces += text[end : found.start()]
        pieces += Markup("<i>{}</i><sub>{}</sub>").format(_GREEK.get(head, head), tail)
        end = found.end()
    return pieces + escape(text[end:])


def _numbers(text: str) -> str:
    text = re.sub(
        rf"{_NUMBER} to {_NUMBER} {_UNIT}", lambda m: interval(float(m[1]), float(m[2]), m[3]), text
    )
    text = re.sub(rf"{_NUMBER} {_UNIT}", lambda m: quantity(float(m[1]), m[2]), text)
    text = re.sub(rf"{_NUMBER}(?=[\s,;.:)]|$)", _number, text)
    return re.sub(r"\bm\^2(?!\w)", unit_text("m^2"), text)


def _number(found: re.Match[str]) -> str:
    """Powers of ten and minus signs; other digits as they stand."""
    return number(float(found[1])) if "e" in found[1] else found[1].replace("-", "−")
