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

from bayeskin.mechanisms import Mechanism, bin_means, observed
from bayeskin.mechanisms.mechanism import Instrument
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
        adds = [m for m in self.mechanisms if isinstance(m.act, Instrument) and m.act.adds]
        if len(adds) == len(self.mechanisms):
            nothing = np.zeros((len(mean_n), 1))
            return bin_means(
                observed(adds, values, self.motion, lambda t: nothing + np.zeros(np.shape(t)[-1])),
                self.motion, self.edges_s,
            )  # fmt: skip
        force = _Straight(self.edges_s, self.motion, mean_n)
        seen = observed(self.mechanisms, values, self.motion, force)
        return bin_means(seen, self.motion, self.edges_s) - bin_means(force, self.motion, self.edges_s)


class _Straight:
    """Force over time, straight between the middles of bins (n, m) and the corners of the protocol.

    At a corner inside a bin the force follows from the straight lines on either side, and they meet halfway.
    """

    def __init__(self, edges_s: Array, motion: PadMotion, mean_n: Array) -> None:
        middle = 0.5 * (edges_s[1:] + edges_s[:-1])
        corners = motion.time_s[(motion.time_s > middle[2]) & (motion.time_s < middle[-3])]
        right = np.searchsorted(middle, corners)
        width = edges_s[1] - edges_s[0]
        kept = np.abs(middle[:, None] - corners).min(axis=1, initial=np.inf) > 0.5 * width
        before, after = (self._extended(middle, mean_n, right, corners, side) for side in (-1, 1))
        times = np.concatenate([middle[kept], corners])
        order = np.argsort(times)
        self._times = times[order]
        self._force = np.concatenate([mean_n[:, kept], 0.5 * (before + after)], axis=1)[:, order]

    @staticmethod
    def _extended(middle: Array, mean_n: Array, right: Array, corners: Array, side: int) -> Array:
        """Straight on from two middles at least a bin away on one side of each corner, (n, c)."""
        near = right + (1 if side > 0 else -2)
        far = near + side
        slope = (mean_n[:, far] - mean_n[:, near]) / (middle[far] - middle[near])
        return np.asarray(mean_n[:, near] + slope * (corners - middle[near]))

    def __call__(self, time_s: Array) -> Array:
        rows = np.broadcast_to(time_s, (len(self._force), np.shape(time_s)[-1]))
        left = np.clip(np.searchsorted(self._times, rows, side="right") - 1, 0, len(self._times) - 2)
        share = np.clip((rows - self._times[left]) / np.diff(self._times)[left], 0.0, 1.0)
        low, high = (np.take_along_axis(self._force, left + one, axis=1) for one in (0, 1))
        return np.asarray(low + share * (high - low))
