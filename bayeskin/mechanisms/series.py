"""What lies between drive and skin, on the force of a surrogate: a shortcut for what the full model solves.

The skin sees p - s: p trails the drive u behind a gap, s is what yields at once (compliance) or slowly
(recovery, a Kelvin-Voigt element), and what has slipped.
Its force is taken to follow the displacement at once,

    F[p - s](t) = F[u](t) + G(p(t) - s(t)) - G(u(t)) ,

G the force over the displacement of the first loading, straight on below its start. Exact for skin without
memory; the full model tells what else there is to it.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.model.assembly import compiled
from bayeskin.types import Array, PadMotion

STEPS_A_PHASE = 100
GRID = 33  # displacements at which G is tabulated
ITERATIONS = 8  # of a force and what it makes lost, which changes it by some tenths at most


def lost_in_series(
    motion: PadMotion,
    force: ForceOfTime,
    gap_m: ArrayLike = 0.0,
    compliance: ArrayLike = 0.0,
    rate: ArrayLike = 0.0,
    threshold_n: ArrayLike = 0.0,
    recovery: ArrayLike = 0.0,
    recovery_s: ArrayLike = 1.0,
) -> ForceOfTime:
    """The force behind a gap [m], a compliance [m/N], slip [m/(N s)] beyond a threshold, and a compliance
    [m/N] that yields and returns over a time [s]; each (n,) or one for all."""
    given = np.broadcast_arrays(gap_m, compliance, rate, threshold_n, recovery, recovery_s)
    elements = [np.array(np.atleast_1d(one), dtype=float) for one in given]
    steps = np.linspace(motion.time_s[:-1], motion.time_s[1:], STEPS_A_PHASE, endpoint=False).T.ravel()
    grid_s = np.append(steps, motion.time_s[-1])
    u, n = motion.at(grid_s), len(elements[0])
    rising = np.flatnonzero(np.diff(motion.displacement_m) > 0.0)
    first = int(rising[0]) if len(rising) else 0
    start, end = motion.time_s[first : first + 2]
    low, high = motion.displacement_m[first : first + 2]
    table = force(np.linspace(start, end, GRID)) - force(np.array([start]))
    free = np.ascontiguousarray(np.broadcast_to(force(grid_s), (n, len(grid_s))))
    change = np.zeros_like(free)
    _march(
        free, u, np.diff(grid_s), np.ascontiguousarray(np.broadcast_to(table, (n, GRID))), float(low),
        float(max(high - low, 1e-9)), *elements, float(np.ptp(u)), change,  # type: ignore[call-arg]
    )  # fmt: skip

    def reported(time_s: Array) -> Array:
        each = np.broadcast_to(time_s, (n, np.shape(time_s)[-1]))
        place = np.clip(np.searchsorted(grid_s, each, side="right") - 1, 0, len(grid_s) - 2)
        share = np.clip((each - grid_s[place]) / np.diff(grid_s)[place], 0.0, 1.0)
        left, right = (np.take_along_axis(change, place + one, axis=1) for one in (0, 1))
        return np.asarray(force(time_s) + left + share * (right - left))

    return reported


@compiled
def _march(
    free, u, elapsed, table, low, width, gap, compliance, rate, threshold, recovery, recovery_s, reach, change
):  # fmt: skip
    """Fills change (n, k) of the forces `free` (n, k) at drive displacements u (k,)."""
    for i in range(free.shape[0]):
        behind, slip, yielded, before = u[0], 0.0, 0.0, free[i, 0]
        for k in range(1, free.shape[1]):
            behind = max(u[k] - gap[i], min(u[k], behind))
            rest = _interpolated(table[i], (u[k] - low) / width)
            z = elapsed[k - 1] / recovery_s[i]
            keep, phi = np.exp(-z), -np.expm1(-z) / z
            added, slid, slow = change[i, k - 1], slip, yielded
            for _ in range(ITERATIONS):
                now = free[i, k] + added
                slid = slip + rate[i] * elapsed[k - 1] * mean_beyond(before, now, threshold[i])
                slid = min(max(slid, -reach), reach)
                slow = keep * yielded + recovery[i] * ((phi - keep) * before + (1.0 - phi) * now)
                lost = min(max(slid + slow + compliance[i] * now, -reach), reach)
                added = _interpolated(table[i], (behind - lost - low) / width) - rest
            slip, yielded, before = slid, slow, free[i, k] + added
            change[i, k] = added


@compiled
def _interpolated(table, place):
    """Of a table over [0, 1], straight on beyond it."""
    place *= len(table) - 1
    left = min(max(int(np.floor(place)), 0), len(table) - 2)
    return table[left] + (place - left) * (table[left + 1] - table[left])


@compiled
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
