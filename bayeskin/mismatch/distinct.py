"""Predicts only once for points that agree in all parameters on which a part of a surrogate depends.

Finite differences in one parameter, and draws of one mechanism's parameters, do not change the other
parameters. A part of a surrogate that depends only on unchanged parameters is then predicted once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bayeskin.types import Array, Prediction


def at_distinct(predict: Callable[[Array, Array], Prediction], theta: Array, also: Array) -> Prediction:
    """Returns predict(theta, also), computed once for all rows of theta (n, d) that are equal.

    also : further arguments (n, ...) of `predict`, which must be equal where the rows of theta are equal
    """
    first, place = _distinct(theta)
    if len(first) == len(theta):
        return predict(theta, also)
    distinct = predict(theta[first], also[first])
    rows = distinct.factor.transpose(0, 2, 1)  # the layout of the factor in memory
    return Prediction(distinct.mean[place], rows[place].transpose(0, 2, 1), distinct.diagonal[place])


def mean_at_distinct(predict: Callable[[Array, Array], Array], theta: Array, also: Array) -> Array:
    """Returns the same as `at_distinct` for a function that predicts only the mean (n, m)."""
    first, place = _distinct(theta)
    return predict(theta, also) if len(first) == len(theta) else predict(theta[first], also[first])[place]


def _distinct(theta: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the first index of each distinct row of theta (n, d), and the position of each row in them."""
    _, first, place = np.unique(theta, axis=0, return_index=True, return_inverse=True)
    return first, place.reshape(-1)
