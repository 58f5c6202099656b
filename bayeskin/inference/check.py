"""Compares the surrogate with the full model where it matters most: at the most probable point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayeskin.inference.optimise import MapResult, find_map
from bayeskin.inference.problem import LogPosterior
from bayeskin.number_format import quantity
from bayeskin.types import Array, FreezesArrays, Prediction, Simulation, Surrogate

FullRun = Callable[[Mapping[str, float]], Simulation]
Retrain = Callable[[Mapping[str, float], Simulation], Surrogate]


@dataclass(frozen=True)
class CheckSettings:
    """Limits of the surrogate's error at the most probable point.

    z : largest RMS of the errors over their claimed sd; a surrogate with a correct sd and one dominant error
        mode exceeds it at one point in twenty
    noise_share : share of the noise below which an error does not change the posterior, whatever sd the
        surrogate claims
    """

    z: float = 2.0
    noise_share: float = 0.1


@dataclass(frozen=True)
class MapCheck(FreezesArrays):
    """Error of the surrogate at one point: its force minus that of the full model.

    error_n (m,) [N] is the error in each bin. rms_n and max_n [N] are its root mean square and its largest
    magnitude over the bins. rms_z is the root mean square of the errors over their claimed sd. mahalanobis
    is sqrt(e' C^-1 e / m) with the claimed covariance C, correlations included. It is reported but not
    judged, because it measures rounding where C is nearly singular. All are NaN when the full run failed.
    """

    theta: Mapping[str, float]
    error_n: Array
    rms_n: float
    max_n: float
    rms_z: float
    mahalanobis: float
    passes: bool
    message: str
    simulation: Simulation


@dataclass(frozen=True)
class RefinedMap:
    """The last maximum, the surrogate that it belongs to (in `log_posterior`), and every check."""

    map: MapResult
    log_posterior: LogPosterior
    checks: tuple[MapCheck, ...]

    @property
    def passes(self) -> bool:
        return self.checks[-1].passes


def check_map(
    surrogate: Surrogate,
    full_run: FullRun,
    theta: Mapping[str, float],
    noise_sd_n: float = 0.0,
    fitted: NDArray[np.int64] | None = None,
    settings: CheckSettings = CheckSettings(),
) -> MapCheck:
    """Runs the full model at `theta` (SI by name) and returns how far the surrogate is from it.

    Entries of `theta` that the surrogate lacks are ignored. The check passes in either of two cases:
    - The errors do not matter: their rms is at most a tenth of `noise_sd_n`, the noise sd of a bin [N].
    - The errors are as small as the surrogate claims (rms_z <= 2), and in the bins `fitted` (all by default)
      they do not exceed the noise. A maximum with larger errors may come from the surrogate's uncertainty
      and not from the model. The comparison with the noise is left out where `noise_sd_n` is 0.
    A failed run gives a check that does not pass.
    """
    material = {name: float(theta[name]) for name in surrogate.space.names}
    simulation = full_run(material)
    if simulation.status != "ok":
        nan = float("nan")
        empty = np.full(len(surrogate.edges_s) - 1, nan)
        message = f"the full model failed at the maximum: {simulation.message}"
        return MapCheck(material, empty, nan, nan, nan, nan, False, message, simulation)
    prediction = surrogate.predict(np.array([list(material.values())]))
    error = prediction.mean[0] - simulation.bin_means(surrogate.edges_s)
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    rms_z = _rms_z(error, prediction.sd()[0])
    as_claimed, negligible = rms_z <= settings.z, rms <= settings.noise_share * noise_sd_n
    where_fitted_n = float(np.sqrt(np.mean(error[slice(None) if fitted is None else fitted] ** 2)))
    below_noise = noise_sd_n == 0.0 or where_fitted_n <= noise_sd_n
    text = (
        f"surrogate off by {quantity(rms, 'N')} RMS ({quantity(largest, 'N')} at most), "
        f"{rms_z:.2f} of its stated sd"
    )
    if as_claimed and below_noise:
        text += f": below the limit of {settings.z:g}"
    elif negligible:
        text += f", but less than {settings.noise_share:g} times the noise ({quantity(noise_sd_n, 'N')})"
    elif as_claimed:
        text += (
            f", but {quantity(where_fitted_n, 'N')} RMS in the fitted bins, more than the noise "
            f"({quantity(noise_sd_n, 'N')}); add the point to the design and train again"
        )
    else:
        text += f": above the limit of {settings.z:g}; add the point to the design and train again"
    passes = bool((as_claimed and below_noise) or negligible)
    return MapCheck(
        material, error, rms, largest, rms_z, _mahalanobis(error, prediction), passes, text, simulation
    )


def refine_map(
    log_posterior: LogPosterior,
    full_run: FullRun,
    retrain: Retrain,
    seed: int,
    starts: int = 8,
    evaluations: int = 20000,
    max_rounds: int = 8,
) -> RefinedMap:
    """Finds the maximum, runs the full model there and retrains with that run, until a check passes.

    The loop ends after `max_rounds` checks at the latest. `retrain(theta, simulation)` returns the surrogate
    whose training includes the run. It is not called after a failed run, which teaches nothing: the loop
    ends there, and the result does not pass.
    """
    checks: list[MapCheck] = []
    while True:
        maximum = find_map(log_posterior, seed, starts, evaluations)
        noise_sd_n = _noise_sd_n(log_posterior, maximum.theta)
        fitted = log_posterior.chain.bins
        check = check_map(log_posterior.surrogate, full_run, maximum.theta, noise_sd_n, fitted)
        checks.append(check)
        if check.passes or check.simulation.status != "ok" or len(checks) >= max_rounds:
            return RefinedMap(maximum, log_posterior, tuple(checks))
        log_posterior = dataclasses.replace(log_posterior, surrogate=retrain(check.theta, check.simulation))


def _noise_sd_n(log_posterior: LogPosterior, theta: Mapping[str, float]) -> float:
    """Returns the smallest noise sd [N] among the kinds of phase, as the strictest limit.

    The sd includes a bin's own variance.
    """
    chain = log_posterior.chain
    sd = np.array([theta[f"sd_{kind}"] for kind in chain.kinds])[chain.kind]
    total = sd**2 + chain.variance_n2
    return float(np.sqrt(min(total[chain.kind == k].mean() for k in range(len(chain.kinds)))))


def _rms_z(error: Array, sd: Array) -> float:
    # Where a bin is claimed to be exact, an error of a millionth of the largest sd is allowed for rounding.
    floor = 1e-6 * float(sd.max()) or np.finfo(float).tiny
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean((error / np.maximum(sd, floor)) ** 2)))


def _mahalanobis(error: Array, prediction: Prediction) -> float:
    """Returns sqrt(e' C^-1 e / m) by the Woodbury identity; the diagonal has the floor of `_rms_z`."""
    floor = 1e-12 * float((prediction.sd()[0] ** 2).max()) or np.finfo(float).tiny
    diagonal = np.maximum(prediction.diagonal[0], floor)
    scaled = prediction.factor[0] / diagonal[:, None]
    inner = np.eye(scaled.shape[1]) + prediction.factor[0].T @ scaled
    through = scaled.T @ error
    with np.errstate(over="ignore"):
        square = error @ (error / diagonal) - through @ cho_solve(cho_factor(inner), through)
    return float(np.sqrt(max(square, 0.0) / len(error)))
