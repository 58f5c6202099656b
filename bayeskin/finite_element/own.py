"""Runs a forward model of the user's own in the place of a formulation."""

from __future__ import annotations

from dataclasses import dataclass

from bayeskin.external.model import STEP_S, simulate_own
from bayeskin.finite_element.formulation import Formulation, RunRequest
from bayeskin.types import Simulation


@dataclass(frozen=True)
class Own(Formulation):
    """A model of the user's own; `forward` is its location, as `bayeskin.external.model` describes."""

    forward: str

    any_parameters = True
    error_unknown = "this is a model of your own"
    steps = STEP_S

    def run(self, request: RunRequest) -> Simulation:
        return simulate_own(self.forward, request.motion, request.theta)
