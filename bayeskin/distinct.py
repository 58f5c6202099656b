"""Predictions at points of which many agree in all that one part of a surrogate depends on.

Differences by one parameter and draws of one mechanism leave the others as they are: what depends on these
alone is predicted once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayeskin.types import Array, Prediction


def at_distinct(predict: Callable[[Array, Array], Prediction], theta: Array, also: Array) -> Prediction:
    """predict(theta, also), once for all rows of theta (n, d) that agree; `also` (n, ...) agrees with it."""
    _, first, place = np.unique(theta, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(theta):
        return predict(theta, also)
    found, place = predict(theta[first], also[first]), place.reshape(-1)
    rows = found.factor.transpose(0, 2, 1)  # as they lie in memory
    return Prediction(found.mean[place], rows[place].transpose(0, 2, 1), found.diagonal[place])
