"""Defines a mechanism: physics that the base model leaves out, and that is off at its neutral value.

Tissue mechanisms change the model's equations (`bayeskin.finite_element.tissue`). Instrument mechanisms act
on the force of the skin, for each sample of a posterior. Each takes a force as a function of time and returns
the force that the load cell then reports.
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

Values = Mapping[str, Array]  # (n,) of each parameter of all active mechanisms, SI
ForceOfTime = Callable[[Array], Array]  # maps times (t,) or (n, t) [s] to forces (n, t) [N]
Observe = Callable[[Values, PadMotion, ForceOfTime], ForceOfTime]
Refuted = Callable[[Values, PadMotion, Jumps], NDArray[np.bool_]]
GAUSS_POINTS = 4  # number in each interval between neighbouring bin edges, corners and repeats
SETTLING = np.array([3.0, 12.0])  # bins are divided at these multiples of the time constant after a corner


class Place(IntEnum):
    """The place in the instrument where a mechanism acts, in order from the skin outward.

    A mechanism acts on the force that results from the mechanisms before it.
    """

    PADS = 0
    # The arm acts after the pads, so what the pads lose depends on the force without the swings of the arm.
    ARM = 1
    DRIVE = 2
    CELL = 3
    AMPLIFIER = 4
    CLOCK = 5


@dataclass(frozen=True)
class Instrument:
    """The action of an instrument mechanism on a force.

    place : where in the instrument it acts
    observe : returns the force as a function of time after the mechanism has acted on it
    bind : the law of a mechanism that changes the displacement of the skin, otherwise None. The full model
        solves this law together with the skin; `observe` is then a shortcut for the force of a surrogate
    adds : True if the force that it adds does not depend on the force on which it acts
    refuted : returns which values contradict the samples of a recording, given the jumps that these samples
        allow; None if samples cannot contradict the mechanism
    repeats_m, repeats_s : the shortest travel [m], or time [s], after which its effect repeats; infinite if
        it does not repeat
    settles_s : the shortest time constant [s] with which its response to a corner decays; infinite if it has
        no such response
    of_skin : True for a property of the skin or the arm, which several recordings of one skin share; the
        properties of an instrument may differ between them
    """

    place: Place
    observe: Observe
    bind: Bind | None = None
    adds: bool = True
    refuted: Refuted | None = None
    repeats_m: float = np.inf
    repeats_s: float = np.inf
    settles_s: float = np.inf
    of_skin: bool = False


@dataclass(frozen=True)
class Tissue:
    """The action of a tissue mechanism on the full model."""

    bind: Bind


@dataclass(frozen=True)
class Mechanism:
    """One entry of the catalogue.

    parameters : its parameters in SI units, with priors
    neutral : values of these parameters that switch it off. Parameters that it does not name, because their
        value makes no difference then, get the median of their prior in the catalogue
    statement : returns one plain sentence for a report, from the parameters' values
    look_alikes : names of mechanisms that one force channel cannot tell apart from it. One entry of a pair
        states the other; the catalogue completes both
    also_possible : names of mechanisms that may be the true one where this one is named, although this one is
        hardly the truth where they are named
    parts : groups of parameters, by name, that act without the others. The first parameter of each part
        switches it on. () means that all parameters form one part
    act : its action, on the force or on the full model
    needs : names of mechanisms without which it has no effect
    """

    name: str
    parameters: tuple[Parameter, ...]
    neutral: Mapping[str, float]
    statement: Callable[[Mapping[str, float]], str]
    act: Instrument | Tissue
    look_alikes: tuple[str, ...] = ()
    also_possible: tuple[str, ...] = ()
    parts: tuple[tuple[str, ...], ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def group(self) -> tuple[str, ...]:
        """Returns the name of the mechanism, and of those that may be the true one where it is named."""
        return (self.name, *self.look_alikes, *self.also_possible)

    @property
    def whole_or_parts(self) -> tuple[tuple[str, ...], ...]:
        """Returns `parts`, or all parameters as one part."""
        return self.parts or (tuple(p.name for p in self.parameters),)


def with_one(names: Iterable[str], name: str, known: Mapping[str, Mechanism]) -> tuple[str, ...]:
    """Returns a set of names with one mechanism added, and with the mechanisms that it needs."""
    return tuple(sorted({*names, name, *known[name].needs}))


def without_one(names: Iterable[str], name: str, known: Mapping[str, Mechanism]) -> tuple[str, ...]:
    """Returns a set of names without one mechanism, and without the mechanisms that need it."""
    return tuple(other for other in names if other != name and name not in known[other].needs)


def observed(
    mechanisms: Iterable[Mechanism], values: Values, motion: PadMotion, force: ForceOfTime
) -> ForceOfTime:
    """Returns the reported force after the instrument mechanisms among `mechanisms` have acted on a force.

    They act in the order of their places, then of their names, in whatever order they are given.
    """
    acts = [(m.act.place, m.name, m.act) for m in mechanisms if isinstance(m.act, Instrument)]
    for _, _, act in sorted(acts, key=lambda placed: placed[:2]):
        force = act.observe(values, motion, force)
    return force


def solved(mechanisms: Iterable[Mechanism]) -> list[Mechanism]:
    """Returns the mechanisms that the full model solves. The other mechanisms act on its force."""
    return [m for m in mechanisms if m.act.bind is not None]


def laws(mechanisms: Iterable[Mechanism]) -> list[Bind]:
    """Returns the laws that `simulate` is given for `mechanisms`."""
    return [m.act.bind for m in mechanisms if m.act.bind is not None]


def added(force: ForceOfTime, more: ForceOfTime) -> ForceOfTime:
    """Returns the sum of two forces as a function of time."""
    return lambda time_s: np.asarray(force(time_s) + more(time_s))


class Bins:
    """Computes means of forces over the bins between edges_s (m+1,).

    The quadrature is exact to high order between corners. It also resolves effects of `mechanisms` that
    repeat over the travel or time, or that settle after a corner.
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
        at_gauss = np.ascontiguousarray(force(self._time_s)).reshape(-1, len(self._width), GAUSS_POINTS)
        integral = np.empty((len(at_gauss), len(self._lasts_s)))
        bin_integrals(at_gauss, self._weight, self._width, self._first, integral)
        integral /= self._lasts_s
        return integral


def bin_means(
    force: ForceOfTime, motion: PadMotion, edges_s: Array, mechanisms: Iterable[Mechanism] = ()
) -> Array:
    """Returns the means (n, m) of one force over the bins between edges_s (m+1,).

    mechanisms : those that have acted on the force, so that the quadrature resolves their effects (`Bins`)
    """
    return Bins(motion, edges_s, mechanisms).means(force)


def _no_longer(cuts: Array, motion: PadMotion, travel_m: float, lasts_s: float) -> Array:
    """Returns `cuts` with further times between them.

    Between neighbouring times the pads move by at most `travel_m` [m], and at most `lasts_s` [s] pass.
    """
    longest = np.maximum(np.abs(np.diff(motion.at(cuts))) / travel_m, np.diff(cuts) / lasts_s)
    parts = np.ceil(longest).astype(int).clip(1)
    pieces = zip(cuts[:-1], cuts[1:], parts, strict=True)
    return np.append(np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in pieces]), cuts[-1])
