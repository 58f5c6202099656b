"""What a mechanism is: physics that the base model leaves out, off at its neutral value.

Instrument mechanisms act on the force that comes out of the skin, sample by sample of a posterior: each
takes a force as a function of time and gives the force that the load cell then reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from bayeskin.types import Array, PadMotion, Parameter

Values = Mapping[str, Array]  # each parameter (n,), SI; those of all mechanisms that are on
ForceOfTime = Callable[[Array], Array]  # times (t,) or (n, t) [s] to forces (n, t) [N]
Observe = Callable[[Values, PadMotion, ForceOfTime], ForceOfTime]
GAUSS_POINTS = 4  # between neighbouring edges and corners


class Place(IntEnum):
    """Where in the instrument a mechanism acts, from the skin outward; it sees what those before it made."""

    DRIVE = 0
    CELL = 1
    CLOCK = 2


@dataclass(frozen=True)
class Mechanism:
    """One entry of the catalogue.

    parameters : SI, with priors; neutral : values of these that switch it off
    statement : one plain sentence from the parameters' values, for a report
    group : names of the look-alikes that one force channel cannot tell from it, its own among them
    """

    name: str
    parameters: tuple[Parameter, ...]
    neutral: Mapping[str, float]
    statement: Callable[[Mapping[str, float]], str]
    group: tuple[str, ...]
    place: Place
    observe: Observe


def observed(
    mechanisms: Iterable[Mechanism], values: Values, motion: PadMotion, force: ForceOfTime
) -> ForceOfTime:
    """The force that is reported when `mechanisms` act on `force`, whatever order they are given in."""
    for mechanism in sorted(mechanisms, key=lambda m: (m.place, m.name)):
        force = mechanism.observe(values, motion, force)
    return force


def added(force: ForceOfTime, more: ForceOfTime) -> ForceOfTime:
    """The sum of two forces."""
    return lambda time_s: np.asarray(force(time_s) + more(time_s))


def bin_means(force: ForceOfTime, motion: PadMotion, edges_s: Array) -> Array:
    """Means (n, m) of a force over the bins between edges_s (m+1,), exact between corners to high order."""
    inside = motion.time_s[(motion.time_s > edges_s[0]) & (motion.time_s < edges_s[-1])]
    cuts = np.union1d(edges_s, inside)
    abscissa, weight = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    width = np.diff(cuts)
    time_s = (cuts[:-1, None] + 0.5 * width[:, None] * (1.0 + abscissa)).ravel()
    found = force(time_s).reshape(-1, len(width), GAUSS_POINTS)
    integral = (found @ (0.5 * weight)) * width
    first = np.searchsorted(cuts, edges_s[:-1])
    return np.asarray(np.add.reduceat(integral, first, axis=1) / np.diff(edges_s))
