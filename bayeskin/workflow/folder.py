"""The folder of a run: a lock for one process at a time, and for each stage a record of its inputs.

The record of a stage, ``<stage>/stage.json``, contains the hash of its inputs, the hashes of its outputs, its
duration in seconds and its summary. A stage is not run again if its record is complete, its inputs have the
same hash, and its outputs are unchanged.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bayeskin.errors import InputError
from bayeskin.hashing import sha256_of, sha256_of_file
from bayeskin.json_files import write_json

RECORD = "stage.json"


@dataclass(frozen=True)
class Record:
    """The record of one stage.

    `outputs` maps each file, relative to the stage's folder, to its sha256.
    """

    inputs_sha256: str
    done: bool
    seconds: float
    outputs: Mapping[str, str] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sha256(self) -> str:
        """Returns the hash of the stage's outputs, on which later stages depend."""
        return sha256_of(dict(self.outputs))


def read_record(stage_folder: Path) -> Record | None:
    """Returns the record of a stage; None where there is no record, or none that can be read."""
    try:
        record = Record(**json.loads((stage_folder / RECORD).read_text()))
    except (OSError, ValueError, TypeError):
        return None
    scalars = isinstance(record.inputs_sha256, str) and isinstance(record.done, bool)
    mappings = all(isinstance(value, dict) for value in (record.outputs, record.summary, record.provenance))
    return record if scalars and mappings and isinstance(record.seconds, int | float) else None


def write_record(stage_folder: Path, record: Record) -> None:
    """Writes the record of a stage."""
    write_json(stage_folder / RECORD, vars(record))


def current_record(stage_folder: Path, inputs_sha256: str) -> Record | None:
    """Returns the stage's record if it was completed from these inputs and its outputs are unchanged."""
    record = read_record(stage_folder)
    if record is None or not record.done or record.inputs_sha256 != inputs_sha256:
        return None
    intact = all(sha256_of_file(stage_folder / name) == value for name, value in record.outputs.items())
    return record if intact else None


def output_hashes(stage_folder: Path) -> dict[str, str]:
    """Returns the sha256 of each file that the stage wrote, without its record and hidden files."""
    files = sorted(p for p in stage_folder.rglob("*") if p.is_file())
    return {
        str(p.relative_to(stage_folder)): sha256_of_file(p)
        for p in files
        if p.name != RECORD and not p.name.startswith(".")
    }


def begin(stage_folder: Path, inputs_sha256: str) -> float:
    """Prepares the folder of a stage; returns the seconds that an interrupted attempt has already taken.

    The files of an attempt on other inputs are removed, so that none of them can be taken for a file of this
    attempt. Raises InputError for a folder that does not belong to a stage: files of other origin stay.
    """
    _refuse_foreign(stage_folder)
    record = read_record(stage_folder)
    if record is None or record.inputs_sha256 != inputs_sha256:
        _remove(stage_folder)
        record = None
    stage_folder.mkdir(parents=True, exist_ok=True)
    seconds = 0.0 if record is None or record.done else record.seconds
    write_record(stage_folder, Record(inputs_sha256, done=False, seconds=seconds))
    return seconds


def _remove(stage_folder: Path) -> None:
    """Removes the folder of a stage as a whole.

    The folder is renamed first. If the process is killed in between, the remaining files have no stage's
    name.
    """
    removed = stage_folder.with_name(f".{stage_folder.name}.removed")
    shutil.rmtree(removed, ignore_errors=True)
    if stage_folder.is_dir():
        stage_folder.rename(removed)
        shutil.rmtree(removed, ignore_errors=True)


def _refuse_foreign(stage_folder: Path) -> None:
    """Raises InputError unless a folder belongs to a stage.

    Such a folder has a record, or contains only hidden files that a killed attempt has left.
    """
    if stage_folder.is_symlink():
        raise InputError(
            stage_folder, "it is a link to another place", "it must be a folder that belongs to the run"
        )
    if stage_folder.is_dir() and not (stage_folder / RECORD).is_file():
        others = sorted(p.name for p in stage_folder.iterdir() if not p.name.startswith("."))
        if others:
            remedy = "move these files, or give the run another name"
            raise InputError(stage_folder, f"it contains other files, such as {others[0]}", remedy)


@contextlib.contextmanager
def locked(run_folder: Path) -> Iterator[None]:
    """Locks the run's folder while the context lasts.

    The system releases the lock even if the process is killed. Raises InputError when another process holds
    it.
    """
    run_folder.mkdir(parents=True, exist_ok=True)
    with open(run_folder / ".lock", "a+") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            holder = handle.read().strip() or "unknown"
            raise InputError(
                run_folder,
                f"another bayeskin (process {holder}) uses this folder",
                "wait until it has ended",
            ) from None
        handle.truncate(0)
        handle.write(str(os.getpid()))
        handle.flush()
        yield
