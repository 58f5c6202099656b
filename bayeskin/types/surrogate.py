"""The interface of a model that inference uses, and the force that it predicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.types.arrays import Array
from bayeskin.types.parameters import ParameterSpace

POINTS_AT_ONCE = 256  # number of points of a `Prediction`, whose factor then takes a few tens of MB


@dataclass(frozen=True)
class Prediction:
    """The force at n points with its uncertainty, as a low-rank Gaussian.

    mean : (n, m) [N]
    factor : (n, m, r) [N]
    diagonal : (n, m) [N^2]

    The covariance at point i is ``factor[i] @ factor[i].T + diag(diagonal[i])``. A factor whose bins are
    adjacent in memory, which is the transposed view of an (n, r, m) array, is used without a copy.
    """

    mean: Array
    factor: Array
    diagonal: Array

    def sd(self) -> Array:
        """Returns the standard deviation of each bin, (n, m) [N]."""
        return np.sqrt(np.einsum("nmr,nmr->nm", self.factor, self.factor) + self.diagonal)

    def of_bins(self, bins: slice) -> Prediction:
        """Returns the force in some of the bins."""
        return Prediction(self.mean[:, bins], self.factor[:, bins], self.diagonal[:, bins])


@runtime_checkable
class Surrogate(Protocol):
    """All that inference and sensitivity analysis need of a model: its box, its bins and its predictions."""

    @property
    def space(self) -> ParameterSpace:
        """Returns the parameters with their bounds."""
        ...

    @property
    def edges_s(self) -> Array:
        """Returns the edges of the bins, (m+1,)."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Returns the origin of the surrogate, as plain values."""
        ...

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d), vectorised. Raises InputError outside the box."""
        ...

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`, which may be faster."""
        ...
