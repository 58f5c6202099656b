"""Makes the parts of a page about markers on the skin: their residuals, their noise, and what they add."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayeskin.number_format import number
from bayeskin.report.page.parts import Block, Cell, Folded, Heading, Picture, Table, Text, row
from bayeskin.report.words import markers_in_words


def marker_blocks(fits: Mapping[str, Mapping[str, Any]], drawn: Sequence[Picture]) -> list[Block]:
    """Returns blocks about the markers of one fit, or of several by their names; none without markers.

    fits : the entry `on_skin` of each fit
    """
    if not fits:
        return []
    named = len(fits) > 1
    lines = [
        f"{name.capitalize()}: {sentence[0].lower()}{sentence[1:]}" if named and at == 0 else sentence
        for name, fit in fits.items()
        for at, sentence in enumerate(markers_in_words(fit))
    ]
    largest = [
        _largest(name if named else "", fit["largest"]) for name, fit in fits.items() if fit["largest"]
    ]
    return [
        Heading("Markers on the skin"), Text(lines, listed=True), *drawn,
        *([Folded("The largest residuals of markers", largest)] if largest else []),
    ]  # fmt: skip


def _largest(name: str, residuals: Sequence[Mapping[str, Any]]) -> Table:
    """Returns the table of the longest significant residuals of a fit."""
    rows = [
        row((residual["point"], *(Cell(number(1e3 * value_m), value_m) for value_m in numbers)))
        for residual in residuals
        for numbers in [(*residual["place_m"], *residual["residual_m"])]
    ]
    head = ("marker", "along the pull [mm]", "across it [mm]", "residual along [mm]", "residual across [mm]")
    return Table(f"The largest residuals {name}".rstrip(), head, rows)
