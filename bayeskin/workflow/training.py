"""The third stage: trains the surrogate, and measures its error on held-out runs after each wave."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayeskin import report, storage
from bayeskin.config import parameter_space
from bayeskin.surrogates import (
    ShapeSurrogate,
    Validation,
    correct,
    load_manifest,
    load_surrogate,
    manifest_of,
    save_surrogate,
    train,
)
from bayeskin.surrogates.focus import focus
from bayeskin.types import Array, BinnedForce, Design, PadMotion
from bayeskin.types.joint import figure_name
from bayeskin.workflow.design_runs import enough
from bayeskin.workflow.engine import Run, Stage
from bayeskin.workflow.provenance import caption
from bayeskin.workflow.recording import fitted_bins
from bayeskin.workflow.shipping import origin, shipped_files

PRIOR_DRAWS = 256


def trained(run: Run, design: Design, binned: BinnedForce) -> tuple[ShapeSurrogate, Validation]:
    """Returns the configuration's surrogate of a design, most accurate near the recording, with its
    validation."""
    config = run.config
    weights = focus(design, binned, fitted_bins(run, binned))
    return train(enough(design), config.surrogate.kind, config.seed, weights)


def corrected(
    run: Run, surrogate: ShapeSurrogate, fine: Design, binned: BinnedForce
) -> tuple[ShapeSurrogate, Validation]:
    """Returns a coarser model's surrogate after correction by runs of the configuration's model.

    The second value is its validation.
    """
    return correct(surrogate, fine, focus(fine, binned, fitted_bins(run, binned)))


def fine_design(run: Run, stage: str) -> Design | None:
    """Returns the configuration's model at points of a coarser model's design, as a stage left it.

    Returns None where the configuration has no coarser model.
    """
    return None if run.config.design.coarse is None else storage.load(run.at(stage, "fine.h5"), Design)


def _train_surrogate(run: Run) -> Mapping[str, Any]:
    """Trains the surrogate, or takes a shipped one, writes it, and returns the stage's summary."""
    design, fine = storage.load(run.at("design", "design.h5"), Design), fine_design(run, "design")
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    uncorrected = None
    if run.config.surrogate.file is not None:
        file = shipped_files(run).surrogate
        surrogate, manifest = load_surrogate(file), load_manifest(file)
    else:
        surrogate, validation = trained(run, design, binned)
        if fine is not None:
            uncorrected = surrogate
            surrogate, validation = corrected(run, uncorrected, fine, binned)
        records = json.loads(run.at("design", "waves.json").read_text())
        manifest = {**manifest_of(surrogate, validation), **origin(run, motion, records)}
    save_surrogate(run.at("train", "surrogate.h5"), surrogate, manifest)
    _draw_figures(run, design, fine, binned, surrogate, uncorrected)
    return {name: value for name, value in manifest.items() if name not in ("waves", "parameters")}


def _draw_figures(
    run: Run, design: Design, fine: Design | None, binned: BinnedForce, surrogate: ShapeSurrogate,
    uncorrected: ShapeSurrogate | None,
) -> None:  # fmt: skip
    """Draws the figures of the validation and of predictions over the prior."""
    held_out = design if fine is None else fine
    testing = held_out.testing
    truth, prediction = held_out.force_n[testing], surrogate.predict(held_out.theta[testing])
    scale = np.sqrt(np.mean(truth**2, axis=1))
    means = [*_earlier_predictions(run, design, binned, held_out, uncorrected), prediction.mean]
    errors = np.array([np.sqrt(np.mean((mean - truth) ** 2, axis=1)) / scale for mean in means])
    space = parameter_space(run.config, run.config_path)
    theta = space.draw(np.random.default_rng([run.config.seed, 3]), PRIOR_DRAWS)
    drawn = surrogate.predict_mean(theta)
    for number, (bins, part) in enumerate(zip(binned.slices, binned.parts, strict=True)):
        figure = report.figure_prior_predictive(part, drawn[:, bins])
        report.save_figure(figure, run.at("train", figure_name("prior_predictive", number)), caption(run))
        figure = report.figure_validation(
            part.edges_s, truth[:, bins], prediction.of_bins(bins), np.sqrt(part.variance_n2), errors,
            corrected=fine is not None,
        )  # fmt: skip
        report.save_figure(figure, run.at("train", figure_name("validation", number)), caption(run))


def _earlier_predictions(
    run: Run, design: Design, binned: BinnedForce, held_out: Design, uncorrected: ShapeSurrogate | None
) -> list[Array]:
    """Returns the predictions at held-out points of surrogates trained on fewer waves, (n, m) each.

    There is one surrogate for each wave but the last, trained on the waves up to it. With held-out points of
    a fine model, the last entry is the uncorrected surrogate of all waves. The predictions are NaN where the
    surrogate was trained elsewhere.
    """
    waves = np.unique(design.wave[design.ok])
    theta, before = held_out.theta[held_out.testing], waves[:-1]
    if run.config.surrogate.file is not None:
        count = len(before) if held_out is design else len(waves)
        return [np.full((len(theta), design.force_n.shape[1]), np.nan)] * count
    parts = [dataclasses.replace(design, ok=design.ok & (design.wave <= wave)) for wave in before]
    predictions = [trained(run, part, binned)[0].predict_mean(theta) for part in parts]
    return predictions if uncorrected is None else [*predictions, uncorrected.predict_mean(theta)]


STAGE = Stage(
    "train",
    "trains the surrogate",
    ("recording", "design"),
    ("seed", "parameters", "surrogate", "fit", "model", "design"),
    _train_surrogate,
    lambda run: shipped_files(run).present if run.config.surrogate.file is not None else (),
)
