"""The commands that take a recording of the user's own: `import` and `new`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.options import PATH, device_option
from bayeskin.cli.terminal import Terminal
from bayeskin.errors import InputError


@click.command("import", short_help="Read a recording (a table or a workbook), write it as HDF5.")
@click.argument("file", type=PATH)
@click.option("-o", "out", required=True, type=PATH, help="HDF5 file to write.")
@click.option("--sheet", metavar="NAME", help="One of several tables, or 'all' for one recording each.")
@click.option("--time", metavar="COLUMN", help="Name or number of the column of time.")
@click.option("--displacement", metavar="COLUMN", help="Name or number of the column of displacement.")
@click.option("--force", metavar="COLUMN", help="Name or number of the column of force.")
@click.option(
    "--unit", "units", multiple=True, metavar="QUANTITY=UNIT", help="A unit, such as force=mN; repeatable."
)
@click.option("--zero/--no-zero", default=None, help="Subtract the first displacement, or keep it.")
@answered
def import_(**options: Any) -> Mapping[str, Any]:
    """Read a recording and write it in SI units as HDF5.

    FILE is a table (csv, tsv, txt, dat, asc, tra, lvm, npy) or a workbook (xlsx, xls) of any test machine.
    The command finds the table, its columns and their units, and reports on stderr what it took for what. It
    also reports the phases, the noise, the spikes and the steps that it detects. If something is not clear,
    it writes nothing and names the option that decides. A minus before a unit turns the sign, as
    --unit force=-N where a pull counts negative.

    \b
    Example:
      bayeskin import Healthy_skin.xlsx -o runs/healthy-skin.h5
      bayeskin import series.xlsx --sheet "Test 3" -o runs/test-3.h5
      bayeskin import series.xlsx --sheet all -o runs/series.h5
      bayeskin import arm.csv --displacement Position --unit force=gf --zero -o runs/arm.h5
    """
    from bayeskin.workflow.importing import import_recording

    with Terminal() as terminal:
        return import_recording(terminal, **options)


@click.command(short_help="Write a configuration for a recording of your own.")
@click.argument("recordings", nargs=-1, type=PATH)
@click.option("-o", "out", type=PATH, help="TOML file to write; default: beside the first recording.")
@device_option
@answered
def new(recordings: tuple[Path, ...], out: Path | None, device: Path | None) -> Mapping[str, Any]:
    """Write a commented configuration for recordings of your own; without any, write the demo's.

    The command reads the recordings and reports what they contain. Several recordings must be of one skin.
    The configuration of a single one uses a shipped surrogate if one was trained on the recording's protocol,
    and a design of model runs otherwise. Existing files are never overwritten. The demo's recording is
    written beside its configuration. With --device, the sections [device] and [tissue] of that file are
    written into the configuration; without it, the article's device and tissue are used.

    \b
    Example:
      bayeskin new && bayeskin run demo.toml
      bayeskin new test.xlsx -o runs/test.toml --device device.toml
      bayeskin new runs/test.h5 && bayeskin run runs/test.toml
      bayeskin new first.h5 second.h5 -o both.toml
    """
    from bayeskin.workflow.new import new_config, new_demo

    if recordings:
        return new_config(recordings, out, device)
    if device is not None:
        raise InputError(
            f"--device {device}",
            "no recording is given",
            "give one, because the demo uses the article's device, or leave out --device",
        )
    return new_demo(out)
