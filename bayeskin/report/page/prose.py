"""Formats the sentences of the stages for a page: symbols, units with prefixes, minus signs."""

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
    """Returns escaped text in which ``E_c`` is a symbol and ``5.08e+04 Pa`` reads 50.8 kPa."""
    pieces, end = Markup(), 0
    text = _numbers(text)
    for match in _NAME.finditer(text):
        head, tail = match.groups()
        pieces += text[end : match.start()]
        pieces += Markup("<i>{}</i><sub>{}</sub>").format(_GREEK.get(head, head), tail)
        end = match.end()
    return pieces + escape(text[end:])


def _numbers(text: str) -> str:
    """Returns text in which numbers and their units have the form in which a page prints them."""
    text = re.sub(
        rf"{_NUMBER} to {_NUMBER} {_UNIT}", lambda m: interval(float(m[1]), float(m[2]), m[3]), text
    )
    text = re.sub(rf"{_NUMBER} {_UNIT}", lambda m: quantity(float(m[1]), m[2]), text)
    text = re.sub(rf"{_NUMBER}(?=[\s,;.:)]|$)", _number, text)
    return re.sub(r"\bm\^2(?!\w)", unit_text("m^2"), text)


def _number(found: re.Match[str]) -> str:
    """Returns a matched number in printed form: with a minus sign, and without an exponent such as e+04."""
    return number(float(found[1])) if "e" in found[1] else found[1].replace("-", "−")
