"""The command that checks an installation: `doctor`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.terminal import Terminal
from bayeskin.errors import InputError


@click.command(short_help="Check that this installation works.")
@answered
def doctor() -> Mapping[str, Any]:
    """Check that this installation works in the current folder.

    The command checks the packages and their versions, the linear solver, the threads, the disk space and the
    write access. Then it compares short runs of the full and the reduced model, a surrogate and a posterior
    with stored numbers. This takes about five seconds; the first time after the installation it takes 40
    seconds on two cores, because it compiles the models. The exit code is 1 if something is broken.

    \b
    Example:
      bayeskin doctor
      bayeskin doctor --json
    """
    from bayeskin.workflow.doctor import examine

    try:
        folder = Path.cwd()
    except FileNotFoundError:
        raise InputError("current folder", "it does not exist any more", "change to another: cd ~") from None
    with Terminal() as terminal:
        return examine(folder, terminal)
