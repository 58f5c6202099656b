"""Draws from the posterior by independent ensembles.

The ensembles continue after an interruption, and stop by themselves once their draws can be trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference import chains as chain_files
from bayeskin.inference.convergence import Convergence, Limits, assess
from bayeskin.inference.ensembles import adapt_proposals, advance_all, ensembles
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.schedule import SCHEDULE
from bayeskin.types import Array, FreezesArrays, ParameterSpace

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SampleSettings:
    """Size of a run and when it stops.

    ensembles, walkers : number of independent ensembles, and number of walkers in each
    max_steps : largest number of steps
    limits : criteria that end the run earlier
    """

    ensembles: int = 4
    walkers: int = 40
    max_steps: int = 20000
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class Posterior(FreezesArrays):
    """Draws after burn-in, thinned by the autocorrelation time, so that each is worth about one sample.

    draws (E, n, D) are in SI with the columns of `space`. Steps are in order, with an ensemble's walkers side
    by side. log_prob is (E, n). `convergence.verdict` says whether to trust the draws.
    """

    space: ParameterSpace
    draws: Array
    log_prob: Array
    convergence: Convergence
    seed: int

    @property
    def flat(self) -> Array:
        """Returns all draws, (E n, D)."""
        return self.draws.reshape(-1, self.draws.shape[-1])


def sample(
    log_posterior: LogPosterior,
    folder: Path | str,
    seed: int,
    start: Mapping[str, float],
    settings: SampleSettings = SampleSettings(),
    progress: Progress | None = None,
    threads: int = 1,
) -> Posterior:
    """Runs ensembles from around `start` (the MAP, SI by name) until they can be trusted, or to max_steps.

    The first steps draw from powers of the posterior, from low powers to the full posterior. The proposals of
    the moves are fitted to these draws. From then on all ensembles propose from one distribution, so that
    R-hat compares what they have made of it.

    `folder` keeps one file for each ensemble, ``ensemble_0.h5`` ..., in emcee's own HDF5 form with its random
    state. Each file is replaced as a whole after every stretch of steps. An interrupted run continues from
    these files and gives the same draws as an uninterrupted run. The draws do not depend on the number of
    `threads`, over which the ensembles are spread. Raises InputError for fewer than 500 steps, and when the
    files belong to another posterior, seed or number of walkers; these files are not changed.
    """
    _check_settings(settings, log_posterior.dim)
    files = _files(folder, settings.ensembles)
    identity = {**log_posterior.identity, "seed": str(seed), "walkers": str(settings.walkers)}
    backends = [chain_files.load(f, log_posterior.names, identity) if f.exists() else None for f in files]
    runs = ensembles(log_posterior, log_posterior.vector(start), seed, settings.walkers, backends)
    convergence: Convergence | None = None
    settled = 0
    for goal, judged in SCHEDULE.checkpoints(settings.max_steps):
        with closing(advance_all(runs, goal, threads)) as advanced:
            for e, at in advanced:
                if at < goal:
                    text = f"ensemble {e + 1} of {len(runs)}, step {at} of {goal}"
                    _report_progress(progress, convergence, settings, text)
                elif runs[e].changed:
                    chain_files.save(files[e], runs[e].backend, log_posterior.names, identity)
                    runs[e].changed = False
        chains = np.stack([r.backend.chain[:goal] for r in runs])
        log_prob = np.stack([r.backend.log_prob[:goal] for r in runs])
        if judged:
            convergence = assess(chains, log_prob, log_posterior.names, settings.limits, settled)
            _report_progress(progress, convergence, settings, convergence.verdict.reasons[0])
            if convergence.verdict.trusted:
                break
        if SCHEDULE.is_lesson(goal):
            late = chains[:, int(SCHEDULE.late * goal) :]
            adapt_proposals(runs, late, log_posterior, np.random.default_rng([seed, goal]))
            settled = goal
    assert convergence is not None
    return _posterior(log_posterior, chains, log_prob, convergence, seed)


def load_chains(folder: Path | str, log_posterior: LogPosterior, ensembles: int) -> Array:
    """Returns whole chains (E, n, W, D) in SI of the first ensembles that `sample` left in `folder`.

    They are cut to the length of the shortest chain. Raises InputError where a chain is missing or belongs to
    another posterior.
    """
    files = _files(folder, ensembles)
    parts = [chain_files.load(f, log_posterior.names, log_posterior.identity).chain for f in files]
    steps = min(len(p) for p in parts)
    return log_posterior.from_sampling(np.stack([p[:steps] for p in parts]))


def _files(folder: Path | str, ensembles: int) -> list[Path]:
    return [Path(folder) / f"ensemble_{e}.h5" for e in range(ensembles)]


def evenly(draws: Array, count: int) -> Array:
    """Returns at most `count` of draws (n, D), spread evenly over all of them."""
    return draws[np.linspace(0, len(draws) - 1, min(count, len(draws))).astype(int)]


def _check_settings(settings: SampleSettings, dim: int) -> None:
    if settings.walkers < 2 * dim + 2:
        raise InputError(
            "sample.walkers",
            f"{settings.walkers} walkers are too few",
            f"use at least {2 * dim + 2}, which is twice the {dim} parameters plus 2",
        )
    if settings.ensembles < 1:
        raise InputError("sample.ensembles", f"it is {settings.ensembles}", "it must be at least 1")
    if settings.max_steps < SCHEDULE.first_check:
        raise InputError(
            "sample.max_steps", f"{settings.max_steps} steps are too few",
            f"use at least {SCHEDULE.first_check}, because the first steps do not yet follow the posterior",
        )  # fmt: skip


def _report_progress(
    progress: Progress | None, state: Convergence | None, settings: SampleSettings, text: str
) -> None:
    if progress:
        progress(state.progress(settings.limits) if state else 0.0, text)


def _posterior(
    log_posterior: LogPosterior, chains: Array, log_prob: Array, convergence: Convergence, seed: int
) -> Posterior:
    kept = slice(convergence.burn_in, None, convergence.thin)
    ensembles, _, _, dim = chains.shape
    return Posterior(
        space=log_posterior.space,
        draws=log_posterior.from_sampling(chains[:, kept].reshape(ensembles, -1, dim)),
        log_prob=log_prob[:, kept].reshape(ensembles, -1),
        convergence=convergence,
        seed=seed,
    )
