"""The way from the protocol to the pads: what lies in series with the skin loses a part of the displacement.

What is lost follows from the force, and the force from what is left. Both are solved for by a secant method
that knows neither mesh nor basis: the model solves with the pads at a displacement, and tells the force.

Derivatives by parameters: what is lost is s(F, theta). With the skin's stiffness K_u, by the pads' travel
alone, and the derivative F' of the force with s held,

    ds = (ds/dtheta + ds/dF F') / (1 + ds/dF K_u) ,   dF = F' - K_u ds .
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.finite_element.tissue import SeriesElement, TissueLaw
from bayeskin.types import Array, PadMotion

OPENED_S, REST_S = 1e3, 1e6  # pads that were opened before the test: by then, and when it starts
SMALLEST_MOTION_M = 1e-4  # so that a protocol without motion has a scale too
SERIES_TOLERANCE = 1e-5  # of the largest displacement, in what is lost before the skin
MOST_TRIALS = 8  # of what is lost

Memories = tuple[Array, ...]  # (k,) of each element in series; derivatives by r parameters are (k, r)
Solved = tuple[Array, float]  # unknowns, and the force [N] beyond that at the start of the test


@dataclass(frozen=True)
class Drive:
    """The drive's motion on its way to the pads.

    motion : what is left of the protocol when all is lost that depends on the motion alone [m, LVDT]
    starts_s : when the test starts; the elements act from then on
    elements : what lies in series with the skin
    """

    motion: PadMotion
    starts_s: float
    elements: tuple[SeriesElement, ...]

    @cached_property
    def largest_m(self) -> float:
        """The largest displacement of a pad [m], a scale of displacements."""
        return max(0.5 * float(np.abs(self.motion.displacement_m).max()), SMALLEST_MOTION_M)

    @property
    def at_rest(self) -> Memories:
        """The elements' memories at the start."""
        return tuple(np.zeros(element.remembers) for element in self.elements)

    def yields(self, time_s: float) -> bool:
        """Says whether elements act at a time."""
        return bool(self.elements) and time_s > self.starts_s + 1e-9

    def pads_m(self, time_s: float, lost_m: float) -> float:
        """The displacement of a pad [m] when `lost_m` of the drive's is lost: half of what is left."""
        return 0.5 * (float(self.motion.at(time_s)) - lost_m)

    def lost_m(self, time_s: float, pads_m: float) -> float:
        """The displacement [m, LVDT] that is lost where the pads are at `pads_m`."""
        return float(self.motion.at(time_s)) - 2.0 * pads_m

    def follow(self, force_n: float, elapsed_s: float, before: Memories) -> Memories:
        """The elements' memories under a force, a time after `before`."""
        elements = zip(self.elements, before, strict=True)
        return tuple(element.follow(force_n, elapsed_s, memory) for element, memory in elements)


def on_the_way(protocol: PadMotion, laws: Sequence[TissueLaw]) -> Drive:
    """Returns what laws leave of a protocol on its way to the pads, and what lies in series with the skin.

    Pads that were opened before are slowly moved apart and left to rest.
    """
    motion, opening_m = protocol, sum(law.opening_m for law in laws)
    if opening_m != 0.0:
        time_s = np.concatenate([[0.0, OPENED_S], REST_S + motion.time_s])
        motion = PadMotion(time_s, np.concatenate([[0.0, opening_m], opening_m + motion.displacement_m]))
    elements = tuple(law.series for law in laws if law.series is not None)
    for element in elements:
        motion = element.moved(motion)
    return Drive(motion, REST_S if opening_m != 0.0 else 0.0, elements)


def total(lost: Memories) -> float:
    """The displacement [m] that all elements in series lose."""
    return sum(float(memory[0]) for memory in lost)


def yielding(follow: Callable[[float], Memories], force_n: float, by_n: float) -> float:
    """Returns what is lost more a newton [m/N], over a small change `by_n`; follow : memories of a force."""
    return (total(follow(force_n + by_n)) - total(follow(force_n))) / by_n


