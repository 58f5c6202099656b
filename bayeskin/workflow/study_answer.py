"""States what a study says about its population in the types of JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayeskin.study import (
    Contrast,
    Estimate,
    ParameterOfPopulation,
    Population,
    Shrunk,
    Spread,
    doubts,
    headline,
    sentences,
)


def population_in_json(population: Population) -> dict[str, Any]:
    """Returns the result of a study; values are in SI, and intervals contain 90 % of the probability."""
    names = [one.parameter.name for one in population.parameters]
    reasons = doubts(population) or population.convergence.verdict.reasons
    return {
        "ok": population.trusted,
        "verdict": "trusted" if population.trusted else "not trusted",
        "because": reasons,
        "headline": headline(population),
        "sentences": sentences(population),
        "parameters": {one.parameter.name: _parameter(one) for one in population.parameters},
        "recordings": [_shrunk(one, names) for one in population.recordings],
        "subjects": [_shrunk(one, names) for one in population.subjects],
        "overlaps": [
            {**vars(one), "poor": one.poor, "contradicts": one.contradicts} for one in population.overlaps
        ],
        "priors": vars(population.priors),
        "sweeps": population.convergence.steps,
    }


def _parameter(one: ParameterOfPopulation) -> dict[str, Any]:
    parameter = one.parameter
    return {
        "unit": parameter.unit, "meaning": parameter.description,
        "bounds": [parameter.lower, parameter.upper],
        "medians": {group: _estimate(median) for group, median in one.medians.items()},
        "ratios": [_ratio(contrast) for contrast in one.contrasts],
        "between_subjects": _spread(one.between),
        "within_a_subject": _spread(one.within),
        "within_a_session": _spread(one.repeats),
        "informative_recordings": one.informative,
        "leaning_on_bounds": {"lower": one.at_lower, "upper": one.at_upper},
    }  # fmt: skip


def _estimate(one: Estimate) -> dict[str, float]:
    return {"median": one.median, "low_90": one.low, "high_90": one.high}


def _ratio(one: Contrast) -> dict[str, Any]:
    return {
        "of": one.category, "numerator": one.second, "denominator": one.first, **_estimate(one.ratio),
        "probability_above_1": one.probability,
    }  # fmt: skip


def _spread(one: Spread | None) -> Mapping[str, Any] | None:
    if one is None:
        return None
    return {
        "sd_of_logarithm": _estimate(one.sd),
        "coefficient_of_variation": _estimate(one.cv),
        "only_upper_bound": one.only_upper_bound,
    }


def _shrunk(one: Shrunk, names: list[str]) -> dict[str, Any]:
    def by_name(estimates: tuple[Estimate, ...]) -> dict[str, Any]:
        return {name: _estimate(estimate) for name, estimate in zip(names, estimates, strict=True)}

    alone = {} if one.alone is None else {"alone": by_name(one.alone)}
    return {
        "name": one.name, "subject": one.subject, "group": one.group, **alone,
        "given_the_study": by_name(one.shrunk),
    }  # fmt: skip
