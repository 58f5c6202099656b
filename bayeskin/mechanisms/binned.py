"""What mechanisms do to a force of which only means over bins are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime, Mechanism, Tissue, bin_means
from bayeskin.types import Array, PadMotion


class StraightForce:
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


def change_of_bins(
    act: Callable[[ForceOfTime], ForceOfTime], motion: PadMotion, edges_s: Array, mean_n: Array
) -> Array:
    """What `act` adds to the bins' means (n, m) of a force."""
    force = StraightForce(edges_s, motion, mean_n)
    return bin_means(act(force), motion, edges_s) - bin_means(force, motion, edges_s)


@dataclass(frozen=True)
class BinnedEstimate:
    """A tissue mechanism's estimate of its effect, of bins' means: see `Tissue.estimate`.

    `own` names the parameters that are given; the mechanism's others are neutral.
    """

    mechanism: Mechanism
    own: tuple[str, ...]
    motion: PadMotion
    edges_s: Array

    def __call__(self, own: Array, mean_n: Array) -> Array:
        """What the mechanism adds (n, m), at its own parameters (n, k), to a force without it (n, m)."""
        act = self.mechanism.act
        assert isinstance(act, Tissue)
        assert act.estimate is not None
        neutral = {name: np.full(len(own), value) for name, value in self.mechanism.neutral.items()}
        values = {**neutral, **dict(zip(self.own, own.T, strict=True))}
        return change_of_bins(partial(act.estimate, values, self.motion), self.motion, self.edges_s, mean_n)


def estimate_of(
    mechanism: Mechanism, own: Sequence[str], motion: PadMotion, edges_s: Array
) -> BinnedEstimate | None:
    """None for a mechanism without an estimate."""
    if not isinstance(mechanism.act, Tissue) or mechanism.act.estimate is None:
        return None
    return BinnedEstimate(mechanism, tuple(own), motion, edges_s)
