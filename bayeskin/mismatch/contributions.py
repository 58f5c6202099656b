"""What each mechanism of a fit does to the force: with it, less without it, all else as it was fitted.

What has nothing to act on without a mechanism goes with it. Contributions need not add up: what mechanisms
do to each other counts for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayeskin.inference import LogPosterior
from bayeskin.mismatch.fit import Fit
from bayeskin.mismatch.search import ONLY_WITH, Build
from bayeskin.types import Array


@dataclass(frozen=True)
class Contribution:
    """One mechanism's part of the force (m,) [N] in all bins, and what was taken out along with it."""

    name: str
    along: tuple[str, ...]
    force_n: Array

    @property
    def size_n(self) -> float:
        """RMS over all bins [N]."""
        return float(np.sqrt(np.mean(self.force_n**2)))


def contributions(found: Fit, build: Build) -> list[Contribution]:
    """Of each mechanism of a fit, the largest first; forces are the surrogate's means."""
    whole, parts = _force(found.log_posterior, found.theta), []
    for name in found.names:
        along = tuple(other for other in found.names if ONLY_WITH.get(other) == name)
        without = build([other for other in found.names if other not in (name, *along)])
        parts.append(Contribution(name, along, whole - _force(without, found.theta)))
    return sorted(parts, key=lambda part: -part.size_n)


def _force(log_posterior: LogPosterior, theta: Mapping[str, float]) -> Array:
    """Mean force (m,) at the values that this posterior knows."""
    values = log_posterior.from_sampling(log_posterior.vector(theta))
    return np.asarray(log_posterior.predict(values).mean[0])
