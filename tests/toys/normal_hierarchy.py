"""Studies whose recordings have normal likelihoods, with the posterior of the population by linear algebra.

Given the covariances of all levels, the coefficients, the recordings' values and the measurements are jointly
normal. The posterior is then an average over covariances: over a fine grid of them, or over draws of their
prior with the marginal likelihood as weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.special import ndtri

from bayeskin.study import Entry, Individual, Priors
from bayeskin.study.layout import Layout
from bayeskin.study.model import Model, State
from bayeskin.types import Array, Parameter, ParameterSpace

MEDIAN, SD = 5e4, 1.5  # of the log-normal prior of every parameter
BOUND = np.exp(6.0 * SD)


def space(dim: int) -> ParameterSpace:
    """Log-normal priors, under which posteriors of normal likelihoods of the logarithm are normal."""
    return ParameterSpace(
        tuple(
            Parameter(f"E_{j}", "Pa", MEDIAN / BOUND, MEDIAN * BOUND, "log-normal", centre=MEDIAN, spread=SD)
            for j in range(dim)
        )
    )


def normal_draws(mean: Array, covariance: Array, count: int = 2000) -> Array:
    """Points (count, d) with exactly this mean (d,) and covariance (d, d), and nearly normal otherwise."""
    rng = np.random.default_rng(0)
    even = ndtri((np.arange(count) + 0.5) / count)
    z = np.column_stack([rng.permutation(even) for _ in mean])
    z -= z.mean(axis=0)
    z = np.linalg.solve(np.linalg.cholesky(np.cov(z.T).reshape(len(mean), -1)), z.T).T
    return mean + z @ np.linalg.cholesky(covariance).T


def individual(name: str, y: Array, covariance: Array) -> Individual:
    """The posterior of a recording that measured y (d,) with a normal error (d, d)."""
    dim = len(y)
    precision = np.linalg.inv(covariance)
    shrunk = np.linalg.inv(precision + np.eye(dim) / SD**2)
    mean = shrunk @ (precision @ y + np.log(MEDIAN) / SD**2)
    return Individual(name, space(dim), np.exp(normal_draws(mean, shrunk)))


def entries(rows: Sequence[tuple[str, ...]], columns: Sequence[str]) -> tuple[Entry, ...]:
    """Rows of a table; the recordings are numbered."""
    return tuple(
        Entry(f"row {n}", Path(f"r{n}.h5"), **dict(zip(columns, row, strict=True)))
        for n, row in enumerate(rows)
    )


@dataclass(frozen=True)
class Exact:
    """The posterior of a population: weighted covariances (s, l, d, d) of each level, the recordings last.

    Given the covariances, the rest z is normal: B, and the effects of all levels. x = design z.
    """

    model: Model
    y: Array
    errors: Array
    covariances: Array
    weights: Array

    @classmethod
    def of(
        cls, table: Sequence[Entry], y: Array, errors: Array, covariances: Array, log_prior: Array
    ) -> Exact:
        """The posterior, given measurements y (N, d) with errors (N, d, d).

        log_prior (s,) : log of the prior weight of the covariances
        """
        low, high = np.log(space(y.shape[1]).lower), np.log(space(y.shape[1]).upper)
        self = cls(
            Model.of(Layout.of(table), (low, high), Priors()), y, errors, covariances, np.ones(len(log_prior))
        )
        parts = np.array_split(covariances, 1 + len(covariances) // 1000)  # of a few megabytes each
        log = log_prior + np.concatenate([self._log_evidences(part) for part in parts])
        weights = np.exp(log - log.max())
        return replace(self, weights=weights / weights.sum())

    @property
    def effective(self) -> float:
        """The effective number of covariances."""
        return float(1.0 / np.sum(self.weights**2))

    def draw(self, count: int, rng: np.random.Generator) -> State:
        """Draws of the posterior, as a state of so many walkers."""
        chosen = rng.choice(len(self.weights), count, p=self.weights)
        errors = rng.multivariate_normal(np.zeros(len(self._error)), self._error, count)
        z = np.array([self._draw(self.covariances[s], e, rng) for s, e in zip(chosen, errors, strict=True)])
        layout, dim = self.model.layout, self.y.shape[1]
        ends = np.cumsum([dim * unit.shape[1] for unit in self._units])
        parts = [part.reshape(count, -1, dim) for part in np.split(z, ends[:-1], axis=1)]
        values = list(parts[1:-1])
        for at in range(1, len(values)):
            values[at] = values[at] + values[at - 1][:, layout.levels[at].parent]
        x = (z @ self._design.T).reshape(count, *self.y.shape)
        covariances = tuple(np.moveaxis(self.covariances[chosen], 1, 0))
        return State(x, np.zeros(x.shape[:2]), parts[0], tuple(values), covariances)

    @cached_property
    def _units(self) -> list[Array]:
        """The matrices (N, n) of the layout, and of the units of each level."""
        levels = self.model.layout.levels
        of_levels = [(level.unit[:, None] == np.arange(len(level.parent))).astype(float) for level in levels]
        return [self.model.layout.matrix, *of_levels, np.eye(len(self.y))]

    @cached_property
    def _design(self) -> Array:
        return np.kron(np.hstack(self._units), np.eye(self.y.shape[1]))

    @cached_property
    def _error(self) -> Array:
        n, dim = self.y.shape
        error = np.zeros((n, dim, n, dim))
        error[range(n), :, range(n), :] = self.errors
        return error.reshape(n * dim, n * dim)

    @property
    def _mean(self) -> Array:
        """Mean of z under the prior."""
        mean = np.zeros(self._design.shape[1])
        mean[: self.model.centre.size] = self.model.centre.ravel()
        return mean

    def _log_evidences(self, covariances: Array) -> Array:
        """Logs of the marginal likelihoods (s,), up to a constant, at covariances (s, l, d, d)."""
        size = self.y.size
        known = self._design[:, : self.model.sd.size] * self.model.sd.ravel()
        shared = np.array([unit @ unit.T for unit in self._units[1:]])
        levels = np.einsum("lab,slij->saibj", shared, covariances).reshape(-1, size, size)
        marginal = levels + known @ known.T + self._error
        away = self.y.ravel() - self._design @ self._mean
        distances = np.linalg.solve(marginal, np.broadcast_to(away, (len(levels), size))[..., None])[..., 0]
        return np.asarray(-0.5 * (np.linalg.slogdet(marginal)[1] + distances @ away))

    def _draw(self, levels: Array, error: Array, rng: np.random.Generator) -> Array:
        """A draw of z: a draw of the prior, corrected by the measurement that it would not have given.

        error (N d,) : a draw of the errors of measurement
        """
        blocks = [np.diag(self.model.sd.ravel() ** 2)]
        blocks += [
            np.kron(np.eye(unit.shape[1]), level) for unit, level in zip(self._units[1:], levels, strict=True)
        ]
        prior = block_diag(*blocks)
        z = self._mean + np.linalg.cholesky(prior) @ rng.standard_normal(len(prior))
        away = self.y.ravel() - self._design @ z - error
        covariance = self._design @ prior @ self._design.T + self._error
        return z + prior @ self._design.T @ np.linalg.solve(covariance, away)


def grid(levels: int, count: int) -> tuple[Array, Array]:
    """Covariances (s, levels, 1, 1) of one parameter on a grid of log sds, with the log of their prior."""
    priors = Priors()
    log_sd = np.linspace(np.log(1e-3), np.log(10.0), count)
    density = log_sd - 0.5 * (priors.freedom + 1.0) * np.log1p(
        (np.exp(log_sd) / priors.spread_scale) ** 2 / priors.freedom
    )
    points = np.stack(np.meshgrid(*[log_sd] * levels, indexing="ij"), axis=-1).reshape(-1, levels)
    log_prior = sum(np.meshgrid(*[density] * levels, indexing="ij")).ravel()
    return np.exp(2.0 * points)[:, :, None, None], log_prior


def prior_draws(levels: int, count: int, rng: np.random.Generator) -> Array:
    """Covariances (count, levels, 2, 2) of two parameters from their prior, by its definition.

    The correlation of two parameters has a beta distribution, stretched to the range from -1 to 1.
    """
    priors = Priors()
    sds = priors.spread_scale * np.abs(rng.standard_t(priors.freedom, (count, levels, 2)))
    tie = np.ones((count, levels, 2, 2))
    shape = priors.correlation_shape
    tie[..., 0, 1] = tie[..., 1, 0] = 2.0 * rng.beta(shape, shape, (count, levels)) - 1.0
    return sds[..., None] * tie * sds[..., None, :]
