"""Defines the trained surrogate, which predicts latents, and from them the force, each with its error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayeskin.errors import InputError
from bayeskin.surrogates.shapes import ShapeTransform
from bayeskin.surrogates.similarity import Similarity
from bayeskin.types import Array, FreezesArrays, ParameterSpace, Prediction

ROUNDING = 1e-12  # relative tolerance, so that a corner computed as exp(log(corner)) lies in the box


class Latents(Protocol):
    """Predicts the latent vectors of `ShapeTransform`, by Gaussian processes or chaos expansions."""

    @property
    def inputs(self) -> Array: ...

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) at the active inputs (n, k) of `Similarity`."""
        ...

    def predict_mean(self, unit: Array) -> Array:
        """Returns only the mean (n, q) of `predict`."""
        ...

    def leave_one_out(self) -> tuple[Array, Array]:
        """Returns the mean and the variance (n, q) of each training row given the other rows."""
        ...


@dataclass(frozen=True)
class ShapeSurrogate(FreezesArrays):
    """Predicts the force as a scale times exp(amplitude) times a shape; implements `types.Surrogate`.

    The latents give the amplitude and the shape.

    space : the box in which the surrogate predicts
    edges_s : (m+1,) edges of the bins [s]
    active : (k,) indices of the inputs that the latents use
    """

    space: ParameterSpace
    edges_s: Array
    transform: ShapeTransform
    latents: Latents
    provenance: Mapping[str, Any]
    active: NDArray[np.int64]

    @cached_property
    def similarity(self) -> Similarity:
        """Returns the similarity law, which converts parameters to inputs."""
        return Similarity(self.space)

    def inputs(self, theta: Array) -> Array:
        """Returns the inputs (n, k) that the latents use, for theta (n, d)."""
        return self.similarity.inputs(theta)[:, self.active]

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d) or (d,), with its uncertainty.

        Raises an InputError that names the first parameter outside the box.
        """
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        mean, variance = self.latents.predict(self.inputs(theta))
        return self._decode(theta, mean, variance)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        latent = self.latents.predict_mean(self.inputs(theta))
        latent[:, 0] += self.similarity.log_scale(theta)
        return self.transform.decode_mean(latent)

    def leave_one_out(self, theta: Array) -> Prediction:
        """Returns the force at the training rows, theta (n, d), each predicted from the other rows.

        The hyperparameters stay fixed.
        """
        return self._decode(theta, *self.latents.leave_one_out())

    def _decode(self, theta: Array, mean: Array, variance: Array) -> Prediction:
        mean[:, 0] += self.similarity.log_scale(theta)
        return self.transform.decode(mean, np.sqrt(variance))


def refuse_outside(space: ParameterSpace, theta: Array) -> None:
    """Raises InputError unless every row of theta (n, d) lies in the closed box."""
    if theta.ndim != 2 or theta.shape[1] != space.dim:
        raise InputError(
            "theta",
            f"the shape is {theta.shape}",
            f"it must be (n, {space.dim}) for {', '.join(space.names)}",
        )
    if np.all((theta >= space.lower) & (theta <= space.upper)):
        return
    lower = space.lower - ROUNDING * np.abs(space.lower)
    upper = space.upper + ROUNDING * np.abs(space.upper)
    outside = ~((theta >= lower) & (theta <= upper))  # NaN counts as outside
    if outside.any():
        row, column = np.argwhere(outside)[0]
        p = space.parameters[column]
        raise InputError(
            f"theta row {row}: {p.name}",
            f"it is {theta[row, column]:g} {p.unit}",
            f"it must lie within {p.lower:g} to {p.upper:g}, the box that the surrogate was trained for",
        )
