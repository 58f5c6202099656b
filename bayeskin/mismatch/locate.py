"""Where a recording leaves what the calibrated model allows: windows, the error of the whole search held.

What is allowed is the residual that noise alone leaves after a fit: draws of the noise, with its parameters
of a fit that takes no mismatch for noise, less what parameters and the errors allowed for take up of each;
and, in each phase, an error of `MODEL_ERROR` of the force's range, which mesh and time steps leave beyond
what is allowed for (`inference.model_error`; docs/discretisation.md: 0.02 and 0.04 %, RMS), or `MESH_ERROR`,
which they leave beside a factor alone (0.10 %, there), where no shape of a mesh's error is allowed for. Mean
residuals over windows of every length inside each phase are counted in standard deviations of the same means
of draws; the largest over all windows has its distribution from the draws themselves, so that one chance in
`LEVEL` finds any window where nothing is missing (a scan statistic: Glaz, Naus & Wallenstein 2001).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from bayeskin.inference import LogPosterior
from bayeskin.inference.likelihood import FARTHEST
from bayeskin.inference.noise_model import draw_noise
from bayeskin.mismatch.fit import EDGE, Fit
from bayeskin.types import Array

DRAWS = 1000
LEVEL = 0.05
TAIL = 0.1  # of the draws, from whose farthest windows the chance of going farther is read
SHORTEST = 2  # bins
MODEL_ERROR = 4e-4  # of the force's range
MESH_ERROR = 1e-3  # the same
PRIOR_PRECISION = 12.0  # of a uniform prior over the unit cube
STEP = 1e-4  # of the unit cube, inwards, for derivatives


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
    """Windows in time order; residual (k,) [N] and what is allowed of it, sd (k,) [N], at bins (k,).

    chance : that some window goes by itself as far as the farthest does
    """

    windows: tuple[Window, ...]
    bins: NDArray[np.int64]
    residual_n: Array
    allowed_n: Array
    chance: float


def model_error(log_posterior: LogPosterior) -> float:
    """What the full model itself is wrong by [N], beyond the shapes that are allowed for."""
    force_n = log_posterior.binned.force_n
    share = MODEL_ERROR if log_posterior.model_error is not None else MESH_ERROR
    return share * float(np.nanmax(force_n) - np.nanmin(force_n))


def locate(found: Fit, noise: Mapping[str, float], seed: int) -> Located:
    """Windows in which the recording differs from the model at `found`, or at another point as near by.

    A residual is tested as draws of noise are: less what small changes of the parameters take up of it, so
    that `found` need not be the best there is. `noise` holds the noise parameters among its values: those of
    a fit that takes no mismatch for noise.
    """
    log_posterior, rng = found.log_posterior, np.random.default_rng(seed)
    chain = log_posterior.chain
    residual = chain.force_n - found.force_n[chain.bins]
    phase = log_posterior.binned.phase[chain.bins]
    spread, tested = _allowed(found, noise, residual, rng)
    error_n = model_error(log_posterior) * rng.standard_normal((DRAWS, len(log_posterior.binned.phases)))
    spread += error_n[:, phase]
    spans = _spans(phase)
    scale = np.array([_means(spread, *span).std() for span in spans])
    tall = np.zeros(len(spread))
    for span, sd in zip(spans, scale, strict=True):
        centred = _means(spread, *span)
        tall = np.maximum(tall, np.abs(centred - centred.mean()) / sd)
    z = np.array([_means(tested[None], *span)[0] for span in spans]) / scale
    windows = []
    for a, b in _chosen(spans, z, float(np.quantile(tall, 1.0 - LEVEL))):
        mean, left = float(residual[a:b].mean()), float(tested[a:b].mean())
        sd = float(_means(spread, a, b).std())
        within = log_posterior.binned.phases[phase[a]]
        edges = log_posterior.binned.edges_s
        windows.append(
            Window(
                float(edges[chain.bins[a]]), float(edges[chain.bins[b - 1] + 1]),
                within.kind, within.cycle, mean, _chance(tall, abs(left) / sd),
            )
        )  # fmt: skip
    chance = _chance(tall, float(np.abs(z).max(initial=0.0)))
    return Located(tuple(windows), chain.bins, residual, spread.std(axis=0), chance)


def _chance(tall: Array, height: float) -> float:
    """Of some window of a draw going so high, in sd.

    From draws; beyond the highest tenth of them by its own tail, in which squares are exponential as a
    Gaussian's are.
    """
    edge = float(np.quantile(tall, 1.0 - TAIL))
    if height <= edge:
        return float((1 + np.sum(tall >= height)) / (1 + len(tall)))
    scale = float(np.mean(tall[tall > edge] ** 2 - edge**2))
    return float(TAIL * np.exp(-(height**2 - edge**2) / scale))


def _allowed(
    found: Fit, noise: Mapping[str, float], residual: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draws (n, k) of the residual that noise, parameters and what the surrogate leaves open allow; and what
    is left of the recorded one (k,) when these have taken up what they can, as of the draws.

    Of that they take up no more than is believed: parameters in their box, errors within `FARTHEST` sd,
    or as far as they are. Noise alone does not bring a draw's there.
    """
    log_posterior, chain = found.log_posterior, found.log_posterior.chain
    own = [noise[name] for name in log_posterior.names[log_posterior.surrogate.space.dim :]]
    point = log_posterior.from_sampling(log_posterior.vector(found.theta))[None]
    best = log_posterior.predict(point)
    diagonal = np.repeat(best.diagonal[:, chain.bins], DRAWS, axis=0)
    drawn = draw_noise(chain, np.tile(own, (DRAWS, 1)), diagonal, rng)
    # What parameters and the surrogate's latent error leave open is what the recording does not fix: noise,
    # seen through the fit, moves both; a fit to each draw would take that part out of it again.
    weight = 1.0 / np.maximum(drawn.var(axis=0), 1e-18)
    free = _free(found)
    unit = found.unit[free]
    design = np.concatenate([_slopes(found, free), best.factor[0, chain.bins]], axis=1)
    prior = np.concatenate([np.full(design.shape[1] - best.factor.shape[2], PRIOR_PRECISION),
                            np.ones(best.factor.shape[2])])  # fmt: skip
    normal = (design * weight[:, None]).T @ design + np.diag(prior)
    taken = design @ np.linalg.solve(normal, (design * weight[:, None]).T @ drawn.T)
    reach = np.maximum(np.abs(found.latent), FARTHEST)
    root = np.sqrt(weight)
    at = lsq_linear(
        np.concatenate([root[:, None] * design, np.diag(np.sqrt(prior))]),
        np.concatenate([root * residual, np.zeros(len(prior))]),
        (np.concatenate([-unit, -reach - found.latent]), np.concatenate([1.0 - unit, reach - found.latent])),
    )
    return drawn - taken.T, residual - design @ at.x


def _free(found: Fit) -> list[int]:
    """Which material parameters are not on a bound."""
    inner = found.log_posterior.surrogate.space.dim
    return [i for i in range(inner) if EDGE < found.unit[i] < 1.0 - EDGE]


def _slopes(found: Fit, free: list[int]) -> Array:
    """Derivatives (k, d) [N] by these parameters, over the unit cube."""
    log_posterior = found.log_posterior
    low, high = log_posterior.bounds
    if not free:
        return np.zeros((len(log_posterior.chain.bins), 0))
    step = np.where(found.unit[free] < 0.5, STEP, -STEP)
    inwards = found.unit + step[:, None] * np.eye(len(low))[free]
    points = low + np.concatenate([found.unit[None], inwards]) * (high - low)
    mean = log_posterior.predict_mean(log_posterior.from_sampling(points))[:, log_posterior.chain.bins]
    return np.asarray((mean[1:] - mean[0]).T / step)


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
