"""Finds the most probable point by three kinds of global search in turn, each followed by a local polish.

Controlled random search (NLopt GN_CRS2_LM; Kaelo & Ali 2006, J. Optim. Theory Appl. 130:253), differential
evolution (Storn & Price 1997, J. Glob. Optim. 11:341, by SciPy) and Gauss-Newton from draws of the prior
(`gauss_newton`) share nothing but the density. Where they end at the same value, it is hardly a local one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import nlopt
import numpy as np
from scipy.optimize import differential_evolution

from bayeskin.errors import InputError
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.reparametrisation import Shear, find_shear
from bayeskin.types import Array

# NLopt 2.11 has its own base class of errors; earlier versions raise Python's errors.
_ERRORS = (nlopt.RoundoffLimited, getattr(nlopt, "exception", RuntimeError), RuntimeError, MemoryError)
_WORST = -1e30  # value of a point without a density, because NLopt needs finite values
_STATUS = {
    nlopt.SUCCESS: "converged",
    nlopt.STOPVAL_REACHED: "converged",
    nlopt.FTOL_REACHED: "converged",
    nlopt.XTOL_REACHED: "converged",
    nlopt.MAXEVAL_REACHED: "stopped at the evaluation limit",
    nlopt.MAXTIME_REACHED: "stopped at the time limit",
}


@dataclass(frozen=True)
class OptimiserSettings:
    """Settings of the search for the most probable point.

    agree : difference in log density [nats] up to which two starts have reached the same maximum, even where
        it is flat around
    levels : range of log amplitudes that is searched on either side of the recorded force's
    step : step of central differences in a unit coordinate
    steep : nats that the density falls per box width outside the prior
    climbs : number of Gauss-Newton climbs from the prior that make one start
    population : number of members of differential evolution for each parameter
    reached, settled : change in log density [nats] below which a global and a local search of NLopt end
    """

    agree: float = 0.1
    levels: float = 3.0
    step: float = 1e-6
    steep: float = 1e4
    climbs: int = 16
    population: int = 10
    reached: float = 1e-3
    settled: float = 1e-6


OPTIMISER = OptimiserSettings()


@dataclass(frozen=True)
class StartResult:
    """End of one start: SI values by name, log density, how the polish stopped, and evaluations spent.

    `search` names the global search before the polish. `evaluations` leaves out those inside Gauss-Newton.
    """

    theta: Mapping[str, float]
    value: float
    status: str
    evaluations: int
    search: str = ""


@dataclass(frozen=True)
class MapResult:
    """The best of all starts. `agreement` is the share of starts within 0.1 nats of it."""

    theta: Mapping[str, float]
    value: float
    starts: tuple[StartResult, ...]
    agreement: float

    @property
    def by_search(self) -> dict[str, float]:
        """Returns the best log density at which each kind of search ended."""
        kinds = dict.fromkeys(start.search for start in self.starts)
        return {kind: max(s.value for s in self.starts if s.search == kind) for kind in kinds}

    @property
    def message(self) -> str:
        """Returns a sentence that says whether to rely on the maximum, and what to do if not."""
        reached = [kind for kind, value in self.by_search.items() if value >= self.value - OPTIMISER.agree]
        summary = f"{round(self.agreement * len(self.starts))} of {len(self.starts)} starts reached it"
        summary += f", by {', '.join(reached)}"
        if len(reached) > 1 or self.agreement >= 0.5:
            return f"maximum of the log-posterior {self.value:.2f}: {summary}"
        return (
            f"maximum of the log-posterior {self.value:.2f}: only {summary}; allow more evaluations a start"
        )


def find_map(
    log_posterior: LogPosterior,
    seed: int,
    starts: int = 8,
    evaluations: int = 20000,
    progress: Callable[[float, str], None] | None = None,
) -> MapResult:
    """Returns the maximum of the posterior density in sampling coordinates.

    The starts use the kinds of `SEARCHES` in turn. Each search spends at most half of `evaluations`. The
    start then continues with Gauss-Newton, L-BFGS and Sbplx, in straightened coordinates
    (`reparametrisation`).
    Where the first starts of all kinds end at the same value, no further starts are made. A failure of NLopt
    becomes the start's status. NLopt draws from its own generator, which is seeded for each start. Raises
    InputError when there is no start to make.
    """
    if starts < 1 or evaluations < 4:
        raise InputError(
            "map",
            f"{starts} starts and {evaluations} evaluations are too few",
            "use at least 1 start and 4 evaluations",
        )
    space = SearchSpace(log_posterior)
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    results: list[StartResult] = []
    for index, state in enumerate(seeds):
        results.append(_one_start(space, list(SEARCHES)[index % len(SEARCHES)], int(state), evaluations))
        if progress:
            progress((index + 1) / starts, f"start {index + 1} of {starts}: {results[-1].value:.2f}")
        if index + 1 == len(SEARCHES) and np.ptp([r.value for r in results]) <= OPTIMISER.agree:
            break
    best = max(results, key=lambda r: r.value)
    agreement = float(np.mean([r.value >= best.value - OPTIMISER.agree for r in results]))
    return MapResult(best.theta, best.value, tuple(results), agreement)


def climb(
    log_posterior: LogPosterior,
    start: Mapping[str, float],
    evaluations: int = 4000,
    shear: Shear | None = None,
) -> StartResult:
    """Returns the local maximum near `start` (all parameters, SI; moved into the box if outside it).

    shear : the map that straightens this posterior, where it is already known
    """
    space = SearchSpace(log_posterior, shear)
    low, high = log_posterior.bounds
    search = Search(space)
    search.best = space.unit(np.clip(log_posterior.vector(start), low, high)[None])[0]
    status = "failed: no point with a density above zero"
    for algorithm in (nlopt.LD_LBFGS, nlopt.LN_SBPLX, nlopt.LD_LBFGS):
        status = search.run(algorithm, search.best, evaluations // 3, OPTIMISER.settled)
    theta = log_posterior.from_sampling(space.points(search.best[None])[0][0])
    return StartResult(log_posterior.named(theta), search.value, status, search.evaluations)


def _one_start(search_space: SearchSpace, kind: str, seed: int, evaluations: int) -> StartResult:
    search = Search(search_space)
    SEARCHES[kind](search, seed, evaluations // 2)
    log_posterior = search_space.log_posterior
    status = "failed: no point with a density above zero"
    if np.isfinite(search.value):
        reached = search_space.points(search.best[None])[0][0]
        search.offer(gauss_newton(log_posterior, reached, search_space.shear).vector)
        for algorithm in (nlopt.LD_LBFGS, nlopt.LN_SBPLX):
            status = search.run(algorithm, search.best, evaluations // 4, OPTIMISER.settled)
    theta = log_posterior.from_sampling(search_space.points(search.best[None])[0][0])
    return StartResult(log_posterior.named(theta), search.value, status, search.evaluations, kind)


def _controlled_random(search: Search, seed: int, evaluations: int) -> None:
    nlopt.srand(seed)
    unit = np.random.default_rng(seed).uniform(size=len(search.best))
    search.run(nlopt.GN_CRS2_LM, unit, evaluations, OPTIMISER.reached)


def _evolution(search: Search, seed: int, evaluations: int) -> None:
    dim = len(search.best)
    generations = max(evaluations // (OPTIMISER.population * dim) - 1, 1)
    differential_evolution(
        lambda columns: -search.offer_unit(columns.T), [(0.0, 1.0)] * dim, maxiter=generations,
        popsize=OPTIMISER.population, tol=0.0, atol=OPTIMISER.agree, polish=False, updating="deferred",
        vectorized=True, seed=np.random.default_rng(seed),
    )  # fmt: skip


def _climbs(search: Search, seed: int, evaluations: int) -> None:
    log_posterior, shear = search.space.log_posterior, search.space.shear
    low, high = log_posterior.bounds
    for start in np.random.default_rng(seed).uniform(low, high, (OPTIMISER.climbs, len(low))):
        search.offer(gauss_newton(log_posterior, start, shear).vector)


class SearchSpace:
    """The unit cube over straightened coordinates; the density is continued outside the prior box."""

    def __init__(self, log_posterior: LogPosterior, shear: Shear | None = None) -> None:
        self.log_posterior, self.shear = log_posterior, shear or find_shear(log_posterior)
        self.low, self.high = (np.array(bound) for bound in log_posterior.bounds)
        if self.shear is not None:
            group = self.shear.group
            level = (self.low[group].mean(), self.high[group].mean())
            self.low[group], self.high[group] = self.low[group] - level[1], self.high[group] - level[0]
            first = int(np.argmax(group))
            self.low[first], self.high[first] = -OPTIMISER.levels, OPTIMISER.levels

    def points(self, unit: Array) -> tuple[Array, Array]:
        """Returns sampling coordinates (n, D) moved into the prior box, and by how many box widths (n,)."""
        x = self.low + unit * (self.high - self.low)
        if self.shear is not None:
            x = self.shear.back(x)
        low, high = self.log_posterior.bounds
        inside = np.clip(x, low, high)
        return inside, np.linalg.norm((x - inside) / (high - low), axis=1)

    def unit(self, x: Array) -> Array:
        """Returns the unit-cube coordinates (n, D) of sampling coordinates (n, D)."""
        straight = x if self.shear is None else self.shear.straight(x)
        return np.clip((straight - self.low) / (self.high - self.low), 0.0, 1.0)

    def values(self, unit: Array) -> Array:
        """Returns log densities (n,), always finite; outside the prior box a steep cone is subtracted."""
        inside, outside = self.points(unit)
        return np.maximum(self.log_posterior.log_prob(inside) - OPTIMISER.steep * outside, _WORST)


class Search:
    """The objective on the unit cube; it keeps the best point so far, which NLopt drops when it fails."""

    def __init__(self, space: SearchSpace) -> None:
        self.space = space
        self.best = np.full(len(space.low), 0.5)
        self.value = -np.inf
        self.evaluations = 0

    def __call__(self, unit: Array, gradient: Array) -> float:
        trials = unit[None]
        if gradient.size:
            step = OPTIMISER.step * np.eye(len(unit))
            trials = np.concatenate([trials, unit + step, unit - step])
        values = self.space.values(trials)
        self.evaluations += len(trials)
        if gradient.size:
            up, down = values[1:].reshape(2, -1)
            gradient[:] = (up - down) / (2 * OPTIMISER.step)
        if values[0] > max(self.value, _WORST):
            self.best, self.value = np.array(unit), float(values[0])
        return float(values[0])

    def offer(self, x: Array) -> None:
        """Evaluates a point (D,) in sampling coordinates from another method, and keeps it if it is best."""
        self.offer_unit(self.space.unit(x[None]))

    def offer_unit(self, unit: Array) -> Array:
        """Returns log densities (n,) at points (n, D) of the unit cube, and keeps the best point."""
        values = self.space.values(unit)
        self.evaluations += len(unit)
        best = int(np.argmax(values))
        if values[best] > max(self.value, _WORST):
            self.best, self.value = np.array(unit[best]), float(values[best])
        return values

    def run(self, algorithm: int, start: Array, evaluations: int, tolerance: float) -> str:
        opt = nlopt.opt(algorithm, len(start))
        opt.set_max_objective(self)
        opt.set_lower_bounds(np.zeros(len(start)))
        opt.set_upper_bounds(np.ones(len(start)))
        each = 2 * len(start) + 1 if algorithm == nlopt.LD_LBFGS else 1
        opt.set_maxeval(max(evaluations // each, 1))
        opt.set_ftol_abs(tolerance)
        try:
            opt.optimize(np.clip(start, 0.0, 1.0))
        except _ERRORS as error:
            return f"failed: {str(error) or type(error).__name__}"
        return _STATUS.get(opt.last_optimize_result(), "stopped")


SEARCHES: dict[str, Callable[[Search, int, int], None]] = {
    "controlled random search": _controlled_random,
    "differential evolution": _evolution,
    "Gauss-Newton from the prior": _climbs,
}
