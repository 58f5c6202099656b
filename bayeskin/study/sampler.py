"""Draws from the posterior of a population, by ensembles of walkers that run until they have converged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayeskin.inference.convergence import Convergence, Limits, assess
from bayeskin.study.exact_draws import draw_coefficients, draw_covariances, draw_values
from bayeskin.study.individual import Likelihoods
from bayeskin.study.model import Model, State
from bayeskin.study.moves import Ensembles
from bayeskin.types import Array

_FIRST_CHECK, _GROWTH = 500, 1.5  # sweeps until the first check, and their growth until the next
_EVERY, _MOST = 5, 200  # every fifth sweep is kept; at most so many make the result
_START_SDS = (0.1, 1.0)  # range of the spreads at the start
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class SamplerSettings:
    """Number of independent ensembles, even number of walkers in each, and when to stop.

    `limits` are those of `bayeskin.inference.Limits`. A sweep moves all parameters of a walker once.
    """

    ensembles: int = 4
    walkers: int = 16
    max_sweeps: int = 12000
    limits: Limits = field(default_factory=lambda: Limits(effective_samples=1000.0, lengths=10.0))


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
    state = _start(model, likelihoods, settings.ensembles * settings.walkers, rng)
    names = _names(model, likelihoods.names)
    chain, densities, kept = list[Array](), list[Array](), list[State]()
    goal = min(_FIRST_CHECK, settings.max_sweeps)
    while True:
        while len(chain) < goal:
            state = _sweep(moves, state, rng)
            chain.append(_coordinates(state))
            densities.append(model.log_density(state))
            if len(chain) % _EVERY == 0:
                kept.append(state)
        steps, log_density = (_by_ensemble(rows, settings) for rows in (chain, densities))
        convergence = assess(steps, log_density, names, settings.limits)
        if progress is not None:
            progress(convergence.progress(settings.limits), convergence.verdict.reasons[0])
        if convergence.verdict.trusted or goal == settings.max_sweeps:
            settled = kept[convergence.burn_in // _EVERY :]
            chosen = np.linspace(0, len(settled) - 1, min(_MOST, len(settled))).astype(int)
            return State.joined([settled[at] for at in chosen]), convergence
        goal = min(int(_GROWTH * goal), settings.max_sweeps)


def _sweep(moves: Ensembles, state: State, rng: np.random.Generator) -> State:
    """Returns the state after all parameters have moved once."""
    model = moves.model
    for draw in (draw_coefficients, draw_values, draw_covariances):
        state = draw(model, state, rng)
    for move in (
        moves.from_population,
        moves.from_posteriors,
        moves.move_recordings,
        moves.move_coefficients,
    ):
        state = move(state, rng)
    for level in range(len(model.layout.levels) + 1):
        state = moves.move_spread(state, level, rng)
    return state


def _start(model: Model, likelihoods: Likelihoods, count: int, rng: np.random.Generator) -> State:
    """Returns a state of `count` walkers, in which each recording has a draw of its own posterior."""
    x = likelihoods.draw(count, rng)
    dim, levels = x.shape[2], model.layout.levels
    low, high = _START_SDS
    sds = low * (high / low) ** rng.random((len(levels) + 1, count, 1, dim))
    state = State(
        x, likelihoods.log_likelihood(x), np.tile(model.centre, (count, 1, 1)),
        tuple(np.zeros((count, len(level.parent), dim)) for level in levels), tuple(sds**2 * np.eye(dim)),
    )  # fmt: skip
    return draw_values(model, draw_coefficients(model, state, rng), rng)


def _coordinates(state: State) -> Array:
    """Returns the parameters (m, D) whose convergence is judged: B and the log sds of all levels."""
    sds = [0.5 * np.log(np.diagonal(one, axis1=1, axis2=2)) for one in state.covariances]
    return np.concatenate([state.coefficients.reshape(len(state.x), -1), *sds], axis=1)


def _names(model: Model, parameters: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of `_coordinates`."""
    layout = model.layout
    ratios = [f"{one.name} {value}" for one in layout.categories for value in one.values[1:]]
    spreads = [f"spread of {level.name}s" for level in layout.levels] + ["spread of recordings"]
    return tuple(f"{what}, {name}" for what in ("median", *ratios, *spreads) for name in parameters)


def _by_ensemble(rows: Sequence[Array], settings: SamplerSettings) -> Array:
    """Returns values (E, n, W, ...) of n sweeps, each (E W, ...)."""
    values = np.stack(rows)
    shape = (len(values), settings.ensembles, settings.walkers, *values.shape[2:])
    return np.moveaxis(values.reshape(shape), 1, 0)
