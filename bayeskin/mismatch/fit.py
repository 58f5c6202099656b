"""Fits a set of mechanisms on a surrogate or a tangent, with all other parameters free again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import Top, gauss_newton
from bayeskin.inference.score_test import promise, with_less_noise
from bayeskin.mismatch.evidence import evidence
from bayeskin.mismatch.fit_starts import starts_elsewhere
from bayeskin.types import Array

SAME_MAXIMUM = 0.1  # largest difference of any parameter at one maximum, as a share of the prior's width


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit of a set of mechanisms.

    draws : number of prior draws for each new parameter, among which starting points are chosen
    ranked : the same number for score tests, which only rank the mechanisms
    starts : number of the most promising draws of a part's parameters from which climbs start
    redrawn : how often the parameters of a part are drawn again, near the best point so far
    tissues : number of climbs from the best of other tissues
    first_rounds, first_kept : every climb has the first number of rounds; the `first_kept` best of them then
        have the second number
    rounds : largest number of rounds of the climb that is then the best
    """

    draws: int = 96
    ranked: int = 32
    starts: int = 2
    redrawn: int = 1
    tissues: int = 4
    first_rounds: tuple[int, int] = (2, 4)
    first_kept: int = 3
    rounds: int = 25


FITS = FitSettings()


@dataclass(frozen=True)
class Fit:
    """The most probable point of a set of mechanisms.

    names : the mechanisms of the set
    theta : values of all parameters by name, SI; value : log density at the point; log_evidence : of the set
    covariance (D, D) : covariance in coordinates of the unit cube, at most the priors' 1/12
    latent (r,) : the surrogate's error at the point, in sd of each column of its factor
    """

    names: tuple[str, ...]
    log_posterior: LogPosterior
    theta: Mapping[str, float]
    value: float
    log_evidence: float
    covariance: Array
    latent: Array

    @cached_property
    def force_n(self) -> Array:
        """Returns the force (m,) [N] on all bins, with the most probable error of the surrogate."""
        return self.log_posterior.force_n(self.log_posterior.vector(self.theta), self.latent)

    @cached_property
    def mean_n(self) -> Array:
        """Returns the surrogate's mean (m,) [N] on all bins: the force without the surrogate's error."""
        values = self.log_posterior.from_sampling(self.log_posterior.vector(self.theta))
        return np.asarray(self.log_posterior.predict_mean(values[None])[0])

    @cached_property
    def unit(self) -> Array:
        """Returns the point in coordinates of the unit cube, (D,)."""
        low, high = self.log_posterior.bounds
        return np.asarray((self.log_posterior.vector(self.theta) - low) / (high - low))

    @property
    def log_likelihood(self) -> float:
        """Returns the log-likelihood at the point: the log density without that of the uniform priors."""
        low, high = self.log_posterior.bounds
        return self.value + float(np.sum(np.log(high - low)))

    def draws(self, count: int, seed: int) -> Array:
        """Returns draws (count, D) in SI from the Gaussian at the point, reflected at the priors' bounds."""
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.covariance)))
        unit = self.unit + rng.standard_normal((count, len(root))) @ root.T
        unit = np.abs(np.mod(unit + 1.0, 2.0) - 1.0)
        low, high = self.log_posterior.bounds
        return self.log_posterior.from_sampling(low + unit * (high - low))


def stored(fitted: Fit) -> dict[str, Any]:
    """Returns a fit without its posterior, in JSON's types."""
    plain = {"names": list(fitted.names), "theta": dict(fitted.theta), "value": fitted.value}
    arrays = {"covariance": fitted.covariance.tolist(), "latent": fitted.latent.tolist()}
    return {**plain, "log_evidence": fitted.log_evidence, **arrays}


def restored(plain: Mapping[str, Any], log_posterior: LogPosterior) -> Fit:
    """Returns the fit from the result of `stored` and the fit's posterior."""
    covariance, latent = (np.asarray(plain[name], dtype=float) for name in ("covariance", "latent"))
    value, log_evidence = plain["value"], plain["log_evidence"]
    return Fit(tuple(plain["names"]), log_posterior, plain["theta"], value, log_evidence, covariance, latent)


