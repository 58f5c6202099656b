"""Sparse polynomial chaos: Legendre polynomials orthonormal under the prior, few of them, found by a path.

Terms are chosen by orthogonal matching pursuit over hyperbolic index sets of growing degree (Blatman &
Sudret 2011, J. Comput. Phys. 230, 2345). Degree and number of terms minimise the error of folds that the
whole pursuit has not seen: leave-one-out with the terms kept is blind to their selection, and promised
errors ten times too small with 128 rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayeskin.polynomials import Indices, legendre_basis, multi_indices
from bayeskin.types import Array, _FreezesArrays

HIGHEST_DEGREE = 12
MOST_CANDIDATES = 500
MOST_TERMS = 120
FOLDS = 5


class SparseFit(NamedTuple):
    """Indices (k, d) of the terms of one latent; cross-validated error squared: mean, weighted mean."""

    indices: Indices
    variance: float
    error: float


def fit_sparse(unit: Array, target: Array, weights: Array) -> SparseFit:
    """The terms for one latent (n,) at unit-cube points (n, d); the degree grows while the error falls.

    weights (n,) of the rows in that error; the regression knows no weights.
    """
    n, dim = unit.shape
    fold = np.arange(n) % FOLDS
    most = max(min(n // 3, MOST_TERMS), 1)
    best, worse = SparseFit(np.zeros((1, dim), dtype=np.int64), np.inf, np.inf), 0
    for degree in range(1, HIGHEST_DEGREE + 1):
        indices = multi_indices(dim, degree)
        if len(indices) > MOST_CANDIDATES or worse == 2:
            break
        basis = legendre_basis(unit, indices)
        missed = np.empty((n, min(most, len(indices))))
        for k in range(FOLDS):
            missed[fold == k] = _pursue(basis, target, fold != k, missed.shape[1])[1]
        errors = np.average(missed**2, axis=0, weights=weights)
        step = int(np.argmin(errors))
        if errors[step] < best.error:
            chosen = _pursue(basis, target, np.ones(n, dtype=bool), step + 1)[0]
            variance = float(np.mean(missed[:, step] ** 2))
            best, worse = SparseFit(indices[chosen], variance, float(errors[step])), 0
        else:
            worse += 1
    return best


def _pursue(basis: Array, target: Array, learn: NDArray[np.bool_], most: int) -> tuple[list[int], Array]:
    """Orthogonal matching pursuit on the rows `learn`, from the constant on.

    Returns the terms in the order chosen, and after each the errors of the other rows (rows, most).
    Candidates are kept orthogonal to the chosen terms over the learning rows; the other rows go
    through the same combinations, so that their errors come without a solve.
    """
    learned, other = basis[learn], basis[~learn]
    scale = np.linalg.norm(learned, axis=0)
    learned, other = learned / scale, other / scale
    residual, missed = target[learn], target[~learn]
    squares = np.ones(len(scale))
    chosen: list[int] = []
    errors = np.empty((len(missed), most))
    for step in range(most):
        usable = squares > 1e-10
        usable[chosen] = False
        gain = np.where(usable, (residual @ learned) ** 2 / np.where(usable, squares, 1.0), -1.0)
        pick = int(np.argmax(gain)) if chosen else 0
        if not usable[pick]:
            errors[:, step:] = missed[:, None]
            break
        length = np.linalg.norm(learned[:, pick])
        direction, follow = learned[:, pick] / length, other[:, pick] / length
        chosen.append(pick)
        along = direction @ residual
        residual, missed = residual - along * direction, missed - along * follow
        overlap = direction @ learned
        learned -= np.outer(direction, overlap)
        other -= np.outer(follow, overlap)
        squares -= overlap**2
        errors[:, step] = missed
    return chosen, errors


class _Solved(NamedTuple):
    terms: NDArray[np.int64]  # positions of the latent's terms in the common index list
    coefficients: Array
    root: Array  # (k, k): leverage of a row of terms is |row @ root|^2
    residual: Array  # (n,) leave-one-out
    leverage: Array  # (n,)


@dataclass(frozen=True)
class LatentChaos(_FreezesArrays):
    """Expansions of q latents; coefficients are derived from these few arrays, also after loading.

    inputs (n, d) in the unit cube, targets (n, q), indices (P, d) of all terms in use, active (P, q)
    which of them a latent uses, errors (q,) cross-validated mean squared errors.
    """

    inputs: Array
    targets: Array
    indices: Indices
    active: NDArray[np.bool_]
    errors: Array

    @classmethod
    def assemble(cls, unit: Array, targets: Array, fits: list[SparseFit]) -> LatentChaos:
        """Expansions of targets (n, q) at unit (n, d) in the terms of `fits`."""
        indices = np.unique(np.vstack([fit.indices for fit in fits]), axis=0)
        active = np.stack(
            [(indices[:, None] == fit.indices[None]).all(axis=2).any(axis=1) for fit in fits], axis=1
        )
        return cls(unit, targets, indices, active, np.array([fit.variance for fit in fits]))

    @cached_property
    def _solved(self) -> list[_Solved]:
        basis = legendre_basis(self.inputs, self.indices)
        return [self._solve(basis, j) for j in range(self.targets.shape[1])]

    def _solve(self, basis: Array, j: int) -> _Solved:
        terms = np.flatnonzero(self.active[:, j])
        orthogonal, upper = np.linalg.qr(basis[:, terms])
        coefficients = np.linalg.solve(upper, orthogonal.T @ self.targets[:, j])
        leverage = np.einsum("ij,ij->i", orthogonal, orthogonal)
        residual = (self.targets[:, j] - basis[:, terms] @ coefficients) / (1.0 - leverage)
        return _Solved(terms, coefficients, np.linalg.inv(upper), residual, leverage)

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance of every latent at unit (k, d): two arrays (k, q).

        The variance is the cross-validated error, larger where the regression has more leverage.
        """
        basis = legendre_basis(unit, self.indices)
        mean = np.empty((len(unit), self.targets.shape[1]))
        variance = np.empty_like(mean)
        for j, fit in enumerate(self._solved):
            rows = basis[:, fit.terms]
            mean[:, j] = rows @ fit.coefficients
            variance[:, j] = self._variance(j, np.sum((rows @ fit.root) ** 2, axis=1))
        return mean, variance

    def predict_mean(self, unit: Array) -> Array:
        """The mean (k, q) of `predict` alone."""
        basis = legendre_basis(unit, self.indices)
        return np.stack([basis[:, fit.terms] @ fit.coefficients for fit in self._solved], axis=1)

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance of each row given all others, (n, q) each; terms kept."""
        residual = np.stack([fit.residual for fit in self._solved], axis=1)
        variance = [self._variance(j, fit.leverage) for j, fit in enumerate(self._solved)]
        return self.targets - residual, np.stack(variance, axis=1)

    def _variance(self, j: int, leverage: Array) -> Array:
        mean_leverage = float(np.mean(self._solved[j].leverage))
        return self.errors[j] * (1.0 + leverage) / (1.0 + mean_leverage)
