"""Computes Sobol' indices of the force over time: they show which parameters the force informs, and when.

The indices are those of a surrogate (`estimators`). Draws of the surrogate's error widen their intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayeskin.errors import InputError
from bayeskin.sensitivity.estimators import Function, pick_freeze, projection
from bayeskin.sensitivity.result import SobolResult, describe
from bayeskin.types import Array, ParameterSpace, Surrogate


@dataclass(frozen=True)
class ErrorDrawSettings:
    """Settings of the draws of a surrogate's error.

    draws : number of draws
    length : correlation length, as a share of the box's width; about the spacing of a hundred runs in five
        dimensions
    features : number of random Fourier features of a field
    """

    draws: int = 16
    length: float = 0.3
    features: int = 128


def sobol(
    surrogate: Surrogate,
    rng: np.random.Generator,
    samples: int = 2048,
    space: ParameterSpace | None = None,
    method: Literal["pick-freeze", "projection"] = "pick-freeze",
) -> SobolResult:
    """Returns the indices of a surrogate's force; the intervals include the surrogate's own error.

    `space` is the input distribution: the surrogate's box by default, or a narrower box inside it. `samples`
    is rounded up to a power of two. Raises InputError if `space` leaves the surrogate's box.
    """
    space = surrogate.space if space is None else space
    if space.names != surrogate.space.names or not surrogate.space.contains([space.lower, space.upper]).all():
        raise InputError(
            "sobol: space", f"it is {describe(space)}", f"it must be a box within {describe(surrogate.space)}"
        )
    draws = error_draws(surrogate, rng)
    estimate = pick_freeze if method == "pick-freeze" else projection
    return estimate(surrogate.predict_mean, space, surrogate.edges_s, rng, samples, draws)


def error_draws(
    surrogate: Surrogate, rng: np.random.Generator, settings: ErrorDrawSettings = ErrorDrawSettings()
) -> list[Function]:
    """Returns functions that differ from the surrogate's mean by random draws of its error.

    A draw multiplies each column of the predicted factor, and the root of the diagonal, by a smooth random
    field over the box. Each field is independent and has unit variance. The error is therefore a smooth
    function. Independent noise at each point would count as interaction. The fields have a Gaussian
    correlation over `length` of the box (random Fourier features, Rahimi & Recht 2007).
    """
    space, features = surrogate.space, settings.features
    rank = surrogate.predict(space.from_unit(np.full((1, space.dim), 0.5))).factor.shape[2]

    def draw() -> Function:
        waves = rng.normal(0.0, 1.0 / settings.length, (space.dim, (rank + 1) * features))
        shift = rng.uniform(0.0, 2.0 * np.pi, (rank + 1) * features)

        def function(theta: Array) -> Array:
            waved = np.cos(space.to_unit(theta) @ waves + shift).reshape(len(theta), rank + 1, features)
            field = waved.sum(axis=2) * np.sqrt(2 / features)
            prediction = surrogate.predict(theta)
            shifted = prediction.mean + np.matmul(prediction.factor, field[:, :rank, None])[:, :, 0]
            return np.asarray(shifted + field[:, rank:] * np.sqrt(prediction.diagonal))

        return function

    return [draw() for _ in range(settings.draws)]
