"""Builds the log-posterior that a configuration asks for, and compares predicted with recorded forces."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayeskin import inference, storage
from bayeskin.config import parameter_space
from bayeskin.forward.posterior import posterior_of
from bayeskin.inference import LogPosterior, NoisePriors
from bayeskin.inference.noise_model import bins_in_windows
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, BinnedForce, PadMotion, Surrogate
from bayeskin.workflow.engine import Run
from bayeskin.workflow.model import model_spec

ARTICLE_HOLDS_S = (
    (18.8, 75.0),
    (97.8, 145.0),
)  # the article's script has these; its text says 20-75 and 98-140


def log_posterior_of(run: Run, surrogate: Surrogate, binned: BinnedForce, motion: PadMotion) -> LogPosterior:
    """Returns the log-posterior that the configuration asks for, of a recording's bins and protocol."""
    config = run.config
    noise = {name: bounds for name, bounds in config.noise if bounds is not None}
    windows = None if config.fit.windows_s is None else tuple(config.fit.windows_s)
    space = parameter_space(config, run.config_path)
    return posterior_of(surrogate, model_spec(run), binned, motion, NoisePriors(**noise), space, windows)


def refined_posterior(run: Run) -> LogPosterior:
    """Returns the log-posterior with the surrogate after the check at the most probable point."""
    binned = storage.load(run.at("recording", "binned.h5"), BinnedForce)
    motion = storage.load(run.at("recording", "motion.h5"), PadMotion)
    return log_posterior_of(run, load_surrogate(run.at("map", "surrogate.h5")), binned, motion)


def rmse_table(log_posterior: LogPosterior, force_n: Array) -> dict[str, Any]:
    """Returns the RMSE [N] of a predicted force (m,) on the recorded bins.

    The table has the RMSE over all bins, by kind of phase, over the fitted bins, and over the bins that are
    not fitted. `article_holds_n` is the RMSE over both windows of the article; it is None where the recording
    ends before them.
    """
    binned = log_posterior.binned
    usable = bins_in_windows(binned, None) >= 0
    fitted = np.isin(np.arange(len(usable)), log_posterior.chain.bins)
    covered = binned.edges_s[-1] >= ARTICLE_HOLDS_S[-1][1]
    holds = bins_in_windows(binned, ARTICLE_HOLDS_S) >= 0
    square = (binned.force_n - force_n) ** 2
    return {
        "whole_n": _root_of_mean(square[usable]),
        "by_kind_n": dict(inference.rmse(binned, force_n).by_kind_n),
        "fitted_n": _root_of_mean(square[fitted]),
        "not_fitted_n": _root_of_mean(square[usable & ~fitted]),
        "article_holds_n": _root_of_mean(square[holds]) if covered else None,
    }


def _root_of_mean(square: Array) -> float | None:
    """Returns the root of the mean of squares, and None where there are none."""
    return float(np.sqrt(square.mean())) if len(square) else None
