"""Infers a population from the posteriors of a study's recordings, and summarises it.

`infer_population` is the only function that the rest of bayeskin needs: rows of the table and posteriors of
the recordings in, a `Population` out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from bayeskin.inference.identify import Informed, Learned, identifiability
from bayeskin.study.individual import Individual, Likelihoods
from bayeskin.study.layout import Category, Layout
from bayeskin.study.model import Model, Priors, State
from bayeskin.study.overlap import overlap
from bayeskin.study.result import Contrast, Estimate, ParameterOfPopulation, Population, Shrunk, Spread
from bayeskin.study.sampler import Progress, SamplerSettings, draw_population
from bayeskin.study.table import Entry
from bayeskin.types import Array


def infer_population(
    entries: Sequence[Entry],
    individuals: Sequence[Individual],
    rng: np.random.Generator,
    priors: Priors = Priors(),
    settings: SamplerSettings = SamplerSettings(),
    progress: Progress | None = None,
) -> Population:
    """Returns what the recordings of a study say about the population of their subjects.

    Parameters
    ----------
    entries : rows of the study's table
    individuals : posterior of each recording, in the order of the rows, all of the same parameters

    Raises
    ------
    InputError : the parameters of the posteriors differ.
    """
    layout, likelihoods = Layout.of(entries), Likelihoods.of(individuals, rng)
    model = Model.of(layout, likelihoods.bounds, priors)
    draws, convergence = draw_population(model, likelihoods, rng, settings, progress)
    learned = [identifiability(individual.space, individual.draws) for individual in individuals]
    return Population(
        layout, priors,
        tuple(
            _parameter(column, model, draws, [about.parameters[column] for about in learned])
            for column in range(len(likelihoods.names))
        ),
        _recordings(layout, draws, individuals), _subjects(model, draws),
        tuple(overlap(n, individual, model, draws) for n, individual in enumerate(individuals)), convergence,
    )  # fmt: skip


def _parameter(column: int, model: Model, draws: State, learned: Sequence[Learned]) -> ParameterOfPopulation:
    """Returns the summary of one parameter; `learned` is what each recording alone says about it."""
    layout, coefficients = model.layout, draws.coefficients[:, :, column]
    groups = layout.group.values if layout.group else ("",)
    between, *within = [covariance[:, column, column] for covariance in draws.covariances]
    return ParameterOfPopulation(
        learned[0].parameter,
        {group: _estimate(np.exp(coefficients @ layout.row(group))) for group in groups},
        _spread(between), _spread(np.sum(within, axis=0)) if within else None,
        _spread(within[1]) if len(within) > 1 else None,
        tuple(contrast for category in layout.categories for contrast in _contrasts(category, coefficients)),
        sum(about.informed is not Informed.NOT for about in learned),
        *(sum(side in about.leans_on for about in learned) for side in ("lower", "upper")),
    )  # fmt: skip


def _contrasts(category: Category, coefficients: Array) -> Iterator[Contrast]:
    """Yields the ratios of all pairs of a category's values, from coefficients (s, p) of one parameter."""
    further = coefficients[:, category.column : category.column + category.further]
    logs = np.column_stack([np.zeros(len(coefficients)), further])
    for first, second in combinations(range(len(category.values)), 2):
        log_ratio = logs[:, second] - logs[:, first]
        names = category.values[first], category.values[second]
        probability = float(np.mean(log_ratio > 0.0))
        yield Contrast(category.name, *names, _estimate(np.exp(log_ratio)), probability)


def _recordings(layout: Layout, draws: State, individuals: Sequence[Individual]) -> tuple[Shrunk, ...]:
    return tuple(
        Shrunk(
            layout.recordings[n], layout.subjects[layout.subject[n]],
            layout.group.of(n) if layout.group else None,
            tuple(map(_estimate, individual.draws.T)), tuple(map(_estimate, np.exp(draws.x[:, n]).T)),
        )
        for n, individual in enumerate(individuals)
    )  # fmt: skip


def _subjects(model: Model, draws: State) -> tuple[Shrunk, ...]:
    """Returns the values of the subjects, averaged over the groups and sites of their recordings."""
    layout = model.layout
    fixed = layout.matrix @ draws.coefficients
    out = []
    for number, name in enumerate(layout.subjects):
        own = np.flatnonzero(layout.subject == number)
        value = (
            fixed[:, own].mean(axis=1) + draws.values[0][:, number] if draws.values else draws.x[:, own[0]]
        )
        groups = {layout.group.of(int(n)) for n in own} if layout.group else set[str]()
        group = groups.pop() if len(groups) == 1 else None
        out.append(Shrunk(name, name, group, None, tuple(map(_estimate, np.exp(value).T))))
    return tuple(out)


def _spread(variance: Array) -> Spread:
    return Spread(_estimate(np.sqrt(variance)))


def _estimate(values: Array) -> Estimate:
    """Returns the median and the 90 % interval of draws (s,)."""
    low, median, high = np.quantile(values, [0.05, 0.5, 0.95])
    return Estimate(float(median), float(low), float(high))
