"""Applies mechanisms to a force of which only the means over bins are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bayeskin.mechanisms.lines import interpolated
from bayeskin.mechanisms.mechanism import Bins, ForceOfTime, Mechanism
from bayeskin.types import Array, PadMotion


class BinnedForces:
    """Reconstructs forces over time from their bin means, and returns how mechanisms change these means.

    A force is linear between the middles of bins and the corners of the protocol. At a corner, the lines on
    both sides are extrapolated to it, and the force is the mean of the two values.
    bins : computes means over the same bins of forces on which `mechanisms` have acted
    """

    def __init__(self, edges_s: Array, motion: PadMotion, mechanisms: Sequence[Mechanism]) -> None:
        self.bins = Bins(motion, edges_s, mechanisms)
        self._middle = middle = 0.5 * (edges_s[1:] + edges_s[:-1])
        self._corners = motion.time_s[(motion.time_s > middle[2]) & (motion.time_s < middle[-3])]
        self._right = np.searchsorted(middle, self._corners)
        width = edges_s[1] - edges_s[0]
        self._kept = np.abs(middle[:, None] - self._corners).min(axis=1, initial=np.inf) > 0.5 * width
        times = np.concatenate([middle[self._kept], self._corners])
        self._order = np.argsort(times)
        self._times = times[self._order]

    def through(self, mean_n: Array) -> ForceOfTime:
        """Returns the force over time that is reconstructed from bin means (n, m)."""
        before, after = (self._extended(mean_n, side) for side in (-1, 1))
        force = np.concatenate([mean_n[:, self._kept], 0.5 * (before + after)], axis=1)[:, self._order]
        return lambda time_s: interpolated(self._times, force, time_s)

    def change(self, act: Callable[[ForceOfTime], ForceOfTime], mean_n: Array) -> Array:
        """Returns what `act` adds to the bins' means (n, m) of a force."""
        force = self.through(mean_n)
        return self.bins.means(act(force)) - self.bins.means(force)

    def _extended(self, mean_n: Array, side: int) -> Array:
        """Returns the force (n, c) at each corner, extrapolated from one side: -1 before it, 1 after it.

        The line goes through two bin middles that are at least a bin away from the corner.
        """
        near = self._right + (1 if side > 0 else -2)
        far, middle = near + side, self._middle
        slope = (mean_n[:, far] - mean_n[:, near]) / (middle[far] - middle[near])
        return np.asarray(mean_n[:, near] + slope * (self._corners - middle[near]))
