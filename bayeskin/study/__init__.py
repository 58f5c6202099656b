"""Statistics of a study of many skins: its table, and a hierarchical model of the population."""

from bayeskin.study.individual import Individual
from bayeskin.study.model import Priors
from bayeskin.study.population import infer_population
from bayeskin.study.result import (
    Contrast,
    Estimate,
    Overlap,
    ParameterOfPopulation,
    Population,
    Shrunk,
    Spread,
)
from bayeskin.study.sampler import SamplerSettings
from bayeskin.study.table import Entry, read_table
from bayeskin.study.words import contrast_sentence, percentage, sentences

__all__ = [
    "Contrast",
    "Entry",
    "Estimate",
    "Individual",
    "Overlap",
    "ParameterOfPopulation",
    "Population",
    "Priors",
    "SamplerSettings",
    "Shrunk",
    "Spread",
    "contrast_sentence",
    "infer_population",
    "percentage",
    "read_table",
    "sentences",
]
