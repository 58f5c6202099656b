"""Reads and writes the files of a set: open recordings, sealed keys, and an index that reveals a changed key.

FOLDER/index.json           sha256 of each recording and of its key
FOLDER/recordings/001.h5    a recording; nothing in the file tells which effect it conceals
FOLDER/seals/001.json       its key; seals/set.json holds the seed
FOLDER/verdicts/001.json    the verdict of a diagnosis
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
from bayeskin.access_guard import guarded
from bayeskin.errors import InputError, reason_of

RECORDINGS, SEALS, VERDICTS = "recordings", "seals", "verdicts"
NEEDED = "bayeskin needs a file of a proof's set"
INDEX, SCORINGS, SET = "index.json", "scorings.json", "set.json"


def sha256(path: Path) -> str:
    """Returns the hash of a file's bytes, or an empty text if there is no such file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def write_json(path: Path, value: Any) -> None:
    """Writes a file completely or not at all. Raises InputError if it cannot be written."""
    storage.write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Returns the content of a JSON file. Raises InputError if the file is absent or is not JSON."""
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(path, f"it cannot be read ({reason_of(error)})", NEEDED) from None
    except ValueError:
        raise InputError(path, "it is not JSON", NEEDED) from None


def read_index(folder: Path) -> dict[str, dict[str, str]]:
    """Returns the sha256 of each recording and of its key, by number ("001").

    Raises InputError if there is no set.
    """
    index = read_json(folder / INDEX)
    hashes = index.get("recordings") if isinstance(index, dict) else None
    if not isinstance(hashes, dict) or not all(
        isinstance(pair, dict) and set(pair) == {"recording_sha256", "key_sha256"} for pair in hashes.values()
    ):
        raise InputError(
            folder / INDEX,
            "it is not the index of a set",
            "bayeskin needs the hashes of recordings and keys, by number",
        )
    return dict(sorted(hashes.items()))


def recording_path(folder: Path, number: str) -> Path:
    return folder / RECORDINGS / f"{number}.h5"


def read_keys(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Returns the keys by number. Raises InputError for a recording or a key that differs from the index."""
    keys = {}
    for number, hashes in read_index(folder).items():
        for path, expected in (
            (recording_path(folder, number), hashes["recording_sha256"]),
            (folder / SEALS / f"{number}.json", hashes["key_sha256"]),
        ):
            if sha256(path) != expected:
                raise InputError(
                    path,
                    "its contents differ from those of the index",
                    f"its sha256 must be {expected[:12]}...",
                )
        keys[number] = read_json(folder / SEALS / f"{number}.json")
    return keys


def closed(folder: Path) -> AbstractContextManager[None]:
    """Returns a context in which this program's processes cannot open the set's seals (`guarded`)."""
    return guarded(folder / SEALS)
