"""A surrogate as a forward model, where no reduced model stands for the full one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ModelRun
from bayeskin.hashing import sha256_of
from bayeskin.mechanisms import Mechanism
from bayeskin.types import Array, ParameterSpace, Surrogate

STEP = 1e-4  # of the prior's box, for differences of a surrogate


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


def slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Returns derivatives (m, d) of a surrogate's mean by coordinates of the box, by differences toward its
    middle."""
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -STEP, STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))
