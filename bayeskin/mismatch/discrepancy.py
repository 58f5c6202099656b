"""A discrepancy that no mechanism explains: a Gaussian process over the coordinates that physics acts in.

Four parts are added up, each with its own size s and length l of a squared-exponential kernel:

    displacement   over displacement; half of it the same in every direction of motion, half its own
    change         like displacement, but a change from each cycle to the next that stays in all later ones
    phase          over log(1 + time since the last corner); the same in all phases of a kind
    cycle          over the same time; its own in each phase of each cycle

The prior is that of `unexplained`: orthogonal to all that the parameters could take up. Sizes, lengths, and
how large and how long-lived the noise with a memory is maximise the evidence, with and without a discrepancy;
both evidences integrate over them. So what such noise can explain speaks for no discrepancy.
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

from bayeskin.mismatch.features import describe
from bayeskin.mismatch.fit import Fit, occam
from bayeskin.mismatch.unexplained import Memory, Place, Unexplained, unexplained
from bayeskin.types import Array, PadMotion

PARTS = ("displacement", "change", "phase", "cycle")
SMALLEST, LARGEST = 0.01, 10.0  # size s: of the noise's sd, of the residual's RMS
# Length l: of the displacement's range, and of log(1 + t / 1 s).
OVER_DISPLACEMENT, OVER_TIME = (0.05, 2.0), (0.2, 3.0)
LENGTHS = (OVER_DISPLACEMENT, OVER_DISPLACEMENT, OVER_TIME, OVER_TIME)
LITTLE = 0.1  # of the fitted noise with a memory, from which a climb beside a discrepancy begins
STEP = 1e-3  # of a hyperparameter's range, for second derivatives
NOTICEABLE = 5.0  # nats over no discrepancy; noise alone gains less in 99 of 100 recordings


@dataclass(frozen=True)
class Discrepancy:
    """The force that the model leaves unexplained, on the fitted bins (k,).

    mean_n, sd_n (k,) of the discrepancy; parts_n: mean (k,) of each part, which add up to mean_n;
    beyond_n (k,) the residual beyond what parameters could still take up, and taken_n (k,) what they could;
    size_n the RMS of mean_n; share: of the squares of beyond_n those of mean_n, split by the parts' own;
    size_by_part, length_by_part: hyperparameters; memory: the noise with a memory beside it; gain_nats: log
    evidence at the best hyperparameters over that of no discrepancy at its best; log_evidence: of the fit
    with it, and without_log_evidence: without (`Unexplained`), hyperparameters integrated over log-uniform
    priors between their bounds; features: what it looks like, in words.
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
        """Returns whether there is more than noise."""
        return self.gain_nats > NOTICEABLE


def discrepancy(found: Fit, motion: PadMotion) -> Discrepancy:
    """The discrepancy at a fit. `motion` is the recording's own."""
    rest = unexplained(found, motion)
    squares, masks, bounds = _squared_distances(rest.at), _masks(rest.at), _bounds(rest)
    noise_alone = _maximum(partial(_unlikely, rest=rest), _starts(rest), bounds[:2])
    unlikely = partial(_unlikely, rest=rest, squares=squares, masks=masks)
    top = _maximum(unlikely, _starts(rest, bounds), bounds)
    alone, rest = rest.with_memory(noise_alone.line), rest.with_memory(top.line[:2])
    line = top.line[2:]
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
    gain = noise_alone.value - top.value
    beyond = rest.beyond(rest.residual_n)
    own = {name: float(part @ part) for name, part in parts.items()}
    whole = float(beyond @ beyond) * sum(own.values())
    features = describe(rest, mean, sd) if gain > NOTICEABLE else ("nothing beyond the noise",)
    return Discrepancy(
        rest.bins, mean, sd, parts, beyond, rest.residual_n - beyond,
        float(np.sqrt(np.mean(mean**2))),
        {name: float(mean @ mean) * one / whole if whole > 0.0 else 0.0 for name, one in own.items()},
        dict(zip(PARTS, np.exp(line[:4]).tolist(), strict=True)),
        dict(zip(PARTS, np.exp(line[4:]).tolist(), strict=True)),
        rest.memory, gain,
        rest.log_evidence(np.sum(kernels, axis=0)) + top.share, alone.log_evidence() + noise_alone.share,
        features,
    )  # fmt: skip


def _squared_distances(at: Place) -> Array:
    """(4, k, k), one for each part."""
    reach = float(np.ptp(at.displacement_m)) or 1.0
    memory = np.log1p(at.since_s)
    displacement = at.displacement_m / reach
    axes = (displacement, displacement, memory, memory)
    return np.array([(axis[:, None] - axis) ** 2 for axis in axes])


