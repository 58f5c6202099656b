"""Turns the bytes of a text file into rows of cells: encoding, delimiter, quotes, columns set by blanks."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from bayeskin.errors import InputError
from bayeskin.recordings.headers import names_quantities, without_comment
from bayeskin.recordings.numbers import is_number


@dataclass(frozen=True)
class TextSettings:
    """Limits of what is taken for a table.

    header_within : rows in which a table has to begin; a laboratory's preamble stands before it
    run : consecutive rows of numbers with as many cells that make a delimiter credible
    lines_of_cell : most lines of a quoted cell
    longest_header : most characters of a header whose columns are set by blanks
    """

    header_within: int = 1000
    run: int = 3
    lines_of_cell: int = 10
    longest_header: int = 5000


TEXT = TextSettings()
_DELIMITERS = (";", "\t", ",", "|", " ")
_BLANKS, _ZEROS = re.compile(r"[ \t]+"), re.compile(r"(?<![\d.,eE+-])[+-]?0\d")
NumberedRow = tuple[int, Sequence[object]]
Rows = Callable[[], Iterator[NumberedRow]]

# A single-byte encoding reads any bytes, so the encodings after UTF-8 are told apart by the header's words.
_OTHER_ENCODINGS = ("cp1252", "cp932")


def rows_of_text(path: Path, data: bytes) -> tuple[Rows, str, tuple[str, ...]]:
    """Returns a function that yields the numbered rows of a text file, its delimiter, and notes.

    The delimiter is " " where blanks separate the columns. Then a line that holds no numbers is one cell.

    Raises
    ------
    InputError : the file is empty, or no text in a known encoding, or has no rows of numbers near its start.
    """
    if not data.strip(b"\0 \t\r\n"):
        raise InputError(path, "the file is empty", "a recording needs a header row and rows of numbers")
    decoded = list(_decoded(path, data))
    if not decoded:
        raise InputError(
            path, "it is not text", "bayeskin needs text in UTF-8, UTF-16, Windows-1252 or Shift-JIS"
        )
    ways = [(text, encoding, delimiter) for text, encoding in decoded for delimiter in _DELIMITERS]
    starts = [_start(text, delimiter) for text, _, delimiter in ways]
    fitting = [i for i, start in enumerate(starts) if start is not None]
    if not fitting:
        first = next((line.strip() for line in _lines(decoded[0][0]) if line.strip()), "")
        problem = f"it has no rows of numbers near its start (the first line is {first[:60]!r})"
        raise InputError(
            path,
            problem,
            "a recording needs a header that names time, displacement and force, and its numbers",
        )
    headed = (i for i in fitting if any(names_quantities(row) >= 2 for row in (starts[i] or [])[-3:]))
    text, encoding, delimiter = ways[next(headed, fitting[0])]
    notes = () if encoding == "utf-8" else (f"text read as {encoding}",)
    return (lambda: _split(_lines(text), delimiter)), delimiter, notes


def header_cells(line: str, width: int) -> list[str] | None:
    """Returns the `width` names of a header whose columns are set by blanks, or None if they are not clear.

    The names are separated by two blanks or more, or each ends with its unit in brackets, or each is a word.
    Words are not clear where two blanks or more already separate at least three names.
    """
    bracket = r"\s*[\[(][^\[\]()]*[\])]"
    for text in (without_comment(line).strip(), line.strip()) if len(line) < TEXT.longest_header else ():
        apart = re.split(r"\s{2,}|\t", text)
        bracketed = re.findall(rf"[^\[(]+(?:{bracket})+", text)
        words = re.findall(rf"[^\s\[(]+(?:{bracket})*", text)
        ways = [apart, bracketed]
        if "".join(bracketed) != text:
            ways = [apart] if 3 <= len(apart) < width else [apart, words, text.split()]
        fitting = {tuple(part.strip() for part in way) for way in ways if len(way) == width}
        if len(fitting) == 1:
            return list(fitting.pop())
    return None


def _decoded(path: Path, data: bytes) -> Iterator[tuple[str, str]]:
    """Yields the text under each encoding that may be right, with the encoding's name."""
    some = data[:4096]
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        unicode = "utf-16"
    elif some[1::2].count(0) > 0.4 * len(some) // 2:
        unicode = "utf-16-le"
    elif some[::2].count(0) > 0.4 * len(some) // 2:
        unicode = "utf-16-be"
    else:
        unicode = "utf-8-sig"
    for encoding in (unicode, *_OTHER_ENCODINGS):
        with suppress(UnicodeDecodeError):
            yield _without_nuls(path, data.decode(encoding)), encoding.removesuffix("-sig")
            if encoding == unicode:
                return


def _without_nuls(path: Path, text: str) -> str:
    """Returns a text without the NULs that fill up its fields. Raises InputError for a NUL in a number."""
    if "\0" not in text:
        return text
    text = re.sub(r"(?<![\d.,])\0+|\0+(?![\d.,])", "", text)
    if "\0" in text:
        raise InputError(
            path,
            "it is not text (there is a NUL within a number)",
            "bayeskin needs a text file, or a workbook",
        )
    return text


def _lines(text: str) -> Iterator[str]:
    """Returns an iterator over the lines, because a list of ten million lines would take a gigabyte."""
    return (match[1] for match in re.finditer(r"([^\r\n]*)(?:\r\n|\r|\n|\Z)", text))


def _start(text: str, delimiter: str) -> list[list[str]] | None:
    """Returns the rows before the first rows of numbers, or None if the delimiter makes no such rows."""
    before: list[list[str]] = []
    run, width = 0, 0
    for _, row in islice(_split(_lines(text), delimiter), TEXT.header_within):
        if sum(map(is_number, row)) < 2:
            before.append([str(cell) for cell in row])
            run = 0
            continue
        run, width = (run + 1 if len(row) == width else 1), len(row)
        if run == TEXT.run:
            return before if delimiter != " " else [header_cells(row[0], width) or row for row in before]
    return None


def _split(lines: Iterator[str], delimiter: str) -> Iterator[NumberedRow]:
    return _split_by_blanks(lines) if delimiter == " " else _split_by(lines, delimiter)


def _split_by_blanks(lines: Iterator[str]) -> Iterator[NumberedRow]:
    """Yields the cells of lines that hold numbers; every other line is one cell.

    Cells such as 034 show that a blank separates thousands too, so their line is no row of numbers.
    """
    for number, line in enumerate(lines, start=1):
        cells = [] if _ZEROS.search(line) else _BLANKS.split(line.strip(" \t"))
        numbers = islice(filter(is_number, cells), 2)
        yield number, cells if len(list(numbers)) == 2 else [line]


def _split_by(lines: Iterator[str], delimiter: str) -> Iterator[NumberedRow]:
    """Yields the cells of lines; a quoted cell may go on in the next lines. Faulty quotes are kept."""
    numbered = enumerate(lines, start=1)
    for number, line in numbered:
        if '"' not in line:
            yield number, line.split(delimiter)
            continue
        whole = [line]
        while sum(part.count('"') for part in whole) % 2 and len(whole) < TEXT.lines_of_cell:
            following = next(numbered, None)
            if following is None:
                break
            whole.append(following[1])
        try:
            rows = list(
                csv.reader(["\n".join(whole)], delimiter=delimiter, strict=True, skipinitialspace=True)
            )
        except csv.Error:
            rows = []
        if len(rows) == 1:
            yield number, [" ".join(cell.split("\n")) for cell in rows[0]]
        else:
            yield from ((number + i, part.split(delimiter)) for i, part in enumerate(whole))
