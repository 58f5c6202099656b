"""Kernels of a squared distance, and the polynomial trend that a Gaussian process departs from."""

from __future__ import annotations

import numpy as np

from bayeskin.types import Array

KERNELS = ("matern52", "gaussian")


def trend_basis(unit: Array, degree: int) -> Array:
    """Monomials up to `degree` (0, 1 or 2) of ``2 unit - 1``, (n, p)."""
    x = 2.0 * unit - 1.0
    columns = [np.ones((len(x), 1))]
    if degree >= 1:
        columns.append(x)
    if degree >= 2:
        left, right = np.triu_indices(x.shape[1])
        columns.append(x[:, left] * x[:, right])
    return np.hstack(columns)


def trend_degree(rows: int, dim: int) -> int:
    """The richest trend that leaves at least three rows a coefficient."""
    sizes = (1, 1 + dim, (dim + 1) * (dim + 2) // 2)
    return max([degree for degree, size in enumerate(sizes) if rows >= 3 * size], default=0)


def kernel(name: str, squared: Array) -> tuple[Array, Array]:
    """Kernel and its derivative by the squared distance, at squared distances of any shape."""
    if name == "gaussian":
        value = np.exp(-0.5 * squared)
        return value, -0.5 * value
    root = np.sqrt(5.0 * squared)
    decay = np.exp(-root)
    return (1.0 + root + (5.0 / 3.0) * squared) * decay, (-5.0 / 6.0) * (1.0 + root) * decay


def squared_distances(left: Array, right: Array) -> Array:
    """|left_i - right_j|^2, (n, k)."""
    squared = left @ right.T
    squared *= -2.0
    squared += np.einsum("ij,ij->i", left, left)[:, None]
    squared += np.einsum("ij,ij->i", right, right)
    return np.maximum(squared, 0.0, out=squared)
