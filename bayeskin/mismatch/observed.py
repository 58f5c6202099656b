"""A surrogate of the force as an instrument with mechanisms reports it.

Bins know only means. What mechanisms add is taken of a force that goes straight from one bin's middle to the
next, with a corner where the protocol has one, and added to the surrogate's means; of those that add the same
whatever the force is, that is exact. The surrogate's own error passes through unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.mechanisms import Bins, Mechanism, observed
from bayeskin.mechanisms.lines import interpolated
from bayeskin.mechanisms.mechanism import ForceOfTime, Instrument
from bayeskin.types import Array, PadMotion, ParameterSpace, Prediction, Surrogate


@dataclass(frozen=True)
class ObservedSurrogate:
    """Satisfies `types.Surrogate`: `skin`'s parameters, then those of the instrument's `mechanisms`."""

    skin: Surrogate
    mechanisms: tuple[Mechanism, ...]
    motion: PadMotion

    @property
    def edges_s(self) -> Array:
        return self.skin.edges_s

    @cached_property
    def space(self) -> ParameterSpace:
        """Of the skin, then of each mechanism."""
        more = tuple(p for mechanism in self.mechanisms for p in mechanism.parameters)
        return ParameterSpace((*self.skin.space.parameters, *more))

    @property
    def provenance(self) -> Mapping[str, Any]:
        return {**self.skin.provenance, "instrument": [m.name for m in self.mechanisms]}

    def predict(self, theta: ArrayLike) -> Prediction:
        """Force at theta (n, d) or (d,). Raises InputError outside the box."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        inner = self.skin.space.dim
        found = self.skin.predict(theta[:, :inner])
        values = dict(zip(self.space.names[inner:], theta[:, inner:].T, strict=True))
        return Prediction(found.mean + self._added(values, found.mean), found.factor, found.diagonal)

    def _added(self, values: Mapping[str, Array], mean_n: Array) -> Array:
        """What the mechanisms add to the bins' means (n, m)."""
        if all(isinstance(m.act, Instrument) and m.act.adds for m in self.mechanisms):
            seen = observed(
                self.mechanisms, values, self.motion, lambda t: np.zeros((len(mean_n), np.shape(t)[-1]))
            )
            return self._bins.means(seen)
        force = self._straight.through(mean_n)
        seen = observed(self.mechanisms, values, self.motion, force)
        return self._bins.means(seen) - self._bins.means(force)

    @cached_property
    def _bins(self) -> Bins:
        return Bins(self.motion, self.edges_s)

    @cached_property
    def _straight(self) -> _Straight:
        return _Straight(self.edges_s, self.motion)


class _Straight:
    """Forces over time, straight between the middles of bins and the corners of the protocol.

    At a corner inside a bin the force follows from the straight lines on either side, and they meet halfway.
    """

    def __init__(self, edges_s: Array, motion: PadMotion) -> None:
        self._middle = middle = 0.5 * (edges_s[1:] + edges_s[:-1])
        self._corners = motion.time_s[(motion.time_s > middle[2]) & (motion.time_s < middle[-3])]
        self._right = np.searchsorted(middle, self._corners)
        width = edges_s[1] - edges_s[0]
        self._kept = np.abs(middle[:, None] - self._corners).min(axis=1, initial=np.inf) > 0.5 * width
        times = np.concatenate([middle[self._kept], self._corners])
        self._order = np.argsort(times)
        self._times = times[self._order]

    def through(self, mean_n: Array) -> ForceOfTime:
        """The force of bins' means (n, m)."""
        before, after = (self._extended(mean_n, side) for side in (-1, 1))
        force = np.concatenate([mean_n[:, self._kept], 0.5 * (before + after)], axis=1)[:, self._order]
        return lambda time_s: interpolated(self._times, force, time_s)

    def _extended(self, mean_n: Array, side: int) -> Array:
        """Straight on from two middles at least a bin away on one side of each corner, (n, c)."""
        near = self._right + (1 if side > 0 else -2)
        far, middle = near + side, self._middle
        slope = (mean_n[:, far] - mean_n[:, near]) / (middle[far] - middle[near])
        return np.asarray(mean_n[:, near] + slope * (self._corners - middle[near]))
