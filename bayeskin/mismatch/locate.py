"""Locates the windows of a recording in which the residual is larger than the calibrated model allows.

The allowed residual is the one that noise alone leaves after a fit. It is computed from draws of the noise,
minus the part of each draw that the parameters and the allowed errors can explain. The noise parameters come
from a fit that does not mistake a mismatch for noise. In addition, each phase may have an error of
`model_error` of the force's range. Mesh and time steps leave this error beyond the errors that are allowed
for (`inference.model_error`; docs/discretisation.md: 0.02 and 0.04 %, RMS). Where no shapes of the mesh's
error are allowed for, it is `mesh_error` instead, which mesh and time steps leave beyond a factor alone
(0.10 %, docs/discretisation.md).

The residual is averaged over windows of many lengths inside each phase. Each mean is divided by the standard
deviation of the same mean over the draws. The draws also give the distribution of the largest of these
values over all windows. Where nothing is missing, the probability of finding any window is therefore `level`
(a scan statistic: Glaz, Naus & Wallenstein 2001).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from bayeskin.inference import LogPosterior
from bayeskin.inference.likelihood import ERROR_PRIOR
from bayeskin.inference.noise_model import draw_noise
from bayeskin.inference.problem import FORCE_STEP, UNIFORM_PRECISION
from bayeskin.mismatch.evidence import EVIDENCE
from bayeskin.mismatch.fit import Fit
from bayeskin.types import Array


@dataclass(frozen=True)
class LocateSettings:
    """Settings of the search for windows.

    draws : number of draws of the noise
    level : probability of finding any window where nothing is missing
    tail : share of the draws with the farthest windows, from which larger distances are extrapolated
    shortest : smallest number of bins of a window
    model_error, mesh_error : error of the full model in each phase, as a share of the force's range, where
        shapes of the mesh's error are allowed for and where they are not (docs/discretisation.md)
    """

    draws: int = 1000
    level: float = 0.05
    tail: float = 0.1
    shortest: int = 2
    model_error: float = 4e-4
    mesh_error: float = 1e-3


@dataclass(frozen=True)
class Window:
    """A part of a phase in which the residual is larger than allowed.

    start_s, end_s : its times; mean_n : mean residual [N]
    significance : probability that noise alone makes any window of the recording as significant
    """

    start_s: float
    end_s: float
    phase: str
    cycle: int
    mean_n: float
    significance: float


@dataclass(frozen=True)
class Located:
    """The windows of a recording, in order of time.

    bins : indices of the fitted bins, (k,)
    residual_n : residual (k,) [N]; allowed_n : sd (k,) [N] of the residual that is allowed
    chance : probability that noise alone makes any window as significant as the most significant one
    """

    windows: tuple[Window, ...]
    bins: NDArray[np.int64]
    residual_n: Array
    allowed_n: Array
    chance: float


def model_error(log_posterior: LogPosterior, settings: LocateSettings = LocateSettings()) -> float:
    """Returns the error [N] of the full model beyond the shapes of error that are allowed for."""
    force_n = log_posterior.binned.force_n
    share = settings.mesh_error if log_posterior.model_error is None else settings.model_error
    return share * float(np.nanmax(force_n) - np.nanmin(force_n))


def locate(
    fit: Fit, noise: Mapping[str, float], seed: int, settings: LocateSettings = LocateSettings()
) -> Located:
    """Returns the windows in which the recording differs from the model at a fit, and at all points near it.

    The residual is tested in the same way as draws of the noise: the part that small changes of the
    parameters explain is subtracted. The fit therefore need not be the best point.

    noise : values by name, with the noise parameters of a fit that does not mistake a mismatch for noise
    """
    log_posterior, rng = fit.log_posterior, np.random.default_rng(seed)
    chain = log_posterior.chain
    residual = chain.force_n - fit.force_n[chain.bins]
    phase = log_posterior.binned.phase[chain.bins]
    drawn, tested = _allowed(fit, noise, residual, settings.draws, rng)
    normals = rng.standard_normal((settings.draws, len(log_posterior.binned.phases)))
    drawn += (model_error(log_posterior, settings) * normals)[:, phase]
    spans = _spans(phase, settings.shortest)
    scale = np.array([_means(drawn, *span).std() for span in spans])
    farthest = np.zeros(len(drawn))
    for span, sd in zip(spans, scale, strict=True):
        centred = _means(drawn, *span)
        farthest = np.maximum(farthest, np.abs(centred - centred.mean()) / sd)
    z = np.array([_means(tested[None], *span)[0] for span in spans]) / scale
    windows = []
    for a, b in _chosen(spans, z, float(np.quantile(farthest, 1.0 - settings.level))):
        mean, tested_mean = float(residual[a:b].mean()), float(tested[a:b].mean())
        sd = float(_means(drawn, a, b).std())
        probability = exceedance_probability(farthest, abs(tested_mean) / sd, settings.tail)
        at_phase = log_posterior.binned.phases[phase[a]]
        edges = log_posterior.binned.edges_s
        windows.append(
            Window(
                float(edges[chain.bins[a]]), float(edges[chain.bins[b - 1] + 1]),
                at_phase.kind, at_phase.cycle, mean, probability,
            )
        )  # fmt: skip
    chance = exceedance_probability(farthest, float(np.abs(z).max(initial=0.0)), settings.tail)
    return Located(tuple(windows), chain.bins, residual, drawn.std(axis=0), chance)


def exceedance_probability(tall: Array, height: float, tail: float) -> float:
    """Returns the probability that noise alone makes some window as far from zero as `height` [sd].

    The probability is counted among the draws. Within the highest share `tail` of the draws and beyond, it is
    extrapolated: there the squares are taken to be exponentially distributed, as those of a Gaussian are.

    tall : distance from zero of the farthest window of each draw, (n,) [sd]
    """
    tail_start = float(np.quantile(tall, 1.0 - tail))
    if height <= tail_start:
        return float((1 + np.sum(tall >= height)) / (1 + len(tall)))
    scale = float(np.mean(tall[tall > tail_start] ** 2 - tail_start**2))
    return float(tail * np.exp(-(height**2 - tail_start**2) / scale))


def _allowed(
    fit: Fit, noise: Mapping[str, float], residual: Array, draws: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Returns draws (n, k) [N] of the residual that noise leaves after a fit, and the recorded residual (k,).

    From both, the part is subtracted that the parameters and the surrogate's error can explain. For the
    recorded residual the parameters stay in their box, and the surrogate's errors within three sd, or
    within their fitted size if that is larger. The draws need no such limits, because noise alone does not
    reach them.
    """
    log_posterior, chain = fit.log_posterior, fit.log_posterior.chain
    noise_values = [noise[name] for name in log_posterior.names[log_posterior.force_noise]]
    point = log_posterior.from_sampling(log_posterior.vector(fit.theta))[None]
    best = log_posterior.predict(point)
    diagonal = np.repeat(best.diagonal[:, chain.bins], draws, axis=0)
    drawn = draw_noise(chain, np.tile(noise_values, (draws, 1)), diagonal, rng)
    # Noise moves the fitted parameters and the fitted error of the surrogate. A fit to a draw would therefore
    # explain a part of the draw, which is computed here by weighted least squares.
    weight = 1.0 / np.maximum(drawn.var(axis=0), 1e-18)
    free_columns = _free(fit)
    unit = fit.unit[free_columns]
    design = np.concatenate([_slopes(fit, free_columns), best.factor[0, chain.bins]], axis=1)
    rank = best.factor.shape[2]
    prior = np.concatenate([np.full(design.shape[1] - rank, UNIFORM_PRECISION), np.ones(rank)])
    normal = (design * weight[:, None]).T @ design + np.diag(prior)
    explained = design @ np.linalg.solve(normal, (design * weight[:, None]).T @ drawn.T)
    farthest = np.maximum(np.abs(fit.latent), ERROR_PRIOR.farthest)
    root_weight = np.sqrt(weight)
    solution = lsq_linear(
        np.concatenate([root_weight[:, None] * design, np.diag(np.sqrt(prior))]),
        np.concatenate([root_weight * residual, np.zeros(len(prior))]),
        (
            np.concatenate([-unit, -farthest - fit.latent]),
            np.concatenate([1.0 - unit, farthest - fit.latent]),
        ),
    )
    return drawn - explained.T, residual - design @ solution.x


