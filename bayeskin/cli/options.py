"""The arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path

import click

PATH = click.Path(path_type=Path)

config_argument = click.argument("config", type=PATH)
device_option = click.option("--device", type=PATH, help="TOML file with [device] and [tissue].")
scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Dask scheduler that runs the full model, in the form tcp://HOST:PORT.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout.")
