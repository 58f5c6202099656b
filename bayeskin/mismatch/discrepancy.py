"""A discrepancy that no mechanism explains: a Gaussian process over the coordinates that physics acts in.

Three parts are added up, each with its own size s and length l of a squared-exponential kernel:

    displacement   over displacement; half of it the same in every direction of motion, half its own
    phase          over log(1 + time since the last corner); the same in all phases of a kind
    cycle          over the same time; its own in each phase of each cycle

Sizes and lengths maximise the marginal likelihood, with the measured noise and the surrogate's error held.
The prior is that of `unexplained`: orthogonal to all that the parameters could take up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

from bayeskin.mismatch.features import describe
from bayeskin.mismatch.fit import Fit, occam
from bayeskin.mismatch.unexplained import Place, Unexplained, unexplained
from bayeskin.types import Array, PadMotion

PARTS = ("displacement", "phase", "cycle")
SMALLEST, LARGEST = 0.01, 10.0  # size s: of the noise's sd, of the residual's RMS
LENGTHS = ((0.05, 2.0), (0.2, 3.0), (0.2, 3.0))  # of the displacement's range; of log(1 + t / 1 s)
STEP = 1e-3  # of a hyperparameter's range, for second derivatives
NOTICEABLE = 5.0  # nats over no discrepancy; noise alone gains less in 99 of 100 recordings


@dataclass(frozen=True)
class Discrepancy:
    """What the model leaves unexplained, on the fitted bins (k,).

    mean_n, sd_n (k,) of the discrepancy; parts_n: mean (k,) of each part, which add up to mean_n;
    beyond_n (k,) the residual beyond what parameters could still take up, and taken_n (k,) what they could;
    size_n the RMS of mean_n; share: of the squares of beyond_n those of mean_n, split by the parts' own;
    size_by_part, length_by_part: hyperparameters; gain_nats: log marginal likelihood over that of no
    discrepancy; log_evidence: of the fit with it, and without_log_evidence: without (`Unexplained`), sizes
    and lengths integrated over log-uniform priors between their bounds; features: what it looks like, in
    words.
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
    gain_nats: float
    log_evidence: float
    without_log_evidence: float
    features: tuple[str, ...]

    @property
    def noticeable(self) -> bool:
        """Whether there is more than noise."""
        return self.gain_nats > NOTICEABLE


def discrepancy(found: Fit, motion: PadMotion) -> Discrepancy:
    """The discrepancy at a fit. `motion` is the recording's own."""
    rest = unexplained(found, motion)
    squares = _squared_distances(rest.at)
    masks = _masks(rest.at)
    bounds = _bounds(rest)
    line, value = _most_likely(rest, squares, masks, bounds)
    kernels = _kernels(line, squares, masks)
    reduced = rest.reduce @ rest.residual_n
    root = np.linalg.cholesky(rest.reduce @ np.sum(kernels, axis=0) @ rest.reduce.T + np.eye(len(reduced)))
    weight = rest.reduce.T @ cho_solve((root, True), reduced)
    parts = {
        name: np.asarray(rest.expand @ (rest.reduce @ (kernel @ weight)))
        for name, kernel in zip(PARTS, kernels, strict=True)
    }
    mean = np.sum(list(parts.values()), axis=0)
    # The posterior covariance of a is I - S^-1, S = C + I with C the prior's.
    shrunk = solve_triangular(root, rest.expand.T, lower=True)
    sd = np.sqrt(np.maximum(np.sum(rest.expand**2, axis=1) - np.sum(shrunk**2, axis=0), 0.0))
    gain = 0.5 * float(reduced @ reduced) - value
    beyond = rest.beyond(rest.residual_n)
    own = {name: float(part @ part) for name, part in parts.items()}
    whole = float(beyond @ beyond) * sum(own.values())
    features = describe(rest, mean, sd) if gain > NOTICEABLE else ("nothing beyond the noise",)
    return Discrepancy(
        rest.bins, mean, sd, parts, beyond, rest.residual_n - beyond,
        float(np.sqrt(np.mean(mean**2))),
        {name: float(mean @ mean) * one / whole if whole > 0.0 else 0.0 for name, one in own.items()},
        dict(zip(PARTS, np.exp(line[:3]).tolist(), strict=True)),
        dict(zip(PARTS, np.exp(line[3:]).tolist(), strict=True)),
        gain,
        rest.log_evidence(np.sum(kernels, axis=0)) + _integrated(line, bounds, rest, squares, masks),
        rest.log_evidence(), features,
    )  # fmt: skip


