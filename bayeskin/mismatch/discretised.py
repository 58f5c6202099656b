"""A surrogate that allows for its model's mesh.

What a finer mesh would change is, within a tenth, a factor on the force; what that leaves goes with
displacement (docs/discretisation.md). Both are errors of the force at every point of the parameter space, so
they belong to the surrogate's factor: two columns of one sd each,

    a F(t)  and  b F(t) (2 d(t) / max d - 1) ,

F the predicted force and d the pads' displacement. Without them a fit takes the mesh for skin: intervals of
moduli come out as narrow as the noise alone lets them be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.types import Array, PadMotion, ParameterSpace, Prediction, Surrogate


@dataclass(frozen=True)
class Discretised:
    """Satisfies `types.Surrogate`: `skin` with its model's error, sd `amplitude` and `bend` of the force."""

    skin: Surrogate
    motion: PadMotion
    amplitude: float
    bend: float

    @property
    def space(self) -> ParameterSpace:
        return self.skin.space

    @property
    def edges_s(self) -> Array:
        return self.skin.edges_s

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.skin.provenance, "mesh_error": [self.amplitude, self.bend]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        found = self.skin.predict(theta)
        rows = found.factor.transpose(0, 2, 1)  # as they lie in memory
        more = found.mean[:, None, :] * self._shapes
        factor = np.concatenate([rows, more], axis=1).transpose(0, 2, 1)
        return Prediction(found.mean, factor, found.diagonal)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """That of `skin`."""
        return self.skin.predict_mean(theta)

    @cached_property
    def _shapes(self) -> Array:
        """Of both errors relative to the force, (2, m)."""
        middle = 0.5 * (self.edges_s[1:] + self.edges_s[:-1])
        share = self.motion.at(middle) / float(np.max(np.abs(self.motion.displacement_m)))
        return np.stack([np.full(len(middle), self.amplitude), self.bend * (2.0 * share - 1.0)])
