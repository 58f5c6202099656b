"""Extrapolates the unknowns in time by the polynomial through the last states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayeskin.types import Array

EXTRAPOLATION_POINTS = 3


def extrapolate(past: Sequence[tuple[float, Array]], time_s: float) -> Array:
    """Returns the unknowns (dofs,) at a later time, extrapolated from the past pairs of time and unknowns.

    The polynomial passes through the last three pairs, or through all if there are fewer.
    """
    last = past[-EXTRAPOLATION_POINTS:]
    weights = extrapolation_weights([time for time, _ in last], time_s)
    return np.asarray(sum(weight * x for weight, (_, x) in zip(weights, last, strict=True)))


def extrapolation_weights(times_s: Sequence[float], time_s: float) -> list[float]:
    """Returns the weights of the values at `times_s` in the Lagrange polynomial's value at another time."""
    return [
        float(np.prod([(time_s - other_s) / (node_s - other_s) for other_s in times_s if other_s != node_s]))
        for node_s in times_s
    ]