def promised(
    log_posterior: LogPosterior, start: Mapping[str, float], neutral: Mapping[str, float],
    parts: Sequence[Sequence[str]], seed: int,
) -> float:  # fmt: skip
    """Returns the largest gain [nats] over `start` that score tests promise for draws of new parameters.

    start : values of a smaller set; neutral : neutral values of the new parameters
    parts : names of the parameters of each part, which are drawn together
    """
    low, high = log_posterior.bounds
    vector = np.clip(log_posterior.vector({**neutral, **start}), low, high)
    rng, best = np.random.default_rng(seed), 0.0
    new = np.array([name not in start for name in log_posterior.names])
    for part in parts:
        columns = [log_posterior.names.index(name) for name in part]
        trials = _drawn(vector, columns, FITS.ranked, low, high, rng)
        best = max(best, promise(log_posterior, vector, trials, ~new, 1)[0][1])
    return best


def _drawn(
    vector: Array, columns: list[int], each: int, low: Array, high: Array, rng: np.random.Generator
) -> Array:
    """Returns points (n, D) with some coordinates drawn from the prior, `each` points for each of them."""
    trials = np.tile(vector, (each * len(columns), 1))
    trials[:, columns] = rng.uniform(low[columns], high[columns], (len(trials), len(columns)))
    return trials


def fit(
    names: Sequence[str],
    log_posterior: LogPosterior,
    start: Mapping[str, float],
    neutral: Mapping[str, float],
    seed: int,
    parts: Sequence[Sequence[str]] = (),
) -> Fit:
    """Returns the best of a few climbs from `start`, which holds the values of a smaller set.

    Parameters that `start` lacks begin at their neutral values. They are searched for, one part after
    another; each of `parts` has the names of its parameters. Finally the tissue is searched for, with the
    other parameters as fitted: the base parameters alone, and together with the tissue's mechanisms. This is
    necessary because a missing mechanism with a large effect has biased the tissue of the smaller set.
    """
    low, high = log_posterior.bounds
    starts = [np.clip(log_posterior.vector({**neutral, **start}), low, high)]
    rng = np.random.default_rng(seed)
    later_names = [[name for part in parts[index + 1 :] for name in part] for index in range(len(parts))]
    rounds = list(zip(parts, later_names, strict=True))
    # Each part is then searched for again, with the other parts at their best values.
    rounds += [(part, []) for part in parts] if len(parts) > 1 else []
    for part, later in rounds:
        starts = [_search_part(log_posterior, starts[0], part, later, neutral, rng)]
    return _best_fit(names, log_posterior, starts, seed)


def fit_near(names: Sequence[str], log_posterior: LogPosterior, theta: Mapping[str, float]) -> Fit:
    """Returns the fit that a single climb from a point reaches."""
    low, high = log_posterior.bounds
    top = gauss_newton(log_posterior, np.clip(log_posterior.vector(theta), low, high), None, FITS.rounds)
    return _fit_at(names, log_posterior, top)


