"""A trained surrogate: parameters to latents, latents to force, both with their own error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.errors import InputError
from bayeskin.surrogates.shapes import ShapeTransform
from bayeskin.types import Array, ParameterSpace, Prediction, _FreezesArrays

ROUNDING = 1e-12  # relative: a corner of the box computed as exp(log(corner)) still lies in it


class Latents(Protocol):
    """What predicts the latent vectors of `ShapeTransform`: Gaussian processes or chaos expansions."""

    @property
    def inputs(self) -> Array: ...

    def predict(self, unit: Array) -> tuple[Array, Array]:
        """Mean and variance (n, q) at unit-cube points (n, d)."""
        ...

    def leave_one_out(self) -> tuple[Array, Array]:
        """Mean and variance (n, q) of each training row given the others."""
        ...


@dataclass(frozen=True)
class ShapeSurrogate(_FreezesArrays):
    """Satisfies `types.Surrogate`: force as exp(amplitude) times a shape, whose latents are predicted.

    `space` is the box in which it answers; edges_s (m+1,).
    """

    space: ParameterSpace
    edges_s: Array
    transform: ShapeTransform
    latents: Latents
    provenance: Mapping[str, Any]

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,), with its uncertainty.

        Raises InputError that names the first parameter outside the box.
        """
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        refuse_outside(self.space, theta)
        mean, variance = self.latents.predict(self.space.to_unit(theta))
        return self.transform.decode(mean, np.sqrt(variance))

    def leave_one_out(self) -> Prediction:
        """Force at each training row as the other rows predict it (hyperparameters or terms kept)."""
        mean, variance = self.latents.leave_one_out()
        return self.transform.decode(mean, np.sqrt(variance))


def refuse_outside(space: ParameterSpace, theta: Array) -> None:
    """Raises InputError unless every row of theta (n, d) lies in the closed box."""
    if theta.ndim != 2 or theta.shape[1] != space.dim:
        raise InputError("theta", f"shape {theta.shape}", f"(n, {space.dim}) for {', '.join(space.names)}")
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
