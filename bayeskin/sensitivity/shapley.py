"""Shapley effects: shares of the force's variance where the parameters are correlated, as a posterior's are.

With correlated inputs first-order and total Sobol' indices no longer add up to a variance; Shapley effects
do, are never negative, and share what two parameters explain together between them (Owen 2014, SIAM/ASA J.
Uncertainty Quantification 2:245; Song, Nelson & Staum 2016, ibid. 4:1060). They are estimated from the draws
at hand: a set of parameters explains the variance of the force less the mean squared error of the polynomial
that predicts it best from that set, each draw by a fit to all others. The nearest neighbour in that set, the
estimate of Broto, Bachoc & Depecker (2020, ibid. 8:693), is farther away than a narrow ridge is wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.types import Array, ParameterSpace, _FreezesArrays

REPLICATES = 200
HIGHEST_DEGREE = 10
DRAWS_A_TERM = 5  # of a polynomial, at least
COMPONENTS = 8  # of the force that are predicted; what varies beyond them is small
_BLOCKS = 40  # of draws, that the bootstrap draws among


@dataclass(frozen=True)
class ShapleyResult(_FreezesArrays):
    """Shares (d,) of the variance of the whole force history, with 5 and 95 % limits (2, d).

    variance_n2: its mean over time. `distribution` says what the draws are of. NaN without variance.
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
) -> ShapleyResult:
    """Shapley effects of parameters theta (n, d) in SI on the force_n (n, m) of bins edges_s (m + 1,).

    The draws should be nearly independent. Intervals are by bootstrap over blocks of draws.
    """
    unit, force = space.to_unit(theta), np.asarray(force_n, dtype=float)
    weight = np.diff(np.asarray(edges_s, dtype=float))
    centred = (force - force.mean(axis=0)) * np.sqrt(weight / weight.sum())
    own = np.einsum("nm,nm->n", centred, centred)
    explained = _explained(unit, centred, own)
    block = rng.permutation(len(own)) % min(_BLOCKS, len(own))
    sums = np.stack([np.bincount(block, values) for values in explained.values()])
    picks = rng.integers(0, sums.shape[1], (REPLICATES, sums.shape[1]))
    spread_of = sums[:, picks].sum(axis=2)  # (sets, replicates)
    columns = dict(zip(explained, range(len(explained)), strict=True))
    best = _effects(sums.sum(axis=1)[:, None], columns, space.dim)[0]
    limits = np.quantile(_effects(spread_of, columns, space.dim), [0.05, 0.95], axis=0)
    return ShapleyResult(space.names, best, limits, float(own.mean()), len(own), distribution)


def _explained(unit: Array, centred: Array, own: Array) -> dict[tuple[int, ...], Array]:
    """By set of parameters, each draw's part (n,) of the variance that the set explains."""
    dim = unit.shape[1]
    left, size, _ = np.linalg.svd(centred, full_matrices=False)
    components = left[:, :COMPONENTS] * size[:COMPONENTS]
    predicted = np.einsum("nr,nr->n", components, components)
    out: dict[tuple[int, ...], Array] = {(): np.zeros(len(own))}
    for count in range(1, dim):
        for chosen in combinations(range(dim), count):
            out[chosen] = predicted - _left(unit[:, chosen], components)
    out[tuple(range(dim))] = own
    return out


def _left(points: Array, values: Array) -> Array:
    """Squared error (n,) of values (n, r) by a polynomial of points (n, k) fitted to all other rows.

    Of the degree at which these errors are least in sum; at most `values` squared in sum, by none at all.
    """
    inside = _spread_evenly(points)
    best = np.einsum("nr,nr->n", values, values)
    for degree in range(1, HIGHEST_DEGREE + 1):
        terms = multi_indices(points.shape[1], degree, 1.0)
        if len(terms) * DRAWS_A_TERM > len(points):
            break
        basis = np.linalg.qr(legendre_basis(inside, terms))[0]
        missed = values - basis @ (basis.T @ values)
        kept = np.maximum(1.0 - np.einsum("np,np->n", basis, basis), np.finfo(float).eps)
        errors = np.einsum("nr,nr->n", missed, missed) / kept**2
        best = errors if errors.sum() < best.sum() else best
    return best


def _spread_evenly(points: Array) -> Array:
    """Points (n, k) turned to their principal axes, each brought to the range 0 to 1."""
    turned = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[0]
    low, high = turned.min(axis=0), turned.max(axis=0)
    return np.asarray((turned - low) / np.where(high > low, high - low, 1.0))


def _effects(variance: Array, columns: dict[tuple[int, ...], int], dim: int) -> Array:
    """Shares (r, d) from what each set explains (sets, r)."""
    out = np.zeros((variance.shape[1], dim))
    for chosen, row in columns.items():
        for j in set(range(dim)) - set(chosen):
            larger = columns[tuple(sorted((*chosen, j)))]
            out[:, j] += (variance[larger] - variance[row]) / (dim * comb(dim - 1, len(chosen)))
    whole = variance[columns[tuple(range(dim))]]
    return out / np.where(whole > 0.0, whole, np.nan)[:, None]