def _masks(at: Place) -> Array:
    """(4, k, k): how much of each part two bins share whatever their distance."""
    same = [values[:, None] == values for values in (at.direction, at.kind, at.phase)]
    moving, changes = 0.5 + 0.5 * same[0], np.maximum(at.cycle - 1.0, 0.0)
    before_both = np.minimum(changes[:, None], changes) / max(changes.max(), 1.0)
    return np.array([moving, before_both * moving, same[1], same[2]], dtype=float)


def _kernels(line: Array, squares: Array, masks: Array) -> Array:
    """(4, k, k) [N^2] at logarithms of four sizes and four lengths, (8,)."""
    size, length = np.exp(line[:4, None, None]), np.exp(line[4:, None, None])
    return np.asarray(size**2 * masks * np.exp(-0.5 * squares / length**2))


def _bounds(rest: Unexplained) -> Array:
    """Returns bounds (10, 2) of logarithms: noise's size and memory, then the parts' sizes and lengths."""
    noise = float(np.sqrt(np.median(np.diag(rest.measured_n2))))
    rms = max(float(np.sqrt(np.mean(rest.beyond(rest.residual_n) ** 2))), noise)
    of_noise = [rest.memory.size_within, rest.memory.time_within]
    return np.log([*of_noise, *[(SMALLEST * noise, LARGEST * rms)] * 4, *LENGTHS])


def _starts(rest: Unexplained, bounds: Array | None = None) -> list[Array]:
    """Returns where climbs begin: at the fitted noise and at little; with `bounds`, at little alone."""
    fitted = np.log([rest.memory.size, rest.memory.time_s])
    noises = [fitted, fitted + np.log([LITTLE, 1.0])]
    if bounds is None:
        return noises
    rms = np.exp(bounds[2, 1]) / LARGEST
    parts = np.concatenate([np.full(4, np.log(rms / 2.0)), np.log([0.3, 0.3, 0.8, 0.8])])
    return [np.concatenate([noise, parts]) for noise in noises[1:]]


class _Top(NamedTuple):
    """Logarithms of the best hyperparameters; minus the log evidence there; Laplace's logarithm of the share
    of their box that the recording leaves."""

    line: Array
    value: float
    share: float


def _maximum(
    unlikely: Callable[[Array], tuple[float, Array]], starts: Sequence[Array], bounds: Array
) -> _Top:
    tops = [minimize(unlikely, np.clip(start, *bounds.T), jac=True, method="L-BFGS-B", bounds=bounds)
            for start in starts]  # fmt: skip
    best = min(tops, key=lambda top: top.fun)
    line, width = np.asarray(best.x), bounds[:, 1] - bounds[:, 0]
    side = np.where(line + STEP * width < bounds[:, 1], STEP, -STEP)
    here = unlikely(line)[1]
    there = [unlikely(line + at)[1] for at in np.diag(side * width)]
    bend = np.array([(one - here) * width / step for one, step in zip(there, side, strict=True)])
    return _Top(line, float(best.fun), occam(np.linalg.eigvalsh(0.5 * (bend + bend.T))))


def _unlikely(
    line: Array, rest: Unexplained, squares: Array | None = None, masks: Array | None = None
) -> tuple[float, Array]:
    """Minus the log evidence, up to a constant, at logarithms of hyperparameters, and its derivatives.

    Size and time of the noise (2,), and with distances and masks those of parts after them (10,).
    """
    rest = rest.with_memory(line[:2])
    memory = rest.memory.covariance_n2
    covariance, kernels = rest.noise_n2 + rest.open_n2, None
    if squares is not None and masks is not None:
        kernels = _kernels(line[2:], squares, masks)
        covariance = covariance + rest.beyond(rest.beyond(kernels.sum(axis=0)).T)
    root, inverse = _inverted(covariance)
    weight = inverse @ rest.residual_n
    value = 0.5 * float(rest.residual_n @ weight) + float(np.sum(np.log(np.diag(root))))
    bend = inverse - np.outer(weight, weight)
    forgetting = np.where(np.isfinite(rest.memory.apart_s), rest.memory.apart_s, 0.0) / rest.memory.time_s
    slopes = [np.sum(bend * memory), 0.5 * np.sum(bend * memory * forgetting)]
    if kernels is None or squares is None:
        return value, np.array(slopes)
    bend = rest.beyond(rest.beyond(bend).T)
    by_size = np.einsum("ij,pij->p", bend, kernels)
    by_length = np.einsum("ij,pij,pij->p", bend, kernels, squares) * 0.5 * np.exp(-2.0 * line[6:])
    return value, np.concatenate([slopes, by_size, by_length])


def _inverted(covariance: Array) -> tuple[Array, Array]:
    """Returns the Cholesky factor and the inverse; raises LinAlgError where it is not positive definite."""
    root = np.linalg.cholesky(covariance)
    lower, _ = dpotri(root, lower=1)
    return np.asarray(root), np.asarray(np.tril(lower) + np.tril(lower, -1).T)
