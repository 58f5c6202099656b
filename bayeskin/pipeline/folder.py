"""The folder of a run: one process at a time, and for each stage what it was made from.

A stage's record, ``<stage>/stage.json``, holds the hash of its inputs, the hashes of its outputs, its
seconds and its summary. A stage whose record is complete, whose inputs hash the same and whose outputs are
still as written is not run again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayeskin.errors import InputError

RECORD = "stage.json"


@dataclass(frozen=True)
class Record:
    """What is known of one stage: `outputs` maps each file, relative to the stage's folder, to its sha256."""

    inputs_sha256: str
    done: bool
    seconds: float
    outputs: Mapping[str, str] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sha256(self) -> str:
        """Hash of the stage's outputs, which the stages above it are made from."""
        return sha256_of(dict(self.outputs))


def read_record(stage_folder: Path) -> Record | None:
    """The stage's record; None when there is none, or none that can be read."""
    try:
        return Record(**json.loads((stage_folder / RECORD).read_text()))
    except (OSError, ValueError, TypeError):
        return None


def read_lines(file: Path) -> list[dict[str, Any]]:
    """JSON lines of a file, [] without one; a torn last line is cut off, so that more can follow."""
    if not file.is_file():
        return []
    text = file.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]


def write_record(stage_folder: Path, record: Record) -> None:
    write_json(stage_folder / RECORD, vars(record))


def current_record(stage_folder: Path, inputs_sha256: str) -> Record | None:
    """The stage's record if it was completed from these inputs and its outputs are as it left them."""
    record = read_record(stage_folder)
    if record is None or not record.done or record.inputs_sha256 != inputs_sha256:
        return None
    intact = all(sha256_of_file(stage_folder / name) == value for name, value in record.outputs.items())
    return record if intact else None


def output_hashes(stage_folder: Path) -> dict[str, str]:
    """sha256 of every file that the stage wrote, its record and hidden files left out."""
    files = sorted(p for p in stage_folder.rglob("*") if p.is_file())
    return {
        str(p.relative_to(stage_folder)): sha256_of_file(p)
        for p in files
        if p.name != RECORD and not p.name.startswith(".")
    }


def begin(stage_folder: Path, inputs_sha256: str) -> float:
    """Readies a stage's folder; returns the seconds that an interrupted attempt already spent.

    What an attempt on other inputs left is removed: nothing of it may be mistaken for this one's.
    """
    record = read_record(stage_folder)
    if record is None or record.inputs_sha256 != inputs_sha256:
        shutil.rmtree(stage_folder, ignore_errors=True)
        record = None
    stage_folder.mkdir(parents=True, exist_ok=True)
    seconds = 0.0 if record is None or record.done else record.seconds
    write_record(stage_folder, Record(inputs_sha256, done=False, seconds=seconds))
    return seconds


@contextlib.contextmanager
def locked(run_folder: Path) -> Iterator[None]:
    """Holds the run's folder; the system lets go of it even when the process is killed.

    Raises InputError when another process holds it.
    """
    run_folder.mkdir(parents=True, exist_ok=True)
    with open(run_folder / ".lock", "a+") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            holder = handle.read().strip() or "unknown"
            raise InputError(
                run_folder, f"in use by another bayeskin (process {holder})", "one process a run"
            ) from None
        handle.truncate(0)
        handle.write(str(os.getpid()))
        handle.flush()
        yield


def write_json(path: Path, value: Any) -> None:
    """Writes JSON whole or not at all; what is not a number in JSON (NaN, infinity) becomes null."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(json.dumps(plain(value), indent=2, allow_nan=False) + "\n")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """A value as JSON knows it: arrays become lists, numpy numbers become Python's, NaN becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def sha256_of(value: Any) -> str:
    """Hash of anything that `plain` makes JSON of."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Hash of a file's bytes; empty when it cannot be read."""
    try:
        with open(path, "rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError:
        return ""
