"""The commands that explain a mismatch between model and recording: `diagnose` and `experiment`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bayeskin.cli.answers import answered
from bayeskin.cli.options import PATH, device_option
from bayeskin.cli.terminal import Terminal


@click.command(short_help="Find the physics that the model leaves out, and where.")
@click.argument("sources", type=PATH, nargs=-1, required=True)
@device_option
@answered
def diagnose(sources: tuple[Path, ...], device: Path | None) -> Mapping[str, Any]:
    """Find the physics that the model leaves out of a recording, and where; show how the fit improves.

    SOURCES is a configuration, or a recording of any protocol, or several recordings of one skin.
    Several recordings share the skin and its mechanisms. Each has its own initial pressure, noise and
    mechanisms of the instrument. A recording that contradicts the others is pointed out.

    The reduced model of the device solves all mechanisms of a set together, and the full model checks the
    result. The likeliest sets are fitted again to the recording up to the end of its second hold, and tested
    on the rest of it. This takes two to ten minutes, and longer if many mechanisms act. For the article's
    observation, and for a forward model of your own, a surrogate is trained first, and mechanisms of the
    tissue are not tried. The exit code is 0 for every verdict. Read report.html in the run's folder for the
    result: it begins with the verdict, one figure and three sentences.

    \b
    Example:
      bayeskin diagnose runs/healthy-skin.toml
      bayeskin diagnose runs/healthy-skin.h5 --json
      bayeskin diagnose first.h5 --device device.toml
      bayeskin diagnose first.h5 second.h5
    """
    from bayeskin.workflow import diagnosing

    with Terminal() as terminal:
        return diagnosing.diagnose(sources, terminal, device)


@click.command(short_help="Propose a test that tells look-alike mechanisms apart.")
@click.argument("sources", type=PATH, nargs=-1, required=True)
@device_option
@answered
def experiment(sources: tuple[Path, ...], device: Path | None) -> Mapping[str, Any]:
    """Propose the further test that would best tell look-alike mechanisms apart.

    SOURCES are those of `bayeskin diagnose`, which runs first if the diagnosis is not done. The command works
    only for the observation `reaction`, because the article's observation is defined for the article's
    protocol alone. It compares the set of mechanisms that explains the recording best with the sets in which
    look-alikes take their place, and takes all of them as equally probable. The reduced model of the device
    runs draws of their posteriors in other tests. The forces give the expected information, in bits, about
    which set is true. The command first tries nine variations of the recording's own test, and then changes
    of the most informative ones. All tests stay within the displacements and speeds that the reduced model
    was trained for.

    \b
    Example:
      bayeskin experiment runs/healthy-skin.toml
      bayeskin experiment first.h5 --device device.toml
      bayeskin experiment first.h5 second.h5
    """
    from bayeskin.workflow import experiment

    with Terminal() as terminal:
        return experiment.choose(sources, terminal, device)
