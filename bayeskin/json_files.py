"""Converts values to JSON, and writes JSON files completely or not at all."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayeskin.errors import InputError


def write_json(path: Path, value: Any) -> None:
    """Writes a value as JSON, completely or not at all; NaN and infinity become null."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """Returns a value that JSON can hold.

    Arrays become lists, numpy numbers become Python's, paths become text, and NaN and infinity become None.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Returns the JSON lines of a file, and [] where there is no file.

    An incomplete last line is cut off, so that further lines can be added. Raises InputError for a line that
    is not a mapping in JSON.
    """
    if not file.is_file():
        return []
    contents = file.read_bytes()
    end = contents.rfind(b"\n") + 1
    if end != len(contents):
        os.truncate(file, end)
    rows = []
    for number, line in enumerate(contents[:end].splitlines(), start=1):
        try:
            rows.append(json.loads(line))
        except ValueError:
            rows.append(None)
        if not isinstance(rows[-1], dict):
            raise InputError(
                f"{file}, line {number}",
                "no JSON object",
                "a JSON object (without this file, the work starts again)",
            )
    return rows
