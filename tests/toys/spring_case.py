"""A configuration of a spring in a user's own file, with a recording; and what a refused command prints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from toys.closed_form_model import MOTION
from toys.external_models import PARAMETERS, SPRING, TRUE, spring

from bayeskin import cli, storage
from bayeskin.types import Parameter, ParameterSpace, Recording

CONFIG = """
[recording]
file = "measured.h5"
[model]
forward = "{forward}"
[fit]
bin_width_s = 1.0
[design]
points = [32]
held_out = 8
workers = 1
[map]
starts = 2
evaluations = 2000
"""
SPACE = ParameterSpace(
    tuple(
        Parameter(name, "", low, high, "uniform")
        for name, low, high in (("stiffness", 10.0, 800.0), ("share", 0.0, 1.0), ("tau", 1.0, 50.0))
    )
)
NOISE_N = 0.002


def spring_case(folder: Path) -> Path:
    """A configuration of the spring in a folder, with a recording that the spring made."""
    time_s = np.arange(0.0, 130.001, 0.1)
    pulled = MOTION.at(time_s)
    noise_n = NOISE_N * np.random.default_rng(5).standard_normal(len(time_s))
    force_n = spring()(TRUE, time_s, pulled) + noise_n
    storage.save(folder / "measured.h5", Recording(time_s, pulled, force_n, "spring", "0" * 64))
    (folder / "spring.py").write_text(SPRING)
    return configured(folder / "case.toml", "spring.py:force")


def configured(path: Path, forward: str, more: str = PARAMETERS) -> Path:
    path.write_text(CONFIG.format(forward=forward) + more)
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a command that ends with exit code 2."""
    with pytest.raises(SystemExit) as stop:
        cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("bayeskin: ")]
    assert lines == [captured.err.splitlines()[-1]]
    return lines[0]
