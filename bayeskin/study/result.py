"""The results of a study about a population, and what its data cannot tell, as values without sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayeskin.inference.convergence import Convergence
from bayeskin.inference.importance import WeightSettings
from bayeskin.study.layout import Layout
from bayeskin.study.model import Priors
from bayeskin.types import Parameter

FEWEST_EFFECTIVE = 50.0  # effective draws with which weighted draws can test a shrunk estimate
_OFF = 0.25  # shift of a shrunk estimate, in its sd, above which the fitted likelihood counts as wrong
_RESOLVED = 0.1  # ratio of an interval's ends below which a spread has only an upper bound


@dataclass(frozen=True)
class Estimate:
    """The median of a quantity and its 90 % interval, `low` to `high`."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Spread:
    """The sd of the natural logarithm of a parameter between the units of a level."""

    sd: Estimate

    @property
    def cv(self) -> Estimate:
        """Returns the coefficient of variation of the parameter, which is log-normal."""
        with np.errstate(over="ignore"):
            ends = (float(np.sqrt(np.expm1(sd**2))) for sd in (self.sd.median, self.sd.low, self.sd.high))
        return Estimate(*ends)

    @property
    def only_upper_bound(self) -> bool:
        """Returns whether the data cannot tell the spread from zero."""
        return self.sd.low < _RESOLVED * self.sd.high


@dataclass(frozen=True)
class Contrast:
    """The ratio of the medians of two groups or sites (`category`), `second` over `first`.

    probability : of a ratio above 1
    """

    category: str
    first: str
    second: str
    ratio: Estimate
    probability: float


@dataclass(frozen=True)
class ParameterOfPopulation:
    """One parameter in the population.

    medians : for each group, or for "" without groups, averaged over the sites (geometric mean) [SI]
    between : spread between subjects; it includes that within subjects where `within` is None
    within : spread between recordings of one subject; where the table repeats sessions and recordings, it
        contains both; None where no subject has two recordings
    repeats : spread between recordings of one session, only where `within` contains more
    informative, at_lower, at_upper : numbers of recordings whose own posterior differs from its prior, leans
        on the lower and leans on the upper bound of its prior
    """

    parameter: Parameter
    medians: Mapping[str, Estimate]
    between: Spread
    within: Spread | None
    repeats: Spread | None
    contrasts: tuple[Contrast, ...]
    informative: int
    at_lower: int
    at_upper: int


@dataclass(frozen=True)
class Shrunk:
    """The values of a recording or a subject, given all recordings of the study, in SI.

    alone : estimates by the recording alone, for each parameter; None for a subject
    subject, group : of the recording; the group of a subject is None where it is in several
    """

    name: str
    subject: str
    group: str | None
    alone: tuple[Estimate, ...] | None
    shrunk: tuple[Estimate, ...]


@dataclass(frozen=True)
class Overlap:
    """A comparison of a recording's shrunk estimate with that of its weighted draws.

    The weights turn draws of the recording's own posterior into draws of the shrunk one, without the fitted
    likelihood.

    effective : number of effective draws at one set of parameters of the population (median over the sets)
    khat : shape of the Pareto tail of the weights, NaN below 200 draws and where the weights are nearly even
    shift_sd : largest difference of the two means over the parameters, in sd of the shrunk estimate
    """

    recording: str
    effective: float
    khat: float
    shift_sd: float

    @property
    def poor(self) -> bool:
        """Returns whether so few draws lie there that the estimate relies on the fitted likelihood."""
        return self.effective < FEWEST_EFFECTIVE or self.khat > WeightSettings().khat

    @property
    def contradicts(self) -> bool:
        """Returns whether the draws show that the fitted likelihood is wrong."""
        return not self.poor and self.shift_sd > _OFF + 3.0 / math.sqrt(self.effective)


@dataclass(frozen=True)
class Population:
    """The result of a study: parameters, shrunk estimates, and how far it can be trusted.

    recordings, subjects : shrunk estimates, in the order of the table
    """

    layout: Layout
    priors: Priors
    parameters: tuple[ParameterOfPopulation, ...]
    recordings: tuple[Shrunk, ...]
    subjects: tuple[Shrunk, ...]
    overlaps: tuple[Overlap, ...]
    convergence: Convergence

    @property
    def trusted(self) -> bool:
        """Returns whether the draws have converged, and no weighted draws contradict them."""
        return self.convergence.verdict.trusted and not any(overlap.contradicts for overlap in self.overlaps)
