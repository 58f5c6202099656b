"""A set of mechanisms refitted with everything else free, and its evidence.

The evidence is Laplace's in coordinates u of the unit cube, in which every prior is uniform, with each
eigenvalue l of the Hessian of -log p joined by the prior's own,

    log Z = log p(y | u*) + sum 1/2 log(2 pi / (max(l, 0) + 2 pi)) ,

so that a direction that the data does not inform costs nothing, and one that they do costs the share of the
prior that they leave (Tierney & Kadane 1986, JASA 81:82; what follows where l = 0 is exact).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.optimise import climb
from bayeskin.inference.straighten import Shear
from bayeskin.types import Array

STEP = 1e-3  # of the unit cube, for second differences
DRAWS = 400  # of the priors of what is new, from which a climb starts
STARTS = 2
EVALUATIONS = 1500


@dataclass(frozen=True)
class Fit:
    """The most probable point of one set of mechanisms: values by name (SI), log density, evidence.

    covariance (D, D) is that of the unit cube's coordinates, the priors' 1/12 at most.
    """

    names: tuple[str, ...]
    log_posterior: LogPosterior
    theta: Mapping[str, float]
    value: float
    log_evidence: float
    covariance: Array

    @cached_property
    def unit(self) -> Array:
        """The point in the unit cube, (D,)."""
        low, high = self.log_posterior.bounds
        return np.asarray((self.log_posterior.vector(self.theta) - low) / (high - low))

    def draws(self, count: int, seed: int) -> Array:
        """SI values (count, D) from the Gaussian about the point, folded back at the priors' bounds."""
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.covariance)))
        unit = self.unit + rng.standard_normal((count, len(root))) @ root.T
        unit = np.abs(np.mod(unit + 1.0, 2.0) - 1.0)
        low, high = self.log_posterior.bounds
        return self.log_posterior.from_sampling(low + unit * (high - low))

    def mean_and_sd(self, name: str) -> tuple[float, float]:
        """Of one parameter, SI, over the Gaussian."""
        values = self.draws(1000, 0)[:, self.log_posterior.names.index(name)]
        return float(values.mean()), float(values.std())


def fit(
    names: Sequence[str],
    log_posterior: LogPosterior,
    start: Mapping[str, float],
    neutral: Mapping[str, float],
    seed: int,
    shear: Shear | None = None,
    before: Mapping[str, float] | None = None,
) -> Fit:
    """The best of a few climbs from `start`, which has the values of a smaller set.

    What `start` does not have begins at its value in `before`, an earlier fit; where there is none, at its
    neutral value and at the best of many draws of its prior. `shear` straightens the ridges of this
    posterior, where it is known.
    """
    known = {**neutral, **(before or {}), **start}
    fresh = [] if before else [i for i, name in enumerate(log_posterior.names) if name not in start]
    low, high = log_posterior.bounds
    known_line = np.clip(log_posterior.vector(known), low, high)
    trials = np.tile(known_line, (DRAWS, 1))
    rng = np.random.default_rng(seed)
    trials[1:, fresh] = rng.uniform(low[fresh], high[fresh], (DRAWS - 1, len(fresh)))
    values = log_posterior.log_prob(trials)
    order = [0, *(i for i in np.argsort(-values) if i != 0)]
    chosen = order[:STARTS] if fresh else order[:1]
    ends = [
        climb(log_posterior, log_posterior.named(log_posterior.from_sampling(trials[i])), EVALUATIONS, shear)
        for i in chosen
    ]
    best = max(ends, key=lambda end: end.value)
    found = Fit(tuple(names), log_posterior, best.theta, best.value, np.nan, np.zeros((0, 0)))
    return _with_evidence(found)


def _with_evidence(found: Fit) -> Fit:
    hessian = _hessian(found)
    values, vectors = np.linalg.eigh(hessian)
    values = np.maximum(values, 0.0) + 2.0 * np.pi
    low, high = found.log_posterior.bounds
    at_point = found.value + float(np.sum(np.log(high - low)))  # the likelihood itself
    log_evidence = at_point + 0.5 * float(np.sum(np.log(2.0 * np.pi / values)))
    covariance = (vectors / np.maximum(values, 12.0)) @ vectors.T
    return replace(found, log_evidence=log_evidence, covariance=covariance)


def _hessian(found: Fit) -> Array:
    """Second differences (D, D) of -log p over the unit cube, one-sided where a bound is near."""
    log_posterior, dim = found.log_posterior, len(found.unit)
    low, high = log_posterior.bounds
    centre = np.clip(found.unit, 2 * STEP, 1.0 - 2 * STEP)
    eye = STEP * np.eye(dim)
    pairs = [(i, j) for i in range(dim) for j in range(i)]
    points = [centre, *(centre + s * e for e in eye for s in (1, -1))]
    points += [
        centre + a * eye[i] + b * eye[j] for i, j in pairs for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1))
    ]
    values = -log_posterior.log_prob(low + np.array(points) * (high - low))
    hessian = np.empty((dim, dim))
    ahead, behind = values[1 : 2 * dim + 1 : 2], values[2 : 2 * dim + 1 : 2]
    hessian[np.diag_indices(dim)] = (ahead + behind - 2 * values[0]) / STEP**2
    for (i, j), (pp, mm, pm, mp) in zip(pairs, values[2 * dim + 1 :].reshape(-1, 4), strict=True):
        hessian[i, j] = hessian[j, i] = (pp + mm - pm - mp) / (4 * STEP**2)
    return np.where(np.isfinite(hessian), hessian, 0.0)
