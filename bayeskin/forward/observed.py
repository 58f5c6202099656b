"""The full model with mechanisms, as the instrument reports its force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.problem import PARAMETERS
from bayeskin.finite_element.simulate import ModelSpec, simulate
from bayeskin.geometry import LENGTHS
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, laws, observed, solved
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.types import Array, PadMotion, Simulation

BESIDE = 1e-4  # of a change, by which derivatives are taken beside a neutral value


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


def beside_neutral(
    theta: Mapping[str, float], by: Mapping[str, float], mechanisms: Sequence[Mechanism]
) -> dict[str, float]:
    """Returns values beside those of `theta` that are neutral, by `BESIDE` of a change.

    At its neutral value a law may not be there at all, and has no derivative (pads never opened).
    """
    neutral = {name: value for mechanism in mechanisms for name, value in mechanism.neutral.items()}
    return {name: theta[name] + BESIDE * by[name] for name in by if theta[name] == neutral.get(name)}


@dataclass(frozen=True)
class FullForce:
    """A function of (names of mechanisms, values by name): bin means (m,) of a full run with them.

    Of a run that fails its message, of a skin that folds, too. Picklable, for `run_parallel`.
    """

    spec: ModelSpec
    motion: PadMotion
    edges_s: Array

    def __call__(self, case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
        names, values = case
        mechanisms = [catalogue()[name] for name in names]
        along = {p.name for mechanism in solved(mechanisms) for p in mechanism.parameters}
        theta = dict(values)
        if self.spec.forward is None:  # a model of one's own has parameters of any name
            theta = {name: value for name, value in values.items() if name in {*along, *PARAMETERS, *LENGTHS}}
        simulation = simulate(self.spec, self.motion, theta, laws=laws(mechanisms), falls_too=False)
        if simulation.status != "ok":
            return simulation.message
        beyond = [mechanism for mechanism in mechanisms if mechanism.act.bind is None]
        force = reported(simulation, mechanisms, values, self.motion)
        return np.asarray(bin_means(force, self.motion, self.edges_s, beyond)[0])
