"""Models the transmission from the drive to the pads: elements in series with the skin lose displacement.

The lost displacement depends on the force, and the force depends on the displacement that is left. A secant
method solves for both. It needs neither mesh nor basis: the model solves with the pads at a given
displacement and returns the force.

The derivatives with respect to parameters follow from the lost displacement s(F, theta). Let K_u be the
stiffness of the skin, which is the derivative of the force with respect to the pads' travel alone. Let F' be
the derivative of the force with s held. Then

    ds = (ds/dtheta + ds/dF F') / (1 + ds/dF K_u) ,   dF = F' - K_u ds .
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayeskin.finite_element.tissue import SeriesElement, TissueLaw
from bayeskin.types import Array, PadMotion

OPENED_S, REST_S = 1e3, 1e6  # pads opened before the test: time when they are open, and when the test starts
SMALLEST_MOTION_M = 1e-4  # gives a scale to a protocol without motion
SERIES_TOLERANCE = 1e-5  # tolerance of the lost displacement, relative to the largest displacement
MOST_TRIALS = 8  # largest number of iterations for the lost displacement

Memories = tuple[Array, ...]  # (k,) for each element in series; (k, r) for derivatives by r parameters
Solved = tuple[Array, float]  # unknowns, and the force [N] relative to the start of the test


@dataclass(frozen=True)
class Drive:
    """The motion of the drive, and the elements between the drive and the pads.

    motion : protocol [m, LVDT] without the displacement whose loss depends on the motion alone
    starts_s : time at which the test starts; the elements act from then on
    elements : elements in series with the skin
    """

    motion: PadMotion
    starts_s: float
    elements: tuple[SeriesElement, ...]

    @cached_property
    def largest_m(self) -> float:
        """Returns the largest displacement of a pad [m], as a scale of displacements."""
        return max(0.5 * float(np.abs(self.motion.displacement_m).max()), SMALLEST_MOTION_M)

    @property
    def at_rest(self) -> Memories:
        """Returns the memories of the elements at the start."""
        return tuple(np.zeros(element.remembers) for element in self.elements)

    def yields(self, time_s: float) -> bool:
        """Returns True if elements act at this time."""
        return bool(self.elements) and time_s > self.starts_s + 1e-9

    def pads_m(self, time_s: float, lost_m: float) -> float:
        """Returns a pad's displacement [m]: half of the drive's displacement less the lost displacement."""
        return 0.5 * (float(self.motion.at(time_s)) - lost_m)

    def lost_m(self, time_s: float, pads_m: float) -> float:
        """Returns the lost displacement [m, LVDT] if each pad has the displacement `pads_m`."""
        return float(self.motion.at(time_s)) - 2.0 * pads_m

    def follow(self, force_n: float, elapsed_s: float, before: Memories) -> Memories:
        """Returns the elements' memories under a force, `elapsed_s` after the memories `before`."""
        elements = zip(self.elements, before, strict=True)
        return tuple(element.follow(force_n, elapsed_s, memory) for element, memory in elements)


