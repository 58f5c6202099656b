"""Puts the result of a study into sentences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bayeskin.number_format import number, with_interval
from bayeskin.study.result import Contrast, Estimate, ParameterOfPopulation, Population, Spread
from bayeskin.types import Parameter

_LARGEST_CV = 10.0  # above this coefficient of variation, a percentage says little
_MORE = {
    1: "stiffer than",
    -1: "more permeable than",
}  # keys: the power of a stress with which a parameter scales


def sentences(population: Population) -> tuple[str, ...]:
    """Returns the result in sentences: each parameter, then what the data cannot tell, then the checks."""
    by_parameter = [text for summary in population.parameters for text in _of_parameter(population, summary)]
    return (*by_parameter, *_of_table(population), *_of_checks(population))


def headline(population: Population) -> tuple[str, ...]:
    """Returns the result in two sentences at most: the clearest difference, and the widest variation."""
    known = [summary for summary in population.parameters if summary.informative]
    if not known:
        return ("No recording of the study informs any of these parameters.",)
    said = [] if (clearest := clearest_contrast(population)) is None else [contrast_sentence(*clearest)]
    varying = [summary for summary in known if not summary.between.only_upper_bound]
    if not varying:
        return (*said, "The variation between subjects cannot be told from zero in any parameter.")
    widest = max(varying, key=lambda summary: summary.between.sd.median)
    variation = f"{widest.parameter.name} varies most: {_spread('between subjects', widest.between)}"
    if widest.within is not None:
        variation += f", and {_spread('within a subject', widest.within)}"
    return (*said, f"{variation}.")


def clearest_contrast(population: Population) -> tuple[Parameter, Contrast] | None:
    """Returns the difference of two groups or sites that is least likely to be none, with its parameter."""
    pairs = [
        (summary.parameter, contrast)
        for summary in population.parameters
        for contrast in summary.contrasts
        if summary.informative
    ]
    return max(pairs, key=lambda pair: abs(pair[1].probability - 0.5)) if pairs else None


def contrast_sentence(parameter: Parameter, contrast: Contrast, name: str = "") -> str:
    """Returns which of two groups or sites has the larger parameter, and by which factor.

    name : printed name of the parameter, if it differs from its own
    """
    larger, smaller, ratio, probability = _upward(contrast)
    more = _MORE.get(parameter.stress_power, "larger than")
    return (
        f"{name or parameter.name}: {contrast.category} {larger} is {more} {contrast.category} {smaller} "
        f"with probability {_probability(probability)}, by a factor of {_bracketed(ratio)}."
    )


def percentage(cv: Estimate) -> str:
    """Returns a coefficient of variation with its interval, such as "23 % [5, 48 %]"."""
    median, low, high = (_percent(value) for value in (cv.median, cv.low, cv.high))
    return f"{median} % [{low}, {high} %]"


def _of_parameter(population: Population, summary: ParameterOfPopulation) -> Iterator[str]:
    name, count = summary.parameter.name, len(population.recordings)
    if not summary.informative:
        yield f"{name}: no recording informs it, so all its numbers are those of the prior."
        return
    yield f"{name}: {_medians(summary)}."
    yield from (contrast_sentence(summary.parameter, contrast) for contrast in summary.contrasts)
    yield f"{name}: {_spread('between subjects', summary.between)}."
    if summary.within is not None:
        yield f"{name}: {_spread('within a subject', summary.within)}."
    if summary.repeats is not None:
        yield f"{name}: {_spread('between recordings of summary session', summary.repeats)}."
    if summary.informative < count:
        yield (
            f"{name}: only {summary.informative} of {count} recordings inform it; the others follow the "
            "population."
        )
    for side, leaning in (("lower", summary.at_lower), ("upper", summary.at_upper)):
        if leaning:
            yield (
                f"{name}: the posteriors of {leaning} of {count} recordings lean on the {side} bound of the "
                "prior, so this bound shapes the median and the spread."
            )


def _medians(summary: ParameterOfPopulation) -> str:
    parts = [
        f"{_bracketed(estimate, summary.parameter.unit)}{f' in group {group}' if group else ''}"
        for group, estimate in summary.medians.items()
    ]
    return f"the median of the population is {' and '.join(parts)}"


def _spread(where: str, spread: Spread) -> str:
    cv = spread.cv
    if spread.only_upper_bound:
        return (
            f"the variation {where} cannot be told from zero; its coefficient of variation is below "
            f"{_percent(cv.high)} % with probability 0.95"
        )
    return f"the coefficient of variation {where} is {percentage(cv)}"


def _of_table(population: Population) -> Iterator[str]:
    """Yields what the table of the study cannot tell."""
    layout = population.layout
    if layout.repetition == "none":
        yield (
            "Each subject has one recording. The variation within a subject is therefore not known, and it "
            "is part of the variation between subjects."
        )
    if layout.repetition == "recordings of a session":
        yield (
            "All recordings of a subject are of one session. The variation within a subject does not include "
            "differences between sessions."
        )
    if layout.site_is_group:
        yield (
            "Sites cannot be told apart from groups in this table. A difference between groups may be a "
            "difference between sites."
        )


def _of_checks(population: Population) -> Iterator[str]:
    poor = sum(overlap.poor for overlap in population.overlaps)
    if poor:
        yield (
            f"The draws of {poor} of {len(population.overlaps)} recordings hardly overlap with their shrunk "
            "estimates. These estimates rely on the densities that were fitted to the draws."
        )
    yield from (f"Not trusted: {doubt}." for doubt in doubts(population))


def doubts(population: Population) -> tuple[str, ...]:
    """Returns the reasons why the result is not to be trusted; there are none where it is trusted."""
    verdict = population.convergence.verdict
    contradicted = (
        f"the weighted draws of {overlap.recording} differ from its shrunk estimate by "
        f"{number(overlap.shift_sd, 2)} of its sd"
        for overlap in population.overlaps
        if overlap.contradicts
    )
    return (*contradicted, *(() if verdict.trusted else verdict.reasons[:1]))


def _upward(contrast: Contrast) -> tuple[str, str, Estimate, float]:
    """Returns the larger and the smaller of two values, their ratio, and its probability of being above 1."""
    ratio = contrast.ratio
    if contrast.probability >= 0.5:
        return contrast.second, contrast.first, ratio, contrast.probability
    inverse = Estimate(1.0 / ratio.median, 1.0 / ratio.high, 1.0 / ratio.low)
    return contrast.first, contrast.second, inverse, 1.0 - contrast.probability


def _probability(value: float) -> str:
    return "above 0.999" if value > 0.999 else number(np.round(value, 3 if value > 0.99 else 2), 3)


def _bracketed(estimate: Estimate, unit: str = "") -> str:
    return with_interval(estimate.median, estimate.low, estimate.high, unit)


def _percent(value: float) -> str:
    return f"more than {100 * _LARGEST_CV:.0f}" if value > _LARGEST_CV else number(100.0 * value, 2)
