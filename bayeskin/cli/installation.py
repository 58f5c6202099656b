"""The command that checks an installation: `doctor`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered


@click.command(short_help="Check that this installation works.")
@answered
def doctor() -> Mapping[str, Any]:
    """Check that this installation works in the current folder.

    The command checks the packages and their versions, the linear solver, the threads, the disk space and the
    write access. Then it compares a short run of the full model and a prediction of a surrogate with stored
    numbers. This takes about five seconds; the first time after the installation it takes half a minute,
    because parts are compiled. The exit code is 1 if something is broken.

    \b
    Example:
      bayeskin doctor
      bayeskin doctor --json
    """
    from bayeskin.workflow.doctor import examine

    return examine(Path.cwd())
