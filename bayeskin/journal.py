"""Stores finished runs on disk, one line each, until they are part of a design file.

A line is ``<crc32 of the text, hex> <its length> <JSON text>``. It is on disk before the next run is stored.
A process that is killed while it writes leaves at most one incomplete line. Such a line is skipped, and its
point is run again. JSON stores every float64 exactly, as the shortest decimal number that reads back the
same. A lock keeps other processes out.
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
    """One finished run.

    theta : the parameters (d,)
    force_n : the bin means [N] (m,), or NaN where the run failed
    ok : whether the run succeeded
    message : why it failed
    seconds : its duration
    """

    theta: Array
    force_n: Array
    ok: bool
    message: str
    seconds: float


class Journal:
    """An append-only file of `Run` that one process at a time may hold. It is a context manager.

    `runs` maps the bytes of theta to the run. Each line contains `identity`, so that results of another
    model, box or bins are refused. The file is removed when it holds no run any more. Raises InputError when
    another process holds the file, or when the file belongs to another design.
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
        """Adds one run, which is safely on disk when the method returns."""
        self._file.write(_line(run, self.identity))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.runs[run.theta.tobytes()] = run

    def forget(self, keys: set[bytes]) -> None:
        """Removes runs that are stored elsewhere, all at once. It must be the last use of an open journal."""
        self.runs = {key: run for key, run in self.runs.items() if key not in keys}
        if not self.runs:
            self._file.truncate(0)
            return
        partial = self.path.with_name(f".{self.path.name}.partial")
        with open(partial, "wb") as out:
            out.writelines(_line(run, self.identity) for run in self.runs.values())
            out.flush()
            os.fsync(out.fileno())
        os.replace(partial, self.path)

    def _read(self) -> dict[bytes, Run]:
        """Returns the runs of the file by the bytes of theta, and completes an incomplete last line."""
        self._file.seek(0)
        text = self._file.read()
        if text and not text.endswith(b"\n"):
            self._file.write(b"\n")  # ends an incomplete line, so that the next run starts a new line
        runs = {}
        for number, line in enumerate(text.splitlines(), start=1):
            content = _text_of_whole_line(line)
            if content is None:
                continue
            try:
                design, run = self._run(json.loads(content))
            except (KeyError, TypeError, ValueError, RecursionError):
                expected = "a run that bayeskin wrote (without this file, all runs are repeated)"
                raise InputError(
                    f"{self.path}, line {number}", "a line that is not a run", expected
                ) from None
            if design != self.identity:
                raise InputError(
                    self.path,
                    "unfinished runs of another model, parameter space or time bins",
                    "runs of this design (finish or remove the other runs first)",
                )
            runs[run.theta.tobytes()] = run
        return runs

    def _run(self, plain: Mapping[str, Any]) -> tuple[Any, Run]:
        """Returns the identity of the design that a line belongs to, and its run."""
        force_n = [np.nan] * self.bins if plain["force_n"] is None else plain["force_n"]
        return plain["design"], Run(
            np.array(plain["theta"], dtype=float), np.array(force_n, dtype=float), plain["ok"],
            plain["message"], plain["seconds"],
        )  # fmt: skip


def _line(run: Run, identity: str) -> bytes:
    """Returns a run as a line of the file."""
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


def _text_of_whole_line(line: bytes) -> bytes | None:
    """Returns the JSON text of a complete line, and None for an incomplete or damaged line."""
    head, _, rest = line.partition(b" ")
    length, _, text = rest.partition(b" ")
    if length != b"%d" % len(text) or head != b"%08x" % zlib.crc32(text):
        return None
    return text


def _open_locked(path: Path) -> IO[bytes]:
    """Opens a file for appending under an exclusive lock, which the system releases when the process ends."""
    while True:
        handle = open(path, "a+b")  # noqa: SIM115 - the journal closes it
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            handle.close()
            raise InputError(
                path, "a design that another process is running", "one process at a time"
            ) from None
        # Another process may have removed or replaced the file after it was opened and before it was locked.
        if path.exists() and os.path.samestat(os.fstat(handle.fileno()), os.stat(path)):
            return handle
        handle.close()
