"""Predicts each latent by a Gaussian process with a polynomial trend, linearly mapped inputs and a nugget.

The method is universal kriging: Rasmussen & Williams (2006), ch. 2.7.

A variance requires a product with an (n, n) matrix for each point, or with a smaller one (`subspace`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from bayeskin.surrogates.hyperparameters import SMALLEST_NUGGET, LatentFit
from bayeskin.surrogates.kernels import (
    correlations,
    kernel,
    squared_distances,
    trend_basis,
    trend_degree,
)
from bayeskin.surrogates.subspace import few_directions
from bayeskin.types import Array, FreezesArrays

CHUNK = 128  # number of points whose kernel rows fit into the cache


class Conditioned(NamedTuple):
    """A latent conditioned on its training rows: the matrices that `predict` multiplies by."""

    mapped: Array  # (n, d)
    whitener: NDArray[np.float64]  # (n, n) L^-1, column-major
    few: Array | None  # (r, n) replaces the whitener if r is at most half of n
    weights: Array  # (n,) K^-1 (y - H b)
    trend: Array  # (p,) b
    trend_weights: Array  # (n, p) K^-1 H
    trend_root: Array  # (p, p) inverse of the lower Cholesky factor of H^T K^-1 H
    centre: float
    deviation: float
    variance: float


class _Stack(NamedTuple):
    """All q latents with the same kernel, so that a single product serves all of them.

    The lower triangular whitener is multiplied in halves. Latents with few directions form a stack of their
    own, in which the upper half has no rows.
    """

    name: str
    latents: NDArray[np.intp]  # (q,) indices of the latents
    half: int  # half of n, or 0 for latents with few directions
    maps: Array  # (q, d, d)
    inputs: Array  # (q, d + 2, n) mapped inputs, 1, and -1/2 of the inputs' squared length
    top: Array  # (q, half, half) L^-1 transposed
    bottom: Array  # (q, n, n - half + p + 1) L^-1 or `few`, root H^T K^-1 and the weights, transposed
    trend: Array  # (q, p, p + 1) root and b, transposed
    nugget: Array  # (q, 1)
    centre: Array
    deviation: Array
    spread: Array

    def predict(self, centred: Array, basis: Array) -> tuple[Array, Array]:
        """Returns the mean and the variance (k, q) at centred inputs (k, d) with trend basis (k, p)."""
        rows = self._correlations(centred)
        k = len(centred)
        white = rows[:, :, : self.half] @ self.top
        mean, variance = np.empty((2, len(self.latents), k))
        _collect(white, rows @ self.bottom, basis @ self.trend, mean, variance)
        mean = self.centre + self.deviation * mean
        variance = np.maximum(variance + self.nugget, np.maximum(self.nugget, SMALLEST_NUGGET))
        return mean.T, (self.spread * variance).T

    def predict_mean(self, centred: Array, basis: Array) -> Array:
        """Returns only the mean (k, q) of `predict`, which needs products with vectors, not with matrices."""
        mean = self._correlations(centred) @ self.bottom[:, :, -1:]
        mean += basis @ self.trend[:, :, -1:]
        return np.asarray((self.centre + self.deviation * mean[:, :, 0]).T)

    def _correlations(self, centred: Array) -> Array:
        """Returns the correlations (q, k, n) with the training rows."""
        k, d = centred.shape
        mapped = np.ones((len(self.latents), k, d + 2))
        np.matmul(centred, self.maps, out=mapped[:, :, :d])
        mapped[:, :, d] = -0.5 * np.einsum("qki,qki->qk", mapped[:, :, :d], mapped[:, :, :d])
        return correlations(self.name, mapped @ self.inputs)


@nb.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _collect(white: Array, linear: Array, trend: Array, mean: Array, variance: Array) -> None:
    """Fills the mean and the variance (q, k), without nugget, from the products that `predict` computes."""
    half, p = white.shape[2], trend.shape[2] - 1
    rest = linear.shape[2] - p - 1
    for j in range(mean.shape[0]):
        for i in range(mean.shape[1]):
            first, second, known = white[j, i], linear[j, i], trend[j, i]
            unexplained = second[rest:]
            explained = 0.0
            for a in range(half):
                explained += first[a] * first[a]
            for a in range(rest):
                explained += second[a] * second[a]
            for a in range(p):
                left = known[a] - unexplained[a]
                explained -= left * left
            mean[j, i] = known[p] + unexplained[p]
            variance[j, i] = 1.0 - explained


def _turned(stack: Array) -> Array:
    return np.ascontiguousarray(stack.transpose(0, 2, 1))


@dataclass(frozen=True)
class LatentGPs(FreezesArrays):
    """Independent Gaussian processes of q latents.

    The matrix factors are derived from these few arrays, also after loading.

    inputs : (n, d) in the unit cube
    targets : (n, q)
    linear_maps : (q, d, d)
    nuggets : (q,)
    inflation : (q,) factors of the standard deviations, from cross-validation
    kernels : q names
    """

    inputs: Array
    targets: Array
    linear_maps: Array
    nuggets: Array
    inflation: Array
    kernels: tuple[str, ...]

    @classmethod
    def assemble(cls, unit: Array, targets: Array, fits: list[LatentFit]) -> LatentGPs:
        """Returns Gaussian processes of targets (n, q) at unit (n, d) with the hyperparameters of `fits`."""
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
    def conditioned(self) -> list[Conditioned]:
        return [self._condition(j) for j in range(len(self.kernels))]

    def _condition(self, j: int) -> Conditioned:
        n = len(self.inputs)
        basis = trend_basis(self.inputs, self.degree)
        centre = float(self.targets[:, j].mean())
        deviation = float(self.targets[:, j].std())
        deviation = deviation if deviation > 1e-12 * max(abs(centre), 1e-300) else 1.0
        target = (self.targets[:, j] - centre) / deviation
        mapped = (self.inputs - 0.5) @ self.linear_maps[j].T
        covariance = kernel(self.kernels[j], squared_distances(mapped, mapped))[0]
        covariance.flat[:: n + 1] = 1.0
        lower = np.linalg.cholesky(covariance + self.nuggets[j] * np.eye(n))
        whitener, _ = dtrtri(np.asfortranarray(lower), lower=1)
        white_basis, white_target = whitener @ basis, whitener @ target
        gram = np.linalg.cholesky(white_basis.T @ white_basis)
        trend = np.linalg.solve(gram.T, np.linalg.solve(gram, white_basis.T @ white_target))
        rest = white_target - white_basis @ trend
        return Conditioned(
            mapped,
            np.asfortranarray(whitener),
            few_directions(covariance, float(self.nuggets[j]), whitener),
            whitener.T @ rest,
            trend,
            whitener.T @ white_basis,
            np.linalg.inv(gram),
            centre,
            deviation,
            float(rest @ rest) / (n - basis.shape[1]),
        )

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Returns the mean and the variance of every latent at unit (k, d): two arrays (k, q).

        The variance includes the nugget.
        """
        mean = np.empty((len(unit), len(self.kernels)))
        variance = np.empty_like(mean)
        for start in range(0, len(unit), CHUNK):
            part = slice(start, start + CHUNK)
            basis = trend_basis(unit[part], self.degree)
            for stack in self._stacks:
                predicted = stack.predict(unit[part] - 0.5, basis)
                mean[part, stack.latents], variance[part, stack.latents] = predicted
        return mean, variance

    def predict_mean(self, unit: Array) -> Array:
        """Returns only the mean (k, q) of `predict`."""
        mean = np.empty((len(unit), len(self.kernels)))
        for start in range(0, len(unit), CHUNK):
            part = slice(start, start + CHUNK)
            basis = trend_basis(unit[part], self.degree)
            for stack in self._stacks:
                mean[part, stack.latents] = stack.predict_mean(unit[part] - 0.5, basis)
        return mean

    @cached_property
    def _stacks(self) -> list[_Stack]:
        alike: dict[tuple[str, bool], list[int]] = {}
        for j, latent in enumerate(self.conditioned):
            alike.setdefault((self.kernels[j], latent.few is None), []).append(j)
        return [self._stack(name, np.array(latents)) for (name, _), latents in sorted(alike.items())]

    def _stack(self, name: str, latents: NDArray[np.intp]) -> _Stack:
        given = [self.conditioned[j] for j in latents]
        whiteners = [latent.whitener if latent.few is None else latent.few for latent in given]
        half = len(self.inputs) // 2 if given[0].few is None else 0
        longest = max(len(whitener) for whitener in whiteners)
        whiteners = [np.pad(whitener, ((0, longest - len(whitener)), (0, 0))) for whitener in whiteners]
        mapped = np.stack([latent.mapped for latent in given])
        square = -0.5 * np.sum(mapped**2, axis=2, keepdims=True)
        linear = [
            np.vstack([whitener[half:], latent.trend_root @ latent.trend_weights.T, latent.weights])
            for latent, whitener in zip(given, whiteners, strict=True)
        ]
        deviation = np.array([latent.deviation for latent in given])
        spread = (self.inflation[latents] * deviation) ** 2 * [latent.variance for latent in given]
        return _Stack(
            name=name,
            latents=latents,
            half=half,
            maps=_turned(self.linear_maps[latents]),
            inputs=_turned(np.concatenate([mapped, np.ones_like(square), square], axis=2)),
            top=_turned(np.stack([whitener[:half, :half] for whitener in whiteners])),
            bottom=_turned(np.stack(linear)),
            trend=np.stack([np.column_stack([latent.trend_root.T, latent.trend]) for latent in given]),
            nugget=self.nuggets[latents][:, None],
            centre=np.array([latent.centre for latent in given])[:, None],
            deviation=deviation[:, None],
            spread=spread[:, None],
        )

    def leave_one_out(self) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) of each row given all other rows.

        The hyperparameters stay fixed.
        """
        mean, variance = np.empty_like(self.targets), np.empty_like(self.targets)
        for j, given in enumerate(self.conditioned):
            half = given.trend_weights @ given.trend_root.T
            diagonal = np.sum(given.whitener**2, axis=0) - np.sum(half**2, axis=1)
            mean[:, j] = self.targets[:, j] - given.deviation * given.weights / diagonal
            variance[:, j] = (self.inflation[j] * given.deviation) ** 2 * given.variance / diagonal
        return mean, variance
