"""The force of a skin near one run of a forward model, by the run's own derivatives.

Linear in the moduli, to which the force is all but proportional, and in the coordinates of the prior's box
for all other parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.types import Array, ParameterSpace, Prediction, _FreezesArrays


@dataclass(frozen=True)
class Tangent(_FreezesArrays):
    """Satisfies `types.Surrogate`, without an error of its own.

    theta (d,) of the run in SI; force_n (m,) its means over the bins between edges_s (m+1,); slopes_n (m, d)
    their derivatives by the coordinates of the prior's box [N].
    """

    space: ParameterSpace
    edges_s: Array
    theta: Array
    force_n: Array
    slopes_n: Array

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {"tangent_at": [float(value) for value in self.theta]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,)."""
        mean = self.predict_mean(theta)
        return Prediction(mean, np.zeros((*mean.shape, 1)), np.zeros(mean.shape))

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        change = self.space.box.to_unit(theta) - self._unit
        moduli = self._moduli
        ratio = theta[:, moduli] / self.theta[moduli] - 1.0
        change[:, moduli] = ratio / self._log_width
        return np.asarray(self.force_n + change @ self.slopes_n.T)

    @cached_property
    def _unit(self) -> Array:
        """The run's coordinates of the box, (d,)."""
        return np.asarray(self.space.box.to_unit(self.theta))

    @cached_property
    def _moduli(self) -> NDArray[np.intp]:
        """Columns of parameters to which the force is all but proportional."""
        known = enumerate(self.space.parameters)
        return np.array(
            [i for i, p in known if p.stress_power == 1 and p.in_log and p.offset == 0.0], dtype=np.intp
        )

    @cached_property
    def _log_width(self) -> Array:
        """Logarithms over which their priors extend."""
        return np.log(self.space.upper[self._moduli] / self.space.lower[self._moduli])
