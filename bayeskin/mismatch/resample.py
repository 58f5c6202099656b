"""The posterior of one set of mechanisms sampled, from all the modes that climbs find.

Laplace's Gaussian knows one mode: of permeabilities, which a force informs little, there are often several,
and the moduli lie along a curved ridge. Two ensembles set out from the modes, each walker near one of them
taken by its share of the evidence, and move as those of a run do (`inference.moves`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import emcee
import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.convergence import Limits, assess
from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.moves import mixed_moves
from bayeskin.mismatch.fit import APART, FIRST_ROUNDS, Fit, evidence, likely, other_skins
from bayeskin.mismatch.wrapper import skins
from bayeskin.types import Array

ENSEMBLES, FEWEST_WALKERS = 2, 40
LEGS = (120, 300, 600, 900)  # steps after which draws may do
FORGOTTEN, EVERY = 1 / 3, 5  # of these steps, at least; one of so many is kept
MODES = 6  # climbs from other skins
NEAR, NEARER = 0.5, 0.7  # of Laplace's sd, about a mode; of that, each time that too few walkers can be there
LIMITS = Limits(effective_samples=200.0, lengths=5.0, rhat=1.1)  # for intervals, not for tails


@dataclass(frozen=True)
class PosteriorDraws:
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
    found: Fit, seed: int, legs: Sequence[int] = LEGS, modes: int = MODES,
    near: Sequence[Mapping[str, float]] = (),
) -> PosteriorDraws:  # fmt: skip
    """Returns draws of the posterior about `found` and other modes.

    They end after the first of `legs` by which they have settled.

    modes : climbs to other modes from skins of the prior; near : values by name from which further ones start
    """
    log_posterior = found.log_posterior
    rng = np.random.default_rng([seed, 7])
    starts = _starts(found, rng, _modes(found, seed, modes, near))
    walkers = max(FEWEST_WALKERS, 2 * log_posterior.dim + 2)
    coordinates = MoveCoordinates(None, *log_posterior.bounds)
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
    with ThreadPoolExecutor(ENSEMBLES) as pool:  # the likelihood frees the interpreter
        for steps in legs:
            more = partial(_moved_on, steps=steps - made)
            states = list(pool.map(more, samplers, states))
            made = steps
            drawn = _assessed(samplers, log_posterior, int(FORGOTTEN * steps))
            if drawn.settled:
                break
    return drawn


def _moved_on(sampler: emcee.EnsembleSampler, state: emcee.State, steps: int) -> emcee.State:
    return sampler.run_mcmc(state, steps, skip_initial_state_check=True)


def _assessed(
    samplers: Sequence[emcee.EnsembleSampler], log_posterior: LogPosterior, forgotten: int
) -> PosteriorDraws:
    """Returns the draws of ensembles after their first steps, of which so many are forgotten at least."""
    chains = np.stack([sampler.get_chain() for sampler in samplers])
    densities = np.stack([sampler.get_log_prob() for sampler in samplers])
    state = assess(chains, densities, log_posterior.names, LIMITS, forgotten)
    kept = log_posterior.from_sampling(chains[:, state.burn_in :: EVERY].reshape(-1, log_posterior.dim))
    rhat, effective = float(np.nanmax(state.rhat)), float(np.nanmin(state.ess))
    return PosteriorDraws(log_posterior.names, kept, rhat, effective, state.verdict.trusted)


def _modes(
    found: Fit, seed: int, count: int, near: Sequence[Mapping[str, float]]
) -> list[tuple[Array, float, Array]]:
    """Vector (D,), log evidence and covariance (D, D) over the unit cube of each mode, that of `found` first.

    Climbs that end nearer than `APART` to a mode that is known have found nothing new.
    """
    log_posterior = found.log_posterior
    low, high = log_posterior.bounds
    best = low + found.unit * (high - low)
    skin = skins(log_posterior.surrogate)[-1]
    starts = [np.clip(log_posterior.vector(theta), low, high) for theta in near]
    if count:
        starts += likely(log_posterior, other_skins(best, log_posterior, seed, skin), count)
    modes = [(best, found.log_evidence, found.covariance)]
    for start in starts:
        top = gauss_newton(log_posterior, start, None, sum(FIRST_ROUNDS))
        apart = [np.abs((top.vector - vector) / (high - low))[:skin].max() for vector, _, _ in modes]
        if min(apart) > APART:
            modes.append((top.vector, *evidence(log_posterior, top)))
    return modes


def _starts(
    found: Fit, rng: np.random.Generator, modes: Sequence[tuple[Array, float, Array]]
) -> Callable[[int], Array]:
    """A function that draws so many walkers (n, D) about the modes, to each by its share of the evidence."""
    log_posterior = found.log_posterior
    low, high = log_posterior.bounds
    masses = np.array([log_evidence for _, log_evidence, _ in modes])
    share = np.exp(masses - masses.max())
    aside = 1e-12 * np.eye(len(low))
    roots = np.array([np.linalg.cholesky(one + aside) * (high - low)[:, None] for _, _, one in modes])
    centres = np.array([vector for vector, _, _ in modes])

    def draw(count: int) -> Array:
        out, near = np.empty((0, len(low))), NEAR
        while len(out) < count:
            mode = rng.choice(len(modes), count, p=share / share.sum())
            normal = rng.standard_normal((count, len(low)))
            trial = centres[mode] + near * np.einsum("nij,nj->ni", roots[mode], normal)
            trial = low + np.abs(np.mod((trial - low) / (high - low) + 1.0, 2.0) - 1.0) * (high - low)
            out = np.concatenate([out, trial[np.isfinite(log_posterior.log_prob(trial))]])
            near *= NEARER  # where next to nothing is possible farther away
        return out[:count]

    return draw
