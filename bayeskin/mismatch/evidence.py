"""The evidence of a fit, by Laplace's approximation with the bounds of the priors.

Laplace's approximation is taken in coordinates u of the unit cube, in which every prior is uniform. At
the best point u*, the expected information of the likelihood has the eigenvalues l. The prior adds 2 pi to
each of them, and the log-evidence is

    log Z = log p(y | u*) + sum 1/2 log(2 pi / (l + 2 pi)) .

A direction that the recording does not inform costs nothing. A direction that it informs costs the share of
the prior that it leaves (Tierney & Kadane 1986, JASA 81:82; the result is exact where l = 0). A coordinate
may lie on a bound, towards which the log density rises with slope g. This coordinate contributes the factor
int_0^1 exp(-g t - l t^2 / 2) dt instead. Along a coordinate, with the others held, the density may have less
room than the Gaussian of its information, for example where the moment of a step falls between two bins, or
where a bound is near. Evidence and covariance then both shrink by this share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import Top
from bayeskin.inference.problem import UNIFORM_PRECISION
from bayeskin.types import Array


@dataclass(frozen=True)
class EvidenceSettings:
    """Settings of an evidence.

    far, near : largest distance from the maximum [sd] up to which the density is integrated along a
        coordinate, and smallest distance, as a share of the prior's width
    ratio : ratio of neighbouring distances
    edge : distance from a bound, in the unit cube, below which a coordinate lies on it
    """

    far: float = 5.0
    near: float = 1e-4
    ratio: float = 1.6
    edge: float = 1e-6


EVIDENCE = EvidenceSettings()


def evidence(log_posterior: LogPosterior, top: Top) -> tuple[float, Array]:
    """Returns the log-evidence, and the covariance (D, D) over the unit cube.

    Where the density at `top` is zero they are -inf and the prior's covariance.
    """
    if not np.isfinite(top.value):
        return -np.inf, np.eye(log_posterior.dim) / UNIFORM_PRECISION
    low, high = log_posterior.bounds
    unit = (top.vector - low) / (high - low)
    edge = EVIDENCE.edge
    uphill = np.where(unit < edge, -top.gradient, np.where(unit > 1.0 - edge, top.gradient, 0.0))
    held = uphill > 0.0
    free = ~held
    values, vectors = np.linalg.eigh(top.information[np.ix_(free, free)])
    t, density = held_density(uphill[held], np.diag(top.information)[held])
    mass = np.trapezoid(density, t, axis=1)
    log_likelihood = top.value + float(np.sum(np.log(high - low)))
    log_evidence = log_likelihood + occam(values) + float(np.sum(np.log(mass)))
    covariance = np.zeros((len(unit), len(unit)))
    width = np.maximum(np.maximum(values, 0.0) + 2.0 * np.pi, UNIFORM_PRECISION)
    covariance[np.ix_(free, free)] = (vectors / width) @ vectors.T
    mean_square = np.trapezoid(density * t**2, t, axis=1) / mass  # mean square distance from the bound
    covariance[held, held] = mean_square
    share = np.ones(len(unit))
    for i in np.flatnonzero(free[: log_posterior.surrogate.space.dim]):
        gaussian = np.sqrt(2.0 * np.pi / (max(top.information[i, i], 0.0) + 2.0 * np.pi))
        share[i] = min(_integral_along(log_posterior, top, unit, int(i)) / gaussian, 1.0)
    return log_evidence + float(np.sum(np.log(share))), covariance * np.outer(share, share)


def occam(information: Array) -> float:
    """Returns the logarithm of the share of uniform priors that a recording leaves.

    information : eigenvalues (d,) of the recording's information in coordinates of the unit cube; a direction
        without information leaves the whole prior
    """
    return float(0.5 * np.sum(np.log(2.0 * np.pi / (np.maximum(information, 0.0) + 2.0 * np.pi))))


def held_density(steep: Array, curved: Array) -> tuple[Array, Array]:
    """Returns distances (t,) from a bound into the unit cube, and the density (h, t) at these distances.

    The density is relative to that on the bound, for h parameters whose best value lies on a bound.

    steep, curved : minus the first and second derivatives (h,) of the log density at the bound
    """
    t = np.linspace(0.0, 1.0, 2001) ** 3  # the distances are close together where the density is steep
    return t, np.exp(-np.outer(steep, t) - 0.5 * np.outer(curved, t**2))


def _integral_along(log_posterior: LogPosterior, top: Top, unit: Array, i: int) -> float:
    """Returns the integral of the density along coordinate i of the unit cube, with the others held.

    The density is relative to that at `top`. The integral extends as far as the Gaussian of the coordinate's
    information reaches.
    """
    low, high = log_posterior.bounds
    far = min(EVIDENCE.far / np.sqrt(max(top.information[i, i], 1.0)), 1.0)
    near = min(EVIDENCE.near, far / 100.0)
    away = np.geomspace(far, near, 1 + round(np.log(far / near) / np.log(EVIDENCE.ratio)))
    places = np.unique(np.clip(np.concatenate([unit[i] - away, unit[i : i + 1], unit[i] + away]), 0.0, 1.0))
    points = np.repeat(unit[None], len(places), axis=0)
    points[:, i] = places
    points = np.clip(low + points * (high - low), low, high)
    values = log_posterior.log_prob(points) - top.value
    return float(np.trapezoid(np.exp(np.minimum(values, 0.0)), places))
