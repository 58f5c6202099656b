"""The output of the command line: progress and messages on stderr, errors in one line, and exit codes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from bayeskin.errors import InputError
from bayeskin.workflow.progress import VARIABLE, ProgressFile, TaskProgress, begun

DONE, NOT_TRUSTED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class _TimeLeft(ProgressColumn):
    """The time until the end, at the average pace so far; the column is empty until there is a pace."""

    def render(self, task: Task) -> Text:
        """Returns the time left of a task as text."""
        left_s = task.fields["progress"].left_s(task.get_time())
        return Text() if left_s is None else Text(f"{timedelta(seconds=round(left_s))} left")


class Terminal:
    """Shows on stderr how a run progresses, with moving bars where stderr is an interactive terminal.

    If the environment variable `BAYESKIN_PROGRESS` names a file, the progress is also written into it.
    """

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(16),
            TimeElapsedColumn(),
            _TimeLeft(),
            TextColumn("{task.fields[progress].note}"),
        )
        self.bars = Progress(
            *columns, console=self.console, transient=True, disable=not self.console.is_terminal,
            get_time=clock,
        )  # fmt: skip
        self.clock = clock
        self.tasks: dict[str, TaskProgress] = {}
        self._shown: dict[str, TaskID] = {}
        named = os.environ.get(VARIABLE)
        self._file = ProgressFile(Path(named)) if named else None

    def __enter__(self) -> Terminal:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def log(self, message: str) -> None:
        """Prints a message."""
        self.console.print(message, markup=False, soft_wrap=True)

    def progress(self, label: str, share: float, note: str = "") -> None:
        """Shows the share of a task that is done; a share that falls starts a new bar for the same task."""
        before, now_s = self.tasks.get(label), self.clock()
        task = begun(label, share, note, now_s) if before is None else before.later(share, note, now_s)
        self.tasks[label] = task
        if before is None or task.began_s != before.began_s:
            if label in self._shown:
                self.bars.remove_task(self._shown[label])
            self._shown[label] = self.bars.add_task(label, total=1.0, progress=task)
        self.bars.update(self._shown[label], completed=share, progress=task, visible=share < 1.0)
        if self._file is not None:
            self._file.write(self.tasks.values(), at_once=before is None or share >= 1.0)


def exit_code(call: Callable[[], Any]) -> int:
    """Calls a function and returns the exit code; an error is printed in one line on stderr."""
    try:
        return int(call() or DONE)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return WRONG_INPUT
    except click.ClickException as error:
        return complain(error.format_message(), WRONG_INPUT)
    except InputError as error:
        return complain(str(error), WRONG_INPUT)
    except (KeyboardInterrupt, click.Abort):
        return complain("interrupted; run the same command again to continue", INTERRUPTED)
    except OSError as error:
        return complain(f"{error.filename}: {error.strerror}" if error.filename else str(error), WRONG_INPUT)


def complain(message: str, code: int) -> int:
    """Prints an error message in one line on stderr, and returns `code`."""
    click.echo(f"bayeskin: {' '.join(message.split())}", err=True)
    return code
