"""Distributions from which moves propose points: mixtures of t-distributions, fitted to draws.

A posterior may be a thin, curved ridge or lie in several parts; a mixture follows it piece by piece. A poor
fit costs speed, never correctness, since the acceptance of a point accounts for the density from which it is
drawn. Source of expectation maximisation for t-distributions: McLachlan & Peel (1998), Lecture Notes in
Computer Science 1451:658.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from bayeskin.types import Array, FreezesArrays


@dataclass(frozen=True)
class MixtureSettings:
    """Settings of a mixture of t-distributions and of its fit to draws.

    freedom : degrees of freedom of the t-distributions, whose tails reach where no draw has been yet
    components : largest number of components
    rounds : number of rounds of expectation maximisation
    prior : weight of the prior on a component's spread, in draws for each coordinate
    first, narrow : spread at the start and in the prior, as shares of the covariance of all draws
    """

    freedom: float = 5.0
    components: int = 24
    rounds: int = 15
    prior: float = 5.0
    first: float = 0.1
    narrow: float = 0.005


MIXTURE = MixtureSettings()


@dataclass(frozen=True)
class Mixture(FreezesArrays):
    """Mixture of t-distributions: weights (k,), centres (k, d), Cholesky factors (k, d, d) of the spreads."""

    weights: Array
    centres: Array
    roots: Array

    @classmethod
    def around(cls, points: Array) -> Mixture:
        """Returns one t-distribution with the mean and covariance of points (n, d).

        Correlations are shrunk where the points are few.
        """
        count, dim = points.shape
        spread = np.cov(points.T)
        variances = np.diag(spread.diagonal())
        spread = (count * spread + dim * variances) / (count + dim) + 1e-10 * np.eye(dim)
        return cls(np.ones(1), points.mean(axis=0)[None], np.linalg.cholesky(spread)[None])

    @classmethod
    def of(cls, points: Array, rng: np.random.Generator) -> Mixture:
        """Returns a mixture fitted to points (n, d).

        Components start at some of the points. A component is removed where few points are left to it.
        """
        count, dim = points.shape
        spread = np.atleast_2d(np.cov(points.T)) + 1e-9 * np.eye(dim)
        start = rng.choice(count, min(MIXTURE.components, count // (2 * dim) + 1), replace=False)
        roots = np.repeat(np.linalg.cholesky(MIXTURE.first * spread)[None], len(start), axis=0)
        mixture = cls(np.full(len(start), 1.0 / len(start)), points[start], roots)
        for _ in range(MIXTURE.rounds):
            mixture = mixture._maximised(points, MIXTURE.prior * dim, MIXTURE.narrow * spread)
        return mixture

    def _maximised(self, points: Array, prior: float, narrow: Array) -> Mixture:
        """Returns the mixture after one round of expectation maximisation.

        prior : weight of the prior on each spread, in draws; narrow (d, d) : the spread of this prior
        """
        dim = points.shape[1]
        squared = self._squared(points)
        log = self._log_densities(squared)
        share = np.exp(log - logsumexp(log, axis=1, keepdims=True))
        size = share.sum(axis=0)
        kept = size >= min(dim, size.max())
        share, size = share[:, kept], size[kept]
        pull = share * (MIXTURE.freedom + dim) / (MIXTURE.freedom + squared[:, kept])
        centres = (pull.T @ points) / pull.sum(axis=0)[:, None]
        differences = [points - centre for centre in centres]
        spreads = np.stack([(away * pull[:, k, None]).T @ away for k, away in enumerate(differences)])
        spreads = (spreads + prior * narrow) / (size + prior)[:, None, None]
        return Mixture(size / size.sum(), centres, np.linalg.cholesky(spreads))

    def draw(self, count: int, random: np.random.RandomState) -> Array:
        """Returns points (count, d) drawn from the mixture."""
        component = random.choice(len(self.weights), count, p=self.weights)
        size = np.sqrt(random.chisquare(MIXTURE.freedom, (count, 1)) / MIXTURE.freedom)
        normal = random.standard_normal((count, self.centres.shape[1])) / size
        return np.asarray(self.centres[component] + np.einsum("nij,nj->ni", self.roots[component], normal))

    def log_density(self, points: Array) -> Array:
        """Returns the log density (n,) at points (n, d)."""
        return np.asarray(logsumexp(self._log_densities(self._squared(points)), axis=1))

    def _squared(self, points: Array) -> Array:
        """Returns squared distances (n, k) from the centres, in each component's own measure."""
        inverses = np.linalg.inv(self.roots)
        scaled = [(points - centre) @ root.T for centre, root in zip(self.centres, inverses, strict=True)]
        return np.stack([np.einsum("nd,nd->n", away, away) for away in scaled], axis=1)

    def _log_densities(self, squared: Array) -> Array:
        """Returns the log (n, k) of the components' densities times their weights."""
        dim, nu = self.centres.shape[1], MIXTURE.freedom
        sizes = np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        norm = gammaln(0.5 * (nu + dim)) - gammaln(0.5 * nu) - 0.5 * dim * np.log(nu * np.pi)
        bend = 0.5 * (nu + dim) * np.log1p(squared / nu)
        return np.asarray(np.log(self.weights) - sizes + norm - bend)


@dataclass(frozen=True)
class Product:
    """Independent mixtures, each for the block of coordinates in its `columns`.

    Where blocks hardly depend on each other, their mixtures need fewer draws than one mixture of all
    coordinates.
    """

    columns: tuple[slice, ...]
    mixtures: tuple[Mixture, ...]

    @classmethod
    def of(cls, points: Array, columns: Sequence[slice], rng: np.random.Generator) -> Product:
        """Returns mixtures fitted to the blocks of points (n, D)."""
        return cls(tuple(columns), tuple(Mixture.of(points[:, block], rng) for block in columns))

    def draw(self, count: int, random: np.random.RandomState) -> Array:
        """Returns points (count, D) drawn from the product."""
        return np.concatenate([mixture.draw(count, random) for mixture in self.mixtures], axis=1)

    def log_density(self, points: Array) -> Array:
        """Returns the log density (n,) at points (n, D)."""
        parts = zip(self.columns, self.mixtures, strict=True)
        return np.sum([mixture.log_density(points[:, block]) for block, mixture in parts], axis=0)