class SeriesSolver:
    """Solves the stages of one run with what lies in series with the skin.

    It remembers how unknowns and force answered last to a displacement that is lost.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._answer: tuple[float, Array] | None = None  # of force and unknowns to a metre that is lost

    def solve(
        self,
        time_s: float,
        elapsed_s: float,
        before: Memories,
        expected_m: float | None,
        first: Callable[[float], Solved | None],
        again: Callable[[Array, float], Solved | None],
    ) -> tuple[Solved, Memories] | None:
        """Returns unknowns and force at a time and the elements' memories there, or None if none were found.

        elapsed_s : since the memories `before`
        expected_m : where the pads will be, as far as known
        first, again : solve with the pads at a displacement [m], by a guess of the model and by a given one
        """
        drive, lost_m = self._drive, total(before)
        yields = drive.yields(time_s)
        if yields and expected_m is not None:
            lost_m = drive.lost_m(time_s, expected_m)
        found = first(drive.pads_m(time_s, lost_m))
        if not yields:
            return None if found is None else (found, before)

        def follow(force_n: float) -> Memories:
            return drive.follow(force_n, elapsed_s, before)

        def moved(x: Array, by_m: float) -> Solved | None:
            return again(x, drive.pads_m(time_s, by_m))

        return self._balanced(found, lost_m, follow, moved)

    def _balanced(
        self,
        found: Solved | None,
        lost_m: float,
        follow: Callable[[float], Memories],
        moved: Callable[[Array, float], Solved | None],
    ) -> tuple[Solved, Memories] | None:
        """Goes on from what is `found` with `lost_m` lost to where what is lost fits the force."""
        allowed_m = SERIES_TOLERANCE * self._drive.largest_m
        past: tuple[float, Array, float] | None = None  # lost, unknowns, force
        for _ in range(MOST_TRIALS):
            if found is None:
                break
            x, force_n = found
            lost = follow(force_n)
            missing_m = total(lost) - lost_m
            if abs(missing_m) < allowed_m:
                return found, lost
            if past is not None and abs(lost_m - past[0]) > allowed_m:
                more_m = lost_m - past[0]
                self._answer = (force_n - past[2]) / more_m, (x - past[1]) / more_m
            past = lost_m, x, force_n
            stiffness, ride = self._answer or (0.0, np.zeros_like(x))
            softness = yielding(follow, force_n, 1e-3 * abs(force_n) + 1e-9)
            step_m = missing_m / max(1.0 - softness * stiffness, 0.5)
            lost_m += step_m
            found = moved(x + step_m * ride, lost_m)
        return None


def memory_slopes(
    varied: Sequence[Drive], step: float, force_n: float, slopes_n: Array, elapsed_s: float,
    before: Memories, before_slopes: Memories, after: Memories,
) -> Memories:  # fmt: skip
    """Returns derivatives (k, r) of the elements' memories `after` a force, by r parameters.

    varied : with each parameter `step` of its change further
    slopes_n (r,), before_slopes (k, r) : derivatives of the force and of the memories before
    """
    columns = []
    for r, drive in enumerate(varied):
        moved = tuple(old + step * slope[:, r] for old, slope in zip(before, before_slopes, strict=True))
        found = drive.follow(force_n + step * float(slopes_n[r]), elapsed_s, moved)
        columns.append([(new - now) / step for new, now in zip(found, after, strict=True)])
    return tuple(np.stack(parts, axis=1) for parts in zip(*columns, strict=True))


def lost_slopes(
    slopes_n: Array, held_m: Array, softness: float, stiffness: float, follow: Callable[[Array], Memories]
) -> tuple[Array, Memories]:
    """Returns derivatives (r,) of what is lost beyond those that were held, and (k, r) of the memories.

    slopes_n (r,) : of the force beyond that at the start, with derivatives held_m (r,) of what is lost
    softness [m/N], stiffness [N/m] : of the elements (`yielding`), and of the skin by what is lost
    follow : derivatives of the memories from those of the force
    """
    asked = sum((memory[0] for memory in follow(slopes_n)), np.zeros(len(slopes_n)))
    more = (asked - held_m) / (1.0 + softness * stiffness)
    return more, follow(slopes_n - stiffness * more)
