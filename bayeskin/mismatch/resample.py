"""The posterior of one set of mechanisms sampled, from all the modes that climbs find.

Laplace's Gaussian knows one mode: of permeabilities, which a force informs little, there are often several,
and the moduli lie along a curved ridge. Two ensembles set out from the modes, each walker near one of them
taken by its share of the evidence, and move as those of a run do (`inference.moves`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import emcee
import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.convergence import Limits, assess
from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.moves import mixed_moves
from bayeskin.inference.straighten import Shear
from bayeskin.mismatch.fit import FIRST_ROUNDS, Fit, evidence, likely, other_skins
from bayeskin.mismatch.wrapper import skins
from bayeskin.types import Array

ENSEMBLES, FEWEST_WALKERS = 2, 40
LEGS = (120, 300, 600, 900)  # steps after which draws may do
FORGOTTEN, EVERY = 1 / 3, 5  # of these steps, at least; one of so many is kept
MODES = 6  # climbs from other skins
NEAR, NEARER = 0.5, 0.7  # of Laplace's sd, about a mode; of that, each time that too few walkers can be there
LIMITS = Limits(effective_samples=200.0, lengths=5.0, rhat=1.1)  # for intervals, not for tails


@dataclass(frozen=True)
class Resampled:
    """Draws (n, D) in SI, columns `names`; rhat, the largest of all; effective, of the least known; whether
    these and the chains' times let intervals be taken from the draws (`LIMITS`)."""

    names: tuple[str, ...]
    draws: Array
    rhat: float
    effective: float
    settled: bool

    @cached_property
    def summary(self) -> dict[str, dict[str, Any]]:
        """Mean, sd and the ends of the 90 % interval of each parameter."""
        low, high = np.quantile(self.draws, [0.05, 0.95], axis=0)
        rows = zip(self.names, self.draws.mean(axis=0), self.draws.std(axis=0), low, high, strict=True)
        return {
            name: {"mean": float(mean), "sd": float(sd), "interval90": [float(a), float(b)]}
            for name, mean, sd, a, b in rows
        }


def resample(
    found: Fit, shear: Shear | None, seed: int, legs: Sequence[int] = LEGS, modes: int = MODES
) -> Resampled:  # fmt: skip
    """Draws of the posterior about `found` and so many other modes; `shear` as for `fit`.

    They end after the first of `legs` by which they have settled.
    """
    log_posterior = found.log_posterior
    rng = np.random.default_rng([seed, 7])
    starts = _starts(found, shear, seed, rng, modes)
    walkers = max(FEWEST_WALKERS, 2 * log_posterior.dim + 2)
    coordinates = MoveCoordinates(shear, *log_posterior.bounds)
    samplers = [
        emcee.EnsembleSampler(
            walkers, log_posterior.dim, log_posterior.log_prob, moves=mixed_moves(coordinates, walkers),
            vectorize=True,
        )
        for _ in range(ENSEMBLES)
    ]  # fmt: skip
    states = [
        emcee.State(starts(walkers), random_state=np.random.RandomState(int(rng.integers(2**32))).get_state())
        for _ in samplers
    ]
    made = 0
    for steps in legs:
        states = [
            sampler.run_mcmc(state, steps - made, skip_initial_state_check=True)
            for sampler, state in zip(samplers, states, strict=True)
        ]
        made = steps
        drawn = _assessed(samplers, log_posterior, int(FORGOTTEN * steps))
        if drawn.settled:
            break
    return drawn


def _assessed(
    samplers: Sequence[emcee.EnsembleSampler], log_posterior: LogPosterior, forgotten: int
) -> Resampled:
    """Returns the draws of ensembles after their first steps, of which so many are forgotten at least."""
    chains = np.stack([sampler.get_chain() for sampler in samplers])
    densities = np.stack([sampler.get_log_prob() for sampler in samplers])
    state = assess(chains, densities, log_posterior.names, LIMITS, forgotten)
    kept = log_posterior.from_sampling(chains[:, state.burn_in :: EVERY].reshape(-1, log_posterior.dim))
    rhat, effective = float(np.nanmax(state.rhat)), float(np.nanmin(state.ess))
    return Resampled(log_posterior.names, kept, rhat, effective, state.verdict.trusted)


def _starts(
    found: Fit, shear: Shear | None, seed: int, rng: np.random.Generator, modes: int
) -> Callable[[int], Array]:  # fmt: skip
    """A function that draws so many walkers (n, D) about the modes."""
    log_posterior = found.log_posterior
    low, high = log_posterior.bounds
    best = low + found.unit * (high - low)
    whole = skins(log_posterior.surrogate)[-1]
    others = (
        likely(log_posterior, other_skins(best, log_posterior, shear, seed, whole), modes) if modes else []
    )
    tops = [gauss_newton(log_posterior, start, shear, sum(FIRST_ROUNDS)) for start in others]
    centres = np.array([best, *(top.vector for top in tops)])
    masses = np.array([found.log_evidence, *(evidence(log_posterior, top)[0] for top in tops)])
    share = np.exp(masses - masses.max())
    root = np.linalg.cholesky(found.covariance + 1e-12 * np.eye(len(low))) * (high - low)[:, None]

    def draw(count: int) -> Array:
        out, near = np.empty((0, len(low))), NEAR
        while len(out) < count:
            centre = centres[rng.choice(len(centres), count, p=share / share.sum())]
            trial = centre + near * rng.standard_normal((count, len(low))) @ root.T
            trial = low + np.abs(np.mod((trial - low) / (high - low) + 1.0, 2.0) - 1.0) * (high - low)
            out = np.concatenate([out, trial[np.isfinite(log_posterior.log_prob(trial))]])
            near *= NEARER  # where next to nothing is possible farther away
        return out[:count]

    return draw
