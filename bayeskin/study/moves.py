"""Moves of ensembles of walkers, for the parts of a population that have no closed form.

A step is the difference of two other walkers of the same ensemble times a number, as in differential
evolution (ter Braak 2006, Statistics and Computing 16:239), so that steps have the right size without tuning.
Where recordings say little, their parameters follow the population, and a step of the population alone would
be tiny. Coefficients and spreads therefore also move together with the parameters of all recordings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayeskin.study.individual import Likelihoods
from bayeskin.study.model import Model, State, Walkers, log_normal
from bayeskin.types import Array

_LENGTH = 2.38 / np.sqrt(2.0)  # optimal for the difference of two draws of a normal density
_SHORTEST = 0.1  # smallest share of this length, so that some steps fit a thin, curved ridge
_MOVED = (0.0, 0.5, 1.0)  # shares of the coordinates that a step moves beside one of them


@dataclass(frozen=True)
class Ensembles:
    """Moves of `count` ensembles of `walkers` walkers each; the walkers of an ensemble are side by side."""

    model: Model
    likelihoods: Likelihoods
    count: int
    walkers: int

    def from_population(self, state: State, rng: np.random.Generator) -> State:
        """Returns the state after the population has proposed parameters of each recording."""
        root = np.swapaxes(np.linalg.cholesky(state.covariances[-1]), 1, 2)
        tried = self.model.parents(state)[-1] + rng.standard_normal(state.x.shape) @ root
        log_likelihood = self.likelihoods.log_likelihood(tried)
        return _accepted(state, tried, log_likelihood, log_likelihood - state.log_likelihood, rng)

    def from_posteriors(self, state: State, rng: np.random.Generator) -> State:
        """Returns the state after each recording's own posterior has proposed its parameters."""
        parents, covariance = self.model.parents(state)[-1], state.covariances[-1]
        tried = self.likelihoods.draw(len(state.x), rng)
        gain = log_normal(tried - parents, covariance) - self.likelihoods.log_prior(tried)
        gain -= log_normal(state.x - parents, covariance) - self.likelihoods.log_prior(state.x)
        return _accepted(state, tried, self.likelihoods.log_likelihood(tried), gain, rng)

    def move_recordings(self, state: State, rng: np.random.Generator) -> State:
        """Returns the state after a step of the parameters of each recording."""
        for own, first, second in self._pairs(rng):
            effects = self.model.effects(state)[-1]
            step = _step(effects[first], effects[second], rng)
            part = state.taken(own)
            tried = part.x + step
            log_likelihood = self.likelihoods.log_likelihood(tried)
            covariance = part.covariances[-1]
            gain = log_normal(effects[own] + step, covariance) - log_normal(effects[own], covariance)
            gain += log_likelihood - part.log_likelihood
            state = state.put(own, _accepted(part, tried, log_likelihood, gain, rng))
        return state

    def move_coefficients(self, state: State, rng: np.random.Generator) -> State:
        """Returns the state after a step of the coefficients, together with all recordings."""
        for own, first, second in self._pairs(rng):
            # A step moves all coefficients of some parameters.
            old = state.coefficients
            step = _step(old[first], old[second], rng, together=True)
            part = state.taken(own)
            tried = replace(
                part, coefficients=part.coefficients + step, x=part.x + self.model.layout.matrix @ step
            )
            prior = self.model.log_prior_of_coefficients
            gain = prior(tried.coefficients) - prior(part.coefficients)
            state = state.put(own, self._all_or_nothing(part, tried, gain, rng))
        return state

    def move_spread(self, state: State, level: int, rng: np.random.Generator) -> State:
        """Returns the state after a step of a level's sds, which stretches the effects of all its units."""
        dim = state.x.shape[2]
        for own, first, second in self._pairs(rng):
            sds = 0.5 * np.log(np.diagonal(state.covariances[level], axis1=1, axis2=2))
            step = _step(sds[first], sds[second], rng)
            part, stretch = state.taken(own), np.exp(step)
            covariances = list(part.covariances)
            covariances[level] = covariances[level] * stretch[:, :, None] * stretch[:, None, :]
            shift = self.model.effects(part)[level] * (stretch[:, None] - 1.0)
            tried = replace(self.model.shifted(part, level, shift), covariances=tuple(covariances))
            prior = self.model.log_prior_of_covariance
            # The density of the effects and the volume that they take change by factors that cancel.
            gain = prior(tried.covariances[level]) - prior(part.covariances[level])
            gain += (dim + 1) * step.sum(axis=1)
            state = state.put(own, self._all_or_nothing(part, tried, gain, rng))
        return state

    def _all_or_nothing(self, part: State, tried: State, gain: Array, rng: np.random.Generator) -> State:
        """Returns the walkers with the tried states where these are accepted; gain (m,) : of the prior."""
        tried = replace(tried, log_likelihood=self.likelihoods.log_likelihood(tried.x))
        gain = gain + np.sum(tried.log_likelihood - part.log_likelihood, axis=1)
        return part.chosen(tried, _chance(gain, rng))

    def _pairs(self, rng: np.random.Generator) -> Iterator[tuple[Walkers, Walkers, Walkers]]:
        """Yields half of the walkers of each ensemble with two different walkers of the other half, twice."""
        order = rng.random((self.count, self.walkers)).argsort(axis=1)
        order += self.walkers * np.arange(self.count)[:, None]
        halves = np.split(order, 2, axis=1)
        for own, others in (halves, halves[::-1]):
            picks = rng.random((*own.shape, others.shape[1])).argsort(axis=2)[..., :2]
            first, second = (np.take_along_axis(others, picks[..., k], axis=1).ravel() for k in (0, 1))
            yield own.ravel(), first, second


def _step(first: Array, second: Array, rng: np.random.Generator, together: bool = False) -> Array:
    """Returns steps (m, ..., d) from differences of walkers, in a random choice of the d coordinates.

    The choice is made for each row (d,), or for all rows of a walker `together`.
    """
    rows = (len(first), *(1,) * (first.ndim - 2), 1) if together else (*first.shape[:-1], 1)
    moved = rng.random((*rows[:-1], first.shape[-1])) < rng.choice(_MOVED, rows)
    np.put_along_axis(moved, rng.integers(first.shape[-1], size=rows), True, axis=-1)
    number = moved.sum(axis=-1, keepdims=True) * (first[0].size // moved[0].size)
    length = _LENGTH * rng.uniform(_SHORTEST, 1.0, rows) / np.sqrt(number)
    return moved * length * (first - second)


def _chance(gain: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Returns whether proposals with these gains of the log density are accepted."""
    return np.asarray(np.log(rng.random(gain.shape)) < gain)


def _accepted(
    state: State, tried: Array, log_likelihood: Array, gain: Array, rng: np.random.Generator
) -> State:
    """Returns the state with the tried x (m, N, d) of each recording where it is accepted."""
    moves = _chance(gain, rng)
    return replace(
        state,
        x=np.where(moves[..., None], tried, state.x),
        log_likelihood=np.where(moves, log_likelihood, state.log_likelihood),
    )
