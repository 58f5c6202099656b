"""Defines the parts of a page. The template turns each part into HTML and computes nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Cell:
    """Holds the text of a table cell and the number by which it is sorted; with None, its text is sorted.

    href : the page that the text opens
    """

    text: str
    order: float | None = None
    href: str = ""


@dataclass(frozen=True)
class Table:
    """Holds a table. The first cell of a row names the row; with `symbols`, these names are parameters."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    symbols: bool = False


@dataclass(frozen=True)
class Picture:
    """Holds a figure that can be enlarged. `svg` is already safe for use inside a page."""

    key: str
    title: str
    alt: str
    svg: str


@dataclass(frozen=True)
class Heading:
    """Holds the heading of the blocks that follow in a section."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Holds short facts, each with its name."""

    pairs: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Text:
    """Holds paragraphs, which form a list with `listed`."""

    lines: Sequence[str]
    listed: bool = False


@dataclass(frozen=True)
class Missing:
    """Holds the reason why a stage is not done, and the command that runs it."""

    message: str
    command: str = ""


@dataclass(frozen=True)
class Folded:
    """Holds blocks that stay hidden until the reader opens them."""

    title: str
    blocks: Sequence[Any]


@dataclass(frozen=True)
class Source:
    """Holds the unchanged text of a file."""

    title: str
    text: str


@dataclass(frozen=True)
class Key:
    """Holds an entry of a chart's legend.

    mark : "dots", "line", "before", "dashed", "band", "window" or a "phase"
    """

    text: str
    mark: str
    color: str = ""


@dataclass(frozen=True)
class Chart:
    """Holds a plot over time that can be enlarged: its drawing, and the data that the cross-hair shows.

    screen : "wide" or "narrow" for a plot that only such a screen shows, "" for any other
    """

    key: str
    title: str
    svg: str
    data: Mapping[str, Any]
    alt: str
    keys: Sequence[Key]
    screen: str = ""


Block = Heading | Table | Picture | Facts | Text | Missing | Folded | Source | Chart


@dataclass(frozen=True)
class Section:
    """Holds a section of a page: its key in links, its title and its blocks."""

    key: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Bar:
    """Holds the position of a 90 % interval and its median in the prior's range, in percent of the range."""

    left: float
    width: float
    median: float


@dataclass(frozen=True)
class ParameterSummary:
    """Holds one line of the answer: a parameter, its meaning, its posterior and its prior."""

    name: str
    meaning: str
    median: str
    interval: str
    learnt: str
    tone: str
    prior: str
    bar: Bar


@dataclass(frozen=True)
class Verdict:
    """Holds a part of the answer: a word, its tone ("good", "doubt" or "none"), and the reasons.

    command : the command that would give the answer, where it is not known yet
    """

    word: str
    tone: str
    lines: Sequence[str]
    command: str = ""


@dataclass(frozen=True)
class Answer:
    """Holds the answers to a reader's first questions: parameters, trust in them, and missing physics.

    missing : the verdict and the three sentences of the diagnosis, if one was made
    """

    parameters: Sequence[ParameterSummary]
    material: Verdict
    sure: Verdict
    missing: Verdict


def row(cells: Iterable[str | Cell]) -> tuple[Cell, ...]:
    """Returns the cells of a row; a cell of plain text is sorted by its text."""
    return tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in cells)
