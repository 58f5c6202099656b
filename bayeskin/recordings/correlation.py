"""Correlation in time of a load cell's noise, where a slow force that is not noise lies under it.

The noise is taken as white plus a first-order autoregression,

    gamma(h) = sd^2 [ w delta(h) + (1 - w) exp(-|h| / tau) ].

Each window of a recording loses its best parabola, P = I - Q Q', which also takes some of the slow noise.
So the averaged lagged products of the residuals are matched not to gamma but to what P leaves of it,
tr(S_h P Gamma P), which is linear in the two amplitudes: they come from non-negative least squares, for
each tau of a grid.
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

_DEGREE = 2
_GRID = 40  # correlation times tried, up to this share of a window:
_LONGEST = 0.4
_CHANCE = 9.0  # three standard deviations, squared


@dataclass(frozen=True)
class NoiseShape:
    """Correlation of noise: the white share w of its variance, and the time tau [s] of the rest."""

    white_share: float
    time_s: float

    def at(self, lag_s: ArrayLike) -> Array:
        """Correlation at the lags [s] given, same shape."""
        lag = np.abs(np.asarray(lag_s, dtype=float))
        return self.white_share * (lag == 0) + (1 - self.white_share) * np.exp(-lag / self.time_s)


WHITE = NoiseShape(1.0, 1.0)


def parabola_basis(size: int) -> Array:
    """Orthonormal polynomials up to degree two on `size` samples, (size, 3)."""
    return np.linalg.qr(np.vander(np.linspace(-1, 1, size), _DEGREE + 1))[0]


def residual_windows(values: Array, size: int) -> Array:
    """Consecutive windows of values (n,) without their best parabola, (n // size, size)."""
    count = len(values) // size
    offset = (len(values) - count * size) // 2
    windows = values[offset : offset + count * size].reshape(count, size)
    basis = parabola_basis(size)
    return windows - (windows @ basis) @ basis.T


def lagged_products(windows: Array, kept: NDArray[np.bool_], lags: int) -> Array:
    """Mean product of residuals at lags 0..lags-1, (lags,), over pairs of kept samples of windows (k, size).

    Windows with more than three times the usual variance are left out: no one event sets the correlation.
    """
    variance = np.mean(windows**2, axis=1)
    usual = variance <= 3 * np.median(variance)
    kept = kept[usual]
    scaled = np.where(kept, windows[usual], 0.0)
    size = windows.shape[1]
    products = [np.sum(scaled[:, : size - h] * scaled[:, h:]) for h in range(lags)]
    pairs = [np.count_nonzero(kept[:, : size - h] & kept[:, h:]) for h in range(lags)]
    return np.array(products) / np.maximum(pairs, 1)


def expected_products(correlation: Array, lags: int) -> Array:
    """Mean of each diagonal of P Gamma P, (lags,), for a noise with correlation (size,)."""
    size = len(correlation)
    basis = parabola_basis(size)
    carried = matmul_toeplitz(correlation, basis)
    inner = basis @ (basis.T @ carried)
    out = np.zeros(lags)
    for q, g, i in zip(basis.T, carried.T, inner.T, strict=True):
        cross = correlate(g, q)[size - 1 :] + correlate(q, g)[size - 1 :] - correlate(i, q)[size - 1 :]
        out -= cross[:lags]
    return correlation[:lags] + out / (size - np.arange(lags))


def fit_shape(correlogram: Array, samples: int, interval_s: float, size: int) -> NoiseShape:
    """The noise whose expected products are nearest to those found.

    correlogram (lags,) are mean lagged products over that at lag 0, from `samples` samples in windows of
    `size`. White unless a correlated part lowers the misfit by more than white noise would let it: the
    estimates of white noise's correlations scatter with variance 1 / samples.
    """
    taus, dictionary = _dictionary(interval_s, size, len(correlogram))
    white = dictionary[0]
    only = correlogram - white * float(white @ correlogram) / float(white @ white)
    least, best = float(only @ only) - _CHANCE / samples, WHITE
    for tau, slow in zip(taus, dictionary[1:], strict=True):
        amplitude, misfit = nnls(np.column_stack([white, slow]), correlogram)
        if misfit**2 < least:
            least, best = misfit**2, NoiseShape(float(amplitude[0] / amplitude.sum()), float(tau))
    return best


@lru_cache(maxsize=8)
def _dictionary(interval_s: float, size: int, lags: int) -> tuple[Array, Array]:
    """The correlation times tried (k,); the expected products of white noise and of each (k + 1, lags)."""
    lag_s = interval_s * np.arange(size)
    taus = np.geomspace(interval_s, _LONGEST * size * interval_s, _GRID)
    correlations = [np.where(lag_s == 0, 1.0, 0.0), *(np.exp(-lag_s / tau) for tau in taus)]
    products = np.array([expected_products(correlation, lags) for correlation in correlations])
    return frozen_array(taus), frozen_array(products)


def weighted_covariance(a: Array, b: Array, correlation: Array) -> float:
    """Covariance of the sums a'x and b'x, weights (size,), for noise of unit variance."""
    return float(a @ matmul_toeplitz(correlation[: len(a)], b))


def effective_windows(shape: NoiseShape, interval_s: float, size: int) -> float:
    """Degrees of freedom of one window's mean square: 2 / its relative variance."""
    rho = expected_products(shape.at(interval_s * np.arange(size)), size)
    weights = np.where(np.arange(size) == 0, 1.0, 2.0) * (1 - np.arange(size) / size)
    return float(size / np.sum(weights * (rho / rho[0]) ** 2))
