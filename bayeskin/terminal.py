"""How the command line speaks: progress and logs on stderr, one line of complaint, exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from bayeskin.errors import InputError

DONE, NOT_TRUSTED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class Terminal:
    """Tells a person on stderr how a run goes on; bars only where somebody can see them move."""

    def __init__(self) -> None:
        self.console = Console(stderr=True, highlight=False)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self.bars = Progress(
            *columns, console=self.console, transient=True, disable=not self.console.is_terminal
        )
        self.tasks: dict[str, Any] = {}

    def __enter__(self) -> Terminal:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def log(self, message: str) -> None:
        self.console.print(message, markup=False, soft_wrap=True)

    def progress(self, label: str, share: float, note: str = "") -> None:
        if label not in self.tasks:
            self.tasks[label] = self.bars.add_task(label, total=1.0, note=note)
        self.bars.update(self.tasks[label], completed=share, note=note, visible=share < 1.0)


def exit_code(call: Callable[[], Any]) -> int:
    """Calls, and says what it came to; what went wrong is told in one line on stderr."""
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
        return complain("interrupted; the same command goes on from here", INTERRUPTED)
    except BrokenPipeError:  # the reader of our stdout left, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        return complain(f"{error.filename}: {error.strerror}" if error.filename else str(error), WRONG_INPUT)


def complain(message: str, code: int) -> int:
    click.echo(f"bayeskin: {' '.join(message.split())}", err=True)
    return code