def on_the_way(protocol: PadMotion, laws: Sequence[TissueLaw]) -> Drive:
    """Returns the motion on its way to the pads, and the elements in series with the skin.

    If the pads were opened before the test, the motion first moves them slowly apart and leaves them at rest.
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
    """Returns the displacement [m] that all elements in series lose together."""
    return sum(float(memory[0]) for memory in lost)


def yielding(follow: Callable[[float], Memories], force_n: float, by_n: float) -> float:
    """Returns the additional lost displacement per newton [m/N], from a small change `by_n` of the force.

    follow : function that returns the memories under a force
    """
    return (total(follow(force_n + by_n)) - total(follow(force_n))) / by_n


class SeriesSolver:
    """Solves the stages of one run together with the elements in series with the skin.

    It remembers how the unknowns and the force last responded to a lost displacement.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        # change of the force and of the unknowns for a metre of lost displacement
        self._answer: tuple[float, Array] | None = None

    def solve(
        self,
        time_s: float,
        elapsed_s: float,
        before: Memories,
        expected_m: float | None,
        first: Callable[[float], Solved | None],
        again: Callable[[Array, float], Solved | None],
    ) -> tuple[Solved, Memories] | None:
        """Returns the unknowns and the force at a time, and the elements' memories there.

        It returns None if there is no convergence.

        elapsed_s : time since the memories `before`
        expected_m : expected displacement of the pads, or None if it is not known
        first : function that solves with the pads at a displacement [m], from the model's own guess
        again : function that solves with the pads at a displacement [m], from a given guess
        """
        drive, lost_m = self._drive, total(before)
        yields = drive.yields(time_s)
        if yields and expected_m is not None:
            lost_m = drive.lost_m(time_s, expected_m)
        solution = first(drive.pads_m(time_s, lost_m))
        if not yields:
            return None if solution is None else (solution, before)

        def follow(force_n: float) -> Memories:
            return drive.follow(force_n, elapsed_s, before)

        def moved(x: Array, by_m: float) -> Solved | None:
            return again(x, drive.pads_m(time_s, by_m))

        return self._solve_lost(solution, lost_m, follow, moved)

    def _solve_lost(
        self,
        solution: Solved | None,
        lost_m: float,
        follow: Callable[[float], Memories],
        moved: Callable[[Array, float], Solved | None],
    ) -> tuple[Solved, Memories] | None:
        """Iterates until the lost displacement agrees with the force.

        solution : solution with the displacement `lost_m` lost, from which the iteration starts
        """
        allowed_m = SERIES_TOLERANCE * self._drive.largest_m
        past: tuple[float, Array, float] | None = None  # lost displacement, unknowns, force
        for _ in range(MOST_TRIALS):
            if solution is None:
                break
            x, force_n = solution
            lost = follow(force_n)
            missing_m = total(lost) - lost_m
            if abs(missing_m) < allowed_m:
                return solution, lost
            if past is not None and abs(lost_m - past[0]) > allowed_m:
                change_m = lost_m - past[0]
                self._answer = (force_n - past[2]) / change_m, (x - past[1]) / change_m
            past = lost_m, x, force_n
            stiffness, ride = self._answer or (0.0, np.zeros_like(x))
            softness = yielding(follow, force_n, 1e-3 * abs(force_n) + 1e-9)
            step_m = missing_m / max(1.0 - softness * stiffness, 0.5)
            lost_m += step_m
            solution = moved(x + step_m * ride, lost_m)
        return None


def memory_slopes(
    varied: Sequence[Drive], step: float, force_n: float, slopes_n: Array, elapsed_s: float,
    before: Memories, before_slopes: Memories, after: Memories,
) -> Memories:  # fmt: skip
    """Returns the derivatives (k, r) of the elements' memories `after` a force, with respect to r parameters.

    varied : for each parameter, the drive with that parameter changed by `step` times its change
    slopes_n (r,) : derivatives of the force
    before_slopes (k, r) : derivatives of the memories `before`
    """
    columns = []
    for r, drive in enumerate(varied):
        moved = tuple(old + step * slope[:, r] for old, slope in zip(before, before_slopes, strict=True))
        memories = drive.follow(force_n + step * float(slopes_n[r]), elapsed_s, moved)
        columns.append([(new - now) / step for new, now in zip(memories, after, strict=True)])
    return tuple(np.stack(parts, axis=1) for parts in zip(*columns, strict=True))


def lost_slopes(
    slopes_n: Array, held_m: Array, softness: float, stiffness: float, follow: Callable[[Array], Memories]
) -> tuple[Array, Memories]:
    """Returns the derivatives of the lost displacement, as a change (r,), and of the memories (k, r).

    The change is counted from held_m (r,), the derivatives with which the force was differentiated.

    slopes_n (r,) : derivatives of the force, relative to the start of the test, with held_m
    softness : compliance of the elements [m/N] (`yielding`)
    stiffness : derivative of the force with respect to the displacement of the skin [N/m]
    follow : function that returns the derivatives of the memories for those of the force
    """
    demanded = sum((memory[0] for memory in follow(slopes_n)), np.zeros(len(slopes_n)))
    change = (demanded - held_m) / (1.0 + softness * stiffness)
    return change, follow(slopes_n - stiffness * change)
