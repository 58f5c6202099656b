"""A posterior on a thin, curved ridge, whose moments are known in closed form."""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from bayeskin.types import Array, Parameter, ParameterSpace

THIN = 0.1
NAMES = ("a", "b", "c", "d", "e", "f")
# b is about a^2 - 1 and c about a^3 / 3, within THIN; the others are independent.
MEAN = np.zeros(6)
VARIANCE = np.array([1.0, 2.0 + THIN**2, 15.0 / 9.0 + THIN**2, 1.0, 1.0, 1.0])


class Banana:
    """A posterior with all that `sample` needs: unit normal a, d, e and f, and a ridge."""

    low = np.array([-5.0, -3.0, -40.0, -8.0, -8.0, -8.0])
    high = np.array([5.0, 26.0, 40.0, 8.0, 8.0, 8.0])
    names, dim, bounds = NAMES, 6, (low, high)
    identity: ClassVar = {"posterior": "banana"}
    space = ParameterSpace(
        tuple(Parameter(n, "1", a, b, "uniform") for n, a, b in zip(NAMES, low, high, strict=True))
    )
    surrogate = SimpleNamespace(space=ParameterSpace(space.parameters[:4]))
    chain = SimpleNamespace(force_n=np.ones(1), bins=np.zeros(1, dtype=int))

    def log_prob(self, vectors: Array) -> Array:
        a, b, c, d, e, f = vectors.T
        ridge = ((b - a**2 + 1.0) / THIN) ** 2 + ((c - a**3 / 3.0) / THIN) ** 2
        inside = np.all((vectors >= self.low) & (vectors <= self.high), axis=1)
        return np.where(inside, -0.5 * (a**2 + d**2 + e**2 + f**2 + ridge), -np.inf)

    def predict_mean(self, theta: Array) -> Array:
        """No force, so that nothing is straightened."""
        return np.zeros((len(theta), 1))

    def vector(self, theta: dict[str, float]) -> Array:
        return np.array([theta[name] for name in NAMES])

    def from_sampling(self, vectors: Array) -> Array:
        return np.asarray(vectors)
