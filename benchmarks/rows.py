"""Stores the finished rows of a benchmark in a CSV, so that a benchmark that was stopped can continue."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bayeskin.finite_element
from bayeskin.hashing import sha256_of_behaviour
from bayeskin.workflow.engine import Silent

RESULTS = Path(__file__).parent / "results"
Row = dict[str, str]


@dataclass(frozen=True)
class Rows:
    """Describes a CSV with the columns `key` (all inputs of a row and the model's hash) and then `values`.

    The CSV grows by whole lines. Each line is written by one system call; a line that a crash has cut short
    does not count as a row.
    """

    path: Path
    key: tuple[str, ...]
    values: tuple[str, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """Returns all columns of the CSV in their order."""
        return (*self.key, *self.values)

    def read(self) -> list[Row]:
        """Returns all complete rows; of several rows with the same key, the last one.

        Ends the program where the file has other columns.
        """
        if not self.path.is_file():
            return []
        lines = self.path.read_text().splitlines(keepends=True)
        parsed = list(csv.reader(line for line in lines if line.endswith("\n")))
        if not parsed or tuple(parsed[0]) != self.columns:
            raise SystemExit(f"{self.path}: other columns than {', '.join(self.columns)}; move it away")
        rows = [dict(zip(self.columns, row, strict=True)) for row in parsed if len(row) == len(self.columns)]
        return list({self.key_of(row): row for row in rows[1:]}.values())

    def key_of(self, row: Mapping[str, Any]) -> tuple[str, ...]:
        """Returns the key of a row as texts."""
        return tuple(_text(row[name]) for name in self.key)

    def find(self, **inputs: Any) -> Row | None:
        """Returns the row of these inputs, or None."""
        return next((row for row in self.read() if self.key_of(row) == self.key_of(inputs)), None)

    def append(self, **row: Any) -> Row:
        """Appends one row at once, and returns it as it will be read."""
        text = {name: _text(row[name]).replace("\n", " ") for name in self.columns}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        before = self.path.read_bytes() if self.path.is_file() else b""
        buffer = io.StringIO()
        if before and not before.endswith(b"\n"):
            buffer.write("\n")  # ends a line that was cut short, which has too few columns to count as a row
        writer = csv.writer(buffer, lineterminator="\n")
        if not before:
            writer.writerow(self.columns)
        writer.writerow(text.values())
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(handle, buffer.getvalue().encode())
            os.fsync(handle)
        finally:
            os.close(handle)
        return text


def _text(value: Any) -> str:
    """Returns a value as it is written in the CSV."""
    return format(value, ".10g") if isinstance(value, float) else str(value)


def digest(inputs: Mapping[str, Any]) -> str:
    """Returns a short name of a row's inputs, for a file beside the CSV."""
    text = json.dumps({name: _text(value) for name, value in inputs.items()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def code_digest(sources: Iterable[Path]) -> str:
    """Returns a hash of how Python sources behave."""
    hashes = "".join(sha256_of_behaviour(path.read_bytes()) for path in sorted(sources))
    return hashlib.sha256(hashes.encode()).hexdigest()[:12]


# This is a hash of the model's source when it was loaded. Times and small errors depend on more than the
# model hash covers.
CODE = code_digest(Path(bayeskin.finite_element.__file__).parent.glob("*.py"))


def warn_of_mixed_code(rows: Sequence[Row]) -> None:
    """Prints a warning if the rows of one table come from more than one state of the model's source."""
    codes = sorted({row["code"] for row in rows})
    if len(codes) > 1:
        states = ", ".join(codes)
        say(f"warning: rows from {len(codes)} states of bayeskin/finite_element ({states}) in one table")


class Log(Silent):
    """Prints on stderr what stages log."""

    def log(self, message: str) -> None:
        """Prints a message on stderr."""
        say(message)


def say(text: str) -> None:
    """Prints a text on stderr."""
    print(text, file=sys.stderr, flush=True)


def progress(label: str, every_s: float = 20.0) -> Callable[[float], None]:
    """Returns a function that prints on stderr how much of a run is done, at most every `every_s` seconds."""
    last = time.monotonic()

    def show(fraction: float) -> None:
        nonlocal last
        if time.monotonic() - last > every_s:
            last = time.monotonic()
            say(f"  {label}: {100 * fraction:.0f} %")

    return show


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table of cells that are already formatted."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def into_docs(path: Path, name: str, block: str) -> None:
    """Writes a block between the markers of this name in a page; ends the program where they are missing."""
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    page = path.read_text()
    if not re.search(f"{start}\n.*{end}", page, re.DOTALL):
        raise SystemExit(f"{path}: no markers {start} and {end}")
    written = re.sub(f"{start}\n.*{end}", lambda _: f"{start}\n\n{block}\n\n{end}", page, flags=re.DOTALL)
    staged = path.with_name(f".{path.name}.partial")
    staged.write_text(written)
    staged.replace(path)
