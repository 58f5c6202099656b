"""Predictions at points of which many agree in all that one part of a surrogate depends on.

Differences by one parameter and draws of one mechanism leave the others as they are: what depends on these
alone is predicted once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import Array, Prediction


def at_distinct(predict: Callable[[Array, Array], Prediction], theta: Array, also: Array) -> Prediction:
    """predict(theta, also), once for all rows of theta (n, d) that agree; `also` (n, ...) agrees with it."""
    first, place = _distinct(theta)
    if len(first) == len(theta):
        return predict(theta, also)
    found = predict(theta[first], also[first])
    rows = found.factor.transpose(0, 2, 1)  # as they lie in memory
    return Prediction(found.mean[place], rows[place].transpose(0, 2, 1), found.diagonal[place])


def mean_at_distinct(predict: Callable[[Array, Array], Array], theta: Array, also: Array) -> Array:
    """The same of a mean (n, m) alone."""
    first, place = _distinct(theta)
    return predict(theta, also) if len(first) == len(theta) else predict(theta[first], also[first])[place]


def _distinct(theta: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of rows (n, d): where each distinct one first stands, and for each row which of these it is (n,)."""
    _, first, place = np.unique(theta, axis=0, return_index=True, return_inverse=True)
    return first, place.reshape(-1)
