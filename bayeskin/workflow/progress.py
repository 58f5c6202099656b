"""The progress of tasks with the time that is left, and a file in which another process can read it."""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bayeskin.json_files import write_json

VARIABLE = "BAYESKIN_PROGRESS"  # names the file into which a command writes its progress
REST_S = 0.5  # between two writings of the file


@dataclass(frozen=True)
class TaskProgress:
    """The progress of one task.

    share : the share, from 0 to 1, that is done; first : the share that was done when the task began
    began_s, told_s : the times at which the task began and at which `share` was reported, on one clock
    """

    label: str
    share: float
    note: str
    first: float
    began_s: float
    told_s: float

    def left_s(self, now_s: float) -> float | None:
        """Returns the seconds until the end at the average pace so far; None where there is no pace yet."""
        gained = self.share - self.first
        if gained <= 0.0:
            return None
        whole_s = (self.told_s - self.began_s) * (1.0 - self.share) / gained
        return max(whole_s - (now_s - self.told_s), 0.0)

    def later(self, share: float, note: str, now_s: float) -> TaskProgress:
        """Returns the progress after a further report; a share that falls begins the task anew."""
        if share < self.share:
            return begun(self.label, share, note, now_s)
        return replace(self, share=share, note=note, told_s=now_s)


def begun(label: str, share: float, note: str, now_s: float) -> TaskProgress:
    """Returns the progress of a task at its first report."""
    return TaskProgress(label, share, note, share, now_s, now_s)


class Tasks:
    """The progress of all tasks of a command, which is also written into a file if there is one.

    The file is replaced as a whole, at most every half second, except when a task begins or ends.
    """

    def __init__(self, file: Path | None) -> None:
        self._file = file
        self._tasks: dict[str, TaskProgress] = {}
        self._written_s = -math.inf

    def report(self, label: str, share: float, note: str, now_s: float) -> TaskProgress:
        """Takes a report, and returns the progress of its task."""
        before = self._tasks.get(label)
        task = begun(label, share, note, now_s) if before is None else before.later(share, note, now_s)
        self._tasks[label] = task
        if before is None or share >= 1.0 or now_s - self._written_s >= REST_S:
            self._written_s = now_s
            self._write()
        return task

    def _write(self) -> None:
        """Writes the file. One that cannot be written is left out, because the work is more important."""
        if self._file is not None:
            with suppress(OSError):
                write_json(self._file, [asdict(task) for task in self._tasks.values()])


def tasks_for_file() -> Tasks:
    """Returns the tasks of a command, which are written into the file that the environment names."""
    named = os.environ.get(VARIABLE)
    return Tasks(Path(named) if named else None)


def read_progress(path: Path) -> list[TaskProgress]:
    """Returns the progress of all tasks that a command has written into a file, and [] if there is none."""
    try:
        return [TaskProgress(**task) for task in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return []
