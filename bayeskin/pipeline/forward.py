"""The forward models of a diagnosis: the force of a skin with mechanisms of the tissue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from bayeskin.mechanisms import Mechanism, catalogue
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.tangent import ModelRun
from bayeskin.model.simulate import ModelSpec
from bayeskin.pipeline.folder import sha256_of
from bayeskin.pipeline.reported import beside_neutral
from bayeskin.reduced.files import load_reduced
from bayeskin.reduced.model import ReducedModel
from bayeskin.reduced.simulate import simulate_reduced
from bayeskin.surrogates import load_surrogate
from bayeskin.types import Array, PadMotion, ParameterSpace, Simulation, Surrogate

FOLDING = 0.15  # of the stiffness at rest: nearer to folding the reduced model is of no use; runs of the full
# model check what comes out
STEP = 1e-4  # of the prior's box, for differences of a surrogate


class ForwardModel(Protocol):
    """Runs the skin; `solves` names the mechanisms that it solves, `hash` identifies it."""

    @property
    def solves(self) -> frozenset[str]: ...

    @property
    def hash(self) -> str: ...

    @property
    def spec(self) -> ModelSpec:
        """The full model in whose place it is."""
        ...

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns a run at parameters (d,) of a space, with derivatives or not; or why it failed."""
        ...

    def errors(self, at: Array) -> Array:
        """Returns errors (r, m) [N] that the model says it has at parameters (d,), of one sd each."""
        ...


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


@dataclass(frozen=True)
class SurrogateForward:
    """A surrogate of a model that no reduced model stands for; it solves no mechanism."""

    surrogate: Surrogate
    spec: ModelSpec

    @property
    def hash(self) -> str:
        """A hash of the surrogate's training and of the model that it stands for."""
        return sha256_of([dict(self.surrogate.provenance), self.spec.hash])

    @property
    def solves(self) -> frozenset[str]:
        return frozenset()

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """The space is the surrogate's own."""
        force_n = self.surrogate.predict_mean(at)[0]
        return ModelRun(at, force_n, slopes(self.surrogate, at) if derive else None)

    def errors(self, at: Array) -> Array:
        """The columns of the factor of its error."""
        return np.asarray(self.surrogate.predict(at).factor[0].T)


def stands_for(spec: ModelSpec) -> bool:
    """Returns whether a device's reduced model stands for a full model: that of the reaction, on bricks."""
    return (spec.observation, spec.mesh) == ("reaction", "bricks")


def forward_model(file: Path, spec: ModelSpec, motion: PadMotion, edges_s: Array) -> ForwardModel:
    """Returns the model in a file: the reduced model where one stands for `spec`, else a surrogate."""
    if stands_for(spec):
        return ReducedForward(load_reduced(file), motion, edges_s)
    return SurrogateForward(load_surrogate(file), spec)


def change(space: ParameterSpace, theta: Array) -> Array:
    """Returns the change of each parameter (d,) along one coordinate of the prior's box."""
    unit, h = space.box.to_unit(theta), 1e-6
    return np.asarray((space.box.from_unit(unit + h) - space.box.from_unit(unit - h)) / (2.0 * h))


def slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Returns derivatives (m, d) of a surrogate's mean by coordinates of the box, by differences toward its
    middle."""
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -STEP, STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))
