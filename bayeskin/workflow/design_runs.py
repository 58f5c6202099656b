"""Makes the runs of a design, and stores them by what they depend on, so that no run is made twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin.design import Wave
from bayeskin.forward.design_model import ForceModel
from bayeskin.hashing import sha256_of
from bayeskin.runner import run_design
from bayeskin.surrogates import Similarity
from bayeskin.types import Array, Design, PadMotion, ParameterSpace
from bayeskin.workflow.engine import CannotGoOn, Run
from bayeskin.workflow.executor import executor

FEWEST_PER_INPUT = 4  # fewest training runs per input with which a surrogate can be trained


def runs_file(run: Run, model: ForceModel, motion: PadMotion, edges_s: Array, space: ParameterSpace) -> Path:
    """Returns the path of the file with all runs of one model on one protocol."""
    protocol: dict[str, Any] = {"time_s": motion.time_s, "displacement_m": motion.displacement_m}
    if motion.spans:
        protocol["spans"] = motion.spans
    identity = sha256_of([model.hash, protocol, edges_s, [vars(p) for p in space.without_texts.parameters]])
    return run.folder / "runs" / f"{identity[:16]}.h5"


def run_wave(
    run: Run, label: str, runs_file: Path, wave: Wave, edges_s: Array, model: ForceModel, motion: PadMotion
) -> None:
    """Runs the points of a wave that are not in the file yet, and stores them there."""
    run.reporter.log(f"{label}: {len(wave.theta)} runs")
    with executor(run) as run_all:
        run_design(
            runs_file, wave, edges_s, partial(model, motion), model.hash, run_all, partial(_tell, run, label)
        )


def _tell(run: Run, label: str, done: int, total: int, failed: int) -> None:
    """Reports the progress of a design in words."""
    run.reporter.progress(label, done / max(total, 1), f"{done} of {total} runs, {failed} failed")


def rows_of(runs: Design, waves: Sequence[Wave]) -> Design:
    """Returns the rows of `runs` at the waves' points, in the order of the waves and with their labels."""
    row_of = {theta.tobytes(): row for row, theta in enumerate(runs.theta)}
    points = np.concatenate([wave.theta for wave in waves])
    rows = np.array([row_of[theta.tobytes()] for theta in points])
    return replace(
        runs,
        theta=points,
        wave=np.concatenate([np.full(len(wave.theta), wave.number) for wave in waves]),
        held_out=np.concatenate([wave.held_out for wave in waves]),
        messages=tuple(runs.messages[row] for row in rows),
        **{name: getattr(runs, name)[rows] for name in ("force_n", "ok", "seconds")},
    )


def enough(design: Design) -> Design:
    """Returns the design if it is large enough to train a surrogate.

    Raises CannotGoOn, which names the most frequent failure, if it is not.
    """
    needed = FEWEST_PER_INPUT * Similarity(design.space).dim
    succeeded = int(design.training.sum())
    if succeeded >= needed and design.testing.any():
        return design
    failures = failures_of(design)
    why = f" (most frequent failure: {failures.most_common(1)[0][0]})" if failures else ""
    raise CannotGoOn(
        f"{succeeded} training runs succeeded, at least {needed} are needed{why}; narrow the prior box"
    )


def failures_of(design: Design) -> Counter[str]:
    """Returns how often each message of failure occurs among a design's runs."""
    return Counter(text for text, ok in zip(design.messages, design.ok, strict=True) if not ok)
