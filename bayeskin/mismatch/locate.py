"""Where a recording leaves what the calibrated model allows: windows, the error of the whole search held.

What is allowed is the posterior predictive without the discrepancy that the noise model could take up: the
recording's own measured noise, the surrogate's error and the parameters' uncertainty. Mean residuals over
windows of every length inside each phase are counted in standard deviations of the same means of draws; the
largest over all windows has its distribution from the draws themselves, so that one chance in `LEVEL` finds
any window where nothing is missing (a scan statistic: Glaz, Naus & Wallenstein 2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bayeskin.inference.noise_model import draw_noise
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array

DRAWS = 1000
LEVEL = 0.05
SHORTEST = 2  # bins


@dataclass(frozen=True)
class Window:
    """One stretch of a phase: times [s], mean residual [N], chance that any window goes so far by itself."""

    start_s: float
    end_s: float
    phase: str
    cycle: int
    mean_n: float
    significance: float


@dataclass(frozen=True)
class Located:
    """Windows in time order; residual (k,) [N] and what is allowed of it, sd (k,) [N], at bins (k,)."""

    windows: tuple[Window, ...]
    bins: NDArray[np.int64]
    residual_n: Array
    allowed_n: Array


def locate(found: Fit, seed: int) -> Located:
    """Windows in which the recording differs from the model at `found`."""
    log_posterior, rng = found.log_posterior, np.random.default_rng(seed)
    chain = log_posterior.chain
    theta = found.draws(DRAWS, seed)
    best = log_posterior.predict(log_posterior.from_sampling(log_posterior.vector(found.theta)))
    residual = chain.force_n - best.mean[0, chain.bins]
    spread = _allowed(found, theta, rng) - best.mean[0, chain.bins]
    spans = _spans(log_posterior.binned.phase[chain.bins])
    scale = np.array([_means(spread, *span).std() for span in spans])
    tall = np.zeros(len(spread))
    for span, sd in zip(spans, scale, strict=True):
        centred = _means(spread, *span)
        tall = np.maximum(tall, np.abs(centred - centred.mean()) / sd)
    z = np.array([_means(residual[None], *span)[0] for span in spans]) / scale
    windows = []
    for a, b in _chosen(spans, z, float(np.quantile(tall, 1.0 - LEVEL))):
        mean = float(residual[a:b].mean())
        sd = float(_means(spread, a, b).std())
        chance = (1 + np.sum(tall >= abs(mean) / sd)) / (1 + len(tall))
        phase = log_posterior.binned.phases[log_posterior.binned.phase[chain.bins[a]]]
        edges = log_posterior.binned.edges_s
        windows.append(
            Window(
                float(edges[chain.bins[a]]), float(edges[chain.bins[b - 1] + 1]),
                phase.kind, phase.cycle, mean, float(chance),
            )
        )  # fmt: skip
    return Located(tuple(windows), chain.bins, residual, spread.std(axis=0))


def _allowed(found: Fit, theta: Array, rng: np.random.Generator) -> Array:
    """Draws (n, k) of the force that noise, surrogate and parameters allow, without a discrepancy."""
    log_posterior = found.log_posterior
    chain, prediction = log_posterior.chain, log_posterior.predict(theta)
    noise = log_posterior.split(theta)[1].copy()
    noise[:, :-2] = log_posterior.noise_priors.sd_n[0]
    noise[:, -1] = log_posterior.noise_priors.nu[1]
    factor, diagonal = prediction.factor[:, chain.bins], prediction.diagonal[:, chain.bins]
    latent = rng.standard_normal((len(theta), factor.shape[2]))
    error = np.einsum("nkr,nr->nk", factor, latent)
    return np.asarray(prediction.mean[:, chain.bins] + error + draw_noise(chain, noise, diagonal, rng))


def _spans(phase: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Windows (first, end) of doubling lengths at half steps, and whole phases."""
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase)]
    spans = set()
    for a, b in pairwise(edges):
        length = SHORTEST
        while length < b - a:
            starts = {*range(a, b - length + 1, max(length // 2, 1)), b - length}
            spans |= {(start, start + length) for start in starts}
            length *= 2
        if b - a >= SHORTEST:
            spans.add((a, b))
    return sorted(spans)


def _means(values: Array, a: int, b: int) -> Array:
    return np.asarray(values[:, a:b].mean(axis=1))


def _chosen(spans: list[tuple[int, int]], z: Array, limit: float) -> list[tuple[int, int]]:
    """The most significant windows that do not overlap, neighbours of one sign joined, in order."""
    taken: list[tuple[int, int, float]] = []
    for i in np.argsort(-np.abs(z)):
        if abs(z[i]) <= limit:
            break
        a, b = spans[i]
        if all(b <= start or a >= end for start, end, _ in taken):
            taken.append((a, b, float(np.sign(z[i]))))
    joined: list[tuple[int, int, float]] = []
    for a, b, sign in sorted(taken):
        inside = bool(joined) and joined[-1][1] == a and joined[-1][2] == sign
        if inside and any(s <= joined[-1][0] and b <= e for s, e in spans):
            joined[-1] = (joined[-1][0], b, sign)
        else:
            joined.append((a, b, sign))
    return [(a, b) for a, b, _ in joined]
