"""Describes a force history by an amplitude and a shape, and the shape by a few principal components.

Forces span decades over a prior box. A history ``y`` (m,) is therefore split into ``a = log RMS(y)`` and
``s = y / RMS(y)``. A latent vector is ``[a, z_1 .. z_K]`` with ``s = mean + z @ components``. The part that
the components leave out is represented by a variance of each bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np

from bayeskin.errors import InputError
from bayeskin.types import Array, FreezesArrays, Prediction

SMALLEST_AMPLITUDE = 1e-9  # share of the largest amplitude; a history of zeros has no logarithm


@dataclass(frozen=True)
class ShapeTransform(FreezesArrays):
    """The mean (m,) and the components (K, m) of shapes; truncation (m,) is the variance of the remainder."""

    mean: Array
    components: Array
    truncation: Array

    def keep(self, count: int, shapes: Array, weights: Array, fitted: int) -> ShapeTransform:
        """Returns the transform with the first `count` components.

        The remainder of `shapes` (n, m) becomes the truncation. `weights` (n,) are the weights of the rows.
        `fitted` is the number of vectors (mean and components) that were fitted to these same rows.
        """
        components = self.components[:count]
        centred = shapes - self.mean
        rest = centred - (centred @ components.T) @ components
        counting = weights.sum() ** 2 / np.sum(weights**2)  # effective number of rows
        freedom = max(counting - fitted, 1.0) / counting
        return ShapeTransform(self.mean, components, weights @ rest**2 / (weights.sum() * freedom))

    def encode(self, force_n: Array) -> Array:
        """Returns the latent vectors (n, 1 + K) of histories (n, m)."""
        amplitude, shapes = split(force_n)
        return np.column_stack([amplitude, (shapes - self.mean) @ self.components.T])

    def decode(self, latent: Array, sd: Array) -> Prediction:
        """Returns the force of latent vectors with independent errors; mean and sd are (n, 1 + K) each.

        It uses the delta method: d force = force da + exp(a) components dz.
        """
        scale = np.exp(latent[:, 0])[:, None]
        mean = self.decode_mean(latent)
        columns = np.empty((*latent.shape, len(self.mean)))
        _fill(mean, self.components, sd, scale * sd, columns)
        return Prediction(mean, columns.transpose(0, 2, 1), scale**2 * self.truncation)

    def decode_mean(self, latent: Array) -> Array:
        """Returns only the mean (n, m) of `decode`."""
        scale = np.exp(latent[:, 0])[:, None]
        mean = np.asarray((scale * latent[:, 1:]) @ self.components)
        mean += scale * self.mean
        return mean


@nb.njit(cache=True, nogil=True)
def _fill(mean: Array, components: Array, sd: Array, scaled_sd: Array, columns: Array) -> None:
    """Fills columns (n, 1 + K, m): the mean times the amplitude's sd, then components times their sd."""
    for i in range(len(columns)):
        for j in range(columns.shape[2]):
            columns[i, 0, j] = sd[i, 0] * mean[i, j]
        for a in range(len(components)):
            size, row, out = scaled_sd[i, a + 1], components[a], columns[i, a + 1]
            for j in range(len(row)):
                out[j] = size * row[j]


def split(force_n: Array) -> tuple[Array, Array]:
    """Returns log RMS (n,) and shape (n, m) of histories (n, m). Raises InputError if all are zero."""
    rms = np.sqrt(np.mean(force_n**2, axis=1))
    if not rms.max() > 0.0:
        raise InputError(
            "design: force_n", "the force is zero in every run", "it must differ from zero in at least one"
        )
    rms = np.maximum(rms, SMALLEST_AMPLITUDE * rms.max())
    return np.log(rms), force_n / rms[:, None]


def all_components(shapes: Array, weights: Array) -> tuple[ShapeTransform, Array]:
    """Returns all principal components of shapes (n, m) with row weights (n,), and their variances (K,)."""
    share = weights / weights.sum()
    mean = share @ shapes
    _, singular, components = np.linalg.svd(np.sqrt(share)[:, None] * (shapes - mean), full_matrices=False)
    # The sign of a component is arbitrary. It is fixed so that the same design gives the same surrogate.
    signs = np.sign(components[np.arange(len(components)), np.argmax(np.abs(components), axis=1)])
    signs[signs == 0] = 1.0
    return ShapeTransform(mean, components * signs[:, None], np.zeros_like(mean)), singular**2
