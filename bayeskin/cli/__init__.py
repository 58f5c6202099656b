"""The command line: each command parses its options, calls a function and prints the answer.

Exit code 0 means done, 1 that the answer failed or cannot be trusted, 2 that the input is wrong, and 130 that
the command was interrupted. The modules of this package import the rest of bayeskin inside the commands, so
that the command line starts quickly.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Sequence

try:
    import click

    importlib.import_module("rich")
except ModuleNotFoundError as _error:  # without these packages, not even `doctor` could say so
    _pip = f"{sys.executable} -m pip install {_error.name}"
    sys.exit(f"bayeskin: the package {_error.name} is not installed; run `{_pip}`")

import bayeskin
from bayeskin.cli.app import app
from bayeskin.cli.installation import doctor
from bayeskin.cli.mismatch import diagnose, experiment
from bayeskin.cli.models import reduce_, serve, simulate
from bayeskin.cli.recordings import import_, new
from bayeskin.cli.runs import STAGES, export, report, run, study
from bayeskin.cli.terminal import exit_code
from bayeskin.cli.validation import conceal, prove

# The matrices are small, so several threads of linear algebra would slow the program down. The linear algebra
# libraries read these variables when numpy is imported, so they are set before.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# All commands, in the order in which a user needs them.
SECTIONS: dict[str, tuple[click.Command, ...]] = {
    "From a recording to an answer": (doctor, new, import_, run, diagnose, report, study, app),
    "Single stages": (reduce_, *STAGES),
    "Further commands": (experiment, simulate, export, serve, prove, conceal),
}


class _CommandsInSections(click.Group):
    """A group of commands that lists them by `SECTIONS`."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Returns the names of all commands, in the order in which they were added."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the commands with their short help, section by section."""
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(str(command.name), command.get_short_help_str(formatter.width)) for command in commands]
                )


@click.group(
    cls=_CommandsInSections,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(bayeskin.__version__, prog_name="bayeskin")
def cli() -> None:
    """Infer the properties of living skin from an extensometer test, and say how certain they are.

    \b
    Start here:
      bayeskin doctor                          check the installation
      bayeskin new && bayeskin run demo.toml   fit the demo
      bayeskin diagnose demo.toml              name what is concealed in it
      bayeskin new test.xlsx -o test.toml      write your own configuration

    \b
    This line makes your shell complete commands and options (zsh: zsh_source):
      eval "$(_BAYESKIN_COMPLETE=bash_source bayeskin)"
    """


for _commands in SECTIONS.values():
    for _command in _commands:
        cli.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the `bayeskin` command with the given arguments (default: those of the process) and exits."""
    # Job schedulers end a job by SIGTERM, which is treated as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(exit_code(lambda: cli.main(arguments, prog_name="bayeskin", standalone_mode=False)))
