"""Starts, watches and stops jobs. A job runs ordinary commands of bayeskin in a recording's folder.

A job is a process of its own, and its state lies in files. So it goes on when its page is closed, and even
when the program of the page ends. While it runs, it holds a lock, which the system releases with the process.
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TextIO

from bayeskin.errors import InputError
from bayeskin.json_files import write_json
from bayeskin.workflow.progress import VARIABLE, TaskProgress, read_progress

LOCK, REQUEST, END, OUTPUT, PROGRESS = "lock", "job.json", "end.json", "output.txt", "progress.json"
LAST_LINES = 200
_MOST_BYTES_SHOWN = 64_000
_TRIES, _BETWEEN_S = 5, 0.02


class State(StrEnum):
    """The state of a job, by the exit code of its last command."""

    RUNNING = "running"
    DONE = "done"
    NOT_TRUSTED = "not trusted"
    REFUSED = "refused"
    STOPPED = "stopped"
    FAILED = "failed"


INTERRUPTED = 130
_STATES = {0: State.DONE, 1: State.NOT_TRUSTED, 2: State.REFUSED, INTERRUPTED: State.STOPPED}


@dataclass(frozen=True)
class Job:
    """A job as its files describe it; times are in seconds since 1970.

    question : the key of the question that it answers
    ended_s : the time of its end, or None while it runs, or where its process was killed
    """

    folder: Path
    question: str
    state: State
    started_s: float
    ended_s: float | None

    @property
    def running(self) -> bool:
        """Returns whether the job runs."""
        return self.state is State.RUNNING

    @property
    def seconds(self) -> float:
        """Returns how long the job has taken so far."""
        end_s = time.time() if self.running else self.ended_s
        if end_s is None:
            end_s = (self.folder / OUTPUT).stat().st_mtime
        return max(end_s - self.started_s, 0.0)

    @property
    def lines(self) -> list[str]:
        """Returns the last lines of the commands' output."""
        with open(self.folder / OUTPUT, "rb") as handle:
            handle.seek(max(os.fstat(handle.fileno()).st_size - _MOST_BYTES_SHOWN, 0))
            text = handle.read().decode("utf-8", "replace")
        return text.splitlines()[-LAST_LINES:]

    @property
    def tasks(self) -> list[TaskProgress]:
        """Returns the progress of the tasks that are not finished."""
        return [task for task in read_progress(self.folder / PROGRESS) if task.share < 1.0]


def start(folder: Path, question: str, commands: Sequence[Sequence[str]]) -> None:
    """Starts commands of bayeskin one after the other, in the folder above the job's folder.

    The next command starts if the one before it has ended with exit code 0. Raises InputError if a job of
    this folder runs already.
    """
    folder.mkdir(exist_ok=True)
    with open(folder / LOCK, "a+") as lock:
        if not _locked(lock):
            raise InputError(folder.parent.name, "a job runs already", "stop it first, or wait for its end")
        for name in (END, PROGRESS):
            (folder / name).unlink(missing_ok=True)
        with open(folder / OUTPUT, "wb") as output:
            request = {"question": question, "commands": commands, "started_s": time.time()}
            write_json(folder / REQUEST, request)
            process = subprocess.Popen(
                [sys.executable, "-m", "bayeskin.app.supervisor", str(folder), str(lock.fileno())],
                cwd=folder.parent, start_new_session=True, pass_fds=(lock.fileno(),),
                stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                env={**os.environ, VARIABLE: str(folder / PROGRESS), "PYTHONUNBUFFERED": "1"},
            )  # fmt: skip
        lock.seek(0)
        lock.truncate()
        lock.write(str(process.pid))
    threading.Thread(target=process.wait, daemon=True).start()  # the system forgets the process when it ends


def _locked(lock: TextIO) -> bool:
    """Returns whether the lock of a job could be taken. Whoever only looks at it holds it for an instant."""
    for _ in range(_TRIES):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except OSError:
            time.sleep(_BETWEEN_S)
    return False


def job_of(folder: Path) -> Job | None:
    """Returns the job of a folder, or None where no job was ever started."""
    running = _holder(folder) is not None
    try:
        request = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
        question, started_s = str(request["question"]), float(request["started_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if running:
        return Job(folder, question, State.RUNNING, started_s, None)
    try:
        end = json.loads((folder / END).read_text(encoding="utf-8"))
        return Job(folder, question, _STATES.get(end["code"], State.FAILED), started_s, float(end["ended_s"]))
    except (OSError, ValueError, KeyError, TypeError):
        return Job(folder, question, State.FAILED, started_s, None)


def stop(folder: Path) -> None:
    """Stops a job as Ctrl-C does: the commands keep what is finished, and can go on later."""
    holder = _holder(folder)
    if holder:
        with suppress(ProcessLookupError):
            os.killpg(holder, signal.SIGINT)


def _holder(folder: Path) -> int | None:
    """Returns the process of the job that runs, 0 if it has just been started, and None if none runs."""
    try:
        with open(folder / LOCK) as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except OSError:
                return int(lock.read() or 0)
    except (FileNotFoundError, ValueError):
        pass
    return None
