"""Tests whether the residuals of a fit are the noise that the likelihood assumes.

The surrogate's most probable error is first subtracted. At a good point, the innovations of `noise_model` are
then independent draws from the noise's t-distribution. This distribution transforms them to standard normal
scores (z with Phi(z) = T_nu(eps)), so that the scores are the same for tails of any weight. The scores are
tested for
- their distribution: Kolmogorov & Smirnov,
- their correlation over ten bins: Ljung & Box (1978), Biometrika 65:297, about the assumed mean of zero,
- in each kind of phase their sd, which should be 1, and the correlation of neighbours, which should be 0.
The parameters were fitted to the same bins, which makes the tests lenient, never strict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from bayeskin.inference.noise_model import innovations
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.surrogate_error import surrogate_error
from bayeskin.number_format import number
from bayeskin.types import Array, FreezesArrays


@dataclass(frozen=True)
class ResidualSettings:
    """Settings of the tests of residuals.

    lags : number of bins over which the correlation is tested
    family_wise : probability that noise as assumed fails any of the tests
    fewest : smallest number of pairs of neighbouring bins with which a kind of phase is tested by itself
    smallest : smallest tail probability, whose score is still a finite number: 37 sd
    """

    lags: int = 10
    family_wise: float = 0.01
    fewest: int = 8
    smallest: float = 1e-300


RESIDUALS = ResidualSettings()


@dataclass(frozen=True)
class KindCheck:
    """Tests of the scores in one kind of phase: number of bins, sd, correlation of neighbours, and p-values.

    The sd, the correlation and their p-values are NaN where there are too few bins.
    """

    kind: str
    bins: int
    sd: float
    p_sd: float
    correlation: float
    p_correlation: float


@dataclass(frozen=True)
class ResidualCheck(FreezesArrays):
    """Residuals of a fit as scores (k,) of the fitted bins, standard normal if the noise is as assumed.

    autocorrelation (l,) is over 1 to l bins. p_law is the p-value of Kolmogorov & Smirnov, and p_correlation
    that of Ljung & Box.
    """

    scores: Array
    autocorrelation: Array
    p_law: float
    p_correlation: float
    kinds: tuple[KindCheck, ...]

    @property
    def limit(self) -> float:
        """Returns the p-value below which a single test fails, so that all together keep `family_wise`."""
        return RESIDUALS.family_wise / (2 + 2 * len(self.kinds))

    @property
    def passes(self) -> bool:
        return not self.failures

    @property
    def failures(self) -> tuple[str, ...]:
        """Returns how the residual differs from the assumed noise, one entry for each test that fails."""
        out = []
        lags, limit = len(self.autocorrelation), self.limit
        if self.p_law < limit:
            out.append(f"it has a different distribution (Kolmogorov-Smirnov p = {number(self.p_law, 2)})")
        if self.p_correlation < limit:
            p = number(self.p_correlation, 2)
            out.append(f"it has a different correlation (Ljung-Box over {lags} lags p = {p})")
        for check in self.kinds:
            when = f"while pads {check.kind}"
            if check.p_sd < limit:
                times, p = number(check.sd, 2), number(check.p_sd, 2)
                out.append(f"{when} its sd is {times} times the assumed sd (p = {p})")
            if check.p_correlation < limit:
                r, p = number(check.correlation, 2, sign=True), number(check.p_correlation, 2)
                out.append(f"{when} the correlation of neighbours differs by {r} (p = {p})")
        return tuple(out)

    @property
    def outcome(self) -> str:
        """Returns whether the residual passes, in words without a full stop."""
        return f"The residual {'looks like' if self.passes else 'is not'} the assumed noise"

    @property
    def sentence(self) -> str:
        """Returns the outcome with its reasons, as one sentence."""
        if not self.passes:
            return f"{self.outcome}: {'; '.join(self.failures)}."
        return (
            f"{self.outcome}: in its distribution (Kolmogorov-Smirnov p = {number(self.p_law, 2)}), in its "
            f"correlation (Ljung-Box over {len(self.autocorrelation)} lags "
            f"p = {number(self.p_correlation, 2)}) and in each kind of phase."
        )


def check_residuals(log_posterior: LogPosterior, vector: Array) -> ResidualCheck:
    """Returns tests of the residuals at sampling coordinates (D,) against the noise assumed there."""
    chain, theta = log_posterior.chain, log_posterior.from_sampling(vector)[None]
    prediction, noise = log_posterior.predict(theta), log_posterior.split(theta)[1][0]
    residual = chain.force_n - prediction.mean[0, chain.bins]
    columns = np.column_stack([residual, prediction.factor[0, chain.bins]])
    white = innovations(chain, noise, prediction.diagonal[0, chain.bins], columns)
    whitened, factor, nu = white[:, 0], white[:, 1:], float(noise[-1])
    scores = normal_scores(whitened - factor @ surrogate_error(whitened, factor, nu), nu)
    follows = ~chain.starts[1:] & (chain.kind[1:] == chain.kind[:-1])
    kinds = []
    for i, kind in enumerate(chain.kinds):
        later = 1 + np.flatnonzero(follows & (chain.kind[1:] == i))
        kinds.append(_check_kind(kind, scores[chain.kind == i], scores[later - 1], scores[later]))
    correlation = autocorrelation(scores, min(RESIDUALS.lags, len(scores) - 1))
    p_law = float(stats.kstest(scores, "norm").pvalue)
    return ResidualCheck(scores, correlation, p_law, _ljung_box(correlation, len(scores)), tuple(kinds))


def normal_scores(innovation: Array, nu: float) -> Array:
    """Returns standard normal scores (k,) of draws (k,) of Student's t with `nu` degrees of freedom.

    nu may be inf.
    """
    tail = np.maximum(stats.t.sf(np.abs(innovation), nu), RESIDUALS.smallest)
    return np.asarray(np.sign(innovation) * stats.norm.isf(tail))


def autocorrelation(scores: Array, lags: int) -> Array:
    """Returns the autocorrelation (lags,) of scores (k,) about zero."""
    k = len(scores)
    return np.array([scores[lag:] @ scores[: k - lag] for lag in range(1, lags + 1)]) / (scores @ scores)


def _ljung_box(correlation: Array, count: int) -> float:
    lag = np.arange(1, len(correlation) + 1)
    return float(stats.chi2.sf(count * (count + 2) * np.sum(correlation**2 / (count - lag)), len(lag)))


def _check_kind(kind: str, scores: Array, before: Array, after: Array) -> KindCheck:
    """Returns the tests of one kind of phase, from its scores (k,).

    before, after (p,) : the pairs of neighbours among these scores
    """
    if len(after) < RESIDUALS.fewest:
        return KindCheck(kind, len(scores), math.nan, math.nan, math.nan, math.nan)
    square = float(scores @ scores)
    p_sd = 2.0 * min(stats.chi2.cdf(square, len(scores)), stats.chi2.sf(square, len(scores)))
    correlation = float(before @ after / np.sqrt((before @ before) * (after @ after)))
    p_correlation = 2.0 * stats.norm.sf(abs(correlation) * math.sqrt(len(after)))
    return KindCheck(
        kind, len(scores), math.sqrt(square / len(scores)), float(p_sd), correlation, float(p_correlation)
    )
