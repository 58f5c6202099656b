"""What lies between drive and skin, on the force of a surrogate: a shortcut for what the full model solves.

The skin sees u - s, with s [m] what is lost. Its force is taken to follow the displacement at once,

    F[u - s](t) = F[u](t) + G(u(t) - s(t)) - G(u(t)) ,

G the force over the displacement of the first loading, straight on below its start. Exact for skin without
memory; the full model tells what else there is to it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.types import Array, PadMotion

STEP_S = 0.25
GRID = 33  # displacements at which G is tabulated
ITERATIONS = 4  # of a force that depends on what it makes lost, which changes it by some tenths at most

Follow = Callable[
    [Array, Array, float, Array], Array
]  # forces before and now, elapsed [s], lost before: lost


class FirstLoading:
    """G of a force as a function of time, `rows` of them."""

    def __init__(self, motion: PadMotion, force: ForceOfTime, rows: int) -> None:
        u = motion.displacement_m
        rising = np.flatnonzero(np.diff(u) > 0.0)
        first = int(rising[0]) if len(rising) else 0
        start, end = motion.time_s[first], motion.time_s[min(first + 1, len(u) - 1)]
        time_s = np.linspace(start, end, GRID)
        self._low, self._width = float(u[first]), float(max(u[min(first + 1, len(u) - 1)] - u[first], 1e-9))
        self._table = np.broadcast_to(force(time_s) - force(np.array([start])), (rows, GRID))

    def __call__(self, u: Array) -> Array:
        """G (n,) at displacements (n,), straight on beyond the table."""
        place = (u - self._low) / self._width * (GRID - 1)
        left = np.clip(np.floor(place).astype(int), 0, GRID - 2)
        rows = np.arange(len(self._table))
        below, above = self._table[rows, left], self._table[rows, left + 1]
        return np.asarray(below + (place - left) * (above - below))


def lost_in_series(motion: PadMotion, force: ForceOfTime, rows: int, follow: Follow) -> ForceOfTime:
    """The force when what `follow` says is lost on the way to the skin, (rows,) from step to step."""
    loading = FirstLoading(motion, force, rows)
    every = np.arange(motion.time_s[0], motion.time_s[-1], STEP_S)
    grid_s = np.union1d(motion.time_s, every)
    free, u = np.broadcast_to(force(grid_s), (rows, len(grid_s))), motion.at(grid_s)
    lost, change = np.zeros_like(free), np.zeros_like(free)
    for k in range(1, len(grid_s)):
        elapsed_s, before = float(grid_s[k] - grid_s[k - 1]), free[:, k - 1] + change[:, k - 1]
        at_rest = loading(np.full(len(free), u[k]))
        now = free[:, k] + change[:, k - 1]
        for _ in range(ITERATIONS):
            lost[:, k] = follow(before, now, elapsed_s, lost[:, k - 1])
            change[:, k] = loading(u[k] - lost[:, k]) - at_rest
            now = free[:, k] + change[:, k]

    def reported(time_s: Array) -> Array:
        each = np.broadcast_to(time_s, (rows, np.shape(time_s)[-1]))
        place = np.clip(np.searchsorted(grid_s, each, side="right") - 1, 0, len(grid_s) - 2)
        share = np.clip((each - grid_s[place]) / np.diff(grid_s)[place], 0.0, 1.0)
        left, right = (np.take_along_axis(change, place + one, axis=1) for one in (0, 1))
        return np.asarray(force(time_s) + left + share * (right - left))

    return reported
