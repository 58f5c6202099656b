"""The output of the command line: progress and messages on stderr, errors in one line, and exit codes."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from bayeskin.errors import InputError, reason_of

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
        from bayeskin.workflow.progress import tasks_for_file

        self._clock, self._tasks = clock, tasks_for_file()
        self._shown: dict[str, TaskID] = {}

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
        task = self._tasks.report(label, share, note, self._clock())
        if task.began_s == task.told_s:
            if label in self._shown:
                self.bars.remove_task(self._shown[label])
            self._shown[label] = self.bars.add_task(label, total=1.0, progress=task)
        self.bars.update(self._shown[label], completed=share, progress=task, visible=share < 1.0)


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
        where = f"{error.filename}: " if error.filename else ""
        return complain(f"{where}{reason_of(error)}", WRONG_INPUT)


def complain(message: str, code: int) -> int:
    """Prints an error message in one line on stderr, and returns `code`."""
    click.echo(f"bayeskin: {' '.join(message.split())}", err=True)
    return code
