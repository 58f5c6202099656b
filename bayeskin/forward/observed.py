"""Runs the full model with mechanisms and returns the force that the instrument reports."""

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
from bayeskin.types.joint import edges_of, end_to_end, values_in

BESIDE = 1e-4  # relative distance from a neutral value at which derivatives are computed


def reported(
    simulation: Simulation,
    mechanisms: Sequence[Mechanism],
    values: Mapping[str, float],
    motion: PadMotion,
) -> ForceOfTime:
    """Returns the force (1, t) of a run, changed by those mechanisms that the full model does not solve.

    The result is a function of times (t,).
    """
    columns = {name: np.array([value]) for name, value in values.items()}
    in_model = solved(mechanisms)
    on_force = [mechanism for mechanism in mechanisms if mechanism not in in_model]
    return observed(on_force, columns, motion, lambda t: np.atleast_2d(simulation.at(t)))


def beside_neutral(
    theta: Mapping[str, float], by: Mapping[str, float], mechanisms: Sequence[Mechanism]
) -> dict[str, float]:
    """Returns values at which to differentiate by those parameters of `theta` that are neutral.

    They differ from the neutral value by `BESIDE` of the parameter's change.

    At its neutral value a law may be absent and then has no derivative, for example where the pads were never
    opened.
    """
    neutral = {name: value for mechanism in mechanisms for name, value in mechanism.neutral.items()}
    return {name: theta[name] + BESIDE * by[name] for name in by if theta[name] == neutral.get(name)}


@dataclass(frozen=True)
class FullForce:
    """Returns the bin means (m,) of the force [N] of a full run with mechanisms.

    A call takes the names of mechanisms and the values of all parameters by name. It returns the error
    message where the run fails, for example because the skin folds. Instances can be pickled, so that
    `run_parallel` can send them to worker processes.
    """

    spec: ModelSpec
    motion: PadMotion
    edges_s: Array

    def __call__(self, case: tuple[Sequence[str], Mapping[str, float]]) -> Array | str:
        names, values = case
        if not self.motion.spans:
            return self._on_one_recording(names, values)
        forces: list[Array] = []
        edges = edges_of(self.motion.spans, self.edges_s)
        for number, (part, edges_s) in enumerate(zip(self.motion.parts, edges, strict=True)):
            force_n = FullForce(self.spec, part, edges_s)((names, values_in(values, number)))
            if isinstance(force_n, str):
                return f"recording {number + 1}: {force_n}"
            forces.append(force_n)
        return end_to_end(forces, 0.0)

    def _on_one_recording(self, names: Sequence[str], values: Mapping[str, float]) -> Array | str:
        """Returns the force (m,) [N] of a single recording, or the message of a run that failed."""
        mechanisms = [catalogue()[name] for name in names]
        used = {p.name for mechanism in solved(mechanisms) for p in mechanism.parameters}
        theta = dict(values)
        if not self.spec.formulation.any_parameters:
            theta = {name: value for name, value in values.items() if name in {*used, *PARAMETERS, *LENGTHS}}
        simulation = simulate(self.spec, self.motion, theta, laws=laws(mechanisms), falls_too=False)
        if simulation.status != "ok":
            return simulation.message
        on_force = [mechanism for mechanism in mechanisms if mechanism.act.bind is None]
        force = reported(simulation, mechanisms, values, self.motion)
        return np.asarray(bin_means(force, self.motion, self.edges_s, on_force)[0])
