"""Posterior predictive force, the parts of its uncertainty, and its distance from the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.inference.noise_model import (
    NoiseChain,
    NoisePriors,
    Windows,
    bins_in_windows,
    draw_noise,
    innovations,
    noise_chain,
)
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.surrogate_error import drawn_errors
from bayeskin.types import PHASE_KINDS, POINTS_AT_ONCE, Array, BinnedForce, FreezesArrays, Prediction

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class ForceDraws(FreezesArrays):
    """Posterior predictive draws on all bins; each array is (s, m) [N].

    mean_n is the force without noise; it includes the errors of surrogate and model that the recording
    reveals. surrogate_sd_n is the sd that the surrogate states for its own error. noise_sd_n is the sd of
    the noise. force_n is the force with noise.
    """

    mean_n: Array
    surrogate_sd_n: Array
    noise_sd_n: Array
    force_n: Array


@dataclass(frozen=True)
class Bands(FreezesArrays):
    """Predictive bands over the bins, (m,) each [N], and the parts of their variance.

    `sd_model_n` is the sd of the force without noise over the draws; it contains the uncertainty of the
    parameters and of the errors. `sd_noise_n` is the root of the mean variance of the noise (of its Gaussian
    core, see `noise_model`). `sd_surrogate_n` is the root of the mean variance that the surrogate states for
    its own error, before the recording is known. `quantiles_n` (5, m) are the 5, 25, 50, 75 and 95 %
    quantiles of the predicted force with noise.
    """

    time_s: Array
    mean_n: Array
    sd_model_n: Array
    sd_surrogate_n: Array
    sd_noise_n: Array
    quantiles_n: Array

    @property
    def sd_total_n(self) -> Array:
        return np.hypot(self.sd_model_n, self.sd_noise_n)

    def interval(self, level: float) -> tuple[Array, Array]:
        """Returns the lower and upper edge (m,) [N] of the 50 % (level 0.5) or 90 % (level 0.9) band.

        Raises InputError for another level.
        """
        if level not in (0.5, 0.9):
            raise InputError("level of the band", f"{level} is not known", "use 0.5 or 0.9")
        low, high = (1, 3) if level == 0.5 else (0, 4)
        return self.quantiles_n[low], self.quantiles_n[high]


@dataclass(frozen=True)
class Rmse:
    """Root mean square of recorded minus predicted force [N]: over all bins, by kind of phase, by window."""

    whole_n: float
    by_kind_n: Mapping[str, float]
    by_window_n: tuple[float, ...]


def predictive_draws(log_posterior: LogPosterior, theta: ArrayLike, rng: np.random.Generator) -> ForceDraws:
    """Returns one predicted recording for each draw theta (s, D) in SI, on all bins, fitted or not.

    The errors of surrogate and model belong to this device and this skin. They are therefore drawn given
    the residuals of the draw in the fitted bins. The noise is drawn anew. Phases of a kind that was not
    fitted take the largest noise sd of the fitted kinds.
    """
    theta = np.atleast_2d(np.asarray(theta, dtype=float))
    fitted = log_posterior.chain
    chain = _whole_chain(log_posterior.binned, log_posterior.noise_priors)
    parts = [_predictive(log_posterior, fitted, chain, theta[a : a + POINTS_AT_ONCE], rng)
             for a in range(0, len(theta), POINTS_AT_ONCE)]  # fmt: skip
    return ForceDraws(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def bands(log_posterior: LogPosterior, theta: ArrayLike, rng: np.random.Generator) -> Bands:
    """Returns predictive bands from posterior draws theta (s, D) in SI; a thousand draws are enough."""
    return bands_of(log_posterior.binned.time_s, predictive_draws(log_posterior, theta, rng))


def bands_of(time_s: Array, draws: ForceDraws) -> Bands:
    """Returns the bands of predictive draws that exist already; time_s (m,) are the bin centres [s]."""
    return Bands(
        time_s=time_s,
        mean_n=draws.mean_n.mean(axis=0),
        sd_model_n=draws.mean_n.std(axis=0),
        sd_surrogate_n=np.sqrt((draws.surrogate_sd_n**2).mean(axis=0)),
        sd_noise_n=np.sqrt((draws.noise_sd_n**2).mean(axis=0)),
        quantiles_n=np.quantile(draws.force_n, LEVELS, axis=0),
    )


def coverage(binned: BinnedForce, low_n: Array, high_n: Array, windows: Windows | None = None) -> float:
    """Returns the share of recorded bins that lie between two edges (m,) [N]; NaN without a usable bin.

    Only bins in `windows` count; without windows all bins count.
    """
    inside = bins_in_windows(binned, windows) >= 0
    hit = (binned.force_n >= low_n) & (binned.force_n <= high_n)
    return float(hit[inside].mean()) if inside.any() else float("nan")


def rmse(binned: BinnedForce, force_n: ArrayLike, windows: Windows | None = None) -> Rmse:
    """Returns the RMSE of a predicted force (m,) [N] against the recorded force.

    `by_kind_n` covers the whole recording. `by_window_n` has one value for each of `windows`; it is NaN for a
    window without bins.
    """
    square = (binned.force_n - np.asarray(force_n, dtype=float)) ** 2
    usable = bins_in_windows(binned, None) >= 0
    kind = np.array([phase.kind for phase in binned.phases])[binned.phase]
    by_kind: dict[str, float] = {
        k: _root_mean(square[usable & (kind == k)]) for k in PHASE_KINDS if (kind == k).any()
    }
    index = [bins_in_windows(binned, [window]) for window in windows or ()]
    return Rmse(_root_mean(square[usable]), by_kind, tuple(_root_mean(square[i == 0]) for i in index))


def _root_mean(square: Array) -> float:
    return float(np.sqrt(square.mean())) if len(square) else float("nan")


def _whole_chain(binned: BinnedForce, noise: NoisePriors) -> NoiseChain:
    """Returns a chain over all bins, including bins without a recorded force.

    All forces are zero, because drawing noise does not need them. A variance that is not finite becomes zero.
    """
    filled = replace(
        binned,
        force_n=np.zeros_like(binned.force_n),
        variance_n2=np.nan_to_num(binned.variance_n2, nan=0.0, posinf=0.0),
    )
    return noise_chain(filled, by_kind=noise.by_kind, by_recording=noise.by_recording)


def _predictive(
    log_posterior: LogPosterior, fitted: NoiseChain, chain: NoiseChain, theta: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    noise = log_posterior.split(theta)[1]
    sd = noise[:, : len(fitted.kinds)]
    columns = [sd[:, fitted.kinds.index(k)] if k in fitted.kinds else sd.max(axis=1) for k in chain.kinds]
    noise = np.column_stack([*columns, noise[:, -2:]])
    surrogate_only = log_posterior.surrogate.predict(log_posterior.split(theta)[0])
    prediction = log_posterior.with_model_error(surrogate_only)
    latent = _draw_errors(log_posterior, theta, prediction, rng)
    mean = prediction.mean + np.einsum("nmr,nr->nm", prediction.factor, latent)
    force = mean + draw_noise(chain, noise, prediction.diagonal, rng)
    noise_sd = np.sqrt(noise[:, chain.kind] ** 2 + chain.variance_n2)
    return mean, surrogate_only.sd(), noise_sd, force


def _draw_errors(
    log_posterior: LogPosterior, theta: Array, prediction: Prediction, rng: np.random.Generator
) -> Array:
    """Returns one draw of the errors given the fitted bins for each theta, (n, r).

    The errors are in sd of each column of the prediction's factor.
    """
    chain, noise = log_posterior.chain, log_posterior.split(theta)[1]
    normals = rng.standard_normal((len(theta), prediction.factor.shape[2]))
    out = np.empty_like(normals)
    for i in range(len(theta)):
        residual = chain.force_n - prediction.mean[i, chain.bins]
        columns = np.column_stack([residual, prediction.factor[i, chain.bins]])
        white = innovations(chain, noise[i], prediction.diagonal[i, chain.bins], columns)
        out[i] = drawn_errors(white[:, 0], white[:, 1:], float(noise[i, -1]), normals[i][:, None])[:, 0]
    return out
