"""Straight lines between moments, at thousands of times at once: compiled, and without reordered sums.

Each prediction of a mismatch asks for them; the times ascend, so that a place is found from the last one.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np

from bayeskin.types import Array

strict = numba.njit(cache=True, error_model="numpy")  # the same bits in every process


def interpolated(grid_s: Array, values: Array, time_s: Array) -> Array:
    """Of values (n, k) at grid_s (k,), straight between and constant beyond, at times (t,) or (n, t)."""
    times = np.ascontiguousarray(np.atleast_2d(time_s))
    out = np.empty((len(values), times.shape[1]))
    _interpolate(grid_s, np.ascontiguousarray(values), times, out)
    return out


@numba.njit(inline="always")
def stretch_of(grid, left, time):
    """Index of the last of grid[:-1] that is at most `time`, or 0; searched for from `left` on."""
    while left > 0 and time < grid[left]:
        left -= 1
    while left + 2 < len(grid) and time >= grid[left + 1]:
        left += 1
    return left


@strict
def _interpolate(grid, values, times, out):
    place, share = np.zeros(times.shape[1], np.int64), np.zeros(times.shape[1])
    for i in range(out.shape[0]):
        if i < times.shape[0]:  # else all rows have the times of the first
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
    """Fills out (n, m): sums of width[c] weight @ found[:, c], (n, c, g), over c = first[j] .. first[j+1]."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for c in range(first[j], first[j + 1]):
                inner = 0.0
                for g in range(len(weight)):
                    inner += weight[g] * found[i, c, g]
                total += width[c] * inner
            out[i, j] = total
