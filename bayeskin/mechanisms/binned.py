"""What mechanisms do to a force of which only means over bins are known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from bayeskin.mechanisms.lines import interpolated
from bayeskin.mechanisms.mechanism import Bins, ForceOfTime, Mechanism
from bayeskin.types import Array, PadMotion


class BinnedForces:
    """Forces over time, straight between the middles of bins and the corners of the protocol.

    At a corner inside a bin the force follows from the straight lines on either side, and they meet halfway.
    bins : takes means over the same bins, of what `mechanisms` make of a force
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
        """The force of bins' means (n, m)."""
        before, after = (self._extended(mean_n, side) for side in (-1, 1))
        force = np.concatenate([mean_n[:, self._kept], 0.5 * (before + after)], axis=1)[:, self._order]
        return lambda time_s: interpolated(self._times, force, time_s)

    def change(self, act: Callable[[ForceOfTime], ForceOfTime], mean_n: Array) -> Array:
        """What `act` adds to the bins' means (n, m) of a force."""
        force = self.through(mean_n)
        return self.bins.means(act(force)) - self.bins.means(force)

    def _extended(self, mean_n: Array, side: int) -> Array:
        """Straight on from two middles at least a bin away on one side of each corner, (n, c)."""
        near = self._right + (1 if side > 0 else -2)
        far, middle = near + side, self._middle
        slope = (mean_n[:, far] - mean_n[:, near]) / (middle[far] - middle[near])
        return np.asarray(mean_n[:, near] + slope * (self._corners - middle[near]))


@dataclass(frozen=True)
class BinnedEstimate:
    """A mechanism's estimate of its effect, of bins' means: see `Mechanism.estimate`.

    `own` names the parameters that are given; the mechanism's others are neutral.
    """

    mechanism: Mechanism
    own: tuple[str, ...]
    motion: PadMotion
    edges_s: Array

    def __call__(self, own: Array, mean_n: Array) -> Array:
        """What the mechanism adds (n, m), at its own parameters (n, k), to a force without it (n, m)."""
        estimate = self.mechanism.estimate
        assert estimate is not None
        neutral = {name: np.full(len(own), value) for name, value in self.mechanism.neutral.items()}
        values = {**neutral, **dict(zip(self.own, own.T, strict=True))}
        return self._forces.change(partial(estimate, values, self.motion), mean_n)

    @cached_property
    def _forces(self) -> BinnedForces:
        return BinnedForces(self.edges_s, self.motion, [self.mechanism])


def estimate_of(
    mechanisms: Sequence[Mechanism], own: Sequence[str], motion: PadMotion, edges_s: Array
) -> BinnedEstimate | None:
    """None for a mechanism without an estimate, and for what two do beyond both."""
    mechanism = mechanisms[0]
    if len(mechanisms) > 1 or mechanism.estimate is None:
        return None
    return BinnedEstimate(mechanism, tuple(own), motion, edges_s)


def estimates_by_name(
    known: Mapping[str, Mechanism], motion: PadMotion
) -> Callable[[Sequence[str], Sequence[str], Array], BinnedEstimate | None]:
    """`estimate_of` by names of mechanisms, names of their own parameters, and edges of bins."""
    return lambda names, own, edges_s: estimate_of([known[name] for name in names], own, motion, edges_s)
