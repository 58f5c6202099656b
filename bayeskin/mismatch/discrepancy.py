"""Models the discrepancy that no mechanism explains, by a Gaussian process over physical coordinates.

The process is the sum of four parts. Each has a squared-exponential kernel with its own size s and length l:

    displacement   a function of displacement; half of its variance is common to all directions of motion, and
                   half belongs to each direction
    change         like displacement, but a change from each cycle to the next that stays in all later cycles
    phase          a function of log(1 + time since the last corner), common to all phases of a kind
    cycle          a function of the same time, with a separate one for each phase of each cycle

The discrepancy is orthogonal to everything that the parameters could explain, as in `unexplained`. Its sizes
and lengths, and the size and memory of the noise with a memory, maximise the evidence, with and without a
discrepancy. Both evidences integrate over these hyperparameters. A residual that such noise can explain
therefore does not count as evidence for a discrepancy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from bayeskin.mismatch.evidence import occam
from bayeskin.mismatch.features import describe
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.unexplained import Memory, Place, Unexplained, unexplained
from bayeskin.types import Array, PadMotion

PARTS = ("displacement", "change", "phase", "cycle")


@dataclass(frozen=True)
class DiscrepancySettings:
    """Settings of the Gaussian process of a discrepancy.

    smallest, largest : bounds of the size s, in sd of the noise and in RMS of the residual
    over_displacement, over_time : bounds of the length l, as a share of the displacement's range, and in
        units of log(1 + t / 1 s)
    first_lengths : lengths of the four parts from which a climb starts; their sizes start from half the RMS
    little : share of the fitted noise with a memory from which a climb with a discrepancy starts
    step : step for second derivatives, as a share of a hyperparameter's range
    noticeable : gain [nats] from which a discrepancy is more than noise, which gains less in 99 of 100
        recordings
    """

    smallest: float = 0.01
    largest: float = 10.0
    over_displacement: tuple[float, float] = (0.05, 2.0)
    over_time: tuple[float, float] = (0.2, 3.0)
    first_lengths: tuple[float, float, float, float] = (0.3, 0.3, 0.8, 0.8)
    little: float = 0.1
    step: float = 1e-3
    noticeable: float = 5.0


DISCREPANCY = DiscrepancySettings()


@dataclass(frozen=True)
class Discrepancy:
    """The force that the model leaves unexplained, on the fitted bins (k,).

    mean_n, sd_n : posterior mean and sd of the discrepancy, (k,) each [N]
    parts_n : posterior mean (k,) [N] of each part; they add up to mean_n
    beyond_n : the residual (k,) [N] that the parameters cannot explain; taken_n : the residual (k,) [N] that
        they could still explain
    size_n : RMS of mean_n [N]
    share : share of the sum of squares of beyond_n that mean_n has, split in proportion to the squares of the
        parts
    size_by_part, length_by_part : hyperparameters of each part
    memory : the noise with a memory that is fitted together with the discrepancy
    gain_nats : log-evidence at the best hyperparameters, minus that without a discrepancy at its best noise
    log_evidence, without_log_evidence : log-evidences of the fit with and without a discrepancy
        (`Unexplained`), integrated over log-uniform priors of the hyperparameters between their bounds
    features : a description of the discrepancy in words
    """

    bins: NDArray[np.int64]
    mean_n: Array
    sd_n: Array
    parts_n: Mapping[str, Array]
    beyond_n: Array
    taken_n: Array
    size_n: float
    share: Mapping[str, float]
    size_by_part: Mapping[str, float]
    length_by_part: Mapping[str, float]
    memory: Memory
    gain_nats: float
    log_evidence: float
    without_log_evidence: float
    features: tuple[str, ...]

    @property
    def noticeable(self) -> bool:
        """Returns whether the discrepancy is more than noise."""
        return self.gain_nats > DISCREPANCY.noticeable


def discrepancy(fit: Fit, motion: PadMotion) -> Discrepancy:
    """Returns the discrepancy at a fit; `motion` is the protocol of the recording."""
    remainder = unexplained(fit, motion)
    squares, masks, bounds = squared_distances(remainder.at), kernel_masks(remainder.at), _bounds(remainder)
    of_noise = partial(negative_log_evidence, remainder=remainder)
    noise_only = _maximise(of_noise, _starts(remainder), bounds[:2])
    objective = partial(negative_log_evidence, remainder=remainder, squares=squares, masks=masks)
    best = _maximise(objective, _starts(remainder, bounds), bounds)
    without, remainder = remainder.with_memory(noise_only.line), remainder.with_memory(best.line[:2])
    logs = best.line[2:]
    kernels = _kernels(logs, squares, masks)
    reduced = remainder.reduce @ remainder.residual_n
    lower = np.linalg.cholesky(
        remainder.reduce @ np.sum(kernels, axis=0) @ remainder.reduce.T + np.eye(len(reduced))
    )
    weight = remainder.reduce.T @ cho_solve((lower, True), reduced)
    parts = {
        name: np.asarray(remainder.expand @ (remainder.reduce @ (kernel @ weight)))
        for name, kernel in zip(PARTS, kernels, strict=True)
    }
    mean = np.sum(list(parts.values()), axis=0)
    # In the coordinates a, the posterior covariance is I - S^-1, with S = C + I and the prior covariance C.
    whitened = solve_triangular(lower, remainder.expand.T, lower=True)
    sd = np.sqrt(np.maximum(np.sum(remainder.expand**2, axis=1) - np.sum(whitened**2, axis=0), 0.0))
    gain = noise_only.value - best.value
    beyond = remainder.beyond(remainder.residual_n)
    square_by_part = {name: float(part @ part) for name, part in parts.items()}
    total = float(beyond @ beyond) * sum(square_by_part.values())
    noticeable = gain > DISCREPANCY.noticeable
    features = describe(remainder, mean, sd) if noticeable else ("nothing is left beyond the noise",)
    return Discrepancy(
        remainder.bins, mean, sd, parts, beyond, remainder.residual_n - beyond,
        float(np.sqrt(np.mean(mean**2))),
        {name: float(mean @ mean) * square / total if total > 0.0 else 0.0
         for name, square in square_by_part.items()},
        dict(zip(PARTS, np.exp(logs[:4]).tolist(), strict=True)),
        dict(zip(PARTS, np.exp(logs[4:]).tolist(), strict=True)),
        remainder.memory, gain,
        remainder.log_evidence(np.sum(kernels, axis=0)) + best.share,
        without.log_evidence() + noise_only.share, features,
    )  # fmt: skip


def squared_distances(at: Place) -> Array:
    """Returns for each part the squared distances between bins in its coordinate, (4, k, k)."""
    displacement_range = float(np.ptp(at.displacement_m)) or 1.0
    log_time = np.log1p(at.since_s)
    displacement = at.displacement_m / displacement_range
    axes = (displacement, displacement, log_time, log_time)
    return np.array([(axis[:, None] - axis) ** 2 for axis in axes])


def kernel_masks(at: Place) -> Array:
    """Returns for each part the factor (4, k, k) of its kernel that is independent of distance."""
    same = [values[:, None] == values for values in (at.direction, at.kind, at.phase)]
    moving, changes = 0.5 + 0.5 * same[0], np.maximum(at.cycle - 1.0, 0.0)
    before_both = np.minimum(changes[:, None], changes) / max(changes.max(), 1.0)
    return np.array([moving, before_both * moving, same[1], same[2]], dtype=float)


def _kernels(logs: Array, squares: Array, masks: Array) -> Array:
    """Returns the kernels (4, k, k) [N^2] for the logarithms of four sizes and four lengths, (8,)."""
    size, length = np.exp(logs[:4, None, None]), np.exp(logs[4:, None, None])
    return np.asarray(size**2 * masks * np.exp(-0.5 * squares / length**2))


def _bounds(remainder: Unexplained) -> Array:
    """Returns bounds (10, 2) of the logarithms of the hyperparameters.

    Their order is: size and memory of the noise, sizes of the four parts, lengths of the four parts.
    """
    noise_n = float(np.sqrt(np.median(np.diag(remainder.measured_n2))))
    rms_n = max(float(np.sqrt(np.mean(remainder.beyond(remainder.residual_n) ** 2))), noise_n)
    noise_bounds = [remainder.memory.size_within, remainder.memory.time_within]
    sizes = (DISCREPANCY.smallest * noise_n, DISCREPANCY.largest * rms_n)
    lengths = [DISCREPANCY.over_displacement] * 2 + [DISCREPANCY.over_time] * 2
    return np.log([*noise_bounds, *[sizes] * 4, *lengths])


def _starts(remainder: Unexplained, bounds: Array | None = None) -> list[Array]:
    """Returns the starting points of climbs: one with the fitted noise, and one with a small share of it.

    With `bounds`, the points contain the parts of the discrepancy too, and only the small noise is used.
    """
    fitted = np.log([remainder.memory.size, remainder.memory.time_s])
    noise_starts = [fitted, fitted + np.log([DISCREPANCY.little, 1.0])]
    if bounds is None:
        return noise_starts
    rms_n = np.exp(bounds[2, 1]) / DISCREPANCY.largest
    parts = np.concatenate([np.full(4, np.log(rms_n / 2.0)), np.log(DISCREPANCY.first_lengths)])
    return [np.concatenate([noise, parts]) for noise in noise_starts[1:]]


class _Maximum(NamedTuple):
    """A maximum of the evidence over the hyperparameters.

    line : logarithms of the hyperparameters; value : minus the log-evidence there
    share : logarithm of the share of their box that the recording leaves, by Laplace's approximation
    """

    line: Array
    value: float
    share: float


def _maximise(
    objective: Callable[[Array], tuple[float, Array]], starts: Sequence[Array], bounds: Array
) -> _Maximum:
    """Returns the best end point of climbs from several starting points, within bounds (h, 2).

    objective : returns minus the log-evidence and its gradient (h,)
    """
    results = [minimize(objective, np.clip(start, *bounds.T), jac=True, method="L-BFGS-B", bounds=bounds)
            for start in starts]  # fmt: skip
    best = min(results, key=lambda result: result.fun)
    logs, width = np.asarray(best.x), bounds[:, 1] - bounds[:, 0]
    side = DISCREPANCY.step * np.where(logs + DISCREPANCY.step * width < bounds[:, 1], 1.0, -1.0)
    gradient = objective(logs)[1]
    gradients = [objective(logs + change)[1] for change in np.diag(side * width)]
    curvature = np.array(
        [(shifted - gradient) * width / step for shifted, step in zip(gradients, side, strict=True)]
    )
    return _Maximum(logs, float(best.fun), occam(np.linalg.eigvalsh(0.5 * (curvature + curvature.T))))


def negative_log_evidence(
    logs: Array, remainder: Unexplained, squares: Array | None = None, masks: Array | None = None
) -> tuple[float, Array]:
    """Returns minus the log-evidence, up to a constant, and its derivatives by the logarithms.

    logs : logarithms of the noise's size and time (2,); with `squares` and `masks` they are followed
        by those of the parts' sizes and lengths (10,)
    """
    remainder = remainder.with_memory(logs[:2])
    memory_n2 = remainder.memory.covariance_n2
    covariance, kernels = remainder.noise_n2 + remainder.open_n2, None
    if squares is not None and masks is not None:
        kernels = _kernels(logs[2:], squares, masks)
        covariance = covariance + remainder.beyond(remainder.beyond(kernels.sum(axis=0)).T)
    lower, inverse = _inverted(covariance)
    weight = inverse @ remainder.residual_n
    value = 0.5 * float(remainder.residual_n @ weight) + float(np.sum(np.log(np.diag(lower))))
    by_covariance = inverse - np.outer(weight, weight)
    relative_age = (
        np.where(np.isfinite(remainder.memory.apart_s), remainder.memory.apart_s, 0.0)
        / remainder.memory.time_s
    )
    gradient = [np.sum(by_covariance * memory_n2), 0.5 * np.sum(by_covariance * memory_n2 * relative_age)]
    if kernels is None or squares is None:
        return value, np.array(gradient)
    by_covariance = remainder.beyond(remainder.beyond(by_covariance).T)
    by_size = np.einsum("ij,pij->p", by_covariance, kernels)
    by_length = np.einsum("ij,pij,pij->p", by_covariance, kernels, squares) * 0.5 * np.exp(-2.0 * logs[6:])
    return value, np.concatenate([gradient, by_size, by_length])


def _inverted(covariance: Array) -> tuple[Array, Array]:
    """Returns the Cholesky factor and the inverse of a matrix (k, k).

    Raises LinAlgError where the matrix is not positive definite.
    """
    lower = np.linalg.cholesky(covariance)
    inverse, _ = dpotri(lower, lower=1)
    return np.asarray(lower), np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)
