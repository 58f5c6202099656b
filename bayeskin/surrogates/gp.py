"""Gaussian processes, one a latent: a polynomial trend, a kernel of a linear map of the inputs, a nugget.

Universal kriging: Rasmussen & Williams (2006), ch. 2.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dtrtri

from bayeskin.surrogates.hyperparameters import SMALLEST_NUGGET, LatentFit
from bayeskin.surrogates.kernels import kernel, squared_distances, trend_basis, trend_degree
from bayeskin.types import Array, _FreezesArrays

CHUNK = 256  # points whose kernel rows stay in the cache


class _Conditioned(NamedTuple):
    """One latent conditioned on its rows: what `predict` multiplies by."""

    mapped: Array  # (n, d)
    whitener: NDArray[np.float64]  # (n, n) L^-1, column-major
    weights: Array  # (n,) K^-1 (y - H b)
    trend: Array  # (p,) b
    trend_weights: Array  # (n, p) K^-1 H
    trend_root: Array  # (p, p) inverse of the lower Cholesky factor of H^T K^-1 H
    centre: float
    deviation: float
    variance: float


@dataclass(frozen=True)
class LatentGPs(_FreezesArrays):
    """Independent GPs of q latents; the factors are derived from these few arrays, also after loading.

    inputs (n, d) in the unit cube, targets (n, q), linear_maps (q, d, d), nuggets (q,), kernels q names,
    inflation (q,) of the standard deviations, by cross-validation.
    """

    inputs: Array
    targets: Array
    linear_maps: Array
    nuggets: Array
    inflation: Array
    kernels: tuple[str, ...]

    @classmethod
    def assemble(cls, unit: Array, targets: Array, fits: list[LatentFit]) -> LatentGPs:
        """GPs of targets (n, q) at unit (n, d) with the hyperparameters of `fits`."""
        return cls(
            inputs=unit,
            targets=targets,
            linear_maps=np.stack([fit.linear_map for fit in fits]),
            nuggets=np.array([fit.nugget for fit in fits]),
            inflation=np.array([fit.inflation for fit in fits]),
            kernels=tuple(fit.kernel for fit in fits),
        )

    @property
    def degree(self) -> int:
        return trend_degree(*self.inputs.shape)

    @cached_property
    def _conditioned(self) -> list[_Conditioned]:
        return [self._condition(j) for j in range(len(self.kernels))]

    def _condition(self, j: int) -> _Conditioned:
        n = len(self.inputs)
        basis = trend_basis(self.inputs, self.degree)
        centre = float(self.targets[:, j].mean())
        deviation = float(self.targets[:, j].std())
        deviation = deviation if deviation > 1e-12 * max(abs(centre), 1e-300) else 1.0
        target = (self.targets[:, j] - centre) / deviation
        mapped = (self.inputs - 0.5) @ self.linear_maps[j].T
        covariance = kernel(self.kernels[j], squared_distances(mapped, mapped))[0]
        covariance.flat[:: n + 1] = 1.0 + self.nuggets[j]
        lower = np.linalg.cholesky(covariance)
        whitener, _ = dtrtri(np.asfortranarray(lower), lower=1)
        white_basis, white_target = whitener @ basis, whitener @ target
        gram = np.linalg.cholesky(white_basis.T @ white_basis)
        trend = np.linalg.solve(gram.T, np.linalg.solve(gram, white_basis.T @ white_target))
        rest = white_target - white_basis @ trend
        return _Conditioned(
            mapped,
            np.asfortranarray(whitener),
            whitener.T @ rest,
            trend,
            whitener.T @ white_basis,
            np.linalg.inv(gram),
            centre,
            deviation,
            float(rest @ rest) / (n - basis.shape[1]),
        )

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance, nugget included, of every latent at unit (k, d): two arrays (k, q)."""
        mean = np.empty((len(unit), len(self.kernels)))
        variance = np.empty_like(mean)
        for start in range(0, len(unit), CHUNK):
            part = slice(start, start + CHUNK)
            basis = trend_basis(unit[part], self.degree)
            for j, given in enumerate(self._conditioned):
                mean[part, j], variance[part, j] = self._predict_latent(j, given, unit[part], basis)
        return mean, variance

    def _predict_latent(self, j: int, given: _Conditioned, unit: Array, basis: Array) -> tuple[Array, Array]:
        mapped = (unit - 0.5) @ self.linear_maps[j].T
        rows = kernel(self.kernels[j], squared_distances(mapped, given.mapped))[0]
        mean = given.centre + given.deviation * (basis @ given.trend + rows @ given.weights)
        unexplained = (basis - rows @ given.trend_weights) @ given.trend_root.T
        white = dtrmm(1.0, given.whitener, rows.T, lower=1, overwrite_b=1)
        variance = (
            1.0
            + self.nuggets[j]
            - np.einsum("ji,ji->i", white, white)
            + np.einsum("ij,ij->i", unexplained, unexplained)
        )
        floor = max(self.nuggets[j], SMALLEST_NUGGET)
        scale = (self.inflation[j] * given.deviation) ** 2 * given.variance
        return mean, scale * np.maximum(variance, floor)

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance of each row given all others, (n, q) each; hyperparameters kept."""
        mean, variance = np.empty_like(self.targets), np.empty_like(self.targets)
        for j, given in enumerate(self._conditioned):
            half = given.trend_weights @ given.trend_root.T
            diagonal = np.sum(given.whitener**2, axis=0) - np.sum(half**2, axis=1)
            mean[:, j] = self.targets[:, j] - given.deviation * given.weights / diagonal
            variance[:, j] = (self.inflation[j] * given.deviation) ** 2 * given.variance / diagonal
        return mean, variance
