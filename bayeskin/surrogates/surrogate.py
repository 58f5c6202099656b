"""A trained surrogate: parameters to latents, latents to force, both with their own error."""

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
from bayeskin.types import Array, ParameterSpace, Prediction, _FreezesArrays

ROUNDING = 1e-12  # relative: a corner of the box computed as exp(log(corner)) still lies in it


class Latents(Protocol):
    """What predicts the latent vectors of `ShapeTransform`: Gaussian processes or chaos expansions."""

    @property
    def inputs(self) -> Array: ...

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance (n, q) at inputs (n, k), those of `Similarity` that matter."""
        ...

    def predict_mean(self, unit: Array) -> Array:
        """The mean (n, q) of `predict` alone."""
        ...

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance (n, q) of each training row given the others."""
        ...


@dataclass(frozen=True)
class ShapeSurrogate(_FreezesArrays):
    """Satisfies `types.Surrogate`: force as a scale times exp(amplitude) times a shape of predicted latents.

    `space` is the box in which it answers; edges_s (m+1,); active (k,) which of the inputs the latents see.
    """

    space: ParameterSpace
    edges_s: Array
    transform: ShapeTransform
    latents: Latents
    provenance: Mapping[str, Any]
    active: NDArray[np.int64]

    @cached_property
    def similarity(self) -> Similarity:
        """What makes inputs of parameters."""
        return Similarity(self.space)

    def inputs(self, theta: Array) -> Array:
        """What the latents see of theta (n, d), (n, k)."""
        return self.similarity.inputs(theta)[:, self.active]

    def predict(self, theta: ArrayLike) -> Prediction:
        """The force at theta (n, d) or (d,), with its uncertainty.

        Raises InputError that names the first parameter outside the box.
        """
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        mean, variance = self.latents.predict(self.inputs(theta))
        return self._decode(theta, mean, variance)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        latent = self.latents.predict_mean(self.inputs(theta))
        latent[:, 0] += self.similarity.log_scale(theta)
        return self.transform.decode_mean(latent)

    def leave_one_out(self, theta: Array) -> Prediction:
        """Force at the training rows, theta (n, d), as the others predict it; hyperparameters kept."""
        return self._decode(theta, *self.latents.leave_one_out())

    def _decode(self, theta: Array, mean: Array, variance: Array) -> Prediction:
        mean[:, 0] += self.similarity.log_scale(theta)
        return self.transform.decode(mean, np.sqrt(variance))


def refuse_outside(space: ParameterSpace, theta: Array) -> None:
    """Raises InputError unless every row of theta (n, d) lies in the closed box."""
    if theta.ndim != 2 or theta.shape[1] != space.dim:
        raise InputError("theta", f"shape {theta.shape}", f"(n, {space.dim}) for {', '.join(space.names)}")
    if np.all((theta >= space.lower) & (theta <= space.upper)):
        return
    lower = space.lower - ROUNDING * np.abs(space.lower)
    upper = space.upper + ROUNDING * np.abs(space.upper)
    outside = ~((theta >= lower) & (theta <= upper))  # also what is not a number
    if outside.any():
        row, column = np.argwhere(outside)[0]
        p = space.parameters[column]
        raise InputError(
            f"theta row {row}: {p.name}",
            f"{theta[row, column]:g} {p.unit}",
            f"{p.lower:g} to {p.upper:g}, the box that the surrogate was trained for",
        )
