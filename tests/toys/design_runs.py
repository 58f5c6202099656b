"""Runs a small design on the closed-form model, and compares the rows of two designs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from toys.closed_form_model import toy_simulate
from toys.unreliable_models import COARSE_S, WAVE

from bayeskin.design import Wave
from bayeskin.execution.local import Map, here
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.types import Design

SHORT = replace(WAVE, theta=WAVE.theta[:4], held_out=WAVE.held_out[:4])


def run(
    path: Path, wave: Wave = WAVE, simulate: object = toy_simulate, run_all: Map = here, **options: Any
) -> Design:
    """The design of a wave, from runs of a toy that a store beside it keeps."""
    with Store(path, "toy") as store:
        return run_design(store, wave, COARSE_S, simulate, "toy", run_all, **options)


def assert_same_rows(design: Design, expected: Design) -> None:
    """Equal bit by bit, durations excepted."""
    for name in ("edges_s", "theta", "force_n", "wave", "held_out", "ok"):
        np.testing.assert_array_equal(getattr(design, name), getattr(expected, name), err_msg=name)
    assert design.space == expected.space
    assert (design.messages, design.seed, design.model_hash) == (
        expected.messages, expected.seed, expected.model_hash,
    )  # fmt: skip
