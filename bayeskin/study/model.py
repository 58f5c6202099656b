"""The hierarchical model of a population: its parameters, its priors and its density.

Let x be the natural logarithms of the d parameters of a recording. Then

    x = (row of the layout's matrix) B + effect of the subject + effect of the session + own effect,

where the effects of each level are normal with mean zero and a covariance of their own. The levels are those
of the layout, and the recordings are the last level. The value of a unit is its effect and the effects of the
units to which it belongs, so that members scatter around the value of their unit.

The sds of each level are independent of each other and of their correlations. The correlations have the prior
of Lewandowski, Kurowicka & Joe (2009, Journal of Multivariate Analysis 100:1989), in which the determinant of
their matrix enters to a power. All functions serve m walkers at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayeskin.study.layout import Layout, Units
from bayeskin.types import Array

Walkers = NDArray[np.int64]


@dataclass(frozen=True)
class Priors:
    """The weakly informative priors of a population, on natural logarithms.

    ratio_sd : sd of the logarithm of the ratio of two groups' or sites' medians, which is normal around 0
    spread_scale, freedom : scale and degrees of freedom of the half-t prior of each level's sds
    correlation_shape : power of the determinant of the correlations, less one; with 1 all matrices of
        correlations are equally likely, and with more small correlations are likelier

    The median of the reference group is normal around the middle of the bounds of the recordings' priors (on
    logarithms), with half the distance of the bounds as sd.
    """

    ratio_sd: float = 2.0
    spread_scale: float = 0.5
    freedom: float = 3.0
    correlation_shape: float = 2.0


@dataclass(frozen=True)
class State:
    """The parameters of m walkers.

    x (m, N, d) : logarithms of the recordings' parameters; log_likelihood (m, N) : of the recordings at x
    coefficients (m, p, d) : B
    values (m, n, d) : of the units of each level above the recordings
    covariances (m, d, d) : of each level, the recordings last
    """

    x: Array
    log_likelihood: Array
    coefficients: Array
    values: tuple[Array, ...]
    covariances: tuple[Array, ...]

    def taken(self, walkers: Walkers) -> State:
        """Returns the state of some walkers (k,)."""
        return self._made(lambda own: own[walkers], self)

    def put(self, walkers: Walkers, part: State) -> State:
        """Returns the state in which these walkers (k,) have the state `part`."""

        def written(own: Array, new: Array) -> Array:
            out = own.copy()
            out[walkers] = new
            return out

        return self._made(written, self, part)

    def chosen(self, other: State, choice: NDArray[np.bool_]) -> State:
        """Returns the state that is `other` for the walkers with True in choice (m,)."""

        def choose(own: Array, new: Array) -> Array:
            return np.where(choice.reshape(-1, *(1,) * (own.ndim - 1)), new, own)

        return self._made(choose, self, other)

    @classmethod
    def joined(cls, states: Sequence[State]) -> State:
        """Returns the state of the walkers of several states."""
        return cls._made(lambda *parts: np.concatenate(parts), *states)

    @classmethod
    def _made(cls, function: Callable[..., Array], *states: State) -> State:
        """Returns the state whose arrays are a function of the same arrays of other states."""

        def of(name: str) -> Array:
            return function(*(getattr(state, name) for state in states))

        def of_levels(name: str) -> tuple[Array, ...]:
            return tuple(map(function, *(getattr(state, name) for state in states)))

        return cls(
            of("x"), of("log_likelihood"), of("coefficients"), of_levels("values"), of_levels("covariances")
        )


@dataclass(frozen=True)
class Model:
    """The layout of a study with the priors of its population; centre, sd (p, d) : of the prior of B."""

    layout: Layout
    priors: Priors
    centre: Array
    sd: Array

    @classmethod
    def of(cls, layout: Layout, bounds: tuple[Array, Array], priors: Priors) -> Model:
        """Returns the model of recordings whose priors have these lower and upper bounds (d,) of x."""
        low, high = bounds
        shape = (layout.matrix.shape[1], len(low))
        centre, sd = np.zeros(shape), np.full(shape, priors.ratio_sd)
        centre[0], sd[0] = 0.5 * (low + high), 0.5 * (high - low)
        return cls(layout, priors, centre, sd)

    def parents(self, state: State) -> tuple[Array, ...]:
        """Returns for each level, the recordings last, the values around which its units scatter."""
        out: list[Array] = []
        for level, values in zip(self.layout.levels, state.values, strict=True):
            out.append(state.values[len(out) - 1][:, level.parent] if out else np.zeros_like(values))
        return (*out, self.layout.matrix @ state.coefficients + self.above(state))

    def above(self, state: State) -> Array:
        """Returns the value (m, N, d) of the unit to which each recording belongs, or zeros."""
        if not state.values:
            return np.zeros_like(state.x)
        return state.values[-1][:, self.layout.levels[-1].unit]

    def effects(self, state: State) -> tuple[Array, ...]:
        """Returns the effects (m, n, d) of each level, the recordings last."""
        own = (*state.values, state.x)
        return tuple(value - parent for value, parent in zip(own, self.parents(state), strict=True))

    def shifted(self, state: State, level: int, shift: Array) -> State:
        """Returns the state with the units of a level moved by (m, n, d), and all their members with them.

        The log-likelihoods are left as they were.
        """
        levels = self.layout.levels
        if level == len(levels):
            return replace(state, x=state.x + shift)
        values = list(state.values)
        for lower in range(level, len(levels)):
            values[lower] = values[lower] + shift[:, self.layout.ancestors(lower, level)]
        return replace(state, x=state.x + shift[:, levels[level].unit], values=tuple(values))

    def log_prior_of_coefficients(self, coefficients: Array) -> Array:
        """Returns the log density (m,) of B (m, p, d), up to a constant."""
        return -0.5 * np.sum(((coefficients - self.centre) / self.sd) ** 2, axis=(1, 2))

    def log_prior_of_covariance(self, covariance: Array) -> Array:
        """Returns the log density (m,), up to a constant, of the covariances (m, d, d) of a level.

        In the volume of covariances, the sds and correlations take the d-th power of the product of the sds.
        """
        freedom, dim = self.priors.freedom, covariance.shape[1]
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        log_sds = 0.5 * np.log(variances).sum(axis=1)
        half_t = np.log1p(variances / (freedom * self.priors.spread_scale**2)).sum(axis=1)
        correlations = np.linalg.slogdet(covariance)[1] - 2.0 * log_sds
        return (
            -0.5 * (freedom + 1.0) * half_t
            + (self.priors.correlation_shape - 1.0) * correlations
            - dim * log_sds
        )

    def log_density(self, state: State) -> Array:
        """Returns the log density (m,) of the states, up to a constant."""
        out = state.log_likelihood.sum(axis=1) + self.log_prior_of_coefficients(state.coefficients)
        for effects, covariance in zip(self.effects(state), state.covariances, strict=True):
            out += log_normal(effects, covariance).sum(axis=1) + self.log_prior_of_covariance(covariance)
        return out


def log_normal(effects: Array, covariance: Array) -> Array:
    """Returns the log density (m, n), up to a constant, of effects (m, n, d) with covariances (m, d, d)."""
    squared = np.sum((effects @ np.linalg.inv(covariance)) * effects, axis=2)
    return -0.5 * (squared + np.linalg.slogdet(covariance)[1][:, None])


def sums(values: Array, unit: Units, count: int) -> Array:
    """Returns the sums (m, count, ...) of values (m, n, ...) over the members of each of `count` units."""
    members = (unit == np.arange(count)[:, None]).astype(float)
    return np.einsum("un,mn...->mu...", members, values)
