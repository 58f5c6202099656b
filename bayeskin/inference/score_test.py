"""Score tests: the log-likelihood that a change of the force would gain, without a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayeskin.inference.gauss_newton_settings import GaussNewtonSettings
from bayeskin.inference.local_regression import LocalRegression
from bayeskin.inference.problem import UNIFORM_PRECISION, LogPosterior
from bayeskin.types import Array

LESS_NOISE = (1.0, 0.3, 0.1)  # shares of a point's noise at which a missing change of force is tested


def promise(
    log_posterior: LogPosterior, vector: Array, trials: Array, free: NDArray[np.bool_], count: int,
    mean_n: Array | None = None,
) -> list[tuple[int, float, float, Array]]:  # fmt: skip
    """Returns the `count` trials along whose change of force most can be gained from `vector` (D,).

    Each result has the trial's row, the gain [nats], the best multiple of the change of force, and `vector`
    with its `free` coordinates adjusted to that change, within the box. All follow from the linear
    approximation of the force (a score test). The noise at `vector` may contain the missing change. Each
    trial is therefore tested with this noise and with shares of it (`LESS_NOISE`); its largest gain counts.

    trials : points (n, D) in sampling coordinates
    free : (D,) True for coordinates that may move; only those of the material do
    mean_n : force (n, m) [N] at the trials, where it is not to be predicted by the surrogate
    """
    if mean_n is None:
        mean_n = log_posterior.predict_mean(log_posterior.from_sampling(trials))
    value, by_noise = float(log_posterior.log_prob(vector[None])[0]), []
    for share in LESS_NOISE:
        quieter = with_less_noise(log_posterior, vector, share)
        lost = value - float(log_posterior.log_prob(quieter[None])[0])
        by_noise.append(_ScoreTests(log_posterior, quieter, mean_n, free, lost))
    best = np.argmax([test.gain for test in by_noise], axis=0)
    gain = np.max([test.gain for test in by_noise], axis=0)
    return [
        (int(i), float(gain[i]), float(by_noise[best[i]].multiple[i]), by_noise[best[i]].moved(int(i)))
        for i in np.argsort(-gain)[:count]
    ]


def with_less_noise(log_posterior: LogPosterior, vector: Array, share: float = LESS_NOISE[-1]) -> Array:
    """Returns the point (D,) with a smaller noise, within the box.

    share : factor on the sd of the noise with a memory, for each kind of phase
    """
    sds = np.array([name.startswith("sd_") for name in log_posterior.names])
    low, high = log_posterior.bounds
    return np.asarray(np.clip(np.where(sds, vector + np.log(share), vector), low, high))


class _ScoreTests:
    """Score tests of n changes of force at a point.

    `gain` (n,) [nats] is the gain of each change, less the nats `lost` by the point's noise. `multiple` (n,)
    is the best multiple of each change.
    """

    def __init__(
        self, log_posterior: LogPosterior, vector: Array, mean_n: Array, free: NDArray[np.bool_], lost: float
    ) -> None:
        prediction = log_posterior.predict(log_posterior.from_sampling(vector))
        linear = LocalRegression(log_posterior, vector, prediction, GaussNewtonSettings())
        self._linear, self._vector = linear, vector
        self._others = free[: linear.inner]
        self._change = linear.white((mean_n - prediction.mean)[:, linear.chain.bins].T)
        residual, slopes, factor = linear.columns()
        design = np.concatenate([slopes[:, self._others], factor], axis=1)
        moved = int(self._others.sum())
        pull, bend = linear.beside_force(vector)
        precision = np.r_[np.full(moved, UNIFORM_PRECISION), np.ones(factor.shape[1])]
        normal = design.T @ design + np.diag(precision)
        normal[:moved, :moved] += bend[np.ix_(self._others, self._others)]
        target = np.column_stack([residual, self._change])
        right = design.T @ target
        right[:moved, 0] += pull[self._others]
        residuals = target - design @ np.linalg.solve(normal, right)
        length = np.maximum(np.sum(self._change * residuals[:, 1:], axis=0), 1e-12)
        self.multiple = (self._change.T @ residuals[:, 0]) / length
        self.gain = 0.5 * self.multiple**2 * length - lost

    def moved(self, i: int) -> Array:
        """Returns the point (D,) with its free coordinates adjusted to the best multiple of change `i`."""
        explained = self.multiple[i] * self._change[:, i]
        step = self._linear.steps(self._vector, (0.0,), False, explained, self._others)[0]
        return np.asarray(self._vector + step)
