"""Fits sparse polynomial chaos expansions: few Legendre polynomials that are orthonormal under the prior.

Orthogonal matching pursuit chooses the terms from hyperbolic index sets of growing degree (Blatman & Sudret
2011, J. Comput. Phys. 230, 2345). The degree and the number of terms minimise the error on folds that the
whole pursuit has not seen. Leave-one-out with fixed terms does not see the effect of their selection: with
128 rows its errors were ten times too small.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayeskin.polynomials import Indices, legendre_basis, multi_indices
from bayeskin.types import Array, FreezesArrays


@dataclass(frozen=True)
class ChaosSettings:
    """Settings of the choice of terms.

    highest_degree : highest degree of a polynomial
    most_candidates, most_terms : largest number of polynomials among which terms are chosen, and of terms
    folds : number of folds of the cross-validation
    """

    highest_degree: int = 12
    most_candidates: int = 500
    most_terms: int = 120
    folds: int = 5


class SparseFit(NamedTuple):
    """Indices (k, d) of the terms of one latent, with the mean squared error of the cross-validation.

    `variance` is the plain mean of the squared errors, and `error` their weighted mean.
    """

    indices: Indices
    variance: float
    error: float


def fit_sparse(
    unit: Array, target: Array, weights: Array, settings: ChaosSettings = ChaosSettings()
) -> SparseFit:
    """Returns the terms for one latent (n,) at unit-cube points (n, d).

    The degree grows until two successive degrees bring no improvement. `weights` (n,) are the weights of the
    rows in the error. The regression does not use them.
    """
    n, dim = unit.shape
    fold = np.arange(n) % settings.folds
    most = max(min(n // 3, settings.most_terms), 1)
    best, failures = SparseFit(np.zeros((1, dim), dtype=np.int64), np.inf, np.inf), 0
    for degree in range(1, settings.highest_degree + 1):
        indices = multi_indices(dim, degree)
        if len(indices) > settings.most_candidates or failures == 2:
            break
        basis = legendre_basis(unit, indices)
        residual = np.empty((n, min(most, len(indices))))
        for k in range(settings.folds):
            residual[fold == k] = pursue(basis, target, fold != k, residual.shape[1])[1]
        errors = np.average(residual**2, axis=0, weights=weights)
        step = int(np.argmin(errors))
        if errors[step] < best.error:
            chosen = pursue(basis, target, np.ones(n, dtype=bool), step + 1)[0]
            variance = float(np.mean(residual[:, step] ** 2))
            best, failures = SparseFit(indices[chosen], variance, float(errors[step])), 0
        else:
            failures += 1
    return best


def pursue(basis: Array, target: Array, learn: NDArray[np.bool_], most: int) -> tuple[list[int], Array]:
    """Returns the terms in the order in which the pursuit chooses them, and the errors of the other rows.

    Orthogonal matching pursuit uses the rows `learn` and begins with the constant. The errors (rows, most)
    are those after each step. Candidates are kept orthogonal to the chosen terms over the rows `learn`. The
    other rows undergo the same linear combinations, so that their errors require no further solution.
    """
    learned, held_out = basis[learn], basis[~learn]
    scale = np.linalg.norm(learned, axis=0)
    learned, held_out = learned / scale, held_out / scale
    residual, error = target[learn], target[~learn]
    squares = np.ones(len(scale))
    chosen: list[int] = []
    errors = np.empty((len(error), most))
    for step in range(most):
        usable = squares > 1e-10
        usable[chosen] = False
        gain = np.where(usable, (residual @ learned) ** 2 / np.where(usable, squares, 1.0), -1.0)
        pick = int(np.argmax(gain)) if chosen else 0
        if not usable[pick]:
            errors[:, step:] = error[:, None]
            break
        length = np.linalg.norm(learned[:, pick])
        direction, held_out_direction = learned[:, pick] / length, held_out[:, pick] / length
        chosen.append(pick)
        along = direction @ residual
        residual, error = residual - along * direction, error - along * held_out_direction
        overlap = direction @ learned
        learned -= np.outer(direction, overlap)
        held_out -= np.outer(held_out_direction, overlap)
        squares -= overlap**2
        errors[:, step] = error
    return chosen, errors


class _Regression(NamedTuple):
    """Regression of one latent on its terms.

    terms : positions of the latent's terms in the common index list
    root : (k, k) matrix with which the leverage of a row of terms is |row @ root|^2
    residual : (n,) leave-one-out residuals
    leverage : (n,) leverages of the training rows
    """

    terms: NDArray[np.int64]
    coefficients: Array
    root: Array
    residual: Array
    leverage: Array


@dataclass(frozen=True)
class LatentChaos(FreezesArrays):
    """Expansions of q latents; the coefficients are derived from these few arrays, also after loading.

    inputs : (n, d) in the unit cube
    targets : (n, q)
    indices : (P, d) indices of all terms in use
    active : (P, q) marks the terms that each latent uses
    errors : (q,) cross-validated mean squared errors
    """

    inputs: Array
    targets: Array
    indices: Indices
    active: NDArray[np.bool_]
    errors: Array

    @classmethod
    def assemble(cls, unit: Array, targets: Array, fits: list[SparseFit]) -> LatentChaos:
        """Returns the expansions of targets (n, q) at unit (n, d) in the terms of `fits`."""
        indices = np.unique(np.vstack([fit.indices for fit in fits]), axis=0)
        active = np.stack(
            [(indices[:, None] == fit.indices[None]).all(axis=2).any(axis=1) for fit in fits], axis=1
        )
        return cls(unit, targets, indices, active, np.array([fit.variance for fit in fits]))

    @cached_property
    def _solved(self) -> list[_Regression]:
        basis = legendre_basis(self.inputs, self.indices)
        return [self._solve(basis, j) for j in range(self.targets.shape[1])]

    def _solve(self, basis: Array, j: int) -> _Regression:
        terms = np.flatnonzero(self.active[:, j])
        orthogonal, upper = np.linalg.qr(basis[:, terms])
        coefficients = np.linalg.solve(upper, orthogonal.T @ self.targets[:, j])
        leverage = np.einsum("ij,ij->i", orthogonal, orthogonal)
        residual = (self.targets[:, j] - basis[:, terms] @ coefficients) / (1.0 - leverage)
        return _Regression(terms, coefficients, np.linalg.inv(upper), residual, leverage)

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Returns the mean and the variance of every latent at unit (k, d): two arrays (k, q).

        The variance is the cross-validated error. It is larger where the regression has more leverage.
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
        """Returns only the mean (k, q) of `predict`."""
        basis = legendre_basis(unit, self.indices)
        return np.stack([basis[:, fit.terms] @ fit.coefficients for fit in self._solved], axis=1)

    def leave_one_out(self) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) of each row given all other rows; the terms stay fixed."""
        residual = np.stack([fit.residual for fit in self._solved], axis=1)
        variance = [self._variance(j, fit.leverage) for j, fit in enumerate(self._solved)]
        return self.targets - residual, np.stack(variance, axis=1)

    def _variance(self, j: int, leverage: Array) -> Array:
        mean_leverage = float(np.mean(self._solved[j].leverage))
        return self.errors[j] * (1.0 + leverage) / (1.0 + mean_leverage)
