"""The full model with mechanisms, as the instrument reports its force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.mechanisms import Mechanism, bin_means, catalogue, laws, observed, solved
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.model.problem import PARAMETERS
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.types import Array, PadMotion, Simulation


def reported(
    simulation: Simulation,
    mechanisms: Sequence[Mechanism],
    values: Mapping[str, float],
    motion: PadMotion,
) -> ForceOfTime:
    """A run's force (1, t) after those of its mechanisms that the full model does not solve."""
    columns = {name: np.array([value]) for name, value in values.items()}
    within = solved(mechanisms)
    beyond = [mechanism for mechanism in mechanisms if mechanism not in within]
    return observed(beyond, columns, motion, lambda t: np.atleast_2d(simulation.at(t)))


@dataclass(frozen=True)
class FullForce:
    """A function of (names of mechanisms, values by name): bin means (m,) of a full run with them.

    Of a run that fails its message. Picklable, for `run_parallel`.
    """

    spec: ModelSpec
    motion: PadMotion
    edges_s: Array

    def __call__(self, case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
        names, values = case
        mechanisms = [catalogue()[name] for name in names]
        along = {p.name for mechanism in solved(mechanisms) for p in mechanism.parameters}
        theta = {name: value for name, value in values.items() if name in along or name in PARAMETERS}
        simulation = simulate(self.spec, self.motion, theta, laws=laws(mechanisms))
        if simulation.status != "ok":
            return simulation.message
        return bin_means(reported(simulation, mechanisms, values, self.motion), self.motion, self.edges_s)[0]
