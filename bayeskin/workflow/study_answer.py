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
    names = [summary.parameter.name for summary in population.parameters]
    reasons = doubts(population) or population.convergence.verdict.reasons
    return {
        "ok": population.trusted,
        "verdict": "trusted" if population.trusted else "not trusted",
        "because": reasons,
        "headline": headline(population),
        "sentences": sentences(population),
        "parameters": {summary.parameter.name: _parameter(summary) for summary in population.parameters},
        "recordings": [_shrunk(summary, names) for summary in population.recordings],
        "subjects": [_shrunk(summary, names) for summary in population.subjects],
        "overlaps": [
            {**vars(summary), "poor": summary.poor, "contradicts": summary.contradicts}
            for summary in population.overlaps
        ],
        "priors": vars(population.priors),
        "sweeps": population.convergence.steps,
    }


def _parameter(summary: ParameterOfPopulation) -> dict[str, Any]:
    parameter = summary.parameter
    return {
        "unit": parameter.unit, "meaning": parameter.description,
        "bounds": [parameter.lower, parameter.upper],
        "medians": {group: _estimate(median) for group, median in summary.medians.items()},
        "ratios": [_ratio(contrast) for contrast in summary.contrasts],
        "between_subjects": _spread(summary.between),
        "within_a_subject": _spread(summary.within),
        "within_a_session": _spread(summary.repeats),
        "informative_recordings": summary.informative,
        "leaning_on_bounds": {"lower": summary.at_lower, "upper": summary.at_upper},
    }  # fmt: skip


def _estimate(estimate: Estimate) -> dict[str, float]:
    return {"median": estimate.median, "low_90": estimate.low, "high_90": estimate.high}


def _ratio(contrast: Contrast) -> dict[str, Any]:
    return {
        "of": contrast.category, "numerator": contrast.second, "denominator": contrast.first,
        **_estimate(contrast.ratio),
        "probability_above_1": contrast.probability,
    }  # fmt: skip


def _spread(spread: Spread | None) -> Mapping[str, Any] | None:
    if spread is None:
        return None
    return {
        "sd_of_logarithm": _estimate(spread.sd),
        "coefficient_of_variation": _estimate(spread.cv),
        "only_upper_bound": spread.only_upper_bound,
    }


def _shrunk(recording: Shrunk, names: list[str]) -> dict[str, Any]:
    def by_name(estimates: tuple[Estimate, ...]) -> dict[str, Any]:
        return {name: _estimate(estimate) for name, estimate in zip(names, estimates, strict=True)}

    alone = {} if recording.alone is None else {"alone": by_name(recording.alone)}
    return {
        "name": recording.name, "subject": recording.subject, "group": recording.group, **alone,
        "given_the_study": by_name(recording.shrunk),
    }  # fmt: skip
