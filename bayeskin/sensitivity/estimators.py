"""Estimates Sobol' indices of any vectorised function ``theta (n, d) -> force (n, m)``, by two estimators.

- `pick_freeze` uses the first-order estimator of Saltelli et al. (2010), Comput. Phys. Commun. 181, 259,
  table 2(b), and the total-effect estimator of Jansen (1999), table 2(f). A bootstrap over rows gives the
  intervals, with the same rows of every evaluation.
- `projection` is a least-squares projection on Legendre polynomials that are orthonormal under the input
  distribution. The indices are sums of squared coefficients (Sudret 2008, Reliab. Eng. Syst. Saf. 93, 964).

A second-order index is the share that two parameters explain together beyond the share that each explains
alone. In pick-freeze it is the closed index of the pair minus both first-order indices (Saltelli 2002,
Comput. Phys. Commun. 145, 280).

Aggregated indices treat the whole history as a single output. Each bin is weighted by its variance and width
(Lamboni et al. 2011; Gamboa et al. 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import isqrt
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import qmc

from bayeskin.errors import InputError
from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.sensitivity.result import SobolResult, describe
from bayeskin.types import Array, ParameterSpace

Function = Callable[[Array], Array]
REPLICATES = 200  # number of bootstrap replicates from which an interval is computed


@dataclass(frozen=True)
class EstimatorSettings:
    """Settings of both estimators.

    negligible_variance : share of the largest variance of any bin; in bins with a smaller variance an index
        would be rounding error
    chunk : number of rows that are evaluated at once, to save memory

    Pick-freeze
    replicates : number of bootstrap replicates
    error_rows : number of rows that measure the effect of an error draw on the indices

    Projection
    highest_degree, most_terms : highest degree of a polynomial, and largest number of polynomials
    """

    negligible_variance: float = 1e-8
    chunk: int = 512
    replicates: int = REPLICATES
    error_rows: int = 256
    highest_degree: int = 40
    most_terms: int = 600


ESTIMATORS = EstimatorSettings()


class _VarianceParts(NamedTuple):
    """Variance (r, m) and its parts in r replicates: first and total (r, d, m), second (r, p, m)."""

    variance: Array
    first: Array
    total: Array
    second: Array


def pick_freeze(
    function: Function,
    space: ParameterSpace,
    edges_s: Array,
    rng: np.random.Generator,
    samples: int = 2048,
    draws: Sequence[Function] = (),
) -> SobolResult:
    """Returns indices from ``samples (d + 2 + d (d - 1) / 2)`` evaluations at scrambled Sobol' points.

    The intervals come from bootstrap replicates. Each replicate is shifted by the change that
    one of `draws` causes.
    """
    points = _sobol_points(2 * space.dim, samples, rng)
    values = _evaluate_pairs(function, space, points)
    n, replicates = len(points), ESTIMATORS.replicates
    counts = rng.multinomial(n, np.full(n, 1.0 / n), size=replicates) / n
    spread = _pick_freeze_parts(values, counts)
    if draws:
        first_rows = slice(0, min(ESTIMATORS.error_rows, n))
        even = np.full((1, first_rows.stop), 1.0 / first_rows.stop)
        base = _pick_freeze_parts([rows[first_rows] for rows in values], even)
        moved = [_pick_freeze_parts(_evaluate_pairs(draw, space, points[first_rows]), even) for draw in draws]
        picks = np.arange(replicates) % len(draws)
        shifts = (np.concatenate([getattr(m, part) for m in moved])[picks] for part in _VarianceParts._fields)
        spread = _VarianceParts(*(a + b - c for a, b, c in zip(spread, shifts, base, strict=True)))
    best = _pick_freeze_parts(values, np.full((1, n), 1.0 / n))
    return _result(space, edges_s, best, spread, n, "pick-freeze", float("nan"))


def projection(
    function: Function,
    space: ParameterSpace,
    edges_s: Array,
    rng: np.random.Generator,
    samples: int = 2048,
    draws: Sequence[Function] = (),
) -> SobolResult:
    """Returns indices from the coefficients of a Legendre expansion, regressed on `samples` evaluations.

    A surrogate predicts a product of amplitude and shape. The expansion of a product does not follow simply
    from those of its factors, so the force itself is projected. The intervals cover only `draws`, and are NaN
    without them. The coefficients of a given function have no sampling error beyond `unexplained`, which is
    measured on the same number of new points.

    Raises InputError if there are too few samples for a polynomial of degree one.
    """
    unit, fresh = (_sobol_points(space.dim, samples, rng) for _ in range(2))
    indices = _expansion_terms(space.dim, len(unit) // 4)
    if len(indices) == 1:
        raise InputError(
            "sobol.samples",
            f"{samples} samples are too few",
            f"use at least {4 * (space.dim + 1)} with {space.dim} parameters",
        )
    basis = legendre_basis(unit, indices)
    gram = cho_factor(basis.T @ basis)

    def coefficients(values: Array) -> Array:
        return np.asarray(cho_solve(gram, basis.T @ values))

    expansion = coefficients(_in_chunks(function, space.from_unit(unit)))
    truth = _in_chunks(function, space.from_unit(fresh))
    widths = np.diff(edges_s)
    error = float(np.mean((truth - legendre_basis(fresh, indices) @ expansion) ** 2, axis=0) @ widths)
    scatter = float(np.var(truth, axis=0) @ widths)
    moved = [_expansion_parts(coefficients(_in_chunks(f, space.from_unit(unit))), indices) for f in draws]
    spread = _VarianceParts(*(np.concatenate(part) for part in zip(*moved, strict=True))) if moved else None
    unexplained = error / scatter if scatter > 0.0 else float("nan")
    best = _expansion_parts(expansion, indices)
    return _result(space, edges_s, best, spread, len(unit), "projection", unexplained)


def _sobol_points(dim: int, samples: int, rng: np.random.Generator) -> Array:
    """Returns scrambled Sobol' points (n, dim), where n is a power of two."""
    return np.asarray(qmc.Sobol(dim, seed=rng).random_base2(max(samples - 1, 1).bit_length()))


