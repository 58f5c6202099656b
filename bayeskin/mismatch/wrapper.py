"""A surrogate about another: what is not said anew is the inner one's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from bayeskin.mechanisms import catalogue
from bayeskin.types import Array, ParameterSpace, Prediction, Surrogate


@dataclass(frozen=True)
class Wrapper:
    """Satisfies `types.Surrogate`."""

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
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        return self.inner.predict(theta)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        return self.inner.predict_mean(theta)


def innermost(surrogate: Surrogate) -> Surrogate:
    """Returns the surrogate of the skin and of what changes it: the one that is about no other."""
    while isinstance(surrogate, Wrapper):
        surrogate = surrogate.inner
    return surrogate


def skins(surrogate: Surrogate) -> tuple[int, ...]:
    """Returns how many of the first parameters are the skin's, without and with mechanisms of the tissue."""
    names = innermost(surrogate).space.names
    of_mechanisms = {p.name for mechanism in catalogue().values() for p in mechanism.parameters}
    return tuple(sorted({sum(name not in of_mechanisms for name in names), len(names)}))
