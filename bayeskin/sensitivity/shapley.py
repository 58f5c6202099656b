"""Computes Shapley effects: each parameter's share of the force's variance for correlated parameters.

The parameters of a posterior are correlated. First-order and total Sobol' indices of correlated parameters do
not add up to the variance, but Shapley effects do. They are never negative, and they divide the variance that
two parameters explain together between these two (Owen 2014, SIAM/ASA J. Uncertainty Quantification 2:245;
Song, Nelson & Staum 2016, ibid. 4:1060).

The effects are estimated from the given draws. A set of parameters explains the variance of the force minus
the mean squared error of the polynomial that predicts the force best from this set. Each draw is predicted by
a fit to all other draws. Broto, Bachoc & Depecker (2020, ibid. 8:693) use the nearest neighbour in the set
instead, but on a narrow ridge the nearest neighbour is farther away than the ridge is wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.sensitivity.estimators import REPLICATES
from bayeskin.types import Array, FreezesArrays, ParameterSpace


@dataclass(frozen=True)
class ShapleySettings:
    """Settings of Shapley effects.

    highest_degree : highest degree of a polynomial
    draws_a_term : least number of draws for each term of a polynomial
    components : number of principal components of the force that are predicted; the others vary little
    replicates, blocks : number of bootstrap replicates, and of blocks of draws that the bootstrap resamples
    """

    highest_degree: int = 10
    draws_a_term: int = 5
    components: int = 8
    replicates: int = REPLICATES
    blocks: int = 40


@dataclass(frozen=True)
class ShapleyResult(FreezesArrays):
    """Shapley effects: shares (d,) of the variance of the whole force history.

    `interval` (2, d) holds the 5 % and 95 % limits. `variance_n2` is the mean of the variance over time.
    `distribution` says which distribution the draws come from. The effects are NaN if the force has no
    variance.
    """

    names: tuple[str, ...]
    effects: Array
    interval: Array
    variance_n2: float
    draws: int
    distribution: str


def shapley(
    space: ParameterSpace,
    theta: ArrayLike,
    force_n: ArrayLike,
    edges_s: ArrayLike,
    rng: np.random.Generator,
    distribution: str,
    settings: ShapleySettings = ShapleySettings(),
) -> ShapleyResult:
    """Returns the Shapley effects of the parameters theta (n, d), in SI, on the force_n (n, m).

    The bins have the edges edges_s (m + 1,). The draws should be nearly independent. A bootstrap over blocks
    of draws gives the intervals.
    """
    unit, force = space.to_unit(theta), np.asarray(force_n, dtype=float)
    weight = np.diff(np.asarray(edges_s, dtype=float))
    centred = (force - force.mean(axis=0)) * np.sqrt(weight / weight.sum())
    squares = np.einsum("nm,nm->n", centred, centred)
    explained = _explained_by_set(unit, centred, squares, settings)
    block = rng.permutation(len(squares)) % min(settings.blocks, len(squares))
    sums = np.stack([np.bincount(block, values) for values in explained.values()])
    picks = rng.integers(0, sums.shape[1], (settings.replicates, sums.shape[1]))
    resampled = sums[:, picks].sum(axis=2)  # (sets, replicates)
    columns = dict(zip(explained, range(len(explained)), strict=True))
    best = _shares_from_sets(sums.sum(axis=1)[:, None], columns, space.dim)[0]
    limits = np.quantile(_shares_from_sets(resampled, columns, space.dim), [0.05, 0.95], axis=0)
    return ShapleyResult(space.names, best, limits, float(squares.mean()), len(squares), distribution)


def _explained_by_set(
    unit: Array, centred: Array, own: Array, settings: ShapleySettings
) -> dict[tuple[int, ...], Array]:
    """Returns, for each set of parameters, each draw's part (n,) of the variance that the set explains."""
    dim, kept = unit.shape[1], slice(settings.components)
    left, size, _ = np.linalg.svd(centred, full_matrices=False)
    components = left[:, kept] * size[kept]
    predicted = np.einsum("nr,nr->n", components, components)
    explained: dict[tuple[int, ...], Array] = {(): np.zeros(len(own))}
    for count in range(1, dim):
        for chosen in combinations(range(dim), count):
            explained[chosen] = predicted - _squared_errors(unit[:, chosen], components, settings)
    explained[tuple(range(dim))] = own
    return explained


def _squared_errors(points: Array, values: Array, settings: ShapleySettings) -> Array:
    """Returns the squared errors (n,) with which a polynomial in points (n, k) predicts values (n, r).

    Each row is predicted by a fit to all other rows. The polynomial has the degree with the smallest sum of
    errors. Without a better polynomial the errors are the squares of `values`.
    """
    scaled = _scaled_principal_axes(points)
    best = np.einsum("nr,nr->n", values, values)
    for degree in range(1, settings.highest_degree + 1):
        terms = multi_indices(points.shape[1], degree, 1.0)
        if len(terms) * settings.draws_a_term > len(points):
            break
        basis = np.linalg.qr(legendre_basis(scaled, terms))[0]
        residual = values - basis @ (basis.T @ values)
        kept = np.maximum(1.0 - np.einsum("np,np->n", basis, basis), np.finfo(float).eps)
        errors = np.einsum("nr,nr->n", residual, residual) / kept**2
        best = errors if errors.sum() < best.sum() else best
    return best


def _scaled_principal_axes(points: Array) -> Array:
    """Returns points (n, k) rotated to their principal axes, each axis scaled to the range 0 to 1."""
    turned = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[0]
    low, high = turned.min(axis=0), turned.max(axis=0)
    return np.asarray((turned - low) / np.where(high > low, high - low, 1.0))


def _shares_from_sets(variance: Array, columns: dict[tuple[int, ...], int], dim: int) -> Array:
    """Returns the shares (r, d) of the parameters from the variance that each set explains, (sets, r)."""
    shares = np.zeros((variance.shape[1], dim))
    for chosen, row in columns.items():
        for j in set(range(dim)) - set(chosen):
            larger = columns[tuple(sorted((*chosen, j)))]
            shares[:, j] += (variance[larger] - variance[row]) / (dim * comb(dim - 1, len(chosen)))
    whole = variance[columns[tuple(range(dim))]]
    return shares / np.where(whole > 0.0, whole, np.nan)[:, None]
