"""A mechanism is physics that the base model leaves out, off at its neutral value.

Tissue mechanisms change the model's equations (`bayeskin.finite_element.tissue`). Instrument mechanisms act
on the force that comes out of the skin, sample by sample of a posterior: each takes a force as a function of
time and gives the one that the load cell then reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bayeskin.finite_element.tissue import Bind
from bayeskin.mechanisms.lines import bin_integrals
from bayeskin.types import Array, Jumps, PadMotion, Parameter

Values = Mapping[str, Array]  # each parameter (n,), SI; those of all mechanisms that are on
ForceOfTime = Callable[[Array], Array]  # times (t,) or (n, t) [s] to forces (n, t) [N]
Observe = Callable[[Values, PadMotion, ForceOfTime], ForceOfTime]
Refuted = Callable[[Values, PadMotion, Jumps], NDArray[np.bool_]]
GAUSS_POINTS = 4  # between neighbouring edges, corners and repeats
SETTLING = np.array([3.0, 12.0])  # time constants after a corner at which bins are cut


class Place(IntEnum):
    """The place in the instrument where a mechanism acts, from the skin outward.

    A mechanism sees what those before it made.
    """

    PADS = 0
    ARM = 1  # under the pads; what these lose goes by the force without its swings
    DRIVE = 2
    CELL = 3
    AMPLIFIER = 4
    CLOCK = 5


@dataclass(frozen=True)
class Instrument:
    """The action of an instrument mechanism on a force.

    bind : set where it changes the displacement that the skin sees: the full model solves it along, and
        `observe` is its shortcut for the force of a surrogate
    adds : whether what it adds to a force does not depend on that force
    refuted : which values the samples of a recording speak against, by what they allow of jumps; None where
        they cannot
    repeats_m, repeats_s : the shortest travel [m], or time [s], after which what it does comes again,
        infinite where nothing does
    settles_s : the shortest time constant [s] with which its response to a corner fades, infinite without any
    """

    place: Place
    observe: Observe
    bind: Bind | None = None
    adds: bool = True
    refuted: Refuted | None = None
    repeats_m: float = np.inf
    repeats_s: float = np.inf
    settles_s: float = np.inf


@dataclass(frozen=True)
class Tissue:
    """The action of a tissue mechanism on the full model."""

    bind: Bind


@dataclass(frozen=True)
class Mechanism:
    """One entry of the catalogue.

    parameters : SI, with priors; neutral : values of these that switch it off
    statement : one plain sentence from the parameters' values, for a report
    group : names of the look-alikes that one force channel cannot tell from it, its own among them
    parts : names of parameters that act by themselves, the first of each part the one that switches it on;
        () is one part of all
    needs : names of mechanisms without which it does nothing
    """

    name: str
    parameters: tuple[Parameter, ...]
    neutral: Mapping[str, float]
    statement: Callable[[Mapping[str, float]], str]
    group: tuple[str, ...]
    act: Instrument | Tissue
    parts: tuple[tuple[str, ...], ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def whole_or_parts(self) -> tuple[tuple[str, ...], ...]:
        """`parts`, or the one part of all parameters."""
        return self.parts or (tuple(p.name for p in self.parameters),)


def with_one(names: Iterable[str], name: str, known: Mapping[str, Mechanism]) -> tuple[str, ...]:
    """A set with one mechanism more, and those that it needs."""
    return tuple(sorted({*names, name, *known[name].needs}))


def without_one(names: Iterable[str], name: str, known: Mapping[str, Mechanism]) -> tuple[str, ...]:
    """A set with one mechanism fewer, and without those that need it."""
    return tuple(other for other in names if other != name and name not in known[other].needs)


def observed(
    mechanisms: Iterable[Mechanism], values: Values, motion: PadMotion, force: ForceOfTime
) -> ForceOfTime:
    """The force that is reported when the instrument's among `mechanisms` act on it, in any order given."""
    acts = [(m.act.place, m.name, m.act) for m in mechanisms if isinstance(m.act, Instrument)]
    for _, _, act in sorted(acts, key=lambda one: one[:2]):
        force = act.observe(values, motion, force)
    return force


def solved(mechanisms: Iterable[Mechanism]) -> list[Mechanism]:
    """Those that the full model solves; what is left acts on its force."""
    return [m for m in mechanisms if m.act.bind is not None]


def laws(mechanisms: Iterable[Mechanism]) -> list[Bind]:
    """Returns the laws that `simulate` is given for `mechanisms`."""
    return [m.act.bind for m in mechanisms if m.act.bind is not None]


def added(force: ForceOfTime, more: ForceOfTime) -> ForceOfTime:
    """The sum of two forces."""
    return lambda time_s: np.asarray(force(time_s) + more(time_s))


class Bins:
    """Means of forces over the bins between edges_s (m+1,), exact to high order between corners.

    Of forces that `mechanisms` made, whatever repeats over the travel or time, or settles after a corner, is
    followed too.
    """

    def __init__(self, motion: PadMotion, edges_s: Array, mechanisms: Iterable[Mechanism] = ()) -> None:
        acts = [m.act for m in mechanisms if isinstance(m.act, Instrument)]
        settles_s = min((act.settles_s for act in acts), default=np.inf)
        repeats_m = min((act.repeats_m for act in acts), default=np.inf)
        repeats_s = min((act.repeats_s for act in acts), default=np.inf)
        inside = np.union1d(motion.time_s, motion.time_s[:, None] + settles_s * SETTLING)
        inside = inside[(inside > edges_s[0]) & (inside < edges_s[-1])]
        cuts = _no_longer(np.union1d(edges_s, inside), motion, repeats_m, repeats_s)
        abscissa, weight = np.polynomial.legendre.leggauss(GAUSS_POINTS)
        self._width, self._weight, self._lasts_s = np.diff(cuts), 0.5 * weight, np.diff(edges_s)
        self._time_s = (cuts[:-1, None] + 0.5 * self._width[:, None] * (1.0 + abscissa)).ravel()
        self._first = np.searchsorted(cuts, edges_s)

    def means(self, force: ForceOfTime) -> Array:
        """Returns the means of a force over the bins, (n, m)."""
        found = np.ascontiguousarray(force(self._time_s)).reshape(-1, len(self._width), GAUSS_POINTS)
        integral = np.empty((len(found), len(self._lasts_s)))
        bin_integrals(found, self._weight, self._width, self._first, integral)
        integral /= self._lasts_s
        return integral


def bin_means(
    force: ForceOfTime, motion: PadMotion, edges_s: Array, mechanisms: Iterable[Mechanism] = ()
) -> Array:
    """Means (n, m), over the bins between edges_s (m+1,), of one force only, which `mechanisms` made."""
    return Bins(motion, edges_s, mechanisms).means(force)


def _no_longer(cuts: Array, motion: PadMotion, travel_m: float, lasts_s: float) -> Array:
    """Times between which the pads move by `travel_m` or less and `lasts_s` pass or less, those of `cuts`
    among them."""
    longest = np.maximum(np.abs(np.diff(motion.at(cuts))) / travel_m, np.diff(cuts) / lasts_s)
    parts = np.ceil(longest).astype(int).clip(1)
    pieces = zip(cuts[:-1], cuts[1:], parts, strict=True)
    return np.append(np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in pieces]), cuts[-1])
