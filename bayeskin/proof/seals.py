"""A set's files: recordings in the open, keys under seal, and an index that shows if a key was changed.

FOLDER/index.json           sha256 of each recording and of its key
FOLDER/recordings/001.h5    nothing in it tells what it conceals
FOLDER/seals/001.json       the key; seals/set.json the seed
FOLDER/verdicts/001.json    what a diagnosis said
FOLDER/scorings.json        each scoring of the whole set
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from bayeskin.errors import InputError

RECORDINGS, SEALS, VERDICTS = "recordings", "seals", "verdicts"
INDEX, SCORINGS, SET = "index.json", "scorings.json", "set.json"
_CLOSED: list[str] = []  # folders under seal at the moment; the hook stays once it is set


def sha256(path: Path) -> str:
    """Of a file's bytes; empty where there is no such file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def write_json(path: Path, value: Any) -> None:
    """Whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_json(path: Path) -> Any:
    """Raises InputError for a file that is absent or no JSON."""
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(path, error.strerror or "an unreadable file", "a file of a proof's set") from None
    except ValueError:
        raise InputError(path, "no JSON", "a file of a proof's set") from None


def read_index(folder: Path) -> dict[str, dict[str, str]]:
    """sha256 of recording and key by number ("001"); raises InputError where there is no set."""
    found: dict[str, dict[str, str]] = read_json(folder / INDEX)["recordings"]
    return dict(sorted(found.items()))


def recording_path(folder: Path, number: str) -> Path:
    return folder / RECORDINGS / f"{number}.h5"


def read_keys(folder: Path) -> dict[str, Mapping[str, Any]]:
    """The keys by number. Raises InputError for a recording or a key that is not what the index says."""
    keys = {}
    for number, said in read_index(folder).items():
        for path, expected in (
            (recording_path(folder, number), said["recording_sha256"]),
            (folder / SEALS / f"{number}.json", said["key_sha256"]),
        ):
            if sha256(path) != expected:
                raise InputError(path, "other contents than the index says", f"sha256 {expected[:12]}...")
        keys[number] = read_json(folder / SEALS / f"{number}.json")
    return keys


@contextlib.contextmanager
def closed(folder: Path) -> Iterator[None]:
    """While it lasts, this process and those that it forks can open no file under the set's seals.

    An attempt raises PermissionError.
    """
    _set_hook()
    sealed = os.path.realpath(folder / SEALS)
    _CLOSED.append(sealed)
    try:
        yield
    finally:
        _CLOSED.remove(sealed)


@cache
def _set_hook() -> None:
    sys.addaudithook(_refuse)  # for good: Python takes none back


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    if _CLOSED and event in ("open", "os.listdir", "os.scandir"):
        name = arguments[0]
        if isinstance(name, str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(name))
            if any(path == one or path.startswith(one + os.sep) for one in _CLOSED):
                raise PermissionError(f"{path} is under seal")
