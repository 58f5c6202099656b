"""Predicts the displacements of markers from runs of a design: principal components and Gaussian processes.

If moduli are multiplied by a number and permeabilities divided by it, the force is multiplied too, but the
displacements stay the same. The inputs of `Similarity` are therefore all that displacements depend on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.surrogates.gp import LatentGPs
from bayeskin.surrogates.hyperparameters import fit_latent
from bayeskin.surrogates.similarity import Similarity
from bayeskin.types import Array, FreezesArrays, ParameterSpace

MOST_COMPONENTS = 10
ENOUGH_M = 2e-7  # RMS of what the components leave, below which no further one is added


@dataclass(frozen=True)
class MarkerSurrogate(FreezesArrays):
    """Displacements of markers since the first image; it satisfies `inference.PredictsMarkers`.

    mean_m (t - 1, p, 2), components (k, t - 1, p, 2) : the components are orthonormal
    errors_m (k, t - 1, p, 2) : errors of the components' scores, of one sd each
    """

    space: ParameterSpace
    mean_m: Array
    components: Array
    latents: LatentGPs
    errors_m: Array
    provenance: Mapping[str, Any]

    @cached_property
    def _similarity(self) -> Similarity:
        return Similarity(self.space)

    @property
    def rms_error_m(self) -> float:
        """Returns the RMS error of a displacement [m]."""
        return float(np.sqrt(np.sum(self.errors_m**2) / self.mean_m.size))

    def predict_m(self, theta: ArrayLike) -> Array:
        """Returns displacements since the first image (n, t - 1, p, 2) [m] at theta (n, d)."""
        rows = np.atleast_2d(np.asarray(theta, dtype=float))
        scores = self.latents.predict_mean(self._similarity.inputs(rows))
        return np.asarray(self.mean_m + np.tensordot(scores, self.components, 1))


def train_marker_surrogate(
    space: ParameterSpace, theta: Array, moved_m: Array, weights: Array, provenance: Mapping[str, Any]
) -> MarkerSurrogate:
    """Returns the surrogate of displacements (n, t - 1, p, 2) [m] at theta (n, d).

    weights (n,) : weights of the rows in the components and in the errors, which are those of leaving one out
    """
    share = weights / weights.sum()
    mean_m = np.tensordot(share, moved_m, 1)
    centred = (moved_m - mean_m).reshape(len(theta), -1)
    _, size, shapes = np.linalg.svd(np.sqrt(share)[:, None] * centred, full_matrices=False)
    left = np.sqrt(np.maximum(np.sum(size**2) - np.cumsum(size**2), 0.0) / mean_m.size)
    count = min(
        int(np.argmax(left <= ENOUGH_M)) + 1 if left.min() <= ENOUGH_M else len(left), MOST_COMPONENTS
    )
    shapes, inputs = shapes[:count], Similarity(space).inputs(theta)
    scores = centred @ shapes.T
    fits = [fit_latent(inputs, scores[:, k], weights) for k in range(count)]
    latents = LatentGPs.assemble(inputs, scores, fits)
    off = latents.leave_one_out()[0] - scores
    rms = np.sqrt(share @ off**2)
    components = shapes.reshape(count, *mean_m.shape)
    return MarkerSurrogate(
        space, mean_m, components, latents, rms[:, None, None, None] * components, provenance
    )
