"""Ensembles of walkers: where they start, their steps in several threads, and their common proposals."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from threading import Event

import emcee
import numpy as np

from bayeskin.errors import InputError
from bayeskin.inference.coordinates import MoveCoordinates
from bayeskin.inference.moves import mixed_moves
from bayeskin.inference.problem import LogPosterior
from bayeskin.inference.proposal import Product
from bayeskin.inference.reparametrisation import find_shear
from bayeskin.inference.schedule import SCHEDULE
from bayeskin.types import Array


class Ensemble:
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
        power = SCHEDULE.power(goal)
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
            if self.backend.iteration % SCHEDULE.refresh == 0 and self.backend.iteration < goal:
                yield self.backend.iteration
        self.state = _scaled(self.state, 1.0 / power)
        self.backend.log_prob[first:] *= 1.0 / power


def _scaled(state: emcee.State, factor: float) -> emcee.State:
    """Returns the walkers with `factor` times their log densities, where these are known."""
    log_prob = None if state.log_prob is None else factor * state.log_prob
    return emcee.State(state.coords, log_prob=log_prob, random_state=state.random_state)


def ensembles(
    log_posterior: LogPosterior,
    origin: Array,
    seed: int,
    walkers: int,
    backends: Sequence[emcee.backends.Backend | None],
) -> list[Ensemble]:
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
        runs.append(Ensemble(log_posterior, coordinates, backend, state))
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
        "start",
        "the posterior density is zero at nearly all points of the prior",
        "the surrogate must give finite values there",
    )


def advance_all(runs: Sequence[Ensemble], goal: int, threads: int) -> Generator[tuple[int, int], None, None]:
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


def adapt_proposals(
    runs: Sequence[Ensemble], chains: Array, log_posterior: LogPosterior, rng: np.random.Generator
) -> None:
    """Lets the ensembles propose from one distribution, fitted to the draws (E, n, W, D) of all ensembles.

    The parameters of the model and of the noise have separate mixtures, since they hardly depend on each
    other.
    """
    draws = chains[:, :: -(-chains[..., 0].size // SCHEDULE.points)].reshape(-1, log_posterior.dim)
    model = log_posterior.surrogate.space.dim
    blocks = (slice(0, model), slice(model, log_posterior.dim))
    known = Product.of(runs[0].coordinates.forward(draws), blocks, rng)
    for run in runs:
        run.propose_from(known)
