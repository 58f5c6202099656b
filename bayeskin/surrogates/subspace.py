"""Finds the few directions in which the rows of a kernel lie, so that variances need smaller products.

If the nugget is not small, the rows of the kernel lie almost in a subspace of few directions. Pivoted
Cholesky factors give this subspace (Harbrecht, Peters & Schneider 2012, Appl. Numer. Math. 62:428), and a
product with an (r, n) matrix is then enough. The part outside the subspace counts as unexplained. The
variance therefore becomes larger, never smaller. At the training rows it grows by at most `spared` of the
nugget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.linalg.lapack import dpstrf

from bayeskin.types import Array


@dataclass(frozen=True)
class SubspaceSettings:
    """Settings of the subspace near which the rows of a kernel lie.

    least_rows : smallest number of rows for which a subspace is sought; with fewer rows the products cost
        almost nothing
    least_nugget : smallest nugget with which it is sought; with a smaller nugget the rows are not near a
        subspace, or rounding hides it
    spared : share of the nugget by which a variance may become larger at a training row
    residuals : residuals of the Cholesky factors that are tried, as shares of the nugget
    """

    least_rows: int = 100
    least_nugget: float = 1e-6
    spared: float = 0.1
    residuals: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)


SUBSPACE = SubspaceSettings()


def few_directions(covariance: Array, nugget: float, whitener: Array) -> Array | None:
    """Returns a matrix (r, n) that whitens rows of the kernel almost as `whitener` does.

    `covariance` (n, n) is the kernel matrix without its nugget. The result is None for few rows, for a small
    nugget, and if more directions than half the number of rows are necessary.
    """
    n = len(covariance)
    if n < SUBSPACE.least_rows or nugget < SUBSPACE.least_nugget:
        return None
    explained = np.sum((whitener @ covariance) ** 2, axis=0)
    for residual in SUBSPACE.residuals:
        factor, pivots, rank, _ = dpstrf(covariance, tol=residual * min(nugget, 0.5), lower=1)
        if rank > n // 2:
            return None
        columns = np.empty((n, rank))
        columns[pivots - 1] = np.tril(factor)[:, :rank]
        inside = qr(columns, mode="economic")[0]
        lower = np.linalg.cholesky(inside.T @ covariance @ inside + nugget * np.eye(rank))
        few = solve_triangular(lower, inside.T, lower=True)
        if np.max(explained - np.sum((few @ covariance) ** 2, axis=0)) <= SUBSPACE.spared * nugget:
            return np.asarray(few)
    return None
