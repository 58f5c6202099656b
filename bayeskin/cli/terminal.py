"""The output of the command line: progress and messages on stderr, errors in one line, and exit codes."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from bayeskin.errors import InputError, reason_of

DONE, NOT_TRUSTED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class _TimeLeft(ProgressColumn):
    """The time until the end, at the average pace so far; the column is empty until there is a pace."""

    def render(self, task: Task) -> Text:
        """Returns the time left of a task as text."""
        gained, told_s = task.completed - task.fields["first"], task.fields["told_s"]
        if gained <= 0 or task.elapsed is None:
            return Text()
        left_s = told_s * (1.0 - task.completed) / gained - (task.elapsed - told_s)
        return Text(f"{timedelta(seconds=max(round(left_s), 0))} left")


class Terminal:
    """Shows on stderr how a run progresses, with moving bars where stderr is an interactive terminal."""

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.console = console or Console(stderr=True, highlight=False)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(16),
            TimeElapsedColumn(),
            _TimeLeft(),
            TextColumn("{task.fields[note]}"),
        )
        self.bars = Progress(
            *columns, console=self.console, transient=True, disable=not self.console.is_terminal,
            get_time=clock,
        )  # fmt: skip
        self.tasks: dict[str, Task] = {}

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
        task = self.tasks.get(label)
        if task is None or share < task.completed:
            if task is not None:
                self.bars.remove_task(task.id)
            task_id = self.bars.add_task(label, total=1.0, first=share, told_s=0.0, note=note)
            task = self.tasks[label] = next(
                candidate for candidate in self.bars.tasks if candidate.id == task_id
            )
        told_s = task.elapsed or 0.0
        self.bars.update(task.id, completed=share, told_s=told_s, note=note, visible=share < 1.0)


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
