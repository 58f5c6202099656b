"""Distributions that moves propose points from: mixtures of t-distributions, fitted to draws.

A posterior may be a thin, curved ridge or lie in several parts; a mixture follows it piece by piece. A poor
fit costs speed, never correctness, since the acceptance of a point knows the density that it is drawn from.
Expectation maximisation for t: McLachlan & Peel (1998), Lecture Notes in Computer Science 1451:658.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from bayeskin.types import Array, _FreezesArrays

_FREEDOM = 5.0  # of the t-distributions: tails that reach where no draw has been yet
_COMPONENTS, _ROUNDS = 24, 15  # at most; of expectation maximisation
_PRIOR = 5.0  # draws a coordinate that the prior on a component's spread is worth
_FIRST, _NARROW = 0.1, 0.005  # of the covariance of all draws: the spread at first, and a priori


@dataclass(frozen=True)
class Mixture(_FreezesArrays):
    """t-distributions with weights (k,), centres (k, d) and Cholesky factors (k, d, d) of their spreads."""

    weights: Array
    centres: Array
    roots: Array

    @classmethod
    def around(cls, points: Array) -> Mixture:
        """One t-distribution with the mean and covariance of points (n, d), correlations shrunk where few."""
        count, dim = points.shape
        spread = np.cov(points.T)
        own = np.diag(spread.diagonal())
        spread = (count * spread + dim * own) / (count + dim) + 1e-10 * np.eye(dim)
        return cls(np.ones(1), points.mean(axis=0)[None], np.linalg.cholesky(spread)[None])

    @classmethod
    def of(cls, points: Array, rng: np.random.Generator) -> Mixture:
        """Fitted to points (n, d); components begin at some of them, and go where few are left to them."""
        count, dim = points.shape
        spread = np.atleast_2d(np.cov(points.T)) + 1e-9 * np.eye(dim)
        start = rng.choice(count, min(_COMPONENTS, count // (2 * dim) + 1), replace=False)
        roots = np.repeat(np.linalg.cholesky(_FIRST * spread)[None], len(start), axis=0)
        found = cls(np.full(len(start), 1.0 / len(start)), points[start], roots)
        for _ in range(_ROUNDS):
            found = found._maximised(points, _PRIOR * dim, _NARROW * spread)
        return found

    def _maximised(self, points: Array, prior: float, narrow: Array) -> Mixture:
        """One round of expectation maximisation, with a prior of so many draws on each spread."""
        dim = points.shape[1]
        squared = self._squared(points)
        log = self._log_densities(squared)
        share = np.exp(log - logsumexp(log, axis=1, keepdims=True))
        size = share.sum(axis=0)
        kept = size >= min(dim, size.max())
        share, size = share[:, kept], size[kept]
        pull = share * (_FREEDOM + dim) / (_FREEDOM + squared[:, kept])
        centres = (pull.T @ points) / pull.sum(axis=0)[:, None]
        apart = [points - centre for centre in centres]
        spreads = np.stack([(one * pull[:, k, None]).T @ one for k, one in enumerate(apart)])
        spreads = (spreads + prior * narrow) / (size + prior)[:, None, None]
        return Mixture(size / size.sum(), centres, np.linalg.cholesky(spreads))

    def draw(self, count: int, random: np.random.RandomState) -> Array:
        """Points (count, d)."""
        which = random.choice(len(self.weights), count, p=self.weights)
        size = np.sqrt(random.chisquare(_FREEDOM, (count, 1)) / _FREEDOM)
        normal = random.standard_normal((count, self.centres.shape[1])) / size
        return np.asarray(self.centres[which] + np.einsum("nij,nj->ni", self.roots[which], normal))

    def log_density(self, points: Array) -> Array:
        """At points (n, d), (n,)."""
        return np.asarray(logsumexp(self._log_densities(self._squared(points)), axis=1))

    def _squared(self, points: Array) -> Array:
        """Squared distances (n, k) from the centres, in each component's own measure."""
        inverses = np.linalg.inv(self.roots)
        away = [(points - centre) @ root.T for centre, root in zip(self.centres, inverses, strict=True)]
        return np.stack([np.einsum("nd,nd->n", one, one) for one in away], axis=1)

    def _log_densities(self, squared: Array) -> Array:
        """Returns log densities of the components times their weights (n, k)."""
        dim = self.centres.shape[1]
        sizes = np.log(np.diagonal(self.roots, axis1=1, axis2=2)).sum(axis=1)
        norm = (
            gammaln(0.5 * (_FREEDOM + dim)) - gammaln(0.5 * _FREEDOM) - 0.5 * dim * np.log(_FREEDOM * np.pi)
        )
        bend = 0.5 * (_FREEDOM + dim) * np.log1p(squared / _FREEDOM)
        return np.asarray(np.log(self.weights) - sizes + norm - bend)


@dataclass(frozen=True)
class Product:
    """Independent mixtures, each of the coordinates in its `columns`.

    Fewer draws tell mixtures of blocks that hardly depend on each other than one mixture of all of them.
    """

    columns: tuple[slice, ...]
    mixtures: tuple[Mixture, ...]

    @classmethod
    def of(cls, points: Array, columns: Sequence[slice], rng: np.random.Generator) -> Product:
        """Fitted to points (n, D)."""
        return cls(tuple(columns), tuple(Mixture.of(points[:, block], rng) for block in columns))

    def draw(self, count: int, random: np.random.RandomState) -> Array:
        """Points (count, D)."""
        return np.concatenate([mixture.draw(count, random) for mixture in self.mixtures], axis=1)

    def log_density(self, points: Array) -> Array:
        """At points (n, D), (n,)."""
        parts = zip(self.columns, self.mixtures, strict=True)
        return np.sum([mixture.log_density(points[:, block]) for block, mixture in parts], axis=0)
