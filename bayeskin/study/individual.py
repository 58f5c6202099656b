"""The likelihood of each recording, as a smooth function that is fitted to the draws of its posterior.

A population model needs the likelihood of a recording at parameter values between and beside the draws of
its posterior. Each posterior is therefore described by a mixture of normal distributions, and the prior under
which it was drawn is divided out. The mixture is fitted in coordinates in which this prior is a standard
normal distribution. There, a parameter that the recording does not inform is exactly normal, a posterior
that leans on a bound has no sharp edge, and no density lies outside the bounds. The number of components
minimises the Bayesian information criterion, so that a curved ridge gets many and a normal posterior one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from bayeskin.errors import InputError
from bayeskin.inference.sample import evenly
from bayeskin.study.mixture import MixtureSettings, NormalMixture
from bayeskin.types import Array, FreezesArrays, ParameterSpace

FEWEST_DRAWS = 100
_UNIT_EDGE = 1e-12  # distance from a bound, in prior probability, below which points count as at the bound


@dataclass(frozen=True)
class Individual(FreezesArrays):
    """The posterior of one recording: draws (n, d) in SI, in the columns of `space`, which was their prior.

    Raises InputError for draws that are too few, mostly repeated, or outside the bounds, and for a parameter
    that may be zero or negative, because the population is described by logarithms.
    """

    recording: str
    space: ParameterSpace
    draws: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        where, shape = f"posterior of {self.recording}", np.shape(self.draws)
        if len(shape) != 2 or shape[1] != self.space.dim:
            raise InputError(
                where, f"the shape of its draws is {shape}", f"they need {self.space.dim} columns"
            )
        if len(self.draws) < FEWEST_DRAWS:
            raise InputError(
                where, f"{len(self.draws)} draws are too few", f"at least {FEWEST_DRAWS} are needed"
            )
        for parameter, column in zip(self.space.parameters, self.draws.T, strict=True):
            at = f"{where}: {parameter.name}"
            if not parameter.lower > 0:
                raise InputError(
                    at,
                    f"the prior begins at {parameter.lower:g}",
                    "a study needs priors of positive values only",
                )
            if not np.all((column >= parameter.lower) & (column <= parameter.upper)):
                raise InputError(
                    at, "some draws lie outside the bounds of the prior", "all must lie within them"
                )
            if 2 * len(np.unique(column)) < len(column):
                raise InputError(
                    at, "the draws are mostly repeated", "use thinned draws, of which few are alike"
                )


@dataclass(frozen=True)
class Likelihoods(FreezesArrays):
    """The likelihoods of N recordings as functions of x, the natural logarithms of d parameters in SI.

    spaces : the different priors of the recordings; which (N,) : the prior of each recording
    mixtures : of each recording's posterior, in the coordinates in which its prior is standard normal
    """

    names: tuple[str, ...]
    spaces: tuple[ParameterSpace, ...]
    which: NDArray[np.int64]
    mixtures: tuple[NormalMixture, ...]
    _log_weights: Array
    _centres: Array
    _roots: Array
    _constants: Array
    _matrices: Array
    _offsets: Array

    @classmethod
    def of(
        cls, individuals: Sequence[Individual], rng: np.random.Generator,
        settings: MixtureSettings = MixtureSettings(),
    ) -> Likelihoods:  # fmt: skip
        """Returns the likelihoods of recordings. Raises InputError where their parameters differ."""
        first = individuals[0]
        for individual in individuals:
            if individual.space.names != first.space.names:
                raise InputError(
                    f"posterior of {individual.recording}",
                    f"its parameters are {', '.join(individual.space.names)}",
                    f"they must be {', '.join(first.space.names)}, as in {first.recording}",
                )  # fmt: skip
        spaces = tuple(dict.fromkeys(individual.space.without_texts for individual in individuals))
        which = np.array([spaces.index(individual.space.without_texts) for individual in individuals])
        mixtures = []
        for individual, space in zip(individuals, which, strict=True):
            draws = evenly(individual.draws, settings.most_draws)
            mixtures.append(NormalMixture.of(_to_normal(spaces[space], np.log(draws)), rng, settings))
        return cls(first.space.names, spaces, which, tuple(mixtures), *_stacked(mixtures))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Returns the lowest lower and the highest upper bound of all priors, (d,) each, as logarithms."""
        return (
            np.log(np.min([space.lower for space in self.spaces], axis=0)),
            np.log(np.max([space.upper for space in self.spaces], axis=0)),
        )

    def log_likelihood(self, x: Array) -> Array:
        """Returns the log-likelihoods (m, N) at points (m, N, d), up to a constant for each recording.

        It is -inf outside the bounds of a recording's prior.
        """
        z = self._by_space(_to_normal, x)
        white = np.swapaxes(z, 0, 1) @ self._matrices - self._offsets[:, None]
        parts = self._constants[:, None] - 0.5 * np.einsum(
            "nmkd,nmkd->nmk", *(white.reshape(*white.shape[:2], -1, x.shape[2]),) * 2
        )
        largest = parts.max(axis=2)
        posterior = largest + np.log(np.exp(parts - largest[..., None]).sum(axis=2))
        return np.asarray(posterior.T + 0.5 * np.sum(z**2, axis=2) - self._by_space(_log_tie, x))

    def log_prior(self, x: Array) -> Array:
        """Returns the log density (m, N) of each recording's prior at points x (m, N, d)."""
        return self._by_space(log_prior, x)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Returns points x (count, N, d) drawn from the mixtures, which are the recordings' posteriors."""
        recordings, dim = len(self.mixtures), len(self.names)
        limits = np.cumsum(np.exp(self._log_weights), axis=1)[:, :-1]
        component = (rng.random((count, recordings, 1)) > limits).sum(axis=2)
        recording = np.arange(recordings)
        normal = rng.standard_normal((count, recordings, 1, dim))
        spread = (normal @ self._roots[recording, component])[..., 0, :]
        return self._by_space(_from_normal, self._centres[recording, component] + spread)

    def _by_space(self, function: Callable[[ParameterSpace, Array], Array], x: Array) -> Array:
        """Returns what a function of a prior and points gives for each recording's own prior."""
        if len(self.spaces) == 1:
            return function(self.spaces[0], x)
        own = [self.which == s for s in range(len(self.spaces))]
        parts = [function(space, x[:, here]) for space, here in zip(self.spaces, own, strict=True)]
        out = np.empty((*x.shape[:2], *parts[0].shape[2:]))
        for here, part in zip(own, parts, strict=True):
            out[:, here] = part
        return out


