"""Makes the runs of a design, and stores them by what they depend on, so that no run is made twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bayeskin.design import Wave
from bayeskin.forward.design_model import ForceModel
from bayeskin.runner import run_design
from bayeskin.store import Store
from bayeskin.surrogates import Similarity
from bayeskin.types import Array, Design, PadMotion
from bayeskin.workflow.engine import CannotGoOn, Run
from bayeskin.workflow.executor import executor

FEWEST_PER_INPUT = 4  # fewest training runs per input with which a surrogate can be trained


def runs_store(run: Run, model: ForceModel, motion: PadMotion) -> Store:
    """Returns the store of all runs of one model on one protocol."""
    return run.store("runs", [model.hash, vars(motion)])


def run_wave(
    run: Run, label: str, wave: Wave, edges_s: Array, model: ForceModel, motion: PadMotion
) -> Design:
    """Returns the runs of a wave's points; those that are in the store are not made again."""
    run.reporter.log(f"{label}: {len(wave.theta)} runs")
    with executor(run) as run_all, runs_store(run, model, motion) as store:
        return run_design(
            store, wave, edges_s, partial(model, motion), model.hash, run_all, partial(_tell, run, label)
        )


def _tell(run: Run, label: str, done: int, total: int, failed: int) -> None:
    """Reports the progress of a design in words."""
    run.reporter.progress(label, done / max(total, 1), f"{done} of {total} runs, {failed} failed")


def joined(designs: Sequence[Design]) -> Design:
    """Returns the rows of several designs, one design after the other."""
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(design, name) for design in designs])
        for name in ("theta", "force_n", "wave", "held_out", "ok", "seconds")
    }
    messages = tuple(message for design in designs for message in design.messages)
    return replace(designs[0], messages=messages, **rows)


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