def _free(fit: Fit) -> list[int]:
    """Returns the columns of the material parameters that do not lie on a bound."""
    count = fit.log_posterior.surrogate.space.dim
    return [i for i in range(count) if EVIDENCE.edge < fit.unit[i] < 1.0 - EVIDENCE.edge]


def _slopes(fit: Fit, free: list[int]) -> Array:
    """Returns the derivatives (k, d) [N] of the force by these parameters, over the unit cube."""
    log_posterior = fit.log_posterior
    low, high = log_posterior.bounds
    if not free:
        return np.zeros((len(log_posterior.chain.bins), 0))
    step = np.where(fit.unit[free] < 0.5, FORCE_STEP, -FORCE_STEP)
    moved = fit.unit + step[:, None] * np.eye(len(low))[free]
    points = low + np.concatenate([fit.unit[None], moved]) * (high - low)
    mean = log_posterior.predict_mean(log_posterior.from_sampling(points))[:, log_posterior.chain.bins]
    return np.asarray((mean[1:] - mean[0]).T / step)


def _spans(phase: NDArray[np.int64], shortest: int) -> list[tuple[int, int]]:
    """Returns windows (first, end) inside the phases, where `end` is the bin after the last.

    Their lengths are `shortest` times powers of two, and their starts are half a length apart. Whole phases
    are windows, too.
    """
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase)]
    spans = set()
    for a, b in pairwise(edges):
        length = shortest
        while length < b - a:
            starts = {*range(a, b - length + 1, max(length // 2, 1)), b - length}
            spans |= {(start, start + length) for start in starts}
            length *= 2
        if b - a >= shortest:
            spans.add((a, b))
    return sorted(spans)


def _means(values: Array, a: int, b: int) -> Array:
    """Returns the means (n,) of values (n, k) over a window."""
    return np.asarray(values[:, a:b].mean(axis=1))


def _chosen(spans: list[tuple[int, int]], z: Array, limit: float) -> list[tuple[int, int]]:
    """Returns the most significant windows that do not overlap, in order of time.

    Adjacent windows of the same sign are joined if they lie in the same phase.

    z : mean residual of each window in standard deviations; limit : smallest |z| of a significant window
    """
    chosen: list[tuple[int, int, float]] = []
    for i in np.argsort(-np.abs(z)):
        if abs(z[i]) <= limit:
            break
        a, b = spans[i]
        if all(b <= start or a >= end for start, end, _ in chosen):
            chosen.append((a, b, float(np.sign(z[i]))))
    joined: list[tuple[int, int, float]] = []
    for a, b, sign in sorted(chosen):
        same_sign = bool(joined) and joined[-1][1] == a and joined[-1][2] == sign
        if same_sign and any(start <= joined[-1][0] and b <= end for start, end in spans):
            joined[-1] = (joined[-1][0], b, sign)
        else:
            joined.append((a, b, sign))
    return [(a, b) for a, b, _ in joined]
