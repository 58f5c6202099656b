"""Parts of a page; the template turns each into HTML and computes nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Cell:
    """Text of a table's cell, and the number by which it is sorted (None: by its text)."""

    text: str
    order: float | None = None


@dataclass(frozen=True)
class Table:
    """A table with a caption; the first cell of each row names it. `symbols`: names are parameters'."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    symbols: bool = False


@dataclass(frozen=True)
class Picture:
    """A figure that can be enlarged. `svg` has been made safe to stand inside a page."""

    key: str
    title: str
    alt: str
    svg: str


@dataclass(frozen=True)
class Heading:
    """Over the blocks that follow in a section."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Short facts, each with its name."""

    pairs: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Text:
    """Paragraphs; with `listed`, a list of them."""

    lines: Sequence[str]
    listed: bool = False


@dataclass(frozen=True)
class Missing:
    """A stage that is not done, why, and the command that does it."""

    message: str
    command: str = ""


@dataclass(frozen=True)
class Folded:
    """Blocks that a reader opens when he wants them."""

    title: str
    blocks: Sequence[Any]


@dataclass(frozen=True)
class Source:
    """Text as it stands in a file."""

    title: str
    text: str


@dataclass(frozen=True)
class Key:
    """Entry of a chart's legend: "dots", "line", "dashed" or "band", in its own colour or none."""

    text: str
    mark: str
    color: str = ""


@dataclass(frozen=True)
class Chart:
    """A plot over time that can be enlarged: a drawing, and what a cross-hair reads from it."""

    key: str
    title: str
    svg: str
    data: Mapping[str, Any]
    alt: str
    keys: Sequence[Key]


Block = Heading | Table | Picture | Facts | Text | Missing | Folded | Source | Chart


@dataclass(frozen=True)
class Section:
    key: str
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Bar:
    """Position of a 90 % interval and its median in the prior's range, in percent of its width."""

    left: float
    width: float
    median: float


@dataclass(frozen=True)
class Made:
    """One line of the answer: a parameter, what it means and was found to be."""

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
    """A part of the answer: a word, the tone it is said in ("good", "doubt", "none"), and why."""

    word: str
    tone: str
    lines: Sequence[str]
    command: str = ""


@dataclass(frozen=True)
class Answer:
    """Answers to a reader's first questions: the skin's properties, how sure they are, what is missing."""

    made: Sequence[Made]
    made_of: Verdict
    sure: Verdict
    missing: Verdict


def row(cells: Iterable[str | Cell]) -> tuple[Cell, ...]:
    """Cells of a row; plain text is sorted as such."""
    return tuple(cell if isinstance(cell, Cell) else Cell(cell) for cell in cells)
