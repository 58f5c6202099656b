"""A mixture of normal distributions, fitted to points by expectation maximisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayeskin.types import Array, FreezesArrays

_NO_SHARE = 1e-14  # added to the shares of a component, so that an empty one has a centre
_ROUNDS_OF_MEANS = 30


@dataclass(frozen=True)
class MixtureSettings:
    """Settings of the mixture that is fitted to the draws of a recording's posterior.

    most_draws : largest number of draws that it is fitted to
    components : numbers of components that are tried after one, in this order
    patience : how many of these numbers may be worse in succession before the search ends
    rounds, gain : expectation maximisation ends after `rounds` rounds, or when one gains less than `gain`
        per draw [nats]
    narrowest : smallest variance of a component, as a share of the variance of all draws
    """

    most_draws: int = 2000
    components: tuple[int, ...] = (2, 3, 4, 6, 8, 12, 16, 24)
    patience: int = 2
    rounds: int = 200
    gain: float = 1e-4
    narrowest: float = 1e-6


@dataclass(frozen=True)
class NormalMixture(FreezesArrays):
    """A mixture of k normal distributions: log_weights (k,), centres (k, d), and whiten (k, d, d).

    `whiten` turns differences from a component's centre into independent unit normals.
    """

    log_weights: Array
    centres: Array
    whiten: Array

    @classmethod
    def of(
        cls, points: Array, rng: np.random.Generator, settings: MixtureSettings = MixtureSettings()
    ) -> NormalMixture:
        """Returns the mixture fitted to points (n, d), with as many components as the criterion favours."""
        centre, spread = points.mean(axis=0), np.atleast_2d(np.cov(points.T))
        root = np.linalg.cholesky(spread + settings.narrowest * np.diag(spread.diagonal()))
        white = np.linalg.solve(root, (points - centre).T).T
        best, lowest = cls._fitted(white, 1, rng, settings)
        worse = 0
        for count in settings.components:
            mixture, criterion = cls._fitted(white, count, rng, settings)
            worse = 0 if criterion < lowest else worse + 1
            if not worse:
                best, lowest = mixture, criterion
            elif worse == settings.patience:
                break
        return cls(best.log_weights, centre + best.centres @ root.T, best.whiten @ np.linalg.inv(root))

    @classmethod
    def _fitted(
        cls, points: Array, count: int, rng: np.random.Generator, settings: MixtureSettings
    ) -> tuple[NormalMixture, float]:
        """Returns a mixture of `count` components, fitted by expectation maximisation, and its criterion."""
        (n, dim), likelihood = points.shape, -np.inf
        shares = _starting_shares(points, count, rng)
        for _ in range(settings.rounds):
            mixture = cls._weighted(points, shares, settings.narrowest)
            parts = mixture.log_parts(points)
            densities = logsumexp(parts, axis=1)
            before, likelihood = likelihood, float(densities.mean())
            if likelihood - before < settings.gain:
                break
            shares = np.exp(parts - densities[:, None])
        numbers = count * (1 + dim + dim * (dim + 1) // 2) - 1
        return mixture, numbers * float(np.log(n)) - 2.0 * n * likelihood

    @classmethod
    def _weighted(cls, points: Array, shares: Array, narrowest: float) -> NormalMixture:
        """Returns the mixture in which each component has its shares (n, k) of points (n, d)."""
        totals = shares.sum(axis=0) + _NO_SHARE
        centres = shares.T @ points / totals[:, None]
        away = points - centres[:, None]
        covariances = np.einsum("nk,kni,knj->kij", shares, away, away, optimize=True) / totals[:, None, None]
        whiten = np.linalg.inv(np.linalg.cholesky(covariances + narrowest * np.eye(points.shape[1])))
        return cls(np.log(totals / totals.sum()), centres, whiten)

    def log_parts(self, points: Array) -> Array:
        """Returns the log density (n, k) of each component at points (n, d), with its weight."""
        white = np.einsum("kij,knj->kni", self.whiten, points - self.centres[:, None], optimize=True)
        volumes = np.linalg.slogdet(self.whiten)[1] - 0.5 * points.shape[1] * np.log(2.0 * np.pi)
        return np.asarray((self.log_weights + volumes) - 0.5 * np.sum(white**2, axis=2).T)


def _starting_shares(points: Array, count: int, rng: np.random.Generator) -> Array:
    """Returns the shares (n, count) with which a fit starts: of points (n, d), by their nearest centre.

    The centres are points that are chosen with chances in proportion to the squared distance from those
    before (Arthur & Vassilvitskii 2007), and then moved by a few rounds of k-means.
    """
    centres = points[rng.integers(len(points))][None]
    while len(centres) < count:
        squares = _squares(points, centres).min(axis=1)
        centres = np.concatenate([centres, points[rng.choice(len(points), p=squares / squares.sum())][None]])
    for _ in range(_ROUNDS_OF_MEANS):
        shares = np.eye(count)[_squares(points, centres).argmin(axis=1)]
        totals = shares.sum(axis=0)[:, None]
        centres = np.where(totals > 0.0, shares.T @ points / np.maximum(totals, 1.0), centres)
    return np.asarray(shares)


def _squares(points: Array, centres: Array) -> Array:
    """Returns the squared distances (n, k) of points (n, d) from centres (k, d)."""
    return np.asarray(np.sum((points[:, None] - centres) ** 2, axis=2))
