"""Defines kernels of a squared distance and the polynomial trend of a Gaussian process."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import Array

KERNELS = ("matern52", "gaussian")


def trend_basis(unit: Array, degree: int) -> Array:
    """Returns the monomials (n, p) up to `degree` (0, 1 or 2) of ``2 unit - 1``."""
    x = 2.0 * unit - 1.0
    columns = [np.ones((len(x), 1))]
    if degree >= 1:
        columns.append(x)
    if degree >= 2:
        left, right = _pairs(x.shape[1])
        columns.append(x[:, left] * x[:, right])
    return np.concatenate(columns, axis=1)


@lru_cache
def _pairs(dim: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.triu_indices(dim)


def trend_degree(rows: int, dim: int) -> int:
    """Returns the highest degree of the trend (0, 1 or 2) with at least three rows for each coefficient."""
    sizes = (1, 1 + dim, (dim + 1) * (dim + 2) // 2)
    return max([degree for degree, size in enumerate(sizes) if rows >= 3 * size], default=0)


def kernel(name: str, squared: Array) -> tuple[Array, Array]:
    """Returns the kernel and its derivative by the squared distance, at squared distances of any shape."""
    if name == "gaussian":
        value = np.exp(-0.5 * squared)
        return value, -0.5 * value
    root = np.sqrt(5.0 * squared)
    decay = np.exp(-root)
    return (1.0 + root + (5.0 / 3.0) * squared) * decay, (-5.0 / 6.0) * (1.0 + root) * decay


def correlations(name: str, minus_half_squared: Array) -> Array:
    """Returns the kernel at squared distances of any shape, given as -1/2 times the squared distance.

    The argument is overwritten.
    """
    value = np.minimum(minus_half_squared, 0.0, out=minus_half_squared)
    if name == "gaussian":
        return np.exp(value, out=value)
    value *= -10.0
    root = np.sqrt(value)
    value *= 1.0 / 3.0
    value += root
    value += 1.0
    np.negative(root, out=root)
    value *= np.exp(root, out=root)
    return value


def squared_distances(left: Array, right: Array) -> Array:
    """Returns the squared distances |left_i - right_j|^2, (n, k)."""
    squared = left @ right.T
    squared *= -2.0
    squared += np.einsum("ij,ij->i", left, left)[:, None]
    squared += np.einsum("ij,ij->i", right, right)
    return np.maximum(squared, 0.0, out=squared)
