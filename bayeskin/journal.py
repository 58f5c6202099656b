"""Finished runs on their way into a design file: one line each, on disk before the next, and a lock.

A line is ``<crc32 of the text, hex> <its length> <JSON text>``. A process killed while it writes leaves
at most one line that is not whole; such a line is passed over, and its point is run again. JSON
keeps every float64 exactly (shortest decimal that reads back the same).
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array


class Run(NamedTuple):
    """One finished run: theta (d,), bin means [N] (m,) or NaN where it failed, why, and its duration."""

    theta: Array
    force_n: Array
    ok: bool
    message: str
    seconds: float


class Journal:
    """Append-only file of `Run`, held by one process at a time. A context manager.

    `runs` maps the bytes of theta to the run. `identity` stands in each line: results of another
    model, box or bins are refused. The file is gone when nothing is left in it.
    Raises InputError when another process holds it, or when it belongs to another design.
    """

    def __init__(self, path: Path, identity: str, bins: int) -> None:
        self.path, self.identity, self.bins = path, identity, bins
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = _open_locked(path)
        try:
            self.runs = self._read()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        if not os.fstat(self._file.fileno()).st_size:
            self.path.unlink(missing_ok=True)
        self._file.close()

    def append(self, run: Run) -> None:
        """Adds one run; it is on disk on return."""
        self._file.write(_line(run, self.identity))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.runs[run.theta.tobytes()] = run

    def forget(self, keys: set[bytes]) -> None:
        """Drops runs that are safe elsewhere, all at once; the last use of an open journal."""
        self.runs = {key: run for key, run in self.runs.items() if key not in keys}
        if not self.runs:
            self._file.truncate(0)
            return
        rest = self.path.with_name(f".{self.path.name}.partial")
        with open(rest, "wb") as out:
            out.writelines(_line(run, self.identity) for run in self.runs.values())
            out.flush()
            os.fsync(out.fileno())
        os.replace(rest, self.path)

    def _read(self) -> dict[bytes, Run]:
        self._file.seek(0)
        text = self._file.read()
        if text and not text.endswith(b"\n"):
            self._file.write(b"\n")  # closes a torn line, so that the next one starts afresh
        runs = {}
        for number, line in enumerate(text.splitlines(), start=1):
            whole = _whole(line)
            if whole is None:
                continue
            try:
                design, run = self._run(json.loads(whole))
            except (KeyError, TypeError, ValueError, RecursionError):
                expected = "one that bayeskin wrote; without the file all runs are made anew"
                raise InputError(f"{self.path}, line {number}", "what is no run", expected) from None
            if design != self.identity:
                raise InputError(
                    self.path,
                    "unfinished runs of another model, parameter space or time bins",
                    "runs of this design; finish or remove those first",
                )
            runs[run.theta.tobytes()] = run
        return runs

    def _run(self, plain: Mapping[str, Any]) -> tuple[Any, Run]:
        """What a line is of, and its run."""
        force_n = [np.nan] * self.bins if plain["force_n"] is None else plain["force_n"]
        return plain["design"], Run(
            np.array(plain["theta"], dtype=float), np.array(force_n, dtype=float), plain["ok"],
            plain["message"], plain["seconds"],
        )  # fmt: skip


def _line(run: Run, identity: str) -> bytes:
    plain = {
        "design": identity,
        "theta": run.theta.tolist(),
        "force_n": run.force_n.tolist() if run.ok else None,
        "ok": run.ok,
        "message": run.message,
        "seconds": run.seconds,
    }
    text = json.dumps(plain).encode()
    return b"%08x %d %s\n" % (zlib.crc32(text), len(text), text)


def _whole(line: bytes) -> bytes | None:
    """The content of a whole line, None for a torn or damaged one."""
    head, _, rest = line.partition(b" ")
    length, _, text = rest.partition(b" ")
    if length != b"%d" % len(text) or head != b"%08x" % zlib.crc32(text):
        return None
    return text


def _open_locked(path: Path) -> IO[bytes]:
    """Opens for appending under an exclusive lock, which the system drops when the process dies."""
    while True:
        handle = open(path, "a+b")  # noqa: SIM115 - the journal closes it
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            handle.close()
            raise InputError(
                path, "a design that another process is running", "one process at a time"
            ) from None
        # The former holder may have removed or replaced the file between our open and our lock.
        if path.exists() and os.path.samestat(os.fstat(handle.fileno()), os.stat(path)):
            return handle
        handle.close()
