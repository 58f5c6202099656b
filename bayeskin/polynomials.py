"""Products of Legendre polynomials over the unit cube, and the choice of the terms of an expansion."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from bayeskin.types import Array

HYPERBOLIC_NORM = 0.75
Indices = NDArray[np.int64]


def multi_indices(dim: int, degree: int, norm: float = HYPERBOLIC_NORM) -> Indices:
    """Returns the degrees (P, dim) of the terms with (sum_i a_i^norm)^(1/norm) <= degree.

    The terms are sorted by their total degree, lowest first.
    """
    cost = np.arange(degree + 1.0) ** norm
    indices, costs = np.zeros((1, 0), dtype=np.int64), np.zeros(1)
    for _ in range(dim):
        total = costs[:, None] + cost
        row, power = np.nonzero(total <= degree**norm * (1.0 + 1e-12))
        indices, costs = np.column_stack([indices[row], power]), total[row, power]
    return indices[np.argsort(indices.sum(axis=1), kind="stable")]


def legendre_basis(unit: Array, indices: Indices) -> Array:
    """Returns products of Legendre polynomials at unit (n, d), orthonormal over the uniform cube, (n, P)."""
    degree = int(indices.max(initial=0))
    powers = legvander(2.0 * unit - 1.0, degree) * np.sqrt(2.0 * np.arange(degree + 1) + 1.0)
    values = np.ones((len(unit), len(indices)))
    for j in range(unit.shape[1]):
        values *= powers[:, j, indices[:, j]]
    return values
