"""Tangents of stages that were solved, kept to serve again where a run comes back to.

A tangent costs as much as some twenty residuals and changes slowly along the protocol, whose cycles come back
to where they were. So the inverse that served a stage, with the corrections that its solve made, is kept
under the place of the stage, and the nearest one serves the next.
"""

from __future__ import annotations

import numpy as np

ROOM = 32  # tangents that are kept
SAME_PLACE = 0.02  # one this near to a new one is replaced by it
FAR = np.log(4.0)  # from which on one does not serve: what a short stage leaves undrained a long one drains


class Tangent:
    """The inverse of a tangent, with the force's row and the pads' column; corrected as solves go."""

    def __init__(self, size: int) -> None:
        self.inverse, self.force_row = np.zeros((size, size)), np.zeros(size)
        self.by_pads = np.zeros(size + 1)

    def set_to(self, other: Tangent) -> None:
        """Takes the values of another one."""
        self.inverse[:], self.force_row[:], self.by_pads[:] = other.inverse, other.force_row, other.by_pads


class Tangents:
    """Tangents by the places where they last served."""

    def __init__(self) -> None:
        self._kept: list[tuple[tuple[float, float], Tangent]] = []  # the one that served last at the end

    def take(self, place: tuple[float, float], into: Tangent) -> bool:
        """Sets a tangent to that of the nearest place; returns whether there is one that serves."""
        nearest = min(self._kept, key=lambda kept: _apart(kept[0], place), default=None)
        if nearest is None or _apart(nearest[0], place) > FAR:
            return False
        into.set_to(nearest[1])
        return True

    def forget(self) -> None:
        """Drops all tangents."""
        self._kept.clear()

    def keep(self, place: tuple[float, float], tangent: Tangent) -> None:
        """Keeps a copy under a place, instead of that at the same place, or of that which is oldest."""
        same = [i for i, kept in enumerate(self._kept) if _apart(kept[0], place) < SAME_PLACE]
        full = [0] if len(self._kept) == ROOM else []
        number = next(iter([*same, *full]), None)
        room = Tangent(len(tangent.force_row)) if number is None else self._kept.pop(number)[1]
        room.set_to(tangent)
        self._kept.append((place, room))


def _apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])
