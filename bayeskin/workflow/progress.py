"""The progress of tasks with the time that is left, and a file in which another process can read it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bayeskin.json_files import write_json

VARIABLE = "BAYESKIN_PROGRESS"  # names the file into which a command writes its progress
REST_S = 0.5  # the file is written at most this often, except when a task begins or ends


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


class ProgressFile:
    """Writes the progress of all tasks into a file, which is replaced as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._written_s = -REST_S

    def write(self, tasks: Iterable[TaskProgress], at_once: bool) -> None:
        """Writes the progress, unless it was written a moment ago. A file that cannot be written is left."""
        now_s = time.monotonic()
        if at_once or now_s - self._written_s >= REST_S:
            self._written_s = now_s
            with suppress(OSError):
                write_json(self.path, [asdict(task) for task in tasks])


def read_progress(path: Path) -> list[TaskProgress]:
    """Returns the progress of all tasks that a command has written into a file, and [] if there is none."""
    try:
        return [TaskProgress(**task) for task in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return []
