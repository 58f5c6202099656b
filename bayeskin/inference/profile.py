"""Profile likelihoods: how well the recording can be fitted with one parameter held, all others free.

Where the profile is flat, the fit cannot tell one value of the parameter from another, whatever the prior
says (practical non-identifiability; Raue et al. 2009, Bioinformatics 25:1923). Noise parameters are free too.
The held value moves from the most probable point to either end. Each maximum is found by Gauss-Newton
(`gauss_newton`) from the maximum at the neighbouring value. Further climbs start from the likeliest and the
nearest of the posterior draws about the value, because the draws follow curved ridges and separate maxima.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.problem import HELD, LogPosterior
from bayeskin.inference.reparametrisation import Shear, find_shear
from bayeskin.types import Array, FreezesArrays, Parameter, ParameterSpace

DROP = 1.353  # nats below the top: half the 90 % quantile of chi-square with one degree of freedom
_ROUNDS = 12  # largest number of rounds of a climb


@dataclass(frozen=True)
class Profile(FreezesArrays):
    """Profile of one parameter: values (g,) in SI over its prior, and log-likelihoods (g,) less the largest.

    interval : 90 % interval by the likelihood ratio, in SI; an end at the prior's bound is open
    """

    name: str
    values: Array
    drop_nats: Array
    interval: tuple[float, float]
    open_below: bool
    open_above: bool

    @property
    def flat(self) -> bool:
        """Returns whether the fit excludes no value of the prior."""
        return self.open_below and self.open_above


def profiles(
    log_posterior: LogPosterior, best: Mapping[str, float], draws: Array, points: int = 15
) -> tuple[Profile, ...]:
    """Returns a profile for each material parameter, at `points` values evenly over its prior and the best.

    best : all parameters (SI) of the most probable point
    draws : posterior draws (n, D) in SI; n may be 0
    """
    material = log_posterior.material or log_posterior.surrogate.space
    log_posterior = replace(log_posterior, material=material.box)  # without the prior, only the fit counts
    shear, names = find_shear(log_posterior), material.names
    known = log_posterior.to_sampling(draws)
    values = log_posterior.log_prob(known)
    known = known[np.argsort(-values)]
    return tuple(_profile(log_posterior, best, known, shear, j, points) for j in range(len(names)))


def _profile(
    log_posterior: LogPosterior, best: Mapping[str, float], draws: Array, shear: Shear | None, column: int,
    points: int,
) -> Profile:  # fmt: skip
    low, high = (float(bound[column]) for bound in log_posterior.bounds)
    start = log_posterior.vector(best)
    line = np.sort(np.append(np.linspace(low, high, points), start[column]))
    middle = int(np.searchsorted(line, start[column]))
    last = len(line) - 1
    value, maxima = np.full(len(line), -np.inf), np.tile(start, (len(line), 1))
    value[middle], maxima[middle] = _maximum_with_held(log_posterior, start, shear, column)
    for j, draw in _likeliest_about(line, draws, column):
        reached, point = _maximum_with_held(log_posterior, draw, shear, column)
        if reached > value[j]:
            value[j], maxima[j] = reached, point
    # The held value moves out to both ends, then across and back: a maximum that is missed in one direction
    # may be found in the other.
    paths = ((middle, last), (middle, 0), (0, last), (last, 0))
    for first, end in paths:
        for i in range(first, end, 1 if end > first else -1):
            j = i + (1 if end > first else -1)
            trial = maxima[i].copy()
            trial[column] = line[j]
            reached, point = _maximum_with_held(log_posterior, trial, shear, column)
            if reached > value[j]:
                value[j], maxima[j] = reached, point
    drop = value - value.max()
    inside = _crossings(line, drop)
    ends = np.tile(start, (len(line) + 2, 1))
    ends[:, column] = [*line, *inside]
    theta = log_posterior.from_sampling(ends)[:, column]
    open_ends = (bool(drop[0] > -DROP), bool(drop[-1] > -DROP))
    name = log_posterior.names[column]
    return Profile(name, theta[:-2], drop, (float(theta[-2]), float(theta[-1])), *open_ends)


def _likeliest_about(line: Array, draws: Array, column: int) -> Iterator[tuple[int, Array]]:
    """Yields for each value (g,) the likeliest and the nearest draw about it, moved onto the value.

    The draws (n, D) are sorted, the likeliest first.
    """
    away = np.abs(draws[:, column, None] - line)
    value = np.argmin(away, axis=1)
    for j in np.unique(value):
        about = np.flatnonzero(value == j)
        for i in {int(about[0]), int(about[np.argmin(away[about, j])])}:
            yield int(j), np.where(np.arange(draws.shape[1]) == column, line[j], draws[i])


def _maximum_with_held(
    log_posterior: LogPosterior, at: Array, shear: Shear | None, column: int
) -> tuple[float, Array]:
    """Returns log-likelihood and point of the maximum near `at` (D,), with the coordinate `column` held."""
    space = log_posterior.material or log_posterior.surrogate.space
    theta = log_posterior.from_sampling(at[None])[0, column]
    parameters = list(space.parameters)
    parameters[column] = _narrowed(parameters[column], float(theta))
    held = replace(log_posterior, material=ParameterSpace(tuple(parameters)))
    top = gauss_newton(held, at, shear, _ROUNDS)
    value = float(log_posterior.log_likelihood(held.from_sampling(top.vector[None]))[0])
    return value, np.clip(top.vector, *log_posterior.bounds)


def _narrowed(parameter: Parameter, value: float) -> Parameter:
    reach = HELD * (abs(value) if parameter.in_log else parameter.upper - parameter.lower)
    lower = min(max(value - reach, parameter.lower), parameter.upper - 2 * reach)
    return replace(parameter, lower=lower, upper=lower + 2 * reach)


def _crossings(line: Array, drop: Array) -> tuple[float, float]:
    """Returns where the profile last crosses `DROP` on either side, or the line's end without a crossing."""
    within = np.flatnonzero(drop > -DROP)
    first, last = int(within[0]), int(within[-1])

    def between(inside: int, outside: int) -> float:
        share = (drop[inside] + DROP) / (drop[inside] - drop[outside])
        return float(line[inside] + share * (line[outside] - line[inside]))

    return (
        float(line[0]) if first == 0 else between(first, first - 1),
        float(line[-1]) if last == len(line) - 1 else between(last, last + 1),
    )
