"""Prints the names of parameters in sentences as symbols, and commands as code."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

from bayeskin.report.style import GREEK

_GREEK = {**GREEK, "sd": GREEK["sigma"]}
_NAME = re.compile(rf"(?<![\w./-])([A-Za-z]|{'|'.join(_GREEK)})_([a-z]\w*)(?![\w/(]|\.\w)")


def prose(text: str) -> Markup:
    """Returns escaped text in which the name ``E_c`` is a symbol, and what stands in backticks is code."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:  # a backtick without a partner is a character of the text
        return _with_symbols(text)
    return Markup().join(
        Markup("<code>{}</code>").format(piece) if i % 2 else _with_symbols(piece)
        for i, piece in enumerate(pieces)
    )


def _with_symbols(text: str) -> Markup:
    """Returns escaped text in which the name ``E_c`` is a symbol."""
    pieces, end = Markup(), 0
    for match in _NAME.finditer(text):
        head, tail = match.groups()
        pieces += text[end : match.start()]
        pieces += Markup("<i>{}</i><sub>{}</sub>").format(_GREEK.get(head, head), tail)
        end = match.end()
    return pieces + escape(text[end:])
