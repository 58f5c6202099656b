"""Compares shrunk estimates with those of weighted draws, which need no fitted likelihood.

Given the parameters of the population, draws of a recording's own posterior become draws of its shrunk
posterior by the weights (density in the population) / (density of the prior). Averaged over the draws of the
population's parameters, normalised weights give the shrunk posterior exactly, if enough draws have a weight.
"""

from __future__ import annotations

import numpy as np

from bayeskin.inference.importance import WeightSettings, smoothed_weights
from bayeskin.inference.sample import evenly
from bayeskin.study.individual import Individual, log_prior
from bayeskin.study.model import Model, State, log_normal
from bayeskin.study.result import Overlap

_EVEN = 0.5  # smallest share of effective draws with which weights count as nearly even
_DRAWS, _SETS = 2000, 100  # largest numbers of draws of a recording, and of the population's parameters


def overlap(number: int, individual: Individual, model: Model, draws: State) -> Overlap:
    """Returns how well the draws of a recording overlap with its shrunk estimate and agree with it."""
    some = draws.taken(np.arange(0, len(draws.x), -(-len(draws.x) // _SETS)))
    x = np.log(evenly(individual.draws, _DRAWS))
    away = x - model.parents(some)[-1][:, number, None]
    log_weights = log_normal(away, some.covariances[-1]) - log_prior(individual.space, x)
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    effective = float(np.median(1.0 / np.sum(weights**2, axis=1)))
    pooled = weights.mean(axis=0)
    khat = float("nan")
    if effective < _EVEN * len(x):  # nearly even weights have no tail, and the fit of one is erratic
        with np.errstate(divide="ignore"):
            khat = smoothed_weights(np.log(pooled), WeightSettings())[1]
    shrunk = draws.x[:, number]
    shift = np.abs(pooled @ x - shrunk.mean(axis=0)) / shrunk.std(axis=0)
    return Overlap(individual.recording, effective, khat, float(shift.max()))
