"""Interpolates linearly at thousands of times at once, compiled and without reordered sums.

Each prediction of a mismatch needs it. The times ascend, so the search for a time starts where the search for
the time before it ended.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from bayeskin.types import Array

strict = numba.njit(cache=True, error_model="numpy")  # gives the same bits in every process


def interpolated(grid_s: Array, values: Array, time_s: Array) -> Array:
    """Returns values (n, k) at grid_s (k,), interpolated linearly at times (t,) or (n, t).

    Before the first and after the last time of the grid the values are constant.
    """
    times = np.ascontiguousarray(np.atleast_2d(time_s))
    out = np.empty((len(values), times.shape[1]))
    _interpolate(grid_s, np.ascontiguousarray(values), times, out)
    return out


@numba.njit(inline="always")
def stretch_of(grid, left, time):
    """Returns the index of the last of grid[:-1] that is at most `time`, or 0; searches from `left` on."""
    while left > 0 and time < grid[left]:
        left -= 1
    while left + 2 < len(grid) and time >= grid[left + 1]:
        left += 1
    return left


@strict
def _interpolate(grid, values, times, out):
    place, share = np.zeros(times.shape[1], np.int64), np.zeros(times.shape[1])
    for i in range(out.shape[0]):
        if i < times.shape[0]:  # otherwise all rows have the times of the first
            left = 0
            for j in range(times.shape[1]):
                left = stretch_of(grid, left, times[i, j])
                along = (times[i, j] - grid[left]) / (grid[left + 1] - grid[left])
                place[j], share[j] = left, min(max(along, 0.0), 1.0)
        for j in range(times.shape[1]):
            low, high = values[i, place[j]], values[i, place[j] + 1]
            out[i, j] = low + share[j] * (high - low)


@strict
def bin_integrals(found, weight, width, first, out):
    """Fills out (n, m) with integrals over bins, from values `found` (n, c, g) at Gauss points.

    Column j is the sum of width[c] weight @ found[:, c] from c = first[j] to c = first[j + 1] - 1.
    """
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for c in range(first[j], first[j + 1]):
                inner = 0.0
                for g in range(len(weight)):
                    inner += weight[g] * found[i, c, g]
                total += width[c] * inner
            out[i, j] = total