def _squared_distances(at: Place) -> Array:
    """(3, k, k), one for each part."""
    reach = float(np.ptp(at.displacement_m)) or 1.0
    memory = np.log1p(at.since_s)
    axes = (at.displacement_m / reach, memory, memory)
    return np.array([(axis[:, None] - axis) ** 2 for axis in axes])


def _masks(at: Place) -> Array:
    """(3, k, k): how much of each part two bins share whatever their distance."""
    same = [values[:, None] == values for values in (at.direction, at.kind, at.phase)]
    return np.array([0.5 + 0.5 * same[0], same[1], same[2]], dtype=float)


def _kernels(line: Array, squares: Array, masks: Array) -> Array:
    """(3, k, k) [N^2] at logarithms of three sizes and three lengths, (6,)."""
    size, length = np.exp(line[:3, None, None]), np.exp(line[3:, None, None])
    return np.asarray(size**2 * masks * np.exp(-0.5 * squares / length**2))


def _bounds(rest: Unexplained) -> Array:
    """Of logarithms of sizes and lengths, (6, 2)."""
    noise = float(np.sqrt(np.median(np.diag(rest.noise_n2))))
    rms = max(float(np.sqrt(np.mean(rest.beyond(rest.residual_n) ** 2))), noise)
    return np.log([(SMALLEST * noise, LARGEST * rms)] * 3 + list(LENGTHS))


def _most_likely(rest: Unexplained, squares: Array, masks: Array, bounds: Array) -> tuple[Array, float]:
    """Logarithms of sizes and lengths (6,), and minus the log marginal likelihood there."""
    rms = np.exp(bounds[0, 1]) / LARGEST
    start = np.concatenate([np.full(3, np.log(rms / np.sqrt(3.0))), np.log([0.3, 0.8, 0.8])])
    found = minimize(_unlikely, start, (rest, squares, masks), jac=True, method="L-BFGS-B", bounds=bounds)
    return found.x, float(found.fun)


def _integrated(line: Array, bounds: Array, rest: Unexplained, squares: Array, masks: Array) -> float:
    """Laplace's logarithm of the share of the hyperparameters' box that the recording leaves, at the top."""
    width = bounds[:, 1] - bounds[:, 0]
    side = np.where(line + STEP * width < bounds[:, 1], STEP, -STEP)
    there = [_unlikely(line + at, rest, squares, masks)[1] for at in (np.zeros(6), *np.diag(side * width))]
    bend = np.array([(one - there[0]) * width / step for one, step in zip(there[1:], side, strict=True)])
    return occam(np.linalg.eigvalsh(0.5 * (bend + bend.T)))


def _unlikely(line: Array, rest: Unexplained, squares: Array, masks: Array) -> tuple[float, Array]:
    """Minus the log marginal likelihood, up to a constant, at `line` (6,) and its derivatives (6,)."""
    reduced = rest.reduce @ rest.residual_n
    kernels = _kernels(line, squares, masks)
    prior = rest.reduce @ kernels.sum(axis=0) @ rest.reduce.T
    root = np.linalg.cholesky(prior + np.eye(len(prior)))
    inverse = cho_solve((root, True), np.eye(len(prior)))
    weight = inverse @ reduced
    value = 0.5 * float(reduced @ weight) + float(np.sum(np.log(np.diag(root))))
    bend = rest.reduce.T @ (inverse - np.outer(weight, weight)) @ rest.reduce
    by_size = np.einsum("ij,pij->p", bend, kernels)
    by_length = np.einsum("ij,pij,pij->p", bend, kernels, squares) * 0.5 * np.exp(-2.0 * line[3:])
    return value, np.concatenate([by_size, by_length])
