"""Opens the forward model that a file holds."""

from __future__ import annotations

from pathlib import Path

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ForwardModel
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.forward.surrogate import SurrogateForward
from bayeskin.reduced.files import load_reduced
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, PadMotion


def forward_model(file: Path, spec: ModelSpec, motion: PadMotion, edges_s: Array) -> ForwardModel:
    """Returns the model in a file: a reduced model where it can replace `spec`, otherwise a surrogate."""
    if stands_for(spec):
        return ReducedForward(load_reduced(file), motion, edges_s)
    return SurrogateForward(load_surrogate(file), spec)
