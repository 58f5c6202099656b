"""Judges whether a posterior can be trusted: autocorrelation, effective samples, R-hat across ensembles.

The walkers of one ensemble are coupled, so a single walker does not count as a chain. The autocorrelation
time of an ensemble comes from the mean autocorrelation of its walkers (Goodman & Weare 2010). R-hat compares
the ensembles, which have the target density and the proposals in common. Each half of each ensemble's run is
one chain of nearly independent draws: its walkers are pooled and thinned by the autocorrelation time. R-hat
is rank-normalised, and the larger of bulk and folded (Vehtari et al. 2021, Bayesian Analysis 16:667).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import emcee
import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from bayeskin.types import Array, FreezesArrays


@dataclass(frozen=True)
class ConvergenceSettings:
    """Settings with which the convergence of chains is measured.

    resolved : number of samples of a series from which its autocorrelation time is computed
    burn_in_lengths : number of autocorrelation times after which the start is forgotten
    rarely : a walker is stuck if it moves less often than this share of its ensemble's median
    below : a walker is also stuck if its log density is this many robust sd below its ensemble's median
    """

    resolved: int = 2000
    burn_in_lengths: int = 10
    rarely: float = 0.1
    below: float = 5.0


@dataclass(frozen=True)
class Limits:
    """Criteria that a posterior must meet to be called trusted; `rhat` is the largest R-hat allowed."""

    effective_samples: float = 5000.0  # the total of the parameter that has fewest
    lengths: float = 50.0  # length of each ensemble's run after burn-in, in autocorrelation times
    rhat: float = 1.01


@dataclass(frozen=True)
class Verdict:
    """Says whether a posterior is trusted, and states each criterion with its number; failed ones first."""

    trusted: bool
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Convergence(FreezesArrays):
    """Convergence of a run of E ensembles: tau_steps (E, D); ess, rhat (D,); acceptance (E,).

    `stuck` lists (ensemble, walker). A parameter that does not move has NaN in tau_steps, ess and rhat.
    """

    steps: int
    burn_in: int
    thin: int
    tau_steps: Array
    ess: Array
    rhat: Array
    acceptance: Array
    stuck: tuple[tuple[int, int], ...]
    verdict: Verdict

    def progress(self, limits: Limits) -> float:
        """Returns the share of the way to the limits that is done, between 0 and 1."""
        kept = self.steps - self.burn_in
        parts = (_lowest(self.ess) / limits.effective_samples, kept / (limits.lengths * self._tau))
        return float(np.clip(np.nan_to_num(min(parts)), 0.0, 1.0))

    @property
    def _tau(self) -> float:
        return _highest(self.tau_steps)


def assess(
    chains: Array, log_prob: Array, names: tuple[str, ...], limits: Limits, settled: int = 0,
    settings: ConvergenceSettings = ConvergenceSettings(),
) -> Convergence:  # fmt: skip
    """Returns the convergence of chains (E, n, W, D) in sampling coordinates with log densities (E, n, W).

    The first `settled` steps always count as burn-in. After them nothing interferes with the chains.
    """
    steps = chains.shape[1]
    # Only the second half is used, because a start that is not yet forgotten would lengthen the time.
    late = _highest(autocorrelation_steps(chains[:, steps // 2 :], settings))
    forgotten = math.ceil(settings.burn_in_lengths * late) if np.isfinite(late) else steps
    burn_in = max(min(forgotten, steps // 2), settled)
    kept = chains[:, burn_in:]
    tau = autocorrelation_steps(kept, settings)
    longest = _highest(tau)
    thin = int(min(max(1, math.ceil(longest)), kept.shape[1])) if np.isfinite(longest) else 1
    ess = np.sum(kept.shape[1] * kept.shape[2] / tau, axis=0)
    thinned = kept[:, ::thin]
    rhat = np.array([split_rhat(thinned[..., j].reshape(len(chains), -1)) for j in range(chains.shape[3])])
    moved = np.any(np.diff(kept, axis=1) != 0.0, axis=3).mean(axis=1)
    stuck = _stuck_walkers(moved, log_prob[:, burn_in:], settings)
    verdict = _verdict(kept.shape[1], tau, ess, rhat, stuck, names, limits)
    return Convergence(steps, burn_in, thin, tau, ess, rhat, moved.mean(axis=1), stuck, verdict)


def autocorrelation_steps(chains: Array, settings: ConvergenceSettings = ConvergenceSettings()) -> Array:
    """Returns the integrated autocorrelation time (E, D) [steps] of chains (E, n, W, D).

    It is NaN where nothing moves. A walker that never moves in a coordinate has no autocorrelation there and
    is left out. `_stuck_walkers` reports the walkers that move in no coordinate.
    """
    every = max(1, chains.shape[1] // settings.resolved)
    times = np.full((len(chains), chains.shape[3]), np.nan)
    for e, chain in enumerate(chains[:, ::every]):
        moving = np.any(chain != chain[0], axis=0)
        for j in np.flatnonzero(moving.any(axis=0)):
            with np.errstate(invalid="ignore", divide="ignore"):
                times[e, j] = every * emcee.autocorr.integrated_time(chain[:, moving[:, j], j], tol=0)[0]
    return np.maximum(times, 1.0)


def split_rhat(draws: Array) -> float:
    """Returns the rank-normalised split R-hat of draws (chains, n): the larger of bulk and folded.

    It is NaN where the draws are constant or fewer than four a chain.
    """
    half = draws.shape[1] // 2
    if half < 2 or np.ptp(draws) == 0.0:
        return math.nan
    halves = np.concatenate([draws[:, :half], draws[:, -half:]])
    folded = np.abs(halves - np.median(halves))
    return max(_rhat(_rank_normal(halves)), _rhat(_rank_normal(folded)))


def _rank_normal(draws: Array) -> Array:
    ranks = rankdata(draws, axis=None).reshape(draws.shape)
    return ndtri((ranks - 0.375) / (draws.size + 0.25))


def _rhat(draws: Array) -> float:
    n = draws.shape[1]
    within = draws.var(axis=1, ddof=1).mean()
    between = draws.mean(axis=1).var(ddof=1)
    return math.sqrt((n - 1) / n + between / within) if within > 0 else math.inf


def _stuck_walkers(
    moved: Array, log_prob: Array, settings: ConvergenceSettings
) -> tuple[tuple[int, int], ...]:
    rarely = moved <= settings.rarely * np.median(moved, axis=1, keepdims=True)
    level = np.median(log_prob, axis=1)
    centre = np.median(log_prob, axis=(1, 2))[:, None]
    spread = 1.4826 * np.median(np.abs(log_prob - centre[:, None]), axis=(1, 2))[:, None]
    low = level < centre - settings.below * np.maximum(spread, 1e-9)
    return tuple((int(e), int(w)) for e, w in np.argwhere(rarely | low))


def _verdict(
    kept: int, tau: Array, ess: Array, rhat: Array, stuck: tuple[tuple[int, int], ...],
    names: tuple[str, ...], limits: Limits,
) -> Verdict:  # fmt: skip
    longest, fewest, worst = _highest(tau), _lowest(ess), _highest(rhat)
    lengths = kept / longest
    checks = [
        (
            lengths >= limits.lengths,
            f"the run of {kept} steps has {lengths:.0f} autocorrelation lengths "
            f"({_extreme(names, tau.max(axis=0), 'max')}: {longest:.0f} steps); "
            f"{limits.lengths:.0f} are needed",
        ),
        (
            fewest >= limits.effective_samples,
            f"{fewest:.0f} effective samples of {_extreme(names, ess, 'min')}; "
            f"{limits.effective_samples:.0f} are needed",
        ),
        (
            worst <= limits.rhat,
            f"R-hat across {len(tau)} ensembles is {worst:.4f} for {_extreme(names, rhat, 'max')}; "
            f"at most {limits.rhat:g} is allowed",
        ),
        (
            not stuck,
            f"{len(stuck)} stuck {'walker' if len(stuck) == 1 else 'walkers'}"
            + "".join(f", ensemble {e} walker {w}" for e, w in stuck[:3])
            + "; none is allowed",
        ),
    ]
    if len(tau) < 2:
        checks.append((False, "there is only one ensemble; at least 2 independent ones are needed"))
    checks.sort(key=lambda check: bool(check[0]))
    return Verdict(all(bool(ok) for ok, _ in checks), tuple(text for _, text in checks))


def _extreme(names: tuple[str, ...], values: Array, which: str) -> str:
    if np.isnan(values).any():
        return names[int(np.flatnonzero(np.isnan(values))[0])]
    return names[int(np.argmax(values) if which == "max" else np.argmin(values))]


def _highest(values: Array) -> float:
    return math.nan if np.isnan(values).any() else float(np.max(values))


def _lowest(values: Array) -> float:
    return math.nan if np.isnan(values).any() else float(np.min(values))
