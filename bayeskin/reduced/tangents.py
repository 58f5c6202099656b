"""Keeps the tangents of solved stages, so that later stages of a run can use them again.

A tangent costs as much as about twenty residuals. It changes slowly along the protocol, whose cycles return
to earlier displacements. The inverse of a stage, with the corrections from its solve, is therefore kept under
the place of the stage. A new stage takes the inverse of the nearest place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TangentSettings:
    """Settings with which tangents are kept.

    most : largest number of tangents that are kept
    same_place : a kept tangent this near to a new one is replaced by it
    far : a tangent farther away is not used; a long stage drains more than a short one
    """

    most: int = 32
    same_place: float = 0.02
    far: float = float(np.log(4.0))


KEEPING = TangentSettings()


class Tangent:
    """The inverse of a tangent, with the row of the force and the column of the pads; solves correct it."""

    def __init__(self, size: int) -> None:
        self.inverse, self.force_row = np.zeros((size, size)), np.zeros(size)
        self.by_pads = np.zeros(size + 1)

    def set_to(self, other: Tangent) -> None:
        """Copies the values of another tangent."""
        self.inverse[:], self.force_row[:], self.by_pads[:] = other.inverse, other.force_row, other.by_pads


class Tangents:
    """Keeps tangents by the places of the stages that used them last."""

    def __init__(self) -> None:
        self._kept: list[tuple[tuple[float, float], Tangent]] = []  # the most recent one is last

    def take(self, place: tuple[float, float], into: Tangent) -> bool:
        """Copies the tangent of the nearest place to `into`; returns False where none is near enough."""
        nearest = min(self._kept, key=lambda kept: _apart(kept[0], place), default=None)
        if nearest is None or _apart(nearest[0], place) > KEEPING.far:
            return False
        into.set_to(nearest[1])
        return True

    def forget(self) -> None:
        """Drops all tangents."""
        self._kept.clear()

    def keep(self, place: tuple[float, float], tangent: Tangent) -> None:
        """Keeps a copy of a tangent under a place.

        It replaces the tangent at the same place, or the oldest one where the storage is full.
        """
        same = [i for i, kept in enumerate(self._kept) if _apart(kept[0], place) < KEEPING.same_place]
        full = [0] if len(self._kept) == KEEPING.most else []
        number = next(iter([*same, *full]), None)
        copy = Tangent(len(tangent.force_row)) if number is None else self._kept.pop(number)[1]
        copy.set_to(tangent)
        self._kept.append((place, copy))


def _apart(place: tuple[float, float], other: tuple[float, float]) -> float:
    return abs(place[0] - other[0]) + abs(place[1] - other[1])
