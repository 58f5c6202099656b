"""Runs of any model, on its own steps or on those of another run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayeskin.finite_element.extrapolation import EXTRAPOLATION_POINTS
from bayeskin.finite_element.lagrangian import LagrangianModel
from bayeskin.finite_element.stages import Step
from bayeskin.finite_element.stepping import advance, integrate
from bayeskin.reduced.equations import ReducedEquations
from bayeskin.types import Array

Model = LagrangianModel | ReducedEquations


def start_at_zero(model: Model, step: Step) -> None:
    """Zeroes the load cell when the test starts."""
    if abs(step.state.time_s - model.starts_s) < 1e-6:
        model.zero_n = step.force_n


def run(model: Model, p_init: float) -> list[Step]:
    """All steps of a run that does not fail."""
    steps: list[Step] = []

    def on_step(step: Step) -> None:
        steps.append(step)
        start_at_zero(model, step)

    assert integrate(model, p_init, 1e-3, on_step, falls_too=False) == ""
    return steps


def on_steps_of(model: Model, p_init: float, steps: Sequence[Step]) -> Array:
    """Forces of a model (n,) on the steps of another run."""
    past, forces = [model.initial_state(p_init)], [0.0]
    start_at_zero(model, steps[0])
    for step in steps[1:]:
        stepped = advance(model, past, step.state.time_s - past[-1].time_s)
        assert stepped is not None
        forces.append(stepped.force_n)
        start_at_zero(model, stepped)
        past = [*past, stepped.state][-EXTRAPOLATION_POINTS:]
        if step.corner:
            model.remember_travel(past)
            past = past[-1:]
    return np.array(forces)
