"""The most probable point: a global search from many seeds, each polished locally."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import nlopt
import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference.problem import LogPosterior
from bayeskin.types import Array

_AGREE = 0.1  # nats: starts this close to the best found the same maximum, whatever stays flat around it
_WORST = -1e300  # of a point without a density; NLopt asks for finite values
_STATUS = {
    nlopt.SUCCESS: "converged",
    nlopt.STOPVAL_REACHED: "converged",
    nlopt.FTOL_REACHED: "converged",
    nlopt.XTOL_REACHED: "converged",
    nlopt.MAXEVAL_REACHED: "stopped at the evaluation limit",
    nlopt.MAXTIME_REACHED: "stopped at the time limit",
    nlopt.ROUNDOFF_LIMITED: "limited by rounding",
}


@dataclass(frozen=True)
class StartResult:
    """Where one start ended: SI values by name, log density, how the polish stopped, evaluations spent."""

    theta: Mapping[str, float]
    value: float
    status: str
    evaluations: int


@dataclass(frozen=True)
class MapResult:
    """The best of all starts. `agreement` is the share of starts within 0.1 nats of it."""

    theta: Mapping[str, float]
    value: float
    starts: tuple[StartResult, ...]
    agreement: float

    @property
    def message(self) -> str:
        """One sentence: whether to rely on the maximum, and the remedy if not."""
        found = f"{round(self.agreement * len(self.starts))} of {len(self.starts)} starts reached it"
        if self.agreement >= 0.5:
            return f"maximum of log posterior {self.value:.2f}: {found}"
        return f"maximum of log posterior {self.value:.2f}: only {found}; allow more evaluations a start"


def find_map(
    log_posterior: LogPosterior,
    seed: int,
    starts: int = 8,
    evaluations: int = 20000,
    progress: Callable[[float, str], None] | None = None,
) -> MapResult:
    """Maximum of the posterior density in sampling coordinates.

    Each start runs controlled random search (NLopt GN_CRS2_LM; Kaelo & Ali 2006) on at most half of
    `evaluations`, then BOBYQA and Sbplx from there. NLopt's failures become a start's status. The
    search draws from NLopt's own generator, which is seeded here for each start. Raises InputError
    when there is no start to make.
    """
    if starts < 1 or evaluations < 4:
        raise InputError("map", f"{starts} starts, {evaluations} evaluations", "at least 1 start of 4")
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    results: list[StartResult] = []
    for index, state in enumerate(seeds):
        results.append(_one_start(log_posterior, int(state), evaluations))
        if progress:
            progress((index + 1) / starts, f"start {index + 1} of {starts}: {results[-1].value:.2f}")
    best = max(results, key=lambda r: r.value)
    agreement = float(np.mean([r.value >= best.value - _AGREE for r in results]))
    return MapResult(best.theta, best.value, tuple(results), agreement)


def _one_start(log_posterior: LogPosterior, seed: int, evaluations: int) -> StartResult:
    nlopt.srand(seed)
    unit = np.random.default_rng(seed).uniform(size=log_posterior.dim)
    search = _Search(log_posterior)
    status = search.run(nlopt.GN_CRS2_LM, unit, evaluations // 2, 1e-4)
    for algorithm in (nlopt.LN_BOBYQA, nlopt.LN_SBPLX):
        status = search.run(algorithm, search.best, evaluations // 4, 1e-9)
    low, high = log_posterior.bounds
    theta = log_posterior.from_sampling(low + search.best * (high - low))
    return StartResult(log_posterior.named(theta), search.value, status, search.evaluations)


class _Search:
    """The objective on the unit cube, with the best point seen: NLopt drops it when it fails."""

    def __init__(self, log_posterior: LogPosterior) -> None:
        self.log_posterior = log_posterior
        self.best = np.full(log_posterior.dim, 0.5)
        self.value = -np.inf
        self.evaluations = 0

    def __call__(self, unit: Array, _gradient: Array) -> float:
        low, high = self.log_posterior.bounds
        value = float(self.log_posterior.log_prob((low + unit * (high - low))[None])[0])
        self.evaluations += 1
        if value > self.value:
            self.best, self.value = np.array(unit), value
        return max(value, _WORST)

    def run(self, algorithm: int, start: Array, evaluations: int, tolerance: float) -> str:
        opt = nlopt.opt(algorithm, len(start))
        opt.set_max_objective(self)
        opt.set_lower_bounds(np.zeros(len(start)))
        opt.set_upper_bounds(np.ones(len(start)))
        opt.set_maxeval(max(evaluations, 1))
        opt.set_ftol_abs(tolerance)
        try:
            opt.optimize(np.clip(start, 0.0, 1.0))
        except nlopt.RoundoffLimited:
            return _STATUS[nlopt.ROUNDOFF_LIMITED]
        except (RuntimeError, ValueError, MemoryError) as error:  # all that NLopt raises of its own
            return f"failed: {str(error) or type(error).__name__}"
        return _STATUS.get(opt.last_optimize_result(), "stopped")
