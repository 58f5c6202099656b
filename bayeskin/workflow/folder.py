"""The folder of a run: one process at a time, and for each stage what it was made from.

A stage's record, ``<stage>/stage.json``, holds the hash of its inputs, the hashes of its outputs, its
seconds and its summary. A stage whose record is complete, whose inputs hash the same and whose outputs are
still as written is not run again.
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
        found = Record(**json.loads((stage_folder / RECORD).read_text()))
    except (OSError, ValueError, TypeError):
        return None
    plain_ones = isinstance(found.inputs_sha256, str) and isinstance(found.done, bool)
    mappings = all(isinstance(one, dict) for one in (found.outputs, found.summary, found.provenance))
    return found if plain_ones and mappings and isinstance(found.seconds, int | float) else None


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

    What an attempt on other inputs left is removed: nothing of it may be mistaken for this one's. Raises
    InputError for a folder that is no stage's: what others have put there stays.
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
    """As a whole, by another name first: what a kill in between leaves has no stage's name."""
    removed = stage_folder.with_name(f".{stage_folder.name}.removed")
    shutil.rmtree(removed, ignore_errors=True)
    if stage_folder.is_dir():
        stage_folder.rename(removed)
        shutil.rmtree(removed, ignore_errors=True)


def _refuse_foreign(stage_folder: Path) -> None:
    """A stage's folder has a record, or nothing yet but what an attempt that was killed has left hidden."""
    if stage_folder.is_symlink():
        raise InputError(stage_folder, "a link to another place", "a folder of the run's own")
    if stage_folder.is_dir() and not (stage_folder / RECORD).is_file():
        others = sorted(p.name for p in stage_folder.iterdir() if not p.name.startswith("."))
        if others:
            expected = "a folder that a run may fill and empty: move it, or give the run another name"
            raise InputError(stage_folder, f"other files, among them {others[0]}", expected)


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
