"""The full finite-element model of the test: two-layer poro-hyperelastic skin under an extensometer."""

from bayeskin.finite_element.simulate import SOLVER_NAME, ModelSpec, simulate

__all__ = ["SOLVER_NAME", "ModelSpec", "simulate"]
