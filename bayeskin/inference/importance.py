"""Compares the surrogate's posterior with the full model's: draws are run again and weighted.

A draw theta of the surrogate's posterior represents the full model's posterior with the weight
p(y | theta, full model) / p(y | theta, surrogate), since both posteriors have the same prior. If all weights
are alike, the surrogate does not change the posterior. If few draws carry all the weight, the surrogate's
posterior lies elsewhere. From 200 draws on, the largest weights are smoothed by a generalised Pareto tail.
Its shape k-hat says whether sums of the weights are reliable (Vehtari et al. 2024, J. Mach. Learn. Res.
25:72). With fewer draws, only the effective number of draws and the largest weight can tell this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.inference.convergence import Verdict
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.problem import LogPosterior
from bayeskin.number_format import number
from bayeskin.types import Array, FreezesArrays, ParameterSpace


@dataclass(frozen=True)
class WeightSettings:
    """Settings of importance weights and of their verdict.

    smoothed_from : smallest number of draws whose weights are smoothed
    khat : largest k-hat with which sums of the weights are reliable (Vehtari et al. 2024)
    effective_share : share of effective draws below which the surrogate's posterior counts as different
    """

    smoothed_from: int = 200
    khat: float = 0.7
    effective_share: float = 0.5


@dataclass(frozen=True)
class Weighed(FreezesArrays):
    """Draws theta (s, D) in SI with normalised weights (s,); a draw whose full run failed has weight zero.

    log_ratio (s,) : log-likelihood of the full model less that of the surrogate [nats], -inf for a failed run
    effective : effective number of draws, 1 / sum of squared weights
    khat : shape of the Pareto tail, NaN below 200 draws
    """

    space: ParameterSpace
    theta: Array
    log_ratio: Array
    weights: Array
    effective: float
    khat: float
    verdict: Verdict


@dataclass(frozen=True)
class Corrected:
    """One parameter under the full model; all but the quantiles are in logarithms where the prior is.

    quantiles : 5, 50 and 95 % quantiles in SI
    shift_sd, shift_error_sd : shift of the mean and its standard error, in sd of the surrogate's posterior
    sd_ratio : sd under the full model over sd under the surrogate
    """

    name: str
    quantiles: tuple[float, float, float]
    shift_sd: float
    shift_error_sd: float
    sd_ratio: float


def weigh(
    log_posterior: LogPosterior, theta: ArrayLike, force_n: ArrayLike,
    settings: WeightSettings = WeightSettings(),
) -> Weighed:  # fmt: skip
    """Returns posterior draws theta (s, D) in SI with weights, from the full model's forces at them.

    force_n (s, m) [N] are the bin means of these forces. A row of NaN stands for a run that failed.
    """
    theta, force = np.atleast_2d(np.asarray(theta, dtype=float)), np.atleast_2d(np.asarray(force_n, float))
    ok = np.isfinite(force).all(axis=1)
    log_ratio = np.full(len(theta), -np.inf)
    if ok.any():
        exact = log_posterior.of_full_model(force[ok])
        full = log_likelihood(log_posterior.chain, exact, log_posterior.split(theta[ok])[1])
        log_ratio[ok] = full - log_posterior.log_likelihood(theta[ok])
    weights, khat = smoothed_weights(log_ratio, settings)
    effective = float(1.0 / np.sum(weights**2)) if ok.any() else 0.0
    verdict = _verdict(weights, effective, khat, int((~ok).sum()), settings)
    return Weighed(log_posterior.space, theta, log_ratio, weights, effective, khat, verdict)


def corrected(weighed: Weighed, draws: ArrayLike) -> tuple[Corrected, ...]:
    """Returns each parameter's posterior under the full model.

    `draws` (n, D) in SI come from the surrogate's posterior and are many more than the weighted draws. The
    weights shift the mean of the weighted draws and stretch their sd. All draws are shifted and stretched by
    the same amount, in logarithms where the prior is. Thus the sampling error of few weighted draws cancels
    where the weights are nearly alike.
    """
    space, w, tiny = weighed.space, weighed.weights, np.finfo(float).tiny
    line, few = space.to_line(draws), space.to_line(weighed.theta)
    mean, weighted_mean = line.mean(axis=0), w @ few
    shift = weighted_mean - few.mean(axis=0)
    error = np.sqrt(((w - 1.0 / len(w)) ** 2) @ (few - weighted_mean) ** 2)
    sd = np.maximum(line.std(axis=0), tiny)
    ratio = np.sqrt(w @ (few - weighted_mean) ** 2 / np.maximum(few.var(axis=0), tiny))
    quantiles = np.quantile(mean + shift + ratio * (line - mean), [0.05, 0.5, 0.95], axis=0)
    inside = np.clip(space.from_line(quantiles), space.lower, space.upper)
    columns = zip(space.names, inside.T, shift / sd, error / sd, ratio, strict=True)
    return tuple(
        Corrected(name, (float(low), float(middle), float(high)), float(shifted), float(unsure), float(times))
        for name, (low, middle, high), shifted, unsure, times in columns
    )


def smoothed_weights(log_ratio: Array, settings: WeightSettings) -> tuple[Array, float]:
    """Returns normalised weights (s,), smoothed where the draws are many, and k-hat (NaN where not)."""
    if not np.isfinite(log_ratio).any():
        return np.zeros(len(log_ratio)), float("nan")
    relative, khat = log_ratio - log_ratio.max(), float("nan")
    if np.isfinite(relative).sum() >= settings.smoothed_from:
        import arviz as az  # imported here, because the import takes seconds and is rarely needed

        smooth, shape = az.psislw(np.maximum(relative, -700.0))
        relative, khat = np.asarray(smooth), float(shape)
    weights = np.exp(relative - relative.max())
    return weights / weights.sum(), khat


def _verdict(weights: Array, effective: float, khat: float, failed: int, settings: WeightSettings) -> Verdict:
    count = len(weights)
    fewest = settings.effective_share * count
    text = (
        f"full model at {count} posterior draws: {effective:.1f} effective draws, at least "
        f"{fewest:g} are needed; the largest weight is {number(weights.max(), 2)}"
    )
    good = effective >= fewest
    if np.isfinite(khat):
        text += f"; Pareto k-hat is {khat:.2f}, at most {settings.khat:g} is allowed"
        good = good and khat <= settings.khat
    return Verdict(bool(good), (text + (f"; {failed} runs failed" if failed else ""),))
