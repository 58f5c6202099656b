"""Computes how much each mechanism of a fit contributes to the force.

A contribution is the force with the mechanism minus the force without it, with all other parameters at their
fitted values. Mechanisms that need the removed one are removed with it. Contributions need not add up to the
total effect, because an interaction of two mechanisms counts for each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bayeskin.mechanisms import Mechanism, without_one
from bayeskin.types import Array


@dataclass(frozen=True)
class Contribution:
    """The contribution (m,) [N] of one mechanism to the force in all bins.

    along : names of the mechanisms that were removed along with it, because they need it
    """

    name: str
    along: tuple[str, ...]
    force_n: Array

    @property
    def size_n(self) -> float:
        """Returns the RMS of the contribution over all bins [N]."""
        return float(np.sqrt(np.mean(self.force_n**2)))


# Returns the force (m,) [N] of a set at given values, or the message of a run that failed.
Force = Callable[[Sequence[str], Mapping[str, float]], Array | str]


def contributions(
    names: Sequence[str], theta: Mapping[str, float], force: Force, known: Mapping[str, Mechanism]
) -> list[Contribution]:
    """Returns the contribution of each mechanism of a set at given values, the largest first.

    A mechanism is left out where the run with or without it fails.
    """
    force_n, parts = force(names, theta), []
    for name in names:
        remaining = without_one(names, name, known)
        without_n = force(remaining, theta)
        if not isinstance(force_n, str) and not isinstance(without_n, str):
            along = tuple(removed for removed in names if removed not in (name, *remaining))
            parts.append(Contribution(name, along, force_n - without_n))
    return sorted(parts, key=lambda part: -part.size_n)
