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
from bayeskin.study.table import Entry, read_table, refuse_few_subjects
from bayeskin.study.words import (
    clearest_contrast,
    contrast_sentence,
    doubts,
    headline,
    percentage,
    sentences,
)

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
    "clearest_contrast",
    "contrast_sentence",
    "doubts",
    "headline",
    "infer_population",
    "percentage",
    "read_table",
    "refuse_few_subjects",
    "sentences",
]
