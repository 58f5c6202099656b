"""Draws from the posterior by independent ensembles.

The ensembles continue after an interruption, and stop by themselves once their draws can be trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from threading import Event

import emcee
import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference import chains as store
from bayeskin.inference.convergence import Convergence, Limits, assess
from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.moves import mixed_moves
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.proposal import Product
from bayeskin.inference.reparametrisation import find_shear
from bayeskin.types import Array, ParameterSpace, _FreezesArrays

_FIRST_CHECK, _BETWEEN = 500, 250
# At these steps the proposals of the moves are fitted to the draws so far. Until then the draws come from the
# given power of the density. At low powers, separate parts of the posterior are still connected. The last fit
# is at the power 0.7, which makes the proposals wider than the posterior: tails that a proposal lacks would
# hardly be visited. All steps before the last fit are burn-in.
_LESSONS = {
    30: 0.1, 60: 0.1, 90: 0.2, 120: 0.2, 150: 0.35, 180: 0.35, 210: 0.5, 240: 0.5, 270: 0.7, 300: 0.7,
}  # fmt: skip
_LATE = 0.4  # share of the steps so far that such a fit leaves out
_POINTS = 16000  # largest number of draws for such a fit
_REFRESH = 100  # steps between two reports of progress
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SampleSettings:
    """Number of independent ensembles, number of walkers in each, and when to stop."""

    ensembles: int = 4
    walkers: int = 40
    max_steps: int = 20000
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class Posterior(_FreezesArrays):
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
    settings: SampleSettings | None = None,
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
    settings = settings or SampleSettings()
    _check_settings(settings, log_posterior.dim)
    files = _files(folder, settings.ensembles)
    identity = {**log_posterior.identity, "seed": str(seed), "walkers": str(settings.walkers)}
    backends = [store.load(f, log_posterior.names, identity) if f.exists() else None for f in files]
    runs = _ensembles(log_posterior, log_posterior.vector(start), seed, settings.walkers, backends)
    convergence: Convergence | None = None
    settled = 0
    for goal, judged in _checkpoints(settings.max_steps):
        with closing(_advance_all(runs, goal, threads)) as advanced:
            for e, at in advanced:
                if at < goal:
                    text = f"ensemble {e + 1} of {len(runs)}, step {at} of {goal}"
                    _report_progress(progress, convergence, settings, text)
                elif runs[e].changed:
                    store.save(files[e], runs[e].backend, log_posterior.names, identity)
                    runs[e].changed = False
        chains = np.stack([r.backend.chain[:goal] for r in runs])
        log_prob = np.stack([r.backend.log_prob[:goal] for r in runs])
        if judged:
            convergence = assess(chains, log_prob, log_posterior.names, settings.limits, settled)
            _report_progress(progress, convergence, settings, convergence.verdict.reasons[0])
            if convergence.verdict.trusted:
                break
        if goal in _LESSONS:
            _adapt_proposals(
                runs, chains[:, int(_LATE * goal) :], log_posterior, np.random.default_rng([seed, goal])
            )
            settled = goal
    assert convergence is not None
    return _posterior(log_posterior, chains, log_prob, convergence, seed)


def _adapt_proposals(
    runs: Sequence[_Ensemble], chains: Array, log_posterior: LogPosterior, rng: np.random.Generator
) -> None:
    """Lets the ensembles propose from one distribution, fitted to the draws (E, n, W, D) of all ensembles.

    The parameters of the model and of the noise have separate mixtures, since they hardly depend on each
    other.
    """
    draws = chains[:, :: -(-chains[..., 0].size // _POINTS)].reshape(-1, log_posterior.dim)
    model = log_posterior.surrogate.space.dim
    blocks = (slice(0, model), slice(model, log_posterior.dim))
    known = Product.of(runs[0].coordinates.forward(draws), blocks, rng)
    for run in runs:
        run.propose_from(known)


def load_chains(folder: Path | str, log_posterior: LogPosterior, ensembles: int) -> Array:
    """Returns whole chains (E, n, W, D) in SI of the first ensembles that `sample` left in `folder`.

    They are cut to the length of the shortest chain. Raises InputError where a chain is missing or belongs to
    another posterior.
    """
    files = _files(folder, ensembles)
    parts = [store.load(f, log_posterior.names, log_posterior.identity).chain for f in files]
    steps = min(len(p) for p in parts)
    return log_posterior.from_sampling(np.stack([p[:steps] for p in parts]))


def _files(folder: Path | str, ensembles: int) -> list[Path]:
    return [Path(folder) / f"ensemble_{e}.h5" for e in range(ensembles)]


def evenly(draws: Array, count: int) -> Array:
    """Returns at most `count` of draws (n, D), spread evenly over all of them."""
    return draws[np.linspace(0, len(draws) - 1, min(count, len(draws))).astype(int)]


def _advance_all(
    runs: Sequence[_Ensemble], goal: int, threads: int
) -> Generator[tuple[int, int], None, None]:
    """Brings all ensembles to step `goal`; yields (ensemble, step) now and then, and at the goal."""
    updates: SimpleQueue[tuple[int, int]] = SimpleQueue()
    stop = Event()

    def advance(e: int) -> None:
        try:
            for at in runs[e].advance(goal):
                if stop.is_set():
                    return
                updates.put((e, at))
        finally:
            updates.put((e, goal))

    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(advance, e) for e in range(len(runs))]
        try:
            for _ in runs:
                while (step := updates.get())[1] < goal:
                    yield step
                futures[step[0]].result()
                yield step
        finally:  # after an interruption or an error, the other ensembles end at their next report
            stop.set()


class _Ensemble:
    """One ensemble and its chain in memory."""

    def __init__(
        self,
        log_posterior: LogPosterior,
        coordinates: MoveCoordinates,
        backend: emcee.backends.Backend,
        state: emcee.State,
    ) -> None:
        self.changed = False
        self.coordinates = coordinates
        self.backend = backend
        self.state = state
        self._log_prob = log_posterior.log_prob
        self.propose_from(None)

    def propose_from(self, known: Product | None) -> None:
        """Sets the distribution from which the moves of further steps propose points."""
        self._moves = mixed_moves(self.coordinates, self.backend.nwalkers, known)

    def advance(self, goal: int) -> Iterator[int]:
        """Runs the steps up to `goal` that are still to be done; yields the step now and then."""
        first = self.backend.iteration
        power = next((power for at, power in _LESSONS.items() if at >= goal), 1.0)
        if first >= goal:
            return
        self.changed = True
        sampler = emcee.EnsembleSampler(
            self.backend.nwalkers,
            self.state.coords.shape[1],
            lambda vectors: power * self._log_prob(vectors),
            moves=self._moves,
            backend=self.backend,
            vectorize=True,
        )
        start = _scaled(self.state, power)
        for state in sampler.sample(start, iterations=goal - first, skip_initial_state_check=True):
            self.state = state
            if self.backend.iteration % _REFRESH == 0 and self.backend.iteration < goal:
                yield self.backend.iteration
        self.state = _scaled(self.state, 1.0 / power)
        self.backend.log_prob[first:] *= 1.0 / power


def _scaled(state: emcee.State, factor: float) -> emcee.State:
    """Returns the walkers with `factor` times their log densities, where these are known."""
    log_prob = None if state.log_prob is None else factor * state.log_prob
    return emcee.State(state.coords, log_prob=log_prob, random_state=state.random_state)


def _ensembles(
    log_posterior: LogPosterior,
    origin: Array,
    seed: int,
    walkers: int,
    backends: Sequence[emcee.backends.Backend | None],
) -> list[_Ensemble]:
    """Returns ensembles that continue their chains or start anew, each with its own random stream."""
    coordinates = MoveCoordinates(find_shear(log_posterior), *log_posterior.bounds)
    runs = []
    for e, (backend, stream) in enumerate(
        zip(backends, np.random.SeedSequence(seed).spawn(len(backends)), strict=True)
    ):
        if backend is None:
            backend = emcee.backends.Backend()
            backend.reset(walkers, log_posterior.dim)
            rng = np.random.default_rng(stream)
            # Ensembles that all start from the same place could not disagree.
            centre = origin if e == 0 else 0.5 * (origin + rng.uniform(*log_posterior.bounds))
            coords = initial_walkers(log_posterior, centre, walkers, rng)
            generator = np.random.RandomState(stream.generate_state(8))  # emcee uses this kind of generator
            state = emcee.State(coords, random_state=generator.get_state())
        else:
            state = backend.get_last_sample()
        runs.append(_Ensemble(log_posterior, coordinates, backend, state))
    return runs


def initial_walkers(
    log_posterior: LogPosterior, origin: Array, walkers: int, rng: np.random.Generator
) -> Array:
    """Returns walkers (W, D) spread between `origin` (sampling coordinates) and draws of the prior.

    Each walker lies a random share of the way, so that the ensemble spans both and is over-dispersed. Points
    without a density are drawn again. Raises InputError when the density vanishes nearly everywhere.
    """
    low, high = log_posterior.bounds
    out = np.empty((0, log_posterior.dim))
    for _ in range(100):
        share = rng.uniform(0.02, 1.0, (walkers, 1))
        trial = origin + share * (rng.uniform(low, high, (walkers, len(low))) - origin)
        out = np.concatenate([out, trial[np.isfinite(log_posterior.log_prob(trial))]])
        if len(out) >= walkers:
            return out[:walkers]
    raise InputError(
        "start", "a density of zero at nearly all points of the prior", "a surrogate with finite values"
    )


def _checkpoints(max_steps: int) -> Iterator[tuple[int, bool]]:
    """Yields the steps at which the ensembles wait for each other, and whether convergence is judged there.

    They depend on the step count alone, so that an interruption cannot change the step at which a run stops.
    """
    check = 0
    while check < max_steps:
        before, check = check, min(max(_FIRST_CHECK, check + max(_BETWEEN, check // 5)), max_steps)
        yield from ((at, False) for at in _LESSONS if before < at < check)
        yield check, True


def _check_settings(settings: SampleSettings, dim: int) -> None:
    if settings.walkers < 2 * dim + 2:
        raise InputError(
            "sample.walkers",
            settings.walkers,
            f"at least {2 * dim + 2}, which is twice the {dim} parameters plus 2",
        )
    if settings.ensembles < 1:
        raise InputError("sample.ensembles", settings.ensembles, "at least 1")
    if settings.max_steps < _FIRST_CHECK:
        raise InputError(
            "sample.max_steps", settings.max_steps,
            f"at least {_FIRST_CHECK}, because the first steps do not yet follow the posterior",
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