def _stacked(mixtures: Sequence[NormalMixture]) -> tuple[Array, ...]:
    """Returns the mixtures of N recordings together, filled up with components of weight zero.

    These are log weights (N, k), centres (N, k, d), transposed roots of the covariances (N, k, d, d), and
    what the log density needs: constants (N, k), matrices (N, d, k d) and offsets (N, k d).
    """
    most, dim = max(len(mixture.log_weights) for mixture in mixtures), mixtures[0].centres.shape[1]
    log_weights = np.full((len(mixtures), most), -np.inf)
    centres, whiten = np.zeros((len(mixtures), most, dim)), np.tile(np.eye(dim), (len(mixtures), most, 1, 1))
    for n, mixture in enumerate(mixtures):
        count = len(mixture.log_weights)
        log_weights[n, :count] = mixture.log_weights
        centres[n, :count], whiten[n, :count] = mixture.centres, mixture.whiten
    roots = np.swapaxes(np.linalg.inv(whiten), 2, 3)
    constants = log_weights + np.linalg.slogdet(whiten)[1]
    matrices = np.moveaxis(whiten, 3, 1).reshape(len(mixtures), dim, -1)
    offsets = np.einsum("nkij,nkj->nki", whiten, centres).reshape(len(mixtures), -1)
    return log_weights, centres, roots, constants, matrices, offsets


def _to_normal(space: ParameterSpace, x: Array) -> Array:
    """Returns the coordinates (..., d) in which the prior is standard normal, of logarithms x (..., d)."""
    theta = np.exp(np.clip(x, np.log(space.lower), np.log(space.upper)))
    return np.asarray(ndtri(np.clip(space.to_unit(theta), _UNIT_EDGE, 1.0 - _UNIT_EDGE)))


def _from_normal(space: ParameterSpace, z: Array) -> Array:
    """Returns logarithms x (..., d); this is the inverse of `_to_normal`."""
    return np.log(np.clip(space.from_unit(ndtr(z)), space.lower, space.upper))


def log_prior(space: ParameterSpace, x: Array) -> Array:
    """Returns the log density (...,) of a prior at logarithms x (..., d) of points within its bounds."""
    theta = np.exp(x)
    offset = np.array([parameter.offset if parameter.in_log else 0.0 for parameter in space.parameters])
    slopes = np.where(space.is_log, theta / (theta + offset), theta)  # d line / d log(theta)
    return np.asarray(space.log_density(space.to_line(theta)) + np.log(slopes).sum(axis=-1))


def _log_tie(space: ParameterSpace, x: Array) -> Array:
    """Returns the log (...,) of the prior density over that of the same prior without correlations.

    It is infinite outside the bounds, so that the likelihood vanishes there.
    """
    inside = np.all((x >= np.log(space.lower)) & (x <= np.log(space.upper)), axis=-1)
    out = np.where(inside, 0.0, np.inf)
    if space.correlations:
        line = space.to_line(np.exp(x[inside]))
        out[inside] = space.log_density(line) - replace(space, correlations=()).log_density(line)
    return out
