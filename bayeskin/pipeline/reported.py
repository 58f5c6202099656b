"""The full model with mechanisms, as the instrument reports its force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayeskin.geometry import LENGTHS
from bayeskin.mechanisms import Mechanism, bin_means, catalogue, laws, observed, solved
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.model.problem import PARAMETERS
from bayeskin.model.simulate import ModelSpec, simulate
from bayeskin.types import Array, PadMotion, Simulation

STEP = 1e-4  # of a change, for differences of what the instrument makes of a force
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
        found = self.with_slopes(case, {})
        return found if isinstance(found, str) else found[0]

    def with_slopes(
        self, case: tuple[Sequence[str], Mapping[str, float]], changes: Mapping[str, float]
    ) -> tuple[Array, Array] | str:
        """Bin means (m,), and their derivatives (m, r) by these parameters, each for its change."""
        names, values = case
        mechanisms = [catalogue()[name] for name in names]
        along = {p.name for mechanism in solved(mechanisms) for p in mechanism.parameters}
        theta = dict(values)
        if self.spec.forward is None:  # a model of one's own has parameters of any name
            theta = {name: value for name, value in values.items() if name in {*along, *PARAMETERS, *LENGTHS}}
        by = {name: change for name, change in changes.items() if name in theta}
        theta |= beside_neutral(theta, by, mechanisms)
        simulation = simulate(
            self.spec, self.motion, theta, laws=laws(mechanisms), gradients=by, falls_too=False
        )
        if simulation.status != "ok":
            return simulation.message
        slopes = dict(zip(simulation.gradient_names, simulation.gradient_n.T, strict=True))
        runs = [replace(simulation, force_n=simulation.force_n + STEP * slopes.get(name, 0.0))
                for name in changes]  # fmt: skip
        columns = {name: np.full(1 + len(changes), value) for name, value in values.items()}
        for row, (name, change) in enumerate(changes.items(), start=1):
            columns[name][row] += STEP * change

        def force(time_s: Array) -> Array:
            times_s = np.broadcast_to(time_s, (1 + len(runs), np.shape(time_s)[-1]))
            return np.stack([run.at(row) for run, row in zip([simulation, *runs], times_s, strict=True)])

        beyond = [mechanism for mechanism in mechanisms if mechanism.act.bind is None]
        seen = bin_means(observed(beyond, columns, self.motion, force), self.motion, self.edges_s, beyond)
        return seen[0], (seen[1:] - seen[0]).T / STEP
