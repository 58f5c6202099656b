"""How much an experiment is expected to say about which of several hypotheses is true.

With hypotheses h of probability p(h), and the force y of an experiment,

    gain = sum_h p(h) E[ log p(h | y) - log p(h) | h ] .

The expectation is over simulated forces: a posterior draw of the hypothesis, with noise added. p(h | y) needs
each hypothesis' density of y, which a dozen draws of hundreds of bins cannot give: with noise small beside
the spread of draws, a sum over them sees only the nearest (the bias of nested Monte Carlo: Rainforth et al.
2018, ICML). So bins are whitened by the noise and projected on what tells the hypotheses apart, linear
discriminants of the draws (Fisher 1936), and on the direction of largest spread; there the noise is known and
each hypothesis is taken as Gaussian, its spread drawn toward that of all (Friedman 1989, JASA 84:165), its
mean's uncertainty included. Posteriors near a Laplace approximation are close to Gaussian in a few
projections.

A draw is judged by densities and projections made without it. For any approximation q(h | y) made from other
draws, E log q(h | y) / p(h) is at most the true gain (Barber & Agakov 2003, NIPS; Foster et al. 2019,
NeurIPS), so too few draws or a poor projection make the estimate too low, never too high. It is 0 at least.
Densities from a dozen draws are at times sure and wrong, which one draw pays for with tens of nats. So q is a
mixture with the prior, which bounds that (as weights are bounded: Hesterberg 1995, Technometrics 37:185); the
prior's share is what serves the other half of the draws best.
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

FEWEST = 4  # draws of a hypothesis
REPLICATES = 64  # of the noise, a draw
SPREAD = 1  # directions of largest spread, beside the discriminants
NEGLIGIBLE = 1e-9  # singular value of whitened draws, of the largest; gain
DOUBTS = (1e-4, 0.01, 0.03, 0.1, 0.3, 1.0)  # shares of the prior in q


@dataclass(frozen=True)
class Gain:
    """Expected gain [nats] and its Monte-Carlo standard error over draws.

    named: the probability that the true hypothesis is expected to have after the experiment.
    """

    nats: float
    standard_error: float
    named: float


def expected_gain(
    forces_n: Sequence[Array], noise_n2: ArrayLike, probabilities: ArrayLike, seed: int
) -> Gain:
    """Of an experiment, about which hypothesis is true.

    forces_n : for each hypothesis (draws, m), its force without noise at posterior draws, at least 4
    noise_n2 : (m, m) covariance of the noise
    probabilities : (hypotheses,), any positive scale
    Raises InputError for too few draws or hypotheses, or shapes that do not belong together.
    """
    noise, prior = np.asarray(noise_n2, dtype=float), np.asarray(probabilities, dtype=float)
    _refuse(forces_n, noise, prior)
    log_prior = np.log(prior / prior.sum())
    white = _compressed(forces_n, np.linalg.cholesky(noise))
    rng = np.random.default_rng(seed)
    of_truth = [np.empty((len(draws), REPLICATES)) for draws in white]  # log p(h | y), where h is true
    for h, draws in enumerate(white):
        for i, draw in enumerate(draws):
            others = [np.delete(one, i, axis=0) if g == h else one for g, one in enumerate(white)]
            axes = _axes(others, np.exp(log_prior))
            seen = (draw + rng.standard_normal((REPLICATES, len(draw)))) @ axes
            of_truth[h][i] = _log_posterior(seen, others, axes, log_prior)[h]
    nats, error2, named = 0.0, 0.0, 0.0
    for log_post, start, share in zip(
        _doubted(of_truth, log_prior), log_prior, np.exp(log_prior), strict=True
    ):
        each = log_post.mean(axis=1) - start
        nats += share * float(each.mean())
        error2 += share**2 * float(each.var(ddof=1)) / len(each)
        named += share * float(np.exp(log_post).mean())
    if nats <= NEGLIGIBLE:  # the approximation is no better than what is known already
        nats, named = 0.0, float(np.sum(np.exp(2.0 * log_prior)))
    return Gain(nats, float(np.sqrt(error2)), named)


def _doubted(of_truth: Sequence[Array], log_prior: Array) -> list[Array]:
    """log q(h | y) of log p(h | y), (draws, replicates) each.

    Every second draw's has the share of the prior that makes the mean of the others largest.
    """

    def mixed(log_post: Array, start: float, doubt: float) -> Array:
        with np.errstate(divide="ignore"):
            return np.asarray(np.logaddexp(log_post + np.log1p(-doubt), start + np.log(doubt)))

    found = [np.empty_like(one) for one in of_truth]
    for half in (0, 1):
        means = [
            sum(
                np.exp(start) * mixed(one[1 - half :: 2], start, doubt).mean()
                for one, start in zip(of_truth, log_prior, strict=True)
            )
            for doubt in DOUBTS
        ]
        best = DOUBTS[int(np.argmax(means))]
        for one, start, into in zip(of_truth, log_prior, found, strict=True):
            into[half::2] = mixed(one[half::2], start, best)
    return found


def _compressed(forces_n: Sequence[Array], root: Array) -> list[Array]:
    """Whitened draws (n, r) in an orthonormal basis of all that any two draws differ by; noise is I there."""
    rows = np.concatenate(list(forces_n))
    white = solve_triangular(root, (rows - rows.mean(axis=0)).T, lower=True).T
    left, size, _ = np.linalg.svd(white, full_matrices=False)
    kept = size > NEGLIGIBLE * max(size[0], 1e-300)
    kept[0] = True
    inside = left[:, kept] * size[kept]
    return np.split(inside, np.cumsum([len(one) for one in forces_n])[:-1])


def _axes(draws: Sequence[Array], prior: Array) -> Array:
    """Discriminants and directions of largest spread, orthonormal columns (r, q)."""
    means = np.array([one.mean(axis=0) for one in draws])
    within = sum(
        p * np.cov(one.T, ddof=1).reshape(len(one.T), -1) for p, one in zip(prior, draws, strict=True)
    )
    within = np.eye(means.shape[1]) + np.asarray(within)  # the noise's and the draws' spread
    apart = np.sqrt(prior)[:, None] * (means - prior @ means)
    directions = np.linalg.solve(within, apart.T)  # spans Fisher's discriminants, one too many
    left, size, _ = np.linalg.svd(directions, full_matrices=False)
    left = left[:, : len(draws) - 1][:, size[: len(draws) - 1] > 0.0]
    spread = within - left @ (left.T @ within)
    widest = np.linalg.svd(spread)[0][:, :SPREAD]
    return np.asarray(np.linalg.qr(np.concatenate([left, widest], axis=1))[0])


def _log_posterior(seen: Array, draws: Sequence[Array], axes: Array, log_prior: Array) -> Array:
    """log p(h | y) (h, s) of noisy forces (s, q) on the axes."""
    q = axes.shape[1]
    projected = [one @ axes for one in draws]
    own = [np.cov(one.T, ddof=1).reshape(q, q) for one in projected]
    weight = np.array([len(one) - 1.0 for one in projected])
    pooled = np.tensordot(weight / weight.sum(), np.array(own), axes=1)
    logs = []
    for one, spread, n, prior in zip(projected, own, weight, log_prior, strict=True):
        drawn = (n * spread + (q + 2.0) * pooled) / (n + q + 2.0)
        root = np.linalg.cholesky(np.eye(q) + (1.0 + 1.0 / len(one)) * drawn)
        z = solve_triangular(root, (seen - one.mean(axis=0)).T, lower=True)
        logs.append(prior - 0.5 * np.sum(z**2, axis=0) - np.sum(np.log(np.diag(root))))
    joint = np.array(logs)
    return np.asarray(joint - logsumexp(joint, axis=0))


def _refuse(forces_n: Sequence[Array], noise: Array, prior: Array) -> None:
    if len(forces_n) < 2 or prior.shape != (len(forces_n),) or not np.all(prior > 0.0):
        raise InputError(
            "hypotheses",
            f"{len(forces_n)} with probabilities {prior}",
            "two at least, each probability above 0",
        )
    for h, forces in enumerate(forces_n):
        if forces.ndim != 2 or len(forces) < FEWEST or forces.shape[1:] != noise.shape[:1]:
            raise InputError(
                f"hypothesis {h}",
                f"forces of shape {forces.shape}",
                f"{FEWEST} draws on {len(noise)} bins at least",
            )
