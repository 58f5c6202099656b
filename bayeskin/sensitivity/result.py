"""The result of a sensitivity analysis: Sobol' indices over time, and what they say in words."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from bayeskin.number_format import interval, number, quantity
from bayeskin.types import Array, FreezesArrays, Parameter, ParameterSpace


@dataclass(frozen=True)
class UninformedSettings:
    """Thresholds from which the force informs a parameter.

    total : smallest total index
    meaningful_variance : smallest variance of a bin in which it counts, as a share of the largest variance of
        any bin
    """

    total: float = 0.01
    meaningful_variance: float = 1e-3


@dataclass(frozen=True)
class SobolResult(FreezesArrays):
    """First-order, total and second-order Sobol' indices, for each bin and for the whole history.

    first, total : (d, m) indices, NaN in bins whose force hardly varies
    first_interval, total_interval : (2, d, m) the 5 % and 95 % limits
    first_aggregated, total_aggregated and their intervals : the same for the whole history, (d,) and (2, d)
    second : (p, m) indices of the pairs, in the order of `pairs`; for the whole history they are (p,), with
        limits (2, p)
    variance_n2 : (m,) variance of the force
    unexplained : share of the variance that a projection does not explain (NaN for pick-freeze)
    distribution : the distribution from which the parameters were drawn, in words
    """

    names: tuple[str, ...]
    edges_s: Array
    first: Array
    total: Array
    first_interval: Array
    total_interval: Array
    first_aggregated: Array
    total_aggregated: Array
    first_aggregated_interval: Array
    total_aggregated_interval: Array
    second: Array
    second_aggregated: Array
    second_aggregated_interval: Array
    variance_n2: Array
    unexplained: float
    samples: int
    method: Literal["pick-freeze", "projection"]
    distribution: str

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        return tuple(combinations(self.names, 2))


def uninformed(result: SobolResult, settings: UninformedSettings = UninformedSettings()) -> tuple[str, ...]:
    """Returns the parameters whose total index stays below 0.01 in every bin of meaningful variance."""
    matters = result.variance_n2 >= settings.meaningful_variance * np.max(result.variance_n2, initial=0.0)
    matters &= ~np.isnan(result.total).any(axis=0)
    if not matters.any():
        return ()
    highest = result.total[:, matters].max(axis=1)
    return tuple(name for name, top in zip(result.names, highest, strict=True) if top < settings.total)


def sentence(result: SobolResult) -> str:
    """Returns a sentence that names the parameters that the force does not inform."""
    names = uninformed(result)
    if np.isnan(result.total).all():
        return "The force does not vary over the parameters' distribution: it informs none of them."
    if not names:
        return "The force informs every parameter: each total Sobol' index reaches 0.01 in some bin."
    listed = names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
    verb = "its total Sobol' index stays" if len(names) == 1 else "their total Sobol' indices stay"
    return f"The force does not inform {listed}: {verb} below 0.01 in every bin whose force varies."


def describe(space: ParameterSpace) -> str:
    """Returns the input distribution in words."""
    start = "independent, without their priors' correlations: " if space.correlations else "independent: "
    return start + "; ".join(map(_parameter_in_words, space.parameters))


def _parameter_in_words(p: Parameter) -> str:
    sd = f"factor {number(np.exp(p.spread))}" if p.in_log else quantity(p.spread, p.unit)
    about = f" about {quantity(p.centre, p.unit)} (sd: {sd})" if p.peaked else ""
    return f"{p.name} {p.prior}{about}, {interval(p.lower, p.upper, p.unit)}"
