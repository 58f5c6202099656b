"""The second stage: runs the model at the design's points, in waves (`workflow.waves`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayeskin import report, storage
from bayeskin.design_files import load_design
from bayeskin.json_files import write_json
from bayeskin.surrogates import load_manifest
from bayeskin.types import BinnedForce, Design, PadMotion
from bayeskin.workflow.design_runs import failures_of
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.model import own_files, reduced_files
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.shipping import check_fits, shipped_files
from bayeskin.workflow.waves import run_fine, run_waves


def _make_design(run: Run) -> Mapping[str, Any]:
    """Makes the design, or takes the design of a shipped surrogate, and returns the stage's summary."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    if run.config.surrogate.file is not None:
        files = shipped_files(run)
        design = load_design(files.design)
        check_fits(run, files, design, binned, motion)
        records = load_manifest(files.surrogate)["waves"]
        fine = load_design(files.fine) if files.fine is not None else None
    else:
        design, records = run_waves(run, binned, motion)
        fine = run_fine(run, design, motion) if run.config.design.coarse is not None else None
    storage.save(run.at("design", "design.h5"), design)
    if fine is not None:
        storage.save(run.at("design", "fine.h5"), fine)
    write_json(run.at("design", "waves.json"), records)
    _draw_figure(run, design, records)
    return {**_summary(design, records), **({} if fine is None else {"fine": _counts(fine)})}


def _summary(design: Design, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the stage's summary: counts of the runs, and the records of the waves."""
    return {**_counts(design), "waves": list(records)}


def _counts(design: Design) -> dict[str, Any]:
    """Returns counts, failures and durations of a design's runs."""
    return {
        "runs": len(design.theta),
        "training": int(design.training.sum()),
        "held_out": int(design.testing.sum()),
        "failed": int((~design.ok).sum()),
        "failures": dict(failures_of(design).most_common(5)),
        "seconds_of_runs": float(np.nansum(design.seconds)),
        "median_seconds_a_run": float(np.nanmedian(design.seconds)),
        "model_hash": design.model_hash,
    }


def _draw_figure(run: Run, design: Design, records: Sequence[Mapping[str, Any]]) -> None:
    """Draws the figure of the waves."""
    fractions = [record["kept_fraction"] for record in records]
    report.save_figure(report.figure_waves(design, fractions), run.at("design", "waves"), caption(run))


def _files(run: Run) -> Iterable[Path]:
    """Returns the files besides the recording that the stage reads."""
    files = [run.beside(run.config.model.mesh)] if run.config.model.mesh != "bricks" else []
    ready = shipped_files(run).present if run.config.surrogate.file is not None else ()
    return [*files, *own_files(run), *reduced_files(run), *ready]


STAGE = Stage(
    "design",
    "runs the model at the design's points",
    ("recording",),
    ("seed", "model", "parameters", "design", "surrogate", "fit", "noise"),
    _make_design,
    _files,
)
