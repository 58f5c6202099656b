"""The reduced model of a device as a forward model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ModelRun, change
from bayeskin.forward.observed import beside_neutral
from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.types import Array, PadMotion, ParameterSpace, Simulation

FOLDING = 0.15  # of the stiffness at rest: nearer to folding the reduced model is of no use; runs of the full
# model check what comes out


@dataclass(frozen=True)
class ReducedForward:
    """The reduced model of a device, on a protocol."""

    model: ReducedModel
    motion: PadMotion
    edges_s: Array

    @property
    def solves(self) -> frozenset[str]:
        """Those of the tissue that it was trained for, and those that lie in series with the skin."""
        in_series = (m.name for m in catalogue().values() if isinstance(m.act, Instrument) and m.act.bind)
        return frozenset({*self.model.trained.mechanisms, *in_series})

    @property
    def hash(self) -> str:
        return self.model.hash

    @property
    def spec(self) -> ModelSpec:
        """The full model that it was made from."""
        return ModelSpec(refinement=self.model.refinement, geometry=self.model.trained.geometry)

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Derivatives at a value that is neutral are taken beside it, and the force is brought back."""
        by = dict(zip(space.names, map(float, change(space, at)), strict=True))
        values = dict(zip(space.names, map(float, at), strict=True))
        if derive:
            values |= beside_neutral(values, by, mechanisms)
        made = self.simulated(self.motion, values, mechanisms, by if derive else None)
        if made.status != "ok":
            return made.message
        force_n = made.bin_means(self.edges_s)
        if not derive:
            return ModelRun(at, force_n, None)
        slopes_n = made.gradient_bin_means(self.edges_s)
        if not np.all(np.isfinite(slopes_n)):
            return "the derivatives of the run are not finite"
        aside = np.array([(values[name] - here) / by[name] for name, here in zip(by, at, strict=True)])
        return ModelRun(at, force_n - slopes_n @ aside, slopes_n)

    def simulated(
        self, motion: PadMotion, values: Mapping[str, float], mechanisms: Sequence[Mechanism],
        by: Mapping[str, float] | None = None,
    ) -> Simulation:  # fmt: skip
        """Returns a run on any protocol."""
        return simulate_reduced(self.model, motion, values, mechanisms, by, least_stiffness=FOLDING)

    def errors(self, at: Array) -> Array:
        """Returns none: the reduced model does not state its error; runs of the full model show it."""
        return np.zeros((0, len(self.edges_s) - 1))


def stands_for(spec: ModelSpec) -> bool:
    """Returns whether a device's reduced model stands for a full model: that of the reaction, on bricks."""
    return (spec.observation, spec.mesh) == ("reaction", "bricks")
