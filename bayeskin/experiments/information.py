"""Estimates the information that an experiment is expected to give about which hypothesis is true.

For hypotheses h with probability p(h), and the force y of an experiment, the expected information gain is

    gain = sum_h p(h) E[ log p(h | y) - log p(h) | h ] .

The expectation is over simulated forces. Each simulated force is a posterior draw of the hypothesis plus
noise. p(h | y) needs the density of y under each hypothesis. A dozen draws of hundreds of bins cannot give
this density directly. If the noise is small compared with the spread of the draws, a sum over the draws
depends only on the nearest draw (the bias of nested Monte Carlo: Rainforth et al. 2018, ICML).

Therefore the bins are whitened by the noise and projected on a few directions. These are the linear
discriminants of the draws (Fisher 1936), which separate the hypotheses, and the direction of largest spread.
In these directions the noise is known, and each hypothesis is modelled as Gaussian. Its covariance is shrunk
towards the pooled covariance of all hypotheses (Friedman 1989, JASA 84:165), and the uncertainty of its mean
is included. Posteriors near a Laplace approximation are close to Gaussian in a few projections.

Each draw is judged by densities and projections that are computed without it. For any approximation q(h | y)
from other draws, E log q(h | y) / p(h) is at most the true gain (Barber & Agakov 2003, NIPS; Foster et al.
2019, NeurIPS). Too few draws or a poor projection therefore make the estimate too low, never too high. The
estimate is at least 0.

Densities from a dozen draws are sometimes confident and wrong, and a single such draw costs tens of nats. For
this reason q is a mixture with the prior, which bounds the loss (as weights are bounded: Hesterberg 1995,
Technometrics 37:185). Each half of the draws uses the share of the prior that is best for the other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from bayeskin.errors import InputError
from bayeskin.types import Array


@dataclass(frozen=True)
class GainSettings:
    """Settings of the estimate of an expected information gain.

    fewest : least number of draws of a hypothesis
    replicates : number of noise realisations for each draw
    spread : number of directions of largest spread, in addition to the discriminants
    negligible : share of the largest singular value of the whitened draws below which others are negligible,
        and gain [nats] below which there is none
    doubts : shares of the prior in q that are tried
    """

    fewest: int = 4
    replicates: int = 64
    spread: int = 1
    negligible: float = 1e-9
    doubts: tuple[float, ...] = (1e-4, 0.01, 0.03, 0.1, 0.3, 1.0)


@dataclass(frozen=True)
class Gain:
    """Expected information gain [nats] and its Monte Carlo standard error over the draws [nats].

    `named` is the probability that the true hypothesis is expected to have after the experiment.
    """

    nats: float
    standard_error: float
    named: float


def expected_gain(
    forces_n: Sequence[Array], noise_n2: ArrayLike, probabilities: ArrayLike, seed: int,
    settings: GainSettings = GainSettings(),
) -> Gain:  # fmt: skip
    """Returns the expected gain of an experiment about which hypothesis is true.

    forces_n : for each hypothesis the force without noise (draws, m) [N] at posterior draws, at least 4 draws
    noise_n2 : (m, m) covariance of the noise [N^2]
    probabilities : (hypotheses,) positive prior probabilities on any scale

    Raises InputError for too few draws or hypotheses, or for shapes that do not match.
    """
    noise, prior = np.asarray(noise_n2, dtype=float), np.asarray(probabilities, dtype=float)
    _refuse(forces_n, noise, prior, settings.fewest)
    log_prior = np.log(prior / prior.sum())
    white = _whitened_draws(forces_n, np.linalg.cholesky(noise), settings.negligible)
    rng, replicates = np.random.default_rng(seed), settings.replicates
    of_truth = [np.empty((len(draws), replicates)) for draws in white]  # log p(h | y), where h is true
    for h, draws in enumerate(white):
        for i, draw in enumerate(draws):
            others = [np.delete(rows, i, axis=0) if g == h else rows for g, rows in enumerate(white)]
            axes = _projection_axes(others, np.exp(log_prior), settings.spread)
            seen = (draw + rng.standard_normal((replicates, len(draw)))) @ axes
            of_truth[h][i] = _log_posterior(seen, others, axes, log_prior)[h]
    nats, error2, named = 0.0, 0.0, 0.0
    for log_post, start, share in zip(
        _mixed_with_prior(of_truth, log_prior, settings.doubts), log_prior, np.exp(log_prior), strict=True
    ):
        each = log_post.mean(axis=1) - start
        nats += share * float(each.mean())
        error2 += share**2 * float(each.var(ddof=1)) / len(each)
        named += share * float(np.exp(log_post).mean())
    if nats <= settings.negligible:  # the approximation is no better than the prior
        nats, named = 0.0, float(np.sum(np.exp(2.0 * log_prior)))
    return Gain(nats, float(np.sqrt(error2)), named)


def _mixed_with_prior(of_truth: Sequence[Array], log_prior: Array, doubts: Sequence[float]) -> list[Array]:
    """Returns log q(h | y) from log p(h | y), arrays (draws, replicates) for each hypothesis.

    Every second draw belongs to the same half. Each half uses the share of the prior that makes the mean of
    log q over the other half largest.
    """

    def mixed(log_post: Array, start: float, doubt: float) -> Array:
        with np.errstate(divide="ignore"):
            return np.asarray(np.logaddexp(log_post + np.log1p(-doubt), start + np.log(doubt)))

    log_q = [np.empty_like(log_truth) for log_truth in of_truth]
    for half in (0, 1):
        means = [
            sum(
                np.exp(start) * mixed(log_truth[1 - half :: 2], start, doubt).mean()
                for log_truth, start in zip(of_truth, log_prior, strict=True)
            )
            for doubt in doubts
        ]
        best = doubts[int(np.argmax(means))]
        for log_truth, start, mixture in zip(of_truth, log_prior, log_q, strict=True):
            mixture[half::2] = mixed(log_truth[half::2], start, best)
    return log_q


def _whitened_draws(forces_n: Sequence[Array], root: Array, negligible: float) -> list[Array]:
    """Returns the whitened draws (n, r) of each hypothesis; the covariance of the noise becomes I.

    The coordinates belong to an orthonormal basis of the space of all differences between draws.
    """
    rows = np.concatenate(list(forces_n))
    white = solve_triangular(root, (rows - rows.mean(axis=0)).T, lower=True).T
    left, size, _ = np.linalg.svd(white, full_matrices=False)
    kept = size > negligible * max(size[0], 1e-300)
    kept[0] = True
    inside = left[:, kept] * size[kept]
    return np.split(inside, np.cumsum([len(draws) for draws in forces_n])[:-1])


def _projection_axes(draws: Sequence[Array], prior: Array, spread_count: int) -> Array:
    """Returns the discriminants and the directions of largest spread as orthonormal columns (r, q)."""
    means = np.array([rows.mean(axis=0) for rows in draws])
    within = sum(
        p * np.cov(rows.T, ddof=1).reshape(len(rows.T), -1) for p, rows in zip(prior, draws, strict=True)
    )
    within = np.eye(means.shape[1]) + np.asarray(within)  # covariance of the noise plus that of the draws
    apart = np.sqrt(prior)[:, None] * (means - prior @ means)
    directions = np.linalg.solve(within, apart.T)  # spans Fisher's discriminants; has one vector too many
    left, size, _ = np.linalg.svd(directions, full_matrices=False)
    left = left[:, : len(draws) - 1][:, size[: len(draws) - 1] > 0.0]
    spread = within - left @ (left.T @ within)
    widest = np.linalg.svd(spread)[0][:, :spread_count]
    return np.asarray(np.linalg.qr(np.concatenate([left, widest], axis=1))[0])


def _log_posterior(seen: Array, draws: Sequence[Array], axes: Array, log_prior: Array) -> Array:
    """Returns log p(h | y), (h, s), for noisy forces (s, q) that are projected on the axes."""
    q = axes.shape[1]
    projected = [rows @ axes for rows in draws]
    covariances = [np.cov(rows.T, ddof=1).reshape(q, q) for rows in projected]
    weight = np.array([len(rows) - 1.0 for rows in projected])
    pooled = np.tensordot(weight / weight.sum(), np.array(covariances), axes=1)
    logs = []
    for rows, spread, n, prior in zip(projected, covariances, weight, log_prior, strict=True):
        shrunk = (n * spread + (q + 2.0) * pooled) / (n + q + 2.0)
        root = np.linalg.cholesky(np.eye(q) + (1.0 + 1.0 / len(rows)) * shrunk)
        z = solve_triangular(root, (seen - rows.mean(axis=0)).T, lower=True)
        logs.append(prior - 0.5 * np.sum(z**2, axis=0) - np.sum(np.log(np.diag(root))))
    joint = np.array(logs)
    return np.asarray(joint - logsumexp(joint, axis=0))


def _refuse(forces_n: Sequence[Array], noise: Array, prior: Array, fewest: int) -> None:
    if len(forces_n) < 2 or prior.shape != (len(forces_n),) or not np.all(prior > 0.0):
        raise InputError(
            "hypotheses",
            f"there are {len(forces_n)} with the probabilities {prior}",
            "there must be at least two, each with a probability above 0",
        )
    for h, forces in enumerate(forces_n):
        if forces.ndim != 2 or len(forces) < fewest or forces.shape[1:] != noise.shape[:1]:
            raise InputError(
                f"hypothesis {h}",
                f"its forces have the shape {forces.shape}",
                f"there must be at least {fewest} draws on {len(noise)} bins",
            )
