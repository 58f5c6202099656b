"""The commands that run stages: `run`, `report`, the single stages, and `study` for many recordings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.options import PATH, config_argument, scheduler_option
from bayeskin.cli.terminal import Terminal


@click.command(short_help="Run all stages of a configuration that are not done yet.")
@config_argument
@scheduler_option
@answered
def run(config: Path, scheduler: str | None) -> Mapping[str, Any]:
    """Run all stages of a configuration in order; skip those that are done and unchanged.

    Outputs are written to a folder beside CONFIG that has the configuration's name. Read report.html in this
    folder for the result. If the command is interrupted, the same command continues the run.

    \b
    Example:
      bayeskin run runs/demo.toml
      bayeskin run runs/test.toml --scheduler tcp://10.0.0.5:8786
    """
    return _run(config, None, scheduler)


@click.command()
@config_argument
@answered
def report(config: Path) -> Mapping[str, Any]:
    """Write one HTML page about a run, from the stages that are done.

    The command runs no stage, and lists the stages that are missing. The page is report.html in the run's
    folder. It needs no network and no other file, so it can be sent as a single file.

    \b
    Example:
      bayeskin report runs/demo.toml
      bayeskin report runs/demo.toml --json > answer.json
    """
    from bayeskin.workflow import stages

    with Terminal() as terminal:
        return stages.report(config, terminal)


@click.command(short_help="Write a run's posterior for other programs: CSV, JSON, FEBio.")
@config_argument
@click.option("-o", "out", required=True, type=PATH, help="File to write: .csv, .json or .feb.")
@answered
def export(config: Path, out: Path) -> Mapping[str, Any]:
    """Write the posterior of a run to a file for other programs, in SI units.

    A .csv file has one row for each draw and one column for each parameter. A .json file has a normal
    distribution that is fitted to the draws (of the logarithms, where the prior is one of the logarithm), the
    medians, and the constants that the model fixes; it suits codes such as FEniCSx. A .feb file has the
    materials of both layers for FEBio, at the medians.

    The command runs no stage. Its exit code is 1 if the posterior is not to be trusted; the file then says so
    too, unless it is a table.

    \b
    Example:
      bayeskin export runs/demo.toml -o draws.csv
      bayeskin export runs/demo.toml -o skin.feb
    """
    from bayeskin.workflow.exporting import export as export_posterior

    with Terminal() as terminal:
        return export_posterior(config, out, terminal)


@click.command(short_help="Infer all recordings of a study, and their population.")
@click.argument("file", type=PATH)
@scheduler_option
@answered
def study(file: Path, scheduler: str | None) -> Mapping[str, Any]:
    """Infer all recordings of a study, and compare groups of skins.

    FILE states a table with one row for each recording, and settings that all recordings share. Each
    recording is inferred as by `bayeskin run`. A hierarchical model then gives the medians of the groups,
    their ratios, the variation between and within subjects, and what the whole study says about each
    recording. A recording that fails is left out, and the answer says so.

    Outputs are written to a folder beside FILE that has the study's name. Read report.html in this folder
    for the result. If the command is interrupted, the same command continues the study. With --scheduler,
    recordings are inferred on a Dask cluster, whose workers need access to the files under the same paths.

    \b
    Example:
      bayeskin study runs/keloid.toml
      bayeskin study runs/keloid.toml --scheduler tcp://10.0.0.5:8786
    """
    from bayeskin.workflow import study

    with Terminal() as terminal:
        return study.study(file, terminal, scheduler)


def _stage_command(name: str, text: str) -> click.Command:
    """Returns the command that runs a single stage; `text` appears in its help."""
    example = f"\b\nExample:\n  bayeskin {name} runs/demo.toml\n  bayeskin {name} runs/demo.toml --json"

    @click.command(name, help=f"{text}\n\nEarlier stages that it needs run first.\n\n{example}")
    @config_argument
    @scheduler_option
    @answered
    def command(config: Path, scheduler: str | None) -> Mapping[str, Any]:
        return _run(config, name, scheduler)

    return command


STAGES = (
    _stage_command("design", "Run the full model at the design's points, wave by wave."),
    _stage_command("train", "Train the surrogate and validate it on held-out points."),
    _stage_command("map", "Find the most probable point and check it with the full model."),
    _stage_command("sample", "Sample the posterior and check it with the full model."),
    _stage_command("sobol", "Compute Sobol' indices of the force over time."),
)


def _run(config: Path, last: str | None, scheduler: str | None) -> Mapping[str, Any]:
    """Runs a configuration up to the stage `last` (None: all stages) and returns the answer."""
    from bayeskin.workflow import stages

    with Terminal() as terminal:
        return stages.run(config, last, terminal, scheduler=scheduler)
