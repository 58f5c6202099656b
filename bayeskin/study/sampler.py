"""Draws from the posterior of a population, by ensembles of walkers that run until they have converged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.inference.convergence import Convergence, Limits, assess
from bayeskin.study.exact_draws import draw_coefficients, draw_covariances, draw_values
from bayeskin.study.individual import Likelihoods
from bayeskin.study.model import Model, State
from bayeskin.study.moves import Ensembles
from bayeskin.types import Array

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SamplerSettings:
    """Settings of the sampler. A sweep moves all parameters of a walker once.

    ensembles, walkers : number of independent ensembles, and even number of walkers in each
    limits, max_sweeps : the ensembles end when the limits are met, or after `max_sweeps` sweeps
    first_check, growth : sweeps until the limits are first checked, and factor of the sweeps until the next
    every, most : one of `every` sweeps is kept, and at most `most` of these make the result
    start_sds : range of the sds of all levels at the start
    """

    ensembles: int = 4
    walkers: int = 16
    limits: Limits = Limits(effective_samples=1000.0, lengths=10.0)
    max_sweeps: int = 12000
    first_check: int = 500
    growth: float = 1.5
    every: int = 5
    most: int = 200
    start_sds: tuple[float, float] = (0.1, 1.0)


def draw_population(
    model: Model,
    likelihoods: Likelihoods,
    rng: np.random.Generator,
    settings: SamplerSettings,
    progress: Progress | None = None,
) -> tuple[State, Convergence]:
    """Returns draws of the posterior, as a state of many walkers, and their convergence.

    The ensembles run until the limits are met, or for `max_sweeps` sweeps. `progress` is called after each
    check with the share of the way that is done and the first reason of the verdict.
    """
    moves = Ensembles(model, likelihoods, settings.ensembles, settings.walkers)
    state = _start(model, likelihoods, settings, rng)
    names = _names(model, likelihoods.names)
    chain, densities, kept = list[Array](), list[Array](), list[State]()
    goal = min(settings.first_check, settings.max_sweeps)
    while True:
        while len(chain) < goal:
            state = _sweep(moves, state, rng)
            chain.append(_coordinates(state))
            densities.append(model.log_density(state))
            if len(chain) % settings.every == 0:
                kept.append(state)
        steps, log_density = (_by_ensemble(rows, settings) for rows in (chain, densities))
        convergence = assess(steps, log_density, names, settings.limits)
        if progress is not None:
            progress(convergence.progress(settings.limits), convergence.verdict.reasons[0])
        if convergence.verdict.trusted or goal == settings.max_sweeps:
            settled = kept[convergence.burn_in // settings.every :]
            return State.joined(settled[:: -(-len(settled) // settings.most)]), convergence
        goal = min(int(settings.growth * goal), settings.max_sweeps)


def _sweep(moves: Ensembles, state: State, rng: np.random.Generator) -> State:
    """Returns the state after all parameters have moved once."""
    model = moves.model
    for draw in (draw_coefficients, draw_values, draw_covariances):
        state = draw(model, state, rng)
    state = moves.from_population(state, rng)
    state = moves.from_posteriors(state, rng)
    state = moves.move_recordings(state, rng)
    state = moves.move_coefficients(state, rng)
    for level in range(len(model.layout.levels) + 1):
        state = moves.move_spread(state, level, rng)
    return state


def _start(
    model: Model, likelihoods: Likelihoods, settings: SamplerSettings, rng: np.random.Generator
) -> State:
    """Returns a state of all walkers, in which each recording has a draw of its own posterior."""
    count, levels = settings.ensembles * settings.walkers, model.layout.levels
    x = likelihoods.draw(count, rng)
    dim, (low, high) = x.shape[2], settings.start_sds
    sds = low * (high / low) ** rng.random((len(levels) + 1, count, 1, dim))
    state = State(
        x, likelihoods.log_likelihood(x), np.tile(model.centre, (count, 1, 1)),
        tuple(np.zeros((count, len(level.parent), dim)) for level in levels), tuple(sds**2 * np.eye(dim)),
    )  # fmt: skip
    return draw_values(model, draw_coefficients(model, state, rng), rng)


def _coordinates(state: State) -> Array:
    """Returns the parameters (m, D) whose convergence is judged: B and the log sds of all levels."""
    sds = [0.5 * np.log(np.diagonal(covariance, axis1=1, axis2=2)) for covariance in state.covariances]
    return np.concatenate([state.coefficients.reshape(len(state.x), -1), *sds], axis=1)


def _names(model: Model, parameters: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of `_coordinates`."""
    layout = model.layout
    ratios = [f"{category.name} {value}" for category in layout.categories for value in category.values[1:]]
    spreads = [f"spread of {level.name}s" for level in layout.levels] + ["spread of recordings"]
    return tuple(f"{what}, {name}" for what in ("median", *ratios, *spreads) for name in parameters)


def _by_ensemble(rows: Sequence[Array], settings: SamplerSettings) -> Array:
    """Returns values (E, n, W, ...) of n sweeps, each (E W, ...)."""
    values = np.stack(rows)
    shape = (len(values), settings.ensembles, settings.walkers, *values.shape[2:])
    return np.moveaxis(values.reshape(shape), 1, 0)
