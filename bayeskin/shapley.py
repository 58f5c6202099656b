"""Shapley effects: shares of the force's variance where the parameters are correlated, as a posterior's are.

With correlated inputs first-order and total Sobol' indices no longer add up to a variance; Shapley effects
do, are never negative, and share what two parameters explain together between them (Owen 2014, SIAM/ASA J.
Uncertainty Quantification 2:245; Song, Nelson & Staum 2016, ibid. 4:1060). They are estimated from the draws
at hand: the variance that a set of parameters explains is the covariance of the force between each draw and
its nearest neighbour in that set (Broto, Bachoc & Depecker 2020, ibid. 8:693).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from bayeskin.types import Array, ParameterSpace, _FreezesArrays

REPLICATES = 200
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
    spread = unit.std(axis=0)
    unit = unit / np.where(spread > 0.0, spread, 1.0)
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
    out: dict[tuple[int, ...], Array] = {(): np.zeros(len(own))}
    for size in range(1, dim):
        for chosen in combinations(range(dim), size):
            out[chosen] = np.einsum("nm,nm->n", centred, centred[_neighbour(unit[:, chosen])])
    out[tuple(range(dim))] = own
    return out


def _neighbour(points: Array) -> NDArray[np.int64]:
    """Index (n,) of the nearest other point, (n, k)."""
    found = cKDTree(points).query(points, k=2)[1]
    rows = np.arange(len(points))
    return np.where(found[:, 0] == rows, found[:, 1], found[:, 0])


def _effects(variance: Array, columns: dict[tuple[int, ...], int], dim: int) -> Array:
    """Shares (r, d) from what each set explains (sets, r)."""
    out = np.zeros((variance.shape[1], dim))
    for chosen, row in columns.items():
        for j in set(range(dim)) - set(chosen):
            larger = columns[tuple(sorted((*chosen, j)))]
            out[:, j] += (variance[larger] - variance[row]) / (dim * comb(dim - 1, len(chosen)))
    whole = variance[columns[tuple(range(dim))]]
    return out / np.where(whole > 0.0, whole, np.nan)[:, None]
