"""Samples the posterior of one set of mechanisms, from all modes that climbs find.

Laplace's Gaussian describes a single mode. The permeabilities, which a force informs little, often have
several modes, and the moduli lie along a curved ridge. Two ensembles start from the modes. Each walker starts
near one mode, which is drawn in proportion to its evidence. The moves are those of `inference.moves`.
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
from bayeskin.mismatch.evidence import evidence
from bayeskin.mismatch.fit import FITS, SAME_MAXIMUM, Fit
from bayeskin.mismatch.fit_starts import likely, other_skins
from bayeskin.mismatch.wrapper import skins
from bayeskin.types import Array


@dataclass(frozen=True)
class ResampleSettings:
    """Settings of the sampling of one set's posterior.

    legs : numbers of steps after which it is checked whether the draws suffice
    limits : criteria that the draws must meet; they are sufficient for intervals, not for tails
    modes : number of climbs to other modes, from tissues of the prior
    apart : a climb that ends nearer to a known mode gives no new mode; largest difference of any parameter,
        as a share of the prior's width
    ensembles, walkers : number of ensembles, and least number of walkers in each
    forgotten, every : smallest share of the steps that counts as burn-in; one of every `every` later steps is
        kept
    near, nearer : distance of the walkers from a mode, over Laplace's sd, and the factor on it each time that
        too few walkers start at a possible point
    """

    legs: tuple[int, ...] = (120, 300, 600, 900)
    limits: Limits = Limits(effective_samples=200.0, lengths=5.0, rhat=1.1)
    modes: int = 6
    apart: float = SAME_MAXIMUM
    ensembles: int = 2
    walkers: int = 40
    forgotten: float = 1 / 3
    every: int = 5
    near: float = 0.5
    nearer: float = 0.7


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws of a posterior.

    draws : (n, D) in SI; the columns are `names`
    rhat : largest R-hat of all parameters; effective : smallest number of effective samples
    settled : whether intervals may be taken from the draws
    """

    names: tuple[str, ...]
    draws: Array
    rhat: float
    effective: float
    settled: bool

    @cached_property
    def summary(self) -> dict[str, dict[str, Any]]:
        """Returns the mean, the sd and the ends of the 90 % interval of each parameter."""
        low, high = np.quantile(self.draws, [0.05, 0.95], axis=0)
        rows = zip(self.names, self.draws.mean(axis=0), self.draws.std(axis=0), low, high, strict=True)
        return {
            name: {"mean": float(mean), "sd": float(sd), "interval90": [float(a), float(b)]}
            for name, mean, sd, a, b in rows
        }


def resample(
    fit: Fit, seed: int, settings: ResampleSettings = ResampleSettings(),
    near: Sequence[Mapping[str, float]] = (),
) -> PosteriorDraws:  # fmt: skip
    """Returns draws of the posterior at a fit's mode and at other modes.

    Sampling ends after the first of the legs by which the draws have settled.

    near : values by name from which further climbs start
    """
    log_posterior = fit.log_posterior
    rng = np.random.default_rng([seed, 7])
    starts = _starts(fit, rng, _modes(fit, seed, settings, near), settings)
    walkers = max(settings.walkers, 2 * log_posterior.dim + 2)
    coordinates = MoveCoordinates(None, *log_posterior.bounds)
    samplers = [
        emcee.EnsembleSampler(
            walkers, log_posterior.dim, log_posterior.log_prob, moves=mixed_moves(coordinates, walkers),
            vectorize=True,
        )
        for _ in range(settings.ensembles)
    ]  # fmt: skip
    states = [
        emcee.State(starts(walkers), random_state=np.random.RandomState(int(rng.integers(2**32))).get_state())
        for _ in samplers
    ]
    steps_done = 0
    with ThreadPoolExecutor(settings.ensembles) as pool:  # the likelihood releases the interpreter's lock
        for steps in settings.legs:
            advance = partial(_continued, steps=steps - steps_done)
            states = list(pool.map(advance, samplers, states))
            steps_done = steps
            drawn = _assessed(samplers, log_posterior, steps, settings)
            if drawn.settled:
                break
    return drawn


