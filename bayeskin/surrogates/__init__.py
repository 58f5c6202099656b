"""Surrogates replace the full model: they learn from a design, predict their own error, and store no code."""

from bayeskin.surrogates.files import (
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
    "ShapeSurrogate", "Similarity", "Validation", "correct", "load_manifest", "load_surrogate", "manifest_of",
    "save_surrogate", "train", "validate",
]  # fmt: skip
