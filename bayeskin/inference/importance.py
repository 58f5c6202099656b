"""The surrogate's posterior held against the full model's: draws run again, and weighed.

A draw theta of the posterior under the surrogate stands for the posterior under the full model with the
weight p(y | theta, full model) / p(y | theta, surrogate), since both have one prior. Weights that are all
alike say that the surrogate changes nothing; few that carry everything, that its posterior is elsewhere.
From 200 draws on the largest are smoothed by a generalised Pareto tail, whose shape k-hat says whether
their sums can be relied on (Vehtari et al. 2024, J. Mach. Learn. Res. 25:72); below, the effective number of
draws and the largest weight have to do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.inference.convergence import Verdict
from bayeskin.inference.likelihood import log_likelihood
from bayeskin.inference.problem import LogPosterior
from bayeskin.types import Array, ParameterSpace, _FreezesArrays

SMOOTHED_FROM = 200  # draws
KHAT_LIMIT = 0.7
EFFECTIVE_SHARE = 0.5  # of the draws, below which the surrogate's posterior is another one


@dataclass(frozen=True)
class Weighed(_FreezesArrays):
    """Draws theta (s, D) in SI with normalised weights (s,); a full run that failed weighs nothing.

    log_ratio (s,): log-likelihood of the full model less that of the surrogate [nats], -inf where it
    failed; effective: 1 / sum of squared weights; khat: NaN below 200 draws.
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
    """One parameter under the full model: 5, 50 and 95 % quantiles in SI. On its line (logarithms where the
    prior is in them) the shift of the mean in sd of the surrogate's posterior, its standard error, and the sd
    over that one."""

    name: str
    quantiles: tuple[float, float, float]
    shift_sd: float
    shift_error_sd: float
    sd_ratio: float


def weigh(log_posterior: LogPosterior, theta: ArrayLike, force_n: ArrayLike) -> Weighed:
    """Weights of posterior draws theta (s, D) in SI by the full model's bin means force_n (s, m) [N].

    A row of NaN is a run that failed.
    """
    theta, force = np.atleast_2d(np.asarray(theta, dtype=float)), np.atleast_2d(np.asarray(force_n, float))
    ok = np.isfinite(force).all(axis=1)
    log_ratio = np.full(len(theta), -np.inf)
    if ok.any():
        exact = log_posterior.of_full_model(force[ok])
        full = log_likelihood(log_posterior.chain, exact, log_posterior.split(theta[ok])[1])
        log_ratio[ok] = full - log_posterior.log_likelihood(theta[ok])
    weights, khat = _weights(log_ratio)
    effective = float(1.0 / np.sum(weights**2)) if ok.any() else 0.0
    verdict = _verdict(weights, effective, khat, int((~ok).sum()))
    return Weighed(log_posterior.space, theta, log_ratio, weights, effective, khat, verdict)


def corrected(weighed: Weighed, draws: ArrayLike) -> tuple[Corrected, ...]:
    """The full model's posterior beside the surrogate's, whose draws (n, D) in SI are many more.

    All draws are moved, on the line, by what the weights move the mean of the weighed ones, and stretched by
    what they stretch their sd. So an error of sampling few draws cancels where the weights are nearly alike.
    """
    space, w, tiny = weighed.space, weighed.weights, np.finfo(float).tiny
    line, few = space.to_line(draws), space.to_line(weighed.theta)
    mean, moved = line.mean(axis=0), w @ few
    shift = moved - few.mean(axis=0)
    error = np.sqrt(((w - 1.0 / len(w)) ** 2) @ (few - moved) ** 2)
    wide = np.maximum(line.std(axis=0), tiny)
    ratio = np.sqrt(w @ (few - moved) ** 2 / np.maximum(few.var(axis=0), tiny))
    quantiles = np.quantile(mean + shift + ratio * (line - mean), [0.05, 0.5, 0.95], axis=0)
    inside = np.clip(space.from_line(quantiles), space.lower, space.upper)
    columns = zip(space.names, inside.T, shift / wide, error / wide, ratio, strict=True)
    return tuple(
        Corrected(name, (float(low), float(middle), float(high)), float(by), float(unsure), float(times))
        for name, (low, middle, high), by, unsure, times in columns
    )


def _weights(log_ratio: Array) -> tuple[Array, float]:
    """Normalised weights (s,), smoothed from 200 on, and k-hat."""
    if not np.isfinite(log_ratio).any():
        return np.zeros(len(log_ratio)), float("nan")
    relative, khat = log_ratio - log_ratio.max(), float("nan")
    if np.isfinite(relative).sum() >= SMOOTHED_FROM:
        import arviz as az  # takes seconds, which only those who ask for it should wait

        smooth, shape = az.psislw(np.maximum(relative, -700.0))
        relative, khat = np.asarray(smooth), float(shape)
    weights = np.exp(relative - relative.max())
    return weights / weights.sum(), khat


def _verdict(weights: Array, effective: float, khat: float, failed: int) -> Verdict:
    count = len(weights)
    said = (
        f"full model at {count} posterior draws: {effective:.1f} effective, at least "
        f"{EFFECTIVE_SHARE * count:g} needed; largest weight {weights.max():.2g}"
    )
    good = effective >= EFFECTIVE_SHARE * count
    if np.isfinite(khat):
        said += f"; Pareto k-hat {khat:.2f}, at most {KHAT_LIMIT:g} allowed"
        good = good and khat <= KHAT_LIMIT
    return Verdict(bool(good), (said + (f"; {failed} runs failed" if failed else ""),))
