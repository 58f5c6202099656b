"""Provides a surrogate that wraps another one, and functions that look inside wrapped surrogates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from bayeskin.mechanisms import catalogue
from bayeskin.types import Array, ParameterSpace, Prediction, Surrogate
from bayeskin.types.joint import plain_name


@dataclass(frozen=True)
class Wrapper:
    """A surrogate that delegates to `inner` everything that a subclass does not override.

    It satisfies `types.Surrogate`.
    """

    inner: Surrogate

    @property
    def space(self) -> ParameterSpace:
        return self.inner.space

    @property
    def edges_s(self) -> Array:
        return self.inner.edges_s

    @property
    def provenance(self) -> Mapping[str, Any]:
        return self.inner.provenance

    def predict(self, theta: ArrayLike) -> Prediction:
        """Returns the force at theta (n, d) or (d,). Raises InputError outside the box."""
        return self.inner.predict(theta)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """Returns only the mean (n, m) of `predict`."""
        return self.inner.predict_mean(theta)


def innermost(surrogate: Surrogate) -> Surrogate:
    """Returns the innermost surrogate, which predicts the force of the skin with the tissue's mechanisms."""
    while isinstance(surrogate, Wrapper):
        surrogate = surrogate.inner
    return surrogate


def skins(surrogate: Surrogate) -> tuple[int, ...]:
    """Returns the number of the skin's parameters, without and with those of tissue mechanisms.

    These are the first parameters of the surrogate. The result is a single number if the surrogate has no
    tissue mechanisms.
    """
    names = innermost(surrogate).space.names
    of_mechanisms = {p.name for mechanism in catalogue().values() for p in mechanism.parameters}
    of_base = sum(plain_name(name) not in of_mechanisms for name in names)
    return tuple(sorted({of_base, len(names)}))
