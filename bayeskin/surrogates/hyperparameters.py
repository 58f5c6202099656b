"""Finds the hyperparameters of one latent's Gaussian process and measures its error by cross-validation.

The kernel is a function of ``|W (x - x')|`` with a full (lower triangular) matrix W. The reason is that the
force of a layered solid depends on products and ratios of its parameters, which are oblique directions of a
log-scaled box. W and the nugget maximise the restricted likelihood times a weak normal prior on W's entries.
In the restricted likelihood, the trend's coefficients and the variance are integrated out. The method follows
Rasmussen & Williams (2006), ch. 2.7 and 5.4.1. Leave-one-out in closed form: Dubrule (1983), Math. Geology
15, 687.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsymm
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs
from scipy.optimize import minimize

from bayeskin.surrogates.kernels import KERNELS, kernel, squared_distances, trend_basis, trend_degree
from bayeskin.types import Array

SMALLEST_NUGGET = 1e-8  # share of the kernel's variance; it keeps the factorisation accurate to 1e-6


@dataclass(frozen=True)
class HyperparameterSettings:
    """Settings of the search for hyperparameters.

    Prior
    lengths : shortest and longest correlation length, as shares of the box's width
    diagonal_width, oblique_width : prior standard deviations of W's entries

    Search
    first_rows : with more rows the search begins on at most this many of them
    first_nugget : nugget at which the search begins
    aligned_steps, oblique_steps, all_rows_steps : largest number of steps with W diagonal, with W triangular,
        and on all rows
    all_rows_nugget : largest initial nugget for all rows, which can follow what few rows treat as noise

    Few rows
    fewest : least number of rows for each input and the nugget; fewer rows use a single length
    rates : inverse lengths that are tried then, for a box of width 1
    log10_nuggets, nuggets : logarithms of the smallest and largest nugget that are tried, and their number

    Cross-validation
    folds : number of folds
    fold_work, fold_steps : rows times search steps of a fold, and limits of the number of steps; few rows
        mislead the search more, and cost less
    """

    lengths: tuple[float, float] = (0.05, 50.0)
    diagonal_width: float = 3.0
    oblique_width: float = 0.25
    first_rows: int = 320
    first_nugget: float = 1e-4
    aligned_steps: int = 15
    oblique_steps: int = 40
    all_rows_steps: int = 20
    all_rows_nugget: float = 1e-4
    fewest: int = 3
    rates: tuple[float, ...] = (0.3, 1.0, 3.0)
    log10_nuggets: tuple[float, float] = (-6.0, 0.0)
    nuggets: int = 13
    folds: int = 3
    fold_work: int = 640
    fold_steps: tuple[int, int] = (5, 20)


NORMAL_90 = 1.6448536269514722  # a standard normal variable lies within +- this value with probability 90 %


class LatentFit(NamedTuple):
    """Hyperparameters of one latent, with their error from cross-validation.

    error : weighted mean squared error of rows that were not used to fit the hyperparameters
    inflation : ratio of the weighted 90 % quantile of these errors to the quantile that the predicted
        variance implies. For few rows it is the ratio of the RMS errors.
    """

    kernel: str
    linear_map: Array  # (d, d), lower triangular
    nugget: float
    error: float
    inflation: float


class TrainingData(NamedTuple):
    """Training data: inputs (n, d) centred on the cube, trend basis (n, p), target (n,) of unit variance."""

    inputs: Array
    basis: Array
    target: Array

    def rows(self, chosen: NDArray[np.bool_]) -> TrainingData:
        return TrainingData(self.inputs[chosen], self.basis[chosen], self.target[chosen])


class Likelihood(NamedTuple):
    """The negative restricted log-likelihood, its gradient, and the leave-one-out residuals."""

    value: float
    by_map: Array
    by_log_nugget: float
    residual: Array  # (n,) leave-one-out residuals
    spread: Array  # (n,) standard deviations of the residuals, divided by that of the process
    variance: float


def restricted_likelihood(name: str, linear_map: Array, nugget: float, data: TrainingData) -> Likelihood:
    """Returns the negative restricted log-likelihood and its gradient by W and the log nugget.

    The variance is profiled out.
    """
    inputs, basis, target = data
    n, p = basis.shape
    mapped = inputs @ linear_map.T
    squared = squared_distances(mapped, mapped)
    np.fill_diagonal(squared, 0.0)
    covariance, slope = kernel(name, squared)
    covariance.flat[:: n + 1] += nugget
    lower, info = dpotrf(covariance.T, lower=1, clean=1, overwrite_a=1)
    if info:
        raise np.linalg.LinAlgError(f"kernel matrix is not positive definite (row {info})")
    log_root = np.log(lower.diagonal()).sum()
    inverse, _ = dpotri(lower, lower=1, overwrite_c=1)  # only the lower triangle; dsymm reads no more
    weighted = dsymm(1.0, inverse, np.column_stack([basis, target]), lower=1)
    gram, _ = dpotrf(basis.T @ weighted[:, :p], lower=1, clean=1)
    half, _ = dtrtrs(gram, weighted[:, :p].T, lower=1)
    # Let P = K^-1 - K^-1 H (H^T K^-1 H)^-1 H^T K^-1. Only q = P y and P's diagonal are needed separately.
    q = weighted[:, p] - half.T @ (half @ target)
    diagonal = inverse.diagonal() - np.einsum("ij,ij->j", half, half)
    variance = max(float(target @ q) / (n - p), 1e-300)
    value = 0.5 * (n - p) * np.log(variance) + log_root + np.log(gram.diagonal()).sum()
    trace = float(diagonal.sum() - q @ q / variance)
    rows = np.vstack([half, q / np.sqrt(variance)])
    inverse -= (rows.T @ rows).T  # symmetric, and its transpose is column-major
    inverse *= slope.T
    # The result is sum_ij pull_ij (x_i - x_j)(x_i - x_j)^T with pull = (P - q q^T / variance) slope. It is
    # computed without forming the differences.
    pulled = dsymm(1.0, inverse, np.column_stack([inputs, np.ones(n)]), lower=1)
    spread = 2.0 * (inputs.T @ (pulled[:, -1:] * inputs) - inputs.T @ pulled[:, :-1])
    return Likelihood(
        float(value), linear_map @ spread, 0.5 * nugget * trace, q / diagonal, diagonal**-0.5, variance
    )


def _search(
    name: str,
    data: TrainingData,
    free: NDArray[np.bool_],
    start: tuple[Array, float],
    iterations: int,
    settings: HyperparameterSettings,
) -> tuple[Array, float]:
    """Returns the linear map and the nugget of the most probable hyperparameters.

    The search varies the entries of the map that `free` (d, d) marks, and the nugget.
    """
    dim = len(free)
    eye = np.eye(dim, dtype=bool)
    width = np.where(eye, settings.diagonal_width, settings.oblique_width)[free]

    def objective(x: Array) -> tuple[float, Array]:
        linear_map = np.zeros((dim, dim))
        linear_map[free] = x[:-1]
        at = restricted_likelihood(name, linear_map, float(np.exp(x[-1])), data)
        prior = 0.5 * float(np.sum((x[:-1] / width) ** 2))
        return at.value + prior, np.append(at.by_map[free] + x[:-1] / width**2, at.by_log_nugget)

    shortest, longest = settings.lengths
    lowest = np.where(eye, 1.0 / longest, -1.0 / shortest)[free]
    bounds = [(low, 1.0 / shortest) for low in lowest] + [(np.log(SMALLEST_NUGGET), 0.0)]
    x = minimize(
        objective,
        np.append(start[0][free], np.log(start[1])),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": iterations},
    ).x
    linear_map = np.zeros((dim, dim))
    linear_map[free] = x[:-1]
    return linear_map, float(np.exp(x[-1]))


def fit_latent(
    unit: Array, target: Array, weights: Array, settings: HyperparameterSettings = HyperparameterSettings()
) -> LatentFit:
    """Fits one latent (n,) at unit-cube points (n, d) with the kernel of least leave-one-out error.

    `weights` (n,) are the weights of the rows in this error. The likelihood does not use them.
    """
    dim = unit.shape[1]
    deviation = float(target.std())
    if deviation <= 1e-12 * max(abs(float(target.mean())), 1e-300):
        return LatentFit("gaussian", np.eye(dim), 1.0, 0.0, 1.0)
    basis = trend_basis(unit, trend_degree(len(unit), dim))
    data = TrainingData(unit - 0.5, basis, (target - target.mean()) / deviation)
    if len(unit) < settings.fewest * (dim + 1):
        return _fit_one_length(data, weights, deviation, settings)
    aligned, oblique = np.eye(dim, dtype=bool), np.tri(dim, dtype=bool)
    few = data.rows(np.arange(len(unit)) % -(-len(unit) // settings.first_rows) == 0)
    candidates = []
    for name in KERNELS:
        # The search for the oblique map is not convex, so it starts from the best axis-aligned lengths.
        first = (np.eye(dim), settings.first_nugget)
        optimum = _search(name, few, aligned, first, settings.aligned_steps, settings)
        optimum = _search(name, few, oblique, optimum, settings.oblique_steps, settings)
        if len(few.target) < len(unit):
            restart = (optimum[0], min(optimum[1], settings.all_rows_nugget))
            optimum = _search(name, data, oblique, restart, settings.all_rows_steps, settings)
        residual = restricted_likelihood(name, *optimum, data).residual
        candidates.append((float(np.average(residual**2, weights=weights)), name, optimum))
    _, name, optimum = min(candidates, key=lambda candidate: candidate[0])
    best = _cross_validate(name, data, oblique, optimum, weights, settings)
    return best._replace(error=best.error * deviation**2)


def _fit_one_length(
    data: TrainingData, weights: Array, deviation: float, settings: HyperparameterSettings
) -> LatentFit:
    """Returns a fit for few rows: the most probable length and nugget of a grid.

    The length is the same for all inputs, because so few rows cannot distinguish between lengths. A search
    for different lengths would predict far too small errors.
    """
    eye = np.eye(data.inputs.shape[1])
    nuggets = np.logspace(*settings.log10_nuggets, settings.nuggets)
    choices = product(settings.rates, nuggets)
    rate, nugget = min(
        choices, key=lambda at: restricted_likelihood("gaussian", at[0] * eye, at[1], data).value
    )
    best = restricted_likelihood("gaussian", rate * eye, nugget, data)
    error = float(np.average(best.residual**2, weights=weights))
    predicted = best.variance * float(np.average(best.spread**2, weights=weights))
    inflation = max(float(np.sqrt(error / predicted)), 1.0)
    return LatentFit("gaussian", rate * eye, float(nugget), error * deviation**2, inflation)


def _cross_validate(
    name: str,
    data: TrainingData,
    free: NDArray[np.bool_],
    at: tuple[Array, float],
    weights: Array,
    settings: HyperparameterSettings,
) -> LatentFit:
    """Returns the fit with its leave-one-out errors.

    For each fold, the hyperparameters are refitted without the rows of this fold, starting from `at`. With
    the hyperparameters of all rows, the closed form would be too optimistic: for few rows it gives a standard
    deviation that is too small by a factor of up to two to four.
    """
    fold = np.arange(len(data.target)) % settings.folds
    fewest, most = settings.fold_steps
    steps = min(max(settings.fold_work // len(fold), fewest), most)
    residual, ratio = np.empty(len(fold)), np.empty(len(fold))
    for k in range(settings.folds):
        kept = data.rows(fold != k)
        linear_map, nugget = _search(name, kept, free, at, steps, settings)
        variance = restricted_likelihood(name, linear_map, nugget, kept).variance
        all_rows = restricted_likelihood(name, linear_map, nugget, data)
        held_out = fold == k
        residual[held_out] = all_rows.residual[held_out]
        ratio[held_out] = residual[held_out] / (all_rows.spread[held_out] * np.sqrt(variance))
    order = np.argsort(np.abs(ratio))
    share = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    inflation = float(np.interp(0.9, share, np.abs(ratio)[order])) / NORMAL_90
    return LatentFit(name, at[0], at[1], float(np.average(residual**2, weights=weights)), inflation)
