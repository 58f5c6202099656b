"""Measures what markers add to the force: how much wider the posterior would be without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.problem import UNIFORM_PRECISION, LogPosterior
from bayeskin.types import Array


def widened_without_markers(log_posterior: LogPosterior, theta: Mapping[str, float]) -> dict[str, float]:
    """Returns the factors by which the sds of the model's parameters would be larger without the markers.

    They follow from the expected information of force and markers, and of the force alone, at the same values
    `theta` of all parameters. Sds are those of coordinates in which the prior is uniform.
    """
    names = log_posterior.surrogate.space.names
    with_markers = _sd(log_posterior, theta, len(names))
    force_alone = _sd(replace(log_posterior, markers=None), theta, len(names))
    return dict(zip(names, map(float, force_alone / with_markers), strict=True))


def _sd(log_posterior: LogPosterior, theta: Mapping[str, float], dim: int) -> Array:
    """Returns the sds (dim,) of the first parameters near a point, as shares of the prior's width."""
    vector = np.clip(log_posterior.vector(theta), *log_posterior.bounds)
    information = gauss_newton(log_posterior, vector, None, 0).information[:dim, :dim]
    values, modes = np.linalg.eigh(information)
    covariance = (modes / (np.maximum(values, 0.0) + UNIFORM_PRECISION)) @ modes.T
    return np.asarray(np.sqrt(np.diag(covariance)))
