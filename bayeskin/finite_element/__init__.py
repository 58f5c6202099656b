"""The full finite-element model of an extensometer test on skin.

The skin has two layers, cutis and subcutis. Each is a poro-hyperelastic solid. `simulate` runs the model that
a `ModelSpec` describes.
"""

from bayeskin.finite_element.simulate import SOLVER_NAME, ModelSpec, simulate

__all__ = ["SOLVER_NAME", "ModelSpec", "simulate"]
