"""Estimates the correlation in time of a load cell's noise, which lies on top of a slowly varying force.

The model of the noise is white noise plus a first-order autoregression,

    gamma(h) = sd^2 [ w delta(h) + (1 - w) exp(-|h| / tau) ].

The projection P = I - Q Q' subtracts the best-fitting parabola from each window of a recording. It also
removes some of the slow noise. Therefore the averaged lagged products of the residuals are not matched to
gamma, but to the part of gamma that P leaves, tr(S_h P Gamma P). This part is linear in the two amplitudes.
Non-negative least squares gives the amplitudes for each tau of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import matmul_toeplitz
from scipy.optimize import nnls
from scipy.signal import correlate

from bayeskin.types import Array, frozen_array


@dataclass(frozen=True)
class CorrelationSettings:
    """Settings of the estimate of a correlation.

    times : number of correlation times that are tried
    longest : longest correlation time that is tried, as a share of the window
    chance : a correlated part must lower the misfit by more than this multiple of the variance that white
        noise gives an estimated correlation, the square of three standard deviations
    """

    times: int = 40
    longest: float = 0.4
    chance: float = 9.0


@dataclass(frozen=True)
class NoiseShape:
    """Correlation of noise: the white share w of the variance, and the time tau [s] of the other part."""

    white_share: float
    time_s: float

    def at(self, lag_s: ArrayLike) -> Array:
        """Returns the correlation at the given lags [s], in the same shape."""
        lag = np.abs(np.asarray(lag_s, dtype=float))
        return self.white_share * (lag == 0) + (1 - self.white_share) * np.exp(-lag / self.time_s)


WHITE = NoiseShape(1.0, 1.0)


def parabola_basis(size: int) -> Array:
    """Returns orthonormal polynomials up to degree two on `size` samples, (size, 3)."""
    return np.linalg.qr(np.vander(np.linspace(-1, 1, size), 3))[0]


def residual_windows(values: Array, size: int) -> Array:
    """Returns consecutive windows of values (n,) without their best-fitting parabola, (n // size, size)."""
    count = len(values) // size
    offset = (len(values) - count * size) // 2
    windows = values[offset : offset + count * size].reshape(count, size)
    basis = parabola_basis(size)
    return windows - (windows @ basis) @ basis.T


def lagged_products(windows: Array, kept: NDArray[np.bool_], lags: int) -> Array:
    """Returns the mean product (lags,) of residuals at lags 0..lags-1, over pairs of kept samples.

    The windows and `kept` have shape (k, size). Windows with more than three times the median variance are
    left out, so that no single event determines the correlation.
    """
    variance = np.mean(windows**2, axis=1)
    typical = variance <= 3 * np.median(variance)
    kept = kept[typical]
    scaled = np.where(kept, windows[typical], 0.0)
    size = windows.shape[1]
    products = [np.sum(scaled[:, : size - h] * scaled[:, h:]) for h in range(lags)]
    pairs = [np.count_nonzero(kept[:, : size - h] & kept[:, h:]) for h in range(lags)]
    return np.array(products) / np.maximum(pairs, 1)


def expected_products(correlation: Array, lags: int) -> Array:
    """Returns the mean of each diagonal of P Gamma P, (lags,), for noise with a given correlation (size,)."""
    size = len(correlation)
    basis = parabola_basis(size)
    correlated = matmul_toeplitz(correlation, basis)
    inner = basis @ (basis.T @ correlated)
    change = np.zeros(lags)
    for q, g, i in zip(basis.T, correlated.T, inner.T, strict=True):
        cross = correlate(g, q)[size - 1 :] + correlate(q, g)[size - 1 :] - correlate(i, q)[size - 1 :]
        change -= cross[:lags]
    return correlation[:lags] + change / (size - np.arange(lags))


def fit_shape(
    correlogram: Array, samples: int, interval_s: float, size: int,
    settings: CorrelationSettings = CorrelationSettings(),
) -> NoiseShape:  # fmt: skip
    """Returns the noise whose expected lagged products are nearest to the measured ones.

    correlogram (lags,) contains the mean lagged products divided by the product at lag 0. They come from
    `samples` samples in windows of `size`. The result is white noise unless a correlated part lowers the
    misfit by more than chance allows under white noise. The estimated correlations of white noise scatter
    with variance 1 / samples.
    """
    taus, dictionary = _dictionary(interval_s, size, len(correlogram), settings)
    white = dictionary[0]
    remainder = correlogram - white * float(white @ correlogram) / float(white @ white)
    least, best = float(remainder @ remainder) - settings.chance / samples, WHITE
    for tau, slow in zip(taus, dictionary[1:], strict=True):
        amplitude, misfit = nnls(np.column_stack([white, slow]), correlogram)
        if misfit**2 < least:
            least, best = misfit**2, NoiseShape(float(amplitude[0] / amplitude.sum()), float(tau))
    return best


@lru_cache(maxsize=8)
def _dictionary(
    interval_s: float, size: int, lags: int, settings: CorrelationSettings
) -> tuple[Array, Array]:
    """Returns the correlation times that are tried, (k,), and the expected products (k + 1, lags).

    The first row of the products belongs to white noise, the others belong to the correlation times.
    """
    lag_s = interval_s * np.arange(size)
    taus = np.geomspace(interval_s, settings.longest * size * interval_s, settings.times)
    correlations = [np.where(lag_s == 0, 1.0, 0.0), *(np.exp(-lag_s / tau) for tau in taus)]
    products = np.array([expected_products(correlation, lags) for correlation in correlations])
    return frozen_array(taus), frozen_array(products)


def weighted_covariance(a: Array, b: Array, correlation: Array) -> float:
    """Returns the covariance of the sums a'x and b'x for noise x of unit variance; weights a, b (size,)."""
    return float(a @ matmul_toeplitz(correlation[: len(a)], b))


def effective_windows(shape: NoiseShape, interval_s: float, size: int) -> float:
    """Returns the degrees of freedom of one window's mean square: 2 divided by its relative variance."""
    rho = expected_products(shape.at(interval_s * np.arange(size)), size)
    weights = np.where(np.arange(size) == 0, 1.0, 2.0) * (1 - np.arange(size) / size)
    return float(size / np.sum(weights * (rho / rho[0]) ** 2))
