"""The surrogate against the full model where it matters: at the most probable point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayeskin.inference.optimise import MapResult, find_map
from bayeskin.inference.problem import LogPosterior
from bayeskin.types import Array, Prediction, Simulation, Surrogate, _FreezesArrays

FullRun = Callable[[Mapping[str, float]], Simulation]
Retrain = Callable[[Mapping[str, float], Simulation], Surrogate]

Z_LIMIT = 2.0  # an honest surrogate with one dominant error mode exceeds it at one point in twenty
NOISE_SHARE = 0.1  # an error this small beside the noise changes no posterior, whatever sd is claimed


@dataclass(frozen=True)
class MapCheck(_FreezesArrays):
    """Surrogate minus full model at one point.

    error_n (m,) [N]; rms_n, max_n over bins [N]; rms_z of the errors over their claimed sd;
    mahalanobis: sqrt(e' C^-1 e / m) with the claimed covariance, correlations included (reported, not
    judged: where C is nearly singular it measures rounding). NaN throughout when the full run failed.
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
    """The last maximum, the surrogate it was found with (in `log_posterior`), and every check made."""

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
) -> MapCheck:
    """Runs the full model at `theta` (SI by name; entries the surrogate lacks are ignored) and compares.

    Passes when the errors do not matter, rms error at most a tenth of `noise_sd_n`, the noise sd of a bin
    [N]; or when they are what the surrogate claims, rms_z <= 2, and at most the noise in the bins `fitted`
    (all by default): a maximum with larger ones may be of the surrogate's uncertainty, not of the model. A
    failed run is a check that does not pass.
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
    as_claimed, negligible = rms_z <= Z_LIMIT, rms <= NOISE_SHARE * noise_sd_n
    where_fitted_n = float(np.sqrt(np.mean(error[slice(None) if fitted is None else fitted] ** 2)))
    below_noise = noise_sd_n == 0.0 or where_fitted_n <= noise_sd_n
    text = f"surrogate off by {1e3 * rms:.3g} mN rms ({1e3 * largest:.3g} at most), {rms_z:.2f} of its own sd"
    if as_claimed and below_noise:
        text += f": within the {Z_LIMIT:g} allowed"
    elif negligible:
        text += f", but within {NOISE_SHARE:g} of the noise ({1e3 * noise_sd_n:.3g} mN)"
    elif as_claimed:
        text += (
            f", but {1e3 * where_fitted_n:.3g} mN where fitted, more than the noise's "
            f"{1e3 * noise_sd_n:.3g}; add the point to the design and train again"
        )
    else:
        text += f": more than the {Z_LIMIT:g} allowed; add the point to the design and train again"
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
    """Maximum, full run there, retraining with that run: until the check passes, or `max_rounds` checks.

    `retrain(theta, simulation)` gives the surrogate whose training includes the run. It is not called
    after a failed run, which teaches nothing: the loop ends there, not passed.
    """
    checks: list[MapCheck] = []
    while True:
        found = find_map(log_posterior, seed, starts, evaluations)
        noise_sd_n = _noise_sd_n(log_posterior, found.theta)
        fitted = log_posterior.chain.bins
        check = check_map(log_posterior.surrogate, full_run, found.theta, noise_sd_n, fitted)
        checks.append(check)
        if check.passes or check.simulation.status != "ok" or len(checks) >= max_rounds:
            return RefinedMap(found, log_posterior, tuple(checks))
        log_posterior = dataclasses.replace(log_posterior, surrogate=retrain(check.theta, check.simulation))


def _noise_sd_n(log_posterior: LogPosterior, theta: Mapping[str, float]) -> float:
    """Smallest noise sd of a phase kind [N], a bin's own variance included: the strictest yardstick."""
    chain = log_posterior.chain
    sd = np.array([theta[f"sd_{kind}"] for kind in chain.kinds])[chain.kind]
    total = sd**2 + chain.variance_n2
    return float(np.sqrt(min(total[chain.kind == k].mean() for k in range(len(chain.kinds)))))


def _rms_z(error: Array, sd: Array) -> float:
    # A bin claimed to be exact counts as such to a millionth of the largest sd, so that rounding passes.
    floor = 1e-6 * float(sd.max()) or np.finfo(float).tiny
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean((error / np.maximum(sd, floor)) ** 2)))


def _mahalanobis(error: Array, prediction: Prediction) -> float:
    """sqrt(e' C^-1 e / m) by the Woodbury identity; the diagonal is floored as in `_rms_z`."""
    floor = 1e-12 * float((prediction.sd()[0] ** 2).max()) or np.finfo(float).tiny
    diagonal = np.maximum(prediction.diagonal[0], floor)
    scaled = prediction.factor[0] / diagonal[:, None]
    inner = np.eye(scaled.shape[1]) + prediction.factor[0].T @ scaled
    through = scaled.T @ error
    with np.errstate(over="ignore"):
        square = error @ (error / diagonal) - through @ cho_solve(cho_factor(inner), through)
    return float(np.sqrt(max(square, 0.0) / len(error)))
