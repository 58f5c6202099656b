"""Uses a surrogate as a forward model, where no reduced model can replace the full model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.finite_element.simulate import ModelSpec
from bayeskin.forward.interface import ModelRun
from bayeskin.hashing import sha256_of
from bayeskin.inference.problem import FORCE_STEP
from bayeskin.mechanisms import Mechanism
from bayeskin.types import Array, ParameterSpace, Surrogate


@dataclass(frozen=True)
class SurrogateForward:
    """A surrogate of a model that no reduced model can replace. It solves no mechanism."""

    surrogate: Surrogate
    spec: ModelSpec

    @property
    def hash(self) -> str:
        """Returns a hash of the surrogate's training and of the model that it replaces."""
        return sha256_of([dict(self.surrogate.provenance), self.spec.hash])

    @property
    def solves(self) -> frozenset[str]:
        return frozenset()

    def run(
        self, space: ParameterSpace, at: Array, mechanisms: Sequence[Mechanism], derive: bool
    ) -> ModelRun | str:
        """Returns a run at parameters of the surrogate's own space, so `space` is not used."""
        force_n = self.surrogate.predict_mean(at)[0]
        return ModelRun(at, force_n, slopes(self.surrogate, at) if derive else None)

    def errors(self, at: Array) -> Array:
        """Returns the columns of the factor of the surrogate's error covariance, as rows (r, m) [N]."""
        return np.asarray(self.surrogate.predict(at).factor[0].T)


def slopes(surrogate: Surrogate, theta: Array) -> Array:
    """Returns derivatives (m, d) of a surrogate's mean by the coordinates of the box.

    They are one-sided differences toward the middle of the box.
    """
    box = surrogate.space.box
    unit = box.to_unit(theta)
    steps = np.diag(np.where(unit > 0.5, -FORCE_STEP, FORCE_STEP))
    rows = np.vstack([theta, np.clip(box.from_unit(unit + steps), box.lower, box.upper)])
    mean = surrogate.predict_mean(rows)
    return np.asarray((mean[1:] - mean[0]).T / np.diag(steps))
