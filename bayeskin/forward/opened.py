"""Opens the forward model that a file holds."""

from __future__ import annotations

from pathlib import Path

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ForwardModel
from bayeskin.forward.joint import JointForward
from bayeskin.forward.reduced import ReducedForward, stands_for
from bayeskin.forward.surrogate import SurrogateForward
from bayeskin.reduced.files import load_reduced
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, Markers, PadMotion
from bayeskin.types.joint import edges_of


def forward_model(
    file: Path, spec: ModelSpec, motion: PadMotion, edges_s: Array, markers: Markers | None = None
) -> ForwardModel:
    """Returns the model in a file: a reduced model where it can replace `spec`, otherwise a surrogate.

    Several recordings of one skin have a joint model.

    markers : tracks of points on the skin, which a reduced model also computes; only for a single recording
    """
    if stands_for(spec):
        model, edges = load_reduced(file), edges_of(motion.spans, edges_s)
        each = tuple(ReducedForward(model, *part, markers) for part in zip(motion.parts, edges, strict=True))
        return each[0] if len(each) == 1 else JointForward(each)
    return SurrogateForward(load_surrogate(file), spec)
