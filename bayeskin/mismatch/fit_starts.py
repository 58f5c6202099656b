"""Starting points of fits: likely points of the prior, and other tissues."""

from __future__ import annotations

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.mismatch.wrapper import skins
from bayeskin.types import Array

SKINS = 192  # number of tissues drawn from the prior
NEAREST = 8  # trials whose density is computed for each trial from which a climb starts


def likely(log_posterior: LogPosterior, trials: Array, count: int) -> list[Array]:
    """Returns the `count` most probable of trials (n, D) whose force is nearest to the recorded force."""
    if not len(trials):
        return []
    bins, recorded = log_posterior.chain.bins, log_posterior.chain.force_n
    mean = log_posterior.predict_mean(log_posterior.from_sampling(trials))[:, bins]
    trials = trials[np.argsort(np.sum((recorded - mean) ** 2, axis=1))]
    kept, values, enough = trials[:0], np.empty(0), NEAREST * count
    for start in range(0, len(trials), enough):  # nearest first, until enough trials are possible
        value = log_posterior.log_prob(batch := trials[start : start + enough])
        possible = np.isfinite(value)
        kept, values = np.concatenate([kept, batch[possible]]), np.concatenate([values, value[possible]])
        if len(kept) >= enough:
            break
    return list(kept[:enough][np.argsort(-values[:enough])[:count]])


def other_skins(vector: Array, log_posterior: LogPosterior, seed: int, skin: int) -> Array:
    """Returns points (n, D) with other tissues: the first `skin` parameters are drawn from the prior.

    These are the base model's parameters, and possibly those of tissue mechanisms.
    """
    low, high = log_posterior.bounds
    trials = np.tile(np.clip(vector, low, high), (SKINS, 1))
    trials[:, :skin] = np.random.default_rng(seed).uniform(low[:skin], high[:skin], (len(trials), skin))
    return trials


def starts_elsewhere(vector: Array, log_posterior: LogPosterior, seed: int, count: int) -> list[Array]:
    """Returns starting points (D,) in other tissues, with and without other values of tissue mechanisms.

    count : number of starting points of each of these two kinds, the most probable ones of `other_skins`
    """
    sizes = skins(log_posterior.surrogate)
    tissues = [other_skins(vector, log_posterior, seed, size) for size in sizes]
    return [start for trials in tissues for start in likely(log_posterior, trials, count)]
