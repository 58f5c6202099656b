"""Computes Sobol' indices of the force over time: they show which parameters the force informs, and when.

Two estimators work with any vectorised function ``theta (n, d) -> force (n, m)``:

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
from bayeskin.number_format import interval, number, quantity
from bayeskin.polynomials import legendre_basis, multi_indices
from bayeskin.types import Array, Parameter, ParameterSpace, Surrogate, _FreezesArrays

Function = Callable[[Array], Array]
# Both constants are shares of the largest variance of any bin.
NEGLIGIBLE_VARIANCE = 1e-8  # in bins with a smaller variance an index would be rounding error
MEANINGFUL_VARIANCE = 1e-3  # bins with at least this variance can inform a parameter
UNINFORMED_TOTAL = 0.01
REPLICATES = 200
ERROR_DRAWS = 16
ERROR_SAMPLES = 256  # number of rows that measure the effect of an error draw on the indices
ERROR_LENGTH = 0.3  # share of the box's width, about the spacing of a hundred runs in five dimensions
ERROR_FEATURES = 128
HIGHEST_DEGREE = 40
MOST_TERMS = 600
CHUNK = 512


@dataclass(frozen=True)
class SobolResult(_FreezesArrays):
    """First-order, total and second-order Sobol' indices, for each bin and for the whole history.

    first, total : (d, m) indices, NaN in bins whose force hardly varies
    first_interval, total_interval : (2, d, m) the 5 % and 95 % limits
    first_aggregated, total_aggregated and their intervals : the same for the whole history, (d,) and (2, d)
    second : (p, m) indices of the pairs, in the order of `pairs`; for the whole history they are (p,), with
        limits (2, p)
    variance_n2 : (m,) variance of the force
    unexplained : share of the variance that a projection does not explain (NaN for pick-freeze)
    distribution : the distribution from which the parameters were drawn, in words
    """

    names: tuple[str, ...]
    edges_s: Array
    first: Array
    total: Array
    first_interval: Array
    total_interval: Array
    first_aggregated: Array
    total_aggregated: Array
    first_aggregated_interval: Array
    total_aggregated_interval: Array
    second: Array
    second_aggregated: Array
    second_aggregated_interval: Array
    variance_n2: Array
    unexplained: float
    samples: int
    method: Literal["pick-freeze", "projection"]
    distribution: str

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        return tuple(combinations(self.names, 2))


class _VarianceParts(NamedTuple):
    """Variance (r, m) and its parts in r replicates: first and total (r, d, m), second (r, p, m)."""

    variance: Array
    first: Array
    total: Array
    second: Array


def sobol(
    surrogate: Surrogate,
    rng: np.random.Generator,
    samples: int = 2048,
    space: ParameterSpace | None = None,
    method: Literal["pick-freeze", "projection"] = "pick-freeze",
) -> SobolResult:
    """Returns the indices of a surrogate's force; the intervals include the surrogate's own error.

    `space` is the input distribution: the surrogate's box by default, or a narrower box inside it. `samples`
    is rounded up to a power of two. Raises InputError if `space` leaves the surrogate's box.
    """
    space = surrogate.space if space is None else space
    if space.names != surrogate.space.names or not surrogate.space.contains([space.lower, space.upper]).all():
        raise InputError("sobol: space", describe(space), f"a box within {describe(surrogate.space)}")
    draws = error_draws(surrogate, ERROR_DRAWS, rng)
    estimate = pick_freeze if method == "pick-freeze" else projection
    return estimate(surrogate.predict_mean, space, surrogate.edges_s, rng, samples, draws)


def error_draws(surrogate: Surrogate, count: int, rng: np.random.Generator) -> list[Function]:
    """Returns functions that differ from the surrogate's mean by random draws of its error.

    A draw multiplies each column of the predicted factor, and the root of the diagonal, by a smooth random
    field over the box. Each field is independent and has unit variance. The error is therefore a smooth
    function. Independent noise at each point would count as interaction. The fields have a Gaussian
    correlation over `ERROR_LENGTH` of the box (random Fourier features, Rahimi & Recht 2007).
    """
    rank = surrogate.predict(surrogate.space.from_unit(np.full((1, surrogate.space.dim), 0.5))).factor.shape[
        2
    ]

    def draw() -> Function:
        waves = rng.normal(0.0, 1.0 / ERROR_LENGTH, (surrogate.space.dim, (rank + 1) * ERROR_FEATURES))
        shift = rng.uniform(0.0, 2.0 * np.pi, (rank + 1) * ERROR_FEATURES)

        def function(theta: Array) -> Array:
            field = np.cos(surrogate.space.to_unit(theta) @ waves + shift)
            field = field.reshape(len(theta), rank + 1, ERROR_FEATURES).sum(axis=2) * np.sqrt(
                2 / ERROR_FEATURES
            )
            prediction = surrogate.predict(theta)
            shifted = prediction.mean + np.matmul(prediction.factor, field[:, :rank, None])[:, :, 0]
            return np.asarray(shifted + field[:, rank:] * np.sqrt(prediction.diagonal))

        return function

    return [draw() for _ in range(count)]


def pick_freeze(
    function: Function,
    space: ParameterSpace,
    edges_s: Array,
    rng: np.random.Generator,
    samples: int = 2048,
    draws: Sequence[Function] = (),
) -> SobolResult:
    """Returns indices from ``samples (d + 2 + d (d - 1) / 2)`` evaluations at scrambled Sobol' points.

    The intervals come from `REPLICATES` bootstrap replicates. Each replicate is shifted by the change that
    one of `draws` causes.
    """
    points = _sobol_points(2 * space.dim, samples, rng)
    values = _evaluate_pairs(function, space, points)
    n = len(points)
    counts = rng.multinomial(n, np.full(n, 1.0 / n), size=REPLICATES) / n
    spread = _pick_freeze_parts(values, counts)
    if draws:
        first_rows = slice(0, min(ERROR_SAMPLES, n))
        even = np.full((1, first_rows.stop), 1.0 / first_rows.stop)
        base = _pick_freeze_parts([rows[first_rows] for rows in values], even)
        moved = [_pick_freeze_parts(_evaluate_pairs(draw, space, points[first_rows]), even) for draw in draws]
        picks = np.arange(REPLICATES) % len(draws)
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
        expected = f"at least {4 * (space.dim + 1)} with {space.dim} parameters"
        raise InputError("sobol.samples", samples, expected)
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


def uninformed(result: SobolResult) -> tuple[str, ...]:
    """Returns the parameters whose total index stays below 0.01 in every bin of meaningful variance."""
    matters = result.variance_n2 >= MEANINGFUL_VARIANCE * np.max(result.variance_n2, initial=0.0)
    matters &= ~np.isnan(result.total).any(axis=0)
    if not matters.any():
        return ()
    highest = result.total[:, matters].max(axis=1)
    return tuple(name for name, top in zip(result.names, highest, strict=True) if top < UNINFORMED_TOTAL)


def sentence(result: SobolResult) -> str:
    """Returns a sentence that names the parameters that the force does not inform."""
    names = uninformed(result)
    if np.isnan(result.total).all():
        return "The force does not vary over the parameters' distribution: it informs none of them."
    if not names:
        return "The force informs every parameter: each total Sobol' index reaches 0.01 in some bin."
    listed = names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
    verb = "its total Sobol' index stays" if len(names) == 1 else "their total Sobol' indices stay"
    return f"The force does not inform {listed}: {verb} below 0.01 in every bin whose force varies."


def describe(space: ParameterSpace) -> str:
    """Returns the input distribution in words."""
    start = "independent, without their priors' correlations: " if space.correlations else "independent: "
    return start + "; ".join(map(_parameter_in_words, space.parameters))


def _parameter_in_words(p: Parameter) -> str:
    sd = f"factor {number(np.exp(p.spread))}" if p.in_log else quantity(p.spread, p.unit)
    about = f" about {quantity(p.centre, p.unit)} (sd: {sd})" if p.peaked else ""
    return f"{p.name} {p.prior}{about}, {interval(p.lower, p.upper, p.unit)}"


def _sobol_points(dim: int, samples: int, rng: np.random.Generator) -> Array:
    """Returns scrambled Sobol' points (n, dim), where n is a power of two."""
    return np.asarray(qmc.Sobol(dim, seed=rng).random_base2(max(samples - 1, 1).bit_length()))


def _in_chunks(function: Function, theta: Array) -> Array:
    """Returns function(theta), (n, m), computed in chunks to save memory."""
    return np.concatenate([function(theta[i : i + CHUNK]) for i in range(0, len(theta), CHUNK)])


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

    The set never has more than `MOST_TERMS` terms.
    """
    degree, terms = 1, multi_indices(dim, 0)
    while degree <= HIGHEST_DEGREE and len(larger := multi_indices(dim, degree)) <= min(most, MOST_TERMS):
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
    usable = best.variance[0] > NEGLIGIBLE_VARIANCE * best.variance[0].max()
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
