"""The commands that validate the diagnosis on recordings with concealed effects: `prove` and `conceal`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.options import PATH
from bayeskin.cli.terminal import Terminal


@click.command(short_help="Measure how good diagnoses of concealed effects are.")
@click.argument("folder", required=False, type=PATH)
@click.option(
    "--at-most", type=click.IntRange(min=0), metavar="N", help="Diagnose at most N more, then score."
)
@click.option("--rediagnose", default=0, type=click.IntRange(min=0), metavar="N", help="Repeat N diagnoses.")
@answered
def prove(folder: Path | None, at_most: int | None, rediagnose: int) -> Mapping[str, Any]:
    """Measure how good diagnoses are, on recordings with concealed effects whose keys are known.

    FOLDER is a set that `bayeskin conceal` made; the default is the shipped set. A recording that has a
    verdict is not diagnosed again, so the command can be interrupted. The keys are opened only after the
    verdicts are written. With --at-most, the recordings that are judged by then are scored. With
    --rediagnose, N of the recordings are diagnosed again, in a temporary folder. The exit code is 1 if one of
    these gets another verdict than the same sources gave before.

    \b
    Example:
      bayeskin prove --rediagnose 2
      bayeskin prove sets/one --at-most 4
    """
    from bayeskin.workflow import proof

    with Terminal() as terminal:
        return proof.prove(folder, terminal, rediagnose, at_most)


@click.command(short_help="Make a set of recordings for `bayeskin prove`.")
@click.argument("folder", type=PATH)
@click.option("--seed", required=True, type=int, help="Random seed of the set.")
@click.option("--count", required=True, type=int, help="Number of recordings.")
@click.option(
    "--only", multiple=True, metavar="NAME", help="`nothing`, a mechanism or an effect outside the catalogue."
)
@answered
def conceal(folder: Path, seed: int, count: int, only: tuple[str, ...]) -> Mapping[str, Any]:
    """Make a set for `bayeskin prove`: recordings by the full model, with the effects' keys under seal.

    A set has recordings without any effect, with each mechanism, with pairs of mechanisms, and with effects
    that are outside the catalogue of mechanisms. With --only, which can be repeated, the set has only the
    named effects, in equal numbers. Their sizes then range from one to thirty noise floors, to show how large
    an effect must be to be detected. A finished recording is not made again. Each recording takes about half
    a minute, and two are made at once.

    \b
    Example:
      bayeskin conceal sets/one --seed 7 --count 24
      bayeskin conceal sets/none --seed 8 --count 80 --only nothing
      bayeskin conceal sets/sizes --seed 9 --count 16 --only pad-slip --only force-offset
    """
    from bayeskin.workflow import proof

    with Terminal() as terminal:
        return proof.conceal(folder, seed, count, terminal, only)