def _continued(sampler: emcee.EnsembleSampler, state: emcee.State, steps: int) -> emcee.State:
    """Returns the state of an ensemble after further steps."""
    return sampler.run_mcmc(state, steps, skip_initial_state_check=True)


def _assessed(
    samplers: Sequence[emcee.EnsembleSampler], log_posterior: LogPosterior, steps: int,
    settings: ResampleSettings,
) -> PosteriorDraws:  # fmt: skip
    """Returns the draws of ensembles after a number of steps, without burn-in."""
    chains = np.stack([sampler.get_chain() for sampler in samplers])
    densities = np.stack([sampler.get_log_prob() for sampler in samplers])
    forgotten = int(settings.forgotten * steps)
    state = assess(chains, densities, log_posterior.names, settings.limits, forgotten)
    kept_steps = chains[:, state.burn_in :: settings.every]
    kept = log_posterior.from_sampling(kept_steps.reshape(-1, log_posterior.dim))
    rhat, effective = float(np.nanmax(state.rhat)), float(np.nanmin(state.ess))
    return PosteriorDraws(log_posterior.names, kept, rhat, effective, state.verdict.trusted)


def _modes(
    fit: Fit, seed: int, settings: ResampleSettings, near: Sequence[Mapping[str, float]]
) -> list[tuple[Array, float, Array]]:
    """Returns vector (D,), log-evidence and covariance (D, D) over the unit cube of each mode.

    The mode of `fit` comes first.
    """
    log_posterior = fit.log_posterior
    low, high = log_posterior.bounds
    best = low + fit.unit * (high - low)
    tissue_size = skins(log_posterior.surrogate)[-1]
    starts = [np.clip(log_posterior.vector(theta), low, high) for theta in near]
    if settings.modes:
        starts += likely(log_posterior, other_skins(best, log_posterior, seed, tissue_size), settings.modes)
    modes = [(best, fit.log_evidence, fit.covariance)]
    for start in starts:
        top = gauss_newton(log_posterior, start, None, sum(FITS.first_rounds))
        apart = [np.abs((top.vector - vector) / (high - low))[:tissue_size].max() for vector, _, _ in modes]
        if min(apart) > settings.apart:
            modes.append((top.vector, *evidence(log_posterior, top)))
    return modes


def _starts(
    fit: Fit,
    rng: np.random.Generator,
    modes: Sequence[tuple[Array, float, Array]],
    settings: ResampleSettings,
) -> Callable[[int], Array]:
    """Returns a function that draws a given number of walkers (n, D) near the modes.

    The expected number of walkers near a mode is proportional to the mode's evidence.
    """
    log_posterior = fit.log_posterior
    low, high = log_posterior.bounds
    log_evidences = np.array([log_evidence for _, log_evidence, _ in modes])
    share = np.exp(log_evidences - log_evidences.max())
    jitter = 1e-12 * np.eye(len(low))
    roots = np.array(
        [np.linalg.cholesky(covariance + jitter) * (high - low)[:, None] for _, _, covariance in modes]
    )
    centres = np.array([vector for vector, _, _ in modes])

    def draw(count: int) -> Array:
        walkers, near = np.empty((0, len(low))), settings.near
        while len(walkers) < count:
            mode = rng.choice(len(modes), count, p=share / share.sum())
            normal = rng.standard_normal((count, len(low)))
            proposals = centres[mode] + near * np.einsum("nij,nj->ni", roots[mode], normal)
            proposals = low + np.abs(np.mod((proposals - low) / (high - low) + 1.0, 2.0) - 1.0) * (high - low)
            walkers = np.concatenate([walkers, proposals[np.isfinite(log_posterior.log_prob(proposals))]])
            near *= settings.nearer  # the density may be zero farther away from a mode
        return walkers[:count]

    return draw
