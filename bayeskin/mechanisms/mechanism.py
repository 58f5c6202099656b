"""What a mechanism is: physics that the base model leaves out, off at its neutral value.

Tissue mechanisms change the model's equations (`bayeskin.model.tissue`). Instrument mechanisms act on the
force that comes out of the skin, sample by sample of a posterior: each takes a force as a function of time
and gives the one that the load cell then reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

import numpy as np

from bayeskin.model.problem import Problem
from bayeskin.model.tissue import Bind, TissueLaw
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
class Instrument:
    """What an instrument mechanism does to a force."""

    place: Place
    observe: Observe


@dataclass(frozen=True)
class Tissue:
    """What a tissue mechanism does to the model: `bind` takes the values of its parameters and a problem."""

    bind: Callable[[Mapping[str, float], Problem], TissueLaw]


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
    act: Instrument | Tissue


def observed(
    mechanisms: Iterable[Mechanism], values: Values, motion: PadMotion, force: ForceOfTime
) -> ForceOfTime:
    """The force that is reported when the instrument's among `mechanisms` act on it, in any order given."""
    acts = [(m.act.place, m.name, m.act) for m in mechanisms if isinstance(m.act, Instrument)]
    for _, _, act in sorted(acts, key=lambda one: one[:2]):
        force = act.observe(values, motion, force)
    return force


def laws(mechanisms: Iterable[Mechanism], values: Mapping[str, float]) -> list[Bind]:
    """What `simulate` is given for the tissue's among `mechanisms`."""
    return [partial(m.act.bind, values) for m in mechanisms if isinstance(m.act, Tissue)]


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