def _search_part(
    log_posterior: LogPosterior, vector: Array, part: Sequence[str], later: Sequence[str],
    neutral: Mapping[str, float], rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Returns the best point (D,) of climbs from the most promising draws of a part's parameters.

    Further draws are made near the best point so far. Parameters of parts that are searched for `later` have
    their neutral values.
    """
    low, high = log_posterior.bounds
    columns = [log_posterior.names.index(name) for name in part]
    without = log_posterior.named(log_posterior.from_sampling(vector))
    without |= {name: neutral[name] for name in (*part, *later)}
    neutral_vector = np.clip(log_posterior.vector(without), low, high)
    trials = _drawn(neutral_vector, columns, FITS.draws, low, high, rng)
    top = _best_climbs(
        log_posterior,
        [vector, *_promising_starts(log_posterior, neutral_vector, trials, part, later, neutral)],
    )[0]
    for _ in range(FITS.redrawn if len(columns) > 1 else 0):
        near = _redrawn(top.vector, columns, low, high, len(trials), rng)
        trials[:, columns] = near[:, columns]
        starts = _promising_starts(log_posterior, neutral_vector, trials, part, later, neutral)
        top = _best_climbs(log_posterior, [top.vector, *starts])[0]
    return top.vector


def _promising_starts(
    log_posterior: LogPosterior, neutral_vector: Array, trials: Array, part: Sequence[str],
    later: Sequence[str], neutral: Mapping[str, float],
) -> list[Array]:  # fmt: skip
    """Returns starting points (D,) from the trials that promise the largest gains in score tests.

    Each trial gives two points, in which the part is as strong as the score test requires. The other
    parameters are those of `neutral_vector` in one point, and are adjusted by the score test in the other.

    neutral_vector : point (D,) in which the part and the `later` parts are neutral
    trials : points (n, D) with draws of the part's parameters
    """
    low, high = log_posterior.bounds
    names, strength = log_posterior.names, part[0]
    parameter = log_posterior.space.parameters[names.index(strength)]
    in_part = np.array([name in part for name in names])
    free = ~in_part & np.array([name not in later for name in names])
    starts = []
    for row, _, multiple, moved in promise(log_posterior, neutral_vector, trials, free, FITS.starts):
        for background in (neutral_vector, moved):
            values = log_posterior.named(
                log_posterior.from_sampling(np.where(in_part, trials[row], background))
            )
            strength_value = value_for_multiple(multiple, values[strength], neutral[strength])
            values[strength] = float(np.clip(strength_value, parameter.lower, parameter.upper))
            starts.append(np.clip(log_posterior.vector(values), low, high))
    return starts


def value_for_multiple(multiple: float, value: float, neutral: float) -> float:
    """Returns the value of a strength parameter whose effect is `multiple` times that of `value`.

    The effect is proportional to the distance from the neutral value. Where the neutral value is infinite, it
    is proportional to the reciprocal of the value.
    """
    if np.isfinite(neutral):
        return neutral + multiple * (value - neutral)
    return value / multiple if multiple > 0.0 else neutral


def _redrawn(
    vector: Array, columns: list[int], low: Array, high: Array, count: int, rng: np.random.Generator
) -> Array:
    """Returns points (count, D) that differ from `vector` (D,) in one or two of the given coordinates.

    The changed coordinates lie near those of `vector`, or anywhere in the prior.
    """
    width = (high - low)[columns]
    changed = np.argsort(rng.uniform(size=(count, len(columns))), axis=1) < rng.integers(1, 3, (count, 1))
    reach = 10.0 ** rng.uniform(-3.0, -0.5, (count, 1)) * width
    nearby = vector[columns] + reach * rng.standard_normal((count, len(columns)))
    drawn = np.where(
        rng.uniform(size=(count, 1)) < 0.5, nearby, rng.uniform(low[columns], high[columns], nearby.shape)
    )
    trials = np.tile(vector, (count, 1))
    trials[:, columns] = np.clip(np.where(changed, drawn, vector[columns]), low[columns], high[columns])
    return trials


def _best_climbs(log_posterior: LogPosterior, starts: Sequence[Array]) -> list[Top]:
    """Returns the end points of the best climbs, the best first.

    All climbs have a few rounds; then only the best of them continue.
    """
    tops: list[Top] = []
    for rounds in FITS.first_rounds:
        tops = [gauss_newton(log_posterior, start, None, rounds, quick=True) for start in starts]
        tops = sorted(tops, key=lambda top: -top.value)[: FITS.first_kept]
        starts = [top.vector for top in tops]
    return tops


def _best_fit(
    names: Sequence[str], log_posterior: LogPosterior, starts: Sequence[Array], seed: int
) -> Fit:  # fmt: skip
    """Returns the best fit of climbs from given points, from other tissues, and from a smaller noise."""
    best = _best_climbs(log_posterior, starts)[0]
    other_tissues = starts_elsewhere(best.vector, log_posterior, seed, FITS.tissues)
    less_noise = with_less_noise(log_posterior, best.vector)
    best = _best_climbs(log_posterior, [best.vector, less_noise, *other_tissues])[0]
    return _fit_at(names, log_posterior, gauss_newton(log_posterior, best.vector, None, FITS.rounds))


def _fit_at(names: Sequence[str], log_posterior: LogPosterior, top: Top) -> Fit:
    """Returns the fit at the end point of a climb."""
    theta = log_posterior.named(log_posterior.from_sampling(top.vector))
    return Fit(tuple(names), log_posterior, theta, top.value, *evidence(log_posterior, top), top.latent)
