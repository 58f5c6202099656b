"""A set's files: recordings in the open, keys under seal, and an index that shows if a key was changed.

FOLDER/index.json           sha256 of each recording and of its key
FOLDER/recordings/001.h5    nothing in it tells what it conceals
FOLDER/seals/001.json       the key; seals/set.json the seed
FOLDER/verdicts/001.json    what a diagnosis said
FOLDER/scorings.json        each scoring of the whole set
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from bayeskin import storage
from bayeskin.access_guard import off_limits
from bayeskin.errors import InputError

RECORDINGS, SEALS, VERDICTS = "recordings", "seals", "verdicts"
INDEX, SCORINGS, SET = "index.json", "scorings.json", "set.json"


def sha256(path: Path) -> str:
    """Of a file's bytes; empty where there is no such file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def write_json(path: Path, value: Any) -> None:
    """Whole or not at all. Raises InputError where it cannot be written."""
    storage.write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


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
    said = read_json(folder / INDEX)
    found = said.get("recordings") if isinstance(said, dict) else None
    if not isinstance(found, dict) or not all(
        isinstance(one, dict) and set(one) == {"recording_sha256", "key_sha256"} for one in found.values()
    ):
        raise InputError(folder / INDEX, "no index of a set", "hashes of recordings and keys, by number")
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


def closed(folder: Path) -> AbstractContextManager[None]:
    """While it lasts, no process of this program can open a file under the set's seals (`off_limits`)."""
    return off_limits(folder / SEALS)