def _in_chunks(function: Function, theta: Array) -> Array:
    """Returns function(theta), (n, m), computed in chunks to save memory."""
    chunk = ESTIMATORS.chunk
    return np.concatenate([function(theta[i : i + chunk]) for i in range(0, len(theta), chunk)])


def _evaluate_pairs(function: Function, space: ParameterSpace, points: Array) -> list[Array]:
    """Returns [f(A), f(B), f(A with column 1 of B), ..., f(A with columns 1 and 2 of B), ...], each (n, m).

    The mean of f(A) and f(B) is subtracted from all of them.
    """
    a, b = points[:, : space.dim], points[:, space.dim :]
    chosen = [*((i,) for i in range(space.dim)), *combinations(range(space.dim), 2)]
    mixed = [np.where(np.isin(np.arange(space.dim), columns), b, a) for columns in chosen]
    values = [_in_chunks(function, space.from_unit(unit)) for unit in (a, b, *mixed)]
    centre = 0.5 * (values[0].mean(axis=0) + values[1].mean(axis=0))
    return [value - centre for value in values]


def _pick_freeze_parts(values: Sequence[Array], weights: Array) -> _VarianceParts:
    """Returns the parts of the variance for each set of row weights in `weights` (r, n)."""
    a, b, *mixed = values
    dim = (isqrt(8 * len(mixed) + 1) - 1) // 2  # `mixed` has d single columns and d (d - 1) / 2 pairs
    mean = weights @ (0.5 * (a + b))
    variance = weights @ (0.5 * (a**2 + b**2)) - mean**2
    closed = np.stack([weights @ (b * (ab - a)) for ab in mixed], axis=1)
    total = np.stack([weights @ (0.5 * (a - ab) ** 2) for ab in mixed[:dim]], axis=1)
    first = closed[:, :dim]
    left, right = _pair_columns(dim)
    return _VarianceParts(variance, first, total, closed[:, dim:] - first[:, left] - first[:, right])


def _pair_columns(dim: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the first and the second member of each pair, in the order of `SobolResult.pairs`."""
    left, right = np.triu_indices(dim, 1)
    return left, right


def _expansion_terms(dim: int, most: int) -> NDArray[np.int64]:
    """Returns the degrees (P, dim) of the largest hyperbolic set with at most `most` terms.

    The set never has more terms than the settings allow.
    """
    degree, terms, most = 1, multi_indices(dim, 0), min(most, ESTIMATORS.most_terms)
    while degree <= ESTIMATORS.highest_degree and len(larger := multi_indices(dim, degree)) <= most:
        degree, terms = degree + 1, larger
    return terms


def _expansion_parts(coefficients: Array, indices: NDArray[np.int64]) -> _VarianceParts:
    """Returns the parts of the variance from the coefficients (P, m) of orthonormal terms (P, d)."""
    square = coefficients**2
    used = (indices > 0).astype(float)
    count = used.sum(axis=1, keepdims=True)
    left, right = _pair_columns(used.shape[1])
    both = used[:, left] * used[:, right] * (count == 2)
    alone = used * (count == 1)
    return _VarianceParts(
        (used.any(axis=1) @ square)[None],
        (alone.T @ square)[None],
        (used.T @ square)[None],
        (both.T @ square)[None],
    )


def _ratios(
    parts: _VarianceParts, usable: NDArray[np.bool_], widths: Array
) -> tuple[list[Array], list[Array]]:
    """Returns first-order, total and second-order indices for each bin and for the whole history.

    Their shapes are (r, d or p, m) and (r, d or p).
    """
    variance = np.where(usable, parts.variance, np.nan)[:, None]
    history = parts.variance @ widths
    whole = np.where(history > 0.0, history, np.nan)[:, None]
    shares = (parts.first, parts.total, parts.second)
    return [share / variance for share in shares], [share @ widths / whole for share in shares]


def _result(
    space: ParameterSpace,
    edges_s: Array,
    best: _VarianceParts,
    spread: _VarianceParts | None,
    samples: int,
    method: Literal["pick-freeze", "projection"],
    unexplained: float,
) -> SobolResult:
    widths = np.diff(edges_s)
    usable = best.variance[0] > ESTIMATORS.negligible_variance * best.variance[0].max()
    (first, total, second), whole = ([ratio[0] for ratio in kind] for kind in _ratios(best, usable, widths))
    if spread is None:
        limits, whole_limits = (
            [np.full((2, *ratio.shape), np.nan) for ratio in kind] for kind in ((first, total), whole)
        )
    else:
        limits, whole_limits = (
            [np.quantile(ratio, [0.05, 0.95], axis=0) for ratio in kind]
            for kind in _ratios(spread, usable, widths)
        )
    return SobolResult(
        names=space.names,
        edges_s=np.asarray(edges_s, dtype=float),
        first=first,
        total=total,
        first_interval=limits[0],
        total_interval=limits[1],
        first_aggregated=whole[0],
        total_aggregated=whole[1],
        first_aggregated_interval=whole_limits[0],
        total_aggregated_interval=whole_limits[1],
        second=second,
        second_aggregated=whole[2],
        second_aggregated_interval=whole_limits[2],
        variance_n2=best.variance[0],
        unexplained=unexplained,
        samples=samples,
        method=method,
        distribution=describe(space),
    )
