"""Finds a local maximum of the posterior with few predictions, by Gauss-Newton steps on the force.

Each round first makes the noise parameters the most probable ones for the present force. It then takes the
force as linear in the material parameters, by one-sided differences. It solves the robust regression on these
parameters and on the surrogate's own error, within the prior box. Steps with several dampings are tried, both
straight and along the ridge of the moduli (`reparametrisation`). The best of them is taken if the posterior
itself rises. The information is the posterior's curvature by Fisher scoring, with the factor
(nu + 1) / (nu + 3) of the t-distribution for each innovation (Lange, Little & Taylor 1989, JASA 84:881).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayeskin.inference.gauss_newton_settings import GaussNewtonSettings
from bayeskin.inference.local_regression import LocalRegression
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.reparametrisation import Shear
from bayeskin.types import Array, Prediction


@dataclass(frozen=True)
class Top:
    """End point of a climb: sampling coordinates `vector` (D,), log density `value` and number of rounds.

    information (D, D) and gradient (D,) belong to the log density over the unit cube. The information has no
    terms between material and noise. latent (r,) is the surrogate's error at the point, in sd of each column
    of its factor.
    """

    vector: Array
    value: float
    rounds: int
    _linear: LocalRegression

    @property
    def information(self) -> Array:
        return self._linear.curvature[0]

    @property
    def gradient(self) -> Array:
        return self._linear.curvature[1]

    @property
    def latent(self) -> Array:
        return self._linear.curvature[2]


def gauss_newton(
    log_posterior: LogPosterior, start: Array, shear: Shear | None, rounds: int = 40, quick: bool = False,
    settings: GaussNewtonSettings = GaussNewtonSettings(),
) -> Top:  # fmt: skip
    """Returns the end of a climb from `start` (D,) in sampling coordinates.

    shear : the map that straightens this posterior, where it is known
    quick : for the first rounds of many climbs, of which the best continues without this option. Each round
        makes one step of expectation maximisation for the noise, and fewer steps for the t weights. The first
        round that gains next to nothing is the last. A climb across a ridge may end on the ridge's side.
    """
    low, high = log_posterior.bounds
    x = np.clip(np.asarray(start, dtype=float), low, high)
    prediction = log_posterior.predict(log_posterior.from_sampling(x))
    value = float(log_posterior.log_prob_given(x[None], prediction)[0])
    small_rounds = rounds_done = 0
    while np.isfinite(value) and rounds_done < rounds and small_rounds < (1 if quick else 2):
        rounds_done += 1
        before = value
        linear = LocalRegression(log_posterior, x, prediction, settings)
        for trials in _trials(linear, linear.with_noise(quick), shear, quick):
            best = _best_trial(log_posterior, trials)
            if best[1] > value:
                x, value, prediction = best
            if value > before + settings.enough:
                break
        small_rounds = small_rounds + 1 if value - before < settings.enough else 0
    return Top(x, value, rounds_done, LocalRegression(log_posterior, x, prediction, settings))


def _best_trial(log_posterior: LogPosterior, trials: Array) -> tuple[Array, float, Prediction]:
    """Returns the most probable of trials (n, D), its log density and the prediction at it."""
    predictions = log_posterior.predict(log_posterior.from_sampling(trials))
    values = log_posterior.log_prob_given(trials, predictions)
    best = int(np.argmax(values))
    row = slice(best, best + 1)
    return (
        trials[best],
        float(values[best]),
        Prediction(predictions.mean[row], predictions.factor[row], predictions.diagonal[row]),
    )


def _trials(linear: LocalRegression, x: Array, shear: Shear | None, quick: bool) -> list[Array]:
    """Returns for each group of dampings the point and the trial points that the linear force proposes.

    Each group is (n, D), within the box.
    """
    (low, high), damped = linear.log_posterior.bounds, linear.settings.damped
    steps = iter(linear.steps(x, sum(damped, ()), quick))
    groups = []
    for dampings in damped:
        trials = [x]
        for _ in dampings:
            step = next(steps)
            trials.append(x + step)
            if shear is not None:
                straight = shear.straight(x[None])
                change = (shear.straight((x + 1e-6 * step)[None]) - straight) / 1e-6
                trials.append(shear.back(straight + change)[0])
        groups.append(np.clip(np.array(trials), low, high))
    return groups
