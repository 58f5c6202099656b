"""Changes the force of a surrogate for elements between drive and skin: a shortcut for the full model.

The skin sees the displacement p - s. The displacement p trails the drive's displacement u behind a gap. The
lost displacement s is the sum of what yields at once (compliance), what yields slowly (recovery, a
Kelvin-Voigt element) and what has slipped. The force is taken to follow the displacement at once,

    F[p - s](t) = F[u](t) + G(p(t) - s(t)) - G(u(t)) ,

where G is the force over the displacement of the first loading, extrapolated linearly beyond its ends. This
is exact for skin without memory. The full model shows the effects that this shortcut leaves out.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import ArrayLike

from bayeskin.mechanisms.lines import interpolated, strict
from bayeskin.mechanisms.mechanism import ForceOfTime, added
from bayeskin.types import PadMotion

STEPS_A_PHASE = 100
GRID = 33  # number of displacements at which G is tabulated
ITERATIONS = 8  # iterations of force and lost displacement, which changes the force by some tenths at most


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
    """Returns the reported force with elements between drive and skin; each argument is (n,) or one number.

    gap_m : lost motion [m]; compliance [m/N] : of an element that yields at once
    rate [m/(N s)], threshold_n [N] : of a slip, and the force beyond which it slips
    recovery [m/N], recovery_s [s] : compliance and time constant of an element that yields and returns slowly
    """
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

    return added(force, lambda time_s: interpolated(grid_s, change, time_s))


@strict
def _march(
    free, u, elapsed, table, low, width, gap, compliance, rate, threshold, recovery, recovery_s, reach, change
):  # fmt: skip
    """Fills change (n, k) with the changes of the forces `free` (n, k), at displacements u (k,) of the drive.

    The innermost loops run over rows, because each iteration of a row has to wait for the one before it.
    """
    n = free.shape[0]
    scale = (table.shape[1] - 1) / width
    behind, slip, before, rest = np.full(n, u[0]), np.zeros(n), free[:, 0].copy(), np.empty(n)
    added, slid, yielded, slow = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    keep, phi = np.zeros(n), np.zeros(n)
    for k in range(1, free.shape[1]):
        for i in range(n):
            behind[i] = max(u[k] - gap[i], min(u[k], behind[i]))
            rest[i] = _interpolated(table, i, (u[k] - low) * scale)
            if recovery[i] != 0.0:
                z = elapsed[k - 1] / recovery_s[i]
                keep[i], phi[i] = np.exp(-z), -np.expm1(-z) / z
        for _ in range(ITERATIONS):
            moved = False
            for i in range(n):
                now, last = free[i, k] + added[i], added[i]
                if rate[i] != 0.0:
                    more = rate[i] * elapsed[k - 1] * mean_beyond(before[i], now, threshold[i])
                    slid[i] = min(max(slip[i] + more, -reach), reach)
                if recovery[i] != 0.0:
                    mean = (phi[i] - keep[i]) * before[i] + (1.0 - phi[i]) * now
                    slow[i] = keep[i] * yielded[i] + recovery[i] * mean
                lost = min(max(slid[i] + slow[i] + compliance[i] * now, -reach), reach)
                added[i] = _interpolated(table, i, (behind[i] - lost - low) * scale) - rest[i]
                moved |= added[i] != last
            if not moved:  # no force has changed in its last bit, so none would change any more
                break
        for i in range(n):
            slip[i], yielded[i], before[i] = slid[i], slow[i], free[i, k] + added[i]
            change[i, k] = added[i]


@numba.njit(inline="always")
def _interpolated(table, i, place):
    """Returns row i of a table (n, g), interpolated at `place` in 0..g-1 and extrapolated linearly beyond."""
    left = min(max(int(place), 0), table.shape[1] - 2)
    return table[i, left] + (place - left) * (table[i, left + 1] - table[i, left])


@strict
def mean_beyond(before, now, threshold):
    """Returns the mean of sgn(F) max(|F| - threshold, 0) while F goes linearly from `before` to `now`."""
    total = 0.0
    for sign in (1.0, -1.0):
        a, b = sign * before - threshold, sign * now - threshold
        low, high = min(a, b), max(a, b)
        if low >= 0.0:
            total += sign * 0.5 * (a + b)
        elif high > 0.0:
            total += sign * high * high / (2.0 * (high - low))
    return total
