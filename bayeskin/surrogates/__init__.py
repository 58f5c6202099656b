"""Surrogates of the full model: trained on a design, honest about their error, stored without code."""

from bayeskin.surrogates.effects import (
    Effect,
    Pair,
    WithEffects,
    composed,
    effect_of,
    effects_among,
    train_effect,
    with_effects,
)
from bayeskin.surrogates.files import (
    effects_beside,
    effects_in,
    load_effect,
    load_manifest,
    load_surrogate,
    manifest_of,
    save_surrogate,
)
from bayeskin.surrogates.similarity import Similarity
from bayeskin.surrogates.surrogate import ShapeSurrogate
from bayeskin.surrogates.train import train
from bayeskin.surrogates.two_fidelities import correct
from bayeskin.surrogates.validate import Validation, validate

__all__ = [
    "Effect", "Pair", "ShapeSurrogate", "Similarity", "Validation", "WithEffects", "composed", "correct",
    "effect_of", "effects_among", "effects_beside", "effects_in", "load_effect",
    "load_manifest", "load_surrogate", "manifest_of", "save_surrogate", "train",
    "train_effect", "validate", "with_effects",
]  # fmt: skip
