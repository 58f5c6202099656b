"""A surrogate of the force as an instrument with mechanisms reports it.

Bins know only means. What mechanisms add is taken of a force that goes straight from one bin's middle to the
next, with a corner where the protocol has one, and added to the surrogate's means; of those that add the same
whatever the force is, that is exact. The surrogate's own error passes through unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.mechanisms import Mechanism, observed
from bayeskin.mechanisms.binned import BinnedForces
from bayeskin.mechanisms.mechanism import Instrument
from bayeskin.mismatch.distinct import at_distinct, mean_at_distinct
from bayeskin.mismatch.wrapper import Wrapper
from bayeskin.types import Array, PadMotion, ParameterSpace, Prediction


@dataclass(frozen=True)
class ObservedSurrogate(Wrapper):
    """The parameters of `inner`, then those of the instrument's `mechanisms`."""

    mechanisms: tuple[Mechanism, ...]
    motion: PadMotion

    @cached_property
    def space(self) -> ParameterSpace:
        """The parameters of the skin, then those of each mechanism."""
        more = tuple(p for mechanism in self.mechanisms for p in mechanism.parameters)
        return ParameterSpace((*self.inner.space.parameters, *more))

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.inner.provenance, "instrument": [m.name for m in self.mechanisms]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        skin, values = self._split(theta)
        found = at_distinct(lambda these, _: self.inner.predict(these), skin, skin)
        return Prediction(found.mean + self._added(values, found.mean), found.factor, found.diagonal)

    def predict_mean(self, theta: ArrayLike) -> Array:
        """The mean (n, m) of `predict` alone."""
        skin, values = self._split(theta)
        mean = mean_at_distinct(lambda these, _: self.inner.predict_mean(these), skin, skin)
        return mean + self._added(values, mean)

    def _split(self, theta: ArrayLike) -> tuple[Array, dict[str, Array]]:
        """The skin's parameters (n, k), and the instrument's by name, (n,) each."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        inner = self.inner.space.dim
        return theta[:, :inner], dict(zip(self.space.names[inner:], theta[:, inner:].T, strict=True))

    def _added(self, values: Mapping[str, Array], mean_n: Array) -> Array:
        """Returns what the mechanisms add to the bins' means (n, m)."""
        if all(isinstance(m.act, Instrument) and m.act.adds for m in self.mechanisms):
            seen = observed(
                self.mechanisms, values, self.motion, lambda t: np.zeros((len(mean_n), np.shape(t)[-1]))
            )
            return self._forces.bins.means(seen)
        return self._forces.change(partial(observed, self.mechanisms, values, self.motion), mean_n)

    @cached_property
    def _forces(self) -> BinnedForces:
        return BinnedForces(self.edges_s, self.motion, self.mechanisms)
