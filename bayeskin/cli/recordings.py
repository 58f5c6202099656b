"""The commands that take a recording of the user's own: `import` and `new`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.options import PATH, device_option
from bayeskin.errors import InputError


@click.command("import", short_help="Read a recording (xlsx, csv, tsv, h5), write it as HDF5.")
@click.argument("file", type=PATH)
@click.option("-o", "out", required=True, type=PATH, help="HDF5 file to write.")
@click.option("--sheet", help="Sheet of a workbook, if several sheets have the columns.")
@answered
def import_(file: Path, out: Path, sheet: str | None) -> Mapping[str, Any]:
    """Read a recording (xlsx, csv, tsv, h5) and write it in SI units as HDF5.

    The command finds the columns and their units, and reports how it interpreted them. It also reports the
    phases, the noise, the spikes and the steps that it detects.

    \b
    Example:
      bayeskin import Healthy_skin.xlsx -o runs/healthy-skin.h5
      bayeskin import series.xlsx --sheet "Test 3" -o runs/test-3.h5
    """
    from bayeskin.workflow.importing import import_recording

    return import_recording(file, out, sheet)


@click.command(short_help="Write a configuration for a recording of your own.")
@click.argument("recording", required=False, type=PATH)
@click.option("-o", "out", type=PATH, help="TOML file to write; default: beside RECORDING.")
@device_option
@answered
def new(recording: Path | None, out: Path | None, device: Path | None) -> Mapping[str, Any]:
    """Write a commented configuration for your own recording; without RECORDING, write the demo's.

    The command reads the recording and reports what it contains. The configuration uses a shipped surrogate
    if one was trained on the recording's protocol, and a design of model runs otherwise. Existing files are
    never overwritten. The demo's recording is written beside its configuration. With --device, the sections
    [device] and [tissue] of that file are written into the configuration; without it, the article's device
    and tissue are used.

    \b
    Example:
      bayeskin new && bayeskin run demo.toml
      bayeskin new test.xlsx -o runs/test.toml --device device.toml
      bayeskin new runs/test.h5 && bayeskin run runs/test.toml
    """
    from bayeskin.workflow.new import new_config, new_demo

    if recording is not None:
        return new_config(recording, out, device)
    if device is not None:
        raise InputError(
            f"--device {device}", "no RECORDING", "a RECORDING, because the demo uses the article's device"
        )
    return new_demo(out)
