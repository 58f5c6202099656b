"""What each mechanism of a fit does to the force: with it, less without it, all else as it was fitted.

What has nothing to act on without a mechanism goes with it. Contributions need not add up: what mechanisms
do to each other counts for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.mechanisms import Mechanism, without_one
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


Force = Callable[[Sequence[str], Mapping[str, float]], Array | str]  # of a set at values: (m,)


def contributions(
    names: Sequence[str], theta: Mapping[str, float], force: Force, known: Mapping[str, Mechanism]
) -> list[Contribution]:
    """Of each mechanism of a set at its values, the largest first; none where a force cannot be had."""
    whole, parts = force(names, theta), []
    for name in names:
        rest = without_one(names, name, known)
        without = force(rest, theta)
        if not isinstance(whole, str) and not isinstance(without, str):
            along = tuple(other for other in names if other not in (name, *rest))
            parts.append(Contribution(name, along, whole - without))
    return sorted(parts, key=lambda part: -part.size_n)
