"""What lies between drive and skin, on the force of a surrogate: a shortcut for what the full model solves.

The skin sees p - s: p trails the drive u behind a gap, s is what yields (compliance) and what has slipped.
Its force is taken to follow the displacement at once,

    F[p - s](t) = F[u](t) + G(p(t) - s(t)) - G(u(t)) ,

G the force over the displacement of the first loading, straight on below its start. Exact for skin without
memory; the full model tells what else there is to it.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from bayeskin.mechanisms.lines import interpolated, strict
from bayeskin.mechanisms.mechanism import ForceOfTime, added
from bayeskin.types import Array, PadMotion

STEPS_A_PHASE = 100
GRID = 33  # displacements at which G is tabulated
ITERATIONS = 8  # of a force and what it makes lost, which changes it by some tenths at most


def lost_in_series(
    motion: PadMotion,
    force: ForceOfTime,
    gap_m: Array,
    compliance: Array,
    rate: Array,
    threshold_n: Array,
) -> ForceOfTime:
    """The force behind a gap [m], a compliance [m/N], and slip [m/(N s)] beyond a threshold; all (n,)."""
    steps = np.linspace(motion.time_s[:-1], motion.time_s[1:], STEPS_A_PHASE, endpoint=False).T.ravel()
    grid_s = np.append(steps, motion.time_s[-1])
    u, n = motion.at(grid_s), len(gap_m)
    rising = np.flatnonzero(np.diff(motion.displacement_m) > 0.0)
    first = int(rising[0]) if len(rising) else 0
    start, end = motion.time_s[first : first + 2]
    low, high = motion.displacement_m[first : first + 2]
    table = force(np.linspace(start, end, GRID)) - force(np.array([start]))
    free = np.ascontiguousarray(np.broadcast_to(force(grid_s), (n, len(grid_s))))
    change = np.zeros_like(free)
    _march(
        free, u, np.diff(grid_s), np.ascontiguousarray(np.broadcast_to(table, (n, GRID))), float(low),
        float(max(high - low, 1e-9)), gap_m, compliance, rate, threshold_n, float(np.ptp(u)), change,
    )  # fmt: skip

    return added(force, lambda time_s: interpolated(grid_s, change, time_s))


@strict
def _march(free, u, elapsed, table, low, width, gap, compliance, rate, threshold, reach, change):
    """Fills change (n, k) of the forces `free` (n, k) at drive displacements u (k,).

    Rows side by side, because each waits for its own last iteration.
    """
    n = free.shape[0]
    scale = (table.shape[1] - 1) / width
    behind, slip, before, rest = np.full(n, u[0]), np.zeros(n), free[:, 0].copy(), np.empty(n)
    added, slid = np.zeros(n), np.zeros(n)
    for k in range(1, free.shape[1]):
        for i in range(n):
            behind[i] = max(u[k] - gap[i], min(u[k], behind[i]))
            rest[i] = _interpolated(table, i, (u[k] - low) * scale)
        for _ in range(ITERATIONS):
            moved = False
            for i in range(n):
                now, last = free[i, k] + added[i], added[i]
                if rate[i] != 0.0:
                    more = rate[i] * elapsed[k - 1] * mean_beyond(before[i], now, threshold[i])
                    slid[i] = min(max(slip[i] + more, -reach), reach)
                lost = min(max(slid[i] + compliance[i] * now, -reach), reach)
                added[i] = _interpolated(table, i, (behind[i] - lost - low) * scale) - rest[i]
                moved |= added[i] != last
            if not moved:  # to the last bit: no iteration changes them any more
                break
        for i in range(n):
            slip[i], before[i], change[i, k] = slid[i], free[i, k] + added[i], added[i]


@numba.njit(inline="always")
def _interpolated(table, i, place):
    """Of row i of a table (n, g) at `place` in 0..g-1, straight on beyond it."""
    left = min(max(int(place), 0), table.shape[1] - 2)
    return table[i, left] + (place - left) * (table[i, left + 1] - table[i, left])


@strict
def mean_beyond(before, now, threshold):
    """Mean of sgn(F) max(|F| - threshold, 0) along a straight line between two forces."""
    total = 0.0
    for sign in (1.0, -1.0):
        a, b = sign * before - threshold, sign * now - threshold
        low, high = min(a, b), max(a, b)
        if low >= 0.0:
            total += sign * 0.5 * (a + b)
        elif high > 0.0:
            total += sign * high * high / (2.0 * (high - low))
    return total
